// All-pairs sums, field (Eq. 1) and force (Eqs. 4, 13 and 14), of a work list of tiles on a CPU, in vectors of the
// machine's width and by several threads.
//
// At most TILE_SIZE sources (from Python) at a time are kept in the first-level cache. The field and Kelvin's force
// among moments are summed for both moments of a pair at once, which share the separation and its powers. Two fields
// take 33 vector operations, a single one 23; two forces take 44, a single one 34. The loop is compiled for each Kind
// of pairs of two tiles: different radii cost 3 more operations.
//
// Threads take shares of the tiles, the largest first. No two shares add to the same partial sums of a row, and the
// finishing kernel adds the partial sums up in order. So results do not depend on which thread took which share.
#pragma once
#include "pairs/pair_terms.h"
#include "shared/inverse_root.h"
#include "shared/team.h"
#include "shared/transpose.h"
#include "shared/vectors.h"

namespace warpmag::cpu {

#if defined(__AVX512F__)
constexpr int BYTES = 64;
#elif defined(__AVX__)
constexpr int BYTES = 32;
#else
constexpr int BYTES = 16;
#endif
constexpr int LANES = BYTES / (int)sizeof(Real), VECTORS = TILE_SIZE / LANES;
typedef Real Simd __attribute__((ext_vector_type(LANES)));
static_assert(W == 2); // inverse distances are twice_inverse_root(d²)

// MUTUAL: a pair may be summed for both its moments. ONE_SIDED: the quantity summed where only one moment is a target.
template <Quantity Q> constexpr bool MUTUAL = Q == Quantity::FIELD || Q == Quantity::MUTUAL_FORCE;
template <Quantity Q> constexpr Quantity ONE_SIDED = Q == Quantity::MUTUAL_FORCE ? Quantity::FORCE : Q;

// True for the numbers of Sums that a quantity uses; SUMS is their count.
template <Quantity Q> constexpr bool is_summed(int k) {
    if (MUTUAL<Q>) return k >= 3 && k < 6;
    return Q == Quantity::WRENCH || k < 3 || k == 9;
}
template <Quantity Q> constexpr int SUMS = Q == Quantity::WRENCH ? 10 : MUTUAL<Q> ? 3 : 4;

// Sum over the lanes of each of LANES vectors, in the lanes of one vector. Transposing first takes a third of the
// operations of separate sums.
inline Simd totals(Simd (&rows)[LANES]) {
    transpose<1>(rows, __make_integer_seq<Sequence, int, LANES>());
    Simd sum = 0;
    for (int l = 0; l < LANES; ++l) sum += rows[l];
    return sum;
}

inline Vec3<Simd> splat(const Vec3<Real>& v) { return {Simd(v.x), Simd(v.y), Simd(v.z)}; }

inline Real& number(Simd* row, int i) { return ((Real*)row)[i]; }

// Vector of number i of three rows, and of their SIMD vector v.
template <int N> inline Vec3<Real> numbers(Simd (*rows)[N], int i) {
    return {number(rows[0], i), number(rows[1], i), number(rows[2], i)};
}

template <int N> inline Vec3<Simd> vectors(const Simd (*rows)[N], int v) {
    return {rows[0][v], rows[1][v], rows[2][v]};
}

// Rows of packed moments; a tile also has rows of scaled moments.
enum Row { POSITION = 0, RADIUS = 3, MOMENT = 4, LABEL = 7, PACKED_ROWS, SCALED_MOMENT = PACKED_ROWS, TILE_ROWS = 11 };

struct Table {
    const Real* data;
    size_t stride;

    Table(const wp::array_t<Real>& rows) : data(rows.data), stride(rows.strides[0] / sizeof(Real)) {}

    const Real* row(int r) const { return data + r * stride; }

    Vec3<Real> vector(int r, int column) const { return {row(r)[column], row(r + 1)[column], row(r + 2)[column]}; }
};

// A share of the tiles, which one thread sums. Shape of ``partial``: [parts, row_count, width(Q)].
struct Share {
    Table targets, sources, effective;
    const TileEntry *begin, *end;
    Real* partial;
    size_t row_count;

