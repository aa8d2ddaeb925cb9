// Thickening of source boxes that intersect their targets, for averages over the Gauss points of the targets.
#pragma once
#include "cells/gauss_points.h"
#include "cells/rotation.h"

namespace warpmag {

constexpr Real THICKENING_BEGIN = Real(0.1), THICKENING_END = Real(0.35); // common parts of intersecting boxes

// Common part of the projections of two boxes on each axis of one of them, half sides ``own``; ``extent`` are half the
// projections of the other one, ``at`` is its center. The least of three, over the shorter projection: 0 to 1.
CUDA_CALLABLE inline Number least_common(Vector own, Vector extent, Vector at) {
    auto common = [](Number a, Number b, Number d) {
        const Number shorter = 2 * smaller(a, b), zero = a * Real(0);
        return larger(smaller(a + b - larger(d, -d), shorter), zero) / larger(shorter, zero + Real(1e-30));
    };
    return smaller(common(own.x, extent.x, at.x),
                   smaller(common(own.y, extent.y, at.y), common(own.z, extent.z, at.z)));
}

// Half sides of a source that a target intersects, for its field: along each axis at least the distance of the target's
// Gauss points from its center, for the same moment. A thin sheet in a cell would contain none of the points or half of
// them, and then the operator of the cells is not positive. Arguments as in ``SourceAndTarget``. The function
// is not inlined: on a GPU its registers would slow all pairs, which then took 1.6 times as long.
__attribute__((noinline)) CUDA_CALLABLE inline Vector thickened(Vector half, Vector target, Vector center,
                                                                const Rotation<Number>& rotation) {
    auto magnitude = [](Number x) { return larger(x, -x); };
    Rotation<Number> size;
    for (int k = 0; k < 3; ++k)
        for (int l = 0; l < 3; ++l) size.rows[k][l] = magnitude(rotation.rows[k][l]);
    const Vector extent = to_world(size, target);
    const auto apart = [](Number h, Number e, Number d) { return (larger(d, -d) >= h + e); };
    const Mask thin =
        (half.x < GAUSS_PLACE * extent.x) | (half.y < GAUSS_PLACE * extent.y) | (half.z < GAUSS_PLACE * extent.z);
    const Mask outside =
        apart(half.x, extent.x, center.x) | apart(half.y, extent.y, center.y) | apart(half.z, extent.z, center.z);
    if (!any(thin && !outside)) return half;
    const Number least = smaller(least_common(half, extent, center),
                                 least_common(target, to_body(size, half), to_body(rotation, center)));
    const Number zero = least * Real(0), within = (least - THICKENING_BEGIN) / (THICKENING_END - THICKENING_BEGIN);
    const Number share = smaller(larger(within, zero), zero + 1);
    auto side = [&](Number h, Number e) { return h + share * larger(GAUSS_PLACE * e - h, zero); };
    return {side(half.x, extent.x), side(half.y, extent.y), side(half.z, extent.z)};
}
}
