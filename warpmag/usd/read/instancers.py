"""Point instancers of bodies: Newton imports nothing from them, so each instance becomes prims of its own.

They lie in a layer of the session, below the instancer, which is an Xform there: ``/Balls/instance12/Ball`` with a
reference to the prototype. A run writes that layer below its cache, in which the instances then move one by one.
Instances with an inactive id are left out, invisible ones are not. What instancers of colliders, bodies or magnets need
not be made of stays as it is. Very many balls that are alike stay one instancer in the cache, too (``swarms.py``).
"""

from collections.abc import Iterator
from dataclasses import dataclass, replace
from functools import partial

import numpy as np
from pxr import Gf, Sdf, Usd, UsdGeom, UsdPhysics, Vt

from warpmag.errors import InputError
from warpmag.usd.read.alike import ARRAYS, MOMENTS, AlikeBalls, alike, ball_in, may_be_alike, may_stay_whole
from warpmag.usd.read.first_reading import MOST_PRIMS
from warpmag.usd.read.session import INSTANCES, add_layer, is_physical, new_layer, release, release_instances
from warpmag.usd.read.transforms import is_body, is_collider
from warpmag.usd.read.units import units_of
from warpmag.usd.schemas import MAGNET_API, MOMENT, has_api

_TYPES = Sdf.ValueTypeNames
_NAME = "instance"
_OPERATIONS = (
    ("xformOp:translate", "positions", _TYPES.Double3),
    ("xformOp:orient", "orientations", _TYPES.Quatf),
    ("xformOp:scale", "scales", _TYPES.Float3),
)
"""What moves an instance, in the order of operations, the array of the instancer and the type of a value."""
_SPEEDS = "velocities", "angularVelocities"
_TURNS = tuple, Vt.QuathArray, Vt.QuatfArray, Vt.QuatdArray
_RESET = "!resetXformStack!"
_LENGTH_ERROR = 0.01
"""How far from 1 the length of an orientation may be, which half precision leaves 1e-3: USD skews what is farther."""


def expand_instancers(stage: Usd.Stage, time_code: float, *, apart: bool = False) -> list[AlikeBalls]:
    """Let a stage have a prim for each instance of what is physical, by a layer of its session.

    Args:
        stage: The stage.
        time_code: The moment at which instances stand, those left out whose transforms are followed over time.
        apart: Leave it at the first of those instances that are alike.

    Returns:
        The instances left out, which :func:`complete_instances` makes prims of.

    Raises:
        InputError: An instancer is not what USD says one must be, or stands for too many prims.
    """
    expansion = _Expansion(stage, time_code, apart)
    prims = Usd.PrimRange.Stage(stage, Usd.TraverseInstanceProxies())
    found = [prim.GetPath() for prim in prims if prim.IsA(UsdGeom.PointInstancer)]
    for path in found:
        expansion.expand(path)
    return expansion.apart


def complete_instances(apart: list[AlikeBalls]) -> None:
    """Let a stage have prims for those instances, too, that :func:`expand_instancers` has left out."""
    for balls in apart:
        balls.write()


@dataclass(frozen=True)
class _Prototype:
    """What instances are made of.

    Attributes:
        path: Its root.
        name: Name of its root.
        order: Its operations where it would leave the transform of its instance behind, else None.
        bodies: Rigid bodies in it, by their path below the root, and their transforms there.
        magnets: Magnets in it.
        prims: How many prims it has.
    """

    path: Sdf.Path
    name: str
    order: list[str] | None
    bodies: tuple[tuple[Sdf.Path, Gf.Matrix4d], ...]
    magnets: tuple[Sdf.Path, ...]
    prims: int


