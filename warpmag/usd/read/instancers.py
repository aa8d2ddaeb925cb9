"""Expands PointInstancers of physical prims, which Newton does not import: each instance becomes prims of its own.

The prims are in a layer of the session, below the instancer, which becomes an Xform: ``/Balls/instance12/Ball`` with a
reference to the prototype. A run writes that layer below its cache, which moves the instances. Instances with an
inactive id are left out. Invisible instances are kept. Instancers without colliders, bodies and magnets stay
unchanged. Instancers of very many identical balls stay instancers (``ball_instancers.py``).
"""

from dataclasses import dataclass, replace
from functools import cached_property, partial

import numpy as np
from pxr import Gf, Sdf, Usd, UsdGeom, UsdPhysics, Vt

from warpmag.errors import InputError
from warpmag.usd.read.identical_balls import INSTANCE_ARRAYS, MOMENTS_PRIMVAR, IdenticalBalls, identical_balls
from warpmag.usd.read.prims import descendants, is_body, is_collider, is_physical
from warpmag.usd.read.session import INSTANCES, add_layer, release, release_instances
from warpmag.usd.read.trial_read import MOST_PRIMS
from warpmag.usd.schemas import MAGNET_API, MOMENT, has_api
from warpmag.usd.values import value_of

_TYPES = Sdf.ValueTypeNames
_NAME = "instance"
_OPERATIONS = (
    ("xformOp:translate", "positions", _TYPES.Double3),
    ("xformOp:orient", "orientations", _TYPES.Quatf),
    ("xformOp:scale", "scales", _TYPES.Float3),
)
"""Transform operations of an instance in their order, with the array of the instancer and the type of a value."""
_VELOCITIES = "velocities", "angularVelocities"
_QUATERNION_ARRAYS = tuple, Vt.QuathArray, Vt.QuatfArray, Vt.QuatdArray
_RESET = "!resetXformStack!"
_LENGTH_ERROR = 0.01
"""Largest deviation of an orientation's length from 1. Half precision leaves 1e-3; USD shears larger deviations."""


def expand_instancers(stage: Usd.Stage, time_code: float, *, defer: bool = False) -> list[IdenticalBalls]:
    """Create prims for the instances of physical prims, in a layer of the stage's session.

    Instances get their positions at the time code. If a run follows their motion, they keep all time samples. With
    ``defer`` only the first of identical balls gets prims; the others are returned for :func:`complete_instances`.

    Raises:
        InputError: An instancer breaks USD's rules or expands to too many prims.
    """
    expansion = _Expansion(stage, time_code, defer)
    prims = Usd.PrimRange.Stage(stage, Usd.TraverseInstanceProxies())
    paths = [prim.GetPath() for prim in prims if prim.IsA(UsdGeom.PointInstancer)]
    for path in paths:
        expansion.expand(path)
    return expansion.deferred


def complete_instances(deferred: list[IdenticalBalls]) -> None:
    """Create the prims of instances that :func:`expand_instancers` has deferred."""
    for balls in deferred:
        balls.create_prims()


@dataclass(frozen=True)
class _Prototype:
    """A prototype of instances."""

    path: Sdf.Path  # of its root
    order: list[str] | None  # transform operations of its root without the reset of the stack, None if it has no reset
    bodies: tuple[tuple[Sdf.Path, Gf.Matrix4d], ...]  # path below the root, and transform relative to the root's parent
    magnets: tuple[Sdf.Path, ...]  # paths of the magnets in it, below the root
    prims: int  # number of its prims


