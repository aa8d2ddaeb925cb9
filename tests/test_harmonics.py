"""Solid harmonics and their translations against fields of dipoles and 1/r, all in float64."""

import numpy as np
import pytest
from dipole_expansions import dipole_to_multipole, local_to_field, regular_gradients

from bench.reference.oracle import h_field
from warpmag.moments import harmonics

EPSILON = np.finfo(np.float64).eps


def _relative(result, expected):
    return np.linalg.norm(result - expected) / np.linalg.norm(expected)


def _in_cell(rng, n):
    return rng.uniform(-0.5, 0.5, (n, 3))


def _at_distance(rng, n, distance):
    directions = rng.normal(size=(n, 3))
    return distance * directions / np.linalg.norm(directions, axis=1)[:, None]


def test_products_sum_to_the_inverse_distance():
    rng = np.random.default_rng(1)
    near, far = _at_distance(rng, 20, 0.1), _at_distance(rng, 20, 1.0)
    sums = (harmonics.regular(16, near) * harmonics.irregular(16, far)).sum(axis=1)
    # the series is truncated at 0.1¹⁷
    np.testing.assert_allclose(sums, 1 / np.linalg.norm(far - near, axis=1), rtol=32 * EPSILON)


def test_harmonics_of_a_degree_are_normalized():
    rng = np.random.default_rng(2)
    values = harmonics.regular(15, _at_distance(rng, 20, 1.0))
    for degree in range(16):
        squares = (values[:, harmonics.degrees(15) == degree] ** 2).sum(axis=1)
        np.testing.assert_allclose(squares, 1, rtol=1e3 * EPSILON)  # recurrences through 15 degrees


def test_low_degrees_are_the_polynomials_they_should_be():
    x, y, z = np.random.default_rng(3).normal(size=(3, 10))
    values = harmonics.regular(2, np.stack([x, y, z], axis=1))
    root3 = np.sqrt(3)
    expected = [np.ones(10), y, z, x, root3 * x * y, root3 * y * z, z * z - (x * x + y * y) / 2, root3 * x * z]
    expected.append(root3 / 2 * (x * x - y * y))
    np.testing.assert_allclose(values, np.stack(expected, axis=1), rtol=0, atol=32 * EPSILON)


def test_parity():
    points = _in_cell(np.random.default_rng(4), 10)
    values, signs = harmonics.regular(15, points), harmonics.parity(15)
    for axis in range(3):
        mirrored = points * np.where(np.arange(3) == axis, -1, 1)
        np.testing.assert_array_equal(harmonics.regular(15, mirrored), signs[axis] * values)


def test_gradients_by_differences():
    points, step = _in_cell(np.random.default_rng(5), 5), 1e-5
    gradients = regular_gradients(15, points)
    for axis in range(3):
        shift = step * np.eye(3)[axis]
        slope = (harmonics.regular(15, points + shift) - harmonics.regular(15, points - shift)) / (2 * step)
        np.testing.assert_allclose(gradients[:, :, axis], slope, atol=1e-7)  # step², times third derivatives


@pytest.mark.parametrize("offset", [(2, 0, 0), (-3, 1, 2), (0, -2, 3), (-1, -2, 0)])
def test_multipole_to_local_has_irregular_harmonics_around_the_target(offset):
    """Rows of the matrix are expansions of harmonics of any degree, which converge fast near the center."""
    points = 0.05 * _in_cell(np.random.default_rng(6), 10)
    expanded = harmonics.regular(15, points) @ harmonics.multipole_to_local(15, offset)
    expected = harmonics.irregular(15, points + np.asarray(offset, float))
    # truncated at (0.05 √¾ / 2)¹⁶ with large coefficients
    np.testing.assert_allclose(
        expanded / np.abs(expected).max(axis=0), expected / np.abs(expected).max(axis=0), atol=1e-11
    )


def test_offsets_with_other_signs_have_other_signs():
    straight, mirrored = (harmonics.multipole_to_local(9, offset) for offset in ((3, 1, 2), (-3, 1, -2)))
    signs = harmonics.parity(9)[[0, 2]].prod(axis=0)
    np.testing.assert_allclose(mirrored, signs[:, None] * straight * signs, rtol=0, atol=4 * EPSILON)


def test_far_field_is_symmetric():
    """Forces between source and target are mutual, so the operator is symmetric."""
    there, back = (harmonics.multipole_to_local(9, offset) for offset in ((2, -1, 3), (-2, 1, -3)))
    np.testing.assert_allclose(there, back.T, rtol=0, atol=4 * EPSILON)


@pytest.mark.parametrize("degree, error", [(8, 3e-2), (12, 3e-3), (20, 3e-4)])
def test_field_between_cells(degree, error):
    """Dipoles to multipole, to parent, to local, to child, to field, against direct sums.

    The error is that of the series cut at the degree, for cells a cell apart, the nearest that are far.
    """
    rng = np.random.default_rng(7)
    positions, moments, points = _in_cell(rng, 30), rng.normal(size=(30, 3)), _in_cell(rng, 30)
    multipole = dipole_to_multipole(degree, positions, moments)
    offset = np.array([2.0, 0.0, 0.0])
    field = local_to_field(harmonics.multipole_to_local(degree, offset) @ multipole, points)
    assert _relative(field, 4 * np.pi * h_field(positions, moments, points + offset)) < error

    for source, target in ((3, 4), (7, 0)):
        parents = harmonics.multipole_to_multipole(degree, source) @ multipole
        local = harmonics.local_to_local(degree, target) @ (harmonics.multipole_to_local(degree, offset) @ parents)
        apart = 2 * offset + harmonics.octant_offset(target) - harmonics.octant_offset(source)
        field = local_to_field(local, points)
        assert _relative(field, 4 * np.pi * h_field(positions, moments, points + apart)) < error
