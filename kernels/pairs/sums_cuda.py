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
    """Shape of the blocks."""

    targets: int  # targets per lane; a tile has 32 times as many
    warps: int  # Warps per block
    blocks: int  # resident blocks per multiprocessor, in float32


# Measured on an H200 at 243 to 131,072 targets: most targets for which a shape is fastest, and the shape.
_SHAPES = {
    Quantity.FIELD: ((6144, LoopShape(4, 8, 2)), (65536, LoopShape(6, 4, 3)), (None, LoopShape(8, 4, 2))),
    Quantity.FORCE: ((None, LoopShape(4, 4, 3)),),
    Quantity.WRENCH: ((None, LoopShape(3, 4, 3)),),
}
_MOST_SPLITS = 32
_FIXED_COST = 16  # cost of starting and ending a block, in units of one source


def choose_loop_shape(quantity: Quantity, count: int) -> LoopShape:
    """Return the fastest shape for a number of targets."""
    return next(shape for most, shape in _SHAPES[quantity] if most is None or count <= most)


def choose_splits(shape: LoopShape, tiles: int, longest: int, multiprocessors: int) -> int:
    """Return the fastest number of blocks that share the sources of a tile.

    ``tiles`` counts tiles before splitting; ``longest`` is the number of sources of the longest tile.
    """

    def cost(splits):
        time, waves = launch_time(tiles * splits, shape.blocks, shape.blocks * longest / splits, multiprocessors)
        return time + waves * _FIXED_COST

    most = max(1, min(_MOST_SPLITS, longest // (2 * shape.warps)))
    return min(range(1, most + 1), key=cost)


def launch_time(blocks: int, together: int, work: float, multiprocessors: int) -> tuple[float, int]:
    """Estimate the time of equal blocks, and the number of waves in which they run.

    ``together`` blocks are resident on a multiprocessor, and take the time ``work`` there.
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
    moments = dict.fromkeys(("targets", "sources", "effective"), wp.array2d[dtype])
    return native_kernel(
        f"sum_tile<warpmag::Quantity({quantity:d}), {shape.targets}, {shape.warps}>"
        "(thread, tiles, targets, sources, effective, partial_out)",
        "pairs/sums_cuda.h",
        {"tiles": wp.array2d[int], **moments, "partial_out": wp.array3d[dtype]},
        dtype=dtype,
        launch={"grid_stride": False, "launch_bounds": bounds},
    )


def launch_pair_loop_cuda(quantity: Quantity, shape: LoopShape, targets, sources, effective, tiles, partial):
    """Sum a quantity over all tiles; see ``evaluate``."""
    kernel, block, device = _kernel(partial.dtype, quantity, shape), 32 * shape.warps, partial.device
    inputs = [tiles, targets, sources, effective]
    wp.launch(kernel, tiles.shape[0] * block, inputs=inputs, outputs=[partial], device=device, block_dim=block)
