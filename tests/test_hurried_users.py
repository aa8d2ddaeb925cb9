"""Programs of hurried users: they ask early or twice, pass other libraries' arrays, and stop too soon."""

import contextlib
import copy
import math
import pickle

import newton
import numpy as np
import pytest
import warp as wp
from small_builders import add_ball, new_builder

import warpmag
from bench.reference.ball_in_field import box_field
from warpmag.declarations.magnets import Magnet
from warpmag.engine.magnets.attributes import stored_values
from warpmag.kernels.pairs.wrench import MU0
from warpmag.moments.probe import FieldProbe

M = (0.0, 0.0, 1e6)
POINTS = [(0.0, 0.0, 0.01), (0.02, 0.01, 0.0)]


def pair(device, **options):
    """A builder of a magnet below an iron ball."""
    builder = new_builder()
    add_ball(builder, (0.0, 0.0, 0.0), M)
    add_ball(builder, (0.0, 0.0, 0.011))
    return builder


def everything(device):
    """A model of all that a solve reads: balls that conduct, recoil and yield, a box of iron, coils, and its state."""
    builder = pair(device)
    for place, options in (((0.03, 0.0, 0.0), {"conductivity": 1e6}), ((0.0, 0.03, 0.0), {"recoil_permeability": 1.1})):
        ball = builder.add_body(xform=wp.transform(place, wp.quat_identity()))
        builder.add_shape_sphere(ball, radius=0.005)
        warpmag.add_permanent(builder, body=ball, magnetization=M, **options)
    box = builder.add_body(xform=wp.transform((0.0, -0.04, 0.0), wp.quat_identity()))
    builder.add_shape_box(box, hx=0.01, hy=0.005, hz=0.005)
    warpmag.add_inducible(builder, body=box, material="iron")
    warpmag.add_coil(builder, body=1, radius=0.01, ampere_turns=100.0)
    warpmag.add_coil(builder, radius=0.05, ampere_turns=50.0)
    return builder.finalize(device=device)


def moved(model, seed):
    """A state with other poses and velocities."""
    state, rng = model.state(), np.random.default_rng(seed)
    poses = state.body_q.numpy()
    poses[:, :3] += rng.uniform(-0.002, 0.002, (len(poses), 3))
    turns = rng.normal(size=(len(poses), 4))
    poses[:, 3:] = turns / np.linalg.norm(turns, axis=1, keepdims=True)
    state.body_q.assign(poses)
    state.body_qd.assign(rng.normal(size=(len(poses), 6)))
    return state


def answers(magnetics):
    return magnetics.b_field(POINTS), magnetics.field_gradient(POINTS), magnetics.energy(), magnetics.shape_moments()


def test_magnets_of_a_simulation_are_solved_from_the_start(device):
    builder = pair(device)
    simulation = warpmag.Simulation(builder, device=device)
    model = builder.finalize(device=device)
    magnetics = warpmag.Magnetics(model)
    magnetics.apply(model.state())
    for early, expected in zip(answers(simulation.magnetics), answers(magnetics), strict=True):
        assert np.abs(expected).max() > 0.0
        np.testing.assert_allclose(early, expected, rtol=2e-3, atol=1e-3 * np.abs(expected).max())  # rtol of the solve
    before = simulation.magnetics.b_field(POINTS)
    simulation.step()
    assert not np.array_equal(before, simulation.magnetics.b_field(POINTS))


def test_moments_elsewhere_leave_everything_as_it_is(device):
    """Fields and energies, and the forces of a solve whose forces are added later; the moments differ."""
    model = everything(device)
    magnetics, state, other = warpmag.Magnetics(model, rtol=1e-5), moved(model, 1), moved(model, 2)
    with pytest.raises(warpmag.InputError, match="there is no field yet"):
        magnetics.moments_at(other)
        magnetics.energy()
    magnetics.induce(state)
    before, forces = answers(magnetics), []
    magnetics.add_forces(state)
    forces.append(state.body_f.numpy().copy())
    elsewhere = magnetics.moments_at(other)
    state.clear_forces()
    magnetics.add_forces(state)
    forces.append(state.body_f.numpy())
    assert np.abs(elsewhere - before[3]).max() > 1e-2 * np.abs(before[3]).max()
    for earlier, later in zip(before, answers(magnetics), strict=True):
        assert np.abs(earlier).max() > 0.0
        np.testing.assert_array_equal(later, earlier)
    # the field is summed anew, from the final moments in place of those of the last iteration: rounding
    np.testing.assert_allclose(forces[1], forces[0], atol=1e-5 * np.abs(forces[0]).max())


