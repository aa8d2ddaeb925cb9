// Translation of multipoles to local expansions on a GPU: a block takes CELLS cells of one octant through all
// displacements. A thread has 8 rows, of one parity class, of 8 cells in registers; SLICE harmonics of the sources at a
// time, and their columns of the matrix, are in shared memory.
#pragma once
#include "fmm/translate.h"

namespace warpmag {

struct alignas(16) Quad {
    Real x, y, z, w;
};
CUDA_CALLABLE inline Quad operator+(const Quad& a, const Quad& b) {
    return {a.x + b.x, a.y + b.y, a.z + b.z, a.w + b.w};
}
CUDA_CALLABLE inline Quad operator-(const Quad& a, const Quad& b) {
    return {a.x - b.x, a.y - b.y, a.z - b.z, a.w - b.w};
}
CUDA_CALLABLE inline Quad operator*(const Quad& a, const Quad& b) {
    return {a.x * b.x, a.y * b.y, a.z * b.z, a.w * b.w};
}

// Shared memory of a block. Rows of planes are 4 numbers longer, and planes 16, for different banks.
template <int CELLS, int SLICE> struct TranslationStage {
    static constexpr int ROW = CELLS + 4, PLANE = SLICE * ROW + 16;
    alignas(16) Real planes[MOST_SIGNS][PLANE];
    alignas(16) Real matrix[SLICE][ROWS];
    int sources[2][MOST_SIGNS][CELLS]; // of this magnitude and of the next
    int cells[CELLS], parents[CELLS];
    CellRun run;
};

// Finds the sources of each cell at a magnitude.
template <int CELLS, int THREADS, class Stage, class Arrays>
CUDA_CALLABLE inline void find_sources(Stage& stage, const Arrays& arrays, int (&sources)[MOST_SIGNS][CELLS], int code,
                                       int lane) {
    const int axes = signed_axes(code), items = signs_of(axes) * CELLS, none = (int)arrays.multipoles.shape[0] - 1;
    for (int item = lane; item < items; item += THREADS) {
        const int i = item / CELLS, l = item % CELLS;
        sources[i][l] = source_cell(arrays, stage.parents[l], stage.run.octant, code, deposit_axes(i, axes), none);
    }
}

// Puts the sums over signs of N sources of each cell into their planes, SLICE harmonics from the first on.
template <int N, int CELLS, int SLICE, int THREADS, class Stage, class Arrays>
CUDA_CALLABLE inline void fill_planes(Stage& stage, const Arrays& arrays, const int (&sources)[MOST_SIGNS][CELLS],
                                      int axes, int first, int lane) {
    constexpr int QUADS = SLICE / 4;
    for (int item = lane; item < CELLS * QUADS; item += THREADS) {
        // two quads side by side of 16 cells for a warp: whole sectors are read, and no bank is written to twice
        const int quad = item / 16 % QUADS, cell = item / (16 * QUADS) * 16 + item % 16, k = first + 4 * quad;
        const Quad sign = *(const Quad*)(arrays.signs.data + stage.run.octant * PITCH + k);
        Quad values[N];
#pragma unroll
        for (int i = 0; i < N; ++i)
            values[i] = sign * *(const Quad*)(arrays.multipoles.data + PITCH * (size_t)sources[i][cell] + k);
        transform_signs<N>(values);
        const int* const parity = arrays.parity.data + k;
#pragma unroll
        for (int c = 0; c < 4; ++c) {
            const int mirror = extract_axes(parity[c], axes);
#pragma unroll
            for (int i = 0; i < N; ++i)
                stage.planes[i ^ mirror][(4 * quad + c) * Stage::ROW + cell] = ((const Real*)&values[i])[c];
        }
    }
}

// One thread of the block that translates to the cells of a run.
template <int CELLS, int SLICE, class Arrays>
CUDA_CALLABLE inline void translate_block(int thread, const Arrays& arrays) {
    constexpr int COLUMNS = CELLS / 8, USED = COLUMNS * (ROWS / 8), THREADS = (USED + 31) / 32 * 32;
    constexpr int LENGTH = (HARMONICS + SLICE - 1) / SLICE * SLICE;
    typedef TranslationStage<CELLS, SLICE> Stage;
    __shared__ Stage stage;
    const int lane = thread % THREADS, column = 4 * (lane % COLUMNS), row = 8 * min(lane / COLUMNS, ROWS / 8 - 1);
    const int none = (int)arrays.multipoles.shape[0] - 1;
    if (lane == 0) stage.run = cell_run(arrays.octant_begin, CELLS, thread / THREADS);
    __syncthreads();
    const int begin = stage.run.begin, octant = stage.run.octant, count = stage.run.end - begin;
    if (count == 0) return;
    for (int l = lane; l < CELLS; l += THREADS) {
        const int cell = l < count ? arrays.order.data[begin + l] : none;
        stage.cells[l] = cell;
        stage.parents[l] = l < count ? arrays.parent.data[cell] : -1;
    }
    __syncthreads();
    int code = next_magnitude(0), turn = 0;
    find_sources<CELLS, THREADS>(stage, arrays, stage.sources[0], code, lane);
    const int row_class = arrays.row_parity.data[row];
    const Quad* matrix = (const Quad*)arrays.matrices.data;
    Real sums[8][8] = {};
    while (code < 64) {
        const int axes = signed_axes(code), signs = signs_of(axes), next = next_magnitude(code);
        const Real* const plane = stage.planes[extract_axes(row_class, axes)] + column;
#pragma unroll 1
        for (int first = 0; first < LENGTH; first += SLICE) {
            __syncthreads(); // what was staged before has been used
            const auto& sources = stage.sources[turn];
            if (signs == 8) fill_planes<8, CELLS, SLICE, THREADS>(stage, arrays, sources, axes, first, lane);
            else if (signs == 4) fill_planes<4, CELLS, SLICE, THREADS>(stage, arrays, sources, axes, first, lane);
            else if (signs == 2) fill_planes<2, CELLS, SLICE, THREADS>(stage, arrays, sources, axes, first, lane);
            else fill_planes<1, CELLS, SLICE, THREADS>(stage, arrays, sources, axes, first, lane);
            constexpr int QUADS = SLICE * ROWS / 4;
            for (int i = lane; i < QUADS; i += THREADS) ((Quad*)stage.matrix)[i] = matrix[i];
            matrix += QUADS;
            if (first == 0 && next < 64)
                find_sources<CELLS, THREADS>(stage, arrays, stage.sources[1 - turn], next, lane);
            __syncthreads();
#pragma unroll
            for (int k = 0; k < SLICE; ++k) {
                const Quad a[2] = {*(const Quad*)&stage.matrix[k][row], *(const Quad*)&stage.matrix[k][row + 4]};
                const Real* const sourced = plane + k * Stage::ROW;
                const Quad b[2] = {*(const Quad*)sourced, *(const Quad*)(sourced + CELLS / 2)};
#pragma unroll
                for (int r = 0; r < 8; ++r)
#pragma unroll
                    for (int c = 0; c < 8; ++c) sums[r][c] += ((const Real*)a)[r] * ((const Real*)b)[c];
            }
        }
        code = next;
        turn = 1 - turn;
    }
    if (lane >= USED) return;
#pragma unroll
    for (int r = 0; r < 8; ++r) {
        const int k = arrays.row_harmonic.data[row + r];
        if (k < 0) continue;
        const Real sign = arrays.signs.data[octant * PITCH + k];
#pragma unroll
        for (int c = 0; c < 8; ++c) {
            const int l = column + c % 4 + c / 4 * (CELLS / 2);
            if (l < count) arrays.locals.data[PITCH * (size_t)stage.cells[l] + k] = sign * sums[r][c];
        }
    }
}

}
