"""Coils and field maps on Newton models: forces on bodies, currents by world and in graphs, and errors."""

import math

import numpy as np
import pytest
import warp as wp
from hypothesis import given
from hypothesis import strategies as st
from small_builders import add_ball, new_builder
from test_applied import CORNERS, HALF, LOOP, SINGLE, VOLUME, A, R, field_of
from test_arguments_wild import STRANGE, chosen, refusals

from bench.reference import oracle

newton = pytest.importorskip("newton")
import warpmag  # noqa: E402
from warpmag.declarations.coils import Coil, FieldMap, SourceRecord  # noqa: E402


def test_a_coil_on_a_body_feels_what_it_does(device):
    builder = new_builder()
    turn = wp.quat_from_axis_angle(wp.vec3(1.0, 0.0, 0.0), 0.3)
    coil_body = builder.add_body(xform=wp.transform((0.01, 0.02, 0.03), turn))
    builder.add_shape_box(coil_body, xform=wp.transform((0.0, 0.03, 0.0), wp.quat_identity()), hx=R, hy=R, hz=R)
    frame = wp.transform((0.0, 0.01, -0.01), wp.quat_from_axis_angle(wp.vec3(0.0, 1.0, 0.0), 0.5))
    warpmag.add_coil(builder, body=coil_body, radius=A, ampere_turns=800.0, xform=frame)
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
    np.testing.assert_allclose(moments.sum(axis=0), 0.0, atol=1e-5 * np.abs(moments).max())  # from rtol
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
    """A Maxwell pair: opposite loops √3 radii apart, with a gradient uniform to fourth order, in a uniform field."""
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
    # non-uniform gradient (1e-4/A)⁴, rtol of the moment, and nonlinearity of the curve (3 H/Ms)²/3
    np.testing.assert_allclose(state.body_f.numpy()[iron, :3], expected, atol=3e-5 * expected[2])
    np.testing.assert_allclose(magnetics.field_gradient([[0.0, 0.0, 0.0]])[0], gradient * np.diag([-0.5, -0.5, 1.0]),
                               atol=SINGLE * gradient)  # fmt: skip


def test_momentum_of_a_coil_and_a_ball_is_kept_in_a_run(device):
    """Coil and ball attract each other; the ball has fallen well into the coil at the end."""
    builder = new_builder(gravity=(0.0, 0.0, 0.0))
    coil = builder.add_body(mass=0.02, inertia=wp.mat33(*(2e-6 * np.eye(3)).ravel().tolist()), label="coil")
    warpmag.add_coil(builder, body=coil, shape="solenoid", radius=A, length=2.0 * HALF, ampere_turns=4000.0)
    ball = add_ball(builder, (0.003, 0.0, 0.05))
    simulation = warpmag.Simulation(builder, dt=1e-3, device=device)
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
        moment_and_force = magnetics.shape_moments()[0, 2], state.body_f.numpy()[0, 2]
        # force m dH/dz with m = 3 V H and H'/H = -3 z/(A² + z²)
        force = oracle.MU0 * 3.0 * VOLUME * (per_ampere * value) ** 2 * -1.5 / (1.25 * A)
        np.testing.assert_allclose(moment_and_force, (3.0 * VOLUME * per_ampere * value, force), rtol=1e-4)


def test_fixed_bodies_and_fixed_maps(device):
    """A kinematic coil gets no reaction; one map acts on all worlds; a magnetometer measures both fields."""
    world = new_builder()
    add_ball(world, (0.0, 0.0, 0.5 * A))
    holder = world.add_body(is_kinematic=True)
    warpmag.add_coil(world, body=holder, radius=A, ampere_turns=50.0)
    world.add_site(holder, xform=wp.transform((0.0, 0.0, -0.5 * A), wp.quat_identity()), label="hall")
    builder = new_builder()
    builder.replicate(world, 2)
    values = np.broadcast_to([30.0, 0.0, 0.0], (2, 2, 2, 3))
    warpmag.add_field_map(builder, origin=(-1.0, -1.0, -1.0), spacing=2.0, values=values, label="earth")
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
        field = sensor.flux_density.numpy()[k] / oracle.MU0
        np.testing.assert_allclose(field, expected, atol=SINGLE * np.abs(expected).max())


