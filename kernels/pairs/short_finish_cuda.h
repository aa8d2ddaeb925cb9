// Sums and their finish in one kernel on a GPU, for targets that have few sources each, as in thousands of small
// worlds. A group of GROUP threads sums and finishes a target row.
#pragma once
#include "pairs/finish.h"
#include "pairs/tiles_cuda.h"

namespace warpmag {

template <Quantity Q, class Arrays> CUDA_CALLABLE inline void sum_and_finish_row(const Arrays& arrays, int n) {
    const int row = active_item(arrays.active, n);
    if (row < 0) return;
    const TargetRows at = target_rows(arrays, row);
    constexpr bool FIELD = Q == Quantity::FIELD;
    const Table targets(arrays.targets), sources(arrays.sources);
    const Moment target = targets.moment(at.i);
    const Vector base = vectors_at((const Real*)arrays.base.data, at.i);
    Vector e = {0, 0, 0};
    if constexpr (!FIELD) e = Columns(arrays.effective).vector(0, at.i);
    LaneTargets<Q, 1> lane;
    lane.targets[0] = {target.x, target.radius, target.label, {e.x, e.y, e.z}};
    for (int j = at.begin + share(); j < at.end; j += SHARES) {
        const Moment s = sources.moment(j);
        const bool masked = FIELD ? arrays.same_set && j == at.i : s.label == target.label;
        lane.add_masked({s.x, s.m, scaled_moment(Q) * s.m}, s.radius, [=](int) { return masked; });
    }
    Real sums[width(Q)];
    results<Q>(lane.sums[0], lane.targets[0].e, sums);
    constexpr int H = Q == Quantity::WRENCH ? 3 : 0;
    Vector f = {sums[0], sums[1], sums[2]}, h = {sums[H], sums[H + 1], sums[H + 2]};
    add_overlaps<Q>(h, f, e, arrays, at);
    store<Q>(arrays, at, group_sums(h), group_sums(f), e, base);
}
}