    template <Quantity Q> Real* sums_at(int part, int row) const {
        return partial + (part * row_count + row) * width(Q);
    }
};

struct Tile {
    Simd rows[TILE_ROWS][VECTORS + 2]; // the pipelined loop reads two vectors ahead
    Simd sums[3][VECTORS];             // sums h of its moments from pairs summed for both moments
    int begin, count = 0, vectors = 0;
    Real radius; // of the first moment
    bool equal_radii;
    Real lowest_label, highest_label;
    bool ascending; // labels ascend strictly, so that no two moments belong to one body

    Source<Simd> source(int v) const {
        return {cpu::vectors(rows + POSITION, v), cpu::vectors(rows + MOMENT, v),
                cpu::vectors(rows + SCALED_MOMENT, v)};
    }
};

// Compare the radii and the labels of a tile's moments, for kind_of.
inline void compare_radii(Tile& tile) {
    tile.radius = number(tile.rows[RADIUS], 0);
    Simd spread = 0;
    for (int v = 0; v < tile.vectors; ++v)
        spread = __builtin_elementwise_max(spread, __builtin_elementwise_abs(tile.rows[RADIUS][v] - tile.radius));
    tile.equal_radii = __builtin_reduce_max(spread) == 0;
}
inline void compare_labels(Tile& tile) {
    const Simd* labels = tile.rows[LABEL];
    Simd lowest = labels[0], highest = labels[0];
    for (int v = 0; v < tile.vectors; ++v) {
        lowest = __builtin_elementwise_min(lowest, labels[v]);
        highest = __builtin_elementwise_max(highest, labels[v]);
    }
    tile.lowest_label = __builtin_reduce_min(lowest);
    tile.highest_label = __builtin_reduce_max(highest);
    tile.ascending = true;
    for (int i = 1; i < tile.count; ++i)
        tile.ascending &= number(tile.rows[LABEL], i - 1) < number(tile.rows[LABEL], i);
}

// Appends moments to a tile.
inline void append(Tile& tile, const Table& table, int begin, int end) {
    for (int r = 0; r < PACKED_ROWS; ++r)
        __builtin_memcpy((Real*)tile.rows[r] + tile.count, table.row(r) + begin, (end - begin) * sizeof(Real));
    tile.count += end - begin;
}

// Pads a tile, and computes its scaled moments, zero sums, radii and labels.
template <Quantity Q> __attribute__((noinline)) void complete(Tile& tile) {
    tile.vectors = (tile.count + LANES - 1) / LANES;
    for (int r = 0; r < PACKED_ROWS; ++r) {
        // lanes beyond the last source repeat its position, without a moment
        const Real beyond = r >= MOMENT && r < LABEL ? 0 : number(tile.rows[r], tile.count - 1);
        for (int i = tile.count; i < (tile.vectors + 2) * LANES; ++i) number(tile.rows[r], i) = beyond;
    }
    constexpr Real SCALE = scaled_moment(Q);
    for (int c = 0; c < 3; ++c)
        for (int v = 0; v < tile.vectors; ++v) {
            tile.rows[SCALED_MOMENT + c][v] = SCALE * tile.rows[MOMENT + c][v];
            tile.sums[c][v] = 0;
        }
    compare_radii(tile);
    if (Q != Quantity::FIELD) compare_labels(tile);
}

template <Quantity Q> inline void fill(Tile& tile, const Table& table, int begin, int end) {
    tile.begin = begin;
    tile.count = 0;
    append(tile, table, begin, end);
    complete<Q>(tile);
}

// Removes a target's own moment from the tile of sources, and restores it at the end of the scope.
struct WithoutOwn {
    Tile& sources;
    int i;
    Real kept[TILE_ROWS];

