"""Worlds that start again: the same bits as new ones, while others stay as they are."""

import newton
import numpy as np
import pytest
import warp as wp
from small_builders import R, add_ball, new_builder

import warpmag

H0 = (2e4, 0.0, 1e4)  # A/m
M = (0.0, 0.0, 8e5)  # A/m
WORLDS = 3


def world_of_touching_balls(**options):
    """Three inducible balls that nearly touch, a permanent one and a coil."""
    scene = new_builder(gravity=(0.0, 0.0, 0.0))
    for k in range(3):
        add_ball(scene, (2.02 * R * k, 0.1 * R * k, 0.0))
    add_ball(scene, (0.0, 3.0 * R, 0.5 * R), M)
    warpmag.add_coil(scene, shape="loop", radius=0.03, ampere_turns=20.0, label="coil")
    builder = newton.ModelBuilder(gravity=(0.0, 0.0, 0.0))
    builder.replicate(scene, WORLDS)
    return builder


def wrenches(magnetics, state):
    """Wrenches on the bodies by world, shape [worlds, 4, 6]."""
    state.clear_forces()
    magnetics.apply(state)
    return state.body_f.numpy().reshape(WORLDS, 4, 6).copy()


def move(state, step):
    """Move all balls by a smooth step, each in its own way."""
    poses = state.body_q.numpy().copy()
    poses[:, :3] += 2e-5 * np.sin(step + np.arange(poses[:, :3].size)).reshape(-1, 3)
    state.body_q.assign(poses)


def changed_by_its_user(magnetics, model, device):
    """Solve more often than the start of a solve depends on, then change currents, fields and magnetizations."""
    state = model.state()
    for step in range(5):
        move(state, step)
        wrenches(magnetics, state)
    magnetics.set_current("coil", [50.0, 60.0, 70.0])
    magnetics.set_external_field((0.0, 5e4, 0.0))
    model.warpmag.magnetization.fill_(wp.vec3(0.0, 1e6, 0.0))
    wrenches(magnetics, state)
    return state


@pytest.mark.filterwarnings("ignore:Magnetics. did not converge")  # the explicit dynamics needs more evaluations
@pytest.mark.parametrize("dynamics", ["theta", "theta-euler"])
def test_a_reset_world_has_the_bits_of_a_new_one(dynamics, device):
    builder = world_of_touching_balls()
    options = {"external_field": H0, "dynamics": dynamics, "rtol": 1e-4}
    results = {}
    for name in ("reset", "unchanged"):
        model = builder.finalize(device=device)
        magnetics = warpmag.Magnetics(model, **options)
        state = changed_by_its_user(magnetics, model, device)
        if name == "reset":
            magnetics.reset(worlds=[False, True, False])
            strengths = model.warpmag.strength.numpy()
            assert strengths[strengths > 0.0].tolist() == [50.0, 20.0, 70.0]
        results[name] = wrenches(magnetics, state)
    new = wrenches(warpmag.Magnetics(builder.finalize(device=device), **options), state)
    assert np.array_equal(results["reset"][1], new[1])
    assert np.array_equal(results["reset"][[0, 2]], results["unchanged"][[0, 2]])
    assert np.abs(new[1] - results["unchanged"][1]).max() > 0.1 * np.abs(new).max()


def test_contacts_of_multipoles_start_again(device):
    builder = world_of_touching_balls()
    model = builder.finalize(device=device)
    options = {"external_field": H0, "contact_model": "multipole"}
    magnetics = warpmag.Magnetics(model, **options)
    state = changed_by_its_user(magnetics, model, device)
    sweeps = {name: array for name, array in magnetics.persistent_arrays().items() if name.startswith("near.")}
    before = sweeps["near.sources"].numpy().copy()
    magnetics.reset(worlds=[False, True, False])
    after = sweeps["near.sources"].numpy()
    assert np.array_equal(after[[*range(4), *range(8, 12)]], before[[*range(4), *range(8, 12)]])
    assert before[4:7].any() and not after[4:7].any()
    # all worlds: sweeps go on until the last world has converged, and their number changes rounding
    magnetics.reset()
    new = warpmag.Magnetics(builder.finalize(device=device), **options)
    assert np.array_equal(wrenches(magnetics, state), wrenches(new, state))


