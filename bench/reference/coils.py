"""Reference fields of coils in plain NumPy, float64: the law of Biot and Savart summed along the wire.

Independent of the closed forms of ``warpmag.kernels.applied``. Loops use the trapezoidal rule, which converges
exponentially for them; solenoids and straight pieces use Gauss-Legendre quadrature. Points must not be on the wire.
"""

import numpy as np


def wire_field(centers, steps, points):
    """Field H [A/m], shape [p, 3], of short pieces of wire that carry one ampere, ∫ dl × r / (4π r³).

    ``centers`` and ``steps`` are the centers of the pieces and their vectors along the current [m], shape [k, 3].
    """
    r = np.asarray(points, float)[:, None] - centers
    return (np.cross(steps, r) / (4.0 * np.pi * np.linalg.norm(r, axis=2)[..., None] ** 3)).sum(axis=1)


def loop_field(radius, points, *, height=0.0, count=2000):
    """Field [A/m], shape [p, 3], of a loop of one ampere about the z axis, made of ``count`` pieces."""
    angle = 2.0 * np.pi * np.arange(count) / count
    centers = np.stack([radius * np.cos(angle), radius * np.sin(angle), np.full(count, height)], axis=1)
    steps = 2.0 * np.pi * radius / count * np.stack([-np.sin(angle), np.cos(angle), np.zeros(count)], axis=1)
    return wire_field(centers, steps, points)


def solenoid_field(radius, length, points, *, count=600, loops=60):
    """Field [A/m], shape [p, 3], of a solenoid of one ampere-turn about the z axis, made of ``loops`` loops."""
    nodes, weights = np.polynomial.legendre.leggauss(loops)
    heights = 0.5 * length * nodes
    parts = zip(weights, heights, strict=True)
    return sum(0.5 * weight * loop_field(radius, points, height=height, count=count) for weight, height in parts)


def polyline_field(corners, points, *, count=80):
    """Field [A/m], shape [p, 3], of straight pieces of wire of one ampere between ``corners`` [m], shape [k, 3]."""
    nodes, weights = np.polynomial.legendre.leggauss(count)
    start, along = corners[:-1, None], np.diff(corners, axis=0)[:, None]
    centers = start + 0.5 * (1.0 + nodes[:, None]) * along
    return wire_field(centers.reshape(-1, 3), (0.5 * weights[:, None] * along).reshape(-1, 3), points)
