"""The native pair loop on a GPU: a block of warps holds a tile of targets in registers and walks its sources.

Each lane of a warp holds the tile's targets ``lane``, ``lane + 32``, ...; the block's warps share out the sources,
stage them through shared memory, 32 at a time, and at the end add up their sums in order. Sources of few targets are
also split over blocks, whose sums the finishing kernel adds up in order, so that nothing depends on scheduling.

Where a stage's sources have one radius, and none of them is left out for one of the targets, the clamp is a constant of
the target and nothing is masked: 20 instructions a pair for the field and 31 for the force, next to the five or so that
a source takes once for all targets of a lane.
"""

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
        targets: Targets a lane; a tile has 32 times as many.
        warps: Warps a block.
        blocks: Blocks that a multiprocessor holds at once, in float32.
    """

    targets: int
    warps: int
    blocks: int


# Measured on an H200 at 243 to 131,072 targets: the shape, and the most targets that it is best for.
_SHAPES = {
    Quantity.FIELD: ((6144, Shape(4, 8, 2)), (65536, Shape(6, 4, 3)), (None, Shape(8, 4, 2))),
    Quantity.FORCE: ((None, Shape(4, 4, 3)),),
    Quantity.WRENCH: ((None, Shape(3, 4, 3)),),
}
_MOST_SPLITS = 32
_FIXED_COST = 16
"""Sources a block could sum in the time that it takes to start and to end."""


def choose_shape(quantity: Quantity, count: int) -> Shape:
    """Shape for a number of targets."""
    return next(shape for most, shape in _SHAPES[quantity] if most is None or count <= most)


def choose_splits(shape: Shape, tiles: int, longest: int, multiprocessors: int) -> int:
    """Blocks that share the sources of a tile: as many as make the last wave of blocks end with the rest.

    Args:
        shape: Shape of the blocks.
        tiles: Tiles before splitting.
        longest: Sources of the longest tile.
        multiprocessors: Of the device.
    """

    def cost(splits):
        waves, rest = divmod(tiles * splits, multiprocessors * shape.blocks)
        # a multiprocessor with few blocks goes through each of them faster, but does less in all
        share = -(-rest // multiprocessors) / shape.blocks
        work = shape.blocks * longest / splits
        return waves * work + (0.4 + 0.6 * share) * work * (rest > 0) + (waves + (rest > 0)) * _FIXED_COST

    most = max(1, min(_MOST_SPLITS, longest // (2 * shape.warps)))
    return min(range(1, most + 1), key=cost)


_STAGES_PER_SUM = 16
"""Stages after which a warp adds what it has summed to a second set of sums, so that long sums keep their digits."""


_W = 1.0  # see pair_code

_SOURCE = """
            const Quad qa = staged_a[k], qb = staged_b[k];
            const REAL ax = qa.x, ay = qa.y, az = qa.z, bx = qb.x, by = qb.y, bz = qb.z;
            const REAL ux = SCALE * bx, uy = SCALE * by, uz = SCALE * bz;
