// Field of a solenoid as a sheet of current, after Derby and Olbert 2010, "Cylindrical magnets and ideal solenoids",
// Am. J. Phys. 78, 229. With z± = z ± b, β±² = z±² + (a + ρ)², q± = α±/β±, γ = (a − ρ)/(a + ρ) and C = I/(2πb),
//
//     H_ρ = C Σ± ± (a/β±) cel(q±, 1, 1, −1),      H_z = C a/(a + ρ) Σ± ± (z±/β±) cel(q±, γ², 1, γ).
//
// A sheet is a stack of loops, so ∂H/∂z is the difference of the fields of the loops at its ends. The other derivatives
// follow from curl H = 0 and div H = 0. As in loop.h, the first step of cel is done in closed form.
#pragma once
#include "applied/loop.h"

namespace warpmag {

// Field of an axisymmetric source: e = H_ρ/ρ, H_z, f = (∂H_ρ/∂z)/ρ and ∂H_z/∂z.
template <class N> struct AxisymmetricField {
    N e, hz, f, z_z;
};
// Field at (ρ, z) of a thin sheet of radius a from z = −b to b, of 2πb ampere-turns: of its ends from ``begin`` on,
// every
// ``step``-th. Points count as no nearer to the circles at the ends than the root of ``least2``.
template <class N>
CUDA_CALLABLE inline AxisymmetricField<N> thin_solenoid(N a, N b, N rho, N z, N least2, int begin, int step) {
    const N zero = a * 0, one = zero + 1, tiny = number<N>(is_double<N> ? 1e-100 : 1e-6);
    N gamma = (a - rho) / (a + rho);
    gamma = gamma < tiny && gamma > -tiny ? tiny : gamma; // H_z jumps at the sheet: points on it count as inside
    const N sign = gamma > zero ? one : -one, size = sign * gamma;
    AxisymmetricField<N> field = {zero, zero, zero, zero};
    for (int k = begin; k < 2; k += step) {
        const N end = one - 2 * k;
        const LoopPoint<N> at(a, rho, z + end * b, least2);
        const N q = at.q, p = 1 + q;
        field.e -= end * 8 * a * a / (at.beta2 * at.beta * p) * cel_after_step<N>(q, p, zero, one);
        const N cel = cel_after_step<N>(q, q / size + size, 1 + 1 / gamma, 2 * (sign + q / size));
        field.hz += end * a / (a + rho) * (at.z / at.beta) * cel;
        field.f += end * at.radial();
        field.z_z += end * at.axial();
    }
    return field;
}
CUDA_CALLABLE inline PointField thin_solenoid(double a, double b, Point x) {
    const auto field = thin_solenoid<double>(a, b, sqrt(x.x * x.x + x.y * x.y), x.z, 0, 0, 1);
    return axisymmetric_field(x, field.e, field.hz, -field.e - field.z_z, field.f, field.z_z);
}

// Solenoid. Parameters: radius a, half-length b, and wire radius w [m]. The field of the sheet diverges at its ends;
// less than w away from an end it is that of a wire. Strength: ampere-turns [A].
CUDA_CALLABLE inline PointField solenoid_field(const AppliedSource& source, Point x) {
    const double a = source.parameters[0], b = source.parameters[1], w = source.parameters[2];
    InWire wire;
    Point surface;
    const bool inside = within_ring(a, w, b, x, wire, surface) || within_ring(a, w, -b, x, wire, surface);
    const PointField field = inside ? wire.inner_field(thin_solenoid(a, b, surface)) : thin_solenoid(a, b, x);
    return source.strength.x * INVERSE_PI / (2 * b) * field;
}
}
