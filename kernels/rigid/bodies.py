"""Between rigid bodies and their magnetic moments.

A magnet's moments are fixed in the frame of its body. Every substep they are transformed to the world frame, and the
force F and torque τ on each are added to the wrench of its body about the centre of mass c (Newton's convention):

    F_body = Σ F_i,    τ_body = Σ τ_i + (x_i − c) × F_i

Sums run in a fixed order and without atomics, so that a run repeats bit by bit: on a GPU a warp sums the moments of a
body.
"""

import warp as wp

from warpmag.kernels.rigid.newton_views import BodyView
from warpmag.kernels.shared.reductions import group_sum

wp.set_module_options({"enable_backward": False})

_SHARES = 32
"""Threads of a GPU that sum the moments of a body: a warp."""
_sum_group = group_sum(wp.spatial_vectord)


@wp.struct
class BodyMoments:
    """Which moments belong to which body, for n moments in r runs on b bodies.

    Attributes:
        body: Body of each moment, -1 where the magnet is fixed in the world, shape [n].
        permanent: Whether the moment is permanent, shape [n].
        local_positions: Position in the body's frame [m], shape [n].
        volumes: Volume of each moment [m³], shape [n].
        shape: Shape that the moment belongs to, shape [n].
        shape_frames, magnetizations: Frame of each shape in its body's, and its permanent magnetization in that frame
            [A/m]: arrays of the model, shape [shapes].
        body_list, body_run_start: Bodies with moments, and the first run of each, shape [b] and [b + 1].
        runs: First moment of each run, and the one after its last, shape [r].
        kinematic_flag: Newton's flag of bodies that forces do not move.
    """

    body: wp.array[wp.int32]
    permanent: wp.array[wp.bool]
    local_positions: wp.array[wp.vec3]
    volumes: wp.array[float]
    shape: wp.array[wp.int32]
    shape_frames: wp.array[wp.transform]
    magnetizations: wp.array[wp.vec3]
    body_list: wp.array[wp.int32]
    body_run_start: wp.array[wp.int32]
    runs: wp.array[wp.vec2i]
    kinematic_flag: int


@wp.struct
class ShapeMagnets:
    """What the shapes of a model say about magnets, arrays of the model or copies of them, shape [shapes].

    Attributes:
        kind: 0 for a shape that is no magnet.
        saturation, susceptibility, curve, recoil_permeability, moment_spacing, conductivity: As in
            ``warpmag.engine.magnets.attributes``.
    """

    kind: wp.array[wp.int32]
    saturation: wp.array[float]
    susceptibility: wp.array[float]
    curve: wp.array[wp.int32]
    recoil_permeability: wp.array[float]
    moment_spacing: wp.array[float]
    conductivity: wp.array[float]


@wp.func
def _alike(now: ShapeMagnets, then: ShapeMagnets, shape: int) -> bool:
    if now.kind[shape] != then.kind[shape]:
        return False
    if now.kind[shape] == 0:
        return True
    same = now.saturation[shape] == then.saturation[shape] and now.susceptibility[shape] == then.susceptibility[shape]
    same = same and now.recoil_permeability[shape] == then.recoil_permeability[shape]
    same = same and now.conductivity[shape] == then.conductivity[shape]
    return same and now.curve[shape] == then.curve[shape] and now.moment_spacing[shape] == then.moment_spacing[shape]


@wp.kernel
def _gather_moments(
    # inputs:
    body_q_in: wp.array[wp.transform],
    magnets: BodyMoments,
    now: ShapeMagnets,
    then: ShapeMagnets,
    # outputs:
    positions_out: wp.array[wp.vec3],
    moments_out: wp.array[wp.vec3],
    changed_out: wp.array[wp.int32],
):
    i = wp.tid()
    if i < now.kind.shape[0]:
        if not _alike(now, then, i):
            wp.atomic_max(changed_out, 0, i + 1)
    if i >= positions_out.shape[0]:
        return
    frame = wp.transform_identity()
    body = magnets.body[i]
    if body >= 0:
        frame = body_q_in[body]
    positions_out[i] = wp.transform_point(frame, magnets.local_positions[i])
    if magnets.permanent[i]:
        shape = magnets.shape[i]
        moment = magnets.volumes[i] * magnets.magnetizations[shape]
        moments_out[i] = wp.transform_vector(frame, wp.transform_vector(magnets.shape_frames[shape], moment))


def gather_moments(body_q, magnets: BodyMoments, now: ShapeMagnets, then: ShapeMagnets, positions, moments, changed):
    """Write the world positions of all moments, and the world moments of the permanent ones.

    ``changed`` [1] becomes a shape, plus one, of which the model says something else now than then, if there is any.
    """
    outputs = [positions, moments, changed]
    dim = max(len(positions), len(now.kind))
    wp.launch(_gather_moments, dim, inputs=[body_q, magnets, now, then], outputs=outputs, device=positions.device)


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
    frame = wp.transform_identity()
    body = magnets.body[i]
    if body >= 0:
        frame = body_q_in[body]
    shape = magnets.shape[i]
    bias = factors_in[k] * magnets.magnetizations[shape]
    bias_out[i] = wp.transform_vector(frame, wp.transform_vector(magnets.shape_frames[shape], bias))


