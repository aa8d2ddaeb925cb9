// Corrections of the field and force between near cells of different bodies, H_i += T_ij m_j.
//
// The sums over pairs treat a cell as a ball. Here the cells are boxes, and T_ij is the difference (``box_pair.h``).
// Balls near cells take part, too; their frame is the world.
// The rows of T_ij are in the frame of box i and its columns in that of box j: a box's axes are the axes of its body's
// grid. A tensor is computed again when the relative pose of the two bodies has changed.
//
// From Python: OVERLAP_DEMAGNETIZATION, the demagnetizing factor added to a cell inside another body, OVERLAP_BEGIN and
// OVERLAP_END, the shares of its volume from which it gets some and all of it; OVERLAP_BODIES, the number of bodies
// around a cell beyond which the factor grows; MU0; and the constants of ``cell_rows.h``.
// ``CellPairs`` is the struct of cell_pairs.py.
#pragma once
#include "cells/cell_rows.h"
#include "shared/team.h"

namespace warpmag {

constexpr Real FAR = Real(8);               // component of the quaternion of pairs that are not near
constexpr Real POSE_TOLERANCE = Real(3e-5); // largest change of a pose, in sizes, that counts as rest

enum CellPairPass {
    LOCATE,
    CLEAR,
    SELECT,
    ARRANGE,
    ASSIGN,
    LINK,
    TABULATE,
    COPY_BALLS,
    ADD_FIELD,
    ADD_FORCE,
    ADD_REACTION
};
// as in cell_pairs.py

// Calls visit(slot, points) for the candidates of a row, of which the first ``close`` may be close. On a GPU threads
// share the Gauss points of these.
template <class Visit> CUDA_CALLABLE inline void for_candidates(int slots, int close, Visit visit) {
    int others = 0;
    if (SHARES >= POINTS) {
        others = close;
        for (int k = share(); k < POINTS * close; k += SHARES) visit(k / POINTS, Points{k % POINTS, 1});
    }
    for (int slot = others + share(); slot < slots; slot += SHARES) visit(slot, ALL_POINTS);
}

// Sum over the threads that share the Gauss points of a candidate.
CUDA_CALLABLE inline Number points_sum(Number part, Points points) {
#if defined(__CUDA_ARCH__)
    if (points.count == POINTS) return part;
    const unsigned mask = ((1u << POINTS) - 1) << (threadIdx.x % 32 / POINTS * POINTS);
    for (int step = 1; step < POINTS; step *= 2) part += __shfl_xor_sync(mask, part, step);
#endif
    return part;
}

// Slots of a vector of pairs in the rows of their other cells; ``slot`` is negative where nothing is written.
struct OtherSlots {
    bool written; // anywhere
    int slot[WIDTH], row[WIDTH];

    template <class Pairs>
    CUDA_CALLABLE OtherSlots(const Pairs& a, const Cells& slots, const Cells& others, Mask chosen)
        : written(any(chosen & mask_of(indices(slots.at) >= 0))) {
        for (int l = 0; l < WIDTH && written; ++l) {
            slot[l] = lane_of(chosen, l) ? slots.at[l] : NO_PAIR;
            row[l] = a.row_of.data[others.at[l]];
        }
    }
};

// Matrices of a vector of pairs that have moved: sums over Gauss points times a factor, 0 where pairs are not near.
struct MovedMatrices {
    Points points;
    Number factor;
    Mask moved, near;
    OtherSlots others;

