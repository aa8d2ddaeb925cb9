"""The accelerated θ flow, kept wholly on the device.

Unknown is the dual variable s = k f⁻¹(M)/Ms of every inducible moment, so that M = Ms c(‖s‖) ŝ. One field evaluation
gives the target g = k H(M)/Ms and the residual r = g − s; the exact θ flow moves s by ω r (``curves.theta_flow``).
With the last few changes Δs_j, Δr_j from one evaluation to the next, Anderson's step is

    s̄ = s − Σ_j α_j Δs_j,   r̄ = r − Σ_j α_j Δr_j,   s ← s̄ + ω r̄,    α = argmin ‖φ r̄‖,

weighted by φ = Ms c(a)/a, a = max(‖s‖, ‖g‖): what a residual is worth in magnetization, so that a saturated moment's
huge s does not drown the rest. The plain step is mirror descent on the energy Σ V Φ(M) − ½ M·GM − H0·M, convex for the
ball-averaged kernel: with L = 1 + k |λmin| it descends from anywhere for ω ≤ 1/L, and close to the solution converges
for ω < 2/L; 1/3 − (1 + max o) ≤ λmin gives the bound (see ``neighbors``).

What a step changes is felt most by neighbours. Their part of it is known without another field evaluation: with the
coupling G' of the neighbours that ``neighbors`` lists, two sweeps s ← s + ω' (ḡ + (k/Ms) G' (M(s) − M(s̄)) − s)
follow, ḡ = s̄ + r̄, ω' a little above ω. From cold they spare a pile of touching balls 1 or 2 of 8 to 10 evaluations to
1e-3, and more where balls overlap.

An accelerated step or a swept one that leaves the merit ‖φ r‖ more than twice the best is taken back, and a few plain
steps follow from the best iterate.

The residual that ends a solve is good for one more step: that polished s, further by β Δg, is where the next solve
starts, Δg the last change of g from solve to solve. Sweeps over neighbours go before its first evaluation: what these
are to each other is known exactly where they stand now, and of the field of all others, F = H − H0 − G' M, it is
F₁ + β (F₁ − F₂) that they use, F of the last solve and of the one before for the present neighbours. Both are those of
s̄ and ḡ, which are nearer to the solution than what was judged. β is what would have predicted the last change from the
one before it, β = ⟨φΔg, φΔg'⟩/‖φΔg'‖² within [0, 1], one for a world: smooth motion is followed, noise is not. The
changes Δs_j, Δr_j outlive a solve, since what they tell of the coupling hardly changes: a slow mode, as of long columns
of balls, costs one evaluation instead of three. All that leaves 1.5 evaluations a solve where 2,500 balls jump (Balls
Up). A start is only a start, and whatever it is worth the solve converges to the one solution.

``theta_flow_cpu`` does the same on a CPU.
"""

from functools import cache
from typing import Any

import warp as wp

from warpmag.kernels.induction.anderson import DEPTH, anderson_solver, matrix_column, slot_of
from warpmag.kernels.induction.solve_state import (
    CHUNK,
    COLUMNS,
    EARLIER,
    FIELD,
    FOLLOWED,
    GOAL,
    LACK,
    MERIT,
    STIFFNESS,
    TERMS,
    InductionBuffers,
    World,
    applied_field,
    begin_world,
    relative_error,
    step_length,
    world_summation,
)
from warpmag.kernels.material.curves import curve_ratio, inverse_curve_ratio, theta_flow
from warpmag.kernels.pairs.field import INVERSE_4PI
from warpmag.kernels.pairs.neighbors import extrapolated_near_field, near_field, shared_volume
from warpmag.kernels.pairs.packing import ball_volume, store_magnetization
from warpmag.kernels.shared.reductions import block_max, block_sum, group_sum, group_threads

