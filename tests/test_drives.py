"""Joints, their drives and weak pulls: periods and paths against closed forms, with each solver."""

import math
import sys
from dataclasses import replace

import newton
import numpy as np
import pytest
import warp as wp
from scipy.integrate import solve_ivp

import warpmag
from warpmag.engine.pile_xpbd import solvers
from warpmag.engine.pile_xpbd.xpbd import PileXPBD
from warpmag.engine.stepping.model_checks import joint_gaps
from warpmag.engine.stepping.simulation import Simulation
from warpmag.errors import InputError

G, MU0 = 9.81, 4e-7 * math.pi  # m/s², H/m
STEP = 1e-3  # s
EXTENT = np.array((0.01, 0.002, 0.001))  # half of it, of a bar or a needle [m]
SLOW = [pytest.param(name, marks=pytest.mark.long) for name in ("steel", "mujoco", "kamino")]  # to compile
SOLVERS = ["xpbd", "featherstone", *SLOW]
DRIVEN = ["xpbd", pytest.param("featherstone", marks=pytest.mark.long), *SLOW]


def scene(gravity=0.0):
    """A builder with a magnet that is too far to matter."""
    builder = newton.ModelBuilder(gravity=(0.0, 0.0, -gravity))
    warpmag.register_attributes(builder)
    far = builder.add_shape_sphere(-1, xform=wp.transform((5.0, 5.0, 5.0), wp.quat_identity()), radius=1e-3)
    warpmag.add_permanent(builder, shape=far, magnetization=(0.0, 0.0, 1.0))
    return builder


def hinge(builder, angle, arm=0.0, axis=(0.0, 1.0, 0.0), **drive):
    """A bar along x that is turned by ``angle`` about a hinge ``arm`` from its centre; its inertia about that."""
    bar, turn = builder.add_link(), wp.quat_from_axis_angle(wp.vec3(*axis), angle)
    builder.add_shape_box(bar, hx=EXTENT[0], hy=EXTENT[1], hz=EXTENT[2])
    end = wp.vec3(-arm, 0.0, 0.0)
    joint = builder.add_joint_revolute(-1, bar, child_xform=wp.transform(end, wp.quat_identity()), axis=axis, **drive)
    builder.add_articulation([joint])
    builder.joint_q[-1] = angle
    builder.body_q[bar] = wp.transform(-wp.quat_rotate(turn, end), turn)
    inertia = np.array(builder.body_inertia[bar]).reshape(3, 3) + builder.body_mass[bar] * arm**2 * np.diag((0, 1, 1))
    return bar, float(np.array(axis) @ inertia @ np.array(axis))


def angles(simulation, bar, axis, steps):
    """How far a bar is turned about an axis after each step [rad]."""
    results = []
    for step in range(steps + 1):
        if step:
            simulation.step()
        q = simulation.state.body_q.numpy()[bar, 3:].astype(float)
        results.append(2.0 * math.atan2(q[:3] @ axis, q[3]))
    return np.unwrap(results)


def swing(rate, angle, center, steps, law=math.sin):
    """The same of a rigid body whose angle φ from ``center`` obeys φ'' = -rate² law(φ)."""
    times = STEP * np.arange(steps + 1)
    ends = (0.0, times[-1])
    path = solve_ivp(
        lambda _, y: (y[1], -(rate**2) * law(y[0])), ends, (angle - center, 0.0), "DOP853", times, rtol=1e-9
    )
    return center + path.y[0]


def period(path):
    """Twice the mean time between two passages of zero [s]."""
    before = np.flatnonzero(np.diff(np.sign(path)))
    times = STEP * (before + path[before] / (path[before] - path[before + 1]))
    assert len(times) >= 2
    return 2.0 * np.diff(times).mean()


@pytest.fixture(params=SOLVERS)
def solver(request):
    if request.param == "mujoco":
        pytest.importorskip("mujoco_warp")
    return request.param


def compare(path, expected, center, scale):
    """Path within 1 % of the amplitude and period within 0.2 %: a substep has 0.5 ms, and a radian takes 36 ms.

    Positions run ahead by half a substep, since velocities take the whole of the first one.
    """
    np.testing.assert_allclose(path, expected, rtol=0, atol=0.01 * scale)
    assert period(path - center) == pytest.approx(period(expected - center), rel=2e-3)


def test_a_bar_hinged_at_its_end_swings_as_a_pendulum(solver, device):
    builder, center, wide = scene(G), math.pi / 2, math.radians(60)
    axis = np.array((0.0, 1.0, 0.0))
    bar, inertia = hinge(builder, center - wide, arm=EXTENT[0])
    rate, steps = math.sqrt(builder.body_mass[bar] * G * EXTENT[0] / inertia), 220
    simulation = Simulation(builder, solver=solver, device=device, dt=STEP)
    compare(angles(simulation, bar, axis, steps), swing(rate, center - wide, center, steps), center, wide)


