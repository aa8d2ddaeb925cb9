// All-pairs sums of many moments among themselves on a GPU, field (Eq. 1) or force (Eqs. 13 and 14). Each pair is
// evaluated once, for both its moments.
//
// The moments are cut into an odd number of equal tiles, arranged in a circle. Each tile is paired with the half of the
// others that follows it. A block holds a home tile in registers: lane l holds its moments l, l + 32, ... The other
// tiles are read in stages of 32 moments. At step s of a stage lane l pairs moment (l + s) mod 32 with all moments that
// it holds. It then sends the sums of that moment to lane l − 1, which pairs the moment next. After 32 steps lane l has
// the sums of moment l from the home tile. A pair takes 30 instructions for both fields or 41 for both forces; loading
// a moment takes about eight for all moments that a lane holds.
//
// The sums of staged moments go to partial sums of the distance between the two tiles, which no other block writes. The
// sums of the home tile go to partial sums of the block's share of the walk around the circle.
#pragma once
#include "pairs/tiles_cuda.h"

namespace warpmag {

// Moments of a home tile that a lane holds, and their sums.
template <Quantity Q, int MOMENTS> struct HomeMoments {
    Moment moments[MOMENTS];
    Vec3<Real> scaled[MOMENTS], sums[MOMENTS];
    static constexpr Real SCALE = scaled_moment(Quantity::FIELD);

    // Adds a moment of another tile to the sums h of the home moments, and the home moments to its sums g.
    // inverse(k, d2) is the inverse distance to home moment k.
    template <class Inverse>
    CUDA_CALLABLE void add(Vec3<Real> (&h)[MOMENTS], Vec3<Real>& g, const Source<Real>& source, Inverse inverse) {
#pragma unroll
        for (int k = 0; k < MOMENTS; ++k) {
            const Vec3<Real> r = moments[k].x - source.x;
            add_mirrored_pair<Q>(h[k], g, r, inverse(k, dot(r, r)), source, moments[k].m, scaled[k]);
        }
    }
};

// Adds a stage in shared memory to the sums of the home tile, and returns the sums of moment `lane` of the stage. A
// fast stage has one radius and no masked pair. Otherwise a force masks pairs of one label, and a field masks a moment
// with itself: the lane's k-th moment is moment own + 32 k of the stage.
template <int UNROLLED, Quantity Q, int MOMENTS>
CUDA_CALLABLE inline Vec3<Real> add_mirrored_stage(HomeMoments<Q, MOMENTS>& home, const Quad* staged, int lane,
                                                   bool fast, int own) {
    constexpr bool FIELD = Q == Quantity::FIELD;
    // a force is summed by stages: in one sum the large near terms would round away the far ones
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
        for (int k = 0; k < MOMENTS; ++k)
            clamp[k] = (home.moments[k].radius + radius) * (home.moments[k].radius + radius);
#pragma unroll UNROLLED
        for (int step = 0; step < 32; ++step)
            add_step(lane + step, [&](int k, Real d2) { return inverse_root(max(d2, clamp[k])); });
    } else {
#pragma unroll 1
        for (int step = 0; step < 32; ++step) {
            const Quad c = staged[lane + step + 128];
            const int offset = (lane + step) % 32 - own;
            add_step(lane + step, [&](int k, Real d2) {
                const bool masked = offset == 32 * k || (!FIELD && c.y == home.moments[k].label);
                return masked_inverse(d2, home.moments[k].radius + c.x, masked);
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

// Sums the pairs of a home tile with its share of the following tiles; called by each thread of a block. Shape of
// partial_out: [partial sums, moments, 3], partial sums of distances between tiles first. Arguments as in
// mirror_cuda.MirrorTiles.
template <Quantity Q, int MOMENTS, int WARPS, int UNROLLED, class Tiles>
CUDA_CALLABLE inline void sum_mirrored(int block, int thread, const wp::array_t<Real>& packed, const Tiles& tiles,
                                       int nearest, const wp::array_t<Real>& partial_out) {
    constexpr bool FIELD = Q == Quantity::FIELD;
    // per warp: the moments of a stage twice, at the end its sums
    __shared__ Quad staging[WARPS][MOMENTS > 8 ? 24 * MOMENTS : 192];
    const int lane = thread % 32, warp = thread / 32;
    const int* entry = tiles.blocks.data + 4 * block;
    const int home_tile = entry[0], share = entry[3], walk = entry[2] - entry[1];
    const int walk_begin = entry[1] + walk * warp / WARPS, walk_end = entry[1] + walk * (warp + 1) / WARPS;
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
        // lanes beyond the last moment repeat it with a zero moment, and are not written
        const int row = row_begin + lane + 32 * k;
        home.moments[k] = table.moment(tiles.origin + min(row, row_end - 1), row < row_end);
        home.scaled[k] = home.SCALE * home.moments[k].m;
        home.sums[k] = {};
    }
    LabelRange labels;
    if constexpr (!FIELD) labels = LabelRange::of<32>(home.moments);

    Quad* staged = staging[warp];
#pragma unroll 1
    for (int stage = walk_begin; stage < walk_end; ++stage) {
        const int distance = stage / tiles.stages;
        const int other = home_tile + distance < count ? home_tile + distance : home_tile + distance - count;
        const int begin = edges[other] + 32 * (stage - distance * tiles.stages), end = edges[other + 1];
        if (begin >= end) continue;
        // lanes beyond the last moment repeat its position, with a zero moment
        const bool exists = begin + lane < end;
        const Moment s = table.moment(tiles.origin + (exists ? begin + lane : end - 1), exists);
        const bool fast = __all_sync(ALL_LANES, s.radius == __shfl_sync(ALL_LANES, s.radius, 0) && s.radius > 0
                                                    && distance > 0 && (FIELD || labels.excludes(s.label)));
        __syncwarp();
        staged[lane] = staged[lane + 32] = {s.x.x, s.x.y, s.x.z, s.m.x};
        staged[lane + 64] = staged[lane + 96] = {s.m.y, s.m.z, home.SCALE * s.m.x, home.SCALE * s.m.y};
        staged[lane + 128] = staged[lane + 160] = {s.radius, FIELD ? 0 : s.label};
        __syncwarp();
        const int own = distance == 0 ? row_begin + lane - begin : 32;
        const Vec3<Real> g = add_mirrored_stage<UNROLLED>(home, staged, lane, fast, own);
        if (exists && distance > 0) {
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
