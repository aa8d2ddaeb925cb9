"""Opens USD stages, and makes the values of one time code their defaults.

Newton imports neither PointInstancers of bodies, nor units other than meters and kilograms, nor time samples, and it
would fetch textures from network addresses. Layers of the session therefore hold prims for instances
(``instancers.py``), converted units (``units.py``) and the values of one time code; the scene's own layers stay
unchanged.
"""

import math
import os
import re
from collections.abc import Sized
from functools import cache
from pathlib import Path

from pxr import Sdf, Tf, Usd, UsdGeom

from warpmag.declarations.checks import real_number
from warpmag.errors import InputError
from warpmag.usd.paths import full_path, usable_path
from warpmag.usd.read.ball_instancers import BallInstancer, ball_instancers
from warpmag.usd.read.clock import check_rates, start_of
from warpmag.usd.read.coils import is_source
from warpmag.usd.read.identical_balls import IdenticalBalls
from warpmag.usd.read.input_errors import NOT_USD, one_line_of, usd_errors
from warpmag.usd.read.instancers import complete_instances, expand_instancers
from warpmag.usd.read.keys import make_kinematic
from warpmag.usd.read.prims import descendants
from warpmag.usd.read.trial_read import MOST_NAMES, irregular_file, trial_read
from warpmag.usd.read.units import convert_units
from warpmag.usd.values import check_type, declared, quiet

_ORDER = "xformOpOrder"
_ADDRESS = re.compile(r"[\x00-\x20]*([A-Za-z][A-Za-z0-9+.-]+:/|file:)", re.IGNORECASE)
"""Beginning of an address, of a network or of a file; a Windows drive has one letter."""
_SHADING = ("inputs", "outputs")
"""Namespaces of the attributes that shaders connect; a connection leads to a value in either."""
_COMPOSED = ("subLayers", "subLayerOffsets", "layerRelocates")
"""Metadata of a layer that layers above it inherit."""


def open_stage(path: str | os.PathLike, time_code: float | None = None) -> Usd.Stage:
    """Open a stage with the values of one time code as its defaults.

    Args:
        path: USD file.
        time_code: The time code; by default the start of the stage.

    Returns:
        The stage in meters and kilograms, with prims for each instance of a body. Its layers are unchanged; all
        additions are in its session layer.

    Raises:
        InputError: The file is missing, is not USD or does not compose, or ``time_code`` is not a finite number.
    """
    if time_code is not None:
        time_code = real_number("time_code", time_code)
        if not math.isfinite(time_code):
            raise InputError(f"time_code: must be finite, got {time_code}")
    stage, deferred = open_deferred(path, time_code)
    with usd_errors(str(path)):
        complete_instances(deferred)
    return stage


def open_deferred(path: str | os.PathLike, time_code: float | None = None) -> tuple[Usd.Stage, list[IdenticalBalls]]:
    """Open a stage like :func:`open_stage`; return it with the identical balls whose prims are not created yet."""
    stage = _open(path)
    with usd_errors(str(path)):
        time_code = start_of(stage) if time_code is None else time_code
        deferred = expand_instancers(stage, time_code, defer=True)
        convert_units(stage)
        freeze(stage, time_code)
    return stage, deferred


def open_animated(path: str | os.PathLike) -> tuple[Usd.Stage, list[BallInstancer]]:
    """Open a stage with its time samples, in its own units; return it with the instancers whose balls have no prims."""
    stage = _open(path)
    with usd_errors(str(path)):
        deferred = expand_instancers(stage, start_of(stage), defer=True)
        complete_instances([balls for balls in deferred if not balls.stays_instancer])
        return stage, ball_instancers(stage, deferred)


def _readable(path: str | os.PathLike) -> Path:
    """Return a path that USD can name; raises :class:`InputError` unless it can be opened for reading."""
    file = usable_path(path)
    if not os.path.isfile(file):
        raise InputError(f"{path}: no such file")
    try:
        with open(file, "rb"):
            return file
    except OSError as error:
        raise InputError(f"{path}: cannot be read ({error.strerror})") from None


def _open(path: str | os.PathLike) -> Usd.Stage:
    """Open a user's stage, after a trial read in a child process. All functions that read a stage open it here."""
    file = full_path(_readable(path))
    if reason := trial_read(file):
        raise InputError(f"{path}: {reason}")
    with usd_errors(str(path), NOT_USD):
        stage = Usd.Stage.Open(str(file))
        for layer in stage.GetUsedLayers():
            if layer.realPath and not layer.dirty:  # its file may have changed since it was read
                layer.Reload()
        broken = [str(error) for error in stage.GetCompositionErrors()]
    if broken:
        raise InputError(f"{path}: {one_line_of(broken[0])}")
    check_rates(stage)
    return stage


