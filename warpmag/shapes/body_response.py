"""The field of a body's own moments, and the update of all its cells together by the inverse of its operator.

An induction solve compares the reduced field g = k H/M_s of each moment with its dual variable s
(``kernels/induction``). A lone body of χ = ∞, far from saturation, is solved by s + Q (g − s) with Q = (1 − 3 T V)⁻¹.
Here 3 is the initial slope k of a ball, T are the tensors between the body's cells, and V their volumes. Among other
bodies, Q removes the slow modes of the body itself from the iteration.

T excludes the field of a cell in its own ball. :data:`_SHIFT` is added to the eigenvalues before the inversion.

**Mirrors.** Let the cells of a body be symmetric with respect to q planes through its center, each normal to an axis.
Then the operator acts separately on magnetizations of each of 2^q parities p. A parity is one sign for each mirror: the
mirror leaves the magnetization unchanged, or reverses it. A mirror reverses the component along its normal. The cells
that mirrors map to each other are an orbit. The values at one cell of each orbit determine a magnetization of parity p.
So 2^q matrices between orbits replace the matrix between cells. If no cell lies on a plane, they have 1/2^q of its
elements.

The field T m of the body's own moments m is computed with such matrices, too, where they are small enough.
"""

from typing import NamedTuple

import numpy as np
from scipy.spatial import KDTree

from warpmag.shapes.demagnetization import Coupling
from warpmag.shapes.lattice import Lattice
from warpmag.shapes.uniform_response import cell_matrix

MOST_CELLS = 1000
"""Largest number of cells of a body with a response: a matrix of 9 million elements before the inversion."""
_SLOPE = 3.0
"""Initial slope k = 3χ/(3 + χ) of a ball of χ = ∞."""
_SHIFT = 0.01
"""Number added to all eigenvalues before the inversion, because the eigenvalues of sheets and of loops of magnetization
are below 0.001. With 0.03 a lone plate of χ = ∞ takes 1.5 times as many evaluations. With 0.001 a plate of χ = 300
takes 1.3 times as many."""
_POWERS = 30
"""Number of steps of the power method; the largest eigenvalue then has an error of a few percent."""
_SYMMETRIC, _SYMMETRIC_FIELD = 1e-3, 1e-6
"""Tolerances of a symmetry, for the response and for the field. They bound three changes by a mirror: of positions, in
radii, and the relative changes of radii and of the operator times a random vector. Solves converge to the same solution
with any response."""
_MOST_ENTRIES = 5.0, 400_000
"""Most elements of the tables of a field: per pair of cells, or in all. More take longer than sums over pairs."""


class BodyResponse(NamedTuple):
    """Q − 1 of a body, by parity."""

    cells: int  # number of cells
    mirrors: int  # bits 0, 1, 2: the body has a mirror plane normal to x, y, z
    images: np.ndarray  # row k: images of the first cells of orbits by the mirrors in the bits of k, shape [8, orbits]
    tables: np.ndarray  # Q − 1 between orbits, shape [parities, orbits, 3, orbits, 3]; upper 16 bits of float32
    largest: float  # largest eigenvalue


class OwnField(NamedTuple):
    """Field of a body's moments, by parity."""

    cells: int
    mirrors: int  # as in :class:`BodyResponse`
    images: np.ndarray  # as in :class:`BodyResponse`
    tables: np.ndarray  # T [1/m³] between orbits, shape [parities, orbits, 3, orbits, 3]


def own_field(coupling: Coupling) -> OwnField | None:
    """Return the tensors between the cells of a body, in its frame, or None if the tables are too large."""
    operator, root = _interactions(coupling)
    mirrors, images = _images(operator, coupling, _SYMMETRIC_FIELD)
    entries, count = 2 ** mirrors.bit_count() * 9 * images.shape[1] ** 2, len(root)
    if entries > max(_MOST_ENTRIES[0] * count**2, _MOST_ENTRIES[1]):
        return None
    scale = np.repeat(root[images[0]], 3)
    folded = [_folded(operator, images, mirrors, parity)[0] for parity in _within(mirrors)]
    tables = np.stack([-table / (scale[:, None] * scale) for table in folded])
    return OwnField(count, mirrors, images, tables.reshape(len(tables), *(images.shape[1], 3) * 2))


