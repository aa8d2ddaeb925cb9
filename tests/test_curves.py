"""Magnetization curves of the kernels, in Warp functions and in passes over moments, against the float64 oracle."""

import numpy as np
import pytest
import warp as wp

from bench.reference import oracle
from warpmag.declarations import magnets
from warpmag.kernels.material.curves import CURVE_IDS, curve_ratio, curve_slope, inverse_curve_ratio
from warpmag.kernels.shared.native import CHUNK, native_options

S = np.concatenate([[0.0], np.geomspace(1e-3, 30.0, 319)])
"""Reduced fields, a multiple of ``CHUNK``."""
PRECISION = {"float32": 1e-5, "float64": 1e-9}  # Langevin's curve cancels where its series ends


@pytest.fixture(scope="module", params=list(PRECISION))
def evaluate(request, device):
    """Return a function that evaluates a curve: c(s)/s in both forms, c'(s), c'(s) from c², and s/c from c."""
    kind = getattr(wp, request.param)
    call = (
        "warpmag::put(ratio.data + i, warpmag::curve_ratio(warpmag::numbers(s.data + i), curve));"
        "warpmag::put(slope.data + i, warpmag::curve_steepness(warpmag::numbers(square.data + i), curve));"
    )

    @wp.func_native(call)
    def by_passes(
        i: int, curve: int, s: wp.array[kind], square: wp.array[kind], ratio: wp.array[kind], slope: wp.array[kind]
    ): ...

    @wp.kernel(module="unique", enable_backward=False, module_options=native_options("material/curves.h", dtype=kind))
    def curves(curve: int, tables: wp.array2d[kind], s: wp.array[kind], square: wp.array[kind], out: wp.array2d[kind]):
        i = wp.tid()
        c = curve_ratio(s[i], curve, tables)
        out[0, i] = c
        out[1, i] = curve_slope(s[i], curve, tables)
        out[2, i] = inverse_curve_ratio(c * s[i], curve, tables)
        by_passes(i, curve, s, square, out[3], out[4])

    def run(name, reduced):
        padded = [np.pad(x, (0, CHUNK)) for x in (S, reduced**2)]
        s, square = (wp.array(x, dtype=kind, device=device) for x in padded)
        out = wp.zeros((5, len(S) + CHUNK), dtype=kind, device=device)
        wp.launch(curves, dim=len(S), inputs=[CURVE_IDS[name], None, s, square, out], device=device)
        return out.numpy()[:, : len(S)].astype(float), PRECISION[request.param]

    return run


@pytest.mark.parametrize("name", magnets.CURVES)
def test_curve_of_the_kernels_is_the_oracles(name, evaluate):
    c, slope = oracle.reduced_curve(S, name)
    (ratio, kernels_slope, inverse, vectors_ratio, steepness), tolerance = evaluate(name, c)
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
    magnetizations, tolerance = evaluate("langevin", c)
    assert np.abs(magnetizations[4] - cohen(c) * np.polyval(fit, 2.0 * c - 1.0)).max() < tolerance
