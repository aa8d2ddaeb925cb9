// Permanent bodies: their frames, the fields of their moments in the system, and the correction of these fields by the
// closed form nearby, and by more moments up to a larger distance.
//
// ``Arrays`` is the struct of sources.py. Takes INVERSE_4PI from Python.
#pragma once
#include "applied/axial_cylinder.h"
#include "pairs/pair_law.h"

namespace warpmag {

// Numbers of a shape and of a body, as in solids.py; numbers of a moment: position and volume.
constexpr int SHAPE_ROW = 17, SIZE_ROW = 10, MOMENT_ROW = 4;

// Origin and axes of a body in the world.
struct Frame {
    Real3 origin, x, y, z;

    CUDA_CALLABLE Vector to_world(Vector v) const {
        return v.x * broadcast(x) + v.y * broadcast(y) + v.z * broadcast(z);
    }
    CUDA_CALLABLE Vector to_body(Vector v) const {
        return {dot(v, broadcast(x)), dot(v, broadcast(y)), dot(v, broadcast(z))};
    }
    CUDA_CALLABLE Real3 to_body(Real3 v) const { return {dot(v, x), dot(v, y), dot(v, z)}; }
    CUDA_CALLABLE Vector point_to_body(Vector v) const { return to_body(v - broadcast(origin)); }
    // R T Rᵀ
    CUDA_CALLABLE Symmetric to_world(const Symmetric& t) const {
        const Vector a = to_world(t * broadcast({x.x, y.x, z.x})), b = to_world(t * broadcast({x.y, y.y, z.y}));
        const Vector c = to_world(t * broadcast({x.z, y.z, z.z}));
        return {a.x, b.y, c.z, a.y, b.z, c.x};
    }
    CUDA_CALLABLE CurlFreeField to_world(const CurlFreeField& n) const { return {to_world(n.h), to_world(n.t)}; }
};
// Frame from a transform: position and quaternion (x, y, z, w), normalized here.
CUDA_CALLABLE inline Frame frame_of(const Real* at) {
    const Real x = at[3], y = at[4], z = at[5], w = at[6], n = 2 / (x * x + y * y + z * z + w * w);
    return {real3(at),
            {1 - n * (y * y + z * z), n * (x * y + w * z), n * (x * z - w * y)},
            {n * (x * y - w * z), 1 - n * (x * x + z * z), n * (y * z + w * x)},
            {n * (x * z + w * y), n * (y * z - w * x), 1 - n * (x * x + y * y)}};
}

// Weight of a source's field at a point, and its gradient by the point's position. ``offset`` is the vector from the
// box around the source to the point.
struct SourceFade {
    Real weight;
    Real3 slope, offset;
};
// The weight fades from 1 to 0 between the distances ``low`` and ``high`` from the box, in multiples of ``unit``.
CUDA_CALLABLE inline SourceFade fade_of(Real3 point, Real unit, Real low, Real high, const Frame& frame, Real3 center,
                                        Real3 half) {
    auto excess = [](Real at, Real half) { return at > half ? at - half : at < -half ? at + half : Real(0); };
    const Real3 at = frame.to_body(point - frame.origin) - center;
    const Real3 d = {excess(at.x, half.x), excess(at.y, half.y), excess(at.z, half.z)};
    const Real3 offset = d.x * frame.x + d.y * frame.y + d.z * frame.z;
    const Real distance = wp::sqrt(dot(d, d)) / unit, width = high - low;
    const Real ramp = (high - distance) / width, t = ramp < 1 ? ramp : Real(1);
    if (!(t > 0)) return {0, {0, 0, 0}, offset};
    const Real slope = t < 1 ? -6 * t * (1 - t) / (width * unit * unit * distance) : Real(0);
    return {t * t * (3 - 2 * t), slope * offset, offset};
}

// A permanent body. Its closed form has the magnetization ``m`` in the body's frame, and ``m_world`` in the world. If
// the body responds to fields, this is the magnetization of a ball by the remanence alone, without the part that fields
// induce. ``cylinder`` is the exact shape of a body that is magnetized along the axis of a cylinder.
struct PermanentBody {
    Solid solid;
    AxialCylinder cylinder;
    Frame frame;
    Real3 m, box_center, box_half, m_world;
    Real reach, far_reach, radius, label; // ``radius`` of its bounding sphere
    int first, count, shape, responds;    // ``first`` and ``count`` of its moments in the system
};
// One number of a packed moment. Rows are position (0 to 2), radius (3), moment (4 to 6) and label (7).
template <class Arrays> CUDA_CALLABLE inline Real packed_at(const Arrays& arrays, int row, int i) {
    return arrays.packed.data[row * (arrays.packed.strides[0] / sizeof(Real)) + i];
}
template <class Arrays> CUDA_CALLABLE inline Real3 packed_real3(const Arrays& arrays, int row, int i) {
    return {packed_at(arrays, row, i), packed_at(arrays, row + 1, i), packed_at(arrays, row + 2, i)};
}
// The cylinder at a number of the table, of a body of magnetization m; none if m is not along its axis.
template <class Arrays> CUDA_CALLABLE inline AxialCylinder axial_cylinder(const Arrays& arrays, int number, Real3 m) {
    const Real* const at = arrays.solids.cylinder.data + number;
    const Real3 axis = real3(at + 3);
    const Real along = dot(m, axis);
    const Real3 across = m - along * axis;
    if (dot(across, across) > Real(1e-12) * dot(m, m)) return {};
    return {real3(at), axis, at[6], at[7], along};
}
template <class Arrays> CUDA_CALLABLE inline PermanentBody body_at(const Arrays& arrays, int b) {
    const int* const row =
        arrays.solids.body.data + 4 * (size_t)b; // shape, first moment, number of moments, 1 if it responds
    const int* const tables = arrays.solids.shape.data + SHAPE_ROW * (size_t)row[0];
    // 1/V of the first moment, or k if the body responds; reach, far_reach, radius, box_center, box_half
    const Real* const size = arrays.solids.size.data + SIZE_ROW * (size_t)b;
    const Solid solid = {arrays.solids.edge.data + EDGE_ROW * (size_t)tables[0],
                         arrays.solids.face.data + FACE_ROW * (size_t)tables[2],
                         arrays.solids.corner.data + 3 * (size_t)tables[5],
                         arrays.solids.begin.data + tables[4],
                         tables[1],
                         tables[3]};
    const Frame frame = frame_of((const Real*)arrays.solids.frame.data + 7 * (size_t)b);
    const int first = row[1];
    const Real3 magnetized =
        row[3] ? real3((const Real*)arrays.solids.bias.data + 3 * (size_t)first) : packed_real3(arrays, 4, first);
    const Real3 m = size[0] * magnetized, local = frame.to_body(m);
    const AxialCylinder cylinder = tables[12] < 0 ? AxialCylinder{} : axial_cylinder(arrays, tables[12], local);
    return {solid,
            cylinder,
            frame,
            local,
            real3(size + 4),
            real3(size + 7),
            m,
            size[1],
            size[2],
            size[3],
            packed_at(arrays, 7, first),
            first,
            row[2],
            row[0],
            row[3]};
}
// Field of the closed form of a body at points in its frame.
CUDA_CALLABLE inline CurlFreeField closed_form(const PermanentBody& body, Vector at, Number least2, int begin,
                                               int step) {
    if (body.cylinder.radius > 0) return field_of(body.cylinder, at, least2, begin, step);
    return field_of(body.solid, body.m, at, least2, begin, step);
}
// Potentials of the closed form of a body at points in its frame.
CUDA_CALLABLE inline Potentials potentials_of(const PermanentBody& body, Vector at) {
    if (body.cylinder.radius > 0) return potentials_of(body.cylinder, at);
    const Vector g = potentials_of(body.solid, at), m = broadcast(body.m);
    return {dot(m, g), cross(m, g)};
}

// Moment j of a body's lattice that the closed form replaces: only the part by the remanence if the body responds to
// fields.
template <class Arrays> CUDA_CALLABLE inline Real3 moment_at(const Arrays& arrays, const PermanentBody& body, int j) {
    if (!body.responds) return packed_real3(arrays, 4, j);
    const Real radius = packed_at(arrays, 3, j), volume = Real(4.18879020478639) * radius * radius * radius;
    return volume * body.m_world;
}

// Position of a body's first moment, the reference point of its torque.
template <class Arrays> CUDA_CALLABLE inline Real3 reference_point(const Arrays& arrays, const PermanentBody& body) {
    return packed_real3(arrays, 0, body.first);
}

// Squared distance of a point from the body's box, in the body's frame.
CUDA_CALLABLE inline Number box_distance2(const PermanentBody& body, Vector at) {
    const Number zero = Number(Real(0));
    auto excess = [=](Number v, Real center, Real half) {
        const Number d = v - center, size = larger(d, -d) - half;
        return larger(size, zero);
    };
    const Vector d = {excess(at.x, body.box_center.x, body.box_half.x),
                      excess(at.y, body.box_center.y, body.box_half.y),
                      excess(at.z, body.box_center.z, body.box_half.z)};
    return dot(d, d);
}

// Adds 4π times field and gradient of a moment m at the distance r of inverse length i.
CUDA_CALLABLE inline void add_dipole(CurlFreeField& out, Vector r, Number i, Vector m) {
    const Number i2 = i * i, i3 = i2 * i, g2 = 3 * i2 * i3, rm = dot(r, m);
    const Number g3 = -5 * i2 * (g2 * rm); // avoids r⁻⁷, which overflows float32 at 1 µm
    out.h += (g2 * rm * r - i3 * m);
    add_product(out.t, g2, r, m), add_product(out.t, g2, m, r), add_product(out.t, g3, r, r);
    out.t.xx += g2 * rm, out.t.yy += g2 * rm, out.t.zz += g2 * rm;
}

// 4π times field and gradient of a body's moments in the system at balls of the given radius, as in the sums over
// pairs.
template <class Arrays>
CUDA_CALLABLE inline CurlFreeField lattice_field(const Arrays& arrays, const PermanentBody& body, Vector x,
                                                 Number radius, Mask mask, int begin, int step) {
    CurlFreeField out = zero_field();
    for (int j = body.first + begin; j < body.first + body.count; j += step) {
        const Vector r = x - broadcast(packed_real3(arrays, 0, j));
        const Vector m = broadcast(moment_at(arrays, body, j));
        const Number source_radius = Number(Real(0)) + packed_at(arrays, 3, j), s = radius + source_radius,
                     d2 = dot(r, r), s2 = s * s;
        add_dipole(out, r, Real(0.5) * twice_inverse_root(larger(d2, s2)), m);
        const Mask overlapping = mask & (d2 < s2);
        if (!any(overlapping)) continue;
        const Overlap p = overlap_of(r, radius, source_radius, m, overlapping);
        add_where(overlapping, out.h, field_of(p));
        Symmetric t = zero_field().t; // lanes without overlap may be NaN, and are masked
        const Number um = p.unit * dot(p.u, p.m), k2 = p.unit * p.g.g2;
        add_product(t, k2, p.u, p.m), add_product(t, k2, p.m, p.u), add_product(t, p.g.g3 * um, p.u, p.u);
        t.xx += p.g.g2 * um, t.yy += p.g.g2 * um, t.zz += p.g.g2 * um;
        add_where(overlapping, out.t, t);
    }
    return out;
}

// Field and gradient of the moments that replace a body's closed form, at x in the frame of the body.
template <class Arrays>
CUDA_CALLABLE inline CurlFreeField moments_field(const Arrays& arrays, const PermanentBody& body, Vector x, int begin,
                                                 int step) {
    const int* const tables = arrays.solids.shape.data + SHAPE_ROW * (size_t)body.shape;
    const Vector m = broadcast(body.m);
    CurlFreeField out = zero_field();
    for (int j = tables[10] + begin; j < tables[10] + tables[11]; j += step) {
        const Real* const at = rows_at(arrays.solids.moment.data, MOMENT_ROW, j);
        const Vector r = x - broadcast({at[0], at[CHUNK], at[2 * CHUNK]});
        add_dipole(out, r, Real(0.5) * twice_inverse_root(dot(r, r)), at[3 * CHUNK] * m);
    }
    return INVERSE_4PI * out;
}

// Field of a body at targets nearer than its far reach, in the world.
template <class Arrays>
CUDA_CALLABLE inline CurlFreeField near_field(const Arrays& arrays, const PermanentBody& body, Vector x, Number radius,
                                              Mask mask, int begin, int step) {
    const Vector at = body.frame.point_to_body(x);
    // the form of a cylinder is cheaper than its moments, everywhere
    const Real reach = body.cylinder.radius > 0 ? body.far_reach : body.reach;
    const Mask near = box_distance2(body, at) < reach * reach, close = mask & near, apart = mask & !near;
    CurlFreeField field = zero_field();
    if (any(close)) {
        const CurlFreeField exact = closed_form(body, at, Real(0.25) * radius * radius, begin, step);
        add_where(close, field.h, exact.h), add_where(close, field.t, exact.t);
    }
    if (any(apart)) {
        const CurlFreeField summed = moments_field(arrays, body, at, begin, step);
        add_where(apart, field.h, summed.h), add_where(apart, field.t, summed.t);
    }
    return body.frame.to_world(field);
}
// The same, less the field of the body's moments in the system.
template <class Arrays>
CUDA_CALLABLE inline CurlFreeField field_correction(const Arrays& arrays, const PermanentBody& body, Vector x,
                                                    Number radius, Mask mask, int begin, int step) {
    return near_field(arrays, body, x, radius, mask, begin, step)
           - INVERSE_4PI * lattice_field(arrays, body, x, radius, mask, begin, step);
}

// Magnetization of the body less that of its moments' balls, at x.
template <class Arrays>
CUDA_CALLABLE inline Vector magnetization_correction(const Arrays& arrays, const PermanentBody& body, Vector x,
                                                     int begin, int step) {
    const Number zero = Number(Real(0));
    Vector m = {zero, zero, zero};
    const Vector at = body.frame.point_to_body(x);
    const Mask inside = body.cylinder.radius > 0 ? points_about(body.cylinder, at).inside : inside_of(body.solid, at);
    if (begin == 0) add_where(inside, m, body.frame.to_world(broadcast(body.m)));
    for (int j = body.first + begin; j < body.first + body.count; j += step) {
        const Vector r = x - broadcast(packed_real3(arrays, 0, j));
        const Real radius = packed_at(arrays, 3, j),
                   per_volume = -1 / (Real(4.18879020478639) * radius * radius * radius);
        const Vector m_ball = broadcast(moment_at(arrays, body, j));
        add_where(dot(r, r) < zero + radius * radius, m, (zero + per_volume) * m_ball);
    }
    return m;
}
}
