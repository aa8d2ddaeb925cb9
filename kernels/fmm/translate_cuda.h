// Translation of multipoles to local expansions on a GPU: a block takes CELLS cells of one octant through all
// displacements. A thread has GROUP_ROWS rows (8, or 6 in 8 places), of one parity class, of 8 cells in registers;
// SLICE harmonics of the sources at a time, and their columns of the matrix, are in shared memory.
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
    alignas(16) Real matrix[2][SLICE][ROWS]; // of this slice and of the next
    int sources[2][MOST_SIGNS][CELLS];       // of this magnitude and of the next
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

// Starts copying ``bytes``, a multiple of 16, to shared memory, and waits for what this thread has started.
template <int THREADS> CUDA_CALLABLE inline void start_copy(void* to, const void* from, int bytes, int lane) {
    const unsigned there = (unsigned)__cvta_generic_to_shared(to);
    for (int i = 16 * lane; i < bytes; i += 16 * THREADS)
        asm volatile("cp.async.cg.shared.global [%0], [%1], 16;" : : "r"(there + i), "l"((const char*)from + i));
}
CUDA_CALLABLE inline void wait_for_copies() { asm volatile("cp.async.wait_all;" : : : "memory"); }

// What a thread brings to shared memory for a slice of harmonics of N sources of some cells.
template <int N, int CELLS, int SLICE, int THREADS> struct Slice {
    static constexpr int QUADS = SLICE / 4, ITEMS = CELLS * QUADS, ROUNDS = (ITEMS + THREADS - 1) / THREADS;
    Quad values[ROUNDS][N];

    // two quads side by side of 16 cells for a warp: whole sectors are read, and no bank is written to twice
    static CUDA_CALLABLE int quad(int item) { return 4 * (item / 16 % QUADS); }
    static CUDA_CALLABLE int cell(int item) { return item / (16 * QUADS) * 16 + item % 16; }

    template <class Arrays>
    CUDA_CALLABLE void load(const Arrays& arrays, const int (&sources)[MOST_SIGNS][CELLS], int first, int lane) {
#pragma unroll
        for (int n = 0; n < ROUNDS; ++n) {
            const int item = lane + n * THREADS;
            if (ITEMS % THREADS && item >= ITEMS) break;
            const Real* const harmonics = arrays.multipoles.data + first + quad(item);
#pragma unroll
            for (int i = 0; i < N; ++i)
                values[n][i] = *(const Quad*)(harmonics + PITCH * (size_t)sources[i][cell(item)]);
        }
    }

    // Puts the sums over signs into their planes.
    template <class Stage, class Arrays>
    CUDA_CALLABLE void store(Stage& stage, const Arrays& arrays, int axes, int first, int lane) {
#pragma unroll
        for (int n = 0; n < ROUNDS; ++n) {
            const int item = lane + n * THREADS;
            if (ITEMS % THREADS && item >= ITEMS) break;
            const int k = first + quad(item);
            const Quad sign = *(const Quad*)(arrays.signs.data + stage.run.octant * PITCH + k);
#pragma unroll
            for (int i = 0; i < N; ++i) values[n][i] = sign * values[n][i];
            transform_signs<N>(values[n]);
#pragma unroll
            for (int c = 0; c < 4; ++c) {
                const int mirror = extract_axes(arrays.parity.data[k + c], axes);
                Real* const to = stage.planes[0] + (quad(item) + c) * Stage::ROW + cell(item);
#pragma unroll
                for (int i = 0; i < N; ++i) to[(i ^ mirror) * Stage::PLANE] = ((const Real*)&values[n][i])[c];
            }
        }
    }
};

// Adds the products of a thread's rows and 8 cells for the slice in shared memory.
template <int CELLS, int SLICE, int ROW>
CUDA_CALLABLE inline void add_products(Real (&sums)[GROUP_ROWS][8], const Real* matrix, const Real* plane) {
#pragma unroll
    for (int k = 0; k < SLICE; ++k, matrix += ROWS, plane += ROW) {
        const Quad a[2] = {*(const Quad*)matrix, *(const Quad*)(matrix + 4)};
        const Quad b[2] = {*(const Quad*)plane, *(const Quad*)(plane + CELLS / 2)};
#pragma unroll
        for (int r = 0; r < GROUP_ROWS; ++r)
#pragma unroll
            for (int c = 0; c < 8; ++c) sums[r][c] += ((const Real*)a)[r] * ((const Real*)b)[c];
    }
}

