"""Masses split among contacts, so that iterations that relax all contacts at once converge.

Corners of boxes face to face all close the same gap: n of them overshoot it n times the relaxation, and iterations with
momentum β diverge from 2 (1 + β)/(1 + 2β) = 1.38 times on (``contact_law.h``). A contact that acts on its share of each
body's mass closes its share of the gap (Tonge, Benevolenski and Voroshilov 2012, "Mass Splitting for Jitter-Free
Parallel Rigid Body Simulation"). Its impulses on both bodies stay opposite, so that momentum is kept, which dividing
each body's sum by its number of contacts would not do.

The shares bound what all contacts together do. Let J be the rows of a body's contacts (push, two of friction, three of
what turns), each over the root of its own ease J M⁻¹ Jᵀ and times the root of the part by which it is relaxed. The
iteration converges where the largest eigenvalue of G = M^-½ Jᵀ J M^-½ is at most 1.38 times the body's shares, for
every body: a row's ease is the sum over its two bodies of their shares times their eases. G has six rows and columns,
whatever the number of contacts, and no eigenvalue is larger than its largest row sum or its Frobenius norm.
"""

import warp as wp

from warpmag.kernels.contacts.solve import FRICTION, MOMENTUM
from warpmag.kernels.rigid.newton_views import BodyView, ContactView, contact_bodies, contact_count, contact_depth

wp.set_module_options({"enable_backward": False})

ENTRIES = 36
"""Entries of G, of which those on and above the diagonal are used."""
_STABLE = wp.constant(2.0 * (1.0 + MOMENTUM) / (1.0 + 2.0 * MOMENTUM))
_TOUCHING_GAP = wp.constant(0.1)
"""Distance up to which contacts count that do not close, over the sum of their shapes' contact gaps."""
_UNIT = wp.constant(16384.0)
"""Steps of an entry of G: whole numbers add up to the same in any order."""


@wp.func
def _root(a: wp.mat33) -> wp.mat33:
    """Lower triangle L with L Lᵀ = a, a positive; zero rows of a stay zero."""
    r = wp.mat33()
    for j in range(3):
        d = a[j, j]
        for k in range(j):
            d -= r[j, k] * r[j, k]
        if d > 1.0e-6 * a[j, j]:
            r[j, j] = wp.sqrt(d)
            for i in range(j + 1, 3):
                t = a[i, j]
                for k in range(j):
                    t -= r[i, k] * r[j, k]
                r[i, j] = t / r[j, j]
    return r


@wp.func
def _row(arm: wp.vec3, n: wp.vec3, inv_mass: float, root: wp.mat33) -> wp.spatial_vector:
    """M^-½ Jᵀ of an impulse along n at an arm, in the body's frame."""
    return wp.spatial_vector(wp.sqrt(inv_mass) * n, wp.transpose(root) * wp.cross(arm, n))


@wp.func
def _square(u: wp.spatial_vector, largest: float) -> wp.spatial_matrix:
    if largest <= 0.0:
        return wp.spatial_matrix()
    return wp.outer(u, u) / largest


@wp.func
def _across(n: wp.vec3) -> wp.vec3:
    if n[0] * n[0] > 0.5:
        return wp.normalize(wp.vec3(n[1], -n[0], 0.0))
    return wp.normalize(wp.vec3(0.0, n[2], -n[1]))


@wp.func
def _effect(
    bodies: BodyView, body: int, point: wp.vec3, normal: wp.vec3, rubs: float, turns: float, relaxation: float
) -> wp.spatial_matrix:
    """What a contact at a point of the body's frame adds to its G."""
    n = wp.quat_rotate_inv(wp.transform_get_rotation(bodies.q[body]), normal)
    arm, m, root = point - bodies.com[body], bodies.inv_mass[body], _root(bodies.inv_inertia[body])
    push = _row(arm, n, m, root)
    effect = relaxation * _square(push, wp.dot(push, push))
    if rubs > 0.0:
        t = _across(n)
        a, b = _row(arm, t, m, root), _row(arm, wp.cross(n, t), m, root)
        aa, bb, ab = wp.dot(a, a), wp.dot(b, b), wp.dot(a, b)
        largest = 0.5 * (aa + bb) + wp.sqrt(0.25 * (aa - bb) * (aa - bb) + ab * ab)
        effect += relaxation * FRICTION * (_square(a, largest) + _square(b, largest))
    if turns > 0.0:
        largest = float(0.0)
        for i in range(3):
            row = float(0.0)
            for j in range(3):
                row += wp.abs(bodies.inv_inertia[body][i, j])
            largest = wp.max(largest, row)
        for i in range(3):
            turn = wp.spatial_vector(wp.vec3(), root[i])
            effect += relaxation * FRICTION * _square(turn, largest)
    return effect


