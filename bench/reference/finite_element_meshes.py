"""Meshes of ``iron_bodies`` for finite elements, in mm: half planes of axial setups, solids of others.

Needs Netgen: ``pip install ngsolve``. Elements are as small as the gap between two bodies, and shrink geometrically
toward edges and corners, where the field is singular (hp refinement).
"""

# pyright: reportMissingImports=false, reportAttributeAccessIssue=false

import math
from dataclasses import dataclass

import ngsolve as ng
import numpy as np
from netgen import occ
from netgen.meshing import MeshingParameters

from bench.reference.iron_bodies import Body, Setup

_FAR = 30.0  # radius of the domain over the size of the setup; 120 in place of 30 changes forces and moments by 5e-5
_RATIO = 0.15  # of the sizes of elements from one layer to the next, toward an edge
_GRADING = {2: 0.3, 3: 0.5}


@dataclass(frozen=True)
class Resolution:
    """Sizes and degree of the elements."""

    order: int  # degree of the potential
    layers: int  # number of geometric layers toward edges
    scale: float  # size of elements over the gap


@dataclass(frozen=True)
class Domain:
    """A mesh of bodies and air, with names ``body0``, ... of regions, ``surface0``, ... and ``far`` of boundaries."""

    mesh: ng.Mesh
    axes: tuple[int, ...]  # axis x, y or z (0, 1, 2) of each coordinate of the mesh
    mirrors: tuple[int, ...]  # axes across planes of symmetry, along which totals are 0
    weight: ng.CoefficientFunction  # volume of the setup per volume of the mesh


def axial_domain(setup: Setup, resolution: Resolution) -> Domain:
    """Return the half plane r ≥ 0 of an axial setup; its coordinates are r and z."""
    middle, size = _extent(setup)
    domain = _half_disc(_FAR * size, middle[2])
    for edge in domain.edges:
        edge.name = "far" if edge.center[0] > 0.1 * size else "axis"
    pieces = [_section(body) for body in setup.bodies]
    mesh = _meshed(setup, domain, pieces, resolution)
    return Domain(mesh, (0, 2), (0,), 2.0 * math.pi * ng.x)


def solid_domain(setup: Setup, resolution: Resolution) -> Domain:
    """Return the part of a setup at x ≥ 0 and y ≥ 0 where these planes are mirrors; its coordinates are x, y, z."""
    middle, size = _extent(setup)
    radius = _FAR * size
    mirrors = tuple(axis for axis in (0, 1) if setup.is_mirrored(axis))
    domain = occ.Sphere(occ.Pnt(*middle), radius)
    domain.faces.name = "far"
    pieces = [_solid(body) for body in setup.bodies]
    corner = [0.0 if axis in mirrors else -2.0 * radius for axis in (0, 1)]
    part = occ.Box(occ.Pnt(*corner, -2.0 * radius), occ.Pnt(2.0 * radius, 2.0 * radius, 2.0 * radius))
    part.faces.name = "mirror"
    mesh = _meshed(setup, domain * part, [piece * part for piece in pieces], resolution)
    return Domain(mesh, (0, 1, 2), mirrors, ng.CF(2.0 ** len(mirrors)))


def _meshed(setup: Setup, domain, pieces: list, resolution: Resolution) -> ng.Mesh:
    """Return the mesh of a domain with pieces of bodies, refined in gaps and toward edges."""
    _, size = _extent(setup)
    dimension, air = (2, domain) if len(domain.solids) == 0 else (3, domain)
    for k, (piece, body) in enumerate(zip(pieces, setup.bodies, strict=True)):
        regions, surfaces = (piece.faces, piece.edges) if dimension == 2 else (piece.solids, piece.faces)
        for surface in surfaces:
            surface.name = surface.name if surface.name == "mirror" else f"surface{k}"
        regions.name, regions.maxh = f"body{k}", 500.0 * resolution.scale * min(body.size)
        air = air - piece
    (air.faces if dimension == 2 else air.solids).name = "air"
    parameters = MeshingParameters(grading=_GRADING[dimension])
    for place, gap in _gaps(setup, dimension) if len(pieces) > 1 else ():
        point = place[[0, 2, 1]] if dimension == 2 else place
        parameters.RestrictH(*map(float, point), h=resolution.scale * gap)
    geometry = occ.OCCGeometry(occ.Glue([air, *pieces]), dim=dimension)
    mesh = ng.Mesh(geometry.GenerateMesh(parameters, maxh=0.25 * _FAR * size))
    if resolution.layers:
        mesh.RefineHP(resolution.layers, factor=_RATIO)
    mesh.Curve(resolution.order)
    return mesh


