"""Instances of one ball each that differ only in where they are: to read and to import one of them is enough.

The first has prims like any other instance. What Newton makes of it is copied for the others, whose prims come to be
when somebody wants the stage as a whole: a run that is written, say.
"""

from collections.abc import Callable, Iterator
from dataclasses import dataclass

import numpy as np
from pxr import Sdf, Usd, UsdGeom, UsdPhysics

from warpmag.usd.read.transforms import is_animated, is_body, is_collider
from warpmag.usd.schemas import MAGNET_API
from warpmag.usd.write.placements import cross, product, rotate, turn_of

_SCHEMAS = {"PhysicsRigidBodyAPI", "PhysicsCollisionAPI", "PhysicsMassAPI", "MaterialBindingAPI", MAGNET_API}
"""What may be applied to a ball and to what is in it: nothing that speaks of other prims but its material."""
_OF_OTHERS = (UsdPhysics.Joint, UsdPhysics.CollisionGroup)
"""Types of prims that speak of other prims, which may be single instances."""
MANY = 5_000
"""So many instances a run writes as an instancer: as prims they would take 10 kB of memory each."""
_SIMILAR = 1e-6
"""What single precision leaves of a transform that turns and scales alike in all directions."""


ARRAYS = {
    "positions": 3,
    "orientations": 4,
    "velocities": 3,
    "angularVelocities": 3,
    "primvars:warpmag:moment": 3,
}
"""What may be said of single instances, and numbers in a value; the last is the moment [A·m²], world frame."""
MOMENTS = "primvars:warpmag:moment"
_BACK = (-1.0, -1.0, -1.0, 1.0)
"""What makes of a quaternion its inverse."""


@dataclass(frozen=True)
class AlikeBalls:
    """Instances of an instancer that are alike but for what its arrays say of each.

    Attributes:
        first: Path of the instance that has prims.
        others: Paths of the others.
        body: Path of the body below an instance.
        rows: Where they are in the arrays, the first one first, shape [1 + n].
        arrays: Those of :data:`ARRAYS`, of these instances, shape [1 + n, ...]; quaternions x y z w, empty if none.
        whole: Whether the instancer holds nothing else, and so many that a run writes it as an instancer.
        write: Writes the prims of the others.
    """

    first: Sdf.Path
    others: list[str]
    body: Sdf.Path
    rows: np.ndarray
    arrays: dict[str, np.ndarray]
    whole: bool
    write: Callable[[], None]

    @property
    def instancer(self) -> Sdf.Path:
        """The instancer."""
        return self.first.GetParentPath()

    def bodies(self) -> tuple[str, list[str]]:
        """Return the path of the first body, and those of the others."""
        return f"{self.first}/{self.body}", [f"{one}/{self.body}" for one in self.others]

    def others_of(self, prim: str) -> list[str]:
        """Return for a prim of the first instance those of the others."""
        within = prim.removeprefix(str(self.first))
        return [f"{one}{within}" for one in self.others]


