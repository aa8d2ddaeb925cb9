"""Sums over the pairs of moments in cells that are neighbours: field (Eq. 1), and force (Eqs. 4, 13, 14).

They are those of ``pairs/evaluate.py`` without the pairs that are far apart: of dipoles clamped at contact, as partial
sums, to which ``finish.h`` adds what overlapping pairs lack.
"""

from functools import cache

import warp as wp

from warpmag.kernels.pairs.pair_terms import Quantity
from warpmag.kernels.pairs.work_list import tile_size
from warpmag.kernels.shared.native import native_options
from warpmag.kernels.shared.passes import passes_kernel
from warpmag.kernels.shared.team import team, threads_for

_LEAVES_PER_THREAD = 16
"""Leaves that make another thread worth waking."""
_WARPS = 4
"""Warps of a block, each of which sums a leaf."""
MOST_HELD = 4
"""Most targets of a lane, 2 or 4."""
_BLOCKS = {
    2: {Quantity.FIELD: 6, Quantity.FORCE: 5, Quantity.WRENCH: 4},
    4: {Quantity.FIELD: 4, Quantity.FORCE: 3, Quantity.WRENCH: 2},
}
"""Blocks that a multiprocessor holds together then, in float32."""


@cache
def near_arrays(dtype):
    """Struct of what the sums work on."""

    @wp.struct
    class NearArrays:
        moments: wp.array2d[dtype]
        effective: wp.array2d[dtype]
        neighbors: wp.array2d[int]
        moment_begin: wp.array[int]
        leaves: wp.array[int]
        sums: wp.array2d[dtype]

    return NearArrays


def launch_near_sums(quantity: Quantity, moments, effective, neighbors, moment_begin, leaves, sums):
    """Sum a quantity over the pairs in leaves that are neighbours.

    Labels of moments of a leaf that are near each other make forces fast: those of single balls are best their columns.

    Args:
        quantity: ``FIELD``, ``FORCE`` or ``WRENCH``.
        moments: Packed moments sorted by leaf, leaves x fastest, then y, z and world, shape [8, n], with the pitch of
            ``packing``.
        effective: Effective moments e [A·m²] of the force, sorted likewise, shape [3, n].
        neighbors: Leaf at each offset x + 3 y + 9 z, itself in the middle, −1 for none, shape [cells, 27].
        moment_begin: First column of each leaf, and the end after the last, shape [cells + 1] or more.
        leaves: First leaf whose moments are targets, and the end after the last.
        sums: Out, a row for each sorted moment: 4π times the force sum and the field, shape [n, 3 or 6].
    """
    a = near_arrays(sums.dtype)()
    a.moments, a.effective, a.neighbors = moments, effective, neighbors
    a.moment_begin, a.leaves, a.sums = moment_begin, leaves, sums
    device, most = sums.device, moment_begin.shape[0] - 1
    if device.is_cuda:
        block = 32 * _WARPS
        dim = -(-most // _WARPS) * block
        wp.launch(_cuda_kernel(sums.dtype, quantity, MOST_HELD), dim=dim, inputs=[a], device=device, block_dim=block)
        return
    threads = threads_for(most, _LEAVES_PER_THREAD)
    wp.launch(_cpu_kernel(sums.dtype, quantity), dim=1, inputs=[0, 1, threads, team(), a], device=device)


@cache
def _cpu_kernel(dtype, quantity: Quantity):
    return passes_kernel(
        f"warpmag::cpu::sum_near<warpmag::Quantity({quantity:d})>(arrays, threads, team.data);",
        near_arrays(dtype),
        native_options("fmm/near_cpu.h", dtype=dtype, TILE_SIZE=tile_size(dtype)),
    )


@cache
def _cuda_kernel(dtype, quantity: Quantity, most_held: int):
    arrays_struct = near_arrays(dtype)

    @wp.func_native(f"warpmag::sum_leaf<warpmag::Quantity({quantity:d}), {_WARPS}>(thread, arrays);")
    def run(thread: int, arrays: arrays_struct): ...

    @wp.kernel(
        module="unique",
        enable_backward=False,
        grid_stride=False,
        launch_bounds=(32 * _WARPS, _BLOCKS[most_held][quantity] if dtype is wp.float32 else 1),
        module_options=native_options("fmm/near_cuda.h", dtype=dtype, MOST_HELD=most_held),
    )
    def near_sums_cuda(arrays: arrays_struct):
        run(wp.tid(), arrays)

    return near_sums_cuda
