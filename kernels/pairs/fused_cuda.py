"""Shapes of blocks for ``fused_cuda.h``: all-pairs sums of few moments on a GPU, in one kernel."""

import math
from dataclasses import dataclass

from warpmag.kernels.pairs.pair_law import Quantity


@dataclass(frozen=True)
class FusedShape:
    """Shape of the blocks."""

    targets_per_lane: int  # targets per lane
    lanes: int  # lanes of a warp that hold different targets
    warps: int  # Warps of a block, which share the sources
    unrolled: int  # sources per unrolled step of the loop

    @property
    def targets(self) -> int:
        """Targets per block."""
        return self.targets_per_lane * self.lanes

    @property
    def correcting(self) -> int:
        """Threads of a block that correct overlapping pairs."""
        return 32 * max(min(4, math.ceil(self.targets / 8)), math.ceil(self.targets / 32))

    @property
    def threads(self) -> int:
        """Threads per block: those that sum pairs, then those that correct."""
        return 32 * self.warps + self.correcting

    @property
    def shares(self) -> int:
        """Threads that share the corrections of a target, a power of two."""
        return min(32, 1 << (self.correcting // self.targets).bit_length() - 1)


# Measured on an H200: most targets for which a shape is fastest, one block on each of 132 multiprocessors, and the
# shape. Clusters of blocks that share the sources of a larger tile are no faster. For a field at 2,560 targets clusters
# of two take 10.4 µs and single blocks 10.0 µs; clusters of four or eight use only 124 or 120 multiprocessors.
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
    """Return the fastest shape for a number of targets."""
    return next(shape for most, shape in _SHAPES[quantity] if most is None or count <= most)