class BallFrames:
    """How alike balls stand to their instances, and these to the world.

    A body of an instance at ``x``, turned by ``q``, is at ``x + q * offset`` in the instancer, turned by ``q * turn``.

    Attributes:
        above: Transform of the instancer, shape [4, 4], for rows of points.
        outer: Its rotation.
        offset: Place of the body in the instance, as it is scaled, shape [3].
        turn: Rotation of the body in the instance.
    """

    def __init__(self, stage: Usd.Stage, balls: AlikeBalls, turn: np.ndarray | None = None):
        """Look at the instance that has prims.

        Args:
            stage: The stage, which is in metres.
            balls: Its instances.
            turn: Rotation of the first body, for those that take it over to have its bits; by default the stage's.
        """
        places = UsdGeom.XformCache(Usd.TimeCode.Default())
        self.above = np.array(places.GetLocalToWorldTransform(stage.GetPrimAtPath(balls.instancer)))
        self.outer = turn_of(self.above)
        first = np.array(places.GetLocalToWorldTransform(stage.GetPrimAtPath(balls.first.AppendPath(balls.body))))
        self._origin, self._back = balls.arrays["positions"][0], self._turns(balls.arrays)[:1] * _BACK
        self.offset = self.within(first[3, :3])
        self.turn = product(
            product(self._back, self.outer[None] * _BACK), (turn_of(first) if turn is None else turn)[None]
        )[0]

    def within(self, place: np.ndarray) -> np.ndarray:
        """Return where a place in the world is in that instance, as it would be if it were not turned."""
        local = (np.append(place, 1.0) @ np.linalg.inv(self.above))[:3] - self._origin
        return rotate(self._back, local[None])[0]

    def poses(self, arrays: dict[str, np.ndarray]) -> np.ndarray:
        """Return where bodies are in the world, position [m] and quaternion x y z w, shape [n, 7]."""
        positions, turns = arrays["positions"].astype(float), self._turns(arrays)
        local = np.c_[positions + rotate(turns, self._each(self.offset, turns)), np.ones(len(positions))]
        inner = product(turns, self._each(self.turn, turns))
        return np.c_[(local @ self.above)[:, :3], product(self._each(self.outer, turns), inner)]

    def velocities(self, arrays: dict[str, np.ndarray], first: np.ndarray | None = None) -> np.ndarray:
        """Return linear [m/s] and angular velocities [rad/s] of bodies, world, shape [n, 6].

        Args:
            arrays: What is said of them.
            first: Those of the first body, by which the others move where nothing is said; by default it rests.
        """
        given, spins, turns = arrays["velocities"], np.radians(arrays["angularVelocities"]), self._turns(arrays)
        found = np.zeros((len(turns), 6))
        if first is not None:
            bodies = self.poses(arrays)[:, 3:]
            back = self._each(bodies[0] * _BACK, turns)
            for part in (slice(3), slice(3, 6)):
                found[:, part] = rotate(bodies, rotate(back, self._each(first[part], turns)))
        outer = self._each(self.outer, turns)
        if len(given):
            arms = rotate(turns, self._each(self.offset, turns))
            found[:, :3] = rotate(outer, given + (cross(spins, arms) if len(spins) else 0.0))
        if len(spins):
            found[:, 3:] = rotate(outer, spins)
        return found

    def instances(self, body_q: np.ndarray, body_qd: np.ndarray) -> dict[str, np.ndarray]:
        """Return the arrays of which :meth:`poses` and :meth:`velocities` make bodies in the world, float64.

        Args:
            body_q: Position [m] and quaternion x y z w, shape [n, 7].
            body_qd: Linear [m/s] and angular velocity [rad/s], shape [n, 6].
        """
        # column by column in memory, which takes half the time
        body_q, body_qd = (values.astype(float, order="F") for values in (body_q, body_qd))
        inward = self._each(self.outer * _BACK, body_q)
        turns = product(product(inward, body_q[:, 3:]), self._each(self.turn * _BACK, body_q))
        turns /= np.linalg.norm(turns, axis=1, keepdims=True)
        arms = rotate(turns, self._each(self.offset, turns))
        spins = rotate(inward, body_qd[:, 3:])
        return {
            "positions": (np.c_[body_q[:, :3], np.ones(len(body_q))] @ np.linalg.inv(self.above))[:, :3] - arms,
            "orientations": turns,
            "velocities": rotate(inward, body_qd[:, :3]) - cross(spins, arms),
            "angularVelocities": np.degrees(spins),
        }

    @staticmethod
    def _turns(arrays: dict[str, np.ndarray]) -> np.ndarray:
        own = arrays["orientations"]
        return own if len(own) else np.tile((0.0, 0.0, 0.0, 1.0), (len(arrays["positions"]), 1))

    @staticmethod
    def _each(value: np.ndarray, rows: np.ndarray) -> np.ndarray:
        return np.broadcast_to(value, (len(rows), len(value)))


def may_be_alike(stage: Usd.Stage, instancer: UsdGeom.PointInstancer, time_code: float) -> bool:
    """Whether nothing of a stage speaks of single instances of an instancer, and it does not distort them."""
    path = instancer.GetPath()
    for prim in Usd.PrimRange.Stage(stage, Usd.TraverseInstanceProxies()):
        if (
            prim.IsA(UsdPhysics.Joint)
            or prim.IsA(UsdPhysics.CollisionGroup)
            or prim.HasAPI(UsdPhysics.FilteredPairsAPI)
        ):
            return False
        if prim.IsA(UsdGeom.PointInstancer) and prim.GetPath() != path:
            if any(
                path.HasPrefix(one) for one in UsdGeom.PointInstancer(prim).GetPrototypesRel().GetForwardedTargets()
            ):
                return False
    above = np.array(UsdGeom.XformCache(Usd.TimeCode(time_code)).GetLocalToWorldTransform(instancer.GetPrim()))[:3, :3]
    scale = np.cbrt(np.linalg.det(above))
    return bool(scale > 0.0 and np.allclose(above @ above.T, scale**2 * np.eye(3), rtol=0.0, atol=_SIMILAR * scale**2))


