"""Text of the near-contact model's passes over the slots of the balls' lists; ``vector_passes`` runs them."""

import math

from warpmag.kernels.material.curves import CLAMPED, LANGEVIN
from warpmag.kernels.pairs.wrench import MU0
from warpmag.kernels.shared.vector_text import passes_text
from warpmag.near_contact import (
    CONTACT_GAP,
    DEEPEST,
    LANGEVIN_STEEPNESS,
    LEAST_RATIO,
    LOG_GAPS,
    MOST_SHARED,
    QUADRUPOLE_OVERLAP,
    QUADRUPOLE_REACH,
    RANGE,
    REACH,
    SMALLEST_GAP,
    SOFTNESS,
)

NEAR = 32
"""Slots for near balls; balls that do not overlap have at most about 24."""
CONTACTS = 16
"""The first of them, for those that nearly touch."""
WAYS = 8
"""Threads of a GPU that share a ball: numbers k and k + 8 of a ball are with one of them."""
CANDIDATES = 64
"""Balls that may be listed as near, or about to be."""
SKIN = 0.05
"""Part of its radius that a ball may move before near balls are sought anew."""

PAIR_ROWS = 8
"""Rows of a near pair: direction to the other ball; U_sr, g1 d, g2 d², 1/d, the quadrupoles' window."""
CHANGE_ROWS = 2
"""Rows of a near pair's derivatives: g3 d³ and the window's."""
CONTACT_ROWS = 17
"""Rows of a contact: A to P, then D', J' and L' that the other ball sees."""
SLOPE_ROWS = 14
"""Rows of a contact's derivatives: of A to P by the distance."""
STATE_ROWS = 14
"""Rows of what sweeps move: xx, yy, xy, yz, zx of n_Θ and N, the contact sources' quadrupole and dipole; the same of Θ̃;
and q. The drive that goes with them has their numbers, 0 to 7 and 13: R² e_Θ, R e_m and φ."""
OUTER_ROWS = 24
"""Rows of what a pass keeps for the next: by these numbers the drive that balls make which do not touch, and at 8 to
12 what Θ̃ moves towards; at 16, 22 and 23 (M_sr a)_m; at 17 and 18 the polarizability of the quadrupole, and the factor
that falls as a ball saturates."""
SWEEPS = 2
"""Sweeps before each field evaluation, and before forces are taken: with one, a cold solve of a pile takes twice as
many evaluations."""
FORCES = 1 + 2 * SWEEPS
"""The first pass that finds forces."""

OWN_SOURCE, OWN_DIPOLE = 1.0 - 1.2 * 2.0 / RANGE, 1.0 - (2.0 / RANGE) ** 3
"""M of a ball of unit radius on itself."""
_LEAST, _MOST = 0.4, 4.0
"""Between these lie the eigenvalues of what sweeps solve for, in piles of any permeability, touching or overlapping."""
_PACE = 4.0 / (_MOST**0.5 + _LEAST**0.5) ** 2
_MOMENTUM = ((_MOST**0.5 - _LEAST**0.5) / (_MOST**0.5 + _LEAST**0.5)) ** 2

# Blocks: ``placed`` holds x, y, z, radius; share, kind. On a CPU ``seen`` holds N, q; Θ̃ and m, ``driven`` R e_m, φ;
# R² e_Θ and the weight. On a GPU they hold packets: N; Θ̃ and q; and R² e_Θ and R e_m, each two of which are followed by
# φ, the first, or the weight.
_TYPES = """
    struct Sources { Vector t, m; NUMBER q; Tensor theta; };
    struct Drive { NUMBER phi, weight; Vector e; Tensor t; };
    struct Softness { NUMBER p, weight; };
    auto own_moment = [=](int i) -> Vector {
        return {numbers(moment + i), numbers(moment + moment_stride + i), numbers(moment + 2 * moment_stride + i)};
    };
    auto put_partial = [=](int i, Vector h, int l) {
        if (row_of[i + l] < 0) return;
        REAL* const sum = partial + 3 * (size_t)row_of[i + l];
        sum[0] = lane_of(h.x, l);
        sum[1] = lane_of(h.y, l);
        sum[2] = lane_of(h.z, l);
    };
    constexpr unsigned DRIVES = 0x20ff, ALL = 0xe1ff;  // numbers of a drive; and, at 8, 14 and 15, of (M_sr a)_m
"""

# How a thread of a GPU keeps what it needs of its ball from pass to pass, and how balls read each other.
_SHOW_ON_GPU = """
    // numbers way and way + 8 of the ball, but its own part of all of the sums
    REAL kept_state[2] = {0, 0}, kept_last[2] = {0, 0}, kept_goal[2] = {0, 0}, kept_lone[2] = {0, 0}, kept_sum[16];
    REAL kept_drive[2] = {0, 0}, kept_p, kept_weight, kept_size, kept_moment, kept_pace[2];
    int partners[NEAR / WAYS], kept_count, kept_contacts;
    auto size_of = [&](int) -> NUMBER { return kept_size; };
    auto moment_of = [&](int, int) -> NUMBER { return kept_moment; };
    auto pace_of = [&](int, int k) -> NUMBER { return kept_pace[k]; };
    int turn;  // how often drives have been told
    auto state = [&](int, int k) -> NUMBER { return kept_state[k]; };
    auto last_state = [&](int, int k) -> NUMBER { return kept_last[k]; };
    auto goal = [&](int, int k) -> NUMBER { return kept_goal[k]; };
    auto lone_field = [&](int, int c) -> NUMBER { return number(kept_lone, c); };
    auto kept_sums = [&](int, int c) -> NUMBER { return kept_sum[c]; };
    auto keep_state = [&](int, int k, NUMBER n) { kept_state[k] = n; };
    auto keep_last = [&](int, int k, NUMBER n) { kept_last[k] = n; };
    auto keep_goal = [&](int, int k, NUMBER n) { kept_goal[k] = n; };
    auto keep_lone_field = [&](int, const NUMBER* sum) { kept_lone[1] = sum[8]; };
    auto keep_sum = [&](int, int c, NUMBER n) { kept_sum[c] = n; };
    auto seen_by_others = [&](int i) -> REAL* { return seen + BLOCK * ((size_t)stride * (turn % 4) + i); };
    auto driven_by_others = [&](int i) -> REAL* { return driven + BLOCK * ((size_t)stride * (turn % 2) + i); };
    auto sources_at = [&](const int* j) -> Sources {
        const REAL* block = seen_by_others(*j);
        const Vector m = own_moment(*j);
        Told n, t, o;
        do {
            n = hear(block);
            t = hear(block + 4);
            o = hear(block + 8);
        } while (!come(n.mark == turn && t.mark == turn && o.mark == turn));
        return {{m.x - n.x, m.y - n.y, m.z - n.z}, m, -o.z, {t.x, t.y, t.z, o.x, o.y}};
    };
    auto put_sources = [&](int i, const NUMBER* n) {
        const int from = way == 0 ? 5 : 3 * way - 3;
        const REAL x = __shfl_sync(~0u, way < 5 ? n[1] : n[0], from, WAYS);
        const REAL y = __shfl_sync(~0u, way < 5 ? n[1] : n[0], from + 1, WAYS);
        const REAL z = __shfl_sync(~0u, way < 6 ? n[1] : n[0], from + 2, WAYS);
        if (way < 3) tell(seen_by_others(i) + 4 * way, x, y, z, turn);
    };
    auto drive_at = [&](const int* j) -> Drive {
        const REAL* block = driven_by_others(*j);
        Told a, b, c, d;
        do {
            a = hear(block);
            b = hear(block + 4);
            c = hear(block + 8);
            d = hear(block + 12);
        } while (!come(a.mark == turn && b.mark == turn && c.mark == turn && d.mark == turn));
        return {a.z, b.z, {c.y, d.x, d.y}, {a.x, a.y, b.x, b.y, c.x}};
    };
    auto put_drive = [&](int i, const NUMBER* n, NUMBER weight) {
        const REAL x = __shfl_sync(~0u, n[0], 2 * way, WAYS), y = __shfl_sync(~0u, n[0], 2 * way + 1, WAYS);
        const REAL phi = number(n, 13);
        kept_drive[0] = n[0];
        kept_drive[1] = n[1];
        ++turn;
        if (way < 4) tell(driven_by_others(i) + 4 * way, x, y, way == 0 ? phi : weight, turn);
    };
    auto softness = [&](int) -> Softness { return {kept_p, kept_weight}; };
    auto keep_softness = [&](int, Softness s) {
        kept_p = s.p;
        kept_weight = s.weight;
    };
    auto put_field = [&](int i, Vector h) {
        if (way > 0) return;
        tell(field + 4 * (size_t)i, h.x, h.y, h.z, last <= FORCES || (movable[i] == 1 && twisted[i] == 1));
        if (!AT_ONCE) put_partial(i, h, 0);
    };
    auto put_half = [&](int i, int s, Vector v) {
        tell(halves + 4 * ((size_t)i * CONTACTS + s), v.x, v.y, v.z, turn);
    };
    auto half_at = [&](int place) -> Vector {
        Told half;
        do half = hear(halves + 4 * (size_t)place); while (!come(half.mark == turn));
        return {half.x, half.y, half.z};
    };
    auto own_half = [&](int i, int s) -> Vector { return half_at(i * CONTACTS + s); };
    auto other_half = [&](int i, int s) -> Vector {
        const int place = s < kept_contacts ? *list_at(mirror, CONTACTS, s, i) : -1;
        const Vector half = half_at(place < 0 ? i * CONTACTS + s : place);
        return place < 0 ? Vector{0, 0, 0} : half;
    };
    // the ball of a slot, or itself where there is none
    struct Partner { int at[1]; };
    auto partner = [&](int i, int s, const int* counts) -> Partner {
        int other = partners[0];
        for (int k = 1; k < NEAR / WAYS; ++k) other = s >= k * WAYS ? partners[k] : other;
        return {{s < (counts == count ? kept_count : kept_contacts) ? other : i}};
    };
    auto own_field = [&](int i) -> Vector {
        const Told h = hear(field + 4 * (size_t)i);
        return {h.x, h.y, h.z};
    };
    auto own_sources = [&](int i) -> Sources { return sources_at(&i); };
    auto own_drive = [&](int i) -> Drive {
        if (!AT_ONCE) return drive_at(&i);
        auto d = [&](int c) -> REAL { return number(kept_drive, c); };
        return {d(13), kept_weight, {d(5), d(6), d(7)}, {d(0), d(1), d(2), d(3), d(4)}};
    };
"""

