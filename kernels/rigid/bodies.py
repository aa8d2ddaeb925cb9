"""Coupling of rigid bodies and their magnetic moments: positions and moments from bodies, wrenches on bodies.

A magnet's moments are fixed in the frame of its body. Every substep they are transformed to the world frame. The force
F and torque τ on each are added to the wrench of its body about the center of mass c (Newton's convention):

    F_body = Σ F_i,    τ_body = Σ τ_i + (x_i − c) × F_i

Sums have a fixed order and use no atomics, so that runs are repeatable bit by bit. On a GPU a warp sums the moments of
a body.
"""

import warp as wp

from warpmag.kernels.rigid.newton_views import BodyView, body_pose, velocity_at, view_bodies
from warpmag.kernels.shared.reductions import group_sum

wp.set_module_options({"enable_backward": False})

_THREADS = 32  # threads of a GPU that sum the moments of a body, a warp
_sum_group = group_sum(wp.spatial_vectord)


@wp.struct
class BodyMoments:
    """Moments and their bodies, for n moments in r runs of consecutive moments on b bodies."""

    body: wp.array[wp.int32]  # body of each moment, -1 where the magnet is fixed in the world, shape [n]
    permanent: wp.array[wp.bool]  # true for permanent moments, shape [n]
    local_positions: wp.array[wp.vec3]  # position in the body's frame [m], shape [n]
    volumes: wp.array[float]  # volume of each moment [m³], shape [n]
    shape: wp.array[wp.int32]  # shape of each moment, shape [n]
    shape_frames: wp.array[wp.transform]  # frame of each shape in its body, an array of the model, shape [shapes]
    magnetizations: wp.array[wp.vec3]  # permanent magnetization in the shape's frame [A/m], likewise
    body_list: wp.array[wp.int32]  # bodies with moments, shape [b]
    body_world: wp.array[wp.int32]  # world of each of them, shape [b]
    resting: wp.array[wp.int32]  # 1 for worlds where the moments exert no forces, shape [worlds]
    body_run_start: wp.array[wp.int32]  # first run of each body with moments, shape [b + 1]
    runs: wp.array[wp.vec2i]  # first moment of each run, and the index after its last, shape [r]
    kinematic_flag: int  # Newton's flag of bodies that forces do not move


@wp.struct
class ShapeMagnets:
    """Magnetic attributes of a model's shapes: arrays of the model or copies of them, shape [shapes]."""

    kind: wp.array[wp.int32]  # kind of magnet, 0 for other shapes
    # As in ``warpmag.engine.magnets.attributes``.
    saturation: wp.array[float]
    susceptibility: wp.array[float]
    curve: wp.array[wp.int32]
    recoil_permeability: wp.array[float]
    moment_spacing: wp.array[float]
    conductivity: wp.array[float]


@wp.func
def _have_same_magnet(a: ShapeMagnets, b: ShapeMagnets, shape: int) -> bool:
    """Return true if a shape has the same attributes in both structs."""
    if a.kind[shape] != b.kind[shape]:
        return False
    if a.kind[shape] == 0:
        return True
    same = a.saturation[shape] == b.saturation[shape] and a.susceptibility[shape] == b.susceptibility[shape]
    same = same and a.recoil_permeability[shape] == b.recoil_permeability[shape]
    same = same and a.conductivity[shape] == b.conductivity[shape]
    return same and a.curve[shape] == b.curve[shape] and a.moment_spacing[shape] == b.moment_spacing[shape]


@wp.kernel
def _gather_moments(
    body_q_in: wp.array[wp.transform],
    magnets: BodyMoments,
    present: ShapeMagnets,
    initial: ShapeMagnets,
    positions_out: wp.array[wp.vec3],
    moments_out: wp.array[wp.vec3],
    changed_out: wp.array[wp.int32],
):
    i = wp.tid()
    if i < present.kind.shape[0]:
        if not _have_same_magnet(present, initial, i):
            wp.atomic_max(changed_out, 0, i + 1)
    if i >= positions_out.shape[0]:
        return
    frame = body_pose(body_q_in, magnets.body[i])
    positions_out[i] = wp.transform_point(frame, magnets.local_positions[i])
    if magnets.permanent[i]:
        shape = magnets.shape[i]
        moment = magnets.volumes[i] * magnets.magnetizations[shape]
        moments_out[i] = wp.transform_vector(frame, wp.transform_vector(magnets.shape_frames[shape], moment))


