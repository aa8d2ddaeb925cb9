"""Compares sums on one GPU with sums shared among several: ``mpirun -n 2 python -m bench.ranks``.

Each rank sums all moments of :mod:`bench.many` by itself, then its share of them. Times are those of the slowest rank,
captured in a graph. Both results must be bitwise identical. Each measurement is one JSON line.
"""

import argparse
from contextlib import nullcontext

import numpy as np
import warp as wp

from bench.machine import line_writer
from bench.many import Moments, lattice, repetitions
from bench.timing import measure
from warpmag.kernels.pairs.pair_law import Quantity
from warpmag.moments.arrays import resolve_device
from warpmag.moments.ranks import Ranks, current_ranks, is_first_rank, without_ranks

CASES = ((131_072, None), (1_000_000, None), (1_000_000, 1e-3), (4_019_679, 1e-3), (4_019_679, 1e-5))
"""Numbers of moments, and requested relative errors; None means all pairs."""


def run_case(count: int, quantity: Quantity, rtol: float | None, all_ranks: Ranks, device) -> dict:
    """Measure the sums of one rank and of all ranks; ``cells_seconds`` is the time to build the cells on every rank."""
    moments = Moments(*lattice(count), wp.float32, device)
    results = []
    for sharing in (without_ranks(), nullcontext()):
        with sharing:
            build, evaluate = moments.parts(quantity, rtol)
        build()
        evaluate()
        result = moments.out.numpy()
        seconds = [measure(part, device, **repetitions(count)) for part in (build, evaluate)]
        results.append((result, np.max(all_ranks.exchange(seconds), axis=0)))
    (single, (cells, seconds_of_one)), (shared, (_, seconds)) = results
    return {
        "quantity": quantity.name.lower(),
        "method": "direct" if rtol is None else "fmm",
        "rtol": rtol,
        "count": count,
        "ranks": all_ranks.size,
        "cells_seconds": float(cells),
        "seconds_of_one": float(seconds_of_one),
        "seconds": float(seconds),
        "ratio": float(seconds_of_one / seconds),
        "ratio_with_cells": float((cells + seconds_of_one) / (cells + seconds)),
        "same_bits": all(all_ranks.exchange(single.tobytes() == shared.tobytes())),
    }


def main() -> None:
    """Measure on the GPU of each rank; the first rank prints."""
    parser = argparse.ArgumentParser(prog="mpirun -n 2 python -m bench.ranks", description=__doc__.partition("\n")[0])
    parser.parse_args()
    wp.config.log_level = wp.LOG_WARNING
    all_ranks, device = current_ranks(), resolve_device(None)
    if all_ranks is None or not device.is_cuda:
        parser.error("start it by mpirun, with a GPU for each rank")
    write = line_writer(device)
    for count, rtol in CASES:
        for quantity in (Quantity.FIELD, Quantity.WRENCH):
            line = run_case(count, quantity, rtol, all_ranks, device)
            if is_first_rank(all_ranks):
                write({"case": "ranks"} | line)


if __name__ == "__main__":
    main()
