"""Between rigid bodies and the sources of fields on them: frames to sources, reactions back."""

import warp as wp

from warpmag.kernels.rigid.newton_views import BodyView, view_bodies

wp.set_module_options({"enable_backward": False})


@wp.struct
class SourceShapes:
    """Shapes that s sources of fields are, on b bodies.

    Attributes:
        shape: Shape of each source, shape [s].
        shape_body, shape_frames: Body of each shape, and its frame there: arrays of the model, shape [shapes].
        strengths: Strength of each shape, an array of the model, shape [shapes].
        body_list, run_start: Bodies that sources push, and the first of each in ``order``, shape [b] and [b + 1].
        order: Sources by body.
        kinematic_flag: Newton's flag of bodies that forces do not move.
    """

    shape: wp.array[wp.int32]
    shape_body: wp.array[wp.int32]
    shape_frames: wp.array[wp.transform]
    strengths: wp.array[float]
    body_list: wp.array[wp.int32]
    run_start: wp.array[wp.int32]
    order: wp.array[wp.int32]
    kinematic_flag: int


@wp.kernel
def _gather_sources(
    # inputs:
    body_q_in: wp.array[wp.transform],
    sources: SourceShapes,
    # outputs:
    frames_out: wp.array[wp.transform],
    strengths_out: wp.array[wp.vec3],
):
    s = wp.tid()
    shape = sources.shape[s]
    frame = sources.shape_frames[shape]
    body = sources.shape_body[shape]
    if body >= 0:
        frame = body_q_in[body] * frame
    frames_out[s] = frame
    strengths_out[s] = wp.vec3(sources.strengths[shape], 0.0, 0.0)


def gather_sources(body_q, sources: SourceShapes, frames, strengths):
    """Write where in the world all sources are, and how strong."""
    outputs = [frames, strengths]
    wp.launch(_gather_sources, len(frames), inputs=[body_q, sources], outputs=outputs, device=frames.device)


@wp.kernel
def _add_reactions(
    # inputs:
    sources: SourceShapes,
    bodies: BodyView,
    frames_in: wp.array[wp.transform],
    wrenches_in: wp.array2d[float],
    # outputs:
    body_f_out: wp.array[wp.spatial_vector],
):
    k = wp.tid()
    body = sources.body_list[k]
    if (bodies.flags[body] & sources.kinematic_flag) != 0:
        return
    center = wp.transform_point(bodies.q[body], bodies.com[body])
    force = wp.vec3()
    torque = wp.vec3()
    for place in range(sources.run_start[k], sources.run_start[k + 1]):
        s = sources.order[place]
        pull = wp.vec3(wrenches_in[s, 0], wrenches_in[s, 1], wrenches_in[s, 2])
        turn = wp.vec3(wrenches_in[s, 3], wrenches_in[s, 4], wrenches_in[s, 5])
        force += pull
        torque += turn + wp.cross(wp.transform_get_translation(frames_in[s]) - center, pull)
    body_f_out[body] = body_f_out[body] + wp.spatial_vector(force, torque)


def add_reactions(sources: SourceShapes, model, state, frames, wrenches):
    """Add force and torque about its frame of every source to the wrench of its body, unless that is kinematic."""
    inputs = [sources, view_bodies(model, state), frames, wrenches]
    outputs = [state.body_f]
    wp.launch(_add_reactions, len(sources.body_list), inputs=inputs, outputs=outputs, device=frames.device)


@wp.kernel
def _set_strengths(values_in: wp.array[float], shapes_in: wp.array[wp.int32], strengths_out: wp.array[float]):
    k = wp.tid()
    strengths_out[shapes_in[k]] = values_in[wp.min(k, values_in.shape[0] - 1)]


def set_strengths(values, shapes, strengths):
    """Give each of ``shapes`` its strength, or all of them the only one there is."""
    wp.launch(_set_strengths, len(shapes), inputs=[values, shapes], outputs=[strengths], device=shapes.device)
