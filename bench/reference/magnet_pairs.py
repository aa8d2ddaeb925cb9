"""Forces between two permanent magnets in closed form.

Parallel boxes: G. Akoun and J.-P. Yonnet, IEEE Trans. Magn. 20 (1984) 1962. Coaxial cylinders: D. Vokoun et al.,
J. Magn. Magn. Mater. 321 (2009) 3758.
"""

import itertools
import math

import numpy as np
from scipy.integrate import quad
from scipy.special import j1

from bench.reference.oracle import MU0

CUBE, PLATE, BAR = (1.0, 1.0, 1.0), (1.0, 1.0, 0.2), (0.3, 0.3, 1.0)  # half extents of boxes of side 2
PAIRS = {
    "cubes in line": (CUBE, CUBE, 2, 0.0),
    "cubes side by side": (CUBE, CUBE, 0, 0.0),
    "plates": (PLATE, PLATE, 2, 0.0),
    "bars": (BAR, BAR, 2, 0.0),
    "cube and plate off axis": (CUBE, PLATE, 2, 0.3),
}
"""Two boxes, the axis of their gap, and the offset of the second box along x in sides."""


def box_pair(name: str, gap: float, side: float):
    """Half extents [m] of the two boxes of a pair of ``PAIRS``, and offset of the second box [m], shape [3] each.

    ``gap`` is the distance between the faces over ``side``, the longest edge of the boxes [m].
    """
    half1, half2, axis, lateral = PAIRS[name]
    offset = np.zeros(3)
    offset[0] = lateral * side
    offset[axis] = (0.5 * (half1[axis] + half2[axis]) + gap) * side
    return 0.5 * side * np.array(half1), 0.5 * side * np.array(half2), offset


def box_force(half1, half2, offset, magnetization1: float, magnetization2: float) -> np.ndarray:
    """Force [N] of the first box on the second, both magnetized along z, edges along the axes, shape [3].

    The boxes are charged sheets: each pair of corners adds one term of an integral in closed form.

    Args:
        half1, half2: Half extents of the boxes [m], shape [3].
        offset: Center of the second box relative to the first [m], shape [3]; the boxes do not overlap.
        magnetization1, magnetization2: Magnetizations along z [A/m].
    """
    total = np.zeros(3)
    for signs in itertools.product((-1.0, 1.0), repeat=6):
        first, second = np.array(signs[:3]), np.array(signs[3:])
        u, v, w = np.asarray(offset, float) + second * half2 - first * half1
        total += np.prod(signs) * _corner(u, v, w)
    return MU0 * magnetization1 * magnetization2 / (4.0 * math.pi) * total


def _corner(u, v, w) -> np.ndarray:
    r = math.sqrt(u * u + v * v + w * w)
    angle = math.atan2(u * v, r * w)

    def log(x):  # where r = x the factor of the logarithm is zero
        return math.log(r - x) if r > x else 0.0

    x = 0.5 * (v * v - w * w) * log(u) + u * v * log(v) + v * w * angle + 0.5 * r * u
    y = 0.5 * (u * u - w * w) * log(v) + u * v * log(u) + u * w * angle + 0.5 * r * v
    return np.array([x, y, -u * w * log(u) - v * w * log(v) + u * v * angle - r * w])


def cylinder_force(radius, height1, height2, gap, magnetization1: float, magnetization2: float) -> float:
    """Force [N] along the axis on the upper of two coaxial cylinders of equal radius, magnetized along the axis.

    Only the ends are charged. A charged disc has the spectrum 2πR J1(kR)/k, and the pairs of ends add up to

        F = −π μ0 M1 M2 R² ∫ J1(q)²/q · (1 − exp(−q h1/R)) (1 − exp(−q h2/R)) exp(−q g/R) dq.

    Args:
        radius: Radius of both cylinders [m].
        height1, height2: Heights of the lower and of the upper cylinder [m].
        gap: Gap between the cylinders [m]; zero in contact.
        magnetization1, magnetization2: Magnetizations along the axis [A/m].
    """

    def spectrum(q):
        ends = math.expm1(-q * height1 / radius) * math.expm1(-q * height2 / radius)
        return j1(q) ** 2 / q * ends * math.exp(-q * gap / radius)

    last = 2000.0  # beyond it the mean of J1² is 1/(πq), and only contact contributes
    pieces = [quad(spectrum, a, b, limit=400)[0] for a, b in zip((0.0, 20.0, 200.0), (20.0, 200.0, last), strict=True)]
    tail = math.exp(-last * gap / radius) / (math.pi * last) if gap == 0.0 else 0.0
    return -math.pi * MU0 * magnetization1 * magnetization2 * radius**2 * (sum(pieces) + tail)
