"""Identical balls: instances of a PointInstancer that differ only in pose, velocity and moment.

One instance of each group gets prims, which Newton imports. Its bodies and shapes are then copied for the others. The
prims of the others are created only where the whole stage is needed, for example to write a run.
"""

from collections.abc import Callable, Iterator
from dataclasses import dataclass

import numpy as np
from pxr import Sdf, Usd, UsdGeom, UsdPhysics

from warpmag.declarations.rotations import conjugate, cross, multiply, rotate
from warpmag.usd.read.prims import descendants, is_body, is_collider, lineage
from warpmag.usd.read.transforms import LARGEST_COORDINATE, is_animated, rotation_of
from warpmag.usd.read.units import units_of
from warpmag.usd.schemas import MAGNET_API

COMPACT_COUNT = 5_000
"""Least number of instances that a run writes as an instancer: as prims, each would take 10 kB of memory."""
MOMENTS_PRIMVAR = "primvars:warpmag:moment"
"""Moments of instances [A·m²], world frame."""
INSTANCE_ARRAYS = {"positions": 3, "orientations": 4, "velocities": 3, "angularVelocities": 3, MOMENTS_PRIMVAR: 3}
"""Arrays with one value for each instance, and the numbers in a value; quaternions are (x, y, z, w)."""
_SCHEMAS = {"PhysicsRigidBodyAPI", "PhysicsCollisionAPI", "PhysicsMassAPI", "MaterialBindingAPI", MAGNET_API}
"""API schemas of a ball that can be copied: none refers to other prims, except for a material."""
_REFERRING = (UsdPhysics.Joint, UsdPhysics.CollisionGroup)
_SIMILARITY = 1e-6
"""Tolerance for rotation and uniform scale in a transform: rounding errors of single precision."""


@dataclass(frozen=True)
class IdenticalBalls:
    """Instances of one instancer that differ only in the values of its arrays.

    ``stays_instancer`` means that a run writes the instancer as an instancer: it is large, and all its instances are
    identical balls.
    """

    first: Sdf.Path  # of the instance that has prims
    others: list[str]  # paths of the other instances
    body: Sdf.Path  # of the body below an instance
    rows: np.ndarray  # rows of the instances in the arrays, ``first`` in front, shape [1 + n]
    arrays: dict[str, np.ndarray]  # ``INSTANCE_ARRAYS``, shape [1 + n, ...]; empty where the instancer has none
    stays_instancer: bool
    create_prims: Callable[[], None] = lambda: None  # creates the prims of the other instances

    @property
    def instancer(self) -> Sdf.Path:
        """Path of the instancer."""
        return self.first.GetParentPath()

    def bodies(self) -> tuple[str, list[str]]:
        """Return the path of the first body and the paths of the other bodies."""
        return f"{self.first}/{self.body}", [f"{instance}/{self.body}" for instance in self.others]

    def copies_of(self, prim: str) -> list[str]:
        """Return the paths in the other instances that correspond to a prim of the first."""
        below = prim.removeprefix(str(self.first))
        return [f"{instance}{below}" for instance in self.others]