def test_a_compass_needle_swings_about_north(solver, device):
    builder, field, wide = scene(), 40.0, math.radians(40)  # A/m, of the earth
    axis = np.array((0.0, 0.0, 1.0))
    needle, inertia = hinge(builder, wide, axis=tuple(axis))
    warpmag.add_permanent(builder, body=needle, magnetization=(4e5, 0.0, 0.0))
    moment = 4e5 * 8.0 * EXTENT.prod()
    simulation = Simulation(builder, solver=solver, device=device, dt=STEP, external_field=(field, 0.0, 0.0))
    rate, steps = math.sqrt(MU0 * moment * field / inertia), 220
    compare(angles(simulation, needle, axis, steps), swing(rate, wide, 0.0, steps), 0.0, wide)


def test_a_joint_outside_of_its_limits_goes_back_slowly(device):
    """As those of robots whose stages say where joints may be, and not where they start: no jump in one substep."""
    builder = scene()
    bar, _ = hinge(builder, 0.0, limit_lower=0.5, limit_upper=1.5)
    simulation = Simulation(builder, device=device, dt=STEP)
    path = angles(simulation, bar, (0.0, 1.0, 0.0), 300)
    assert np.diff(path).max() < 1.05 * 10.0 * STEP  # rad, _RETURN_RATE of kernels.contacts.joints
    assert path[100] > 0.499 and path[100:].min() > 0.499 and path.max() < 1.501
    assert simulation.statistics.substeps == 600


def test_ends_of_a_joint_that_are_apart_close_slowly(device):
    builder = scene()
    bar, _ = hinge(builder, 0.0, arm=EXTENT[0])
    builder.body_q[bar] = wp.transform((0.3, 0.0, 0.2), wp.quat_identity())
    simulation = Simulation(builder, device=device, dt=STEP)
    gap = math.hypot(0.3 - EXTENT[0], 0.2)
    (warning,) = simulation.warnings()
    assert warning.startswith(f"{builder.joint_label[-1]}: its ends are {gap:.3g} m apart at the start")
    apart, spins = [], []
    for _ in range(400):
        simulation.step()
        pose = wp.transform(*simulation.state.body_q.numpy()[bar].tolist())
        apart.append(wp.length(wp.transform_point(pose, wp.vec3(-EXTENT[0], 0.0, 0.0))))
        spins.append(simulation.state.body_qd.numpy()[bar, 3:])
    assert np.abs(np.diff(apart)).max() < 1.05 * 2.0 * STEP  # m, _CLOSING
    assert max(apart[-50:]) < 1e-3
    assert np.isfinite(spins).all()


def test_ends_of_joints_that_newton_places_are_not_apart():
    """All kinds at odd places, of bodies that hang from others, against Newton's forward kinematics."""
    builder, parent, random = scene(), -1, np.random.default_rng(3)
    kinds = {"revolute": 1, "prismatic": 1, "ball": 4, "fixed": 0, "free": 7}
    for kind in kinds:
        frames = {
            f"{end}_xform": wp.transform(random.normal(size=3), wp.normalize(wp.quat(*random.normal(size=4))))
            for end in ("parent", "child")
        }
        body = builder.add_link(mass=1.0, inertia=wp.mat33(np.eye(3)))
        axis = {"axis": wp.normalize(wp.vec3(*random.normal(size=3)))} if kinds[kind] == 1 else {}
        joint = getattr(builder, f"add_joint_{kind}")(parent=parent, child=body, **frames, **axis, label=kind)
        start = builder.joint_q_start[joint]
        values = random.normal(size=kinds[kind])
        values[-4:] /= np.linalg.norm(values[-4:]) if len(values) >= 4 else 1.0  # a quaternion
        builder.joint_q[start : start + kinds[kind]] = values.tolist()
        parent = body
    builder.add_articulation(list(range(len(kinds))))
    model = builder.finalize(device="cpu")
    assert list(joint_gaps(model)) == ["revolute", "prismatic", "ball", "fixed"]
    state = model.state()
    newton.eval_fk(model, model.joint_q, model.joint_qd, state)
    model.body_q.assign(state.body_q)
    assert not joint_gaps(model)


