"""The lever arms of XPBD's contact impulses, corrected so that contacts keep angular momentum.

XPBD moves bodies with their new velocities, then takes contacts, and the lever arms of their impulses, at the new
poses. A position that moves with its own velocity keeps its momentum, but lever arms r have turned by ω dt. With
contact points a and b that coincided before the substep, opposite impulses p change the angular momentum of two bodies
by dt (ω_a × r_a − ω_b × r_b) × p. That is negligible in a light touch, but turns a heap that strong forces press
together ever faster: at the rate a dt/r for accelerations a. Balls are not affected: the lever arms of their contacts
point along the normal.

With the lever arms from before the substep the sum is right. So once contacts are solved, the angular impulses
− dt (ω × r) × p of its contacts are added to each body. Iterations apply impulses in portions, and ω changes with them:
the mean of ω before and after is taken. Friction, too, is taken to act at the shape's contact point, short of its
margin.
"""

import warp as wp

from warpmag.kernels.rigid.newton_views import BodyView, ContactView, contact_bodies, contact_count

wp.set_module_options({"enable_backward": False})


@wp.func
def _add_correction(bodies: BodyView, body: int, point: wp.vec3, impulse: wp.vec3, dt: float):
    if body >= 0:
        arm = wp.quat_rotate(wp.transform_get_rotation(bodies.q[body]), point - bodies.com[body])
        torque = -dt * wp.cross(wp.cross(wp.spatial_bottom(bodies.qd[body]), arm), impulse)
        wp.atomic_add(bodies.deltas, body, wp.spatial_vector(wp.vec3(0.0), torque))


@wp.kernel
def _correct_lever_arms(contacts: ContactView, impulses_in: wp.array[wp.spatial_vector], dt: float, bodies: BodyView):
    i = wp.tid()
    if i >= contact_count(contacts):
        return
    impulse = wp.spatial_top(impulses_in[i])
    if impulse == wp.vec3(0.0):
        return
    body0, body1 = contact_bodies(contacts, i)
    _add_correction(bodies, body0, contacts.point0[i], impulse, dt)
    _add_correction(bodies, body1, contacts.point1[i], -impulse, dt)


@wp.kernel
def _average_velocities(after_in: wp.array[wp.spatial_vector], mean_io: wp.array[wp.spatial_vector]):
    body = wp.tid()
    mean_io[body] = 0.5 * (mean_io[body] + after_in[body])


def launch_average_velocities(after, mean):
    """Replace the velocities before the contacts, ``mean``, by the means of these and those ``after``, shape [b]."""
    wp.launch(_average_velocities, dim=mean.shape[0], inputs=[after], outputs=[mean], device=mean.device)


def launch_correct_lever_arms(contacts: ContactView, impulses, dt: float, bodies: BodyView):
    """Add to ``bodies.deltas`` the angular impulses that correct the lever arms.

    Args:
        contacts: The contacts.
        impulses: Impulse of each on its first body and angular impulse [N·s, N·m·s], shape [contact_max].
        dt: Substep [s].
        bodies: The bodies, with mean velocities.
    """
    inputs = [contacts, impulses, dt, bodies]
    wp.launch(_correct_lever_arms, dim=len(impulses), inputs=inputs, device=impulses.device)
