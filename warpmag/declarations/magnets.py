"""Records of magnets and of the settings of a scene, with their rows of the table of attributes.

Stages, the command line and scripts check values through these records.
"""

import math
from collections.abc import Iterable
from dataclasses import dataclass, field, replace
from functools import partial
from typing import Annotated, Any

from warpmag.declarations.attributes import Attribute, attributes_of, check_fields, make_plain
from warpmag.declarations.checks import (
    check_not_negative,
    check_positive,
    check_token,
    check_vector,
    real_number,
    vector,
)
from warpmag.declarations.curves import MagnetizationCurve
from warpmag.declarations.measured import MEASURED_CURVES
from warpmag.errors import InputError

KINDS = ("inducible", "permanent")
LINEAR_CURVE = "linear"
"""Curve of permanent magnets with recoil. Stages have no such token, because every inducible magnet saturates."""
CURVES = ("tanh", "langevin", "clamped", "frohlich", "tanh-applied")
"""Formulas of magnetization curves (``kernels.material.curves``); a model stores the position in this list.

A formula is a function of the field of all other sources for a ball, and of the field inside the material for a cell.
``tanh-applied``, which the scene Alphabets uses, is ``tanh`` in the field of all others for cells, too.
"""
FORCES = ("kelvin", "zeeman")
CONTACT_MODELS = ("dipole", "multipole")
METHODS = ("auto", "direct", "fmm")
"""Summation methods: the faster of the other two, sums over all pairs, and the fast multipole method."""
DYNAMICS = ("theta", "theta-euler", "llg", "llg-damping")

ACCURACY = {"float32": 2e-6, "float64": 1e-13}
"""Smallest valid relative tolerance by precision. It exceeds the L2 error of fields by sums over all pairs in tests."""

MATERIAL_RANGE = {"float32": (1e-12, 1e15), "float64": (1e-100, 1e100)}
"""Smallest and largest saturation [A/m] and finite susceptibility, by the precision of a solve."""
_MATERIAL_TEXT = f"[{MATERIAL_RANGE['float32'][0]:g}, {MATERIAL_RANGE['float32'][1]:g}]"

MAGNET_SIZES = (1e-8, 2e4)
"""Smallest and largest radius or half side [m] of a magnetic shape: its moment and the moment's square stay in float32.
"""
_RECOIL_RANGE = (1.001, 10.0)
"""Smallest recoil permeability above 1 that float32 resolves, and an upper limit: AlNiCo reaches 5."""

SATURATION_OF_IRON = 1.7e6
"""Default saturation magnetization [A/m]."""


def check_curve(name: str, value: Any, materials: tuple[str, ...] = ()) -> None:
    """Raise :class:`InputError` unless ``value`` is a measured curve or in ``CURVES``, listed with ``materials``."""
    if not isinstance(value, MagnetizationCurve) and not (isinstance(value, str) and value in CURVES):
        check_token(name, value, (*CURVES, *materials))


def check_material(name: str, value: Any, *, infinite: bool = False) -> None:
    """Raise :class:`InputError` unless ``value`` is a saturation or susceptibility that single precision resolves."""
    check_positive(name, value, infinite=infinite)
    least, most = MATERIAL_RANGE["float32"]
    if not (least <= value <= most or math.isinf(value)):
        raise InputError(f"{name}: must be {least:g} to {most:g}, got {float(value):g}")


def check_sizes(name: str, lengths: Iterable[float]) -> None:
    """Raise :class:`InputError` for a radius or half side of a magnetic shape [m] outside :data:`MAGNET_SIZES`."""
    least, most = MAGNET_SIZES
    for length in lengths:
        if not least <= length <= most:
            raise InputError(f"{name}: sizes must be from {least:g} to {most:g} m, got {length:g}")


def check_magnetization(name: str, value: Any) -> None:
    """Raise :class:`InputError` unless ``value`` is a magnetization with fields that single precision resolves."""
    components = vector(name, value)
    if not max(map(abs, components)) <= (most := MATERIAL_RANGE["float32"][1]):
        raise InputError(f"{name}: components must be at most {most:g}, got {components}")


def check_recoil(name: str, value: Any) -> None:
    """Raise :class:`InputError` unless ``value`` is a recoil permeability: 1, or from 1.001 to 10."""
    number = real_number(name, value)
    if number != 1.0 and not _RECOIL_RANGE[0] <= number <= _RECOIL_RANGE[1]:
        raise InputError(f"{name}: must be 1, or {_RECOIL_RANGE[0]:g} to {_RECOIL_RANGE[1]:g}, got {number:g}")


