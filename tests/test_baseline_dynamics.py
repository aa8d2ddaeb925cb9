"""Baseline dynamics: pairs of submagnetizations, against closed forms and the float64 oracle."""

import numpy as np
import pytest
import warp as wp
from arrangements import fcc_block, pile, relative

from bench.reference import oracle
from bench.systems import moment_system
from warpmag.declarations import magnets
from warpmag.errors import InputError

MS = 1.7e6
BASELINES = ("theta-euler", "llg", "llg-damping")


@pytest.fixture(scope="module")
def step_kernel():
    """Kernel that makes many steps of one submagnetization in a fixed effective field, float64."""
    from warpmag.kernels.induction.submagnetization import llg_step, step_submagnetization  # noqa: PLC0415 - after the device

    @wp.kernel(module="unique", enable_backward=False)
    def march(
        u: wp.array[wp.vec3d], h: wp.vec3d, kappa: wp.float64, precession: wp.float64, law: int, count: int, scaled: int
    ):
        x = u[0]
        for _ in range(count):
            if scaled == 1:
                x = step_submagnetization(x, h, kappa, precession, wp.float64(1.0), law)
            else:
                x = llg_step(x, h, kappa, precession)
        u[0] = x

    return march


@pytest.fixture
def march(step_kernel, device):
    def run(start, h, kappa, precession, law, count, scaled=True):
        u = wp.array([start], dtype=wp.vec3d, device=device)
        wp.launch(step_kernel, dim=1, inputs=[u, wp.vec3d(*h), kappa, precession, law, count, int(scaled)],
                  device=device)  # fmt: skip
        return u.numpy()[0]

    return run


def direction(theta, phi=0.0):
    return np.array([np.sin(theta) * np.cos(phi), np.sin(theta) * np.sin(phi), np.cos(theta)])


def lone_moments(fields, device, **settings):
    """One moment per world, each in a field of its own along an oblique direction [reduced by Ms]."""
    fields = np.asarray(fields, float)
    unit = np.array([0.48, -0.6, 0.64])
    system = moment_system(
        radii=np.full(len(fields), 0.005), worlds=np.arange(len(fields)), saturation=MS,
        external_field=MS * fields[:, None] * unit, device=device, **settings,
    )  # fmt: skip
    return system, MS * fields[:, None] * unit


# ---------------------------------------------------------------------------------------------------------------------
# One submagnetization in a fixed effective field
# ---------------------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("precession", [0.0, 5.0])
def test_llg_follows_its_closed_form_to_first_order(march, precession):
    """tan θ/2 decays as exp(−κ‖h‖n), φ turns by κ‖h‖n/α, with an error in proportion to the step."""
    start, h, duration = direction(2.0), 0.7, 1.0
    exact = direction(2.0 * np.arctan(np.tan(1.0) * np.exp(-h * duration)), precession * h * duration)
    errors = []
    for count in (200, 400, 800):
        u = march(start, (0.0, 0.0, h), duration / count, precession, 1, count)
        assert abs(np.linalg.norm(u) - 1.0) < 1e-14
        errors.append(np.linalg.norm(u - exact))
    # first order: the error halves with the step, up to the next order's share of it
    assert errors[0] < 0.1
    assert errors[0] / errors[1] == pytest.approx(2.0, rel=0.1)
    assert errors[1] / errors[2] == pytest.approx(2.0, rel=0.05)


def test_pure_precession_keeps_length_and_angle_to_the_order_of_the_step(march):
    """Damping 1e-9 of the precession: an explicit step grows ‖M‖ by (step)²/2, which is O(step) over one turn."""
    start, drifts, growths = direction(1.0), [], []
    for count in (1000, 2000):
        kappa, precession = 1e-9, 2.0 * np.pi / count * 1e9
        turned = march(start, (0.0, 0.0, 1.0), kappa, precession, 1, count)
        free = march(start, (0.0, 0.0, 1.0), kappa, precession, 1, count, scaled=False)
        drifts.append(abs(np.arccos(turned[2]) - 1.0))
        growths.append(np.linalg.norm(free) - 1.0)
        assert growths[-1] < 1.01 * 0.5 * count * (2.0 * np.pi / count) ** 2
    assert drifts[0] / drifts[1] == pytest.approx(2.0, rel=0.05)
    assert growths[0] / growths[1] == pytest.approx(2.0, rel=0.05)


