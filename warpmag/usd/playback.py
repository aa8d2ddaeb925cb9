"""What a stage says of bodies and magnets at one moment after another."""

from collections.abc import Sequence

import numpy as np
from pxr import Gf, Usd, UsdGeom

from warpmag.usd.reader import hold


class Playback:
    """Poses and moments of a stage that :func:`warpmag.usd.open_stage` opened, at any moment of it."""

    def __init__(self, stage: Usd.Stage):
        """Follow ``stage``."""
        self._stage = stage

    def seek(self, time_code: float) -> None:
        """Go to a moment."""
        hold(self._stage, time_code)

    def poses(self, prims: Sequence[str]) -> np.ndarray:
        """Return where prims stand: place [m] and quaternion x y z w, world, shape [n, 7]."""
        cache, found = UsdGeom.XformCache(Usd.TimeCode.Default()), np.empty((len(prims), 7))
        for row, prim in zip(found, prims, strict=True):
            matrix = Gf.Transform(cache.GetLocalToWorldTransform(self._stage.GetPrimAtPath(prim)))
            turn = matrix.GetRotation().GetQuat()
            row[:] = *matrix.GetTranslation(), *turn.GetImaginary(), turn.GetReal()
        return found

    def moments(self, prims: Sequence[str]) -> np.ndarray:
        """Return the moments of magnet prims [A·m²], world, shape [n, 3]; zero where none is written."""
        found = np.zeros((len(prims), 3))
        for row, prim in zip(found, prims, strict=True):
            value = self._stage.GetPrimAtPath(prim).GetAttribute("warpmag:moment").Get()
            row[:] = 0.0 if value is None else value
        return found
