// Collective response of a body of few cells to the field of everything else, in the frame of the body;
// body_response.py has the equations.
//
// On a GPU a block of threads works on a body, and a group of threads on a cell. On a CPU a thread works on a body,
// with its cells in vectors. Takes MOST_CELLS, COMPONENTS and the constants of theta_flow.h; ``Bodies`` is the struct
// of body_response.py.
#pragma once
#include "cells/rotation.h"
#include "induction/theta_flow.h"

namespace warpmag {

constexpr int MOST_STEPS = 24;     // of conjugate gradients
constexpr double TOLERANCE = 0.05; // relative residual at which one more step suffices

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

// A body, and the memory that its threads share: a vector per cell, and partial sums.
struct InducibleBody {
    int cells;
    const Real *full, *pair_law; // tables of tensors, as in body_response.py
    Real* vectors;
    double* parts;
};

// A vector of the body's cells, one per lane. Fields and moments are in the body's frame, except ``outside``.
struct Cell {
    int number;
    Span at;
    Material material;
    Number radius, scale; // scale = k/Ms
    Number across, along; // √(k V) D^½ perpendicular to s, and along s
    Vector axis, s, outside, residual, direction, field, along_direction, correction;
};

// Calls visit(cell) for the vectors of cells of this thread.
template <class Visit> CUDA_CALLABLE inline void for_cells(const InducibleBody& body, Cell* cells, Visit visit) {
#pragma unroll
    for (int k = 0; k < VECTORS; ++k)
        if (k < vectors_of(body.cells)) visit(cells[k]);
}

// Σ_j T_ij v_j by a table, of the vectors in shared memory.
CUDA_CALLABLE inline Vector sum_cells(const InducibleBody& body, const Real* table, int cell) {
    const Real* const rows = table + (size_t)(cell / CHUNK) * (COMPONENTS * CHUNK) * body.cells + cell % CHUNK;
    const int end = cell < body.cells ? body.cells : 0;
    Vector h = {0, 0, 0};
#pragma unroll 4
    for (int j = share(); j < end; j += SHARES) {
        const Real* const t = rows + (size_t)j * (COMPONENTS * CHUNK);
        const Real x = body.vectors[j], y = body.vectors[MOST_CELLS + j], z = body.vectors[2 * MOST_CELLS + j];
        auto component = [=](int c) { return numbers(t + c * CHUNK); };
        if constexpr (COMPONENTS == 9) {
            h += Vector{component(0) * x + component(1) * y + component(2) * z,
                        component(3) * x + component(4) * y + component(5) * z,
                        component(6) * x + component(7) * y + component(8) * z};
            continue;
        }
        const Number xx = component(0), yy = component(1), zz = component(2);
        const Number xy = component(3), xz = component(4), yz = component(5);
        h += Vector{xx * x + xy * y + xz * z, xy * x + yy * y + yz * z, xz * x + yz * y + zz * z};
    }
    return group_sums(h);
}

// Sets each cell's field to the body's own field T m for moments vector(cell).
template <class VectorOf>
CUDA_CALLABLE inline void apply_tensors(const InducibleBody& body, Cell* cells, VectorOf vector) {
    wait_for_body();
    for_cells(body, cells, [&](Cell& cell) {
        const Vector v = vector(cell);
        if (share() != 0) return;
        put_first(body.vectors + cell.number, cell.at.count, v.x);
        put_first(body.vectors + MOST_CELLS + cell.number, cell.at.count, v.y);
        put_first(body.vectors + 2 * MOST_CELLS + cell.number, cell.at.count, v.z);
    });
    wait_for_body();
    for_cells(body, cells, [&](Cell& cell) { cell.field = sum_cells(body, body.full, cell.number); });
}

struct Pair {
    double first, second;
};

// Sums of two numbers of each cell over the body, returned to all of its threads.
template <class NumbersOf>
CUDA_CALLABLE inline Pair sums_of_body(const InducibleBody& body, Cell* cells, NumbersOf numbers_of) {
    Pair total = {0, 0};
#if defined(__CUDA_ARCH__)
    if (cells[0].at.count > 0 && share() == 0) numbers_of(cells[0], total.first, total.second);
    for (int step = 1; step < 32; step *= 2) {
        total.first += __shfl_xor_sync(~0u, total.first, step);
        total.second += __shfl_xor_sync(~0u, total.second, step);
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
        for (int l = 0; l < cell.at.count; ++l) total.first += first[l], total.second += second[l];
    });
#endif
    return total;
}

