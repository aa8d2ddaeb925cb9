// Neighbor search on a GPU: a hash table with a linked list of sources in each bucket. A warp lists the neighbors of a
// target, one thread for each of the 27 cells around it. The warp then sorts the list, so that the result does not
// depend on the order of threads.
//
// The table is never cleared: each entry has the number of its search, and entries of older searches are ignored.
#pragma once
#include "pairs/neighbor_cells.h"
#include "pairs/overlaps.h"

#if defined(__CUDA_ARCH__)
namespace warpmag {

typedef unsigned long long Entry; // number of a search (upper half) and a source (lower half)

template <class Lists> __device__ inline Cell* cells_of(const Lists& lists) { return (Cell*)lists.cell.data; }

// Last source that a search put into a bucket, −1 if none.
__device__ inline int last_of(Entry entry, int search) {
    return (int)(entry >> 32) == search ? (int)(unsigned)entry : -1;
}

// Puts source j into the list of its bucket if a moment has moved too far since the last search.
template <class Lists> __device__ inline void fill_table(int j, const Lists& targets, const Lists& sources) {
    const int search = targets.moved.data[0] ? sources.searches.data[0] + 1 : 0;
    if (j == 0) targets.searching.data[0] = search;
    if (search == 0 || j >= sources.packed.shape[1]) return;
    const Cell cell = cell_of(balls_of(sources), j, sources.group.data[j], cells_per_meter_of(targets));
    cells_of(sources)[j] = cell;
    if (cell.group < 0) return;
    Entry* const last = (Entry*)sources.table.data + bucket_of(cell, sources.table.shape[0]);
    sources.before.data[j] = last_of(atomicExch(last, (Entry)search << 32 | (unsigned)j), search);
}

// Lists the neighbors of target ``thread / 32`` in ascending order: the rank of an entry is the number of smaller ones.
template <class Lists> __device__ inline void list_neighbors(int thread, const Lists& targets, const Lists& sources) {
    const int search = targets.searching.data[0], i = thread / 32, c = thread % 32;
    if (search == 0) return;
    if (thread == 0) targets.moved.data[0] = 0, sources.searches.data[0] = search;
    if (targets.group.data[i] < 0) return;
    __shared__ int lists[BLOCK / 32][CAPACITY], counts[BLOCK / 32];
    int* const list = lists[threadIdx.x / 32];
    int& neighbors = counts[threadIdx.x / 32];
    __syncwarp(); // a thread may list several targets, one after the other
    if (c == 0) neighbors = 0;
    __syncwarp();
    const bool same = targets.count.data == sources.count.data;
    const int own_body = same ? targets.body.data[i] : -1;
    const Balls own = balls_of(targets), others = balls_of(sources);
    const Real x = own.x[i], y = own.y[i], z = own.z[i], radius = own.radius[i], ratio = (Real)targets.ratio;
    Cell near_cell = same ? cells_of(sources)[i] : cell_of(own, i, targets.group.data[i], cells_per_meter_of(targets));
    if (near_cell.group >= 0 && c < 27) {
        near_cell = {near_cell.x + c / 9 - 1, near_cell.y + c / 3 % 3 - 1, near_cell.z + c % 3 - 1, near_cell.group};
        int j = last_of(sources.table.data[bucket_of(near_cell, sources.table.shape[0])], search);
        for (; j >= 0; j = sources.before.data[j]) {
            const Cell cell = cells_of(sources)[j]; // a bucket may hold several cells
            if (cell.x != near_cell.x || cell.y != near_cell.y || cell.z != near_cell.z
                || cell.group != near_cell.group)
                continue;
            const Vector r = {x - others.x[j], y - others.y[j], z - others.z[j]};
            const Real reach = ratio * (radius + others.radius[j]);
            if (!(dot(r, r) < reach * reach) || (same && sources.body.data[j] == own_body)) continue;
            const int slot = atomicAdd(&neighbors, 1);
            if (slot < CAPACITY) list[slot] = j;
        }
    }
    __syncwarp();
    const int count = neighbors < CAPACITY ? neighbors : CAPACITY;
    for (int e = c; e < count; e += 32) {
        int rank = 0;
        for (int n = 0; n < count; ++n) rank += list[n] < list[e];
        targets.neighbor.data[(size_t)CAPACITY * i + rank] = list[e];
    }
    if (c > 0) return;
    targets.count.data[i] = neighbors;
    Real* const found_at = (Real*)targets.found_at.data + 3 * (size_t)i;
    found_at[0] = x, found_at[1] = y, found_at[2] = z;
}
}
#endif
