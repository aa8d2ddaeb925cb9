"""Frames of a :class:`BallInstancer`: the arrays that a run writes for an instancer of very many balls."""

import numpy as np
from pxr import Usd, UsdGeom

from warpmag.declarations.rotations import dot, rotate
from warpmag.usd.read.ball_instancers import BallInstancer
from warpmag.usd.read.identical_balls import INSTANCE_ARRAYS, MOMENTS_PRIMVAR, BallFrames, IdenticalBalls
from warpmag.usd.write.columns import INSTANCER, Column

_BLOCK = 8192
"""Balls computed at a time, so that their arrays stay in the processor's cache."""


class InstancerFrames:
    """Converts bodies of one instancer into its arrays, the ``columns`` of a frame."""

    def __init__(self, instancer: BallInstancer):
        """Read the spheres of an instancer."""
        lengths = [2 if kind.name == "extent" else len(instancer.bodies) for kind in INSTANCER]
        self.columns = [Column(kind, [instancer.path], length) for kind, length in zip(INSTANCER, lengths, strict=True)]
        self._count = len(instancer.bodies)
        self._groups = [
            (balls.rows, frames, *_sphere(instancer.stage, balls, frames))
            for balls, frames in zip(instancer.groups, instancer.frames, strict=True)
        ]

    def values(
        self, body_q: np.ndarray, body_qd: np.ndarray, moments: np.ndarray, last_rotations: np.ndarray | None
    ) -> list[np.ndarray]:
        """Return the values of ``columns`` from poses, as in :meth:`Placements.place`, and moments [A·m²]."""
        values = {name: np.empty((self._count, width), np.float32) for name, width in INSTANCE_ARRAYS.items()}
        values[MOMENTS_PRIMVAR] = moments
        box = np.array([[np.inf] * 3, [-np.inf] * 3])
        for group, frames, center, radius in self._groups:
            for rows in np.array_split(group, -(-len(group) // _BLOCK)):
                arrays = frames.instance_arrays(body_q[rows], body_qd[rows])
                for name, array in arrays.items():
                    values[name][rows] = array
                offsets = rotate(arrays["orientations"], np.broadcast_to(center, (len(rows), 3)))
                centers = arrays["positions"] + offsets
                box[0] = np.minimum(box[0], centers.min(axis=0) - radius)
                box[1] = np.maximum(box[1], centers.max(axis=0) + radius)
        rotations = values["orientations"]
        if last_rotations is not None:
            rotations *= np.where(dot(rotations, last_rotations.reshape(-1, 4)) < 0.0, -1.0, 1.0)
        return [array.reshape(1, -1) for array in (*values.values(), box.astype(np.float32))]


def _sphere(stage: Usd.Stage, balls: IdenticalBalls, frames: BallFrames) -> tuple[np.ndarray, float]:
    """Return the center of a ball in its instance, with the scale applied, and its radius [m]."""
    prims = Usd.PrimRange(stage.GetPrimAtPath(balls.first))
    sphere = next(prim for prim in prims if prim.IsA(UsdGeom.Sphere))
    world = np.array(UsdGeom.XformCache(Usd.TimeCode.Default()).GetLocalToWorldTransform(sphere))
    radius = UsdGeom.Sphere(sphere).GetRadiusAttr().Get() * np.linalg.norm(world[:3, :3], axis=1).max()
    return frames.to_instance(world[3, :3]), float(radius)
