"""An inducible ball in the non-uniform field of permanent magnets, in float64 with NumPy: exact and model solutions.

Exact: no other body responds. The applied potential of degree l induces on the ball's surface the charge

    σ_l = p_l (2l + 1)/l H_r,l,    p_l = lχ/(lχ + 2l + 1),

with H_r,l the part of degree l of the applied field's radial component. The force is F = μ0 ∮ σ H dS. In a ball of
infinite permeability a point charge q at distance s has the images −qR/s at R²/s and qR/s in the center. Reference:
Jackson, Classical Electrodynamics, 3rd ed., sections 2.2 and 4.4.

Modeled: :func:`model_energy` is the energy that ``warpmag.kernels.near_contact`` adds for such a ball.
"""

import itertools

import numpy as np
from scipy.special import sph_harm_y

from bench.reference.near_contact import ramp, smoothstep
from bench.reference.oracle import MU0
from warpmag.kernels.near_contact.contact_table import CELL_DEPTH, CELL_SIZE, LEAST_MAGNET, MAGNET_OVERLAP, MAGNET_REACH


def image_force(positions, charges, radius: float) -> np.ndarray:
    """Force [N] on a ball of infinite permeability at the origin, shape [3].

    ``charges`` are magnetic charges [A·m] at ``positions`` outside the ball [m], shape [n, 3]; a dipole is two of them.
    """
    x, q = np.asarray(positions, float), np.asarray(charges, float)
    s = np.linalg.norm(x, axis=1)
    sites = np.concatenate([x * (radius / s)[:, None] ** 2, np.zeros_like(x)])
    images = np.concatenate([-q * radius / s, q * radius / s])
    r = sites[:, None] - x[None]
    field = np.einsum("n,inc->ic", q, r / np.linalg.norm(r, axis=2)[..., None] ** 3) / (4.0 * np.pi)
    return MU0 * images @ field


def dipole_charges(position, moment, distance: float):
    """Positions [m] and values [A·m] of two charges at a ``distance`` [m] that make a moment [A·m²]."""
    along = np.asarray(moment, float) / np.linalg.norm(moment)
    q = np.linalg.norm(moment) / distance
    return np.stack([position + 0.5 * distance * along, position - 0.5 * distance * along]), np.array([q, -q])


def dipole_pull(distance, radius: float, susceptibility: float, along: bool, order=400) -> float:
    """Attraction [N] of a ball by a unit moment [A·m²] at a ``distance`` from its center [m], summed over degrees.

    The moment points to the ball if ``along``, else it is perpendicular to this direction. χ may be infinite; ``order``
    is the highest degree.
    """
    degree = np.arange(1, order + 1)
    weight = (degree + 1.0) ** 2 if along else 0.5 * degree * (degree + 1.0)
    energy = -0.5 * MU0 / (4.0 * np.pi) / radius**3 * _response(degree, susceptibility) * weight
    energy = energy * (radius / distance) ** (2.0 * degree + 4.0)
    return float(np.sum(-energy * (2.0 * degree + 4.0)) / distance)


def force_in_field(field, center, radius: float, susceptibility=np.inf, order=40) -> np.ndarray:
    """Force [N] on a ball in the field of magnets outside of it, shape [3].

    ``field`` returns H [A/m] at points [m], shape [p, 3]. χ may be infinite; ``order`` is the highest degree.
    """
    nodes, weights = np.polynomial.legendre.leggauss(order + 16)
    count = 2 * order + 32
    polar, azimuth = np.repeat(np.arccos(nodes), count), np.tile(np.arange(count) * 2.0 * np.pi / count, len(nodes))
    normals = np.stack([np.sin(polar) * np.cos(azimuth), np.sin(polar) * np.sin(azimuth), np.cos(polar)], 1)
    weights = np.repeat(weights, count) * 2.0 * np.pi / count
    h = field(center + radius * normals)
    radial = np.sum(h * normals, axis=1) * weights
    charge = np.zeros(len(normals))
    for degree in range(1, order + 1):
        response = _response(degree, susceptibility) * (2.0 + 1.0 / degree)
        for m in range(-degree, degree + 1):
            harmonic = sph_harm_y(degree, m, polar, azimuth)
            charge += response * ((radial @ harmonic.conj()) * harmonic).real
    return MU0 * radius**2 * (weights * charge) @ h


