"""Steps, substeps and buffers of a simulation."""

import math
import re
import time

import newton
import numpy as np
import pytest
import warp as wp

import warpmag
from warpmag.declarations.magnets import Magnet, MagneticSettings
from warpmag.engine.pile_xpbd.contacts import RigidSolver, body_sizes
from warpmag.engine.stepping.held_bodies import find_held
from warpmag.engine.stepping.simulation import Simulation
from warpmag.engine.stepping.statistics import Statistics
from warpmag.engine.stepping.stepper import OVERLAP_LIMIT, TRAVEL_LIMIT, Stepper
from warpmag.kernels.rigid.monitor import UNCONSTRAINED_WEIGHT
from warpmag.kernels.shared.scan import launch_scan
from warpmag.scenes_usd import authoring

R = 0.005  # m
G = 9.81  # m/s²


def at(*position):
    return wp.transform(position, wp.quat_identity())


def add_ball(builder, position, velocity=(0.0, 0.0, 0.0), **arguments):
    body = builder.add_body(xform=at(*position), **arguments)
    builder.body_qd[body] = wp.spatial_vector(*velocity, 0.0, 0.0, 0.0)
    builder.add_shape_sphere(body, radius=R)
    warpmag.add_inducible(builder, body=body)
    return body


def pile(lift=0.0):
    """Eight iron balls on the ground below a fixed magnet."""
    builder = newton.ModelBuilder()
    builder.default_shape_cfg = newton.ModelBuilder.ShapeConfig(density=7874.0, mu=0.0, mu_torsional=0.0)
    warpmag.register_attributes(builder)
    builder.add_ground_plane()
    for x in (0, 1):
        for y in (0, 1):
            for z in (0, 1):
                add_ball(builder, (2.002 * R * x, 2.002 * R * y, R + 2.002 * R * z + lift), label=f"ball_{x}{y}{z}")
    magnet = builder.add_shape_box(-1, xform=at(R, R, 0.045), hx=0.01, hy=0.01, hz=0.01)
    warpmag.add_permanent(builder, shape=magnet, magnetization=(0.0, 0.0, 1e6), moment_spacing=0.005)
    return builder


def run(simulation, steps):
    for _ in range(steps):
        simulation.step()
    return simulation.state.body_q.numpy().copy()


def advance(stepper, steps=1):
    """Reports of some steps."""
    reports = []
    for _ in range(steps):
        stepper.advance()
        reports += stepper.read_reports()
    return reports


@pytest.fixture(scope="module")
def reference(device):
    """The pile after 30 steps, in which the balls have hit the magnet."""
    simulation = Simulation(pile(), device=device)
    return run(simulation, 30), simulation


def test_balls_jump_to_the_magnet(reference):
    poses, simulation = reference
    assert (poses[:, 2] > 0.02).all()
    assert simulation.statistics.peak_speed > 0.5
    assert simulation.time == pytest.approx(0.03)
    assert simulation.finish().held == 8


def test_a_run_repeats_bit_by_bit_with_and_without_graphs(device):
    simulations = [Simulation(pile(), device=device, graphs=graphs) for graphs in (True, True, False)]
    first, *others = [(run(simulation, 30), simulation.state.body_qd.numpy()) for simulation in simulations]
    for other in others:
        np.testing.assert_array_equal(other[0], first[0])
        np.testing.assert_array_equal(other[1], first[1])


def hinged_ball():
    builder = newton.ModelBuilder()
    warpmag.register_attributes(builder)
    ball = builder.add_link()
    builder.add_shape_sphere(ball, radius=R)
    warpmag.add_inducible(builder, body=ball)
    builder.add_articulation([builder.add_joint_revolute(-1, ball)])
    return builder


def test_bodies_with_joints_move(device):
    simulation = Simulation(hinged_ball(), device=device)
    np.testing.assert_allclose(run(simulation, 5)[0, :3], 0.0, atol=1e-3 * R)
    assert simulation.statistics.steps == 5


def test_penetration_stays_small(reference):
    assert reference[1].statistics.overlap < 0.01


