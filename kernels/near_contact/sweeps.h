// Sweeps over near pairs. A sweep computes the drive e = M ã of all balls, then moves contact sources and quadrupoles a
// step towards ΔC e.
//
// Numbers of a ball's state, and of sums over its slots: 0 to 4 are xx, yy, xy, yz, zx of a quadrupole, 5 to 7 a
// dipole, 13 a source. From Python: PACE and MOMENTUM of a step, OWN_SOURCE and OWN_DIPOLE of M, SWEEPS.
#pragma once
#include "near_contact/images.h"

namespace warpmag {

constexpr unsigned DRIVES = 0x20ff,
                   DRIVES_AND_FIELD = 0xe1ff; // bits of the numbers of a drive; and 8, 14, 15 for (M_sr a)_m

// Polarizability p of a ball's quadrupole, and p relative to its value in a small field.
struct QuadrupoleResponse {
    Number p, weight;
};
CUDA_CALLABLE inline QuadrupoleResponse quadrupole_response(const NearArrays& a, int i) {
    const Number p = polarizability(differential_slope(a, i), 2);
    return {p, p * numbers(a.hardness + i)};
}

// Adds the drive by the sources of another ball to sums of φ, e_m and e_Θ. ``row`` holds the pair's numbers of
// ``tabulate.h``.
CUDA_CALLABLE inline void add_drive(Number (&sum)[16], const Rows<PAIR_ROWS>& row, const Sources& o) {
    const Vector u = {row[0], row[1], row[2]}, t = o.t;
    const Number q = o.q, along = dot(u, t), source = row[4], g2 = row[5], inverse = row[6], w = row[7];
    const Number g1 = source * inverse, square = inverse * inverse;
    const Number k3 = Real(1.0 / 3.0) * w * g2, k4 = w * square * square, k5 = k4 * inverse;
    const Vector v = o.theta * u;
    const Number f = dot(v, u);
    sum[13] += row[3] * q + source * along + k3 * f;
    const Number radial = 5 * k4 * f - source * q - g2 * along;
    sum[5] += radial * u.x - g1 * t.x - 2 * k4 * v.x;
    sum[6] += radial * u.y - g1 * t.y - 2 * k4 * v.y;
    sum[7] += radial * u.z - g1 * t.z - 2 * k4 * v.z;
    // 3/2 of the symmetric traceless part of y u
    const Number c = k3 * q - 5 * k4 * along + Real(35.0 / 3.0) * k5 * f;
    const Number k = 2 * k4, b = Real(-20.0 / 3.0) * k5;
    const Vector y = {k * t.x + b * v.x + c * u.x, k * t.y + b * v.y + c * u.y, k * t.z + b * v.z + c * u.z};
    const Number third = Real(0.5) * dot(u, y);
    sum[0] += Real(1.5) * u.x * y.x - third + k5 * o.theta.xx;
    sum[1] += Real(1.5) * u.y * y.y - third + k5 * o.theta.yy;
    sum[2] += Real(0.75) * (u.x * y.y + u.y * y.x) + k5 * o.theta.xy;
    sum[3] += Real(0.75) * (u.y * y.z + u.z * y.y) + k5 * o.theta.yz;
    sum[4] += Real(0.75) * (u.z * y.x + u.x * y.z) + k5 * o.theta.zx;
}

// Adds the field of another ball's moment to (M_sr a)_m, numbers 8, 14 and 15.
CUDA_CALLABLE inline void add_dipole_field(Number (&sum)[16], const Rows<PAIR_ROWS>& row, Vector m) {
    const Vector u = {row[0], row[1], row[2]};
    const Number g1 = row[4] * row[6], radial = -row[5] * dot(u, m);
    sum[8] += radial * u.x - g1 * m.x;
    sum[14] += radial * u.y - g1 * m.y;
    sum[15] += radial * u.z - g1 * m.z;
}

// Sums e = M ã over near balls, contacts last. The first sweep of an evaluation caches the sum over the other near
// balls, and the field of the moments. The following sweeps only add contacts.
template <bool FIRST>
CUDA_CALLABLE inline void sum_drive(const NearArrays& a, int i, Number (&sum)[16], const Parts<CACHED_ROWS>& cached) {
    Partners<NEAR_SLOTS> partners(a.near, i);
    const int contact_end = whole_rounds(largest_count(a.contact_count + i));
    const int end = FIRST ? whole_rounds(largest_count(a.near_count + i)) : contact_end;
    const Number zero = numbers(a.radius + i) * Real(0);
    Number far[16];
#pragma unroll
    for (int c = 0; c < 16; ++c) {
        // one thread of a group starts from the cached number
        sum[c] = !FIRST && DRIVES >> c & 1 && c % SHARES == share() ? cached[c / SHARES] : zero;
        far[c] = zero;
    }
#pragma unroll 1
    for (int s = end - SHARES + share(); s >= 0; s -= SHARES) {
        const Rows<PAIR_ROWS> row(a.pair(s, i));
        const Sources o = sources_at(a, partners.of(s));
        add_drive(sum, row, o);
        if (!FIRST) continue;
        add_dipole_field(sum, row, o.m);
        if (s - share() == contact_end)
#pragma unroll
            for (int c = 0; c < 16; ++c) far[c] = sum[c];
    }
    group_totals(sum, FIRST ? DRIVES_AND_FIELD : DRIVES);
    if (!FIRST) return;
    group_totals(far, DRIVES);
    Real* const rows = rows_at(a.cached, CACHED_ROWS, i);
#pragma unroll
    for (int c = 0; c < 16; ++c) {
        if (c % SHARES != share()) continue;
        if (DRIVES >> c & 1) put(rows + c * CHUNK, far[c / SHARES * SHARES]);
        if (c == 8 || c >= 14) put(rows + (8 + c) * CHUNK, sum[c / SHARES * SHARES]);
    }
}

// Writes the drive and the target of the quadrupoles, Θ̃ = −p R⁵ e' − (1 − p) n_Θ. Returns 4π H_near = (M_sr a − e)_m,
// or 0 in the first sweep.
template <bool FIRST> CUDA_CALLABLE inline Vector find_drive(const NearArrays& a, int i) {
    Real* const rows = rows_at(a.cached, CACHED_ROWS, i);
    const Parts<CACHED_ROWS> cached(rows);
    const Parts<STATE_ROWS> state(rows_at(a.state, STATE_ROWS, i));
    const Number size = numbers(a.radius + i), zero = size * Real(0);
    const QuadrupoleResponse response =
        FIRST ? quadrupole_response(a, i) : QuadrupoleResponse{number(cached, 17), number(cached, 18)};
    Number sum[16], drive[parts(16)], difference[parts(16)], m[parts(8)];
    for (int k = 0; k < parts(8); ++k) {
        const int component = k * SHARES + share() - 5;
        m[k] = component < 0 ? zero : numbers(a.moment(component < 0 ? 0 : component, i));
    }
    sum_drive<FIRST>(a, i, sum, cached);
    const Number p = response.p, square = size * size, inverse = 1 / size, cube = inverse * inverse * inverse;
    const Number source = OWN_SOURCE * inverse, dipole = OWN_DIPOLE * cube, fifth = cube * inverse * inverse;
#pragma unroll
    for (int k = 0; k < parts(14); ++k) {
        const int c = k * SHARES + share();
        const Number other = sum[k * SHARES];
        if (k * SHARES >= 8) {
            drive[k] = other - source * state[k]; // number 13 only
            continue;
        }
        const bool quadrupole = c < 5;
        const Number own = quadrupole ? state[k + parts(8)] : state[k];
        difference[k] = other - (quadrupole ? fifth : dipole) * own;
        drive[k] = quadrupole ? square * (1 - p) * difference[k] : size * (difference[k] + dipole * m[k]);
        if (quadrupole) put(rows + (c + 8) * CHUNK, (p - 1) * own - p * square * square * size * other);
    }
    store_line(a.drives, i, drive, {response.weight, zero, zero});
    mirror_drives(a, i);
    if (FIRST && share() == 0) {
        put(rows + 17 * CHUNK, response.p);
        put(rows + 18 * CHUNK, response.weight);
    }
    if (FIRST) return {zero, zero, zero};
    const Vector dipoles = {number(cached, 16), number(cached, 22), number(cached, 23)};
    return dipoles - Vector{number(difference, 5), number(difference, 6), number(difference, 7)};
}

// Drive of a ball at a contact in direction u: φ, α, γ, R e_m, and R² e_Θ u.
struct ContactDrive {
    Number phi, alpha, gamma;
    Vector field, gradient;
};
CUDA_CALLABLE inline ContactDrive at_contact(const Drive& o, Vector u, int sign) {
    const Vector gradient = o.t * u;
    return {o.phi, sign * dot(o.e, u), dot(gradient, u), o.e, gradient};
}
typedef Rows<CONDUCTANCE_ROWS> Conductances;
// D', J' or L' of the other ball, for row 3, 9 or 11. With one kind of material they equal D, J and L.
CUDA_CALLABLE inline Number other_conductance(const NearArrays& a, const Conductances& f, int row) {
    return a.kinds > 1 ? f[row == 3 ? 14 : row == 9 ? 15 : 16] : f[row];
}

// Adds the sources ΔC e of a contact of a ball of radius ``size``, from the drives of both balls.
CUDA_CALLABLE inline void add_contact_sources(const NearArrays& arrays, Number (&sum)[16], const Conductances& f,
                                              Vector u, Number size, const Drive& own, const Drive& other) {
    const Number w = own.weight * other.weight;
    const ContactDrive a = at_contact(own, u, 1), b = at_contact(other, u, -1);
    sum[13] += w * (f[0] * a.phi + f[1] * b.phi + f[2] * a.alpha + f[3] * b.alpha + f[8] * a.gamma + f[9] * b.gamma);
    const Number g = f[6], h = f[7];
    const Number along = w
                         * (f[2] * a.phi + other_conductance(arrays, f, 3) * b.phi + (f[4] - g) * a.alpha
                            + (f[5] + h) * b.alpha + f[10] * a.gamma + f[11] * b.gamma);
    const Number factor = w * g, factor_b = w * h;
    sum[5] += size * (along * u.x + factor * a.field.x + factor_b * b.field.x);
    sum[6] += size * (along * u.y + factor * a.field.y + factor_b * b.field.y);
    sum[7] += size * (along * u.z + factor * a.field.z + factor_b * b.field.z);
    const Number axial = w
                         * (f[8] * a.phi + other_conductance(arrays, f, 9) * b.phi + f[10] * a.alpha
                            + other_conductance(arrays, f, 11) * b.alpha + f[12] * a.gamma + f[13] * b.gamma);
    const Number turned = Real(1.5) * size * size * axial, third = Real(0.5) * size * size * axial;
    sum[0] += turned * u.x * u.x - third;
    sum[1] += turned * u.y * u.y - third;
    sum[2] += turned * u.x * u.y;
    sum[3] += turned * u.y * u.z;
    sum[4] += turned * u.z * u.x;
}

// Moves contact sources towards ΔC e, and quadrupoles towards their target, by a heavy-ball step:
// n ← n + α s (ΔC e − n) + β (n − n').
CUDA_CALLABLE inline void relax(const NearArrays& a, int i) {
    Partners<CONTACT_SLOTS> partners(a.near, i);
    Real *const rows = rows_at(a.state, STATE_ROWS, i), *const last_rows = rows_at(a.last_state, STATE_ROWS, i);
    const Parts<STATE_ROWS> state(rows), last(last_rows);
    const Parts<CACHED_ROWS> cached(rows_at(a.cached, CACHED_ROWS, i));
    const Number of_source = numbers(a.relaxation + i), of_dipole = numbers(a.relaxation + a.balls + i);
    const int slots = largest_count(a.contact_count + i);
    const Drive own = drive_at(a, OwnIndices(i).at);
    const Number size = numbers(a.radius + i), zero = size * Real(0), unit = zero + 1;
    Number sum[16], moved[parts(16)];
#pragma unroll
    for (int c = 0; c < 16; ++c) sum[c] = zero;
    for (int s = share(); s - share() < slots; s += SHARES) {
        const Conductances f(a.conductance(s, i));
        const Drive other = drive_at(a, partners.of(s));
        add_contact_sources(a, sum, f, own_vector(a.pair(s, i)), size, own, other);
    }
    group_totals(sum, DRIVES);
#pragma unroll
    for (int k = 0; k < parts(14); ++k) {
        const int c = k * SHARES + share();
        const bool contact_quadrupole = c >= 8 && c < 13; // number c − 8 of the sums
        const Number current = state[k];
        const Number contact = contact_quadrupole ? sum[k % parts(8) * SHARES] : sum[k * SHARES];
        const Number target = c < 5 ? cached[k + parts(8)] : contact;
        const Number pace = PACE * (c == 13 ? of_source : c >= 5 && c < 8 ? of_dipole : unit);
        const Number next = current + pace * (target - current) + MOMENTUM * (current - last[k]);
        moved[k] = next - next == zero ? next : zero;
        put(last_rows + c * CHUNK, current);
        put(rows + c * CHUNK, moved[k]);
    }
    store_line(a.sources, i, moved, MOMENTS_IN_LINES ? a.own_moment(i) : Vector{zero, zero, zero});
    mirror_sources(a, i);
}

// Writes moments to the lines of sources, and the images' lines.
CUDA_CALLABLE inline void store_moment(const NearArrays& a, int i) {
    const Vector m = a.own_moment(i);
    if (share() == 0) put_four(a.sources, 2, i, {numbers(rows_at(a.state, STATE_ROWS, i) + 13 * CHUNK), m.x, m.y, m.z});
    store_responses(a, i);
    mirror_sources(a, i);
}

// Pass 0 writes moments to lines, where needed; then each sweep is a pass for the drive and one for the step. Returns
// 4π H_near after the last drive.
CUDA_CALLABLE inline Vector sweep_pass(const NearArrays& a, int pass, int i) {
    if (pass == 1) return find_drive<true>(a, i);
    if (pass % 2 == 1) return find_drive<false>(a, i);
    if (pass > 0) relax(a, i);
    else if (MOMENTS_IN_LINES) store_moment(a, i);
    const Number zero = numbers(a.radius + i) * Real(0);
    return {zero, zero, zero};
}

// Sweeps of a field evaluation. The pass of the last drive writes 4π H_near to the partial sums of the field.
struct Sweeps {
    const NearArrays a;
    CUDA_CALLABLE void operator()(int pass, int i) const {
        const Vector h = sweep_pass(a, pass, i);
        if (pass != 2 * SWEEPS - 1 || share() > 0) return;
        for (int l = 0; l < WIDTH; ++l) {
            if (a.field_row[i + l] < 0) continue;
            Real* const part = a.partial + 3 * (size_t)a.field_row[i + l];
            part[0] = lane_of(h.x, l);
            part[1] = lane_of(h.y, l);
            part[2] = lane_of(h.z, l);
        }
    }
};
}
