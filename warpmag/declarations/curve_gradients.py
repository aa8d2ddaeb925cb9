"""Derivatives of measured magnetization curves with respect to their points.

Between two points M is Hermite's cubic of their magnetizations and slopes. Beyond the last point M = Ms − D²/z with
D = Ms − M_n and z = D + M'_n (H − H_n) (``curves.py``). Slopes and Ms follow from the points, so each chain of
derivatives ends there.
"""

import numpy as np

from warpmag.declarations.curves import MagnetizationCurve
from warpmag.errors import InputError


def point_gradients(curve: MagnetizationCurve, ball_fields, weights) -> tuple[np.ndarray, np.ndarray]:
    """Return the gradients of Σ w M of balls with respect to fields and magnetizations of the points of a curve.

    A change δM of the curve changes the magnetization of a ball by δM/(1 + M'/3) at a fixed field of all others. The
    reason is the ball's own field −M/3, which changes, too.

    Args:
        curve: Curve with extrapolated saturation.
        ball_fields: Field [A/m] of all others at each ball, NumPy, shape [n].
        weights: Factor w of each ball's magnetization, NumPy, shape [n].

    Returns:
        Gradients with respect to ``curve.fields`` and to ``curve.magnetizations``, NumPy, shape [points] each.

    Raises:
        InputError: Two points have the same magnetization. The slope has no derivative there.
    """
    h, m, d = (np.array(values) for values in (curve.fields, curve.magnetizations, curve.slopes))
    level = np.flatnonzero(np.diff(m) <= 0.0)
    if len(level):
        raise InputError(
            f"{curve.name}: at H = {h[level[0]]:g} and {h[level[0] + 1]:g} A/m the magnetization is the same, which "
            "has no gradient"
        )
    by_h, by_m, by_d = np.zeros((3, len(h)))
    beyond = ball_fields > h[-1] + m[-1] / 3.0
    _add_inside(h, m, d, ball_fields[~beyond], weights[~beyond], (by_h, by_m, by_d))
    _add_beyond(h, m, d, curve.saturation, ball_fields[beyond], weights[beyond], (by_h, by_m, by_d))
    _add_slopes(h, m, d, by_d, by_h, by_m)
    return by_h, by_m


def _add_inside(h, m, d, ball_fields, weights, sums) -> None:
    """Add the gradients of balls between points to ``sums``: with respect to fields, magnetizations and slopes."""
    k = np.clip(np.searchsorted(h + m / 3.0, ball_fields, "right") - 1, 0, len(h) - 2)
    span, t = np.diff(h)[k], np.zeros(len(k))
    for step in 0.5 ** np.arange(1, 54):  # bisection of H' + M/3 = H to rounding
        middle = t + step
        below = h[k] + middle * span + _cubic(m, d, k, middle, span) / 3.0 < ball_fields
        t = np.where(below, middle, t)
    by_end = t * t * (3.0 - 2.0 * t)
    of_slopes = t * (1.0 - t) ** 2, t * t * (t - 1.0)
    slope = 6.0 * t * (1.0 - t) * (m[k + 1] - m[k]) / span
    slope += d[k] * (1.0 - t) * (1.0 - 3.0 * t) + d[k + 1] * t * (3.0 * t - 2.0)
    stretch = d[k] * of_slopes[0] + d[k + 1] * of_slopes[1]  # derivative with respect to the span at constant t
    weights = weights / (1.0 + slope / 3.0)
    by_points = (
        (slope * (t - 1.0) - stretch, stretch - slope * t),
        (1.0 - by_end, by_end),
        (span * of_slopes[0], span * of_slopes[1]),
    )
    for total, (first, second) in zip(sums, by_points, strict=True):
        np.add.at(total, k, weights * first)
        np.add.at(total, k + 1, weights * second)


def _cubic(m, d, k, t, span):
    """Return Hermite's cubic of piece ``k`` at ``t`` in [0, 1]."""
    by_end = t * t * (3.0 - 2.0 * t)
    return m[k] + (m[k + 1] - m[k]) * by_end + span * t * (1.0 - t) * (d[k] * (1.0 - t) - d[k + 1] * t)


def _add_beyond(h, m, d, saturation, ball_fields, weights, sums) -> None:
    """Add the gradients of balls beyond the last point to ``sums``, as :func:`_add_inside` does."""
    by_h, by_m, by_d = sums
    left = saturation - m[-1]
    by_left = by_slope = slope = np.zeros(len(weights))
    if left > 0.0:
        # H' + M/3 = H is a quadratic equation of z
        b = h[-1] - left / d[-1] + saturation / 3.0 - ball_fields
        z = 0.5 * d[-1] * (np.sqrt(b * b + 4.0 * left**2 / (3.0 * d[-1])) - b)
        slope, by_left = d[-1] * (left / z) ** 2, (left / z) ** 2 - 2.0 * left / z
        by_slope = (left / z) ** 2 * (z - left) / d[-1]
    weights = weights / (1.0 + slope / 3.0)
    by_saturation = np.sum(weights * (1.0 + by_left))  # Ms = M_n + H_n M'_n
    by_h[-1] += d[-1] * by_saturation - np.sum(weights * slope)
    by_m[-1] += by_saturation - np.sum(weights * by_left)
    by_d[-1] += h[-1] * by_saturation + np.sum(weights * by_slope)


def _add_slopes(h, m, d, by_d, by_h, by_m) -> None:
    """Add the gradients with respect to PCHIP's slopes to those with respect to fields and magnetizations."""
    span, secant = np.diff(h), np.diff(m) / np.diff(h)
    by_span, by_secant = np.zeros((2, len(span)))
    by_secant[0] += by_d[0]
    by_secant[-1] += by_d[-1] * h[-2] / h[-1]
    by_h[-2] += by_d[-1] * secant[-1] / h[-1]
    by_h[-1] -= by_d[-1] * d[-1] / h[-1]
    # d = (a + b)/(a/s₁ + b/s₂), a = 2 l₂ + l₁, b = l₂ + 2 l₁ with the lengths l and secants s of two pieces
    a, b = 2.0 * span[1:] + span[:-1], span[1:] + 2.0 * span[:-1]
    inner, share = d[1:-1], by_d[1:-1] * d[1:-1] / (a + b)
    by_a, by_b = share * (1.0 - inner / secant[:-1]), share * (1.0 - inner / secant[1:])
    by_secant[:-1] += share * inner * a / secant[:-1] ** 2
    by_secant[1:] += share * inner * b / secant[1:] ** 2
    by_span[:-1] += by_a + 2.0 * by_b
    by_span[1:] += 2.0 * by_a + by_b
    by_span -= by_secant * secant / span
    for total, values in ((by_h, by_span), (by_m, by_secant / span)):
        total[1:] += values
        total[:-1] -= values
