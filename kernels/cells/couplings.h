// Cells of one body: the differences of their halves, and corrections of the field between them, H_i += Σ T_ij m_j.
//
// DIFFERENCES writes the moment of each cell and half the difference D m of its halves
// (``warpmag.shapes.linear_cells``). UNIFORM_FIELD computes the uniform field that the correction C adds to all cells
// of a body. TRANSPOSE copies the fields of the differences from an array of vectors to rows of components. ADD adds
// Dᵀ of these fields, the fields of the tensors, and the uniform field. Where no cell has slopes, the differences are
// 0. Everything is in the frame of the body's grid. On a CPU a pass works on a vector of cells, on a GPU a group of
// threads has one cell.
// ``Couplings`` is the struct of couplings.py.
#pragma once
#include "cells/rotation.h"
#include "shared/active.h"
#include "shared/group.h"
#include "shared/layer.h"
#include "shared/team.h"

namespace warpmag {

constexpr int TENSOR = 9; // rows of the tensor one after the other

enum CellPass { DIFFERENCES, UNIFORM_FIELD, TRANSPOSE, ADD }; // as in couplings.py

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
        auto row_times = [&](int k) {
            const Real* const row = t + 3 * k * CHUNK;
            return numbers(row) * m.x + numbers(row + CHUNK) * m.y + numbers(row + 2 * CHUNK) * m.z;
        };
        h += Vector{row_times(0), row_times(1), row_times(2)};
    }
    return group_sums(h);
}

// Uniform field that all cells of a body share: C times the moment of the body.
template <class Couplings> CUDA_CALLABLE inline void write_uniform_field(const Couplings& c, int body) {
    const auto& rows = c.rows.data[body]; // range of the body's rows
    const size_t pitch = c.body_moments.strides[0] / sizeof(Real);
    const Number zero = Number(Real(0));
    Vector sum = {zero, zero, zero};
    for (int row = rows[0] + WIDTH * share(); row < rows[1]; row += WIDTH * SHARES) {
        const Real* const own = c.body_moments.data + row;
        sum += Vector{numbers(own), numbers(own + pitch), numbers(own + 2 * pitch)};
    }
    sum = group_sums(sum);
    if (share() != 0) return;
    Real total[3] = {};
    for (int lane = 0; lane < WIDTH; ++lane) {
        total[0] += lane_of(sum.x, lane);
        total[1] += lane_of(sum.y, lane);
        total[2] += lane_of(sum.z, lane);
    }
    const Real* const matrix = c.matrix.data + 9 * (size_t)body;
    for (int k = 0; k < 3; ++k)
        c.common.data[3 * (size_t)body + k] =
            matrix[3 * k] * total[0] + matrix[3 * k + 1] * total[1] + matrix[3 * k + 2] * total[2];
}

// Writes three rows of an array of cells from ``first`` on.
template <class Array> CUDA_CALLABLE inline void put_row(const Array& array, int row, int first, Vector v) {
    const size_t pitch = array.strides[0] / sizeof(Real);
    Real* const at = array.data + first * pitch + row;
    put(at, v.x);
    put(at + pitch, v.y);
    put(at + 2 * pitch, v.z);
}

// Cells of a vector: their first row, their number, their first moment, and the rows and moments of their body.
struct CellSpan {
    int row, count, i, body, first_row, table_row, first_moment;
};
template <class Couplings> CUDA_CALLABLE inline CellSpan cell_span(const Couplings& c, int row) {
    const auto& chunk = c.chunk.data[row / CHUNK]; // first moment, count, first row of the body, first row of its table
    const int offset = row % CHUNK, left = chunk[1] - offset;
    return {row,      left < 0 ? 0 : left > WIDTH ? WIDTH : left, chunk[0] + offset, c.body.data[row / CHUNK], chunk[2],
            chunk[3], chunk[0] + offset - (row - chunk[2])};
}
template <class Couplings> CUDA_CALLABLE inline Rotation<Real> frame_of(const Couplings& c, const CellSpan& at) {
    Real q[4];
    put_product(c.rotation.data[at.body], c.grid.data[at.body], q);
    return rotation_of<Real>(q);
}

// Neighbors of the cells on a side, relative to their body, and the weights of the cells' own moments, of the
// neighbors', and of the cells' moments in the differences of the neighbors.
struct Neighbors {
    Index j;
    Number outward, inward, back;
};
template <class Couplings>
CUDA_CALLABLE inline Neighbors neighbors_at(const Couplings& c, const CellSpan& at, int side) {
    const size_t pitch = c.weight.strides[0] / sizeof(Real), row = at.table_row + (at.row - at.first_row);
    const Index j = indices(c.side.data + side * (c.side.strides[0] / sizeof(int)) + row);
    const Real *const weight = c.weight.data + side * pitch + row, *const inward = weight + 6 * pitch;
    const Number own = numbers(weight), zero = own * 0;
    const Number back = collect(c.weight.data + (6 + (side ^ 1)) * pitch + at.table_row, j);
    return {j, own, numbers(inward), mask_of(own > zero) ? back : zero}; // a cell without a neighbor has itself
}

