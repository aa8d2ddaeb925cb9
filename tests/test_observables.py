"""Field, flux density, gradient and energy of a model's magnets, and magnets and fields that are set as it runs."""

import math

import numpy as np
import pytest
import warp as wp
from small_builders import R, add_ball, new_builder

import warpmag
from bench.reference import oracle
from bench.systems import moment_system
from warpmag.moments.probe import FieldProbe

M = 1e6  # A/m
VOLUME = 4.0 / 3.0 * math.pi * R**3
H0 = np.array([1e4, 2e4, 5e4])  # A/m
SINGLE = 3e-6  # sums of some float32 terms, relative to the largest


def apart(rng, count, least):
    """Points that are no nearer to each other than ``least`` [m]."""
    kept = []
    while len(kept) < count:
        x = rng.uniform(-6.0 * least, 6.0 * least, 3)
        if all(np.linalg.norm(x - other) > least for other in kept):
            kept.append(x)
    return np.array(kept)


def make_system(curve, device, *, dtype="float64", rtol=1e-11):
    """24 balls of which six are permanent; the system, positions and moments."""
    rng = np.random.default_rng(5)
    n = 24
    x, permanent = apart(rng, n, 2.1 * R), np.arange(n) >= 18
    m = np.where(permanent[:, None], rng.normal(size=(n, 3)) * 3e5 * VOLUME, 0.0)
    system = moment_system(
        radii=np.full(n, R), permanent=permanent, saturation=2e5, susceptibility=50.0, curve=curve,
        external_field=H0, dtype=dtype, rtol=rtol, device=device,
    )  # fmt: skip
    system.positions.assign(x)
    system.moments.assign(m)
    return system, x


@pytest.mark.parametrize("curve", ["tanh", "langevin", "clamped", "frohlich"])
def test_gradient_of_the_energy_is_the_force(curve, device):
    system, x = make_system(curve, device)

    def energy(places):
        system.positions.assign(places)
        system.solve()
        assert system.converged.numpy()[0]
        return system.energy()[0]

    energy(x)
    system.apply_forces()
    forces = system.forces.numpy()
    step = 1e-6  # m: the third derivative's part is (step/R)² of the force, 4e-8, the solve's 1e-11 E/(step F)
    for ball, axis in ((0, 0), (3, 1), (17, 2), (18, 0), (23, 2)):
        there, back = x.copy(), x.copy()
        there[ball, axis] += step
        back[ball, axis] -= step
        slope = (energy(there) - energy(back)) / (2.0 * step)
        assert abs(slope + forces[ball, axis]) < 1e-6 * np.abs(forces).max()


def test_energy_of_one_ball(device):
    """μ0 of minus half moment times field, where the curve is straight; less a quarter of Ms² where it saturates."""
    for saturation, expected in ((1e9, -1.5 * np.dot(H0, H0)), (1e3, -1e3 * (np.linalg.norm(H0) - 1e3 / 6.0))):
        system = moment_system(
            radii=[R], saturation=saturation, curve="clamped", external_field=H0, dtype="float64", device=device
        )
        system.solve()
        np.testing.assert_allclose(system.energy(), oracle.MU0 * VOLUME * expected, rtol=1e-12)


def test_energy_of_the_multipole_model_is_refused(device):
    system = moment_system(radii=[R, R], contact_model="multipole", device=device)
    with pytest.raises(warpmag.InputError, match="contact_model"):
        system.energy()


@pytest.mark.parametrize(("dtype", "tolerance"), [("float64", 1e-13), ("float32", SINGLE)])
def test_field_gradient_and_flux_density_inside_and_out(dtype, tolerance, device):
    system, x = make_system("tanh", device, dtype=dtype, rtol=1e-5)
    system.solve()
    rng = np.random.default_rng(2)
    points = np.concatenate(
        [x[:12] + 0.2 * R, x[-6:] + np.array([0.9 * R, 0.0, 0.0]), rng.normal(size=(40, 3)) * 6.0 * R]
    )
    probe = FieldProbe(system, len(points), gradients=True)
    probe.points.assign(points)
    probe.measure()
    moments = system.moments.numpy().astype(float)
    h = oracle.h_field(x, moments, points, radii=R) + H0
    inside = np.linalg.norm(points[:, None] - x, axis=2) < R
    assert inside.sum() >= 18
    b = oracle.MU0 * (h + inside @ (moments / VOLUME))
    gradient = oracle.field_gradient(x, moments, points, radii=R)
    for actual, expected in ((probe.h, h), (probe.b, b), (probe.gradient, gradient)):
        np.testing.assert_allclose(actual.numpy(), expected, atol=tolerance * np.abs(expected).max())


