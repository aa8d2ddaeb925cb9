"""Checks values of USD attributes: type of the schema, finite, in range. Each error is one line."""

import contextlib
import math
import numbers
from collections.abc import Iterator
from dataclasses import dataclass
from functools import cache
from typing import Any

import numpy as np
from pxr import Gf, Tf, Usd, UsdUtils, Vt

from warpmag.declarations.checks import short_repr
from warpmag.errors import InputError, one_line

LARGEST = float(np.finfo(np.float32).max)
"""Largest number that Newton can hold, in single precision."""
SMALLEST_SIZE, LARGEST_SIZE = 1e-7, 1e6
"""Range of sizes of shapes [m]: single precision holds their volumes, inertias and moments."""
LARGEST_COORDINATE = 1e8
"""Largest coordinate [m]: single precision holds squares and fourth powers of distances."""
_LIGHTEST, _HEAVIEST = 1e-20, 1e20
_FASTEST = 1e6
_SIZE, _COORDINATE = (SMALLEST_SIZE, LARGEST_SIZE, False), (-LARGEST_COORDINATE, LARGEST_COORDINATE, False)
_COEFFICIENT = (0.0, 1e6, False)
_RANGES = {  # least, largest, and whether 0 means "not given"
    **dict.fromkeys(("radius", "radiusTop", "radiusBottom", "size", "height"), _SIZE),
    **dict.fromkeys(("points", "physics:centerOfMass"), _COORDINATE),
    **dict.fromkeys(("physics:localPos0", "physics:localPos1"), _COORDINATE),
    "physics:mass": (_LIGHTEST, _HEAVIEST, True),
    "physics:density": (1e-6, 1e12, True),
    "physics:diagonalInertia": (1e-36, 1e36, True),
    "physics:velocity": (-_FASTEST, _FASTEST, False),
    "physics:angularVelocity": (-1e8, 1e8, False),
    "physics:gravityMagnitude": (0.0, 1e6, False),
    "physics:gravityDirection": (-1e9, 1e9, False),
    "physics:restitution": (0.0, 1.0, False),
    **dict.fromkeys(("physics:staticFriction", "physics:dynamicFriction"), _COEFFICIENT),
    **dict.fromkeys(("newton:torsionalFriction", "newton:rollingFriction"), _COEFFICIENT),
    **dict.fromkeys(("newton:contactMargin", "newton:contactGap"), (0.0, LARGEST_SIZE, False)),
    **dict.fromkeys(("newton:contactStiffness", "newton:contactDamping"), (0.0, LARGEST, False)),
    **dict.fromkeys(("newton:contactAdhesion", "newton:contactFrictionGain"), (0.0, LARGEST, False)),
    "newton:timeStepsPerSecond": (1, 1_000_000, False),
}
_TOKENS = {**dict.fromkeys(("axis", "physics:axis"), ("X", "Y", "Z")), "orientation": ("rightHanded", "leftHanded")}
_QUATERNIONS = ("physics:principalAxes", "physics:localRot0", "physics:localRot1")
_QUATERNION_TYPES = (Gf.Quatf, Gf.Quatd, Gf.Quath)
_INERTIA_TOLERANCE = 1e-2
"""Largest excess of an often rounded moment of inertia over the other two, as a fraction of the sum of all three."""
_READ_NAMESPACES = ("physics:", "newton:", "mjc:", "drive:", "limit:")
_SHAPES = {
    "Sphere": ("radius",),
    "Cube": ("size",),
    **dict.fromkeys(("Capsule", "Cylinder", "Cone"), ("radius", "height", "axis")),
    **dict.fromkeys(("Capsule_1", "Cylinder_1"), ("radiusTop", "radiusBottom", "height", "axis")),
    "Plane": ("width", "length", "axis"),
    "Mesh": ("points", "faceVertexCounts", "faceVertexIndices", "orientation", "subdivisionScheme", "holeIndices"),
}
_LENGTHS = ("radius", "radiusTop", "radiusBottom", "height", "size", "width", "length")
"""Sizes of shapes, numbers of double precision."""
_VECTORS = (Gf.Vec3f, Gf.Vec3d, Gf.Vec3h, Gf.Vec3i)
_NEED_SCHEMA = (
    *("physics:mass", "physics:density", "physics:centerOfMass", "physics:diagonalInertia", "physics:principalAxes"),
    *("physics:staticFriction", "physics:dynamicFriction", "physics:restitution"),
    *("physics:velocity", "physics:angularVelocity", "physics:kinematicEnabled"),
)
"""Attributes that have no effect unless their schema, one of the first four of ``_SCHEMAS``, is applied."""
_SCHEMAS = (
    *("PhysicsMassAPI", "PhysicsMaterialAPI", "PhysicsRigidBodyAPI", "PhysicsCollisionAPI", "PhysicsMeshCollisionAPI"),
    *("NewtonSceneAPI", "NewtonMaterialAPI", "NewtonMeshCollisionAPI", "NewtonCollisionAPI"),
    "NewtonArticulationRootAPI",
)

