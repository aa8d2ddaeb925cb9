// Arrays of the contact solver, and functions that read and write contacts and bodies.
//
// solve.py documents the arrays. Each participating body has a line of ``motion`` and of ``pose``, a cache line long.
// Lines of bodies that contacts can move come first, without gaps. Lines of the immovable bodies that they touch
// follow; the world is one of these.
#pragma once
#include "contacts/contact_law.h"
#include "shared/team.h"

namespace warpmag {

// Arrays at the addresses in ``SolveArrays`` of solve.py, field by field in the same order.
struct Arrays {
    // sizes
    int contact_max, body_count, line_count, kinematic_flag;
    // contacts
    const int *count, *shape0, *shape1, *shape_body;
    const Real *point0, *point1, *offset0, *offset1, *normal, *margin0, *margin1, *mu, *mu_torsional, *mu_rolling;
    // bodies
    const int* flags;
    const Real *com, *inv_mass, *inv_inertia, *q;
    Real* qd;
    // work
    const Real* shares;
    int *totals, *side_count, *filled, *slot, *body, *range, *entry, *other, *records_zero, *wide, *world_first,
        *kept_range;
    unsigned long long *key, *kept_key;
    Real *motion, *next_motion, *pose, *side, *return_velocity, *impulse, *record, *kept;

