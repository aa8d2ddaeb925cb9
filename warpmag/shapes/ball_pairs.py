"""Pair law of two uniformly magnetized balls, from the field of one averaged over the other, in float64.

A moment m at separation r gives the field H = (g1 m + g2 r (r·m)) / 4π. Balls that do not overlap act as point dipoles,
with the potential U = 1/d. Overlapping balls of radii a and b have

    U = 1/d + (a+b−d)⁴ (5a² − 20ab + 5b² − 4(a+b)d − d²) / (160 a³b³d),

and a ball inside a larger ball of radius A has g1 = −1/A³, g2 = 0. The factors are g1 = U'/d and g2 = g1'/d.
``kernels/pairs/pair_law.h`` evaluates the same law on a device.
"""

import numpy as np


def radial_factors(distance: np.ndarray, radius_i: np.ndarray, radius_j: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return the radial factors g1 [1/m³] and g2 [1/m⁵] of the pair law, for distances d and radii [m], broadcast.

    A point has the radius 0. Both factors are 0 for point dipoles at distance 0.
    """
    d, a, b = np.broadcast_arrays(np.asarray(distance, float), np.asarray(radius_i, float), np.asarray(radius_j, float))
    safe = np.where(d > 0.0, d, 1.0)
    g1, g2 = np.where(d > 0.0, -1.0 / safe**3, 0.0), np.where(d > 0.0, 3.0 / safe**5, 0.0)

    inside = (d <= np.abs(a - b)) & (np.maximum(a, b) > 0.0)
    larger = np.where(inside, np.maximum(a, b), 1.0)
    g1, g2 = np.where(inside, -1.0 / larger**3, g1), np.where(inside, 0.0, g2)

    overlap = (d < a + b) & ~inside
    if np.any(overlap):
        g1[overlap], g2[overlap] = _overlap_factors(d[overlap], a[overlap], b[overlap])
    return g1, g2


def _overlap_factors(d, a, b):
    """Return the factors of partially overlapping balls, |a − b| < d < a + b."""
    s, p, delta2 = a + b, a * b, (a - b) ** 2
    c = 1.0 / (160.0 * p**3)
    # Laurent polynomial in d: accurate at small d, where terms of the module's formula cancel
    k = 5.0 * delta2**2 * (delta2 + 6.0 * p)
    u1, u2, u3 = 45.0 * s**2 * delta2, -40.0 * s * (delta2 + p), 15.0 * (delta2 + 2.0 * p)
    g1 = c * (-k / d**3 + u1 / d + 2.0 * u2 + 3.0 * u3 * d - 5.0 * d**3)
    g2 = c * (3.0 * k / d**5 - u1 / d**3 + 3.0 * u3 / d - 15.0 * d)
    # the module's formula: accurate near d = a + b and for very different radii, where terms of the polynomial cancel
    e, q0 = s - d, 5.0 * a**2 - 20.0 * p + 5.0 * b**2
    q, q1, q2 = (6.0 * s * e - 30.0 * p - e**2) / d, -q0 / d**2 - 1.0, 2.0 * q0 / d**3
    w1 = -4.0 * e**3 * q + e**4 * q1
    w2 = 12.0 * e**2 * q - 8.0 * e**3 * q1 + e**4 * q2
    far = d > 0.5 * s
    g1 = np.where(far, -1.0 / d**3 + c * w1 / d, g1)
    g2 = np.where(far, 3.0 / d**5 + c * (w2 / d**2 - w1 / d**3), g2)
    return g1, g2
