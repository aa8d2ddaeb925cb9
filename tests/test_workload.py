"""Moments of each body, and the time of a step by part, body and world."""

import newton
import numpy as np
import pytest
import warp as wp

import warpmag
from warpmag.engine.magnets.workload import moments_line
from warpmag.errors import InputError


def model_of(device, worlds=2):
    """A plate, a disc magnet above it that touches a part of it, and a ball far away, in each world."""
    world = newton.ModelBuilder()
    warpmag.register_custom_attributes(world)
    plate = world.add_body(label="plate")
    world.add_shape_box(plate, hx=0.02, hy=0.01, hz=0.002, label="plate")
    warpmag.add_inducible(world, body=plate, moment_spacing=0.004)
    disc = world.add_body(xform=wp.transform((0.015, 0.0, 0.0045), wp.quat_identity()))
    world.add_shape_cylinder(disc, radius=0.005, half_height=0.0025, label="disc")
    warpmag.add_permanent(world, body=disc, magnetization=(0.0, 0.0, 1e6))
    ball = world.add_body(xform=wp.transform((0.2, 0.0, 0.0), wp.quat_identity()))
    world.add_shape_sphere(ball, radius=0.005, label="ball")
    warpmag.add_inducible(world, body=ball)
    builder = newton.ModelBuilder()
    builder.replicate(world, worlds)
    return builder.finalize(device=device)


def test_workload_names_the_costliest_body_and_leaves_the_results(device):
    model = model_of(device)
    magnetics, state = warpmag.Magnetics(model), model.state()
    magnetics.apply(state)
    before = [magnetics.shape_moments(), magnetics.h_field([[0.0, 0.0, 0.1]], worlds=1), state.body_f.numpy()]
    load = magnetics.workload()
    parts = {"neighbors", "sources", "permanent moments", "pairs of cells", "evaluations", "forces"}
    assert set(load.seconds) == parts
    assert all(seconds > 0.0 for seconds in load.seconds.values())
    assert sum(body.seconds for body in load.bodies) == pytest.approx(sum(load.seconds.values()))
    assert list(load.world_seconds) == [0, 1] or list(load.world_seconds) == [1, 0]
    plates, others = load.bodies[:2], load.bodies[2:]
    assert [body.label for body in plates] == ["plate"] * 2
    assert {(body.label, body.moments, body.near_cells) for body in others} == {("disc", 8, 0), ("ball", 1, 0)}
    moments = magnetics.system.count // 2 - 9
    for plate in plates:
        assert plate.moments == moments and 0 < plate.near_cells < moments
    assert "plate, world" in str(load)
    state.clear_forces()
    magnetics.add_forces(state)
    after = [magnetics.shape_moments(), magnetics.h_field([[0.0, 0.0, 0.1]], worlds=1), state.body_f.numpy()]
    for old, new in zip(before, after, strict=True):
        np.testing.assert_array_equal(new, old)


def test_workload_needs_a_solve(device):
    with pytest.raises(InputError, match="there is no field yet"):
        warpmag.Magnetics(model_of(device)).workload()


def test_the_number_of_moments_in_words():
    magnetics = warpmag.Magnetics(model_of("cpu", worlds=1))
    count = magnetics.system.count
    assert moments_line(magnetics) == f"{count} in 3 bodies, at most {count - 9} in one body: plate"


def test_the_number_of_moments_of_one_body_in_words():
    builder = newton.ModelBuilder()
    warpmag.register_custom_attributes(builder)
    ball = builder.add_body()
    shape = builder.add_shape_sphere(ball, radius=0.005, label="ball")
    warpmag.add_inducible(builder, shape=shape)
    magnetics = warpmag.Magnetics(builder.finalize(device="cpu"))
    assert moments_line(magnetics) == "1 in 1 body: ball"
