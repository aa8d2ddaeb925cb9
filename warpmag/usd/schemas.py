"""The applied API schemas ``WarpmagMagnetAPI`` and ``WarpmagSceneAPI``: registration, authoring and reading.

The schemas are codeless; their text is ``schema/generatedSchema.usda``. Each attribute stands for one field of
:class:`warpmag.declarations.magnets.Magnet` or :class:`warpmag.declarations.magnets.MagneticSettings`.
"""

import dataclasses
from pathlib import Path

import newton_usd_schemas  # noqa: F401  (registers Newton's own schemas, which must happen before a stage is opened)
from pxr import Gf, Plug, Sdf, Usd

from warpmag.declarations import materials
from warpmag.declarations.checks import check_vector
from warpmag.declarations.curves import MagnetizationCurve
from warpmag.declarations.keys import Keys
from warpmag.declarations.magnets import Magnet, MagneticSettings, check_curve, check_material, check_recoil
from warpmag.errors import InputError
from warpmag.usd.read.keys import KeyReader
from warpmag.usd.values import instance_finding, number, text, vector

Plug.Registry().RegisterPlugins(str(Path(__file__).parent.absolute() / "schema"))

MAGNET_API = "WarpmagMagnetAPI"
SCENE_API = "WarpmagSceneAPI"
MOMENT = "warpmag:moment"
MATERIAL = "warpmag:material"
CURVE_POINTS = "warpmag:curve:h", "warpmag:curve:b"
"""Points of a measured curve: H [A/m] inside the material, and B [T]."""

_TYPES = {str: Sdf.ValueTypeNames.Token, float: Sdf.ValueTypeNames.Float, tuple: Sdf.ValueTypeNames.Vector3f}

_READERS = {str: text, float: number, tuple: vector}

_MAGNET_ATTRIBUTES = {
    "kind": "warpmag:kind",
    "saturation": "warpmag:saturationMagnetization",
    "susceptibility": "warpmag:susceptibility",
    "curve": "warpmag:curve",
    "magnetization": "warpmag:magnetization",
    "recoil_permeability": "warpmag:recoilPermeability",
    "moment_spacing": "warpmag:momentSpacing",
    "conductivity": "warpmag:conductivity",
}
_OF_CURVE = ("saturation", "susceptibility", "curve")
"""What a measured curve says."""
_SETTINGS_ATTRIBUTES = {
    "external_field": "warpmag:externalField",
    "force": "warpmag:force",
    "dynamics": "warpmag:dynamics",
    "contact_model": "warpmag:contactModel",
    "rtol": "warpmag:rtol",
}
MAGNET_NAMES = (*_MAGNET_ATTRIBUTES.values(), MATERIAL, *CURVE_POINTS, MOMENT)
SCENE_NAMES = tuple(_SETTINGS_ATTRIBUTES.values())


def author_magnet(prim: Usd.Prim, magnet: Magnet) -> None:
    """Make ``prim`` a magnet, with every attribute authored (Newton sees authored values only, no fallbacks).

    But for what has no meaning for this one: a recoil permeability of 1, no conductivity, and what a measured curve
    says.
    """
    magnet.check(str(prim.GetPath()))
    left_out = [
        *([] if magnet.recoils else ["recoil_permeability"]),
        *([] if magnet.conductivity else ["conductivity"]),
    ]
    if isinstance(magnet.curve, MagnetizationCurve):
        left_out += _OF_CURVE
        _author_curve(prim, magnet.curve)
    said = {field: name for field, name in _MAGNET_ATTRIBUTES.items() if field not in left_out}
    _author(prim, MAGNET_API, said, magnet)


def author_settings(prim: Usd.Prim, settings: MagneticSettings) -> None:
    """Write the scene's magnetic settings on its PhysicsScene ``prim``, every attribute authored."""
    settings.check(str(prim.GetPath()))
    _author(prim, SCENE_API, _SETTINGS_ATTRIBUTES, settings)


def magnet_of(prim: Usd.Prim) -> Magnet:
    """Read and check the magnet that ``prim`` carries; raises :class:`InputError` naming the prim."""
    magnet = _with_curve(prim, _read(prim, _MAGNET_ATTRIBUTES, Magnet()))
    material = prim.GetAttribute(MATERIAL).Get()
    if material is not None and text(f"{prim.GetPath()}: {MATERIAL}", material):
        magnet = dataclasses.replace(magnet, **_of_material(prim, material, magnet))
    path = str(prim.GetPath())
    magnet.check(path)
    check_curve(f"{path}: {_MAGNET_ATTRIBUTES['curve']}", magnet.curve)  # what its kind has no use for, too
    check_vector(f"{path}: {_MAGNET_ATTRIBUTES['magnetization']}", magnet.magnetization)
    check_recoil(f"{path}: {_MAGNET_ATTRIBUTES['recoil_permeability']}", magnet.recoil_permeability)
    for field, infinite in (("saturation", False), ("susceptibility", True)):
        check_material(f"{path}: {_MAGNET_ATTRIBUTES[field]}", getattr(magnet, field), infinite=infinite)
    return magnet


def magnet_prim_of(collider: Usd.Prim) -> Usd.Prim | None:
    """Return the prim that makes a collider a magnet: itself or its rigid body; None where neither does."""
    if not has_api(collider, "PhysicsCollisionAPI") or collider.GetTypeName() == "Plane":
        return None
    prim = collider
    while not has_api(prim, MAGNET_API) and not has_api(prim, "PhysicsRigidBodyAPI") and not prim.IsPseudoRoot():
        prim = prim.GetParent()
    return prim if has_api(prim, MAGNET_API) and (prim == collider or has_api(prim, "PhysicsRigidBodyAPI")) else None


