"""Sources that apply fields: coils and field maps; their field, what they do to magnets, and what these do to them."""

import math

import numpy as np
import pytest
import warp as wp
from hypothesis import given
from hypothesis import strategies as st
from test_arguments_wild import STRANGE, chosen, refusals

from warpmag import oracle
from warpmag.kernels.applied.sources import AppliedSource, SourceKind
from warpmag.probe import FieldProbe
from warpmag.system import MomentSystem

newton = pytest.importorskip("newton")
import warpmag  # noqa: E402
from warpmag import coil_oracle  # noqa: E402
from warpmag.coils import Coil, FieldMap, SourceRecord  # noqa: E402

A = 0.02  # m, radius of coils
R = 0.005  # m
VOLUME = 4.0 / 3.0 * math.pi * R**3
SINGLE = 3e-6  # sums of some float32 terms, relative to the largest
HALF = 0.03  # m, half the length of solenoids
CORNERS = 2.5 * A * np.array([[-1.0, -0.5, 0.0], [1.0, -0.4, 0.1], [0.8, 0.6, 0.5], [-0.2, 0.3, -0.3]])


def source_of(record, **where):
    return AppliedSource(SourceKind[record.kind.upper()], record.parameters, record.table, **where)


LOOP = source_of(Coil(radius=A).record())
SOLENOID = source_of(Coil("solenoid", radius=A, length=2.0 * HALF).record())
POLYLINE = source_of(Coil("polyline", points=tuple(map(tuple, CORNERS)), wire_radius=0.01 * A).record())


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


def test_field_of_a_solenoid_on_its_axis(device):
    z = np.linspace(-5.0 * A, 5.0 * A, 21)
    h, _ = field_of(SOLENOID, np.stack([0.0 * z, 0.0 * z, z], axis=1), device)
    np.testing.assert_array_equal(h[:, :2], 0.0)
    ends = [(z + end) / np.hypot(z + end, A) for end in (HALF, -HALF)]
    np.testing.assert_allclose(h[:, 2], 100.0 / (4.0 * HALF) * (ends[0] - ends[1]), rtol=1e-12)


def test_field_of_a_solenoid_beside_its_axis(device):
    """A sheet of current is a magnetized cylinder, whose magnetization is left out."""
    magpylib = pytest.importorskip("magpylib")
    points = np.concatenate(
        [points_around(), A * np.array([[0.999999, 0.0, 0.5], [1.000001, 0.0, 0.5], [99.0, 0, 9.0]])]
    )
    h, _ = field_of(SOLENOID, points, device)
    along = np.array([0.0, 0.0, 100.0 / (2.0 * HALF)])
    inside = (np.hypot(points[:, 0], points[:, 1]) < A) & (np.abs(points[:, 2]) < HALF)
    cylinder = magpylib.magnet.Cylinder(magnetization=along, dimension=(2.0 * A, 2.0 * HALF))
    expected = cylinder.getH(points) + inside[:, None] * along
    assert (np.linalg.norm(h - expected, axis=1) < 1e-11 * np.linalg.norm(expected, axis=1)).all()


@pytest.mark.parametrize("kind", ["loop", "solenoid", "polyline"])
def test_field_is_that_of_the_law_of_biot_and_savart(kind, device):
    points = points_around(30)
    if kind == "loop":
        source, expected = LOOP, coil_oracle.loop_field(A, points)
    elif kind == "solenoid":
        source, expected = SOLENOID, coil_oracle.solenoid_field(A, 2.0 * HALF, points)
    else:
        source, expected = POLYLINE, coil_oracle.polyline_field(CORNERS[[0, 1, 2, 3, 0]], points, count=200)
    h, _ = field_of(source, points, device)
    # where the reference has converged
    far = np.abs(np.hypot(points[:, 0], points[:, 1]) - A) > 0.2 * A
    assert far.sum() > 20
    np.testing.assert_allclose(h[far], 100.0 * expected[far], atol=1e-9 * 100.0 / A)


