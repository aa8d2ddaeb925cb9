// Gradients of functions of the forces between permanent bodies, by the poses of the bodies.
//
// The force between two bodies is a sum over points on the edges of the smaller one, and the torque a sum over points
// on its edges and faces. Neither is exactly the derivative of one energy, so the Jacobian J of both wrenches by both
// poses is not quite symmetric. ``solid_gradients.py`` takes J v, with the motion v of the cotangents. Here Jᵀv − J v
// is added for the sums over points, by central differences: Jᵀv from motions of one body along each axis, J v from
// that of both.
//
// From Python: STEP, the motion between a pose and each side, in radii and radians, and MU0, INVERSE_4PI and GROUP.
// ``Arrays`` is the struct of sources.py, ``Gradients`` that of body_pair_gradients.py, which has them.
#pragma once
#include "applied/body_pairs.h"
#include "shared/team.h"

namespace warpmag {

// Velocities of a body: that of its first moment, and its angular velocity.
struct BodyMotion {
    Real3 velocity, rotation;
};
template <class Gradients> CUDA_CALLABLE inline BodyMotion motion_of(const Gradients& g, const PermanentBody& body) {
    return {real3((const Real*)g.velocity.data + 3 * (size_t)body.first),
            real3((const Real*)g.rotation.data + 3 * (size_t)body.first)};
}
// The body after a motion of a time ``step``, turned about ``center``, which moves with it.
CUDA_CALLABLE inline PermanentBody moved(PermanentBody body, Real3& center, const BodyMotion& motion, Real step) {
    const Real3 half = (Real(0.5) * step) * motion.rotation;
    const Real scale = 2 / (1 + dot(half, half));
    auto turned = [=](Real3 v) {
        const Real3 across = cross(half, v);
        return v + scale * (across + cross(half, across));
    };
    Frame& f = body.frame;
    f.origin = center + step * motion.velocity + turned(f.origin - center);
    f.x = turned(f.x), f.y = turned(f.y), f.z = turned(f.z);
    body.m_world = turned(body.m_world);
    center = center + step * motion.velocity;
    return body;
}

// Force and torque on a body about its first moment, and on the other body of a pair.
struct PairWrenches {
    Real3 force, torque, other_torque;
};
// A pair of bodies whose points are summed, and the first moments of both.
struct PosedPair {
    BodyPair pair;
    Real3 center_q, center_s;

    // The pair after a motion of the first body, and of the other one.
    CUDA_CALLABLE PosedPair after(const BodyMotion& motion, const BodyMotion& other_motion, Real step) const {
        PosedPair p = *this;
        p.pair.q = moved(pair.q, p.center_q, pair.first_is_q ? motion : other_motion, step);
        p.pair.s = moved(pair.s, p.center_s, pair.first_is_q ? other_motion : motion, step);
        return p;
    }
};
template <class Arrays> CUDA_CALLABLE inline PairWrenches wrenches_of(const Arrays& arrays, const PosedPair& p) {
    const Wrench wrench = summed_wrench(arrays, p.pair, p.center_q);
    const Real3 f = total_of(wrench.force), on_q = total_of(wrench.torque);
    const Real3 on_s = Real(-1) * (on_q + cross(p.center_q - p.center_s, f));
    if (p.pair.first_is_q) return {f, on_q, on_s};
    return {Real(-1) * f, on_s, on_q};
}

// Adds (Jᵀv − J v)/μ0 of a pair to six numbers of the first body, gradients by its position and its turns.
template <class Arrays>
CUDA_CALLABLE inline void add_pair_gradient(const Arrays& arrays, const PosedPair& p, const BodyMotion& own,
                                            const BodyMotion& other, Real* total) {
    const BodyMotion none = {{0, 0, 0}, {0, 0, 0}};
    const Real radius = p.pair.q.radius;
    for (int axis = 0; axis < 6; ++axis) {
        auto unit = [=](int k) { return Real3{Real(axis == k), Real(axis == k + 1), Real(axis == k + 2)}; };
        const Real step = axis < 3 ? STEP * radius : STEP;
        for (int side = -1; side < 2; side += 2) {
            const PairWrenches w = wrenches_of(arrays, p.after({unit(0), unit(3)}, none, side * step));
            const Real value = dot(own.velocity - other.velocity, w.force) + dot(own.rotation, w.torque)
                               + dot(other.rotation, w.other_torque);
            total[axis] += side / (2 * step) * value;
        }
    }
    auto length = [](Real3 v) { return wp::sqrt(dot(v, v)); };
    const Real speed =
        length(own.velocity) + length(other.velocity) + radius * (length(own.rotation) + length(other.rotation));
    if (!(speed > 0)) return;
    const Real step = STEP * radius / speed;
    for (int side = -1; side < 2; side += 2) {
        const PairWrenches w = wrenches_of(arrays, p.after(own, other, side * step));
        const Real weight = -side / (2 * step);
        add_force_torque(total, w.force, w.torque, weight);
        add_force_torque(total, {0, 0, 0}, cross(w.torque, own.rotation), Real(-0.5)); // rotations do not commute
    }
}

// Adds the gradients of body b to those of its first moment and its turns.
template <class Gradients> CUDA_CALLABLE inline void differentiate_body(const Gradients& g, int b) {
    const auto& arrays = g.sources;
    const PermanentBody body = body_at(arrays, b);
    const auto& world = arrays.solids.world.data[b]; // the bodies of its world
    const BodyMotion own = motion_of(g, body);
    Real total[6] = {};
    for (int c = world[0]; c < world[1]; ++c) {
        if (c == b) continue;
        const PermanentBody other = body_at(arrays, c);
        const BodyPair pair = body_pair(body, other, b < c);
        if (!pair.near) continue;
        const PosedPair posed = {pair, reference_point(arrays, pair.q), reference_point(arrays, pair.s)};
        add_pair_gradient(arrays, posed, own, motion_of(g, other), total);
    }
    if (share() != 0) return;
    Real* const by_position = (Real*)g.by_positions.data + 3 * (size_t)body.first;
    Real* const by_rotation = (Real*)g.by_rotations.data + 3 * (size_t)b;
    for (int k = 0; k < 3; ++k) by_position[k] += MU0 * total[k], by_rotation[k] += MU0 * total[k + 3];
}

template <class Word, class Gradients>
CUDA_CALLABLE inline void differentiate_body_pairs(int thread, int first, int last, int threads, Word* team,
                                                   const Gradients& g) {
#if defined(__CUDA_ARCH__)
    differentiate_body(g, thread / GROUP);
#else
    run_passes(team, threads, first, last, g.sources.solids.body.shape[0], 1,
               [&](int, int b) { differentiate_body(g, b); });
#endif
}
}
