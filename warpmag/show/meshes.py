"""Meshes of the solids of UsdGeom: importers, such as Blender's, drop the materials of spheres and cubes."""

import functools
from collections.abc import Sequence

import numpy as np
from pxr import Gf, Usd, UsdGeom, Vt

from warpmag.shapes.polygons import triangulate
from warpmag.usd.schemas import shape_axis

_AROUND = 48
"""Corners of a ball's equator and of other circles."""
_CREASE = 0.82
"""Cosine of the angle between faces beyond which an edge is sharp."""

Shape = tuple[np.ndarray, list[np.ndarray]]
"""Points, shape [n, 3], and the corners of each face, counterclockwise seen from outside."""


def shape_of(prim: Usd.Prim) -> Shape | None:
    """Return the surface of a mesh, of a solid of UsdGeom, or of a plane, in its own frame; None for others.

    Solids whose ``axis`` is x or y are rotated from z by cyclic permutation, as UsdGeom does.
    """
    if prim.IsA(UsdGeom.Mesh):
        points, counts, indices = (
            np.array(prim.GetAttribute(name).Get(0.0)) for name in ("points", "faceVertexCounts", "faceVertexIndices")
        )
        if not (points.ndim and counts.ndim and indices.ndim and len(points) and len(counts)):
            return None
        return points.astype(float), np.split(indices, np.cumsum(counts)[:-1])
    for kind, (make, *sizes) in _MAKERS.items():
        if prim.IsA(kind):
            points, faces = make(*(prim.GetAttribute(name).Get() for name in sizes))
            axis = shape_axis(prim.GetStage(), prim.GetPath()) or "Z"
            return np.roll(points, {"X": 1, "Y": 2, "Z": 0}[axis], axis=1), faces  # (x, y, z) → (z, x, y)
    return None


def author_mesh(mesh: UsdGeom.Mesh, points: np.ndarray, faces: Sequence[np.ndarray]) -> None:
    """Author a mesh of flat faces whose normals are smooth except at sharp edges."""
    mesh.CreatePointsAttr(Vt.Vec3fArray.FromNumpy(np.ascontiguousarray(points, dtype=np.float32)))
    mesh.CreateFaceVertexCountsAttr(Vt.IntArray([len(face) for face in faces]))
    mesh.CreateFaceVertexIndicesAttr(Vt.IntArray.FromNumpy(np.concatenate(faces).astype(np.int32)))
    mesh.CreateSubdivisionSchemeAttr(UsdGeom.Tokens.none)
    corners, normals = np.concatenate(faces), corner_normals(points, faces)
    at_points = np.zeros((len(points), 3))
    at_points[corners] = normals
    smooth = np.allclose(at_points[corners], normals, rtol=0.0, atol=1e-6)
    normals = at_points if smooth else normals
    mesh.CreateNormalsAttr(Vt.Vec3fArray.FromNumpy(np.ascontiguousarray(normals, dtype=np.float32)))
    mesh.SetNormalsInterpolation(UsdGeom.Tokens.vertex if smooth else UsdGeom.Tokens.faceVarying)
    low, high = points.min(axis=0), points.max(axis=0)
    mesh.CreateExtentAttr([Gf.Vec3f(*low.tolist()), Gf.Vec3f(*high.tolist())])


def corner_normals(points: np.ndarray, faces: Sequence[np.ndarray]) -> np.ndarray:
    """Return unit normals at the corners of faces, smooth where faces meet at less than 35°.

    Args:
        points: Points of the mesh, shape [n, 3].
        faces: Indices of the corners of each face, counterclockwise seen from outside.

    Returns:
        A normal for each corner of each face, one face after the other, shape [corners, 3].
    """
    sizes = np.array([len(face) for face in faces])
    corners, owners = np.concatenate(faces), np.repeat(np.arange(len(faces)), sizes)
    start = np.repeat(np.cumsum(sizes) - sizes, sizes)
    number = np.arange(len(corners)) - start  # of the corner in its face
    following = corners[start + (number + 1) % np.repeat(sizes, sizes)]
    origin = points[corners[start]]
    areas = np.zeros((len(faces), 3))
    np.add.at(areas, owners, np.cross(points[corners] - origin, points[following] - origin))
    flat = areas / np.linalg.norm(areas, axis=1, keepdims=True)
    # all pairs of corners that share a point: rows of ``corner`` and faces of the second corner
    order = np.argsort(corners, kind="stable")
    shared = np.bincount(corners, minlength=len(points))
    first = (np.cumsum(shared) - shared)[corners]
    count = shared[corners]
    corner = np.repeat(np.arange(len(corners)), count)
    rank = np.arange(len(corner)) - np.repeat(np.cumsum(count) - count, count)
    face = owners[order[first[corner] + rank]]
    smooth = np.einsum("ni,ni->n", flat[owners[corner]], flat[face]) > _CREASE
    sums = np.zeros((len(corners), 3))
    np.add.at(sums, corner[smooth], areas[face[smooth]])
    return sums / np.linalg.norm(sums, axis=1, keepdims=True)


