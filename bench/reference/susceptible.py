"""Moments of boxes and cylinders of any susceptibility from a surface integral equation, for ``bench.reference.table``.

With M = −∇w inside, w over the susceptibility is the total potential, and w solves on the surface
(1/χ + 1/2) w − (1/4π) ∫ w dΩ = H0·x, dΩ the solid angle of dA; the moment is ∫ w n dA. w is taken as constant on
rectangles (``boxes.py``), whose solid angles are known, or on rings (``cylinders.py``), by its values at their centres.
The error goes as one over the square of their number along a side, which two of them extrapolate: to 0.3 %, against
the two other references and with twice as many.
"""

import numpy as np

from bench.reference import boxes, cylinders


def box(sides, susceptibilities, rectangles=(10, 15)) -> np.ndarray:
    """Moment over V H0 along each axis of a box of given ``sides``, shape [susceptibilities, 3]."""
    return _extrapolated(lambda count: _box(sides, susceptibilities, count), rectangles)


def cylinder(length: float, susceptibilities, rings=(20, 30)) -> np.ndarray:
    """The same along the axis and across it of a cylinder of unit diameter, shape [susceptibilities, 2]."""
    return _extrapolated(lambda count: _cylinder(length, susceptibilities, count), rings)


def _extrapolated(moments, counts) -> np.ndarray:
    coarse, fine = map(moments, counts)
    return fine + (fine - coarse) / ((counts[1] / counts[0]) ** 2 - 1.0)


def _box(sides, susceptibilities, count: int) -> np.ndarray:
    lower, upper, axis = boxes.faces_of_eighth(0.5 * np.asarray(sides, float), count)
    centre, size = 0.5 * (lower + upper), upper - lower
    area = np.prod(np.where(np.arange(3) == axis[:, None], 1.0, size), axis=1)
    found = np.empty((len(susceptibilities), 3))
    for along in range(3):
        angles = np.zeros((len(axis), len(axis)))
        for mirror in np.ndindex(2, 2, 2):
            signs = 1.0 - 2.0 * np.array(mirror)
            angles += signs[along] * _solid_angles(centre * signs, lower, upper, axis)
        for k, w in enumerate(_solved(angles, centre[:, along], susceptibilities)):
            found[k, along] = 8.0 * (w * area)[axis == along].sum() / np.prod(sides)
    return found


def _solved(angles, values, susceptibilities):
    one = np.eye(len(values))
    return [np.linalg.solve((1.0 / chi + 0.5) * one - angles / (4.0 * np.pi), values) for chi in susceptibilities]


def _solid_angles(points, lower, upper, axes) -> np.ndarray:
    """Of each rectangle from each point, positive from below, shape [points, rectangles]."""
    result = np.empty((len(points), len(axes)))
    for axis in range(3):
        which, (a, b) = np.flatnonzero(axes == axis), ((axis + 1) % 3, (axis + 2) % 3)
        z = lower[None, which, axis] - points[:, None, axis]
        total, safe = np.zeros_like(z), np.where(z == 0.0, 1.0, z)
        for i, j in np.ndindex(2, 2):
            x = (upper if i else lower)[None, which, a] - points[:, None, a]
            y = (upper if j else lower)[None, which, b] - points[:, None, b]
            total += (1.0 if i == j else -1.0) * np.arctan(x * y / (safe * np.sqrt(x * x + y * y + z * z)))
        result[:, which] = np.where(z == 0.0, 0.0, total)
    return result


def _cylinder(length: float, susceptibilities, count: int) -> np.ndarray:
    lower, upper = cylinders.rings_of(length, count)
    middle, width = 0.5 * (lower + upper), np.linalg.norm(upper - lower, axis=1)
    normals = np.repeat(np.eye(2), count, axis=0)
    found = np.empty((len(susceptibilities), 2))
    for mode, sign, values in ((0, -1.0, middle[:, 1]), (1, 1.0, middle[:, 0])):
        angles = _ring_angles(middle, lower, upper, normals, mode)
        angles += sign * _ring_angles(middle * [1, -1], lower, upper, normals, mode)
        part = slice(count, None) if mode == 0 else slice(None, count)  # caps, or the side
        around = 2.0 * np.pi if mode == 0 else np.pi
        for k, w in enumerate(_solved(angles, values, susceptibilities)):
            found[k, mode] = 2.0 * around * (w * middle[:, 0] * width)[part].sum() / (0.25 * np.pi * length)
    return found


def _ring_angles(points, lower, upper, normals, mode: int) -> np.ndarray:
    """∫ cos(mode φ) dΩ of each ring from each point, at azimuth 0, shape [points, rings]."""
    result = np.empty((len(points), len(lower)))
    for k, (a, b) in enumerate(zip(lower, upper, strict=True)):
        total = 0.0
        for y, weights in cylinders.nodes_on(points, a, b):
            values = y[..., 0] * _around(points[:, None], y, normals[k], mode)
            total = total + (np.where(np.isfinite(values), values, 0.0) * weights).sum(axis=1)
        result[:, k] = total
    return result


def _around(x, y, normal, mode: int) -> np.ndarray:
    """∫ cos(mode φ) n·(y − x)/‖x − y‖³ dφ over a circle through y, from complete elliptic integrals."""
    rho, other, height = x[..., 0], y[..., 0], y[..., 1] - x[..., 1]
    far2 = (rho + other) ** 2 + height**2
    rest = ((rho - other) ** 2 + height**2) / far2  # 1 − k²
    k2 = np.maximum(4.0 * rho * other / far2, np.finfo(float).tiny)
    first, second = cylinders.elliptic(rest)
    d_first, d_second = (second / rest - first) / (2.0 * k2), (second - first) / (2.0 * k2)
    g, dg = 4.0 * first, 4.0 * d_first
    if mode == 1:
        g = 4.0 * ((2.0 / k2 - 1.0) * first - 2.0 / k2 * second)
        dg = 4.0 * ((2.0 / k2 - 1.0) * d_first - 2.0 / k2 * d_second + 2.0 / k2**2 * (second - first))
    total = 0.0
    for n, d_far2, d_k2 in (
        (normal[0], 2.0 * (rho + other), 4.0 * rho / far2 - 2.0 * k2 * (rho + other) / far2),
        (normal[1], 2.0 * height, -2.0 * k2 * height / far2),
    ):
        total = total - n * (dg * d_k2 - 0.5 * g * d_far2 / far2) / np.sqrt(far2)
    return total
