"""Sums over pairs on a GPU, made by the very kernel that needs them: no second launch waits for the first.

A block has a tile of a few targets. Each of its warps holds all of them, some in every lane, and as often as there are
lanes for it; the warps share out the sources, stage them through shared memory, 32 at a time, and groups of lanes share
out what is staged. What the groups have summed is added up by shuffles, most of which halve the values that a lane
keeps, and what the warps have summed in shared memory, in an order that depends on nothing. Other threads of the block
meanwhile bring the correction of overlapping pairs. Thread k of a block ends with the whole sum of target k, for the
kernel to go on with.

Where the sources that a group meets in one go have one radius, and none of them is left out for one of the targets,
the clamp is a constant of the target and nothing is masked: 20 instructions a pair for the field and 31 for the force,
next to the four or so that a source takes once for all targets of a lane, and the sixty that a warp takes to stage 32.
"""

import math
from dataclasses import dataclass
from functools import cache

import warp as wp

from warpmag.kernels.pairs.pair_terms import (
    SUMS,
    TILE_COLUMNS,
    WIDTHS,
    Quantity,
    cuda_head,
    pair,
    results,
    scaled_moment,
)


@dataclass(frozen=True)
class Shape:
    """Shape of the blocks that walk a work list.

    Attributes:
        held: Targets that a lane holds.
        lanes: Lanes of a warp that hold other targets than each other.
        warps: Warps of a block that share out the sources.
        unrolled: Sources that a lane meets in one go.
    """

    held: int
    lanes: int
    warps: int
    unrolled: int

    @property
    def targets(self) -> int:
        """Targets of a block."""
        return self.held * self.lanes

    @property
    def summing(self) -> int:
        """Threads of a block that sum."""
        return 32 * self.warps

    @property
    def correcting(self) -> int:
        """Threads of a block that correct, after those that sum."""
        return 32 * max(min(4, math.ceil(self.targets / 8)), math.ceil(self.targets / 32))

    @property
    def threads(self) -> int:
        """Threads of a block."""
        return self.summing + self.correcting

    @property
    def shares(self) -> int:
        """Threads that share out the corrections of a target, a power of two."""
        return min(32, 1 << (self.correcting // self.targets).bit_length() - 1)


# Measured on an H200, of 132 multiprocessors: the shape, and the most targets that it is best for. Those are what the
# multiprocessors hold at a block each. Blocks in clusters, which share out the sources of a larger tile and add up
# through each other's shared memory, gained nothing: of two blocks, 10.4 µs where one takes 10.0 for a field at 2,560;
# of four or eight, only 124 or 120 multiprocessors find partners.
SHAPES = {
    Quantity.FIELD: (
        (528, Shape(2, 2, 8, 1)),
        (1056, Shape(4, 2, 8, 2)),
        (1584, Shape(3, 4, 16, 4)),
        (2112, Shape(4, 4, 16, 4)),
        (2640, Shape(5, 4, 16, 4)),
        (3696, Shape(7, 4, 12, 4)),
        (5280, Shape(5, 8, 12, 4)),
        (None, Shape(7, 8, 12, 4)),
    ),
    Quantity.FORCE: (
        (528, Shape(2, 2, 8, 1)),
        (1056, Shape(2, 4, 16, 2)),
        (2112, Shape(4, 4, 8, 4)),
        (None, Shape(5, 4, 8, 4)),
    ),
    Quantity.WRENCH: (
        (528, Shape(2, 2, 8, 1)),
        (1056, Shape(4, 2, 8, 2)),
        (2112, Shape(4, 4, 8, 2)),
        (None, Shape(5, 4, 8, 4)),
    ),
}


def choose_shape(quantity: Quantity, count: int) -> Shape:
    """Shape for a number of targets."""
    return next(shape for most, shape in SHAPES[quantity] if most is None or count <= most)


_W = 1.0  # see pair_code

_SOURCE = """
                        const Quad qa = staged_a[k], qb = staged_b[k];
                        const REAL ax = qa.x, ay = qa.y, az = qa.z, bx = qa.w, by = qb.x, bz = qb.y;
                        const REAL ux = qb.z, uy = qb.w, uz = SCALE * bz;
"""


def _folds(values: int, lanes: int) -> tuple[int, str, str]:
    """Text that adds up the ``values`` of the lanes that are ``lanes`` apart, in as few shuffles as may be.

    Returns:
        The number of values to begin with, the last of them nothing; the text; and text that stores what a lane ends
        with at its place.
    """
    steps = [step for step in (16, 8, 4, 2, 1) if step >= lanes]
    halvings = min(len(steps), (values - 1).bit_length())
    padded = -(-values >> halvings) << halvings
    left, text, first = padded, "", ["0"]
    for step in steps[:halvings]:
        left //= 2
        text += f"halve({left}, {step});"
        first.append(f"(lane & {step} ? {left} : 0)")
    for step in steps[halvings:]:
        text += f"for (int i = 0; i < {left}; ++i) r[i] += __shfl_xor_sync(~0u, r[i], {step});"
    idle = sum(steps[halvings:])
    stores = "".join(f"warp_sums[at + {i}] = r[{i}];" for i in range(left))
    place = f"const int at = own * {padded} + {' + '.join(first)};"
    return padded, text, f"if ((lane & {idle}) == 0) {{ {place} {stores} }}"


def _snippet(real: str, quantity: Quantity, shape: Shape) -> str:
    """One thread of a block."""
    field, width = quantity == Quantity.FIELD, WIDTHS[quantity]
    held, lanes, warps, ks = shape.held, shape.lanes, shape.warps, [str(k) for k in range(shape.held)]
    groups = 32 // lanes
    stride = groups * shape.unrolled
    padded, folds, stores = _folds(held * width, lanes)

    def each(text: str) -> str:
        return "".join(text.replace("@", k) for k in ks)

    if field:
        apart = "(unsigned)(j - own_begin) >= own_count"
        left_out, bounds = f"same && base + k == column_begin + own + {lanes} * @", ""
    else:
        apart, left_out = "(label < lowest || label > highest)", "qc.y == tl@"
        bounds = (
            "REAL lowest = tl0, highest = tl0;"
            + "".join(f"lowest = min(lowest, tl{k}); highest = max(highest, tl{k});" for k in ks[1:])
            + f"""
        for (int step = {lanes // 2}; step > 0; step /= 2) {{
            lowest = min(lowest, __shfl_xor_sync(~0u, lowest, step));
            highest = max(highest, __shfl_xor_sync(~0u, highest, step));
        }}"""
        )
    # what a lane reads beyond the last target is there, and not wanted; but what a table of another pitch holds, or
    # what decides whether a source is left out, is that of the last again
    loads = "".join(
        f"{{ const REAL* row = tgt + {row} * nt + column_begin + own;" + each(f"{name}@ = row[{lanes} * @];") + "}"
        for row, name in enumerate(("tx", "ty", "tz", "tr"))
    )
    if not field:
        loads += each(
            f"{{ const int column = column_begin + min(own + {lanes} * @, count - 1); tl@ = tgt[7 * nt + column];"
            + "".join(f"e{c}@ = eff[{row} * ne + column];" for row, c in enumerate("xyz"))
            + "}"
        )
    target = ["tx", "ty", "tz", "tr", *([] if field else ["tl", "ex", "ey", "ez"])]
    read = ", ".join(f"{name}{k}" for k in ks for name in target)
    cleared = ", ".join(f"{name}{k} = 0" for k in ks for name in SUMS[quantity])
    fast_pairs = each("{" + pair(quantity, "inverse_root(max(d2, clamp@))", "@") + "}")
    careful_pairs = each("{" + pair(quantity, f"careful(d2, tr@ + qc.x, {left_out})", "@") + "}")
    sums = "".join(
        f"r[{int(k) * width + c}] = {text};" for k in ks for c, text in enumerate(results(quantity, _W, k))
    ) + "".join(f"r[{c}] = 0;" for c in range(held * width, padded))
    return f"""
    {cuda_head(real)}
    constexpr REAL SCALE = {scaled_moment(quantity, _W)!r};
    struct alignas(16) Quad {{ REAL x, y, z, w; }};
    struct alignas(8) Pair {{ REAL x, y; }};
    __shared__ Quad staging[{warps}][{max(80, lanes * padded // 4)}];  // of each warp: its sources, and then its sums
    __shared__ REAL corrections[{shape.targets}][{width}];
    const int lane = thread % 32, warp = thread / 32;
    const int* t = tiles.data + {TILE_COLUMNS} * tile;
    const int count = t[1] - t[0], column_begin = t[2], range_begin = t[3], range = t[4] - range_begin;
    const size_t ns = sources.strides[0] / sizeof(REAL), nt = targets.strides[0] / sizeof(REAL);
    const size_t ne = effective.strides[0] / sizeof(REAL);
    const REAL *src = (const REAL*)sources.data, *tgt = (const REAL*)targets.data, *eff = (const REAL*)effective.data;
    if (thread < {shape.summing}) {{
        const bool same = src == tgt;
        const int own_begin = same ? column_begin : 0;
        const unsigned own_count = same ? count : 0;
        const int own = lane % {lanes}, group = lane / {lanes};
        const int source_begin = range_begin + range * warp / {warps};
        const int source_end = range_begin + range * (warp + 1) / {warps};
        Quad *staged_a = staging[warp], *staged_b = staged_a + 32;
        Pair* staged_c = (Pair*)(staged_a + 64);
        REAL x, y, z, radius, bx, by, bz, label = 0;
        // the moments of nothing that follow the last one are there to be read
        auto load = [&](int base) {{
            const REAL* s = src + base + lane;
            const bool there = base + lane < source_end;
            x = s[0], y = s[ns], z = s[2 * ns], radius = s[3 * ns];
            bx = there ? s[4 * ns] : 0, by = there ? s[5 * ns] : 0, bz = there ? s[6 * ns] : 0;
            {"" if field else "label = s[7 * ns];"}
        }};
        const REAL one_radius = src[3 * ns + range_begin];
        if (source_begin < source_end) load(source_begin);
        REAL {read}, {cleared};
        {loads}
        {bounds}
        {each("const REAL clamp@ = (tr@ + one_radius) * (tr@ + one_radius);")}
        #pragma unroll 1
        for (int base = source_begin; base < source_end; base += 32) {{
            const int j = base + lane, staged = min(32, source_end - base);
            const bool plain = radius == one_radius && radius > 0 && {apart};
            const unsigned odd = __ballot_sync(~0u, !plain);
            staged_a[lane] = Quad{{x, y, z, bx}};
            staged_b[lane] = Quad{{by, bz, SCALE * bx, SCALE * by}};
            staged_c[lane] = Pair{{radius, label}};
            __syncwarp();
            if (base + 32 < source_end) load(base + 32);
            #pragma unroll 1
            for (int first = 0; first < staged; first += {stride}) {{
                if ((odd >> first & {(1 << stride) - 1}u) == 0) {{
                    #pragma unroll
                    for (int step = 0; step < {shape.unrolled}; ++step) {{
                        const int k = first + {groups} * step + group;
                        {_SOURCE}
                        {fast_pairs}
                    }}
                }} else {{
                    #pragma unroll 1
                    for (int k = first + group; k < first + {stride}; k += {groups}) {{
                        const Pair qc = staged_c[k];
                        {_SOURCE}
                        {careful_pairs}
                    }}
                }}
            }}
            __syncwarp();
        }}
        REAL r[{padded}];
        {sums}
        auto halve = [&](int half, int step) {{
            const bool upper = lane & step;
            #pragma unroll
            for (int i = 0; i < half; ++i) {{
                const REAL sent = upper ? r[i] : r[i + half], kept = upper ? r[i + half] : r[i];
                r[i] = kept + __shfl_xor_sync(~0u, sent, step);
            }}
        }};
        {folds}
        REAL* warp_sums = (REAL*)staging[warp];
        {stores}
    }} else {{
        const int k = (thread - {shape.summing}) / {shape.shares};
        #pragma unroll
        for (int c = 0; c < {width}; ++c) {{
            REAL total = correction[c];
            #pragma unroll
            for (int step = {shape.shares // 2}; step > 0; step /= 2) total += __shfl_xor_sync(~0u, total, step);
            if (thread % {shape.shares} == 0 && k < {shape.targets}) corrections[k][c] = total;
        }}
    }}
    __syncthreads();
    wp::vec_t<{width}, REAL> total;
    if (thread < count) {{
        const int at = thread % {lanes} * {padded} + thread / {lanes} * {width};
        #pragma unroll
        for (int c = 0; c < {width}; ++c) {{
            total[c] = corrections[thread][c];
            #pragma unroll
            for (int w = 0; w < {warps}; ++w) total[c] += ((const REAL*)staging[w])[at + c];
        }}
    }}
    return total;
    """


@cache
def pair_summation(dtype, quantity: Quantity, shape: Shape):
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


# what Warp makes of its index takes a division, and all else waits for it
@wp.func_native("return blockIdx.x;")
def this_block() -> int:
    """Block of this thread, and so its tile."""
    ...


@wp.func_native("return threadIdx.x;")
def this_thread() -> int:
    """Thread of the block."""
    ...


@wp.func
def own_target(tile: int, thread: int, tiles: wp.array2d[int]):
    """Packed column of the target whose sum a thread gets; -1 for none."""
    # all of it is read at once, whether it is wanted or not: a block begins with what waits for this
    column = tiles[tile, 2] + thread
    return wp.where(thread < tiles[tile, 1] - tiles[tile, 0], column, -1)


@cache
def target_share(shape: Shape):
    """Warp function that says what a thread has to correct: packed column of its target, or -1, and its share of it."""

    @wp.func
    def share_of(tile: int, thread: int, tiles: wp.array2d[int]):
        k = (thread - wp.static(shape.summing)) // wp.static(shape.shares)
        column = tiles[tile, 2] + k
        wanted = thread >= wp.static(shape.summing) and k < tiles[tile, 1] - tiles[tile, 0]
        return wp.where(wanted, column, -1), thread % wp.static(shape.shares)

    return share_of