// √(k V) D^½ v, with D the derivative of the reduced magnetization by s.
CUDA_CALLABLE inline Vector weighted(const Cell& cell, Vector v) {
    return cell.across * v + (cell.along - cell.across) * dot(cell.axis, v) * cell.axis;
}

// Sets the weights of a cell at its present s.
CUDA_CALLABLE inline void set_weights(Cell& cell) {
    const Number length_s = length(cell.s), ratio = curve_ratio(length_s, cell.material.curves);
    const Number reduced = ratio * length_s, steepness = curve_steepness(reduced * reduced, cell.material.curves);
    const Number volume = Real(4.18879020478639) * cell.radius * cell.radius * cell.radius;
    const Number size = root(cell.material.slope * volume), zero = size * 0;
    cell.across = size * root(ratio);
    cell.along = size * root(larger(steepness, zero));
    cell.axis = (length_s > zero ? 1 / length_s : zero) * cell.s;
}

// One step of Newton's method from s with residual r: s ← s + r + (k/Ms) T E z. Conjugate gradients with one reduction
// per step solve (1 − E T E) z = E r Ms/k (Chronopoulos and Gear 1989).
CUDA_CALLABLE inline void newton_step(const InducibleBody& body, Cell* cells) {
    for_cells(body, cells, [&](Cell& cell) {
        set_weights(cell);
        cell.s += cell.residual;
        cell.residual = 1 / cell.scale * weighted(cell, cell.residual);
        cell.direction = cell.along_direction = cell.correction = {0, 0, 0};
    });
    double first = 0, before = 0, length_before = 0;
    for (int step = 0; step < MOST_STEPS; ++step) {
        apply_tensors(body, cells, [](const Cell& cell) { return weighted(cell, cell.residual); });
        const Pair sums = sums_of_body(body, cells, [&](Cell& cell, Wide& square, Wide& curvature) {
            square = wide_dot(cell.residual, cell.residual);
            curvature = wide_dot(cell.residual, cell.residual - weighted(cell, cell.field));
        });
        const double beta = step > 0 ? sums.first / before : 0;
        const double curvature = sums.second - (step > 0 ? beta * sums.first / length_before : 0);
        if (!(curvature > 0)) break;
        const double length = sums.first / curvature;
        for_cells(body, cells, [&](Cell& cell) {
            cell.direction = cell.residual + (Real)beta * cell.direction;
            cell.along_direction = cell.field + (Real)beta * cell.along_direction;
            cell.correction += (Real)length * cell.along_direction;
            const Vector change = cell.direction - weighted(cell, cell.along_direction);
            cell.residual -= (Real)length * change;
        });
        if (step == 0) first = sums.first;
        if (sums.first <= TOLERANCE * TOLERANCE * first) break;
        before = sums.first;
        length_before = length;
    }
    for_cells(body, cells, [](Cell& cell) { cell.s = cell.s + cell.scale * cell.correction; });
}

// Subtracts ``weight`` times the body's own field at its ``past`` solution from the outside field.
template <class State, class Bodies>
CUDA_CALLABLE inline void subtract_own_field(State& state, const Bodies& bodies, int b, const InducibleBody& body,
                                             Cell* cells, int past, Real weight) {
    const Rotation<Real> rotation = rotation_of<Real>(bodies.past.data[past * bodies.body.shape[0] + b]);
    apply_tensors(body, cells, [&](const Cell& cell) {
        return moments_of(cell.material, cell.radius, to_body(rotation, get(state.past_g, cell.at, past)));
    });
    for_cells(body, cells, [&](Cell& cell) { cell.outside = cell.outside - weight * to_world(rotation, cell.field); });
}

