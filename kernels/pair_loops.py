"""All-pairs loops: field, and field with gradient, of packed moments at packed targets.

Moments travel packed, one scalar row per component, so that one layout serves vector loads on a CPU and coalesced
loads on a GPU:

| packed row | 0 1 2 | 3 | 4 5 6 | 7 |
|---|---|---|---|---|
| content | position [m] | radius [m] | moment [A·m²] | body label |

A ``Rows`` object says which target sees which contiguous range of sources. The loops come in two forms behind
:func:`launch_pair_loop`: the plain Warp loop, readable, exact for overlapping balls, and kept as the reference; and
native loops, which evaluate the dipole clamped at contact (see ``pair_law``) and leave overlapping pairs to
``neighbors``. Sums leave in ``partial`` rows, several per target where the sources of few targets are split over
blocks; the caller's finishing kernel adds them up in a fixed order, so that results do not depend on scheduling.

All sums are 4π times the field [A/m], three numbers, or that and the gradient [A/m²], nine: xx, yy, zz, xy, yz, zx.
"""

import os
from dataclasses import dataclass
from functools import cache

import numpy as np
import warp as wp

from warpmag.kernels.pair_law import field_of, gradient_of, pair_factors, smoothed_factors

PACKED_ROWS = 8
EXCLUDE_NOTHING, EXCLUDE_SELF, EXCLUDE_BODY = 0, 1, 2
"""Sources that a loop leaves out: none, the target itself, or everything with the target's body label."""

_BLOCK = 256
# Measured on an H200 (132 multiprocessors): targets that a thread holds in registers, and blocks worth launching.
_MANY_TARGETS = 8192
_FEW = (1, 512)
_MANY = (4, 1600)
_MIN_SOURCES_PER_SPLIT = 16
_PAIRS_PER_THREAD = 100_000
"""Pairs that are worth a thread on a CPU: about ten times what it costs to start one."""


@dataclass(frozen=True)
class Rows:
    """Which target rows see which sources, on one device.

    Attributes:
        count: Number of target rows.
        target: Packed column of each target row, shape [count].
        begin: First source of each target row, shape [count].
        end: One past the last source of each target row, shape [count].
        shares: CPU work list: row at which each thread begins, and the end, shape [threads + 1].
        tiles: CUDA work list: target range, source range, split; shape [tiles, 5]. Empty on a CPU.
        splits: Partial sums per target row.
        targets_per_thread: Targets that one CUDA thread holds in registers.
        pair_count: Pairs that the loop evaluates.
    """

    count: int
    target: wp.array
    begin: wp.array
    end: wp.array
    shares: wp.array
    tiles: wp.array
    splits: int
    targets_per_thread: int
    pair_count: int


def _cores() -> int:
    """Cores that this process may use."""
    return len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1


