"""``warpmag.jax``: values are those of the calls on arrays, and gradients pass ``jax.test_util.check_grads``."""

from functools import partial

import numpy as np
import pytest
import warp as wp
from wrong_calls import WRONG

jax = pytest.importorskip("jax", reason="JAX is not installed")

import jax.numpy as jnp  # noqa: E402
from jax.test_util import check_grads  # noqa: E402

import warpmag  # noqa: E402
import warpmag.jax  # noqa: E402
from bench.gradients import field_gradients  # noqa: E402


@pytest.fixture(autouse=True)
def double_precision():
    before = jax.config.jax_enable_x64
    jax.config.update("jax_enable_x64", True)  # for all threads, because JAX calls warpmag from another
    yield
    jax.config.update("jax_enable_x64", before)


@pytest.fixture(params=["own", "given"])
def place(request, device):
    """Device argument of calls: None for that of the arrays, whose memory is shared, or the device under test."""
    return None if request.param == "own" else device


def arrays(*shapes, scale=1.0):
    rng = np.random.default_rng(11)
    return [jnp.asarray(scale * rng.normal(size=shape)) for shape in shapes]


def check(function, arguments):
    check_grads(function, arguments, order=1, modes=["rev"], eps=1e-5, rtol=1e-5, atol=1e-9)


def test_field(place, device):
    x, m, targets = arrays((4, 3), (4, 3), (3, 3))
    field = jax.jit(lambda *a: warpmag.jax.h_field(*a, radii=0.1, device=place))(x, m, targets)
    expected = warpmag.h_field(*map(np.asarray, (x, m, targets)), radii=0.1, dtype="float64", device=device)
    assert field.dtype == jnp.float64 and np.allclose(field, expected, rtol=1e-12, atol=0.0)
    check(lambda *a: warpmag.jax.h_field(*a, device=place), (x, m, targets))


def test_wrench(place):
    x, m, field = arrays((4, 3), (4, 3), (3,))

    def scaled(x, m, field):  # newtons would be too small for the absolute tolerance
        return [1e6 * part for part in warpmag.jax.wrench(x, m, external_field=field, device=place)]

    check(scaled, (x, m, field))
    batch = jax.vmap(lambda x: scaled(x, m, field)[0])(jnp.stack([x, 2.0 * x]))
    assert np.allclose(batch[1], scaled(2.0 * x, m, field)[0], rtol=1e-12)


def test_equilibrium(place):
    noise, field, dipoles, dipole_moments = arrays((4, 3), (3,), (2, 3), (2, 3), scale=0.1)
    lattice = np.stack(np.meshgrid([0, 1], [0, 1], [0]), -1).reshape(-1, 3)

    def solve(noise, radii, saturation, susceptibility, field, dipoles, dipole_moments):
        result = warpmag.jax.solve_induction(
            lattice + noise, radii, saturation=saturation, susceptibility=susceptibility, rtol=1e-12,
            external_field=20.0 * field, permanent=(dipoles + 2.0, dipole_moments), device=place,
        )  # fmt: skip
        return result.magnetizations, result.h_field, 1e6 * result.wrench()[0]

    radii = jnp.array([0.3, 0.25, 0.3, 0.35])
    check(solve, (noise, radii, jnp.float64(2.0), jnp.float64(30.0), field, dipoles, dipole_moments))


def test_points_of_a_curve(place):
    positions = jnp.array([[0.0, 0.0, 0.0], [0.0, 0.3, 0.9]])

    def solve(fields, magnetizations):
        result = warpmag.jax.solve_induction(
            positions, 0.3, curve_points=(fields, magnetizations), external_field=(0.0, 0.0, 3.0), rtol=1e-12,
            device=place,
        )  # fmt: skip
        return result.magnetizations, 1e6 * result.wrench()[0]

    check(solve, (jnp.array([0.5, 1.0, 3.0]), jnp.array([2.0, 4.0, 5.0])))


def test_what_has_no_gradient_raises(place):
    x, m = arrays((3, 3), (3, 3))
    with pytest.raises(Exception, match="radii: requires a gradient"):
        # on a GPU JAX runs calls later, and raises their errors when results are read
        jax.block_until_ready(jax.grad(lambda radius: warpmag.jax.h_field(x, m, radii=radius, device=place).sum())(0.1))
    with pytest.raises(warpmag.InputError, match="positions: must be float32 or float64"):
        warpmag.jax.h_field(x.astype(jnp.float16), m)


@pytest.mark.parametrize("case", WRONG)
def test_wrong_arguments_are_one_line(case, place):
    call, message = WRONG[case]
    x, m = arrays((3, 3), (3, 3))
    with pytest.raises(warpmag.InputError, match=f"^{message}$"):
        call(partial(warpmag.jax.h_field, device=place), x, m)


def test_on_a_tape_of_warp(place):
    """Warp's active tape neither records the call nor gets in its way."""
    x, m = arrays((4, 3), (4, 3))

    def force(x):
        return warpmag.jax.wrench(x, m, device=place)[0][0, 0]

    expected = jax.grad(force)(x)
    with wp.Tape() as tape:
        gradient = jax.grad(force)(x).block_until_ready()
    assert np.array_equal(gradient, expected) and not tape.launches


def test_gradients_are_those_of_magpylib_jax(device):
    """Field of 40 permanent dipoles at other points, by positions, moments and points."""
    peer_module = pytest.importorskip("bench.peers.with_magpylib_jax", reason="magpylib-jax is not installed")
    arrays = np.random.default_rng(2).uniform(-1.0, 1.0, (4, 40, 3))
    peer = peer_module.field_gradients(*arrays)
    peer.run()
    peer.wait()
    for own, other in zip(field_gradients(*arrays, device=device), peer.result(), strict=True):
        assert np.allclose(own, other, rtol=0.0, atol=1e-12 * np.abs(other).max())  # sums of 40 terms in float64
