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

// Field of a thin sheet of radius a from z = −b to b, of 2πb ampere-turns.
CUDA_CALLABLE inline PointField thin_solenoid(double a, double b, Point x) {
    const double rho = sqrt(x.x * x.x + x.y * x.y);
    double gamma = (a - rho) / (a + rho);
    if (fabs(gamma) < 1e-100) gamma = 1e-100; // H_z jumps at the sheet: points on it count as inside
    const double size = fabs(gamma), sign = gamma > 0 ? 1.0 : -1.0;
    const LoopPoint upper(a, rho, x.z + b), lower(a, rho, x.z - b);
    const auto across = [&](const LoopPoint& at) -> Cel { // H_ρ/ρ
        return {-8 * a * a / (at.beta2 * at.beta * (1 + at.q)), 1 + at.q, 0, 1};
    };
    const auto along = [&](const LoopPoint& at) -> Cel { // H_z
        return {a / (a + rho) * (at.z / at.beta), at.q / size + size, 1 + 1 / gamma, 2 * (sign + at.q / size)};
    };
    const Cel integrals[][4] = {{across(upper), along(upper), upper.radial(), upper.axial()},
                                {across(lower), along(lower), lower.radial(), lower.axial()}};
    const double q[] = {upper.q, lower.q};
    double values[2][4];
    evaluate(q, integrals, values);
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
