"""Reads the time samples (keys) that a run follows: transforms of kinematic bodies, fields, magnetizations, currents.

Keys are read from the stage without frozen values, which would hide them. Animated colliders, coils and field maps
without a rigid body, as artists leave them, become kinematic bodies in the session layer.
"""

from collections.abc import Callable, Iterable, Iterator
from functools import cached_property

import numpy as np
from pxr import Gf, Sdf, Tf, Usd, UsdGeom, UsdPhysics

from warpmag.declarations import materials
from warpmag.declarations.keys import Keys, Motion, Operation
from warpmag.declarations.magnets import Magnet
from warpmag.declarations.schemas import MAGNET_SCHEMA, SCENE_SCHEMA
from warpmag.errors import InputError
from warpmag.usd.read.prims import is_body, is_collider, lineage
from warpmag.usd.read.session import without_frozen
from warpmag.usd.read.transforms import SCALE_TOLERANCE, is_animated, rigid_fault
from warpmag.usd.schemas import MATERIAL, finite_vector
from warpmag.usd.values import Finding, instance_finding


class KeyReader:
    """Reads the keys of one stage."""

    def __init__(self, stage: Usd.Stage):
        """Read from ``stage``, which may be frozen."""
        self._stage = stage
        self._moving: dict[Sdf.Path, bool] = {}

    @cached_property
    def unfrozen(self) -> Usd.Stage:
        """The stage without frozen values."""
        return without_frozen(self._stage)

    def moves(self, prim: Usd.Prim, within: Usd.Prim | None = None) -> bool:
        """Return True if keys move a prim or a parent, in the world or relative to the parent ``within``."""
        for parent in lineage(prim):
            if parent == within:
                return False
            path = parent.GetPath()
            if path not in self._moving:
                self._moving[path] = is_animated(parent) and self._varies(path)
            if self._moving[path]:
                return True
            if parent.IsA(UsdGeom.Xformable) and UsdGeom.Xformable(parent).GetResetXformStack():
                return False
        return False

    def motion(self, prim: Usd.Prim) -> Motion:
        """Return the keyed transform operations of a prim and its parents, at time codes of the stage."""
        operations: list[Operation] = []
        for parent in lineage(self.unfrozen.GetPrimAtPath(prim.GetPath())):
            if parent.IsA(UsdGeom.Xformable):
                xform = UsdGeom.Xformable(parent)
                stack = map(_operation, xform.GetOrderedXformOps())
                operations = [*(operation for operation in stack if not _is_identity(operation)), *operations]
                if xform.GetResetXformStack():
                    break
        return Motion(tuple(operations))

    def keys(self, prim: Usd.Prim, name: str, read: Callable[[str, object], tuple]) -> Keys | None:
        """Return the time samples of an attribute, None where it has fewer than two.

        ``read`` is a function of the name in messages and a value. It checks the value and returns its numbers.
        """
        attribute = self.unfrozen.GetPrimAtPath(prim.GetPath()).GetAttribute(name)
        times = attribute.GetTimeSamples() if attribute else ()
        where = f"{prim.GetPath()}: {name}"
        if attribute:
            _check_no_spline(attribute, where)
        if len(times) < 2:
            return None
        return _keys(times, [read(f"{where} at time code {time:g}", _sample(attribute, time)) for time in times], where)

    def findings(self, prim: Usd.Prim, motion: Motion) -> Iterator[Finding]:
        """Yield the first error of a motion that a rigid body cannot follow, at its keys and half-way between them."""
        path = str(prim.GetPath())
        times = np.unique(np.concatenate([op.keys.times for op in motion.operations if len(op.keys.times) > 1]))
        times = np.unique(np.concatenate([times, 0.5 * (times[1:] + times[:-1])]))
        prim, transforms, scales = self.unfrozen.GetPrimAtPath(prim.GetPath()), UsdGeom.XformCache(), None
        for time in times.tolist():
            transforms.SetTime(time)
            world = np.array(transforms.GetLocalToWorldTransform(prim))
            if fault := rigid_fault(world)[0]:
                yield Finding(path, f"keyed transform {fault} at time code {time:g}")
                return
            scale = np.linalg.norm(world[:3, :3], axis=1)
            scales = scale if scales is None else scales
            if np.abs(scale - scales).max() > SCALE_TOLERANCE * scales.max():
                yield Finding(path, "its scale is keyed, and a rigid body keeps its size")
                return

    def _varies(self, path: Sdf.Path) -> bool:
        """Return True if the prim's own transform differs between its samples."""
        for op in UsdGeom.Xformable(self.unfrozen.GetPrimAtPath(path)).GetOrderedXformOps():
            if op.GetAttr().HasSpline():
                return True
            values = [_sample(op.GetAttr(), time) for time in op.GetTimeSamples()]
            if any(value != values[0] for value in values):
                return True
        return False


