"""Records of coils and field maps: their rows of the table of attributes, and their data for the kernels.

A source of a field does not respond to other fields. The kernels read a kind, some numbers and a table of vectors, in
the frame of the source (``kernels.applied``). Newton's builders store a source as one line of text on a shape, because
copies of a shape keep its text.
"""

import base64
import json
import math
from dataclasses import dataclass
from functools import partial
from typing import Annotated, Any, NamedTuple

import numpy as np

from warpmag.declarations.attributes import Attribute, check_fields, make_plain
from warpmag.declarations.checks import check_flag, check_positive, check_vector, real_number, short_repr, vector
from warpmag.errors import InputError

COIL_SHAPES = ("loop", "solenoid", "polyline")
LARGEST_STRENGTH = 1e15
"""Largest ampere-turns [A] and voltage [V], and largest factor of a field map: they stay within single precision."""
CIRCUIT_RANGE = (1e-12, 1e12)
"""Smallest and largest resistance [Ω], inductance [H] and number of turns."""
DEFAULT_WIRE_RADIUS = 0.01
"""Default radius of a wire, in radii of the coil, or in diagonals of the box around a polyline."""
SIZE_RANGE = (1e-7, 1e6)
"""Smallest and largest radius, length and spacing [m]."""
LARGEST_POINT = 1e7
"""Largest coordinate [m] of a point of a coil or of a map."""
STRONGEST_FIELD = 1e30
"""Largest component [A/m] of the field of a map."""
_CIRCUIT_TEXT = f"0 or [{CIRCUIT_RANGE[0]:g}, {CIRCUIT_RANGE[1]:g}]"
_SIZE_TEXT = f"[{SIZE_RANGE[0]:g}, {SIZE_RANGE[1]:g}] m"

Vector = tuple[float, float, float]


def check_strength(name: str, value: Any) -> None:
    """Raise :class:`InputError` unless the magnitude of ``value`` is at most :data:`LARGEST_STRENGTH`."""
    number = real_number(name, value)
    if not abs(number) <= LARGEST_STRENGTH:
        raise InputError(f"{name}: must be finite and at most {LARGEST_STRENGTH:g} in size, got {number:g}")


def check_size(name: str, value: Any) -> None:
    """Raise :class:`InputError` unless ``value`` is a length [m] within :data:`SIZE_RANGE`."""
    check_positive(name, value)
    if not SIZE_RANGE[0] <= (size := real_number(name, value)) <= SIZE_RANGE[1]:
        raise InputError(f"{name}: must be from {SIZE_RANGE[0]:g} to {SIZE_RANGE[1]:g} m, got {size:g}")


def check_circuit_value(name: str, value: Any) -> None:
    """Raise :class:`InputError` unless ``value`` is 0 or within :data:`CIRCUIT_RANGE`."""
    number = real_number(name, value)
    if number != 0.0 and not CIRCUIT_RANGE[0] <= number <= CIRCUIT_RANGE[1]:
        raise InputError(f"{name}: must be {_CIRCUIT_TEXT}, got {number:g}")


def check_spacing(name: str, value: Any) -> None:
    """Raise :class:`InputError` unless ``value`` is three lengths [m] within :data:`SIZE_RANGE`."""
    for step in vector(name, value):
        check_size(name, step)


def checked_vectors(name: str, values: Any, most: float) -> np.ndarray:
    """Return vectors, shape [k, 3]; raise :class:`InputError` if a component is not finite or exceeds ``most``."""
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


class Circuit(NamedTuple):
    """Winding of a coil with a resistance."""

    turns: float  # number of turns
    resistance: float  # of the winding and its supply [Ω]
    inductance: float  # in air [H]; 0 means that of the coil's geometry


