"""Contacts taken apart into their two sides, each with a copy of its body, so that sums over contacts have an order.

XPBD adds up what the contacts of a body do to it with float atomics, in the order in which threads happen to run. With
a copy of the body for every side of every contact, nothing is added there: each side gets what its contact does, and
:func:`launch_sum_sides` adds the sides of each body in the order of the contacts.

Side 2c and 2c + 1 are those of contact c. Sides of what is fixed in the world, and of contacts that there are not,
belong to no body. Those of a body that forces do not move are not added up: there may be very many.
"""

from dataclasses import dataclass

import numpy as np
import warp as wp

wp.set_module_options({"enable_backward": False})


@dataclass(frozen=True)
class ContactBodies:
    """What contacts act on: b bodies, or copies of them.

    Attributes:
        q, qd, com, inv_mass, inv_inertia, flags: As those of Newton's model and state, shape [b].
        first, second: Shapes of each contact, shape [rigid_contact_max].
        shape_body: Body of each shape, shape [shapes].
        mu, mu_torsional, mu_rolling: Friction of each shape, shape [shapes].
        deltas: Impulses and impulses of torque that contacts add up [N·s, N·m·s], shape [b].
    """

    q: wp.array
    qd: wp.array
    com: wp.array
    inv_mass: wp.array
    inv_inertia: wp.array
    flags: wp.array
    first: wp.array
    second: wp.array
    shape_body: wp.array
    mu: wp.array
    mu_torsional: wp.array
    mu_rolling: wp.array
    deltas: wp.array


@dataclass(frozen=True)
class ContactSides:
    """Buffers for c contacts and b bodies.

    Attributes:
        first, second: The sides of each contact, shape [c].
        side_body: Each side's copy of a body: itself, or -1 for none, shape [2c].
        body: Body of each side, as is, shape [2c].
        q, qd, com, inv_mass, inv_inertia, flags: Copies of the body, shape [2c].
        mu, mu_torsional, mu_rolling: Friction of the side's shape, shape [2c].
        deltas: What the contact does to the side, shape [2c].
        keys, order: Sides sorted by the body they are added up for, b if for none: bodies and sides, shape [4c], of
            which the second half is scratch.
        start: First of each body's sides in ``order``, shape [b + 1].
        key_bits: Bits that tell bodies apart.
    """

    first: wp.array
    second: wp.array
    side_body: wp.array
    body: wp.array
    q: wp.array
    qd: wp.array
    com: wp.array
    inv_mass: wp.array
    inv_inertia: wp.array
    flags: wp.array
    mu: wp.array
    mu_torsional: wp.array
    mu_rolling: wp.array
    deltas: wp.array
    keys: wp.array
    order: wp.array
    start: wp.array
    key_bits: int


def allocate(contact_max: int, body_count: int, device) -> ContactSides:
    """Allocate the buffers."""
    n = 2 * contact_max

    def zeros(count, dtype):
        return wp.zeros(count, dtype=dtype, device=device)

    def put(values):
        return wp.array(values.astype(np.int32), dtype=wp.int32, device=device)

    return ContactSides(
        first=put(np.arange(0, n, 2)),
        second=put(np.arange(1, n, 2)),
        **{name: zeros(n, wp.int32) for name in ("side_body", "body", "flags")},
        q=zeros(n, wp.transform),
        com=zeros(n, wp.vec3),
        inv_inertia=zeros(n, wp.mat33),
        **{name: zeros(n, wp.spatial_vector) for name in ("qd", "deltas")},
        **{name: zeros(n, wp.float32) for name in ("inv_mass", "mu", "mu_torsional", "mu_rolling")},
        **{name: zeros(2 * n, wp.int32) for name in ("keys", "order")},
        start=zeros(body_count + 1, wp.int32),
        key_bits=body_count.bit_length(),
    )


