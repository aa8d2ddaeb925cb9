// The passes over targets and sources: fields at targets, fields about balls, and what the targets push sources with.
//
// Of a permanent body everything is a difference: the closed form less what the sums over pairs make of the lattice. On
// a CPU a pass works on a vector of targets or of points, on a GPU a group of threads shares a target, a ball, a row of
// targets or a body. Takes GROUP, MU0, INVERSE_4PI and the switches COILS, SOLIDS, BALLS and RATES from Python, for
// what there is, and PASS, the only one of a GPU's kernel; ``All`` is the struct of sources.py, which has the names.
#pragma once
#include "applied/balls.h"
#include "applied/between.h"
#include "applied/rates.h"
#include "shared/team.h"

namespace warpmag {

enum SourcePass { AT_TARGETS, AT_POINTS, AT_BALLS, REACT, ADD_UP }; // as in fields.py
constexpr int WRENCH = 7;                                           // as in sources.py

// Targets from column i on: places, radii, moments and labels, and what is wanted of each (see sources.py).
struct Targets {
    Vector x;
    Number radius, label;
    Index wanted;
};
template <class All> CUDA_CALLABLE inline Targets targets_at(const All& all, int i, int held) {
    const Number zero = Number(Real(0));
    const Vector none = {zero, zero, zero};
    Targets at = {none, zero, zero, {}};
    if (held <= 0) return at;
    const Real* const rows = all.target.data + i;
    const size_t pitch = all.target.strides[0] / sizeof(Real);
    auto row = [=](int n) -> Number { return numbers(rows + n * pitch); };
    at = {{row(0), row(1), row(2)}, row(3), row(7), {}};
#if defined(__CUDA_ARCH__)
    at.wanted = all.wanted.data[i];
#else
    for (int l = 0; l < held && l < WIDTH; ++l) at.wanted[l] = all.wanted.data[i + l];
#endif
    return at;
}

// What each ``step``-th source of a list applies to targets, and in ``acting`` what those of other bodies do.
template <class All>
CUDA_CALLABLE inline Vector add_applied(const All& all, const int* list, int begin, int step, int count,
                                        const Targets& at, int held, Seen& acting) {
    Vector h = acting.h;
    for (int l = 0; l < WIDTH && l < held; ++l) {
        Point whole = {0, 0, 0};
        FieldAt others = {};
        for (int k = begin; k < count; k += step) {
            const FieldAt f = field_at(all, list[k], {lane_of(at.x.x, l), lane_of(at.x.y, l), lane_of(at.x.z, l)});
            whole += f.h;
            if (all.label.data[list[k]] != lane_of(at.label, l)) others = others + f;
        }
        set_lane(h, l, whole), set_lane(acting.h, l, others.h);
        set_lane(acting.x, l, others.dx), set_lane(acting.y, l, others.dy), set_lane(acting.z, l, others.dz);
    }
    return h;
}

// Targets that a body's closed form counts for.
template <class All> CUDA_CALLABLE inline Mask near_to(const Body& body, const Targets& at) {
    return mask_of(at.wanted != 0) & (away2(body, body.pose.place(at.x)) < body.reach * body.reach);
}

template <bool POINTS, class All> CUDA_CALLABLE inline void field_at_targets(const All& all, int row) {
    const auto& chunk = all.chunk.data[row / CHUNK]; // first target, their number, and the bodies of their world
    const int offset = row % CHUNK, held = chunk[1] - offset, i = chunk[0] + offset;
    if (held <= 0) return;
    const Targets at = targets_at(all, i, held);
    Seen acting = nothing_seen();
    Vector h = acting.h, inside = h, rate = h;
    if constexpr (COILS) {
        const auto& list = all.lists.data[row / CHUNK];
        const int* const first = all.list.data + list[0];
        h = add_applied(all, first, share(), SHARES, list[1] - list[0], at, held, acting);
        if constexpr (RATES)
            rate = rate_of_coils(all, first, share(), SHARES, list[1] - list[0], i, held, at.x, at.label);
    }
    if constexpr (SOLIDS)
        for (int b = chunk[2]; b < chunk[3]; ++b) {
            const Body body = body_at(all, b);
            const Mask near = near_to<All>(body, at);
            if (!any(near)) continue;
            const Seen seen = seen_of(lacking(all, body, at.x, at.radius, near, share(), SHARES));
            add_where(near, h, seen.h);
            add_where(near & (at.label != body.label), acting, seen);
            if constexpr (RATES)
                add_where(near & (at.label != body.label), rate, rate_of_body(all, body, seen, i, held, at.x));
            if constexpr (POINTS) add_where(near, inside, lacking_inside(all, body, at.x, share(), SHARES));
        }
    h = group_sums(h);
    acting = {group_sums(acting.h), group_sums(acting.x), group_sums(acting.y), group_sums(acting.z)};
    if constexpr (POINTS) inside = group_sums(inside);
    if constexpr (RATES) rate = group_sums(rate);
    if (share() != 0) return;
    const size_t column = 3 * (size_t)i;
    const Vector base = vectors((Real*)all.base.data + column, held);
    put_vectors((Real*)all.field.data + column, held, base + h);
    put_vectors((Real*)all.acting.data + column, held, base + acting.h);
    put_vectors((Real*)all.along_x.data + column, held, acting.x);
    put_vectors((Real*)all.along_y.data + column, held, acting.y);
    put_vectors((Real*)all.along_z.data + column, held, acting.z);
    if constexpr (POINTS) put_vectors((Real*)all.inside.data + column, held, inside);
    if constexpr (RATES) put_vectors((Real*)all.rate.data + column, held, rate);
}

// What the targets of a row push their source with: the opposite of what it pushes them with.
template <class All> CUDA_CALLABLE inline Push push_of(const All& all, int s, const Body& body, int first, int last) {
    Push push = no_push();
    const bool solid = SOLIDS && s >= all.kind.shape[0];
    const Three center = solid ? center_of(all, body) : three((const Real*)all.frame.data + 7 * (size_t)s);
    const size_t pitch = all.effective.strides[0] / sizeof(Real);
    for (int i = first + WIDTH * share(); i < last; i += WIDTH * SHARES) {
        const Targets at = targets_at(all, i, last - i);
        const Real* const m = all.effective.data + i;
        Mask pushed = first_lanes(last - i);
        Seen seen = nothing_seen();
        if constexpr (SOLIDS)
            if (solid) {
                pushed &= near_to<All>(body, at) & (at.label != body.label);
                if (!any(pushed)) continue;
                seen = seen_of(lacking(all, body, at.x, at.radius, pushed, 0, 1));
            }
        if constexpr (COILS)
            if (!solid) add_applied(all, &s, 0, 1, 1, at, last - i, seen);
        push_moments(push, pushed, seen, {numbers(m), numbers(m + pitch), numbers(m + 2 * pitch)}, at.x, center);
    }
    return push;
}
template <class All> CUDA_CALLABLE inline void react(const All& all, int row) {
    const auto& part = all.row.data[row]; // source, first target and the end, and whether these are balls
    const int s = part[0], coils = all.kind.shape[0];
    const Body body = SOLIDS && s >= coils ? body_at(all, s - coils) : Body{};
    Three force = {0, 0, 0}, torque = force;
    if (!part[3]) {
        const Push push = push_of(all, s, body, part[1], part[2]);
        force = added_up(push.force), torque = added_up(push.torque);
    } else if constexpr (BALLS) {
        const Three center = s < coils ? three((const Real*)all.frame.data + 7 * (size_t)s) : center_of(all, body);
        for (int n = part[1]; n < part[2]; ++n) {
            Ball ball = ball_at(all, all.ball.data[n][0]);
            if constexpr (COILS)
                if (s < coils) add_source(all, s, ball);
            if constexpr (SOLIDS)
                if (s >= coils) add_body(all, body, ball);
            const Three f = pull_of(all, ball);
            force += f;
            torque += cross(ball.center - center, f);
        }
    }
    if (share() != 0) return;
    Real* const out = all.partial.data + 6 * (size_t)row;
    for (int k = 0; k < 6; ++k) out[k] = 0;
    add_numbers(out, force, torque, -MU0);
}

// Adds up what pushes a source: its rows, and of permanent bodies other ones. Of two bodies the charges of the smaller
// are summed, whichever of them asks, so that both get the same numbers.
template <class All> CUDA_CALLABLE inline void add_bodies(const All& all, int b, Real (&total)[WRENCH]) {
    const Body body = body_at(all, b);
    const auto& world = all.world.data[b]; // the bodies of its world
    for (int c = world[0]; c < world[1]; ++c) {
        if (c == b) continue;
        const Body other = body_at(all, c);
        if (other.label == body.label) continue;
        const bool own = body.radius < other.radius || (body.radius == other.radius && b < c);
        const Body &q = own ? body : other, &s = own ? other : body;
        const Three &p = q.pose.origin, &x = q.pose.x, &y = q.pose.y, &z = q.pose.z, &d = q.middle;
        const Vector middle = spread(p + d.x * x + (d.y * y + d.z * z));
        const Real reach = q.radius + (q.reach > s.reach ? q.reach : s.reach);
        if (!any(away2(s, s.pose.place(middle)) < Number(Real(0)) + reach * reach)) continue;
        Three force, torque;
        Real energy;
        between(all, q, s, force, torque, energy);
        if (own) add_numbers(total, force, torque, MU0);
        else {
            const Three turn = cross(center_of(all, q) - center_of(all, s), force);
            add_numbers(total, force, torque + turn, -MU0);
        }
        total[6] += Real(0.5) * MU0 * energy;
    }
}
template <class All> CUDA_CALLABLE inline void add_up(const All& all, int s) {
    Real total[WRENCH] = {};
    for (int row = all.row_begin.data[s] + share(); row < all.row_begin.data[s + 1]; row += SHARES)
        for (int k = 0; k < 6; ++k) total[k] += all.partial.data[6 * (size_t)row + k];
#if defined(__CUDA_ARCH__)
    for (int k = 0; k < 6; ++k) total[k] = group_sum(total[k]);
#endif
    if constexpr (SOLIDS)
        if (s >= all.kind.shape[0]) add_bodies(all, s - all.kind.shape[0], total);
    if (share() != 0) return;
    for (int k = 0; k < WRENCH; ++k) all.wrench.data[WRENCH * (size_t)s + k] = total[k];
}

template <class Word, class All>
CUDA_CALLABLE inline void apply_sources(int thread, int first, int last, int threads, Word* team, const All& all) {
    auto make_pass = [&](int pass, int i) {
        if constexpr (PASS < 0 || PASS == AT_TARGETS)
            if (pass == AT_TARGETS) field_at_targets<false>(all, i);
        if constexpr (PASS < 0 || PASS == AT_POINTS)
            if (pass == AT_POINTS) field_at_targets<true>(all, i);
        if constexpr (BALLS && (PASS < 0 || PASS == AT_BALLS))
            if (pass == AT_BALLS) expand(all, i);
        if constexpr (PASS < 0 || PASS == REACT)
            if (pass == REACT) react(all, i);
        if constexpr (PASS < 0 || PASS == ADD_UP)
            if (pass == ADD_UP) add_up(all, i);
    };
#if defined(__CUDA_ARCH__)
    make_pass(PASS, thread / GROUP);
#else
    auto items = [&](int pass) {
        return pass < AT_BALLS    ? CHUNK * all.chunk.shape[0]
               : pass == AT_BALLS ? all.ball.shape[0]
               : pass == REACT    ? all.row.shape[0]
                                  : all.wrench.shape[0];
    };
    run_passes(team, threads, first, last, items, first < AT_BALLS ? WIDTH : 1, make_pass);
#endif
}
}