_DECLARED = {
    "assignment": ("model", "state", "control", "contact"),
    "frequency": (
        *("once", "joint", "joint_dof", "joint_coord", "joint_constraint", "body", "shape", "articulation", "world"),
        *("particle", "edge", "triangle", "tetrahedron", "spring", "constraint_mimic", "attachment_particle_body"),
        *("tendon", "tendon_guide", "tendon_segment", "curve", "surface", "volume"),
    ),
}
"""Keys and values of the customData by which an attribute of a scene is declared to Newton."""
_SCENE_OPTIONS = ("newton:joint_drive_gains_scaling", "newton:collapse_fixed_joints")
"""Other attributes of a scene that Newton reads, though no schema has them."""


@dataclass(frozen=True)
class Finding:
    """An error or a warning about a stage."""

    where: str  # path of the prim, or the name of the stage
    message: str
    severity: str = "error"  # ``error``: a run does not start; or ``warning``

    def __str__(self) -> str:
        """Return one line that names the prim."""
        return one_line(f"{self.where}: {self.message}")


@contextlib.contextmanager
def quiet() -> Iterator[None]:
    """Keep USD's messages off stderr; USD still raises its errors."""
    silencer = UsdUtils.CoalescingDiagnosticDelegate()
    try:
        yield
    finally:
        del silencer


def check_prim(prim: Any, *, authored: bool = False) -> None:
    """Raise :class:`InputError` unless ``prim`` is a prim of a stage, and one to author if ``authored`` is True."""
    if not (isinstance(prim, Usd.Prim) and prim.IsValid()):
        raise InputError(f"prim: must be a valid Usd.Prim, got {short_repr(prim)}")
    if authored and (prim.IsPseudoRoot() or prim.IsInstanceProxy() or prim.IsInPrototype()):
        raise InputError(f"prim: {prim.GetPath()} is the root of its stage or in an instance, and cannot be authored")


def check_stage(stage: Any) -> None:
    """Raise :class:`InputError` unless ``stage`` is a stage of USD."""
    if not isinstance(stage, Usd.Stage):
        raise InputError(f"stage: must be a Usd.Stage, got {short_repr(stage)}")


def finding_of(where: str, error: InputError) -> Finding:
    """Return the finding of an :class:`InputError` about ``where``."""
    return Finding(where, str(error).removeprefix(f"{where}: "))


def value_of(prim: Usd.Prim, name: str):
    """Return the default value of an attribute, None where it has none.

    A value of another type than the schema's, not finite or out of range raises :class:`InputError`. Infinities are
    valid only where they are the schema's defaults, such as those of limits.
    """
    attribute = prim.GetAttribute(name)
    if not attribute:
        return None
    try:
        value = attribute.Get()
    except Tf.ErrorException:
        raise InputError(f"{prim.GetPath()}: {name} has a value that USD cannot read") from None
    fallback = prim.GetPrimDefinition().GetAttributeFallbackValue(name)
    if fallback is None:
        fallback = _defaults_by_name().get(name)
    if value is None and fallback is not None:
        raise InputError(f"{prim.GetPath()}: {name} is blocked and has no value")
    if value is None or not attribute.HasAuthoredValue():
        return value
    check_type(prim, name, value, declared(attribute) if fallback is None else fallback)
    if name.startswith("physics:") or name in _LENGTHS:
        _check_precision(prim, attribute)
    if name in _TOKENS and value not in _TOKENS[name]:
        raise InputError(f"{prim.GetPath()}: {name} must be one of {', '.join(_TOKENS[name])}, got {_shown(value)}")
    _check_numbers(prim, name, value, fallback)
    if message := _broken_condition(name, value):
        raise InputError(f"{prim.GetPath()}: {name} {message}, got {_shown(value)}")
    return value


def attribute_findings(prim: Usd.Prim, *, shape: bool) -> Iterator[Finding]:
    """Yield errors and warnings about the attributes that Newton's importer reads from a prim, except transforms.

    ``shape`` adds the attributes of the prim's shape.
    """
    names = [name for name in prim.GetAuthoredPropertyNames() if name.startswith(_READ_NAMESPACES)]
    for name in (*names, *(_SHAPES.get(prim.GetTypeName(), ()) if shape else ())):
        attribute = prim.GetAttribute(name)
        if not attribute:
            continue
        try:
            value_of(prim, name)
        except InputError as error:
            yield finding_of(str(prim.GetPath()), error)
        if finding := instance_finding(attribute):
            yield finding
        if name in _NEED_SCHEMA and name not in prim.GetPrimDefinition().GetPropertyNames():
            schemas = " or ".join(schema for schema in _SCHEMAS[:4] if name in _defaults(schema))
            yield Finding(str(prim.GetPath()), f"{name} has no effect: the prim has no {schemas}", "warning")


