"""An iron ball in an uneven field, exactly: image charges, and multipoles by quadrature, in float64 with NumPy.

Nothing else responds: the field is that of permanent magnets. Each multipole of the applied potential, of degree l,
leaves a charge on the ball's surface

    σ_l = p_l (2l + 1)/l H_r,l,    p_l = lχ/(lχ + 2l + 1),

H_r,l the part of degree l of the applied field's radial component, and the force is F = μ0 ∮ σ H dS. In an ideally
permeable ball a point charge q at distance s has the images −qR/s at R²/s and qR/s in the centre. Reference: Jackson,
Classical Electrodynamics, 3rd ed., sections 2.2 and 4.4.
"""

import itertools

import numpy as np
from scipy.special import sph_harm_y

MU0 = 4e-7 * np.pi
"""Vacuum permeability [T·m/A]."""


def image_force(places, charges, radius: float) -> np.ndarray:
    """Force [N] on an ideally permeable ball at the origin by point charges, shape [3].

    Args:
        places: Places of the charges outside the ball [m], shape [n, 3].
        charges: Magnetic charges [A·m], shape [n]; a dipole is two of them.
        radius: Radius of the ball [m].
    """
    x, q = np.asarray(places, float), np.asarray(charges, float)
    s = np.linalg.norm(x, axis=1)
    at = np.concatenate([x * (radius / s)[:, None] ** 2, np.zeros_like(x)])
    images = np.concatenate([-q * radius / s, q * radius / s])
    r = at[:, None] - x[None]
    field = np.einsum("n,inc->ic", q, r / np.linalg.norm(r, axis=2)[..., None] ** 3) / (4.0 * np.pi)
    return MU0 * images @ field


def dipole_charges(place, moment, size: float):
    """Places and charges of a moment [A·m²], two charges ``size`` [m] apart."""
    along = np.asarray(moment, float) / np.linalg.norm(moment)
    q = np.linalg.norm(moment) / size
    return np.stack([place + 0.5 * size * along, place - 0.5 * size * along]), np.array([q, -q])


def dipole_pull(distance, radius: float, susceptibility: float, along: bool, order=400) -> float:
    """Pull [N] of a unit moment [A·m²] on a ball at a distance [m], summed over degrees.

    Args:
        distance: From the ball's centre [m].
        radius: The ball's [m].
        susceptibility: Its χ, may be infinite.
        along: Whether the moment points to the ball; else it is across.
        order: Highest degree.
    """
    degree = np.arange(1, order + 1)
    response = degree / (degree + (2.0 * degree + 1.0) / susceptibility)
    weight = (degree + 1.0) ** 2 if along else 0.5 * degree * (degree + 1.0)
    energy = -0.5 * MU0 / (4.0 * np.pi) / radius**3 * response * weight * (radius / distance) ** (2.0 * degree + 4.0)
    return float(np.sum(-energy * (2.0 * degree + 4.0)) / distance)


def force_in_field(field, center, radius: float, susceptibility=np.inf, order=40) -> np.ndarray:
    """Force [N] on a ball in the field of magnets outside of it, shape [3].

    Args:
        field: Function of points [m], shape [p, 3], that returns H [A/m], same shape.
        center: Centre of the ball [m], shape [3].
        radius: Its radius [m].
        susceptibility: Its χ, may be infinite.
        order: Highest degree.
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
        response = degree / (degree + (2.0 * degree + 1.0) / susceptibility)
        for m in range(-degree, degree + 1):
            harmonic = sph_harm_y(degree, m, polar, azimuth)
            charge += response * (2.0 + 1.0 / degree) * ((radial @ harmonic.conj()) * harmonic).real
    return MU0 * radius**2 * (weights * charge) @ h


def box_field(points, half, magnetization: float) -> np.ndarray:
    """Field H [A/m] outside of a box magnetized along z, centred, edges along the axes (Akoun and Yonnet 1984).

    Args:
        points: Places [m], shape [p, 3].
        half: Half extents [m], shape [3].
        magnetization: Along z [A/m].
    """
    total = np.zeros_like(points)
    for corner in itertools.product((-1.0, 1.0), repeat=3):
        x, y, z = (points - np.array(corner) * half).T
        r = np.sqrt(x * x + y * y + z * z)
        total += np.prod(corner) * np.stack([np.log(r - y), np.log(r - x), np.arctan2(x * y, z * r)], 1)
    return magnetization / (4.0 * np.pi) * total
