"""Values that keys give over time, and motions made of them: plain data, read from a stage and followed on a device.

Neither Warp, Newton nor USD is imported here.
"""

import json
from dataclasses import asdict, dataclass, replace

import numpy as np


@dataclass(frozen=True)
class Keys:
    """Values at some times: between two of them interpolated, before the first and after the last held.

    Attributes:
        times: Times, rising, shape [k]: [s] since the start, or time codes of a stage as long as it is being read.
        values: Numbers of each, float64, shape [k, width].
        interpolation: ``linear``, ``held``, or ``slerp`` for quaternions x y z w.
    """

    times: np.ndarray
    values: np.ndarray
    interpolation: str = "linear"

    @classmethod
    def constant(cls, values) -> "Keys":
        """Return values that never change, shape [width]."""
        return cls(np.zeros(1), np.reshape(np.asarray(values, dtype=float), (1, -1)))

    def in_seconds(self, start: float, rate: float) -> "Keys":
        """Return keys at time codes, ``rate`` of which make a second, as keys at seconds since the code ``start``."""
        return replace(self, times=(self.times - start) / rate)

    def to_text(self) -> str:
        """Return the keys as JSON."""
        return json.dumps(asdict(self), default=np.ndarray.tolist)

    @classmethod
    def from_text(cls, text: str) -> "Keys":
        """Return the keys that :meth:`to_text` wrote."""
        found = json.loads(text)
        return cls(np.array(found["times"]), np.array(found["values"]), found["interpolation"])


@dataclass(frozen=True)
class Operation:
    """One transform of those that together place something.

    Attributes:
        kind: ``translate``, ``scale``, ``orient``, ``matrix``, or ``rotate`` with the order of its axes, ``rotateXYZ``:
            about x first. A matrix has 16 numbers by rows, and acts on rows, as USD's do.
        keys: Its numbers; of rotations three angles [degrees].
        inverse: Whether it is undone instead.
    """

    kind: str
    keys: Keys
    inverse: bool = False


@dataclass(frozen=True)
class Motion:
    """How something moves in the world.

    Attributes:
        operations: Transforms, the outermost first: the last acts on points first.
    """

    operations: tuple[Operation, ...]

    def in_seconds(self, start: float, rate: float) -> "Motion":
        """Return the motion with its keys at seconds, see :meth:`Keys.in_seconds`."""
        return Motion(tuple(replace(one, keys=one.keys.in_seconds(start, rate)) for one in self.operations))


@dataclass(frozen=True)
class SceneKeys:
    """All of a scene that follows keys, their times in seconds since the start.

    Attributes:
        motions: Motion of kinematic bodies, by body.
        magnetizations: Magnetizations of permanent shapes [A/m], in the frames of the shapes, by shape.
        currents: Ampere-turns of coils [A], by shape.
        field: External field [A/m], None where it is constant.
    """

    motions: dict[int, Motion]
    magnetizations: dict[int, Keys]
    currents: dict[int, Keys]
    field: Keys | None = None
