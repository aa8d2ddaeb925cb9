"""Hard cases of moving bodies: each ends with finite states and all bodies there, or stops and names step and body."""

import newton
import numpy as np
import pytest
import warp as wp

import warpmag
from warpmag.errors import SimulationError

R = 0.005  # m
G = 9.81  # m/s²


def add_ball(builder, place, velocity=(0.0, 0.0, 0.0), radius=R, magnetization=None, **body):
    index = builder.add_body(xform=wp.transform(wp.vec3(*place), wp.quat_identity()), **body)
    builder.body_qd[index] = wp.spatial_vector(*velocity, 0.0, 0.0, 0.0)
    builder.add_shape_sphere(index, radius=radius, cfg=newton.ModelBuilder.ShapeConfig(density=7870.0, mu=0.3))
    if magnetization is None:
        warpmag.add_inducible(builder, body=index)
    else:
        warpmag.add_permanent(builder, body=index, magnetization=magnetization)
    return index


def new_builder(ground=True):
    builder = newton.ModelBuilder()
    warpmag.register_attributes(builder)
    if ground:
        builder.add_ground_plane(cfg=newton.ModelBuilder.ShapeConfig(mu=0.3))
    return builder


def add_pile(builder, side=3, at=(0.0, 0.0, 0.0)):
    for place in np.ndindex(side, side, side):
        add_ball(builder, np.add(at, 2.002 * R * np.array(place) + (0.0, 0.0, R)))


def run(builder, device, seconds, **arguments):
    """Run and return the simulation; every state on the way is finite."""
    simulation = warpmag.Simulation(builder, device=device, **arguments)
    for _ in range(max(1, round(seconds / simulation.step_size))):
        simulation.step()
    figures = simulation.finish()
    assert np.isfinite(simulation.state.body_q.numpy()).all() and np.isfinite(simulation.state.body_qd.numpy()).all()
    assert np.isfinite([figures.error, figures.rms_speed, figures.overlap, figures.peak_speed]).all()
    return simulation


def spread(simulation):
    """Farthest ball from the middle of all [m]."""
    x = simulation.state.body_q.numpy()[:, :3]
    return np.linalg.norm(x - x.mean(axis=0), axis=1).max()


def test_a_magnet_shot_through_a_pile(device):
    """At 100 m/s a ball moves 3 mm in the shortest substep: the run goes on and says that it was too fast."""
    builder = new_builder()
    add_pile(builder)
    add_ball(builder, (-0.05, 2.0 * R, 3.0 * R), (100.0, 0.0, 0.0), 0.008, (0.0, 0.0, 1e6))
    simulation = run(builder, device, 0.003)
    assert simulation.statistics.capped
    assert any("too fast for the shortest substep" in line for line in simulation.statistics.warnings())


@pytest.mark.parametrize("step", [1e-6, 1e-5, 1e-4, 1e-2])
def test_steps_of_any_length(step, device):
    builder = new_builder()
    add_pile(builder)
    add_ball(builder, (2.0 * R, 2.0 * R, 0.05), magnetization=(0.0, 0.0, 1e6), radius=0.01, is_kinematic=True)
    simulation = run(builder, device, 5.0 * step, dt=step)
    assert simulation.time == pytest.approx(5.0 * step)
    assert simulation.statistics.overlap < 0.05 and spread(simulation) < 0.1


def test_a_magnet_1000_times_too_strong(device):
    """Forces up to a million times those of the scene: stopped by name, or finite and warned of."""
    builder = new_builder()
    add_pile(builder)
    add_ball(builder, (2.0 * R, 2.0 * R, 0.05), magnetization=(0.0, 0.0, 1e9), radius=0.01, is_kinematic=True)
    try:
        simulation = run(builder, device, 0.005)
    except SimulationError as error:
        assert "step " in str(error) and "body_" in str(error)
    else:
        assert simulation.statistics.capped and simulation.statistics.warnings()


