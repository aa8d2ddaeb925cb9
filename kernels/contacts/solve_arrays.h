// What the contact solve works on: its arrays, and a line for each body that takes part.
//
// contact_solve.py has the meaning of all arrays. Lines are cache lines: those of bodies that contacts move come first,
// without gaps, then those of others that they touch; the world is one of these.
#pragma once
#include "contacts/contact_law.h"
#include "shared/team.h"

namespace warpmag {

// As ``SolveArrays`` in contact_solve.py.
struct Arrays {
    int contact_max, bodies, lines, kinematic_flag;
    // of Newton's contacts, then of its bodies
    const int *count, *shape0, *shape1, *shape_body;
    const Real *point0, *point1, *offset0, *offset1, *normal, *margin0, *margin1, *mu, *mu_torsional, *mu_rolling;
    const int* flags;
    const Real *com, *inv_mass, *inv_inertia, *q;
    Real* qd;
    // own
    const Real* shares;
    int *totals, *side_count, *filled, *slot, *body, *range, *entry, *other, *wide, *world_first, *kept_range;
    unsigned long long *key, *kept_key;
    Real *motion, *next_motion, *pose, *side, *back, *given, *record, *kept;

    template <class Addresses> CUDA_CALLABLE explicit Arrays(const Addresses& addresses) {
        static_assert(sizeof(*this) == sizeof(addresses), "SolveArrays has the same members in the same order");
        memcpy((void*)this, &addresses, sizeof(*this));
    }
    CUDA_CALLABLE int found() const { return *count < contact_max ? *count : contact_max; }
    CUDA_CALLABLE int body_of(int shape) const { return shape_body[shape]; }
    CUDA_CALLABLE bool movable(int b) const { return b >= 0 && inv_mass[b] > 0; }
    CUDA_CALLABLE bool kinematic(int b) const { return b >= 0 && (flags[b] & kinematic_flag) != 0; }
    CUDA_CALLABLE int line_of(int b) const { return b < 0 ? lines - 1 : slot[b]; }
    CUDA_CALLABLE unsigned long long key_of(int c) const {
        return (unsigned long long)shape0[c] << 32 | (unsigned)shape1[c];
    }
    CUDA_CALLABLE bool sticks(int c) const { return mu[shape0[c]] + mu[shape1[c]] > 0; }
};

// Numbers of a contact as found, of how it goes back, of its impulses, of a record, and of what is kept of a side.
constexpr int TOUCH = 20, BACK = 8, GIVEN = 12, RECORD = 8, KEPT = 9;

// Reads by four numbers, which ``fours`` gives for a quarter of a line, and writes so.
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
template <class Fours> CUDA_CALLABLE inline Touch read_touch(Fours side) {
    const Four a = side(0), b = side(1), c = side(2), d = side(3), e = side(4);
    // whether the bodies are kinematic is one number: 1 for the own and 2 for the other one
    const Number none = e.w * Real(0), its = e.w > Real(1.5) ? none + 1 : none;
    return {{a.x, a.y, a.z},
            {b.x, b.y, b.z},
            {c.x, c.y, c.z},
            {d.x, d.y, d.z},
            {e.x, e.y, e.z},
            a.w,
            b.w,
            c.w,
            d.w,
            e.w - 2 * its,
            its};
}
template <class Fours> CUDA_CALLABLE inline Contact read_contact(Fours side, const Slip& back) {
    const Four a = side(0), b = side(1), c = side(2), d = side(3);
    return {{a.x, a.y, a.z}, {b.x, b.y, b.z}, {c.x, c.y, c.z}, a.w, b.w, c.w, d.x, d.y, d.z, d.w, back};
}
template <class Fours> CUDA_CALLABLE inline Slip read_slip(Fours slip) {
    const Four a = slip(0), b = slip(1);
    return {{a.x, a.y, a.z}, {a.w, b.x, b.y}};
}
template <class PutFours> CUDA_CALLABLE inline void put_slip(const Slip& s, PutFours put) {
    put(0, Four{s.linear.x, s.linear.y, s.linear.z, s.turn.x});
    put(1, Four{s.turn.y, s.turn.z, 0 * s.turn.y, 0 * s.turn.z});
}
template <class Fours> CUDA_CALLABLE inline Given read_given(Fours given) {
    const Four a = given(0), b = given(1), c = given(2);
    return {{{a.x, a.y, a.z}, {a.w, b.x, b.y}}, {{b.z, b.w, c.x}, {c.y, c.z, c.w}}};
}
template <class PutFours> CUDA_CALLABLE inline void put_given(const Given& g, PutFours put) {
    const Vector &a = g.last.linear, &b = g.last.turn, &c = g.ahead.linear, &d = g.ahead.turn;
    put(0, Four{a.x, a.y, a.z, b.x});
    put(1, Four{b.y, b.z, c.x, c.y});
    put(2, Four{c.z, d.x, d.y, d.z});
}
template <class PutFours> CUDA_CALLABLE inline void put_contact(const Contact& c, PutFours put) {
    put(0, Four{c.normal.x, c.normal.y, c.normal.z, c.gap_speed});
    put(1, Four{c.arm.x, c.arm.y, c.arm.z, c.push_rate});
    put(2, Four{c.other_arm.x, c.other_arm.y, c.other_arm.z, c.rub_rate});
    put(3, Four{c.turn_rate, c.mu, c.torsional, c.rolling});
}
CUDA_CALLABLE inline void put_body(Real* motion, int i, const Body& body) {
    put_four(motion, 0, i, {body.v.x, body.v.y, body.v.z, body.inv_mass});
    put_four(motion, 1, i, {body.spin.x, body.spin.y, body.spin.z, body.inv_inertia});
}

// Centres of mass of the bodies of lines i in their frames.
CUDA_CALLABLE inline Vector centers(const Arrays& a, int i) {
    Real row[3 * WIDTH];
    for (int l = 0; l < WIDTH; ++l)
        for (int c = 0; c < 3; ++c) row[3 * l + c] = a.body[i + l] < 0 ? 0 : a.com[3 * (size_t)a.body[i + l] + c];
    return vectors(row, WIDTH);
}

// Fills lines i with their bodies, as they are before contacts; those without a body with the world.
CUDA_CALLABLE inline void begin_lines(const Arrays& a, int i) {
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
    pose.x += turned(pose.q, centers(a, i));
    put_four(a.pose, 0, i, {pose.x.x, pose.x.y, pose.x.z, 0 * pose.x.x});
    Inertia inertia = read_inertia(motion);
    if constexpr (!ROUND) inertia.inverse = turned(pose.q, inertia.inverse);
    const Symmetric& s = inertia.inverse;
    const Body body = read_body(motion);
    Real* const copies[2] = {a.motion, a.next_motion};
    for (Real* lines : copies) {
        if (!lines) continue;
        put_body(lines, i, body);
        put_four(lines, 2, i, {s.xx, s.yy, s.zz, inertia.shares});
        put_four(lines, 3, i, {s.xy, s.yz, s.zx, 0 * s.xx});
    }
}

// Writes the velocities of lines i, of which ``held`` are bodies.
CUDA_CALLABLE inline void end_lines(const Arrays& a, const Body& body, int i, int held) {
    for (int l = 0; l < WIDTH && l < held; ++l) {
        Real* const qd = a.qd + 6 * (size_t)a.body[i + l];
        qd[0] = lane_of(body.v.x, l), qd[1] = lane_of(body.v.y, l), qd[2] = lane_of(body.v.z, l);
        qd[3] = lane_of(body.spin.x, l), qd[4] = lane_of(body.spin.y, l), qd[5] = lane_of(body.spin.z, l);
    }
}

// The bodies of contact c, or false if it moves none.
CUDA_CALLABLE inline bool ends_of(const Arrays& a, int c, int (&ends)[2]) {
    ends[0] = a.body_of(a.shape0[c]), ends[1] = a.body_of(a.shape1[c]);
    return ends[0] != ends[1] && (a.movable(ends[0]) || a.movable(ends[1]));
}

// Writes contact c as it was found, seen from one of its ends; its numbers are ``stride`` apart.
CUDA_CALLABLE inline void put_touch(const Arrays& a, int c, int end, Real* place, int stride) {
    const int shapes[2] = {a.shape0[c], a.shape1[c]};
    const Real* const points[2] = {a.point0 + 3 * (size_t)c, a.point1 + 3 * (size_t)c};
    const Real* const offsets[2] = {a.offset0 + 3 * (size_t)c, a.offset1 + 3 * (size_t)c};
    for (int which = 0; which < 2; ++which) {
        const int from = which == 0 ? end : 1 - end, b = a.body_of(shapes[from]);
        for (int k = 0; k < 3; ++k) {
            const Real point = points[from][k] - (b < 0 ? 0 : a.com[3 * (size_t)b + k]);
            place[(4 * which + k) * stride] = point;
            place[(4 * (which + 2) + k) * stride] = point + offsets[from][k];
        }
    }
    for (int k = 0; k < 3; ++k) place[(16 + k) * stride] = (end == 1 ? 1 : -1) * a.normal[3 * (size_t)c + k];
    auto mean = [&](const Real* of_shape) { return Real(0.5) * (of_shape[shapes[0]] + of_shape[shapes[1]]); };
    place[3 * stride] = a.margin0[c] + a.margin1[c];
    place[7 * stride] = mean(a.mu);
    place[11 * stride] = mean(a.mu_torsional);
    place[15 * stride] = mean(a.mu_rolling);
    place[19 * stride] = a.kinematic(a.body_of(shapes[end])) + 2 * a.kinematic(a.body_of(shapes[1 - end]));
}

// Which sides are kept of body b.
CUDA_CALLABLE inline void keep_range(const Arrays& a, int b, int first, int last) {
    a.kept_range[2 * (size_t)b] = first;
    a.kept_range[2 * (size_t)b + 1] = last;
}
// Keeps a side of contact c for the next substep: how far it has slipped, and where on its first shape's body it is.
CUDA_CALLABLE inline void keep(const Arrays& a, int place, int c, const Real (&slipped)[6]) {
    Real* const kept = a.kept + KEPT * (size_t)place;
    for (int k = 0; k < 6; ++k) kept[k] = slipped[k];
    for (int k = 0; k < 3; ++k) kept[6 + k] = a.point0[3 * (size_t)c + k];
    a.kept_key[place] = a.key_of(c);
}
// How far contact c has slipped on its second body by the end of the last substep: where shapes touch at several
// points, the one that was nearest. Nothing if they did not touch, or if that is not finite, after an attempt that
// failed.
CUDA_CALLABLE inline void slipped_before(const Arrays& a, int c, Real (&slipped)[6]) {
    for (Real& one : slipped) one = 0;
    if (!a.sticks(c)) return;
    int ends[2], ranges[2][2] = {};
    ends_of(a, c, ends);
    for (int end = 0; end < 2; ++end)
        for (int k = 0; k < 2 && a.movable(ends[end]); ++k) ranges[end][k] = a.kept_range[2 * (size_t)ends[end] + k];
    // either body's list has it
    const int counts[2] = {ranges[0][1] - ranges[0][0], ranges[1][1] - ranges[1][0]};
    const int from = !a.movable(ends[0]) || (a.movable(ends[1]) && counts[1] <= counts[0]);
    const Real* nearest = nullptr;
    Real least = Real(1e30);
    for (int place = ranges[from][0]; place < ranges[from][1]; ++place) {
        if (a.kept_key[place] != a.key_of(c)) continue;
        const Real* const kept = a.kept + KEPT * (size_t)place;
        Real square = 0;
        for (int k = 0; k < 3; ++k) {
            const Real apart = kept[6 + k] - a.point0[3 * (size_t)c + k];
            square += apart * apart;
        }
        if (square < least) least = square, nearest = kept;
    }
    Real size = 0;
    for (int k = 0; k < 6 && nearest; ++k) size += nearest[k] < 0 ? -nearest[k] : nearest[k];
    for (int k = 0; k < 6 && nearest && size < Real(1e30); ++k) slipped[k] = from ? nearest[k] : -nearest[k];
}
}
