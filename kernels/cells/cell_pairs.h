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
constexpr Real FAR = Real(8);                    // component of the quaternion of pairs that are not near
constexpr Real POSE_TOLERANCE = Real(3e-5);      // largest change of a pose, in sizes, that counts as rest

constexpr int CLASSES = 16, BINS = CLASSES * CLASSES; // of rows by their numbers of close and of all candidates

enum CellPairPass { LOCATE, CLEAR, SELECT, ARRANGE, ASSIGN, TABULATE, TAKE_BALLS, ADD_FIELD, ADD_FORCE };
// as in cell_pairs.py

// Writes the box of moment i, and raises a flag if it has moved so far that candidates are searched again.
template <class Pairs> CUDA_CALLABLE inline void locate(const Pairs& a, int i) {
    if (i >= a.group.shape[0] || a.group.data[i] < 0) return;
    const Real *const row = (const Real*)a.packed.data + i, *const half = a.half.data + i;
    const size_t pitch = a.packed.strides[0] / sizeof(Real), cells = a.half.shape[1];
    const int body = a.body.data[i];
    const bool is_ball = body >= a.grid.shape[0];
    Real* const line = a.box.data + LINE * (size_t)i;
    Real* const turn = line + 8;
    for (int k = 0; k < 4; ++k) line[k] = row[k * pitch], line[4 + k] = half[k * cells], turn[k] = k == 3;
    if (!is_ball) put_product(a.rotation.data[body], a.grid.data[body], turn);
    line[12] = is_ball ? BALL * line[3] * line[3] * line[3] : 8 * line[4] * line[5] * line[6];
    line[13] = is_ball, line[14] = a.linear.data[body] + 2 * a.flat.data[body], line[15] = a.inducible.data[i];
    const Real* const listed = (const Real*)a.found_at.data + 3 * (size_t)i;
    const Real x = line[0] - listed[0], y = line[1] - listed[1], z = line[2] - listed[2];
    const Real limit = MARGIN / 2 * line[7];
    if (!(x * x + y * y + z * z <= limit * limit)) raise_flag(*a.moved.data);
}

CUDA_CALLABLE inline int increment(int* count) {
#if defined(__CUDA_ARCH__)
    return atomicAdd(count, 1);
#else
    return __atomic_fetch_add(count, 1, __ATOMIC_RELAXED);
#endif
}

// Kinds of candidates, in the order of a row, so that vectors of rows have few different ones in a slot. Differences
// act between the first three, the others are too far for their longest sides. The first ones have fine points.
enum CandidateKind { FINE_NOW, CLOSE_NOW, MAY_BE_CLOSE, CLOSE_AND_FLAT, NEAR_NOW, MAY_BE_NEAR, KINDS };

template <class Pairs> CUDA_CALLABLE inline int kind_of(const Pairs& a, int i, int j) {
    const Real *const own = a.box.data + LINE * (size_t)i, *const other = a.box.data + LINE * (size_t)j;
    auto longest_half = [](const Real* line) { return larger(line[4], larger(line[5], line[6])); };
    const Real r[3] = {other[0] - own[0], other[1] - own[1], other[2] - own[2]};
    const Real d2 = r[0] * r[0] + r[1] * r[1] + r[2] * r[2];
    const Real size = (own[7] + other[7]) / 2, d = (CLOSE_END + MARGIN) * (longest_half(own) + longest_half(other));
    const bool close = d2 < CLOSE_END * size * CLOSE_END * size;
    const bool flat = own[14] >= 2 || other[14] >= 2, fine = flat && d2 < FINE_END * size * FINE_END * size;
    if (d2 < d * d) return fine ? FINE_NOW : close ? CLOSE_NOW : MAY_BE_CLOSE;
    return close ? CLOSE_AND_FLAT : d2 < WINDOW_END * size * WINDOW_END * size ? NEAR_NOW : MAY_BE_NEAR;
}

// Class of a number of candidates: class 0 has the largest numbers.
CUDA_CALLABLE inline int class_of(int number) { return number < CLASSES ? CLASSES - 1 - number : 0; }