def gather_moments(
    launch, body_q, magnets: BodyMoments, present: ShapeMagnets, initial: ShapeMagnets, positions, moments, changed
):
    """Write the positions of all moments and the moments of permanent magnets, in the world's frame.

    If the present attributes of a shape differ from the initial ones, its index plus 1 is written to ``changed`` [1].
    """
    inputs, outputs = [body_q, magnets, present, initial], [positions, moments, changed]
    dim = max(len(positions), len(present.kind))
    launch(_gather_moments, dim, inputs=inputs, outputs=outputs, device=positions.device)


@wp.kernel
def _gather_bias(
    body_q_in: wp.array[wp.transform],
    magnets: BodyMoments,
    moments_in: wp.array[wp.int32],
    factors_in: wp.array[float],
    bias_out: wp.array[wp.vec3],
):
    k = wp.tid()
    i = moments_in[k]
    frame = body_pose(body_q_in, magnets.body[i])
    shape = magnets.shape[i]
    bias = factors_in[k] * magnets.magnetizations[shape]
    bias_out[i] = wp.transform_vector(frame, wp.transform_vector(magnets.shape_frames[shape], bias))


def gather_bias(launch, body_q, magnets: BodyMoments, moments, factors, bias):
    """Write the bias field of ``moments`` with a remanence, ``factors`` times their magnetization [A/m], world
    frame."""
    inputs = [body_q, magnets, moments, factors]
    launch(_gather_bias, len(moments), inputs=inputs, outputs=[bias], device=bias.device)


@wp.kernel
def _gather_rotations(
    body_q_in: wp.array[wp.transform], bodies_in: wp.array[wp.int32], rotations_out: wp.array[wp.quat]
):
    k = wp.tid()
    if bodies_in[k] >= 0:
        rotations_out[k] = wp.transform_get_rotation(body_q_in[bodies_in[k]])


def gather_rotations(launch, body_q, bodies, rotations):
    """Write the rotations of ``bodies``, except for index −1, the world."""
    launch(_gather_rotations, len(bodies), [body_q, bodies], [rotations], device=rotations.device)


@wp.kernel
def _gather_frames(
    body_q_in: wp.array[wp.transform], bodies_in: wp.array[wp.int32], frames_out: wp.array[wp.transform]
):
    k = wp.tid()
    if bodies_in[k] >= 0:
        frames_out[k] = body_q_in[bodies_in[k]]


def gather_frames(launch, body_q, bodies, frames):
    """Write the poses of ``bodies``, except for index −1, the world."""
    launch(_gather_frames, len(bodies), [body_q, bodies], [frames], device=frames.device)


@wp.kernel
def _set_magnetization(
    magnetization_in: wp.array[wp.vec3],
    shapes_in: wp.array[wp.int32],
    shape_body_in: wp.array[wp.int32],
    shape_frames_in: wp.array[wp.transform],
    magnetizations_out: wp.array[wp.vec3],
):
    shape = shapes_in[wp.tid()]
    magnetization = magnetization_in[0]
    if shape_body_in[shape] >= 0:
        magnetization = wp.quat_rotate_inv(wp.transform_get_rotation(shape_frames_in[shape]), magnetization)
    magnetizations_out[shape] = magnetization


def set_magnetization(magnetization, shapes, model, magnets: BodyMoments):
    """Set the permanent magnetization [A/m], shape [1], of shapes, in their body's frame, or their own if static."""
    inputs = [magnetization, shapes, model.shape_body, magnets.shape_frames]
    wp.launch(_set_magnetization, len(shapes), inputs=inputs, outputs=[magnets.magnetizations], device=shapes.device)


@wp.kernel
def _set_external_field(
    field_in: wp.array[wp.vec3], world_in: wp.array[wp.int32], external_field_out: wp.array[wp.vec3]
):
    i = wp.tid()
    external_field_out[i] = field_in[wp.clamp(world_in[i], 0, field_in.shape[0] - 1)]


def set_external_field(field, worlds, external_field):
    """Set the external field [A/m] of each moment to that of its world, -1 for a model without worlds.

    ``field`` may have one entry for all worlds.
    """
    wp.launch(_set_external_field, len(worlds), inputs=[field, worlds], outputs=[external_field], device=worlds.device)


