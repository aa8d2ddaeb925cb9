// Permanent bodies near cells of inducible bodies: averages of their field, and charges on the cells' outer faces.
//
// The field at a cell's center does not represent a cell near the edge of a magnet, where the field varies over less
// than a cell. There the average of the field over the cell is taken, H̄ = −Σ n φ̄ A/V over its faces, with the
// mean potential φ̄ of FACE_POINTS points of a face. A face in front of a magnet has charges that vary over less than a
// cell, too. They respond to the potentials at the points with q = −R φ, and have the energy −½ μ0 φᵀ R φ. Python
// computes R (``warpmag.shapes.face_charges``); it leaves out uniform and linear charges.
//
// Both fade with the distance of a cell from the body, in longest sides of the cell. Forces are the derivatives of the
// energy. Takes CELL_REACH_LOW and CELL_REACH_HIGH from Python. ``Arrays`` is the struct of sources.py.
#pragma once
#include "applied/target_field.h"

namespace warpmag {

constexpr int FACE_POINTS = 16, CELL_POINTS = 6 * FACE_POINTS; // as in near_cells.py

// A cell in the world. The axes are those of its grid; ``outer`` has a bit for each face on the surface of the body.
struct Cell {
    Real3 center, axes[3];
    Real half[3], size, radius, label, response;
    int moment, first, last, outer; // ``first`` and ``last``: range of permanent bodies
    const Real* matrices;           // R of a face across each axis, for an ideally permeable body

