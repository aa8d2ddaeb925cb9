"""Closed triangle meshes: check that they are closed, and winding numbers of points."""

import math
from collections.abc import Callable

import numpy as np

from warpmag.errors import InputError

_CHUNK = 1 << 18
"""Pairs of a ray and a triangle evaluated at a time (some tens of MB)."""


_SAME_PLANE = 1e-5
"""Relative distance up to which parallel faces are in one plane. Also 1 − cosine of the angle up to which the normal of
a face counts as parallel to an axis."""


def steps_of(corners: np.ndarray) -> np.ndarray:
    """Return the planes normal to an axis that contain triangles, except those that bound the mesh, shape [f, 3].

    A row holds the axis, the coordinate [m] and the area of its triangles [m²]. ``corners`` [m] have the shape
    [k, 3, 3].
    """
    lower, upper = corners.min(axis=(0, 1)), corners.max(axis=(0, 1))
    size, rows = float((upper - lower).max()), []
    doubled = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    areas = 0.5 * np.linalg.norm(doubled, axis=1)
    for axis in range(3):
        height = corners[:, :, axis].mean(axis=1)
        across = 0.5 * np.abs(doubled[:, axis]) >= (1.0 - _SAME_PLANE) * areas
        across &= (height > lower[axis] + _SAME_PLANE * size) & (height < upper[axis] - _SAME_PLANE * size)
        planes, number = np.unique(np.rint(height[across] / (_SAME_PLANE * size)), return_inverse=True)
        total = np.bincount(number.reshape(-1), areas[across], len(planes))
        rows.append(np.column_stack([np.full(len(planes), axis), planes * _SAME_PLANE * size, total]))
    return np.concatenate(rows)


