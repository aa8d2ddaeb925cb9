"""The applied API schemas ``WarpmagMagnetAPI`` and ``WarpmagSceneAPI``: registration, authoring and reading.

The schemas are codeless: their text, ``schema/generatedSchema.usda``, is made from the table of attributes
(``warpmag.declarations.schemas``) by ``python -m warpmag.usd.schema_text``.
"""

import dataclasses
from collections.abc import Callable, Iterable, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import newton_usd_schemas  # noqa: F401  (registers Newton's own schemas, which must happen before a stage is opened)
import numpy as np
from pxr import Gf, Plug, Sdf, Usd, UsdGeom, Vt

from warpmag.declarations import materials
from warpmag.declarations.attributes import Attribute, Schema, attributes_of, check_record
from warpmag.declarations.checks import check_vector
from warpmag.declarations.curves import MagnetizationCurve
from warpmag.declarations.magnets import Magnet, MagneticSettings
from warpmag.declarations.schemas import MAGNET_SCHEMA, SCENE_SCHEMA
from warpmag.errors import InputError
from warpmag.usd.values import check_prim, flag, number, point_array, text, vector, vector_array, whole_numbers

Plug.Registry().RegisterPlugins(str(Path(__file__).parent.absolute() / "schema"))

MAGNET_API, SCENE_API = MAGNET_SCHEMA.name, SCENE_SCHEMA.name
MOMENT = MAGNET_SCHEMA.usd_name("moment")
MATERIAL = MAGNET_SCHEMA.usd_name("material")
CURVE_POINTS = MAGNET_SCHEMA.usd_name("curve_fields"), MAGNET_SCHEMA.usd_name("curve_flux_densities")
"""Points of a measured curve: H [A/m] inside the material, and B [T]."""
_CURVE = MAGNET_SCHEMA.usd_name("curve")
_SET_BY_CURVE = ("saturation", "susceptibility", "curve")
"""Fields that a measured curve sets."""

_READERS: dict[str, Callable[[str, Any], Any]] = {
    "token": text,
    "float": number,
    "double": number,
    "bool": flag,
    "vector3f": vector,
    "point3f": vector,
    "int3": whole_numbers,
    "vector3f[]": vector_array,
    "point3f[]": point_array,
}
"""Functions that convert the value of a USD attribute to the value of a field, by USD type."""
_TO_USD: dict[str, Callable[[Any], Any]] = {
    "float": float,
    "double": float,
    "bool": bool,
    "vector3f": lambda value: Gf.Vec3f(*map(float, value)),
    "point3f": lambda value: Gf.Vec3f(*map(float, value)),
    "int3": lambda value: Gf.Vec3i(*value),
    "vector3f[]": lambda value: Vt.Vec3fArray.FromNumpy(np.ascontiguousarray(value, np.float32).reshape(-1, 3)),
    "point3f[]": lambda value: Vt.Vec3fArray([Gf.Vec3f(*map(float, point)) for point in value]),
}
"""Functions that convert the value of a field to the value of a USD attribute; other USD types need none."""


def author_magnet(prim: Usd.Prim, magnet: Magnet) -> None:
    """Make ``prim`` a magnet and author its attributes, also default values, because Newton reads authored values only.

    A recoil permeability of 1, a conductivity of 0, and attributes that a measured curve sets are not authored.
    """
    check_prim(prim, authored=True)
    check_record("magnet", magnet, Magnet)
    magnet.check(str(prim.GetPath()), unused=True)
    measured = isinstance(magnet.curve, MagnetizationCurve)
    prim.AddAppliedSchema(MAGNET_API)
    for row in attributes_of(Magnet):
        value = getattr(magnet, row.field)
        unused = row.optional and (row.kind not in ("", magnet.kind) or value == row.default)
        if not (unused or (measured and row.field in _SET_BY_CURVE)):
            author(prim, row, value)
    if measured:
        _author_curve(prim, magnet.curve)


