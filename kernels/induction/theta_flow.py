"""The accelerated θ flow (Kim and Han 2022, Eqs. 8, 9 and 11, exact in time), kept wholly on the device.

With M1 and M2 symmetric about H_eff, ‖M‖ = Ms cos θ, and ln cot(θ/2) = artanh(‖M‖/Ms) grows linearly in time. Unknown
is therefore the dual variable s = k f⁻¹(M)/Ms of every inducible moment, so that M = Ms c(‖s‖) ŝ: the exact flow over a
step is s ← (1 − ω) s + ω k H/Ms, ω = κ/k, κ = βΔtMs. One field evaluation gives the target g = k H(M)/Ms and the
residual r = g − s. With the last few changes Δs_j, Δr_j from one evaluation to the next, Anderson's step is

    s̄ = s − Σ_j α_j Δs_j,   r̄ = r − Σ_j α_j Δr_j,   s ← s̄ + ω r̄,    α = argmin ‖φ r̄‖,

weighted by φ = Ms c(a)/a, a = max(‖s‖, ‖g‖): what a residual is worth in magnetization, so that a saturated moment's
huge s does not drown the rest. The plain step is mirror descent on the energy Σ V Φ(M) − ½ M·GM − H0·M, convex for the
ball-averaged kernel: with L_i = 1 + k (2/3 + o_i) it descends from anywhere for ω_i ≤ 1/L_i, and close to the solution
converges for ω_i < 2/L_i, o_i being the volume that a ball shares with others (``total_overlap`` in ``theta_flow.h``).
Steps are short where balls overlap, and nowhere else.

A step changes most the field at near neighbours, and their part is known without another evaluation of the whole field:
with the coupling G' of the neighbours that ``neighbors`` lists, two sweeps s ← s + ω' (ḡ + (k/Ms) G' (M(s) − M(s̄)) − s)
follow, ḡ = s̄ + r̄, ω' a little above ω. From cold they spare a pile of touching balls 1 or 2 of 8 to 10 evaluations to
1e-3, and more where balls overlap.

An accelerated step or a swept one that leaves the merit ‖φ r‖ more than twice the best is taken back, and a few plain
steps follow from the best iterate.

**What a solve returns, and its error.** The residual that ends a solve is good for one more step. Returned are M and H
of s̄ + ω₁ r̄, M = f(H), with the whole step ω₁ = 1 that solves a lone ball, or less where balls overlap. What the mixture
removes of r has a known worth in s: at most γ times itself, γ = max ‖φ Δs_j‖/‖φ Δr_j‖. What it leaves, r̄, the step
corrects, and as much error again is allowed for. Hence the estimate is an amplification of the residual (Eq. 12) of the
last iterate,

    error = ‖M − f(H)‖/‖f(H)‖ · max(1, σ [λ ‖φ r̄‖ + γ √(‖φ r‖² − ‖φ r̄‖²)]/‖φ r‖),   λ = ‖φ (2 − ω₁) r‖/‖φ r‖.

With slow convergence many steps like the last one are to come: σ is their geometric series ρ/(1 − ρ), ρ being ‖φ r‖
over the smallest before, and at least 1; half of a σ outlives an evaluation. An error below a hundredth of the last
‖φ Δs‖ is not believed: sweeps over near contacts lag behind the moments. Rounding comes on top of all that, and a
residual that is no more than rounding is not amplified. ``python -m bench.accuracy arrangements`` compares the estimate
with the truth.

s̄ + ω r̄, further by β Δg, is where the next solve starts, Δg the last change of g from solve to solve. Sweeps over
neighbours go before its first evaluation: the field of the neighbours is computed where they are now, and the field of
all others, F = H − H0 − G' M, is extrapolated as F₁ + β (F₁ − F₂), F of the last solve and of the one before for the
present neighbours. Both are those of s̄ and ḡ, which are nearer to the solution than the last iterate. β is what would
have predicted the last change from the one before it, β = ⟨φΔg, φΔg'⟩/‖φΔg'‖² within [0, 1], one for a world: smooth
motion is followed, noise is not. The changes Δs_j, Δr_j outlive a solve, since the coupling hardly changes: a slow
mode, as of long columns of balls, costs one evaluation instead of three. All that leaves 1.2 evaluations a solve
where 243 balls jump (Balls Up). Whatever a start is worth, the solve converges to the one solution.

Bodies of few cells respond as wholes to each field that is evaluated (``body_response``). The flow takes the field in
which they have responded for the field, and whole steps for them, as for lone balls; sweeps leave them out.
"""

