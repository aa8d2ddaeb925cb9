// Cells of moments: a cube around all of them is halved again and again, and of each level those cells that hold
// something are listed. grid.py says what the arrays are.
//
// Moments are sorted along a Morton curve, on which every cell of every level is a range. Where a moment and the one
// before it part, a cell begins at that level and at all finer ones: the ranks of those beginnings number the cells.
// Then cells are sorted by rows, x fastest, and moments with them.
#pragma once
#include "shared/arrival.h"
#include "shared/lanes.h"
#include "shared/team.h"

namespace warpmag {

typedef unsigned long long Bits;

constexpr int BLOCK = 256;                    // moments that a block of threads has, as in grid.py
constexpr int ROOT = 3, EDGE = 4, WANTED = 5; // places of numbers in ``frame``, after the corner of the cube

CUDA_CALLABLE inline int highest_bit(Bits bits) {
#if defined(__CUDA_ARCH__)
    return 63 - __clzll((long long)bits);
#else
    return 63 - __builtin_clzll(bits);
#endif
}

// Bits with two zeros between them, and back.
CUDA_CALLABLE inline Bits spread_bits(Bits x) {
    x = (x | x << 32) & 0x1f00000000ffffull;
    x = (x | x << 16) & 0x1f0000ff0000ffull;
    x = (x | x << 8) & 0x100f00f00f00f00full;
    x = (x | x << 4) & 0x10c30c30c30c30c3ull;
    return (x | x << 2) & 0x1249249249249249ull;
}
CUDA_CALLABLE inline Bits gathered_bits(Bits x) {
    x &= 0x1249249249249249ull;
    x = (x | x >> 2) & 0x10c30c30c30c30c3ull;
    x = (x | x >> 4) & 0x100f00f00f00f00full;
    x = (x | x >> 8) & 0x1f0000ff0000ffull;
    x = (x | x >> 16) & 0x1f00000000ffffull;
    return (x | x >> 32) & 0x1fffffull;
}

// Where a cell is: its height above the leaves, its world and its place in the grid of its level.
struct CellPlace {
    int height, world, x, y, z;
};
template <class Arrays> CUDA_CALLABLE inline Bits row_key(const Arrays& a, CellPlace at) {
    const int d = a.depth;
    const Bits place = (Bits)at.z << 2 * d | (Bits)at.y << d | (Bits)at.x;
    return ((Bits)at.height << a.world_bits | (Bits)at.world) << 3 * d | place;
}
template <class Arrays> CUDA_CALLABLE inline CellPlace place_of(const Arrays& a, Bits key) {
    const int d = a.depth;
    const Bits axis = (1ull << d) - 1, top = key >> 3 * d;
    return {(int)(top >> a.world_bits), (int)(top & ((1ull << a.world_bits) - 1)), (int)(key & axis),
            (int)(key >> d & axis), (int)(key >> 2 * d & axis)};
}

template <class Arrays> CUDA_CALLABLE inline int leaf_level(const Arrays& a) { return a.counts.data[0]; }
template <class Arrays> CUDA_CALLABLE inline int cell_count(const Arrays& a) { return a.counts.data[1]; }
template <class Arrays> CUDA_CALLABLE inline int leaf_count(const Arrays& a) { return a.level_begin.data[1]; }
template <class Arrays> CUDA_CALLABLE inline int moment_count(const Arrays& a) { return a.fork.shape[0]; }
template <class Arrays> CUDA_CALLABLE inline Real position(const Arrays& a, int axis, int i) {
    return a.packed.data[axis * (a.packed.strides[0] / sizeof(Real)) + i];
}

// First place in ascending ``keys`` from ``begin`` on that is not below a key.
template <class Key> CUDA_CALLABLE inline int lower_bound(const Key* keys, int begin, int end, Key key) {
    while (begin < end) {
        const int middle = begin + (end - begin) / 2;
        if (keys[middle] < key) begin = middle + 1;
        else end = middle;
    }
    return begin;
}

// Smallest and largest of some places along each axis; on a GPU of a block's threads, the same for all of them.
struct Box {
    Real low[3], high[3];

