// All-pairs sums, field (Eq. 1) and force (Eqs. 4, 13 and 14), of a work list of tiles on a CPU: in vectors as wide as
// the machine has them, by several threads.
//
// A tile holds up to TILE_SIZE sources (from Python) in the first-level cache, and as many targets. There are two loops
// over its pairs:
//
// * add_rows sums a target at a time, whatever the radii.
// * add_both_ends is for the field and Kelvin's force among moments of one radius. It computes a separation and its
//   powers once for both ends of a pair: 35 vector operations for two fields, where add_rows takes 28 for one, and 46
//   for two forces, where it takes 37. Tiles that may hold moments of the same body do not have their forces that way.
//
// Threads take shares of the tiles, the largest first; one that starts late or is interrupted leaves more to the
// others. Each share has partial sums of its own, which the finishing kernel adds up in order, so that results do not
// depend on which thread took which share.
#pragma once
#include "pairs/pair_terms.h"
#include "shared/inverse_root.h"
#include "shared/team.h"

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

// Whether a pair may be summed for both its ends, and what is summed otherwise.
template <Quantity Q> constexpr bool MUTUAL = Q == Quantity::FIELD || Q == Quantity::MUTUAL_FORCE;
template <Quantity Q> constexpr Quantity ROWS = Q == Quantity::MUTUAL_FORCE ? Quantity::FORCE : Q;

inline Real total(Simd lanes) {
    Real sum = 0;
    for (int l = 0; l < LANES; ++l) sum += lanes[l];
    return sum;
}

inline Vec3<Real> total(const Vec3<Simd>& v) { return {total(v.x), total(v.y), total(v.z)}; }

inline Vec3<Simd> splat(const Vec3<Real>& v) { return {Simd(v.x), Simd(v.y), Simd(v.z)}; }

inline Real& number(Simd* row, int i) { return ((Real*)row)[i]; }

// Number i, and vector v, of three rows.
template <int N> inline Vec3<Real> numbers(Simd (*rows)[N], int i) {
    return {number(rows[0], i), number(rows[1], i), number(rows[2], i)};
}

template <int N> inline Vec3<Simd> vectors(Simd (*rows)[N], int v) { return {rows[0][v], rows[1][v], rows[2][v]}; }

// Rows of an array of packed moments, and of a tile, which has scaled moments, too.
enum Row { POSITION = 0, RADIUS = 3, MOMENT = 4, LABEL = 7, PACKED_ROWS, SCALED_MOMENT = PACKED_ROWS, TILE_ROWS = 11 };

struct Table {
    const Real* data;
    size_t stride;

    Table(const wp::array_t<Real>& rows) : data(rows.data), stride(rows.strides[0] / sizeof(Real)) {}

    const Real* row(int r) const { return data + r * stride; }

    Vec3<Real> vector(int r, int column) const { return {row(r)[column], row(r + 1)[column], row(r + 2)[column]}; }
};

// Tiles that one thread sums, and its partial sums, shape [row_count, width(Q)].
struct Share {
    Table targets, sources, effective;
    const TileEntry *begin, *end;
    Real* out;
    size_t row_count;
};

struct Tile {
    Simd rows[TILE_ROWS][VECTORS + 2]; // two vectors more than are summed, for a loop that reads ahead
    Simd sums[3][VECTORS];             // mirrored sums h at the sources themselves
    int begin = -1, count = 0, vectors = 0;
    Real radius; // the one radius of all moments, or 0
    Real lowest_label, highest_label;
    bool ascending; // whether labels ascend, so that no two moments are of one body

    Source<Simd> source(int v) {
        return {cpu::vectors(rows + POSITION, v), cpu::vectors(rows + MOMENT, v),
                cpu::vectors(rows + SCALED_MOMENT, v)};
    }
};

template <Quantity Q> __attribute__((noinline)) void fill(Tile& tile, const Table& table, int begin, int end) {
    tile.begin = begin;
    tile.count = end - begin;
    tile.vectors = (tile.count + LANES - 1) / LANES;
    for (int r = 0; r < PACKED_ROWS; ++r) {
        const Real* row = table.row(r) + begin;
        __builtin_memcpy(tile.rows[r], row, tile.count * sizeof(Real));
        // lanes beyond the last source have its position, and no moment
        const Real beyond = r >= MOMENT && r < LABEL ? 0 : row[tile.count - 1];
        for (int i = tile.count; i < (tile.vectors + 2) * LANES; ++i) number(tile.rows[r], i) = beyond;
    }
    constexpr Real SCALE = scaled_moment(Q);
    for (int c = 0; c < 3; ++c)
        for (int v = 0; v < tile.vectors; ++v) {
            tile.rows[SCALED_MOMENT + c][v] = SCALE * tile.rows[MOMENT + c][v];
            tile.sums[c][v] = 0;
        }
    const Real *radii = (const Real*)tile.rows[RADIUS], *labels = (const Real*)tile.rows[LABEL];
    bool equal = true;
    tile.lowest_label = tile.highest_label = labels[0];
    tile.ascending = true;
    for (int i = 1; i < tile.count; ++i) {
        equal &= radii[i] == radii[0];
        tile.ascending &= labels[i - 1] < labels[i];
        tile.lowest_label = tile.lowest_label < labels[i] ? tile.lowest_label : labels[i];
        tile.highest_label = tile.highest_label > labels[i] ? tile.highest_label : labels[i];
    }
    tile.radius = equal ? radii[0] : 0;
}

