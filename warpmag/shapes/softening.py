"""Softer operator of a lone body's cells: the mean of two, one of which is too stiff and one too soft.

Cells of uniform magnetization have charges on the faces between them wherever the magnetization varies. In iron there
are almost none, because its flux is continuous. So the operator N of the cells is too stiff: a magnet pulls a plate
with 5 to 15 % too little force. Let A average the magnetization of each cell with both neighbors along its own
direction, by ¼, ½ and ¼. AᵀNA has hardly any charges between cells, and is too soft: fields that vary from cell to
cell magnetize too much. The mean of both is right to a few percent for plates of 1 to 10 mm below a magnet.

The mean is symmetric and positive like N. That holds for a lone body only: fields between two bodies are those of
uniform cells. With softer bodies they would make eigenvalues negative where faces touch.
"""

from dataclasses import dataclass, replace

import numpy as np

from warpmag.shapes.demagnetization import COMPONENTS, Coupling, rotated
from warpmag.shapes.lattice import Lattice, Pieces
from warpmag.shapes.uniform_response import LINEAR_FIELD_CELLS, MOST_MOMENTS, pair_factors

_SHARE = 0.5
"""Share of AᵀNA in the operator."""
_EXCHANGE = 0.25
"""Weight of each neighbor in the average."""


@dataclass(frozen=True)
class _Average:
    """Average of each moment and its neighbors along one axis, symmetric if scaled by the roots of volumes."""

    own: np.ndarray  # weight of the moment itself, shape [n]
    neighbors: np.ndarray  # neighbors of each moment, shape [most, n]
    weights: np.ndarray  # their weights, 0 after the last one, shape [most, n]

    def __call__(self, rows: np.ndarray) -> np.ndarray:
        """Return the averages of rows, shape [n, m]."""
        result = self.own[:, None] * rows
        for neighbor, weight in zip(self.neighbors, self.weights, strict=True):
            result += weight[:, None] * rows[neighbor]
        return result


def softened(coupling: Coupling, lattice: Lattice) -> Coupling:
    """Return the coupling of a lone body with the mean operator, for bodies of 65 to 6200 cells.

    The tensors of other pairs than those of the coupling's list are not changed.
    """
    if not LINEAR_FIELD_CELLS[0] <= len(coupling.radii) <= MOST_MOMENTS:
        return coupling
    (part,) = lattice.pieces  # the shapes of an inducible body share a grid
    x, root, isotropic, dipolar, unit = pair_factors(coupling, lattice)
    x, tensors = x @ part.rotation, rotated(coupling.tensor, part.rotation.T) * unit**3
    row, averages = np.repeat(np.arange(len(x)), np.diff(coupling.start)), _averages(part, len(x))
    change = np.empty_like(tensors)
    for c, (k, j) in enumerate(zip(*COMPONENTS, strict=True)):
        block = dipolar * (x[:, None, k] - x[:, k]) * (x[:, None, j] - x[:, j]) + (isotropic if k == j else 0.0)
        block /= 4.0 * np.pi
        block[row, coupling.other] += tensors[:, c]
        block *= root[:, None] * root
        softer = averages[j](averages[k](block).T)
        softer = 0.5 * (softer + softer.T)  # at edges the tensor of a pair would not be symmetric
        change[:, c] = _SHARE * (softer - block)[row, coupling.other] / (root[row] * root[coupling.other])
    return replace(coupling, tensor=coupling.tensor + rotated(change, part.rotation) / unit**3)


def _averages(part: Pieces, count: int) -> list[_Average]:
    """Return the averages along the axes of the grid.

    Neighbors exchange equal volumes, so that a body keeps its moment, and uniform magnetization stays uniform.
    """
    filled = part.filled.mean(axis=(1, 2, 3))
    volumes = np.bincount(part.moment, part.share * filled[part.piece], count)
    order = np.argsort(part.piece, kind="stable")  # entries by piece
    first_entry = np.searchsorted(part.piece[order], np.arange(len(part.index) + 1))
    averages = []
    for axis in range(3):
        p, q = _adjacent(part.index, axis)
        pair, a = _expanded(p, first_entry)
        again, b = _expanded(q[pair], first_entry)
        pair, a, b = pair[again], order[a[again]], order[b]
        exchanged = _EXCHANGE * part.share[a] * part.share[b] * np.minimum(filled[p[pair]], filled[q[pair]])
        i, j = part.moment[a], part.moment[b]
        averages.append(_average(np.append(i, j), np.append(j, i), np.append(exchanged, exchanged), volumes))
    return averages


def _adjacent(index: np.ndarray, axis: int) -> tuple[np.ndarray, np.ndarray]:
    """Return all pairs of pieces whose cells follow each other along an axis."""
    index = index - index.min(axis=0)
    shape, step = index.max(axis=0) + 2, np.eye(3, dtype=int)[axis]
    cell, beyond = (np.asarray(np.ravel_multi_index(tuple(at.T), shape)) for at in (index, index + step))
    order = np.argsort(cell, kind="stable")
    first, last = (np.searchsorted(cell[order], beyond, side) for side in ("left", "right"))
    count = last - first
    p = np.repeat(np.arange(len(index)), count)
    return p, order[first[p] + np.arange(len(p)) - np.repeat(np.cumsum(count) - count, count)]


def _expanded(pieces: np.ndarray, first_entry: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return each entry of each of the pieces: the position in ``pieces``, and the index of the entry."""
    count = first_entry[pieces + 1] - first_entry[pieces]
    position = np.repeat(np.arange(len(pieces)), count)
    rank = np.arange(len(position)) - np.repeat(np.cumsum(count) - count, count)
    return position, first_entry[pieces[position]] + rank


def _average(i: np.ndarray, j: np.ndarray, exchanged: np.ndarray, volumes: np.ndarray) -> _Average:
    """Return the average in which moments i and j exchange volumes; each pair is given in both orders."""
    n, distinct = len(volumes), i != j
    key, inverse = np.unique(i[distinct] * n + j[distinct], return_inverse=True)
    exchanged, i, j = np.bincount(inverse.reshape(-1), exchanged[distinct], len(key)), key // n, key % n
    own = 1.0 - np.bincount(i, exchanged, n) / volumes
    rank = np.arange(len(i)) - np.searchsorted(i, np.arange(n))[i]
    neighbors = np.zeros((rank.max(initial=-1) + 1, n), int)
    weights = np.zeros(neighbors.shape)
    neighbors[rank, i], weights[rank, i] = j, exchanged / np.sqrt(volumes[i] * volumes[j])
    return _Average(own, neighbors, weights)
