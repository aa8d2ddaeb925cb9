// XPBD for rigid bodies in contact: the impulse of a contact in one iteration, and the motion that it causes.
//
// The conditions are Newton's (newton/_src/solvers/xpbd/kernels.py: solve_body_contact_positions). At the end of the
// substep surfaces do not overlap. Friction stops slip, spin and roll as far as the normal impulse allows. XPBD moves
// bodies with their new velocities, x' = x + dt v', so these are conditions on velocities. They are linear in the
// rotation during a substep, which is exact for balls. Five things differ from Newton's kernels:
//
// 1. Accumulated impulses. A contact keeps the sum of its impulses, and an iteration may reduce it, down to zero
//    normal impulse. The method is projected gradients with Nesterov's momentum (Mazhar, Heyn, Negrut and Tasora 2015,
//    "Using Nesterov's Method to Accelerate Multibody Dynamics with Friction and Contact"). Newton's iterations only
//    add impulses, and end at some state without overlap. The iterations here converge to the smallest impulses that
//    prevent overlap.
//
// 2. Penetration recovery. Overlapping bodies separate at RECOVERY_SPEED (from Python) at most. So bodies that overlap
//    at the start do not fly apart.
//
// 3. Conserved angular momentum. The impulse acts at one point on both bodies. That point lies between the surfaces
//    where they are before the substep, nearer to the surface of the lighter body. Lever arms at the new poses have
//    rotated by ω dt and would not conserve angular momentum. Bodies that strong forces press together would spin up at
//    the rate a dt/r for accelerations a.
//
// 4. No rest threshold. Low speeds are not set to zero.
//
// 5. Static friction with memory. A sticking contact stores its accumulated slip, and the surfaces return by that
//    slip. Iterations that stop early leave a little slip, in every substep in the same direction, so that heaps
//    would creep. Overlap needs no such memory: it is detected again in the next substep. The slip, as well as the
//    accumulated rolling and spinning angle, is stored as long as the surfaces touch (Cundall and Strack 1979, "A
//    Discrete Numerical Model for Granular Assemblies"). At sliding contacts it is limited to the slip that the full
//    friction force can return. The memory is a displacement, not an impulse. Impulses from the last substep would
//    include those that removed overlap, and throw a chain of 1,000 balls apart.
//
// A contact is evaluated from one of its two bodies, called the own body. Evaluated from the other body, its impulses
// are bitwise opposite.
#pragma once
#include "shared/inverse_root.h"
#include "shared/vectors.h"

