// Field of a circular current loop, by complete elliptic integrals in Bulirsch's form cel(k, p, a, b).
//
// With r² = ρ² + z², α² = z² + (a − ρ)², β² = z² + (a + ρ)², q = α/β, E and K of modulus √(1 − q²) and C = I/π,
//
//     H_ρ  = C z [(a² + r²) E − α² K]/(2 α² β ρ),         H_z = C [(a² − r²) E + α² K]/(2 α² β),
//     ∂H_ρ/∂z = C [P E − α² Q K]/(2 α⁴ β³ ρ),   P = (ρ² − a²)²(ρ² + a²) + 2 z² (a⁴ − 6 a² ρ² + ρ⁴) + z⁴ (a² + ρ²),
//                                                Q = (ρ² − a²)² + z² (ρ² + a²),
//     ∂H_z/∂z = C z [P E − α² Q K]/(2 α⁴ β³),    P = 6 a² (ρ² − z²) − 7 a⁴ + r⁴,   Q = r² − a²
//
// (Simpson, Lane, Immer and Youngquist 2001, "Simple analytic expressions for the magnetic field of a circular current
// loop", NASA). Near the axis and far away these expressions are small differences of large numbers. Two steps avoid
// the cancellation. The first step of cel is done in closed form: it gives c + s and 2 (s + c q) for cel(q, 1, c, s).
// The remaining difference P − αβ Q is written as (P² − α²β² Q²)/(P + αβ Q) where P + αβ Q does not cancel.
#pragma once
#include "applied/point_field.h"

