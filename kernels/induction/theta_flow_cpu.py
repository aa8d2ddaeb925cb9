"""The accelerated θ flow on a CPU: what ``theta_flow`` says, in passes over vectors of moments that threads share.

A vector has moments of one world only: rows of the inducible moments are padded to ``LANES`` in each world, and what
moments read of each other stands in a cache line for each row. All other arrays are those of ``induction``.

| variable | shape | meaning |
|---|---|---|
| near | [chunks, CAPACITY, LANES] | inducible neighbours of each row, padded rows; itself where there is none |
| near_count | [chunks] | how many the longest of its lists has |
| past | [rows, BLOCK] | last two places [m] and moments [A·m²], radius |
| shown, next_shown | [rows, BLOCK] | place [m], radius, and what a step adds to the moment [A·m²] |
"""

from dataclasses import dataclass
from functools import cache
from typing import Any

import numpy as np
import warp as wp

from warpmag.kernels.induction.anderson import DEPTH
from warpmag.kernels.induction.solve_state import (
    COLUMNS,
    EARLIER,
    FIELD,
    FLOW_STEP,
    FOLLOWED,
    GOAL,
    LACK,
    MERIT,
    STIFFNESS,
    TERMS,
    InductionBuffers,
    World,
    begin_world,
)
from warpmag.kernels.induction.theta_flow import (
    REST,
    RETREAT,
    STEADY,
    SWEEP,
    SWEEP_STEP,
    VANISH,
    columns,
    decide,
    open_world,
)
from warpmag.kernels.pairs.field import INVERSE_4PI
from warpmag.kernels.pairs.moment_code import moment_text
from warpmag.kernels.pairs.neighbors import CAPACITY
from warpmag.kernels.shared.vector_text import BLOCK, LANES, passes_text
from warpmag.kernels.shared.team import MOMENTS_PER_THREAD, team, threads_for, wide_registers

SHOW, START, FIRST_SWEEP, LAST_SWEEP, JUDGE, ADVANCE = range(6)
"""The passes, in order."""

_PLACE = f"""
    typedef double WIDE __attribute__((ext_vector_type(WIDTH)));
    auto* const worlds = arrays.worlds.data;
    const size_t n = arrays.s.shape[0], pitch = arrays.packed.strides[0] / sizeof(REAL);
    struct Place {{
        int row, i, held, world, begin, end, source_begin, source_end, sums;
        int shift;  // of the row behind the moment
    }};
    auto place = [=](int row) -> Place {{
        const int* c = chunk + 8 * (row / LANES);
        const int offset = row % LANES, i = c[0] + offset, left = c[1] - offset;
        const int held = left < 0 ? 0 : left > WIDTH ? WIDTH : left;
        return {{row, i, held, c[2], c[3], c[4], c[5], c[6], c[7] + offset, row - i}};
    }};
    auto whose = [=](const REAL* rows, const Place& at) -> Vector {{ return vectors(rows + 3 * at.i, at.held); }};
    auto put_whose = [=](REAL* rows, const Place& at, Vector v) {{ put_vectors(rows + 3 * at.i, at.held, v); }};
    auto volume_of = [](NUMBER radius) -> NUMBER {{ return REAL(4.18879020478639) * radius * radius * radius; }};
    auto magnetized = [=](const Place& at, Vector s) -> Vector {{
        const NUMBER volume = volume_of(some(packed + 3 * pitch + at.i, at.held, 0));
        return scaled(volume * some(saturation + at.i, at.held, 1) * curve_ratio(length(s), curve[at.i]), s);
    }};
    auto store = [=](const Place& at, Vector m) {{
        put_whose(moments, at, m);
        put_some(packed + 4 * pitch + at.i, at.held, m.x);
        put_some(packed + 5 * pitch + at.i, at.held, m.y);
        put_some(packed + 6 * pitch + at.i, at.held, m.z);
    }};
    // calls meet(j, listed) for slot after slot of the neighbours of a row
    auto meet_neighbors = [=](int row, auto meet) {{
        INDEX self;
        for (int l = 0; l < WIDTH; ++l) self[l] = row + l;
        for (int s = 0; s < near_count[row / WIDTH]; ++s) {{
            const int* j = list_at(near, {CAPACITY}, s, row);
            meet(j, mask_of(indices(j) != self));
        }}
    }};
"""