class _Expansion:
    """Expands the instancers of one stage, beginning with instancers in prototypes of others."""

    def __init__(self, stage: Usd.Stage, time_code: float, defer: bool):
        self._stage, self._time = stage, time_code
        self._defer, self.deferred = defer, list[IdenticalBalls]()
        self._done: set[Sdf.Path] = set()
        self._prims = 0

    def expand(self, path: Sdf.Path, within: tuple[Sdf.Path, ...] = ()) -> None:
        """Expand an instancer with physical prims, nested in prototypes of the instancers ``within``."""
        if path in within:
            raise InputError(f"{path}: a PointInstancer that is part of its own prototypes")
        if path in self._done:
            return
        instancer = UsdGeom.PointInstancer(self._editable(path))
        targets = instancer.GetPrototypesRel().GetForwardedTargets()
        roots = [self._prototype_prim(path, target) for target in targets]
        if not any(is_physical(prim) for root in (instancer.GetPrim(), *roots) for prim in descendants(root)):
            return
        nested = [prim.GetPath() for root in roots for prim in descendants(root) if prim.IsA(UsdGeom.PointInstancer)]
        for inner in nested:
            self.expand(inner, (*within, path))
        self._write(UsdGeom.PointInstancer.Get(self._stage, path), targets)
        self._done.add(path)

    @cached_property
    def _layer(self) -> Sdf.Layer:
        """Layer of the prims; the first use adds it to the stage."""
        return add_layer(self._stage, INSTANCES)

    def _editable(self, path: Sdf.Path) -> Usd.Prim:
        """Return the prim at a path; where it is physical, instances around it become editable."""
        while (prim := self._stage.GetPrimAtPath(path)) and prim.IsInstanceProxy():
            if not any(map(is_physical, descendants(prim))):
                break
            while not prim.IsInstance():
                prim = prim.GetParent()
            release(self._stage, self._layer, [prim.GetPath()])
        return prim

    def _prototype_prim(self, instancer: Sdf.Path, target: Sdf.Path) -> Usd.Prim:
        if not target.IsPrimPath() or not (prim := self._editable(target)):
            raise InputError(f"{instancer}: prototypes names {target}, which is not there")
        return prim

    def _write(self, instancer: UsdGeom.PointInstancer, targets) -> None:
        """Write the prims of an instancer's instances, except for deferred ones."""
        path, layer = instancer.GetPath(), self._layer
        instances = _Instances(instancer, len(targets), self._time)
        has_velocities = any(len(instances.arrays[name]) for name in _VELOCITIES)
        for target in targets if has_velocities else ():  # they are written to the bodies, also inside instances
            release_instances(self._stage, layer, target)
        prototypes = [_prototype(self._stage.GetPrimAtPath(target)) for target in targets]
        samples = instances.samples() if any(map(self._follows_keys, targets)) else ()
        prefix = _NAME
        while any(name.startswith(prefix) for name in instancer.GetPrim().GetAllChildrenNames()):
            prefix += "_"
        write = partial(_write_instances, layer, path, prefix, instances, prototypes, samples)
        groups = []
        if self._defer and not samples:
            groups = list(identical_balls(instancer, self._time, *instances.kinds(f"{path}/{prefix}")))
        without_prims = {row for balls in groups if balls.stays_instancer for row in balls.rows.tolist()}
        kinds = [instances.prototypes[row] for row in instances.rows if row not in without_prims]
        self._prims += sum(1 + prototypes[kind].prims for kind in kinds)
        if self._prims > MOST_PRIMS:
            raise InputError(f"{path}: instances of bodies expand to more than {MOST_PRIMS} prims")
        later = [balls.rows[1:].tolist() for balls in groups]
        for balls, rows in zip(groups, later, strict=True):
            self.deferred.append(replace(balls, create_prims=partial(write, rows)))
        with Sdf.ChangeBlock():
            root = Sdf.CreatePrimInLayer(layer, path)
            root.typeName = "Xform"
            for target in targets:
                if target.HasPrefix(path):
                    Sdf.CreatePrimInLayer(layer, target).active = False
        deferred = {row for rows in later for row in rows}
        write([row for row in instances.rows if row not in deferred])

    def _follows_keys(self, target: Sdf.Path) -> bool:
        """Return True if a prototype has kinematic bodies or colliders without a body, which follow the instance."""
        dynamic = False
        for prim in descendants(self._stage.GetPrimAtPath(target)):
            if is_body(prim):
                dynamic = not UsdPhysics.RigidBodyAPI(prim).GetKinematicEnabledAttr().Get()
                if not dynamic:
                    return True
            elif is_collider(prim) and not dynamic:
                return True
        return False


