"""The exact multipole solution of permeable balls against boundary conditions, closed forms and its own energy."""

import numpy as np
import pytest
from scipy.special import gammaln, lpmv, zeta

from bench.reference import clusters
from bench.reference.spheres import MU0, pair, spheres

CLUSTER = np.array([[0.0, 0.0, 0.0], [0.3, 1.9, 1.2], [2.1, 0.4, 0.5]])
RADII = np.array([1.0, 0.9, 0.8])
PERMEABILITIES = np.array([5.0, np.inf, 50.0])
FIELD = np.array([0.3, -0.5, 0.8])


def isolated(permeability):
    """Moment of a lone ball of unit radius in a unit field."""
    return 4.0 * np.pi * (1.0 if np.isinf(permeability) else (permeability - 1.0) / (permeability + 2.0))


def pair_moments(gap, permeability, direction, tolerance=1e-10):
    """Moment of each of two balls of unit radius in a unit field along (0) or across (1) their axis."""
    two = pair(2.0 + gap, (1.0, 1.0), (permeability, permeability), tolerance=tolerance)
    return np.linalg.solve(two.resistance[direction], np.ones(2)), two


def real_harmonics(points, order):
    """Real solid harmonics r^l C_lm(r̂) at points, from SciPy's Legendre functions, shape [points, L (L + 2)]."""
    r = np.linalg.norm(points, axis=1)
    azimuth = np.arctan2(points[:, 1], points[:, 0])
    columns = []
    for degree in range(1, order + 1):
        for m in range(-degree, degree + 1):
            size = abs(m)
            norm = (-1.0) ** size * np.exp(0.5 * (gammaln(degree - size + 1) - gammaln(degree + size + 1)))
            turn = 1.0 if m == 0 else np.sqrt(2.0) * (np.cos(size * azimuth) if m > 0 else np.sin(size * azimuth))
            columns.append(norm * lpmv(size, degree, points[:, 2] / r) * turn * r**degree)
    return np.stack(columns, axis=1)


def test_boundary_conditions_hold():
    """Inside each ball the potential continues the outer one, and the normal flux density is continuous."""
    order = 20
    solution = spheres(CLUSTER, RADII, PERMEABILITIES, FIELD, order=order, estimate=False)
    degrees = np.concatenate([np.full(2 * k + 1, k) for k in range(1, order + 1)])

    def potential(x):
        total = -x @ FIELD
        for center, a in zip(CLUSTER, solution.multipoles, strict=True):
            r = x - center
            d2 = np.sum(r * r, axis=1)[:, None]
            total += real_harmonics(r / d2, order) @ a * d2[:, 0] ** -0.5  # inversion makes them irregular
        return total

    nodes, weights = np.polynomial.legendre.leggauss(order + 8)
    azimuths = np.arange(2 * order + 16) * (2.0 * np.pi / (2 * order + 16))
    sine = np.sqrt(1.0 - nodes**2)
    normals = np.stack(
        [np.outer(sine, np.cos(azimuths)), np.outer(sine, np.sin(azimuths)), np.outer(nodes, np.ones_like(azimuths))],
        -1,
    ).reshape(-1, 3)
    weights = np.repeat(weights, len(azimuths)) / (2.0 * len(azimuths))
    harmonics = real_harmonics(normals, order)
    for center, radius, permeability in zip(CLUSTER, RADII, PERMEABILITIES, strict=True):
        step = 1e-5
        outer = [potential(center + (radius + s * step) * normals) for s in (1.0, 0.0, -1.0)]
        flux = (outer[0] - outer[2]) / (2.0 * step)
        inside = (2.0 * degrees + 1.0) * (harmonics.T @ (weights * outer[1]))  # ψ on the surface by degree
        normal = harmonics @ (degrees * inside / radius)
        # what is cut off at order 20 is 5e-4 of the field between the closest balls, at worst at one point
        if np.isinf(permeability):
            assert np.abs(normal).max() < 2e-3
        else:
            assert np.abs(flux - permeability * normal).max() < 2e-3 * np.abs(flux).max()


def test_forces_are_the_gradient_of_the_energy():
    solution = spheres(CLUSTER, RADII, PERMEABILITIES, FIELD, order=8)
    step = 1e-4
    for ball in range(3):
        for axis in range(3):
            energies = []
            for sign in (1.0, -1.0):
                moved = CLUSTER.copy()
                moved[ball, axis] += sign * step
                energies.append(spheres(moved, RADII, PERMEABILITIES, FIELD, order=8, estimate=False).energy)
            # central differences: step² of truncation, eps/step of rounding
            derivative = -(energies[0] - energies[1]) / (2.0 * step)
            assert abs(derivative - solution.forces[ball, axis]) < 1e-7 * np.abs(solution.forces).max()


def test_momentum_is_conserved():
    solution = spheres(CLUSTER, RADII, PERMEABILITIES, FIELD, order=10)
    size = np.abs(solution.forces).max()
    assert np.abs(solution.forces.sum(0)).max() < 1e-13 * size
    # the torque of the field on the moments is all the torque there is: none acts on an isotropic ball by itself
    torque = MU0 * np.cross(solution.moments, FIELD).sum(0)
    assert np.abs(np.cross(CLUSTER, solution.forces).sum(0) - torque).max() < 1e-12 * size