    // Writes a matrix into the rows, and its transpose into the other cells' entries, from row ``first`` of these.
    CUDA_CALLABLE void write(Real* rows, const Number* values, Real* array, int slots, int entry, int first) const {
        Number written[9];
        for (int k = 0; k < 9; ++k) {
            const Number sum = points_sum(values[k], points);
            written[k] = near ? factor * sum : factor * Real(0);
            if (points.first == 0) put_where(moved, rows + k * CHUNK, written[k]);
        }
        for (int l = 0; l < WIDTH && points.first == 0 && others.written; ++l) {
            if (others.slot[l] < 0) continue;
            Real* const other = slot_at(array, slots, entry, others.slot[l], others.row[l]) + first * CHUNK;
            for (int k = 0; k < 9; ++k) other[(k % 3 * 3 + k / 3) * CHUNK] = lane_of(written[k], l);
        }
    }
};
CUDA_CALLABLE inline Vector matrix_times(const Real* rows, Vector v) {
    auto row_times = [&](int k) {
        const Real* const row = rows + 3 * k * CHUNK;
        return numbers(row) * v.x + numbers(row + CHUNK) * v.y + numbers(row + 2 * CHUNK) * v.z;
    };
    return {row_times(0), row_times(1), row_times(2)};
}
// Vectors of cells in an array of vectors, which has one vector more.
CUDA_CALLABLE inline Vector vectors_of(const Real* array, const Cells& cells) {
#if defined(__CUDA_ARCH__)
    const Real* const v = array + 3 * (size_t)*cells.at;
    return {v[0], v[1], v[2]};
#else
    const Four v = load_fours([&](int l) { return array + 3 * (size_t)cells.at[l]; });
    return {v.x, v.y, v.z};
#endif
}

CUDA_CALLABLE inline Vector where(Mask active, Vector v) {
    const Number zero = v.x * Real(0);
    return {active ? v.x : zero, active ? v.y : zero, active ? v.z : zero};
}

// Relative poses of a vector of pairs as numbers, and a mask of the pairs that have moved since the stored pose. In
// ``new_rows`` all have moved. All pairs that are not near have the same pose.
struct PoseRows {
    Number now[POSE_ROWS];
    Mask moved;

