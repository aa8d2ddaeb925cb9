"""Grids of equal cells over the shapes of a body, and what each shape fills of their cells."""

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from warpmag.shapes.solids import Solid, boxes_meet, grid

_FINE_POINTS = 32
"""Test points across a shape, along each axis, at least, as far as ``_MOST_SPLITS`` lets them."""

_MOST_SPLITS = 8
"""Test points across a cell, along each axis, at most, where several shapes share a grid."""

_FLATTEST = 4.0
"""How much narrower than the spacing cells of several shapes get, for a thin one to have several across."""

_SMALL = 0.1
"""Shapes of less than this part of the largest one's volume do not make the cells narrower."""

_CHUNK = 1 << 18
"""Test points evaluated at a time (some tens of MB)."""


@dataclass(frozen=True)
class Filled:
    """What one shape fills of the cells of a grid, less what shapes before it do.

    Attributes:
        index: Place in the grid of each cell that it reaches into, shape [m, 3].
        shares: Share of each subcell that it fills, shape [m, a, b, c].
        weights: Number of test points that it holds of each cell, shape [m].
        sums: Sum of their positions [m], frame of the grid, shape [m, 3].
        whole: Number of test points in the shape, also of those that shapes before it have taken.
    """

    index: np.ndarray
    shares: np.ndarray
    weights: np.ndarray
    sums: np.ndarray
    whole: float


