"""What a stage says of bodies and magnets at one moment after another."""

from collections.abc import Sequence

import numpy as np
from pxr import Gf, Usd, UsdGeom

from warpmag.usd.read.alike import MOMENTS
from warpmag.usd.read.reader import hold
from warpmag.usd.read.swarms import Swarm


class Playback:
    """Poses and moments of a stage that :func:`warpmag.usd.open_stage` opened, at any moment of it."""

    def __init__(self, stage: Usd.Stage, swarms: Sequence[Swarm] = ()):
        """Follow ``stage``, and balls that have no prims in ``swarms``."""
        self._stage, self._swarms = stage, swarms

    def seek(self, time_code: float) -> None:
        """Go to a moment."""
        hold(self._stage, time_code)

    def poses(self, prims: Sequence[str]) -> np.ndarray:
        """Return where prims stand: place [m] and quaternion x y z w, world, shape [n, 7]."""
        cache, found = UsdGeom.XformCache(Usd.TimeCode.Default()), np.empty((len(prims), 7))
        own = {}
        for swarm in self._swarms:
            own |= zip(swarm.bodies, swarm.poses(swarm.arrays(Usd.TimeCode.Default())), strict=True)
        for row, prim in zip(found, prims, strict=True):
            if prim in own:
                row[:] = own[prim]
                continue
            matrix = Gf.Transform(cache.GetLocalToWorldTransform(self._stage.GetPrimAtPath(prim)))
            turn = matrix.GetRotation().GetQuat()
            row[:] = *matrix.GetTranslation(), *turn.GetImaginary(), turn.GetReal()
        return found

    def moments(self, prims: Sequence[str]) -> np.ndarray:
        """Return the moments of magnet prims [A·m²], world, shape [n, 3]; zero where none is written."""
        found, own = np.zeros((len(prims), 3)), {}
        for swarm in self._swarms:
            moments = swarm.arrays(Usd.TimeCode.Default())[MOMENTS]
            own |= zip(swarm.magnets, moments if len(moments) else np.zeros((len(swarm.bodies), 3)), strict=True)
        for row, prim in zip(found, prims, strict=True):
            if prim in own:
                row[:] = own[prim]
                continue
            value = self._stage.GetPrimAtPath(prim).GetAttribute("warpmag:moment").Get()
            row[:] = 0.0 if value is None else value
        return found
