"""Solid shapes, posed in the frame of a body."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass, field, replace

import numpy as np

from warpmag.errors import InputError

Values = Sequence[float] | np.ndarray


@dataclass(frozen=True)
class Solid:
    """A solid shape, posed in the frame of its body. All values but the pose are in the frame of the shape."""

    name: str  # name in error messages
    lower: np.ndarray  # lower corner of the bounding box [m], shape [3]
    upper: np.ndarray  # upper corner of the bounding box [m], shape [3]
    volume: float  # [m³]
    centroid: np.ndarray  # [m], shape [3]
    inside: Callable[[np.ndarray, np.ndarray, np.ndarray], np.ndarray]  # True inside, from x, y, z [m] that broadcast
    facets: Callable[[int], np.ndarray]  # about a given number m of facets of the surface [m], shape [m, 4, 3]
    steps: np.ndarray = field(default_factory=lambda: np.empty((0, 3)))  # faces inside the box,
    # normal to an axis: axis, coordinate [m] and area [m²], shape [f, 3]
    position: np.ndarray = field(default_factory=lambda: np.zeros(3))  # origin in the body's frame [m], shape [3]
    rotation: np.ndarray = field(default_factory=lambda: np.eye(3))  # rotation to the body's frame, shape [3, 3]

    def posed(self, position: Values, quaternion: Values = (0.0, 0.0, 0.0, 1.0)) -> "Solid":
        """Return the shape at ``position`` [m], rotated by ``quaternion`` (x, y, z, w), both in the body's frame."""
        origin, q = np.asarray(position, float), np.asarray(quaternion, float)
        if origin.shape != (3,) or not np.isfinite(origin).all():
            raise InputError(f"{self.name}: position must be three finite lengths, got {position}")
        if q.shape != (4,) or not (np.isfinite(q).all() and q.any()):
            raise InputError(f"{self.name}: quaternion must be four finite numbers, not all zero, got {quaternion}")
        x, y, z, w = q / np.linalg.norm(q)
        cross = np.array([[0.0, -z, y], [z, 0.0, -x], [-y, x, 0.0]])
        return replace(self, position=origin, rotation=np.eye(3) + 2.0 * (w * cross + cross @ cross))

    def to_body(self, points: np.ndarray) -> np.ndarray:
        """Transform points [m], shape [n, 3], from the frame of the shape to the body's."""
        return points @ self.rotation.T + self.position

    def bounds(self) -> tuple[np.ndarray, np.ndarray]:
        """Return center and half sides [m] of the bounding box along the axes of the body, shape [3] each."""
        return self.to_body(0.5 * (self.lower + self.upper)), np.abs(self.rotation) @ (0.5 * (self.upper - self.lower))

    def test_points(self, counts: np.ndarray) -> np.ndarray:
        """Return points [m], body frame, that fill the bounding box with ``counts`` along each axis, shape [n, 3]."""
        return self.to_body(self.lower + (grid(counts) + 0.5) * ((self.upper - self.lower) / counts))

    def contains(self, points: np.ndarray) -> np.ndarray:
        """Return True for the points [m], body frame, shape [n, 3], that lie inside, shape [n]."""
        local = (points - self.position) @ self.rotation
        in_box = np.flatnonzero(((local >= self.lower) & (local <= self.upper)).all(axis=1))
        result = np.zeros(len(points), bool)
        result[in_box] = self.inside(*local[in_box].T)
        return result

    def contains_grid(self, x: np.ndarray, y: np.ndarray, z: np.ndarray) -> np.ndarray:
        """Return :meth:`contains` of the points of a grid along the axes of the shape, shape [len(x), len(y), len(z)].

        Coordinates [m] ascend and are in the frame of the shape, shape [n] each.
        """
        values, result = (x, y, z), np.zeros((len(x), len(y), len(z)), bool)
        limits = zip(values, self.lower, self.upper, strict=True)
        rows = [slice(v.searchsorted(low), v.searchsorted(up, side="right")) for v, low, up in limits]
        if all(row.start < row.stop for row in rows):
            x, y, z = np.ix_(*(v[row] for v, row in zip(values, rows, strict=True)))
            result[tuple(rows)] = self.inside(x, y, z)
        return result


def boxes_meet(a: Solid, b: Solid) -> bool:
    """Return True if the :meth:`Solid.bounds` of two shapes overlap beyond rounding."""
    (middle_a, half_a), (middle_b, half_b) = a.bounds(), b.bounds()
    return bool((np.abs(middle_a - middle_b) < (half_a + half_b) * (1.0 - 1e-6)).all())


def grid(counts: np.ndarray) -> np.ndarray:
    """Return the index triples of a grid, shape [product of counts, 3]."""
    return np.stack(np.meshgrid(*(np.arange(n) for n in counts), indexing="ij"), axis=-1).reshape(-1, 3)
