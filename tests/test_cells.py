"""Cells of one inducible body that is no ball: their demagnetizing tensors, their sizes, and the moment of the body."""

import math
from functools import cache

import magpylib
import numpy as np
import pytest
import warp as wp
from cell_bodies import (
    FAINT,
    TURN,
    coupled,
    demagnetizing_factors,
    demagnetizing_matrix,
    filled,
    full,
    make_system,
    matrix,
    polarizability,
    posed,
)

from bench.reference import plate, surface_integrals
from warpmag.kernels.cells.couplings import CellCouplings
from warpmag.shapes import demagnetization, lattice, linear_cells, uniform_response

SIDES = np.array([1.0, 0.7, 0.4])


def sheet_couplings(dtype, device, moments=None):
    """Return a sheet of one layer, the couplings of its cells as the only iron, its moments and the field [n, 3]."""
    body = lattice.fill(lattice.box([0.012, 0.009, 0.0005]), 0.0015, together=True)
    coupling = linear_cells.with_slopes(demagnetization.coupling(body, body.radii), body).among(1, balls=False)
    values = np.zeros_like(body.positions) if moments is None else moments(body)
    vectors = wp.array(values, dtype=wp.types.vector(3, dtype), device=device)
    field = wp.zeros_like(vectors)
    return body, CellCouplings([(0, coupling)], vectors, field, paired=True), vectors, field


def test_magnetization_of_a_sheet_has_no_divergence(device):
    """Half the differences of halves of M = (a x, b y, c) are those of (a x, b y, c − (a + b) z), inside the sheet."""
    slopes = np.array([3e5, -1e5, 0.0])
    body, couplings, _, _ = sheet_couplings(
        wp.float64, device, lambda body: (body.positions * slopes + [0.0, 0.0, 7.0]) * body.volumes[:, None]
    )
    couplings.write_differences()
    sides = body.pieces[0].sides
    slopes[2] = -slopes.sum()
    inside = (np.abs(body.positions[:, :2]) < np.abs(body.positions[:, :2]).max(axis=0) - 1e-6).all(axis=1)
    magnetization = couplings.differences.numpy() / body.volumes[:, None]
    assert inside.sum() > 20 and len(np.unique(body.positions[:, 2].round(9))) == 1
    np.testing.assert_allclose(magnetization[inside], np.tile(0.25 * sides * slopes, (inside.sum(), 1)), rtol=1e-9)


@pytest.mark.parametrize("dtype", [wp.float32, wp.float64])
def test_fields_of_differences_act_on_moments_of_a_sheet_as_its_differences_do(dtype, device):
    """The field Dᵀ g of moments m has the same energy as the field g of the differences D m."""
    rng = np.random.default_rng(5)
    body, couplings, vectors, field = sheet_couplings(dtype, device)
    values, fields = rng.normal(size=(2, *body.positions.shape))
    vectors.assign(values)
    couplings.write_differences()
    differences = couplings.differences.numpy().astype(float)
    vectors.zero_()
    couplings.write_differences()
    couplings.difference_field.assign(fields)
    couplings.launch()
    energy = (differences * fields).sum()
    size = np.linalg.norm(differences) * np.linalg.norm(fields)
    assert (field.numpy() * values).sum() == pytest.approx(energy, abs=1e-6 * size)
    assert abs(differences[:, 2]).max() > 0.1


def test_tensors_of_cuboids_are_their_exact_fields_averaged():
    nodes, weights = np.polynomial.legendre.leggauss(8)  # exact to 1e-9 for a field at a side's distance
    weight = np.einsum("i,j,k->ijk", weights, weights, weights).reshape(-1) / 8
    points = np.stack(np.meshgrid(nodes, nodes, nodes, indexing="ij"), axis=-1).reshape(-1, 3) * SIDES / 2
    for offset in ((2, 1, 0), (0, 3, -2), (-1, 2, 5), (-2, -3, -4)):
        result = full(demagnetization.cuboid_tensors(np.array([offset]), SIDES))[0]
        for axis in np.eye(3):
            field = magpylib.magnet.Cuboid(dimension=SIDES, magnetization=axis).getH(points + offset * SIDES)
            np.testing.assert_allclose(-result @ axis, weight @ field, atol=1e-8)


def test_the_potential_of_a_tiny_facet_beside_a_large_one():
    """The potential in the center of a square of edge a is 4 a ln(1 + √2) / 4π."""
    square = 0.5 * np.array([[-1.0, -1.0, 0.0], [1.0, -1.0, 0.0], [1.0, 1.0, 0.0], [-1.0, 1.0, 0.0]])
    tiny = np.array([1.0, 0.3, 0.2])
    result = uniform_response.potentials(tiny[None], np.stack([square, 1e-9 * square + tiny]))
    # coordinates of order 1 round the corners of the tiny facet to 1e-7 of its edge
    assert result[0, 1] == pytest.approx(1e-9 * math.log(1.0 + math.sqrt(2.0)) / math.pi, rel=1e-6)


