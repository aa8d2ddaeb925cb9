"""Convex polyhedra that bound uniformly magnetized bodies, and the points at which forces between two are summed.

The field of such a body is a sum over its edges and faces in closed form (``kernels/applied/polyhedron.h``). A box is
exact. A cylinder is a prism of :data:`CYLINDER_SIDES` sides with the cylinder's volume, whose field differs by 1 % of M
at a twentieth of the radius from the rim's corners and by 1e-3 at a tenth (``tests/test_close_up.py``).

Force and torque of a field on a body are sums over the charges M·n of its faces. They are integrated once by Stokes'
theorem, with the potentials φ = M·G and a = M×G of the other body, both continuous everywhere: the force along a face
is −∮ φ ν dl and that across it n ∮ a·dl, so that edges are all that remains of it. The torque of a face takes its area
too, ∫ (a − n n·a) dA. Where the bodies touch the field that is meant lies between them: B across a face and H along it
are continuous there, and a little interpenetration changes the force a little.
"""

from dataclasses import dataclass
from functools import cached_property

import numpy as np

CYLINDER_SIDES = 32
"""Sides of the prism that stands for a cylinder."""

_LEAST_POINTS, _EDGE_POINTS, _FACE_POINTS, _FINE_FACE_POINTS = 4, 16, 8, 32
"""Gauss points on an edge, at least and on the longest, and across a face as long as that: boxes that touch feel each
other within 2e-3 then, wherever they are. Only torque and energy take points on faces: where an edge of the other body
is near a face, the potential there has a kink, and 8 points leave 3 % in the slope of the energy of two boxes half a
millimetre apart, whose forces are right to 1e-5. So energies take more."""

_REACH, _REMAINDER, _MOST_MOMENTS = 1.5, 1e-5, 256
"""Distance from which on moments stand for a body, in half its least side, at least; how much of the field there the
points of Gauss may miss in one direction; and how many they may be: if more were needed, the distance is longer."""


@dataclass(frozen=True)
class Polyhedron:
    """A convex polyhedron.

    Attributes:
        corners: Corners [m], shape [c, 3].
        faces: Indices of each face's corners, counterclockwise seen from outside.
    """

    corners: np.ndarray
    faces: tuple[tuple[int, ...], ...]

    def posed(self, position, rotation) -> "Polyhedron":
        """The same polyhedron turned by a matrix ``rotation`` and moved by ``position`` [m]."""
        return Polyhedron(self.corners @ np.asarray(rotation).T + position, self.faces)

    @cached_property
    def normals(self) -> np.ndarray:
        """Outward unit normals of the faces, shape [f, 3]."""
        a, b, c = (self.corners[[face[k] for face in self.faces]] for k in range(3))
        return _unit(np.cross(b - a, c - b))

    @cached_property
    def edges(self) -> np.ndarray:
        """Corners of each edge and its faces, the first of which is passed from the first corner on, shape [e, 4]."""
        sides = {}
        for k, face in enumerate(self.faces):
            sides |= dict.fromkeys(zip(face, face[1:] + face[:1], strict=True), k)
        return np.array([(a, b, k, sides[b, a]) for (a, b), k in sides.items() if a < b])

    def edge_rows(self) -> np.ndarray:
        """Rows of the edges: corner, direction, length, ν out of both faces and n of them, shape [e, 19]."""
        first, last, one, other = self.edges.T
        along = self.corners[last] - self.corners[first]
        length = np.linalg.norm(along, axis=1, keepdims=True)
        along, n, n2 = along / length, self.normals[one], self.normals[other]
        return np.concatenate([self.corners[first], along, length, np.cross(along, n), np.cross(n2, along), n, n2], 1)

    def edge_points(self) -> np.ndarray:
        """Points on the edges: place, direction, ν and n of both faces, weight [m], shape [points, 19]."""
        rows = self.edge_rows()
        longest, points = rows[:, 6].max(), []
        for row in rows:
            at, weights = _gauss(max(_LEAST_POINTS, int(np.ceil(_EDGE_POINTS * row[6] / longest - 1e-6))))
            places = row[:3] + row[6] * at[:, None] * row[3:6]
            fixed = np.broadcast_to(np.delete(row, [0, 1, 2, 6]), (len(at), 15))
            points.append(np.concatenate([places, fixed, row[6] * weights[:, None]], axis=1))
        return np.concatenate(points)

    def face_points(self, *, fine: bool = False) -> np.ndarray:
        """Points on the faces, more of them if ``fine``: place, n, weight [m²], shape [points, 7]."""
        across = _FINE_FACE_POINTS if fine else _FACE_POINTS
        longest, points = self.edge_rows()[:, 6].max(), []
        for face, normal in zip(self.faces, self.normals, strict=True):
            places, weights = _points_of(self.corners[list(face)], longest, across)
            points.append(np.concatenate([places, np.broadcast_to(normal, places.shape), weights[:, None]], axis=1))
        return np.concatenate(points)


@dataclass(frozen=True)
class Moments:
    """Points of Gauss that stand for a body from a distance on: gradients of their field are right to 1e-3 there.

    Cells of a lattice that are no cubes, or that a surface cuts, leave 1e-2 at any distance.

    Attributes:
        places: The points [m], shape [n, 3].
        volumes: Volume of each [m³], shape [n].
        depths: How far it lies under the surface [m], shape [n].
        reach: The distance from the surface [m].
    """

    places: np.ndarray
    volumes: np.ndarray
    depths: np.ndarray
    reach: float


