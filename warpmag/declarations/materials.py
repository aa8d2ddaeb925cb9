"""Magnetic materials by name.

Values are typical at room temperature; the data sheet of a part is more accurate. The susceptibility is the initial
one, for small fields. Above 100 it hardly matters for a ball, because the demagnetizing field limits M/H0 to 3. Some
materials have a measured curve in place of saturation and susceptibility (``measured.py``), with an accurate knee.
Densities are rounded values from Bozorth's table and makers' data sheets.
"""

import math
from dataclasses import dataclass

from warpmag.declarations.checks import check_positive, real_number, short_repr, vector
from warpmag.declarations.curves import MU0, MagnetizationCurve
from warpmag.declarations.magnets import check_curve
from warpmag.declarations.measured import MEASURED_CURVES
from warpmag.errors import InputError, warn_caller

_BOZORTH = (
    "R. M. Bozorth, Ferromagnetism, 1951, table of magnetic materials: permeability at 2 mT, saturation, resistivity"
)
_NDFEB = "GB/T 13560-2017, sintered NdFeB, middle of the range of remanence"


@dataclass(frozen=True)
class Material:
    """A magnetic material.

    Attributes:
        name: Name of the material.
        kind: ``inducible`` or ``permanent``.
        polarization: Saturation polarization μ0·Ms of an inducible, remanence Br of a permanent material [T].
        permeability: Initial relative permeability of an inducible material [dimensionless]. For a measured curve, the
            largest permeability of the curve.
        density: Mass density [kg/m³].
        source: Source of the numbers.
        curve: Measured magnetization curve of an inducible material, or None.
        conductivity: Electrical conductivity [S/m], 0 where the source has none. Magnets do not take it from the
            material: pass it to ``add_inducible(..., conductivity=...)``, for balls. Eddy currents cost a sum over
            pairs.
    """

    name: str
    kind: str
    polarization: float
    permeability: float
    density: float
    source: str
    curve: MagnetizationCurve | None = None
    conductivity: float = 0.0

    @property
    def saturation(self) -> float:
        """Saturation magnetization Ms [A/m] of an inducible material."""
        return self.polarization / MU0

    @property
    def susceptibility(self) -> float:
        """Susceptibility χ [dimensionless] of an inducible material."""
        return self.permeability - 1.0

    @property
    def magnetization(self) -> float:
        """Magnetization M = Br/μ0 [A/m] of a permanent material."""
        return self.polarization / MU0


def _inducible(name, saturation, permeability, density, resistivity, source):
    return Material(name, "inducible", saturation, permeability, density, source, conductivity=1.0 / resistivity)


def _measured(name, density):
    source, *rows = MEASURED_CURVES[name]
    h, b = zip(*(point for row in rows for point in row), strict=True)
    curve = MagnetizationCurve.from_bh(h, b, name=name)
    return Material(name, "inducible", MU0 * curve.saturation, 1.0 + curve.susceptibility, density, source, curve)


def _permanent(name, remanence, density, source):
    return Material(name, "permanent", remanence, math.nan, density, source)


MATERIALS = {
    entry.name: entry
    for entry in (
        _inducible("iron", 2.15, 200.0, 7870.0, 1e-7, f"{_BOZORTH}; 99.91 % Fe"),
        _inducible("mild-steel", 2.10, 180.0, 7870.0, 1e-7, f"{_BOZORTH}; cold-rolled steel, 98.5 % Fe"),
        _inducible("silicon-steel", 1.97, 500.0, 7650.0, 6e-7, f"{_BOZORTH}; 4 % Si"),
        _inducible("permalloy", 1.07, 8000.0, 8600.0, 1.6e-7, f"{_BOZORTH}; 78.5 % Ni"),
        _inducible("mumetal", 0.65, 20000.0, 8580.0, 6.2e-7, f"{_BOZORTH}; 77 % Ni, 5 % Cu, 2 % Cr"),
        _inducible("soft-ferrite", 0.47, 2300.0, 4800.0, 5.0, "Ferroxcube, Soft Ferrites, 2013; 3C90 (MnZn) at 25 °C"),
        _measured("pure-iron", 7870.0),
        _measured("1010-steel", 7870.0),
        _measured("M-19", 7650.0),
        _measured("430-stainless", 7700.0),
        _permanent("N35", 1.195, 7500.0, _NDFEB),
        _permanent("N42", 1.30, 7500.0, _NDFEB),
        _permanent("N52", 1.45, 7500.0, _NDFEB),
        _permanent("SmCo", 1.05, 8300.0, "Magna Tokyo, magnet characteristics: Sm2Co17"),
        _permanent("AlNiCo5", 1.27, 7300.0, "Magna Tokyo, magnet characteristics"),
        _permanent("AlNiCo8", 0.88, 7250.0, "Magna Tokyo, magnet characteristics"),
        _permanent("hard-ferrite", 0.385, 4900.0, "Chinese standard grade Y30 (C5), middle of the range of remanence"),
    )
}
"""Every material by its name."""


