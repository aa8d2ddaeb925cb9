// Forces of permanent bodies near each other: of the charges on the surfaces of one in the field of the other.
#pragma once
#include "applied/seen.h"

namespace warpmag {

constexpr int EDGE_POINT = 19, FACE_POINT = 7; // as in solids.py

// What body q, whose surfaces' charges are summed, feels of body s beyond what its lattice does: over μ0, in the world,
// about its first moment.
template <class All>
CUDA_CALLABLE inline void between(const All& all, const Body& q, const Body& s, Three& force, Three& torque,
                                  Real& energy) {
    const Three center = center_of(all, q);
    const int* const tables = all.shape.data + 10 * (size_t)q.shape;
    const Vector m = spread(s.m), own = spread(q.m);
    Push push = no_push();
    auto potentials = [&](Vector x, Number& phi, Vector& a) { // of s, in the frame of q
        const Vector g = potentials_of(s.solid, s.pose.place(q.pose.to_world(x) + spread(q.pose.origin)));
        phi = dot(m, g);
        a = q.pose.to_body(s.pose.to_world(cross(m, g)));
    };
    const Vector middle = q.pose.place(spread(center));
    auto vector_of = [](const Real* rows, int k) {
        return Vector{numbers(rows + k * CHUNK), numbers(rows + (k + 1) * CHUNK), numbers(rows + (k + 2) * CHUNK)};
    };
    const Number dark = Number(Real(0)) + Real(1e-12) * dot(q.m, q.m);
    for (int i = tables[6] + WIDTH * share(); i < tables[6] + tables[7]; i += WIDTH * SHARES) {
        const Real* const at = rows_at(all.edge_point.data, EDGE_POINT, i);
        const Vector n1 = vector_of(at, 12), n2 = vector_of(at, 15), x = vector_of(at, 0);
        const Number s1 = dot(own, n1), s2 = dot(own, n2), weight = numbers(at + 18 * CHUNK);
        if (!any((s1 * s1 + s2 * s2 > dark) & (weight > 0))) continue;
        Number phi;
        Vector a;
        potentials(x, phi, a);
        const Number along = dot(a, vector_of(at, 3));
        const Vector aside = s1 * vector_of(at, 6) + s2 * vector_of(at, 9);
        const Vector f = weight * (along * (s1 * n1 - s2 * n2) - phi * aside);
        push.force += f;
        push.torque += cross(x - middle, f);
    }
    for (int i = tables[8] + WIDTH * share(); i < tables[8] + tables[9]; i += WIDTH * SHARES) {
        const Real* const at = rows_at(all.face_point.data, FACE_POINT, i);
        const Vector n = vector_of(at, 3);
        const Number charge = dot(own, n) * numbers(at + 6 * CHUNK);
        if (!any((dot(own, n) * dot(own, n) > dark) & (charge != 0))) continue;
        Number phi;
        Vector a;
        potentials(vector_of(at, 0), phi, a);
        push.torque += charge * (a - dot(a, n) * n);
        push.energy += charge * phi;
    }
    push.force = q.pose.to_world(push.force), push.torque = q.pose.to_world(push.torque);
    const Number minus = Number(Real(-INVERSE_4PI));
    for (int i = q.first + WIDTH * share(); i < q.first + q.count; i += WIDTH * SHARES) {
        const size_t pitch = all.packed.strides[0] / sizeof(Real);
        const Real* const rows = all.packed.data + i;
        const Vector x = {numbers(rows), numbers(rows + pitch), numbers(rows + 2 * pitch)};
        const Mask held = first_lanes(q.first + q.count - i);
        const Number radius = numbers(rows + 3 * pitch);
        const Vector moment =
            q.yields ? (Real(4.18879020478639) * radius * radius * radius * spread(q.uniform))
                     : Vector{numbers(rows + 4 * pitch), numbers(rows + 5 * pitch), numbers(rows + 6 * pitch)};
        const Near field = lattice_field(all, s, x, radius, held, 0, 1);
        push_moments(push, held, seen_of(field), minus * moment, x, center);
    }
    force = added_up(push.force), torque = added_up(push.torque), energy = added_up(push.energy);
}
}
