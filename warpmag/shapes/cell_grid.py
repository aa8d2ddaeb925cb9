"""Grids of equal cells over the shapes of a body, and the part of each cell that a shape fills."""

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from warpmag.errors import InputError
from warpmag.shapes.solids import Solid, boxes_meet, grid

_FINE_POINTS = 32
"""Smallest number of test points along each axis of a shape, unless cells with ``_CELL_POINTS`` have fewer."""
_CELL_POINTS = 8
"""Number of test points along each axis of a cell, if several shapes share a grid. Cells that are small beside the
thinnest shape have 4."""
_LARGEST_REFINEMENT = 4.0
"""Largest ratio of spacing to cell side in a shared grid, where thin shapes get several cells across."""
_SMALL = 0.1
"""Shapes below this share of the largest shape's volume do not make the cells of a shared grid narrower."""
_WIDEST = 1.25
"""Largest factor by which a side of a cell changes, to place faces of a mesh between cells."""
_DEVIATION = 0.2
"""Cost of a change of a side by a factor, over the squared logarithm of the factor. A factor of 1.2 costs as much as
a face of 3 % of the cross-section in the middle of a cell."""
_MOST_POINTS = 1 << 23
"""Largest number of test points of a shape (200 MB, and a few seconds). More of them raise an error."""
_CHUNK = 1 << 18
"""Test points evaluated at a time (some tens of MB)."""


@dataclass(frozen=True)
class Filled:
    """Part of each cell that a shape fills, excluding overlap with earlier shapes."""

    index: np.ndarray  # index in the grid of each cell that the shape reaches into, shape [m, 3]
    shares: np.ndarray  # filled share of each subcell, shape [m, a, b, c]
    weights: np.ndarray  # number of test points of each cell in the filled part, shape [m]; fractions are possible
    sums: np.ndarray  # sum of the positions of these points [m], frame of the grid, shape [m, 3]
    point_count: float  # number of test points in the shape, including overlap with earlier shapes