def test_gradients_outside_and_inside_of_wires(device):
    around = A * np.array([[1.0, 0.0, 0.003], [1.004, 0.0, -0.002], [0.6, 0.802, 0.0], [0.0, -0.995, 0.001]])
    assert_gradients(LOOP, device, np.concatenate([points_around(), around]))
    edges = around + np.array([0.0, 0.0, HALF])
    assert_gradients(SOLENOID, device, np.concatenate([points_around(), edges, -edges]))
    beside = [0.3 * CORNERS[0] + 0.7 * CORNERS[1], CORNERS[2], CORNERS[3], 2.0 * CORNERS[1] - CORNERS[0]]
    assert_gradients(
        POLYLINE, device, np.concatenate([points_around(), beside + 1e-3 * A * np.array([3.0, -5.0, 4.0])])
    )


@pytest.mark.parametrize(("source", "place", "across"), [
    (LOOP, (A, 0.0, 0.0), (0.6, 0.0, 0.8)),
    (SOLENOID, (0.0, A, -HALF), (0.0, 0.8, -0.6)),
    (POLYLINE, 0.3 * CORNERS[0] + 0.7 * CORNERS[1], (0.0, 0.0, 1.0)),
    (POLYLINE, CORNERS[2], (0.6, 0.8, 0.0)),
])  # fmt: skip
def test_field_is_continuous_where_a_wire_begins_and_zero_on_its_axis(source, place, across, device):
    """From 1 % of the radius of the wire inside to as much outside it changes by no more than some per cent."""
    depths = 0.01 * A * np.array([0.99, 0.9999999, 1.0000001, 1.01, 1e-9])
    h, gradient = field_of(source, place + depths[:, None] * np.array(across), device)
    size = np.linalg.norm(h, axis=1)
    assert size[:4].min() > 0.3 * size.max()
    np.testing.assert_allclose(h[1], h[2], rtol=1e-5, atol=1e-5 * size[1])
    assert size[4] < 0.01 * size[1]  # of other pieces
    assert np.isfinite(gradient).all()
    centre, slope = field_of(source, np.array([place]), device)
    assert np.linalg.norm(centre) < 0.01 * size[1]
    assert np.isfinite(slope).all()


def test_gradients_of_turned_coils(device):
    turned = (0.1, -0.2, 0.3, 0.5, -0.5, 0.1, 0.7)
    length = np.linalg.norm(turned[3:])
    frame = (*turned[:3], *(q / length for q in turned[3:]))
    assert_gradients(LOOP, device, points_around(20) + frame[:3], frame=frame)


DIPOLE = np.zeros((1, 3)), np.array([[0.02, -0.05, 0.1]])  # m, A·m²
CORNER, SIDE = np.array([-0.02, -0.02, 0.03]), 0.04  # m, of a map beside it


def map_of_a_dipole(cells):
    """A map of a dipole's field, of so many cells along each side."""
    axes = [start + SIDE / cells * np.arange(cells + 1) for start in CORNER]
    places = np.stack(np.meshgrid(*axes, indexing="ij"), axis=-1)
    values = oracle.h_field(*DIPOLE, places.reshape(-1, 3)).reshape(places.shape)
    return source_of(FieldMap(tuple(CORNER), (SIDE / cells,) * 3, values).record())


def test_a_map_converges_to_the_field_that_it_is_of(device):
    """The field as the third power of the spacing, its gradient as the second, up to the border."""
    points = CORNER + SIDE * np.random.default_rng(2).uniform(size=(1000, 3))
    exact, errors = (oracle.h_field(*DIPOLE, points), oracle.gradient_at(*DIPOLE, points)), []
    for cells in (20, 40, 80):
        found = field_of(map_of_a_dipole(cells), points, device, strength=1.0)
        errors.append([np.linalg.norm(one - of) / np.linalg.norm(of) for one, of in zip(found, exact, strict=True)])
    errors = np.array(errors)
    assert errors[-1, 0] < 5e-6
    assert (errors[1:, 0] < errors[:-1, 0] / 7.0).all()  # 8 in the limit
    assert (errors[1:, 1] < errors[:-1, 1] / 3.8).all()  # 4


