"""Convex polyhedra that bound uniformly magnetized bodies, and quadrature points for the forces between two of them.

The field of such a body is a closed form, a sum over its edges and faces (``kernels/applied/polyhedron.h``). A box is
exact. A cylinder is a prism of :data:`CYLINDER_SIDES` sides with the cylinder's volume. Its field differs by 1 % of M
at a twentieth of the radius from the rim's corners, and by 1e-3 at a tenth (``tests/test_close_up.py``). A cylinder
magnetized along its axis has the exact field and potentials (``kernels/applied/axial_cylinder.h``), and charges on its
two ends only.

Force and torque on a body are integrals over the charges M·n of its faces. Stokes' theorem turns them into line
integrals of the potentials φ = M·G and a = M×G of the other body, which are continuous everywhere. The force in the
plane of a face with the normal n is −∮ φ ν dl. Here ν is the outward normal of an edge in this plane. The force normal
to the face is n ∮ a·dl. Both are integrals over edges. The torque of a face also needs an integral over its area,
∫ (a − n n·a) dA. Between touching bodies, the normal B and the tangential H are continuous, so that a small
interpenetration changes the force only a little.
"""

import math
from dataclasses import dataclass, replace
from functools import cache, cached_property

import numpy as np

from warpmag.shapes.cylinder_potential import potential_table

CYLINDER_SIDES = 32
"""Number of sides of the prism that replaces a cylinder."""
_LEAST_POINTS, _EDGE_POINTS, _FACE_POINTS, _FINE_FACE_POINTS = 4, 16, 8, 32
"""Numbers of Gauss points: the smallest on an edge; on the longest edge; across a face as long as that edge, for
torques; and for energies. Forces between touching boxes then have an error of 2e-3 at any offset. Forces use no points
on faces. The potential has a kink on a face near an edge of the other body. For two boxes half a millimeter apart, 8
points give the force to 1e-5, but the slope of the energy only to 3 %; energies therefore use more."""
_RIM_POINTS = 256
"""Number of points on each rim of a cylinder magnetized along its axis. Forces between overlapping ends of discs of
50:1 then have an error of 4e-4, those of thicker discs 1e-5. With 128 points it would be 1e-3."""
_REACH, _REMAINDER, _MOST_MOMENTS = 1.5, 1e-5, 256
"""For the moments that replace a body at a distance: smallest distance, in halves of the body's smallest side; relative
error of the field there from the Gauss points along one axis; largest number of moments. If more moments were needed,
the distance is increased."""
_FAR_REACH, _FAR_REMAINDER = 5.0, 1.2e-4
"""For the few moments that replace a body farther off: smallest distance, in halves of the body's largest side, and
relative error along one axis. A cube and a disc have 8 moments, slender boxes 2. Gradients of their fields have an
error of up to 5e-3 there, which falls off with the fourth power of the distance."""


@dataclass(frozen=True)
class Cylinder:
    """A cylinder."""

    radius: float  # [m]
    half_height: float  # [m]
    center: np.ndarray  # [m], shape [3]
    axis: np.ndarray  # unit vector, shape [3]


