// All-pairs sums of a work list of tiles on a GPU: field (Eq. 1) and force (Eqs. 4, 13 and 14). A block holds a tile of
// targets in registers: lane l of each warp holds targets l, l + 32, ... The warps share the tile's sources, and their
// sums are added up in order at the end.
#pragma once
#include "pairs/tiles_cuda.h"

namespace warpmag {

// Sums a tile; called by each thread of a block. Shape of partial_out: [splits, target rows, width(Q)].
template <Quantity Q, int TARGETS, int WARPS>
CUDA_CALLABLE inline void sum_tile(int thread, const wp::array_t<int>& tiles, const wp::array_t<Real>& target_table,
                                   const wp::array_t<Real>& source_table, const wp::array_t<Real>& effective_table,
                                   const wp::array_t<Real>& partial_out) {
    constexpr bool FIELD = Q == Quantity::FIELD;
    constexpr int WIDTH = width(Q), UNROLLED = TARGETS < 4 ? 8 / TARGETS : 2;
    // per warp: staged sources, at the end its sums
    __shared__ Quad staging[WARPS][TARGETS * WIDTH > 10 ? 8 * TARGETS * WIDTH : 80];
    const int lane = thread % 32, warp = thread / 32 % WARPS;
    const TileEntry& tile = ((const TileEntry*)tiles.data)[thread / (32 * WARPS)];
    const int row_begin = tile.row_begin, count = tile.row_end - row_begin, column_begin = tile.column_begin;
    if (count <= 0) return; // of a world that rests
    const int per_warp = (tile.source_end - tile.source_begin + WARPS - 1) / WARPS, split = tile.split;
    const int source_begin = tile.source_begin + warp * per_warp;
    const int source_end = min(tile.source_end, source_begin + per_warp);
    const Table target_rows(target_table), sources(source_table), effective_rows(effective_table);
    const bool same = sources.data == target_rows.data;

    // lanes beyond the last target repeat it, and are not written
    const auto target_at = [&](int k) -> Target {
        const int column = column_begin + min(lane + 32 * k, count - 1);
        const Moment t = target_rows.moment(column);
        return {t.x, t.radius, t.label, FIELD ? Vec3<Real>{} : effective_rows.vector(0, column)};
    };
    LaneTargets<Q, TARGETS> lane_targets;
    add_sources<32, UNROLLED, true>(lane_targets, target_at, sources, source_begin, source_end, 0,
                                    same ? column_begin : FAR, same ? count : 0, lane, staging[warp]);
    Real* warp_sums = (Real*)staging[warp];
#pragma unroll
    for (int k = 0; k < TARGETS; ++k)
        results<Q>(lane_targets.sums[k], lane_targets.targets[k].e, warp_sums + (lane + 32 * k) * WIDTH);
    __syncthreads();
    Real* out = partial_out.data + ((size_t)split * partial_out.shape[1] + row_begin) * WIDTH;
    sum_warps(staging, thread % (32 * WARPS), WIDTH * count, [&](int item, Real total) { out[item] = total; });
}

}