def box_field(points, half, magnetization: float) -> np.ndarray:
    """Field H [A/m] at points [m], shape [p, 3], outside a centered box magnetized along z (Akoun and Yonnet 1984).

    The edges are along the axes; ``half`` are the half extents [m], shape [3].
    """
    total = np.zeros_like(points)
    for corner in itertools.product((-1.0, 1.0), repeat=3):
        x, y, z = (points - np.array(corner) * half).T
        r = np.sqrt(x * x + y * y + z * z)
        total += np.prod(corner) * np.stack([np.log(r - y), np.log(r - x), np.arctan2(x * y, z * r)], 1)
    return magnetization / (4.0 * np.pi) * total


def _response(degree, susceptibility):
    """p_l of degree l: 1 for infinite χ."""
    return degree / (degree + (2.0 * degree + 1.0) / susceptibility)


# ---------- The model of the near-contact kernels ----------


def model_weight(distance, radius, magnet_radius, alone):
    """Weight of permanent moments at distances [m] in the multipoles of a ball, shape [n]."""
    rho, size = distance / radius, magnet_radius / radius
    depth = np.maximum(np.where(alone, size, CELL_DEPTH * size), LEAST_MAGNET)
    far = smoothstep((MAGNET_REACH[1] - rho) / (MAGNET_REACH[1] - MAGNET_REACH[0]))[0]
    shallow, deep = MAGNET_OVERLAP
    near = smoothstep((rho - 1.0 - (1.0 - deep) * depth) / ((deep - shallow) * depth))[0]
    return far * near * np.where(alone, 1.0, 1.0 - ramp(size, CELL_SIZE))


def model_energy(center, radius, susceptibility, positions, radii, moments, alone):
    """Energy [J] of the multipoles of degree 2 and more of an inducible ball, by Legendre polynomials.

    ``positions`` [m], ``radii`` [m] and ``moments`` [A·m²] are those of n permanent moments; ``alone`` is true for each
    moment that is the only one of its body.
    """
    s = (np.asarray(positions, float) - center) / radius
    d = np.linalg.norm(s, axis=1)
    w = model_weight(d * radius, radius, np.asarray(radii, float), np.asarray(alone, bool))
    u, m = s / d[:, None], w[:, None] * np.asarray(moments, float) / radius**3
    c, products = u @ u.T, m @ m.T
    a, b = np.sum(u * m, axis=1), u @ m.T  # b[i, j] = u_i·m_j
    q = b.T - c * a[:, None]  # component along u_j of the part of moment i perpendicular to u_i
    total = 0.0
    for degree in (2, 3, 4):
        p, slope, curve = (np.polynomial.legendre.Legendre.basis(degree).deriv(k)(c) for k in (0, 1, 2))
        k = degree + 1.0
        # (m_i·∇_i)(m_j·∇_j) P(c)/(d_i d_j)^(l+1)
        mixed = k * k * np.outer(a, a) * p - k * (a[None] * q + a[:, None] * q.T) * slope + q * q.T * curve
        mixed += (products - a[:, None] * b - q * a[None]) * slope
        total += _response(degree, susceptibility) * np.sum(mixed / np.outer(d, d) ** (degree + 2.0))
    degree = np.arange(5, 400)[:, None]
    single = (degree + 1.0) ** 2 * a**2 + 0.5 * degree * (degree + 1.0) * (np.sum(m * m, axis=1) - a**2)
    total += _response(6.0, susceptibility) * np.sum((single * d ** (-2.0 * degree - 4.0))[:, alone])
    return -0.5 * MU0 / (4.0 * np.pi) * radius**3 * total