@dataclass(frozen=True)
class Polyhedron:
    """A convex polyhedron."""

    corners: np.ndarray  # [m], shape [c, 3]
    faces: tuple[tuple[int, ...], ...]  # indices of each face's corners, counterclockwise seen from outside
    cylinder: Cylinder | None = None  # the cylinder that it replaces

    def posed(self, position, rotation) -> "Polyhedron":
        """Return the polyhedron rotated by a matrix and then moved by ``position`` [m]."""
        rotation, cylinder = np.asarray(rotation), self.cylinder
        if cylinder is not None:
            center, axis = rotation @ cylinder.center + position, rotation @ cylinder.axis
            cylinder = replace(cylinder, center=center, axis=axis)
        return Polyhedron(self.corners @ rotation.T + position, self.faces, cylinder)

    def potential_table(self) -> np.ndarray:
        """Return center and axis of the cylinder, and its table (``cylinder_potential``), flat; empty for others."""
        if self.cylinder is None:
            return np.zeros(0)
        shape = self.cylinder
        return np.concatenate([shape.center, shape.axis, potential_table(shape.radius, shape.half_height)])

    @cached_property
    def bounds(self) -> tuple[float, ...]:
        """Radius of the sphere around the corners, center of the bounding box, half sides of the box [m], shape [7].

        The sphere has the center of the box.
        """
        lower, upper = self.corners.min(axis=0), self.corners.max(axis=0)
        center = 0.5 * (lower + upper)
        radius = np.linalg.norm(self.corners - center, axis=1).max()
        return tuple(map(float, (radius, *center, *(0.5 * (upper - lower)))))

    @cached_property
    def normals(self) -> np.ndarray:
        """Outward unit normals of the faces, shape [f, 3]."""
        a, b, c = (self.corners[[face[k] for face in self.faces]] for k in range(3))
        normals = np.cross(b - a, c - b)
        return normals / np.linalg.norm(normals, axis=1, keepdims=True)

    @cached_property
    def edges(self) -> np.ndarray:
        """Two corners and two faces of each edge, shape [e, 4]; the first face lists it from first to second."""
        sides = {}
        for k, face in enumerate(self.faces):
            sides |= dict.fromkeys(zip(face, face[1:] + face[:1], strict=True), k)
        return np.array([(a, b, k, sides[b, a]) for (a, b), k in sides.items() if a < b])

    def edge_rows(self) -> np.ndarray:
        """Return rows of edges: corner, direction, length, ν out of both faces, n of both faces, shape [e, 19]."""
        first, last, face, other = self.edges.T
        along = self.corners[last] - self.corners[first]
        length = np.linalg.norm(along, axis=1, keepdims=True)
        along, n, n2 = along / length, self.normals[face], self.normals[other]
        return np.concatenate([self.corners[first], along, length, np.cross(along, n), np.cross(n2, along), n, n2], 1)

    def edge_points(self) -> np.ndarray:
        """Return points on edges: position, direction, ν and n of both faces, weight [m], shape [points, 19]."""
        rows = self.edge_rows()
        longest, points = rows[:, 6].max(), []
        for row in rows:
            nodes, weights = _gauss(max(_LEAST_POINTS, int(np.ceil(_EDGE_POINTS * row[6] / longest - 1e-6))))
            positions = row[:3] + row[6] * nodes[:, None] * row[3:6]
            fixed = np.broadcast_to(np.delete(row, [0, 1, 2, 6]), (len(nodes), 15))
            points.append(np.concatenate([positions, fixed, row[6] * weights[:, None]], axis=1))
        return np.concatenate(points)

    def face_points(self, *, fine: bool = False) -> np.ndarray:
        """Return points on faces, more of them if ``fine``: position, n, weight [m²], shape [points, 7]."""
        across = _FINE_FACE_POINTS if fine else _FACE_POINTS
        longest, points = self.edge_rows()[:, 6].max(), []
        for face, normal in zip(self.faces, self.normals, strict=True):
            positions, weights = _gauss_points_on_face(self.corners[list(face)], longest, across)
            normals = np.broadcast_to(normal, positions.shape)
            points.append(np.concatenate([positions, normals, weights[:, None]], axis=1))
        return np.concatenate(points)

    def end_points(self, *, fine: bool = False) -> tuple[np.ndarray, np.ndarray]:
        """Return points on the rims and ends of the cylinder, as :meth:`edge_points` and :meth:`face_points` do.

        Both are empty for other polyhedra.
        """
        if self.cylinder is None:
            return np.zeros((0, 19)), np.zeros((0, 7))
        shape, (nodes, weights) = self.cylinder, _gauss(_FINE_FACE_POINTS if fine else _FACE_POINTS)
        out = self._around_axis(_RIM_POINTS)
        rays = self._around_axis(CYLINDER_SIDES)
        arc, sector = 2.0 * np.pi * shape.radius / _RIM_POINTS, 2.0 * np.pi * shape.radius**2 / CYLINDER_SIDES
        rims, ends = [], []
        for side in (-1.0, 1.0):
            normal, middle = side * shape.axis, shape.center + side * shape.half_height * shape.axis
            along, up = np.cross(normal, out), np.broadcast_to(normal, out.shape)
            arcs = np.full((len(out), 1), arc)
            rims.append(np.concatenate([middle + shape.radius * out, along, out, up, up, out, arcs], axis=1))
            positions = (middle + shape.radius * nodes[:, None, None] * rays).reshape(-1, 3)
            areas = np.repeat(sector * nodes * weights, len(rays))[:, None]
            ends.append(np.concatenate([positions, np.broadcast_to(normal, positions.shape), areas], axis=1))
        return np.concatenate(rims), np.concatenate(ends)

    def _around_axis(self, count: int) -> np.ndarray:
        """Return ``count`` unit vectors from the axis of the cylinder at equal angles, shape [count, 3]."""
        assert self.cylinder is not None
        axis, angle = self.cylinder.axis, 2.0 * np.pi / count * (np.arange(count) + 0.5)
        first = self.corners[0] - self.cylinder.center
        first = first - first @ axis * axis
        first = first / np.linalg.norm(first)
        return np.cos(angle)[:, None] * first + np.sin(angle)[:, None] * np.cross(axis, first)


