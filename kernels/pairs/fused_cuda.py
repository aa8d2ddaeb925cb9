"""Sums over pairs on a GPU, made by the very kernel that needs them: no second launch waits for the first.

A block has a tile of a few targets. Each of its warps holds all of them, some in every lane, and as often as there are
lanes for it; the warps share out the sources, stage them through shared memory, 32 at a time, and groups of lanes share
out what is staged. What the groups have summed is added up by shuffles, most of which halve the values that a lane
keeps, and what the warps have summed in shared memory, in an order that depends on nothing. Other threads of the block
meanwhile bring the correction of overlapping pairs. Thread k of a block ends with the whole sum of target k, for the
kernel to go on with.

Where the sources that a group meets in one go have one radius, and none of them is left out for one of the targets,
the clamp is a constant of the target and nothing is masked: 20 instructions a pair for the field and 31 for the force,
next to the four or so that a source takes once for all targets of a lane, and the sixty that a warp takes to stage 32.
"""

import math
from dataclasses import dataclass
from functools import cache

import warp as wp

from warpmag.kernels.pairs.pair_terms import WIDTHS, Quantity


@dataclass(frozen=True)
class FusedShape:
    """Shape of the blocks that walk a work list.

    Attributes:
        held: Targets that a lane holds.
        lanes: Lanes of a warp that hold other targets than each other.
        warps: Warps of a block that share out the sources.
        unrolled: Sources that a lane meets in one go.
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


# Measured on an H200, of 132 multiprocessors: the shape, and the most targets that it is best for. Those are what the
# multiprocessors hold at a block each. Blocks in clusters, which share out the sources of a larger tile and add up
# through each other's shared memory, gained nothing: of two blocks, 10.4 µs where one takes 10.0 for a field at 2,560;
# of four or eight, only 124 or 120 multiprocessors find partners.
SHAPES = {
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


def choose_shape(quantity: Quantity, count: int) -> FusedShape:
    """Shape for a number of targets."""
    return next(shape for most, shape in SHAPES[quantity] if most is None or count <= most)


@cache
def pair_summation(dtype, quantity: Quantity, shape: FusedShape):
    """Warp function by which a block sums a quantity, see ``pair_loops``, over a tile's pairs.

    All threads of the block call it. Those that have a :func:`target_share` bring something to add to the sum of that
    target. Thread k gets the sum of target k.
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
