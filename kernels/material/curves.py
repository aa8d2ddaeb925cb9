"""Magnetization curves M = f(H) in reduced form (Kim and Han 2022, Eqs. 7, 10), with a formula or measured.

With the reduced field s = k‖H‖/Ms every curve reads ‖M‖ = Ms c(s), c(0) = 0, c'(0) = 1, c(∞) = 1:

| curve | c(s) | source |
|---|---|---|
| tanh | tanh s | Kim and Han 2022, Eq. 10 |
| langevin | L(3s), L(x) = coth x − 1/x | their section 6.2 |
| clamped | min(s, 1) | Eq. 7 |
| frohlich | s/(1 + s) | Fröhlich 1881, Kennelly 1891 |

k = 3χ/(3+χ) is the initial slope of a ball of susceptibility χ. ``curves.h`` has the functions. Kernels that call the
Warp functions of this module, for float32 or float64, take ``native_options("material/curves.h", dtype=dtype)``. The
curve c = s (``LINEAR``) has no token; it is the response of a permanent magnet.

**Balls and cells.** A moment's field H is that of all others, without its own field −M/3. A ball has ‖M‖ = Ms c(s) in
this field, as in the paper. A cell of a body of any shape has ‖M‖ = Ms c(y) in the field H' = H − M/3 inside, with
y = χ H'/Ms. Then s = b y + a c(y), a = k/3, b = 1 − a = k/χ, and curve ``INNER + i`` is M as a function of s.
``clamped`` and ``LINEAR`` are the same function for both. The token ``tanh-applied`` is Eq. 10 for cells, too.

**Measured curves.** A table gives M as a function of the field H' inside the material. With y = k H'/Ms and c = M/Ms,
the reduced field of a ball or a cell is s = y + (k/3) c. Between two knots c is cubic in y,

    c = c_i + t (c1 + t (c2 + t c3)),    y = y_i + t span,    t in [0, 1].

Beyond the last knot c = 1 − a/z, where z is y plus a constant, with a continuous slope (law of approach to saturation,
R. M. Bozorth, Ferromagnetism, 1951). k belongs to the largest susceptibility of the table. So no slope c' exceeds 1,
and the iteration converges as for other curves. ``tables.h`` solves for t. The rows of a table are

| column | 0 | 1 | 2 | 3 to 5 | 6 | 7 |
|---|---|---|---|---|---|---|
| of a piece | s_i | c_i | span | c1, c2, c3 | ∫c dy from 0 to y_i | k/3 |
| of the last knot | s_n | c_n | 0 | z_n, a, 0 | ∫c dy from 0 to y_n | k/3 |

All tables are padded to one length with rows that no field reaches, so that every search takes the same number of
steps. Row 0 of the array, before the first table, holds that length.
"""

from dataclasses import dataclass
from typing import Any

import numpy as np
import warp as wp

MIXED, TANH, LANGEVIN, CLAMPED, FROHLICH, LINEAR, INNER = range(-1, 6)
"""Ids of the curves; ``INNER + TANH`` is tanh as a function of the field inside. As in ``curves.h``."""
FIRST_TABLE = INNER + LINEAR
"""Id of the first measured curve; as in ``tables.h``."""
CURVE_IDS = {
    "tanh": (TANH, INNER + TANH),
    "langevin": (LANGEVIN, INNER + LANGEVIN),
    "clamped": (CLAMPED, CLAMPED),
    "frohlich": (FROHLICH, INNER + FROHLICH),
    "tanh-applied": (TANH, TANH),
}
"""Ids of the curves with a token, of a ball and of a cell."""
_COLUMNS = 8
_BEYOND = 1e30  # reduced field and magnetization of the padding, which no field reaches


@dataclass(frozen=True)
class CurveParameters:
    """Magnetization curve of each moment, on one device."""

    inducible: wp.array  # 1 for inducible moments, 0 for permanent ones, shape [n]
    saturation: wp.array  # saturation magnetization Ms [A/m], shape [n]
    slope: wp.array  # slope k = 3χ/(3+χ) [dimensionless], the largest of the curve, shape [n]
    curve: wp.array  # id of a formula, or ``FIRST_TABLE`` + i for measured curve i of ``tables``, shape [n]
    common_curve: int  # common curve id of all inducible moments, or ``MIXED``
    tables: wp.array  # measured curves (:func:`curve_tables`)


