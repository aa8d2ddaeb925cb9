"""Induction against the float64 Newton solution, closed forms and its own residual."""

import itertools

import numpy as np
import pytest
import warp as wp
from arrangements import as_float32, fcc_block, overlapping, pile, relative

import warpmag
from bench.arrangements import ARRANGEMENTS, arranged, trace
from bench.reference import oracle
from bench.systems import moment_system
from warpmag.declarations import magnets

MS = 1.7e6


@pytest.fixture(scope="module")
def block():
    """FCC block of 1,008 touching balls under a dipole that saturates its top, and the oracle's equilibrium."""
    x = as_float32(fcc_block())[0]
    source = np.append(x[:, :2].mean(0), x[:, 2].max() + 0.03)[None]
    moment = np.array([[0.0, 0.0, 900.0]])  # 3‖H‖ is 9 Ms at the top, and 0.1 Ms at the bottom
    radius = float(np.float32(0.005))
    exact = oracle.equilibrium(x, radius, oracle.h_field(source, moment, x), saturation=MS)
    assert exact.residual < 1e-12
    return x, radius, (source, moment), exact


@pytest.mark.parametrize("curve", magnets.CURVES)
@pytest.mark.parametrize("susceptibility", [1.0, np.inf])
@pytest.mark.parametrize("strength", [0.0, 1e-12, 1e-6, 1e-2, 0.3, 1.0, 10.0, 1e6])
def test_isolated_ball_takes_one_iteration(curve, susceptibility, strength, device):
    h0 = strength * MS * np.array([[0.6, 0.0, 0.8]])
    result = warpmag.solve_induction(
        np.zeros((1, 3)), 0.005, saturation=MS, susceptibility=susceptibility, curve=curve,
        external_field=h0, rtol=1e-5, device=device,
    )  # fmt: skip
    exact, _ = oracle.magnetization(h0, MS, susceptibility, curve)
    assert result.evaluations == 1 and result.converged
    # a few float32 roundings of the curve
    assert np.linalg.norm(result.magnetizations - exact) <= 1e-6 * np.linalg.norm(exact)


@pytest.mark.filterwarnings("ignore:solve_induction. did not converge")  # ended on purpose
@pytest.mark.parametrize("evaluations, error", [(6, 1e-2), (8, 1e-3), (11, 1e-4)])
@pytest.mark.parametrize("dtype", ["float32", "float64"])
def test_cold_block_converges_fast(block, evaluations, error, dtype, device):
    x, radius, permanent, exact = block
    result = warpmag.solve_induction(
        x,
        radius,
        saturation=MS,
        permanent=permanent,
        rtol=2e-6,
        max_evaluations=evaluations,
        dtype=dtype,
        device=device,
    )
    assert result.evaluations <= evaluations
    assert relative(result.magnetizations, exact.magnetizations) < error


def test_tight_tolerance_reaches_the_newton_solution(block, device):
    x, radius, permanent, exact = block
    result = warpmag.solve_induction(
        x, radius, saturation=MS, permanent=permanent, rtol=1e-11, dtype="float64", device=device
    )
    assert result.converged and result.error <= 1e-11
    # the residual is amplified by the inverse Jacobian, whose norm is below 20 here
    assert relative(result.magnetizations, exact.magnetizations) < 1e-9
    assert relative(result.h_field, exact.h) < 1e-9


@pytest.mark.parametrize("name", ARRANGEMENTS)
def test_error_bounds_the_distance_from_the_solution(name, device):
    """The magnetization is within ``.error`` of the Newton solution, ``.error`` within rtol; evaluations are few."""
    arrangement = ARRANGEMENTS[name]()
    radii = as_float32(arrangement.radii)[0]
    exact = oracle.equilibrium(arrangement.positions, radii, arrangement.applied, **arrangement.material)
    assert exact.residual < 1e-12
    for dtype, rtol in itertools.product(("float32", "float64"), (1e-2, 1e-3, 1e-4, 1e-5)):
        # float32 fields have relative errors of a few 1e-7, which the inverse Jacobian amplifies up to ten times
        rounding = 3e-6 if dtype == "float32" else 1e-11
        system = arranged(arrangement, rtol=rtol, dtype=dtype, device=device)
        residuals = trace(system)
        error = relative(system.magnetizations().numpy(), exact.magnetizations)
        assert error <= system.error.numpy()[0] + rounding
        assert system.error.numpy()[0] <= rtol and system.converged.numpy()[0]
        # deep overlaps converge slowly, with residuals much smaller than the error: 2, with other rounding 3
        late = 3 if name == "overlapping balls" else 1
        assert len(residuals) <= 1 + np.argmax(residuals <= rtol) + late