@dataclass(frozen=True, eq=False)
class SourceRecord:
    """Data of one source for the kernels, in the frame of the source."""

    kind: str  # name of a ``kernels.applied.sources.SourceKind``, in lower case
    parameters: tuple[float, ...]  # numbers of the kind
    table: np.ndarray  # vectors of the kind, shape [k, 3]
    circuit: Circuit | None = None  # of a coil with a resistance, None where the current is given

    def to_text(self) -> str:
        """Return the record as a line of text that keeps every bit of its numbers."""
        table = base64.b64encode(np.ascontiguousarray(self.table, "<f8").tobytes()).decode("ascii")
        fields = {"kind": self.kind, "parameters": self.parameters, "table": table}
        return json.dumps(fields if self.circuit is None else fields | {"circuit": self.circuit})

    def declared(self, strength: float, voltage: float = 0.0) -> "Coil | FieldMap":
        """Return the coil or the field map of this record, with a strength and a voltage."""
        p = self.parameters
        if self.kind == "field_map":
            counts = tuple(int(count) for count in p[6:9])
            nodes = self.table.reshape(*(count + 2 for count in counts), 3)[1:-1, 1:-1, 1:-1]
            return FieldMap(p[:3], p[3:6], nodes, strength)
        turns, resistance, inductance = self.circuit or (0.0, 0.0, 0.0)
        driven = {"resistance": resistance, "voltage": voltage, "turns": turns, "inductance": inductance}
        shared = {"wire_radius": p[-1], "ampere_turns": strength, **driven}
        if self.kind == "polyline":
            closed = len(self.table) > 3 and bool((self.table[0] == self.table[-1]).all())
            corners = self.table[:-1] if closed else self.table
            return Coil("polyline", points=tuple(map(tuple, corners.tolist())), closed=closed, **shared)
        return Coil(self.kind, radius=p[0], length=2.0 * p[1] if self.kind == "solenoid" else 0.0, **shared)

    def radius(self) -> float:
        """Return the radius of a ball around the frame's origin that contains the coil, 0 for a field map [m]."""
        if self.kind == "field_map":
            return 0.0
        farthest = (
            np.linalg.norm(self.table, axis=1).max() if self.kind == "polyline" else math.hypot(*self.parameters[:-1])
        )
        return float(farthest) + self.parameters[-1]  # the wire's radius

    def spacing(self) -> float:
        """Return the shortest distance between nodes of a field map, infinite for a coil [m]."""
        return min(self.parameters[3:6]) if self.kind == "field_map" else math.inf

    @classmethod
    def from_text(cls, text: str) -> "SourceRecord":
        """Return the record of a line that :meth:`to_text` wrote."""
        fields = json.loads(text)
        table = np.frombuffer(base64.b64decode(fields["table"]), "<f8").reshape(-1, 3)
        circuit = Circuit(*fields["circuit"]) if "circuit" in fields else None
        return cls(fields["kind"], tuple(fields["parameters"]), table, circuit)


