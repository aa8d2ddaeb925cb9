"""Scenes that are unusual and valid run with sane physics."""

import math

import newton
import numpy as np
import pytest
from pxr import Usd
from small_stages import (
    CHAIN,
    FIELD,
    IRON,
    LEFT,
    PERMANENT,
    RIGHT,
    A,
    B,
    C,
    G,
    R,
    ball,
    errors_and_warnings,
    joint,
    physics,
    write,
)

import warpmag
from warpmag.engine.stepping.simulation import Simulation
from warpmag.errors import SimulationError
from warpmag.kernels.contacts.solve import RECOVERY_SPEED


def advance(simulation, seconds):
    for _ in range(round(seconds / simulation.step_size)):
        simulation.step()
    return simulation.state.body_q.numpy(), simulation.state.body_qd.numpy()


COMPOUND = f"""def Xform "Body" (prepend apiSchemas = ["PhysicsRigidBodyAPI"]) {{
    double3 xformOp:translate = (0, 0, 1)
    uniform token[] xformOpOrder = ["xformOp:translate"]
    {ball("Magnet", (0, 0, 0), body=False)}
    {ball("Other", (2 * R, 0, 0), body=False, magnet=False)}
}}
"""
FALLING = {
    "no physics scene, no ground": [A],
    "one body of a magnet and something else": [physics(), COMPOUND],
    "only permanent magnets": [physics(), ball("A", (0, 0, 1), PERMANENT), ball("B", (2.0, 0, 1), PERMANENT)],
    "a chain": [physics(), A, B, C, *CHAIN],
    "a chain named from its end": [
        *(physics(), A, B, C),
        *(joint("Revolute", *bodies, LEFT, RIGHT, name=bodies) for bodies in ("CB", "BA")),
    ],
    "two joints into one body": [
        *(physics(), A, B, C, CHAIN[0]),
        joint("Spherical", "C", "B", LEFT, RIGHT, name="CB"),
    ],
    "a loop": [physics(), A, B, C, *CHAIN, joint("Spherical", "C", "A", (-0.05, 0, 0), (0.05, 0, 0), name="CA")],
    **{
        f"a pair with a {kind} joint": [physics(), A, B, joint(kind, "A", "B", RIGHT, LEFT)]
        for kind in ("Fixed", "Prismatic", "Distance")
    },
}


@pytest.mark.no_cover  # lines of joints that other tests reach
@pytest.mark.parametrize("case", FALLING)
def test_what_nothing_holds_falls_freely(case, device, tmp_path, capsys):
    path = write(tmp_path, *FALLING[case])
    errors_and_warnings(path, tmp_path, device, capsys, frames=6)
    stage = Usd.Stage.Open(str(tmp_path / "out.usda"))
    places = [prim.GetAttribute("xformOp:translate:warpmag") for prim in stage.Traverse()]
    ways = np.array([np.subtract(place.Get(0.0), place.Get(6.0)) for place in places if place])
    # Symplectic Euler with substeps h falls g t (t + h) / 2; substeps are 0.5 ms. The centre of equal balls falls.
    fallen = 0.5 * G * 0.1 * (0.1 + 5e-4)
    np.testing.assert_allclose(ways.mean(axis=0), (0.0, 0.0, fallen), atol=1e-3 * fallen)


LENGTH, BOB = 0.1, 0.05  # m
SWUNG = ball("Bob", (LENGTH, 0, 1), radius=BOB)
HOLDER = {"radius": 0.06, "magnet": False}  # into the ball: bodies of a joint do not collide
FIRST, SECOND = (0.0, 0.0, 0.0), (-LENGTH, 0.0, 0.0)
PENDULUMS = {
    "the world": [joint("Revolute", None, "Bob", (0, 0, 1), SECOND)],
    "a static prim": [
        ball("Stand", (0, 0, 1), body=False, **HOLDER),
        joint("Revolute", "Bob", "Stand", SECOND, FIRST),
    ],
    "a disabled body": [
        ball("Stand", (0, 0, 1), "bool physics:rigidBodyEnabled = 0", **HOLDER),
        joint("Revolute", "Stand", "Bob", FIRST, SECOND),
    ],
    "two static prims": [
        *(ball(name, (0, y, 1), body=False, **HOLDER) for name, y in (("Left", 0.02), ("Right", -0.02))),
        joint("Revolute", "Left", "Bob", (0, -0.02, 0), SECOND, name="One"),
        joint("Revolute", "Right", "Bob", (0, 0.02, 0), SECOND, name="Other"),
    ],
    "a kinematic body": [
        ball("Stand", (0, 0, 1), kinematic=True, **HOLDER),
        joint("Spherical", "Stand", "Bob", FIRST, SECOND),
    ],
    "a kinematic body, the other way round": [
        ball("Stand", (0, 0, 1), kinematic=True, **HOLDER),
        joint("Revolute", "Bob", "Stand", SECOND, FIRST),
    ],
}


