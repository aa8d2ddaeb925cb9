// What the contact solve works on: its arrays, and a line for each body that takes part.
//
// contact_solve.py has the meaning of all arrays. Lines are cache lines: those of bodies that contacts move come first,
// without gaps, then those of others that they touch; the world is one of these.
#pragma once
#include "rigid/contact_law.h"
#include "shared/team.h"

namespace warpmag {

// As ``SolveArrays`` in contact_solve.py.
struct Arrays {
    int contact_max, bodies, lines, with_levers, kinematic_flag;
    // of Newton's contacts, then of its bodies
    const int *count, *shape0, *shape1, *shape_body;
    const Real *point0, *point1, *offset0, *offset1, *normal, *margin0, *margin1, *mu, *mu_torsional, *mu_rolling;
    const int* flags;
    const Real *com, *inv_mass, *inv_inertia, *inertia;
    Real *q, *qd;
    // own
    const Real* shares;
    int *totals, *side_count, *filled, *slot, *body, *range, *entry, *other, *wide, *world_first;
    unsigned long long* key;
    Real *motion, *next_motion, *first_motion, *matter, *side, *pressed, *record;

    template <class Addresses> CUDA_CALLABLE explicit Arrays(const Addresses& addresses) {
        static_assert(sizeof(*this) == sizeof(addresses), "SolveArrays has the same members in the same order");
        memcpy((void*)this, &addresses, sizeof(*this));
    }
    CUDA_CALLABLE int found() const { return *count < contact_max ? *count : contact_max; }
    CUDA_CALLABLE int body_of(int shape) const { return shape_body[shape]; }
    CUDA_CALLABLE bool movable(int b) const { return b >= 0 && inv_mass[b] > 0; }
    CUDA_CALLABLE bool kinematic(int b) const { return b >= 0 && (flags[b] & kinematic_flag) != 0; }
    CUDA_CALLABLE int line_of(int b) const { return b < 0 ? lines - 1 : slot[b]; }
};

constexpr int SIDE = 20, RECORD = 8; // numbers of a side, and of an impulse record, both in fours

// Reads by four numbers, which ``fours`` gives for a quarter of a line.
template <class Fours> CUDA_CALLABLE inline Body read_body(Fours motion) {
    const Four a = motion(0), b = motion(1), c = motion(2);
    return {{a.x, a.y, a.z}, {c.x, c.y, c.z}, {b.x, b.y, b.z, b.w}, a.w, c.w};
}
template <class Fours> CUDA_CALLABLE inline Drift read_drift(Fours motion) {
    const Four d = motion(3);
    return {{d.x, d.y, d.z}, d.w};
}
// Of a share, which is smaller than the whole by a number that stands beside the inverse inertia.
template <class Fours> CUDA_CALLABLE inline Inertia read_inertia(Fours matter) {
    if constexpr (ROUND) return {};
    const Four a = matter(0), b = matter(1);
    return {{a.w * a.x, a.w * a.y, a.w * a.z, a.w * b.x, a.w * b.y, a.w * b.z}};
}
// Of the whole body, of which motion is given, too.
template <class Fours> CUDA_CALLABLE inline Whole read_whole(const Drift& motion, Fours matter) {
    const Four a = matter(0), b = matter(1), c = matter(2), d = matter(3);
    return {motion.v, b.w, {a.x, a.y, a.z, b.x, b.y, b.z}, {c.x, c.y, c.z, d.x, d.y, d.z}};
}
template <class Fours> CUDA_CALLABLE inline Contact read_contact(Fours side) {
    const Four a = side(0), b = side(1), c = side(2), d = side(3), e = side(4);
    return {
        {a.x, a.y, a.z}, {b.x, b.y, b.z}, {c.x, c.y, c.z}, {d.x, d.y, d.z}, {e.x, e.y, e.z}, a.w, b.w, c.w, d.w, e.w};
}
CUDA_CALLABLE inline void put_body(Real* motion, int i, const Body& body, const Drift& drift) {
    put_four(motion, 0, i, {body.x.x, body.x.y, body.x.z, body.ease});
    put_four(motion, 1, i, {body.q.x, body.q.y, body.q.z, body.q.w});
    put_four(motion, 2, i, {body.spin.x, body.spin.y, body.spin.z, body.spin_ease});
    put_four(motion, 3, i, {drift.v.x, drift.v.y, drift.v.z, drift.kinematic});
}

CUDA_CALLABLE inline void put_symmetric(Real* quarters, const Real* matrix) {
    quarters[0] = matrix[0], quarters[1] = matrix[4], quarters[2] = matrix[8];
    quarters[4] = matrix[1], quarters[5] = matrix[5], quarters[6] = matrix[2];
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
        Real *const motion = a.motion + LINE * (size_t)(i + l), *const matter = a.matter + LINE * (size_t)(i + l);
        for (int k = 0; k < LINE; ++k) motion[k] = matter[k] = 0;
        motion[7] = matter[3] = 1;
        if (b < 0) continue;
        for (int c = 0; c < 3; ++c) {
            motion[c] = a.q[7 * (size_t)b + c];
            motion[12 + c] = a.qd[6 * (size_t)b + c];
            motion[8 + c] = a.qd[6 * (size_t)b + 3 + c];
        }
        for (int c = 0; c < 4; ++c) motion[4 + c] = a.q[7 * (size_t)b + 3 + c];
        if (a.shares) matter[3] = a.shares[b];
        put_symmetric(matter, a.inv_inertia + 9 * (size_t)b);
        put_symmetric(matter + 8, a.inertia + 9 * (size_t)b);
        motion[3] = matter[3] * a.inv_mass[b];
        matter[7] = a.inv_mass[b];
        motion[11] = matter[3] * matter[0];
        motion[15] = a.kinematic(b);
    }
    auto motion = [&](int quarter) { return own_four(a.motion, quarter, i); };
    Body body = read_body(motion);
    body.x = sum(body.x, turned(body.q, centers(a, i)));
    put_body(a.motion, i, body, read_drift(motion));
    if (a.next_motion) put_body(a.next_motion, i, body, read_drift(motion));
    if (a.with_levers) put_body(a.first_motion, i, body, read_drift(motion));
}