@pytest.mark.parametrize("law", [0, 2], ids=["theta-euler", "llg-damping"])
@pytest.mark.parametrize("theta", [0.01, 1.5, 3.0])
def test_damping_ends_in_the_direction_of_the_field(march, law, theta):
    h = 0.5 * direction(0.8, 2.0)
    start = direction(0.8 + theta, 2.0)
    u = march(start, h, 0.3, 0.0, law, 400)
    assert np.linalg.norm(u - direction(0.8, 2.0)) < 1e-12


def test_theta_step_parts_from_the_far_pole_and_stops_at_the_field(march):
    """At θ = π no plane is given: Θ = 2 − sin θ still moves; a step beyond the field ends on it."""
    u = march((0.0, 0.0, -1.0), (0.0, 0.0, 1.0), 0.1, 0.0, 0, 1)
    assert u[2] == pytest.approx(-np.cos(0.2), abs=1e-14)
    assert np.allclose(march(direction(1.0), (0.0, 0.0, 10.0), 0.3, 0.0, 0, 1), [0.0, 0.0, 1.0], atol=1e-15)
    assert np.array_equal(march(direction(1.0), (0.0, 0.0, 0.0), 0.3, 0.0, 0, 1), direction(1.0))


# ---------------------------------------------------------------------------------------------------------------------
# One moment
# ---------------------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("curve", ["tanh", "clamped"])
@pytest.mark.parametrize("dynamics", BASELINES)
def test_lone_moment_converges_to_its_curve(dynamics, curve, device):
    """Eq. 7 or Eq. 10, from weak fields to twice saturation; also from a magnetization in another direction."""
    step = 0.05 if dynamics == "llg" else 0.3  # precession is 1/α = 5 times as fast
    system, h = lone_moments(
        [0.05, 0.2, 0.4, 0.7], device, dynamics=dynamics, curve=curve, rtol=1e-4, step=step, max_evaluations=4000
    )
    exact = oracle.magnetization(h, MS, curve=curve)[0]
    for start in (None, 0.7 * MS * np.roll(h, 1, axis=1) / np.linalg.norm(h, axis=1)[:, None]):
        if start is not None:
            system.start_from(wp.array(start, dtype=wp.vec3, device=device))
        system.solve()
        assert system.converged.numpy().all()
        error = np.linalg.norm(system.magnetizations().numpy() - exact, axis=1)
        assert (error <= 1.01e-4 * np.linalg.norm(exact, axis=1)).all()


def test_theta_euler_is_the_exact_flow_to_first_order(device):
    """One step from the same pair: s ← (1 − κ/k) s + κ H/Ms up to κ², so the difference falls by 4 with half the κ."""
    start, differences = 0.3, []
    for kappa in (0.08, 0.04, 0.02):
        system, h = lone_moments([0.2], device, dynamics="theta-euler", step=kappa, dtype="float64")
        unit = h / np.linalg.norm(h)
        system.start_from(wp.array(start * MS * unit, dtype=wp.vec3d, device=device))
        system.begin()
        system.iterate()
        s = (1.0 - kappa / 3.0) * np.arctanh(start) + kappa * 0.2
        magnetization = system.magnetizations().numpy()
        differences.append(np.linalg.norm(magnetization - MS * np.tanh(s) * unit) / MS)
        assert np.linalg.norm(np.cross(magnetization, unit)) < 1e-12 * MS
    assert differences[0] < 0.08**2
    assert np.divide(differences[:-1], differences[1:]) == pytest.approx([4.0, 4.0], rel=0.1)


