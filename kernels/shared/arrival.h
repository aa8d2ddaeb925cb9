// Work that a GPU's blocks leave to the last of them.
#pragma once

namespace warpmag {

#if defined(__CUDA_ARCH__)
// Whether this block is the last of ``count`` that come here, which can read what they have all written. The number of
// those that have come, zero before the first, is zero again after the last.
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
