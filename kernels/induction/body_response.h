// Response of a body of few cells to the field of all others, in the frame of the body: body_response.py has the
// equations.
//
// On a GPU a block of threads has a body, and a group of them a cell; on a CPU a thread has a body, and takes its cells
// in vectors. Takes MOST_CELLS and what theta_flow.h does; ``Bodies`` is the struct of body_response.py.
#pragma once
#include "cells/rotation.h"
#include "induction/theta_flow.h"

namespace warpmag {

constexpr int MOST_STEPS = 24;  // of conjugate gradients
constexpr double ENOUGH = 0.05; // residual that one more step suffices for, over the first
constexpr int COMPONENTS = 6;   // of a symmetric tensor: xx, yy, zz, xy, xz, yz

#if defined(__CUDA_ARCH__)
constexpr int VECTORS = 1;
CUDA_CALLABLE inline int vectors_of(int) { return 1; }
CUDA_CALLABLE inline int first_cell(int) { return threadIdx.x / GROUP; }
CUDA_CALLABLE inline void wait_for_body() { __syncthreads(); }
#else
constexpr int VECTORS = (MOST_CELLS + WIDTH - 1) / WIDTH;
inline int vectors_of(int cells) { return (cells + WIDTH - 1) / WIDTH; }
inline int first_cell(int vector) { return WIDTH * vector; }
inline void wait_for_body() {}
#endif

// A body, and what its threads share: a vector of each cell, and parts of sums.
struct Body {
    int cells;
    const Real *whole, *law; // tables of tensors, as in body_response.py
    Real* vectors;
    double* parts;
};

// A vector of its cells; what has a direction is in the frame of the body.
struct Cell {
    int number;
    Place at;
    Material material;
    Number radius, scale, hardness; // scale = k/Ms
    Number across, along;           // √(k V) D^½ at right angles to s, and along it
    Vector axis, s, outside, residual, direction, field, along_direction, answer;
};

// Calls visit(cell) for the vectors of cells of this thread.
template <class Visit> CUDA_CALLABLE inline void for_cells(const Body& body, Cell* cells, Visit visit) {
#pragma unroll
    for (int k = 0; k < VECTORS; ++k)
        if (k < vectors_of(body.cells)) visit(cells[k]);
}

// Σ T_ij v_j by a table, of the vectors that the cells have shared.
CUDA_CALLABLE inline Vector sum_cells(const Body& body, const Real* table, int cell) {
    const Real* const own = table + (size_t)(cell / CHUNK) * (COMPONENTS * CHUNK) * body.cells + cell % CHUNK;
    const int end = cell < body.cells ? body.cells : 0;
    Vector h = {0, 0, 0};
#pragma unroll 4
    for (int j = share(); j < end; j += SHARES) {
        const Real* const t = own + (size_t)j * (COMPONENTS * CHUNK);
        const Real x = body.vectors[j], y = body.vectors[MOST_CELLS + j], z = body.vectors[2 * MOST_CELLS + j];
        const Number xx = numbers(t), yy = numbers(t + CHUNK), zz = numbers(t + 2 * CHUNK);
        const Number xy = numbers(t + 3 * CHUNK), xz = numbers(t + 4 * CHUNK), yz = numbers(t + 5 * CHUNK);
        h += Vector{xx * x + xy * y + xz * z, xy * x + yy * y + yz * z, xz * x + yz * y + zz * z};
    }
    return group_sums(h);
}

// Sets the field of the body whose cells have the moments vector(cell), in its frame; all of its threads see these.
template <class Of> CUDA_CALLABLE inline void apply_whole(const Body& body, Cell* cells, Of vector) {
    wait_for_body();
    for_cells(body, cells, [&](Cell& cell) {
        cell.field = vector(cell);
        if (share() != 0) return;
        put_first(body.vectors + cell.number, cell.at.held, cell.field.x);
        put_first(body.vectors + MOST_CELLS + cell.number, cell.at.held, cell.field.y);
        put_first(body.vectors + 2 * MOST_CELLS + cell.number, cell.at.held, cell.field.z);
    });
    wait_for_body();
    for_cells(body, cells,
              [&](Cell& cell) { cell.field = sum_cells(body, body.whole, cell.number) - cell.hardness * cell.field; });
}

struct Pair {
    double first, second;
};

// Sums of two numbers of each cell over the body, the same for all of its threads.
template <class Of> CUDA_CALLABLE inline Pair sums_of_body(const Body& body, Cell* cells, Of numbers_of) {
    Pair total = {0, 0};
#if defined(__CUDA_ARCH__)
    if (cells[0].at.held > 0 && share() == 0) numbers_of(cells[0], total.first, total.second);
    for (int other = 1; other < 32; other *= 2) {
        total.first += __shfl_xor_sync(~0u, total.first, other);
        total.second += __shfl_xor_sync(~0u, total.second, other);
    }
    Pair* const parts = (Pair*)body.parts;
    if (threadIdx.x % 32 == 0) parts[threadIdx.x / 32] = total;
    wait_for_body();
    total = {0, 0};
    for (int warp = 0; warp < blockDim.x / 32; ++warp) {
        total.first += parts[warp].first;
        total.second += parts[warp].second;
    }
#else
    for_cells(body, cells, [&](Cell& cell) {
        Wide first, second;
        numbers_of(cell, first, second);
        for (int l = 0; l < cell.at.held; ++l) total.first += first[l], total.second += second[l];
    });
#endif
    return total;
}

// √(k V) D^½ v, D the derivative of the reduced magnetization by s.
CUDA_CALLABLE inline Vector weighted(const Cell& cell, Vector v) {
    return cell.across * v + (cell.along - cell.across) * dot(cell.axis, v) * cell.axis;
}

CUDA_CALLABLE inline void take_weights(Cell& cell) {
    const Number length_s = length(cell.s), ratio = curve_ratio(length_s, cell.material.curves);
    const Number reduced = ratio * length_s, steepness = curve_steepness(reduced * reduced, cell.material.curves);
    const Number volume = Real(4.18879020478639) * cell.radius * cell.radius * cell.radius;
    const Number size = root(cell.material.slope * volume), zero = size * 0;
    cell.across = size * root(ratio);
    cell.along = size * root(larger(steepness, zero));
    cell.axis = (length_s > zero ? 1 / length_s : zero) * cell.s;
}

// Takes a step of Newton's method from s, where the residual is r: s + r + (k/Ms) T E z, (1 − E T E) z = E r Ms/k, by
// conjugate gradients that sum once a step (Chronopoulos and Gear 1989).
CUDA_CALLABLE inline void newton_step(const Body& body, Cell* cells) {
    for_cells(body, cells, [&](Cell& cell) {
        take_weights(cell);
        cell.s += cell.residual;
        cell.residual = 1 / cell.scale * weighted(cell, cell.residual);
        cell.direction = cell.along_direction = cell.answer = {0, 0, 0};
    });
    double first = 0, before = 0, length_before = 0;
    for (int step = 0; step < MOST_STEPS; ++step) {
        apply_whole(body, cells, [](const Cell& cell) { return weighted(cell, cell.residual); });
        const Pair sums = sums_of_body(body, cells, [&](Cell& cell, Wide& square, Wide& curvature) {
            square = wide_dot(cell.residual, cell.residual);
            curvature = wide_dot(cell.residual, cell.residual - weighted(cell, cell.field));
        });
        const double kept = step > 0 ? sums.first / before : 0;
        const double curvature = sums.second - (step > 0 ? kept * sums.first / length_before : 0);
        if (!(curvature > 0)) break;
        const double length = sums.first / curvature;
        for_cells(body, cells, [&](Cell& cell) {
            cell.direction = cell.residual + (Real)kept * cell.direction;
            cell.along_direction = cell.field + (Real)kept * cell.along_direction;
            cell.answer += (Real)length * cell.along_direction;
            const Vector change = cell.direction - weighted(cell, cell.along_direction);
            cell.residual -= (Real)length * change;
        });
        if (step == 0) first = sums.first;
        if (sums.first <= ENOUGH * ENOUGH * first) break;
        before = sums.first;
        length_before = length;
    }
    for_cells(body, cells, [](Cell& cell) { cell.s = cell.s + cell.scale * cell.answer; });
}

// Takes the body's own field at its ``past`` solution, times a weight, from the field in which it is to respond.
template <class State, class Bodies>
CUDA_CALLABLE inline void take_own_past(State& state, const Bodies& bodies, int b, const Body& body, Cell* cells,
                                        int past, Real weight) {
    const Rotation rotation = rotation_of(bodies.past.data[past * bodies.body.shape[0] + b]);
    apply_whole(body, cells, [&](const Cell& cell) {
        return moments_of(cell.material, cell.radius, turned_back(rotation, get(state.past_g, cell.at, past)));
    });
    for_cells(body, cells, [&](Cell& cell) { cell.outside = cell.outside - weight * turned(rotation, cell.field); });
}

// Reads the cells of body b, in the field of everything as it was summed, or at the start of a solve is expected.
template <class State, class Bodies>
CUDA_CALLABLE inline void read_cells(State& state, const Bodies& bodies, int b, const Body& body, Cell* cells,
                                     bool begin, const Rotation& rotation) {
    const auto& one = bodies.body.data[b];
    const bool steady = begin && state.warm.data[one[2]] == STEADY;
#pragma unroll
    for (int k = 0; k < VECTORS; ++k) {
        if (k >= vectors_of(body.cells)) continue;
        Cell& cell = cells[k];
        cell.number = first_cell(k);
        const int left = body.cells - cell.number, held = left < 0 ? 0 : left > WIDTH ? WIDTH : left;
        const int offset = held > 0 ? cell.number : 0;
        cell.at = {0, one[0] + offset, held, one[2], 0, 0};
        cell.material = material_of(state, cell.at);
        cell.radius = numbers_or(entries(state.packed, cell.at, 3), held, 0);
        cell.scale = cell.material.slope / cell.material.saturation;
        cell.hardness = numbers_or(bodies.hardness.data + bodies.row.data[b] + offset, held, 0);
        cell.s = turned_back(rotation, get(state.s, cell.at));
        cell.outside = get(begin ? state.h0 : state.h, cell.at);
        if (steady) cell.outside = 1 / cell.scale * get(state.mixed_g, cell.at);
    }
    if (!steady) return;
    const Real ahead = (Real)state.worlds.data[one[2]].ahead;
    take_own_past(state, bodies, b, body, cells, 0, 1 + ahead);
    take_own_past(state, bodies, b, body, cells, 1, -ahead);
}

// Lets body b respond, and writes where that leads: at the start of a solve its dual variables and moments, and later
// the field that they would have, in which the θ flow goes on.
template <class State, class Bodies>
CUDA_CALLABLE inline void respond(State& state, const Bodies& bodies, int b, bool begin, Real* vectors, double* parts) {
    const auto& one = bodies.body.data[b]; // first moment, cells, world, and number of the rotation
    if (!state.worlds.data[one[2]].active) return;
    const Real* const table = bodies.tensor.data + bodies.table.data[b];
    const Body body = {one[1], table, table + bodies.law.data[b], vectors, parts};
    const auto now = bodies.rotation.data[one[3]];
    const Rotation rotation = rotation_of(now);
    Cell cells[VECTORS];
    read_cells(state, bodies, b, body, cells, begin, rotation);
    auto moment = [](const Cell& cell) { return moments_of(cell.material, cell.radius, cell.s); };
    apply_whole(body, cells, moment);
    for_cells(body, cells, [&](Cell& cell) {
        // what was summed has the pair law between the body's own cells
        const Vector own = begin ? Vector{0, 0, 0} : sum_cells(body, body.law, cell.number);
        const Vector outside = turned_back(rotation, cell.outside) - own;
        cell.residual = cell.scale * (outside + cell.field) - cell.s;
    });
    newton_step(body, cells);
    const int warm = state.warm.data[one[2]];
    if (share() == 0)
        for_cells(body, cells, [&](Cell& cell) {
            const Vector s = turned(rotation, cell.s);
            if (!begin) return set(state.h, cell.at, 1 / cell.scale * s);
            if (warm != 0 && warm != STEADY) return; // s is given, or changes are not known yet
            set(state.s, cell.at, s);
            store_moments(state, cell.at, moments_of(cell.material, cell.radius, s));
        });
    if (!begin || first_cell(0) != 0 || share() != 0) return;
    bodies.past.data[bodies.body.shape[0] + b] = bodies.past.data[b];
    bodies.past.data[b] = now;
}

template <class Word, class State, class Bodies>
CUDA_CALLABLE inline void respond_all(int thread, bool begin, int threads, Word* team, const Bodies& bodies,
                                      State& state) {
    if (thread == 0 && !begin) state.condition.data[0] = 0; // until a world wants another evaluation
#if defined(__CUDA_ARCH__)
    __shared__ Real vectors[3 * MOST_CELLS];
    __shared__ double parts[2 * MOST_CELLS * GROUP / 32];
    respond(state, bodies, thread / blockDim.x, begin, vectors, parts);
#else
    share_out(team, threads, bodies.body.shape[0], 1, [&](int b) {
        Real vectors[3 * MOST_CELLS];
        respond(state, bodies, b, begin, vectors, nullptr);
    });
#endif
}
}