def test_residual_is_that_of_the_last_evaluation(block, device):
    """The residual is ‖M − f(H(M))‖/‖f(H(M))‖ (Eq. 12), evaluated independently."""
    x, radius, permanent, _ = block
    applied = oracle.h_field(*permanent, x)
    system = moment_system(
        radii=np.full(len(x), radius), saturation=MS, external_field=applied, rtol=1e-6, dtype="float64", device=device
    )
    system.positions.assign(x)
    system.begin()
    volume = 4.0 / 3.0 * np.pi * radius**3
    for _ in range(3):
        system.dynamics.refine()
        moments = system.moments.numpy().copy()
        system.evaluate()
        system.dynamics.iterate()
        goal, _ = oracle.magnetization(applied + oracle.h_field(x, moments, radii=radius), MS)
        assert system.residual.numpy()[0] == pytest.approx(relative(moments / volume, goal), rel=1e-9)


@pytest.mark.parametrize("dtype", ["float32", "float64"])
def test_magnetizations_and_fields_are_the_materials(block, dtype, device):
    """The returned M and H satisfy M = f(H), however early the solve ends."""
    x, radius, permanent, _ = block
    result = warpmag.solve_induction(
        x, radius, saturation=MS, permanent=permanent, rtol=1e-1, dtype=dtype, device=device
    )
    expected, _ = oracle.magnetization(result.h_field, MS)
    assert relative(result.magnetizations, expected) < (1e-6 if dtype == "float32" else 1e-14)


def test_warm_start_and_initial(block, device):
    x, radius, permanent, exact = block
    settings = {"saturation": MS, "permanent": permanent, "rtol": 1e-4, "device": device}
    cold = warpmag.solve_induction(x, radius, **settings)
    again = warpmag.solve_induction(x, radius, initial=exact.magnetizations, **settings)
    assert again.evaluations == 1 < cold.evaluations


@pytest.mark.parametrize("strength", [0.3, 1.0, 10.0, 1e3])
@pytest.mark.parametrize("extent", [0.1, 0.05])
def test_overlapping_at_will_has_one_solution(extent, strength, device):
    """400 randomly placed balls, up to 60 of them at one point, from two different starts."""
    rng = np.random.default_rng(3)
    x, radii, _ = overlapping(extent=extent)
    h0 = as_float32(strength * MS * (np.array([0.3, 0.2, 1.0]) + 0.2 * rng.normal(size=(400, 3))))[0]
    exact = oracle.equilibrium(x, radii, h0, saturation=MS)
    assert exact.residual < 1e-12
    for initial in (None, MS * rng.uniform(-0.5, 0.5, (400, 3))):
        result = warpmag.solve_induction(
            x, radii, saturation=MS, external_field=h0, initial=initial, rtol=1e-7, dtype="float64", device=device
        )
        assert result.converged
        # the inverse Jacobian of such heaps amplifies the residual up to some hundred times
        assert relative(result.magnetizations, exact.magnetizations) < 1e-4


def test_fields_of_eight_decades_in_one_scene(device):
    rng = np.random.default_rng(4)
    x, radii, _ = pile(count=300)
    h0 = as_float32(MS * 10.0 ** rng.uniform(-5, 3, (300, 1)) * rng.normal(size=(300, 3)))[0]
    exact = oracle.equilibrium(x, radii, h0, saturation=MS)
    result = warpmag.solve_induction(x, radii, saturation=MS, external_field=h0, rtol=1e-5, device=device)
    assert result.converged
    assert relative(result.magnetizations, exact.magnetizations) < 1e-4


@pytest.mark.parametrize("curve", magnets.CURVES)
def test_curves_and_materials(curve, device):
    rng = np.random.default_rng(5)
    x, radii, _ = pile(count=200)
    saturation, susceptibility = rng.uniform(0.3, 2.0, 200) * 1e6, 10.0 ** rng.uniform(-1, 3, 200)
    material = {"saturation": saturation, "susceptibility": susceptibility, "curve": curve}
    h0 = [2e5, 0.0, 1e5]
    exact = oracle.equilibrium(x, radii, h0, **material)
    result = warpmag.solve_induction(x, radii, external_field=h0, rtol=1e-9, dtype="float64", device=device, **material)
    assert result.converged
    assert relative(result.magnetizations, exact.magnetizations) < 1e-7


