"""The accelerated θ flow, kept wholly on the device.

Unknown is the dual variable s = k f⁻¹(M)/Ms of every inducible moment, so that M = Ms c(‖s‖) ŝ. One field evaluation
gives the target g = k H(M)/Ms and the residual r = g − s; the exact θ flow moves s by ω r (``curves.theta_flow``).
With the iterate's differences Δs_j, Δr_j to the last few, Anderson's step is

    s̄ = s − Σ_j α_j Δs_j,   r̄ = r − Σ_j α_j Δr_j,   s ← s̄ + ω r̄,    α = argmin ‖φ r̄‖,

weighted by φ = Ms c(a)/a, a = max(‖s‖, ‖g‖): what a residual is worth in magnetization, so that a saturated moment's
huge s does not drown the rest. The plain step is mirror descent on the energy Σ V Φ(M) − ½ M·GM − H0·M, convex for the
ball-averaged kernel: with L = 1 + k |λmin| it descends from anywhere for ω ≤ 1/L, and close to the solution converges
for ω < 2/L; 1/3 − (1 + max o) ≤ λmin gives the bound (see ``neighbors``).

What a step changes is felt most by neighbours. Their part of it is known without another field evaluation: with the
coupling G' of the neighbours that ``neighbors`` lists, two sweeps s ← s + ω (ḡ + (k/Ms) G' (M(s) − M(s̄)) − s) follow,
ḡ = s̄ + r̄. From cold they spare a pile of touching balls 1 or 2 of 8 to 10 evaluations to 1e-3, and more where balls
overlap.

An accelerated step or a swept one that leaves the merit ‖φ r‖ more than twice the best is taken back, and a few plain
steps follow from the best iterate.

The residual that ends a solve is good for one more step: with that polished s, and its change β Δs to come, the next
solve starts, Δs the change since the solve before it. β is what would have predicted Δs from the change before it,
β = Δs·Δs'/‖Δs'‖² within [0, 1], for each moment by itself: smooth motion is followed, a jump is not repeated. A start
is only a start, and whatever it is worth the solve converges to the one solution.
"""

from functools import cache
from typing import Any

import warp as wp

from warpmag.kernels.anderson import DEPTH, SLOTS, anderson_coefficients, matrix_column, slot_of
from warpmag.kernels.curves import curve_ratio, inverse_curve_ratio, theta_flow
from warpmag.kernels.field import INVERSE_4PI, finished_field
from warpmag.kernels.induction import (
    CHUNK,
    COLUMNS,
    FIELD,
    GOAL,
    LACK,
    MERIT,
    STIFFNESS,
    TERMS,
    InductionBuffers,
    block_sum,
    relative_error,
    step_length,
    world_summation,
)
from warpmag.kernels.neighbors import near_field
from warpmag.kernels.packing import ball_volume, store_magnetization

PLAIN_STEPS = SLOTS
"""Plain steps after an accelerated one was taken back, before the next is tried."""
REST, RETREAT, ADVANCE, SWEEP = 0, 1, 2, 3
"""What a world does next: nothing, a plain step from the best iterate, a step, a step and sweeps over neighbours."""
STEADY = 3
"""Solves in a row that make two changes to extrapolate from."""


@cache
def _start_kernel(dtype):
    vec3 = wp.types.vector(3, dtype)

    @wp.kernel(module="unique", enable_backward=False)
    def start_moments(
        # inputs:
        row_target: wp.array[int],
        world: wp.array[int],
        warm: wp.array[int],
        start: wp.array2d[wp.float64],
        h0: wp.array[vec3],
        saturation: wp.array[dtype],
        slope: wp.array[dtype],
        curve: wp.array[int],
        # in and out:
        s_inout: wp.array[vec3],
        last_s: wp.array[vec3],
        last_change: wp.array[vec3],
        # outputs:
        moments_out: wp.array[vec3],
        packed_out: wp.array2d[dtype],
    ):
        i = row_target[wp.tid()]
        w = world[i]
        s = s_inout[i]
        change = s - last_s[i]
        earlier = last_change[i]
        # without a field the one solution is no magnetization, which a cold start hits
        cold = warm[w] == 0 or start[w, wp.static(FIELD)] == wp.float64(0.0)
        if cold:
            # the θ flow with κ = k from no magnetization: exact for a lone ball; shorter where balls overlap deeply
            step = wp.min(dtype(1.0), dtype(step_length(start[w, wp.static(STIFFNESS)])) / dtype(0.6))
            s = (step * slope[i] / saturation[i]) * h0[i]
            change = vec3()
        last_s[i] = s
        last_change[i] = change
        square = wp.dot(earlier, earlier)
        if warm[w] == wp.static(STEADY) and square > dtype(0.0):
            s += wp.clamp(wp.dot(change, earlier) / square, dtype(0.0), dtype(1.0)) * change
        s_inout[i] = s
        store_magnetization(i, (saturation[i] * curve_ratio(wp.length(s), curve[i])) * s, moments_out, packed_out)

    return start_moments


