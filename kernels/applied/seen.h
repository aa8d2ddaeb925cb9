// What sources make of targets: field and gradient, seen by several at a time, and what pushes moments there.
#pragma once
#include "applied/field_at.h"
#include "applied/solids.h"

namespace warpmag {

// A field and its derivatives along x, y and z.
struct Seen {
    Vector h, x, y, z;
};
CUDA_CALLABLE inline Seen nothing_seen() {
    const Number zero = Number(Real(0));
    const Vector none = {zero, zero, zero};
    return {none, none, none, none};
}
CUDA_CALLABLE inline Seen seen_of(const Near& n) {
    return {n.h, {n.t.xx, n.t.xy, n.t.zx}, {n.t.xy, n.t.yy, n.t.yz}, {n.t.zx, n.t.yz, n.t.zz}};
}
CUDA_CALLABLE inline void add_where(Mask wanted, Seen& to, const Seen& s) {
    add_where(wanted, to.h, s.h), add_where(wanted, to.x, s.x);
    add_where(wanted, to.y, s.y), add_where(wanted, to.z, s.z);
}
// ∇(m·H)
CUDA_CALLABLE inline Vector pulled(const Seen& s, Vector m) { return {dot(s.x, m), dot(s.y, m), dot(s.z, m)}; }

CUDA_CALLABLE inline void set_lane(Vector& v, int l, const Vec3<double>& p) {
#if defined(__CUDA_ARCH__)
    v = {Real(p.x), Real(p.y), Real(p.z)};
#else
    v.x[l] = Real(p.x), v.y[l] = Real(p.y), v.z[l] = Real(p.z);
#endif
}

// Which lanes the first ``held`` are.
CUDA_CALLABLE inline Mask first_lanes(int held) {
#if defined(__CUDA_ARCH__)
    return held > 0;
#else
    Index left;
    for (int l = 0; l < WIDTH; ++l) left[l] = held - l;
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
// Over lanes and the threads of a group.
CUDA_CALLABLE inline Real added_up(Number n) {
#if defined(__CUDA_ARCH__)
    return group_sum(n);
#else
    return lane_sum(n);
#endif
}
CUDA_CALLABLE inline Three added_up(Vector v) { return {added_up(v.x), added_up(v.y), added_up(v.z)}; }

// Force and torque, both to be multiplied by μ0, and energy.
struct Push {
    Vector force, torque;
    Number energy;
};
CUDA_CALLABLE inline Push no_push() {
    const Number zero = Number(Real(0));
    return {{zero, zero, zero}, {zero, zero, zero}, zero};
}
// Moments m at x in a field, torques about ``center``.
CUDA_CALLABLE inline void push_moments(Push& push, Mask wanted, const Seen& seen, Vector m, Vector x, Three center) {
    const Vector f = pulled(seen, m), turn = cross(x - spread(center), f) + cross(m, seen.h);
    add_where(wanted, push.force, f);
    add_where(wanted, push.torque, turn);
    push.energy -= wanted ? dot(m, seen.h) : 0;
}
CUDA_CALLABLE inline void add_numbers(Real* to, Three force, Three torque, Real sign) {
    to[0] += sign * force.x, to[1] += sign * force.y, to[2] += sign * force.z;
    to[3] += sign * torque.x, to[4] += sign * torque.y, to[5] += sign * torque.z;
}
}