@wp.kernel
def _split(
    # inputs:
    contact_count_in: wp.array[wp.int32],
    shape0_in: wp.array[wp.int32],
    shape1_in: wp.array[wp.int32],
    shape_body_in: wp.array[wp.int32],
    shape_mu_in: wp.array[float],
    shape_mu_torsional_in: wp.array[float],
    shape_mu_rolling_in: wp.array[float],
    body_com_in: wp.array[wp.vec3],
    body_inv_mass_in: wp.array[float],
    body_inv_inertia_in: wp.array[wp.mat33],
    body_flags_in: wp.array[wp.int32],
    # outputs:
    side_body_out: wp.array[wp.int32],
    body_out: wp.array[wp.int32],
    com_out: wp.array[wp.vec3],
    inv_mass_out: wp.array[float],
    inv_inertia_out: wp.array[wp.mat33],
    flags_out: wp.array[wp.int32],
    mu_out: wp.array[float],
    mu_torsional_out: wp.array[float],
    mu_rolling_out: wp.array[float],
    keys_out: wp.array[wp.int32],
    order_out: wp.array[wp.int32],
):
    side = wp.tid()
    contact = side // 2
    order_out[side] = side
    keys_out[side] = body_com_in.shape[0]
    body_out[side] = -1
    side_body_out[side] = -1
    if contact >= wp.min(contact_count_in[0], shape0_in.shape[0]):
        return
    shape = shape0_in[contact]
    if side % 2 == 1:
        shape = shape1_in[contact]
    mu_out[side] = shape_mu_in[shape]
    mu_torsional_out[side] = shape_mu_torsional_in[shape]
    mu_rolling_out[side] = shape_mu_rolling_in[shape]
    body = shape_body_in[shape]
    if body >= 0:
        if body_inv_mass_in[body] > 0.0:
            keys_out[side] = body
        body_out[side] = body
        side_body_out[side] = side
        com_out[side] = body_com_in[body]
        inv_mass_out[side] = body_inv_mass_in[body]
        inv_inertia_out[side] = body_inv_inertia_in[body]
        flags_out[side] = body_flags_in[body]


@wp.kernel
def _find_starts(
    # inputs:
    sorted_keys_in: wp.array[wp.int32],
    # outputs:
    start_out: wp.array[wp.int32],
):
    body = wp.tid()
    start_out[body] = wp.lower_bound(sorted_keys_in, body)


def launch_split_contacts(model, contacts, inv_mass, inv_inertia, sides: ContactSides):
    """Give each side of the contacts a copy of what does not change while they are solved.

    Args:
        model: Newton's model.
        contacts: Newton's contacts.
        inv_mass: Inverse mass of each body [1/kg], zero for one that forces do not move.
        inv_inertia: The same of its inertia [1/(kg·m²)].
        sides: Out.
    """
    n, device = sides.body.shape[0], sides.body.device
    wp.launch(
        _split,
        dim=n,
        inputs=[
            contacts.rigid_contact_count,
            contacts.rigid_contact_shape0,
            contacts.rigid_contact_shape1,
            model.shape_body,
            model.shape_material_mu,
            model.shape_material_mu_torsional,
            model.shape_material_mu_rolling,
            model.body_com,
            inv_mass,
            inv_inertia,
            model.body_flags,
        ],
        outputs=[
            sides.side_body,
            sides.body,
            sides.com,
            sides.inv_mass,
            sides.inv_inertia,
            sides.flags,
            sides.mu,
            sides.mu_torsional,
            sides.mu_rolling,
            sides.keys,
            sides.order,
        ],
        device=device,
    )
    wp.utils.radix_sort_pairs(sides.keys, sides.order, n, end_bit=sides.key_bits)  # stable: sides stay in order
    wp.launch(_find_starts, dim=sides.start.shape[0], inputs=[sides.keys[:n]], outputs=[sides.start], device=device)


@wp.kernel
def _copy_motion(
    # inputs:
    body_in: wp.array[wp.int32],
    body_q_in: wp.array[wp.transform],
    body_qd_in: wp.array[wp.spatial_vector],
    # outputs:
    q_out: wp.array[wp.transform],
    qd_out: wp.array[wp.spatial_vector],
    deltas_out: wp.array[wp.spatial_vector],
):
    side = wp.tid()
    body = body_in[side]
    if body >= 0:
        q_out[side] = body_q_in[body]
        qd_out[side] = body_qd_in[body]
        deltas_out[side] = wp.spatial_vector()


def launch_copy_motion(body_q, body_qd, sides: ContactSides):
    """Bring the copies to the present poses and velocities, and clear what was done to them."""
    wp.launch(
        _copy_motion,
        dim=sides.body.shape[0],
        inputs=[sides.body, body_q, body_qd],
        outputs=[sides.q, sides.qd, sides.deltas],
        device=sides.body.device,
    )


@wp.kernel
def _sum_sides(
    # inputs:
    start_in: wp.array[wp.int32],
    order_in: wp.array[wp.int32],
    side_deltas_in: wp.array[wp.spatial_vector],
    # outputs:
    deltas_out: wp.array[wp.spatial_vector],
):
    body = wp.tid()
    total = wp.spatial_vector()
    for k in range(start_in[body], start_in[body + 1]):
        total += side_deltas_in[order_in[k]]
    deltas_out[body] = total


def launch_sum_sides(sides: ContactSides, deltas):
    """Add up what was done to each body, in the order of its contacts, into ``deltas`` [b]."""
    wp.launch(
        _sum_sides,
        dim=deltas.shape[0],
        inputs=[sides.start, sides.order, sides.deltas],
        outputs=[deltas],
        device=deltas.device,
    )
