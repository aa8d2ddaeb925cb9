"""Force between two parallel box magnets, exactly: G. Akoun and J.-P. Yonnet, IEEE Trans. Magn. 20 (1984) 1962."""

import itertools
import math

import numpy as np

MU0 = 4e-7 * math.pi
"""Magnetic constant [T·m/A]."""


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