def _gaps(setup: Setup, dimension: int):
    """Yield points [mm], shape [3], and the sums of the distances to their two nearest bodies [mm].

    Points are the centers of cells, divided until their side is at most half the sum.
    """
    axes, (middle, size) = [0, 2] if dimension == 2 else [0, 1, 2], _extent(setup)
    offsets = np.zeros((2**dimension, 3))
    offsets[:, axes] = np.array(list(np.ndindex(*(2,) * dimension))) - 0.5
    side, centers = 2.0 * size, middle[None]
    while len(centers):
        distances = np.sort([np.maximum(_distance(body, centers), 0.0) for body in setup.bodies], axis=0)
        gaps = distances[:2].sum(axis=0)
        small = side <= 0.5 * gaps
        yield from zip(centers[small], gaps[small], strict=True)
        side *= 0.5
        centers = (centers[~small, None] + side * offsets).reshape(-1, 3)


def _distance(body: Body, points: np.ndarray) -> np.ndarray:
    """Distances [mm] of points [mm] from the surface of a body, negative inside, shape [n]."""
    size, (x, y, z) = 1e3 * np.array(body.size), (points - 1e3 * np.array(body.center)).T
    if body.shape == "ball":
        return np.sqrt(x * x + y * y + z * z) - size[0]
    c, s = math.cos(body.turn), math.sin(body.turn)
    x, z = c * x - s * z, s * x + c * z
    if body.shape == "prism":
        excess = np.array([_outline_distance(1e3 * np.array(body.outline), x, z), np.abs(y) - size[0]])
    else:
        inward = np.abs([x, y, z]) if body.shape == "box" else np.array([np.hypot(x, y), np.abs(z)])
        excess = inward - size[:, None]
    return np.linalg.norm(np.maximum(excess, 0.0), axis=0) + np.minimum(excess.max(axis=0), 0.0)


def _outline_distance(outline: np.ndarray, x: np.ndarray, z: np.ndarray) -> np.ndarray:
    """Distances of points (x, z) from a polygon, negative inside, shape [n]."""
    points, begin, end = np.stack([x, z], axis=-1)[:, None], outline, np.roll(outline, -1, axis=0)
    edge, offset = end - begin, points - begin
    along = np.clip((offset * edge).sum(axis=2) / (edge**2).sum(axis=1), 0.0, 1.0)
    distance = np.linalg.norm(offset - along[..., None] * edge, axis=2).min(axis=1)
    crosses = (begin[:, 1] > points[..., 1]) != (end[:, 1] > points[..., 1])
    side = edge[:, 0] * offset[..., 1] - edge[:, 1] * offset[..., 0]
    inside = (crosses & ((side < 0.0) == (edge[:, 1] > 0.0))).sum(axis=1) % 2 == 1
    return np.where(inside, -distance, distance)


def _extent(setup: Setup) -> tuple[np.ndarray, float]:
    """Center of the bodies and largest distance of their parts from it [mm]."""
    centers = 1e3 * np.array([body.center for body in setup.bodies])
    middle = 0.5 * (centers.min(axis=0) + centers.max(axis=0))
    reach = [1e3 * body.reach for body in setup.bodies]
    return middle, float((np.linalg.norm(centers - middle, axis=1) + reach).max())


def _half_disc(radius: float, z: float):
    """Half disc of a radius at r ≥ 0 around a point of the axis [mm]."""
    low, side, high = occ.Pnt(0, z - radius, 0), occ.Pnt(radius, z, 0), occ.Pnt(0, z + radius, 0)
    return occ.Face(occ.Wire([occ.ArcOfCircle(low, side, high), occ.Segment(high, low)]))


def _section(body: Body):
    """Section of a body in the half plane r ≥ 0, with corners marked for refinement."""
    size, z = [1e3 * length for length in body.size], 1e3 * body.center[2]
    if body.shape == "ball":
        return _half_disc(size[0], z)
    section = occ.MoveTo(0, z - size[1]).Rectangle(size[0], 2.0 * size[1]).Face()
    for corner in section.vertices:
        corner.hpref = 1 if corner.p[0] > 0.0 else 0
    return section


def _solid(body: Body):
    """Solid of a body, with edges and corners marked for refinement."""
    size, center = [1e3 * length for length in body.size], [1e3 * length for length in body.center]
    if body.shape == "ball":
        return occ.Sphere(occ.Pnt(*center), size[0])
    if body.shape == "cylinder":
        x, y, z = center
        solid = occ.Cylinder(occ.Pnt(x, y, z - size[1]), occ.Z, r=size[0], h=2.0 * size[1])
        for edge in solid.edges:
            edge.hpref = 1 if abs(edge.center[2] - z) > 0.9 * size[1] else 0  # not the seam
        return solid
    if body.shape == "prism":
        corners = [occ.Pnt(1e3 * x, -size[0], 1e3 * z) for x, z in body.outline]
        edges = [occ.Segment(a, b) for a, b in zip(corners, corners[1:] + corners[:1], strict=True)]
        solid = occ.Face(occ.Wire(edges)).Extrude(occ.Vec(0, 2.0 * size[0], 0))
    else:
        solid = occ.Box(occ.Pnt(*(-length for length in size)), occ.Pnt(*size))
    for part in (*solid.edges, *solid.vertices):
        part.hpref = 1
    turned = solid.Rotate(occ.Axis(occ.Pnt(0, 0, 0), occ.Y), math.degrees(body.turn))
    return turned.Move(occ.Vec(*center))
