"""The native pair loop on a CPU: vectors as wide as the machine has them, tile by tile, by several threads.

A tile holds up to ``STRIPE`` sources in the first-level cache, for a range of target rows to meet. There are two ways
through it:

* ``add_rows`` sums a target at a time, whatever the radii.
* ``add_both_ways`` is for the field, and Kelvin's force, among moments of one radius: a separation and its powers serve
  both ends of the pair. That takes 35 vector operations for the two fields, where ``add_rows`` takes 28 for one, and 46
  for the two forces, where it takes 37. Tiles that may hold moments of the same body do not have their forces that way.

Threads take shares of the tiles, the largest first, as they get to it: one that wakes late or is interrupted leaves
more to the others. Every share has sums of its own, which the finishing kernel adds up in order, so that nothing
depends on who took which.
"""

from functools import cache

import warp as wp

from warpmag.kernels.pairs.pair_terms import (
    SUMS,
    TILE_COLUMNS,
    WIDTHS,
    Quantity,
    mirrored_pair,
    mirrored_sums,
    pair,
    results,
    scaled_moment,
)
from warpmag.kernels.shared.team import MOST_THREADS, TOGETHER, team, wide_registers

STRIPE = 512
"""Most sources, and most targets, of a tile."""

_W = 2.0  # see pair_code: W/√c is cheapest for W = 2

_VECTORS = """
    #if defined(__AVX512F__)
    constexpr int BYTES = 64;
    #elif defined(__AVX__)
    constexpr int BYTES = 32;
    #else
    constexpr int BYTES = 16;
    #endif
    constexpr int LANES = BYTES / (int)sizeof(REAL), VECTORS = STRIPE / LANES;
    typedef REAL NUMBER __attribute__((ext_vector_type(LANES)));

    auto total = [](NUMBER lanes) {
        #pragma clang fp reassociate(on)
        REAL sum = 0;
        for (int l = 0; l < LANES; ++l) sum += lanes[l];
        return sum;
    };

    struct Tile {
        NUMBER packed[8][VECTORS + 2];  // rows of the packed sources, and two vectors for loops to read ahead
        NUMBER u[3][VECTORS];           // their scaled moments
        NUMBER h[3][VECTORS];           // what is summed at the sources themselves
        int begin, count, vectors;
        REAL radius;                // the one radius of all of them, or 0
        REAL first, last;           // the lowest and the highest of their labels
        bool distinct;              // whether their labels ascend, so that none are of one body
    };
    auto number = [](NUMBER* row, int i) -> REAL& { return ((REAL*)row)[i]; };
    auto fill = [number](Tile& tile, const REAL* packed, size_t stride, int begin, int end) ONCE {
        tile.begin = begin;
        tile.count = end - begin;
        tile.vectors = (tile.count + LANES - 1) / LANES;
        for (int c = 0; c < 8; ++c) {
            const REAL* row = packed + c * stride + begin;
            __builtin_memcpy(tile.packed[c], row, tile.count * sizeof(REAL));
            // the lanes beyond the last source stand where it stands, without a moment
            for (int i = tile.count; i < tile.vectors * LANES; ++i)
                number(tile.packed[c], i) = c >= 4 && c < 7 ? REAL(0) : row[tile.count - 1];
            tile.packed[c][tile.vectors] = tile.packed[c][tile.vectors + 1] = row[tile.count - 1];
        }
        for (int c = 0; c < 3; ++c)
            for (int v = 0; v < tile.vectors; ++v) {
                tile.u[c][v] = SCALE * tile.packed[4 + c][v];
                tile.h[c][v] = 0;
            }
        const REAL* radii = (const REAL*)tile.packed[3];
        const REAL* labels = (const REAL*)tile.packed[7];
        bool same = true;
        tile.first = tile.last = labels[0];
        tile.distinct = true;
        for (int i = 1; i < tile.count; ++i) {
            same &= radii[i] == radii[0];
            tile.distinct &= labels[i - 1] < labels[i];
            tile.first = tile.first < labels[i] ? tile.first : labels[i];
            tile.last = tile.last > labels[i] ? tile.last : labels[i];
        }
        tile.radius = same ? radii[0] : 0;
    };
"""

