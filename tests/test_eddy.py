"""Eddy currents in conducting balls, against float64 differences of fields, closed forms and conservation laws."""

import itertools
import math

import newton
import numpy as np
import pytest
import warp as wp

import warpmag
from bench.reference import oracle
from bench.systems import moment_system
from warpmag.errors import InputError

RADIUS, COUNT, PERMANENT = 0.005, 12, 3
MASS = 7870.0 * 4.0 / 3.0 * math.pi * RADIUS**3
INERTIA = 0.4 * MASS * RADIUS**2
NO_STEP = 0.0
"""Time step [s] of forces that are not followed by a motion."""


class Clump:
    """Balls that nearly touch or overlap a little; the last balls are permanent, every second ball conducts."""

    def __init__(self, dtype, device, step=NO_STEP, conductivity=1e7):
        rng = np.random.default_rng(3)
        grid = np.stack(np.meshgrid(*3 * [np.arange(3.0)], indexing="ij"), axis=-1).reshape(-1, 3)[:COUNT]
        self.positions = 1.98 * RADIUS * (grid + 0.01 * rng.normal(size=(COUNT, 3)))
        permanent = np.arange(COUNT) >= COUNT - PERMANENT
        self.conductivity = np.where(np.arange(COUNT) % 2 == 1, conductivity, 0.0)
        self.system = system = moment_system(
            radii=np.full(COUNT, RADIUS),
            permanent=permanent,
            saturation=1.7e6,
            rtol=1e-10 if dtype == "float64" else 1e-5,
            dtype=dtype,
            device=device,
        )
        moments = np.where(permanent[:, None], 0.8 * rng.normal(size=(COUNT, 3)), 0.0)
        system.positions.assign(self.positions)
        system.moments.assign(moments)
        system.set_conductivity(self.conductivity, step)
        system.solve()
        self.moments = system.moments.numpy().astype(float)
        h = oracle.h_field(self.positions, self.moments, radii=np.full(COUNT, RADIUS))
        _, derivatives = oracle.magnetization(h, 1.7e6)
        self.derivatives = np.where(permanent[:, None, None], 0.0, derivatives)
        self.still = self._wrench(np.zeros((COUNT, 3)), np.zeros((COUNT, 3)))

    def _wrench(self, velocities, spins):
        motion = np.zeros((8, COUNT))
        motion[:3], motion[3:6], motion[6], motion[7] = velocities.T, spins.T, 1.0 / MASS, 1.0 / INERTIA
        self.system.eddy.motion.assign(motion)
        self.system.apply_forces()
        return np.stack([self.system.forces.numpy(), self.system.torques.numpy()]).astype(float)

    def braked(self, velocities, spins):
        """Forces [N] and torques [N·m] of the eddy currents alone."""
        return self._wrench(velocities, spins) - self.still

    def expected(self):
        """Forces, torques and dissipated power by the oracle."""

        def rates(velocities, spins):
            radii = np.full(COUNT, RADIUS)
            return oracle.flux_rates(self.positions, self.moments, radii, velocities, spins, self.derivatives)

        return oracle.eddy_wrench(oracle.eddy_coefficient(RADIUS, self.conductivity), rates)


@pytest.fixture(scope="module")
def clump(device):
    return Clump("float64", device)


def _motion(speed=1e-3):
    """Velocities [m/s] and spins [rad/s], so slow that interactions of eddy moments are negligible."""
    rng = np.random.default_rng(4)
    return speed * rng.normal(size=(COUNT, 3)), speed / RADIUS * rng.normal(size=(COUNT, 3))


def test_forces_are_slopes_of_the_dissipation(clump):
    velocities, spins = _motion()
    power, *expected = clump.expected()(velocities, spins)
    results = clump.braked(velocities, spins)
    # differences over 1 µs have errors of 1e-6; interactions of eddy moments are of second order in the speeds
    for value, other in zip(results, expected, strict=True):
        np.testing.assert_allclose(value, other, rtol=0.0, atol=1e-5 * np.abs(other).max())
    assert -(results[0] * velocities).sum() - (results[1] * spins).sum() == pytest.approx(power, rel=1e-5)
    assert power > 0.0


def test_single_precision(device):
    clump, (velocities, spins) = Clump("float32", device), _motion(speed=1.0)
    _, *expected = clump.expected()(velocities, spins)
    # at 1 m/s changes of 1 % of a force have errors of 1e-4, and the second order is 2e-3
    for value, other in zip(clump.braked(velocities, spins), expected, strict=True):
        np.testing.assert_allclose(value, other, rtol=0.0, atol=5e-3 * np.abs(other).max())


