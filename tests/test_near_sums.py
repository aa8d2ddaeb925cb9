"""Sums over pairs in neighboring leaves, against the float64 oracle."""

from typing import Any

import numpy as np
import pytest
import warp as wp

from bench.reference import oracle
from warpmag.kernels.fmm.near import launch_near_sums
from warpmag.kernels.pairs.pair_law import WIDTHS, Quantity

PITCH = 128


def make_leaves(counts, radius, seed=21):
    """Moments of a grid of leaves with edges of length 1, sorted by leaf; empty leaves do not exist.

    Args:
        counts: Number of moments in each leaf, shape [z, y, x].
        radius: Their radius.
        seed: Of random numbers.

    Returns:
        Positions and moments [n, 3], radii [n], places of leaves [c, 3] (x, y, z), neighbors [c, 27], first moments.
    """
    rng = np.random.default_rng(seed)
    filled = np.argwhere(counts > 0)
    numbers = np.full(np.array(counts.shape) + 2, -1)
    numbers[tuple((filled + 1).T)] = np.arange(len(filled))
    offsets = np.array([(k // 9, k // 3 % 3, k % 3) for k in range(27)])
    neighbors = np.stack([numbers[tuple((filled + offset).T)] for offset in offsets], axis=1)
    sizes = counts[tuple(filled.T)]
    begin = np.concatenate([[0], np.cumsum(sizes)])
    n = begin[-1]
    places = filled[:, ::-1]
    positions = np.repeat(places, sizes, axis=0) + rng.uniform(size=(n, 3))
    return positions, rng.normal(size=(n, 3)), np.full(n, radius), places, neighbors, begin


def launch(quantity, leaves, labels, dtype, device):
    positions, moments, radii, _, neighbors, begin = leaves
    n = len(positions)
    columns = (1 + -(-n // PITCH)) * PITCH
    packed = np.zeros((8, columns))
    packed[:3, :n], packed[3], packed[4:7, :n], packed[7] = positions.T, radii[0], moments.T, -1
    packed[3, :n], packed[7, :n] = radii, labels
    rows: Any = wp.array(packed, dtype=dtype, device=device)[:, :n]

    def integers(values):
        return wp.array(np.ascontiguousarray(values), dtype=wp.int32, device=device)

    capacity = len(begin) + 3  # three unused leaves
    begins = np.pad(begin, (0, capacity - len(begin)), constant_values=n)
    sums = wp.full((n, WIDTHS[quantity]), np.nan, dtype=dtype, device=device)
    level_begin = integers([0, len(neighbors), len(neighbors)])
    launch_near_sums(quantity, rows, rows[4:7], integers(neighbors), integers(begins), level_begin, sums)
    return sums.numpy()


def are_near(leaves) -> np.ndarray:
    """True where the leaves of two moments are neighbors, shape [n, n]."""
    _, _, _, places, _, begin = leaves
    own = np.repeat(places, np.diff(begin), axis=0)
    return np.all(np.abs(own[:, None] - own[None]) <= 1, axis=2)


def wanted_sums(leaves, labels):
    """4π (m·∇)H and 4π H at each moment from near moments of other bodies, and 4π H from all other near moments."""
    positions, moments, radii = leaves[:3]
    r = positions[:, None] - positions[None]
    d = np.maximum(np.linalg.norm(r, axis=2), radii[:, None] + radii[None])[..., None]
    m, b = moments[:, None], moments[None]
    rb, rm, mb = ((p * q).sum(axis=2, keepdims=True) for p, q in ((r, b), (r, m), (m, b)))
    others = ~np.eye(len(positions), dtype=bool)
    with np.errstate(all="ignore"):
        field = 3 * rb * r / d**5 - b / d**3
        force = 3 / d**5 * (rb * m + rm * b + (mb - 5 * rb * rm / d**2) * r)
    near = are_near(leaves)
    apart = near & (labels[:, None] != labels[None])
    return [
        np.where(pairs[..., None], terms, 0).sum(axis=1)
        for terms, pairs in ((force, apart), (field, apart), (field, near & others))
    ]


def uneven_counts():
    """Leaves of 0, 1, 7, 20, 33, 57, 64, 65, 97, 128 and 150 moments."""
    counts = np.array([57, 0, 20, 7, 33, 64, 0, 65, 1, 97, 128, 0, 5, 150, 31, 16, 0, 40, 9, 57, 2, 0, 12, 30])
    return counts.reshape(2, 3, 4)


@pytest.mark.parametrize("quantity, dtype", [(Quantity.FIELD, wp.float32), (Quantity.FORCE, wp.float32),
                                             (Quantity.WRENCH, wp.float64)])  # fmt: skip
def test_sums_over_pairs_in_neighboring_leaves(device, quantity, dtype):
    leaves = make_leaves(uneven_counts(), 0.02)
    n = len(leaves[0])
    labels = np.arange(n) if quantity == Quantity.FIELD else np.arange(n) // 3 * 3  # bodies of three moments
    sums = launch(quantity, leaves, labels, dtype, device)
    force, field, of_all = wanted_sums(leaves, labels)
    expected = {Quantity.FIELD: of_all, Quantity.FORCE: force, Quantity.WRENCH: np.hstack([force, field])}[quantity]
    epsilon = np.finfo(wp.dtype_to_numpy(dtype)).eps
    # sums of hundreds of terms; separations at contact lose digits, since positions are up to 100 contact distances
    # from the origin
    np.testing.assert_allclose(sums, expected, rtol=1e3 * epsilon, atol=1e3 * epsilon * np.abs(expected).max())
    np.testing.assert_array_equal(sums, launch(quantity, leaves, labels, dtype, device))


def test_points_in_two_cells_a_side_are_all_near(device):
    """In a grid of two leaves a side all leaves are neighbors: the sums are over all pairs."""
    leaves = make_leaves(np.full((2, 2, 2), 20), 0.0)
    positions, moments = leaves[:2]
    sums = launch(Quantity.FIELD, leaves, np.arange(len(positions)), wp.float32, device)
    expected = 4 * np.pi * oracle.h_field(positions, moments)
    # separations of the nearest pairs lose digits
    np.testing.assert_allclose(sums, expected, rtol=0, atol=2e-5 * np.abs(expected).max())


def test_a_cell_of_many_moments_is_summed_in_parts(device):
    counts = np.array([[[650, 3, 700]]])
    leaves = make_leaves(counts, 0.01)
    labels = np.arange(len(leaves[0]))
    sums = launch(Quantity.FIELD, leaves, labels, wp.float32, device)
    field = wanted_sums(leaves, labels)[2]
    np.testing.assert_allclose(sums, field, rtol=0, atol=2e-5 * np.abs(field).max())
