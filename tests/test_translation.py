"""Translations of multipoles to local expansions, against sums of matrix products in float64."""

from dataclasses import dataclass
from functools import cache
from itertools import product

import numpy as np
import pytest
import warp as wp
from dipole_expansions import dipole_to_multipole, local_to_field

from warpmag.kernels.fmm.translate import OCTANTS, Translation, _grouped_rows, _used_rows, displacements, pitch
from warpmag.moments import harmonics


@dataclass
class Boxes:
    """Boxes of several levels as the translation takes them, with their positions, components z, y, x."""

    begin: list
    places: list
    numbers: list
    neighbors: np.ndarray
    children: np.ndarray
    parent: np.ndarray
    order: np.ndarray
    octant_begin: np.ndarray


def make_boxes(side: int, levels: int, kept: float) -> Boxes:
    """Return a cube of boxes with a random part kept, and the parents of these boxes."""
    present = np.random.default_rng(11).random((side, side, side)) < kept
    begin, places, numbering = [0], [], []
    for _ in range(levels):
        place = np.argwhere(present)
        numbers = np.full(present.shape, -1)
        numbers[tuple(place.T)] = begin[-1] + np.arange(len(place))
        begin, places, numbering = [*begin, begin[-1] + len(place)], [*places, place], [*numbering, numbers]
        present = np.zeros([-(-n // 2) for n in present.shape], bool)
        present[tuple((place // 2).T)] = True
    box_count = begin[-1]
    neighbors, children = np.full((box_count, 27), -1, np.int32), np.full((box_count, 8), -1, np.int32)
    parent, order, octant_begin = np.full(box_count, -1, np.int32), [], []
    for level, place in enumerate(places):
        own = slice(begin[level], begin[level + 1])
        around = np.pad(numbering[level], 1, constant_values=-1)
        for k, offset in enumerate(product((0, 1, 2), repeat=3)):
            neighbors[own, k] = around[tuple((place + offset).T)]
        octant = place % 2 @ (4, 2, 1)
        if level + 1 < levels:
            parent[own] = numbering[level + 1][tuple((place // 2).T)]
            children[parent[own], octant] = np.arange(begin[level], begin[level + 1])
        counts = np.bincount(octant, minlength=OCTANTS)
        octant_begin.append(begin[level] + np.concatenate([[0], np.cumsum(counts)]))
        order.append(begin[level] + np.argsort(octant, kind="stable"))
    order, octant_begin = np.concatenate(order).astype(np.int32), np.array(octant_begin, np.int32)
    return Boxes(begin, places, numbering, neighbors, children, parent, order, octant_begin)


@cache
def matrices(degree: int) -> np.ndarray:
    return harmonics.multipole_to_local(degree, -displacements())


def translate(boxes: Boxes, multipoles, degree: int, dtype, device) -> np.ndarray:
    """Local expansions of the translation under test, shape [c, K]."""
    box_count, count = multipoles.shape
    padded = np.zeros((box_count + 1, pitch(count)))
    padded[:box_count, :count] = multipoles
    local = wp.full(padded.shape, np.nan, dtype=dtype, device=device)

    def integers(values):
        return wp.array(values, dtype=wp.int32, device=device)

    lists = boxes.neighbors, boxes.children, boxes.parent, boxes.order, boxes.octant_begin
    translation = Translation(matrices(degree), harmonics.parity(degree), dtype, device)
    parts = translation.parts(padded.shape)
    given = wp.array(padded, dtype=dtype, device=device)
    translation.launch(translation.bind(given, local, *map(integers, lists), parts=parts))
    return local.numpy()[:box_count, :count]


@cache
def table(degree: int, displacement: tuple) -> np.ndarray:
    return harmonics.multipole_to_local(degree, -np.array(displacement))


def reference(boxes: Boxes, multipoles, degree: int) -> np.ndarray:
    """The same from the definition: sources are not neighbors, but their parents are."""
    local = np.zeros_like(multipoles)
    for level in range(len(boxes.places) - 1):
        place, around = boxes.places[level], np.pad(boxes.numbers[level], 3, constant_values=-1)
        for offset in product(range(-3, 4), repeat=3):
            source = around[tuple((place + 3 + offset).T)]
            near = (np.abs((place + offset) // 2 - place // 2) <= 1).all(axis=1)
            target = np.flatnonzero(near & (source >= 0))
            if max(map(abs, offset)) < 2 or len(target) == 0:
                continue
            local[boxes.begin[level] + target] += multipoles[source[target]] @ table(degree, offset[::-1]).T
    return local


def random_multipoles(boxes: Boxes, degree: int) -> np.ndarray:
    values = np.random.default_rng(12).normal(size=(boxes.begin[-1], harmonics.count(degree)))
    return values * 0.8 ** harmonics.degrees(degree)  # like multipoles of moments in a box


@pytest.mark.parametrize(
    "dtype, degree, side, kept", [(wp.float32, 8, 7, 0.5), (wp.float32, 3, 13, 0.9), (wp.float64, 4, 8, 1.0)]
)
def test_translations_equal_sums_of_matrix_products(device, dtype, degree, side, kept):
    boxes = make_boxes(side, 3, kept)
    multipoles = random_multipoles(boxes, degree)
    result = translate(boxes, multipoles, degree, dtype, device)
    expected = reference(boxes, multipoles, degree)
    # sums of 189 K products with random errors
    epsilon = np.finfo(wp.dtype_to_numpy(dtype)).eps
    np.testing.assert_allclose(result, expected, rtol=0, atol=32 * epsilon * np.abs(expected).max())
    assert (result[boxes.begin[-2] :] == 0).all()  # boxes of the highest level have no far sources
    np.testing.assert_array_equal(result, translate(boxes, multipoles, degree, dtype, device))


@pytest.mark.parametrize("degree", [5, 8, 9, 14])
def test_threads_of_a_gpu_have_rows_of_one_parity_class(degree):
    classes = (harmonics.parity(degree) < 0).T @ [1, 2, 4]
    used = _used_rows(classes)
    groups = _grouped_rows(classes, 8, used).reshape(-1, 8)
    assert (groups[:, used:] == -1).all()
    assert sorted(groups[groups >= 0]) == list(range(harmonics.count(degree)))
    assert all(len(set(classes[group[group >= 0]])) == 1 for group in groups)
    assert (groups[:, 0] >= 0).all()  # defines the class of the group


@pytest.mark.cuda
@pytest.mark.parametrize("most_split", [0, 10**6])
def test_blocks_may_share_the_displacements(device, most_split, monkeypatch):
    """Blocks share displacements where boxes are few, and do not where boxes are many."""
    monkeypatch.setattr("warpmag.kernels.fmm.translate._MOST_SPLIT", most_split)
    boxes = make_boxes(9, 3, 0.7)
    multipoles = random_multipoles(boxes, 9)
    expected = reference(boxes, multipoles, 9)
    result = translate(boxes, multipoles, 9, wp.float32, device)
    np.testing.assert_allclose(result, expected, rtol=0, atol=4e-6 * np.abs(expected).max())


@pytest.mark.parametrize("aligned", [False, True])
def test_float32_keeps_its_digits_at_degree_15(device, aligned):
    """The far field of dipoles in float32 against float64: rounding on top of the truncation error."""
    rng, degree, each = np.random.default_rng(13), 15, 20
    boxes = make_boxes(4, 2, 1.0)
    box_count = boxes.begin[1]
    moments = np.array([0.0, 0.6, 0.8]) if aligned else rng.normal(size=(box_count, each, 3))
    moments = np.broadcast_to(moments, (box_count, each, 3))
    points = rng.uniform(-0.5, 0.5, (box_count, each, 3))
    multipoles = np.zeros((boxes.begin[-1], harmonics.count(degree)))
    multipoles[:box_count] = [dipole_to_multipole(degree, *pair) for pair in zip(points, moments, strict=True)]
    fields = [
        np.array([local_to_field(local, at) for local, at in zip(result[:box_count], points, strict=True)])
        for result in (translate(boxes, multipoles, degree, dtype, device) for dtype in (wp.float32, wp.float64))
    ]
    assert np.linalg.norm(fields[0] - fields[1]) < 2e-6 * np.linalg.norm(fields[1])
