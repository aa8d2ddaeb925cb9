"""Sources of fields without a response, coils among them: plain data, shared by the USD part and the Newton part.

A source is a kind, some numbers and a table of vectors, in its own frame; ``kernels.applied`` has its field. On a
builder it is one line of text, so that it survives whatever builders do to the shape that carries it.
"""

import base64
import json
from dataclasses import dataclass
from typing import Any

import numpy as np

from warpmag.declarations.checks import check_flag, check_positive, check_token, check_vector, real_number, short_repr
from warpmag.errors import InputError

COIL_SHAPES = ("loop", "solenoid", "polyline")
MOST_AMPERE_TURNS = 1e15
"""Largest current times turns [A], and factor of a field map: single precision holds what follows."""
THINNEST_WIRE = 0.01
"""Default radius of a wire, in parts of the radius of the coil, or of the diagonal of the box around a polyline."""
SIZES = (1e-7, 1e6)
"""Least and largest radius, length and spacing [m]."""
FARTHEST_POINT = 1e7
"""Largest coordinate [m] of a point of a coil or of a map."""
STRONGEST_FIELD = 1e30
"""Largest component [A/m] of the field of a map."""

Vector = tuple[float, float, float]


@dataclass(frozen=True, eq=False)
class SourceRecord:
    """One source in its own frame.

    Attributes:
        kind: Its kind, a name of ``kernels.applied.sources.SourceKind`` in lower case.
        parameters: Its numbers.
        table: Its vectors, shape [k, 3].
    """

    kind: str
    parameters: tuple[float, ...]
    table: np.ndarray

    def to_text(self) -> str:
        """Return the record as a line of text, numbers to their last bit."""
        table = base64.b64encode(np.ascontiguousarray(self.table, "<f8").tobytes()).decode("ascii")
        return json.dumps({"kind": self.kind, "parameters": self.parameters, "table": table})

    @classmethod
    def from_text(cls, text: str) -> "SourceRecord":
        """Return the record that :meth:`to_text` made a line of."""
        fields = json.loads(text)
        table = np.frombuffer(base64.b64decode(fields["table"]), "<f8").reshape(-1, 3)
        return cls(fields["kind"], tuple(fields["parameters"]), table)


@dataclass(frozen=True)
class Coil:
    """A coil in its own frame. A loop or a solenoid is about the z axis, and a positive current makes a field along z.

    Attributes:
        shape: One of :data:`COIL_SHAPES`.
        radius: Radius of a loop or a solenoid [m].
        length: Length of a solenoid [m], whose middle is the origin.
        points: Corners of a polyline [m], in the direction of a positive current.
        closed: Whether its last point is joined to the first. An open one is a part of a circuit.
        wire_radius: Radius of the wire [m], inside of which the field falls to zero; 0 means ``THINNEST_WIRE``.
        ampere_turns: Current times turns [A].
    """

    shape: str = "loop"
    radius: float = 0.0
    length: float = 0.0
    points: tuple[Vector, ...] = ()
    closed: bool = True
    wire_radius: float = 0.0
    ampere_turns: float = 0.0

    def check(self, name: str) -> None:
        """Raise :class:`InputError` naming ``name`` (a prim path or a function) if a value is out of range."""
        check_token(f"{name}: shape", self.shape, COIL_SHAPES)
        check_strength(f"{name}: ampere turns", self.ampere_turns)
        check_flag(f"{name}: closed", self.closed)
        has = {"loop": ("radius",), "solenoid": ("radius", "length"), "polyline": ()}[self.shape]
        for size in ("radius", "length"):
            if size in has:
                _check_size(f"{name}: {size}", getattr(self, size))
            elif real_number(f"{name}: {size}", getattr(self, size)) != 0.0:
                raise InputError(f"{name}: {size} is given, but a {self.shape} has none")
        if self.shape == "polyline":
            self._check_points(f"{name}: points")
        elif len(self.points):
            raise InputError(f"{name}: points are given, but a {self.shape} has none")
        most = self._thickest()
        wire = real_number(f"{name}: wire radius", self.wire_radius)
        if not 0.0 <= wire <= most:
            raise InputError(f"{name}: wire radius must be from 0 to {most:g}, got {wire:g}")

    def _check_points(self, name: str) -> None:
        least = 3 if self.closed else 2
        if len(self.points) < least:
            raise InputError(f"{name}: must be at least {least}, got {len(self.points)}")
        checked_vectors(name, self.points, FARTHEST_POINT)
        lengths = np.linalg.norm(np.diff(self._chain(), axis=0), axis=1)
        if not lengths.min() >= SIZES[0]:
            raise InputError(f"{name}: must be {SIZES[0]:g} m apart or more, number {int(lengths.argmin())} is not")

    def _chain(self) -> np.ndarray:
        points = np.array(self.points, float).reshape(-1, 3)
        return np.concatenate([points, points[:1]]) if self.closed else points

    def _extent(self) -> float:
        return float(np.linalg.norm(np.ptp(np.array(self.points), axis=0)))

    def _thickest(self) -> float:
        """Largest radius of the wire [m] that leaves it one."""
        if self.shape == "polyline":
            return 0.5 * self._extent()
        return 0.5 * min(self.radius, self.length or self.radius)

    def record(self) -> SourceRecord:
        """Return the source that it is, per ampere-turn."""
        if self.shape == "polyline":
            wire = self.wire_radius or THINNEST_WIRE * self._extent()
            return SourceRecord(self.shape, (float(wire),), self._chain())
        wire = self.wire_radius or min(THINNEST_WIRE * self.radius, self._thickest())
        halves = (0.5 * float(self.length),) if self.shape == "solenoid" else ()
        return SourceRecord(self.shape, (float(self.radius), *halves, float(wire)), np.zeros((0, 3)))