template <Quantity Q>
inline void add_results(const Share& share, int row, const Sums<Real>& sums, const Vec3<Real>& e = {}) {
    Real numbers[width(Q)];
    results<Q>(sums, e, numbers);
    for (int c = 0; c < width(Q); ++c) share.out[(size_t)row * width(Q) + c] += numbers[c];
}

// Adds the sources of a tile to target rows, of which the first is packed in column_begin.
template <Quantity Q>
__attribute__((noinline)) void add_rows(const Share& share, int row_begin, int row_end, int column_begin, Tile& tile) {
    const Table& targets = share.targets;
    const bool among_sources = Q == Quantity::FIELD && targets.data == share.sources.data;
    for (int row = row_begin; row < row_end; ++row) {
        const int column = column_begin + row - row_begin, own = column - tile.begin;
        // a moment's own field is left out: its moment is zero, and its label, while its row is summed
        const bool masked = among_sources && own >= 0 && own < tile.count;
        Real kept[TILE_ROWS];
        for (int r = MOMENT; r < TILE_ROWS && masked; ++r) {
            kept[r] = number(tile.rows[r], own);
            number(tile.rows[r], own) = 0;
        }
        const Vec3<Real> e = Q == Quantity::FIELD ? Vec3<Real>{} : share.effective.vector(0, column);
        const Vec3<Simd> x = splat(targets.vector(POSITION, column)), all_e = splat(e);
        const Real radius = targets.row(RADIUS)[column], label = targets.row(LABEL)[column];
        Sums<Simd> sums;
        for (int v = 0; v < tile.vectors; ++v) {
            const Source<Simd> source = tile.source(v);
            const Vec3<Simd> r = x - source.x;
            const Simd s = radius + tile.rows[RADIUS][v], s2 = s * s, d2 = dot(r, r), c = d2 > s2 ? d2 : s2;
            auto wanted = c > 0;
            if constexpr (Q != Quantity::FIELD) wanted &= label != tile.rows[LABEL][v];
            add_pair<Q>(sums, r, wanted ? twice_inverse_root(c) : 0, source, all_e);
        }
        add_results<Q>(share, row, {total(sums.f), total(sums.h), total(sums.g), total(sums.a)}, e);
        for (int r = MOMENT; r < TILE_ROWS && masked; ++r) number(tile.rows[r], own) = kept[r];
    }
}

// Targets of mirrored tiles that follow each other in the work list, and their partial sums in lanes.
struct TargetTile {
    Tile tile;
    Simd sums[3][TILE_SIZE];
    int row;
};

// Adds each pair of two tiles, or of a tile with itself, to the sums of both its ends. The loop is software pipelined,
// so that nothing waits for its inverse root: one vector of sources has its separations computed, the one before its
// roots, and the one before that is summed.
template <Quantity Q> __attribute__((noinline)) void add_both_ends(TargetTile& targets, Tile& sources) {
    struct Separation {
        Vec3<Simd> r;
        Simd c;
    };
    Tile& tile = targets.tile;
    const Simd contact = tile.radius + sources.radius, clamp = contact * contact;
    const bool diagonal = &tile == &sources;
    for (int i = 0; i < tile.count; ++i) {
        const Vec3<Simd> x = splat(numbers(tile.rows + POSITION, i)), m = splat(numbers(tile.rows + MOMENT, i));
        const Vec3<Simd> n = splat(numbers(tile.rows + SCALED_MOMENT, i));
        const auto separation = [&](int v) -> Separation {
            const Vec3<Simd> r = x - vectors(sources.rows + POSITION, v);
            const Simd d2 = dot(r, r);
            return {r, d2 > clamp ? d2 : clamp};
        };
        Vec3<Simd> h{};
        int v = 0;
        if (diagonal) {
            // pairs with earlier vectors are summed already; those within a vector are summed for each end apart
            v = i / LANES;
            auto others = clamp > 0;
            others[i % LANES] = 0;
            Vec3<Simd> unused{};
            const Separation s = separation(v);
            add_mirrored_pair<Q>(h, unused, s.r, others ? twice_inverse_root(s.c) : 0, sources.source(v), m, n);
            ++v;
        }
        Separation now = separation(v), next = separation(v + 1);
        Simd inv = twice_inverse_root(now.c);
        for (; v < sources.vectors; ++v) {
            const Separation later = separation(v + 2);
            const Simd next_inv = twice_inverse_root(next.c);
            Vec3<Simd> g = vectors(sources.sums, v);
            add_mirrored_pair<Q>(h, g, now.r, inv, sources.source(v), m, n);
            sources.sums[0][v] = g.x, sources.sums[1][v] = g.y, sources.sums[2][v] = g.z;
            now = next, next = later, inv = next_inv;
        }
        targets.sums[0][i] += h.x, targets.sums[1][i] += h.y, targets.sums[2][i] += h.z;
    }
}

