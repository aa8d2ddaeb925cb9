// Tensor and forces of a pair of magnetized boxes, less those of balls of the same volumes, in the frame of box i.
//
// The tensor of close boxes is the field of the larger box, averaged over 2³ Gauss points of the smaller one. Those
// farther away differ from balls by their quadrupoles. A window ends this difference. Forces are the exact derivatives
// of the energy −μ0 m_i·T_ij·m_j, so that they conserve energy and momentum. Lengths are in units of the mean of the
// boxes' sizes.
//
// From Python: WINDOW_BEGIN, WINDOW_END, CLOSE_BEGIN and CLOSE_END, distances of the windows.
#pragma once
#include "cells/box_field.h"
#include "cells/rotation.h"
#include "pairs/pair_law.h"

namespace warpmag {

constexpr Real SMALLER = Real(0.999); // ratio of volumes from which a box counts as smaller than another one

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
// of the balls, the window of all boxes, and that of close boxes. ``own_points``: the Gauss points are those of i.
struct BoxPair {
    Vector half, other_half, r;
    Rotation<Number> rotation;
    Number unit, radius, other_radius;
    Window window, close;
    Mask own_points;
};
CUDA_CALLABLE inline Number longest(Vector half) { return larger(half.x, larger(half.y, half.z)); }
CUDA_CALLABLE inline BoxPair box_pair(const Boxes& own, const Boxes& other, const RelativePose& pose, Mask listed,
                                      Mask own_first) {
    const Number unit = 2 / (own.size + other.size), side = unit * (longest(own.half) + longest(other.half));
    const Vector r = unit * pose.r;
    const Number d = length(r);
    Window close = window_between(d / side, CLOSE_BEGIN, CLOSE_END, listed);
    close.slope /= side;
    const Mask own_smaller = own.volume < SMALLER * other.volume, alike = own.volume * SMALLER <= other.volume;
    return {unit * own.half,
            unit * other.half,
            r,
            rotation_of<Number>(pose.q),
            unit,
            unit * own.radius,
            unit * other.radius,
            window_between(d, WINDOW_BEGIN, WINDOW_END, listed),
            close,
            own_smaller | (own_first & alike)};
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

// A source, the box whose field is evaluated, and a target, the box with the Gauss points, in the frame of the source.
struct SourceAndTarget {
    Vector half, target_half, center; // half sides, and the target's center
    Rotation<Number> rotation;        // from the frame of the target to that of the source
    Number scale;                     // weight of a point, over the source's volume

    CUDA_CALLABLE explicit SourceAndTarget(const BoxPair& p) {
        const Mask own = p.own_points;
        half = choose(own, p.other_half, p.half);
        target_half = choose(own, p.half, p.other_half);
        center = choose(own, -to_body(p.rotation, p.r), p.r);
        for (int k = 0; k < 3; ++k)
            for (int l = 0; l < 3; ++l) rotation.rows[k][l] = own ? p.rotation.rows[l][k] : p.rotation.rows[k][l];
        scale = Real(1.0 / 64) / (half.x * half.y * half.z);
    }
    // A vector of the frame of i in that of the source, and back.
    static CUDA_CALLABLE Vector to_source(const BoxPair& p, Vector a) {
        return choose(p.own_points, to_body(p.rotation, a), a);
    }
    static CUDA_CALLABLE Vector from_source(const BoxPair& p, Vector a) {
        return choose(p.own_points, to_world(p.rotation, a), a);
    }
    static CUDA_CALLABLE Vector choose(Mask first, Vector a, Vector b) {
        return {first ? a.x : b.x, first ? a.y : b.y, first ? a.z : b.z};
    }
};

// Field tensor of the source, averaged over the Gauss points of the target, in the frame of i.
CUDA_CALLABLE inline Symmetric boxes_tensor(const BoxPair& p) {
    const SourceAndTarget s(p);
    const Number zero = p.unit * Real(0);
    Symmetric sum = {zero, zero, zero, zero, zero, zero};
    for_gauss_points(s.target_half,
                     [&](Vector x) { sum = sum + box_tensor(view_box(s.center + to_world(s.rotation, x), s.half)); });
    const Symmetric t = s.scale * sum, turned = rotated(p.rotation, t);
    const Mask own = p.own_points;
    return {own ? turned.xx : t.xx, own ? turned.yy : t.yy, own ? turned.zz : t.zz,
            own ? turned.xy : t.xy, own ? turned.yz : t.yz, own ? turned.zx : t.zx};
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
    const SourceAndTarget s(p);
    const Number zero = p.unit * Real(0);
    const Vector m_s = s.to_source(p, m), e_s = s.to_source(p, e);
    const Vector of_target = s.choose(p.own_points, m_s, e_s), of_source = s.choose(p.own_points, e_s, m_s);
    Vector force = {zero, zero, zero}, torque = force; // on the target, about the center of the source
    Number work = zero;
    for_gauss_points(s.target_half, [&](Vector x) {
        const Vector at = s.center + to_world(s.rotation, x);
        const BoxView view = view_box(at, s.half);
        const Vector push = box_slope(view, of_source, of_target), field = box_tensor(view) * of_source;
        force += push;
        torque += cross(at, push) + cross(of_target, field);
        work += dot(of_target, field);
    });
    const Vector about_target = torque - cross(s.center, force);
    const Vector on_i = s.choose(p.own_points, force, -force), turning = s.choose(p.own_points, about_target, -torque);
    return {s.scale * s.from_source(p, on_i), s.scale * s.from_source(p, turning), s.scale * work};
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