// Writes the poses and velocities of lines i, of which ``held`` are bodies.
CUDA_CALLABLE inline void end_lines(const Arrays& a, const Body& body, const Drift& drift, int i, int held) {
    const Vector origin = less(body.x, turned(body.q, centers(a, i)));
    for (int l = 0; l < WIDTH && l < held; ++l) {
        Real *const q = a.q + 7 * (size_t)a.body[i + l], *const qd = a.qd + 6 * (size_t)a.body[i + l];
        q[0] = lane_of(origin.x, l), q[1] = lane_of(origin.y, l), q[2] = lane_of(origin.z, l);
        q[3] = lane_of(body.q.x, l), q[4] = lane_of(body.q.y, l), q[5] = lane_of(body.q.z, l);
        q[6] = lane_of(body.q.w, l);
        qd[0] = lane_of(drift.v.x, l), qd[1] = lane_of(drift.v.y, l), qd[2] = lane_of(drift.v.z, l);
        qd[3] = lane_of(body.spin.x, l), qd[4] = lane_of(body.spin.y, l), qd[5] = lane_of(body.spin.z, l);
    }
}

// The bodies of contact c, or false if it moves none.
CUDA_CALLABLE inline bool ends_of(const Arrays& a, int c, int (&ends)[2]) {
    ends[0] = a.body_of(a.shape0[c]), ends[1] = a.body_of(a.shape1[c]);
    return ends[0] != ends[1] && (a.movable(ends[0]) || a.movable(ends[1]));
}

// Writes contact c as seen from one of its ends; its numbers are ``stride`` apart.
CUDA_CALLABLE inline void put_side(const Arrays& a, int c, int end, Real* place, int stride) {
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
    place[7 * stride] = a.kinematic(a.body_of(shapes[0])) || a.kinematic(a.body_of(shapes[1]));
    place[11 * stride] = mean(a.mu);
    place[15 * stride] = mean(a.mu_torsional);
    place[19 * stride] = mean(a.mu_rolling);
}
}