PLAIN_STEPS = DEPTH + 1
"""Plain steps after an accelerated one was taken back, before the next is tried."""
REST, VANISH, RETREAT, ADVANCE, SWEEP = 0, 1, 2, 3, 4
"""What a world does next: nothing; no magnetization, where there is no field; a plain step from the best iterate; a
step; a step and sweeps over neighbours."""
STEADY = 3
"""Solves in a row that make two changes to extrapolate from."""
_BEGINNERS = 4
"""Blocks that share the moments of a chunk at the start of a solve, where a moment takes many threads."""
SWEEP_STEP = 1.4
"""Step length of a sweep over that of a step: long chains of balls near their solution want more than is safe alone."""


@wp.func
def open_world(w: int, warm: int, worlds: wp.array[World]):
    """Let a world start from what it remembers."""
    worlds[w].mode = wp.where(warm == wp.static(STEADY), wp.static(SWEEP), wp.static(REST))
    if warm == 0:
        worlds[w].kept = 0


@cache
def _begin_kernel(dtype):
    vec3 = wp.types.vector(3, dtype)
    sum_group = group_sum(wp.types.vector(7, dtype))
    apply_field = applied_field(dtype)

    @wp.kernel(module="unique", enable_backward=False)
    def begin_flow(
        # inputs:
        chunk: wp.array[wp.vec3i],
        partial: wp.array3d[dtype],
        packed: wp.array2d[dtype],
        row_target: wp.array[int],
        source_begin: wp.array[int],
        source_end: wp.array[int],
        induced_begin: wp.array[int],
        induced_end: wp.array[int],
        neighbor: wp.array2d[int],
        neighbor_count: wp.array[int],
        overlap: wp.array2d[int],
        overlap_count: wp.array[int],
        external_field: wp.array[vec3],
        warm: wp.array[int],
        past_positions: wp.array2d[vec3],
        past_moments: wp.array2d[vec3],
        past_field: wp.array2d[vec3],
        past_g: wp.array2d[vec3],
        saturation: wp.array[dtype],
        slope: wp.array[dtype],
        curve: wp.array[int],
        shares: int,
        # in and out:
        s_inout: wp.array[vec3],
        # outputs:
        h0_out: wp.array[vec3],
        mixed_g_out: wp.array[vec3],
        mixed_moment_out: wp.array[vec3],
        change_out: wp.array[vec3],
        moments_out: wp.array[vec3],
        packed_out: wp.array2d[dtype],
        start_out: wp.array2d[wp.float64],
        worlds_out: wp.array[World],
        condition_out: wp.array[int],
    ):
        block, lane = wp.tid()
        c = block // wp.static(_BEGINNERS)
        at_once = (wp.block_dim() + shares - 1) // shares
        share = lane % shares
        w = chunk[c][2]
        steady = warm[w] == wp.static(STEADY)
        ahead = dtype(worlds_out[w].ahead)
        field = wp.float64(0.0)
        stiffest = wp.float64(0.0)
        begin = chunk[c][0] + at_once * (block % wp.static(_BEGINNERS)) + lane // shares
        for row in range(begin, chunk[c][1], at_once * wp.static(_BEGINNERS)):
            i = row_target[row]
            first = induced_begin[row]
            last = induced_end[row]
            k = slope[i]
            limit = saturation[i]
            applied = apply_field(
                partial,
                packed,
                row,
                i,
                source_begin[row],
                source_end[row],
                overlap,
                overlap_count,
                external_field,
                share,
                shares,
            )
            near = vec3()
            if steady:
                near = extrapolated_near_field(
                    packed, past_positions, past_moments, ahead, i, first, last, neighbor, neighbor_count, share, shares
                )
            volume = shared_volume(packed, i, first, last, overlap, overlap_count, share, shares)
            mine = wp.vector(applied[0], applied[1], applied[2], near[0], near[1], near[2], volume, length=7)
            about = sum_group(mine, shares)
            h0 = vec3(about[0], about[1], about[2])
            stiffness = wp.float64(k * (about[6] + dtype(wp.static(2.0 / 3.0))))
            field = wp.max(field, wp.float64(wp.length(h0)))
            stiffest = wp.max(stiffest, stiffness)
            if share == 0:
                h0_out[i] = h0
                s = s_inout[i]
                if warm[w] == 0:
                    # the θ flow with κ = k from no magnetization: exact for a lone ball; shorter where balls overlap
                    # deeply
                    step = wp.min(dtype(1.0), dtype(step_length(stiffness)) / dtype(0.6))
                    s = (step * k / limit) * h0
                if steady:
                    s += ahead * (past_g[0, i] - past_g[1, i])
                s_inout[i] = s
                store_magnetization(i, (limit * curve_ratio(wp.length(s), curve[i])) * s, moments_out, packed_out)
                if steady:
                    near = dtype(wp.static(INVERSE_4PI)) * vec3(about[3], about[4], about[5])
                    far = past_field[0, i] + ahead * (past_field[0, i] - past_field[1, i]) - near
                    mixed_g_out[i] = (k / limit) * (h0 + far)
                    mixed_moment_out[i] = vec3()
                    change_out[i] = moments_out[i]
        field = block_max(field)
        stiffest = block_max(stiffest)
        if lane == 0:
            begin_world(w, field, stiffest, start_out, worlds_out, condition_out)
            open_world(w, warm[w], worlds_out)

    return begin_flow


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