@cache
def _set_state_kernel(dtype):
    vec3 = wp.types.vector(3, dtype)

    @wp.kernel(module="unique", enable_backward=False)
    def set_state(
        # inputs:
        row_target: wp.array[int],
        world: wp.array[int],
        magnetizations: wp.array[vec3],
        saturation: wp.array[dtype],
        curve: wp.array[int],
        # outputs:
        s_out: wp.array[vec3],
        warm_out: wp.array[int],
    ):
        i = row_target[wp.tid()]
        reduced = magnetizations[i] / saturation[i]
        s_out[i] = inverse_curve_ratio(wp.length(reduced), curve[i]) * reduced
        warm_out[world[i]] = 1

    return set_state


@wp.func
def product(a: Any, b: Any):
    """Product of two vectors in float64."""
    total = wp.float64(0.0)
    for k in range(3):
        total += wp.float64(a[k]) * wp.float64(b[k])
    return total


@cache
def _residual_kernel(dtype):
    vec3 = wp.types.vector(3, dtype)
    differences = wp.types.matrix((DEPTH, 3), dtype)
    columns = wp.types.vector(COLUMNS, wp.float64)
    finish = finished_field(dtype)

    @wp.kernel(module="unique", enable_backward=False)
    def residuals(
        # inputs:
        chunk: wp.array[wp.vec3i],
        partial: wp.array3d[dtype],
        packed: wp.array2d[dtype],
        row_target: wp.array[int],
        row_begin: wp.array[int],
        row_end: wp.array[int],
        neighbor: wp.array2d[int],
        neighbor_count: wp.array[int],
        h0: wp.array[vec3],
        s_in: wp.array[vec3],
        saturation: wp.array[dtype],
        slope: wp.array[dtype],
        curve: wp.array[int],
        active: wp.array[int],
        history: wp.array[int],
        slot: wp.array[int],
        # outputs:
        h_out: wp.array[vec3],
        history_s_out: wp.array2d[vec3],
        history_r_out: wp.array2d[vec3],
        sums_out: wp.array2d[wp.float64],
        condition_out: wp.array[int],
    ):
        c, lane = wp.tid()
        if c == 0 and lane == 0:
            condition_out[0] = 0
        w = chunk[c][2]
        if active[w] == 0:
            return
        current = slot[w]
        mine = columns()
        for row in range(chunk[c][0] + lane, chunk[c][1], wp.block_dim()):
            i = row_target[row]
            h = h0[i] + finish(
                partial, packed, packed, row, i, row_begin[row], row_end[row], 1, neighbor, neighbor_count
            )
            h_out[i] = h
            s = s_in[i]
            g = (slope[i] / saturation[i]) * h
            r = g - s
            history_s_out[current, i] = s
            history_r_out[current, i] = r
            length_s = wp.length(s)
            length_g = wp.length(g)
            worth_s = saturation[i] * curve_ratio(length_s, curve[i])
            worth_g = saturation[i] * curve_ratio(length_g, curve[i])
            # lengths, not squares: a field of 1e-20 A/m squared is no float32
            goal_length = wp.float64(worth_g * length_g)
            lack_length = wp.float64(wp.length(worth_g * g - worth_s * s))
            weight = wp.float64(wp.where(length_s > length_g, worth_s, worth_g))
            merit = weight * wp.float64(wp.length(r))
            mine[wp.static(LACK)] += lack_length * lack_length
            mine[wp.static(GOAL)] += goal_length * goal_length
            mine[wp.static(MERIT)] += merit * merit
            change = differences()
            for a in range(wp.static(DEPTH)):
                if a < history[w]:
                    old = history_r_out[slot_of(current, a + 1), i]
                    for k in range(3):
                        change[a, k] = r[k] - old[k]
                    mine[wp.static(TERMS) + a] += weight * weight * product(change[a], r)
                    for b in range(a + 1):
                        mine[wp.static(TERMS) + matrix_column(b, a)] += weight * weight * product(change[b], change[a])
        total = block_sum(mine)
        if lane == 0:
            for column in range(wp.static(COLUMNS)):
                sums_out[c, column] = total[column]

    return residuals


