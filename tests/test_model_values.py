"""What a user writes into ``model.warpmag`` counts, or is refused by name; and fields that kernels drive in a graph."""

import math

import newton
import numpy as np
import pytest
import warp as wp

import warpmag

R = 0.005  # m
VOLUME = 4.0 / 3.0 * math.pi * R**3
CHANGES = {"kind": 2, "curve": 1, "moment_spacing": 0.001}
"""What cannot be taken over."""


def model_of(device, **material):
    """A ball and a box of iron beside a permanent ball, and a shape that is no magnet."""
    builder = newton.ModelBuilder()
    warpmag.register_attributes(builder)
    for k in range(4):
        body = builder.add_body(xform=wp.transform((0.012 * k, 0.0, 0.0)), label=f"body{k}")
        label = f"shape{k}"
        if k == 1:
            builder.add_shape_box(body, hx=R, hy=R, hz=0.5 * R, label=label)
        else:
            builder.add_shape_sphere(body, radius=R, label=label)
        if k == 2:
            warpmag.add_permanent(builder, body=body, magnetization=(0.0, 0.0, 1e6))
        elif k < 2:
            warpmag.add_inducible(builder, body=body, **material)
    return builder.finalize(device=device)


def write(model, name, shape, value):
    array = getattr(model.warpmag, name)
    values = array.numpy()
    values[shape] = value
    array.assign(values)


def stepped(magnetics, model):
    """Return the forces at the poses of the model; a change raises an error here at the latest."""
    state = model.state()
    magnetics.apply(state)
    magnetics.check_model()
    return state.body_f.numpy()


@pytest.mark.parametrize("name", ["saturation", "susceptibility", *CHANGES])
def test_a_change_that_nobody_tells_is_refused(device, name):
    model = model_of(device)
    magnetics = warpmag.Magnetics(model)
    stepped(magnetics, model)
    write(model, name, 1, CHANGES.get(name, 1e5))
    message = rf"^shape1: model\.warpmag\.{name} was changed, call notify_model_changed\(\)"
    for _ in range(2):  # not only once
        with pytest.raises(warpmag.InputError, match=message):
            stepped(magnetics, model)
    for measure in (magnetics.shape_moments, magnetics.energy, lambda: magnetics.h_field([[0.1, 0.0, 0.0]])):
        with pytest.raises(warpmag.InputError, match=message):
            measure()


def test_a_shape_that_becomes_a_magnet_is_noticed(device):
    model = model_of(device)
    magnetics = warpmag.Magnetics(model)
    write(model, "saturation", 3, 2.0)  # of a shape that is no magnet: nothing changes
    stepped(magnetics, model)
    write(model, "kind", 3, 1)
    with pytest.raises(warpmag.InputError, match=r"^shape3: model\.warpmag\.kind was changed"):
        stepped(magnetics, model)


@pytest.mark.parametrize("captured", [False, True])
def test_a_notified_material_takes_effect(device, captured):
    """As if the model had been made with it, also in a graph that was captured before."""
    material = {"saturation": 3e5, "susceptibility": 8.0}
    model = model_of(device)
    magnetics, state = warpmag.Magnetics(model, rtol=1e-5), model.state()
    magnetics.apply(state)
    before = state.body_f.numpy().copy()
    work = lambda: (state.body_f.zero_(), magnetics.apply(state))  # noqa: E731
    if captured:
        with wp.ScopedCapture(device) as capture:
            work()
        work = lambda: wp.capture_launch(capture.graph)  # noqa: E731
    for name, value in material.items():
        write(model, name, [0, 1], value)
    magnetics.notify_model_changed()
    for _ in range(3):
        work()
    magnetics.check_model()
    forces, expected = state.body_f.numpy(), stepped(warpmag.Magnetics(model_of(device, **material), rtol=1e-5), model)
    scale = np.abs(expected).max()
    assert np.abs(before - expected).max() > 0.1 * scale
    np.testing.assert_allclose(forces, expected, rtol=0, atol=1e-4 * scale)  # ten times rtol
    assert {entry.magnet.saturation for entry in magnetics.magnets if entry.magnet.kind == "inducible"} == {
        np.float32(3e5)
    }


@pytest.mark.parametrize("name", CHANGES)
def test_what_cannot_be_taken_over_is_refused(device, name):
    model = model_of(device)
    magnetics = warpmag.Magnetics(model)
    write(model, name, 0, CHANGES[name])
    magnetics.notify_model_changed(newton.ModelFlags.BODY_PROPERTIES)  # of something else
    with pytest.raises(warpmag.InputError, match=rf"^shape0: warpmag\.{name} was changed, and .*: make another"):
        magnetics.notify_model_changed()