from functools import cache

import warp as wp

from warpmag.kernels.induction.body_response import BodyResponses
from warpmag.kernels.induction.solve_state import BLOCK_CHUNK, COLUMNS, DEPTH, state_type, world_summation
from warpmag.kernels.material.curves import inverse_curve_ratio
from warpmag.kernels.pairs.neighbors import CAPACITY
from warpmag.kernels.pairs.pair_law import INVERSE_4PI
from warpmag.kernels.shared.native import PASS_ARGUMENTS, native_kernel, native_options
from warpmag.kernels.shared.reductions import group_threads
from warpmag.kernels.shared.team import MOMENTS_PER_THREAD, team, threads_for

START, FIRST_SWEEP, LAST_SWEEP, MEASURE, CHOOSE, ADVANCE = range(6)
"""The passes, in order; as in ``theta_flow.h``."""
_BEGINNERS = 4
"""Blocks of a GPU that share a chunk of moments at the start of a solve, where a moment takes a group of threads."""

_RESIDENT = {wp.float32: (3, 5), wp.float64: (2, 3)}
"""Blocks of 256 threads that a multiprocessor is to hold at the start and in sweeps: compilers take more registers."""


def _constants(group: int, responding: bool) -> dict:
    constants = {"GROUP": group, "CAPACITY": CAPACITY, "DEPTH": DEPTH, "RESPONDING": int(responding)}
    return constants | {"INVERSE_4PI": INVERSE_4PI}


def _options(dtype, group: int, responding: bool) -> dict:
    return native_options("induction/theta_flow.h", dtype=dtype, **_constants(group, responding))


@cache
def _passes_kernel(dtype, responding: bool):
    """Kernel of passes on a CPU."""
    call = "theta_flow(first, last, threads, team.data, arrays)"
    arguments = {**PASS_ARGUMENTS, "arrays": state_type(dtype)}
    return native_kernel(call, "induction/theta_flow.h", arguments, dtype=dtype, **_constants(1, responding))