@pytest.mark.parametrize("magnetization", [(0.0, 0.0, 0.0), (1e6, 0.0, 0.0)])
def test_only_permanent_magnets(magnetization, device):
    builder = new_builder()
    for x in (0.0, 3.0 * R, 6.0 * R):
        add_ball(builder, (x, 0.0, R), magnetization=magnetization)
    simulation = run(builder, device, 0.05)
    assert simulation.statistics.evaluations == [0] * 50 and spread(simulation) < 0.05


def test_far_from_the_origin(device):
    """At 10 km single precision knows positions to a fifth of a radius: the run is warned of, and stays finite."""
    builder = new_builder()
    add_pile(builder, 2, at=(1e4, 0.0, 0.0))
    simulation = run(builder, device, 0.01)
    assert any("far from the origin" in line for line in simulation.statistics.warnings())
    near = new_builder()
    add_pile(near, 2, at=(1.0, 0.0, 0.0))
    assert not run(near, device, 0.002).statistics.warnings()


def test_farther_than_single_precision_reaches(device):
    """At 1000 km positions are 63 mm apart: cells of a body coincide and induction would iterate to its limit."""
    builder = new_builder()
    add_ball(builder, (0.0, 0.0, R))
    add_ball(builder, (1e6, 0.0, R), label="far")
    with pytest.raises(warpmag.InputError, match=r"^far: is too far from the origin: positions .* 0.062 m apart"):
        warpmag.Simulation(builder, device=device)


def test_sheets_where_their_cells_would_overlap_at_random(device):
    """At 1 km positions are 0.061 mm apart: a solve of two such sheets, which touch, did not converge."""
    builder = new_builder()
    for height in (0.0, 1e-4):
        sheet = builder.add_body(xform=wp.transform((0.0, 0.0, 1e3 + height), wp.quat_identity()), label="sheet")
        builder.add_shape_box(sheet, hx=0.02, hy=0.02, hz=5e-5)
        warpmag.add_inducible(builder, body=sheet, susceptibility=1000.0)
    with pytest.raises(warpmag.InputError, match=r"^sheet: is too far .* over a quarter of its thickness of 5e-05 m$"):
        warpmag.Simulation(builder, device=device)


def test_worlds_of_different_size_side_by_side(device):
    """Three worlds at one place, 1, 8 and 27 balls under a field: each moves as it does alone, in as long substeps."""

    def world(side):
        builder = new_builder(ground=False)
        for place in np.ndindex(side, side, side):
            add_ball(builder, 2.5 * R * np.array(place))
        return builder

    def run_calmly(builder):
        simulation = run(builder, device, 0.01, external_field=(0.0, 0.0, 8e4))
        assert simulation.statistics.substeps == 2 * simulation.statistics.steps
        return simulation.state.body_q.numpy()[:, :3]

    together = newton.ModelBuilder()
    warpmag.register_attributes(together)
    for side in (1, 2, 3):
        together.add_world(world(side))
    alone = np.concatenate([run_calmly(world(side)) for side in (1, 2, 3)])
    start = np.concatenate([2.5 * R * np.array(list(np.ndindex(side, side, side))) for side in (1, 2, 3)])
    fallen = start - (0.0, 0.0, 0.5 * G * 0.01**2)
    moved = np.abs(alone - fallen).max()
    assert moved > 0.02 * R  # by magnetic forces, known to 2 rtol
    np.testing.assert_allclose(run_calmly(together), alone, atol=5e-3 * moved)


def test_balls_of_a_gas_of_denormal_speed(device):
    """Speeds and distances of 1e-41 are kept or flushed, never blown up."""
    builder = new_builder(ground=False)
    builder.gravity = wp.vec3(0.0, 0.0, 0.0)
    for k in range(4):
        add_ball(builder, (1e-41 * k, 3.0 * R * k, 0.0), (1e-41, 0.0, 0.0))
    assert spread(run(builder, device, 0.005)) < 0.03


