// Tensor and forces of a pair of magnetized boxes, less those of balls of the same volumes, in the frame of box i.
//
// The tensor is the field of each box, averaged over 2³ Gauss points of the other one, and the mean of both, so that it
// is symmetric. A window blends it into the law of the balls with growing distance. Forces are the exact derivatives of
// the energy −μ0 m_i·T_ij·m_j, so that they conserve energy and momentum. Lengths are in units of the mean of the
// boxes' sizes.
//
// From Python: WINDOW_BEGIN, WINDOW_END, CLOSE_BEGIN and CLOSE_END, distances of the windows; CLOSE_POINTS, Gauss
// points of close boxes along each axis.
#pragma once
#include "cells/box_field.h"
#include "cells/rotation.h"
#include "pairs/pair_law.h"

namespace warpmag {

// Boxes of cells: half sides, rotation to the world as quaternion, volume, and the size that scales the window.
struct Boxes {
    Vector half;
    Number q[4], volume, size, radius; // radius of the ball of the same volume
};

// Pose of box j relative to box i: separation, and rotation from the frame of j to that of i.
struct RelativePose {
    Vector r;
    Number q[4];
};
CUDA_CALLABLE inline RelativePose relative_pose(Vector apart, const Boxes& own, const Boxes& other) {
    const Number *a = own.q, *b = other.q;
    return {
        to_body(rotation_of<Number>(a), apart),
        {a[3] * b[0] - a[0] * b[3] - a[1] * b[2] + a[2] * b[1], a[3] * b[1] - a[1] * b[3] - a[2] * b[0] + a[0] * b[2],
         a[3] * b[2] - a[2] * b[3] - a[0] * b[1] + a[1] * b[0], a[3] * b[3] + a[0] * b[0] + a[1] * b[1] + a[2] * b[2]}};
}

// Factor that falls from 1 to 0 with the distance, and its derivative.
struct Window {
    Number value, slope;
};
CUDA_CALLABLE inline Window window_between(Number d, Real begin, Real end, Mask listed) {
    const Number zero = d * Real(0), t = smaller(larger((end - d) * (1 / (end - begin)), zero), zero + 1);
    return {listed ? t * t * (3 - 2 * t) : zero, listed ? t * (1 - t) * (-6 / (end - begin)) : zero};
}

// A pair of boxes in units of ``1/unit``: half sides, separation r from i to j, rotation of j in the frame of i, radii
// of the balls, the window of all boxes, and that of boxes that are integrated over.
struct BoxPair {
    Vector half, other_half, r;
    Rotation<Number> rotation;
    Number unit, radius, other_radius;
    Window window, close;
};
CUDA_CALLABLE inline BoxPair box_pair(const Boxes& own, const Boxes& other, const RelativePose& pose, Mask listed) {
    const Number unit = 2 / (own.size + other.size);
    const Vector r = unit * pose.r;
    const Number d = length(r);
    return {unit * own.half,
            unit * other.half,
            r,
            rotation_of<Number>(pose.q),
            unit,
            unit * own.radius,
            unit * other.radius,
            window_between(d, WINDOW_BEGIN, WINDOW_END, listed),
            window_between(d, CLOSE_BEGIN, CLOSE_END, listed)};
}

// Calls visit(p, weight) for the POINTS³ Gauss points of a box of half sides h.
template <int POINTS, class Visit> CUDA_CALLABLE inline void for_gauss_points(Vector h, Visit visit) {
    constexpr Real PLACE = POINTS == 1 ? Real(0) : POINTS == 2 ? Real(0.5773502691896258) : Real(0.7745966692414834);
    constexpr Real OUTER = POINTS == 1 ? Real(1) : POINTS == 2 ? Real(0.5) : Real(5.0 / 18), INNER = Real(8.0 / 18);
    auto place = [](int k) { return PLACE * (POINTS == 2 ? 2 * k - 1 : k - POINTS / 2); };
    auto weight = [](int k) { return POINTS == 3 && k == 1 ? INNER : OUTER; };
    for (int a = 0; a < POINTS; ++a)
        for (int b = 0; b < POINTS; ++b)
            for (int c = 0; c < POINTS; ++c)
                visit(Vector{place(a) * h.x, place(b) * h.y, place(c) * h.z}, weight(a) * weight(b) * weight(c));
}

CUDA_CALLABLE inline Symmetric operator+(const Symmetric& a, const Symmetric& b) {
    return {a.xx + b.xx, a.yy + b.yy, a.zz + b.zz, a.xy + b.xy, a.yz + b.yz, a.zx + b.zx};
}
CUDA_CALLABLE inline Symmetric operator*(Number k, const Symmetric& a) {
    return {k * a.xx, k * a.yy, k * a.zz, k * a.xy, k * a.yz, k * a.zx};
}

// A tensor of the frame of j in the frame of i.
CUDA_CALLABLE inline Symmetric rotated(const Rotation<Number>& q, const Symmetric& k) {
    Vector columns[3]; // of k qᵀ
    for (int c = 0; c < 3; ++c) columns[c] = k * Vector{q.rows[c][0], q.rows[c][1], q.rows[c][2]};
    const Vector x = to_world(q, columns[0]), y = to_world(q, columns[1]), z = to_world(q, columns[2]);
    return {x.x, y.y, z.z, y.x, z.y, z.x};
}

// Law of the balls, in the units of the pair: direction from j to i, distance, and radial factors.
struct BallLaw {
    Vector u;
    Number d;
    Factors<Number> g;
};
CUDA_CALLABLE inline BallLaw ball_law(const BoxPair& p) {
    const Number a = p.radius, b = p.other_radius, zero = a * Real(0);
    const Polar at = polar(-p.r);
    const Number d = larger(at.d, zero + Real(1e-12)), inverse = 1 / d, i3 = inverse * inverse * inverse;
    Factors<Number> g = {-i3, 3 * i3 * inverse, -15 * i3 * inverse};
    const Mask overlap = d < a + b;
    if (any(overlap)) {
        const Factors<Number> near = averaged_factors(d, a, b, larger(a - b, b - a));
        g = {overlap ? near.g1 : g.g1, overlap ? near.g2 : g.g2, overlap ? near.g3 : g.g3};
    }
    return {at.u, d, g};
}

// Sum of both boxes' fields, each averaged over the Gauss points of the other box, in the frame of i.
template <int POINTS> CUDA_CALLABLE inline Symmetric boxes_tensor(const BoxPair& p) {
    const Number zero = p.unit * Real(0), share = zero + 1;
    Symmetric of_other = {zero, zero, zero, zero, zero, zero}, of_own = of_other;
    for_gauss_points<POINTS>(p.half, [&](Vector x, Real w) {
        of_other = of_other + (zero + w) * box_tensor(view_box(to_body(p.rotation, x - p.r), p.other_half));
    });
    for_gauss_points<POINTS>(p.other_half, [&](Vector x, Real w) {
        of_own = of_own + (zero + w) * box_tensor(view_box(p.r + to_world(p.rotation, x), p.half));
    });
    const Vector a = p.half, b = p.other_half;
    return share / (8 * b.x * b.y * b.z) * rotated(p.rotation, of_other) + share / (8 * a.x * a.y * a.z) * of_own;
}

// Tensor of the pair less that of the balls, in the frame of i and the units of the pair. Close boxes are the mean of
// both averages. Those farther away are the sum of both fields at the centers less that of dipoles, which has the
// quadrupoles of both boxes.
CUDA_CALLABLE inline Symmetric pair_tensor(const BoxPair& p) {
    const Number zero = p.unit * Real(0), close = p.close.value;
    Symmetric boxes = {zero, zero, zero, zero, zero, zero};
    if (any(close > zero)) boxes = Real(0.5) * close * boxes_tensor<CLOSE_POINTS>(p);
    if (any(close < zero + 1)) boxes = boxes + (1 - close) * boxes_tensor<1>(p);
    const BallLaw ball = ball_law(p);
    const Vector u = ball.u;
    const Number factor = INVERSE_4_PI * (2 - close), g1 = factor * ball.g.g1, g2 = factor * ball.g.g2 * ball.d;
    return {boxes.xx - g1 - g2 * u.x * u.x, boxes.yy - g1 - g2 * u.y * u.y, boxes.zz - g1 - g2 * u.z * u.z,
            boxes.xy - g2 * u.x * u.y,      boxes.yz - g2 * u.y * u.z,      boxes.zx - g2 * u.z * u.x};
}

// Share of a cell's depth that it lies inside a box of another body: 0 for disjoint boxes, at most 1. Disjoint boxes
// have disjoint inscribed spheres.
CUDA_CALLABLE inline Number overlap_depth(const Boxes& own, const Boxes& other, Vector apart) {
    auto inscribed = [](Vector h) { return smaller(h.x, smaller(h.y, h.z)); };
    const Number zero = own.size * Real(0), reach = inscribed(own.half) + inscribed(other.half);
    return larger(1 - length(apart) / reach, zero);
}

// Force on a cell, torque about its center, and the negative energy that they are derivatives of.
struct Wrench {
    Vector force, torque;
    Number work;

