"""What a magnet is made of and how a scene is to be solved: plain data, shared by the USD part and the Newton part.

Neither Warp, Newton nor USD is imported here. Each record checks itself, so that a bad value is refused in the same
words whether it comes from a stage, from the command line or from a script.
"""

import math
from dataclasses import dataclass, field, replace

from warpmag.declarations.checks import check_not_negative, check_positive, check_token, check_vector, real_number
from warpmag.declarations.curves import MagnetizationCurve
from warpmag.errors import InputError

KINDS = ("inducible", "permanent")
LINEAR_CURVE = "linear"
"""Curve of permanent magnets that respond; no token, since nothing inducible is without saturation."""
CURVES = ("tanh", "langevin", "clamped", "frohlich")
"""Magnetization curves, see ``kernels.material.curves``; a model has the place in this list."""
FORCES = ("kelvin", "zeeman")
CONTACT_MODELS = ("dipole", "multipole")
METHODS = ("auto", "direct", "fmm")
"""Summation methods: the faster one, over all pairs, by the fast multipole method."""
DYNAMICS = ("theta", "theta-euler", "llg", "llg-damping")

ACCURACY = {"float32": 2e-6, "float64": 1e-13}
"""Relative L2 error of all-pairs sums in each precision that tests hold them to: no tolerance below it is met."""

MATERIAL_RANGE = {"float32": (1e-12, 1e15), "float64": (1e-100, 1e100)}
"""Least and largest saturation [A/m] and finite susceptibility, by the precision of a solve."""

_RECOIL = (1.001, 10.0)
"""Least recoil permeability above 1 that single precision resolves, and more than any magnet's: AlNiCo has up to 5."""

SATURATION_OF_IRON = 1.7e6
"""Default saturation magnetization [A/m]."""


def check_curve(name: str, value, others: tuple[str, ...] = ()) -> None:
    """Raise :class:`InputError` unless ``value`` is a magnetization curve, one of :data:`CURVES` or a measured one.

    The message names ``others``, too.
    """
    if not isinstance(value, MagnetizationCurve) and not (isinstance(value, str) and value in CURVES):
        check_token(name, value, (*CURVES, *others))


def check_material(name: str, value: float, *, infinite: bool = False) -> None:
    """Raise :class:`InputError` unless ``value`` is a saturation or a susceptibility that single precision resolves."""
    check_positive(name, value, infinite=infinite)
    least, most = MATERIAL_RANGE["float32"]
    if not (least <= value <= most or math.isinf(value)):
        raise InputError(f"{name}: must be {least:g} to {most:g}, got {float(value):g}")


def check_recoil(name: str, value: float) -> None:
    """Raise :class:`InputError` unless ``value`` is a recoil permeability: 1, or from 1.001 to 10."""
    number = real_number(name, value)
    if number != 1.0 and not _RECOIL[0] <= number <= _RECOIL[1]:
        raise InputError(f"{name}: must be 1, or {_RECOIL[0]:g} to {_RECOIL[1]:g}, got {number:g}")


def check_force(name: str, value: str, contact_model: str = "dipole") -> None:
    """Raise :class:`InputError` unless ``value`` is a force law that goes with ``contact_model``."""
    check_token(name, value, FORCES)
    if contact_model == "multipole" and value != "kelvin":
        raise InputError(f"{name}: the contact model 'multipole' goes with 'kelvin' only, got {value!r}")


def check_rtol(name: str, value: float, dtype: str = "float32") -> None:
    """Raise :class:`InputError` unless ``value`` is a relative error that sums in ``dtype`` can reach."""
    number = real_number(name, value)
    if not ACCURACY[dtype] <= number < math.inf:
        raise InputError(f"{name}: must be at least {ACCURACY[dtype]:g} in {dtype} and finite, got {number:g}")


