// Corrections of the field and force between near cells of different bodies, H_i += T_ij m_j.
//
// The sums over pairs treat a cell as a ball. Here the cells are boxes. The tensor of a pair is the field of each box,
// averaged over 2³ Gauss points of the other one, and the mean of both, so that it is symmetric. A window blends it
// into the law of the balls with growing distance. T_ij is the difference. Forces are the exact derivatives of the
// energy −μ0 m_i·T_ij·m_j, so that they conserve energy and momentum.
//
// Entries are in the frame of box i: the box's axes are the axes of its body's grid. They are computed again when the
// relative pose of their bodies has changed. Lengths are in units of the mean of the boxes' sizes.
//
// From Python: CAPACITY, the length of a list of candidates; WINDOW_BEGIN, WINDOW_END, CLOSE_BEGIN and CLOSE_END,
// distances of the windows; CLOSE_POINTS, Gauss points of close boxes along each axis;
// HARDENING, the demagnetizing factor added to a cell inside another body; MARGIN, by how many radii a cell
// may move before candidates are searched again; MU0.
// ``CellPairs`` is the struct of cell_pairs.py.
#pragma once
#include "cells/box_field.h"
#include "cells/rotation.h"
#include "pairs/pair_law.h"
#include "shared/group.h"
#include "shared/team.h"

