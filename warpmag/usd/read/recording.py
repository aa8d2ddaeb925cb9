"""Motion of rigid bodies and magnets in a stage, usually one that a run wrote."""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from pxr import Usd, UsdGeom, Vt

from warpmag.declarations.rotations import multiply, rotate
from warpmag.usd.read.ball_instancers import BallInstancer
from warpmag.usd.read.identical_balls import MOMENTS_PRIMVAR
from warpmag.usd.read.opening import freeze
from warpmag.usd.read.prims import is_body, lineage
from warpmag.usd.read.transforms import is_animated, rigid_part, rotation_of
from warpmag.usd.schemas import MAGNET_API, MOMENT, SCENE_API, has_api
from warpmag.usd.values import value_of

TRANSLATE, ORIENT, SCALE = (f"xformOp:{kind}:warpmag" for kind in ("translate", "orient", "scale"))
"""Transform operations of a body in a run, in this order."""
_VELOCITIES = "physics:velocity", "physics:angularVelocity"


@dataclass(frozen=True)
class Recording:
    """Bodies and magnets of a stage over time, in the world, in the stage's unit of length."""

    codes: np.ndarray  # time codes of the samples, shape [f]; only the start of the stage where nothing moves
    seconds: np.ndarray  # times of the samples since the first one [s], shape [f]
    meters_per_unit: float  # the stage's unit of length [m]
    bodies: list[str]  # paths of the rigid bodies
    positions: np.ndarray  # origins of the bodies, float64, shape [f, n, 3]
    rotations: np.ndarray  # orientations of the bodies, quaternions (x, y, z, w), float32, shape [f, n, 4]
    linear: np.ndarray  # velocities of the bodies [units/s], float32, shape [f, n, 3]
    angular: np.ndarray  # angular velocities of the bodies [rad/s], float32, shape [f, n, 3]
    magnets: list[str]  # paths of the magnets that have moments
    moments: np.ndarray  # moments of the magnets [A·m²], float32, shape [f, m, 3]
    permanent: np.ndarray  # True for each permanent magnet, shape [m]
    external: np.ndarray  # the external field [A/m], shape [f, 3]


def read_recording(stage: Usd.Stage, instancers: Sequence[BallInstancer] = ()) -> Recording:
    """Return bodies and moments of a stage, which must not be frozen, at all their time samples.

    The balls of ``instancers``, which have no prims, follow the bodies and magnets with prims.
    """
    prims = [prim for prim in Usd.PrimRange.Stage(stage, Usd.TraverseInstanceProxies()) if prim.IsActive()]
    firsts = [balls.first for instancer in instancers for balls in instancer.groups]
    prims = [prim for prim in prims if not any(map(prim.GetPath().HasPrefix, firsts))]
    bodies = [prim for prim in prims if is_body(prim)]
    magnets = [prim for prim in prims if has_api(prim, MAGNET_API) and prim.GetAttribute(MOMENT).HasAuthoredValue()]
    fields = [prim.GetAttribute("warpmag:externalField") for prim in prims if has_api(prim, SCENE_API)]
    codes = _codes(stage, bodies, magnets, instancers)
    seconds = (codes - codes[0]) / stage.GetTimeCodesPerSecond()
    moments = [_values(prim.GetAttribute(MOMENT), codes, Vt.Vec3fArray) for prim in magnets]
    moments = np.stack(moments, axis=1) if moments else np.zeros((len(codes), 0, 3), dtype=np.float32)
    recording = Recording(
        codes,
        seconds,
        UsdGeom.GetStageMetersPerUnit(stage),
        [str(prim.GetPath()) for prim in bodies],
        *_motion(bodies, codes, seconds),
        [str(prim.GetPath()) for prim in magnets],
        moments.astype(np.float32),
        np.array([prim.GetAttribute("warpmag:kind").Get() == "permanent" for prim in magnets], dtype=bool),
        _values(next((field for field in fields if field.HasAuthoredValue()), None), codes, Vt.Vec3fArray),
    )
    for instancer in instancers:
        recording = _with_balls(recording, instancer)
    return recording


