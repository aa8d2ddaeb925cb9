"""Plan and launch of ``mirror_cuda.h``: sums of many moments among themselves on a GPU, each pair evaluated once.

The finishing kernel adds up the partial sums in order, so that results do not depend on the order of blocks. If the
partial sums would take too much memory, several passes add to the same partial sums.
"""

import math
from dataclasses import dataclass, replace
from functools import cache

import numpy as np
import warp as wp

from warpmag.kernels.pairs.pair_law import Quantity
from warpmag.kernels.pairs.sums_cuda import launch_time
from warpmag.kernels.shared.native import native_kernel


@dataclass(frozen=True)
class MirrorShape:
    """Shape of the blocks."""

    moments: int  # moments per lane; a tile has at most 32 times as many
    warps: int  # Warps per block
    blocks: int  # resident blocks per multiprocessor, in float32
    unrolled: int  # steps of a stage that are unrolled


# Measured on an H200 at 5,000 to 131,072 moments: most moments for which a shape is fastest, and the shape.
_SHAPES = {
    Quantity.FIELD: (
        (7000, MirrorShape(2, 4, 6, 2)),
        (30000, MirrorShape(3, 8, 2, 2)),
        (None, MirrorShape(6, 4, 3, 2)),
    ),
    Quantity.MUTUAL_FORCE: ((7000, MirrorShape(2, 4, 6, 2)), (None, MirrorShape(4, 4, 4, 1))),
}
_MOST_DOUBLE_WARPS = 4  # most warps per block in float64, limited by shared memory
_SLAB_BYTES = 2**28  # most memory of slabs. A slab holds the partial sums of one distance between tiles
_MOST_SPLITS, _MOST_STAGES = 32, 32
"""Most blocks that share the walk of a tile, and most stages in a warp's sum: longer sums would lose digits."""
_SPLITS_TOGETHER = 4
"""With several passes the number of splits is a multiple of this, so that this many processes can share them."""
_FIXED_COST = 0.1  # cost of starting and ending a block, and of adding up a split, in units of a warp's stage


@wp.struct
class MirrorTiles:
    """Tiles and blocks for the sums of moments among themselves, on one device."""

    # Model:
    origin: int  # packed column of the first moment
    edges: wp.array[int]  # first moment of each tile, and the end, shape [tiles + 1]
    blocks: wp.array2d[int]  # home tile, stages begin and end, and share of each block, shape [blocks, 4]
    stages: int  # stages per tile
    slabs: int  # slabs; partial sums of the blocks' shares follow them


@dataclass(frozen=True)
class Mirror:
    """Work list of moments among themselves, on one device."""

    shape: MirrorShape  # shape of the blocks
    tiles: MirrorTiles  # tiles and blocks
    # First block, number of blocks, and first distance between tiles of each launch.
    passes: tuple[tuple[int, int, int], ...]
    slabs: int  # number of slabs; partial sums of the blocks' shares follow them
    splits: int  # number of blocks of a pass that share the walk of a home tile


def shape_for(quantity: Quantity, count: int) -> MirrorShape:
    """Return the fastest shape of the sums of ``count`` moments."""
    return next(shape for most, shape in _SHAPES[quantity] if most is None or count <= most)


