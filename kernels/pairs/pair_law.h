// Pair law of two magnetic moments, each spread over a ball; pair_law.py has the equations and the names. Radial
// factors are templates of the number type N, a scalar or a vector of scalars.
#pragma once
#include "shared/inverse_root.h"
#include "shared/vectors.h"

namespace warpmag {

// Radial factors g1, g2 d and g3 d³, which multiply unit directions and stay finite down to coincident centers.
template <class N> struct Factors {
    N g1, g2, g3;
};

// Factors of overlapping balls of radii a and b, with ``apart`` = |a − b|, at distance d < a + b. The potential is
//
//     U = 1/d + (a+b−d)⁴ (5a² − 20ab + 5b² − 4(a+b)d − d²) / (160 a³b³d),
//
// and g1 = −1/A³ where the smaller ball lies inside the larger of radius A. The expression is evaluated in two forms.
// Near contact and for very different radii the form above is accurate, with 6(a+b)e − 30ab − e² in the brackets and
// e = a+b−d. For nearly concentric balls the Laurent polynomial in d is accurate.
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

// Correction of the clamped dipole for an overlapping pair: averaged factors minus dipole factors at contact, with
// lengths in units of the contact distance, a + b = 1. Equal radii have a short form, U'/d = −8 + 9d − 2d³.
template <class N> CUDA_CALLABLE inline Factors<N> overlap_factors(N d, N a, N b, N apart) {
    const N e = 1 - d;
    const Factors<N> same = {e * (e * (2 * e - 6) - 3), 3 * e * (3 + 2 * d), -3 * e * (3 + d * (3 + 5 * d))};
    const auto equal = apart == N(Real(0));
    if (!any(mask_of(!equal))) return same;
    const Factors<N> other = averaged_factors(d, a, b, apart);
    return {equal ? same.g1 : other.g1 + 1, equal ? same.g2 : other.g2 - 3 * d,
            equal ? same.g3 : other.g3 + 15 * d * d * d};
}

// Shared volume of two balls at squared distance d2, over the geometric mean of their volumes; zero in inactive lanes.
CUDA_CALLABLE inline Number shared_volume(Number d2, Number a, Number b, Mask active) {
    const Number p = a * b, s = a + b, large = larger(a, b), small = smaller(a, b), apart = large - small;
    const Number d = root(d2), ratio = small / large, e = s - d, zero = Number(Real(0));
    const Number lens = e * e * (d + 2 * s - 3 * apart * (apart / d)) / (16 * p * root(p));
    return (active & (d2 < s * s) & (p > zero)) ? (d <= apart ? ratio * root(ratio) : lens) : zero;
}

// Distance and unit direction of a separation, however small; the direction is zero for a zero separation.
struct Polar {
    Number d;
    Vector u;
};
CUDA_CALLABLE inline Polar polar(Vector r) {
    const Number zero = Number(Real(0)), one = Number(Real(1));
    const Mask tiny = dot(r, r) < Real(1e-20); // scaled by 2⁶⁰, so that the square does not underflow
    const Vector scaled = (tiny ? Number(Real(1.152921504606847e18)) : one) * r;
    const Number d = length(scaled);
    return {d * (tiny ? Number(Real(8.673617379884035e-19)) : one), (d > zero ? one / d : zero) * scaled};
}

// An overlapping pair in units of its contact distance, so that no power overflows: direction u, distance d, moment m,
// and the factors of the correction. ``unit`` is 1 over the contact distance.
struct Overlap {
    Number unit, d;
    Vector u, m;
    Factors<Number> g;
};
CUDA_CALLABLE inline Overlap overlap_of(Vector r, Number a, Number b, Vector m, Mask active) {
    const Number unit = 1 / (active ? a + b : Number(Real(1)));
    const Polar at = polar(unit * r);
    // |a − b| of the unscaled radii: scaled ones are rounded
    const Factors<Number> g = overlap_factors(at.d, unit * a, unit * b, unit * larger(a - b, b - a));
    return {unit, at.d, at.u, unit * unit * unit * m, g};
}

// Correction of 4π times the field, 4πH = g1 m + g2 d (u·m) u.
CUDA_CALLABLE inline Vector field_of(const Overlap& p) { return p.g.g1 * p.m + p.g.g2 * p.d * dot(p.u, p.m) * p.u; }

// Adds to h the field 4πH = 3 (r·m) r/d⁵ − m/d³ of moments m at separations r, of balls of radii a and b; d is clamped
// to the contact distance, and overlapping pairs are corrected.
CUDA_CALLABLE inline void add_pair_field(Vector& h, Vector r, Number a, Number b, Vector m, Mask active) {
    const Number d2 = dot(r, r), s = a + b, s2 = s * s, c = larger(d2, s2), zero = Number(Real(0));
    const Number i = (active & (c > zero)) ? Real(0.5) * twice_inverse_root(c) : zero, i2 = i * i, i3 = i2 * i;
    const Number along = 3 * i2 * (i3 * dot(r, m));
    h.x += along * r.x - i3 * m.x;
    h.y += along * r.y - i3 * m.y;
    h.z += along * r.z - i3 * m.z;
    const Mask overlapping = active & (d2 < s2);
    if (any(overlapping)) add_where(overlapping, h, field_of(overlap_of(r, a, b, m, overlapping)));
}

// Correction of 4π (e·∇)H = g2 [(u·e) m + (u·m) e] + [g2 m·e + g3 (u·m)(u·e)] u.
CUDA_CALLABLE inline Vector force_of(const Overlap& p, Vector e) {
    const Number ue = dot(p.u, e), um = dot(p.u, p.m);
    const Vector mixed = ue * p.m + um * e;
    const Number radial = p.g.g2 * dot(p.m, e) + p.g.g3 * um * ue;
    return p.unit * (p.g.g2 * mixed + radial * p.u);
}

// Potential U of overlapping balls of radii a and b at distance d < a + b, in the two forms of averaged_factors.
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
