// Gradients of functions of the field and of the forces between near cells of different bodies.
//
// ``cell_pairs.h`` has the field H_i = T_ij m_j and the derivatives of the bilinear form m_i·T_ij m_j by the pose of
// box i, forces and torques, with moments that turn with their boxes. A function of fields has the cotangents η, and
// its derivatives by poses are those of η_i·T_ij m_j: forces between two sets of moments.
//
// A function of forces and torques with the cotangents a and b is the derivative of the energy along a motion, in which
// cell i moves by a_i and turns by b_i. Second derivatives commute. So its gradients by poses are the derivatives of
// forces and torques along this motion, and those by moments are the derivatives of fields in the frames of the boxes:
// central differences. Turns do not commute, which leaves τ_i × b_i.
//
// From Python: STEP, the motion between a pose and each side, in units of the pair and radians, and the constants of
// ``cell_pairs.h``. ``Real`` is double, because differences in float32 are too coarse. ``Gradients`` is the struct of
// cell_pair_gradients.py.
#pragma once
#include "cells/cell_pairs.h"

namespace warpmag {

enum GradientPass { OF_FIELD, OF_WRENCH }; // as in cell_pair_gradients.py

// Mean moments of cells and half differences of their halves, in the frames of their boxes.
struct CellMoments {
    Vector mean, difference;
};
template <class Moments> CUDA_CALLABLE inline CellMoments moments_of(const Moments& m, const Cells& cells) {
    return {vectors_of((const Real*)m.means.data, cells), vectors_of((const Real*)m.differences.data, cells)};
}

// Sums of a cell over its pairs: derivatives by position and by turns, in the world's frame, and fields in the frame of
// its box.
struct CellSums {
    Vector by_position, by_turn, field, difference_field;
};

// Wrench of a pair in the frame of box i, whose moments are m, as those of box j are e.
CUDA_CALLABLE inline Wrench wrench_between(const BoxPair& p, const CellMoments& m, const CellMoments& e) {
    const Number cube = p.unit * p.unit * p.unit;
    const PairMoments moments = {m.mean, cube * to_world(p.rotation, e.mean), m.difference, cube * e.difference};
    const Wrench wrench = pair_wrench(p, moments, ALL_POINTS);
    return {p.unit * wrench.force, wrench.torque, wrench.work};
}

// Fields of box j at box i: mean, and half the difference of the halves.
CUDA_CALLABLE inline CellMoments field_between(const BoxPair& p, const CellMoments& e) {
    const Number factor = p.window.value * p.unit * p.unit * p.unit;
    const PairMatrices k = pair_matrices(p, ALL_POINTS);
    auto times = [](const Number* rows, Vector v) {
        return Vector{rows[0] * v.x + rows[1] * v.y + rows[2] * v.z, rows[3] * v.x + rows[4] * v.y + rows[5] * v.z,
                      rows[6] * v.x + rows[7] * v.y + rows[8] * v.z};
    };
    return {factor * (times(k.means, e.mean) + times(k.of_differences, e.difference)),
            factor * (times(k.at_differences, e.mean) + times(k.differences, e.difference))};
}

// Boxes turned by the rotation vector v of the world, to second order.
CUDA_CALLABLE inline Boxes turned(Boxes box, Vector v) {
    const Number w = 1 / root(1 + Real(0.25) * dot(v, v)), k = Real(0.5) * w, q[4] = {k * v.x, k * v.y, k * v.z, w};
    const Number old[4] = {box.q[0], box.q[1], box.q[2], box.q[3]};
    put_product(q, old, box.q);
    return box;
}

// A vector of pairs, of which some are ``listed``: boxes, and whether cell i precedes its candidate.
struct CellPair {
    Boxes box, other;
    Mask listed, first, differ; // ``differ``: differences act

