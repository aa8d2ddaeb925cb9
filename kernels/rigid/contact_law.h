// XPBD for rigid bodies in contact: the impulses of a contact in one iteration, and how they move a body.
//
// Newton's equations (newton/_src/solvers/xpbd/kernels.py: solve_body_contact_positions, apply_body_deltas), with
// points about centres of mass. A contact is seen from one of its two bodies, the own one, and looks the same from the
// other: its impulses there are opposite, whichever of the two computes them.
//
// Lever arms are corrected, or contacts do not keep angular momentum. XPBD moves bodies with their new velocities, then
// takes contacts, and the lever arms of their impulses, at the new poses. A position that moves with its own velocity
// keeps its momentum, but lever arms r have turned by ω dt. With contact points a and b that coincided before the
// substep, opposite impulses p change the angular momentum of two bodies by dt (ω_a × r_a − ω_b × r_b) × p. That is
// negligible in a light touch, but turns a heap that strong forces press together ever faster: at the rate a dt/r for
// accelerations a. Balls are not affected: the lever arms of their contacts point along the normal. With the lever arms
// from before the substep the sum is right. So once contacts are solved, the angular impulses − dt (ω × r) × p are
// added to each body. Iterations apply impulses in portions, and ω changes with them: the mean of ω before and after is
// taken. Friction, too, is taken to act at the shape's contact point, short of its margin.
#pragma once
#include "shared/inverse_root.h"
#include "shared/vectors.h"