def residual_response(coupling: Coupling) -> BodyResponse:
    """Return Q − 1 between the cells of a body, in its frame.

    The elements are the upper 16 bits of float32, rounded to nearest, type uint16. The parities are the subsets of the
    bits of ``mirrors``, ascending. Only these rows of ``images`` are used.
    """
    interactions, root = _interactions(coupling)
    count = len(root)
    unit = np.eye(3 * count)
    operator = (unit + _SLOPE * interactions.reshape(unit.shape) + _SHIFT * unit).reshape(interactions.shape)
    mirrors, images = _images(operator, coupling, _SYMMETRIC)
    scale = np.repeat(root[images[0]], 3)
    tables, largest = [], 0.0
    for parity in _within(mirrors):
        folded, absent = _folded(operator, images, mirrors, parity)
        change = np.linalg.inv(folded + np.diag(absent)) - np.eye(len(folded))
        largest = max(largest, _largest_eigenvalue(change))
        response = (change * scale / scale[:, None]).astype(np.float32)
        bits = response.view(np.uint32).reshape(len(images[0]), 3, len(images[0]), 3)
        tables.append(((bits + 0x7FFF + (bits >> 16 & 1)) >> 16).astype(np.uint16))
    return BodyResponse(count, mirrors, images, np.stack(tables), largest)


def _interactions(coupling: Coupling) -> tuple[np.ndarray, np.ndarray]:
    """Return −T between cells, symmetrized by their volumes, shape [n, 3, n, 3], and the roots of the volumes."""
    volumes = 4.0 / 3.0 * np.pi * coupling.radii**3
    root, count = np.sqrt(volumes), len(volumes)
    cells = cell_matrix(coupling, Lattice(coupling.positions, volumes, np.zeros(count, int)))
    shared = root[:, None, None, None] * coupling.common[:, None] * root[:, None]
    own = np.eye(3 * count).reshape(shared.shape) / 3.0
    return cells.reshape(shared.shape) - shared - own, root


def _within(mirrors: int) -> list[int]:
    """Return the subsets of the bits of ``mirrors``, ascending."""
    return [number for number in range(8) if number & ~mirrors == 0]


def _images(operator: np.ndarray, coupling: Coupling, tolerance: float) -> tuple[int, np.ndarray]:
    """Return the mirrors of a body, and the images of the first cell of each orbit, shape [8, orbits].

    ``operator`` has the shape [n, 3, n, 3].
    """
    radii, place = coupling.radii, coupling.positions - 0.5 * (coupling.positions.min(0) + coupling.positions.max(0))
    tree, count, mirrors = KDTree(place), len(radii), 0
    images = np.tile(np.arange(count), (8, 1))  # of all cells
    vector = np.random.default_rng(0).normal(size=(count, 3))

    def product(vector):
        return (operator.reshape(3 * count, -1) @ vector.ravel()).reshape(-1, 3)

    whole = product(vector)
    for axis in range(3):
        signs = np.where(np.arange(3) == axis, -1.0, 1.0)
        distance, image = map(np.asarray, tree.query(place * signs))
        if distance.max() > tolerance * radii.min() or not np.allclose(radii[image], radii, rtol=tolerance):
            continue
        change = product(vector[image] * signs) - whole[image] * signs
        if np.linalg.norm(change) <= tolerance * np.linalg.norm(whole):
            mirrors |= 1 << axis
            for mirror in [number for number in range(8) if number >> axis & 1]:
                images[mirror] = image[images[mirror ^ 1 << axis]]
    return mirrors, images[:, images.min(axis=0) == np.arange(count)]


def _signs(mirror: int, mirrors: int, parity: int) -> np.ndarray:
    """Return the signs of the components x, y and z of a parity at the image of a cell by the mirrors in ``mirror``."""
    return np.array([(-1.0) ** (mirror & (parity ^ (1 << axis & mirrors))).bit_count() for axis in range(3)])


def _folded(operator: np.ndarray, images: np.ndarray, mirrors: int, parity: int) -> tuple[np.ndarray, np.ndarray]:
    """Return the operator between magnetizations of a parity in the first cells of orbits, shape [3 orbits, 3 orbits].

    Also return 1 for components that are 0 in magnetizations of the parity, in cells on mirror planes, shape
    [3 orbits]. Their rows and columns are 0.
    """
    used = _within(mirrors)
    rows, total = operator[images[0]], np.zeros((len(images[0]), 3, len(images[0]), 3))
    absent = np.zeros((len(images[0]), 3), bool)
    for mirror in used:
        signs = _signs(mirror, mirrors, parity)
        total += rows[:, :, images[mirror]] * signs
        absent |= (images[mirror] == images[0])[:, None] & (signs < 0.0)
    distinct = np.array([len(set(orbit)) for orbit in images[used].T])  # cells on a mirror plane are their own images
    folded = (total * (distinct / len(used))[:, None]).reshape(absent.size, absent.size)
    absent = absent.ravel()
    folded[absent], folded[:, absent] = 0.0, 0.0
    return folded, absent.astype(float)


def _largest_eigenvalue(matrix: np.ndarray) -> float:
    """Return the largest eigenvalue of a matrix that is similar to a symmetric one, by the power method."""
    vector, norm = np.random.default_rng(0).normal(size=len(matrix)), 0.0
    for _ in range(_POWERS):
        vector = matrix @ vector
        norm = float(np.linalg.norm(vector))
        if norm == 0.0:  # no cell has a component of the parity
            break
        vector /= norm
    return norm