def check_force(name: str, value: Any, contact_model: str = "dipole") -> None:
    """Raise :class:`InputError` unless ``value`` is a force law compatible with ``contact_model``."""
    check_token(name, value, FORCES)
    if contact_model == "multipole" and value != "kelvin":
        raise InputError(f"{name}: the contact model 'multipole' goes with 'kelvin' only, got {value!r}")


def check_rtol(name: str, value: Any, dtype: str = "float32") -> None:
    """Raise :class:`InputError` unless ``value`` is a finite relative error of at least :data:`ACCURACY`."""
    number = real_number(name, value)
    if not ACCURACY[dtype] <= number < math.inf:
        raise InputError(f"{name}: must be at least {ACCURACY[dtype]:g} in {dtype} and finite, got {number:g}")


@dataclass(frozen=True)
class Magnet:
    """The magnetic material of one rigid body or collider, with the attributes of the schema ``WarpmagMagnetAPI``.

    A measured ``curve`` sets ``saturation`` to its limit and ``susceptibility`` to its largest slope.
    ``magnetization`` is in the frame of the body or collider.
    """

    kind: Annotated[str, Attribute(
        "kind", "token", "Kind",
        "Kind of the magnet: magnetized by the applied field (inducible), or permanently (permanent).",
        tokens=KINDS, uniform=True,
    )] = "inducible"  # fmt: skip
    saturation: Annotated[float, Attribute(
        "saturationMagnetization", "float", "Saturation Magnetization",
        "Saturation magnetization Ms of an inducible magnet.",
        unit="ampere / meter", range=_MATERIAL_TEXT, check=check_material, kind="inducible",
        model_change="notified",
    )] = SATURATION_OF_IRON  # fmt: skip
    susceptibility: Annotated[float, Attribute(
        "susceptibility", "float", "Susceptibility",
        "Magnetic susceptibility of an inducible magnet; infinite for an ideally permeable one.",
        unit="dimensionless", range=f"{_MATERIAL_TEXT}, or inf", check=partial(check_material, infinite=True),
        kind="inducible", model_change="notified",
    )] = math.inf  # fmt: skip
    curve: Annotated[str | MagnetizationCurve, Attribute(
        "curve", "token", "Magnetization Curve",
        "Magnetization curve of an inducible magnet: a formula, or the measured curve of a material. A measured "
        "curve replaces saturation magnetization and susceptibility. A formula is a function of the field of all "
        "other sources for a ball of one moment, and of the field inside for other shapes. tanh-applied is tanh of the "
        "field of all other sources for every shape.",
        tokens=(*CURVES, *MEASURED_CURVES), check=check_curve, uniform=True, kind="inducible",
    )] = "tanh"  # fmt: skip
    magnetization: Annotated[tuple[float, float, float], Attribute(
        "magnetization", "vector3f", "Magnetization",
        "Magnetization of a permanent magnet in the frame of the prim. With a recoil permeability above 1 it is "
        "the remanent magnetization, at zero internal field.",
        unit="ampere / meter", check=check_magnetization, kind="permanent", model_change="substep",
    )] = (0.0, 0.0, 0.0)  # fmt: skip
    recoil_permeability: Annotated[float, Attribute(
        "recoilPermeability", "float", "Recoil Permeability",
        "Relative permeability mu of a permanent magnet, M = Mr + (mu - 1) H with the internal field H. At 1 no "
        "field changes the magnetization.",
        unit="dimensionless", range=f"1, or [{_RECOIL_RANGE[0]:g}, {_RECOIL_RANGE[1]:g}]", check=check_recoil,
        kind="permanent", optional=True,
    )] = 1.0  # fmt: skip
    moment_spacing: Annotated[float, Attribute(
        "momentSpacing", "float", "Moment Spacing",
        "Distance between the moments that sample the magnet. 0 means one moment for a ball, and an automatic distance "
        "for other bodies.",
        unit="distance", range="[0, inf)", check=check_not_negative,
    )] = 0.0  # fmt: skip
    conductivity: Annotated[float, Attribute(
        "conductivity", "float", "Conductivity",
        "Electrical conductivity of a ball of one moment that is its body's only magnet. Eddy currents brake such "
        "a ball; 0 means no eddy currents.",
        unit="siemens / meter", range="[0, inf)", check=check_not_negative, optional=True,
    )] = 0.0  # fmt: skip

    def __post_init__(self):
        """Make all values plain, and set saturation and susceptibility to those of a measured curve."""
        make_plain(self)
        if isinstance(self.curve, MagnetizationCurve):
            object.__setattr__(self, "saturation", self.curve.saturation)
            object.__setattr__(self, "susceptibility", self.curve.susceptibility)

    @property
    def recoils(self) -> bool:
        """True for a permanent magnet with recoil: the field changes its magnetization."""
        return self.kind == "permanent" and self.recoil_permeability > 1.0

    @property
    def fixed(self) -> bool:
        """True for a permanent magnet without recoil: no field changes its magnetization."""
        return self.kind == "permanent" and not self.recoils

    def check(self, name: str, *, unused: bool = False) -> None:
        """Raise :class:`InputError` if a value is out of range.

        Args:
            name: Prim path or label of the body, for the message.
            unused: True to check the attributes of the other kind of magnets, too.
        """
        for row in attributes_of(Magnet):
            if unused or row.kind in ("", self.kind):
                row.check_value(name, getattr(self, row.field))


