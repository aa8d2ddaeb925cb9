// Contacts of balls with balls, planes, boxes and capsules: those of Newton's narrow phase, one of each pair
// (newton/_src/geometry: narrow_phase.py, collision_primitive.py, contact_data.py).
//
// A ball touches another shape where the core of that comes nearest to its centre: the other's centre, the axis of a
// capsule, the surface of a plane or box. Contact points are the centre and that point.
#pragma once

namespace warpmag {

enum Kind { PLANE, BALL, CAPSULE, BOX, KINDS }; // in the order of Newton's types; as in broad_phase.py

struct Touch {
    int ball, other;
    wp::vec3 core;    // of the other shape, in its frame [m]
    wp::vec3 towards; // unit vector from the ball to the other shape
    Real rounding;    // by which the other's surface is outside of its core [m]
    Real separation;  // of the surfaces, margins included [m]
};

template <class Arrays> CUDA_CALLABLE inline Real size_of(const Arrays& arrays, int shape, int c) {
    return arrays.scale.data[shape][c];
}

// Whether contacts of shapes a and b are found here.
template <class Arrays> CUDA_CALLABLE inline bool is_touch(const Arrays& arrays, int a, int b) {
    const int kind = arrays.kind.data[a], other = arrays.kind.data[b];
    return (kind == BALL && other < KINDS) || (other == BALL && kind < KINDS);
}

// The point of a box that is nearest to one at c in its frame, the unit vector that leads there, or out where c is
// inside, and the distance.
CUDA_CALLABLE inline Real reach_box(wp::vec3 size, wp::vec3 c, wp::vec3& core, wp::vec3& towards) {
    core = wp::min(size, wp::max(-size, c));
    towards = core - c;
    Real distance = wp::length(towards);
    if (distance > Real(1e-6)) {
        towards = towards / distance;
        return distance;
    }
    distance = 2 * (size[0] + size[1] + size[2]);
    int nearest = 0;
    for (int face = 0; face < 6; ++face) {
        const Real depth = fabs((face % 2 ? size[face / 2] : -size[face / 2]) - c[face / 2]);
        if (distance > depth) distance = depth, nearest = face;
    }
    towards = wp::vec3(0, 0, 0);
    towards[nearest / 2] = nearest % 2 ? -1 : 1;
    core = c - distance * towards;
    return -distance;
}

// Where a ball touches a shape at its side; a < b are the two.
template <class Arrays> CUDA_CALLABLE inline Touch touch_of(const Arrays& arrays, int a, int b) {
    Touch t;
    const bool first = arrays.kind.data[a] == BALL;
    t.ball = first ? a : b, t.other = first ? b : a;
    const int kind = arrays.kind.data[t.other];
    const wp::transform frame = arrays.frame.data[t.other];
    wp::vec3 c = arrays.frame.data[t.ball].p - frame.p;
    t.core = wp::vec3(0, 0, 0);
    t.rounding = kind == BALL || kind == CAPSULE ? size_of(arrays, t.other, 0) : Real(0);
    Real distance;
    if (kind != BALL) c = wp::quat_rotate_inv(frame.q, c);
    if (kind == PLANE) {
        t.core = wp::vec3(c[0], c[1], 0);
        t.towards = wp::vec3(0, 0, -1);
        distance = c[2];
    } else if (kind == BOX) {
        distance = reach_box(arrays.scale.data[t.other], c, t.core, t.towards);
    } else {
        if (kind == CAPSULE) {
            // as Newton has it: what is added against a length of zero draws the point to an end
            const Real half = size_of(arrays, t.other, 1), along = 2 * half;
            const Real part = (c[2] + half) * along / (along * along + Real(1e-6));
            t.core[2] = along * (part < 0 ? 0 : part > 1 ? 1 : part) - half;
        }
        t.towards = t.core - c;
        distance = wp::length(t.towards);
        if (distance > 0) t.towards = t.towards / distance;
        else t.towards = kind == BALL ? wp::vec3(1, 0, 0) : wp::quat_rotate_inv(frame.q, wp::vec3(1, 0, 0));
    }
    if (kind != BALL) t.towards = wp::quat_rotate(frame.q, t.towards);
    t.separation = distance - size_of(arrays, t.ball, 0) - t.rounding - arrays.margin.data[a] - arrays.margin.data[b];
    return t;
}

// Whether a touch is to be a contact: the surfaces are near, or come together within the substep.
template <class Arrays> CUDA_CALLABLE inline bool is_contact(const Arrays& arrays, const Touch& t) {
    if (t.separation <= arrays.gap.data[t.ball] + arrays.gap.data[t.other]) return true;
    if (arrays.displacement.shape[0] == 0) return false;
    wp::vec3 motion = arrays.displacement.data[t.other] - arrays.displacement.data[t.ball];
    const int body = arrays.body.data[t.other];
    if (body >= 0 && arrays.kind.data[t.other] != BALL) {
        const wp::vec3 arm = wp::quat_rotate(arrays.frame.data[t.other].q, t.core);
        motion += arrays.dt * wp::cross(wp::spatial_bottom(arrays.body_qd.data[body]), arm);
    }
    const Real approach = -wp::dot(motion, t.towards);
    return (approach < arrays.farthest ? approach : arrays.farthest) >= t.separation;
}

// A point, and a vector of the world, in the frame of a shape's body.
template <class Arrays> CUDA_CALLABLE inline wp::vec3 on_body(const Arrays& arrays, int shape, wp::vec3 point) {
    return wp::transform_point(arrays.placement.data[shape], point);
}
template <class Arrays> CUDA_CALLABLE inline wp::vec3 along_body(const Arrays& arrays, int shape, wp::vec3 vector) {
    return wp::quat_rotate(arrays.placement.data[shape].q, wp::quat_rotate_inv(arrays.frame.data[shape].q, vector));
}

// Writes a touch as contact i of Newton's.
template <class Arrays> CUDA_CALLABLE inline void put_contact(const Arrays& arrays, const Touch& t, int i) {
    const bool ball_first = arrays.kind.data[t.other] >= BALL;
    const int shapes[2] = {ball_first ? t.ball : t.other, ball_first ? t.other : t.ball};
    const wp::vec3 normal = ball_first ? t.towards : -t.towards;
    const auto& out = arrays.contacts;
    out.shape0.data[i] = shapes[0], out.shape1.data[i] = shapes[1];
    out.normal.data[i] = normal;
    for (int end = 0; end < 2; ++end) {
        const int shape = shapes[end];
        const bool is_ball = shape == t.ball;
        const Real outside = (is_ball ? size_of(arrays, shape, 0) : t.rounding) + arrays.margin.data[shape];
        const wp::vec3 point = on_body(arrays, shape, is_ball ? wp::vec3(0, 0, 0) : t.core);
        const wp::vec3 offset = along_body(arrays, shape, end == 0 ? outside * normal : -outside * normal);
        (end == 0 ? out.point0 : out.point1).data[i] = point;
        (end == 0 ? out.offset0 : out.offset1).data[i] = offset;
        (end == 0 ? out.margin0 : out.margin1).data[i] = outside;
    }
}
}
