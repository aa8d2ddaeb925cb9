"""Gradients of body wrenches by body poses, from those of moments.

With the cotangents g_F and g_τ of a body's force and torque, F_body = Σ F_i and τ_body = Σ τ_i + (x_i − c) × F_i, the
cotangents of a moment's force and torque are g_F + g_τ × (x_i − c) and g_τ. The lever arm x_i − c has F_i × g_τ.
Warp differentiates positions and permanent moments by the pose, and the frames of coils. A gradient G by a rotation of
a frame is that of Σ_k w_k·e_k by its axes e_k, with w_k = G × e_k / 2.
"""

import warp as wp

from warpmag.kernels.rigid.bodies import BodyMoments
from warpmag.kernels.rigid.sources import SourceShapes


@wp.kernel(module="unique", enable_backward=False)
def _spread_cotangents(
    magnets: BodyMoments,
    body_q_in: wp.array[wp.transform],
    body_com_in: wp.array[wp.vec3],
    body_flags_in: wp.array[wp.int32],
    positions_in: wp.array[wp.vec3],
    forces_in: wp.array[wp.vec3],
    body_f_in: wp.array[wp.spatial_vector],
    force_out: wp.array[wp.vec3],
    torque_out: wp.array[wp.vec3],
    arm_out: wp.array[wp.vec3],
):
    i = wp.tid()
    body = magnets.body[i]
    if body < 0:
        return
    if (body_flags_in[body] & magnets.kinematic_flag) != 0:
        return
    center = wp.transform_point(body_q_in[body], body_com_in[body])
    about = wp.spatial_bottom(body_f_in[body])
    force_out[i] = wp.spatial_top(body_f_in[body]) + wp.cross(about, positions_in[i] - center)
    torque_out[i] = about
    arm_out[i] = wp.cross(forces_in[i], about)


def spread_cotangents(magnets: BodyMoments, model, body_q, positions, forces, body_f) -> tuple[wp.array, ...]:
    """Return the cotangents of forces, torques and lever arms of n moments, shape [n] each.

    ``body_f`` are the cotangents of the bodies' wrenches, forces first. Kinematic bodies have none.
    """
    out = tuple(wp.zeros(len(positions), dtype=wp.vec3, device=positions.device) for _ in range(3))
    inputs = [magnets, body_q, model.body_com, model.body_flags, positions, forces, body_f]
    wp.launch(_spread_cotangents, len(positions), inputs=inputs, outputs=out, device=positions.device)
    return out


@wp.kernel(module="unique", enable_backward=True)
def _multiply_poses(
    magnets: BodyMoments,
    body_q: wp.array[wp.transform],
    body_com: wp.array[wp.vec3],
    by_positions: wp.array[wp.vec3],
    by_moments: wp.array[wp.vec3],
    by_arms: wp.array[wp.vec3],
    products_out: wp.array[float],
):
    i = wp.tid()
    body = magnets.body[i]
    frame = wp.transform_identity()
    product = float(0.0)
    if body >= 0:
        frame = body_q[body]
        x = wp.transform_point(frame, magnets.local_positions[i])
        center = wp.transform_point(frame, body_com[body])
        product = wp.dot(x, by_positions[i]) + wp.dot(x - center, by_arms[i])
    if magnets.permanent[i]:
        shape = magnets.shape[i]
        moment = magnets.volumes[i] * magnets.magnetizations[shape]
        moment = wp.transform_vector(frame, wp.transform_vector(magnets.shape_frames[shape], moment))
        product = product + wp.dot(moment, by_moments[i])
    products_out[i] = product


def add_pose_gradients(magnets: BodyMoments, model, body_q, by_positions, by_moments, by_arms) -> None:
    """Add to the gradients of ``body_q``, and of magnetizations where they have one.

    The arguments are the gradients by positions, by permanent moments and by lever arms of n moments, shape [n] each.
    """
    inputs = [magnets, body_q, model.body_com, by_positions, by_moments, by_arms]
    _differentiate(_multiply_poses, len(by_positions), inputs, body_q.device)


@wp.func
def _rotation_product(outer: wp.transform, inner: wp.transform, rotation: wp.quat, gradient: wp.vec3):
    """Sum of w_k·e_k over the axes e_k of the frame ``outer inner``, which has the ``rotation``."""
    product = float(0.0)
    for k in range(3):
        unit = wp.vec3(float(k == 0), float(k == 1), float(k == 2))
        axis = wp.transform_vector(outer, wp.transform_vector(inner, unit))
        product = product + 0.5 * wp.dot(axis, wp.cross(gradient, wp.quat_rotate(rotation, unit)))
    return product


