"""Sums over pairs on a GPU, made by the very kernel that needs them: no second launch waits for the first.

The warps of a block share out the sources of a few targets: each lane takes some of them at a time and meets all the
block's targets with them. What the lanes have summed is added up by shuffles, each of which halves the values that a
lane keeps, and what the warps have summed in shared memory, in an order that depends on nothing. One more warp of the
block brings what the loop leaves out, the correction of overlapping pairs, while the others sum. Thread k of a block
ends with the whole sum of target k, for the kernel to go on with.

Where all sources that a warp takes have one radius, and none of them is left out for one of the targets, the clamp is
a constant of the target and nothing is masked: 20 instructions a pair for the field and 31 for the force, next to the
ten or so that a source takes once for all targets.
"""

from dataclasses import dataclass
from functools import cache

import warp as wp

from warpmag.kernels.pair_code import FIELD, FORCE, SUMS, TILE_COLUMNS, WIDTHS, WRENCH, pair, results, scaled_moment


@dataclass(frozen=True)
class Shape:
    """Shape of the blocks that walk a work list.

    Attributes:
        targets: Targets of a block; a power of two up to 16.
        warps: Warps of a block that share out the sources.
        sources: Sources that a lane takes at a time; 1, 2 or 4.
        blocks: Blocks that a multiprocessor holds at once, in float32.
    """

    targets: int
    warps: int
    sources: int
    blocks: int

    @property
    def threads(self) -> int:
        """Threads of a block, those of the correcting warp included."""
        return 32 * (self.warps + 1)

    @property
    def shares(self) -> int:
        """Threads of the correcting warp that share out a target's corrections."""
        return 32 // self.targets

    def launch_bounds(self, dtype) -> tuple[int, int]:
        """Bounds of a kernel: threads of a block, and blocks that a multiprocessor holds at once."""
        return self.threads, self.blocks if dtype is wp.float32 else 1


# Measured on an H200: the shape, and the most targets that it is best for.
_SHAPES = {
    FIELD: ((512, Shape(1, 2, 2, 8)), (None, Shape(4, 4, 2, 5))),
    FORCE: ((512, Shape(1, 2, 2, 8)), (None, Shape(4, 4, 2, 4))),
    WRENCH: ((512, Shape(1, 2, 2, 8)), (None, Shape(4, 4, 2, 3))),
}


def choose_shape(quantity: str, count: int) -> Shape:
    """Shape for a number of targets."""
    return next(shape for most, shape in _SHAPES[quantity] if most is None or count <= most)


# the library's rsqrtf spends as many slots on denormal distances as the pair law has left
_INVERSE_ROOT = {
    "float": """
    auto inverse_root = [](float c) { float y; asm("rsqrt.approx.ftz.f32 %0, %1;" : "=f"(y) : "f"(c)); return y; };""",
    "double": "auto inverse_root = [](double c) { return rsqrt(c); };",
}

_W = 1.0  # see pair_code


PREFETCH = False


