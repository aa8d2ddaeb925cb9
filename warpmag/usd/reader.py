"""Opens USD stages and reads what they say about magnets and time.

Everything that Newton's importer would read wrong without a word is found here and refused: stages that are not in
metres and kilograms, bodies inside a PointInstancer, transforms and sizes that are not finite and positive.
"""

import math
import os
from collections.abc import Iterator
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np
from pxr import Sdf, Tf, Usd, UsdGeom, UsdPhysics, UsdUtils

from warpmag.errors import InputError
from warpmag.magnets import Magnet, MagneticSettings, StageMagnets
from warpmag.usd.schemas import MAGNET_API, MOMENT, SCENE_API, has_api, magnet_of, settings_of

_SIZES = ("radius", "size", "height")
_MASSES = ("physics:mass", "physics:density")
_VELOCITIES = ("physics:velocity", "physics:angularVelocity")


@dataclass(frozen=True)
class Finding:
    """Something wrong with a stage.

    Attributes:
        where: Path of the prim, or the name of the stage.
        message: What is wrong with it.
        severity: ``error`` (a run refuses the stage) or ``warning``.
    """

    where: str
    message: str
    severity: str = "error"

    def __str__(self) -> str:
        """One line that names the prim."""
        return f"{self.where}: {self.message}"


@dataclass(frozen=True)
class StageClock:
    """How time runs on a stage.

    Attributes:
        start: Time code of the start.
        end: Time code of the end; equal to ``start`` where the stage has no range.
        time_codes_per_second: Time codes that make a second.
        frames_per_second: Rate of the output frames [Hz].
        step: Time step of the physics [s], None where the stage does not say.
    """

    start: float
    end: float
    time_codes_per_second: float
    frames_per_second: float
    step: float | None


@dataclass
class StageContents:
    """What a stage holds and what is wrong with it, prim paths in the order of the stage.

    Attributes:
        bodies: Rigid bodies, kinematic ones included.
        kinematic: Kinematic bodies.
        colliders: Colliders.
        magnets: Magnets whose attributes are sound.
        initial_moments: Authored moments [A·m²], world frame.
        settings: Magnetic settings of the first physics scene.
        findings: Errors and warnings.
    """

    bodies: list[str] = field(default_factory=list)
    kinematic: list[str] = field(default_factory=list)
    colliders: list[str] = field(default_factory=list)
    magnets: dict[str, Magnet] = field(default_factory=dict)
    initial_moments: dict[str, tuple[float, float, float]] = field(default_factory=dict)
    settings: MagneticSettings = field(default_factory=MagneticSettings)
    findings: list[Finding] = field(default_factory=list)


def open_stage(path: str | os.PathLike, time_code: float | None = None) -> Usd.Stage:
    """Open a stage and hold it at one moment.

    Args:
        path: USD file.
        time_code: The moment at which bodies stand; by default the start of the stage.

    Returns:
        The stage. Its layers are untouched; only the session layer holds the values of that moment.

    Raises:
        InputError: The file is missing, is not USD or does not compose.
    """
    if not Path(path).is_file():
        raise InputError(f"{path}: no such file")
    silencer = UsdUtils.CoalescingDiagnosticDelegate()  # what USD has to say goes into the error, not to stderr
    try:
        stage = Usd.Stage.Open(str(path))
        broken = [str(error) for error in stage.GetCompositionErrors()]
    except Tf.ErrorException as error:
        # USD ends its list with "failed to open", the reasons stand before it.
        reasons = [one.commentary.strip().splitlines()[0] for one in error.args[:-1]]
        raise InputError(f"{path}: not a USD file{''.join(f' ({reason})' for reason in reasons[:1])}") from None
    finally:
        del silencer
    if broken:
        raise InputError(f"{path}: {' '.join(broken[0].split())}")
    hold(stage, stage.GetStartTimeCode() if time_code is None else time_code)
    return stage


