"""Numbers of threads that share work, sums over them in a fixed order, largest values in blocks, and memory fences."""

from functools import cache
from typing import Any

import warp as wp

_GROUP_THREADS = 8  # threads of a GPU that share the neighbors of a moment; a power of two, at most a warp
_FEW_THREADS, _MANY_MOMENTS = 2, 50_000
"""Threads of a GPU per moment if the moments alone fill the GPU, and the smallest number of such moments. With few
threads per moment, reads of neighboring entries coalesce, and fewer threads wait."""
_WARP = 32  # threads of a warp, which share the thousands of neighbors of a large cell among small ones

_BLOCKS = 16  # per multiprocessor of a GPU, in launches over lists


def group_threads(device, *, moments: int = 0, long_lists: bool = False) -> int:
    """Return the number of threads that share the neighbors of a moment.

    It is 1 on a CPU. On a GPU it is 32 for long lists, 2 if a pass has 50,000 ``moments`` or more, and 8 otherwise.
    """
    if not device.is_cuda:
        return 1
    return _WARP if long_lists else _FEW_THREADS if moments >= _MANY_MOMENTS else _GROUP_THREADS


def most_blocks(device) -> int:
    """Most blocks of a launch over a list whose length is known to the device alone; threads repeat beyond them."""
    return _BLOCKS * device.sm_count if device.is_cuda else 0


@cache
def group_sum(vector):
    """Warp function (value, width) that returns the sum of a vector over groups of ``width`` = 2ᵏ threads of a warp."""

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
def block_max(value: Any):
    """Largest value among the threads of a block."""
    return wp.tile_extract(wp.tile_max(wp.tile(value)), 0)


@wp.func_native("""
#if defined(__CUDA_ARCH__)
    __threadfence();
#endif
""")
def fence():
    """Make earlier writes of a thread visible to other blocks before its later writes."""