def test_a_measured_curve_of_all_magnets_is_not_bent(device):
    model = model_of(device)
    magnetics = warpmag.Magnetics(model, curve="M-19")
    write(model, "saturation", 0, 3e5)
    with pytest.raises(
        warpmag.InputError, match=r"^shape0: warpmag\.saturation was changed, but a measured curve determines"
    ):
        magnetics.notify_model_changed()


@pytest.mark.parametrize(("name", "value"), [("saturation", -1.0), ("saturation", math.nan), ("susceptibility", 0.0)])
def test_a_material_out_of_range_is_refused(device, name, value):
    model = model_of(device)
    magnetics = warpmag.Magnetics(model)
    write(model, name, 1, value)
    with pytest.raises(warpmag.InputError, match=rf"^shape1: warpmag\.{name}: must be"):
        magnetics.notify_model_changed(newton.ModelFlags.ALL if hasattr(newton.ModelFlags, "ALL") else -1)


def test_tables_of_the_contact_model_keep_their_materials(device):
    model = model_of(device)
    magnetics = warpmag.Magnetics(model, contact_model="multipole")
    write(model, "saturation", 0, 3e5)
    with pytest.raises(warpmag.InputError, match=r"^contact_model: multipole has tables"):
        magnetics.notify_model_changed()
    with pytest.raises(warpmag.InputError, match=r"^shape0: model\.warpmag\.saturation was changed"):
        stepped(magnetics, model)


def test_a_simulation_stops_at_a_model_that_has_changed(device):
    builder = newton.ModelBuilder()
    warpmag.register_attributes(builder)
    body = builder.add_body()
    builder.add_shape_sphere(body, radius=R, label="ball")
    warpmag.add_inducible(builder, body=body)
    simulation = warpmag.Simulation(builder, device=device)
    simulation.step()
    write(simulation.model, "saturation", 0, 5.0)
    with pytest.raises(warpmag.InputError, match=r"^ball: model\.warpmag\.saturation was changed"):
        for _ in range(2):
            simulation.step()
            _ = simulation.state
    simulation._magnetics.notify_model_changed()
    simulation.step()


@wp.kernel
def drive(time: wp.array[float], amplitude: wp.array[wp.vec3], field: wp.array[wp.vec3]):
    world = wp.tid()
    field[world] = wp.sin(2.0 * wp.pi * 50.0 * time[0]) * amplitude[world]


@wp.kernel
def advance(dt: float, time: wp.array[float]):
    time[0] = time[0] + dt


def test_64_worlds_driven_by_a_kernel_in_a_graph(device):
    """Each has its own field of 50 Hz, which its ball follows: m = 4π R³ H of ideally permeable iron."""
    world = newton.ModelBuilder()
    warpmag.register_attributes(world)
    ball = world.add_body()
    world.add_shape_sphere(ball, radius=R)
    warpmag.add_inducible(world, body=ball)
    builder = newton.ModelBuilder()
    warpmag.register_attributes(builder)
    builder.replicate(world, 64)
    model = builder.finalize(device=device)
    magnetics, state, dt = warpmag.Magnetics(model, rtol=1e-5), model.state(), 1e-3
    amplitudes = np.random.default_rng(0).normal(size=(64, 3)) * 1e3
    time, field = wp.zeros(1, dtype=float, device=device), wp.zeros(64, dtype=wp.vec3, device=device)
    amplitude = wp.array(amplitudes, dtype=wp.vec3, device=device)

    def substep():
        wp.launch(drive, 64, inputs=[time, amplitude], outputs=[field], device=device)
        wp.launch(advance, 1, inputs=[dt], outputs=[time], device=device)
        magnetics.set_external_field(field)
        state.clear_forces()
        magnetics.apply(state)

    substep()
    time.zero_()
    with wp.ScopedCapture(device) as capture:
        substep()
    time.zero_()  # on a CPU a capture may have run
    for number in range(25):
        wp.capture_launch(capture.graph)
        expected = 3.0 * VOLUME * math.sin(2.0 * math.pi * 50.0 * number * dt) * amplitudes
        np.testing.assert_allclose(magnetics.shape_moments(), expected, rtol=0, atol=1e-4 * 3e3 * VOLUME)
