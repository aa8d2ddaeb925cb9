// Detection of the last block of a GPU launch that finishes its work.
#pragma once

namespace warpmag {

#if defined(__CUDA_ARCH__)
// Returns true in the last of ``count`` blocks that call this function. That block may read everything that the others
// wrote before their calls. ``arrived`` counts the calls; it is zero before the first and after the last.
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
