"""Magnets on a Newton builder: which shapes they cover, how they survive copying, what is refused."""

import math

import newton
import numpy as np
import pytest
import warp as wp

import warpmag
from warpmag.engine.magnets.attributes import marked_shapes


@pytest.fixture
def builder():
    builder = newton.ModelBuilder()
    warpmag.register_attributes(builder)
    return builder


def add_ball(builder, position=(0.0, 0.0, 0.0), radius=0.005, **arguments):
    body = builder.add_body(xform=wp.transform(position, wp.quat_identity()), **arguments)
    builder.add_shape_sphere(body, radius=radius)
    return body


def test_a_magnet_covers_all_colliding_shapes_of_its_body(builder, device):
    body = add_ball(builder)
    builder.add_shape_box(body, hx=0.01, hy=0.01, hz=0.01)
    unseen = newton.ModelBuilder.ShapeConfig(has_shape_collision=False)
    builder.add_shape_box(body, hx=0.1, hy=0.1, hz=0.1, cfg=unseen)
    add_ball(builder)
    warpmag.add_inducible(
        builder, body=body, saturation=4e5, susceptibility=3.0, curve="langevin", moment_spacing=0.002
    )
    magnets = marked_shapes(builder.finalize(device=device))
    assert set(magnets) == {0, 1}
    magnet = magnets[1]
    assert (magnet.kind, magnet.saturation, magnet.susceptibility, magnet.curve) == ("inducible", 4e5, 3.0, "langevin")
    assert magnet.moment_spacing == pytest.approx(0.002, rel=1e-6)  # stored in float32


def test_magnetization_is_given_in_the_frame_of_the_body_and_stored_in_that_of_the_shape(builder, device):
    body = builder.add_body()
    quarter = wp.quat_from_axis_angle(wp.vec3(0.0, 0.0, 1.0), 0.5 * math.pi)
    builder.add_shape_box(body, xform=wp.transform((0.0, 0.0, 0.0), quarter), hx=0.01, hy=0.01, hz=0.01)
    warpmag.add_permanent(builder, body=body, magnetization=(1e6, 0.0, 0.0))
    stored = marked_shapes(builder.finalize(device=device))[0].magnetization
    np.testing.assert_allclose(stored, (0.0, -1e6, 0.0), atol=1e6 * 1e-6)  # float32 rotation


def test_magnets_survive_copying(builder, device):
    warpmag.add_permanent(builder, body=add_ball(builder), magnetization=(0.0, 0.0, 1e6))
    add_ball(builder)
    scene = newton.ModelBuilder()
    scene.replicate(builder, 3)
    assert sorted(marked_shapes(scene.finalize(device=device))) == [0, 2, 4]


def test_a_static_shape_can_be_a_magnet(builder, device):
    shape = builder.add_shape_box(-1, hx=0.02, hy=0.02, hz=0.02)
    warpmag.add_permanent(builder, shape=shape, magnetization=(0.0, 0.0, 1e6))
    assert list(marked_shapes(builder.finalize(device=device))) == [shape]


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"saturation": -1.0}, "saturation: must be positive"),
        ({"saturation": math.nan}, "saturation: must be positive"),
        ({"susceptibility": 0.0}, "susceptibility: must be positive"),
        ({"curve": "cubic"}, "curve: 'cubic' is not one of"),
        ({"moment_spacing": -1.0}, "moment spacing: must be zero or positive"),
        ({"body": 5}, "body: 5 is out of range, the builder has 2 bodies"),
        ({"body": 1}, "empty: has no colliding solid shape yet"),
        ({"body": None, "shape": 9}, "shape: 9 is out of range"),
        ({"body": None, "shape": 1}, "a plane has no volume to magnetize"),
        ({"body": 1, "shape": 0}, "body, shape: give one of them, got both"),
        ({"body": None}, "body, shape: give one of them, got none"),
    ],
)
def test_bad_magnets_are_refused_in_one_line(builder, change, message):
    add_ball(builder, label="ball")
    builder.add_body(label="empty")
    builder.add_ground_plane()
    with pytest.raises(warpmag.InputError, match=message) as caught:
        warpmag.add_inducible(builder, **({"body": 0} | change))
    assert "\n" not in str(caught.value)


def test_bad_magnetizations_are_refused(builder):
    body = add_ball(builder)
    with pytest.raises(warpmag.InputError, match="magnetization: must be finite"):
        warpmag.add_permanent(builder, body=body, magnetization=(math.inf, 0.0, 0.0))
    with pytest.raises(warpmag.InputError, match="magnetization: must be three numbers"):
        warpmag.add_permanent(builder, body=body, magnetization=(1e6, 0.0))


def test_attributes_must_be_registered_and_magnets_must_exist(device):
    builder = newton.ModelBuilder()
    body = add_ball(builder)
    with pytest.raises(warpmag.InputError, match="call warpmag.register_custom_attributes"):
        warpmag.add_inducible(builder, body=body)
    with pytest.raises(warpmag.InputError, match="has no magnets"):
        warpmag.Magnetics(builder.finalize(device=device))
