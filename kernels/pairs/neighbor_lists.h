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
    Index own = i[0], first = 0, count = 0, full = 0;
    int longest = 0, lowest = __INT_MAX__, highest = 0; // of the lists; of the sources of balls whose list is full
    for (int l = 0; l < held; ++l) {
        if (end[l] <= begin[l]) continue;
        own[l] = i[l], first[l] = begin[l];
        full[l] = counts[i[l]] > CAPACITY;
        if (full[l]) {
            lowest = begin[l] < lowest ? begin[l] : lowest;
            highest = end[l] > highest ? end[l] : highest;
        } else {
            count[l] = counts[i[l]];
            longest = count[l] > longest ? count[l] : longest;
        }
    }
    for (int s = 0; s < longest; ++s) {
        Index j;
        for (int l = 0; l < WIDTH; ++l) j[l] = lists[(size_t)CAPACITY * own[l] + s];
        const auto listed = count > s;
        j = listed ? j : first;
        visit(j, mask_of(listed & (j >= begin) & (j < end)));
    }
    for (int j = lowest; j < highest; ++j) visit(j, mask_of((full != 0) & (j >= begin) & (j < end)));
}
#endif
}
