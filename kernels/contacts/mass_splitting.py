"""Mass splitting: masses are divided among contacts, so that iterations that relax all contacts at once converge.

The n corner contacts of two boxes face to face all close the same gap, so that they overshoot n times. Iterations with
momentum β diverge from an overshoot of 2 (1 + β)/(1 + 2β) = 1.38 on (``contact_law.h``). A contact that acts on its
share of each body's mass closes its share of the gap. Its impulses on both bodies remain opposite, so momentum is
conserved. Division of each body's sum by its number of contacts would not conserve it. Reference: Tonge, Benevolenski
and Voroshilov 2012, "Mass Splitting for Jitter-Free Parallel Rigid Body Simulation".

The number of shares bounds the joint effect of all contacts of a body. Let J be the Jacobian rows of the contacts: one
normal, two tangential, three angular. Each row is divided by the root of its mobility J M⁻¹ Jᵀ, and multiplied by the
root of its relaxation. In the solver, the mobility of a row is the sum over both bodies of shares times mobility. So
the iteration converges if, for every body, the largest eigenvalue of G = M^-½ Jᵀ J M^-½ is at most 1.38 times its
shares. G is 6 × 6 for any number of contacts. Its largest row sum and its Frobenius norm are upper bounds of its
eigenvalues.
"""

import warp as wp

from warpmag.kernels.contacts.solve import FRICTION, MOMENTUM
from warpmag.kernels.rigid.newton_views import BodyView, ContactView, contact_bodies, contact_count, contact_depth

wp.set_module_options({"enable_backward": False})

ENTRIES = 36  # entries of G; those on and above the diagonal are used
_STABLE_RELAXATION = wp.constant(2.0 * (1.0 + MOMENTUM) / (1.0 + 2.0 * MOMENTUM))
_TOUCHING_GAP = wp.constant(0.1)
"""Distance up to which open contacts count, relative to the sum of their shapes' contact gaps."""
_STEPS_PER_UNIT = wp.constant(16384.0)
"""Inverse resolution of entries of G, which are summed as integers: their sum does not depend on the order."""


@wp.func
def _cholesky(a: wp.mat33) -> wp.mat33:
    """Return the Cholesky factor L, L Lᵀ = a, of a positive semidefinite matrix; zero rows stay zero."""
    factor = wp.mat33()
    for j in range(3):
        d = a[j, j]
        for k in range(j):
            d -= factor[j, k] * factor[j, k]
        if d > 1.0e-6 * a[j, j]:
            factor[j, j] = wp.sqrt(d)
            for i in range(j + 1, 3):
                t = a[i, j]
                for k in range(j):
                    t -= factor[i, k] * factor[j, k]
                factor[i, j] = t / factor[j, j]
    return factor


@wp.func
def _row(arm: wp.vec3, n: wp.vec3, inv_mass: float, root: wp.mat33) -> wp.spatial_vector:
    """Return M^-½ Jᵀ of an impulse along n at a lever arm, in the body's frame, with I⁻¹ = ``root`` ``root``ᵀ."""
    return wp.spatial_vector(wp.sqrt(inv_mass) * n, wp.transpose(root) * wp.cross(arm, n))


@wp.func
def _scaled_outer(u: wp.spatial_vector, largest: float) -> wp.spatial_matrix:
    """Return u uᵀ / largest, or 0 where ``largest`` is not positive."""
    if largest <= 0.0:
        return wp.spatial_matrix()
    return wp.outer(u, u) / largest


@wp.func
def _perpendicular(n: wp.vec3) -> wp.vec3:
    """Return a unit vector perpendicular to the unit vector n."""
    if n[0] * n[0] > 0.5:
        return wp.normalize(wp.vec3(n[1], -n[0], 0.0))
    return wp.normalize(wp.vec3(0.0, n[2], -n[1]))


@wp.func
def _contact_matrix(
    bodies: BodyView,
    body: int,
    point: wp.vec3,
    normal: wp.vec3,
    friction: float,
    rotational_friction: float,
    relaxation: float,
) -> wp.spatial_matrix:
    """Return the contribution to G of a contact at a point of the body's frame."""
    n = wp.quat_rotate_inv(wp.transform_get_rotation(bodies.q[body]), normal)
    arm, m, root = point - bodies.com[body], bodies.inv_mass[body], _cholesky(bodies.inv_inertia[body])
    push = _row(arm, n, m, root)
    matrix = relaxation * _scaled_outer(push, wp.dot(push, push))
    if friction > 0.0:
        t = _perpendicular(n)
        a, b = _row(arm, t, m, root), _row(arm, wp.cross(n, t), m, root)
        aa, bb, ab = wp.dot(a, a), wp.dot(b, b), wp.dot(a, b)
        largest = 0.5 * (aa + bb) + wp.sqrt(0.25 * (aa - bb) * (aa - bb) + ab * ab)
        matrix += relaxation * FRICTION * (_scaled_outer(a, largest) + _scaled_outer(b, largest))
    if rotational_friction > 0.0:
        largest = float(0.0)
        for i in range(3):
            row = float(0.0)
            for j in range(3):
                row += wp.abs(bodies.inv_inertia[body][i, j])
            largest = wp.max(largest, row)
        for i in range(3):
            rotation = wp.spatial_vector(wp.vec3(), root[i])
            matrix += relaxation * FRICTION * _scaled_outer(rotation, largest)
    return matrix


