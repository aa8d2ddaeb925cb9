// Field and gradient at one point in the frame of a coil or field map. All numbers are in double precision, because
// closed forms are differences of large numbers. The cost is small, because few terms are summed.
#pragma once
#include "pairs/pair_terms.h"

namespace warpmag {

typedef Vec3<double> Point;

constexpr double INVERSE_PI = 0.3183098861837907;

// H [A/m] and its derivatives along x, y and z [A/m²]. The gradient need not be symmetric: a field has a curl inside a
// conductor, and between the nodes of a field map.
struct PointField {
    Point h, dx, dy, dz;

    // (v·∇)H
    CUDA_CALLABLE Point along(Point v) const { return v.x * dx + v.y * dy + v.z * dz; }
};
CUDA_CALLABLE inline PointField operator+(const PointField& a, const PointField& b) {
    return {a.h + b.h, a.dx + b.dx, a.dy + b.dy, a.dz + b.dz};
}
CUDA_CALLABLE inline PointField& operator+=(PointField& a, const PointField& b) { return a = a + b; }
CUDA_CALLABLE inline PointField operator*(double k, const PointField& f) {
    return {k * f.h, k * f.dx, k * f.dy, k * f.dz};
}

CUDA_CALLABLE inline double norm(const Point& v) { return sqrt(dot(v, v)); }

// A coil or field map: strength, parameters, and a table of ``count`` vectors. Each kind defines their meaning.
struct AppliedSource {
    int kind;
    Point strength;
    const double* parameters;
    const Point* table;
    int count;
};

// Field and gradient of an axisymmetric source from e = H_ρ/ρ, H_z, ∂H_ρ/∂ρ, f = (∂H_ρ/∂z)/ρ = (∂H_z/∂ρ)/ρ and
// ∂H_z/∂z at x.
CUDA_CALLABLE inline PointField axisymmetric_field(Point x, double e, double hz, double rho_rho, double f, double z_z) {
    const double rho2 = x.x * x.x + x.y * x.y, g = rho2 > 0 ? (rho_rho - e) / rho2 : 0.0;
    return {{e * x.x, e * x.y, hz},
            {e + g * x.x * x.x, g * x.x * x.y, f * x.x},
            {g * x.x * x.y, e + g * x.y * x.y, f * x.y},
            {f * x.x, f * x.y, z_z}};
}

// A point inside a wire of radius w with uniform current density. The field there is d/w times the field at the wire's
// surface, with d the distance from the axis. The surface point lies w away from the axis in the direction n.
//
// ``tangent`` is the direction of the axis, or zero about the end of a straight piece. The surface point moves by
// ``stretch`` times a motion along the tangent.
struct InWire {
    Point n, tangent;
    double distance, radius, stretch;

    // d times the motion of the surface point, for a motion v of the point.
    CUDA_CALLABLE Point surface_motion(Point v) const {
        const double out = dot(n, v), on = dot(tangent, v);
        return radius * (v - out * n - on * tangent) + (distance * stretch * on) * tangent;
    }
    CUDA_CALLABLE PointField inner_field(const PointField& at_surface) const {
        const double slope = 1 / radius;
        auto derivative = [&](Point v) {
            return slope * (at_surface.along(surface_motion(v)) + dot(n, v) * at_surface.h);
        };
        return {(slope * distance) * at_surface.h, derivative({1, 0, 0}), derivative({0, 1, 0}), derivative({0, 0, 1})};
    }
};
}
