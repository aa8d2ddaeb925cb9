"""Opens USD stages and reads what they say about magnets and time.

Everything that Newton's importer would read wrong without a word is found here and refused before Newton sees any of
it: values by ``values.py``, transforms by ``transforms.py``, sizes and meshes by ``geometry.py``, units and time by
``clock.py``; here are magnets that are none. Point instancers become prims (``instancers.py``), and other units than
metres and kilograms are converted (``units.py``), in layers of the session (``session.py``).
"""

import os
from collections.abc import Iterator
from dataclasses import dataclass, field
from pathlib import Path

from pxr import Sdf, Tf, Usd, UsdGeom, UsdPhysics

from warpmag.declarations.keys import Keys, Motion
from warpmag.declarations.magnets import Magnet, MagneticSettings, StageMagnets
from warpmag.errors import InputError
from warpmag.usd.paths import full_path, usable_path
from warpmag.usd.read.addresses import cut_off
from warpmag.usd.read.alike import AlikeBalls
from warpmag.usd.read.clock import check_rates, scenes, stage_name, start_of, unit_findings
from warpmag.usd.read.coils import PlacedSource, is_source, sources_of
from warpmag.usd.read.first_reading import NOT_USD, failure, first_reading
from warpmag.usd.read.geometry import is_solid, magnet_findings, mesh_findings, shape_findings, spacing_findings
from warpmag.usd.read.guard import line_of, readable
from warpmag.usd.read.instancers import complete_instances, expand_instancers
from warpmag.usd.read.keys import KeyReader, make_kinematic
from warpmag.usd.read.materials import material_findings
from warpmag.usd.read.session import instance_findings, instances_around, unsaved_layers
from warpmag.usd.read.slips import kind_findings, stray_findings
from warpmag.usd.read.swarms import Swarm, swarms_of
from warpmag.usd.read.transforms import TransformCheck, is_body, is_collider
from warpmag.usd.read.units import convert_units
from warpmag.usd.schemas import (
    MAGNET_API,
    SCENE_API,
    field_keys,
    has_api,
    magnet_of,
    magnetization_keys,
    moment_of,
    settings_of,
)
from warpmag.usd.values import (
    Finding,
    attribute_findings,
    check_type,
    declaration_findings,
    declared,
    finding_of,
    quiet,
)

_ORDER = "xformOpOrder"
_COMPOSED = ("subLayers", "subLayerOffsets", "layerRelocates")
"""Metadata of a layer that layers above it get from it."""


@dataclass
class StageContents:
    """What a stage holds and what is wrong with it, prim paths in the order of the stage.

    Attributes:
        bodies: Rigid bodies, kinematic ones included.
        kinematic: Kinematic bodies.
        colliders: Colliders.
        magnets: Magnets whose attributes are sound.
        initial_moments: Authored moments [A·m²], world frame.
        sources: Coils and field maps that are sound, by prim.
        settings: Magnetic settings of the first physics scene.
        motions: How keys move kinematic bodies, at time codes.
        field_keys: Keys of the external field [A/m] at time codes, None where it is constant.
        magnetization_keys: Keys of permanent magnets whose magnetization [A/m] is not constant.
        findings: Errors and warnings.
    """

    bodies: list[str] = field(default_factory=list)
    kinematic: list[str] = field(default_factory=list)
    colliders: list[str] = field(default_factory=list)
    magnets: dict[str, Magnet] = field(default_factory=dict)
    initial_moments: dict[str, tuple[float, float, float]] = field(default_factory=dict)
    sources: dict[str, list[PlacedSource]] = field(default_factory=dict)
    settings: MagneticSettings = field(default_factory=MagneticSettings)
    motions: dict[str, Motion] = field(default_factory=dict)
    field_keys: Keys | None = None
    magnetization_keys: dict[str, Keys] = field(default_factory=dict)
    findings: list[Finding] = field(default_factory=list)


def open_stage(path: str | os.PathLike, time_code: float | None = None) -> Usd.Stage:
    """Open a stage and hold it at one moment.

    Args:
        path: USD file.
        time_code: The moment at which bodies stand; by default the start of the stage.

    Returns:
        The stage in metres and kilograms, with a prim for each instance of a body. Its layers are untouched; all that
        is in its session, which holds the values of that moment, too.

    Raises:
        InputError: The file is missing, is not USD or does not compose.
    """
    stage, apart = open_apart(path, time_code)
    with readable(str(path)):
        complete_instances(apart)
    return stage