    // Points k and its successors; ``units`` are all points of a cube of half side 1.
    CUDA_CALLABLE Vector points(const Real* units, int k) const {
        Vector x = broadcast(center);
        for (int a = 0; a < 3; ++a) x += (half[a] * numbers(units + a * CELL_POINTS + k)) * broadcast(axes[a]);
        return x;
    }
    // Charge at a point of a face per magnetic moment along the outward normal.
    CUDA_CALLABLE Real share_of(int face) const { return 1 / (2 * FACE_POINTS * half[face / 2]); }
    CUDA_CALLABLE bool is_outer(int face) const { return outer >> face & 1; }
};
template <class Arrays> CUDA_CALLABLE inline Cell cell_at(const Arrays& arrays, int c) {
    const auto& row = arrays.cells.cell.data[c];  // moment, body of its rotation, range of permanent bodies
    const auto& form = arrays.cells.form.data[c]; // bits of outer faces, index of its matrices
    const Real* const box = arrays.cells.box.data + 4 * (size_t)c; // half sides, χ/(χ + 2)
    const Real* const q = (const Real*)arrays.cells.rotation.data + 4 * (size_t)row[1];
    const Real* const grid = arrays.cells.grid.data + 9 * (size_t)row[1]; // axes of the grid in the body's frame
    const Real pose[7] = {0, 0, 0, q[0], q[1], q[2], q[3]};
    const Frame body = frame_of(pose);
    Cell cell = {packed_real3(arrays, 0, row[0]),
                 {},
                 {box[0], box[1], box[2]},
                 0,
                 packed_at(arrays, 3, row[0]),
                 packed_at(arrays, 7, row[0]),
                 box[3],
                 row[0],
                 row[2],
                 row[3],
                 form[0],
                 arrays.cells.response.data + (size_t)form[1] * (3 * FACE_POINTS * FACE_POINTS)};
    for (int a = 0; a < 3; ++a) {
        cell.axes[a] = grid[3 * a] * body.x + grid[3 * a + 1] * body.y + grid[3 * a + 2] * body.z;
        cell.size = cell.half[a] > Real(0.5) * cell.size ? 2 * cell.half[a] : cell.size;
    }
    return cell;
}
CUDA_CALLABLE inline SourceFade cell_fade(const Cell& cell, const PermanentBody& body) {
    return fade_of(cell.center, cell.size, CELL_REACH_LOW, CELL_REACH_HIGH, body.frame, body.box_center, body.box_half);
}
// Points in the frame of a permanent body, and the face of the body that they have passed: the charge of that face, if
// they are inside, and their height above it. Points on the face count as outside.
struct NearPoints {
    Vector at, normal;
    Number charge, height;
};
CUDA_CALLABLE inline NearPoints near_points(const PermanentBody& body, Vector x) {
    const Number zero = Number(Real(0)), touching = zero + Real(1e-6) * body.radius;
    NearPoints points = {body.frame.point_to_body(x), {zero, zero, zero}, zero, zero - 2 * body.radius};
    for (int f = 0; f < body.solid.faces; ++f) {
        const Vector n = broadcast(real3(body.solid.face + FACE_ROW * f));
        const Vector corner = broadcast(real3(body.solid.corner + 3 * body.solid.begin[f]));
        const Number height = dot(points.at - corner, n);
        const Mask nearer = height > points.height;
        points.height = nearer ? height : points.height;
        points.normal.x = nearer ? n.x : points.normal.x, points.normal.y = nearer ? n.y : points.normal.y;
        points.normal.z = nearer ? n.z : points.normal.z;
    }
    const Number shift = points.height * points.height < touching * touching ? 2 * touching : zero;
    points.at += shift * points.normal;
    points.height += shift;
    points.charge = points.height < 0 ? dot(broadcast(body.m), points.normal) : zero;
    return points;
}
// Potential and field of a body. Where contacts let an iron face sink into a magnet they are those of the outside, as
// if the magnet's face were in front of the points: the pull does not turn into a push.
CUDA_CALLABLE inline PotentialField outer_field(const PermanentBody& body, Vector x) {
    const NearPoints points = near_points(body, x);
    const PotentialField f = potential_field_of(body.solid, body.m, points.at);
    return {f.phi - points.charge * points.height, body.frame.to_world(f.h + points.charge * points.normal)};
}
CUDA_CALLABLE inline Real3 first_lane(Vector v) { return {lane_of(v.x, 0), lane_of(v.y, 0), lane_of(v.z, 0)}; }
// Closed form of a body's field at the center of a cell, in all lanes.
CUDA_CALLABLE inline TargetField center_field(const Cell& cell, const PermanentBody& body) {
    const Vector at = body.frame.point_to_body(broadcast(cell.center));
    const Number least2 = Number(Real(0)) + Real(0.25) * cell.radius * cell.radius;
    const TargetField f = target_field(body.frame.to_world(field_of(body.solid, body.m, at, least2, share(), SHARES)));
    return {group_sums(f.h), group_sums(f.x), group_sums(f.y), group_sums(f.z)};
}

// Replaces the fields of near bodies at the center of cell c by their averages, and writes the potentials at the points
// of its faces.
template <class Arrays> CUDA_CALLABLE inline void average_over_cell(const Arrays& arrays, int c) {
    const Cell cell = cell_at(arrays, c);
    const Real* const units = arrays.cells.point.data;
    Real* const potential = arrays.cells.potential.data + CELL_POINTS * (size_t)c;
    Real3 field = {0, 0, 0}, acting = field;
    bool is_near = false;
    for (int b = cell.first; b < cell.last; ++b) {
        const PermanentBody body = body_at(arrays, b);
        const SourceFade fade = cell_fade(cell, body);
        if (fade.weight == 0) continue;
        const bool acts = body.label != cell.label;
        Vector sums = zero_target_field().h; // along the axes of the grid
        for (int k = WIDTH * share(); k < CELL_POINTS; k += WIDTH * SHARES) {
            const int face = k / FACE_POINTS;
            const Number phi = outer_field(body, cell.points(units, k)).phi;
            (face < 2 ? sums.x : face < 4 ? sums.y : sums.z) += (face % 2 ? -1 : 1) * cell.share_of(face) * phi;
            if (acts) put(potential + k, (is_near ? numbers(potential + k) : 0 * phi) + fade.weight * phi);
        }
        const Real3 mean = total_of(sums);
        const Real3 average = mean.x * cell.axes[0] + mean.y * cell.axes[1] + mean.z * cell.axes[2];
        const Real3 change = fade.weight * (average - first_lane(center_field(cell, body).h));
        field += change;
        if (acts) acting += change, is_near = true;
    }
    if (share() != 0) return;
    arrays.cells.near.data[c] = is_near;
    Real* const at_change = (Real*)arrays.cells.change.data + 3 * (size_t)c;
    at_change[0] = acting.x, at_change[1] = acting.y, at_change[2] = acting.z;
    Real* const at_field = (Real*)arrays.targets.field.data + 3 * (size_t)cell.moment;
    Real* const at_acting = (Real*)arrays.targets.acting.data + 3 * (size_t)cell.moment;
    at_field[0] += field.x, at_field[1] += field.y, at_field[2] += field.z;
    at_acting[0] += acting.x, at_acting[1] += acting.y, at_acting[2] += acting.z;
}

// Charges that respond to the potentials at points k and its successors of an outer face.
CUDA_CALLABLE inline Number response_charges(const Cell& cell, const Real* potential, int k) {
    const int face = k / FACE_POINTS, point = k % FACE_POINTS;
    const Real* const column = cell.matrices + face / 2 * (FACE_POINTS * FACE_POINTS) + point;
    Number charge = Number(Real(0));
    for (int l = 0; l < FACE_POINTS; ++l)
        charge -= potential[face * FACE_POINTS + l] * numbers(column + l * FACE_POINTS);
    return cell.response * charge;
}

CUDA_CALLABLE inline Real3 effective_at(const Real* effective, size_t pitch, int i) {
    return {effective[i], effective[pitch + i], effective[2 * pitch + i]};
}
// Adds force/μ0 and torque/μ0 about the center of cell c by a body, less those of its field at the center.
template <class Arrays>
CUDA_CALLABLE inline void add_cell_wrench(const Arrays& arrays, const Cell& cell, int c, const PermanentBody& body,
                                          Real3& force, Real3& torque) {
    const SourceFade fade = cell_fade(cell, body);
    if (fade.weight == 0 || body.label == cell.label) return;
    const size_t pitch = arrays.effective.strides[0] / sizeof(Real);
    const Real3 m = effective_at(arrays.effective.data, pitch, cell.moment);
    const Real* const potential = arrays.cells.potential.data + CELL_POINTS * (size_t)c;
    const Number zero = Number(Real(0));
    Wrench wrench = zero_wrench();
    for (int k = WIDTH * share(); k < CELL_POINTS; k += WIDTH * SHARES) {
        const int face = k / FACE_POINTS;
        const Vector x = cell.points(arrays.cells.point.data, k);
        const PotentialField at_points = outer_field(body, x);
        Number charge = zero + (face % 2 ? 1 : -1) * cell.share_of(face) * dot(m, cell.axes[face / 2]);
        if (cell.is_outer(face)) charge += response_charges(cell, potential, k);
        const Vector f = charge * at_points.h;
        wrench.force += f;
        wrench.torque += cross(x - broadcast(cell.center), f);
        wrench.energy += charge * at_points.phi;
    }
    const TargetField at_center = center_field(cell, body);
    const Real3 h = first_lane(at_center.h), f = first_lane(gradient_dot(at_center, broadcast(m)));
    const Real energy = total_of(wrench.energy) + dot(m, h);
    force += fade.weight * (total_of(wrench.force) - f) - energy * fade.slope;
    torque += fade.weight * (total_of(wrench.torque) - cross(m, h));
}

// Adds force and torque of near bodies on cell c. The torque m × H of its moment contains the averages already.
template <class Arrays> CUDA_CALLABLE inline void act_on_cell(const Arrays& arrays, int c) {
    const Cell cell = cell_at(arrays, c);
    if (!arrays.cells.near.data[c] || !arrays.cells.movable.data[cell.moment]) return;
    const size_t pitch = arrays.effective.strides[0] / sizeof(Real);
    const Real3 m = effective_at(arrays.effective.data, pitch, cell.moment);
    const Real3 change = real3((const Real*)arrays.cells.change.data + 3 * (size_t)c);
    Real3 force = {0, 0, 0}, torque = cross(change, m);
    for (int b = cell.first; b < cell.last; ++b) add_cell_wrench(arrays, cell, c, body_at(arrays, b), force, torque);
    if (share() != 0) return;
    Real* const on = (Real*)arrays.cells.forces.data + 3 * (size_t)cell.moment;
    Real* const about = (Real*)arrays.cells.torques.data + 3 * (size_t)cell.moment;
    on[0] += MU0 * force.x, on[1] += MU0 * force.y, on[2] += MU0 * force.z;
    about[0] += MU0 * torque.x, about[1] += MU0 * torque.y, about[2] += MU0 * torque.z;
}

// Force/μ0 on cells ``first`` to ``last`` − 1 by a body, and their torque/μ0 about its reference point.
template <class Arrays>
CUDA_CALLABLE inline void wrench_on_cells(const Arrays& arrays, const PermanentBody& body, int first, int last,
                                          Real3& force, Real3& torque) {
    const Real3 center = reference_point(arrays, body);
    for (int c = first; c < last; ++c) {
        if (!arrays.cells.near.data[c]) continue;
        const Cell cell = cell_at(arrays, c);
        Real3 f = {0, 0, 0}, t = f;
        add_cell_wrench(arrays, cell, c, body, f, t);
        force += f;
        torque += t + cross(cell.center - center, f);
    }
}
}
