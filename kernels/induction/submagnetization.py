"""Baseline dynamics by pairs of submagnetizations (Kim and Han 2022, Eqs. 5, 6, 8, 9, 11), without acceleration.

Every inducible moment is the mean of two submagnetizations of length Ms, M = (M1 + M2)/2, stored as unit vectors
u = M_i/Ms. With the reduced effective field h = H_eff/Ms, one explicit step of each dynamics is

| dynamics | step | source |
|---|---|---|
| theta-euler | Δθ = −κ‖h‖ Θ(θ), θ in [0, π], Θ = sin θ below π/2, 2 − sin θ above | Kim and Han 2022, Eqs. 8, 9 |
| llg | Δu = −κ (u × (u × h) + u × h/α) | Eq. 6, after Kim et al. 2018 |
| llg-damping | Δu = −κ u × (u × h) | damping term of Eq. 6 |

H_eff = H − γM with γ = ‖f⁻¹(M)‖/‖M‖, bounded near saturation (Eq. 11; the paper prints the numerator alone, which is
not dimensionless). On the clamped curve γ = 1/k, the constant γ_D = 1/3 of Eq. 5. κ = βΔtMs is dimensionless. For LLG β
= γ_g α/((1 + α²) Ms) with the gyromagnetic ratio γ_g; the paper's α is α/Ms here. At equal κ all three dynamics have
the same damping to first order, and LLG precesses by κ/α in addition.

The angle to H_eff is never negative: a step past H_eff ends at H_eff. LLG's explicit step leaves the sphere ‖M_i‖ = Ms,
and M_i is normalized again, as in micromagnetics.

A moment starts demagnetized, M1 = −M2, perpendicular to its applied field, in the plane of the field and the coordinate
axis farthest from it. Pairs persist: the next solve continues from them.
"""

from functools import cache
from typing import Any

import warp as wp

from warpmag.kernels.induction.solve_state import BLOCK_CHUNK, state_type, world_summation
from warpmag.kernels.material.curves import curve_ratio, inverse_curve_ratio
from warpmag.kernels.pairs.packing import store_magnetization
from warpmag.kernels.shared.native import native_options

THETA_EULER, LLG, LLG_DAMPING = 0, 1, 2
LAW_IDS = {"theta-euler": THETA_EULER, "llg": LLG, "llg-damping": LLG_DAMPING}


@wp.func
def effective_field(h: Any, m: Any, slope: Any, curve: int, tables: Any):
    """Return the reduced effective field H_eff/Ms (Eqs. 5, 11) of reduced field ``h`` and magnetization ``m``."""
    return h - (inverse_curve_ratio(wp.length(m), slope, curve, tables) / slope) * m


@wp.func
def perpendicular(axis: Any):
    """Return the unit vector perpendicular to ``axis`` and nearest to the coordinate axis farthest from it."""
    x = wp.abs(axis[0])
    y = wp.abs(axis[1])
    z = wp.abs(axis[2])
    coordinate_axis = axis - axis  # zero
    k = wp.where(z <= wp.min(x, y), 2, wp.where(y <= x, 1, 0))
    coordinate_axis[k] = type(x)(1.0)
    return wp.normalize(coordinate_axis - axis[k] * axis)


@wp.func
def theta_step(u: Any, h_eff: Any, kappa: Any, side: Any):
    """Return ``u`` turned towards ``h_eff`` in their plane (Eqs. 8, 9); ``side`` ±1 chooses it if they are parallel."""
    strength = wp.length(h_eff)
    if not strength > type(strength)(0.0):
        return u
    axis = h_eff / strength
    cosine = wp.dot(u, axis)
    transverse = u - cosine * axis
    sine = wp.length(transverse)
    # For nearly parallel vectors rounding would define the plane; M1 and M2 then turn to opposite sides.
    plane = side * perpendicular(axis)
    if sine > type(sine)(1.0e-6):
        plane = transverse / sine
    rate = wp.where(cosine > type(cosine)(0.0), sine, type(sine)(2.0) - sine)
    theta = wp.max(wp.atan2(sine, cosine) - kappa * strength * rate, type(sine)(0.0))
    return wp.cos(theta) * axis + wp.sin(theta) * plane


