"""Measured magnetization curves: tables of B or M over H, from arrays, from a file, or of a named material.

Cubics without overshoot interpolate M(H) between the points (PCHIP: F. N. Fritsch and J. Butland, "A method for
constructing local monotone piecewise cubic interpolants", 1984). They pass through the points and their mirror images,
so the curve is odd. M never falls, so induction has one solution. Beyond the last point M approaches saturation by the
law M = Ms (1 − a/H) through the last two points (R. M. Bozorth, Ferromagnetism, 1951). If Ms is given, H in that law
is shifted so that the slope at the last point is continuous.
"""

import csv
import math
import os
import re
import stat
from dataclasses import dataclass, field
from typing import Self

import numpy as np
import numpy.typing as npt

from warpmag.declarations.checks import BYTES, check_text, plain_value, real_number, short_repr
from warpmag.errors import InputError

MU0 = 1.2566370614359173e-06
"""Vacuum permeability [T·m/A], the conventional 4π·10⁻⁷."""
_LARGEST_POLARIZATION = 2.5
"""Limit of the polarization [T], above that of every material: iron-cobalt reaches 2.45 T."""
_LEVEL_TOLERANCE = 1e-3
"""Largest fall of M that counts as level, as a fraction of the largest M.

Tables print B with three or four digits, and near saturation B is little more than μ0 H.
"""
_LARGEST_COUNT = 4096
_UNITS = {
    "h": {"A/m": 1.0, "kA/m": 1e3, "Oe": 1e3 / (4.0 * math.pi)},
    "b": {"T": 1.0, "mT": 1e-3, "G": 1e-4, "kG": 0.1},
    "m": {"A/m": 1.0, "kA/m": 1e3, "MA/m": 1e6},
}
_UNITS["j"] = _UNITS["b"]
_COLUMN = re.compile(r"\s*([HBMJ])\s*[\[(]\s*([A-Za-z/]+)\s*[\])]\s*", re.IGNORECASE)


