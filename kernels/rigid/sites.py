"""Between sites on bodies and what is measured there."""

import warp as wp

wp.set_module_options({"enable_backward": False})


@wp.struct
class Sites:
    """Sites of s sensors.

    Attributes:
        shape: Shape that each site is, shape [s].
        shape_body, shape_frames: Body of each shape, and its frame there: arrays of the model, shape [shapes].
    """

    shape: wp.array[wp.int32]
    shape_body: wp.array[wp.int32]
    shape_frames: wp.array[wp.transform]


@wp.func
def _frame_of(sites: Sites, body_q: wp.array[wp.transform], i: int) -> wp.transform:
    shape = sites.shape[i]
    frame = sites.shape_frames[shape]
    body = sites.shape_body[shape]
    if body >= 0:
        frame = body_q[body] * frame
    return frame


@wp.kernel
def _find_sites(body_q_in: wp.array[wp.transform], sites: Sites, points_out: wp.array[wp.vec3]):
    i = wp.tid()
    points_out[i] = wp.transform_get_translation(_frame_of(sites, body_q_in, i))


def find_sites(body_q, sites: Sites, points):
    """Write where the sites are [m], world frame."""
    wp.launch(_find_sites, len(points), inputs=[body_q, sites], outputs=[points], device=points.device)


@wp.kernel
def _read_sites(
    # inputs:
    body_q_in: wp.array[wp.transform],
    sites: Sites,
    field_in: wp.array[wp.vec3],
    noise: float,
    most: float,
    seed: int,
    reading_count_in: wp.array[wp.int32],
    # outputs:
    readings_out: wp.array[wp.vec3],
):
    i = wp.tid()
    rotation = wp.transform_get_rotation(_frame_of(sites, body_q_in, i))
    reading = wp.quat_rotate_inv(rotation, field_in[i])
    random = wp.rand_init(seed, reading_count_in[0] * field_in.shape[0] + i)
    for c in range(3):
        reading[c] = wp.clamp(reading[c] + noise * wp.randn(random), -most, most)
    readings_out[i] = reading


@wp.kernel
def _count_reading(reading_count_out: wp.array[wp.int32]):
    reading_count_out[0] = reading_count_out[0] + 1


def read_sites(body_q, sites: Sites, field, *, noise: float, most: float, seed: int, reading_count, readings):
    """Write what sensors at the sites read of a vector field.

    Args:
        body_q: Poses of bodies.
        sites: The sites.
        field: The field there, world frame, shape [s].
        noise: Standard deviation of the noise of each component, in the unit of the field.
        most: Largest size of a component that a sensor reads; infinite for all.
        seed: Seed of the noise.
        reading_count: Readings so far, shape [1]; counted.
        readings: Out, in the frames of the sites, shape [s].
    """
    inputs = [body_q, sites, field, noise, most, seed, reading_count]
    wp.launch(_read_sites, len(readings), inputs=inputs, outputs=[readings], device=readings.device)
    wp.launch(_count_reading, 1, inputs=[reading_count], device=readings.device)