@dataclass(frozen=True)
class Magnet:
    """The magnetic material of one rigid body or collider.

    Attributes:
        kind: ``inducible`` (magnetized by the field it is in) or ``permanent``.
        saturation: Saturation magnetization Ms [A/m], inducible only.
        susceptibility: Susceptibility χ [dimensionless], may be infinite, inducible only.
        curve: Magnetization curve, one of :data:`CURVES` or a measured one, which then says what saturation and
            susceptibility (its largest) are; inducible only.
        magnetization: Magnetization of a permanent magnet [A/m], in its own frame; with a recoil permeability above 1
            the remanent one, of no field inside.
        recoil_permeability: μ of a permanent magnet [dimensionless], M = M_r + (μ − 1) H with the field H inside.
        moment_spacing: Distance between sampled moments [m]; 0 means one moment for a ball, automatic otherwise.
        conductivity: Electrical conductivity [S/m] of a ball of one moment, whose eddy currents brake it; 0 means none.
    """

    kind: str = "inducible"
    saturation: float = SATURATION_OF_IRON
    susceptibility: float = math.inf
    curve: str | MagnetizationCurve = "tanh"
    magnetization: tuple[float, float, float] = (0.0, 0.0, 0.0)
    recoil_permeability: float = 1.0
    moment_spacing: float = 0.0
    conductivity: float = 0.0

    def __post_init__(self):
        """Take what a measured curve says."""
        if isinstance(self.curve, MagnetizationCurve):
            object.__setattr__(self, "saturation", self.curve.saturation)
            object.__setattr__(self, "susceptibility", self.curve.susceptibility)

    @property
    def recoils(self) -> bool:
        """Whether it is permanent and the field changes its magnetization."""
        return self.kind == "permanent" and self.recoil_permeability > 1.0

    @property
    def fixed(self) -> bool:
        """Whether no field changes its magnetization."""
        return self.kind == "permanent" and not self.recoils

    def check(self, name: str) -> None:
        """Raise :class:`InputError` naming ``name`` (a prim path or body label) if a value is out of range."""
        check_token(f"{name}: kind", self.kind, KINDS)
        if self.kind == "inducible":
            check_material(f"{name}: saturation magnetization", self.saturation)
            check_material(f"{name}: susceptibility", self.susceptibility, infinite=True)
            check_curve(f"{name}: curve", self.curve)
        else:
            check_vector(f"{name}: magnetization", self.magnetization)
            check_recoil(f"{name}: recoil permeability", self.recoil_permeability)
        check_not_negative(f"{name}: moment spacing", self.moment_spacing)
        check_not_negative(f"{name}: conductivity", self.conductivity)


@dataclass(frozen=True)
class MagneticSettings:
    """How the magnetics of a whole scene is solved.

    Attributes:
        external_field: Uniform applied field H0 [A/m], world frame.
        force: ``kelvin`` (Eqs. 13, 14) or ``zeeman`` (Eq. 4).
        dynamics: ``theta`` (exact flow, accelerated), ``theta-euler`` (the paper's explicit step), ``llg`` or
            ``llg-damping`` (Eq. 6, with and without precession).
        contact_model: ``dipole``, or ``multipole``, which adds what balls lack where they nearly touch (Kelvin only).
        rtol: Relative magnetization error at which a step's induction ends, the computable form of Eq. 12.
    """

    external_field: tuple[float, float, float] = (0.0, 0.0, 0.0)
    force: str = "kelvin"
    dynamics: str = "theta"
    contact_model: str = "dipole"
    rtol: float = 1e-3

    def check(self, name: str) -> None:
        """Raise :class:`InputError` naming ``name`` if a value is out of range."""
        check_vector(f"{name}: external field", self.external_field)
        check_token(f"{name}: contact model", self.contact_model, CONTACT_MODELS)
        check_force(f"{name}: force", self.force, self.contact_model)
        check_token(f"{name}: dynamics", self.dynamics, DYNAMICS)
        check_rtol(f"{name}: rtol", self.rtol)

    def replaced(self, **given) -> "MagneticSettings":
        """Return settings with those of ``given`` that are not None, unchecked, in the place of these."""
        return replace(self, **{name: value for name, value in given.items() if value is not None})


@dataclass(frozen=True)
class StageMagnets:
    """All that a stage says about magnets, keyed by prim path.

    Attributes:
        magnets: Magnet of each prim that carries one; the prim is a rigid body or a collider.
        settings: The scene's magnetic settings.
        initial_moments: Total moment [A·m²], world frame, of prims that carry ``warpmag:moment``, for a warm start.
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
    "paper": Preset(dynamics="theta-euler", curve="tanh", force="zeeman"),
    "kim2018": Preset(dynamics="llg", curve="clamped", force="kelvin"),
}
"""Published methods: this library's; Kim and Han 2022 as published; Kim, Park and Han 2018."""
