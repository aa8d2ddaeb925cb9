"""All-pairs sums of few moments on a GPU, ``fused_cuda.h``: the kernel that needs the sums computes them itself."""

import math
from dataclasses import dataclass
from functools import cache

import warp as wp

from warpmag.kernels.pairs.pair_terms import WIDTHS, Quantity


@dataclass(frozen=True)
class FusedShape:
    """Shape of the blocks.

    Attributes:
        held: Targets that a lane holds.
        lanes: Lanes of a warp that hold different targets.
        warps: Warps of a block that share out the sources.
        unrolled: Sources that the compiler interleaves.
    """

    held: int
    lanes: int
    warps: int
    unrolled: int

    @property
    def targets(self) -> int:
        """Targets of a block."""
        return self.held * self.lanes

    @property
    def summing(self) -> int:
        """Threads of a block that sum."""
        return 32 * self.warps

    @property
    def correcting(self) -> int:
        """Threads of a block that correct, after those that sum."""
        return 32 * max(min(4, math.ceil(self.targets / 8)), math.ceil(self.targets / 32))

    @property
    def threads(self) -> int:
        """Threads of a block."""
        return self.summing + self.correcting

    @property
    def shares(self) -> int:
        """Threads that share out the corrections of a target, a power of two."""
        return min(32, 1 << (self.correcting // self.targets).bit_length() - 1)


# Measured on an H200: the most targets that a shape is best for, those of a block on each of 132 multiprocessors, and
# the shape. Clusters of blocks, which share out the sources of a larger tile and add up through each other's shared
# memory, gained nothing: clusters of two take 10.4 µs for a field at 2,560 targets, single blocks 10.0; those of four
# or eight use only 124 or 120 multiprocessors.
_SHAPES = {
    Quantity.FIELD: (
        (528, FusedShape(2, 2, 8, 1)),
        (1056, FusedShape(4, 2, 8, 2)),
        (1584, FusedShape(3, 4, 16, 4)),
        (2112, FusedShape(4, 4, 16, 4)),
        (2640, FusedShape(5, 4, 16, 4)),
        (3696, FusedShape(7, 4, 12, 4)),
        (5280, FusedShape(5, 8, 12, 4)),
        (None, FusedShape(7, 8, 12, 4)),
    ),
    Quantity.FORCE: (
        (528, FusedShape(2, 2, 8, 1)),
        (1056, FusedShape(2, 4, 16, 2)),
        (2112, FusedShape(4, 4, 8, 4)),
        (None, FusedShape(5, 4, 8, 4)),
    ),
    Quantity.WRENCH: (
        (528, FusedShape(2, 2, 8, 1)),
        (1056, FusedShape(4, 2, 8, 2)),
        (2112, FusedShape(4, 4, 8, 2)),
        (None, FusedShape(5, 4, 8, 4)),
    ),
}


def choose_fused_shape(quantity: Quantity, count: int) -> FusedShape:
    """Shape for a number of targets."""
    return next(shape for most, shape in _SHAPES[quantity] if most is None or count <= most)


@cache
def pair_summation(dtype, quantity: Quantity, shape: FusedShape):
    """Warp function by which a block sums a quantity over the pairs of a tile.

    All threads of the block call it. Those that have a :func:`target_share` give a correction to add to the sum of that
    target. Thread k gets the sum of target k. Its kernel needs ``native_options("pairs/fused_cuda.h", ...)``.
    """
    vector = wp.types.vector(WIDTHS[quantity], dtype)
    parameters = f"{shape.held}, {shape.lanes}, {shape.warps}, {shape.unrolled}, {shape.shares}"

    @wp.func_native(
        f"return warpmag::sum_fused<warpmag::Quantity({quantity:d}), {parameters}>(tile, thread, tiles, targets, "
        "sources, effective, [&](int, int) { return correction; });"
    )
    def sum_pairs(
        tile: int,
        thread: int,
        tiles: wp.array2d[int],
        targets: wp.array2d[dtype],
        sources: wp.array2d[dtype],
        effective: wp.array2d[dtype],
        correction: vector,
    ) -> vector: ...

    return sum_pairs


# what Warp makes of its index takes a division, and all else waits for it
@wp.func_native("return blockIdx.x;")
def this_block() -> int:
    """Block of this thread, and so its tile."""
    ...


@wp.func_native("return threadIdx.x;")
def this_thread() -> int:
    """Thread of the block."""
    ...


@wp.func
def own_target(tile: int, thread: int, tiles: wp.array2d[int]):
    """Packed column of the target whose sum a thread gets; -1 for none."""
    # all of it is read at once, whether it is wanted or not: a block begins with what waits for this
    column = tiles[tile, 2] + thread
    return wp.where(thread < tiles[tile, 1] - tiles[tile, 0], column, -1)


@cache
def target_share(shape: FusedShape):
    """Warp function that says what a thread has to correct: packed column of its target, or -1, and its share of it."""

    @wp.func
    def share_of(tile: int, thread: int, tiles: wp.array2d[int]):
        k = (thread - wp.static(shape.summing)) // wp.static(shape.shares)
        column = tiles[tile, 2] + k
        wanted = thread >= wp.static(shape.summing) and k < tiles[tile, 1] - tiles[tile, 0]
        return wp.where(wanted, column, -1), thread % wp.static(shape.shares)

    return share_of