# W/√c. On AVX-512 by Newton's steps from an estimate y good to 2⁻¹⁴: root and quotient take the machine twice the time.
INVERSE_ROOT = {
    "float": """
    auto inverse_root = [](NUMBER c) -> NUMBER {
    #if defined(__AVX512F__)
        const NUMBER y = __builtin_ia32_rsqrt14ps512_mask(c, c, (unsigned short)-1);
        return y * (REAL(3) - c * (y * y));
    #else
        return REAL(2) / __builtin_elementwise_sqrt(c);
    #endif
    };
""",
    "double": """
    auto inverse_root = [](NUMBER c) -> NUMBER {
    #if defined(__AVX512F__)
        NUMBER y = __builtin_ia32_rsqrt14pd512_mask(c, c, (unsigned char)-1);
        y *= REAL(1.5) - REAL(0.5) * c * (y * y);
        return y * (REAL(3) - c * (y * y));
    #else
        return REAL(2) / __builtin_elementwise_sqrt(c);
    #endif
    };
""",
}

_SOURCES = """
            const NUMBER ax = tile.packed[0][v], ay = tile.packed[1][v], az = tile.packed[2][v];
            const NUMBER bx = tile.packed[4][v], by = tile.packed[5][v], bz = tile.packed[6][v];
            const NUMBER ux = tile.u[0][v], uy = tile.u[1][v], uz = tile.u[2][v];
"""


def _add_rows(quantity: Quantity) -> str:
    """Text of ``add`` for a target's sums, and of ``add_rows`` for those of some target rows over a tile."""
    quantity = Quantity.FORCE if quantity == Quantity.MUTUAL_FORCE else quantity
    sums = SUMS[quantity]
    field = quantity == Quantity.FIELD
    effective = "" if field else "REAL ex, REAL ey, REAL ez, "
    target = {"tx": 0, "ty": 1, "tz": 2, "radius": 3, "label": 7}
    loads = [f"{name} = share.targets[{row} * share.target_stride + column]" for name, row in target.items()]
    if not field:
        loads += [f"e{c} = share.effective[{k} * share.effective_stride + column]" for k, c in enumerate("xyz")]
    mask = "c > 0" if field else "(c > 0) & (label != tile.packed[7][v])"
    return f"""
    auto add = [](REAL* out, {effective}{", ".join(f"REAL {name}" for name in sums)}) {{
        {" ".join(f"out[{c}] += {text};" for c, text in enumerate(results(quantity, _W)))}
    }};
    auto add_rows = [=](const Share& share, int row_begin, int row_end, int column_begin, Tile& tile) ONCE {{
        for (int row = row_begin; row < row_end; ++row) {{
            const int column = column_begin + row - row_begin, own = column - tile.begin;
            // a moment makes no field at its own place: while its row is summed, it rests
            const bool rests = {"share.targets == share.sources && own >= 0 && own < tile.count" if field else "false"};
            REAL kept[6];
            for (int c = 0; c < 6 && rests; ++c) {{
                REAL& moment = number(c < 3 ? tile.packed[4 + c] : tile.u[c - 3], own);
                kept[c] = moment;
                moment = 0;
            }}
            const REAL {", ".join(loads)};
            NUMBER {", ".join(f"{name} = 0" for name in sums)};
            for (int v = 0; v < tile.vectors; ++v) {{
                {_SOURCES}
                const NUMBER s = radius + tile.packed[3][v], s2 = s * s;
                auto inverse = [=, &tile](NUMBER d2) -> NUMBER {{
                    const NUMBER c = d2 > s2 ? d2 : s2;
                    return ({mask}) ? inverse_root(c) : 0;
                }};
                {pair(quantity, "inverse(d2)")}
            }}
            add(share.out + (size_t)row * {WIDTHS[quantity]}, {"" if field else "ex, ey, ez, "}
                {", ".join(f"total({name})" for name in sums)});
            for (int c = 0; c < 6 && rests; ++c) number(c < 3 ? tile.packed[4 + c] : tile.u[c - 3], own) = kept[c];
        }}
    }};
    """


