"""Pairs of submagnetizations: the magnetization dynamics that ``theta_flow`` replaces.

Every inducible moment is the mean of two submagnetizations of length Ms, M = (M1 + M2)/2, held here as unit vectors
u = M_i/Ms. With the reduced effective field h = H_eff/Ms, one explicit step of each dynamics is

| dynamics | step | source |
|---|---|---|
| theta-euler | Δθ = −κ‖h‖ Θ(θ), θ in [0, π], Θ = sin θ below π/2, 2 − sin θ above | Kim and Han 2022, Eqs. 8, 9 |
| llg | Δu = −κ (u × (u × h) + u × h/α) | Eq. 6, after Kim et al. 2018 |
| llg-damping | Δu = −κ u × (u × h) | the damping term of Eq. 6 as is |

H_eff = H − γM, γ = ‖f⁻¹(M)‖/‖M‖ (Eq. 11; the paper prints the numerator alone, which is not dimensionless), bounded
near saturation; on the clamped curve γ = 1/k, the constant γ_D = 1/3 of Eq. 5. κ = βΔtMs is dimensionless; for LLG
β = γ_g α/((1 + α²) Ms) with the gyromagnetic ratio γ_g, where α/Ms is meant where the paper writes α. At one κ all
three thus damp alike to first order, and LLG precesses κ/α on top.

An angle to H_eff is never negative: a step that would carry M_i past H_eff ends on it. LLG's explicit step leaves the
sphere ‖M_i‖ = Ms, and M_i is scaled back, as micromagnetics does.

A moment starts demagnetized, M1 = −M2, across its applied field, along the coordinate axis farthest from it. Pairs
outlive a solve: the next one goes on from them.
"""

from functools import cache
from typing import Any

import warp as wp

from warpmag.kernels.induction.solve_state import (
    CHUNK,
    FIELD,
    GOAL,
    LACK,
    InductionBuffers,
    World,
    applied_field,
    begin_world,
    relative_error,
    world_summation,
)
from warpmag.kernels.material.curves import curve_ratio, inverse_curve_ratio
from warpmag.kernels.pairs.packing import store_magnetization
from warpmag.kernels.shared.reductions import block_max, block_sum

THETA_EULER, LLG, LLG_DAMPING = 0, 1, 2
LAW_IDS = {"theta-euler": THETA_EULER, "llg": LLG, "llg-damping": LLG_DAMPING}


# ---------------------------------------------------------------------------------------------------------------------
# One step of one submagnetization
# ---------------------------------------------------------------------------------------------------------------------


@wp.func
def effective_field(h: Any, m: Any, slope: Any, curve: int):
    """Reduced effective field H_eff/Ms (Eqs. 5 and 11) of reduced field ``h`` and reduced magnetization ``m``."""
    return h - (inverse_curve_ratio(wp.length(m), curve) / slope) * m


@wp.func
def across(axis: Any):
    """Unit vector across a unit ``axis``, along the coordinate axis farthest from it."""
    x = wp.abs(axis[0])
    y = wp.abs(axis[1])
    z = wp.abs(axis[2])
    far = axis - axis
    k = wp.where(z <= wp.min(x, y), 2, wp.where(y <= x, 1, 0))
    far[k] = type(x)(1.0)
    return wp.normalize(far - axis[k] * axis)


@wp.func
def theta_step(u: Any, h_eff: Any, kappa: Any, side: Any):
    """Turn ``u`` towards ``h_eff`` in their common plane (Eqs. 8, 9); ``side`` ±1 picks it where they are parallel."""
    strength = wp.length(h_eff)
    if not strength > type(strength)(0.0):
        return u
    axis = h_eff / strength
    cosine = wp.dot(u, axis)
    off = u - cosine * axis
    sine = wp.length(off)
    # nearly parallel the plane is rounding; M1 and M2 then part to opposite sides
    plane = side * across(axis)
    if sine > type(sine)(1.0e-6):
        plane = off / sine
    rate = wp.where(cosine > type(cosine)(0.0), sine, type(sine)(2.0) - sine)
    theta = wp.max(wp.atan2(sine, cosine) - kappa * strength * rate, type(sine)(0.0))
    return wp.cos(theta) * axis + wp.sin(theta) * plane


