"""Letters as solids: outlines with holes, closed meshes, boxes along the strokes."""

import itertools
import string

import numpy as np
import pytest

from warpmag.errors import InputError
from warpmag.scenes_usd import lettering
from warpmag.shapes import lattice
from warpmag.show.meshes import corner_normals

pytest.importorskip("matplotlib")


def corners_of(box):
    offsets = box.half * np.array([(-1.0, -1.0), (1.0, -1.0), (1.0, 1.0), (-1.0, 1.0)])
    cos, sin = np.cos(box.angle), np.sin(box.angle)
    return box.center + offsets @ np.array([[cos, sin], [-sin, cos]])


def test_outlines_are_the_fonts():
    """In font units, 2048 to the em: capitals 1493 high, the stem and the foot of the L 385 and 291 wide."""
    (curve,) = lettering.outline("L")
    whole = 1493.0 * curve
    np.testing.assert_allclose(np.ptp(whole, axis=0), (1061.0, 1493.0), atol=1e-9)
    assert sorted({round(x - whole[:, 0].min()) for x in whole[:, 0]}) == [0, 385, 1061]
    assert sorted({round(y - whole[:, 1].min()) for y in whole[:, 1]}) == [0, 291, 1493]
    np.testing.assert_allclose(curve.min(axis=0) + curve.max(axis=0), 0.0, atol=1e-12)


def test_holes_turn_the_other_way():
    holes = {letter: len(lettering.outline(letter)) - 1 for letter in string.ascii_uppercase}
    assert {letter for letter, count in holes.items() if count} == set("ABDOPQR") and holes["B"] == 2
    signs = [np.sign(lettering.area([curve])) for curve in lettering.outline("B")]
    assert sorted(signs) == [-1.0, -1.0, 1.0]


@pytest.mark.parametrize("letter", string.ascii_uppercase)
def test_triangles_fill_the_outline_once(letter):
    curves = lettering.outline(letter)
    corners = np.concatenate(curves)[lettering.triangles(curves)]
    ab, ac = corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0]
    areas = 0.5 * (ab[:, 0] * ac[:, 1] - ab[:, 1] * ac[:, 0])
    assert (areas > 0.0).all()
    assert areas.sum() == pytest.approx(lettering.area(curves), rel=1e-9)
    # n corners and h holes make n + 2h - 2 triangles
    assert len(areas) == len(np.concatenate(curves)) + 2 * (len(curves) - 1) - 2


@pytest.mark.parametrize("letter", string.ascii_uppercase)
def test_extruded_letters_are_closed_and_have_their_volume(letter):
    curves = lettering.outline(letter)
    depth, bevel = 0.25, 0.02
    points, faces = lettering.extruded(curves, depth, bevel)
    cut = [(face[0], a, b) for face in faces for a, b in itertools.pairwise(face[1:])]
    solid = lattice.mesh(points, np.array(cut))  # refuses what is open or turned inside out
    missing = depth * lettering.area(curves) - solid.volume
    edge = sum(np.linalg.norm(curve - np.roll(curve, 1, axis=0), axis=1).sum() for curve in curves)
    # The bevel takes a triangular prism off both edges, more along holes, less where corners are sharp.
    assert 0.6 * edge * bevel**2 < missing < 1.05 * edge * bevel**2
    assert np.ptp(points[:, 2]) == pytest.approx(depth)
    normals = corner_normals(points, faces)
    flat = [np.cross(points[face[1]] - points[face[0]], points[face[2]] - points[face[0]]) for face in faces]
    flat /= np.linalg.norm(flat, axis=1, keepdims=True)
    outwards = flat[:, 2] * points[[face[0] for face in faces], 2]
    assert (outwards[np.abs(flat[:, 2]) > 0.99] > 0.0).all()  # no triangle of a cap is folded over another
    flat = np.repeat(flat, [len(face) for face in faces], axis=0)
    np.testing.assert_allclose(np.linalg.norm(normals, axis=1), 1.0, atol=1e-12)
    # within the crease, 35°, and 10° more where the bevel of a sharp corner is twisted
    assert (np.einsum("ni,ni->n", normals, flat) > 0.7).all()
    np.testing.assert_allclose(normals[np.abs(flat[:, 2]) > 0.99], flat[np.abs(flat[:, 2]) > 0.99], atol=1e-9)


@pytest.mark.parametrize("letter", string.ascii_uppercase)
def test_boxes_cover_the_strokes(letter):
    curves = lettering.outline(letter)
    boxes = lettering.boxes(curves)
    assert 1 <= len(boxes) <= 8
    x, y = np.meshgrid(np.linspace(-0.8, 0.8, 161), np.linspace(-0.8, 0.8, 161))
    points = np.stack([x.ravel(), y.ravel()], axis=1)
    inside = lettering._inside(points, curves)
    covered = np.any([box.contains(points) for box in boxes], axis=0)
    assert (covered & inside).sum() > 0.88 * inside.sum()
    # What sticks out does so by the margin and half a cell, along all edges: allowed are both margins and a cell.
    reach = lettering._OVERHANG + 1.0 / lettering._CELLS
    outer = [lettering._inset(curve, -reach) for curve in curves]
    assert (covered & ~lettering._inside(points, outer)).sum() < 0.01 * inside.sum()
    for box in boxes:
        assert box.contains(0.999 * corners_of(box) + 0.001 * box.center).all()
        assert 2.0 * box.half.min() > 0.14


@pytest.mark.parametrize("text", [" ", ""])
def test_a_letter_without_ink_is_refused(text):
    with pytest.raises(InputError, match="letters"):
        lettering.outline(text)