def declaration_findings(scene: Usd.Prim) -> Iterator[Finding]:
    """Yield findings about ``newton:`` properties of a scene without a schema: Newton reads them as declarations."""
    path = str(scene.GetPath())
    known = {*scene.GetPrimDefinition().GetPropertyNames(), *_newton_attributes(), *_SCENE_OPTIONS}
    for attribute in scene.GetAuthoredPropertiesInNamespace("newton"):
        name = attribute.GetName()
        if name in known:
            continue
        if not isinstance(attribute, Usd.Attribute):
            yield Finding(path, f"{name} is a relationship, but in no schema: Newton reads it as an attribute")
            continue
        declaration = {key: attribute.GetCustomDataByKey(key) for key in _DECLARED}
        for key, value in declaration.items():
            if value and not isinstance(value, str):
                yield Finding(path, f"{name} has the {key} {_shown(value)} in its customData, which must be text")
        if any(str(declaration[key]).lower() not in allowed for key, allowed in _DECLARED.items()):
            message = "no schema has it, and its customData do not declare it with an assignment and a frequency"
            yield Finding(path, f"{name} has no effect: {message}", "warning")


def instance_finding(attribute: Usd.Attribute) -> Finding | None:
    """Return an error if an attribute inside an instance has time samples, which cannot be frozen there, or None."""
    prim = attribute.GetPrim()
    if not (prim.IsInstanceProxy() and attribute.GetNumTimeSamples()):
        return None
    default = attribute.Get()
    if all(attribute.Get(time) == default for time in attribute.GetTimeSamples()):
        return None
    while not prim.IsInstance():
        prim = prim.GetParent()
    return Finding(
        str(attribute.GetPrim().GetPath()),
        f"{attribute.GetName()} has time samples inside an instance, where they cannot be frozen: "
        f"set instanceable = false on {prim.GetPath()}",
    )


def number(name: str, value) -> float:
    """Return the shortest decimal that rounds to a number in single precision: 0.001, not 0.0010000000475."""
    if not isinstance(value, numbers.Real) or isinstance(value, bool):
        raise InputError(f"{name}: {_shown(value)} is not a float")
    with np.errstate(over="ignore"):
        return float(str(np.float32(value)))


def vector(name: str, value) -> tuple[float, float, float]:
    """Return the components of a vector, each rounded by :func:`number`."""
    if not isinstance(value, _VECTORS):
        raise InputError(f"{name}: {_shown(value)} is not a vector")
    x, y, z = (number(name, component) for component in value)
    return x, y, z


def text(name: str, value) -> str:
    """Return ``value`` if it is a token or a string."""
    if not isinstance(value, str):
        raise InputError(f"{name}: {_shown(value)} is not a str")
    return value


def flag(name: str, value) -> bool:
    """Return ``value`` if it is a bool."""
    if not isinstance(value, bool):
        raise InputError(f"{name}: must be true or false, got {value!r:.60}")
    return value


def whole_numbers(name: str, value) -> tuple[int, int, int]:
    """Return the components of a vector of whole numbers."""
    if not isinstance(value, Gf.Vec3i):
        raise InputError(f"{name}: must be three whole numbers, got {value!r:.60}")
    x, y, z = value
    return x, y, z


def vector_array(name: str, value) -> np.ndarray:
    """Return vectors, shape [k, 3]."""
    if not isinstance(value, (Vt.Vec3fArray, Vt.Vec3dArray, Vt.Vec3hArray)):
        raise InputError(f"{name}: must be an array of vectors, got {type(value).__name__}")
    return np.array(value, dtype=float).reshape(-1, 3)


def point_array(name: str, value) -> tuple[tuple[float, float, float], ...]:
    """Return points as a tuple."""
    return tuple((x, y, z) for x, y, z in vector_array(name, value).tolist())


def check_type(prim: Usd.Prim, name: str, value, example) -> None:
    """Raise :class:`InputError` unless ``value`` has the type of ``example``; None allows every type."""
    if example is not None and type(value) is not type(example):
        raise InputError(f"{prim.GetPath()}: {name} must be {_kind(example)}, got {_shown(value)}")


def declared(attribute: Usd.Attribute):
    """Return the default value of an attribute's declared type, None where the type is unknown."""
    return attribute.GetTypeName().defaultValue if attribute.GetTypeName() else None


