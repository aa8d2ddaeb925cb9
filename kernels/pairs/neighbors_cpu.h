// Neighbor search on a CPU: a vector of candidates at a time, by several threads.
//
// A counting sort orders the sources by bucket. The candidates of a target are in nine columns of three cells each, and
// a column is contiguous in memory. Sources of other cells in the same buckets are skipped by comparing cell columns.
#pragma once
#include "pairs/neighbor_cells.h"
#include "pairs/overlaps.h"
#include "shared/team.h"

namespace warpmag {

constexpr int TARGETS = 64;        // targets that a thread takes at a time
constexpr int LONGEST_RANKED = 64; // entries up to which ranks take less time than a sort

// Sources in the order of their buckets: index, body, column, group, position and radius. ``begin[b]`` is the first
// source of bucket b. ``bucket`` has the bucket of each source, or −1, in the original order of sources.
struct SortedSources {
    int buckets, pitch, *begin, *index;
    Real* x;
    int *body = index + pitch, *column_x = body + pitch, *column_y = column_x + pitch, *group = column_y + pitch,
        *bucket = group + pitch;
    Real *y = x + pitch, *z = y + pitch, *radius = z + pitch;
};

template <class Lists> inline SortedSources sort_sources(const Lists& sources, double cells_per_meter) {
    const SortedSources s = {sources.bucket.shape[0] - 1, sources.entries.shape[1], sources.bucket.data,
                             sources.entries.data, (Real*)sources.balls.data};
    const Balls balls = balls_of(sources);
    const int count = sources.packed.shape[1];
    __builtin_memset(s.begin, 0, (s.buckets + 1) * sizeof(int));
    for (int j = 0; j < count; ++j) {
        const Cell cell = cell_of(balls, j, sources.group.data[j], cells_per_meter);
        s.bucket[j] = cell.group >= 0 ? bucket_of(cell, s.buckets) : -1;
        if (s.bucket[j] >= 0) ++s.begin[s.bucket[j]];
    }
    for (int b = 0; b < s.buckets; ++b) s.begin[b + 1] += s.begin[b]; // end of each bucket
    for (int j = count - 1; j >= 0; --j) {
        if (s.bucket[j] < 0) continue;
        const Cell cell = cell_of(balls, j, sources.group.data[j], cells_per_meter);
        const int e = --s.begin[s.bucket[j]];
        s.index[e] = j, s.body[e] = sources.body.data[j];
        s.column_x[e] = cell.x, s.column_y[e] = cell.y, s.group[e] = cell.group;
        s.x[e] = balls.x[j], s.y[e] = balls.y[j], s.z[e] = balls.z[j], s.radius[e] = balls.radius[j];
    }
    return s;
}

struct Target {
    Real x, y, z, radius, ratio;
    int body; // body whose sources are not neighbors, −1 for none
};

// Appends the sources ``begin`` to ``end`` of a column that are near a target to a list, which keeps the first
// CAPACITY. Returns the new count.
inline int find_in_run(const SortedSources& s, const Target& t, Cell column, int begin, int end, int* list, int count) {
    for (int e = begin; e < end; e += WIDTH) {
        const Vector r = {t.x - numbers(s.x + e), t.y - numbers(s.y + e), t.z - numbers(s.z + e)};
        const Number reach = t.ratio * (t.radius + numbers(s.radius + e));
        const Index j = indices(s.index + e);
        const auto near = __builtin_convertvector(dot(r, r) < reach * reach, Index) & (lanes() < end - e)
                          & (indices(s.body + e) != t.body) & (indices(s.column_x + e) == column.x)
                          & (indices(s.column_y + e) == column.y) & (indices(s.group + e) == column.group);
        count += append(list + (count < CAPACITY ? count : CAPACITY), j, near);
    }
    return count;
}

// Lists the neighbors of a target in its cell and the 26 cells around it; returns their number.
inline int find_around(const SortedSources& s, const Target& t, Cell cell, int* list) {
    int count = 0;
    for (int c = 0; c < 9 && cell.group >= 0; ++c) {
        const Cell column = {cell.x + c / 3 - 1, cell.y + c % 3 - 1, cell.z - 1, cell.group};
        const int b = bucket_of(column, s.buckets);
        const int run = b + 3 <= s.buckets ? 3 : 1; // a column may wrap around to the first buckets
        for (int k = b; k < b + 3; k += run) {
            const int* const begin = s.begin + (k & (s.buckets - 1));
            count = find_in_run(s, t, column, begin[0], begin[run], list, count);
        }
    }
    return count;
}

// Writes a short list in ascending order: the rank of an entry is the number of smaller entries.
inline void write_ranked(int* list, int count, int* out) {
    const int vectors = (count + WIDTH - 1) / WIDTH;
    put_indices(list + count, Index(__INT_MAX__));
    for (int k = 0; k < count; ++k) {
        int rank = 0;
        for (int v = 0; v < vectors; ++v) rank += __builtin_popcount(bits_of(indices(list + WIDTH * v) < list[k]));
        out[rank] = list[k];
    }
}

// Writes a long list of indices below ``end`` in ascending order: sorts by digits of six bits. Overwrites the list.
inline void write_sorted(int* list, int count, int end, int* out) {
    int buffer[CAPACITY], *other = buffer;
    for (int shift = 0; (end - 1) >> shift > 0; shift += 6) {
        int begin[65] = {};
        for (int k = 0; k < count; ++k) ++begin[(list[k] >> shift & 63) + 1];
        for (int digit = 0; digit < 64; ++digit) begin[digit + 1] += begin[digit];
        for (int k = 0; k < count; ++k) other[begin[list[k] >> shift & 63]++] = list[k];
        int* const sorted = other;
        other = list, list = sorted;
    }
    for (int k = 0; k < count; ++k) out[k] = list[k];
}

// Rebuilds the neighbor lists if a moment has moved too far.
template <class Lists>
inline void search_neighbors(const Lists& targets, const Lists& sources, int threads, Word* team) {
    targets.searching.data[0] = targets.moved.data[0];
    if (targets.moved.data[0] == 0) return;
    targets.moved.data[0] = 0;
    const double cells_per_meter = cells_per_meter_of(targets);
    const SortedSources sorted = sort_sources(sources, cells_per_meter);
    const Balls balls = balls_of(targets);
    const bool same = targets.count.data == sources.count.data;
    share_items(team, threads, targets.packed.shape[1], TARGETS, [&](int i) {
        int list[CAPACITY + WIDTH];
        const Target target = {balls.x[i],      balls.y[i],          balls.z[i],
                               balls.radius[i], (Real)targets.ratio, same ? targets.body.data[i] : -1};
        const int count = find_around(sorted, target, cell_of(balls, i, targets.group.data[i], cells_per_meter), list);
        int* const out = targets.neighbor.data + (size_t)CAPACITY * i;
        const int listed = count < CAPACITY ? count : CAPACITY;
        if (listed > LONGEST_RANKED) write_sorted(list, listed, sources.packed.shape[1], out);
        else write_ranked(list, listed, out);
        targets.count.data[i] = count;
        Real* const found_at = (Real*)targets.found_at.data + 3 * i;
        found_at[0] = target.x, found_at[1] = target.y, found_at[2] = target.z;
    });
}

template <class Lists>
inline void list_overlaps_of_all(const Lists& targets, const Lists& sources, int threads, Word* team) {
    share_items(team, threads, targets.packed.shape[1], TARGETS, [&](int i) { list_overlaps(targets, sources, i); });
}
}
