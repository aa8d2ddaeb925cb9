"""Values keyed over time, and motions of keyed transforms. A stage holds them; a device interpolates them."""

import json
from dataclasses import asdict, dataclass, replace

import numpy as np


@dataclass(frozen=True)
class Keys:
    """Values keyed over time: interpolated between keys, constant before the first and after the last."""

    times: np.ndarray  # rising, shape [k]: time codes while a stage is read, then seconds since the start
    values: np.ndarray  # value of each key, float64, shape [k, width]
    interpolation: str = "linear"  # or ``held``, or ``slerp`` for quaternions x y z w

    @classmethod
    def constant(cls, values) -> "Keys":
        """Return keys of a constant value, shape [width]."""
        return cls(np.zeros(1), np.reshape(np.asarray(values, dtype=float), (1, -1)))

    def in_seconds(self, start: float, rate: float) -> "Keys":
        """Return the keys with times in seconds since the time code ``start``, at ``rate`` time codes per second."""
        return replace(self, times=(self.times - start) / rate)

    def to_text(self) -> str:
        """Return the keys as JSON."""
        return json.dumps(asdict(self), default=np.ndarray.tolist)

    @classmethod
    def from_text(cls, text: str) -> "Keys":
        """Return the keys of a text that :meth:`to_text` wrote."""
        fields = json.loads(text)
        return cls(np.array(fields["times"]), np.array(fields["values"]), fields["interpolation"])


@dataclass(frozen=True)
class Operation:
    """One keyed transform of a stack.

    The kinds are ``translate``, ``scale``, ``orient``, ``matrix``, and ``rotate`` with the order of its axes:
    ``rotateXYZ`` rotates about x first. A matrix has 16 numbers by rows, for row vectors, as in USD.
    """

    kind: str
    keys: Keys  # numbers of the transform; three angles [degrees] for ``rotate``
    inverse: bool = False  # True if the inverse of the transform applies


@dataclass(frozen=True)
class Motion:
    """Motion of a frame in the world."""

    operations: tuple[Operation, ...]  # stack of transforms, the outermost first: the last acts on points first

    def in_seconds(self, start: float, rate: float) -> "Motion":
        """Return the motion with times in seconds, see :meth:`Keys.in_seconds`."""
        return Motion(tuple(replace(item, keys=item.keys.in_seconds(start, rate)) for item in self.operations))


@dataclass(frozen=True)
class SceneKeys:
    """All keyed values of a scene, times in seconds since the start."""

    motions: dict[int, Motion]  # of kinematic bodies, by body
    magnetizations: dict[int, Keys]  # of permanent magnets [A/m], in the frames of their shapes, by shape
    currents: dict[int, Keys]  # ampere-turns of coils [A], by shape
    voltages: dict[int, Keys]  # of coils with a resistance [V], by shape
    field: Keys | None = None  # external field [A/m], None where it is constant
