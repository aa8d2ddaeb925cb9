"""Measures the figures of ``docs/benchmarks.md``: ``python -m bench.all [--device cuda:0] [-o FILE]``.

Parts: steps of the bundled scenes, the field of all pairs beside other libraries, the fast multipole method, many
worlds, and the paper's method on the same machine. Each measurement is one JSON line with machine and commit.
``python -m bench.page`` writes the tables of the page from the lines. All parts take about ten minutes on two cores.
"""

import argparse
from pathlib import Path

import warp as wp

from bench import compare, many
from bench.machine import line_writer
from bench.paper.trials import SCENES, Trial, run_trials
from bench.run import run_worlds
from bench.scene import run_bundled

FIELDS = {"cpu": ("2560", "10000"), "cuda": ("2560", "32768", "131072")}
"""Numbers of balls whose fields on each other are compared with peers."""
MANY = {"cpu": "97336", "cuda": "1000000"}
"""Numbers of moments of the fast multipole method."""
WORLD = 64  # balls of each of many worlds
PAPER_SECONDS = {"cpu": 10.0, "cuda": 4.0}
"""Wall time after which a run by the paper's method ends [s]."""


def steps(device, output: Path) -> None:
    """Measure the mean step of the first second of each scene."""
    write = line_writer(device, output)
    for scene in SCENES:
        write({"case": "steps", "scene": scene, **run_bundled(scene, device)})


def fields(device, output: Path) -> None:
    """Compare the field of all pairs with peers."""
    compare.main(["--device", str(device), "--sizes", *FIELDS[_kind(device)], "--slowest", "5", "-o", str(output)])


def multipoles(device, output: Path) -> None:
    """Measure the fast multipole method, and FMM3D on a CPU."""
    peers = ["--peers", "fmm3d"] if device.is_cpu else []
    many.main(["--device", str(device), "--sizes", MANY[_kind(device)], "--slowest", "20", *peers, "-o", str(output)])


def worlds(device, output: Path) -> None:
    """Measure magnetic steps of many worlds."""
    line_writer(device, output)({"case": "worlds", "count": WORLD, **run_worlds(WORLD, device)})


def paper(device, output: Path) -> None:
    """Measure steps of the paper's method, as ``warpmag run --preset paper``."""
    write, limit = line_writer(device, output), PAPER_SECONDS[_kind(device)]
    for trial, values in run_trials([Trial(scene, "paper", 1.0, str(device), limit, rtol=1e-2) for scene in SCENES]):
        write({"case": "paper", **values, "scene": trial.scene})


def _kind(device) -> str:
    return "cpu" if device.is_cpu else "cuda"


PARTS = {part.__name__: part for part in (steps, fields, multipoles, worlds, paper)}


def main(arguments=None) -> None:
    """Run the parts named on the command line, or all."""
    parser = argparse.ArgumentParser(prog="python -m bench.all", description=__doc__.partition(":")[0])
    parser.add_argument("--device", default="cpu")
    parser.add_argument("--parts", nargs="+", choices=PARTS, default=list(PARTS), help="default: all")
    parser.add_argument("-o", "--output", type=Path, default=Path("bench_out/all.jsonl"), help="file of the lines")
    options = parser.parse_args(arguments)
    wp.config.log_level = wp.LOG_WARNING
    for part in options.parts:
        PARTS[part](wp.get_device(options.device), options.output)


if __name__ == "__main__":
    main()
