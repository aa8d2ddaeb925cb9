"""How bodies move in a substep: forces and torques change velocities, then velocities change poses.

Contacts are solved between the two, so that they see poses as they were found at. Both halves together are symplectic
Euler for centres of mass. Angular momentum is kept to rounding: a body that turns gets the angular velocity that its
angular momentum has at its new orientation, in place of Newton's explicit gyroscopic term, and no spin is damped.
"""

import warp as wp

from warpmag.kernels.rigid.newton_views import BodyView

wp.set_module_options({"enable_backward": False})


@wp.func
def _about(q: wp.quat, tensor: wp.mat33, vector: wp.vec3) -> wp.vec3:
    """Apply a tensor of the frame of a body to a vector of the world's."""
    return wp.quat_rotate(q, tensor * wp.quat_rotate_inv(q, vector))


@wp.func
def _turn(q: wp.quat, rotation: wp.vec3) -> wp.quat:
    """Turn an orientation by a rotation vector of the world's frame [rad]."""
    return wp.normalize(q + 0.5 * wp.quat(rotation, 0.0) * q)


@wp.kernel
def _accelerate(
    # inputs:
    bodies: BodyView,
    gravity_in: wp.array[wp.vec3],
    free_dof_in: wp.array[wp.int32],
    joint_f_in: wp.array[float],
    kinematic_flag: int,
    dt: float,
    # outputs:
    q_out: wp.array[wp.transform],
    qd_out: wp.array[wp.spatial_vector],
):
    body = wp.tid()
    q_out[body] = bodies.q[body]
    qd_out[body] = bodies.qd[body]
    if (bodies.flags[body] & kinematic_flag) == 0:
        velocity, force, inv_mass = bodies.qd[body], bodies.f[body], bodies.inv_mass[body]
        if free_dof_in and free_dof_in[body] >= 0:
            for k in range(6):
                force[k] += joint_f_in[free_dof_in[body] + k]
        gravity = gravity_in[bodies.world[body]] * wp.nonzero(inv_mass)
        gain = _about(wp.transform_get_rotation(bodies.q[body]), bodies.inv_inertia[body], wp.spatial_bottom(force))
        v = wp.spatial_top(velocity) + dt * (inv_mass * wp.spatial_top(force) + gravity)
        qd_out[body] = wp.spatial_vector(v, wp.spatial_bottom(velocity) + dt * gain)


@wp.kernel
def _move(
    # inputs:
    bodies: BodyView,
    kinematic_flag: int,
    dt: float,
    # outputs:
    q_out: wp.array[wp.transform],
    qd_out: wp.array[wp.spatial_vector],
):
    body = wp.tid()
    if (bodies.flags[body] & kinematic_flag) != 0:
        return
    pose, velocity = bodies.q[body], bodies.qd[body]
    inertia, inverse, com = bodies.inertia[body], bodies.inv_inertia[body], bodies.com[body]
    v, q = wp.spatial_top(velocity), wp.transform_get_rotation(pose)
    spin = wp.spatial_bottom(velocity)
    turned = _turn(q, dt * spin)
    if bodies.inv_mass[body] > 0.0:
        momentum = _about(q, inertia, spin)
        turned = _turn(q, dt * _about(_turn(q, 0.5 * dt * spin), inverse, momentum))
        spin = _about(turned, inverse, momentum)
    center = wp.transform_get_translation(pose) + wp.quat_rotate(q, com) + dt * v
    q_out[body] = wp.transform(center - wp.quat_rotate(turned, com), turned)
    qd_out[body] = wp.spatial_vector(v, spin)


def launch_accelerate(bodies: BodyView, gravity, kinematic_flag: int, dt: float, q, qd, free_dof=None, joint_f=None):
    """Write the poses of bodies as they are and the velocities that forces and torques lend them in ``dt`` [s].

    Args:
        bodies: The bodies.
        gravity: Acceleration in each world [m/s²], shape [worlds].
        kinematic_flag: Newton's flag of kinematic bodies.
        dt: Length of the substep [s].
        q, qd: Out, poses and velocities, shape [bodies].
        free_dof: First degree of freedom of each body's free joint, -1 without, shape [bodies]; None if forces of
            joints are none, or in the bodies' own.
        joint_f: Forces of degrees of freedom, those of a free joint about the centre of mass [N, N·m], shape [dofs].
    """
    inputs = [bodies, gravity, free_dof, joint_f, kinematic_flag, dt]
    wp.launch(_accelerate, dim=len(q), inputs=inputs, outputs=[q, qd], device=q.device)


def launch_move(bodies: BodyView, kinematic_flag: int, dt: float, q=None, qd=None):
    """Move bodies with their velocities for ``dt`` [s]; their spins change as they turn, their momenta do not.

    Poses and velocities are written into ``q`` and ``qd``, if there are any, where kinematic bodies stay as they are.
    """
    inputs = [bodies, kinematic_flag, dt]
    outputs = [bodies.q if q is None else q, bodies.qd if qd is None else qd]
    wp.launch(_move, dim=len(bodies.q), inputs=inputs, outputs=outputs, device=bodies.q.device)
