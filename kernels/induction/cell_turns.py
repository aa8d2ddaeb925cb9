"""Gradients of functions of fields and forces of cells, with respect to the poses of their bodies.

The corrections N of ``cells.couplings`` are constant in the body's frame. With the cotangents η of the cells' fields, a
small rotation δ of the body changes η·N m by δ·Σ_i ((N m)_i × η_i + (N η)_i × m_i), since N is symmetric. Where cells
of other bodies are near, N includes the tensors of the pairs, and the derivatives of η·N m with moments that rotate
with their bodies are added (``cells.cell_pair_gradients``).

Likewise let g be the gradients of a function of forces and torques with respect to the moments. A rotation δ of a body
at fixed moments changes the function by δ·Σ_i g_i × m_i more than a rotation of body and moments.
"""

from functools import cache

import numpy as np
import warp as wp

from warpmag.kernels.cells.cell_pair_gradients import CellPairGradients, cast
from warpmag.kernels.cells.couplings import CellCouplings
from warpmag.kernels.pairs.wrench import MU0
from warpmag.kernels.shared.axpy import launch_add_scaled


@cache
def _kernel(dtype):
    vec3 = wp.types.vector(3, dtype)

    @wp.kernel(module="unique", enable_backward=False)
    def add_turns(
        factor: dtype,
        ranges: wp.array[wp.vec2i],
        field: wp.array[vec3],
        vectors: wp.array[vec3],
        by_turns: wp.array[vec3],
        by_rotations: wp.array[vec3],
    ):
        body = wp.tid()
        total = vec3()
        for i in range(ranges[body][0], ranges[body][1]):
            total += wp.cross(field[i], vectors[i])
            if by_turns:
                total += by_turns[i]
        by_rotations[body] = by_rotations[body] + factor * total

    return add_turns


class CellTurns:
    """Field of the corrections between cells, and gradients by poses, repeatedly in the same arrays.

    Args:
        couplings: First moment and coupling of each body, as ``CellCouplings`` takes them.
        pairs: Near cells of different bodies of the system (``cells.cell_pairs.CellPairs``); None without them.
        moments: Moments whose field is added, packed (``PackedMoments``).
        vectors: The same as vectors [A·m²], shape [n].
        field: Field that is added to [A/m], shape [n].

    Attributes:
        rotations: Rotation of each body's frame to the world, shape [bodies]; written before :meth:`load`.
        by_rotations: Gradient by small turns of each body, in the world's frame, shape [bodies]. :meth:`load` clears
            it, and :meth:`add_wrench` and :meth:`add_solve` add to it.
    """

    def __init__(self, couplings, pairs, moments, vectors, field):
        """Lay out the tables."""
        self._cells = CellCouplings(couplings, vectors, field, paired=pairs is not None)
        self._moments, self._vectors, self._field = moments, vectors, field
        self._pairs = self._near = None
        if pairs is not None:
            self._pairs = pairs.for_all_moments(self._cells, moments, field)
            self._near = CellPairGradients(self._pairs.arrays)
            self._part = wp.zeros_like(field)  # of the near cells' gradients, in the precision of the field
        self.rotations = self._cells.rotations
        ranges = [(first, first + len(coupling.start) - 1) for first, coupling in couplings]
        self._ranges = wp.array(np.array(ranges, np.int32), dtype=wp.vec2i, device=field.device)
        self.by_rotations = wp.zeros(len(ranges), dtype=field.dtype, device=field.device)

    def load(self, positions) -> None:
        """Set the positions [m], shape [n], and find near cells at the present rotations."""
        self._positions = positions
        self.by_rotations.zero_()
        if self._pairs is not None:
            self._pairs.find()
            self._near.load()

    def add_field(self) -> None:
        """Add the corrections to the field."""
        if self._pairs is not None:
            self._pairs.add_field()
        self._cells.launch()

    def add_wrench(self, moments, force_cotangents, torque_cotangents, by_positions, by_moments) -> None:
        """Add the gradients of a function of forces and torques to those by positions, moments and rotations, [n] each.

        The moments are 0 after it, and the field is overwritten.
        """
        near = self._near
        if near is None:
            return
        self._evaluate(moments)
        near.load_moments()
        near.launch_wrench(force_cotangents, torque_cotangents)
        self._clear()
        self._cells.write_differences()
        cast(near.arrays.difference_fields, self._cells.difference_field)
        cast(near.arrays.fields, self._field)
        self._cells.launch()  # of no moments: it adds the transposed differences
        launch_add_scaled(self._field, by_moments, MU0)
        self._add_turns(MU0, self._field, moments, self._take_near(near, MU0, by_positions))

    def add_solve(self, moments, by_field, by_positions, by_moments) -> None:
        """Add the gradients of η·N m by positions and rotations, and N η to ``by_moments``, shape [n] each.

        The moments are 0 after it, and the field is overwritten.
        """
        near, by_turns = self._near, None
        self._evaluate(by_field)
        launch_add_scaled(self._field, by_moments)
        self._add_turns(1.0, self._field, moments)
        if near is not None:
            near.load_cotangents()
        self._evaluate(moments)
        if near is not None:
            near.load_moments()
            near.launch_field()
            by_turns = self._take_near(near, 1.0, by_positions)
        self._add_turns(1.0, self._field, by_field, by_turns)
        self._clear()

    def _evaluate(self, moments) -> None:
        """Write the corrections of the field of moments."""
        wp.copy(self._vectors, moments)
        self._moments.pack(self._positions, moments)
        self._field.zero_()
        self.add_field()

    def _clear(self) -> None:
        """Set all moments to zero: the linear solve writes the inducible ones alone."""
        self._vectors.zero_()
        self._moments.pack(self._positions, self._vectors)

    def _take_near(self, near: CellPairGradients, factor: float, by_positions) -> wp.array:
        """Add the near cells' gradients by positions, times a factor, and return those by turns of cells."""
        cast(near.arrays.by_positions, self._part)
        launch_add_scaled(self._part, by_positions, factor)
        cast(near.arrays.by_turns, self._part)
        return self._part

    def _add_turns(self, factor: float, field, vectors, by_turns=None) -> None:
        """Add ``factor`` (field × vectors + by_turns), summed over each body, to the gradients by rotations."""
        inputs = [factor, self._ranges, field, vectors, by_turns]
        kernel, device = _kernel(field.dtype._wp_scalar_type_), field.device
        wp.launch(kernel, len(self._ranges), inputs=inputs, outputs=[self.by_rotations], device=device)
