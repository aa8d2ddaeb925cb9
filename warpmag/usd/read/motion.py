"""Reads what a stage, a run's above all, shows of its rigid bodies and magnets, sample by sample."""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from pxr import Usd, UsdGeom, Vt

from warpmag.usd.read.alike import MOMENTS
from warpmag.usd.read.swarms import Swarm
from warpmag.usd.read.transforms import is_animated, is_body
from warpmag.usd.schemas import MAGNET_API, MOMENT, SCENE_API, has_api
from warpmag.usd.write.columns import ORIENT, SCALE, TRANSLATE
from warpmag.usd.write.placements import product, rigid, rotate, turn_of

_VELOCITIES = "physics:velocity", "physics:angularVelocity"


@dataclass(frozen=True)
class Recording:
    """Bodies and magnets of a stage over time, in the world, in the stage's units of length.

    Attributes:
        codes: Time codes of the samples, shape [f]; the start of the stage where nothing moves.
        seconds: The same since the start of the stage [s], shape [f].
        metres_per_unit: The stage's unit of length [m].
        bodies: Prims of the rigid bodies.
        positions: Their origins, float64, shape [f, n, 3].
        turns: Their orientations, quaternions x y z w, float32, shape [f, n, 4].
        linear: Their velocities [units/s], float32, shape [f, n, 3].
        angular: Their angular velocities [rad/s], float32, shape [f, n, 3].
        magnets: Prims of the magnets that have moments.
        moments: Their moments [A·m²], float32, shape [f, m, 3].
        permanent: Whether each is permanent, shape [m].
        external: The applied field [A/m], shape [f, 3].
    """

    codes: np.ndarray
    seconds: np.ndarray
    metres_per_unit: float
    bodies: list[str]
    positions: np.ndarray
    turns: np.ndarray
    linear: np.ndarray
    angular: np.ndarray
    magnets: list[str]
    moments: np.ndarray
    permanent: np.ndarray
    external: np.ndarray


def read_recording(stage: Usd.Stage, swarms: Sequence[Swarm] = ()) -> Recording:
    """Read a stage at all samples of its bodies and moments.

    Args:
        stage: The stage, not held at any moment.
        swarms: Instancers whose balls have no prims; they come behind those bodies and magnets that have.
    """
    prims = [prim for prim in Usd.PrimRange.Stage(stage, Usd.TraverseInstanceProxies()) if prim.IsActive()]
    firsts = [one for swarm in swarms for one in swarm.firsts]
    prims = [prim for prim in prims if not any(map(prim.GetPath().HasPrefix, firsts))]
    bodies = [prim for prim in prims if is_body(prim)]
    magnets = [prim for prim in prims if has_api(prim, MAGNET_API) and prim.GetAttribute(MOMENT).HasAuthoredValue()]
    fields = [prim.GetAttribute("warpmag:externalField") for prim in prims if has_api(prim, SCENE_API)]
    codes = _codes(stage, bodies, magnets, swarms)
    seconds = (codes - codes[0]) / stage.GetTimeCodesPerSecond()
    poses = _Poses(codes)
    count = len(codes), len(bodies)
    positions, turns = np.empty((*count, 3)), np.empty((*count, 4), dtype=np.float32)
    linear, angular = (np.zeros((*count, 3), dtype=np.float32) for _ in range(2))
    for n, prim in enumerate(bodies):
        positions[:, n], turns[:, n] = poses.of(prim)
        if prim.GetAttribute(TRANSLATE):  # else what is authored there is where a run would begin
            for values, name in zip((linear, angular), _VELOCITIES, strict=True):
                values[:, n] = _values(prim.GetAttribute(name), codes, Vt.Vec3fArray)
        elif len(codes) > 1:
            linear[:, n] = np.gradient(positions[:, n], seconds, axis=0)
    world = rotate(turns.reshape(-1, 4), linear.reshape(-1, 3)).reshape(linear.shape)
    recorded = np.array([bool(prim.GetAttribute(TRANSLATE)) for prim in bodies], dtype=bool)
    linear[:, recorded] = world[:, recorded]
    angular = np.radians(rotate(turns.reshape(-1, 4), angular.reshape(-1, 3))).reshape(angular.shape)
    moments = [_values(prim.GetAttribute(MOMENT), codes, Vt.Vec3fArray) for prim in magnets]
    moments = np.stack(moments, axis=1) if moments else np.zeros((len(codes), 0, 3), dtype=np.float32)
    found = Recording(
        codes,
        seconds,
        UsdGeom.GetStageMetersPerUnit(stage),
        [str(prim.GetPath()) for prim in bodies],
        positions,
        turns,
        linear,
        angular.astype(np.float32),
        [str(prim.GetPath()) for prim in magnets],
        moments.astype(np.float32),
        np.array([prim.GetAttribute("warpmag:kind").Get() == "permanent" for prim in magnets], dtype=bool),
        _values(next((one for one in fields if one.HasAuthoredValue()), None), codes, Vt.Vec3fArray),
    )
    for swarm in swarms:
        found = _with_balls(found, swarm)
    return found