def test_tensors_of_cuboids_add_up_to_that_of_the_block_they_fill():
    """Ten digits remain of float64 after cancellation at offsets of up to 6 sides."""
    counts = np.array([3, 2, 5])
    grid = np.stack(np.meshgrid(*(np.arange(k) for k in counts), indexing="ij"), axis=-1).reshape(-1, 3)
    pairs = demagnetization.cuboid_tensors((grid[:, None] - grid).reshape(-1, 3), SIDES)
    block = demagnetization.cuboid_tensors(np.zeros((1, 3)), counts * SIDES)[0]
    np.testing.assert_allclose(pairs.sum(axis=0) / len(grid), block, atol=1e-10)
    assert block[:3].sum() == pytest.approx(1.0, abs=1e-12)  # the trace of a body's own tensor
    apart = (grid[:, None] != grid).any(axis=2).reshape(-1)
    np.testing.assert_allclose(pairs[apart, :3].sum(axis=1), 0.0, atol=1e-10)


@pytest.mark.parametrize("dtype", ["float32", "float64"])
def test_field_of_cells_is_that_of_balls_and_couplings(device, dtype):
    body = lattice.fill(lattice.cylinder(0.01, 0.005), 0.003)
    coupling = linear_cells.with_slopes(demagnetization.coupling(body, body.radii), body).among(1, balls=False)
    assert len(body.volumes) >= linear_cells.LEAST_CELLS
    system = make_system(body, turn=TURN, coupling=coupling, dtype=dtype, device=device)
    start = np.random.default_rng(0).normal(size=body.positions.shape)
    system.start_from(wp.array(0.05 * FAINT * start, dtype=system.moments.dtype, device=device))
    system.begin()
    system.evaluate()
    moments, turned, n = system.moments.numpy().astype(float), matrix(TURN), len(start)
    magnetization, local = moments / body.volumes[:, None], moments @ turned
    operator = demagnetizing_matrix(body, coupling) / np.repeat(np.sqrt(body.volumes), 3)[:, None]
    field = (-(operator @ (local / np.sqrt(body.volumes)[:, None]).reshape(-1))).reshape(n, 3)
    expected = (field + magnetization @ turned / 3.0) @ turned.T  # the ball's own part is in its curve
    error = np.linalg.norm(system.h.numpy() - expected) / np.linalg.norm(magnetization)
    assert error < {"float32": 2e-6, "float64": 1e-14}[dtype]  # sums of n terms


ELLIPSOIDS = {
    "sphere": (1.0, 1.0, 1.0),
    "needle": (1.0, 1.0, 10.0),
    "disc": (5.0, 5.0, 1.0),
}


def magnetized(solid, susceptibility, device, spacing=0.0, **settings):
    body = filled([solid], spacing)
    return polarizability(body, susceptibility, device, coupling=coupled(body, [solid]), **settings)


@cache
def ellipsoid_cells(name):
    """Cells of an ellipsoid, and their coupling."""
    solid = lattice.ellipsoid(0.01 * np.array(ELLIPSOIDS[name]))
    body = filled([solid])
    return body, coupled(body, [solid])


@pytest.mark.parametrize("name", ELLIPSOIDS)
@pytest.mark.parametrize("susceptibility", [10.0, 179.0, math.inf])
def test_ellipsoids_take_the_moment_of_the_closed_form(device, name, susceptibility):
    """1 %: facets are good to 0.5 % in a uniform field, whatever the cells."""
    axes, (body, coupling) = np.array(ELLIPSOIDS[name]), ellipsoid_cells(name)
    result = polarizability(body, susceptibility, device, coupling=coupling, rtol=1e-3)
    np.testing.assert_allclose(result, 1.0 / (demagnetizing_factors(axes) + 1.0 / susceptibility)[[0, 2]], rtol=1e-2)


@pytest.mark.parametrize(
    "sides",
    [
        (1.0, 1.0, 10.0),
        (10.0, 10.0, 1.0),
        *(pytest.param(sides, marks=pytest.mark.long) for sides in ((1.0, 1.0, 5.0), (5.0, 5.0, 1.0))),
    ],
)
def test_rods_and_sheets_take_the_moment_of_a_surface_integral_equation(device, sides):
    """1 % at the default spacing; the reference is good to 0.3 %."""
    result = magnetized(lattice.box(0.5 * np.array(sides)), math.inf, device)
    np.testing.assert_allclose(result, surface_integrals.box_moments(sides, [math.inf])[0, [0, 2]], rtol=1e-2)


