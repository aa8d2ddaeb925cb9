"""Induction: what every magnetization dynamics shares on the device.

The state of a solve, the field that it starts from, and the sums over a world's moments that convergence is judged by.
How the moments move is another matter: ``theta_flow`` is the product, ``submagnetization`` its rivals.

Each world iterates for itself, with its own convergence. Sums go by fixed chunks in a fixed order, in float64: a block
sums a chunk, and a block a world's chunks.
"""

from dataclasses import dataclass
from functools import cache
from typing import Any

import numpy as np
import warp as wp

from warpmag.kernels import anderson
from warpmag.kernels.anderson import DEPTH, SLOTS
from warpmag.kernels.field import finished_field
from warpmag.kernels.neighbors import shared_volume

CHUNK = 64
"""Moments whose sums one block adds up, on a GPU each of them by a thread of its own."""
LACK, GOAL, MERIT, TERMS = 0, 1, 2, 3
"""Sums ‖M − f(H)‖², ‖f(H)‖² and ‖φr‖² of a chunk or world, and how many they are."""
COLUMNS = TERMS + anderson.COLUMNS
"""All sums of a chunk or world; those of ``anderson`` stand behind."""
FIELD, STIFFNESS = 0, 1
_FLOW_STEP = 0.9
"""Share of the largest convergent step length that is used."""


@dataclass(frozen=True)
class InductionBuffers:
    """Everything an induction solve keeps on the device, for n moments, w worlds and c chunks.

    Attributes:
        world: World of each moment, shape [n].
        chunk: Rows of the inducible moments' work list from and to, and world, of each chunk, shape [c].
        chunk_begin: First chunk of each world, shape [w + 1].
        h0: Applied field [A/m]: external and from permanent magnets, shape [n].
        h: Whole field [A/m], shape [n].
        s: Dual variable [dimensionless], shape [n].
        last_s, last_change: Solution of the last solve, and how it differs from that of the one before, shape [n].
        history_s, history_r: Last iterates and residuals, shape [SLOTS, n].
        best_s, best_r: Those of the smallest merit, shape [n].
        mixed_g: Reduced field of the mixed iterate, as far as it is known, shape [n].
        mixed_moment: Moments of the mixed iterate [A·m²], shape [n].
        change, next_change: What a step adds to them [A·m²], shape [n].
        start: Largest applied field [A/m] and stiffness k (2/3 + o_i) of each world until it is judged, shape [w, 2].
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
    h0: wp.array
    h: wp.array
    s: wp.array
    last_s: wp.array
    last_change: wp.array
    history_s: wp.array
    history_r: wp.array
    best_s: wp.array
    best_r: wp.array
    mixed_g: wp.array
    mixed_moment: wp.array
    change: wp.array
    next_change: wp.array
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
    chunks, chunk_begin, first = [], [0], 0
    for w in range(world_count):
        last = first + int(np.count_nonzero(inducible[worlds == w]))
        chunks += [(a, min(a + CHUNK, last), w) for a in range(first, last, CHUNK)]
        chunk_begin.append(len(chunks))
        first = last
    vec3 = wp.types.vector(3, dtype)

    def put(values, kind):
        return wp.array(np.asarray(values, np.int32), dtype=kind, device=device)

    def zeros(shape, kind):
        return wp.zeros(shape, dtype=kind, device=device)

    integers = ("warm", "active", "history", "slot", "plain_steps", "evaluations")
    integers += ("mode", "improved", "used_slot", "used_history")
    return InductionBuffers(
        world=put(worlds, wp.int32),
        chunk=put(np.reshape(chunks, (-1, 3)), wp.vec3i),
        chunk_begin=put(chunk_begin, wp.int32),
        **{name: zeros(n, vec3) for name in ("h0", "h", "s", "last_s", "last_change", "best_s", "best_r")},
        **{name: zeros(n, vec3) for name in ("mixed_g", "mixed_moment", "change", "next_change")},
        **{name: zeros((SLOTS, n), vec3) for name in ("history_s", "history_r")},
        start=zeros((world_count, 2), wp.float64),
        sums=zeros((len(chunks), COLUMNS), wp.float64),
        world_sums=zeros((world_count, COLUMNS), wp.float64),
        **{name: zeros(world_count, wp.float64) for name in ("omega", "best", "error")},
        **{name: zeros(world_count, wp.int32) for name in integers},
        converged=put(np.ones(world_count), wp.int32),  # a world without inducible moments has nothing to converge
        alpha=zeros((world_count, DEPTH), wp.float64),
        condition=zeros(1, wp.int32),
    )


@wp.func
def block_sum(mine: Any):
    """Sum of a value over the threads of a block, in a fixed order; the same for all of them."""
    return wp.tile_extract(wp.tile_sum(wp.tile(mine, preserve_type=True)), 0)


@wp.func
def block_max(mine: Any):
    """Largest value of the threads of a block."""
    return wp.tile_extract(wp.tile_max(wp.tile(mine)), 0)


@cache
def _begin_kernel(dtype):
    vec3 = wp.types.vector(3, dtype)
    finish = finished_field(dtype)

    @wp.kernel(module="unique", enable_backward=False)
    def begin_solve(
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
        external_field: wp.array[vec3],
        slope: wp.array[dtype],
        # outputs:
        h0_out: wp.array[vec3],
        start_out: wp.array2d[wp.float64],
        active_out: wp.array[int],
        history_out: wp.array[int],
        slot_out: wp.array[int],
        plain_steps_out: wp.array[int],
        best_out: wp.array[wp.float64],
        evaluations_out: wp.array[int],
        converged_out: wp.array[int],
        condition_out: wp.array[int],
    ):
        c, lane = wp.tid()
        field = wp.float64(0.0)
        stiffest = dtype(0.0)
        for row in range(chunk[c][0] + lane, chunk[c][1], wp.block_dim()):
            i = row_target[row]
            first = source_begin[row]
            last = source_end[row]
            h = external_field[i]
            if last > first:
                h += finish(partial, packed, packed, row, i, first, last, 1, neighbor, neighbor_count)
            h0_out[i] = h
            field = wp.max(field, wp.float64(wp.length(h)))
            overlap = shared_volume(packed, i, induced_begin[row], induced_end[row], neighbor, neighbor_count)
            stiffest = wp.max(stiffest, slope[i] * (overlap + dtype(2.0 / 3.0)))
        field = block_max(field)
        stiffest = block_max(stiffest)
        if lane == 0:
            w = chunk[c][2]
            wp.atomic_max(start_out, w, wp.static(FIELD), field)
            wp.atomic_max(start_out, w, wp.static(STIFFNESS), wp.float64(stiffest))
            active_out[w] = 1
            history_out[w] = 0
            slot_out[w] = 0
            plain_steps_out[w] = 0
            best_out[w] = wp.float64(-1.0)
            evaluations_out[w] = 0
            converged_out[w] = 0
            condition_out[0] = 1

    return begin_solve


def launch_begin(applied, partial, induced, moments, external_field, material, b: InductionBuffers):
    """Begin a solve in every world: the applied field ``b.h0``, what its step length follows from, its state reset.

    Args:
        applied: Work list, permanent moments on inducible ones.
        partial: Sums of the native field loop over ``applied``.
        induced: Work list, inducible moments on inducible ones, with the same targets.
        moments: Packed moments with their neighbours (``warpmag.packed.PackedMoments``).
        external_field: External field [A/m], shape [n].
        material: What the moments are made of (``kernels.wrench.Material``).
        b: The buffers.
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
            induced.begin,
            induced.end,
            moments.neighbors,
            moments.neighbor_counts,
            external_field,
            material.slope,
        ],
        outputs=[
            b.h0,
            b.start,
            b.active,
            b.history,
            b.slot,
            b.plain_steps,
            b.best,
            b.evaluations,
            b.converged,
            b.condition,
        ],
        block_dim=CHUNK,
        device=moments.device,
    )


