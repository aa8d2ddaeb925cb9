// All-pairs sums of few moments on a GPU, computed and finished in one kernel, without a second launch: field (Eq. 1)
// and force (Eqs. 4, 13 and 14).
//
// A block has a tile of few targets. Each warp holds all of them: a lane holds several, and groups of lanes hold
// copies. The warps share the sources. Shuffles add up the sums of a warp's lanes; the sums of warps are added up in
// shared memory, in a fixed order. Other threads of the block compute the corrections of overlapping pairs meanwhile.
// Thread k of a block ends with the total of target k.
#pragma once
#include "pairs/tiles_cuda.h"

namespace warpmag {

// Length of ``values`` numbers, padded so that ``fold`` can halve them until one lane in ``lanes`` holds each.
constexpr int padded(int values, int lanes) {
    int parts = 1;
    for (int step = 16; step >= lanes && parts < values; step /= 2) parts *= 2;
    return (values + parts - 1) / parts * parts;
}

// Adds up r over the lanes that are a multiple of LANES apart, in few shuffles: while a lane has several values, it
// keeps one half and sends the other. One lane writes each sum to ``out``.
template <int LANES, int VALUES, int STEP = 16, int SIZE>
CUDA_CALLABLE inline void fold(Real (&r)[SIZE], int lane, Real* out, bool writes = true) {
    const bool upper = lane & STEP;
    if constexpr (STEP < LANES || STEP == 0) {
        if (!writes) return;
#pragma unroll
        for (int i = 0; i < VALUES; ++i) out[i] = r[i];
    } else if constexpr (VALUES > 1) {
        constexpr int HALF = VALUES / 2;
#pragma unroll
        for (int i = 0; i < HALF; ++i) {
            const Real sent = upper ? r[i] : r[i + HALF], kept = upper ? r[i + HALF] : r[i];
            r[i] = kept + __shfl_xor_sync(ALL_LANES, sent, STEP);
        }
        fold<LANES, HALF, STEP / 2>(r, lane, out + (upper ? HALF : 0), writes);
    } else {
        r[0] += __shfl_xor_sync(ALL_LANES, r[0], STEP);
        fold<LANES, 1, STEP / 2>(r, lane, out, writes && !upper);
    }
}

// Sums over a warp's share of the sources of a tile, written to ``staging``. Lane l has targets l, l + LANES, ...
template <Quantity Q, int TARGETS, int LANES, int UNROLLED>
CUDA_CALLABLE inline void sum_share(int lane, const TileEntry& tile, int source_begin, int source_end,
                                    const Table& target_rows, const Table& sources, const Table& effective_rows,
                                    Quad* staging) {
    constexpr bool FIELD = Q == Quantity::FIELD;
    constexpr int VALUES = padded(TARGETS * width(Q), LANES);
    const int column_begin = tile.column_begin, count = tile.row_end - tile.row_begin, own = lane % LANES;
    const bool same = sources.data == target_rows.data;
    // lanes beyond the last target read other moments, and are not written. They take the last target's label, since
    // labels mask pairs, and its effective moment, since that table may end there
    const auto target_at = [&](int k) -> Target {
        const Moment t = target_rows.moment(column_begin + own + LANES * k);
        const int column = column_begin + min(own + LANES * k, count - 1);
        if constexpr (FIELD) return {t.x, t.radius};
        else return {t.x, t.radius, target_rows(7, column), effective_rows.vector(0, column)};
    };
    LaneTargets<Q, TARGETS> lane_targets;
    add_sources<LANES, UNROLLED, false>(lane_targets, target_at, sources, source_begin, source_end,
                                        sources(3, tile.source_begin), same ? column_begin : FAR, same ? count : 0,
                                        lane, staging);
    Real r[VALUES] = {};
#pragma unroll
    for (int k = 0; k < TARGETS; ++k) results<Q>(lane_targets.sums[k], lane_targets.targets[k].e, r + k * width(Q));
    fold<LANES, VALUES>(r, lane, (Real*)staging + own * VALUES);
}

// Total of target `thread` of a tile, in the threads that have a target: sums over pairs plus a correction. SHARES
// threads compute the correction as the vector correct(column, share), for the packed column of the target.
template <Quantity Q, int TARGETS, int LANES, int WARPS, int UNROLLED, int SHARES, class Correct>
CUDA_CALLABLE inline wp::vec_t<width(Q), Real>
sum_fused(int block, int thread, const wp::array_t<int>& tiles, const wp::array_t<Real>& target_table,
          const wp::array_t<Real>& source_table, const wp::array_t<Real>& effective_table, Correct correct) {
    constexpr int WIDTH = width(Q), VALUES = padded(TARGETS * WIDTH, LANES);
    // per warp: staged sources, at the end its sums
    __shared__ Quad staging[WARPS][LANES * VALUES > 320 ? LANES * VALUES / 4 : 80];
    __shared__ Real corrections[TARGETS * LANES][WIDTH];
    const TileEntry& tile = ((const TileEntry*)tiles.data)[block];
    const int count = tile.row_end - tile.row_begin;
    if (thread < 32 * WARPS) {
        const int warp = thread / 32, range = tile.source_end - tile.source_begin;
        sum_share<Q, TARGETS, LANES, UNROLLED>(thread % 32, tile, tile.source_begin + range * warp / WARPS,
                                               tile.source_begin + range * (warp + 1) / WARPS, Table(target_table),
                                               Table(source_table), Table(effective_table), staging[warp]);
    } else {
        const int k = (thread - 32 * WARPS) / SHARES, share = thread % SHARES;
        wp::vec_t<WIDTH, Real> correction;
        if (k < count) correction = correct(tile.column_begin + k, share);
#pragma unroll
        for (int c = 0; c < WIDTH; ++c) {
            Real total = correction[c];
#pragma unroll
            for (int step = SHARES / 2; step > 0; step /= 2) total += __shfl_xor_sync(ALL_LANES, total, step);
            if (share == 0 && k < TARGETS * LANES) corrections[k][c] = total;
        }
    }
    __syncthreads();
    wp::vec_t<WIDTH, Real> total;
    if (thread < count) {
        const int at = thread % LANES * VALUES + thread / LANES * WIDTH;
#pragma unroll
        for (int c = 0; c < WIDTH; ++c) {
            total[c] = corrections[thread][c];
#pragma unroll
            for (int w = 0; w < WARPS; ++w) total[c] += ((const Real*)staging[w])[at + c];
        }
    }
    return total;
}

}