@pytest.mark.parametrize("ahead", [1, 15])
def test_buffers_that_overflow_are_grown_and_the_step_repeated(reference, device, ahead):
    builder = pile()
    for x, y in np.ndindex(3, 3):  # far away, and side by side: balls alone need no pairs
        builder.add_shape_capsule(builder.add_body(xform=at(2.01 * R * x, 2.01 * R * y, 1.0)), radius=R, half_height=R)
    model = builder.finalize(device=device)
    sizes = body_sizes(model)
    solver = RigidSolver(model, sizes, capacity=0.0)
    before = [buffer.limit for buffer in solver.buffers]
    stepper = Stepper(model, warpmag.Magnetics(model), solver, sizes, step=1e-3, longest_substep=5e-4)
    reports = []
    for _ in range(30 // ahead):
        for _ in range(ahead):
            stepper.advance()
        reports += stepper.read_reports()
    assert len(reports) == 30
    assert any(report.regrown for report in reports)
    assert all(after.limit >= limit for after, limit in zip(solver.buffers, before, strict=True))
    assert all(after.limit > limit for after, limit in zip(solver.buffers[:2], before[:2], strict=True))
    # Nothing was lost: the motion is the same, but for a repeated step's warm start, which differs within rtol.
    np.testing.assert_allclose(stepper.state.body_q.numpy()[:8, :3], reference[0][:, :3], atol=1e-3 * R)


def test_substeps_follow_the_speed(device):
    builder = newton.ModelBuilder(gravity=(0.0, 0.0, 0.0))
    warpmag.register_attributes(builder)
    add_ball(builder, (0.0, 0.0, 0.0), velocity=(15.0, 0.0, 0.0))  # 1.5 radii in a substep of 0.5 ms
    builder.add_shape_box(-1, xform=at(0.05, 0.0, 0.0), hx=0.001, hy=0.05, hz=0.05)
    model = builder.finalize(device=device)
    sizes = body_sizes(model)
    stepper = Stepper(
        model, warpmag.Magnetics(model), RigidSolver(model, sizes), sizes, step=1e-3, longest_substep=5e-4
    )
    [first] = advance(stepper)
    assert first.substeps == 4  # 15 m/s × 1 ms / 4 is 0.75 radii, a ball alone may move one
    assert first.travel == pytest.approx(UNCONSTRAINED_WEIGHT * 15.0 * 1e-3 / 4 / R, rel=1e-5)
    assert first.travel < TRAVEL_LIMIT < 2.0 * first.travel
    advance(stepper, 5)
    assert stepper.state.body_q.numpy()[0, 0] < 0.05  # it did not pass the wall, which is thinner than a step
    assert advance(stepper, 5)[-1].substeps == 2  # at rest again


def test_bodies_that_fly_together_need_no_short_substeps(device):
    """A clump in flight, and one that lies still: the same substeps, and up to rounding the same motion in it."""
    ends = []
    for speed in (0.0, 8.0):
        builder = newton.ModelBuilder(gravity=(0.0, 0.0, 0.0))
        builder.default_shape_cfg = newton.ModelBuilder.ShapeConfig(density=7874.0)
        warpmag.register_attributes(builder)
        for place in np.ndindex(2, 2, 2):
            add_ball(builder, 2.02 * R * np.array(place), velocity=(0.0, speed, 0.0))
        simulation = Simulation(builder, device=device, external_field=(0.0, 0.0, 8e4))
        ends.append(run(simulation, 20)[:, :3] - (0.0, 0.02 * speed, 0.0))
        assert simulation.statistics.substeps == 2 * simulation.statistics.steps
    assert np.abs(ends[0] - 2.02 * R * np.array(list(np.ndindex(2, 2, 2)))).max() > 0.01 * R  # they moved
    # 40 substeps of a position of 0.16 m in single precision
    assert np.abs(ends[1] - ends[0]).max() < 40 * np.spacing(np.float32(0.16))


def test_contacts_at_the_end_of_a_step_serve_the_next_one(device, monkeypatch):
    searches = []
    collide = RigidSolver.collide
    monkeypatch.setattr(RigidSolver, "collide", lambda *arguments: searches.append(collide(*arguments)))
    simulation = Simulation(pile(), device=device, graphs=False)
    run(simulation, 2)
    searches.clear()
    for _ in range(5):
        simulation.step()
    figures = simulation.statistics
    assert figures.substeps == 2 * figures.steps and not figures.repeated
    # two a step and not three, but for the first after the state was handed out, and might have been changed
    assert len(searches) == 11


def test_a_repeated_step_starts_from_the_magnetizations_at_its_begin(device, monkeypatch):
    """A repeated first solve takes 3 evaluations; from the magnetizations of the rejected attempt it took 6."""
    builder = newton.ModelBuilder(gravity=(0.0, 0.0, 0.0))
    warpmag.register_attributes(builder)
    for number in range(12):
        add_ball(builder, (0.0, 0.0, 2.02 * R * number))
    simulation = Simulation(builder, device=device, external_field=(0.0, 0.0, 8e4), graphs=False)
    system, starts, evaluations = simulation.magnetics.system, [], []
    induce = warpmag.Magnetics.induce

    def record(magnetics, *arguments, **options):
        starts.append([array.numpy().copy() for array in system.start_arrays()])
        induce(magnetics, *arguments, **options)
        evaluations.append(int(system.evaluations.numpy()[0]))

    monkeypatch.setattr(warpmag.Magnetics, "induce", record)
    for speeds in (np.zeros(12), np.linspace(-40.0, 40.0, 12)):  # with a cold start, and with a warm one
        velocities = simulation.state.body_qd.numpy()
        velocities[:, 0] = speeds
        simulation.state.body_qd.assign(velocities)
        starts.clear()
        evaluations.clear()
        before = simulation.statistics.repeated
        simulation.step()
        assert simulation.statistics.repeated > before
        dual, warm, _ = starts[0]
        repeated = next(k for k, start in enumerate(starts) if k and np.array_equal(start[0], dual))
        assert starts[repeated][1] == min(warm, 1)  # nothing is extrapolated
        assert evaluations[repeated] <= max(evaluations[0], 3)


def test_a_state_may_be_changed_between_steps(device):
    """Poses and velocities that a user sets count, in contacts too: as in a simulation that came there."""
    first, second = (Simulation(pile(), device=device) for _ in range(2))
    run(first, 30)
    run(second, 1)
    result = first.state
    for name in ("body_q", "body_qd", "joint_q", "joint_qd"):
        getattr(second.state, name).assign(getattr(result, name))
    for entry in (first, second):
        entry.magnetics.system.start_cold()
    # up to rounding: neighbours are listed in another order; with contacts of the state before it is 1e-3 radii
    np.testing.assert_allclose(run(second, 3), run(first, 3), atol=1e-4 * R)


@pytest.mark.parametrize(("speed", "substeps"), [(6.0, 2), (15.0, 4), (30.0, 8)])  # of which none, 2 and 2 share forces
def test_shared_forces_neither_lag_nor_lead(speed, substeps, device):
    """A ball flies past a magnet in substeps that share forces, and in so short ones that none are shared."""

    def fly_past(step):
        builder = newton.ModelBuilder(gravity=(0.0, 0.0, 0.0))
        builder.default_shape_cfg = newton.ModelBuilder.ShapeConfig(density=7874.0)
        warpmag.register_attributes(builder)
        magnet = builder.add_shape_sphere(-1, radius=R)
        warpmag.add_permanent(builder, shape=magnet, magnetization=(0.0, 0.0, speed * 1.1e6))
        add_ball(builder, (0.02, 0.0, 0.03), velocity=(0.0, 0.0, -speed))
        simulation = Simulation(builder, device=device, dt=step)
        pose = run(simulation, round(0.06 / speed / step))[0, :3]
        return pose, simulation.statistics

    (fine, _), (pose, figures) = fly_past(1.5e-4 / speed), fly_past(1e-3)
    deflection = 0.02 - fine[0]
    assert deflection > 0.2 * R
    assert figures.substeps == substeps * figures.steps
    # forces that lag, those where the first of these substeps starts, change the deflection by 2 % and more
    assert np.abs(pose - fine).max() < 0.005 * deflection


def test_substeps_follow_the_pressure(device):
    builder = newton.ModelBuilder(gravity=(0.0, 0.0, -4000.0))  # as strong as a magnet's pull on a ball
    builder.default_shape_cfg = newton.ModelBuilder.ShapeConfig(density=7874.0, mu=0.0)
    warpmag.register_attributes(builder)
    builder.add_ground_plane()
    for layer in range(20):
        add_ball(builder, (0.0, 0.0, R + 2.0 * R * layer))
    model = builder.finalize(device=device)
    sizes = body_sizes(model)
    stepper = Stepper(
        model, warpmag.Magnetics(model), RigidSolver(model, sizes), sizes, step=1e-3, longest_substep=5e-4
    )
    reports = advance(stepper, 20)
    assert max(report.substeps for report in reports) > 2
    assert max(report.overlap for report in reports) < OVERLAP_LIMIT
    assert max(report.travel for report in reports) < TRAVEL_LIMIT


def test_the_step_asked_for_is_the_step_done(device):
    builder = newton.ModelBuilder()
    warpmag.register_attributes(builder)
    add_ball(builder, (0.0, 0.0, 1.0))
    simulation = Simulation(builder, device=device, dt=4e-3)
    fallen = 1.0 - run(simulation, 25)[0, 2]
    assert simulation.time == pytest.approx(0.1)
    # Symplectic Euler with substeps h falls g t (t + h) / 2; substeps are at most 0.5 ms.
    assert fallen == pytest.approx(0.5 * G * 0.1 * (0.1 + 5e-4), rel=1e-4)


@pytest.mark.parametrize("speed", [math.nan, 2e7], ids=["not finite", "too fast"])
def test_a_state_that_is_not_finite_or_too_fast_stops_the_run(speed, device):
    simulation = Simulation(pile(), device=device)
    simulation.step()
    velocities = simulation.state.body_qd.numpy().copy()
    velocities[3, 0] = speed  # of ball_011; the others follow within a substep
    simulation.state.body_qd.assign(velocities)
    held = run(simulation, 0)
    for _ in range(2):  # each further step fails as well
        with pytest.raises(warpmag.SimulationError, match=r"step 2 \(0.002 s\): the state of ball_011 is not finite"):
            run(simulation, 3)
    assert simulation.time == pytest.approx(0.001)
    assert simulation.statistics.steps == 1
    np.testing.assert_array_equal(simulation.state.body_q.numpy(), held)


def test_a_state_that_is_mended_goes_on(device):
    broken, whole = (Simulation(pile(), device=device) for _ in range(2))
    start = [array.numpy().copy() for array in (broken.state.body_q, broken.state.body_qd)]
    broken.state.body_qd.fill_(math.nan)
    with pytest.raises(warpmag.SimulationError):
        run(broken, 2)
    for array, values in zip((broken.state.body_q, broken.state.body_qd), start, strict=True):
        array.assign(values)
    ends = [run(entry, 20) for entry in (broken, whole)]
    # induction starts from other moments, and ends within its error of the same ones
    np.testing.assert_allclose(*ends, atol=0.01 * R)
    assert broken.statistics.steps == 20


def test_what_finish_measures_changes_nothing(device):
    ends = []
    for measured in (False, True):
        simulation = Simulation(pile(), device=device)
        for _ in range(20):
            simulation.step()
            if measured:
                simulation.finish()
        ends.append(run(simulation, 0))
    np.testing.assert_array_equal(*ends)


def test_forces_of_free_joints_move_bodies(device):
    """v = F t/m and ω = τ t/I of a ball, I = 2/5 m R²; a kinematic one stays."""
    builder = newton.ModelBuilder(gravity=(0.0, 0.0, 0.0))
    warpmag.register_attributes(builder)
    ball, still = add_ball(builder, (0.0, 0.0, 1.0)), add_ball(builder, (1.0, 0.0, 1.0), is_kinematic=True)
    simulation = Simulation(builder, device=device)
    mass = builder.body_mass[ball]
    force, torque = np.array([1e-3, 0.0, 2e-3]), np.array([0.0, 3e-7, 0.0])
    simulation.control.joint_f.assign(np.tile(np.concatenate([force, torque]), 2))
    run(simulation, 20)
    velocities = simulation.state.body_qd.numpy()
    # float32 rounds in each of 40 substeps
    np.testing.assert_allclose(velocities[ball, :3], force * 0.02 / mass, rtol=5e-5, atol=1e-9)
    np.testing.assert_allclose(velocities[ball, 3:], torque * 0.02 / (0.4 * mass * R**2), rtol=5e-5, atol=1e-6)
    assert not velocities[still].any()


@pytest.mark.parametrize("how", ["raises", "fails later"])
def test_steps_that_cannot_be_captured_are_launched(device, how):
    ends = []
    for disturbed in (False, True):
        simulation = Simulation(pile(), device=device)
        step, grid = simulation._solver.step, wp.HashGrid(8, 8, 8, device=device)

        def disturb(*arguments, step=step, grid=grid):
            assert how != "raises" or not wp.get_device(device).is_capturing
            # a copy from pageable memory, with which CUDA makes no graph that has conditional nodes executable
            grid.build(wp.zeros(9, dtype=wp.vec3, device=device), 1.0)
            step(*arguments)

        if disturbed:
            simulation._solver.step = disturb
        ends.append(run(simulation, 30))
        assert simulation.statistics.steps == 30
        failed = disturbed and (how == "raises" or device != "cpu")
        assert (simulation._stepper._graph is None) == failed == bool(simulation.capture_failure)
    np.testing.assert_array_equal(*ends)


def test_steps_with_near_contacts_are_captured(device):
    simulation = Simulation(pile(), device=device, contact_model="multipole")
    run(simulation, 3)
    assert simulation._stepper._graph is not None and not simulation.capture_failure


def test_times_of_the_stages_add_up_to_that_of_the_step(device):
    simulation = Simulation(pile(), device=device)
    run(simulation, 5)
    began = time.perf_counter()
    run(simulation, 20)
    seconds = time.perf_counter() - began
    stages = 20 * 1e-3 * np.array(simulation.statistics.milliseconds_since(5))
    assert (stages > 0.0).all()
    assert stages.sum() < 2.0 * seconds  # the right unit; what is left is the host's


def test_steps_allocate_nothing(device):
    simulation = Simulation(pile(), device=device)
    run(simulation, 1)
    texts = []
    with wp.ScopedMemoryTracker("steps", report_func=texts.append) as tracker:
        tracker.clear()
        for _ in range(20):
            simulation.step()
        assert simulation.statistics.repeated > 0  # nor do steps that are done again
    assert re.search(r"Total allocations:\s+Peak usage:", texts[0]), texts[0]


@pytest.mark.parametrize("count", [1, 2047, 2048, 2049, 10000])
@pytest.mark.parametrize("inclusive", [True, False])
def test_scan(device, count, inclusive):
    numbers = np.random.default_rng(count).integers(0, 1000, count).astype(np.int32)
    expected = np.cumsum(numbers) - (0 if inclusive else numbers)
    values, sums = wp.array(numbers, device=device), wp.zeros(count, dtype=wp.int32, device=device)
    launch_scan(values, sums, inclusive)
    np.testing.assert_array_equal(sums.numpy(), expected)
    launch_scan(values, values, inclusive)
    np.testing.assert_array_equal(values.numpy(), expected)


def test_bad_scenes_are_refused(device):
    builder = newton.ModelBuilder()
    warpmag.register_attributes(builder)
    add_ball(builder, (math.nan, 0.0, 0.0), label="lost")
    with pytest.raises(warpmag.InputError, match="lost: position or orientation is not finite"):
        Simulation(builder, device=device)
    with pytest.raises(warpmag.InputError, match="solver: 'magic' is not one of xpbd, steel"):
        Simulation(pile(), device=device, solver="magic")
    with pytest.raises(warpmag.InputError, match="dt: must be positive"):
        Simulation(pile(), device=device, dt=0.0)
    with pytest.raises(warpmag.InputError, match="device: no 'cuda:99' here"):
        Simulation(pile(), device="cuda:99")
    with pytest.raises(warpmag.InputError, match="resume: needs an output, and a scene from a stage"):
        Simulation(pile(), device=device).run(1, resume=True)


def test_overlaps_at_the_start_are_counted(device):
    builder = newton.ModelBuilder()
    warpmag.register_attributes(builder)
    for x in (0.0, 1.9 * R, 3.9 * R):
        add_ball(builder, (x, 0.0, 0.0))
    simulation = Simulation(builder, device=device)
    assert simulation.statistics.overlapping == 1
    assert simulation.statistics.warnings() == ["1 pair of bodies overlaps at the start"]


def test_a_warning_counts_unconverged_solves():
    """Short substeps share a solve, so these are not numbers of substeps."""
    lines = [Statistics(substeps=6, unconverged=count).warnings() for count in (0, 1, 2)]
    words = ["1 induction solve did not converge, in 6 substeps", "2 induction solves did not converge, in 6 substeps"]
    assert lines == [[], words[:1], words[1:]]


def test_gaps_follow_the_size_of_the_bodies(reference):
    gaps = reference[1].model.shape_gap.numpy()
    np.testing.assert_allclose(gaps, 0.1 * R, rtol=1e-6)


def test_who_is_held():
    # 0 ground, 1 magnet, 2 and 3 hang on it in a chain, 4 stands on the ground and touches 3, 5 flies
    fixed = np.array([True, True, False, False, False, False])
    holders = np.array([False, True, False, False, False, False])
    pairs = np.array([(1, 2), (3, 2), (3, 4), (0, 4)])
    assert np.flatnonzero(find_held(pairs, holders, fixed)).tolist() == [2, 3]
    assert not find_held(np.zeros((0, 2), int), holders, fixed).any()


def test_a_magnet_that_lies_on_the_ground_holds_what_touches_it():
    # 0 ground, 1 magnet on it, 2 touches both, 3 hangs on 1, 4 hangs on 3, 5 touches 2 and the ground, 6 touches 2
    fixed = np.array([True, False, False, False, False, False, False])
    holders = np.array([False, True, False, False, False, False, False])
    pairs = np.array([(0, 1), (1, 2), (0, 2), (3, 1), (4, 3), (2, 5), (5, 0), (2, 6)])
    assert np.flatnonzero(find_held(pairs, holders, fixed)).tolist() == [2, 3, 4]


def test_only_what_has_friction_resists_rolling(device, tmp_path):
    path = tmp_path / "materials.usda"
    stage = authoring.new_stage("Three materials", seconds=1.0)
    authoring.add_scene(stage, MagneticSettings())
    for number, friction in enumerate((0.0, 0.4, 0.4)):
        material = authoring.add_material(stage, f"Material_{number}", color=(1.0, 1.0, 1.0), friction=friction)
        authoring.add_ball(stage, f"/World/Ball_{number}", (0.1 * number, 0.0, 0.0), R, material, magnet=Magnet())
        if number != 1:  # as another tool would write it, who knows nothing of Newton's attributes
            for name in ("newton:rollingFriction", "newton:torsionalFriction"):
                material.GetPrim().RemoveProperty(name)
    authoring.save(stage, path)
    model = Simulation(path, device=device).model
    default = newton.ModelBuilder.ShapeConfig()
    rolling, spinning = model.shape_material_mu_rolling.numpy(), model.shape_material_mu_torsional.numpy()
    patch = authoring.CONTACT_PATCH
    np.testing.assert_allclose(rolling, [0.0, patch, default.mu_rolling], rtol=1e-6)
    np.testing.assert_allclose(spinning, [0.0, patch, default.mu_torsional], rtol=1e-6)
