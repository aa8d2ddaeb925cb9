// Forces and torques between near balls, in units of μ0/4π: of short-range parts, of quadrupoles and of contacts.
// Lengths are in radii of the ball, so that products of sources stay in float32's range.
#pragma once
#include "near_contact/image_forces.h"

namespace warpmag {

// Derivative of ½ e ΔC e by the other ball's position, for the ball's own half of ΔC. ``g`` holds the derivatives of A
// to P by the distance.
CUDA_CALLABLE inline Vector contact_force(const NearArrays& arrays, const Conductances& f,
                                          const Rows<CONDUCTANCE_SLOPE_ROWS>& g, Vector u, Number inverse,
                                          const Drive& own, const Drive& other) {
    const Number w = own.weight * other.weight;
    const ContactDrive a = at_contact(own, u, 1), b = at_contact(other, u, -1);
    const Number square = dot(a.field, a.field) - a.alpha * a.alpha;
    const Number mixed = dot(a.field, b.field) + a.alpha * b.alpha;
    // terms in both balls' halves count half for each
    const Number doubled = a.phi * (g[0] * a.phi + g[1] * b.phi) + a.alpha * (g[4] * a.alpha + g[5] * b.alpha)
                           + g[6] * square + g[7] * mixed + a.gamma * (g[12] * a.gamma + g[13] * b.gamma);
    const Number radial = Real(0.5) * doubled
                          + a.phi * (g[2] * a.alpha + g[3] * b.alpha + g[8] * a.gamma + g[9] * b.gamma)
                          + a.alpha * (g[10] * a.gamma + g[11] * b.gamma);
    const Number by_alpha = f[2] * a.phi + other_conductance(arrays, f, 3) * b.phi + (f[4] - f[6]) * a.alpha
                            + (f[5] + f[7]) * b.alpha + f[10] * a.gamma + f[11] * b.gamma;
    const Number by_gamma = 2
                            * (f[8] * a.phi + other_conductance(arrays, f, 9) * b.phi + f[10] * a.alpha
                               + other_conductance(arrays, f, 11) * b.alpha + f[12] * a.gamma + f[13] * b.gamma);
    const Number rest = w * radial - w * inverse * (by_alpha * a.alpha + by_gamma * a.gamma);
    const Number x = w * inverse * by_alpha, y = w * inverse * by_gamma;
    return rest * u + x * a.field + y * a.gradient;
}

// Writes the forces of a ball's contacts that the ball's own half of ΔC exerts.
CUDA_CALLABLE inline void store_contact_forces(const NearArrays& a, int i) {
    Partners<CONTACT_SLOTS> partners(a.near, i);
    const int slots = largest_count(a.contact_count + i);
    const Drive own = drive_at(a, OwnIndices(i).at);
    for (int s = share(); s - share() < slots; s += SHARES) {
        const Conductances f(a.conductance(s, i));
        const Rows<CONDUCTANCE_SLOPE_ROWS> g(a.conductance_slope(s, i));
        const Real* pair = a.pair(s, i);
        const Drive other = drive_at(a, partners.of(s));
        put_vector(a.pair_force(s, i), contact_force(a, f, g, own_vector(pair), numbers(pair + 6 * CHUNK), own, other));
    }
}

// Force on a ball by another ball in direction u: the sum of ``radial`` u and ``across``, which also has a component
// along u.
struct PairForce {
    Number radial;
    Vector across;
};

// Force of smooth sources and dipoles, less the force of the actual dipoles. ``third`` is g3 d³.
CUDA_CALLABLE inline PairForce dipole_force(const Sources& own, const Sources& other, Vector u, Number source,
                                            Number g2, Number inverse, Number third) {
    const Vector t = own.t, m = own.m, t_j = other.t, m_j = other.m;
    const Number g1 = source * inverse, second = g2 * inverse;
    const Number along = dot(u, t), along_j = dot(u, t_j), along_m = dot(u, m), along_m_j = dot(u, m_j);
    const Number mutual = dot(second * t, t_j) - dot(second * m, m_j);
    const Number radial = source * own.q * other.q + own.q * g2 * along_j - other.q * g2 * along - mutual
                          - (third * along) * along_j + (third * along_m) * along_m_j;
    const Number factor_j = g1 * own.q - second * along, factor = -(g1 * other.q + second * along_j);
    const Vector across = second * (along_m * m_j + along_m_j * m);
    return {radial, factor_j * t_j + factor * t + across};
}

// Force of quadrupoles on sources, dipoles and each other: derivatives of their energy by distance and direction, with
// the window w and its ``slope``. It is 0 where balls are so close that powers of 1/d overflow.
CUDA_CALLABLE inline PairForce quadrupole_force(const Sources& own, const Sources& other, Vector u, Number g2,
                                                Number inverse, Number third, Number w, Number slope) {
    const Vector t = own.t, t_j = other.t;
    const Traceless theta = own.theta, theta_j = other.theta;
    const Number q = own.q, q_j = other.q, a = dot(u, t), a_j = dot(u, t_j);
    const Number square = inverse * inverse, fourth = square * square;
    const Vector v = theta * u, v_j = theta_j * u;
    const Number f = dot(v, u), f_j = dot(v_j, u);
    const Number on_sources = q * f_j + q_j * f, k3 = Real(1.0 / 3.0) * g2;
    const Number on_dipoles = 5 * (a * f_j - a_j * f) - 2 * (dot(t, v_j) - dot(t_j, v));
    const Number fifth = fourth * inverse;
    const Number product = theta_j.xx * theta.xx + theta_j.yy * theta.yy
                           + (theta_j.xx + theta_j.yy) * (theta.xx + theta.yy)
                           + 2 * (theta_j.xy * theta.xy + theta_j.yz * theta.yz + theta_j.zx * theta.zx);
    const Number energy_4 = fourth * on_dipoles;
    const Number energy_5 = fifth * (2 * product - 20 * dot(v, v_j) + 35 * f_j * f) * Real(1.0 / 3.0);
    const Vector z = theta_j * t - theta * t_j, x = theta * v_j + theta_j * v;
    auto direction_derivative = [=](Number t, Number t_j, Number v, Number v_j, Number z, Number x) -> Number {
        return 2 * k3 * (q * v_j + q_j * v) + fourth * (5 * (f_j * t - f * t_j) + 10 * (a * v_j - a_j * v) - 2 * z)
               + fifth * (Real(70.0 / 3.0) * (f_j * v + v_j * f) - Real(20.0 / 3.0) * x);
    };
    const Vector across = {direction_derivative(t.x, t_j.x, v.x, v_j.x, z.x, x.x),
                           direction_derivative(t.y, t_j.y, v.y, v_j.y, z.y, x.y),
                           direction_derivative(t.z, t_j.z, v.z, v_j.z, z.z, x.z)};
    const Number second = g2 * inverse;
    const Number radial = slope * (k3 * on_sources + energy_4 + energy_5)
                          + w * Real(1.0 / 3.0) * (third + 2 * second) * on_sources
                          - w * inverse * (4 * energy_4 + 5 * energy_5 + dot(across, u));
    return {radial, w * inverse * across};
}

// Sources with lengths in radii of the ball.
CUDA_CALLABLE inline Sources in_radii(const Sources& o, Number inverse_radius) {
    const Number square = inverse_radius * inverse_radius, cube = square * inverse_radius;
    const Traceless t = o.theta;
    return {square * o.t,
            square * o.m,
            inverse_radius * o.q,
            {cube * t.xx, cube * t.yy, cube * t.xy, cube * t.yz, cube * t.zx}};
}

// Sum of the forces on a ball by its near balls [μ0/4π].
CUDA_CALLABLE inline Vector sum_forces(const NearArrays& a, int i, const Sources& sources) {
    const Number size = numbers(a.radius + i), zero = size * Real(0), square = size * size, inverse_radius = 1 / size;
    const Sources own = in_radii(sources, inverse_radius);
    Vector total = {zero, zero, zero};
    Partners<NEAR_SLOTS> partners(a.near, i);
    const int near_slots = largest_count(a.near_count + i), contact_slots = largest_count(a.contact_count + i);
    for (int s = share(); s - share() < near_slots; s += SHARES) {
        const Rows<PAIR_ROWS> row(a.pair(s, i));
        const Rows<PAIR_SLOPE_ROWS> slope(a.pair_slope(s, i));
        const Sources other = in_radii(sources_at(a, partners.of(s)), inverse_radius);
        const Vector u = {row[0], row[1], row[2]};
        const Number g1 = square * row[4], g2 = square * size * row[5], g3 = square * (square * slope[0]), w = row[7];
        const Number inverse = size * row[6], apart = w > zero ? inverse : zero;
        const PairForce d = dipole_force(own, other, u, g1, g2, inverse, g3);
        const PairForce q = quadrupole_force(own, other, u, g2, apart, g3, w, size * slope[1]);
        total += d.across;
        total += ((d.radial + q.radial) * u + q.across);
        if constexpr (IMAGES > 0) {
            const Vector force = d.across + ((d.radial + q.radial) * u + q.across);
            if (any(image_slot(a, partners.of(s)).live))
                total += image_force(a, i, s, partners.of(s), sources, force, s < contact_slots);
        }
    }
    for (int s = share(); s - share() < contact_slots; s += SHARES) {
        const int* counterpart = list_at(a.counterpart, CONTACT_SLOTS, s, i);
        const Real* forces = a.pair_forces;
        const Vector other_force = {gather(forces, counterpart), gather(forces + CHUNK, counterpart),
                                    gather(forces + 2 * CHUNK, counterpart)};
        total += (other_force - own_vector(a.pair_force(s, i)));
    }
    return {group_total(total.x), group_total(total.y), group_total(total.z)};
}

// Adds forces to movable moments, and torques m × 4π H_near to rotatable ones.
CUDA_CALLABLE inline void add_forces(const NearArrays& a, int i) {
    const Sources own = sources_at(a, OwnIndices(i).at);
    const Vector force = sum_forces(a, i, own);
    if (share() > 0) return;
    add_to(a.forces, i, force, a.movable);
    add_to(a.torques, i, cross(own.m, own_vector(rows_at(a.field, 3, i))), a.rotatable);
}

// Sweeps, with contact forces in the pass of the last step, then a pass for the sums of forces.
struct Forces {
    const NearArrays a;
    CUDA_CALLABLE void operator()(int pass, int i) const {
        if (pass > 2 * SWEEPS) {
            add_forces(a, i);
            return;
        }
        const Vector h = sweep_pass(a, pass, i);
        if (pass == 2 * SWEEPS - 1 && share() == 0) put_vector(rows_at(a.field, 3, i), h);
        if (pass == 2 * SWEEPS) store_contact_forces(a, i);
    }
};
}
