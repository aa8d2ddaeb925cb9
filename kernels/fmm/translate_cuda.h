// Multipole-to-local translation on a GPU: a block takes BOXES boxes of one octant through all displacements. A thread
// holds GROUP_ROWS rows (8, or 6 padded to 8) of one parity class for 8 boxes in registers. Shared memory holds SLICE
// harmonics of the sources at a time, and the matching columns of the matrix.
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

// Shared memory of a block. Rows of planes are padded by 4 numbers, and planes by 16, to avoid bank conflicts.
template <int BOXES, int SLICE> struct TranslationStage {
    static constexpr int ROW = BOXES + 4, PLANE = SLICE * ROW + 16;
    alignas(16) Real planes[MOST_SIGNS][PLANE];
    alignas(16) Real matrix[2][SLICE][ROWS]; // this slice and the next
    int sources[2][MOST_SIGNS][BOXES];       // this magnitude and the next
    int boxes[BOXES], parents[BOXES];
    BoxRun run;
};

// Finds the source boxes of each box at a magnitude.
template <int BOXES, int THREADS, class Stage, class Arrays>
CUDA_CALLABLE inline void find_sources(Stage& stage, const Arrays& arrays, int (&sources)[MOST_SIGNS][BOXES], int code,
                                       int lane) {
    const int axes = signed_axes(code), items = signs_of(axes) * BOXES, no_box = (int)arrays.multipoles.shape[0] - 1;
    for (int item = lane; item < items; item += THREADS) {
        const int i = item / BOXES, l = item % BOXES;
        sources[i][l] = source_box(arrays, stage.parents[l], stage.run.octant, code, deposit_axes(i, axes), no_box);
    }
}

// Starts an asynchronous copy of ``bytes``, a multiple of 16, to shared memory. wait_for_copies waits for the copies of
// this thread.
template <int THREADS> CUDA_CALLABLE inline void start_copy(void* to, const void* from, int bytes, int lane) {
    const unsigned address = (unsigned)__cvta_generic_to_shared(to);
    for (int i = 16 * lane; i < bytes; i += 16 * THREADS)
        asm volatile("cp.async.cg.shared.global [%0], [%1], 16;" : : "r"(address + i), "l"((const char*)from + i));
}
CUDA_CALLABLE inline void wait_for_copies() { asm volatile("cp.async.wait_all;" : : : "memory"); }

// A thread's part of loading a slice of harmonics of N sources per box into shared memory.
template <int N, int BOXES, int SLICE, int THREADS> struct Slice {
    static constexpr int QUADS = SLICE / 4, ITEMS = BOXES * QUADS, ROUNDS = (ITEMS + THREADS - 1) / THREADS;
    Quad values[ROUNDS][N];

    // a warp reads two adjacent quads of 16 boxes: whole sectors, and no bank conflicts on writing
    static CUDA_CALLABLE int quad(int item) { return 4 * (item / 16 % QUADS); }
    static CUDA_CALLABLE int box(int item) { return item / (16 * QUADS) * 16 + item % 16; }

    template <class Arrays>
    CUDA_CALLABLE void load(const Arrays& arrays, const int (&sources)[MOST_SIGNS][BOXES], int first, int lane) {
#pragma unroll
        for (int n = 0; n < ROUNDS; ++n) {
            const int item = lane + n * THREADS;
            if (ITEMS % THREADS && item >= ITEMS) break;
            const Real* const harmonics = arrays.multipoles.data + first + quad(item);
#pragma unroll
            for (int i = 0; i < N; ++i)
                values[n][i] = *(const Quad*)(harmonics + PITCH * (size_t)sources[i][box(item)]);
        }
    }

    // Transforms the sources, and writes them into their planes.
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
                Real* const to = stage.planes[0] + (quad(item) + c) * Stage::ROW + box(item);
#pragma unroll
                for (int i = 0; i < N; ++i) to[(i ^ mirror) * Stage::PLANE] = ((const Real*)&values[n][i])[c];
            }
        }
    }
};

// Adds the products of a thread's rows with 8 boxes for the slice in shared memory.
template <int BOXES, int SLICE, int ROW>
CUDA_CALLABLE inline void add_products(Real (&sums)[GROUP_ROWS][8], const Real* matrix, const Real* plane) {
#pragma unroll
    for (int k = 0; k < SLICE; ++k, matrix += ROWS, plane += ROW) {
        const Quad a[2] = {*(const Quad*)matrix, *(const Quad*)(matrix + 4)};
        const Quad b[2] = {*(const Quad*)plane, *(const Quad*)(plane + BOXES / 2)};
#pragma unroll
        for (int r = 0; r < GROUP_ROWS; ++r)
#pragma unroll
            for (int c = 0; c < 8; ++c) sums[r][c] += ((const Real*)a)[r] * ((const Real*)b)[c];
    }
}