namespace warpmag {

constexpr int TENSOR_ROWS = 6, POSE_ROWS = 7; // xx, yy, zz, xy, yz, zx; position and quaternion of box j
constexpr Real POSE_TOLERANCE = Real(1e-6);   // largest change of a pose that counts as rest: float32 rounding

enum CellPairPass { LOCATE, CLEAR, SELECT, TABULATE, ADD_FIELD, ADD_FORCE }; // as in cell_pairs.py

// Writes the frame of body i, and raises a flag if cell i has moved so far that candidates are searched again.
template <class Pairs> CUDA_CALLABLE inline void locate(const Pairs& a, int i) {
    if (i < a.frame.shape[0]) {
        const auto &b = a.rotation.data[i], &g = a.grid.data[i];
        auto& q = a.frame.data[i];
        q[0] = b[3] * g[0] + b[0] * g[3] + b[1] * g[2] - b[2] * g[1];
        q[1] = b[3] * g[1] + b[1] * g[3] + b[2] * g[0] - b[0] * g[2];
        q[2] = b[3] * g[2] + b[2] * g[3] + b[0] * g[1] - b[1] * g[0];
        q[3] = b[3] * g[3] - b[0] * g[0] - b[1] * g[1] - b[2] * g[2];
    }
    if (i >= a.group.shape[0] || a.group.data[i] < 0) return;
    const Real* const row = (const Real*)a.packed.data + i;
    const size_t pitch = a.packed.strides[0] / sizeof(Real);
    const Real* const listed = (const Real*)a.found_at.data + 3 * (size_t)i;
    const Real x = row[0] - listed[0], y = row[pitch] - listed[1], z = row[2 * pitch] - listed[2];
    const Real limit = MARGIN * row[3 * pitch];
    if (!(x * x + y * y + z * z <= limit * limit)) raise_flag(*a.moved.data);
}

CUDA_CALLABLE inline int next_row(int* count) {
#if defined(__CUDA_ARCH__)
    return atomicAdd(count, 1);
#else
    return __atomic_fetch_add(count, 1, __ATOMIC_RELAXED);
#endif
}

// Orders the candidates of cell i by distance, so that the first slots of all rows have close pairs.
template <class Pairs> CUDA_CALLABLE inline void sort_candidates(const Pairs& a, int i, int count) {
    const Real* const x = (const Real*)a.packed.data;
    const size_t pitch = a.packed.strides[0] / sizeof(Real);
    int* const list = a.candidate.data + (size_t)i * CAPACITY;
    auto distance = [=](int j) {
        const Real r[3] = {x[j] - x[i], x[j + pitch] - x[i + pitch], x[j + 2 * pitch] - x[i + 2 * pitch]};
        return r[0] * r[0] + r[1] * r[1] + r[2] * r[2];
    };
    for (int k = 1; k < count; ++k) {
        const int j = list[k];
        const Real d = distance(j);
        int place = k;
        for (; place > 0 && distance(list[place - 1]) > d; --place) list[place] = list[place - 1];
        list[place] = j;
    }
}

// Gives a row to cell i after a search if it has candidates. Cells with too many candidates have none.
template <class Pairs> CUDA_CALLABLE inline void select(const Pairs& a, int i) {
    if (a.searching.data[0] == 0 || i >= a.group.shape[0] || a.group.data[i] < 0) return;
    const int count = a.candidate_count.data[i];
    if (count > CAPACITY) raise_flag(*a.crowded.data);
    if (count == 0 || count > CAPACITY) return;
    sort_candidates(a, i, count);
    const int row = next_row(a.rows.data);
    a.cell.data[row] = i;
    Real* const poses = a.pose.data;
    for (int slot = 0; slot < count; ++slot) // a pose of no pair: the entry is computed
        slot_at(poses, CAPACITY, POSE_ROWS, slot, row)[3 * CHUNK] = 9;
}

// Boxes of cells: half sides, rotation to the world as quaternion, volume, and the size that scales the window.
struct Boxes {
    Vector half;
    Number q[4], volume, size, radius; // radius of the ball of the same volume
};

// Cells of a vector of rows, or their candidates: index, and 0 where there is none.
struct Cells {
    int at[WIDTH];
};

template <class Pairs> struct PairReader {
    const Pairs& a;
    const Real* const packed;
    const size_t pitch;

    CUDA_CALLABLE explicit PairReader(const Pairs& a)
        : a(a), packed((const Real*)a.packed.data), pitch(a.packed.strides[0] / sizeof(Real)) {}
    CUDA_CALLABLE Number row(int k, const Cells& c) const { return gather(packed + k * pitch, c.at); }
    CUDA_CALLABLE Vector position(const Cells& c) const { return {row(0, c), row(1, c), row(2, c)}; }
    CUDA_CALLABLE Vector moment(const Cells& c) const { return {row(4, c), row(5, c), row(6, c)}; }
    CUDA_CALLABLE Boxes boxes(const Cells& c) const {
        const size_t cells = a.half.strides[0] / sizeof(Real);
        Boxes b;
        b.half = {gather(a.half.data, c.at), gather(a.half.data + cells, c.at), gather(a.half.data + 2 * cells, c.at)};
        int body[WIDTH];
        for (int l = 0; l < WIDTH; ++l) body[l] = 4 * a.body.data[c.at[l]];
        const Real* const frames = (const Real*)a.frame.data;
        for (int k = 0; k < 4; ++k) b.q[k] = gather(frames + k, body);
        b.radius = row(3, c);
        b.volume = 8 * b.half.x * b.half.y * b.half.z;
        b.size = gather(a.half.data + 3 * cells, c.at);
        return b;
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
            const int j = slot < counts[l] ? a.candidate.data[(size_t)own.at[l] * CAPACITY + slot] : own.at[l];
            c.at[l] = a.candidate_count.data[j] > CAPACITY ? own.at[l] : j;
        }
        return c;
    }
};

// Pose of box j relative to box i: separation, and rotation from the frame of j to that of i.
struct RelativePose {
    Vector r;
    Number q[4];
};
CUDA_CALLABLE inline RelativePose relative_pose(Vector apart, const Boxes& own, const Boxes& other) {
    const Number *a = own.q, *b = other.q;
    return {
        to_body(rotation_of<Number>(a), apart),
        {a[3] * b[0] - a[0] * b[3] - a[1] * b[2] + a[2] * b[1], a[3] * b[1] - a[1] * b[3] - a[2] * b[0] + a[0] * b[2],
         a[3] * b[2] - a[2] * b[3] - a[0] * b[1] + a[1] * b[0], a[3] * b[3] + a[0] * b[0] + a[1] * b[1] + a[2] * b[2]}};
}

// Factor that falls from 1 to 0 with the distance, and its derivative.
struct Window {
    Number value, slope;
};
CUDA_CALLABLE inline Window window_between(Number d, Real begin, Real end, Mask listed) {
    const Number zero = d * Real(0), t = smaller(larger((end - d) * (1 / (end - begin)), zero), zero + 1);
    return {listed ? t * t * (3 - 2 * t) : zero, listed ? t * (1 - t) * (-6 / (end - begin)) : zero};
}