@wp.func
def _speed(bodies: BodyView, body: int, point: wp.vec3, normal: wp.vec3) -> float:
    if body < 0:
        return 0.0
    arm = wp.quat_rotate(wp.transform_get_rotation(bodies.q[body]), point - bodies.com[body])
    v = wp.spatial_top(bodies.qd[body]) + wp.cross(wp.spatial_bottom(bodies.qd[body]), arm)
    return wp.dot(normal, v)


@wp.kernel
def _add_effects(
    # inputs:
    contacts: ContactView,
    bodies: BodyView,
    splits_in: wp.array[wp.int32],
    relaxation: float,
    dt: float,
    # outputs:
    entries_out: wp.array2d[wp.int32],
):
    i = wp.tid()
    if i >= contact_count(contacts):
        return
    shape0, shape1 = contacts.shape0[i], contacts.shape1[i]
    body0, body1 = contact_bodies(contacts, i)
    n = contacts.normal[i]
    closing = _speed(bodies, body0, contacts.point0[i], n) - _speed(bodies, body1, contacts.point1[i], n)
    gaps = contacts.shape_gap[shape0] + contacts.shape_gap[shape1]
    if contact_depth(contacts, bodies.q, i) + dt * wp.max(closing, 0.0) < -_TOUCHING_GAP * gaps:
        return
    rubs = contacts.mu[shape0] + contacts.mu[shape1]
    turns = contacts.mu_torsional[shape0] + contacts.mu_torsional[shape1]
    turns += contacts.mu_rolling[shape0] + contacts.mu_rolling[shape1]
    for end in range(2):
        body = wp.where(end == 0, body0, body1)
        if body >= 0 and splits_in[body] == 1:
            point = wp.where(
                end == 0, contacts.point0[i] + contacts.offset0[i], contacts.point1[i] + contacts.offset1[i]
            )
            effect = _effect(bodies, body, point, n, rubs, turns, relaxation)
            for j in range(6):
                for k in range(j, 6):
                    wp.atomic_add(entries_out, 6 * j + k, body, int(wp.rint(_UNIT * effect[j, k])))


@wp.kernel
def _find_shares(entries_io: wp.array2d[wp.int32], shares_out: wp.array[float]):
    body = wp.tid()
    rows, square = wp.spatial_vector(), float(0.0)
    for j in range(6):
        for k in range(j, 6):
            entry = wp.abs(float(entries_io[6 * j + k, body])) / _UNIT
            entries_io[6 * j + k, body] = 0
            rows[j] += entry
            square += entry * entry
            if k > j:
                rows[k] += entry
                square += entry * entry
    largest = float(0.0)
    for j in range(6):
        largest = wp.max(largest, rows[j])
    shares_out[body] = wp.max(1.0, wp.min(largest, wp.sqrt(square)) / _STABLE)


def launch_find_shares(
    contacts: ContactView, bodies: BodyView, splits, entries, shares, *, relaxation: float, dt: float
):
    """Write into how many shares each body is split.

    Args:
        contacts: The contacts.
        bodies: Bodies as contacts found them, with the velocities that they have without contacts.
        splits: 1 for bodies that may be split, shape [bodies].
        entries: Zeros, which they are again afterwards, shape [``ENTRIES``, bodies].
        shares: Out, number of shares, 1 at least, shape [bodies]. Contacts count that touch or nearly do, or may in the
            substep.
        relaxation: Part of its correction that each contact is given in an iteration.
        dt: Substep [s].
    """
    device = shares.device
    inputs = [contacts, bodies, splits, relaxation, dt]
    wp.launch(_add_effects, dim=contacts.shape0.shape[0], inputs=inputs, outputs=[entries], device=device)
    wp.launch(_find_shares, dim=len(shares), outputs=[entries, shares], device=device)


@wp.kernel
def _split_masses(
    # inputs:
    shares_in: wp.array[float],
    inv_mass_in: wp.array[float],
    inv_inertia_in: wp.array[wp.mat33],
    # outputs:
    inv_mass_out: wp.array[float],
    inv_inertia_out: wp.array[wp.mat33],
):
    body = wp.tid()
    inv_mass_out[body] = shares_in[body] * inv_mass_in[body]
    inv_inertia_out[body] = shares_in[body] * inv_inertia_in[body]


def launch_split_masses(shares, whole, split):
    """Write the inverse masses [1/kg] and inertias [1/(kg·m²)] of the share of each body that one contact acts on.

    Args:
        shares: Number of shares of each body, shape [body_count].
        whole: Inverse masses and inertias of the bodies, each of shape [body_count].
        split: Out, those of a share, each of shape [body_count].
    """
    wp.launch(_split_masses, dim=len(shares), inputs=[shares, *whole], outputs=[*split], device=shares.device)