template <Quantity Q> __attribute__((noinline)) void add_target_sums(const Share& share, TargetTile& targets) {
    for (int i = 0; i < targets.tile.count; ++i) {
        const auto& sums = targets.sums;
        const Vec3<Real> h = {total(sums[0][i]), total(sums[1][i]), total(sums[2][i])};
        add_results<Q>(share, targets.row + i, {.h = h + numbers(targets.tile.sums, i)});
    }
}

// Sums a tile for its targets, and the tile with sources and targets exchanged.
template <Quantity Q>
inline void sum_mirrored(const Share& share, const TileEntry& entry, TargetTile& targets, Tile& tile) {
    const int begin = entry.column_begin, end = begin + entry.row_end - entry.row_begin;
    const int mirror_begin = entry.row_begin + entry.source_begin - begin;
    if (targets.tile.begin != begin || targets.row != entry.row_begin) {
        if constexpr (MUTUAL<Q>) {
            add_target_sums<Q>(share, targets);
            __builtin_memset(targets.sums, 0, sizeof(targets.sums));
        }
        targets.row = entry.row_begin;
        fill<Q>(targets.tile, share.sources, begin, end);
    }
    const bool diagonal = entry.source_begin == begin;
    Tile &a = targets.tile, &b = diagonal ? a : tile;
    if (!diagonal) fill<Q>(b, share.sources, entry.source_begin, entry.source_end);
    if constexpr (MUTUAL<Q>) {
        const bool apart = a.highest_label < b.lowest_label || b.highest_label < a.lowest_label;
        const bool distinct = Q == Quantity::FIELD || (diagonal ? a.ascending : apart);
        if (share.targets.data == share.sources.data && a.radius > 0 && b.radius > 0 && distinct) {
            add_both_ends<Q>(targets, b);
            for (int j = 0; j < b.count && !diagonal; ++j)
                add_results<Q>(share, mirror_begin + j, {.h = numbers(b.sums, j)});
            return;
        }
    }
    add_rows<ROWS<Q>>(share, entry.row_begin, entry.row_end, begin, b);
    if (!diagonal) add_rows<ROWS<Q>>(share, mirror_begin, mirror_begin + b.count, entry.source_begin, a);
}

template <Quantity Q> inline void sum_share(const Share& share) {
    __builtin_memset(share.out, 0, share.row_count * width(Q) * sizeof(Real));
    Tile tile;
    TargetTile targets;
    for (const TileEntry* entry = share.begin; entry < share.end; ++entry) {
        if (entry->mirrored) {
            sum_mirrored<Q>(share, *entry, targets, tile);
        } else {
            fill<Q>(tile, share.sources, entry->source_begin, entry->source_end);
            add_rows<ROWS<Q>>(share, entry->row_begin, entry->row_end, entry->column_begin, tile);
        }
    }
    if constexpr (MUTUAL<Q>) add_target_sums<Q>(share, targets);
}

// Sums all tiles. Shape of partial_out: [shares, target rows, width(Q)]; shares has the tile that each begins with.
template <Quantity Q>
inline void sum_tiles(const wp::array_t<Real>& targets, const wp::array_t<Real>& sources,
                      const wp::array_t<Real>& effective, const wp::array_t<int>& tiles, const wp::array_t<int>& shares,
                      int threads, Word* team, const wp::array_t<Real>& partial_out) {
    const TileEntry* entries = (const TileEntry*)tiles.data;
    const size_t rows = partial_out.shape[1];
    share_out(team, threads, (int)shares.shape[0] - 1, 1, [&](int s) {
        sum_share<Q>({targets, sources, effective, entries + shares.data[s], entries + shares.data[s + 1],
                      partial_out.data + s * rows * width(Q), rows});
    });
}

}
