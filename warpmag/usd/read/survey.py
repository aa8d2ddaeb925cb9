"""Surveys a stage: its magnets, bodies and settings, with errors and warnings.

Before Newton imports the stage, the survey reports content that the importer would silently misread: values
(``values.py``), transforms (``transforms.py``), sizes and meshes (``geometry.py``), units and time (``clock.py``), and
here prims declared as magnets that cannot be magnets.
"""

from collections.abc import Iterator
from dataclasses import dataclass, field

from pxr import Tf, Usd, UsdGeom, UsdPhysics

from warpmag.declarations.keys import Keys, Motion
from warpmag.declarations.magnets import Magnet, MagneticSettings, StageMagnets
from warpmag.errors import InputError
from warpmag.usd.read.clock import scenes, stage_name, unit_findings
from warpmag.usd.read.coils import PlacedSource, is_source, sources_of
from warpmag.usd.read.geometry import magnet_findings, mesh_findings, shape_findings, spacing_findings
from warpmag.usd.read.input_errors import first_line
from warpmag.usd.read.keys import KeyReader, field_keys, magnetization_keys
from warpmag.usd.read.materials import material_findings
from warpmag.usd.read.mujoco_field import with_mujoco_field
from warpmag.usd.read.opening import copied_metadata
from warpmag.usd.read.prims import body_of, is_body, is_collider, is_solid, prims_of_magnet
from warpmag.usd.read.session import instance_findings, instances_around, unsaved_layers
from warpmag.usd.read.transforms import TransformCheck
from warpmag.usd.read.unused_attributes import kind_findings, stray_findings
from warpmag.usd.schemas import MAGNET_API, SCENE_API, has_api, magnet_of, moment_of, settings_of
from warpmag.usd.values import Finding, attribute_findings, check_stage, declaration_findings, finding_of, quiet


@dataclass
class StageContents:
    """Contents of a stage and errors in it; paths are in the order of the stage."""

    bodies: list[str] = field(default_factory=list)  # rigid bodies, including kinematic ones
    kinematic: list[str] = field(default_factory=list)  # kinematic bodies
    colliders: list[str] = field(default_factory=list)
    magnets: dict[str, Magnet] = field(default_factory=dict)  # magnets with valid attributes
    initial_moments: dict[str, tuple[float, float, float]] = field(default_factory=dict)  # authored [A·m²], world frame
    sources: dict[str, list[PlacedSource]] = field(default_factory=dict)  # valid coils and field maps of each prim
    settings: MagneticSettings = field(default_factory=MagneticSettings)  # of the first physics scene
    motions: dict[str, Motion] = field(default_factory=dict)  # keys of kinematic bodies, at time codes
    field_keys: Keys | None = None  # of the external field [A/m] at time codes, None where it is constant
    magnetization_keys: dict[str, Keys] = field(default_factory=dict)  # of magnets with variable magnetization [A/m]
    findings: list[Finding] = field(default_factory=list)  # errors and warnings


def read_magnets(stage: Usd.Stage) -> StageMagnets:
    """Read and check the magnets and the magnetic settings of a stage.

    Raises:
        InputError: The stage has an error; the message names the prim of the first one. Or ``stage`` is not a stage.
    """
    check_stage(stage)
    contents = survey(stage)
    for finding in contents.findings:
        if finding.severity == "error":
            raise InputError(str(finding))
    return StageMagnets(contents.magnets, contents.settings, contents.initial_moments)


@quiet()
def survey(stage: Usd.Stage) -> StageContents:
    """Return the contents of a stage, with all errors and warnings."""
    contents = StageContents()
    contents.findings += [*_metadata_findings(stage), *unit_findings(stage)]
    unsaved = "has unsaved edits in this process: a run uses them, and writes a copy of the scene with them"
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
    moving = [prim for prim in prims if prim.IsInstanceProxy() and (is_body(prim) or has_api(prim, MAGNET_API))]
    contents.findings += instance_findings(instances_around(moving))
    contents.findings += material_findings([prim for prim in prims if str(prim.GetPath()) in contents.colliders])
    if not any(has_api(prim, MAGNET_API) for prim in prims):
        contents.findings.append(Finding(stage_name(stage), f"no magnets: no prim has {MAGNET_API} applied"))
    return contents


def _metadata_findings(stage) -> Iterator[Finding]:
    """Yield errors for metadata of the stage that cannot be read; a run copies metadata."""
    root = stage.GetRootLayer()
    for key in copied_metadata(root):
        try:
            root.pseudoRoot.GetInfo(key)
        except (UnicodeDecodeError, Tf.ErrorException) as error:
            yield Finding(stage_name(stage), f"{key} cannot be read ({first_line(error)})")


