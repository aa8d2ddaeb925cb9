"""Sums over the contacts of each body in the order of the contacts, so that runs on a GPU repeat bit by bit.

XPBD adds up contacts' impulses on a body with float atomics, in the order in which threads happen to run. Here every
contact has two sides, each with its own copy of a body: XPBD's kernel then writes the impulse of each side by itself,
and :func:`launch_sum_sides` adds up the sides of each body.

Contact c has the sides 2c and 2c + 1. Sides of the world, and of contacts beyond the number found, have no body. Sides
of bodies that forces do not move are not added up: there may be very many.
"""

from dataclasses import dataclass

import numpy as np
import warp as wp

from warpmag.kernels.rigid.newton_views import BodyView, ContactView, contact_count

wp.set_module_options({"enable_backward": False})


@dataclass(frozen=True)
class ContactSides:
    """Buffers for c contacts and b bodies.

    Attributes:
        contacts: The contacts, each between two shapes of its own: shapes and their bodies are the sides, shape [2c].
        bodies: Each side's copy of its body, shape [2c].
        body: Body of each side, or -1, shape [2c].
        keys, order: Bodies and sides, sorted by the body to add up for, b if none, shape [4c]; the second half is
            scratch.
        start: First of each body's sides in ``order``, shape [b + 1].
        key_bits: Bits of the largest key.
    """

    contacts: ContactView
    bodies: BodyView
    body: wp.array
    keys: wp.array
    order: wp.array
    start: wp.array
    key_bits: int


def allocate(contact_max: int, body_count: int, device) -> ContactSides:
    """Allocate the buffers."""
    n = 2 * contact_max

    def zeros(count, dtype):
        return wp.zeros(count, dtype=dtype, device=device)

    contacts, bodies = ContactView(), BodyView()
    sides = np.arange(n, dtype=np.int32).reshape(-1, 2)
    contacts.shape0, contacts.shape1 = (wp.array(side.copy(), dtype=wp.int32, device=device) for side in sides.T)
    contacts.shape_body = zeros(n, wp.int32)
    contacts.mu, contacts.mu_torsional, contacts.mu_rolling = (zeros(n, wp.float32) for _ in range(3))
    bodies.q, bodies.com, bodies.flags = zeros(n, wp.transform), zeros(n, wp.vec3), zeros(n, wp.int32)
    bodies.qd, bodies.deltas = zeros(n, wp.spatial_vector), zeros(n, wp.spatial_vector)
    bodies.inv_mass, bodies.inv_inertia = zeros(n, wp.float32), zeros(n, wp.mat33)
    return ContactSides(
        contacts,
        bodies,
        body=zeros(n, wp.int32),
        keys=zeros(2 * n, wp.int32),
        order=zeros(2 * n, wp.int32),
        start=zeros(body_count + 1, wp.int32),
        key_bits=body_count.bit_length(),
    )


@wp.kernel
def _split(
    # inputs:
    contacts: ContactView,
    bodies: BodyView,
    # outputs:
    side_contacts: ContactView,
    side_bodies: BodyView,
    body_out: wp.array[wp.int32],
    keys_out: wp.array[wp.int32],
    order_out: wp.array[wp.int32],
):
    side = wp.tid()
    contact = side // 2
    order_out[side] = side
    keys_out[side] = bodies.com.shape[0]
    body_out[side] = -1
    side_contacts.shape_body[side] = -1
    if contact >= contact_count(contacts):
        return
    shape = contacts.shape0[contact]
    if side % 2 == 1:
        shape = contacts.shape1[contact]
    side_contacts.mu[side] = contacts.mu[shape]
    side_contacts.mu_torsional[side] = contacts.mu_torsional[shape]
    side_contacts.mu_rolling[side] = contacts.mu_rolling[shape]
    body = contacts.shape_body[shape]
    if body >= 0:
        if bodies.inv_mass[body] > 0.0:
            keys_out[side] = body
        body_out[side] = body
        side_contacts.shape_body[side] = side
        side_bodies.com[side] = bodies.com[body]
        side_bodies.inv_mass[side] = bodies.inv_mass[body]
        side_bodies.inv_inertia[side] = bodies.inv_inertia[body]
        side_bodies.flags[side] = bodies.flags[body]


@wp.kernel
def _find_starts(sorted_keys_in: wp.array[wp.int32], start_out: wp.array[wp.int32]):
    body = wp.tid()
    start_out[body] = wp.lower_bound(sorted_keys_in, body)


def launch_split_contacts(contacts: ContactView, bodies: BodyView, sides: ContactSides):
    """Copy to each side what does not change while contacts are solved, and sort the sides by body."""
    n, device = len(sides.body), sides.body.device
    sides.contacts.count = contacts.count
    sides.contacts.point0, sides.contacts.point1 = contacts.point0, contacts.point1
    outputs = [sides.contacts, sides.bodies, sides.body, sides.keys, sides.order]
    wp.launch(_split, dim=n, inputs=[contacts, bodies], outputs=outputs, device=device)
    wp.utils.radix_sort_pairs(sides.keys, sides.order, n, end_bit=sides.key_bits)  # stable: sides stay in order
    wp.launch(_find_starts, dim=len(sides.start), inputs=[sides.keys[:n]], outputs=[sides.start], device=device)


@wp.kernel
def _copy_motion(
    body_in: wp.array[wp.int32], q_in: wp.array[wp.transform], qd_in: wp.array[wp.spatial_vector], sides: BodyView
):
    side = wp.tid()
    body = body_in[side]
    if body >= 0:
        sides.q[side] = q_in[body]
        sides.qd[side] = qd_in[body]
        sides.deltas[side] = wp.spatial_vector()


def launch_copy_motion(q, qd, sides: ContactSides):
    """Copy the bodies' poses and velocities to the sides, and clear their impulses."""
    inputs = [sides.body, q, qd]
    wp.launch(_copy_motion, dim=len(sides.body), inputs=inputs, outputs=[sides.bodies], device=sides.body.device)


@wp.kernel
def _sum_sides(
    start_in: wp.array[wp.int32], order_in: wp.array[wp.int32], sides: BodyView, deltas_out: wp.array[wp.spatial_vector]
):
    body = wp.tid()
    total = wp.spatial_vector()
    for k in range(start_in[body], start_in[body + 1]):
        total += sides.deltas[order_in[k]]
    deltas_out[body] = total


def launch_sum_sides(sides: ContactSides, deltas):
    """Add up the impulses on each body, in the order of its contacts, into ``deltas`` [b]."""
    inputs = [sides.start, sides.order, sides.bodies]
    wp.launch(_sum_sides, dim=len(deltas), inputs=inputs, outputs=[deltas], device=deltas.device)
