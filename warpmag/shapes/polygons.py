"""Triangulation of the polygons of a mesh.

A fan around the first corner covers a convex polygon. It also covers many others: exactly those simple polygons whose
fan has no inverted triangle. The rest, such as the faces of extruded letters, are cut into triangles by clipping ears
(Meisters, "Polygons have ears", 1975). An ear is a convex corner whose triangle contains no other corner. A hole that
is connected with the outline by a pair of coincident edges (a keyhole) is part of such a polygon.

A polygon of n corners always becomes n − 2 triangles with all of its edges. A closed mesh thus stays closed, even where
triangles have no area.
"""

import functools

import numpy as np

_INVERTED = 1e-6
"""Area of an inverted triangle of a fan that rounding to float32 explains, as a share of the area of its polygon."""
_FLAT = 1e-6
"""Ratio of height to longest side of the triangle at a corner up to which a corner of float32 counts as straight."""


def triangulate(points: np.ndarray, counts: np.ndarray, indices: np.ndarray) -> np.ndarray:
    """Return the triangles of polygons, oriented as the polygons.

    Args:
        points: Points of the mesh, shape [n, 3].
        counts: Number of corners of each polygon, shape [f].
        indices: Points of the corners, one polygon after the other, shape [sum of ``counts``].

    Returns:
        Corners of the triangles as positions in ``indices``, shape [k, 3]. The ``counts − 2`` triangles of a polygon
        follow those of the polygon before it. A polygon that crosses itself or has no area becomes a fan.
    """
    points, counts, indices = np.asarray(points, float), np.asarray(counts), np.asarray(indices)
    corners, faces = fans(counts), faces_of_triangles(counts)
    a, b, c = points[indices[corners]].transpose(1, 0, 2)
    normals = np.zeros((len(counts), 3))
    with np.errstate(over="ignore", invalid="ignore"):  # points that are not finite keep their fans
        areas = np.cross(b - a, c - a)
        np.add.at(normals, faces, areas)
        inverted = np.einsum("ki,ki->k", areas, normals[faces]) < -_INVERTED * (normals**2).sum(axis=1)[faces]
    ends = np.cumsum(counts)
    for face in np.unique(faces[inverted]).tolist():
        begin, end = int(ends[face] - counts[face]), int(ends[face])
        axis = int(np.abs(normals[face]).argmax())
        plane = [(axis + 1) % 3, (axis + 2) % 3] if normals[face, axis] > 0.0 else [(axis + 2) % 3, (axis + 1) % 3]
        ears = _ears(points[indices[begin:end]][:, plane].tobytes())
        if ears is not None:
            first = int(np.searchsorted(faces, face))
            corners[first : first + len(ears)] = begin + ears
    return corners


def fans(counts: np.ndarray) -> np.ndarray:
    """Return the fans of polygons around their first corners, in the form of :func:`triangulate`."""
    counts = np.asarray(counts, dtype=np.int64)
    faces = faces_of_triangles(counts)
    first = (np.cumsum(counts) - counts)[faces]
    rank = np.arange(len(faces)) - np.searchsorted(faces, faces)
    return np.stack([first, first + rank + 1, first + rank + 2], axis=1)


def faces_of_triangles(counts: np.ndarray) -> np.ndarray:
    """Return the polygon of each triangle of :func:`triangulate`, shape [k]."""
    return np.repeat(np.arange(len(counts)), np.maximum(np.asarray(counts) - 2, 0))


@functools.lru_cache(maxsize=1024)  # copies of a letter have the same outline
def _ears(outline: bytes) -> np.ndarray | None:
    """Return the triangles of a counterclockwise polygon, shape [n − 2, 3], or None if it crosses itself.

    ``outline`` are the bytes of its corners, float64, shape [n, 2]. The ear of the best shape is clipped first.
    """
    ring = _Ring(np.frombuffer(outline).reshape(-1, 2))
    triangles = []
    for _ in range(len(ring.points) - 3):
        corner = int(ring.shapes.argmax())
        if ring.shapes[corner] < 0.0:
            return None
        triangles.append(ring.triangle(corner))
        ring.clip(corner)
    last = ring.triangle(int(ring.shapes.argmax()))
    if ring.shape_of(last) < -_FLAT:
        return None
    return np.array([*triangles, last])


class _Ring:
    """Corners of a polygon that are not clipped yet."""

    def __init__(self, points: np.ndarray):
        corners = np.arange(len(points))
        self.points = points
        self._before, self._after = np.roll(corners, 1), np.roll(corners, -1)
        self._blocks = np.array([self.shape_of(self.triangle(corner)) <= 0.0 for corner in corners])
        # height of each ear over its longest side; 0 for straight corners, -1 where the corner is not an ear
        self.shapes = np.array([self._shape(corner) for corner in corners])

    def triangle(self, corner: int) -> tuple[int, int, int]:
        """Return a corner between its neighbors."""
        return int(self._before[corner]), corner, int(self._after[corner])

    def shape_of(self, triangle: tuple[int, int, int]) -> float:
        """Return the height of a triangle over its longest side, negative if it is clockwise, 0 without a side."""
        a, b, c = self.points[list(triangle)]
        longest = max(float(side @ side) for side in (b - a, c - b, a - c))
        return _area(a, b, c) / longest if longest > 0.0 else 0.0

    def clip(self, corner: int) -> None:
        """Remove a corner."""
        before, _, after = self.triangle(corner)
        self._after[before], self._before[after] = after, before
        self._blocks[corner], self.shapes[corner] = False, -np.inf
        for neighbor in (before, after):
            self._blocks[neighbor] = self.shape_of(self.triangle(neighbor)) <= 0.0
            self.shapes[neighbor] = self._shape(neighbor)

    def _shape(self, corner: int) -> float:
        """Return the value of a corner in ``shapes``."""
        triangle = self.triangle(corner)
        a, b, c = self.points[list(triangle)]
        if np.array_equal(a, b) or np.array_equal(b, c) or np.array_equal(c, a):
            return np.inf  # the polygon is the same without the corner
        shape = self.shape_of(triangle)
        if abs(shape) <= _FLAT:
            return 0.0
        others = self.points[self._blocks]
        others = others[(others != a).any(axis=1) & (others != b).any(axis=1) & (others != c).any(axis=1)]
        inside = (_area(a, b, others) >= 0.0) & (_area(b, c, others) >= 0.0) & (_area(c, a, others) >= 0.0)
        return -1.0 if shape < 0.0 or inside.any() else shape


def _area(a: np.ndarray, b: np.ndarray, c: np.ndarray):
    """Return twice the signed area of triangles; ``c`` may be one point or several."""
    return (b[0] - a[0]) * (c[..., 1] - a[1]) - (b[1] - a[1]) * (c[..., 0] - a[0])