@pytest.mark.parametrize("length", surface_integrals.CYLINDER_LENGTHS)
def test_cylinders_take_the_moment_of_a_surface_integral_equation(device, length):
    """1 %; the reference is good to 0.3 %."""
    result = magnetized(lattice.cylinder(0.5, 0.5 * length), math.inf, device)
    np.testing.assert_allclose(result[::-1], surface_integrals.cylinder_moments(length, [math.inf])[0], rtol=1e-2)


def test_moments_of_any_susceptibility_are_those_of_a_surface_integral_equation(device):
    """1 %, as for an infinite one; references are good to 0.3 %."""
    values = (1.0, 10.0, 1000.0)
    rods = surface_integrals.cylinder_moments(5.0, values)[:, ::-1]
    sheets = surface_integrals.box_moments((5.0, 5.0, 1.0), values, (6, 10))[:, [0, 2]]
    for solid, references in ((lattice.cylinder(0.5, 2.5), rods), (lattice.box([2.5, 2.5, 0.5]), sheets)):
        body = filled([solid])
        coupling = coupled(body, [solid])
        for susceptibility, expected in zip(values, references, strict=True):
            result = polarizability(body, susceptibility, device, coupling=coupling)
            np.testing.assert_allclose(result, expected, rtol=1e-2)


@pytest.mark.parametrize("spacing", [1.0, 2.0, 10.0])
def test_bodies_of_a_cell_across_take_the_moment_of_their_surface(device, spacing):
    """1 %: 5, 3 and 1 cells of a rod, which alone take down to 11.3 of 17.5 along it."""
    result = magnetized(lattice.box([0.5, 0.5, 2.5]), math.inf, device, spacing)
    expected = surface_integrals.box_moments((1.0, 1.0, 5.0), [math.inf])[0, [0, 2]]
    np.testing.assert_allclose(result, expected, rtol=1e-2)


def test_crossed_bars_of_a_cell_across_take_the_moment_of_a_surface_integral_equation(device):
    """2 %: facets are whole or left out where the bars meet; cells alone take a quarter too little."""
    bars = posed(([1.0, 1.0, 5.0], [0.0] * 3), ([5.0, 1.0, 1.0], [0.0] * 3))
    body = filled(bars, 2.0)
    result = polarizability(body, math.inf, device, coupling=coupled(body, bars))
    squares = [((1, -1, 1), (5, 1, 1)), ((1, -1, -1), (5, 1, -1)), ((5, -1, -1), (5, 1, 1))]
    squares += [((1, 1, -1), (5, 1, 1)), ((1, -1, -1), (5, -1, 1))]
    faces = [((-1, y, -1), (1, y, 1)) for y in (-1, 1)]
    for corners in np.array(squares, float):
        for sign, swap in np.ndindex(2, 2):
            face = corners * [1 - 2 * sign, 1, 1]
            face = face[:, ::-1] if swap else face
            faces.append((face.min(axis=0), face.max(axis=0)))
    expected = surface_integrals.permeable_moments(np.array(faces, float), body.volumes.sum(), 8)
    np.testing.assert_allclose(result, expected[[0, 2], [0, 2]], rtol=2e-2)


@pytest.mark.parametrize(("gap", "aside"), [(0.0005, 0.0), (0.0005, 0.01), (0.001, 0.0), (0.002, 0.0), (0.005, 0.01)])
def test_a_plate_below_a_ferrite_cube_is_pulled_as_by_a_surface_integral_equation(device, gap, aside):
    """5 % close up, 2.5 % from a cell's height on; the reference with 12 rectangles is good to 0.3 %."""
    pull, magnetized, _ = plate.model_forces(gap, aside, device)
    force, moment = plate.force(gap, aside, 12)
    close = 0.025 if gap >= 0.002 else 0.05
    assert np.linalg.norm(pull - force) < close * np.linalg.norm(force)
    assert np.linalg.norm(magnetized - moment) < 0.02 * np.linalg.norm(moment)


def test_cubes_approach_the_published_value(device):
    """A cube of infinite permeability takes 3.6442 V H0 (Sihvola et al. 2004; Helsing and Perfekt 2013).

    Cells of uniform magnetization are a little too stiff, by a part that falls with their side.
    """
    error = [
        3.6442 - polarizability(lattice.fill(lattice.box([1.0] * 3), 2.0 / n), math.inf, device)[0] for n in (5, 9)
    ]
    assert 0.0 < error[1] < 0.02 * 3.6442
    assert error[1] < 0.7 * error[0]


