// Terms that one pair of moments adds to the sums of its target, or of both moments: field (Eq. 1) and force (Eqs. 4,
// 13 and 14). A number N is a scalar on a GPU and a vector of scalars on a CPU; Real is the scalar type.
//
// A pair has a separation r from the source to the target, and an inverse distance that the caller clamps and masks.
// The source has a moment b and a multiple u of it. For a force the target has an effective moment e, for a
// MUTUAL_FORCE its moment m. The inverse distance is i = W/d: with W = 2 the last Newton step of a CPU is shortest.
// Constant factors are applied to the complete sums:
//
// | quantity     | u     | sums over the pairs                                  | result                          |
// |--------------|-------|------------------------------------------------------|---------------------------------|
// | FIELD        | W²b/3 | h = i³ [i² (r·b) r − u]                              | 4πH = 3 W⁻⁵ h                   |
// | FORCE        | W²b/5 | f = i⁵ [(r·e) u + (u·e) r − i² (r·e)(r·b) r]         |                                 |
// |              |       | a = i⁵ (r·b)                                         | 4π(e·∇)H = 15 W⁻⁷ f + 3 W⁻⁵ a e |
// | WRENCH       | W²b/5 | f and a, and h = i⁵ (r·b) r, g = i³ b                | also 4πH = 3 W⁻⁵ h − W⁻³ g      |
// | MUTUAL_FORCE |       | h = i⁵ [(r·b) m + (r·m) b + (b·m) r                  |                                 |
// |              |       |         − 5 W⁻² i² (r·b)(r·m) r]                     | 4π(m·∇)H = 3 W⁻⁵ h              |
//
// Products are ordered so that a power beyond r⁻³ is multiplied by r before it can leave the range of float32.
#pragma once
#include "shared/vectors.h"

namespace warpmag {

// Summed quantity: H; (e·∇)H for an effective moment e of the target; both; (m·∇)H for the target's moment m. As in
// pair_law.Quantity.
enum class Quantity { FIELD, FORCE, WRENCH, MUTUAL_FORCE };

// Numbers stored per target.
constexpr int width(Quantity q) { return q == Quantity::WRENCH ? 6 : 3; }

#if defined(__CUDA_ARCH__)
constexpr Real W = 1;
#else
constexpr Real W = 2;
#endif

// Ratio u/b of a source's scaled moment to its moment.
constexpr Real scaled_moment(Quantity q) { return Real(double(W) * W / (q == Quantity::FIELD ? 3.0 : 5.0)); }

// Tile of the work list: range of target rows, packed column of the first of them, range of sources, and index of the
// partial sums. If ``mirrored``, the tile also stands for its mirror image, with targets and sources exchanged, which
// is added to partial sums ``mirror_split``.
struct TileEntry {
    int row_begin, row_end, column_begin, source_begin, source_end, split, mirrored, mirror_split;
};

// Sums of a target, as in the table. Sums that a quantity does not use stay zero and are optimized away.
template <class N> struct Sums {
    Vec3<N> f{}, h{}, g{};
    N a{};

    CUDA_CALLABLE Sums& operator+=(const Sums& s) { return *this = {f + s.f, h + s.h, g + s.g, a + s.a}; }
};

template <class N> struct Source {
    Vec3<N> x, b, u; // position, moment, scaled moment
};

// Adds a source at separation r, with inv = i of the table, to the sums of a target of effective moment e.
template <Quantity Q, class N>
CUDA_CALLABLE inline void add_pair(Sums<N>& sums, const Vec3<N>& r, N inv, const Source<N>& source, const Vec3<N>& e) {
    const Vec3<N>&b = source.b, &u = source.u;
    const N inv2 = inv * inv, inv3 = inv2 * inv;
    if constexpr (Q == Quantity::FIELD) {
        const N w = inv2 * dot(r, b);
        sums.h += inv3 * (w * r - u);
    } else {
        const N inv5 = inv3 * inv2, rb = dot(r, b);
        const N p = inv2 * dot(r, e), c = inv3 * p, q = inv5 * (dot(u, e) - p * rb);
        sums.f += c * u;
        sums.f += q * r;
        const N a = inv5 * rb;
        sums.a += a;
        if constexpr (Q == Quantity::WRENCH) {
            sums.h += a * r;
            sums.g += inv3 * b;
        }
    }
}

// Adds a pair to the sums h of its target, which has moment m and scaled moment n, and to the sums g of its source.
template <Quantity Q, class N>
CUDA_CALLABLE inline void add_mirrored_pair(Vec3<N>& h, Vec3<N>& g, const Vec3<N>& r, N inv, const Source<N>& source,
                                            const Vec3<N>& m, const Vec3<N>& n) {
    const Vec3<N>& b = source.b;
    const N inv2 = inv * inv, inv3 = inv2 * inv;
    if constexpr (Q == Quantity::FIELD) {
        const N w = inv2 * dot(r, b);
        h += inv3 * (w * r - source.u);
        const N back = inv2 * dot(r, m);
        g += inv3 * (back * r - n);
    } else {
        constexpr Real FIVE = Real(5.0 / (double(W) * W));
        const N inv5 = inv3 * inv2, rb = dot(r, b), rm = dot(r, m), bm = dot(b, m);
        const N c = inv5 * rb, e = inv5 * rm, q = inv5 * (bm - FIVE * (inv2 * rb) * rm);
        const Vec3<N> f = c * m + e * b + q * r;
        h += f;
        g -= f;
    }
}

// Factors of h, f and g in the results: 3 W⁻⁵, 15 W⁻⁷ and W⁻³.
constexpr double W3 = double(W) * W * W, W5 = W3 * W * W, W7 = W5 * W * W;
constexpr Real H_FACTOR = Real(3.0 / W5), F_FACTOR = Real(15.0 / W7), G_FACTOR = Real(1.0 / W3);

CUDA_CALLABLE inline void put(Real* out, const Vec3<Real>& v) { out[0] = v.x, out[1] = v.y, out[2] = v.z; }

// Writes the results of a target, width(Q) numbers: the force and then the field.
template <Quantity Q> CUDA_CALLABLE inline void results(const Sums<Real>& sums, const Vec3<Real>& e, Real* out) {
    if constexpr (Q == Quantity::FIELD || Q == Quantity::MUTUAL_FORCE) put(out, H_FACTOR * sums.h);
    else put(out, F_FACTOR * sums.f + H_FACTOR * sums.a * e);
    if constexpr (Q == Quantity::WRENCH) put(out + 3, H_FACTOR * sums.h - G_FACTOR * sums.g);
}

}
