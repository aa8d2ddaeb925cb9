"""Sources that apply fields: coils and field maps; their field, what they do to magnets, and what these do to them."""

import math

import numpy as np
import pytest
import warp as wp

from warpmag import oracle
from warpmag.kernels.applied.sources import AppliedSource, SourceKind
from warpmag.probe import FieldProbe
from warpmag.system import MomentSystem

newton = pytest.importorskip("newton")
import warpmag  # noqa: E402

A = 0.02  # m, radius of coils
R = 0.005  # m
VOLUME = 4.0 / 3.0 * math.pi * R**3
SINGLE = 3e-6  # sums of some float32 terms, relative to the largest
LOOP = AppliedSource(SourceKind.LOOP, (A, 0.01 * A))


def field_of(source, points, device, strength=100.0, frame=(0, 0, 0, 0, 0, 0, 1)):
    """Field and gradient of one source, float64, by a probe beside a moment of zero."""
    system = MomentSystem(radii=[1e-9], permanent=[True], applied=[source], dtype="float64", device=device)
    system.sources.strengths.assign([[strength, 0.0, 0.0]])
    system.sources.frames.assign([frame])
    system.positions.assign([[1e3, 0.0, 0.0]])
    probe = FieldProbe(system, len(points), gradients=True)
    probe.points.assign(points)
    probe.measure()
    return probe.h.numpy(), probe.gradient.numpy()


def points_around(count=60, seed=0, scale=1.5 * A):
    """Points about a coil, some of them on its axis and close to it."""
    some = np.random.default_rng(seed).normal(size=(count, 3)) * scale
    some[:5, :2] = 0.0
    some[5:10, :2] *= 1e-9
    return some


def assert_gradients(source, device, points, **where):
    """Gradients are the derivatives of fields, by differences of fourth order."""
    step, tolerance = 1e-5 * A, 1e-8  # (1/160)⁴ of a derivative where the wire is nearest, and 1e-15/1e-5 of rounding
    _, gradient = field_of(source, points, device, **where)
    for axis, unit in enumerate(np.eye(3)):
        near, far = (
            [field_of(source, points + sign * n * step * unit, device, **where)[0] for sign in (1, -1)] for n in (1, 2)
        )
        slope = (8.0 * (near[0] - near[1]) - (far[0] - far[1])) / (12.0 * step)
        worst = np.abs(gradient[:, :, axis] - slope).max(axis=1) / np.abs(gradient).max(axis=(1, 2))
        assert worst.max() < tolerance


def test_field_of_a_loop_on_its_axis(device):
    z = np.linspace(-5.0 * A, 5.0 * A, 21)
    h, _ = field_of(LOOP, np.stack([0.0 * z, 0.0 * z, z], axis=1), device)
    np.testing.assert_array_equal(h[:, :2], 0.0)
    np.testing.assert_allclose(h[:, 2], 100.0 * A**2 / (2.0 * (A**2 + z**2) ** 1.5), rtol=1e-13)


def test_field_of_a_loop_beside_its_axis(device):
    magpylib = pytest.importorskip("magpylib")
    points = np.concatenate([points_around(), [[100.0, 3.0, -70.0], [1e-12, 0.0, 0.3 * A], [A, 0.0, 0.02 * A]]])
    h, _ = field_of(LOOP, points, device)
    expected = magpylib.current.Circle(current=100.0, diameter=2.0 * A).getH(points)
    assert (np.linalg.norm(h - expected, axis=1) < 1e-12 * np.linalg.norm(expected, axis=1)).all()


def test_gradient_of_a_loop_outside_and_inside_its_wire(device):
    around = A * np.array([[1.0, 0.0, 0.003], [1.004, 0.0, -0.002], [0.6, 0.802, 0.0], [0.0, -0.995, 0.001]])
    assert_gradients(LOOP, device, np.concatenate([points_around(), around]))
    turned = (0.1, -0.2, 0.3, 0.5, -0.5, 0.1, 0.7)
    length = np.linalg.norm(turned[3:])
    frame = (*turned[:3], *(q / length for q in turned[3:]))
    assert_gradients(LOOP, device, points_around(20) + frame[:3], frame=frame)


PUSHED = LOOP._replace(world=0, body=50, pushed=True)


