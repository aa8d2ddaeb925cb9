"""Magnetic materials by name.

Values are typical ones at room temperature; a data sheet of the very part is better. The susceptibility is the initial
one, of small fields: that of a ball hardly matters above 100, for its own demagnetizing field limits it to 3.
"""

import math
from dataclasses import dataclass

from warpmag.errors import InputError
from warpmag.magnets import shown
from warpmag.oracle import MU0

_BOZORTH = "R. M. Bozorth, Ferromagnetism, 1951, table of magnetic materials: permeability at 2 mT, saturation"
_NDFEB = "GB/T 13560-2017, sintered NdFeB, middle of the range of remanence"


@dataclass(frozen=True)
class Material:
    """A magnetic material.

    Attributes:
        name: Its name.
        kind: ``inducible`` or ``permanent``.
        polarization: Saturation polarization μ0·Ms of an inducible, remanence Br of a permanent material [T].
        permeability: Initial relative permeability of an inducible material [dimensionless].
        source: Where the numbers are from.
    """

    name: str
    kind: str
    polarization: float
    permeability: float
    source: str

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


def _inducible(name, saturation, permeability, source):
    return Material(name, "inducible", saturation, permeability, source)


def _permanent(name, remanence, source):
    return Material(name, "permanent", remanence, math.nan, source)


MATERIALS = {
    one.name: one
    for one in (
        _inducible("iron", 2.15, 200.0, f"{_BOZORTH}; 99.91 % Fe"),
        _inducible("mild-steel", 2.10, 180.0, f"{_BOZORTH}; cold-rolled steel, 98.5 % Fe"),
        _inducible("silicon-steel", 1.97, 500.0, f"{_BOZORTH}; 4 % Si"),
        _inducible("permalloy", 1.07, 8000.0, f"{_BOZORTH}; 78.5 % Ni"),
        _inducible("mumetal", 0.65, 20000.0, f"{_BOZORTH}; 77 % Ni, 5 % Cu, 2 % Cr"),
        _inducible("soft-ferrite", 0.47, 2300.0, "Ferroxcube, Soft Ferrites, 2013; 3C90 (MnZn) at 25 °C"),
        _permanent("N35", 1.195, _NDFEB),
        _permanent("N42", 1.30, _NDFEB),
        _permanent("N52", 1.45, _NDFEB),
        _permanent("SmCo", 1.05, "Magna Tokyo, magnet characteristics: Sm2Co17"),
        _permanent("AlNiCo5", 1.27, "Magna Tokyo, magnet characteristics"),
        _permanent("AlNiCo8", 0.88, "Magna Tokyo, magnet characteristics"),
        _permanent("hard-ferrite", 0.385, "Chinese standard grade Y30 (C5), middle of the range of remanence"),
    )
}
"""Every material by its name."""


def material(name: str) -> Material:
    """Return a material by its name.

    Raises:
        InputError: There is no such material; the message names all.
    """
    return _look_up("material", name)


def inducible(owner: str, name: str) -> dict[str, float]:
    """Return saturation [A/m] and susceptibility of an inducible material, as arguments of a magnet.

    Args:
        owner: Who asks, for the message.
        name: The material.

    Raises:
        InputError: There is no such material, or it is a permanent one.
    """
    found = _look_up(owner, name, "inducible")
    return {"saturation": found.saturation, "susceptibility": found.susceptibility}


def permanent(owner: str, name: str, direction: tuple[float, float, float]) -> tuple[float, float, float]:
    """Return the magnetization [A/m] of a permanent material along a direction of any length.

    Args:
        owner: Who asks, for the message.
        name: The material.
        direction: Where it is magnetized to.

    Raises:
        InputError: There is no such material, it is an inducible one, or the direction has no length.
    """
    found = _look_up(owner, name, "permanent")
    length = math.hypot(*direction)
    if not (length > 0.0 and math.isfinite(length)):
        raise InputError(f"{owner}: magnetization: must have a direction for {name} to be magnetized in")
    x, y, z = (found.magnetization * component / length for component in direction)
    return x, y, z


def _look_up(owner: str, name: str, kind: str | None = None) -> Material:
    known = [one.name for one in MATERIALS.values() if kind in (None, one.kind)]
    if not isinstance(name, str) or name not in known:
        which = f"{kind} material" if kind else "material"
        raise InputError(f"{owner}: {shown(name)} is no {which} known here, which are {', '.join(known)}")
    return MATERIALS[name]