columns = wp.types.vector(COLUMNS, wp.float64)
_sum_world = world_summation(COLUMNS)
_solve = anderson_solver(COLUMNS, TERMS)


@cache
def _measured(dtype):
    """Warp function that notes an iterate's residual and returns what a moment adds to its world's sums."""
    vec3 = wp.types.vector(3, dtype)
    differences = wp.types.matrix((DEPTH, 3), dtype)

    @wp.func
    def measure(
        i: int,
        h: vec3,
        s: vec3,
        saturation: dtype,
        slope: dtype,
        curve: int,
        linked: int,
        newest: int,
        kept: int,
        past_g: wp.array2d[vec3],
        iterate_s: wp.array[vec3],
        iterate_r: wp.array[vec3],
        history_s: wp.array2d[vec3],
        history_r: wp.array2d[vec3],
    ):
        mine = columns()
        g = (slope / saturation) * h
        r = g - s
        if linked == 1:
            history_s[newest, i] = s - iterate_s[i]
            history_r[newest, i] = r - iterate_r[i]
        iterate_s[i] = s
        iterate_r[i] = r
        length_s = wp.length(s)
        length_g = wp.length(g)
        worth_s = saturation * curve_ratio(length_s, curve)
        worth_g = saturation * curve_ratio(length_g, curve)
        # lengths, not squares: a field of 1e-20 A/m squared is no float32
        goal_length = wp.float64(worth_g * length_g)
        lack_length = wp.float64(wp.length(worth_g * g - worth_s * s))
        weight = wp.float64(wp.where(length_s > length_g, worth_s, worth_g))
        merit = weight * wp.float64(wp.length(r))
        mine[wp.static(LACK)] = lack_length * lack_length
        mine[wp.static(GOAL)] = goal_length * goal_length
        mine[wp.static(MERIT)] = merit * merit
        earlier = past_g[0, i] - past_g[1, i]
        mine[wp.static(FOLLOWED)] = weight * weight * product(g - past_g[0, i], earlier)
        mine[wp.static(EARLIER)] = weight * weight * product(earlier, earlier)
        change = differences()
        for a in range(wp.static(DEPTH)):
            if a < kept:
                old = history_r[slot_of(newest, a), i]
                for k in range(3):
                    change[a, k] = old[k]
                mine[wp.static(TERMS) + a] = weight * weight * product(change[a], r)
                for b in range(a + 1):
                    mine[wp.static(TERMS) + matrix_column(b, a)] = weight * weight * product(change[b], change[a])
        return mine

    return measure


