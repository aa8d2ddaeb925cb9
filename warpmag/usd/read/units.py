"""Converts stages in other units than meters and kilograms to SI units, in a layer over the unchanged scene.

Newton's importer converts no units. Every value with a length or a mass in its unit is therefore written in SI units to
a layer of the session: defaults, time samples, and fallback values of shapes. A sphere without an authored radius, for
example, has a radius of one unit. Angles are always in degrees and times in seconds. Lengths of warpmag's attributes
are in the unit of the stage, like those of shapes. Magnetizations, fields, currents and moments are always SI, because
USD has no unit of current and data sheets use A/m.
"""

import math
import re
from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np
from pxr import Gf, Sdf, Tf, Usd, UsdGeom, UsdPhysics, Vt

from warpmag.declarations.schemas import SCHEMAS
from warpmag.errors import InputError
from warpmag.usd.read.session import UNITS, add_layer, release_instances

_LENGTH, _NO_UNIT = (1, 0), (0, 0)
_FORCE, _TORQUE = (1, 1), (2, 1)
_STIFFNESS = (0, 1)
"""Exponents of length and mass in a unit. Damping has the exponents of stiffness."""

_SIZES = (
    *("radius", "radiusTop", "radiusBottom", "size", "height", "width", "length"),
    *("clippingRange", "focusDistance", "focalLength"),
    *("horizontalAperture", "verticalAperture", "horizontalApertureOffset", "verticalApertureOffset"),
)
"""Lengths whose fallback values are in the unit of the stage."""
_EXPONENTS = {
    **dict.fromkeys(_SIZES, _LENGTH),
    **dict.fromkeys(("points", "extent", "extentsHint", "widths", "primvars:widths"), _LENGTH),
    **dict.fromkeys(("positions", "velocities", "accelerations"), _LENGTH),
    **dict.fromkeys((f"physics:{name}" for name in ("velocity", "centerOfMass", "gravityMagnitude")), _LENGTH),
    **dict.fromkeys((f"physics:{name}" for name in ("localPos0", "localPos1", "minDistance", "maxDistance")), _LENGTH),
    **dict.fromkeys(("physics:mass", "physics:masses"), (0, 1)),
    "physics:density": (-3, 1),
    "physics:diagonalInertia": (2, 1),
    "physics:breakForce": _FORCE,
    "physics:breakTorque": _TORQUE,
    **dict.fromkeys(("newton:contactMargin", "newton:contactGap", "newton:contactAdhesion"), _LENGTH),
    **dict.fromkeys(("newton:torsionalFriction", "newton:rollingFriction", "newton:shellThickness"), _LENGTH),
    **dict.fromkeys(("newton:sdfTargetVoxelSize", "newton:sdfPadding"), _LENGTH),
    **dict.fromkeys(("newton:sdfNarrowBandInner", "newton:sdfNarrowBandOuter"), _LENGTH),
    **dict.fromkeys(("newton:contactStiffness", "newton:contactDamping", "newton:contactFrictionGain"), _STIFFNESS),
    "newton:hydroelasticStiffness": (-2, 1),
    "newton:inertia": (2, 1),
    "newton:xpbd:jointLinearCompliance": (0, -1),
    "newton:xpbd:jointAngularCompliance": (-2, -1),
    **dict.fromkeys(("newton:vbd:rigid:jointLinearStiffness", "newton:vbd:rigid:jointLinearDamping"), _STIFFNESS),
    **dict.fromkeys(("newton:vbd:rigid:jointAngularStiffness", "newton:vbd:rigid:jointAngularDamping"), _TORQUE),
    **{row.usd_name: _LENGTH for schema in SCHEMAS for row in schema.attributes if row.unit == "distance"},
}
_JOINT_EXPONENTS = {
    **dict.fromkeys(("physics:lowerLimit", "physics:upperLimit"), (_LENGTH, _NO_UNIT)),
    **dict.fromkeys(("newton:velocityLimit", "newton:mimicCoef0"), (_LENGTH, _NO_UNIT)),
    "newton:armature": ((0, 1), (2, 1)),
    "newton:friction": (_FORCE, _TORQUE),
    **dict.fromkeys(("newton:damping", "newton:limitStiffness", "newton:limitDamping"), (_STIFFNESS, _TORQUE)),
}
"""Attributes with different units for sliding and for turning joints."""
_DRIVE_EXPONENTS = {
    **dict.fromkeys(("targetPosition", "targetVelocity"), (_LENGTH, _NO_UNIT)),
    **dict.fromkeys(("stiffness", "damping"), (_STIFFNESS, _TORQUE)),
    "maxForce": (_FORCE, _TORQUE),
}
_SLIDING = (UsdPhysics.PrismaticJoint, UsdPhysics.DistanceJoint)
_TURNING = (UsdPhysics.RevoluteJoint, UsdPhysics.SphericalJoint)
_PER_AXIS = re.compile(r"(drive|limit):(\w+):physics:(\w+)$")
_UNIT = re.compile(r"Units:.*\b(distance|mass|force|torque|effort)\b")
"""Pattern in the documentation of attributes whose unit must be converted."""
_PRECISE = {Sdf.ValueTypeNames.Half: Sdf.ValueTypeNames.Double, Sdf.ValueTypeNames.Half3: Sdf.ValueTypeNames.Double3}
"""Types too imprecise for converted values, and their replacements."""
_ARRAYS = (Vt.Vec3fArray, Vt.Vec3dArray, Vt.FloatArray, Vt.DoubleArray)
_VECTORS = (Gf.Vec2f, Gf.Vec2d, Gf.Vec3f, Gf.Vec3d)