@quiet()
def freeze(stage: Usd.Stage, time_code: float) -> None:
    """Make the values of ``time_code`` the defaults of the stage, in its session layer.

    Newton reads default values only: it would read a pose that has only time samples as the identity. Values inside
    instances cannot be frozen; :func:`warpmag.usd.survey` reports relevant ones. USD ignores time samples of the
    order of transform operations, so that order stays. Textures that are not files are blocked. Animated colliders
    without a rigid body become kinematic bodies.
    """
    session = stage.GetSessionLayer()
    candidates = [
        attribute
        for prim in stage.Traverse()
        if _is_bounded(prim)
        for attribute in prim.GetAuthoredAttributes()
        if attribute.GetNumTimeSamples() or attribute.HasSpline() or session.GetAttributeAtPath(attribute.GetPath())
    ]
    sampled = [attribute for attribute in candidates if _unfreeze(attribute, session)]
    values = [(attribute, _value_at(attribute, time_code)) for attribute in sampled if attribute.GetName() != _ORDER]
    with Usd.EditContext(stage, session):
        for attribute, value in values:
            if value is not None:
                attribute.Set(value)
            else:  # a blocked sample: as if nothing were authored
                attribute.Block()
    _block_textures(stage)
    transforms = [attribute for attribute in sampled if attribute.GetName().startswith("xformOp:")]
    make_kinematic(stage, {attribute.GetPrim().GetPath() for attribute in transforms}, is_source)


def _is_bounded(prim: Usd.Prim) -> bool:
    """Return True; raise :class:`InputError` for more transform operations than Newton composes in linear time."""
    order = prim.GetAttribute(_ORDER).Get() if prim.HasAttribute(_ORDER) else None
    if isinstance(order, Sized) and len(order) > MOST_NAMES:
        raise InputError(f"{prim.GetPath()}: has {len(order)} transform operations, at most {MOST_NAMES}")
    return True


def _unfreeze(attribute: Usd.Attribute, session: Sdf.Layer) -> bool:
    """Remove the value of an earlier :func:`freeze`; return True if the attribute has time samples or a spline."""
    spec = session.GetAttributeAtPath(attribute.GetPath())
    value = spec.default if spec else None
    if spec:
        spec.ClearDefaultValue()
    if attribute.GetNumTimeSamples() or attribute.HasSpline():
        return True
    if value is not None:  # written by something else
        spec.default = value
    return False


def _value_at(attribute, time_code):
    prim, name = attribute.GetPrim(), attribute.GetName()
    try:
        value = attribute.Get(time_code)
    except Tf.ErrorException:
        raise InputError(f"{prim.GetPath()}: {name} has time samples that USD cannot read") from None
    if value is not None:
        check_type(prim, name, value, declared(attribute))
    return value


def _block_textures(stage: Usd.Stage) -> None:
    """Block, in the session layer, the values of shaders that Newton could open as anything but a regular file.

    Newton follows connections to values of any type, and would fetch textures from network addresses.
    """
    irregular = cache(irregular_file)
    blocked = [
        (attribute, text)
        for prim in descendants(stage.GetPseudoRoot())
        for namespace in _SHADING
        for attribute in prim.GetAuthoredPropertiesInNamespace(namespace)
        if isinstance(attribute, Usd.Attribute)
        for text in _texts(attribute.Get())
        if _ADDRESS.match(text) or any(map(irregular, _files(attribute, text)))
    ]
    with Usd.EditContext(stage, stage.GetSessionLayer()):
        for attribute, text in blocked:
            prim = attribute.GetPrim()
            if prim.IsInstanceProxy():
                raise InputError(
                    f"{prim.GetPath()}: {attribute.GetName()} is {text[:80]!r} inside an instance, and nothing is "
                    "fetched from a network or a device: name a file, or set instanceable = false"
                )
            attribute.Block()


def _texts(value) -> list[str]:
    """Return the texts of a value, and of an array of assets or texts."""
    if isinstance(value, Sdf.AssetPathArray | list) or type(value).__name__ in ("StringArray", "TokenArray"):
        return [text for entry in value for text in _texts(entry)]
    texts = [value.path, value.resolvedPath] if isinstance(value, Sdf.AssetPath) else [value]
    return [text for text in texts if isinstance(text, str) and text]


def _files(attribute: Usd.Attribute, text: str) -> set[str]:
    """Return the paths that a text of an attribute may stand for, relative to its layers or to the working folder."""
    layers = {spec.layer for spec in attribute.GetPropertyStack()} | {attribute.GetStage().GetRootLayer()}
    return {text, *(Sdf.ComputeAssetPathRelativeToLayer(layer, text) for layer in layers if not layer.anonymous)}


def perspective_cameras(stage: Usd.Stage) -> list[Usd.Prim]:
    """Return the perspective cameras of a stage, in its order."""
    cameras = [prim for prim in stage.Traverse() if prim.IsA(UsdGeom.Camera)]
    perspective = UsdGeom.Tokens.perspective
    return [prim for prim in cameras if UsdGeom.Camera(prim).GetProjectionAttr().Get() == perspective]


def describe(path: str | os.PathLike) -> str:
    """Return the first line of the documentation of a trusted stage, such as a bundled one, without composing it."""
    layer = Sdf.Layer.OpenAsAnonymous(str(path), metadataOnly=True)
    return (layer.documentation.strip().splitlines() or [""])[0]


def copied_metadata(root: Sdf.Layer) -> list[str]:
    """Return the names of a root layer's metadata that a root layer above it must repeat."""
    return [key for key in root.pseudoRoot.ListInfoKeys() if key not in _COMPOSED]
