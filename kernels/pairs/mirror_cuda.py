"""The native pair loop on a GPU for many moments among themselves: a pair is met once, for both of its ends.

The moments are cut into an odd number of equal tiles, set in a circle, and each meets the half of the others that
follows it. A block of warps holds a home tile in registers, lane l its moments l, l + 32, ..., and walks stages of 32
moments of the others. At step s of a stage lane l meets the moment (l + s) mod 32 with all it holds, and passes what
it has summed for that moment on to the lane that meets it next, so that after 32 steps lane l has what the home tile
does to moment l: 30 instructions for both ends of a field's pair and 41 of a force's, next to the eight or so that a
moment takes once for all that a lane holds.

That goes to a slab of sums that belongs to the distance between the two tiles in the circle, to which no other block
writes; what is summed for the home tile goes to a slab of the block's own share of the walk. The finishing kernel adds
up the slabs in order, so that nothing depends on scheduling. Slabs that would take more memory than they may are made
in passes, each of which adds to the slabs of the last.
"""

import math
from dataclasses import dataclass
from functools import cache

import numpy as np
import warp as wp

from warpmag.kernels.pairs.pair_terms import Quantity, cuda_head, mirrored_pair, scaled_moment


@dataclass(frozen=True)
class Shape:
    """Shape of the blocks that walk the tiles.

    Attributes:
        moments: Moments a lane holds; a tile has at most 32 times as many.
        warps: Warps a block.
        blocks: Blocks that a multiprocessor holds at once, in float32.
        unrolled: Steps of a stage that the compiler interleaves.
    """

    moments: int
    warps: int
    blocks: int
    unrolled: int


# Measured on an H200 at 5,000 to 131,072 moments: the shape, and the most moments that it is best for.
SHAPES = {
    Quantity.FIELD: ((7000, Shape(2, 4, 6, 2)), (30000, Shape(3, 4, 4, 2)), (None, Shape(6, 4, 3, 2))),
    Quantity.MUTUAL_FORCE: ((7000, Shape(2, 4, 6, 2)), (None, Shape(4, 4, 4, 1))),
}
_SLAB_BYTES = 2**28
"""Memory that slabs may take."""
_MOST_SPLITS, _MOST_STAGES = 32, 32
"""Blocks that share the walk of a tile, and stages that a warp sums in one piece: longer sums would lose digits."""
_FIXED_COST = 0.1
"""Time that a block takes to start and to end, and that a split takes to be added up, in stages of a warp."""


@dataclass(frozen=True)
class Mirror:
    """Work list of moments among themselves, on one device.

    Attributes:
        quantity: What is summed: ``FIELD`` or ``MUTUAL_FORCE``.
        shape: Shape of the blocks.
        origin: Packed column of the first moment.
        edges: First moment of each tile, and the end, shape [tiles + 1].
        blocks: Home tile, stages begin and end, and share of each block, shape [blocks, 4].
        passes: For each launch its first block and number of blocks, and the first distance between tiles.
        slabs: Distances between tiles that have a slab of their own; those of the blocks' shares follow.
        stages: Stages of a tile.
        splits: Blocks of a pass that share out the walk of a home tile.
    """

    quantity: Quantity
    shape: Shape
    origin: int
    edges: wp.array
    blocks: wp.array
    passes: tuple[tuple[int, int, int], ...]
    slabs: int
    stages: int
    splits: int


