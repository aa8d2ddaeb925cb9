"""Translations of multipoles to local expansions on grids of cells, against sums of matrix products in float64."""

from dataclasses import dataclass
from functools import cache
from itertools import product

import numpy as np
import pytest
import warp as wp

from warpmag.kernels.fmm.translate import OCTANTS, Translation, _grouped_rows, _used_rows, displacements, pitch
from warpmag.moments import harmonics


@dataclass
class Grid:
    """Levels of cells as the translation takes them, and their places, components z, y, x."""

    begin: list
    places: list
    found: list
    neighbors: np.ndarray
    children: np.ndarray
    parent: np.ndarray
    order: np.ndarray
    octant_begin: np.ndarray


def make_grid(side: int, levels: int, kept: float) -> Grid:
    """A cube of cells, of which a part is kept, and their parents."""
    present = np.random.default_rng(11).random((side, side, side)) < kept
    begin, places, found = [0], [], []
    for _ in range(levels):
        place = np.argwhere(present)
        numbers = np.full(present.shape, -1)
        numbers[tuple(place.T)] = begin[-1] + np.arange(len(place))
        begin, places, found = [*begin, begin[-1] + len(place)], [*places, place], [*found, numbers]
        present = np.zeros([-(-n // 2) for n in present.shape], bool)
        present[tuple((place // 2).T)] = True
    cells = begin[-1]
    neighbors, children = np.full((cells, 27), -1, np.int32), np.full((cells, 8), -1, np.int32)
    parent, order, octant_begin = np.full(cells, -1, np.int32), [], []
    for level, place in enumerate(places):
        own = slice(begin[level], begin[level + 1])
        around = np.pad(found[level], 1, constant_values=-1)
        for k, offset in enumerate(product((0, 1, 2), repeat=3)):
            neighbors[own, k] = around[tuple((place + offset).T)]
        octant = place % 2 @ (4, 2, 1)
        if level + 1 < levels:
            parent[own] = found[level + 1][tuple((place // 2).T)]
            children[parent[own], octant] = np.arange(begin[level], begin[level + 1])
        counts = np.bincount(octant, minlength=OCTANTS)
        octant_begin.append(begin[level] + np.concatenate([[0], np.cumsum(counts)]))
        order.append(begin[level] + np.argsort(octant, kind="stable"))
    order, octant_begin = np.concatenate(order).astype(np.int32), np.array(octant_begin, np.int32)
    return Grid(begin, places, found, neighbors, children, parent, order, octant_begin)


@cache
def matrices(degree: int) -> np.ndarray:
    return harmonics.multipole_to_local(degree, -displacements())


def translate(grid: Grid, multipoles, degree: int, dtype, device) -> np.ndarray:
    """Local expansions of the translation under test, shape [c, K]."""
    cells, count = multipoles.shape
    padded = np.zeros((cells + 1, pitch(count)))
    padded[:cells, :count] = multipoles
    local = wp.full(padded.shape, np.nan, dtype=dtype, device=device)

    def integers(values):
        return wp.array(values, dtype=wp.int32, device=device)

    lists = grid.neighbors, grid.children, grid.parent, grid.order, grid.octant_begin
    translation = Translation(matrices(degree), harmonics.parity(degree), dtype, device)
    parts = translation.parts(padded.shape)
    given = wp.array(padded, dtype=dtype, device=device)
    translation.launch(translation.bind(given, local, *map(integers, lists), parts=parts))
    return local.numpy()[:cells, :count]


@cache
def table(degree: int, displacement: tuple) -> np.ndarray:
    return harmonics.multipole_to_local(degree, -np.array(displacement))


def reference(grid: Grid, multipoles, degree: int) -> np.ndarray:
    """The same from the definition: cells that are not neighbours, but whose parents are."""
    local = np.zeros_like(multipoles)
    for level in range(len(grid.places) - 1):
        place, around = grid.places[level], np.pad(grid.found[level], 3, constant_values=-1)
        for offset in product(range(-3, 4), repeat=3):
            source = around[tuple((place + 3 + offset).T)]
            near = (np.abs((place + offset) // 2 - place // 2) <= 1).all(axis=1)
            target = np.flatnonzero(near & (source >= 0))
            if max(map(abs, offset)) < 2 or len(target) == 0:
                continue
            local[grid.begin[level] + target] += multipoles[source[target]] @ table(degree, offset[::-1]).T
    return local


def random_multipoles(grid: Grid, degree: int) -> np.ndarray:
    values = np.random.default_rng(12).normal(size=(grid.begin[-1], harmonics.count(degree)))
    return values * 0.8 ** harmonics.degrees(degree)  # as those of moments in a cell


@pytest.mark.parametrize(
    "dtype, degree, side, kept", [(wp.float32, 8, 7, 0.5), (wp.float32, 3, 13, 0.9), (wp.float64, 4, 8, 1.0)]
)
def test_every_cell_takes_what_its_parent_does_not_have(device, dtype, degree, side, kept):
    grid = make_grid(side, 3, kept)
    multipoles = random_multipoles(grid, degree)
    found = translate(grid, multipoles, degree, dtype, device)
    wanted = reference(grid, multipoles, degree)
    # of sums over 189 K products, whose errors are random
    epsilon = np.finfo(wp.dtype_to_numpy(dtype)).eps
    np.testing.assert_allclose(found, wanted, rtol=0, atol=32 * epsilon * np.abs(wanted).max())
    assert (found[grid.begin[-2] :] == 0).all()  # nothing is far from the cells of the highest level
    np.testing.assert_array_equal(found, translate(grid, multipoles, degree, dtype, device))


@pytest.mark.parametrize("degree", [5, 8, 9, 14])
def test_threads_of_a_gpu_have_rows_of_one_class(degree):
    classes = (harmonics.parity(degree) < 0).T @ [1, 2, 4]
    used = _used_rows(classes)
    groups = _grouped_rows(classes, 8, used).reshape(-1, 8)
    assert (groups[:, used:] == -1).all()
    assert sorted(groups[groups >= 0]) == list(range(harmonics.count(degree)))
    assert all(len(set(classes[group[group >= 0]])) == 1 for group in groups)
    assert (groups[:, 0] >= 0).all()  # whose class the group has


@pytest.mark.cuda
@pytest.mark.parametrize("most_split", [0, 10**6])
def test_blocks_may_share_the_displacements(device, most_split, monkeypatch):
    """Those of many cells do not, and those of few."""
    monkeypatch.setattr("warpmag.kernels.fmm.translate._MOST_SPLIT", most_split)
    grid = make_grid(9, 3, 0.7)
    multipoles = random_multipoles(grid, 9)
    wanted = reference(grid, multipoles, 9)
    found = translate(grid, multipoles, 9, wp.float32, device)
    np.testing.assert_allclose(found, wanted, rtol=0, atol=4e-6 * np.abs(wanted).max())


@pytest.mark.parametrize("aligned", [False, True])
def test_float32_keeps_its_digits_at_degree_15(device, aligned):
    """The far field of dipoles in float32 against the same in float64: what rounding adds to the series' error."""
    rng, degree, each = np.random.default_rng(13), 15, 20
    grid = make_grid(4, 2, 1.0)
    cells = grid.begin[1]
    moments = np.array([0.0, 0.6, 0.8]) if aligned else rng.normal(size=(cells, each, 3))
    moments = np.broadcast_to(moments, (cells, each, 3))
    points = rng.uniform(-0.5, 0.5, (cells, each, 3))
    multipoles = np.zeros((grid.begin[-1], harmonics.count(degree)))
    multipoles[:cells] = [harmonics.dipole_to_multipole(degree, *one) for one in zip(points, moments, strict=True)]
    fields = [
        np.array([harmonics.local_to_field(local, at) for local, at in zip(found[:cells], points, strict=True)])
        for found in (translate(grid, multipoles, degree, dtype, device) for dtype in (wp.float32, wp.float64))
    ]
    assert np.linalg.norm(fields[0] - fields[1]) < 2e-6 * np.linalg.norm(fields[1])