class _Expansion:
    """Expands the instancers of one stage, those first that are in prototypes of others."""

    def __init__(self, stage: Usd.Stage, time_code: float, apart: bool):
        self._stage, self._time = stage, time_code
        self._left_apart, self.apart = apart, list[AlikeBalls]()
        self._layer: Sdf.Layer | None = None
        self._done: set[Sdf.Path] = set()
        self._prims = 0

    def expand(self, path: Sdf.Path, within: tuple[Sdf.Path, ...] = ()) -> None:
        """Expand an instancer, in prototypes of those ``within``, unless it is only seen."""
        if path in within:
            raise InputError(f"{path}: a PointInstancer that is part of its own prototypes")
        if path in self._done:
            return
        instancer = UsdGeom.PointInstancer(self._editable(path))
        targets = instancer.GetPrototypesRel().GetForwardedTargets()
        roots = [self._prototype_prim(path, target) for target in targets]
        held = [one for root in (instancer.GetPrim(), *roots) for one in _all_below(root)]
        if not any(map(is_physical, held)):
            return
        inner = [one.GetPath() for root in roots for one in _all_below(root) if one.IsA(UsdGeom.PointInstancer)]
        for one in inner:
            self.expand(one, (*within, path))
        self._write(UsdGeom.PointInstancer.Get(self._stage, path), targets)
        self._done.add(path)

    def _layer_of_prims(self) -> Sdf.Layer:
        """Return the layer, part of the stage from the first time on."""
        if self._layer is None:
            self._layer = new_layer(INSTANCES)
            add_layer(self._stage, self._layer)
        return self._layer

    def _editable(self, path: Sdf.Path) -> Usd.Prim:
        """Return the prim at a path, no longer in an instance."""
        while (prim := self._stage.GetPrimAtPath(path)) and prim.IsInstanceProxy():
            if not any(is_physical(one) for one in _all_below(prim)):
                break  # only seen, or what it has is elsewhere, which must not be in an instance
            while not prim.IsInstance():
                prim = prim.GetParent()
            release(self._stage, self._layer_of_prims(), [prim.GetPath()])
        return prim

    def _prototype_prim(self, instancer: Sdf.Path, target: Sdf.Path) -> Usd.Prim:
        if not target.IsPrimPath() or not (prim := self._editable(target)):
            raise InputError(f"{instancer}: prototypes names {target}, which is not there")
        return prim

    def _write(self, instancer: UsdGeom.PointInstancer, targets) -> None:
        """Write the prims of all instances of an instancer."""
        path, layer = instancer.GetPath(), self._layer_of_prims()
        instances = _Instances(instancer, len(targets), self._time)
        if any(len(instances.arrays[name]) for name in _SPEEDS):  # which bodies get, in instances, too
            for target in targets:
                release_instances(self._stage, layer, target)
        prototypes = [_prototype(self._stage.GetPrimAtPath(target)) for target in targets]
        followed = instances.samples() if any(map(self._follows_keys, targets)) else ()
        prefix = _NAME
        while any(name.startswith(prefix) for name in instancer.GetPrim().GetAllChildrenNames()):
            prefix += "_"
        write = partial(_write_instances, layer, path, prefix, instances, prototypes, followed)
        left = self._alike(instancer, instances, prefix) if self._left_apart and not followed else []
        whole = {row for balls in left if balls.whole for row in balls.rows.tolist()}  # never are prims
        self._prims += sum(
            1 + prototypes[instances.prototypes[row]].prims for row in instances.rows if row not in whole
        )
        if self._prims > MOST_PRIMS:
            raise InputError(f"{path}: instances of bodies that stand for more than {MOST_PRIMS} prims")
        later = [balls.rows[1:].tolist() for balls in left]
        self.apart += [replace(balls, write=partial(write, rows)) for balls, rows in zip(left, later, strict=True)]
        with Sdf.ChangeBlock():
            own = Sdf.CreatePrimInLayer(layer, path)
            own.typeName = "Xform"
            for target in targets:
                if target.HasPrefix(path):
                    Sdf.CreatePrimInLayer(layer, target).active = False
        unwritten = {row for rows in later for row in rows}
        write([row for row in instances.rows if row not in unwritten])

    def _alike(self, instancer: UsdGeom.PointInstancer, instances: "_Instances", prefix: str) -> list[AlikeBalls]:
        """Find out which instances are alike; those in other units are not, nor are any where a number is none."""
        finite = all(np.isfinite(values).all() for values in instances.arrays.values())
        if not (finite and units_of(self._stage).are_si and may_be_alike(self._stage, instancer, self._time)):
            return []
        targets = instancer.GetPrototypesRel().GetForwardedTargets()
        found = {number: ball_in(self._stage.GetPrimAtPath(target)) for number, target in enumerate(targets)}
        balls = {number: body for number, body in found.items() if body is not None}
        groups = list(alike(*instances.listed(f"{instancer.GetPath()}/{prefix}"), instances.arrays, balls))
        if not may_stay_whole(instancer, self._time):
            groups = [replace(one, whole=False) for one in groups]
        return groups

    def _follows_keys(self, target: Sdf.Path) -> bool:
        """Whether something of a prototype moves as its instance does over time: what is no dynamic body."""
        dynamic = False
        for prim in _all_below(self._stage.GetPrimAtPath(target)):
            if is_body(prim):
                dynamic = not UsdPhysics.RigidBodyAPI(prim).GetKinematicEnabledAttr().Get()
                if not dynamic:
                    return True
            elif is_collider(prim) and not dynamic:
                return True
        return False