// A thread's rows and boxes, and their sums.
template <int BOXES, int SLICE, int SPLITS> struct Translator {
    static constexpr int COLUMNS = BOXES / 8, USED = COLUMNS * (ROWS / 8), THREADS = (USED + 31) / 32 * 32;
    static constexpr int LENGTH = (HARMONICS + SLICE - 1) / SLICE * SLICE;
    typedef TranslationStage<BOXES, SLICE> Stage;
    int lane, column, row, row_class, stage_index = 0, buffer = 0;
    const Real* matrix; // next slice to copy
    Real sums[GROUP_ROWS][8] = {};

    CUDA_CALLABLE void copy_matrix(Stage& stage, int to) {
        constexpr int SIZE = SLICE * ROWS;
        start_copy<THREADS>(stage.matrix[to], matrix, SIZE * (int)sizeof(Real), lane);
        matrix += SIZE;
    }

    // Adds all displacements of one magnitude; ``next`` is the magnitude that follows.
    template <int N, class Arrays>
    CUDA_CALLABLE void translate(Stage& stage, const Arrays& arrays, int code, int next) {
        const int axes = signed_axes(code);
        const Real* const plane = stage.planes[extract_axes(row_class, axes)] + column;
#pragma unroll 1
        for (int first = 0; first < LENGTH; first += SLICE) {
            Slice<N, BOXES, SLICE, THREADS> slice;
            slice.load(arrays, stage.sources[stage_index], first, lane);
            __syncthreads(); // the previous slice is no longer read
            slice.store(stage, arrays, axes, first, lane);
            if (first == 0 && next < 64)
                find_sources<BOXES, THREADS>(stage, arrays, stage.sources[1 - stage_index], next, lane);
            wait_for_copies();
            __syncthreads();
            const bool more = first + SLICE < LENGTH;
            if (!more) matrix += (SPLITS - 1) * LENGTH * ROWS;
            if (more || next < 64) copy_matrix(stage, 1 - buffer);
            add_products<BOXES, SLICE, Stage::ROW>(sums, &stage.matrix[buffer][0][row], plane);
            buffer = 1 - buffer;
        }
        stage_index = 1 - stage_index;
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
                const int l = column + c % 4 + c / 4 * (BOXES / 2);
                if (l < count) out[PITCH * (size_t)stage.boxes[l] + k] = sign * sums[r][c];
            }
        }
    }
};

// The magnitude ``steps`` after ``code``.
CUDA_CALLABLE inline int later_magnitude(int code, int steps) {
    for (int i = 0; i < steps; ++i) code = next_magnitude(code);
    return code;
}

// One thread of a block that computes the local expansions of a run of boxes. Where boxes are few for the GPU, SPLITS
// blocks share the magnitudes of a run, and each writes partial sums of its own.
template <int BOXES, int SLICE, int SPLITS, class Arrays>
CUDA_CALLABLE inline void translate_block(int thread, const Arrays& arrays) {
    typedef Translator<BOXES, SLICE, SPLITS> ThreadState;
    __shared__ TranslationStage<BOXES, SLICE> stage;
    const int lane = thread % ThreadState::THREADS, no_box = (int)arrays.multipoles.shape[0] - 1;
    const int block = thread / ThreadState::THREADS, split = block % SPLITS;
    if (lane == 0) stage.run = box_run(arrays.octant_begin, BOXES, block / SPLITS);
    __syncthreads();
    const int begin = stage.run.begin, count = stage.run.end - begin;
    if (count == 0) return;
    for (int l = lane; l < BOXES; l += ThreadState::THREADS) {
        stage.boxes[l] = l < count ? arrays.order.data[begin + l] : no_box;
        stage.parents[l] = l < count ? arrays.parent.data[stage.boxes[l]] : -1;
    }
    __syncthreads();
    ThreadState self = {lane, 4 * (lane % ThreadState::COLUMNS), 8 * min(lane / ThreadState::COLUMNS, ROWS / 8 - 1)};
    self.row_class = arrays.row_parity.data[self.row];
    self.matrix = arrays.matrices.data + split * ThreadState::LENGTH * ROWS;
    self.copy_matrix(stage, 0);
    int code = later_magnitude(0, 1 + split);
    find_sources<BOXES, ThreadState::THREADS>(stage, arrays, stage.sources[0], code, lane);
    __syncthreads();
    while (code < 64) {
        const int next = later_magnitude(code, SPLITS), signs = signs_of(signed_axes(code));
        if (signs == 8) self.template translate<8>(stage, arrays, code, next);
        else if (signs == 4) self.template translate<4>(stage, arrays, code, next);
        else if (signs == 2) self.template translate<2>(stage, arrays, code, next);
        else self.template translate<1>(stage, arrays, code, next);
        code = next;
    }
    const size_t size = (size_t)arrays.locals.shape[0] * PITCH;
    self.write(stage, arrays, count, SPLITS == 1 ? arrays.locals.data : arrays.parts.data + split * size);
}

}
