// NearArrays of the passes over near pairs, and cache lines that balls write for others to read.
//
// near_pairs.py documents the arrays. It passes the numbers of their rows and slots, IMAGES of images.h, and UNIT,
// μ0/4π [T·m/A].
#pragma once
#include "material/curves.h"
#include "near_contact/group_rows.h"
#include "shared/team.h"
#include "shared/vectors.h"

namespace warpmag {

// Data of ``contact_arrays`` in near_pairs.py, without shapes and strides.
struct NearArrays {
    int balls, moment_stride, kinds, common_curve;
    int *group, *field_row, *kind, *candidate, *candidate_count, *moved, *used, *counterpart, *movable, *rotatable,
        *near, *near_count, *contact_count, *curve, *partner_begin, *partner_end, *magnet_movable, *face_begin,
        *face_end, *face, *face_cells, *cell_curve, *image_face;
    Real *packed, *radius, *inverse_saturation, *curve_slope, *hardness, *relaxation, *pairs, *conductances, *state,
        *last_state, *sources, *drives, *field, *cached, *pair_slopes, *conductance_slopes, *pair_forces, *partial,
        *found_at, *tables, *positions, *forces, *torques, *curve_tables, *single, *response, *bounds, *expansion,
        *face_plane, *face_edge, *face_origin, *face_rotation, *cell_slope, *cell_inverse_saturation, *image_view,
        *image_wrench;

    template <class Given> CUDA_CALLABLE explicit NearArrays(const Given& a) {
        balls = a.balls, moment_stride = a.moment_stride, kinds = a.kinds, common_curve = a.common_curve;
        // moments
        packed = a.packed.data, group = a.group.data, field_row = a.field_row.data, kind = a.kind.data;
        radius = a.radius.data, inverse_saturation = a.inverse_saturation.data, curve_slope = a.curve_slope.data;
        hardness = a.hardness.data, curve = a.curve.data, curve_tables = a.curve_tables.data, tables = a.tables.data;
        movable = a.movable.data, rotatable = a.rotatable.data;
        // near pairs
        candidate = a.candidate.data, candidate_count = a.candidate_count.data, moved = a.moved.data;
        found_at = (Real*)a.found_at.data, positions = a.positions.data, near = a.near.data, used = a.used.data;
        near_count = a.near_count.data, contact_count = a.contact_count.data, counterpart = a.counterpart.data;
        pairs = a.pairs.data, pair_slopes = a.pair_slopes.data, conductances = a.conductances.data;
        conductance_slopes = a.conductance_slopes.data, relaxation = a.relaxation.data;
        // sweeps and forces
        state = a.state.data, last_state = a.last_state.data, sources = a.sources.data, drives = a.drives.data;
        cached = a.cached.data, pair_forces = a.pair_forces.data, field = a.field.data;
        partial = (Real*)a.partial.data, forces = (Real*)a.forces.data, torques = (Real*)a.torques.data;
        // permanent moments
        const auto& magnets = a.magnets;
        partner_begin = magnets.partner_begin.data, partner_end = magnets.partner_end.data;
        magnet_movable = magnets.movable.data, single = magnets.single.data, bounds = magnets.bounds.data;
        response = magnets.response.data, expansion = magnets.expansion.data;
        // images in faces of iron
        const auto& faces = a.faces;
        face_begin = faces.begin.data, face_end = faces.end.data, face = faces.face.data, cell_curve = faces.curve.data;
        face_cells = faces.cells.data, face_plane = faces.plane.data, face_edge = faces.edge.data;
        face_origin = faces.origin.data, face_rotation = (Real*)faces.rotation.data, cell_slope = faces.slope.data;
        cell_inverse_saturation = faces.inverse_saturation.data, image_face = faces.image_face.data;
        image_view = faces.view.data, image_wrench = faces.wrench.data;
    }

