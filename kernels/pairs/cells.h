// Cells of the neighbour search and their hash table; how its moments are read and its lists are written.
//
// From Python: CAPACITY, the entries that a list has room for, and GROUP, the threads of a GPU that share a target.
#pragma once
#include "shared/group.h"
#include "shared/vectors.h"

namespace warpmag {

constexpr double FARTHEST_CELL = 1e9; // from the origin; beyond it a cell would be no integer

struct alignas(16) Cell {
    int x, y, z, group; // −1: the moment has no cell
};

// Positions [m] and radii [m] of packed moments.
struct Balls {
    const Real *x, *y, *z, *radius;
};

template <class Lists> CUDA_CALLABLE inline Balls balls_of(const Lists& lists) {
    const Real* const x = (const Real*)lists.packed.data;
    const size_t pitch = lists.packed.strides[0] / sizeof(Real);
    return {x, x + pitch, x + 2 * pitch, x + 3 * pitch};
}

// Cell of a moment of some group.
CUDA_CALLABLE inline Cell cell_of(const Balls& balls, int i, int group, double cells_per_meter) {
    const double place[3] = {balls.x[i] * cells_per_meter, balls.y[i] * cells_per_meter, balls.z[i] * cells_per_meter};
    int cell[3];
    for (int c = 0; c < 3; ++c) {
        if (!(place[c] < FARTHEST_CELL && -place[c] < FARTHEST_CELL)) return {0, 0, 0, -1};
        cell[c] = (int)place[c];
        cell[c] -= cell[c] > place[c];
    }
    return {cell[0], cell[1], cell[2], group};
}

// Bucket of a cell among 2ᵏ, after Teschner et al. 2003; cells above one another have buckets that follow each other.
CUDA_CALLABLE inline int bucket_of(Cell cell, int buckets) {
    unsigned mixed = (unsigned)cell.x * 73856093u ^ (unsigned)cell.y * 19349663u ^ (unsigned)cell.group * 49979687u;
    mixed = (mixed ^ mixed >> 15) * 0x2c1b3c6du;
    return (int)(((mixed ^ mixed >> 16) + (unsigned)cell.z) & (unsigned)(buckets - 1));
}

// append(list, j, wanted) writes those indices of a vector, or of a group's threads, that are wanted to a list, and
// returns how many they are. On a CPU it writes WIDTH entries, and has no branches, which could not be predicted.
#if defined(__CUDA_ARCH__)
CUDA_CALLABLE inline Index lanes() { return 0; }

CUDA_CALLABLE inline int append(int* list, Index j, bool wanted) {
    const unsigned all = __ballot_sync(group_mask(), wanted);
    if (wanted) list[__popc(all & ((1u << threadIdx.x % 32) - 1u))] = j;
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
    const Bits wanted = __builtin_convertvector(mask, Bits);
    unsigned bits = 0;
    __builtin_memcpy(&bits, &wanted, WIDTH / 8);
    return bits;
}

template <class Places, class Lanes> inline int append(int* list, Places j, Lanes wanted) {
#if defined(__AVX512F__)
    if constexpr (WIDTH == 16) {
        const unsigned short bits = (unsigned short)bits_of(wanted);
        put_indices(list, __builtin_ia32_compresssi512_mask(j, j, bits));
        return __builtin_popcount(bits);
    }
#endif
    int count = 0;
    for (int l = 0; l < WIDTH; ++l) {
        list[count] = j[l];
        count += wanted[l] != 0;
    }
    return count;
}
#endif

// Lists those of target i's neighbours that overlap it; of a full list only the count is passed on.
template <class Lists> CUDA_CALLABLE inline void list_overlaps(const Lists& targets, const Lists& sources, int i) {
    const Balls own = balls_of(targets), others = balls_of(sources);
    const int count = targets.count.data[i];
    const int* const neighbors = targets.neighbor.data + (size_t)CAPACITY * i;
    int* const overlap = targets.overlap.data + (size_t)CAPACITY * i;
#if defined(__CUDA_ARCH__)
    int* const list = overlap;
#else
    int list[CAPACITY + WIDTH]; // what lies behind belongs to other threads
#endif
    int found = 0;
    for (int begin = 0; begin < count && count <= CAPACITY; begin += SHARES * WIDTH) {
        const int first = begin + share();
        const auto listed = lanes() < count - first;
        const Index j = listed ? indices(neighbors + first) : Index(0);
        const Vector r = {own.x[i] - collect(others.x, j), own.y[i] - collect(others.y, j),
                          own.z[i] - collect(others.z, j)};
        const Number contact = own.radius[i] + collect(others.radius, j);
        found += append(list + found, j, (dot(r, r) < contact * contact) & mask_of(listed));
    }
#if !defined(__CUDA_ARCH__)
    __builtin_memcpy(overlap, list, found * sizeof(int));
#endif
    if (share() == 0) targets.overlap_count.data[i] = count <= CAPACITY ? found : count;
}
}