def gather_bias(body_q, magnets: BodyMoments, moments, factors, bias):
    """Write the field that stands for the remanence of some ``moments``, ``factors`` times it [A/m], world frame."""
    inputs = [body_q, magnets, moments, factors]
    wp.launch(_gather_bias, len(moments), inputs=inputs, outputs=[bias], device=bias.device)


@wp.kernel
def _gather_rotations(
    body_q_in: wp.array[wp.transform], bodies_in: wp.array[wp.int32], rotations_out: wp.array[wp.quat]
):
    k = wp.tid()
    if bodies_in[k] >= 0:
        rotations_out[k] = wp.transform_get_rotation(body_q_in[bodies_in[k]])


def gather_rotations(body_q, bodies, rotations):
    """Write the rotations of ``bodies``; that of one fixed in the world, −1, stays."""
    wp.launch(_gather_rotations, len(bodies), [body_q, bodies], [rotations], device=rotations.device)


@wp.kernel
def _gather_frames(
    body_q_in: wp.array[wp.transform], bodies_in: wp.array[wp.int32], frames_out: wp.array[wp.transform]
):
    k = wp.tid()
    if bodies_in[k] >= 0:
        frames_out[k] = body_q_in[bodies_in[k]]


def gather_frames(body_q, bodies, frames):
    """Write where ``bodies`` are; that of one fixed in the world, −1, stays."""
    wp.launch(_gather_frames, len(bodies), [body_q, bodies], [frames], device=frames.device)


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
    """Give shapes a permanent magnetization [A/m], shape [1], in the frame of their body, their own where static."""
    inputs = [magnetization, shapes, model.shape_body, magnets.shape_frames]
    wp.launch(_set_magnetization, len(shapes), inputs=inputs, outputs=[magnets.magnetizations], device=shapes.device)


@wp.kernel
def _set_external_field(
    field_in: wp.array[wp.vec3], world_in: wp.array[wp.int32], external_field_out: wp.array[wp.vec3]
):
    i = wp.tid()
    external_field_out[i] = field_in[wp.min(world_in[i], field_in.shape[0] - 1)]


def set_external_field(field, worlds, external_field):
    """Give each moment the external field [A/m] of its world, or the only one there is."""
    wp.launch(_set_external_field, len(worlds), inputs=[field, worlds], outputs=[external_field], device=worlds.device)


@wp.kernel
def _add_wrenches(
    # inputs:
    magnets: BodyMoments,
    body_q_in: wp.array[wp.transform],
    body_com_in: wp.array[wp.vec3],
    body_flags_in: wp.array[wp.int32],
    positions_in: wp.array[wp.vec3],
    forces_in: wp.array[wp.vec3],
    torques_in: wp.array[wp.vec3],
    shares: int,
    # outputs:
    body_f_out: wp.array[wp.spatial_vector],
):
    k = wp.tid() // shares
    share = wp.tid() % shares
    body = magnets.body_list[k]
    if (body_flags_in[body] & magnets.kinematic_flag) != 0:
        return
    center = wp.transform_point(body_q_in[body], body_com_in[body])
    mine = wp.spatial_vectord()
    for run in range(magnets.body_run_start[k], magnets.body_run_start[k + 1]):
        for i in range(magnets.runs[run][0] + share, magnets.runs[run][1], shares):
            force = forces_in[i]
            torque = torques_in[i] + wp.cross(positions_in[i] - center, force)
            for c in range(3):
                mine[c] += wp.float64(force[c])
                mine[c + 3] += wp.float64(torque[c])
    total = _sum_group(mine, shares)
    if share == 0:
        force = wp.vec3(float(total[0]), float(total[1]), float(total[2]))
        torque = wp.vec3(float(total[3]), float(total[4]), float(total[5]))
        body_f_out[body] = body_f_out[body] + wp.spatial_vector(force, torque)


def add_wrenches(magnets: BodyMoments, model, state, positions, forces, torques):
    """Add the force and torque of every moment to the wrench of its body in ``state``, unless that is kinematic."""
    device = positions.device
    shares = _SHARES if device.is_cuda else 1
    inputs = [magnets, state.body_q, model.body_com, model.body_flags, positions, forces, torques, shares]
    wp.launch(_add_wrenches, shares * len(magnets.body_list), inputs=inputs, outputs=[state.body_f], device=device)


@wp.kernel
def _predict_poses(bodies: BodyView, substeps_in: wp.array[wp.int32], dt: float, body_q_out: wp.array[wp.transform]):
    body = wp.tid()
    seconds = 0.5 * float(substeps_in[0] - 1) * dt
    center = wp.transform_point(bodies.q[body], bodies.com[body]) + seconds * wp.spatial_top(bodies.qd[body])
    rotation = wp.transform_get_rotation(bodies.q[body])
    turn = 0.5 * seconds * wp.spatial_bottom(bodies.qd[body])
    rotation = wp.normalize(rotation + wp.quat(turn, 0.0) * rotation)
    body_q_out[body] = wp.transform(center - wp.quat_rotate(rotation, bodies.com[body]), rotation)


def predict_poses(bodies: BodyView, substeps, dt: float, body_q):
    """Write the poses, by velocities, half-way between those that ``substeps`` [1] of ``dt`` each start from."""
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
    """Write the total moment [A·m²] of each run of moments from ``part_start[k]`` to ``part_start[k + 1]``."""
    wp.launch(_sum_moments, dim=len(totals), inputs=[part_start, moments], outputs=[totals], device=totals.device)
