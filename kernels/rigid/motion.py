"""How magnetic moments and sources of fields move with their bodies: what ``pairs.eddy`` and ``applied.rates`` take."""

import warp as wp

from warpmag.kernels.rigid.bodies import BodyMoments
from warpmag.kernels.rigid.newton_views import BodyView, view_bodies
from warpmag.kernels.rigid.sources import SourceShapes

wp.set_module_options({"enable_backward": False})


@wp.func
def _velocity_at(bodies: BodyView, body: int, x: wp.vec3):
    center = wp.transform_point(bodies.q[body], bodies.com[body])
    return wp.spatial_top(bodies.qd[body]) + wp.cross(wp.spatial_bottom(bodies.qd[body]), x - center)


@wp.kernel
def _gather_motion(
    # inputs:
    bodies: BodyView,
    magnets: BodyMoments,
    positions_in: wp.array[wp.vec3],
    # outputs:
    motion_out: wp.array2d[float],
):
    i = wp.tid()
    body = magnets.body[i]
    if body < 0:
        return
    velocity = _velocity_at(bodies, body, positions_in[i])
    spin = wp.spatial_bottom(bodies.qd[body])
    for c in range(3):
        motion_out[c, i] = velocity[c]
        motion_out[c + 3, i] = spin[c]
    if (bodies.flags[body] & magnets.kinematic_flag) == 0:
        inverse = bodies.inv_inertia[body]
        motion_out[6, i] = bodies.inv_mass[body]
        motion_out[7, i] = wp.max(inverse[0, 0], wp.max(inverse[1, 1], inverse[2, 2]))


def gather_motion(magnets: BodyMoments, model, state, positions, motion):
    """Write velocity and angular velocity of all moments, and how easily their bodies move; those of the world stay."""
    inputs = [view_bodies(model, state), magnets, positions]
    wp.launch(_gather_motion, len(positions), inputs=inputs, outputs=[motion], device=positions.device)


@wp.kernel
def _gather_source_motion(
    # inputs:
    bodies: BodyView,
    sources: SourceShapes,
    frames_in: wp.array[wp.transform],
    # outputs:
    motion_out: wp.array2d[float],
):
    s = wp.tid()
    body = sources.shape_body[sources.shape[s]]
    if body < 0:
        return
    velocity = _velocity_at(bodies, body, wp.transform_get_translation(frames_in[s]))
    spin = wp.spatial_bottom(bodies.qd[body])
    for c in range(3):
        motion_out[s, c] = velocity[c]
        motion_out[s, c + 3] = spin[c]


def gather_source_motion(sources: SourceShapes, model, state, frames, motion):
    """Write velocity of the origin and angular velocity of all sources; those fixed in the world stay."""
    inputs = [view_bodies(model, state), sources, frames]
    wp.launch(_gather_source_motion, len(frames), inputs=inputs, outputs=[motion], device=frames.device)
