// Solenoids as sheets of current, after Derby and Olbert 2010, "Cylindrical magnets and ideal solenoids", Am. J. Phys.
// 78, 229. With z± = z ± b, β±² = z±² + (a + ρ)², q± = α±/β±, γ = (a − ρ)/(a + ρ) and C = I/(2πb),
//
//     H_ρ = C Σ± ± (a/β±) cel(q±, 1, 1, −1),      H_z = C a/(a + ρ) Σ± ± (z±/β±) cel(q±, γ², 1, γ).
//
// A sheet is a pile of loops, so that ∂H/∂z is the difference of the fields of those at its ends; the field has no curl
// and no divergence, from which the other derivatives follow. As in loop.h, cel's first step is made by hand.
#pragma once
#include "applied/loop.h"

namespace warpmag {

// Field of a sheet of radius a from z = −b to b, of 2πb ampere-turns.
CUDA_CALLABLE inline FieldAt thin_solenoid(double a, double b, Point x) {
    const double rho = sqrt(x.x * x.x + x.y * x.y);
    double gamma = (a - rho) / (a + rho);
    if (fabs(gamma) < 1e-100) gamma = 1e-100; // in the sheet, where H_z jumps, as inside
    const double size = fabs(gamma), sign = gamma > 0 ? 1.0 : -1.0;
    double e = 0, hz = 0, f = 0, zz = 0;
    for (int end = 1; end >= -1; end -= 2) {
        const NearLoop at(a, rho, x.z + end * b);
        e -= end * 8 * a * a / (at.beta2 * at.beta * (1 + at.q)) * end_cel(at.q, 1 + at.q, 0, 1);
        const double cel = end_cel(at.q, at.q / size + size, 1 + 1 / gamma, 2 * (sign + at.q / size));
        hz += end * a / (a + rho) * (at.z / at.beta) * cel;
        f += end * at.radial();
        zz += end * at.axial();
    }
    return round_field(x, e, hz, -e - zz, f, zz);
}

// A solenoid, of parameters radius a, half its length b, and w [m]: nearer than that to an edge of the sheet, where the
// field is infinite, it is that of a wire; strength: ampere-turns [A].
CUDA_CALLABLE inline FieldAt solenoid_field(const AppliedSource& source, Point x) {
    const double a = source.parameters[0], b = source.parameters[1], w = source.parameters[2];
    InWire wire;
    Point surface;
    const bool inside = within_ring(a, w, b, x, wire, surface) || within_ring(a, w, -b, x, wire, surface);
    const FieldAt found = inside ? wire.inner(thin_solenoid(a, b, surface)) : thin_solenoid(a, b, x);
    return source.strength.x * INVERSE_PI / (2 * b) * found;
}
}