def test_flux_density_inside_a_magnetized_sphere(device):
    """Two thirds of μ0 M everywhere inside, a dipole's outside, the normal part continuous at the surface."""
    builder = new_builder()
    add_ball(builder, (0.1, 0.0, 0.0), (0.0, 0.0, M))
    model = builder.finalize(device=device)
    magnetics = warpmag.Magnetics(model)
    magnetics.induce(model.state())
    inside = np.array([[0.1, 0.0, 0.0], [0.1, 0.6 * R, 0.6 * R], [0.1 + 0.99 * R, 0.0, 0.0]])
    expected = np.tile([0.0, 0.0, 2.0 / 3.0 * oracle.MU0 * M], (3, 1))
    np.testing.assert_allclose(magnetics.b_field(inside), expected, atol=SINGLE * oracle.MU0 * M)
    poles = magnetics.b_field([[0.1, 0.0, 0.9999 * R], [0.1, 0.0, 1.0001 * R]])
    np.testing.assert_allclose(poles[0], poles[1], rtol=4e-4)  # 3 · 1e-4 of the way outside
    np.testing.assert_allclose(magnetics.h_field([[0.1, 0.0, 2.0 * R]])[0, 2], 2.0 / 3.0 * M / 8.0, rtol=SINGLE)


def test_each_point_sees_the_magnets_of_its_world(device):
    world = new_builder()
    add_ball(world, (0.0, 0.0, 0.0), (0.0, 0.0, M))
    builder = new_builder()
    builder.replicate(world, 3)
    model = builder.finalize(device=device)
    magnetics = warpmag.Magnetics(model)
    magnetics.set_magnetization((0.0, 0.0, -2.0 * M), body=1)
    points = [[0.0, 0.0, 0.02]] * 4
    with pytest.raises(warpmag.InputError, match=r"there is no field yet, call apply\(state\)"):
        magnetics.h_field(points, worlds=0)
    magnetics.induce(model.state())
    field = magnetics.h_field(points, worlds=[2, 1, 0, 1])[:, 2]
    first = 2.0 * M * VOLUME / (4.0 * math.pi * 0.02**3)
    np.testing.assert_allclose(field, [first, -2.0 * first, first, -2.0 * first], rtol=SINGLE)
    with pytest.raises(warpmag.InputError, match="worlds: must be given"):
        magnetics.h_field(points)
    with pytest.raises(warpmag.InputError, match="worlds: world 7 holds no magnets"):
        magnetics.b_field(points, worlds=7)
    assert magnetics.energy().shape == (3,)


def test_a_probe_in_a_crowd_of_balls(device):
    """A point inside more balls than a list of neighbours has room for."""
    n = 400
    rng = np.random.default_rng(1)
    x = rng.normal(size=(n, 3)) * 0.1 * R
    m = rng.normal(size=(n, 3)) * VOLUME * M
    system = moment_system(radii=np.full(n, R), permanent=np.ones(n, bool), dtype="float64", device=device)
    system.positions.assign(x)
    system.moments.assign(m)
    system.solve()
    probe = FieldProbe(system, 2)
    points = np.array([[0.0, 0.0, 0.0], [0.9 * R, 0.0, 0.0]])
    probe.points.assign(points)
    probe.measure()
    h = oracle.h_field(x, m, points, radii=R)
    inside = np.linalg.norm(points[:, None] - x, axis=2) < R
    expected = oracle.MU0 * (h + inside @ (m / VOLUME))
    np.testing.assert_allclose(probe.b.numpy(), expected, atol=1e-12 * np.abs(expected).max())


