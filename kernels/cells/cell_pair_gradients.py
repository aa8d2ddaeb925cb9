"""Gradients of functions of the field and of the forces between near cells of different bodies, and their launches.

``cell_pair_gradients.h`` has the derivation. Derivatives along a motion of two cells are central differences, because
the second derivatives of boxes, quadrupoles and windows have no short closed form. Differences are in float64 on all
devices: their relative error is below 1e-9.
"""

from functools import cache

import warp as wp

from warpmag.kernels.cells.cell_pairs import CELLS_PER_THREAD, cell_pairs_type, pair_constants
from warpmag.kernels.cells.couplings import padded_vectors
from warpmag.kernels.shared.native import PASS_ARGUMENTS, native_kernel
from warpmag.kernels.shared.reductions import group_threads
from warpmag.kernels.shared.team import launch_passes, threads_for

_OF_FIELD, _OF_WRENCH = range(2)
"""The passes; as in ``cell_pair_gradients.h``."""
_STEP = 3e-6
"""Largest motion of a pair in a difference, in mean sizes and radians: about the cube root of the precision."""
_SHARED = "candidate", "candidate_count", "rows", "cell", "column", "kind_end", "close_capacity"
"""Integers and integer arrays that are shared with the pairs, not copied."""


@wp.struct
class CellMomentArrays:
    """Moments of n cells and half the differences of their halves, in the frames of their grids [A·m²]."""

    means: wp.array[wp.vec3d]
    differences: wp.array[wp.vec3d]


@wp.struct
class CellPairGradientArrays:
    """Arrays of the passes, for n moments."""

    pairs: cell_pairs_type(wp.float64)
    # Data in:
    moments: CellMomentArrays
    cotangents: CellMomentArrays  # of fields, like moments
    shift: wp.array[wp.vec3d]  # cotangents of forces, shape [n]
    turn: wp.array[wp.vec3d]  # cotangents of torques, shape [n]
    # Data out, added to:
    by_positions: wp.array[wp.vec3d]  # shape [n]
    by_turns: wp.array[wp.vec3d]  # gradients by turns of cells with their moments, shape [n]
    fields: wp.array[wp.vec3d]  # gradients by means, in the world's frame, shape [n]
    difference_fields: wp.array[wp.vec3d]  # gradients by differences, in the frames of grids, shape [n]


@cache
def _kernel(group: int):
    arguments = {**PASS_ARGUMENTS, "arrays": CellPairGradientArrays}
    call = "differentiate_cell_pairs(thread, first, last, threads, team.data, arrays)"
    constants = {"STEP": _STEP, "GROUP": group, **pair_constants()}
    return native_kernel(call, "cells/cell_pair_gradients.h", arguments, dtype=wp.float64, **constants)


class CellPairGradients:
    """Gradients by near cells, in buffers that are allocated once.

    Args:
        pairs: Arrays of the pairs (``cell_pairs.CellPairs.arrays``), of either precision.

    Attributes:
        arrays: The arrays of the passes. The results are not multiplied by μ0.
    """

    def __init__(self, pairs):
        """Allocate the buffers."""
        n, self._device, self._given = pairs.group.shape[0], pairs.h.device, pairs
        self.arrays = g = CellPairGradientArrays()
        for name in _SHARED:
            setattr(g.pairs, name, getattr(pairs, name))
        g.pairs.box = wp.zeros(pairs.box.shape, dtype=wp.float64, device=self._device)

        def vectors():
            return padded_vectors(n, wp.vec3d, self._device)

        for moments in (g.moments, g.cotangents):
            moments.means, moments.differences = vectors(), vectors()
        g.shift, g.turn = vectors(), vectors()
        self._results = g.by_positions, g.by_turns, g.fields, g.difference_fields = tuple(vectors() for _ in range(4))

    def load(self) -> None:
        """Copy the boxes of the pairs, after their ``find``."""
        cast(self._given.box, self.arrays.pairs.box)

    def load_moments(self) -> None:
        """Copy the moments whose field the pairs have just evaluated."""
        self._load(self.arrays.moments)

    def load_cotangents(self) -> None:
        """Copy the cotangents of fields, whose field as moments the pairs have just evaluated."""
        self._load(self.arrays.cotangents)

    def _load(self, moments: CellMomentArrays) -> None:
        cast(self._given.means, moments.means)
        cast(self._given.differences, moments.differences)

    def launch_field(self) -> None:
        """Write the gradients of η·T m by poses."""
        self._launch(_OF_FIELD)

    def launch_wrench(self, force_cotangents, torque_cotangents) -> None:
        """Write the gradients of a function of forces and torques by poses and moments."""
        cast(force_cotangents, self.arrays.shift)
        cast(torque_cotangents, self.arrays.turn)
        self._launch(_OF_WRENCH)

    def _launch(self, number: int) -> None:
        for result in self._results:
            result.zero_()
        group, rows = group_threads(self._device, long_lists=True), self.arrays.pairs.cell.shape[0]
        sizes = dict(threads=threads_for(rows, CELLS_PER_THREAD), gpu_threads=group * rows)
        launch_passes(_kernel(group), number, number + 1, self.arrays, device=self._device, **sizes)


def cast(values: wp.array, out: wp.array) -> None:
    """Copy an array to one of another precision."""
    wp.utils.array_cast(in_array=values, out_array=out)
