"""Coils with a resistance: closed forms of circuits, reference inductances, energy, graphs, worlds and errors."""

import math

import numpy as np
import pytest
import warp as wp
from scipy.integrate import solve_ivp
from scipy.linalg import expm
from small_builders import new_builder

from bench.reference.cored_coil import inductance as reference_inductance

newton = pytest.importorskip("newton")
import warpmag  # noqa: E402
from warpmag.declarations.coils import Coil  # noqa: E402
from warpmag.shapes.inductance import MU0, mutual_inductance, self_inductance  # noqa: E402

TURNS, RESISTANCE, VOLTAGE = 200, 2.0, 5.0
MAGNET, M = 0.004, 1e6  # radius of a ball [m], magnetization [A/m]
SOLENOID = {"shape": "solenoid", "radius": 0.01, "length": 0.02}
LOOP = {"radius": 0.01}


def coil_and_ball(coil, *, position=(0.0, 0.0, 5.0), magnet=None, **circuit):
    """Builder of a coil with a resistance and a ball, by default far away: iron or with the given magnetization."""
    builder = new_builder(gravity=(0.0, 0.0, 0.0))
    body = builder.add_body(xform=wp.transform(position, wp.quat_identity()))
    builder.add_shape_sphere(body, radius=MAGNET)
    if magnet is None:
        warpmag.add_inducible(builder, body=body, material="mild-steel")
    else:
        warpmag.add_permanent(builder, body=body, magnetization=magnet)
    values = {"resistance": RESISTANCE, "turns": TURNS, "label": "coil"} | circuit
    warpmag.add_coil(builder, **coil, **values)
    return builder


def currents_over_time(magnetics, state, dt, steps):
    """Currents after each step, shape [steps, coils]."""
    currents = []
    for _ in range(steps):
        state.clear_forces()
        magnetics.apply(state, dt)
        currents.append(magnetics.coils.currents.numpy().copy())
    return np.array(currents)


def place(state, z):
    """Place the first body on the axis at height z [m]."""
    poses = state.body_q.numpy().copy()
    poses[0, :3] = 0.0, 0.0, z
    state.body_q.assign(poses)


def test_inductances_of_tables_and_limits():
    # Nagaoka's coefficient of L = K μ0 π a²/l for 2a/l = 0.1, 1 and 10 (Grover 1946, table 36)
    for ratio, coefficient in ((0.1, 0.958807), (1.0, 0.688423), (10.0, 0.203315)):
        sheet = Coil("solenoid", radius=1.0, length=2.0 / ratio).record()
        expected = coefficient * MU0 * math.pi * ratio / 2.0
        assert self_inductance(sheet) == pytest.approx(expected, rel=1e-4)
    side, wire = 0.2, 1e-3
    corners = ((0.0, 0.0, 0.0), (side, 0.0, 0.0), (side, side, 0.0), (0.0, side, 0.0))
    square = Coil("polyline", points=corners, wire_radius=wire).record()
    expected = (
        2.0 * MU0 * side / math.pi * (math.log(side / wire) - 0.77401 + 0.25 + wire / side)
    )  # Grover 1946, Eq. 61
    assert self_inductance(square) == pytest.approx(expected, rel=1e-3)
    loop = Coil(radius=0.1, wire_radius=wire).record()
    assert self_inductance(loop) == pytest.approx(MU0 * 0.1 * (math.log(8.0 * 0.1 / wire) - 1.75), rel=1e-3)
    # two halves of a solenoid in series
    half, whole = (Coil("solenoid", radius=0.05, length=length).record() for length in (0.1, 0.2))
    mutual = mutual_inductance(half, half, np.eye(3), np.array([0.0, 0.0, 0.1]))
    assert (self_inductance(half) + mutual) / 2.0 == pytest.approx(self_inductance(whole), rel=1e-4)
    turn, offset = np.array([[0.8, 0.0, 0.6], [0.0, 1.0, 0.0], [-0.6, 0.0, 0.8]]), np.array([0.03, 0.02, 0.15])
    for first, second in ((loop, square), (whole, loop), (square, whole)):
        there, back = (
            mutual_inductance(first, second, turn, offset),
            mutual_inductance(second, first, turn.T, -turn.T @ offset),
        )
        assert there == pytest.approx(back, rel=1e-6)  # of quadrature


