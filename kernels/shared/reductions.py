"""Sums over groups of threads of a warp and over blocks, in a fixed order."""

from functools import cache
from typing import Any

import warp as wp

_GROUP_THREADS = 8
"""Threads of a GPU that share out the neighbours of a moment; a part of a warp."""


def group_threads(device) -> int:
    """Threads that share out the neighbours of a moment; each takes every so many of them."""
    return _GROUP_THREADS if device.is_cuda else 1


@cache
def group_sum(vector):
    """Warp function that adds up a vector over groups of 2ᵏ threads of a warp, for each of them."""

    @wp.func_native(f"""
    auto total = value;
    #if defined(__CUDA_ARCH__)
    const unsigned group = (width == 32 ? ~0u : (1u << width) - 1u) << (threadIdx.x & (32 - width));
    for (int step = width / 2; step > 0; step /= 2)
        for (int c = 0; c < {vector._length_}; ++c) total[c] += __shfl_xor_sync(group, total[c], step);
    #endif
    return total;
    """)
    def sum_group(value: vector, width: int) -> vector: ...

    return sum_group


@wp.func
def block_sum(mine: Any):
    """Sum of a value over the threads of a block, in a fixed order; the same for all of them."""
    return wp.tile_extract(wp.tile_sum(wp.tile(mine, preserve_type=True)), 0)


@wp.func
def block_max(mine: Any):
    """Largest value of the threads of a block."""
    return wp.tile_extract(wp.tile_max(wp.tile(mine)), 0)


@wp.func_native("""
#if defined(__CUDA_ARCH__)
    __threadfence();
#endif
""")
def fence():
    """Let what a thread has written be seen by other blocks before what it writes next."""
    ...
