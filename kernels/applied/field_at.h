// A field and its gradient at a place, in the frame of a source, and the sources themselves. All of it is in double
// precision: few terms are summed, and closed forms are differences of large numbers.
#pragma once
#include "pairs/pair_terms.h"

namespace warpmag {

typedef Vec3<double> Point;

constexpr double INVERSE_PI = 0.3183098861837907;

// H [A/m] and its derivatives along x, y and z [A/m²]. The gradient need not be symmetric: within a conductor, and
// between the nodes of a table, a field has a curl.
struct FieldAt {
    Point h, dx, dy, dz;

    // Derivative of H along v.
    CUDA_CALLABLE Point along(Point v) const { return v.x * dx + v.y * dy + v.z * dz; }
};
CUDA_CALLABLE inline FieldAt operator+(const FieldAt& a, const FieldAt& b) {
    return {a.h + b.h, a.dx + b.dx, a.dy + b.dy, a.dz + b.dz};
}
CUDA_CALLABLE inline FieldAt& operator+=(FieldAt& a, const FieldAt& b) { return a = a + b; }
CUDA_CALLABLE inline FieldAt operator*(double k, const FieldAt& f) { return {k * f.h, k * f.dx, k * f.dy, k * f.dz}; }

CUDA_CALLABLE inline double norm(const Point& v) { return sqrt(dot(v, v)); }

// A source: its strength, PARAMETERS numbers and a table of ``count`` vectors, as its kind understands them.
struct AppliedSource {
    int kind;
    Point strength;
    const double* parameters;
    const Point* table;
    int count;
};

// Derivatives of the field of something round from those in the half-plane of the place: e = H_ρ/ρ, H_z, ∂H_ρ/∂ρ, and
// f = (∂H_ρ/∂z)/ρ = (∂H_z/∂ρ)/ρ, ∂H_z/∂z.
CUDA_CALLABLE inline FieldAt round_field(Point x, double e, double hz, double rho_rho, double f, double z_z) {
    const double rho2 = x.x * x.x + x.y * x.y, g = rho2 > 0 ? (rho_rho - e) / rho2 : 0.0;
    return {{e * x.x, e * x.y, hz},
            {e + g * x.x * x.x, g * x.x * x.y, f * x.x},
            {g * x.x * x.y, e + g * x.y * x.y, f * x.y},
            {f * x.x, f * x.y, z_z}};
}

// A wire of radius w carries its current evenly: nearer to its axis than that, the field falls to zero in proportion to
// the distance d. Where it is evaluated instead is w away from the axis, in the direction n. ``tangent`` is the axis's,
// zero about the end of a straight piece; to move along the axis by some length there moves by ``stretch`` times that.
struct InWire {
    Point n, tangent;
    double distance, radius, stretch;

    // d times how the place moves where the field is evaluated.
    CUDA_CALLABLE Point moved(Point v) const {
        const double out = dot(n, v), on = dot(tangent, v);
        return radius * (v - out * n - on * tangent) + (distance * stretch * on) * tangent;
    }
    CUDA_CALLABLE FieldAt inner(const FieldAt& at_surface) const {
        const double slope = 1 / radius;
        auto derivative = [&](Point v) { return slope * (at_surface.along(moved(v)) + dot(n, v) * at_surface.h); };
        return {(slope * distance) * at_surface.h, derivative({1, 0, 0}), derivative({0, 1, 0}), derivative({0, 0, 1})};
    }
};
}
