// Walks over lists of neighbours. Takes CAPACITY, the length of a list, from Python, and on a GPU GROUP, the threads
// that share a ball.
#pragma once
#include "shared/group.h"

namespace warpmag {

// Calls visit(j, listed) for one entry after the other of the lists of balls i, as far as they name sources from begin
// to end; where a list is full, for all of these. The threads of a group take turns.
#if defined(__CUDA_ARCH__)
template <class Visit>
CUDA_CALLABLE inline void walk_lists(const int* lists, const int* counts, int i, int, int begin, int end, Visit visit) {
    const int* const list = lists + (size_t)CAPACITY * i;
    const int count = counts[i], nearest = list[share()]; // read at once, whether it is an entry or not
    const bool listed = count <= CAPACITY;
    for (int s = share(); s < (listed ? count : end - begin); s += SHARES) {
        const int j = !listed ? begin + s : s < SHARES ? nearest : list[s];
        visit(j, j >= begin && j < end);
    }
}
#else
template <class Visit>
inline void walk_lists(const int* lists, const int* counts, Index i, int held, Index begin, Index end, Visit visit) {
    Index first = 0, count = 0, full = 0;
    int longest = 0;
    for (int l = 0; l < held; ++l) {
        if (end[l] <= begin[l]) continue;
        first[l] = begin[l];
        full[l] = counts[i[l]] > CAPACITY;
        count[l] = full[l] ? end[l] - begin[l] : counts[i[l]];
        longest = count[l] > longest ? count[l] : longest;
    }
    for (int s = 0; s < longest; ++s) {
        Index j = first;
        for (int l = 0; l < held; ++l)
            if (s < count[l]) j[l] = full[l] ? begin[l] + s : lists[(size_t)CAPACITY * i[l] + s];
        visit(j, mask_of((count > s) & (j >= begin) & (j < end)));
    }
}
#endif
}
