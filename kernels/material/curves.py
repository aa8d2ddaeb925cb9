"""Magnetization curves M = f(H) in reduced form, and the θ dynamics that follows them.

With the reduced field s = k‖H‖/Ms every curve reads ‖M‖ = Ms c(s), c(0) = 0, c'(0) = 1, c(∞) = 1:

| curve | c(s) | source |
|---|---|---|
| tanh | tanh s | Kim and Han 2022, Eq. 10 |
| langevin | L(3s), L(x) = coth x − 1/x | their section 6.2 |
| clamped | min(s, 1) | Eq. 7 |

k = 3χ/(3+χ) is the initial slope of a ball of susceptibility χ. The functions are generic over float32 and float64.
"""

from dataclasses import dataclass
from typing import Any

import warp as wp

TANH, LANGEVIN, CLAMPED = 0, 1, 2
CURVE_IDS = {"tanh": TANH, "langevin": LANGEVIN, "clamped": CLAMPED}


@dataclass(frozen=True)
class CurveParameters:
    """Magnetization curve of each moment, on one device.

    Attributes:
        inducible: 1 for inducible moments, 0 for permanent ones, shape [n].
        saturation: Saturation magnetization Ms [A/m], shape [n].
        slope: Initial slope k = 3χ/(3+χ) [dimensionless], shape [n].
        curve: Curve id, one of ``CURVE_IDS``, shape [n].
    """

    inducible: wp.array
    saturation: wp.array
    slope: wp.array
    curve: wp.array


@wp.func
def langevin(x: Any):
    """Langevin's L(x) = coth x − 1/x for x ≥ 0; by its series below 0.3, where the closed form cancels."""
    one = type(x)(1.0)
    x2 = x * x
    series = x * (
        one / type(x)(3.0)
        - x2
        * (one / type(x)(45.0) - x2 * (type(x)(2.0 / 945.0) - x2 * (one / type(x)(4725.0) - x2 / type(x)(46777.5))))
    )
    safe = wp.max(x, type(x)(0.3))
    return wp.where(x < type(x)(0.3), series, one / wp.tanh(safe) - one / safe)


@wp.func
def langevin_slope(x: Any):
    """L'(x) = 1/x² − 1/sinh² x for x ≥ 0; by its series below 0.3."""
    one = type(x)(1.0)
    x2 = x * x
    series = one / type(x)(3.0) - x2 * (
        one / type(x)(15.0) - x2 * (type(x)(2.0 / 189.0) - x2 * (one / type(x)(675.0) - x2 * type(x)(9.0 / 46777.5)))
    )
    safe = wp.max(x, type(x)(0.3))
    sinh = wp.sinh(wp.min(safe, type(x)(40.0)))
    return wp.where(x < type(x)(0.3), series, one / (safe * safe) - one / (sinh * sinh))


@wp.func
def reduced_curve(s: Any, curve: int):
    """Reduced magnetization c(s) for s ≥ 0 and curve ``TANH``, ``LANGEVIN`` or ``CLAMPED``."""
    if curve == wp.static(LANGEVIN):
        return langevin(type(s)(3.0) * s)
    if curve == wp.static(CLAMPED):
        return wp.min(s, type(s)(1.0))
    return wp.tanh(s)


@wp.func
def reduced_curve_slope(s: Any, curve: int):
    """Derivative c'(s) for s ≥ 0."""
    one = type(s)(1.0)
    if curve == wp.static(LANGEVIN):
        return type(s)(3.0) * langevin_slope(type(s)(3.0) * s)
    if curve == wp.static(CLAMPED):
        return wp.where(s < one, one, type(s)(0.0))
    c = wp.cosh(wp.min(s, type(s)(40.0)))
    return one / (c * c)


@wp.func
def curve_ratio(s: Any, curve: int):
    """c(s)/s, which is 1 at s = 0: the factor between a reduced field vector and its reduced magnetization."""
    # below the square root of the smallest normal number the quotient of two denormals says nothing
    if s < type(s)(1.0e-18):
        return type(s)(1.0)
    return reduced_curve(s, curve) / s


@wp.func
def inverse_curve_ratio(c: Any, curve: int):
    """s/c of the reduced field s that gives reduced magnetization ``c``; a saturated one gets a large finite s."""
    one = type(c)(1.0)
    bounded = wp.min(c, type(c)(0.999999))
    if bounded < type(c)(1.0e-18) or curve == wp.static(CLAMPED):
        return one
    if curve == wp.static(LANGEVIN):
        # Newton on L(3s) = c from Cohen's rational start; the curve is concave, so it converges from any start below
        x = bounded * (type(c)(3.0) - bounded * bounded) / (one - bounded * bounded)
        for _ in range(8):
            x += (bounded - langevin(x)) / langevin_slope(x)
        return x / (type(c)(3.0) * bounded)
    return type(c)(0.5) * wp.log((one + bounded) / (one - bounded)) / bounded


@wp.func
def curve_derivative_times(h: Any, v: Any, k: Any, saturation: Any, curve: int):
    """Product f'(H) v of the curve's derivative ∂M/∂H at field ``h`` [A/m] with a vector ``v``; Eq. 4 needs it."""
    norm = wp.length(h)
    s = k * norm / saturation
    across = k * curve_ratio(s, curve)
    if norm == type(norm)(0.0):
        return across * v
    unit = h / norm
    along = k * reduced_curve_slope(s, curve)
    return across * v + ((along - across) * wp.dot(unit, v)) * unit


@wp.func
def theta_flow(s: Any, target: Any, omega: Any):
    """Exact flow of the θ dynamics (Eqs. 8, 9, 11) over one step, in the dual variable s = k f⁻¹(M)/Ms.

    With M1 and M2 symmetric about H_eff, ‖M‖ = Ms cos θ, and ln cot(θ/2) = artanh(‖M‖/Ms) = ‖s‖ grows linearly in
    time: s ← (1 − ω) s + ω k H/Ms with ω = κ/k, κ = βΔtMs.
    """
    return s + omega * (target - s)