@dataclass(frozen=True)
class Units:
    """Units of a stage."""

    meters: float  # unit of length [m]
    kilograms: float  # unit of mass [kg]

    @property
    def are_si(self) -> bool:
        """True for SI units."""
        return math.isclose(self.meters, 1.0) and math.isclose(self.kilograms, 1.0)

    @property
    def are_valid(self) -> bool:
        """True for units that can be converted."""
        return all(1e-50 < unit < 1e50 for unit in (self.meters, self.kilograms))


def units_of(stage: Usd.Stage) -> Units:
    """Return the units of a stage's file, before any conversion."""
    root = stage.GetRootLayer().pseudoRoot
    defaults = {"metersPerUnit": UsdGeom.LinearUnits.centimeters, "kilogramsPerUnit": UsdPhysics.MassUnits.kilograms}
    return Units(*(float(root.GetInfo(name) if root.HasInfo(name) else unit) for name, unit in defaults.items()))


def convert_units(stage: Usd.Stage) -> None:
    """Convert a stage to SI units, in a layer of its session. Stages with SI units or invalid units stay unchanged.

    Instances become editable, as each needs its own converted values.
    """
    units = units_of(stage)
    if units.are_si or not units.are_valid:
        return
    layer = add_layer(stage, UNITS)
    release_instances(stage, layer, stage.GetPseudoRoot().GetPath())
    # read everything before writing: referenced values would be converted twice
    everywhere = Usd.PrimRange(stage.GetPseudoRoot(), Usd.PrimAllPrimsPredicate)
    converted = [values for prim in everywhere for values in _converted(prim, units)]
    with Sdf.ChangeBlock():
        for attribute, default, samples in converted:
            _write(layer, attribute, default, samples)
    session = stage.GetSessionLayer().pseudoRoot
    session.SetInfo("metersPerUnit", 1.0)
    session.SetInfo("kilogramsPerUnit", 1.0)


def _converted(prim: Usd.Prim, units: Units) -> Iterator[tuple[Usd.Attribute, object, list[tuple[float, object]]]]:
    """Yield the attributes of a prim in other units than SI, with their converted defaults and time samples."""
    for name in prim.GetPropertyNames():
        attribute = prim.GetAttribute(name)
        if not attribute or not (attribute.HasAuthoredValue() or name in _SIZES):
            continue
        length, mass = _exponents(prim, name)
        scale = units.meters**length * units.kilograms**mass
        if scale != 1.0:
            default, samples = _values(attribute)
            yield attribute, _scaled(default, scale), [(time, _scaled(value, scale)) for time, value in samples]