@dataclass(frozen=True)
class MagnetizationCurve:
    """A measured magnetization curve; :meth:`from_bh`, :meth:`from_mh` and :meth:`from_csv` make one.

    Attributes:
        fields: Field H inside the material at the points [A/m], rising from 0.
        magnetizations: Magnetization M at the points [A/m], never falling, from 0.
        saturation: Saturation magnetization Ms [A/m], the limit beyond the last point.
        name: Name of the curve in messages.

    Example:
        >>> import warpmag
        >>> steel = warpmag.MagnetizationCurve.from_bh([0, 200, 1e3, 1e4, 1e5], [0, 0.6, 1.35, 1.8, 2.1])
        >>> float(steel.fields[-1])  # A/m
        100000.0
    """

    fields: tuple[float, ...]
    magnetizations: tuple[float, ...]
    saturation: float
    name: str = field(default="curve", compare=False)

    @classmethod
    def from_bh(
        cls,
        fields: npt.ArrayLike,
        flux_densities: npt.ArrayLike,
        *,
        saturation: float | None = None,
        name: str = "curve",
    ) -> Self:
        """Return the curve of flux densities B [T] at fields H [A/m], each of shape [points].

        Args:
            fields: H inside the material [A/m], rising; a missing origin is added.
            flux_densities: B [T].
            saturation: Ms [A/m]; by default extrapolated from the last two points.
            name: Name of the curve in messages.

        Raises:
            InputError: The points are not a magnetization curve; the message names the reason and the point.
        """
        h, b = _points(name, fields, "flux densities", flux_densities)
        return cls._from_points(name, h, b / MU0 - h, saturation)

    @classmethod
    def from_mh(
        cls,
        fields: npt.ArrayLike,
        magnetizations: npt.ArrayLike,
        *,
        saturation: float | None = None,
        name: str = "curve",
    ) -> Self:
        """Return the curve of magnetizations M [A/m] at fields H [A/m]; see :meth:`from_bh`."""
        h, m = _points(name, fields, "magnetizations", magnetizations)
        return cls._from_points(name, h, m, saturation)

    @classmethod
    def from_csv(cls, path: str | os.PathLike, *, saturation: float | None = None) -> Self:
        """Return the curve of a file with two columns.

        The first line names quantities and units, such as ``H [A/m], B [T]``. The second quantity is the flux density
        B, the polarization J or the magnetization M. Units are A/m, kA/m or Oe for H; T, mT, G or kG for B and J; A/m,
        kA/m or MA/m for M. Lines that begin with # are skipped.

        Raises:
            InputError: The file cannot be read, or the points are not a magnetization curve.
        """
        if not isinstance(path, str | os.PathLike) or not os.fspath(path):
            raise InputError(f"path: must be the name of a file, got {short_repr(path)}")
        name = os.path.basename(os.fspath(path)) or "path"
        (_, h_unit), (quantity, second_unit), rows = _read_csv(path, name)
        h, second = rows[:, 0] * h_unit, rows[:, 1] * second_unit
        if quantity == "m":
            return cls.from_mh(h, second, saturation=saturation, name=name)
        return cls.from_bh(h, second if quantity == "b" else second + MU0 * h, saturation=saturation, name=name)

    @classmethod
    def _from_points(cls, name, h, m, saturation):
        """Return the curve through checked points; add the origin and the saturation where missing."""
        if h[0] != 0.0:
            h, m = np.append(0.0, h), np.append(0.0, m)
        _check_points(name, h, m)
        m = np.maximum.accumulate(m)
        slope = float(_slopes(h, m)[-1])
        saturation = float(m[-1] + h[-1] * slope) if saturation is None else saturation
        saturation = _checked_saturation(name, h, m, slope, saturation)
        return cls(tuple(h.tolist()), tuple(m.tolist()), saturation, name)

    @property
    def flux_densities(self) -> tuple[float, ...]:
        """Flux densities B = μ0 (H + M) at the points [T]."""
        return tuple((MU0 * (np.array(self.fields) + np.array(self.magnetizations))).tolist())

    @property
    def slopes(self) -> tuple[float, ...]:
        """Susceptibilities dM/dH at the points [dimensionless]."""
        return tuple(_slopes(np.array(self.fields), np.array(self.magnetizations)).tolist())

    @property
    def susceptibility(self) -> float:
        """Largest susceptibility dM/dH of the curve [dimensionless]."""
        slope = np.array(self.slopes)
        secant = np.diff(self.magnetizations) / np.diff(self.fields)
        # the derivative of a cubic is a parabola, slope + t (2 b + 3 t c): the maximum is at an end or at the vertex
        b, c = 3.0 * secant - 2.0 * slope[:-1] - slope[1:], slope[:-1] + slope[1:] - 2.0 * secant
        vertex = np.clip(np.divide(-b, 3.0 * c, out=np.zeros_like(b), where=c < 0.0), 0.0, 1.0)
        return float(max(slope.max(), (slope[:-1] + vertex * (2.0 * b + 3.0 * vertex * c)).max()))

    def magnetization(self, fields: npt.ArrayLike) -> np.ndarray:
        """Return the magnetization M [A/m] at internal fields H ≥ 0 [A/m], NumPy, any shape.

        Raises:
            InputError: A field is negative, or not a finite number.
        """
        h, m, d = np.array(self.fields), np.array(self.magnetizations), np.array(self.slopes)
        x = _real_numbers(self.name, "fields", fields)
        if (x < 0.0).any():
            raise InputError(f"{self.name}: fields must be zero or positive, got {x.min():g}")
        k = np.clip(np.searchsorted(h, x, "right") - 1, 0, len(h) - 2)
        span, rise = np.diff(h)[k], np.diff(m)[k]
        t = np.minimum((x - h[k]) / span, 1.0)
        begin, end = span * d[k], span * d[k + 1]
        inside = m[k] + t * (begin + t * (3.0 * rise - 2.0 * begin - end + t * (begin + end - 2.0 * rise)))
        deficit = self.saturation - m[-1]  # Ms − M at the last point
        deficit_beyond = deficit**2 / (deficit + d[-1] * np.maximum(x - h[-1], 0.0)) if deficit > 0.0 else 0.0
        return np.where(x <= h[-1], inside, self.saturation - deficit_beyond)


def _slopes(h, m):
    """Return the slopes dM/dH at the points, by PCHIP."""
    span, secant = np.diff(h), np.diff(m) / np.diff(h)
    slope = np.empty(len(h))
    slope[0] = secant[0]  # the curve continues as its mirror image
    weight, other = 2.0 * span[1:] + span[:-1], span[1:] + 2.0 * span[:-1]
    rising = (secant[:-1] > 0.0) & (secant[1:] > 0.0)
    with np.errstate(divide="ignore", invalid="ignore"):
        slope[1:-1] = np.where(rising, (weight + other) / (weight / secant[:-1] + other / secant[1:]), 0.0)
    slope[-1] = secant[-1] * h[-2] / h[-1]  # by the law of approach to saturation
    return slope


def _real_numbers(name: str, quantity: str, values) -> np.ndarray:
    """Return values as an array of finite numbers, any shape."""
    if getattr(values, "requires_grad", False):
        raise InputError(f"{name}: {quantity} require a gradient, which only curve_points of solve_induction have")
    try:
        array = np.asarray(None if isinstance(values, BYTES) else plain_value(f"{name}: {quantity}", values))
        if array.dtype.kind not in "iuf":
            raise TypeError
        array = array.astype(float)
    except (TypeError, ValueError, OverflowError):
        raise InputError(f"{name}: {quantity} must be real numbers") from None
    wrong = np.flatnonzero(~np.isfinite(array))
    if len(wrong):
        raise InputError(f"{name}: {quantity} must be finite, got {array.flat[wrong[0]]:g} at point {wrong[0] + 1}")
    return array


