#pragma once
// All-pairs sums of few moments on a GPU, for a fused kernel: the kernel that needs the sums computes them itself, and
// no second launch waits for the first.
//
// A block has a tile of a few targets. Each of its warps holds all of them, some in every lane, and as often as there
// are lanes for it; the warps share out the sources, stage them in shared memory, 32 at a time, and groups of lanes
// share out the staged sources. The sums of the groups are added up by shuffles, most of which halve the values that a
// lane keeps, and the sums of the warps in shared memory, in a fixed order. Other threads of the block meanwhile
// compute the correction of overlapping pairs. Thread k of a block ends with the whole sum of target k.
//
// Where the sources of a step have one radius, and none of them is masked for one of the targets, the clamp is a
// constant of the target: 20 instructions a pair for the field and 31 for the force, next to the four or so that a
// source takes once for all targets of a lane, and the sixty that a warp takes to stage 32.

#include "pairs/tiles_cuda.h"

namespace warpmag {

// Numbers that a lane has to add up over the lanes LANES apart, and zeros until they can be halved as often as needed.
constexpr int padded(int values, int lanes) {
    int parts = 1;
    for (int step = 16; step >= lanes && parts < values; step /= 2) parts *= 2;
    return (values + parts - 1) / parts * parts;
}

// Adds up r over the lanes that are a multiple of LANES apart, in few shuffles: as long as there are several values, a
// lane keeps half of them and gives away the others. The sums are written to out by one lane each.
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

// Adds up to 32 staged sources to the sums of a lane's targets, which share them out in GROUPS of lanes. Bit i of odd
// is set where source i has another radius or is masked for a target of any lane: that is one with the target's label,
// or for the field the source that is the lane's target k, own + LANES k.
template <int UNROLLED, int LANES, Quantity Q, int HELD>
CUDA_CALLABLE inline void add_shared_stage(LaneTargets<Q, HELD>& held, const Quad* staged, int count, unsigned odd,
                                           int group, int own) {
    constexpr int GROUPS = 32 / LANES, STRIDE = GROUPS * UNROLLED;
    constexpr unsigned STEP = STRIDE < 32 ? (1u << STRIDE) - 1 : ~0u;
    const auto source_at = [&](int i) -> Source<Real> {
        const Quad a = staged[i], b = staged[i + 32];
        return {{a.x, a.y, a.z}, {a.w, b.x, b.y}, {b.z, b.w, scaled_moment(Q) * b.y}};
    };
#pragma unroll 1
    for (int first = 0; first < count; first += STRIDE) {
        if ((odd >> first & STEP) == 0) {
#pragma unroll
            for (int i = 0; i < UNROLLED; ++i) held.add(source_at(first + GROUPS * i + group));
        } else {
#pragma unroll 1
            for (int i = first + group; i < first + STRIDE; i += GROUPS) {
                const Pair c = ((const Pair*)(staged + 64))[i];
                held.add_masked(source_at(i), c.x, [&](int k) {
                    return Q == Quantity::FIELD ? i - own == LANES * k : c.y == held.targets[k].label;
                });
            }
        }
    }
}

// Sums of a warp's share of the sources of a tile, written to staging: lane l has targets l, l + LANES, ...
template <Quantity Q, int HELD, int LANES, int UNROLLED>
CUDA_CALLABLE inline void sum_share(int lane, const TileEntry& tile, int source_begin, int source_end,
                                    const Table& target_rows, const Table& sources, const Table& effective_rows,
                                    Quad* staging) {
    constexpr bool FIELD = Q == Quantity::FIELD;
    constexpr Real SCALE = scaled_moment(Q);
    constexpr int VALUES = padded(HELD * width(Q), LANES);
    const int column_begin = tile.column_begin, count = tile.row_end - tile.row_begin, own = lane % LANES;
    const bool same = sources.data == target_rows.data;
    const unsigned own_begin = same ? column_begin : 0, own_count = same ? count : 0;
    // moments of zero follow the last one and may be read
    const auto load = [&](int j) { return sources.moment(j, j < source_end); };
    const Real radius = sources(3, tile.source_begin);
    Moment s;
    if (source_begin < source_end) s = load(source_begin + lane);

    LaneTargets<Q, HELD> held;
#pragma unroll
    for (int k = 0; k < HELD; ++k) {
        // beyond the last target others are read, and not written; but the label, which masks, and the effective
        // moment, whose table may end, are those of the last
        const Moment t = target_rows.moment(column_begin + own + LANES * k);
        const int column = column_begin + min(own + LANES * k, count - 1);
        held.targets[k] = {t.x, t.radius};
        if constexpr (!FIELD) held.targets[k].label = target_rows(7, column);
        if constexpr (!FIELD) held.targets[k].e = effective_rows.vector(0, column);
    }
    held.clamp_for(radius);
    LabelRange labels;
    if constexpr (!FIELD) labels = LabelRange::of<LANES>(held.targets);

#pragma unroll 1
    for (int base = source_begin; base < source_end; base += 32) {
        const int j = base + lane;
        const unsigned odd =
            ~__ballot_sync(ALL_LANES, s.radius == radius && s.radius > 0
                                          && (FIELD ? j - own_begin >= own_count : labels.excludes(s.label)));
        staging[lane] = {s.x.x, s.x.y, s.x.z, s.m.x};
        staging[lane + 32] = {s.m.y, s.m.z, SCALE * s.m.x, SCALE * s.m.y};
        ((Pair*)(staging + 64))[lane] = {s.radius, FIELD ? 0 : s.label};
        __syncwarp();
        if (base + 32 < source_end) s = load(j + 32);
        add_shared_stage<UNROLLED, LANES>(held, staging, min(32, source_end - base), odd, lane / LANES,
                                          same ? column_begin + own - base : 32);
        __syncwarp();
    }
    Real r[VALUES] = {};
#pragma unroll
    for (int k = 0; k < HELD; ++k) results<Q>(held.sums[k], held.targets[k].e, r + k * width(Q));
    fold<LANES, VALUES>(r, lane, (Real*)staging + own * VALUES);
}

// Total of target `thread` of a tile, in the threads that have one: the sums over its sources, and a correction that
// SHARES threads compute as correct(column, share), a vector, for the packed column of the target.
template <Quantity Q, int HELD, int LANES, int WARPS, int UNROLLED, int SHARES, class Correct>
CUDA_CALLABLE inline wp::vec_t<width(Q), Real>
sum_fused(int block, int thread, const wp::array_t<int>& tiles, const wp::array_t<Real>& target_table,
          const wp::array_t<Real>& source_table, const wp::array_t<Real>& effective_table, Correct correct) {
    constexpr int WIDTH = width(Q), VALUES = padded(HELD * WIDTH, LANES);
    // of each warp: its sources, and then its sums
    __shared__ Quad staging[WARPS][LANES * VALUES > 320 ? LANES * VALUES / 4 : 80];
    __shared__ Real corrections[HELD * LANES][WIDTH];
    const TileEntry& tile = ((const TileEntry*)tiles.data)[block];
    const int count = tile.row_end - tile.row_begin;
    if (thread < 32 * WARPS) {
        const int warp = thread / 32, range = tile.source_end - tile.source_begin;
        sum_share<Q, HELD, LANES, UNROLLED>(thread % 32, tile, tile.source_begin + range * warp / WARPS,
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
            if (share == 0 && k < HELD * LANES) corrections[k][c] = total;
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
