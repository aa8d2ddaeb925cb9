// What passes over near pairs work on: the arrays, and what balls publish for others to read, a cache line each.
//
// near_pairs.py has the meaning of all arrays, and passes the numbers of their rows and slots.
#pragma once
#include "near_contact/group_rows.h"
#include "shared/team.h"
#include "shared/vectors.h"

namespace warpmag {

// As ``ContactArrays`` in near_pairs.py: pointers that sweeps read stand side by side, for a GPU to read together.
struct Arrays {
    int *group, *kind, *candidate, *candidate_count, *moved, *used, *counterpart, *field_row, *movable, *twisted, *near,
        *near_count, *contact_count;
    int balls, moment_stride, kinds, curve;
    Real *packed, *radius, *unsaturated, *curve_slope, *hardness, *relaxation, *pairs, *conductances, *state,
        *last_state, *sources, *drives, *field, *kept, *pair_slopes, *conductance_slopes, *pair_forces, *partial,
        *found_at, *tables, *places, *forces, *torques;

    template <class Addresses> CUDA_CALLABLE explicit Arrays(const Addresses& addresses) {
        static_assert(sizeof(*this) == sizeof(addresses), "ContactArrays has the same members in the same order");
        memcpy((void*)this, &addresses, sizeof(*this));
    }

    CUDA_CALLABLE Real* pair(int s, int i) const { return slot_at(pairs, NEAR_SLOTS, PAIR_ROWS, s, i); }
    CUDA_CALLABLE Real* pair_slope(int s, int i) const { return slot_at(pair_slopes, NEAR_SLOTS, PAIR_SLOPE_ROWS, s, i); }
    CUDA_CALLABLE Real* conductance(int s, int i) const {
        return slot_at(conductances, CONTACT_SLOTS, CONDUCTANCE_ROWS, s, i);
    }
    CUDA_CALLABLE Real* conductance_slope(int s, int i) const {
        return slot_at(conductance_slopes, CONTACT_SLOTS, CONDUCTANCE_SLOPE_ROWS, s, i);
    }
    CUDA_CALLABLE Real* pair_force(int s, int i) const { return slot_at(pair_forces, CONTACT_SLOTS, 3, s, i); }
    // Components of the moments m, of their three rows.
    CUDA_CALLABLE const Real* moment(int component, int i) const {
        return packed + (size_t)(4 + component) * moment_stride + i;
    }
    CUDA_CALLABLE Vector own_moment(int i) const {
        return {numbers(moment(0, i)), numbers(moment(1, i)), numbers(moment(2, i))};
    }
};

// What is left of a ball's sources without those of its contacts, ã = (−q, t, theta) with t = m − N, and m itself.
struct Sources {
    Vector t, m;
    Number q;
    Tensor theta;
};
// A ball's drive: φ, R e_m and R² e_Θ, and the weight that falls as the ball saturates.
struct Drive {
    Number phi, weight;
    Vector e;
    Tensor t;
};

// Lines of sources: Θ̃, N, q as in the state, and m. On a GPU, which has no pass that writes m before the others, it is
// read from where the moments are.
CUDA_CALLABLE inline Sources sources_of(Four a, Four b, Vector m, Number q) {
    return {{m.x - b.y, m.y - b.z, m.z - b.w}, m, -q, {a.x, a.y, a.z, a.w, b.x}};
}
// Lines of drives: R² e_Θ, R e_m, φ, weight.
CUDA_CALLABLE inline Drive drive_of(Four a, Four b, Number phi, Number weight) {
    return {phi, weight, {b.y, b.z, b.w}, {a.x, a.y, a.z, a.w, b.x}};
}

#if defined(__CUDA_ARCH__)
CUDA_CALLABLE inline Sources sources_at(const Arrays& a, const int* j) {
    const Real q = a.sources[LINE * (size_t)*j + 8];
    return sources_of(four_at(a.sources, 0, j), four_at(a.sources, 1, j), a.own_moment(*j), q);
}
CUDA_CALLABLE inline Sources own_sources(const Arrays& a, int i) { return sources_at(a, &i); }
CUDA_CALLABLE inline void publish_sources(const Arrays& a, int i, const Number* state) {
    Real* const line = a.sources + LINE * (size_t)i;
    line[share()] = state[0];
    if (share() == 5) line[8] = state[1];
}
CUDA_CALLABLE inline Drive drive_at(const Arrays& a, const int* j) {
    const Four end = four_at(a.drives, 2, j);
    return drive_of(four_at(a.drives, 0, j), four_at(a.drives, 1, j), end.x, end.y);
}
CUDA_CALLABLE inline Drive own_drive(const Arrays& a, int i) { return drive_at(a, &i); }
CUDA_CALLABLE inline void publish_drive(const Arrays& a, int i, const Number* drive, Number weight) {
    Real* const line = a.drives + LINE * (size_t)i;
    line[share()] = drive[0];
    if (share() == 5) line[8] = drive[1];
    if (share() == 0) line[9] = weight;
}
#else
inline Sources sources_at(const Arrays& a, const int* j) {
    const Four end = four_at(a.sources, 2, j);
    return sources_of(four_at(a.sources, 0, j), four_at(a.sources, 1, j), {end.y, end.z, end.w}, end.x);
}
inline Sources own_sources(const Arrays& a, int i) {
    const Four end = own_four(a.sources, 2, i);
    return sources_of(own_four(a.sources, 0, i), own_four(a.sources, 1, i), {end.y, end.z, end.w}, end.x);
}
inline void publish_sources(const Arrays& a, int i, const Number* state) {
    const Vector m = a.own_moment(i);
    put_four(a.sources, 0, i, {state[0], state[1], state[2], state[3]});
    put_four(a.sources, 1, i, {state[4], state[5], state[6], state[7]});
    put_four(a.sources, 2, i, {state[13], m.x, m.y, m.z});
}
inline Drive drive_at(const Arrays& a, const int* j) {
    const Four end = four_at(a.drives, 2, j);
    return drive_of(four_at(a.drives, 0, j), four_at(a.drives, 1, j), end.x, end.y);
}
inline Drive own_drive(const Arrays& a, int i) {
    const Four end = own_four(a.drives, 2, i);
    return drive_of(own_four(a.drives, 0, i), own_four(a.drives, 1, i), end.x, end.y);
}
inline void publish_drive(const Arrays& a, int i, const Number* drive, Number weight) {
    put_four(a.drives, 0, i, {drive[0], drive[1], drive[2], drive[3]});
    put_four(a.drives, 1, i, {drive[4], drive[5], drive[6], drive[7]});
    put_four(a.drives, 2, i, {drive[13], weight, weight, weight});
}
#endif

// Passes ``first`` to ``last``, of which a launch on a GPU makes one: a launch is where its threads wait for each other.
template <class MakePass>
CUDA_CALLABLE inline void make_passes(int thread, int first, int last, int threads, unsigned long long* team, int balls,
                                      MakePass make_pass) {
#if defined(__CUDA_ARCH__)
    make_pass(first, thread / GROUP);
#else
    run_passes(team, threads, first, last, balls, WIDTH, make_pass);
#endif
}
}