def _read_prim(prim, transforms, keys, contents) -> None:
    """Add a prim's role for rigid bodies to ``contents``, and its errors."""
    path = str(prim.GetPath())
    body, collider = is_body(prim), is_collider(prim)
    faults = list(transforms.findings(prim)) if body or collider else []
    if body:
        contents.bodies.append(path)
        if UsdPhysics.RigidBodyAPI(prim).GetKinematicEnabledAttr().Get():
            contents.kinematic.append(path)
            faults += _read_motion(prim, keys, contents) if transforms.is_valid(prim) and not faults else ()
    if collider:
        contents.colliders.append(path)
        owner = None if body else body_of(prim)
        if owner and keys.moves(prim, owner):
            message = f"keys move it within its rigid body {owner.GetPath()}, which keeps its shape"
            contents.findings.append(Finding(path, message, "warning"))
    faults += attribute_findings(prim, shape=body or collider)
    has_errors = any(fault.severity == "error" for fault in faults)
    if collider and not has_errors and transforms.is_valid(prim):
        faults += shape_findings(prim)
    elif prim.IsA(UsdGeom.Mesh) and not collider:
        faults += mesh_findings(prim)
    contents.findings += faults


def _read_motion(prim, keys, contents) -> Iterator[Finding]:
    """Add the keys of a kinematic body to ``contents``; yield errors in them."""
    path = str(prim.GetPath())
    try:
        if keys.moves(prim):
            contents.motions[path] = motion = keys.motion(prim)
            yield from keys.findings(prim, motion)
    except InputError as error:
        yield finding_of(path, error)


def _read_scene(stage, prims, keys, contents) -> None:
    """Read the magnetic settings of the first physics scene, the one that Newton reads."""
    physics_scenes = scenes(stage)
    for prim in prims:
        if has_api(prim, SCENE_API) and not prim.IsA(UsdPhysics.Scene):
            contents.findings.append(Finding(str(prim.GetPath()), f"{SCENE_API} on a prim that is not a PhysicsScene"))
    for prim in physics_scenes[1:]:
        contents.findings.append(Finding(str(prim.GetPath()), "one PhysicsScene of several: only the first is read"))
    for prim in physics_scenes[:1]:
        contents.findings += declaration_findings(prim)
        try:
            if has_api(prim, SCENE_API):
                contents.settings = settings_of(prim)
                contents.field_keys = field_keys(prim, keys)
            contents.settings, warnings = with_mujoco_field(prim, contents.settings)
            contents.findings += warnings
        except InputError as error:
            contents.findings.append(finding_of(str(prim.GetPath()), error))


def _read_magnet(prim, transforms, keys, contents) -> None:
    """Add one magnet to ``contents``, and its errors."""
    path = str(prim.GetPath())
    body, collider = is_body(prim), is_collider(prim)
    if not (body or collider):
        message = f"{MAGNET_API} on a prim that is neither an enabled rigid body nor an enabled collider"
        contents.findings.append(Finding(path, message))
    elif not any(is_collider(part) and is_solid(part) for part in prims_of_magnet(prim)):
        contents.findings.append(Finding(path, "a magnet without colliders that are solid: no shape to magnetize"))
    elif not body and (owner := body_of(prim)) and has_api(owner, MAGNET_API):
        contents.findings.append(Finding(path, f"its rigid body {owner.GetPath()} is a magnet already"))
    try:
        contents.magnets[path] = magnet = magnet_of(prim)
        if magnet_keys := magnetization_keys(prim, magnet, keys):
            contents.magnetization_keys[path] = magnet_keys
        contents.findings += kind_findings(prim, magnet, keyed=magnet_keys is not None)
        if moment := moment_of(prim):
            contents.initial_moments[path] = moment
    except InputError as error:
        contents.findings.append(finding_of(path, error))
    faulty = {finding.where for finding in contents.findings if finding.severity == "error"}
    valid_parts = [
        part
        for part in prims_of_magnet(prim)
        if is_collider(part) and is_solid(part) and str(part.GetPath()) not in faulty and transforms.is_valid(part)
    ]
    contents.findings += [finding for part in valid_parts for finding in magnet_findings(part)]
    if path in contents.magnets and path not in faulty:
        contents.findings += spacing_findings(prim, valid_parts, contents.magnets[path].moment_spacing)


def _read_sources(prim, transforms, keys, contents) -> None:
    """Add the coil and the field map of a prim to ``contents``, and their errors."""
    for source in sources_of(prim, transforms, keys):
        if isinstance(source, Finding):
            contents.findings.append(source)
        else:
            contents.sources.setdefault(str(prim.GetPath()), []).append(source)