@wp.func
def decide(
    w: int,
    sums: columns,
    newest: int,
    kept: int,
    rtol: wp.float64,
    max_evaluations: int,
    start: wp.array2d[wp.float64],
    worlds: wp.array[World],
    warm: wp.array[int],
    error_out: wp.array[wp.float64],
    evaluations_out: wp.array[int],
    converged_out: wp.array[int],
    condition_out: wp.array[int],
):
    """Judge a world's iterate by its sums and choose its next step."""
    error = relative_error(sums)
    merit = wp.sqrt(sums[wp.static(MERIT)])
    best = worlds[w].best
    plain_steps = worlds[w].plain_steps
    evaluations = worlds[w].evaluations + 1
    lost = not wp.isfinite(merit)
    first = best < wp.float64(0.0)
    done = error <= rtol or evaluations >= max_evaluations or (first and lost)
    fieldless = False
    if evaluations == 1:
        fieldless = start[w, wp.static(FIELD)] == wp.float64(0.0)
        worlds[w].omega = step_length(start[w, wp.static(STIFFNESS)])
        start[w, wp.static(STIFFNESS)] = wp.float64(0.0)
        start[w, wp.static(FIELD)] = wp.float64(0.0)
    error_out[w] = error
    evaluations_out[w] = evaluations
    worlds[w].evaluations = evaluations
    worlds[w].newest = newest
    worlds[w].improved = 0
    mode = int(ADVANCE)
    if done:
        worlds[w].active = 0
        converged_out[w] = wp.where(error <= rtol, 1, 0)
        # a state that is not finite must not be the next start
        warm[w] = wp.where(lost, 0, wp.min(warm[w] + 1, wp.static(STEADY)))
        earlier = sums[wp.static(EARLIER)]
        followed = wp.where(earlier > wp.float64(0.0), sums[wp.static(FOLLOWED)] / earlier, wp.float64(0.0))
        worlds[w].ahead = wp.clamp(followed, wp.float64(0.0), wp.float64(1.0))
    else:
        converged_out[w] = 0
        condition_out[0] = 1
    # plain steps descend in energy whatever the merit does on the way, so only accelerated ones are judged by it
    if done and lost:
        mode = REST
    elif fieldless and not done:
        mode = VANISH
    elif lost or (not first and plain_steps == 0 and merit > wp.float64(2.0) * best):
        mode = RETREAT
        plain_steps = wp.static(PLAIN_STEPS)
    else:
        plain_steps = wp.max(plain_steps - 1, 0)
        descended = plain_steps == 0 and kept == wp.static(DEPTH) and worlds[w].used == 0
        if first or merit < best or descended:
            worlds[w].best = merit
            worlds[w].improved = 1
            plain_steps = 0
        used = wp.where(plain_steps > 0, 0, kept)
        worlds[w].used = used
        worlds[w].alpha = _solve(sums, used)
        if not done and plain_steps == 0:
            mode = SWEEP
    worlds[w].mode = mode
    worlds[w].plain_steps = plain_steps
    worlds[w].linked = wp.where(mode >= wp.static(ADVANCE), 1, 0)
    worlds[w].kept = wp.where(mode >= wp.static(ADVANCE), kept, 0)


