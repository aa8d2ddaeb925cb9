// Near-field sums: pairs of moments in neighboring leaves, by the loops of pairs/ over tiles.
//
// On a CPU a tile of targets comes from one leaf, tiles of sources from its neighbors (pairs/sums_cpu.h). On a GPU a
// warp sums one leaf, and loops over its neighbors as the warps of pairs/tiles_cuda.h do.
#pragma once
#if defined(__CUDA_ARCH__)
#include "pairs/tiles_cuda.h"

namespace warpmag {

// Moments of a leaf's neighbors as nine ranges of columns: three neighbors along x are contiguous in memory.
struct NearRanges {
    int start[10], shift[9]; // first source number of each range, and column minus source number
};
struct NearSources {
    const Table& table;
    const NearRanges& ranges;

    CUDA_CALLABLE Moment moment(int j, bool active) const {
        int shift = ranges.shift[0];
#pragma unroll
        for (int r = 1; r < 9; ++r) shift = j >= ranges.start[r] ? ranges.shift[r] : shift;
        return table.moment(j + shift, active);
    }
};

// The value of the lane whose number differs in bit ``step``.
CUDA_CALLABLE inline Vec3<Real> from_lane(const Vec3<Real>& v, int step) {
    return {__shfl_xor_sync(ALL_LANES, v.x, step), __shfl_xor_sync(ALL_LANES, v.y, step),
            __shfl_xor_sync(ALL_LANES, v.z, step)};
}
CUDA_CALLABLE inline Sums<Real> from_lane(const Sums<Real>& s, int step) {
    return {from_lane(s.f, step), from_lane(s.h, step), from_lane(s.g, step), __shfl_xor_sync(ALL_LANES, s.a, step)};
}

// Sums up to LANES × TARGETS targets of a leaf, from column ``begin`` on. ``own`` is the source number of the first
// target.
template <Quantity Q, int LANES, int TARGETS>
CUDA_CALLABLE inline void sum_targets(int lane, const Table& moments, const Table& effective, const NearRanges& ranges,
                                      int own, int begin, int count, Quad* staged, Real* out) {
    constexpr bool FIELD = Q == Quantity::FIELD;
    constexpr int UNROLLED = TARGETS < 3 ? 4 : 2;
    const auto target_at = [&](int k) -> Target {
        const int column = begin + min(lane % LANES + LANES * k, count - 1);
        const Moment t = moments.moment(column);
        return {t.x, t.radius, t.label, FIELD ? Vec3<Real>{} : effective.vector(0, column)};
    };
    LaneTargets<Q, TARGETS> lane_targets;
    const NearSources sources = {moments, ranges};
    add_sources<LANES, UNROLLED, true>(lane_targets, target_at, sources, 0, ranges.start[9], 0, own, count, lane,
                                       staged);
#pragma unroll
    for (int k = 0; k < TARGETS; ++k) {
        if constexpr (LANES < 32) {
#pragma unroll
            for (int step = LANES; step < 32; step *= 2) lane_targets.sums[k] += from_lane(lane_targets.sums[k], step);
        }
        const int i = lane % LANES + LANES * k;
        if (lane < LANES && i < count)
            results<Q>(lane_targets.sums[k], lane_targets.targets[k].e, out + (size_t)i * width(Q));
    }
}

template <int LANES, int TARGETS> struct Form {
    static constexpr int lanes = LANES, targets = TARGETS;
};

// One thread of a block; each warp of the block sums one leaf.
template <Quantity Q, int WARPS, class Arrays> CUDA_CALLABLE inline void sum_leaf(int thread, const Arrays& arrays) {
    __shared__ Quad staging[WARPS][80];
    __shared__ NearRanges all_ranges[WARPS];
    const int lane = thread % 32, warp = thread / 32 % WARPS, leaf = arrays.leaves.data[0] + thread / 32;
    if (leaf >= arrays.leaves.data[1]) return;
    const int* const begin_of = arrays.moment_begin.data;
    NearRanges& ranges = all_ranges[warp];
    int begin = 0, length = 0;
    if (lane < 9) {
        const int* const row = arrays.neighbors.data + 27 * (size_t)leaf + 3 * lane;
        const int first = row[0] >= 0 ? row[0] : row[1] >= 0 ? row[1] : row[2];
        const int last = row[2] >= 0 ? row[2] : row[1] >= 0 ? row[1] : row[0];
        if (first >= 0) begin = begin_of[first], length = begin_of[last + 1] - begin;
    }
    int start = length; // inclusive prefix sum of lengths, then exclusive
#pragma unroll
    for (int step = 1; step < 16; step *= 2) {
        const int before = __shfl_up_sync(ALL_LANES, start, step);
        if (lane >= step) start += before;
    }
    start -= length;
    if (lane < 10) ranges.start[lane] = start;
    if (lane < 9) ranges.shift[lane] = begin - start;
    __syncwarp();
    const int end = begin_of[leaf + 1], own_shift = ranges.shift[4];
    const Table moments(arrays.moments), effective(arrays.effective);
#pragma unroll 1
    for (int first = begin_of[leaf]; first < end; first += 32 * TARGETS_PER_LANE) {
        const int count = min(32 * TARGETS_PER_LANE, end - first), own = first - own_shift;
        Real* const out = arrays.sums.data + (size_t)first * width(Q);
        const auto sum = [&](auto form) {
            sum_targets<Q, form.lanes, form.targets>(lane, moments, effective, ranges, own, first, count, staging[warp],
                                                     out);
        };
        // The fewest target slots that suffice; several targets per lane amortize the cost of loading a source.
        if constexpr (TARGETS_PER_LANE == 2) {
            if (count <= 16) sum(Form<8, 2>());
            else if (count <= 32) sum(Form<16, 2>());
            else sum(Form<32, 2>());
        } else {
            if (count <= 24) sum(Form<8, 3>());
            else if (count <= 32) sum(Form<8, 4>());
            else if (count <= 48) sum(Form<16, 3>());
            else if (count <= 64) sum(Form<16, 4>());
            else if (count <= 96) sum(Form<32, 3>());
            else sum(Form<32, 4>());
        }
    }
}
}
#else
#include "pairs/sums_cpu.h"

