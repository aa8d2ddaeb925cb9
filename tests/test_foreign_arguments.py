"""States, models, controls and arrays that do not fit: an ``InputError`` that names the argument, for every function.

Kernels do not check bounds. On the code before these checks such calls wrote beyond arrays, and ended the process.
"""

import re

import newton
import numpy as np
import pytest
import warp as wp
from small_builders import add_ball, new_builder

import warpmag
from warpmag.moments.probe import FieldProbe

M = (0.0, 0.0, 1e6)


class World:
    """A model of a magnet, a conducting ball, iron, a coil on a body and a site, with all that takes its states."""

    def __init__(self, device, *, solved=True):
        self.builder = builder = new_builder()
        add_ball(builder, (0.0, 0.0, 0.0), M)
        add_ball(builder, (0.0, 0.0, 0.02))
        ball = builder.add_body(xform=wp.transform((0.03, 0.0, 0.0), wp.quat_identity()))
        builder.add_shape_sphere(ball, radius=0.005)
        warpmag.add_permanent(builder, body=ball, magnetization=M, conductivity=1e6)
        warpmag.add_coil(builder, body=1, radius=0.01, ampere_turns=1.0, label="coil")
        builder.add_site(1, label="site")
        self.model = builder.finalize(device=device)
        self.magnetics = warpmag.Magnetics(self.model)
        self.sensor = warpmag.SensorMagnetometer(self.model, self.magnetics, "site")
        self.viewer = newton.viewer.ViewerNull()
        self.display = warpmag.Display(self.viewer, self.model, self.magnetics)
        self.state = self.model.state()
        if solved:
            self.magnetics.apply(self.state)

    def vectors(self, count, dtype=wp.vec3):
        return wp.zeros(count, dtype=dtype, device=self.model.device)


@pytest.fixture(scope="module")
def world(device):
    return World(device)


def other_model(device, bodies):
    builder = new_builder()
    for number in range(bodies):
        add_ball(builder, (0.0, 0.0, 0.02 * number), M)
    return builder.finalize(device=device)


OF_STATES = {
    "Magnetics.apply": lambda world, state: world.magnetics.apply(state),
    "Magnetics.induce": lambda world, state: world.magnetics.induce(state),
    "Magnetics.add_forces": lambda world, state: world.magnetics.add_forces(state),
    "Magnetics.moments_at": lambda world, state: world.magnetics.moments_at(state),
    "SensorMagnetometer.update": lambda world, state: world.sensor.update(state),
    "Display.show": lambda world, state: world.display.show(0.0, state),
    "Display.follow": lambda world, state: world.display.follow(0.0, state),
    "Display.apply_forces": lambda world, state: world.display.apply_forces(state),
}


def state_with(**arrays):
    """A state of the model with other arrays."""

    def make(world):
        state = world.model.state()
        for name, array in arrays.items():
            setattr(state, name, array(world) if callable(array) else array)
        return state

    return make


WRONG_STATES = {
    "None": lambda _: None,
    "text": lambda _: "state",
    "a model": lambda world: world.model,
    "a control": lambda world: world.model.control(),
    "of fewer bodies": lambda world: other_model(world.model.device, 1).state(),
    "of more bodies": lambda world: other_model(world.model.device, 7).state(),
    "of no bodies": lambda _: newton.State(),
    "without poses": state_with(body_q=None),
    "poses on the host": state_with(body_q=np.zeros((3, 7), np.float32)),
    "poses of another type": state_with(body_q=lambda world: world.vectors(3)),
    "poses in two dimensions": state_with(body_q=lambda world: wp.zeros((3, 1), dtype=wp.transform)),
}


@pytest.mark.parametrize("wrong", WRONG_STATES)
@pytest.mark.parametrize("name", OF_STATES)
def test_wrong_state(name, wrong, world):
    with pytest.raises(warpmag.InputError, match=r"^state: (body_q: )?must be a "):
        OF_STATES[name](world, WRONG_STATES[wrong](world))


@pytest.mark.cuda
@pytest.mark.parametrize("name", OF_STATES)
def test_state_on_another_device(name, world):
    with pytest.raises(warpmag.InputError, match=r"^state: body_q: must be .* on cuda"):
        OF_STATES[name](world, other_model("cpu", 3).state())