@pytest.mark.parametrize("held_by", PENDULUMS)
def test_the_first_swing_of_a_pendulum(held_by, device, tmp_path):
    simulation = Simulation(write(tmp_path, physics(), SWUNG, *PENDULUMS[held_by]), device=device)
    assert simulation.statistics.overlapping == 0
    # From the horizontal to the bottom: I/(m g L) under a root, times the elliptic integral K(sin 45°).
    quarter = math.sqrt((LENGTH**2 + 0.4 * BOB**2) / (G * LENGTH)) * 1.85407467730137
    poses, speeds = advance(simulation, quarter)
    swung = math.degrees(math.atan2(1.0 - poses[0, 2], poses[0, 0]))
    assert swung == pytest.approx(90.0, abs=1.0)  # a step is 0.8 degrees there; XPBD loses 0.8 % of the speed
    fastest = math.sqrt(2.0 * G * LENGTH / (LENGTH**2 + 0.4 * BOB**2))
    assert speeds[0, 4] == pytest.approx(fastest, rel=0.015)


def test_a_distance_joint_is_a_rope(device, tmp_path):
    rope = joint("Distance", None, "Bob", (0, 0, 1), (0, 0, 0), f"float physics:maxDistance = {LENGTH}")
    simulation = Simulation(write(tmp_path, physics(), ball("Bob", (LENGTH, 0, 1)), rope), device=device)
    poses, speeds = advance(simulation, math.sqrt(LENGTH / G) * 1.85407467730137)
    np.testing.assert_allclose(poses[0, :3], (0.0, 0.0, 1.0 - LENGTH), atol=0.02 * LENGTH)
    assert np.linalg.norm(speeds[0, :3]) == pytest.approx(math.sqrt(2.0 * G * LENGTH), rel=0.015)


@pytest.mark.parametrize(("body0", "body1", "fallen"), [(None, "Bob", 20.0), ("Bob", None, 10.0)])
def test_limits_count_from_body0_to_body1(body0, body1, fallen, device, tmp_path):
    ends = [(0, 0, 1), SECOND] if body0 is None else [SECOND, (0, 0, 1)]
    limits = "float physics:lowerLimit = -10\n float physics:upperLimit = 20"
    simulation = Simulation(
        write(tmp_path, physics(), SWUNG, joint("Revolute", body0, body1, *ends, limits)), device=device
    )
    [pose], _ = advance(simulation, 0.4)
    assert math.degrees(math.atan2(1.0 - pose[2], pose[0])) == pytest.approx(fallen, abs=0.1)


def test_a_generic_joint_is_free_where_it_has_no_limit(device, tmp_path):
    moving = ball("A", (0, 0, 1), "vector3f physics:velocity = (0, 0, 0.1)", magnet=False)
    path = write(tmp_path, physics(0.0), moving, B, joint("", "A", "B", RIGHT, LEFT))
    _, speeds = advance(Simulation(path, device=device), 0.05)
    np.testing.assert_allclose(speeds[:, 2], (0.1, 0.0), atol=1e-6)


STILL = {
    "one static magnet": [physics(), ball("A", (0, 0, 0), PERMANENT, body=False)],
    "kinematic bodies alone": [
        physics(),
        *(ball("A", (0, 0, 0), PERMANENT, kinematic=True), ball("B", (0.02, 0, 0), kinematic=True)),
    ],
    "no rigid bodies": [
        physics(),
        *(ball("A", (0, 0, 0), PERMANENT, body=False), ball("B", (0.02, 0, 0), body=False)),
    ],
    "zero gravity": [physics(0.0), A],
}