def test_results_stay_when_the_next_ones_come(device):
    model = pair(device).finalize(device=device)
    magnetics = warpmag.Magnetics(model)
    magnetics.apply(model.state())
    moments, kept = (magnetics.shape_moments() for _ in range(2))
    magnetics.apply(moved(model, 3))
    magnetics.shape_moments()
    np.testing.assert_array_equal(moments, kept)


ASKING = {
    "apply": lambda magnetics, state: magnetics.apply(state),
    "energy": lambda magnetics, state: magnetics.energy(),
    "shape_moments": lambda magnetics, state: magnetics.shape_moments(),
    "h_field": lambda magnetics, state: magnetics.h_field(POINTS),
    "moments_at": lambda magnetics, state: magnetics.moments_at(state),
}


@pytest.mark.parametrize("name", ASKING)
def test_an_unconverged_solve_warns(name, device):
    builder = new_builder()
    add_ball(builder, (0.0, 0.0, 0.0), M)
    for number in range(1, 6):
        add_ball(builder, (0.0, 0.0, 0.01 * number))
    model = builder.finalize(device=device)
    magnetics, state = warpmag.Magnetics(model, max_evaluations=2, rtol=1e-5), model.state()
    magnetics.induce(state)
    if name == "apply" and magnetics.device.is_cuda:
        pytest.skip("does not wait for a GPU")
    with pytest.warns(warpmag.ConvergenceWarning, match=r"error .* > rtol 1e-05 after 2 evaluations$") as caught:
        ASKING[name](magnetics, state)
    assert caught[0].filename == __file__  # names the line of the caller


def test_results_can_be_pickled_and_copied(device):
    result = warpmag.solve_induction(
        [[0.0, 0.0, 0.0], [0.0, 0.0, 0.012]], 0.005, saturation=1e6, external_field=(0.0, 0.0, 1e5), device=device
    )
    for other in (pickle.loads(pickle.dumps(result)), copy.deepcopy(result), copy.copy(result)):
        np.testing.assert_array_equal(other.magnetizations, result.magnetizations)
        np.testing.assert_array_equal(other.h_field, result.h_field)
        assert (other.error, other.evaluations, other.converged) == (result.error, result.evaluations, result.converged)
        with pytest.raises(warpmag.InputError, match="^wrench: a copied or unpickled result"):
            other.wrench()
    assert np.isfinite(result.wrench()[0]).all()


class Tensor:
    """Stand-in for a tensor of PyTorch: ``numpy()`` fails where a GPU or a gradient holds the numbers."""

    def __init__(self, values, readable=True):
        self._values, self._readable = np.asarray(values), readable

    def numpy(self):
        if not self._readable:
            raise TypeError("can't convert cuda:0 device type tensor to numpy")
        return self._values

    __array__ = lambda self, dtype=None, copy=None: self.numpy().astype(dtype)  # noqa: E731


VECTORS = {
    "Warp array of floats": lambda values: wp.array(np.array(values, np.float32), dtype=float, device="cpu"),
    "Warp array of a vector": lambda values: wp.array([values], dtype=wp.vec3, device="cpu"),
    "Warp vector": lambda values: wp.vec3(*values),
    "Warp vector of doubles": lambda values: wp.vec3d(*values),
    "tensor": Tensor,
    "NumPy": lambda values: np.array(values, np.float32),
    "numbers of Warp": lambda values: [wp.float32(value) for value in values],
}