def make_loaded_system(device):
    """Twelve balls beside a coil, four of them permanent, two of one body; the system and places."""
    rng = np.random.default_rng(5)
    places = np.array([[x, y, z] for x in (-1, 1) for y in (-1, 1) for z in (-1, 0, 1)]) * 2.3 * R
    places += rng.normal(size=places.shape) * 0.05 * R
    permanent = np.arange(12) >= 8
    system = MomentSystem(
        radii=np.full(12, R), permanent=permanent, bodies=[0, 0, *range(2, 12)], saturation=2e5, susceptibility=50.0,
        external_field=(1e3, 2e3, -5e2), applied=[PUSHED], dtype="float64", rtol=1e-11, device=device,
    )  # fmt: skip
    system.positions.assign(places)
    system.moments.assign(np.where(permanent[:, None], rng.normal(size=(12, 3)) * 3e4 * VOLUME, 0.0))
    system.sources.strengths.assign([[800.0, 0.0, 0.0]])
    return system, places


def test_gradient_of_the_energy_is_the_force(device):
    system, places = make_loaded_system(device)

    def energy(places, coil=(0.0, 0.0, 0.0)):
        system.positions.assign(places)
        system.sources.frames.assign([(*coil, 0.0, 0.0, 0.0, 1.0)])
        system.solve()
        assert system.converged.numpy()[0]
        return system.energy()[0]

    energy(places)
    system.apply_forces()
    forces, reaction = system.forces.numpy(), system.reactions.reaction_forces.numpy()[0]
    step = 1e-6  # m: the third derivative's part is (step/R)² of the force
    for ball, axis in ((0, 0), (3, 1), (7, 2), (8, 0), (11, 2)):
        moved = np.zeros((12, 3))
        moved[: 2 if ball == 0 else 0, axis] = moved[ball, axis] = step
        slope = (energy(places + moved) - energy(places - moved)) / (2.0 * step)
        force = forces[: 2 if ball == 0 else 1].sum(axis=0) if ball == 0 else forces[ball]
        assert abs(slope + force[axis]) < 1e-6 * np.abs(forces).max()
    for axis, unit in enumerate(np.eye(3)):
        slope = (energy(places, step * unit) - energy(places, -step * unit)) / (2.0 * step)
        assert abs(slope + reaction[axis]) < 1e-6 * np.abs(reaction).max()


@pytest.mark.parametrize("force", ["kelvin", "zeeman"])
def test_force_law(force, device):
    system, places = make_loaded_system(device)
    system.solve()
    system.apply_forces(force)
    found = system.forces.numpy()
    m, h = system.moments.numpy(), system.h.numpy()
    coil, own = field_of(LOOP, places, device, strength=800.0)
    labels = np.array([0, 0, *range(2, 12)])
    gradient = oracle.field_gradient(places, m, radii=R, bodies=labels) + own
    expected = oracle.kelvin_force(m, gradient)
    if force == "zeeman":
        magnetization, slope = oracle.magnetization(h, 2e5, 50.0)
        expected[:8] = oracle.zeeman_force(np.full(12, VOLUME), h, gradient, magnetization, slope)[:8]
    np.testing.assert_allclose(found, expected, atol=1e-9 * np.abs(expected).max())
    turning = oracle.h_field(places, m, radii=R, bodies=labels) + coil + (1e3, 2e3, -5e2)
    torques = oracle.torque(m, turning)
    np.testing.assert_allclose(system.torques.numpy()[8:], torques[8:], atol=1e-12 * np.abs(torques).max())


@pytest.mark.parametrize("force", ["kelvin", "zeeman"])
def test_reaction_is_opposite_and_equal(force, device):
    """Without the coil's part, the same moments feel other forces and torques; the coil feels the difference."""
    system, places = make_loaded_system(device)
    frame = (0.01, -0.02, 0.03, 0.0, 0.0, 0.6, 0.8)
    system.sources.frames.assign([frame])
    system.solve()
    system.apply_forces(force)
    coil, gradient = field_of(LOOP, places, device, strength=800.0, frame=frame)
    effective = system.moments.numpy() if force == "kelvin" else system._effective.numpy().T
    forces = oracle.kelvin_force(effective, gradient)
    torques = oracle.torque(effective, coil) + np.cross(places - frame[:3], forces)
    for found, expected in (
        (system.reactions.reaction_forces, forces),
        (system.reactions.reaction_torques, torques),
    ):
        np.testing.assert_allclose(found.numpy()[0], -expected.sum(axis=0), atol=1e-13 * np.abs(expected).sum())


