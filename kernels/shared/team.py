"""Threads of a CPU that help with the work of a launch.

Warp launches serially on a CPU, and a launch may sit inside a graph, where Python's threads cannot help. So native code
shares its work with threads of the process's own library. They are started once, since to start one takes longer than
many a launch. One that has helped looks for more to do for a while, as launches follow each other, and then sleeps.

How many threads work on something is decided when its launch is prepared, by the cores that this process may use then;
it never shows in results, since no sum is cut or ordered by it.

A member of the team is some memory that all launches share: its state, what it is to do, and what it sleeps with. A
launch claims members that have nothing to do, and takes back what they have not begun when it is done itself. So it
never waits for a thread that does not come, and several that run at once share the members.
"""

import atexit
import os
import time
from functools import cache

import numpy as np
import warp as wp

from warpmag.kernels.shared.cores import cores
from warpmag.kernels.shared.native import native_kernel

MOST_THREADS = 64
"""Threads that may work on one launch."""
MOMENTS_PER_THREAD = 2500
"""Moments that make another thread worth waking for a pass over them and their neighbours: 0.1 to 0.2 ms."""
_STATE, _WORDS = 0, 24
_GONE, _ASLEEP = 0, 2
"""Place of a member's state among its words, how many these are, and two of its values; as in ``team.h``."""


_start_members = native_kernel(
    "start_members(count, team.data)",
    "shared/team.h",
    {"count": int, "team": wp.array2d[wp.uint64]},
    dtype=wp.float32,
)


def threads_for(count: int, each: int) -> int:
    """Threads that share ``count`` pieces of work, ``each`` of which make another one worth waking."""
    return max(1, min(int(count) // each, cores(), MOST_THREADS))


def team() -> wp.array:
    """The members' memory, one for the process; what ``run_together`` of ``team.h`` takes.

    There are as many as other cores; should this process be given more, members join.
    """
    members, started = _members()
    wanted = min(cores(), MOST_THREADS) - 1
    if wanted > started[0]:
        wp.launch(_start_members, dim=1, inputs=[wanted], outputs=[members], device="cpu")
        started[0] = wanted
    return members


@cache
def _members() -> tuple[wp.array, list[int]]:
    """Memory of the members, and how many have been started."""
    members = wp.zeros((MOST_THREADS, _WORDS), dtype=wp.uint64, device="cpu")
    atexit.register(_wait_until_asleep, members.numpy())
    if hasattr(os, "register_at_fork"):
        os.register_at_fork(after_in_child=lambda: _forget(members.numpy()))
    return members, [0]


def _wait_until_asleep(members: np.ndarray) -> None:
    """Wait for members that look for work: the code that they run goes when the process ends."""
    for _ in range(100):
        if np.isin(members[:, _STATE], (_GONE, _ASLEEP)).all():
            return
        time.sleep(1e-3)


def _forget(members: np.ndarray) -> None:
    """Do without the members, which a process that was forked has not."""
    members[:] = _GONE
    _members.cache_clear()
