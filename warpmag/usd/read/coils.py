"""The applied API schemas ``WarpmagCoilAPI`` and ``WarpmagFieldMapAPI``: authoring and reading.

A source of a field moves with the nearest rigid body at or above its prim.
"""

from collections.abc import Iterator
from dataclasses import dataclass, replace
from typing import Any, TypeVar

import numpy as np
from pxr import Gf, Usd, UsdGeom

from warpmag.declarations.attributes import Schema, attributes_of, check_record
from warpmag.declarations.coils import Coil, FieldMap, check_strength
from warpmag.declarations.keys import Keys
from warpmag.declarations.schemas import COIL_SCHEMA, FIELD_MAP_SCHEMA
from warpmag.errors import InputError
from warpmag.shapes.inductance import check_inductance
from warpmag.usd.read.clock import stage_clock
from warpmag.usd.read.keys import KeyReader
from warpmag.usd.read.prims import body_of
from warpmag.usd.read.transforms import SCALE_TOLERANCE, TransformCheck
from warpmag.usd.schemas import author_schema, has_api, read_fields, world_matrix
from warpmag.usd.values import Finding, check_prim, finding_of, instance_finding, number

Source = TypeVar("Source", Coil, FieldMap)
_AMPERE_TURNS, _VOLTAGE = (COIL_SCHEMA.usd_name(field) for field in ("ampere_turns", "voltage"))
CURRENT = COIL_SCHEMA.usd_name("current")
_BORDER_WARNING = 0.05
"""Largest field on the boundary of a map without a warning, as a fraction of its largest field."""


@dataclass(frozen=True)
class PlacedSource:
    """A coil or a field map of a stage."""

    prim: str  # path of the prim that declares it
    source: Coil | FieldMap  # in meters of the world
    body: str | None  # path of the rigid body that it moves with, None where it is fixed in the world
    position: tuple[float, float, float]  # origin of its frame in the world [m]
    rotation: tuple[float, float, float, float]  # rotation of its frame, a quaternion x y z w
    # Ampere-turns [A] of a coil, or voltages [V] of a coil with a resistance, at time codes; None where constant
    drive: Keys | None = None


def author_coil(prim: Usd.Prim, coil: Coil) -> None:
    """Make ``prim`` a coil, with every attribute authored."""
    check_prim(prim, authored=True)
    check_record("coil", coil, Coil)
    coil.check(str(prim.GetPath()))
    author_schema(prim, COIL_SCHEMA, vars(coil))


def author_field_map(prim: Usd.Prim, field_map: FieldMap) -> None:
    """Make ``prim`` a field map, with every attribute authored."""
    check_prim(prim, authored=True)
    check_record("field_map", field_map, FieldMap)
    field_map.check(str(prim.GetPath()))
    author_schema(prim, FIELD_MAP_SCHEMA, vars(field_map) | {"counts": np.shape(field_map.values)[:3]})


def is_source(prim: Usd.Prim) -> bool:
    """Return True if a prim is a coil or a field map."""
    return has_api(prim, COIL_SCHEMA.name) or has_api(prim, FIELD_MAP_SCHEMA.name)


def sources_of(prim: Usd.Prim, transforms: TransformCheck, keys: KeyReader) -> Iterator[PlacedSource | Finding]:
    """Yield the coil and the field map that a prim declares, and the errors and warnings about them."""
    path = str(prim.GetPath())
    if not prim.IsA(UsdGeom.Xformable):
        yield Finding(path, "a coil or a field map on a prim that has no transform: use an Xform")
        return
    faults = list(transforms.findings(prim))
    yield from faults
    if faults or not transforms.is_valid(prim):
        return
    try:
        position, rotation, scale = _frame(prim)
        owner = body_of(prim)
        body = owner and str(owner.GetPath())
        if keys.moves(prim, owner):
            yield Finding(path, f"keys move it within its rigid body {body}: a run holds it still there", "warning")
        if has_api(prim, COIL_SCHEMA.name):
            coil = _coil(prim)
            coil.check(path)
            drive, coil = _drive(prim, coil, keys), _scaled(coil, scale)
            check_inductance(path, coil.record())
            yield PlacedSource(path, coil, body, position, rotation, drive)
        if has_api(prim, FIELD_MAP_SCHEMA.name):
            field_map = field_map_of(prim)
            if (ratio := field_map.border_ratio()) > _BORDER_WARNING:
                share = f"{100.0 * ratio:.0f} % of its maximum"
                message = f"the field is up to {share} on the boundary of the map, and zero beyond"
                yield Finding(path, message, "warning")
            yield PlacedSource(path, _scaled(field_map, scale), body, position, rotation)
    except InputError as error:
        yield finding_of(path, error)