_sum_world = world_summation(COLUMNS)


@wp.kernel(enable_backward=False)
def decide(
    # inputs:
    chunk_begin: wp.array[int],
    sums: wp.array2d[wp.float64],
    rtol: wp.float64,
    max_evaluations: int,
    # in and out:
    start: wp.array2d[wp.float64],
    active: wp.array[int],
    history: wp.array[int],
    slot: wp.array[int],
    plain_steps: wp.array[int],
    best: wp.array[wp.float64],
    evaluations: wp.array[int],
    warm: wp.array[int],
    # outputs:
    world_sums_out: wp.array2d[wp.float64],
    omega_out: wp.array[wp.float64],
    error_out: wp.array[wp.float64],
    converged_out: wp.array[int],
    mode_out: wp.array[int],
    improved_out: wp.array[int],
    used_slot_out: wp.array[int],
    used_history_out: wp.array[int],
    alpha_out: wp.array2d[wp.float64],
    condition_out: wp.array[int],
):
    """Judge each world's iterate and choose its next step; a block sums a world, its first thread judges."""
    w, lane = wp.tid()
    if active[w] == 0:
        if lane == 0:
            mode_out[w] = wp.static(REST)
        return
    _sum_world(w, lane, chunk_begin[w], chunk_begin[w + 1], sums, world_sums_out)
    if lane > 0:
        return
    mode_out[w] = wp.static(REST)
    evaluations[w] = evaluations[w] + 1
    merit = wp.sqrt(world_sums_out[w, wp.static(MERIT)])
    error = relative_error(world_sums_out, w)
    error_out[w] = error
    lost = not wp.isfinite(merit)
    first = best[w] < wp.float64(0.0)
    if evaluations[w] == 1:
        omega_out[w] = step_length(start[w, wp.static(STIFFNESS)])
        start[w, wp.static(STIFFNESS)] = wp.float64(0.0)
        start[w, wp.static(FIELD)] = wp.float64(0.0)
    if error <= rtol or evaluations[w] >= max_evaluations or (first and lost):
        active[w] = 0
        converged_out[w] = wp.where(error <= rtol, 1, 0)
        # a state that is not finite must not be the next start
        warm[w] = wp.where(lost, 0, wp.min(warm[w] + 1, wp.static(STEADY)))
        if lost:
            return
    else:
        condition_out[0] = 1
    current = slot[w]
    used_slot_out[w] = current
    improved_out[w] = 0
    # plain steps descend in energy whatever the merit does on the way, so only accelerated ones are judged by it
    if lost or (not first and plain_steps[w] == 0 and merit > wp.float64(2.0) * best[w]):
        mode_out[w] = wp.static(RETREAT)
        plain_steps[w] = wp.static(PLAIN_STEPS)
        history[w] = 0
        return
    mode_out[w] = wp.static(ADVANCE)
    plain_steps[w] = wp.max(plain_steps[w] - 1, 0)
    descended = plain_steps[w] == 0 and history[w] == wp.static(DEPTH) and used_history_out[w] == 0
    if first or merit < best[w] or descended:
        best[w] = merit
        improved_out[w] = 1
        plain_steps[w] = 0
    used = wp.where(plain_steps[w] > 0, 0, history[w])
    if active[w] == 1 and plain_steps[w] == 0:
        mode_out[w] = wp.static(SWEEP)
    alpha = anderson_coefficients(world_sums_out, w, wp.static(TERMS), used)
    for a in range(wp.static(DEPTH)):
        alpha_out[w, a] = alpha[a]
    used_history_out[w] = used
    history[w] = wp.min(history[w] + 1, wp.static(DEPTH))
    slot[w] = (current + 1) % wp.static(SLOTS)


