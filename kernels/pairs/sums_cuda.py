"""The native pair loop on a GPU: a block of warps holds a tile of targets in registers and walks its sources.

Each lane of a warp holds the tile's targets ``lane``, ``lane + 32``, ...; the block's warps share out the sources,
stage them through shared memory, 32 at a time, and at the end add up their sums in order. Sources of few targets are
also split over blocks, whose sums the finishing kernel adds up in order, so that nothing depends on scheduling.

Where a stage's sources have one radius, and none of them is left out for one of the targets, the clamp is a constant of
the target and nothing is masked: 20 instructions a pair for the field and 31 for the force, next to the five or so that
a source takes once for all targets of a lane.
"""

from dataclasses import dataclass
from functools import cache

import warp as wp

from warpmag.kernels.pairs.pair_terms import (
    Quantity,
)
from warpmag.kernels.shared.native import native_options


@dataclass(frozen=True)
class LoopShape:
    """Shape of the blocks that walk a work list.

    Attributes:
        targets: Targets a lane; a tile has 32 times as many.
        warps: Warps a block.
        blocks: Blocks that a multiprocessor holds at once, in float32.
    """

    targets: int
    warps: int
    blocks: int


# Measured on an H200 at 243 to 131,072 targets: the shape, and the most targets that it is best for.
_SHAPES = {
    Quantity.FIELD: ((6144, LoopShape(4, 8, 2)), (65536, LoopShape(6, 4, 3)), (None, LoopShape(8, 4, 2))),
    Quantity.FORCE: ((None, LoopShape(4, 4, 3)),),
    Quantity.WRENCH: ((None, LoopShape(3, 4, 3)),),
}
_MOST_SPLITS = 32
_FIXED_COST = 16
"""Sources a block could sum in the time that it takes to start and to end."""


def choose_shape(quantity: Quantity, count: int) -> LoopShape:
    """Shape for a number of targets."""
    return next(shape for most, shape in _SHAPES[quantity] if most is None or count <= most)


def choose_splits(shape: LoopShape, tiles: int, longest: int, multiprocessors: int) -> int:
    """Blocks that share the sources of a tile: as many as make the last wave of blocks end with the rest.

    Args:
        shape: LoopShape of the blocks.
        tiles: Tiles before splitting.
        longest: Sources of the longest tile.
        multiprocessors: Of the device.
    """

    def cost(splits):
        waves, rest = divmod(tiles * splits, multiprocessors * shape.blocks)
        # a multiprocessor with few blocks goes through each of them faster, but does less in all
        share = -(-rest // multiprocessors) / shape.blocks
        work = shape.blocks * longest / splits
        return waves * work + (0.4 + 0.6 * share) * work * (rest > 0) + (waves + (rest > 0)) * _FIXED_COST

    most = max(1, min(_MOST_SPLITS, longest // (2 * shape.warps)))
    return min(range(1, most + 1), key=cost)


@cache
def _kernel(dtype, quantity: Quantity, shape: LoopShape):
    @wp.func_native(
        f"warpmag::sum_tile<warpmag::Quantity({quantity:d}), {shape.targets}, {shape.warps}>"
        "(thread, tiles, targets, sources, effective, partial_out);"
    )
    def sum_tile(
        thread: int,
        tiles: wp.array2d[int],
        targets: wp.array2d[dtype],
        sources: wp.array2d[dtype],
        effective: wp.array2d[dtype],
        partial_out: wp.array3d[dtype],
    ): ...

    @wp.kernel(
        module="unique",
        enable_backward=False,
        grid_stride=False,
        launch_bounds=(32 * shape.warps, shape.blocks if dtype is wp.float32 else 1),
        module_options=native_options("pairs/sums_cuda.h", dtype=dtype),
    )
    def pair_loop_cuda(
        # inputs:
        tiles: wp.array2d[int],
        targets: wp.array2d[dtype],
        sources: wp.array2d[dtype],
        effective: wp.array2d[dtype],
        # outputs:
        partial_out: wp.array3d[dtype],
    ):
        sum_tile(wp.tid(), tiles, targets, sources, effective, partial_out)

    return pair_loop_cuda


def launch_pair_loop_cuda(quantity: Quantity, shape: LoopShape, targets, sources, effective, tiles, partial):
    """Sum a quantity over all tiles; see ``pair_loops.launch_pair_loop``."""
    wp.launch(
        _kernel(partial.dtype, quantity, shape),
        dim=tiles.shape[0] * 32 * shape.warps,
        inputs=[tiles, targets, sources, effective],
        outputs=[partial],
        device=partial.device,
        block_dim=32 * shape.warps,
    )
