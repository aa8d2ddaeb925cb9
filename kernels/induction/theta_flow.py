"""Solve induction by the θ dynamics (Kim and Han 2022, Eqs. 8, 9 and 11), accelerated by Anderson mixing.

The dynamics are integrated exactly in time. All arrays stay on the device.

An inducible moment has the magnetization M, the saturation Ms, and the curve M = f(H) with the initial slope k. H is
the field at the moment, without that of its own ball: H = H0 + G M, with the applied field H0 and the coupling G of all
moments. In the paper M is the mean of two submagnetizations M1 and M2 of length Ms, each at the angle θ from the
effective field H_eff = H − f⁻¹(M), towards which they turn at a rate β. Then ‖M‖ = Ms cos θ, and ln cot(θ/2) =
artanh(‖M‖/Ms) grows linearly in time. The unknown is therefore the dual variable s = k f⁻¹(M)/Ms of every moment, so
that M = Ms c(‖s‖) s/‖s‖ with the curve c in units of Ms. The exact solution over a step of length Δt is s ← (1 − ω) s +
ω k H/Ms, with ω = κ/k and κ = βΔtMs. One evaluation of the field gives the target g = k H/Ms and the residual r = g −
s. With the last few changes Δs_j and Δr_j from one evaluation to the next, Anderson's step is

    s̄ = s − Σ_j α_j Δs_j,   r̄ = r − Σ_j α_j Δr_j,   s ← s̄ + ω r̄,    α = argmin ‖φ r̄‖.

The vector s̄ is called a mixture. The weight φ = Ms c(a)/a, a = max(‖s‖, ‖g‖), converts a residual to magnetization, so
that the large s of saturated moments does not dominate. A plain step, with α = 0, is mirror descent on the energy
divided by μ0, Σ V [Φ(M) − ½ M·GM − H0·M]. V are the volumes of the moments, and Φ is the integral of f⁻¹. The energy is
convex for the ball-averaged kernel. Let L_i = 1 + k (2/3 + o_i + f_i), with o_i the sum of the volumes that ball i
shares with others, each over the root of the product of both balls' volumes (``stiffness_of`` in ``theta_flow.h``). The
energy decreases from any state for ω_i ≤ 1/L_i, and near the solution the steps converge for ω_i < 2/L_i. f_i
is the demagnetizing factor of overlaps (``stiffness_of``). It is 0 except for moments that act by tensors alone: cells
of bodies that take steps as a whole (``body_products.py``), and few moments in place of a body.

After as many evaluations as stored changes, the newest stored change is replaced if the current iterate is the best so
far. The new one is the difference between the current mixture and the previous one. The coupling is symmetric, so that
few such changes are as good as all (conjugate residuals; short-term recurrence of Wei, Bao and Liu 2022). Heaps of
plates and bars then take 26 evaluations instead of 35. Sheets that lie on each other take less than half as many
evaluations as without such changes. The field of a mixture is not evaluated. Where iterates do not improve, or r̄
hardly changes, differences between iterates are more precise, and are kept.

A step changes the field most at near neighbors. Sweeps update the neighbors' part without another evaluation of the
whole field. With the coupling G' of the listed neighbors, two sweeps s ← s + ω' (ḡ + (k/Ms) G' (M(s) − M(s̄)) − s)
follow each step. Here ḡ = s̄ + r̄, and ω' is a little above ω. In a solve of touching balls from zero magnetization,
sweeps save one or two field evaluations. They save more where balls overlap.

A step with mixing or sweeps is rejected if it leaves the merit ‖φ r‖ more than twice the best. A few plain steps from
the best iterate follow, and no more sweeps: where balls overlap cells, sweeps can diverge.

**Result and error.** The last residual allows one more step. A solve returns M and H of s̄ + ω₁ r̄, with M = f(H). The
whole step ω₁ is 1, which solves an isolated ball, or less where balls overlap. The part of r that the mixture removes
changes s by at most γ times that part, γ = max ‖φ Δs_j‖/‖φ Δr_j‖. The step corrects the rest, r̄. The estimate counts
r̄ as an error, weighted by λ. So the estimate amplifies the residual (Eq. 12) of the last iterate,

    error = ‖M − f(H)‖/‖f(H)‖ · max(1, σ [λ ‖φ r̄‖ + γ √(‖φ r‖² − ‖φ r̄‖²)]/‖φ r‖),

with λ = ‖φ (2 − ω₁) r‖/‖φ r‖, and σ as below. In long solves λ is replaced by max(λ, γ), because slow modes remain in
r̄.

Inside a body of iron, closed loops of magnetization have almost no field. They barely change the residual, and do not
affect forces or fields outside. So in worlds with bodies of cells the error is measured in the energy norm. Let A =
max(1, …) be the amplification above, b = k H0/Ms the reduced applied field, and H' the field H plus the changes of
``body_products.py``:

    error = max(‖M − f(H)‖/‖f(H)‖, √(A ⟨M − f(H), M − f(H')⟩/⟨φ s, φ b⟩)).

The energy norm of an error e is √⟨e, r⟩. For bodies that take steps as a whole (``body_products.py``), r' = Q r
approximates e, with the inverse Q of their operator. For other bodies M − f(H) and M − f(H') are equal. The energy norm
of the solution is √⟨s, b⟩. In a long bar along the field a slow mode dominates the solution, and the error is the same
in both norms. A steel plate of 60 × 60 × 3 mm that a magnet lifts takes 2 evaluations per solve. Ending these solves at
``rtol`` contributes an error of 1e-4 to the force on the plate. The error of the cells is not included.

With slow convergence many steps like the last one remain. The factor σ is their geometric series ρ/(1 − ρ), and at
least 1, with ρ the ratio of ‖φ r‖ to its smallest earlier value. At least half of σ is kept at the next evaluation. The
error is at least a hundredth of the last ‖φ Δs‖, since sweeps over near contacts lag behind the moments. Rounding is
not included, and a residual at the level of rounding is not amplified. ``python -m bench.accuracy arrangements``
compares the estimate with the true error.

**Warm start.** The next solve starts at s̄ + ω r̄ + η Δg, where Δg is the last change of g from solve to solve. Sweeps
over neighbors precede its first evaluation. The neighbors' field is computed at their present positions. The field of
all other sources, F = H − H0 − G' M, is extrapolated as F₁ + η (F₁ − F₂) from the last two solves. Both F are computed
from s̄ and ḡ, which are closer to the solution than the last iterate. Each world has its own factor
η = ⟨φΔg, φΔg'⟩/‖φΔg'‖², limited to [0, 1]. It is the factor that best predicts the last change Δg from the change Δg'
before it. So the start follows smooth motion, and ignores noise.

The changes Δs_j, Δr_j are kept for the next solve, since the coupling hardly changes. A slow mode, such as that of long
columns of balls, then costs one evaluation instead of three. Balls Up, where 243 balls jump, takes 1.2 evaluations per
solve. Where the equilibrium is unique, every start leads to the same solution.
"""