def hold(stage: Usd.Stage, time_code: float) -> None:
    """Make the values of ``time_code`` the defaults of the stage, in its session layer.

    Newton reads default values only: a pose that is given by time samples alone would be the identity.
    """
    session = stage.GetSessionLayer()
    sampled = [
        attribute
        for prim in stage.Traverse()
        for attribute in prim.GetAuthoredAttributes()
        if attribute.GetNumTimeSamples() or session.GetAttributeAtPath(attribute.GetPath())
    ]
    for attribute in sampled:  # what an earlier call held would hide the samples
        if spec := session.GetAttributeAtPath(attribute.GetPath()):
            spec.ClearDefaultValue()
    values = [(attribute, attribute.Get(time_code)) for attribute in sampled]
    with Usd.EditContext(stage, session):
        for attribute, value in values:
            if value is not None:
                attribute.Set(value)


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


def stage_clock(stage: Usd.Stage) -> StageClock:
    """Read how time runs on a stage; raises :class:`InputError` where its rates make no sense."""
    name = stage_name(stage)
    codes = stage.GetTimeCodesPerSecond()
    frames = stage.GetFramesPerSecond() if stage.HasAuthoredMetadata("framesPerSecond") else codes
    for what, rate in (("timeCodesPerSecond", codes), ("framesPerSecond", frames)):
        if not (rate > 0.0 and math.isfinite(rate)):
            raise InputError(f"{name}: {what} must be positive and finite, got {rate}")
    step = None
    scenes = _scenes(stage)
    steps = scenes[0].GetAttribute("newton:timeStepsPerSecond") if scenes else None
    if steps and steps.HasAuthoredValue():
        if not steps.Get() > 0:
            raise InputError(f"{scenes[0].GetPath()}: newton:timeStepsPerSecond must be positive, got {steps.Get()}")
        step = 1.0 / steps.Get()
    start = stage.GetStartTimeCode()
    return StageClock(start, max(start, stage.GetEndTimeCode()), codes, frames, step)


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


def stage_name(stage: Usd.Stage) -> str:
    """Return the name by which messages call a stage."""
    return stage.GetRootLayer().realPath or "stage"


def is_animated(prim: Usd.Prim) -> bool:
    """Whether a layer gives time samples for the prim's own transform, held or not."""
    return prim.IsA(UsdGeom.Xformable) and any(
        spec.HasInfo("timeSamples")
        for operation in UsdGeom.Xformable(prim).GetOrderedXformOps()
        for spec in operation.GetAttr().GetPropertyStack()
    )


def survey(stage: Usd.Stage) -> StageContents:
    """Find out what a stage holds and everything that is wrong with it."""
    contents = StageContents()
    contents.findings += _unit_findings(stage)
    prims = list(Usd.PrimRange.Stage(stage, Usd.TraverseInstanceProxies()))
    inside = _instanced_prims(stage, prims, contents.findings)
    transforms = _TransformCheck()
    for prim in prims:
        path = str(prim.GetPath())
        if path in inside:
            continue
        body, collider = _is_body(prim), _is_collider(prim)
        if body:
            contents.bodies.append(path)
            if UsdPhysics.RigidBodyAPI(prim).GetKinematicEnabledAttr().Get():
                contents.kinematic.append(path)
                if is_animated(prim):
                    contents.findings.append(Finding(path, "animated and kinematic: a run holds it still", "warning"))
        if collider:
            contents.colliders.append(path)
        if body or collider:
            contents.findings += transforms.findings(prim)
            contents.findings += _value_findings(prim)
    _read_scene(stage, prims, contents)
    for prim in prims:
        if has_api(prim, MAGNET_API) and str(prim.GetPath()) not in inside:
            _read_magnet(prim, contents)
    if not any(has_api(prim, MAGNET_API) for prim in prims):
        contents.findings.append(Finding(stage_name(stage), f"no magnets: no prim has {MAGNET_API} applied"))
    return contents


def _is_body(prim) -> bool:
    return prim.HasAPI(UsdPhysics.RigidBodyAPI) and bool(UsdPhysics.RigidBodyAPI(prim).GetRigidBodyEnabledAttr().Get())


def _is_collider(prim) -> bool:
    return prim.HasAPI(UsdPhysics.CollisionAPI) and bool(UsdPhysics.CollisionAPI(prim).GetCollisionEnabledAttr().Get())