def _numbers(name: str, quantity: str, values) -> np.ndarray:
    """Return values as a one-dimensional array of finite numbers."""
    array = _real_numbers(name, quantity, values)
    if array.ndim != 1:
        raise InputError(f"{name}: {quantity} must be a list of numbers, shape [points], got {list(array.shape)}")
    return array


def _points(name: str, fields, quantity: str, values) -> tuple[np.ndarray, np.ndarray]:
    """Return the fields at the points of a curve, and the values of another quantity at these points."""
    check_text("name", name)
    h, others = _numbers(name, "fields", fields), _numbers(name, quantity, values)
    if len(h) != len(others):
        raise InputError(f"{name}: {len(h)} fields, but {len(others)} values at them")
    if not 2 <= len(h) <= _LARGEST_COUNT:
        raise InputError(f"{name}: a curve has 2 to {_LARGEST_COUNT} points, got {len(h)}")
    return h, others


def _check_points(name: str, h, m) -> None:
    if h[0] == 0.0 and m[0] != 0.0:
        raise InputError(f"{name}: at H = 0 there is M = {m[0]:.4g} A/m; a curve without hysteresis begins at 0")
    not_rising = np.flatnonzero(np.diff(h) <= 0.0)
    if len(not_rising):
        k = not_rising[0]
        raise InputError(f"{name}: H must rise from 0, but {h[k + 1]:g} A/m follows {h[k]:g} A/m")
    polarization = float(MU0 * m.max())
    if polarization > _LARGEST_POLARIZATION:
        k = int(m.argmax())
        raise InputError(
            f"{name}: at H = {h[k]:g} A/m the polarization B − μ0 H is {polarization:.3g} T, which no material reaches"
            ": H is in A/m, B in T"
        )
    falls = np.flatnonzero(np.diff(m) < -_LEVEL_TOLERANCE * polarization / MU0)
    if len(falls):
        k = falls[0]
        raise InputError(
            f"{name}: M = B/μ0 − H must not fall, but from H = {h[k]:g} to {h[k + 1]:g} A/m it does, from {m[k]:.5g} "
            f"to {m[k + 1]:.5g} A/m: B rises by less than μ0 ΔH"
        )
    if not m[1] > 0.0:
        raise InputError(f"{name}: M must rise from the origin, but at H = {h[1]:g} A/m it is {m[1]:.4g} A/m")


def _checked_saturation(name: str, h, m, slope: float, given) -> float:
    """Return the saturation magnetization [A/m] if a curve can reach it from its last point."""
    saturation = real_number(f"{name}: saturation", given)
    if not math.isfinite(saturation):
        raise InputError(f"{name}: saturation must be a finite number [A/m], got {saturation}")
    if saturation < m[-1] * (1.0 - 1e-9):
        raise InputError(f"{name}: saturation {saturation:g} A/m is less than the last point's M, {m[-1]:g} A/m")
    if slope == 0.0 and saturation > m[-1] * (1.0 + 1e-9):
        raise InputError(f"{name}: saturation {saturation:g} A/m is not reached, the curve ends flat at {m[-1]:g} A/m")
    if MU0 * saturation > _LARGEST_POLARIZATION:
        raise InputError(
            f"{name}: it would saturate at {MU0 * saturation:.3g} T, which no material does: H is in A/m, B in T; "
            "where a curve ends far from saturation, give the saturation"
        )
    return saturation


def _read_csv(path, name: str):
    """Return (quantity, factor to SI) of each of the two columns of a file, and the rows."""
    try:
        if not stat.S_ISREG(os.stat(path).st_mode):  # a pipe would wait for ever
            raise OSError("not a regular file")
        with open(path, newline="", encoding="utf-8-sig") as file:
            lines = [row for row in csv.reader(line for line in file if line.strip() and line.lstrip()[0] != "#")]
    except (OSError, ValueError, csv.Error) as error:  # text in another encoding, or a name with a null character
        raise InputError(f"{name}: cannot be read ({error})") from None
    matches = [_COLUMN.fullmatch(cell) for cell in lines[0]] if lines else []
    if len(matches) != 2 or None in matches:
        raise InputError(f"{name}: the first line must name the two columns, such as 'H [A/m], B [T]'")
    columns = [_unit(name, *match.groups()) for match in matches if match]
    if columns[0][0] != "h" or columns[1][0] == "h":
        raise InputError(f"{name}: the first column must be H, the second B, J or M")
    try:
        rows = np.array([[float(cell) for cell in row] for row in lines[1:]])
    except ValueError as error:
        raise InputError(f"{name}: not a number ({error})") from None
    if rows.ndim != 2 or rows.shape[1] != 2:
        raise InputError(f"{name}: each line after the first must have two numbers")
    return columns[0], columns[1], rows


def _unit(name: str, quantity: str, unit: str) -> tuple[str, float]:
    """Return a quantity in lower case and the factor of its unit to SI."""
    units = _UNITS[quantity.lower()]
    if unit not in units:
        raise InputError(f"{name}: unknown unit {unit} of {quantity}; known are {', '.join(units)}")
    return quantity.lower(), units[unit]
