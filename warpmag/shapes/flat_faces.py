"""Flat convex faces of solids, in which balls have mirror images (``kernels/near_contact/images.py``)."""

from dataclasses import dataclass

import numpy as np

from warpmag.shapes.closed_mesh import welded
from warpmag.shapes.polyhedra import Polyhedron

_LEAST_AREA = 0.01
"""Smallest area of a face, relative to the whole surface of its mesh: smaller facets are parts of curved surfaces."""
_FLAT = 1e-5
"""Largest distance of a point from the plane of its face, or from the line of an edge, relative to the mesh."""
_SAME_LINE = 1e-4
"""Difference of normals, and of offsets relative to the face, up to which edges are in one line."""


@dataclass(frozen=True)
class FlatFaces:
    """Flat convex faces in the frame of a body. Normals n are unit vectors, offsets are n·x on the face or edge [m]."""

    planes: np.ndarray  # outward normal and offset, shape [f, 4]
    edges: tuple[np.ndarray, ...]  # of each face: normals out of the face, in its plane, and offsets, shape [e, 4]


def joined(parts: list[FlatFaces]) -> FlatFaces:
    """Return the faces of several shapes of one body."""
    planes = [np.zeros((0, 4)), *(part.planes for part in parts)]
    return FlatFaces(np.concatenate(planes), tuple(rows for part in parts for rows in part.edges))


def faces_of_polyhedron(surface: Polyhedron, count: int) -> FlatFaces:
    """Return the first ``count`` faces of a convex polyhedron."""
    corners = [surface.corners[list(face)] for face in surface.faces[:count]]
    return _faces(corners, surface.normals[:count])


def faces_of_mesh(vertices: np.ndarray, triangles: np.ndarray) -> FlatFaces:
    """Return the large flat convex faces of a closed mesh.

    Faces with holes or concave outlines are left out.
    """
    points, triangles = welded(vertices, triangles)
    a, b, c = (points[triangles[:, k]] for k in range(3))
    normals = np.cross(b - a, c - a)
    areas = np.linalg.norm(normals, axis=1)
    normals = normals / np.maximum(areas, np.finfo(float).tiny)[:, None]
    size, total = float(np.ptp(points, axis=0).max()), areas.sum()
    outlines, outward = [], []
    for rows in _coplanar(normals, (normals * a).sum(axis=1) / size):
        outline = _outline(triangles[rows]) if areas[rows].sum() >= _LEAST_AREA * total else None
        normal = normals[rows[np.argmax(areas[rows])]]
        if outline is not None and _is_convex(points[outline], normal, size):
            outlines.append(points[outline])
            outward.append(normal)
    return _faces(outlines, np.reshape(outward, (-1, 3)))


def _coplanar(normals: np.ndarray, offsets: np.ndarray) -> list[np.ndarray]:
    """Return the rows of triangles in each plane."""
    keys = np.rint(np.column_stack([normals, offsets]) / (10.0 * _FLAT))
    _, plane = np.unique(keys, axis=0, return_inverse=True)
    order = np.argsort(plane.reshape(-1), kind="stable")
    return np.split(order, np.flatnonzero(np.diff(plane.reshape(-1)[order])) + 1)


def _outline(triangles: np.ndarray) -> list[int] | None:
    """Return the corners of the outline of triangles, counterclockwise, or None if it is not one closed line."""
    sides = {(int(t[k]), int(t[(k + 1) % 3])) for t in triangles for k in range(3)}
    following = {start: end for start, end in sides if (end, start) not in sides}
    border = sum((end, start) not in sides for start, end in sides)
    if border != len(following):
        return None
    first = next(iter(following))
    corners, corner = [first], following[first]
    while corner != first and len(corners) <= border:
        corners.append(corner)
        corner = following.get(corner, first)
    return corners if len(corners) == border else None


def _is_convex(corners: np.ndarray, normal: np.ndarray, size: float) -> bool:
    """Return True if no corner lies outside an edge, for a counterclockwise outline."""
    edges = _edges(corners, normal)
    return bool(((corners @ edges[:, :3].T - edges[:, 3]) <= 10.0 * _FLAT * size).all())


def _faces(outlines, normals: np.ndarray) -> FlatFaces:
    """Return the faces with corners ``outlines`` [m], counterclockwise, and outward unit normals."""
    offsets = [normal @ corners.mean(axis=0) for corners, normal in zip(outlines, normals, strict=True)]
    planes = np.column_stack([normals, np.reshape(offsets, (-1, 1))]) if len(normals) else np.zeros((0, 4))
    return FlatFaces(planes, tuple(map(_edges, outlines, normals)))


def _edges(corners: np.ndarray, normal: np.ndarray) -> np.ndarray:
    """Return the outward unit normals of edges in the plane of their face, and offsets [m], shape [e, 4]."""
    along = np.roll(corners, -1, axis=0) - corners
    outward = np.cross(along, normal)
    outward /= np.linalg.norm(outward, axis=1, keepdims=True)
    offsets = (outward * corners).sum(axis=1)
    lines = np.column_stack([outward, offsets / np.ptp(corners)])
    _, kept = np.unique(np.rint(lines / _SAME_LINE), axis=0, return_index=True)
    return np.column_stack([outward, offsets])[np.sort(kept)]  # edges in one line count once
