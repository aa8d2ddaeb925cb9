"""Charges on a flat face of iron that vary over less than a cell, and their response to a potential.

Cells are uniformly magnetized, and so are the charges of their faces. In front of the edge of a magnet the charge of an
iron face varies over less than a cell. Without that a magnet in contact pulls too little.

A face gets charges q on equal squares besides. Those of an ideally permeable body keep its surface at one potential:
S q + φ = const with the potentials S of uniformly charged squares. The magnetization of the cells has uniform charges,
and keeps the average field of each cell near 0. So φ is the potential less that of the average field, and q = −R φ with
R = Q (Qᵀ S Q)⁻¹ Qᵀ, where the columns of Q span all charges without a sum. The energy is −½ μ0 φᵀ R φ. A body of finite
susceptibility χ responds by χ/(χ + 2) of that, as a half-space does. Charges of different faces do not act on each
other: they fall off fast.

The part of q that varies linearly over a face is too large where the field is smooth. Over an ideal half-space a
potential cos kx at the surface has the charges 2 k cos kx. Along a face of side l they vary by 2 k² l. The cells leave
the potential a slope of k² d/2 of second order, since their average field is that at half their depth d, and R makes it
charges that vary by k² d/(2 c) with c = 0.09. The ratio of both is 4 c l/d = 0.36 l/d. Edges of magnets need up to all
of q. So the linear part of q along a side is multiplied by :data:`_LINEAR` l/d, at most 1.
"""

from functools import cache

import numpy as np

from warpmag.shapes.uniform_response import potentials

_LINEAR = 0.5
"""Share of linear charges for cells that are cubes. For magnets over 10 mm of iron with 700 and 1,800 cells, in contact
and at 1 mm, the errors are then −3 to +3 %. With a share of 0.36 they are −7 to +2 %, and with all linear charges +1 to
+8 %."""
_GAUSS_POINTS = 3
"""Points along each side of a square, over which its potential is averaged."""


@cache
def face_response(sides: tuple[float, float, float], split: int) -> np.ndarray:
    """Return the responses R [m] of the faces of a cuboid across x, y and z, shape [3, split², split²].

    ``sides`` are those of the cuboid [m]. A face has ``split`` squares along each side; the last axis of the
    cuboid comes last.

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
    root = linear * (1.0 - np.sqrt(np.minimum(_LINEAR * sides / depth, 1.0))) @ linear.T
    reduced = np.eye(split**2) - root
    return reduced @ response @ reduced
