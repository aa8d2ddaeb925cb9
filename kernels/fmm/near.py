"""Near-field sums: field (Eq. 1) and force (Eqs. 4, 13, 14) over pairs of moments in neighboring leaves.

They are the sums of ``pairs/evaluate.py`` restricted to near pairs: dipoles clamped at contact, as partial sums.
``finish.h`` then adds the corrections of overlapping pairs.
"""

from functools import cache

import warp as wp

from warpmag.kernels.pairs.pair_law import Quantity
from warpmag.kernels.pairs.work_list import tile_size
from warpmag.kernels.shared.native import PASS_ARGUMENTS, native_kernel
from warpmag.kernels.shared.team import launch_passes, threads_for

_LEAVES_PER_THREAD = 16  # leaves per thread of a CPU, at least
_WARPS = 4  # warps of a block; each warp sums one leaf
_TARGETS_PER_LANE = 4  # most targets of a lane, 2 or 4
_BLOCKS = {
    2: {Quantity.FIELD: 6, Quantity.FORCE: 5, Quantity.WRENCH: 4},
    4: {Quantity.FIELD: 4, Quantity.FORCE: 3, Quantity.WRENCH: 2},
}
"""Blocks per multiprocessor in float32, by targets per lane and quantity."""


@cache
def _arrays_type(dtype):
    @wp.struct
    class NearArrays:
        # Moments in, sorted by leaf:
        moments: wp.array2d[dtype]
        effective: wp.array2d[dtype]
        # Leaves in:
        neighbors: wp.array2d[int]
        moment_begin: wp.array[int]
        leaves: wp.array[int]
        # Sums out:
        sums: wp.array2d[dtype]

    return NearArrays


def launch_near_sums(quantity: Quantity, moments, effective, neighbors, moment_begin, leaves, sums):
    """Launch the sums of a quantity over all pairs in neighboring leaves.

    Forces are fastest where the labels in a leaf are close to each other. Single balls are best labeled by column.

    Args:
        quantity: ``FIELD``, ``FORCE`` or ``WRENCH``.
        moments: Packed moments in the octree's order, shape [8, n], with the pitch of ``packing``.
        effective: Effective moments e [A·m²] of the force, in the same order, shape [3, n].
        neighbors, moment_begin: Leaves, as in ``octree``.
        leaves: Range of leaves whose moments are targets, shape [2].
        sums: Out: 4π times force sum and field of each sorted moment, shape [n, 3 or 6].
    """
    a = _arrays_type(sums.dtype)()
    a.moments, a.effective, a.neighbors = moments, effective, neighbors
    a.moment_begin, a.leaves, a.sums = moment_begin, leaves, sums
    device, capacity = sums.device, moment_begin.shape[0] - 1
    if device.is_cuda:
        block = 32 * _WARPS
        dim = -(-capacity // _WARPS) * block
        wp.launch(_cuda_kernel(sums.dtype, quantity), dim=dim, inputs=[a], device=device, block_dim=block)
        return
    threads = threads_for(capacity, _LEAVES_PER_THREAD)
    launch_passes(_cpu_kernel(sums.dtype, quantity), 0, 1, a, device=device, threads=threads)


@cache
def _cpu_kernel(dtype, quantity: Quantity):
    call = f"cpu::sum_near<warpmag::Quantity({quantity:d})>(arrays, threads, team.data)"
    arguments = {**PASS_ARGUMENTS, "arrays": _arrays_type(dtype)}
    return native_kernel(call, "fmm/near.h", arguments, dtype=dtype, TILE_SIZE=tile_size(dtype))


@cache
def _cuda_kernel(dtype, quantity: Quantity):
    call = f"sum_leaf<warpmag::Quantity({quantity:d}), {_WARPS}>(thread, arrays)"
    blocks = _BLOCKS[_TARGETS_PER_LANE][quantity] if dtype is wp.float32 else 1
    launch = {"grid_stride": False, "launch_bounds": (32 * _WARPS, blocks)}
    constants = {"TARGETS_PER_LANE": _TARGETS_PER_LANE}
    return native_kernel(call, "fmm/near.h", {"arrays": _arrays_type(dtype)}, dtype=dtype, launch=launch, **constants)