class _Instances:
    """Arrays of an instancer at one time code; ``arrays`` are :data:`INSTANCE_ARRAYS`, empty where it has none."""

    def __init__(self, instancer: UsdGeom.PointInstancer, prototypes: int, time_code: float):
        """Read the arrays; raises :class:`InputError` where their lengths or types are inconsistent."""
        self._prim, self._path = instancer.GetPrim(), instancer.GetPath()
        time = Usd.TimeCode(time_code)
        self.prototypes = self._array("protoIndices", time, None)
        self._count = len(self.prototypes)
        wrong = self.prototypes[(self.prototypes < 0) | (self.prototypes >= prototypes)]
        if len(wrong):
            raise InputError(f"{self._path}: protoIndices names prototype {wrong[0]}, but there are {prototypes}")
        self.arrays = {name: self._array(name, time, 3) for name, width in INSTANCE_ARRAYS.items() if width == 3}
        self.arrays["orientations"] = self._orientations(time)
        self._scales = self._array("scales", time, 3)
        if not len(self.arrays["positions"]) and self._count:
            raise InputError(f"{self._path}: positions is missing for {self._count} instances")
        ids = self._array("ids", time, None)
        metadata = self._prim.GetMetadata("inactiveIds")
        inactive = set(metadata.GetAppliedItems() if metadata else ())
        active = [(int(ids[row]) if len(ids) else row) not in inactive for row in range(self._count)]
        self.rows = np.flatnonzero(active).tolist()

    def value(self, name: str, row: int):
        """Return an instance's value of an array, None where the array is empty."""
        values = self._scales if name == "scales" else self.arrays[name]
        return _typed(name, values[row]) if len(values) else None

    def kinds(self, prefix: str) -> tuple[list[str], np.ndarray, np.ndarray, dict[str, np.ndarray]]:
        """Return paths, rows and kinds of the active instances, and all arrays, as for :func:`identical_balls`."""
        rows = np.array(self.rows, int)
        kinds = np.c_[self.prototypes, self._scales] if len(self._scales) else self.prototypes[:, None]
        return [f"{prefix}{row}" for row in self.rows], rows, kinds[rows], self.arrays

    def samples(self) -> tuple[tuple[float, dict[str, np.ndarray]], ...]:
        """Return the arrays of the instances' transforms at all time samples; empty for fewer than two samples."""
        names = ("positions", "orientations", "orientationsf", "scales", "protoIndices")
        times = {name: self._prim.GetAttribute(name).GetTimeSamples() for name in names}
        if len(times["protoIndices"]) > 1:
            raise InputError(f"{self._path}: protoIndices has time samples, and bodies in it follow their instances")
        all_times = sorted({time for samples in times.values() for time in samples})
        return tuple((time, self._transforms(Usd.TimeCode(time))) for time in all_times) if len(all_times) > 1 else ()

    def _transforms(self, time) -> dict[str, np.ndarray]:
        arrays = {name: self._array(name, time, 3) for name in ("positions", "scales")}
        return arrays | {"orientations": self._orientations(time)}

    def _array(self, name: str, time, width: int | None) -> np.ndarray:
        """Return an array with one value for each instance, or an empty one."""
        attribute = self._prim.GetAttribute(name)
        value = attribute.Get(time) if attribute else None
        array = np.zeros(0) if value is None else np.asarray(value)
        kinds = "if" if width else "i"
        if array.size and (array.dtype.kind not in kinds or array.ndim != (2 if width else 1)):
            raise InputError(f"{self._path}: {name} is not an array of {'vectors' if width else 'whole numbers'}")
        if name != "protoIndices" and len(array) not in (0, self._count):
            raise InputError(f"{self._path}: {name} has {len(array)} values for {self._count} instances")
        return array if width else array.astype(np.int64)

    def _orientations(self, time) -> np.ndarray:
        """Return unit quaternions (x, y, z, w): ``orientationsf`` where authored, else ``orientations``."""
        values = {name: self._prim.GetAttribute(name).Get(time) or () for name in ("orientations", "orientationsf")}
        for name, value in values.items():
            if not isinstance(value, _QUATERNION_ARRAYS):
                raise InputError(f"{self._path}: {name} is not an array of quaternions")
        name = "orientationsf" if len(values["orientationsf"]) else "orientations"
        quaternions = np.array(values[name], dtype=float) if len(values[name]) else np.zeros((0, 4))
        if quaternions.shape not in ((0, 4), (self._count, 4)):
            raise InputError(f"{self._path}: {name} has {len(quaternions)} values for {self._count} instances")
        lengths = np.linalg.norm(quaternions, axis=1)
        wrong = ~(np.abs(lengths - 1.0) <= _LENGTH_ERROR)
        if wrong.any():
            row = int(wrong.argmax())
            raise InputError(f"{self._path}: {name} of instance {row} has length {lengths[row]:g}, not 1")
        return quaternions / lengths[:, None]