// A pair of boxes in units of ``1/unit``: half sides, separation r from i to j, rotation of j in the frame of i, radii
// of the balls, the window of all boxes, and that of boxes that are integrated over.
struct BoxPair {
    Vector half, other_half, r;
    Rotation<Number> rotation;
    Number unit, radius, other_radius;
    Window window, close;
};
CUDA_CALLABLE inline BoxPair box_pair(const Boxes& own, const Boxes& other, const RelativePose& pose, Mask listed) {
    const Number unit = 2 / (own.size + other.size);
    const Vector r = unit * pose.r;
    const Number d = length(r);
    return {unit * own.half,
            unit * other.half,
            r,
            rotation_of<Number>(pose.q),
            unit,
            unit * own.radius,
            unit * other.radius,
            window_between(d, WINDOW_BEGIN, WINDOW_END, listed),
            window_between(d, CLOSE_BEGIN, CLOSE_END, listed)};
}

// Calls visit(p, weight) for the POINTS³ Gauss points of a box of half sides h.
template <int POINTS, class Visit> CUDA_CALLABLE inline void for_gauss_points(Vector h, Visit visit) {
    constexpr Real PLACE = POINTS == 1 ? Real(0) : POINTS == 2 ? Real(0.5773502691896258) : Real(0.7745966692414834);
    constexpr Real OUTER = POINTS == 1 ? Real(1) : POINTS == 2 ? Real(0.5) : Real(5.0 / 18), INNER = Real(8.0 / 18);
    auto place = [](int k) { return PLACE * (POINTS == 2 ? 2 * k - 1 : k - POINTS / 2); };
    auto weight = [](int k) { return POINTS == 3 && k == 1 ? INNER : OUTER; };
    for (int a = 0; a < POINTS; ++a)
        for (int b = 0; b < POINTS; ++b)
            for (int c = 0; c < POINTS; ++c)
                visit(Vector{place(a) * h.x, place(b) * h.y, place(c) * h.z}, weight(a) * weight(b) * weight(c));
}

CUDA_CALLABLE inline Symmetric operator+(const Symmetric& a, const Symmetric& b) {
    return {a.xx + b.xx, a.yy + b.yy, a.zz + b.zz, a.xy + b.xy, a.yz + b.yz, a.zx + b.zx};
}
CUDA_CALLABLE inline Symmetric operator*(Number k, const Symmetric& a) {
    return {k * a.xx, k * a.yy, k * a.zz, k * a.xy, k * a.yz, k * a.zx};
}

// A tensor of the frame of j in the frame of i.
CUDA_CALLABLE inline Symmetric rotated(const Rotation<Number>& q, const Symmetric& k) {
    Vector columns[3]; // of k qᵀ
    for (int c = 0; c < 3; ++c) columns[c] = k * Vector{q.rows[c][0], q.rows[c][1], q.rows[c][2]};
    const Vector x = to_world(q, columns[0]), y = to_world(q, columns[1]), z = to_world(q, columns[2]);
    return {x.x, y.y, z.z, y.x, z.y, z.x};
}

// Law of the balls, in the units of the pair: direction from j to i, distance, and radial factors.
struct BallLaw {
    Vector u;
    Number d;
    Factors<Number> g;
};
CUDA_CALLABLE inline BallLaw ball_law(const BoxPair& p) {
    const Number a = p.radius, b = p.other_radius, zero = a * Real(0);
    const Polar at = polar(-p.r);
    const Number d = larger(at.d, zero + Real(1e-12)), inverse = 1 / d, i3 = inverse * inverse * inverse;
    Factors<Number> g = {-i3, 3 * i3 * inverse, -15 * i3 * inverse};
    const Mask overlap = d < a + b;
    if (any(overlap)) {
        const Factors<Number> near = averaged_factors(d, a, b, larger(a - b, b - a));
        g = {overlap ? near.g1 : g.g1, overlap ? near.g2 : g.g2, overlap ? near.g3 : g.g3};
    }
    return {at.u, d, g};
}

