"""Bodies and shapes by index, label and pattern; strengths of permanent magnets; likely units."""

import math

import newton
import numpy as np
import pytest
import warp as wp

import warpmag
from warpmag.engine.magnets.attributes import marked_shapes

MU0 = 4e-7 * math.pi
UP = (0.0, 0.0, 1.0)


@pytest.fixture
def builder():
    """Bodies of index 0 to 5, each with one shape: the index of a body is not that of its shape."""
    builder = newton.ModelBuilder()
    warpmag.register_custom_attributes(builder)
    builder.add_ground_plane()
    for label in ("arm/gripper", "arm/ball_1", "arm/ball_2", "left/tip", "right/tip", "cube"):
        builder.add_shape_sphere(builder.add_body(label=label), radius=0.005, label=f"{label}/shape")
    return builder


@pytest.mark.parametrize(
    ("body", "shapes"),
    [
        (0, [1]),
        (np.int32(2), [3]),
        ("cube", [6]),
        ("gripper", [1]),
        ("arm/gripper", [1]),
        ("*/ball_*", [2, 3]),
        ("arm/ball_[12]", [2, 3]),
        ("*tip", [4, 5]),
        ("*", [1, 2, 3, 4, 5, 6]),
    ],
)
def test_bodies_are_selected(builder, body, shapes, device):
    assert warpmag.add_inducible(builder, body=body) == shapes
    assert sorted(marked_shapes(builder.finalize(device=device))) == shapes


def test_shapes_are_selected(builder, device):
    assert warpmag.add_permanent(builder, shape="arm/ball_?/shape", magnetization=(0.0, 0.0, 1e6)) == [2, 3]
    assert sorted(marked_shapes(builder.finalize(device=device))) == [2, 3]


@pytest.mark.parametrize(
    ("body", "message"),
    [
        (
            "tip",
            r"body: 'tip' is the label of 2 bodies: 'left/tip' \(3\), 'right/tip' \(4\); give an index or a pattern",
        ),
        ("griper", r"body: no label of the builder's 6 bodies matches 'griper'; such as 'arm/gripper'"),
        ("*/bolt_*", r"body: no label of the builder's 6 bodies matches '\*/bolt_\*'"),
        ("", "body: no label of the builder's 6 bodies matches ''"),
        (6, "body: 6 is out of range, the builder has 6 bodies"),
        (-1, "body: -1 is out of range"),
        (1.5, "body: must be a whole number"),
        (True, "body: must be a whole number"),
    ],
)
def test_wrong_bodies_are_refused(builder, body, message):
    with pytest.raises(warpmag.InputError, match=message):
        warpmag.add_inducible(builder, body=body)


def test_a_source_is_on_one_body(builder):
    site = warpmag.add_coil(builder, body="gripper", radius=0.01)
    assert builder.shape_body[site] == 0
    with pytest.raises(warpmag.InputError, match=r"body: '\*tip' matches 2 bodies, a source has one"):
        warpmag.add_coil(builder, body="*tip", radius=0.01)


@pytest.mark.parametrize("add", ["add_inducible", "add_permanent", "add_coil"])
def test_a_body_by_position_warns(builder, add):
    """In version 0.1 ``add_permanent(builder, shape)`` marked another shape in silence."""
    values = {"add_permanent": {"magnetization": (0.0, 0.0, 1e6)}, "add_coil": {"radius": 0.01}}.get(add, {})
    with pytest.warns(DeprecationWarning, match=rf"{add}: name the body, {add}\(builder, body=4, ...\)") as caught:
        made = getattr(warpmag, add)(builder, 4, **values)
    assert caught[0].filename == __file__
    assert made == (7 if add == "add_coil" else [5])
    with pytest.warns(DeprecationWarning), pytest.raises(TypeError):
        getattr(warpmag, add)(builder, 4, 5, **values)


@pytest.mark.parametrize(
    ("strength", "expected"),
    [
        ({"magnetization": (0.0, 3e5, 4e5)}, (0.0, 3e5, 4e5)),
        ({"remanence": 1.3, "direction": (0.0, 3.0, 4.0)}, (0.0, 0.6 * 1.3 / MU0, 0.8 * 1.3 / MU0)),
        ({"material": "N42", "direction": (0.0, 3.0, 4.0)}, (0.0, 0.6 * 1.3 / MU0, 0.8 * 1.3 / MU0)),
    ],
)
def test_strengths(builder, strength, expected, device):
    warpmag.add_permanent(builder, body="cube", **strength)
    made = warpmag.add_balls(builder, [[0.0, 0.0, 1.0]], 0.005, **strength)
    magnets = marked_shapes(builder.finalize(device=device))
    for shape in (6, made.shapes[0]):
        np.testing.assert_allclose(magnets[shape].magnetization, expected, rtol=1e-6)  # float32


