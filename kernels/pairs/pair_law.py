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

The all-pairs loops evaluate the dipole with its distance clamped from below to the contact distance a + b
(``clamped`` below); the few pairs that overlap get ``overlap_factors``, the difference, in a neighbour pass. Both are
continuous at contact, so a pair that two roundings of d put on different sides of it does no harm.

The functions are generic over float32 and float64.
"""

from typing import Any

import warp as wp


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


@wp.func
def averaged_factors(d: Any, a: Any, b: Any):
    """Factors [g1, g2, g3] of overlapping balls of radii ``a`` and ``b`` [m] at distance ``d`` < a + b [m].

    U = 1/d + (a+b−d)⁴ (5a² − 20ab + 5b² − 4(a+b)d − d²) / (160 a³b³d), and −1/A³ where the smaller ball lies inside
    the larger of radius A. Two forms of the same expression: the printed one keeps its digits near contact and for
    very different radii, the Laurent polynomial in d keeps them for nearly concentric balls.
    """
    one = type(d)(1.0)
    zero = type(d)(0.0)
    s = a + b
    p = a * b
    if d <= wp.abs(a - b) or d == zero:
        large = wp.max(a, b)
        return wp.vector(-one / (large * large * large), zero, zero, length=3)
    c = one / (type(d)(160.0) * p * p * p)
    i1 = one / d
    i2 = i1 * i1
    i3 = i2 * i1
    if d > type(d)(0.5) * s:
        e = s - d
        e2 = e * e
        e3 = e2 * e
        e4 = e2 * e2
        q0 = type(d)(5.0) * (a * a + b * b) - type(d)(20.0) * p
        q = q0 * i1 - type(d)(4.0) * s - d
        q1 = -q0 * i2 - one
        q2 = type(d)(2.0) * q0 * i3
        q3 = type(d)(-6.0) * q0 * i3 * i1
        w1 = c * (e4 * q1 - type(d)(4.0) * e3 * q) * i1
        w2 = c * (type(d)(12.0) * e2 * q - type(d)(8.0) * e3 * q1 + e4 * q2) * i2
        w3 = c * (type(d)(36.0) * e2 * q1 - type(d)(24.0) * e * q - type(d)(12.0) * e3 * q2 + e4 * q3) * i3
        g1 = w1 - i3
        g2 = w2 - (w1 - type(d)(3.0) * i3) * i2
        g3 = w3 - type(d)(3.0) * (w2 - w1 * i2) * i2 - type(d)(15.0) * i3 * i2 * i2
        return wp.vector(g1, g2, g3, length=3)
    delta2 = (a - b) * (a - b)
    k = type(d)(5.0) * delta2 * delta2 * (delta2 + type(d)(6.0) * p)
    u1 = type(d)(45.0) * s * s * delta2
    u2 = type(d)(-40.0) * s * (delta2 + p)
    u3 = type(d)(15.0) * (delta2 + type(d)(2.0) * p)
    g1 = c * (type(d)(2.0) * u2 + type(d)(3.0) * u3 * d - type(d)(5.0) * d * d * d + (u1 - k * i2) * i1)
    g2 = c * (type(d)(3.0) * u3 * i1 - type(d)(15.0) * d + (type(d)(3.0) * k * i2 - u1) * i3)
    g3 = c * ((type(d)(3.0) * u1 - type(d)(15.0) * k * i2) * i3 * i2 - type(d)(3.0) * u3 * i3 - type(d)(15.0) * i1)
    return wp.vector(g1, g2, g3, length=3)


@wp.func
def pair_factors(d2: Any, a: Any, b: Any):
    """Factors [g1, g2, g3] of two balls at any distance: the averaged law where they overlap, else the dipole."""
    s = a + b
    if d2 < s * s:
        return averaged_factors(wp.sqrt(d2), a, b)
    return dipole_factors(d2)


@wp.func
def overlap_factors(d: Any, a: Any, b: Any):
    """What the clamped dipole lacks for an overlapping pair: averaged factors less those at the contact distance.

    Lengths are in units of that distance, a + b = 1. Balls of one radius, most of all, have U'/d = −8 + 9d − 2d³.
    """
    one = type(d)(1.0)
    if a == b:
        e = one - d
        i = one / wp.max(d, type(d)(1.0e-6))  # bounded: the factors of coincident balls meet a separation of zero
        return wp.vector(
            e * (e * (type(d)(2.0) * e - type(d)(6.0)) - type(d)(3.0)),
            e * (type(d)(9.0) * i + type(d)(6.0)),
            -e * i * (type(d)(9.0) * i * (i + one) + type(d)(15.0)),
            length=3,
        )
    return averaged_factors(d, a, b) - wp.vector(-one, type(d)(3.0), type(d)(-15.0), length=3)


@wp.func
def overlap_fraction(d: Any, a: Any, b: Any):
    """Volume that two balls share, over the geometric mean of their volumes [dimensionless]."""
    zero = type(d)(0.0)
    if d >= a + b:
        return zero
    small = wp.min(a, b)
    large = wp.max(a, b)
    if d <= large - small:
        ratio = small / large
        return ratio * wp.sqrt(ratio)
    e = a + b - d
    lens = e * e * (d * d + type(d)(2.0) * d * (a + b) - type(d)(3.0) * (a - b) * (a - b)) / (type(d)(16.0) * d)
    p = a * b
    return lens / (p * wp.sqrt(p))


@wp.func
def field_of(g: Any, r: Any, m: Any):
    """4π times the field [A/m] of moment ``m`` [A·m²] at separation ``r`` [m] for radial factors ``g``."""
    return g[0] * m + (g[1] * wp.dot(r, m)) * r


@wp.func
def gradient_of(g: Any, r: Any, m: Any):
    """4π times the gradient ∂H_k/∂x_l [A/m²] of moment ``m`` at separation ``r``: diagonal, then xy, yz, zx."""
    rm = wp.dot(r, m)
    t = g[2] * rm
    trace = g[1] * rm
    two = type(rm)(2.0)
    return wp.vector(
        two * g[1] * r[0] * m[0] + trace + t * r[0] * r[0],
        two * g[1] * r[1] * m[1] + trace + t * r[1] * r[1],
        two * g[1] * r[2] * m[2] + trace + t * r[2] * r[2],
        g[1] * (r[0] * m[1] + r[1] * m[0]) + t * r[0] * r[1],
        g[1] * (r[1] * m[2] + r[2] * m[1]) + t * r[1] * r[2],
        g[1] * (r[2] * m[0] + r[0] * m[2]) + t * r[2] * r[0],
        length=6,
    )


@wp.func
def gradient_times(t: Any, e: Any):
    """The vector e_k ∂H_k/∂x_l for a gradient ``t`` as :func:`gradient_of` gives it, or sums of such."""
    x = t[0] * e[0] + t[3] * e[1] + t[5] * e[2]
    y = t[3] * e[0] + t[1] * e[1] + t[4] * e[2]
    z = t[5] * e[0] + t[4] * e[1] + t[2] * e[2]
    return wp.vector(x, y, z, length=3)