@pytest.mark.parametrize("case", STILL)
def test_what_nothing_moves_stays(case, device, tmp_path, capsys):
    path = write(tmp_path, *STILL[case])
    assert errors_and_warnings(path, tmp_path, device, capsys) == ([], [])
    before, after = Usd.Stage.Open(str(path)), Usd.Stage.Open(str(tmp_path / "out.usda"))
    for name in ("A", "B"):
        if prim := before.GetPrimAtPath(f"/World/{name}"):
            place = after.GetPrimAtPath(prim.GetPath()).GetAttribute("xformOp:translate:warpmag")
            assert not place or np.allclose(place.Get(2.0), prim.GetAttribute("xformOp:translate").Get(), atol=1e-7)
    permanent = after.GetPrimAtPath("/World/A").GetAttribute("warpmag:moment").Get(2.0)
    volume = 4.0 / 3.0 * math.pi * R**3
    if case != "zero gravity":
        np.testing.assert_allclose(permanent, (0.0, 0.0, 1e6 * volume), rtol=1e-6)
    if induced := after.GetAttributeAtPath("/World/B.warpmag:moment"):
        field = -1e6 * volume / (4.0 * math.pi * 0.02**3)  # beside a dipole
        expected = 1.7e6 * math.tanh(3.0 * field / 1.7e6) * volume
        np.testing.assert_allclose(induced.Get(2.0), (0.0, 0.0, expected), rtol=2e-3, atol=-1e-6 * expected)


@pytest.mark.parametrize("body", [True, False])
def test_an_iron_ball_alone_in_a_field(body, device, tmp_path):
    simulation = Simulation(write(tmp_path, physics(0.0, FIELD), ball("A", (0, 0, 1), body=body)), device=device)
    poses, _ = advance(simulation, 0.02)
    volume = 4.0 / 3.0 * math.pi * R**3
    # tanh(3 H/Ms) is linear there to 1e-6
    np.testing.assert_allclose(simulation.magnetics.shape_moments(), [volume * 3.0 * np.array(FIELD)], rtol=2e-3)
    if body:
        np.testing.assert_allclose(poses[0, :3], (0, 0, 1), atol=1e-7)


def test_permanent_magnets_attract_as_dipoles(device, tmp_path):
    apart = 0.04  # m, one above the other
    magnets = [ball(name, (0, 0, z), PERMANENT) for name, z in (("A", 0.0), ("B", apart))]
    simulation = Simulation(write(tmp_path, physics(0.0), *magnets), device=device)
    _, speeds = advance(simulation, 0.002)
    volume = 4.0 / 3.0 * math.pi * R**3
    force = 6.0 * 4e-7 * math.pi * (1e6 * volume) ** 2 / (4.0 * math.pi * apart**4)
    expected = force / (IRON * volume) * 0.002
    np.testing.assert_allclose(speeds[:, 2], (expected, -expected), rtol=0.01)  # they come 0.2 % closer


SQUARE = [
    ball(name, place)
    for name, place in zip("ABCD", [(0, 0, 1), (0.05, 0, 1), (0.05, 0, 1.05), (0, 0, 1.05)], strict=True)
]
UP, DOWN = (0, 0, 0.025), (0, 0, -0.025)
SIDES = [("A", "B", RIGHT, LEFT), ("B", "C", UP, DOWN), ("C", "D", LEFT, RIGHT), ("D", "A", DOWN, UP)]
LOOP = [*SQUARE, *(joint("Revolute", *side, name=side[0] + side[1]) for side in SIDES)]
PIN = joint("Revolute", None, "A", (0, 0, 1), (0, 0, 0), name="Pin")
ARTICULATIONS = {
    "a joint that it excludes": [
        *(A, B, C, PIN, CHAIN[0]),
        CHAIN[1].replace("point3f", "bool physics:excludeFromArticulation = 1\n    point3f", 1),
    ],
    "a joint named from its end": [A, B, C, PIN, CHAIN[0], joint("Spherical", "C", "B", LEFT, RIGHT, name="CB")],
    "a loop": [*LOOP, PIN],
    "a loop in the air": LOOP,
    "two trees": [A, B, C, ball("D", (0.15, 0, 1)), CHAIN[0], joint("Spherical", "C", "D", RIGHT, LEFT, name="CD")],
    "a root on a body of another one": [
        *(A, B.replace('"PhysicsMassAPI"', '"PhysicsMassAPI", "PhysicsArticulationRootAPI"'), C, PIN, *CHAIN),
    ],
}


@pytest.mark.no_cover  # lines of joints that other tests reach
@pytest.mark.parametrize("case", ARTICULATIONS)
def test_an_articulation_moves_as_its_joints_do(case, device, tmp_path):
    """The default solver knows joints one by one: a root above them changes nothing but rounding."""
    results = []
    for root in ("", '(prepend apiSchemas = ["PhysicsArticulationRootAPI"])'):
        (folder := tmp_path / f"root{len(root)}").mkdir()
        inner = "".join(ARTICULATIONS[case]).replace("World/", "World/R/")
        simulation = Simulation(write(folder, physics(), f'def Xform "R" {root} {{\n{inner}}}\n'), device=device)
        poses, _ = advance(simulation, 0.05)
        results.append(dict(zip(simulation.model.body_label, poses[:, :3], strict=True)))
    assert results[0].keys() == results[1].keys() and len(results[0]) >= 3
    fallen = max(1.0 - pose[2] for pose in results[0].values())
    assert fallen > 1e-3
    for label, pose in results[0].items():
        np.testing.assert_allclose(results[1][label], pose, atol=2e-3 * fallen, err_msg=label)


