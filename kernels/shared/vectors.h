// Three-vectors and symmetric tensors, of one ball or of several at a time, and access to arrays of vectors.
#pragma once
#include "shared/lanes.h"

namespace warpmag {

// Vector of numbers N: scalars, or vectors of several balls' numbers.
template <class N> struct Vec3 {
    N x, y, z;

    friend CUDA_CALLABLE Vec3 operator+(Vec3 a, Vec3 b) { return {a.x + b.x, a.y + b.y, a.z + b.z}; }
    friend CUDA_CALLABLE Vec3 operator-(Vec3 a, Vec3 b) { return {a.x - b.x, a.y - b.y, a.z - b.z}; }
    friend CUDA_CALLABLE Vec3 operator-(Vec3 a) { return {-a.x, -a.y, -a.z}; }
    friend CUDA_CALLABLE Vec3 operator*(N k, Vec3 a) { return {k * a.x, k * a.y, k * a.z}; }
    friend CUDA_CALLABLE Vec3& operator+=(Vec3& a, Vec3 b) { return a = a + b; }
    friend CUDA_CALLABLE Vec3& operator-=(Vec3& a, Vec3 b) { return a = a - b; }
    friend CUDA_CALLABLE N dot(Vec3 a, Vec3 b) { return a.x * b.x + a.y * b.y + a.z * b.z; }
    friend CUDA_CALLABLE Vec3 cross(Vec3 a, Vec3 b) {
        return {a.y * b.z - a.z * b.y, a.z * b.x - a.x * b.z, a.x * b.y - a.y * b.x};
    }
};
typedef Vec3<Number> Vector;

// Symmetric tensors; zz of a traceless tensor is −xx − yy.
struct Traceless {
    Number xx, yy, xy, yz, zx;
};
struct Symmetric {
    Number xx, yy, zz, xy, yz, zx;
};
CUDA_CALLABLE inline Symmetric operator+(const Symmetric& a, const Symmetric& b) {
    return {a.xx + b.xx, a.yy + b.yy, a.zz + b.zz, a.xy + b.xy, a.yz + b.yz, a.zx + b.zx};
}
CUDA_CALLABLE inline Symmetric operator*(Number k, const Symmetric& a) {
    return {k * a.xx, k * a.yy, k * a.zz, k * a.xy, k * a.yz, k * a.zx};
}

CUDA_CALLABLE inline Number length(Vector a) { return root(dot(a, a)); }
CUDA_CALLABLE inline Vector operator*(Traceless t, Vector a) {
    return {t.xx * a.x + t.xy * a.y + t.zx * a.z, t.xy * a.x + t.yy * a.y + t.yz * a.z,
            t.zx * a.x + t.yz * a.y - (t.xx + t.yy) * a.z};
}
CUDA_CALLABLE inline Vector operator*(const Symmetric& t, Vector a) {
    return {t.xx * a.x + t.xy * a.y + t.zx * a.z, t.xy * a.x + t.yy * a.y + t.yz * a.z,
            t.zx * a.x + t.yz * a.y + t.zz * a.z};
}
// Adds a to ``total`` in active lanes.
CUDA_CALLABLE inline void add_where(Mask active, Vector& total, Vector a) {
    total.x += active ? a.x : 0;
    total.y += active ? a.y : 0;
    total.z += active ? a.z : 0;
}

// Loads and stores vectors whose components are rows, CHUNK numbers apart.
CUDA_CALLABLE inline Vector own_vector(const Real* rows) {
    return {numbers(rows), numbers(rows + CHUNK), numbers(rows + 2 * CHUNK)};
}
CUDA_CALLABLE inline void put_vector(Real* rows, Vector v) {
    put(rows, v.x);
    put(rows + CHUNK, v.y);
    put(rows + 2 * CHUNK, v.z);
}

// Loads and stores of public buffers, with a number or a vector (x, y, z) for each moment. At the end of a world fewer
// moments are left than a vector has lanes: only the first ``lane_count`` lanes are read and written, lane by lane.
// numbers_or sets the other lanes to ``fill``.
#if defined(__CUDA_ARCH__)
CUDA_CALLABLE inline Number numbers_or(const Real* row, int lane_count, Real fill) {
    return lane_count > 0 ? *row : fill;
}
CUDA_CALLABLE inline void put_first(Real* row, int lane_count, Number n) {
    if (lane_count > 0) *row = n;
}
CUDA_CALLABLE inline Vector vectors(const Real* rows, int lane_count) {
    return lane_count > 0 ? Vector{rows[0], rows[1], rows[2]} : Vector{0, 0, 0};
}
CUDA_CALLABLE inline void put_vectors(Real* rows, int lane_count, Vector v) {
    if (lane_count > 0) rows[0] = v.x, rows[1] = v.y, rows[2] = v.z;
}
#else
inline Number numbers_or(const Real* row, int lane_count, Real fill) {
    Number n = fill;
    if (lane_count >= WIDTH) __builtin_memcpy(&n, row, sizeof(n));
    else
        for (int l = 0; l < lane_count; ++l) n[l] = row[l];
    return n;
}
inline void put_first(Real* row, int lane_count, Number n) {
    if (lane_count >= WIDTH) __builtin_memcpy(row, &n, sizeof(n));
    else
        for (int l = 0; l < lane_count; ++l) row[l] = n[l];
}

// Component C of the vectors that are interleaved in (a, b, c).
template <int C, int... L> inline Number component(Number a, Number b, Number c, Sequence<int, L...>) {
    const Number low = __builtin_shufflevector(a, b, (3 * L + C < 2 * WIDTH ? 3 * L + C : 0)...);
    return __builtin_shufflevector(low, c, (3 * L + C < 2 * WIDTH ? L : 3 * L + C - WIDTH)...);
}
// Number N (0 to 2) of the three that hold the components of vectors v in the order x, y, z, x, y, z, ...
template <int N, int... L> inline Number interleaved(Vector v, Sequence<int, L...>) {
    constexpr int F = N * WIDTH;
    const Number low = __builtin_shufflevector(v.x, v.y,
                                               ((F + L) % 3 == 0   ? (F + L) / 3
                                                : (F + L) % 3 == 1 ? WIDTH + (F + L) / 3
                                                                   : 0)...);
    return __builtin_shufflevector(low, v.z, ((F + L) % 3 == 2 ? WIDTH + (F + L) / 3 : L)...);
}

inline Vector vectors(const Real* rows, int lane_count) {
    Number a = 0, b = 0, c = 0;
    if (lane_count >= WIDTH) {
        const AllLanes all;
        __builtin_memcpy(&a, rows, sizeof(a));
        __builtin_memcpy(&b, rows + WIDTH, sizeof(b));
        __builtin_memcpy(&c, rows + 2 * WIDTH, sizeof(c));
        return {component<0>(a, b, c, all), component<1>(a, b, c, all), component<2>(a, b, c, all)};
    }
    for (int l = 0; l < lane_count; ++l) a[l] = rows[3 * l], b[l] = rows[3 * l + 1], c[l] = rows[3 * l + 2];
    return {a, b, c};
}
inline void put_vectors(Real* rows, int lane_count, Vector v) {
    if (lane_count >= WIDTH) {
        const AllLanes all;
        const Number parts[3] = {interleaved<0>(v, all), interleaved<1>(v, all), interleaved<2>(v, all)};
        __builtin_memcpy(rows, parts, sizeof(parts));
        return;
    }
    for (int l = 0; l < lane_count; ++l) rows[3 * l] = v.x[l], rows[3 * l + 1] = v.y[l], rows[3 * l + 2] = v.z[l];
}
#endif
}