@wp.kernel(module="unique", enable_backward=True)
def _multiply_rotations(
    bodies: wp.array[wp.int32],
    body_q: wp.array[wp.transform],
    rotations: wp.array[wp.quat],
    by_rotations: wp.array[wp.vec3],
    products_out: wp.array[float],
):
    k = wp.tid()
    product = float(0.0)
    if bodies[k] >= 0:
        product = _rotation_product(body_q[bodies[k]], wp.transform_identity(), rotations[k], by_rotations[k])
    products_out[k] = product


def add_rotation_gradients(bodies, body_q, rotations, by_rotations) -> None:
    """Add to the gradients of ``body_q`` those by small turns of ``bodies`` at their ``rotations``, shape [k] each."""
    _differentiate(_multiply_rotations, len(bodies), [bodies, body_q, rotations, by_rotations], body_q.device)


@wp.kernel(module="unique", enable_backward=False)
def _copy_rotations(frames_in: wp.array[wp.transform], rotations_out: wp.array[wp.quat]):
    rotations_out[wp.tid()] = wp.transform_get_rotation(frames_in[wp.tid()])


def rotations_of(frames: wp.array) -> wp.array:
    """Return the rotations of transforms, quaternions, shape [k]."""
    rotations = wp.empty(len(frames), dtype=wp.quat, device=frames.device)
    wp.launch(_copy_rotations, len(frames), inputs=[frames], outputs=[rotations], device=frames.device)
    return rotations


def _differentiate(kernel, count: int, inputs, device) -> None:
    """Add to the gradients of inputs those of the sum of a kernel's ``count`` products."""
    products = wp.zeros(count, dtype=float, device=device, requires_grad=True)
    with wp.Tape() as tape:
        wp.launch(kernel, count, inputs=inputs, outputs=[products], device=device)
    products.grad.fill_(1.0)
    tape.backward()


@wp.kernel(module="unique", enable_backward=False)
def _spread_to_coils(
    sources: SourceShapes,
    body_q_in: wp.array[wp.transform],
    body_com_in: wp.array[wp.vec3],
    body_flags_in: wp.array[wp.int32],
    body_f_in: wp.array[wp.spatial_vector],
    force_out: wp.array[wp.vec3],
    torque_out: wp.array[wp.vec3],
    center_out: wp.array[wp.vec3],
):
    s = wp.tid()
    body = sources.shape_body[sources.shape[s]]
    force_out[s] = wp.vec3()
    torque_out[s] = wp.vec3()
    if body < 0:
        return
    if (body_flags_in[body] & sources.kinematic_flag) != 0:
        return
    force_out[s] = wp.spatial_top(body_f_in[body])
    torque_out[s] = wp.spatial_bottom(body_f_in[body])
    center_out[s] = wp.transform_point(body_q_in[body], body_com_in[body])


def spread_to_coils(sources: SourceShapes, model, body_q, body_f, force_cotangents, torque_cotangents, centers) -> None:
    """Write the cotangents of the reactions on coils, and the center of mass of each coil's body, shape [coils] each.

    ``body_f`` are the cotangents of the bodies' wrenches. Coils that forces do not move have none.
    """
    inputs = [sources, body_q, model.body_com, model.body_flags, body_f]
    outputs = [force_cotangents, torque_cotangents, centers]
    wp.launch(_spread_to_coils, len(centers), inputs=inputs, outputs=outputs, device=centers.device)


@wp.kernel(module="unique", enable_backward=True)
def _multiply_frames(
    sources: SourceShapes,
    body_q: wp.array[wp.transform],
    body_com: wp.array[wp.vec3],
    frames: wp.array[wp.transform],
    by_sources: wp.array2d[float],
    products_out: wp.array[float],
):
    s = wp.tid()
    shape = sources.shape[s]
    body = sources.shape_body[shape]
    outer = wp.transform_identity()
    product = by_sources[s, 0] * sources.strengths[shape]
    if body >= 0:
        outer = body_q[body]
        center = wp.transform_point(outer, body_com[body])
        product = product + wp.dot(center, wp.vec3(by_sources[s, 7], by_sources[s, 8], by_sources[s, 9]))
    inner = sources.shape_frames[shape]
    origin = wp.transform_point(outer, wp.transform_get_translation(inner))
    product = product + wp.dot(origin, wp.vec3(by_sources[s, 1], by_sources[s, 2], by_sources[s, 3]))
    turn = wp.vec3(by_sources[s, 4], by_sources[s, 5], by_sources[s, 6])
    product = product + _rotation_product(outer, inner, wp.transform_get_rotation(frames[s]), turn)
    products_out[s] = product


def add_coil_gradients(sources: SourceShapes, model, body_q, frames, by_sources) -> None:
    """Add to the gradients of ``body_q``, of the shapes' transforms and of strengths, where they have one.

    ``frames`` are those of the coils in the world, ``by_sources`` as in ``applied.coil_gradients``.
    """
    inputs = [sources, body_q, model.body_com, frames, by_sources]
    _differentiate(_multiply_frames, len(frames), inputs, body_q.device)
