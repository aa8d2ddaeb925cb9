"""Fields and steps of bodies of cells as a whole: few evaluations, the same solution, in any world."""

import math

import newton
import numpy as np
import pytest
import warp as wp
from scipy.spatial.transform import Rotation

import warpmag
from bench.systems import moment_system
from tests.cell_bodies import posed
from warpmag.moments import body_products
from warpmag.moments import system as system_module
from warpmag.shapes import demagnetization, lattice
from warpmag.shapes.body_response import MOST_CELLS, own_field, residual_response
from warpmag.shapes.linear_cells import with_slopes
from warpmag.shapes.uniform_response import cell_matrix

FIELD = (3e3, -2e3, 5e3)  # A/m, far from saturation


def coupled(body):
    return with_slopes(demagnetization.coupling(body, body.radii), body)


def filled(sides, spacing):
    """Return the lattice of a box and its coupling."""
    body = lattice.fill(lattice.box(sides), spacing, together=True)
    return body, coupled(body)


STROKE, OTHER, FOOT = (
    ((0.002, 0.008, 0.002), (0.0, 0.0, 0.0)),
    ((0.006, 0.002, 0.002), (0.0, 0.010, 0.0)),
    ((0.004, 0.002, 0.002), (0.006, -0.006, 0.0)),
)
BODIES = {  # boxes, and the bits of the mirrors: of a block, a rod, a letter T, a foot on the T, boxes above each other
    "block": ([STROKE], 0b111),
    "rod of one cell across": ([((0.008, 0.0005, 0.0005), (0.0, 0.0, 0.0))], 0b111),  # no cell has parity 0b110
    "T": ([STROKE, OTHER], 0b101),
    "T with a foot": ([STROKE, OTHER, FOOT], 0b100),
    "none": ([STROKE, ((0.003, 0.002, 0.002), (0.003, 0.010, 0.002)), FOOT], 0),
}


def product_by_parities(operator, tables, vectors):
    """Return the products of the tables of all parities with vectors of cells, shape [n, 3]."""
    parities = [parity for parity in range(8) if not parity & ~operator.mirrors]
    result = np.zeros(vectors.shape)
    for table, parity in zip(tables, parities, strict=True):

        def signs(mirror, parity=parity):  # a mirror reverses the component across it
            odd = [(mirror & (parity ^ (1 << axis & operator.mirrors))).bit_count() for axis in range(3)]
            return (-1.0) ** np.array(odd)

        part = sum(vectors[operator.images[mirror]] * signs(mirror) for mirror in parities) / len(parities)
        product = np.einsum("iajb,jb->ia", table, part)
        parts = np.zeros(vectors.shape)
        for mirror in parities:
            parts[operator.images[mirror]] = product * signs(mirror)
        result += parts
    return result


def interactions(body, coupling):
    """Return 1/3 + T between cells with the opposite sign, symmetrized by volumes, shape [3 n, 3 n]."""
    root = np.sqrt(body.volumes)
    operator = cell_matrix(coupling, body)
    return operator - np.einsum("i,ab,j->iajb", root, coupling.common, root).reshape(operator.shape)


@pytest.mark.parametrize("name", BODIES)
def test_tables_of_parities_have_the_response_of_the_dense_inverse(name):
    """The table of each parity acts on sums over the images of cells; bfloat16 has 8 bits."""
    boxes, mirrors = BODIES[name]
    body = lattice.fill(posed(*boxes), 0.0015, together=True)
    coupling, count = coupled(body), len(body.volumes)
    response = residual_response(coupling)
    assert response.mirrors == mirrors and len(response.tables) == 2 ** mirrors.bit_count()
    root = np.sqrt(body.volumes)
    unit = np.eye(3 * count)
    dense = np.linalg.inv(1.01 * unit + 3.0 * (interactions(body, coupling) - unit / 3.0))
    vectors = np.random.default_rng(2).normal(size=(count, 3))
    exact = (dense @ (np.repeat(root, 3) * vectors.ravel())).reshape(-1, 3) / root[:, None] - vectors
    tables = (response.tables.astype(np.uint32) << 16).view(np.float32).astype(float)
    result = product_by_parities(response, tables, vectors)
    assert np.linalg.norm(result - exact) <= 2.0**-8 * np.linalg.norm(exact)


@pytest.mark.parametrize("name", BODIES)
def test_tables_of_parities_have_the_field_of_the_moments(name):
    boxes, mirrors = BODIES[name]
    body = lattice.fill(posed(*boxes), 0.0025, together=True)
    coupling = coupled(body)
    field = own_field(coupling)
    assert field is not None and field.mirrors == mirrors
    moments, root = np.random.default_rng(2).normal(size=(len(body.volumes), 3)), np.repeat(np.sqrt(body.volumes), 3)
    exact = moments.ravel() / root / 3.0 - interactions(body, coupling) @ (moments.ravel() / root)
    result = product_by_parities(field, field.tables, moments)
    np.testing.assert_allclose(result.ravel(), exact / root, rtol=0.0, atol=1e-12 * np.abs(exact / root).max())


def test_a_large_body_without_mirrors_has_no_table_of_its_field():
    body = lattice.fill(posed(*BODIES["none"][0]), 0.001, together=True)
    assert len(body.volumes) > 211  # 9 n² elements are more than 400,000
    assert own_field(coupled(body)) is None