class _Instances:
    """The arrays of an instancer at one moment.

    Attributes:
        rows: Indices of the instances that are active.
        prototypes: Number of the prototype of each, shape [n].
        arrays: What else is said of single ones, see :data:`warpmag.usd.read.alike.ARRAYS`; empty where nothing is.
    """

    def __init__(self, instancer: UsdGeom.PointInstancer, prototypes: int, time_code: float):
        """Read them; raises :class:`InputError` where they do not fit each other."""
        self._prim, self._path = instancer.GetPrim(), instancer.GetPath()
        time = Usd.TimeCode(time_code)
        self.prototypes = self._array("protoIndices", time, None)
        self._count = len(self.prototypes)
        wrong = self.prototypes[(self.prototypes < 0) | (self.prototypes >= prototypes)]
        if len(wrong):
            raise InputError(f"{self._path}: protoIndices names prototype {wrong[0]}, but there are {prototypes}")
        self.arrays = {name: self._array(name, time, 3) for name, width in ARRAYS.items() if width == 3}
        self.arrays["orientations"] = self._turns(time)
        self._scales = self._array("scales", time, 3)
        if not len(self.arrays["positions"]) and self._count:
            raise InputError(f"{self._path}: positions is missing, of {self._count} instances")
        ids = self._array("ids", time, None)
        inactive = self._prim.GetMetadata("inactiveIds")
        off = set(inactive.GetAppliedItems() if inactive else ())
        self.rows = [row for row in range(self._count) if (int(ids[row]) if len(ids) else row) not in off]

    def value(self, name: str, row: int):
        """Return what an array says of an instance, None where it is empty."""
        values = self._scales if name == "scales" else self.arrays[name]
        return _typed(name, values[row]) if len(values) else None

    def listed(self, prefix: str) -> tuple[list[str], np.ndarray, np.ndarray]:
        """Return paths, rows and kinds of the active ones as :func:`alike` takes them."""
        rows = np.array(self.rows, int)
        kinds = np.c_[self.prototypes, self._scales] if len(self._scales) else self.prototypes[:, None]
        return [f"{prefix}{row}" for row in self.rows], rows, kinds[rows]

    def samples(self) -> tuple[tuple[float, dict[str, np.ndarray]], ...]:
        """Return the arrays that move instances at all their times, nothing where they have but one."""
        names = ("positions", "orientations", "orientationsf", "scales", "protoIndices")
        times = {name: self._prim.GetAttribute(name).GetTimeSamples() for name in names}
        if len(times["protoIndices"]) > 1:
            raise InputError(f"{self._path}: protoIndices has time samples, and bodies in it follow their instances")
        every = sorted({time for one in times.values() for time in one})
        return tuple((time, self._at(Usd.TimeCode(time))) for time in every) if len(every) > 1 else ()

    def _at(self, time) -> dict[str, np.ndarray]:
        found = {name: self._array(name, time, 3) for name in ("positions", "scales")}
        return found | {"orientations": self._turns(time)}

    def _array(self, name: str, time, width: int | None) -> np.ndarray:
        """Return an array of as many values as there are instances, or none."""
        attribute = self._prim.GetAttribute(name)
        value = attribute.Get(time) if attribute else None
        found = np.zeros(0) if value is None else np.asarray(value)
        kinds = "if" if width else "i"
        if found.size and (found.dtype.kind not in kinds or found.ndim != (2 if width else 1)):
            raise InputError(f"{self._path}: {name} is no array of {'vectors' if width else 'whole numbers'}")
        if name != "protoIndices" and len(found) not in (0, self._count):
            raise InputError(f"{self._path}: {name} has {len(found)} values for {self._count} instances")
        return found if width else found.astype(np.int64)

    def _turns(self, time) -> np.ndarray:
        """Return the orientations, the precise ones if there are any, quaternions x y z w of length 1."""
        values = {name: self._prim.GetAttribute(name).Get(time) or () for name in ("orientations", "orientationsf")}
        for name, value in values.items():
            if not isinstance(value, _TURNS):
                raise InputError(f"{self._path}: {name} is no array of quaternions")
        name = "orientationsf" if len(values["orientationsf"]) else "orientations"
        found = np.array(values[name], dtype=float) if len(values[name]) else np.zeros((0, 4))
        if found.shape not in ((0, 4), (self._count, 4)):
            raise InputError(f"{self._path}: {name} has {len(found)} values for {self._count} instances")
        lengths = np.linalg.norm(found, axis=1)
        odd = ~(np.abs(lengths - 1.0) <= _LENGTH_ERROR)
        if odd.any():
            row = int(odd.argmax())
            raise InputError(f"{self._path}: {name} of instance {row} has length {lengths[row]:g} in place of 1")
        return found / lengths[:, None]


