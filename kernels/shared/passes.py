"""How arrays of passes over balls are laid out; ``lanes.h`` and ``vectors.h`` have the vectors that read them.

A pass is written once for both devices: on a CPU it works on a vector of balls, on a GPU a group of threads shares one.
Arrays have ``CHUNK`` balls along their last axis, and what a ball reads of others stands in a cache line for each, of
``LINE`` numbers: on a CPU lines are transposed into vectors in registers, which is faster than to gather numbers.
"""

import warp as wp

CHUNK = 16
"""Multiple that the number of balls is padded to, the lanes of the widest vectors; as in ``lanes.h``."""
LINE = 16
"""Numbers in a ball's cache line; as in ``lanes.h``."""


def passes_kernel(call: str, arrays_type, options: dict):
    """Kernel (first, last, threads, team, arrays) that makes passes ``first`` to ``last`` over balls.

    Args:
        call: Call of a C++ function with these arguments and ``thread``, the thread of a GPU.
        arrays_type: Warp struct of what the passes work on.
        options: What ``native.native_options`` returns for its header.
    """

    @wp.func_native(call)
    def run(thread: int, first: int, last: int, threads: int, team: wp.array2d[wp.uint64], arrays: arrays_type): ...

    @wp.kernel(module="unique", enable_backward=False, module_options=options)
    def passes(first: int, last: int, threads: int, team: wp.array2d[wp.uint64], arrays: arrays_type):
        run(wp.tid(), first, last, threads, team, arrays)

    return passes
