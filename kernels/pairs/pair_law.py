"""Pair law of two magnetic moments, each spread over a ball.

A moment m at x_j makes at x_i, with r = x_i − x_j and d = ‖r‖, the field and the field gradient

    H        = (g1 m + g2 r (r·m)) / 4π
    ∂H_k/∂x_l = (g2 [r_k m_l + m_k r_l + δ_kl r·m] + g3 (r·m) r_k r_l) / 4π

with radial factors g1 = U'/d, g2 = g1'/d, g3 = g2'/d of a potential U(d). Three sets of factors are used:

* ``dipole_factors``: the point dipole, U = 1/d (Kim and Han 2022, Eqs. 1 and 14).
* ``averaged_factors``: the field of one uniformly magnetized ball averaged over another that overlaps it. It joins the
  dipole with its first derivative at contact and stays bounded down to coincident centres, and the averaged operator
  is positive, so that induction has one solution for any arrangement of balls.
* ``smoothed_factors``: the paper's smoothing, ε² = ℓ⁵ added to d⁵ (section 5).

The native sums evaluate the dipole with its distance clamped from below to the contact distance a + b; the few pairs
that overlap get the difference, ``overlap_factors`` of ``pair_law.h``, when sums are finished. Both are continuous at
contact, so a pair that two roundings of d put on different sides of it does no harm.

The functions are generic over float32 and float64; averaged factors are those of ``pair_law.h``.
"""

from functools import cache
from typing import Any

import warp as wp

INVERSE_4PI = 0.07957747154594767


@wp.func
def dipole_factors(d2: Any):
    """Factors [g1, g2, g3] of two point dipoles at squared distance ``d2`` [m²]; zero at zero distance."""
    zero = d2 * type(d2)(0.0)
    # masked before the power: a self pair's r⁻⁵ overflows float32
    inverse = wp.where(d2 > zero, type(d2)(1.0) / wp.sqrt(wp.where(d2 > zero, d2, type(d2)(1.0))), zero)
    inverse2 = inverse * inverse
    g1 = -inverse2 * inverse
    g2 = type(d2)(-3.0) * g1 * inverse2
    g3 = type(d2)(-5.0) * g2 * inverse2
    return wp.vector(g1, g2, g3, length=3)


@wp.func
def smoothed_factors(d2: Any, epsilon2: Any):
    """Factors [g1, g2, g3] with ε² [m⁵] added to d⁵ in every denominator; zero at zero distance."""
    zero = d2 * type(d2)(0.0)
    safe = wp.where(d2 > zero, d2, type(d2)(1.0))
    w = wp.where(d2 > zero, type(d2)(1.0) / (safe * safe * wp.sqrt(safe) + epsilon2), zero)
    return wp.vector(-safe * w, type(d2)(3.0) * w, type(d2)(-15.0) * w / safe, length=3)


@cache
def pair_factors(dtype):
    """Warp function (d2, a, b, epsilon2): factors [g1, g2, g3] of balls of radii a, b [m] at squared distance d2 [m²].

    They are averaged where the balls overlap; with an ε² [m⁵] they are smoothed instead.
    """
    vec3 = wp.types.vector(3, dtype)

    @wp.func_native("const auto g = warpmag::averaged_factors(d, a, b); return {g.g1, g.g2, g.g3};")
    def averaged_factors(d: dtype, a: dtype, b: dtype) -> vec3: ...

    @wp.func
    def factors(d2: dtype, a: dtype, b: dtype, epsilon2: dtype):
        if epsilon2 > dtype(0.0):
            return smoothed_factors(d2, epsilon2)
        if d2 < (a + b) * (a + b):
            return averaged_factors(wp.sqrt(d2), a, b)
        return dipole_factors(d2)

    return factors


@wp.func
def field_of(g: Any, r: Any, m: Any):
    """4π times the field [A/m] of moment ``m`` [A·m²] at separation ``r`` [m] for radial factors ``g``."""
    return g[0] * m + (g[1] * wp.dot(r, m)) * r


@wp.func
def force_of(g: Any, r: Any, m: Any, e: Any):
    """4π times (e·∇)H [A²] of moment ``m`` at separation ``r`` for an effective moment ``e`` [A·m²]."""
    rm = wp.dot(r, m)
    re = wp.dot(r, e)
    return g[1] * (re * m + rm * e) + (g[1] * wp.dot(m, e) + g[2] * rm * re) * r