@pytest.mark.parametrize("solver", DRIVEN, indirect=True)
def test_a_drive_is_a_spring_of_its_gain(solver, device):
    if solver == "kamino":
        pytest.skip("its drives are stiffer than their gains, as it says")
    builder, wide, rate, steps = scene(), 0.5, 25.0, 220
    axis = np.array((0.6, 0.8, 0.0))
    bar, inertia = hinge(builder, wide, arm=EXTENT[0], axis=tuple(axis))
    builder.joint_target_ke[-1], builder.joint_target_kd[-1] = inertia * rate**2, 0.0
    builder.joint_target_mode[-1] = int(newton.JointTargetMode.POSITION)
    simulation = Simulation(builder, solver=solver, device=device, dt=STEP)
    expected = swing(rate, wide, 0.0, steps, law=float)
    if solver == "steel":  # its springs are implicit, which damps them in substeps of half a step
        expected *= np.exp(-0.5 * rate**2 * 0.5 * STEP * STEP * np.arange(steps + 1))
    compare(angles(simulation, bar, axis, steps), expected, 0.0, wide)


def servo(angle=0.0, rate=200.0):
    """A bar whose end is held level against gravity by a critically damped drive; the angle it sags by."""
    builder = scene(G)
    bar, inertia = hinge(builder, angle, arm=EXTENT[0], target_q=angle)
    builder.joint_target_ke[-1], builder.joint_target_kd[-1] = inertia * rate**2, 2.0 * inertia * rate
    builder.joint_target_mode[-1] = int(newton.JointTargetMode.POSITION)
    return builder, bar, builder.body_mass[bar] * G * EXTENT[0] / (inertia * rate**2)


@pytest.mark.parametrize("solver", DRIVEN, indirect=True)
def test_an_arm_holds_what_its_drive_holds(solver, device):
    builder, bar, sag = servo()
    path = angles(Simulation(builder, solver=solver, device=device, dt=STEP), bar, np.array((0.0, 1.0, 0.0)), 80)
    if solver == "kamino":  # stiffer than its gain, as it says
        assert 0.0 < path[-1] < sag
    else:
        assert path[-1] == pytest.approx(sag, rel=0.01)


ARM = """#usda 1.0
(
    defaultPrim = "World"
    metersPerUnit = 1
    upAxis = "Z"
)
def Xform "World" {
def PhysicsScene "Scene" {
    vector3f physics:gravityDirection = (0, 0, -1)
    float physics:gravityMagnitude = 9.81
}
def Xform "Robot" (prepend apiSchemas = ["PhysicsArticulationRootAPI"]) {
def Capsule "Arm" (
    prepend apiSchemas = ["PhysicsRigidBodyAPI", "PhysicsCollisionAPI", "PhysicsMassAPI", "WarpmagMagnetAPI"]
) {
    uniform token axis = "X"
    double radius = 0.002
    double height = 0.02
    float physics:mass = 0.01
}
def PhysicsRevoluteJoint "Shoulder" (prepend apiSchemas = ["PhysicsDriveAPI:angular"]) {
    rel physics:body1 = </World/Robot/Arm>
    uniform token physics:axis = "Y"
    point3f physics:localPos0 = (-0.01, 0, 0)
    point3f physics:localPos1 = (-0.01, 0, 0)
    float drive:angular:physics:stiffness = 0.002
    float drive:angular:physics:damping = 0.00002
    float drive:angular:physics:targetPosition = 10
}
}
}
"""


@pytest.mark.parametrize("solver", ["xpbd", "featherstone", *SLOW[1:]])
def test_a_stages_drive_holds_its_target(solver, device, tmp_path):
    if solver == "mujoco":
        pytest.importorskip("mujoco_warp")
    (tmp_path / "arm.usda").write_text(ARM)
    simulation = Simulation(tmp_path / "arm.usda", solver=solver, device=device, dt=STEP)
    angle = angles(simulation, 0, np.array((0.0, 1.0, 0.0)), 150)[-1]
    stiffness, target = math.degrees(0.002), math.radians(10.0)  # N·m/rad
    sag = 0.01 * G * 0.01 * math.cos(target) / stiffness
    if solver == "kamino":
        assert target < angle < target + sag
    else:
        assert angle - target == pytest.approx(sag, rel=0.02)


def test_targets_may_change_between_steps(device):
    builder, bar, sag = servo()
    axis = np.array((0.0, 1.0, 0.0))
    simulation = Simulation(builder, device=device, dt=STEP)
    before = angles(simulation, bar, axis, 80)[-1]
    simulation.control.joint_target_q.assign(np.array([-0.5], np.float32))
    raised = angles(simulation, bar, axis, 80)[-1]
    other = simulation.model.control()
    other.joint_target_q.fill_(0.5)
    simulation.control = other
    lowered = angles(simulation, bar, axis, 80)[-1]
    simulation.control = other  # the same again makes no new graph
    result = np.array((before, raised, lowered))
    np.testing.assert_allclose(result, (sag, sag * math.cos(0.5) - 0.5, sag * math.cos(0.5) + 0.5), atol=0.05 * sag)
    assert not simulation.capture_failure


def test_what_is_no_control_of_the_model_is_refused(device):
    simulation = Simulation(servo()[0], device=device)
    for wrong, message in (
        (None, "control: must be a newton.Control, got None"),
        (newton.Control(), "control: joint_"),
    ):
        with pytest.raises(InputError, match=message):
            simulation.control = wrong