def test_micrometres(device):
    """Balls of 1 µm in float32 as in float64, where r⁻⁷ overflows float32."""
    results = []
    for dtype in ("float32", "float64"):
        system = moment_system(
            radii=[1e-6, 1e-6], saturation=1.7e6, permanent=[False, True], dtype=dtype, device=device
        )
        system.positions.assign([[0.5e-6, 0.0, 2.5e-6], [0.0, 0.0, 0.0]])
        system.moments.assign([[0.0, 0.0, 0.0], [0.0, 0.0, 4e-12]])
        system.set_conductivity([1e16, 0.0], 1e-12)  # large enough for a measurable brake
        system.solve()
        system.eddy.motion.assign(np.outer([0.0, 0.0, 1e-3, 0.0, 0.0, 0.0, 0.0, 0.0], [1.0, 0.0]))
        system.apply_forces()
        results.append(system.forces.numpy().astype(float))
    np.testing.assert_allclose(results[0], results[1], rtol=0.0, atol=1e-5 * np.abs(results[1]).max())
    system.eddy.motion.zero_()
    system.apply_forces()
    assert np.abs(results[1] - system.forces.numpy()).max() > 0.1 * np.abs(results[1]).max()


def test_momentum_and_angular_momentum_are_kept(clump):
    forces, torques = clump.braked(*_motion())
    turned = np.cross(clump.positions, forces)
    assert np.abs(forces.sum(axis=0)).max() < 1e-9 * np.abs(forces).max()
    # the solve's tolerance is 1e-10; forces change by a fraction of 1e-5
    assert np.abs((turned + torques).sum(axis=0)).max() < 1e-6 * np.abs(turned).max()


def test_common_motion_is_not_braked(clump):
    """A common velocity and a common rotation of all balls are not braked."""
    scale = np.abs(clump.braked(*_motion())).max(axis=(1, 2))
    same = np.broadcast_to([1e-3, 2e-3, -1e-3], (COUNT, 3))
    spin = np.broadcast_to([0.3, -0.2, 0.1], (COUNT, 3))
    for velocities, spins in ((same, 0.0 * spin), (np.cross(spin, clump.positions), spin)):
        results = np.abs(clump.braked(velocities, spins)).max(axis=(1, 2))
        assert (results < 1e-6 * scale).all()


@pytest.mark.parametrize("conductivity", [1e7, 1e10, 1e14])
def test_no_step_is_too_long(device, conductivity):
    """A step never increases the kinetic energy, and stops a ball of very high conductivity quickly."""
    dt = 1e-3
    clump, (velocities, spins) = Clump("float64", device, step=dt, conductivity=conductivity), _motion()
    energies = []
    for _ in range(20):
        forces, torques = clump.braked(velocities, spins)
        velocities, spins = velocities + dt / MASS * forces, spins + dt / INERTIA * torques
        energies.append(0.5 * (MASS * (velocities**2).sum() + INERTIA * (spins**2).sum()))
    assert (np.diff(energies) < 0.0).all()


GRADIENT = np.array([1.0, 1.0, -2.0]) * 2e7
"""Gradient g of a quadrupole, H = (g x, g y, −2g z) [A/m²]."""


def _flying_ball(device, saturation, susceptibility, velocity):
    """Simulation of a ball in a quadrupole."""
    builder = newton.ModelBuilder(gravity=(0.0, 0.0, 0.0))
    warpmag.register_attributes(builder)
    body = builder.add_body()
    builder.add_shape_sphere(body, radius=RADIUS, cfg=newton.ModelBuilder.ShapeConfig(density=8960.0))
    builder.body_qd[body] = wp.spatial_vector(*velocity, 0.0, 0.0, 0.0)
    warpmag.add_inducible(builder, body=body, saturation=saturation, susceptibility=susceptibility, conductivity=5.96e7)
    nodes = np.linspace(-0.1, 0.1, 5)
    values = np.stack(np.meshgrid(nodes, nodes, nodes, indexing="ij"), axis=-1) * GRADIENT
    warpmag.add_field_map(builder, origin=(-0.1,) * 3, spacing=0.05, values=values)
    return warpmag.Simulation(builder, dt=1e-3, device=device)


def _slowed_down(velocity, mass, steps, dt):
    """Velocity of a copper ball that starts in the center of the quadrupole, by the same steps in float64.

    The force is −c G b and the torque c B × b, with G = μ0 ∇H, B = G x and b = G v − ω × B.
    """
    place, spin, inertia = np.zeros(3), np.zeros(3), 0.4 * mass * RADIUS**2
    slope = oracle.MU0 * GRADIENT
    for _ in range(steps):
        inside = slope * place
        c = oracle.eddy_coefficient(RADIUS, 5.96e7)
        c /= 1.0 + 2.0 * dt * c * (slope @ slope / mass + inside @ inside / inertia)
        change = slope * velocity - np.cross(spin, inside)
        velocity = velocity - dt * c * slope * change / mass
        spin = spin + dt * c * np.cross(inside, change) / inertia
        place = place + dt * velocity
    return velocity


