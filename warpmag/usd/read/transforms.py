"""Checks transforms: errors in their composition, and shear, mirroring or scale that a rigid body cannot have."""

from collections.abc import Iterator

import numpy as np
from pxr import Gf, Tf, Usd, UsdGeom

from warpmag.errors import InputError
from warpmag.usd.read.prims import is_body
from warpmag.usd.values import LARGEST_COORDINATE, Finding, finding_of, instance_finding, value_of

_RESET = "!resetXformStack!"
_INVERSE = "!invert!"
SCALE_TOLERANCE = 1e-5
"""Relative tolerance for equal scales and right angles of axes: poses are often in single precision."""
LEAST_SCALE = 1.1e-5
"""Least scale of a body: ``Gf.Transform``, by which USD's physics reads scales, makes 1e-10 of scales below 1e-5."""


def is_animated(prim: Usd.Prim) -> bool:
    """Return True if any layer has time samples or a spline for the prim's own transform, frozen or not."""
    if not prim.IsA(UsdGeom.Xformable):
        return False
    try:
        order = value_of(prim, "xformOpOrder") or ()
    except InputError:  # reported for the prims that it moves
        return False
    attributes = (prim.GetAttribute(name.removeprefix(_INVERSE)) for name in order if "xformOp:" in name)
    specs = [spec for attribute in attributes if attribute for spec in attribute.GetPropertyStack()]
    return any(spec.HasInfo("timeSamples") or spec.HasInfo("spline") for spec in specs)


def rigid_part(matrix) -> np.ndarray:
    """Return position and rotation of a transform without its scale, shape [4, 4]: the frame of a rigid body.

    USD's physics and Newton extract the same rotation.
    """
    transform = Gf.Transform(Gf.Matrix4d(matrix.tolist()))
    rigid = Gf.Matrix4d().SetRotate(transform.GetRotation())
    rigid.SetTranslateOnly(transform.GetTranslation())
    return np.array(rigid)


def rotation_of(matrix) -> np.ndarray:
    """Return the rotation of a transform as a quaternion (x, y, z, w)."""
    rotation = Gf.Transform(Gf.Matrix4d(matrix.tolist())).GetRotation().GetQuat()
    return np.array([*rotation.GetImaginary(), rotation.GetReal()])


def rigid_fault(world: np.ndarray, *, may_mirror: bool = False) -> tuple[str, str]:
    """Return the reason why a rigid body cannot have a world transform, and a comment on it; empty where it can."""
    matrix, farthest = world[:3, :3], np.abs(world).max()
    if not farthest <= LARGEST_COORDINATE:
        return f"reaches {farthest:g}, beyond {LARGEST_COORDINATE:g}", ""
    if np.linalg.norm(matrix, axis=1).min() < LEAST_SCALE:
        return f"has a scale of less than {LEAST_SCALE:g}", ", which USD's physics reads wrongly: apply it to the sizes"
    gram = matrix @ matrix.T  # rotation and scale leave the axes at right angles
    if np.abs(gram - np.diag(np.diag(gram))).max() > SCALE_TOLERANCE * np.trace(gram) / 3.0:
        return "is sheared", ", which Newton imports wrongly"
    if np.abs(world[:, 3] - (0.0, 0.0, 0.0, 1.0)).max() > 1e-9:
        return "is a projection", ", which no rigid body has"
    if np.linalg.det(matrix) < 0.0 and not may_mirror:
        return "is mirrored", ", which Newton imports wrongly: mirror the mesh instead"
    return "", ""


class TransformCheck:
    """Checks transforms of bodies and colliders; reports an error in composition once, at the prim that causes it."""

    def __init__(self):
        """Create a check without results."""
        self._cache = UsdGeom.XformCache(Usd.TimeCode.Default())
        self._valid = {}

    def findings(self, prim: Usd.Prim) -> Iterator[Finding]:
        """Yield errors in the transform of a body or collider, including its parents' transforms."""
        yield from self._lineage_findings(prim)
        if not self.is_valid(prim):
            return
        path, world = str(prim.GetPath()), np.array(self._cache.GetLocalToWorldTransform(prim))
        fault, comment = rigid_fault(world, may_mirror=not is_body(prim))
        squares = (world[:3, :3] ** 2).sum(axis=1)
        if fault:
            yield Finding(path, f"transform {fault}{comment}")
        elif prim.IsA(UsdGeom.Sphere) and np.abs(squares - squares.mean()).max() > SCALE_TOLERANCE * squares.mean():
            yield Finding(path, "a sphere with non-uniform scale would be imported as a ball: make it a mesh")

    def is_valid(self, prim: Usd.Prim) -> bool:
        """Return True if :meth:`findings` was called for a prim, and USD can compose its transform."""
        return self._valid.get(prim.GetPath(), False)

    def _lineage_findings(self, prim) -> Iterator[Finding]:
        lineage = []
        while not prim.IsPseudoRoot() and prim.GetPath() not in self._valid:
            lineage.append(prim)
            prim = prim.GetParent()
        for prim in reversed(lineage):
            findings = list(_operation_findings(prim))
            self._valid[prim.GetPath()] = not findings and self._valid.get(prim.GetParent().GetPath(), True)
            yield from findings


def _operation_findings(prim) -> Iterator[Finding]:
    """Yield errors in the transform operations of one prim."""
    if not prim.IsA(UsdGeom.Xformable):
        return
    path = str(prim.GetPath())
    try:
        order = value_of(prim, "xformOpOrder")
    except InputError as error:
        yield finding_of(path, error)
        return
    for entry in order or ():
        name = entry.removeprefix(_INVERSE)
        if entry == _RESET:
            continue
        if message := _operation_fault(prim, name):
            yield Finding(path, message)
            return
        if finding := instance_finding(prim.GetAttribute(name)):
            yield finding
    try:
        matrix = UsdGeom.Xformable(prim).GetLocalTransformation(Usd.TimeCode.Default())
    except Tf.ErrorException:
        yield Finding(path, "transform cannot be composed by USD")
        return
    if not np.isfinite(np.array(matrix)).all():
        yield Finding(path, "transform is not finite")
    elif matrix.GetDeterminant3() == 0.0:
        yield Finding(path, "transform has a scale of zero")


def _operation_fault(prim, name) -> str:
    """Return the error in one transform operation, empty where there is none."""
    attribute = prim.GetAttribute(name) if name.startswith("xformOp:") else None
    if not attribute:
        return f"xformOpOrder names {name!r:.80}, which the prim does not have"
    try:
        value = attribute.Get()
        matrix = UsdGeom.XformOp(attribute).GetOpTransform(Usd.TimeCode.Default())
    except (Tf.ErrorException, RuntimeError):
        return f"{name} has a type or value that USD cannot compose"
    if value is None and attribute.HasAuthoredValue() and not attribute.GetNumTimeSamples():
        return f"{name} has a value that USD cannot read"
    return "" if np.isfinite(np.array(matrix)).all() else f"transform is not finite ({name})"
