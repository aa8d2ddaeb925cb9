// Octree of moments: a cube around all moments is halved repeatedly, and each level lists its occupied boxes. octree.py
// describes the arrays.
//
// Moments are sorted along a Morton curve, on which every box is a contiguous range. Where two consecutive moments lie
// in different boxes, a new box starts at that level and at all finer levels. A prefix sum over these starts numbers
// the boxes. Then boxes are sorted by rows, x fastest, and moments with them.
#pragma once
#include "shared/arrival.h"
#include "shared/lanes.h"
#include "shared/team.h"

namespace warpmag {

typedef unsigned long long Bits;

constexpr int BLOCK = 256;                                   // moments of a thread block, as in octree.py
constexpr int CUBE_EDGE = 3, LEAF_EDGE = 4, TARGET_EDGE = 5; // indices into ``frame``, after the cube's corner

CUDA_CALLABLE inline int highest_bit(Bits bits) {
#if defined(__CUDA_ARCH__)
    return 63 - __clzll((long long)bits);
#else
    return 63 - __builtin_clzll(bits);
#endif
}

// The bits of x with two zeros inserted between neighbors (Morton code of one axis), and the inverse.
CUDA_CALLABLE inline Bits spread_bits(Bits x) {
    x = (x | x << 32) & 0x1f00000000ffffull;
    x = (x | x << 16) & 0x1f0000ff0000ffull;
    x = (x | x << 8) & 0x100f00f00f00f00full;
    x = (x | x << 4) & 0x10c30c30c30c30c3ull;
    return (x | x << 2) & 0x1249249249249249ull;
}
CUDA_CALLABLE inline Bits compact_bits(Bits x) {
    x &= 0x1249249249249249ull;
    x = (x | x >> 2) & 0x10c30c30c30c30c3ull;
    x = (x | x >> 4) & 0x100f00f00f00f00full;
    x = (x | x >> 8) & 0x1f0000ff0000ffull;
    x = (x | x >> 16) & 0x1f00000000ffffull;
    return (x | x >> 32) & 0x1fffffull;
}

// Index of a box: its height above the leaves, its world, and its position in the grid of its level.
struct BoxIndex {
    int height, world, x, y, z;
};
template <class Arrays> CUDA_CALLABLE inline Bits row_key(const Arrays& a, BoxIndex index) {
    const int d = a.depth;
    const Bits place = (Bits)index.z << 2 * d | (Bits)index.y << d | (Bits)index.x;
    return ((Bits)index.height << a.world_bits | (Bits)index.world) << 3 * d | place;
}
template <class Arrays> CUDA_CALLABLE inline BoxIndex box_index(const Arrays& a, Bits key) {
    const int d = a.depth;
    const Bits axis = (1ull << d) - 1, top = key >> 3 * d;
    return {(int)(top >> a.world_bits), (int)(top & ((1ull << a.world_bits) - 1)), (int)(key & axis),
            (int)(key >> d & axis), (int)(key >> 2 * d & axis)};
}

template <class Arrays> CUDA_CALLABLE inline int leaf_level(const Arrays& a) { return a.counts.data[0]; }
template <class Arrays> CUDA_CALLABLE inline int box_count(const Arrays& a) { return a.counts.data[1]; }
template <class Arrays> CUDA_CALLABLE inline int leaf_count(const Arrays& a) { return a.level_begin.data[1]; }
template <class Arrays> CUDA_CALLABLE inline int moment_count(const Arrays& a) { return a.split_level.shape[0]; }
template <class Arrays> CUDA_CALLABLE inline Real position(const Arrays& a, int axis, int i) {
    return a.packed.data[axis * (a.packed.strides[0] / sizeof(Real)) + i];
}

// First index from ``begin`` on whose key in ascending ``keys`` is at least ``key``.
template <class Key> CUDA_CALLABLE inline int lower_bound(const Key* keys, int begin, int end, Key key) {
    while (begin < end) {
        const int middle = begin + (end - begin) / 2;
        if (keys[middle] < key) begin = middle + 1;
        else end = middle;
    }
    return begin;
}

// Bounding box of positions.
struct Bounds {
    Real low[3], high[3];