# The same of a vector of balls on a CPU.
_SHOW_ON_CPU = """
    auto size_of = [=](int i) -> NUMBER { return numbers(radius + i); };
    auto moment_of = [=](int i, int axis) -> NUMBER { return numbers(moment + axis * moment_stride + i); };
    auto pace_of = [=](int i, int c) -> NUMBER {
        const NUMBER one = numbers(radius + i) * REAL(0) + 1;
        return PACE * (c == 13 ? numbers(ease + i) : c < 5 || c > 7 ? one : numbers(ease + stride + i));
    };
    auto row_in = [=](REAL* rows, int count) {
        return [=](int i, int c) -> NUMBER { return numbers(rows_at(rows, count, i) + c * LANES); };
    };
    auto keep_in = [=](REAL* rows, int count) {
        return [=](int i, int c, NUMBER n) { put(rows_at(rows, count, i) + c * LANES, n); };
    };
    auto state = row_in(contact, STATE_ROWS), last_state = row_in(last_contact, STATE_ROWS);
    auto keep_state = keep_in(contact, STATE_ROWS), keep_last = keep_in(last_contact, STATE_ROWS);
    auto goal = row_in(outer, OUTER_ROWS), kept_sums = goal, lone_field = row_in(outer + 8 * LANES, OUTER_ROWS);
    auto keep_goal = keep_in(outer, OUTER_ROWS), keep_sum = keep_goal;
    auto keep_lone_field = [=](int i, const NUMBER* sum) {
        REAL* const rows = rows_at(outer, OUTER_ROWS, i) + 8 * LANES;
        put(rows + 8 * LANES, sum[8]);
        put(rows + 14 * LANES, sum[14]);
        put(rows + 15 * LANES, sum[15]);
    };
    auto softness = [=](int i) -> Softness { return {goal(i, 17), goal(i, 18)}; };
    auto keep_softness = [=](int i, Softness s) {
        keep_goal(i, 17, s.p);
        keep_goal(i, 18, s.weight);
    };
    auto put_field = [=](int i, Vector h) {
        put_vector(rows_at(field, 3, i), h);
        for (int l = 0; l < WIDTH; ++l) put_partial(i, h, l);
    };
    auto own_field = [=](int i) -> Vector { return own_vector(rows_at(field, 3, i)); };
    auto put_half = [=](int i, int s, Vector v) { put_vector(slot_at(halves, CONTACTS, 3, s, i), v); };
    auto own_half = [=](int i, int s) -> Vector { return own_vector(slot_at(halves, CONTACTS, 3, s, i)); };
    auto other_half = [=](int i, int s) -> Vector {
        const int* other = list_at(mirror, CONTACTS, s, i);
        return {gather(halves, other), gather(halves + LANES, other), gather(halves + 2 * LANES, other)};
    };
    struct Partner { const int* at; };
    auto partner = [=](int i, int s, const int*) -> Partner { return {list_at(near, NEAR, s, i)}; };
    auto sources_in = [=](Four a, Four b, Four c) -> Sources {
        return {{c.y - a.x, c.z - a.y, c.w - a.z}, {c.y, c.z, c.w}, -a.w, {b.x, b.y, b.z, b.w, c.x}};
    };
    auto sources_at = [=](const int* j) -> Sources {
        return sources_in(four_at(seen, 0, j), four_at(seen, 1, j), four_at(seen, 2, j));
    };
    auto own_sources = [=](int i) -> Sources {
        return sources_in(own_four(seen, 0, i), own_four(seen, 1, i), own_four(seen, 2, i));
    };
    auto put_sources = [=](int i, const NUMBER* n) {
        const Vector m = own_moment(i);
        put_four(seen, 0, i, {n[5], n[6], n[7], n[13]});
        put_four(seen, 1, i, {n[8], n[9], n[10], n[11]});
        put_four(seen, 2, i, {n[12], m.x, m.y, m.z});
    };
    auto drive_in = [=](Four a, Four b, Four c) -> Drive {
        return {a.w, c.y, {a.x, a.y, a.z}, {b.x, b.y, b.z, b.w, c.x}};
    };
    auto drive_at = [=](const int* j) -> Drive {
        return drive_in(four_at(driven, 0, j), four_at(driven, 1, j), four_at(driven, 2, j));
    };
    auto own_drive = [=](int i) -> Drive {
        return drive_in(own_four(driven, 0, i), own_four(driven, 1, i), own_four(driven, 2, i));
    };
    auto put_drive = [=](int i, const NUMBER* n, NUMBER weight) {
        put_four(driven, 0, i, {n[5], n[6], n[7], n[13]});
        put_four(driven, 1, i, {n[0], n[1], n[2], n[3]});
        put_four(driven, 2, i, {n[4], weight, weight, weight});
    };
"""