// Sum of both boxes' fields, each averaged over the Gauss points of the other box, in the frame of i.
template <int POINTS> CUDA_CALLABLE inline Symmetric boxes_tensor(const BoxPair& p) {
    const Number zero = p.unit * Real(0), share = zero + 1;
    Symmetric of_other = {zero, zero, zero, zero, zero, zero}, of_own = of_other;
    for_gauss_points<POINTS>(p.half, [&](Vector x, Real w) {
        of_other = of_other + (zero + w) * box_tensor(view_box(to_body(p.rotation, x - p.r), p.other_half));
    });
    for_gauss_points<POINTS>(p.other_half, [&](Vector x, Real w) {
        of_own = of_own + (zero + w) * box_tensor(view_box(p.r + to_world(p.rotation, x), p.half));
    });
    const Vector a = p.half, b = p.other_half;
    return share / (8 * b.x * b.y * b.z) * rotated(p.rotation, of_other) + share / (8 * a.x * a.y * a.z) * of_own;
}

// Tensor of the pair less that of the balls, in the frame of i and the units of the pair. Close boxes are the mean of
// both averages. Those farther away are the sum of both fields at the centers less that of dipoles, which has the
// quadrupoles of both boxes.
CUDA_CALLABLE inline Symmetric pair_tensor(const BoxPair& p) {
    const Number zero = p.unit * Real(0), close = p.close.value;
    Symmetric boxes = {zero, zero, zero, zero, zero, zero};
    if (any(close > zero)) boxes = Real(0.5) * close * boxes_tensor<CLOSE_POINTS>(p);
    if (any(close < zero + 1)) boxes = boxes + (1 - close) * boxes_tensor<1>(p);
    const BallLaw ball = ball_law(p);
    const Vector u = ball.u;
    const Number factor = INVERSE_4_PI * (2 - close), g1 = factor * ball.g.g1, g2 = factor * ball.g.g2 * ball.d;
    return {boxes.xx - g1 - g2 * u.x * u.x, boxes.yy - g1 - g2 * u.y * u.y, boxes.zz - g1 - g2 * u.z * u.z,
            boxes.xy - g2 * u.x * u.y,      boxes.yz - g2 * u.y * u.z,      boxes.zx - g2 * u.z * u.x};
}

