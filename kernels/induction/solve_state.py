"""State of an induction solve on the device and its convergence (Kim and Han 2022, Eq. 12), for every dynamics.

How the moments move is another matter: ``theta_flow`` is the product, ``submagnetization`` its rivals. Each world
iterates and converges for itself, see ``solve_state.h``. Sums go by fixed chunks of a world's moments in a fixed order,
in float64.

The state of n moments, m of them inducible, in w worlds and c chunks:

    packed, moments: Moments, packed and plain [A·m²], shapes [8, n] and [n]; the inducible ones are written.
    neighbor, neighbor_count, overlap, overlap_count, searching: Their lists (``PackedMoments``).
    saturation, slope, curve: What they are made of (``curves.CurveParameters``).
    rtol: Error at which a world ends.
    max_evaluations: Field evaluations after which a world gives up.
    responds: Whether a moment is a cell of a body that responds as a whole (``body_response``), shape [n].
    row: Number, world, and the world's inducible moments from and to, of each inducible moment, shape [m].
    chunk: Rows from and to, and world, of each chunk, shape [c].
    chunk_begin: First chunk of each world, shape [w + 1].
    near: On a CPU rows of the neighbours of a chunk's moments, shape [c, CAPACITY, CHUNK].
    near_count: How many the longest list of each vector has.
    h0: Applied field [A/m]: external and from permanent magnets, shape [n].
    h: Whole field [A/m], shape [n].
    s: Dual variable [dimensionless], shape [n].
    iterate_s, iterate_r: The last iterate, and its residual, shape [n].
    history_s, history_r: Last changes of both from one evaluation to the next, shape [DEPTH, n].
    best_s, best_r: Those of the smallest merit, shape [n].
    step: Step length of each moment, shape [n].
    mixed_g: Reduced field of the mixed iterate, as far as it is known, shape [n].
    mixed_moment: Moments of the mixed iterate [A·m²], shape [n].
    past_field, past_g: Field of the inducible moments at the last two solutions [A/m], and the reduced whole field; the
        last first, shape [2, n].
    past: Place [m], radius and moment [A·m²] of each row at these solutions, shape [rows, LINE].
    now, swept: Place [m], radius and what a step or a first sweep adds to the moment, shape [rows, LINE].
    sums: Sums of each chunk, on a CPU of each vector, shape [c, COLUMNS].
    arrived: Chunks of each world whose sums are done, shape [w].
    worlds: State of each world, shape [w].
    warm: Solves of each world since it began cold, as far as it matters, shape [w].
    residual: Relative residual ‖M − f(H)‖/‖f(H)‖ of each world after its last evaluation, shape [w].
    error: Its relative error: an estimate of ``theta_flow``, the residual of its rivals, shape [w].
    evaluations, converged: What a solve took, and whether it reached its goal, shape [w].
    condition: Whether any world still iterates, shape [1].
"""

from functools import cache

import numpy as np
import warp as wp

from warpmag.kernels.pairs.neighbors import CAPACITY
from warpmag.kernels.shared.native import CHUNK, LINE
from warpmag.kernels.shared.reductions import block_max, block_sum, fence

DEPTH = 5
"""Changes between iterates that are kept and mixed, see ``anderson.h``."""
COLUMNS = 7 + DEPTH + DEPTH * (DEPTH + 1) // 2
"""Sums over the moments of a chunk or world; as in ``theta_step.h``."""
BLOCK_CHUNK = 128
"""Moments in a chunk on a GPU, each of them for a thread of a block; on a CPU a chunk has ``native.CHUNK``."""