_SHOW = f"{_TYPES}\n#if defined(__CUDA_ARCH__)\n{_SHOW_ON_GPU}\n#else\n{_SHOW_ON_CPU}\n#endif\n"

_PREPARE = """
    // On a CPU moments stand with the sources, of which a GPU has no need, where they are read at once.
    auto prepare = [=](int i) {
        const Vector m = own_moment(i);
        put_four(seen, 2, i, {numbers(rows_at(contact, STATE_ROWS, i) + 12 * LANES), m.x, m.y, m.z});
    };
    auto softness_of = [=](int i) -> Softness {
        const NUMBER slope = numbers(curve_slope + i), zero = slope * REAL(0), one = zero + 1;
        const Vector m = own_moment(i);
        const NUMBER over = numbers(unsaturated + i);
        const Vector reduced = {over * m.x, over * m.y, over * m.z};
        const NUMBER square = dot(reduced, reduced);
        NUMBER steepness = one - square;  // of tanh
        if (curve == CLAMPED) steepness = square < one ? one : zero;
        if (curve == LANGEVIN) {
            steepness *= 3 * steepness / (3 + square * square);
            const NUMBER x = 2 * root(square) - 1;
            NUMBER fit = zero;
            for (int k = 0; k < FITTED; ++k) fit = fit * x + STEEPNESS[k];
            steepness *= fit;
        }
        // 1/χ_d = 1/k_d − 1/3, and of the higher multipoles the polarizability 2χ/(2χ + 5)
        const NUMBER softer = smaller(larger(slope * steepness, zero), one * 3);
        const NUMBER p = softer / (REAL(2.5) + softer * REAL(1.0 / 6.0));
        return {p, p * numbers(hardness + i)};
    };
"""

_DRIVE = """
    // e = M ã, what quadrupoles move towards, and 4π H_near = (M_sr a − e)_m. What balls make that do not touch, and
    // what moments make, is summed by the first pass only, for the others to start from.
    auto drive_of = [&](int i, bool first, bool finds_field) {
        if (first) keep_softness(i, softness_of(i));
        // whole rounds of the threads that share a ball
        const int near_end = (most(contact_count + i) + WAYS - 1) / WAYS * WAYS;
        const int end = first ? (most(count + i) + WAYS - 1) / WAYS * WAYS : near_end;
        const NUMBER size = size_of(i), zero = size * REAL(0);
        NUMBER sum[16];
        #pragma unroll
        for (int c = 0; c < 16; ++c) sum[c] = DRIVES >> c & 1 && !first ? kept_sums(i, c) : zero;
        #pragma unroll
        for (int c = 0; c < 16 && first; ++c)
            if (DRIVES >> c & 1) keep_sum(i, c, zero);
        // slots of balls that nearly touch come last
        #pragma unroll 1
        for (int s = end - WAYS + way; s >= 0; s -= WAYS) {
            const SlotRows row = slot_rows(slot_at(pairs, NEAR, PAIR_ROWS, s, i), PAIR_ROWS);
            const Sources o = sources_at(partner(i, s, count).at);
            const Vector u = {row[0], row[1], row[2]}, t = o.t, m = o.m;
            const NUMBER q = o.q, along = dot(u, t), source = row[4], g2 = row[5], inverse = row[6], w = row[7];
            const NUMBER g1 = source * inverse, square = inverse * inverse;
            const NUMBER k3 = REAL(1.0 / 3.0) * w * g2, k4 = w * square * square, k5 = k4 * inverse;
            const Vector v = times(o.theta, u);
            const NUMBER f = dot(v, u);
            sum[13] += row[3] * q + source * along + k3 * f;
            const NUMBER pull = 5 * k4 * f - source * q - g2 * along;
            sum[5] += pull * u.x - g1 * t.x - 2 * k4 * v.x;
            sum[6] += pull * u.y - g1 * t.y - 2 * k4 * v.y;
            sum[7] += pull * u.z - g1 * t.z - 2 * k4 * v.z;
            if (first) {
                const NUMBER lone_pull = -g2 * dot(u, m);
                sum[8] += lone_pull * u.x - g1 * m.x;
                sum[14] += lone_pull * u.y - g1 * m.y;
                sum[15] += lone_pull * u.z - g1 * m.z;
            }
            // 3/2 of what is symmetric and traceless of y u
            const NUMBER c = k3 * q - 5 * k4 * along + REAL(35.0 / 3.0) * k5 * f;
            const NUMBER k = 2 * k4, b = REAL(-20.0 / 3.0) * k5;
            const Vector y = {k * t.x + b * v.x + c * u.x, k * t.y + b * v.y + c * u.y,
                              k * t.z + b * v.z + c * u.z};
            const NUMBER third = REAL(0.5) * dot(u, y);
            sum[0] += REAL(1.5) * u.x * y.x - third + k5 * o.theta.xx;
            sum[1] += REAL(1.5) * u.y * y.y - third + k5 * o.theta.yy;
            sum[2] += REAL(0.75) * (u.x * y.y + u.y * y.x) + k5 * o.theta.xy;
            sum[3] += REAL(0.75) * (u.y * y.z + u.z * y.y) + k5 * o.theta.yz;
            sum[4] += REAL(0.75) * (u.z * y.x + u.x * y.z) + k5 * o.theta.zx;
            if (first && s - way == near_end)
                #pragma unroll
                for (int c = 0; c < 16; ++c)
                    if (DRIVES >> c & 1) keep_sum(i, c, sum[c]);
        }
        add_up(sum, ALL);
        if (first) keep_lone_field(i, sum);
        const Softness soft = softness(i);
        const NUMBER p = soft.p, square = size * size, inverse = 1 / size, cube = inverse * inverse * inverse;
        const NUMBER source = OWN_SOURCE * inverse, dipole = OWN_DIPOLE * cube, fifth = cube * inverse * inverse;
        NUMBER drive[PART(16)], lack[PART(16)];
        #pragma unroll
        for (int k = 0; k < PART(STATE_ROWS); ++k) {
            const int c = k * WAYS + way;
            const NUMBER other = sum[k * WAYS], own = state(i, k);
            if (k * WAYS >= 8) {
                drive[k] = other - source * own;  // of number 13 only
                continue;
            }
            const bool quadrupole = c < 5;
            const NUMBER m = quadrupole ? zero : moment_of(i, c - 5);
            lack[k] = other - (quadrupole ? fifth : dipole) * own;
            drive[k] = quadrupole ? square * (1 - p) * lack[k] : size * (lack[k] + dipole * m);
            if (quadrupole) keep_goal(i, k + PART(8), (p - 1) * own - p * square * square * size * other);
        }
        put_drive(i, drive, soft.weight);
        if (!finds_field) return;
        const Vector h = {lone_field(i, 8) - number(lack, 5), lone_field(i, 14) - number(lack, 6),
                          lone_field(i, 15) - number(lack, 7)};
        put_field(i, h);
    };
"""