def test_a_source_magnetizes_its_own_body_and_does_not_push_it(device):
    """A coil with a core: the core is a moment of its body."""
    for body in (0, 1):
        coil = LOOP._replace(world=0, body=body, pushed=True)
        system = MomentSystem(
            radii=[R], bodies=[0], applied=[coil], lone_torque=True, dtype="float64", rtol=1e-9, device=device
        )
        system.sources.strengths.assign([[100.0, 0.0, 0.0]])
        place = np.array([[0.3 * A, 0.0, 0.4 * A]])
        system.positions.assign(place)
        system.solve()
        system.apply_forces()
        h, gradient = field_of(LOOP, place, device)
        np.testing.assert_allclose(system.moments.numpy(), oracle.magnetization(h, 1.0)[0] * VOLUME)
        expected = oracle.kelvin_force(system.moments.numpy(), gradient) * body
        np.testing.assert_allclose(system.forces.numpy(), expected, rtol=1e-12)
        np.testing.assert_allclose(system.reactions.reaction_forces.numpy(), -expected, rtol=1e-12)


def test_each_world_has_its_sources(device):
    """One for all, one of the second world alone; the first is fixed, the second pushed."""
    everywhere, second = LOOP, LOOP._replace(world=1, body=9, pushed=True)
    system = MomentSystem(
        radii=[R, R, R], worlds=[0, 1, 1], saturation=1e9, applied=[everywhere, second], dtype="float64", rtol=1e-10,
        device=device,
    )  # fmt: skip
    places = np.array([[0.0, 0.0, 0.01], [0.0, 0.0, 0.01], [0.03, 0.0, 0.01]])
    system.positions.assign(places)
    system.sources.strengths.assign([[100.0, 0.0, 0.0], [-40.0, 0.0, 0.0]])
    system.solve()
    system.apply_forces()
    coil, gradient = field_of(LOOP, places, device, strength=1.0)
    m, strengths = system.moments.numpy(), np.array([100.0, 60.0, 60.0])
    np.testing.assert_allclose(m[0], 3.0 * VOLUME * 100.0 * coil[0], rtol=1e-6)  # of an Ms of 1e9 A/m
    np.testing.assert_allclose(system.sources.frames.numpy()[0], [0, 0, 0, 0, 0, 0, 1])
    found = system.forces.numpy()
    np.testing.assert_allclose(found[0], oracle.kelvin_force(m, strengths[:, None, None] * gradient)[0], atol=1e-15)
    push = -oracle.kelvin_force(m[1:], -40.0 * gradient[1:]).sum(axis=0)
    np.testing.assert_allclose(system.reactions.reaction_forces.numpy(), [[0, 0, 0], push], atol=1e-18)
    probe = FieldProbe(system, 2, worlds=[1, 0])
    probe.points.assign([[0.0, 0.0, 1.0]] * 2)
    probe.measure()
    alone = [
        oracle.h_field(places[rows], m[rows], np.array([[0.0, 0.0, 1.0]])) + strengths[rows][0]
        * field_of(LOOP, np.array([[0.0, 0.0, 1.0]]), device, strength=1.0)[0]
        for rows in (slice(1, 3), slice(0, 1))
    ]  # fmt: skip
    np.testing.assert_allclose(probe.h.numpy(), np.concatenate(alone), rtol=1e-9)


def new_builder(**arguments):
    builder = newton.ModelBuilder(**arguments)
    warpmag.register_attributes(builder)
    return builder


def add_ball(builder, position, magnetization=None, **arguments):
    """Add a ball, permanent if it has a magnetization, else inducible."""
    body = builder.add_body(xform=wp.transform(position, wp.quat_identity()), **arguments)
    builder.add_shape_sphere(body, radius=R)
    if magnetization is None:
        warpmag.add_inducible(builder, body)
    else:
        warpmag.add_permanent(builder, body, magnetization=magnetization)
    return body


