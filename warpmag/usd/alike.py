"""Instances of one ball each that differ only in where they are: to read and to import one of them is enough.

The first has prims like any other instance. What Newton makes of it is copied for the others, whose prims come to be
when somebody wants the stage as a whole: a run that is written, say.
"""

from collections.abc import Callable, Iterator
from dataclasses import dataclass

import numpy as np
from pxr import Sdf, Usd, UsdGeom, UsdPhysics

from warpmag.usd.placements import product, rotate, turn_of
from warpmag.usd.schemas import MAGNET_API
from warpmag.usd.transforms import is_body, is_collider

_SCHEMAS = {"PhysicsRigidBodyAPI", "PhysicsCollisionAPI", "PhysicsMassAPI", "MaterialBindingAPI", MAGNET_API}
"""What may be applied to a ball and to what is in it: nothing that speaks of other prims but its material."""
_OF_OTHERS = (UsdPhysics.Joint, UsdPhysics.CollisionGroup)
"""Types of prims that speak of other prims, which may be single instances."""
_SIMILAR = 1e-6
"""What single precision leaves of a transform that turns and scales alike in all directions."""


@dataclass(frozen=True)
class AlikeBalls:
    """Instances of an instancer that are alike but for their transforms.

    Attributes:
        first: Path of the instance that has prims.
        others: Paths of the others.
        body: Path of the body below an instance.
        positions: Positions of all in the instancer, the first one's first, shape [1 + n, 3].
        turns: Orientations there, quaternions x y z w, shape [1 + n, 4]; empty if no instance is turned.
        write: Writes the prims of the others.
    """

    first: Sdf.Path
    others: list[str]
    body: Sdf.Path
    positions: np.ndarray
    turns: np.ndarray
    write: Callable[[], None]

    def bodies(self) -> tuple[str, list[str]]:
        """Return the path of the first body, and those of the others."""
        return f"{self.first}/{self.body}", [f"{one}/{self.body}" for one in self.others]

    def poses(self, stage: Usd.Stage, first: np.ndarray) -> np.ndarray:
        """Return where the other bodies are, position [m] and quaternion x y z w, shape [n, 7].

        Args:
            stage: The stage, which is in metres.
            first: The quaternion of the first one.
        """
        places = UsdGeom.XformCache(Usd.TimeCode.Default())
        above = np.array(places.GetLocalToWorldTransform(stage.GetPrimAtPath(self.first.GetParentPath())))
        place = np.array(places.GetLocalToWorldTransform(stage.GetPrimAtPath(self.first.AppendPath(self.body))))[3]
        offset = (place @ np.linalg.inv(above))[:3] - self.positions[0]
        turns = np.tile(first, (len(self.others), 1))
        offsets = np.tile(offset, (len(self.others), 1))
        if len(self.turns):
            back = (-1.0, -1.0, -1.0, 1.0)
            within = product(self.turns[1:], np.tile(self.turns[0] * back, (len(self.others), 1)))
            outer = np.tile(turn_of(above), (len(self.others), 1))
            turns = product(product(product(outer, within), outer * back), turns)
            offsets = rotate(within, offsets)
        local = np.c_[self.positions[1:] + offsets, np.ones(len(self.others))]
        return np.c_[(local @ above)[:, :3], turns]


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


def alike(paths: list[str], kinds: list[tuple], positions, turns, balls: dict[int, Sdf.Path]) -> Iterator[AlikeBalls]:
    """Yield those instances that are alike.

    Args:
        paths: Instances.
        kinds: Prototype and scale of each.
        positions: Positions, shape [n, 3].
        turns: Orientations, shape [n, 4], or empty.
        balls: The body below an instance of each prototype that is a ball.
    """
    rows_of: dict[tuple, list[int]] = {}
    for row, kind in enumerate(kinds):
        if kind[0] in balls:
            rows_of.setdefault(kind, []).append(row)
    for kind, rows in rows_of.items():
        if len(rows) > 1:
            others = [paths[row] for row in rows[1:]]
            own = turns[rows] if len(turns) else turns
            yield AlikeBalls(
                Sdf.Path(paths[rows[0]]), others, balls[kind[0]], positions[rows].astype(float), own, _nothing
            )