def test_bodies_of_cells_start_again(device):
    scene = new_builder(gravity=(0.0, 0.0, 0.0))
    for k in range(2):
        body = scene.add_body(xform=wp.transform((0.021 * k, 0.0, 0.0), wp.quat_identity()))
        scene.add_shape_box(body, hx=0.01, hy=0.01, hz=0.01)
        warpmag.add_inducible(scene, body=body, moment_spacing=0.01)
    builder = newton.ModelBuilder(gravity=(0.0, 0.0, 0.0))
    builder.replicate(scene, 2)
    model = builder.finalize(device=device)
    magnetics, new = (warpmag.Magnetics(model, external_field=H0) for _ in range(2))
    state = model.state()
    for step in range(4):
        poses = model.body_q.numpy().copy()
        poses[:, 1] += 1e-7 * step * np.arange(4)  # less than a tensor is computed again for
        state.body_q.assign(poses)
        state.clear_forces()
        magnetics.apply(state)
    magnetics.reset(worlds=np.array([True, False]))
    results = []
    for source in (magnetics, new):
        state.clear_forces()
        source.apply(state)
        results.append(state.body_f.numpy()[:2].copy())
    assert np.array_equal(*results)


def test_reset_in_a_graph_reads_the_mask_of_each_launch(device):
    model = world_of_touching_balls().finalize(device=device)
    magnetics, state = warpmag.Magnetics(model, external_field=H0), model.state()
    mask = wp.zeros(WORLDS, dtype=wp.bool, device=device)
    wrenches(magnetics, state)
    magnetics.reset(worlds=mask)
    with wp.ScopedCapture(device) as capture:
        magnetics.reset(worlds=mask)
    warm = magnetics.persistent_arrays()["induction.warm"]
    for chosen in (2, 0):
        wrenches(magnetics, state)
        count = warm.numpy()
        mask.assign(np.arange(WORLDS) == chosen)
        wp.capture_launch(capture.graph)
        assert np.array_equal(warm.numpy(), np.where(np.arange(WORLDS) == chosen, 0, count))


def test_a_simulation_resets_worlds(device):
    scene = new_builder()
    scene.add_ground_plane()
    add_ball(scene, (0.0, 0.0, 1.5 * R))
    add_ball(scene, (2.5 * R, 0.0, 1.5 * R))
    builder = newton.ModelBuilder()
    builder.replicate(scene, WORLDS)
    simulation = warpmag.Simulation(builder, external_field=H0, device=device)
    start, poses = simulation.state.body_q.numpy().copy(), []
    for _ in range(30):
        simulation.step()
        poses.append(simulation.state.body_q.numpy().copy())
    velocities = simulation.state.body_qd.numpy().copy()
    simulation.reset(worlds=[False, True, False])
    assert np.array_equal(simulation.state.body_q.numpy()[2:4], start[2:4])
    assert not simulation.state.body_qd.numpy()[2:4].any()
    others = [0, 1, 4, 5]
    assert np.array_equal(simulation.state.body_q.numpy()[others], poses[-1][others])
    assert np.array_equal(simulation.state.body_qd.numpy()[others], velocities[others])
    for step in range(30):
        simulation.step()
        assert np.array_equal(simulation.state.body_q.numpy()[2:4], poses[step][2:4])
    simulation.reset()
    assert np.array_equal(simulation.state.body_q.numpy(), start)


@pytest.mark.parametrize("mask", [[1, 0, 0], [True, False], "all", [[True], [True, False]], np.ones((3, 1), bool)])
def test_other_masks_are_refused(mask, device):
    magnetics = warpmag.Magnetics(world_of_touching_balls().finalize(device=device))
    with pytest.raises(warpmag.InputError, match="^worlds: "):
        magnetics.reset(worlds=mask)