@wp.func
def llg_step(u: Any, h_eff: Any, kappa: Any, precession: Any):
    """Return an explicit step of Eq. 6 (LLG), not normalized; ``precession`` is 1/α, or 0 for damping only."""
    torque = wp.cross(u, h_eff)
    return u - kappa * (wp.cross(u, torque) + precession * torque)


@wp.func
def step_submagnetization(u: Any, h_eff: Any, kappa: Any, precession: Any, side: Any, law: int):
    """Return one step of dynamics ``law``, normalized."""
    if law == wp.static(THETA_EULER):
        return theta_step(u, h_eff, kappa, side)
    return wp.normalize(llg_step(u, h_eff, kappa, precession))


def _options(dtype) -> dict:
    headers = "induction/solve_state.h", "material/curves.h", "shared/block_sum.h"
    return native_options(*headers, dtype=dtype)


@cache
def pairs_type(dtype):
    """Return the struct of the pairs of n moments and the parameters of their dynamics."""
    vec3 = wp.types.vector(3, dtype)

    @wp.struct
    class Pairs:
        first: wp.array[vec3]  # directions M1/Ms, shape [n]
        second: wp.array[vec3]  # directions M2/Ms, shape [n]
        law: int  # ``THETA_EULER``, ``LLG`` or ``LLG_DAMPING``
        kappa: dtype  # step κ = βΔtMs [dimensionless]
        precession: dtype  # ratio of precession to damping, 1/α or 0 [dimensionless]

    return Pairs


@cache
def _begin_kernel(dtype):
    state_struct = state_type(dtype)

    @wp.func_native("warpmag::begin_world(state, w);")
    def begin_world(state: state_struct, w: int): ...

    @wp.kernel(module="unique", enable_backward=False, module_options=_options(dtype))
    def begin_worlds(state: state_struct):
        row = state.row[wp.tid()]
        if row[0] == row[2]:
            begin_world(state, row[1])
        if wp.length(state.h0[row[0]]) > dtype(0.0):
            state.worlds[row[1]].in_field = 1

    return begin_worlds


@cache
def _start_kernel(dtype):
    @wp.kernel(module="unique", enable_backward=False)
    def start_pairs(state: state_type(dtype), pairs: pairs_type(dtype)):
        row = state.row[wp.tid()]
        i = row[0]
        # without an applied field the only solution is zero magnetization, where a cold start begins
        if state.warm[row[1]] == 0 or state.worlds[row[1]].in_field == 0:
            u = perpendicular(wp.normalize(state.h0[i]))
            pairs.first[i] = u
            pairs.second[i] = -u
        mean = dtype(0.5) * state.saturation[i] * (pairs.first[i] + pairs.second[i])
        store_magnetization(i, mean, state.moments, state.packed)

    return start_pairs


@cache
def _split_kernel(dtype):
    @wp.kernel(module="unique", enable_backward=False)
    def split_magnetizations(
        magnetizations: wp.array[wp.types.vector(3, dtype)], state: state_type(dtype), pairs: pairs_type(dtype)
    ):
        row = state.row[wp.tid()]
        i = row[0]
        m = magnetizations[i] / state.saturation[i]
        length = wp.length(m)
        if length > dtype(1.0):
            m = m / length
            length = dtype(1.0)
        transverse = wp.sqrt(dtype(1.0) - length * length) * perpendicular(wp.normalize(m))
        pairs.first[i] = m + transverse
        pairs.second[i] = m - transverse
        state.warm[row[1]] = 1

    return split_magnetizations