@pytest.mark.parametrize("z", [0.1, 5.0])  # steps over L/R
def test_current_in_air_decays_as_its_closed_form(z, device):
    model = coil_and_ball(SOLENOID, voltage=VOLTAGE).finalize(device=device)
    magnetics = warpmag.Magnetics(model)
    inductance = TURNS**2 * self_inductance(Coil(**SOLENOID).record())
    dt = z * inductance / RESISTANCE
    currents = currents_over_time(magnetics, model.state(), dt, 20)[:, 0]
    expected = VOLTAGE / RESISTANCE * (1.0 - np.exp(-z * np.arange(1, 21)))
    np.testing.assert_allclose(currents, expected, rtol=1e-5)  # float32


def test_two_coils_are_a_transformer(device):
    builder = coil_and_ball(SOLENOID, voltage=VOLTAGE)
    above = wp.transform((0.0, 0.0, 0.012), wp.quat_identity())
    warpmag.add_coil(builder, **LOOP, resistance=0.5, turns=40, xform=above, label="short circuit")
    model = builder.finalize(device=device)
    magnetics = warpmag.Magnetics(model)
    first, second = Coil(**SOLENOID).record(), Coil(**LOOP).record()
    mutual = TURNS * 40 * mutual_inductance(first, second, np.eye(3), np.array([0.0, 0.0, 0.012]))
    matrix = np.array([[TURNS**2 * self_inductance(first), mutual], [mutual, 40**2 * self_inductance(second)]])
    rate, dt = np.linalg.solve(matrix, np.diag([RESISTANCE, 0.5])), 5e-6
    currents = currents_over_time(magnetics, model.state(), dt, 100)
    steady = np.array([VOLTAGE / RESISTANCE, 0.0])
    expected = np.array([steady - expm(-rate * dt * k) @ steady for k in range(1, 101)])
    assert expected[:, 1].min() < -0.3
    np.testing.assert_allclose(currents, expected, atol=2e-4 * np.abs(expected).max())  # second order in dt


@pytest.mark.parametrize("share", [0.1, 0.7, None])
def test_coupled_coils_lose_energy(share, device):
    """Coils closer than their given inductances allow: the energy in them can only become heat."""
    own = TURNS**2 * self_inductance(Coil(**LOOP).record())
    builder = coil_and_ball(LOOP, inductance=(share or 0.0) * own, ampere_turns=100.0)
    place_of_copy = wp.transform((0.0, 0.0, 0.0 if share is None else 1e-4), wp.quat_identity())
    circuit = {"resistance": RESISTANCE, "turns": TURNS, "inductance": (share or 0.0) * own}
    warpmag.add_coil(builder, **LOOP, **circuit, xform=place_of_copy)
    model = builder.finalize(device=device)
    currents = currents_over_time(warpmag.Magnetics(model), model.state(), 1e-4, 60)
    assert np.abs(currents).max() <= 100.0 / TURNS
    assert np.abs(currents[-1]).max() < np.abs(currents[0]).max()


def test_a_given_current_induces_one(device):
    builder = coil_and_ball(LOOP, resistance=1e-6)  # keeps its flux
    warpmag.add_coil(builder, **SOLENOID, label="given")
    model = builder.finalize(device=device)
    magnetics, state = warpmag.Magnetics(model), model.state()
    magnetics.apply(state, 1e-4)
    magnetics.set_current("given", 100.0)
    magnetics.apply(state, 1e-4)
    own, other = Coil(**LOOP).record(), Coil(**SOLENOID).record()
    ratio = mutual_inductance(own, other, np.eye(3), np.zeros(3)) / self_inductance(own)
    assert magnetics.coils.currents.numpy()[0] == pytest.approx(-100.0 * ratio / TURNS, rel=1e-4)