    CUDA_CALLABLE void add(const Real* least, const Real* most, size_t stride) {
        for (int c = 0; c < 3; ++c) {
            const Real x = least[c * stride], y = most[c * stride];
            low[c] = x < low[c] ? x : low[c], high[c] = y > high[c] ? y : high[c];
        }
    }
};
// Union of the bounds of all threads of a block, returned to each of them.
#if defined(__CUDA_ARCH__)
CUDA_CALLABLE inline Bounds block_union(Bounds bounds) {
    __shared__ Bounds all[BLOCK];
    all[threadIdx.x] = bounds;
    for (int step = BLOCK / 2; step > 0; step /= 2) {
        __syncthreads();
        if (threadIdx.x >= step) continue;
        all[threadIdx.x].add(all[threadIdx.x + step].low, all[threadIdx.x + step].high, 1);
    }
    __syncthreads();
    return all[0];
}
CUDA_CALLABLE inline int first_lane() { return threadIdx.x; }
constexpr int STRIDE = BLOCK;
#else
inline Bounds block_union(const Bounds& bounds) { return bounds; }
inline int first_lane() { return 0; }
constexpr int STRIDE = 1;
#endif

// Writes the bounds of a block of moments.
template <class Arrays> CUDA_CALLABLE inline void bound_moments(const Arrays& a, int block) {
    const int begin = block * BLOCK, end = begin + BLOCK < moment_count(a) ? begin + BLOCK : moment_count(a);
    const size_t pitch = a.packed.strides[0] / sizeof(Real);
    Bounds bounds = {{position(a, 0, begin), position(a, 1, begin), position(a, 2, begin)},
                     {position(a, 0, begin), position(a, 1, begin), position(a, 2, begin)}};
    for (int i = begin + first_lane(); i < end; i += STRIDE) bounds.add(a.packed.data + i, a.packed.data + i, pitch);
    bounds = block_union(bounds);
    Real* const out = a.block_bounds.data + 6 * block;
    if (first_lane() == 0)
        for (int c = 0; c < 3; ++c) out[c] = bounds.low[c], out[3 + c] = bounds.high[c];
}

// Leaf edge that gives the target occupancy if moments fill their bounds uniformly. A flat extent counts as 1/64.
template <class Arrays>
CUDA_CALLABLE inline double estimated_edge(const Arrays& a, const double* extent, double largest) {
    double volume = 1;
    for (int c = 0; c < 3; ++c) volume *= extent[c] > largest / 64 ? extent[c] : largest / 64;
    return cbrt(volume * a.worlds * a.occupancy / moment_count(a));
}

// Writes the cube around all moments. Its edge is a power of two times the leaf edge that gives the target occupancy.
// Round 0 estimates that leaf edge from the volume of the bounds, round 1 from the occupancy measured in round 0.
template <class Arrays> CUDA_CALLABLE inline void set_frame(const Arrays& a, int round) {
    const Real* const blocks = a.block_bounds.data;
    Bounds bounds = {{blocks[0], blocks[1], blocks[2]}, {blocks[3], blocks[4], blocks[5]}};
    for (int b = first_lane(); b < (int)a.block_bounds.shape[0]; b += STRIDE)
        bounds.add(blocks + 6 * b, blocks + 6 * b + 3, 1);
    bounds = block_union(bounds);
    if (first_lane() > 0) return;
    double extent[3], largest = 0;
    for (int c = 0; c < 3; ++c) {
        extent[c] = (double)bounds.high[c] - bounds.low[c];
        largest = extent[c] > largest ? extent[c] : largest;
    }
    double edge = round == 0 ? estimated_edge(a, extent, largest) : a.frame.data[TARGET_EDGE];
    if (!(edge > 0)) edge = 1; // all moments coincide
    for (int level = 0; level < a.depth && edge <= 1.0001 * largest; ++level) edge *= 2;
    if (edge <= 1.0001 * largest) edge = 1.0001 * largest; // too few levels: leaves exceed the target size
    for (int c = 0; c < 3; ++c) a.frame.data[c] = bounds.low[c] - 0.5 * (edge - extent[c]);
    a.frame.data[CUBE_EDGE] = edge;
}

// Resets the entry of a box, so that it sorts behind all boxes in use.
template <class Arrays> CUDA_CALLABLE inline void clear_box(const Arrays& a, int box) {
    a.box_keys.data[box] = ~0ull;
    a.unsorted_box.data[box] = box;
    for (int o = 0; o < 8; ++o) a.children.data[8 * (size_t)box + o] = -1;
}

// Writes the Morton key of moment i, and resets the entry of box i.
template <class Arrays> CUDA_CALLABLE inline void set_key(const Arrays& a, int i) {
    if (i < a.capacity) clear_box(a, i);
    if (i >= moment_count(a)) return;
    const double* const frame = a.frame.data;
    const double per_meter = (double)(1ull << a.depth) / frame[CUBE_EDGE];
    Bits key = 0;
    for (int c = 0; c < 3; ++c) {
        const double at = ((double)position(a, c, i) - frame[c]) * per_meter, last = (double)((1ull << a.depth) - 1);
        key |= spread_bits((Bits)(at > 0 ? at < last ? at : last : 0)) << c; // NaN becomes 0
    }
    a.keys.data[i] = (Bits)a.group.data[i] << 3 * a.depth | key;
    a.index.data[i] = i;
}

// Coarsest level at which sorted moments i − 1 and i lie in different boxes; depth + 1 if there is none.
template <class Arrays> CUDA_CALLABLE inline int split_level_of(const Arrays& a, int i) {
    if (i == 0) return 0;
    const Bits differing = a.keys.data[i] ^ a.keys.data[i - 1];
    if (differing == 0) return a.depth + 1;
    const int level = a.depth - highest_bit(differing) / 3;
    return level > 0 ? level : 0;
}

// Counts the boxes that start in a block of moments, at each level.
template <class Arrays> CUDA_CALLABLE inline void count_box_starts(const Arrays& a, int block) {
    const int begin = block * BLOCK, end = begin + BLOCK < moment_count(a) ? begin + BLOCK : moment_count(a);
    int* const counts = a.box_starts.data + block * (a.depth + 1);
#if defined(__CUDA_ARCH__)
    const int i = begin + threadIdx.x, split_level = i < end ? split_level_of(a, i) : a.depth + 1;
    if (i < end) a.split_level.data[i] = split_level;
    for (int level = 0; level <= a.depth; ++level) {
        const int count = __syncthreads_count(split_level <= level);
        if (threadIdx.x == 0) counts[level] = count;
    }
#else
    for (int level = 0; level <= a.depth; ++level) counts[level] = 0;
    for (int i = begin; i < end; ++i) {
        const int split_level = a.split_level.data[i] = split_level_of(a, i);
        if (split_level <= a.depth) ++counts[split_level];
    }
    for (int level = 1; level <= a.depth; ++level) counts[level] += counts[level - 1];
#endif
}

// Replaces the counts of a level by their exclusive prefix sum over blocks, and returns their total: the boxes of the
// level. On a GPU a warp scans a level, and each lane takes four blocks at a time.
template <class Arrays> CUDA_CALLABLE inline int scan_level(const Arrays& a, int level) {
    constexpr int BATCH = 4;
    const int blocks = a.box_starts.shape[0], stride = a.depth + 1;
    int* const counts = a.box_starts.data + level;
    int total = 0;
#if defined(__CUDA_ARCH__)
    const int lane = threadIdx.x % 32;
    for (int first = BATCH * lane; first - BATCH * lane < blocks; first += 32 * BATCH) {
        int batch[BATCH], own = 0;
#pragma unroll
        for (int k = 0; k < BATCH; ++k) own += batch[k] = first + k < blocks ? counts[(first + k) * stride] : 0;
        int sum = own;
        for (int step = 1; step < 32; step *= 2) {
            const int other = __shfl_up_sync(~0u, sum, step);
            if (lane >= step) sum += other;
        }
        int before = total + sum - own;
#pragma unroll
        for (int k = 0; k < BATCH; ++k) {
            if (first + k < blocks) counts[(first + k) * stride] = before;
            before += batch[k];
        }
        total += __shfl_sync(~0u, sum, 31);
    }
#else
    for (int b = 0; b < blocks; ++b) {
        const int own = counts[b * stride];
        counts[b * stride] = total;
        total += own;
    }
#endif
    return total;
}

// Chooses the level of the leaves: the one whose occupancy is nearest to the target. Its boxes and all coarser ones
// must fit into the buffers. Leaves must not be smaller than ``reach``, so that touching moments are near neighbors.
template <class Arrays> CUDA_CALLABLE inline void choose_level(const Arrays& a, const int* totals) {
    int chosen = 0, sum = 0;
    double best = 1e30, size = a.frame.data[CUBE_EDGE];
    for (int level = 0; level <= a.depth; ++level, size /= 2) {
        sum += totals[level];
        if (level > 0 && (sum > a.capacity || size < a.reach)) break;
        const double ratio = (double)moment_count(a) / totals[level] / a.occupancy;
        const double mismatch = ratio > 1 ? ratio : 1 / ratio;
        if (mismatch < best) best = mismatch, chosen = level;
    }
    int begin = 0;
    for (int height = 0; height <= a.depth + 1; ++height) {
        a.level_begin.data[height] = begin;
        if (height <= chosen) begin += totals[chosen - height];
    }
    a.counts.data[0] = chosen, a.counts.data[1] = begin;
    double edge = a.frame.data[CUBE_EDGE];
    for (int level = 0; level < chosen; ++level) edge /= 2;
    a.frame.data[LEAF_EDGE] = edge;
    // The number of boxes scales as edge^−power; two levels give the power.
    const double ratio = (double)moment_count(a) / totals[chosen] / a.occupancy;
    const int other = ratio > 1 ? chosen + 1 : chosen - 1;
    double power = other < 0 || other > a.depth ? 3 : fabs(log2((double)totals[other] / totals[chosen]));
    power = power > 3 ? 3 : power < 1 ? 1 : power;
    const double target = edge * exp2(-log2(ratio) / power), least = 1.0001 * a.reach;
    a.frame.data[TARGET_EDGE] = target > least ? target : least;
}

// Scans all levels, and chooses the level of the leaves.
template <class Arrays> CUDA_CALLABLE inline void choose_leaves(const Arrays& a) {
#if defined(__CUDA_ARCH__)
    __shared__ int totals[32];
    for (int level = threadIdx.x / 32; level <= a.depth; level += blockDim.x / 32) {
        const int total = scan_level(a, level);
        if (threadIdx.x % 32 == 0) totals[level] = total;
    }
    __syncthreads();
    if (threadIdx.x == 0) choose_level(a, totals);
    __syncthreads();
#else
    int totals[32];
    for (int level = 0; level <= a.depth; ++level) totals[level] = scan_level(a, level);
    choose_level(a, totals);
#endif
}

// Writes the ``rank``-th box of a level, which starts at sorted moment i; ``above`` is the rank of its parent.
template <class Arrays> CUDA_CALLABLE inline void write_box(const Arrays& a, int i, int level, int rank, int above) {
    const int height = leaf_level(a) - level, box = a.level_begin.data[height] + rank - 1;
    const Bits key = a.keys.data[i], place = key >> 3 * (a.depth - level);
    const Bits axes = level == 0 ? 0 : place & ((1ull << 3 * level) - 1);
    const int world = (int)(key >> 3 * a.depth);
    const BoxIndex index = {height, world, (int)compact_bits(axes), (int)compact_bits(axes >> 1),
                            (int)compact_bits(axes >> 2)};
    a.box_keys.data[box] = row_key(a, index);
    a.first_moment.data[box] = i;
    a.unsorted_parent.data[box] = level > 0 ? a.level_begin.data[height + 1] + above - 1 : -1;
}

// Writes all boxes that start in a block of moments.
template <class Arrays> CUDA_CALLABLE inline void write_boxes(const Arrays& a, int block) {
    const int begin = block * BLOCK, end = begin + BLOCK < moment_count(a) ? begin + BLOCK : moment_count(a);
    const int* const before = a.box_starts.data + block * (a.depth + 1);
    const int leaf = leaf_level(a);
#if defined(__CUDA_ARCH__)
    __shared__ int warps[BLOCK / 32];
    const int i = begin + threadIdx.x, split_level = i < end ? a.split_level.data[i] : a.depth + 1;
    const unsigned up_to_lane = ~0u >> (31 - threadIdx.x % 32);
    for (int level = 0, above = 0; level <= leaf; ++level) {
        const unsigned votes = __ballot_sync(~0u, split_level <= level);
        __syncthreads();
        if (threadIdx.x % 32 == 0) warps[threadIdx.x / 32] = __popc(votes);
        __syncthreads();
        int rank = before[level] + __popc(votes & up_to_lane);
        for (int w = 0; w < threadIdx.x / 32; ++w) rank += warps[w];
        if (split_level <= level) write_box(a, i, level, rank, above);
        if (level == leaf && i < end) a.unsorted_leaf.data[i] = rank - 1;
        above = rank;
    }
#else
    int ranks[32];
    for (int level = 0; level <= leaf; ++level) ranks[level] = before[level];
    for (int i = begin; i < end; ++i) {
        for (int level = a.split_level.data[i]; level <= leaf; ++level)
            write_box(a, i, level, ++ranks[level], level > 0 ? ranks[level - 1] : 0);
        a.unsorted_leaf.data[i] = ranks[leaf] - 1;
    }
#endif
}

// Writes the inverse of the boxes' sort order, and the number of moments in each leaf.
template <class Arrays> CUDA_CALLABLE inline void invert_order(const Arrays& a, int box) {
    int count = 0;
    if (box < box_count(a)) {
        const int before = a.unsorted_box.data[box], leaves = leaf_count(a);
        a.sorted_box.data[before] = box;
        if (box < leaves)
            count =
                (before + 1 < leaves ? a.first_moment.data[before + 1] : moment_count(a)) - a.first_moment.data[before];
    }
    a.moment_counts.data[box] = count;
}

// Lists the neighbors of a box. Neighbors along x follow each other in the sorted list.
template <class Arrays> CUDA_CALLABLE inline void find_neighbors(const Arrays& a, int box, BoxIndex index) {
    const int begin = a.level_begin.data[index.height], end = a.level_begin.data[index.height + 1];
    const int boxes_per_axis = 1 << (leaf_level(a) - index.height);
    int* const neighbors = a.neighbors.data + 27 * (size_t)box;
    for (int row = 0; row < 9; ++row) {
        BoxIndex near = {index.height, index.world, index.x > 0 ? index.x - 1 : 0, index.y + row % 3 - 1,
                         index.z + row / 3 - 1};
        int* const slots = neighbors + 3 * row;
        slots[0] = slots[1] = slots[2] = -1;
        if (near.y < 0 || near.z < 0 || near.y >= boxes_per_axis || near.z >= boxes_per_axis) continue;
        int next = lower_bound(a.box_keys.data, begin, end, row_key(a, near));
        for (; near.x <= index.x + 1 && near.x < boxes_per_axis && next < end; ++near.x)
            if (a.box_keys.data[next] == row_key(a, near)) slots[near.x - index.x + 1] = next++;
    }
}

// Links a box to its parent, its children and its neighbors, and writes its key by height and octant.
template <class Arrays> CUDA_CALLABLE inline void link_box(const Arrays& a, int box) {
    if (box >= box_count(a)) {
        a.parent.data[box] = -1;
        a.order_keys.data[box] = 255;
        return;
    }
    const BoxIndex index = box_index(a, a.box_keys.data[box]);
    const int above = a.unsorted_parent.data[a.unsorted_box.data[box]],
              parent = above < 0 ? -1 : a.sorted_box.data[above];
    const int octant = (index.x & 1) | (index.y & 1) << 1 | (index.z & 1) << 2;
    a.parent.data[box] = parent, a.octant.data[box] = octant;
    if (parent >= 0) a.children.data[8 * (size_t)parent + octant] = box;
    a.order_keys.data[box] = 8 * index.height + octant;
    a.order.data[box] = box;
    find_neighbors(a, box, index);
}

// Copies moment i into its leaf, and finds where the boxes of each height and octant begin in ``order``.
template <class Arrays> CUDA_CALLABLE inline void place_moment(const Arrays& a, int i) {
    if (i < 9 * (int)a.octant_begin.shape[0])
        a.octant_begin.data[i] = lower_bound(a.order_keys.data, 0, box_count(a), 8 * (i / 9) + i % 9);
    if (i >= moment_count(a)) return;
    const int before = a.unsorted_leaf.data[i], leaf = a.sorted_box.data[before], from = a.index.data[i];
    const int to = a.moment_begin.data[leaf] + i - a.first_moment.data[before];
    const size_t pitch = a.sorted.strides[0] / sizeof(Real), packed_pitch = a.packed.strides[0] / sizeof(Real);
    a.packed_index.data[to] = from, a.leaf.data[to] = leaf, a.sorted_index.data[from] = to;
    for (int row = 0; row < 8; ++row) a.sorted.data[row * pitch + to] = a.packed.data[row * packed_pitch + from];
    const BoxIndex index = box_index(a, a.box_keys.data[leaf]);
    const int place[3] = {index.x, index.y, index.z};
    for (int c = 0; c < 3; ++c) {
        const double center = a.frame.data[c] + (place[c] + 0.5) * a.frame.data[LEAF_EDGE];
        const double offset = ((double)position(a, c, from) - center) / a.frame.data[LEAF_EDGE];
        a.leaf_position.data[c * (a.leaf_position.strides[0] / sizeof(Real)) + to] = (Real)offset;
    }
}

// Passes of the build, in order; octree.py sorts between them.
enum class Pass { BOUND, KEYS, COUNT, WRITE, INVERT, LINK, PLACE };

template <Pass P, class Arrays> CUDA_CALLABLE inline void run_item(const Arrays& a, int i) {
    if constexpr (P == Pass::BOUND) bound_moments(a, i);
    else if constexpr (P == Pass::KEYS) set_key(a, i);
    else if constexpr (P == Pass::COUNT) count_box_starts(a, i);
    else if constexpr (P == Pass::WRITE) write_boxes(a, i);
    else if constexpr (P == Pass::INVERT) invert_order(a, i);
    else if constexpr (P == Pass::LINK) link_box(a, i);
    else place_moment(a, i);
}

// Passes that take one block of moments at a time, and passes that end with finish_pass.
template <Pass P> constexpr bool takes_blocks() { return P == Pass::BOUND || P == Pass::COUNT || P == Pass::WRITE; }
template <Pass P> constexpr bool has_last_step() { return P == Pass::BOUND || P == Pass::COUNT; }

// Work after all items of a pass; on a GPU by the last block.
template <Pass P, class Arrays> CUDA_CALLABLE inline void finish_pass(const Arrays& a, int round) {
    if (P == Pass::COUNT) choose_leaves(a);
    if (P == Pass::BOUND || round == 0) set_frame(a, P == Pass::BOUND ? 0 : 1);
}

// Runs one pass over ``count`` items. On a GPU a block of BLOCK threads takes one block of moments, or a thread one
// item.
template <Pass P, class Word, class Arrays>
CUDA_CALLABLE inline void build_octree(int thread, int count, int round, int threads, Word* team, const Arrays& a) {
#if defined(__CUDA_ARCH__)
    if (takes_blocks<P>()) run_item<P>(a, thread / BLOCK);
    else if (thread < count) run_item<P>(a, thread);
    if constexpr (has_last_step<P>())
        if (is_last_of(a.arrived.data, count)) finish_pass<P>(a, round);
#else
    share_items(team, threads, count, takes_blocks<P>() ? 8 : 8 * BLOCK, [&](int i) { run_item<P>(a, i); });
    if constexpr (has_last_step<P>()) finish_pass<P>(a, round);
#endif
}
}