    WithoutOwn(const Share& share, const Tile& targets, Tile& sources, int target, bool remove)
        : sources(sources), i(targets.begin + target - sources.begin) {
        if (!remove || share.targets.data != share.sources.data || i < 0 || i >= sources.count) i = -1;
        for (int r = MOMENT; r < TILE_ROWS && i >= 0; ++r) {
            kept[r] = number(sources.rows[r], i);
            number(sources.rows[r], i) = 0;
        }
    }
    ~WithoutOwn() {
        for (int r = MOMENT; r < TILE_ROWS && i >= 0; ++r) number(sources.rows[r], i) = kept[r];
    }
};

// Kind of the pairs of two tiles. POINTS: points of different bodies. BALLS: balls of different bodies with one contact
// distance. ANY: everything else.
enum class Kind { POINTS, BALLS, ANY };

template <Quantity Q> inline Kind kind_of(const Tile& a, const Tile& b) {
    const bool disjoint = a.highest_label < b.lowest_label || b.highest_label < a.lowest_label;
    const bool distinct = Q == Quantity::FIELD || (&a == &b ? a.ascending : disjoint);
    if (!(a.equal_radii && b.equal_radii && distinct)) return Kind::ANY;
    return a.radius + b.radius > 0 ? Kind::BALLS : Kind::POINTS;
}

// Adds the results of targets to the partial sums, from vectors of each of their sums.
template <Quantity Q>
inline void add_results(const Share& share, Real* out, int column, int lane_count, Simd (&rows)[SUMS<Q>][LANES]) {
    Simd summed[10] = {};
    for (int k = 0, used = 0; k < 10; ++k)
        if (is_summed<Q>(k)) summed[k] = totals(rows[used++]);
    for (int l = 0; l < lane_count; ++l, out += width(Q)) {
        const auto sum = [&](int k) { return number(summed + k, l); };
        const auto vector = [&](int k) -> Vec3<Real> { return {sum(k), sum(k + 1), sum(k + 2)}; };
        const Vec3<Real> e = Q == Quantity::FIELD ? Vec3<Real>{} : share.effective.vector(0, column + l);
        Real numbers[width(Q)];
        results<Q>({vector(0), vector(3), vector(6), sum(9)}, e, numbers);
        for (int c = 0; c < width(Q); ++c) out[c] += numbers[c];
    }
}

// Adds each pair of two tiles to the partial sums of its target, or, if BOTH, to the sums of both moments; the two
// tiles may then be the same. The loop is software-pipelined to hide the latency of inverse roots. Each step computes
// the separations of one vector of sources, the inverse roots of the vector before, and the sums of the vector before
// that.
template <Quantity Q, Kind K, bool BOTH>
__attribute__((noinline)) void sum_pairs(const Share& share, Tile& targets, Tile& sources, Real* out) {
    struct Separation {
        Vec3<Simd> r;
        Simd c;
    };
    struct Target {
        Vec3<Simd> x;
        Simd radius, label;
    };
    const Simd contact = targets.radius + sources.radius, clamp = contact * contact;
    const bool diagonal = &targets == &sources, restarts = diagonal || sources.vectors < 2;
    const auto of_target = [&](int row, int i) { return splat(numbers(targets.rows + row, i)); };
    const auto target = [&](int i) -> Target {
        return {of_target(POSITION, i), number(targets.rows[RADIUS], i), number(targets.rows[LABEL], i)};
    };
    const auto separation = [&](const Target& t, int v) -> Separation {
        const Vec3<Simd> r = t.x - vectors(sources.rows + POSITION, v);
        const Simd d2 = dot(r, r), s = t.radius + sources.rows[RADIUS][v], s2 = K == Kind::ANY ? s * s : clamp;
        return {r, K == Kind::POINTS || d2 > s2 ? d2 : s2};
    };
    const auto inverse = [&](const Target& t, Simd c, int v) -> Simd {
        if (K == Kind::BALLS) return twice_inverse_root(c);
        auto active = c > 0;
        if (K == Kind::ANY && Q != Quantity::FIELD) active &= t.label != sources.rows[LABEL][v];
        return active ? twice_inverse_root(c) : 0;
    };
    Separation current, next;
    Simd inv;
    const auto sum_row = [&](int i) __attribute__((always_inline)) -> Sums<Simd> {
        const Target t = target(i), next_target = target(i + 1);
        const Vec3<Simd> e = BOTH ? of_target(MOMENT, i) : splat(share.effective.vector(0, targets.begin + i));
        const Vec3<Simd> n = of_target(SCALED_MOMENT, i);
        Sums<Simd> sums;
        int v = 0;
        if (diagonal) {
            // pairs with earlier vectors are already summed; pairs within a vector are summed for each moment
            // separately
            v = i / LANES;
            const Separation s = separation(t, v);
            Simd others = inverse(t, s.c, v);
            others[i % LANES] = 0;
            Vec3<Simd> unused{};
            add_mirrored_pair<Q>(sums.h, unused, s.r, others, sources.source(v), e, n);
            ++v;
        }
        if (restarts || i == 0) {
            current = separation(t, v), next = separation(t, v + 1);
            inv = inverse(t, current.c, v);
        }
        const auto sum_vector = [&](const Separation& later, Simd next_inv) {
            if constexpr (BOTH) {
                Vec3<Simd> g = vectors(sources.sums, v);
                add_mirrored_pair<Q>(sums.h, g, current.r, inv, sources.source(v), e, n);
                sources.sums[0][v] = g.x, sources.sums[1][v] = g.y, sources.sums[2][v] = g.z;
            } else {
                add_pair<Q>(sums, current.r, inv, sources.source(v), e);
            }
            current = next, next = later, inv = next_inv;
        };
        for (; v < sources.vectors - 2 * !restarts; ++v) sum_vector(separation(t, v + 2), inverse(t, next.c, v + 1));
        // the next target's first separations
        for (; v < sources.vectors; ++v) {
            const int ahead = v + 2 - sources.vectors;
            sum_vector(separation(next_target, ahead),
                       ahead ? inverse(next_target, next.c, ahead - 1) : inverse(t, next.c, v + 1));
        }
        return sums;
    };
    for (int i = 0; i < targets.count; i += LANES) {
        const int lane_count = targets.count - i < LANES ? targets.count - i : LANES;
        Simd rows[SUMS<Q>][LANES] = {};
        for (int l = 0; l < lane_count; ++l) {
            const WithoutOwn own(share, targets, sources, i + l, !BOTH && Q == Quantity::FIELD);
            const Sums<Simd> sums = sum_row(i + l);
            for (int k = 0, used = 0; k < 10; ++k)
                if (is_summed<Q>(k)) rows[used++][l] = ((const Simd*)&sums)[k];
        }
        if constexpr (BOTH)
            for (int c = 0; c < 3; ++c) targets.sums[c][i / LANES] += totals(rows[c]);
        else add_results<Q>(share, out + (size_t)i * width(Q), targets.begin + i, lane_count, rows);
    }
}

template <Quantity Q, bool BOTH> inline void sum_all_pairs(const Share& share, Tile& a, Tile& b, Real* out) {
    const Kind kind = kind_of<Q>(a, b);
    if (kind == Kind::ANY) sum_pairs<Q, Kind::ANY, BOTH>(share, a, b, out);
    else if (kind == Kind::BALLS) sum_pairs<Q, Kind::BALLS, BOTH>(share, a, b, out);
    else sum_pairs<Q, Kind::POINTS, BOTH>(share, a, b, out);
}

// Adds the sums h of a tile's moments to their partial sums.
__attribute__((noinline)) inline void add_tile_sums(const Tile& tile, Real* out) {
    for (int i = 0; i < tile.count; i += WIDTH, out += 3 * WIDTH) {
        const auto h = [&](int c) { return warpmag::numbers((const Real*)tile.sums[c] + i); };
        const int lane_count = tile.count - i;
        put_vectors(out, lane_count, warpmag::vectors(out, lane_count) + H_FACTOR * Vector{h(0), h(1), h(2)});
    }
}

// Targets that consecutive mirrored tiles of the work list share, and their partial sums.
struct TargetTile {
    Tile tile;
    Real* out = nullptr;

