"""Checks meshes and sizes of colliders: Newton would read out of bounds, loop forever or import wrong shapes."""

from collections.abc import Iterator

import numpy as np
from pxr import Usd, UsdGeom

from warpmag.errors import InputError
from warpmag.shapes import lattice
from warpmag.shapes.polygons import triangulate
from warpmag.usd.values import LARGEST_COORDINATE, LARGEST_SIZE, SMALLEST_SIZE, Finding, finding_of, value_of

_SIZES = ("radius", "radiusTop", "radiusBottom", "size", "height")
_LARGEST_MAGNET = 2e4
"""Limit of a magnet's sizes [m], so that its moment and the moment's square stay in single precision."""
_AS_DRAWN = ("none", "meshSimplification", "sdf", None)
"""Collision approximations that keep a mesh's surface. The others are closed, and replace an open mesh as magnet."""


def shape_findings(prim: Usd.Prim) -> Iterator[Finding]:
    """Yield errors in a collider's size in the world, and in its mesh. Its attributes must be valid."""
    if prim.IsA(UsdGeom.Mesh):
        yield from _mesh_findings(prim)
    else:
        yield from _size_findings(prim, LARGEST_SIZE)


def magnet_findings(prim: Usd.Prim) -> Iterator[Finding]:
    """Yield the reason why a valid collider cannot be magnetized."""
    if not prim.IsA(UsdGeom.Mesh):
        yield from _size_findings(prim, _LARGEST_MAGNET)
        return
    points, counts, indices = (np.asarray(value) for value in _topology(prim)[:3])
    try:
        lattice.mesh(points.astype(float) @ _axes(prim), indices[triangulate(points, counts, indices)])
    except InputError as error:
        approximation = prim.GetAttribute("physics:approximation").Get()
        if approximation in _AS_DRAWN:
            yield Finding(str(prim.GetPath()), str(error))
        else:
            place = f"its approximation for collisions, {approximation}, is magnetized in its place"
            message = f"{error}: {place}, and a density gives it the mass of the open mesh"
            yield Finding(str(prim.GetPath()), message, "warning")


def spacing_findings(magnet: Usd.Prim, colliders: list[Usd.Prim], spacing: float) -> Iterator[Finding]:
    """Yield an error if a moment spacing [m] is too small for the valid colliders of a magnet."""
    boxes = []
    for prim in colliders if spacing > 0.0 else ():
        lower, upper = UsdGeom.Boundable.ComputeExtentFromPlugins(UsdGeom.Boundable(prim), Usd.TimeCode.Default())
        boxes.append(np.subtract(upper, lower).astype(float) * np.linalg.norm(_axes(prim), axis=1))
    if not lattice.fits(boxes, spacing):
        message = f"warpmag:momentSpacing {spacing:g} m needs more than {lattice.LARGEST_COUNT} moments for one body"
        yield Finding(str(magnet.GetPath()), message)


def mesh_findings(prim: Usd.Prim) -> Iterator[Finding]:
    """Yield errors in the faces of a visual mesh, which may have none."""
    try:
        points, counts, indices, holes = _topology(prim)
    except InputError as error:
        yield finding_of(str(prim.GetPath()), error)
        return
    if points and indices and (message := _topology_fault(len(points), counts, indices, holes)):
        yield Finding(str(prim.GetPath()), message)


def _size_findings(prim, largest) -> Iterator[Finding]:
    try:
        sizes = [value_of(prim, name) for name in _SIZES] if prim.IsA(UsdGeom.Gprim) else []
    except InputError:  # reported with the attributes
        return
    lengths = np.linalg.norm(_axes(prim), axis=1)
    for name, size in zip(_SIZES, sizes, strict=False):
        if isinstance(size, float) and not (SMALLEST_SIZE <= size * lengths.min() and size * lengths.max() <= largest):
            scaled = f"{name} {size:g} scaled by {lengths.min():g} to {lengths.max():g}"
            yield Finding(str(prim.GetPath()), f"{scaled} must be from {SMALLEST_SIZE:g} to {largest:g} m")


def _mesh_findings(prim) -> Iterator[Finding]:
    path = str(prim.GetPath())
    points, counts, indices, holes = _topology(prim)
    if points is None or not len(points):
        yield Finding(path, "mesh has no points")
        return
    if message := _topology_fault(len(points), counts, indices, holes):
        yield Finding(path, message)
        return
    corners = np.asarray(points, dtype=float)[np.unique(np.asarray(indices))] @ _axes(prim)
    extent = np.ptp(corners, axis=0).max()
    if not SMALLEST_SIZE <= extent <= LARGEST_SIZE:
        yield Finding(path, f"mesh is {extent:g} m long, must be from {SMALLEST_SIZE:g} to {LARGEST_SIZE:g} m")
    elif not np.abs(corners).max() <= LARGEST_COORDINATE:
        yield Finding(path, f"points reach {np.abs(corners).max():g} m, beyond {LARGEST_COORDINATE:g}")


def _topology(prim) -> tuple:
    return tuple(value_of(prim, name) for name in ("points", "faceVertexCounts", "faceVertexIndices", "holeIndices"))


def _topology_fault(vertices: int, counts, indices, holes) -> str:
    """Return the error in the faces of a mesh, empty where there is none."""
    if counts is None or indices is None or not len(counts):
        return "mesh has no faces: faceVertexCounts or faceVertexIndices is empty"
    counts, indices = np.asarray(counts, dtype=np.int64), np.asarray(indices, dtype=np.int64)
    if (counts < 3).any():
        return f"faceVertexCounts must be 3 or more, got {counts[counts < 3][0]}"
    if counts.sum() != len(indices):
        return f"faceVertexCounts sum to {counts.sum()}, but there are {len(indices)} faceVertexIndices"
    wrong = indices[(indices < 0) | (indices >= vertices)]
    if len(wrong):
        return f"faceVertexIndices name point {wrong[0]}, but there are points 0 to {vertices - 1} only"
    holes = np.asarray(holes if holes is not None else (), dtype=np.int64)
    wrong = holes[(holes < 0) | (holes >= len(counts))]
    if len(wrong):
        return f"holeIndices name face {wrong[0]}, but there are faces 0 to {len(counts) - 1} only"
    return ""


def _axes(prim) -> np.ndarray:
    """Return the world vectors of a prim's axes, one row each."""
    return np.array(UsdGeom.XformCache(Usd.TimeCode.Default()).GetLocalToWorldTransform(prim))[:3, :3]