_BEGIN = f"""
    auto list = [&](const Place& at) {{
        int* const lists = list_at(near, {CAPACITY}, 0, at.row);
        int counts[WIDTH], most = 0;
        for (int l = 0; l < WIDTH; ++l) {{
            const int i = at.i + l, found = l < at.held && neighbor_count[i] <= {CAPACITY} ? neighbor_count[i] : 0;
            counts[l] = 0;
            for (int s = 0; s < found; ++s) {{
                const int j = neighbor[(size_t){CAPACITY} * i + s];
                if (j >= at.begin && j < at.end) lists[LANES * counts[l]++ + l] = j + at.shift;
            }}
            most = counts[l] > most ? counts[l] : most;
        }}
        for (int l = 0; l < WIDTH; ++l)
            for (int s = counts[l]; s < most; ++s) lists[LANES * s + l] = at.row + l;
        near_count[at.row / WIDTH] = most;
    }};
    auto show = [&](const Place& at) {{
        Four own;
        own.x = some(packed + at.i, at.held, 0);
        own.y = some(packed + pitch + at.i, at.held, 0);
        own.z = some(packed + 2 * pitch + at.i, at.held, 0);
        own.w = some(packed + 3 * pitch + at.i, at.held, 0);
        put_four(shown, 0, at.row, own);
        put_four(next_shown, 0, at.row, own);
        for (int k = 0; k < 2; ++k) {{
            const Vector x = whose(past_positions + 3 * k * n, at), m = whose(past_moments + 3 * k * n, at);
            put_four(past, 2 * k, at.row, {{x.x, x.y, x.z, own.w}});
            put_four(past, 2 * k + 1, at.row, {{m.x, m.y, m.z, 0}});
        }}
        if (searching[0]) list(at);
    }};
    auto start = [&](const Place& at) {{
        const int was = warm[at.world];
        const bool steady = was == {STEADY};
        const REAL ahead = (REAL)worlds[at.world].ahead;
        const Four own = own_four(shown, 0, at.row);
        const NUMBER radius = own.w, limit = some(saturation + at.i, at.held, 1), k = some(slope + at.i, at.held, 0);
        INDEX self = 0;
        for (int l = 0; l < at.held; ++l) self[l] = at.i + l;
        auto meet_overlapping = [&](int begin, int end, auto meet) {{
            walk(overlap, overlap_count, self, at.held, begin, end, [&](INDEX j, MASK listed) {{
                auto row = [&](int c) {{ return collect(packed + c * pitch, j); }};
                const Vector r = {{own.x - row(0), own.y - row(1), own.z - row(2)}};
                const NUMBER other = row(3), contact = radius + other;
                meet(row, r, other, listed & mask_of(j != self) & (dot(r, r) < contact * contact));
            }});
        }};
        Vector applied = {{0, 0, 0}};
        if (at.source_end > at.source_begin) {{
            for (int part = 0; part < arrays.partial.shape[0]; ++part) {{
                const REAL* row = partial + 3 * ((size_t)part * arrays.partial.shape[1] + at.sums);
                applied = sum(applied, vectors(row, at.held));
            }}
            meet_overlapping(at.source_begin, at.source_end, [&](auto row, Vector r, NUMBER other, MASK overlapping) {{
                add_lacking(applied, r, radius, other, {{row(4), row(5), row(6)}}, overlapping);
            }});
        }}
        const Vector base = sum(whose(external_field, at), scaled(INVERSE_4PI, applied));
        NUMBER volume = 0;
        meet_overlapping(at.begin, at.end, [&](auto, Vector r, NUMBER other, MASK overlapping) {{
            volume += shared_volume(dot(r, r), radius, other, overlapping);
        }});
        const NUMBER stiffness = k * (volume + REAL(2.0 / 3.0)), field = length(base);
        double* const most = (double*)arrays.largest.data + 2 * (at.row / WIDTH);
        most[{FIELD}] = most[{STIFFNESS}] = 0;
        for (int l = 0; l < at.held; ++l) {{
            most[{FIELD}] = field[l] > most[{FIELD}] ? field[l] : most[{FIELD}];
            most[{STIFFNESS}] = stiffness[l] > most[{STIFFNESS}] ? stiffness[l] : most[{STIFFNESS}];
        }}
        put_whose(h0, at, base);
        Vector now = whose(s, at);
        if (was == 0) {{
            // the θ flow with κ = k from no magnetization: exact for a lone ball; shorter where balls overlap deeply
            const NUMBER one = 1, safe = smaller(one, REAL(MOST_STEP) / (1 + stiffness));
            now = scaled(smaller(one, safe / REAL(0.6)) * k / limit, base);
        }}
        if (steady) now = sum(now, scaled(ahead, less(whose(past_g, at), whose(past_g + 3 * n, at))));
        put_whose(s, at, now);
        const Vector m = magnetized(at, now);
        store(at, m);
        if (!steady) return;
        Vector about = {{0, 0, 0}};
        const Four x0 = own_four(past, 0, at.row), x1 = own_four(past, 2, at.row);
        meet_neighbors(at.row, [&](const int* j, MASK listed) {{
            const Four y0 = four_at(past, 0, j), n0 = four_at(past, 1, j);
            const Four y1 = four_at(past, 2, j), n1 = four_at(past, 3, j);
            Vector last = {{0, 0, 0}}, earlier = {{0, 0, 0}};
            add_field(last, {{x0.x - y0.x, x0.y - y0.y, x0.z - y0.z}}, radius, y0.w, {{n0.x, n0.y, n0.z}}, listed);
            add_field(earlier, {{x1.x - y1.x, x1.y - y1.y, x1.z - y1.z}}, radius, y1.w, {{n1.x, n1.y, n1.z}}, listed);
            about = sum(about, sum(last, scaled(ahead, less(last, earlier))));
        }});
        const Vector field0 = whose(past_field, at), field1 = whose(past_field + 3 * n, at);
        const Vector far = less(sum(field0, scaled(ahead, less(field0, field1))), scaled(INVERSE_4PI, about));
        put_whose(mixed_g, at, scaled(k / limit, sum(base, far)));
        put_whose(mixed_moment, at, {{0, 0, 0}});
        put_four(shown, 1, at.row, {{m.x, m.y, m.z, 0}});
    }};
"""

