"""Output of an experiment: JSON lines, figures and its section of the report."""

import json
import re
from dataclasses import dataclass
from pathlib import Path

from bench.machine import describe

ORDER = ("fig7", "fig8", "fig9", "fig10", "uniqueness", "stability", "table1")
"""The experiments, in the order of the report."""
_MARK = "<!-- section {} -->"
_HEAD = """# The paper's experiments, repeated

This page repeats the experiments of Kim and Han 2022, "Fast Stabilization of Inducible Magnet Simulation",
[doi:10.1145/3550469.3555410](https://doi.org/10.1145/3550469.3555410). The paper compares its method with Kim, Park and
Han 2018, "Magnetization Dynamics for Magnetic Object Interactions". Each section states the paper's result, in its
words or numbers, and the result measured here. The paper's images are not redistributed. Numbers of figures, tables and
equations are the paper's. `python -m bench.paper all` repeats all experiments and writes a report.

| name | meaning |
| --- | --- |
| Ms, f(H), k | saturation magnetization; magnetization curve; initial slope of the curve, 3 for a ball |
| M1, M2 | pair of submagnetizations of size Ms of each moment; its magnetization is M = (M1 + M2)/2 |
| e_M | relative magnetization error, ‖M − f(H)‖/‖f(H)‖ (Eq. 12) |
| θ | angle of M1 and M2 to the effective field, on either side of it; ‖M‖ = Ms cos θ (`docs/physics/equilibrium.md`) |
| κ | dimensionless step β Δt Ms, with the rate β of Eqs. 6 and 8 and the time step Δt |
| `theta`, `warpmag` | this library: exact flow of θ, Anderson mixing, tanh curve (Eq. 10), Kelvin's force (Eq. 13) |
| `theta-euler`, `paper` | Kim and Han 2022: explicit steps of θ (Eqs. 8, 9), tanh curve, the force of Eq. 4 |
| `llg`, `kim2018` | Kim et al. 2018: explicit steps of LLG (Eq. 6), clamped curve (Eq. 7), Kelvin's force |
| `llg-damping` | LLG without precession, clamped curve |
| weak, strong bar | magnetization 1e6 and 4e7 A/m; ‖H‖ at the balls is 0.8 to 20 % of Ms, and 0.3 to 8 Ms |
"""


@dataclass
class Output:
    """Results of one experiment."""

    name: str
    folder: Path  # of the files
    device: str  # name of the Warp device
    small: bool  # true for the small version, for continuous integration
    _started: bool = False

    def __post_init__(self):
        """Describe the machine."""
        self._machine = describe(self.device)

    def record(self, **values):
        """Write a JSON line; print it without the machine and without lists."""
        line = {"experiment": self.name, "small": self.small, **values}
        print(json.dumps({key: value for key, value in line.items() if not isinstance(value, list)}))
        with open(self.folder / f"{self.name}.jsonl", "a" if self._started else "w", encoding="utf-8") as file:
            file.write(json.dumps(line | self._machine) + "\n")
        self._started = True

    def save(self, figure) -> str:
        """Write a Matplotlib figure and return the Markdown that shows it."""
        figure.savefig(self.folder / f"{self.name}.png", dpi=110, bbox_inches="tight")
        return f"![{self.name}]({self.name}.png)"

    def report(self, text: str, part: str = ""):
        """Replace this experiment's section of the report, or one part of it; keep all other sections."""
        path = self.folder / "report.md"
        sections = _read_sections(path)
        where = ", ".join(f"{self._machine[key]}" for key in ("device", "machine", "commit") if self._machine[key])
        size = " Small version." if self.small else ""
        sections[f"{self.name} {part}".strip()] = f"{text.strip()}\n\n*Measured on {where}.{size}*"
        names = sorted(sections, key=lambda name: (ORDER.index(name.split()[0]), name))
        body = "\n\n".join(f"{_MARK.format(name)}\n{sections[name]}" for name in names)
        path.write_text(f"{_HEAD}\n{body}\n", encoding="utf-8")


def _read_sections(path: Path) -> dict[str, str]:
    if not path.exists():
        return {}
    parts = re.split(_MARK.format(r"(\w+(?: \w+)?)"), path.read_text(encoding="utf-8"))
    return {name: text.strip() for name, text in zip(parts[1::2], parts[2::2], strict=True)}


def table(head: list[str], rows: list[list]) -> str:
    """Return a Markdown table."""
    lines = [head, ["---"] * len(head), *rows]
    return "\n".join("| " + " | ".join(str(cell) for cell in line) + " |" for line in lines)