@wp.struct
class World:
    """State of a world between evaluations; in one cache line, up to the last, what every moment needs of it.

    Attributes:
        active: Whether it still iterates.
        evaluations: Field evaluations of this solve.
        in_field: Whether there is an applied field, until its first evaluation.
        next: What it does next, of ``Next`` in ``solve_state.h``.
        linked: Whether the next iterate's change from the last one is worth keeping.
        kept: Changes that are kept, in ``history``.
        newest: Slot of the newest of them.
        used: How many of them the next step mixes.
        improved: Whether the last iterate is the best so far.
        plain_steps: Steps to be taken without mixing.
        damping: Part of the moments' step lengths that is taken.
        ahead: Part of the last change from solve to solve that the next start adds.
        best: Smallest merit of this solve, negative before the first.
        alpha: Anderson coefficients.
        slowness: Sum of the steps to come over the last one, if they go on as they do.
        gain: Size of each kept change of the iterate over that of its residual, by slot.
    """

    active: int
    evaluations: int
    in_field: int
    next: int
    linked: int
    kept: int
    newest: int
    used: int
    improved: int
    plain_steps: int
    damping: wp.float64
    ahead: wp.float64
    best: wp.float64
    alpha: wp.types.vector(DEPTH, wp.float64)
    slowness: wp.float64
    gain: wp.types.vector(DEPTH, wp.float64)


@cache
def state_type(dtype):
    """Type of the state of a solve; the module says what its arrays are."""
    vec3 = wp.types.vector(3, dtype)

    @wp.struct
    class SolveState:
        packed: wp.array2d[dtype]
        moments: wp.array[vec3]
        neighbor: wp.array2d[int]
        neighbor_count: wp.array[int]
        overlap: wp.array2d[int]
        overlap_count: wp.array[int]
        searching: wp.array[int]
        saturation: wp.array[dtype]
        slope: wp.array[dtype]
        curve: wp.array[int]
        common_curve: int
        curve_tables: wp.array2d[dtype]
        responds: wp.array[int]
        rtol: wp.float64
        max_evaluations: int
        row: wp.array[wp.vec4i]
        chunk: wp.array[wp.vec3i]
        chunk_begin: wp.array[int]
        near: wp.array3d[int]
        near_count: wp.array[int]
        h0: wp.array[vec3]
        h: wp.array[vec3]
        s: wp.array[vec3]
        iterate_s: wp.array[vec3]
        iterate_r: wp.array[vec3]
        history_s: wp.array2d[vec3]
        history_r: wp.array2d[vec3]
        best_s: wp.array[vec3]
        best_r: wp.array[vec3]
        mixed_g: wp.array[vec3]
        mixed_moment: wp.array[vec3]
        past_field: wp.array2d[vec3]
        past_g: wp.array2d[vec3]
        step: wp.array[dtype]
        past: wp.array2d[dtype]
        now: wp.array2d[dtype]
        swept: wp.array2d[dtype]
        sums: wp.array2d[wp.float64]
        arrived: wp.array[int]
        worlds: wp.array[World]
        warm: wp.array[int]
        residual: wp.array[wp.float64]
        error: wp.array[wp.float64]
        evaluations: wp.array[int]
        converged: wp.array[int]
        condition: wp.array[int]

    return SolveState