// Prepares cell i for a row after a search, if it has candidates. Cells with too many candidates have none.
template <class Pairs> CUDA_CALLABLE inline void select(const Pairs& a, int i) {
    const int count = a.group.data[i] < 0 ? 0 : a.candidate_count.data[i];
    if (share() == 0) a.bin.data[i] = -1;
    if (count > a.candidate.shape[1]) raise_flag(*a.crowded.data);
    if (count == 0 || count > a.candidate.shape[1]) return;
    int kinds[KINDS] = {};
    for (int k = share(); k < count; k += SHARES) {
        const int kind = kind_of(a, i, a.candidate.data[(size_t)i * a.candidate.shape[1] + k]);
        for (int n = 0; n < KINDS; ++n) kinds[n] += n == kind;
    }
    for (int n = 0; n < KINDS; ++n) kinds[n] = group_count(kinds[n]);
    if (share() != 0) return;
    for (int n = 0; n < KINDS; ++n) a.kinds.data[KINDS * (size_t)i + n] = kinds[n];
    const int now = kinds[FINE_NOW] + kinds[CLOSE_NOW], close = now + kinds[MAY_BE_CLOSE];
    if (close > a.close_capacity && a.close_capacity > 0) raise_flag(*a.crowded.data);
    a.bin.data[i] = CLASSES * class_of((now + 1) / 2) + class_of(count / 16);
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

// Gives a row to cell i, with poses of no pair, so that all entries are computed. Crowded candidates take no part: the
// cell itself replaces them.
template <class Pairs> CUDA_CALLABLE inline void assign(const Pairs& a, int i) {
    if (a.bin.data[i] < 0) return;
    const int count = a.candidate_count.data[i], capacity = a.candidate.shape[1];
    const int row = of_first_share(share() == 0 ? increment(a.bin_end.data + a.bin.data[i]) : 0);
    if (share() == 0) a.cell.data[row] = i;
    int next[KINDS] = {};
    for (int n = 1; n < KINDS; ++n) next[n] = next[n - 1] + a.kinds.data[KINDS * (size_t)i + n - 1];
    for (int first = 0; first < count; first += SHARES) {
        const int k = first + share(), j = k < count ? a.candidate.data[(size_t)i * capacity + k] : i;
        const int kind = k < count ? kind_of(a, i, j) : KINDS;
        int slot = count;
        for (int n = 0; n < KINDS; ++n) {
            const int place = next_place(n == kind, next[n]);
            slot = n == kind ? place : slot;
        }
        if (k >= count) continue;
        *list_at(a.column.data, capacity, slot, row) = a.candidate_count.data[j] > capacity ? i : j;
        slot_at(a.pose.data, capacity, POSE_ROWS, slot, row)[3 * CHUNK] = 9;
    }
}

// Cells of a vector of rows, or their candidates: index, and 0 where there is none.
struct Cells {
    int at[WIDTH];
};

// True where a cell has a smaller index than its candidate.
CUDA_CALLABLE inline Mask precedes(const Cells& own, const Cells& other) {
    return mask_of(indices(own.at) < indices(other.at));
}

// A vector of rows: own cells, and their numbers of candidates, 0 beyond the last row.
template <class Pairs> struct Rows {
    const Pairs& a;
    const int row, capacity; // first row, and length of a list of candidates
    Cells own;
    int counts[WIDTH], slots; // number of candidates of each row, and the largest

    CUDA_CALLABLE Rows(const Pairs& a, int row) : a(a), row(row), capacity(a.candidate.shape[1]) {
        const int rows = *a.rows.data;
        for (int l = 0; l < WIDTH; ++l) {
            own.at[l] = row + l < rows ? a.cell.data[row + l] : a.cell.data[row / CHUNK * CHUNK];
            counts[l] = row + l < rows ? a.candidate_count.data[own.at[l]] : 0;
        }
        slots = largest_count(counts);
    }
    // Largest number of candidates with which differences act.
    CUDA_CALLABLE int close_slots() const {
        int close[WIDTH];
        for (int l = 0; l < WIDTH; ++l) {
            const int* const kinds = a.kinds.data + KINDS * (size_t)own.at[l];
            close[l] = counts[l] == 0 ? 0 : kinds[FINE_NOW] + kinds[CLOSE_NOW] + kinds[MAY_BE_CLOSE];
        }
        return largest_count(close);
    }
    // Candidates of a slot; where there is none, or it takes no part, the own cell.
    CUDA_CALLABLE Cells candidates(int slot) const {
        const int* const column = list_at(a.column.data, capacity, slot, row);
        Cells c;
        for (int l = 0; l < WIDTH; ++l) c.at[l] = slot < counts[l] ? column[l] : own.at[l];
        return c;
    }
    CUDA_CALLABLE Boxes boxes(const Cells& c) const {
        const Four place = four_at(a.box.data, 0, c.at), sides = four_at(a.box.data, 1, c.at),
                   turn = four_at(a.box.data, 2, c.at), kind = four_at(a.box.data, 3, c.at);
        return {{place.x, place.y, place.z},
                {sides.x, sides.y, sides.z},
                {turn.x, turn.y, turn.z, turn.w},
                kind.x,
                sides.w,
                place.w,
                kind.y > Real(0),
                (kind.z == Real(1)) | (kind.z == Real(3)),
                kind.z >= Real(2),
                kind.w > Real(0)};
    }
    // Where a candidate is another cell.
    CUDA_CALLABLE Mask listed(const Cells& other) const { return mask_of(indices(own.at) != indices(other.at)); }
    // Where a candidate is in the window.
    CUDA_CALLABLE Mask near(const Boxes& box, const Cells& other) const {
        const Four place = four_at(a.box.data, 0, other.at), sides = four_at(a.box.data, 1, other.at);
        const Vector apart = Vector{place.x, place.y, place.z} - box.center;
        const Number reach = WINDOW_END / 2 * (box.size + sides.w);
        return listed(other) & (dot(apart, apart) < reach * reach);
    }
    CUDA_CALLABLE BoxPair pair(const Boxes& box, const Cells& other, const Boxes& other_box,
                               const RelativePose& pose) const {
        return box_pair(box, other_box, pose, listed(other), precedes(own, other));
    }
};

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

// Writes sums over Gauss points where pairs have moved, 0 where they are not near.
CUDA_CALLABLE inline void put_moved(Real* rows, const Number* values, Points points, Number factor, Mask moved,
                                    Mask near) {
    for (int k = 0; k < 9; ++k) {
        const Number sum = points_sum(values[k], points);
        Real* const row = rows + k * CHUNK;
        if (points.first == 0) put(row, moved ? (near ? factor * sum : factor * Real(0)) : numbers(row));
    }
}
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

// Relative pose of a pair in numbers, and where it differs from the stored one. Pairs that are not near have one pose.
struct PoseRows {
    Number now[POSE_ROWS];
    Mask moved;

    CUDA_CALLABLE PoseRows(const Real* rows, const RelativePose& pose, Number size, Mask near)
        : now{pose.r.x, pose.r.y, pose.r.z, pose.q[0], pose.q[1], pose.q[2], pose.q[3]} {
        const Number zero = size * Real(0);
        Number change = zero;
        for (int k = 0; k < POSE_ROWS; ++k) {
            now[k] = near ? now[k] : zero + (k == 3 ? FAR : Real(0));
            const Number difference = now[k] - numbers(rows + k * CHUNK),
                         scaled = k < 3 ? difference / size : difference;
            change = larger(change, larger(scaled, -scaled));
        }
        moved = change > POSE_TOLERANCE;
    }
    // True if none of the stored pairs was near: their matrices are 0.
    static CUDA_CALLABLE bool all_far(const Real* rows) { return !any(numbers(rows + 3 * CHUNK) != FAR); }
    CUDA_CALLABLE void store(Real* rows) const {
        for (int k = 0; k < POSE_ROWS; ++k) put(rows + k * CHUNK, moved ? now[k] : numbers(rows + k * CHUNK));
    }
};

// Computes the tensors of the rows from ``row`` on whose pairs have moved.
template <class Pairs> CUDA_CALLABLE inline void tabulate(const Pairs& a, int row) {
    const Rows<Pairs> rows(a, row);
    if (rows.slots == 0) return;
    const Boxes box = rows.boxes(rows.own);
    const Number zero = box.size * Real(0);
    Number overlap = zero;
    int end = 0;
    for_candidates(rows.slots, rows.close_slots(), [&](int slot, Points points) {
        const Cells other = rows.candidates(slot);
        const Mask near = rows.near(box, other);
        Real* const stored = slot_at(a.pose.data, rows.capacity, POSE_ROWS, slot, row);
        if (!any(near) && PoseRows::all_far(stored)) return;
        if (any(near)) end = slot + 1;
        const Boxes other_box = rows.boxes(other);
        const RelativePose pose = relative_pose(box, other_box);
        const Mask induced = near & other_box.inducible;
        if (points.first == 0) overlap += induced ? overlap_share(box, other_box, pose) : zero;
        const PoseRows change(stored, pose, box.size, near);
        if (!any(change.moved)) return;
        const BoxPair pair = rows.pair(box, other, other_box, pose);
        const Number factor = pair.window.value * pair.unit * pair.unit * pair.unit;
        PairMatrices matrices;
        if (any(near)) matrices = pair_matrices(pair, points);
        auto write = [&](Real* out, const Number* values) {
            put_moved(out, values, points, factor, change.moved, near);
        };
        write(slot_at(a.matrix.data, rows.capacity, MATRIX_ROWS, slot, row), matrices.means);
        if (slot < a.close_capacity) {
            Real* const detail = slot_at(a.detail.data, a.close_capacity, DETAIL_ROWS, slot, row);
            write(detail, matrices.of_differences);
            write(detail + 9 * CHUNK, matrices.at_differences);
            write(detail + 18 * CHUNK, matrices.differences);
        }
        if (points.first == 0) change.store(stored); // after the other threads have read it
    });
    const Number within = (group_sum(overlap) - OVERLAP_BEGIN) / (OVERLAP_END - OVERLAP_BEGIN);
    overlap = smaller(larger(within, zero), zero + 1);
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
    const int may_be_close = a.close_capacity > 0 ? rows.close_slots() : 0;
    const int close = may_be_close < a.close_capacity ? may_be_close : a.close_capacity;
    Vector h = {zero, zero, zero}, g = h;
    for (int slot = share(); slot < a.near_end.data[row]; slot += SHARES) {
        const Cells other = rows.candidates(slot);
        const Vector m = vectors_of(means, other);
        h += matrix_times(slot_at(a.matrix.data, rows.capacity, MATRIX_ROWS, slot, row), m);
        if (slot >= close) continue;
        const Real* const detail = slot_at(a.detail.data, a.close_capacity, DETAIL_ROWS, slot, row);
        const Vector d = vectors_of(differences, other);
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

// Adds forces [N] and torques [N·m] to the rows' cells.
template <class Pairs> CUDA_CALLABLE inline void add_force(const Pairs& a, int row) {
    const Rows<Pairs> rows(a, row);
    if (rows.slots == 0) return;
    const Boxes box = rows.boxes(rows.own);
    const Real *const means = (const Real*)a.means.data, *const differences = (const Real*)a.differences.data;
    const Vector m = vectors_of(means, rows.own), difference = vectors_of(differences, rows.own);
    const Number zero = box.size * Real(0);
    Vector force = {zero, zero, zero}, torque = force;
    const int end = a.near_end.data[row], close = rows.close_slots();
    for_candidates(end, close < end ? close : end, [&](int slot, Points points) {
        const Cells other = rows.candidates(slot);
        const Mask near = rows.near(box, other);
        if (!any(near)) return;
        const Boxes other_box = rows.boxes(other);
        const BoxPair pair = rows.pair(box, other, other_box, relative_pose(box, other_box));
        const Number cube = pair.unit * pair.unit * pair.unit;
        const PairMoments moments = {m, cube * to_world(pair.rotation, vectors_of(means, other)), difference,
                                     cube * vectors_of(differences, other)};
        const Wrench wrench = pair_wrench(pair, moments, points);
        add_where(near, force, pair.unit * wrench.force);
        add_where(near, torque, wrench.torque);
    });
    int moved[WIDTH], turned[WIDTH];
    for (int l = 0; l < WIDTH; ++l) {
        moved[l] = a.movable.data[rows.own.at[l]] ? rows.counts[l] : 0;
        turned[l] = a.rotatable.data[rows.own.at[l]] ? moved[l] : 0;
    }
    const Rotation<Number> frame = rotation_of<Number>(box.q);
    add_to_cells((Real*)a.forces.data, rows.own, moved, to_world(frame, group_sums(force)), MU0);
    add_to_cells((Real*)a.torques.data, rows.own, turned, to_world(frame, group_sums(torque)), MU0);
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
    if (pass == CLEAR && i < BINS && share() == 0) a.bin_end.data[i] = 0;
    if (pass == ARRANGE && i == 0 && share() == 0) arrange(a);
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
    for (int l = 0; l < WIDTH; ++l)
        if (pass != LOCATE && pass != TAKE_BALLS) arrange_rows(a, pass, i + l);
        else if (share() != 0) return;
        else if (pass == LOCATE) locate(a, i + l);
        else take_ball(a, i + l);
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
