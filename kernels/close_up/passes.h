// The passes over targets and bodies: fields at targets near bodies, what these push bodies with, and what bodies near
// each other do.
//
// Everything is a difference: the closed form less what the sums over pairs make of the lattice. On a CPU a pass works
// on a vector of targets or of points, on a GPU a group of threads shares a target, a row of targets or a body. Takes
// GROUP, MU0 and INVERSE_4PI from Python; ``Bodies`` is the struct of bodies.py, which has the names.
#pragma once
#include "close_up/polyhedron.h"
#include "pairs/pair_law.h"
#include "shared/team.h"

namespace warpmag {

enum CloseUpPass { AT_TARGETS, AT_POINTS, REACT, ADD_UP }; // as in bodies.py
constexpr int EDGE_POINT = 19, FACE_POINT = 7, WRENCH = 7; // as in bodies.py

struct Pose {
    Three origin, x, y, z; // where the axes of the body point in the world

    CUDA_CALLABLE Vector to_world(Vector v) const {
        return sum(sum(scaled(v.x, spread(x)), scaled(v.y, spread(y))), scaled(v.z, spread(z)));
    }
    CUDA_CALLABLE Vector to_body(Vector v) const { return {dot(v, spread(x)), dot(v, spread(y)), dot(v, spread(z))}; }
    CUDA_CALLABLE Three to_body(Three v) const { return {dot(v, x), dot(v, y), dot(v, z)}; }
    CUDA_CALLABLE Vector place(Vector v) const { return to_body(less(v, spread(origin))); }
    // R T R^T
    CUDA_CALLABLE Gradient to_world(const Gradient& t) const {
        const Vector a = to_world(times(t, spread({x.x, y.x, z.x}))), b = to_world(times(t, spread({x.y, y.y, z.y})));
        const Vector c = to_world(times(t, spread({x.z, y.z, z.z})));
        return {a.x, b.y, c.z, a.y, b.z, c.x};
    }
};
CUDA_CALLABLE inline Pose pose_from(const Real* at) {
    const Real x = at[3], y = at[4], z = at[5], w = at[6], n = 2 / (x * x + y * y + z * z + w * w);
    return {three(at),
            {1 - n * (y * y + z * z), n * (x * y + w * z), n * (x * z - w * y)},
            {n * (x * y - w * z), 1 - n * (x * x + z * z), n * (y * z + w * x)},
            {n * (x * z + w * y), n * (y * z - w * x), 1 - n * (x * x + y * y)}};
}

// A body: its place in the tables, its lattice and its magnetization, in its frame.
struct Body {
    Solid solid;
    Pose pose;
    Three m, middle, half;
    Real reach, radius, label;
    int first, count, shape;
};
template <class Bodies> CUDA_CALLABLE inline Real packed_at(const Bodies& all, int row, int i) {
    return all.packed.data[row * (all.packed.strides[0] / sizeof(Real)) + i];
}
template <class Bodies> CUDA_CALLABLE inline Body body_at(const Bodies& all, int b) {
    const int* const own = all.body.data + 4 * (size_t)b; // shape, first moment, their number
    const int* const tables = all.shape.data + 10 * (size_t)own[0];
    const Real* const size = all.size.data + 9 * (size_t)b; // 1/V of the first moment, reach, radius, middle, half
    const Solid solid = {all.edge.data + EDGE_ROW * (size_t)tables[0],
                         all.face.data + FACE_ROW * (size_t)tables[2],
                         all.corner.data + 3 * (size_t)tables[5],
                         all.begin.data + tables[4],
                         tables[1],
                         tables[3]};
    const Pose pose = pose_from((const Real*)all.frame.data + 7 * (size_t)b);
    const int first = own[1];
    const Three m = {size[0] * packed_at(all, 4, first), size[0] * packed_at(all, 5, first),
                     size[0] * packed_at(all, 6, first)};
    return {solid,           pose,    pose.to_body(m), three(size + 3),
            three(size + 6), size[1], size[2],         packed_at(all, 7, first),
            first,           own[2],  own[0]};
}

// Squared distance from the body's box of a place in its frame.
CUDA_CALLABLE inline Number away2(const Body& body, Vector at) {
    const Number zero = Number(Real(0));
    auto beyond = [=](Number v, Real middle, Real half) {
        const Number d = v - middle, size = larger(d, -d) - half;
        return larger(size, zero);
    };
    const Vector d = {beyond(at.x, body.middle.x, body.half.x), beyond(at.y, body.middle.y, body.half.y),
                      beyond(at.z, body.middle.z, body.half.z)};
    return dot(d, d);
}

// Field and gradient of a body's lattice, as the sums over pairs have it, at balls of given radius.
template <class Bodies>
CUDA_CALLABLE inline Near lattice_field(const Bodies& all, const Body& body, Vector x, Number radius, Mask wanted,
                                        int begin, int step) {
    Near out = no_field();
    for (int j = body.first + begin; j < body.first + body.count; j += step) {
        const Vector r = less(x, spread({packed_at(all, 0, j), packed_at(all, 1, j), packed_at(all, 2, j)}));
        const Vector m = spread({packed_at(all, 4, j), packed_at(all, 5, j), packed_at(all, 6, j)});
        const Number other = Number(Real(0)) + packed_at(all, 3, j), s = radius + other, d2 = dot(r, r), s2 = s * s;
        const Number c = larger(d2, s2), i = Real(0.5) * twice_inverse_root(c), i2 = i * i, i3 = i2 * i;
        const Number g2 = 3 * i2 * i3, rm = dot(r, m), g3 = -5 * i2 * g2 * rm;
        out.h = sum(out.h, less(scaled(g2 * rm, r), scaled(i3, m)));
        add_product(out.t, g2, r, m), add_product(out.t, g2, m, r), add_product(out.t, g3, r, r);
        out.t.xx += g2 * rm, out.t.yy += g2 * rm, out.t.zz += g2 * rm;
        const Mask overlapping = wanted & (d2 < s2);
        if (!any(overlapping)) continue;
        const Overlap p = overlap_of(r, radius, other, m, overlapping);
        add_where(overlapping, out.h, field_of(p));
        Gradient t = no_field().t; // of lanes that do not overlap it may be no number
        const Number of = p.unit * dot(p.u, p.m), k2 = p.unit * p.g.g2;
        add_product(t, k2, p.u, p.m), add_product(t, k2, p.m, p.u), add_product(t, p.g.g3 * of, p.u, p.u);
        t.xx += p.g.g2 * of, t.yy += p.g.g2 * of, t.zz += p.g.g2 * of;
        add_where(overlapping, out.t, t);
    }
    return out;
}

// What the closed form of a body's field has beyond its lattice's.
template <class Bodies>
CUDA_CALLABLE inline Near lacking(const Bodies& all, const Body& body, Vector x, Number radius, Mask wanted, int begin,
                                  int step) {
    const Near near = field_of(body.solid, body.m, body.pose.place(x), Real(0.25) * radius * radius, begin, step);
    const Near far = lattice_field(all, body, x, radius, wanted, begin, step);
    const Gradient a = body.pose.to_world(near.t), &b = far.t;
    const Number k = Number(Real(0)) + INVERSE_4PI;
    return {less(body.pose.to_world(near.h), scaled(k, far.h)),
            {a.xx - k * b.xx, a.yy - k * b.yy, a.zz - k * b.zz, a.xy - k * b.xy, a.yz - k * b.yz, a.zx - k * b.zx}};
}

// Magnetization of the body less that of its lattice's balls.
template <class Bodies>
CUDA_CALLABLE inline Vector lacking_inside(const Bodies& all, const Body& body, Vector x, int begin, int step) {
    const Number zero = Number(Real(0));
    Vector m = {zero, zero, zero};
    if (begin == 0) add_where(inside_of(body.solid, body.pose.place(x)), m, body.pose.to_world(spread(body.m)));
    for (int j = body.first + begin; j < body.first + body.count; j += step) {
        const Vector r = less(x, spread({packed_at(all, 0, j), packed_at(all, 1, j), packed_at(all, 2, j)}));
        const Real radius = packed_at(all, 3, j), each = -1 / (Real(4.18879020478639) * radius * radius * radius);
        const Vector own = spread({packed_at(all, 4, j), packed_at(all, 5, j), packed_at(all, 6, j)});
        add_where(dot(r, r) < zero + radius * radius, m, scaled(zero + each, own));
    }
    return m;
}

// Targets from column i on: places, radii and labels, and what is wanted of each (see bodies.py).
struct Targets {
    Vector x;
    Number radius, label;
    Index wanted;
};
template <class Bodies> CUDA_CALLABLE inline Targets targets_at(const Bodies& all, int i, int held) {
    const Real* const rows = all.target.data + i;
    const size_t pitch = all.target.strides[0] / sizeof(Real);
#if defined(__CUDA_ARCH__)
    if (held <= 0) return {{0, 0, 0}, 0, 0, 0};
    const Index wanted = all.wanted.data[i];
#else
    Index wanted = 0;
    for (int l = 0; l < held && l < WIDTH; ++l) wanted[l] = all.wanted.data[i + l];
#endif
    return {{numbers(rows), numbers(rows + pitch), numbers(rows + 2 * pitch)},
            numbers(rows + 3 * pitch),
            numbers(rows + 7 * pitch),
            wanted};
}

template <bool POINTS, class Bodies> CUDA_CALLABLE inline void field_at_targets(const Bodies& all, int row) {
    const auto& chunk = all.chunk.data[row / CHUNK]; // first target, their number, and the bodies of their world
    const int offset = row % CHUNK, held = chunk[1] - offset, i = chunk[0] + offset;
    if (held <= 0) return;
    const Targets at = targets_at(all, i, held);
    const Number zero = Number(Real(0));
    Vector h = {zero, zero, zero}, inside = h;
    Near push = no_field();
    for (int b = chunk[2]; b < chunk[3]; ++b) {
        const Body body = body_at(all, b);
        const Mask near = mask_of(at.wanted != 0) & (away2(body, body.pose.place(at.x)) < body.reach * body.reach);
        if (!any(near)) continue;
        const Near field = lacking(all, body, at.x, at.radius, near, share(), SHARES);
        add_where(near, h, field.h);
        const Mask pushed = near & (at.label != body.label);
        add_where(pushed, push.h, field.h);
        add_where(pushed, push.t, field.t);
        if constexpr (POINTS) add_where(near, inside, lacking_inside(all, body, at.x, share(), SHARES));
    }
    h = group_sums(h);
    push.h = group_sums(push.h);
    const Vector x = group_sums({push.t.xx, push.t.xy, push.t.zx}), y = group_sums({push.t.yy, push.t.yz, push.t.zz});
    if constexpr (POINTS) inside = group_sums(inside);
    if (share() != 0) return;
    const size_t column = 3 * (size_t)i;
    put_vectors((Real*)all.near_h.data + column, held, push.h);
    put_vectors((Real*)all.near_x.data + column, held, x);
    put_vectors((Real*)all.near_y.data + column, held, {x.y, y.x, y.y});
    put_vectors((Real*)all.near_z.data + column, held, {x.z, y.y, y.z});
    if constexpr (POINTS) put_vectors((Real*)all.near_m.data + column, held, inside);
    else {
        Real* const h0 = (Real*)all.h0.data + column;
        const Vector before = vectors(h0, held);
        Vector after = before;
        add_where(mask_of(at.wanted == 2), after, h); // inducible
        put_vectors(h0, held, after);
    }
}

// Which lanes the first ``held`` are.
CUDA_CALLABLE inline Mask first_lanes(int held) {
#if defined(__CUDA_ARCH__)
    return held > 0;
#else
    Index left;
    for (int l = 0; l < WIDTH; ++l) left[l] = held - l;
    return mask_of(left > 0);
#endif
}

// Force and torque, both to be multiplied by μ0, and energy.
struct Push {
    Vector force, torque;
    Number energy;
};
CUDA_CALLABLE inline Push no_push() {
    const Number zero = Number(Real(0));
    return {{zero, zero, zero}, {zero, zero, zero}, zero};
}
// Moments m at x in a field, torques about ``center``.
CUDA_CALLABLE inline void push_moments(Push& push, Mask wanted, const Near& field, Vector m, Vector x, Three center) {
    const Vector f = times(field.t, m), turn = sum(cross(less(x, spread(center)), f), cross(m, field.h));
    add_where(wanted, push.force, f);
    add_where(wanted, push.torque, turn);
    push.energy -= wanted ? dot(m, field.h) : 0;
}
CUDA_CALLABLE inline Real added_up(Number n) {
    n = group_sum(n);
#if defined(__CUDA_ARCH__)
    return n;
#else
    Real total = 0;
    for (int l = 0; l < WIDTH; ++l) total += n[l];
    return total;
#endif
}
CUDA_CALLABLE inline Three added_up(Vector v) { return {added_up(v.x), added_up(v.y), added_up(v.z)}; }
template <class Bodies> CUDA_CALLABLE inline Three center_of(const Bodies& all, const Body& body) {
    return {packed_at(all, 0, body.first), packed_at(all, 1, body.first), packed_at(all, 2, body.first)};
}
CUDA_CALLABLE inline void add_numbers(Real* to, Three force, Three torque, Real sign) {
    to[0] += sign * force.x, to[1] += sign * force.y, to[2] += sign * force.z;
    to[3] += sign * torque.x, to[4] += sign * torque.y, to[5] += sign * torque.z;
}

// What the targets of a row push their body with: the opposite of what it pushes them with.
template <class Bodies> CUDA_CALLABLE inline void react(const Bodies& all, int row) {
    const auto& part = all.row.data[row]; // body, first target and the end
    const Body body = body_at(all, part[0]);
    const Three center = center_of(all, body);
    Push push = no_push();
    const size_t pitch = all.target.strides[0] / sizeof(Real);
    for (int i = part[1] + WIDTH * share(); i < part[2]; i += WIDTH * SHARES) {
        const Targets at = targets_at(all, i, part[2] - i);
        const Mask near = mask_of(at.wanted != 0) & (at.label != body.label)
                          & (away2(body, body.pose.place(at.x)) < body.reach * body.reach);
        if (!any(near)) continue;
        const Real* const m = all.target.data + i + 4 * pitch;
        const Vector moment = {numbers(m), numbers(m + pitch), numbers(m + 2 * pitch)};
        push_moments(push, near, lacking(all, body, at.x, at.radius, near, 0, 1), moment, at.x, center);
    }
    const Three force = added_up(push.force), torque = added_up(push.torque);
    if (share() != 0) return;
    Real* const out = all.partial.data + 6 * (size_t)row;
    for (int k = 0; k < 6; ++k) out[k] = 0;
    add_numbers(out, force, torque, -MU0);
}

// What body q, whose surfaces' charges are summed, feels of body s beyond what its lattice does: over μ0, in the world,
// about its first moment.
template <class Bodies>
CUDA_CALLABLE inline void between(const Bodies& all, const Body& q, const Body& s, Three& force, Three& torque,
                                  Real& energy) {
    const Three center = center_of(all, q);
    const int* const tables = all.shape.data + 10 * (size_t)q.shape;
    const Vector m = spread(s.m), own = spread(q.m);
    Push push = no_push();
    auto potentials = [&](Vector x, Number& phi, Vector& a) { // of s, in the frame of q
        const Vector g = potentials_of(s.solid, s.pose.place(sum(q.pose.to_world(x), spread(q.pose.origin))));
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
        const Vector aside = sum(scaled(s1, vector_of(at, 6)), scaled(s2, vector_of(at, 9)));
        const Vector f = scaled(weight, less(scaled(along, less(scaled(s1, n1), scaled(s2, n2))), scaled(phi, aside)));
        push.force = sum(push.force, f);
        push.torque = sum(push.torque, cross(less(x, middle), f));
    }
    for (int i = tables[8] + WIDTH * share(); i < tables[8] + tables[9]; i += WIDTH * SHARES) {
        const Real* const at = rows_at(all.face_point.data, FACE_POINT, i);
        const Vector n = vector_of(at, 3);
        const Number charge = dot(own, n) * numbers(at + 6 * CHUNK);
        if (!any((dot(own, n) * dot(own, n) > dark) & (charge != 0))) continue;
        Number phi;
        Vector a;
        potentials(vector_of(at, 0), phi, a);
        push.torque = sum(push.torque, scaled(charge, less(a, scaled(dot(a, n), n))));
        push.energy += charge * phi;
    }
    push.force = q.pose.to_world(push.force), push.torque = q.pose.to_world(push.torque);
    const Number minus = Number(Real(-INVERSE_4PI));
    for (int i = q.first + WIDTH * share(); i < q.first + q.count; i += WIDTH * SHARES) {
        const size_t pitch = all.packed.strides[0] / sizeof(Real);
        const Real* const rows = all.packed.data + i;
        const Vector x = {numbers(rows), numbers(rows + pitch), numbers(rows + 2 * pitch)};
        const Mask held = first_lanes(q.first + q.count - i);
        const Vector moment = {numbers(rows + 4 * pitch), numbers(rows + 5 * pitch), numbers(rows + 6 * pitch)};
        const Near field = lattice_field(all, s, x, numbers(rows + 3 * pitch), held, 0, 1);
        push_moments(push, held, field, scaled(minus, moment), x, center);
    }
    force = added_up(push.force), torque = added_up(push.torque), energy = added_up(push.energy);
}

// Adds up what pushes a body, its rows' targets and other bodies. Of two bodies the charges of the smaller are summed,
// whichever of them asks, so that both get the same numbers.
template <class Bodies> CUDA_CALLABLE inline void add_up(const Bodies& all, int b) {
    Real total[WRENCH] = {};
    for (int row = all.row_begin.data[b] + share(); row < all.row_begin.data[b + 1]; row += SHARES)
        for (int k = 0; k < 6; ++k) total[k] += all.partial.data[6 * (size_t)row + k];
#if defined(__CUDA_ARCH__)
    for (int k = 0; k < 6; ++k) total[k] = group_sum(total[k]);
#endif
    const Body body = body_at(all, b);
    const auto& world = all.world.data[b]; // the bodies of its world
    for (int c = world[0]; c < world[1]; ++c) {
        if (c == b) continue;
        const Body other = body_at(all, c);
        if (other.label == body.label) continue;
        const bool own = body.radius < other.radius || (body.radius == other.radius && b < c);
        const Body &q = own ? body : other, &s = own ? other : body;
        const Three &p = q.pose.origin, &x = q.pose.x, &y = q.pose.y, &z = q.pose.z, &d = q.middle;
        const Vector middle = spread({p.x + d.x * x.x + d.y * y.x + d.z * z.x, p.y + d.x * x.y + d.y * y.y + d.z * z.y,
                                      p.z + d.x * x.z + d.y * y.z + d.z * z.z});
        const Real reach = q.radius + (q.reach > s.reach ? q.reach : s.reach);
        if (!any(away2(s, s.pose.place(middle)) < Number(Real(0)) + reach * reach)) continue;
        Three force, torque;
        Real energy;
        between(all, q, s, force, torque, energy);
        if (own) add_numbers(total, force, torque, MU0);
        else {
            const Three a = center_of(all, q), e = center_of(all, s), r = mixed(1, a, -1, e);
            const Three turn = {r.y * force.z - r.z * force.y, r.z * force.x - r.x * force.z,
                                r.x * force.y - r.y * force.x};
            add_numbers(total, force, mixed(1, torque, 1, turn), -MU0);
        }
        total[6] += Real(0.5) * MU0 * energy;
    }
    if (share() != 0) return;
    for (int k = 0; k < WRENCH; ++k) all.wrench.data[WRENCH * (size_t)b + k] = total[k];
}

template <class Word, class Bodies>
CUDA_CALLABLE inline void close_up(int thread, int first, int last, int threads, Word* team, const Bodies& all) {
    auto make_pass = [&](int pass, int i) {
        if (pass == AT_TARGETS) field_at_targets<false>(all, i);
        if (pass == AT_POINTS) field_at_targets<true>(all, i);
        if (pass == REACT) react(all, i);
        if (pass == ADD_UP) add_up(all, i);
    };
#if defined(__CUDA_ARCH__)
    make_pass(first, thread / GROUP);
#else
    auto items = [&](int pass) {
        return pass < REACT ? CHUNK * all.chunk.shape[0] : pass == REACT ? all.row.shape[0] : all.body.shape[0];
    };
    run_passes(team, threads, first, last, items, first < REACT ? WIDTH : 1, make_pass);
#endif
}
}