def triangles_of(points: np.ndarray, faces: Sequence[np.ndarray]) -> np.ndarray:
    """Return the triangles of polygons with the given points, shape [k, 3]."""
    corners = np.concatenate(faces)
    return corners[triangulate(points, np.array([len(face) for face in faces]), corners)]


def revolved(profile: np.ndarray, around: int = _AROUND) -> Shape:
    """Return the surface of revolution of a line about z, with ``around`` corners around z.

    ``profile`` are points (r, z) from the lower pole to the upper one, r = 0 at the poles only, shape [k, 2].
    """
    angle = 2.0 * np.pi * np.arange(around) / around
    circle = np.stack([np.cos(angle), np.sin(angle)], axis=1)
    rings = [np.c_[r * circle, np.full(around, z)] for r, z in profile[1:-1].tolist()]
    poles = np.array([[0.0, 0.0, profile[0, 1]], [0.0, 0.0, profile[-1, 1]]])
    points = np.concatenate([*rings, poles])
    corner = np.arange(around)
    following = np.roll(corner, -1)
    last, low, high = (len(rings) - 1) * around, len(points) - 2, len(points) - 1
    faces = list(np.stack([np.full(around, low), following, corner], axis=1))
    for ring in range(len(rings) - 1):
        a, b = ring * around, (ring + 1) * around
        faces += list(np.stack([corner + a, following + a, following + b, corner + b], axis=1))
    return points, faces + list(np.stack([corner + last, following + last, np.full(around, high)], axis=1))


def _arc(radius: float, center: float, begin: float, end: float, count: int) -> np.ndarray:
    """Return points (r, z) of an arc about (0, center); angles from the equator in units of π."""
    angle = np.pi * np.linspace(begin, end, count)
    return np.stack([radius * np.cos(angle), center + radius * np.sin(angle)], axis=1)


@functools.cache  # thousands of balls have the same radius
def _sphere(radius: float) -> Shape:
    profile = _arc(radius, 0.0, -0.5, 0.5, _AROUND // 2 + 1)
    profile[[0, -1], 0] = 0.0
    return revolved(profile)


def _box(side: float) -> Shape:
    corners = np.array([(x, y, z) for x in (-0.5, 0.5) for y in (-0.5, 0.5) for z in (-0.5, 0.5)])
    faces = [(0, 1, 3, 2), (4, 6, 7, 5), (0, 4, 5, 1), (2, 3, 7, 6), (0, 2, 6, 4), (1, 5, 7, 3)]
    return side * corners, [np.array(face) for face in faces]


def _plane(width: float, length: float) -> Shape:
    corners = np.array([(-0.5, -0.5, 0.0), (0.5, -0.5, 0.0), (0.5, 0.5, 0.0), (-0.5, 0.5, 0.0)])
    return corners * (width, length, 1.0), [np.arange(4)]


def _cylinder(low: float, high: float, height: float) -> Shape:
    h = 0.5 * height
    return revolved(np.array([(0.0, -h), (low, -h), (high, h), (0.0, h)]))


def _capsule(low: float, high: float, height: float) -> Shape:
    h = 0.5 * height
    lower, upper = _arc(low, -h, -0.5, 0.0, 5), _arc(high, h, 0.0, 0.5, 5)
    profile = np.concatenate([lower, upper])
    profile[[0, -1], 0] = 0.0
    return revolved(profile, _AROUND // 3)


def _cone(radius: float, height: float) -> Shape:
    h = 0.5 * height
    return revolved(np.array([(0.0, -h), (radius, -h), (0.0, h)]))


_MAKERS: dict[type, tuple] = {
    UsdGeom.Sphere: (_sphere, "radius"),
    UsdGeom.Cube: (_box, "size"),
    UsdGeom.Cylinder: (_cylinder, "radius", "radius", "height"),
    UsdGeom.Cylinder_1: (_cylinder, "radiusBottom", "radiusTop", "height"),
    UsdGeom.Capsule: (_capsule, "radius", "radius", "height"),
    UsdGeom.Capsule_1: (_capsule, "radiusBottom", "radiusTop", "height"),
    UsdGeom.Cone: (_cone, "radius", "height"),
    UsdGeom.Plane: (_plane, "width", "length"),
}
"""Maker of the mesh of each kind of prim, and the attributes that are its arguments."""

BALL = _sphere(1.0)
"""A ball of radius 1."""
ARROW = revolved(np.array([(0.0, -0.5), (0.05, -0.5), (0.05, 0.15), (0.14, 0.15), (0.0, 0.5)]), 16)
"""An arrow along z from -1/2 to 1/2."""