def worlds_of_a_plate(device, **options):
    """Return a system of three worlds, each with an iron plate turned differently and a permanent dipole."""
    body, coupling = filled((0.01, 0.008, 0.0015), 0.0015)
    n, turns = len(body.radii) + 1, Rotation.random(3, random_state=1)
    system = moment_system(
        radii=np.tile(np.append(body.radii, 0.0), 3), worlds=np.repeat(np.arange(3), n),
        permanent=np.tile(np.arange(n) == n - 1, 3), bodies=np.repeat(np.arange(6), [n - 1, 1] * 3),
        couplings=[(n * world, coupling) for world in range(3)], external_field=FIELD,
        susceptibility=math.inf, saturation=1e9, device=device, **options,
    )  # fmt: skip
    places = [turn.apply(np.append(body.positions, [[0.002, 0.003, 0.009]], axis=0)) for turn in turns]
    system.positions.assign(np.concatenate(places))
    moments = np.zeros((3 * n, 3))
    moments[n - 1 :: n] = 0.01, 0.02, -0.03
    system.moments.assign(moments)
    system.rotations.assign(turns.as_quat())
    return system


@pytest.mark.parametrize("dtype", ["float32", "float64"])
def test_fields_by_tables_equal_sums_over_pairs(device, monkeypatch, dtype):
    system = worlds_of_a_plate(device, dtype=dtype)
    with monkeypatch.context() as context:
        context.setattr(system_module, "make_body_fields", lambda *_: None)
        pairs = worlds_of_a_plate(device, dtype=dtype)
    assert system._body_fields is not None and pairs._body_fields is None
    for each in (system, pairs):
        each.solve()
        assert each.converged.numpy().all()
    pairs.moments.assign(system.moments.numpy())
    for each in (system, pairs):
        each.evaluate_again()
    actual, expected = system.h.numpy(), pairs.h.numpy()
    # rounding of sums over 112 cells, and of positions on the order of cells
    assert np.linalg.norm(actual - expected) < 100.0 * np.finfo(dtype).eps * np.linalg.norm(expected)


def test_tables_of_many_kinds_of_bodies_are_left_out(device, monkeypatch):
    monkeypatch.setattr(body_products, "_MOST_BYTES", 1000)
    assert worlds_of_a_plate(device)._body_fields is None


def test_worlds_at_rest_keep_their_field(device):
    system = worlds_of_a_plate(device)
    system.solve()
    before = system.h.numpy().copy()
    system.resting.assign([0, 1, 0])
    system.external_field.assign(2.0 * system.external_field.numpy())
    system.solve()
    changed = (system.h.numpy() != before).any(axis=1).reshape(3, -1).any(axis=1)
    assert changed.tolist() == [True, False, True]


@pytest.mark.parametrize(
    ("sides", "spacing", "evaluations"),
    [((0.03, 0.03, 0.0015), 0.003, 12), ((0.005, 0.004, 0.0045), 0.0012, 8), ((0.03, 0.001, 0.001), 0.0009, 8)],
    ids=["plate", "block", "rod"],
)
def test_a_lone_body_is_solved_in_few_evaluations(sides, spacing, evaluations, device):
    """The solution is that of the dense matrix of the body, to the tolerance in the energy norm.

    The bounds are 1.3 times the evaluations on a CPU: rounding differs between devices.
    """
    body, coupling = filled(sides, spacing)
    assert 64 < len(body.volumes) <= MOST_CELLS
    system = moment_system(
        radii=body.radii, bodies=np.zeros(len(body.radii), int), couplings=[(0, coupling)], external_field=FIELD,
        susceptibility=math.inf, saturation=1e9, rtol=1e-4, device=device,
    )  # fmt: skip
    system.positions.assign(body.positions)
    system.rotations.assign(np.array([[0.0, 0.0, 0.0, 1.0]]))
    system.solve()
    assert system.converged.numpy()[0] and system.evaluations.numpy()[0] <= evaluations
    root = np.repeat(np.sqrt(body.volumes), 3)
    matrix = cell_matrix(coupling.among(1, balls=False), body)
    exact = np.linalg.solve(matrix, root * np.tile(FIELD, len(body.volumes)))
    error = root * system.magnetizations().numpy().astype(float).ravel() - exact
    work = exact @ (root * np.tile(FIELD, len(body.volumes)))
    assert error @ matrix @ error <= (3e-4) ** 2 * work  # rtol, and rounding of float32


def worlds_of_bars(turns, device):
    """Return the magnetics and the magnetizations of a bar and a plate in each world, turned, in a uniform field."""
    builder = newton.ModelBuilder()
    warpmag.register_attributes(builder)
    for turn in turns:
        builder.begin_world()
        for half, spacing, x in (((0.01, 0.002, 0.002), 0.0015, 0.0), ((0.008, 0.008, 0.001), 0.0018, 0.03)):
            body = builder.add_body(xform=wp.transform((x, 0.0, 0.0), wp.quat(*turn)))
            builder.add_shape_box(body, hx=half[0], hy=half[1], hz=half[2])
            warpmag.add_inducible(builder, body=body, material="1010-steel", moment_spacing=spacing)
        builder.end_world()
    model = builder.finalize(device=device)
    magnetics = warpmag.Magnetics(model, external_field=(0.0, 0.0, 2e4), rtol=1e-5)
    magnetics.apply(model.state())
    assert magnetics.converged.numpy().all()
    return magnetics.system.magnetizations().numpy().reshape(len(turns), -1, 3)


def test_bodies_that_share_a_table(device):
    """Groups of bodies on a GPU, one of them not full, have the solutions of single worlds."""
    turns = Rotation.random(19, random_state=4).as_quat()
    together = worlds_of_bars(turns, device)
    for world in (0, 7, 8, 18):
        alone = worlds_of_bars(turns[world : world + 1], device)[0]
        np.testing.assert_allclose(together[world], alone, atol=1e-4 * np.abs(alone).max())