@pytest.mark.parametrize("kind", VECTORS)
def test_vectors_and_numbers_of_other_libraries(kind):
    make, number = VECTORS[kind], wp.float32(1.25) if "Warp" in kind else np.float32(1.25)

    def marked(**arguments):
        builder = new_builder()
        ball = builder.add_body()
        builder.add_shape_sphere(ball, radius=0.005)
        warpmag.add_permanent(builder, body=ball, **arguments)
        coil = warpmag.add_coil(builder, radius=number, ampere_turns=number, wire_radius=wp.float64(0.01))
        values = {name: dict(entry.values) for name, entry in builder.custom_attributes.items()}
        return tuple(values["warpmag:magnetization"][0]), values["warpmag:strength"][coil]

    x, y, z = (0.0, 3e5, 4e5)
    assert marked(magnetization=make((x, y, z))) == ((x, y, z), 1.25)
    assert marked(direction=make((0.0, 3.0, 4.0)), remanence=number) == (
        marked(direction=(0.0, 3.0, 4.0), remanence=1.25)
    )
    settings = warpmag.Simulation(pair("cpu"), external_field=make((x, y, z)), device="cpu")
    np.testing.assert_allclose(settings.magnetics.external_field.numpy(), [(x, y, z)] * 2)
    warpmag.add_balls(builder := new_builder(), POINTS, 0.005, color=make((0.1, 0.2, 0.3)))
    np.testing.assert_allclose(builder.shape_color, [(0.1, 0.2, 0.3)] * 2, rtol=1e-6)


NO_VECTORS = {
    "bytes": b"\1\2\3",
    "array of bytes": bytearray(b"\1\2\3"),
    "view of bytes": memoryview(b"\1\2\3"),
    "text": "123",
    "texts": np.array(["1", "2", "3"]),
    "objects": np.array([None] * 3),
    "set": {1.0, 2.0, 3.0},
    "table": {0: 1.0, 1: 2.0, 2: 3.0},
}


@pytest.mark.parametrize("kind", NO_VECTORS)
def test_bytes_texts_and_sets_are_no_numbers(kind):
    """Numbers without an order, or in a form that NumPy and Python read as numbers though nobody meant them."""
    value, table, curve = NO_VECTORS[kind], [0.0, 1.0, 1.5], warpmag.MagnetizationCurve.from_bh
    calls = {
        "magnetization": lambda: warpmag.add_permanent(pair("cpu"), body=0, magnetization=value),
        "color": lambda: warpmag.add_balls(pair("cpu"), POINTS, 0.005, color=value),
        "label": lambda: warpmag.add_balls(pair("cpu"), POINTS, 0.005, label=0 if kind == "text" else value),
        "radius": lambda: warpmag.add_balls(pair("cpu"), np.zeros((3, 3)), value),
        "points": lambda: warpmag.add_coil(pair("cpu"), shape="polyline", points=value, ampere_turns=1.0),
        "moments": lambda: warpmag.h_field(POINTS, value, POINTS),
        "curve: fields": lambda: curve(value, table),
        "curve: flux densities": lambda: curve([0.0, 1e3, 1e4], value),
        "curve: saturation": lambda: curve([0.0, 1e3, 1e4], table, saturation=value),
        "name": lambda: curve([0.0, 1e3, 1e4], table, name=0 if kind == "text" else value),
    }
    for name, call in calls.items():
        with pytest.raises(warpmag.InputError, match=rf"^(\w+: )?{name}:? [^\n]*$"):
            call()


@pytest.mark.parametrize("argument", ["magnetization", "direction"])
def test_a_tensor_that_cannot_be_read(argument):
    builder = pair("cpu")
    more = {"remanence": 1.2} if argument == "direction" else {}
    with pytest.raises(warpmag.InputError, match=f"^{argument}: cannot be read as a NumPy array .can't convert cuda"):
        warpmag.add_permanent(builder, body=0, **{argument: Tensor(M, readable=False)}, **more)


SHAPES = {
    "sphere": lambda builder, body, size: builder.add_shape_sphere(body, radius=size),
    "box": lambda builder, body, size: builder.add_shape_box(body, hx=size, hy=0.01, hz=0.01),
    "capsule": lambda builder, body, size: builder.add_shape_capsule(body, radius=0.01, half_height=size),
    "cylinder": lambda builder, body, size: builder.add_shape_cylinder(body, radius=size, half_height=0.01),
    "cone": lambda builder, body, size: builder.add_shape_cone(body, radius=0.01, half_height=size),
    "ellipsoid": lambda builder, body, size: builder.add_shape_ellipsoid(body, rx=0.01, ry=0.01, rz=size),
}