@cache
def _judgement_kernel(dtype):
    """Kernel whose blocks judge a chunk of a world each."""
    vec3 = wp.types.vector(3, dtype)
    measure = _measured(dtype)

    @wp.kernel(module="unique", enable_backward=False)
    def judge_iterates(
        # inputs:
        chunk: wp.array[wp.vec3i],
        chunk_begin: wp.array[int],
        row_target: wp.array[int],
        h: wp.array[vec3],
        s_in: wp.array[vec3],
        saturation: wp.array[dtype],
        slope: wp.array[dtype],
        curve: wp.array[int],
        rtol: wp.float64,
        max_evaluations: int,
        # in and out:
        worlds: wp.array[World],
        start: wp.array2d[wp.float64],
        warm: wp.array[int],
        sums: wp.array2d[wp.float64],
        arrived: wp.array[int],
        past_g: wp.array2d[vec3],
        iterate_s: wp.array[vec3],
        iterate_r: wp.array[vec3],
        history_s: wp.array2d[vec3],
        history_r: wp.array2d[vec3],
        # outputs:
        error_out: wp.array[wp.float64],
        evaluations_out: wp.array[int],
        converged_out: wp.array[int],
        condition_out: wp.array[int],
    ):
        c, lane = wp.tid()
        w = chunk[c][2]
        if worlds[w].active == 0:
            if c == chunk_begin[w] and lane == 0:
                worlds[w].mode = wp.static(REST)
            return
        linked = worlds[w].linked
        newest = (worlds[w].newest + linked) % wp.static(DEPTH)
        kept = wp.min(worlds[w].kept + linked, wp.static(DEPTH))
        mine = columns()
        for row in range(chunk[c][0] + lane, chunk[c][1], wp.block_dim()):
            i = row_target[row]
            mine += measure(
                i, h[i], s_in[i], saturation[i], slope[i], curve[i], linked, newest, kept, past_g, iterate_s,
                iterate_r, history_s, history_r,
            )  # fmt: skip
        last, total = _sum_world(block_sum(mine), c, lane, w, chunk_begin[w], chunk_begin[w + 1], sums, arrived)
        if last and lane == 0:
            decide(
                w,
                total,
                newest,
                kept,
                rtol,
                max_evaluations,
                start,
                worlds,
                warm,
                error_out,
                evaluations_out,
                converged_out,
                condition_out,
            )

    return judge_iterates