@pytest.mark.cuda
@pytest.mark.parametrize("other", ["cpu", "cuda:1"])
def test_models_on_two_devices(other, device):
    """They are evaluated in turns: equal results, each on its own device, and Warp's own device stays."""
    if other not in [str(place) for place in wp.get_devices()] or not device.startswith("cuda"):
        pytest.skip("needs a second GPU" if other != "cpu" else "needs a GPU")
    before, worlds, results = wp.get_device(), (World(device), World(other)), []
    for world in (*worlds, *worlds):
        state = world.model.state()
        world.magnetics.apply(state)
        assert state.body_f.device == world.model.device
        results.append((world.magnetics.b_field([(0.0, 0.0, 0.05), (0.02, 0.0, 0.0)]), state.body_f.numpy()))
    for result in results[1:]:
        for value, expected in zip(result, results[0], strict=True):
            tolerance = 2e-3 * np.abs(expected).max()  # that of the induction
            np.testing.assert_allclose(value, expected, rtol=0.0, atol=tolerance)
    for call in OF_STATES.values():
        for world, stranger in (worlds, worlds[::-1]):
            with pytest.raises(warpmag.InputError, match=r"^state: body_q: must be .* on "):
                call(world, stranger.model.state())
    assert wp.get_device() == before


@pytest.mark.parametrize("array", ["body_f", "body_qd"])
@pytest.mark.parametrize("wrong", [None, 1, 7])
def test_wrong_forces_and_velocities(array, wrong, world):
    state = world.model.state()
    setattr(state, array, None if wrong is None else world.vectors(wrong, wp.spatial_vector))
    for name in ("Magnetics.apply", "Magnetics.add_forces"):
        with pytest.raises(warpmag.InputError, match=f"^state: {array}: must be a Warp array of .*\\[3\\]"):
            OF_STATES[name](world, state)


OF_MODELS = {
    "Magnetics": lambda world, model: warpmag.Magnetics(model),
    "KeyedCurrents": lambda world, model: warpmag.KeyedCurrents(model),
    "SensorMagnetometer": lambda world, model: warpmag.SensorMagnetometer(model, world.magnetics, "site"),
    "Display": lambda world, model: warpmag.Display(world.viewer, model, world.magnetics),
    "Display.restart": lambda world, model: world.display.restart(model, world.magnetics),
}
OF_MAGNETICS = {
    "SensorMagnetometer": lambda world, value: warpmag.SensorMagnetometer(world.model, value, "site"),
    "Display": lambda world, value: warpmag.Display(world.viewer, world.model, value),
    "Display.restart": lambda world, value: world.display.restart(world.model, value),
}


def changed_model(name, count):
    """A model with an array of another size."""

    def make(world):
        model = other_model(world.model.device, 3)
        owner = model.warpmag if name.startswith("warpmag") else model
        array = getattr(model, name) if owner is model else getattr(owner, name.partition(".")[2])
        setattr(owner, name.rpartition(".")[2], wp.zeros(count, dtype=array.dtype, device=model.device))
        return model

    return make


WRONG_MODELS = {
    "None": lambda _: None,
    "a builder": lambda world: world.builder,
    "a state": lambda world: world.state,
    **{
        f"{name} of {count}": changed_model(name, count)
        for name in ("body_q", "body_com", "body_flags", "shape_transform", "shape_body", "warpmag.magnetization")
        for count in (1, 9)
    },
}


@pytest.mark.parametrize("wrong", WRONG_MODELS)
@pytest.mark.parametrize("name", OF_MODELS)
def test_wrong_model(name, wrong, world):
    with pytest.raises(warpmag.InputError, match=r"^model"):
        OF_MODELS[name](world, WRONG_MODELS[wrong](world))


@pytest.mark.parametrize("name", OF_MAGNETICS)
@pytest.mark.parametrize("bodies", [None, 1, 3, 7])
def test_magnetics_of_another_model(name, bodies, world):
    wrong = None if bodies is None else warpmag.Magnetics(other_model(world.model.device, bodies))
    with pytest.raises(warpmag.InputError, match="magnetics: "):
        OF_MAGNETICS[name](world, wrong)


@pytest.mark.parametrize("viewer", [None, "gl", newton.viewer.ViewerNull])
def test_wrong_viewer(viewer, world):
    with pytest.raises(warpmag.InputError, match="^viewer: "):
        warpmag.Display(viewer, world.model, world.magnetics)


def of_points(name):
    """Measure at points that replaced those of a probe."""

    def measure(world, points):
        probe = world.magnetics.probe(np.zeros((3, 3))) if name == "probe" else FieldProbe(world.magnetics.system, 3)
        probe.points = points
        probe.measure()

    return measure


