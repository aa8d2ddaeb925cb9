"""Python's threads, forks and signals while the threads of a CPU work: ``python tests/stress_threads.py [rounds]``.

Each round forks a child while members of the team still poll for work. Then three threads and the child evaluate
fields and solve at once, and a timer interrupts the process every millisecond. Everything has to give the bits that it
gave alone. Prints how many rounds did.

The fork comes before the threads: a lock that another thread holds during a fork stays locked in the child, and Warp's
``Module.load`` and Python 3.11's ``cached_property`` have such locks.
"""

import os
import signal
import sys
import threading

import numpy as np
import warp as wp

import warpmag
from warpmag.kernels.shared import team

_PATIENCE = 60.0
"""Time that a round may take before it counts as hung [s]."""


def work(x, m) -> bytes:
    """Bits of a field and of a solve that several threads share."""
    h = warpmag.h_field(x, m, device="cpu")
    solved = warpmag.solve_induction(x, 0.005, saturation=1.7e6, external_field=(0.0, 0.0, 1e5), device="cpu")
    return h.tobytes() + solved.magnetizations.tobytes()


def run_round(x, m, expected: bytes) -> bool:
    """Whether all that ran at once gave the expected bits."""
    child = os.fork()
    if child == 0:
        signal.signal(signal.SIGALRM, signal.SIG_DFL)  # ends a child that hangs
        signal.alarm(int(_PATIENCE))
        os._exit(0 if work(x, m) == expected else 1)
    same = []
    threads = [threading.Thread(target=lambda: same.append(work(x, m) == expected), daemon=True) for _ in range(3)]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join(_PATIENCE)
    return len(same) == len(threads) and all(same) and os.waitpid(child, 0)[1] == 0


def main(rounds: int) -> None:
    """Run rounds and print how many were right."""
    wp.config.log_level = wp.LOG_ERROR
    wp.config.enable_backward = False
    team.cores = lambda: 8
    rng = np.random.default_rng(0)
    x = 0.01 * np.stack(np.meshgrid(*[np.arange(11.0)] * 3, indexing="ij"), -1).reshape(-1, 3)
    m = rng.normal(size=x.shape)
    expected = work(x, m)
    ticks = []
    signal.signal(signal.SIGALRM, lambda *_: ticks.append(1))
    signal.setitimer(signal.ITIMER_REAL, 1e-3, 1e-3)
    right = sum(run_round(x, m, expected) for _ in range(rounds))
    signal.setitimer(signal.ITIMER_REAL, 0.0)
    print(f"{right} of {rounds} rounds right, {len(ticks)} signals")
    sys.exit(right != rounds or not ticks)


if __name__ == "__main__":
    main(int(sys.argv[1]) if len(sys.argv) > 1 else 85)