def author_settings(prim: Usd.Prim, settings: MagneticSettings) -> None:
    """Author all magnetic settings of the scene on its PhysicsScene ``prim``."""
    check_prim(prim, authored=True)
    check_record("settings", settings, MagneticSettings)
    settings.check(str(prim.GetPath()))
    author_schema(prim, SCENE_SCHEMA, vars(settings))


def author_schema(prim: Usd.Prim, schema: Schema, values: Mapping[str, Any]) -> None:
    """Apply a schema to ``prim`` and author its attributes that have a field in ``values``."""
    prim.AddAppliedSchema(schema.name)
    for row in schema.attributes:
        if row.field in values:
            author(prim, row, values[row.field])


def author(prim: Usd.Prim, attribute: Attribute, value: Any) -> None:
    """Author one attribute of the table on ``prim``."""
    variability = Sdf.VariabilityUniform if attribute.uniform else Sdf.VariabilityVarying
    usd_type = Sdf.ValueTypeNames.Find(attribute.usd_type)
    created = prim.CreateAttribute(attribute.usd_name, usd_type, custom=False, variability=variability)
    created.Set(_TO_USD[attribute.usd_type](value) if attribute.usd_type in _TO_USD else value)


def read_fields(prim: Usd.Prim, attributes: Iterable[Attribute]) -> dict[str, Any]:
    """Return the values of those attributes of ``prim`` that have a value, by field; only types are checked."""
    values = {}
    for row in attributes:
        attribute = prim.GetAttribute(row.usd_name)
        value = attribute.Get() if attribute else None
        if value is not None:
            values[row.field] = _READERS[row.usd_type](f"{prim.GetPath()}: {row.usd_name}", value)
    return values


def magnet_of(prim: Usd.Prim) -> Magnet:
    """Return the magnet that ``prim`` declares.

    Raises:
        InputError: A value is invalid, or two attributes contradict each other; the message names the prim.
    """
    check_prim(prim)
    magnet = _with_curve(prim, Magnet(**read_fields(prim, attributes_of(Magnet))))
    material = prim.GetAttribute(MATERIAL).Get()
    if material is not None and text(f"{prim.GetPath()}: {MATERIAL}", material):
        magnet = dataclasses.replace(magnet, **_material_fields(prim, material, magnet))
    magnet.check(str(prim.GetPath()), unused=True)
    return magnet


def _magnet_prim(collider: Usd.Prim) -> Usd.Prim | None:
    """Return the prim that makes a collider a magnet: the collider itself or its rigid body, or None."""
    if not has_api(collider, "PhysicsCollisionAPI") or collider.GetTypeName() == "Plane":
        return None
    prim = collider
    while not has_api(prim, MAGNET_API) and not has_api(prim, "PhysicsRigidBodyAPI") and not prim.IsPseudoRoot():
        prim = prim.GetParent()
    return prim if has_api(prim, MAGNET_API) and (prim == collider or has_api(prim, "PhysicsRigidBodyAPI")) else None


@dataclass(frozen=True)
class ColliderMagnet:
    """The magnet of one collider, for the shape that Newton makes of the collider."""

    magnet: Magnet  # magnetization in the frame of the prim that declares it
    frames: tuple[np.ndarray, ...]  # world matrices of that prim and the collider, for row vectors; empty if equal
    axis: str | None  # token of the axis of a capsule, cylinder or cone, None for other shapes


def collider_magnet(collider: Usd.Prim) -> ColliderMagnet | None:
    """Return the magnet of a collider, None if the collider is not a magnet; see :func:`magnet_of` for errors."""
    prim = _magnet_prim(collider)
    if prim is None:
        return None
    frames = () if prim == collider else (world_matrix(prim), world_matrix(collider))
    return ColliderMagnet(magnet_of(prim), frames, shape_axis(collider.GetStage(), collider.GetPath()))


def shape_axis(stage: Usd.Stage, path: str | Sdf.Path) -> str | None:
    """Return the token of the axis of the capsule, cylinder or cone at a path, None for other shapes.

    On other shapes an attribute of that name is a stranger's, of any type.
    """
    prim = stage.GetPrimAtPath(path)
    return prim.GetAttribute("axis").Get() if "axis" in prim.GetPrimDefinition().GetPropertyNames() else None