def _motion(bodies: list[Usd.Prim], codes: np.ndarray, seconds: np.ndarray):
    """Return positions, rotations, linear and angular velocities of bodies, see :class:`Recording`."""
    poses = _Poses(codes)
    shape = len(codes), len(bodies)
    positions, rotations = np.empty((*shape, 3)), np.empty((*shape, 4), dtype=np.float32)
    linear, angular = (np.zeros((*shape, 3), dtype=np.float32) for _ in range(2))
    for n, prim in enumerate(bodies):
        positions[:, n], rotations[:, n] = poses.read(prim)
        if prim.GetAttribute(TRANSLATE):  # a run wrote the velocities; elsewhere they are initial values
            for values, name in zip((linear, angular), _VELOCITIES, strict=True):
                values[:, n] = _values(prim.GetAttribute(name), codes, Vt.Vec3fArray)
        elif len(codes) > 1:
            linear[:, n] = np.gradient(positions[:, n], seconds, axis=0)
    world = rotate(rotations.reshape(-1, 4), linear.reshape(-1, 3)).reshape(linear.shape)
    recorded = np.array([bool(prim.GetAttribute(TRANSLATE)) for prim in bodies], dtype=bool)
    linear[:, recorded] = world[:, recorded]
    angular = np.radians(rotate(rotations.reshape(-1, 4), angular.reshape(-1, 3))).reshape(angular.shape)
    return positions, rotations, linear, angular.astype(np.float32)


def _with_balls(recording: Recording, instancer: BallInstancer) -> Recording:
    """Return a recording with the balls of an instancer appended."""
    arrays = [instancer.arrays(Usd.TimeCode(code)) for code in recording.codes.tolist()]
    poses = np.stack([instancer.poses(frame) for frame in arrays])
    velocities = np.stack([instancer.velocities(frame) for frame in arrays])
    balls = (poses[..., :3], poses[..., 3:], velocities[..., :3], velocities[..., 3:])
    fields: dict[str, Any] = {}
    for name, values in zip(("positions", "rotations", "linear", "angular"), balls, strict=True):
        bodies = getattr(recording, name)
        fields[name] = np.concatenate([bodies, values.astype(bodies.dtype)], axis=1)
    if len(arrays[0][MOMENTS_PRIMVAR]):
        rows = np.flatnonzero([magnet is not None for magnet in instancer.magnets])
        moments = np.stack([frame[MOMENTS_PRIMVAR][rows] for frame in arrays])
        fields["magnets"] = recording.magnets + instancer.magnets[rows].tolist()
        fields["moments"] = np.concatenate([recording.moments, moments], axis=1)
        fields["permanent"] = np.append(recording.permanent, instancer.permanent[rows])
    return replace(recording, bodies=[*recording.bodies, *instancer.bodies], **fields)


def _codes(stage, bodies, magnets, instancers) -> np.ndarray:
    """Return all time codes at which a body or a moment has a sample, in order."""
    xforms = (prim for body in bodies for prim in lineage(body) if prim.IsA(UsdGeom.Xformable))
    samples = {tuple(UsdGeom.Xformable(prim).GetTimeSamples()) for prim in xforms}
    samples |= {tuple(prim.GetAttribute(MOMENT).GetTimeSamples()) for prim in magnets}
    positions = [stage.GetPrimAtPath(instancer.path).GetAttribute("positions") for instancer in instancers]
    samples |= {tuple(attribute.GetTimeSamples()) for attribute in positions}
    codes = sorted(set().union(*samples))
    return np.array(codes or [stage.GetStartTimeCode()])


