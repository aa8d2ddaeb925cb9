"""Inducible bodies other than balls: demagnetizing tensors of their cells, moments, forces and torques."""

import math

import magpylib
import newton
import numpy as np
import pytest
import warp as wp
from cell_bodies import (
    FAINT,
    TURN,
    coupled,
    demagnetizing_matrix,
    filled,
    full,
    make_system,
    matrix,
    polarizability,
    posed,
)
from scipy.integrate import quad
from scipy.spatial.transform import Rotation

import warpmag
from bench.reference import oracle, plate, surface_integrals
from bench.systems import moment_system
from warpmag.shapes import demagnetization, lattice, linear_cells, uniform_response

SIDES = np.array([1.0, 0.7, 0.4])


def demagnetizing_factors(semi_axes):
    """Demagnetizing factors of an ellipsoid (Osborn 1945), by numerical integration."""
    a = np.asarray(semi_axes, float)
    return np.array(
        [a.prod() / 2 * quad(lambda s, x=x: 1 / ((s + x * x) * np.sqrt((s + a * a).prod())), 0, np.inf)[0] for x in a]
    )


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
    coupling = linear_cells.with_slopes(demagnetization.coupling(body, body.radii), body)
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


@pytest.mark.parametrize("name", ELLIPSOIDS)
@pytest.mark.parametrize("susceptibility", [10.0, 179.0, math.inf])
def test_ellipsoids_take_the_moment_of_the_closed_form(device, name, susceptibility):
    """1 %: facets are good to 0.5 % in a uniform field, whatever the cells."""
    axes = np.array(ELLIPSOIDS[name])
    result = magnetized(lattice.ellipsoid(0.01 * axes), susceptibility, device, rtol=1e-3)
    np.testing.assert_allclose(result, 1.0 / (demagnetizing_factors(axes) + 1.0 / susceptibility)[[0, 2]], rtol=1e-2)


@pytest.mark.parametrize("sides", [(1.0, 1.0, 5.0), (1.0, 1.0, 10.0), (5.0, 5.0, 1.0), (10.0, 10.0, 1.0)])
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


def test_flat_cells_of_thin_plates_keep_the_operator_positive(monkeypatch):
    monkeypatch.setattr(lattice, "AUTOMATIC_COUNT", 150)
    solid = lattice.box([15.0, 15.0, 0.5])
    body = lattice.fill(solid, across=2)
    assert len(body.volumes) > 100
    values = np.linalg.eigvalsh(demagnetizing_matrix(body, coupled(body, [solid])))
    assert values[0] > 0.0


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


