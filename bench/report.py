"""Draws results: ``python -m bench.report FILE... [-o bench_out/report]``.

Reads the JSON lines of ``bench.compare`` and ``bench.run``. For each device it draws speed against error at every size,
and the share of the device's limit against the size. It also writes a Markdown table.

The limit is the rate of pairs at 20 operations a pair: a separation, its inverse powers and the sums of a field, if
each pair is evaluated once for each of its ends. A loop that evaluates both ends at once may exceed the limit.
"""

import argparse
import json
from collections import defaultdict
from pathlib import Path

import matplotlib

matplotlib.use("Agg")
import matplotlib.pyplot as plt
from matplotlib.lines import Line2D

OPERATIONS_PER_PAIR = 20  # in the limit


def read(paths) -> list[dict]:
    """All JSON lines of the files."""
    return [json.loads(line) for path in paths for line in Path(path).read_text().splitlines() if line.startswith("{")]


def latest(lines) -> list[dict]:
    """The last line of each measurement: files may contain several runs."""
    keys = ("device", "case", "peer", "dtype", "count")
    return list({tuple(line.get(key) for key in keys): line for line in lines}.values())


def machine_of(line: dict) -> str:
    """Device of a line, or the machine for a CPU."""
    return line["device"] if line["device"] != "cpu" else line["machine"]


def _name_of(line: dict) -> str:
    return line.get("peer") or f"{line['case']} {line['dtype']}"


def draw_pareto(lines, path: Path) -> None:
    """Draw speed against error of every peer, one panel per size."""
    sizes = sorted({line["count"] for line in lines})
    columns = min(4, len(sizes))
    rows = -(-len(sizes) // columns)
    figure, axes = plt.subplots(rows, columns, squeeze=False, sharex=True, sharey=True, layout="constrained")
    figure.set_size_inches(3.4 * columns, 3.2 * rows)
    peers = sorted({line["peer"] for line in lines}, key=lambda name: (name != "warpmag", name))
    colors = dict(zip(peers, matplotlib.color_sequences["tab20"], strict=False))
    for axis in axes.flat[len(sizes) :]:
        axis.set_visible(False)
    for axis, size in zip(axes.flat, sizes, strict=False):
        for line in (line for line in lines if line["count"] == size):
            marker, area = ("*", 160) if line["peer"] == "warpmag" else ("o", 40)
            error, rate = max(line["error"], 1e-16), line["pairs_per_second"]
            axis.scatter(error, rate, area, color=colors[line["peer"]], marker=marker)
        axis.set(xscale="log", yscale="log", title=f"{size:,} dipoles")
        axis.grid(True, alpha=0.3)
    axes[0, 0].invert_xaxis()
    figure.supxlabel("relative error of the field (smaller to the right)")
    figure.supylabel("pairs per second")
    handles = [Line2D([], [], color=colors[p], marker="o", linestyle="", label=p) for p in peers]
    figure.legend(handles=handles, loc="outside right upper")
    figure.suptitle(machine_of(lines[0]))
    figure.savefig(path, dpi=130)
    plt.close(figure)


def limit_of(line: dict) -> float | None:
    """Pairs per second at the limit of the device; None if its clock is unknown."""
    operations = line.get("operations_per_second")
    return operations / OPERATIONS_PER_PAIR if operations else None


def draw_roofline(lines, path: Path) -> None:
    """Draw each peer's share of the limit against the size."""
    figure, axis = plt.subplots(figsize=(7.0, 4.5), layout="constrained")
    series = defaultdict(list)
    for line in lines:
        series[_name_of(line)].append((line["count"], line["pairs_per_second"] / limit_of(line)))
    for name, points in sorted(series.items()):
        axis.plot(*zip(*sorted(points), strict=True), marker="o", label=name, linewidth=3 if name == "warpmag" else 1)
    axis.axhline(1.0, color="black", linewidth=0.8)
    axis.set(xscale="log", yscale="log", xlabel="dipoles", ylabel="share of the limit", title=machine_of(lines[0]))
    axis.grid(True, alpha=0.3)
    axis.legend(fontsize="small")
    figure.savefig(path, dpi=130)
    plt.close(figure)


def table(lines) -> str:
    """A Markdown table of all lines of a device."""
    rows = [
        "| case | n | time | pairs/s | of the limit | error | first call | commit |",
        "|---|---|---|---|---|---|---|---|",
    ]
    for line in sorted(lines, key=lambda line: (line["case"], line["count"], line.get("seconds", float("inf")))):
        head = f"| {_name_of(line)} | {line['count']:,}"
        if "failed" in line:
            rows.append(f"{head} | {line['failed']} | | | | | {line['commit']} |")
            continue
        rate, limit = line.get("pairs_per_second"), limit_of(line)
        share = f"{rate / limit:.1%}" if rate and limit else ""
        rows.append(
            f"{head} | {duration(line['seconds'])} | {f'{rate:.3g}' if rate else ''} | {share} "
            f"| {line['error']:.1e} | {line['first_call_seconds']:.1f} s | {line['commit']} |"
        )
    return "\n".join(rows)


def duration(seconds: float) -> str:
    """A time with a unit that makes it readable."""
    scale, unit = next(((s, u) for s, u in ((1.0, "s"), (1e3, "ms")) if seconds * s >= 1.0), (1e6, "µs"))
    return f"{seconds * scale:.3g} {unit}"


def main(arguments=None) -> None:
    """Write pictures and tables of the files on the command line."""
    parser = argparse.ArgumentParser(prog="python -m bench.report", description=__doc__.partition("\n")[0])
    parser.add_argument("files", nargs="+", type=Path, help="JSON lines of bench.compare or bench.run")
    parser.add_argument("-o", "--output", type=Path, default=Path("bench_out/report"), help="folder (bench_out/report)")
    options = parser.parse_args(arguments)
    options.output.mkdir(parents=True, exist_ok=True)
    machines = defaultdict(list)
    for line in latest(read(options.files)):
        machines[machine_of(line)].append(line)
    sections = []
    for machine, lines in machines.items():
        name = "".join(c if c.isalnum() else "_" for c in machine).strip("_").lower()
        measured = [line for line in lines if "pairs_per_second" in line]
        compared = [line for line in measured if line["case"] == "compare"]
        if compared:
            draw_pareto(compared, options.output / f"{name}_pareto.png")
        limited = [line for line in measured if limit_of(line)]
        if limited:
            draw_roofline(limited, options.output / f"{name}_roofline.png")
        sections.append(f"## {machine}\n\n{table(lines)}\n")
    (options.output / "report.md").write_text("\n".join(sections))
    print(f"wrote {options.output}")


if __name__ == "__main__":
    main()