// Factors of differences across layers.
template <class Couplings> CUDA_CALLABLE inline Vector layer_at(const Couplings& c, const CellSpan& at) {
    const size_t pitch = c.layer.strides[0] / sizeof(Real);
    const Real* const factors = c.layer.data + at.table_row + (at.row - at.first_row);
    return {numbers(factors), numbers(factors + pitch), numbers(factors + 2 * pitch)};
}

// Writes moments and half differences in the frame of the grid.
template <class Couplings> CUDA_CALLABLE inline void write_differences(const Couplings& c, const CellSpan& at) {
    const Rotation<Real> frame = frame_of(c, at);
    const Real* const world = (const Real*)c.moments.data + 3 * (size_t)at.first_moment;
    const Vector m = to_body(frame, vectors((const Real*)c.moments.data + 3 * (size_t)at.i, at.count));
    Number difference[3] = {m.x * 0, m.x * 0, m.x * 0};
    for (int side = 0; side < (c.has_slopes ? 6 : 0); ++side) {
        const int k = side / 2;
        const Neighbors other = neighbors_at(c, at, side);
        const Index place = 3 * other.j;
        const Number component = frame.rows[0][k] * collect(world, place) + frame.rows[1][k] * collect(world + 1, place)
                                 + frame.rows[2][k] * collect(world + 2, place);
        const Number change = other.inward * component - other.outward * (k == 0 ? m.x : k == 1 ? m.y : m.z);
        difference[k] += (side % 2 ? Real(0.25) : Real(-0.25)) * change;
    }
    if (share() != 0) return;
    put_row(c.body_moments, at.row, 0, m);
    put_vectors((Real*)c.means.data + 3 * (size_t)at.i, at.count, m);
    Vector along = {difference[0], difference[1], difference[2]};
    if (c.has_layers) along = layer_differences(layer_at(c, at), along);
    put_vectors((Real*)c.differences.data + 3 * (size_t)at.i, at.count, along);
    put_vectors((Real*)c.difference_field.data + 3 * (size_t)at.i, at.count, {m.x * 0, m.x * 0, m.x * 0});
}

// Writes the fields that act on differences between neighbors by rows.
template <class Couplings> CUDA_CALLABLE inline void transpose_fields(const Couplings& c, const CellSpan& at) {
    if (share() != 0) return;
    Vector fields = vectors((const Real*)c.difference_field.data + 3 * (size_t)at.i, at.count);
    if (c.has_layers) fields = layer_fields(layer_at(c, at), fields);
    put_row(c.fields, at.row, 0, fields);
}

// Dᵀ of the field of differences.
template <class Couplings> CUDA_CALLABLE inline Vector gathered(const Couplings& c, const CellSpan& at) {
    const size_t pitch = c.fields.strides[0] / sizeof(Real);
    Number h[3];
    for (int k = 0; k < 3; ++k) {
        const Real* const field = c.fields.data + k * pitch + at.first_row;
        const Number own = numbers(c.fields.data + k * pitch + at.row);
        h[k] = own * 0;
        if (!c.has_slopes) continue;
        for (int side = 2 * k; side < 2 * k + 2; ++side) {
            const Neighbors other = neighbors_at(c, at, side);
            const Number sum = other.outward * own + other.back * collect(field, other.j);
            h[k] += (side % 2 ? Real(-0.25) : Real(0.25)) * sum;
        }
    }
    return {h[0], h[1], h[2]};
}

// Makes a pass over the cells from ``row`` on.
template <class Couplings> CUDA_CALLABLE inline void make_cell_pass(const Couplings& c, int pass, int row) {
    const CellSpan at = cell_span(c, row);
    if (at.count == 0) return;
    if (pass == DIFFERENCES) return write_differences(c, at);
    if (pass == TRANSPOSE) return transpose_fields(c, at);
    if (pass == UNIFORM_FIELD) {
        if (row == c.rows.data[at.body][0]) write_uniform_field(c, at.body);
        return;
    }
    const int table_row = at.table_row + (row - at.first_row);
    const Vector sums = sum_entries(c, c.body_moments.data + at.first_row, table_row);
    if (share() != 0) return;
    const Real* const common = c.common.data + 3 * (size_t)at.body;
    const Number zero = Number(Real(0));
    const Vector shared = {zero + common[0], zero + common[1], zero + common[2]};
    Real* const h = (Real*)c.h.data + 3 * (size_t)at.i;
    put_vectors(h, at.count, vectors(h, at.count) + to_world(frame_of(c, at), gathered(c, at) + sums + shared));
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