def make_rows(segments, device) -> Rows:
    """Build the work list of target ranges that each see one source range.

    Args:
        segments: Integers [k, 4]: target column begin and end, source begin and end.
        device: Warp device.
    """
    segments = np.asarray(segments, np.int64).reshape(-1, 4)
    sizes = segments[:, 1] - segments[:, 0]
    starts = np.concatenate([[0], np.cumsum(sizes)])
    count = int(starts[-1])
    within = np.arange(count) - np.repeat(starts[:-1], sizes)
    target = np.repeat(segments[:, 0], sizes) + within
    begin, end = np.repeat(segments[:, 2], sizes), np.repeat(segments[:, 3], sizes)

    splits, per_thread, tiles = 1, 1, np.zeros((0, 5), np.int64)
    if wp.get_device(device).is_cuda and count:
        per_thread, blocks_wanted = _MANY if count > _MANY_TARGETS else _FEW
        width = _BLOCK * per_thread
        blocks = int(np.sum(-(-sizes // width)))
        longest = int(np.max(segments[:, 3] - segments[:, 2]))
        splits = max(1, min(-(-blocks_wanted // max(blocks, 1)), longest // _MIN_SOURCES_PER_SPLIT))
        tiles = np.array(
            [
                (
                    starts[k] + t,
                    min(starts[k] + t + width, starts[k + 1]),
                    s0 + (s1 - s0) * split // splits,
                    s0 + (s1 - s0) * (split + 1) // splits,
                    split,
                )
                for k, (_, _, s0, s1) in enumerate(segments)
                for t in range(0, int(sizes[k]), width)
                for split in range(splits)
            ],
            np.int64,
        ).reshape(-1, 5)

    pairs = np.concatenate([[0], np.cumsum(end - begin)])
    threads = int(np.clip(pairs[-1] // _PAIRS_PER_THREAD, 1, min(_cores(), _MOST_THREADS)))
    shares = np.searchsorted(pairs, pairs[-1] * np.arange(threads + 1) // threads)
    shares[-1] = count

    def to_device(a):
        return wp.array(a.astype(np.int32), dtype=wp.int32, device=device)

    return Rows(
        count=count,
        target=to_device(target),
        begin=to_device(begin),
        end=to_device(end),
        shares=to_device(shares),
        tiles=to_device(tiles),
        splits=splits,
        targets_per_thread=per_thread,
        pair_count=int(pairs[-1]),
    )


# ---------------------------------------------------------------------------------------------------------------------
# Reference loop
# ---------------------------------------------------------------------------------------------------------------------


@cache
def _reference_kernel(dtype, gradient: bool):
    vec3 = wp.types.vector(3, dtype)

    @wp.kernel(module="unique", enable_backward=False)
    def pair_loop_reference(
        # inputs:
        targets: wp.array2d[dtype],
        sources: wp.array2d[dtype],
        row_target: wp.array[int],
        row_begin: wp.array[int],
        row_end: wp.array[int],
        exclude: int,
        epsilon2: dtype,
        # outputs:
        partial_out: wp.array3d[dtype],
    ):
        row = wp.tid()
        i = row_target[row]
        x = vec3(targets[0, i], targets[1, i], targets[2, i])
        radius = targets[3, i]
        label = targets[7, i]
        h = vec3()
        diagonal = vec3()
        off_diagonal = vec3()
        for j in range(row_begin[row], row_end[row]):
            left_out = (exclude == 1 and i == j) or (exclude == 2 and label == sources[7, j])
            if not left_out:
                r = x - vec3(sources[0, j], sources[1, j], sources[2, j])
                m = vec3(sources[4, j], sources[5, j], sources[6, j])
                d2 = wp.dot(r, r)
                g = pair_factors(d2, radius, sources[3, j])
                if epsilon2 > dtype(0.0):
                    g = smoothed_factors(d2, epsilon2)
                h += field_of(g, r, m)
                if wp.static(gradient):
                    t = gradient_of(g, r, m)
                    diagonal += vec3(t[0], t[1], t[2])
                    off_diagonal += vec3(t[3], t[4], t[5])
        for c in range(3):
            partial_out[0, row, c] = h[c]
            if wp.static(gradient):
                partial_out[0, row, c + 3] = diagonal[c]
                partial_out[0, row, c + 6] = off_diagonal[c]

    return pair_loop_reference


# ---------------------------------------------------------------------------------------------------------------------
# Native loops
# ---------------------------------------------------------------------------------------------------------------------

# One pair. The products are ordered so that no factor beyond r⁻³ leaves the float32 range before it meets r.
_PAIR = """
    const REAL rx = tx{k} - ax, ry = ty{k} - ay, rz = tz{k} - az;
    const REAL s = tr{k} + ar;
    const REAL s2 = s * s;
    const REAL d2 = rx * rx + ry * ry + rz * rz;
    const REAL c = d2 > s2 ? d2 : s2;
    const REAL inv = {mask} ? RSQRT(c) : REAL(0);
    const REAL inv2 = inv * inv;
    const REAL inv3 = inv2 * inv;
    const REAL rm = REAL(3) * inv2 * (rx * bx + ry * by + rz * bz);
    const REAL ux = rm * rx - bx, uy = rm * ry - by, uz = rm * rz - bz;
    {{
    REORDER_SUMS
    hx{k} += inv3 * ux;
    hy{k} += inv3 * uy;
    hz{k} += inv3 * uz;
    }}
"""
_PAIR_GRADIENT = """
    const REAL w = REAL(3) * inv3 * inv2;
    const REAL trace = inv3 * rm;
    const REAL px = w * bx - REAL(2.5) * inv2 * trace * rx;
    const REAL py = w * by - REAL(2.5) * inv2 * trace * ry;
    const REAL pz = w * bz - REAL(2.5) * inv2 * trace * rz;
    const REAL vxx = REAL(2) * rx * px + trace, vxy = rx * py + ry * px;
    const REAL vyy = REAL(2) * ry * py + trace, vyz = ry * pz + rz * py;
    const REAL vzz = REAL(2) * rz * pz + trace, vzx = rz * px + rx * pz;
    {{
    REORDER_SUMS
    xx{k} += vxx;
    yy{k} += vyy;
    zz{k} += vzz;
    xy{k} += vxy;
    yz{k} += vyz;
    zx{k} += vzx;
    }}
"""
_FIELD_SUMS = ("hx", "hy", "hz")
_GRADIENT_SUMS = ("xx", "yy", "zz", "xy", "yz", "zx")


def _pair_code(gradient: bool, k: str = "") -> str:
    mask = f"(d2 > REAL(0) && al != tl{k})" if gradient else "d2 > REAL(0)"
    return (_PAIR + (_PAIR_GRADIENT if gradient else "")).format(k=k, mask=mask)


def _sums(gradient: bool) -> tuple[str, ...]:
    return _FIELD_SUMS + (_GRADIENT_SUMS if gradient else ())


_MOST_THREADS = 64
# Threads of the process's own library: Warp launches serially on a CPU, and a launch may sit inside a graph, where
# Python's threads cannot help. A thread that cannot be had leaves its rows to this one.
_RUN_THREADS = """
#if defined(_WIN32)
    for (int t = 0; t < threads; ++t) work(&rows[t]);
#else
#if defined(__APPLE__)
    #define SYMBOL(name) "_" name
#else
    #define SYMBOL(name) name
#endif
    typedef void* (*Start)(void*);
    extern int start_thread(unsigned long*, const void*, Start, void*) __asm__(SYMBOL("pthread_create"));
    extern int join_thread(unsigned long, void**) __asm__(SYMBOL("pthread_join"));
    unsigned long ids[64];  // _MOST_THREADS
    bool started[64];
    for (int t = 1; t < threads; ++t) started[t] = start_thread(&ids[t], nullptr, work, &rows[t]) == 0;
    if (threads > 0) work(&rows[0]);
    for (int t = 1; t < threads; ++t) {
        if (started[t]) join_thread(ids[t], nullptr);
        else work(&rows[t]);
    }
    #undef SYMBOL
#endif
"""


def _cpu_snippet(real: str, gradient: bool) -> str:
    """All target rows, shared out to threads; clang vectorises each row's loop over its contiguous sources."""
    sums = _sums(gradient)
    stores = " ".join(f"out[{c}] = {name};" for c, name in enumerate(sums))
    return f"""
    typedef {real} REAL;
    struct Rows {{
        const REAL *src, *tgt;
        size_t ns, nt;
        const int *column, *begin, *end;
        REAL* out;
        int first, last;
    }};
    #define RSQRT(c) (REAL(1) / {"__builtin_sqrtf" if real == "float" else "__builtin_sqrt"}(c))
    // the sums may be split into lanes; reordering more would spread x_i − x_j over them and lose its digits
    #define REORDER_SUMS _Pragma("clang fp reassociate(on)")
    auto work = [](void* argument) -> void* {{
        const Rows& rows = *(const Rows*)argument;
        const size_t ns = rows.ns, nt = rows.nt;
        const REAL *src = rows.src, *tgt = rows.tgt;
        for (int row = rows.first; row < rows.last; ++row) {{
            const int column = rows.column[row], end = rows.end[row];
            const REAL tx = tgt[column], ty = tgt[nt + column], tz = tgt[2 * nt + column], tr = tgt[3 * nt + column];
            const REAL tl = tgt[7 * nt + column];
            REAL {", ".join(f"{name} = 0" for name in sums)};
            {{
            #pragma clang fp contract(fast)
            #pragma clang loop vectorize(enable)
            for (int j = rows.begin[row]; j < end; ++j) {{
                const REAL ax = src[j], ay = src[ns + j], az = src[2 * ns + j], ar = src[3 * ns + j];
                const REAL bx = src[4 * ns + j], by = src[5 * ns + j], bz = src[6 * ns + j];
                const REAL al = src[7 * ns + j];
                {_pair_code(gradient)}
            }}
            }}
            REAL* out = rows.out + (size_t)row * {len(sums)};
            {stores}
        }}
        return nullptr;
    }};
    const int threads = (int)shares.shape[0] - 1;
    Rows rows[{_MOST_THREADS}];
    for (int t = 0; t < threads; ++t)
        rows[t] = Rows{{(const REAL*)sources.data, (const REAL*)targets.data, (size_t)sources.shape[1],
                       (size_t)targets.shape[1], row_target.data, row_begin.data, row_end.data, (REAL*)partial_out.data,
                       shares.data[t], shares.data[t + 1]}};
    {_RUN_THREADS}
    #undef REORDER_SUMS
    #undef RSQRT
    """


# the library's rsqrtf spends as many slots on denormal distances as the pair law has left
_CUDA_RSQRT = {
    "float": """
    auto RSQRT = [](float c) { float y; asm("rsqrt.approx.ftz.f32 %0, %1;" : "=f"(y) : "f"(c)); return y; };""",
    "double": "auto RSQRT = [](double c) { return rsqrt(c); };",
}


def _cuda_snippet(real: str, gradient: bool, targets_per_thread: int) -> str:
    """One block: a tile of targets in registers, its sources staged through shared memory, double-buffered."""
    sums = _sums(gradient)
    ks = [str(k) for k in range(targets_per_thread)]
    loads = "\n".join(
        f"""
    const int row{k} = row_begin + lane + {k} * {_BLOCK};
    const int column{k} = row{k} < row_end ? row_target.data[row{k}] : -1;
    const REAL tx{k} = column{k} < 0 ? REAL(0) : tgt[column{k}], ty{k} = column{k} < 0 ? REAL(0) : tgt[nt + column{k}];
    const REAL tz{k} = column{k} < 0 ? REAL(0) : tgt[2 * nt + column{k}];
    const REAL tr{k} = column{k} < 0 ? REAL(0) : tgt[3 * nt + column{k}];
    const REAL tl{k} = column{k} < 0 ? REAL(0) : tgt[7 * nt + column{k}];
    REAL {", ".join(f"{name}{k} = 0" for name in sums)};"""
        for k in ks
    )
    pairs = "\n".join("        {" + _pair_code(gradient, k) + "}" for k in ks)
    assigns = {k: " ".join(f"out[{c}] = {name}{k};" for c, name in enumerate(sums)) for k in ks}
    stores = "\n".join(
        f"""
    if (column{k} >= 0) {{
        REAL* out = (REAL*)partial_out.data + ((size_t)split * rows + row{k}) * {len(sums)};
        {assigns[k]}
    }}"""
        for k in ks
    )
    return f"""
    typedef {real} REAL;
    {_CUDA_RSQRT[real]}
    #define REORDER_SUMS
    struct alignas(16) Quad {{ REAL x, y, z, w; }};
    __shared__ Quad shared_a[2][{_BLOCK}];
    __shared__ Quad shared_b[2][{_BLOCK}];
    const int lane = thread % {_BLOCK};
    const int* tile = tiles.data + 5 * (thread / {_BLOCK});
    const int row_begin = tile[0], row_end = tile[1], source_begin = tile[2], source_end = tile[3], split = tile[4];
    const size_t ns = sources.shape[1], nt = targets.shape[1], rows = partial_out.shape[1];
    const REAL* src = (const REAL*)sources.data;
    const REAL* tgt = (const REAL*)targets.data;
{loads}
    // padding beyond the last source: no moment, out of everybody's reach
    const Quad far_away = {{REAL(1e15), REAL(0), REAL(0), REAL(0)}}, nothing = {{REAL(0), REAL(0), REAL(0), REAL(-1)}};
    Quad a = far_away, b = nothing;
    #define STAGE(base) {{ const int j = (base) + lane; a = far_away; b = nothing; if (j < source_end) {{ \\
        a = Quad{{src[j], src[ns + j], src[2 * ns + j], src[3 * ns + j]}}; \\
        b = Quad{{src[4 * ns + j], src[5 * ns + j], src[6 * ns + j], src[7 * ns + j]}}; }} }}
    STAGE(source_begin)
    int buffer = 0;
    for (int base = source_begin; base < source_end; base += {_BLOCK}) {{
        shared_a[buffer][lane] = a;
        shared_b[buffer][lane] = b;
        __syncthreads();
        if (base + {_BLOCK} < source_end) STAGE(base + {_BLOCK})
        const int staged = min({_BLOCK}, source_end - base);
        #pragma unroll 8
        for (int k = 0; k < staged; ++k) {{
            const Quad sa = shared_a[buffer][k], sb = shared_b[buffer][k];
            const REAL ax = sa.x, ay = sa.y, az = sa.z, ar = sa.w, bx = sb.x, by = sb.y, bz = sb.z, al = sb.w;
{pairs}
        }}
        buffer ^= 1;
    }}
{stores}
    #undef STAGE
    #undef REORDER_SUMS
    """


@cache
def _cpu_kernel(dtype, gradient: bool):
    real = "float" if dtype is wp.float32 else "double"

    @wp.func_native(_cpu_snippet(real, gradient))
    def pair_rows(
        targets: wp.array2d[dtype],
        sources: wp.array2d[dtype],
        row_target: wp.array[int],
        row_begin: wp.array[int],
        row_end: wp.array[int],
        shares: wp.array[int],
        partial_out: wp.array3d[dtype],
    ): ...

    # Warp's flags, and registers as wide as there are: clang's default stops at half of AVX-512
    flags = f"{wp.config.cpu_compiler_flags or '-march=native'} -mprefer-vector-width=512"

    @wp.kernel(module="unique", enable_backward=False, module_options={"cpu_compiler_flags": flags})
    def pair_loop_cpu(
        # inputs:
        targets: wp.array2d[dtype],
        sources: wp.array2d[dtype],
        row_target: wp.array[int],
        row_begin: wp.array[int],
        row_end: wp.array[int],
        shares: wp.array[int],
        # outputs:
        partial_out: wp.array3d[dtype],
    ):
        pair_rows(targets, sources, row_target, row_begin, row_end, shares, partial_out)

    return pair_loop_cpu


@cache
def _cuda_kernel(dtype, gradient: bool, targets_per_thread: int):
    real = "float" if dtype is wp.float32 else "double"

    @wp.func_native(_cuda_snippet(real, gradient, targets_per_thread))
    def pair_tile(
        targets: wp.array2d[dtype],
        sources: wp.array2d[dtype],
        row_target: wp.array[int],
        tiles: wp.array2d[int],
        thread: int,
        partial_out: wp.array3d[dtype],
    ): ...

    @wp.kernel(module="unique", enable_backward=False)
    def pair_loop_cuda(
        # inputs:
        targets: wp.array2d[dtype],
        sources: wp.array2d[dtype],
        row_target: wp.array[int],
        tiles: wp.array2d[int],
        # outputs:
        partial_out: wp.array3d[dtype],
    ):
        pair_tile(targets, sources, row_target, tiles, wp.tid(), partial_out)

    return pair_loop_cuda


# ---------------------------------------------------------------------------------------------------------------------
# Launch
# ---------------------------------------------------------------------------------------------------------------------


def partial_shape(rows: Rows, gradient: bool) -> tuple[int, int, int]:
    """Shape of the ``partial`` array that :func:`launch_pair_loop` fills: splits, target rows, sums."""
    return rows.splits, max(rows.count, 1), len(_sums(gradient))


def launch_pair_loop(rows: Rows, targets, sources, partial, *, gradient=False, reference_exclude=None, epsilon2=0.0):
    """Sum the field, or the field and its gradient, of packed sources over the target rows.

    The native loops clamp the distance at contact and leave out pairs at zero distance, a target's own moment among
    them; with the gradient, also everything that bears the target's own label.

    Args:
        rows: Work list.
        targets: Packed targets, shape [8, targets].
        sources: Packed sources, shape [8, sources].
        partial: Sums, shape as :func:`partial_shape` says.
        gradient: Whether to sum the gradient too.
        reference_exclude: One of ``EXCLUDE_...`` to run the reference loop, which leaves those sources out and takes
            overlapping pairs exactly; None for the native loop.
        epsilon2: Smoothing ε² [m⁵], reference loop only.
    """
    if rows.count == 0:
        return
    device, dtype = partial.device, partial.dtype
    if reference_exclude is not None:
        wp.launch(
            _reference_kernel(dtype, gradient),
            dim=rows.count,
            inputs=[targets, sources, rows.target, rows.begin, rows.end, reference_exclude, dtype(epsilon2)],
            outputs=[partial],
            device=device,
        )
    elif device.is_cuda:
        wp.launch(
            _cuda_kernel(dtype, gradient, rows.targets_per_thread),
            dim=rows.tiles.shape[0] * _BLOCK,
            inputs=[targets, sources, rows.target, rows.tiles],
            outputs=[partial],
            device=device,
            block_dim=_BLOCK,
        )
    else:
        wp.launch(
            _cpu_kernel(dtype, gradient),
            dim=1,
            inputs=[targets, sources, rows.target, rows.begin, rows.end, rows.shares],
            outputs=[partial],
            device=device,
        )