@pytest.mark.parametrize(
    "solid",
    [
        lattice.sphere(1.0), lattice.box([1.0, 1.0, 1.0]), lattice.box([1.0, 1.0, 6.0]), lattice.box([6.0, 6.0, 1.0]),
        lattice.ellipsoid([1.0, 1.0, 6.0]), lattice.cone(1.0, 1.0), lattice.cylinder(1.0, 0.3),
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


SLENDER = {
    "nail 20": (lattice.cylinder(0.5, 10.0), lambda chi: surface_integrals.cylinder_moments(20.0, chi, (40, 60))[:, 0]),
    "nail 50": (lattice.cylinder(0.5, 25.0), lambda chi: surface_integrals.cylinder_moments(50.0, chi, (60, 90))[:, 0]),
    "needle 40": (
        lattice.ellipsoid([1.0, 1.0, 40.0]),
        lambda chi: 1.0 / (demagnetizing_factors((1.0, 1.0, 40.0))[2] + 1.0 / np.array(chi)),
    ),
    "bar 30": (
        lattice.box([0.5, 0.5, 15.0]), lambda chi: surface_integrals.box_moments((1.0, 1.0, 30.0), chi, (20, 30))[:, 2]
    ),
}  # fmt: skip


@pytest.mark.parametrize("name", SLENDER)
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


def coenergy(system):
    """μ0/2 Σ m·H0 of inducible moments that do not saturate, for an applied field H0 [J]."""
    system.solve()
    moments, applied = system.moments.numpy(), system._induction.h0.numpy()
    return 0.5 * oracle.MU0 * (moments * applied)[: len(applied)].sum()


def test_torque_on_a_turned_body_is_the_gradient_of_its_energy(device):
    body = lattice.fill(lattice.box([0.001, 0.002, 0.006]), 0.001)
    settings = {"dtype": "float64", "rtol": 1e-10, "susceptibility": 50.0, "external_field": (2e3, -1e3, 4e3)}
    system = make_system(body, turn=TURN, device=device, **settings)
    system.solve()
    system.apply_forces()
    torque = system.torques.numpy().sum(axis=0)
    step = 1e-4
    for axis in range(3):
        energies = []
        for sign in (1, -1):
            turn = np.append(math.sin(sign * step / 2) * np.eye(3)[axis], math.cos(step / 2))
            v, w = turn[:3], turn[3]
            product = np.append(w * TURN[:3] + TURN[3] * v + np.cross(v, TURN[:3]), w * TURN[3] - v @ TURN[:3])
            energies.append(coenergy(make_system(body, turn=product, device=device, **settings)))
        slope = (energies[0] - energies[1]) / (2 * step)
        assert torque[axis] == pytest.approx(slope, abs=1e-6 * np.abs(torque).max())  # step² and rtol


def test_a_soft_ellipsoid_turns_with_the_torque_of_the_closed_form(device):
    """1 %, as for its moments: the torque is μ0 V H0² (κ∥ − κ⊥) sin α cos α; down to a fifth without cells."""
    builder = newton.ModelBuilder()
    warpmag.register_attributes(builder)
    body = builder.add_body()
    builder.add_shape_ellipsoid(body, rx=0.01, ry=0.01, rz=0.1)
    warpmag.add_inducible(builder, body=body, saturation=FAINT, susceptibility=179.0)
    model = builder.finalize(device=device)
    across, along = 1.0 / (demagnetizing_factors((1.0, 1.0, 10.0))[[0, 2]] + 1.0 / 179.0)
    volume = 4.0 / 3.0 * math.pi * 1e-5
    for angle in (0.3, 0.25 * math.pi, 1.3):
        state, field = model.state(), 1e4 * np.array([math.sin(angle), 0.0, math.cos(angle)])
        warpmag.Magnetics(model, external_field=tuple(field)).apply(state)
        expected = oracle.MU0 * volume * (along - across) * field[0] * field[2]
        np.testing.assert_allclose(state.body_f.numpy()[0, 3:], [0.0, expected, 0.0], rtol=1e-2, atol=1e-3 * expected)


def test_a_body_neither_pushes_nor_turns_itself(device):
    """Forces and torques of an iron plate and a magnet are opposite and equal."""
    body = lattice.fill(lattice.box([0.01, 0.01, 0.002]), 0.001)
    magnet = np.array([[0.004, 0.002, 0.006]]), np.array([[0.1, -0.3, 0.5]])
    system = make_system(body, turn=TURN, permanent=[magnet], susceptibility=1e3, dtype="float64", device=device)
    system.solve()
    system.apply_forces()
    forces, torques = system.forces.numpy(), system.torques.numpy()
    turning = torques + np.cross(system.positions.numpy(), forces)
    np.testing.assert_allclose(forces.sum(axis=0), 0.0, atol=1e-12 * np.abs(forces[-1]).max())
    np.testing.assert_allclose(turning.sum(axis=0), 0.0, atol=1e-12 * np.abs(turning[-1]).max())


def add_needle(builder, rotation, position=(0.0, 0.0, 0.0), body=None, **settings):
    body = builder.add_body(xform=wp.transform(position, rotation)) if body is None else body
    frame = wp.transform_identity() if body >= 0 else wp.transform(position, rotation)
    shape = builder.add_shape_box(body, xform=frame, hx=0.005, hy=0.005, hz=0.05)
    warpmag.add_inducible(builder, **({"body": body} if body >= 0 else {"shape": shape}), **settings)
    return body


def test_a_needle_of_a_model_turns_into_the_field(device):
    """At the rod's trial values of χ = 1000 along and across the field: 40.9 and about 2.3 times V H0."""
    field, angle = np.array([0.0, 0.0, 1e3]), math.radians(30.0)
    builder = newton.ModelBuilder()
    warpmag.register_attributes(builder)
    rotation = wp.quat_from_axis_angle(wp.vec3(1.0, 0.0, 0.0), angle)
    add_needle(builder, rotation, (0.1, 0.2, 0.3), susceptibility=1e3)
    model = builder.finalize(device=device)
    magnetics = warpmag.Magnetics(model, external_field=tuple(field), rtol=1e-4)
    state = model.state()
    magnetics.apply(state)
    wrench = state.body_f.numpy()[0]
    along = np.array([0.0, -math.sin(angle), math.cos(angle)])
    volume = 1e-5
    moment = volume * 1e3 * (2.28 * np.array([0, 0, 1]) + (40.9 - 2.28) * along[2] * along)
    np.testing.assert_allclose(
        wrench[3:], oracle.MU0 * np.cross(moment, field), rtol=0.05, atol=1e-4 * np.abs(wrench[3:]).max()
    )
    np.testing.assert_allclose(wrench[:3], 0.0, atol=1e-6 * np.abs(wrench).max() / 0.05)
    # bitwise equal when repeated, and from a graph
    again = model.state()
    magnetics.reset()
    with wp.ScopedCapture(device=device) as capture:
        magnetics.apply(again)
    again.clear_forces()
    wp.capture_launch(capture.graph)
    np.testing.assert_array_equal(again.body_f.numpy()[0], wrench)


def test_bodies_of_one_shape_share_a_table_and_balls_have_none(device):
    builder = newton.ModelBuilder()
    warpmag.register_attributes(builder)
    for k in range(3):
        add_needle(builder, wp.quat_identity(), (0.1 * k, 0.0, 0.0))
    magnetics = warpmag.Magnetics(builder.finalize(device=device))
    couplings = {id(magnet.lattice.coupling) for magnet in magnetics.magnets}
    assert len(couplings) == 1
    assert len(magnetics.system.rotations) == 3
    balls = newton.ModelBuilder()
    warpmag.register_attributes(balls)
    body = balls.add_body()
    balls.add_shape_sphere(body, radius=0.01)
    warpmag.add_inducible(balls, body=body)
    assert warpmag.Magnetics(balls.finalize(device=device)).system.rotations is None


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
