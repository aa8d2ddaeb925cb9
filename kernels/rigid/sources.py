"""Coupling of rigid bodies to the sources of fields and the sensors on them: frames and motion, reactions, readings."""

import warp as wp

from warpmag.kernels.rigid.newton_views import BodyView, velocity_at, view_bodies

wp.set_module_options({"enable_backward": False})


@wp.struct
class SourceShapes:
    """Shapes of s sources of fields, on b bodies."""

    shape: wp.array[wp.int32]  # shape of each source, shape [s]
    shape_body: wp.array[wp.int32]  # body of each shape, an array of the model, shape [shapes]
    shape_frames: wp.array[wp.transform]  # frame of each shape in its body, likewise
    strengths: wp.array[float]  # strength of each shape, an array of the model, shape [shapes]
    body_list: wp.array[wp.int32]  # bodies with sources, shape [b]
    run_start: wp.array[wp.int32]  # first source of each of them in ``order``, shape [b + 1]
    order: wp.array[wp.int32]  # sources sorted by body
    kinematic_flag: int  # Newton's flag of bodies that forces do not move


@wp.func
def _world_frame(body_q: wp.array[wp.transform], body: int, frame: wp.transform) -> wp.transform:
    """Return the frame of a shape in the world, from its frame in a body or in the world, -1."""
    if body < 0:
        return frame
    return body_q[body] * frame


@wp.kernel
def _gather_sources(
    body_q_in: wp.array[wp.transform],
    sources: SourceShapes,
    frames_out: wp.array[wp.transform],
    strengths_out: wp.array[wp.vec3],
):
    s = wp.tid()
    shape = sources.shape[s]
    frames_out[s] = _world_frame(body_q_in, sources.shape_body[shape], sources.shape_frames[shape])
    strengths_out[s] = wp.vec3(sources.strengths[shape], 0.0, 0.0)


def gather_sources(launch, body_q, sources: SourceShapes, frames, strengths):
    """Write the frames of all sources in the world, and their strengths."""
    launch(_gather_sources, len(frames), [body_q, sources], [frames, strengths], device=frames.device)


@wp.kernel
def _gather_source_motion(
    bodies: BodyView, sources: SourceShapes, frames_in: wp.array[wp.transform], motion_out: wp.array2d[float]
):
    s = wp.tid()
    body = sources.shape_body[sources.shape[s]]
    if body < 0:
        return
    velocity = velocity_at(bodies, body, wp.transform_get_translation(frames_in[s]))
    omega = wp.spatial_bottom(bodies.qd[body])
    for c in range(3):
        motion_out[s, c] = velocity[c]
        motion_out[s, c + 3] = omega[c]


def gather_source_motion(sources: SourceShapes, model, state, frames, motion):
    """Write the velocity of the origin and the angular velocity of each source, except for those fixed in the world."""
    inputs = [view_bodies(model, state), sources, frames]
    wp.launch(_gather_source_motion, len(frames), inputs=inputs, outputs=[motion], device=frames.device)


@wp.kernel
def _add_reactions(
    sources: SourceShapes,
    bodies: BodyView,
    frames_in: wp.array[wp.transform],
    wrenches_in: wp.array2d[float],
    body_f_out: wp.array[wp.spatial_vector],
):
    k = wp.tid()
    body = sources.body_list[k]
    if (bodies.flags[body] & sources.kinematic_flag) != 0:
        return
    center = wp.transform_point(bodies.q[body], bodies.com[body])
    force = wp.vec3()
    torque = wp.vec3()
    for entry in range(sources.run_start[k], sources.run_start[k + 1]):
        s = sources.order[entry]
        source_force = wp.vec3(wrenches_in[s, 0], wrenches_in[s, 1], wrenches_in[s, 2])
        source_torque = wp.vec3(wrenches_in[s, 3], wrenches_in[s, 4], wrenches_in[s, 5])
        force += source_force
        torque += source_torque + wp.cross(wp.transform_get_translation(frames_in[s]) - center, source_force)
    body_f_out[body] = body_f_out[body] + wp.spatial_vector(force, torque)


def add_reactions(launch, sources: SourceShapes, model, state, frames, wrenches):
    """Add the wrench of each source, about its frame's origin, to that of its body, except for kinematic bodies."""
    inputs = [sources, view_bodies(model, state), frames, wrenches]
    launch(_add_reactions, len(sources.body_list), inputs, [state.body_f], device=frames.device)


@wp.kernel
def _set_strengths(values_in: wp.array[float], shapes_in: wp.array[wp.int32], strengths_out: wp.array[float]):
    k = wp.tid()
    strengths_out[shapes_in[k]] = values_in[wp.min(k, values_in.shape[0] - 1)]


def set_strengths(values, shapes, strengths):
    """Set the strengths of ``shapes``; ``values`` may have one entry for all."""
    wp.launch(_set_strengths, len(shapes), inputs=[values, shapes], outputs=[strengths], device=shapes.device)


@wp.struct
class Sites:
    """Sites of s sensors."""

    shape: wp.array[wp.int32]  # shape of each site, shape [s]
    shape_body: wp.array[wp.int32]  # body of each shape, an array of the model, shape [shapes]
    shape_frames: wp.array[wp.transform]  # frame of each shape in its body, likewise


@wp.func
def _site_frame(sites: Sites, body_q: wp.array[wp.transform], i: int) -> wp.transform:
    shape = sites.shape[i]
    return _world_frame(body_q, sites.shape_body[shape], sites.shape_frames[shape])


@wp.kernel
def _find_sites(body_q_in: wp.array[wp.transform], sites: Sites, points_out: wp.array[wp.vec3]):
    i = wp.tid()
    points_out[i] = wp.transform_get_translation(_site_frame(sites, body_q_in, i))


def find_sites(body_q, sites: Sites, points):
    """Write the positions of the sites [m], world frame."""
    wp.launch(_find_sites, len(points), inputs=[body_q, sites], outputs=[points], device=points.device)


@wp.kernel
def _read_sites(
    body_q_in: wp.array[wp.transform],
    sites: Sites,
    field_in: wp.array[wp.vec3],
    noise: float,
    limit: float,
    seed: int,
    reading_count_in: wp.array[wp.int32],
    readings_out: wp.array[wp.vec3],
):
    i = wp.tid()
    rotation = wp.transform_get_rotation(_site_frame(sites, body_q_in, i))
    reading = wp.quat_rotate_inv(rotation, field_in[i])
    random = wp.rand_init(seed, reading_count_in[0] * field_in.shape[0] + i)
    for c in range(3):
        reading[c] = wp.clamp(reading[c] + noise * wp.randn(random), -limit, limit)
    readings_out[i] = reading


@wp.kernel
def _count_reading(reading_count_out: wp.array[wp.int32]):
    reading_count_out[0] = reading_count_out[0] + 1


def read_sites(body_q, sites: Sites, field, *, noise: float, limit: float, seed: int, reading_count, readings):
    """Write the readings of a vector field by sensors at the sites.

    Args:
        field: Field at the sites, world frame, shape [s].
        noise: Standard deviation of the noise of each component, in the unit of the field.
        limit: Largest magnitude of a component that a sensor reads; infinite for no limit.
        reading_count: In and out, number of previous readings, shape [1].
        readings: Out, in the frames of the sites, shape [s].
    """
    inputs = [body_q, sites, field, noise, limit, seed, reading_count]
    wp.launch(_read_sites, len(readings), inputs=inputs, outputs=[readings], device=readings.device)
    wp.launch(_count_reading, 1, inputs=[reading_count], device=readings.device)
