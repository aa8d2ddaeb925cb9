// Groups of ``GROUP`` GPU threads that share a ball; Python sets ``GROUP``, a power of two. On a CPU one thread
// processes a vector of balls.
#pragma once
#include "shared/vectors.h"

namespace warpmag {

#if defined(__CUDA_ARCH__)
constexpr int SHARES = GROUP; // threads that share a ball
// Index of this thread in its group.
CUDA_CALLABLE inline int share() { return threadIdx.x % GROUP; }
// Mask of the group's threads in the warp.
CUDA_CALLABLE inline unsigned group_mask() { return (~0u >> (32 - GROUP)) << (threadIdx.x % 32 / GROUP * GROUP); }
// Sum over the threads of a group; all threads of the warp take part.
CUDA_CALLABLE inline Number group_total(Number part) {
    for (int step = 1; step < GROUP; step *= 2) part += __shfl_xor_sync(~0u, part, step);
    return part;
}
// Sum over the threads of a group whose warp may have diverged.
CUDA_CALLABLE inline Number group_sum(Number part) {
    for (int step = 1; step < GROUP; step *= 2) part += __shfl_xor_sync(group_mask(), part, step);
    return part;
}
// Largest count among a warp's balls.
CUDA_CALLABLE inline int largest_count(const int* counts) {
    int largest = *counts;
    for (int step = GROUP; step < 32; step *= 2) {
        const int count = __shfl_xor_sync(~0u, largest, step);
        largest = count > largest ? count : largest;
    }
    return largest;
}
// Sum of integers over the threads of a group.
CUDA_CALLABLE inline int group_count(int part) {
    for (int step = 1; step < GROUP; step *= 2) part += __shfl_xor_sync(group_mask(), part, step);
    return part;
}
// Largest integer of the threads of a group.
CUDA_CALLABLE inline int group_most(int part) {
    for (int step = 1; step < GROUP; step *= 2) {
        const int other = __shfl_xor_sync(group_mask(), part, step);
        part = other > part ? other : part;
    }
    return part;
}
// Value of the first thread of a group.
CUDA_CALLABLE inline int of_first_share(int value) { return __shfl_sync(group_mask(), value, 0, GROUP); }
// Place of this thread among those of its group that ask for one, from ``next`` on, which moves by their number.
CUDA_CALLABLE inline int next_place(bool asks, int& next) {
    const unsigned asking = __ballot_sync(group_mask(), asks) & group_mask();
    const int place = next + __popc(asking & ((1u << threadIdx.x % 32) - 1));
    next += __popc(asking);
    return place;
}
#else
constexpr int SHARES = 1;
inline constexpr int share() { return 0; }
inline Number group_total(Number part) { return part; }
inline Number group_sum(Number part) { return part; }
inline int group_count(int part) { return part; }
inline int group_most(int part) { return part; }
inline int of_first_share(int value) { return value; }
inline int next_place(bool asks, int& next) { return asks ? next++ : next; }
// Largest count among a vector's balls.
inline int largest_count(const int* counts) {
    int largest = 0;
    for (int l = 0; l < WIDTH; ++l) largest = counts[l] > largest ? counts[l] : largest;
    return largest;
}
#endif

CUDA_CALLABLE inline Vector group_sums(Vector part) {
    return {group_sum(part.x), group_sum(part.y), group_sum(part.z)};
}
}