namespace warpmag {

struct Quaternion {
    Number x, y, z, w;
};
struct Symmetric {
    Number xx, yy, zz, xy, yz, zx;
};

CUDA_CALLABLE inline Vector imaginary(Quaternion q) { return {q.x, q.y, q.z}; }
CUDA_CALLABLE inline Vector turned(Quaternion q, Vector a) {
    const Vector t = scaled(2, cross(imaginary(q), a));
    return sum(sum(a, scaled(q.w, t)), cross(imaginary(q), t));
}
CUDA_CALLABLE inline Vector turned_back(Quaternion q, Vector a) {
    const Vector t = scaled(2, cross(imaginary(q), a));
    return sum(less(a, scaled(q.w, t)), cross(imaginary(q), t));
}
CUDA_CALLABLE inline Vector times(const Symmetric& s, Vector a) {
    return {s.xx * a.x + s.xy * a.y + s.zx * a.z, s.xy * a.x + s.yy * a.y + s.yz * a.z,
            s.zx * a.x + s.yz * a.y + s.zz * a.z};
}

// A body at the beginning of an iteration: centre of mass, orientation and angular velocity. Its contacts split it into
// shares (mass_splitting.py): the inverse mass of a share, and if it is ROUND (from Python: all bodies are) its inverse
// inertia about any axis.
struct Body {
    Vector x, spin;
    Quaternion q;
    Number ease, spin_ease;
};
// If it is not, the inverse inertia of a share in its frame.
struct Inertia {
    Symmetric inverse;
};
// A contact from its own body's side: points about the centres of mass in the bodies' frames, where surfaces rub, the
// unit normal from the other body to the own one, the sum of the margins, coefficients of friction, and whether one of
// the bodies is kinematic: 1 or 0.
struct Contact {
    Vector point, other_point, rub, other_rub, normal;
    Number margin, drifting, mu, torsional, rolling;
};
// On the own body, and angular on the other, where the opposite linear one acts.
struct Impulse {
    Vector linear, own, other;
};

CUDA_CALLABLE inline Vector arm(const Body& body, Vector point) { return turned(body.q, point); }
// Distance of the surfaces along the normal, negative where they overlap.
CUDA_CALLABLE inline Number gap(const Contact& c, const Body& own, const Body& other, Vector r, Vector other_r) {
    return dot(c.normal, sum(less(own.x, other.x), less(r, other_r))) - c.margin;
}

// Quotients and inverse lengths of nothing are nothing.
CUDA_CALLABLE inline Number quotient(Number a, Number b) {
#if defined(__CUDA_ARCH__)
    return b > 0 ? __fdividef(a, b) : 0;
#else
    return b > 0 ? a / b : a * Real(0);
#endif
}
CUDA_CALLABLE inline Number inverse_length(Vector a) {
    const Number square = dot(a, a);
    return square > Real(1e-30) ? Real(0.5) * twice_inverse_root(square) : square * Real(0);
}

// How easily an angular impulse turns a share of a body about it: the energy of a unit impulse along an axis, and of a
// unit impulse at an arm, where it also moves the body.
CUDA_CALLABLE inline Number spin_ease(const Body& body, const Inertia& inertia, Vector axis) {
    if constexpr (ROUND) return body.spin_ease;
    const Vector local = turned_back(body.q, axis);
    return dot(local, times(inertia.inverse, local));
}
CUDA_CALLABLE inline Number ease(const Body& body, const Inertia& inertia, Vector r, Vector along) {
    const Vector about = cross(r, along);
    const Number length = ROUND ? dot(about, about) : about.x * Real(0) + 1;
    return body.ease + length * spin_ease(body, inertia, about);
}

// The velocity that a kinematic body lends its surface, of which positions do not tell.
struct Drift {
    Vector v;
    Number kinematic; // 1 or 0
};
CUDA_CALLABLE inline Vector drift_at(const Drift& drift, const Body& body, Vector r) {
    return scaled(drift.kinematic, sum(drift.v, cross(body.spin, r)));
}

// Impulses of a contact whose surfaces overlap by −``distance``, at arms r. ``rate`` is the relaxation over dt,
// ``drifts`` gives the drifts of the own (1) and the other body (0), and is asked where one is kinematic.
template <class Drifts>
CUDA_CALLABLE inline Impulse contact_impulse(const Contact& c, const Body& own, const Body& other,
                                             const Inertia& inertia, const Inertia& other_inertia, Number distance,
                                             Vector r, Vector other_r, Drifts drifts, Real rate, Real dt) {
    const Vector n = c.normal;
    const Number push_ease = ease(own, inertia, r, n) + ease(other, other_inertia, other_r, n);
    const Number push = distance < 0 ? quotient(-rate * distance, push_ease) : distance * Real(0);
    Impulse p;
    p.linear = scaled(push, n);
    p.own = cross(r, p.linear);
    p.other = cross(p.linear, other_r);
    if (!any(c.mu > 0) && !any(c.torsional > 0) && !any(c.rolling > 0)) return p;

    r = arm(own, c.rub), other_r = arm(other, c.other_rub);
    Vector slip = sum(less(own.x, other.x), less(r, other_r));
    if (any(c.drifting > 0)) {
        const Vector drift = less(drift_at(drifts(1), own, r), drift_at(drifts(0), other, other_r));
        slip = sum(slip, scaled(dt, drift));
    }
    slip = less(slip, scaled(dot(n, slip), n));
    const Vector along = scaled(inverse_length(slip), slip);
    const Number rub_ease = ease(own, inertia, r, along) + ease(other, other_inertia, other_r, along);
    const Vector rub = scaled(-smaller(quotient(rate * dot(along, slip), rub_ease), c.mu * push), along);
    p.linear = sum(p.linear, rub);
    p.own = sum(p.own, cross(r, rub));
    p.other = sum(p.other, cross(rub, other_r));

    const Vector turn = less(own.spin, other.spin);
    const Number twist = dot(turn, n), twist_most = c.torsional * push;
    const Vector roll = less(turn, scaled(twist, n)), about = scaled(inverse_length(roll), roll);
    auto stop = [&](Vector axis) { // the angular impulse that stops a unit of speed about an axis
        return quotient(push * Real(0) + rate * dt,
                        spin_ease(own, inertia, axis) + spin_ease(other, other_inertia, axis));
    };
    const Number torsion = larger(smaller(twist * stop(n), twist_most), -twist_most);
    const Number rolling = smaller(dot(about, roll) * stop(about), c.rolling * push);
    const Vector friction = sum(scaled(torsion, n), scaled(rolling, about));
    p.own = less(p.own, friction);
    p.other = sum(p.other, friction);
    return p;
}

// What is missing in the angular impulse of a contact on a body, whose mean spin is given, for a linear impulse there.
CUDA_CALLABLE inline Vector lever_correction(const Body& body, Vector mean_spin, Vector point, Vector linear, Real dt) {
    return scaled(-dt, cross(cross(mean_spin, arm(body, point)), linear));
}

// What moves a body as a whole: velocity, inverse mass and inertia in its frame.
struct Whole {
    Vector v;
    Number inv_mass;
    Symmetric inverse, inertia;
};

// Moves a body by the sum of impulses and angular impulses; its velocities change with its pose.
CUDA_CALLABLE inline void apply(Body& body, Whole& whole, Vector linear, Vector angular, Real dt) {
    const Vector change = scaled(whole.inv_mass, linear);
    Vector gain = scaled(whole.inverse.xx, angular);
    if constexpr (!ROUND) {
        const Vector spin = turned_back(body.q, body.spin), spun = times(whole.inverse, turned_back(body.q, angular));
        const Vector both =
            sum(cross(spun, times(whole.inertia, sum(spin, spun))), cross(spin, times(whole.inertia, spun)));
        gain = turned(body.q, less(spun, scaled(dt, times(whole.inverse, both))));
    }
    body.x = sum(body.x, scaled(dt, change));
    const Vector half = scaled(Real(0.5) * dt, gain), axis = imaginary(body.q);
    const Vector turn = sum(axis, sum(scaled(body.q.w, half), cross(half, axis)));
    const Number w = body.q.w - dot(half, axis);
    const Number unit = Real(0.5) * twice_inverse_root(dot(turn, turn) + w * w);
    body.q = {unit * turn.x, unit * turn.y, unit * turn.z, unit * w};
    // Newton's solver lets what is this slow rest
    constexpr Real REST = Real(1e-4);
    const Vector v = sum(whole.v, change), spin = sum(body.spin, gain);
    const Number none = w * Real(0), moves = dot(v, v) < REST * REST ? none : none + 1;
    const Number spins = dot(spin, spin) < REST * REST ? none : none + 1;
    whole.v = scaled(moves, v);
    body.spin = scaled(spins, spin);
}
}