def test_a_moving_magnet_induces_its_closed_form(device):
    """A magnet at constant velocity through a short-circuited loop: current, force, and heat equal to the work."""
    dt, start, count = 5e-5, -0.03, 1200
    model = coil_and_ball(LOOP, position=(0.0, 0.0, start), magnet=(0.0, 0.0, M)).finalize(device=device)
    magnetics, state = warpmag.Magnetics(model), model.state()
    moment, a = M * 4.0 / 3.0 * math.pi * MAGNET**3, LOOP["radius"]
    inductance = TURNS**2 * self_inductance(Coil(**LOOP).record())

    def flux_slope(z):
        return -1.5 * MU0 * moment * TURNS * a * a * z / (a * a + z * z) ** 2.5

    solution = solve_ivp(
        lambda t, i: (-RESISTANCE * i - flux_slope(start + t)) / inductance, (0.0, count * dt), [0.0],
        rtol=1e-9, atol=1e-12, dense_output=True,
    )  # fmt: skip
    times = dt * np.arange(count)
    heights, currents, forces = start + times, [], []
    for z in heights:
        place(state, z)
        currents += currents_over_time(magnetics, state, dt, 1)[:, 0].tolist()
        forces.append(float(state.body_f.numpy()[0, 2]))
    expected = solution.sol(times)[0]
    assert np.abs(expected).max() > 0.1
    np.testing.assert_allclose(currents, expected, atol=1e-3 * np.abs(expected).max())
    np.testing.assert_allclose(
        forces, expected * flux_slope(heights), atol=0.01 * np.abs(forces).max()
    )  # dt/(L/R) = 0.04
    heat, work = RESISTANCE * np.sum(np.square(currents)) * dt, -np.sum(forces) * dt
    assert heat == pytest.approx(work, rel=1e-3)


def test_an_iron_core_multiplies_the_inductance(device):
    """Current over time of a coil with an iron core: the reference's inductance, from finite volumes."""
    builder = new_builder(gravity=(0.0, 0.0, 0.0))
    core = builder.add_body()
    builder.add_shape_cylinder(core, radius=0.005, half_height=0.015)
    warpmag.add_inducible(builder, body=core, saturation=1e9, susceptibility=999.0)
    coil = {"shape": "solenoid", "radius": 0.008, "length": 0.03}
    warpmag.add_coil(builder, **coil, resistance=RESISTANCE, turns=TURNS, voltage=VOLTAGE)
    model = builder.finalize(device=device)
    magnetics, state = warpmag.Magnetics(model), model.state()
    air = reference_inductance(coil["radius"], coil["length"])
    assert self_inductance(Coil(**coil).record()) == pytest.approx(air, rel=2e-3)  # of the grid
    inductance = TURNS**2 * reference_inductance(0.008, 0.03, core_radius=0.005, core_length=0.03, permeability=1000.0)
    assert inductance > 4.0 * TURNS**2 * air
    for dt in (0.05 * inductance / RESISTANCE, 0.8 * inductance / RESISTANCE):
        magnetics.reset()
        times = dt * np.arange(1, 5)
        currents = currents_over_time(magnetics, state, dt, 4)[:, 0]
        expected = VOLTAGE / RESISTANCE * (1.0 - np.exp(-RESISTANCE / inductance * times))
        np.testing.assert_allclose(currents, expected, rtol=0.01)  # of cells and of the grid