@cache
def _advance_kernel(dtype):
    vec3 = wp.types.vector(3, dtype)

    @wp.kernel(module="unique", enable_backward=False)
    def advance(
        # inputs:
        row_target: wp.array[int],
        world: wp.array[int],
        mode: wp.array[int],
        improved: wp.array[int],
        used_slot: wp.array[int],
        used_history: wp.array[int],
        active: wp.array[int],
        alpha: wp.array2d[wp.float64],
        omega: wp.array[wp.float64],
        history_s: wp.array2d[vec3],
        history_r: wp.array2d[vec3],
        saturation: wp.array[dtype],
        curve: wp.array[int],
        # in and out:
        best_s: wp.array[vec3],
        best_r: wp.array[vec3],
        # outputs:
        s_out: wp.array[vec3],
        mixed_g_out: wp.array[vec3],
        mixed_moment_out: wp.array[vec3],
        change_out: wp.array[vec3],
        moments_out: wp.array[vec3],
        packed_out: wp.array2d[dtype],
    ):
        i = row_target[wp.tid()]
        w = world[i]
        if mode[w] == wp.static(REST):
            return
        s = best_s[i]
        r = best_r[i]
        if mode[w] != wp.static(RETREAT):
            current = used_slot[w]
            s_now = history_s[current, i]
            r_now = history_r[current, i]
            if improved[w] == 1:
                best_s[i] = s_now
                best_r[i] = r_now
            s = s_now
            r = r_now
            for a in range(used_history[w]):
                old = slot_of(current, a + 1)
                s -= dtype(alpha[w, a]) * (s_now - history_s[old, i])
                r -= dtype(alpha[w, a]) * (r_now - history_r[old, i])
        mixed = s
        s = theta_flow(mixed, mixed + r, dtype(omega[w]))
        s_out[i] = s
        # what has ended keeps the moments that its error was measured at, and s is the next solve's start
        if active[w] == 1:
            magnetization = (saturation[i] * curve_ratio(wp.length(s), curve[i])) * s
            store_magnetization(i, magnetization, moments_out, packed_out)
            if mode[w] == wp.static(SWEEP):
                before = (saturation[i] * curve_ratio(wp.length(mixed), curve[i])) * mixed
                mixed_g_out[i] = mixed + r
                mixed_moment_out[i] = ball_volume(packed_out[3, i]) * before
                change_out[i] = ball_volume(packed_out[3, i]) * (magnetization - before)

    return advance


@cache
def _sweep_kernel(dtype):
    vec3 = wp.types.vector(3, dtype)

    @wp.kernel(module="unique", enable_backward=False)
    def sweep(
        # inputs:
        row_target: wp.array[int],
        row_begin: wp.array[int],
        row_end: wp.array[int],
        neighbor: wp.array2d[int],
        neighbor_count: wp.array[int],
        world: wp.array[int],
        mode: wp.array[int],
        omega: wp.array[wp.float64],
        mixed_g: wp.array[vec3],
        mixed_moment: wp.array[vec3],
        change: wp.array[vec3],
        saturation: wp.array[dtype],
        slope: wp.array[dtype],
        curve: wp.array[int],
        # outputs:
        s_out: wp.array[vec3],
        change_out: wp.array[vec3],
        moments_out: wp.array[vec3],
        packed_out: wp.array2d[dtype],
    ):
        row = wp.tid()
        i = row_target[row]
        w = world[i]
        if mode[w] != wp.static(SWEEP):
            return
        h = near_field(packed_out, change, i, row_begin[row], row_end[row], neighbor, neighbor_count)
        g = mixed_g[i] + (dtype(wp.static(INVERSE_4PI)) * slope[i] / saturation[i]) * h
        s = theta_flow(s_out[i], g, dtype(omega[w]))
        s_out[i] = s
        store_magnetization(i, (saturation[i] * curve_ratio(wp.length(s), curve[i])) * s, moments_out, packed_out)
        change_out[i] = moments_out[i] - mixed_moment[i]

    return sweep


def launch_set_state(rows, magnetizations, material, b: InductionBuffers):
    """Take given magnetizations [A/m], shape [n], for the last solution of all worlds; ``rows`` as in launch_start."""
    if rows.count == 0:
        return
    wp.launch(
        _set_state_kernel(material.saturation.dtype),
        dim=rows.count,
        inputs=[rows.target, b.world, magnetizations, material.saturation, material.curve],
        outputs=[b.s, b.warm],
        device=b.h.device,
    )


