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

// γ of a sheet of radius a at the distance rho from its axis, never 0. H_z jumps at the sheet: points on it count as
// inside, where γ is positive.
template <class N> CUDA_CALLABLE inline N sheet_gamma(N a, N rho) {
    const N tiny = number<N>(is_double<N> ? 1e-100 : 1e-6), gamma = (a - rho) / (a + rho);
    return magnitude(gamma) < tiny ? tiny : gamma;
}
// Writes q and the integrals of one end of a thin sheet of current of radius a, at the height z above that end. H_ρ/ρ,
// H_z, (∂H_ρ/∂z)/ρ and ∂H_z/∂z of 2πb ampere-turns are those of the upper end less those of the lower end.
template <class N> CUDA_CALLABLE inline void put_sheet_end(N a, N rho, N z, N least2, N& q, Cel<N> (&integrals)[4]) {
    const N unit = 0 * a + 1, gamma = sheet_gamma(a, rho), size = magnitude(gamma), sign = gamma > 0 ? unit : -unit;
    const LoopPoint<N> at(a, rho, z, least2);
    q = at.q;
    integrals[0] = {-8 * a * a / (at.beta2 * at.beta * (1 + q)), 1 + q, 0 * a, unit};
    integrals[1] = {a / (a + rho) * (at.z / at.beta), q / size + size, 1 + 1 / gamma, 2 * (sign + q / size)};
    integrals[2] = at.radial(), integrals[3] = at.axial();
}
// Field of a thin sheet of radius a from z = −b to b, of 2πb ampere-turns.
CUDA_CALLABLE inline PointField thin_solenoid(double a, double b, Point x) {
    const double rho = sqrt(x.x * x.x + x.y * x.y);
    double q[2], values[2][4];
    Cel<double> integrals[2][4];
    put_sheet_end<double>(a, rho, x.z + b, 0, q[0], integrals[0]);
    put_sheet_end<double>(a, rho, x.z - b, 0, q[1], integrals[1]);
    evaluate<double>(q, integrals, values);
    const auto difference = [&](int n) { return values[0][n] - values[1][n]; };
    const double e = difference(0), hz = difference(1), f = difference(2), zz = difference(3);
    return axisymmetric_field(x, e, hz, -e - zz, f, zz);
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
