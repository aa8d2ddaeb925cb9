// Differences across layers of one cell. Along an axis without neighbors the difference between the halves of a cell
// follows from those along the other axes, so that div M = 0 (``warpmag.shapes.linear_cells``). Vectors V are of one
// cell or of the cells of all lanes. Factors are positive for axes without neighbors, negative for the others, and 0
// for cells without such differences.
#pragma once
#include "shared/vectors.h"

namespace warpmag {

template <class N> CUDA_CALLABLE inline N positive_part(N x) { return x > Real(0) ? x : x * Real(0); }
template <class V> CUDA_CALLABLE inline V positive_parts(V a) {
    return {positive_part(a.x), positive_part(a.y), positive_part(a.z)};
}

// All differences, from those between neighbors.
template <class V> CUDA_CALLABLE inline V layer_differences(V factors, V differences) {
    const V across = positive_parts(factors), others = factors - across;
    return differences + dot(others, differences) * across;
}

// Fields that act on the differences between neighbors, from those that act on all differences: the transpose.
template <class V> CUDA_CALLABLE inline V layer_fields(V factors, V fields) {
    const V across = positive_parts(factors), others = factors - across;
    return fields + dot(across, fields) * others;
}
}
