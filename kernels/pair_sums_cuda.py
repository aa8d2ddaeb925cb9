"""Sums over pairs on a GPU, made by the very kernel that needs them: no second launch waits for the first.

Some warps share out the sources of a few targets: each lane takes some of them at a time, and meets all the targets
with them. What the lanes have summed is added up by shuffles, each of which halves the values that a lane keeps, and
what the warps have summed in shared memory, in an order that depends on nothing. Other threads of the block meanwhile
bring what these leave out: the targets among themselves, and the correction of overlapping pairs. Thread k of a block
ends with the whole sum of target k, for the kernel to go on with.

Where all sources that a warp takes have one radius, and none of them is left out for one of the targets, the clamp is
a constant of the target and nothing is masked: 20 instructions a pair for the field and 31 for the force, next to the
ten or so that a source takes once for all targets.
"""

import math
from dataclasses import dataclass
from functools import cache

import warp as wp

from warpmag.kernels.pair_code import (
    FIELD,
    FORCE,
    SUMS,
    TILE_COLUMNS,
    WIDTHS,
    WRENCH,
    cuda_head,
    pair,
    results,
    scaled_moment,
)


@dataclass(frozen=True)
class Shape:
    """Shape of the blocks that walk a work list.

    Attributes:
        targets: Targets of a block.
        groups: Groups of them that each have warps of their own, which hold up to 16 targets.
        warps: Warps of a group that share out the sources.
        sources: Sources that a lane takes at a time; 1, 2 or 4.
        blocks: Blocks that a multiprocessor holds at once, in float32.
    """

    targets: int
    groups: int
    warps: int
    sources: int
    blocks: int

    @property
    def summing(self) -> int:
        """Threads of a block that sum."""
        return 32 * self.groups * self.warps

    @property
    def correcting(self) -> int:
        """Threads of a block that correct, after those that sum."""
        return 32 * math.ceil(self.targets / 16)

    @property
    def threads(self) -> int:
        """Threads of a block."""
        return self.summing + self.correcting

    @property
    def shares(self) -> int:
        """Threads that share out the corrections of a target, a power of two."""
        return min(32, 1 << (self.correcting // self.targets).bit_length() - 1)

    def launch_bounds(self, dtype) -> tuple[int, int]:
        """Bounds of a kernel: threads of a block, and blocks that a multiprocessor holds at once."""
        return self.threads, self.blocks if dtype is wp.float32 else 1


# Measured on an H200: the shape, and the most targets that it is best for.
SHAPES = {
    FIELD: ((350, Shape(2, 1, 4, 2, 6)), (1500, Shape(4, 1, 8, 2, 2)), (None, Shape(5, 1, 3, 4, 4))),
    FORCE: ((700, Shape(2, 1, 4, 2, 4)), (1500, Shape(4, 1, 4, 2, 2)), (None, Shape(20, 5, 2, 4, 1))),
    WRENCH: ((700, Shape(2, 1, 4, 2, 4)), (1500, Shape(4, 1, 4, 2, 2)), (None, Shape(4, 1, 3, 2, 4))),
}


def choose_shape(quantity: str, count: int) -> Shape:
    """Shape for a number of targets."""
    return next(shape for most, shape in SHAPES[quantity] if most is None or count <= most)


_W = 1.0  # see pair_code


def _snippet(real: str, quantity: str, shape: Shape) -> str:
    """One thread of a block."""
    field = quantity == FIELD
    groups, warps, width, taken = shape.groups, shape.warps, WIDTHS[quantity], shape.sources
    held = shape.targets // groups
    padded = 1 << (held - 1).bit_length()  # targets, so many that halving ends with one
    ks, vs = [str(k) for k in range(held)], range(taken)
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
    ) + "".join(f"r[{c}] = 0;" for c in range(held * width, padded * width))
    halvings = "".join(f"halve({padded * width >> level}, {32 >> level});" for level in range(1, padded.bit_length()))
    return f"""
    {cuda_head(real)}
    constexpr REAL SCALE = {scaled_moment(quantity, _W)!r};
    struct alignas({taken} * sizeof(REAL)) Pack {{ REAL at[{taken}]; }};
    __shared__ REAL sums[{groups * warps}][{padded}][{width}], corrections[{shape.targets}][{width}];
    const int lane = thread % 32, warp = thread / 32;
    const bool summing = thread < {shape.summing};
    const int* t = tiles.data + {TILE_COLUMNS} * tile;
    const int count = t[1] - t[0], column_begin = t[2], source_begin = t[3], source_end = t[4];
    const size_t ns = sources.strides[0] / sizeof(REAL), nt = targets.strides[0] / sizeof(REAL);
    const size_t ne = effective.strides[0] / sizeof(REAL);
    const REAL *src = (const REAL*)sources.data, *tgt = (const REAL*)targets.data, *eff = (const REAL*)effective.data;
    // a lane reads one target; those beyond the last are the last again
    const int group = warp / {warps};
    const int own = summing ? group * {held} + min(lane, {held - 1}) : (thread - {shape.summing}) / {shape.shares};
    const int column = column_begin + min(own, count - 1);
    {target_loaded}
    // the targets of a group, with what else is taken with them, are left to the correcting threads
    const int first = source_begin / {taken} * {taken}, group_begin = column_begin + own / {held} * {held};
    const int group_end = min(group_begin + {held}, column_begin + count);
    const int own_begin = src == tgt ? min(max(group_begin / {taken} * {taken}, first), source_end) : source_end;
    const int own_end = min(max((group_end + {taken - 1}) / {taken} * {taken}, own_begin), source_end);
    const int skipped = (own_end - own_begin + {taken - 1}) / {taken} * {taken};
    REAL r[{padded * width}];  // of all targets, target by target; then of fewer and fewer
    #pragma unroll
    for (int c = 0; c < {width}; ++c) r[c] = summing ? REAL(0) : correction[c];
    if (summing && group_begin < group_end && source_begin < source_end) {{
        const REAL one_radius = src[3 * ns + source_begin];
        // the last moment is followed by moments of nothing
        const int readable_end = source_end < sources.shape[1] ? source_end : (int)ns;
        int walk = first + {taken} * (thread % {32 * warps}), j;
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
    }} else if (!summing && own < count) {{
        REAL {", ".join(f"{name} = 0" for name in SUMS[quantity])};
        for (int i = max(own_begin, source_begin) + thread % {shape.shares}; i < own_end; i += {shape.shares}) {{
            const bool there = true;
            {source}
            {moment}
            {own_pair}
        }}
        {own_sums}
    }}
    auto add_lanes = [&](int lanes) {{
        #pragma unroll
        for (int step = lanes / 2; step > 0; step /= 2)
            #pragma unroll
            for (int c = 0; c < {width}; ++c) r[c] += __shfl_xor_sync(~0u, r[c], step);
    }};
    if (summing) {{
        add_lanes({32 // padded});
        if (lane % {32 // padded} == 0)
            for (int c = 0; c < {width}; ++c) sums[warp][lane / {32 // padded}][c] = r[c];
    }} else {{
        add_lanes({shape.shares});
        if (thread % {shape.shares} == 0 && own < count)
            for (int c = 0; c < {width}; ++c) corrections[own][c] = r[c];
    }}
    __syncthreads();
    wp::vec_t<{width}, REAL> total;
    if (thread < count) {{
        for (int c = 0; c < {width}; ++c) {{
            total[c] = corrections[thread][c];
            for (int w = 0; w < {warps}; ++w) total[c] += sums[thread / {held} * {warps} + w][thread % {held}][c];
        }}
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
        k = (thread - wp.static(shape.summing)) // wp.static(shape.shares)
        i = -1
        if thread >= wp.static(shape.summing) and k < tiles[tile, 1] - tiles[tile, 0]:
            i = tiles[tile, 2] + k
        return i, thread % wp.static(shape.shares)

    return share_of