@pytest.mark.parametrize("permeability", [2.0, 10.0, np.inf])
@pytest.mark.parametrize("field", [[0.0, 0.0, 1.0], [1.0, 0.0, 0.0]])
def test_axis_and_general_solution_agree(permeability, field):
    """Two codings, one with the orders m decoupled on the axis, one with translations in any direction."""
    direction = 0 if field[2] else 1
    two = pair(2.3, (1.0, 1.0), (permeability, permeability), order=12)
    m = np.linalg.solve(two.resistance[direction], np.ones(2))
    many = spheres([[0.0, 0.0, 0.0], [0.0, 0.0, 2.3]], 1.0, permeability, field, order=12)
    np.testing.assert_allclose(many.moments @ field, m, rtol=1e-12)
    np.testing.assert_allclose(many.forces[1, 2], -0.5 * MU0 * m @ two.slope[direction] @ m, rtol=1e-10)


@pytest.mark.parametrize("permeability", [2.0, 1000.0, np.inf])
def test_far_balls_are_dipoles(permeability):
    distance = 40.0
    for direction, factor in ((0, 2.0), (1, -1.0)):
        m, two = pair_moments(distance - 2.0, permeability, direction)
        resistance = np.full((2, 2), -factor / (4.0 * np.pi * distance**3))
        np.fill_diagonal(resistance, 1.0 / isolated(permeability))
        # quadrupoles add terms of (R/d)⁵ to the dipoles' (R/d)³
        np.testing.assert_allclose(two.resistance[direction], resistance, rtol=4.0 * distance**-2.0)
        slope = 3.0 * factor * m[0] * m[1] / (4.0 * np.pi * distance**4)
        np.testing.assert_allclose(0.5 * m @ two.slope[direction] @ m, slope, rtol=10.0 * distance**-2.0)


def test_images_across_the_field():
    """μr = ∞ across the field: image dipoles alone, m/m0 = Σ (−1)^(n+1) (sinh ξ/sinh nξ)³, cosh ξ = d/2R."""
    n = np.arange(1, 400)
    for gap in (3.0, 0.3, 0.03):
        xi = np.arccosh(1.0 + 0.5 * gap)
        series = np.sum((-1.0) ** (n + 1) * (np.sinh(xi) / np.sinh(np.minimum(n * xi, 300.0))) ** 3)
        m, _ = pair_moments(gap, np.inf, 1)
        np.testing.assert_allclose(m / isolated(np.inf), series, rtol=1e-9)


def test_touching_balls():
    """μr = ∞ in contact: the pair has 3ζ(3)/2 of a lone ball's moment across the field and 4ζ(3) along it."""
    across, _ = pair_moments(1e-4, np.inf, 1, tolerance=1e-6)
    assert across.sum() / isolated(np.inf) == pytest.approx(1.5 * zeta(3.0), rel=2e-5)  # of the order of gap/R
    # along the field the potential between the balls falls as 1/(ln(4R/gap) + 2γ): two gaps extrapolate it
    inverse = [1.0 / (np.log(4.0 / gap) + 2.0 * np.euler_gamma) for gap in (1e-3, 1e-4)]
    along = [pair_moments(gap, np.inf, 0, 1e-6)[0].sum() / isolated(np.inf) for gap in (1e-3, 1e-4)]
    limit = along[1] - inverse[1] * (along[1] - along[0]) / (inverse[1] - inverse[0])
    assert along[0] < along[1] < 4.0 * zeta(3.0)
    assert limit == pytest.approx(4.0 * zeta(3.0), rel=5e-3)  # the next term of the series in 1/ln


def test_truncation_error_is_bounded_by_its_estimate():
    m, fine = pair_moments(0.05, np.inf, 0)
    force = -0.5 * MU0 * m @ fine.slope[0] @ m
    coarse = spheres([[0.0, 0.0, 0.0], [0.0, 0.0, 2.05]], 1.0, np.inf, [0.0, 0.0, 1.0], order=15)
    error = abs(coarse.forces[1, 2] / force - 1.0)
    assert 0.0 < error < coarse.truncation < 0.1


def test_scale():
    """Lengths times s, fields times f: moments go as s³ f, forces as s² f²."""
    first = spheres(CLUSTER, RADII, PERMEABILITIES, FIELD, order=5)
    other = spheres(0.005 * CLUSTER, 0.005 * RADII, PERMEABILITIES, 1e6 * FIELD, order=5)
    np.testing.assert_allclose(other.moments, 0.005**3 * 1e6 * first.moments, rtol=1e-11)
    np.testing.assert_allclose(other.forces, 0.005**2 * 1e12 * first.forces, rtol=1e-9, atol=1e-12 * 25e6)


@pytest.mark.parametrize("name, gap", [("chain", 0.02), ("chain", 0.3), ("fcc", 0.2), ("fcc", 0.3)])
def test_stored_clusters_are_what_is_solved(name, gap):
    rows = [row for row in clusters.load() if (row["cluster"], row["gap"]) == (name, gap)]
    for actual, row in zip(clusters.solve(name, gap).items(), rows, strict=True):
        key, solution = actual
        assert key == (row["permeability"], row["field"])
        # six digits are stored
        np.testing.assert_allclose(row["forces"], solution.forces, atol=1e-5 * np.abs(solution.forces).max())
        np.testing.assert_allclose(row["moments"], solution.moments, atol=1e-5 * np.abs(solution.moments).max())
