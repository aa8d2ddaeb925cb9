"""What sharing out brings: sums of one GPU beside those of several, ``mpirun -n 2 python -m bench.ranks``.

Each rank sums all by itself first, then what is its part, of the moments of :mod:`bench.many`; times are those of the
slowest rank, captured in a graph. The results of both must have the same bits. One JSON line a measurement.
"""

import argparse
import json
from contextlib import nullcontext

import numpy as np
import warp as wp

from bench.machine import describe
from bench.many import Moments, lattice, repetitions
from bench.timing import measure
from warpmag.kernels.pairs.pair_terms import Quantity
from warpmag.moments.arrays import resolve_device
from warpmag.moments.ranks import Ranks, current_ranks, is_first_rank, without_ranks

CASES = ((131_072, None), (1_000_000, None), (1_000_000, 1e-3), (4_019_679, 1e-3), (4_019_679, 1e-5))
"""Numbers of moments, and relative errors asked for; None means all pairs."""


def run_case(count: int, quantity: Quantity, rtol: float | None, all_ranks: Ranks, device) -> dict:
    """Measure the sums of one rank and those of all; ``cells_seconds`` of both are for the cells, which all make."""
    own = Moments(*lattice(count), wp.float32, device)
    found = []
    for sharing in (without_ranks(), nullcontext()):
        with sharing:
            build, evaluate = own.parts(quantity, rtol)
        build()
        evaluate()
        result = own.out.numpy()
        seconds = [measure(part, device, **repetitions(count)) for part in (build, evaluate)]
        found.append((result, np.max(all_ranks.exchange(seconds), axis=0)))
    (one, (cells, seconds_of_one)), (shared, (_, seconds)) = found
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
        "same_bits": all(all_ranks.exchange(one.tobytes() == shared.tobytes())),
    }


def main() -> None:
    """Measure on the GPU of each rank; the first one prints."""
    parser = argparse.ArgumentParser(prog="mpirun -n 2 python -m bench.ranks", description=__doc__.partition("\n")[0])
    parser.parse_args()
    wp.config.log_level = wp.LOG_WARNING
    all_ranks, device = current_ranks(), resolve_device(None)
    if all_ranks is None or not device.is_cuda:
        parser.error("to be started by mpirun, with a GPU for each rank")
    machine = describe(device)
    for count, rtol in CASES:
        for quantity in (Quantity.FIELD, Quantity.WRENCH):
            line = run_case(count, quantity, rtol, all_ranks, device)
            if is_first_rank(all_ranks):
                print(json.dumps({"case": "ranks"} | line | machine), flush=True)


if __name__ == "__main__":
    main()
