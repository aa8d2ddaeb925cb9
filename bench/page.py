"""Writes the tables of ``docs/benchmarks.md``, and the figures that other pages quote: ``python -m bench.page``.

The figures are those of ``docs/benchmarks/*.jsonl``, lines of ``python -m bench.all``, a file for each machine. Tables
and quoted figures stand between comments such as ``<!-- benchmark: steps -->`` and ``<!-- benchmark end -->``. The main
figures of each machine and commit are also kept in ``docs/benchmarks/history.jsonl``.
"""

import json
import re
from pathlib import Path

from bench.paper.table1 import PAPERS_TIMES
from bench.report import duration, machine_of, read

ROOT = Path(__file__).parents[1]
PAGES = [ROOT / "README.md", *sorted((ROOT / "docs").rglob("*.md"))]
DATA = ROOT / "docs" / "benchmarks"
HISTORY = DATA / "history.jsonl"
QUOTED = re.compile(r"(<!-- benchmark: (\w+) -->).*?(<!-- benchmark end -->)", re.DOTALL)
_SCENES = {
    "balls_up": "Balls Up, 243 balls",
    "alphabets": "Alphabets, 100 letters",
    "falling_magnet": "Falling Magnet, 1,033 bodies",
    "sakura_tree": "Sakura Tree, 2,500 balls",
}
_OWN = ("warpmag", "h_field")  # names of warpmag among the peers
_PEERS = {"numba_cpu": "a parallel loop in Numba", "warp_tile": "Warp's tile example"}
"""Names of peers for readers who do not know the benchmark; other peers keep theirs."""
_GPU = "NVIDIA H200"
"""Machine of the quoted figures."""

Machines = dict[str, list[dict]]
"""Lines of each machine, by its name."""


def machines() -> Machines:
    """Return the lines of each data file by the name of its machine."""
    files = [path for path in sorted(DATA.glob("*.jsonl")) if path != HISTORY]
    return {machine_of(lines[0]): lines for lines in (read([path]) for path in files)}


def _cases(lines: list[dict], case: str, **values) -> list[dict]:
    """Lines of a case that have these values and did not fail."""
    wanted = {"case": case, **values}
    return [line for line in lines if "failed" not in line and wanted.items() <= line.items()]


def _time(lines: list[dict]) -> str:
    """Time of the first line, or an empty cell."""
    return duration(lines[0]["seconds"]) if lines else ""


def _table(head: list[str], rows: list[list[str]]) -> str:
    lines = [head, ["---"] * len(head), *rows]
    return "\n\n" + "".join(f"| {' | '.join(row)} |\n" for row in lines) + "\n"


def sources(data: Machines) -> str:
    """Return the table of machines, commits and versions."""
    rows = [
        [name, lines[0]["machine"], lines[0]["commit"], f"{lines[0]['python']}, {lines[0]['warp']}"]
        for name, lines in data.items()
    ]
    return _table(["device", "processor", "commit", "Python, Warp"], rows)


def steps(data: Machines) -> str:
    """Return the table of the steps of scenes, beside the paper's times and its method on the same machine."""
    programs = {}
    for name, lines in data.items():
        times = {line["scene"]: line["seconds"] for line in _cases(lines, "steps")}
        reruns = {line["scene"]: sum(1e-3 * line[f"t{part}_ms"] for part in "ifr") for line in _cases(lines, "paper")}
        programs |= {f"warpmag, {name}": times, f"the paper's method, {name}": reruns}
    programs["the paper, Core i7-8700"] = {scene: 1e-3 * sum(PAPERS_TIMES[scene, "paper"]) for scene in _SCENES}
    rows = [
        [program, *(duration(times[scene]) if scene in times else "" for scene in _SCENES)]
        for program, times in programs.items()
        if times
    ]
    return _table(["program", *_SCENES.values()], rows)


def fields(data: Machines) -> str:
    """Return the tables of the field of all pairs, by warpmag and its peers."""
    text = ""
    for name, lines in data.items():
        compared = sorted(_cases(lines, "compare"), key=lambda line: (line["count"], line["seconds"]))
        rows = [[f"{line['count']:,}", f"`{line['peer']}`", _time([line]), f"{line['error']:.0e}"] for line in compared]
        text += f"\n\n**{name}**" + _table(["balls", "program", "time", "error"], rows)
    return text.replace("\n\n\n", "\n\n")


def multipoles(data: Machines) -> str:
    """Return the tables of sums over many moments."""
    names = {"direct": "all pairs", "fmm": "multipoles", "fmm3d": "FMM3D, float64"}
    text = ""
    for name, lines in data.items():
        rows = []
        for line in _cases(lines, "many"):
            method = names[line["method"]] + (f", {line['rtol']:g}" if line["rtol"] else "")
            quantity = {"field": "field", "wrench": "force, torque"}[line["quantity"]]
            rows.append([f"{line['count']:,}", quantity, method, _time([line]), f"{line['error']:.0e}"])
        text += f"\n\n**{name}**" + _table(["moments", "quantity", "method", "time", "error"], rows)
    return text.replace("\n\n\n", "\n\n")


