"""Magnetization curves M = f(H) in reduced form (Kim and Han 2022, Eqs. 7, 10).

With the reduced field s = k‖H‖/Ms every curve reads ‖M‖ = Ms c(s), c(0) = 0, c'(0) = 1, c(∞) = 1:

| curve | c(s) | source |
|---|---|---|
| tanh | tanh s | Kim and Han 2022, Eq. 10 |
| langevin | L(3s), L(x) = coth x − 1/x | their section 6.2 |
| clamped | min(s, 1) | Eq. 7 |
| frohlich | s/(1 + s) | Fröhlich 1881, Kennelly 1891 |

k = 3χ/(3+χ) is the initial slope of a ball of susceptibility χ. ``curves.h`` has the functions. Kernels that call them
from here, for float32 or float64, take ``native_options("material/curves.h", dtype=dtype)``.
"""

from dataclasses import dataclass
from typing import Any

import warp as wp

TANH, LANGEVIN, CLAMPED, FROHLICH = range(4)
"""Numbers of the curves; as in ``curves.h``."""
CURVE_IDS = {"tanh": TANH, "langevin": LANGEVIN, "clamped": CLAMPED, "frohlich": FROHLICH}


@dataclass(frozen=True)
class CurveParameters:
    """Magnetization curve of each moment, on one device.

    Attributes:
        inducible: 1 for inducible moments, 0 for permanent ones, shape [n].
        saturation: Saturation magnetization Ms [A/m], shape [n].
        slope: Initial slope k = 3χ/(3+χ) [dimensionless], shape [n].
        curve: Curve id, one of ``CURVE_IDS``, shape [n].
    """

    inducible: wp.array
    saturation: wp.array
    slope: wp.array
    curve: wp.array


for _dtype in (wp.float32, wp.float64):

    @wp.func_native("return warpmag::curve_ratio(s, curve);")
    def curve_ratio(s: _dtype, curve: int) -> _dtype:
        """c(s)/s, which is 1 at s = 0: the factor between a reduced field vector and its reduced magnetization."""
        ...

    @wp.func_native("return warpmag::curve_slope(s, curve);")
    def curve_slope(s: _dtype, curve: int) -> _dtype:
        """Derivative c'(s) for s ≥ 0."""
        ...

    @wp.func_native("return warpmag::curve_area(double(s), curve);")
    def curve_area(s: _dtype, curve: int) -> wp.float64:
        """Area ∫ c ds from 0 to ``s``."""
        ...

    @wp.func_native("return warpmag::inverse_curve_ratio(c, curve);")
    def inverse_curve_ratio(c: _dtype, curve: int) -> _dtype:
        """s/c of the reduced field s that makes reduced magnetization ``c``; a saturated one gets a large finite s."""
        ...


@wp.func
def curve_derivative_times(h: Any, v: Any, k: Any, saturation: Any, curve: int):
    """Product f'(H) v of the curve's derivative ∂M/∂H at field ``h`` [A/m] with a vector ``v``; Eq. 4 needs it."""
    norm = wp.length(h)
    s = k * norm / saturation
    across = k * curve_ratio(s, curve)
    if norm == type(norm)(0.0):
        return across * v
    unit = h / norm
    along = k * curve_slope(s, curve)
    return across * v + ((along - across) * wp.dot(unit, v)) * unit