def _all_below(prim: Usd.Prim) -> Iterator[Usd.Prim]:
    return iter(Usd.PrimRange(prim, Usd.TraverseInstanceProxies(Usd.PrimAllPrimsPredicate)))


def _prototype(root: Usd.Prim) -> _Prototype:
    places, below = UsdGeom.XformCache(), list(_all_below(root))
    order = UsdGeom.Xformable(root).GetXformOpOrderAttr().Get() if root.IsA(UsdGeom.Xformable) else None
    outside = places.GetParentToWorldTransform(root).GetInverse()
    bodies = tuple(
        (one.GetPath().MakeRelativePath(root.GetPath()), places.GetLocalToWorldTransform(one) * outside)
        for one in below
        if is_body(one)
    )
    kept = [one for one in order if one != _RESET] if order and _RESET in order else None
    magnets = tuple(one.GetPath().MakeRelativePath(root.GetPath()) for one in below if has_api(one, MAGNET_API))
    return _Prototype(root.GetPath(), root.GetName(), kept, bodies, magnets, len(below))


def _write_instances(layer, path, prefix: str, instances: _Instances, prototypes, followed, rows: list[int]) -> None:
    """Write the prims of some instances of the instancer at a path."""
    own = layer.GetPrimAtPath(path)
    with Sdf.ChangeBlock():
        for row in rows:
            prim = Sdf.PrimSpec(own, f"{prefix}{row}", Sdf.SpecifierDef, "Xform")
            prototype = prototypes[instances.prototypes[row]]
            _write_transform(prim, instances, row, followed)
            _write_prototype(prim, prototype)
            _write_velocities(prim, prototype, instances, row)
            if len(prototype.magnets) == 1 and (moment := instances.value(MOMENTS, row)) is not None:
                magnet = prim.path.AppendChild(prototype.name).AppendPath(prototype.magnets[0])
                Sdf.AttributeSpec(Sdf.CreatePrimInLayer(layer, magnet), MOMENT, _TYPES.Vector3f).default = moment


def _typed(name: str, value) -> object:
    numbers = [float(one) for one in value]
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
    prim = Sdf.PrimSpec(instance, prototype.name, Sdf.SpecifierDef)
    prim.active, prim.instanceable = True, False
    prim.referenceList.Prepend(Sdf.Reference("", prototype.path))
    if prototype.order is not None:
        _write_order(prim, prototype.order)


def _write_velocities(prim: Sdf.PrimSpec, prototype: _Prototype, instances: _Instances, row: int) -> None:
    """Give the bodies of an instance its velocities, which are in the frame of the instancer, in their own frames."""
    given = [instances.value(name, row) for name in _SPEEDS]
    if all(one is None for one in given):
        return
    velocity, spin = (Gf.Vec3d(0.0) if one is None else Gf.Vec3d(one) for one in given)
    turn = instances.value("orientations", row) or Gf.Quatf(1.0)
    scale = instances.value("scales", row) or Gf.Vec3f(1.0)
    rotation = Gf.Matrix4d().SetRotate(Gf.Rotation(Gf.Quatd(turn)))
    for below, matrix in prototype.bodies:
        placed = matrix * Gf.Matrix4d().SetScale(Gf.Vec3d(scale)) * rotation
        own = Gf.Transform(placed).GetRotation().GetInverse()
        across = Gf.Cross(spin, placed.ExtractTranslation()) * np.pi / 180.0
        path = prim.path.AppendChild(prototype.name).AppendPath(below)
        body = Sdf.CreatePrimInLayer(prim.layer, path)
        for name, value, said in (
            ("physics:velocity", own.TransformDir(velocity + across), given[0]),
            ("physics:angularVelocity", own.TransformDir(spin), given[1]),
        ):
            if said is not None:
                Sdf.AttributeSpec(body, name, _TYPES.Vector3f).default = Gf.Vec3f(value)