// A thread of the block, its rows and cells, and their sums.
template <int CELLS, int SLICE, int SPLITS> struct Translator {
    static constexpr int COLUMNS = CELLS / 8, USED = COLUMNS * (ROWS / 8), THREADS = (USED + 31) / 32 * 32;
    static constexpr int LENGTH = (HARMONICS + SLICE - 1) / SLICE * SLICE;
    typedef TranslationStage<CELLS, SLICE> Stage;
    int lane, column, row, row_class, turn = 0, buffer = 0;
    const Real* matrix; // of the next slice that is copied
    Real sums[GROUP_ROWS][8] = {};

    CUDA_CALLABLE void copy_matrix(Stage& stage, int to) {
        constexpr int SIZE = SLICE * ROWS;
        start_copy<THREADS>(stage.matrix[to], matrix, SIZE * (int)sizeof(Real), lane);
        matrix += SIZE;
    }

    // Translates displacements of one magnitude; ``next`` is the one that follows.
    template <int N, class Arrays>
    CUDA_CALLABLE void translate(Stage& stage, const Arrays& arrays, int code, int next) {
        const int axes = signed_axes(code);
        const Real* const plane = stage.planes[extract_axes(row_class, axes)] + column;
#pragma unroll 1
        for (int first = 0; first < LENGTH; first += SLICE) {
            Slice<N, CELLS, SLICE, THREADS> slice;
            slice.load(arrays, stage.sources[turn], first, lane);
            __syncthreads(); // what was staged before has been used
            slice.store(stage, arrays, axes, first, lane);
            if (first == 0 && next < 64)
                find_sources<CELLS, THREADS>(stage, arrays, stage.sources[1 - turn], next, lane);
            wait_for_copies();
            __syncthreads();
            const bool more = first + SLICE < LENGTH;
            if (!more) matrix += (SPLITS - 1) * LENGTH * ROWS;
            if (more || next < 64) copy_matrix(stage, 1 - buffer);
            add_products<CELLS, SLICE, Stage::ROW>(sums, &stage.matrix[buffer][0][row], plane);
            buffer = 1 - buffer;
        }
        turn = 1 - turn;
    }

    template <class Arrays>
    CUDA_CALLABLE void write(const Stage& stage, const Arrays& arrays, int count, Real* out) const {
        if (lane >= USED) return;
#pragma unroll
        for (int r = 0; r < GROUP_ROWS; ++r) {
            const int k = arrays.row_harmonic.data[row + r];
            if (k < 0) continue;
            const Real sign = arrays.signs.data[stage.run.octant * PITCH + k];
#pragma unroll
            for (int c = 0; c < 8; ++c) {
                const int l = column + c % 4 + c / 4 * (CELLS / 2);
                if (l < count) out[PITCH * (size_t)stage.cells[l] + k] = sign * sums[r][c];
            }
        }
    }
};

// The magnitude that follows another by some.
CUDA_CALLABLE inline int later_magnitude(int code, int steps) {
    for (int i = 0; i < steps; ++i) code = next_magnitude(code);
    return code;
}

// One thread of a block that translates to the cells of a run. SPLITS blocks share the magnitudes of a run, where there
// are few cells for many multiprocessors; each writes its own partial sums.
template <int CELLS, int SLICE, int SPLITS, class Arrays>
CUDA_CALLABLE inline void translate_block(int thread, const Arrays& arrays) {
    typedef Translator<CELLS, SLICE, SPLITS> Own;
    __shared__ TranslationStage<CELLS, SLICE> stage;
    const int lane = thread % Own::THREADS, none = (int)arrays.multipoles.shape[0] - 1;
    const int block = thread / Own::THREADS, split = block % SPLITS;
    if (lane == 0) stage.run = cell_run(arrays.octant_begin, CELLS, block / SPLITS);
    __syncthreads();
    const int begin = stage.run.begin, count = stage.run.end - begin;
    if (count == 0) return;
    for (int l = lane; l < CELLS; l += Own::THREADS) {
        stage.cells[l] = l < count ? arrays.order.data[begin + l] : none;
        stage.parents[l] = l < count ? arrays.parent.data[stage.cells[l]] : -1;
    }
    __syncthreads();
    Own own = {lane, 4 * (lane % Own::COLUMNS), 8 * min(lane / Own::COLUMNS, ROWS / 8 - 1)};
    own.row_class = arrays.row_parity.data[own.row];
    own.matrix = arrays.matrices.data + split * Own::LENGTH * ROWS;
    own.copy_matrix(stage, 0);
    int code = later_magnitude(0, 1 + split);
    find_sources<CELLS, Own::THREADS>(stage, arrays, stage.sources[0], code, lane);
    __syncthreads();
    while (code < 64) {
        const int next = later_magnitude(code, SPLITS), signs = signs_of(signed_axes(code));
        if (signs == 8) own.template translate<8>(stage, arrays, code, next);
        else if (signs == 4) own.template translate<4>(stage, arrays, code, next);
        else if (signs == 2) own.template translate<2>(stage, arrays, code, next);
        else own.template translate<1>(stage, arrays, code, next);
        code = next;
    }
    const size_t size = (size_t)arrays.locals.shape[0] * PITCH;
    own.write(stage, arrays, count, SPLITS == 1 ? arrays.locals.data : arrays.parts.data + split * size);
}

}