    CUDA_CALLABLE void add(const Real* least, const Real* most, size_t stride) {
        for (int c = 0; c < 3; ++c) {
            const Real x = least[c * stride], y = most[c * stride];
            low[c] = x < low[c] ? x : low[c], high[c] = y > high[c] ? y : high[c];
        }
    }
};
#if defined(__CUDA_ARCH__)
CUDA_CALLABLE inline Box joined(Box box) {
    __shared__ Box boxes[BLOCK];
    boxes[threadIdx.x] = box;
    for (int step = BLOCK / 2; step > 0; step /= 2) {
        __syncthreads();
        if (threadIdx.x >= step) continue;
        boxes[threadIdx.x].add(boxes[threadIdx.x + step].low, boxes[threadIdx.x + step].high, 1);
    }
    __syncthreads();
    return boxes[0];
}
CUDA_CALLABLE inline int first_item() { return threadIdx.x; }
constexpr int AT_ONCE = BLOCK;
#else
inline Box joined(const Box& box) { return box; }
inline int first_item() { return 0; }
constexpr int AT_ONCE = 1;
#endif

// The box around a block of moments.
template <class Arrays> CUDA_CALLABLE inline void bound_moments(const Arrays& a, int block) {
    const int begin = block * BLOCK, end = begin + BLOCK < moment_count(a) ? begin + BLOCK : moment_count(a);
    const size_t pitch = a.packed.strides[0] / sizeof(Real);
    Box box = {{position(a, 0, begin), position(a, 1, begin), position(a, 2, begin)},
               {position(a, 0, begin), position(a, 1, begin), position(a, 2, begin)}};
    for (int i = begin + first_item(); i < end; i += AT_ONCE) box.add(a.packed.data + i, a.packed.data + i, pitch);
    box = joined(box);
    Real* const out = a.boxes.data + 6 * block;
    if (first_item() == 0)
        for (int c = 0; c < 3; ++c) out[c] = box.low[c], out[3 + c] = box.high[c];
}

// Edge of a leaf that holds as many moments as wanted where they fill their box, which may be flat.
template <class Arrays> CUDA_CALLABLE inline double usual_edge(const Arrays& a, const double* size, double largest) {
    double volume = 1;
    for (int c = 0; c < 3; ++c) volume *= size[c] > largest / 64 ? size[c] : largest / 64;
    return cbrt(volume * a.worlds * a.occupancy / moment_count(a));
}

// The cube around all boxes: an edge is a power of two times that of the leaves that hold as many moments as wanted, by
// the volume of the box in the first round, by what leaves of other sizes hold in the second.
template <class Arrays> CUDA_CALLABLE inline void set_frame(const Arrays& a, int round) {
    const Real* const boxes = a.boxes.data;
    Box box = {{boxes[0], boxes[1], boxes[2]}, {boxes[3], boxes[4], boxes[5]}};
    for (int b = first_item(); b < (int)a.boxes.shape[0]; b += AT_ONCE) box.add(boxes + 6 * b, boxes + 6 * b + 3, 1);
    box = joined(box);
    if (first_item() > 0) return;
    double size[3], largest = 0;
    for (int c = 0; c < 3; ++c) {
        size[c] = (double)box.high[c] - box.low[c];
        largest = size[c] > largest ? size[c] : largest;
    }
    double root = round == 0 ? usual_edge(a, size, largest) : a.frame.data[WANTED];
    if (!(root > 0)) root = 1; // all moments at one place
    for (int level = 0; level < a.depth && root <= 1.0001 * largest; ++level) root *= 2;
    if (root <= 1.0001 * largest) root = 1.0001 * largest; // more levels than there are: leaves are larger than wanted
    for (int c = 0; c < 3; ++c) a.frame.data[c] = box.low[c] - 0.5 * (root - size[c]);
    a.frame.data[ROOT] = root;
}

// Makes a cell's entry one that is sorted behind all others.
template <class Arrays> CUDA_CALLABLE inline void clear_cell(const Arrays& a, int cell) {
    a.cell_keys.data[cell] = ~0ull;
    a.cell_before.data[cell] = cell;
    for (int o = 0; o < 8; ++o) a.children.data[8 * (size_t)cell + o] = -1;
}

// Key of a moment on the Morton curve of its world; and an entry for a cell.
template <class Arrays> CUDA_CALLABLE inline void set_key(const Arrays& a, int i) {
    if (i < a.capacity) clear_cell(a, i);
    if (i >= moment_count(a)) return;
    const double* const frame = a.frame.data;
    const double cells = (double)(1ull << a.depth) / frame[ROOT];
    Bits key = 0;
    for (int c = 0; c < 3; ++c) {
        const double at = ((double)position(a, c, i) - frame[c]) * cells, most = (double)((1ull << a.depth) - 1);
        key |= spread_bits((Bits)(at > 0 ? at < most ? at : most : 0)) << c; // 0 of what is no number, too
    }
    a.keys.data[i] = (Bits)a.group.data[i] << 3 * a.depth | key;
    a.index.data[i] = i;
}

// Coarsest level on which a sorted moment lies in another cell than the one before it.
template <class Arrays> CUDA_CALLABLE inline int fork_of(const Arrays& a, int i) {
    if (i == 0) return 0;
    const Bits differing = a.keys.data[i] ^ a.keys.data[i - 1];
    if (differing == 0) return a.depth + 1;
    const int level = a.depth - highest_bit(differing) / 3;
    return level > 0 ? level : 0;
}

// Numbers of cells that begin in a block of moments, for each level.
template <class Arrays> CUDA_CALLABLE inline void count_beginnings(const Arrays& a, int block) {
    const int begin = block * BLOCK, end = begin + BLOCK < moment_count(a) ? begin + BLOCK : moment_count(a);
    int* const counts = a.beginnings.data + block * (a.depth + 1);
#if defined(__CUDA_ARCH__)
    const int i = begin + threadIdx.x, fork = i < end ? fork_of(a, i) : a.depth + 1;
    if (i < end) a.fork.data[i] = fork;
    for (int level = 0; level <= a.depth; ++level) {
        const int count = __syncthreads_count(fork <= level);
        if (threadIdx.x == 0) counts[level] = count;
    }
#else
    for (int level = 0; level <= a.depth; ++level) counts[level] = 0;
    for (int i = begin; i < end; ++i) {
        const int fork = a.fork.data[i] = fork_of(a, i);
        if (fork <= a.depth) ++counts[fork];
    }
    for (int level = 1; level <= a.depth; ++level) counts[level] += counts[level - 1];
#endif
}

// Sums up the numbers of a level's cells before each block; returns how many cells the level has. On a GPU a warp has
// a level, and each lane four blocks at a time.
template <class Arrays> CUDA_CALLABLE inline int scan_level(const Arrays& a, int level) {
    constexpr int HELD = 4;
    const int blocks = a.beginnings.shape[0], stride = a.depth + 1;
    int* const counts = a.beginnings.data + level;
    int total = 0;
#if defined(__CUDA_ARCH__)
    const int lane = threadIdx.x % 32;
    for (int first = HELD * lane; first - HELD * lane < blocks; first += 32 * HELD) {
        int held[HELD], own = 0;
#pragma unroll
        for (int k = 0; k < HELD; ++k) own += held[k] = first + k < blocks ? counts[(first + k) * stride] : 0;
        int sum = own;
        for (int step = 1; step < 32; step *= 2) {
            const int other = __shfl_up_sync(~0u, sum, step);
            if (lane >= step) sum += other;
        }
        int before = total + sum - own;
#pragma unroll
        for (int k = 0; k < HELD; ++k) {
            if (first + k < blocks) counts[(first + k) * stride] = before;
            before += held[k];
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

// Chooses the leaves: of the levels whose cells, with those above, there is room for, and are not smaller than what
// touches, which must be near, the one whose cells hold most nearly what is wanted.
template <class Arrays> CUDA_CALLABLE inline void choose_level(const Arrays& a, const int* totals) {
    int chosen = 0, sum = 0;
    double best = 1e30, size = a.frame.data[ROOT];
    for (int level = 0; level <= a.depth; ++level, size /= 2) {
        sum += totals[level];
        if (level > 0 && (sum > a.capacity || size < a.reach)) break;
        const double held = (double)moment_count(a) / totals[level] / a.occupancy, off = held > 1 ? held : 1 / held;
        if (off < best) best = off, chosen = level;
    }
    int begin = 0;
    for (int height = 0; height <= a.depth + 1; ++height) {
        a.level_begin.data[height] = begin;
        if (height <= chosen) begin += totals[chosen - height];
    }
    a.counts.data[0] = chosen, a.counts.data[1] = begin;
    double edge = a.frame.data[ROOT];
    for (int level = 0; level < chosen; ++level) edge /= 2;
    a.frame.data[EDGE] = edge;
    // the number of cells is a power of their edge, which two levels tell
    const double ratio = (double)moment_count(a) / totals[chosen] / a.occupancy;
    const int other = ratio > 1 ? chosen + 1 : chosen - 1;
    double power = other < 0 || other > a.depth ? 3 : fabs(log2((double)totals[other] / totals[chosen]));
    power = power > 3 ? 3 : power < 1 ? 1 : power;
    const double wanted = edge * exp2(-log2(ratio) / power), least = 1.0001 * a.reach;
    a.frame.data[WANTED] = wanted > least ? wanted : least;
}

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

// Writes the cell of a level that begins with sorted moment i, the ``rank``-th; ``above`` is the rank of its parent.
template <class Arrays> CUDA_CALLABLE inline void write_cell(const Arrays& a, int i, int level, int rank, int above) {
    const int height = leaf_level(a) - level, cell = a.level_begin.data[height] + rank - 1;
    const Bits key = a.keys.data[i], place = key >> 3 * (a.depth - level);
    const Bits axes = level == 0 ? 0 : place & ((1ull << 3 * level) - 1);
    const int world = (int)(key >> 3 * a.depth);
    const CellPlace at = {height, world, (int)gathered_bits(axes), (int)gathered_bits(axes >> 1),
                          (int)gathered_bits(axes >> 2)};
    a.cell_keys.data[cell] = row_key(a, at);
    a.first.data[cell] = i;
    a.parent_before.data[cell] = level > 0 ? a.level_begin.data[height + 1] + above - 1 : -1;
}

// Writes all cells that begin in a block of moments.
template <class Arrays> CUDA_CALLABLE inline void write_cells(const Arrays& a, int block) {
    const int begin = block * BLOCK, end = begin + BLOCK < moment_count(a) ? begin + BLOCK : moment_count(a);
    const int* const before = a.beginnings.data + block * (a.depth + 1);
    const int leaf = leaf_level(a);
#if defined(__CUDA_ARCH__)
    __shared__ int warps[BLOCK / 32];
    const int i = begin + threadIdx.x, fork = i < end ? a.fork.data[i] : a.depth + 1;
    const unsigned up_to_me = ~0u >> (31 - threadIdx.x % 32);
    for (int level = 0, above = 0; level <= leaf; ++level) {
        const unsigned votes = __ballot_sync(~0u, fork <= level);
        __syncthreads();
        if (threadIdx.x % 32 == 0) warps[threadIdx.x / 32] = __popc(votes);
        __syncthreads();
        int rank = before[level] + __popc(votes & up_to_me);
        for (int w = 0; w < threadIdx.x / 32; ++w) rank += warps[w];
        if (fork <= level) write_cell(a, i, level, rank, above);
        if (level == leaf && i < end) a.leaf_before.data[i] = rank - 1;
        above = rank;
    }
#else
    int ranks[32];
    for (int level = 0; level <= leaf; ++level) ranks[level] = before[level];
    for (int i = begin; i < end; ++i) {
        for (int level = a.fork.data[i]; level <= leaf; ++level)
            write_cell(a, i, level, ++ranks[level], level > 0 ? ranks[level - 1] : 0);
        a.leaf_before.data[i] = ranks[leaf] - 1;
    }
#endif
}

// Notes where a cell went when cells were sorted, and how many moments a leaf has.
template <class Arrays> CUDA_CALLABLE inline void note_cell(const Arrays& a, int cell) {
    int held = 0;
    if (cell < cell_count(a)) {
        const int before = a.cell_before.data[cell], leaves = leaf_count(a);
        a.cell_after.data[before] = cell;
        if (cell < leaves)
            held = (before + 1 < leaves ? a.first.data[before + 1] : moment_count(a)) - a.first.data[before];
    }
    a.held.data[cell] = held;
}

// Lists the neighbours of a cell: those of a row follow each other.
template <class Arrays> CUDA_CALLABLE inline void find_neighbors(const Arrays& a, int cell, CellPlace at) {
    const int begin = a.level_begin.data[at.height], end = a.level_begin.data[at.height + 1];
    const int across = 1 << (leaf_level(a) - at.height);
    int* const neighbors = a.neighbors.data + 27 * (size_t)cell;
    for (int row = 0; row < 9; ++row) {
        CellPlace one = {at.height, at.world, at.x > 0 ? at.x - 1 : 0, at.y + row % 3 - 1, at.z + row / 3 - 1};
        int* const found = neighbors + 3 * row;
        found[0] = found[1] = found[2] = -1;
        if (one.y < 0 || one.z < 0 || one.y >= across || one.z >= across) continue;
        int next = lower_bound(a.cell_keys.data, begin, end, row_key(a, one));
        for (; one.x <= at.x + 1 && one.x < across && next < end; ++one.x)
            if (a.cell_keys.data[next] == row_key(a, one)) found[one.x - at.x + 1] = next++;
    }
}

template <class Arrays> CUDA_CALLABLE inline void link_cell(const Arrays& a, int cell) {
    if (cell >= cell_count(a)) {
        a.parent.data[cell] = -1;
        a.order_keys.data[cell] = 255;
        return;
    }
    const CellPlace at = place_of(a, a.cell_keys.data[cell]);
    const int above = a.parent_before.data[a.cell_before.data[cell]],
              parent = above < 0 ? -1 : a.cell_after.data[above];
    const int octant = (at.x & 1) | (at.y & 1) << 1 | (at.z & 1) << 2;
    a.parent.data[cell] = parent, a.octant.data[cell] = octant;
    if (parent >= 0) a.children.data[8 * (size_t)parent + octant] = cell;
    a.order_keys.data[cell] = 8 * at.height + octant;
    a.order.data[cell] = cell;
    find_neighbors(a, cell, at);
}

// Puts a moment where its leaf has it; and finds where a height's cells of an octant begin in ``order``.
template <class Arrays> CUDA_CALLABLE inline void place_moment(const Arrays& a, int i) {
    if (i < 9 * (int)a.octant_begin.shape[0])
        a.octant_begin.data[i] = lower_bound(a.order_keys.data, 0, cell_count(a), 8 * (i / 9) + i % 9);
    if (i >= moment_count(a)) return;
    const int before = a.leaf_before.data[i], leaf = a.cell_after.data[before], from = a.index.data[i];
    const int to = a.moment_begin.data[leaf] + i - a.first.data[before];
    const size_t pitch = a.sorted.strides[0] / sizeof(Real), given = a.packed.strides[0] / sizeof(Real);
    a.source.data[to] = from, a.leaf.data[to] = leaf, a.place.data[from] = to;
    for (int row = 0; row < 8; ++row) a.sorted.data[row * pitch + to] = a.packed.data[row * given + from];
    const CellPlace at = place_of(a, a.cell_keys.data[leaf]);
    const int cells[3] = {at.x, at.y, at.z};
    for (int c = 0; c < 3; ++c) {
        const double middle = a.frame.data[c] + (cells[c] + 0.5) * a.frame.data[EDGE];
        const double away = ((double)position(a, c, from) - middle) / a.frame.data[EDGE];
        a.inside.data[c * (a.inside.strides[0] / sizeof(Real)) + to] = (Real)away;
    }
}

// Passes of the build, in order; grid.py sorts between them.
enum class Pass { BOUND, KEYS, COUNT, WRITE, NOTE, LINK, PLACE };

template <Pass P, class Arrays> CUDA_CALLABLE inline void make_pass(const Arrays& a, int i) {
    if constexpr (P == Pass::BOUND) bound_moments(a, i);
    else if constexpr (P == Pass::KEYS) set_key(a, i);
    else if constexpr (P == Pass::COUNT) count_beginnings(a, i);
    else if constexpr (P == Pass::WRITE) write_cells(a, i);
    else if constexpr (P == Pass::NOTE) note_cell(a, i);
    else if constexpr (P == Pass::LINK) link_cell(a, i);
    else place_moment(a, i);
}

template <Pass P> constexpr bool of_blocks() { return P == Pass::BOUND || P == Pass::COUNT || P == Pass::WRITE; }
template <Pass P> constexpr bool is_concluded() { return P == Pass::BOUND || P == Pass::COUNT; }

// What follows all items of a pass; on a GPU by a block.
template <Pass P, class Arrays> CUDA_CALLABLE inline void conclude(const Arrays& a, int round) {
    if (P == Pass::COUNT) choose_leaves(a);
    if (P == Pass::BOUND || round == 0) set_frame(a, P == Pass::BOUND ? 0 : 1);
}

// Makes one pass over ``count`` items: on a GPU by blocks of BLOCK threads, each of which has an item or a thread of
// which has one.
template <Pass P, class Word, class Arrays>
CUDA_CALLABLE inline void build(int thread, int count, int round, int threads, Word* team, const Arrays& a) {
#if defined(__CUDA_ARCH__)
    if (of_blocks<P>()) make_pass<P>(a, thread / BLOCK);
    else if (thread < count) make_pass<P>(a, thread);
    if constexpr (is_concluded<P>())
        if (is_last_of(a.arrived.data, count)) conclude<P>(a, round);
#else
    share_out(team, threads, count, of_blocks<P>() ? 8 : 8 * BLOCK, [&](int i) { make_pass<P>(a, i); });
    if constexpr (is_concluded<P>()) conclude<P>(a, round);
#endif
}
}