@dataclass(frozen=True)
class MagneticSettings:
    """Settings of a scene's magnetic solve, with the attributes of the schema ``WarpmagSceneAPI``."""

    external_field: Annotated[tuple[float, float, float], Attribute(
        "externalField", "vector3f", "External Field", "Uniform applied field H0 in the world frame.",
        unit="ampere / meter", check=check_vector,
    )] = (0.0, 0.0, 0.0)  # fmt: skip
    force: Annotated[str, Attribute(
        "force", "token", "Force Law",
        "Force law of the field on a moment: kelvin (Eqs. 13 and 14 of Kim and Han 2022) or zeeman (Eq. 4).",
        tokens=FORCES, uniform=True,
    )] = "kelvin"  # fmt: skip
    dynamics: Annotated[str, Attribute(
        "dynamics", "token", "Magnetization Dynamics",
        "Iteration toward the equilibrium of the moments: the exact flow, accelerated (theta), its explicit Euler "
        "step (theta-euler), or LLG (Eq. 6) with and without precession (llg, llg-damping).",
        tokens=DYNAMICS, uniform=True,
    )] = "theta"  # fmt: skip
    contact_model: Annotated[str, Attribute(
        "contactModel", "token", "Contact Model",
        "Interaction of balls that nearly touch. dipole: with the dipoles alone two balls in line with the field "
        "attract too weakly, by up to 34 % at a gap of 0.3 radii and 93 % at 0.01. multipole: also the higher "
        "multipoles of the exact solution of two balls; requires the force law kelvin.",
        tokens=CONTACT_MODELS, uniform=True,
    )] = "dipole"  # fmt: skip
    rtol: Annotated[float, Attribute(
        "rtol", "float", "Relative Tolerance",
        "Relative error of the magnetization at which the induction of a step ends.",
        unit="dimensionless", range=f"[{ACCURACY['float32']:g}, inf)", check=check_rtol,
    )] = 1e-3  # fmt: skip

    def __post_init__(self):
        """Make numbers of Warp and arrays of other libraries plain."""
        make_plain(self)

    def check(self, name: str) -> None:
        """Raise :class:`InputError` naming ``name`` if a value is out of range, or values are incompatible."""
        check_fields(self, name, "external_field", "contact_model")
        check_force(f"{name}: force", self.force, self.contact_model)
        check_fields(self, name, "dynamics", "rtol")

    def replaced(self, **values) -> "MagneticSettings":
        """Return the settings with new ``values``, unchecked; a value of None keeps the present one."""
        return replace(self, **{name: value for name, value in values.items() if value is not None})


@dataclass(frozen=True)
class StageMagnets:
    """Magnets and settings of a stage, by prim path.

    Attributes:
        magnets: Magnet of each magnetic prim, a rigid body or a collider.
        settings: Magnetic settings of the scene.
        initial_moments: Total moment [A·m²], world frame, of prims with ``warpmag:moment``, for a warm start.
    """

    magnets: dict[str, Magnet]
    settings: MagneticSettings
    initial_moments: dict[str, tuple[float, float, float]] = field(default_factory=dict)


@dataclass(frozen=True)
class Preset:
    """Dynamics, magnetization curve and force law of a published method."""

    dynamics: str
    curve: str
    force: str


PRESETS = {
    "warpmag": Preset(dynamics="theta", curve="tanh", force="kelvin"),
    "paper": Preset(dynamics="theta-euler", curve="tanh-applied", force="zeeman"),
    "kim2018": Preset(dynamics="llg", curve="clamped", force="kelvin"),
}
"""Published methods: this library's; Kim and Han 2022 as published; Kim, Park and Han 2018."""