SLENDER = {
    "nail 20": (lattice.cylinder(0.5, 10.0), lambda chi: surface_integrals.cylinder_moments(20.0, chi, (40, 60))[:, 0]),
    "nail 50": (lattice.cylinder(0.5, 25.0), lambda chi: surface_integrals.cylinder_moments(50.0, chi, (60, 90))[:, 0]),
    "needle 40": (
        lattice.ellipsoid([1.0, 1.0, 40.0]),
        lambda chi: 1.0 / (demagnetizing_factors((1.0, 1.0, 40.0))[2] + 1.0 / np.array(chi)),
    ),
    "bar 30": (  # the reference takes half a minute
        lattice.box([0.5, 0.5, 15.0]), lambda chi: surface_integrals.box_moments((1.0, 1.0, 30.0), chi, (20, 30))[:, 2]
    ),
}  # fmt: skip


@pytest.mark.parametrize(
    "name", [pytest.param(name, marks=pytest.mark.long if name == "bar 30" else ()) for name in SLENDER]
)
def test_moments_along_slender_bodies_are_those_of_references(name):
    """Their demagnetizing factor is at most 1e-3, so that inconsistent tensors of near and far cells would show."""
    solid, reference = SLENDER[name]
    chi = (10.0, 1000.0, math.inf)
    body = lattice.fill(solid, across=lattice.LEAST_ACROSS, together=True)
    matrix = demagnetizing_matrix(body, coupled(body, [solid]))
    values, vectors = np.linalg.eigh(matrix)
    assert values[0] > 0.0
    along = np.kron(np.sqrt(body.volumes / body.volumes.sum()), [0.0, 0.0, 1.0]) @ vectors
    moments = [(along**2 / (values + 1.0 / susceptibility)).sum() for susceptibility in chi]
    # cells and surface; the references extrapolate to 1 % here
    np.testing.assert_allclose(moments, reference(chi), rtol=0.03)


def test_cells_of_slender_bodies_are_nearly_cubic():
    """A body has several cells across unless they would be flat or long."""
    for half, across in (([0.02, 0.02, 0.0025], 3), ([0.02, 0.02, 0.001], 2), ([0.05, 0.05, 0.001], 1)):
        body = lattice.fill(lattice.box(half), across=lattice.LEAST_ACROSS, together=True)
        assert len(np.unique(body.positions[:, 2].round(9))) == across
        assert 0.9 * lattice.AUTOMATIC_COUNT < len(body.volumes) <= lattice.AUTOMATIC_COUNT
    for half in ([0.001, 0.001, 0.02], [0.001, 0.001, 0.1], [0.05, 0.005, 0.001]):
        body = lattice.fill(lattice.box(half), across=lattice.LEAST_ACROSS, together=True)
        _, middle, most = np.sort(body.pieces[0].sides)
        assert most <= lattice.LONGEST * middle
        assert len(body.volumes) <= lattice.AUTOMATIC_COUNT


@pytest.mark.parametrize("name", ["box", "crossed"])
def test_response_of_cells_is_the_same_directly_and_by_iteration(name, monkeypatch):
    """The iteration's error is the square of its residual over the smallest eigenvalue, here about 0.1."""
    bars = [lattice.box([0.03, 0.01, 0.01]), lattice.box([0.01, 0.03, 0.01])]
    body = lattice.fill({"box": bars[:1], "crossed": bars}[name], 0.005, together=True)
    cells = demagnetization.coupling(body, body.radii)
    direct = uniform_response.cell_polarizability(cells, body)
    monkeypatch.setattr(uniform_response, "_MATRIX_CELLS", 0)
    monkeypatch.setattr(uniform_response, "_RESIDUAL", 1e-6)
    iterated = uniform_response.cell_polarizability(cells, body)
    assert direct.shape == (3, 3)
    np.testing.assert_allclose(iterated, direct, atol=1e-10 * np.abs(direct).max())


def test_repeated_cells_of_a_wire_are_evaluated_once(monkeypatch):
    """Cells along a wire of aspect ratio 10,000 are equal, so their tensors depend on the distance only."""
    body = lattice.fill(lattice.cylinder(1e-4, 1.0), across=lattice.LEAST_ACROSS, together=True)
    evaluated, cut_tensors = [], demagnetization._cut_tensors

    def counted(sides, filled, p, q, separation):
        evaluated.append(len(p))
        return cut_tensors(sides, filled, p, q, separation)

    monkeypatch.setattr(demagnetization, "_cut_tensors", counted)
    cells = demagnetization.coupling(body, body.radii)
    assert len(cells.other) > 5 * len(body.volumes)
    assert sum(evaluated) < 0.1 * len(body.volumes)
