// Forces between permanent bodies near each other: the surface charges of one body in the potentials of the other.
// Bodies farther apart than the moments of the smaller body require: these moments in the closed form of the larger
// body. Potentials of a large body differ too little across a small one for single precision. Farther off still, the
// moments of one body in the field of the other's.
#pragma once
#include "applied/target_field.h"

namespace warpmag {

// Numbers of a point on an edge: position, direction of the edge, ν of both faces, n of both faces, weight. Numbers of
// a point on a face: position, n, weight. polyhedron.h defines ν and n.
constexpr int EDGE_POINT = 19, FACE_POINT = 7;

// Wrench of body s on the surface charges of body q. The torque is about ``center``.
template <class Arrays>
CUDA_CALLABLE inline Wrench wrench_on_charges(const Arrays& arrays, const PermanentBody& q, const PermanentBody& s,
                                              Real3 center) {
    // points on edges and faces, or on rims and ends of a cylinder that has charges on its ends only
    const int* const points = arrays.solids.shape.data + SHAPE_ROW * (size_t)q.shape + (q.cylinder.radius > 0 ? 13 : 6);
    const Vector m_target = broadcast(q.m);
    Wrench wrench = zero_wrench();
    auto potentials_at = [&](Vector x) { // of s, in the frame of q
        const Vector at = s.frame.point_to_body(q.frame.to_world(x) + broadcast(q.frame.origin));
        const Potentials p = potentials_of(s, at);
        return Potentials{p.phi, q.frame.to_body(s.frame.to_world(p.a))};
    };
    const Vector center_in_body = q.frame.point_to_body(broadcast(center));
    auto vector_of = [](const Real* rows, int k) {
        return Vector{numbers(rows + k * CHUNK), numbers(rows + (k + 1) * CHUNK), numbers(rows + (k + 2) * CHUNK)};
    };
    const Number negligible = Number(Real(0)) + Real(1e-12) * dot(q.m, q.m);
    for (int i = points[0] + WIDTH * share(); i < points[0] + points[1]; i += WIDTH * SHARES) {
        const Real* const at = rows_at(arrays.solids.edge_point.data, EDGE_POINT, i);
        const Vector n1 = vector_of(at, 12), n2 = vector_of(at, 15), x = vector_of(at, 0);
        const Number s1 = dot(m_target, n1), s2 = dot(m_target, n2), weight = numbers(at + 18 * CHUNK);
        if (!any((s1 * s1 + s2 * s2 > negligible) & (weight > 0))) continue;
        const Potentials p = potentials_at(x);
        const Number a_tangent = dot(p.a, vector_of(at, 3));
        const Vector normal = s1 * vector_of(at, 6) + s2 * vector_of(at, 9);
        const Vector f = weight * (a_tangent * (s1 * n1 - s2 * n2) - p.phi * normal);
        wrench.force += f;
        wrench.torque += cross(x - center_in_body, f);
    }
    for (int i = points[2] + WIDTH * share(); i < points[2] + points[3]; i += WIDTH * SHARES) {
        const Real* const at = rows_at(arrays.solids.face_point.data, FACE_POINT, i);
        const Vector n = vector_of(at, 3);
        const Number charge = dot(m_target, n) * numbers(at + 6 * CHUNK);
        if (!any((dot(m_target, n) * dot(m_target, n) > negligible) & (charge != 0))) continue;
        const Potentials p = potentials_at(vector_of(at, 0));
        wrench.torque += charge * (p.a - dot(p.a, n) * n);
        wrench.energy += charge * p.phi;
    }
    return {q.frame.to_world(wrench.force), q.frame.to_world(wrench.torque), wrench.energy};
}

// Wrench of body s on the moments that replace body q at a distance, by the closed form of s if ``closed``, else by
// such moments of s. The torque is about ``center``.
template <class Arrays>
CUDA_CALLABLE inline Wrench wrench_on_moments(const Arrays& arrays, const PermanentBody& q, const PermanentBody& s,
                                              bool closed, Real3 center) {
    const Number zero = Number(Real(0));
    const int* const tables = arrays.solids.shape.data + SHAPE_ROW * (size_t)q.shape;
    Wrench wrench = zero_wrench();
    for (int i = WIDTH * share(); i < tables[11]; i += WIDTH * SHARES) {
        const Real* const at = rows_at(arrays.solids.moment.data, MOMENT_ROW, tables[10] + i);
        const Vector x = q.frame.to_world(own_vector(at)) + broadcast(q.frame.origin);
        const Vector at_s = s.frame.point_to_body(x);
        const CurlFreeField field = closed ? closed_form(s, at_s, zero, 0, 1) : moments_field(arrays, s, at_s, 0, 1);
        add_wrench(wrench, first_lanes(tables[11] - i), target_field(s.frame.to_world(field)),
                   numbers(at + 3 * CHUNK) * broadcast(q.m_world), x, center);
    }
    return wrench;
}

// Two bodies: q, the smaller one, whose charges or moments are summed, in the field of s. ``near`` is true where the
// pair differs from that of the moments in the system, ``charges`` for the surface charges of q, false for its moments,
// ``closed`` for the closed form of s.
struct BodyPair {
    PermanentBody q, s;
    bool first_is_q, near, charges, closed;
};
// The pair of two bodies, of which the one that ``precedes`` counts as smaller if both are of a size. Both bodies then
// sum the same points, so that action and reaction are bitwise equal.
CUDA_CALLABLE inline BodyPair body_pair(const PermanentBody& body, const PermanentBody& other, bool precedes) {
    const bool is_smaller = body.radius < other.radius || (body.radius == other.radius && precedes);
    BodyPair pair = {is_smaller ? body : other, is_smaller ? other : body, is_smaller, false, false, false};
    const PermanentBody &q = pair.q, &s = pair.s;
    const Real3 &p = q.frame.origin, &x = q.frame.x, &y = q.frame.y, &z = q.frame.z, &d = q.box_center;
    const Vector center = broadcast(p + d.x * x + (d.y * y + d.z * z));
    const Number distance2 = box_distance2(s, s.frame.point_to_body(center));
    auto is_within = [&](Real a, Real b) {
        const Real reach = q.radius + (a > b ? a : b);
        return any(distance2 < Number(Real(0)) + reach * reach);
    };
    pair.near = is_within(q.far_reach, s.far_reach) && body.label != other.label;
    pair.charges = is_within(q.reach, q.reach), pair.closed = is_within(q.reach, s.reach);
    return pair;
}
// Wrench of s on the charges or the moments of q. The torque is about ``center``.
template <class Arrays>
CUDA_CALLABLE inline Wrench summed_wrench(const Arrays& arrays, const BodyPair& pair, Real3 center) {
    return pair.charges ? wrench_on_charges(arrays, pair.q, pair.s, center)
                        : wrench_on_moments(arrays, pair.q, pair.s, pair.closed, center);
}

// Force/μ0, torque/μ0 and energy/μ0 of body s on body q, less those between their moments in the system. The torque is
// about the first moment of q; all results are in the world's frame.
template <class Arrays>
CUDA_CALLABLE inline void body_wrench(const Arrays& arrays, const BodyPair& pair, Real3& force, Real3& torque,
                                      Real& energy) {
    const PermanentBody &q = pair.q, &s = pair.s;
    const Real3 center = reference_point(arrays, q);
    Wrench wrench = summed_wrench(arrays, pair, center);
    const Number minus = Number(Real(-INVERSE_4PI));
    for (int i = q.first + WIDTH * share(); i < q.first + q.count; i += WIDTH * SHARES) {
        const size_t pitch = arrays.packed.strides[0] / sizeof(Real);
        const Real* const rows = arrays.packed.data + i;
        const Vector x = {numbers(rows), numbers(rows + pitch), numbers(rows + 2 * pitch)};
        const Mask occupied = first_lanes(q.first + q.count - i);
        const Number radius = numbers(rows + 3 * pitch);
        const Vector moment =
            q.responds ? (Real(4.18879020478639) * radius * radius * radius * broadcast(q.m_world))
                       : Vector{numbers(rows + 4 * pitch), numbers(rows + 5 * pitch), numbers(rows + 6 * pitch)};
        const CurlFreeField field = lattice_field(arrays, s, x, radius, occupied, 0, 1);
        add_wrench(wrench, occupied, target_field(field), minus * moment, x, center);
    }
    force = total_of(wrench.force), torque = total_of(wrench.torque), energy = total_of(wrench.energy);
}
}