def test_a_map_is_exact_for_parabolas_and_its_gradient_is_its_own(device):
    """Also where no field could be so: the gradient is that of the interpolant, with a curl and a divergence."""
    rng = np.random.default_rng(4)
    linear, square = rng.normal(size=(3, 3)), rng.normal(size=(3, 3))
    origin, spacing, counts = np.array([0.1, -0.2, 0.0]), np.array([0.01, 0.02, 0.03]), (4, 3, 5)
    places = origin + spacing * np.stack(np.meshgrid(*map(np.arange, counts), indexing="ij"), axis=-1)
    record = FieldMap(tuple(origin), tuple(spacing), places @ linear + places**2 @ square, 1.0).record()
    points = origin + spacing * np.subtract(counts, 1) * rng.uniform(size=(50, 3))
    h, gradient = field_of(source_of(record), points, device, strength=2.0)
    np.testing.assert_allclose(h, 2.0 * (points @ linear + points**2 @ square), atol=1e-12)
    expected = 2.0 * (linear.T + 2.0 * points[:, None, :] * square.T)
    np.testing.assert_allclose(gradient, expected, atol=1e-10)
    some = FieldMap((0.0, 0.0, 0.0), (0.5 * A,) * 3, rng.normal(size=(5, 2, 4, 3))).record()
    assert_gradients(source_of(some), device, 0.5 * A * np.array([4.0, 1.0, 3.0]) * rng.uniform(0.01, 0.99, (40, 3)))
    outside = origin + spacing * np.array([[-0.001, 1.0, 1.0], [1.0, 2.001, 1.0], [1.0, 1.0, 4.001], [9e9, 0.0, 0.0]])
    h, gradient = field_of(source_of(record), np.concatenate([outside, [origin]]), device)
    assert not h[:4].any()
    assert not gradient[:4].any()
    assert h[4].any()


PUSHED = LOOP._replace(world=0, body=50, pushed=True)


def make_loaded_system(device, source=PUSHED):
    """Twelve balls beside a coil, four of them permanent, two of one body; the system and places."""
    rng = np.random.default_rng(5)
    places = np.array([[x, y, z] for x in (-1, 1) for y in (-1, 1) for z in (-1, 0, 1)]) * 2.3 * R
    places += rng.normal(size=places.shape) * 0.05 * R
    permanent = np.arange(12) >= 8
    system = MomentSystem(
        radii=np.full(12, R), permanent=permanent, bodies=[0, 0, *range(2, 12)], saturation=2e5, susceptibility=50.0,
        external_field=(1e3, 2e3, -5e2), applied=[source], dtype="float64", rtol=1e-11, device=device,
    )  # fmt: skip
    system.positions.assign(places)
    system.moments.assign(np.where(permanent[:, None], rng.normal(size=(12, 3)) * 3e4 * VOLUME, 0.0))
    system.sources.strengths.assign([[800.0, 0.0, 0.0]])
    return system, places


@pytest.mark.parametrize("kind", ["loop", "map"])
def test_gradient_of_the_energy_is_the_force(kind, device):
    """Of the interpolant of a map, too, which is rough: a field with a curl."""
    source = PUSHED
    if kind == "map":
        values = np.random.default_rng(7).normal(size=(4, 4, 4, 3))
        record = FieldMap((-0.05, -0.05, -0.05), (0.1 / 3.0,) * 3, 5.0 * values).record()
        source = source_of(record, world=0, body=50, pushed=True)
    system, places = make_loaded_system(device, source)

    def energy(places, coil=(0.0, 0.0, 0.0)):
        system.positions.assign(places)
        system.sources.frames.assign([(*coil, 0.0, 0.0, 0.0, 1.0)])
        system.solve()
        assert system.converged.numpy()[0]
        return system.energy()[0]

    energy(places)
    system.apply_forces()
    forces, reaction = system.forces.numpy(), system.applied.wrenches.numpy()[0, :3]
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
        (system.applied.wrenches.numpy()[0, :3], forces),
        (system.applied.wrenches.numpy()[0, 3:6], torques),
    ):
        np.testing.assert_allclose(found, -expected.sum(axis=0), atol=1e-13 * np.abs(expected).sum())


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
        np.testing.assert_allclose(system.applied.wrenches.numpy()[:, :3], -expected, rtol=1e-12)


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
    np.testing.assert_allclose(system.applied.wrenches.numpy()[:, :3], [[0, 0, 0], push], atol=1e-18)
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
    for set_to in (currents, wp.array(-currents, dtype=wp.float32, device=device), 0.5):
        magnetics.set_current("lift", set_to)
        magnetics.induce(state)
        field = on_axis[0] * (set_to.numpy() if isinstance(set_to, wp.array) else np.asarray(set_to)) + 5.0 * on_axis[1]
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