@dataclass(frozen=True)
class Coil:
    """A coil in its own frame, with the attributes of the schema ``WarpmagCoilAPI``.

    The axis of loops and solenoids is z. A positive current causes a field along +z inside them. The current of a coil
    with a resistance follows from its voltage. The current of other coils is given.
    """

    shape: Annotated[str, Attribute(
        "coil:shape", "token", "Shape",
        "Shape of the coil: a circular loop, a sheet of current around a cylinder (solenoid), or straight pieces "
        "of wire (polyline).",
        tokens=COIL_SHAPES, uniform=True,
    )] = "loop"  # fmt: skip
    radius: Annotated[float, Attribute(
        "coil:radius", "float", "Radius", "Radius of a loop or a solenoid.",
        unit="distance", range=_SIZE_TEXT, check=check_size, uniform=True,
    )] = 0.0  # fmt: skip
    length: Annotated[float, Attribute(
        "coil:length", "float", "Length", "Length of a solenoid; its middle is the origin of the prim.",
        unit="distance", range=_SIZE_TEXT, check=check_size, uniform=True,
    )] = 0.0  # fmt: skip
    points: Annotated[tuple[Vector, ...], Attribute(
        "coil:points", "point3f[]", "Points", "Corners of a polyline, in the direction of a positive current.",
        unit="distance", check=partial(checked_vectors, most=LARGEST_POINT), uniform=True,
    )] = ()  # fmt: skip
    closed: Annotated[bool, Attribute(
        "coil:closed", "bool", "Closed",
        "True if a wire joins the last corner of a polyline to the first. An open polyline is a part of a circuit.",
        check=check_flag, uniform=True,
    )] = True  # fmt: skip
    wire_radius: Annotated[float, Attribute(
        "coil:wireRadius", "float", "Wire Radius",
        "Radius of the wire; inside the wire the field falls to zero. 0 means a hundredth of the coil's radius, or "
        "of the diagonal of the box around a polyline.",
        unit="distance", range="[0, half the coil's radius or length]", check=real_number, uniform=True,
    )] = 0.0  # fmt: skip
    ampere_turns: Annotated[float, Attribute(
        "coil:ampereTurns", "float", "Ampere-Turns",
        "Current times turns; a positive current causes a field along +z inside a loop or a solenoid. With a "
        "resistance it is the value at the start.",
        unit="ampere", range=f"[-{LARGEST_STRENGTH:g}, {LARGEST_STRENGTH:g}]", check=check_strength,
    )] = 0.0  # fmt: skip
    resistance: Annotated[float, Attribute(
        "coil:resistance", "float", "Resistance",
        "Resistance of the winding and its supply. The current then follows from the voltage; with 0 it is given.",
        unit="ohm", range=_CIRCUIT_TEXT, check=check_circuit_value, uniform=True,
    )] = 0.0  # fmt: skip
    voltage: Annotated[float, Attribute(
        "coil:voltage", "float", "Voltage", "Voltage at a coil with a resistance; 0 is a short circuit.",
        unit="volt", range=f"[-{LARGEST_STRENGTH:g}, {LARGEST_STRENGTH:g}]", check=check_strength,
    )] = 0.0  # fmt: skip
    turns: Annotated[float, Attribute(
        "coil:turns", "float", "Turns", "Number of turns; a coil with a resistance requires it.",
        unit="dimensionless", range=_CIRCUIT_TEXT, check=check_circuit_value, uniform=True,
    )] = 0.0  # fmt: skip
    inductance: Annotated[float, Attribute(
        "coil:inductance", "float", "Inductance",
        "Measured inductance in air of a coil with a resistance; 0 means the computed value of its geometry.",
        unit="henry", range=_CIRCUIT_TEXT, check=check_circuit_value, uniform=True,
    )] = 0.0  # fmt: skip

    def __post_init__(self):
        """Make numbers of Warp and arrays of other libraries plain."""
        make_plain(self)

    def check(self, name: str) -> None:
        """Raise :class:`InputError` naming ``name`` (a prim path or a function) if a value is out of range."""
        check_fields(self, name, "shape", "closed", "ampere_turns")
        sizes = {"loop": ("radius",), "solenoid": ("radius", "length"), "polyline": ()}[self.shape]
        for size in ("radius", "length"):
            if size in sizes:
                check_fields(self, name, size)
            elif real_number(f"{name}: {size}", getattr(self, size)) != 0.0:
                raise InputError(f"{name}: {size} is given, but a {self.shape} has none")
        if self.shape == "polyline":
            self._check_points(name)
        elif self._count_points(name):
            raise InputError(f"{name}: points are given, but a {self.shape} has none")
        most = self._largest_wire_radius()
        wire = real_number(f"{name}: wire radius", self.wire_radius)
        if not 0.0 <= wire <= most:
            raise InputError(f"{name}: wire radius must be from 0 to {most:g}, got {wire:g}")
        self._check_circuit(name)

    def _check_circuit(self, name: str) -> None:
        check_fields(self, name, "resistance", "voltage", "turns", "inductance")
        if self.resistance == 0.0:
            for field in ("voltage", "turns", "inductance"):
                if getattr(self, field) != 0.0:
                    raise InputError(f"{name}: {field} is given, but only a coil with a resistance has one")
        elif self.turns == 0.0:
            raise InputError(f"{name}: turns is missing: a coil with a resistance needs their number")
        elif self.shape == "polyline" and not self.closed:
            raise InputError(f"{name}: resistance is given, but an open polyline is only a part of a circuit")

    def _count_points(self, name: str) -> int:
        try:
            return len(self.points)
        except TypeError:  # of a number, and of a NumPy array without a dimension
            raise InputError(f"{name}: points: must be vectors, got {short_repr(self.points)}") from None

    def _check_points(self, name: str) -> None:
        least = 3 if self.closed else 2
        if (count := self._count_points(name)) < least:
            raise InputError(f"{name}: points: must be at least {least}, got {count}")
        check_fields(self, name, "points")
        lengths = np.linalg.norm(np.diff(self._path(), axis=0), axis=1)
        if not lengths.min() >= SIZE_RANGE[0]:
            short = int(lengths.argmin())
            raise InputError(f"{name}: points: must be {SIZE_RANGE[0]:g} m apart or more, number {short} is not")

    def _path(self) -> np.ndarray:
        """Return the corners of a polyline, shape [k, 3]. A closed polyline ends with its first corner."""
        points = np.array(self.points, float).reshape(-1, 3)
        return np.concatenate([points, points[:1]]) if self.closed else points

    def _diagonal(self) -> float:
        """Return the diagonal of the box around a polyline [m]."""
        return float(np.linalg.norm(np.ptp(np.array(self.points), axis=0)))

    def _largest_wire_radius(self) -> float:
        """Return the largest radius of a wire [m] that fits into the coil."""
        if self.shape == "polyline":
            return 0.5 * self._diagonal()
        return 0.5 * min(self.radius, self.length or self.radius)

    def record(self) -> SourceRecord:
        """Return the coil as a source of one ampere-turn."""
        circuit = None
        if self.resistance:
            circuit = Circuit(float(self.turns), float(self.resistance), float(self.inductance))
        if self.shape == "polyline":
            wire = self.wire_radius or DEFAULT_WIRE_RADIUS * self._diagonal()
            return SourceRecord(self.shape, (float(wire),), self._path(), circuit)
        wire = self.wire_radius or min(DEFAULT_WIRE_RADIUS * self.radius, self._largest_wire_radius())
        half_length = (0.5 * float(self.length),) if self.shape == "solenoid" else ()
        parameters = (float(self.radius), *half_length, float(wire))
        return SourceRecord(self.shape, parameters, np.zeros((0, 3)), circuit)


