// XPBD for rigid bodies in contact, for a substep: the impulses of a contact in one iteration, and how they move a
// body.
//
// Newton's conditions (newton/_src/solvers/xpbd/kernels.py: solve_body_contact_positions): at the end of the substep
// surfaces do not overlap, and friction stops what slips, spins and rolls as far as the push in a contact allows it.
// XPBD moves bodies with their new velocities, x' = x + dt v', so that these are conditions on velocities, taken to
// first order in the turn of a substep: exact for balls. Three things differ from Newton's kernels:
//
// A contact keeps the sum of its impulses, and an iteration may take back what was too much of it, down to no push:
// projected gradients with Nesterov's momentum (Mazhar, Heyn, Negrut and Tasora 2015, "Using Nesterov's Method to
// Accelerate Multibody Dynamics with Friction and Contact"). Pushes that are never taken back, as in Newton's kernels,
// end somewhere without overlap; these end at the least impulses that do it.
//
// What overlaps is moved apart at no more than PUSH_OUT (from Python), so that bodies that were put into each other do
// not fly off.
//
// The sum acts at one point between the surfaces on both bodies, where they are before the substep, nearer to the
// surface of the lighter one.
// Positions that move with their own velocity keep their momentum, so angular momentum is kept, too. Lever arms at the
// new poses have turned by ω dt and do not: bodies that strong forces press together would turn ever faster, at the
// rate a dt/r for accelerations a.
//
// No speed is too low to be kept.
//
// What sticks remembers how far it has slipped, and goes back. Iterations that end early leave it to slip a little, in
// each substep the same way, so that heaps would creep. An overlap is pushed out sooner or later, whatever is left of
// it in a substep; a slip would be forgotten. It is kept as long as surfaces touch (Cundall and Strack 1979, "A
// Discrete Numerical Model for Granular Assemblies"), and so is what rolls and spins. Where friction gives way, it is
// kept as far as all of the friction may bring it back. That is position, not impulse: impulses that were kept from
// substep to substep would hold what undoes overlap, too, and throw a chain of 1,000 balls apart.
//
// A contact is seen from one of its two bodies, the own one, and looks the same from the other: its impulses there are
// opposite to the last bit, whichever of the two computes them.
#pragma once
#include "shared/inverse_root.h"
#include "shared/vectors.h"