def _prototype(root: Usd.Prim) -> _Prototype:
    transforms, prims = UsdGeom.XformCache(), list(descendants(root))
    order = value_of(root, "xformOpOrder") if root.IsA(UsdGeom.Xformable) else None
    to_parent = transforms.GetParentToWorldTransform(root).GetInverse()
    bodies = tuple(
        (prim.GetPath().MakeRelativePath(root.GetPath()), transforms.GetLocalToWorldTransform(prim) * to_parent)
        for prim in prims
        if is_body(prim)
    )
    order = [name for name in order if name != _RESET] if order and _RESET in order else None
    magnets = tuple(prim.GetPath().MakeRelativePath(root.GetPath()) for prim in prims if has_api(prim, MAGNET_API))
    return _Prototype(root.GetPath(), order, bodies, magnets, len(prims))


def _write_instances(layer, path, prefix: str, instances: _Instances, prototypes, samples, rows: list[int]) -> None:
    """Write the prims of some instances of the instancer at a path."""
    root = layer.GetPrimAtPath(path)
    with Sdf.ChangeBlock():
        for row in rows:
            prim = Sdf.PrimSpec(root, f"{prefix}{row}", Sdf.SpecifierDef, "Xform")
            prototype = prototypes[instances.prototypes[row]]
            _write_transform(prim, instances, row, samples)
            _write_prototype(prim, prototype)
            _write_velocities(prim, prototype, instances, row)
            if len(prototype.magnets) == 1 and (moment := instances.value(MOMENTS_PRIMVAR, row)) is not None:
                magnet = prim.path.AppendChild(prototype.path.name).AppendPath(prototype.magnets[0])
                Sdf.AttributeSpec(Sdf.CreatePrimInLayer(layer, magnet), MOMENT, _TYPES.Vector3f).default = moment


def _typed(name: str, value) -> object:
    numbers = [float(number) for number in value]
    if name == "orientations":
        return Gf.Quatf(numbers[3], *numbers[:3])
    return Gf.Vec3d(*numbers) if name == "positions" else Gf.Vec3f(*numbers)


def _write_transform(prim: Sdf.PrimSpec, instances: _Instances, row: int, samples) -> None:
    order = []
    for operation, name, kind in _OPERATIONS:
        value = instances.value(name, row)
        if value is None:
            continue
        attribute = Sdf.AttributeSpec(prim, operation, kind)
        attribute.default = value
        for time, arrays in samples:
            prim.layer.SetTimeSample(attribute.path, time, _typed(name, arrays[name][row]))
        order.append(operation)
    _write_order(prim, order)


def _write_order(prim: Sdf.PrimSpec, order: list[str]) -> None:
    Sdf.AttributeSpec(prim, "xformOpOrder", _TYPES.TokenArray, Sdf.VariabilityUniform).default = order


def _write_prototype(instance: Sdf.PrimSpec, prototype: _Prototype) -> None:
    prim = Sdf.PrimSpec(instance, prototype.path.name, Sdf.SpecifierDef)
    prim.active, prim.instanceable = True, False
    prim.referenceList.Prepend(Sdf.Reference("", prototype.path))
    if prototype.order is not None:
        _write_order(prim, prototype.order)


def _write_velocities(prim: Sdf.PrimSpec, prototype: _Prototype, instances: _Instances, row: int) -> None:
    """Write the velocities of an instance's bodies, converted from the instancer's frame to the bodies' frames."""
    authored = [instances.value(name, row) for name in _VELOCITIES]
    if all(value is None for value in authored):
        return
    linear, angular = (Gf.Vec3d(0.0) if value is None else Gf.Vec3d(value) for value in authored)
    orientation = instances.value("orientations", row) or Gf.Quatf(1.0)
    scale = instances.value("scales", row) or Gf.Vec3f(1.0)
    rotation = Gf.Matrix4d().SetRotate(Gf.Rotation(Gf.Quatd(orientation)))
    for below, matrix in prototype.bodies:
        placed = matrix * Gf.Matrix4d().SetScale(Gf.Vec3d(scale)) * rotation
        to_body = Gf.Transform(placed).GetRotation().GetInverse()
        tangential = Gf.Cross(angular, placed.ExtractTranslation()) * np.pi / 180.0
        path = prim.path.AppendChild(prototype.path.name).AppendPath(below)
        body = Sdf.CreatePrimInLayer(prim.layer, path)
        for name, value, authored_value in (
            ("physics:velocity", to_body.TransformDir(linear + tangential), authored[0]),
            ("physics:angularVelocity", to_body.TransformDir(angular), authored[1]),
        ):
            if authored_value is not None:
                Sdf.AttributeSpec(body, name, _TYPES.Vector3f).default = Gf.Vec3f(value)
