"""The operator of induction between cells: positive for any body, also for bodies that intersect; solves by bodies."""

import math

import numpy as np
import pytest
import warp as wp
from cell_bodies import (
    FAINT,
    coupled,
    demagnetizing_matrix,
)
from scipy.spatial.transform import Rotation

from bench.systems import moment_system
from warpmag.shapes import demagnetization, lattice


def test_flat_cells_of_thin_plates_keep_the_operator_positive(monkeypatch):
    monkeypatch.setattr(lattice, "AUTOMATIC_COUNT", 150)
    solid = lattice.box([15.0, 15.0, 0.5])
    body = lattice.fill(solid, across=2)
    assert len(body.volumes) > 100
    values = np.linalg.eigvalsh(demagnetizing_matrix(body, coupled(body, [solid])))
    assert values[0] > 0.0


@pytest.mark.parametrize(
    "solid",
    [
        lattice.sphere(1.0), lattice.box([1.0, 1.0, 1.0]), lattice.box([1.0, 1.0, 6.0]), lattice.box([6.0, 6.0, 1.0]),
        lattice.box([6.0, 6.0, 0.5]), lattice.box([0.3, 0.3, 50.0]), lattice.ellipsoid([1.0, 1.0, 6.0]),
        lattice.cone(1.0, 1.0), lattice.cylinder(1.0, 0.3),
    ],
    ids=lambda solid: f"{solid.name}{solid.upper.max() / solid.upper.min():.0f}",
)  # fmt: skip
def test_operator_of_a_body_is_positive(solid):
    """Induction then has one solution for any susceptibility. Slopes add to the energy: eigenvalues may exceed 1."""
    body = lattice.fill(solid, (solid.volume / 150.0) ** (1 / 3))
    matrix = demagnetizing_matrix(body, coupled(body, [solid]))
    np.testing.assert_allclose(matrix, matrix.T, atol=1e-12)
    values = np.linalg.eigvalsh(matrix)
    assert values[0] > 0.0
    assert values[-1] < 1.1


@pytest.mark.parametrize("solid", [lattice.box([1.0] * 3), lattice.cylinder(1.0, 1.0)], ids=lambda solid: solid.name)
def test_operator_of_a_compact_body_of_the_default_number_of_cells_is_positive(solid):
    """Fields of differences that end abruptly leave 6e-5 and -2e-4, less than bodies in contact need."""
    body = lattice.fill(solid, across=lattice.LEAST_ACROSS, together=True)
    values = np.linalg.eigvalsh(demagnetizing_matrix(body, coupled(body, [solid])))
    assert values[0] > 5e-4


@pytest.mark.parametrize("apart", [0.0, 0.004, 0.009, 0.01])
def test_bodies_that_touch_or_intersect_have_one_solution(device, apart):
    """Two cubes of 10 mm and infinite permeability, also coincident, from different starts."""
    body = lattice.fill(lattice.box([0.005] * 3), 0.0025)
    n, coupling = len(body.volumes), demagnetization.coupling(body, body.radii)
    solutions = []
    for seed in range(3):
        system = moment_system(
            radii=np.tile(body.radii, 2), bodies=np.repeat([0, 1], n), saturation=1.7e6, external_field=(0.0, 0.0, 1e3),
            couplings=[(0, coupling), (n, coupling)], rtol=1e-8, max_evaluations=3000, dtype="float64", device=device,
        )  # fmt: skip
        system.positions.assign(np.concatenate([body.positions, body.positions + np.array([apart, 0.0, 0.0])]))
        start = np.random.default_rng(seed).normal(size=(2 * n, 3)) * (1e6 if seed else 0.0)
        system.start_from(wp.array(np.clip(start, -9e5, 9e5), dtype=wp.vec3d, device=device))
        system.solve()
        assert system.converged.numpy().tolist() == [1]
        solutions.append(system.moments.numpy())
    for other in solutions[1:]:
        # rtol, amplified by slow convergence
        assert np.linalg.norm(other - solutions[0]) < 1e-6 * np.linalg.norm(solutions[0])


def intersecting(body, coupling, places, turns, device):
    """A system of equal bodies, and their operator H = −D M, symmetrized by volumes, from the field of each moment."""
    n, count = len(body.volumes), len(places)
    system = moment_system(
        radii=np.tile(body.radii, count), bodies=np.repeat(np.arange(count), n), saturation=FAINT,
        susceptibility=math.inf, external_field=(0.0, 0.0, 1e3), dtype="float64", device=device,
        couplings=[(n * k, coupling) for k in range(count)],
    )  # fmt: skip
    positions = [turn.apply(body.positions) + place for turn, place in zip(turns, places, strict=True)]
    system.positions.assign(np.concatenate(positions))
    system.rotations.assign(np.array([turn.as_quat() for turn in turns]))
    system.begin()
    size, fields = 3 * n * count, []
    for moment in np.vstack([np.zeros(size), np.eye(size)]):
        system.moments.assign(moment.reshape(-1, 3))
        system._packed.pack(system.positions, system.moments)
        system.evaluate()
        fields.append(system.h.numpy().flatten())
    root = np.repeat(np.sqrt(np.tile(body.volumes, count)), 3)
    operator = np.eye(size) / 3.0 - root * (np.array(fields[1:]) - fields[0]).T * root[:, None]
    np.testing.assert_allclose(operator, operator.T, atol=1e-6)  # positions are rounded to float32
    system.start_from(wp.zeros(n * count, dtype=wp.vec3d, device=device))
    return system, operator


