// Permanent bodies near cells of inducible bodies: averages of their field, and charges on the cells' outer faces.
//
// The field at a cell's center does not represent a cell near the edge of a magnet, where the field varies over less
// than a cell. There the average of the field over the cell is taken, H̄ = −Σ n φ̄ A/V over its faces, with the
// mean potential φ̄ of points of a face. A face on the surface of the iron body in front of a magnet has charges that
// vary over less than a cell, too. They are q = −R φ at FACE_POINTS points. Here φ is the potential of the magnet minus
// that of its average field. The energy of the charges is −½ μ0 φᵀ R φ. Python computes R
// (``warpmag.shapes.face_charges``); it leaves out uniform charges.
//
// Averages and charges fade with the distance of a cell from the magnet, in longest sides of the cell. Forces are minus
// the derivatives of the energy at constant permeability of the cell. Takes CELL_REACH_LOW, CELL_REACH_HIGH,
// STEEP_REACH_LOW and STEEP_REACH_HIGH from Python. ``Arrays`` is the struct of sources.py.
#pragma once
#include "applied/cylinder.h"
#include "applied/target_field.h"
#include "shared/layer.h"

namespace warpmag {

constexpr int FACE_POINTS = 16, MOST_OUTER = 6 * FACE_POINTS, COARSE_POINTS = 7, COARSE_LENGTH = 16,
              GAUSS_POINTS = 4; // of other faces and of planes through the center; all as in near_cells.py
enum Nearness {
    FAR_CELL,
    STEEP_CELL,
    NEAR_CELL
}; // fields: at the center, with differences, averaged; as in near_cells.py

// Points of a cell whose half sides are 1, and charges at them, shape [9, length] (near_cells.py). The first ``count``
// are not padding, and the first ``outer`` are on outer faces.
struct CellPoints {
    const Real* data;
    int length, count, outer;
    CUDA_CALLABLE const Real* row(int row, int k) const { return data + row * length + k; }
};
template <class Arrays> CUDA_CALLABLE inline CellPoints coarse_points(const Arrays& arrays) {
    return {arrays.cells.point.data, COARSE_LENGTH, COARSE_POINTS, 0};
}

// A cell in the world. The axes are those of its grid; ``outer`` has a bit for each face on the surface of the body.
struct Cell {
    Real3 center, axes[3];
    Real half[3], size, radius, label, response;
    int moment, first, last, outer; // ``first`` and ``last``: range of permanent bodies
    const Real* matrices;           // R of a face across each axis, for an ideally permeable body
    CellPoints fine;

