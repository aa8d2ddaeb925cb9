"""``python -m tests.fuzz.calls``: wild calls of every documented function and of its results' methods.

    python -m tests.fuzz.calls --count 2000 --seed 7           so many calls of each function
    python -m tests.fuzz.calls --count 100 --only apply        of functions with ``apply`` in their names

Each call has one to three wild arguments among right ones: numbers, texts, arrays of other sizes, types and memory,
states and models of other worlds. It must end in an ``InputError`` of one line or in finite results. The calls run in
child processes, so that a crash counts; it ends the child, and the next one goes on behind the call that did it.
Simulations and displays take seconds to build. A child process builds them again only after a call that was not
refused.
``warpmag.torch`` and ``warpmag.jax`` are called where their libraries are installed.
"""

import argparse
import multiprocessing
import sys
from functools import partial

from .caller import Outcome
from .children import outcomes
from .functions import targets
from .worlds import KINDS, new_world


def main() -> int:
    """Make calls of all functions, and print a line about each function and each problem."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--count", type=int, default=200, help="calls of each function (default: %(default)s)")
    parser.add_argument("--seed", type=int, default=0, help="which calls (default: %(default)s)")
    parser.add_argument("--only", default="", help="part of the names of the functions, between dots for a whole one")
    parser.add_argument("--without", default="-", help="part of the names of functions that are left out")
    parser.add_argument("--workers", type=int, default=1, help="functions at a time (default: %(default)s)")
    options = parser.parse_args()
    for kind in KINDS:  # kernels are compiled before the first fork
        new_world(kind=kind)
    names = [name for name in targets() if options.only in f".{name}." and options.without not in f".{name}."]
    calls = partial(_all_outcomes, seed=options.seed, count=options.count)
    total = 0
    with multiprocessing.get_context("fork").Pool(options.workers) as pool:
        for name, results in pool.imap_unordered(calls, names):
            bad = [outcome for outcome in results if outcome.problem]
            total += len(bad)
            taken = sum(outcome.taken for outcome in results)
            print(f"{name:36} {len(results):6} calls {taken:6} taken {len(bad):6} problems", flush=True)
            for outcome in bad[:5]:
                print(f"    {outcome.number}: {outcome.call[:300]}\n        {outcome.problem}", flush=True)
    print(f"{len(names)} functions, {total} problems")
    return 1 if total else 0


def _all_outcomes(name: str, seed: int, count: int) -> tuple[str, list[Outcome]]:
    """Return the name of a function and :func:`outcomes` of its first ``count`` calls."""
    return name, list(outcomes(name, seed, list(range(count))))


if __name__ == "__main__":
    sys.exit(main())