def moment_of(prim: Usd.Prim) -> tuple[float, float, float] | None:
    """Read the authored moment of a magnet [A·m²], world frame, None where it has none."""
    attribute = prim.GetAttribute(MOMENT)
    value = attribute.Get() if attribute and attribute.HasAuthoredValue() else None
    if value is None:
        return None
    moment = vector(f"{prim.GetPath()}: {MOMENT}", value)
    check_vector(f"{prim.GetPath()}: {MOMENT}", moment)
    return moment


def _of_material(prim: Usd.Prim, material: str, magnet: Magnet) -> dict:
    """Return what a named material says about a magnet, which the prim must not say again."""
    owner = f"{prim.GetPath()}: {MATERIAL}"
    if magnet.kind == "permanent":
        return {"magnetization": materials.permanent(owner, material, magnet.magnetization)}
    values = materials.inducible(owner, material)
    if isinstance(magnet.curve, MagnetizationCurve):
        raise InputError(f"{owner}: {material} says what the magnet is made of, and a measured curve does, author one")
    for field in _OF_CURVE if _OF_CURVE[2] in values else values:
        if prim.GetAttribute(_MAGNET_ATTRIBUTES[field]).HasAuthoredValue():
            raise InputError(f"{owner}: {material} says what {_MAGNET_ATTRIBUTES[field]} is, author one or the other")
    return values


def _with_curve(prim: Usd.Prim, magnet: Magnet) -> Magnet:
    """Return a magnet with the measured curve that the prim has by name or by points, which says Ms and χ, too."""
    name, points = _MAGNET_ATTRIBUTES["curve"], [prim.GetAttribute(one).Get() for one in CURVE_POINTS]
    if any(points):
        given = prim.GetAttribute(name)
        if given and given.HasAuthoredValue():
            raise InputError(f"{prim.GetPath()}: {name}: there are points of a curve, too, author one or the other")
        owner = f"{prim.GetPath()}: {' and '.join(CURVE_POINTS)}"
        curve = MagnetizationCurve.from_bh(*(one or () for one in points), name=owner)
    else:
        curve = materials.measured(f"{prim.GetPath()}: curve", magnet.curve)
    if isinstance(curve, MagnetizationCurve):
        for one in _OF_CURVE[:2]:
            if prim.GetAttribute(_MAGNET_ATTRIBUTES[one]).HasAuthoredValue():
                raise InputError(f"{prim.GetPath()}: {_MAGNET_ATTRIBUTES[one]}: a measured curve says it, author one")
    return dataclasses.replace(magnet, curve=curve)


def _author_curve(prim: Usd.Prim, curve: MagnetizationCurve) -> None:
    """Write a measured curve, by its name where a material has it."""
    if name := materials.name_of_curve(curve):
        attribute = prim.CreateAttribute(
            _MAGNET_ATTRIBUTES["curve"], Sdf.ValueTypeNames.Token, custom=False, variability=Sdf.VariabilityUniform
        )
        attribute.Set(name)
        return
    for one, values in zip(CURVE_POINTS, (curve.fields, curve.flux_densities), strict=True):
        prim.CreateAttribute(one, Sdf.ValueTypeNames.DoubleArray, custom=False).Set(values)


def settings_of(prim: Usd.Prim) -> MagneticSettings:
    """Read and check the magnetic settings of a PhysicsScene ``prim``; raises :class:`InputError` naming it."""
    settings = _read(prim, _SETTINGS_ATTRIBUTES, MagneticSettings())
    settings.check(str(prim.GetPath()))
    return settings


def field_keys(prim: Usd.Prim, keys: KeyReader) -> Keys | None:
    """Read the time samples of a scene's external field [A/m], None where it is constant."""
    return keys.keys(prim, _SETTINGS_ATTRIBUTES["external_field"], _finite_vector)


def magnetization_keys(prim: Usd.Prim, magnet: Magnet, keys: KeyReader) -> Keys | None:
    """Read the time samples of a permanent magnet's magnetization [A/m], None where it is constant."""
    name = _MAGNET_ATTRIBUTES["magnetization"]
    if magnet.kind != "permanent":
        return None
    if finding := instance_finding(prim.GetAttribute(name)):
        raise InputError(str(finding))
    material = prim.GetAttribute(MATERIAL).Get()

    def read(where: str, value) -> tuple:
        given = _finite_vector(where, value)
        return materials.permanent(where, material, given) if material else given

    return keys.keys(prim, name, read)


def _finite_vector(name: str, value) -> tuple[float, float, float]:
    found = vector(name, value)
    check_vector(name, found)
    return found


def has_api(prim: Usd.Prim, name: str) -> bool:
    """Whether the API schema ``name`` is applied to ``prim``, also if it was registered too late for USD to know it."""
    return name in prim.GetPrimTypeInfo().GetAppliedAPISchemas()


def _author(prim, api, attributes, record) -> None:
    prim.AddAppliedSchema(api)
    for field, name in attributes.items():
        value = getattr(record, field)
        kind = type(value) if isinstance(value, (str, tuple)) else float
        variability = Sdf.VariabilityUniform if kind is str else Sdf.VariabilityVarying
        attribute = prim.CreateAttribute(name, _TYPES[kind], custom=False, variability=variability)
        attribute.Set(Gf.Vec3f(*value) if kind is tuple else value)


def _read(prim, attributes, defaults):
    """Return ``defaults`` with each field replaced by the value of its attribute, where it has one."""
    values = {}
    for field, name in attributes.items():
        value = prim.GetAttribute(name).Get()
        if value is not None:
            values[field] = _READERS[type(getattr(defaults, field))](f"{prim.GetPath()}: {name}", value)
    return dataclasses.replace(defaults, **values)