@cache
def _begin_kernel(dtype, group: int, responding: bool):
    state_struct = state_type(dtype)

    @wp.func_native("warpmag::start(state, warpmag::place(state, row));")
    def start(state: state_struct, row: int): ...

    @wp.func_native("warpmag::begin_world(state, w);")
    def begin_world(state: state_struct, w: int): ...

    @wp.kernel(
        module="unique",
        enable_backward=False,
        module_options=_options(dtype, group, responding),
        launch_bounds=(256, _RESIDENT[dtype][0]),
    )
    def begin_flow(state: state_struct):
        block, lane = wp.tid()
        chunk = state.chunk[block // wp.static(_BEGINNERS)]
        at_once = wp.block_dim() // wp.static(group)
        begin = chunk[0] + at_once * (block % wp.static(_BEGINNERS)) + lane // wp.static(group)
        for row in range(begin, chunk[1], at_once * wp.static(_BEGINNERS)):
            start(state, row)
        if block == wp.static(_BEGINNERS) * state.chunk_begin[chunk[2]] and lane == 0:
            begin_world(state, chunk[2])

    return begin_flow


@cache
def _sweep_kernel(dtype, group: int, responding: bool):
    state_struct = state_type(dtype)

    @wp.func_native("warpmag::sweep(state, warpmag::place(state, row), last == 1);")
    def sweep_neighbors(state: state_struct, row: int, last: int): ...

    @wp.kernel(
        module="unique",
        enable_backward=False,
        module_options=_options(dtype, group, responding),
        launch_bounds=(256, _RESIDENT[dtype][1]),
    )
    def sweep(last: int, state: state_struct):
        sweep_neighbors(state, wp.tid() // wp.static(group), last)

    return sweep


@cache
def _convergence_kernel(dtype, group: int, responding: bool):
    """Kernel whose blocks measure a chunk of a world each, the last of which chooses its world's next step."""
    state_struct = state_type(dtype)
    columns = wp.types.vector(COLUMNS, wp.float64)
    sum_world = world_summation(dtype, COLUMNS)

    @wp.func_native("return warpmag::measured(state, row);")
    def measure(state: state_struct, row: int) -> columns: ...

    @wp.func_native("warpmag::choose_step(state, w, &sums[0]);")
    def choose_step(state: state_struct, w: int, sums: columns): ...

    @wp.kernel(module="unique", enable_backward=False, module_options=_options(dtype, group, responding))
    def check_convergence(state: state_struct):
        c, lane = wp.tid()
        chunk = state.chunk[c]
        w = chunk[2]
        if state.worlds[w].active == 0:
            if c == state.chunk_begin[w] and lane == 0:
                state.worlds[w].next = 0
            return
        mine = columns()
        if chunk[0] + lane < chunk[1]:
            mine = measure(state, chunk[0] + lane)
        last, total = sum_world(mine, c, lane, w, state)
        if last:
            choose_step(state, w, total)

    return check_convergence


@cache
def _advance_kernel(dtype, group: int, responding: bool):
    state_struct = state_type(dtype)

    @wp.func_native("warpmag::advance(state, warpmag::place(state, row));")
    def advance_moment(state: state_struct, row: int): ...

    @wp.kernel(module="unique", enable_backward=False, module_options=_options(dtype, group, responding))
    def advance(state: state_struct):
        advance_moment(state, wp.tid())

    return advance


@cache
def _set_kernel(dtype):
    state_struct = state_type(dtype)

    @wp.kernel(module="unique", enable_backward=False, module_options=native_options("material/curves.h", dtype=dtype))
    def set_state(magnetizations: wp.array[wp.types.vector(3, dtype)], state: state_struct):
        row = state.row[wp.tid()]
        reduced = magnetizations[row[0]] / state.saturation[row[0]]
        ratio = inverse_curve_ratio(wp.length(reduced), state.curve[row[0]], state.curve_tables)
        state.s[row[0]] = ratio * reduced
        state.warm[row[1]] = 1

    return set_state


def launch_set_state(state, magnetizations):
    """Take given magnetizations [A/m], shape [n], for the last solution of all worlds."""
    wp.launch(
        _set_kernel(state.packed.dtype), dim=state.row.shape[0], inputs=[magnetizations, state], device=state.h.device
    )


class Launches:
    """Launches of the flow on one state, recorded once, which spares packing its arrays every time."""

    def __init__(self, state, bodies: BodyResponses | None):
        """Record the launches for a state that is bound to its moments (``solve_state.bind``).

        Args:
            state: The state.
            bodies: Bodies among the moments that respond as wholes.
        """
        device, dtype, count, chunks = state.h.device, state.packed.dtype, state.row.shape[0], state.chunk.shape[0]
        group, responding = group_threads(device), bodies is not None

        def record(kernel, dim, *inputs, block_dim=256):
            return wp.launch(
                kernel, dim=dim, inputs=[*inputs, state], block_dim=block_dim, device=device, record_cmd=True
            )

        def passes(first: int, last: int):
            return record(
                _passes_kernel(dtype, responding), 1, first, last + 1, threads_for(count, MOMENTS_PER_THREAD), team()
            )

        if device.is_cpu:
            self.begin, self.sweeps = [passes(START, START)], [passes(FIRST_SWEEP, LAST_SWEEP)]
            self.iteration = [passes(MEASURE, ADVANCE)]
        else:
            width = group * BLOCK_CHUNK // _BEGINNERS
            self.begin = [
                record(_begin_kernel(dtype, group, responding), (_BEGINNERS * chunks, width), block_dim=width)
            ]
            self.sweeps = [record(_sweep_kernel(dtype, group, responding), group * count, last) for last in (0, 1)]
            self.iteration = [
                record(_convergence_kernel(dtype, group, responding), (chunks, BLOCK_CHUNK), block_dim=BLOCK_CHUNK),
                record(_advance_kernel(dtype, group, responding), count),
            ]
        if bodies is not None:
            self.begin.append(bodies.begin)
            self.iteration.insert(0, bodies.respond)
            self.sweeps = self.sweeps if bodies.cell_count < count else []