    // Points k and its successors.
    CUDA_CALLABLE Vector points(const CellPoints& all, int k) const {
        Vector x = broadcast(center);
        for (int a = 0; a < 3; ++a) x += (half[a] * numbers(all.row(a, k))) * broadcast(axes[a]);
        return x;
    }
    CUDA_CALLABLE Vector local_points(int k) const {
        return {half[0] * numbers(fine.row(0, k)), half[1] * numbers(fine.row(1, k)),
                half[2] * numbers(fine.row(2, k))};
    }
    // Charges at these points by moments along the axes: of rows 3 to 5 for means, 6 to 8 for differences.
    CUDA_CALLABLE Number charges(const CellPoints& all, int row, int k, Real3 m) const {
        return m.x / (2 * half[0]) * numbers(all.row(row, k)) + m.y / (2 * half[1]) * numbers(all.row(row + 1, k))
               + m.z / (2 * half[2]) * numbers(all.row(row + 2, k));
    }
    // Adds −Σ φ times the charges by unit moments along the axes to ``sums``.
    CUDA_CALLABLE void add_mean_field(const CellPoints& all, int row, int k, Number phi, Vector& sums) const {
        sums.x -= 1 / (2 * half[0]) * numbers(all.row(row, k)) * phi;
        sums.y -= 1 / (2 * half[1]) * numbers(all.row(row + 1, k)) * phi;
        sums.z -= 1 / (2 * half[2]) * numbers(all.row(row + 2, k)) * phi;
    }
    CUDA_CALLABLE Real3 to_world(Real3 v) const { return v.x * axes[0] + v.y * axes[1] + v.z * axes[2]; }
    // Axis across the ``number``-th outer face.
    CUDA_CALLABLE int outer_axis(int number) const {
        int face = 0;
        for (int faces = outer; number > 0 || !(faces & 1); faces >>= 1, ++face) number -= faces & 1;
        return face / 2;
    }
};
template <class Arrays> CUDA_CALLABLE inline Cell cell_at(const Arrays& arrays, int c) {
    const auto& row = arrays.cells.cell.data[c]; // moment, body of its rotation, range of permanent bodies
    const int own = arrays.cells.row.data[c];
    const auto& form = arrays.cells.form.data[own]; // bits of outer faces, index of its matrices, first point, points
    const Real* const half = arrays.cells.half.data + 3 * (size_t)own;
    const Real* const q = (const Real*)arrays.cells.rotation.data + 4 * (size_t)row[1];
    const Real* const grid = arrays.cells.grid.data + 9 * (size_t)row[1]; // axes of the grid in the body's frame
    const Real pose[7] = {0, 0, 0, q[0], q[1], q[2], q[3]};
    const Frame body = frame_of(pose);
    Cell cell = {packed_real3(arrays, 0, row[0]),
                 {},
                 {half[0], half[1], half[2]},
                 0,
                 packed_at(arrays, 3, row[0]),
                 packed_at(arrays, 7, row[0]),
                 arrays.cells.factor.data[c],
                 row[0],
                 row[2],
                 row[3],
                 form[0],
                 arrays.cells.response.data + (size_t)form[1] * (3 * FACE_POINTS * FACE_POINTS),
                 {arrays.cells.point.data + form[2], form[3], 9 * GAUSS_POINTS, 0}};
    for (int face = 0; face < 6; ++face) {
        cell.fine.outer += form[0] >> face & 1 ? FACE_POINTS : 0;
        cell.fine.count += form[0] >> face & 1 ? FACE_POINTS - GAUSS_POINTS : 0;
    }
    for (int a = 0; a < 3; ++a) {
        cell.axes[a] = grid[3 * a] * body.x + grid[3 * a + 1] * body.y + grid[3 * a + 2] * body.z;
        cell.size = cell.half[a] > Real(0.5) * cell.size ? 2 * cell.half[a] : cell.size;
    }
    return cell;
}
// Weights of the averages of a body's field, and of its differences at coarse points. Their sum fades later.
struct CellFades {
    SourceFade fine, coarse;
};
CUDA_CALLABLE inline CellFades cell_fades(const Cell& cell, const PermanentBody& body) {
    auto fade = [&](Real low, Real high) {
        return fade_of(cell.center, cell.size, low, high, body.frame, body.box_center, body.box_half);
    };
    const SourceFade fine = fade(CELL_REACH_LOW, CELL_REACH_HIGH), all = fade(STEEP_REACH_LOW, STEEP_REACH_HIGH);
    return {fine, {all.weight - fine.weight, all.slope - fine.slope, all.offset}};
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
// Table of a body's cylinder; null for other shapes.
template <class Arrays> CUDA_CALLABLE inline const Real* cylinder_of(const Arrays& arrays, const PermanentBody& body) {
    const int first = arrays.cells.cylinder.data[body.shape];
    return first < 0 ? nullptr : arrays.cells.cylinders.data + first;
}
// Potential and field of a body, from the table of its cylinder unless null. Where contacts let an iron face sink into
// a magnet they are those of the outside, as if the magnet's face were in front of the points: the pull does not turn
// into a push.
CUDA_CALLABLE inline PotentialField outer_field(const PermanentBody& body, const Real* cylinder, Vector x) {
    if (cylinder != nullptr) {
        const PotentialField f = potential_field_of(cylinder_at(cylinder), body.m, body.frame.point_to_body(x));
        return {f.phi, body.frame.to_world(f.h)};
    }
    const NearPoints points = near_points(body, x);
    const PotentialField f = potential_field_of(body.solid, body.m, points.at);
    return {f.phi - points.charge * points.height, body.frame.to_world(f.h + points.charge * points.normal)};
}
// Factors of differences across layers of cell c.
template <class Arrays> CUDA_CALLABLE inline Real3 layer_of(const Arrays& arrays, int c) {
    return real3(arrays.cells.layer.data + 3 * (size_t)arrays.cells.row.data[c]);
}
template <class Vectors> CUDA_CALLABLE inline void put_real3(const Vectors& to, int i, Real3 v) {
    Real* const at = (Real*)to.data + 3 * (size_t)i;
    at[0] = v.x, at[1] = v.y, at[2] = v.z;
}
template <class Vectors> CUDA_CALLABLE inline void add_real3(const Vectors& to, int i, Real3 v) {
    put_real3(to, i, real3((const Real*)to.data + 3 * (size_t)i) + v);
}
CUDA_CALLABLE inline Real3 first_lane(Vector v) { return {lane_of(v.x, 0), lane_of(v.y, 0), lane_of(v.z, 0)}; }
// Field of body b at the center of a cell, in all lanes. If the body is the only source, the pass over targets has
// written this field within the body's reach. Rounding decides whether a target at the end of the reach is within it.
template <class Arrays>
CUDA_CALLABLE inline TargetField center_field(const Arrays& arrays, const Cell& cell, int b,
                                              const PermanentBody& body) {
    const Vector at = body.frame.point_to_body(broadcast(cell.center));
    const Real distance2 = lane_of(box_distance2(body, at), 0), reach2 = body.far_reach * body.far_reach;
    if (arrays.only.data[arrays.coils.kind.shape[0] + b] && distance2 < Real(0.999) * reach2) {
        auto read = [&](const auto& array) {
            return broadcast(real3((const Real*)array.data + 3 * (size_t)cell.moment));
        };
        return {read(arrays.targets.body_field), read(arrays.targets.body_field_x), read(arrays.targets.body_field_y),
                read(arrays.targets.body_field_z)};
    }
    const Number zero = Number(Real(0)), radius = zero + cell.radius;
    return group_sums(
        target_field(body.frame.to_world(closed_form(body, at, Real(0.25) * radius * radius, share(), SHARES))));
}

// Half the difference of a body's field between the halves of a cell along its axes, of the components along them.
CUDA_CALLABLE inline Real3 coarse_differences(const Cell& cell, const CellPoints& coarse, const PermanentBody& body,
                                              const Real* cylinder) {
    Vector sums = zero_target_field().h;
    for (int k = WIDTH * share(); k < coarse.count; k += WIDTH * SHARES)
        cell.add_mean_field(coarse, 6, k, outer_field(body, cylinder, cell.points(coarse, k)).phi, sums);
    return total_of(sums);
}
#if defined(__CUDA_ARCH__)
// The ``n``-th cell near a body, −1 beyond the last. The list starts with two counts: of cells with averages, and of
// cells with differences alone. Cells with averages follow. The others are stored from the end of the list backward.
// So the threads of a warp do the same work.
template <class List> CUDA_CALLABLE inline int listed_cell(const List& listed, int n) {
    const int averaged = listed.data[0], others = listed.data[1];
    if (n < averaged) return listed.data[2 + n];
    return n < averaged + others ? listed.data[listed.shape[0] - 1 - (n - averaged)] : -1;
}
// The compiler makes one atomic addition for a warp only where all its threads add to one number.
template <class List> CUDA_CALLABLE inline void list_cell(const List& listed, int c, bool averaged) {
    if (averaged) listed.data[2 + atomicAdd(listed.data, 1)] = c;
    else listed.data[listed.shape[0] - 1 - atomicAdd(listed.data + 1, 1)] = c;
}
#endif
// Marks cell c as a far one unless a body is near it, and lists near cells on a GPU. A single thread does this for a
// cell, not a group of threads, because most cells are far.
template <class Arrays> CUDA_CALLABLE inline void find_near_bodies(const Arrays& arrays, int c) {
    const Cell cell = cell_at(arrays, c);
    Real fine = 0, all = 0;
    for (int b = cell.first; b < cell.last; ++b) {
        const CellFades fade = cell_fades(cell, body_at(arrays, b));
        fine += fade.fine.weight;
        all += fade.fine.weight + fade.coarse.weight;
    }
    arrays.cells.near.data[c] = all > 0 ? STEEP_CELL : FAR_CELL;
#if defined(__CUDA_ARCH__)
    if (all > 0) list_cell(arrays.cells.listed, c, fine > 0);
#endif
    if (all > 0) return;
    put_real3(arrays.cells.change, c, {0, 0, 0});
    put_real3(arrays.cells.steepness, c, {0, 0, 0});
}
// Replaces the fields of near bodies at the center of cell c by their averages, and writes the differences of the field
// between its halves, and the potentials at the points of its faces, without those of the average field: the
// magnetization responds to it.
template <class Arrays> CUDA_CALLABLE inline void average_over_cell(const Arrays& arrays, int c) {
    if (!arrays.cells.near.data[c]) return;
    const Cell cell = cell_at(arrays, c);
    const CellPoints& fine = cell.fine;
    Real* const potential = arrays.cells.potential.data + MOST_OUTER * (size_t)c;
    Real3 field = {0, 0, 0}, acting = field, acting_mean = field, steepness = field;
    int nearness = FAR_CELL;
    for (int b = cell.first; b < cell.last; ++b) {
        const PermanentBody body = body_at(arrays, b);
        const CellFades fade = cell_fades(cell, body);
        const bool acts = body.label != cell.label;
        const Real* const cylinder = cylinder_of(arrays, body);
        if (fade.coarse.weight > 0) {
            steepness += fade.coarse.weight * coarse_differences(cell, coarse_points(arrays), body, cylinder);
            if (acts && nearness == FAR_CELL) nearness = STEEP_CELL;
        }
        if (fade.fine.weight == 0) continue;
        Vector means = zero_target_field().h, differences = means; // along the axes of the grid
        for (int k = WIDTH * share(); k < fine.count; k += WIDTH * SHARES) {
            const Number phi = outer_field(body, cylinder, cell.points(fine, k)).phi;
            cell.add_mean_field(fine, 3, k, phi, means);
            cell.add_mean_field(fine, 6, k, phi, differences);
            if (acts && k < fine.outer)
                put(potential + k, (nearness == NEAR_CELL ? numbers(potential + k) : 0 * phi) + fade.fine.weight * phi);
        }
        const Real3 average = cell.to_world(total_of(means));
        const Real3 change = fade.fine.weight * (average - first_lane(center_field(arrays, cell, b, body).h));
        field += change;
        steepness += fade.fine.weight * total_of(differences);
        if (acts) acting += change, acting_mean += fade.fine.weight * average, nearness = NEAR_CELL;
    }
    if (nearness == NEAR_CELL) {
        const Vector along =
            broadcast({dot(acting_mean, cell.axes[0]), dot(acting_mean, cell.axes[1]), dot(acting_mean, cell.axes[2])});
        for (int k = WIDTH * share(); k < fine.outer; k += WIDTH * SHARES)
            put(potential + k, numbers(potential + k) + dot(along, cell.local_points(k)));
    }
    if (share() != 0) return;
    arrays.cells.near.data[c] = nearness;
    put_real3(arrays.cells.change, c, acting);
    put_real3(arrays.cells.steepness, c, layer_fields(layer_of(arrays, c), steepness));
    add_real3(arrays.targets.field, cell.moment, field);
    add_real3(arrays.targets.acting, cell.moment, acting);
}

// Neighbor of cell c on a side (−x, +x, −y, ...), relative to c, and its weights (``warpmag.shapes.linear_cells``).
struct CellNeighbor {
    int step;
    Real own, other;
};
template <class Arrays> CUDA_CALLABLE inline CellNeighbor cell_neighbor(const Arrays& arrays, int c, int side) {
    const size_t row = arrays.cells.row.data[c];
    const Real* const weights = arrays.cells.weight.data + 12 * row;
    return {arrays.cells.neighbor.data[6 * row + side], weights[side], weights[6 + side]};
}
// Adds the field by which differences between halves magnetize cell c: the derivative of their energy.
template <class Arrays> CUDA_CALLABLE inline void add_differences(const Arrays& arrays, int c) {
    const Cell cell = cell_at(arrays, c);
    const Real* const steepness = (const Real*)arrays.cells.steepness.data + 3 * (size_t)c;
    Real h[3];
    for (int k = 0; k < 3; ++k) {
        h[k] = 0;
        for (int side = 2 * k; side < 2 * k + 2; ++side) {
            const CellNeighbor at = cell_neighbor(arrays, c, side);
            Real sum = at.own * steepness[k];
            if (at.step != 0) sum += cell_neighbor(arrays, c + at.step, side ^ 1).other * steepness[3 * at.step + k];
            h[k] += (side % 2 ? Real(-0.25) : Real(0.25)) * sum;
        }
    }
    if (share() == 0) add_real3(arrays.targets.field, cell.moment, cell.to_world({h[0], h[1], h[2]}));
}

// Charges that respond to the potentials at points k and its successors of an outer face.
CUDA_CALLABLE inline Number response_charges(const Cell& cell, const Real* potential, int k) {
    const int face = k / FACE_POINTS, point = k % FACE_POINTS;
    const Real* const column = cell.matrices + cell.outer_axis(face) * (FACE_POINTS * FACE_POINTS) + point;
    Number charge = Number(Real(0));
    for (int l = 0; l < FACE_POINTS; ++l)
        charge -= potential[face * FACE_POINTS + l] * numbers(column + l * FACE_POINTS);
    return cell.response * charge;
}

// Moment of these charges, along the axes of the grid.
CUDA_CALLABLE inline Real3 response_moment(const Cell& cell, const Real* potential) {
    Vector sums = zero_target_field().h;
    for (int k = WIDTH * share(); k < cell.fine.outer; k += WIDTH * SHARES)
        sums += response_charges(cell, potential, k) * cell.local_points(k);
    return total_of(sums);
}

CUDA_CALLABLE inline Real3 effective_at(const Real* effective, size_t pitch, int i) {
    return {effective[i], effective[pitch + i], effective[2 * pitch + i]};
}
// Half the differences of the moments of the halves of cell c, along the axes of the grid.
template <class Arrays>
CUDA_CALLABLE inline Real3 moment_differences(const Arrays& arrays, const Cell& cell, int c, Real3 m) {
    const size_t pitch = arrays.effective.strides[0] / sizeof(Real);
    Real d[3];
    for (int k = 0; k < 3; ++k) {
        d[k] = 0;
        for (int side = 2 * k; side < 2 * k + 2; ++side) {
            const CellNeighbor at = cell_neighbor(arrays, c, side);
            const Real3 other = effective_at(arrays.effective.data, pitch, cell.moment + at.step);
            const Real change = at.other * dot(other, cell.axes[k]) - at.own * dot(m, cell.axes[k]);
            d[k] += (side % 2 ? Real(0.25) : Real(-0.25)) * change;
        }
    }
    return layer_differences(layer_of(arrays, c), Real3{d[0], d[1], d[2]});
}
// Wrench/μ0 of a body on the charges of a cell by its moment, differences and response, at fine or coarse points.
CUDA_CALLABLE inline Wrench wrench_on_charges(const Cell& cell, const PermanentBody& body, const Real* cylinder,
                                              const CellPoints& all, Real3 m, Real3 difference, const Real* potential) {
    Wrench wrench = zero_wrench();
    for (int k = WIDTH * share(); k < all.count; k += WIDTH * SHARES) {
        const Vector x = cell.points(all, k);
        const PotentialField at_points = outer_field(body, cylinder, x);
        Number charge = cell.charges(all, 3, k, m) + cell.charges(all, 6, k, difference);
        if (k < all.outer) charge += response_charges(cell, potential, k);
        const Vector f = charge * at_points.h;
        wrench.force += f;
        wrench.torque += cross(x - broadcast(cell.center), f);
        wrench.energy += charge * at_points.phi;
    }
    return wrench;
}
// Adds force/μ0 and torque/μ0 about the center of cell c by a body, less those of its field at the center.
template <class Arrays>
CUDA_CALLABLE inline void add_cell_wrench(const Arrays& arrays, const Cell& cell, int c, int b, Real3& force,
                                          Real3& torque) {
    const PermanentBody body = body_at(arrays, b);
    const CellFades fade = cell_fades(cell, body);
    if ((fade.fine.weight == 0 && fade.coarse.weight == 0) || body.label == cell.label) return;
    const Real* const cylinder = cylinder_of(arrays, body);
    const Real3 m = effective_at(arrays.effective.data, arrays.effective.strides[0] / sizeof(Real), cell.moment);
    const Real3 difference = moment_differences(arrays, cell, c, m);
    auto add = [&](const SourceFade& by, Real3 f, Real3 t, Real energy) {
        force += by.weight * f - energy * by.slope;
        torque += by.weight * t;
    };
    if (fade.coarse.weight > 0) {
        const Wrench w = wrench_on_charges(cell, body, cylinder, coarse_points(arrays), {0, 0, 0}, difference, nullptr);
        add(fade.coarse, total_of(w.force), total_of(w.torque), total_of(w.energy));
    }
    if (fade.fine.weight == 0) return;
    const Real3 along = {dot(m, cell.axes[0]), dot(m, cell.axes[1]), dot(m, cell.axes[2])};
    const Real* const potential = arrays.cells.potential.data + MOST_OUTER * (size_t)c;
    const Real3 responding = along - response_moment(cell, potential); // potentials lack the average field
    const Wrench w = wrench_on_charges(cell, body, cylinder, cell.fine, responding, difference, potential);
    const TargetField at_center = center_field(arrays, cell, b, body);
    const Real3 h = first_lane(at_center.h), f = first_lane(gradient_dot(at_center, broadcast(m)));
    add(fade.fine, total_of(w.force) - f, total_of(w.torque) - cross(m, h), total_of(w.energy) + dot(m, h));
}

// Adds force and torque of near bodies on cell c. The torque m × H of its moment contains the averages already.
// Writes those of a body that is the only source, for its reaction.
template <class Arrays> CUDA_CALLABLE inline void act_on_cell(const Arrays& arrays, int c) {
    if (!arrays.cells.near.data[c]) return;
    const Cell cell = cell_at(arrays, c);
    const bool movable = arrays.cells.movable.data[cell.moment];
    const bool only = arrays.only.data[arrays.coils.kind.shape[0] + cell.first];
    if (!(movable || only)) return;
    const size_t pitch = arrays.effective.strides[0] / sizeof(Real);
    const Real3 m = effective_at(arrays.effective.data, pitch, cell.moment);
    const Real3 change = real3((const Real*)arrays.cells.change.data + 3 * (size_t)c);
    Real3 force = {0, 0, 0}, torque = cross(change, m);
    for (int b = cell.first; b < cell.last; ++b) add_cell_wrench(arrays, cell, c, b, force, torque);
    if (share() != 0) return;
    if (only) {
        Real* const wrench = arrays.cells.wrench.data + 6 * (size_t)c;
        for (int k = 0; k < 6; ++k) wrench[k] = 0;
        add_force_torque(wrench, force, torque, 1);
    }
    if (!movable) return;
    add_real3(arrays.cells.forces, cell.moment, MU0 * force);
    add_real3(arrays.cells.torques, cell.moment, MU0 * torque);
}

// Force/μ0 on cells ``first`` to ``last`` − 1 by body b, and their torque/μ0 about its reference point. If the body is
// the only source, :func:`act_on_cell` has written them.
template <class Arrays>
CUDA_CALLABLE inline void wrench_on_cells(const Arrays& arrays, int b, bool only, int first, int last, Real3& force,
                                          Real3& torque) {
    const Real3 center = reference_point(arrays, body_at(arrays, b));
    // threads share what has been written, or each cell
    for (int c = first + (only ? share() : 0); c < last; c += only ? SHARES : 1) {
        if (!arrays.cells.near.data[c]) continue;
        Real3 f = {0, 0, 0}, t = f;
        if (only) {
            const Real* const wrench = arrays.cells.wrench.data + 6 * (size_t)c;
            f = real3(wrench), t = real3(wrench + 3);
        } else {
            add_cell_wrench(arrays, cell_at(arrays, c), c, b, f, t);
        }
        force += f;
        torque += t + cross(packed_real3(arrays, 0, arrays.cells.cell.data[c][0]) - center, f);
    }
#if defined(__CUDA_ARCH__)
    if (only) force = total_of(broadcast(force)), torque = total_of(broadcast(torque));
#endif
}
}
