"""Magnets of two bodies at exactly one place are a slip, and refused by name; all else that overlaps runs."""

import time

import newton
import numpy as np
import pytest
from small_stages import PERMANENT, R, ball, physics, told, write

import warpmag
from warpmag.engine.fitness import check_places
from warpmag.engine.grouping import find_magnets
from warpmag.errors import InputError

AT = (0.0, 0.0, 1.0)
SAME = "magnets of different bodies at the same place; move or remove one"
SIDE = 0.01  # m


def cube(name):
    return ball(name, AT, PERMANENT).replace("def Sphere", "def Cube").replace("double radius", "double size")


REFUSED = {
    "balls": [ball("A", AT), ball("B", AT)],
    "permanent cubes": [cube("A"), cube("B")],
    "of other sizes and kinds": [ball("A", AT, PERMANENT), ball("B", (1e-3 * R * 0.4, 0.0, 1.0), radius=0.5 * R)],
}


@pytest.mark.parametrize("case", REFUSED)
def test_magnets_at_one_place_are_refused_by_both_commands(case, device, tmp_path, capsys):
    path = write(tmp_path, physics(), ball("C", (1.0, 0.0, 1.0)), *REFUSED[case])
    assert told(path, tmp_path, device, capsys)[0] == [f"/World/A and /World/B: {SAME}"]


RUNS = {
    "almost at one place": [ball("A", AT), ball("B", (1e-2 * R, 0.0, 1.0))],
    "one kinematic": [ball("A", AT), ball("B", AT, kinematic=True)],
    "one without a body": [ball("A", AT), ball("B", AT, body=False)],
    "one no magnet": [ball("A", AT), ball("B", AT, magnet=False)],
}


@pytest.mark.parametrize("case", RUNS)
def test_other_overlaps_are_a_warning(case, device, tmp_path, capsys):
    errors, warnings = told(write(tmp_path, physics(), *RUNS[case]), tmp_path, device, capsys, frames=1)
    assert errors == [] and any("of bodies overlaps at the start" in line for line in warnings)


def new_builder():
    builder = newton.ModelBuilder()
    warpmag.register_custom_attributes(builder)
    return builder


def add_boxes(builder, places, half, **body):
    """A body of permanent boxes, which are one magnet."""
    index = builder.add_body(**body)
    for place in places:
        builder.add_shape_box(index, xform=(place, (0.0, 0.0, 0.0, 1.0)), hx=half, hy=half, hz=half)
    warpmag.add_permanent(builder, index, magnetization=(0.0, 0.0, 1e6))


def refusal(builder):
    """What is said of a model, empty if it is accepted; nothing steps."""
    model = builder.finalize(device="cpu")
    try:
        check_places(model, warpmag.Magnetics(model).magnets, "xpbd")
    except InputError as error:
        return str(error)
    return ""


def test_a_simulation_of_a_builder_refuses_them(device):
    builder = new_builder()
    warpmag.add_balls(builder, np.zeros((3, 3)), R, label="ball")
    with pytest.raises(InputError, match=f"ball_0 and ball_[12]: {SAME}"):
        warpmag.Simulation(builder, device=device)


def test_a_rotor_in_a_ring_is_no_slip():
    """Their centres are one point, which is in the hole of the ring; a second rotor is a slip."""
    around = [(x * SIDE, y * SIDE, 0.0) for x, y in np.ndindex(3, 3) if (x, y) != (1, 1)]
    ring = np.subtract(around, (SIDE, SIDE, 0.0)).tolist()
    builder = new_builder()
    add_boxes(builder, ring, 0.5 * SIDE)
    add_boxes(builder, [(0.0, 0.0, 0.0)], 0.3 * SIDE, label="rotor")
    assert refusal(builder) == ""
    add_boxes(builder, [(0.0, 0.0, 0.0)], 0.2 * SIDE, label="copy")
    assert refusal(builder) == f"rotor and copy: {SAME}"


def test_places_are_those_of_the_magnets_in_the_world():
    """Not those of the bodies' origins: two arms with one hinge are apart, and two that end at one place are not."""
    for angle, said in ((2.0, ""), (np.pi, f"one and other: {SAME}")):
        builder = new_builder()
        turn = (0.0, 0.0, np.sin(0.5 * angle), np.cos(0.5 * angle))
        add_boxes(builder, [(0.03, 0.0, 0.0)], 0.5 * SIDE, label="one")
        add_boxes(builder, [(-0.03, 0.0, 0.0)], 0.5 * SIDE, label="other", xform=((0.0, 0.0, 0.0), turn))
        assert refusal(builder) == said


def test_worlds_may_lie_on_each_other():
    world = new_builder()
    warpmag.add_balls(world, [(0.0, 0.0, 0.0), (0.1, 0.0, 0.0)], R, label="ball")
    builder = newton.ModelBuilder()
    builder.replicate(world, 50)
    assert refusal(builder) == ""
    warpmag.add_balls(world, [(0.1, 0.0, 0.0)], R, label="copy")
    builder.add_world(world)
    assert refusal(builder).endswith(SAME)


@pytest.mark.parametrize("side", [12, pytest.param(47, marks=pytest.mark.long)])  # 1,728 and 103,823 balls
def test_many_balls_are_compared_with_those_beside_them(side):
    """All pairs of the larger pile would be 5e9; told in the log is what the check takes."""
    grid = 2.002 * R * np.stack(np.unravel_index(np.arange(side**3), (side,) * 3), axis=1)
    builder = new_builder()
    warpmag.add_balls(builder, grid, R, label="ball")
    model = builder.finalize(device="cpu")
    magnets, poses = find_magnets(model)[0], model.body_q.numpy()
    began = time.process_time()
    check_places(model, magnets, "xpbd")
    print(f"{len(grid)} balls: {time.process_time() - began:.3f} s of CPU")
    poses[1700, :3] = poses[123, :3]
    model.body_q.assign(poses)
    with pytest.raises(InputError, match=f"^ball_123 and ball_1700: {SAME}$"):
        check_places(model, magnets, "xpbd")
    poses[:, :3] = 0.0
    model.body_q.assign(poses)
    with pytest.raises(InputError, match=SAME):
        check_places(model, magnets, "xpbd")
