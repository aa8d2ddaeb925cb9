"""Magnetization curves of the kernels, in Warp functions and in passes over moments, against the float64 oracle."""

import numpy as np
import pytest
import warp as wp

from bench.reference import oracle
from warpmag.declarations import magnets
from warpmag.kernels.material.curves import CURVE_IDS, curve_area, curve_ratio, curve_slope, inverse_curve_ratio
from warpmag.kernels.shared.native import CHUNK, native_options

S = np.concatenate([[0.0], np.geomspace(1e-3, 30.0, 319)])
"""Reduced fields, a multiple of ``CHUNK``."""
PRECISION = {"float32": 1e-5, "float64": 1e-9}  # Langevin's curve cancels where its series ends


@pytest.fixture(scope="module", params=list(PRECISION))
def evaluate(request, device):
    """Return a function that evaluates a curve: c(s)/s in both forms, c'(s), c'(s) from c², s/c from c, and ∫c ds."""
    kind = getattr(wp, request.param)
    call = (
        "warpmag::Curves curves = {curve, warpmag::Index(curve), nullptr, warpmag::Number(k)};"
        "warpmag::put(ratio.data + i, warpmag::curve_ratio(warpmag::numbers(s.data + i), curves));"
        "warpmag::put(slope.data + i, warpmag::curve_steepness(warpmag::numbers(square.data + i), curves));"
    )

    @wp.func_native(call)
    def by_passes(
        i: int,
        curve: int,
        k: kind,
        s: wp.array[kind],
        square: wp.array[kind],
        ratio: wp.array[kind],
        slope: wp.array[kind],
    ): ...

    @wp.kernel(module="unique", enable_backward=False, module_options=native_options("material/curves.h", dtype=kind))
    def curves(
        curve: int,
        k: kind,
        tables: wp.array2d[kind],
        s: wp.array[kind],
        square: wp.array[kind],
        out: wp.array2d[kind],
        area: wp.array[wp.float64],
    ):
        i = wp.tid()
        c = curve_ratio(s[i], k, curve, tables)
        out[0, i] = c
        out[1, i] = curve_slope(s[i], k, curve, tables)
        out[2, i] = inverse_curve_ratio(c * s[i], k, curve, tables)
        area[i] = curve_area(s[i], k, curve, tables)
        by_passes(i, curve, k, s, square, out[3], out[4])

    def run(curve, reduced, k=3.0):
        padded = [np.pad(x, (0, CHUNK)) for x in (S, reduced**2)]
        s, square = (wp.array(x, dtype=kind, device=device) for x in padded)
        out, area = (
            wp.zeros((5, len(S) + CHUNK), dtype=kind, device=device),
            wp.zeros(len(S), dtype=wp.float64, device=device),
        )
        wp.launch(curves, dim=len(S), inputs=[curve, k, None, s, square, out, area], device=device)
        return np.vstack([out.numpy()[:, : len(S)].astype(float), area.numpy()]), PRECISION[request.param]

    return run


@pytest.mark.parametrize("name", magnets.CURVES)
def test_curve_of_the_kernels_is_the_oracles(name, evaluate):
    c, slope = oracle.reduced_curve(S, name)
    (ratio, kernels_slope, inverse, vectors_ratio, steepness, _), tolerance = evaluate(CURVE_IDS[name][0], c)
    exact = np.divide(c, S, out=np.ones_like(S), where=S > 0.0)
    assert np.abs(ratio / exact - 1.0).max() < tolerance
    assert np.abs(vectors_ratio / exact - 1.0).max() < tolerance
    assert np.abs(kernels_slope - slope).max() < tolerance
    # near saturation rounding decides the field of a magnetization, and weak ones are rounded where 1 is added to them
    invertible = (c < 0.999) & (c > 1e-2)
    assert np.abs(inverse * ratio - 1.0)[invertible].max() < 1e2 * tolerance
    assert np.abs(steepness - slope).max() < max(tolerance, 2e-4 if name == "langevin" else 0.0)


def test_langevins_steepness_is_fitted_to_the_oracle(evaluate):
    """The 13 coefficients in ``curves.h``: of its slope over Cohen's approximation, as a polynomial in 2c − 1."""
    s = np.concatenate([np.linspace(0.0, 10.0, 2000), np.geomspace(10.0, 1e4, 1000)])

    def cohen(c):
        return 3.0 * (1.0 - c**2) ** 2 / (3.0 + c**4)

    c, slope = oracle.reduced_curve(s, "langevin")
    fit = np.polyfit(2.0 * c - 1.0, slope / cohen(c), 12)
    c, _ = oracle.reduced_curve(S, "langevin")
    magnetizations, tolerance = evaluate(CURVE_IDS["langevin"][0], c)
    assert np.abs(magnetizations[4] - cohen(c) * np.polyval(fit, 2.0 * c - 1.0)).max() < tolerance


@pytest.mark.parametrize("susceptibility", [0.3, 8.0, 1e3, 1e6, np.inf])
@pytest.mark.parametrize("name", ["tanh", "langevin", "clamped", "frohlich"])
def test_curve_of_a_cell_is_the_formula_in_the_field_inside(name, susceptibility, evaluate):
    """Against a bisection; all values are conditioned by the rounding of 1 − k/3, relative to its value k/χ."""
    k = float(oracle.curve_slope(susceptibility))
    law = oracle.inner_curve(name, susceptibility)
    c, slope = law(S)
    (ratio, kernels_slope, inverse, vectors_ratio, steepness, area), tolerance = evaluate(CURVE_IDS[name][1], c, k)
    exact = np.divide(c, S, out=np.ones_like(S), where=S > 0.0)
    assert np.abs(ratio / exact - 1.0).max() < tolerance
    assert np.abs(vectors_ratio / exact - 1.0).max() < tolerance
    assert np.abs(inverse * ratio - 1.0)[(c < 0.999) & (c > 1e-2)].max() < 1e2 * tolerance
    inside = k / susceptibility
    smooth = np.abs(S - 1.0) > 0.05 if name == "clamped" or inside < 1e-4 else np.full(len(S), True)
    bound = tolerance + 1e-7 * (tolerance / 1e-5) / max(inside, 1e-6)
    assert np.abs(kernels_slope - slope)[smooth].max() < max(bound, 1e-9)
    assert np.abs(steepness - slope)[smooth].max() < max(10.0 * bound, 2e-3 if name == "langevin" else 0.0)
    # ∫c ds by Gauss's rule between neighbors
    nodes, weights = np.polynomial.legendre.leggauss(8)
    middle, half = 0.5 * (S[1:] + S[:-1]), 0.5 * np.diff(S)
    values = law((middle[:, None] + half[:, None] * nodes).ravel())[0].reshape(len(middle), -1)
    total = np.cumsum(half * (values @ weights))
    assert np.abs(area[1:] / total - 1.0).max() < max(tolerance, 1e-4)
