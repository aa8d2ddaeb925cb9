"""All-pairs sums on a CPU: the kernel that calls ``sums_cpu.h``."""

from functools import cache

import warp as wp

from warpmag.kernels.pairs.pair_terms import Quantity
from warpmag.kernels.shared.native import native_options
from warpmag.kernels.shared.team import team

TILE_SIZE = 512
"""Most sources, and most targets, of a tile."""


@cache
def _kernel(dtype, quantity: Quantity):
    @wp.func_native(
        f"warpmag::cpu::sum_tiles<warpmag::Quantity({quantity:d})>"
        "(targets, sources, effective, tiles, shares, threads, team.data, partial_out);"
    )
    def sum_tiles(
        targets: wp.array2d[dtype],
        sources: wp.array2d[dtype],
        effective: wp.array2d[dtype],
        tiles: wp.array2d[int],
        shares: wp.array[int],
        threads: int,
        team: wp.array2d[wp.uint64],
        partial_out: wp.array3d[dtype],
    ): ...

    options = native_options("pairs/sums_cpu.h", dtype=dtype, TILE_SIZE=TILE_SIZE)

    @wp.kernel(module="unique", enable_backward=False, module_options=options)
    def pair_loop_cpu(
        # inputs:
        targets: wp.array2d[dtype],
        sources: wp.array2d[dtype],
        effective: wp.array2d[dtype],
        tiles: wp.array2d[int],
        shares: wp.array[int],
        threads: int,
        team: wp.array2d[wp.uint64],
        # outputs:
        partial_out: wp.array3d[dtype],
    ):
        sum_tiles(targets, sources, effective, tiles, shares, threads, team, partial_out)

    return pair_loop_cpu


def launch_pair_loop_cpu(quantity: Quantity, targets, sources, effective, tiles, shares, threads, partial):
    """Sum a quantity over all tiles; see ``evaluate``."""
    wp.launch(
        _kernel(partial.dtype, quantity),
        dim=1,
        inputs=[targets, sources, effective, tiles, shares, threads, team()],
        outputs=[partial],
        device=partial.device,
    )
