// Rows of cells with near cells of other bodies: their candidates, ordered for vectors of rows.
//
// A search lists candidates, cells that are or may become near. Each cell with candidates gets a row, and each
// candidate a slot of it. One cell of a close pair owns it: its row computes tensors and forces for both cells. Owned
// pairs have the slot of this cell in the row of the other one.
//
// From Python: MARGIN, by how many radii a cell may move before candidates are searched again, and the constants of
// ``box_pair.h``. ``Pairs`` is the struct ``CellPairs`` of cell_pairs.py.
#pragma once
#include "cells/box_overlap.h"
#include "shared/group.h"

namespace warpmag {

constexpr int MATRIX_ROWS = 9, DETAIL_ROWS = 27; // of means; of, at and between differences; as in cell_pairs.py
constexpr int POSE_ROWS = 7;                     // position and quaternion of box j
constexpr int REACTION_ROWS = 8;                 // force, 0, torque, 0
constexpr Real BALL = Real(4.1887902047863905);  // volume of a ball over r³

constexpr int CLASSES = 16, BINS = CLASSES * CLASSES; // of rows by their numbers of close and of all candidates

// Writes the box of moment i. Raises a flag if it has moved at all, and another one if candidates are searched again.
template <class Pairs> CUDA_CALLABLE inline void locate(const Pairs& a, int i) {
    if (i >= a.group.shape[0] || a.group.data[i] < 0) return;
    const Real *const row = (const Real*)a.packed.data + i, *const half = a.half.data + i;
    const size_t pitch = a.packed.strides[0] / sizeof(Real), cells = a.half.shape[1];
    const int body = a.body.data[i];
    const bool is_ball = body >= a.grid.shape[0];
    Real line[LINE], *const turn = line + 8, *const stored = a.box.data + LINE * (size_t)i;
    for (int k = 0; k < 4; ++k) line[k] = row[k * pitch], line[4 + k] = half[k * cells], turn[k] = k == 3;
    if (!is_ball) put_product(a.rotation.data[body], a.grid.data[body], turn);
    line[12] = is_ball ? BALL * line[3] * line[3] * line[3] : 8 * line[4] * line[5] * line[6];
    line[13] = is_ball, line[14] = a.linear.data[body] + 2 * a.flat.data[body], line[15] = a.inducible.data[i];
    bool same = true;
    for (int k = 0; k < LINE; ++k) same = same && stored[k] == line[k], stored[k] = line[k];
    if (!same) raise_flag(*a.displaced.data);
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

// True if cell i owns its pair with cell j: half the pairs of a cell on a lattice.
CUDA_CALLABLE inline bool owns(int i, int j) { return (i + j) % 2 ? i < j : i > j; }

// Kinds of candidates by distance. Differences act between the first three, the others are too far for their longest
// sides. The first ones have fine points.
enum Distance { FINE_NOW, CLOSE_NOW, MAY_BE_CLOSE, CLOSE_AND_FLAT, NEAR_NOW, MAY_BE_NEAR, DISTANCES };
// Kinds in the order of a row, so that vectors of rows have few different ones in a slot: those of the first three
// distances, owned and not owned, then flat ones, owned and not owned, then those of no owner, which cost less.
constexpr int OWN_CLOSE_KINDS = 3, CLOSE_KINDS = 6, OWNED_KINDS = 8, KINDS = 10;
// In place of the slot in the row of the other cell: neither cell owns the pair, the other one does, there is no pair.
constexpr int NONE_OWNS = -1, OTHER_OWNS = -2, NO_PAIR = -3;

template <class Pairs> CUDA_CALLABLE inline int distance_of(const Pairs& a, int i, int j) {
    const Real *const own = a.box.data + LINE * (size_t)i, *const other = a.box.data + LINE * (size_t)j;
    auto longest_half = [](const Real* line) { return larger(line[4], larger(line[5], line[6])); };
    const Real r[3] = {other[0] - own[0], other[1] - own[1], other[2] - own[2]};
    const Real d2 = r[0] * r[0] + r[1] * r[1] + r[2] * r[2];
    const Real size = (own[7] + other[7]) / 2, longest = longest_half(own) + longest_half(other);
    auto within = [=](Real reach) { return d2 < reach * reach; };
    const bool close = within(CLOSE_END * size), flat = own[14] >= 2 || other[14] >= 2;
    const bool fine = flat && within(FINE_END * longest);
    if (within((CLOSE_END + MARGIN) * longest)) return fine ? FINE_NOW : close ? CLOSE_NOW : MAY_BE_CLOSE;
    return close ? CLOSE_AND_FLAT : within(WINDOW_END * size) ? NEAR_NOW : MAY_BE_NEAR;
}

// Kind of candidate j of cell i, in the order of a row.
template <class Pairs> CUDA_CALLABLE inline int kind_of(const Pairs& a, int i, int j) {
    const int distance = distance_of(a, i, j), other = owns(i, j) ? 0 : 1;
    if (distance < CLOSE_AND_FLAT) return distance + OWN_CLOSE_KINDS * other;
    return distance == CLOSE_AND_FLAT ? CLOSE_KINDS + other : OWNED_KINDS + distance - NEAR_NOW;
}

// Class of a number of candidates: class 0 has the largest numbers.
CUDA_CALLABLE inline int class_of(int number) { return number < CLASSES ? CLASSES - 1 - number : 0; }

// End of the slots of cell i with candidates of the first kinds.
template <class Pairs> CUDA_CALLABLE inline int end_of_kinds(const Pairs& a, int i, int first_kinds) {
    return a.kind_end.data[KINDS * (size_t)i + first_kinds - 1];
}

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
    a.bin.data[i] = CLASSES * class_of(kinds[FINE_NOW]) + class_of(count / 32);
    for (int n = 0, end = 0; n < KINDS; ++n) a.kind_end.data[KINDS * (size_t)i + n] = end += kinds[n];
    if (end_of_kinds(a, i, CLOSE_KINDS) > a.close_capacity && a.close_capacity > 0) raise_flag(*a.crowded.data);
    increment(a.bin_end.data + a.bin.data[i]);
}

// Converts the numbers of rows of the bins to first rows. Rows of a vector then have similar numbers of candidates.
template <class Pairs> CUDA_CALLABLE inline void arrange(const Pairs& a) {
    int rows = 0;
    for (int k = 0; k < BINS; ++k) {
        const int count = a.bin_end.data[k];
        a.bin_end.data[k] = rows;
        rows += count;
    }
    a.rows.data[0] = rows;
}

// Force and torque of a slot by the row of the other cell. Only the first slots of rows have other owners, so that
// slots come first: the memory beyond these is never written.
template <class Pairs> CUDA_CALLABLE inline Real* reaction_at(const Pairs& a, int slot, int row) {
    return a.reaction.data + REACTION_ROWS * ((size_t)slot * a.cell.shape[0] + row);
}

// Writes the row of cell i. Crowded candidates take no part: the cell itself replaces them.
template <class Pairs> CUDA_CALLABLE inline void assign(const Pairs& a, int i) {
    if (a.bin.data[i] < 0) return;
    const int count = a.candidate_count.data[i], capacity = a.candidate.shape[1];
    const int row = of_first_share(share() == 0 ? increment(a.bin_end.data + a.bin.data[i]) : 0);
    if (share() == 0) a.cell.data[row] = i, a.row_of.data[i] = row;
    int next[KINDS] = {};
    for (int n = 1; n < KINDS; ++n) next[n] = end_of_kinds(a, i, n);
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
    // Largest number of candidates of the first kinds.
    CUDA_CALLABLE int slots_of(int first_kinds) const {
        int numbers[WIDTH];
        for (int l = 0; l < WIDTH; ++l) numbers[l] = counts[l] == 0 ? 0 : end_of_kinds(a, own.at[l], first_kinds);
        return largest_count(numbers);
    }
    // Number of slots with details.
    CUDA_CALLABLE int detailed_slots() const {
        const int close = a.close_capacity > 0 ? slots_of(CLOSE_KINDS) : 0;
        return close < a.close_capacity ? close : a.close_capacity;
    }
    // Where differences act with the candidate of a slot: between close cells with room for the details of all their
    // close candidates.
    CUDA_CALLABLE Mask differ(int slot, const Cells& other) const {
        Cells close;
        for (int l = 0; l < WIDTH; ++l) {
            const int own_close = end_of_kinds(a, own.at[l], CLOSE_KINDS),
                      other_close = end_of_kinds(a, other.at[l], CLOSE_KINDS);
            close.at[l] = own_close <= a.close_capacity && other_close <= a.close_capacity ? own_close : 0;
        }
        return mask_of(indices(close.at) > slot);
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
    // Slot of each pair in the row of the other cell, or who owns it.
    CUDA_CALLABLE Cells other_slots(int slot) const {
        const int* const found = list_at(a.other_slot.data, capacity, slot, row);
        Cells c;
        for (int l = 0; l < WIDTH; ++l) c.at[l] = slot < counts[l] ? found[l] : NO_PAIR;
        return c;
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
    // The pairs of a slot; where they are not ``active`` their windows are 0.
    CUDA_CALLABLE BoxPair pair(const Boxes& box, int slot, const Cells& other, const Boxes& other_box,
                               const RelativePose& pose, Mask active) const {
        return box_pair(box, other_box, pose, active, precedes(own, other), differ(slot, other));
    }
};

// Slot of an owned pair in the row of its other cell, or who owns it, for cell i of a row.
template <class Pairs> CUDA_CALLABLE inline int slot_in_other_row(const Pairs& a, int i, int slot, int row) {
    const int capacity = a.candidate.shape[1], j = *list_at(a.column.data, capacity, slot, row);
    if (j == i) return NO_PAIR; // a crowded candidate
    if (slot >= end_of_kinds(a, i, OWNED_KINDS)) return NONE_OWNS;
    if (!owns(i, j)) return OTHER_OWNS;
    for (int k = 0; k < a.candidate_count.data[j]; ++k)
        if (*list_at(a.column.data, capacity, k, a.row_of.data[j]) == i) return k;
    return NONE_OWNS;
}

// Links the owned pairs of a vector of rows with the rows of their other cells. Clears all details, because those of
// pairs whose differences do not act are not computed.
template <class Pairs> CUDA_CALLABLE inline void link(const Pairs& a, int row) {
    if (row >= a.cell.shape[0]) return;
    const Rows<Pairs> rows(a, row);
    for (int slot = share(); slot < rows.slots; slot += SHARES)
        for (int l = 0; l < WIDTH; ++l) {
            if (slot >= rows.counts[l]) continue;
            *list_at(a.other_slot.data, rows.capacity, slot, row + l) =
                slot_in_other_row(a, rows.own.at[l], slot, row + l);
        }
    const int detailed = rows.detailed_slots();
    for (int slot = share(); slot < detailed; slot += SHARES)
        for (int k = 0; k < DETAIL_ROWS; ++k)
            put(slot_at(a.detail.data, a.close_capacity, DETAIL_ROWS, slot, row) + k * CHUNK, Number(Real(0)));
}
}