@pytest.mark.parametrize("coil_moves", [False, True])
def test_fields_at_magnets_that_nothing_moves_are_left_out(device, coil_moves):
    """Static coil and static magnet: no field is evaluated there, the energy and the forces on others are the same."""
    energies, wrenches = [], []
    for kinematic in (False, True):
        builder = new_builder()
        magnet = builder.add_body(xform=wp.transform((0.0, 0.0, 0.01), wp.quat_identity()), is_kinematic=kinematic)
        builder.add_shape_box(magnet, hx=0.003, hy=0.003, hz=0.003)
        warpmag.add_permanent(builder, body=magnet, magnetization=(0.0, 2e5, 1e6))
        holder = builder.add_body(is_kinematic=not coil_moves)
        warpmag.add_coil(builder, body=holder, radius=A, ampere_turns=50.0)
        add_ball(builder, (0.02, 0.0, 0.02))
        model = builder.finalize(device=device)
        magnetics, state = warpmag.Magnetics(model), model.state()
        magnetics.apply(state)
        chunks = magnetics.system.source_interaction.arrays.targets.chunk.numpy()
        assert chunks[:, 1].sum() == (1 if kinematic else magnetics.system.count)
        energies.append(magnetics.energy())
        magnetics.apply(state)  # the energy leaves no trace
        wrenches.append(0.5 * state.body_f.numpy()[1:])
    np.testing.assert_allclose(energies[1], energies[0], rtol=1e-6)
    np.testing.assert_allclose(wrenches[1], wrenches[0], atol=SINGLE * np.abs(wrenches[0]).max())
    assert np.abs(wrenches[1][0]).max() > 0.0 or not coil_moves


def test_a_coil_does_not_act_on_the_magnet_that_carries_it(device):
    """The body gets the wrench of the ball alone."""
    builder = new_builder()
    body = builder.add_body()
    builder.add_shape_box(body, hx=0.003, hy=0.003, hz=0.003)
    warpmag.add_permanent(builder, body=body, magnetization=(0.0, 0.0, 1e6))
    warpmag.add_coil(builder, body=body, radius=A, xform=((0.0, 0.0, 0.004), wp.quat_identity()), ampere_turns=50.0)
    add_ball(builder, (0.0, 0.0, 0.03))
    model = builder.finalize(device=device)
    magnetics, state = warpmag.Magnetics(model), model.state()
    magnetics.apply(state)
    force = state.body_f.numpy()
    assert force[1, 2] < 0.0
    np.testing.assert_allclose(force[0, :3], -force[1, :3], atol=1e-5 * abs(force[1, 2]))
    assert not magnetics.system.source_interaction.acting.numpy()[1:].any()


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
    assert FieldMap((0.0,) * 3, (1.0,) * 3, values).border_ratio() == 0.25
    assert FieldMap((0.0,) * 3, (1.0,) * 3, 0.0 * values).border_ratio() == 0.0


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
    "add_coil": "body shape radius length points closed wire_radius ampere_turns resistance voltage turns inductance "
    "xform label",
    "add_field_map": "origin spacing values body factor xform label",
}


@pytest.mark.parametrize("name", WILD)
@given(st.data())
def test_any_source(name, data):
    """Valid arguments give a record of finite numbers."""
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
    warpmag.add_coil(several, body=several.add_body(), radius=A, label="free")
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
    other.add_world(lone)  # contains no magnet
    magnetics = warpmag.Magnetics(other.finalize(device=device))
    assert magnetics.system.sources is None
