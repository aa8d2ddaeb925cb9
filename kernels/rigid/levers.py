"""The lever arms of XPBD's contacts, put right so that contacts turn nothing by themselves.

XPBD moves bodies with their new velocities and looks at contacts where bodies are then; so does it take the levers of
their impulses. Positions have moved with the velocities, and the momentum of a position that moves along with its own
velocity stays what it was; levers have turned by ω dt. With contact points a and b that coincided before the substep,
opposite impulses p change the angular momentum of two bodies by dt (ω_a × r_a − ω_b × r_b) × p, which is nothing to a
light touch, but turns a heap that strong forces press together, ever faster: at the rate a dt/r for accelerations a.
Balls are spared, for their contacts push through the centre.

With the levers of before the substep the sum is right. So once contacts are solved each body's turn is put right by the
torque impulses − dt (ω × r) × p of its contacts. Impulses come in portions and turn changes along with them, hence ω is
the mean of before and after. Frictional impulses, too, are taken to act at the shape's contact point, short of its
margin.
"""

import warp as wp

wp.set_module_options({"enable_backward": False})


@wp.func
def _turn(
    body: int,
    body_q: wp.array[wp.transform],
    body_qd: wp.array[wp.spatial_vector],
    body_com: wp.array[wp.vec3],
    point: wp.vec3,
    impulse: wp.vec3,
    dt: float,
) -> wp.spatial_vector:
    lever = wp.quat_rotate(wp.transform_get_rotation(body_q[body]), point - body_com[body])
    torque = -dt * wp.cross(wp.cross(wp.spatial_bottom(body_qd[body]), lever), impulse)
    return wp.spatial_vector(wp.vec3(0.0), torque)


@wp.kernel
def _correct_levers(
    # inputs:
    count_in: wp.array[wp.int32],
    point0_in: wp.array[wp.vec3],
    point1_in: wp.array[wp.vec3],
    impulses_in: wp.array[wp.spatial_vector],
    shape0_in: wp.array[wp.int32],
    shape1_in: wp.array[wp.int32],
    shape_body_in: wp.array[wp.int32],
    body_q_in: wp.array[wp.transform],
    body_qd_in: wp.array[wp.spatial_vector],
    body_com_in: wp.array[wp.vec3],
    dt_in: float,
    # outputs:
    deltas_out: wp.array[wp.spatial_vector],
):
    i = wp.tid()
    if i >= wp.min(count_in[0], shape0_in.shape[0]):
        return
    impulse = wp.spatial_top(impulses_in[i])
    if impulse == wp.vec3(0.0):
        return
    body0 = shape_body_in[shape0_in[i]]
    body1 = shape_body_in[shape1_in[i]]
    if body0 >= 0:
        turn = _turn(body0, body_q_in, body_qd_in, body_com_in, point0_in[i], impulse, dt_in)
        wp.atomic_add(deltas_out, body0, turn)
    if body1 >= 0:
        turn = _turn(body1, body_q_in, body_qd_in, body_com_in, point1_in[i], -impulse, dt_in)
        wp.atomic_add(deltas_out, body1, turn)


@wp.kernel
def _take_mean(
    # inputs:
    after_in: wp.array[wp.spatial_vector],
    # in and out:
    mean_io: wp.array[wp.spatial_vector],
):
    body = wp.tid()
    mean_io[body] = 0.5 * (mean_io[body] + after_in[body])


def launch_take_mean(after, mean):
    """Turn velocities of before the contacts, ``mean``, into the means of these and those ``after``, shape [b]."""
    wp.launch(_take_mean, dim=mean.shape[0], inputs=[after], outputs=[mean], device=mean.device)


def launch_correct_levers(contacts, impulses, bodies, dt):
    """Add to ``bodies.deltas`` what puts the turn of each body right.

    Args:
        contacts: Newton's contacts.
        impulses: What each did to its first body, force and torque [N·s, N·m·s], shape [rigid_contact_max].
        bodies: What contacts act on, as :class:`warpmag.kernels.contact_sides.ContactBodies`, with mean velocities.
        dt: Substep [s].
    """
    wp.launch(
        _correct_levers,
        dim=contacts.rigid_contact_max,
        inputs=[
            contacts.rigid_contact_count,
            contacts.rigid_contact_point0,
            contacts.rigid_contact_point1,
            impulses,
            bodies.first,
            bodies.second,
            bodies.shape_body,
            bodies.q,
            bodies.qd,
            bodies.com,
            dt,
        ],
        outputs=[bodies.deltas],
        device=bodies.deltas.device,
    )
