// The pair law of two magnetic moments, each spread over a ball; pair_law.py has the equations and the names.
//
// The functions are templates of the number type, a scalar or a vector of them, with ``any`` of a mask and ``larger``,
// ``smaller`` and ``root`` of numbers found for it.
#pragma once
#include "shared/inverse_root.h"
#include "shared/vectors.h"

namespace warpmag {

template <class N> struct Factors {
    N g1, g2, g3;
};

// Radial factors of overlapping balls of radii a and b at distance d < a + b, i1 = 1/d:
// U = 1/d + (a+b−d)⁴ (5a² − 20ab + 5b² − 4(a+b)d − d²) / (160 a³b³d), and −1/A³ where the smaller ball lies inside the
// larger of radius A. Two forms of the same expression: the printed one keeps its digits near contact and for very
// different radii, the Laurent polynomial in d keeps them for nearly concentric balls.
template <class N> CUDA_CALLABLE inline Factors<N> averaged_factors(N d, N a, N b) {
    const N p = a * b, s = a + b, i1 = 1 / d, i2 = i1 * i1, i3 = i2 * i1, c = 1 / (160 * p * p * p);
    const N e = s - d, e2 = e * e, e3 = e2 * e, e4 = e2 * e2, q0 = 5 * (a * a + b * b) - 20 * p;
    const N q = q0 * i1 - 4 * s - d, q1 = -q0 * i2 - 1, q2 = 2 * q0 * i3, q3 = -6 * q0 * i3 * i1;
    const N w1 = c * (e4 * q1 - 4 * e3 * q) * i1, w2 = c * (12 * e2 * q - 8 * e3 * q1 + e4 * q2) * i2;
    const N w3 = c * (36 * e2 * q1 - 24 * e * q - 12 * e3 * q2 + e4 * q3) * i3;
    const Factors<N> far = {w1 - i3, w2 - (w1 - 3 * i3) * i2, w3 - 3 * (w2 - w1 * i2) * i2 - 15 * i3 * i2 * i2};
    const N apart2 = (a - b) * (a - b), k = 5 * apart2 * apart2 * (apart2 + 6 * p);
    const N u1 = 45 * s * s * apart2, u2 = -40 * s * (apart2 + p), u3 = 15 * (apart2 + 2 * p);
    const Factors<N> near = {c * (2 * u2 + 3 * u3 * d - 5 * d * d * d + (u1 - k * i2) * i1),
                             c * (3 * u3 * i1 - 15 * d + (3 * k * i2 - u1) * i3),
                             c * ((3 * u1 - 15 * k * i2) * i3 * i2 - 3 * u3 * i3 - 15 * i1)};
    const N large = larger(a, b), zero = N(Real(0));
    const auto inside = (d * d <= apart2) | (d == zero);
    const auto outside_half = d > Real(0.5) * s;
    return {inside         ? -1 / (large * large * large)
            : outside_half ? far.g1
                           : near.g1,
            inside         ? zero
            : outside_half ? far.g2
                           : near.g2,
            inside         ? zero
            : outside_half ? far.g3
                           : near.g3};
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

// Adds 4π times what the fields of moments m at separations r have beyond those of clamped dipoles.
CUDA_CALLABLE inline void add_overlap_field(Vector& h, Vector r, Number a, Number b, Vector m, Mask overlapping) {
    const Number unit = 1 / (overlapping ? a + b : Number(Real(1)));
    const Vector apart = scaled(unit, r), moment = scaled(unit * unit * unit, m);
    const Factors<Number> g = overlap_factors(root(dot(apart, apart)), unit * a, unit * b);
    add_where(overlapping, h, sum(scaled(g.g1, moment), scaled(g.g2 * dot(apart, moment), apart)));
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
    if (any(overlapping)) add_overlap_field(h, r, a, b, m, overlapping);
}

// The overlap field's counterpart in (e·∇)H.
CUDA_CALLABLE inline void add_overlap_force(Vector& f, Vector r, Number a, Number b, Vector m, Vector e,
                                            Mask overlapping) {
    const Number unit = 1 / (overlapping ? a + b : Number(Real(1)));
    const Vector apart = scaled(unit, r), moment = scaled(unit * unit * unit, m);
    const Factors<Number> g = overlap_factors(root(dot(apart, apart)), unit * a, unit * b);
    const Number along = dot(apart, e), of = dot(apart, moment);
    const Vector across = sum(scaled(along, moment), scaled(of, e));
    const Number radial = g.g2 * dot(moment, e) + g.g3 * of * along;
    add_where(overlapping, f, scaled(unit, sum(scaled(g.g2, across), scaled(radial, apart))));
}

// Potential U of balls of radii a and b at distance d, 1/d from contact on; nearly concentric ones as at 0.05 (a + b).
template <class N> CUDA_CALLABLE inline N averaged_potential(N d, N a, N b) {
    const N p = a * b, s = a + b, c = 1 / (160 * p * p * p), x = larger(d, Real(0.05) * s), e = s - x, e2 = e * e;
    const N u = (1 + e2 * e2 * (5 * (a * a + b * b) - 20 * p - 4 * s * x - x * x) * c) / x;
    return d < s ? u : 1 / d;
}
}