@cache
def _advance_kernel(dtype):
    vec3 = wp.types.vector(3, dtype)

    @wp.kernel(module="unique", enable_backward=False)
    def advance(
        # inputs:
        row_target: wp.array[int],
        world: wp.array[int],
        worlds: wp.array[World],
        iterate_s: wp.array[vec3],
        iterate_r: wp.array[vec3],
        history_s: wp.array2d[vec3],
        history_r: wp.array2d[vec3],
        saturation: wp.array[dtype],
        slope: wp.array[dtype],
        curve: wp.array[int],
        h0: wp.array[vec3],
        # in and out:
        best_s: wp.array[vec3],
        best_r: wp.array[vec3],
        past_positions: wp.array2d[vec3],
        past_moments: wp.array2d[vec3],
        past_field: wp.array2d[vec3],
        past_g: wp.array2d[vec3],
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
        mode = worlds[w].mode
        if mode == wp.static(REST):
            return
        s = vec3()
        r = vec3()
        if mode == wp.static(RETREAT):
            s = best_s[i]
            r = best_r[i]
        elif mode != wp.static(VANISH):
            s = iterate_s[i]
            r = iterate_r[i]
            if worlds[w].improved == 1:
                best_s[i] = s
                best_r[i] = r
            for a in range(wp.static(DEPTH)):
                if a < worlds[w].used:
                    old = slot_of(worlds[w].newest, a)
                    alpha = dtype(worlds[w].alpha[a])
                    s -= alpha * history_s[old, i]
                    r -= alpha * history_r[old, i]
        limit = saturation[i]
        law = curve[i]
        mixed = s
        s = theta_flow(mixed, mixed + r, dtype(worlds[w].omega))
        s_out[i] = s
        # what has ended keeps the moments that its error was measured at, and s is the next solve's start
        if worlds[w].active == 1:
            magnetization = (limit * curve_ratio(wp.length(s), law)) * s
            store_magnetization(i, magnetization, moments_out, packed_out)
            if mode == wp.static(SWEEP):
                before = (limit * curve_ratio(wp.length(mixed), law)) * mixed
                mixed_g_out[i] = mixed + r
                mixed_moment_out[i] = ball_volume(packed_out[3, i]) * before
                change_out[i] = ball_volume(packed_out[3, i]) * (magnetization - before)
        else:
            past_positions[1, i] = past_positions[0, i]
            past_moments[1, i] = past_moments[0, i]
            past_field[1, i] = past_field[0, i]
            past_g[1, i] = past_g[0, i]
            past_positions[0, i] = vec3(packed_out[0, i], packed_out[1, i], packed_out[2, i])
            # the mixed iterate is nearer to the solution than the one that was judged
            g = mixed + r
            past_moments[0, i] = (ball_volume(packed_out[3, i]) * limit * curve_ratio(wp.length(mixed), law)) * mixed
            past_field[0, i] = (limit / slope[i]) * g - h0[i]
            past_g[0, i] = g

    return advance


@cache
def _sweep_kernel(dtype):
    vec3 = wp.types.vector(3, dtype)
    sum_group = group_sum(vec3)

    @wp.kernel(module="unique", enable_backward=False)
    def sweep(
        # inputs:
        row_target: wp.array[int],
        row_begin: wp.array[int],
        row_end: wp.array[int],
        neighbor: wp.array2d[int],
        neighbor_count: wp.array[int],
        world: wp.array[int],
        worlds: wp.array[World],
        mixed_g: wp.array[vec3],
        mixed_moment: wp.array[vec3],
        change: wp.array[vec3],
        saturation: wp.array[dtype],
        slope: wp.array[dtype],
        curve: wp.array[int],
        shares: int,
        # outputs:
        s_out: wp.array[vec3],
        change_out: wp.array[vec3],
        moments_out: wp.array[vec3],
        packed_out: wp.array2d[dtype],
        condition_out: wp.array[int],
    ):
        row = wp.tid() // shares
        share = wp.tid() % shares
        if wp.tid() == 0:
            condition_out[0] = 0  # until a world wants another evaluation
        i = row_target[row]
        w = world[i]
        if worlds[w].mode != wp.static(SWEEP):
            return
        h = near_field(packed_out, change, i, row_begin[row], row_end[row], neighbor, neighbor_count, share, shares)
        h = sum_group(h, shares)
        if share == 0:
            g = mixed_g[i] + (dtype(wp.static(INVERSE_4PI)) * slope[i] / saturation[i]) * h
            s = theta_flow(s_out[i], g, wp.min(dtype(1.0), dtype(wp.static(SWEEP_STEP)) * dtype(worlds[w].omega)))
            s_out[i] = s
            store_magnetization(i, (saturation[i] * curve_ratio(wp.length(s), curve[i])) * s, moments_out, packed_out)
            change_out[i] = moments_out[i] - mixed_moment[i]

    return sweep


def launch_set_state(rows, magnetizations, material, b: InductionBuffers):
    """Take given magnetizations [A/m], shape [n], for the last solution of all worlds; ``rows`` are the inducible."""
    if rows.count == 0:
        return
    wp.launch(
        _set_state_kernel(material.saturation.dtype),
        dim=rows.count,
        inputs=[rows.target, b.world, magnetizations, material.saturation, material.curve],
        outputs=[b.s, b.warm],
        device=b.h.device,
    )


def launch_begin(applied, partial, induced, moments, external_field, material, b: InductionBuffers, moments_out):
    """Begin a solve in every world: applied field, starting moments, and what their step length follows from.

    Args:
        applied: Work list, permanent moments on inducible ones.
        partial: Sums of the native field loop over ``applied``.
        induced: Work list, inducible moments on inducible ones, with the same targets.
        moments: Packed moments with their neighbours (``warpmag.packed.PackedMoments``); gets the starting moments.
        external_field: External field [A/m], shape [n].
        material: What the moments are made of (``kernels.material.curves.CurveParameters``).
        b: The buffers.
        moments_out: Moments [A·m²], shape [n]; the inducible ones are written.
    """
    shares = group_threads(moments.device)
    wp.launch_tiled(
        _begin_kernel(moments.dtype),
        dim=[_BEGINNERS * b.chunk.shape[0]],
        inputs=[
            b.chunk,
            partial,
            moments.packed,
            applied.target,
            applied.begin,
            applied.end,
            induced.begin,
            induced.end,
            moments.neighbors,
            moments.neighbor_counts,
            moments.overlaps,
            moments.overlap_counts,
            external_field,
            b.warm,
            b.past_positions,
            b.past_moments,
            b.past_field,
            b.past_g,
            material.saturation,
            material.slope,
            material.curve,
            shares,
            b.s,
        ],
        outputs=[
            b.h0,
            b.mixed_g,
            b.mixed_moment,
            b.change,
            moments_out,
            moments.packed,
            b.start,
            b.worlds,
            b.condition,
        ],
        block_dim=shares * CHUNK // _BEGINNERS,
        device=moments.device,
    )


def launch_sweeps(rows, moments, material, b: InductionBuffers, moments_out):
    """Two sweeps over neighbours, before the field is summed, in worlds that want them; see the module."""
    shares = group_threads(moments.device)
    for change, next_change in ((b.change, b.next_change), (b.next_change, b.change)):
        wp.launch(
            _sweep_kernel(moments.dtype),
            dim=shares * rows.count,
            inputs=[
                rows.target,
                rows.begin,
                rows.end,
                moments.neighbors,
                moments.neighbor_counts,
                b.world,
                b.worlds,
                b.mixed_g,
                b.mixed_moment,
                change,
                material.saturation,
                material.slope,
                material.curve,
                shares,
            ],
            outputs=[b.s, next_change, moments_out, moments.packed, b.condition],
            device=moments.device,
        )


def launch_iteration(rows, moments, material, b: InductionBuffers, rtol, max_evaluations, moments_out):
    """Judge the field at the inducible moments, and move every world that has not ended; see the module.

    Args:
        rows: Work list whose targets are the inducible moments; their field stands in ``b.h``.
        moments: Packed moments with their neighbours (``warpmag.packed.PackedMoments``).
        material: What they are made of (``kernels.material.curves.CurveParameters``).
        b: The buffers; ``b.condition`` tells whether another evaluation is wanted.
        rtol: Relative residual ‖M − f(H)‖/‖f(H)‖ at which a world ends.
        max_evaluations: Field evaluations after which a world gives up.
        moments_out: Moments [A·m²], shape [n]; the inducible ones are written.
    """
    device, dtype = moments.device, moments.dtype
    wp.launch_tiled(
        _judgement_kernel(dtype),
        dim=[b.chunk.shape[0]],
        inputs=[
            b.chunk,
            b.chunk_begin,
            rows.target,
            b.h,
            b.s,
            material.saturation,
            material.slope,
            material.curve,
            wp.float64(rtol),
            max_evaluations,
            b.worlds,
            b.start,
            b.warm,
            b.sums,
            b.arrived,
            b.past_g,
            b.iterate_s,
            b.iterate_r,
            b.history_s,
            b.history_r,
        ],
        outputs=[b.error, b.evaluations, b.converged, b.condition],
        block_dim=CHUNK,
        device=device,
    )
    wp.launch(
        _advance_kernel(dtype),
        dim=rows.count,
        inputs=[
            rows.target,
            b.world,
            b.worlds,
            b.iterate_s,
            b.iterate_r,
            b.history_s,
            b.history_r,
            material.saturation,
            material.slope,
            material.curve,
            b.h0,
            b.best_s,
            b.best_r,
            b.past_positions,
            b.past_moments,
            b.past_field,
            b.past_g,
        ],
        outputs=[b.s, b.mixed_g, b.mixed_moment, b.change, moments_out, moments.packed],
        device=device,
    )