# arguments of arrays: function, type and size of a right one, and its name
OF_ARRAYS = {
    "set_external_field": (lambda world, a: world.magnetics.set_external_field(a), wp.vec3, 1, "external_field"),
    "set_current": (lambda world, a: world.magnetics.set_current("coil", a), wp.float32, 1, "set_current"),
    "set_magnetization": (
        *(lambda world, a: world.magnetics.set_magnetization(a, body=0), wp.vec3, 1, "magnetization"),
    ),
    "probe": (lambda world, a: world.magnetics.probe(a), wp.vec3, None, "points"),
    "h_field": (lambda world, a: world.magnetics.h_field(a), wp.vec3, None, "points"),
    "b_field": (lambda world, a: world.magnetics.b_field(a), wp.vec3, None, "points"),
    "field_gradient": (lambda world, a: world.magnetics.field_gradient(a), wp.vec3, None, "points"),
    "FieldProbe.measure": (of_points("FieldProbe"), wp.vec3, 3, "points"),
    "Magnetics.probe, points": (of_points("probe"), wp.vec3, 3, "points"),
    "start_from": (lambda world, a: world.magnetics.start_from(a), None, None, "magnetizations"),
    "start_from, vector": (lambda world, a: world.magnetics.start_from({0: a}), None, None, "magnetizations: shape 0"),
}
WRONG_ARRAYS = {
    "None": lambda world, dtype: None,
    "text": lambda world, dtype: "x",
    "an object": lambda world, dtype: object(),
    "a ragged list": lambda world, dtype: [[0.0], [0.0, 1.0]],
    "NaN": lambda world, dtype: np.full((1, 3), np.nan),
    "of quaternions": lambda world, dtype: wp.zeros(1, dtype=wp.quat, device=world.model.device),
    "in two dimensions": lambda world, dtype: wp.zeros((1, 1), dtype=dtype or wp.vec3, device=world.model.device),
}
WRONG_SIZES = [0, 2, 5, 1000]


@pytest.mark.parametrize("wrong", [*WRONG_ARRAYS, *WRONG_SIZES])
@pytest.mark.parametrize("name", OF_ARRAYS)
def test_wrong_array(name, wrong, world):
    call, dtype, count, argument = OF_ARRAYS[name]
    if isinstance(wrong, int) and count is None and dtype is not None:
        call(world, world.vectors(wrong, dtype))  # any number of points
        return
    array = world.vectors(wrong, dtype or wp.vec3) if isinstance(wrong, int) else WRONG_ARRAYS[wrong](world, dtype)
    with pytest.raises(warpmag.InputError, match=f"^{re.escape(argument)}: "):
        call(world, array)


def test_a_start_beyond_single_precision_is_refused(world):
    """NumPy would make it infinite."""
    with pytest.raises(warpmag.InputError, match=r"^magnetizations: shape 0: must be at most 1e\+30 A/m, got "):
        world.magnetics.start_from({0: (0.0, -2e30, 0.0)})


WORLDS = {"of several": [0, 0, 0], "none": [], "fractions": [0.5, 0.5], "negative": [-1, 0], "too many": [0, 1]}
WORLDS |= {"texts": ["a", "b"], "a table": [[0, 0]], "an object": object(), "Warp's": lambda: wp.zeros(7, dtype=int)}


@pytest.mark.parametrize("wrong", WORLDS)
def test_wrong_worlds_of_points(wrong, world):
    worlds, points = WORLDS[wrong], np.full((2, 3), 0.05)
    for name in ("probe", "h_field", "b_field", "field_gradient"):
        with pytest.raises(warpmag.InputError, match="^worlds: "):
            getattr(world.magnetics, name)(points, worlds=worlds() if callable(worlds) else worlds)


@pytest.fixture(scope="module")
def driven(device):
    """Magnets of a model whose coil has a voltage."""
    builder = new_builder()
    add_ball(builder, (0.0, 0.0, 0.0), M)
    warpmag.add_coil(builder, radius=0.01, resistance=1.0, turns=5, label="coil")
    return warpmag.Magnetics(builder.finalize(device=device))


