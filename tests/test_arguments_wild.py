"""Wild arguments of every public function: right against the oracle, or an ``InputError``; never anything else.

Hypothesis draws sizes and strengths over eighty decades, in any guise, and values that are none; ``--wild 2000`` has it
draw that many of each.
"""

import contextlib
import math
import warnings

import newton
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from test_arguments import GUISES, MS, Unreadable, X, call

import warpmag
from bench.reference import oracle

pytestmark = pytest.mark.no_cover  # what is drawn decides no line of the report
STRANGE = st.sampled_from(
    [
        *(None, True, "x", b"x", 1j, math.nan, math.inf, -1, 0, 10**400, 1e300, 1e-300, [], {}, np.ma.masked),
        *(X[:, :1], X[:0], Unreadable(), np.datetime64("2020"), [[1, 2], [3]], "float64", "cpu", "multipole"),
        np.int64(3),
    ]
)
SCALES = st.one_of(st.just(0.0), st.floats(-40.0, 40.0))
GUISE = st.sampled_from([lambda a: a, *GUISES.values()])
NEAREST = 1e-5
"""Distance [contact distances] of balls that nearly coincide, below which the kernels bound the pair law."""


@st.composite
def arrangements(draw):
    """Positions [m], their scale [m] and radii [m] or None: of any size, some of them far, near or coincident."""
    rng = np.random.default_rng(draw(st.integers(0, 2**32)))
    n, scale = draw(st.integers(0, 12)), 10.0 ** draw(st.one_of(st.just(-2.0), st.floats(-12.0, 12.0)))
    x = scale * rng.normal(size=(n, 3))
    if n > 1:
        x[0] *= 10.0 ** draw(st.one_of(st.just(0.0), st.floats(-8.0, 8.0)))
        x[1] = draw(st.sampled_from([x[1], x[0], x[0] * (1.0 + 1e-3)]))
    radii = scale * 10.0 ** rng.uniform(-3.0, 0.5, n)
    return x, scale, draw(st.sampled_from([None, radii, scale * 0.3]))


def single(values, dtype):
    """Values as a call of some precision sees them."""
    with np.errstate(over="ignore"):  # of an external field, where there is no ball to feel it
        return np.asarray(values, float).astype(dtype).astype(float)


def outcome(name, device, /, **arguments):
    """What a call returned, None where it was refused; anything else fails."""
    try:
        result = call(name, device, **arguments)
    except warpmag.InputError as error:
        assert ": " in str(error) and "\n" not in str(error)
        return None
    assert all(np.isfinite(entry).all() for entry in result)
    return result


def scales(x, m, radii):
    """Sizes that sums over pairs are rounded at: of m/d³ and μ0 m m'/d⁴; None where balls all but coincide.

    Where balls overlap in part, both change over the radius of the smaller one, which rounding of d is then part of.
    """
    d, size, reach = np.linalg.norm(x[:, None] - x, axis=2), np.linalg.norm(m, axis=1), np.add.outer(radii, radii)
    if ((d > 0.0) & (d < NEAREST * reach)).any():
        return None
    least = np.minimum.outer(radii, radii)
    partly = (least > 0.0) & (np.abs(d - reach + least) <= 1.001 * least)
    steep = np.maximum(1.0, np.where(partly, d / np.where(least > 0.0, least, 1.0), 1.0))
    d = np.maximum(d, reach)
    np.fill_diagonal(d, 0.0)
    near = np.where(d > 0.0, 1.0 / np.where(d > 0.0, d, 1.0), 0.0)
    fields, forces = (steep * near**3) @ size, 1e-6 * size * ((steep**2 * near**4) @ size)
    return fields.max(initial=0.0), forces.max(initial=0.0), size.max(initial=0.0)


