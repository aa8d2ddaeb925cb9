"""State of an induction solve on the device, and its convergence (Kim and Han 2022, Eq. 12), for every dynamics.

``theta_flow`` and the baselines in ``submagnetization`` move the moments. Each world iterates and converges on its own
(``solve_state.h``). Sums run over fixed chunks of a world's moments in a fixed order, in float64.
"""

from functools import cache

import numpy as np
import warp as wp

from warpmag.kernels.pairs.neighbors import CAPACITY
from warpmag.kernels.shared.copies import put_copies, repeat_rows
from warpmag.kernels.shared.native import CHUNK, LINE
from warpmag.kernels.shared.pieces import cut
from warpmag.kernels.shared.reductions import block_max, fence

DEPTH = 5  # changes between iterates that are stored and mixed (``anderson.h``)
COLUMNS = 10 + DEPTH + DEPTH * (DEPTH + 1) // 2  # sums over the moments of a chunk or world; as in ``theta_step.h``
BLOCK_CHUNK = 128  # moments in a chunk on a GPU, one per thread of a block; on a CPU a chunk has ``native.CHUNK``
_CHUNK_SIZES = 4, 32, 64, BLOCK_CHUNK
"""Sizes for which the blocks of a GPU are made. Blocks for whole chunks would be mostly idle in small worlds."""


@wp.struct
class World:
    """State of a world between evaluations; the fields that every moment reads share a cache line."""

    active: int  # 1 while it iterates
    evaluations: int  # field evaluations of this solve
    in_field: int  # 1 if there is an applied field, 0 after the first evaluation
    next: int  # its next action, of ``Next`` in ``solve_state.h``
    has_change: int  # 1 if the change from the last iterate to the next one is stored
    changes_mixture: int  # 1 if the newest change becomes that from mixture to mixture
    change_count: int  # number of stored changes in ``history``
    newest: int  # slot of the newest stored change
    used: int  # number of changes that the next step mixes
    is_best: int  # 1 if the last iterate is the best so far
    plain_steps: int  # steps left without mixing
    apart: int  # solves left without sweeps and steps of bodies as a whole (``body_products``), since one was rejected
    ahead: wp.float64  # factor η of the last change from solve to solve in the next start
    best: wp.float64  # smallest merit of this solve, negative before the first evaluation
    alpha: wp.types.vector(DEPTH, wp.float64)  # Anderson coefficients
    slowness: wp.float64  # predicted sum of the remaining steps over the last step
    gain: wp.types.vector(DEPTH, wp.float64)  # ratio ‖φΔs‖/‖φΔr‖ of each stored change


@cache
def state_type(dtype):
    """Return the struct of the state of n moments, m of them inducible, in w worlds and c chunks."""
    vec3 = wp.types.vector(3, dtype)

    @wp.struct
    class SolveState:
        packed: wp.array2d[dtype]  # moments, shape [8, n]; inducible ones are written
        moments: wp.array[vec3]  # the same [A·m²], shape [n]
        neighbor: wp.array2d[int]  # lists of neighbors (``PackedMoments``)
        neighbor_count: wp.array[int]
        overlap: wp.array2d[int]
        overlap_count: wp.array[int]
        searching: wp.array[int]
        saturation: wp.array[dtype]  # this and the next are materials (``curves.CurveParameters``)
        slope: wp.array[dtype]
        curve: wp.array[int]
        common_curve: int
        within_body: wp.array[dtype]  # 1 where moments of a body are neighbors as balls, 0 in others, shape [n]
        curve_tables: wp.array2d[dtype]
        rtol: wp.float64  # error at which a world ends
        max_evaluations: int  # field evaluations after which a world ends unconverged
        row: wp.array[wp.vec4i]  # moment, world, and range of the world's inducible moments, shape [m]
        active: wp.array[int]  # on a GPU the number of rows whose worlds do not rest, then these; None for all
        chunk: wp.array[wp.vec3i]  # range of rows, and world, of each chunk, shape [c]
        block_moments: int  # on a GPU the number of moments of the largest chunk, rounded up to one of few sizes
        chunk_begin: wp.array[int]  # first chunk of each world, shape [w + 1]
        near: wp.array3d[int]  # on a CPU rows of the neighbors of a chunk's moments, shape [c, CAPACITY, CHUNK]
        near_count: wp.array[int]  # length of the longest list of each vector; on a GPU neighbors of a moment
        h0: wp.array[vec3]  # applied field [A/m], external and of permanent magnets, shape [n]
        h: wp.array[vec3]  # total field [A/m], shape [n]
        h_change: wp.array[vec3]  # part of ``h`` by steps of bodies as a whole [A/m], shape [n]; None without
        s: wp.array[vec3]  # dual variable [dimensionless], shape [n]
        mixed_s: wp.array[vec3]  # last mixture of iterates, shape [n]
        mixed_r: wp.array[vec3]  # its residual
        history_s: wp.array2d[vec3]  # last changes of both from one evaluation to the next, shape [DEPTH, n]
        history_r: wp.array2d[vec3]
        best_s: wp.array[vec3]  # iterate of the smallest merit, shape [n]
        best_r: wp.array[vec3]  # its residual
        mixed_g: wp.array[vec3]  # reduced field of the mixed iterate, without the changes by sweeps, shape [n]
        mixed_moment: wp.array[vec3]  # moments of the mixed iterate [A·m²], shape [n]
        past_field: wp.array2d[vec3]  # inducible moments' field at the last two solutions [A/m], last first, [2, n]
        past_g: wp.array2d[vec3]  # reduced total field at these solutions
        step: wp.array[dtype]  # step length of each moment, shape [n]
        past: wp.array2d[dtype]  # position [m], radius and moment [A·m²] at these solutions, shape [rows, LINE]
        now: wp.array2d[dtype]  # position [m], radius, and change of moment by a step, shape [rows, LINE]
        swept: wp.array2d[dtype]  # the same, with the change by the first sweep
        sums: wp.array2d[wp.float64]  # sums of each chunk, on a CPU of each vector, shape [c, COLUMNS]
        arrived: wp.array[int]  # number of each world's chunks whose sums are complete, shape [w]
        worlds: wp.array[World]  # state of each world, shape [w]
        has_cells: wp.array[int]  # 1 for worlds with bodies of cells, shape [w]
        resting: wp.array[int]  # 1 for worlds that solves leave out, shape [w]
        warm: wp.array[int]  # number of solves of each world since its cold start, at most ``STEADY``, shape [w]
        residual: wp.array[wp.float64]  # ‖M − f(H)‖/‖f(H)‖ of each world after its last evaluation, shape [w]
        error: wp.array[wp.float64]  # estimate of ``theta_flow``, or residual of a baseline, relative, shape [w]
        evaluations: wp.array[int]  # number of evaluations of the last solve, shape [w]
        converged: wp.array[int]  # 1 if it converged, shape [w]
        condition: wp.array[int]  # 1 while any world iterates, shape [1]

    return SolveState