namespace warpmag::cpu {

// Sums one leaf.
template <Quantity Q, class Arrays> void sum_leaf(const Arrays& arrays, int leaf) {
    const Share share = {arrays.moments, arrays.moments, arrays.effective, nullptr, nullptr, arrays.sums.data, 0};
    const int* const begin_of = arrays.moment_begin.data;
    const int begin = begin_of[leaf], end = begin_of[leaf + 1];
    __builtin_memset(share.sums_at<Q>(0, begin), 0, (end - begin) * width(Q) * sizeof(Real));
    Tile targets, sources;
    const auto clear = [&] {
        sources.count = 0;
        sources.begin = end; // beyond the targets: no target is among the sources
    };
    const auto sum_tile = [&] {
        if (sources.count == 0) return;
        complete<Q>(sources);
        for (int i = begin; i < end; i += TILE_SIZE) {
            fill<Q>(targets, share.targets, i, i + TILE_SIZE < end ? i + TILE_SIZE : end);
            sum_all_pairs<Q, false>(share, targets, sources, share.sums_at<Q>(0, i));
        }
        clear();
    };
    clear();
    for (int k = 0; k < 9; ++k) {
        // moments of neighbors along x are contiguous
        const int* const row = arrays.neighbors.data + 27 * (size_t)leaf + 3 * k;
        const int lowest = row[0] >= 0 ? row[0] : row[1] >= 0 ? row[1] : row[2];
        const int highest = row[2] >= 0 ? row[2] : row[1] >= 0 ? row[1] : row[0];
        if (lowest < 0) continue;
        const int last = begin_of[highest + 1];
        for (int first = begin_of[lowest]; first < last;) {
            const int room = TILE_SIZE - sources.count, added = last - first < room ? last - first : room;
            // the middle row contains the targets: their source numbers
            if (k == 4) sources.begin = first - sources.count;
            append(sources, share.sources, first, first + added);
            first += added;
            if (sources.count == TILE_SIZE) sum_tile();
        }
    }
    sum_tile();
}

// Sums all leaves of the range ``leaves``.
template <Quantity Q, class Arrays> void sum_near(const Arrays& arrays, int threads, Word* team) {
    const int first = arrays.leaves.data[0], count = arrays.leaves.data[1] - first;
    share_items(team, threads, count, 8, [&](int leaf) { sum_leaf<Q>(arrays, first + leaf); });
}
}
#endif
