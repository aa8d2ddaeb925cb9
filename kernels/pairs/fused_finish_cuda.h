// Sums and their finish in one kernel, for few moments on a GPU. A block sums a tile of targets and finishes them;
// other threads of the block, GROUP per target, correct overlapping pairs.
#pragma once
#include "pairs/finish.h"
#include "pairs/fused_cuda.h"

namespace warpmag {

template <Quantity Q, int TARGETS, int LANES, int WARPS, int UNROLLED, class Arrays>
CUDA_CALLABLE inline void sum_and_finish(const Arrays& arrays) {
    // not Warp's thread index, whose division would delay everything that follows
    const int block = blockIdx.x, thread = threadIdx.x;
    const TileEntry& tile = ((const TileEntry*)arrays.tiles.data)[block];
    if (tile.row_end <= tile.row_begin) return; // of a world that rests
    const int i = tile.column_begin + thread;
    const bool has_target = thread < tile.row_end - tile.row_begin;
    Vector base = {0, 0, 0};
    if (has_target) base = vectors_at((const Real*)arrays.base.data, i); // loaded early to hide its latency
    auto effective = [&](int column) -> Vector {
        if constexpr (Q == Quantity::FIELD) return {0, 0, 0};
        else return Columns(arrays.effective).vector(0, column);
    };
    auto correct = [&](int column, int) {
        Vector h = {0, 0, 0}, f = h;
        add_overlaps<Q>(h, f, effective(column), arrays, {0, 1, 0, column, tile.source_begin, tile.source_end});
        wp::vec_t<width(Q), Real> correction;
        const Vector first = Q == Quantity::FIELD ? h : f;
        correction[0] = first.x, correction[1] = first.y, correction[2] = first.z;
        if constexpr (Q == Quantity::WRENCH) correction[3] = h.x, correction[4] = h.y, correction[5] = h.z;
        return correction;
    };
    const auto total = sum_fused<Q, TARGETS, LANES, WARPS, UNROLLED, GROUP>(block, thread, arrays.tiles, arrays.targets,
                                                                            arrays.sources, arrays.effective, correct);
    if (!has_target) return;
    constexpr int H = Q == Quantity::WRENCH ? 3 : 0;
    const Vector first = {total[0], total[1], total[2]}, last = {total[H], total[H + 1], total[H + 2]};
    store<Q>(arrays, {0, 1, 0, i, 0, 0}, last, first, effective(i), base);
}
}