def open_apart(path: str | os.PathLike, time_code: float | None = None) -> tuple[Usd.Stage, list[AlikeBalls]]:
    """Open a stage as :func:`open_stage` does, but for instances that are like others.

    Returns:
        The stage, and the instances that :func:`complete_instances` makes prims of.
    """
    file = usable_path(path)
    if not os.path.isfile(file):
        raise InputError(f"{path}: no such file")
    if reason := first_reading(full_path(file)):
        raise InputError(f"{path}: {reason}")
    stage = _open(file, path)
    with readable(str(path)):
        time_code = start_of(stage) if time_code is None else time_code
        apart = expand_instancers(stage, time_code, apart=True)
        convert_units(stage)
        hold(stage, time_code)
    return stage, apart


def open_motion(path: str | os.PathLike) -> tuple[Usd.Stage, list[Swarm]]:
    """Open a stage as it moves, held at no moment, in its own units.

    It is read in this process at once: to read a long run's samples in a process of their own first would take longer
    than to export them.

    Returns:
        The stage, with a prim for each instance of a body, and the instancers whose balls have none.

    Raises:
        InputError: The file is missing, is not USD, does not compose, or has instancers that make no sense.
    """
    file = usable_path(path)
    if not os.path.isfile(file):
        raise InputError(f"{path}: no such file")
    stage = _open(file, path)
    with readable(str(path)):
        apart = expand_instancers(stage, start_of(stage), apart=True)
        complete_instances([one for one in apart if not one.whole])
        return stage, swarms_of(stage, apart)


def _open(file: Path, path: str | os.PathLike) -> Usd.Stage:
    """Open a file that is there; ``path`` is what messages call it."""
    with readable(str(path), NOT_USD):
        stage = Usd.Stage.Open(str(full_path(file)))
        _refresh(stage)
        broken = [str(error) for error in stage.GetCompositionErrors()]
    if broken:
        raise InputError(f"{path}: {line_of(broken[0])}")
    check_rates(stage)
    return stage


def _refresh(stage: Usd.Stage) -> None:
    """Read layers again whose files have changed since this process read them, but for those with unsaved edits."""
    for layer in stage.GetUsedLayers():
        if layer.realPath and not layer.dirty:
            layer.Reload()


@quiet()
def hold(stage: Usd.Stage, time_code: float) -> None:
    """Make the values of ``time_code`` the defaults of the stage, in its session layer.

    Newton reads default values only: a pose that is given by time samples alone would be the identity. Inside instances
    nothing can be held; :func:`survey` finds what would be wrong there. The order of transform operations stays: USD
    itself never asks for its samples. Addresses of a network are blocked. Colliders that keys move and that are no
    rigid bodies become kinematic ones.

    Raises:
        InputError: Time samples are of another type than their attribute, an address cannot be blocked, or what keys
            move cannot become a body.
    """
    session = stage.GetSessionLayer()
    candidates = [
        attribute
        for prim in stage.Traverse()
        for attribute in prim.GetAuthoredAttributes()
        if attribute.GetNumTimeSamples() or attribute.HasSpline() or session.GetAttributeAtPath(attribute.GetPath())
    ]
    sampled = [attribute for attribute in candidates if _uncover(attribute, session)]
    values = [(attribute, _at(attribute, time_code)) for attribute in sampled if attribute.GetName() != _ORDER]
    with Usd.EditContext(stage, session):
        for attribute, value in values:
            if value is not None:
                attribute.Set(value)
            else:  # blocked at that time: as if it had never been authored
                attribute.Block()
    cut_off(stage)
    make_kinematic(
        stage, {one.GetPrim().GetPath() for one in sampled if one.GetName().startswith("xformOp:")}, is_source
    )


def _uncover(attribute: Usd.Attribute, session: Sdf.Layer) -> bool:
    """Take away what an earlier call held, which would hide samples; return whether there are any, or a spline."""
    spec = session.GetAttributeAtPath(attribute.GetPath())
    held = spec.default if spec else None
    if spec:
        spec.ClearDefaultValue()
    if attribute.GetNumTimeSamples() or attribute.HasSpline():
        return True
    if held is not None:  # written for another reason
        spec.default = held
    return False