@given(arrangements(), SCALES, st.integers(0, 99), GUISE, st.sampled_from(["float32", "float64"]), st.booleans())
def test_any_field_and_force(device, arrangement, power, seed, guise, dtype, reference):
    x, _, radii = arrangement
    m = 10.0**power * np.random.default_rng(seed).normal(size=x.shape)
    arguments = {"positions": guise(x), "moments": guise(m), "dtype": dtype, "radii": radii}
    arguments["method"] = "reference" if reference else "auto"
    h, wrench = outcome("h_field", device, **arguments), outcome("wrench", device, **arguments)
    if h is None and wrench is None:
        return
    x, m = single(x, dtype), single(m, dtype)
    radii = np.broadcast_to(0.0 if radii is None else single(radii, dtype), len(x))
    size = scales(x, m, radii)
    if size is None:
        return
    rtol, tiny = (5e-5, 1e-30) if dtype == "float32" else (1e-9, 1e-280)
    if h is not None:
        assert np.abs(h[0] - oracle.h_field(x, m, radii=radii)).max(initial=0.0) <= rtol * size[0] + tiny
    if wrench is not None and len(x):
        force = oracle.kelvin_force(m, oracle.field_gradient(x, m, radii=radii))
        torque = oracle.torque(m, oracle.h_field(x, m, radii=radii))
        assert np.abs(wrench[0] - force).max() <= rtol * size[1] + tiny
        assert np.abs(wrench[1] - torque).max() <= rtol * 1e-6 * size[2] * size[0] + tiny


@given(arrangements(), SCALES, SCALES, GUISE, st.sampled_from(["float32", "float64"]), st.booleans())
def test_any_induction(device, arrangement, field, strength, guise, dtype, beside):
    x, scale, radii = arrangement
    radii = scale * 0.5 if radii is None else radii
    applied, saturation = 10.0 ** (5.0 + field) * np.array([0.6, 0.0, 0.8]), MS * 10.0**strength
    arguments = {"positions": guise(x), "radii": radii, "saturation": saturation, "external_field": applied}
    h0 = np.broadcast_to(single(applied, dtype), x.shape).copy()
    if beside:
        places, moments = scale * np.array([[3.0, 1.0, 2.0]]), np.array([[1e5 * scale**3, 0.0, 0.0]])
        arguments["permanent"] = places, moments
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore", warpmag.errors.ConvergenceWarning)
            actual = warpmag.solve_induction(**arguments, dtype=dtype, device=device, max_evaluations=200)
            forces = actual.wrench()
    except warpmag.InputError as error:
        assert ": " in str(error) and "\n" not in str(error)
        return
    m = np.asarray(actual.magnetizations, float)
    assert all(np.isfinite(entry).all() for entry in (m, actual.h_field, *forces, actual.error))
    if not actual.converged:
        return
    x, radii = single(x, dtype), np.broadcast_to(single(radii, dtype), len(x))
    h0 += oracle.h_field(x, m * (4.0 / 3.0 * np.pi * radii**3)[:, None], radii=radii)
    if beside:
        h0 += oracle.h_field(single(places, dtype), single(moments, dtype), x, target_radii=radii)
    wanted, _ = oracle.magnetization(h0, single(saturation, dtype))
    tolerance = 1e-3 + (2e-3 if dtype == "float32" else 1e-8)
    assert np.linalg.norm(m - wanted) <= tolerance * np.linalg.norm(wanted) + (1e-30 if dtype == "float32" else 0.0)


ARGUMENTS = {
    "h_field": "positions moments targets radii target_radii smoothing method rtol dtype device",
    "wrench": "positions moments radii external_field smoothing method rtol dtype device",
    "solve_induction": "positions radii saturation susceptibility curve external_field permanent dynamics "
    "contact_model rtol max_evaluations initial dtype device",
}


def chosen(data, names):
    """Strange values of one to three of some arguments."""
    some = data.draw(st.lists(st.sampled_from(names.split()), min_size=1, max_size=3))
    return {argument: data.draw(STRANGE) for argument in some}