# ---------------------------------------------------------------------------------------------------------------------
# Many moments
# ---------------------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("dynamics", BASELINES)
def test_baseline_dynamics_find_the_oracles_equilibrium(dynamics, device):
    """Section 6.3: one solution, in a touching pack. LLG needs a step small enough for its precession."""
    x, h0 = fcc_block((2, 2, 1)), np.array([2e5, -1e5, 4e5])
    exact = oracle.equilibrium(x, 0.005, h0, saturation=MS)
    system = moment_system(
        radii=np.full(16, 0.005), saturation=MS, external_field=h0, dynamics=dynamics, rtol=1e-7, dtype="float64",
        step=0.03 if dynamics == "llg" else 0.3, max_evaluations=5000, device=device,
    )  # fmt: skip
    system.positions.assign(x)
    system.solve()
    assert system.converged.numpy()[0]
    # ‖M − M*‖ is at most the residual over 1 − 3 λ, λ under 0.3 here: ten times the residual
    assert relative(system.magnetizations().numpy(), exact.magnetizations) < 1e-6
    assert relative(system.h.numpy(), exact.h) < 1e-6


@pytest.fixture(scope="module")
def piles(device):
    """Two worlds of balls in an oblique field, the second three times as dense: a system and its positions."""
    x = np.concatenate([pile(count=40)[0], 2.0 * pile(count=60)[0]])
    system = moment_system(
        radii=np.full(100, 0.004), worlds=np.repeat([0, 1], [40, 60]), saturation=MS, dynamics="llg", curve="clamped",
        external_field=(4e4, 2e4, 1e4), device=device,
    )  # fmt: skip
    system.positions.assign(x)
    return system


def test_pairs_outlive_a_solve_and_worlds_end_for_themselves(piles):
    piles.start_cold()
    piles.solve()
    cold = piles.evaluations.numpy()
    assert piles.converged.numpy().all() and (cold > 20).all() and cold[0] != cold[1]
    piles.solve()
    assert piles.evaluations.numpy().tolist() == [1, 1]
    piles.start_cold()
    piles.solve()
    assert np.array_equal(piles.evaluations.numpy(), cold)


def test_solve_of_pairs_can_be_captured(piles, device):
    piles.start_cold()
    piles.solve()
    launched = piles.moments.numpy()
    with wp.ScopedCapture(device) as capture:
        piles.solve()
    piles.start_cold()
    wp.capture_launch(capture.graph)
    assert np.array_equal(piles.moments.numpy(), launched)


def test_pairs_give_up_after_max_evaluations_and_rest_without_a_field(device):
    system, _ = lone_moments([0.0, 1e-3, 0.7], device, dynamics="llg-damping", max_evaluations=50)
    system.solve()
    assert system.converged.numpy().tolist() == [1, 0, 1]
    assert system.evaluations.numpy()[:2].tolist() == [1, 50]
    assert np.array_equal(system.moments.numpy()[0], [0.0, 0.0, 0.0])


@pytest.mark.parametrize(
    ("settings", "message"),
    [
        ({"dynamics": "llg", "step": -1.0}, "step: must be positive"),
        ({"dynamics": "llg", "damping": 0.0}, "damping: must be positive"),
        ({"dynamics": "theta", "step": 0.1}, "step: the dynamics 'theta' has an automatic step"),
        ({"dynamics": "theta-euler", "damping": 0.2}, "damping: the dynamics 'theta-euler' has no damping"),
        ({"dynamics": "newton"}, "dynamics: 'newton' is not one of theta, theta-euler, llg, llg-damping"),
    ],
)
def test_bad_settings_are_refused(settings, message, device):
    with pytest.raises(InputError, match=message):
        moment_system(radii=[0.005], device=device, **settings)


def test_methods_are_made_of_what_there_is():
    for method in magnets.PRESETS.values():
        assert method.dynamics in magnets.DYNAMICS and method.curve in magnets.CURVES and method.force in magnets.FORCES
