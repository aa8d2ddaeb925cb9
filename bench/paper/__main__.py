"""Command line of the paper's experiments."""

import argparse
import sys
from importlib import import_module
from pathlib import Path

import warp as wp

from bench.paper.output import ORDER, Output
from warpmag.errors import InputError


def main(arguments: list[str] | None = None) -> int:
    """Run experiments and return the exit code."""
    parser = argparse.ArgumentParser(prog="python -m bench.paper", description="Repeat the paper's experiments.")
    parser.add_argument("experiment", choices=(*ORDER, "all"))
    parser.add_argument("--device", help="Warp device, cpu or cuda:0 (default: the first GPU, else cpu)")
    parser.add_argument("--small", action="store_true", help="coarser grids and fewer repetitions, for CI")
    parser.add_argument("-o", "--output", type=Path, default=Path("bench_out/paper"), metavar="DIR")
    options = parser.parse_args(arguments)

    import matplotlib  # noqa: PLC0415 - slow to import, and --help goes without it

    from warpmag.moments.arrays import resolve_device  # noqa: PLC0415

    matplotlib.use("Agg")
    wp.config.log_level = wp.LOG_WARNING
    try:
        device = str(resolve_device(options.device))
    except InputError as error:
        parser.error(str(error))
    options.output.mkdir(parents=True, exist_ok=True)
    for name in ORDER if options.experiment == "all" else (options.experiment,):
        import_module(f"bench.paper.{name}").run(Output(name, options.output, device, options.small))
    print(f"report: {options.output / 'report.md'}")
    return 0


if __name__ == "__main__":
    sys.exit(main())
