"""Surfaces of solids as flat facets, narrow towards edges, where the charge of a permeable body is singular.

Facets have four corners, counterclockwise seen from outside, of which two may be one; shape [m, 4, 3] in all of these.
"""

from collections.abc import Sequence

import numpy as np

from warpmag.shapes.solids import Solid

_LEAST = 3
"""Facets along a side of a box, at least."""

_OFF = 1e-4
"""How far from a facet its two sides are looked at, in roots of its area."""


def box(half_extents: np.ndarray, count: int) -> np.ndarray:
    """About ``count`` facets of a box."""
    n = max(_LEAST, round(np.sqrt(count / 6.0)))
    at = -np.cos(np.pi * np.linspace(0.0, 1.0, n + 1))
    found = []
    for axis, sign in ((k, s) for k in range(3) for s in (1.0, -1.0)):
        a, b = (axis + 1) % 3, (axis + 2) % 3
        corners = np.empty((n + 1, n + 1, 3))
        corners[..., a], corners[..., b] = (sign * half_extents[a] * at)[:, None], half_extents[b] * at
        corners[..., axis] = sign * half_extents[axis]
        found.append(_patch(corners))
    return np.concatenate(found)


def ellipsoid(semi_axes: np.ndarray, count: int) -> np.ndarray:
    """About ``count`` facets of an ellipsoid."""
    turns = np.pi * np.linspace(0.0, 1.0, 4 * _unit(count) + 1)
    return _revolved(np.sin(turns), -np.cos(turns), 4 * _unit(count)) * semi_axes


def cylinder(radius: float, half_height: float, count: int) -> np.ndarray:
    """About ``count`` facets of a cylinder along z."""
    unit = _unit(count)
    rho, z = radius * _towards_end(unit), half_height * (2.0 * _towards_ends(2 * unit) - 1.0)
    rhos = [rho, np.full(2 * unit - 1, radius), rho[::-1]]
    heights = [np.full(unit + 1, -half_height), z[1:-1], np.full(unit + 1, half_height)]
    return _revolved(np.concatenate(rhos), np.concatenate(heights), 4 * unit)


def cone(radius: float, half_height: float, count: int) -> np.ndarray:
    """About ``count`` facets of a cone along z, its base below."""
    unit = _unit(count)
    base, side = radius * _towards_end(unit), _towards_ends(3 * unit)[1:]
    rhos, heights = [base, radius * (1.0 - side)], [np.full(unit + 1, -half_height), half_height * (2.0 * side - 1.0)]
    return _revolved(np.concatenate(rhos), np.concatenate(heights), 4 * unit)


def capsule(radius: float, half_height: float, count: int) -> np.ndarray:
    """About ``count`` facets of a capsule along z."""
    unit = _unit(count)
    turns = 0.5 * np.pi * np.linspace(0.0, 1.0, unit + 1)
    rho, z = radius * np.cos(turns), half_height + radius * np.sin(turns)
    between = half_height * np.linspace(-1.0, 1.0, 2 * unit + 1)[1:-1]
    rhos = [rho[::-1], np.full(len(between), radius), rho]
    return _revolved(np.concatenate(rhos), np.concatenate([-z[::-1], between, z]), 4 * unit)


def mesh(corners: np.ndarray, count: int) -> np.ndarray:
    """The triangles of a mesh, shape [n, 3, 3], the longest halved until there are ``count``."""
    while len(corners) < count:
        sides = np.linalg.norm(np.roll(corners, -1, axis=1) - corners, axis=2)
        longest, which = sides.max(axis=1), sides.argmax(axis=1)
        cut = longest >= 0.7 * longest.max()
        rows = np.arange(cut.sum())
        a, b, c = (corners[cut][rows, (which[cut] + k) % 3] for k in range(3))
        middle = 0.5 * (a + b)
        halves = [np.stack([a, middle, c], axis=1), np.stack([middle, b, c], axis=1)]
        corners = np.concatenate([corners[~cut], *halves])
    return corners[:, [0, 1, 2, 2]]


def of_body(solids: Sequence[Solid], count: int) -> np.ndarray:
    """About ``count`` facets of the surface of the union of solids, in the frame of the body.

    Where surfaces meet others, facets are whole or left out, by their middles.
    """
    found = []
    for k, solid in enumerate(solids):
        own = solid.facets(max(1, count // len(solids)))
        normals, areas = measures(own)
        enclosed = np.einsum("ik,ik->i", middles(own), normals) @ areas / 3.0
        own = own * np.cbrt(solid.volume / enclosed) @ solid.rotation.T + solid.position
        normals, areas = measures(own)
        off = _OFF * np.sqrt(areas)[:, None] * normals
        outer, inner = middles(own) + off, middles(own) - off
        hidden = np.zeros(len(own), bool)
        for j, other in enumerate(solids):
            if j != k:
                # inside another one, or on a surface that an earlier one has in common with this one
                hidden |= other.contains(outer) | ((j < k) & other.contains(inner))
        found.append(own[~hidden])
    return np.concatenate(found)


def middles(facets: np.ndarray) -> np.ndarray:
    """Centroids, shape [m, 3]."""
    a, b, c, d = np.moveaxis(facets, 1, 0)
    first, second = (np.linalg.norm(np.cross(q - a, r - a), axis=1)[:, None] for q, r in ((b, c), (c, d)))
    return (first * (a + b + c) + second * (a + c + d)) / (3.0 * (first + second))


def measures(facets: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Unit normals, shape [m, 3], and areas, shape [m]."""
    a, b, c, d = np.moveaxis(facets, 1, 0)
    double = np.cross(c - a, d - b)
    size = np.linalg.norm(double, axis=1)
    return double / size[:, None], 0.5 * size


def _unit(count: int) -> int:
    return max(2, round(np.sqrt(count / 16.0)))


def _towards_end(count: int) -> np.ndarray:
    return np.sin(0.5 * np.pi * np.linspace(0.0, 1.0, count + 1))


def _towards_ends(count: int) -> np.ndarray:
    return 0.5 - 0.5 * np.cos(np.pi * np.linspace(0.0, 1.0, count + 1))


def _patch(corners: np.ndarray) -> np.ndarray:
    """Facets between points in rows and columns."""
    parts = corners[:-1, :-1], corners[1:, :-1], corners[1:, 1:], corners[:-1, 1:]
    return np.stack(parts, axis=2).reshape(-1, 4, 3)


def _revolved(rho: np.ndarray, z: np.ndarray, count: int) -> np.ndarray:
    """A profile from the lower end of the axis to the upper, turned about it; cross-sections keep their area."""
    turns = 2.0 * np.pi * np.arange(count + 1) / count
    rho = rho * np.sqrt(turns[1] / np.sin(turns[1]))
    points = np.outer(np.cos(turns), rho), np.outer(np.sin(turns), rho), np.broadcast_to(z, (count + 1, len(z)))
    found = _patch(np.stack(points, axis=2))
    return found[measures(found)[1] > 1e-12 * np.ptp(z) ** 2]