// Writes tensors where pairs have moved, 0 where they are not near.
CUDA_CALLABLE inline void put_tensor(Real* rows, const Symmetric& t, Mask moved, Mask near) {
    const Number components[TENSOR_ROWS] = {t.xx, t.yy, t.zz, t.xy, t.yz, t.zx}, zero = t.xx * Real(0);
    for (int k = 0; k < TENSOR_ROWS; ++k) {
        Real* const row = rows + k * CHUNK;
        put(row, moved ? (near ? components[k] : zero) : numbers(row));
    }
}
CUDA_CALLABLE inline Symmetric tensor_at(const Real* rows) {
    return {numbers(rows),
            numbers(rows + CHUNK),
            numbers(rows + 2 * CHUNK),
            numbers(rows + 3 * CHUNK),
            numbers(rows + 4 * CHUNK),
            numbers(rows + 5 * CHUNK)};
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

// Share of a cell's depth that it lies inside a box of another body: 0 for disjoint boxes, at most 1. Disjoint boxes
// have disjoint inscribed spheres.
CUDA_CALLABLE inline Number overlap_depth(const Boxes& own, const Boxes& other, Vector apart) {
    auto inscribed = [](Vector h) { return smaller(h.x, smaller(h.y, h.z)); };
    const Number zero = own.size * Real(0), reach = inscribed(own.half) + inscribed(other.half);
    return larger(1 - length(apart) / reach, zero);
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
    Number depth = box.size * Real(0);
    for (int slot = share(); slot < slots; slot += SHARES) {
        const Cells other = reader.candidates(own, counts, slot);
        const Boxes other_box = reader.boxes(other);
        const Vector apart = reader.position(other) - x;
        const Mask listed = mask_of(indices(own.at) != indices(other.at));
        depth += listed ? overlap_depth(box, other_box, apart) : depth * Real(0);
        const RelativePose pose = relative_pose(apart, box, other_box);
        const Mask moved = store_pose(slot_at(a.pose.data, CAPACITY, POSE_ROWS, slot, row), pose, box.size);
        if (!any(moved)) continue;
        const BoxPair pair = box_pair(box, other_box, pose, listed);
        const Mask near = pair.window.value > Real(0);
        const Number zero = pair.unit * Real(0), cube = pair.unit * pair.unit * pair.unit;
        Symmetric tensor = {zero, zero, zero, zero, zero, zero};
        if (any(near)) tensor = pair.window.value * cube * pair_tensor(pair);
        put_tensor(slot_at(a.tensor.data, CAPACITY, TENSOR_ROWS, slot, row), tensor, moved, near);
    }
    depth = smaller(group_sum(depth), depth * Real(0) + 1);
    if (share() == 0) put(a.hardness.data + row, HARDENING * depth / box.volume);
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
    const Real* const moments = (const Real*)a.moments.data;
    Vector h = {zero, zero, zero};
    for (int slot = share(); slot < slots; slot += SHARES) {
        int place[WIDTH];
        const Cells other = reader.candidates(own, counts, slot);
        for (int l = 0; l < WIDTH; ++l) place[l] = 3 * other.at[l];
        const Vector m = {gather(moments, place), gather(moments + 1, place), gather(moments + 2, place)};
        h += tensor_at(slot_at(a.tensor.data, CAPACITY, TENSOR_ROWS, slot, row)) * to_body(frame, m);
    }
    int place[WIDTH];
    for (int l = 0; l < WIDTH; ++l) place[l] = 3 * own.at[l];
    const Vector m = {gather(moments, place), gather(moments + 1, place), gather(moments + 2, place)};
    add_to_cells((Real*)a.h.data, own, counts, to_world(frame, group_sums(h)) - numbers(a.hardness.data + row) * m, 1);
}

// Force on a cell, torque about its center, and the negative energy that they are derivatives of.
struct Wrench {
    Vector force, torque;
    Number work;

    CUDA_CALLABLE void add(Number k, const Wrench& w) {
        force += k * w.force;
        torque += k * w.torque;
        work += k * w.work;
    }
};

// Wrench of m·T e, for T of ``boxes_tensor`` and moments m of i and e of j, in the frame of i.
template <int POINTS> CUDA_CALLABLE inline Wrench boxes_wrench(const BoxPair& p, Vector m, Vector e) {
    const Number zero = p.unit * Real(0), share = zero + 1;
    const Vector a = p.half, b = p.other_half, none = {zero, zero, zero};
    Wrench of_other = {none, none, zero}, of_own = of_other;
    const Vector r_j = to_body(p.rotation, p.r), m_j = to_body(p.rotation, m), e_j = to_body(p.rotation, e);
    for_gauss_points<POINTS>(p.half, [&](Vector x, Real w) { // points of i in the field of j, in the frame of j
        const Vector arm = to_body(p.rotation, x);
        const BoxView view = view_box(arm - r_j, p.other_half);
        const Vector force = box_slope(view, e_j, m_j), field = box_tensor(view) * e_j;
        of_other.add(zero + w, {force, cross(arm, force) + cross(m_j, field), dot(m_j, field)});
    });
    for_gauss_points<POINTS>(p.other_half, [&](Vector x, Real w) { // points of j in the field of i
        const Vector at = p.r + to_world(p.rotation, x);
        const BoxView view = view_box(at, p.half);
        const Vector force = box_slope(view, m, e), field = box_tensor(view) * m;
        of_own.add(zero - w, {force, cross(at, force) + cross(e, field), -dot(e, field)});
    });
    Wrench sum = {none, none, zero};
    sum.add(share / (8 * a.x * a.y * a.z), of_own);
    const Wrench turned = {to_world(p.rotation, of_other.force), to_world(p.rotation, of_other.torque), of_other.work};
    sum.add(share / (8 * b.x * b.y * b.z), turned);
    return sum;
}

// Wrench of m·T e, for the tensor of the balls.
CUDA_CALLABLE inline Wrench ball_wrench(const BoxPair& p, Vector m, Vector e) {
    const BallLaw ball = ball_law(p);
    const Vector u = ball.u;
    const Number um = dot(u, m), ue = dot(u, e), product = dot(m, e);
    const Number g2 = INVERSE_4_PI * ball.g.g2, radial = g2 * product + INVERSE_4_PI * ball.g.g3 * um * ue;
    const Vector field = INVERSE_4_PI * ball.g.g1 * e + g2 * ball.d * ue * u;
    return {g2 * (um * e + ue * m) + radial * u, cross(m, field), dot(m, field)};
}

// Wrench of m·T e, for T of ``pair_tensor`` and its windows.
CUDA_CALLABLE inline Wrench pair_wrench(const BoxPair& p, Vector m, Vector e) {
    const Number zero = p.unit * Real(0), close = p.close.value;
    const Vector none = {zero, zero, zero}, inward = -1 / larger(length(p.r), zero + Real(1e-12)) * p.r;
    const Wrench ball = ball_wrench(p, m, e);
    Wrench sum = {none, none, zero};
    Number change = ball.work; // of the work with the window of close boxes
    sum.add(close - 2, ball);
    if (any(close > zero)) {
        const Wrench boxes = boxes_wrench<CLOSE_POINTS>(p, m, e);
        sum.add(Real(0.5) * close, boxes);
        change += Real(0.5) * boxes.work;
    }
    if (any(close < zero + 1)) {
        const Wrench boxes = boxes_wrench<1>(p, m, e);
        sum.add(1 - close, boxes);
        change -= boxes.work;
    }
    const Number radial = p.window.value * p.close.slope * change + p.window.slope * sum.work;
    return {p.window.value * sum.force + radial * inward, p.window.value * sum.torque, zero};
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
    const Number zero = box.size * Real(0);
    Vector force = {zero, zero, zero}, torque = force;
    for (int slot = share(); slot < slots; slot += SHARES) {
        const Cells other = reader.candidates(own, counts, slot);
        const Boxes other_box = reader.boxes(other);
        const RelativePose pose = relative_pose(reader.position(other) - x, box, other_box);
        const BoxPair pair = box_pair(box, other_box, pose, mask_of(indices(own.at) != indices(other.at)));
        const Mask near = pair.window.value > Real(0);
        if (!any(near)) continue;
        const Number cube = pair.unit * pair.unit * pair.unit;
        const Wrench wrench = pair_wrench(pair, m, cube * to_body(frame, reader.moment(other)));
        add_where(near, force, pair.unit * wrench.force);
        add_where(near, torque, wrench.torque);
    }
    int movable[WIDTH];
    for (int l = 0; l < WIDTH; ++l) movable[l] = a.movable.data[own.at[l]] ? counts[l] : 0;
    add_to_cells((Real*)a.forces.data, own, movable, to_world(frame, group_sums(force)), MU0);
    add_to_cells((Real*)a.torques.data, own, movable, to_world(frame, group_sums(torque)), MU0);
}

template <class Pairs> CUDA_CALLABLE inline void make_cell_pair_pass(const Pairs& a, int pass, int i) {
    if (pass >= TABULATE) {
        if (pass == TABULATE) tabulate(a, i);
        else if (pass == ADD_FIELD) add_field(a, i);
        else add_force(a, i);
        return;
    }
    for (int l = 0; l < WIDTH && share() == 0; ++l)
        if (pass == LOCATE) locate(a, i + l);
        else if (pass == SELECT) select(a, i + l);
        else if (i + l == 0 && a.searching.data[0] != 0) a.rows.data[0] = 0;
}

template <class Word, class Pairs>
CUDA_CALLABLE inline void add_cell_pairs(int thread, int first, int last, int threads, Word* team, const Pairs& a) {
#if defined(__CUDA_ARCH__)
    make_cell_pair_pass(a, first, thread / GROUP);
#else
    run_passes(team, threads, first, last, CHUNK * ((a.group.shape[0] + CHUNK - 1) / CHUNK), WIDTH,
               [&](int pass, int i) { make_cell_pair_pass(a, pass, i); });
#endif
}
}
