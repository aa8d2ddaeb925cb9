"""The applied API schemas ``WarpmagCoilAPI`` and ``WarpmagFieldMapAPI``: authoring, and reading with their place.

Each attribute stands for a field of :class:`warpmag.declarations.coils.Coil` or
:class:`warpmag.declarations.coils.FieldMap`. A source moves with the nearest rigid body at or above its prim.
"""

from collections.abc import Iterator
from dataclasses import dataclass, fields, replace

import numpy as np
from pxr import Gf, Sdf, Usd, UsdGeom, Vt

from warpmag.declarations.coils import Coil, FieldMap, check_strength
from warpmag.declarations.keys import Keys
from warpmag.errors import InputError
from warpmag.usd.read.keys import KeyReader
from warpmag.usd.read.transforms import TransformCheck, is_body
from warpmag.usd.schemas import has_api
from warpmag.usd.values import Finding, finding_of, instance_finding, number, text, vector

COIL_API = "WarpmagCoilAPI"
MAP_API = "WarpmagFieldMapAPI"
AMPERE_TURNS = "warpmag:coil:ampereTurns"

_FADED = 0.05
"""Part of its largest field that a map may have at its border without a warning."""
_EVEN = 1e-5
"""How much scales may differ and axes lean: poses are often single precision."""


@dataclass(frozen=True)
class PlacedSource:
    """A coil or a field map of a stage.

    Attributes:
        source: What it is, in metres of the world.
        body: Rigid-body prim that it moves with, None where it is fixed in the world.
        position: Origin of its frame in the world [m].
        rotation: Rotation of its frame (x, y, z, w).
        currents: Keys of a coil's ampere-turns [A] at time codes, None where they are constant.
    """

    source: Coil | FieldMap
    body: str | None
    position: tuple[float, float, float]
    rotation: tuple[float, float, float, float]
    currents: Keys | None = None


def _current(name: str, value) -> tuple[float]:
    found = number(name, value)
    check_strength(name, found)
    return (found,)


def _array(name: str, value, kinds: tuple) -> np.ndarray:
    if not isinstance(value, kinds):
        raise InputError(f"{name}: must be an array of vectors, got {type(value).__name__}")
    return np.array(value, dtype=float).reshape(-1, 3)


def _vectors(name: str, value) -> np.ndarray:
    return _array(name, value, (Vt.Vec3fArray, Vt.Vec3dArray, Vt.Vec3hArray))


def _points(name: str, value) -> tuple:
    return tuple(map(tuple, _vectors(name, value).tolist()))


def _flag(name: str, value) -> bool:
    if not isinstance(value, bool):
        raise InputError(f"{name}: must be true or false, got {value!r:.60}")
    return value


def _counts(name: str, value) -> tuple[int, int, int]:
    if not isinstance(value, Gf.Vec3i):
        raise InputError(f"{name}: must be three whole numbers, got {value!r:.60}")
    return tuple(value)


_NAMES = Sdf.ValueTypeNames
_COIL = {
    "shape": ("warpmag:coil:shape", text, _NAMES.Token),
    "radius": ("warpmag:coil:radius", number, _NAMES.Float),
    "length": ("warpmag:coil:length", number, _NAMES.Float),
    "points": ("warpmag:coil:points", _points, _NAMES.Point3fArray),
    "closed": ("warpmag:coil:closed", _flag, _NAMES.Bool),
    "wire_radius": ("warpmag:coil:wireRadius", number, _NAMES.Float),
    "ampere_turns": (AMPERE_TURNS, number, _NAMES.Float),
}
_MAP = {
    "origin": ("warpmag:fieldMap:origin", vector, _NAMES.Point3f),
    "spacing": ("warpmag:fieldMap:spacing", vector, _NAMES.Vector3f),
    "counts": ("warpmag:fieldMap:counts", _counts, _NAMES.Int3),
    "values": ("warpmag:fieldMap:values", _vectors, _NAMES.Vector3fArray),
    "factor": ("warpmag:fieldMap:factor", number, _NAMES.Float),
}
_VARYING = ("ampere_turns",)
COIL_NAMES, MAP_NAMES = (tuple(name for name, _, _ in one.values()) for one in (_COIL, _MAP))


def author_coil(prim: Usd.Prim, coil: Coil) -> None:
    """Make ``prim`` a coil, with every attribute authored."""
    coil.check(str(prim.GetPath()))
    values = {one.name: getattr(coil, one.name) for one in fields(coil)}
    values["points"] = Vt.Vec3fArray([Gf.Vec3f(*point) for point in coil.points])
    _author(prim, COIL_API, _COIL, values)


def author_field_map(prim: Usd.Prim, field_map: FieldMap) -> None:
    """Make ``prim`` a field map, with every attribute authored."""
    field_map.check(str(prim.GetPath()))
    nodes = np.ascontiguousarray(field_map.values, np.float32)
    values = {
        "origin": Gf.Vec3f(*field_map.origin),
        "spacing": Gf.Vec3f(*field_map.spacing),
        "counts": Gf.Vec3i(*nodes.shape[:3]),
        "values": Vt.Vec3fArray.FromNumpy(nodes.reshape(-1, 3)),
        "factor": field_map.factor,
    }
    _author(prim, MAP_API, _MAP, values)


def _author(prim, api, attributes, values) -> None:
    prim.AddAppliedSchema(api)
    for field, (name, _, kind) in attributes.items():
        variability = Sdf.VariabilityVarying if field in _VARYING else Sdf.VariabilityUniform
        prim.CreateAttribute(name, kind, custom=False, variability=variability).Set(values[field])


