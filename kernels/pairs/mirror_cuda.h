#pragma once
// All-pairs sums of many moments among themselves on a GPU: each pair is evaluated once, for both of its ends.
//
// The moments are cut into an odd number of equal tiles, arranged in a circle, and each tile takes the half of the
// others that follows it. A block of warps holds a home tile in registers, lane l its moments l, l + 32, ..., and takes
// the others in stages of 32 moments. At step s of a stage lane l takes the moment (l + s) mod 32 with all that it
// holds, and passes the sums of that moment on to the lane that takes it next, so that after 32 steps lane l has the
// home tile's sums for moment l: 30 instructions for both ends of a field's pair and 41 of a force's, next to the eight
// or so that a moment takes once for all that a lane holds.
//
// Those go to partial sums that belong to the distance between the two tiles in the circle, to which no other block
// writes; the sums of the home tile go to partial sums of the block's share of the walk.

#include "pairs/tiles_cuda.h"

namespace warpmag {

// One thread of the block that takes stages of the tiles after a home tile. Shape of partial_out: [partial sums,
// moments, 3], those of the distances between tiles first. Arguments as in mirror_cuda.MirrorTiles.
template <Quantity Q, int MOMENTS, int WARPS, int UNROLLED, class Tiles>
CUDA_CALLABLE inline void sum_mirrored(int block, int thread, const wp::array_t<Real>& packed, const Tiles& tiles,
                                       int nearest, const wp::array_t<Real>& partial_out) {
    constexpr bool FIELD = Q == Quantity::FIELD;
    constexpr Real SCALE = scaled_moment(Quantity::FIELD);
    // of each warp, for the moments of a stage, twice over, and at the end for its sums
    __shared__ Quad staging[WARPS][MOMENTS > 8 ? 24 * MOMENTS : 192];
    const int lane = thread % 32, warp = thread / 32;
    const int* p = tiles.blocks.data + 4 * block;
    const int home = p[0], share = p[3], walk = p[2] - p[1];
    const int walk_begin = p[1] + walk * warp / WARPS, walk_end = p[1] + walk * (warp + 1) / WARPS;
    const int* edges = tiles.edges.data;
    const int count = tiles.edges.shape[0] - 1, row_begin = edges[home], row_end = edges[home + 1];
    const Table table(packed);
    const auto store = [&](size_t slab, int item, Real value) {
        Real& sum = partial_out.data[slab * partial_out.shape[1] * 3 + item];
        sum = nearest == 1 ? value : sum + value; // the first pass begins the sums
    };

    Moment held[MOMENTS];
    Vec3<Real> scaled[MOMENTS], sums[MOMENTS];
#pragma unroll
    for (int k = 0; k < MOMENTS; ++k) {
        // a lane that holds fewer has the last again, without a moment, which is not written
        const int row = row_begin + lane + 32 * k;
        held[k] = table.moment(tiles.origin + min(row, row_end - 1), row < row_end);
        scaled[k] = SCALE * held[k].m;
        sums[k] = {};
    }
    LabelRange labels;
    if constexpr (!FIELD) labels = LabelRange::of<32>(held);

    Quad *staged_a = staging[warp], *staged_b = staged_a + 64, *staged_c = staged_b + 64;
#pragma unroll 1
    for (int at = walk_begin; at < walk_end; ++at) {
        const int distance = at / tiles.stages;
        const int other = home + distance < count ? home + distance : home + distance - count;
        const int begin = edges[other] + 32 * (at - distance * tiles.stages), end = edges[other + 1];
        if (begin >= end) continue;
        // lanes beyond the last moment have its place, and no moment
        const bool there = begin + lane < end;
        const Moment s = table.moment(tiles.origin + (there ? begin + lane : end - 1), there);
        const Real radius = __shfl_sync(ALL_LANES, s.radius, 0);
        const bool fast = __all_sync(ALL_LANES, s.radius == radius && s.radius > 0 && distance > 0
                                                    && (FIELD || labels.excludes(s.label)));
        __syncwarp();
        staged_a[lane] = staged_a[lane + 32] = {s.x.x, s.x.y, s.x.z, s.m.x};
        staged_b[lane] = staged_b[lane + 32] = {s.m.y, s.m.z, SCALE * s.m.x, SCALE * s.m.y};
        staged_c[lane] = staged_c[lane + 32] = {s.radius, FIELD ? 0 : s.label};
        __syncwarp();
        // the near terms of a force outweigh the far ones so much that a sum of both would lose these: it is by stages
        Vec3<Real> g{}, stage_sums[MOMENTS];
#pragma unroll
        for (int k = 0; k < MOMENTS; ++k) stage_sums[k] = FIELD ? sums[k] : Vec3<Real>{};
        const auto add_step = [&](int step, auto inverse) {
            const Quad a = staged_a[lane + step], b = staged_b[lane + step];
            const Source<Real> source{{a.x, a.y, a.z}, {a.w, b.x, b.y}, {b.z, b.w, SCALE * b.y}};
#pragma unroll
            for (int k = 0; k < MOMENTS; ++k) {
                const Vec3<Real> r = held[k].x - source.x;
                add_mirrored_pair<Q>(stage_sums[k], g, r, inverse(k, dot(r, r)), source, held[k].m, scaled[k]);
            }
            g = {__shfl_sync(ALL_LANES, g.x, lane + 1), __shfl_sync(ALL_LANES, g.y, lane + 1),
                 __shfl_sync(ALL_LANES, g.z, lane + 1)};
        };
        if (fast) {
            Real clamp[MOMENTS];
#pragma unroll
            for (int k = 0; k < MOMENTS; ++k) clamp[k] = (held[k].radius + radius) * (held[k].radius + radius);
#pragma unroll UNROLLED
            for (int step = 0; step < 32; ++step)
                add_step(step, [&](int k, Real d2) { return inverse_root(max(d2, clamp[k])); });
        } else {
#pragma unroll 1
            for (int step = 0; step < 32; ++step) {
                const Quad c = staged_c[lane + step];
                const int row = begin + (lane + step) % 32;
                add_step(step, [&](int k, Real d2) {
                    const bool own = distance == 0 && row == row_begin + lane + 32 * k;
                    return masked_inverse(d2, held[k].radius + c.x, own || (!FIELD && c.y == held[k].label));
                });
            }
        }
#pragma unroll
        for (int k = 0; k < MOMENTS; ++k) {
            if constexpr (FIELD) sums[k] = stage_sums[k];
            else sums[k] += stage_sums[k];
        }
        if (there && distance > 0) {
            store(distance - nearest, 3 * (begin + lane), H_FACTOR * g.x);
            store(distance - nearest, 3 * (begin + lane) + 1, H_FACTOR * g.y);
            store(distance - nearest, 3 * (begin + lane) + 2, H_FACTOR * g.z);
        }
    }
    __syncwarp();
    Real* warp_sums = (Real*)staging[warp];
#pragma unroll
    for (int k = 0; k < MOMENTS; ++k) results<Q>(Sums<Real>{{}, sums[k]}, {}, warp_sums + (lane + 32 * k) * 3);
    __syncthreads();
    sum_warps(staging, thread, 3 * (row_end - row_begin),
              [&](int item, Real total) { store(tiles.slabs + share, 3 * row_begin + item, total); });
}

}
