"""References of iron bodies near each other by finite elements, and warpmag's comparison with them."""

import json
import math

import newton
import numpy as np
import pytest
import warp as wp

import warpmag
from bench import iron
from bench.prisms import prism
from bench.reference import near_contact
from bench.reference.iron_bodies import SETUPS, Body, load
from bench.reference.oracle import MU0
from bench.reference.spheres import pair
from warpmag.shapes import lattice


def test_every_setup_has_a_converged_reference():
    """Finer elements change a force by less than 0.3 %, of setups without an axis by less than 1 %."""
    table = load()
    assert list(table) == list(SETUPS)
    for name, row in table.items():
        setup = SETUPS[name]
        limit = 3e-3 if setup.is_axial else 1e-2
        assert np.isfinite([row["forces"], row["moments"]]).all()
        assert np.shape(row["forces"]) == np.shape(row["moments"]) == (len(setup.bodies), 3)
        assert row["moment_change"] < limit, name
        if len(setup.bodies) > 1:
            assert row["force_change"] < limit and row["force_sum"] < limit, name


@pytest.mark.parametrize("gap", [0.005, 0.2, 1.0, 5.0])
def test_references_of_two_balls_are_the_exact_solution(gap):
    """The domain ends at 30 sizes, which leaves 1e-4."""
    setup, row = SETUPS[f"balls in line, gap {gap:g}"], load()[f"balls in line, gap {gap:g}"]
    first, second = setup.bodies
    exact = pair(math.dist(first.center, second.center), (0.005, 0.005), (1001.0, 1001.0))
    moments = np.linalg.solve(exact.resistance[0], 2 * [setup.field[2]])
    force = 0.5 * MU0 * moments @ exact.slope[0] @ moments
    assert np.array(row["forces"])[:, 2] == pytest.approx([force, -force], rel=3e-4)
    assert np.array(row["moments"])[:, 2] == pytest.approx(moments, rel=3e-4)


def test_volume_of_a_body():
    """The volume sets the spacing of a number of cells."""
    sizes = {"ball": (0.005,), "cylinder": (0.01, 0.003), "box": (0.01, 0.02, 0.003)}
    volumes = {shape: Body(shape, size, (0.0, 0.0, 0.0)).volume for shape, size in sizes.items()}
    expected = {"ball": 4.0 / 3.0 * math.pi * 1.25e-7, "cylinder": math.pi * 1e-4 * 0.006, "box": 0.02 * 0.04 * 0.006}
    assert volumes == pytest.approx(expected)


@pytest.mark.parametrize("index", [0, 1])
def test_a_letter_is_its_mesh(index):
    """Volume [m³] and reach are those of the mesh in single precision."""
    letter = SETUPS["letters T and L, gap 0.2"].bodies[index]
    mesh = prism(letter.outline, letter.size[0])
    solid = lattice.mesh(np.asarray(mesh.vertices, float), np.asarray(mesh.indices).reshape(-1, 3))
    assert letter.volume == pytest.approx([4.8e-7, 4.48e-7][index], rel=1e-12)
    assert solid.volume == pytest.approx(letter.volume, rel=1e-6)
    assert letter.reach == pytest.approx(np.linalg.norm(mesh.vertices, axis=1).max(), rel=1e-6)


def test_lines_compare_a_model_with_the_table(device, monkeypatch, capsys):
    name = "cylinders in line, gap 5"
    monkeypatch.setattr("sys.argv", ["iron", name, "--cells", "0", "--device", device])
    iron.main()
    (line,) = [json.loads(text) for text in capsys.readouterr().out.splitlines()]
    assert line["setup"] == name and line["converged"]
    # the gap is as wide as three cells: cells of 2 mm leave 2 %
    assert line["force_error"] < 0.03 and line["moment_error"] < 0.03
    assert abs(line["force_ratios"][0] - 1.0) == pytest.approx(line["force_error"], abs=1e-4)
    assert line["force_sum"] < 1e-5


def test_letters_whose_faces_are_not_between_cells(device):
    """17 cells along 14 mm: faces at 5 and 9 mm are inside cells.

    With 4 test points across a cell and one factor for the volumes of all cells the error would be 13 %.
    """
    name = "letters T and L, gap 0.2"
    line = iron.errors(SETUPS[name], load()[name], cells=1000, device=device)
    assert line["converged"]
    assert line["force_error"] < 0.05


def test_cylinders_side_by_side_that_nearly_touch(device):
    """Cells of 2 mm leave 6 % at a gap of 0.2 mm; with four times the energy of the curl of M it would be 13 %."""
    name = "cylinders side by side, gap 0.2"
    line = iron.errors(SETUPS[name], load()[name], device=device)
    assert line["converged"]
    assert line["force_error"] < 0.07


@pytest.mark.parametrize("name", [name for name in SETUPS if name.startswith("magnet ") and " on " in name])
def test_magnets_on_plates_that_they_saturate(name, device):
    """Cells as wide as the plate is thick, or wider, leave 4 %; without charges across M they would leave 11 %."""
    line = iron.errors(SETUPS[name], load()[name], device=device)
    assert line["converged"] and line["force_sum"] < 1e-5
    assert line["force_error"] < 0.05