def make_mirror(origin: int, count: int, shape: MirrorShape, dtype, device, *, numbers=3, ranks=None) -> Mirror:
    """Plan the sums of ``count`` moments from packed column ``origin`` on, or the part of one process of ``ranks``.

    A moment has partial sums of so many ``numbers``.
    """
    if dtype is wp.float64 and shape.warps > _MOST_DOUBLE_WARPS:
        shape = replace(shape, warps=shape.warps // 2, blocks=2 * shape.blocks)
    tiles = max(math.ceil(count / (32 * shape.moments)), 3)
    tiles += 1 - tiles % 2
    stages = math.ceil(math.ceil(count / tiles) / 32)
    farthest = tiles // 2
    slabs = min(farthest, max(1, _SLAB_BYTES // (4 * numbers * count)))
    slabs = math.ceil(farthest / math.ceil(farthest / slabs))  # equal in all passes
    splits = _choose_splits(shape, tiles, stages * min(slabs + 1, farthest + 1), device.sm_count)
    several = slabs < farthest
    if several:  # a split has the same slabs in each pass, so that only one process adds to a partial sum
        splits = min(-(-splits // _SPLITS_TOGETHER) * _SPLITS_TOGETHER, slabs)
    own = (0, tiles * splits) if ranks is None else ranks.share(tiles * splits)
    if ranks is not None and several:
        own = tuple(tiles * edge for edge in ranks.share(splits))
    blocks, passes = [], []
    for nearest in range(1, farthest + 1, slabs):
        # the first pass includes the pairs within a tile
        begin, end = stages * (nearest if nearest > 1 else 0), stages * min(nearest + slabs, farthest + 1)
        cuts = begin + (end - begin) * np.arange(splits + 1) // splits
        if several:
            cuts = np.minimum(stages * (nearest + slabs * np.arange(splits + 1) // splits), end)
            cuts[0] = begin
        passes.append((len(passes) * tiles * splits + own[0], own[1] - own[0], nearest))
        split, tile = np.divmod(np.arange(tiles * splits), tiles)
        blocks.append(np.stack((tile, cuts[split], cuts[split + 1], split), axis=1))
    mirror_tiles = MirrorTiles()
    mirror_tiles.origin, mirror_tiles.stages, mirror_tiles.slabs = origin, stages, slabs
    mirror_tiles.edges = wp.array(count * np.arange(tiles + 1) // tiles, dtype=wp.int32, device=device)
    mirror_tiles.blocks = wp.array(np.concatenate(blocks), dtype=wp.int32, device=device)
    return Mirror(shape, mirror_tiles, tuple(passes), slabs, splits)


def _choose_splits(shape: MirrorShape, tiles: int, walk: int, multiprocessors: int) -> int:
    """Return the fastest number of blocks that share the ``walk`` of a tile [stages]."""

    def cost(splits):
        work = shape.blocks * math.ceil(walk / splits / shape.warps)
        time, waves = launch_time(tiles * splits, shape.blocks, work, multiprocessors)
        return time + (waves + splits) * _FIXED_COST

    least = math.ceil(walk / shape.warps / _MOST_STAGES)
    return min(range(least, max(least, min(_MOST_SPLITS, walk)) + 1), key=cost)


@cache
def _kernel(dtype, quantity: Quantity, shape: MirrorShape):
    bounds = 32 * shape.warps, shape.blocks if dtype is wp.float32 else 1
    numbers = f"{shape.moments}, {shape.warps}, {shape.unrolled}"
    arguments = {"packed": wp.array2d[dtype], "tiles": MirrorTiles, "first_block": int, "nearest": int}
    return native_kernel(
        f"sum_mirrored<warpmag::Quantity({quantity:d}), {numbers}>"
        "(first_block + blockIdx.x, threadIdx.x, packed, tiles, nearest, partial_out)",
        "pairs/mirror_cuda.h",
        arguments | {"partial_out": wp.array3d[dtype]},
        dtype=dtype,
        launch={"grid_stride": False, "launch_bounds": bounds},
    )


def launch_pair_loop_mirrored(quantity: Quantity, mirror: Mirror, packed, partial):
    """Sum a quantity, ``FIELD`` or ``MUTUAL_FORCE``, over all pairs; see ``evaluate``."""
    block = 32 * mirror.shape.warps
    kernel, device = _kernel(partial.dtype, quantity, mirror.shape), partial.device
    for first_block, blocks, nearest in mirror.passes:
        inputs = [packed, mirror.tiles, first_block, nearest]
        wp.launch(kernel, block * blocks, inputs=inputs, outputs=[partial], block_dim=block, device=device)