@pytest.mark.parametrize("wrong", [*WRONG_ARRAYS, *WRONG_SIZES])
def test_wrong_voltage(wrong, driven, world):
    array = world.vectors(wrong, wp.float32) if isinstance(wrong, int) else WRONG_ARRAYS[wrong](world, wp.float32)
    with pytest.raises(warpmag.InputError, match="^set_voltage: "):
        driven.set_voltage("coil", array)


OF_BUILDERS = {
    "register_custom_attributes": warpmag.register_custom_attributes,
    "add_inducible": lambda builder: warpmag.add_inducible(builder, body=0),
    "add_permanent": lambda builder: warpmag.add_permanent(builder, body=0, magnetization=M),
    "add_balls": lambda builder: warpmag.add_balls(builder, np.zeros((1, 3)), 0.005),
    "add_coil": lambda builder: warpmag.add_coil(builder, radius=0.01),
    "add_field_map": lambda builder: warpmag.add_field_map(
        builder, origin=(0.0, 0.0, 0.0), spacing=1.0, values=np.zeros((2, 2, 2, 3))
    ),
}


@pytest.mark.parametrize("wrong", [None, "builder", newton.ModelBuilder, "a model", "a state"])
@pytest.mark.parametrize("name", OF_BUILDERS)
def test_wrong_builder(name, wrong, world):
    builder = {"a model": world.model, "a state": world.state}.get(wrong, wrong)
    with pytest.raises(warpmag.InputError, match="^builder: must be a newton.ModelBuilder, got "):
        OF_BUILDERS[name](builder)


@pytest.mark.parametrize("wrong", ["text", "an object", "a ragged list", "NaN", "of quaternions", *WRONG_SIZES])
def test_wrong_sharing(wrong, world):
    array = world.vectors(wrong, wp.int32) if isinstance(wrong, int) else WRONG_ARRAYS[wrong](world, wp.int32)
    with pytest.raises(warpmag.InputError, match="^sharing: must be a Warp array of int32 of shape "):
        world.magnetics.induce(world.state, 1e-3, sharing=array)


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        ({"count": -1}, "count: "),
        ({"count": 2.5}, "count: "),
        ({"count": 2, "worlds": [0]}, "worlds: shape must be"),
        ({"count": 2, "worlds": [0, 0.5]}, "worlds: must be whole"),
        ({"count": 2, "worlds": [0, 1]}, "worlds: must be 0 to 0"),
        ({"count": 2, "worlds": ["a", "b"]}, "worlds: "),
    ],
)
def test_wrong_probe(arguments, message, world):
    with pytest.raises(warpmag.InputError, match=f"^{message}"):
        FieldProbe(world.magnetics.system, **arguments)


@pytest.mark.parametrize("sites", [None, 3, [1.5], [-1], [10**9], [[0]], [None], b"site", {}])
def test_wrong_sites(sites, world):
    with pytest.raises(warpmag.InputError, match="^sites: "):
        warpmag.SensorMagnetometer(world.model, world.magnetics, sites)


@pytest.mark.parametrize("flags", [None, "all", 1.5])
def test_wrong_flags(flags, world):
    with pytest.raises(warpmag.InputError, match="^flags: "):
        world.magnetics.notify_model_changed(flags)


@pytest.mark.parametrize("array", ["model.body_com", "model.shape_transform", "model.warpmag.magnetization"])
def test_replaced_array_of_the_model(array, device):
    model = other_model(device, 2)
    magnetics, state = warpmag.Magnetics(model), model.state()
    owner, name = (model.warpmag if "warpmag" in array else model), array.rpartition(".")[2]
    setattr(owner, name, wp.clone(getattr(owner, name)))
    for function in (magnetics.apply, magnetics.induce, magnetics.add_forces, magnetics.moments_at):
        with pytest.raises(warpmag.InputError, match=f"^model.*: {name} is another array than before"):
            function(state)


def simulation_of_two(device):
    builder = new_builder()
    for height in (0.0, 0.03):
        add_ball(builder, (0.0, 0.0, height), M)
    return warpmag.Simulation(builder, device=device)


@pytest.mark.parametrize("count", [1, 2, 9])
@pytest.mark.parametrize("array", ["state.body_q", "state.body_qd", "state.body_f", "control.joint_f"])
def test_replaced_array_of_a_simulation(array, count, device):
    """Captured steps would go on with the earlier array."""
    simulation = simulation_of_two(device)
    simulation.step()
    part, name = array.split(".")
    owner = getattr(simulation, part)
    setattr(owner, name, wp.zeros(count, dtype=getattr(owner, name).dtype, device=device))
    with pytest.raises(warpmag.InputError, match=f"^{part}: {name} is another array"):
        simulation.step()