def test_two_balls_in_contact(device):
    """Two balls have so few unknowns that changes between mixtures are rounding: moments were four times as large."""
    setup = SETUPS["balls in line, gap 0.005"]
    centers, radii = np.array([body.center for body in setup.bodies]), np.array([body.size[0] for body in setup.bodies])
    exact, _ = near_contact.equilibrium(centers, radii, setup.field, saturation=1e9, susceptibility=1000.0)
    _, moments, magnetics = iron.model_forces(setup, 0, device, "multipole")
    volumes = 4.0 / 3.0 * math.pi * radii[:, None] ** 3
    np.testing.assert_allclose(moments / volumes, exact.magnetizations, rtol=1e-3, atol=1.0)
    assert magnetics.converged.numpy().all()


ACROSS, ALONG = (0.0, 0.0, 1.0), (1.0, 0.0, 0.0)


@pytest.mark.parametrize(
    ("size", "direction"),
    [
        ((0.03, 0.001), ACROSS),
        ((0.04, 0.0012), ALONG),
        pytest.param((0.03, 0.001), ALONG, marks=pytest.mark.long),
        pytest.param((0.04, 0.0012), ACROSS, marks=pytest.mark.long),
        pytest.param((0.04, 0.001), ACROSS, marks=pytest.mark.long),
        pytest.param((0.04, 0.001), ALONG, marks=pytest.mark.long),
    ],
    ids=str,
)
def test_equal_sheets_that_lie_on_each_other_converge(size, direction, device):
    """Sheets of one layer, cell on cell: differences across the layer would make the operator indefinite."""
    side, thickness = size
    builder = newton.ModelBuilder(gravity=(0.0, 0.0, 0.0))
    warpmag.register_custom_attributes(builder)
    for height in (-0.5, 0.5):
        sheet = builder.add_body(xform=((0.0, 0.0, height * thickness), (0.0, 0.0, 0.0, 1.0)))
        builder.add_shape_box(sheet, hx=0.5 * side, hy=0.5 * side, hz=0.5 * thickness)
        warpmag.add_inducible(builder, body=sheet, material="1010-steel")
    magnetics = warpmag.Magnetics(builder.finalize(device=device), external_field=1e4 * np.array(direction))
    magnetics.induce(magnetics.model.state())
    assert magnetics.converged.numpy().all()
    assert magnetics.evaluations.numpy().max() < 300  # 70 to 120


def solved_boxes(sizes, angles, susceptibility, field, device):
    """Evaluations of boxes on each other, and whether their solve converged; sizes are from the lowest on [m]."""
    builder, height = newton.ModelBuilder(gravity=(0.0, 0.0, 0.0)), 0.0
    warpmag.register_custom_attributes(builder)
    for size, angle in zip(sizes, angles, strict=True):
        center, turn = (0.0, 0.0, height + 0.5 * size[2]), wp.quat_from_axis_angle(wp.vec3(0.0, 0.0, 1.0), angle)
        body = builder.add_body(xform=wp.transform(center, turn))
        builder.add_shape_box(body, hx=0.5 * size[0], hy=0.5 * size[1], hz=0.5 * size[2])
        warpmag.add_inducible(builder, body=body, susceptibility=susceptibility, saturation=1e9)
        height += size[2]
    magnetics = warpmag.Magnetics(builder.finalize(device=device), external_field=field)
    magnetics.induce(magnetics.model.state())
    return magnetics.evaluations.numpy().max(), magnetics.converged.numpy().all()


ONE_LAYER, TWO_LAYERS = (0.03, 0.03, 0.001), (0.05, 0.02, 0.002)


@pytest.mark.parametrize(
    ("size", "count"),
    [
        (ONE_LAYER, 2),
        (ONE_LAYER, 5),
        (TWO_LAYERS, 3),
        pytest.param(ONE_LAYER, 3, marks=pytest.mark.long),
        pytest.param(TWO_LAYERS, 2, marks=pytest.mark.long),
        pytest.param(TWO_LAYERS, 5, marks=pytest.mark.long),
    ],
    ids=str,
)
def test_stacks_of_sheets_without_saturation_converge(size, count, device):
    """With the energy of linear parts deep in a body, or without larger sizes, three and five do not converge."""
    evaluations, converged = solved_boxes([size] * count, [0.0] * count, 5000.0, (1e4, 2e4, 5e3), device)
    assert converged
    assert evaluations < 400  # 85 to 220


@pytest.mark.parametrize("angle", [0.0, 1.3])
def test_a_sheet_of_long_thin_cells_on_a_plate_converges(angle, device):
    """Vortices in the sheet would have negative energy: with points of the sheet, or with all of the linear parts."""
    sizes = [(0.06, 0.06, 1e-4), (0.02, 0.02, 0.001)]
    evaluations, converged = solved_boxes(sizes, [0.0, angle], 1e4, (0.0, 2e4, 5e3), device)
    assert converged
    assert evaluations < 400  # 170 to 250


def test_finite_elements_repeat_the_table():
    """Another version of the mesh generator changes a force by no more than the coarse elements do."""
    pytest.importorskip("ngsolve")
    from bench.reference import finite_elements  # noqa: PLC0415 - needs NGSolve

    name = "ball on plate, gap 1"
    row, stored = finite_elements.solve(name), load()[name]
    np.testing.assert_allclose(row["forces"], stored["forces"], atol=3e-3 * np.abs(stored["forces"]).max())
    np.testing.assert_allclose(row["moments"], stored["moments"], atol=3e-3 * np.abs(stored["moments"]).max())