namespace warpmag {

struct Quaternion {
    Number x, y, z, w;
};

CUDA_CALLABLE inline Vector turned(Quaternion q, Vector a) {
    const Vector axis = {q.x, q.y, q.z}, t = 2 * cross(axis, a);
    return a + q.w * t + cross(axis, t);
}
// A tensor of a frame that was turned.
CUDA_CALLABLE inline Symmetric turned(Quaternion q, const Symmetric& s) {
    const Number none = q.w * Real(0), one = none + 1;
    auto row = [&](Vector axis) { return turned(q, s * turned({-q.x, -q.y, -q.z, q.w}, axis)); };
    const Vector x = row({one, none, none}), y = row({none, one, none}), z = row({none, none, one});
    return {x.x, y.y, z.z, x.y, y.z, z.x};
}

// Where a body is before the substep: its centre of mass and orientation.
struct Pose {
    Vector x;
    Quaternion q;
};
// How it moves, and its inverse mass and, if it is ROUND (from Python: all bodies are), inverse inertia about any axis.
struct Body {
    Vector v, spin;
    Number inv_mass, inv_inertia;
};
// If it is not, its inverse inertia in the world's frame; and the number of shares that contacts split it into
// (mass_splitting.py).
struct Inertia {
    Symmetric inverse;
    Number shares;
};
// A contact as it was found, from its own body's side: points about the centres of mass in the bodies' frames, where
// surfaces rub, the unit normal from the other body to the own one, the sum of the margins, coefficients of friction,
// and whether the own and the other body are kinematic: 1 or 0.
struct Touch {
    Vector point, other_point, rub, other_rub, normal;
    Number margin, mu, torsional, rolling, kinematic, other_kinematic;
};
// How far or how fast the own surface of a contact slips and turns on the other one.
struct Slip {
    Vector linear, turn;
};
// A contact as iterations need it: arms from the centres of mass to where impulses act, the speed at which a gap may
// close, impulses for a unit of speed that pushes, slips and turns, and the speed at which what sticks goes back to
// where it stuck.
struct Contact {
    Vector normal, arm, other_arm;
    Number gap_speed, push_rate, rub_rate, turn_rate, mu, torsional, rolling;
    Slip back;
};
// On the own body, and the angular one besides that of its arm; the other body gets the opposite.
struct Impulse {
    Vector linear, turn;
};

CUDA_CALLABLE inline Vector spun(const Body& body, const Inertia& inertia, Vector torque) {
    if constexpr (ROUND) return body.inv_inertia * torque;
    return inertia.inverse * torque;
}
// How easily impulses at an arm along a and along b move a share of a body along b and along a.
CUDA_CALLABLE inline Number ease(const Body& body, const Inertia& inertia, Vector arm, Vector a, Vector b) {
    return inertia.shares * (body.inv_mass * dot(a, b) + dot(cross(arm, a), spun(body, inertia, cross(arm, b))));
}
// How easily an angular impulse turns a share of a body at most.
CUDA_CALLABLE inline Number turn_ease(const Body& body, const Inertia& inertia) {
    if constexpr (ROUND) return inertia.shares * body.inv_inertia;
    const Symmetric& s = inertia.inverse;
    auto size = [](Number x) { return larger(x, -x); };
    const Number xy = size(s.xy), yz = size(s.yz), zx = size(s.zx);
    return inertia.shares * larger(s.xx + xy + zx, larger(s.yy + xy + yz, s.zz + yz + zx));
}
// Quotients of nothing are nothing.
CUDA_CALLABLE inline Number quotient(Number a, Number b) { return b > 0 ? a / b : a * Real(0); }

CUDA_CALLABLE inline Number inverse_length(Vector a) {
    const Number square = dot(a, a);
    return square > Real(1e-30) ? Real(0.5) * twice_inverse_root(square) : square * Real(0);
}
CUDA_CALLABLE inline Vector at_most(Vector a, Number length) {
    const Number one = length * Real(0) + 1;
    return (dot(a, a) > length * length ? length * inverse_length(a) : one) * a;
}
// What of a vector is across a unit vector.
CUDA_CALLABLE inline Vector tangential(Vector a, Vector n) { return a - dot(a, n) * n; }
// What is limited to ``across`` across a unit vector, and to ``about`` along it.
CUDA_CALLABLE inline Vector limited(Vector a, Vector n, Number across, Number about) {
    const Number along = dot(a, n);
    return at_most(tangential(a, n), across) + larger(smaller(along, about), -about) * n;
}
// Some unit vector across a unit vector.
CUDA_CALLABLE inline Vector across(Vector n) {
    const Number none = n.x * Real(0);
    const auto steep = n.x * n.x > Real(0.5);
    const Vector t = {steep ? n.y : none, steep ? -n.x : n.z, steep ? none : -n.y};
    return inverse_length(t) * t;
}

// What sticks goes back by this part of its slip in a substep: all at once, layers that fall on each other come back at
// the speed of what the first impact left, and overlap three times as far.
constexpr Real RETURN = Real(0.3);

// How easily an impulse across a unit vector moves a share of a body along itself at most.
CUDA_CALLABLE inline Number easiest_across(const Body& body, const Inertia& inertia, Vector arm, Vector n) {
    const Vector a = across(n), b = cross(n, a);
    const Number aa = ease(body, inertia, arm, a, a), ab = ease(body, inertia, arm, a, b);
    const Number bb = ease(body, inertia, arm, b, b), half = Real(0.5) * (aa - bb);
    return Real(0.5) * (aa + bb) + root(half * half + ab * ab);
}

// Prepares a contact, which has slipped so far while it stuck, for iterations that relax it by a part of what it lacks.
CUDA_CALLABLE inline Contact prepared(const Touch& t, const Pose& own, const Pose& other, const Body& body,
                                      const Body& other_body, const Inertia& inertia, const Inertia& other_inertia,
                                      const Slip& slipped, Real relaxation, Real dt) {
    const Vector n = t.normal, apart = own.x - other.x;
    const Vector rub = turned(own.q, t.rub), other_rub = turned(other.q, t.other_rub);
    const Number total = body.inv_mass + other_body.inv_mass;
    const Vector apart_there = apart + (rub - other_rub);
    Contact c;
    c.normal = n;
    c.arm = rub - quotient(other_body.inv_mass, total) * apart_there;
    c.other_arm = other_rub + quotient(body.inv_mass, total) * apart_there;
    const Vector points = turned(own.q, t.point) - turned(other.q, t.other_point);
    // kinematic bodies stand where they do at the end already, and lend their surfaces a velocity besides; without it
    // the gap is the one that they and others were found with
    const Vector drift = body.v + cross(body.spin, c.arm), its = cross(other_body.spin, c.other_arm);
    const Vector other_drift = other_body.v + its;
    const Number lent = t.kinematic * dot(n, drift) - t.other_kinematic * dot(n, other_drift);
    c.gap_speed = larger((dot(n, apart + points) - t.margin) / dt - lent, n.x * Real(0) - PUSH_OUT);
    // the sums over both bodies that mass_splitting.py bounds
    const Number none = n.x * Real(0), push_ease = ease(body, inertia, c.arm, n, n),
                 other_push_ease = ease(other_body, other_inertia, c.other_arm, n, n);
    const Number rub_ease = easiest_across(body, inertia, c.arm, n),
                 other_rub_ease = easiest_across(other_body, other_inertia, c.other_arm, n);
    c.push_rate = quotient(none + relaxation, push_ease + other_push_ease);
    c.rub_rate = quotient(none + Real(FRICTION) * relaxation, rub_ease + other_rub_ease);
    c.turn_rate =
        quotient(none + Real(FRICTION) * relaxation, turn_ease(body, inertia) + turn_ease(other_body, other_inertia));
    c.mu = t.mu, c.torsional = t.torsional, c.rolling = t.rolling;
    c.back = {RETURN / dt * tangential(slipped.linear, n), RETURN / dt * slipped.turn};
    return c;
}

// How the own surface of a contact moves on the other one.
CUDA_CALLABLE inline Slip slip_of(const Contact& c, const Body& own, const Body& other) {
    const Vector mine = own.v + cross(own.spin, c.arm), its = other.v + cross(other.spin, c.other_arm);
    return {mine - its, own.spin - other.spin};
}
// The impulse of a contact after an iteration, from one that its bodies have and from how they move: it does not pull,
// and its push limits friction.
CUDA_CALLABLE inline Impulse relaxed(const Contact& c, const Body& own, const Body& other, Impulse p) {
    const Slip slip = slip_of(c, own, other);
    const Number opening = dot(slip.linear, c.normal), none = opening * Real(0);
    const Number push = larger(dot(p.linear, c.normal) - c.push_rate * (opening + c.gap_speed), none);
    const Vector pressed = push * c.normal;
    if (!any(c.mu > 0) && !any(c.torsional > 0) && !any(c.rolling > 0)) return {pressed, none * c.normal};
    const Vector linear = p.linear - c.rub_rate * (slip.linear + c.back.linear);
    const Vector turn = p.turn - c.turn_rate * (slip.turn + c.back.turn);
    const Vector rub = at_most(tangential(linear, c.normal), c.mu * push);
    return {rub + pressed, limited(turn, c.normal, c.rolling * push, c.torsional * push)};
}

CUDA_CALLABLE inline Impulse change(Impulse from, Impulse to) { return {to.linear - from.linear, to.turn - from.turn}; }

// What a contact has given its bodies: its impulse after the last iteration, and that with momentum, which they have.
struct Given {
    Impulse last, ahead;
};
// Nesterov's momentum: the part of its last change that an impulse goes on by. It is bounded, so that nothing has to
// tell when to begin anew, and the last iteration leaves impulses that contacts admit.
CUDA_CALLABLE inline Real momentum_at(int iteration, int iterations) {
    const Real part = Real(iteration) / (iteration + 3), most = Real(MOMENTUM);
    return iteration == iterations - 1 ? 0 : part < most ? part : most;
}
// One iteration of a contact: returns the impulse that it adds.
CUDA_CALLABLE inline Impulse press(const Contact& c, const Body& own, const Body& other, Given& given, Real momentum) {
    const Impulse now = relaxed(c, own, other, given.ahead), gain = change(given.last, now);
    const Impulse ahead = {now.linear + momentum * gain.linear, now.turn + momentum * gain.turn};
    const Impulse added = change(given.ahead, ahead);
    given = {now, ahead};
    return added;
}
// How far a contact has slipped while it stuck, at the end of a substep whose iterations left an impulse.
CUDA_CALLABLE inline Slip slipped_so_far(const Contact& c, const Body& own, const Body& other, Impulse p,
                                         Real relaxation, Real dt) {
    const Slip slip = slip_of(c, own, other);
    auto after = [&](Vector back, Vector now) { return dt * (1 / RETURN * back + now); };
    const Vector linear = after(c.back.linear, tangential(slip.linear, c.normal));
    const Vector turn = after(c.back.turn, slip.turn);
    const Number push = Real(FRICTION) * relaxation * dt / RETURN * dot(p.linear, c.normal);
    const Number per_turn = quotient(push, c.turn_rate);
    return {at_most(linear, quotient(c.mu * push, c.rub_rate)),
            limited(turn, c.normal, c.rolling * per_turn, c.torsional * per_turn)};
}
// The angular impulses of an impulse about the centres of mass.
CUDA_CALLABLE inline Vector on_own(const Contact& c, Impulse p) { return cross(c.arm, p.linear) + p.turn; }
CUDA_CALLABLE inline Vector on_other(const Contact& c, Impulse p) { return -(cross(c.other_arm, p.linear) + p.turn); }

// Moves a body by the sums of impulses and angular impulses.
CUDA_CALLABLE inline void apply(Body& body, const Inertia& inertia, Vector linear, Vector angular) {
    body.v += body.inv_mass * linear;
    body.spin += spun(body, inertia, angular);
}
}