def _unit_findings(stage) -> Iterator[Finding]:
    """Yield what the units of a stage get refused for: Newton's importer does not convert any."""
    metres = UsdGeom.GetStageMetersPerUnit(stage)
    kilograms = UsdPhysics.GetStageKilogramsPerUnit(stage)
    if not math.isclose(metres, 1.0):
        given = f"metersPerUnit is {metres:g}"
        if not UsdGeom.StageHasAuthoredMetersPerUnit(stage):
            given = f"metersPerUnit is not set, which in USD means {metres:g}"
        yield Finding(
            stage_name(stage),
            f"{given}, only metres are read; to convert, multiply lengths, velocities and gravity by {metres:g}, "
            f"densities by {metres**-3:g} and inertias by {metres**2:g}, and set metersPerUnit = 1",
        )
    if not math.isclose(kilograms, 1.0):
        yield Finding(
            stage_name(stage),
            f"kilogramsPerUnit is {kilograms:g}, only kilograms are read; to convert, multiply masses, densities and "
            f"inertias by {kilograms:g} and set kilogramsPerUnit = 1",
        )


def _instanced_prims(stage, prims, findings) -> set[str]:
    """Refuse bodies and magnets in point instancers; return the paths of all prims that belong to an instancer."""
    inside = set()
    for prim in prims:
        if not prim.IsA(UsdGeom.PointInstancer):
            continue
        targets = UsdGeom.PointInstancer(prim).GetPrototypesRel().GetForwardedTargets()
        roots = [prim, *(root for root in map(stage.GetPrimAtPath, targets) if root)]
        held = {one.GetPath(): one for root in roots for one in Usd.PrimRange(root, Usd.PrimAllPrimsPredicate)}
        inside |= {str(path) for path in held}
        if any(one.HasAPI(UsdPhysics.RigidBodyAPI) or has_api(one, MAGNET_API) for one in held.values()):
            findings.append(
                Finding(
                    str(prim.GetPath()),
                    "a PointInstancer of rigid bodies or magnets: Newton imports no bodies from an instancer; "
                    "give each body a prim of its own",
                )
            )
        elif any(one.HasAPI(UsdPhysics.CollisionAPI) for one in held.values()):
            findings.append(
                Finding(str(prim.GetPath()), "Newton imports no colliders from a PointInstancer", "warning")
            )
    return inside


class _TransformCheck:
    """Finds transforms that no rigid body can have, those that are not finite once, at the prim that causes it."""

    def __init__(self):
        self._cache = UsdGeom.XformCache(Usd.TimeCode.Default())
        self._sound = {}

    def findings(self, prim) -> Iterator[Finding]:
        yield from self._lineage_findings(prim)
        if not self._sound[prim.GetPath()]:
            return
        matrix = np.array(self._cache.GetLocalToWorldTransform(prim))[:3, :3]
        gram = matrix @ matrix.T
        # Rotation and scale leave the axes at right angles. Poses are often single precision: 1e-5.
        size = np.trace(gram) / 3.0
        if np.abs(gram - np.diag(np.diag(gram))).max() > 1e-5 * size:
            yield Finding(str(prim.GetPath()), "transform is sheared, which Newton imports wrong")
        elif _is_body(prim) and np.linalg.det(matrix) < 0.0:
            yield Finding(
                str(prim.GetPath()), "transform is mirrored, which Newton imports wrong: mirror the mesh instead"
            )
        elif prim.IsA(UsdGeom.Sphere) and np.abs(np.diag(gram) - size).max() > 1e-5 * size:
            yield Finding(str(prim.GetPath()), "a sphere scaled unevenly would be imported as a ball: make it a mesh")

    def _lineage_findings(self, prim) -> Iterator[Finding]:
        lineage = []
        while not prim.IsPseudoRoot() and prim.GetPath() not in self._sound:
            lineage.append(prim)
            prim = prim.GetParent()
        for prim in reversed(lineage):
            matrix, _ = self._cache.GetLocalTransformation(prim)
            finite = bool(np.isfinite(np.array(matrix)).all())
            flat = finite and matrix.GetDeterminant3() == 0.0
            self._sound[prim.GetPath()] = finite and not flat and self._sound.get(prim.GetParent().GetPath(), True)
            if not finite:
                yield Finding(str(prim.GetPath()), "transform is not finite")
            elif flat:
                yield Finding(str(prim.GetPath()), "transform has a scale of zero")


