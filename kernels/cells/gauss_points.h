// Gauss points of a box, over which the field of another one is averaged.
#pragma once
#include "shared/vectors.h"

namespace warpmag {

constexpr Real GAUSS_PLACE = Real(0.5773502691896258); // of two points in a box of half sides 1

CUDA_CALLABLE inline Number shortest(Vector half) { return smaller(half.x, smaller(half.y, half.z)); }

// Range of the 2³ Gauss points of a box that a thread sums over. Terms that belong to no point are added with the first
// point.
struct Points {
    int first, count;
};
constexpr int POINTS = 8;
constexpr Points ALL_POINTS = {0, POINTS};

// Point of a box: weight in units of that of 2³ points and its derivative by ``fine``, place, and sign of its half
// along each axis. A factor of the signs makes half the difference of a linear field between the halves exact: points
// lie beside the halves' centers.
struct GaussPoint {
    Number weight, slope;
    Vector at, signs;
};

// Calls visit(point) for Gauss points of a box of half sides h: 2³ points of weights 1 − fine, and 4 × 4 × 2 points,
// two along the shortest side, of weights fine/4. Four of these are in the octant of each of the 2³ points.
template <class Visit> CUDA_CALLABLE inline void for_gauss_points(Vector h, Number fine, Points points, Visit visit) {
    const Number zero = fine * Real(0), least = shortest(h);
    const Mask flat_x = h.x <= least, flat_y = (h.y <= least) & !flat_x;
    const int first = any(fine < Real(1)) ? 0 : 1, last = any(fine > zero) ? 4 : 0;
#pragma unroll 1
    for (int k = points.first; k < points.first + points.count; ++k)
#pragma unroll 1
        for (int n = first; n <= last; ++n) {
            const Real four = n ? Real(1) : Real(0), a = n & 1 ? Real(1) : Real(-1), b = n > 2 ? Real(1) : Real(-1);
            const Number split_x = flat_x ? zero : zero + four, split_y = flat_y ? zero : zero + four,
                         split_z = flat_x | flat_y ? zero + four : zero;
            // over the half side: the half of sign ``side`` has one point, or is split in two and has two
            auto place = [](Real side, Number split, Number half) {
                return side * (GAUSS_PLACE + split * (Real(0.5) - GAUSS_PLACE)) + split * half * (GAUSS_PLACE / 2);
            };
            auto sign = [](Real side, Number split) {
                constexpr Real SINGLE = Real(0.5) / GAUSS_PLACE;
                return side * (SINGLE + split * (1 - SINGLE));
            };
            const Real x = k & 1 ? Real(1) : Real(-1), y = k & 2 ? Real(1) : Real(-1), z = k & 4 ? Real(1) : Real(-1);
            visit({n ? Real(0.25) * fine : 1 - fine,
                   n ? zero + Real(0.25) : zero - 1,
                   {h.x * place(x, split_x, zero + a), h.y * place(y, split_y, flat_x ? zero + a : zero + b),
                    h.z * place(z, split_z, zero + b)},
                   {sign(x, split_x), sign(y, split_y), sign(z, split_z)}});
        }
}
}
