"""The oracle against quadrature, finite differences and closed forms."""

import itertools

import numpy as np
import pytest

from bench.reference import oracle
from warpmag.declarations import magnets

EYE = np.eye(3)


def averaged_tensor(distance, a, b, nodes=48):
    """Field per moment of a uniformly magnetized ball of radius b, averaged over a ball of radius a, by quadrature.

    Inside its ball a magnetization has the field −M/3, outside the dipole's. Gauss-Legendre in the target ball's
    spherical coordinates, split where a shell crosses the source's surface, so that every piece is smooth.
    """
    x, w = np.polynomial.legendre.leggauss(nodes)
    kinks = [k for k in (abs(distance - b), distance + b, b - distance) if 0.0 < k < a]
    total = np.zeros(2)
    for low, high in zip([0.0, *sorted(kinks)], [*sorted(kinks), a], strict=True):
        r = 0.5 * (high - low) * x + 0.5 * (high + low)
        for ri, wi in zip(r, 0.5 * (high - low) * w, strict=True):
            # shell of radius ri about the target, at distance d' from the source: d'² = d² + ri² + 2 d ri u
            u_kink = (b * b - distance**2 - ri**2) / (2.0 * distance * ri)
            edges = [-1.0, *([u_kink] if -1.0 < u_kink < 1.0 else []), 1.0]
            for u0, u1 in itertools.pairwise(edges):
                u, wu = 0.5 * (u1 - u0) * x + 0.5 * (u1 + u0), 0.5 * (u1 - u0) * w
                d2 = distance**2 + ri**2 + 2.0 * distance * ri * u
                along = distance + ri * u  # component of the separation on the axis
                inside = 0.5 * (u0 + u1) < u_kink
                if inside:
                    parallel, across = -np.ones_like(u) / b**3, -np.ones_like(u) / b**3
                else:
                    parallel = (3.0 * along**2 / d2 - 1.0) / d2**1.5
                    across = (1.5 * (d2 - along**2) / d2 - 1.0) / d2**1.5
                total += 2.0 * np.pi * ri**2 * wi * np.array([np.sum(wu * parallel), np.sum(wu * across)])
    return total / (4.0 / 3.0 * np.pi * a**3)


@pytest.mark.parametrize("a, b", [(1.0, 1.0), (1.0, 0.4), (0.4, 1.0), (1.0, 0.9)])
@pytest.mark.parametrize("share", [0.05, 0.35, 0.6, 0.95, 1.0, 1.3])
def test_averaged_law_is_the_average(a, b, share):
    distance = share * (a + b)
    g1, g2, _ = oracle.radial_factors(distance, a, b)
    parallel, across = averaged_tensor(distance, a, b)
    # smooth pieces: 48 nodes integrate them to near machine precision
    assert abs(g1 + g2 * distance**2 - parallel) < 1e-9
    assert abs(g1 - across) < 1e-9


@pytest.mark.parametrize("a, b", [(1.0, 1.0), (1.0, 0.3)])
def test_law_joins_the_dipole_and_the_inner_law(a, b):
    for d in (a + b, abs(a - b)):
        if d == 0.0:
            continue
        below, above = (oracle.radial_factors(d * (1.0 + s), a, b) for s in (-1e-7, 1e-7))
        for name, low, high in zip(("g1", "g2"), below[:2], above[:2], strict=True):
            # the value is continuous and its slope finite, so a step of 2e-7 changes it by that much, times a few
            assert abs(low - high) < 1e-5, name


def test_gradient_is_the_derivative_of_the_field():
    rng = np.random.default_rng(1)
    x = rng.uniform(-1.0, 1.0, (12, 3))
    m, radii = rng.normal(size=(12, 3)), rng.uniform(0.2, 0.7, 12)
    for smoothing in (0.0,):
        gradients = oracle.field_gradient(x, m, radii=radii, smoothing=smoothing)
        for i in range(12):
            others = np.arange(12) != i
            for axis in range(3):
                step = 1e-5 * EYE[axis]
                h = [
                    oracle.h_field(x[others], m[others], [x[i] + s * step], radii=radii[others], target_radii=radii[i])
                    for s in (-1, 1)
                ]
                # central differences: step² truncation and eps/step rounding both lie near 1e-10
                np.testing.assert_allclose((h[1] - h[0])[0] / 2e-5, gradients[i][:, axis], atol=1e-7)