class BallFrames:
    """Transforms between identical balls, their instances and the world.

    An instance at ``x`` with rotation ``q`` has its body at ``x + q * offset`` in the instancer, with rotation
    ``q * rotation``.

    Attributes:
        instancer: World transform of the instancer for rows of points, shape [4, 4].
        instancer_rotation: Its rotation.
        offset: Position of the body in its instance, with the scale applied, shape [3].
        rotation: Rotation of the body in its instance.
    """

    def __init__(self, stage: Usd.Stage, balls: IdenticalBalls, rotation: np.ndarray | None = None):
        """Read the transforms of the instance that has prims; the stage is in meters.

        ``rotation`` is the rotation of the first body in the world, such as Newton's, so that all bodies have its
        rounding; by default the rotation in the stage.
        """
        transforms = UsdGeom.XformCache(Usd.TimeCode.Default())
        self.instancer = np.array(transforms.GetLocalToWorldTransform(stage.GetPrimAtPath(balls.instancer)))
        self.instancer_rotation = rotation_of(self.instancer)
        first = np.array(transforms.GetLocalToWorldTransform(stage.GetPrimAtPath(balls.first.AppendPath(balls.body))))
        self._origin, self._inverse = balls.arrays["positions"][0], conjugate(self._rotations(balls.arrays)[:1])
        self.offset = self.to_instance(first[3, :3])
        rotation = rotation_of(first) if rotation is None else rotation
        to_instance = multiply(self._inverse, conjugate(self.instancer_rotation[None]))
        self.rotation = multiply(to_instance, rotation[None])[0]

    def to_instance(self, position: np.ndarray) -> np.ndarray:
        """Return a world position in the frame of the first instance, with its scale applied."""
        local = (np.append(position, 1.0) @ np.linalg.inv(self.instancer))[:3] - self._origin
        return rotate(self._inverse, local[None])[0]

    def poses(self, arrays: dict[str, np.ndarray]) -> np.ndarray:
        """Return positions [m] and quaternions (x, y, z, w) of the bodies in the world, shape [n, 7]."""
        positions, rotations = arrays["positions"].astype(float), self._rotations(arrays)
        local = np.c_[positions + rotate(rotations, self._repeat(self.offset, rotations)), np.ones(len(positions))]
        inner = multiply(rotations, self._repeat(self.rotation, rotations))
        return np.c_[(local @ self.instancer)[:, :3], multiply(self._repeat(self.instancer_rotation, rotations), inner)]

    def velocities(self, arrays: dict[str, np.ndarray], first: np.ndarray | None = None) -> np.ndarray:
        """Return linear [m/s] and angular velocities [rad/s] of the bodies in the world, shape [n, 6].

        Without velocities in the arrays, each body has the velocities ``first`` of the first body, shape [6], rotated
        with the body; by default zero.
        """
        linear, angular = arrays["velocities"], np.radians(arrays["angularVelocities"])
        rotations = self._rotations(arrays)
        velocities = np.zeros((len(rotations), 6))
        if first is not None:
            bodies = self.poses(arrays)[:, 3:]
            inverse = self._repeat(conjugate(bodies[0]), rotations)
            for part in (slice(3), slice(3, 6)):
                velocities[:, part] = rotate(bodies, rotate(inverse, self._repeat(first[part], rotations)))
        outer = self._repeat(self.instancer_rotation, rotations)
        if len(linear):
            arms = rotate(rotations, self._repeat(self.offset, rotations))
            velocities[:, :3] = rotate(outer, linear + (cross(angular, arms) if len(angular) else 0.0))
        if len(angular):
            velocities[:, 3:] = rotate(outer, angular)
        return velocities

    def instance_arrays(self, body_q: np.ndarray, body_qd: np.ndarray) -> dict[str, np.ndarray]:
        """Return instance arrays of bodies, float64: the inverse of :meth:`poses` and :meth:`velocities`."""
        # column-major arrays halve the time
        body_q, body_qd = (values.astype(float, order="F") for values in (body_q, body_qd))
        inverse = self._repeat(conjugate(self.instancer_rotation), body_q)
        rotations = multiply(multiply(inverse, body_q[:, 3:]), self._repeat(conjugate(self.rotation), body_q))
        rotations /= np.linalg.norm(rotations, axis=1, keepdims=True)
        arms = rotate(rotations, self._repeat(self.offset, rotations))
        angular = rotate(inverse, body_qd[:, 3:])
        return {
            "positions": (np.c_[body_q[:, :3], np.ones(len(body_q))] @ np.linalg.inv(self.instancer))[:, :3] - arms,
            "orientations": rotations,
            "velocities": rotate(inverse, body_qd[:, :3]) - cross(angular, arms),
            "angularVelocities": np.degrees(angular),
        }

    @staticmethod
    def _rotations(arrays: dict[str, np.ndarray]) -> np.ndarray:
        orientations = arrays["orientations"]
        return orientations if len(orientations) else np.tile((0.0, 0.0, 0.0, 1.0), (len(arrays["positions"]), 1))

    @staticmethod
    def _repeat(value: np.ndarray, rows: np.ndarray) -> np.ndarray:
        return np.broadcast_to(value, (len(rows), len(value)))


def rows_of(arrays: dict[str, np.ndarray], rows: np.ndarray) -> dict[str, np.ndarray]:
    """Return rows of arrays; empty arrays stay empty."""
    return {name: values[rows] if len(values) else values for name, values in arrays.items()}