def _exponents(prim: Usd.Prim, name: str) -> tuple[int, int]:
    """Return the exponents of length and mass in the unit of an attribute."""
    if name.startswith(("xformOp:translate", "xformOp:transform")):
        return _LENGTH
    if name in _EXPONENTS:
        return _EXPONENTS[name]
    if per_axis := _PER_AXIS.match(name):
        return _exponents_per_axis(prim, *per_axis.groups())
    if name in _JOINT_EXPONENTS:
        slides, turns = (any(prim.IsA(kind) for kind in kinds) for kinds in (_SLIDING, _TURNING))
        if slides or turns:
            return _JOINT_EXPONENTS[name][0 if slides else 1]
    if name.startswith("mjc:") or (
        name.startswith("newton:") and _UNIT.search(prim.GetAttribute(name).GetDocumentation().replace("\n", " "))
    ):
        raise InputError(f"{prim.GetPath()}: {name} is not converted: set metersPerUnit and kilogramsPerUnit to 1")
    return _NO_UNIT


def _exponents_per_axis(prim, kind: str, axis: str, name: str) -> tuple[int, int]:
    slides = axis in ("linear", "distance") or axis.startswith("trans")
    if kind == "limit":
        return _LENGTH if slides and name in ("low", "high") else _NO_UNIT
    length, mass = _DRIVE_EXPONENTS.get(name, (_NO_UNIT, _NO_UNIT))[0 if slides else 1]
    if name in ("stiffness", "damping") and prim.GetAttribute(f"drive:{axis}:physics:type").Get() == "acceleration":
        return _NO_UNIT  # an acceleration, independent of mass
    return length, mass


def _values(attribute: Usd.Attribute) -> tuple[object, list[tuple[float, object]]]:
    """Return default and time samples, or none where USD cannot read them; the survey reports this later."""
    if attribute.HasSpline():
        where = f"{attribute.GetPrim().GetPath()}: {attribute.GetName()}"
        raise InputError(f"{where} is a spline, which is not converted from other units: bake it into time samples")
    try:
        samples = [(time, attribute.Get(time)) for time in attribute.GetTimeSamples()]
        return attribute.Get(), samples
    except Tf.ErrorException:
        return None, []


def _write(layer: Sdf.Layer, attribute: Usd.Attribute, default, samples: list[tuple[float, object]]) -> None:
    """Write converted values of an attribute."""
    path, kind = attribute.GetPath(), attribute.GetTypeName()
    if (default is None and not samples) or not kind:
        return
    kind = _PRECISE.get(kind, kind)
    if not Sdf.JustCreatePrimAttributeInLayer(layer, path, kind, attribute.GetVariability(), False):
        return
    if default is not None:
        layer.GetAttributeAtPath(path).default = default
    for time, value in samples:
        layer.SetTimeSample(path, time, Sdf.ValueBlock() if value is None else value)


def _scaled(value, scale: float):
    """Return a value times a factor; in a matrix only the translation is scaled. None for types without unit."""
    if isinstance(value, float):
        return value * scale
    if isinstance(value, Gf.Matrix4d):
        return Gf.Matrix4d(value).SetTranslateOnly(value.ExtractTranslation() * scale)
    if isinstance(value, Gf.Vec3h):
        return Gf.Vec3d(value) * scale
    if isinstance(value, _VECTORS):
        return value * scale
    if isinstance(value, _ARRAYS):
        numbers = np.asarray(value)
        with np.errstate(over="ignore", invalid="ignore"):  # the survey reports values that are not finite
            return type(value).FromNumpy(np.ascontiguousarray(scale * numbers, dtype=numbers.dtype))
    return None