    template <class Addresses> CUDA_CALLABLE explicit Arrays(const Addresses& addresses) {
        static_assert(sizeof(*this) == sizeof(addresses), "SolveArrays has the same fields in the same order");
        memcpy((void*)this, &addresses, sizeof(*this));
    }
    CUDA_CALLABLE int contact_count() const { return *count < contact_max ? *count : contact_max; }
    CUDA_CALLABLE int body_of_shape(int shape) const { return shape_body[shape]; }
    CUDA_CALLABLE bool movable(int b) const { return b >= 0 && inv_mass[b] > 0; }
    CUDA_CALLABLE bool is_kinematic(int b) const { return b >= 0 && (flags[b] & kinematic_flag) != 0; }
    CUDA_CALLABLE int line_of_body(int b) const { return b < 0 ? line_count - 1 : slot[b]; }
    CUDA_CALLABLE unsigned long long pair_key(int c) const {
        return (unsigned long long)shape0[c] << 32 | (unsigned)shape1[c];
    }
    CUDA_CALLABLE bool has_friction(int c) const { return mu[shape0[c]] + mu[shape1[c]] > 0; }
};

// Sizes, in numbers, of a contact, its return velocity, its accumulated impulse, a record and a kept slip.
constexpr int CONTACT_SIZE = 20, RETURN_SIZE = 8, IMPULSE_SIZE = 12, RECORD_SIZE = 8, KEPT_SIZE = 9;

// Functions that read and write four numbers at a time. Their argument is a function that reads or writes quarter q of
// a line.
template <class Fours> CUDA_CALLABLE inline Body read_body(Fours motion) {
    const Four a = motion(0), b = motion(1);
    return {{a.x, a.y, a.z}, {b.x, b.y, b.z}, a.w, b.w};
}
template <class Fours> CUDA_CALLABLE inline Inertia read_inertia(Fours motion) {
    const Four a = motion(2), b = motion(3);
    return {{a.x, a.y, a.z, b.x, b.y, b.z}, a.w};
}
template <class Fours> CUDA_CALLABLE inline Pose read_pose(Fours pose) {
    const Four a = pose(0), b = pose(1);
    return {{a.x, a.y, a.z}, {b.x, b.y, b.z, b.w}};
}
template <class Fours> CUDA_CALLABLE inline DetectedContact read_detected(Fours side) {
    const Four a = side(0), b = side(1), c = side(2), d = side(3), e = side(4);
    // the last number is 1 where the own body is kinematic, plus 2 where the other one is
    const Number zero = e.w * Real(0), other_kinematic = e.w > Real(1.5) ? zero + 1 : zero;
    return {{a.x, a.y, a.z},
            {b.x, b.y, b.z},
            {c.x, c.y, c.z},
            {d.x, d.y, d.z},
            {e.x, e.y, e.z},
            a.w,
            b.w,
            c.w,
            d.w,
            e.w - 2 * other_kinematic,
            other_kinematic};
}
template <class Fours> CUDA_CALLABLE inline Contact read_contact(Fours side, const Slip& return_velocity) {
    const Four a = side(0), b = side(1), c = side(2), d = side(3);
    return {{a.x, a.y, a.z}, {b.x, b.y, b.z}, {c.x, c.y, c.z}, a.w, b.w, c.w, d.x, d.y, d.z, d.w, return_velocity};
}
template <class Fours> CUDA_CALLABLE inline Slip read_slip(Fours slip) {
    const Four a = slip(0), b = slip(1);
    return {{a.x, a.y, a.z}, {a.w, b.x, b.y}};
}
template <class PutFours> CUDA_CALLABLE inline void write_slip(const Slip& s, PutFours put) {
    put(0, Four{s.linear.x, s.linear.y, s.linear.z, s.angular.x});
    put(1, Four{s.angular.y, s.angular.z, 0 * s.angular.y, 0 * s.angular.z});
}
template <class Fours> CUDA_CALLABLE inline AccumulatedImpulse read_impulse(Fours impulse) {
    const Four a = impulse(0), b = impulse(1), c = impulse(2);
    return {{{a.x, a.y, a.z}, {a.w, b.x, b.y}}, {{b.z, b.w, c.x}, {c.y, c.z, c.w}}};
}
template <class PutFours> CUDA_CALLABLE inline void write_impulse(const AccumulatedImpulse& g, PutFours put) {
    const Vector &a = g.last.linear, &b = g.last.angular, &c = g.extrapolated.linear, &d = g.extrapolated.angular;
    put(0, Four{a.x, a.y, a.z, b.x});
    put(1, Four{b.y, b.z, c.x, c.y});
    put(2, Four{c.z, d.x, d.y, d.z});
}
template <class PutFours> CUDA_CALLABLE inline void write_contact(const Contact& c, PutFours put) {
    put(0, Four{c.normal.x, c.normal.y, c.normal.z, c.gap_speed});
    put(1, Four{c.arm.x, c.arm.y, c.arm.z, c.normal_mass});
    put(2, Four{c.other_arm.x, c.other_arm.y, c.other_arm.z, c.tangential_mass});
    put(3, Four{c.angular_mass, c.mu, c.torsional, c.rolling});
}
CUDA_CALLABLE inline void write_body(Real* motion, int i, const Body& body) {
    put_four(motion, 0, i, {body.v.x, body.v.y, body.v.z, body.inv_mass});
    put_four(motion, 1, i, {body.omega.x, body.omega.y, body.omega.z, body.inv_inertia});
}

// Centers of mass [m] of the bodies of lines i, in their frames.
CUDA_CALLABLE inline Vector centers_of_mass(const Arrays& a, int i) {
    Real row[3 * WIDTH];
    for (int l = 0; l < WIDTH; ++l)
        for (int c = 0; c < 3; ++c) row[3 * l + c] = a.body[i + l] < 0 ? 0 : a.com[3 * (size_t)a.body[i + l] + c];
    return vectors(row, WIDTH);
}

// Loads the bodies of lines i in their state before the solve. Lines without a body get the values of the world.
CUDA_CALLABLE inline void load_lines(const Arrays& a, int i) {
    for (int l = 0; l < WIDTH; ++l) {
        const int b = a.body[i + l];
        Real *const motion = a.motion + LINE * (size_t)(i + l), *const pose = a.pose + LINE * (size_t)(i + l);
        for (int k = 0; k < LINE; ++k) motion[k] = pose[k] = 0;
        pose[7] = motion[11] = 1;
        if (b < 0) continue;
        for (int c = 0; c < 3; ++c) {
            motion[c] = a.qd[6 * (size_t)b + c];
            motion[4 + c] = a.qd[6 * (size_t)b + 3 + c];
            pose[c] = a.q[7 * (size_t)b + c];
        }
        for (int c = 0; c < 4; ++c) pose[4 + c] = a.q[7 * (size_t)b + 3 + c];
        motion[3] = a.inv_mass[b];
        if (a.shares) motion[11] = a.shares[b];
        const Real* const inverse = a.inv_inertia + 9 * (size_t)b;
        motion[7] = motion[8] = inverse[0], motion[9] = inverse[4], motion[10] = inverse[8];
        motion[12] = inverse[1], motion[13] = inverse[5], motion[14] = inverse[2];
    }
    auto motion = [&](int quarter) { return own_four(a.motion, quarter, i); };
    Pose pose = read_pose([&](int quarter) { return own_four(a.pose, quarter, i); });
    pose.x += rotate(pose.q, centers_of_mass(a, i));
    put_four(a.pose, 0, i, {pose.x.x, pose.x.y, pose.x.z, 0 * pose.x.x});
    Inertia inertia = read_inertia(motion);
    if constexpr (!ROUND) inertia.inverse = rotate(pose.q, inertia.inverse);
    const Symmetric& s = inertia.inverse;
    const Body body = read_body(motion);
    Real* const copies[2] = {a.motion, a.next_motion};
    for (Real* lines : copies) {
        if (!lines) continue;
        write_body(lines, i, body);
        put_four(lines, 2, i, {s.xx, s.yy, s.zz, inertia.shares});
        put_four(lines, 3, i, {s.xy, s.yz, s.zx, 0 * s.xx});
    }
}

// Writes the velocities of the bodies of lines i, ``count`` of them at most.
CUDA_CALLABLE inline void store_velocities(const Arrays& a, const Body& body, int i, int count) {
    for (int l = 0; l < WIDTH && l < count; ++l) {
        Real* const qd = a.qd + 6 * (size_t)a.body[i + l];
        qd[0] = lane_of(body.v.x, l), qd[1] = lane_of(body.v.y, l), qd[2] = lane_of(body.v.z, l);
        qd[3] = lane_of(body.omega.x, l), qd[4] = lane_of(body.omega.y, l), qd[5] = lane_of(body.omega.z, l);
    }
}

// Finds the two bodies of contact c. Returns true if they differ and at least one of them is movable.
CUDA_CALLABLE inline bool find_bodies(const Arrays& a, int c, int (&ends)[2]) {
    ends[0] = a.body_of_shape(a.shape0[c]), ends[1] = a.body_of_shape(a.shape1[c]);
    return ends[0] != ends[1] && (a.movable(ends[0]) || a.movable(ends[1]));
}

// Writes detected contact c, with the body of shape ``end`` as its own body; the numbers are ``stride`` apart.
CUDA_CALLABLE inline void write_detected(const Arrays& a, int c, int end, Real* out, int stride) {
    const int shapes[2] = {a.shape0[c], a.shape1[c]};
    const Real* const points[2] = {a.point0 + 3 * (size_t)c, a.point1 + 3 * (size_t)c};
    const Real* const offsets[2] = {a.offset0 + 3 * (size_t)c, a.offset1 + 3 * (size_t)c};
    for (int row = 0; row < 2; ++row) { // own body, then the other one
        const int row_end = row == 0 ? end : 1 - end, b = a.body_of_shape(shapes[row_end]);
        for (int k = 0; k < 3; ++k) {
            const Real point = points[row_end][k] - (b < 0 ? 0 : a.com[3 * (size_t)b + k]);
            out[(4 * row + k) * stride] = point;
            out[(4 * (row + 2) + k) * stride] = point + offsets[row_end][k];
        }
    }
    for (int k = 0; k < 3; ++k) out[(16 + k) * stride] = (end == 1 ? 1 : -1) * a.normal[3 * (size_t)c + k];
    auto mean = [&](const Real* of_shape) { return Real(0.5) * (of_shape[shapes[0]] + of_shape[shapes[1]]); };
    out[3 * stride] = a.margin0[c] + a.margin1[c];
    out[7 * stride] = mean(a.mu);
    out[11 * stride] = mean(a.mu_torsional);
    out[15 * stride] = mean(a.mu_rolling);
    const int own_body = a.body_of_shape(shapes[end]), other_body = a.body_of_shape(shapes[1 - end]);
    out[19 * stride] = a.is_kinematic(own_body) + 2 * a.is_kinematic(other_body);
}

// Stores the range of the kept sides of body b.
CUDA_CALLABLE inline void keep_range(const Arrays& a, int b, int first, int last) {
    a.kept_range[2 * (size_t)b] = first;
    a.kept_range[2 * (size_t)b + 1] = last;
}
// Keeps a side of contact c for the next substep: its accumulated slip, and its point on the body of the first shape.
CUDA_CALLABLE inline void keep_slip(const Arrays& a, int side, int c, const Real (&slip)[6]) {
    Real* const kept = a.kept + KEPT_SIZE * (size_t)side;
    for (int k = 0; k < 6; ++k) kept[k] = slip[k];
    for (int k = 0; k < 3; ++k) kept[6 + k] = a.point0[3 * (size_t)c + k];
    a.kept_key[side] = a.pair_key(c);
}
// Reads the slip that contact c had accumulated on its second body at the end of the last substep. If the shapes
// touched at several points, the slip of the nearest point is read. The slip is 0 if they did not touch, or if the kept
// slip is not finite, as after a failed attempt at a step.
CUDA_CALLABLE inline void read_kept_slip(const Arrays& a, int c, Real (&slip)[6]) {
    for (Real& component : slip) component = 0;
    if (!a.has_friction(c)) return;
    int ends[2], ranges[2][2] = {};
    find_bodies(a, c, ends);
    for (int end = 0; end < 2; ++end)
        for (int k = 0; k < 2 && a.movable(ends[end]); ++k) ranges[end][k] = a.kept_range[2 * (size_t)ends[end] + k];
    // the lists of both bodies hold the contact: search the shorter one
    const int counts[2] = {ranges[0][1] - ranges[0][0], ranges[1][1] - ranges[1][0]};
    const int searched = !a.movable(ends[0]) || (a.movable(ends[1]) && counts[1] <= counts[0]);
    const Real* nearest = nullptr;
    Real least = Real(1e30);
    for (int side = ranges[searched][0]; side < ranges[searched][1]; ++side) {
        if (a.kept_key[side] != a.pair_key(c)) continue;
        const Real* const kept = a.kept + KEPT_SIZE * (size_t)side;
        Real square = 0;
        for (int k = 0; k < 3; ++k) {
            const Real apart = kept[6 + k] - a.point0[3 * (size_t)c + k];
            square += apart * apart;
        }
        if (square < least) least = square, nearest = kept;
    }
    Real size = 0;
    for (int k = 0; k < 6 && nearest; ++k) size += nearest[k] < 0 ? -nearest[k] : nearest[k];
    for (int k = 0; k < 6 && nearest && size < Real(1e30); ++k) slip[k] = searched ? nearest[k] : -nearest[k];
}
}