# What a ball sees of a contact, its own drive and that of the other ball.
_SEEN = """
    struct Seen { NUMBER phi, alpha, gamma; Vector field, pull; };  // R e_m, and R² e_Θ times the direction
    auto seen_by = [=](const Drive& o, Vector u, int sign) -> Seen {
        const Vector pull = times(o.t, u);
        return {o.phi, sign * dot(o.e, u), dot(pull, u), o.e, pull};
    };
    // D', J' or L', which balls of one kind have in common with D, J and L
    auto its = [=](const SlotRows& f, int row) -> NUMBER {
        const int other = row == 3 ? 14 : row == 9 ? 15 : 16;
    #if defined(__CUDA_ARCH__)
        return kinds > 1 ? f[other] : f[row];  // no array of registers has an index
    #else
        return f[kinds > 1 ? other : row];
    #endif
    };
"""

_TAKE = """
    // n towards ΔC e, and Θ̃ towards its place, by a heavy ball's step
    auto take = [&](int i) {
        const int slots = most(contact_count + i);
        const Drive own = own_drive(i);
        const NUMBER size = size_of(i), zero = size * REAL(0);
        NUMBER sum[16];
        #pragma unroll
        for (int c = 0; c < 16; ++c) sum[c] = zero;
        for (int s = way; s - way < slots; s += WAYS) {
            const SlotRows f = slot_rows(slot_at(contacts, CONTACTS, CONTACT_ROWS, s, i), CONTACT_ROWS);
            const Vector u = own_vector(slot_at(pairs, NEAR, PAIR_ROWS, s, i));
            const Drive other = drive_at(partner(i, s, contact_count).at);
            const NUMBER w = own.weight * other.weight;
            const Seen a = seen_by(own, u, 1), b = seen_by(other, u, -1);
            sum[13] += w * (f[0] * a.phi + f[1] * b.phi + f[2] * a.alpha + f[3] * b.alpha + f[8] * a.gamma
                + f[9] * b.gamma);
            const NUMBER g = f[6], h = f[7];
            const NUMBER along = w * (f[2] * a.phi + its(f, 3) * b.phi + (f[4] - g) * a.alpha + (f[5] + h) * b.alpha
                + f[10] * a.gamma + f[11] * b.gamma);
            const NUMBER on = w * g, on_b = w * h;
            sum[5] += size * (along * u.x + on * a.field.x + on_b * b.field.x);
            sum[6] += size * (along * u.y + on * a.field.y + on_b * b.field.y);
            sum[7] += size * (along * u.z + on * a.field.z + on_b * b.field.z);
            const NUMBER pull = w * (f[8] * a.phi + its(f, 9) * b.phi + f[10] * a.alpha + its(f, 11) * b.alpha
                + f[12] * a.gamma + f[13] * b.gamma);
            const NUMBER turned = REAL(1.5) * size * size * pull, third = REAL(0.5) * size * size * pull;
            sum[0] += turned * u.x * u.x - third;
            sum[1] += turned * u.y * u.y - third;
            sum[2] += turned * u.x * u.y;
            sum[3] += turned * u.y * u.z;
            sum[4] += turned * u.z * u.x;
        }
        add_up(sum, DRIVES);
        NUMBER moved[PART(16)];
        #pragma unroll
        for (int k = 0; k < PART(STATE_ROWS); ++k) {
            const int c = k * WAYS + way;
            const NUMBER now = state(i, k), there = c < 8 || c == 13 ? sum[k * WAYS] : goal(i, k);
            const NUMBER next = now + pace_of(i, k) * (there - now) + MOMENTUM * (now - last_state(i, k));
            moved[k] = next - next == zero ? next : zero;
            keep_last(i, k, now);
            keep_state(i, k, moved[k]);
        }
        put_sources(i, moved);
    };
"""

_HALVES = """
    // what a ball sees of its contacts' forces: derivatives of ½ e ΔC e by the other ball's place
    auto halve = [&](int i) {
        const int slots = most(contact_count + i);
        const Drive own = own_drive(i);
        for (int s = way; s - way < slots; s += WAYS) {
            const SlotRows f = slot_rows(slot_at(contacts, CONTACTS, CONTACT_ROWS, s, i), CONTACT_ROWS);
            const SlotRows g = slot_rows(slot_at(slopes, CONTACTS, SLOPE_ROWS, s, i), SLOPE_ROWS);
            const REAL* pair = slot_at(pairs, NEAR, PAIR_ROWS, s, i);
            const Vector u = own_vector(pair);
            const Drive drive = drive_at(partner(i, s, contact_count).at);
            const NUMBER w = own.weight * drive.weight;
            const Seen a = seen_by(own, u, 1), b = seen_by(drive, u, -1);
            const NUMBER square = dot(a.field, a.field) - a.alpha * a.alpha;
            const NUMBER mixed = dot(a.field, b.field) + a.alpha * b.alpha;
            // what both share counts half for each
            const NUMBER doubled = a.phi * (g[0] * a.phi + g[1] * b.phi) + a.alpha * (g[4] * a.alpha + g[5] * b.alpha)
                + g[6] * square + g[7] * mixed + a.gamma * (g[12] * a.gamma + g[13] * b.gamma);
            const NUMBER radial = REAL(0.5) * doubled
                + a.phi * (g[2] * a.alpha + g[3] * b.alpha + g[8] * a.gamma + g[9] * b.gamma)
                + a.alpha * (g[10] * a.gamma + g[11] * b.gamma);
            const NUMBER by_alpha = f[2] * a.phi + its(f, 3) * b.phi + (f[4] - f[6]) * a.alpha
                + (f[5] + f[7]) * b.alpha + f[10] * a.gamma + f[11] * b.gamma;
            const NUMBER by_gamma = 2 * (f[8] * a.phi + its(f, 9) * b.phi + f[10] * a.alpha + its(f, 11) * b.alpha
                + f[12] * a.gamma + f[13] * b.gamma);
            const NUMBER inverse = numbers(pair + 6 * LANES);
            const NUMBER rest = w * radial - w * inverse * (by_alpha * a.alpha + by_gamma * a.gamma);
            const NUMBER x = w * inverse * by_alpha, y = w * inverse * by_gamma;
            put_half(i, s, {rest * u.x + x * a.field.x + y * a.pull.x, rest * u.y + x * a.field.y + y * a.pull.y,
                            rest * u.z + x * a.field.z + y * a.pull.z});
        }
    };
"""

