// Permanent bodies: where they are, what their lattices make of their field, and what the closed form has beyond that.
//
// ``All`` is the struct of sources.py, which has the names. Takes INVERSE_4PI from Python.
#pragma once
#include "applied/polyhedron.h"
#include "pairs/pair_law.h"

namespace warpmag {

struct Pose {
    Three origin, x, y, z; // where the axes of the body point in the world

    CUDA_CALLABLE Vector to_world(Vector v) const { return v.x * spread(x) + v.y * spread(y) + v.z * spread(z); }
    CUDA_CALLABLE Vector to_body(Vector v) const { return {dot(v, spread(x)), dot(v, spread(y)), dot(v, spread(z))}; }
    CUDA_CALLABLE Three to_body(Three v) const { return {dot(v, x), dot(v, y), dot(v, z)}; }
    CUDA_CALLABLE Vector place(Vector v) const { return to_body(v - spread(origin)); }
    // R T R^T
    CUDA_CALLABLE Symmetric to_world(const Symmetric& t) const {
        const Vector a = to_world(t * spread({x.x, y.x, z.x})), b = to_world(t * spread({x.y, y.y, z.y}));
        const Vector c = to_world(t * spread({x.z, y.z, z.z}));
        return {a.x, b.y, c.z, a.y, b.z, c.x};
    }
    CUDA_CALLABLE Near to_world(const Near& n) const { return {to_world(n.h), to_world(n.t)}; }
};
CUDA_CALLABLE inline Pose pose_from(const Real* at) {
    const Real x = at[3], y = at[4], z = at[5], w = at[6], n = 2 / (x * x + y * y + z * z + w * w);
    return {three(at),
            {1 - n * (y * y + z * z), n * (x * y + w * z), n * (x * z - w * y)},
            {n * (x * y - w * z), 1 - n * (x * x + z * z), n * (y * z + w * x)},
            {n * (x * z + w * y), n * (y * z - w * x), 1 - n * (x * x + y * y)}};
}

// A body: its place in the tables, its lattice and its magnetization, in its frame. Of one that yields to fields that
// is what its remanence alone would make of a ball, ``uniform`` in the world, whatever its moments are.
struct Body {
    Solid solid;
    Pose pose;
    Three m, middle, half, uniform;
    Real reach, radius, label;
    int first, count, shape, yields;
};
template <class All> CUDA_CALLABLE inline Real packed_at(const All& all, int row, int i) {
    return all.packed.data[row * (all.packed.strides[0] / sizeof(Real)) + i];
}
template <class All> CUDA_CALLABLE inline Body body_at(const All& all, int b) {
    const int* const own = all.body.data + 4 * (size_t)b; // shape, first moment, their number, whether it yields
    const int* const tables = all.shape.data + 10 * (size_t)own[0];
    // 1/V of the first moment, or what to multiply its bias by, reach, radius, middle, half
    const Real* const size = all.size.data + 9 * (size_t)b;
    const Solid solid = {all.edge.data + EDGE_ROW * (size_t)tables[0],
                         all.face.data + FACE_ROW * (size_t)tables[2],
                         all.corner.data + 3 * (size_t)tables[5],
                         all.begin.data + tables[4],
                         tables[1],
                         tables[3]};
    const Pose pose = pose_from((const Real*)all.solid_frame.data + 7 * (size_t)b);
    const int first = own[1];
    const Three of = own[3] ? three((const Real*)all.bias.data + 3 * (size_t)first)
                            : Three{packed_at(all, 4, first), packed_at(all, 5, first), packed_at(all, 6, first)};
    const Three m = size[0] * of;
    return {solid,  pose,    pose.to_body(m), three(size + 3),          three(size + 6),
            m,      size[1], size[2],         packed_at(all, 7, first), first,
            own[2], own[0],  own[3]};
}

// A moment of a body's lattice that the closed form stands for.
template <class All> CUDA_CALLABLE inline Three moment_at(const All& all, const Body& body, int j) {
    if (!body.yields) return {packed_at(all, 4, j), packed_at(all, 5, j), packed_at(all, 6, j)};
    const Real radius = packed_at(all, 3, j), volume = Real(4.18879020478639) * radius * radius * radius;
    return volume * body.uniform;
}

template <class All> CUDA_CALLABLE inline Three center_of(const All& all, const Body& body) {
    return {packed_at(all, 0, body.first), packed_at(all, 1, body.first), packed_at(all, 2, body.first)};
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
template <class All>
CUDA_CALLABLE inline Near lattice_field(const All& all, const Body& body, Vector x, Number radius, Mask wanted,
                                        int begin, int step) {
    Near out = no_field();
    for (int j = body.first + begin; j < body.first + body.count; j += step) {
        const Vector r = x - spread({packed_at(all, 0, j), packed_at(all, 1, j), packed_at(all, 2, j)});
        const Vector m = spread(moment_at(all, body, j));
        const Number other = Number(Real(0)) + packed_at(all, 3, j), s = radius + other, d2 = dot(r, r), s2 = s * s;
        const Number c = larger(d2, s2), i = Real(0.5) * twice_inverse_root(c), i2 = i * i, i3 = i2 * i;
        const Number g2 = 3 * i2 * i3, rm = dot(r, m);
        const Number g3 = -5 * i2 * (g2 * rm); // without r⁻⁷, which is no float at 1 µm
        out.h += (g2 * rm * r - i3 * m);
        add_product(out.t, g2, r, m), add_product(out.t, g2, m, r), add_product(out.t, g3, r, r);
        out.t.xx += g2 * rm, out.t.yy += g2 * rm, out.t.zz += g2 * rm;
        const Mask overlapping = wanted & (d2 < s2);
        if (!any(overlapping)) continue;
        const Overlap p = overlap_of(r, radius, other, m, overlapping);
        add_where(overlapping, out.h, field_of(p));
        Symmetric t = no_field().t; // of lanes that do not overlap it may be no number
        const Number of = p.unit * dot(p.u, p.m), k2 = p.unit * p.g.g2;
        add_product(t, k2, p.u, p.m), add_product(t, k2, p.m, p.u), add_product(t, p.g.g3 * of, p.u, p.u);
        t.xx += p.g.g2 * of, t.yy += p.g.g2 * of, t.zz += p.g.g2 * of;
        add_where(overlapping, out.t, t);
    }
    return out;
}

// What the closed form of a body's field has beyond its lattice's.
template <class All>
CUDA_CALLABLE inline Near lacking(const All& all, const Body& body, Vector x, Number radius, Mask wanted, int begin,
                                  int step) {
    const Near near = field_of(body.solid, body.m, body.pose.place(x), Real(0.25) * radius * radius, begin, step);
    const Near far = lattice_field(all, body, x, radius, wanted, begin, step);
    return body.pose.to_world(near) - INVERSE_4PI * far;
}

// Magnetization of the body less that of its lattice's balls.
template <class All>
CUDA_CALLABLE inline Vector lacking_inside(const All& all, const Body& body, Vector x, int begin, int step) {
    const Number zero = Number(Real(0));
    Vector m = {zero, zero, zero};
    if (begin == 0) add_where(inside_of(body.solid, body.pose.place(x)), m, body.pose.to_world(spread(body.m)));
    for (int j = body.first + begin; j < body.first + body.count; j += step) {
        const Vector r = x - spread({packed_at(all, 0, j), packed_at(all, 1, j), packed_at(all, 2, j)});
        const Real radius = packed_at(all, 3, j), each = -1 / (Real(4.18879020478639) * radius * radius * radius);
        const Vector own = spread(moment_at(all, body, j));
        add_where(dot(r, r) < zero + radius * radius, m, (zero + each) * own);
    }
    return m;
}
}