    CUDA_CALLABLE void add(Number k, const Wrench& w) {
        force += k * w.force;
        torque += k * w.torque;
        work += k * w.work;
    }
};

// Wrench of m·T e, for T of ``boxes_tensor`` and moments m of i and e of j, in the frame of i.
template <int POINTS> CUDA_CALLABLE inline Wrench boxes_wrench(const BoxPair& p, Vector m, Vector e) {
    const Number zero = p.unit * Real(0), share = zero + 1;
    const Vector a = p.half, b = p.other_half, none = {zero, zero, zero};
    Wrench of_other = {none, none, zero}, of_own = of_other;
    const Vector r_j = to_body(p.rotation, p.r), m_j = to_body(p.rotation, m), e_j = to_body(p.rotation, e);
    for_gauss_points<POINTS>(p.half, [&](Vector x, Real w) { // points of i in the field of j, in the frame of j
        const Vector arm = to_body(p.rotation, x);
        const BoxView view = view_box(arm - r_j, p.other_half);
        const Vector force = box_slope(view, e_j, m_j), field = box_tensor(view) * e_j;
        of_other.add(zero + w, {force, cross(arm, force) + cross(m_j, field), dot(m_j, field)});
    });
    for_gauss_points<POINTS>(p.other_half, [&](Vector x, Real w) { // points of j in the field of i
        const Vector at = p.r + to_world(p.rotation, x);
        const BoxView view = view_box(at, p.half);
        const Vector force = box_slope(view, m, e), field = box_tensor(view) * m;
        of_own.add(zero - w, {force, cross(at, force) + cross(e, field), -dot(e, field)});
    });
    Wrench sum = {none, none, zero};
    sum.add(share / (8 * a.x * a.y * a.z), of_own);
    const Wrench turned = {to_world(p.rotation, of_other.force), to_world(p.rotation, of_other.torque), of_other.work};
    sum.add(share / (8 * b.x * b.y * b.z), turned);
    return sum;
}

// Wrench of m·T e, for the tensor of the balls.
CUDA_CALLABLE inline Wrench ball_wrench(const BoxPair& p, Vector m, Vector e) {
    const BallLaw ball = ball_law(p);
    const Vector u = ball.u;
    const Number um = dot(u, m), ue = dot(u, e), product = dot(m, e);
    const Number g2 = INVERSE_4_PI * ball.g.g2, radial = g2 * product + INVERSE_4_PI * ball.g.g3 * um * ue;
    const Vector field = INVERSE_4_PI * ball.g.g1 * e + g2 * ball.d * ue * u;
    return {g2 * (um * e + ue * m) + radial * u, cross(m, field), dot(m, field)};
}

// Wrench of m·T e, for T of ``pair_tensor`` and its windows.
CUDA_CALLABLE inline Wrench pair_wrench(const BoxPair& p, Vector m, Vector e) {
    const Number zero = p.unit * Real(0), close = p.close.value;
    const Vector none = {zero, zero, zero}, inward = -1 / larger(length(p.r), zero + Real(1e-12)) * p.r;
    const Wrench ball = ball_wrench(p, m, e);
    Wrench sum = {none, none, zero};
    Number change = ball.work; // of the work with the window of close boxes
    sum.add(close - 2, ball);
    if (any(close > zero)) {
        const Wrench boxes = boxes_wrench<CLOSE_POINTS>(p, m, e);
        sum.add(Real(0.5) * close, boxes);
        change += Real(0.5) * boxes.work;
    }
    if (any(close < zero + 1)) {
        const Wrench boxes = boxes_wrench<1>(p, m, e);
        sum.add(1 - close, boxes);
        change -= boxes.work;
    }
    const Number radial = p.window.value * p.close.slope * change + p.window.slope * sum.work;
    return {p.window.value * sum.force + radial * inward, p.window.value * sum.torque, zero};
}
}