_PULL = """
    // forces, in units of μ0/4π: of the short-range parts, of quadrupoles and of contacts
    auto pull = [&](int i) {
        const NUMBER zero = numbers(radius + i) * REAL(0);
        Vector total = {zero, zero, zero};
        const Sources own = own_sources(i);
        const Vector t = own.t, m = own.m;
        const NUMBER q = own.q;
        const Tensor theta = own.theta;
        const int near_slots = most(count + i);
        for (int s = way; s - way < near_slots; s += WAYS) {
            const REAL* pair = slot_at(pairs, NEAR, PAIR_ROWS, s, i);
            auto row = [=](int r) -> NUMBER { return numbers(pair + r * LANES); };
            const REAL* change = slot_at(changes, NEAR, CHANGE_ROWS, s, i);
            const Sources its = sources_at(partner(i, s, count).at);
            const Vector u = own_vector(pair), m_j = its.m, t_j = its.t;
            const Tensor theta_j = its.theta;
            const NUMBER q_j = its.q, source = row(4), g2 = row(5), inverse = row(6), third = numbers(change);
            const NUMBER g1 = source * inverse, second = g2 * inverse;

            // dipoles: of what is left of them, less the actual ones
            const NUMBER a = dot(u, t), a_j = dot(u, t_j), lone = dot(u, m), lone_j = dot(u, m_j);
            const NUMBER among = (second * t.x) * t_j.x + (second * t.y) * t_j.y + (second * t.z) * t_j.z
                - (second * m.x) * m_j.x - (second * m.y) * m_j.y - (second * m.z) * m_j.z;
            NUMBER radial = source * q * q_j + q * g2 * a_j - q_j * g2 * a - among - (third * a) * a_j
                + (third * lone) * lone_j;
            const NUMBER on = g1 * q - second * a, on_j = -(g1 * q_j + second * a_j);
            total.x += on * t_j.x + on_j * t.x + second * (lone * m_j.x + lone_j * m.x);
            total.y += on * t_j.y + on_j * t.y + second * (lone * m_j.y + lone_j * m.y);
            total.z += on * t_j.z + on_j * t.z + second * (lone * m_j.z + lone_j * m.z);

            // quadrupoles: derivatives of their energy by the distance and by the direction
            const NUMBER w = row(7), slope = numbers(change + LANES);
            const NUMBER square = inverse * inverse, fourth = square * square;
            const Vector v = times(theta, u), v_j = times(theta_j, u);
            const NUMBER f = dot(v, u), f_j = dot(v_j, u);
            const NUMBER on_sources = q * f_j + q_j * f, k3 = REAL(1.0 / 3.0) * g2;
            const NUMBER on_dipoles = 5 * (a * f_j - a_j * f) - 2 * (dot(t, v_j) - dot(t_j, v));
            const NUMBER fifth = fourth * inverse;  // first, or else products of moments overflow
            const Tensor part = {fifth * theta_j.xx, fifth * theta_j.yy, fifth * theta_j.xy, fifth * theta_j.yz,
                                 fifth * theta_j.zx};
            const Vector v_part = {fifth * v_j.x, fifth * v_j.y, fifth * v_j.z};
            const NUMBER product = part.xx * theta.xx + part.yy * theta.yy
                + (part.xx + part.yy) * (theta.xx + theta.yy)
                + 2 * (part.xy * theta.xy + part.yz * theta.yz + part.zx * theta.zx);
            const NUMBER energy_4 = fourth * on_dipoles;
            const NUMBER energy_5 = (2 * product - 20 * dot(v, v_part) + 35 * (fifth * f_j) * f) * REAL(1.0 / 3.0);
            const Vector z = times(theta, t_j), z_j = times(theta_j, t), x = times(theta, v_part), x_j = times(part, v);
            auto turn_of = [=](NUMBER t, NUMBER t_j, NUMBER v, NUMBER v_j, NUMBER z, NUMBER x) -> NUMBER {
                return 2 * k3 * (q * v_j + q_j * v)
                    + fourth * (5 * (f_j * t - f * t_j) + 10 * (a * v_j - a_j * v) - 2 * z)
                    + REAL(70.0 / 3.0) * ((fifth * f_j) * v + (fifth * v_j) * f) - REAL(20.0 / 3.0) * x;
            };
            const Vector turn = {turn_of(t.x, t_j.x, v.x, v_j.x, z_j.x - z.x, x.x + x_j.x),
                                 turn_of(t.y, t_j.y, v.y, v_j.y, z_j.y - z.y, x.y + x_j.y),
                                 turn_of(t.z, t_j.z, v.z, v_j.z, z_j.z - z.z, x.z + x_j.z)};
            radial += slope * (k3 * on_sources + energy_4 + energy_5)
                + w * REAL(1.0 / 3.0) * (third + 2 * second) * on_sources
                - w * inverse * (4 * energy_4 + 5 * energy_5 + dot(turn, u));
            total.x += radial * u.x + w * inverse * turn.x;
            total.y += radial * u.y + w * inverse * turn.y;
            total.z += radial * u.z + w * inverse * turn.z;
        }
        const int contact_slots = most(contact_count + i);
        for (int s = way; s - way < contact_slots; s += WAYS) {
            const Vector half = own_half(i, s), other = other_half(i, s);
            total.x += other.x - half.x;
            total.y += other.y - half.y;
            total.z += other.z - half.z;
        }
        total = {total_of(total.x), total_of(total.y), total_of(total.z)};
        if (way > 0) return;
    #if defined(__CUDA_ARCH__)
        if (AT_ONCE) {
            tell(pulled + 4 * (size_t)i, total.x, total.y, total.z, 1);
            return;
        }
    #endif
        const Vector h = own_field(i);
        const Vector turn = {m.y * h.z - m.z * h.y, m.z * h.x - m.x * h.z, m.x * h.y - m.y * h.x};
        auto add = [=](REAL* out, Vector v, int l) {
            out[0] += UNIT * lane_of(v.x, l);
            out[1] += UNIT * lane_of(v.y, l);
            out[2] += UNIT * lane_of(v.z, l);
        };
        for (int l = 0; l < WIDTH; ++l) {
            if (movable[i + l] == 0) continue;
            add(forces + 3 * (size_t)(i + l), total, l);
            if (twisted[i + l] == 1) add(torques + 3 * (size_t)(i + l), turn, l);
        }
    };
"""

_LAW = """
    struct Fade { NUMBER value, slope; };
    auto smoothstep = [=](NUMBER x) -> Fade {
        const NUMBER zero = x * REAL(0), t = smaller(larger(x, zero), zero + 1);
        return {t * t * (3 - 2 * t), 6 * t * (1 - t)};
    };
    // fades between two gaps and between two overlaps
    auto window = [=](NUMBER gap, REAL near, REAL far, REAL shallow, REAL deep) -> Fade {
        const REAL width = 1 / (far - near), depth = 1 / (deep - shallow);
        const Fade outer = smoothstep((far - gap) * width), inner = smoothstep((deep + gap) * depth);
        return {outer.value * inner.value, outer.value * inner.slope * depth - outer.slope * inner.value * width};
    };
    // U of two homogeneous balls and its radial factors, as pair_law.averaged_factors has them where they overlap
    struct Factors { NUMBER u, g1, g2, g3; };
    auto factors = [=](NUMBER d, NUMBER i1, NUMBER a, NUMBER b) -> Factors {  // i1 = 1/d
        const NUMBER s = a + b, i2 = i1 * i1, i3 = i2 * i1;
        Factors f = {i1, -i3, 3 * i3 * i2, -15 * i3 * i2 * i2};
        if (!any(d < s)) return f;
        const NUMBER p = a * b, c = 1 / (160 * p * p * p), squares = a * a + b * b;
        NUMBER e = s - d, e2 = e * e, q0 = 5 * squares - 20 * p;
        const NUMBER q = q0 * i1 - 4 * s - d, q1 = -q0 * i2 - 1, q2 = 2 * q0 * i3, q3 = -6 * q0 * i3 * i1;
        const NUMBER w1 = c * e2 * e * (e * q1 - 4 * q) * i1;
        const NUMBER w2 = c * e2 * (12 * q - 8 * e * q1 + e2 * q2) * i2;
        const NUMBER w3 = c * e * (36 * e * q1 - 24 * q - 12 * e2 * q2 + e2 * e * q3) * i3;
        NUMBER g1 = w1 - i3, g2 = w2 - (w1 - 3 * i3) * i2, g3 = w3 - 3 * (w2 - w1 * i2) * i2 - 15 * i3 * i2 * i2;
        const auto deep = d <= REAL(0.5) * s;
        if (any(deep)) {
            const NUMBER delta = a - b, delta2 = delta * delta, k = 5 * delta2 * delta2 * (delta2 + 6 * p);
            const NUMBER u1 = 45 * s * s * delta2, u2 = -40 * s * (delta2 + p), u3 = 15 * (delta2 + 2 * p);
            g1 = deep ? c * (2 * u2 + 3 * u3 * d - 5 * d * d * d + (u1 - k * i2) * i1) : g1;
            g2 = deep ? c * (3 * u3 * i1 - 15 * d + (3 * k * i2 - u1) * i3) : g2;
            g3 = deep ? c * ((3 * u1 - 15 * k * i2) * i3 * i2 - 3 * u3 * i3 - 15 * i1) : g3;
            const auto within = d <= larger(delta, -delta);
            const NUMBER large = larger(a, b);
            g1 = within ? -1 / (large * large * large) : g1;
            g2 = within ? 0 * d : g2;
            g3 = within ? 0 * d : g3;
        }
        const NUMBER x = larger(d, REAL(0.05) * s);  // nearly concentric ones as touching
        e = s - x;
        e2 = e * e;
        const NUMBER u = (1 + e2 * e2 * (5 * squares - 20 * p - 4 * s * x - x * x) * c) / x;
        return {d < s ? u : f.u, d < s ? g1 : f.g1, d < s ? g2 : f.g2, d < s ? g3 : f.g3};
    };
"""

