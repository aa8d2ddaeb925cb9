// All-pairs sums of many moments among themselves on a GPU, field (Eq. 1) or force (Eqs. 13 and 14): each pair is
// evaluated once, for both of its ends.
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
#pragma once
#include "pairs/tiles_cuda.h"

namespace warpmag {

// The moments of a home tile that a lane holds, and their sums.
template <Quantity Q, int MOMENTS> struct HomeMoments {
    Moment held[MOMENTS];
    Vec3<Real> scaled[MOMENTS], sums[MOMENTS];
    static constexpr Real SCALE = scaled_moment(Quantity::FIELD);

    // Adds a moment of another tile to the sums h of the moments held, and those to its sums g; inverse(k, d2) is the
    // inverse distance to the k-th.
    template <class Inverse>
    CUDA_CALLABLE void add(Vec3<Real> (&h)[MOMENTS], Vec3<Real>& g, const Source<Real>& source, Inverse inverse) {
#pragma unroll
        for (int k = 0; k < MOMENTS; ++k) {
            const Vec3<Real> r = held[k].x - source.x;
            add_mirrored_pair<Q>(h[k], g, r, inverse(k, dot(r, r)), source, held[k].m, scaled[k]);
        }
    }
};

// Adds a staged stage to the sums of the home tile, and returns the sums of moment `lane` of the stage. If fast, the
// stage has one radius and no pair is masked; otherwise those of one label are, or for the field of one moment: the
// lane's k-th is moment own + 32 k of the stage.
template <int UNROLLED, Quantity Q, int MOMENTS>
CUDA_CALLABLE inline Vec3<Real> add_mirrored_stage(HomeMoments<Q, MOMENTS>& home, const Quad* staged, int lane,
                                                   bool fast, int own) {
    constexpr bool FIELD = Q == Quantity::FIELD;
    // the near terms of a force outweigh the far ones so much that a sum of both would lose these: it is by stages
    Vec3<Real> g{}, h[MOMENTS];
#pragma unroll
    for (int k = 0; k < MOMENTS; ++k) h[k] = FIELD ? home.sums[k] : Vec3<Real>{};
    const auto add_step = [&](int i, auto inverse) {
        const Quad a = staged[i], b = staged[i + 64];
        home.add(h, g, {{a.x, a.y, a.z}, {a.w, b.x, b.y}, {b.z, b.w, home.SCALE * b.y}}, inverse);
        g = {__shfl_sync(ALL_LANES, g.x, lane + 1), __shfl_sync(ALL_LANES, g.y, lane + 1),
             __shfl_sync(ALL_LANES, g.z, lane + 1)};
    };
    if (fast) {
        const Real radius = staged[128].x;
        Real clamp[MOMENTS];
#pragma unroll
        for (int k = 0; k < MOMENTS; ++k) clamp[k] = (home.held[k].radius + radius) * (home.held[k].radius + radius);
#pragma unroll UNROLLED
        for (int step = 0; step < 32; ++step)
            add_step(lane + step, [&](int k, Real d2) { return inverse_root(max(d2, clamp[k])); });
    } else {
#pragma unroll 1
        for (int step = 0; step < 32; ++step) {
            const Quad c = staged[lane + step + 128];
            const int offset = (lane + step) % 32 - own;
            add_step(lane + step, [&](int k, Real d2) {
                const bool masked = offset == 32 * k || (!FIELD && c.y == home.held[k].label);
                return masked_inverse(d2, home.held[k].radius + c.x, masked);
            });
        }
    }
#pragma unroll
    for (int k = 0; k < MOMENTS; ++k) {
        if constexpr (FIELD) home.sums[k] = h[k];
        else home.sums[k] += h[k];
    }
    return g;
}

// One thread of the block that takes stages of the tiles after a home tile. Shape of partial_out: [partial sums,
// moments, 3], those of the distances between tiles first. Arguments as in mirror_cuda.MirrorTiles.
template <Quantity Q, int MOMENTS, int WARPS, int UNROLLED, class Tiles>
CUDA_CALLABLE inline void sum_mirrored(int block, int thread, const wp::array_t<Real>& packed, const Tiles& tiles,
                                       int nearest, const wp::array_t<Real>& partial_out) {
    constexpr bool FIELD = Q == Quantity::FIELD;
    // of each warp, for the moments of a stage, twice over, and at the end for its sums
    __shared__ Quad staging[WARPS][MOMENTS > 8 ? 24 * MOMENTS : 192];
    const int lane = thread % 32, warp = thread / 32;
    const int* p = tiles.blocks.data + 4 * block;
    const int home_tile = p[0], share = p[3], walk = p[2] - p[1];
    const int walk_begin = p[1] + walk * warp / WARPS, walk_end = p[1] + walk * (warp + 1) / WARPS;
    const int* edges = tiles.edges.data;
    const int count = tiles.edges.shape[0] - 1, row_begin = edges[home_tile], row_end = edges[home_tile + 1];
    const Table table(packed);
    const auto store = [&](size_t slab, int item, Real value) {
        Real& sum = partial_out.data[slab * partial_out.shape[1] * 3 + item];
        sum = nearest == 1 ? value : sum + value; // the first pass begins the sums
    };

    HomeMoments<Q, MOMENTS> home;
#pragma unroll
    for (int k = 0; k < MOMENTS; ++k) {
        // a lane that holds fewer has the last again, without a moment, which is not written
        const int row = row_begin + lane + 32 * k;
        home.held[k] = table.moment(tiles.origin + min(row, row_end - 1), row < row_end);
        home.scaled[k] = home.SCALE * home.held[k].m;
        home.sums[k] = {};
    }
    LabelRange labels;
    if constexpr (!FIELD) labels = LabelRange::of<32>(home.held);

    Quad* staged = staging[warp];
#pragma unroll 1
    for (int at = walk_begin; at < walk_end; ++at) {
        const int distance = at / tiles.stages;
        const int other = home_tile + distance < count ? home_tile + distance : home_tile + distance - count;
        const int begin = edges[other] + 32 * (at - distance * tiles.stages), end = edges[other + 1];
        if (begin >= end) continue;
        // lanes beyond the last moment have its place, and no moment
        const bool there = begin + lane < end;
        const Moment s = table.moment(tiles.origin + (there ? begin + lane : end - 1), there);
        const bool fast = __all_sync(ALL_LANES, s.radius == __shfl_sync(ALL_LANES, s.radius, 0) && s.radius > 0
                                                    && distance > 0 && (FIELD || labels.excludes(s.label)));
        __syncwarp();
        staged[lane] = staged[lane + 32] = {s.x.x, s.x.y, s.x.z, s.m.x};
        staged[lane + 64] = staged[lane + 96] = {s.m.y, s.m.z, home.SCALE * s.m.x, home.SCALE * s.m.y};
        staged[lane + 128] = staged[lane + 160] = {s.radius, FIELD ? 0 : s.label};
        __syncwarp();
        const int own = distance == 0 ? row_begin + lane - begin : 32;
        const Vec3<Real> g = add_mirrored_stage<UNROLLED>(home, staged, lane, fast, own);
        if (there && distance > 0) {
            store(distance - nearest, 3 * (begin + lane), H_FACTOR * g.x);
            store(distance - nearest, 3 * (begin + lane) + 1, H_FACTOR * g.y);
            store(distance - nearest, 3 * (begin + lane) + 2, H_FACTOR * g.z);
        }
    }
    __syncwarp();
    Real* warp_sums = (Real*)staged;
#pragma unroll
    for (int k = 0; k < MOMENTS; ++k) results<Q>(Sums<Real>{{}, home.sums[k]}, {}, warp_sums + (lane + 32 * k) * 3);
    __syncthreads();
    sum_warps(staging, thread, 3 * (row_end - row_begin),
              [&](int item, Real total) { store(tiles.slabs + share, 3 * row_begin + item, total); });
}

}
