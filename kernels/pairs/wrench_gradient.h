// Gradient of a function of forces and torques between moments; wrench_gradient.py has the equations.
//
// From Python: INVERSE_4PI, MU0 [T·m/A] and GROUP, the threads of a GPU that share a target. ``Arrays`` is the struct
// of wrench_gradient.py. On a CPU a vector of targets is visited at a time.
#pragma once
#include "pairs/pair_law.h"
#include "shared/group.h"
#include "shared/team.h"

namespace warpmag {

// g4 d⁴ of two overlapping balls, with g4 = g3'/d, in the two forms of averaged_factors.
template <class N> CUDA_CALLABLE inline N averaged_fourth_factor(N d, N a, N b, N apart) {
    const N p = a * b, s = a + b, i1 = 1 / d, c = 1 / (160 * p * p * p);
    const N i2 = i1 * i1, i3 = i2 * i1, e = s - d, e2 = e * e, e3 = e2 * e, e4 = e2 * e2;
    const N q0 = 5 * (a * a + b * b) - 20 * p, q = (6 * s * e - 30 * p - e2) * i1, q1 = -q0 * i2 - 1;
    const N q2 = 2 * q0 * i3, q3 = -6 * q0 * i3 * i1, q4 = 24 * q0 * i3 * i2;
    const N w1 = c * (e4 * q1 - 4 * e3 * q), w2 = c * (12 * e2 * q - 8 * e3 * q1 + e4 * q2);
    const N w3 = c * (36 * e2 * q1 - 24 * e * q - 12 * e3 * q2 + e4 * q3);
    const N w4 = c * (24 * q - 96 * e * q1 + 72 * e2 * q2 - 16 * e3 * q3 + e4 * q4);
    const N far = w4 - 6 * w3 * i1 + 15 * (w2 * i2 - w1 * i3) + 105 * i3 * i2;
    const N t = apart * i1, apart2 = apart * apart;
    const N k = 5 * t * t * t * t * (apart2 + 6 * p), u1 = 45 * s * s * t * t, u3 = 15 * (apart2 + 2 * p);
    const N near = c * (105 * k - 15 * u1 + 9 * u3 + 15 * d * d) * i1;
    const auto inside = mask_of(d <= apart), outer_half = mask_of(d > Real(0.5) * s);
    return inside ? d * 0 : outer_half ? far : near;
}

// Pair of a target and a source: direction u, distance d, and the factors g1, g2 d², g2 d, g3 d³, g2, g3 d² and g4 d⁴.
// All are zero unless they are ``others``, moments of different bodies.
struct DifferentiatedPair {
    Vector u;
    Number g1, g2_d2, g2_d, g3_d3, g2, g3_d2, g4_d4;
};
CUDA_CALLABLE inline DifferentiatedPair differentiated_pair(Vector r, Number a, Number b, Mask others) {
    const Number d2 = dot(r, r), contact = a + b, zero = Number(Real(0));
    Number i = others & (d2 > zero) ? Real(0.5) * twice_inverse_root(d2) : zero;
    Number d = i * d2, i2 = i * i, i3 = i2 * i, fourth = 105 * i3 * i2;
    Vector u = i * r;
    Factors<Number> g = {-i3, 3 * i3 * i, -15 * i3 * i};
    const Mask overlapping = others & (d2 < contact * contact);
    if (any(overlapping)) {
        const Polar at = polar(r);
        const Number apart = larger(a - b, b - a), inverse = at.d > zero ? 1 / at.d : zero;
        const Factors<Number> averaged = averaged_factors(at.d, a, b, apart);
        const Number averaged_fourth = averaged_fourth_factor(at.d, a, b, apart);
        g.g1 = overlapping ? averaged.g1 : g.g1, g.g2 = overlapping ? averaged.g2 : g.g2;
        g.g3 = overlapping ? averaged.g3 : g.g3, fourth = overlapping ? averaged_fourth : fourth;
        d = overlapping ? at.d : d, i = overlapping ? inverse : i;
        u = {overlapping ? at.u.x : u.x, overlapping ? at.u.y : u.y, overlapping ? at.u.z : u.z};
    }
    return {u, g.g1, g.g2 * d, g.g2, g.g3, g.g2 * i, g.g3 * i, fourth};
}

// Sums over the sources of a target, 4π times the field and both gradients. Terms along the target's m and v = b × m
// are summed as factors.
struct WrenchGradient {
    Vector field = {0, 0, 0}, by_moment = {0, 0, 0}, by_position = {0, 0, 0};
    Number along_m = 0, along_v = 0;