_SWEEP = f"""
    auto sweep = [&](const Place& at, const REAL* from, REAL* to) {{
        if (at.row == 0) arrays.condition.data[0] = 0;  // until a world wants another evaluation
        if (worlds[at.world].mode != {SWEEP}) return;
        const Four own = own_four(from, 0, at.row);
        Vector h = {{0, 0, 0}};
        meet_neighbors(at.row, [&](const int* j, MASK listed) {{
            const Four other = four_at(from, 0, j), m = four_at(from, 1, j);
            const Vector r = {{own.x - other.x, own.y - other.y, own.z - other.z}};
            add_field(h, r, own.w, other.w, {{m.x, m.y, m.z}}, listed);
        }});
        const NUMBER scale = INVERSE_4PI * some(slope + at.i, at.held, 1) / some(saturation + at.i, at.held, 1);
        const Vector g = sum(whose(mixed_g, at), scaled(scale, h)), now = whose(s, at);
        const REAL wanted = SWEEP_STEP * (REAL)worlds[at.world].omega;
        const Vector next = sum(now, scaled(wanted < 1 ? wanted : REAL(1), less(g, now)));
        put_whose(s, at, next);
        const Vector m = magnetized(at, next);
        if (to) {{
            const Vector change = less(m, whose(mixed_moment, at));
            put_four(to, 1, at.row, {{change.x, change.y, change.z, 0}});
        }} else {{
            store(at, m);
        }}
    }};
"""