_PLACE = """
    // places and radii as others read them, and whether a ball has moved so far that near ones are sought anew
    auto place = [=](int i) {
        if (way > 0) return;
        const REAL* row = packed + i;
        const NUMBER x = numbers(row), y = numbers(row + moment_stride), z = numbers(row + 2 * moment_stride);
        const NUMBER size = numbers(row + 3 * moment_stride), zero = size * REAL(0);
        put_four(placed, 0, i, {x, y, z, size});
        put_four(placed, 1, i, {zero, number_of(indices(kind + i)), zero, zero});
        for (int l = 0; l < WIDTH; ++l) {
            if (group[i + l] < 0) continue;
            const REAL* found = found_at + 3 * (size_t)(i + l);
            const REAL rx = row[l] - found[0], ry = row[moment_stride + l] - found[1];
            const REAL rz = row[2 * moment_stride + l] - found[2], limit = SKIN * row[3 * moment_stride + l];
            if (!(rx * rx + ry * ry + rz * rz <= limit * limit)) *moved = 1;
        }
    };
"""

_SELECT = """
    // enter those of balls j that are chosen, 1 or 0, in the lists of balls i, of which so many slots are filled
    auto append = [=](int i, const int* j, INDEX chosen, int slots, int* filled) {
    #if defined(__CUDA_ARCH__)
        const int shift = threadIdx.x % 32 / WAYS * WAYS;
        const unsigned all = __ballot_sync(mates, chosen) >> shift & ((1u << WAYS) - 1u);
        const int s = *filled + __popc(all & ((1u << way) - 1u));
        if (chosen && s < slots) *list_at(near, NEAR, s, i) = *j;
        *filled += __popc(all);
    #else
        const Places count = places(chosen);
        for (int l = 0; l < WIDTH; ++l) {
            if (filled[l] < slots) list_at(near, NEAR, filled[l], i)[l] = j[l];
            filled[l] += count.at[l];
        }
    #endif
    };
    // the balls that are near now, those that nearly touch first, and how far a ball takes part
    auto select = [=](int i) {
        int own[WIDTH], filled[WIDTH], touching[WIDTH], largest = 0;
        for (int l = 0; l < WIDTH; ++l) {
            own[l] = group[i + l] < 0 || candidate_count[i + l] > CANDIDATES ? 0 : candidate_count[i + l];
            largest = own[l] > largest ? own[l] : largest;
            filled[l] = 0;
        }
        const Four at = own_four(placed, 0, i);
        const NUMBER owns = number_of(indices(own)), a = at.w, zero = a * REAL(0), one = zero + 1;
        NUMBER shared = zero;
        for (int apart = 0; apart < 2; ++apart) {
            for (int first = 0; first < largest; first += WAYS) {
                const int k = first + way;
                int j[WIDTH];
                for (int l = 0; l < WIDTH; ++l)
                    j[l] = k < own[l] ? candidate[(size_t)(i + l) * CANDIDATES + k] : i + l;
                const Four o = four_at(placed, 0, j);
                const Vector r = {o.x - at.x, o.y - at.y, o.z - at.z};
                const NUMBER d = root(dot(r, r)), b = o.w, sum = a + b;
                const auto near_now = (owns > REAL(k)) & (d < HALF_REACH * sum);
                const auto close = (d - sum) * sum < 2 * CONTACT_FAR * a * b;
                const NUMBER chosen = near_now ? (close ? one - apart : zero + apart) : zero;
                append(i, j, whole(chosen), apart ? NEAR : CONTACTS, filled);
                const auto overlap = near_now & (d < sum);
                if (apart || !any(overlap)) continue;
                const NUMBER small = smaller(a, b), large = larger(a, b), delta = large - small, e = sum - d, p = a * b;
                const NUMBER lens = e * e * (d * d + 2 * d * sum - 3 * delta * delta) / (16 * d) / (p * root(p));
                shared += overlap ? (d > delta ? lens : small / large * root(small / large)) : zero;
            }
            for (int l = 0; l < WIDTH && !apart; ++l) touching[l] = filled[l];
        }
        const NUMBER excess = (total_of(shared) - SHARED_LOW) * (1 / (SHARED_HIGH - SHARED_LOW));
        const NUMBER share = 1 - smoothstep(excess).value;
        for (int l = 0; l < WIDTH && way == 0; ++l) {
            const REAL part = lane_of(share, l);
            const bool fits = own[l] > 0 && filled[l] <= NEAR && touching[l] <= CONTACTS && part > 0;
            count[i + l] = fits ? filled[l] : 0;
            contact_count[i + l] = fits ? touching[l] : 0;
            placed[BLOCK * (size_t)(i + l) + 4] = fits ? part : 0;
        }
    };
"""