// Reads the cells of body b, with the summed field as outside field. At the start of a solve the outside field is the
// applied field, or is extrapolated from the last solves.
template <class State, class Bodies>
CUDA_CALLABLE inline void read_cells(State& state, const Bodies& bodies, int b, const InducibleBody& body, Cell* cells,
                                     bool begin, const Rotation<Real>& rotation) {
    const auto& row = bodies.body.data[b]; // first moment, cells, world, index of the rotation
    const bool steady = begin && state.warm.data[row[2]] == STEADY;
#pragma unroll
    for (int k = 0; k < VECTORS; ++k) {
        if (k >= vectors_of(body.cells)) continue;
        Cell& cell = cells[k];
        cell.number = first_cell(k);
        const int left = body.cells - cell.number, count = left < 0 ? 0 : left > WIDTH ? WIDTH : left;
        const int offset = count > 0 ? cell.number : 0;
        cell.at = {0, row[0] + offset, count, row[2], 0, 0};
        cell.material = material_of(state, cell.at);
        cell.radius = numbers_or(entries(state.packed, cell.at, 3), count, 0);
        cell.scale = cell.material.slope / cell.material.saturation;
        cell.s = to_body(rotation, get(state.s, cell.at));
        cell.outside = get(begin ? state.h0 : state.h, cell.at);
        if (steady) cell.outside = 1 / cell.scale * get(state.mixed_g, cell.at);
    }
    if (!steady) return;
    const Real ahead = (Real)state.worlds.data[row[2]].ahead;
    subtract_own_field(state, bodies, b, body, cells, 0, 1 + ahead);
    subtract_own_field(state, bodies, b, body, cells, 1, -ahead);
}

// Computes the response of body b. At the start of a solve it writes dual variables and moments. After an evaluation it
// writes the field of the response, from which the θ flow continues.
template <class State, class Bodies>
CUDA_CALLABLE inline void respond(State& state, const Bodies& bodies, int b, bool begin, Real* vectors, double* parts) {
    const auto& row = bodies.body.data[b]; // first moment, cells, world, index of the rotation
    if (!state.worlds.data[row[2]].active) return;
    const Real* const table = bodies.tensor.data + bodies.table.data[b];
    const InducibleBody body = {row[1], table, table + bodies.pair_law.data[b], vectors, parts};
    const auto now = bodies.rotation.data[row[3]];
    const Rotation<Real> rotation = rotation_of<Real>(now);
    Cell cells[VECTORS];
    read_cells(state, bodies, b, body, cells, begin, rotation);
    auto moment = [](const Cell& cell) { return moments_of(cell.material, cell.radius, cell.s); };
    apply_tensors(body, cells, moment);
    for_cells(body, cells, [&](Cell& cell) {
        // the summed field contains the pair law between the body's own cells
        const Vector own = begin ? Vector{0, 0, 0} : sum_cells(body, body.pair_law, cell.number);
        const Vector outside = to_body(rotation, cell.outside) - own;
        cell.residual = cell.scale * (outside + cell.field) - cell.s;
    });
    newton_step(body, cells);
    const int warm = state.warm.data[row[2]];
    if (share() == 0)
        for_cells(body, cells, [&](Cell& cell) {
            const Vector s = to_world(rotation, cell.s);
            if (!begin) return set(state.h, cell.at, 1 / cell.scale * s);
            if (warm != 0 && warm != STEADY) return; // s is given, or too few solves to extrapolate
            set(state.s, cell.at, s);
            store_moments(state, cell.at, moments_of(cell.material, cell.radius, s));
        });
    if (!begin || first_cell(0) != 0 || share() != 0) return;
    bodies.past.data[bodies.body.shape[0] + b] = bodies.past.data[b];
    bodies.past.data[b] = now;
}

// Computes the responses of all bodies: on a GPU a block takes a body, on a CPU the threads share bodies.
template <class Word, class State, class Bodies>
CUDA_CALLABLE inline void respond_all(int thread, bool begin, int threads, Word* team, const Bodies& bodies,
                                      State& state) {
    if (thread == 0 && !begin) state.condition.data[0] = 0; // set again by any world that needs another evaluation
#if defined(__CUDA_ARCH__)
    __shared__ Real vectors[3 * MOST_CELLS];
    __shared__ double parts[2 * MOST_CELLS * GROUP / 32];
    respond(state, bodies, thread / blockDim.x, begin, vectors, parts);
#else
    share_items(team, threads, bodies.body.shape[0], 1, [&](int b) {
        Real vectors[3 * MOST_CELLS];
        respond(state, bodies, b, begin, vectors, nullptr);
    });
#endif
}
}