def box(half_extents) -> Polyhedron:
    """A box of half sides ``half_extents`` [m], shape [3], centred at the origin."""
    square = np.array([[-1, -1], [1, -1], [1, 1], [-1, 1]])
    return _prism(square * np.asarray(half_extents, float)[:2], float(half_extents[2]))


def cylinder(radius: float, half_height: float) -> Polyhedron:
    """A prism for a cylinder along z of ``radius`` and ``half_height`` [m], centred at the origin, of its volume."""
    turn = 2.0 * np.pi / CYLINDER_SIDES
    angle = turn * np.arange(CYLINDER_SIDES)
    around = np.stack([np.cos(angle), np.sin(angle)], axis=1)
    return _prism(radius * np.sqrt(turn / np.sin(turn)) * around, half_height)


def box_moments(half_extents) -> Moments:
    """Moments of a box of half sides ``half_extents`` [m], shape [3], centred at the origin."""
    half = np.asarray(half_extents, float)
    lines, distance = _planned(half.min(), lambda distance: [_line(h, distance) for h in half])
    (x, wx), (y, wy), (z, wz) = (_along(h, *line) for h, line in zip(half, lines, strict=True))
    places = np.stack(np.meshgrid(x, y, z, indexing="ij"), axis=-1).reshape(-1, 3)
    shares = (wx[:, None, None] * wy[:, None] * wz).ravel()
    return Moments(places, 8.0 * half.prod() * shares, (half - np.abs(places)).min(axis=1), distance)


def cylinder_moments(radius: float, half_height: float) -> Moments:
    """Moments of a cylinder along z of ``radius`` and ``half_height`` [m], centred at the origin: rings in layers."""

    def plan(distance):
        _, order = _line(radius, max(distance, radius / 1e3), 1)
        return [_line(half_height, distance), (order // 2 + 1, 2 * order + 1)]

    (line, (rings, around)), distance = _planned(min(radius, half_height), plan)
    (squared, area), (z, height) = _gauss(rings), _along(half_height, *line)
    angle = 2.0 * np.pi / around * np.arange(around)
    r, turn, z = np.meshgrid(radius * np.sqrt(squared), angle, z, indexing="ij")
    places = np.stack([r * np.cos(turn), r * np.sin(turn), z], axis=-1).reshape(-1, 3)
    shares = (area[:, None, None] / around * np.ones((around, 1)) * height).ravel()
    depth = np.minimum(radius - r, half_height - np.abs(z)).ravel()
    return Moments(places, 2.0 * np.pi * radius**2 * half_height * shares, depth, distance)


def _planned(half: float, plan):
    """The densest plan of pairs of factors that gives :data:`_MOST_MOMENTS`, and the distance it is for."""
    distance = _REACH * half
    while np.prod(plan(distance)) > _MOST_MOMENTS:
        distance *= 1.1
    return plan(distance), distance


def _line(half: float, distance: float, panels: int = 0) -> tuple[int, int]:
    """Panels of a line, as long as ``distance`` or shorter, and points of Gauss in each, for a field from there on.

    What n points leave falls off as exp(−2n arsinh(distance/half a panel)).
    """
    panels = panels or int(np.ceil(half / distance))
    return panels, max(1, int(np.ceil(-np.log(_REMAINDER) / (2.0 * np.arcsinh(distance * panels / half)))))


def _along(half: float, panels: int, points: int) -> tuple[np.ndarray, np.ndarray]:
    """Places on a line from −half to half, and their shares of it."""
    at, shares = _gauss(points)
    places = (np.arange(panels)[:, None] + at).ravel() / panels
    return (2.0 * places - 1.0) * half, np.tile(shares / panels, panels)


def _prism(polygon: np.ndarray, half_height: float) -> Polyhedron:
    """The prism along z over a polygon of corners [m], shape [n, 2], counterclockwise."""
    n = len(polygon)
    corners = np.concatenate([np.c_[polygon, np.full(n, z)] for z in (-half_height, half_height)])
    sides = tuple((k, (k + 1) % n, n + (k + 1) % n, n + k) for k in range(n))
    return Polyhedron(corners, (tuple(range(n))[::-1], tuple(range(n, 2 * n)), *sides))


def _points_of(corners: np.ndarray, longest: float, most: int) -> tuple[np.ndarray, np.ndarray]:
    """Points of a rectangle or of a regular polygon, and their weights [m²]."""
    if len(corners) == 4:
        across = corners[1] - corners[0], corners[3] - corners[0]
        counts = [max(2, int(np.ceil(most * np.linalg.norm(one) / longest - 1e-6))) for one in across]
        (u, wu), (v, wv) = (_gauss(count) for count in counts)
        places = corners[0] + u[:, None, None] * across[0] + v[:, None] * across[1]
        return places.reshape(-1, 3), np.outer(wu, wv).ravel() * np.linalg.norm(np.cross(*across))
    centre, following = corners.mean(axis=0), np.roll(corners, -1, axis=0)
    at, weights = _gauss(most)
    places = centre + at[:, None] * (0.5 * (corners + following) - centre)[:, None]
    areas = np.linalg.norm(np.cross(corners - centre, following - centre), axis=1)
    return places.reshape(-1, 3), np.outer(areas, at * weights).ravel()


def _gauss(count: int) -> tuple[np.ndarray, np.ndarray]:
    """Points and weights of Gauss and Legendre between 0 and 1."""
    at, weights = np.polynomial.legendre.leggauss(count)
    return 0.5 * (at + 1.0), 0.5 * weights


def _unit(vectors: np.ndarray) -> np.ndarray:
    return vectors / np.linalg.norm(vectors, axis=1, keepdims=True)
