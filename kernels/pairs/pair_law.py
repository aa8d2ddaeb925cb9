"""Pair law of two magnetic moments, each spread over a ball, and the quantities that are summed over pairs.

With r = x_i − x_j and d = ‖r‖, a moment m at x_j has at x_i the field and the field gradient

    H        = (g1 m + g2 r (r·m)) / 4π
    ∂H_k/∂x_l = (g2 [r_k m_l + m_k r_l + δ_kl r·m] + g3 (r·m) r_k r_l) / 4π

with radial factors g1 = U'/d, g2 = g1'/d, g3 = g2'/d of a potential U(d). Functions return g1, g2 d and g3 d³, which
multiply the direction r/d and stay finite down to d = 0. There are three sets of factors:

* ``dipole_factors``: the point dipole, U = 1/d (Kim and Han 2022, Eqs. 1 and 14).
* ``averaged_factors``: the field of a uniformly magnetized ball, averaged over another ball that overlaps it. At
  contact the factors and their first derivatives equal those of the dipole. They are bounded down to coincident
  centers. The averaged operator is positive, so that induction has one solution for any arrangement of balls.
* ``smoothed_factors``: the paper's smoothing, ε² = ℓ⁵ added to d⁵ (section 5).

The native sums evaluate the dipole at a distance clamped from below to the contact distance a + b. Overlapping pairs
get the correction ``overlap_factors`` of ``pair_law.h`` when sums are finished. Both are continuous at contact, so a
pair that rounding puts on different sides of contact is harmless.

The functions are generic over float32 and float64.
"""

from enum import IntEnum
from functools import cache
from typing import Any

import warp as wp

INVERSE_4PI = 0.07957747154594767


class Quantity(IntEnum):
    """Summed quantity; the values are those of ``pair_terms.h``.

    ``FIELD`` is H, ``FORCE`` is (e·∇)H for an effective moment e of the target, ``WRENCH`` is both. ``MUTUAL_FORCE`` is
    (m·∇)H for the target's moment m.
    """

    FIELD = 0
    FORCE = 1
    WRENCH = 2
    MUTUAL_FORCE = 3


WIDTHS = {Quantity.FIELD: 3, Quantity.FORCE: 3, Quantity.WRENCH: 6, Quantity.MUTUAL_FORCE: 3}
"""Numbers stored per target."""


@wp.func
def dipole_factors(d: Any):
    """Factors of two point dipoles at distance ``d`` [m]: −1/d³, 3/d⁴, −15/d⁴; zero at zero distance."""
    zero = d * type(d)(0.0)
    # d is masked before the power: r⁻⁴ of a moment with itself would overflow float32
    inverse = wp.where(d > zero, type(d)(1.0) / wp.where(d > zero, d, type(d)(1.0)), zero)
    g1 = -inverse * inverse * inverse
    g2 = type(d)(-3.0) * g1 * inverse
    return wp.vector(g1, g2, type(d)(-5.0) * g2, length=3)


@wp.func
def smoothed_factors(d: Any, epsilon2: Any):
    """Factors with ε² [m⁵] added to d⁵ in every denominator; zero at zero distance."""
    w = d / (d * d * d * d * d + epsilon2)
    return wp.vector(-d * w, type(d)(3.0) * w, type(d)(-15.0) * w, length=3)


@cache
def pair_factors(dtype):
    """Warp function (d, a, b, epsilon2) that returns the factors of balls of radii a, b [m] at distance d [m].

    The factors are averaged where the balls overlap. With ε² > 0 [m⁵] they are smoothed instead.
    """
    vec3 = wp.types.vector(3, dtype)

    @wp.func_native("const auto g = warpmag::averaged_factors(d, a, b, apart); return {g.g1, g.g2, g.g3};")
    def averaged_factors(d: dtype, a: dtype, b: dtype, apart: dtype) -> vec3: ...

    @wp.func
    def factors(d: dtype, a: dtype, b: dtype, epsilon2: dtype):
        if epsilon2 > dtype(0.0):
            return smoothed_factors(d, epsilon2)
        if d < a + b:
            return averaged_factors(d, a, b, wp.abs(a - b))
        return dipole_factors(d)

    return factors


@wp.func
def field_of(g: Any, d: Any, u: Any, m: Any):
    """4π times the field [A/m] of moment ``m`` [A·m²] at distance ``d`` [m] in direction ``u`` for factors ``g``."""
    return g[0] * m + (g[1] * d * wp.dot(u, m)) * u


@wp.func
def force_of(g: Any, u: Any, m: Any, e: Any):
    """4π times (e·∇)H [A²] of moment ``m`` in direction ``u`` for an effective moment ``e`` [A·m²]."""
    um = wp.dot(u, m)
    ue = wp.dot(u, e)
    return g[1] * (ue * m + um * e) + (g[1] * wp.dot(m, e) + g[2] * um * ue) * u
