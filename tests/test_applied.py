"""Coils and field maps: their fields, their forces on magnets, and the reactions on them."""

import math

import numpy as np
import pytest

from bench.reference import oracle
from bench.systems import moment_system
from warpmag.kernels.applied.sources import AppliedSource, SourceKind
from warpmag.moments.probe import FieldProbe

newton = pytest.importorskip("newton")
from bench.reference import coils as coil_oracle  # noqa: E402
from warpmag.declarations.coils import Coil, FieldMap  # noqa: E402

A = 0.02  # m, radius of coils
R = 0.005  # m
VOLUME = 4.0 / 3.0 * math.pi * R**3
SINGLE = 3e-6  # rounding of float32 sums, relative to the largest term
HALF = 0.03  # m, half the length of solenoids
CORNERS = 2.5 * A * np.array([[-1.0, -0.5, 0.0], [1.0, -0.4, 0.1], [0.8, 0.6, 0.5], [-0.2, 0.3, -0.3]])


def source_of(record, **where):
    return AppliedSource(SourceKind[record.kind.upper()], record.parameters, record.table, **where)


LOOP = source_of(Coil(radius=A).record())
SOLENOID = source_of(Coil("solenoid", radius=A, length=2.0 * HALF).record())
POLYLINE = source_of(Coil("polyline", points=tuple(map(tuple, CORNERS)), wire_radius=0.01 * A).record())


def field_of(source, points, device, strength=100.0, frame=(0, 0, 0, 0, 0, 0, 1)):
    """Return field and gradient of one source in float64, measured by a probe."""
    system = moment_system(radii=[1e-9], permanent=[True], sources=[source], dtype="float64", device=device)
    system.sources.strengths.assign([[strength, 0.0, 0.0]])
    system.sources.frames.assign([frame])
    system.positions.assign([[1e3, 0.0, 0.0]])
    probe = FieldProbe(system, len(points), gradients=True)
    probe.points.assign(points)
    probe.measure()
    return probe.h.numpy(), probe.gradient.numpy()


def points_around(count=60, seed=0, scale=1.5 * A):
    """Return points around a coil, some of them on its axis or close to it."""
    some = np.random.default_rng(seed).normal(size=(count, 3)) * scale
    some[:5, :2] = 0.0
    some[5:10, :2] *= 1e-9
    return some


def assert_gradients(source, device, points, **where):
    """Assert that gradients equal fourth-order differences of fields."""
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
    """The H of a sheet of current is the B/μ0 of a magnetized cylinder."""
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
    # only points where the reference has converged
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
    """The field changes by a few percent at most across the surface of a wire."""
    depths = 0.01 * A * np.array([0.99, 0.9999999, 1.0000001, 1.01, 1e-9])
    h, gradient = field_of(source, place + depths[:, None] * np.array(across), device)
    size = np.linalg.norm(h, axis=1)
    assert size[:4].min() > 0.3 * size.max()
    np.testing.assert_allclose(h[1], h[2], rtol=1e-5, atol=1e-5 * size[1])
    assert size[4] < 0.01 * size[1]  # the rest is the field of other pieces
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
    """Return a map of a dipole's field with ``cells`` cells along each side."""
    axes = [start + SIDE / cells * np.arange(cells + 1) for start in CORNER]
    places = np.stack(np.meshgrid(*axes, indexing="ij"), axis=-1)
    values = oracle.h_field(*DIPOLE, places.reshape(-1, 3)).reshape(places.shape)
    return source_of(FieldMap(tuple(CORNER), (SIDE / cells,) * 3, values).record())


def test_a_map_converges_to_the_field_that_it_is_of(device):
    """Errors fall as the third power of the spacing, those of gradients as the second, up to the border."""
    points = CORNER + SIDE * np.random.default_rng(2).uniform(size=(1000, 3))
    exact, errors = (oracle.h_field(*DIPOLE, points), oracle.field_gradient(*DIPOLE, points)), []
    for cells in (20, 40, 80):
        result = field_of(map_of_a_dipole(cells), points, device, strength=1.0)
        errors.append(
            [np.linalg.norm(field - of) / np.linalg.norm(of) for field, of in zip(result, exact, strict=True)]
        )
    errors = np.array(errors)
    assert errors[-1, 0] < 5e-6
    assert (errors[1:, 0] < errors[:-1, 0] / 7.0).all()  # 8 in the limit
    assert (errors[1:, 1] < errors[:-1, 1] / 3.8).all()  # 4


def test_a_map_is_exact_for_parabolas_and_its_gradient_is_its_own(device):
    """The gradient is that of the interpolant, even for values with curl and divergence."""
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


PUSHED = LOOP._replace(world=0, body=50, movable=True)


def make_loaded_system(device, source=PUSHED):
    """Return a system of twelve balls beside a coil, four permanent, two in one body, and their positions."""
    rng = np.random.default_rng(5)
    places = np.array([[x, y, z] for x in (-1, 1) for y in (-1, 1) for z in (-1, 0, 1)]) * 2.3 * R
    places += rng.normal(size=places.shape) * 0.05 * R
    permanent = np.arange(12) >= 8
    system = moment_system(
        radii=np.full(12, R), permanent=permanent, bodies=[0, 0, *range(2, 12)], saturation=2e5, susceptibility=50.0,
        external_field=(1e3, 2e3, -5e2), sources=[source], dtype="float64", rtol=1e-11, device=device,
    )  # fmt: skip
    system.positions.assign(places)
    system.moments.assign(np.where(permanent[:, None], rng.normal(size=(12, 3)) * 3e4 * VOLUME, 0.0))
    system.sources.strengths.assign([[800.0, 0.0, 0.0]])
    return system, places