@pytest.mark.parametrize("name", ARGUMENTS)
@given(st.data())
def test_any_value_of_any_argument(device, name, data):
    outcome(name, device, **chosen(data, ARGUMENTS[name]))


@contextlib.contextmanager
def refusals():
    """Let a call be refused by an ``InputError`` of one line; anything else fails."""
    try:
        yield
    except warpmag.InputError as error:
        assert ": " in str(error) and "\n" not in str(error) and len(str(error)) < 1000


@given(st.one_of(STRANGE, st.text(), st.sampled_from(["iron", "N42"])))
def test_any_material(name):
    with refusals():
        assert warpmag.material(name).name == name


def two_shapes():
    """A builder with a ball as a body, above a box that stands still."""
    builder = newton.ModelBuilder()
    warpmag.register_attributes(builder)
    ball = builder.add_body(xform=((0.0, 0.0, 0.03), (0.0, 0.0, 0.0, 1.0)), label="ball")
    builder.add_shape_sphere(ball, radius=0.005)
    builder.add_shape_box(-1, hx=0.01, hy=0.01, hz=0.01, label="box")
    return builder


MAGNETS = {
    "register_attributes": "builder",
    "add_inducible": "builder body shape material saturation susceptibility curve moment_spacing",
    "add_permanent": "builder body shape material magnetization remanence direction recoil_permeability moment_spacing",
}


@pytest.mark.filterwarnings("ignore::DeprecationWarning")
@pytest.mark.parametrize("name", MAGNETS)
@given(st.data())
def test_any_magnet(name, data):
    """What is taken stands in the attributes as it was given."""
    given = chosen(data, MAGNETS[name])
    arguments = {"builder": two_shapes()} | ({} if name == "register_attributes" else {"body": 0})
    if name == "add_permanent":
        arguments["magnetization"] = data.draw(st.sampled_from([(0.0, 0.0, 1e6), np.ones(3), [1, 2, 3]]))
    arguments |= given
    with refusals():
        getattr(warpmag, name)(**arguments)
        values = {key: entry.values for key, entry in arguments["builder"].custom_attributes.items()}
        for key, wanted in given.items():
            if (
                key in ("saturation", "susceptibility", "moment_spacing", "magnetization", "recoil_permeability")
                and wanted is not None
            ):
                (actual,) = values[f"warpmag:{key}"].values()
                assert np.array_equal(np.ravel(actual), np.ravel(wanted))


SETTINGS = "force dynamics contact_model rtol external_field max_evaluations curve"


@pytest.fixture(scope="module")
def magnets(device):
    """A model of an iron ball above a magnet, and its state."""
    builder = two_shapes()
    warpmag.add_inducible(builder, body=0)
    warpmag.add_permanent(builder, shape=1, magnetization=(0.0, 0.0, 1e6), moment_spacing=0.01)
    model = builder.finalize(device=device)
    return model, model.state()


@given(st.data())
def test_any_magnetics(magnets, data):
    """What is taken pulls the ball down to the magnet, or leaves it where the field is that of the void."""
    model, state = magnets
    with refusals():
        magnetics = warpmag.Magnetics(model, **chosen(data, SETTINGS))
        state.clear_forces()
        magnetics.apply(state)
        force = state.body_f.numpy()
        assert np.isfinite(force).all() and force[0, 2] < 0.0


@settings(max_examples=max(1, settings.default.max_examples // 5))  # a simulation takes a fifth of a second
@given(st.data())
def test_any_simulation(device, data):
    """What is taken makes a step, after which the ball is somewhere."""
    names = SETTINGS.replace("max_evaluations ", "") + " dt solver device graphs visuals scene"
    builder = two_shapes()
    warpmag.add_inducible(builder, body=0)
    with refusals(), contextlib.suppress(warpmag.SimulationError):
        simulation = warpmag.Simulation(**{"scene": builder, "device": device} | chosen(data, names))
        simulation.step()
        assert np.isfinite(simulation.state.body_q.numpy()).all()
