#pragma once
// All-pairs sums of a work list of tiles on a GPU: a block of warps holds a tile of targets in registers and passes
// over its sources.
//
// Each lane of a warp holds the tile's targets lane, lane + 32, ...; the warps share out the sources, stage them in
// shared memory, 32 at a time, and at the end add up their sums in order.
//
// Where the sources of a stage have one radius, and none of them is masked for one of the targets, the clamp is a
// constant of the target: 20 instructions a pair for the field and 31 for the force, next to the five or so that a
// source takes once for all targets of a lane.

#include "pairs/tiles_cuda.h"

namespace warpmag {

// Stages after which a warp adds its sums to a second set of sums, so that long sums keep their digits.
constexpr int STAGES_PER_SUM = 16;

// Adds up to 32 staged sources to the sums of a lane's targets. If fast, they have one radius and none is masked;
// otherwise those are masked that have the target's label, or for the field the one that is the lane's target k, which
// is own + 32 k.
template <Quantity Q, int TARGETS>
CUDA_CALLABLE inline void add_stage(LaneTargets<Q, TARGETS>& lane, const Quad* staged, int count, bool fast, int own) {
    constexpr int UNROLLED = TARGETS < 4 ? 8 / TARGETS : 2;
    const auto source_at = [&](int i) -> Source<Real> {
        const Quad a = staged[i], b = staged[i + 32];
        constexpr Real SCALE = scaled_moment(Q);
        return {{a.x, a.y, a.z}, {b.x, b.y, b.z}, {SCALE * b.x, SCALE * b.y, SCALE * b.z}};
    };
    if (fast) {
        lane.clamp_for(staged[0].w);
#pragma unroll 1
        for (int first = 0; first < count; first += UNROLLED) {
#pragma unroll
            for (int i = 0; i < UNROLLED; ++i) lane.add(source_at(first + i));
        }
    } else {
#pragma unroll 1
        for (int i = 0; i < count; ++i) {
            const Real label = staged[i + 32].w;
            lane.add_masked(source_at(i), staged[i].w, [&](int k) {
                return Q == Quantity::FIELD ? i - own == 32 * k : label == lane.targets[k].label;
            });
        }
    }
}

// One thread of the block that sums a tile. Shape of partial_out: [splits, target rows, width(Q)].
template <Quantity Q, int TARGETS, int WARPS>
CUDA_CALLABLE inline void sum_tile(int thread, const wp::array_t<int>& tiles, const wp::array_t<Real>& target_table,
                                   const wp::array_t<Real>& source_table, const wp::array_t<Real>& effective_table,
                                   const wp::array_t<Real>& partial_out) {
    constexpr bool FIELD = Q == Quantity::FIELD;
    constexpr int WIDTH = width(Q);
    // of each warp, for its sources, and at the end for its sums
    __shared__ Quad staging[WARPS][TARGETS * WIDTH > 8 ? 8 * TARGETS * WIDTH : 64];
    const int lane = thread % 32, warp = thread / 32 % WARPS;
    const TileEntry& tile = ((const TileEntry*)tiles.data)[thread / (32 * WARPS)];
    const int row_begin = tile.row_begin, count = tile.row_end - row_begin, column_begin = tile.column_begin;
    const int per_warp = (tile.source_end - tile.source_begin + WARPS - 1) / WARPS, split = tile.split;
    const int source_begin = tile.source_begin + warp * per_warp;
    const int source_end = min(tile.source_end, source_begin + per_warp);
    const Table target_rows(target_table), sources(source_table), effective_rows(effective_table);
    const bool same = sources.data == target_rows.data;

    LaneTargets<Q, TARGETS> held;
    Sums<Real> long_sums[TARGETS];
#pragma unroll
    for (int k = 0; k < TARGETS; ++k) {
        // targets beyond the last are the last again, and are not written
        const int column = column_begin + min(lane + 32 * k, count - 1);
        const Moment t = target_rows.moment(column);
        held.targets[k] = {t.x, t.radius, t.label};
        if constexpr (!FIELD) held.targets[k].e = effective_rows.vector(0, column);
    }
    LabelRange labels;
    if constexpr (!FIELD) labels = LabelRange::of<32>(held.targets);

    // lanes beyond the last source have its place, and no moment
    const auto load = [&](int j) { return sources.moment(j < source_end ? j : source_end - 1, j < source_end); };
    Moment s;
    if (source_begin < source_end) s = load(source_begin + lane);
    int stage = 0;
    for (int base = source_begin; base < source_end; base += 32) {
        const int j = base + lane;
        const bool fast = __all_sync(ALL_LANES, s.radius == __shfl_sync(ALL_LANES, s.radius, 0) && s.radius > 0
                                                    && (FIELD ? !same || unsigned(j - column_begin) >= unsigned(count)
                                                              : labels.excludes(s.label)));
        __syncwarp();
        staging[warp][lane] = {s.x.x, s.x.y, s.x.z, s.radius};
        staging[warp][lane + 32] = {s.m.x, s.m.y, s.m.z, FIELD ? 0 : s.label};
        __syncwarp();
        if (base + 32 < source_end) s = load(j + 32);
        add_stage(held, staging[warp], min(32, source_end - base), fast, same ? column_begin + lane - base : 32);
        if (++stage % STAGES_PER_SUM == 0) {
#pragma unroll
            for (int k = 0; k < TARGETS; ++k) {
                long_sums[k] += held.sums[k];
                held.sums[k] = {};
            }
        }
    }
    __syncwarp();
    Real* warp_sums = (Real*)staging[warp];
#pragma unroll
    for (int k = 0; k < TARGETS; ++k) {
        held.sums[k] += long_sums[k];
        results<Q>(held.sums[k], held.targets[k].e, warp_sums + (lane + 32 * k) * WIDTH);
    }
    __syncthreads();
    Real* out = partial_out.data + ((size_t)split * partial_out.shape[1] + row_begin) * WIDTH;
    sum_warps(staging, thread % (32 * WARPS), WIDTH * count, [&](int item, Real total) { out[item] = total; });
}

}
