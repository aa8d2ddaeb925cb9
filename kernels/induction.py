"""Induction: what every magnetization dynamics shares on the device.

The state of a solve, the start of each world, and the sums over its moments that convergence is judged by. How the
moments move is another matter: ``theta_flow`` is the product, ``submagnetization`` its rivals.

Each world iterates for itself, with its own convergence. Sums go by fixed chunks in a fixed order, in float64.
"""

from dataclasses import dataclass
from functools import cache

import numpy as np
import warp as wp

from warpmag.kernels.anderson import DEPTH, GRAM_COLUMNS, SLOTS, gram_slots

CHUNK = 64
"""Moments whose sums one thread adds up."""
COLUMNS = GRAM_COLUMNS + 3
"""Sums per chunk: the residuals' Gram matrix, then ‖M − f(H)‖², ‖f(H)‖², ‖φr‖²."""
_FLOW_STEP = 0.9
"""Share of the largest convergent step length that is used."""


@dataclass(frozen=True)
class InductionBuffers:
    """Everything an induction solve keeps on the device, for n moments, w worlds and c chunks.

    Attributes:
        world: World of each moment, shape [n].
        chunk: Begin, end and world of each chunk of inducible moments, shape [c].
        chunk_begin: First chunk of each world, shape [w + 1].
        column_slots: Slots whose product each Gram column holds, shape [COLUMNS].
        h0: Applied field [A/m]: external and from permanent magnets, shape [n].
        h: Whole field [A/m], shape [n].
        s: Dual variable [dimensionless], shape [n].
        last_s, last_change: Solution of the last solve, and how it differs from that of the one before, shape [n].
        history_s, history_r: Last iterates and residuals, shape [SLOTS, n].
        best_s, best_r: Those of the smallest merit, shape [n].
        weight, terms: Weight φ, and the lengths whose squares are summed, shape [n].
        start: Largest field and stiffness of each chunk, shape [c, 2].
        sums, world_sums: Sums of each chunk and world, shape [c, COLUMNS] and [w, COLUMNS].
        omega, best, error: Step length, smallest merit, relative residual of each world, shape [w].
        warm: Solves of each world since it began cold, as far as it matters, shape [w].
        active, converged, evaluations: How each world stands, shape [w].
        history, slot, plain_steps, mode, improved, used_slot, used_history: What it does next, shape [w].
        alpha: Anderson coefficients, shape [w, DEPTH].
        condition: Whether any world still iterates, shape [1].
    """

    world: wp.array
    chunk: wp.array
    chunk_begin: wp.array
    column_slots: wp.array
    h0: wp.array
    h: wp.array
    s: wp.array
    last_s: wp.array
    last_change: wp.array
    history_s: wp.array
    history_r: wp.array
    best_s: wp.array
    best_r: wp.array
    weight: wp.array
    terms: wp.array
    start: wp.array
    sums: wp.array
    world_sums: wp.array
    omega: wp.array
    best: wp.array
    error: wp.array
    warm: wp.array
    active: wp.array
    history: wp.array
    slot: wp.array
    plain_steps: wp.array
    evaluations: wp.array
    converged: wp.array
    mode: wp.array
    improved: wp.array
    used_slot: wp.array
    used_history: wp.array
    alpha: wp.array
    condition: wp.array


def allocate(worlds, inducible, dtype, device) -> InductionBuffers:
    """Allocate the buffers.

    Args:
        worlds: World of each moment, non-decreasing, shape [n].
        inducible: Whether a moment is inducible, shape [n]; in each world these come first.
        dtype: Warp scalar type.
        device: Warp device.
    """
    n, world_count = len(worlds), int(worlds[-1]) + 1 if len(worlds) else 0
    chunks, chunk_begin = [], [0]
    for w in range(world_count):
        first = int(np.searchsorted(worlds, w))
        last = first + int(np.count_nonzero(inducible[worlds == w]))
        chunks += [(a, min(a + CHUNK, last), w) for a in range(first, last, CHUNK)]
        chunk_begin.append(len(chunks))
    slots = gram_slots() + [(0, 0)] * (COLUMNS - GRAM_COLUMNS)
    vec3 = wp.types.vector(3, dtype)

    def put(values, kind):
        return wp.array(np.asarray(values, np.int32), dtype=kind, device=device)

    def zeros(shape, kind):
        return wp.zeros(shape, dtype=kind, device=device)

    integers = ("warm", "active", "history", "slot", "plain_steps", "evaluations", "converged")
    integers += ("mode", "improved", "used_slot", "used_history")
    return InductionBuffers(
        world=put(worlds, wp.int32),
        chunk=put(np.reshape(chunks, (-1, 3)), wp.vec3i),
        chunk_begin=put(chunk_begin, wp.int32),
        column_slots=put(slots, wp.vec2i),
        **{name: zeros(n, vec3) for name in ("h0", "h", "s", "last_s", "last_change", "best_s", "best_r", "terms")},
        **{name: zeros((SLOTS, n), vec3) for name in ("history_s", "history_r")},
        weight=zeros(n, dtype),
        start=zeros((len(chunks), 2), wp.float64),
        sums=zeros((len(chunks), COLUMNS), wp.float64),
        world_sums=zeros((world_count, COLUMNS), wp.float64),
        **{name: zeros(world_count, wp.float64) for name in ("omega", "best", "error")},
        **{name: zeros(world_count, wp.int32) for name in integers},
        alpha=zeros((world_count, DEPTH), wp.float64),
        condition=zeros(1, wp.int32),
    )