def placed_sources(prim: Usd.Prim) -> list[PlacedSource]:
    """Return the coil and the field map that a prim declares, with keys in seconds since the start."""
    stage, sources = prim.GetStage(), []
    for source in sources_of(prim, TransformCheck(), KeyReader(stage)):
        if isinstance(source, Finding):
            if source.severity == "error":
                raise InputError(str(source))
        elif source.drive is None:
            sources.append(source)
        else:
            clock = stage_clock(stage)
            seconds = source.drive.in_seconds(clock.start, clock.time_codes_per_second)
            sources.append(replace(source, drive=seconds))
    return sources


def world_matrix_at(prim: Usd.Prim, path: str) -> np.ndarray:
    """Return the world matrix of the prim at a path of the stage of ``prim``, for row vectors, shape [4, 4]."""
    return world_matrix(prim.GetStage().GetPrimAtPath(path))


def field_map_of(prim: Usd.Prim) -> FieldMap:
    """Return the field map that ``prim`` declares, in its own frame; raise :class:`InputError` where it is invalid."""
    path, fields = str(prim.GetPath()), _read(prim, FIELD_MAP_SCHEMA)
    for row in FIELD_MAP_SCHEMA.attributes:
        if row.default is not None:
            fields.setdefault(row.field, row.default)
        elif row.field not in fields:
            raise InputError(f"{path}: {row.usd_name} is missing")
    counts, nodes = fields.pop("counts"), fields.pop("values")
    if min(counts) < 2 or np.prod(counts, dtype=float) != len(nodes):
        names = [FIELD_MAP_SCHEMA.usd_name(field) for field in ("values", "counts")]
        raise InputError(f"{path}: {names[0]} has {len(nodes)} vectors, but {names[1]} is {counts}, 2 or more each")
    field_map = FieldMap(**fields, values=nodes.reshape(*counts, 3))
    field_map.check(path)
    return field_map


def _coil(prim: Usd.Prim) -> Coil:
    """Return the coil that ``prim`` declares, in its own frame, with the current of an earlier run; not checked."""
    fields = _read(prim, COIL_SCHEMA)
    authored = prim.GetAttribute(CURRENT).HasAuthoredValue()
    current = fields.pop("current", 0.0)
    coil = Coil(**fields)
    return replace(coil, ampere_turns=current * coil.turns) if authored and coil.resistance else coil


def _read(prim: Usd.Prim, schema: Schema) -> dict:
    """Return the values of the attributes of a schema by field; uniform ones must not change over time."""
    values = read_fields(prim, schema.attributes)
    for row in schema.attributes:
        if not (attribute := prim.GetAttribute(row.usd_name)):
            continue
        specs = attribute.GetPropertyStack()  # including specs below a frozen value
        if row.uniform and any(spec.layer.GetNumTimeSamplesForPath(spec.path) > 1 for spec in specs):
            raise InputError(f"{prim.GetPath()}: {row.usd_name} has time samples, but cannot change")
        if finding := instance_finding(attribute):
            raise InputError(str(finding))
    return values


def _drive(prim: Usd.Prim, coil: Coil, keys: KeyReader) -> Keys | None:
    """Return the keys of a coil's current, or of its voltage if it has a resistance."""
    currents, voltages = (keys.keys(prim, name, _strength) for name in (_AMPERE_TURNS, _VOLTAGE))
    if currents is not None and coil.resistance:
        raise InputError(f"{prim.GetPath()}: {_AMPERE_TURNS} has time samples, but follows from the voltage")
    if voltages is not None and not coil.resistance:
        raise InputError(f"{prim.GetPath()}: {_VOLTAGE} has time samples, but the coil has no resistance")
    return voltages if coil.resistance else currents


def _strength(name: str, value) -> tuple[float]:
    """Return the checked value of one key of a coil's ampere-turns [A] or voltage [V]."""
    strength = number(name, value)
    check_strength(name, strength)
    return (strength,)


def _scaled(source: Source, scale: float) -> Source:
    """Return a source with all its lengths scaled."""
    lengths = [row.field for row in attributes_of(type(source)) if row.unit == "distance"]
    return replace(source, **{field: _times(scale, getattr(source, field)) for field in lengths})


def _times(scale: float, value: Any) -> Any:
    """Return a number, a vector or vectors times a scale."""
    return tuple(_times(scale, part) for part in value) if isinstance(value, tuple) else scale * value


def _frame(prim):
    """Return position, rotation and scale of a prim's frame; raise :class:`InputError` where scales differ."""
    matrix = UsdGeom.XformCache(Usd.TimeCode.Default()).GetLocalToWorldTransform(prim)
    axes = np.array(matrix)[:3, :3]
    scales = np.linalg.norm(axes, axis=1)
    if np.ptp(scales) > SCALE_TOLERANCE * scales.max() or np.linalg.det(axes) < 0.0:
        raise InputError(f"{prim.GetPath()}: a coil or a field map must not be mirrored or have a non-uniform scale")
    quaternion = Gf.Matrix3d((axes / scales[:, None]).tolist()).ExtractRotation().GetQuat()
    rotation = (*quaternion.GetImaginary(), quaternion.GetReal())
    return tuple(np.array(matrix)[3, :3].tolist()), rotation, float(scales.mean())