    CUDA_CALLABLE Real* pair(int s, int i) const { return slot_at(pairs, NEAR_SLOTS, PAIR_ROWS, s, i); }
    CUDA_CALLABLE Real* pair_slope(int s, int i) const {
        return slot_at(pair_slopes, NEAR_SLOTS, PAIR_SLOPE_ROWS, s, i);
    }
    CUDA_CALLABLE Real* conductance(int s, int i) const {
        return slot_at(conductances, CONTACT_SLOTS, CONDUCTANCE_ROWS, s, i);
    }
    CUDA_CALLABLE Real* conductance_slope(int s, int i) const {
        return slot_at(conductance_slopes, CONTACT_SLOTS, CONDUCTANCE_SLOPE_ROWS, s, i);
    }
    CUDA_CALLABLE Real* pair_force(int s, int i) const { return slot_at(pair_forces, CONTACT_SLOTS, 3, s, i); }
    CUDA_CALLABLE Curves curves(int i) const {
        return curves_of(curve, common_curve, curve_tables, numbers(curve_slope + i), i, WIDTH);
    }
    // Row of a component of the moments m.
    CUDA_CALLABLE const Real* moment(int component, int i) const {
        return packed + (size_t)(4 + component) * moment_stride + i;
    }
    CUDA_CALLABLE Vector own_moment(int i) const {
        return {numbers(moment(0, i)), numbers(moment(1, i)), numbers(moment(2, i))};
    }
};

// Smooth sources of a ball, ã = (−q, t, Θ̃) with t = m − N, and its moment m.
struct Sources {
    Vector t, m;
    Number q;
    Traceless theta;
};
// Drive e of a ball: φ, R e_m and R² e_Θ, and a weight that falls as the ball saturates.
struct Drive {
    Number phi, weight;
    Vector e;
    Traceless t;
};

// True where moments are in the lines of sources: on a CPU, and if balls have images. Otherwise a GPU has no pass that
// writes them there, and reads the packed moments.
constexpr bool MOMENTS_IN_LINES = SHARES == 1 || IMAGES > 0;

// Sources of balls j.
CUDA_CALLABLE inline Sources sources_at(const NearArrays& arrays, const int* j) {
    const Four a = four_at(arrays.sources, 0, j), b = four_at(arrays.sources, 1, j), c = four_at(arrays.sources, 2, j);
    Vector m = {c.y, c.z, c.w};
    if constexpr (!MOMENTS_IN_LINES) m = arrays.own_moment(*j);
    return {{m.x - b.y, m.y - b.z, m.z - b.w}, m, -c.x, {a.x, a.y, a.z, a.w, b.x}};
}
CUDA_CALLABLE inline Drive drive_at(const NearArrays& arrays, const int* j) {
    const Four a = four_at(arrays.drives, 0, j), b = four_at(arrays.drives, 1, j), c = four_at(arrays.drives, 2, j);
    return {c.x, c.y, {b.y, b.z, b.w}, {a.x, a.y, a.z, a.w, b.x}};
}
// Indices of balls i, as an argument of the functions above.
struct OwnIndices {
    int at[WIDTH];
    CUDA_CALLABLE explicit OwnIndices(int i) {
        for (int l = 0; l < WIDTH; ++l) at[l] = i + l;
    }
};

// Slope k_d of the curve at the ball's moment, from 0 to 3 (an ideally permeable ball). The differential susceptibility
// χ_d follows from 1/χ_d = 1/k_d − 1/3, so multipoles soften as a ball saturates.
CUDA_CALLABLE inline Number differential_slope(const NearArrays& a, int i) {
    const Number slope = numbers(a.curve_slope + i), zero = slope * Real(0);
    const Vector reduced = numbers(a.inverse_saturation + i) * a.own_moment(i);
    const Number steepness = curve_steepness(dot(reduced, reduced), a.curves(i));
    return smaller(larger(slope * steepness, zero), zero + 3);
}

// Polarizability lχ/(lχ + 2l + 1) of a ball's multipoles of degree l, divided by R^(2l+1), at a slope of the curve.
CUDA_CALLABLE inline Number polarizability(Number slope, Real degree) {
    const Real stiffness = 2 + 1 / degree;
    return slope / (stiffness + slope * (1 - stiffness * Real(1.0 / 3.0)));
}

// Adds UNIT times vectors to an array of vectors, for moments whose ``flags`` are not 0.
CUDA_CALLABLE inline void add_to(Real* array, int i, Vector v, const int* flags) {
    for (int l = 0; l < WIDTH; ++l) {
        if (flags[i + l] == 0) continue;
        Real* const own = array + 3 * (size_t)(i + l);
        own[0] += UNIT * lane_of(v.x, l);
        own[1] += UNIT * lane_of(v.y, l);
        own[2] += UNIT * lane_of(v.z, l);
    }
}

// Writes numbers 0 to 7 and 13 of a ball to its line, followed by a vector.
CUDA_CALLABLE inline void store_line(Real* lines, int i, const Number* part, Vector more) {
#if defined(__CUDA_ARCH__)
    lines[LINE * (size_t)i + share()] = part[0];
    if (share() == 5) put_four(lines, 2, i, {part[1], more.x, more.y, more.z});
#else
    put_four(lines, 0, i, {part[0], part[1], part[2], part[3]});
    put_four(lines, 1, i, {part[4], part[5], part[6], part[7]});
    put_four(lines, 2, i, {part[13], more.x, more.y, more.z});
#endif
}

// Runs passes ``first`` to ``last`` − 1. A launch on a GPU runs only pass ``first``, because threads synchronize only
// between launches.
template <class Passes, class Addresses>
CUDA_CALLABLE inline void make_passes(int thread, int first, int last, int threads, unsigned long long* team,
                                      const Addresses& addresses) {
    const Passes passes = {NearArrays(addresses)};
#if defined(__CUDA_ARCH__)
    passes(first, thread / GROUP);
#else
    run_passes(team, threads, first, last, passes.a.balls, WIDTH, [&](int pass, int i) { passes(pass, i); });
#endif
}
}