@dataclass(frozen=True, eq=False)
class FieldMap:
    """A field map in its own frame, with the attributes of the schema ``WarpmagFieldMapAPI``.

    The field is zero outside the grid. ``values`` has the shape [nx, ny, nz, 3], with at least two nodes along each
    axis.
    """

    origin: Annotated[Vector, Attribute(
        "fieldMap:origin", "point3f", "Origin", "Position of the first node.",
        unit="distance", check=check_vector, uniform=True, default=(0.0, 0.0, 0.0),
    )]  # fmt: skip
    spacing: Annotated[Vector, Attribute(
        "fieldMap:spacing", "vector3f", "Spacing", "Distance between nodes along each axis.",
        unit="distance", range=_SIZE_TEXT, check=check_spacing, uniform=True,
    )]  # fmt: skip
    values: Annotated[np.ndarray, Attribute(
        "fieldMap:values", "vector3f[]", "Values",
        "Field H at the nodes, in the frame of the prim. The index along z runs fastest, then y, then x.",
        unit="ampere / meter", check=partial(checked_vectors, most=STRONGEST_FIELD), uniform=True,
    )]  # fmt: skip
    factor: Annotated[float, Attribute(
        "fieldMap:factor", "float", "Factor", "Factor on the values of the field.",
        unit="dimensionless", range=f"[-{LARGEST_STRENGTH:g}, {LARGEST_STRENGTH:g}]", check=check_strength,
        uniform=True,
    )] = 1.0  # fmt: skip

    def __post_init__(self):
        """Make numbers of Warp and arrays of other libraries plain."""
        make_plain(self)

    def check(self, name: str) -> None:
        """Raise :class:`InputError` naming ``name`` (a prim path or a function) if a value is out of range."""
        check_fields(self, name, "factor", "origin", "spacing")
        try:
            shape = np.shape(self.values)
        except ValueError:  # a ragged list
            raise InputError(f"{name}: values: must be an array, got {short_repr(self.values)}") from None
        if len(shape) != 4 or shape[3] != 3 or min(shape) < 2:
            raise InputError(f"{name}: values: shape must be [nx, ny, nz, 3] of 2 or more each, got {list(shape)}")
        corner = np.abs(np.add(self.origin, np.multiply(self.spacing, np.subtract(shape[:3], 1))))
        farthest = max(*corner, *np.abs(self.origin))
        if not farthest <= LARGEST_POINT:
            raise InputError(f"{name}: reaches {farthest:g} m, at most {LARGEST_POINT:g} m")
        checked_vectors(f"{name}: values", np.reshape(self.values, (-1, 3)), STRONGEST_FIELD)

    def border_ratio(self) -> float:
        """Return the largest field on the boundary of the map over the largest in the map; 0 for a map of zeros."""
        magnitude = np.linalg.norm(np.asarray(self.values, float), axis=3)
        inner = magnitude[1:-1, 1:-1, 1:-1].max(initial=0.0)
        outer = max(magnitude.take(end, axis).max() for axis in range(3) for end in (0, -1))
        return float(outer / max(outer, inner)) if outer > 0.0 else 0.0

    def record(self) -> SourceRecord:
        """Return the map as a source, with one more node at either end of each axis."""
        nodes = np.asarray(self.values, float)
        counts = nodes.shape[:3]
        for axis in range(3):
            nodes = _extrapolated(nodes, axis)
        parameters = (*map(float, self.origin), *map(float, self.spacing), *map(float, counts))
        return SourceRecord("field_map", parameters, nodes.reshape(-1, 3))


def _extrapolated(nodes: np.ndarray, axis: int) -> np.ndarray:
    """Return nodes with one more at either end of an axis (Keys 1981).

    A new node lies on the parabola through the nearest three nodes, or on the line through the only two.
    """

    def beyond(ends):
        first, second, third = ([*ends, None])[:3]
        return 2.0 * first - second if third is None else 3.0 * (first - second) + third

    count = min(3, nodes.shape[axis])
    before = beyond([nodes.take([k], axis) for k in range(count)])
    after = beyond([nodes.take([-1 - k], axis) for k in range(count)])
    return np.concatenate([before, nodes, after], axis=axis)
