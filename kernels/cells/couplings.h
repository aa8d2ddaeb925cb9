// Corrections of the field between cells of one body, H_i += Σ T_ij m_j, with tensors T_ij in the body's frame.
//
// Three passes: TURN rotates moments into the frame of their body; SHARE computes the low-order fields that all cells
// of a body share; ADD sums the tensors' fields and rotates them into the world. On a CPU a pass works on a
// vector of cells, on a GPU a group of threads has one cell. ``Couplings`` is the struct of couplings.py.
#pragma once
#include "cells/rotation.h"
#include "shared/active.h"
#include "shared/group.h"
#include "shared/team.h"

namespace warpmag {

constexpr int TENSOR = 6; // xx, yy, zz, xy, xz, yz
constexpr int COMMON = 8; // low-order fields that all cells of a body share; as in couplings.py

enum CellPass { TURN, SHARE, ADD }; // as in couplings.py

// Σ T_ij m_j of the cells at ``row`` of the tables. All lists of a chunk have the length of the longest.
template <class Couplings>
CUDA_CALLABLE inline Vector sum_entries(const Couplings& c, const Real* const moments, int row) {
    const int chunk = row / CHUNK, lane = row % CHUNK;
    const int end = c.slot_begin.data[chunk + 1];
    const size_t pitch = c.body_moments.strides[0] / sizeof(Real);
    Vector h = {0, 0, 0};
#pragma unroll 4
    for (int slot = c.slot_begin.data[chunk] + share(); slot < end; slot += SHARES) {
        const int* const other = c.other.data + (size_t)slot * CHUNK + lane;
        const Real* const t = c.tensor.data + (size_t)slot * (TENSOR * CHUNK) + lane;
        const Index j = indices(other);
        const Vector m = {collect(moments, j), collect(moments + pitch, j), collect(moments + 2 * pitch, j)};
        const Number xx = numbers(t), yy = numbers(t + CHUNK), zz = numbers(t + 2 * CHUNK);
        const Number xy = numbers(t + 3 * CHUNK), xz = numbers(t + 4 * CHUNK), yz = numbers(t + 5 * CHUNK);
        h += Vector{xx * m.x + xy * m.y + xz * m.z, xy * m.x + yy * m.y + yz * m.z, xz * m.x + yz * m.y + zz * m.z};
    }
    return group_sums(h);
}

// Low-order field at positions in a body: a[0..2] is a uniform field, a[3..7] are the coefficients of the linear fields
// ∇(x² − z²)/2, ∇(y² − z²)/2, ∇xy, ∇xz and ∇yz.
CUDA_CALLABLE inline Vector common_field(const Real* a, Vector position) {
    const Number &x = position.x, &y = position.y, &z = position.z;
    return {a[0] + a[3] * x + a[5] * y + a[6] * z, a[1] + a[5] * x + a[4] * y + a[7] * z,
            a[2] + a[6] * x + a[7] * y - (a[3] + a[4]) * z};
}

// Coefficients of a body's low-order field: its matrix times the sums of zeroth and first order, Σ m and Σ x_k m_l.
template <class Couplings> CUDA_CALLABLE inline void share_field(const Couplings& c, int body) {
    const auto& rows = c.rows.data[body]; // range of the body's rows
    const int table = c.chunk.data[rows[0] / CHUNK][3] - rows[0];
    const size_t pitch = c.body_moments.strides[0] / sizeof(Real), stride = c.position.strides[0] / sizeof(Real);
    Vector sums[3] = {};
    for (int row = rows[0] + WIDTH * share(); row < rows[1]; row += WIDTH * SHARES) {
        const Real *const own = c.body_moments.data + row, *const at = c.position.data + table + row;
        const Vector m = {numbers(own), numbers(own + pitch), numbers(own + 2 * pitch)};
        const Number x = numbers(at), y = numbers(at + stride), z = numbers(at + 2 * stride);
        sums[0] += m;
        sums[1] += Vector{x * m.x - z * m.z, y * m.y - z * m.z, x * m.y + y * m.x};
        sums[2] += Vector{x * m.z + z * m.x, y * m.z + z * m.y, z * 0};
    }
    for (Vector& sum : sums) sum = group_sums(sum);
    if (share() != 0) return;
    Real totals[3 * 3] = {};
    for (int lane = 0; lane < WIDTH; ++lane)
        for (int k = 0; k < 3; ++k) {
            totals[3 * k] += lane_of(sums[k].x, lane);
            totals[3 * k + 1] += lane_of(sums[k].y, lane);
            totals[3 * k + 2] += lane_of(sums[k].z, lane);
        }
    const Real* const matrix = c.matrix.data + (size_t)body * (COMMON * COMMON);
    for (int k = 0; k < COMMON; ++k) {
        Real strength = 0;
        for (int l = 0; l < COMMON; ++l) strength += matrix[COMMON * k + l] * totals[l];
        c.common.data[(size_t)body * COMMON + k] = strength;
    }
}

// Makes a pass over the cells from ``row`` on.
template <class Couplings> CUDA_CALLABLE inline void make_cell_pass(const Couplings& c, int pass, int row) {
    const auto& chunk = c.chunk.data[row / CHUNK]; // first moment, count, first row of the body, first row of its table
    const int offset = row % CHUNK, left = chunk[1] - offset, lane_count = left < 0 ? 0 : left > WIDTH ? WIDTH : left;
    if (lane_count == 0) return;
    const int i = chunk[0] + offset;
    const int body = c.body.data[row / CHUNK];
    if (pass == SHARE) {
        if (row == c.rows.data[body][0]) share_field(c, body);
        return;
    }
    const Rotation<Real> rotation = rotation_of<Real>(c.rotation.data[body]);
    Real* const own = c.body_moments.data + row;
    const size_t pitch = c.body_moments.strides[0] / sizeof(Real);
    if (pass == TURN) {
        const Vector m = to_body(rotation, vectors((const Real*)c.moments.data + 3 * (size_t)i, lane_count));
        if (share() != 0) return;
        put(own, m.x);
        put(own + pitch, m.y);
        put(own + 2 * pitch, m.z);
        return;
    }
    const int table_row = row - chunk[2] + chunk[3];
    const Vector sums = sum_entries(c, c.body_moments.data + chunk[2], table_row);
    if (share() != 0) return;
    const size_t stride = c.position.strides[0] / sizeof(Real);
    const Real* const at = c.position.data + table_row;
    const Vector position = {numbers(at), numbers(at + stride), numbers(at + 2 * stride)};
    const Vector common = common_field(c.common.data + (size_t)body * COMMON, position);
    const Vector h = sums + common;
    Real* const field = (Real*)c.h.data + 3 * (size_t)i;
    put_vectors(field, lane_count, vectors(field, lane_count) + to_world(rotation, h));
}

template <class Word, class Couplings>
CUDA_CALLABLE inline void add_couplings(int thread, int first, int last, int threads, Word* team, const Couplings& c) {
#if defined(__CUDA_ARCH__)
    const int n = thread / GROUP, chunk = active_item(c.active, n / CHUNK);
    if (chunk >= 0) make_cell_pass(c, first, CHUNK * chunk + n % CHUNK);
#else
    run_passes(team, threads, first, last, CHUNK * c.chunk.shape[0], WIDTH,
               [&](int pass, int row) { make_cell_pass(c, pass, row); });
#endif
}
}
