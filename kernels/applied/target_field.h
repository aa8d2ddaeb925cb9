// Field and gradient at a vector of targets, and the force and torque on moments there.
#pragma once
#include "applied/point_field.h"
#include "applied/solids.h"

namespace warpmag {

// H and its derivatives along x, y and z.
struct TargetField {
    Vector h, x, y, z;
};
CUDA_CALLABLE inline TargetField zero_target_field() {
    const Number zero = Number(Real(0));
    const Vector none = {zero, zero, zero};
    return {none, none, none, none};
}
CUDA_CALLABLE inline TargetField target_field(const CurlFreeField& n) {
    return {n.h, {n.t.xx, n.t.xy, n.t.zx}, {n.t.xy, n.t.yy, n.t.yz}, {n.t.zx, n.t.yz, n.t.zz}};
}
CUDA_CALLABLE inline void add_where(Mask mask, TargetField& to, const TargetField& s) {
    add_where(mask, to.h, s.h), add_where(mask, to.x, s.x);
    add_where(mask, to.y, s.y), add_where(mask, to.z, s.z);
}
// Sums over the threads of a group.
CUDA_CALLABLE inline TargetField group_sums(const TargetField& s) {
    return {group_sums(s.h), group_sums(s.x), group_sums(s.y), group_sums(s.z)};
}
// ∇(m·H)
CUDA_CALLABLE inline Vector gradient_dot(const TargetField& s, Vector m) {
    return {dot(s.x, m), dot(s.y, m), dot(s.z, m)};
}

// Sets lane l of a vector.
CUDA_CALLABLE inline void set_lane(Vector& v, int l, const Vec3<double>& p) {
#if defined(__CUDA_ARCH__)
    v = {Real(p.x), Real(p.y), Real(p.z)};
#else
    v.x[l] = Real(p.x), v.y[l] = Real(p.y), v.z[l] = Real(p.z);
#endif
}

// Mask of the first ``count`` lanes.
CUDA_CALLABLE inline Mask first_lanes(int count) {
#if defined(__CUDA_ARCH__)
    return count > 0;
#else
    Index left;
    for (int l = 0; l < WIDTH; ++l) left[l] = count - l;
    return mask_of(left > 0);
#endif
}

#if !defined(__CUDA_ARCH__)
template <int STEP, int... L> inline Number lanes_apart(Number n, Sequence<int, L...>) {
    return __builtin_shufflevector(n, n, (L ^ STEP)...);
}
template <int STEP = WIDTH / 2> inline Real lane_sum(Number n) {
    if constexpr (STEP == 0) return n[0];
    else return lane_sum<STEP / 2>(n + lanes_apart<STEP>(n, AllLanes()));
}
#endif
// Sum over lanes and the threads of a group.
CUDA_CALLABLE inline Real total_of(Number n) {
#if defined(__CUDA_ARCH__)
    return group_sum(n);
#else
    return lane_sum(n);
#endif
}
CUDA_CALLABLE inline Real3 total_of(Vector v) { return {total_of(v.x), total_of(v.y), total_of(v.z)}; }

// Force/μ0, torque/μ0 and energy/μ0.
struct Wrench {
    Vector force, torque;
    Number energy;
};
CUDA_CALLABLE inline Wrench zero_wrench() {
    const Number zero = Number(Real(0));
    return {{zero, zero, zero}, {zero, zero, zero}, zero};
}
// Adds the wrench of a field on moments m at x: f = ∇(m·H), torque (x − center) × f + m × H, energy −m·H.
CUDA_CALLABLE inline void add_wrench(Wrench& wrench, Mask mask, const TargetField& field, Vector m, Vector x,
                                     Real3 center) {
    const Vector f = gradient_dot(field, m), torque = cross(x - broadcast(center), f) + cross(m, field.h);
    add_where(mask, wrench.force, f);
    add_where(mask, wrench.torque, torque);
    wrench.energy -= mask ? dot(m, field.h) : 0;
}
// Adds sign × (force, torque) to six numbers.
CUDA_CALLABLE inline void add_force_torque(Real* to, Real3 force, Real3 torque, Real sign) {
    to[0] += sign * force.x, to[1] += sign * force.y, to[2] += sign * force.z;
    to[3] += sign * torque.x, to[4] += sign * torque.y, to[5] += sign * torque.z;
}
}
