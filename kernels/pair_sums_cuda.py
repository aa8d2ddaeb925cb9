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
        targets: Targets of a block, up to 16.
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
        """Lanes of a warp that end with the sums of one target, and threads that share out its corrections."""
        return 32 >> (self.targets - 1).bit_length()

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


def _snippet(real: str, quantity: str, shape: Shape) -> str:
    """One thread of a block."""
    field = quantity == FIELD
    targets, warps, width, taken = shape.targets, shape.warps, WIDTHS[quantity], shape.sources
    padded = 32 // shape.shares  # targets, so many that halving ends with one
    ks, vs = [str(k) for k in range(targets)], range(taken)
    # what is read of a source, and in which packed row it is
    rows = {"ax": 0, "ay": 1, "az": 2, "radius": 3, "bx": 4, "by": 5, "bz": 6, **({} if field else {"label": 7})}

    def each(text: str) -> str:
        return "".join(text.replace("@", k) for k in ks)

    # what is read of a target, and where it is
    target = {"tx": "tgt[0 * nt", "ty": "tgt[1 * nt", "tz": "tgt[2 * nt", "tr": "tgt[3 * nt"}
    if not field:
        target |= {"tl": "tgt[7 * nt", "ex": "eff[0 * ne", "ey": "eff[1 * ne", "ez": "eff[2 * ne"}
    target_loaded = "".join(f"const REAL {name} = {place} + column];" for name, place in target.items())
    targets_shared = each(
        "".join(f"const REAL {name}@ = __shfl_sync(~0u, {name}, @);" for name in target)
        + f"REAL {', '.join(f'{name}@ = 0' for name in SUMS[quantity])};"
        + "const REAL clamp@ = (tr@ + one_radius) * (tr@ + one_radius);"
    )
    if field:
        bounds, apart, left_out, own_left_out = "", [], "false", "i == column"
    else:
        bounds = "REAL lowest = tl0, highest = tl0;" + "".join(
            f"lowest = min(lowest, tl{k}); highest = max(highest, tl{k});" for k in ks[1:]
        )
        apart = [f"(p_label.at[{v}] < lowest || p_label.at[{v}] > highest)" for v in vs]
        left_out, own_left_out = "label == tl@", "label == tl"
    apart += [f"p_radius.at[{v}] == one_radius" for v in vs]
    packs_loaded = "".join(f"p_{name} = *(const Pack*)(src + {row} * ns + j);" for name, row in rows.items())
    scaled = "const REAL ux = SCALE * bx, uy = SCALE * by, uz = SCALE * bz;"
    fast_pairs = each("{" + pair(quantity, "inverse_root(max(d2, clamp@))", "@") + "}")
    fast_sources = "".join(
        "{" + "".join(f"const REAL {name} = p_{name}.at[{v}];" for name in rows) + scaled + fast_pairs + "}" for v in vs
    )
    source = "".join(f"const REAL {name} = src[{row} * ns + i];" for name, row in rows.items() if name[0] != "b")
    moment = "".join(f"const REAL b{c} = there ? src[{row} * ns + i] : 0;" for row, c in enumerate("xyz", 4)) + scaled
    careful_pairs = each("{" + pair(quantity, f"careful(d2, tr@ + radius, {left_out})", "@") + "}")
    own_pair = pair(quantity, f"careful(d2, tr + radius, {own_left_out})")
    own_sums = "".join(f"r[{c}] += {text};" for c, text in enumerate(results(quantity, _W)))
    sums = "".join(
        f"r[{int(k) * width + c}] = {text};" for k in ks for c, text in enumerate(results(quantity, _W, k))
    ) + "".join(f"r[{c}] = 0;" for c in range(targets * width, padded * width))
    halvings = "".join(f"halve({padded * width >> level}, {32 >> level});" for level in range(1, padded.bit_length()))
    return f"""
    typedef {real} REAL;
    typedef REAL NUMBER;
    constexpr REAL SCALE = {scaled_moment(quantity, _W)!r};
    {_INVERSE_ROOT[real]}
    auto careful = [&](REAL d2, REAL s, bool left_out) {{
        const REAL c = max(d2, s * s);
        return c > 0 && !left_out ? inverse_root(c) : REAL(0);
    }};
    struct alignas({taken} * sizeof(REAL)) Pack {{ REAL at[{taken}]; }};
    __shared__ REAL sums[{warps + 1}][{padded}][{width}];
    const int lane = thread % 32, warp = thread / 32;
    const int* t = tiles.data + {TILE_COLUMNS} * tile;
    const int count = t[1] - t[0], column_begin = t[2], source_begin = t[3], source_end = t[4];
    const size_t ns = sources.strides[0] / sizeof(REAL), nt = targets.strides[0] / sizeof(REAL);
    const size_t ne = effective.strides[0] / sizeof(REAL);
    const REAL *src = (const REAL*)sources.data, *tgt = (const REAL*)targets.data, *eff = (const REAL*)effective.data;
    // the targets themselves, with what else is taken with them, are left to the correcting warp
    const int first = source_begin / {taken} * {taken};
    const int own_begin = src == tgt ? min(max(column_begin / {taken} * {taken}, first), source_end) : source_end;
    const int own_end = min(max((column_begin + count + {taken - 1}) / {taken} * {taken}, own_begin), source_end);
    const int skipped = (own_end - own_begin + {taken - 1}) / {taken} * {taken};
    // a lane reads one target; those beyond the last are the last again
    const int own = warp < {warps} ? lane : lane / {shape.shares}, column = column_begin + min(own, count - 1);
    {target_loaded}
    REAL r[{padded * width}];  // of all targets, target by target; then of fewer and fewer
    if (warp < {warps} && source_begin < source_end) {{
        const REAL one_radius = src[3 * ns + source_begin];
        // the last moment is followed by moments of nothing
        const int readable_end = source_end < sources.shape[1] ? source_end : (int)ns;
        int walk = first + {taken} * thread, j;
        bool loaded;
        Pack {", ".join("p_" + name for name in rows)};
        auto load = [&]() {{
            j = walk < own_begin ? walk : walk + skipped;
            loaded = j >= source_begin && j + {taken} <= readable_end;
            if (loaded) {{
                {packs_loaded}
            }}
        }};
        load();  // before the targets are wanted, so that both are waited for at once
        {targets_shared}
        {bounds}
        #pragma unroll 1
        for (; walk - {taken} * lane < source_end - skipped; walk += {32 * taken * warps}, load()) {{
            const bool fast = loaded && one_radius > 0 && {" && ".join(apart)};
            if (__all_sync(~0u, fast)) {{
                {fast_sources}
            }} else {{
                #pragma unroll 1
                for (int v = 0; v < {taken}; ++v) {{
                    // beyond the ends stand the first or the last source again, without a moment
                    const int i = min(max(j + v, source_begin), source_end - 1);
                    const bool there = i == j + v;
                    {source}
                    {moment}
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
        if (warp == {warps} && own < count) {{
            REAL {", ".join(f"{name} = 0" for name in SUMS[quantity])};
            for (int i = max(own_begin, source_begin) + lane % {shape.shares}; i < own_end; i += {shape.shares}) {{
                const bool there = true;
                {source}
                {moment}
                {own_pair}
            }}
            {own_sums}
        }}
    }}
    #pragma unroll
    for (int step = {shape.shares // 2}; step > 0; step /= 2)
        #pragma unroll
        for (int c = 0; c < {width}; ++c) r[c] += __shfl_xor_sync(~0u, r[c], step);
    if (lane % {shape.shares} == 0)
        for (int c = 0; c < {width}; ++c) sums[warp][lane / {shape.shares}][c] = r[c];
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


@wp.func
def own_target(tile: int, thread: int, tiles: wp.array2d[int]):
    """Packed column of the target whose sum a thread gets; -1 for none."""
    if thread < tiles[tile, 1] - tiles[tile, 0]:
        return tiles[tile, 2] + thread
    return -1


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
