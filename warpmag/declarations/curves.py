"""Magnetization curves that were measured: tables of B or M over H, from arrays, from a file, or of a named material.

Between the points M(H) is interpolated without overshoot by cubics (PCHIP: F. N. Fritsch and J. Butland, "A method for
constructing local monotone piecewise cubic interpolants", 1984) through the points and their mirror images, so that the
curve is odd. It never falls, so that induction has one solution. Beyond the last point M approaches saturation as the
law M = Ms (1 − a/H) through the last two has it (R. M. Bozorth, Ferromagnetism, 1951). Where Ms is given, H is counted
from elsewhere, so that the curve goes on with the same slope.
"""

import csv
import math
import os
import re
from dataclasses import dataclass, field
from typing import Self

import numpy as np
import numpy.typing as npt

from warpmag.errors import InputError

MU0 = 1.2566370614359173e-06
"""Vacuum permeability [T·m/A], the conventional 4π·10⁻⁷."""
_STRONGEST = 2.5
"""Polarization [T] that no material has: iron-cobalt, the strongest, has 2.45 T."""
_ROUNDED = 1e-3
"""Part of the largest magnetization by which M may fall and is taken for level: B is printed with three or four digits,
and where a curve is saturated all it says is μ0 H."""
_MOST_POINTS = 4096
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
        magnetizations: Magnetization M there [A/m], never falling, from 0.
        saturation: Magnetization Ms [A/m] that it approaches beyond the last point.
        name: What messages call it.
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
            fields: H inside the material [A/m], rising; the origin is added where it is missing.
            flux_densities: B [T].
            saturation: Ms [A/m]; by default what the last two points lead to.
            name: What messages call the curve.

        Raises:
            InputError: The points are no magnetization curve; the message has the reason and the point.
        """
        h, b = _numbers(name, "fields", fields), _numbers(name, "flux densities", flux_densities)
        _check_count(name, h, b)
        return cls._made(name, h, b / MU0 - h, saturation)

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
        h, m = _numbers(name, "fields", fields), _numbers(name, "magnetizations", magnetizations)
        _check_count(name, h, m)
        return cls._made(name, h, m, saturation)

    @classmethod
    def from_csv(cls, path: str | os.PathLike, *, saturation: float | None = None) -> Self:
        """Return the curve of a file with two columns, the first line of which says what they are.

        Such as ``H [A/m], B [T]``. The second may be the flux density B, the polarization J or the magnetization M.
        Units are A/m, kA/m or Oe of H; T, mT, G or kG of B and J; A/m, kA/m or MA/m of M. Lines that begin with #
        are skipped.

        Raises:
            InputError: The file cannot be read, or the points are no magnetization curve.
        """
        name = os.path.basename(os.fspath(path))
        (_, of_h), (quantity, of_second), rows = _read_csv(path, name)
        h, second = rows[:, 0] * of_h, rows[:, 1] * of_second
        if quantity == "m":
            return cls.from_mh(h, second, saturation=saturation, name=name)
        return cls.from_bh(h, second if quantity == "b" else second + MU0 * h, saturation=saturation, name=name)

    @classmethod
    def _made(cls, name, h, m, saturation):
        """Check points and complete the curve."""
        if h[0] != 0.0:
            h, m = np.append(0.0, h), np.append(0.0, m)
        _check_points(name, h, m)
        m = np.maximum.accumulate(m)
        slope = float(_slopes(h, m)[-1])
        if saturation is None:
            saturation = float(m[-1] + h[-1] * slope)
        _check_saturation(name, h, m, slope, saturation)
        return cls(tuple(h.tolist()), tuple(m.tolist()), float(saturation), name)

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
        """The largest susceptibility dM/dH anywhere [dimensionless]."""
        slope = np.array(self.slopes)
        secant = np.diff(self.magnetizations) / np.diff(self.fields)
        # the derivative of a cubic is a parabola in t: begin + t (2 b + 3 t c), largest at an end or at its vertex
        b, c = 3.0 * secant - 2.0 * slope[:-1] - slope[1:], slope[:-1] + slope[1:] - 2.0 * secant
        vertex = np.clip(np.divide(-b, 3.0 * c, out=np.zeros_like(b), where=c < 0.0), 0.0, 1.0)
        return float(max(slope.max(), (slope[:-1] + vertex * (2.0 * b + 3.0 * vertex * c)).max()))

    def magnetization(self, fields: npt.ArrayLike) -> np.ndarray:
        """Return the magnetization M [A/m] at fields H ≥ 0 inside the material [A/m], NumPy, any shape."""
        h, m, d = np.array(self.fields), np.array(self.magnetizations), np.array(self.slopes)
        x = np.asarray(fields, float)
        k = np.clip(np.searchsorted(h, x, "right") - 1, 0, len(h) - 2)
        span, rise = np.diff(h)[k], np.diff(m)[k]
        t = np.minimum((x - h[k]) / span, 1.0)
        begin, end = span * d[k], span * d[k + 1]
        inside = m[k] + t * (begin + t * (3.0 * rise - 2.0 * begin - end + t * (begin + end - 2.0 * rise)))
        left = self.saturation - m[-1]
        beyond = left**2 / (left + d[-1] * np.maximum(x - h[-1], 0.0)) if left > 0.0 else 0.0
        return np.where(x <= h[-1], inside, self.saturation - beyond)


def _slopes(h, m):
    """Slopes at the points by PCHIP, the curve mirrored at the origin; at the last that of the law through two."""
    span, secant = np.diff(h), np.diff(m) / np.diff(h)
    slope = np.empty(len(h))
    slope[0] = secant[0]
    weight, other = 2.0 * span[1:] + span[:-1], span[1:] + 2.0 * span[:-1]
    rising = (secant[:-1] > 0.0) & (secant[1:] > 0.0)
    with np.errstate(divide="ignore", invalid="ignore"):
        slope[1:-1] = np.where(rising, (weight + other) / (weight / secant[:-1] + other / secant[1:]), 0.0)
    slope[-1] = secant[-1] * h[-2] / h[-1]
    return slope


def _numbers(name: str, what: str, values) -> np.ndarray:
    try:
        array = np.asarray(values)
        if array.dtype.kind not in "iuf":
            raise TypeError
        array = array.astype(float)
    except (TypeError, ValueError, OverflowError):
        raise InputError(f"{name}: {what} must be real numbers") from None
    if array.ndim != 1:
        raise InputError(f"{name}: {what} must be a list of numbers, shape [points], got {list(array.shape)}")
    wrong = np.flatnonzero(~np.isfinite(array))
    if len(wrong):
        raise InputError(f"{name}: {what} must be finite, got {array[wrong[0]]:g} at point {wrong[0] + 1}")
    return array


def _check_count(name: str, h, other) -> None:
    if len(h) != len(other):
        raise InputError(f"{name}: {len(h)} fields, but {len(other)} values at them")
    if not 2 <= len(h) <= _MOST_POINTS:
        raise InputError(f"{name}: a curve has 2 to {_MOST_POINTS} points, got {len(h)}")


def _check_points(name: str, h, m) -> None:
    if h[0] == 0.0 and m[0] != 0.0:
        raise InputError(f"{name}: at H = 0 there is M = {m[0]:.4g} A/m; a curve without hysteresis begins at 0")
    where = np.flatnonzero(np.diff(h) <= 0.0)
    if len(where):
        k = where[0]
        raise InputError(f"{name}: H must rise from 0, but {h[k + 1]:g} A/m follows {h[k]:g} A/m")
    strongest = float(MU0 * m.max())
    if strongest > _STRONGEST:
        k = int(m.argmax())
        raise InputError(
            f"{name}: at H = {h[k]:g} A/m the polarization B − μ0 H is {strongest:.3g} T, which no material reaches: "
            "H is in A/m, B in T"
        )
    where = np.flatnonzero(np.diff(m) < -_ROUNDED * strongest / MU0)
    if len(where):
        k = where[0]
        raise InputError(
            f"{name}: M = B/μ0 − H must not fall, but from H = {h[k]:g} to {h[k + 1]:g} A/m it does, from {m[k]:.5g} "
            f"to {m[k + 1]:.5g} A/m: B rises by less than μ0 ΔH"
        )
    if not m[1] > 0.0:
        raise InputError(f"{name}: M must rise from the origin, but at H = {h[1]:g} A/m it is {m[1]:.4g} A/m")


def _check_saturation(name: str, h, m, slope: float, saturation) -> None:
    try:
        sound = math.isfinite(saturation) and not isinstance(saturation, bool)
    except TypeError:
        sound = False
    if not sound:
        raise InputError(f"{name}: saturation must be a finite number [A/m]")
    if saturation < m[-1] * (1.0 - 1e-9):
        raise InputError(f"{name}: saturation {saturation:g} A/m is less than the last point's M, {m[-1]:g} A/m")
    if slope == 0.0 and saturation > m[-1] * (1.0 + 1e-9):
        raise InputError(f"{name}: saturation {saturation:g} A/m is not reached, the curve ends flat at {m[-1]:g} A/m")
    if MU0 * saturation > _STRONGEST:
        raise InputError(
            f"{name}: it would saturate at {MU0 * saturation:.3g} T, which no material does: H is in A/m, B in T; "
            "where a curve ends far from saturation, give the saturation"
        )


def _read_csv(path, name: str):
    """Return what the two columns of a file are, each with the factor to SI, and the rows."""
    try:
        with open(path, newline="", encoding="utf-8-sig") as file:
            lines = [row for row in csv.reader(line for line in file if line.strip() and line.lstrip()[0] != "#")]
    except (OSError, UnicodeDecodeError, csv.Error) as error:
        raise InputError(f"{name}: cannot be read ({error})") from None
    found = [_COLUMN.fullmatch(cell) for cell in lines[0]] if lines else []
    if len(found) != 2 or None in found:
        raise InputError(f"{name}: its first line must say what the two columns are, as 'H [A/m], B [T]'")
    columns = [_unit(name, *match.groups()) for match in found if match]
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
    """Return a quantity and the factor of its unit to SI."""
    units = _UNITS[quantity.lower()]
    if unit not in units:
        raise InputError(f"{name}: {quantity} in {unit} is not known, only in {', '.join(units)}")
    return quantity.lower(), units[unit]