def test_a_copper_ball_slows_down_in_a_quadrupole(device):
    """A copper ball is braked by about dv/dt = −c (μ0 g)² v / m along each axis, apart from its rotation."""
    start, steps = np.array([0.03, -0.02, 0.04]), 100
    simulation = _flying_ball(device, 1e-3, 1e-9, start)
    for _ in range(steps):
        simulation.step()
    results = simulation.state.body_qd.numpy()[0, :3]
    expected = _slowed_down(start, float(simulation.model.body_mass.numpy()[0]), 2 * steps, 5e-4)
    assert (np.abs(expected) < 0.5 * np.abs(start)).all()
    # float32 positions, 5 mm from the origin, change the velocity by 1e-6 m/s per substep
    np.testing.assert_allclose(results, expected, atol=3e-5)


def test_iron_is_braked_by_the_field_inside(device):
    """In a weak field B inside iron is 3 μ0 H, and the force is nine times that on copper."""
    forces = []
    for saturation, susceptibility in ((1e-3, 1e-9), (1e12, math.inf)):
        simulation = _flying_ball(device, saturation, susceptibility, (0.0, 0.0, 0.5))
        magnetics, state = simulation._magnetics, simulation.state
        state.clear_forces()
        magnetics.apply(state)
        forces.append(float(state.body_f.numpy()[0, 2]))
    c, step = oracle.eddy_coefficient(RADIUS, 5.96e7), 5e-4
    mass = float(simulation.model.body_mass.numpy()[0])
    expected = []
    for factor in (1.0, 3.0):
        rate = (factor * oracle.MU0 * GRADIENT) ** 2 * c / mass
        expected.append(-mass * 0.5 * rate[2] / (1.0 + 2.0 * step * rate.sum()))
    np.testing.assert_allclose(forces, expected, rtol=1e-4)


def _ball_at_a_magnet(motion):
    """An iron ball near a permanent box with a coil on it; ``motion`` returns a body's velocity and spin."""
    builder = newton.ModelBuilder(gravity=(0.0, 0.0, 0.0))
    warpmag.register_attributes(builder)
    places = np.array([[0.0, 0.0, 0.0], [0.004, 0.002, 0.018]])
    magnet, ball = (builder.add_body(xform=wp.transform(place, wp.quat_identity())) for place in places)
    builder.add_shape_box(magnet, hx=0.01, hy=0.01, hz=0.01)
    builder.add_shape_sphere(ball, radius=RADIUS)
    warpmag.add_permanent(builder, body=magnet, magnetization=(0.0, 2e5, 8e5))
    warpmag.add_coil(
        builder, body=magnet, radius=0.012, ampere_turns=500.0, xform=((0.0, 0.0, 0.01), (0.0, 0.0, 0.0, 1.0))
    )
    warpmag.add_inducible(builder, body=ball, conductivity=1e7)
    for body, place in zip((magnet, ball), places, strict=True):
        velocity, spin = motion(body, place)
        builder.body_qd[body] = wp.spatial_vector(*map(float, velocity), *map(float, spin))
    return builder


def _wrenches(device, motion):
    """Force and torque on the magnet and on the ball, and the part due to eddy currents."""
    results = []
    for moving in (lambda body, place: (np.zeros(3), np.zeros(3)), motion):
        model = _ball_at_a_magnet(moving).finalize(device=device)
        state, magnetics = model.state(), warpmag.Magnetics(model, rtol=1e-5)
        state.clear_forces()
        magnetics.apply(state)
        results.append(state.body_f.numpy().astype(float))
    return results[1], results[1] - results[0]


def test_a_magnet_and_its_coil_move(device):
    """A ball that moves with the magnet is not braked; otherwise momentum is conserved and power dissipated."""
    spin, speed = np.array([0.5, -1.0, 2.0]), np.array([0.02, 0.01, -0.03])
    whole, along = _wrenches(device, lambda body, place: (speed + np.cross(spin, place), spin))
    _, apart = _wrenches(device, lambda body, place: (body * speed, body * spin))
    _, turned = _wrenches(device, lambda body, place: (0.0 * speed, (1 - body) * 20.0 * spin))
    noise = 1e-6 * np.abs(whole).max(axis=0)  # rounding of the forces whose differences these are
    assert (np.abs(along) < 5.0 * noise).all()
    for forces, power in ((apart, apart[1] @ [*speed, *spin]), (turned, turned[0, 3:] @ (20.0 * spin))):
        assert np.abs(forces).max() > 100.0 * noise.max()
        assert power < 0.0
        assert (np.abs(forces[:, :3].sum(axis=0)) < 10.0 * noise[:3]).all()