namespace warpmag {

// A number N: double for coils, or a vector of Real for permanent bodies.
template <class N> constexpr bool is_double = sizeof(N) <= sizeof(double) ? sizeof(N) == 8 : sizeof(Real) == 8;
template <class N> CUDA_CALLABLE inline N number(double x) {
    if constexpr (sizeof(N) > sizeof(double)) return N(Real(x));
    else return N(x);
}
template <class N> CUDA_CALLABLE inline N square_root(N x) {
    if constexpr (sizeof(N) > sizeof(double)) return root(x);
    else return sqrt(x);
}
template <class N> CUDA_CALLABLE inline N magnitude(N x) {
    if constexpr (sizeof(N) > sizeof(double)) return larger(x, -x);
    else return fabs(x);
}

// factor × cel(q, p, c, s), with p and the sums c and s after the first step of the iteration.
template <class N> struct Cel {
    N factor, p, c, s;
};

// Writes the values of K integrals for each of M values of q, by Bulirsch's iteration (Bulirsch 1965). The integrals of
// one q share the arithmetic-geometric mean of 1 and q. The loop contains all integrals, because each square root and
// division takes long, and independent ones overlap.
template <class N, int M, int K>
CUDA_CALLABLE inline void evaluate(const N (&q)[M], const Cel<N> (&cel)[M][K], N (&values)[M][K]) {
    const N tolerance = number<N>(is_double<N> ? 1e-9 : 1e-4); // quadratic convergence: one more step is exact
    N p[M][K], c[M][K], s[M][K], k[M], product[M], mean[M], apart = 0 * q[0];
    for (int m = 0; m < M; ++m) {
        k[m] = product[m] = q[m], mean[m] = 1 + q[m], apart += magnitude(1 - q[m]);
        for (int n = 0; n < K; ++n) p[m][n] = cel[m][n].p, c[m][n] = cel[m][n].c, s[m][n] = cel[m][n].s;
    }
    for (int step = 0; step < 30 && any(mask_of(apart > tolerance)); ++step) {
        apart = 0 * apart;
        for (int m = 0; m < M; ++m) {
            k[m] = 2 * square_root(product[m]);
            product[m] = k[m] * mean[m];
            for (int n = 0; n < K; ++n) {
                const N f = c[m][n], inverse = 1 / p[m][n], g = product[m] * inverse;
                c[m][n] += s[m][n] * inverse;
                s[m][n] = 2 * (s[m][n] + f * g);
                p[m][n] += g;
            }
            apart += magnitude(mean[m] - k[m]) / mean[m];
            mean[m] += k[m];
        }
    }
    for (int m = 0; m < M; ++m)
        for (int n = 0; n < K; ++n)
            values[m][n] = number<N>(1.5707963267948966) * cel[m][n].factor * (s[m][n] + c[m][n] * mean[m])
                           / (mean[m] * (mean[m] + p[m][n]));
}

// A point near a loop of radius a about the z axis: ρ, z, α², β² and q. It counts as no nearer to the loop than the
// root of ``least2``.
template <class N> struct LoopPoint {
    N a, rho, z, alpha2, beta2, beta, q;

    CUDA_CALLABLE LoopPoint(N a, N rho, N z, N least2) : a(a), rho(rho), z(z) {
        alpha2 = z * z + (a - rho) * (a - rho), beta2 = z * z + (a + rho) * (a + rho);
        alpha2 = alpha2 > least2 ? alpha2 : least2;
        beta = square_root(beta2), q = square_root(alpha2) / beta;
    }

    // H_ρ/ρ of π ampere-turns.
    CUDA_CALLABLE Cel<N> radial() const {
        return {4 * a * a * z / (alpha2 * beta * beta2), 1 + q, 0 * q + 1, 2 * q / (1 + q)};
    }
    // H_z of π ampere-turns.
    CUDA_CALLABLE Cel<N> axial() const {
        const N term = 4 * a * rho * rho / beta2, p = 1 + q;
        return {a / (alpha2 * beta), p, a * (1 + q * q) - term, 2 * q * (a * p - term / p)};
    }
};

// Field of a thin loop of radius a about the z axis in the plane z = 0, of π ampere-turns.
CUDA_CALLABLE inline PointField thin_loop(double a, Point x) {
    const double z = x.z, z2 = z * z, a2 = a * a, rho2 = x.x * x.x + x.y * x.y, rho = sqrt(rho2), r2 = rho2 + z2;
    const LoopPoint<double> at(a, rho, z, 0);
    const double q = at.q, p = 1 + q, ab = sqrt(at.alpha2) * at.beta;
    const double outer = 0.5 / (at.alpha2 * at.alpha2 * at.beta2 * at.beta);
    const double a4 = a2 * a2, rho4 = rho2 * rho2, z4 = z2 * z2, d2 = (rho2 - a2) * (rho2 - a2), s2 = rho2 + a2;

    // ∂H_ρ/∂z: both sums are divided by ρ²
    const double p1 = d2 * s2 + 2 * z2 * (a4 - 6 * a2 * rho2 + rho4) + z4 * s2, q1 = d2 + z2 * s2;
    const double c1 = 8 * a2 * (d2 - 2 * z2 * s2 - 3 * z4) / at.beta2;
    const double n1 = 4 * a2
                      * (d2 * d2 - 4 * z2 * (a2 * a4 - a4 * rho2 - a2 * rho4 + rho2 * rho4)
                         - z4 * (11 * a4 - 38 * a2 * rho2 + 11 * rho4) - 6 * z4 * z2 * s2);
    const double s1 = p1 > 0 ? n1 / (p1 + ab * q1) : (p1 - ab * q1) / rho2;

    // ∂H_z/∂z
    const double p2 = 6 * a2 * (rho2 - z2) - 7 * a4 + r2 * r2, q2 = r2 - a2;
    const double c2 = -4 * a2 * (3 * a4 + 2 * a2 * rho2 + 6 * a2 * z2 - 5 * rho4 - 2 * rho2 * z2 + 3 * z4) / at.beta2;
    const double n2 = -4 * a2
                      * (-12 * a2 * a4 + a4 * (20 * rho2 - 21 * z2) - a2 * (4 * rho4 - 26 * rho2 * z2 + 6 * z4)
                         - 4 * rho2 * rho4 - 5 * rho4 * z2 + 2 * rho2 * z4 + 3 * z4 * z2);
    const double s2z = p2 > 0 && q2 > 0 ? n2 / (p2 + ab * q2) : p2 - ab * q2;

    const Cel<double> integrals[][4] = {
        {at.radial(), at.axial(), {outer, p, c1, 2 * q * p * s1}, {outer * z, p, c2, 2 * q * p * s2z}}};
    const double of_q[] = {q};
    double values[1][4];
    evaluate<double>(of_q, integrals, values);
    const double e = values[0][0], hz = values[0][1], f = values[0][2], zz = values[0][3];
    return axisymmetric_field(x, e, hz, -e - zz, f, zz);
}

// Returns true if x is less than w away from the circle of radius a about the z axis at ``height``. In that case writes
// the point in the wire and the surface point.
CUDA_CALLABLE inline bool within_ring(double a, double w, double height, Point x, InWire& wire, Point& surface) {
    const double rho = sqrt(x.x * x.x + x.y * x.y), outward = rho - a, upward = x.z - height,
                 d = sqrt(outward * outward + upward * upward);
    if (!(d < w)) return false;
    const Point radial = {x.x / rho, x.y / rho, 0};
    const double cosine = d > 0 ? outward / d : 1.0;
    const Point n = {cosine * radial.x, cosine * radial.y, d > 0 ? upward / d : 0.0};
    wire = {n, {-radial.y, radial.x, 0}, d, w, (a + w * cosine) / rho};
    surface = a * radial + w * n + Point{0, 0, height};
    return true;
}

// Loop. Parameters: radius a and wire radius w ≤ a/2 [m]. Strength: ampere-turns [A].
CUDA_CALLABLE inline PointField loop_field(const AppliedSource& source, Point x) {
    const double a = source.parameters[0];
    InWire wire;
    Point surface;
    const bool inside = within_ring(a, source.parameters[1], 0, x, wire, surface);
    const PointField field = inside ? wire.inner_field(thin_loop(a, surface)) : thin_loop(a, x);
    return source.strength.x * INVERSE_PI * field;
}
}