@pytest.mark.parametrize(
    ("strength", "message"),
    [
        ({}, "magnetization, remanence, material: give one of them, got none"),
        ({"material": "N42", "remanence": 1.0, "direction": UP}, "give one of them, got remanence and material"),
        ({"magnetization": UP, "direction": UP}, "direction: goes with remanence or material"),
        ({"material": "N42"}, "direction: material needs the direction"),
        ({"remanence": 1.3}, "direction: remanence needs the direction"),
        ({"remanence": 1.3, "direction": (0.0, 0.0, 0.0)}, "direction: must not be zero"),
        ({"remanence": (0.0, 0.0, 1.3), "direction": UP}, "remanence: must be one real number"),
        ({"remanence": -1.3, "direction": UP}, "remanence: must be positive"),
    ],
)
def test_wrong_strengths_are_refused(builder, strength, message):
    with pytest.raises(warpmag.InputError, match=message):
        warpmag.add_permanent(builder, body="cube", **strength)


def test_a_direction_as_magnetization_warns(builder):
    with pytest.warns(DeprecationWarning, match="direction=") as caught:
        warpmag.add_permanent(builder, body="cube", material="N42", magnetization=UP)
    assert caught[0].filename == __file__


@pytest.mark.parametrize("add", [warpmag.add_permanent, warpmag.add_balls])
@pytest.mark.parametrize(
    ("magnetization", "meant"),
    [((0.0, 0.0, 1.3), "; for 1.3 T give remanence=1.3 and a direction"), ((0.0, 5e6, 0.0), ""), ((9.0, 0.0, 0.0), "")],
)
def test_a_strength_of_no_magnet_warns(builder, add, magnetization, meant):
    arguments = {"body": "cube"} if add is warpmag.add_permanent else {"positions": [UP], "radius": 0.005}
    value = f"{max(magnetization):g}".replace("+", r"\+")
    message = rf"^magnetization: {value} A/m is not that of a permanent magnet \(1000 to 2e\+06 A/m\){meant}$"
    with pytest.warns(warpmag.UnitWarning, match=message) as caught:
        add(builder, magnetization=magnetization, **arguments)
    assert caught[0].filename == __file__


@pytest.mark.parametrize("add", ["add_inducible", "add_permanent", "add_balls"])
def test_a_ball_of_a_meter_warns(builder, add):
    builder.add_shape_sphere(builder.add_body(label="large"), radius=1.0)
    strength = {} if add == "add_inducible" else {"magnetization": (0.0, 0.0, 1e6)}
    arguments = {"positions": [UP], "radius": 1.0} if add == "add_balls" else {"body": "large"}
    with pytest.warns(
        warpmag.UnitWarning, match="a magnetic ball of radius 1 m; lengths are in meters, 5 mm are 0.005"
    ):
        getattr(warpmag, add)(builder, **arguments, **strength)


@pytest.mark.filterwarnings("error")
@pytest.mark.parametrize("magnetization", [0.0, 1e3, 1e5, 1.2e6, 2e6])
def test_magnets_as_they_are_warn_of_nothing(builder, magnetization):
    warpmag.add_permanent(builder, body="cube", magnetization=(0.0, 0.0, magnetization))


def masses(**shape_config):
    """Builder of a ball, a box away from its body's origin, and a body of two shapes."""
    builder = newton.ModelBuilder()
    warpmag.register_custom_attributes(builder)
    config = newton.ModelBuilder.ShapeConfig(**shape_config)
    frame = wp.transform((0.01, 0.02, 0.03), wp.quat_rpy(0.1, 0.2, 0.3))
    builder.add_shape_sphere(builder.add_body(label="ball"), radius=0.005, cfg=config)
    builder.add_shape_box(builder.add_body(label="box"), xform=frame, hx=0.01, hy=0.02, hz=0.03, cfg=config)
    both = builder.add_body(label="both")
    builder.add_shape_sphere(both, radius=0.005, cfg=config)
    builder.add_shape_box(both, xform=frame, hx=0.01, hy=0.02, hz=0.03, cfg=config)
    return builder


def test_a_named_material_gives_the_density_that_nobody_gave():
    """Mass, inertia and center of mass are those that Newton computes from the density."""
    density = warpmag.material("1010-steel").density
    builder, expected = masses(), masses(density=density)
    warpmag.add_inducible(builder, body="*", material="1010-steel")
    for name in ("body_mass", "body_inv_mass", "body_inertia", "body_inv_inertia", "body_com"):
        values, wanted = (np.array(getattr(of, name), float) for of in (builder, expected))
        # float32; products of inertia that vanish are rounding of the moments of inertia
        np.testing.assert_allclose(values, wanted, rtol=1e-5, atol=1e-6 * np.abs(wanted).max())
    balls = warpmag.add_balls(builder, [[0.0, 0.0, 1.0]], 0.005, material="1010-steel")
    assert builder.body_mass[balls.bodies[0]] == pytest.approx(builder.body_mass[0], rel=1e-6)


@pytest.mark.parametrize("material", [{"material": "N42", "direction": UP}, {"magnetization": (0.0, 0.0, 1e6)}])
def test_a_density_that_somebody_gave_stays(material):
    given = {} if "magnetization" in material else {"density": 2000.0}
    builder, expected = masses(**given), masses(**given)
    warpmag.add_permanent(builder, body="*", **material)
    assert builder.body_mass == expected.body_mass


def test_a_part_of_a_body_does_not_change_its_mass():
    builder, expected = masses(), masses()
    warpmag.add_inducible(builder, shape=2, material="iron")
    assert builder.body_mass == expected.body_mass
