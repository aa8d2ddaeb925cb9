"""Charges on a flat face of iron that vary over less than a cell, and their response to a potential.

Cells are uniformly magnetized, and so are the charges of their faces. In front of the edge of a magnet the charge of an
iron face varies over less than a cell. Without that a magnet in contact pulls too little.

A face gets charges q on equal squares besides. Those of an ideally permeable body keep its surface at one potential:
S q + φ = const with the potentials S of uniformly charged squares. The magnetization of the cells has uniform charges,
and keeps the average field of each cell near 0. So φ is the potential less that of the average field, and q = −R φ with
R = Q (Qᵀ S Q)⁻¹ Qᵀ, where the columns of Q span all charges without a sum. The energy is −½ μ0 φᵀ R φ. A body of finite
susceptibility χ responds by χ/(χ + 2) of that, as a half-space does. Charges of different faces do not act on each
other: they fall off fast.
"""

from functools import cache

import numpy as np

from warpmag.shapes.uniform_response import potentials

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
    return np.stack([_rectangle_response(np.array([sides[k] for k in axes]), split) for axes in others])


def _rectangle_response(sides: np.ndarray, split: int) -> np.ndarray:
    """Return R [m] of a rectangle with ``sides`` [m], shape [2], on split × split rectangles."""
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
    return other @ np.linalg.solve(other.T @ self_potential @ other, other.T)