_JUDGE = f"""
    auto slot_of = [](int newest, int age) {{ return (newest - age + {DEPTH}) % {DEPTH}; }};
    auto wide = [](NUMBER x) -> WIDE {{ return __builtin_convertvector(x, WIDE); }};
    auto product = [=](Vector a, Vector b) -> WIDE {{
        return wide(a.x) * wide(b.x) + wide(a.y) * wide(b.y) + wide(a.z) * wide(b.z);
    }};
    auto judge = [&](const Place& at) {{
        if (!worlds[at.world].active) return;
        double* const sums = (double*)arrays.sums.data + (size_t){COLUMNS} * (at.row / WIDTH);
        auto put_sum = [=](int column, WIDE lanes) {{
            #pragma clang fp reassociate(on)
            double total = 0;
            for (int l = 0; l < WIDTH; ++l) total += lanes[l];
            sums[column] = total;
        }};
        const int linked = worlds[at.world].linked, newest = (worlds[at.world].newest + linked) % {DEPTH};
        const int some_kept = worlds[at.world].kept + linked, kept = some_kept < {DEPTH} ? some_kept : {DEPTH};
        const NUMBER limit = some(saturation + at.i, at.held, 1), k = some(slope + at.i, at.held, 0);
        const Vector now = whose(s, at), g = scaled(k / limit, whose(h, at)), r = less(g, now);
        if (linked) {{
            put_whose(history_s + 3 * n * newest, at, less(now, whose(iterate_s, at)));
            put_whose(history_r + 3 * n * newest, at, less(r, whose(iterate_r, at)));
        }}
        put_whose(iterate_s, at, now);
        put_whose(iterate_r, at, r);
        const NUMBER length_s = length(now), length_g = length(g);
        const NUMBER worth_s = limit * curve_ratio(length_s, curve[at.i]);
        const NUMBER worth_g = limit * curve_ratio(length_g, curve[at.i]);
        const WIDE goal = wide(worth_g * length_g), lack = wide(length(less(scaled(worth_g, g), scaled(worth_s, now))));
        const WIDE weight = wide(length_s > length_g ? worth_s : worth_g), squared = weight * weight;
        const WIDE merit = weight * wide(length(r));
        put_sum({LACK}, lack * lack);
        put_sum({GOAL}, goal * goal);
        put_sum({MERIT}, merit * merit);
        const Vector g0 = whose(past_g, at), earlier = less(g0, whose(past_g + 3 * n, at));
        put_sum({FOLLOWED}, squared * product(less(g, g0), earlier));
        put_sum({EARLIER}, squared * product(earlier, earlier));
        Vector change[{DEPTH}];
        for (int a = 0; a < {DEPTH}; ++a) {{
            if (a < kept) {{
                change[a] = whose(history_r + 3 * n * slot_of(newest, a), at);
                put_sum({TERMS} + a, squared * product(change[a], r));
            }} else {{
                sums[{TERMS} + a] = 0;
            }}
            for (int b = 0; b <= a; ++b) {{
                const int column = {TERMS + DEPTH} + b * {DEPTH} - b * (b - 1) / 2 + a - b;
                if (a < kept) put_sum(column, squared * product(change[b], change[a]));
                else sums[column] = 0;
            }}
        }}
    }};
"""