@wp.kernel
def _add_wrenches(
    magnets: BodyMoments,
    body_q_in: wp.array[wp.transform],
    body_com_in: wp.array[wp.vec3],
    body_flags_in: wp.array[wp.int32],
    positions_in: wp.array[wp.vec3],
    forces_in: wp.array[wp.vec3],
    torques_in: wp.array[wp.vec3],
    threads: int,
    body_f_out: wp.array[wp.spatial_vector],
):
    k = wp.tid() // threads
    thread = wp.tid() % threads
    body = magnets.body_list[k]
    if (body_flags_in[body] & magnets.kinematic_flag) != 0 or magnets.resting[magnets.body_world[k]] != 0:
        return
    center = wp.transform_point(body_q_in[body], body_com_in[body])
    partial = wp.spatial_vectord()
    for run in range(magnets.body_run_start[k], magnets.body_run_start[k + 1]):
        for i in range(magnets.runs[run][0] + thread, magnets.runs[run][1], threads):
            force = forces_in[i]
            torque = torques_in[i] + wp.cross(positions_in[i] - center, force)
            for c in range(3):
                partial[c] += wp.float64(force[c])
                partial[c + 3] += wp.float64(torque[c])
    total = _sum_group(partial, threads)
    if thread == 0:
        force = wp.vec3(float(total[0]), float(total[1]), float(total[2]))
        torque = wp.vec3(float(total[3]), float(total[4]), float(total[5]))
        body_f_out[body] = body_f_out[body] + wp.spatial_vector(force, torque)


def add_wrenches(launch, magnets: BodyMoments, model, state, positions, forces, torques):
    """Add force and torque of every moment to its body in ``state``, but for kinematic bodies and resting worlds."""
    device = positions.device
    threads = _THREADS if device.is_cuda else 1
    inputs = [magnets, state.body_q, model.body_com, model.body_flags, positions, forces, torques, threads]
    launch(_add_wrenches, threads * len(magnets.body_list), inputs=inputs, outputs=[state.body_f], device=device)


@wp.kernel
def _gather_motion(
    bodies: BodyView, magnets: BodyMoments, positions_in: wp.array[wp.vec3], motion_out: wp.array2d[float]
):
    i = wp.tid()
    body = magnets.body[i]
    if body < 0:
        return
    velocity = velocity_at(bodies, body, positions_in[i])
    omega = wp.spatial_bottom(bodies.qd[body])
    for c in range(3):
        motion_out[c, i] = velocity[c]
        motion_out[c + 3, i] = omega[c]
    if (bodies.flags[body] & magnets.kinematic_flag) == 0:
        inverse = bodies.inv_inertia[body]
        motion_out[6, i] = bodies.inv_mass[body]
        motion_out[7, i] = wp.max(inverse[0, 0], wp.max(inverse[1, 1], inverse[2, 2]))


def gather_motion(magnets: BodyMoments, model, state, positions, motion):
    """Write the velocity, angular velocity, inverse mass and largest inverse inertia of each moment, by rows.

    Columns of moments that are fixed in the world are skipped. Kinematic bodies keep their inverse mass and inertia of
    0.
    """
    inputs = [view_bodies(model, state), magnets, positions]
    wp.launch(_gather_motion, len(positions), inputs=inputs, outputs=[motion], device=positions.device)


@wp.kernel
def _predict_poses(bodies: BodyView, substeps_in: wp.array[wp.int32], dt: float, body_q_out: wp.array[wp.transform]):
    body = wp.tid()
    seconds = 0.5 * float(substeps_in[0] - 1) * dt
    center = wp.transform_point(bodies.q[body], bodies.com[body]) + seconds * wp.spatial_top(bodies.qd[body])
    rotation = wp.transform_get_rotation(bodies.q[body])
    half_turn = 0.5 * seconds * wp.spatial_bottom(bodies.qd[body])
    rotation = wp.normalize(rotation + wp.quat(half_turn, 0.0) * rotation)
    body_q_out[body] = wp.transform(center - wp.quat_rotate(rotation, bodies.com[body]), rotation)


def predict_poses(bodies: BodyView, substeps, dt: float, body_q):
    """Write the poses at the middle of ``substeps`` [1] substeps of ``dt`` [s], predicted from velocities.

    The middle is halfway between the starts of the first and the last substep.
    """
    inputs = [bodies, substeps, dt]
    wp.launch(_predict_poses, dim=len(body_q), inputs=inputs, outputs=[body_q], device=body_q.device)


@wp.kernel
def _sum_moments(part_start_in: wp.array[wp.int32], moments_in: wp.array[wp.vec3], totals_out: wp.array[wp.vec3]):
    part = wp.tid()
    total = wp.vec3(0.0)
    for i in range(part_start_in[part], part_start_in[part + 1]):
        total += moments_in[i]
    totals_out[part] = total


def sum_moments(part_start, moments, totals):
    """Write the total moment [A·m²] of moments ``part_start[k]`` to ``part_start[k + 1]``, for each k."""
    wp.launch(_sum_moments, dim=len(totals), inputs=[part_start, moments], outputs=[totals], device=totals.device)
