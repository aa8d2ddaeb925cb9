// Lists of the neighbors that overlap a moment.
//
// From Python: CAPACITY, the length of a list, and GROUP, the threads of a GPU that share a target.
#pragma once
#include "pairs/neighbor_cells.h"
#include "shared/group.h"
#include "shared/vectors.h"

namespace warpmag {

// append(list, j, active) writes the indices j of active lanes, or of active threads of a group, to a list, and returns
// their number. On a CPU it always writes WIDTH entries, since branches would be mispredicted.
#if defined(__CUDA_ARCH__)
CUDA_CALLABLE inline Index lanes() { return 0; }

CUDA_CALLABLE inline int append(int* list, Index j, bool active) {
    const unsigned all = __ballot_sync(group_mask(), active);
    if (active) list[__popc(all & ((1u << threadIdx.x % 32) - 1u))] = j;
    return __popc(all);
}
#else
inline Index lanes() {
    Index lanes;
    for (int l = 0; l < WIDTH; ++l) lanes[l] = l;
    return lanes;
}

template <class Lanes> inline unsigned bits_of(Lanes mask) {
    typedef bool Bits __attribute__((ext_vector_type(WIDTH)));
    const Bits active = __builtin_convertvector(mask, Bits);
    unsigned bits = 0;
    __builtin_memcpy(&bits, &active, WIDTH / 8);
    return bits;
}

template <class Places, class Lanes> inline int append(int* list, Places j, Lanes active) {
#if defined(__AVX512F__)
    if constexpr (WIDTH == 16) {
        const unsigned short bits = (unsigned short)bits_of(active);
        put_indices(list, __builtin_ia32_compresssi512_mask(j, j, bits));
        return __builtin_popcount(bits);
    }
#endif
    int count = 0;
    for (int l = 0; l < WIDTH; ++l) {
        list[count] = j[l];
        count += active[l] != 0;
    }
    return count;
}
#endif

// Lists the neighbors of target i that overlap it. If the list of neighbors is full, only its count is copied.
template <class Lists> CUDA_CALLABLE inline void list_overlaps(const Lists& targets, const Lists& sources, int i) {
    if (targets.group.data[i] < 0) return;
    const Balls own = balls_of(targets), others = balls_of(sources);
    const int count = targets.count.data[i];
    const int* const neighbors = targets.neighbor.data + (size_t)CAPACITY * i;
    int* const overlap = targets.overlap.data + (size_t)CAPACITY * i;
#if defined(__CUDA_ARCH__)
    int* const list = overlap;
#else
    int list[CAPACITY + WIDTH]; // a buffer: append() writes beyond the last entry, where another thread's list begins
#endif
    int overlapping = 0;
    for (int begin = 0; begin < count && count <= CAPACITY; begin += SHARES * WIDTH) {
        const int first = begin + share();
        const auto listed = lanes() < count - first;
        const Index j = listed ? indices(neighbors + first) : Index(0);
        const Vector r = {own.x[i] - collect(others.x, j), own.y[i] - collect(others.y, j),
                          own.z[i] - collect(others.z, j)};
        const Number contact = own.radius[i] + collect(others.radius, j);
        overlapping += append(list + overlapping, j, (dot(r, r) < contact * contact) & mask_of(listed));
    }
#if !defined(__CUDA_ARCH__)
    __builtin_memcpy(overlap, list, overlapping * sizeof(int));
#endif
    if (share() == 0) targets.overlap_count.data[i] = count <= CAPACITY ? overlapping : count;
}
}