@cache
def _convergence_kernel(dtype):
    """Return the kernel that sums chunks of worlds; the last block of a world ends it if it has converged."""
    state_struct = state_type(dtype)
    sum_world = world_summation(dtype, 2)

    @wp.func_native("return warpmag::relative_residual(deviation2, goal2);")
    def relative_residual(deviation2: wp.float64, goal2: wp.float64) -> wp.float64: ...

    @wp.func_native("warpmag::check_convergence(state, w, residual, residual, finite, !finite);")
    def end_world(state: state_struct, w: int, residual: wp.float64, finite: bool): ...

    @wp.kernel(module="unique", enable_backward=False, module_options=_options(dtype))
    def check_convergence(state: state_struct, pairs: pairs_type(dtype)):
        c, lane = wp.tid()
        chunk = state.chunk[c]
        if state.worlds[chunk[2]].active == 0:
            return
        terms = wp.vec2d()
        for row in range(chunk[0] + lane, chunk[1], wp.block_dim()):
            i = state.row[row][0]
            limit = state.saturation[i]
            g = (state.slope[i] / limit) * state.h[i]
            goal = (limit * curve_ratio(wp.length(g), state.slope[i], state.curve[i], state.curve_tables)) * g
            # lengths, not squares: the square of 1e-20 A/m underflows float32
            deviation = wp.float64(wp.length(goal - (dtype(0.5) * limit) * (pairs.first[i] + pairs.second[i])))
            terms += wp.vec2d(deviation * deviation, wp.float64(wp.length(goal)) * wp.float64(wp.length(goal)))
        last, total = sum_world(terms, c, lane, chunk[2], state)
        if last:
            finite = wp.isfinite(total[0]) and wp.isfinite(total[1])
            end_world(state, chunk[2], relative_residual(total[0], total[1]), finite)

    return check_convergence


@cache
def _step_kernel(dtype):
    @wp.kernel(module="unique", enable_backward=False, module_options=_options(dtype))
    def step_pairs(state: state_type(dtype), pairs: pairs_type(dtype)):
        row = state.row[wp.tid()]
        if state.worlds[row[1]].active == 0:
            return
        i = row[0]
        u = pairs.first[i]
        v = pairs.second[i]
        reduced, mean = state.h[i] / state.saturation[i], dtype(0.5) * (u + v)
        h_eff = effective_field(reduced, mean, state.slope[i], state.curve[i], state.curve_tables)
        u = step_submagnetization(u, h_eff, pairs.kappa, pairs.precession, dtype(1.0), pairs.law)
        v = step_submagnetization(v, h_eff, pairs.kappa, pairs.precession, dtype(-1.0), pairs.law)
        pairs.first[i] = u
        pairs.second[i] = v
        store_magnetization(i, (dtype(0.5) * state.saturation[i]) * (u + v), state.moments, state.packed)

    return step_pairs


def make_pairs(state, law: str, kappa: float, precession: float):
    """Return pairs for the moments of ``state``, with dynamics ``law`` of ``LAW_IDS``."""
    dtype = state.packed.dtype
    pairs = pairs_type(dtype)()
    pairs.first, pairs.second = wp.zeros_like(state.h), wp.zeros_like(state.h)
    pairs.law, pairs.kappa, pairs.precession = LAW_IDS[law], kappa, precession
    return pairs


def _launch(kernel, state, *inputs):
    wp.launch(kernel(state.packed.dtype), dim=state.row.shape[0], inputs=[*inputs], device=state.h.device)


def launch_split(state, pairs, magnetizations):
    """Launch the split of magnetizations [A/m], shape [n], into symmetric pairs; the next solve starts from them."""
    _launch(_split_kernel, state, magnetizations, state, pairs)


def launch_begin(state, pairs):
    """Launch the start of a solve, cold from the applied field, or warm from the present pairs."""
    _launch(_begin_kernel, state, state)
    _launch(_start_kernel, state, state, pairs)


def launch_iteration(state, pairs):
    """Launch the check of convergence in the field ``state.h``, and a step of the pairs of worlds that iterate on."""
    state.condition.zero_()  # set again by any world that needs another evaluation
    kernel, chunks = _convergence_kernel(state.packed.dtype), state.chunk.shape[0]
    wp.launch_tiled(kernel, dim=[chunks], inputs=[state, pairs], block_dim=BLOCK_CHUNK, device=state.h.device)
    _launch(_step_kernel, state, state, pairs)