def test_not_converging_is_said(block, device):
    x, radius, permanent, _ = block
    with pytest.warns(warpmag.ConvergenceWarning, match="did not converge, error .* after 2 evaluations"):
        result = warpmag.solve_induction(
            x, radius, saturation=MS, permanent=permanent, max_evaluations=2, device=device
        )
    assert not result.converged and result.evaluations == 2 and result.error > 1e-3


@pytest.mark.parametrize("force", ["kelvin", "zeeman"])
def test_wrench_of_the_result(block, force, device):
    x, radius, permanent, exact = block
    result = warpmag.solve_induction(
        x, radius, saturation=MS, permanent=permanent, rtol=1e-9, dtype="float64", device=device
    )
    volume = 4.0 / 3.0 * np.pi * radius**3
    everything = np.concatenate([x, permanent[0]]), np.concatenate([volume * exact.magnetizations, permanent[1]])
    gradient = oracle.field_gradient(*everything, radii=np.append(np.full(len(x), radius), 0.0))[:-1]
    if force == "kelvin":
        expected = oracle.kelvin_force(volume * exact.magnetizations, gradient)
    else:
        _, derivative = oracle.magnetization(exact.h, MS)
        expected = oracle.zeeman_force(np.full(len(x), volume), exact.h, gradient, exact.magnetizations, derivative)
    forces, torques = result.wrench(force)
    assert relative(forces, expected) < 1e-6
    # in equilibrium m is parallel to H: m × H is as small as the residual
    assert np.abs(torques).max() < 1e-6 * oracle.MU0 * volume * MS * np.linalg.norm(exact.h, axis=1).max()


def test_no_balls_and_no_field(device):
    none = warpmag.solve_induction(np.zeros((0, 3)), np.zeros(0), saturation=MS, device=device)
    assert none.converged and none.evaluations == 0 and none.magnetizations.shape == (0, 3)
    dark = warpmag.solve_induction(fcc_block((1, 1, 1)), 0.005, saturation=MS, device=device)
    assert dark.converged and np.abs(dark.magnetizations).max() == 0.0 and dark.error == 0.0


def test_warp_arrays(device):
    x, radii, _ = pile(count=50)
    result = warpmag.solve_induction(
        wp.array(x, dtype=wp.vec3, device=device), wp.array(radii, dtype=wp.float32, device=device),
        saturation=MS, external_field=[0.0, 0.0, 1e5],
    )  # fmt: skip
    assert isinstance(result.magnetizations, wp.array) and isinstance(result.h_field, wp.array)
    assert np.isfinite(result.magnetizations.numpy()).all()


@pytest.mark.parametrize(
    "arguments, message",
    [
        ({"saturation": -1.0}, "saturation: must be positive"),
        ({"saturation": np.nan}, "saturation: must be"),
        ({"susceptibility": 0.0}, "susceptibility: must be positive"),
        ({"radii": 0.0}, "radii: must be positive"),
        ({"radii": np.nan}, "radii: must be finite"),
        ({"curve": "cubic"}, "curve: 'cubic' is not one of"),
        ({"dynamics": "magic"}, "dynamics: 'magic' is not one of"),
        ({"contact_model": "magic"}, "contact_model: 'magic' is not one of"),
        ({"rtol": 0.0}, "rtol: must be at least"),
        ({"rtol": np.nan}, "rtol: must be at least"),
        ({"max_evaluations": 0}, "max_evaluations: must be at least 1"),
        ({"external_field": [np.inf, 0, 0]}, "external_field: not finite"),
        ({"permanent": (np.zeros((2, 3)), np.zeros((3, 3)))}, "permanent: moments: shape"),
    ],
)
def test_bad_arguments(arguments, message, device):
    good = {"positions": np.array([[0.0, 0, 0], [0, 0, 1]]), "radii": 0.1, "saturation": MS, "device": device}
    with pytest.raises(warpmag.InputError, match=message):
        warpmag.solve_induction(**{**good, **arguments})