_TABULATE = """
    // slot of ball i in the list of another, or −1
    auto slot_of = [=](int i, int j) -> int {
        int place = -1;
        for (int s = 0; s < contact_count[j]; ++s) place = *list_at(near, NEAR, s, j) == i ? s : place;
        return place;
    };
    auto shared = [=](int i) -> REAL { return placed[BLOCK * (size_t)i + 4]; };
    // slots beyond a ball's count hold the ball itself
    auto fill_up = [=](int* list, int i, int s) {
        for (int l = 0; l < WIDTH; ++l) list[l] = s < count[i + l] ? list[l] : i + l;
    };
    // what does not change while balls stand still; slots that are no longer used are emptied
    auto tabulate = [=](int i) {
        const int counted = most(count + i), contact_slots = most(contact_count + i);
        const int used_slots = most(used + i), used_contacts = most(used + stride + i);
        const NUMBER counts = number_of(indices(count + i)), contact_counts = number_of(indices(contact_count + i));
        const Four own = own_four(placed, 0, i), own_part = own_four(placed, 1, i);
        const NUMBER a = own.w, zero = a * REAL(0), one = zero + 1;
        NUMBER sources = zero, dipoles = zero;
        const int slots = counted > used_slots ? counted : used_slots;
        for (int s = way; s < slots; s += WAYS) {
            int* const list = list_at(near, NEAR, s, i);
            fill_up(list, i, s);
            REAL* const pair = slot_at(pairs, NEAR, PAIR_ROWS, s, i);
            const Four other = four_at(placed, 0, list), part = four_at(placed, 1, list);
            const NUMBER share = counts > REAL(s) ? own_part.x * part.x : zero;
            const auto live = share > zero;
            const NUMBER b = live ? other.w : a + (a > zero ? zero : one), sum = a + b, unit = 1 / sum;
            const Vector r = {other.x - own.x, other.y - own.y, other.z - own.z};
            const NUMBER length = root(dot(r, r)), least = REAL(1e-6) * a;
            const NUMBER d = live ? (length > least ? length : least) : sum, inverse = 1 / d;
            auto keep = [=](int row, NUMBER n) { put(pair + row * LANES, live ? n : zero); };
            keep(0, r.x * inverse);
            keep(1, r.y * inverse);
            keep(2, r.z * inverse);
            // in units of the distance in contact: powers of metres overflow float32
            const NUMBER y = unit * d, over_y = sum * inverse, third = unit * unit * unit;
            const Factors whole_law = factors(y, over_y, unit * a, unit * b);
            const Factors far = factors(y, over_y, HALF_RANGE * unit * a, HALF_RANGE * unit * b);
            const NUMBER short_range = y < HALF_RANGE ? one : zero;
            keep(3, short_range * unit * (whole_law.u - far.u));
            keep(4, short_range * unit * unit * ((whole_law.g1 - far.g1) * y));
            keep(5, short_range * third * ((whole_law.g2 - far.g2) * y * y));
            keep(6, inverse);
            REAL* const change = slot_at(changes, NEAR, CHANGE_ROWS, s, i);
            put(change, live ? short_range * third * (unit * ((whole_law.g3 - far.g3) * y * y * y)) : zero);
            const NUMBER alike = smoothstep((smaller(a, b) / larger(a, b) - LEAST) * (1 / (MOST - LEAST))).value;
            const Fade quadrupole =
                window(2 * y - 2, QUADRUPOLE_NEAR, QUADRUPOLE_FAR, QUADRUPOLE_SHALLOW, QUADRUPOLE_DEEP);
            keep(7, share * alike * quadrupole.value);
            put(change + LANES, live ? share * alike * 2 * unit * quadrupole.slope : zero);

            if (s >= contact_slots && s >= used_contacts) continue;
            const NUMBER both = contact_counts > REAL(s) ? share * alike : zero;
            const auto touches = both > zero;
            REAL* const rows = slot_at(contacts, CONTACTS, CONTACT_ROWS, s, i);
            REAL* const slope_rows = slot_at(slopes, CONTACTS, SLOPE_ROWS, s, i);
            // coordinate of the table, and its derivative
            const NUMBER scale = 2 * a * b * unit, gap = (d - sum) / scale;
            const NUMBER outside = larger(gap, one * SMALLEST_GAP);
            const NUMBER z = smaller(gap - SMALLEST_GAP, zero) * (1 / SOFTNESS), steep = 1 / root(1 + z * z);
            NUMBER x = logarithm(outside) + (SOFTNESS / SMALLEST_GAP) * z * steep;
            x = smaller(larger((x - FIRST) * NODES_PER_UNIT, zero), one * (NODES - 1));
            const INDEX row = whole(smaller(x, one * (NODES - 2)));
            const NUMBER v = x - number_of(row), u = 1 - v, sixth = one * REAL(1.0 / 6.0);
            const NUMBER slope = REAL(0.5) * NODES_PER_UNIT * steep * steep * steep / outside;
            const NUMBER weights[4] = {sixth * u * u * u, sixth * (4 - 6 * v * v + 3 * v * v * v),
                                       sixth * (4 - 6 * u * u + 3 * u * u * u), sixth * v * v * v};
            const NUMBER tilts[4] = {-slope * u * u, slope * (3 * v * v - 4 * v), slope * (4 * u - 3 * u * u),
                                     slope * v * v};
            const Fade fade = window(gap, CONTACT_NEAR, CONTACT_FAR, SHALLOW, DEEP);
            const NUMBER part_value = scale * both * fade.value, part_slope = both * fade.slope;
            const NUMBER part_change = both * fade.value;
            const INDEX kind = whole(own_part.y), its_kind = whole(part.y);
            const Places lines = places((kind * kinds + its_kind) * (NODES + 2) + row);
            auto store = [=](int f, NUMBER value, NUMBER change) {
                put(rows + f * LANES, touches ? part_value * value : zero);
                put(slope_rows + f * LANES, touches ? part_change * change + part_slope * value : zero);
            };
            for (int quarter = 0; quarter < 4; ++quarter) {
                Four value = {zero, zero, zero, zero}, change = value;
                for (int k = 0; k < 4; ++k) {
                    const Four node = four_at(tables + BLOCK * k, quarter, lines.at);
                    value = {value.x + weights[k] * node.x, value.y + weights[k] * node.y,
                             value.z + weights[k] * node.z, value.w + weights[k] * node.w};
                    change = {change.x + tilts[k] * node.x, change.y + tilts[k] * node.y,
                              change.z + tilts[k] * node.z, change.w + tilts[k] * node.w};
                }
                store(4 * quarter, value.x, change.x);
                store(4 * quarter + 1, value.y, change.y);
                if (quarter == 0) sources += touches ? part_value * value.x : zero;
                if (quarter == 1) dipoles += touches ? part_value * (value.x + 2 * value.z) : zero;
                if (quarter == 3) break;
                store(4 * quarter + 2, value.z, change.z);
                store(4 * quarter + 3, value.w, change.w);
            }
            if (kinds > 1) {
                const Places others = places((its_kind * kinds + kind) * (NODES + 2) + row);
                NUMBER seen_d = zero, seen_j = zero, seen_l = zero;
                for (int k = 0; k < 4; ++k) {
                    seen_d += weights[k] * four_at(tables + BLOCK * k, 0, others.at).w;
                    const Four node = four_at(tables + BLOCK * k, 2, others.at);
                    seen_j += weights[k] * node.y;
                    seen_l += weights[k] * node.w;
                }
                put(rows + 14 * LANES, touches ? part_value * seen_d : zero);
                put(rows + 15 * LANES, touches ? part_value * seen_j : zero);
                put(rows + 16 * LANES, touches ? part_value * seen_l : zero);
            }
            for (int l = 0; l < WIDTH; ++l) {
                const int j = list[l];
                const bool touch = s < contact_count[i + l] && shared(i + l) * shared(j) > 0;
                const int place = touch ? slot_of(i + l, j) : -1;
            #if defined(__CUDA_ARCH__)
                list_at(mirror, CONTACTS, s, i)[l] = place < 0 ? -1 : j * CONTACTS + place;
            #else
                list_at(mirror, CONTACTS, s, i)[l] =
                    place < 0 ? CONTACTS * 3 * stride : (int)(slot_at(halves, CONTACTS, 3, place, j) - halves);
            #endif
            }
        }
        sources = total_of(sources);
        dipoles = total_of(dipoles) * REAL(1.0 / 3.0);
        if (way > 0) return;
        const NUMBER size = numbers(radius + i);
        put(ease + i, size / (size + OWN_SOURCE * sources));
        put(ease + stride + i, size / (size + OWN_DIPOLE * dipoles));
        put_indices(used + i, indices(count + i));
        put_indices(used + stride + i, indices(contact_count + i));
        if (!any(counts == zero)) return;
        for (int quarter = 0; quarter < 3 * SEEN_COPIES; ++quarter) {
            REAL* const copy = seen + BLOCK * (size_t)stride * (quarter / 3);
            const Four f = own_four(copy, quarter % 3, i);
            put_four(copy, quarter % 3, i, {counts > zero ? f.x : zero, counts > zero ? f.y : zero,
                                            counts > zero ? f.z : zero, counts > zero ? f.w : zero});
        }
        for (int c = 0; c < STATE_ROWS; ++c)
            for (int last = 0; last < 2; ++last) {
                REAL* const place = rows_at(last ? last_contact : contact, STATE_ROWS, i) + c * LANES;
                put(place, counts > zero ? numbers(place) : zero);
            }
    };
"""

