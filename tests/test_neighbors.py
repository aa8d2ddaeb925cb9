"""Neighbor lists against a loop over all pairs."""

import numpy as np
import pytest
import warp as wp

from warpmag.kernels.pairs.neighbors import CAPACITY, SKIN
from warpmag.kernels.pairs.packing import PackedMoments
from warpmag.moments.arrays import vec3_type


def make(radii, device, dtype=wp.float32, groups=None):
    radii = wp.array(radii, dtype=dtype, device=device)
    return PackedMoments(radii, largest_radius=float(radii.numpy().max()), groups=groups)


def find(packed, positions):
    """Place moments at positions; return their lists and the lengths of the lists."""
    x = wp.array(positions, dtype=vec3_type(packed.dtype), device=packed.device)
    packed.pack(x, wp.zeros_like(x))
    packed.find_overlaps()
    return packed.neighbors.numpy(), packed.neighbor_counts.numpy()


def closeness(positions, radii, groups=None):
    """Distance over contact distance of all pairs; infinite for a moment and itself, and across groups."""
    d = np.linalg.norm(positions[:, None] - positions[None], axis=2) / (radii[:, None] + radii[None])
    np.fill_diagonal(d, np.inf)
    if groups is not None:
        d[groups[:, None] != groups[None]] = np.inf
    return d


def check(packed, near):
    """Lists contain all overlapping moments and none beyond the skin, in ascending order."""
    full = packed.neighbor_counts.numpy() > CAPACITY
    assert np.array_equal(packed.overlap_counts.numpy()[full], packed.neighbor_counts.numpy()[full])
    check_lists(packed.neighbors.numpy(), packed.neighbor_counts.numpy(), near, 1.0 + SKIN)
    check_lists(packed.overlaps.numpy()[~full], packed.overlap_counts.numpy()[~full], near[~full], 1.0)


def check_lists(lists, counts, near, reach):
    rounding = 1e-5  # of a distance of float32 positions a few hundred radii from the origin
    assert ((near < 1.0 - rounding).sum(1) <= counts).all() and (counts <= (near < reach + rounding).sum(1)).all()
    for i in np.flatnonzero(counts <= CAPACITY):
        listed = lists[i, : counts[i]]
        assert (np.diff(listed) > 0).all()
        assert (near[i, listed] < reach + rounding).all()
        assert np.isin(np.flatnonzero(near[i] < 1.0 - rounding), listed).all()


@pytest.mark.parametrize("dtype", [wp.float32, wp.float64])
@pytest.mark.parametrize("extent", [0.06, 0.03])
def test_balls_of_many_sizes_in_two_worlds(extent, dtype, device):
    rng = np.random.default_rng(0)
    positions = rng.uniform(-extent, extent, (600, 3)) + np.array([1.0, -2.0, 0.0])
    radii, groups = rng.choice([0.002, 0.004, 0.01], 600), np.repeat([0, 1], 300)
    packed = make(radii, device, dtype, groups)
    _, counts = find(packed, positions)
    assert (counts.max() > CAPACITY) == (extent < 0.05)
    check(packed, closeness(positions, radii, groups))


def test_lists_stay_complete_while_moments_move(device):
    rng = np.random.default_rng(1)
    radii = rng.uniform(0.5, 1.0, 200)
    positions = rng.uniform(0.0, 10.0, (200, 3))
    packed, stale = make(radii, device), 0
    for _ in range(40):
        before = packed.neighbors.numpy().copy()
        lists, counts = find(packed, positions)
        assert counts.max() <= CAPACITY
        stale += np.array_equal(before, lists)
        near = closeness(positions, radii)
        overlapping = near < 1.0 - 1e-5
        assert all(np.isin(np.flatnonzero(overlapping[i]), lists[i, : counts[i]]).all() for i in range(200))
        check_lists(packed.overlaps.numpy(), packed.overlap_counts.numpy(), near, 1.0)
        positions = positions + 0.024 * rng.normal(size=(200, 3))
    assert 10 < stale < 39  # lists are kept for several steps, but not for all


def test_moments_at_no_place_have_no_neighbors(device):
    positions = np.array([[0.0, 0, 0], [1.5, 0, 0], [np.nan, 0, 0], [1e30, 0, 0], [1e30, 0, 0], [np.inf, 0, 0]])
    packed = make(np.ones(6), device)
    for _ in range(2):
        lists, counts = find(packed, positions)
        assert counts.tolist() == [1, 1, 0, 0, 0, 0] and lists[0, 0] == 1 and lists[1, 0] == 0
    positions[2:] = [[0.0, 1.5, 0], [0, -1.5, 0], [0, 0, 1.5], [0, 0, -1.5]]
    lists, counts = find(packed, positions)
    assert counts[0] == 5 and lists[0, :5].tolist() == [1, 2, 3, 4, 5]


def test_other_moments(device):
    rng = np.random.default_rng(2)
    sources, targets = rng.uniform(0.0, 10.0, (100, 3)), rng.uniform(0.0, 10.0, (70, 3))
    at, of = make(np.full(70, 0.5), device), make(np.ones(100), device)
    for shift in (0.0, 3.0):
        find(of, sources + shift)
        x = wp.array(targets, dtype=wp.vec3, device=device)
        at.pack(x, wp.zeros_like(x))
        at.find_overlaps(of)
        near = np.linalg.norm(targets[:, None] - (sources + shift)[None], axis=2) / 1.5
        check(at, near)
