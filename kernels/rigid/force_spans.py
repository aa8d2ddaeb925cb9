"""Distances over which the magnetic forces on fast bodies vary, from the gaps to all other magnets and coils.

The force on a body far from other magnets varies over a longer distance than in contact. More substeps may then share
forces. Fragments that fly apart do not need a solve in each pair of short substeps.
"""

import warp as wp

from warpmag.kernels.rigid.monitor import Monitor
from warpmag.kernels.rigid.newton_views import BodyView, body_pose

wp.set_module_options({"enable_backward": False})

_SHARE = 0.5
"""Share of the gap to the nearest magnet in which a force varies. Two balls in contact have a gap of 0, and forces that
vary over a radius, which is half the distance of their centers."""
_THREADS = 32  # threads of a GPU that measure the gaps of a shape


@wp.struct
class MagneticShapes:
    """Magnets and coils of a model, m of them, which are shapes, and its arrays of all shapes."""

    shape: wp.array[wp.int32]  # shapes that are magnets or coils, shape [m]
    radius: wp.array[float]  # radius of a ball around the frame of each that contains it [m], shape [m]
    longest: float  # longest distance over which the field of maps varies [m]
    body: wp.array[wp.int32]  # body of each shape, -1 for the world, shape [shapes]
    world: wp.array[wp.int32]  # world of each shape, -1 for all worlds, shape [shapes]
    frame: wp.array[wp.transform]  # pose on its body, shape [shapes]


def magnetic_shapes(model, shapes, radii, spacing: float) -> MagneticShapes:
    """Return the shapes of a Newton model that are magnets or coils, with their ``radii`` [m].

    ``spacing`` is the shortest distance between nodes of field maps [m].
    """
    magnets = MagneticShapes()
    magnets.shape = wp.array(shapes, dtype=wp.int32, device=model.device)
    magnets.radius = wp.array(radii, dtype=float, device=model.device)
    magnets.longest = _SHARE * spacing
    magnets.body, magnets.world, magnets.frame = model.shape_body, model.shape_world, model.shape_transform
    return magnets


@wp.func
def _is_fast(m: Monitor, bodies: BodyView, body: int, longest: float) -> bool:
    """Return true for a body whose motion could end the sharing of forces before a substep of the first level."""
    length = m.force_length[body]
    return length < wp.inf and wp.length(wp.spatial_top(bodies.qd[body])) * longest > length


@wp.kernel
def _begin_spans(m: Monitor, bodies: BodyView, magnets: MagneticShapes, longest: float):
    body = wp.tid()
    length = m.force_length[body]
    m.force_span[body] = wp.where(_is_fast(m, bodies, body, longest), wp.max(length, magnets.longest), length)


@wp.func
def _center(magnets: MagneticShapes, bodies: BodyView, shape: int) -> wp.vec3:
    pose = body_pose(bodies.q, magnets.body[shape])
    return wp.transform_point(pose, wp.transform_get_translation(magnets.frame[shape]))


@wp.kernel
def _measure_spans(m: Monitor, bodies: BodyView, magnets: MagneticShapes, longest: float, threads: int):
    index = wp.tid() // threads
    own = magnets.shape[index]
    body = magnets.body[own]
    if body < 0:
        return
    if not _is_fast(m, bodies, body, longest):
        return
    center = _center(magnets, bodies, own)
    gap = float(wp.inf)
    for k in range(wp.tid() % threads, magnets.shape.shape[0], threads):
        other = magnets.shape[k]
        apart = magnets.world[other] >= 0 and magnets.world[own] >= 0 and magnets.world[other] != magnets.world[own]
        if magnets.body[other] != body and not apart:
            distance = wp.length(_center(magnets, bodies, other) - center)
            gap = wp.min(gap, distance - magnets.radius[index] - magnets.radius[k])
    wp.atomic_min(m.force_span, body, wp.max(m.force_length[body], wp.static(_SHARE) * gap))


def measure_force_spans(m: Monitor, bodies: BodyView, magnets: MagneticShapes, longest: float):
    """Write the distances over which magnetic forces on bodies vary at their present poses to ``m.force_span``.

    ``longest`` is the length of the substeps of the first level [s].
    """
    device = m.peaks.device
    threads = _THREADS if device.is_cuda else 1
    wp.launch(_begin_spans, len(m.force_span), inputs=[m, bodies, magnets, longest], device=device)
    inputs = [m, bodies, magnets, longest, threads]
    wp.launch(_measure_spans, threads * len(magnets.shape), inputs=inputs, device=device)
