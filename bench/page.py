"""Writes the tables of ``docs/benchmarks.md`` and of README: ``python -m bench.page``.

The figures are those of ``docs/benchmarks/*.jsonl``, lines of ``python -m bench.all``, a file for each machine. Tables
stand between comments such as ``<!-- benchmark: steps -->`` and ``<!-- benchmark end -->``. The main figures of each
machine and commit are also kept in ``docs/benchmarks/history.jsonl``.
"""

import json
import re
from pathlib import Path

from bench.paper.table1 import PAPERS_TIMES
from bench.report import duration, machine_of, read

ROOT = Path(__file__).parents[1]
PAGES = (ROOT / "README.md", ROOT / "docs" / "benchmarks.md")
DATA = ROOT / "docs" / "benchmarks"
HISTORY = DATA / "history.jsonl"
_TABLE = re.compile(r"(<!-- benchmark: (\w+) -->\n).*?(<!-- benchmark end -->)", re.DOTALL)
_SCENES = {
    "balls_up": "Balls Up, 243 balls",
    "alphabets": "Alphabets, 100 letters",
    "falling_magnet": "Falling Magnet, 1,033 bodies",
    "sakura_tree": "Sakura Tree, 2,500 balls",
}
_OWN = ("warpmag", "h_field")  # names of warpmag among the peers

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
    return "\n" + "".join(f"| {' | '.join(row)} |\n" for row in lines) + "\n"


def sources(data: Machines) -> str:
    """Return the table of machines, commits and versions."""
    rows = [
        [name, lines[0]["machine"], lines[0]["commit"], f"{lines[0]['python']}, {lines[0]['warp']}"]
        for name, lines in data.items()
    ]
    return _table(["device", "processor", "commit", "Python, Warp"], rows)


def steps(data: Machines) -> str:
    """Return the table of the steps of scenes, beside the paper's times and its method on the same machine."""
    rows = []
    data = {name: lines for name, lines in data.items() if _cases(lines, "steps")}
    for scene, title in _SCENES.items():
        row = [title]
        for lines in data.values():
            rerun = _cases(lines, "paper", scene=scene)
            rerun_time = sum(rerun[0][f"t{part}_ms"] for part in "ifr") if rerun else 0.0
            row += [_time(_cases(lines, "steps", scene=scene)), duration(1e-3 * rerun_time) if rerun else ""]
        rows.append([*row, f"{sum(PAPERS_TIMES[scene, 'paper']):.3g} ms"])
    head = [text for name in data for text in (name, "the paper's method on it")]
    return _table(["scene", *head, "paper, Core i7-8700"], rows)


def fields(data: Machines) -> str:
    """Return the tables of the field of all pairs, by warpmag and its peers."""
    text = ""
    for name, lines in data.items():
        compared = sorted(_cases(lines, "compare"), key=lambda line: (line["count"], line["seconds"]))
        rows = [[f"{line['count']:,}", f"`{line['peer']}`", _time([line]), f"{line['error']:.0e}"] for line in compared]
        text += f"\n**{name}**\n" + _table(["balls", "program", "time", "error"], rows)
    return text


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
        text += f"\n**{name}**\n" + _table(["moments", "quantity", "method", "time", "error"], rows)
    return text


def worlds(data: Machines) -> str:
    """Return the table of many worlds."""
    rows = [
        [name, f"{line['worlds']:,}", f"{line['count']}", f"{line['world_steps_per_second']:.2g}"]
        for name, lines in data.items()
        for line in _cases(lines, "worlds")
    ]
    return _table(["device", "worlds", "balls in each", "steps of worlds per second"], rows)


def summary(data: Machines) -> str:
    """Return the five rows of README."""
    rows = [
        ["step of 1 ms of Balls Up, 243 balls", *(_time(_cases(x, "steps", scene="balls_up")) for x in data.values())],
        ["step of Sakura Tree, 2,500 balls", *(_time(_cases(x, "steps", scene="sakura_tree")) for x in data.values())],
        ["field of balls on each other", *map(_against_peers, data.values())],
        ["field of many moments, error at most 1e-3", *map(_many, data.values())],
        ["64 balls in many worlds", *map(_rate, data.values())],
    ]
    commits = ", ".join(sorted({lines[0]["commit"] for lines in data.values()}))
    return _table(["", *data], rows) + f"*`python -m bench.all`, commit {commits}.*\n"


def _against_peers(lines: list[dict]) -> str:
    largest = max(line["count"] for line in _cases(lines, "compare"))
    compared = _cases(lines, "compare", count=largest)
    peer = min((line for line in compared if line["peer"] not in _OWN), key=lambda line: line["seconds"])
    own = _cases(compared, "compare", peer="warpmag")
    return f"{largest:,}: {_time(own)}; {peer['peer']} {_time([peer])}"


def _many(lines: list[dict]) -> str:
    own = _cases(lines, "many", method="fmm", quantity="field", rtol=1e-3)
    peer = _cases(lines, "many", method="fmm3d")
    return f"{own[0]['count']:,}: {_time(own)}" + (f"; FMM3D {_time(peer)}" if peer else "")


def _rate(lines: list[dict]) -> str:
    (line,) = _cases(lines, "worlds")
    return f"{line['worlds']:,} worlds, {line['world_steps_per_second']:.2g} steps of worlds per second"


TABLES = {table.__name__: table for table in (sources, steps, fields, multipoles, worlds, summary)}


def filled(text: str, data: Machines) -> str:
    """Return the text of a page with its tables."""
    return _TABLE.sub(lambda match: match[1] + TABLES[match[2]](data) + match[3], text)


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
