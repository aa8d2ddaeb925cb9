// Gradients of many moments on a GPU. Each pair is evaluated once, for both its moments.
//
// Tiles, stages, lanes and partial sums are those of ``mirror_cuda.h``. Stages lie in shared memory as rows of numbers,
// like packed moments and their cotangents. Shape of the partial sums: [partial sums, ROWS, moments or more].
#pragma once
#include "pairs/pair_gradients.h"
#include "pairs/tiles_cuda.h"

namespace warpmag {

constexpr int PACKED = 8, STAGED = PACKED + (WRENCH ? 6 : 3); // rows of a stage

// Adds a stage of ``exists`` moments to the sums of the home moments; returns those of moment ``lane`` of the stage.
template <int MOMENTS>
CUDA_CALLABLE inline GradientSums add_stage(const Balls (&home)[MOMENTS], GradientSums (&sums)[MOMENTS], int home_count,
                                            const Real* stage, int exists, int lane) {
    const Rows packed(stage, 32), cotangents(stage + 32 * PACKED, 32);
    GradientSums mirrored;
#pragma unroll 1
    for (int step = 0; step < 32; ++step) {
        const int i = (lane + step) % 32;
        const Balls other = balls_from(packed, cotangents, i);
#pragma unroll
        for (int k = 0; k < MOMENTS; ++k) {
            const bool others = i < exists && lane + 32 * k < home_count && home[k].label != other.label;
            const PairGradient g = gradient_of(home[k], other, others);
            sums[k].add_to_target(g);
            mirrored.add_to_source(g);
        }
        for (Vec3<Real>& v : mirrored.part) // to the lane that pairs the moment next
            v = {__shfl_sync(ALL_LANES, v.x, lane + 1), __shfl_sync(ALL_LANES, v.y, lane + 1),
                 __shfl_sync(ALL_LANES, v.z, lane + 1)};
    }
    return mirrored;
}

// Sums the pairs of a home tile with its share of the following tiles; called by each thread of a block. Arguments as
// of ``sum_mirrored``.
template <int MOMENTS, int WARPS, class Arrays, class Tiles>
CUDA_CALLABLE inline void sum_mirrored_gradients(int block, int thread, const Arrays& arrays, const Tiles& tiles,
                                                 int nearest) {
    constexpr int HOME = 32 * MOMENTS, NUMBERS = HOME * ROWS > 32 * STAGED ? HOME * ROWS : 32 * STAGED;
    __shared__ Quad staging[WARPS][NUMBERS / 4]; // per warp: a stage, at the end its sums
    const int lane = thread % 32, warp = thread / 32;
    const int* const entry = tiles.blocks.data + 4 * block;
    const int home_tile = entry[0], share = entry[3], walk = entry[2] - entry[1];
    const int walk_begin = entry[1] + walk * warp / WARPS, walk_end = entry[1] + walk * (warp + 1) / WARPS;
    const int* const edges = tiles.edges.data;
    const int count = tiles.edges.shape[0] - 1, row_begin = edges[home_tile];
    const int home_count = edges[home_tile + 1] - row_begin;
    const Rows packed(arrays.packed), cotangents(arrays.cotangents);
    const size_t pitch = arrays.partial.shape[2];
    const auto store = [&](size_t slab, int row, int i, Real value) {
        Real& sum = arrays.partial.data[(slab * ROWS + row) * pitch + i];
        sum = nearest == 1 ? value : sum + value; // the first pass begins the sums
    };

    Balls home[MOMENTS];
    GradientSums sums[MOMENTS];
#pragma unroll
    for (int k = 0; k < MOMENTS; ++k) // lanes beyond the last moment repeat it
        home[k] = balls_from(packed, cotangents, row_begin + min(lane + 32 * k, home_count - 1));

    Real* const stage = (Real*)staging[warp];
#pragma unroll 1
    for (int n = walk_begin; n < walk_end; ++n) {
        const int distance = n / tiles.stages;
        const int other = home_tile + distance < count ? home_tile + distance : home_tile + distance - count;
        const int begin = edges[other] + 32 * (n - distance * tiles.stages), exists = min(32, edges[other + 1] - begin);
        if (exists <= 0) continue;
        const int i = begin + min(lane, exists - 1);
        __syncwarp();
        for (int row = 0; row < STAGED; ++row) {
            const Rows& from = row < PACKED ? packed : cotangents;
            stage[32 * row + lane] = from.lanes(row < PACKED ? row : row - PACKED, i);
        }
        __syncwarp();
        const GradientSums mirrored = add_stage(home, sums, home_count, stage, exists, lane);
        if (distance == 0 || lane >= exists) continue; // a tile has its pairs in both orders
        for (int row = 0; row < ROWS; ++row)
            store(distance - nearest, row, begin + lane, ((const Real*)mirrored.part)[row]);
    }
    __syncwarp();
#pragma unroll
    for (int k = 0; k < MOMENTS; ++k)
        for (int row = 0; row < ROWS; ++row) stage[HOME * row + lane + 32 * k] = ((const Real*)sums[k].part)[row];
    __syncthreads();
    sum_warps(staging, thread, HOME * ROWS, [&](int item, Real total) {
        if (item % HOME < home_count) store(tiles.slabs + share, item / HOME, row_begin + item % HOME, total);
    });
}

}