@wp.func
def llg_step(u: Any, h_eff: Any, kappa: Any, precession: Any):
    """Explicit step of the LLG equation (Eq. 6), not scaled back; ``precession`` is 1/α, or 0 for damping only."""
    turn = wp.cross(u, h_eff)
    return u - kappa * (wp.cross(u, turn) + precession * turn)


@wp.func
def step_submagnetization(u: Any, h_eff: Any, kappa: Any, precession: Any, side: Any, law: int):
    """One step of dynamics ``law``, ending on the unit sphere."""
    if law == wp.static(THETA_EULER):
        return theta_step(u, h_eff, kappa, side)
    return wp.normalize(llg_step(u, h_eff, kappa, precession))


# ---------------------------------------------------------------------------------------------------------------------
# Kernels
# ---------------------------------------------------------------------------------------------------------------------


@cache
def _begin_kernel(dtype):
    vec3 = wp.types.vector(3, dtype)
    apply_field = applied_field(dtype)

    @wp.kernel(module="unique", enable_backward=False)
    def begin_pairs(
        # inputs:
        chunk: wp.array[wp.vec3i],
        partial: wp.array3d[dtype],
        packed: wp.array2d[dtype],
        row_target: wp.array[int],
        source_begin: wp.array[int],
        source_end: wp.array[int],
        neighbor: wp.array2d[int],
        neighbor_count: wp.array[int],
        external_field: wp.array[vec3],
        # outputs:
        h0_out: wp.array[vec3],
        start_out: wp.array2d[wp.float64],
        worlds_out: wp.array[World],
        condition_out: wp.array[int],
    ):
        c, lane = wp.tid()
        field = wp.float64(0.0)
        for row in range(chunk[c][0] + lane, chunk[c][1], wp.block_dim()):
            i = row_target[row]
            h0 = apply_field(
                partial,
                packed,
                row,
                i,
                source_begin[row],
                source_end[row],
                neighbor,
                neighbor_count,
                external_field,
                0,
                1,
            )
            h0_out[i] = h0
            field = wp.max(field, wp.float64(wp.length(h0)))
        field = block_max(field)
        if lane == 0:
            begin_world(chunk[c][2], field, wp.float64(0.0), start_out, worlds_out, condition_out)

    return begin_pairs


@cache
def _start_kernel(dtype):
    vec3 = wp.types.vector(3, dtype)

    @wp.kernel(module="unique", enable_backward=False)
    def start_pairs(
        # inputs:
        row_target: wp.array[int],
        world: wp.array[int],
        warm: wp.array[int],
        start: wp.array2d[wp.float64],
        h0: wp.array[vec3],
        saturation: wp.array[dtype],
        # in and out:
        first: wp.array[vec3],
        second: wp.array[vec3],
        # outputs:
        moments_out: wp.array[vec3],
        packed_out: wp.array2d[dtype],
    ):
        i = row_target[wp.tid()]
        # without a field the one solution is no magnetization, which a cold start hits
        if warm[world[i]] == 0 or start[world[i], wp.static(FIELD)] == wp.float64(0.0):
            u = across(wp.normalize(h0[i]))
            first[i] = u
            second[i] = -u
        store_magnetization(i, (dtype(0.5) * saturation[i]) * (first[i] + second[i]), moments_out, packed_out)

    return start_pairs


@cache
def _split_kernel(dtype):
    vec3 = wp.types.vector(3, dtype)

    @wp.kernel(module="unique", enable_backward=False)
    def split_magnetizations(
        # inputs:
        row_target: wp.array[int],
        world: wp.array[int],
        magnetizations: wp.array[vec3],
        saturation: wp.array[dtype],
        # outputs:
        first_out: wp.array[vec3],
        second_out: wp.array[vec3],
        warm_out: wp.array[int],
    ):
        i = row_target[wp.tid()]
        m = magnetizations[i] / saturation[i]
        length = wp.length(m)
        if length > dtype(1.0):
            m = m / length
            length = dtype(1.0)
        half = wp.sqrt(dtype(1.0) - length * length) * across(wp.normalize(m))
        first_out[i] = m + half
        second_out[i] = m - half
        warm_out[world[i]] = 1

    return split_magnetizations


_columns = wp.types.vector(2, wp.float64)
_sum_world = world_summation(2)


