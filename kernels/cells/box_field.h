// Field of a uniformly magnetized box, in closed form, and its derivatives, in the frame of the box.
//
// The field at r from the center is H = K(r) M. With corners at signs s of the half sides h, x = r_x − s_x h_x, and so
// on, R = √(x² + y² + z²) and s = s_x s_y s_z,
//
//     4π K_xx = Σ s arctan(yz/(xR)),    4π K_xy = −Σ s ln(z + R),    trace K = −1 inside, 0 outside.
//
// Derivatives of the logarithms are algebraic, and the other ones follow from div H = 0.
//
// Reference: Joseph and Schlömann 1965, "Demagnetizing field in nonellipsoidal bodies", J. Appl. Phys. 36, 1579-1593.
#pragma once
#include "shared/vectors.h"

namespace warpmag {

constexpr Real INVERSE_4_PI = Real(0.07957747154594767);

// Corners of a box relative to points: x[0] is the distance from the lower face, x[1] from the upper face, and
// distance[k] that of the corner whose bits select upper faces: 1 of x, 2 of y, 4 of z.
struct BoxView {
    Number x[2], y[2], z[2], distance[8];
    Vector half;
};
CUDA_CALLABLE inline BoxView view_box(Vector r, Vector half) {
    BoxView v = {{r.x + half.x, r.x - half.x}, {r.y + half.y, r.y - half.y}, {r.z + half.z, r.z - half.z}, {}, half};
    for (int k = 0; k < 8; ++k) {
        const Number x = v.x[k & 1], y = v.y[k >> 1 & 1], z = v.z[k >> 2];
        v.distance[k] = root(x * x + y * y + z * z);
    }
    return v;
}

// Σ s ln(w + R) over the corners, less a constant, for edges of half length ``half`` along an axis w. ``along``, ``a``
// and ``b`` are the bits of w and of the other two axes.
CUDA_CALLABLE inline Number edge_logarithms(const BoxView& v, Number half, int along, int a, int b) {
    const Number tiny = half * Real(1e-7);
    Number upper = half * Real(0) + 1, lower = upper;
    for (int k = 0; k < 4; ++k) {
        const int corner = (k & 1 ? a : 0) + (k & 2 ? b : 0);
        const Number sum = v.distance[corner] + v.distance[corner + along];
        const Number near = larger(sum - 2 * half, tiny), far = sum + 2 * half;
        const bool positive = k == 0 || k == 3;
        upper *= positive ? near : far;
        lower *= positive ? far : near;
    }
    return logarithm(upper / lower);
}

// Difference of the solid angles of the two faces across an axis, Σ s arctan(yz/(xR)): x, y and z are any axes, with
// their bits. A diagonal cuts a face into two triangles with corners at a, b and c, whose solid angles are
//
//     2 arctan(N/D),    N = |a·(b × c)|,    D = abc + (a·b) c + (a·c) b + (b·c) a
//
// (van Oosterom and Strackee 1983). Half the angle of a face is at most π: the argument of the product of both D + iN.
CUDA_CALLABLE inline Number face_angles(const BoxView& v, const Number* x, const Number* y, const Number* z, int of_x,
                                        int of_y, int of_z) {
    const Number zero = x[0] * Real(0), area = (y[0] - y[1]) * (z[0] - z[1]), yy = y[0] * y[1], zz = z[0] * z[1];
    Number sum = zero;
    for (int side = 0; side < 2; ++side) {
        const int corner = side ? of_x : 0;
        const Number xx = x[side] * x[side], a = v.distance[corner], b = v.distance[corner + of_y + of_z];
        // of the triangle whose third corner c is at y[end] and z[1 - end]
        auto denominator = [&](int end) {
            const Number c = v.distance[corner + (end ? of_y : of_z)];
            const Number shared_y = y[end] * y[end] + zz, shared_z = z[1 - end] * z[1 - end] + yy;
            const Number ac = xx + (end ? shared_z : shared_y), bc = xx + (end ? shared_y : shared_z);
            return a * b * c + (xx + yy + zz) * c + ac * b + bc * a;
        };
        const Number height = larger(x[side], -x[side]), n = height * area, d0 = denominator(0), d1 = denominator(1);
        const Number solid = 2 * angle(larger(n * (d0 + d1), zero), d0 * d1 - n * n);
        const Number outward = x[side] < zero ? -solid : solid;
        sum += side ? outward : -outward;
    }
    return sum;
}

// Column of K along an axis.
CUDA_CALLABLE inline Vector box_column(const BoxView& v, int axis) {
    auto log_x = [&] { return -INVERSE_4_PI * edge_logarithms(v, v.half.x, 1, 2, 4); };
    auto log_y = [&] { return -INVERSE_4_PI * edge_logarithms(v, v.half.y, 2, 1, 4); };
    auto log_z = [&] { return -INVERSE_4_PI * edge_logarithms(v, v.half.z, 4, 1, 2); };
    if (axis == 0) return {INVERSE_4_PI * face_angles(v, v.x, v.y, v.z, 1, 2, 4), log_z(), log_y()};
    if (axis == 1) return {log_z(), INVERSE_4_PI * face_angles(v, v.y, v.z, v.x, 2, 4, 1), log_x()};
    return {log_y(), log_x(), INVERSE_4_PI * face_angles(v, v.z, v.x, v.y, 4, 1, 2)};
}

// K of the box.
CUDA_CALLABLE inline Symmetric box_tensor(const BoxView& v) {
    const Number zero = v.half.x * Real(0);
    const Number xx = INVERSE_4_PI * face_angles(v, v.x, v.y, v.z, 1, 2, 4);
    const Number yy = INVERSE_4_PI * face_angles(v, v.y, v.z, v.x, 2, 4, 1);
    const auto inside =
        (v.x[0] > zero) & (v.x[1] < zero) & (v.y[0] > zero) & (v.y[1] < zero) & (v.z[0] > zero) & (v.z[1] < zero);
    const Number zz = (inside ? zero - 1 : zero) - xx - yy;
    return {xx,
            yy,
            zz,
            -INVERSE_4_PI * edge_logarithms(v, v.half.z, 4, 1, 2),
            -INVERSE_4_PI * edge_logarithms(v, v.half.x, 1, 2, 4),
            -INVERSE_4_PI * edge_logarithms(v, v.half.y, 2, 1, 4)};
}

// Sums over the corners for the edges along an axis w: Σ s a/(R (R + w)) and Σ s b/(R (R + w)) for the other two axes,
// and Σ s/R.
struct EdgeSlopes {
    Number a, b, along;
};
CUDA_CALLABLE inline EdgeSlopes edge_slopes(const BoxView& v, const Number* w, const Number* a, const Number* b,
                                            int of_w, int of_a, int of_b, Number tiny) {
    EdgeSlopes sums = {tiny * Real(0), tiny * Real(0), tiny * Real(0)};
    for (int k = 0; k < 4; ++k) {
        const int corner = (k & 1 ? of_a : 0) + (k & 2 ? of_b : 0);
        const Number inverse_lower = 1 / larger(v.distance[corner], tiny),
                     inverse_upper = 1 / larger(v.distance[corner + of_w], tiny);
        const Number p = a[k & 1], q = b[k >> 1], across = larger(p * p + q * q, tiny * tiny);
        const Real sign = k == 0 || k == 3 ? Real(1) : Real(-1);
        const Number cosines = sign * (w[0] * inverse_lower - w[1] * inverse_upper) / across;
        sums.a += p * cosines;
        sums.b += q * cosines;
        sums.along += sign * (inverse_upper - inverse_lower);
    }
    return sums;
}

// Symmetric product of two vectors in the derivatives of K: (e·∇) K m.
CUDA_CALLABLE inline Vector box_slope(const BoxView& v, Vector m, Vector e) {
    const Number tiny = Real(1e-4) * smaller(v.half.x, smaller(v.half.y, v.half.z));
    const EdgeSlopes z = edge_slopes(v, v.z, v.x, v.y, 4, 1, 2, tiny), y = edge_slopes(v, v.y, v.x, v.z, 2, 1, 4, tiny),
                     x = edge_slopes(v, v.x, v.y, v.z, 1, 2, 4, tiny);
    // third derivatives, over −1/4π
    const Number xxy = z.a, xyy = z.b, xyz = z.along, xxz = y.a, xzz = y.b, yyz = x.a, yzz = x.b;
    const Number xxx = -xyy - xzz, yyy = -xxy - yzz, zzz = -xxz - yyz;
    const Number pxx = m.x * e.x, pyy = m.y * e.y, pzz = m.z * e.z;
    const Number pxy = m.x * e.y + m.y * e.x, pyz = m.y * e.z + m.z * e.y, pzx = m.z * e.x + m.x * e.z;
    return -INVERSE_4_PI
           * Vector{xxx * pxx + xyy * pyy + xzz * pzz + xxy * pxy + xyz * pyz + xxz * pzx,
                    xxy * pxx + yyy * pyy + yzz * pzz + xyy * pxy + yyz * pyz + xyz * pzx,
                    xxz * pxx + yyz * pyy + zzz * pzz + xyz * pxy + yzz * pyz + xzz * pzx};
}
}