@wp.func
def _normal_speed(bodies: BodyView, body: int, point: wp.vec3, normal: wp.vec3) -> float:
    """Return the velocity along ``normal`` of a point of a body's frame [m/s]."""
    if body < 0:
        return 0.0
    arm = wp.quat_rotate(wp.transform_get_rotation(bodies.q[body]), point - bodies.com[body])
    v = wp.spatial_top(bodies.qd[body]) + wp.cross(wp.spatial_bottom(bodies.qd[body]), arm)
    return wp.dot(normal, v)


@wp.kernel
def _add_contacts(
    contacts: ContactView,
    bodies: BodyView,
    splits_in: wp.array[wp.int32],
    relaxation: float,
    dt: float,
    entries_out: wp.array2d[wp.int32],
):
    i = wp.tid()
    if i >= contact_count(contacts):
        return
    shape0, shape1 = contacts.shape0[i], contacts.shape1[i]
    body0, body1 = contact_bodies(contacts, i)
    n = contacts.normal[i]
    closing = _normal_speed(bodies, body0, contacts.point0[i], n) - _normal_speed(bodies, body1, contacts.point1[i], n)
    gaps = contacts.shape_gap[shape0] + contacts.shape_gap[shape1]
    if contact_depth(contacts, bodies.q, i) + dt * wp.max(closing, 0.0) < -_TOUCHING_GAP * gaps:
        return
    friction = contacts.mu[shape0] + contacts.mu[shape1]
    rotational_friction = contacts.mu_torsional[shape0] + contacts.mu_torsional[shape1]
    rotational_friction += contacts.mu_rolling[shape0] + contacts.mu_rolling[shape1]
    for end in range(2):
        body = wp.where(end == 0, body0, body1)
        if body >= 0 and splits_in[body] == 1:
            point = wp.where(
                end == 0, contacts.point0[i] + contacts.offset0[i], contacts.point1[i] + contacts.offset1[i]
            )
            matrix = _contact_matrix(bodies, body, point, n, friction, rotational_friction, relaxation)
            for j in range(6):
                for k in range(j, 6):
                    wp.atomic_add(entries_out, 6 * j + k, body, int(wp.rint(_STEPS_PER_UNIT * matrix[j, k])))


@wp.kernel
def _find_shares(entries_io: wp.array2d[wp.int32], shares_out: wp.array[float]):
    body = wp.tid()
    rows, square = wp.spatial_vector(), float(0.0)
    for j in range(6):
        for k in range(j, 6):
            entry = wp.abs(float(entries_io[6 * j + k, body])) / _STEPS_PER_UNIT
            entries_io[6 * j + k, body] = 0
            rows[j] += entry
            square += entry * entry
            if k > j:
                rows[k] += entry
                square += entry * entry
    largest = float(0.0)
    for j in range(6):
        largest = wp.max(largest, rows[j])
    shares_out[body] = wp.max(1.0, wp.min(largest, wp.sqrt(square)) / _STABLE_RELAXATION)


def launch_find_shares(
    contacts: ContactView, bodies: BodyView, splits, entries, shares, *, relaxation: float, dt: float
):
    """Write the number of shares into which each body is divided.

    Args:
        bodies: Bodies as contacts were detected, with their velocities without contacts.
        splits: 1 for bodies that may be divided, shape [bodies].
        entries: Work array of zeros, zero again afterwards, shape [``ENTRIES``, bodies].
        shares: Out, number of shares, at least 1, shape [bodies]. Only contacts count that are closed, nearly closed,
            or may close in the substep.
        relaxation: Fraction of its correction that each contact applies in an iteration.
    """
    device = shares.device
    inputs = [contacts, bodies, splits, relaxation, dt]
    wp.launch(_add_contacts, dim=contacts.shape0.shape[0], inputs=inputs, outputs=[entries], device=device)
    wp.launch(_find_shares, dim=len(shares), outputs=[entries, shares], device=device)


@wp.kernel
def _split_masses(
    shares_in: wp.array[float],
    inv_mass_in: wp.array[float],
    inv_inertia_in: wp.array[wp.mat33],
    inv_mass_out: wp.array[float],
    inv_inertia_out: wp.array[wp.mat33],
):
    body = wp.tid()
    inv_mass_out[body] = shares_in[body] * inv_mass_in[body]
    inv_inertia_out[body] = shares_in[body] * inv_inertia_in[body]


def launch_split_masses(shares, whole, split):
    """Write the inverse masses [1/kg] and inertias [1/(kg·m²)] of a share of each body, from those of whole bodies."""
    wp.launch(_split_masses, dim=len(shares), inputs=[shares, *whole], outputs=[*split], device=shares.device)
