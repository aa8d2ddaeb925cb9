// Potential and field of a uniformly magnetized cylinder from the table of its shape
// (``warpmag.shapes.cylinder_potential``), by bicubic Hermite interpolation in ρ and z.
//
// A point inside the cylinder gets the potential of the outside, extended linearly through the nearest face: where
// contacts let an iron face sink into a magnet, the pull does not turn into a push.
#pragma once
#include "applied/polyhedron.h"

namespace warpmag {

constexpr int CYLINDER_ROW = 16, PLACE = 6; // numbers before the nodes: center, axis, and those of the table

struct Cylinder {
    Real3 center, axis;
    Real radius, half_height, rho_scale, z_scale, per_fold, reach; // as in the table
    int rho_rim, z_rim, rho_count, z_count;
    const Real* nodes;
};
CUDA_CALLABLE inline Cylinder cylinder_at(const Real* at) {
    const Real* const t = at + PLACE;
    return {real3(at), real3(at + 3),    t[0], t[1], t[2], t[3], t[8], t[9], (int)t[4], (int)t[5], (int)t[6],
            (int)t[7], at + CYLINDER_ROW};
}

// A coordinate in node spacings: its cell, the weights of G and of its derivative at both nodes, and the same weights
// for the derivative by the coordinate in meters.
struct CellBasis {
    Index cell;
    Number value[2], slope[2], value_rate[2], slope_rate[2];
};
// Basis of a point at the distance d beyond the rim's node. The cell is at least ``least``: before it the potential is
// linear in d.
CUDA_CALLABLE inline CellBasis basis_of(Number d, Real scale, Real per_fold, int rim, int count, Number least) {
    const Number zero = Number(Real(0)), distance = larger(d, -d), first = zero + Real(1) / (scale + distance);
    const Number folds = per_fold * logarithm((scale + distance) * (zero + 1 / scale));
    const Number node = rim + (d < 0 ? -folds : folds);
    const Mask before = node < least; // least is 0 or the rim
    CellBasis at;
    at.cell = truncated(smaller(larger(node, least), zero + (count - 2)));
    const Number linear = (least > 0 ? d : 0) * (zero + per_fold / scale);
    const Number t = before ? linear : node - number_of(at.cell), u = 1 - t;
    const Number rate = before ? zero + per_fold / scale : per_fold * first;
    at.value[0] = before ? zero + 1 : (1 + 2 * t) * u * u, at.value[1] = before ? zero : t * t * (3 - 2 * t);
    at.slope[0] = before ? t : t * u * u, at.slope[1] = before ? zero : -t * t * u;
    at.value_rate[1] = before ? zero : rate * (6 * t * u), at.value_rate[0] = -at.value_rate[1];
    at.slope_rate[0] = before ? rate : rate * (u * (1 - 3 * t)),
    at.slope_rate[1] = before ? zero : rate * (t * (3 * t - 2));
    return at;
}
// A component of G and its derivatives by ρ and z.
struct Interpolated {
    Number g, by_rho, by_z;
};
CUDA_CALLABLE inline Interpolated interpolated(const Real* nodes, int z_count, const CellBasis& rho,
                                               const CellBasis& z) {
    const Number zero = Number(Real(0));
    Interpolated out = {zero, zero, zero};
    for (int i = 0; i < 2; ++i) {
        Number g = zero, by_rho = zero, by_z = zero, by_both = zero;
        for (int j = 0; j < 2; ++j) {
            const Four node = collect_four(nodes, (rho.cell + i) * z_count + z.cell + j); // G, ∂ρ, ∂z, ∂ρ∂z
            g += z.value[j] * node.x + z.slope[j] * node.z, by_rho += z.value[j] * node.y + z.slope[j] * node.w;
            by_z += z.value_rate[j] * node.x + z.slope_rate[j] * node.z;
            by_both += z.value_rate[j] * node.y + z.slope_rate[j] * node.w;
        }
        out.g += rho.value[i] * g + rho.slope[i] * by_rho;
        out.by_rho += rho.value_rate[i] * g + rho.slope_rate[i] * by_rho;
        out.by_z += rho.value[i] * by_z + rho.slope[i] * by_both;
    }
    return out;
}
// Potential and field of a dipole.
CUDA_CALLABLE inline PotentialField dipole_field(Vector moment, Vector x) {
    const Number i = Real(0.5) * twice_inverse_root(dot(x, x)), i3 = i * i * i, mx = dot(moment, x);
    return {i3 * mx, (3 * mx * i * i) * i3 * x - i3 * moment};
}

// Scalar potential and field of magnetization m at x, in the frame of the cylinder's body.
CUDA_CALLABLE inline PotentialField potential_field_of(const Cylinder& cylinder, Real3 m, Vector x) {
    const Number zero = Number(Real(0));
    const Vector axis = broadcast(cylinder.axis), from = x - broadcast(cylinder.center);
    const Real along = dot(m, cylinder.axis);
    const Real3 across = m - along * cylinder.axis;
    const Number height = dot(from, axis), side = height < 0 ? zero - 1 : zero + 1;
    const Vector out = from - height * axis;
    const Number rho = length(out), d_rho = rho - cylinder.radius, d_z = side * height - cylinder.half_height;
    const Vector radial = 1 / larger(rho, zero + Real(1e-6) * cylinder.radius) * out;
    // above an end, or inside and nearer to it than to the wall
    const Mask over_end = (d_z >= 0) | ((d_rho < 0) & (d_z > d_rho));
    const CellBasis at_rho = basis_of(d_rho, cylinder.rho_scale, cylinder.per_fold, cylinder.rho_rim,
                                      cylinder.rho_count, over_end ? zero : zero + cylinder.rho_rim);
    const CellBasis at_z = basis_of(d_z, cylinder.z_scale, cylinder.per_fold, cylinder.z_rim, cylinder.z_count,
                                    over_end ? zero + cylinder.z_rim : zero);
    const Interpolated g = interpolated(cylinder.nodes, cylinder.z_count, at_rho, at_z);
    PotentialField f = {along * side * g.g, (-along * side * g.by_rho) * radial - (along * g.by_z) * axis};
    if (dot(across, across) > Real(1e-12) * dot(m, m)) {
        const Real* const nodes = cylinder.nodes + 4 * (size_t)(cylinder.rho_count * cylinder.z_count);
        const Interpolated q = interpolated(nodes, cylinder.z_count, at_rho, at_z);
        const Vector m_across = broadcast(across);
        const Number m_rho = dot(m_across, radial), per_rho = rho < Real(1e-3) * cylinder.radius ? q.by_rho : q.g / rho;
        f.phi += m_rho * q.g;
        f.h -= (m_rho * q.by_rho) * radial + (m_rho * side * q.by_z) * axis + per_rho * (m_across - m_rho * radial);
    }
    const Mask far = dot(from, from) > zero + cylinder.reach * cylinder.reach;
    if (any(far)) {
        const Real volume_by_4pi = Real(0.5) * cylinder.radius * cylinder.radius * cylinder.half_height;
        const PotentialField d = dipole_field(volume_by_4pi * broadcast(m), from);
        f.phi = far ? d.phi : f.phi;
        f.h.x = far ? d.h.x : f.h.x, f.h.y = far ? d.h.y : f.h.y, f.h.z = far ? d.h.z : f.h.z;
    }
    return f;
}
}