def may_stay_whole(instancer: UsdGeom.PointInstancer, time_code: float) -> bool:
    """Whether a run may write an instancer as one: nothing else moves or scales it, nor its instances over time."""
    prim = instancer.GetPrim()
    if instancer.GetAccelerationsAttr().HasAuthoredValue():
        return False
    if any(prim.GetAttribute(name).GetNumTimeSamples() > 1 for name in ("scales", "protoIndices")):
        return False
    above = np.array(UsdGeom.XformCache(Usd.TimeCode(time_code)).GetLocalToWorldTransform(prim))[:3, :3]
    if not np.allclose(above @ above.T, np.eye(3), rtol=0.0, atol=_SIMILAR):
        return False
    while prim and not prim.IsPseudoRoot():
        if is_animated(prim) or is_body(prim) or prim.IsInstance():
            return False
        prim = prim.GetParent()
    return True


def ball_in(root: Usd.Prim) -> Sdf.Path | None:
    """Return the path below a prototype of its only body, if that is one ball that nothing holds, else None."""
    prims = list(Usd.PrimRange(root, Usd.TraverseInstanceProxies(Usd.PrimAllPrimsPredicate)))
    bodies = [prim for prim in prims if is_body(prim)]
    seen = [prim for prim in prims if prim.IsA(UsdGeom.Gprim) or prim.IsA(UsdGeom.PointInstancer)]
    if len(bodies) != 1 or len(seen) != 1 or not seen[0].IsA(UsdGeom.Sphere) or not is_collider(seen[0]):
        return None
    if UsdPhysics.RigidBodyAPI(bodies[0]).GetKinematicEnabledAttr().Get() or not all(map(_stands_alone, prims)):
        return None
    if not seen[0].GetPath().HasPrefix(bodies[0].GetPath()):
        return None
    return bodies[0].GetPath().MakeRelativePath(root.GetPath().GetParentPath())


def _stands_alone(prim: Usd.Prim) -> bool:
    """Whether a prim has no values over time, and nothing of other prims but a material."""
    schemas = prim.GetPrimTypeInfo().GetAppliedAPISchemas()
    sampled = any(one.GetNumTimeSamples() or one.HasSpline() for one in prim.GetAttributes())
    return _SCHEMAS.issuperset(schemas) and not sampled and not prim.IsInstanceProxy() and not prim.IsInstance()


def _nothing() -> None:
    """Stands for what writes prims until somebody has it."""


def alike(
    paths: list[str], rows: np.ndarray, kinds: np.ndarray, arrays: dict[str, np.ndarray], balls: dict[int, Sdf.Path]
) -> Iterator[AlikeBalls]:
    """Yield those instances that are alike.

    Args:
        paths: Instances.
        rows: Where each is in the arrays.
        kinds: Prototype and scale of each, shape [n, 1] or [n, 4].
        arrays: What the instancer says of all that it has.
        balls: The body below an instance of each prototype that is a ball.
    """
    _, which = np.unique(kinds, axis=0, return_inverse=True)
    order = np.argsort(which.ravel(), kind="stable")
    groups = np.split(order, np.flatnonzero(np.diff(which.ravel()[order])) + 1)
    groups = sorted(groups, key=lambda own: own[0]) if len(order) else []
    found = [(int(kinds[own[0], 0]), own) for own in groups]
    whole = len(rows) >= MANY and len(rows) == len(arrays["positions"])
    whole = whole and all(kind in balls and len(own) > 1 for kind, own in found)
    for kind, own in found:
        if kind in balls and len(own) > 1:
            said = {name: values[rows[own]] if len(values) else values for name, values in arrays.items()}
            others = [paths[row] for row in own[1:].tolist()]
            yield AlikeBalls(Sdf.Path(paths[own[0]]), others, balls[kind], rows[own], said, whole, _nothing)
