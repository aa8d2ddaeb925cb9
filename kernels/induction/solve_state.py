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

from warpmag.kernels.induction import anderson
from warpmag.kernels.induction.anderson import DEPTH
from warpmag.kernels.pairs.field import finished_field
from warpmag.kernels.shared.reductions import block_max, block_sum, fence

CHUNK = 128
"""Moments whose sums one block adds up, on a GPU each of them by a thread of its own."""
LACK, GOAL, MERIT, FOLLOWED, EARLIER, TERMS = range(6)
"""Sums ‖M − f(H)‖², ‖f(H)‖², ‖φr‖², ⟨φΔg, φΔg'⟩ and ‖φΔg'‖² of a chunk or world, and how many they are."""
COLUMNS = TERMS + anderson.COLUMNS
"""All sums of a chunk or world; those of ``anderson`` stand behind."""
FIELD, STIFFNESS = 0, 1
FLOW_STEP = 0.9
"""Share of the largest convergent step length that is used."""


@wp.struct
class World:
    """How a world stands between evaluations: one cache line, where a GPU would wait for an array after another.

    Attributes:
        active: Whether it still iterates.
        evaluations: Field evaluations of this solve.
        mode: What it does next, see ``theta_flow``.
        linked: Whether the next iterate's change from the last one is worth keeping.
        kept: Changes that are kept, in ``history``.
        newest: Slot of the newest of them.
        used: How many of them the next step mixes.
        improved: Whether the last iterate is the best so far.
        plain_steps: Steps to be taken without mixing.
        omega: Step length.
        ahead: Part of the last change from solve to solve that the next start adds.
        best: Smallest merit of this solve, negative before the first.
        alpha: Anderson coefficients.
    """

    active: int
    evaluations: int
    mode: int
    linked: int
    kept: int
    newest: int
    used: int
    improved: int
    plain_steps: int
    omega: wp.float64
    ahead: wp.float64
    best: wp.float64
    alpha: anderson.coefficients


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
        past_positions, past_moments, past_field, past_g: Where the last two solves were done [m], the moments [A·m²]
            that they ended at, what fields these make [A/m], and the reduced whole field; the last first, shape [2, n].
        iterate_s, iterate_r: The last iterate judged, and its residual, shape [n].
        history_s, history_r: Last changes of both from one evaluation to the next, shape [DEPTH, n].
        best_s, best_r: Those of the smallest merit, shape [n].
        mixed_g: Reduced field of the mixed iterate, as far as it is known, shape [n].
        mixed_moment: Moments of the mixed iterate [A·m²], shape [n].
        change, next_change: What a step adds to them [A·m²], shape [n].
        start: Largest applied field [A/m] and stiffness k (2/3 + o_i) of each world until it is judged, shape [w, 2].
        sums: Sums of each chunk, shape [c, COLUMNS].
        arrived: Chunks of each world whose sums are done, shape [w].
        worlds: How each world stands, shape [w].
        warm: Solves of each world since it began cold, as far as it matters, shape [w].
        error: Relative residual of each world, shape [w].
        evaluations, converged: What a solve took, and whether it reached its goal, shape [w].
        condition: Whether any world still iterates, shape [1].
    """

    world: wp.array
    chunk: wp.array
    chunk_begin: wp.array
    h0: wp.array
    h: wp.array
    s: wp.array
    past_positions: wp.array
    past_moments: wp.array
    past_field: wp.array
    past_g: wp.array
    iterate_s: wp.array
    iterate_r: wp.array
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
    arrived: wp.array
    worlds: wp.array
    warm: wp.array
    error: wp.array
    evaluations: wp.array
    converged: wp.array
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

    return InductionBuffers(
        world=put(worlds, wp.int32),
        chunk=put(np.reshape(chunks, (-1, 3)), wp.vec3i),
        chunk_begin=put(chunk_begin, wp.int32),
        **{name: zeros(n, vec3) for name in ("h0", "h", "s", "best_s", "best_r")},
        **{name: zeros(n, vec3) for name in ("mixed_g", "mixed_moment", "change", "next_change")},
        **{name: zeros((2, n), vec3) for name in ("past_positions", "past_moments", "past_field", "past_g")},
        **{name: zeros(n, vec3) for name in ("iterate_s", "iterate_r")},
        **{name: zeros((DEPTH, n), vec3) for name in ("history_s", "history_r")},
        start=zeros((world_count, 2), wp.float64),
        sums=zeros((len(chunks), COLUMNS), wp.float64),
        worlds=zeros(world_count, World),
        error=zeros(world_count, wp.float64),
        **{name: zeros(world_count, wp.int32) for name in ("arrived", "warm", "evaluations")},
        converged=put(np.ones(world_count), wp.int32),  # a world without inducible moments has nothing to converge
        condition=zeros(1, wp.int32),
    )


@cache
def applied_field(dtype):
    """Warp function that returns the applied field [A/m] at a row's target: external and from permanent magnets.

    Thread ``share`` of ``shares`` gets its share of it, for ``reductions.group_sum`` to add up.
    """
    vec3 = wp.types.vector(3, dtype)
    finish = finished_field(dtype)

    @wp.func
    def apply_field(
        partial: wp.array3d[dtype],
        packed: wp.array2d[dtype],
        row: int,
        i: int,
        begin: int,
        end: int,
        neighbor: wp.array2d[int],
        neighbor_count: wp.array[int],
        external_field: wp.array[vec3],
        share: int,
        shares: int,
    ):
        h0 = vec3()
        if share == 0:
            h0 = external_field[i]
        if end > begin:
            h0 += finish(partial, packed, packed, row, i, begin, end, 1, neighbor, neighbor_count, share, shares)
        return h0

    return apply_field


@wp.func
def begin_world(
    w: int,
    field: wp.float64,
    stiffness: wp.float64,
    start: wp.array2d[wp.float64],
    worlds: wp.array[World],
    condition: wp.array[int],
):
    """Let a world iterate; ``field`` and ``stiffness`` are the largest of one of its chunks."""
    wp.atomic_max(start, w, wp.static(FIELD), field)
    wp.atomic_max(start, w, wp.static(STIFFNESS), stiffness)
    worlds[w].active = 1
    worlds[w].evaluations = 0
    worlds[w].linked = 0
    worlds[w].plain_steps = 0
    worlds[w].best = wp.float64(-1.0)
    condition[0] = 1


@wp.func
def step_length(stiffness: wp.float64):
    """Step length ω = κ/k that converges at the largest k (2/3 + o_i) of a world; see ``theta_flow``."""
    return wp.min(wp.float64(1.0), wp.float64(wp.static(2.0 * FLOW_STEP)) / (wp.float64(1.0) + stiffness))


@wp.func
def relative_error(sums: Any):
    """Relative residual ‖M − f(H)‖/‖f(H)‖ of a world's sums; not relative where there is no field."""
    lack = wp.sqrt(sums[wp.static(LACK)])
    goal = wp.sqrt(sums[wp.static(GOAL)])
    return wp.where(goal > wp.float64(0.0), lack / goal, lack)


