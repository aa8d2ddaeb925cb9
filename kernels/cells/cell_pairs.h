// Corrections of the field and force between near cells of different bodies, H_i += T_ij m_j.
//
// The sums over pairs treat a cell as a ball. Here the cells are boxes, and T_ij is the difference (``box_pair.h``).
// Balls near cells take part, too; their frame is the world.
// Rows are in the frame of box i and columns in that of box j: a box's axes are the axes of its body's grid. They are
// computed again when the relative pose of their bodies has changed.
//
// From Python: OVERLAP_DEMAGNETIZATION, the demagnetizing factor added to a cell inside another body, OVERLAP_BEGIN and
// OVERLAP_END, the shares of its volume from which it gets some and all of it; MARGIN, by how many radii a cell may
// move before candidates are searched again; MU0; and the constants of ``box_pair.h``.
// ``CellPairs`` is the struct of cell_pairs.py.
#pragma once
#include "cells/box_overlap.h"
#include "shared/group.h"
#include "shared/team.h"

namespace warpmag {

constexpr int MATRIX_ROWS = 9, DETAIL_ROWS = 27; // of means; of, at and between differences; as in cell_pairs.py
constexpr int POSE_ROWS = 7;                     // position and quaternion of box j
constexpr Real BALL = Real(4.1887902047863905);  // volume of a ball over r³
constexpr Real POSE_TOLERANCE = Real(3e-5);      // largest change of a pose, in sizes, that counts as rest

constexpr int CLASSES = 16, BINS = CLASSES * CLASSES; // of rows by their numbers of close and of all candidates

enum CellPairPass { LOCATE, CLEAR, SELECT, ARRANGE, ASSIGN, TABULATE, TAKE_BALLS, ADD_FIELD, ADD_FORCE };
// as in cell_pairs.py

// Writes the frame of body i, and raises a flag if cell i has moved so far that candidates are searched again.
template <class Pairs> CUDA_CALLABLE inline void locate(const Pairs& a, int i) {
    if (i < a.grid.shape[0]) put_product(a.rotation.data[i], a.grid.data[i], a.frame.data[i]);
    if (i >= a.group.shape[0] || a.group.data[i] < 0) return;
    const Real* const row = (const Real*)a.packed.data + i;
    const size_t pitch = a.packed.strides[0] / sizeof(Real);
    const Real* const listed = (const Real*)a.found_at.data + 3 * (size_t)i;
    const Real x = row[0] - listed[0], y = row[pitch] - listed[1], z = row[2 * pitch] - listed[2];
    const Real limit = MARGIN / 2 * a.half.data[i + 3 * (size_t)a.half.shape[1]];
    if (!(x * x + y * y + z * z <= limit * limit)) raise_flag(*a.moved.data);
}

CUDA_CALLABLE inline int increment(int* count) {
#if defined(__CUDA_ARCH__)
    return atomicAdd(count, 1);
#else
    return __atomic_fetch_add(count, 1, __ATOMIC_RELAXED);
#endif
}

// Puts the candidates of cell i that may be close before all others, and returns their number.
template <class Pairs> CUDA_CALLABLE inline int part_candidates(const Pairs& a, int i, int count) {
    const Real* const x = (const Real*)a.packed.data;
    const size_t pitch = a.packed.strides[0] / sizeof(Real), cells = a.half.shape[1];
    int* const list = a.candidate.data + (size_t)i * a.candidate.shape[1];
    auto longest_half = [&](int j) {
        const Real* const half = a.half.data + j;
        return larger(half[0], larger(half[cells], half[2 * cells]));
    };
    const Real own_half = longest_half(i);
    int close = 0;
    for (int k = 0; k < count; ++k) {
        const int j = list[k];
        const Real r[3] = {x[j] - x[i], x[j + pitch] - x[i + pitch], x[j + 2 * pitch] - x[i + 2 * pitch]};
        const Real reach = (CLOSE_END + MARGIN) * (own_half + longest_half(j));
        if (!(r[0] * r[0] + r[1] * r[1] + r[2] * r[2] < reach * reach)) continue;
        list[k] = list[close];
        list[close++] = j;
    }
    return close;
}

// Class of a number of candidates: class 0 has the largest numbers.
CUDA_CALLABLE inline int class_of(int number) { return number < CLASSES ? CLASSES - 1 - number : 0; }

// Prepares cell i for a row after a search, if it has candidates. Cells with too many candidates have none.
template <class Pairs> CUDA_CALLABLE inline void select(const Pairs& a, int i) {
    a.bin.data[i] = -1;
    const int count = a.group.data[i] < 0 ? 0 : a.candidate_count.data[i];
    if (count > a.candidate.shape[1]) raise_flag(*a.crowded.data);
    if (count == 0 || count > a.candidate.shape[1]) return;
    const int close = part_candidates(a, i, count);
    a.close_count.data[i] = close;
    if (close > a.close_capacity) raise_flag(*a.crowded.data);
    a.bin.data[i] = CLASSES * class_of((close + 1) / 2) + class_of(count / 16);
    increment(a.bin_end.data + a.bin.data[i]);
}

// Makes the counts of the bins their first rows. Rows of a vector then have similar numbers of candidates.
template <class Pairs> CUDA_CALLABLE inline void arrange(const Pairs& a) {
    int rows = 0;
    for (int k = 0; k < BINS; ++k) {
        const int count = a.bin_end.data[k];
        a.bin_end.data[k] = rows;
        rows += count;
    }
    a.rows.data[0] = rows;
}

// Gives a row to cell i, with poses of no pair, so that all entries are computed.
template <class Pairs> CUDA_CALLABLE inline void assign(const Pairs& a, int i) {
    if (a.bin.data[i] < 0) return;
    const int row = increment(a.bin_end.data + a.bin.data[i]), count = a.candidate_count.data[i];
    a.cell.data[row] = i;
    Real* const poses = a.pose.data;
    for (int slot = 0; slot < count; ++slot) slot_at(poses, a.candidate.shape[1], POSE_ROWS, slot, row)[3 * CHUNK] = 9;
}

// Cells of a vector of rows, or their candidates: index, and 0 where there is none.
struct Cells {
    int at[WIDTH];
};

// True where a cell has a smaller index than its candidate.
CUDA_CALLABLE inline Mask precedes(const Cells& own, const Cells& other) {
    return mask_of(indices(own.at) < indices(other.at));
}

template <class Pairs> struct PairReader {
    const Pairs& a;
    const Real* const packed;
    const size_t pitch;
    const int capacity; // of a list of candidates

    CUDA_CALLABLE explicit PairReader(const Pairs& a)
        : a(a), packed((const Real*)a.packed.data), pitch(a.packed.strides[0] / sizeof(Real)),
          capacity(a.candidate.shape[1]) {}
    CUDA_CALLABLE Number row(int k, const Cells& c) const { return gather(packed + k * pitch, c.at); }
    CUDA_CALLABLE Vector position(const Cells& c) const { return {row(0, c), row(1, c), row(2, c)}; }
    CUDA_CALLABLE Vector moment(const Cells& c) const { return {row(4, c), row(5, c), row(6, c)}; }
    CUDA_CALLABLE Boxes boxes(const Cells& c) const {
        const size_t cells = a.half.strides[0] / sizeof(Real);
        Boxes b;
        b.half = {gather(a.half.data, c.at), gather(a.half.data + cells, c.at), gather(a.half.data + 2 * cells, c.at)};
        int body[WIDTH], is_box[WIDTH], is_linear[WIDTH], none[WIDTH] = {};
        for (int l = 0; l < WIDTH; ++l) {
            body[l] = 4 * a.body.data[c.at[l]];
            is_box[l] = a.body.data[c.at[l]] < a.grid.shape[0];
            is_linear[l] = a.linear.data[a.body.data[c.at[l]]];
        }
        const Real* const frames = (const Real*)a.frame.data;
        for (int k = 0; k < 4; ++k) b.q[k] = gather(frames + k, body);
        b.radius = row(3, c);
        b.ball = mask_of(indices(is_box) == indices(none));
        b.linear = mask_of(indices(none) < indices(is_linear));
        b.volume = b.ball ? BALL * b.radius * b.radius * b.radius : 8 * b.half.x * b.half.y * b.half.z;
        b.size = gather(a.half.data + 3 * cells, c.at);
        return b;
    }
    CUDA_CALLABLE Mask is_inducible(const Cells& c) const {
        int values[WIDTH], none[WIDTH] = {};
        for (int l = 0; l < WIDTH; ++l) values[l] = a.inducible.data[c.at[l]];
        return mask_of(indices(none) < indices(values));
    }
    // Own cells of rows from ``row`` on, and the number of candidates of each, 0 beyond the last row.
    CUDA_CALLABLE Cells own(int row, int* counts) const {
        const int rows = *a.rows.data;
        Cells c;
        for (int l = 0; l < WIDTH; ++l) {
            c.at[l] = row + l < rows ? a.cell.data[row + l] : a.cell.data[row / CHUNK * CHUNK];
            counts[l] = row + l < rows ? a.candidate_count.data[c.at[l]] : 0;
        }
        return c;
    }
    // Candidates of a slot; where there is none, or it takes no part, the own cell.
    CUDA_CALLABLE Cells candidates(const Cells& own, const int* counts, int slot) const {
        Cells c;
        for (int l = 0; l < WIDTH; ++l) {
            const int j = slot < counts[l] ? a.candidate.data[(size_t)own.at[l] * capacity + slot] : own.at[l];
            c.at[l] = a.candidate_count.data[j] > capacity ? own.at[l] : j;
        }
        return c;
    }
};

// Writes numbers where pairs have moved, 0 where they are not near.
CUDA_CALLABLE inline void put_moved(Real* rows, const Number* values, int count, Number factor, Mask moved, Mask near) {
    for (int k = 0; k < count; ++k) {
        Real* const row = rows + k * CHUNK;
        put(row, moved ? (near ? factor * values[k] : factor * Real(0)) : numbers(row));
    }
}
CUDA_CALLABLE inline Vector matrix_times(const Real* rows, Vector v) {
    auto row_times = [&](int k) {
        const Real* const row = rows + 3 * k * CHUNK;
        return numbers(row) * v.x + numbers(row + CHUNK) * v.y + numbers(row + 2 * CHUNK) * v.z;
    };
    return {row_times(0), row_times(1), row_times(2)};
}
// Vectors of cells in an array of vectors.
CUDA_CALLABLE inline Vector vectors_of(const Real* array, const Cells& cells) {
    int place[WIDTH];
    for (int l = 0; l < WIDTH; ++l) place[l] = 3 * cells.at[l];
    return {gather(array, place), gather(array + 1, place), gather(array + 2, place)};
}

// Stores relative poses that have changed; returns where they have.
CUDA_CALLABLE inline Mask store_pose(Real* rows, const RelativePose& pose, Number size) {
    const Number now[POSE_ROWS] = {pose.r.x, pose.r.y, pose.r.z, pose.q[0], pose.q[1], pose.q[2], pose.q[3]};
    Number change = size * Real(0);
    for (int k = 0; k < POSE_ROWS; ++k) {
        const Number difference = now[k] - numbers(rows + k * CHUNK), scaled = k < 3 ? difference / size : difference;
        change = larger(change, larger(scaled, -scaled));
    }
    const Mask moved = change > POSE_TOLERANCE;
    for (int k = 0; k < POSE_ROWS && any(moved); ++k) put(rows + k * CHUNK, moved ? now[k] : numbers(rows + k * CHUNK));
    return moved;
}

// Computes the tensors of the rows from ``row`` on whose pairs have moved.
template <class Pairs> CUDA_CALLABLE inline void tabulate(const Pairs& a, int row) {
    const PairReader<Pairs> reader(a);
    int counts[WIDTH];
    const Cells own = reader.own(row, counts);
    const int slots = largest_count(counts);
    if (slots == 0) return;
    const Boxes box = reader.boxes(own);
    const Vector x = reader.position(own);
    Number overlap = box.size * Real(0);
    for (int slot = share(); slot < slots; slot += SHARES) {
        const Cells other = reader.candidates(own, counts, slot);
        const Boxes other_box = reader.boxes(other);
        const Vector apart = reader.position(other) - x;
        const Mask listed = mask_of(indices(own.at) != indices(other.at));
        const RelativePose pose = relative_pose(apart, box, other_box);
        const Mask induced = listed && reader.is_inducible(other);
        overlap += induced ? overlap_share(box, other_box, pose) : overlap * Real(0);
        const Mask moved = store_pose(slot_at(a.pose.data, reader.capacity, POSE_ROWS, slot, row), pose, box.size);
        if (!any(moved)) continue;
        const BoxPair pair = box_pair(box, other_box, pose, listed, precedes(own, other));
        const Mask near = pair.window.value > Real(0);
        const Number factor = pair.window.value * pair.unit * pair.unit * pair.unit;
        PairMatrices matrices;
        if (any(near)) matrices = pair_matrices(pair);
        put_moved(slot_at(a.matrix.data, reader.capacity, MATRIX_ROWS, slot, row), matrices.means, 9, factor, moved,
                  near);
        if (slot >= a.close_capacity) continue;
        Real* const detail = slot_at(a.detail.data, a.close_capacity, DETAIL_ROWS, slot, row);
        put_moved(detail, matrices.of_differences, 9, factor, moved, near);
        put_moved(detail + 9 * CHUNK, matrices.at_differences, 9, factor, moved, near);
        put_moved(detail + 18 * CHUNK, matrices.differences, 9, factor, moved, near);
    }
    const Number zero = overlap * Real(0),
                 within = (group_sum(overlap) - OVERLAP_BEGIN) / (OVERLAP_END - OVERLAP_BEGIN);
    overlap = smaller(larger(within, zero), zero + 1);
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
    const PairReader<Pairs> reader(a);
    int counts[WIDTH];
    const Cells own = reader.own(row, counts);
    const int slots = largest_count(counts);
    if (slots == 0) return;
    const Rotation<Number> frame = rotation_of<Number>(reader.boxes(own).q);
    const Number zero = frame.rows[0][0] * Real(0);
    const Real *const means = (const Real*)a.means.data, *const differences = (const Real*)a.differences.data;
    int close_counts[WIDTH];
    for (int l = 0; l < WIDTH; ++l) close_counts[l] = counts[l] == 0 ? 0 : a.close_count.data[own.at[l]];
    const int close = largest_count(close_counts) < a.close_capacity ? largest_count(close_counts) : a.close_capacity;
    Vector h = {zero, zero, zero}, g = h;
    for (int slot = share(); slot < slots; slot += SHARES) {
        const Cells other = reader.candidates(own, counts, slot);
        const Vector m = vectors_of(means, other);
        h += matrix_times(slot_at(a.matrix.data, reader.capacity, MATRIX_ROWS, slot, row), m);
        if (slot >= close) continue;
        const Real* const detail = slot_at(a.detail.data, a.close_capacity, DETAIL_ROWS, slot, row);
        const Vector d = vectors_of(differences, other);
        h += matrix_times(detail, d);
        g += matrix_times(detail + 9 * CHUNK, m) + matrix_times(detail + 18 * CHUNK, d);
    }
    const Number overlap_factor = numbers(a.overlap_factor.data + row);
    h = group_sums(h) - overlap_factor * vectors_of(means, own);
    g = group_sums(g);
    for (int l = 0; l < WIDTH; ++l) counts[l] = a.inducible.data[own.at[l]] ? counts[l] : 0;
    add_to_cells((Real*)a.h.data, own, counts, to_world(frame, h), 1);
    add_to_cells((Real*)a.difference_field.data, own, counts, g, 1);
}

// Adds forces [N] and torques [N·m] to the rows' cells.
template <class Pairs> CUDA_CALLABLE inline void add_force(const Pairs& a, int row) {
    const PairReader<Pairs> reader(a);
    int counts[WIDTH];
    const Cells own = reader.own(row, counts);
    const int slots = largest_count(counts);
    if (slots == 0) return;
    const Boxes box = reader.boxes(own);
    const Rotation<Number> frame = rotation_of<Number>(box.q);
    const Vector x = reader.position(own), m = to_body(frame, reader.moment(own));
    const Real* const differences = (const Real*)a.differences.data;
    const Vector difference = vectors_of(differences, own);
    const Number zero = box.size * Real(0);
    Vector force = {zero, zero, zero}, torque = force;
    for (int slot = share(); slot < slots; slot += SHARES) {
        const Cells other = reader.candidates(own, counts, slot);
        const Boxes other_box = reader.boxes(other);
        const RelativePose pose = relative_pose(reader.position(other) - x, box, other_box);
        const Mask listed = mask_of(indices(own.at) != indices(other.at));
        const BoxPair pair = box_pair(box, other_box, pose, listed, precedes(own, other));
        const Mask near = pair.window.value > Real(0);
        if (!any(near)) continue;
        const Number cube = pair.unit * pair.unit * pair.unit;
        const PairMoments moments = {m, cube * to_body(frame, reader.moment(other)), difference,
                                     cube * vectors_of(differences, other)};
        const Wrench wrench = pair_wrench(pair, moments);
        add_where(near, force, pair.unit * wrench.force);
        add_where(near, torque, wrench.torque);
    }
    int moved[WIDTH], turned[WIDTH];
    for (int l = 0; l < WIDTH; ++l) {
        moved[l] = a.movable.data[own.at[l]] ? counts[l] : 0;
        turned[l] = a.rotatable.data[own.at[l]] ? moved[l] : 0;
    }
    add_to_cells((Real*)a.forces.data, own, moved, to_world(frame, group_sums(force)), MU0);
    add_to_cells((Real*)a.torques.data, own, turned, to_world(frame, group_sums(torque)), MU0);
}

// Writes the moment of moment i if it is a ball.
template <class Pairs> CUDA_CALLABLE inline void take_ball(const Pairs& a, int i) {
    if (i >= a.group.shape[0] || a.body.data[i] < a.grid.shape[0]) return;
    const Real* const m = (const Real*)a.packed.data + 4 * (a.packed.strides[0] / sizeof(Real)) + i;
    for (int k = 0; k < 3; ++k) ((Real*)a.means.data)[3 * (size_t)i + k] = m[k * (a.packed.strides[0] / sizeof(Real))];
}

// The passes that arrange rows after a search.
template <class Pairs> CUDA_CALLABLE inline void arrange_rows(const Pairs& a, int pass, int i) {
    if (a.searching.data[0] == 0) return;
    if (pass == CLEAR && i < BINS) a.bin_end.data[i] = 0;
    if (pass == ARRANGE && i == 0) arrange(a);
    if (i >= a.group.shape[0]) return;
    if (pass == SELECT) select(a, i);
    if (pass == ASSIGN) assign(a, i);
}

template <class Pairs> CUDA_CALLABLE inline void make_cell_pair_pass(const Pairs& a, int pass, int i) {
    if (pass >= TABULATE && pass != TAKE_BALLS) {
        if (i >= a.cell.shape[0]) return;
        if (pass == TABULATE) tabulate(a, i);
        else if (pass == ADD_FIELD) add_field(a, i);
        else add_force(a, i);
        return;
    }
    for (int l = 0; l < WIDTH && share() == 0; ++l)
        if (pass == LOCATE) locate(a, i + l);
        else if (pass == TAKE_BALLS) take_ball(a, i + l);
        else arrange_rows(a, pass, i + l);
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