_ADVANCE = f"""
    auto advance = [&](const Place& at) {{
        const auto& world = worlds[at.world];
        if (world.mode == {REST}) return;
        Vector mixed = {{0, 0, 0}}, r = {{0, 0, 0}};
        if (world.mode == {RETREAT}) {{
            mixed = whose(best_s, at);
            r = whose(best_r, at);
        }} else if (world.mode != {VANISH}) {{
            mixed = whose(iterate_s, at);
            r = whose(iterate_r, at);
            if (world.improved) {{
                put_whose(best_s, at, mixed);
                put_whose(best_r, at, r);
            }}
            for (int a = 0; a < world.used; ++a) {{
                const size_t old = 3 * n * slot_of(world.newest, a);
                const REAL alpha = (REAL)world.alpha[a];
                mixed = less(mixed, scaled(alpha, whose(history_s + old, at)));
                r = less(r, scaled(alpha, whose(history_r + old, at)));
            }}
        }}
        const Vector g = sum(mixed, r), next = sum(mixed, scaled((REAL)world.omega, r));
        put_whose(s, at, next);
        // what has ended keeps the moments that its error was measured at, and s is the next solve's start
        if (world.active) {{
            const Vector m = magnetized(at, next);
            store(at, m);
            if (world.mode != {SWEEP}) return;
            const Vector before = magnetized(at, mixed), change = less(m, before);
            put_whose(mixed_g, at, g);
            put_whose(mixed_moment, at, before);
            put_four(shown, 1, at.row, {{change.x, change.y, change.z, 0}});
        }} else {{
            REAL* const all[4] = {{past_positions, past_moments, past_field, past_g}};
            for (REAL* two : all) put_whose(two + 3 * n, at, whose(two, at));
            const Four own = own_four(shown, 0, at.row);
            const NUMBER limit = some(saturation + at.i, at.held, 1), k = some(slope + at.i, at.held, 1);
            put_whose(past_positions, at, {{own.x, own.y, own.z}});
            // the mixed iterate is nearer to the solution than the one that was judged
            put_whose(past_moments, at, magnetized(at, mixed));
            put_whose(past_field, at, less(scaled(limit / k, g), whose(h0, at)));
            put_whose(past_g, at, g);
        }}
    }};
"""

_PASSES = f"""
    const Place at = place(i);
    if (at.held == 0) return;
    if (pass == {SHOW}) show(at);
    else if (pass == {START}) start(at);
    else if (pass == {FIRST_SWEEP}) sweep(at, shown, next_shown);
    else if (pass == {LAST_SWEEP}) sweep(at, next_shown, nullptr);
    else if (pass == {JUDGE}) judge(at);
    else advance(at);
"""

_INTEGERS = ("chunk", "near", "near_count", "searching", "neighbor", "neighbor_count", "overlap", "overlap_count",
             "curve", "warm")  # fmt: skip
_REALS = (
    "packed", "external_field", "partial", "saturation", "slope", "moments", "h0", "h", "s", "past_positions",
    "past_moments", "past_field", "past_g", "iterate_s", "iterate_r", "history_s", "history_r", "best_s", "best_r",
    "mixed_g", "mixed_moment", "past", "shown", "next_shown",
)  # fmt: skip


@cache
def _arrays_type(dtype):
    """Type of what the passes are given."""
    vec3 = wp.types.vector(3, dtype)

    @wp.struct
    class ThetaFlowArrays:
        chunk: wp.array2d[int]
        near: wp.array3d[int]
        near_count: wp.array[int]
        searching: wp.array[int]
        neighbor: wp.array2d[int]
        neighbor_count: wp.array[int]
        overlap: wp.array2d[int]
        overlap_count: wp.array[int]
        packed: wp.array2d[dtype]
        external_field: wp.array[vec3]
        partial: wp.array3d[dtype]
        saturation: wp.array[dtype]
        slope: wp.array[dtype]
        curve: wp.array[int]
        moments: wp.array[vec3]
        h0: wp.array[vec3]
        h: wp.array[vec3]
        s: wp.array[vec3]
        past_positions: wp.array2d[vec3]
        past_moments: wp.array2d[vec3]
        past_field: wp.array2d[vec3]
        past_g: wp.array2d[vec3]
        iterate_s: wp.array[vec3]
        iterate_r: wp.array[vec3]
        history_s: wp.array2d[vec3]
        history_r: wp.array2d[vec3]
        best_s: wp.array[vec3]
        best_r: wp.array[vec3]
        mixed_g: wp.array[vec3]
        mixed_moment: wp.array[vec3]
        past: wp.array2d[dtype]
        shown: wp.array2d[dtype]
        next_shown: wp.array2d[dtype]
        largest: wp.array2d[wp.float64]
        sums: wp.array2d[wp.float64]
        warm: wp.array[int]
        worlds: wp.array[World]
        condition: wp.array[int]

    return ThetaFlowArrays


