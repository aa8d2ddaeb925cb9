"""Instancers of very many identical balls, which stay one prim: each ball is a row of the arrays and has no prims.

100,000 prims take a gigabyte and a minute to open. An instancer of as many balls opens immediately, and each frame of a
run is a few arrays.
"""

from collections.abc import Callable, Sequence
from dataclasses import replace
from typing import Any

import numpy as np
from pxr import Sdf, Usd

from warpmag.usd.read.identical_balls import INSTANCE_ARRAYS, BallFrames, IdenticalBalls, rows_of
from warpmag.usd.schemas import MAGNET_API, has_api


class BallInstancer:
    """An instancer of balls.

    Attributes:
        path: Path of the instancer.
        stage: Its stage.
        groups: Its identical balls.
        frames: Transforms of the balls of each group.
        bodies: Path of each ball, in the order of the arrays.
        magnets: Path of the magnet of each ball, None for a ball without a magnet, shape [n].
        permanent: True for each ball with a permanent magnet, shape [n].
    """

    def __init__(self, stage: Usd.Stage, groups: Sequence[IdenticalBalls]):
        """Read the balls of one instancer."""
        self.path, self.stage, self.groups = str(groups[0].instancer), stage, groups
        self.frames = [BallFrames(stage, balls) for balls in groups]
        paths = np.empty(sum(len(balls.rows) for balls in groups), dtype=object)
        self.magnets, self.permanent = np.full(len(paths), None, dtype=object), np.zeros(len(paths), dtype=bool)
        for balls in groups:
            first, others = balls.bodies()
            paths[balls.rows] = [first, *others]
            prims = Usd.PrimRange(stage.GetPrimAtPath(balls.first))
            if magnet := next((prim for prim in prims if has_api(prim, MAGNET_API)), None):
                prim = str(magnet.GetPath())
                self.magnets[balls.rows] = [prim, *balls.copies_of(prim)]
                self.permanent[balls.rows] = magnet.GetAttribute("warpmag:kind").Get() == "permanent"
        self.bodies: list[str] = paths.tolist()

    def copies_of(self, prims: Sequence[str]) -> dict[str, tuple[str, ...]]:
        """Return, for each of ``prims`` in an instance with prims, the corresponding paths in identical instances."""
        return {
            prim: tuple(balls.copies_of(prim))
            for balls in self.groups
            for prim in prims
            if prim == str(balls.first) or prim.startswith(f"{balls.first}/")
        }

    def with_copies(self, shapes: Sequence[Any], bodies: Sequence[str]) -> list[Any]:
        """Return drawn shapes, each followed by its copies in identical balls without prims.

        Shapes are dataclass records with the ``path`` of a shape and the ``row`` of its body in the paths ``bodies``.
        """
        rows, copied = {path: row for row, path in enumerate(bodies)}, []
        shape_copies, body_copies = self.copies_of([shape.path for shape in shapes]), self.copies_of(self.bodies)
        for shape in shapes:
            copied.append(shape)
            if shape.path in shape_copies:
                pairs = zip(shape_copies[shape.path], body_copies[bodies[shape.row]], strict=True)
                copied += [replace(shape, path=path, row=rows[body]) for path, body in pairs]
        return copied

    def arrays(self, time: Usd.TimeCode) -> dict[str, np.ndarray]:
        """Return the arrays :data:`INSTANCE_ARRAYS` of the stage at a time code."""
        prim, arrays = self.stage.GetPrimAtPath(self.path), {}
        for name, width in INSTANCE_ARRAYS.items():
            value = prim.GetAttribute(name).Get(time) if prim.HasAttribute(name) else None
            if name == "orientations" and (single := prim.GetAttribute("orientationsf").Get(time)):
                value = single
            arrays[name] = np.array(value if value else np.zeros((0, width)))
        return arrays

    def poses(self, arrays: dict[str, np.ndarray]) -> np.ndarray:
        """Return positions [m] and quaternions (x, y, z, w) of the balls in the world, shape [n, 7]."""
        return self._per_ball(7, BallFrames.poses, arrays)

    def velocities(self, arrays: dict[str, np.ndarray]) -> np.ndarray:
        """Return linear [m/s] and angular velocities [rad/s] in the world, shape [n, 6]; zero where none are given."""
        return self._per_ball(6, BallFrames.velocities, arrays)

    def _per_ball(self, width: int, evaluate: Callable, arrays: dict[str, np.ndarray]) -> np.ndarray:
        """Return the results of a method of :class:`BallFrames` for the arrays of all balls, shape [n, width]."""
        values = np.empty((len(self.bodies), width))
        for balls, frames in zip(self.groups, self.frames, strict=True):
            values[balls.rows] = evaluate(frames, rows_of(arrays, balls.rows))
        return values


def ball_instancers(stage: Usd.Stage, deferred: Sequence[IdenticalBalls]) -> list[BallInstancer]:
    """Return the instancers among ``deferred`` that a run writes as instancers."""
    groups: dict[Sdf.Path, list[IdenticalBalls]] = {}
    for balls in deferred:
        if balls.stays_instancer:
            groups.setdefault(balls.instancer, []).append(balls)
    return [BallInstancer(stage, group) for group in groups.values()]
