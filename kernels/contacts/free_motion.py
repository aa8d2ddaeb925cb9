"""Motion of free bodies in a substep: forces and torques change velocities, then velocities change poses.

Contacts are solved between these two changes, at the poses at which they were detected. Both changes together are
symplectic Euler for centers of mass. Angular momentum is conserved to rounding: the new angular velocity is the one
that the body's angular momentum implies at its new orientation. Newton adds an explicit gyroscopic term instead, and
damps rotation.
"""

import warp as wp

from warpmag.kernels.rigid.newton_views import BodyView

wp.set_module_options({"enable_backward": False})


@wp.func
def _apply_tensor(q: wp.quat, tensor: wp.mat33, vector: wp.vec3) -> wp.vec3:
    """Return the product of a tensor in a body's frame, of orientation q, and a vector in the world's frame."""
    return wp.quat_rotate(q, tensor * wp.quat_rotate_inv(q, vector))


@wp.func
def _rotate(q: wp.quat, rotation: wp.vec3) -> wp.quat:
    """Return the orientation q rotated by a rotation vector of the world's frame [rad], to first order."""
    return wp.normalize(q + 0.5 * wp.quat(rotation, 0.0) * q)


@wp.kernel
def _accelerate(
    bodies: BodyView,
    gravity_in: wp.array[wp.vec3],
    free_dof_in: wp.array[wp.int32],
    joint_f_in: wp.array[float],
    kinematic_flag: int,
    dt: float,
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
        rotation, torque = wp.transform_get_rotation(bodies.q[body]), wp.spatial_bottom(force)
        angular = _apply_tensor(rotation, bodies.inv_inertia[body], torque)
        v = wp.spatial_top(velocity) + dt * (inv_mass * wp.spatial_top(force) + gravity)
        qd_out[body] = wp.spatial_vector(v, wp.spatial_bottom(velocity) + dt * angular)


@wp.kernel
def _move(
    bodies: BodyView, kinematic_flag: int, dt: float, q_out: wp.array[wp.transform], qd_out: wp.array[wp.spatial_vector]
):
    body = wp.tid()
    if (bodies.flags[body] & kinematic_flag) != 0:
        return
    pose, velocity = bodies.q[body], bodies.qd[body]
    inertia, inverse, com = bodies.inertia[body], bodies.inv_inertia[body], bodies.com[body]
    v, q = wp.spatial_top(velocity), wp.transform_get_rotation(pose)
    omega = wp.spatial_bottom(velocity)
    rotated = _rotate(q, dt * omega)
    if bodies.inv_mass[body] > 0.0:
        momentum = _apply_tensor(q, inertia, omega)  # L = I ω
        rotated = _rotate(q, dt * _apply_tensor(_rotate(q, 0.5 * dt * omega), inverse, momentum))
        omega = _apply_tensor(rotated, inverse, momentum)  # ω' = I'⁻¹ L
    center = wp.transform_get_translation(pose) + wp.quat_rotate(q, com) + dt * v
    q_out[body] = wp.transform(center - wp.quat_rotate(rotated, com), rotated)
    qd_out[body] = wp.spatial_vector(v, omega)


def launch_accelerate(bodies: BodyView, gravity, kinematic_flag: int, dt: float, q, qd, free_dof=None, joint_f=None):
    """Write the present poses of bodies, and their velocities after forces and torques have acted for ``dt`` [s].

    Args:
        gravity: Acceleration in each world [m/s²], shape [worlds].
        q, qd: Out, poses and velocities, shape [bodies].
        free_dof: First degree of freedom of each body's free joint, -1 without one, shape [bodies]; None to ignore
            ``joint_f``.
        joint_f: Forces of degrees of freedom, about the center of mass for a free joint [N, N·m], shape [dofs].
    """
    inputs = [bodies, gravity, free_dof, joint_f, kinematic_flag, dt]
    wp.launch(_accelerate, dim=len(q), inputs=inputs, outputs=[q, qd], device=q.device)


def launch_move(bodies: BodyView, kinematic_flag: int, dt: float, q=None, qd=None):
    """Move bodies with their velocities for ``dt`` [s], at constant linear and angular momentum.

    Poses and velocities are written to ``q`` and ``qd``, by default those of ``bodies``. Kinematic bodies are skipped.
    """
    inputs = [bodies, kinematic_flag, dt]
    outputs = [bodies.q if q is None else q, bodies.qd if qd is None else qd]
    wp.launch(_move, dim=len(bodies.q), inputs=inputs, outputs=outputs, device=bodies.q.device)


@wp.func
def velocity_change(bodies: BodyView, body: int, linear: wp.vec3, angular: wp.vec3):
    """Return the changes of a body's velocities by an impulse and an angular impulse about its center of mass."""
    if body < 0:
        return wp.vec3(0.0), wp.vec3(0.0)
    rotation = wp.transform_get_rotation(bodies.q[body])
    omega = wp.quat_rotate(rotation, bodies.inv_inertia[body] * wp.quat_rotate_inv(rotation, angular))
    return bodies.inv_mass[body] * linear, omega


@wp.kernel
def _apply_impulses(bodies: BodyView, deltas_io: wp.array[wp.spatial_vector], qd_out: wp.array[wp.spatial_vector]):
    body = wp.tid()
    delta = deltas_io[body]
    deltas_io[body] = wp.spatial_vector()
    v, omega = velocity_change(bodies, body, wp.spatial_top(delta), wp.spatial_bottom(delta))
    qd_out[body] += wp.spatial_vector(v, omega)


def launch_apply_impulses(bodies: BodyView, deltas):
    """Change velocities by impulses and angular impulses about centers of mass [N·s, N·m·s], and set these to zero."""
    wp.launch(_apply_impulses, dim=len(deltas), inputs=[bodies, deltas], outputs=[bodies.qd], device=deltas.device)


@wp.kernel
def _apply_corrections(
    bodies: BodyView,
    deltas_in: wp.array[wp.spatial_vector],
    inv_weights_in: wp.array[float],
    dt: float,
    q_out: wp.array[wp.transform],
    qd_out: wp.array[wp.spatial_vector],
):
    body = wp.tid()
    weight = float(1.0)
    if inv_weights_in and inv_weights_in[body] > 0.0:
        weight = 1.0 / inv_weights_in[body]
    delta, pose, com = deltas_in[body] * weight, bodies.q[body], bodies.com[body]
    v, omega = velocity_change(bodies, body, wp.spatial_top(delta), wp.spatial_bottom(delta))
    q = wp.transform_get_rotation(pose)
    rotated = _rotate(q, dt * omega)
    center = wp.transform_point(pose, com) + dt * v
    q_out[body] = wp.transform(center - wp.quat_rotate(rotated, com), rotated)
    qd_out[body] = bodies.qd[body] + wp.spatial_vector(v, omega)


def launch_apply_corrections(bodies: BodyView, deltas, inv_weights, dt: float, q, qd):
    """Write the poses and velocities after position corrections; as in Newton's kernel, without its rest threshold.

    ``deltas`` are impulses and angular impulses about the centers of mass [N·s, N·m·s], shape [bodies], divided by
    ``inv_weights`` unless None.
    """
    inputs = [bodies, deltas, inv_weights, dt]
    wp.launch(_apply_corrections, dim=len(deltas), inputs=inputs, outputs=[q, qd], device=deltas.device)
