// Gradients of functions of fields, forces and torques between moments; pair_gradients.py has the equations.
//
// From Python: INVERSE_4PI, MU0 [T·m/A], GROUP, the threads of a GPU that share a target, WRENCH, 1 for forces and
// torques and 0 for fields, and TILE_SIZE. ``Arrays`` is the struct of pair_gradients.py. On a CPU a pair is visited
// once, for both its moments, in tiles of the work list. On a GPU many moments of one world do the same
// (``mirrored_gradients_cuda.h``), and the partial sums are added up here. Otherwise each target visits all sources of
// its world.
#pragma once
#include "pairs/pair_law.h"
#include "pairs/pair_terms.h"
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

// Pair of a target and a source: distance d and direction u, and the factors g1, g2, g2 d, g3 d² and g4 d⁴. The factors
// are zero unless they are ``others``, moments of different bodies.
struct DifferentiatedPair {
    Vector u;
    Number d, g1, g2, g2_d, g3_d2, g4_d4;
};
CUDA_CALLABLE inline DifferentiatedPair differentiated_pair(Vector r, Number a, Number b, Mask others) {
    const Number d2 = dot(r, r), contact = a + b, zero = Number(Real(0));
    const Number i = (others & (d2 > zero)) ? Real(0.5) * twice_inverse_root(d2) : zero;
    const Number i2 = i * i, i3 = i2 * i, i5 = i3 * i2;
    DifferentiatedPair p = {i * r, i * d2, -i3, 3 * i5, 3 * (i3 * i), -15 * i5, 105 * i5};
    const Mask overlapping = others & (d2 < contact * contact);
    if (any(overlapping)) {
        const Polar at = polar(r);
        const Number apart = larger(a - b, b - a), inverse = at.d > zero ? 1 / at.d : zero;
        const Factors<Number> g = averaged_factors(at.d, a, b, apart);
        const Number g4_d4 = averaged_fourth_factor(at.d, a, b, apart);
        p.d = overlapping ? at.d : p.d, p.g1 = overlapping ? g.g1 : p.g1;
        p.g2 = overlapping ? g.g2 * inverse : p.g2, p.g2_d = overlapping ? g.g2 : p.g2_d;
        p.g3_d2 = overlapping ? g.g3 * inverse : p.g3_d2, p.g4_d4 = overlapping ? g4_d4 : p.g4_d4;
        p.u = {overlapping ? at.u.x : p.u.x, overlapping ? at.u.y : p.u.y, overlapping ? at.u.z : p.u.z};
    }
    return p;
}

// Moments m, their cotangents v and, for forces, a; see pair_gradients.py.
struct Charges {
    Vector m, v, a;
};

// Terms of a pair, 4π times: gradient by the target's position, which is minus that by the source's, gradients by both
// moments, and fields at both.
struct PairGradient {
    Vector by_position, by_target, by_source, at_target, at_source;
};

// With A[x, y] = g2 x·y + g3 (r·x)(r·y), D3[x, y] = g2 [(r·x) y + (r·y) x] + A[x, y] r, and D4[x, y, z] is the sum of
// A[x, y] z, A[y, z] x, A[z, x] y and [g3 (x·y r·z + y·z r·x + z·x r·y) + g4 (r·x)(r·y)(r·z)] r.
CUDA_CALLABLE inline PairGradient gradient_of(const DifferentiatedPair& p, const Charges& i, const Charges& j) {
    const Vector u = p.u, m = i.m, n = j.m, v = i.v, w = j.v;
    const Number um = dot(u, m), un = dot(u, n), uv = dot(u, v), uw = dot(u, w), d_um = p.g2_d * um, d_un = p.g2_d * un;
    const Number a_mixed = p.g2 * (dot(v, n) + dot(m, w)) + p.g3_d2 * (uv * un + um * uw);
    Number by_m = p.g2_d * uw, by_n = p.g2_d * uv, along = p.d * a_mixed;
    PairGradient g = {d_un * v + d_um * w, p.g1 * w, p.g1 * v};
    if constexpr (WRENCH) {
        const Vector c = i.a - j.a;
        const Number uc = dot(u, c), cm = dot(c, m), cn = dot(c, n), mn = dot(m, n);
        const Number d_uc = p.g2_d * uc, g3_uc = p.g3_d2 * uc;
        by_m += p.g2 * cn + g3_uc * un;
        by_n += p.g2 * cm + g3_uc * um;
        along += p.g3_d2 * (cm * un + cn * um + mn * uc) + p.g4_d4 * (uc * um) * un;
        g.by_position += (p.g2 * mn + p.g3_d2 * um * un) * c;
        g.by_target += d_uc * n + d_un * c;
        g.by_source += d_uc * m + d_um * c;
        g.at_target = p.g1 * n + p.d * d_un * u;
        g.at_source = p.g1 * m + p.d * d_um * u;
    }
    g.by_position += by_m * m + by_n * n + along * u;
    g.by_target += p.d * by_m * u;
    g.by_source += p.d * by_n * u;
    return g;
}