def test_energy_is_conserved(device):
    """A coil pulls a free steel ball, which saturates: electrical energy = heat + stored energy + kinetic energy."""
    resistance, voltage, begin = 0.05, 0.6, -0.014
    mass, dt, steps = 7870.0 * 4.0 / 3.0 * math.pi * MAGNET**3, 5e-5, 400
    builder = coil_and_ball(SOLENOID, position=(0.0, 0.0, begin), resistance=resistance, voltage=voltage)
    model = builder.finalize(device=device)
    magnetics, state = warpmag.Magnetics(model, rtol=1e-4), model.state()
    magnetics.induce(state)
    start = magnetics.energy()[0]
    z, v, before, electrical, heat = begin, 0.0, 0.0, 0.0, 0.0
    for _ in range(steps):
        place(state, z)
        current = float(currents_over_time(magnetics, state, dt, 1)[0, 0])
        mean = 0.5 * (before + current)  # dt R/L is 0.005
        electrical, heat, before = electrical + voltage * mean * dt, heat + resistance * mean * mean * dt, current
        v += float(state.body_f.numpy()[0, 2]) * dt / mass
        z += v * dt
    # U = ½ L i² + G + λ i, with the co-energy −G and the flux λ of the ball's moment
    own = 0.5 * TURNS**2 * self_inductance(Coil(**SOLENOID).record()) * current**2
    linked = TURNS * magnetics.coils.flux.numpy()[0] * current - 2.0 * own
    stored = own + magnetics.energy()[0] + linked - start
    kinetic = 0.5 * mass * v * v
    assert min(heat, stored, 100.0 * kinetic) > 0.3 * electrical
    assert abs(electrical - heat - stored - kinetic) < 1e-3 * electrical


def test_voltages_by_world_in_a_graph_and_a_reset(device):
    world = coil_and_ball(SOLENOID, position=(0.0, 0.0, 0.01), voltage=1.0, ampere_turns=40.0)
    builder = newton.ModelBuilder(gravity=(0.0, 0.0, 0.0))
    builder.replicate(world, 3)
    model = builder.finalize(device=device)
    magnetics, state, dt = warpmag.Magnetics(model), model.state(), 1e-4
    first = currents_over_time(magnetics, state, dt, 3)
    assert first[0] == pytest.approx(first[0, 0], rel=1e-5) and first[0, 0] > 0.2
    voltages = wp.array([0.0, 2.0, 4.0], dtype=wp.float32, device=device)
    magnetics.set_voltage("coil", voltages)
    with wp.ScopedCapture(device) as capture:
        magnetics.set_voltage("coil", voltages)
        magnetics.apply(state, dt)
    for _ in range(100):
        wp.capture_launch(capture.graph)
    np.testing.assert_allclose(magnetics.coils.currents.numpy(), [0.0, 1.0, 2.0], atol=2e-3)
    magnetics.reset(worlds=[True, False, False])
    assert model.warpmag.voltage.numpy().max() == 4.0
    again = currents_over_time(magnetics, state, dt, 3)
    np.testing.assert_allclose(again[:, 0], first[:, 0], rtol=1e-5)
    np.testing.assert_allclose(again[:, 1:], [[1.0, 2.0]] * 3, rtol=2e-3)


def test_repeated_attempts_do_not_repeat_the_circuit(device):
    """Magnets that jump together: steps are repeated with short substeps, the current follows its closed form."""
    builder = new_builder(gravity=(0.0, 0.0, 0.0))
    for x in (0.0, 4.0 * MAGNET):
        ball = builder.add_body(xform=wp.transform((x, 0.0, 0.0), wp.quat_identity()))
        builder.add_shape_sphere(ball, radius=MAGNET)
        warpmag.add_permanent(builder, body=ball, magnetization=(M, 0.0, 0.0))
    far = wp.transform((0.0, 0.0, 3.0), wp.quat_identity())
    warpmag.add_coil(builder, **SOLENOID, xform=far, resistance=0.2, turns=TURNS, voltage=1.0)
    simulation = warpmag.Simulation(builder, dt=4e-3, device=device)
    rate = 0.2 / (TURNS**2 * self_inductance(Coil(**SOLENOID).record()))
    currents = []
    for _ in range(12):
        simulation.step()
        currents.append(float(simulation.magnetics.coils.currents.numpy()[0]))
    expected = 5.0 * (1.0 - np.exp(-rate * 4e-3 * np.arange(1, 13)))
    assert simulation.statistics.repeated > 0
    np.testing.assert_allclose(currents, expected, rtol=1e-4)