from functools import cache

import warp as wp

from warpmag.kernels.cells.cell_pairs import OVERLAP_DEMAGNETIZATION
from warpmag.kernels.induction.solve_state import COLUMNS, DEPTH, state_type, world_summation
from warpmag.kernels.material.curves import inverse_curve_ratio
from warpmag.kernels.pairs.neighbors import CAPACITY
from warpmag.kernels.pairs.pair_law import INVERSE_4PI
from warpmag.kernels.shared.native import PASS_ARGUMENTS, native_kernel, native_options
from warpmag.kernels.shared.reductions import group_threads, most_blocks
from warpmag.kernels.shared.team import MOMENTS_PER_THREAD, launch_passes, threads_for

START, FIRST_SWEEP, LAST_SWEEP, MEASURE, CHOOSE, ADVANCE = range(6)  # passes in order; as in ``theta_flow.h``
FLOW_STEP = 0.9
"""Step length over the largest convergent one."""
CONTACT = 0.2
"""Overlap of cells of bodies in contact. Their balls overlap, but not the cells themselves."""
_START_THREADS = 256
"""Most threads of a GPU's block at the start of a solve, where a moment takes a group of threads."""
_RESIDENT_BLOCKS = {wp.float32: (3, 5, 2), wp.float64: (2, 3, 1)}
"""Blocks of 256 threads per multiprocessor at the start, in sweeps and in checks of convergence; limits the registers
that compilers use."""


def _constants(group: int) -> dict:
    constants = {"GROUP": group, "CAPACITY": CAPACITY, "DEPTH": DEPTH, "FLOW_STEP": FLOW_STEP}
    constants |= {"CONTACT": CONTACT, "OVERLAP_DEMAGNETIZATION": OVERLAP_DEMAGNETIZATION}
    return constants | {"INVERSE_4PI": INVERSE_4PI}


def _options(dtype, group: int) -> dict:
    return native_options("induction/theta_flow.h", dtype=dtype, **_constants(group))


@cache
def _passes_kernel(dtype):
    """Return the kernel of all passes on a CPU."""
    call = "theta_flow(first, last, threads, team.data, arrays)"
    arguments = {**PASS_ARGUMENTS, "arrays": state_type(dtype)}
    return native_kernel(call, "induction/theta_flow.h", arguments, dtype=dtype, **_constants(1))