def test_a_coil_on_a_body_feels_what_it_does(device):
    builder = new_builder()
    turn = wp.quat_from_axis_angle(wp.vec3(1.0, 0.0, 0.0), 0.3)
    coil_body = builder.add_body(xform=wp.transform((0.01, 0.02, 0.03), turn))
    builder.add_shape_box(coil_body, xform=wp.transform((0.0, 0.03, 0.0), wp.quat_identity()), hx=R, hy=R, hz=R)
    frame = wp.transform((0.0, 0.01, -0.01), wp.quat_from_axis_angle(wp.vec3(0.0, 1.0, 0.0), 0.5))
    warpmag.add_coil(builder, coil_body, radius=A, ampere_turns=800.0, xform=frame)
    balls = [add_ball(builder, (0.0, 0.0, 0.05)), add_ball(builder, (0.02, 0.01, 0.05), (0.0, 3e5, 1e5))]
    model = builder.finalize(device=device)
    magnetics, state = warpmag.Magnetics(model, rtol=1e-5), model.state()
    magnetics.apply(state)
    f = state.body_f.numpy().astype(float)
    centers = state.body_q.numpy()[:, :3].astype(float)
    centers[coil_body] = wp.transform_point(
        wp.transform(*state.body_q.numpy()[coil_body].tolist()), wp.vec3(*model.body_com.numpy()[coil_body].tolist())
    )
    assert np.abs(f[coil_body]).max() > 0.1 * np.abs(f[balls]).max()
    np.testing.assert_allclose(f[:, :3].sum(axis=0), 0.0, atol=SINGLE * np.abs(f[:, :3]).max())
    moments = f[:, 3:] + np.cross(centers, f[:, :3])
    np.testing.assert_allclose(moments.sum(axis=0), 0.0, atol=1e-5 * np.abs(moments).max())  # of rtol
    world = wp.transform(*model.body_q.numpy()[coil_body].tolist()) * frame
    points = np.random.default_rng(1).normal(size=(20, 3)) * 0.05
    magnetics.set_magnetization((0.0, 0.0, 0.0), body=balls[1])
    magnetics.induce(state)
    dipole = oracle.h_field(centers[balls], magnetics.system.moments.numpy().astype(float), points, radii=R)
    expected, _ = field_of(
        LOOP, points, device, strength=800.0, frame=tuple(np.array(world.p).tolist() + np.array(world.q).tolist())
    )
    np.testing.assert_allclose(magnetics.h_field(points), dipole + expected, atol=SINGLE * np.abs(expected).max())


def test_64_worlds_with_64_currents(device):
    world = new_builder()
    add_ball(world, (0.0, 0.0, 0.5 * A))
    warpmag.add_coil(world, radius=A, label="lift")
    builder = new_builder()
    builder.replicate(world, 64)
    warpmag.add_coil(builder, radius=2.0 * A, ampere_turns=5.0, label="everywhere")
    model = builder.finalize(device=device)
    magnetics, state = warpmag.Magnetics(model, rtol=1e-5), model.state()
    currents = np.random.default_rng(0).normal(size=64)
    on_axis = np.array([A**2 / (2.0 * (A**2 * (k + 0.25)) ** 1.5) * k for k in (1.0, 4.0)])
    for given in (currents, wp.array(-currents, dtype=wp.float32, device=device), 0.5):
        magnetics.set_current("lift", given)
        magnetics.induce(state)
        field = on_axis[0] * (given.numpy() if isinstance(given, wp.array) else np.asarray(given)) + 5.0 * on_axis[1]
        expected = np.broadcast_to(3.0 * VOLUME * field, 64)
        np.testing.assert_allclose(
            magnetics.shape_moments()[:, 2], expected, atol=1e-4 * 3.0 * VOLUME * np.abs(field).max()
        )
    for which, value, text in (
        ("lift", [1.0, 2.0], "must be 1 or 64 numbers"),
        ("lift", math.nan, "set_current"),
        ("nothing", 1.0, "'nothing' is no source"),
        (0, 1.0, "0 is no source"),
        ("lift", wp.zeros(1, dtype=wp.vec3, device=device), "Warp array of float32"),
    ):
        with pytest.raises(warpmag.InputError, match=text):
            magnetics.set_current(which, value)
