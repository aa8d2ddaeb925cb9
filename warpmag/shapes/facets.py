"""Surfaces of solids as flat facets, which are narrow at edges, where the charge of a permeable body is singular.

Facets are arrays of shape [m, 4, 3]: four corners each, counterclockwise seen from outside. Two corners of a triangle
coincide.
"""

from collections.abc import Sequence

import numpy as np

from warpmag.shapes.solids import Solid

_LEAST_PER_SIDE = 3
"""Smallest number of facets along a side of a box."""
_TEST_OFFSET = 1e-4
"""Distance of the test points on both sides of a facet from its center, in square roots of its area."""
_FLAT = 1e-6
"""Ratio of height to longest side up to which a triangle of float32 corners counts as one without area."""


def box(half_extents: np.ndarray, count: int) -> np.ndarray:
    """Return about ``count`` facets of a box."""
    n = max(_LEAST_PER_SIDE, round(np.sqrt(count / 6.0)))
    lines = -np.cos(np.pi * np.linspace(0.0, 1.0, n + 1))
    sides = []
    for axis, sign in ((k, s) for k in range(3) for s in (1.0, -1.0)):
        a, b = (axis + 1) % 3, (axis + 2) % 3
        corners = np.empty((n + 1, n + 1, 3))
        corners[..., a], corners[..., b] = (sign * half_extents[a] * lines)[:, None], half_extents[b] * lines
        corners[..., axis] = sign * half_extents[axis]
        sides.append(_patch(corners))
    return np.concatenate(sides)


def ellipsoid(semi_axes: np.ndarray, count: int) -> np.ndarray:
    """Return about ``count`` facets of an ellipsoid."""
    angles = np.pi * np.linspace(0.0, 1.0, 4 * _facets_per_quarter(count) + 1)
    return _revolved(np.sin(angles), -np.cos(angles), 4 * _facets_per_quarter(count)) * semi_axes


def cylinder(radius: float, half_height: float, count: int) -> np.ndarray:
    """Return about ``count`` facets of a cylinder along z."""
    quarter = _facets_per_quarter(count)
    rho, z = radius * _dense_at_end(quarter), half_height * (2.0 * _dense_at_ends(2 * quarter) - 1.0)
    rhos = [rho, np.full(2 * quarter - 1, radius), rho[::-1]]
    heights = [np.full(quarter + 1, -half_height), z[1:-1], np.full(quarter + 1, half_height)]
    return _revolved(np.concatenate(rhos), np.concatenate(heights), 4 * quarter)


def cone(radius: float, half_height: float, count: int) -> np.ndarray:
    """Return about ``count`` facets of a cone along z, with its base below."""
    quarter = _facets_per_quarter(count)
    base, side = radius * _dense_at_end(quarter), _dense_at_ends(3 * quarter)[1:]
    rhos = [base, radius * (1.0 - side)]
    heights = [np.full(quarter + 1, -half_height), half_height * (2.0 * side - 1.0)]
    return _revolved(np.concatenate(rhos), np.concatenate(heights), 4 * quarter)


def capsule(radius: float, half_height: float, count: int) -> np.ndarray:
    """Return about ``count`` facets of a capsule along z."""
    quarter = _facets_per_quarter(count)
    angles = 0.5 * np.pi * np.linspace(0.0, 1.0, quarter + 1)
    rho, z = radius * np.cos(angles), half_height + radius * np.sin(angles)
    between = half_height * np.linspace(-1.0, 1.0, 2 * quarter + 1)[1:-1]
    rhos = [rho[::-1], np.full(len(between), radius), rho]
    return _revolved(np.concatenate(rhos), np.concatenate([-z[::-1], between, z]), 4 * quarter)