@dataclass(frozen=True)
class CellGrid:
    """Equal cells over shapes, in the frame of the largest one. Along each axis they fit the thinnest shape exactly."""

    solids: list[Solid]  # shapes posed in the frame of the grid
    earlier: int  # number of leading ``solids`` that get no cells and only remove overlap
    lower: np.ndarray  # lower corner [m], shape [3]
    sides: np.ndarray  # sides of a cell [m], shape [3]
    counts: np.ndarray  # cells along each axis, shape [3]
    splits: np.ndarray  # test points across a cell along each axis, shape [3]
    position: np.ndarray  # origin of the grid in the body's frame [m], shape [3]
    rotation: np.ndarray  # rotation from the frame of the grid to the body's, shape [3, 3]

    def filled(self, k: int) -> Filled:
        """Return the part of each cell that shape ``k`` fills."""
        part = self.solids[k]
        others = [other for other in self.solids[:k] if boxes_meet(part, other)]
        pitch = np.abs(part.rotation).T @ (self.sides / self.splits)
        if (part.upper - part.lower < 2.0 * pitch).any():
            return self._filled_by_thin_shape(part, others, pitch)
        in_own_frame = not part.position.any() and (part.rotation == np.eye(3)).all()
        index, inside, hits = self._hits_along_axes(part, others) if in_own_frame else self._hits(part, others)
        factors = _volume_factors(inside / hits.shape[1], part.volume / self.sides.prod())
        used = hits.any(axis=1)
        index, shares = index[used], factors[used, None] * hits[used]
        weights = shares.sum(axis=1)
        sums = weights[:, None] * (self.lower + (index + 0.5) * self.sides) + shares @ self._offsets()
        return Filled(index, shares.reshape(-1, *self.splits), weights, sums, float(inside @ factors))

    def _offsets(self) -> np.ndarray:
        """Return the test points of a cell relative to its center [m], shape [points, 3]."""
        return ((grid(self.splits) + 0.5) / self.splits - 0.5) * self.sides

    def _hits_along_axes(self, part: Solid, others: list[Solid]) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Return :meth:`_hits` of a shape that has the frame of the grid, from test points in a grid along its axes."""
        first = np.maximum(np.floor((part.lower - self.lower) / self.sides).astype(int) - 1, 0)
        last = np.minimum(np.ceil((part.upper - self.lower) / self.sides).astype(int) + 1, self.counts)
        size = int(self.splits.prod())
        deep, rows, columns = size * (last - first)[2], *(last - first)[:2]
        high = min(rows, max(1, _CHUNK // (columns * deep)))
        wide = columns if high > 1 else min(columns, max(1, _CHUNK // deep))  # blocks in the order of the cells
        index, inside, hits = [np.empty((0, 3), int)], [np.empty(0, int)], [np.empty((0, size), bool)]
        for i, j in ((i, j) for i in range(first[0], last[0], high) for j in range(first[1], last[1], wide)):
            begin = np.array([i, j, first[2]])
            end = np.minimum([i + high, j + wide, last[2]], last)
            x, y, z = (self._test_coordinates(axis, begin[axis], end[axis]) for axis in range(3))
            free = part.contains_grid(x, y, z)
            cells = np.stack([end - begin, self.splits], axis=1).reshape(-1)
            count = free.reshape(cells).sum(axis=(1, 3, 5)).reshape(-1)
            for other in others:
                a, b, c = np.nonzero(free)
                free[a, b, c] = ~other.contains(np.stack([x[a], y[b], z[c]], axis=1))
            used = np.flatnonzero(count)
            index.append(np.stack(np.unravel_index(used, end - begin), axis=1) + begin)
            inside.append(count[used])
            hits.append(free.reshape(cells).transpose(0, 2, 4, 1, 3, 5).reshape(-1, size)[used])
        return np.concatenate(index), np.concatenate(inside), np.concatenate(hits)

    def _test_coordinates(self, axis: int, begin: int, end: int) -> np.ndarray:
        """Return the coordinates [m] of the test points of the cells from ``begin`` to ``end`` along an axis."""
        side, split = self.sides[axis], self.splits[axis]
        centers = self.lower[axis] + (np.arange(begin, end) + 0.5) * side
        return (centers[:, None] + ((np.arange(split) + 0.5) / split - 0.5) * side).reshape(-1)

    def _hits(self, part: Solid, others: list[Solid]) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Return the cells with test points in a shape, shape [m, 3], and the number of these points, shape [m].

        The third value is True for test points in the shape, but not in ``others``, shape [m, points of a cell].
        """
        index, offsets = self._cells_near(part), self._offsets()
        cells = self.lower + (index + 0.5) * self.sides
        inside, hits = np.empty(len(cells), int), np.empty((len(cells), len(offsets)), bool)
        step = max(1, _CHUNK // len(offsets))
        for start in range(0, len(cells), step):
            chunk = cells[start : start + step]
            in_part, free = _inside(part, others, (chunk[:, None, :] + offsets).reshape(-1, 3))
            inside[start : start + step] = np.count_nonzero(in_part.reshape(len(chunk), -1), axis=1)
            hits[start : start + step] = free.reshape(len(chunk), -1)
        used = inside > 0
        return index[used], inside[used], hits[used]

    def _cells_near(self, part: Solid) -> np.ndarray:
        """Return the sorted indices of the cells that the rotated bounding box of a shape reaches into."""
        rotation, extent = np.abs(part.rotation), part.upper - part.lower
        steps = (0.5 * self.sides[:, None] / np.maximum(rotation, 1e-9)).min(axis=0)  # along each axis of the shape
        points = part.test_points(self._point_counts(extent / steps))
        index, size = np.floor((points - self.lower) / self.sides).astype(int), self.counts + 4
        index = np.clip(index, -2, self.counts + 1) + 2  # indices of neighbors are not negative, either
        index = np.stack(np.unravel_index(np.unique(np.ravel_multi_index(tuple(index.T), size)), size), axis=1)
        index = np.clip(index[:, None] + grid(np.full(3, 3)) - 1, 0, size - 1).reshape(-1, 3)  # with their neighbors
        index = np.stack(np.unravel_index(np.unique(np.ravel_multi_index(tuple(index.T), size)), size), axis=1) - 2
        index = index[((index >= 0) & (index < self.counts)).all(axis=1)]
        center = (self.lower + (index + 0.5) * self.sides - part.position) @ part.rotation
        reach = 0.5 * (extent + self.sides @ rotation) * (1.0 - 1e-9)
        return index[(np.abs(center - 0.5 * (part.lower + part.upper)) < reach).all(axis=1)]

    def _point_counts(self, ratios: np.ndarray) -> np.ndarray:
        """Return numbers of test points along the axes of a shape, ``ratios`` rounded up; too many raise an error."""
        counts = np.ceil(ratios)
        if not counts.prod() <= _MOST_POINTS:
            sides = " x ".join(f"{side:.2g}" for side in self.sides)
            raise InputError(
                f"spacing: cells of {sides} m are too small beside a shape of the body, which would need "
                f"{counts.prod():.2g} test points: give a larger spacing, or make a body of each shape"
            )
        return counts.astype(int)

    def _filled_by_thin_shape(self, part: Solid, others: list[Solid], pitch: np.ndarray) -> Filled:
        """Return :meth:`filled` of a thin shape from its own test points, because the grid's points may miss it."""
        points = part.test_points(self._point_counts(np.maximum((part.upper - part.lower) / pitch, _CELL_POINTS)))
        inside, free = _inside(part, others, points)
        point_count, points = np.count_nonzero(inside), points[free]
        coordinates = (points - self.lower) / self.sides
        index = np.clip(coordinates.astype(int), 0, self.counts - 1)
        index, cell = np.unique(index, axis=0, return_inverse=True)
        cell = cell.reshape(-1)
        split = np.clip(((coordinates - index[cell]) * self.splits).astype(int), 0, self.splits - 1)
        subcell = np.ravel_multi_index(tuple(split.T), tuple(self.splits))
        size = int(self.splits.prod())
        hits = np.bincount(cell * size + subcell, minlength=len(index) * size).reshape(-1, *self.splits)
        sums = np.stack([np.bincount(cell, x, len(index)) for x in points.T], axis=1)
        share = part.volume / max(point_count, 1) / (self.sides / self.splits).prod()
        weights = hits.sum(axis=(1, 2, 3)).astype(float)
        return Filled(index, hits * share, weights, sums, point_count)


def cells_over(parts: Sequence[Solid], earlier: Sequence[Solid], spacing: float, across: int) -> CellGrid:
    """Return a grid of cells with sides of about ``spacing`` [m] over ``parts`` of a body outside ``earlier`` shapes.

    ``across`` is the smallest number of cells across a shape. In a shared grid ``_LARGEST_REFINEMENT`` limits it.
    """
    largest = max(parts, key=lambda part: part.volume)
    solids = [_in_frame_of(largest, part) for part in (*earlier, *parts)]
    posed = solids[len(earlier) :]
    middle, half = np.array([part.bounds() for part in posed]).swapaxes(0, 1)
    lower, upper = (middle - half).min(axis=0), (middle + half).max(axis=0)
    spacing = min(spacing, (upper - lower).max())  # larger cells would have fewer test points in the shapes
    large = np.array([part.volume >= _SMALL * largest.volume for part in parts])
    thinnest = np.where(large[:, None], half, np.inf).argmin(axis=0), np.arange(3)
    thin, face = 2.0 * half[thinnest], (middle - half)[thinnest]
    flattest = np.inf if len(parts) == 1 else _LARGEST_REFINEMENT if across > 1 else 1.0
    fit = np.maximum(np.rint(thin / spacing), np.minimum(across, flattest * thin / spacing))
    if len(solids) == 1:
        fit = _fit_steps(largest, fit, across)
    sides = thin / np.where(fit < 1.0, fit, np.rint(fit))
    cells_before = np.ceil((face - lower) / sides - 1e-6)
    counts = (cells_before + np.ceil((upper - face) / sides - 1e-6)).astype(int)
    splits = np.maximum(np.ceil(_FINE_POINTS * sides / thin - 1e-6).astype(int), 1)
    if len(parts) == 1:
        splits = -(-splits // 8) * 8  # demagnetizing tensors use 8 subcells
    else:
        splits = np.where(splits > 4, _CELL_POINTS, 4)  # with 8 always, a hammer of two shapes has an eigenvalue < 0
    lower = face - cells_before * sides
    return CellGrid(solids, len(earlier), lower, sides, counts, splits, largest.position, largest.rotation)


def _fit_steps(part: Solid, fit: np.ndarray, across: int) -> np.ndarray:
    """Return numbers of cells along each axis near ``fit`` for which faces of the shape lie between cells.

    A face inside a cell costs its share of the cross-section times its squared distance [cells] from the nearest face
    of the cell.
    """
    extent, result = part.upper - part.lower, fit.copy()
    for axis in range(3):
        coordinate, area = part.steps[part.steps[:, 0] == axis, 1:].T
        if not len(coordinate):
            continue
        least = max(int(np.ceil(fit[axis] / _WIDEST)), min(int(fit[axis]), across))
        counts = np.arange(least, int(fit[axis] * _WIDEST) + 1)
        if len(counts) < 2:
            continue
        heights = counts[:, None] * ((coordinate - part.lower[axis]) / extent[axis])
        shares = area / np.delete(extent, axis).prod()
        cost = (shares * (heights - np.rint(heights)) ** 2).sum(axis=1) + _DEVIATION * np.log(counts / fit[axis]) ** 2
        result[axis] = counts[cost.argmin()]
    return result


def _in_frame_of(frame: Solid, part: Solid) -> Solid:
    """Return a shape posed in the frame of another shape of its body."""
    if part is frame:
        return replace(part, position=np.zeros(3), rotation=np.eye(3))
    rotation = frame.rotation.T @ part.rotation
    return replace(part, position=(part.position - frame.position) @ frame.rotation, rotation=rotation)


def _inside(part: Solid, others: list[Solid], points: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return True for each point in ``part``, and for each point in ``part`` but in none of ``others``."""
    inside = part.contains(points)
    free = inside.copy()
    for other in others:
        free[free] = ~other.contains(points[free])
    return inside, free


def _volume_factors(shares: np.ndarray, volume: float) -> np.ndarray:
    """Return factors of the shares of cells inside a shape, so that their sum is its ``volume`` in cells, shape [m].

    Only cells that the surface cuts change: a share s becomes s + c s (1 − s). Whole cells keep their volume. So the
    fields of near cells (sums over subcells) and those of distant cells (dipoles) belong to the same body. c is limited
    to ±1.
    """
    cut = float(shares @ (1.0 - shares))
    if cut == 0.0:
        return np.ones(len(shares))
    return 1.0 + np.clip((volume - shares.sum()) / cut, -1.0, 1.0) * (1.0 - shares)