def welded(vertices: np.ndarray, faces: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return the vertices and triangles of a mesh with equal vertices joined and degenerate triangles dropped."""
    points, triangles = np.asarray(vertices, float), np.asarray(faces)
    if points.ndim != 2 or points.shape[1] != 3 or not np.isfinite(points).all():
        raise InputError(f"mesh: vertices must be finite and of shape [n, 3], got shape {points.shape}")
    if triangles.size == 0 or triangles.size % 3 or triangles.dtype.kind not in "iu":
        raise InputError("mesh: faces must be triples of indices")
    triangles = triangles.reshape(-1, 3).astype(np.int64)
    if triangles.min() < 0 or triangles.max() >= len(points):
        raise InputError(f"mesh: faces name a vertex outside 0 to {len(points) - 1}")
    size = float(np.ptp(points, axis=0).max())
    keys = np.rint((points - points.min(axis=0)) / max(1e-6 * size, np.finfo(float).tiny))  # joins float32 vertices
    _, first, joined = np.unique(keys, axis=0, return_index=True, return_inverse=True)
    triangles = joined.reshape(-1)[triangles]
    a, b, c = triangles.T
    triangles = triangles[(a != b) & (b != c) & (c != a)]
    if len(triangles) == 0:
        raise InputError("mesh: encloses no volume")
    return points[first], triangles


def check_closed(triangles: np.ndarray) -> None:
    """Raise ``InputError`` unless the triangles traverse every edge equally often in both directions."""
    start, end = triangles.reshape(-1), np.roll(triangles, -1, axis=1).reshape(-1)
    edges, edge = np.unique(np.sort(np.stack([start, end], axis=1), axis=1), axis=0, return_inverse=True)
    balance = np.bincount(edge.reshape(-1), np.where(start < end, 1.0, -1.0))
    if balance.any():
        open_edges = int(np.count_nonzero(balance))
        raise InputError(
            f"mesh: not closed and consistently oriented: {open_edges} of {len(edges)} edges lack their counterpart"
        )


def winding_number(points: np.ndarray, triangles: np.ndarray) -> Callable[..., np.ndarray]:
    """Return a function of coordinates x, y, z that returns the winding number of a closed mesh about each point.

    The coordinates broadcast. In a grid along the axes, all points of a line along z share a ray.

    The function counts the triangles that a ray along +z crosses. A crossing at an edge or a vertex counts exactly
    once: the side of an edge is computed from its end points in the order of their indices, and is thus the same for
    both triangles. Triangles are sorted into rectangular columns along z: a ray tests the triangles of its column.
    """
    crossings = _ray_crossings(points, triangles)

    def winding(x: np.ndarray, y: np.ndarray, z: np.ndarray) -> np.ndarray:
        x, y = np.broadcast_arrays(x, y)
        shape = np.broadcast_shapes(x.shape, z.shape)
        if not math.prod(shape):
            return np.zeros(shape, np.int16)
        height, sign, count = crossings(np.stack([x.reshape(-1), y.reshape(-1)], axis=1))
        result, start = (
            np.zeros((len(count), math.prod(shape) // max(1, len(count))), np.int16),
            np.cumsum(count) - count,
        )
        z = z.reshape(-1, result.shape[1])  # one row for all rays, or one for each
        for k in range(int(count.max(initial=0))):  # the crossing k of each ray
            rays = np.flatnonzero(count > k)
            crossing = start[rays] + k
            above = height[crossing, None] > (z if len(z) == 1 else z[rays])
            result[rays] += above * sign[crossing, None]
        return result.reshape(shape)

    return winding


def _ray_crossings(points: np.ndarray, triangles: np.ndarray) -> Callable[[np.ndarray], tuple[np.ndarray, ...]]:
    """Return a function of rays along z through (x, y), shape [n, 2], that returns where they cross a mesh.

    The function returns z [m] and the sign of the normal's z of each crossing, sorted by ray. It also returns the
    number of crossings of each ray.
    """
    corners = points[triangles]
    flat = corners[:, :, :2]
    lower = points[:, :2].min(axis=0)
    columns = int(np.clip(np.sqrt(len(triangles)), 1, 128))
    width = np.maximum((points[:, :2].max(axis=0) - lower) / columns, np.finfo(float).tiny)
    first = np.minimum(((flat.min(axis=1) - lower) / width).astype(int), columns - 1)
    spans = np.minimum(((flat.max(axis=1) - lower) / width).astype(int), columns - 1) - first + 1
    entries = np.repeat(np.arange(len(triangles)), spans.prod(axis=1))
    rank = _counters(spans.prod(axis=1))
    column = (first[entries, 0] + rank // spans[entries, 1]) * columns + first[entries, 1] + rank % spans[entries, 1]
    entries = entries[np.argsort(column, kind="stable")]
    sizes = np.bincount(column, minlength=columns * columns)
    starts = np.cumsum(sizes) - sizes

    low = np.minimum(triangles, np.roll(triangles, -1, axis=1))
    high = np.maximum(triangles, np.roll(triangles, -1, axis=1))
    forward = triangles == low
    origin, direction = points[low, :2], points[high, :2] - points[low, :2]

    def crossings(rays: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        xy = np.clip(((rays - lower) / width).astype(int), 0, columns - 1)
        column = xy[:, 0] * columns + xy[:, 1]
        heights, signs, counts = [np.empty(0)], [np.empty(0, np.int8)], np.zeros(len(rays), int)
        ends = np.cumsum(sizes[column])
        begin = 0
        while begin < len(rays):
            done = ends[begin - 1] if begin else 0
            stop = max(begin + 1, int(np.searchsorted(ends, done + _CHUNK, side="right")))
            rows = np.arange(begin, stop)
            ray = np.repeat(rows, sizes[column[rows]])
            t = entries[starts[column[ray]] + _counters(sizes[column[rows]])]
            offset = rays[ray, None] - origin[t]
            side = direction[t, :, 0] * offset[:, :, 1] - direction[t, :, 1] * offset[:, :, 0]
            left = (side >= 0.0) == forward[t]
            up, down = left.all(axis=1), ~left.any(axis=1)
            crossed = np.flatnonzero(up | down)
            opposite = np.abs(side[crossed][:, [1, 2, 0]])  # edge k, from corner k to k + 1, faces corner k + 2
            total = opposite.sum(axis=1)
            heights.append((opposite * corners[t[crossed], :, 2]).sum(axis=1) / np.where(total > 0.0, total, 1.0))
            signs.append(np.where(up[crossed], 1, -1).astype(np.int8))
            counts[begin:stop] = np.bincount(ray[crossed] - begin, minlength=stop - begin)
            begin = stop
        return np.concatenate(heights), np.concatenate(signs), counts

    return crossings


def _counters(counts: np.ndarray) -> np.ndarray:
    """Return 0 … counts[0] − 1, 0 … counts[1] − 1, and so on, in one array."""
    return np.arange(counts.sum()) - np.repeat(np.cumsum(counts) - counts, counts)
