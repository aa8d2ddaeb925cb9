"""Shape and launch of ``sums_cuda.h``: all-pairs sums of a work list of tiles on a GPU.

If there are few targets, several blocks share the sources of a tile. Each block writes separate partial sums, so that
results do not depend on the order of blocks.
"""

from dataclasses import dataclass
from functools import cache

import warp as wp

from warpmag.kernels.pairs.pair_law import Quantity
from warpmag.kernels.shared.native import native_kernel


@dataclass(frozen=True)
class LoopShape:
    """Shape of the blocks.

    Attributes:
        targets: Targets per lane; a tile has 32 times as many.
        warps: Warps per block.
        blocks: Resident blocks per multiprocessor, in float32.
    """

    targets: int
    warps: int
    blocks: int


# Measured on an H200 at 243 to 131,072 targets: most targets for which a shape is fastest, and the shape.
_SHAPES = {
    Quantity.FIELD: ((6144, LoopShape(4, 8, 2)), (65536, LoopShape(6, 4, 3)), (None, LoopShape(8, 4, 2))),
    Quantity.FORCE: ((None, LoopShape(4, 4, 3)),),
    Quantity.WRENCH: ((None, LoopShape(3, 4, 3)),),
}
_MOST_SPLITS = 32
_FIXED_COST = 16
"""Cost of starting and ending a block, in units of one source."""


def choose_loop_shape(quantity: Quantity, count: int) -> LoopShape:
    """Return the fastest shape for a number of targets."""
    return next(shape for most, shape in _SHAPES[quantity] if most is None or count <= most)


def choose_splits(shape: LoopShape, tiles: int, longest: int, multiprocessors: int) -> int:
    """Return the fastest number of blocks that share the sources of a tile.

    Args:
        shape: Shape of the blocks.
        tiles: Number of tiles before splitting.
        longest: Number of sources of the longest tile.
        multiprocessors: Multiprocessors of the device.
    """

    def cost(splits):
        time, waves = launch_time(tiles * splits, shape.blocks, shape.blocks * longest / splits, multiprocessors)
        return time + waves * _FIXED_COST

    most = max(1, min(_MOST_SPLITS, longest // (2 * shape.warps)))
    return min(range(1, most + 1), key=cost)


def launch_time(blocks: int, together: int, work: float, multiprocessors: int) -> tuple[float, int]:
    """Estimate the time of equal blocks, and the number of waves in which they run.

    Args:
        blocks: Number of blocks.
        together: Resident blocks per multiprocessor.
        work: Time of ``together`` blocks on a multiprocessor.
        multiprocessors: Multiprocessors of the device.
    """
    waves, rest = divmod(blocks, multiprocessors * together)
    if rest == 0:
        return waves * work, waves
    # with fewer blocks on a multiprocessor each block is faster, but the throughput is lower
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