    CUDA_CALLABLE PoseRows(const Real* rows, const RelativePose& pose, Number size, Mask near, bool new_rows)
        : now{pose.r.x, pose.r.y, pose.r.z, pose.q[0], pose.q[1], pose.q[2], pose.q[3]} {
        const Number zero = size * Real(0);
        Number change = zero;
        for (int k = 0; k < POSE_ROWS; ++k) {
            now[k] = near ? now[k] : zero + (k == 3 ? FAR : Real(0));
            const Number difference = now[k] - numbers(rows + k * CHUNK),
                         scaled = k < 3 ? difference / size : difference;
            change = larger(change, larger(scaled, -scaled));
        }
        moved = new_rows ? mask_of(size == size) : mask_of(change > POSE_TOLERANCE);
    }
    // True if none of the stored pairs was near: their matrices are 0.
    static CUDA_CALLABLE bool all_far(const Real* rows) { return !any(numbers(rows + 3 * CHUNK) != FAR); }
    CUDA_CALLABLE void store(Real* rows) const {
        for (int k = 0; k < POSE_ROWS; ++k) put(rows + k * CHUNK, moved ? now[k] : numbers(rows + k * CHUNK));
    }
};

// Computes the tensors of a vector of pairs, unless the other cells own them, where they have moved.
template <class Pairs>
CUDA_CALLABLE inline void tabulate_slot(const Rows<Pairs>& rows, int slot, Points points, const Boxes& box,
                                        const Cells& other, const Boxes& other_box, const RelativePose& pose,
                                        Mask near) {
    const Pairs& a = rows.a;
    const Cells found = rows.other_slots(slot);
    const Mask chosen = mask_of(indices(found.at) >= NONE_OWNS), active = near & chosen;
    Real* const stored = slot_at(a.pose.data, rows.capacity, POSE_ROWS, slot, rows.row);
    const bool new_rows = a.searching.data[0] != 0;
    if (!any(chosen) || (!new_rows && !any(active) && PoseRows::all_far(stored))) return;
    const PoseRows change(stored, pose, box.size, active, new_rows);
    if (!any(change.moved)) return;
    const BoxPair pair = rows.pair(box, slot, other, other_box, pose, active);
    const Number factor = pair.window.value * pair.unit * pair.unit * pair.unit;
    PairMatrices matrices;
    if (any(active)) matrices = pair_matrices(pair, points);
    const Mask moved = change.moved & chosen;
    const MovedMatrices result = {points, factor, moved, active, OtherSlots(a, found, other, moved)};
    result.write(slot_at(a.matrix.data, rows.capacity, MATRIX_ROWS, slot, rows.row), matrices.means, a.matrix.data,
                 rows.capacity, MATRIX_ROWS, 0);
    const Mask differ = moved & rows.differ(slot, other);
    if (any(differ)) {
        const MovedMatrices details = {points, factor, differ, active, OtherSlots(a, found, other, differ)};
        Real* const detail = slot_at(a.detail.data, a.close_capacity, DETAIL_ROWS, slot, rows.row);
        auto write = [&](int first, const Number* values, int other_first) {
            details.write(detail + first * CHUNK, values, a.detail.data, a.close_capacity, DETAIL_ROWS, other_first);
        };
        write(0, matrices.of_differences, 9);
        write(9, matrices.at_differences, 0);
        write(18, matrices.differences, 18);
    }
    if (points.first == 0) change.store(stored); // after the other threads have read it
}

// Computes the tensors of the rows from ``row`` on whose pairs have moved, and the overlap of their cells with others.
template <class Pairs> CUDA_CALLABLE inline void tabulate(const Pairs& a, int row) {
    const Rows<Pairs> rows(a, row);
    if (rows.slots == 0) return;
    const Boxes box = rows.boxes(rows.own);
    const Number zero = box.size * Real(0);
    Number overlap = zero;
    int end = 0;
    for_candidates(rows.slots, rows.slots_of(OWN_CLOSE_KINDS), [&](int slot, Points points) {
        const Cells other = rows.candidates(slot);
        const Mask near = rows.near(box, other);
        const Real* const stored = slot_at(a.pose.data, rows.capacity, POSE_ROWS, slot, row);
        if (a.searching.data[0] == 0 && !any(near) && PoseRows::all_far(stored)) return;
        const Boxes other_box = rows.boxes(other);
        const RelativePose pose = relative_pose(box, other_box);
        if (any(near)) end = slot + 1;
        if (any(near) && points.first == 0)
            overlap += near & other_box.inducible ? overlap_share(box, other_box, pose) : zero;
        tabulate_slot(rows, slot, points, box, other, other_box, pose, near);
    });
    const Number shares = group_sum(overlap), within = (shares - OVERLAP_BEGIN) / (OVERLAP_END - OVERLAP_BEGIN);
    const Number of_many = shares * (1 / Real(OVERLAP_BODIES)); // the errors of their tensors add up
    overlap = of_many > 1 ? of_many : smaller(larger(within, zero), zero + 1);
    end = group_most(end);
    if (share() == 0) a.near_end.data[row] = end;
    if (share() == 0) put(a.overlap_factor.data + row, OVERLAP_DEMAGNETIZATION * overlap / box.volume);
}

// Adds vectors times ``scale`` to an array of vectors, for cells with candidates.
CUDA_CALLABLE inline void add_to_cells(Real* array, const Cells& cells, const int* counts, Vector v, Real scale) {
    for (int l = 0; l < WIDTH && share() == 0; ++l) {
        if (counts[l] == 0) continue;
        Real* const own = array + 3 * (size_t)cells.at[l];
        own[0] += scale * lane_of(v.x, l);
        own[1] += scale * lane_of(v.y, l);
        own[2] += scale * lane_of(v.z, l);
    }
}

// Adds the corrections to the field of the rows' cells.
template <class Pairs> CUDA_CALLABLE inline void add_field(const Pairs& a, int row) {
    const Rows<Pairs> rows(a, row);
    if (rows.slots == 0) return;
    const Rotation<Number> frame = rotation_of<Number>(rows.boxes(rows.own).q);
    const Number zero = frame.rows[0][0] * Real(0);
    const Real *const means = (const Real*)a.means.data, *const differences = (const Real*)a.differences.data;
    const int close = rows.detailed_slots();
    Vector h = {zero, zero, zero}, g = h;
    for (int slot = share(); slot < a.near_end.data[row]; slot += SHARES) {
        const Cells other = rows.candidates(slot);
        const Mask listed = rows.listed(other); // elsewhere matrices are those of earlier rows
        const Vector m = where(listed, vectors_of(means, other));
        h += matrix_times(slot_at(a.matrix.data, rows.capacity, MATRIX_ROWS, slot, row), m);
        if (slot >= close) continue;
        const Real* const detail = slot_at(a.detail.data, a.close_capacity, DETAIL_ROWS, slot, row);
        const Vector d = where(listed, vectors_of(differences, other));
        h += matrix_times(detail, d);
        g += matrix_times(detail + 9 * CHUNK, m) + matrix_times(detail + 18 * CHUNK, d);
    }
    const Number overlap_factor = numbers(a.overlap_factor.data + row);
    h = group_sums(h) - overlap_factor * vectors_of(means, rows.own);
    g = group_sums(g);
    int counts[WIDTH];
    for (int l = 0; l < WIDTH; ++l) counts[l] = a.inducible.data[rows.own.at[l]] ? rows.counts[l] : 0;
    add_to_cells((Real*)a.h.data, rows.own, counts, to_world(frame, h), 1);
    add_to_cells((Real*)a.difference_field.data, rows.own, counts, g, 1);
}

// Adds forces and torques, in the frames of the cells' boxes and over μ0, to those [N] and [N·m] of the rows' cells.
template <class Pairs>
CUDA_CALLABLE inline void add_wrenches(const Rows<Pairs>& rows, const Boxes& box, Vector force, Vector torque) {
    const Pairs& a = rows.a;
    int moved[WIDTH], turned[WIDTH];
    for (int l = 0; l < WIDTH; ++l) {
        moved[l] = a.movable.data[rows.own.at[l]] ? rows.counts[l] : 0;
        turned[l] = a.rotatable.data[rows.own.at[l]] ? moved[l] : 0;
    }
    const Rotation<Number> frame = rotation_of<Number>(box.q);
    add_to_cells((Real*)a.forces.data, rows.own, moved, to_world(frame, group_sums(force)), MU0);
    add_to_cells((Real*)a.torques.data, rows.own, turned, to_world(frame, group_sums(torque)), MU0);
}

// Writes sums over Gauss points of the force and torque on the other cells of owned pairs.
template <class Pairs>
CUDA_CALLABLE inline void put_reaction(const OtherSlots& others, const Pairs& a, Vector force, Vector torque,
                                       Points points) {
    const Number values[6] = {force.x, force.y, force.z, torque.x, torque.y, torque.z};
    for (int k = 0; k < 6; ++k) {
        const Number sum = points_sum(values[k], points);
        for (int l = 0; l < WIDTH && points.first == 0; ++l)
            if (others.slot[l] >= 0) reaction_at(a, others.slot[l], others.row[l])[k + k / 3] = lane_of(sum, l);
    }
}

// Adds the forces and torques of pairs to the rows' cells, unless the other cells own them, and writes the reactions.
template <class Pairs> CUDA_CALLABLE inline void add_force(const Pairs& a, int row) {
    const Rows<Pairs> rows(a, row);
    if (rows.slots == 0) return;
    const Boxes box = rows.boxes(rows.own);
    const Real *const means = (const Real*)a.means.data, *const differences = (const Real*)a.differences.data;
    const Vector m = vectors_of(means, rows.own), difference = vectors_of(differences, rows.own);
    const Number zero = box.size * Real(0);
    const Vector none = {zero, zero, zero};
    Vector force = none, torque = none;
    const int near_end = a.near_end.data[row], owned = rows.slots_of(OWNED_KINDS),
              end = near_end > owned ? near_end : owned;
    for_candidates(end, rows.slots_of(OWN_CLOSE_KINDS), [&](int slot, Points points) {
        const Cells found = rows.other_slots(slot);
        const Mask chosen = mask_of(indices(found.at) >= NONE_OWNS);
        if (!any(chosen)) return;
        const Cells other = rows.candidates(slot);
        const Mask active = chosen & rows.near(box, other);
        Vector push = none, turn = none, reaction = none, reaction_torque = none;
        if (any(active)) {
            const Boxes other_box = rows.boxes(other);
            const RelativePose pose = relative_pose(box, other_box);
            const BoxPair pair = rows.pair(box, slot, other, other_box, pose, active);
            const Number cube = pair.unit * pair.unit * pair.unit;
            const PairMoments moments = {m, cube * to_world(pair.rotation, vectors_of(means, other)), difference,
                                         cube * vectors_of(differences, other)};
            const Wrench wrench = pair_wrench(pair, moments, points);
            add_where(active, push, pair.unit * wrench.force);
            add_where(active, turn, wrench.torque);
            force += push;
            torque += turn;
            // the torques of both about the center of i vanish
            reaction = to_body(pair.rotation, -push);
            reaction_torque = to_body(pair.rotation, cross(pose.r, push) - turn);
        }
        const OtherSlots others(a, found, other, chosen);
        if (others.written) put_reaction(others, a, reaction, reaction_torque, points);
    });
    add_wrenches(rows, box, force, torque);
}

// Force or torque of a slot by the rows of the other cells, 0 where these do not own the pair.
template <class Pairs> CUDA_CALLABLE inline Vector reactions(const Rows<Pairs>& rows, int slot, int first) {
    const Pairs& a = rows.a;
    const Mask others = mask_of(indices(rows.other_slots(slot).at) == OTHER_OWNS);
    auto address = [&](int l) { return reaction_at(a, slot, rows.row + l) + first; };
#if defined(__CUDA_ARCH__)
    const Real* const v = address(0);
    return others ? Vector{v[0], v[1], v[2]} : Vector{0, 0, 0};
#else
    const Four v = load_fours(address);
    const Number zero = v.x * Real(0);
    return {others ? v.x : zero, others ? v.y : zero, others ? v.z : zero};
#endif
}

// Adds the reactions of pairs that other cells own.
template <class Pairs> CUDA_CALLABLE inline void add_reaction(const Pairs& a, int row) {
    const Rows<Pairs> rows(a, row);
    if (rows.slots == 0) return;
    const Boxes box = rows.boxes(rows.own);
    const Number zero = box.size * Real(0);
    Vector force = {zero, zero, zero}, torque = force;
    const int end = rows.slots_of(OWNED_KINDS);
    for (int slot = share(); slot < end; slot += SHARES) {
        force += reactions(rows, slot, 0);
        torque += reactions(rows, slot, 4);
    }
    add_wrenches(rows, box, force, torque);
}

// Copies the moment of moment i from the packed moments if it is a ball.
template <class Pairs> CUDA_CALLABLE inline void copy_ball(const Pairs& a, int i) {
    if (i >= a.group.shape[0] || a.body.data[i] < a.grid.shape[0]) return;
    const Real* const m = (const Real*)a.packed.data + 4 * (a.packed.strides[0] / sizeof(Real)) + i;
    for (int k = 0; k < 3; ++k) ((Real*)a.means.data)[3 * (size_t)i + k] = m[k * (a.packed.strides[0] / sizeof(Real))];
}

// The passes that arrange rows after a search.
template <class Pairs> CUDA_CALLABLE inline void arrange_rows(const Pairs& a, int pass, int i) {
    if (a.searching.data[0] == 0) return;
    if (pass == CLEAR && i < BINS && share() == 0) a.bin_end.data[i] = 0;
    if (pass == ARRANGE && i == 0 && share() == 0) arrange(a);
    if (i >= a.group.shape[0]) return;
    if (pass == SELECT) select(a, i);
    if (pass == ASSIGN) assign(a, i);
}

template <class Pairs> CUDA_CALLABLE inline void make_cell_pair_pass(const Pairs& a, int pass, int i) {
    if (pass >= TABULATE && pass != COPY_BALLS) {
        const bool rests = pass == TABULATE && a.searching.data[0] == 0 && a.displaced.data[0] == 0;
        if (i >= a.cell.shape[0] || rests) return;
        if (pass == TABULATE) tabulate(a, i);
        else if (pass == ADD_FIELD) add_field(a, i);
        else if (pass == ADD_FORCE) add_force(a, i);
        else add_reaction(a, i);
        return;
    }
    if (pass == LINK) {
        if (a.searching.data[0] != 0) link(a, i);
        return;
    }
    for (int l = 0; l < WIDTH; ++l)
        if (pass != LOCATE && pass != COPY_BALLS) arrange_rows(a, pass, i + l);
        else if (share() != 0) return;
        else if (pass == LOCATE) locate(a, i + l);
        else copy_ball(a, i + l);
}

template <class Word, class Pairs>
CUDA_CALLABLE inline void add_cell_pairs(int thread, int first, int last, int threads, Word* team, const Pairs& a) {
#if defined(__CUDA_ARCH__)
    make_cell_pair_pass(a, first, thread / GROUP);
#else
    const int most = a.group.shape[0] > BINS ? a.group.shape[0] : BINS, items = CHUNK * ((most + CHUNK - 1) / CHUNK);
    run_passes(team, threads, first, last, items, WIDTH, [&](int pass, int i) { make_cell_pair_pass(a, pass, i); });
#endif
}
}
