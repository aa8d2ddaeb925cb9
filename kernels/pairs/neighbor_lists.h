// Loops over lists of neighbors. From Python: CAPACITY, the length of a list, and GROUP, the threads of a GPU that
// share a ball.
#pragma once
#include "pairs/pair_law.h"
#include "shared/group.h"

namespace warpmag {

// Calls visit(j, listed) for each entry j of the lists of balls i; ``listed`` masks the sources from begin to end. If a
// list is full, all of these sources are visited instead. The threads of a group take turns.
#if defined(__CUDA_ARCH__)
template <class Visit>
CUDA_CALLABLE inline void walk_lists(const int* lists, const int* counts, int i, int, int begin, int end, Visit visit) {
    const int* const list = lists + (size_t)CAPACITY * i;
    const int count = counts[i], nearest = list[share()]; // read before the count is known
    const bool listed = count <= CAPACITY;
    for (int s = share(); s < (listed ? count : end - begin); s += SHARES) {
        const int j = !listed ? begin + s : s < SHARES ? nearest : list[s];
        visit(j, j >= begin && j < end);
    }
}
#else
template <class Visit>
inline void walk_lists(const int* lists, const int* counts, Index i, int lane_count, Index begin, Index end,
                       Visit visit) {
    Index own = i[0], first = 0, count = 0, full = 0;
    // length of the longest list, and range of sources of the balls whose list is full
    int longest = 0, lowest = __INT_MAX__, highest = 0;
    for (int l = 0; l < lane_count; ++l) {
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

// Volumes that balls share with others, Σ_j |B_i ∩ B_j|, over √(V_i V_j) and over the own volume V_i.
struct SharedVolumes {
    Number over_mean, over_own;
};
// Shared volumes of ``lane_count`` moments from i on, over sources j from begin to end that accepts(i, j) selects.
// ``lists`` has the packed moments and the overlap lists.
template <class Lists, class Accepts>
CUDA_CALLABLE inline SharedVolumes shared_volumes(const Lists& lists, int i, int lane_count, int begin, int end,
                                                  Accepts accepts) {
    const Real* const packed = (const Real*)lists.packed.data;
    const size_t pitch = lists.packed.strides[0] / sizeof(Real);
    Index self = Index(i);
#if !defined(__CUDA_ARCH__)
    for (int l = 0; l < WIDTH; ++l) self[l] += l;
#endif
    auto row = [&](int c, auto j) { return Number(Real(0)) + collect(packed + c * pitch, j); };
    const Vector x = {row(0, self), row(1, self), row(2, self)};
    const Number radius = row(3, self);
    SharedVolumes sums = {Number(Real(0)), Number(Real(0))};
    auto add = [&](auto j, Mask listed) {
        const Mask accepted = listed & accepts(self, Index(j));
        if (!any(accepted)) return;
        const Vector r = {x.x - row(0, j), x.y - row(1, j), x.z - row(2, j)};
        const Number other_radius = row(3, j), contact = radius + other_radius;
        const Mask overlapping = accepted & (dot(r, r) < contact * contact);
        if (!any(overlapping)) return;
        const Number volume = shared_volume(dot(r, r), radius, other_radius, overlapping);
        const Number ratio = overlapping ? other_radius / radius : Number(Real(1));
        sums.over_mean += volume;
        sums.over_own += volume * ratio * root(ratio);
    };
    walk_lists(lists.overlap.data, lists.overlap_count.data, self, lane_count, Index(begin), Index(end), add);
    return {group_sum(sums.over_mean), group_sum(sums.over_own)};
}
}