@wp.func
def judge(
    w: int,
    sums: _columns,
    rtol: wp.float64,
    max_evaluations: int,
    worlds: wp.array[World],
    start_out: wp.array2d[wp.float64],
    error_out: wp.array[wp.float64],
    evaluations_out: wp.array[int],
    converged_out: wp.array[int],
    warm_out: wp.array[int],
    condition_out: wp.array[int],
):
    """Tell whether a world has converged, given up or come to nothing; else it steps on."""
    evaluations = worlds[w].evaluations + 1
    error = relative_error(sums)
    lost = not wp.isfinite(error)
    worlds[w].evaluations = evaluations
    evaluations_out[w] = evaluations
    error_out[w] = error
    converged_out[w] = wp.where(error <= rtol, 1, 0)
    start_out[w, wp.static(FIELD)] = wp.float64(0.0)
    if error <= rtol or evaluations >= max_evaluations or lost:
        worlds[w].active = 0
        # a state that is not finite must not be the next start
        warm_out[w] = wp.where(lost, 0, 1)
    else:
        condition_out[0] = 1


@cache
def _evaluate_kernel(dtype):
    vec3 = wp.types.vector(3, dtype)

    @wp.kernel(module="unique", enable_backward=False)
    def evaluate_pairs(
        # inputs:
        chunk: wp.array[wp.vec3i],
        chunk_begin: wp.array[int],
        row_target: wp.array[int],
        h: wp.array[vec3],
        first: wp.array[vec3],
        second: wp.array[vec3],
        saturation: wp.array[dtype],
        slope: wp.array[dtype],
        curve: wp.array[int],
        rtol: wp.float64,
        max_evaluations: int,
        # in and out:
        worlds: wp.array[World],
        sums: wp.array2d[wp.float64],
        arrived: wp.array[int],
        # outputs:
        start_out: wp.array2d[wp.float64],
        error_out: wp.array[wp.float64],
        evaluations_out: wp.array[int],
        converged_out: wp.array[int],
        warm_out: wp.array[int],
        condition_out: wp.array[int],
    ):
        c, lane = wp.tid()
        w = chunk[c][2]
        if worlds[w].active == 0:
            return
        mine = _columns()
        for row in range(chunk[c][0] + lane, chunk[c][1], wp.block_dim()):
            i = row_target[row]
            g = (slope[i] / saturation[i]) * h[i]
            goal = (saturation[i] * curve_ratio(wp.length(g), curve[i])) * g
            # lengths, not squares: a field of 1e-20 A/m squared is no float32
            goal_length = wp.float64(wp.length(goal))
            lack_length = wp.float64(wp.length(goal - (dtype(0.5) * saturation[i]) * (first[i] + second[i])))
            mine[wp.static(LACK)] += lack_length * lack_length
            mine[wp.static(GOAL)] += goal_length * goal_length
        last, total = _sum_world(block_sum(mine), c, lane, w, chunk_begin[w], chunk_begin[w + 1], sums, arrived)
        if last and lane == 0:
            judge(
                w,
                total,
                rtol,
                max_evaluations,
                worlds,
                start_out,
                error_out,
                evaluations_out,
                converged_out,
                warm_out,
                condition_out,
            )

    return evaluate_pairs


@cache
def _step_kernel(dtype):
    vec3 = wp.types.vector(3, dtype)

    @wp.kernel(module="unique", enable_backward=False)
    def step_pairs(
        # inputs:
        row_target: wp.array[int],
        world: wp.array[int],
        worlds: wp.array[World],
        h: wp.array[vec3],
        saturation: wp.array[dtype],
        slope: wp.array[dtype],
        curve: wp.array[int],
        law: int,
        kappa: dtype,
        precession: dtype,
        # in and out:
        first: wp.array[vec3],
        second: wp.array[vec3],
        # outputs:
        moments_out: wp.array[vec3],
        packed_out: wp.array2d[dtype],
    ):
        i = row_target[wp.tid()]
        if worlds[world[i]].active == 0:
            return
        u = first[i]
        v = second[i]
        h_eff = effective_field(h[i] / saturation[i], dtype(0.5) * (u + v), slope[i], curve[i])
        u = step_submagnetization(u, h_eff, kappa, precession, dtype(1.0), law)
        v = step_submagnetization(v, h_eff, kappa, precession, dtype(-1.0), law)
        first[i] = u
        second[i] = v
        store_magnetization(i, (dtype(0.5) * saturation[i]) * (u + v), moments_out, packed_out)

    return step_pairs


