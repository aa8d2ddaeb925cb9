"""Shapes and launch of the all-pairs sums of a work list of tiles on a GPU, ``sums_cuda.h``.

Sources of few targets are split over blocks, each of which writes partial sums of its own, so that results do not
depend on the order in which blocks run.
"""

from dataclasses import dataclass
from functools import cache

import warp as wp

from warpmag.kernels.pairs.pair_terms import Quantity
from warpmag.kernels.shared.native import native_kernel


@dataclass(frozen=True)
class LoopShape:
    """Shape of the blocks.

    Attributes:
        targets: Targets of a lane; a tile has 32 times as many.
        warps: Warps of a block.
        blocks: Blocks that a multiprocessor holds together, in float32.
    """

    targets: int
    warps: int
    blocks: int


# Measured on an H200 at 243 to 131,072 targets: the most targets that a shape is best for, and the shape.
_SHAPES = {
    Quantity.FIELD: ((6144, LoopShape(4, 8, 2)), (65536, LoopShape(6, 4, 3)), (None, LoopShape(8, 4, 2))),
    Quantity.FORCE: ((None, LoopShape(4, 4, 3)),),
    Quantity.WRENCH: ((None, LoopShape(3, 4, 3)),),
}
_MOST_SPLITS = 32
_FIXED_COST = 16
"""Sources that a block sums in the time that it takes to start and to end."""


def choose_loop_shape(quantity: Quantity, count: int) -> LoopShape:
    """Shape for a number of targets."""
    return next(shape for most, shape in _SHAPES[quantity] if most is None or count <= most)


def choose_splits(shape: LoopShape, tiles: int, longest: int, multiprocessors: int) -> int:
    """Number of blocks that share the sources of a tile, for which a launch is fastest.

    Args:
        shape: Shape of the blocks.
        tiles: Tiles before splitting.
        longest: Sources of the longest tile.
        multiprocessors: Of the device.
    """

    def cost(splits):
        time, waves = launch_time(tiles * splits, shape.blocks, shape.blocks * longest / splits, multiprocessors)
        return time + waves * _FIXED_COST

    most = max(1, min(_MOST_SPLITS, longest // (2 * shape.warps)))
    return min(range(1, most + 1), key=cost)


def launch_time(blocks: int, together: int, work: float, multiprocessors: int) -> tuple[float, int]:
    """Time that equal blocks take, and the waves in which they run.

    Args:
        blocks: Number of blocks.
        together: Blocks that a multiprocessor holds together.
        work: Time that so many blocks take on a multiprocessor.
        multiprocessors: Of the device.
    """
    waves, rest = divmod(blocks, multiprocessors * together)
    if rest == 0:
        return waves * work, waves
    # a multiprocessor with few blocks runs each of them faster, but all of them together slower
    share = -(-rest // multiprocessors) / together
    return waves * work + (0.4 + 0.6 * share) * work, waves + 1


@cache
def _kernel(dtype, quantity: Quantity, shape: LoopShape):
    bounds = 32 * shape.warps, shape.blocks if dtype is wp.float32 else 1
    return native_kernel(
        f"sum_tile<warpmag::Quantity({quantity:d}), {shape.targets}, {shape.warps}>"
        "(thread, tiles, targets, sources, effective, partial_out)",
        "pairs/sums_cuda.h",
        {
            "tiles": wp.array2d[int],
            **dict.fromkeys(("targets", "sources", "effective"), wp.array2d[dtype]),
            "partial_out": wp.array3d[dtype],
        },
        dtype=dtype,
        launch={"grid_stride": False, "launch_bounds": bounds},
    )


def launch_pair_loop_cuda(quantity: Quantity, shape: LoopShape, targets, sources, effective, tiles, partial):
    """Sum a quantity over all tiles; see ``evaluate``."""
    wp.launch(
        _kernel(partial.dtype, quantity, shape),
        dim=tiles.shape[0] * 32 * shape.warps,
        inputs=[tiles, targets, sources, effective],
        outputs=[partial],
        device=partial.device,
        block_dim=32 * shape.warps,
    )