def test_force_of_a_gradient_coil_on_a_ball(device):
    """A Maxwell pair: opposite loops √3 radii apart, whose gradient is even to fourth order, in a uniform field."""
    gap = math.sqrt(3.0) * A
    gradient = 300.0 * 3.0 * A**2 * 0.5 * gap / (A**2 + 0.25 * gap**2) ** 2.5
    builder = new_builder()
    for sign in (-1, 1):
        frame = wp.transform((0.0, 0.0, 0.5 * sign * gap), wp.quat_identity())
        warpmag.add_coil(builder, radius=A, ampere_turns=sign * 300.0, xform=frame)
    iron = add_ball(builder, (0.0, 0.0, 1e-4))
    model = builder.finalize(device=device)
    magnetics, state = warpmag.Magnetics(model, external_field=(0.0, 0.0, 2000.0), rtol=1e-5), model.state()
    magnetics.apply(state)
    moment = 3.0 * VOLUME * (2000.0 + gradient * 1e-4)
    expected = [0.0, 0.0, oracle.MU0 * moment * gradient]
    # (1e-4/A)⁴ of the gradient's unevenness, rtol of the moment, and its curve's (3 H/Ms)²/3
    np.testing.assert_allclose(state.body_f.numpy()[iron, :3], expected, atol=3e-5 * expected[2])
    np.testing.assert_allclose(magnetics.field_gradient([[0.0, 0.0, 0.0]])[0], gradient * np.diag([-0.5, -0.5, 1.0]),
                               atol=SINGLE * gradient)  # fmt: skip


def test_momentum_of_a_coil_and_a_ball_is_kept_in_a_run(device):
    """Each pulls the other; the ball has fallen well into the coil at the end."""
    builder = new_builder(gravity=(0.0, 0.0, 0.0))
    coil = builder.add_body(mass=0.02, inertia=wp.mat33(*(2e-6 * np.eye(3)).ravel().tolist()), label="coil")
    warpmag.add_coil(builder, coil, shape="solenoid", radius=A, length=2.0 * HALF, ampere_turns=4000.0)
    ball = add_ball(builder, (0.003, 0.0, 0.05))
    simulation = warpmag.Simulation(builder, step=1e-3, device=device)
    mass, start = simulation.model.body_mass.numpy().astype(float), simulation.state.body_q.numpy()[:, :3].astype(float)
    for _ in range(60):
        simulation.step()
    velocity = simulation.state.body_qd.numpy()[:, :3].astype(float)
    moved = simulation.state.body_q.numpy()[:, :3].astype(float) - start
    assert moved[ball, 2] < -0.01
    assert moved[coil, 2] > 1e-4
    momentum = mass[:, None] * velocity
    assert np.linalg.norm(momentum.sum(axis=0)) < 1e-5 * np.linalg.norm(momentum[ball])  # 60 to 240 float32 substeps
    centre = (mass[:, None] * moved).sum(axis=0) / mass.sum()
    assert np.linalg.norm(centre) < 1e-5 * np.linalg.norm(moved[ball])


def test_a_coil_is_switched_in_a_graph(device):
    builder = new_builder()
    add_ball(builder, (0.0, 0.0, 0.5 * A))
    coil = warpmag.add_coil(builder, radius=A)
    model = builder.finalize(device=device)
    magnetics, state = warpmag.Magnetics(model, rtol=1e-5), model.state()
    current = wp.zeros(1, dtype=wp.float32, device=device)

    def work():
        state.clear_forces()
        magnetics.set_current(coil, current)
        magnetics.apply(state)

    work()
    with wp.ScopedCapture(device) as capture:
        work()
    per_ampere = A**2 / (2.0 * (1.25 * A**2) ** 1.5)
    for value in (200.0, 0.0, -400.0):
        current.assign([value])
        wp.capture_launch(capture.graph)
        found = magnetics.shape_moments()[0, 2], state.body_f.numpy()[0, 2]
        # the force is m dH/dz, of m = 3 V H: H'/H = -3 z/(A² + z²)
        force = oracle.MU0 * 3.0 * VOLUME * (per_ampere * value) ** 2 * -1.5 / (1.25 * A)
        np.testing.assert_allclose(found, (3.0 * VOLUME * per_ampere * value, force), rtol=1e-4)