@dataclass(frozen=True)
class Moments:
    """Moments at Gauss points that replace a body at a distance; there, gradients of their field have an error of 1e-3.

    Lattice cells that are not cubes, or that a surface cuts, have an error of 1e-2 at any distance. Beyond a larger
    distance, the few moments of :func:`far_box_moments` and :func:`far_cylinder_moments` suffice.
    """

    positions: np.ndarray  # [m], shape [n, 3]
    volumes: np.ndarray  # [m³], shape [n]
    depths: np.ndarray  # depths below the surface of the body [m], shape [n]
    reach: float  # smallest distance from the surface at which the moments replace the body [m]

    def posed(self, position, rotation) -> "Moments":
        """Return the moments rotated by a matrix and then moved by ``position`` [m]."""
        return replace(self, positions=self.positions @ np.asarray(rotation).T + position)


def box(half_extents) -> Polyhedron:
    """Return a box of half sides ``half_extents`` [m], shape [3], centered at the origin."""
    square = np.array([[-1, -1], [1, -1], [1, 1], [-1, 1]])
    return _prism(square * np.asarray(half_extents, float)[:2], float(half_extents[2]))


def cylinder(radius: float, half_height: float) -> Polyhedron:
    """Return a prism along z with the volume of a cylinder of ``radius`` and ``half_height`` [m], at the origin."""
    step = 2.0 * np.pi / CYLINDER_SIDES
    angle = step * np.arange(CYLINDER_SIDES)
    circle = np.stack([np.cos(angle), np.sin(angle)], axis=1)
    prism = _prism(radius * np.sqrt(step / np.sin(step)) * circle, half_height)
    exact = Cylinder(float(radius), float(half_height), np.zeros(3), np.array([0.0, 0.0, 1.0]))
    return replace(prism, cylinder=exact)


def box_moments(half_extents) -> Moments:
    """Return the moments of a box of half sides ``half_extents`` [m], shape [3], centered at the origin."""
    half = np.asarray(half_extents, float)
    return _box_moments(half, *_planned(half.min(), lambda distance: [_panels_and_points(h, distance) for h in half]))


def far_box_moments(half_extents) -> Moments:
    """Return the few moments of a box of half sides ``half_extents`` [m] for large distances, shape [3]."""
    half = np.asarray(half_extents, float)
    distance = _FAR_REACH * float(half.max())
    return _box_moments(half, [_panels_and_points(h, distance, 1, _FAR_REMAINDER) for h in half], distance)


def _box_moments(half: np.ndarray, lines, distance: float) -> Moments:
    """Return moments of a box from (panels, points) per axis, for distances from ``distance`` [m] on."""
    (x, wx), (y, wy), (z, wz) = (_gauss_points_on_line(h, *line) for h, line in zip(half, lines, strict=True))
    positions = np.stack(np.meshgrid(x, y, z, indexing="ij"), axis=-1).reshape(-1, 3)
    shares = (wx[:, None, None] * wy[:, None] * wz).ravel()
    return Moments(positions, 8.0 * half.prod() * shares, (half - np.abs(positions)).min(axis=1), distance)


