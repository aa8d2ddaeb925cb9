"""Between rigid bodies and their magnetic moments.

A magnet's moments are fixed in the frame of its body. Every substep they are gathered into the world, and the force F
and torque τ on each of them are added to the wrench of its body about the centre of mass c (Newton's convention):

    F_body = Σ F_i,    τ_body = Σ τ_i + (x_i − c) × F_i

Sums run in a fixed order and without atomics, so that a run repeats bit by bit: on a GPU a warp sums the moments of a
body.

| variable | shape | dtype | meaning |
|---|---|---|---|
| positions, moments | [moment_count] | vec3 | [m], [A·m²], world frame |
| local_positions, local_moments | [moment_count] | vec3 | the same in the frame of the body |
| moment_body | [moment_count] | int32 | body, −1 where the magnet is fixed in the world |
| body_list, body_run_start | [n], [n + 1] | int32 | bodies that take forces, first run of moments of each |
| runs | [run_count] | vec2i | first moment of each run, and the one after its last |
"""

import warp as wp

from warpmag.kernels.shared.reductions import group_sum

wp.set_module_options({"enable_backward": False})

_SHARES = 32
"""Threads of a GPU that share out the moments of a body: a warp."""
_sum_group = group_sum(wp.spatial_vectord)


@wp.kernel
def _gather_moments(
    # inputs:
    body_q_in: wp.array[wp.transform],
    moment_body_in: wp.array[wp.int32],
    permanent_in: wp.array[wp.bool],
    local_positions_in: wp.array[wp.vec3],
    local_moments_in: wp.array[wp.vec3],
    # outputs:
    positions_out: wp.array[wp.vec3],
    moments_out: wp.array[wp.vec3],
):
    i = wp.tid()
    frame = wp.transform_identity()
    body = moment_body_in[i]
    if body >= 0:
        frame = body_q_in[body]
    positions_out[i] = wp.transform_point(frame, local_positions_in[i])
    if permanent_in[i]:
        moments_out[i] = wp.transform_vector(frame, local_moments_in[i])


def gather_moments(body_q, moment_body, permanent, local_positions, local_moments, positions, moments):
    """Write the world positions of all moments, and the world moments of the permanent ones."""
    wp.launch(
        _gather_moments,
        dim=len(positions),
        inputs=[body_q, moment_body, permanent, local_positions, local_moments],
        outputs=[positions, moments],
        device=positions.device,
    )


@wp.kernel
def _add_to_bodies(
    # inputs:
    body_q_in: wp.array[wp.transform],
    body_com_in: wp.array[wp.vec3],
    body_flags_in: wp.array[wp.int32],
    kinematic_flag: int,
    body_list_in: wp.array[wp.int32],
    body_run_start_in: wp.array[wp.int32],
    run_in: wp.array[wp.vec2i],
    positions_in: wp.array[wp.vec3],
    forces_in: wp.array[wp.vec3],
    torques_in: wp.array[wp.vec3],
    shares: int,
    # outputs:
    body_f_out: wp.array[wp.spatial_vector],
):
    k = wp.tid() // shares
    share = wp.tid() % shares
    body = body_list_in[k]
    if (body_flags_in[body] & kinematic_flag) != 0:
        return
    center = wp.transform_point(body_q_in[body], body_com_in[body])
    mine = wp.spatial_vectord()
    for run in range(body_run_start_in[k], body_run_start_in[k + 1]):
        for i in range(run_in[run][0] + share, run_in[run][1], shares):
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


def scatter_wrenches(
    body_q, body_com, body_flags, kinematic_flag, body_list, body_run_start, runs, positions, forces, torques, body_f
):
    """Add the force and torque of every moment to the wrench of its body.

    Bodies that carry ``kinematic_flag`` take none.
    """
    shares = _SHARES if body_f.device.is_cuda else 1
    wp.launch(
        _add_to_bodies,
        dim=shares * len(body_list),
        inputs=[
            body_q,
            body_com,
            body_flags,
            kinematic_flag,
            body_list,
            body_run_start,
            runs,
            positions,
            forces,
            torques,
            shares,
        ],
        outputs=[body_f],
        device=body_f.device,
    )


@wp.kernel
def _predict_poses(
    # inputs:
    body_q_in: wp.array[wp.transform],
    body_qd_in: wp.array[wp.spatial_vector],
    body_com_in: wp.array[wp.vec3],
    substeps_in: wp.array[wp.int32],
    dt: float,
    # outputs:
    body_q_out: wp.array[wp.transform],
):
    body = wp.tid()
    seconds = 0.5 * float(substeps_in[0] - 1) * dt
    center = wp.transform_point(body_q_in[body], body_com_in[body]) + seconds * wp.spatial_top(body_qd_in[body])
    rotation = wp.transform_get_rotation(body_q_in[body])
    turn = 0.5 * seconds * wp.spatial_bottom(body_qd_in[body])
    rotation = wp.normalize(rotation + wp.quat(turn, 0.0) * rotation)
    body_q_out[body] = wp.transform(center - wp.quat_rotate(rotation, body_com_in[body]), rotation)


def predict_poses(state, body_com, substeps, dt, body_q):
    """Write poses half-way between those that the next ``substeps`` [1] of ``dt`` each start from, by velocities."""
    wp.launch(
        _predict_poses,
        dim=state.body_q.shape[0],
        inputs=[state.body_q, state.body_qd, body_com, substeps, dt],
        outputs=[body_q],
        device=body_q.device,
    )


@wp.kernel
def _sum_moments(
    # inputs:
    part_start_in: wp.array[wp.int32],
    moments_in: wp.array[wp.vec3],
    # outputs:
    totals_out: wp.array[wp.vec3],
):
    part = wp.tid()
    total = wp.vec3(0.0)
    for i in range(part_start_in[part], part_start_in[part + 1]):
        total += moments_in[i]
    totals_out[part] = total


def sum_moments(part_start, moments, totals):
    """Write the total moment [A·m²] of each run of moments from ``part_start[k]`` to ``part_start[k + 1]``."""
    wp.launch(_sum_moments, dim=len(totals), inputs=[part_start, moments], outputs=[totals], device=totals.device)
