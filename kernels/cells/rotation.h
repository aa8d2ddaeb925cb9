// Rotation from the frame of a body to the world, and back.
#pragma once
#include "shared/vectors.h"

namespace warpmag {

// Rotation matrix from a body's frame to the world.
struct Rotation {
    Real rows[3][3];
};

template <class Quaternion> CUDA_CALLABLE inline Rotation rotation_of(const Quaternion& q) {
    const Real x = q[0], y = q[1], z = q[2], w = q[3];
    return {{{1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y)},
             {2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x)},
             {2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)}}};
}
CUDA_CALLABLE inline Vector to_world(const Rotation& r, Vector v) {
    const auto& a = r.rows;
    return {a[0][0] * v.x + a[0][1] * v.y + a[0][2] * v.z, a[1][0] * v.x + a[1][1] * v.y + a[1][2] * v.z,
            a[2][0] * v.x + a[2][1] * v.y + a[2][2] * v.z};
}
CUDA_CALLABLE inline Vector to_body(const Rotation& r, Vector v) {
    const auto& a = r.rows;
    return {a[0][0] * v.x + a[1][0] * v.y + a[2][0] * v.z, a[0][1] * v.x + a[1][1] * v.y + a[2][1] * v.z,
            a[0][2] * v.x + a[1][2] * v.y + a[2][2] * v.z};
}
}