namespace warpmag {

struct Quaternion {
    Number x, y, z, w;
};

// Vector rotated by a unit quaternion.
CUDA_CALLABLE inline Vector rotate(Quaternion q, Vector a) {
    const Vector axis = {q.x, q.y, q.z}, t = 2 * cross(axis, a);
    return a + q.w * t + cross(axis, t);
}
// Tensor R s Rᵀ for the rotation R of a unit quaternion.
CUDA_CALLABLE inline Symmetric rotate(Quaternion q, const Symmetric& s) {
    const Number zero = q.w * Real(0), unit = zero + 1;
    auto row = [&](Vector axis) { return rotate(q, s * rotate({-q.x, -q.y, -q.z, q.w}, axis)); };
    const Vector x = row({unit, zero, zero}), y = row({zero, unit, zero}), z = row({zero, zero, unit});
    return {x.x, y.y, z.z, x.y, y.z, z.x};
}

// Center of mass [m] and orientation of a body before the substep.
struct Pose {
    Vector x;
    Quaternion q;
};
// Velocity [m/s], angular velocity [rad/s] and inverse mass [1/kg] of a body. Where ROUND (from Python) is set, all
// bodies have the same inertia about every axis, and ``inv_inertia`` is its inverse [1/(kg·m²)].
struct Body {
    Vector v, omega;
    Number inv_mass, inv_inertia;
};
// Inverse inertia in the world's frame for bodies that are not ROUND, and the number of shares into which mass
// splitting divides the body (mass_splitting.py).
struct Inertia {
    Symmetric inverse;
    Number shares;
};
// A detected contact, from the own body's side. ``point`` is the contact point and ``surface`` the point on the surface
// where friction acts, relative to the centers of mass and in the frames of the bodies. ``normal`` points from the
// other body to the own one, ``margin`` is the sum of the margins. ``mu``, ``torsional`` and ``rolling`` are
// coefficients of friction. ``kinematic`` and ``other_kinematic`` are 1 if the body is kinematic, else 0.
struct DetectedContact {
    Vector point, other_point, surface, other_surface, normal;
    Number margin, mu, torsional, rolling, kinematic, other_kinematic;
};
// Slip of the own surface on the other one: displacement and rotation [m, rad], or slip velocity [m/s, rad/s].
struct Slip {
    Vector linear, angular;
};
// A contact prepared for the iterations: the normal, lever arms about the centers of mass, and coefficients of
// friction. The gap closes at ``gap_speed`` at most. ``normal_mass``, ``tangential_mass`` and ``angular_mass`` are
// effective masses times the relaxation [kg, kg, kg·m²]. A sticking contact returns at ``return_velocity``.
struct Contact {
    Vector normal, arm, other_arm;
    Number gap_speed, normal_mass, tangential_mass, angular_mass, mu, torsional, rolling;
    Slip return_velocity;
};
// Impulse on the own body [N·s], and the angular impulse in addition to that of its lever arm [N·m·s]. The other body
// receives the opposite.
struct Impulse {
    Vector linear, angular;
};

// a / b, or 0 where b ≤ 0.
CUDA_CALLABLE inline Number divide_or_zero(Number a, Number b) { return b > 0 ? a / b : a * Real(0); }
CUDA_CALLABLE inline Number inverse_length(Vector a) {
    const Number square = dot(a, a);
    return square > Real(1e-30) ? Real(0.5) * twice_inverse_root(square) : square * Real(0);
}
// Vector shortened to ``length`` where it is longer.
CUDA_CALLABLE inline Vector clamp_length(Vector a, Number length) {
    const Number unit = length * Real(0) + 1;
    return (dot(a, a) > length * length ? length * inverse_length(a) : unit) * a;
}
// Component of a vector perpendicular to the unit vector n.
CUDA_CALLABLE inline Vector tangential(Vector a, Vector n) { return a - dot(a, n) * n; }
// Vector with its component perpendicular to n limited to ``across``, and the one along n to ``along``.
CUDA_CALLABLE inline Vector clamp_components(Vector a, Vector n, Number across, Number along) {
    const Number axial = dot(a, n);
    return clamp_length(tangential(a, n), across) + larger(smaller(axial, along), -along) * n;
}
// Unit vector perpendicular to the unit vector n.
CUDA_CALLABLE inline Vector perpendicular(Vector n) {
    const Number zero = n.x * Real(0);
    const auto near_x = n.x * n.x > Real(0.5);
    const Vector t = {near_x ? n.y : zero, near_x ? -n.x : n.z, near_x ? zero : -n.y};
    return inverse_length(t) * t;
}

// Change of a body's angular velocity by an angular impulse: ω = I⁻¹ L.
CUDA_CALLABLE inline Vector angular_response(const Body& body, const Inertia& inertia, Vector angular) {
    if constexpr (ROUND) return body.inv_inertia * angular;
    return inertia.inverse * angular;
}
// Inverse effective mass [1/kg] of a body's share for impulses at a lever arm r, along a and b:
// shares (a·b/m + (r × a)·I⁻¹ (r × b)).
CUDA_CALLABLE inline Number mobility(const Body& body, const Inertia& inertia, Vector arm, Vector a, Vector b) {
    return inertia.shares
           * (body.inv_mass * dot(a, b) + dot(cross(arm, a), angular_response(body, inertia, cross(arm, b))));
}
// Largest inverse effective mass of a body's share for impulses perpendicular to n: the larger eigenvalue of the
// symmetric 2 × 2 mobility in the tangent plane.
CUDA_CALLABLE inline Number tangential_mobility(const Body& body, const Inertia& inertia, Vector arm, Vector n) {
    const Vector a = perpendicular(n), b = cross(n, a);
    const Number aa = mobility(body, inertia, arm, a, a), ab = mobility(body, inertia, arm, a, b);
    const Number bb = mobility(body, inertia, arm, b, b), half = Real(0.5) * (aa - bb);
    return Real(0.5) * (aa + bb) + root(half * half + ab * ab);
}
// Upper bound of the inverse inertia of a body's share about any axis [1/(kg·m²)]: the largest absolute row sum.
CUDA_CALLABLE inline Number angular_mobility(const Body& body, const Inertia& inertia) {
    if constexpr (ROUND) return inertia.shares * body.inv_inertia;
    const Symmetric& s = inertia.inverse;
    auto magnitude = [](Number x) { return larger(x, -x); };
    const Number xy = magnitude(s.xy), yz = magnitude(s.yz), zx = magnitude(s.zx);
    return inertia.shares * larger(s.xx + xy + zx, larger(s.yy + xy + yz, s.zz + yz + zx));
}

// Fraction of its accumulated slip by which a sticking contact returns in a substep. With 1, layers that fall on each
// other return at the speed that the first impact left, and overlap three times as far.
constexpr Real SLIP_RETURN = Real(0.3);

// Prepares a contact with accumulated ``slip`` for iterations that apply the fraction ``relaxation`` of each
// correction.
CUDA_CALLABLE inline Contact prepare_contact(const DetectedContact& detected, const Pose& own, const Pose& other,
                                             const Body& body, const Body& other_body, const Inertia& inertia,
                                             const Inertia& other_inertia, const Slip& slip, Real relaxation, Real dt) {
    const Vector n = detected.normal, apart = own.x - other.x;
    const Vector surface = rotate(own.q, detected.surface), other_surface = rotate(other.q, detected.other_surface);
    const Number total = body.inv_mass + other_body.inv_mass;
    const Vector surfaces_apart = apart + (surface - other_surface);
    Contact c;
    c.normal = n;
    c.arm = surface - divide_or_zero(other_body.inv_mass, total) * surfaces_apart;
    c.other_arm = other_surface + divide_or_zero(body.inv_mass, total) * surfaces_apart;
    const Vector points = rotate(own.q, detected.point) - rotate(other.q, detected.other_point);
    // a kinematic body is already at its pose of the substep's end, but its velocity still moves its surface; the gap
    // speed excludes that velocity
    const Vector own_velocity = body.v + cross(body.omega, c.arm);
    const Vector other_rotation = cross(other_body.omega, c.other_arm);
    const Vector other_velocity = other_body.v + other_rotation;
    const Number kinematic_speed =
        detected.kinematic * dot(n, own_velocity) - detected.other_kinematic * dot(n, other_velocity);
    c.gap_speed =
        larger((dot(n, apart + points) - detected.margin) / dt - kinematic_speed, n.x * Real(0) - RECOVERY_SPEED);
    // mass_splitting.py bounds these sums of the mobilities of both bodies
    const Number zero = n.x * Real(0), own_normal = mobility(body, inertia, c.arm, n, n),
                 other_normal = mobility(other_body, other_inertia, c.other_arm, n, n);
    const Number own_tangential = tangential_mobility(body, inertia, c.arm, n),
                 other_tangential = tangential_mobility(other_body, other_inertia, c.other_arm, n);
    c.normal_mass = divide_or_zero(zero + relaxation, own_normal + other_normal);
    c.tangential_mass = divide_or_zero(zero + Real(FRICTION) * relaxation, own_tangential + other_tangential);
    c.angular_mass = divide_or_zero(zero + Real(FRICTION) * relaxation,
                                    angular_mobility(body, inertia) + angular_mobility(other_body, other_inertia));
    c.mu = detected.mu, c.torsional = detected.torsional, c.rolling = detected.rolling;
    c.return_velocity = {SLIP_RETURN / dt * tangential(slip.linear, n), SLIP_RETURN / dt * slip.angular};
    return c;
}

// Velocity of the own surface of a contact relative to the other one.
CUDA_CALLABLE inline Slip relative_velocity(const Contact& c, const Body& own, const Body& other) {
    const Vector own_velocity = own.v + cross(own.omega, c.arm);
    const Vector other_velocity = other.v + cross(other.omega, c.other_arm);
    return {own_velocity - other_velocity, own.omega - other.omega};
}
// Impulse p of a contact after a relaxation step from the bodies' present velocities, projected onto the friction cone.
// The normal impulse is at least 0, and friction at most μ times it.
CUDA_CALLABLE inline Impulse relax_impulse(const Contact& c, const Body& own, const Body& other, Impulse p) {
    const Slip velocity = relative_velocity(c, own, other);
    const Number opening = dot(velocity.linear, c.normal), zero = opening * Real(0);
    const Number push = larger(dot(p.linear, c.normal) - c.normal_mass * (opening + c.gap_speed), zero);
    const Vector normal_impulse = push * c.normal;
    if (!any(c.mu > 0) && !any(c.torsional > 0) && !any(c.rolling > 0)) return {normal_impulse, zero * c.normal};
    const Vector linear = p.linear - c.tangential_mass * (velocity.linear + c.return_velocity.linear);
    const Vector angular = p.angular - c.angular_mass * (velocity.angular + c.return_velocity.angular);
    const Vector friction = clamp_length(tangential(linear, c.normal), c.mu * push);
    return {friction + normal_impulse, clamp_components(angular, c.normal, c.rolling * push, c.torsional * push)};
}

CUDA_CALLABLE inline Impulse difference(Impulse from, Impulse to) {
    return {to.linear - from.linear, to.angular - from.angular};
}

// Accumulated impulse of a contact after the last iteration, and its extrapolation by Nesterov's momentum. The bodies'
// velocities contain the extrapolated one.
struct AccumulatedImpulse {
    Impulse last, extrapolated;
};
// Nesterov's momentum: the fraction of its last change by which an impulse is extrapolated. It is bounded, which makes
// restarts unnecessary. It is 0 in the last iteration, so that the final impulses are in the friction cone.
CUDA_CALLABLE inline Real momentum_at(int iteration, int iterations) {
    const Real fraction = Real(iteration) / (iteration + 3), limit = Real(MOMENTUM);
    return iteration == iterations - 1 ? 0 : fraction < limit ? fraction : limit;
}
// Performs an iteration of a contact and returns the impulse to add to the bodies.
CUDA_CALLABLE inline Impulse iterate_contact(const Contact& c, const Body& own, const Body& other,
                                             AccumulatedImpulse& impulse, Real momentum) {
    const Impulse relaxed = relax_impulse(c, own, other, impulse.extrapolated),
                  change = difference(impulse.last, relaxed);
    const Impulse extrapolated = {relaxed.linear + momentum * change.linear,
                                  relaxed.angular + momentum * change.angular};
    const Impulse added = difference(impulse.extrapolated, extrapolated);
    impulse = {relaxed, extrapolated};
    return added;
}
// Accumulated slip of a contact [m, rad] at the end of a substep, with the impulse p after the last iteration.
CUDA_CALLABLE inline Slip accumulated_slip(const Contact& c, const Body& own, const Body& other, Impulse p,
                                           Real relaxation, Real dt) {
    const Slip velocity = relative_velocity(c, own, other);
    auto slip_of = [&](Vector returning, Vector speed) { return dt * (1 / SLIP_RETURN * returning + speed); };
    const Vector linear = slip_of(c.return_velocity.linear, tangential(velocity.linear, c.normal));
    const Vector angular = slip_of(c.return_velocity.angular, velocity.angular);
    const Number push = Real(FRICTION) * relaxation * dt / SLIP_RETURN * dot(p.linear, c.normal);
    const Number per_angle = divide_or_zero(push, c.angular_mass);
    return {clamp_length(linear, divide_or_zero(c.mu * push, c.tangential_mass)),
            clamp_components(angular, c.normal, c.rolling * per_angle, c.torsional * per_angle)};
}
// Angular impulses about the centers of mass of the two bodies.
CUDA_CALLABLE inline Vector own_angular_impulse(const Contact& c, Impulse p) {
    return cross(c.arm, p.linear) + p.angular;
}
CUDA_CALLABLE inline Vector other_angular_impulse(const Contact& c, Impulse p) {
    return -(cross(c.other_arm, p.linear) + p.angular);
}

// Changes a body's velocities by an impulse and an angular impulse: v += p/m, ω += I⁻¹ L.
CUDA_CALLABLE inline void apply_impulse(Body& body, const Inertia& inertia, Vector linear, Vector angular) {
    body.v += body.inv_mass * linear;
    body.omega += angular_response(body, inertia, angular);
}
}