def _with_balls(record: Recording, swarm: Swarm) -> Recording:
    """Return a recording with the balls of an instancer."""
    said = [swarm.arrays(Usd.TimeCode(code)) for code in record.codes.tolist()]
    poses, speeds = np.stack([swarm.poses(one) for one in said]), np.stack([swarm.velocities(one) for one in said])
    given = {
        "positions": poses[..., :3],
        "turns": poses[..., 3:].astype(np.float32),
        "linear": speeds[..., :3].astype(np.float32),
        "angular": speeds[..., 3:].astype(np.float32),
    }
    found: dict[str, Any] = {name: np.concatenate([getattr(record, name), one], axis=1) for name, one in given.items()}
    if len(said[0][MOMENTS]):
        held = np.flatnonzero([one is not None for one in swarm.magnets])
        found["magnets"] = record.magnets + swarm.magnets[held].tolist()
        found["moments"] = np.concatenate([record.moments, np.stack([one[MOMENTS][held] for one in said])], axis=1)
        found["permanent"] = np.append(record.permanent, swarm.permanent[held])
    return replace(record, bodies=[*record.bodies, *swarm.bodies], **found)


def _codes(stage, bodies, magnets, swarms) -> np.ndarray:
    """Return the time codes at which a body or a moment has a sample, in order."""
    lists: set[tuple[float, ...]] = set()
    for prim in bodies:
        while prim and not prim.IsPseudoRoot():
            if prim.IsA(UsdGeom.Xformable):
                lists.add(tuple(UsdGeom.Xformable(prim).GetTimeSamples()))
            prim = prim.GetParent()
    lists |= {tuple(prim.GetAttribute(MOMENT).GetTimeSamples()) for prim in magnets}
    lists |= {tuple(stage.GetPrimAtPath(one.path).GetAttribute("positions").GetTimeSamples()) for one in swarms}
    codes = sorted(set().union(*lists))
    return np.array(codes or [stage.GetStartTimeCode()])


class _Poses:
    """Poses of bodies in the world at time codes."""

    def __init__(self, codes: np.ndarray):
        self._codes = codes
        self._first = UsdGeom.XformCache(codes[0])
        self._caches = []

    def of(self, prim: Usd.Prim) -> tuple[np.ndarray, np.ndarray]:
        """Return positions, shape [f, 3], and orientations, shape [f, 4]; exactly those of a run where that wrote."""
        order = list(UsdGeom.Xformable(prim).GetXformOpOrderAttr().Get() or ())
        resets = order[:1] == ["!resetXformStack!"]
        if order[resets:] not in ([TRANSLATE, ORIENT], [TRANSLATE, ORIENT, SCALE]) or not (
            resets or self._still_above(prim)
        ):
            return self._composed(prim)
        positions = _values(prim.GetAttribute(TRANSLATE), self._codes, Vt.Vec3dArray)
        turns = _values(prim.GetAttribute(ORIENT), self._codes, Vt.QuatfArray)
        parent = np.eye(4) if resets else np.array(self._first.GetLocalToWorldTransform(prim.GetParent()))
        if not np.array_equal(parent, np.eye(4)):
            positions = np.c_[positions, np.ones(len(positions))] @ parent[:, :3]
            turns = product(np.broadcast_to(turn_of(parent), turns.shape), turns).astype(np.float32)
        return positions, turns

    def _still_above(self, prim) -> bool:
        above = prim.GetParent()
        while above and not above.IsPseudoRoot():
            if is_animated(above):
                return False
            above = above.GetParent()
        return True

    def _composed(self, prim) -> tuple[np.ndarray, np.ndarray]:
        moves = is_animated(prim) or not self._still_above(prim)
        if moves and not self._caches:
            self._caches = [UsdGeom.XformCache(code) for code in self._codes]
        frames = [
            rigid(np.array(one.GetLocalToWorldTransform(prim))) for one in (self._caches if moves else [self._first])
        ]
        positions, turns = np.array([one[3, :3] for one in frames]), np.array([turn_of(one) for one in frames])
        for k in range(1, len(turns)):
            turns[k] *= -1.0 if turns[k] @ turns[k - 1] < 0.0 else 1.0
        count = len(self._codes)
        return np.broadcast_to(positions, (count, 3)), np.broadcast_to(turns, (count, 4)).astype(np.float32)


def _values(attribute: Usd.Attribute | None, codes: np.ndarray, array) -> np.ndarray:
    """Return the values of an attribute, shape [f, ...]; zero where it has none."""
    if not attribute or not attribute.HasAuthoredValue():
        return np.zeros((len(codes), 3))
    query = Usd.AttributeQuery(attribute)
    if not query.ValueMightBeTimeVarying():
        return np.repeat(np.array(array([query.Get(codes[0])])), len(codes), axis=0)
    return np.array(array([query.Get(code) for code in codes.tolist()]))