@dataclass(frozen=True, eq=False)
class FieldMap:
    """A field on a regular grid, in its own frame; zero beyond.

    Attributes:
        origin: The first node [m].
        spacing: Distance of nodes along each axis [m].
        values: H at the nodes [A/m], shape [nx, ny, nz, 3], at least two along each axis.
        factor: Factor of the field.
    """

    origin: Vector
    spacing: Vector
    values: np.ndarray
    factor: float = 1.0

    def check(self, name: str) -> None:
        """Raise :class:`InputError` naming ``name`` (a prim path or a function) if a value is out of range."""
        check_strength(f"{name}: factor", self.factor)
        check_vector(f"{name}: origin", self.origin)
        check_vector(f"{name}: spacing", self.spacing)
        for step in self.spacing:
            _check_size(f"{name}: spacing", step)
        shape = np.shape(self.values)
        if len(shape) != 4 or shape[3] != 3 or min(shape) < 2:
            raise InputError(f"{name}: values: shape must be [nx, ny, nz, 3] of 2 or more each, got {list(shape)}")
        corner = np.abs(np.add(self.origin, np.multiply(self.spacing, np.subtract(shape[:3], 1))))
        farthest = max(*corner, *np.abs(self.origin))
        if not farthest <= FARTHEST_POINT:
            raise InputError(f"{name}: reaches {farthest:g} m, at most {FARTHEST_POINT:g} m")
        checked_vectors(f"{name}: values", np.reshape(self.values, (-1, 3)), STRONGEST_FIELD)

    def border(self) -> float:
        """Return the largest field at the border, where the map ends, over the largest of all; 0 without any."""
        size = np.linalg.norm(np.asarray(self.values, float), axis=3)
        inner = size[1:-1, 1:-1, 1:-1].max(initial=0.0)
        outer = max(size.take(end, axis).max() for axis in range(3) for end in (0, -1))
        return float(outer / max(outer, inner)) if outer > 0.0 else 0.0

    def record(self) -> SourceRecord:
        """Return the source that it is, with one more node at either end of each axis."""
        nodes = np.asarray(self.values, float)
        counts = nodes.shape[:3]
        for axis in range(3):
            nodes = _extrapolated(nodes, axis)
        parameters = (*map(float, self.origin), *map(float, self.spacing), *map(float, counts))
        return SourceRecord("field_map", parameters, nodes.reshape(-1, 3))


def _extrapolated(nodes: np.ndarray, axis: int) -> np.ndarray:
    """Nodes with one more at either end, by a parabola through three of them, or a line through two (Keys 1981)."""

    def beyond(ends):
        first, second, third = ([*ends, None])[:3]
        return 2.0 * first - second if third is None else 3.0 * (first - second) + third

    count = min(3, nodes.shape[axis])
    before = beyond([nodes.take([k], axis) for k in range(count)])
    after = beyond([nodes.take([-1 - k], axis) for k in range(count)])
    return np.concatenate([before, nodes, after], axis=axis)


def checked_vectors(name: str, values: Any, most: float) -> np.ndarray:
    """Return vectors as an array of shape [k, 3]; :class:`InputError` where a component is no number up to ``most``."""
    try:
        array = np.asarray(values)
    except ValueError:  # a ragged list
        array = np.zeros(0, object)
    if array.dtype.kind not in "iuf" or array.ndim != 2 or array.shape[1] != 3:
        raise InputError(f"{name}: must be vectors of three numbers, got {short_repr(values)}")
    wrong = ~(np.abs(array) <= most).all(axis=1)
    if wrong.any():
        row = int(np.argmax(wrong))
        raise InputError(f"{name}: must be finite and at most {most:g}, number {row} is {array[row].tolist()}")
    return array.astype(float)


def check_strength(name: str, value: Any) -> None:
    """Raise :class:`InputError` unless ``value`` is a number of ampere-turns, or a factor, in range."""
    number = real_number(name, value)
    if not abs(number) <= MOST_AMPERE_TURNS:
        raise InputError(f"{name}: must be finite and at most {MOST_AMPERE_TURNS:g} in size, got {number:g}")


def _check_size(name: str, value: Any) -> None:
    check_positive(name, value)
    if not SIZES[0] <= value <= SIZES[1]:
        raise InputError(f"{name}: must be from {SIZES[0]:g} to {SIZES[1]:g} m, got {float(value):g}")