def make_kinematic(
    stage: Usd.Stage, animated: Iterable[Sdf.Path], is_source: Callable[[Usd.Prim], bool] = lambda _: False
) -> None:
    """Turn animated colliders and field sources that have no rigid body into kinematic bodies, in the session layer.

    ``animated`` are prims whose own transforms have time samples. ``is_source`` returns True for coils and field maps.
    """
    roots = [path for path in Sdf.Path.RemoveDescendentPaths(list(animated)) if stage.GetPrimAtPath(path)]
    reader, paths = KeyReader(stage), []
    for root in roots:
        for prim in Usd.PrimRange(stage.GetPrimAtPath(root), Usd.TraverseInstanceProxies()):
            chosen = is_collider(prim) or (prim.IsA(UsdGeom.Xformable) and is_source(prim))
            has_body = chosen and any(is_body(parent) or parent.GetPath() in paths for parent in lineage(prim))
            if chosen and not has_body and reader.moves(prim):
                paths.append(prim.GetPath())
    with Usd.EditContext(stage, stage.GetSessionLayer()):
        for path in paths:
            prim = stage.GetPrimAtPath(path)
            if prim.IsInstanceProxy():
                where = next(parent.GetPath() for parent in lineage(prim) if parent.IsInstance())
                raise InputError(f"{path}: moves by keys inside an instance: set instanceable = false on {where}")
            body = UsdPhysics.RigidBodyAPI.Apply(prim)
            body.CreateRigidBodyEnabledAttr(True)
            body.CreateKinematicEnabledAttr(True)
            # Newton drops bodies without mass, such as planes and open meshes; a kinematic body's value is arbitrary
            mass = UsdPhysics.MassAPI.Apply(prim)
            mass.CreateMassAttr(1.0)
            mass.CreateDiagonalInertiaAttr(Gf.Vec3f(1.0))
            mass.CreatePrincipalAxesAttr(Gf.Quatf(1.0))
            mass.CreateCenterOfMassAttr(Gf.Vec3f(0.0))


def _sample(attribute: Usd.Attribute, time: float):
    """Return the value of an attribute at a time code; raises :class:`InputError` if USD cannot read it."""
    try:
        value = attribute.Get(time)
    except Tf.ErrorException:
        value = None
    if value is None:
        where = f"{attribute.GetPrim().GetPath()}: {attribute.GetName()}"
        raise InputError(f"{where} has no value at time code {time:g} that USD can read")
    return value


def _keys(times, values, where: str, interpolation: str = "linear") -> Keys:
    keys = Keys(np.array(times, dtype=float), np.array(values, dtype=float).reshape(len(times), -1), interpolation)
    if not (np.isfinite(keys.times).all() and (np.diff(keys.times) > 0.0).all()):
        raise InputError(f"{where} has time samples at times that are not finite")
    wrong = ~np.isfinite(keys.values).all(axis=1)
    if wrong.any():
        raise InputError(f"{where} is not finite at time code {times[int(np.argmax(wrong))]:g}")
    return keys


def _check_no_spline(attribute: Usd.Attribute, where: str) -> None:
    """Raise :class:`InputError` if an attribute is a spline, whose values are not keys; ``where`` names it."""
    if attribute.HasSpline():
        raise InputError(f"{where} is a spline, which a run does not read: bake it into time samples")


def _operation(xform: UsdGeom.XformOp) -> Operation:
    """Return a transform operation with its keys; a constant one has a single key."""
    attribute = xform.GetAttr()
    where = f"{attribute.GetPrim().GetPath()}: {attribute.GetName()}"
    _check_no_spline(attribute, where)
    token = UsdGeom.XformOp.GetOpTypeToken(xform.GetOpType())
    times = xform.GetTimeSamples()
    if times:
        values = [_sample(attribute, time) for time in times]
    else:
        times, values = [0.0], [attribute.Get()]
    if values[0] is None:  # the identity for USD
        return Operation("matrix", Keys.constant(np.eye(4)))
    if token == "orient":
        quaternions = [(*value.GetImaginary(), value.GetReal()) for value in values]
        keys = _keys(times, quaternions, where, "slerp")
        lengths = np.linalg.norm(keys.values, axis=1, keepdims=True)
        if not lengths.all():
            raise InputError(f"{where} has a quaternion of zeros at time code {times[int(np.argmin(lengths))]:g}")
        return Operation("orient", Keys(keys.times, keys.values / lengths, "slerp"), xform.IsInverseOp())
    kind = "matrix" if token == "transform" else token
    rows = _keys(times, [np.ravel(np.array(value, dtype=float)) for value in values], where)
    if token[-1] in "XYZ" and token[:-1] in ("translate", "scale", "rotate"):
        kind = token[:-1]
        vectors = np.full((len(times), 3), 1.0 if kind == "scale" else 0.0)
        vectors[:, "XYZ".index(token[-1])] = rows.values[:, 0]
        kind, rows = ("rotateXYZ" if kind == "rotate" else kind), Keys(rows.times, vectors)
    return Operation(kind, rows, xform.IsInverseOp())


def _is_identity(operation: Operation) -> bool:
    """Return True if an operation is the identity at all keys."""
    neutral = {"translate": np.zeros(3), "scale": np.ones(3), "matrix": np.eye(4).ravel()}.get(operation.kind)
    return neutral is not None and bool((operation.keys.values == neutral).all())


def field_keys(prim: Usd.Prim, keys: KeyReader) -> Keys | None:
    """Return the time samples of a scene's external field [A/m], None where it is constant."""
    return keys.keys(prim, SCENE_SCHEMA.usd_name("external_field"), finite_vector)


def magnetization_keys(prim: Usd.Prim, magnet: Magnet, keys: KeyReader) -> Keys | None:
    """Return the time samples of a permanent magnet's magnetization [A/m], None where it is constant."""
    if magnet.kind != "permanent":
        return None
    name = MAGNET_SCHEMA.usd_name("magnetization")
    if finding := instance_finding(prim.GetAttribute(name)):
        raise InputError(str(finding))
    material = prim.GetAttribute(MATERIAL).Get()

    def read(where: str, value) -> tuple:
        magnetization = finite_vector(where, value)
        return materials.permanent(where, material, magnetization) if material else magnetization

    return keys.keys(prim, name, read)
