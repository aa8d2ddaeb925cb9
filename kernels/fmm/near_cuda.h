// Sums over the pairs of moments in neighbouring cells on a GPU: a warp takes the moments of a leaf as its targets, and
// passes over those of its neighbours as the warps of sums_cuda.h do.
#pragma once
#include "pairs/tiles_cuda.h"

namespace warpmag {

// The moments of a leaf's neighbours one after the other: of three side by side along x they follow in memory.
struct NearRanges {
    int start[10], shift[9]; // number of the first of each range, and how far its column is from that
};
struct NearSources {
    const Table& table;
    const NearRanges& ranges;

    CUDA_CALLABLE Moment moment(int j, bool wanted) const {
        int shift = ranges.shift[0];
#pragma unroll
        for (int r = 1; r < 9; ++r) shift = j >= ranges.start[r] ? ranges.shift[r] : shift;
        return table.moment(j + shift, wanted);
    }
};

// The sums of the lane whose number differs by a bit.
CUDA_CALLABLE inline Vec3<Real> from_lane(const Vec3<Real>& v, int step) {
    return {__shfl_xor_sync(ALL_LANES, v.x, step), __shfl_xor_sync(ALL_LANES, v.y, step),
            __shfl_xor_sync(ALL_LANES, v.z, step)};
}
CUDA_CALLABLE inline Sums<Real> from_lane(const Sums<Real>& s, int step) {
    return {from_lane(s.f, step), from_lane(s.h, step), from_lane(s.g, step), __shfl_xor_sync(ALL_LANES, s.a, step)};
}

// Sums of up to LANES times HELD moments of a leaf, from column begin on; ``own`` is the number of the first of them
// among the sources.
template <Quantity Q, int LANES, int HELD>
CUDA_CALLABLE inline void sum_targets(int lane, const Table& moments, const Table& effective, const NearRanges& ranges,
                                      int own, int begin, int count, Quad* staged, Real* out) {
    constexpr bool FIELD = Q == Quantity::FIELD;
    constexpr int UNROLLED = HELD < 3 ? 4 : 2;
    const auto target_at = [&](int k) -> Target {
        const int column = begin + min(lane % LANES + LANES * k, count - 1);
        const Moment t = moments.moment(column);
        return {t.x, t.radius, t.label, FIELD ? Vec3<Real>{} : effective.vector(0, column)};
    };
    LaneTargets<Q, HELD> held;
    const NearSources sources = {moments, ranges};
    add_sources<LANES, UNROLLED, true>(held, target_at, sources, 0, ranges.start[9], 0, own, count, lane, staged);
#pragma unroll
    for (int k = 0; k < HELD; ++k) {
        if constexpr (LANES < 32) {
#pragma unroll
            for (int step = LANES; step < 32; step *= 2) held.sums[k] += from_lane(held.sums[k], step);
        }
        const int i = lane % LANES + LANES * k;
        if (lane < LANES && i < count) results<Q>(held.sums[k], held.targets[k].e, out + (size_t)i * width(Q));
    }
}

template <int LANES, int HELD> struct Form {
    static constexpr int lanes = LANES, held = HELD;
};

// One thread of a block whose warps sum a leaf each.
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
    int start = length; // up to the end of each range, then to its begin
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
    for (int first = begin_of[leaf]; first < end; first += 32 * MOST_HELD) {
        const int count = min(32 * MOST_HELD, end - first), own = first - own_shift;
        Real* const out = arrays.sums.data + (size_t)first * width(Q);
        const auto sum = [&](auto form) {
            sum_targets<Q, form.lanes, form.held>(lane, moments, effective, ranges, own, first, count, staging[warp],
                                                  out);
        };
        // as few places for targets as will do, but as many of a lane as pay for what a source takes once
        if constexpr (MOST_HELD == 2) {
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
