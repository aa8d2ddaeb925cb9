"""Between rigid bodies and their magnetic moments.

A magnet's moments are fixed in the frame of its body. Every substep they are gathered into the world, and the force F
and torque τ on each of them are added to the wrench of its body about the centre of mass c (Newton's convention):

    F_body = Σ F_i,    τ_body = Σ τ_i + (x_i − c) × F_i

Sums run in a fixed order and without atomics, so that a run repeats bit by bit: the moments of a body are cut into
chunks of neighbours, one thread sums a chunk, and one thread a body's chunks.

| variable | shape | dtype | meaning |
|---|---|---|---|
| positions, moments | [moment_count] | vec3 | [m], [A·m²], world frame |
| local_positions, local_moments | [moment_count] | vec3 | the same in the frame of the body |
| moment_body | [moment_count] | int32 | body, −1 where the magnet is fixed in the world |
| chunk_range | [chunk_count] | vec2i | first moment of each chunk, and the one after its last; sorted by body |
| chunk_body | [chunk_count] | int32 | the chunk's body |
| body_list, body_chunk_start | [n], [n + 1] | int32 | bodies that take forces, first chunk of each |
"""

import warp as wp

wp.set_module_options({"enable_backward": False})


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
def _sum_chunks(
    # inputs:
    body_q_in: wp.array[wp.transform],
    body_com_in: wp.array[wp.vec3],
    chunk_range_in: wp.array[wp.vec2i],
    chunk_body_in: wp.array[wp.int32],
    positions_in: wp.array[wp.vec3],
    forces_in: wp.array[wp.vec3],
    torques_in: wp.array[wp.vec3],
    # outputs:
    wrenches_out: wp.array[wp.spatial_vector],
):
    chunk = wp.tid()
    body = chunk_body_in[chunk]
    force = wp.vec3(0.0)
    torque = wp.vec3(0.0)
    if body >= 0:
        center = wp.transform_point(body_q_in[body], body_com_in[body])
        for i in range(chunk_range_in[chunk][0], chunk_range_in[chunk][1]):
            force += forces_in[i]
            torque += torques_in[i] + wp.cross(positions_in[i] - center, forces_in[i])
    wrenches_out[chunk] = wp.spatial_vector(force, torque)


@wp.kernel
def _add_to_bodies(
    # inputs:
    body_list_in: wp.array[wp.int32],
    body_chunk_start_in: wp.array[wp.int32],
    body_flags_in: wp.array[wp.int32],
    kinematic_flag: int,
    wrenches_in: wp.array[wp.spatial_vector],
    # outputs:
    body_f_out: wp.array[wp.spatial_vector],
):
    k = wp.tid()
    body = body_list_in[k]
    if (body_flags_in[body] & kinematic_flag) != 0:
        return
    wrench = wp.spatial_vector()
    for chunk in range(body_chunk_start_in[k], body_chunk_start_in[k + 1]):
        wrench += wrenches_in[chunk]
    body_f_out[body] = body_f_out[body] + wrench


def scatter_wrenches(
    body_q,
    body_com,
    body_flags,
    kinematic_flag,
    chunk_range,
    chunk_body,
    body_list,
    body_chunk_start,
    positions,
    forces,
    torques,
    wrenches,
    body_f,
):
    """Add the force and torque of every moment to the wrench of its body; ``wrenches`` [chunk_count] is scratch.

    Bodies that carry ``kinematic_flag`` take none.
    """
    if not len(body_list):
        return
    wp.launch(
        _sum_chunks,
        dim=len(chunk_body),
        inputs=[body_q, body_com, chunk_range, chunk_body, positions, forces, torques],
        outputs=[wrenches],
        device=wrenches.device,
    )
    wp.launch(
        _add_to_bodies,
        dim=len(body_list),
        inputs=[body_list, body_chunk_start, body_flags, kinematic_flag, wrenches],
        outputs=[body_f],
        device=wrenches.device,
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
