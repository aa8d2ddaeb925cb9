// What passes over near pairs work on: the arrays, and what balls publish for others to read, a cache line each.
//
// near_pairs.py has the meaning of all arrays, and passes the numbers of their rows and slots, and UNIT, μ0/4π [T·m/A].
#pragma once
#include "material/curves.h"
#include "near_contact/group_rows.h"
#include "shared/team.h"
#include "shared/vectors.h"

namespace warpmag {

// As ``ContactArrays`` in near_pairs.py: pointers that sweeps read stand side by side, for a GPU to read together.
struct Arrays {
    int *group, *field_row, *kind, *candidate, *candidate_count, *moved, *used, *counterpart, *movable, *turned, *near,
        *near_count, *contact_count, *curve, *other_begin, *other_end, *pushed;
    int balls, moment_stride, kinds, common_curve;
    Real *packed, *radius, *unsaturated, *curve_slope, *hardness, *relaxation, *pairs, *conductances, *state,
        *last_state, *sources, *drives, *field, *kept, *pair_slopes, *conductance_slopes, *pair_forces, *partial,
        *found_at, *tables, *places, *forces, *torques, *curve_tables, *alone, *response, *bounds, *expansion;

    template <class Addresses> CUDA_CALLABLE explicit Arrays(const Addresses& addresses) {
        static_assert(sizeof(*this) == sizeof(addresses), "ContactArrays has the same members in the same order");
        memcpy((void*)this, &addresses, sizeof(*this));
    }

    CUDA_CALLABLE Real* pair(int s, int i) const { return slot_at(pairs, NEAR_SLOTS, PAIR_ROWS, s, i); }
    CUDA_CALLABLE Real* pair_slope(int s, int i) const {
        return slot_at(pair_slopes, NEAR_SLOTS, PAIR_SLOPE_ROWS, s, i);
    }
    CUDA_CALLABLE Real* conductance(int s, int i) const {
        return slot_at(conductances, CONTACT_SLOTS, CONDUCTANCE_ROWS, s, i);
    }
    CUDA_CALLABLE Real* conductance_slope(int s, int i) const {
        return slot_at(conductance_slopes, CONTACT_SLOTS, CONDUCTANCE_SLOPE_ROWS, s, i);
    }
    CUDA_CALLABLE Real* pair_force(int s, int i) const { return slot_at(pair_forces, CONTACT_SLOTS, 3, s, i); }
    CUDA_CALLABLE Curves curves(int i) const { return curves_of(curve, common_curve, curve_tables, i, WIDTH); }
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
    Traceless theta;
};
// A ball's drive: φ, R e_m and R² e_Θ, and the weight that falls as the ball saturates.
struct Drive {
    Number phi, weight;
    Vector e;
    Traceless t;
};

// Sources of balls j. On a GPU, which has no pass that publishes m before the others, it comes from where moments are.
CUDA_CALLABLE inline Sources sources_at(const Arrays& arrays, const int* j) {
    const Four a = four_at(arrays.sources, 0, j), b = four_at(arrays.sources, 1, j), c = four_at(arrays.sources, 2, j);
#if defined(__CUDA_ARCH__)
    const Vector m = arrays.own_moment(*j);
#else
    const Vector m = {c.y, c.z, c.w};
#endif
    return {{m.x - b.y, m.y - b.z, m.z - b.w}, m, -c.x, {a.x, a.y, a.z, a.w, b.x}};
}
CUDA_CALLABLE inline Drive drive_at(const Arrays& arrays, const int* j) {
    const Four a = four_at(arrays.drives, 0, j), b = four_at(arrays.drives, 1, j), c = four_at(arrays.drives, 2, j);
    return {c.x, c.y, {b.y, b.z, b.w}, {a.x, a.y, a.z, a.w, b.x}};
}
// Balls i themselves, for the functions above.
struct Own {
    int at[WIDTH];
    CUDA_CALLABLE explicit Own(int i) {
        for (int l = 0; l < WIDTH; ++l) at[l] = i + l;
    }
};

// Adds UNIT times vectors to those of the moments in an array that are ``wanted``.
CUDA_CALLABLE inline void add_to(Real* array, int i, Vector v, const int* wanted) {
    for (int l = 0; l < WIDTH; ++l) {
        if (wanted[i + l] == 0) continue;
        Real* const own = array + 3 * (size_t)(i + l);
        own[0] += UNIT * lane_of(v.x, l);
        own[1] += UNIT * lane_of(v.y, l);
        own[2] += UNIT * lane_of(v.z, l);
    }
}

// Publishes numbers 0 to 7 and 13 of a ball, and more that goes with them.
CUDA_CALLABLE inline void publish(Real* lines, int i, const Number* part, Vector more) {
#if defined(__CUDA_ARCH__)
    lines[LINE * (size_t)i + share()] = part[0];
    if (share() == 5) put_four(lines, 2, i, {part[1], more.x, more.y, more.z});
#else
    put_four(lines, 0, i, {part[0], part[1], part[2], part[3]});
    put_four(lines, 1, i, {part[4], part[5], part[6], part[7]});
    put_four(lines, 2, i, {part[13], more.x, more.y, more.z});
#endif
}

// Passes ``first`` to ``last``, of which a launch on a GPU makes one: a launch is where its threads wait for each
// other.
template <class Passes, class Addresses>
CUDA_CALLABLE inline void make_passes(int thread, int first, int last, int threads, unsigned long long* team,
                                      const Addresses& addresses) {
    const Passes passes = {Arrays(addresses)};
#if defined(__CUDA_ARCH__)
    passes(first, thread / GROUP);
#else
    run_passes(team, threads, first, last, passes.a.balls, WIDTH, [&](int pass, int i) { passes(pass, i); });
#endif
}
}
