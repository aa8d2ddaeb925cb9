// Field of straight pieces of wire. With r and s from the ends of a piece to the point, and L from end to end,
//
//     H = I/4π (L × r) f,   f = (|r| + |s|)/(|r||s| (|r||s| + r·s))
//
// (Hanson and Hirshman 2002, "Compact expressions for the Biot-Savart fields of a filamentary segment", Phys. Plasmas
// 9, 4410). The gradient of f is derived term by term. Beside the piece |r||s| + r·s cancels, and is written as
// |L × r|²/(|r||s| − r·s).
#pragma once
#include "applied/point_field.h"

namespace warpmag {

// Field of a thin piece from a to b, of 4π amperes.
CUDA_CALLABLE inline PointField thin_piece(Point a, Point b, Point x) {
    const Point l = b - a, r = x - a, s = x - b, normal = cross(l, r);
    const double rs = dot(r, s), nr = norm(r), ns = norm(s), product = nr * ns;
    const double opening = rs < 0 ? dot(normal, normal) / (product - rs) : product + rs;
    const double numerator = nr + ns, denominator = product * opening;
    const Point d_numerator = (1 / nr) * r + (1 / ns) * s, d_product = (ns / nr) * r + (nr / ns) * s;
    const Point d_denominator = opening * d_product + product * (d_product + r + s);
    const double f = numerator / denominator;
    const Point df = (1 / denominator) * (d_numerator - f * d_denominator);
    return {f * normal, df.x * normal + f * cross(l, {1, 0, 0}), df.y * normal + f * cross(l, {0, 1, 0}),
            df.z * normal + f * cross(l, {0, 0, 1})};
}

// Field of a piece of wire of radius w, of 4π amperes.
CUDA_CALLABLE inline PointField piece_field(Point a, Point b, double w, Point x) {
    const Point l = b - a;
    const double length2 = dot(l, l), at = dot(x - a, l) / length2, nearest = at < 0 ? 0.0 : at > 1 ? 1.0 : at;
    const Point axis = a + nearest * l, away = x - axis;
    const double d = norm(away);
    if (d >= w) return thin_piece(a, b, x);
    const bool beside = at > 0 && at < 1;
    const Point tangent = beside ? (1 / sqrt(length2)) * l : Point{0, 0, 0};
    // on the axis any perpendicular direction serves
    const Point across = fabs(l.x) < fabs(l.y) ? cross(l, {1, 0, 0}) : cross(l, {0, 1, 0});
    const Point n = d > 0 ? (1 / d) * away : (1 / norm(across)) * across;
    return InWire{n, tangent, d, w, 1}.inner_field(thin_piece(a, b, axis + w * n));
}

// Polyline through the points of the table. Parameter: wire radius w [m]. Strength: ampere-turns [A].
CUDA_CALLABLE inline PointField polyline_field(const AppliedSource& source, Point x) {
    PointField total = {};
    for (int k = 0; k + 1 < source.count; ++k)
        total += piece_field(source.table[k], source.table[k + 1], source.parameters[0], x);
    return 0.25 * INVERSE_PI * source.strength.x * total;
}
}