constexpr int ROWS = WRENCH ? 9 : 6; // numbers summed for each moment

// Sums of a moment over its pairs, 4π times: gradients by position and moment, and, for torques, the field.
struct GradientSums {
    Vector part[ROWS / 3] = {};

    CUDA_CALLABLE void add_to_target(const PairGradient& g) {
        part[0] += g.by_position;
        part[1] += g.by_target;
        if constexpr (WRENCH) part[2] += g.at_target;
    }
    CUDA_CALLABLE void add_to_source(const PairGradient& g) {
        part[0] -= g.by_position;
        part[1] += g.by_source;
        if constexpr (WRENCH) part[2] += g.at_source;
    }
};

// Rows of numbers, one for each moment.
struct Rows {
    const Real* data;
    size_t pitch;

    CUDA_CALLABLE Rows(const Real* data, size_t pitch) : data(data), pitch(pitch) {}
    CUDA_CALLABLE Rows(const wp::array_t<Real>& rows) : Rows(rows.data, rows.strides[0] / sizeof(Real)) {}
    CUDA_CALLABLE Number lanes(int row, int i) const { return numbers(data + row * pitch + i); }
    CUDA_CALLABLE Vector vector(int row, int i) const { return {lanes(row, i), lanes(row + 1, i), lanes(row + 2, i)}; }
    // Number i in all lanes.
    CUDA_CALLABLE Number all(int row, int i) const { return collect(data + row * pitch, i); }
    CUDA_CALLABLE Vector vector_of_all(int row, int i) const { return {all(row, i), all(row + 1, i), all(row + 2, i)}; }
};

// Balls with their charges: a vector of them from number i on, or number i in all lanes.
struct Balls {
    Vector x;
    Number radius, label;
    Charges charges;
};
CUDA_CALLABLE inline Balls balls_from(const Rows& packed, const Rows& cotangents, int i) {
    Balls b = {packed.vector(0, i), packed.lanes(3, i), packed.lanes(7, i), {packed.vector(4, i)}};
    b.charges.v = cotangents.vector(0, i);
    if constexpr (WRENCH) b.charges.a = cotangents.vector(3, i);
    return b;
}
CUDA_CALLABLE inline Balls ball_in_all(const Rows& packed, const Rows& cotangents, int i) {
    Balls b = {packed.vector_of_all(0, i), packed.all(3, i), packed.all(7, i), {packed.vector_of_all(4, i)}};
    b.charges.v = cotangents.vector_of_all(0, i);
    if constexpr (WRENCH) b.charges.a = cotangents.vector_of_all(3, i);
    return b;
}
CUDA_CALLABLE inline PairGradient gradient_of(const Balls& i, const Balls& j, Mask others) {
    return gradient_of(differentiated_pair(i.x - j.x, i.radius, j.radius, others), i.charges, j.charges);
}

// Writes the gradients of ``lane_count`` moments from number ``first`` on.
template <class Arrays>
CUDA_CALLABLE inline void store_gradients(const Arrays& arrays, int first, int lane_count, const GradientSums& sums) {
    const auto at = [&](auto& array) { return (Real*)array.data + 3 * (size_t)first; };
    if constexpr (!WRENCH) {
        put_vectors(at(arrays.by_positions), lane_count, INVERSE_4PI * sums.part[0]);
        put_vectors(at(arrays.by_moments), lane_count, INVERSE_4PI * sums.part[1]);
    } else {
        const Vector h = INVERSE_4PI * sums.part[2] + vectors(at(arrays.external_field), lane_count);
        const Vector b = vectors(at(arrays.torque_cotangents), lane_count);
        put_vectors(at(arrays.by_positions), lane_count, MU0 * INVERSE_4PI * sums.part[0]);
        put_vectors(at(arrays.by_moments), lane_count, MU0 * (INVERSE_4PI * sums.part[1] + cross(h, b)));
        put_vectors(at(arrays.by_external_field), lane_count, MU0 * Rows(arrays.cotangents).vector(0, first));
    }
}

// Row k of the partial sums of a part, from moment i on. Shape of ``partial``: [parts, ROWS, pitch].
template <class Arrays> CUDA_CALLABLE inline Real* partial_row(const Arrays& arrays, int part, int k, int i) {
    return arrays.partial.data + ((size_t)part * ROWS + k) * arrays.partial.shape[2] + i;
}
// Adds up the partial sums of a vector of moments, or of one that a group of threads shares, in order.
template <class Arrays> CUDA_CALLABLE inline void finish_vector(const Arrays& arrays, int i) {
    const int left = arrays.packed.shape[1] - i;
    if (left <= 0) return;
    GradientSums sums;
    for (int part = share(); part < arrays.partial.shape[0]; part += SHARES)
        for (int k = 0; k < ROWS; ++k) ((Number*)sums.part)[k] += numbers(partial_row(arrays, part, k, i));
    for (auto& part : sums.part) part = group_sums(part);
    if (share() == 0) store_gradients(arrays, i, left < WIDTH ? left : WIDTH, sums);
}

