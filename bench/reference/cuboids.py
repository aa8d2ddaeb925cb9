"""Force between two parallel box magnets, exactly: G. Akoun and J.-P. Yonnet, IEEE Trans. Magn. 20 (1984) 1962."""

import itertools
import math

import numpy as np

MU0 = 4e-7 * math.pi
"""Magnetic constant [T·m/A]."""


CUBE, PLATE, BAR = (1.0, 1.0, 1.0), (1.0, 1.0, 0.2), (0.3, 0.3, 1.0)
"""Half extents of boxes of side 2."""
PAIRS = {
    "cubes in line": (CUBE, CUBE, 2, 0.0),
    "cubes side by side": (CUBE, CUBE, 0, 0.0),
    "plates": (PLATE, PLATE, 2, 0.0),
    "bars": (BAR, BAR, 2, 0.0),
    "cube and plate off axis": (CUBE, PLATE, 2, 0.3),
}
"""Two boxes, the axis along which they are apart, and how far off it the second is, in sides along x."""


def pair(name: str, gap: float, side: float):
    """Half extents [m] of a pair of ``PAIRS``, and the offset of the second box [m], shape [3] each.

    Args:
        name: Which pair.
        gap: Distance between the faces, in sides.
        side: Longest edge of the boxes [m].
    """
    half1, half2, axis, aside = PAIRS[name]
    offset = np.zeros(3)
    offset[0] = aside * side
    offset[axis] = (0.5 * (half1[axis] + half2[axis]) + gap) * side
    return 0.5 * side * np.array(half1), 0.5 * side * np.array(half2), offset


def force(half1, half2, offset, magnetization1: float, magnetization2: float) -> np.ndarray:
    """Force [N] of the first box on the second, both magnetized along z and edges along the axes, shape [3].

    The boxes are charged sheets: each pair of corners adds one term of an integral done in closed form.

    Args:
        half1: Half extents of the first box [m], shape [3].
        half2: Half extents of the second box [m], shape [3].
        offset: Centre of the second seen from the first [m], shape [3]; the boxes are apart.
        magnetization1: Magnetization of the first along z [A/m].
        magnetization2: Magnetization of the second along z [A/m].
    """
    total = np.zeros(3)
    for signs in itertools.product((-1.0, 1.0), repeat=6):
        first, second = np.array(signs[:3]), np.array(signs[3:])
        u, v, w = np.asarray(offset, float) + second * half2 - first * half1
        total += np.prod(signs) * _corner(u, v, w)
    return MU0 * magnetization1 * magnetization2 / (4.0 * math.pi) * total


def _corner(u, v, w) -> np.ndarray:
    r = math.sqrt(u * u + v * v + w * w)
    turn = math.atan2(u * v, r * w)

    def log(x):  # where r = x the product in front is zero
        return math.log(r - x) if r > x else 0.0

    return np.array(
        [
            0.5 * (v * v - w * w) * log(u) + u * v * log(v) + v * w * turn + 0.5 * r * u,
            0.5 * (u * u - w * w) * log(v) + u * v * log(u) + u * w * turn + 0.5 * r * v,
            -u * w * log(u) - v * w * log(v) + u * v * turn - r * w,
        ]
    )