@cache
def _defaults_by_name() -> dict[str, object]:
    """Return the defaults of attributes that Newton reads by name, whether or not their schema is applied."""
    return {name: value for schema in _SCHEMAS for name, value in _defaults(schema).items()}


@cache
def _newton_attributes() -> frozenset[str]:
    """Return the attributes of all of Newton's API schemas; Newton reads some where the schema is not applied."""
    types = Tf.Type.FindByName("UsdAPISchemaBase").GetAllDerivedTypes()
    names = [str(Usd.SchemaRegistry.GetSchemaTypeName(schema)) for schema in types]
    return frozenset(attribute for name in names if name.startswith("Newton") for attribute in _defaults(name))


@cache
def _defaults(schema: str) -> dict[str, object]:
    """Return the defaults of an API schema, by attribute."""
    definition = Usd.SchemaRegistry().FindAppliedAPIPrimDefinition(schema)
    names = definition.GetPropertyNames() if definition else ()
    return {name: definition.GetAttributeFallbackValue(name) for name in names}


def _check_precision(prim: Usd.Prim, attribute: Usd.Attribute) -> None:
    """Raise :class:`InputError` if a number has another type than the schema's, such as double for float.

    USD's physics parser reads such a friction, restitution, density, gravity or radius as 0 or as the default. Types
    of other roles, such as float3 for point3f, are read.
    """
    usual = attribute.GetTypeName()  # the schema's, where it is applied
    for spec in attribute.GetPropertyStack():
        if spec.HasInfo("default") and spec.typeName.type != usual.type:
            raise InputError(f"{prim.GetPath()}: {attribute.GetName()} must be of type {usual}, not {spec.typeName}")


def _check_numbers(prim, name, value, fallback) -> None:
    """Raise :class:`InputError` unless the numbers of a value are finite and in range, or the infinite default."""
    given = _numbers(value)
    if given is None or not given.size:
        return
    default = None if fallback is None else _numbers(fallback)
    if default is not None and np.isinf(default).all() and np.array_equal(given, default):
        return
    where = f"{prim.GetPath()}: {name}"
    lowest, highest, zero = _RANGES.get(name, (-LARGEST, LARGEST, True))
    if lowest > 0.0 and not (np.isfinite(given) & ((given > 0.0) | (zero & (given == 0.0)))).all():
        condition = "not be negative and must be finite" if zero else "be positive and finite"
        raise InputError(f"{where} must {condition}, got {_shown(value)}")
    if not np.isfinite(given).all():
        raise InputError(f"{where} must be finite, got {_shown(value)}")
    wrong = (given < lowest) | (given > highest)
    if (wrong & (given != 0.0) if zero else wrong).any():
        unless = "0 or " if zero and lowest > 0.0 else ""
        raise InputError(f"{where} must be {unless}from {lowest:g} to {highest:g}, got {_shown(value)}")


def _broken_condition(name, value) -> str:
    """Return the condition that the numbers of a value violate together, empty where they violate none."""
    if name in _QUATERNIONS:
        norm = float(np.linalg.norm(_numbers(value))) if isinstance(value, _QUATERNION_TYPES) else np.inf
        if abs(norm - 1.0) > 1e-2 and not (norm == 0.0 and name == "physics:principalAxes"):
            return "must be a quaternion of length 1"
    if name == "physics:diagonalInertia" and 2.0 * max(value) > (1.0 + _INERTIA_TOLERANCE) * sum(value):
        return "must be the inertia of a body: no component above the sum of the other two"
    return ""


def _numbers(value) -> np.ndarray | None:
    """Return the numbers of a value, None for tokens and the like."""
    if isinstance(value, (bool, str)):
        return None
    if isinstance(value, _QUATERNION_TYPES):
        value = (value.GetReal(), *value.GetImaginary())
    try:
        return np.array(value, dtype=float).ravel()
    except (TypeError, ValueError, OverflowError):
        return None


def _kind(example) -> str:
    """Return the type of a value with its article, for a message."""
    if isinstance(example, str):
        return "a token"
    name = type(example).__name__
    return f"{'an' if name[0] in 'aeiou' else 'a'} {name}"


def _shown(value) -> str:
    """Return a value as short text, for a message."""
    if isinstance(value, float):
        return f"{value:g}" if math.isfinite(value) else str(value)
    if isinstance(value, _VECTORS):
        return str(tuple(value))
    if type(value).__module__ == Vt.__name__ and hasattr(value, "__len__"):
        return f"an array of {len(value)}"
    shown = " ".join(repr(value).split())
    return shown if len(shown) <= 80 else f"{shown[:77]}..."
