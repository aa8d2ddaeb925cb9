"""Instancers of very many balls, which stay one prim: their balls are rows of its arrays, and no prims of their own.

100,000 prims take a gigabyte and a minute to open; an instancer of as many balls is opened at once, and each frame of
a run is a few arrays. ``alike.py`` says which instancers are such; ``warpmag:moment`` of its balls is a primvar.
"""

from collections.abc import Sequence
from dataclasses import replace
from typing import Any

import numpy as np
from pxr import Sdf, Usd, UsdGeom

from warpmag.usd.read.alike import ARRAYS, MOMENTS, AlikeBalls, BallFrames
from warpmag.usd.schemas import MAGNET_API, has_api
from warpmag.usd.write.columns import SWARM, Column
from warpmag.usd.write.placements import dot, rotate

_BLOCK = 8192
"""Balls that are placed at a time, so that what is computed of them stays in the processor's cache."""


class Swarm:
    """An instancer of balls.

    Attributes:
        path: The instancer.
        bodies: What the balls are called, in the order of its arrays.
        magnets: The magnet that stands for each, None for those without; shape [n].
        permanent: Whether that is permanent, shape [n].
        firsts: Instances that have prims.
    """

    def __init__(self, stage: Usd.Stage, groups: Sequence[AlikeBalls]):
        """Look at all balls of an instancer, ``groups`` of those that are alike."""
        self.path, self._stage, self._alike = str(groups[0].instancer), stage, groups
        self.firsts = [one.first for one in groups]
        self._groups = [(BallFrames(stage, one), one.rows) for one in groups]
        pairs = zip(groups, self._groups, strict=True)
        self._spheres = [_sphere(stage, one, frames) for one, (frames, _) in pairs]
        magnets = [_magnet(stage, one) for one in groups]
        names = np.empty(sum(len(one.rows) for one in groups), dtype=object)
        for one in groups:
            first, others = one.bodies()
            names[one.rows] = [first, *others]
        self.bodies: list[str] = names.tolist()
        self.magnets, self.permanent = np.full(len(names), None, dtype=object), np.zeros(len(names), dtype=bool)
        for one, magnet in zip(groups, magnets, strict=True):
            if magnet is not None:
                prim = str(magnet.GetPath())
                self.magnets[one.rows] = [prim, *one.others_of(prim)]
                self.permanent[one.rows] = magnet.GetAttribute("warpmag:kind").Get() == "permanent"

    def like(self, prims: Sequence[str]) -> dict[str, tuple[str, ...]]:
        """Return for those ``prims`` that are in an instance with prims what they are called in the others like it."""
        return {
            prim: tuple(one.others_of(prim))
            for one in self._alike
            for prim in prims
            if prim == str(one.first) or prim.startswith(f"{one.first}/")
        }

    def with_shapes(self, shapes: Sequence[Any], bodies: Sequence[str]) -> list[Any]:
        """Return drawn shapes with those of the balls that have no prims, behind those of the balls that they are like.

        Args:
            shapes: Records with ``path`` and the ``row`` of a body.
            bodies: The bodies.
        """
        rows, found = {path: row for row, path in enumerate(bodies)}, []
        others, moving = self.like([one.path for one in shapes]), self.like(self.bodies)
        for shape in shapes:
            found.append(shape)
            if shape.path in others:
                own = zip(others[shape.path], moving[bodies[shape.row]], strict=True)
                found += [replace(shape, path=path, row=rows[body]) for path, body in own]
        return found

    def columns(self) -> list[Column]:
        """Return what a run writes of it."""
        lengths = [2 if kind.name == "extent" else len(self.bodies) for kind in SWARM]
        return [Column(kind, [self.path], length) for kind, length in zip(SWARM, lengths, strict=True)]

    def place(
        self, body_q: np.ndarray, body_qd: np.ndarray, moments: np.ndarray, last_turns: np.ndarray | None
    ) -> list[np.ndarray]:
        """Return the values of :meth:`columns` in a frame, a row each.

        Args:
            body_q: Position [m] and quaternion x y z w of each ball in the world, shape [n, 7].
            body_qd: Linear [m/s] and angular velocity [rad/s], shape [n, 6].
            moments: Moments [A·m²], world frame, shape [n, 3].
            last_turns: Orientations of the frame before, next to which those of this one are to be; None in the first.
        """
        values = {name: np.empty((len(self.bodies), width), np.float32) for name, width in ARRAYS.items()}
        values[MOMENTS] = moments
        box = np.array([[np.inf] * 3, [-np.inf] * 3])
        for (frames, whole), (middle, radius) in zip(self._groups, self._spheres, strict=True):
            for rows in np.array_split(whole, -(-len(whole) // _BLOCK)):
                own = frames.instances(body_q[rows], body_qd[rows])
                for name, one in own.items():
                    values[name][rows] = one
                places = own["positions"] + rotate(own["orientations"], np.broadcast_to(middle, (len(rows), 3)))
                box[0] = np.minimum(box[0], places.min(axis=0) - radius)
                box[1] = np.maximum(box[1], places.max(axis=0) + radius)
        turns = values["orientations"]
        if last_turns is not None:
            turns *= np.where(dot(turns, last_turns.reshape(-1, 4)) < 0.0, -1.0, 1.0)
        return [one.reshape(1, -1) for one in (*values.values(), box.astype(np.float32))]

    def arrays(self, time: Usd.TimeCode) -> dict[str, np.ndarray]:
        """Return what its stage says of the balls at a moment; see :data:`ARRAYS`."""
        prim, found = self._stage.GetPrimAtPath(self.path), {}
        for name, width in ARRAYS.items():
            value = prim.GetAttribute(name).Get(time) if prim.HasAttribute(name) else None
            if name == "orientations" and (precise := prim.GetAttribute("orientationsf").Get(time)):
                value = precise
            found[name] = np.array(value if value else np.zeros((0, width)))
        return found

    def poses(self, arrays: dict[str, np.ndarray]) -> np.ndarray:
        """Return where balls are, position [m] and quaternion x y z w, world, shape [n, 7]."""
        found = np.empty((len(self.bodies), 7))
        for frames, rows in self._groups:
            found[rows] = frames.poses(_of(arrays, rows))
        return found

    def velocities(self, arrays: dict[str, np.ndarray]) -> np.ndarray:
        """Return their linear [m/s] and angular velocities [rad/s], world, shape [n, 6]; zero where none are given."""
        found = np.zeros((len(self.bodies), 6))
        for frames, rows in self._groups:
            found[rows] = frames.velocities(_of(arrays, rows))
        return found


def swarms_of(stage: Usd.Stage, apart: Sequence[AlikeBalls]) -> list[Swarm]:
    """Return the instancers among ``apart`` that a run writes as instancers."""
    groups: dict[Sdf.Path, list[AlikeBalls]] = {}
    for one in apart:
        if one.whole:
            groups.setdefault(one.instancer, []).append(one)
    return [Swarm(stage, one) for one in groups.values()]


def _of(arrays: dict[str, np.ndarray], rows: np.ndarray) -> dict[str, np.ndarray]:
    return {name: values[rows] if len(values) else values for name, values in arrays.items()}


def _magnet(stage: Usd.Stage, balls: AlikeBalls) -> Usd.Prim | None:
    """Return the magnet in the instance that has prims."""
    prims = Usd.PrimRange(stage.GetPrimAtPath(balls.first))
    return next((prim for prim in prims if has_api(prim, MAGNET_API)), None)


def _sphere(stage: Usd.Stage, balls: AlikeBalls, frames: BallFrames) -> tuple[np.ndarray, float]:
    """Return the middle of a ball in its instance, as it is scaled, and its radius."""
    prims = Usd.PrimRange(stage.GetPrimAtPath(balls.first))
    sphere = next(prim for prim in prims if prim.IsA(UsdGeom.Sphere))
    own = np.array(UsdGeom.XformCache(Usd.TimeCode.Default()).GetLocalToWorldTransform(sphere))
    radius = UsdGeom.Sphere(sphere).GetRadiusAttr().Get() * np.linalg.norm(own[:3, :3], axis=1).max()
    return frames.within(own[3, :3]), float(radius)