def is_source(prim: Usd.Prim) -> bool:
    """Whether a prim is a coil or a field map."""
    return has_api(prim, COIL_API) or has_api(prim, MAP_API)


def sources_of(prim: Usd.Prim, transforms: TransformCheck, keys: KeyReader) -> Iterator[PlacedSource | Finding]:
    """Yield the coil and the field map that a prim is, or what is wrong with them."""
    path = str(prim.GetPath())
    if not prim.IsA(UsdGeom.Xformable):
        yield Finding(path, "a coil or a field map on a prim that has no transform: use an Xform")
        return
    wrong = list(transforms.findings(prim))
    yield from wrong
    if wrong or not transforms.is_sound(prim):
        return
    try:
        position, rotation, scale = _frame(prim)
        owner = _owner(prim)
        body = owner and str(owner.GetPath())
        if keys.moves(prim, owner):
            yield Finding(path, f"keys move it within its rigid body {body}: a run holds it still there", "warning")
        if has_api(prim, COIL_API):
            currents = keys.keys(prim, AMPERE_TURNS, _current)
            yield PlacedSource(_scaled_coil(coil_of(prim), scale), body, position, rotation, currents)
        if has_api(prim, MAP_API):
            found = field_map_of(prim)
            if (rest := found.border()) > _FADED:
                message = f"the field is up to {100.0 * rest:.0f} % of its largest where the map ends, and zero beyond"
                yield Finding(path, message, "warning")
            yield PlacedSource(_scaled_map(found, scale), body, position, rotation)
    except InputError as error:
        yield finding_of(path, error)


def placed_sources(prim: Usd.Prim) -> list[PlacedSource]:
    """Return the coil and the field map that a prim is; raises :class:`InputError` if something is wrong with them."""
    found = list(sources_of(prim, TransformCheck(), KeyReader(prim.GetStage())))
    for one in found:
        if isinstance(one, Finding) and one.severity == "error":
            raise InputError(str(one))
    return [one for one in found if isinstance(one, PlacedSource)]


def coil_of(prim: Usd.Prim) -> Coil:
    """Read and check the coil that ``prim`` is, in its own frame; raises :class:`InputError` naming the prim."""
    coil = Coil(**_read(prim, _COIL))
    coil.check(str(prim.GetPath()))
    return coil


def field_map_of(prim: Usd.Prim) -> FieldMap:
    """Read and check the field map that ``prim`` is, in its own frame; raises :class:`InputError` naming the prim."""
    path, given = str(prim.GetPath()), _read(prim, _MAP)
    for field in ("spacing", "counts", "values"):
        if field not in given:
            raise InputError(f"{path}: {_MAP[field][0]} is missing")
    counts, nodes = given.pop("counts"), given.pop("values")
    if min(counts) < 2 or np.prod(counts, dtype=float) != len(nodes):
        names = _MAP["values"][0], _MAP["counts"][0]
        raise InputError(f"{path}: {names[0]} has {len(nodes)} vectors, but {names[1]} is {counts}, 2 or more each")
    found = FieldMap(**({"origin": (0.0, 0.0, 0.0)} | given), values=nodes.reshape(*counts, 3))
    found.check(path)
    return found


def _read(prim, attributes) -> dict:
    """Return the fields whose attributes have a value."""
    found = {}
    for field, (name, read, _) in attributes.items():
        attribute = prim.GetAttribute(name)
        value = attribute.Get() if attribute else None
        if value is not None:
            found[field] = read(f"{prim.GetPath()}: {name}", value)
        if field not in _VARYING and attribute and _changes(attribute):
            raise InputError(f"{prim.GetPath()}: {name} has time samples, but cannot change")
        if attribute and (finding := instance_finding(attribute)):
            raise InputError(str(finding))
    return found


def _changes(attribute: Usd.Attribute) -> bool:
    """Whether a layer gives several time samples for an attribute, held or not."""
    return any(one.layer.GetNumTimeSamplesForPath(one.path) > 1 for one in attribute.GetPropertyStack())


def _scaled_coil(coil: Coil, scale: float) -> Coil:
    points = tuple(map(tuple, (scale * np.array(coil.points, float).reshape(-1, 3)).tolist()))
    sizes = {name: scale * getattr(coil, name) for name in ("radius", "length", "wire_radius")}
    return replace(coil, points=points, **sizes)


def _scaled_map(found: FieldMap, scale: float) -> FieldMap:
    return replace(found, origin=_times(scale, found.origin), spacing=_times(scale, found.spacing))


def _times(scale: float, numbers) -> tuple[float, float, float]:
    x, y, z = (scale * one for one in numbers)
    return x, y, z


def _frame(prim):
    """Return place, rotation and scale of a prim's frame; raises :class:`InputError` where it is scaled unevenly."""
    matrix = UsdGeom.XformCache(Usd.TimeCode.Default()).GetLocalToWorldTransform(prim)
    axes = np.array(matrix)[:3, :3]
    scales = np.linalg.norm(axes, axis=1)
    if np.ptp(scales) > _EVEN * scales.max() or np.linalg.det(axes) < 0.0:
        raise InputError(f"{prim.GetPath()}: a coil or a field map must not be scaled unevenly or mirrored")
    turn = Gf.Matrix3d((axes / scales[:, None]).tolist()).ExtractRotation().GetQuat()
    rotation = (*turn.GetImaginary(), turn.GetReal())
    return tuple(np.array(matrix)[3, :3].tolist()), rotation, float(scales.mean())


def _owner(prim) -> Usd.Prim | None:
    """Return the nearest rigid body at or above a prim."""
    while prim and not prim.IsPseudoRoot():
        if is_body(prim):
            return prim
        prim = prim.GetParent()
    return None