def test_gradient_is_traceless_outside_and_symmetric():
    rng = np.random.default_rng(2)
    x = 3.0 * np.stack(np.meshgrid(*[np.arange(3.0)] * 3), -1).reshape(-1, 3)
    gradients = oracle.field_gradient(x, rng.normal(size=(27, 3)), radii=1.0)
    scale = np.abs(gradients).max()
    assert np.abs(np.trace(gradients, axis1=1, axis2=2)).max() < 1e-14 * scale * 27
    assert np.abs(gradients - gradients.transpose(0, 2, 1)).max() == 0.0


@pytest.mark.parametrize("curve", magnets.CURVES)
@pytest.mark.parametrize("susceptibility", [0.5, 3.0, np.inf])
def test_curve_derivative(curve, susceptibility):
    rng = np.random.default_rng(3)
    h = rng.normal(size=(60, 3)) * 10.0 ** rng.uniform(-3, 1, (60, 1))
    _, derivative = oracle.magnetization(h, 1.0, susceptibility, curve)
    k = oracle.curve_slope(susceptibility)
    smooth = np.abs(k * np.linalg.norm(h, axis=1) - 1.0) > 0.01  # Eq. 7 has a kink at saturation
    for axis in range(3):
        step = 1e-6 * EYE[axis]
        high, low = (oracle.magnetization(h + s * step, 1.0, susceptibility, curve)[0] for s in (1, -1))
        np.testing.assert_allclose(((high - low) / 2e-6)[smooth], derivative[smooth][:, :, axis], atol=1e-7)


def test_langevin_series_meets_the_closed_form():
    s = np.array([0.1 / 3.0 * (1.0 - 1e-12), 0.1 / 3.0 * (1.0 + 1e-12)])
    value, slope = oracle.reduced_curve(s, "langevin")
    assert abs(value[1] - value[0]) < 1e-12
    assert abs(slope[1] - slope[0]) < 1e-11  # the closed slope cancels two digits at x = 0.1


def test_two_linear_balls():
    """Two far unsaturated balls in line: M = 3H0 / (1 − 3G), G = 2V/(4π d³)."""
    radius, distance, h0 = 1.0, 3.0, 1e-6
    g = 2.0 * (4.0 / 3.0 * np.pi * radius**3) / (4.0 * np.pi * distance**3)
    result = oracle.equilibrium([[0, 0, 0], [0, 0, distance]], radius, [0, 0, h0], saturation=1.0)
    # in a field of 1e-6 Ms the curve bends by 1e-11 of itself
    np.testing.assert_allclose(result.magnetizations[:, 2], 3.0 * h0 / (1.0 - 3.0 * g), rtol=1e-9)


@pytest.mark.parametrize("extent", [0.1, 0.03, 0.005])
def test_coupling_is_bounded_for_any_arrangement(extent):
    """λmax ≤ 1/3 and λmin ≥ 1/3 − (1 + overlap): what uniqueness and the step length rest on."""
    rng = np.random.default_rng(4)
    x = rng.uniform(-0.5, 0.5, (120, 3)) * extent
    eigenvalues = np.linalg.eigvalsh(oracle.coupling_matrix(x, 0.01))
    assert eigenvalues.max() < 1.0 / 3.0 + 1e-12
    d = np.linalg.norm(x[:, None] - x[None], axis=2)
    lens = np.where(d < 0.02, (1.0 - d / 0.02) ** 2 * (1.0 + d / 0.04), 0.0) - np.eye(120)
    assert eigenvalues.min() > 1.0 / 3.0 - (1.0 + lens.sum(1).max())