def identical_balls(
    instancer: UsdGeom.PointInstancer,
    time_code: float,
    paths: list[str],
    rows: np.ndarray,
    kinds: np.ndarray,
    arrays: dict[str, np.ndarray],
) -> Iterator[IdenticalBalls]:
    """Yield groups of two or more identical balls of an instancer; none unless units are SI and arrays are finite.

    None either if an instance is out of bounds: as a prim it has an error.
    Each of n instances has a path, a row in the arrays, and a kind: its prototype and scale, shape [n, 1] or [n, 4].
    """
    stage = instancer.GetPrim().GetStage()
    finite = all(np.isfinite(values).all() for values in arrays.values())
    if not (finite and units_of(stage).are_si and _has_interchangeable_instances(stage, instancer, time_code)):
        return
    world = np.array(UsdGeom.XformCache(Usd.TimeCode(time_code)).GetLocalToWorldTransform(instancer.GetPrim()))
    positions = arrays["positions"].reshape(-1, 3)  # an instancer may have none
    if not np.abs(positions @ world[:3, :3] + world[3, :3]).max(initial=0.0) <= LARGEST_COORDINATE:
        return
    targets = instancer.GetPrototypesRel().GetForwardedTargets()
    bodies = [_ball_in(stage.GetPrimAtPath(target)) for target in targets]
    _, labels = np.unique(kinds, axis=0, return_inverse=True)
    order = np.argsort(labels.ravel(), kind="stable")
    members = np.split(order, np.flatnonzero(np.diff(labels.ravel()[order])) + 1)
    members = sorted(members, key=lambda group: group[0]) if len(order) else []
    groups = [(bodies[int(kinds[group[0], 0])], group) for group in members]
    stays = len(rows) >= COMPACT_COUNT and len(rows) == len(arrays["positions"])
    stays = stays and all(body is not None and len(group) > 1 for body, group in groups)
    stays = stays and _can_stay_instancer(instancer, time_code)
    for body, group in groups:
        if body is not None and len(group) > 1:
            first, *others = (paths[row] for row in group.tolist())
            yield IdenticalBalls(Sdf.Path(first), others, body, rows[group], rows_of(arrays, rows[group]), stays)


def _has_interchangeable_instances(stage: Usd.Stage, instancer: UsdGeom.PointInstancer, time_code: float) -> bool:
    """Return True if no prim can refer to a single instance, and the scale of the instancer is uniform."""
    path = instancer.GetPath()
    for prim in Usd.PrimRange.Stage(stage, Usd.TraverseInstanceProxies()):
        if any(map(prim.IsA, _REFERRING)) or prim.HasAPI(UsdPhysics.FilteredPairsAPI):
            return False
        if prim.IsA(UsdGeom.PointInstancer) and prim.GetPath() != path:
            if any(map(path.HasPrefix, UsdGeom.PointInstancer(prim).GetPrototypesRel().GetForwardedTargets())):
                return False
    world = UsdGeom.XformCache(Usd.TimeCode(time_code)).GetLocalToWorldTransform(instancer.GetPrim())
    matrix = np.array(world)[:3, :3]
    scale = np.cbrt(np.linalg.det(matrix))
    similar = np.allclose(matrix @ matrix.T, scale**2 * np.eye(3), rtol=0.0, atol=_SIMILARITY * scale**2)
    return bool(scale > 0.0 and similar)


def _can_stay_instancer(instancer: UsdGeom.PointInstancer, time_code: float) -> bool:
    """Return True if nothing else moves or scales an instancer, and scales and prototypes are constant."""
    prim = instancer.GetPrim()
    if instancer.GetAccelerationsAttr().HasAuthoredValue():
        return False
    if any(prim.GetAttribute(name).GetNumTimeSamples() > 1 for name in ("scales", "protoIndices")):
        return False
    world = np.array(UsdGeom.XformCache(Usd.TimeCode(time_code)).GetLocalToWorldTransform(prim))[:3, :3]
    if not np.allclose(world @ world.T, np.eye(3), rtol=0.0, atol=_SIMILARITY):
        return False
    return not any(is_animated(parent) or is_body(parent) or parent.IsInstance() for parent in lineage(prim))


def _ball_in(prototype: Usd.Prim) -> Sdf.Path | None:
    """Return the path of a prototype's body below the instance; None unless its only content is one dynamic ball."""
    prims = list(descendants(prototype))
    bodies = [prim for prim in prims if is_body(prim)]
    shapes = [prim for prim in prims if prim.IsA(UsdGeom.Gprim) or prim.IsA(UsdGeom.PointInstancer)]
    if len(bodies) != 1 or len(shapes) != 1 or not shapes[0].IsA(UsdGeom.Sphere) or not is_collider(shapes[0]):
        return None
    if UsdPhysics.RigidBodyAPI(bodies[0]).GetKinematicEnabledAttr().Get() or not all(map(_can_be_copied, prims)):
        return None
    if not shapes[0].GetPath().HasPrefix(bodies[0].GetPath()):
        return None
    return bodies[0].GetPath().MakeRelativePath(prototype.GetPath().GetParentPath())


def _can_be_copied(prim: Usd.Prim) -> bool:
    """Return True if a prim has no time samples and refers to no other prim, except for a material."""
    schemas = prim.GetPrimTypeInfo().GetAppliedAPISchemas()
    sampled = any(attribute.GetNumTimeSamples() or attribute.HasSpline() for attribute in prim.GetAttributes())
    return _SCHEMAS.issuperset(schemas) and not sampled and not prim.IsInstanceProxy() and not prim.IsInstance()
