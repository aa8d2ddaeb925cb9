"""Solid shapes, posed in the frame of a body."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass, field, replace

import numpy as np

from warpmag.errors import InputError

Values = Sequence[float] | np.ndarray


@dataclass(frozen=True)
class Solid:
    """A solid shape, posed in the frame of its body.

    Attributes:
        name: Name in error messages.
        lower: Lower corner of the bounding box [m], frame of the shape, shape [3].
        upper: Upper corner of the bounding box [m], frame of the shape, shape [3].
        volume: Volume [m³].
        centroid: Centroid [m], frame of the shape, shape [3].
        inside: Function of points [m], frame of the shape, shape [n, 3], that returns True for points inside.
        facets: Function of a count that returns about ``count`` facets of the surface [m], frame of the shape, shape
            [m, 4, 3] (``facets.py``).
        position: Origin of the shape in the body's frame [m], shape [3].
        rotation: Rotation from the frame of the shape to the body's, shape [3, 3].
    """

    name: str
    lower: np.ndarray
    upper: np.ndarray
    volume: float
    centroid: np.ndarray
    inside: Callable[[np.ndarray], np.ndarray]
    facets: Callable[[int], np.ndarray]
    position: np.ndarray = field(default_factory=lambda: np.zeros(3))
    rotation: np.ndarray = field(default_factory=lambda: np.eye(3))

    def posed(self, position: Values, quaternion: Values = (0.0, 0.0, 0.0, 1.0)) -> "Solid":
        """Return the shape at ``position`` [m], rotated by ``quaternion`` (x, y, z, w), both in the body's frame."""
        place, q = np.asarray(position, float), np.asarray(quaternion, float)
        if place.shape != (3,) or not np.isfinite(place).all():
            raise InputError(f"{self.name}: position must be three finite lengths, got {position}")
        if q.shape != (4,) or not (np.isfinite(q).all() and q.any()):
            raise InputError(f"{self.name}: quaternion must be four finite numbers, not all zero, got {quaternion}")
        x, y, z, w = q / np.linalg.norm(q)
        cross = np.array([[0.0, -z, y], [z, 0.0, -x], [-y, x, 0.0]])
        return replace(self, position=place, rotation=np.eye(3) + 2.0 * (w * cross + cross @ cross))

    def to_body(self, points: np.ndarray) -> np.ndarray:
        """Transform points [m], shape [n, 3], from the frame of the shape to the body's."""
        return points @ self.rotation.T + self.position

    def contains(self, points: np.ndarray) -> np.ndarray:
        """Return True for the points [m], body frame, shape [n, 3], that lie inside, shape [n]."""
        local = (points - self.position) @ self.rotation
        in_box = np.flatnonzero(((local >= self.lower) & (local <= self.upper)).all(axis=1))
        result = np.zeros(len(points), bool)
        result[in_box] = self.inside(local[in_box])
        return result


def boxes_meet(a: Solid, b: Solid) -> bool:
    """Return True if the bounding boxes of two posed shapes, aligned with the body's axes, overlap beyond rounding."""
    reach = sum(np.abs(solid.rotation) @ (0.5 * (solid.upper - solid.lower)) for solid in (a, b))
    middle_a, middle_b = (solid.to_body(0.5 * (solid.lower + solid.upper)) for solid in (a, b))
    return bool((np.abs(middle_a - middle_b) < reach * (1.0 - 1e-6)).all())


def grid(counts: np.ndarray) -> np.ndarray:
    """Return the index triples of a grid, shape [product of counts, 3]."""
    return np.stack(np.meshgrid(*(np.arange(n) for n in counts), indexing="ij"), axis=-1).reshape(-1, 3)