def _value_findings(prim) -> Iterator[Finding]:
    """Yield the sizes, masses, velocities and points of a body or collider that make no sense."""
    path = str(prim.GetPath())
    for name in _SIZES:
        value = prim.GetAttribute(name).Get() if prim.IsA(UsdGeom.Gprim) else None
        if value is not None and not (value > 0.0 and math.isfinite(value)):
            yield Finding(path, f"{name} must be positive and finite, got {value:g}")
    for name in _MASSES:
        value = prim.GetAttribute(name).Get()
        if value is not None and not (value >= 0.0 and math.isfinite(value)):
            yield Finding(path, f"{name} must not be negative and must be finite, got {value:g}")
    for name in _VELOCITIES:
        value = prim.GetAttribute(name).Get()
        if value is not None and not all(map(math.isfinite, value)):
            yield Finding(path, f"{name} must be finite, got {tuple(value)}")
    if prim.IsA(UsdGeom.PointBased):
        points = prim.GetAttribute("points").Get()
        if points is None or not len(points):
            yield Finding(path, "mesh has no points")
        elif not np.isfinite(np.array(points)).all():
            yield Finding(path, "points must be finite")


def _scenes(stage) -> list[Usd.Prim]:
    return [prim for prim in stage.Traverse() if prim.IsA(UsdPhysics.Scene)]


def _read_scene(stage, prims, contents) -> None:
    """Read the magnetic settings of the first physics scene, the one that Newton takes."""
    scenes = _scenes(stage)
    for prim in prims:
        if has_api(prim, SCENE_API) and not prim.IsA(UsdPhysics.Scene):
            contents.findings.append(Finding(str(prim.GetPath()), f"{SCENE_API} on a prim that is not a PhysicsScene"))
    for prim in scenes[1:]:
        contents.findings.append(Finding(str(prim.GetPath()), "one PhysicsScene of several: only the first is read"))
    if scenes:
        gravity = UsdPhysics.Scene(scenes[0])
        strength = gravity.GetGravityMagnitudeAttr().Get()
        if not strength < math.inf or not np.isfinite(gravity.GetGravityDirectionAttr().Get()).all():
            contents.findings.append(Finding(str(scenes[0].GetPath()), "gravity must be finite"))
    if scenes and has_api(scenes[0], SCENE_API):
        try:
            contents.settings = settings_of(scenes[0])
        except InputError as error:
            contents.findings.append(_named(scenes[0], error))


def _read_magnet(prim, contents) -> None:
    """Read one magnet into ``contents``, or what is wrong with it."""
    path = str(prim.GetPath())
    body, collider = _is_body(prim), _is_collider(prim)
    if not (body or collider):
        contents.findings.append(
            Finding(path, f"{MAGNET_API} on a prim that is neither an enabled rigid body nor an enabled collider")
        )
    elif not collider and not any(map(_is_collider, _prims_of_body(prim))):
        contents.findings.append(Finding(path, "a magnet without colliders: there is no shape to magnetize"))
    elif not body and (owner := _body_above(prim)) and has_api(owner, MAGNET_API):
        contents.findings.append(Finding(path, f"its rigid body {owner.GetPath()} is a magnet already"))
    try:
        contents.magnets[path] = magnet_of(prim)
    except InputError as error:
        contents.findings.append(_named(prim, error))
    moment = prim.GetAttribute(MOMENT)
    if moment and moment.HasAuthoredValue() and (value := moment.Get()) is not None:
        if all(map(math.isfinite, value)):
            contents.initial_moments[path] = tuple(value)
        else:
            contents.findings.append(Finding(path, f"{MOMENT} must be finite, got {tuple(value)}"))


def _prims_of_body(body) -> Iterator[Usd.Prim]:
    """Yield the prims that move with ``body``: its subtree without the bodies nested in it."""
    prims = iter(Usd.PrimRange(body, Usd.TraverseInstanceProxies()))
    for prim in prims:
        if prim != body and _is_body(prim):
            prims.PruneChildren()
        else:
            yield prim


def _body_above(prim) -> Usd.Prim | None:
    while prim and not prim.IsPseudoRoot():
        if _is_body(prim):
            return prim
        prim = prim.GetParent()
    return None


def _named(prim, error: InputError) -> Finding:
    path = str(prim.GetPath())
    return Finding(path, str(error).removeprefix(f"{path}: "))