@pytest.mark.parametrize("kind", ["loop", "map"])
def test_gradient_of_the_energy_is_the_force(kind, device):
    """The force is also the gradient of the co-energy in a map, whose interpolant has a curl."""
    source = PUSHED
    if kind == "map":
        values = np.random.default_rng(7).normal(size=(4, 4, 4, 3))
        record = FieldMap((-0.05, -0.05, -0.05), (0.1 / 3.0,) * 3, 5.0 * values).record()
        source = source_of(record, world=0, body=50, movable=True)
    system, places = make_loaded_system(device, source)

    def energy(places, coil=(0.0, 0.0, 0.0)):
        system.positions.assign(places)
        system.sources.frames.assign([(*coil, 0.0, 0.0, 0.0, 1.0)])
        system.solve()
        assert system.converged.numpy()[0]
        return system.energy()[0]

    energy(places)
    system.apply_forces()
    forces, reaction = system.forces.numpy(), system.source_interaction.wrenches.numpy()[0, :3]
    step = 1e-6  # m; the truncation error is (step/R)² of the force
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
    result = system.forces.numpy()
    m, h = system.moments.numpy(), system.h.numpy()
    coil, own = field_of(LOOP, places, device, strength=800.0)
    labels = np.array([0, 0, *range(2, 12)])
    gradient = oracle.field_gradient(places, m, radii=R, bodies=labels) + own
    expected = oracle.kelvin_force(m, gradient)
    if force == "zeeman":
        magnetization, slope = oracle.magnetization(h, 2e5, 50.0)
        expected[:8] = oracle.zeeman_force(np.full(12, VOLUME), h, gradient, magnetization, slope)[:8]
    np.testing.assert_allclose(result, expected, atol=1e-9 * np.abs(expected).max())
    turning = oracle.h_field(places, m, radii=R, bodies=labels) + coil + (1e3, 2e3, -5e2)
    torques = oracle.torque(m, turning)
    np.testing.assert_allclose(system.torques.numpy()[8:], torques[8:], atol=1e-12 * np.abs(torques).max())


@pytest.mark.parametrize("force", ["kelvin", "zeeman"])
def test_reaction_is_opposite_and_equal(force, device):
    """The reaction on the coil is the difference of forces and torques with and without its field."""
    system, places = make_loaded_system(device)
    frame = (0.01, -0.02, 0.03, 0.0, 0.0, 0.6, 0.8)
    system.sources.frames.assign([frame])
    system.solve()
    system.apply_forces(force)
    coil, gradient = field_of(LOOP, places, device, strength=800.0, frame=frame)
    effective = system.moments.numpy() if force == "kelvin" else system._effective.numpy().T
    forces = oracle.kelvin_force(effective, gradient)
    torques = oracle.torque(effective, coil) + np.cross(places - frame[:3], forces)
    for result, expected in (
        (system.source_interaction.wrenches.numpy()[0, :3], forces),
        (system.source_interaction.wrenches.numpy()[0, 3:6], torques),
    ):
        np.testing.assert_allclose(result, -expected.sum(axis=0), atol=1e-13 * np.abs(expected).sum())


def test_a_source_magnetizes_its_own_body_and_does_not_push_it(device):
    """A coil exerts no force on the core in its own body."""
    for body in (0, 1):
        coil = LOOP._replace(world=0, body=body, movable=True)
        system = moment_system(
            radii=[R], bodies=[0], sources=[coil], single_torque=True, dtype="float64", rtol=1e-9, device=device
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
        np.testing.assert_allclose(system.source_interaction.wrenches.numpy()[:, :3], -expected, rtol=1e-12)


def test_each_world_has_its_sources(device):
    """The first source is fixed and acts on all worlds; the second is pushed and acts on the second world."""
    everywhere, second = LOOP, LOOP._replace(world=1, body=9, movable=True)
    system = moment_system(
        radii=[R, R, R], worlds=[0, 1, 1], saturation=1e9, sources=[everywhere, second], dtype="float64", rtol=1e-10,
        device=device,
    )  # fmt: skip
    places = np.array([[0.0, 0.0, 0.01], [0.0, 0.0, 0.01], [0.03, 0.0, 0.01]])
    system.positions.assign(places)
    system.sources.strengths.assign([[100.0, 0.0, 0.0], [-40.0, 0.0, 0.0]])
    system.solve()
    system.apply_forces()
    coil, gradient = field_of(LOOP, places, device, strength=1.0)
    m, strengths = system.moments.numpy(), np.array([100.0, 60.0, 60.0])
    np.testing.assert_allclose(m[0], 3.0 * VOLUME * 100.0 * coil[0], rtol=1e-6)  # far below saturation at 1e9 A/m
    np.testing.assert_allclose(system.sources.frames.numpy()[0], [0, 0, 0, 0, 0, 0, 1])
    result = system.forces.numpy()
    np.testing.assert_allclose(result[0], oracle.kelvin_force(m, strengths[:, None, None] * gradient)[0], atol=1e-15)
    push = -oracle.kelvin_force(m[1:], -40.0 * gradient[1:]).sum(axis=0)
    np.testing.assert_allclose(system.source_interaction.wrenches.numpy()[:, :3], [[0, 0, 0], push], atol=1e-18)
    probe = FieldProbe(system, 2, worlds=[1, 0])
    probe.points.assign([[0.0, 0.0, 1.0]] * 2)
    probe.measure()
    alone = [
        oracle.h_field(places[rows], m[rows], np.array([[0.0, 0.0, 1.0]])) + strengths[rows][0]
        * field_of(LOOP, np.array([[0.0, 0.0, 1.0]]), device, strength=1.0)[0]
        for rows in (slice(1, 3), slice(0, 1))
    ]  # fmt: skip
    np.testing.assert_allclose(probe.h.numpy(), np.concatenate(alone), rtol=1e-9)