def add_plate(builder, place, velocity=(0.0, 0.0, 0.0), tilt=0.02):
    """A plate of 4 x 4 boxes, 40 x 40 x 5 mm."""
    turn = wp.quat_from_axis_angle(wp.vec3(1.0, 0.0, 0.0), tilt)
    body = builder.add_body(xform=wp.transform(wp.vec3(*place), turn))
    builder.body_qd[body] = wp.spatial_vector(*velocity, 0.0, 0.0, 0.0)
    steel = newton.ModelBuilder.ShapeConfig(density=7870.0, mu=0.3)
    for x, y in np.ndindex(4, 4):
        at = wp.transform(wp.vec3(0.01 * (x - 1.5), 0.01 * (y - 1.5), 0.0), wp.quat_identity())
        builder.add_shape_box(body, xform=at, hx=0.005, hy=0.005, hz=0.0025, cfg=steel)
    warpmag.add_inducible(builder, body=body)


def test_plates_of_many_boxes_lie_on_each_other(device):
    """Some 250 contacts between two flat faces, that all push the same way, bring them to rest."""
    builder = new_builder()
    for z in (0.003, 0.009):
        add_plate(builder, (0.0, 0.0, z))
    simulation = run(builder, device, 0.05)
    state, figures = simulation.state, simulation.statistics
    assert np.abs(state.body_qd.numpy()).max() < 1e-3 and figures.overlap < 0.05
    np.testing.assert_allclose(state.body_q.numpy()[:, 2], [0.0025, 0.0075], atol=5e-5)


def test_plates_that_collide_keep_their_momentum(device):
    """A contact's impulses on two bodies are opposite, however many of them share the bodies."""
    builder = new_builder(ground=False)
    builder.gravity = wp.vec3(0.0, 0.0, 0.0)
    add_plate(builder, (0.0, 0.0, 0.0), (0.0, 0.0, 0.3), 0.0)
    add_plate(builder, (0.001, 0.015, 0.007), (0.0, 0.02, -0.1), 0.03)
    simulation = run(builder, device, 0.03)
    velocities = simulation.state.body_qd.numpy()[:, :3]
    assert velocities[1, 2] > 0.0  # they met
    # single precision, 60 substeps of 60 sums of contacts
    np.testing.assert_allclose(velocities.sum(axis=0), [0.0, 0.02, 0.2], atol=1e-5)


def test_a_chain_of_1000_balls(device):
    """A crooked chain of touching balls along the field, 10 m long, neither breaks nor folds up."""
    builder = new_builder(ground=False)
    builder.gravity = wp.vec3(0.0, 0.0, 0.0)
    crooked = 0.01 * R * np.random.default_rng(9).uniform(-1.0, 1.0, (1000, 2))
    for number, (y, z) in enumerate(crooked):
        add_ball(builder, (2.0 * R * (number - 500), y, z))
    simulation = run(builder, device, 0.01, external_field=(3e5, 0.0, 0.0))
    x = simulation.state.body_q.numpy()[:, :3].astype(float)
    gaps = np.linalg.norm(np.diff(x, axis=0), axis=1) / R - 2.0
    assert simulation.statistics.unconverged == 0 and simulation.statistics.overlap < 0.05
    assert np.abs(x[:, 1:]).max() < 0.05 * R and gaps.max() < 0.02


@pytest.mark.long
@pytest.mark.cuda
def test_100_000_balls_in_one_clump(device):
    """A block of balls below a magnet, far larger than any scene: nothing is lost in the first steps."""
    layer = newton.ModelBuilder()
    warpmag.register_attributes(layer)
    for place in np.ndindex(50, 50):
        add_ball(layer, 2.002 * R * np.array([*place, 0.5]))
    builder = new_builder()
    for number in range(40):  # in bulk: a ball at a time would take a minute
        builder.add_builder(layer, xform=wp.transform(wp.vec3(0.0, 0.0, 2.002 * R * number), wp.quat_identity()))
    add_ball(builder, (50.0 * R, 50.0 * R, 86.0 * R), magnetization=(0.0, 0.0, 1e6), radius=4.0 * R, is_kinematic=True)
    simulation = run(builder, device, 0.01)
    assert simulation.statistics.magnets == 100_000
    assert simulation.statistics.overlap < 0.05 and simulation.statistics.unconverged == 0
