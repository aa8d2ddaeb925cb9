"""Attributes that a run writes in each frame.

A frame is one block of bytes, the values of all attributes in the layout of a crate file: one value for each prim that
has the attribute, or an array with its length in front.
"""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from warpmag.usd.read.coils import CURRENT
from warpmag.usd.read.identical_balls import MOMENTS_PRIMVAR
from warpmag.usd.read.recording import ORIENT, TRANSLATE
from warpmag.usd.schemas import MOMENT
from warpmag.usd.write import crate

_LENGTH = 8
"""Bytes in front of an array that hold its length."""


@dataclass(frozen=True)
class _Kind:
    """Type of an attribute; ``kind``, ``dtype`` and ``size`` describe a value, or an element of an array."""

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
"""Attributes of a rigid body, see :class:`warpmag.usd.write.placements.Placed`."""
MAGNET = _Kind(MOMENT, "vector3f", crate.VEC3F, np.float32, 3)
CIRCUIT = _Kind(CURRENT, "double", crate.DOUBLE, np.float64, 1)
INSTANCER = (
    _Kind("positions", "point3f[]", crate.VEC3F, np.float32, 3),
    _Kind("orientationsf", "quatf[]", crate.QUATF, np.float32, 4),
    _Kind("velocities", "vector3f[]", crate.VEC3F, np.float32, 3),
    _Kind("angularVelocities", "vector3f[]", crate.VEC3F, np.float32, 3),
    _Kind(MOMENTS_PRIMVAR, "vector3f[]", crate.VEC3F, np.float32, 3),
    _Kind("extent", "float3[]", crate.VEC3F, np.float32, 3),
)
"""Attributes of an instancer, see :class:`warpmag.usd.write.instancer_frames.InstancerFrames`."""


@dataclass(frozen=True)
class Column:
    """One attribute of a frame."""

    kind: _Kind
    paths: Sequence[str]  # of the prims that have the attribute
    length: int | None = None  # number of elements of an array, None for an attribute that is no array

    @property
    def sizes(self) -> np.ndarray:
        """Size of each prim's value in a frame [bytes]."""
        size = self.kind.size * np.dtype(self.kind.dtype).itemsize
        return np.full(len(self.paths), size if self.length is None else _LENGTH + self.length * size)

    def pack(self, values: np.ndarray) -> bytes:
        """Return values, one row for each prim, as bytes of a frame."""
        return values.tobytes() if self.length is None else np.array([self.length]).tobytes() + values.tobytes()

    def unpack(self, data: bytes, start: int) -> np.ndarray:
        """Return the values that begin at byte ``start`` of a frame, shape [prims, ...]."""
        start += 0 if self.length is None else _LENGTH
        count = len(self.paths) * self.kind.size * (1 if self.length is None else self.length)
        values = np.frombuffer(data, dtype=self.kind.dtype, count=count, offset=start)
        return values.reshape(len(self.paths), -1 if count else self.kind.size)