@cache
def _measure_kernel(dtype):
    vec3 = wp.types.vector(3, dtype)

    @wp.kernel(module="unique", enable_backward=False)
    def measure_start(
        # inputs:
        chunk: wp.array[wp.vec3i],
        h0: wp.array[vec3],
        overlap: wp.array[dtype],
        slope: wp.array[dtype],
        # outputs:
        start_out: wp.array2d[wp.float64],
    ):
        c = wp.tid()
        field = wp.float64(0.0)
        stiffest = dtype(0.0)
        for i in range(chunk[c][0], chunk[c][1]):
            field = wp.max(field, wp.float64(wp.length(h0[i])))
            stiffest = wp.max(stiffest, slope[i] * (overlap[i] + dtype(2.0 / 3.0)))
        start_out[c, 0] = field
        start_out[c, 1] = wp.float64(stiffest)

    return measure_start


@wp.kernel(enable_backward=False)
def start_worlds(
    # inputs:
    chunk_begin: wp.array[int],
    start: wp.array2d[wp.float64],
    # outputs:
    omega_out: wp.array[wp.float64],
    warm_out: wp.array[int],
    active_out: wp.array[int],
    history_out: wp.array[int],
    slot_out: wp.array[int],
    plain_steps_out: wp.array[int],
    best_out: wp.array[wp.float64],
    evaluations_out: wp.array[int],
    error_out: wp.array[wp.float64],
    converged_out: wp.array[int],
    condition_out: wp.array[int],
):
    """Reset each world; its step length follows from the stiffest of its moments."""
    w = wp.tid()
    field = wp.float64(0.0)
    stiffest = wp.float64(0.0)
    for c in range(chunk_begin[w], chunk_begin[w + 1]):
        field = wp.max(field, start[c, 0])
        stiffest = wp.max(stiffest, start[c, 1])
    omega_out[w] = wp.min(wp.float64(1.0), wp.float64(wp.static(2.0 * _FLOW_STEP)) / (wp.float64(1.0) + stiffest))
    if field == wp.float64(0.0):
        warm_out[w] = 0  # no field: the one solution is no magnetization, which a cold start hits
    busy = chunk_begin[w + 1] > chunk_begin[w]
    active_out[w] = wp.where(busy, 1, 0)
    converged_out[w] = wp.where(busy, 0, 1)
    if busy:
        condition_out[0] = 1
    history_out[w] = 0
    slot_out[w] = 0
    plain_steps_out[w] = 0
    best_out[w] = wp.float64(-1.0)
    evaluations_out[w] = 0
    error_out[w] = wp.float64(0.0)


@wp.kernel(enable_backward=False)
def sum_worlds(
    # inputs:
    chunk_begin: wp.array[int],
    active: wp.array[int],
    sums: wp.array2d[wp.float64],
    # outputs:
    world_sums_out: wp.array2d[wp.float64],
    condition_out: wp.array[int],
):
    """Add up the chunks of each world."""
    w, column = wp.tid()
    if w == 0 and column == 0:
        condition_out[0] = 0
    if active[w] == 0:
        return
    total = wp.float64(0.0)
    for c in range(chunk_begin[w], chunk_begin[w + 1]):
        total += sums[c, column]
    world_sums_out[w, column] = total


def launch_start_worlds(moments, material, b: InductionBuffers):
    """Reset the world state for a solve in the applied field ``b.h0``; see ``theta_flow.launch_start``."""
    device = moments.device
    wp.launch(
        _measure_kernel(moments.dtype),
        dim=b.chunk.shape[0],
        inputs=[b.chunk, b.h0, moments.overlaps, material.slope],
        outputs=[b.start],
        device=device,
    )
    wp.launch(
        start_worlds,
        dim=b.omega.shape[0],
        inputs=[b.chunk_begin, b.start],
        outputs=[
            b.omega,
            b.warm,
            b.active,
            b.history,
            b.slot,
            b.plain_steps,
            b.best,
            b.evaluations,
            b.error,
            b.converged,
            b.condition,
        ],
        device=device,
    )


def launch_sum_worlds(b: InductionBuffers):
    """Add up the chunks' sums of each world that still iterates."""
    wp.launch(
        sum_worlds,
        dim=(b.omega.shape[0], COLUMNS),
        inputs=[b.chunk_begin, b.active, b.sums],
        outputs=[b.world_sums, b.condition],
        device=b.omega.device,
    )