@dataclass(frozen=True)
class Passes:
    """What the passes work on.

    Attributes:
        arrays: A Warp struct of arrays; besides those of ``induction``, the moments' and the module's:
            chunk: First moment of each chunk of rows, how many it holds, its world, the world's inducible moments from
                and to, and permanent ones, and the first moment's row among the sums of their field, shape [chunks, 8].
            partial: Those sums.
            largest: Largest applied field [A/m] and stiffness of each vector of rows, shape [vectors, 2].
            sums: Its sums, shape [vectors, COLUMNS].
        begin: First vector of each world, shape [worlds + 1].
        buffers: State of the solve.
        dtype: Warp scalar type.
        threads: Threads that share a pass.
        commands: Launches as they were recorded, which spares packing the arrays each time.
    """

    arrays: Any
    begin: wp.array
    buffers: InductionBuffers
    dtype: Any
    threads: int
    commands: dict


def allocate(applied, partial, induced, moments, external_field, material, b: InductionBuffers, moments_out) -> Passes:
    """Allocate what the passes need beyond the state of a solve; for the arguments see ``theta_flow.launch_begin``."""
    dtype = moments.dtype
    target, begin, end, source_begin, source_end = (
        array.numpy() for array in (induced.target, induced.begin, induced.end, applied.begin, applied.end)
    )
    world = b.world.numpy()[target]
    chunks, first_vector = [], [0]
    vectors = 1 if dtype is wp.float32 else 2  # of a chunk
    for w in range(b.warm.shape[0]):
        rows = np.flatnonzero(world == w)
        for row in rows[::LANES]:
            held = min(LANES, rows[-1] + 1 - row)
            chunks.append((target[row], held, w, begin[row], end[row], source_begin[row], source_end[row], row))
        first_vector.append(vectors * len(chunks))
    count = len(chunks)

    def put(values, kind):
        return wp.array(np.asarray(values, np.int32), dtype=kind, device="cpu")

    def zeros(*shape, kind=dtype):
        return wp.zeros(shape, dtype=kind, device="cpu")

    arrays = _arrays_type(dtype)()
    arrays.chunk = put(np.reshape(chunks, (-1, 8)), wp.int32)
    arrays.near = zeros(count, CAPACITY, LANES, kind=wp.int32)
    arrays.near_count = zeros(vectors * count, kind=wp.int32)
    arrays.searching = moments.searching
    arrays.neighbor, arrays.neighbor_count = moments.neighbors, moments.neighbor_counts
    arrays.overlap, arrays.overlap_count = moments.overlaps, moments.overlap_counts
    arrays.packed, arrays.moments = moments.packed, moments_out
    arrays.external_field, arrays.partial = external_field, partial
    arrays.saturation, arrays.slope, arrays.curve = material.saturation, material.slope, material.curve
    for name in ("h0", "h", "s", "past_positions", "past_moments", "past_field", "past_g", "iterate_s", "iterate_r",
                 "history_s", "history_r", "best_s", "best_r", "mixed_g", "mixed_moment", "warm", "worlds",
                 "condition"):  # fmt: skip
        setattr(arrays, name, getattr(b, name))
    arrays.past, arrays.shown, arrays.next_shown = (zeros(LANES * count, BLOCK) for _ in range(3))
    arrays.largest = zeros(vectors * count, 2, kind=wp.float64)
    arrays.sums = zeros(vectors * count, COLUMNS, kind=wp.float64)
    return Passes(arrays, put(first_vector, wp.int32), b, dtype, threads_for(len(target), MOMENTS_PER_THREAD), {})


# ---------------------------------------------------------------------------------------------------------------------
# Launches
# ---------------------------------------------------------------------------------------------------------------------


@cache
def _kernel(dtype):
    arrays_type = _arrays_type(dtype)
    real = "float" if dtype is wp.float32 else "double"
    body = moment_text(real) + _PLACE + _BEGIN + _SWEEP + _JUDGE + _ADVANCE
    numbers = {"INVERSE_4PI": INVERSE_4PI, "SWEEP_STEP": SWEEP_STEP, "MOST_STEP": 2.0 * FLOW_STEP}
    text = passes_text(real, 1, {}, numbers, _INTEGERS, _REALS, body, _PASSES, balls="LANES * arrays.chunk.shape[0]")

    @wp.func_native(text)
    def make_passes(
        thread: int, first: int, last: int, threads: int, team: wp.array2d[wp.uint64], arrays: arrays_type
    ): ...

    @wp.kernel(module="unique", enable_backward=False, module_options=wide_registers())
    def theta_flow_passes(first: int, last: int, threads: int, team: wp.array2d[wp.uint64], arrays: arrays_type):
        make_passes(0, first, last, threads, team, arrays)

    return theta_flow_passes