def curve_tables(measured, dtype, device) -> wp.array:
    """Return the rows of measured curves for the kernels, shape [rows, 8].

    Args:
        measured: Curves, :class:`warpmag.declarations.curves.MagnetizationCurve`: knots ``fields`` and
            ``magnetizations`` [A/m], ``slopes`` dM/dH at them, ``saturation`` [A/m] and the largest ``susceptibility``.
    """
    longest = max((len(curve.fields) for curve in measured), default=1)
    size = 1 << (longest - 1).bit_length()
    rows = np.zeros((1 + size * len(measured), _COLUMNS))
    rows[0] = size
    rows[1:, :2] = _BEYOND
    for number, curve in enumerate(measured):
        first = 1 + size * number
        rows[first : first + len(curve.fields)] = _rows(curve)
    return wp.array(rows, dtype=dtype, device=device)


def _rows(measured) -> np.ndarray:
    """Return the rows of one measured curve, shape [knots, 8]."""
    k = 3.0 / (1.0 + 3.0 / measured.susceptibility)
    y, c = k * np.asarray(measured.fields), np.asarray(measured.magnetizations)
    y, c = y / measured.saturation, c / measured.saturation
    slope = np.asarray(measured.slopes) / k
    span, rise = np.diff(y), np.diff(c)
    begin, end = span * slope[:-1], span * slope[1:]
    c1, c2, c3 = begin, 3.0 * rise - 2.0 * begin - end, begin + end - 2.0 * rise
    area = np.concatenate([[0.0], np.cumsum(span * (c[:-1] + c1 / 2.0 + c2 / 3.0 + c3 / 4.0))])
    unsaturated = 1.0 - c[-1]
    z, a = (unsaturated / slope[-1], unsaturated**2 / slope[-1]) if unsaturated > 0.0 else (1.0, 0.0)
    pieces = [np.append(span, 0.0), np.append(c1, z), np.append(c2, a), np.append(c3, 0.0)]
    return np.stack([y + k / 3.0 * c, c, *pieces, area, np.full(len(y), k / 3.0)], axis=1)


for _dtype in (wp.float32, wp.float64):

    @wp.func_native("return warpmag::curve_ratio(s, k, curve, tables.data);")
    def curve_ratio(s: _dtype, k: _dtype, curve: int, tables: wp.array2d[_dtype]) -> _dtype:
        """c(s)/s, the factor between a reduced field vector and its reduced magnetization; 1 at s = 0."""

    @wp.func_native("return warpmag::curve_slope(s, k, curve, tables.data);")
    def curve_slope(s: _dtype, k: _dtype, curve: int, tables: wp.array2d[_dtype]) -> _dtype:
        """Derivative c'(s) for s ≥ 0."""

    @wp.func_native("return warpmag::curve_area(s, k, curve, tables.data);")
    def curve_area(s: _dtype, k: _dtype, curve: int, tables: wp.array2d[_dtype]) -> wp.float64:
        """Area ∫ c ds from 0 to ``s``."""

    @wp.func_native("return warpmag::inverse_curve_ratio(c, k, curve, tables.data);")
    def inverse_curve_ratio(c: _dtype, k: _dtype, curve: int, tables: wp.array2d[_dtype]) -> _dtype:
        """Ratio s/c of the reduced field s to the reduced magnetization ``c``; large but finite at saturation."""


@wp.func
def curve_derivative_times(h: Any, v: Any, k: Any, saturation: Any, curve: int, tables: Any):
    """Product f'(H) v of the curve's derivative ∂M/∂H at field ``h`` [A/m] with a vector ``v`` (for Eq. 4)."""
    norm = wp.length(h)
    s = k * norm / saturation
    perpendicular = k * curve_ratio(s, k, curve, tables)
    if norm == type(norm)(0.0):
        return perpendicular * v
    unit = h / norm
    parallel = k * curve_slope(s, k, curve, tables)
    # f' v = k (c/s) v + k (c' − c/s) (u·v) u
    return perpendicular * v + ((parallel - perpendicular) * wp.dot(unit, v)) * unit