@pytest.mark.parametrize("size", [0.0, math.nan, math.inf, 1e-30, 1e30])
@pytest.mark.parametrize("shape", SHAPES)
def test_sizes_of_magnetic_shapes(shape, size):
    builder = new_builder()
    body = builder.add_body()
    SHAPES[shape](builder, body, size)
    for add in (warpmag.add_inducible, lambda *a, **k: warpmag.add_permanent(*a, magnetization=M, **k)):
        with pytest.raises(warpmag.InputError, match=r"^shape_0: sizes must be from 1e-08 to 20000 m, got "):
            add(builder, body=body)


SLENDER = {
    "foil": lambda builder, body: builder.add_shape_box(body, hx=1e4, hy=1e4, hz=1e-7),
    "strip": lambda builder, body: builder.add_shape_box(body, hx=1e-7, hy=1e-3, hz=1e3),
    "wire": lambda builder, body: builder.add_shape_cylinder(body, radius=1e-7, half_height=1e3),
    "disc": lambda builder, body: builder.add_shape_cylinder(body, radius=1e4, half_height=1e-7),
    "needle": lambda builder, body: builder.add_shape_ellipsoid(body, rx=1e-7, ry=1e-7, rz=1e3),
}


@pytest.mark.filterwarnings("ignore:Inertia validation")
@pytest.mark.parametrize("permanent", [False, True])
@pytest.mark.parametrize("shape", SLENDER)
def test_shapes_slender_beyond_all_measure(shape, permanent):
    """Their counts of cells exceed 64 bits, and their matrices are singular: few moments, or one line."""
    builder = new_builder()
    SLENDER[shape](builder, body := builder.add_body())
    if permanent:
        warpmag.add_permanent(builder, body=body, magnetization=M)
    else:
        warpmag.add_inducible(builder, body=body, material="iron")
    with contextlib.suppress(warpmag.InputError):
        assert warpmag.Magnetics(builder.finalize(device="cpu")).shape_volumes.shape == (1,)


def test_a_spacing_too_fine_for_a_wide_shape_beside():
    """It would need billions of test points, which took gigabytes."""
    builder = new_builder()
    body = builder.add_body()
    builder.add_shape_box(body, hx=0.01, hy=0.01, hz=0.01)
    tilted = wp.transform((1.0, 0.0, 0.0), wp.quat_rpy(0.3, 0.4, 0.5))
    builder.add_shape_box(body, xform=tilted, hx=2.5, hy=2.5, hz=1e-7)
    warpmag.add_inducible(builder, body=body, moment_spacing=0.02)
    with pytest.raises(warpmag.InputError, match="^shape_0: spacing: cells of .* would need .* test points: give"):
        warpmag.Magnetics(builder.finalize(device="cpu"))


FOIL = (0.5, 0.5, 5e-5)  # half sides [m]: 62,500 cells of 4 mm, though its volume is that of 1,600 cubes of 4 mm


@pytest.mark.parametrize("spacing", [4e-3, 1e-3, 1e-6])
@pytest.mark.parametrize(("permanent", "most"), [(True, 4096), (False, 20000)])
def test_a_spacing_too_fine_for_a_foil(permanent, most, spacing):
    """A foil is one cell across: the number of cells does not follow from its volume."""
    builder = new_builder()
    builder.add_shape_box(body := builder.add_body(), hx=FOIL[0], hy=FOIL[1], hz=FOIL[2])
    if permanent:
        warpmag.add_permanent(builder, body=body, magnetization=M, moment_spacing=spacing)
    else:
        warpmag.add_inducible(builder, body=body, moment_spacing=spacing)
    with pytest.raises(warpmag.InputError, match=f"^shape_0: spacing: .* needs more than {most} moments"):
        warpmag.Magnetics(builder.finalize(device="cpu"))