    // Adds a pair with the target's m and v, the source's moment n and w = b × n, and the difference c of both a.
    CUDA_CALLABLE void add(const DifferentiatedPair& p, Vector c, Vector m, Vector v, Vector n, Vector w) {
        const Vector u = p.u;
        const Number uc = dot(u, c), um = dot(u, m), un = dot(u, n), uv = dot(u, v), uw = dot(u, w), cm = dot(c, m);
        const Number cn = dot(c, n), mn = dot(m, n), g2_un = p.g2_d * un, g2_uc = p.g2_d * uc, g3_un = p.g3_d2 * un;
        field += p.g1 * n + p.g2_d2 * un * u;
        // D3[c, n] + D2[w]
        by_moment += (p.g2_d * cn + p.g3_d3 * uc * un + p.g2_d2 * uw) * u + g2_un * c + g2_uc * n + p.g1 * w;
        // D4[c, m, n] + D3[v, n] + D3[m, w]
        const Number by_u = p.g4_d4 * uc * um * un + p.g3_d2 * (cm * un + cn * um + mn * uc)
                            + p.g2_d * (dot(v, n) + dot(m, w)) + p.g3_d3 * (uv * un + um * uw);
        by_position += by_u * u + (g3_un * um + p.g2 * mn) * c + (p.g3_d2 * uc * um + p.g2 * cm + p.g2_d * uv) * n
                       + p.g2_d * um * w;
        along_m += g3_un * uc + p.g2 * cn + p.g2_d * uw;
        along_v += g2_un;
    }
};

// Vector number j of an array, in all lanes.
CUDA_CALLABLE inline Vector vector_of_all(const Real* vectors, int j) {
    return {collect(vectors, 3 * j), collect(vectors + 1, 3 * j), collect(vectors + 2, 3 * j)};
}

// Writes the gradients of the moments from number ``first`` on: a vector of them, or one for a group of threads.
template <class Arrays> CUDA_CALLABLE inline void differentiate_moments(const Arrays& arrays, int first) {
    const int count = arrays.packed.shape[1], left = count - first;
    const int own_count = left < WIDTH ? left : WIDTH, lane_count = share() == 0 ? own_count : 0;
    if (left <= 0) return;
    const size_t pitch = arrays.packed.strides[0] / sizeof(Real);
    const Real *packed = arrays.packed.data, *along = (const Real*)arrays.force_cotangents.data;
    const Real *about = (const Real*)arrays.torque_cotangents.data, *applied = (const Real*)arrays.external_field.data;
    const auto packed_vector = [&](int row, auto read, int i) -> Vector {
        const Real* const rows = packed + row * pitch + i;
        return {read(rows), read(rows + pitch), read(rows + 2 * pitch)};
    };
    const auto lanes_at = [](const Real* row) { return numbers(row); };
    const auto all_at = [](const Real* row) { return collect(row, 0); };
    const Vector x = packed_vector(0, lanes_at, first), m = packed_vector(4, lanes_at, first);
    const Vector a = vectors(along + 3 * (size_t)first, own_count), b = vectors(about + 3 * (size_t)first, own_count);
    const Vector v = cross(b, m);
    const Number radius = numbers(packed + 3 * pitch + first), label = numbers(packed + 7 * pitch + first);
    WrenchGradient sums;
    for (int j = share(); j < count; j += SHARES) {
        const Vector r = x - packed_vector(0, all_at, j), source = packed_vector(4, all_at, j);
        const Vector c = a - vector_of_all(along, j), source_v = cross(vector_of_all(about, j), source);
        const Mask others = label != collect(packed + 7 * pitch, j);
        const DifferentiatedPair pair = differentiated_pair(r, radius, collect(packed + 3 * pitch, j), others);
        sums.add(pair, c, m, v, source, source_v);
    }
    const Vector by_position = group_sums(sums.by_position + sums.along_m * m + sums.along_v * v);
    const Vector by_moment = group_sums(sums.by_moment), field = group_sums(sums.field);
    const Vector h = INVERSE_4PI * field + vectors(applied + 3 * (size_t)first, own_count);
    const auto store = [&](Real* out, Vector value) { put_vectors(out + 3 * (size_t)first, lane_count, value); };
    store((Real*)arrays.by_positions.data, MU0 * INVERSE_4PI * by_position);
    store((Real*)arrays.by_moments.data, MU0 * (INVERSE_4PI * by_moment + cross(h, b)));
    store((Real*)arrays.by_external_field.data, MU0 * v);
}

// Writes the gradients of all moments.
template <class Word, class Arrays>
CUDA_CALLABLE inline void differentiate_wrench(int thread, int threads, Word* team, const Arrays& arrays) {
#if defined(__CUDA_ARCH__)
    differentiate_moments(arrays, thread / GROUP);
#else
    run_passes(team, threads, 0, 1, arrays.packed.shape[1], WIDTH,
               [&](int, int i) { differentiate_moments(arrays, i); });
#endif
}
}