#if defined(__CUDA_ARCH__)
// Writes the gradients of a moment, from its pairs with all moments of its world; a group of threads shares it.
template <class Arrays> CUDA_CALLABLE inline void differentiate_target(const Arrays& arrays, int i) {
    if (i >= arrays.packed.shape[1]) return;
    const Rows packed(arrays.packed), cotangents(arrays.cotangents);
    const Balls target = balls_from(packed, cotangents, i);
    GradientSums sums;
    for (int j = arrays.begin.data[i] + share(); j < arrays.end.data[i]; j += SHARES) {
        const Balls source = balls_from(packed, cotangents, j);
        sums.add_to_target(gradient_of(target, source, target.label != source.label));
    }
    for (auto& part : sums.part) part = group_sums(part);
    store_gradients(arrays, i, share() == 0, sums);
}
#else
template <class Arrays>
inline void add_partial(const Arrays& arrays, int part, int i, int lane_count, const Number* sums) {
    for (int k = 0; k < ROWS; ++k) {
        Real* const row = partial_row(arrays, part, k, i);
        put_first(row, lane_count, numbers_or(row, lane_count, 0) + sums[k]);
    }
}

inline Real total_of(Number lanes) {
#pragma clang fp reassociate(on)
    Real total = 0;
    for (int l = 0; l < WIDTH; ++l) total += lanes[l];
    return total;
}

// Adds the pairs of the targets and the sources of a tile to the sums of both.
template <class Arrays> inline void sum_tile(const Arrays& arrays, const TileEntry& tile) {
    const int begin = tile.column_begin, end = begin + tile.row_end - tile.row_begin, sources = tile.source_begin;
    const Rows packed(arrays.packed), cotangents(arrays.cotangents);
    const bool diagonal = sources == begin;
    GradientSums sums[TILE_SIZE / WIDTH + 1] = {}; // of vectors of sources
    Mask lane;
    for (int l = 0; l < WIDTH; ++l) lane[l] = l;
    for (int i = begin; i < end; ++i) {
        const Balls target = ball_in_all(packed, cotangents, i);
        GradientSums own;
        for (int k = diagonal ? (i + 1 - begin) / WIDTH : 0, j; (j = sources + WIDTH * k) < tile.source_end; ++k) {
            const Balls source = balls_from(packed, cotangents, j);
            Mask others = (target.label != source.label) & (lane < tile.source_end - j);
            if (diagonal) others &= lane > i - j;
            const PairGradient g = gradient_of(target, source, others);
            own.add_to_target(g);
            sums[k].add_to_source(g);
        }
        for (int k = 0; k < ROWS; ++k) *partial_row(arrays, tile.split, k, i) += total_of(((const Number*)own.part)[k]);
    }
    for (int j = sources, k = 0; j < tile.source_end; j += WIDTH, ++k)
        add_partial(arrays, tile.mirror_split, j, tile.source_end - j, (const Number*)sums[k].part);
}

// Clears the partial sums of a share of the tiles, and sums the tiles.
template <class Arrays> inline void sum_share(const Arrays& arrays, const TileEntry* begin, const TileEntry* end) {
    const auto clear = [&](int part, int i, int count) {
        for (int k = 0; k < ROWS; ++k) __builtin_memset(partial_row(arrays, part, k, i), 0, count * sizeof(Real));
    };
    for (const TileEntry* tile = begin; tile < end; ++tile) {
        clear(tile->split, tile->row_begin, tile->row_end - tile->row_begin);
        if (tile->mirrored) clear(tile->mirror_split, tile->source_begin, tile->source_end - tile->source_begin);
    }
    for (const TileEntry* tile = begin; tile < end; ++tile)
        if (tile->mirrored) sum_tile(arrays, *tile);
}

#endif

// Writes the gradients of all moments.
template <class Word, class Arrays>
CUDA_CALLABLE inline void differentiate_pairs(int thread, int threads, Word* team, const Arrays& arrays) {
#if defined(__CUDA_ARCH__)
    if (arrays.partial.data) finish_vector(arrays, thread / GROUP);
    else differentiate_target(arrays, thread / GROUP);
#else
    const TileEntry* const tiles = (const TileEntry*)arrays.tiles.data;
    const int* const shares = arrays.shares.data; // first tile of each share
    share_items(team, threads, (int)arrays.shares.shape[0] - 1, 1,
                [&](int s) { sum_share(arrays, tiles + shares[s], tiles + shares[s + 1]); });
    run_passes(team, threads, 0, 1, arrays.packed.shape[1], WIDTH, [&](int, int i) { finish_vector(arrays, i); });
#endif
}
}