@pytest.mark.filterwarnings("ignore:Inertia validation")
@pytest.mark.parametrize("spacing", [0.0, 0.02])
def test_a_speck_at_the_edge_of_a_foil(device, spacing):
    """A magnet 50,000 times smaller than the foil is a moment in its field. Few moments stand for the foil, and the
    reaction is the opposite force."""
    center, half, m = np.array([0.5004, 0.1, 1e-3]), 1e-5, np.array([2e5, 1e5, 3e5])
    builder = new_builder()
    builder.add_shape_box(foil := builder.add_body(), hx=FOIL[0], hy=FOIL[1], hz=FOIL[2])
    warpmag.add_permanent(builder, body=foil, magnetization=(0.0, 0.0, 1e6), moment_spacing=spacing)
    speck = builder.add_body(xform=wp.transform(center, wp.quat_identity()))
    builder.add_shape_box(speck, hx=half, hy=half, hz=half)
    warpmag.add_permanent(builder, body=speck, magnetization=m)
    magnetics = warpmag.Magnetics(builder.finalize(device=device))
    assert magnetics.system.count <= 4096
    magnetics.apply(state := magnetics.model.state())
    step = 1e-6 * np.eye(3)
    slopes = (box_field(center + step, FOIL, 1e6) - box_field(center - step, FOIL, 1e6)) / 2e-6  # ∂H_i/∂x_k, [k, i]
    expected = MU0 * (2.0 * half) ** 3 * slopes @ m
    forces = state.body_f.numpy()[:, :3]
    size = np.linalg.norm(expected)
    np.testing.assert_allclose(forces[speck], expected, atol=1e-3 * size)
    np.testing.assert_allclose(forces[foil], -forces[speck], atol=1e-5 * size)


def test_a_probe_of_as_many_points_as_numpy_counts(device):
    system = warpmag.Magnetics(pair(device).finalize(device=device)).system
    assert FieldProbe(system, np.int64(3)).points.shape == (3,)


def test_equal_curves_share_a_number():
    """A process that makes the same curve again and again keeps one of them."""
    fields = np.array([0.0, 1e3, 1e4, 1e5])
    curves = [warpmag.MagnetizationCurve.from_mh(fields, [0.0, 1e5, 1.0e6, 1.1e6 + k % 2]) for k in range(6)]
    numbers = [stored_values(Magnet(curve=curve))["curve"] for curve in curves]
    assert numbers == numbers[:2] * 3 and len(set(numbers)) == 2


def test_static_magnets_with_a_coil_alone(device):
    """No body moves: fields and a simulation work, and a coil without any magnet is one line."""
    builder = new_builder()
    block = builder.add_shape_box(-1, hx=0.01, hy=0.01, hz=0.01)
    warpmag.add_coil(builder, radius=0.03, ampere_turns=1000.0, label="coil")
    with pytest.raises(warpmag.InputError, match="^model: has no magnets"):
        warpmag.Magnetics(builder.finalize(device=device))
    warpmag.add_inducible(builder, shape=block, material="iron")
    builder.add_site(-1, xform=wp.transform((0.0, 0.0, 0.02), wp.quat_identity()), label="site")
    simulation = warpmag.Simulation(builder, device=device)
    sensor = warpmag.SensorMagnetometer(simulation.model, simulation.magnetics, "site")
    readings = []
    for current in (1000.0, 500.0):
        simulation.magnetics.set_current("coil", current)
        simulation.step()
        simulation.magnetics.induce(simulation.state)
        sensor.update(simulation.state)
        readings.append(sensor.flux_density.numpy()[0].copy())
    assert readings[0][2] > 1e-3
    np.testing.assert_allclose(readings[1], 0.5 * readings[0], atol=2e-3 * readings[0][2])  # iron far from saturation


def test_another_device_is_one_line():
    for device in ("cuda:77", "tpu", 3.5):
        with pytest.raises(warpmag.InputError, match="^device: no .* here; available: cpu"):
            warpmag.Simulation(pair("cpu"), device=device)
    with pytest.raises(warpmag.InputError, match="^model: must be a newton.Model"):
        warpmag.Magnetics(newton.ModelBuilder())