def worlds(data: Machines) -> str:
    """Return the table of many worlds."""
    rows = [
        [name, f"{line['worlds']:,}", f"{line['count']}", _rate(line)]
        for name, lines in data.items()
        for line in _cases(lines, "worlds")
    ]
    return _table(["device", "worlds", "balls in each", "world steps per second"], rows)


def summary(data: Machines) -> str:
    """Return the five rows of README, of machines with steps."""
    data = {name: lines for name, lines in data.items() if _cases(lines, "steps")}
    rows = [
        [
            "wall time of a time step of 1 ms in the scene Balls Up, 243 balls, without eddy currents",
            *(_time(_cases(x, "steps", scene="balls_up")) for x in data.values()),
        ],
        [
            "wall time of a time step of 1 ms in the scene Sakura Tree, 2,500 balls",
            *(_time(_cases(x, "steps", scene="sakura_tree")) for x in data.values()),
        ],
        ["mutual field of balls, all pairs", *map(_against_peers, data.values())],
        ["field of many moments, error at most 1e-3", *map(_many, data.values())],
        ["solve and forces in many worlds of 64 balls, without rigid-body motion", *map(_many_worlds, data.values())],
    ]
    commits = ", ".join(sorted({lines[0]["commit"] for lines in data.values()}))
    caption = f"*`python -m bench.all`, commit {commits}; [all programs](docs/benchmarks.md).*"
    return _table(["computation", *data], rows) + caption + "\n\n"


def _against_peers(lines: list[dict]) -> str:
    largest = max(line["count"] for line in _cases(lines, "compare"))
    compared = _cases(lines, "compare", count=largest)
    peer = min((line for line in compared if line["peer"] not in _OWN), key=lambda line: line["seconds"])
    own = _cases(compared, "compare", peer="warpmag")
    name = _PEERS.get(peer["peer"], f"`{peer['peer']}`")
    return f"{largest:,} balls: {_time(own)}; fastest other program, {name}: {_time([peer])}"


def _many(lines: list[dict]) -> str:
    own = _cases(lines, "many", method="fmm", quantity="field", rtol=1e-3)
    peer = _cases(lines, "many", method="fmm3d")
    return f"{own[0]['count']:,} moments: {_time(own)}" + (f"; FMM3D: {_time(peer)}" if peer else "")


def _many_worlds(lines: list[dict]) -> str:
    (line,) = _cases(lines, "worlds")
    return f"{line['worlds']:,} worlds: {_rate(line)} steps per second, summed over worlds"


def _rate(line: dict) -> str:
    """World steps per second, two digits."""
    rate = float(f"{line['world_steps_per_second']:.2g}")
    return f"{1e-6 * rate:g} million" if rate >= 1e6 else f"{rate:,.0f}"


def rate_of_worlds(data: Machines) -> str:
    """Return the world steps per second on the GPU."""
    (line,) = _cases(data[_GPU], "worlds")
    return _rate(line)


def largest_field(data: Machines) -> str:
    """Return the largest field of all pairs on the GPU: the number of balls and the time."""
    line = max(_cases(data[_GPU], "compare", peer="warpmag"), key=lambda line: line["count"])
    return f"{line['count']:,} balls in {_time([line])}"


TABLES = {
    table.__name__: table
    for table in (sources, steps, fields, multipoles, worlds, summary, rate_of_worlds, largest_field)
}


def filled(text: str, data: Machines) -> str:
    """Return the text of a page with its tables and quoted figures."""
    return QUOTED.sub(lambda match: match[1] + TABLES[match[2]](data) + match[3], text)


def figures(lines: list[dict]) -> dict:
    """Return the main figures of a machine for the history: times [s] and rates [1/s]."""
    kept = {f"step {line['scene']}": line["seconds"] for line in _cases(lines, "steps")}
    own = _cases(lines, "compare", peer="warpmag")
    kept |= {f"field {line['count']}": line["seconds"] for line in own}
    kept |= {f"multipoles {line['count']}": line["seconds"] for line in _cases(lines, "many", method="fmm")[:1]}
    return kept | {f"worlds of {line['count']}": line["world_steps_per_second"] for line in _cases(lines, "worlds")}


def main() -> None:
    """Write the tables and append new figures to the history."""
    data = machines()
    for page in PAGES:
        page.write_text(filled(page.read_text(encoding="utf-8"), data), encoding="utf-8")
    known = {(line["commit"], line["device"]) for line in read([HISTORY])} if HISTORY.exists() else set()
    with HISTORY.open("a", encoding="utf-8") as file:
        for name, lines in data.items():
            commit = lines[0]["commit"]
            if (commit, name) not in known:
                file.write(json.dumps({"commit": commit, "device": name, **figures(lines)}) + "\n")


if __name__ == "__main__":
    main()