@wp.func
def step_length(stiffness: wp.float64):
    """Step length ω = κ/k that converges at the largest k (2/3 + o_i) of a world; see ``theta_flow``."""
    return wp.min(wp.float64(1.0), wp.float64(wp.static(2.0 * _FLOW_STEP)) / (wp.float64(1.0) + stiffness))


@wp.func
def relative_error(sums: wp.array2d[wp.float64], w: int):
    """Relative residual ‖M − f(H)‖/‖f(H)‖ of a world; not relative where there is no field."""
    lack = wp.sqrt(sums[w, wp.static(LACK)])
    goal = wp.sqrt(sums[w, wp.static(GOAL)])
    return wp.where(goal > wp.float64(0.0), lack / goal, lack)


@cache
def world_summation(columns: int):
    """Warp function by which a block adds up the first ``columns`` sums of the chunks of a world."""
    vector = wp.types.vector(columns, wp.float64)

    @wp.func
    def sum_chunks(
        w: int, lane: int, begin: int, end: int, sums: wp.array2d[wp.float64], world_sums_out: wp.array2d[wp.float64]
    ):
        mine = vector()
        for c in range(begin + lane, end, wp.block_dim()):
            for column in range(wp.static(columns)):
                mine[column] += sums[c, column]
        total = block_sum(mine)
        if lane == 0:
            for column in range(wp.static(columns)):
                world_sums_out[w, column] = total[column]

    return sum_chunks
