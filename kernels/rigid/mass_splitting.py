"""Masses split among contacts, for bodies that many contacts push the same way.

XPBD relaxes all contacts at once and adds up their corrections. Those on a ball point in different directions, but the
corners of boxes face to face all make good the same gap: n of them overshoot it 0.35 n times (0.35 is the relaxation),
and from some ten on each iteration is worse than the one before. A contact that sees only its share of each body's mass
makes good its share of the gap (Tonge, Benevolenski and Voroshilov 2012, "Mass Splitting for Jitter-Free Parallel Rigid
Body Simulation"). Its impulses on both bodies stay opposite, so that momentum is kept, which dividing each body's sum
by its number of contacts would not do.

| variable | shape | meaning |
|---|---|---|
| splits | [body_count] | 1 for bodies whose mass is split |
| counts | [body_count] | contacts of each of them that touch or nearly do |
| inv_mass, inv_inertia | [body_count] | as contacts see them [1/kg, 1/(kg·m²)] |
"""

import warp as wp

wp.set_module_options({"enable_backward": False})

UNSPLIT = wp.constant(4)
"""Contacts that share a body without splitting it."""
NEAR = wp.constant(0.1)
"""Distance up to which contacts count, over the sum of their shapes' contact gaps."""


@wp.kernel
def _count_contacts(
    # inputs:
    count_in: wp.array[wp.int32],
    shape0_in: wp.array[wp.int32],
    shape1_in: wp.array[wp.int32],
    point0_in: wp.array[wp.vec3],
    point1_in: wp.array[wp.vec3],
    margin0_in: wp.array[float],
    margin1_in: wp.array[float],
    normal_in: wp.array[wp.vec3],
    shape_body_in: wp.array[wp.int32],
    shape_gap_in: wp.array[float],
    body_q_in: wp.array[wp.transform],
    splits_in: wp.array[wp.int32],
    # outputs:
    counts_out: wp.array[wp.int32],
):
    i = wp.tid()
    if i >= wp.min(count_in[0], shape0_in.shape[0]):
        return
    body0 = shape_body_in[shape0_in[i]]
    body1 = shape_body_in[shape1_in[i]]
    point0 = point0_in[i]
    point1 = point1_in[i]
    if body0 >= 0:
        point0 = wp.transform_point(body_q_in[body0], point0)
    if body1 >= 0:
        point1 = wp.transform_point(body_q_in[body1], point1)
    distance = wp.dot(normal_in[i], point1 - point0) - margin0_in[i] - margin1_in[i]
    if distance > NEAR * (shape_gap_in[shape0_in[i]] + shape_gap_in[shape1_in[i]]):
        return
    if body0 >= 0 and splits_in[body0] == 1:
        wp.atomic_add(counts_out, body0, 1)
    if body1 >= 0 and splits_in[body1] == 1:
        wp.atomic_add(counts_out, body1, 1)


@wp.kernel
def _split_masses(
    # inputs:
    counts_in: wp.array[wp.int32],
    inv_mass_in: wp.array[float],
    inv_inertia_in: wp.array[wp.mat33],
    # outputs:
    inv_mass_out: wp.array[float],
    inv_inertia_out: wp.array[wp.mat33],
):
    body = wp.tid()
    shares = wp.max(1.0, float(counts_in[body]) / float(UNSPLIT))
    inv_mass_out[body] = shares * inv_mass_in[body]
    inv_inertia_out[body] = shares * inv_inertia_in[body]


def launch_split_masses(
    model, state, contacts, splits, inv_mass, inv_inertia, counts, split_inv_mass, split_inv_inertia
):
    """Write the inverse masses and inertias that contacts see.

    Args:
        model: Newton's model.
        state: State that ``contacts`` were found at.
        contacts: Its contacts.
        splits: Which bodies may be split.
        inv_mass: Inverse masses [1/kg].
        inv_inertia: Inverse inertias [1/(kg·m²)].
        counts: Out, contacts counted.
        split_inv_mass: Out, inverse masses of a contact's share.
        split_inv_inertia: Out, inverse inertias of a contact's share.
    """
    counts.zero_()
    wp.launch(
        _count_contacts,
        dim=contacts.rigid_contact_max,
        inputs=[
            contacts.rigid_contact_count,
            contacts.rigid_contact_shape0,
            contacts.rigid_contact_shape1,
            contacts.rigid_contact_point0,
            contacts.rigid_contact_point1,
            contacts.rigid_contact_margin0,
            contacts.rigid_contact_margin1,
            contacts.rigid_contact_normal,
            model.shape_body,
            model.shape_gap,
            state.body_q,
            splits,
        ],
        outputs=[counts],
        device=counts.device,
    )
    wp.launch(
        _split_masses,
        dim=model.body_count,
        inputs=[counts, inv_mass, inv_inertia],
        outputs=[split_inv_mass, split_inv_inertia],
        device=counts.device,
    )