def test_probing_leaves_the_solve_as_it_is(device):
    results = []
    for probed in (False, True):
        system, x = make_system("tanh", device, dtype="float32", rtol=1e-4)
        probe = FieldProbe(system, 5)
        probe.points.assign(x[:5] + 0.5 * R)
        for k in range(3):
            system.positions.assign(x * (1.0 + 1e-3 * k))
            system.solve()
            if probed:
                probe.measure()
        results.append(system.moments.numpy())
    np.testing.assert_array_equal(*results)


def test_64_worlds_with_64_fields(device):
    world = new_builder()
    add_ball(world, (0.0, 0.0, 0.0))
    builder = new_builder()
    builder.replicate(world, 64)
    model = builder.finalize(device=device)
    magnetics = warpmag.Magnetics(model, rtol=1e-5)
    fields = np.random.default_rng(0).normal(size=(64, 3)) * 1e3
    magnetics.set_external_field(fields)
    magnetics.induce(model.state())
    np.testing.assert_allclose(magnetics.shape_moments(), 3.0 * VOLUME * fields, atol=1e-4 * 3e3 * VOLUME)
    magnetics.set_external_field((0.0, 0.0, 50.0))
    magnetics.induce(model.state())
    np.testing.assert_allclose(magnetics.shape_moments()[:, 2], 150.0 * VOLUME, rtol=1e-4)
    for bad, text in (((1.0, 2.0), "shape"), (np.zeros((3, 3)), "shape"), ((math.nan, 0.0, 0.0), "external_field")):
        with pytest.raises(warpmag.InputError, match=text):
            magnetics.set_external_field(bad)


def test_magnetization_is_set_in_the_frame_of_the_body(device):
    builder = new_builder()
    quarter = wp.quat_from_axis_angle(wp.vec3(1.0, 0.0, 0.0), 0.5 * math.pi)
    body = builder.add_body(xform=wp.transform((0.0, 0.0, 0.0), quarter))
    builder.add_shape_box(body, xform=wp.transform((0.01, 0.0, 0.0), quarter), hx=R, hy=R, hz=R)
    warpmag.add_permanent(builder, body=body, magnetization=(0.0, 0.0, M))
    ball = add_ball(builder, (0.1, 0.0, 0.0))
    model = builder.finalize(device=device)
    magnetics = warpmag.Magnetics(model)
    state = model.state()
    for magnetization in ((0.0, 0.0, M), (0.0, 2.0 * M, 0.0), (0.0, 0.0, 0.0)):
        magnetics.set_magnetization(magnetization, body=body)
        magnetics.induce(state)
        x, y, z = magnetization
        expected = np.array([x, -z, y]) * 8.0 * R**3  # turned by the body's quarter about x
        actual = magnetics.shape_moments()[list(magnetics.shapes).index(0)]
        np.testing.assert_allclose(actual, expected, atol=SINGLE * M * 8.0 * R**3)
    model.warpmag.magnetization.assign(np.array([[0.0, 0.0, M], [0.0, 0.0, 0.0]]))  # in the frame of the shape
    magnetics.induce(state)
    actual = magnetics.shape_moments()[list(magnetics.shapes).index(0)]
    np.testing.assert_allclose(actual, [0.0, 0.0, -M * 8.0 * R**3], atol=SINGLE * M * 8.0 * R**3)
    for where in ({"body": ball}, {"shape": 1}, {}, {"body": 17}):
        with pytest.raises(warpmag.InputError, match="has no permanent magnet"):
            magnetics.set_magnetization((0.0, 0.0, M), **where)


@pytest.mark.cuda
def test_set_and_measured_in_a_graph(device):
    builder = new_builder()
    add_ball(builder, (0.0, 0.0, 0.0), (0.0, 0.0, M))
    add_ball(builder, (0.03, 0.0, 0.0))
    model = builder.finalize(device=device)
    magnetics, state = warpmag.Magnetics(model), model.state()
    magnetization = wp.array([(0.0, 0.0, M)], dtype=wp.vec3, device=device)
    field = wp.zeros(1, dtype=wp.vec3, device=device)
    probe = magnetics.probe([[0.0, 0.0, 0.02]], gradients=True)

    def work():
        magnetics.set_magnetization(magnetization, body=0)
        magnetics.set_external_field(field)
        magnetics.induce(state)
        probe.measure()

    work()
    with wp.ScopedCapture(device) as capture:
        work()
    for scale in (1.0, -0.5):
        magnetization.assign([(0.0, 0.0, scale * M)])
        field.assign([(0.0, 0.0, 100.0 * scale)])
        wp.capture_launch(capture.graph)
        graphed = probe.b.numpy()
        work()
        np.testing.assert_array_equal(graphed, probe.b.numpy())