# Three vectors of sources are under way at a time, so that nothing waits for its inverse root: one has its separations
# computed, the one before its root, and the one before that is summed.
def _add_both_ways(quantity: Quantity) -> str:
    """Text of ``deposit`` for what is summed at a moment, and of ``add_both_ways`` for the pairs of two tiles."""
    return f"""
    auto deposit = [](REAL* out, REAL hx, REAL hy, REAL hz) {{
        {" ".join(f"out[{c}] += {text};" for c, text in enumerate(results(quantity, _W)))}
    }};
    struct Apart {{ NUMBER x, y, z, c; }};
    auto add_both_ways = [=](Tile& home, NUMBER (&lanes)[3][STRIPE], Tile& tile) ONCE {{
        const NUMBER contact = home.radius + tile.radius, clamp = contact * contact;
        const bool diagonal = &home == &tile;
        for (int i = 0; i < home.count; ++i) {{
            const NUMBER tx = number(home.packed[0], i), ty = number(home.packed[1], i), tz = number(home.packed[2], i);
            const NUMBER mx = number(home.packed[4], i), my = number(home.packed[5], i), mz = number(home.packed[6], i);
            const NUMBER nx = number(home.u[0], i), ny = number(home.u[1], i), nz = number(home.u[2], i);
            NUMBER hx = 0, hy = 0, hz = 0;
            auto apart = [&](int v) -> Apart {{
                const NUMBER x = tx - tile.packed[0][v], y = ty - tile.packed[1][v], z = tz - tile.packed[2][v];
                const NUMBER d2 = x * x + y * y + z * z;
                return Apart{{x, y, z, d2 > clamp ? d2 : clamp}};
            }};
            int v = 0;
            if (diagonal) {{  // vectors before the target's own have met it; its own it meets one way, without itself
                v = i / LANES;
                auto others = clamp > 0;
                others[i % LANES] = 0;
                NUMBER gx = 0, gy = 0, gz = 0;
                {_SOURCES}
                {mirrored_pair(quantity, "others ? inverse_root(d2 > clamp ? d2 : clamp) : 0", w=_W)}
                ++v;
            }}
            Apart now = apart(v), next = apart(v + 1);
            NUMBER inv_now = inverse_root(now.c);
            for (; v < tile.vectors; ++v) {{
                const Apart later = apart(v + 2);
                const NUMBER inv_next = inverse_root(next.c);
                const NUMBER rx = now.x, ry = now.y, rz = now.z, inv = inv_now;
                {_SOURCES}
                NUMBER gx = tile.h[0][v], gy = tile.h[1][v], gz = tile.h[2][v];
                {mirrored_sums(quantity, w=_W)}
                tile.h[0][v] = gx, tile.h[1][v] = gy, tile.h[2][v] = gz;
                now = next, next = later, inv_now = inv_next;
            }}
            lanes[0][i] += hx;
            lanes[1][i] += hy;
            lanes[2][i] += hz;
        }}
    }};
    """


_ENTER_HOME = """
    Tile home;  // the targets of mirrored tiles, and what is summed for them, by lanes
    NUMBER lanes[3][STRIPE];
    int home_row = 0;
    home.begin = -1;
    auto leave_home = [&]() ONCE {
        for (int i = 0; i < home.count && home.begin >= 0; ++i)
            deposit(share.out + 3 * (size_t)(home_row + i), total(lanes[0][i]) + number(home.h[0], i),
                    total(lanes[1][i]) + number(home.h[1], i), total(lanes[2][i]) + number(home.h[2], i));
        home.begin = -1;
    };
    auto enter_home = [&](int row, int begin, int end) {
        leave_home();
        home_row = row;
        fill(home, share.sources, share.source_stride, begin, end);
        __builtin_memset(lanes, 0, sizeof(lanes));
    };
"""


def _walk_home(quantity: Quantity) -> str:
    """Text that sums a mirrored tile."""
    strangers = "home.radius > 0 && other.radius > 0"
    if quantity == Quantity.MUTUAL_FORCE:
        strangers += " && (diagonal ? home.distinct : home.last < other.first || other.last < home.first)"
    return f"""
        if (mirrored && share.targets == share.sources) {{
            if (home.begin != column_begin || home_row != row_begin)
                enter_home(row_begin, column_begin, column_begin + row_end - row_begin);
            const bool diagonal = source_begin == column_begin;
            Tile& other = diagonal ? home : tile;
            if (!diagonal) fill(tile, share.sources, share.source_stride, source_begin, source_end);
            if ({strangers}) {{
                add_both_ways(home, lanes, other);
                for (int j = 0; j < other.count && !diagonal; ++j)
                    deposit(share.out + 3 * (size_t)(mirror_begin + j), number(other.h[0], j), number(other.h[1], j),
                            number(other.h[2], j));
            }} else {{
                add_rows(share, row_begin, row_end, column_begin, other);
                if (!diagonal) add_rows(share, mirror_begin, mirror_end, source_begin, home);
            }}
            continue;
        }}
    """