@pytest.mark.parametrize(
    ("solid", "spacing"),
    [
        (lattice.box([0.01] * 3), 0.007),
        (lattice.box([0.02, 0.02, 0.0025]), 0.01),
        (lattice.box([0.003, 0.003, 0.03]), 0.006),
        (lattice.cylinder(0.01, 0.01), 0.007),
        (lattice.cone(0.01, 0.02), 0.005),
        (lattice.ellipsoid([0.01, 0.006, 0.015]), 0.006),
    ],
    ids=["cube", "plate", "rod", "cylinder", "cone", "ellipsoid"],
)
def test_operator_of_bodies_that_intersect_is_positive(solid, spacing, device):
    """Coincident, close and random bodies: induction converges for any intersection."""
    body = lattice.fill(solid, spacing, lattice.LEAST_ACROSS)
    coupling = coupled(body, [solid])
    rng = np.random.default_rng(0)
    for count, spread, turn in ((2, 0.0, 0.0), (2, 1e-4, 0.01), (3, 0.3, 0.3), (4, 1.0, 1.0)):
        places = spread * solid.upper.min() * rng.uniform(-1.0, 1.0, (count, 3))
        turns = Rotation.from_rotvec(turn * rng.normal(size=(count, 3)))
        system, operator = intersecting(body, coupling, places, list(turns), device)
        assert np.linalg.eigvalsh(operator)[0] > -0.002  # the quadrature of boxes that intersect
        system.solve()
        assert system.converged.numpy().tolist() == [1]
        assert system.evaluations.numpy()[0] < 120


def test_small_bodies_are_solved_as_a_whole(device):
    """A turned bar of 16 cells, alone: the residuals of all steps are parallel, so that mixing two of them ends it."""
    solid = lattice.box([0.01, 0.0025, 0.00125])
    body = lattice.fill(solid, 0.0025, together=True)
    turn = Rotation.from_rotvec([0.3, -0.5, 1.0])
    system, operator = intersecting(body, coupled(body, [solid]), np.zeros((1, 3)), [turn], device)
    system.solve()
    root = np.repeat(np.sqrt(body.volumes), 3)
    expected = root * np.linalg.solve(operator, root * np.tile([0.0, 0.0, 1e3], len(body.volumes)))
    moments = system.moments.numpy().reshape(-1)
    assert system.evaluations.numpy()[0] <= 4
    assert np.linalg.norm(moments - expected) < 2e-3 * np.linalg.norm(expected)  # rtol, and the saturation of FAINT


def test_permanent_ball_around_iron_adds_no_demagnetization(device):
    """Iron inside a spread moment responds to other fields as without it."""
    body = lattice.fill(lattice.box([0.005] * 3), 0.0025)
    n, fields = len(body.volumes), []
    coupling = demagnetization.coupling(body, body.radii)
    moments = np.random.default_rng(2).normal(size=(2 * n, 3))
    for radius, moment in ((1e-5, 0.0), (0.03, 5.0)):
        system = moment_system(
            radii=[*np.tile(body.radii, 2), radius], bodies=[*np.repeat([0, 1], n), 2],
            permanent=np.arange(2 * n + 1) == 2 * n, couplings=[(0, coupling), (n, coupling)], saturation=1.7e6,
            dtype="float64", device=device,
        )  # fmt: skip
        beside = body.positions + np.array([0.0105, 0.0, 0.0])
        system.positions.assign(np.concatenate([body.positions, beside, [[0.004, 0.003, 0.0]]]))
        for own in (moments, 0.0 * moments):
            system.moments.assign(np.concatenate([own, [[0.0, 0.0, moment]]]))
            system.begin()
            system.moments.assign(np.concatenate([own, [[0.0, 0.0, moment]]]))  # the start has changed them
            system._packed.pack(system.positions, system.moments)
            system.evaluate()
            fields.append(system.h.numpy()[: 2 * n].copy())
    # positions are rounded to float32, and the field of the spread moment is 1e3 times that of the iron
    np.testing.assert_allclose(fields[2] - fields[3], fields[0] - fields[1], atol=1e-6 * np.abs(fields[2]).max())
