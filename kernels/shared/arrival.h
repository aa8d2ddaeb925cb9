// Work of the last block of a GPU's launch.
#pragma once

namespace warpmag {

#if defined(__CUDA_ARCH__)
// Returns whether this block is the last of ``count`` blocks to call this function. The last block may read what all
// blocks wrote. ``arrived`` counts the calls: zero before the first and after the last.
CUDA_CALLABLE inline bool is_last_of(int* arrived, int count) {
    __shared__ bool last;
    __syncthreads();
    if (threadIdx.x == 0) {
        __threadfence();
        last = atomicAdd(arrived, 1) == count - 1;
        if (last) *arrived = 0;
        __threadfence();
    }
    __syncthreads();
    return last;
}
#endif

}
