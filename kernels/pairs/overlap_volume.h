// Volume that moments share with others. Takes CAPACITY and GROUP, see neighbor_lists.h.
#pragma once
#include "pairs/neighbor_lists.h"
#include "pairs/pair_law.h"

namespace warpmag {

// Σ_j |B_i ∩ B_j|/√(V_i V_j) of ``held`` moments from i on with those from begin to end that wanted(i, j) accepts. The
// struct has packed moments, and lists of what overlaps each.
template <class Lists, class Wanted>
CUDA_CALLABLE inline Number shared_volumes(const Lists& lists, int i, int held, int begin, int end, Wanted wanted) {
    const Real* const packed = (const Real*)lists.packed.data;
    const size_t pitch = lists.packed.strides[0] / sizeof(Real);
    Index self = Index(i);
#if !defined(__CUDA_ARCH__)
    for (int l = 0; l < WIDTH; ++l) self[l] += l;
#endif
    auto row = [&](int c, Index j) { return collect(packed + c * pitch, j); };
    const Vector x = {row(0, self), row(1, self), row(2, self)};
    const Number radius = row(3, self);
    Number volume = 0;
    auto add = [&](Index j, Mask listed) {
        const Vector r = {x.x - row(0, j), x.y - row(1, j), x.z - row(2, j)};
        volume += shared_volume(dot(r, r), radius, row(3, j), listed & wanted(self, j));
    };
    walk_lists(lists.overlap.data, lists.overlap_count.data, self, held, Index(begin), Index(end), add);
    return group_sum(volume);
}
}
