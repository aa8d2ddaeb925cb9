"""Reference of an inducible ball in the uneven field of permanent moments, in float64 with NumPy.

``warpmag.kernels.near_contact.uneven`` has the model. Tests compare the device with it.
"""

import numpy as np

from bench.reference import oracle
from bench.reference.near_contact import smoothstep
from warpmag.kernels.near_contact.contact_table import (
    CELL_DEPTH,
    CELL_SIZE,
    LEAST_MAGNET,
    MAGNET_OVERLAP,
    MAGNET_REACH,
)


def weight(distance, radius, its_radius, alone):
    """Factor by which permanent moments take part in the multipoles of a ball, at distances [m], shape [n]."""
    rho, its = distance / radius, its_radius / radius
    depth = np.maximum(np.where(alone, its, CELL_DEPTH * its), LEAST_MAGNET)
    far = smoothstep((MAGNET_REACH[1] - rho) / (MAGNET_REACH[1] - MAGNET_REACH[0]))[0]
    shallow, deep = MAGNET_OVERLAP
    near = smoothstep((rho - 1.0 - (1.0 - deep) * depth) / ((deep - shallow) * depth))[0]
    coarse = smoothstep((its - CELL_SIZE[0]) / (CELL_SIZE[1] - CELL_SIZE[0]))[0]
    return far * near * np.where(alone, 1.0, 1.0 - coarse)


def energy(center, radius, susceptibility, positions, radii, moments, alone):
    """Energy [J] of what the multipoles of degree 2 and more of an inducible ball add, by Legendre's polynomials.

    Args:
        center: The ball's centre [m], shape [3].
        radius: Its radius [m].
        susceptibility: Its χ, may be infinite.
        positions: Places of the permanent moments [m], shape [n, 3].
        radii: Radii of their balls [m], shape [n].
        moments: Moments [A·m²], shape [n, 3].
        alone: Whether each is alone on its body, shape [n].
    """
    s = (np.asarray(positions, float) - center) / radius
    d = np.linalg.norm(s, axis=1)
    w = weight(d * radius, radius, np.asarray(radii, float), np.asarray(alone, bool))
    u, m = s / d[:, None], w[:, None] * np.asarray(moments, float) / radius**3
    c, among = u @ u.T, m @ m.T
    a, b = np.sum(u * m, axis=1), u @ m.T  # b[i, j] = u_i·m_j
    q = b.T - c * a[:, None]  # what moment i has across u_i along u_j
    total = 0.0

    def response(degree):
        return degree / (degree + (2.0 * degree + 1.0) / susceptibility)

    for degree in (2, 3, 4):
        p, slope, curve = (np.polynomial.legendre.Legendre.basis(degree).deriv(k)(c) for k in (0, 1, 2))
        k = degree + 1.0
        # (m_i·∇_i)(m_j·∇_j) P(c)/(d_i d_j)^(l+1)
        mixed = k * k * np.outer(a, a) * p - k * (a[None] * q + a[:, None] * q.T) * slope + q * q.T * curve
        mixed += (among - a[:, None] * b - q * a[None]) * slope
        total += response(degree) * np.sum(mixed / np.outer(d, d) ** (degree + 2.0))
    degree = np.arange(5, 400)[:, None]
    own = (degree + 1.0) ** 2 * a**2 + 0.5 * degree * (degree + 1.0) * (np.sum(m * m, axis=1) - a**2)
    total += response(6.0) * np.sum((own * d ** (-2.0 * degree - 4.0))[:, alone])
    return -0.5 * oracle.MU0 / (4.0 * np.pi) * radius**3 * total
