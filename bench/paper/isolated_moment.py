"""Warp kernels of ``fig9``: iterations that one moment needs in fixed fields of many strengths and directions.

One thread runs one test of Kim and Han 2022, Fig. 9: a moment of slope k = 3 in a field of ‖H‖ = strength · Ms, in a
random direction, from the same start, until ‖M − f(H)‖ ≤ tolerance ‖f(H)‖. Without a field, where f(H) = 0, the
tolerance is of Ms. The step is κ = multiplier · κ0. A test that does not end within ``MOST_ITERATIONS`` has failed.

| dynamics | iteration |
|---|---|
| theta | exact θ flow with ω = κ/k, Anderson-accelerated with the last iterate as in ``warpmag.kernels.induction`` |
| theta-flow | the same flow, not accelerated |
| theta-euler, llg, llg-damping | one step of each submagnetization, as in ``warpmag.kernels.induction`` |
| llg-unscaled, llg-damping-unscaled | LLG without scaling M_i back to Ms |

The start is a pair M1, M2 open by an angle; the flow starts from the pair's mean.
"""

from functools import cache

import warp as wp

from warpmag.kernels.induction.submagnetization import LAW_IDS, effective_field, llg_step, step_submagnetization
from warpmag.kernels.material.curves import TANH, curve_ratio, inverse_curve_ratio
from warpmag.kernels.shared.native import native_options

MOST_ITERATIONS = 999
_SLOPE = 3.0
_FLOWS = ("theta", "theta-flow")
_UNSCALED = ("llg-unscaled", "llg-damping-unscaled")
DYNAMICS = (*_FLOWS, *LAW_IDS, *_UNSCALED)


@wp.func
def exceeds_tolerance(m: wp.vec3, goal: wp.vec3, tolerance: float):
    """Whether reduced magnetization ``m`` is farther from ``goal`` than allowed, or not a number."""
    size = wp.length(goal)
    return not wp.length(m - goal) <= tolerance * wp.where(size > 0.0, size, 1.0)


@wp.func
def flow_iterations(
    start: wp.vec3,
    target: wp.vec3,
    omega: float,
    accelerated: int,
    curve: int,
    tables: wp.array2d[float],
    tolerance: float,
):
    """Iterations of the θ flow from dual variable ``start`` to ``target`` = k H/Ms."""
    goal = curve_ratio(wp.length(target), curve, tables) * target
    s = start
    old_s = start
    old_r = wp.vec3()
    for n in range(wp.static(MOST_ITERATIONS)):
        r = target - s
        now = s
        s = now + omega * r  # exact, see theta_flow
        if accelerated == 1 and n > 0:
            dr = r - old_r
            size = wp.dot(dr, dr)
            if size > 0.0:
                s -= (wp.dot(r, dr) / size) * ((now - old_s) + omega * dr)
        old_s = now
        old_r = r
        if not exceeds_tolerance(curve_ratio(wp.length(s), curve, tables) * s, goal, tolerance):
            return n + 1
    return wp.static(MOST_ITERATIONS + 1)


@cache
def _pair_iterations(scaled: bool):
    @wp.func
    def pair_iterations(
        first: wp.vec3,
        second: wp.vec3,
        h: wp.vec3,
        law: int,
        kappa: float,
        precession: float,
        curve: int,
        tables: wp.array2d[float],
        tolerance: float,
    ):
        target = wp.static(_SLOPE) * h
        goal = curve_ratio(wp.length(target), curve, tables) * target
        u = first
        v = second
        for n in range(wp.static(MOST_ITERATIONS)):
            h_eff = effective_field(h, 0.5 * (u + v), float(wp.static(_SLOPE)), curve, tables)
            if wp.static(scaled):
                u = step_submagnetization(u, h_eff, kappa, precession, 1.0, law)
                v = step_submagnetization(v, h_eff, kappa, precession, -1.0, law)
            else:
                u = llg_step(u, h_eff, kappa, precession)
                v = llg_step(v, h_eff, kappa, precession)
            if not exceeds_tolerance(0.5 * (u + v), goal, tolerance):
                return n + 1
            if not wp.isfinite(wp.dot(u, v)):
                break
        return wp.static(MOST_ITERATIONS + 1)

    return pair_iterations