    void finish() {
        if (out) add_tile_sums(tile, out);
        out = nullptr;
    }
};

// Sums a tile and its mirror image, with sources and targets exchanged.
template <Quantity Q>
inline void sum_mirrored(const Share& share, const TileEntry& entry, TargetTile& targets, Tile& tile) {
    const int begin = entry.column_begin, end = begin + entry.row_end - entry.row_begin;
    Real* const out = share.sums_at<Q>(entry.split, entry.row_begin);
    Real* const mirror_out = share.sums_at<Q>(entry.mirror_split, entry.row_begin + entry.source_begin - begin);
    if (targets.out != out) {
        targets.finish();
        targets.out = out;
        fill<Q>(targets.tile, share.sources, begin, end);
    }
    if (entry.source_begin == begin) return sum_all_pairs<Q, true>(share, targets.tile, targets.tile, nullptr);
    fill<Q>(tile, share.sources, entry.source_begin, entry.source_end);
    sum_all_pairs<Q, true>(share, targets.tile, tile, nullptr);
    add_tile_sums(tile, mirror_out);
}

// Sums a tile for its targets only, in nearly equal parts of its sources.
template <Quantity Q>
inline void sum_sources(const Share& share, const TileEntry& entry, TargetTile& targets, Tile& tile) {
    targets.finish();
    const int begin = entry.column_begin, end = begin + entry.row_end - entry.row_begin;
    const int count = entry.source_end - entry.source_begin, parts = (count + TILE_SIZE - 1) / TILE_SIZE;
    for (int first = entry.source_begin; first < entry.source_end; first += tile.count) {
        const int chunks = (count + CHUNK * parts - 1) / (CHUNK * parts), left = entry.source_end - first;
        fill<Q>(tile, share.sources, first, first + (CHUNK * chunks < left ? CHUNK * chunks : left));
        for (int i = begin; i < end; i += TILE_SIZE) {
            fill<Q>(targets.tile, share.targets, i, i + TILE_SIZE < end ? i + TILE_SIZE : end);
            Real* const out = share.sums_at<Q>(entry.split, entry.row_begin + i - begin);
            sum_all_pairs<Q, false>(share, targets.tile, tile, out);
        }
    }
}

template <Quantity Q> inline void sum_share(const Share& share) {
    for (const TileEntry* entry = share.begin; entry < share.end; ++entry) {
        const auto clear = [&](int part, int row, int rows) {
            __builtin_memset(share.sums_at<Q>(part, row), 0, rows * width(Q) * sizeof(Real));
        };
        clear(entry->split, entry->row_begin, entry->row_end - entry->row_begin);
        if (!entry->mirrored) continue;
        const int mirror_begin = entry->row_begin + entry->source_begin - entry->column_begin;
        clear(entry->mirror_split, mirror_begin, entry->source_end - entry->source_begin);
    }
    Tile tile;
    TargetTile targets;
    for (const TileEntry* entry = share.begin; entry < share.end; ++entry) {
        if (entry->row_begin == entry->row_end) continue; // of a world that rests
        if (entry->mirrored) {
            if constexpr (MUTUAL<Q>) sum_mirrored<Q>(share, *entry, targets, tile);
        } else {
            sum_sources<ONE_SIDED<Q>>(share, *entry, targets, tile);
        }
    }
    targets.finish();
}

// Sums all tiles of ``Arrays``, the struct of work_list.py.
template <Quantity Q, class Arrays> inline void sum_tiles(const Arrays& arrays, int threads, Word* team) {
    const TileEntry* const tiles = (const TileEntry*)arrays.tiles.data;
    const int* const shares = arrays.shares.data; // first tile of each share
    share_items(team, threads, (int)arrays.shares.shape[0] - 1, 1, [&](int s) {
        sum_share<Q>({arrays.targets, arrays.sources, arrays.effective, tiles + shares[s], tiles + shares[s + 1],
                      arrays.partial.data, (size_t)arrays.partial.shape[1]});
    });
}

}