def test_a_drive_along_a_slanted_axis(device):
    """A ball on a rail, hung on a spring: it swings about where that carries it."""
    builder, rate, steps, axis = scene(G), 25.0, 200, np.array((0.0, 0.6, 0.8))
    ball = builder.add_link()
    builder.add_shape_sphere(ball, radius=5e-3)
    builder.add_articulation([builder.add_joint_prismatic(-1, ball, axis=tuple(axis))])
    builder.joint_target_ke[-1], builder.joint_target_mode[-1] = builder.body_mass[ball] * rate**2, 1
    simulation = Simulation(builder, device=device, dt=STEP)
    path = []
    for _ in range(steps):
        simulation.step()
        path.append(simulation.state.body_q.numpy()[ball, :3].astype(float))
    sag, times = -G * axis[2] / rate**2, STEP * np.arange(1, steps + 1)
    np.testing.assert_allclose(np.array(path), np.outer(sag * (1.0 - np.cos(rate * times)), axis), atol=0.02 * abs(sag))


def weakly_pulled(other):
    """A builder with a ball under 0.15 m/s², and what makes the solver take another way."""
    builder = scene(0.15)
    ball = builder.add_body()
    builder.add_shape_sphere(ball, radius=5e-3)
    if other == "joint":
        hinge(builder, 0.0, arm=0.0)
        builder.body_q[-1] = builder.joint_X_p[-1] = wp.transform((1.0, 0.0, 0.0), wp.quat_identity())
    if other == "particle":
        builder.add_particle((1.0, 0.0, 0.0), (0.0, 0.0, 0.0), mass=1e-3)
    return builder, ball


@pytest.mark.parametrize("other", ["joint", "particle"])
def test_a_weak_pull_moves_a_body_from_rest(other, device):
    builder, ball = weakly_pulled(other)
    simulation = Simulation(builder, device=device, dt=STEP)
    for _ in range(150):
        simulation.step()
    fallen = -simulation.state.body_q.numpy()[ball, 2]
    assert fallen == pytest.approx(0.5 * 0.15 * 0.15**2, rel=0.01)


def test_a_weak_pull_moves_a_body_that_rebounds(device):
    builder, ball = weakly_pulled("")
    model = builder.finalize(device=device)
    now, then = model.state(), model.state()
    contacts = newton.CollisionPipeline(model).contacts()
    solver = PileXPBD(model, 16, iterations=10, enable_restitution=True)
    for _ in range(20):
        solver.step(now, then, None, contacts, 5e-4)
        now, then = then, now
    assert now.body_qd.numpy()[ball, 2] == pytest.approx(-0.15 * 20 * 5e-4, rel=1e-4)


def test_a_solver_that_is_not_installed_names_what_installs_it(device, monkeypatch):
    monkeypatch.setitem(sys.modules, "mujoco_warp", None)
    monkeypatch.setattr(newton.solvers.SolverMuJoCo, "_mujoco_warp", None)
    with pytest.raises(
        InputError, match=r"^solver mujoco: needs the extra 'sim' \(in a checkout pip install '\.\[sim\]', "
    ):
        Simulation(servo()[0], solver="mujoco", device=device)


@pytest.mark.parametrize(
    ("solver", "message"),
    [
        (
            "semi-implicit",
            "^joint_1: a body of the joint is too light for the solver semi-implicit, whose joints are",
        ),
        pytest.param("kamino", "^solver kamino: .*DISTANCE", marks=pytest.mark.long),
        ("vbd", "^solver vbd: .*DISTANCE"),
    ],
)
def test_what_a_solver_cannot_take_is_refused(solver, message, device):
    builder = servo()[0]
    if solver != "semi-implicit":
        ball = builder.add_link()
        builder.add_shape_sphere(ball, radius=5e-3)
        builder.add_joint_distance(-1, ball, max_distance=0.1)
    with pytest.raises(InputError, match=message):
        Simulation(builder, solver=solver, device=device)


def test_vbd_says_what_it_is_not_for(device, monkeypatch):
    """The kind of solver has the warning; kernels of VBD take long to compile."""
    kinds = solvers.SOLVERS
    monkeypatch.setitem(kinds, "vbd", replace(kinds["vbd"], make=kinds["xpbd"].make))
    simulation = Simulation(servo()[0], solver="vbd", device=device)
    assert any(line.startswith("solver vbd: bodies that magnets press together") for line in simulation.warnings())


@pytest.mark.long  # to compile
def test_vbd_makes_a_step(device):
    simulation = Simulation(servo()[0], solver="vbd", device=device)
    simulation.step()
    assert np.isfinite(simulation.state.body_q.numpy()).all()