def _snippet(real: str, quantity: str, shape: Shape) -> str:
    """One thread of a block."""
    field = quantity == FIELD
    targets, warps, width = shape.targets, shape.warps, WIDTHS[quantity]
    ks = [str(k) for k in range(targets)]
    rows = range(7 if field else 8)  # of the packed sources that are read

    def each(text: str) -> str:
        return "".join(text.replace("@", k) for k in ks)

    effective = "" if field else "".join(f"const REAL e{c}@ = eff[{r} * ne + column@];" for r, c in enumerate("xyz"))
    loads = each(
        f"""
        // targets beyond the last are the last again
        const int column@ = column_begin + min(@, count - 1);
        const REAL tx@ = tgt[column@], ty@ = tgt[nt + column@], tz@ = tgt[2 * nt + column@];
        const REAL tr@ = tgt[3 * nt + column@], clamp@ = (tr@ + one_radius) * (tr@ + one_radius);
        {"" if field else "const REAL tl@ = tgt[7 * nt + column@];"}
        {effective}
        REAL {", ".join(f"{name}@ = 0" for name in SUMS[quantity])};"""
    )
    if field:
        bounds = "const int own_begin = same ? column_begin : source_end, own_end = own_begin + count;"
        apart = f"(j >= own_end || j + {shape.sources} <= own_begin)"
        left_out = "j + v == own_begin + @"
    else:
        bounds = "REAL lowest = tl0, highest = tl0;" + "".join(
            f"lowest = min(lowest, tl{k}); highest = max(highest, tl{k});" for k in ks[1:]
        )
        apart = " && ".join(f"(s[7].at[{v}] < lowest || s[7].at[{v}] > highest)" for v in range(shape.sources))
        left_out = "s[7].at[v] == tl@"
    whole_loads = "".join(f"s[{row}] = *(const Pack*)(src + {row} * ns + j);" for row in rows)
    single_loads = "".join(
        f"s[{row}].at[v] = {'j + v != there ? REAL(0) : ' if row in (4, 5, 6) else ''}src[{row} * ns + there];"
        for row in rows
    )
    one_radius = " && ".join(f"s[3].at[{v}] == one_radius" for v in range(shape.sources))
    source = """
                    const REAL ax = s[0].at[v], ay = s[1].at[v], az = s[2].at[v];
                    const REAL bx = s[4].at[v], by = s[5].at[v], bz = s[6].at[v];
                    const REAL ux = SCALE * bx, uy = SCALE * by, uz = SCALE * bz;
    """
    fast_pairs = each("{" + pair(quantity, "inverse_root(max(d2, clamp@))", "@") + "}")
    careful_pairs = each("{" + pair(quantity, f"careful(d2, tr@ + s[3].at[v], {left_out})", "@") + "}")
    prefetch = "".join(f"s[{row}] = next[{row}];" for row in rows) + (
        f"if (j - {shape.sources} * lane + {32 * shape.sources * warps} < source_end)"
        f"load(j + {32 * shape.sources * warps}, next);"
    )
    sums = "".join(f"r[{int(k) * width + c}] = {text};" for k in ks for c, text in enumerate(results(quantity, _W, k)))
    halvings = "".join(f"halve({targets * width >> level}, {32 >> level});" for level in range(1, targets.bit_length()))
    return f"""
    typedef {real} REAL;
    typedef REAL NUMBER;
    constexpr REAL SCALE = {scaled_moment(quantity, _W)!r};
    {_INVERSE_ROOT[real]}
    auto careful = [&](REAL d2, REAL s, bool left_out) {{
        const REAL c = max(d2, s * s);
        return c > 0 && !left_out ? inverse_root(c) : REAL(0);
    }};
    struct alignas({shape.sources} * sizeof(REAL)) Pack {{ REAL at[{shape.sources}]; }};
    __shared__ REAL sums[{warps + 1}][{targets}][{width}];
    const int lane = thread % 32, warp = thread / 32;
    const int* p = tiles.data + {TILE_COLUMNS} * tile;
    const int count = p[1] - p[0], column_begin = p[2], source_begin = p[3], source_end = p[4];
    REAL r[{targets * width}];  // of all targets, target by target; then of fewer and fewer
    if (warp < {warps} && source_begin < source_end) {{
        const size_t ns = sources.strides[0] / sizeof(REAL), nt = targets.strides[0] / sizeof(REAL);
        const size_t ne = effective.strides[0] / sizeof(REAL);
        const REAL *src = (const REAL*)sources.data, *tgt = (const REAL*)targets.data;
        const REAL* eff = (const REAL*)effective.data;
        const bool same = src == tgt;
        const REAL one_radius = src[3 * ns + source_begin];
        {loads}
        {bounds}
        const int first = source_begin / {shape.sources} * {shape.sources};
        auto load = [&](int j, Pack (&s)[8]) {{
            if (j >= source_begin && j + {shape.sources} <= source_end) {{
                {whole_loads}
            }} else {{  // beyond the ends stand the first or the last source again, without a moment
                #pragma unroll
                for (int v = 0; v < {shape.sources}; ++v) {{
                    const int there = min(max(j + v, source_begin), source_end - 1);
                    {single_loads}
                }}
            }}
        }};
        int j = first + {shape.sources} * thread;
        {f"Pack next[8]; if (j - {shape.sources} * lane < source_end) load(j, next);" if PREFETCH else ""}
        #pragma unroll 1
        for (; j - {shape.sources} * lane < source_end; j += {32 * shape.sources * warps}) {{
            Pack s[8];
            {prefetch if PREFETCH else "load(j, s);"}
            if (__all_sync(~0u, one_radius > 0 && {one_radius} && {apart})) {{
                #pragma unroll
                for (int v = 0; v < {shape.sources}; ++v) {{
                    {source}
                    {fast_pairs}
                }}
            }} else {{
                #pragma unroll
                for (int v = 0; v < {shape.sources}; ++v) {{
                    {source}
                    {careful_pairs}
                }}
            }}
        }}
        {sums}
        auto halve = [&](int half, int step) {{
            const bool upper = lane & step;
            for (int i = 0; i < half; ++i) {{
                const REAL sent = upper ? r[i] : r[i + half], kept = upper ? r[i + half] : r[i];
                r[i] = kept + __shfl_xor_sync(~0u, sent, step);
            }}
        }};
        {halvings}
    }} else {{
        for (int c = 0; c < {width}; ++c) r[c] = warp < {warps} ? REAL(0) : correction[c];
    }}
    #pragma unroll
    for (int step = {16 // targets}; step > 0; step /= 2)
        #pragma unroll
        for (int c = 0; c < {width}; ++c) r[c] += __shfl_xor_sync(~0u, r[c], step);
    if (lane % {32 // targets} == 0)
        for (int c = 0; c < {width}; ++c) sums[warp][lane / {32 // targets}][c] = r[c];
    __syncthreads();
    wp::vec_t<{width}, REAL> total;
    if (thread < {targets}) {{
        for (int w = 0; w < {warps + 1}; ++w)
            for (int c = 0; c < {width}; ++c) total[c] += sums[w][thread][c];
    }}
    return total;
    """


@cache
def pair_summation(dtype, quantity: str, shape: Shape):
    """Warp function by which a block sums a quantity, see ``pair_loops``, over a tile's pairs.

    All threads of the block call it. Those that have a :func:`target_share` bring something to add to the sum of that
    target. Thread k gets the sum of target k.
    """
    vector = wp.types.vector(WIDTHS[quantity], dtype)

    @wp.func_native(_snippet("float" if dtype is wp.float32 else "double", quantity, shape))
    def sum_pairs(
        tile: int,
        thread: int,
        tiles: wp.array2d[int],
        targets: wp.array2d[dtype],
        sources: wp.array2d[dtype],
        effective: wp.array2d[dtype],
        correction: vector,
    ) -> vector: ...

    return sum_pairs


@cache
def target_share(shape: Shape):
    """Warp function that says what a thread has to correct: packed column of its target, or -1, and its share of it."""

    @wp.func
    def share_of(tile: int, thread: int, tiles: wp.array2d[int]):
        lane = thread - wp.static(32 * shape.warps)
        k = lane // wp.static(shape.shares)
        i = -1
        if lane >= 0 and k < tiles[tile, 1] - tiles[tile, 0]:
            i = tiles[tile, 2] + k
        return i, lane % wp.static(shape.shares)

    return share_of
