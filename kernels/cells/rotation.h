// Rotation from the frame of a body to the world, and back.
#pragma once
#include "shared/vectors.h"

namespace warpmag {

// Rotation matrix from a body's frame to the world: of one body (N = Real), or of the body of each lane (N = Number).
template <class N> struct Rotation {
    N rows[3][3];
};

// ``q`` has the components x, y, z, w.
template <class N, class Quaternion> CUDA_CALLABLE inline Rotation<N> rotation_of(const Quaternion& q) {
    const N x = q[0], y = q[1], z = q[2], w = q[3];
    return {{{1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y)},
             {2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x)},
             {2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)}}};
}
// Product of two quaternions: the rotation b, then a.
template <class A, class B, class Result> CUDA_CALLABLE inline void put_product(const A& a, const B& b, Result& q) {
    q[0] = a[3] * b[0] + a[0] * b[3] + a[1] * b[2] - a[2] * b[1];
    q[1] = a[3] * b[1] + a[1] * b[3] + a[2] * b[0] - a[0] * b[2];
    q[2] = a[3] * b[2] + a[2] * b[3] + a[0] * b[1] - a[1] * b[0];
    q[3] = a[3] * b[3] - a[0] * b[0] - a[1] * b[1] - a[2] * b[2];
}
template <class N> CUDA_CALLABLE inline Vector to_world(const Rotation<N>& r, Vector v) {
    const auto& a = r.rows;
    return {a[0][0] * v.x + a[0][1] * v.y + a[0][2] * v.z, a[1][0] * v.x + a[1][1] * v.y + a[1][2] * v.z,
            a[2][0] * v.x + a[2][1] * v.y + a[2][2] * v.z};
}
template <class N> CUDA_CALLABLE inline Vector to_body(const Rotation<N>& r, Vector v) {
    const auto& a = r.rows;
    return {a[0][0] * v.x + a[1][0] * v.y + a[2][0] * v.z, a[0][1] * v.x + a[1][1] * v.y + a[2][1] * v.z,
            a[0][2] * v.x + a[1][2] * v.y + a[2][2] * v.z};
}
}
