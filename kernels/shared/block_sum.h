// Sum of a vector over the threads of a GPU's block, in a fixed order.
#pragma once

namespace warpmag {

#if defined(__CUDA_ARCH__)
constexpr int MOST_WARPS = 8; // largest number of warps of a block that sums

// Adds up LEFT columns, the components of the vector, over the threads of a warp. In each exchange a thread passes on
// half of its columns, so that it ends with the sum of one.
template <int STEP, int LEFT, class Scalar> CUDA_CALLABLE inline void add_columns(Scalar* columns) {
    constexpr int HALF = LEFT / 2;
    const bool upper = HALF > 0 && (threadIdx.x & STEP) != 0;
#pragma unroll
    for (int c = 0; c < LEFT - HALF; ++c) {
        const Scalar kept = upper ? columns[c + HALF] : columns[c], passed = upper ? columns[c] : columns[c + HALF];
        columns[c] = kept + __shfl_xor_sync(~0u, passed, STEP);
    }
    if constexpr (STEP > 1) add_columns<STEP / 2, LEFT - HALF>(columns);
}

// All threads of the block call this function, and receive the same sum.
template <unsigned N, class Scalar> CUDA_CALLABLE inline wp::vec_t<N, Scalar> block_sum(wp::vec_t<N, Scalar> value) {
    static_assert(N <= 32);
    constexpr int COLUMNS = N > 16 ? 32 : N > 8 ? 16 : N > 4 ? 8 : N > 2 ? 4 : 2;
    __shared__ Scalar of_warps[MOST_WARPS][COLUMNS];
    Scalar columns[COLUMNS];
#pragma unroll
    for (int c = 0; c < COLUMNS; ++c) columns[c] = c < N ? value[c] : Scalar(0);
    add_columns<16, COLUMNS>(columns);
    of_warps[threadIdx.x / 32][threadIdx.x % 32 * COLUMNS / 32] = columns[0]; // threads of a column write the same
    __syncthreads();
    for (int c = 0; c < N; ++c) {
        value[c] = 0;
        for (int warp = 0; warp < blockDim.x / 32; ++warp) value[c] += of_warps[warp][c];
    }
    __syncthreads();
    return value;
}
#else
template <class Vector> inline Vector block_sum(Vector value) { return value; } // a block has one thread
#endif
}
