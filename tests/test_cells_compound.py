"""Inducible bodies of several shapes magnetize as one: their moments, and the operator of their cells."""

import math

import newton
import numpy as np
import pytest
import warp as wp
from cell_bodies import FAINT, TURN, coupled, demagnetizing_matrix, filled, make_system, polarizability, posed

import warpmag
from bench.reference import surface_integrals
from warpmag.shapes import demagnetization, lattice

L_SHAPE = posed(([1.0, 1.0, 3.0], [0.0, 0.0, 3.0]), ([2.0, 1.0, 1.0], [3.0, 0.0, 1.0]))


def test_halves_of_a_box_are_the_box(device):
    """Cells are equal: differences are the residual and rounding."""
    half, at = [1.0, 1.0, 5.0], [0.0, 0.0, 5.0]
    turned = lattice.box([5.0, 1.0, 1.0]).posed([0.0, 0.0, -5.0], [0.0, math.sqrt(0.5), 0.0, math.sqrt(0.5)])
    whole = polarizability(filled([lattice.box([1.0, 1.0, 10.0])]), math.inf, device, rtol=1e-5)
    halves = filled([lattice.box(half).posed(at), turned])
    np.testing.assert_allclose(np.bincount(halves.owners, halves.volumes), [40.0, 40.0], rtol=1e-12)
    np.testing.assert_allclose(polarizability(halves, math.inf, device, rtol=1e-5), whole, rtol=1e-3)


def test_an_l_of_two_boxes_takes_the_moment_of_a_surface_integral_equation(device):
    """5 % as for rods and sheets, at 5 cells across; the reference is good to 0.3 %."""
    body = filled(L_SHAPE)
    corners = [
        (np.array(lower), np.array(upper)) for lower, upper in (((-1, -1, 0), (1, 1, 6)), ((1, -1, 0), (5, 1, 2)))
    ]
    faces = [((1, -1, 2), (1, 1, 6))]
    for lower, upper in corners:
        for axis, end in np.ndindex(3, 2):
            face = np.array([lower, upper])
            face[:, axis] = (lower, upper)[end][axis]
            if axis != 0 or face[0, 0] != 1:  # where the boxes touch
                faces.append(face)
    expected = surface_integrals.permeable_moments(faces, 40.0, 8)
    for axis in (0, 2):
        system = make_system(body, susceptibility=math.inf, external_field=1e3 * np.eye(3)[axis], device=device)
        system.solve()
        moment = system.moments.numpy().sum(axis=0) / (1e3 * body.volumes.sum())
        assert np.linalg.norm(moment - expected[axis]) < 0.05 * np.linalg.norm(expected[axis])


def test_parts_apart_are_dipoles_to_each_other(device):
    """Two cubes 100 sides apart in two corners of a common grid of 10 million cells."""
    body = filled(posed(([0.01] * 3, [0.0] * 3), ([0.01] * 3, [1.0, -1.5, 2.0])))
    cube = filled([lattice.box([0.01] * 3)], 0.02 / 7)
    coupling = demagnetization.coupling(body, body.radii)
    assert len(coupling.other) == 2 * len(demagnetization.coupling(cube, cube.radii).other)
    expected = polarizability(cube, math.inf, device)
    np.testing.assert_allclose(polarizability(body, math.inf, device), expected, rtol=2e-3)  # rtol of the solves


@pytest.mark.parametrize("spacing", [8.0, 20.0, 1e10, 1e38])
def test_a_spacing_larger_than_the_body_is_as_large_as_the_body(spacing):
    """The L is 6 m wide. A spacing of 1e38 m once overflowed, and 1e10 m had a single test point."""
    body, expected = (lattice.fill(L_SHAPE, value, together=True) for value in (spacing, 6.0))
    np.testing.assert_array_equal(body.positions, expected.positions)
    np.testing.assert_array_equal(body.volumes, expected.volumes)
    builder = newton.ModelBuilder()
    warpmag.register_custom_attributes(builder)
    magnet = builder.add_body()
    for solid in L_SHAPE:
        builder.add_shape_box(magnet, xform=(solid.position, (0.0, 0.0, 0.0, 1.0)), hx=1.0, hy=1.0, hz=1.0)
    warpmag.add_inducible(builder, body=magnet, saturation=1.7e6, moment_spacing=spacing)
    (magnet,) = warpmag.Magnetics(builder.finalize(device="cpu")).magnets
    assert np.isfinite(magnet.lattice.coupling.common).all()


@pytest.mark.parametrize(
    "solids",
    [
        L_SHAPE,
        [lattice.cylinder(1.0, 10.0), lattice.box([4.0, 1.5, 1.5]).posed([0.0, 0.0, 11.0])],
        [lattice.cylinder(1.0, 4.0), lattice.box([3.0, 1.5, 1.5]).posed([0.0, 0.0, 4.0], TURN)],
        [lattice.sphere(1.0), lattice.box([2.0, 2.0, 0.002]).posed([0.0, 0.0, 2.0], TURN)],
        [lattice.box([1.0] * 3), lattice.box([0.01, 0.01, 0.02]).posed([0.0, 0.0, 1.02])],
        [lattice.sphere(1.0), lattice.sphere(0.5).posed([0.2, 0.0, 0.0]), lattice.capsule(0.2, 2.0)],
    ],
    ids=["L", "hammer", "crooked hammer", "foil", "screw", "inner"],
)  # fmt: skip
def test_operator_of_several_shapes_is_positive(solids):
    """The volume is that of the union of the shapes, to the resolution of the test points."""
    body = filled(solids, (solids[0].volume / 100.0) ** (1 / 3))
    values = np.linalg.eigvalsh(demagnetizing_matrix(body, coupled(body, solids)))
    assert values[0] > 0.0
    assert values[-1] < 1.0
    owned = np.bincount(body.owners, body.volumes, len(solids))
    assert owned[0] == pytest.approx(solids[0].volume, rel=1e-12)  # the first shape has its whole volume
    assert (owned[1:] <= [solid.volume * (1 + 1e-12) for solid in solids[1:]]).all()
    if solids[0].name != "cylinder" and len(solids) == 2:
        assert owned[1] == pytest.approx(solids[1].volume, rel=1e-12)


def test_shapes_of_one_body_magnetize_as_one(device):
    """In a model a rod of two boxes has the moment of the rod, and reports the share of each shape."""
    moments = []
    for parts in (1, 2):
        builder = newton.ModelBuilder()
        warpmag.register_attributes(builder)
        body = builder.add_body()
        for k in range(parts):
            frame = wp.transform((0.0, 0.0, 0.05 * (2 * k + 1 - parts)), wp.quat_identity())
            builder.add_shape_box(body, xform=frame, hx=0.01, hy=0.01, hz=0.1 / parts)
        warpmag.add_inducible(builder, body=body, saturation=FAINT / 1e3)
        model = builder.finalize(device=device)
        magnetics = warpmag.Magnetics(model, external_field=(0.0, 0.0, 1e3))
        magnetics.apply(model.state())
        shares = magnetics.shape_moments()[:, 2]
        assert len(shares) == parts
        np.testing.assert_allclose(shares, shares.mean(), rtol=2e-3)  # rtol of the solve
        moments.append(shares.sum() / (8e-5 * 1e3))
    rod = surface_integrals.box_moments((1.0, 1.0, 10.0), [math.inf])[0, 2]
    assert moments[0] == pytest.approx(rod, rel=0.05)
    assert moments[1] == pytest.approx(moments[0], rel=4e-3)