def test_only_balls_conduct(device):
    builder = _ball_at_a_magnet(lambda body, place: (np.zeros(3), np.zeros(3)))
    warpmag.add_permanent(builder, body=0, magnetization=(0.0, 0.0, 8e5), conductivity=1e6)
    with pytest.raises(InputError, match="shape_0: conductivity: only balls"):
        warpmag.Magnetics(builder.finalize(device=device))
    with pytest.raises(InputError, match="conductivity: must be zero or positive"):
        warpmag.add_inducible(builder, body=1, conductivity=-1.0)


def test_nothing_is_prepared_without_conductors(device):
    builder = _ball_at_a_magnet(lambda body, place: (np.zeros(3), np.zeros(3)))
    warpmag.add_inducible(builder, body=1)
    system = warpmag.Magnetics(builder.finalize(device=device)).system
    assert system.eddy is None and system.source_interaction.rates is None


def test_worlds_do_not_see_each_other(clump, device):
    """Two worlds of equal balls, of which fewer conduct in the second world."""
    motion, alone = np.zeros((8, 2 * COUNT)), clump.braked(*_motion())
    system = moment_system(
        radii=np.full(2 * COUNT, RADIUS),
        worlds=np.repeat([0, 1], COUNT),
        permanent=np.tile(np.arange(COUNT) >= COUNT - PERMANENT, 2),
        saturation=1.7e6,
        rtol=1e-10,
        dtype="float64",
        device=device,
    )
    system.positions.assign(np.tile(clump.positions, (2, 1)))
    system.moments.assign(np.tile(clump.moments, (2, 1)))
    system.set_conductivity(np.concatenate([np.zeros(COUNT), clump.conductivity]), NO_STEP)
    system.solve()
    results = []
    for speed in (1.0, 0.0):
        motion[:6] = speed * np.tile(np.concatenate([part.T for part in _motion()]), 2)
        system.eddy.motion.assign(motion)
        system.apply_forces()
        results.append(np.stack([system.forces.numpy(), system.torques.numpy()]))
    first, second = np.split(results[0] - results[1], 2, axis=1)
    assert not first.any()
    # two solves to 1e-10, and forces that change by a fraction of 1e-5
    assert np.abs(second - alone).max() < 1e-5 * np.abs(alone).max()


def test_a_ball_that_hangs_stops_to_swing(device):
    """Decay of small oscillations of an iron ball about a dipole, against the closed form without friction.

    The field turns by 3/2 of the swing's angle, and the ball after it at a rate of c B²/I, slower than it swings, so
    that |dB/dt|² is B² (3/2 dφ/dt)² Ω²/(Ω² + (cB²/I)²): the amplitude falls at a quarter of that power over
    ½ m r² (dφ/dt)².
    """
    magnet, start, top = 0.01, np.radians(5.0), 0.1
    builder = newton.ModelBuilder()
    warpmag.register_attributes(builder)
    smooth = newton.ModelBuilder.ShapeConfig(density=7870.0, mu=0.0)
    fixed = builder.add_shape_sphere(
        -1, xform=wp.transform((0.0, 0.0, top), wp.quat_identity()), radius=magnet, cfg=smooth
    )
    warpmag.add_permanent(builder, shape=fixed, magnetization=(0.0, 0.0, 3e5))
    place = 1.0005 * (magnet + RADIUS) * np.array([np.sin(start), 0.0, -np.cos(start)])
    ball = builder.add_body(xform=wp.transform((*place[:2], top + place[2]), wp.quat_identity()))
    builder.add_shape_sphere(ball, radius=RADIUS, cfg=smooth)
    warpmag.add_inducible(builder, body=ball, conductivity=1e7)
    simulation, step, angles = warpmag.Simulation(builder, dt=1e-3, device=device), 1e-3, []
    for _ in range(500):
        simulation.step()
        x, _, z = simulation.state.body_q.numpy()[0, :3]
        angles.append(np.arctan2(x, top - z))
    angles = np.array(angles)
    zeros = np.flatnonzero(np.diff(np.sign(angles)) != 0)
    swing = np.pi / (step * np.diff(zeros).mean())
    peaks = [np.abs(angles[a:b]).max() for a, b in itertools.pairwise(zeros)]
    results = -np.polyfit(step * zeros[:-1], np.log(peaks), 1)[0]

    distance, c = magnet + RADIUS, oracle.eddy_coefficient(RADIUS, 1e7)
    flux_density = 3.0 * oracle.MU0 * 2.0 / 3.0 * 3e5 * (magnet / distance) ** 3
    follows = c * flux_density**2 / INERTIA
    power = c * flux_density**2 * 1.5**2 * swing**2 / (swing**2 + follows**2)
    # the step reduces the coefficient by 2 %; amplitude (1 %), peaks between steps and saturation have smaller effects
    assert results == pytest.approx(power / (2.0 * MASS * distance**2), rel=0.05)