@wp.func
def is_last_of_world(lane: int, w: int, chunks: int, arrived: wp.array[int]):
    """Whether this block is the last of those that sum the ``chunks`` of world ``w``, whose sums it can then read."""
    last = int(0)
    if lane == 0:
        fence()
        if wp.atomic_add(arrived, w, 1) == chunks - 1:
            arrived[w] = 0
            last = 1
        fence()
    return block_max(last) == 1


@cache
def world_summation(columns: int):
    """Warp function by which the last block of a world adds up its sums.

    The first thread of every block brings its block's; that of the last one gets all of them, and others ``False``.
    """
    vector = wp.types.vector(columns, wp.float64)

    @wp.func
    def sum_world(
        total: vector,
        c: int,
        lane: int,
        w: int,
        begin: int,
        end: int,
        sums: wp.array2d[wp.float64],
        arrived: wp.array[int],
    ):
        if end - begin == 1:
            return True, total
        if lane == 0:
            for column in range(wp.static(columns)):
                sums[c, column] = total[column]
        if not is_last_of_world(lane, w, end - begin, arrived):
            return False, total
        mine = vector()
        for chunk in range(begin + lane, end, wp.block_dim()):
            for column in range(wp.static(columns)):
                mine[column] += sums[chunk, column]
        return True, block_sum(mine)

    return sum_world
