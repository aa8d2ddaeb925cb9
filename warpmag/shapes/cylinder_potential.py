"""Tables of the potential around uniformly magnetized cylinders, from which a device interpolates potential and field.

The scalar potential of a magnetization M is M·G. With the potentials P of the faces and their normals n, G = Σ n P, as
in ``polyhedra.py``. Around a cylinder of radius R and half height h, G has a component along the axis and a radial one.
Both depend on the distances ρ from the axis and z from the middle. They are integrals over the angle φ around the axis,
with c = cos φ, D² = ρ² + R² − 2 ρ R c, w = z ∓ h and S = √(D² + w²):

    4π G_z = R Σ ± ∫ (R − ρ c) (S − |w|)/D² dφ,    4π G_ρ = −R Σ ± ∫ c arsinh(w/D) dφ.

The first integral contains the boundary terms of ∫ dA/r over the end faces at z = ±h (divergence theorem). The second
is over 1/r along the lines of the curved face. The spacing of nodes grows geometrically away from the rim, where
derivatives of G are infinite. Each node has G, its first derivatives and its mixed derivative. Bicubic Hermite
interpolation (``kernels/applied/cylinder.h``) is then continuous in its first derivatives, so that forces are
derivatives of the energy. The field has a relative error of 1e-4. Nearer to the rim than 1/2000 of the smaller of R and
h, it is 1e-1.
"""

import math
from functools import cache

import numpy as np

_PER_FOLD, _FINEST = 8.0, 16.0
"""κ in the distances s (exp(k/κ) − 1) of the nodes k from the rim; the smaller of R and h over s, about."""
_REACH = 24.0
"""Reach of the table, in multiples of the larger of R and h. A dipole has an error of 1e-3 there."""
_ANGLES, _AT_RIM, _OFF_WALL = 96, 1.0 / 16.0, 1e-3
"""Gauss points of the angle; distances, in node spacings, at which derivatives at the rim and at the wall are taken."""


@cache
def potential_table(radius: float, half_height: float) -> np.ndarray:
    """Return the table of a cylinder along z at the origin, flat, as ``kernels/applied/cylinder.h`` takes it.

    The first ten numbers are R, h [m]; s of :func:`_nodes` for ρ and for z [m]; the numbers of nodes before the rim for
    ρ and for z; the numbers of all nodes of ρ and of z; κ of :func:`_nodes`; reach [m]. Then follow, for G_z and G_ρ,
    at each node (ρ, z): G, ∂G/∂ρ, ∂G/∂z and ∂²G/∂ρ∂z [m], with ρ and z in node spacings.

    Args:
        radius: R [m].
        half_height: h [m].
    """
    finest = min(radius, half_height) / _FINEST
    reach = _REACH * max(radius, half_height)
    (rho, per_rho, *at_rho), (z, per_z, *at_z) = (_nodes(edge, finest, reach) for edge in (radius, half_height))
    inner, below = int(at_rho[1]), int(at_z[1])
    on_rho, on_z = np.meshgrid(rho, z, indexing="ij")
    on_rho[inner:, :below] = np.maximum(on_rho[inner:, :below], radius + _OFF_WALL * per_rho[inner])
    nodes = _potentials(on_rho, on_z, radius, half_height)
    beside, above = np.array(radius + _AT_RIM * per_rho[inner]), np.array(half_height + _AT_RIM * per_z[below])
    nodes[:, 1:, inner, below] = _potentials(beside, above, radius, half_height)[:, 1:]
    nodes[:, 1] *= per_rho[:, None]
    nodes[:, 2] *= per_z
    nodes[:, 3] *= per_rho[:, None] * per_z
    sizes = radius, half_height, at_rho[0], at_z[0], inner, below, len(rho), len(z), _PER_FOLD, reach
    return np.concatenate([sizes, nodes.transpose(0, 2, 3, 1).ravel()])


def _nodes(edge: float, finest: float, reach: float) -> tuple[np.ndarray, np.ndarray, float, int]:
    """Return nodes from 0 on to ``reach`` beyond ``edge`` [m], and spacings there.

    Node k from the edge has the distance s (exp(k/κ) − 1), with κ = :data:`_PER_FOLD`. Also returns s and the number of
    nodes before the edge.
    """
    before = max(1, round(_PER_FOLD * math.log1p(edge / finest)))
    s = edge / math.expm1(before / _PER_FOLD)
    count = np.arange(-before, math.ceil(_PER_FOLD * math.log1p(reach / s)) + 1)
    distance = s * np.expm1(abs(count) / _PER_FOLD)
    nodes = edge + np.sign(count) * distance
    nodes[0] = 0.0
    return nodes, (s + distance) / _PER_FOLD, s, before


def _potentials(rho: np.ndarray, z: np.ndarray, radius: float, half_height: float) -> np.ndarray:
    """Return G_z and G_ρ outside of a cylinder, each with its derivatives by ρ, by z and by both.

    Derivatives by z at an end face are those above it.

    Args:
        rho, z: Distances from the axis and above the middle [m], the same shape.
        radius, half_height: R and h [m].

    Returns:
        G [m], ∂G/∂ρ, ∂G/∂z and ∂²G/∂ρ∂z [1/m], shape [2, 4, ...].
    """
    nodes, weights = np.polynomial.legendre.leggauss(_ANGLES)
    t = 0.5 * (nodes + 1.0)
    angle, weights = np.pi * t**5, 5.0 * np.pi * t**4 * weights  # dense about 0, where D is small; both halves
    c, rho, result = np.cos(angle), rho[..., None], np.zeros((2, 4, *rho.shape))
    d2 = np.maximum((rho - radius) ** 2 + 4.0 * rho * radius * np.sin(0.5 * angle) ** 2, 1e-30 * radius**2)
    out, across = (radius - rho * c) / d2, c * (rho - radius * c)
    for sign, height in ((1.0, z - half_height), (-1.0, z + half_height)):
        w = height[..., None]
        s = np.sqrt(d2 + w * w)
        terms = (
            (out * (s - abs(w)), -c / s, out * (w / s - np.where(w < 0.0, -1.0, 1.0)), c * w / s**3),
            (-c * np.arcsinh(w / np.sqrt(d2)), across * w / (d2 * s), -c / s, across / s**3),
        )
        for component, row in enumerate(terms):
            for k, term in enumerate(row):
                result[component, k] += sign * (term @ weights)
    return radius / (4.0 * np.pi) * result
