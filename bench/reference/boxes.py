"""Uniformly magnetized boxes that act on each other, in float64: what ``kernels/cells/cell_pairs.h`` computes.

The windows are those of ``warpmag.kernels.cells.cell_pairs``; all formulas are derived again.
"""

import itertools
import math
from typing import NamedTuple

import numpy as np

from bench.reference import oracle


class Windows(NamedTuple):
    """Distances at which pairs change, in means of their sizes: values of ``warpmag.kernels.cells.cell_pairs``."""

    all: tuple[float, float]  # of all boxes
    close: tuple[float, float]  # of boxes that are integrated over
    fine: tuple[float, float]  # of flat boxes that have fine points, in means of longest sides
    flat: float  # ratio of the two shortest sides of flat boxes


def field_tensor(r: np.ndarray, half: np.ndarray) -> np.ndarray:
    """Tensor K of the field H = K M of a box, shape [n, 3, 3].

    Args:
        r: Points from the center, in the frame of the box [m], shape [n, 3].
        half: Half sides [m], shape [3].
    """
    tensor = np.zeros((len(r), 3, 3))
    for signs in itertools.product((-1.0, 1.0), repeat=3):
        corner, sign = r - np.array(signs) * half, np.prod(signs)
        distance = np.linalg.norm(corner, axis=1)
        for k in range(3):
            a, b = corner[:, (k + 1) % 3], corner[:, (k + 2) % 3]
            tensor[:, k, k] += sign * np.arctan(a * b / (corner[:, k] * distance))
            across = -sign * np.arcsinh(corner[:, k] / np.hypot(a, b))
            tensor[:, (k + 1) % 3, (k + 2) % 3] += across
            tensor[:, (k + 2) % 3, (k + 1) % 3] += across
    return tensor / (4.0 * np.pi)


def mean_tensor(r, rotation, half, other_half, *, fine: bool = False) -> np.ndarray:
    """Field tensor of a box over its volume, averaged over Gauss points of another one [1/m³], shape [3, 3].

    There are two points along each axis; ``fine`` means two in each half of the longer axes. ``r`` is the position of
    the other box and ``rotation`` its rotation, both in the frame of the box.
    """
    nodes, _ = np.polynomial.legendre.leggauss(2)
    along = [np.append(nodes - 1.0, nodes + 1.0) / 2.0 if fine else nodes] * 3
    along[np.argmin(other_half)] = nodes
    places = np.array(list(itertools.product(*along))) * other_half
    return field_tensor(r + places @ rotation.T, half).mean(axis=0) / (8.0 * np.prod(half))


def quadrupole_tensor(r: np.ndarray, spread: np.ndarray) -> np.ndarray:
    """½ Σ S_cd ∂_a ∂_b ∂_c ∂_d of 1/(4πr) [1/m³], shape [3, 3], for the ``spread`` S [m²] of two boxes."""
    d, eye = np.linalg.norm(r), np.eye(3)
    fourth = 105.0 * np.einsum("a,b,c,d->abcd", r, r, r, r) / d**9
    for pair, rest in (("ab", "cd"), ("ac", "bd"), ("ad", "bc"), ("bc", "ad"), ("bd", "ac"), ("cd", "ab")):
        fourth -= 15.0 * np.einsum(f"{pair},{rest[0]},{rest[1]}->abcd", eye, r, r) / d**7
    for pair, rest in (("ab", "cd"), ("ac", "bd"), ("ad", "bc")):
        fourth += 3.0 * np.einsum(f"{pair},{rest}->abcd", eye, eye) / d**5
    return 0.5 * np.einsum("cd,abcd->ab", spread, fourth) / (4.0 * np.pi)


def fade(distance: float, window: tuple[float, float]) -> float:
    """Smooth step from 1 to 0."""
    t = np.clip((window[1] - distance) / (window[1] - window[0]), 0.0, 1.0)
    return float(t * t * (3.0 - 2.0 * t))


def blended_tensor(source, target, fine: float) -> np.ndarray:
    """Mean of the tensor over fine points, by the share ``fine``, and over 2³ points [1/m³], shape [3, 3]."""
    (x, turn, half), (y, other_turn, other_half) = source, target
    points = turn.T @ (y - x), turn.T @ other_turn, half, other_half
    return turn @ (fine * mean_tensor(*points, fine=True) + (1.0 - fine) * mean_tensor(*points)) @ turn.T