def test_fixed_bodies_and_fixed_maps(device):
    """A kinematic coil is not pushed; one map serves all worlds; a magnetometer sees both."""
    world = new_builder()
    add_ball(world, (0.0, 0.0, 0.5 * A))
    holder = world.add_body(is_kinematic=True)
    warpmag.add_coil(world, holder, radius=A, ampere_turns=50.0)
    world.add_site(holder, xform=wp.transform((0.0, 0.0, -0.5 * A), wp.quat_identity()), label="hall")
    builder = new_builder()
    builder.replicate(world, 2)
    values = np.broadcast_to([30.0, 0.0, 0.0], (2, 2, 2, 3))
    warpmag.add_field_map(builder, (-1.0, -1.0, -1.0), 2.0, values, label="earth")
    model = builder.finalize(device=device)
    magnetics, state = warpmag.Magnetics(model), model.state()
    magnetics.apply(state)
    assert not state.body_f.numpy()[[1, 3]].any()
    assert np.abs(state.body_f.numpy()[[0, 2], 2]).min() > 0.0
    magnetics.set_current("earth", 2.0)
    magnetics.set_current("coil*", [50.0, 0.0])
    magnetics.apply(state)
    sensor = warpmag.SensorMagnetometer(model, magnetics, sites="hall")
    sensor.update(state)
    moments = magnetics.shape_moments().astype(float)
    for k, current in enumerate((50.0, 0.0)):
        dipole = oracle.h_field(np.array([[0.0, 0.0, 0.5 * A]]), moments[k : k + 1], np.array([[0.0, 0.0, -0.5 * A]]))
        expected = dipole[0] + [60.0, 0.0, current / (2.0 * 1.25**1.5 * A)]
        found = sensor.flux_density.numpy()[k] / oracle.MU0
        np.testing.assert_allclose(found, expected, atol=SINGLE * np.abs(expected).max())


def test_records_survive_as_text():
    for record in (
        Coil(radius=0.1).record(),
        Coil("polyline", points=tuple(map(tuple, CORNERS))).record(),
        FieldMap((0.0, 0.1, 0.2), (0.1, 0.2, 0.3), np.random.default_rng(0).normal(size=(2, 3, 4, 3))).record(),
    ):
        again = SourceRecord.from_text(record.to_text())
        assert (again.kind, again.parameters) == (record.kind, record.parameters)
        np.testing.assert_array_equal(again.table, record.table)


def test_what_ends_at_its_border():
    values = np.zeros((5, 5, 5, 3))
    values[2, 2, 2, 0] = 4.0
    values[0, 1, 1, 2] = -1.0
    assert FieldMap((0.0,) * 3, (1.0,) * 3, values).border() == 0.25
    assert FieldMap((0.0,) * 3, (1.0,) * 3, 0.0 * values).border() == 0.0


@pytest.mark.parametrize(("arguments", "text"), [
    ({"radius": 0.0}, "add_coil: radius: must be positive"),
    ({"radius": math.nan}, "add_coil: radius"),
    ({"radius": 1e-9}, "radius: must be from 1e-07"),
    ({"radius": A, "length": 1.0}, "length is given, but a loop has none"),
    ({"shape": "ring", "radius": A}, "shape: 'ring' is not one of loop, solenoid, polyline"),
    ({"shape": "solenoid", "radius": A}, "length: must be positive"),
    ({"radius": A, "points": [[0, 0, 0]]}, "points are given, but a loop has none"),
    ({"shape": "polyline"}, "points: must be at least 3"),
    ({"shape": "polyline", "points": [[0, 0, 0], [1, 0, 0]]}, "points: must be at least 3, got 2"),
    ({"shape": "polyline", "points": [[0, 0, 0], [1, 0, 0], [1, 0, 0]]}, "number 1 is not"),
    ({"shape": "polyline", "points": [[0, 0, 0], [1, 0, math.inf], [1, 0, 0]]}, "points: must be finite"),
    ({"shape": "polyline", "points": [[0, 0], [1, 0]]}, "points: must be vectors"),
    ({"shape": "polyline", "points": [[0, 0, 0], [1, 0, 0]], "closed": 1}, "closed: must be True or False"),
    ({"radius": A, "ampere_turns": math.inf}, "ampere turns: must be finite"),
    ({"radius": A, "ampere_turns": "many"}, "ampere turns: must be one real number"),
    ({"radius": A, "wire_radius": A}, "wire radius must be from 0 to 0.01"),
    ({"radius": A, "body": 7}, "body: 7 is out of range"),
    ({"radius": A, "xform": wp.transform((math.nan, 0.0, 0.0), wp.quat_identity())}, "xform: must be finite"),
    ({"radius": A, "xform": ((0.0, 0.0, 0.0), (0.0, 0.0, 0.0, 2.0))}, "xform: must be a place and a quaternion"),
    ({"radius": A, "label": 3}, "label: must be text"),
])  # fmt: skip
def test_coils_that_cannot_be(arguments, text):
    with pytest.raises(warpmag.InputError, match=text) as error:
        warpmag.add_coil(new_builder(), **arguments)
    assert "\n" not in str(error.value)


