// The pair law of two magnetic moments, each spread over a ball, as far as native code needs it; pair_law.py has the
// equations and the names. Radial factors are templates of the number type, a scalar or a vector of them.
#pragma once
#include "shared/inverse_root.h"
#include "shared/vectors.h"

namespace warpmag {

#if !defined(__CUDA_ARCH__)
// of scalars, as vectors.h has it of vectors
inline bool any(bool mask) { return mask; }
inline bool mask_of(bool condition) { return condition; }
inline bool mask_of(int condition) { return condition; }
inline Real larger(Real a, Real b) { return a > b ? a : b; }
#endif

template <class N> struct Factors {
    N g1, g2, g3;
};

// Radial factors of overlapping balls of radii a and b at distance d < a + b, i1 = 1/d:
// U = 1/d + (a+b−d)⁴ (5a² − 20ab + 5b² − 4(a+b)d − d²) / (160 a³b³d), and −1/A³ where the smaller ball lies inside the
// larger of radius A. Two forms of the same expression: the printed one keeps its digits near contact and for very
// different radii, the Laurent polynomial in d keeps them for nearly concentric balls.
template <class N> CUDA_CALLABLE inline Factors<N> averaged_factors(N d, N a, N b) {
    const N p = a * b, s = a + b, i1 = 1 / d, i2 = i1 * i1, i3 = i2 * i1, c = 1 / (160 * p * p * p);
    const N large = larger(a, b), apart2 = (a - b) * (a - b), zero = N(Real(0));
    const auto inside = mask_of((d * d <= apart2) | (d == zero)), outer_half = mask_of(d > Real(0.5) * s);
    Factors<N> far = {}, near = {};
    if (any(outer_half)) {
        const N e = s - d, e2 = e * e, e3 = e2 * e, e4 = e2 * e2, q0 = 5 * (a * a + b * b) - 20 * p;
        const N q = q0 * i1 - 4 * s - d, q1 = -q0 * i2 - 1, q2 = 2 * q0 * i3, q3 = -6 * q0 * i3 * i1;
        const N w1 = c * (e4 * q1 - 4 * e3 * q) * i1, w2 = c * (12 * e2 * q - 8 * e3 * q1 + e4 * q2) * i2;
        const N w3 = c * (36 * e2 * q1 - 24 * e * q - 12 * e3 * q2 + e4 * q3) * i3;
        far = {w1 - i3, w2 - (w1 - 3 * i3) * i2, w3 - 3 * (w2 - w1 * i2) * i2 - 15 * i3 * i2 * i2};
    }
    if (any(mask_of(!outer_half))) {
        const N k = 5 * apart2 * apart2 * (apart2 + 6 * p);
        const N u1 = 45 * s * s * apart2, u2 = -40 * s * (apart2 + p), u3 = 15 * (apart2 + 2 * p);
        near = {c * (2 * u2 + 3 * u3 * d - 5 * d * d * d + (u1 - k * i2) * i1),
                c * (3 * u3 * i1 - 15 * d + (3 * k * i2 - u1) * i3),
                c * ((3 * u1 - 15 * k * i2) * i3 * i2 - 3 * u3 * i3 - 15 * i1)};
    }
    const N g1 = outer_half ? far.g1 : near.g1, g2 = outer_half ? far.g2 : near.g2;
    const N g3 = outer_half ? far.g3 : near.g3;
    return {inside ? -1 / (large * large * large) : g1, inside ? zero : g2, inside ? zero : g3};
}

// What the clamped dipole lacks for an overlapping pair: averaged factors less those at the contact distance, with
// lengths in units of it, a + b = 1. Balls of one radius, most of all, have U'/d = −8 + 9d − 2d³.
template <class N> CUDA_CALLABLE inline Factors<N> overlap_factors(N d, N a, N b) {
    // bounded: the factors of coincident balls meet a separation of zero
    const N e = 1 - d, i = 1 / larger(d, N(Real(1e-6)));
    const Factors<N> same = {e * (e * (2 * e - 6) - 3), e * (9 * i + 6), -e * i * (9 * i * (i + 1) + 15)};
    const auto equal = a == b;
    if (!any(mask_of(!equal))) return same;
    const Factors<N> other = averaged_factors(d, a, b);
    return {equal ? same.g1 : other.g1 + 1, equal ? same.g2 : other.g2 - 3, equal ? same.g3 : other.g3 + 15};
}

// Volume that two balls at squared distance d2 share, over the geometric mean of their volumes; zero where not wanted.
CUDA_CALLABLE inline Number shared_volume(Number d2, Number a, Number b, Mask wanted) {
    const Number p = a * b, s = a + b, large = larger(a, b), small = smaller(a, b), apart = large - small;
    const Number d = root(d2), ratio = small / large, e = s - d, zero = Number(Real(0));
    const Number lens = e * e * (d2 + 2 * d * s - 3 * apart * apart) / (16 * d * p * root(p));
    return (wanted & (d2 < s * s) & (p > zero)) ? (d <= apart ? ratio * root(ratio) : lens) : zero;
}

// An overlapping pair in units of its contact distance, in which no power of r overflows: separation r, moment m and
// the factors of what a clamped dipole lacks.
struct Overlap {
    Number unit;
    Vector r, m;
    Factors<Number> g;
};
CUDA_CALLABLE inline Overlap overlap_of(Vector r, Number a, Number b, Vector m, Mask wanted) {
    const Number unit = 1 / (wanted ? a + b : Number(Real(1)));
    const Vector apart = scaled(unit, r);
    return {unit, apart, scaled(unit * unit * unit, m), overlap_factors(root(dot(apart, apart)), unit * a, unit * b)};
}

// 4π times the field that a clamped dipole lacks.
CUDA_CALLABLE inline Vector field_of(const Overlap& p) {
    return sum(scaled(p.g.g1, p.m), scaled(p.g.g2 * dot(p.r, p.m), p.r));
}

// Adds 4π times the fields of moments m at separations r, of balls of radii a and b.
CUDA_CALLABLE inline void add_pair_field(Vector& h, Vector r, Number a, Number b, Vector m, Mask wanted) {
    const Number d2 = dot(r, r), s = a + b, s2 = s * s, c = larger(d2, s2), zero = Number(Real(0));
    const Number i = (wanted & (c > zero)) ? Real(0.5) * twice_inverse_root(c) : zero, i2 = i * i, i3 = i2 * i;
    const Number along = 3 * i3 * i2 * dot(r, m);
    h.x += along * r.x - i3 * m.x;
    h.y += along * r.y - i3 * m.y;
    h.z += along * r.z - i3 * m.z;
    const Mask overlapping = wanted & (d2 < s2);
    if (any(overlapping)) add_where(overlapping, h, field_of(overlap_of(r, a, b, m, overlapping)));
}

// 4π times the (e·∇)H that a clamped dipole lacks.
CUDA_CALLABLE inline Vector force_of(const Overlap& p, Vector e) {
    const Number along = dot(p.r, e), of = dot(p.r, p.m);
    const Vector across = sum(scaled(along, p.m), scaled(of, e));
    const Number radial = p.g.g2 * dot(p.m, e) + p.g.g3 * of * along;
    return scaled(p.unit, sum(scaled(p.g.g2, across), scaled(radial, p.r)));
}

// Potential U of balls of radii a and b at distance d, 1/d from contact on; nearly concentric ones as at 0.05 (a + b).
template <class N> CUDA_CALLABLE inline N averaged_potential(N d, N a, N b) {
    const N p = a * b, s = a + b, c = 1 / (160 * p * p * p), x = larger(d, Real(0.05) * s), e = s - x, e2 = e * e;
    const N u = (1 + e2 * e2 * (5 * (a * a + b * b) - 20 * p - 4 * s * x - x * x) * c) / x;
    return d < s ? u : 1 / d;
}
}
