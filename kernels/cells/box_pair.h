// Tensor and forces of a pair of magnetized boxes, less those of balls of the same volumes, in the frame of box i.
//
// The tensor of close boxes is the field of each box, averaged over 2³ Gauss points of the other one, and the mean of
// both, so that it is symmetric. Those farther away differ from balls by their quadrupoles. A window ends this
// difference. Forces are the exact derivatives of the energy −μ0 m_i·T_ij·m_j, so that they conserve energy and
// momentum. Lengths are in units of the mean of the boxes' sizes.
//
// From Python: WINDOW_BEGIN, WINDOW_END, CLOSE_BEGIN and CLOSE_END, distances of the windows.
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

// Calls visit(p) for 2³ Gauss points of a box of half sides h, which have equal weights.
template <class Visit> CUDA_CALLABLE inline void for_gauss_points(Vector h, Visit visit) {
    constexpr Real PLACE = Real(0.5773502691896258);
    for (int k = 0; k < 8; ++k)
        visit(Vector{(k & 1 ? PLACE : -PLACE) * h.x, (k & 2 ? PLACE : -PLACE) * h.y, (k & 4 ? PLACE : -PLACE) * h.z});
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

// Mean of both boxes' fields, each averaged over the Gauss points of the other box, in the frame of i.
CUDA_CALLABLE inline Symmetric boxes_tensor(const BoxPair& p) {
    const Number zero = p.unit * Real(0),
                 share = zero + Real(1.0 / 128); // 8 points, volumes 8 h_x h_y h_z, mean of two
    Symmetric of_other = {zero, zero, zero, zero, zero, zero}, of_own = of_other;
    for_gauss_points(p.half, [&](Vector x) {
        of_other = of_other + box_tensor(view_box(to_body(p.rotation, x - p.r), p.other_half));
    });
    for_gauss_points(p.other_half,
                     [&](Vector x) { of_own = of_own + box_tensor(view_box(p.r + to_world(p.rotation, x), p.half)); });
    const Vector a = p.half, b = p.other_half;
    return share / (b.x * b.y * b.z) * rotated(p.rotation, of_other) + share / (a.x * a.y * a.z) * of_own;
}

// Quadrupoles of a pair: the traceless mean of x xᵀ over box i, along its axes, the sum Q of both in the frame of i,
// and v = Q r, s = r·Q r and powers of 1/r at a distance of at least 1.
struct Quadrupoles {
    Vector own, v;
    Symmetric sum;
    Number s, i2, i5;

    CUDA_CALLABLE explicit Quadrupoles(const BoxPair& p) {
        const Number zero = p.unit * Real(0);
        const Vector other = spread(p.other_half);
        own = spread(p.half);
        sum = rotated(p.rotation, Symmetric{other.x, other.y, other.z, zero, zero, zero});
        sum = sum + Symmetric{own.x, own.y, own.z, zero, zero, zero};
        v = sum * p.r;
        s = dot(p.r, v);
        const Number inverse = 1 / larger(length(p.r), zero + 1);
        i2 = inverse * inverse;
        i5 = i2 * i2 * inverse;
    }
    static CUDA_CALLABLE Vector spread(Vector h) {
        const Number mean = dot(h, h) * Real(1.0 / 9);
        return {h.x * h.x * Real(1.0 / 3) - mean, h.y * h.y * Real(1.0 / 3) - mean, h.z * h.z * Real(1.0 / 3) - mean};
    }
    CUDA_CALLABLE Vector own_times(Vector a) const { return {own.x * a.x, own.y * a.y, own.z * a.z}; }
};
constexpr Real QUADRUPOLE = Real(1.5) * INVERSE_4_PI;

// Tensor ∂_a ∂_b φ of the quadrupoles' share φ = (3/8π) r·Q r/r⁵ of the mean of 1/(4πr) over both boxes.
CUDA_CALLABLE inline Symmetric quadrupole_tensor(const BoxPair& p) {
    const Quadrupoles q(p);
    const Vector r = p.r, v = q.v;
    const Number f5 = QUADRUPOLE * q.i5, f7 = f5 * q.i2, f9 = 35 * q.s * f7 * q.i2, isotropic = -5 * q.s * f7;
    auto entry = [=](Number q_ab, Number r_a, Number v_a, Number r_b, Number v_b) {
        return 2 * f5 * q_ab - 10 * f7 * (v_a * r_b + r_a * v_b) + f9 * r_a * r_b;
    };
    return {entry(q.sum.xx, r.x, v.x, r.x, v.x) + isotropic,
            entry(q.sum.yy, r.y, v.y, r.y, v.y) + isotropic,
            entry(q.sum.zz, r.z, v.z, r.z, v.z) + isotropic,
            entry(q.sum.xy, r.x, v.x, r.y, v.y),
            entry(q.sum.yz, r.y, v.y, r.z, v.z),
            entry(q.sum.zx, r.z, v.z, r.x, v.x)};
}

// Tensor of the pair less that of the balls, in the frame of i and the units of the pair.
CUDA_CALLABLE inline Symmetric pair_tensor(const BoxPair& p) {
    const Number zero = p.unit * Real(0), close = p.close.value;
    const Symmetric far = (1 - close) * quadrupole_tensor(p);
    if (!any(close > zero)) return far;
    const BallLaw ball = ball_law(p);
    const Vector u = ball.u;
    const Number factor = INVERSE_4_PI * close, g1 = factor * ball.g.g1, g2 = factor * ball.g.g2 * ball.d;
    const Symmetric balls = {g1 + g2 * u.x * u.x, g1 + g2 * u.y * u.y, g1 + g2 * u.z * u.z,
                             g2 * u.x * u.y,      g2 * u.y * u.z,      g2 * u.z * u.x};
    return far + close * boxes_tensor(p) + (zero - 1) * balls;
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
CUDA_CALLABLE inline Wrench boxes_wrench(const BoxPair& p, Vector m, Vector e) {
    const Number zero = p.unit * Real(0), share = zero + Real(1.0 / 128);
    const Vector a = p.half, b = p.other_half, none = {zero, zero, zero};
    Wrench of_other = {none, none, zero}, of_own = of_other;
    const Vector r_j = to_body(p.rotation, p.r), m_j = to_body(p.rotation, m), e_j = to_body(p.rotation, e);
    for_gauss_points(p.half, [&](Vector x) { // points of i in the field of j, in the frame of j
        const Vector arm = to_body(p.rotation, x);
        const BoxView view = view_box(arm - r_j, p.other_half);
        const Vector force = box_slope(view, e_j, m_j), field = box_tensor(view) * e_j;
        of_other.add(zero + 1, {force, cross(arm, force) + cross(m_j, field), dot(m_j, field)});
    });
    for_gauss_points(p.other_half, [&](Vector x) { // points of j in the field of i
        const Vector at = p.r + to_world(p.rotation, x);
        const BoxView view = view_box(at, p.half);
        const Vector force = box_slope(view, m, e), field = box_tensor(view) * m;
        of_own.add(zero - 1, {force, cross(at, force) + cross(e, field), -dot(e, field)});
    });
    Wrench sum = {none, none, zero};
    sum.add(share / (a.x * a.y * a.z), of_own);
    const Wrench turned = {to_world(p.rotation, of_other.force), to_world(p.rotation, of_other.torque), of_other.work};
    sum.add(share / (b.x * b.y * b.z), turned);
    return sum;
}

// Wrench of m·T e, for T of ``quadrupole_tensor``. The torque has a share of the quadrupole of i, which turns with it.
CUDA_CALLABLE inline Wrench quadrupole_wrench(const BoxPair& p, Vector m, Vector e) {
    const Quadrupoles q(p);
    const Vector r = p.r, v = q.v, q_m = q.sum * m, q_e = q.sum * e;
    const Number rm = dot(r, m), re = dot(r, e), me = dot(m, e), vm = dot(v, m), ve = dot(v, e), m_q_e = dot(m, q_e);
    const Number f5 = QUADRUPOLE * q.i5, f7 = f5 * q.i2, f9 = f7 * q.i2, f11 = f9 * q.i2, mixed = vm * re + rm * ve;
    const Number work = 2 * f5 * m_q_e - 10 * f7 * mixed - 5 * f7 * q.s * me + 35 * f9 * q.s * rm * re;
    const Number radial = -10 * f7 * m_q_e + 70 * f9 * mixed + 35 * f9 * q.s * me - 315 * f11 * q.s * rm * re;
    const Vector slope = radial * r + (70 * f9 * rm * re - 10 * f7 * me) * v - 10 * f7 * (re * q_m + rm * q_e)
                         + (35 * f9 * q.s * re - 10 * f7 * ve) * m + (35 * f9 * q.s * rm - 10 * f7 * vm) * e;
    const Vector field = 2 * f5 * q_e - 10 * f7 * (re * v + ve * r) - 5 * f7 * q.s * e + 35 * f9 * q.s * re * r;
    const Vector own_r = q.own_times(r), own_m = q.own_times(m), own_e = q.own_times(e);
    const Vector spin = f5 * (cross(own_m, e) + cross(own_e, m)) - 5 * f7 * re * (cross(own_r, m) + cross(own_m, r))
                        - 5 * f7 * rm * (cross(own_r, e) + cross(own_e, r))
                        + (35 * f9 * rm * re - 5 * f7 * me) * cross(own_r, r);
    return {-slope, cross(m, field) + 2 * spin, work};
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
    const Wrench far = quadrupole_wrench(p, m, e);
    Wrench sum = {none, none, zero};
    sum.add(1 - close, far);
    Number change = -far.work; // of the work with the window of close boxes
    if (any(close > zero)) {
        const Wrench boxes = boxes_wrench(p, m, e), ball = ball_wrench(p, m, e);
        sum.add(close, boxes);
        sum.add(-close, ball);
        change += boxes.work - ball.work;
    }
    const Number radial = p.window.value * p.close.slope * change + p.window.slope * sum.work;
    return {p.window.value * sum.force + radial * inward, p.window.value * sum.torque, zero};
}
}
