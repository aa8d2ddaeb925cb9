"""Gradients of a function of the field between the cells of a body, by the body's rotation.

The corrections N of ``cells.couplings`` are constant in the body's frame. With the cotangents η of the cells' fields,
a small turn δ of the body changes η·N m by δ·Σ_i ((N m)_i × η_i + (N η)_i × m_i), since N is symmetric.
"""

from functools import cache

import numpy as np
import warp as wp

from warpmag.kernels.cells.couplings import CellCouplings
from warpmag.kernels.shared.axpy import launch_add_scaled


@cache
def _kernel(dtype):
    vec3 = wp.types.vector(3, dtype)

    @wp.kernel(module="unique", enable_backward=False)
    def add_turns(
        ranges: wp.array[wp.vec2i], field: wp.array[vec3], vectors: wp.array[vec3], by_rotations: wp.array[vec3]
    ):
        body = wp.tid()
        total = vec3()
        for i in range(ranges[body][0], ranges[body][1]):
            total += wp.cross(field[i], vectors[i])
        by_rotations[body] = by_rotations[body] + total

    return add_turns


class CellTurns:
    """Field of the corrections between cells, and gradients by rotations, repeatedly in the same arrays.

    Args:
        couplings: First moment and coupling of each body, as ``CellCouplings`` takes them.
        vectors: Moments whose field is added [A·m²], shape [n].
        field: Field that is added to [A/m], shape [n].

    Attributes:
        rotations: Rotation of each body's frame to the world; written by the caller, shape [bodies].
        by_rotations: Gradient by small turns of each body, in the world's frame, after :meth:`turn`, shape [bodies].
    """

    def __init__(self, couplings, vectors, field):
        """Lay out the tables."""
        self._cells, self._vectors, self._field = CellCouplings(couplings, vectors, field), vectors, field
        self.rotations = self._cells.rotations
        ranges = [(first, first + len(coupling.start) - 1) for first, coupling in couplings]
        self._ranges = wp.array(np.array(ranges, np.int32), dtype=wp.vec2i, device=field.device)
        self.by_rotations = wp.zeros(len(ranges), dtype=field.dtype, device=field.device)

    def add_field(self) -> None:
        """Add the corrections to the field."""
        self._cells.launch()

    def turn(self, moments, by_field, by_moments) -> None:
        """Write ``by_rotations`` from the moments m [A·m²] and η, and add N η to ``by_moments``, shape [n] each.

        The vectors and the field are overwritten.
        """
        self.by_rotations.zero_()
        for acting, other in ((by_field, moments), (moments, by_field)):
            wp.copy(self._vectors, acting)
            self._field.zero_()
            self.add_field()
            inputs = [self._ranges, self._field, other]
            kernel, count = _kernel(self._field.dtype._wp_scalar_type_), len(self._ranges)
            wp.launch(kernel, count, inputs=inputs, outputs=[self.by_rotations], device=self._field.device)
            if acting is by_field:
                launch_add_scaled(self._field, by_moments)