def mesh(corners: np.ndarray, count: int) -> np.ndarray:
    """Return at least ``count`` facets of a mesh with triangles [n, 3, 3], by halving triangles with long sides.

    Triangles without area, such as those of a polygon with a straight corner, are left out.
    """
    sides = np.roll(corners, -1, axis=1) - corners
    areas = np.linalg.norm(np.cross(sides[:, 0], sides[:, 1]), axis=1)
    corners = corners[areas > _FLAT * (sides**2).sum(axis=2).max(axis=1)]
    while len(corners) < count:
        sides = np.linalg.norm(np.roll(corners, -1, axis=1) - corners, axis=2)
        longest, side = sides.max(axis=1), sides.argmax(axis=1)
        cut = longest >= 0.7 * longest.max()
        rows = np.arange(cut.sum())
        a, b, c = (corners[cut][rows, (side[cut] + k) % 3] for k in range(3))
        middle = 0.5 * (a + b)
        halves = [np.stack([a, middle, c], axis=1), np.stack([middle, b, c], axis=1)]
        corners = np.concatenate([corners[~cut], *halves])
    return corners[:, [0, 1, 2, 2]]


def of_body(solids: Sequence[Solid], count: int) -> np.ndarray:
    """Return about ``count`` facets of the surface of a union of solids, in the frame of the body.

    A facet that other solids cut is kept or dropped as a whole, by its center.
    """
    surfaces = []
    for k, solid in enumerate(solids):
        surface = solid.facets(max(1, count // len(solids)))
        normals, areas = normals_and_areas(surface)
        enclosed = np.einsum("ik,ik->i", centroids(surface), normals) @ areas / 3.0
        surface = surface * np.cbrt(solid.volume / enclosed) @ solid.rotation.T + solid.position
        normals, areas = normals_and_areas(surface)
        offset = _TEST_OFFSET * np.sqrt(areas)[:, None] * normals
        outer, inner = centroids(surface) + offset, centroids(surface) - offset
        hidden = np.zeros(len(surface), bool)
        for j, other in enumerate(solids):
            if j != k:
                # inside another solid, or on a surface shared with an earlier solid
                hidden |= other.contains(outer) | ((j < k) & other.contains(inner))
        surfaces.append(surface[~hidden])
    return np.concatenate(surfaces)


def centroids(facets: np.ndarray) -> np.ndarray:
    """Return the centroids of facets, shape [m, 3]."""
    a, b, c, d = np.moveaxis(facets, 1, 0)
    first, second = (np.linalg.norm(np.cross(q - a, r - a), axis=1)[:, None] for q, r in ((b, c), (c, d)))
    return (first * (a + b + c) + second * (a + c + d)) / (3.0 * (first + second))


def normals_and_areas(facets: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return the outward unit normals of facets, shape [m, 3], and their areas, shape [m]."""
    a, b, c, d = np.moveaxis(facets, 1, 0)
    product = np.cross(c - a, d - b)
    double_areas = np.linalg.norm(product, axis=1)
    return product / double_areas[:, None], 0.5 * double_areas


def _facets_per_quarter(count: int) -> int:
    """Return the number of facets along a quarter of a circle, for ``count`` facets of a body of revolution."""
    return max(2, round(np.sqrt(count / 16.0)))


def _dense_at_end(count: int) -> np.ndarray:
    """Return ``count`` + 1 numbers from 0 to 1, dense at 1."""
    return np.sin(0.5 * np.pi * np.linspace(0.0, 1.0, count + 1))


def _dense_at_ends(count: int) -> np.ndarray:
    """Return ``count`` + 1 numbers from 0 to 1, dense at both ends."""
    return 0.5 - 0.5 * np.cos(np.pi * np.linspace(0.0, 1.0, count + 1))


def _patch(corners: np.ndarray) -> np.ndarray:
    """Return the facets between points in rows and columns, shape [rows, columns, 3]."""
    parts = corners[:-1, :-1], corners[1:, :-1], corners[1:, 1:], corners[:-1, 1:]
    return np.stack(parts, axis=2).reshape(-1, 4, 3)


def _revolved(rho: np.ndarray, z: np.ndarray, count: int) -> np.ndarray:
    """Return the facets of a profile (ρ, z), revolved about z in ``count`` steps that keep cross-section areas."""
    angles = 2.0 * np.pi * np.arange(count + 1) / count
    rho = rho * np.sqrt(angles[1] / np.sin(angles[1]))
    points = np.outer(np.cos(angles), rho), np.outer(np.sin(angles), rho), np.broadcast_to(z, (count + 1, len(z)))
    patch = _patch(np.stack(points, axis=2))
    return patch[normals_and_areas(patch)[1] > 1e-12 * np.ptp(z) ** 2]