@cache
def _begin_kernel(dtype, group: int, blocks: int):
    """Return the kernel that starts a solve; ``blocks`` blocks share a chunk."""
    state_struct = state_type(dtype)

    @wp.func_native("warpmag::start(state, warpmag::span_at(state, row));")
    def start(state: state_struct, row: int): ...

    @wp.func_native("warpmag::begin_world(state, w);")
    def begin_world(state: state_struct, w: int): ...

    bounds, options = (256, _RESIDENT_BLOCKS[dtype][0]), _options(dtype, group)

    @wp.kernel(module="unique", enable_backward=False, module_options=options, launch_bounds=bounds)
    def begin_flow(state: state_struct):
        block, lane = wp.tid()
        chunk = state.chunk[block // wp.static(blocks)]
        moments_per_block = wp.block_dim() // wp.static(group)
        begin = chunk[0] + moments_per_block * (block % wp.static(blocks)) + lane // wp.static(group)
        end = chunk[1]
        if state.resting[chunk[2]] != 0 and state.searching[0] == 0:
            end = chunk[0]
        for row in range(begin, end, moments_per_block * wp.static(blocks)):
            start(state, row)
        if block == wp.static(blocks) * state.chunk_begin[chunk[2]] and lane == 0:
            begin_world(state, chunk[2])

    return begin_flow


@cache
def _sweep_kernel(dtype, group: int):
    call = "sweep_moment(state, thread / warpmag::GROUP, last == 1)"
    arguments, constants = {"last": int, "state": state_type(dtype)}, _constants(group)
    launch = {"launch_bounds": (256, _RESIDENT_BLOCKS[dtype][1])}
    return native_kernel(call, "induction/theta_flow.h", arguments, dtype=dtype, launch=launch, **constants)


@cache
def _convergence_kernel(dtype, group: int):
    """Return the kernel that sums chunks of worlds; the last block of a world chooses its next step."""
    state_struct = state_type(dtype)
    columns = wp.types.vector(COLUMNS, wp.float64)
    sum_world = world_summation(dtype, COLUMNS)

    @wp.func_native("return warpmag::world_sums(state, row);")
    def measure(state: state_struct, row: int) -> columns: ...

    @wp.func_native("warpmag::choose_step(state, w, &sums[0]);")
    def choose_step(state: state_struct, w: int, sums: columns): ...

    bounds, options = (256, _RESIDENT_BLOCKS[dtype][2]), _options(dtype, group)

    @wp.kernel(module="unique", enable_backward=False, module_options=options, launch_bounds=bounds)
    def check_convergence(state: state_struct):
        c, lane = wp.tid()
        chunk = state.chunk[c]
        w = chunk[2]
        if state.worlds[w].active == 0:
            if c == state.chunk_begin[w] and lane == 0:
                state.worlds[w].next = 0
            return
        terms = columns()
        if chunk[0] + lane < chunk[1]:
            terms = measure(state, chunk[0] + lane)
        last, total = sum_world(terms, c, lane, w, state)
        if last:
            choose_step(state, w, total)

    return check_convergence


@cache
def _advance_kernel(dtype, group: int):
    call, arguments = "advance_moment(state, thread)", {"state": state_type(dtype)}
    return native_kernel(call, "induction/theta_flow.h", arguments, dtype=dtype, **_constants(group))


@cache
def _set_kernel(dtype):
    state_struct = state_type(dtype)

    @wp.kernel(module="unique", enable_backward=False, module_options=native_options("material/curves.h", dtype=dtype))
    def set_state(magnetizations: wp.array[wp.types.vector(3, dtype)], state: state_struct):
        row = state.row[wp.tid()]
        i = row[0]
        reduced = magnetizations[i] / state.saturation[i]
        ratio = inverse_curve_ratio(wp.length(reduced), state.slope[i], state.curve[i], state.curve_tables)
        state.s[i] = ratio * reduced
        state.warm[row[1]] = 1

    return set_state


def launch_set_state(state, magnetizations):
    """Launch the start of the next solve from magnetizations [A/m], shape [n], as the last solution of all worlds."""
    kernel, rows = _set_kernel(state.packed.dtype), state.row.shape[0]
    wp.launch(kernel, dim=rows, inputs=[magnetizations, state], device=state.h.device)


class Launches:
    """Recorded launches of a solve of one state, which saves packing its arrays each time."""

    def __init__(self, state):
        """Record the launches for a state bound to its moments (``solve_state.bind``)."""
        device, dtype, count, chunks = state.h.device, state.packed.dtype, state.row.shape[0], state.chunk.shape[0]
        group = group_threads(device, moments=count)

        def record(kernel, dim, *inputs, block_dim=256, max_blocks=0):
            options = dict(block_dim=block_dim, max_blocks=max_blocks, device=device, record_cmd=True)
            return wp.launch(kernel, dim=dim, inputs=[*inputs, state], **options)

        def passes(first: int, last: int):
            kernel, threads = _passes_kernel(dtype), threads_for(count, MOMENTS_PER_THREAD)
            return launch_passes(kernel, first, last + 1, state, device=device, threads=threads, record_cmd=True)

        if device.is_cpu:
            self.begin, self.sweeps = [passes(START, START)], [passes(FIRST_SWEEP, LAST_SWEEP)]
            self.iteration = [passes(MEASURE, ADVANCE)]
        else:
            largest = state.block_moments
            blocks, block_dim = -(-group * largest // _START_THREADS), max(32, largest)
            width, begin = max(32, group * largest // blocks), _begin_kernel(dtype, group, blocks)
            self.begin = [record(begin, (blocks * chunks, width), block_dim=width)]
            most = most_blocks(device) if state.active else 0
            sweep = _sweep_kernel(dtype, group)
            self.sweeps = [record(sweep, group * count, last, max_blocks=most) for last in (0, 1)]
            self.iteration = [
                record(_convergence_kernel(dtype, group), (chunks, block_dim), block_dim=block_dim),
                record(_advance_kernel(dtype, group), count, max_blocks=most),
            ]