class _Poses:
    """Poses of bodies in the world at time codes."""

    def __init__(self, codes: np.ndarray):
        self._codes = codes
        self._first = UsdGeom.XformCache(codes[0])
        self._caches = []

    def read(self, prim: Usd.Prim) -> tuple[np.ndarray, np.ndarray]:
        """Return positions, shape [f, 3], and quaternions, shape [f, 4]; poses that a run wrote are unchanged."""
        order = list(value_of(prim, "xformOpOrder") or ())
        resets = order[:1] == ["!resetXformStack!"]
        recorded = order[resets:] in ([TRANSLATE, ORIENT], [TRANSLATE, ORIENT, SCALE])
        if not (recorded and (resets or _parents_are_still(prim))):
            return self._composed(prim)
        positions = _values(prim.GetAttribute(TRANSLATE), self._codes, Vt.Vec3dArray)
        rotations = _values(prim.GetAttribute(ORIENT), self._codes, Vt.QuatfArray)
        parent = np.eye(4) if resets else np.array(self._first.GetLocalToWorldTransform(prim.GetParent()))
        if not np.array_equal(parent, np.eye(4)):
            positions = np.c_[positions, np.ones(len(positions))] @ parent[:, :3]
            rotations = multiply(np.broadcast_to(rotation_of(parent), rotations.shape), rotations).astype(np.float32)
        return positions, rotations

    def _composed(self, prim) -> tuple[np.ndarray, np.ndarray]:
        moves = is_animated(prim) or not _parents_are_still(prim)
        if moves and not self._caches:
            self._caches = [UsdGeom.XformCache(code) for code in self._codes]
        caches = self._caches if moves else [self._first]
        frames = [rigid_part(np.array(cache.GetLocalToWorldTransform(prim))) for cache in caches]
        positions = np.array([frame[3, :3] for frame in frames])
        rotations = np.array([rotation_of(frame) for frame in frames])
        for k in range(1, len(rotations)):
            rotations[k] *= -1.0 if rotations[k] @ rotations[k - 1] < 0.0 else 1.0
        count = len(self._codes)
        return np.broadcast_to(positions, (count, 3)), np.broadcast_to(rotations, (count, 4)).astype(np.float32)


def _parents_are_still(prim: Usd.Prim) -> bool:
    return not any(map(is_animated, lineage(prim.GetParent())))


def _values(attribute: Usd.Attribute | None, codes: np.ndarray, array) -> np.ndarray:
    """Return the values of an attribute at time codes, shape [f, ...]; zeros where none is authored."""
    if not attribute or not attribute.HasAuthoredValue():
        return np.zeros((len(codes), 3))
    query = Usd.AttributeQuery(attribute)
    if not query.ValueMightBeTimeVarying():
        return np.repeat(np.array(array([query.Get(codes[0])])), len(codes), axis=0)
    return np.array(array([query.Get(code) for code in codes.tolist()]))


class Playback:
    """Poses and moments of a stage opened by :func:`warpmag.usd.open_stage`, at any time code."""

    def __init__(self, stage: Usd.Stage, instancers: Sequence[BallInstancer] = ()):
        """Read from ``stage`` and from ``instancers``, whose balls have no prims."""
        self._stage, self._instancers = stage, instancers

    def seek(self, time_code: float) -> None:
        """Set the time code that the other methods read."""
        freeze(self._stage, time_code)

    def poses(self, prims: Sequence[str]) -> np.ndarray:
        """Return world positions [m] and quaternions (x, y, z, w) of prims, shape [n, 7]."""
        cache, poses = UsdGeom.XformCache(Usd.TimeCode.Default()), np.empty((len(prims), 7))
        balls = {}
        for instancer in self._instancers:
            balls |= zip(instancer.bodies, instancer.poses(instancer.arrays(Usd.TimeCode.Default())), strict=True)
        for row, prim in zip(poses, prims, strict=True):
            if prim in balls:
                row[:] = balls[prim]
                continue
            matrix = np.array(cache.GetLocalToWorldTransform(self._stage.GetPrimAtPath(prim)))
            row[:] = *matrix[3, :3], *rotation_of(matrix)
        return poses

    def moments(self, prims: Sequence[str]) -> np.ndarray:
        """Return the moments of magnets [A·m²], world frame, shape [n, 3]; zero where none is authored."""
        moments, balls = np.zeros((len(prims), 3)), {}
        for instancer in self._instancers:
            values = instancer.arrays(Usd.TimeCode.Default())[MOMENTS_PRIMVAR]
            values = values if len(values) else np.zeros((len(instancer.bodies), 3))
            balls |= zip(instancer.magnets, values, strict=True)
        for row, prim in zip(moments, prims, strict=True):
            value = balls[prim] if prim in balls else self._stage.GetPrimAtPath(prim).GetAttribute(MOMENT).Get()
            row[:] = 0.0 if value is None else value
        return moments
