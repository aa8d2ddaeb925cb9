"""Team of CPU threads that share the work of a launch.

Warp launches serially on a CPU, and a launch may be part of a graph, which Python's threads cannot run. So native code
shares its work with POSIX threads. They are started once, since starting a thread takes longer than many launches. A
thread polls for work for a while after a launch, as launches follow each other, and then sleeps.

The number of threads of a launch is chosen when the launch is prepared, from the cores that the process may use. It
never changes results: no sum is split or ordered by thread.

A member of the team is a record in memory that all launches share: its state, its job, and its mutex and condition
variable. A launch claims idle members. When the launching thread has finished its part, it takes back the jobs that
have not begun. So it never waits for a thread that does not run, and concurrent launches share the members.
"""

import atexit
import os
import time
from functools import cache

import numpy as np
import warp as wp

from warpmag.kernels.shared.cores import cores
from warpmag.kernels.shared.native import native_kernel

MOST_THREADS = 64  # most threads per launch; as in ``team.h``
MOMENTS_PER_THREAD = 2500
"""Moments per thread, at least, in a pass over moments and their neighbors: 0.1 to 0.2 ms of work."""
_STATE, _WORDS = 0, 24
_GONE, _ASLEEP = 0, 2
"""Index of the state in a member's record, words per record, and two states; as in ``team.h``."""


_start_members = native_kernel(
    "start_members(count, team.data)", "shared/team.h", {"count": int, "team": wp.array2d[wp.uint64]}, dtype=wp.float32
)


def threads_for(count: int, each: int) -> int:
    """Number of threads for ``count`` items of work, with at least ``each`` items per thread."""
    return max(1, min(int(count) // each, cores(), MOST_THREADS))


def team() -> wp.array:
    """Records of the team's members, the argument of ``run_together`` in ``team.h``; one array per process.

    There is a member for each core but the first. If the process gets more cores, more members are started.
    """
    members, started = _members()
    count = min(cores(), MOST_THREADS) - 1
    if count > started[0]:
        wp.launch(_start_members, dim=1, inputs=[count], outputs=[members], device="cpu")
        started[0] = count
    return members


def launch_passes(kernel, first: int, last: int, arrays, *, device, threads: int, gpu_threads: int = 0, **options):
    """Launch passes ``first`` to ``last`` − 1 of a kernel that takes ``native.PASS_ARGUMENTS`` and a struct of arrays.

    One thread of Warp makes them on a CPU, where ``threads`` members of the team share the work. On a GPU there are
    ``gpu_threads``. ``options`` are those of ``wp.launch``.
    """
    cuda = device.is_cuda
    inputs = [first, last, threads, None if cuda else team(), arrays]
    return wp.launch(kernel, dim=gpu_threads if cuda else 1, inputs=inputs, device=device, **options)


@cache
def _members() -> tuple[wp.array, list[int]]:
    """Records of the members, and the number of members that have been started."""
    members = wp.zeros((MOST_THREADS, _WORDS), dtype=wp.uint64, device="cpu")
    atexit.register(_wait_until_asleep, members.numpy())
    if hasattr(os, "register_at_fork"):
        os.register_at_fork(after_in_child=lambda: _forget(members.numpy()))
    return members, [0]


def _wait_until_asleep(members: np.ndarray) -> None:
    """Wait until no member polls for work: its code is unloaded when the process ends."""
    for _ in range(100):
        if np.isin(members[:, _STATE], (_GONE, _ASLEEP)).all():
            return
        time.sleep(1e-3)


def _forget(members: np.ndarray) -> None:
    """Clear the records after a fork: the child process has no members."""
    members[:] = _GONE
    _members.cache_clear()
