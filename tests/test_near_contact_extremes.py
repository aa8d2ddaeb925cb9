"""The near-contact model where balls lie in one another, and of very small, very large and hardly magnetized balls."""

import numpy as np
import pytest
from arrangements import as_float32, relative

import warpmag
from bench.reference import near_contact as contact_oracle
from bench.reference import oracle

IRON = 1.7e6
DIRECTION = np.array([0.4, -0.3, 0.9])
PILE = np.array([[0.0, 0.0, 0.0], [2.05, 0.0, 0.0], [0.4, 2.2, 0.3], [1.5, 1.6, 1.6], [0.0, 0.0, -2.3]])
PILE_RADII = np.array([1.0, 1.0, 1.0, 0.9, 1.0])


def solve(x, radii, field, dtype, device):
    rtol = {"float64": 1e-11, "float32": 3e-6}[dtype]
    return warpmag.solve_induction(
        x, radii, saturation=IRON, external_field=field, contact_model="multipole", rtol=rtol, dtype=dtype,
        device=device,
    )  # fmt: skip


def in_one_another(ratio, depth):
    """A ball of radius 1/``ratio`` at ``depth`` contact distances in one of radius 1, and a third that touches this."""
    direction = np.array([-0.6, 0.48, 0.64])
    x = np.array([0.0 * direction, depth * (1.0 + 1.0 / ratio) * direction, [2.05, 0.0, 0.1]])
    return x, np.array([1.0, 1.0 / ratio, 1.0])


def two_in_one(_, depth):
    """Two small balls that nearly touch each other, in a large one that another one touches: all have a potential."""
    at = depth * np.array([-0.6, 0.48, 0.64])
    x = np.array([[0.0, 0.0, 0.0], at, at - 0.41 * np.array([0.0, 0.6, 0.8]), [2.05, 0.0, 0.1]])
    return x, np.array([1.0, 0.2, 0.2, 1.0])


def beside(ratio, depth):
    """Two balls that nearly touch, beside two in one another, which leave the model gradually as they overlap."""
    x, radii = in_one_another(ratio, depth)
    return np.array([*x[:2], [2.2, 0.0, 0.3], [2.1, 2.03, 0.4]]), np.append(radii, 1.0)


@pytest.mark.parametrize("dtype, scale", [("float64", 0.005), ("float32", 0.005), ("float32", 100.0)])
@pytest.mark.parametrize(
    "arrange, ratio",
    [(in_one_another, ratio) for ratio in (1.0, 1.000001, 1.2, 3.0, 1000.0)] + [(two_in_one, 5.0), (beside, 1.2)],
)
def test_balls_in_one_another(arrange, ratio, dtype, scale, device):
    """Magnetizations and forces down to coincident centers are the reference's, which is in units of the radius."""
    # two ideally permeable balls in one place do not tell how they share their magnetization
    error = {"float64": 1e-8, "float32": 1e-3}[dtype]
    for depth in (0.0, 1e-15, 1e-9, 1e-6, 1e-3, 0.3, 0.51, 0.95):
        x, radii = (np.asarray(scale * a, dtype).astype(float) for a in arrange(ratio, depth))
        actual = solve(x, radii, 0.1 * IRON * DIRECTION, dtype, device)
        exact, forces = contact_oracle.equilibrium(
            x / radii[0], radii / radii[0], 0.1 * IRON * DIRECTION, saturation=IRON
        )
        assert actual.converged
        miss = np.linalg.norm(actual.magnetizations - exact.magnetizations, axis=1)
        assert (miss < error * np.linalg.norm(exact.magnetizations, axis=1)).all()
        # forces of a small ball in a large one are small beside those of two dipoles at contact, which cancel in them
        moments = np.linalg.norm(exact.magnetizations, axis=1) * 4.0 / 3.0 * np.pi * (radii / radii[0]) ** 3
        unit = oracle.MU0 * moments * moments[0] / (1.0 + radii / radii[0]) ** 4
        miss = np.linalg.norm(actual.wrench()[0] / radii[0] ** 2 - forces, axis=1)
        assert (miss < error * (np.linalg.norm(forces, axis=1) + unit)).all()


@pytest.mark.parametrize(
    "arrange, ratio, depth",
    [
        *((in_one_another, *sizes) for sizes in ((1.3, 0.05), (3.0, 0.2), (8.0, 0.85), (20.0, 0.5))),
        (two_in_one, 5.0, 0.3),
    ],
)
def test_reference_forces_are_the_gradient_of_its_energy(arrange, ratio, depth):
    """A ball in or through another, beside a contact: U of balls in one another goes with the field that it makes."""
    x, radii = arrange(ratio, depth)
    n, volumes = len(x), 4.0 / 3.0 * np.pi * radii**3

    def linear(positions):
        near = contact_oracle.NearContacts(positions, radii, np.full(n, 9.0))
        coupling = oracle.coupling_matrix(positions, radii) / np.repeat(volumes, 3) + near.coupling()
        stiffness = np.diag(np.repeat(1.0 / (oracle.curve_slope(9.0) * volumes), 3)) - coupling
        moments = np.linalg.solve(stiffness, np.tile(DIRECTION, n)).reshape(n, 3)
        dipoles = oracle.kelvin_force(moments, oracle.field_gradient(positions, moments, radii=radii))
        return -0.5 * oracle.MU0 * np.sum(moments @ DIRECTION), dipoles + near.forces(moments)

    _, forces = linear(x)
    step = 1e-5
    for ball in range(n):
        for axis in range(3):
            shift = np.zeros((n, 3))
            shift[ball, axis] = step
            derivative = (linear(x + shift)[0] - linear(x - shift)[0]) / (2.0 * step)
            # central differences: step² of truncation, eps/step of rounding
            assert abs(derivative + forces[ball, axis]) < 1e-7 * np.abs(forces).max()


@pytest.mark.parametrize("strength", [1e-3, 0.1, 2.0])
@pytest.mark.parametrize("dtype, scale", [("float32", 6e-8), ("float32", 1e3), ("float64", 1e-8), ("float64", 1e12)])
def test_any_scale(dtype, scale, strength, device):
    """Balls of 60 nm, of 1 km and of any size: the same magnetizations, forces as the square of the radius."""
    error = {"float64": 1e-6, "float32": 1e-3}[dtype]
    x, radii = (np.asarray(scale * a, dtype).astype(float) for a in (PILE, PILE_RADII))
    actual = solve(x, radii, strength * IRON * DIRECTION, dtype, device)
    exact, forces = contact_oracle.equilibrium(x / scale, radii / scale, strength * IRON * DIRECTION, saturation=IRON)
    assert relative(actual.magnetizations, exact.magnetizations) < error
    assert relative(actual.wrench()[0] / scale**2, forces) < error


def test_moments_without_a_force_in_float32(device):
    """Products of the moments of 60 nm balls in a field of 20 A/m are no float32: refused, where it was off by half."""
    x, radii = as_float32(6e-8 * PILE, 6e-8 * PILE_RADII)
    actual = solve(x, radii, 20.0 * DIRECTION, "float32", device)
    with pytest.raises(warpmag.InputError, match=r"^radii, saturation, external_field: .* use float64$"):
        actual.wrench()
    forces, _ = solve(x, radii, 20.0 * DIRECTION, "float64", device).wrench()
    _, exact = contact_oracle.equilibrium(x / 6e-8, radii / 6e-8, 20.0 * DIRECTION, saturation=IRON)
    assert relative(forces / 6e-8**2, exact) < 1e-6