# ---------------------------------------------------------------------------------------------------------------------
# Launches
# ---------------------------------------------------------------------------------------------------------------------


def launch_split_magnetizations(rows, magnetizations, material, b: InductionBuffers, first, second):
    """Let pairs, symmetric about them, stand for given magnetizations [A/m], shape [n]; ends the worlds' cold start."""
    if rows.count == 0:
        return
    wp.launch(
        _split_kernel(material.saturation.dtype),
        dim=rows.count,
        inputs=[rows.target, b.world, magnetizations, material.saturation],
        outputs=[first, second, b.warm],
        device=b.h.device,
    )


def launch_begin(applied, partial, moments, external_field, material, b: InductionBuffers, first, second, moments_out):
    """Begin a solve from the applied field and, in worlds that are warm, from the pairs as they are.

    Args:
        applied: Work list, permanent moments on inducible ones.
        partial: Sums of the native field loop over ``applied``.
        moments: Packed moments with their overlaps (``warpmag.packed.PackedMoments``); gets the starting moments.
        external_field: External field [A/m], shape [n].
        material: What the moments are made of (``kernels.material.curves.CurveParameters``).
        b: Fields and world state.
        first: Directions of M1, shape [n].
        second: Directions of M2, shape [n].
        moments_out: Moments [A·m²], shape [n]; the inducible ones are written.
    """
    wp.launch_tiled(
        _begin_kernel(moments.dtype),
        dim=[b.chunk.shape[0]],
        inputs=[
            b.chunk,
            partial,
            moments.packed,
            applied.target,
            applied.begin,
            applied.end,
            moments.overlaps,
            moments.overlap_counts,
            external_field,
        ],
        outputs=[b.h0, b.start, b.worlds, b.condition],
        block_dim=CHUNK,
        device=moments.device,
    )
    wp.launch(
        _start_kernel(moments.dtype),
        dim=applied.count,
        inputs=[applied.target, b.world, b.warm, b.start, b.h0, material.saturation],
        outputs=[first, second, moments_out, moments.packed],
        device=moments.device,
    )


def launch_step_pairs(
    moments,
    rows,
    material,
    b: InductionBuffers,
    first,
    second,
    moments_out,
    *,
    law: int,
    kappa: float,
    precession: float,
    rtol: float,
    max_evaluations: int,
):
    """Judge the field at the inducible moments and step the pairs of every world that has not ended.

    Args:
        moments: Packed moments with their overlaps (``warpmag.packed.PackedMoments``).
        rows: Work list whose targets are the inducible moments, whose field stands in ``b.h``.
        material: What they are made of (``kernels.material.curves.CurveParameters``).
        b: Fields and world state; ``b.condition`` tells whether another evaluation is wanted.
        first: Directions of M1, shape [n].
        second: Directions of M2, shape [n].
        moments_out: Moments [A·m²], shape [n]; the inducible ones are written.
        law: ``THETA_EULER``, ``LLG`` or ``LLG_DAMPING``.
        kappa: Step κ = βΔtMs [dimensionless].
        precession: Precession over damping, 1/α or 0 [dimensionless].
        rtol: Relative residual ‖M − f(H)‖/‖f(H)‖ at which a world ends.
        max_evaluations: Field evaluations after which a world gives up.
    """
    device, dtype = moments.device, moments.dtype
    b.condition.zero_()  # until a world wants another evaluation
    wp.launch_tiled(
        _evaluate_kernel(dtype),
        dim=[b.chunk.shape[0]],
        inputs=[
            b.chunk,
            b.chunk_begin,
            rows.target,
            b.h,
            first,
            second,
            material.saturation,
            material.slope,
            material.curve,
            wp.float64(rtol),
            max_evaluations,
            b.worlds,
            b.sums,
            b.arrived,
        ],
        outputs=[b.start, b.error, b.evaluations, b.converged, b.warm, b.condition],
        block_dim=CHUNK,
        device=device,
    )
    wp.launch(
        _step_kernel(dtype),
        dim=rows.count,
        inputs=[
            rows.target,
            b.world,
            b.worlds,
            b.h,
            material.saturation,
            material.slope,
            material.curve,
            law,
            dtype(kappa),
            dtype(precession),
        ],
        outputs=[first, second, moments_out, moments.packed],
        device=device,
    )