_CONSTANTS = {
    "MOST_ROWS": max(PAIR_ROWS, CONTACT_ROWS),
    "FORCES": FORCES,
    "NEAR": NEAR,
    "CONTACTS": CONTACTS,
    "PAIR_ROWS": PAIR_ROWS,
    "CHANGE_ROWS": CHANGE_ROWS,
    "CONTACT_ROWS": CONTACT_ROWS,
    "SLOPE_ROWS": SLOPE_ROWS,
    "STATE_ROWS": STATE_ROWS,
    "OUTER_ROWS": OUTER_ROWS,
    "NODES": LOG_GAPS[2],
    "LANGEVIN": LANGEVIN,
    "CLAMPED": CLAMPED,
    "CANDIDATES": CANDIDATES,
    "FITTED": len(LANGEVIN_STEEPNESS),
}
_NUMBERS = {
    "UNIT": MU0 / (4.0 * math.pi),
    "OWN_SOURCE": OWN_SOURCE,
    "OWN_DIPOLE": OWN_DIPOLE,
    "PACE": _PACE,
    "MOMENTUM": _MOMENTUM,
    "HALF_RANGE": 0.5 * RANGE,
    "HALF_REACH": 0.5 * REACH,
    "SKIN": SKIN,
    "SHARED_LOW": MOST_SHARED[0],
    "SHARED_HIGH": MOST_SHARED[1],
    "LEAST": LEAST_RATIO[0],
    "MOST": LEAST_RATIO[1],
    "QUADRUPOLE_NEAR": QUADRUPOLE_REACH[0] - 2.0,
    "QUADRUPOLE_FAR": QUADRUPOLE_REACH[1] - 2.0,
    "QUADRUPOLE_SHALLOW": QUADRUPOLE_OVERLAP[0],
    "QUADRUPOLE_DEEP": QUADRUPOLE_OVERLAP[1],
    "CONTACT_NEAR": CONTACT_GAP[0],
    "CONTACT_FAR": CONTACT_GAP[1],
    "SHALLOW": DEEPEST[0],
    "DEEP": DEEPEST[1],
    "SMALLEST_GAP": SMALLEST_GAP,
    "SOFTNESS": SOFTNESS,
    "FIRST": LOG_GAPS[0],
    "NODES_PER_UNIT": (LOG_GAPS[2] - 1) / (LOG_GAPS[1] - LOG_GAPS[0]),
}
# those that sweeps read stand together, at the end of the integers and at the beginning of the reals
INTEGER_ARRAYS = (
    *("group", "kind", "candidate", "candidate_count", "moved", "used", "mirror", "row_of"),
    *("movable", "twisted", "near", "count", "contact_count", "turns"),
)
REAL_ARRAYS = (
    *("packed", "radius", "unsaturated", "curve_slope", "hardness", "ease", "pairs", "contacts", "contact"),
    *("last_contact", "seen", "driven", "field", "outer", "changes", "slopes", "halves", "pulled", "partial"),
    *("found_at", "tables", "placed", "forces", "torques"),
)


_ARRAYS = """
    const int kinds = arrays.kinds, curve = arrays.curve;
    const size_t moment_stride = arrays.moment_stride;
    const REAL* const moment = packed + 4 * moment_stride;
#if defined(__CUDA_ARCH__)
    constexpr int SEEN_COPIES = 4, AHEAD = 1;
#else
    constexpr int SEEN_COPIES = 1, AHEAD = 1;
#endif
    constexpr REAL STEEPNESS[FITTED] = {COEFFICIENTS};
""".replace("COEFFICIENTS", ", ".join(map(repr, LANGEVIN_STEEPNESS)))


def _text(real: str, body: str, passes: str, **options) -> str:
    return passes_text(
        real, WAYS, _CONSTANTS, _NUMBERS, INTEGER_ARRAYS, REAL_ARRAYS, _ARRAYS + body, passes, balls="arrays.balls",
        pointer="arrays.{}", **options,
    )  # fmt: skip


_SWEEP = """
    if (pass == 0) prepare(i);
    else if (pass % 2 == 0) take(i);
    else if (pass == 1) drive_of(i, true, false);
    else drive_of(i, false, pass == FORCES - 2);
"""
# What a thread of a GPU keeps of its ball from launch to launch.
_RECALL = """
    REAL* const outer_rows = rows_at(outer, OUTER_ROWS, i);
    recall(kept_state, rows_at(contact, STATE_ROWS, i), STATE_ROWS);
    recall(kept_last, rows_at(last_contact, STATE_ROWS, i), STATE_ROWS);
    turn = turns[i];
    kept_count = count[i];
    kept_contacts = contact_count[i];
    kept_size = radius[i];
    kept_moment = moment[(way < 5 ? 0 : way - 5) * moment_stride + i];
    kept_pace[0] = PACE * (way < 5 ? 1 : ease[stride + i]);
    kept_pace[1] = PACE * (way == 5 ? ease[i] : 1);
    for (int k = 0; k < NEAR / WAYS; ++k) partners[k] = *list_at(near, NEAR, way + k * WAYS, i);
    if (first > 1) {
        REAL rows[3];
        recall(rows, outer_rows, OUTER_ROWS);
        for (int c = 0; c < 8; ++c) kept_sum[c] = way == c ? rows[0] : 0;
        kept_sum[13] = way == 5 ? rows[1] : 0;
        kept_goal[1] = rows[1];
        kept_lone[1] = rows[2];
        kept_p = number(rows, 17);
        kept_weight = number(rows, 18);
    }
"""
_REMEMBER = """
    remember(kept_state, rows_at(contact, STATE_ROWS, i), STATE_ROWS);
    remember(kept_last, rows_at(last_contact, STATE_ROWS, i), STATE_ROWS);
    if (way == 0) turns[i] = turn;
    if (last < FORCES) {
        add_up(kept_sum, DRIVES);
        const REAL rows[3] = {kept_sum[0], way == 5 ? kept_sum[8] : kept_goal[1],
                              way == 1 ? kept_p : way == 2 ? kept_weight : kept_lone[1]};
        remember(rows, outer_rows, OUTER_ROWS);
    }
"""


def contact_text(real: str, forces: bool, at_once: bool = False) -> str:
    """Text of sweeps over contact sources and quadrupoles, and of two passes that find forces.

    Args:
        real: ``float`` or ``double``.
        forces: Whether the passes from ``FORCES`` on are wanted.
        at_once: Whether all passes go in one launch, which waits for what comes out (see ``near_contact_cuda``).
    """
    body = _SHOW + _PREPARE + _DRIVE + _SEEN + _TAKE + _HALVES * forces + _PULL * forces
    passes = f"if (pass == FORCES) halve(i); else if (pass > FORCES) pull(i); else {_SWEEP}" if forces else _SWEEP
    return _text(real, body, passes, at_once=at_once, recall=_RECALL, remember=_REMEMBER)


def place_text(real: str) -> str:
    """Text of what is done with an arrangement before near balls are sought, one pass."""
    return _text(real, _PLACE, "place(i);")


def tabulate_text(real: str) -> str:
    """Text of what is done when they are found, two passes."""
    return _text(real, _LAW + _SELECT + _TABULATE, "if (pass == 0) select(i); else tabulate(i);")