def make_mirror(origin: int, count: int, quantity: Quantity, device) -> Mirror:
    """Plan the walk of ``count`` moments from packed column ``origin`` on."""
    shape = next(shape for most, shape in SHAPES[quantity] if most is None or count <= most)
    tiles = max(math.ceil(count / (32 * shape.moments)), 3)
    tiles += 1 - tiles % 2
    stages = math.ceil(math.ceil(count / tiles) / 32)
    farthest = tiles // 2
    slabs = min(farthest, max(1, _SLAB_BYTES // (12 * count)))
    slabs = math.ceil(farthest / math.ceil(farthest / slabs))  # as many in each pass
    splits = _choose_splits(shape, tiles, stages * min(slabs + 1, farthest + 1), device.sm_count)
    blocks, passes = [], []
    for nearest in range(1, farthest + 1, slabs):
        # the first pass has the pairs within a tile, too
        begin, end = stages * (nearest if nearest > 1 else 0), stages * min(nearest + slabs, farthest + 1)
        cuts = begin + (end - begin) * np.arange(splits + 1) // splits
        passes.append((len(blocks), tiles * splits, nearest))
        blocks += [(tile, cuts[k], cuts[k + 1], k) for k in range(splits) for tile in range(tiles)]
    return Mirror(
        quantity=quantity,
        shape=shape,
        origin=origin,
        edges=wp.array(count * np.arange(tiles + 1) // tiles, dtype=wp.int32, device=device),
        blocks=wp.array(np.array(blocks), dtype=wp.int32, device=device),
        passes=tuple(passes),
        slabs=slabs,
        stages=stages,
        splits=splits,
    )


def _choose_splits(shape: Shape, tiles: int, walk: int, multiprocessors: int) -> int:
    """Blocks that share the walk of a tile, of so many stages; see ``pair_loops_cuda.choose_splits``."""

    def cost(splits):
        waves, rest = divmod(tiles * splits, multiprocessors * shape.blocks)
        # a multiprocessor with few blocks goes through each of them faster, but does less in all
        share = -(-rest // multiprocessors) / shape.blocks
        work = shape.blocks * math.ceil(walk / splits / shape.warps)
        return waves * work + (0.4 + 0.6 * share) * work * (rest > 0) + (waves + (rest > 0) + splits) * _FIXED_COST

    least = math.ceil(walk / shape.warps / _MOST_STAGES)
    return min(range(least, max(least, min(_MOST_SPLITS, walk)) + 1), key=cost)


def _snippet(real: str, quantity: Quantity, shape: Shape) -> str:
    """One thread of a block."""
    field = quantity == Quantity.FIELD
    held, warps = shape.moments, shape.warps
    ks = [str(k) for k in range(held)]

    def each(text: str) -> str:
        return "".join(text.replace("@", k) for k in ks)

    # the near terms of a force outweigh the far ones so much that a sum of both would lose these: sums by stage do not
    by_stage = not field
    h = "sum_h" if by_stage else "h"
    loads = each(
        f"""
    // a lane that holds fewer has the last again, without a moment, which is not written
    const int row@ = row_begin + lane + 32 * @, column@ = origin + min(row@, row_end - 1);
    const REAL tx@ = src[column@], ty@ = src[n + column@], tz@ = src[2 * n + column@], tr@ = src[3 * n + column@];
    const REAL mx@ = row@ < row_end ? src[4 * n + column@] : 0, my@ = row@ < row_end ? src[5 * n + column@] : 0;
    const REAL mz@ = row@ < row_end ? src[6 * n + column@] : 0;
    {"const REAL nx@ = SCALE * mx@, ny@ = SCALE * my@, nz@ = SCALE * mz@;" if field else ""}
    {"" if field else "const REAL tl@ = src[7 * n + column@];"}
    REAL {h}x@ = 0, {h}y@ = 0, {h}z@ = 0;"""
    )
    if field:
        apart, left_out, bounds = "true", "false", ""
    else:
        apart, left_out = "(label < lowest || label > highest)", "qc.y == tl@"
        bounds = (
            "REAL lowest = tl0, highest = tl0;"
            + "".join(f"lowest = min(lowest, tl{k}); highest = max(highest, tl{k});" for k in ks[1:])
            + """
    for (int step = 16; step > 0; step /= 2) {
        lowest = min(lowest, __shfl_xor_sync(~0u, lowest, step));
        highest = max(highest, __shfl_xor_sync(~0u, highest, step));
    }"""
        )
    source = f"""
                const Quad qa = staged_a[lane + step], qb = staged_b[lane + step];
                const REAL ax = qa.x, ay = qa.y, az = qa.z, bx = qa.w, by = qb.x, bz = qb.y;
                {"const REAL ux = qb.z, uy = qb.w, uz = SCALE * bz;" if field else ""}
    """
    hand_on = " ".join(f"g{c} = __shfl_sync(~0u, g{c}, lane + 1);" for c in "xyz")
    fast_pairs = each("{" + mirrored_pair(quantity, "inverse_root(max(d2, clamp@))", "@") + "}")
    left_out += " || (distance == 0 && begin + (lane + step) % 32 == row@)"
    careful_pairs = each("{" + mirrored_pair(quantity, f"careful(d2, tr@ + qc.x, {left_out})", "@") + "}")
    worth = "REAL(3)"
    stores = "".join(
        f"warp_sums[(lane + 32 * {k}) * 3 + {i}] = {worth} * {h}{c}{k};" for k in ks for i, c in enumerate("xyz")
    )
    return f"""
    {cuda_head(real)}
    constexpr REAL SCALE = {scaled_moment(Quantity.FIELD, 1.0)!r};
    struct alignas(16) Quad {{ REAL x, y, z, w; }};
    // of each warp, for the moments of a stage, twice over, and at the end for its sums
    __shared__ Quad staging[{warps}][{max(192, 24 * held)}];
    const int lane = thread % 32, warp = thread / 32;
    const int* p = blocks.data + 4 * block;
    const int home = p[0], share = p[3], rows = partial_out.shape[1], tiles = edges.shape[0] - 1;
    const int row_begin = edges.data[home], row_end = edges.data[home + 1];
    const int walk = p[2] - p[1];
    const int walk_begin = p[1] + walk * warp / {warps}, walk_end = p[1] + walk * (warp + 1) / {warps};
    const size_t n = packed.strides[0] / sizeof(REAL);
    const REAL* src = (const REAL*)packed.data;
    REAL* out = (REAL*)partial_out.data;
    const bool first_pass = nearest == 1;
    auto store = [&](size_t slab, int item, REAL value) {{
        REAL& sum = out[slab * rows * 3 + item];
        sum = first_pass ? value : sum + value;
    }};
    {loads}
    {bounds}
    Quad *staged_a = staging[warp], *staged_b = staged_a + 64, *staged_c = staged_b + 64;
    #pragma unroll 1
    for (int at = walk_begin; at < walk_end; ++at) {{
        const int distance = at / stages;
        const int other = home + distance < tiles ? home + distance : home + distance - tiles;
        const int begin = edges.data[other] + 32 * (at - distance * stages), end = edges.data[other + 1];
        if (begin >= end) continue;
        // lanes beyond the last moment stand where it stands, without a moment
        const bool there = begin + lane < end;
        const int j = origin + (there ? begin + lane : end - 1);
        const REAL radius = src[3 * n + j]{"" if field else ", label = src[7 * n + j]"};
        const REAL bx = there ? src[4 * n + j] : 0, by = there ? src[5 * n + j] : 0, bz = there ? src[6 * n + j] : 0;
        const REAL one_radius = __shfl_sync(~0u, radius, 0);
        const bool fast = __all_sync(~0u, radius == one_radius && radius > 0 && distance > 0 && {apart});
        __syncwarp();
        staged_a[lane] = staged_a[lane + 32] = Quad{{src[j], src[n + j], src[2 * n + j], bx}};
        staged_b[lane] = staged_b[lane + 32] = Quad{{by, bz, SCALE * bx, SCALE * by}};
        staged_c[lane] = staged_c[lane + 32] = Quad{{radius, {0 if field else "label"}, 0, 0}};
        __syncwarp();
        REAL gx = 0, gy = 0, gz = 0;
        {each("REAL hx@ = 0, hy@ = 0, hz@ = 0;") if by_stage else ""}
        if (fast) {{
            {each("const REAL clamp@ = (tr@ + one_radius) * (tr@ + one_radius);")}
            #pragma unroll {shape.unrolled}
            for (int step = 0; step < 32; ++step) {{
                {source}
                {fast_pairs}
                {hand_on}
            }}
        }} else {{
            #pragma unroll 1
            for (int step = 0; step < 32; ++step) {{
                {source}
                const Quad qc = staged_c[lane + step];
                {careful_pairs}
                {hand_on}
            }}
        }}
        {each("sum_hx@ += hx@; sum_hy@ += hy@; sum_hz@ += hz@;") if by_stage else ""}
        if (there && distance > 0) {{
            store(distance - nearest, 3 * (begin + lane), {worth} * gx);
            store(distance - nearest, 3 * (begin + lane) + 1, {worth} * gy);
            store(distance - nearest, 3 * (begin + lane) + 2, {worth} * gz);
        }}
    }}
    __syncwarp();
    REAL* warp_sums = (REAL*)staging[warp];
    {stores}
    __syncthreads();
    for (int item = thread; item < 3 * (row_end - row_begin); item += {32 * warps}) {{
        REAL total = 0;
        #pragma unroll
        for (int w = 0; w < {warps}; ++w) total += ((const REAL*)staging[w])[item];
        store(slabs + share, 3 * row_begin + item, total);
    }}
    """


@cache
def _kernel(dtype, quantity: Quantity, shape: Shape):
    single = dtype is wp.float32

    @wp.func_native(_snippet("float" if single else "double", quantity, shape))
    def walk_tiles(
        block: int,
        thread: int,
        packed: wp.array2d[dtype],
        origin: int,
        edges: wp.array[int],
        blocks: wp.array2d[int],
        stages: int,
        slabs: int,
        nearest: int,
        partial_out: wp.array3d[dtype],
    ): ...

    bounds = (32 * shape.warps, shape.blocks if single else 1)

    @wp.kernel(module="unique", enable_backward=False, grid_stride=False, launch_bounds=bounds)
    def pair_loop_mirrored(
        # inputs:
        packed: wp.array2d[dtype],
        origin: int,
        edges: wp.array[int],
        blocks: wp.array2d[int],
        stages: int,
        slabs: int,
        first_block: int,
        nearest: int,
        # outputs:
        partial_out: wp.array3d[dtype],
    ):
        block, thread = wp.tid()
        walk_tiles(first_block + block, thread, packed, origin, edges, blocks, stages, slabs, nearest, partial_out)

    return pair_loop_mirrored


def launch_pair_loop_mirrored(m: Mirror, packed, partial):
    """Sum a quantity over all pairs; see ``pair_loops.launch_pair_loop``."""
    for first_block, blocks, nearest in m.passes:
        wp.launch_tiled(
            _kernel(partial.dtype, m.quantity, m.shape),
            dim=[blocks],
            inputs=[packed, m.origin, m.edges, m.blocks, m.stages, m.slabs, first_block, nearest],
            outputs=[partial],
            block_dim=32 * m.shape.warps,
            device=partial.device,
        )