def cylinder_moments(radius: float, half_height: float) -> Moments:
    """Return the moments of a cylinder along z of ``radius`` and ``half_height`` [m] at the origin, in rings."""

    def plan(distance):
        _, order = _panels_and_points(radius, max(distance, radius / 1e3), 1)
        return [_panels_and_points(half_height, distance), (order // 2 + 1, 2 * order + 1)]

    (line, circles), distance = _planned(min(radius, half_height), plan)
    return _cylinder_moments(radius, half_height, line, circles, distance)


def far_cylinder_moments(radius: float, half_height: float) -> Moments:
    """Return the few moments of a cylinder along z, as :func:`cylinder_moments`, for large distances."""
    distance = _FAR_REACH * max(radius, half_height)
    line = _panels_and_points(half_height, distance, 1, _FAR_REMAINDER)
    return _cylinder_moments(radius, half_height, line, (1, 4), distance)  # a ring is exact to third order


def _cylinder_moments(radius: float, half_height: float, line, circles, distance: float) -> Moments:
    """Return moments of a cylinder for distances from ``distance`` [m] on.

    ``line`` are panels and points along the axis, ``circles`` the number of rings and of moments in a ring.
    """
    rings, around = circles
    (squared, area), (z, height) = _gauss(rings), _gauss_points_on_line(half_height, *line)
    angle = 2.0 * np.pi / around * np.arange(around)
    r, phi, z = np.meshgrid(radius * np.sqrt(squared), angle, z, indexing="ij")
    positions = np.stack([r * np.cos(phi), r * np.sin(phi), z], axis=-1).reshape(-1, 3)
    shares = (area[:, None, None] / around * np.ones((around, 1)) * height).ravel()
    depth = np.minimum(radius - r, half_height - np.abs(z)).ravel()
    return Moments(positions, 2.0 * np.pi * radius**2 * half_height * shares, depth, distance)


def _planned(half: float, plan):
    """Return ``plan(distance)``, which is (panels, points) per axis, and the distance [m].

    The distance is the smallest from ``_REACH * half`` on with a plan of at most :data:`_MOST_MOMENTS` moments.
    """
    distance = _REACH * half
    while math.prod(map(math.prod, plan(distance))) > _MOST_MOMENTS:  # counts of foils exceed 64 bits
        distance *= 1.1
    return plan(distance), distance


def _panels_and_points(half: float, distance: float, panels: int = 0, remainder: float = _REMAINDER) -> tuple[int, int]:
    """Return the number of panels of a line of length 2 ``half``, and the number of Gauss points in each.

    Half a panel is at most ``distance`` long. The error of n points at that distance falls off as
    exp(−2n arsinh(distance/half a panel)).
    """
    panels = panels or int(np.ceil(half / distance))
    return panels, max(1, int(np.ceil(-np.log(remainder) / (2.0 * np.arcsinh(distance * panels / half)))))


def _gauss_points_on_line(half: float, panels: int, points: int) -> tuple[np.ndarray, np.ndarray]:
    """Return Gauss points on a line from −half to half, and their weights, which sum to 1."""
    nodes, shares = _gauss(points)
    positions = (np.arange(panels)[:, None] + nodes).ravel() / panels
    return (2.0 * positions - 1.0) * half, np.tile(shares / panels, panels)


def _prism(polygon: np.ndarray, half_height: float) -> Polyhedron:
    """Return the prism along z over a counterclockwise polygon of corners [m], shape [n, 2]."""
    n = len(polygon)
    corners = np.concatenate([np.c_[polygon, np.full(n, z)] for z in (-half_height, half_height)])
    sides = tuple((k, (k + 1) % n, n + (k + 1) % n, n + k) for k in range(n))
    return Polyhedron(corners, (tuple(range(n))[::-1], tuple(range(n, 2 * n)), *sides))


def _gauss_points_on_face(corners: np.ndarray, longest: float, most: int) -> tuple[np.ndarray, np.ndarray]:
    """Return Gauss points on a rectangle or a regular polygon, and their weights [m²]."""
    if len(corners) == 4:
        across = corners[1] - corners[0], corners[3] - corners[0]
        counts = [max(2, int(np.ceil(most * np.linalg.norm(side) / longest - 1e-6))) for side in across]
        (u, wu), (v, wv) = (_gauss(count) for count in counts)
        positions = corners[0] + u[:, None, None] * across[0] + v[:, None] * across[1]
        return positions.reshape(-1, 3), np.outer(wu, wv).ravel() * np.linalg.norm(np.cross(*across))
    center, following = corners.mean(axis=0), np.roll(corners, -1, axis=0)
    nodes, weights = _gauss(most)
    positions = center + nodes[:, None] * (0.5 * (corners + following) - center)[:, None]
    areas = np.linalg.norm(np.cross(corners - center, following - center), axis=1)
    return positions.reshape(-1, 3), np.outer(areas, nodes * weights).ravel()


@cache
def _gauss(count: int) -> tuple[np.ndarray, np.ndarray]:
    """Return nodes and weights of Gauss-Legendre quadrature on [0, 1]."""
    nodes, weights = np.polynomial.legendre.leggauss(count)
    return 0.5 * (nodes + 1.0), 0.5 * weights
