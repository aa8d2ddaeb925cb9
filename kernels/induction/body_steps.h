// Steps of bodies as a whole: the residuals r of a body's cells become r + w (Q − 1) r; body_steps.py has the
// equations.
//
// WRITE_RESIDUALS writes the residuals of cells in the frames of their bodies. WRITE_WEIGHTS writes the weight w of
// each body. CHANGE_FIELD multiplies the residuals by the table Q − 1, and adds the result to the field. Bodies with
// the same table form groups of at most ``MEMBERS``, so that a GPU reads the table once for several bodies; a CPU,
// whose caches hold the table, has groups of one. On a CPU a pass works on a vector of cells, on a GPU ``GROUP``
// threads have one cell.
// ``BodySteps`` is the struct of body_steps.py.
#pragma once
#include "cells/rotation.h"
#include "induction/spans.h"
#include "shared/group.h"
#include "shared/team.h"

namespace warpmag {

constexpr int ENTRY = 9 * CHUNK; // words of a table for a pair of sources and CHUNK targets

enum BodyPass { WRITE_RESIDUALS, WRITE_WEIGHTS, CHANGE_FIELD }; // as in body_steps.py

template <class Steps> CUDA_CALLABLE inline bool skips_steps(const Steps& steps, int world) {
    const auto& solve = steps.state.worlds.data[world];
    return solve.active == 0 || solve.apart > 0;
}
// Cells of a body from ``offset`` on.
template <class Steps> CUDA_CALLABLE inline Span cells_at(const Steps& steps, int body, int offset) {
    const auto& cells = steps.body.data[body]; // first moment, count, rotation, world
    const int left = cells[1] - offset;
    return {0, cells[0] + offset, left < 0 ? 0 : left > WIDTH ? WIDTH : left, cells[3], 0, 0};
}
template <class Steps> CUDA_CALLABLE inline Rotation<Real> rotation_of_body(const Steps& steps, int body) {
    return rotation_of<Real>(steps.rotation.data[steps.body.data[body][2]]);
}
// Address of the residuals of the first cell of a group. Each cell has the x, y and z of all members side by side.
template <class Steps> CUDA_CALLABLE inline Real* residuals_of(const Steps& steps, int group) {
    return (Real*)steps.residual.data + 3 * MEMBERS * (size_t)steps.group.data[group][3];
}

// Writes k H/Ms − s of the cells of a body from ``offset`` on.
template <class Steps> CUDA_CALLABLE inline void write_residuals(const Steps& steps, int body, int offset) {
    const Span at = cells_at(steps, body, offset);
    if (share() != 0 || at.count == 0 || skips_steps(steps, at.world)) return;
    const Number slope = numbers_or(entries(steps.state.slope, at), at.count, 0);
    const Number factor = slope / numbers_or(entries(steps.state.saturation, at), at.count, 1);
    const Vector residual = factor * get(steps.state.h, at) - get(steps.state.s, at);
    const Vector local = to_body(rotation_of_body(steps, body), residual);
    Real* const out = residuals_of(steps, body / MEMBERS) + body % MEMBERS;
    for (int l = 0; l < at.count; ++l) {
        Real* const to = out + 3 * MEMBERS * (size_t)(offset + l);
        to[0] = lane_of(local.x, l), to[MEMBERS] = lane_of(local.y, l), to[2 * MEMBERS] = lane_of(local.z, l);
    }
}

// Writes the weight of a body from the means of the shares d and the excesses e of its cells.
template <class Steps> CUDA_CALLABLE inline void write_weight(const Steps& steps, int body) {
    const auto& cells = steps.body.data[body];
    const auto& state = steps.state;
    if (cells[1] == 0 || skips_steps(steps, cells[3])) return;
    Number shares = Number(Real(0)), excesses = shares;
    const Number zero = shares, full = zero + 1;
    for (int k = WIDTH * share(); k < cells[1]; k += WIDTH * SHARES) {
        const Span at = cells_at(steps, body, k);
        const Number radius = numbers_or(entries(state.packed, at, 3), at.count, 0);
        const Number slope = numbers_or(entries(state.slope, at), at.count, 0);
        const Number saturation = numbers_or(entries(state.saturation, at), at.count, 1);
        const Number volume = Real(4.18879020478639) * radius * radius * radius;
        const Number most = volume * saturation * length(get(state.s, at)), moment = length(get(state.moments, at));
        const Number linear = mask_of(most > moment) ? moment / larger(most, moment) : full;
        shares += slope * (Real(1) / 3) * linear;
        const Number stiffness = Real(2 * FLOW_STEP) / numbers_or(entries(state.step, at), at.count, 2 * FLOW_STEP) - 1;
        excesses += larger(stiffness - slope * Real(2.0 / 3 + CONTACT), zero);
    }
    shares = group_sum(shares), excesses = group_sum(excesses);
    if (share() != 0) return;
    Real d = 0, e = 0;
    for (int l = 0; l < WIDTH; ++l) d += lane_of(shares, l), e += lane_of(excesses, l);
    const Real largest = steps.gain.data[body], least = 1 + (e - d * largest / (1 + largest)) / cells[1];
    const Real change = 1 / least - 1;
    steps.weight.data[body] = (change > 0 ? change : 0) / largest;
}

// Residuals of one component of a cell for all members of a group. A GPU reads four at a time.
struct Members {
    Real values[MEMBERS];
};
CUDA_CALLABLE inline Members members_at(const Real* at) {
    Members members;
#if defined(__CUDA_ARCH__)
    if constexpr (MEMBERS % 4 == 0) {
#pragma unroll
        for (int q = 0; q < MEMBERS / 4; ++q) ((Four*)members.values)[q] = ((const Four*)at)[q];
        return members;
    }
#endif
    for (int w = 0; w < MEMBERS; ++w) members.values[w] = at[w];
    return members;
}

// Adds the products of a table's column and a cell's residuals: ``element(k)`` is element k of the cell's tensor.
template <class Element>
CUDA_CALLABLE inline void add_products(const Real* residuals, Vector (&sums)[MEMBERS], Element element) {
#pragma unroll
    for (int c = 0; c < 3; ++c) {
        const Members members = members_at(residuals + c * MEMBERS);
        const Number x = element(c), y = element(3 + c), z = element(6 + c);
#pragma unroll
        for (int w = 0; w < MEMBERS; ++w) sums[w] += members.values[w] * Vector{x, y, z};
    }
}

// Adds the changes of the field at the cells of a group from ``offset`` on.
template <class Steps> CUDA_CALLABLE inline void add_changes(const Steps& steps, int group, int offset) {
    const auto& of_group = steps.group.data[group]; // number of members, cells, first words of the table, first cell
    const int first_body = MEMBERS * group, cells = of_group[1];
    bool any_active = false;
    for (int w = 0; w < of_group[0]; ++w) any_active |= !skips_steps(steps, steps.body.data[first_body + w][3]);
    if (!any_active) return;
    const Real* const residuals = residuals_of(steps, group);
    const int chunk = offset / CHUNK, lane = offset % CHUNK, pairs = (cells + 1) / 2;
    const int* const table = steps.table.data + (size_t)ENTRY * (of_group[2] + chunk * pairs) + lane;
    const Number zero = Number(Real(0));
    Vector sums[MEMBERS];
    for (int w = 0; w < MEMBERS; ++w) sums[w] = {zero, zero, zero};
    for (int pair = share(); pair < pairs; pair += SHARES) {
        const int* const entry = table + (size_t)ENTRY * pair;
        const Real* const pair_residuals = residuals + 6 * MEMBERS * (size_t)pair;
        Index words[9];
#pragma unroll
        for (int k = 0; k < 9; ++k) words[k] = indices(entry + k * CHUNK);
        add_products(pair_residuals, sums, [&](int k) { return lower_number(words[k]); });
        add_products(pair_residuals + 3 * MEMBERS, sums, [&](int k) { return upper_number(words[k]); });
    }
    for (int w = 0; w < MEMBERS; ++w) {
        const Vector response = group_sums(sums[w]);
        const Span at = cells_at(steps, first_body + w, offset);
        if (share() != 0 || at.count == 0 || skips_steps(steps, at.world)) continue;
        const Number scale = numbers_or(entries(steps.state.saturation, at), at.count, 0)
                             / numbers_or(entries(steps.state.slope, at), at.count, 1)
                             * steps.weight.data[first_body + w];
        const Vector change = scale * to_world(rotation_of_body(steps, first_body + w), response);
        set(steps.state.h, at, get(steps.state.h, at) + change);
        set(steps.state.h_change, at, change);
    }
}

template <class Word, class Steps>
CUDA_CALLABLE inline void add_body_steps(int thread, int first, int last, int threads, Word* team, const Steps& steps) {
    auto make_pass = [&](int pass, int row) {
        if (pass == WRITE_WEIGHTS) {
            for (int body = row; body < row + WIDTH && body < steps.body.shape[0]; ++body) write_weight(steps, body);
            return;
        }
        const auto& chunk = (pass == WRITE_RESIDUALS ? steps.body_chunk : steps.group_chunk).data[row / CHUNK];
        const int offset = chunk[1] + row % CHUNK; // chunk: body or group, first cell
        if (pass == WRITE_RESIDUALS) write_residuals(steps, chunk[0], offset);
        else add_changes(steps, chunk[0], offset);
    };
#if defined(__CUDA_ARCH__)
    make_pass(first, thread / GROUP);
#else
    auto items = [&](int pass) {
        if (pass == WRITE_WEIGHTS) return (int)steps.body.shape[0];
        return CHUNK * (int)(pass == WRITE_RESIDUALS ? steps.body_chunk : steps.group_chunk).shape[0];
    };
    run_passes(team, threads, first, last, items, WIDTH, make_pass);
#endif
}
}
