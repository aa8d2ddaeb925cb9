// The neighbour search on a GPU: a hash table with a linked list of sources in each bucket, and a thread for each
// target and each of the 27 cells around it. The lists of neighbours are then sorted, so that the order in which
// threads came does not show.
#pragma once
#include "pairs/cells.h"
#include "pairs/overlaps.h"

#if defined(__CUDA_ARCH__)
namespace warpmag {

template <class Lists> __device__ inline Cell* cells_of(const Lists& lists) { return (Cell*)lists.cell.data; }

// Empties the hash table and the lists if moments have moved too far.
template <class Lists> __device__ inline void empty_table(int thread, const Lists& targets, const Lists& sources) {
    const int moved = targets.moved.data[0];
    if (thread == 0) targets.searching.data[0] = moved;
    if (moved == 0) return;
    if (thread < sources.bucket.shape[0]) sources.bucket.data[thread] = -1;
    if (thread < targets.count.shape[0]) targets.count.data[thread] = 0;
}

// Puts source j into the list of its bucket.
template <class Lists>
__device__ inline void fill_table(int j, const Lists& targets, const Lists& sources, double cells_per_meter) {
    if (j == 0) targets.moved.data[0] = 0;
    if (targets.searching.data[0] == 0) return;
    const Cell cell = cell_of(balls_of(sources), j, sources.group.data[j], cells_per_meter);
    cells_of(sources)[j] = cell;
    if (cell.group < 0) return;
    int* const last = sources.bucket.data + bucket_of(cell, sources.bucket.shape[0] - 1);
    sources.before.data[j] = atomicExch(last, j);
}

// Appends the neighbours of a target that are in one of the cells around it to its list.
template <class Lists>
__device__ inline void search_cell(int thread, const Lists& targets, const Lists& sources, double cells_per_meter) {
    if (targets.searching.data[0] == 0) return;
    const int count = targets.packed.shape[1], i = thread % count, c = thread / count;
    const bool same = targets.count.data == sources.count.data;
    const Balls own = balls_of(targets), others = balls_of(sources);
    Cell sought = same ? cells_of(sources)[i] : cell_of(own, i, targets.group.data[i], cells_per_meter);
    if (sought.group < 0) return;
    sought = {sought.x + c / 9 - 1, sought.y + c / 3 % 3 - 1, sought.z + c % 3 - 1, sought.group};
    const Real x = own.x[i], y = own.y[i], z = own.z[i], radius = own.radius[i], ratio = (Real)targets.ratio;
    int j = sources.bucket.data[bucket_of(sought, sources.bucket.shape[0] - 1)];
    for (; j >= 0; j = sources.before.data[j]) {
        const Cell cell = cells_of(sources)[j]; // a bucket may hold several cells
        if (cell.x != sought.x || cell.y != sought.y || cell.z != sought.z || cell.group != sought.group) continue;
        if (same && i == j) continue;
        const Vector r = {x - others.x[j], y - others.y[j], z - others.z[j]};
        const Real reach = ratio * (radius + others.radius[j]);
        if (!(dot(r, r) < reach * reach)) continue;
        const int place = atomicAdd(targets.count.data + i, 1);
        if (place < CAPACITY) targets.neighbor.data[(size_t)CAPACITY * i + place] = j;
    }
}

// Sorts a target's list by the threads of a warp: each entry comes behind as many as are smaller.
template <class Lists> __device__ inline void sort_list(int thread, const Lists& targets) {
    if (targets.searching.data[0] == 0) return;
    constexpr int ENTRIES = (CAPACITY + 31) / 32; // of a thread
    const int i = thread / 32, lane = thread % 32, found = targets.count.data[i];
    const int count = found < CAPACITY ? found : CAPACITY;
    int* const list = targets.neighbor.data + (size_t)CAPACITY * i;
    const Balls balls = balls_of(targets);
    Real* const found_at = (Real*)targets.found_at.data + 3 * (size_t)i;
    if (lane == 0) found_at[0] = balls.x[i], found_at[1] = balls.y[i], found_at[2] = balls.z[i];
    int mine[ENTRIES], place[ENTRIES] = {};
    for (int e = 0; e < ENTRIES; ++e) mine[e] = 32 * e + lane < count ? list[32 * e + lane] : 0;
    for (int n = 0; n < count; ++n)
        for (int e = 0; e < ENTRIES; ++e) place[e] += list[n] < mine[e];
    __syncwarp();
    for (int e = 0; e < ENTRIES; ++e)
        if (32 * e + lane < count) list[place[e]] = mine[e];
}
}
#endif