    CUDA_CALLABLE BoxPair in_units() const {
        return box_pair(box, other, relative_pose(box, other), listed, first, differ);
    }
    // The pair after a small motion, in which box j moves by ``shift`` relative to box i.
    CUDA_CALLABLE CellPair moved(Vector shift, Vector turn, Vector other_turn) const {
        CellPair pair = {turned(box, turn), turned(other, other_turn), listed, first, differ};
        pair.other.center += shift;
        return pair;
    }
};

// Adds the derivatives of η_i·T_ij m_j + m_i·T_ij η_j by the pose of box i.
CUDA_CALLABLE inline void add_field_gradient(const CellPair& at, const CellMoments& m, const CellMoments& eta,
                                             const CellMoments& other_m, const CellMoments& other_eta, CellSums& sums) {
    const BoxPair pair = at.in_units();
    const Mask near = pair.window.value > Real(0);
    if (!any(near)) return;
    const Rotation<Number> frame = rotation_of<Number>(at.box.q);
    const Wrench a = wrench_between(pair, eta, other_m), b = wrench_between(pair, m, other_eta);
    add_where(near, sums.by_position, to_world(frame, a.force + b.force));
    add_where(near, sums.by_turn, to_world(frame, a.torque + b.torque));
}

// Adds the derivatives of forces, torques and fields along a motion of both boxes.
CUDA_CALLABLE inline void add_wrench_gradient(const CellPair& at, const CellMoments& m, const CellMoments& other_m,
                                              Vector shift, Vector turn, Vector other_turn, CellSums& sums) {
    const Number unit = 2 / (at.box.size + at.other.size), zero = unit * Real(0);
    const Number speed = larger(unit * length(shift), larger(length(turn), length(other_turn)));
    const Number step = STEP / larger(speed, zero + Real(1e-30));
    for (int side = 0; side < 2; ++side) {
        const Number s = side ? -step : step, weight = Real(0.5) / s;
        const CellPair there = at.moved(s * shift, s * turn, s * other_turn);
        const BoxPair pair = there.in_units();
        const Mask near = pair.window.value > Real(0);
        if (!any(near)) continue;
        const Rotation<Number> frame = rotation_of<Number>(there.box.q);
        const Wrench wrench = wrench_between(pair, m, other_m);
        const CellMoments field = field_between(pair, other_m);
        const Vector torque = to_world(frame, wrench.torque);
        add_where(near, sums.by_position, weight * to_world(frame, wrench.force));
        add_where(near, sums.by_turn, weight * torque + Real(0.5) * cross(torque, turn));
        add_where(near, sums.field, weight * field.mean);
        add_where(near, sums.difference_field, weight * field.difference);
    }
}

// Adds the sums of the cells of the rows from ``row`` on to the gradients.
template <class Gradients> CUDA_CALLABLE inline void differentiate_row(const Gradients& g, int pass, int row) {
    const auto& a = g.pairs;
    if (row >= a.cell.shape[0]) return;
    const Rows rows(a, row);
    if (rows.slots == 0) return;
    const Boxes box = rows.boxes(rows.own);
    const Real *const shifts = (const Real*)g.shift.data, *const turns = (const Real*)g.turn.data;
    const CellMoments m = moments_of(g.moments, rows.own), eta = moments_of(g.cotangents, rows.own);
    const Vector shift = vectors_of(shifts, rows.own), turn = vectors_of(turns, rows.own);
    const Number zero = box.size * Real(0);
    const Vector none = {zero, zero, zero};
    CellSums sums = {none, none, none, none};
    for (int slot = share(); slot < rows.slots; slot += SHARES) {
        const Cells other = rows.candidates(slot);
        const CellPair pair = {box, rows.boxes(other), rows.listed(other), precedes(rows.own, other),
                               rows.differ(slot, other)};
        const CellMoments other_m = moments_of(g.moments, other);
        if (pass == OF_FIELD) add_field_gradient(pair, m, eta, other_m, moments_of(g.cotangents, other), sums);
        else
            add_wrench_gradient(pair, m, other_m, vectors_of(shifts, other) - shift, turn, vectors_of(turns, other),
                                sums);
    }
    const Rotation<Number> frame = rotation_of<Number>(box.q);
    add_to_cells((Real*)g.by_positions.data, rows.own, rows.counts, group_sums(sums.by_position), 1);
    add_to_cells((Real*)g.by_turns.data, rows.own, rows.counts, group_sums(sums.by_turn), 1);
    add_to_cells((Real*)g.fields.data, rows.own, rows.counts, to_world(frame, group_sums(sums.field)), 1);
    add_to_cells((Real*)g.difference_fields.data, rows.own, rows.counts, group_sums(sums.difference_field), 1);
}

template <class Word, class Gradients>
CUDA_CALLABLE inline void differentiate_cell_pairs(int thread, int first, int last, int threads, Word* team,
                                                   const Gradients& g) {
#if defined(__CUDA_ARCH__)
    differentiate_row(g, first, thread / GROUP);
#else
    run_passes(team, threads, first, last, g.pairs.cell.shape[0], WIDTH,
               [&](int pass, int row) { differentiate_row(g, pass, row); });
#endif
}
}