@wp.kernel(module="unique", enable_backward=False)
def _open_worlds(
    # inputs:
    begin: wp.array[int],
    largest: wp.array2d[wp.float64],
    warm: wp.array[int],
    start: wp.array2d[wp.float64],
    # outputs:
    worlds_out: wp.array[World],
    condition_out: wp.array[int],
):
    w = wp.tid()
    field = wp.float64(0.0)
    stiffness = wp.float64(0.0)
    for v in range(begin[w], begin[w + 1]):
        field = wp.max(field, largest[v, wp.static(FIELD)])
        stiffness = wp.max(stiffness, largest[v, wp.static(STIFFNESS)])
    if begin[w + 1] > begin[w]:
        begin_world(w, field, stiffness, start, worlds_out, condition_out)
        open_world(w, warm[w], worlds_out)


@wp.func_native(f"""
    wp::vec_t<{COLUMNS}, wp::float64> total;
    for (int v = begin; v < end; ++v)
        for (int c = 0; c < {COLUMNS}; ++c) total[c] += sums.data[(size_t){COLUMNS} * v + c];
    return total;
""")
def _summed(begin: int, end: int, sums: wp.array2d[wp.float64]) -> columns:
    """Sums of vectors ``begin`` to ``end``."""
    ...


@wp.kernel(module="unique", enable_backward=False)
def _judge_worlds(
    # inputs:
    begin: wp.array[int],
    sums: wp.array2d[wp.float64],
    rtol: wp.float64,
    max_evaluations: int,
    # in and out:
    worlds: wp.array[World],
    start: wp.array2d[wp.float64],
    warm: wp.array[int],
    # outputs:
    error_out: wp.array[wp.float64],
    evaluations_out: wp.array[int],
    converged_out: wp.array[int],
    condition_out: wp.array[int],
):
    w = wp.tid()
    if worlds[w].active == 0:
        worlds[w].mode = wp.static(REST)
        return
    newest = (worlds[w].newest + worlds[w].linked) % wp.static(DEPTH)
    kept = wp.min(worlds[w].kept + worlds[w].linked, wp.static(DEPTH))
    decide(
        w,
        _summed(begin[w], begin[w + 1], sums),
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


def _launch(p: Passes, first: int, last: int):
    """Launch passes ``first`` to ``last``."""
    if (first, last) not in p.commands:
        p.commands[first, last] = wp.launch(
            _kernel(p.dtype), dim=1, inputs=[first, last, p.threads, team(), p.arrays], device="cpu", record_cmd=True
        )
    p.commands[first, last].launch()


def launch_begin(p: Passes):
    """Begin a solve in every world, see ``theta_flow.launch_begin``."""
    b = p.buffers
    _launch(p, SHOW, START + 1)
    wp.launch(
        _open_worlds,
        dim=b.warm.shape[0],
        inputs=[p.begin, p.arrays.largest, b.warm, b.start],
        outputs=[b.worlds, b.condition],
        device="cpu",
    )


def launch_sweeps(p: Passes):
    """Two sweeps over neighbours, before the field is summed, in worlds that want them."""
    _launch(p, FIRST_SWEEP, LAST_SWEEP + 1)


def launch_iteration(p: Passes, rtol, max_evaluations):
    """Judge the field at the inducible moments, and move every world that has not ended."""
    b = p.buffers
    _launch(p, JUDGE, JUDGE + 1)
    wp.launch(
        _judge_worlds,
        dim=b.warm.shape[0],
        inputs=[p.begin, p.arrays.sums, wp.float64(rtol), max_evaluations, b.worlds, b.start, b.warm],
        outputs=[b.error, b.evaluations, b.converged, b.condition],
        device="cpu",
    )
    _launch(p, ADVANCE, ADVANCE + 1)
