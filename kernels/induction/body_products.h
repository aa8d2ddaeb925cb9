// Products with operators of bodies: the fields of a body's own moments, and steps of bodies as a whole.
// body_products.py has the equations.
//
// The operators act on parities of the mirrored body separately (``warpmag.shapes.body_response``). A part is the
// component of the residuals, or of the moments, of a group of bodies that has one parity. FOLD writes the parts of the
// residuals of each parity, in the frames of the bodies, and WRITE_WEIGHTS the weight w of each body.
// MULTIPLY multiplies each part by its table Q − 1. UNFOLD adds the result to the field. FOLD_MOMENTS, MULTIPLY_FIELD
// and UNFOLD_FIELD add the field T m to the applied field in the same way. Bodies with the same tables form groups of
// at most ``MEMBERS``, so that a GPU reads a table once for several bodies; a CPU, whose caches hold the tables, has
// groups of one. On a CPU a pass works on a vector of orbits, on a GPU ``GROUP`` threads multiply for one orbit.
// ``Steps`` is the struct of body_products.py.
#pragma once
#include "cells/rotation.h"
#include "induction/spans.h"
#include "shared/group.h"
#include "shared/team.h"

namespace warpmag {

constexpr int ENTRY = 9 * CHUNK; // words of a table for a pair of sources and CHUNK targets
constexpr int MIRRORS = 8;       // sets of mirrors across x, y and z

enum BodyPass { FOLD, WRITE_WEIGHTS, MULTIPLY, UNFOLD, FOLD_MOMENTS, MULTIPLY_FIELD, UNFOLD_FIELD }; // as in Python

// True if the world takes no steps of bodies as a whole.
template <class Steps> CUDA_CALLABLE inline bool skips_steps(const Steps& steps, int world) {
    const auto& solve = steps.state.worlds.data[world];
    return solve.active == 0 || solve.apart > 0;
}
// True if the world needs no field.
template <class Steps> CUDA_CALLABLE inline bool skips_field(const Steps& steps, int world) {
    return steps.state.resting.data[world] != 0 || (!steps.everywhere && steps.state.worlds.data[world].active == 0);
}
template <class Steps> CUDA_CALLABLE inline Rotation<Real> rotation_of_body(const Steps& steps, int body) {
    return rotation_of<Real>(steps.rotation.data[steps.body.data[body][2]]);
}

// Orbits of a body from ``offset`` on: their number, the body's first moment and mirrors, and the place of the first of
// these orbits in the arrays of images and of parts.
struct Orbits {
    int count, moment, mirrors, image, pitch, place, step;
};
template <class Steps> CUDA_CALLABLE inline Orbits orbits_at(const Steps& steps, int body, int offset) {
    const auto& group = steps.group.data[body / MEMBERS]; // first image, mirrors, number of orbits, first place
    const auto& cells = steps.body.data[body];            // first moment, number of cells, rotation, world
    const int left = cells[1] == 0 ? 0 : group[2] - offset;
    return {left < 0       ? 0
            : left > WIDTH ? WIDTH
                           : left,
            cells[0],
            group[1],
            group[0] + offset,
            (group[2] + CHUNK - 1) / CHUNK * CHUNK,
            group[3] + offset,
            group[2] + group[2] % 2};
}
// Moments of the images of orbits by a set of mirrors. Those of a cell that occurs before are negative, −1 − moment.
template <class Steps> CUDA_CALLABLE inline Index images_at(const Steps& steps, const Orbits& at, int mirror) {
    const Index cell = indices(steps.image.data + at.image + mirror * at.pitch);
    return cell < 0 ? cell - at.moment : cell + at.moment;
}
template <class Array> CUDA_CALLABLE inline Vector vectors_of(const Array& array, Index i) {
    const Real* const numbers = (const Real*)array.data;
    return {collect(numbers, 3 * i), collect(numbers + 1, 3 * i), collect(numbers + 2, 3 * i)};
}
template <class Array> CUDA_CALLABLE inline void put_lane(const Array& array, int i, Vector v, int lane) {
    Real* const to = (Real*)array.data + 3 * (size_t)i;
    to[0] = lane_of(v.x, lane), to[1] = lane_of(v.y, lane), to[2] = lane_of(v.z, lane);
}
// Sums over the mirrors, v[p] = Σ_g (−1)^(p·g) v[g] for each component; p·g counts the mirrors in both.
CUDA_CALLABLE inline void transform(Vector (&v)[MIRRORS], int mirrors) {
#pragma unroll
    for (int bit = 1; bit < MIRRORS; bit *= 2) {
        if (!(mirrors & bit)) continue;
#pragma unroll
        for (int g = 0; g < MIRRORS; ++g) {
            if (g & bit) continue;
            const Vector sum = v[g] + v[g | bit];
            v[g | bit] = v[g] - v[g | bit], v[g] = sum;
        }
    }
}
// Calls visit(p, offset) for each parity, with the offset of its part of the orbits in an array of parts.
template <class Visit> CUDA_CALLABLE inline void visit_parities(const Orbits& at, Visit visit) {
    size_t place = at.place;
#pragma unroll
    for (int p = 0; p < MIRRORS; ++p) {
        if (p & ~at.mirrors) continue;
        visit(p, 3 * MEMBERS * place);
        place += at.step;
    }
}

// Writes the parts of values at the orbits of a body from ``offset`` on: for each orbit x, y and z of all members of
// the body's group side by side. A component changes its sign by the mirror across its axis. ``value(i)`` returns the
// values of moments i in the world.
template <class Steps, class Value>
CUDA_CALLABLE inline void fold(const Steps& steps, int body, int offset, bool skips, Value value) {
    const Orbits at = orbits_at(steps, body, offset);
    if (share() != 0 || at.count == 0 || skips) return;
    const Rotation<Real> rotation = rotation_of_body(steps, body);
    Vector v[MIRRORS];
    Real scale = 1;
    for (int bit = 1; bit < MIRRORS; bit *= 2) scale *= at.mirrors & bit ? Real(0.5) : 1;
#pragma unroll
    for (int g = 0; g < MIRRORS; ++g) {
        if (g & ~at.mirrors) continue;
        const Index signed_moment = images_at(steps, at, g);
        v[g] = scale * to_body(rotation, value(signed_moment < 0 ? -1 - signed_moment : signed_moment));
    }
    transform(v, at.mirrors);
    Real* const out = steps.input.data + body % MEMBERS;
    visit_parities(at, [&](int p, size_t first) {
        const Number x = v[p ^ (1 & at.mirrors)].x, y = v[p ^ (2 & at.mirrors)].y, z = v[p ^ (4 & at.mirrors)].z;
        for (int l = 0; l < at.count; ++l) {
            Real* const to = out + first + 3 * MEMBERS * l;
            to[0] = lane_of(x, l), to[MEMBERS] = lane_of(y, l), to[2 * MEMBERS] = lane_of(z, l);
        }
    });
}
// Calls put(i, moment, product, count) for each set of mirrors, with up to WIDTH products at the orbits of a body from
// ``offset`` on, in the world. Where an earlier set of mirrors has the same image of a cell, ``moment`` is negative,
// and put() skips it; elsewhere it is i, the index of the moment.
template <class Steps, class Put>
CUDA_CALLABLE inline void unfold(const Steps& steps, int body, int offset, bool skips, Put put) {
    const Orbits at = orbits_at(steps, body, offset);
    if (share() != 0 || at.count == 0 || skips) return;
    const Real* const parts = steps.product.data + body % MEMBERS;
    Vector v[MIRRORS];
    visit_parities(at, [&](int p, size_t first) {
        Number components[3];
        for (int c = 0; c < 3; ++c) {
            Real lanes[WIDTH] = {};
            for (int l = 0; l < at.count; ++l) lanes[l] = parts[first + 3 * MEMBERS * l + c * MEMBERS];
            components[c] = numbers(lanes);
        }
        v[p ^ (1 & at.mirrors)].x = components[0], v[p ^ (2 & at.mirrors)].y = components[1];
        v[p ^ (4 & at.mirrors)].z = components[2];
    });
    transform(v, at.mirrors);
    const Rotation<Real> rotation = rotation_of_body(steps, body);
#pragma unroll
    for (int g = 0; g < MIRRORS; ++g) {
        if (g & ~at.mirrors) continue;
        const Index moment = images_at(steps, at, g);
        put(moment < 0 ? Index(at.moment) : moment, moment, to_world(rotation, v[g]), at.count);
    }
}
// Puts vectors where ``moment`` is not negative.
template <class Array> CUDA_CALLABLE inline void put_moments(const Array& array, Index moment, Vector v, int count) {
    for (int l = 0; l < count; ++l)
        if (lane_of(moment, l) >= 0) put_lane(array, lane_of(moment, l), v, l);
}

template <class Steps> CUDA_CALLABLE inline void fold_residuals(const Steps& steps, int body, int offset) {
    const auto& state = steps.state;
    fold(steps, body, offset, skips_steps(steps, steps.body.data[body][3]), [&](Index i) {
        const Number factor = collect(state.slope.data, i) / collect(state.saturation.data, i);
        return factor * vectors_of(state.h, i) - vectors_of(state.s, i);
    });
}
// Adds the changes of the field.
template <class Steps> CUDA_CALLABLE inline void unfold_steps(const Steps& steps, int body, int offset) {
    const auto& state = steps.state;
    const Real weight = steps.weight.data[body];
    unfold(steps, body, offset, skips_steps(steps, steps.body.data[body][3]),
           [&](Index i, Index moment, Vector product, int count) {
               const Number scale = weight * collect(state.saturation.data, i) / collect(state.slope.data, i);
               const Vector change = scale * product;
               put_moments(state.h_change, moment, change, count);
               put_moments(state.h, moment, vectors_of(state.h, i) + change, count);
           });
}
template <class Steps> CUDA_CALLABLE inline void fold_moments(const Steps& steps, int body, int offset) {
    fold(steps, body, offset, skips_field(steps, steps.body.data[body][3]),
         [&](Index i) { return vectors_of(steps.state.moments, i); });
}
template <class Steps> CUDA_CALLABLE inline void unfold_field(const Steps& steps, int body, int offset) {
    const auto& state = steps.state;
    unfold(steps, body, offset, skips_field(steps, steps.body.data[body][3]),
           [&](Index i, Index moment, Vector field, int count) {
               put_moments(state.h, moment, vectors_of(state.h0, i) + field, count);
           });
}

// Writes the weight of a body from the means d and e of body_products.py.
template <class Steps> CUDA_CALLABLE inline void write_weight(const Steps& steps, int body) {
    const auto& cells = steps.body.data[body];
    const auto& state = steps.state;
    if (cells[1] == 0 || skips_steps(steps, cells[3])) return;
    Number shares = Number(Real(0)), excesses = shares;
    const Number zero = shares, full = zero + 1;
    for (int k = WIDTH * share(); k < cells[1]; k += WIDTH * SHARES) {
        const int left = cells[1] - k;
        const Span at = {0, cells[0] + k, left > WIDTH ? WIDTH : left, cells[3], 0, 0};
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
    const Real largest = steps.largest.data[body], least = 1 + (e - d * largest / (1 + largest)) / cells[1];
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

// Orbits of a part from ``offset`` on.
struct PartRows {
    size_t first; // place of the part in the arrays
    int orbits;   // of the part
    int left;     // number of these orbits, at most WIDTH
    int entry;    // of the table for these orbits, of ``entries`` for each CHUNK of them
};
template <class Steps>
CUDA_CALLABLE inline PartRows part_rows(const Steps& steps, int number, int offset, int entries) {
    const auto& part = steps.part.data[number]; // group of bodies, number of orbits, first entry of the table, place
    const int left = part[1] - offset;
    return {3 * MEMBERS * (size_t)part[3], part[1], left < WIDTH ? left : WIDTH, part[2] + offset / CHUNK * entries};
}
// Whether all bodies of a part skip it.
template <class Steps, class Skips> CUDA_CALLABLE inline bool all_skip(const Steps& steps, int number, Skips skips) {
    const int group = steps.part.data[number][0];
    for (int body = MEMBERS * group; body < MEMBERS * (group + 1); ++body)
        if (steps.body.data[body][1] > 0 && !skips(steps.body.data[body][3])) return false;
    return true;
}
// Writes sums of the threads of a group.
template <class Steps>
CUDA_CALLABLE inline void put_products(const Steps& steps, const PartRows& at, int offset,
                                       const Vector (&sums)[MEMBERS]) {
    Real* const out = steps.product.data + at.first + 3 * MEMBERS * (size_t)offset;
    for (int w = 0; w < MEMBERS; ++w) {
        const Vector sum = group_sums(sums[w]);
        if (share() != 0) continue;
        for (int l = 0; l < at.left; ++l) {
            Real* const to = out + 3 * MEMBERS * l + w;
            to[0] = lane_of(sum.x, l), to[MEMBERS] = lane_of(sum.y, l), to[2 * MEMBERS] = lane_of(sum.z, l);
        }
    }
}

// Multiplies the part of a parity by its table of Q − 1, for the orbits from ``offset`` on.
template <class Steps> CUDA_CALLABLE inline void multiply(const Steps& steps, int number, int offset) {
    if (all_skip(steps, number, [&](int world) { return skips_steps(steps, world); })) return;
    const int pairs = (steps.part.data[number][1] + 1) / 2;
    const PartRows at = part_rows(steps, number, offset, pairs);
    const Real* const residuals = steps.input.data + at.first;
    const int* const table = steps.table.data + (size_t)ENTRY * at.entry + offset % CHUNK;
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
    put_products(steps, at, offset, sums);
}

// Multiplies the part of a parity by its table of T, for the orbits from ``offset`` on.
template <class Steps> CUDA_CALLABLE inline void multiply_field(const Steps& steps, int number, int offset) {
    if (all_skip(steps, number, [&](int world) { return skips_field(steps, world); })) return;
    const PartRows at = part_rows(steps, number, offset, steps.part.data[number][1]);
    const Real* const moments = steps.input.data + at.first;
    const Real* const table = steps.tensors.data + (size_t)ENTRY * at.entry + offset % CHUNK;
    const Number zero = Number(Real(0));
    Vector sums[MEMBERS];
    for (int w = 0; w < MEMBERS; ++w) sums[w] = {zero, zero, zero};
#pragma unroll 2
    for (int source = share(); source < at.orbits; source += SHARES) {
        const Real* const entry = table + (size_t)ENTRY * source;
        add_products(moments + 3 * MEMBERS * (size_t)source, sums, [&](int k) { return numbers(entry + k * CHUNK); });
    }
    put_products(steps, at, offset, sums);
}

template <class Word, class Steps>
CUDA_CALLABLE inline void multiply_bodies(int thread, int first, int last, int threads, Word* team,
                                          const Steps& steps) {
    auto of_parts = [](int pass) { return pass == MULTIPLY || pass == MULTIPLY_FIELD; };
    auto make_pass = [&](int pass, int row) {
        if (pass == WRITE_WEIGHTS) {
            for (int body = row; body < row + WIDTH && body < steps.body.shape[0]; ++body) write_weight(steps, body);
            return;
        }
        const auto& chunk = (of_parts(pass) ? steps.part_chunk : steps.body_chunk).data[row / CHUNK];
        const int offset = chunk[1] + row % CHUNK; // chunk: part or body, first orbit
        if (pass == FOLD) fold_residuals(steps, chunk[0], offset);
        else if (pass == MULTIPLY) multiply(steps, chunk[0], offset);
        else if (pass == UNFOLD) unfold_steps(steps, chunk[0], offset);
        else if (pass == FOLD_MOMENTS) fold_moments(steps, chunk[0], offset);
        else if (pass == MULTIPLY_FIELD) multiply_field(steps, chunk[0], offset);
        else unfold_field(steps, chunk[0], offset);
    };
#if defined(__CUDA_ARCH__)
    make_pass(first, thread / GROUP);
#else
    auto items = [&](int pass) {
        if (pass == WRITE_WEIGHTS) return (int)steps.body.shape[0];
        return CHUNK * (int)(of_parts(pass) ? steps.part_chunk : steps.body_chunk).shape[0];
    };
    run_passes(team, threads, first, last, items, WIDTH, make_pass);
#endif
}
}
