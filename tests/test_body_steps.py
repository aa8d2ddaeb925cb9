"""Steps of the induction solve for bodies of cells as a whole: few evaluations, the same solution, in any world."""

import math

import newton
import numpy as np
import pytest
import warp as wp
from scipy.spatial.transform import Rotation

import warpmag
from bench.systems import moment_system
from tests.cell_bodies import posed
from warpmag.shapes import demagnetization, lattice
from warpmag.shapes.body_response import MOST_CELLS, residual_response
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


@pytest.mark.parametrize("name", BODIES)
def test_tables_of_parities_have_the_response_of_the_dense_inverse(name):
    """The table of each parity acts on sums over the images of cells; bfloat16 has 8 bits."""
    boxes, mirrors = BODIES[name]
    body = lattice.fill(posed(*boxes), 0.0015, together=True)
    coupling, count = coupled(body), len(body.volumes)
    response = residual_response(coupling)
    assert response.mirrors == mirrors and len(response.tables) == 2 ** mirrors.bit_count()
    root = np.sqrt(body.volumes)
    operator = cell_matrix(coupling, body)  # symmetrized by volumes
    common = np.einsum("i,ab,j->iajb", root, coupling.common, root).reshape(operator.shape)
    dense = np.linalg.inv(1.01 * np.eye(len(operator)) + 3.0 * (operator - common - np.eye(len(operator)) / 3.0))
    vectors = np.random.default_rng(2).normal(size=(count, 3))
    exact = (dense @ (np.repeat(root, 3) * vectors.ravel())).reshape(-1, 3) / root[:, None] - vectors
    tables = (response.tables.astype(np.uint32) << 16).view(np.float32).astype(float)
    parities = [parity for parity in range(8) if not parity & ~mirrors]
    result = np.zeros((count, 3))
    for table, parity in zip(tables, parities, strict=True):

        def signs(mirror, parity=parity):  # a mirror reverses the component across it
            odd = [(mirror & (parity ^ (1 << axis & mirrors))).bit_count() for axis in range(3)]
            return (-1.0) ** np.array(odd)

        part = sum(vectors[response.images[mirror]] * signs(mirror) for mirror in parities) / len(parities)
        product = np.einsum("iajb,jb->ia", table, part)
        parts = np.zeros((count, 3))
        for mirror in parities:
            parts[response.images[mirror]] = product * signs(mirror)
        result += parts
    assert np.linalg.norm(result - exact) <= 2.0**-8 * np.linalg.norm(exact)


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
