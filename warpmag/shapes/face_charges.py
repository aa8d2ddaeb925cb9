"""Charges on a flat face of iron that vary over less than a cell, and their response to a potential.

Cells are uniformly magnetized, so the charges of their faces are uniform. In front of the edge of a magnet the charge
of an iron face varies over less than a cell. Without this variation a magnet in contact pulls too weakly.

A face therefore has additional charges q on equal squares. The charges of an ideally permeable body keep its surface at
one potential: S q + φ = const with the potentials S of uniformly charged squares. The magnetization of the cells has
uniform charges, and keeps the average field of each cell near 0. So φ is the potential minus that of the average field,
and q = −R φ with R = Q (Qᵀ S Q)⁻¹ Qᵀ, where the columns of Q span all charges whose sum is 0. The energy is
−½ μ0 φᵀ R φ. For a body of finite susceptibility χ, R is multiplied by χ/(χ + 2), as for a half-space. Charges of
different faces do not act on each other, because their fields fall off fast.

The part of q that varies linearly over a face is too large where the field is smooth. Over an ideal half-space a
potential cos kx at the surface induces the charges 2 k cos kx. Along a face of side l they vary by up to 2 k² l. The
average field of a cell is the field at half its depth d. After it is subtracted, φ has a slope of up to k² d/2, to
second order in k. R turns this slope into charges that vary by k² d/(2 c), with c = 0.09 for a square. The exact
charges are 4 c l/d = 0.36 l/d times the charges from R. Near edges of magnets, up to the whole linear part is needed.
So the linear part of q along a side is multiplied by :data:`_LINEAR` l/d, at most 1.
"""

from functools import cache

import numpy as np

from warpmag.shapes.uniform_response import potentials

_LINEAR = 0.5
"""Factor of the linear charges of cubic cells. For magnets over 10 mm of iron with 700 and 1,800 cells, in contact and
at 1 mm, errors of the force are −3 to +3 %. With a factor of 0.36 they are −7 to +2 %, and with a factor of 1 they are
+1 to +8 %."""
_GAUSS_POINTS = 3
"""Points along each side of a square, over which its potential is averaged."""


@cache
def face_response(sides: tuple[float, float, float], split: int) -> np.ndarray:
    """Return the responses R [m] of a cuboid's faces normal to x, y and z, shape [3, split², split²].

    ``sides`` are the sides of the cuboid [m]. A face has ``split`` rectangles along each side. Of the two axes of a
    face the later one varies fastest.

    Example:
        >>> face_response((0.004, 0.004, 0.002), 4).shape
        (3, 16, 16)
    """
    others = (1, 2), (0, 2), (0, 1)
    lengths = np.array(sides)
    return np.stack([_rectangle_response(lengths[list(axes)], lengths[k], split) for k, axes in enumerate(others)])


def _rectangle_response(sides: np.ndarray, depth: float, split: int) -> np.ndarray:
    """Return R [m] of a face with ``sides`` [m], shape [2], of a cell of a depth [m], on split × split rectangles."""
    step = sides / split
    middles = [(np.arange(split) + 0.5) / split - 0.5 for _ in range(2)]
    unit = np.stack(np.meshgrid(*middles, indexing="ij"), axis=-1).reshape(-1, 2)
    corners = np.array([[-0.5, -0.5], [0.5, -0.5], [0.5, 0.5], [-0.5, 0.5]]) * step
    squares = np.pad((unit * sides)[:, None] + corners, ((0, 0), (0, 0), (0, 1)))
    nodes, weights = np.polynomial.legendre.leggauss(_GAUSS_POINTS)
    inner = 0.5 * np.stack(np.meshgrid(nodes, nodes, indexing="ij"), axis=-1).reshape(-1, 2) * step
    points = np.pad(((unit * sides)[:, None] + inner).reshape(-1, 2), ((0, 0), (0, 1)))
    at_points = potentials(points, squares).reshape(split**2, len(inner), -1) / step.prod()
    self_potential = np.einsum("ipj,p->ij", at_points, 0.25 * np.outer(weights, weights).ravel())
    self_potential = 0.5 * (self_potential + self_potential.T)
    other = np.linalg.svd(np.ones((len(unit), 1)))[0][:, 1:]
    response = other @ np.linalg.solve(other.T @ self_potential @ other, other.T)
    linear = unit / np.linalg.norm(unit, axis=0)
    removed = 1.0 - np.sqrt(np.minimum(_LINEAR * sides / depth, 1.0))
    reduction = np.eye(split**2) - linear * removed @ linear.T
    return reduction @ response @ reduction