def allocate(worlds, inducible, dtype, device):
    """Allocate the state of a solve; :func:`bind` has what is not its own.

    Args:
        worlds: World of each moment, non-decreasing, shape [n].
        inducible: Whether a moment is inducible, shape [n]; in each world these come first.
        dtype: Warp scalar type.
        device: Warp device.
    """
    n, world_count = len(worlds), int(worlds[-1]) + 1 if len(worlds) else 0
    on_cpu = wp.get_device(device).is_cpu
    size = CHUNK if on_cpu else BLOCK_CHUNK
    target = np.flatnonzero(inducible)
    world, held = worlds[target], np.bincount(worlds[target], minlength=world_count)
    begin = np.searchsorted(worlds, np.arange(world_count))
    rows = np.stack([target, world, begin[world], (begin + held)[world]], axis=1)
    ends = np.cumsum(held)
    chunks = [(a, min(a + size, end), w) for w, end in enumerate(ends) for a in range(end - held[w], end, size)]
    chunk_begin = np.append(0, np.cumsum(-(-held // size)))
    vec3 = wp.types.vector(3, dtype)

    def put(values, kind):
        return wp.array(np.asarray(values, np.int32), dtype=kind, device=device)

    def zeros(names, shape, kind=wp.int32):
        return {name: wp.zeros(shape, dtype=kind, device=device) for name in names.split()}

    count, vectors = len(chunks), CHUNK // (64 // wp.types.type_size_in_bytes(dtype)) if on_cpu else 1
    arrays = {
        "row": put(rows, wp.vec4i),
        "chunk": put(np.reshape(chunks, (-1, 3)), wp.vec3i),
        "chunk_begin": put(chunk_begin, wp.int32),
        "converged": put(np.ones(world_count), wp.int32),  # without inducible moments there is nothing to converge
        **zeros("near", (count if on_cpu else 0, CAPACITY, CHUNK)),
        **zeros("near_count", count * vectors),
        **zeros("h0 h s iterate_s iterate_r best_s best_r mixed_g mixed_moment", n, vec3),
        **zeros("history_s history_r", (DEPTH, n), vec3),
        **zeros("past_field past_g", (2, n), vec3),
        **zeros("past now swept", (count * size if on_cpu else len(rows), LINE), dtype),
        **zeros("step", n, dtype),
        **zeros("sums", (count * vectors, COLUMNS), wp.float64),
        **zeros("worlds", world_count, World),
        **zeros("residual error", world_count, wp.float64),
        **zeros("arrived warm evaluations", world_count),
        **zeros("responds", n),
        **zeros("condition", 1),
    }
    state = state_type(dtype)()
    for name, array in arrays.items():
        setattr(state, name, array)
    return state


def carried_arrays(state) -> dict:
    """Return the arrays of a state that a solve hands on to the next one, by name."""
    names = "near near_count s iterate_s iterate_r history_s history_r best_s best_r mixed_g mixed_moment past_field"
    names += " past_g past now swept worlds warm residual error evaluations converged"
    return {name: getattr(state, name) for name in names.split()}


def bind(state, packed, material, moments, rtol: float, max_evaluations: int) -> None:
    """Let a solve move moments.

    Args:
        state: State of the solve.
        packed: All moments, packed (``PackedMoments``).
        material: What they are made of (``curves.CurveParameters``).
        moments: Moments [A·m²], shape [n].
        rtol: Error at which a world ends.
        max_evaluations: Field evaluations after which a world gives up.
    """
    state.packed, state.moments, state.searching = packed.packed, moments, packed.searching
    state.neighbor, state.neighbor_count = packed.neighbors, packed.neighbor_counts
    state.overlap, state.overlap_count = packed.overlaps, packed.overlap_counts
    state.saturation, state.slope, state.curve = material.saturation, material.slope, material.curve
    state.common_curve, state.curve_tables = material.common_curve, material.tables
    state.rtol, state.max_evaluations = rtol, max_evaluations


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
def world_summation(dtype, columns: int):
    """Warp function by which the last block of a world adds up its sums.

    Every thread of a block brings its own; the first one of the last block gets all of them, and others ``False``.
    """
    vector = wp.types.vector(columns, wp.float64)

    @wp.func
    def sum_world(mine: vector, c: int, lane: int, w: int, state: state_type(dtype)):
        total = block_sum(mine)
        begin = state.chunk_begin[w]
        end = state.chunk_begin[w + 1]
        if end - begin == 1:
            return lane == 0, total
        if lane == 0:
            for column in range(wp.static(columns)):
                state.sums[c, column] = total[column]
        if not is_last_of_world(lane, w, end - begin, state.arrived):
            return False, total
        rest = vector()
        for chunk in range(begin + lane, end, wp.block_dim()):
            for column in range(wp.static(columns)):
                rest[column] += state.sums[chunk, column]
        return lane == 0, block_sum(rest)

    return sum_world