@pytest.mark.parametrize(("arguments", "message"), [
    ({"voltage": 1.0}, "add_coil: voltage is given, but only a coil with a resistance has one"),
    ({"turns": 20}, "add_coil: turns is given"),
    ({"inductance": 1e-3}, "add_coil: inductance is given"),
    ({"resistance": -1.0}, "add_coil: resistance: must be 0 or"),
    ({"resistance": 1.0, "voltage": 12.0}, "add_coil: turns is missing: a coil with a resistance needs their number"),
    ({"resistance": 1.0, "turns": 1, "voltage": math.nan}, "add_coil: voltage: must be finite"),
    ({"resistance": 1.0, "turns": 1e12, "inductance": 1e-3},
     r"add_coil: inductance must be 0 or at least 1 % of the \S+ H of 1e\+12 turns of this shape, got 0.001"),
    ({"resistance": 1.0, "turns": 1, "radius": 0.0, "shape": "polyline", "points": np.eye(3), "closed": False},
     "an open polyline is only a part of a circuit"),
])  # fmt: skip
def test_impossible_circuits_are_errors(arguments, message):
    with pytest.raises(warpmag.InputError, match=message):
        warpmag.add_coil(new_builder(), **LOOP | arguments)


def test_misused_circuits_are_errors(device):
    builder = coil_and_ball(LOOP, inductance=0.5, position=(0.0, 0.0, 0.0))
    warpmag.add_coil(builder, **LOOP, label="given")
    model = builder.finalize(device=device)
    magnetics, state = warpmag.Magnetics(model), model.state()
    for call, message in (
        (lambda: magnetics.apply(state), "apply: dt is missing, by which the current of coil advances"),
        (lambda: magnetics.apply(state, 0.0), "dt: must be positive"),
        (lambda: magnetics.set_current("coil", 1.0), "set_current: coil has a voltage"),
        (lambda: magnetics.set_voltage("given", 1.0), "set_voltage: given has no resistance"),
        (lambda: magnetics.set_voltage("c*", [1.0, 2.0]), "must be 1 or 1 numbers"),
    ):
        with pytest.raises(warpmag.InputError, match=message):
            call()
    magnetics.set_voltage("coil", 1.0)
    magnetics.apply(state, 1e-4)
    assert magnetics.coils.labels == ["coil"]
    assert magnetics.coils.currents.numpy()[0] == pytest.approx(1e-4 / 0.5, rel=0.01)  # the inductance given
    lone = newton.ModelBuilder(gravity=(0.0, 0.0, 0.0))
    without = new_builder(gravity=(0.0, 0.0, 0.0))
    without.add_body()
    warpmag.add_coil(without, **LOOP, resistance=1.0, turns=5, label="lone")
    for world in (coil_and_ball(LOOP), without):
        lone.add_world(world)
    with pytest.raises(warpmag.InputError, match="lone: a coil with a resistance in a world without magnets"):
        warpmag.Magnetics(lone.finalize(device=device))
    everywhere = newton.ModelBuilder(gravity=(0.0, 0.0, 0.0))
    everywhere.replicate(coil_and_ball(LOOP), 2)
    warpmag.add_coil(everywhere, **LOOP, resistance=1.0, turns=5, label="outside")
    with pytest.raises(warpmag.InputError, match="outside: a coil with a resistance outside all worlds"):
        warpmag.Magnetics(everywhere.finalize(device=device))
