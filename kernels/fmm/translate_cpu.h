// Multipole-to-local translation on a CPU: vectors run along boxes, threads along runs of boxes.
#pragma once
#include "fmm/translate.h"
#include "shared/lanes.h"
#include "shared/team.h"
#include "shared/transpose.h"

namespace warpmag::cpu {

// Buffers for a run of up to VECTORS vectors of boxes: planes of sources, and sums by row.
template <int VECTORS> struct Run {
    Number planes[MOST_SIGNS][PITCH][VECTORS];
    Number sums[ROWS][VECTORS];
    int sources[MOST_SIGNS][VECTORS * WIDTH];
};

// Transforms the N sources of each box, and writes them into their planes.
template <int N, int VECTORS, class Arrays>
__attribute__((noinline)) void fill_planes(Run<VECTORS>& run, const Arrays& arrays, int octant, int axes) {
    const Real* const signs = arrays.signs.data + octant * PITCH;
    for (int v = 0; v < VECTORS; ++v)
        for (int first = 0; first < PITCH; first += WIDTH) {
            Number rows[N][WIDTH];
            const Number sign = numbers(signs + first);
            for (int l = 0; l < WIDTH; ++l) {
                Number values[N];
                for (int i = 0; i < N; ++i) {
                    const size_t source = run.sources[i][v * WIDTH + l];
                    values[i] = sign * numbers(arrays.multipoles.data + PITCH * source + first);
                }
                transform_signs<N>(values);
                for (int i = 0; i < N; ++i) rows[i][l] = values[i];
            }
            for (int i = 0; i < N; ++i) {
                transpose<1>(rows[i], AllLanes());
                for (int l = 0; l < WIDTH; ++l) {
                    const int plane = i ^ extract_axes(arrays.parity.data[first + l], axes);
                    run.planes[plane][first + l][v] = rows[i][l];
                }
            }
        }
}

// Adds the product of a matrix with the planes of sources. Shape of matrix: [ROWS / GROUP_ROWS, HARMONICS, GROUP_ROWS].
template <int VECTORS>
__attribute__((noinline)) void add_product(Run<VECTORS>& run, const Real* matrix, const int* row_parity, int axes) {
    for (int row = 0; row < ROWS; row += GROUP_ROWS) {
        const Number(*const plane)[VECTORS] = run.planes[extract_axes(row_parity[row], axes)];
        Number sums[GROUP_ROWS][VECTORS];
        for (int r = 0; r < GROUP_ROWS; ++r)
            for (int v = 0; v < VECTORS; ++v) sums[r][v] = run.sums[row + r][v];
        for (int k = 0; k < HARMONICS; ++k, matrix += GROUP_ROWS)
            for (int r = 0; r < GROUP_ROWS; ++r)
                for (int v = 0; v < VECTORS; ++v) sums[r][v] += matrix[r] * plane[k][v];
        for (int r = 0; r < GROUP_ROWS; ++r)
            for (int v = 0; v < VECTORS; ++v) run.sums[row + r][v] = sums[r][v];
    }
}

// Writes the local expansions of a run of boxes.
template <int VECTORS, class Arrays> void translate_run(const Arrays& arrays, BoxRun boxes) {
    constexpr int WIDE = VECTORS * WIDTH;
    Run<VECTORS> run;
    __builtin_memset(run.sums, 0, sizeof(run.sums));
    const int no_box = (int)arrays.multipoles.shape[0] - 1, count = boxes.end - boxes.begin;
    const int* const order = arrays.order.data + boxes.begin;
    const Real* matrix = arrays.matrices.data;
    for (int code = next_magnitude(0); code < 64; code = next_magnitude(code), matrix += ROWS * HARMONICS) {
        const int axes = signed_axes(code), signs = signs_of(axes);
        bool occupied = false;
        for (int i = 0; i < signs; ++i)
            for (int l = 0; l < WIDE; ++l) {
                const int parent = l < count ? arrays.parent.data[order[l]] : -1;
                const int source = source_box(arrays, parent, boxes.octant, code, deposit_axes(i, axes), no_box);
                run.sources[i][l] = source;
                occupied |= source != no_box;
            }
        if (!occupied) continue;
        if (signs == 8) fill_planes<8>(run, arrays, boxes.octant, axes);
        else if (signs == 4) fill_planes<4>(run, arrays, boxes.octant, axes);
        else if (signs == 2) fill_planes<2>(run, arrays, boxes.octant, axes);
        else fill_planes<1>(run, arrays, boxes.octant, axes);
        add_product<VECTORS>(run, matrix, arrays.row_parity.data, axes);
    }
    for (int l = 0; l < count; ++l) {
        Real* const local = arrays.locals.data + PITCH * (size_t)order[l];
        for (int row = 0; row < ROWS; ++row) {
            const int k = arrays.row_harmonic.data[row];
            if (k >= 0) local[k] = arrays.signs.data[boxes.octant * PITCH + k] * run.sums[row][l / WIDTH][l % WIDTH];
        }
    }
}

// Writes the local expansions of all boxes in ``order``.
template <class Arrays> void translate(const Arrays& arrays, int threads, Word* team) {
    constexpr int WIDE = 2 * WIDTH;
    int runs = 0;
    for (int i = 0; i < 9 * (int)arrays.octant_begin.shape[0]; ++i) {
        const int* const begin = arrays.octant_begin.data + i;
        if (i % 9 < 8) runs += (begin[1] - begin[0] + WIDE - 1) / WIDE;
    }
    share_items(team, threads, runs, 1, [&](int index) {
        const BoxRun boxes = box_run(arrays.octant_begin, WIDE, index);
        if (boxes.end - boxes.begin > WIDTH) translate_run<2>(arrays, boxes);
        else translate_run<1>(arrays, boxes);
    });
}

}