def sensor_model(device):
    """A static magnet, and two turned boards with a site each; the boards' quarter turn takes x to y."""
    builder = new_builder()
    add_ball(builder, (0.0, 0.0, 0.0), (0.0, 0.0, M))
    turn = wp.quat_from_axis_angle(wp.vec3(0.0, 0.0, 1.0), 0.5 * math.pi)
    for k in range(2):
        board = builder.add_body(xform=wp.transform((0.04 + 0.02 * k, 0.0, 0.0), turn))
        builder.add_shape_box(board, hx=R, hy=R, hz=0.001)
        upright = wp.quat_from_axis_angle(wp.vec3(1.0, 0.0, 0.0), math.pi)
        builder.add_site(board, xform=wp.transform((0.0, 0.0, 0.01), upright), label=f"hall_{k}")
    model = builder.finalize(device=device)
    magnetics = warpmag.Magnetics(model)
    magnetics.set_external_field((1000.0, 0.0, 0.0))
    return model, magnetics


def test_a_magnetometer_reads_in_the_frame_of_its_site(device):
    model, magnetics = sensor_model(device)
    state = model.state()
    magnetics.apply(state)
    sensor = warpmag.SensorMagnetometer(model, magnetics, sites="*hall_?")
    sensor.update(state)
    places = np.array([[0.04, 0.0, 0.01], [0.06, 0.0, 0.01]])
    b = oracle.MU0 * (
        oracle.h_field(np.zeros((1, 3)), np.array([[0.0, 0.0, M * VOLUME]]), places) + np.array([1000.0, 0.0, 0.0])
    )
    expected = np.stack([b[:, 1], b[:, 0], -b[:, 2]], axis=1)  # turned back about z, then half a turn about x
    np.testing.assert_allclose(sensor.flux_density.numpy(), expected, atol=SINGLE * np.abs(b).max())


def test_a_magnetometers_noise_and_range(device):
    model, magnetics = sensor_model(device)
    state = model.state()
    magnetics.apply(state)
    exact = warpmag.SensorMagnetometer(model, magnetics, sites=["*hall_1"])
    exact.update(state)
    noisy = warpmag.SensorMagnetometer(model, magnetics, sites="*hall_1", noise=1e-6, seed=3)
    readings = []
    for _ in range(300):
        noisy.update(state)
        readings.append(noisy.flux_density.numpy()[0].copy())
    errors = np.array(readings) - exact.flux_density.numpy()[0]
    # 900 numbers: their mean is within 4/30, and their standard deviation within 4/√1800 of what is wanted
    assert abs(errors.mean()) < 1e-6 * 4.0 / 30.0
    assert abs(errors.std() / 1e-6 - 1.0) < 0.1
    narrow = warpmag.SensorMagnetometer(model, magnetics, sites="*hall_1", saturation=1e-4)
    narrow.update(state)
    np.testing.assert_allclose(
        narrow.flux_density.numpy(), np.clip(exact.flux_density.numpy(), -1e-4, 1e-4), rtol=SINGLE
    )


def test_magnetometers_that_cannot_be(device):
    model, magnetics = sensor_model(device)
    ball = model.shape_label[0]
    for arguments, text in (
        ({"sites": "nothing"}, "sites: no label matches"),
        ({"sites": ball}, "is not a site"),
        ({"sites": [0]}, "sites: 0 is not a site"),
        ({"sites": [99]}, "sites: 99 is not a site"),
        ({"sites": []}, "sites: no label matches"),
        ({"sites": "*hall*", "noise": -1.0}, "noise"),
        ({"sites": "*hall*", "saturation": 0.0}, "saturation"),
    ):
        with pytest.raises(warpmag.InputError, match=text):
            warpmag.SensorMagnetometer(model, magnetics, **arguments)