def _at(attribute, time_code):
    prim, name = attribute.GetPrim(), attribute.GetName()
    try:
        value = attribute.Get(time_code)
    except Tf.ErrorException:
        raise InputError(f"{prim.GetPath()}: {name} has time samples that USD cannot read") from None
    if value is not None:
        check_type(prim, name, value, declared(attribute))
    return value


def read_magnets(stage: Usd.Stage) -> StageMagnets:
    """Read and check the magnets and the magnetic settings of a stage.

    Raises:
        InputError: The first error of :func:`survey`, naming the prim.
    """
    contents = survey(stage)
    for finding in contents.findings:
        if finding.severity == "error":
            raise InputError(str(finding))
    return StageMagnets(contents.magnets, contents.settings, contents.initial_moments)


def first_camera(stage: Usd.Stage) -> Usd.Prim | None:
    """Return the first camera of a stage with perspective; None where there is none."""
    for prim in stage.Traverse():
        if prim.IsA(UsdGeom.Camera) and UsdGeom.Camera(prim).GetProjectionAttr().Get() == UsdGeom.Tokens.perspective:
            return prim
    return None


def describe(path: str | os.PathLike) -> str:
    """Return the first line of a stage's documentation, without composing it."""
    layer = Sdf.Layer.OpenAsAnonymous(str(path), metadataOnly=True)
    return (layer.documentation.strip().splitlines() or [""])[0]


@quiet()
def survey(stage: Usd.Stage) -> StageContents:
    """Find out what a stage holds and everything that is wrong with it."""
    contents = StageContents()
    contents.findings += [*_metadata_findings(stage), *unit_findings(stage)]
    unsaved = "has edits in this process that are not saved: a run has them, and writes a copy of the scene with them"
    contents.findings += [Finding(layer.realPath, unsaved, "warning") for layer in unsaved_layers(stage)]
    prims = list(Usd.PrimRange.Stage(stage, Usd.TraverseInstanceProxies()))
    transforms, keys = TransformCheck(), KeyReader(stage)
    for prim in prims:
        _read_prim(prim, transforms, keys, contents)
    _read_scene(stage, prims, keys, contents)
    for prim in prims:
        if has_api(prim, MAGNET_API):
            _read_magnet(prim, transforms, keys, contents)
        contents.findings += stray_findings(prim)
        if is_source(prim):
            _read_sources(prim, transforms, keys, contents)
    moved = [prim for prim in prims if prim.IsInstanceProxy() and (is_body(prim) or has_api(prim, MAGNET_API))]
    contents.findings += instance_findings(instances_around(moved))
    contents.findings += material_findings([prim for prim in prims if str(prim.GetPath()) in contents.colliders])
    if not any(has_api(prim, MAGNET_API) for prim in prims):
        contents.findings.append(Finding(stage_name(stage), f"no magnets: no prim has {MAGNET_API} applied"))
    return contents


def copied_metadata(root: Sdf.Layer) -> list[str]:
    """Return the names of those metadata of a root layer that a root above it has to repeat."""
    return [key for key in root.pseudoRoot.ListInfoKeys() if key not in _COMPOSED]


def _metadata_findings(stage) -> Iterator[Finding]:
    """Yield which metadata of the stage cannot be read, of a file that is damaged; a run copies them."""
    root = stage.GetRootLayer()
    for key in copied_metadata(root):
        try:
            root.pseudoRoot.GetInfo(key)
        except (UnicodeDecodeError, Tf.ErrorException) as error:
            yield Finding(stage_name(stage), f"{key} cannot be read ({failure(error)})")


def _read_prim(prim, transforms, keys, contents) -> None:
    """Note what a prim is for rigid bodies, and what is wrong with it."""
    path = str(prim.GetPath())
    body, collider = is_body(prim), is_collider(prim)
    faults = list(transforms.findings(prim)) if body or collider else []
    if body:
        contents.bodies.append(path)
        if UsdPhysics.RigidBodyAPI(prim).GetKinematicEnabledAttr().Get():
            contents.kinematic.append(path)
            faults += _read_motion(prim, keys, contents) if transforms.is_sound(prim) and not faults else ()
    if collider:
        contents.colliders.append(path)
        owner = None if body else _body_above(prim)
        if owner and keys.moves(prim, owner):
            message = f"keys move it within its rigid body {owner.GetPath()}, which keeps its shape"
            contents.findings.append(Finding(path, message, "warning"))
    faults += attribute_findings(prim, shape=body or collider)
    if collider and not faults and transforms.is_sound(prim):
        faults += shape_findings(prim)
    elif prim.IsA(UsdGeom.Mesh) and not collider:
        faults += mesh_findings(prim)
    contents.findings += faults