def _walk(quantity: Quantity) -> str:
    """Text that sums the tiles of a share."""
    both_ways = quantity in (Quantity.FIELD, Quantity.MUTUAL_FORCE)
    return f"""
    __builtin_memset(share.out, 0, share.rows * {WIDTHS[quantity]} * sizeof(REAL));
    Tile tile;
    {_ENTER_HOME if both_ways else ""}
    for (int t = share.first; t < share.last; ++t) {{
        const int* p = share.tiles + {TILE_COLUMNS} * t;
        const int row_begin = p[0], row_end = p[1], column_begin = p[2], source_begin = p[3], source_end = p[4];
        // the sources of a mirrored tile are targets too, in these rows
        const bool mirrored = p[6];
        const int mirror_begin = row_begin + source_begin - column_begin;
        const int mirror_end = mirror_begin + source_end - source_begin;
        {_walk_home(quantity) if both_ways else ""}
        fill(tile, share.sources, share.source_stride, source_begin, source_end);
        add_rows(share, row_begin, row_end, column_begin, tile);
        if (mirrored && source_begin != column_begin) {{
            fill(tile, share.sources, share.source_stride, column_begin, column_begin + row_end - row_begin);
            add_rows(share, mirror_begin, mirror_end, source_begin, tile);
        }}
    }}
    {"leave_home();" if both_ways else ""}
    """


def _snippet(real: str, quantity: Quantity) -> str:
    """All tiles of a work list, by several threads."""
    return f"""
    typedef {real} REAL;
    #define ONCE __attribute__((noinline))  // compiled once, not wherever it is called
    constexpr int STRIPE = {STRIPE};
    struct Share {{
        const REAL *targets, *sources, *effective;
        size_t target_stride, source_stride, effective_stride;
        const int* tiles;
        int first, last;
        REAL* out;
        size_t rows;
    }};
    struct Job {{
        Share shares[{MOST_THREADS}];
        int count, next;
    }};
    auto work_on = [](Job& job) {{
        #pragma clang fp contract(fast)
        constexpr REAL SCALE = {scaled_moment(quantity, _W)!r};
        {_VECTORS}
        {INVERSE_ROOT[real]}
        {_add_rows(quantity)}
        {_add_both_ways(quantity) if quantity in (Quantity.FIELD, Quantity.MUTUAL_FORCE) else ""}
        auto sum = [=](const Share& share) {{
            {_walk(quantity)}
        }};
        auto take = [&]() {{ return __atomic_fetch_add(&job.next, 1, __ATOMIC_RELAXED); }};
        for (int taken = take(); taken < job.count; taken = take()) sum(job.shares[taken]);
    }};
    const size_t rows = partial_out.shape[1];
    Job job;
    job.count = (int)shares.shape[0] - 1;
    job.next = 0;
    for (int t = 0; t < job.count; ++t)
        job.shares[t] = Share{{(const REAL*)targets.data, (const REAL*)sources.data, (const REAL*)effective.data,
                          targets.strides[0] / sizeof(REAL), sources.strides[0] / sizeof(REAL),
                          effective.strides[0] / sizeof(REAL),
                          tiles.data, shares.data[t], shares.data[t + 1],
                          (REAL*)partial_out.data + t * rows * {WIDTHS[quantity]}, rows}};
    {TOGETHER}
    auto work = [&](int) {{ work_on(job); }};
    together(team.data, threads, work);
    #undef ONCE
    """


@cache
def _kernel(dtype, quantity: Quantity):
    @wp.func_native(_snippet("float" if dtype is wp.float32 else "double", quantity))
    def sum_tiles(
        targets: wp.array2d[dtype],
        sources: wp.array2d[dtype],
        effective: wp.array2d[dtype],
        tiles: wp.array2d[int],
        shares: wp.array[int],
        threads: int,
        team: wp.array2d[wp.uint64],
        partial_out: wp.array3d[dtype],
    ): ...

    @wp.kernel(module="unique", enable_backward=False, module_options=wide_registers())
    def pair_loop_cpu(
        # inputs:
        targets: wp.array2d[dtype],
        sources: wp.array2d[dtype],
        effective: wp.array2d[dtype],
        tiles: wp.array2d[int],
        shares: wp.array[int],
        threads: int,
        team: wp.array2d[wp.uint64],
        # outputs:
        partial_out: wp.array3d[dtype],
    ):
        sum_tiles(targets, sources, effective, tiles, shares, threads, team, partial_out)

    return pair_loop_cpu


def launch_pair_loop_cpu(quantity: Quantity, targets, sources, effective, tiles, shares, threads, partial):
    """Sum a quantity over all tiles; see ``pair_loops.launch_pair_loop``."""
    wp.launch(
        _kernel(partial.dtype, quantity),
        dim=1,
        inputs=[targets, sources, effective, tiles, shares, threads, team()],
        outputs=[partial],
        device=partial.device,
    )