@cache
def _sweep_kernel(flow: bool, scaled: bool):
    pair_iterations = _pair_iterations(scaled)

    @wp.kernel(
        module="unique", enable_backward=False, module_options=native_options("material/curves.h", dtype=wp.float32)
    )
    def sweep(
        # inputs:
        multipliers: wp.array[float],
        strengths: wp.array[float],
        first: wp.vec3,
        second: wp.vec3,
        law: int,
        kappa0: float,
        precession: float,
        curve: int,
        tables: wp.array2d[float],
        tolerance: float,
        seed: int,
        # outputs:
        iteration_sum_out: wp.array2d[int],
        most_out: wp.array2d[int],
        failed_out: wp.array2d[int],
    ):
        row, column, test = wp.tid()
        state = wp.rand_init(seed, test + (row * multipliers.shape[0] + column) * 65536)
        z = 2.0 * wp.randf(state) - 1.0
        angle = 6.283185307 * wp.randf(state)
        across = wp.sqrt(1.0 - z * z)
        h = strengths[row] * wp.vec3(across * wp.cos(angle), across * wp.sin(angle), z)
        kappa = kappa0 * multipliers[column]
        count = 0
        if wp.static(flow):
            m = 0.5 * (first + second)
            s = inverse_curve_ratio(wp.length(m), curve, tables) * m
            slope = float(wp.static(_SLOPE))
            count = flow_iterations(s, slope * h, kappa / slope, law, curve, tables, tolerance)
        else:
            count = pair_iterations(first, second, h, law, kappa, precession, curve, tables, tolerance)
        if count > wp.static(MOST_ITERATIONS):
            count = wp.static(MOST_ITERATIONS)
            wp.atomic_add(failed_out, row, column, 1)
        wp.atomic_add(iteration_sum_out, row, column, count)
        wp.atomic_max(most_out, row, column, count)

    return sweep


def launch_sweep(
    dynamics: str,
    multipliers,
    strengths,
    directions: int,
    iteration_sum,
    most,
    failed,
    *,
    first,
    second,
    kappa: float,
    damping: float = 0.2,
    curve: int = TANH,
    tolerance: float = 1e-3,
    seed: int = 0,
):
    """Run the tests of every cell.

    Args:
        dynamics: One of ``DYNAMICS``.
        multipliers: Multipliers of the step, shape [columns].
        strengths: Field strengths ‖H‖/Ms, shape [rows].
        directions: Random directions of the field per cell, at most 65,536.
        iteration_sum: Out, iterations summed over the directions, shape [rows, columns]; to be zero.
        most: Out, the largest number of iterations, shape [rows, columns]; to be zero.
        failed: Out, tests that failed, shape [rows, columns]; to be zero.
        first: Direction of M1 at the start.
        second: Direction of M2 at the start.
        kappa: Step κ0 [dimensionless].
        damping: Damping α of LLG.
        curve: Curve id of ``warpmag.kernels.material.curves``.
        tolerance: Magnetization error (Eq. 12) at which a test ends.
        seed: Seed of the directions.
    """
    flow, scaled = dynamics in _FLOWS, dynamics not in _UNSCALED
    name = dynamics.removesuffix("-unscaled")
    law = int(name == "theta") if flow else LAW_IDS[name]
    precession = 1.0 / damping if name == "llg" else 0.0
    start = wp.vec3(*first), wp.vec3(*second)
    wp.launch(
        _sweep_kernel(flow, scaled),
        dim=(strengths.shape[0], multipliers.shape[0], directions),
        inputs=[multipliers, strengths, *start, law, kappa, precession, curve, None, tolerance, seed],
        outputs=[iteration_sum, most, failed],
        device=strengths.device,
    )