@dataclass(frozen=True)
class CellGrid:
    """Equal cells over some shapes, in the frame of the largest of them; the thinnest along an axis is so many across.

    Attributes:
        solids: Shapes posed in the frame of the grid; the first ``earlier`` of them only take place away.
        earlier: Shapes that the grid was not made for.
        lower: Lower corner [m], shape [3].
        sides: Sides of a cell [m], shape [3].
        counts: Cells along each axis, shape [3].
        splits: Test points across a cell along each axis, shape [3].
        position, rotation: Origin of the grid's frame in the body's [m], and rotation to it, shapes [3] and [3, 3].
    """

    solids: list[Solid]
    earlier: int
    lower: np.ndarray
    sides: np.ndarray
    counts: np.ndarray
    splits: np.ndarray
    position: np.ndarray
    rotation: np.ndarray

    def filled(self, k: int) -> Filled:
        """What shape ``k`` fills of the cells."""
        part = self.solids[k]
        others = [other for other in self.solids[:k] if boxes_meet(part, other)]
        pitch = np.abs(part.rotation).T @ (self.sides / self.splits)
        if (part.upper - part.lower < 2.0 * pitch).any():
            return self._filled_by_thin(part, others, pitch)
        index = self._cells_near(part)
        cells = self.lower + (index + 0.5) * self.sides
        offsets = ((grid(self.splits) + 0.5) / self.splits - 0.5) * self.sides
        hits, sums, whole = np.empty((len(cells), len(offsets)), bool), np.empty((len(cells), 3)), 0.0
        step = max(1, _CHUNK // len(offsets))
        for start in range(0, len(cells), step):
            chunk = cells[start : start + step]
            points = (chunk[:, None, :] + offsets).reshape(-1, 3)
            inside, free = _inside(part, others, points)
            whole += inside
            free = hits[start : start + step] = free.reshape(len(chunk), -1)
            sums[start : start + step] = free.sum(axis=1)[:, None] * chunk + free @ offsets
        held = hits.any(axis=1)
        weights = hits[held].sum(axis=1).astype(float)
        return Filled(index[held], hits[held].reshape(-1, *self.splits).astype(float), weights, sums[held], whole)

    def _cells_near(self, part: Solid) -> np.ndarray:
        """Places of the cells that the bounding box of a shape, which may be turned, reaches into, in order."""
        turn, extent = np.abs(part.rotation), part.upper - part.lower
        steps = (0.5 * self.sides[:, None] / np.maximum(turn, 1e-9)).min(axis=0)  # along each axis of the shape
        counts = np.ceil(extent / steps).astype(int)
        points = part.to_body(part.lower + (grid(counts) + 0.5) * (extent / counts))
        found = np.unique(np.floor((points - self.lower) / self.sides).astype(int), axis=0)
        found = np.unique((found[:, None] + grid(np.full(3, 3)) - 1).reshape(-1, 3), axis=0)
        found = found[((found >= 0) & (found < self.counts)).all(axis=1)]
        centre = (self.lower + (found + 0.5) * self.sides - part.position) @ part.rotation
        reach = 0.5 * (extent + self.sides @ turn) * (1.0 - 1e-9)
        return found[(np.abs(centre - 0.5 * (part.lower + part.upper)) < reach).all(axis=1)]

    def _filled_by_thin(self, part: Solid, others: list[Solid], pitch: np.ndarray) -> Filled:
        """The same of a shape that the grid's test points may miss, with test points of its own."""
        extent = part.upper - part.lower
        counts = np.maximum(np.ceil(extent / pitch).astype(int), _MOST_SPLITS)
        points = part.to_body(part.lower + (grid(counts) + 0.5) * (extent / counts))
        whole, free = _inside(part, others, points)
        points = points[free]
        places = (points - self.lower) / self.sides
        index = np.clip(places.astype(int), 0, self.counts - 1)
        index, cell = np.unique(index, axis=0, return_inverse=True)
        cell = cell.reshape(-1)
        at = np.clip(((places - index[cell]) * self.splits).astype(int), 0, self.splits - 1)
        subcell = np.ravel_multi_index(tuple(at.T), tuple(self.splits))
        size = int(self.splits.prod())
        hits = np.bincount(cell * size + subcell, minlength=len(index) * size).reshape(-1, *self.splits)
        sums = np.stack([np.bincount(cell, x, len(index)) for x in points.T], axis=1)
        share = part.volume / max(whole, 1) / (self.sides / self.splits).prod()
        weights = hits.sum(axis=(1, 2, 3)).astype(float)
        return Filled(index, hits * share, weights, sums, whole)


def cells_over(parts: Sequence[Solid], earlier: Sequence[Solid], spacing: float, across: int) -> CellGrid:
    """Cells over shapes of a body.

    Args:
        parts: The shapes, posed in the frame of the body.
        earlier: Shapes of the body whose place is taken.
        spacing: About the sides of the cells [m].
        across: Cells across a shape, at least; of several shapes as far as the cells do not get too flat.
    """
    home = max(parts, key=lambda part: part.volume)
    solids = [_seen_from(home, part) for part in (*earlier, *parts)]
    own = solids[len(earlier) :]
    half = np.array([np.abs(one.rotation) @ (0.5 * (one.upper - one.lower)) for one in own])
    middle = np.array([one.to_body(0.5 * (one.lower + one.upper)) for one in own])
    lower, upper = (middle - half).min(axis=0), (middle + half).max(axis=0)
    spacing = min(spacing, (upper - lower).max())  # cells that are larger yet have fewer test points in the shapes
    large = np.array([part.volume >= _SMALL * home.volume for part in parts])
    thinnest = np.where(large[:, None], half, np.inf).argmin(axis=0), np.arange(3)
    thin, face = 2.0 * half[thinnest], (middle - half)[thinnest]
    flattest = np.inf if len(parts) == 1 else _FLATTEST if across > 1 else 1.0
    fit = np.maximum(np.rint(thin / spacing), np.minimum(across, flattest * thin / spacing))
    sides = thin / np.where(fit < 1.0, fit, np.rint(fit))
    before = np.ceil((face - lower) / sides - 1e-6)
    counts = (before + np.ceil((upper - face) / sides - 1e-6)).astype(int)
    splits = np.maximum(np.ceil(_FINE_POINTS * sides / thin - 1e-6).astype(int), 1)
    splits = np.where(splits > 4, -(-splits // 8) * 8, 4)  # which demagnetizing tensors join to 8 and 4
    splits = splits if len(parts) == 1 else np.minimum(splits, _MOST_SPLITS)
    lower = face - before * sides
    return CellGrid(solids, len(earlier), lower, sides, counts, splits, home.position, home.rotation)


def _seen_from(home: Solid, part: Solid) -> Solid:
    """A shape in the frame of another of its body."""
    if part is home:
        return replace(part, position=np.zeros(3), rotation=np.eye(3))
    turn = home.rotation.T @ part.rotation
    return replace(part, position=(part.position - home.position) @ home.rotation, rotation=turn)


def _inside(part: Solid, others: list[Solid], points: np.ndarray) -> tuple[int, np.ndarray]:
    """How many points lie in a shape, and which of them in no other."""
    free = part.contains(points)
    inside = int(free.sum())
    for other in others:
        free[free] = ~other.contains(points[free])
    return inside, free