@pytest.mark.parametrize("wrong", [None, "x", 1, 9])
def test_wrong_control(wrong, device):
    simulation = simulation_of_two(device)
    control = other_model(device, wrong).control() if isinstance(wrong, int) else wrong
    with pytest.raises(warpmag.InputError, match="^control: "):
        simulation.control = control


@pytest.mark.parametrize("worlds", [[1], [True] * 3, "all", 1, np.ones((1, 1), bool), [[True], [True, False]]])
def test_wrong_worlds_of_a_reset(worlds, device):
    with pytest.raises(warpmag.InputError, match="^worlds: "):
        simulation_of_two(device).reset(worlds)


EARLY = {
    "energy": lambda world: world.magnetics.energy(),
    "shape_moments": lambda world: world.magnetics.shape_moments(),
    "sum_moments": lambda world: world.magnetics.sum_moments(),
    "field_error": lambda world: world.magnetics.field_error(),
    "workload": lambda world: world.magnetics.workload(),
    "h_field": lambda world: world.magnetics.h_field([(0.0, 0.0, 1.0)]),
    "b_field": lambda world: world.magnetics.b_field([(0.0, 0.0, 1.0)]),
    "field_gradient": lambda world: world.magnetics.field_gradient([(0.0, 0.0, 1.0)]),
    "add_forces": lambda world: world.magnetics.add_forces(world.state),
    "a probe": lambda world: world.magnetics.probe([(0.0, 0.0, 1.0)]).measure(),
    "a probe of the system": lambda world: FieldProbe(world.magnetics.system, 1).measure(),
    "a sensor": lambda world: world.sensor.update(world.state),
}


@pytest.fixture(scope="module")
def early(device):
    return World(device, solved=False)


@pytest.mark.parametrize("name", EARLY)
def test_no_result_before_the_first_solve(name, early):
    """Forces, moments, probes and sensors were zero without a word."""
    with pytest.raises(warpmag.InputError, match="^Magnetics: there is no field yet"):
        EARLY[name](early)


@pytest.mark.parametrize("magnetization", [(0.0, 0.0, 1e30), (1e16, 0.0, 0.0), (0.0, -3e38, 0.0)])
def test_magnetization_beyond_single_precision(magnetization, device):
    """Fields and forces were NaN, without a word."""
    builder = new_builder()
    with pytest.raises(warpmag.InputError, match="magnetization: components must be at most 1e.15"):
        add_ball(builder, (0.0, 0.0, 0.0), magnetization)
    magnetics = warpmag.Magnetics(other_model(device, 2))
    with pytest.raises(warpmag.InputError, match="magnetization: components must be at most 1e.15"):
        magnetics.set_magnetization(magnetization, body=1)


def test_steps_without_a_run_have_no_duration(device):
    simulation = simulation_of_two(device)
    simulation.step()
    (line,) = (line for line in simulation.finish().summary() if line.startswith("time per step"))
    assert "with output" not in line


@pytest.mark.parametrize("step", [-1, 0.5, None, "1", True, np.ones(1)])
def test_wrong_step_of_statistics(step, device):
    simulation = simulation_of_two(device)
    simulation.step()
    statistics = simulation.finish()
    with pytest.raises(warpmag.InputError, match="^step: must be "):
        statistics.milliseconds_since(step)
    with pytest.raises(warpmag.InputError, match="^details: must be True or False"):
        statistics.summary(details=step if step is not True else "yes")


def test_builder_that_grows_after_its_model(device):
    """Newton's models share lists with their builders; forces are those of the model alone."""
    forces = []
    for grows in (False, True):
        builder = new_builder()
        add_ball(builder, (0.0, 0.0, 0.0), M)
        add_ball(builder, (0.0, 0.0, 0.02))
        builder.add_site(0, label="site")
        model = builder.finalize(device=device)
        if grows:
            add_ball(builder, (0.0, 0.0, 0.04), M)
            builder.add_site(2, label="site of a later body")
        magnetics, state = warpmag.Magnetics(model), model.state()
        magnetics.apply(state)
        assert warpmag.SensorMagnetometer(model, magnetics, "site*").sites == [2]
        forces.append(state.body_f.numpy())
    assert np.abs(forces[0]).max() > 0.0
    np.testing.assert_array_equal(forces[1], forces[0])