def material(name: str) -> Material:
    """Return a material by its name.

    Raises:
        InputError: There is no such material; the message lists all names.

    Example:
        >>> import warpmag
        >>> warpmag.material("N42").density  # kg/m³
        7500.0
    """
    return _look_up("material", name)


def inducible(owner: str, name: str) -> dict:
    """Return saturation [A/m] and susceptibility of an inducible material, or its curve, as fields of a ``Magnet``.

    ``owner`` is the prim or the argument in the message of an unknown or permanent material.
    """
    entry = _look_up(owner, name, "inducible")
    if entry.curve is not None:
        return {"curve": entry.curve}
    return {"saturation": entry.saturation, "susceptibility": entry.susceptibility}


def inducible_from(material: str | None, curve, numbers: dict) -> dict:
    """Return the fields of an inducible ``Magnet`` from a material, a curve for :func:`measured`, and numbers.

    ``numbers`` holds ``saturation`` [A/m] and ``susceptibility`` where the caller gives them. Two arguments that set
    the same field raise :class:`InputError`.
    """
    values = numbers if curve is None else {**numbers, "curve": measured("curve", curve)}
    has_table = isinstance(values.get("curve"), MagnetizationCurve)
    from_material = {} if material is None else inducible("material", material)
    is_measured = has_table or "curve" in from_material
    fields_set = ("saturation", "susceptibility", "curve") if is_measured else tuple(from_material)
    conflicts = [name for name in values if name in fields_set and (material is not None or name != "curve")]
    if conflicts and (material is not None or has_table):
        owner = f"material: {short_repr(material)}" if material is not None else "curve: a measured curve"
        raise InputError(f"{owner} sets {' and '.join(conflicts)}, give one or the other")
    return {**values, **from_material}


def measured(owner: str, curve):
    """Return the measured curve of a material for its name; return a token or a measured curve unchanged."""
    names = [entry.name for entry in MATERIALS.values() if entry.curve is not None]
    if isinstance(curve, str) and curve in names:
        return MATERIALS[curve].curve
    check_curve(owner, curve, tuple(names))
    return curve


def name_of_curve(curve: MagnetizationCurve) -> str | None:
    """Return the name of the material with this measured curve, or None."""
    return next((entry.name for entry in MATERIALS.values() if entry.curve == curve), None)


def magnetization_from(magnetization, remanence, material, direction) -> tuple[float, float, float]:
    """Return the magnetization [A/m] of the arguments of :func:`warpmag.add_permanent`; exactly one sets the strength.

    The direction of a material as ``magnetization``, as in version 0.1, causes a DeprecationWarning.
    """
    if material is not None and direction is None and magnetization is not None:
        message = f"material: its direction is an argument of its own now, direction={short_repr(magnetization)}"
        warn_caller(message, DeprecationWarning)
        magnetization, direction = None, magnetization
    strengths = {"magnetization": magnetization, "remanence": remanence, "material": material}
    given = [name for name, value in strengths.items() if value is not None]
    if len(given) != 1:
        got = " and ".join(given) if given else "none"
        raise InputError(f"magnetization, remanence, material: give one of them, got {got}")
    if magnetization is not None:
        if direction is not None:
            raise InputError("direction: goes with remanence or material; magnetization has its own")
        return vector("magnetization", magnetization)
    if direction is None:
        raise InputError(f"direction: {given[0]} needs the direction of the magnetization")
    direction = vector("direction", direction)
    if material is not None:
        return permanent("material", material, direction)
    check_positive("remanence", remanence)
    length = math.hypot(*direction)
    if not length > 0.0:
        raise InputError("direction: must not be zero")
    strength = real_number("remanence", remanence) / MU0
    x, y, z = (strength / length * component for component in direction)
    return x, y, z


def permanent(owner: str, name: str, direction: tuple[float, float, float]) -> tuple[float, float, float]:
    """Return the magnetization [A/m] of a permanent material along a direction of any length.

    ``owner`` is the prim or the argument in the message of an unknown or inducible material, or of a zero direction.
    """
    entry = _look_up(owner, name, "permanent")
    length = math.hypot(*direction)
    if not (length > 0.0 and math.isfinite(length)):
        raise InputError(f"{owner}: {name} needs the direction of its magnetization, got zero")
    x, y, z = (entry.magnetization * component / length for component in direction)
    return x, y, z


def _look_up(owner: str, name: str, kind: str | None = None) -> Material:
    """Return a material by its name; raise :class:`InputError` for an unknown name, or for another kind."""
    names = [entry.name for entry in MATERIALS.values() if kind in (None, entry.kind)]
    if not isinstance(name, str) or name not in names:
        expected = f"{kind} material" if kind else "material"
        raise InputError(f"{owner}: {short_repr(name)} is no {expected}; known are {', '.join(names)}")
    return MATERIALS[name]