def launch_start(rows, moments, material, b: InductionBuffers, moments_out):
    """Set the moments that a solve starts from: in worlds that are warm what is left of the last solves.

    Args:
        rows: Work list whose targets are the inducible moments.
        moments: Packed moments (``warpmag.packed.PackedMoments``); gets the starting moments.
        material: What they are made of (``kernels.wrench.Material``).
        b: The buffers, as ``induction.launch_begin`` left them.
        moments_out: Moments [A·m²], shape [n]; the inducible ones are written.
    """
    wp.launch(
        _start_kernel(moments.dtype),
        dim=rows.count,
        inputs=[rows.target, b.world, b.warm, b.start, b.h0, material.saturation, material.slope, material.curve],
        outputs=[b.s, b.last_s, b.last_change, moments_out, moments.packed],
        device=moments.device,
    )


def launch_iteration(rows, partial, moments, material, b: InductionBuffers, rtol, max_evaluations, moments_out):
    """Judge the field just summed into ``partial`` and move every world that has not ended; see the module.

    Args:
        rows: Work list whose targets are the inducible moments.
        partial: Sums of the native field loop over ``rows``.
        moments: Packed moments with their neighbours (``warpmag.packed.PackedMoments``).
        material: What they are made of (``kernels.wrench.Material``).
        b: The buffers; ``b.condition`` tells whether another evaluation is wanted.
        rtol: Relative residual ‖M − f(H)‖/‖f(H)‖ at which a world ends.
        max_evaluations: Field evaluations after which a world gives up.
        moments_out: Moments [A·m²], shape [n]; the inducible ones are written.
    """
    _launch_judgement(rows, partial, moments, material, b, rtol, max_evaluations)
    _launch_step(rows, moments, material, b, moments_out)


def _launch_judgement(rows, partial, moments, material, b, rtol, max_evaluations):
    """Residuals and their sums, and what they make of each world."""
    device, dtype = moments.device, moments.dtype
    wp.launch_tiled(
        _residual_kernel(dtype),
        dim=[b.chunk.shape[0]],
        inputs=[
            b.chunk,
            partial,
            moments.packed,
            rows.target,
            rows.begin,
            rows.end,
            moments.neighbors,
            moments.neighbor_counts,
            b.h0,
            b.s,
            material.saturation,
            material.slope,
            material.curve,
            b.active,
            b.history,
            b.slot,
        ],
        outputs=[b.h, b.history_s, b.history_r, b.sums, b.condition],
        block_dim=CHUNK,
        device=device,
    )
    wp.launch_tiled(
        decide,
        dim=[b.omega.shape[0]],
        inputs=[
            b.chunk_begin,
            b.sums,
            wp.float64(rtol),
            max_evaluations,
            b.start,
            b.active,
            b.history,
            b.slot,
            b.plain_steps,
            b.best,
            b.evaluations,
            b.warm,
        ],
        outputs=[
            b.world_sums,
            b.omega,
            b.error,
            b.converged,
            b.mode,
            b.improved,
            b.used_slot,
            b.used_history,
            b.alpha,
            b.condition,
        ],
        block_dim=CHUNK,
        device=device,
    )


def _launch_step(rows, moments, material, b, moments_out):
    """The step that was decided on, and two sweeps over neighbours."""
    device, dtype = moments.device, moments.dtype
    wp.launch(
        _advance_kernel(dtype),
        dim=rows.count,
        inputs=[
            rows.target,
            b.world,
            b.mode,
            b.improved,
            b.used_slot,
            b.used_history,
            b.active,
            b.alpha,
            b.omega,
            b.history_s,
            b.history_r,
            material.saturation,
            material.curve,
            b.best_s,
            b.best_r,
        ],
        outputs=[b.s, b.mixed_g, b.mixed_moment, b.change, moments_out, moments.packed],
        device=device,
    )
    for change, next_change in ((b.change, b.next_change), (b.next_change, b.change)):
        wp.launch(
            _sweep_kernel(dtype),
            dim=rows.count,
            inputs=[
                rows.target,
                rows.begin,
                rows.end,
                moments.neighbors,
                moments.neighbor_counts,
                b.world,
                b.mode,
                b.omega,
                b.mixed_g,
                b.mixed_moment,
                change,
                material.saturation,
                material.slope,
                material.curve,
            ],
            outputs=[b.s, next_change, moments_out, moments.packed],
            device=device,
        )
