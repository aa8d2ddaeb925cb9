"""Sources of fields without a response, coils among them: plain data, shared by the USD part and the Newton part.

A source is a kind, some numbers and a table of vectors, in its own frame; ``kernels.applied`` has its field. On a
builder it is one line of text, so that it survives whatever builders do to the shape that carries it.
"""

import base64
import json
from dataclasses import dataclass
from typing import Any

import numpy as np

from warpmag.errors import InputError
from warpmag.magnets import check_positive, check_token, real

COIL_SHAPES = ("loop",)
MOST_AMPERE_TURNS = 1e15
THINNEST_WIRE = 0.01
"""Default radius of a wire, in parts of the radius of the coil."""


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
    """A coil about the z axis of its frame; a positive current makes a field along z inside.

    Attributes:
        shape: One of :data:`COIL_SHAPES`.
        radius: Radius of the loop [m].
        wire_radius: Radius of the wire [m], inside of which the field falls to zero; 0 means ``THINNEST_WIRE`` of the
            radius of the coil.
        ampere_turns: Current times turns [A].
    """

    shape: str = "loop"
    radius: float = 0.0
    wire_radius: float = 0.0
    ampere_turns: float = 0.0

    def check(self, name: str) -> None:
        """Raise :class:`InputError` naming ``name`` (a prim path or a function) if a value is out of range."""
        check_token(f"{name}: shape", self.shape, COIL_SHAPES)
        check_current(f"{name}: ampere turns", self.ampere_turns)
        check_positive(f"{name}: radius", self.radius)
        if not 0.0 <= real(f"{name}: wire radius", self.wire_radius) <= 0.5 * self.radius:
            raise InputError(f"{name}: wire radius must be from 0 to half of the radius, got {self.wire_radius:g}")

    def record(self) -> SourceRecord:
        """Return the source that it is, per ampere-turn."""
        wire = self.wire_radius or THINNEST_WIRE * self.radius
        return SourceRecord(self.shape, (float(self.radius), float(wire)), np.zeros((0, 3)))


def check_current(name: str, value: Any) -> None:
    """Raise :class:`InputError` unless ``value`` is a number of ampere-turns [A] that single precision holds."""
    if not abs(real(name, value)) <= MOST_AMPERE_TURNS:
        raise InputError(f"{name}: must be at most {MOST_AMPERE_TURNS:g} in size, got {float(value):g}")