"""


def _snippet(real: str, quantity: Quantity, targets: int, warps: int) -> str:
    """One thread of a block: ``targets`` targets a lane, ``warps`` warps."""
    field = quantity == Quantity.FIELD
    sums, width, ks = SUMS[quantity], WIDTHS[quantity], [str(k) for k in range(targets)]
    unroll = max(2, 8 // targets)
    staging = max(64, 8 * targets * width)

    def each(text: str) -> str:
        return "".join(text.replace("@", k) for k in ks)

    effective = (
        "" if field else "".join(f"const REAL e{c}@ = eff[{row} * ne + column@];" for row, c in enumerate("xyz"))
    )
    loads = each(
        f"""
    // targets beyond the last are the last again, and not written
    const int column@ = column_begin + min(lane + 32 * @, row_end - row_begin - 1);
    const REAL tx@ = tgt[column@], ty@ = tgt[nt + column@], tz@ = tgt[2 * nt + column@], tr@ = tgt[3 * nt + column@];
    const REAL tl@ = tgt[7 * nt + column@];
    {effective}
    REAL {", ".join(f"{name}@ = 0, sum_{name}@ = 0" for name in sums)};"""
    )
    if field:
        apart = "!same || j < column_begin || j >= column_begin + row_end - row_begin"
        left_out = "j == own@"
        own = each("const int own@ = same ? column@ : -1;")
    else:
        apart = "label < lowest || label > highest"
        left_out = "qb.w == tl@"
        own = (
            "REAL lowest = tl0, highest = tl0;"
            + "".join(f"lowest = min(lowest, tl{k}); highest = max(highest, tl{k});" for k in ks[1:])
            + """
    for (int step = 16; step > 0; step /= 2) {
        lowest = min(lowest, __shfl_xor_sync(~0u, lowest, step));
        highest = max(highest, __shfl_xor_sync(~0u, highest, step));
    }"""
        )
    fast_pairs = each("{" + pair(quantity, "inverse_root(max(d2, clamp@))", "@") + "}")
    careful_pairs = each("{" + pair(quantity, f"careful(d2, tr@ + qa.w, {left_out})", "@") + "}")
    stores = "".join(
        f"warp_sums[(lane + 32 * {k}) * {width} + {c}] = {text};"
        for k in ks
        for c, text in enumerate(results(quantity, _W, k))
    )
    return f"""
    {cuda_head(real)}
    constexpr REAL SCALE = {scaled_moment(quantity, _W)!r};
    struct alignas(16) Quad {{ REAL x, y, z, w; }};
    __shared__ Quad staging[{warps}][{staging}];  // of each warp, for its sources, and at the end for its sums
    const int lane = thread % 32, warp = thread / 32 % {warps};
    const int* tile = tiles.data + {TILE_COLUMNS} * (thread / {32 * warps});
    const int row_begin = tile[0], row_end = tile[1], column_begin = tile[2], split = tile[5];
    const int per_warp = (tile[4] - tile[3] + {warps - 1}) / {warps};
    const int source_begin = tile[3] + warp * per_warp, source_end = min(tile[4], source_begin + per_warp);
    const size_t ns = sources.strides[0] / sizeof(REAL), nt = targets.strides[0] / sizeof(REAL);
    const size_t ne = effective.strides[0] / sizeof(REAL), rows = partial_out.shape[1];
    const REAL *src = (const REAL*)sources.data, *tgt = (const REAL*)targets.data, *eff = (const REAL*)effective.data;
    const bool same = src == tgt;
    {loads}
    {own}
    Quad *staged_a = staging[warp], *staged_b = staged_a + 32;
    REAL x, y, z, radius, bx, by, bz, label;
    // lanes beyond the last source stand where it stands, without a moment
    auto load = [&](int base) {{
        const bool there = base + lane < source_end;
        const int j = there ? base + lane : source_end - 1;
        x = src[j], y = src[ns + j], z = src[2 * ns + j], radius = src[3 * ns + j], label = src[7 * ns + j];
        bx = there ? src[4 * ns + j] : 0, by = there ? src[5 * ns + j] : 0, bz = there ? src[6 * ns + j] : 0;
    }};
    if (source_begin < source_end) load(source_begin);
    int stage = 0;
    for (int base = source_begin; base < source_end; base += 32) {{
        const int j = base + lane;
        const REAL one_radius = __shfl_sync(~0u, radius, 0);
        const bool fast = __all_sync(~0u, radius == one_radius && radius > 0 && ({apart}));
        __syncwarp();
        staged_a[lane] = Quad{{x, y, z, radius}};
        staged_b[lane] = Quad{{bx, by, bz, {0 if field else "label"}}};
        __syncwarp();
        const int staged = min(32, source_end - base);
        if (base + 32 < source_end) load(base + 32);
        if (fast) {{
            {each("const REAL clamp@ = (tr@ + one_radius) * (tr@ + one_radius);")}
            #pragma unroll 1
            for (int first = 0; first < staged; first += {unroll}) {{
                #pragma unroll
                for (int step = 0; step < {unroll}; ++step) {{
                    const int k = first + step;
                    {_SOURCE}
                    {fast_pairs}
                }}
            }}
        }} else {{
            #pragma unroll 1
            for (int k = 0; k < staged; ++k) {{
                const int j = base + k;
                {_SOURCE}
                {careful_pairs}
            }}
        }}
        if (++stage % {_STAGES_PER_SUM} == 0) {{
            {each(" ".join(f"sum_{name}@ += {name}@; {name}@ = 0;" for name in sums))}
        }}
    }}
    {each(" ".join(f"{name}@ += sum_{name}@;" for name in sums))}
    __syncwarp();
    REAL* warp_sums = (REAL*)staging[warp];
    {stores}
    __syncthreads();
    for (int item = thread % {32 * warps}; item < {width} * (row_end - row_begin); item += {32 * warps}) {{
        REAL total = 0;
        #pragma unroll
        for (int w = 0; w < {warps}; ++w) total += ((const REAL*)staging[w])[item];
        ((REAL*)partial_out.data)[((size_t)split * rows + row_begin) * {width} + item] = total;
    }}
    """


@cache
def _kernel(dtype, quantity: Quantity, shape: Shape):
    single = dtype is wp.float32

    @wp.func_native(_snippet("float" if single else "double", quantity, shape.targets, shape.warps))
    def sum_tile(
        targets: wp.array2d[dtype],
        sources: wp.array2d[dtype],
        effective: wp.array2d[dtype],
        tiles: wp.array2d[int],
        thread: int,
        partial_out: wp.array3d[dtype],
    ): ...

    bounds = (32 * shape.warps, shape.blocks if single else 1)

    @wp.kernel(module="unique", enable_backward=False, grid_stride=False, launch_bounds=bounds)
    def pair_loop_cuda(
        # inputs:
        targets: wp.array2d[dtype],
        sources: wp.array2d[dtype],
        effective: wp.array2d[dtype],
        tiles: wp.array2d[int],
        # outputs:
        partial_out: wp.array3d[dtype],
    ):
        sum_tile(targets, sources, effective, tiles, wp.tid(), partial_out)

    return pair_loop_cuda


def launch_pair_loop_cuda(quantity: Quantity, shape: Shape, targets, sources, effective, tiles, partial):
    """Sum a quantity over all tiles; see ``pair_loops.launch_pair_loop``."""
    wp.launch(
        _kernel(partial.dtype, quantity, shape),
        dim=tiles.shape[0] * 32 * shape.warps,
        inputs=[targets, sources, effective, tiles],
        outputs=[partial],
        device=partial.device,
        block_dim=32 * shape.warps,
    )