def world_matrix(prim: Usd.Prim) -> np.ndarray:
    """Return the matrix from the frame of ``prim`` to the world, for row vectors, shape [4, 4]."""
    return np.array(UsdGeom.Xformable(prim).ComputeLocalToWorldTransform(Usd.TimeCode.Default()))


def moment_of(prim: Usd.Prim) -> tuple[float, float, float] | None:
    """Return the authored moment of a magnet [A·m²], world frame, None where there is none."""
    attribute = prim.GetAttribute(MOMENT)
    value = attribute.Get() if attribute and attribute.HasAuthoredValue() else None
    return None if value is None else finite_vector(f"{prim.GetPath()}: {MOMENT}", value)


def _material_fields(prim: Usd.Prim, material: str, magnet: Magnet) -> dict:
    """Return the fields of a magnet that a named material sets; the prim must not author them itself."""
    owner = f"{prim.GetPath()}: {MATERIAL}"
    if magnet.kind == "permanent":
        return {"magnetization": materials.permanent(owner, material, magnet.magnetization)}
    values = materials.inducible(owner, material)
    if isinstance(magnet.curve, MagnetizationCurve):
        raise InputError(f"{owner}: {material} sets the magnetization curve, and so does a measured curve: author one")
    for field in _SET_BY_CURVE if "curve" in values else values:
        name = MAGNET_SCHEMA.usd_name(field)
        if prim.GetAttribute(name).HasAuthoredValue():
            raise InputError(f"{owner}: {material} sets {name}: author one or the other")
    return values


def _with_curve(prim: Usd.Prim, magnet: Magnet) -> Magnet:
    """Return a magnet with the measured curve of the prim, by name or points; the curve also sets saturation and χ."""
    points = [prim.GetAttribute(name).Get() for name in CURVE_POINTS]
    if any(points):
        curve_name = prim.GetAttribute(_CURVE)
        if curve_name and curve_name.HasAuthoredValue():
            raise InputError(f"{prim.GetPath()}: {_CURVE}: conflicts with the points of a curve, author one")
        owner = f"{prim.GetPath()}: {' and '.join(CURVE_POINTS)}"
        curve = MagnetizationCurve.from_bh(*(numbers or () for numbers in points), name=owner)
    else:
        curve = materials.measured(f"{prim.GetPath()}: curve", magnet.curve)
    if isinstance(curve, MagnetizationCurve):
        for name in map(MAGNET_SCHEMA.usd_name, ("saturation", "susceptibility")):
            if prim.GetAttribute(name).HasAuthoredValue():
                raise InputError(f"{prim.GetPath()}: {name}: a measured curve sets it, author one")
    return dataclasses.replace(magnet, curve=curve)


def _author_curve(prim: Usd.Prim, curve: MagnetizationCurve) -> None:
    """Author a measured curve: the name of its material where there is one, otherwise its points."""
    points = {"curve_fields": curve.fields, "curve_flux_densities": curve.flux_densities}
    name = materials.name_of_curve(curve)
    author_schema(prim, MAGNET_SCHEMA, {"curve": name} if name else points)


def settings_of(prim: Usd.Prim) -> MagneticSettings:
    """Return the magnetic settings of a PhysicsScene ``prim``; raises :class:`InputError` if they are invalid."""
    settings = MagneticSettings(**read_fields(prim, attributes_of(MagneticSettings)))
    settings.check(str(prim.GetPath()))
    return settings


def finite_vector(name: str, value) -> tuple[float, float, float]:
    """Return the components of a vector called ``name`` in messages; raises :class:`InputError` unless finite."""
    components = vector(name, value)
    check_vector(name, components)
    return components


def has_api(prim: Usd.Prim, name: str) -> bool:
    """Return True if the API schema ``name`` is applied to ``prim``, even if USD registered it too late."""
    return name in prim.GetPrimTypeInfo().GetAppliedAPISchemas()