@pytest.mark.parametrize("kept", [True, False])
def test_an_articulation_whose_bodies_pass_through_each_other_stays_one(kept, device, tmp_path):
    schemas = '"PhysicsArticulationRootAPI", "NewtonArticulationRootAPI"'
    inner = "".join([A, B, *CHAIN[:1]]).replace("World/", "World/R/")
    flag = f"bool newton:selfCollisionEnabled = {int(not kept)}"
    path = write(tmp_path, physics(), f'def Xform "R" (prepend apiSchemas = [{schemas}]) {{\n{flag}\n{inner}}}\n')
    model = Simulation(path, device=device).model
    inside = model.joint_articulation.numpy()[model.joint_label.index("/World/R/AB")] >= 0
    assert inside == kept


def test_a_builder_of_one_static_magnet(device):
    builder = newton.ModelBuilder()
    warpmag.register_attributes(builder)
    magnet = builder.add_shape_sphere(-1, radius=R)
    warpmag.add_permanent(builder, shape=magnet, magnetization=(0.0, 0.0, 1e6))
    simulation = Simulation(builder, device=device)
    simulation.step()
    moment = 1e6 * 4.0 / 3.0 * math.pi * R**3
    np.testing.assert_allclose(simulation.magnetics.shape_moments(), [(0.0, 0.0, moment)], rtol=1e-6)
    assert builder.body_count == 0  # it is the user's


def test_magnetics_of_a_model_without_bodies(device):
    builder = newton.ModelBuilder()
    warpmag.register_attributes(builder)
    magnet = builder.add_shape_sphere(-1, radius=R)
    warpmag.add_inducible(builder, shape=magnet)
    model = builder.finalize(device=device)
    magnetics = warpmag.Magnetics(model, external_field=FIELD)
    magnetics.apply(model.state())
    moment = 4.0 / 3.0 * math.pi * R**3 * 3.0 * np.array(FIELD)
    np.testing.assert_allclose(magnetics.shape_moments(), [moment], rtol=2e-3)


def test_a_solver_that_needs_articulations_names_the_joint(device, tmp_path):
    path = write(tmp_path, physics(), A, B, CHAIN[0])
    with pytest.raises(
        warpmag.InputError, match="/World/AB: the joint is outside all articulations, which the solver stee"
    ):
        Simulation(path, device=device, solver="steel")


BOXES = (
    ((0, 0, 0.01), (0.02, 0.005, 0.003)),
    ((-0.008, 0, 0), (0.003, 0.005, 0.02)),
    ((0, 0, -0.01), (0.01, 0.005, 0.003)),
)


def letter(name):
    boxes = "".join(
        f"""def Cube "Box{k}" (prepend apiSchemas = ["PhysicsCollisionAPI"]) {{
    double size = 1
    double3 xformOp:translate = {place}
    float3 xformOp:scale = {size}
    uniform token[] xformOpOrder = ["xformOp:translate", "xformOp:scale"]
}}
"""
        for k, (place, size) in enumerate(BOXES)
    )
    return f"""def Xform "{name}" (prepend apiSchemas = ["PhysicsRigidBodyAPI", "WarpmagMagnetAPI"]) {{
    {boxes}
}}
"""


def test_two_letters_at_one_place_come_apart_and_a_line_says_why(device, tmp_path):
    simulation = Simulation(write(tmp_path, physics(0.0), letter("A"), letter("B")), device=device)
    assert any("overlap at the start" in line for line in simulation.warnings())
    advance(simulation, 0.1)
    velocities = simulation.state.body_qd.numpy()[:, :3]
    assert np.isfinite(velocities).all()
    # masses are equal; what pushes letters apart rounds as speeds up to the fastest on the way do
    np.testing.assert_allclose(velocities.sum(axis=0), 0.0, atol=1e-4 * simulation.finish().peak_speed)
    assert np.abs(velocities).max() < 2.0 * RECOVERY_SPEED  # of points; centers may be faster


def test_a_state_that_is_not_finite_is_reported_with_its_cause(device, tmp_path):
    simulation = Simulation(write(tmp_path, physics(0.0), letter("A"), letter("B")), device=device)
    simulation.state.body_qd.fill_(math.inf)
    with pytest.raises(SimulationError, match="or faster than 1e.07 m/s; bodies overlapped at the start"):
        advance(simulation, 0.2)