def allocate(worlds, inducible, cells, dtype, device, copies: int = 1):
    """Allocate the state of a solve; :func:`bind` sets the arrays that it shares.

    The worlds of the moments do not decrease. In each world inducible moments come first. ``cells`` is True for the
    cells of bodies. The state has ``copies`` of these worlds.
    """
    on_cpu = wp.get_device(device).is_cpu
    n, size = copies * len(worlds), CHUNK if on_cpu else BLOCK_CHUNK
    rows, chunks, chunk_begin = _rows_and_chunks(worlds, inducible, size, copies)
    row_count, world_count, count = copies * len(rows[0]), len(chunk_begin) - 1, len(chunks)
    vec3, vectors = wp.types.vector(3, dtype), CHUNK // (64 // wp.types.type_size_in_bytes(dtype)) if on_cpu else 1

    has_cells = np.bincount(worlds, cells, minlength=world_count // copies) > 0

    def put(values, kind):
        return wp.array(np.asarray(values, np.int32), dtype=kind, device=device)

    def zeros(names, shape, kind=wp.int32):
        return {name: wp.zeros(shape, dtype=kind, device=device) for name in names.split()}

    arrays = {
        "row": put_copies(rows[0], wp.vec4i, device, copies, rows[1]),
        "chunk": put(chunks, wp.vec3i),
        "chunk_begin": put(chunk_begin, wp.int32),
        "has_cells": put_copies(has_cells.astype(np.int32), wp.int32, device, copies),
        "converged": put(np.ones(world_count), wp.int32),  # worlds without inducible moments count as converged
        **zeros("near", (count if on_cpu else 0, CAPACITY, CHUNK)),
        **zeros("near_count", count * vectors if on_cpu else row_count),
        **zeros("h0 h s mixed_s mixed_r best_s best_r mixed_g mixed_moment", n, vec3),
        **zeros("history_s history_r", (DEPTH, n), vec3),
        **zeros("past_field past_g", (2, n), vec3),
        **zeros("past now swept", (count * size if on_cpu else row_count, LINE), dtype),
        **zeros("step", n, dtype),
        "within_body": wp.ones(n, dtype=dtype, device=device),
        **zeros("sums", (count * vectors, COLUMNS), wp.float64),
        **zeros("worlds", world_count, World),
        **zeros("residual error", world_count, wp.float64),
        **zeros("arrived resting warm evaluations", world_count),
        **zeros("condition", 1),
    }
    state = state_type(dtype)()
    for name, array in arrays.items():
        setattr(state, name, array)
    largest = np.max(chunks[:, 1] - chunks[:, 0], initial=0)
    state.block_moments = size if on_cpu else next(n for n in _CHUNK_SIZES if n >= largest)
    return state


def _rows_and_chunks(worlds, inducible, size: int, copies: int):
    """Return the rows of a copy of the worlds with their steps, chunks of all copies, and first chunks of worlds."""
    n, world_count = len(worlds), int(worlds[-1]) + 1 if len(worlds) else 0
    target = np.flatnonzero(inducible)
    world, counts = worlds[target], np.bincount(worlds[target], minlength=world_count)
    begin = np.searchsorted(worlds, np.arange(world_count))
    rows = np.stack([target, world, begin[world], (begin + counts)[world]], axis=1).astype(np.int32)
    ends = np.cumsum(counts)
    of_world, first, last = cut(ends - counts, ends, size)
    chunks = repeat_rows(np.stack([first, last, of_world], axis=1), copies, [len(rows), len(rows), world_count])
    chunk_begin = np.append(0, np.cumsum(repeat_rows(-(-counts // size), copies)))
    return (rows, [n, world_count, n, n]), chunks, chunk_begin


def persistent_arrays(state) -> dict:
    """Return the arrays of a state that persist from one solve to the next, by name."""
    names = "near near_count s mixed_s mixed_r history_s history_r best_s best_r mixed_g mixed_moment past_field"
    names += " past_g past now swept worlds resting warm residual error evaluations converged"
    return {name: getattr(state, name) for name in names.split()}


def start_arrays(state) -> list:
    """Return the arrays from which a solve starts without extrapolation."""
    return [state.s, state.warm, state.worlds]


def bind(state, packed, material, moments, rtol: float, max_evaluations: int) -> None:
    """Set the moments of a solve with their materials, and the limits at which it ends."""
    state.packed, state.moments, state.searching = packed.packed, moments, packed.searching
    state.neighbor, state.neighbor_count = packed.neighbors, packed.neighbor_counts
    state.overlap, state.overlap_count = packed.overlaps, packed.overlap_counts
    state.saturation, state.slope, state.curve = material.saturation, material.slope, material.curve
    state.common_curve, state.curve_tables = material.common_curve, material.tables
    state.rtol, state.max_evaluations = rtol, max_evaluations


@cache
def _cold_kernel(dtype):
    @wp.kernel(module="unique", enable_backward=False)
    def start_cold(chosen: wp.array[int], state: state_type(dtype)):
        w = wp.tid()
        if chosen[w] != 0:
            state.warm[w] = 0
            state.worlds[w] = World()

    return start_cold


def launch_start_cold(state, chosen):
    """Discard the last solutions of worlds where ``chosen`` is not 0, shape [w]: their next solve starts cold."""
    kernel = _cold_kernel(state.packed.dtype)
    wp.launch(kernel, dim=len(chosen), inputs=[chosen, state], device=chosen.device)


@cache
def _restart_kernel(dtype):
    @wp.kernel(module="unique", enable_backward=False)
    def restart(rejected: wp.array[int], state: state_type(dtype)):
        w = wp.tid()
        if rejected[0] != 0:
            state.warm[w] = wp.min(state.warm[w], 1)
            state.worlds[w].change_count = 0

    return restart


def launch_restart(state, rejected):
    """Discard what solves remember of the last ones except for :func:`start_arrays`, if ``rejected`` [1] is not 0."""
    kernel = _restart_kernel(state.packed.dtype)
    wp.launch(kernel, dim=len(state.warm), inputs=[rejected, state], device=rejected.device)


@wp.func
def is_last_of_world(lane: int, w: int, chunks: int, arrived: wp.array[int]):
    """Return true in the last block that sums one of the ``chunks`` of world ``w``; it can read all sums."""
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
    """Return the Warp function with which the last block of a world adds up the world's sums.

    Kernels that call it include ``shared/block_sum.h``. Every thread passes its terms. The first thread of the last
    block gets (True, totals), all others False.
    """
    vector = wp.types.vector(columns, wp.float64)

    @wp.func_native("return warpmag::block_sum(value);")
    def sum_block(value: vector) -> vector: ...

    @wp.func
    def sum_world(terms: vector, c: int, lane: int, w: int, state: state_type(dtype)):
        total = sum_block(terms)
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
        return lane == 0, sum_block(rest)

    return sum_world


@cache
def _bias_kernel(vec3):
    @wp.kernel(module="unique", enable_backward=False)
    def add_bias(bias: wp.array[vec3], moments: wp.array[int], h0: wp.array[vec3]):
        i = moments[wp.tid()]
        h0[i] = h0[i] + bias[i]

    return add_bias


def launch_add_bias(bias, moments, h0):
    """Add the bias M_r/χ [A/m] of permanent magnets that respond to the field, M = M_r + χ H' with the inner field H'.

    The curve of such a magnet's ball is M = k (H + M_r/χ), k = 3χ/(3 + χ): linear in the field H plus a bias. The bias
    is part of a solve's applied field ``h0`` only, and exerts no force. ``moments`` are the indices that have a bias.
    """
    wp.launch(_bias_kernel(h0.dtype), dim=len(moments), inputs=[bias, moments, h0], device=h0.device)
