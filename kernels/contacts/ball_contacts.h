// Contacts of balls with balls, planes, boxes and capsules, one for each pair, as in Newton's narrow phase
// (newton/_src/geometry: narrow_phase.py, collision_primitive.py, contact_data.py).
//
// The core of a shape is the center of a ball, the axis of a capsule, the surface of a plane or box. The contact points
// are the center of the ball and the nearest point of the other shape's core.
#pragma once

namespace warpmag {

enum Kind { PLANE, BALL, CAPSULE, BOX, KINDS }; // in the order of Newton's types; as in broad_phase.py

// A contact of a ball with another shape, which may be a ball.
struct BallContact {
    int ball, other;
    wp::vec3 core;      // nearest point of the other shape's core, in its frame [m]
    wp::vec3 direction; // unit vector from the ball to the other shape
    Real core_radius;   // distance of the other shape's surface from its core [m]
    Real separation;    // distance of the surfaces, less the margins [m]
};

// Component of a shape's size: radius, half length or half extent [m].
template <class Arrays> CUDA_CALLABLE inline Real size_component(const Arrays& arrays, int shape, int c) {
    return arrays.scale.data[shape][c];
}

// True if the pair is a ball and a ball, plane, capsule or box.
template <class Arrays> CUDA_CALLABLE inline bool involves_ball(const Arrays& arrays, int a, int b) {
    const int kind = arrays.kind.data[a], other = arrays.kind.data[b];
    return (kind == BALL && other < KINDS) || (other == BALL && kind < KINDS);
}

// Finds the point of a box's surface nearest to c, in the frame of the box, and the direction from c to it. Inside the
// box the direction is reversed. Returns the distance, negative inside.
CUDA_CALLABLE inline Real nearest_on_box(wp::vec3 size, wp::vec3 c, wp::vec3& core, wp::vec3& direction) {
    core = wp::min(size, wp::max(-size, c));
    direction = core - c;
    Real distance = wp::length(direction);
    if (distance > Real(1e-6)) {
        direction = direction / distance;
        return distance;
    }
    distance = 2 * (size[0] + size[1] + size[2]);
    int nearest = 0;
    for (int face = 0; face < 6; ++face) {
        const Real depth = fabs((face % 2 ? size[face / 2] : -size[face / 2]) - c[face / 2]);
        if (distance > depth) distance = depth, nearest = face;
    }
    direction = wp::vec3(0, 0, 0);
    direction[nearest / 2] = nearest % 2 ? -1 : 1;
    core = c - distance * direction;
    return -distance;
}

// Contact of a ball with another shape, for shapes a < b.
template <class Arrays> CUDA_CALLABLE inline BallContact detect_ball_contact(const Arrays& arrays, int a, int b) {
    BallContact contact;
    const bool a_is_ball = arrays.kind.data[a] == BALL;
    contact.ball = a_is_ball ? a : b, contact.other = a_is_ball ? b : a;
    const int kind = arrays.kind.data[contact.other];
    const wp::transform frame = arrays.frame.data[contact.other];
    wp::vec3 center = arrays.frame.data[contact.ball].p - frame.p;
    contact.core = wp::vec3(0, 0, 0);
    contact.core_radius = kind == BALL || kind == CAPSULE ? size_component(arrays, contact.other, 0) : Real(0);
    Real distance;
    if (kind != BALL) center = wp::quat_rotate_inv(frame.q, center);
    if (kind == PLANE) {
        contact.core = wp::vec3(center[0], center[1], 0);
        contact.direction = wp::vec3(0, 0, -1);
        distance = center[2];
    } else if (kind == BOX) {
        distance = nearest_on_box(arrays.scale.data[contact.other], center, contact.core, contact.direction);
    } else {
        if (kind == CAPSULE) {
            // as in Newton: the term against division by zero moves the point slightly toward an end
            const Real half = size_component(arrays, contact.other, 1), axis_length = 2 * half;
            const Real fraction = (center[2] + half) * axis_length / (axis_length * axis_length + Real(1e-6));
            contact.core[2] = axis_length * (fraction < 0 ? 0 : fraction > 1 ? 1 : fraction) - half;
        }
        contact.direction = contact.core - center;
        distance = wp::length(contact.direction);
        if (distance > 0) contact.direction = contact.direction / distance;
        else contact.direction = kind == BALL ? wp::vec3(1, 0, 0) : wp::quat_rotate_inv(frame.q, wp::vec3(1, 0, 0));
    }
    if (kind != BALL) contact.direction = wp::quat_rotate(frame.q, contact.direction);
    contact.separation = distance - size_component(arrays, contact.ball, 0) - contact.core_radius
                         - arrays.margin.data[a] - arrays.margin.data[b];
    return contact;
}

// True if the surfaces are within the contact gap, or may meet in the substep.
template <class Arrays> CUDA_CALLABLE inline bool is_contact(const Arrays& arrays, const BallContact& contact) {
    if (contact.separation <= arrays.gap.data[contact.ball] + arrays.gap.data[contact.other]) return true;
    if (arrays.displacement.shape[0] == 0) return false;
    wp::vec3 motion = arrays.displacement.data[contact.other] - arrays.displacement.data[contact.ball];
    const int body = arrays.body.data[contact.other];
    if (body >= 0 && arrays.kind.data[contact.other] != BALL) {
        const wp::vec3 arm = wp::quat_rotate(arrays.frame.data[contact.other].q, contact.core);
        motion += arrays.dt * wp::cross(wp::spatial_bottom(arrays.body_qd.data[body]), arm);
    }
    const Real approach = -wp::dot(motion, contact.direction);
    return (approach < arrays.farthest ? approach : arrays.farthest) >= contact.separation;
}

// Transforms of a point in a shape's frame, and of a vector in the world's frame, to the frame of the shape's body.
template <class Arrays> CUDA_CALLABLE inline wp::vec3 point_in_body(const Arrays& arrays, int shape, wp::vec3 point) {
    return wp::transform_point(arrays.placement.data[shape], point);
}
template <class Arrays> CUDA_CALLABLE inline wp::vec3 vector_in_body(const Arrays& arrays, int shape, wp::vec3 vector) {
    return wp::quat_rotate(arrays.placement.data[shape].q, wp::quat_rotate_inv(arrays.frame.data[shape].q, vector));
}

// Writes a contact as Newton's contact i.
template <class Arrays>
CUDA_CALLABLE inline void write_contact(const Arrays& arrays, const BallContact& contact, int i) {
    const bool ball_first = arrays.kind.data[contact.other] >= BALL;
    const int shapes[2] = {ball_first ? contact.ball : contact.other, ball_first ? contact.other : contact.ball};
    const wp::vec3 normal = ball_first ? contact.direction : -contact.direction;
    const auto& out = arrays.contacts;
    out.shape0.data[i] = shapes[0], out.shape1.data[i] = shapes[1];
    out.normal.data[i] = normal;
    for (int end = 0; end < 2; ++end) {
        const int shape = shapes[end];
        const bool is_ball = shape == contact.ball;
        const Real outside =
            (is_ball ? size_component(arrays, shape, 0) : contact.core_radius) + arrays.margin.data[shape];
        const wp::vec3 point = point_in_body(arrays, shape, is_ball ? wp::vec3(0, 0, 0) : contact.core);
        const wp::vec3 offset = vector_in_body(arrays, shape, end == 0 ? outside * normal : -outside * normal);
        (end == 0 ? out.point0 : out.point1).data[i] = point;
        (end == 0 ? out.offset0 : out.offset1).data[i] = offset;
        (end == 0 ? out.margin0 : out.margin1).data[i] = outside;
    }
}
}