def _read_motion(prim, keys, contents) -> Iterator[Finding]:
    """Note how keys move a kinematic body; yield why it cannot follow them."""
    path = str(prim.GetPath())
    try:
        if keys.moves(prim):
            contents.motions[path] = motion = keys.motion(prim)
            yield from keys.findings(prim, motion)
    except InputError as error:
        yield finding_of(path, error)


def _read_scene(stage, prims, keys, contents) -> None:
    """Read the magnetic settings of the first physics scene, the one that Newton takes."""
    found = scenes(stage)
    for prim in prims:
        if has_api(prim, SCENE_API) and not prim.IsA(UsdPhysics.Scene):
            contents.findings.append(Finding(str(prim.GetPath()), f"{SCENE_API} on a prim that is not a PhysicsScene"))
    for prim in found[1:]:
        contents.findings.append(Finding(str(prim.GetPath()), "one PhysicsScene of several: only the first is read"))
    for prim in found[:1]:
        contents.findings += declaration_findings(prim)
    if found and has_api(found[0], SCENE_API):
        try:
            contents.settings = settings_of(found[0])
            contents.field_keys = field_keys(found[0], keys)
        except InputError as error:
            contents.findings.append(finding_of(str(found[0].GetPath()), error))


def _read_magnet(prim, transforms, keys, contents) -> None:
    """Read one magnet into ``contents``, or what is wrong with it."""
    path = str(prim.GetPath())
    body, collider = is_body(prim), is_collider(prim)
    if not (body or collider):
        contents.findings.append(
            Finding(path, f"{MAGNET_API} on a prim that is neither an enabled rigid body nor an enabled collider")
        )
    elif not any(is_collider(one) and is_solid(one) for one in prims_of_magnet(prim)):
        contents.findings.append(Finding(path, "a magnet without colliders that are solid: no shape to magnetize"))
    elif not body and (owner := _body_above(prim)) and has_api(owner, MAGNET_API):
        contents.findings.append(Finding(path, f"its rigid body {owner.GetPath()} is a magnet already"))
    try:
        contents.magnets[path] = magnet = magnet_of(prim)
        if curve := magnetization_keys(prim, magnet, keys):
            contents.magnetization_keys[path] = curve
        contents.findings += kind_findings(prim, magnet, keyed=curve is not None)
        if moment := moment_of(prim):
            contents.initial_moments[path] = moment
    except InputError as error:
        contents.findings.append(finding_of(path, error))
    faulty = {finding.where for finding in contents.findings if finding.severity == "error"}
    sound = [
        one
        for one in prims_of_magnet(prim)
        if is_collider(one) and is_solid(one) and str(one.GetPath()) not in faulty and transforms.is_sound(one)
    ]
    contents.findings += [finding for one in sound for finding in magnet_findings(one)]
    if path in contents.magnets and path not in faulty:
        contents.findings += spacing_findings(prim, sound, contents.magnets[path].moment_spacing)


def _read_sources(prim, transforms, keys, contents) -> None:
    """Read the coil and the field map of a prim into ``contents``, or what is wrong with them."""
    for found in sources_of(prim, transforms, keys):
        if isinstance(found, Finding):
            contents.findings.append(found)
        else:
            contents.sources.setdefault(str(prim.GetPath()), []).append(found)


def prims_of_magnet(prim) -> Iterator[Usd.Prim]:
    """Yield the prims that a magnet on ``prim`` may cover: all that move with a body, or a collider alone."""
    return _prims_of_body(prim) if is_body(prim) else iter((prim,))


def _prims_of_body(body) -> Iterator[Usd.Prim]:
    """Yield the prims that move with ``body``: its subtree without the bodies nested in it."""
    prims = iter(Usd.PrimRange(body, Usd.TraverseInstanceProxies()))
    for prim in prims:
        if prim != body and is_body(prim):
            prims.PruneChildren()
        else:
            yield prim


def _body_above(prim) -> Usd.Prim | None:
    while prim and not prim.IsPseudoRoot():
        if is_body(prim):
            return prim
        prim = prim.GetParent()
    return None
