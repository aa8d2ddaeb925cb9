// Tensor and forces of a pair of magnetized boxes, less those of balls of the same volumes, in the frame of box i.
//
// The tensor of close boxes is the field of the longer box, averaged over 2³ Gauss points of the shorter one, whose
// points are closer together. With the points of the longer box the operator of induction would have negative
// eigenvalues, for a sheet of long cells that lies on a sheet of shorter, thicker cells. Beside a flat box the field
// varies more over its faces, so 4 × 4 × 2 points replace them there. One of a pair may be a ball: a ball's field is a
// closed form, too, and the average over a ball is the value at its center. Then the field is that of the larger
// volume, because a long box may lie inside a ball. Boxes farther apart differ from balls by their quadrupoles. A
// window function ends this difference. Forces are the exact derivatives of the energy −μ0 m_i·T_ij·m_j, so that they
// conserve energy and momentum. Lengths are in units of the mean of the boxes' sizes.
//
// From Python: WINDOW_BEGIN, WINDOW_END, CLOSE_BEGIN, CLOSE_END, FINE_BEGIN and FINE_END, distances of the windows.
#pragma once
#include "cells/box_field.h"
#include "cells/gauss_points.h"
#include "cells/thickened.h"
#include "pairs/pair_law.h"

namespace warpmag {

constexpr Real SHORTER = Real(0.999); // ratio of longest sides from which a box counts as shorter than another one

// Boxes of cells: center, half sides, rotation to the world as quaternion, volume, the size that scales the window, and
// the radius of the ball of the same volume. Balls have half sides for the windows only. ``linear`` boxes have
// differences; ``flat`` ones are of bodies of flat cells.
struct Boxes {
    Vector center, half;
    Number q[4], volume, size, radius;
    Mask ball, linear, flat, inducible;
};

// Pose of box j relative to box i: separation, and rotation from the frame of j to that of i.
struct RelativePose {
    Vector r;
    Number q[4];
};
CUDA_CALLABLE inline RelativePose relative_pose(const Boxes& own, const Boxes& other) {
    const Number *a = own.q, *b = other.q;
    return {
        to_body(rotation_of<Number>(a), other.center - own.center),
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
// of the balls, the window of all boxes, that of close boxes, and that of 4 × 4 × 2 points. ``own_points``: the Gauss
// points are those of i. ``of_ball``: the other one of the pair, the source, is a ball; ``at_ball``: the one with the
// points is. ``linear``: one of the two has differences, and they act.
struct BoxPair {
    Vector half, other_half, r;
    Rotation<Number> rotation;
    Number unit, radius, other_radius;
    Window window, close, fine;
    Mask own_points, of_ball, at_ball, linear;
};
CUDA_CALLABLE inline Number longest(Vector half) { return larger(half.x, larger(half.y, half.z)); }
// Half the longest side of a box, and half the side of a cube of the volume of a ball.
CUDA_CALLABLE inline Number longest_of(const Boxes& box) {
    const Number of_cube = Real(0.8059959770082348) * box.radius, of_box = longest(box.half);
    return box.ball ? of_cube : of_box;
}
CUDA_CALLABLE inline BoxPair box_pair(const Boxes& own, const Boxes& other, const RelativePose& pose, Mask listed,
                                      Mask own_first, Mask differ) {
    const Number unit = 2 / (own.size + other.size);
    const Vector r = unit * pose.r;
    const Number d = length(r);
    const Number own_longest = longest_of(own), other_longest = longest_of(other);
    const Mask balls = own.ball | other.ball;
    const Number own_size = balls ? own.radius : own_longest, other_size = balls ? other.radius : other_longest;
    const Mask own_shorter = own_size < SHORTER * other_size, alike = own_size * SHORTER <= other_size;
    const Mask own_points = own_shorter | (own_first & alike);
    const Mask flat = own_points ? own.flat : other.flat;
    const Number per_side = 1 / (unit * (own_longest + other_longest)); // from units of the pair to mean longest sides
    Window fine = window_between(per_side * d, FINE_BEGIN, FINE_END, listed & flat);
    fine.slope *= per_side;
    return {unit * own.half,
            unit * other.half,
            r,
            rotation_of<Number>(pose.q),
            unit,
            unit * own.radius,
            unit * other.radius,
            window_between(d, WINDOW_BEGIN, WINDOW_END, listed),
            window_between(d, CLOSE_BEGIN, CLOSE_END, listed),
            fine,
            own_points,
            own_points ? other.ball : own.ball,
            own_points ? own.ball : other.ball,
            (own.linear | other.linear) & differ};
}

// Upper half of a box along an axis, seen from a point of the frame of the box.
CUDA_CALLABLE inline BoxView view_upper_half(Vector r, Vector half, int axis) {
    const Real x = axis == 0 ? Real(0.5) : Real(0), y = axis == 1 ? Real(0.5) : Real(0),
               z = axis == 2 ? Real(0.5) : Real(0);
    return view_box({r.x - x * half.x, r.y - y * half.y, r.z - z * half.z},
                    {(1 - x) * half.x, (1 - y) * half.y, (1 - z) * half.z});
}
CUDA_CALLABLE inline Vector column(const Symmetric& t, int k) {
    return k == 0 ? Vector{t.xx, t.xy, t.zx} : k == 1 ? Vector{t.xy, t.yy, t.yz} : Vector{t.zx, t.yz, t.zz};
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

// Field tensor of a uniformly magnetized ball at r from its center, times its volume: a dipole outside, uniform inside.
CUDA_CALLABLE inline Symmetric ball_tensor(Vector r, Number radius) {
    const Number zero = radius * Real(0), d = length(r), inverse = 1 / larger(d, radius), i2 = inverse * inverse;
    const Number g1 = -INVERSE_4_PI * i2 * inverse, g2 = d < radius ? zero : -3 * i2 * g1;
    return {g1 + g2 * r.x * r.x, g1 + g2 * r.y * r.y, g1 + g2 * r.z * r.z,
            g2 * r.x * r.y,      g2 * r.y * r.z,      g2 * r.z * r.x};
}
// Symmetric product of two vectors in the derivatives of this tensor, as ``box_slope``.
CUDA_CALLABLE inline Vector ball_slope(Vector r, Number radius, Vector m, Vector e) {
    const Number zero = radius * Real(0), d = length(r), inverse = 1 / larger(d, radius), i2 = inverse * inverse;
    const Number factor = d < radius ? zero : 3 * INVERSE_4_PI * i2 * i2 * inverse, rm = dot(r, m), re = dot(r, e);
    return factor * ((dot(m, e) - 5 * i2 * rm * re) * r + re * m + rm * e);
}

// A source, the box whose field is evaluated, and a target, the box with the Gauss points, in the frame of the source.
struct SourceAndTarget {
    Vector half, target_half, center; // half sides, 0 for the target if it is a ball, and the target's center
    Number radius;                    // of the source
    Mask is_ball;                     // the source
    Rotation<Number> rotation;        // from the frame of the target to that of the source
    Number scale;                     // weight of a point, over the source's volume

    CUDA_CALLABLE explicit SourceAndTarget(const BoxPair& p) {
        const Mask own = p.own_points;
        half = choose(own, p.other_half, p.half);
        const Number zero = p.unit * Real(0);
        target_half = choose(p.at_ball, {zero, zero, zero}, choose(own, p.half, p.other_half));
        radius = own ? p.other_radius : p.radius;
        is_ball = p.of_ball;
        center = choose(own, -to_body(p.rotation, p.r), p.r);
        for (int k = 0; k < 3; ++k)
            for (int l = 0; l < 3; ++l) rotation.rows[k][l] = own ? p.rotation.rows[l][k] : p.rotation.rows[k][l];
        half = thickened(half, target_half, center, rotation);
        const Number volume = 8 * half.x * half.y * half.z;
        scale = Real(1.0 / 8) / (is_ball ? zero + 1 : volume);
    }
    // Field tensor of the source, times its volume if it is a box, and its column along an axis for the upper half of a
    // box along it.
    CUDA_CALLABLE Symmetric tensor(Vector at) const {
        const Symmetric box = box_tensor(view_box(at, half));
        return any(is_ball) ? choose(is_ball, ball_tensor(at, radius), box) : box;
    }
    CUDA_CALLABLE Vector upper_half_column(Vector at, int axis) const {
        const Vector box = box_column(view_upper_half(at, half, axis), axis);
        return any(is_ball) ? choose(is_ball, Real(0.5) * column(ball_tensor(at, radius), axis), box) : box;
    }
    // Force of the source on a moment ``here``.
    CUDA_CALLABLE Vector push(Vector at, Vector moment, Vector here) const {
        const Vector box = box_slope(view_box(at, half), moment, here);
        return any(is_ball) ? choose(is_ball, ball_slope(at, radius, moment, here), box) : box;
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
    static CUDA_CALLABLE Symmetric choose(Mask first, const Symmetric& a, const Symmetric& b) {
        return {first ? a.xx : b.xx, first ? a.yy : b.yy, first ? a.zz : b.zz,
                first ? a.xy : b.xy, first ? a.yz : b.yz, first ? a.zx : b.zx};
    }
};

// Matrices of a pair of boxes, rows in the frame of i and columns in that of j: fields of means and of differences, by
// mean moments and half differences of the halves.
struct PairMatrices {
    Number means[9], of_differences[9], at_differences[9], differences[9];
};
// The fields of the source, averaged over the Gauss points of the target.
CUDA_CALLABLE inline PairMatrices boxes_matrices(const BoxPair& p, Points points) {
    const SourceAndTarget s(p);
    const Number zero = p.unit * Real(0);
    const bool linear = any(p.linear); // uniform boxes have no differences
    Symmetric total = {zero, zero, zero, zero, zero, zero};
    PairMatrices sums; // rows in the frame of the target, columns in that of the source
    for (int k = 0; k < 9; ++k) sums.of_differences[k] = sums.at_differences[k] = sums.differences[k] = zero;
    for_gauss_points(s.target_half, p.fine.value, points, [&](const GaussPoint& point) {
        const Vector at = s.center + to_world(s.rotation, point.at);
        const Number signs[3] = {point.signs.x, point.signs.y, point.signs.z};
        const Symmetric full = point.weight * s.tensor(at);
        total = total + full;
        for (int l = 0; l < 3 && linear; ++l) {
            const Vector of_both = column(full, l), of_upper = point.weight * s.upper_half_column(at, l);
            const Vector mean = to_body(s.rotation, of_both), difference = to_body(s.rotation, 2 * of_upper - of_both);
            const Number by_mean[3] = {mean.x, mean.y, mean.z},
                         by_difference[3] = {difference.x, difference.y, difference.z};
            for (int k = 0; k < 3; ++k) {
                sums.of_differences[3 * k + l] += by_difference[k];
                sums.at_differences[3 * k + l] += signs[k] * by_mean[k];
                sums.differences[3 * k + l] += signs[k] * by_difference[k];
            }
        }
    });
    for (int l = 0; l < 3; ++l) {
        const Vector mean = to_body(s.rotation, column(total, l));
        sums.means[l] = mean.x, sums.means[3 + l] = mean.y, sums.means[6 + l] = mean.z;
    }
    PairMatrices result; // of the pair: transposed where i is the source
    const Mask own = p.own_points;
    for (int k = 0; k < 3; ++k)
        for (int l = 0; l < 3; ++l) {
            const int here = 3 * k + l, across = 3 * l + k;
            result.means[here] = s.scale * (own ? sums.means[here] : sums.means[across]);
            result.of_differences[here] = s.scale * (own ? sums.of_differences[here] : sums.at_differences[across]);
            result.at_differences[here] = s.scale * (own ? sums.at_differences[here] : sums.of_differences[across]);
            result.differences[here] = s.scale * (own ? sums.differences[here] : sums.differences[across]);
        }
    return result;
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

// Matrix of means less that of the balls for pairs that are not close, and its share for those that are.
CUDA_CALLABLE inline void far_matrix(const BoxPair& p, Number* matrix) {
    const Number zero = p.unit * Real(0), close = p.close.value;
    Symmetric far = (1 - close) * quadrupole_tensor(p);
    if (any(close > zero)) {
        const BallLaw ball = ball_law(p);
        const Vector u = ball.u;
        const Number factor = INVERSE_4_PI * close, g1 = factor * ball.g.g1, g2 = factor * ball.g.g2 * ball.d;
        far = far + (zero - 1) * Symmetric{g1 + g2 * u.x * u.x, g1 + g2 * u.y * u.y, g1 + g2 * u.z * u.z,
                                           g2 * u.x * u.y,      g2 * u.y * u.z,      g2 * u.z * u.x};
    }
    for (int l = 0; l < 3; ++l) {
        const auto& rows = p.rotation.rows;
        const Vector f = far * Vector{rows[0][l], rows[1][l], rows[2][l]};
        matrix[l] = f.x, matrix[3 + l] = f.y, matrix[6 + l] = f.z;
    }
}

// Share of Gauss points in the matrices of the pair less the law of the balls, in the units of the pair.
CUDA_CALLABLE inline PairMatrices pair_matrices(const BoxPair& p, Points points) {
    const Number zero = p.unit * Real(0), close = p.close.value;
    PairMatrices result;
    for (int k = 0; k < 9; ++k)
        result.means[k] = result.of_differences[k] = result.at_differences[k] = result.differences[k] = zero;
    if (points.first == 0) far_matrix(p, result.means);
    if (!any(close > zero)) return result;
    const PairMatrices boxes = boxes_matrices(p, points);
    for (int k = 0; k < 9; ++k) {
        result.means[k] += close * boxes.means[k];
        result.of_differences[k] = close * boxes.of_differences[k];
        result.at_differences[k] = close * boxes.at_differences[k];
        result.differences[k] = close * boxes.differences[k];
    }
    return result;
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

// Moments of a pair: means m of i and e of j in the frame of i, and half differences in the frames of their boxes.
struct PairMoments {
    Vector m, e, own_difference, other_difference;
};

// Wrench of close boxes. The source is a box of its mean less its differences, and the upper halves of twice each
// difference. Balls have no differences.
CUDA_CALLABLE inline Wrench boxes_wrench(const BoxPair& p, const PairMoments& moments, Points points) {
    const SourceAndTarget s(p);
    const Number zero = p.unit * Real(0);
    const Mask own = p.own_points;
    const Vector m_s = s.to_source(p, moments.m), e_s = s.to_source(p, moments.e);
    const Vector of_target = s.choose(own, m_s, e_s), of_source = s.choose(own, e_s, m_s);
    const Vector none = {zero, zero, zero};
    auto acting = [&](Vector difference) { return s.choose(p.linear, difference, none); };
    const Vector at_target = acting(s.choose(own, moments.own_difference, moments.other_difference));
    const Vector at_source = acting(s.choose(own, moments.other_difference, moments.own_difference));
    Vector force = none, torque = none; // on the target, about the center of the source
    Number work = zero, change = zero;  // and the change of the work with the window of fine points
    for_gauss_points(s.target_half, p.fine.value, points, [&](const GaussPoint& point) {
        const Vector at = s.center + to_world(s.rotation, point.at), signs = point.signs;
        const Vector difference = {signs.x * at_target.x, signs.y * at_target.y, signs.z * at_target.z};
        const Vector here = of_target + to_world(s.rotation, difference);
        auto add = [&](Vector push, Vector field) {
            const Number of_point = dot(here, field);
            force += point.weight * push;
            torque += point.weight * (cross(at, push) + cross(here, field));
            work += point.weight * of_point;
            change += point.slope * of_point;
        };
        auto add_half = [&](int axis, Number source) {
            const BoxView view = view_upper_half(at, s.half, axis);
            const Vector along = {axis == 0 ? source : zero, axis == 1 ? source : zero, axis == 2 ? source : zero};
            add(box_slope(view, along, here), source * box_column(view, axis));
        };
        const Vector mean = of_source - at_source;
        add(s.push(at, mean, here), s.tensor(at) * mean);
        if (!any(p.linear)) return;
        add_half(0, 2 * at_source.x);
        add_half(1, 2 * at_source.y);
        add_half(2, 2 * at_source.z);
    });
    const Vector about_target = torque - cross(s.center, force);
    const Vector inward = -1 / larger(length(p.r), zero + Real(1e-12)) * p.r;
    const Vector radial = p.fine.slope * change * inward, on_i = s.choose(own, force, -force),
                 turning = s.choose(own, about_target, -torque);
    return {s.scale * (s.from_source(p, on_i) + radial), s.scale * s.from_source(p, turning), s.scale * work};
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

// Share of Gauss points in the wrench of the pair less that of the balls, with its windows.
CUDA_CALLABLE inline Wrench pair_wrench(const BoxPair& p, const PairMoments& moments, Points points) {
    const Vector m = moments.m, e = moments.e;
    const Number zero = p.unit * Real(0), close = p.close.value;
    const Vector none = {zero, zero, zero}, inward = -1 / larger(length(p.r), zero + Real(1e-12)) * p.r;
    Wrench sum = {none, none, zero};
    Number change = zero; // of the work with the window of close boxes
    if (points.first == 0) {
        const Wrench far = quadrupole_wrench(p, m, e);
        sum.add(1 - close, far);
        change = -far.work;
    }
    if (any(close > zero)) {
        const Wrench boxes = boxes_wrench(p, moments, points);
        sum.add(close, boxes);
        change += boxes.work;
        if (points.first == 0) {
            const Wrench ball = ball_wrench(p, m, e);
            sum.add(-close, ball);
            change -= ball.work;
        }
    }
    const Number radial = p.window.value * p.close.slope * change + p.window.slope * sum.work;
    return {p.window.value * sum.force + radial * inward, p.window.value * sum.torque, zero};
}
}
