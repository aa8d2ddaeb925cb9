"""What a run writes in each frame: attributes, one after the other, of many prims or with an array of values.

A frame is their values as they lie in a crate file: those of all prims that have an attribute, or how long an array is
and what is in it.
"""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from warpmag.usd.read.alike import MOMENTS
from warpmag.usd.schemas import MOMENT
from warpmag.usd.write import crate

TRANSLATE, ORIENT, SCALE = (f"xformOp:{kind}:warpmag" for kind in ("translate", "orient", "scale"))
"""What moves a body, in this order."""
_LENGTH = 8
"""Bytes before an array, which say how long it is."""


@dataclass(frozen=True)
class _Kind:
    """An attribute that is written for prims of one sort; of arrays the type of what is in them."""

    name: str
    type_name: str
    kind: int
    dtype: type
    size: int


BODY = (
    _Kind(TRANSLATE, "double3", crate.VEC3D, np.float64, 3),
    _Kind(ORIENT, "quatf", crate.QUATF, np.float32, 4),
    _Kind("physics:velocity", "vector3f", crate.VEC3F, np.float32, 3),
    _Kind("physics:angularVelocity", "vector3f", crate.VEC3F, np.float32, 3),
)
"""Of a rigid body, see :class:`warpmag.usd.write.placements.Placed`."""
MAGNET = _Kind(MOMENT, "vector3f", crate.VEC3F, np.float32, 3)
SWARM = (
    _Kind("positions", "point3f[]", crate.VEC3F, np.float32, 3),
    _Kind("orientationsf", "quatf[]", crate.QUATF, np.float32, 4),
    _Kind("velocities", "vector3f[]", crate.VEC3F, np.float32, 3),
    _Kind("angularVelocities", "vector3f[]", crate.VEC3F, np.float32, 3),
    _Kind(MOMENTS, "vector3f[]", crate.VEC3F, np.float32, 3),
    _Kind("extent", "float3[]", crate.VEC3F, np.float32, 3),
)
"""Of an instancer, see :meth:`warpmag.usd.read.swarms.Swarm.place`."""


@dataclass(frozen=True)
class Column:
    """One attribute in a frame.

    Attributes:
        kind: The attribute.
        paths: The prims that have it.
        length: Values in its array, None where it has a value and no array.
    """

    kind: _Kind
    paths: Sequence[str]
    length: int | None = None

    @property
    def sizes(self) -> np.ndarray:
        """Size of what each prim has in a frame [bytes]."""
        size = self.kind.size * np.dtype(self.kind.dtype).itemsize
        return np.full(len(self.paths), size if self.length is None else _LENGTH + self.length * size)

    def packed(self, values: np.ndarray) -> bytes:
        """Return values, a row for each prim, as bytes of a frame."""
        return values.tobytes() if self.length is None else np.array([self.length]).tobytes() + values.tobytes()

    def unpacked(self, data: bytes, place: int) -> np.ndarray:
        """Return the values that lie at a place of a frame, shape [prims, ...]."""
        place += 0 if self.length is None else _LENGTH
        count = len(self.paths) * self.kind.size * (1 if self.length is None else self.length)
        values = np.frombuffer(data, dtype=self.kind.dtype, count=count, offset=place)
        return values.reshape(len(self.paths), -1 if count else self.kind.size)