def is_flat(half, ratio: float) -> bool:
    """Return True if the shortest side of a box is shorter than the next one times ``ratio``."""
    least, middle, _ = np.sort(half)
    return bool(least < ratio * middle)


def pair_correction(a, b, windows: Windows) -> np.ndarray:
    """Tensor of two boxes less that of balls of their volumes [1/m³], shape [3, 3], for bodies of equal cells.

    Args:
        a, b: Boxes: position [m], rotation matrix, half sides [m].
        windows: Windows of the pairs.
    """
    (x, turn, half), (y, other_turn, other_half) = a, b
    r, d = x - y, np.linalg.norm(x - y)
    sizes = [2.0 * h.max() * np.sqrt(min(h.max() / h.min(), 3.0)) for h in (half, other_half)]
    radii = [np.cbrt(8.0 * h.prod() * 0.75 / np.pi) for h in (half, other_half)]
    distance = d / np.mean(sizes)
    if distance >= windows.all[1]:
        return np.zeros((3, 3))

    source, target = (b, a) if half.prod() <= other_half.prod() * 1.0005 else (a, b)
    sides = d / (half.max() + other_half.max())
    of_larger = blended_tensor(source, target, is_flat(target[2], windows.flat) * fade(sides, windows.fine))
    spread = turn @ np.diag(half**2 / 3.0) @ turn.T + other_turn @ np.diag(other_half**2 / 3.0) @ other_turn.T
    g1, g2, _ = oracle.radial_factors(np.array([d]), radii[0], radii[1])
    ball = (g1[0] * np.eye(3) + g2[0] * np.outer(r, r)) / (4.0 * np.pi)
    near = fade(distance, windows.close)
    tensor = near * (of_larger - ball) + (1.0 - near) * quadrupole_tensor(r, spread)
    return fade(distance, windows.all) * tensor


def overlap_share(a, b) -> float:
    """Share of the volume of box a inside box b, as ``box_overlap.h`` estimates it.

    It is the smaller one of the volumes that a box shares with the bounding box of the other one. Disjoint boxes have
    disjoint projections on an edge, or on a normal of two edges. So the least common part of the projections on
    normals, over that on edges, is a factor of at most 1.

    Args:
        a, b: Boxes: position [m], rotation matrix, half sides [m].
    """
    r = b[0] - a[0]

    def common(axis):
        """Length of the common part of the projections on an axis, and over the shorter projection."""
        own, other = (2.0 * np.abs(axis @ turn) @ half for _, turn, half in (a, b))
        length = max(min(0.5 * (own + other) - abs(axis @ r), own, other), 0.0)
        return length, length / min(own, other)

    volume = min(math.prod(common(axis)[0] for axis in turn.T) for _, turn, _ in (a, b))
    if volume == 0.0:
        return 0.0
    on_edges = min(common(axis)[1] for _, turn, _ in (a, b) for axis in turn.T)
    normals = [np.cross(axis, other) for axis in a[1].T for other in b[1].T]
    on_normals = min((common(normal)[1] for normal in normals if normal @ normal > 1e-4), default=1.0)
    return min(on_normals / on_edges, 1.0) * volume / (8.0 * a[2].prod())


def body_corrections(cells, bodies, windows: Windows, overlap_demagnetization: float, overlaps) -> np.ndarray:
    """Tensors between cells of different bodies [1/m³], shape [n, 3, n, 3]: H_i is the sum of T_ij m_j.

    Args:
        cells: Position [m], rotation matrix and half sides [m] of each cell.
        bodies: Body of each cell, shape [n].
        windows: As for :func:`pair_correction`.
        overlap_demagnetization: Demagnetizing factor added to a cell inside another body.
        overlaps: Shares of its volume from which a cell gets some and all of it.
    """
    n, tensors, overlap = len(cells), np.zeros((len(cells), 3, len(cells), 3)), np.zeros(len(cells))
    for i, j in itertools.combinations(range(n), 2):
        if bodies[i] != bodies[j]:
            tensors[i, :, j] = tensors[j, :, i] = pair_correction(cells[i], cells[j], windows)
            overlap[i] += overlap_share(cells[i], cells[j])
            overlap[j] += overlap_share(cells[j], cells[i])
    volumes = np.array([8.0 * half.prod() for _, _, half in cells])
    overlap_factor = overlap_demagnetization * np.interp(overlap, overlaps, (0.0, 1.0)) / volumes
    tensors[np.arange(n), :, np.arange(n)] -= overlap_factor[:, None, None] * np.eye(3)
    return tensors