@pytest.mark.parametrize(("arguments", "text"), [
    ({"values": np.zeros((2, 2, 2))}, "shape must be"),
    ({"values": np.zeros((2, 1, 2, 3))}, "shape must be"),
    ({"values": np.full((2, 2, 2, 3), math.nan)}, "add_field_map: values: must be finite"),
    ({"values": "none"}, "add_field_map: values"),
    ({"spacing": 0.0}, "spacing: must be positive"),
    ({"spacing": (1.0, 1.0)}, "spacing: must be three numbers"),
    ({"spacing": 1e6, "values": np.zeros((20, 2, 2, 3))}, "reaches"),
    ({"origin": (0.0, math.nan, 0.0)}, "origin: must be finite"),
    ({"factor": math.nan}, "factor: must be finite"),
])  # fmt: skip
def test_maps_that_cannot_be(arguments, text):
    given = {"origin": (0.0, 0.0, 0.0), "spacing": 1.0, "values": np.zeros((2, 2, 2, 3))} | arguments
    with pytest.raises(warpmag.InputError, match=text):
        warpmag.add_field_map(new_builder(), **given)


WILD = {
    "add_coil": "body shape radius length points closed wire_radius ampere_turns xform label",
    "add_field_map": "origin spacing values body factor xform label",
}


@pytest.mark.parametrize("name", WILD)
@given(st.data())
def test_any_source(name, data):
    """What is taken makes a record of finite numbers."""
    builder, right = new_builder(), {"radius": A} if name == "add_coil" else {
        "origin": (0.0, 0.0, 0.0), "spacing": 1.0, "values": np.ones((2, 2, 2, 3))
    }  # fmt: skip
    with refusals():
        site = getattr(warpmag, name)(builder, **(right | chosen(data, WILD[name])))
        record = SourceRecord.from_text(builder.custom_attributes["warpmag:source"].values[site])
        assert np.isfinite(record.parameters).all()
        assert np.isfinite(record.table).all()
        assert np.isfinite(builder.custom_attributes["warpmag:strength"].values[site])


@given(st.data())
def test_any_current(wild_magnetics, data):
    with refusals():
        wild_magnetics.set_current(data.draw(st.one_of(STRANGE, st.just("*"))), data.draw(STRANGE))
        assert np.isfinite(wild_magnetics._model.warpmag.strength.numpy()).all()


@pytest.fixture(scope="module")
def wild_magnetics(device):
    builder = new_builder()
    add_ball(builder, (0.0, 0.0, 0.0))
    warpmag.add_coil(builder, radius=A)
    return warpmag.Magnetics(builder.finalize(device=device))


def test_sources_that_no_world_or_every_world_would_have(device):
    with pytest.raises(warpmag.InputError, match="register_custom_attributes"):
        warpmag.add_coil(newton.ModelBuilder(), radius=A)
    world = new_builder()
    add_ball(world, (0.0, 0.0, 0.0))
    several = new_builder()
    several.replicate(world, 2)
    warpmag.add_coil(several, several.add_body(), radius=A, label="free")
    with pytest.raises(warpmag.InputError, match="free: a source on a body outside all worlds"):
        warpmag.Magnetics(several.finalize(device=device))
    outside, lone = new_builder(), new_builder()
    add_ball(outside, (0.0, 0.0, 0.0))
    warpmag.add_coil(lone, radius=A, label="inside")
    outside.add_world(lone)
    with pytest.raises(warpmag.InputError, match="inside: a source of fields in a world"):
        warpmag.Magnetics(outside.finalize(device=device))
    other = new_builder()
    other.add_world(world)
    other.add_world(lone)  # holds no magnet that would feel it
    magnetics = warpmag.Magnetics(other.finalize(device=device))
    assert magnetics.system.sources is None
