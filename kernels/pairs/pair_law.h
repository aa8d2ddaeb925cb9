// The pair law of two magnetic moments, each spread over a ball, as far as native code needs it; pair_law.py has the
// equations and the names. Radial factors are templates of the number type, a scalar or a vector of them.
#pragma once
#include "shared/inverse_root.h"
#include "shared/vectors.h"

namespace warpmag {

// Radial factors g1, g2 d and g3 d³, of unit directions: they stay finite down to coincident centres.
template <class N> struct Factors {
    N g1, g2, g3;
};

// Those of overlapping balls of radii a and b, ``apart`` = |a − b|, at distance d < a + b, i1 = 1/d:
// U = 1/d + (a+b−d)⁴ (5a² − 20ab + 5b² − 4(a+b)d − d²) / (160 a³b³d), and g1 = −1/A³ where the smaller ball lies inside
// the larger of radius A. Two forms of the same expression: the printed one, with 6(a+b)e − 30ab − e² in the brackets,
// e = a+b−d, keeps its digits near contact and for very different radii, the Laurent polynomial in d for nearly
// concentric balls.
template <class N> CUDA_CALLABLE inline Factors<N> averaged_factors(N d, N a, N b, N apart) {
    const N p = a * b, s = a + b, i1 = 1 / d, c = 1 / (160 * p * p * p), large = larger(a, b), zero = N(Real(0));
    const auto inside = mask_of(d <= apart), outer_half = mask_of(d > Real(0.5) * s);
    Factors<N> far = {}, near = {};
    if (any(outer_half)) {
        const N i2 = i1 * i1, i3 = i2 * i1;
        const N e = s - d, e2 = e * e, e3 = e2 * e, e4 = e2 * e2, q0 = 5 * (a * a + b * b) - 20 * p;
        const N q = (6 * s * e - 30 * p - e2) * i1, q1 = -q0 * i2 - 1, q2 = 2 * q0 * i3, q3 = -6 * q0 * i3 * i1;
        const N w1 = c * (e4 * q1 - 4 * e3 * q) * i1, w2 = c * (12 * e2 * q - 8 * e3 * q1 + e4 * q2) * i1;
        const N w3 = c * (36 * e2 * q1 - 24 * e * q - 12 * e3 * q2 + e4 * q3);
        far = {w1 - i3, w2 - (w1 - 3 * i3) * i1, w3 - 3 * (w2 - w1 * i1) - 15 * i3 * i1};
    }
    if (any(mask_of(!outer_half))) {
        // u1/d² and k/d⁴ of the polynomial (k/d + u1 d + u2 d² + u3 d³ − d⁵ + ...) c
        const N t = apart * i1, apart2 = apart * apart;
        const N k = 5 * t * t * t * t * (apart2 + 6 * p), u1 = 45 * s * s * t * t;
        const N u2 = -40 * s * (apart2 + p), u3 = 15 * (apart2 + 2 * p);
        near = {c * (2 * u2 + (3 * u3 - 5 * d * d + u1 - k) * d), c * (3 * u3 - 15 * d * d + 3 * k - u1),
                c * (3 * u1 - 15 * k - 3 * u3 - 15 * d * d)};
    }
    const N g1 = outer_half ? far.g1 : near.g1, g2 = outer_half ? far.g2 : near.g2;
    const N g3 = outer_half ? far.g3 : near.g3;
    return {inside ? -1 / (large * large * large) : g1, inside ? zero : g2, inside ? zero : g3};
}

// What the clamped dipole lacks for an overlapping pair: averaged factors less those at the contact distance, with
// lengths in units of it, a + b = 1. Balls of one radius, most of all, have U'/d = −8 + 9d − 2d³.
template <class N> CUDA_CALLABLE inline Factors<N> overlap_factors(N d, N a, N b, N apart) {
    const N e = 1 - d;
    const Factors<N> same = {e * (e * (2 * e - 6) - 3), 3 * e * (3 + 2 * d), -3 * e * (3 + d * (3 + 5 * d))};
    const auto equal = apart == N(Real(0));
    if (!any(mask_of(!equal))) return same;
    const Factors<N> other = averaged_factors(d, a, b, apart);
    return {equal ? same.g1 : other.g1 + 1, equal ? same.g2 : other.g2 - 3 * d,
            equal ? same.g3 : other.g3 + 15 * d * d * d};
}

// Volume that two balls at squared distance d2 share, over the geometric mean of their volumes; zero where not wanted.
CUDA_CALLABLE inline Number shared_volume(Number d2, Number a, Number b, Mask wanted) {
    const Number p = a * b, s = a + b, large = larger(a, b), small = smaller(a, b), apart = large - small;
    const Number d = root(d2), ratio = small / large, e = s - d, zero = Number(Real(0));
    const Number lens = e * e * (d + 2 * s - 3 * apart * (apart / d)) / (16 * p * root(p));
    return (wanted & (d2 < s * s) & (p > zero)) ? (d <= apart ? ratio * root(ratio) : lens) : zero;
}

// Distance and unit direction of a separation, however small; no direction at none.
struct Polar {
    Number d;
    Vector u;
};
CUDA_CALLABLE inline Polar polar(Vector r) {
    const Number zero = Number(Real(0)), one = Number(Real(1));
    const Mask tiny = dot(r, r) < Real(1e-20); // times 2⁶⁰, for its square to keep its digits
    const Vector lifted = (tiny ? Number(Real(1.152921504606847e18)) : one) * r;
    const Number d = length(lifted);
    return {d * (tiny ? Number(Real(8.673617379884035e-19)) : one), (d > zero ? one / d : zero) * lifted};
}

// An overlapping pair in units of its contact distance, in which no power of it overflows: direction u, distance d,
// moment m and the factors of what a clamped dipole lacks.
struct Overlap {
    Number unit, d;
    Vector u, m;
    Factors<Number> g;
};
CUDA_CALLABLE inline Overlap overlap_of(Vector r, Number a, Number b, Vector m, Mask wanted) {
    const Number unit = 1 / (wanted ? a + b : Number(Real(1)));
    const Polar at = polar(unit * r);
    // |a − b| of the radii as they are: those in other units are rounded
    const Factors<Number> g = overlap_factors(at.d, unit * a, unit * b, unit * larger(a - b, b - a));
    return {unit, at.d, at.u, unit * unit * unit * m, g};
}

// 4π times the field that a clamped dipole lacks.
CUDA_CALLABLE inline Vector field_of(const Overlap& p) { return p.g.g1 * p.m + p.g.g2 * p.d * dot(p.u, p.m) * p.u; }

// Adds 4π times the fields of moments m at separations r, of balls of radii a and b.
CUDA_CALLABLE inline void add_pair_field(Vector& h, Vector r, Number a, Number b, Vector m, Mask wanted) {
    const Number d2 = dot(r, r), s = a + b, s2 = s * s, c = larger(d2, s2), zero = Number(Real(0));
    const Number i = (wanted & (c > zero)) ? Real(0.5) * twice_inverse_root(c) : zero, i2 = i * i, i3 = i2 * i;
    const Number along = 3 * i2 * (i3 * dot(r, m));
    h.x += along * r.x - i3 * m.x;
    h.y += along * r.y - i3 * m.y;
    h.z += along * r.z - i3 * m.z;
    const Mask overlapping = wanted & (d2 < s2);
    if (any(overlapping)) add_where(overlapping, h, field_of(overlap_of(r, a, b, m, overlapping)));
}

// 4π times the (e·∇)H that a clamped dipole lacks.
CUDA_CALLABLE inline Vector force_of(const Overlap& p, Vector e) {
    const Number along = dot(p.u, e), of = dot(p.u, p.m);
    const Vector across = along * p.m + of * e;
    const Number radial = p.g.g2 * dot(p.m, e) + p.g.g3 * of * along;
    return p.unit * (p.g.g2 * across + radial * p.u);
}

// Potential U of overlapping balls of radii a and b at distance d < a + b, in the forms of averaged_factors.
template <class N> CUDA_CALLABLE inline N averaged_potential(N d, N a, N b, N apart) {
    const N p = a * b, s = a + b, c = 1 / (160 * p * p * p), e = s - d, e2 = e * e, d2 = d * d, i1 = 1 / d;
    const N far = (1 + e2 * e2 * (6 * s * e - 30 * p - e2) * c) * i1;
    if (!any(mask_of(d <= larger(Real(0.5) * s, apart)))) return far;
    const N large = larger(a, b), small = s - large, apart2 = apart * apart;
    const N near = 24 * s * s * s * (5 * p - s * s) + 5 * apart2 * apart * (apart * i1) * (apart2 + 6 * p)
                   + d * (45 * s * s * apart2 + d * (-40 * s * (apart2 + p) + d * (15 * (apart2 + 2 * p) - d2)));
    const N inside = (3 * large * large - d2 - Real(0.6) * small * small) / (2 * large * large * large);
    return d <= apart ? inside : d > Real(0.5) * s ? far : near * c;
}
}
