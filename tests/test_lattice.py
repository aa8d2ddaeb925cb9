"""Lattices of moments against closed forms of the solids they stand for, and against magpylib's exact fields."""

from dataclasses import replace

import magpylib
import numpy as np
import pytest

from warpmag.errors import InputError
from warpmag.shapes import cell_grid, facets, lattice

TILT = (0.3, -0.2, 0.5, 0.7)

BOX_FACES = np.array([[int(k) for k in t] for t in "021 123 456 576 014 154 263 367 042 246 135 375".split()])


def box_mesh(half_extents, center=(0.0, 0.0, 0.0)):
    corners = np.array([[x, y, z] for z in (-1, 1) for y in (-1, 1) for x in (-1, 1)], float)
    return corners * half_extents + center, BOX_FACES


def prism(outline, triangles, height):
    """Closed mesh of a polygon [m] (counter-clockwise, with its triangulation) drawn out along z."""
    n = len(outline)
    vertices = np.concatenate([np.c_[outline, np.full(n, z)] for z in (0.0, height)])
    sides = [t for k in range(n) for t in ((k, (k + 1) % n, n + k), ((k + 1) % n, n + (k + 1) % n, n + k))]
    return vertices, np.array([t[::-1] for t in triangles] + [tuple(n + i for i in t) for t in triangles] + sides)


def torus_mesh(major, minor, count=48):
    u, v = np.meshgrid(*[2.0 * np.pi * np.arange(count) / count] * 2, indexing="ij")
    ring = major + minor * np.cos(v)
    vertices = np.stack([ring * np.cos(u), ring * np.sin(u), minor * np.sin(v)], axis=-1).reshape(-1, 3)
    i, j = np.divmod(np.arange(count * count), count)
    a, b = i * count + j, (i + 1) % count * count + j
    c, d = (i + 1) % count * count + (j + 1) % count, i * count + (j + 1) % count
    return vertices, np.concatenate([np.c_[a, b, c], np.c_[a, c, d]])


def centroid(body):
    return body.volumes @ body.positions / body.volumes.sum()


def second_moments(body):
    """Second moments of the moments about the origin, ⟨x xᵀ⟩ [m²]."""
    return np.einsum("n,nk,nl->kl", body.volumes, body.positions, body.positions) / body.volumes.sum()


def dipole_field(body, magnetization, targets):
    r = targets[:, None, :] - body.positions
    d = np.linalg.norm(r, axis=2, keepdims=True)
    m = body.volumes[:, None] * magnetization
    return ((3.0 * r * (r * m).sum(axis=2, keepdims=True) / d**5) - m / d**3).sum(axis=1) / (4.0 * np.pi)


def l2(values, exact):
    return np.linalg.norm(values - exact) / np.linalg.norm(exact)


R, H = 0.01, 0.016
CAPSULE_CAPS = (4.0 / 3.0 * R) / (2.0 * H + 4.0 / 3.0 * R)  # share of the volume
SOLIDS = {
    "box": (lattice.box([0.02, 0.01, 0.03]), 8 * 6e-6, 0.0, np.array([4e-4, 1e-4, 9e-4]) / 3),
    "sphere": (lattice.sphere(R), 4 / 3 * np.pi * R**3, 0.0, np.full(3, R**2 / 5)),
    "ellipsoid": (lattice.ellipsoid([R, 2 * R, 3 * R]), 8 * np.pi * R**3, 0.0, np.array([1, 4, 9]) * R**2 / 5),
    "cylinder": (lattice.cylinder(R, H), 2 * np.pi * R**2 * H, 0.0, np.array([R**2 / 4, R**2 / 4, H**2 / 3])),
    "cone": (
        lattice.cone(R, H),
        2 / 3 * np.pi * R**2 * H,
        -H / 2,
        np.array([3 * R**2 / 20, 3 * R**2 / 20, 3 * (2 * H) ** 2 / 80 + H**2 / 4]),
    ),
    "capsule": (
        lattice.capsule(R, H),
        np.pi * R**2 * (2 * H + 4 / 3 * R),
        0.0,
        np.array(
            [(1 - CAPSULE_CAPS) * R**2 / 4 + CAPSULE_CAPS * R**2 / 5] * 2
            + [(1 - CAPSULE_CAPS) * H**2 / 3 + CAPSULE_CAPS * (H**2 + 0.75 * H * R + R**2 / 5)]
        ),
    ),
}


@pytest.mark.parametrize("name", SOLIDS)
def test_volume_and_centroid_are_exact_and_second_moments_approach_the_solid(name):
    solid, volume, height, second = SOLIDS[name]
    body = lattice.fill(solid)
    assert 0.5 * lattice.AUTOMATIC_COUNT < len(body.volumes) <= lattice.AUTOMATIC_COUNT
    assert body.volumes.sum() == pytest.approx(volume, rel=1e-12)
    np.testing.assert_allclose(centroid(body), [0.0, 0.0, height], atol=1e-12 * H)
    # what a cell of side a lacks is its own a²/12; 5e-3 of the body's second moments is what the fine test grid
    # (32 points across, error 1/32² of a radius squared and below) may add
    cell = np.cbrt(body.volumes.mean())
    lacking = second - second_moments(body)[range(3), range(3)]
    np.testing.assert_allclose(lacking, cell**2 / 12, atol=0.15 * cell**2 / 12 + 5e-3 * second.max())
    off_diagonal = second_moments(body) - np.diag(second_moments(body).diagonal())
    np.testing.assert_allclose(off_diagonal, 0.0, atol=1e-12 * second.max())
    assert body.volumes.min() >= 0.31 * np.median(body.volumes)  # no slivers; whole cells are in the majority


def test_a_box_is_filled_by_equal_cells():
    body = lattice.fill(lattice.box([0.02, 0.01, 0.03]), 0.011)
    assert len(body.volumes) == 4 * 2 * 5
    np.testing.assert_allclose(body.volumes, 48e-6 / 40, rtol=1e-12)
    np.testing.assert_allclose(np.unique(body.positions[:, 1].round(12)), [-0.005, 0.005])


def test_radii_hold_the_volumes():
    body = lattice.fill(lattice.sphere(R), 0.004)
    np.testing.assert_allclose(4 / 3 * np.pi * body.radii**3, body.volumes, rtol=1e-12)
    np.testing.assert_allclose((2 * body.inner_radii) ** 3, body.volumes, rtol=1e-12)


@pytest.mark.parametrize(
    "name, magnet",
    [
        ("box", magpylib.magnet.Cuboid(dimension=(0.04, 0.04, 0.04))),
        ("cylinder", magpylib.magnet.Cylinder(dimension=(0.04, 0.04))),
    ],
)
def test_field_of_the_automatic_lattice_is_that_of_the_solid(name, magnet):
    """Bounds: twice the figures of the module's docstring, 2e-4 (box) and 2e-3 (cylinder) at 0.2 of the side."""
    solid = {"box": lattice.box([0.02] * 3), "cylinder": lattice.cylinder(0.02, 0.02)}[name]
    magnet.magnetization = (3e5, 0.0, 1e6)
    direction = np.random.default_rng(0).normal(size=(500, 3))
    targets = 0.028 * direction / np.abs(direction).max(axis=1, keepdims=True)  # on the cube 0.2 sides further out
    body = lattice.fill(solid)
    error = l2(dipole_field(body, magnet.magnetization, targets), magnet.getH(targets))
    assert error < {"box": 4e-4, "cylinder": 4e-3}[name]


def test_field_turns_with_the_body():
    targets = np.random.default_rng(1).normal(size=(50, 3)) * 0.1
    solid = lattice.cone(R, H)
    turn = solid.posed((0.0, 0.0, 0.0), TILT).rotation
    np.testing.assert_allclose(turn @ turn.T, np.eye(3), atol=1e-14)
    assert np.linalg.det(turn) == pytest.approx(1.0)
    m = np.array([1e6, 2e5, -4e5])
    still = dipole_field(lattice.fill(solid), m, targets)
    turned = dipole_field(lattice.fill(solid.posed((0.0, 0.0, 0.0), TILT)), turn @ m, targets @ turn.T)
    assert l2(turned, still @ turn.T) < 1e-12


def test_quaternion_order_is_x_y_z_w():
    quarter = np.sqrt(0.5)
    body = lattice.fill(lattice.cone(R, H).posed((0.1, 0.0, 0.0), (0.0, quarter, 0.0, quarter)))
    np.testing.assert_allclose(centroid(body), [0.1 - H / 2, 0.0, 0.0], atol=1e-15)  # z turned to x


def test_mesh_of_a_box_is_the_box():
    h = [0.02, 0.01, 0.03]
    vertices, faces = box_mesh(h, center=(5.0, -3.0, 2.0))
    body, exact = lattice.fill(lattice.mesh(vertices, faces), 0.005), lattice.fill(lattice.box(h), 0.005)
    np.testing.assert_allclose(body.volumes, exact.volumes, rtol=1e-9)
    np.testing.assert_allclose(body.positions - [5.0, -3.0, 2.0], exact.positions, atol=1e-12)


def test_mesh_orientation_and_split_vertices_do_not_matter():
    vertices, faces = box_mesh([0.02, 0.01, 0.03])
    corners = vertices[faces[:, ::-1].reshape(-1)].astype(np.float32)
    body = lattice.fill(lattice.mesh(corners, np.arange(36)), 0.01)
    exact = lattice.fill(lattice.box([0.02, 0.01, 0.03]), 0.01)
    np.testing.assert_allclose(body.positions, exact.positions, atol=1e-8)  # float32 corners


def test_concave_mesh():
    outline = np.array([[0, 0], [3, 0], [3, 1], [1, 1], [1, 2], [0, 2]]) * 0.01
    triangles = [(0, 1, 2), (0, 2, 3), (0, 3, 4), (0, 4, 5)]
    solid = lattice.mesh(*prism(outline, triangles, 0.01))
    body = lattice.fill(solid, 0.0025)
    assert body.volumes.sum() == pytest.approx(4e-6, rel=1e-12)
    assert len(body.volumes) == 4 * 4**3
    np.testing.assert_allclose(centroid(body), [0.0125, 0.0075, 0.005], atol=1e-12)
    notch = (body.positions[:, 0] > 0.01) & (body.positions[:, 1] > 0.01)
    assert not notch.any()


@pytest.mark.parametrize("across", [1, lattice.LEAST_ACROSS])
@pytest.mark.parametrize("stroke", [0.004, 0.0037])
def test_cells_fit_the_strokes_of_a_letter(stroke, across):
    """The letter L: whole cells alone, where the number of cells would put its inner faces inside of cells."""
    outline = np.array([[0, 0], [3, 0], [3, 1], [1, 1], [1, 5], [0, 5]]) * stroke
    solid = lattice.mesh(*prism(outline, [(0, 1, 2), (0, 2, 3), (0, 3, 4), (0, 4, 5)], 0.004))
    expected = [[0, stroke, 0.016 * stroke], [1, stroke, 0.008 * stroke]]
    np.testing.assert_allclose(solid.steps, expected, rtol=2e-5, atol=1e-12)
    body = lattice.fill(solid, 0.0, across, together=True)
    cell = body.pieces[0].sides.prod()
    assert 0.5 * lattice.AUTOMATIC_COUNT < len(body.volumes) <= lattice.AUTOMATIC_COUNT
    np.testing.assert_allclose(body.volumes, cell, rtol=1e-9)


def test_a_mesh_that_is_asked_about_no_point():
    """As a part of a body whose other parts are elsewhere: it raised an error of NumPy."""
    solid = lattice.mesh(*box_mesh((0.01, 0.01, 0.01)))
    assert not solid.contains(np.full((5, 3), 1.0)).any()
    assert solid.contains(np.zeros((0, 3))).shape == (0,)


def test_facets_leave_out_triangles_without_area():
    """Polygons with a straight corner have such triangles, which have no normal."""
    outline = np.array([[0, 0], [1, 0], [3, 0], [3, 2], [0, 2]]) * 0.01
    vertices, faces = prism(outline, [(0, 1, 2), (0, 2, 3), (0, 3, 4)], 0.01)
    solid = lattice.mesh(vertices, faces)
    normals, areas = facets.normals_and_areas(solid.facets(200))
    np.testing.assert_allclose(np.linalg.norm(normals, axis=1), 1.0, rtol=1e-12)
    assert areas.sum() == pytest.approx(2 * 6e-4 + 10e-2 * 0.01, rel=1e-12)
    np.testing.assert_allclose(areas @ normals, 0.0, atol=1e-16)


def test_torus_mesh_and_its_inside():
    major, minor = 0.02, 0.008
    solid = lattice.mesh(*torus_mesh(major, minor))
    points = np.random.default_rng(2).uniform(-0.03, 0.03, size=(20000, 3))
    distance = np.hypot(np.hypot(points[:, 0], points[:, 1]) - major, points[:, 2])
    clear = np.abs(distance - minor) > 0.005 * major  # the facets lie up to 1 − cos(π/48) of a radius deeper
    np.testing.assert_array_equal(solid.contains(points)[clear], (distance < minor)[clear])
    body = lattice.fill(solid)
    assert body.volumes.sum() == pytest.approx(2 * np.pi**2 * major * minor**2, rel=1e-2)
    np.testing.assert_allclose(centroid(body), 0.0, atol=1e-12)


def test_rays_through_edges_and_vertices_count_once():
    solid = lattice.mesh(*box_mesh([0.02] * 3))
    points = np.stack(np.meshgrid(*[np.linspace(-0.03, 0.03, 13)] * 3, indexing="ij"), axis=-1).reshape(-1, 3)
    off_faces = (np.abs(np.abs(points) - 0.02) > 1e-9).all(axis=1)
    np.testing.assert_array_equal(solid.contains(points)[off_faces], (np.abs(points) < 0.02).all(axis=1)[off_faces])
    assert solid.contains(np.array([[0.0, 0.0, 0.0], [0.01, 0.01, -0.019], [0.01, -0.01, 0.0]])).all()  # on diagonals


def test_shells_of_one_mesh():
    outer, faces = box_mesh([0.02] * 3)
    inner = box_mesh([0.01] * 3)[0]
    hollow = lattice.mesh(np.concatenate([outer, inner]), np.concatenate([faces, faces[:, ::-1] + 8]))
    body = lattice.fill(hollow, 0.005)
    assert body.volumes.sum() == pytest.approx(64e-6 - 8e-6, rel=1e-12)
    assert (np.abs(body.positions) > 0.01).any(axis=1).all()
    crossing = box_mesh([0.02] * 3, center=(0.02, 0.0, 0.0))[0]
    joined = lattice.mesh(np.concatenate([outer, crossing]), np.concatenate([faces, faces + 8]))
    assert lattice.fill(joined, 0.005).volumes.sum() == pytest.approx(96e-6, rel=0.02)  # half a test cell of 1/32


def test_shapes_that_touch_add_up():
    parts = [lattice.box([0.03, 0.01, 0.01]), lattice.box([0.01, 0.02, 0.01]).posed((0.0, 0.03, 0.0))]
    body = lattice.fill(parts, 0.005)
    assert body.volumes.sum() == pytest.approx(24e-6 + 16e-6, rel=1e-12)
    np.testing.assert_allclose(np.bincount(body.owners, body.volumes), [24e-6, 16e-6], rtol=1e-12)
    np.testing.assert_allclose(centroid(body), [0.0, 16 * 0.03 / 40, 0.0], atol=1e-12)


def test_overlapping_shapes_count_once():
    parts = [lattice.box([0.03, 0.01, 0.01]), lattice.box([0.01, 0.03, 0.01]), lattice.box([0.03, 0.01, 0.01])]
    body = lattice.fill(parts, 0.005)
    assert body.volumes.sum() == pytest.approx(24e-6 + 24e-6 - 8e-6, rel=1e-12)  # cells and cuts coincide
    assert np.bincount(body.owners, minlength=3).tolist() == [192, 128, 0]
    lens = [lattice.sphere(R), lattice.sphere(R).posed((R, 0.0, 0.0), TILT)]
    common = 5 / 12 * np.pi * R**3
    # a test point in 32 across knows a cut to a fraction of its cell: well within 1 %
    assert lattice.fill(lens).volumes.sum() == pytest.approx(8 / 3 * np.pi * R**3 - common, rel=1e-2)
    np.testing.assert_allclose(centroid(lattice.fill(lens)), [R / 2, 0.0, 0.0], atol=2e-2 * R)


@pytest.mark.parametrize("name", SOLIDS)
def test_spacing_larger_than_the_shape_gives_one_moment_at_the_centroid(name):
    solid, volume, height, _ = SOLIDS[name]
    body = lattice.fill(solid, 1.0)
    assert len(body.volumes) == 1
    assert body.volumes[0] == pytest.approx(volume, rel=1e-12)
    np.testing.assert_allclose(body.positions[0], [0.0, 0.0, height], atol=1e-15)


def test_spacing_above_the_automatic_cells_gives_fewer_moments():
    """A ring of overlapping boxes, whose common volumes counted repeatedly are more than 729 cells at any spacing."""
    angles = 2.0 * np.pi * np.arange(12) / 12
    radial, size = np.stack([np.cos(angles), 0.0 * angles, np.sin(angles)], axis=1), [0.0015, 0.0025, 0.0035]
    turns = [(0.0, -np.sin(a / 2), 0.0, np.cos(a / 2)) for a in angles]
    ring = [lattice.box(size).posed(0.008 * at, turn) for at, turn in zip(radial, turns, strict=True)]
    automatic, given = (lattice.fill(ring, spacing, 3, together=True) for spacing in (0.0, 0.003))
    assert automatic.pieces[0].sides.max() < 0.003
    assert len(given.volumes) < 0.5 * len(automatic.volumes)
    # cells differ from cubes of the spacing by up to a factor, and parts of several shapes share cells
    assert len(given.volumes) < 2.0 * given.volumes.sum() / 0.003**3


def test_ball_is_one_moment():
    body = lattice.ball(0.005)
    assert body.radii[0] == pytest.approx(0.005, rel=1e-14)
    np.testing.assert_array_equal(body.positions, 0.0)


def test_thin_and_long_shapes_stay_within_the_automatic_count():
    for solid in (lattice.box([0.02, 0.02, 1e-5]), lattice.cylinder(1e-3, 0.5), lattice.sphere(0.02)):
        body = lattice.fill(solid)
        assert 0.4 * lattice.AUTOMATIC_COUNT < len(body.volumes) <= lattice.AUTOMATIC_COUNT
        assert body.volumes.sum() == pytest.approx(solid.volume, rel=1e-12)


@pytest.mark.parametrize(
    "call, named",
    [
        (lambda: lattice.fill(lattice.sphere(R), -1.0), "spacing"),
        (lambda: lattice.fill(lattice.sphere(R), float("nan")), "spacing"),
        (lambda: lattice.fill(lattice.sphere(R), 1e-6), "spacing"),
        (lambda: lattice.fill([]), "solids"),
        (lambda: lattice.ball(0.0), "radius"),
        (lambda: lattice.box([0.01, -0.01, 0.01]), "half_extents"),
        (lambda: lattice.box([0.01, 0.01]), "half_extents"),
        (lambda: lattice.cylinder(R, float("inf")), "half_height"),
        (lambda: lattice.sphere(R).posed((0.0, 0.0, float("nan"))), "position"),
        (lambda: lattice.sphere(R).posed((0.0, 0.0, 0.0), (0.0, 0.0, 0.0, 0.0)), "quaternion"),
        (lambda: lattice.mesh(*(box_mesh([R] * 3)[0], BOX_FACES[:-1])), "3 of 18 edges"),
        (lambda: lattice.mesh(box_mesh([R] * 3)[0], BOX_FACES + 1), "vertex outside 0 to 7"),
        (lambda: lattice.mesh(box_mesh([R, R, 0.0])[0], BOX_FACES), "no volume"),
        (lambda: lattice.mesh(np.full((8, 3), np.nan), BOX_FACES), "vertices"),
        (lambda: lattice.mesh(box_mesh([R] * 3)[0], BOX_FACES.astype(float)), "faces"),
    ],
)
def test_bad_input_is_named(call, named):
    with pytest.raises(InputError, match=named) as caught:
        call()
    assert "\n" not in str(caught.value)


def turned_solids():
    """Shapes in frames of their own, so that a common grid is along the axes of none of them but the largest."""
    return [lattice.box([0.03, 0.01, 0.01]), lattice.cone(0.01, 0.016).posed((0.02, 0.0, 0.0), TILT)]


@pytest.mark.parametrize("name", [*SOLIDS, "torus", "concave", "several"])
def test_points_along_the_axes_fill_the_cells_that_single_points_fill(name):
    """The grid of test points of a shape in its own frame, against the same points one by one."""
    outline = np.array([[0, 0], [3, 0], [3, 1], [1, 1], [1, 2], [0, 2]]) * 0.01
    meshes = {
        "torus": lattice.mesh(*torus_mesh(0.02, 0.008)),
        "concave": lattice.mesh(*prism(outline, [(0, 1, 2), (0, 2, 3), (0, 3, 4), (0, 4, 5)], 0.01)),
    }
    solids = turned_solids()[::-1] if name == "several" else [meshes.get(name) or SOLIDS[name][0]]
    cells = cell_grid.cells_over(solids, [], 0.004, 3)
    part, others = cells.solids[-1], cells.solids[:-1]
    one_by_one, along_axes = cells._hits(part, others), cells._hits_along_axes(part, others)
    assert one_by_one[1].sum() > 1000
    for expected, values in zip(one_by_one, along_axes, strict=True):
        np.testing.assert_array_equal(values, expected)


def filled_volumes(body):
    """Volume of the filled subcells of each moment of a body of one grid."""
    (part,) = body.pieces
    shares = part.share * part.filled.mean(axis=(1, 2, 3))[part.piece]
    return part.sides.prod() * np.bincount(part.moment, shares)


T = np.array([(5, 0), (9, 0), (9, 16), (14, 16), (14, 20), (0, 20), (0, 16), (5, 16)]) * 1e-3


@pytest.mark.parametrize("spacing", [0.0, 0.0012, 0.0017, 0.0031])
@pytest.mark.parametrize("name", ["sphere", "cylinder", "cone", "torus", "letter"])
def test_subcells_have_the_volumes_of_the_moments(name, spacing):
    """Fields of near cells are sums over subcells, those of distant cells are dipoles: both are of one volume."""
    solids = {
        "torus": lattice.mesh(*torus_mesh(0.02, 0.008)),
        "letter": lattice.mesh(*prism(T, [(0, 1, 2), (0, 2, 7), (2, 3, 4), (7, 2, 4), (7, 4, 5), (7, 5, 6)], 0.004)),
    }
    body = lattice.fill(solids.get(name) or SOLIDS[name][0], spacing, lattice.LEAST_ACROSS)
    np.testing.assert_allclose(filled_volumes(body), body.volumes, rtol=1e-6)  # of the mesh's volume


def test_subcells_of_intersecting_shapes_have_the_volumes_of_the_moments():
    """The total of the second box includes the part in the first one, which the second one does not fill."""
    solids = [lattice.box([0.012, 0.004, 0.003]), lattice.box([0.01, 0.003, 0.003]).posed((0.0, 0.0, 0.001), TILT)]
    body = lattice.fill(solids, 0.0016, together=True)
    np.testing.assert_allclose(filled_volumes(body), body.volumes, rtol=1e-9)


def test_blocks_of_test_points_never_show(monkeypatch):
    cells = cell_grid.cells_over([lattice.mesh(*torus_mesh(0.02, 0.008))], [], 0.002, 1)
    whole = cells.filled(0)
    for chunk in (1, 3000, 30000):  # a line of cells, a few lines, a few layers at a time
        monkeypatch.setattr(cell_grid, "_CHUNK", chunk)
        parts = cells.filled(0)
        np.testing.assert_array_equal(parts.index, whole.index)
        np.testing.assert_array_equal(parts.shares, whole.shares)


@pytest.mark.parametrize("kind", ["cylinder", "mesh"])
def test_a_wire_takes_few_test_points(kind, monkeypatch):
    """Aspect ratio 10,000. The rays of a mesh are along the wire: 32² in its width, whatever its length."""
    angle = 2.0 * np.pi * np.arange(24) / 24
    outline = 1e-4 * np.stack([np.cos(angle), np.sin(angle)], axis=1)
    made = prism(outline, [(0, k, k + 1) for k in range(1, 23)], 2.0)
    solid = lattice.cylinder(1e-4, 1.0) if kind == "cylinder" else lattice.mesh(*made)
    rays = []

    def inside(x, y, z, inside=solid.inside):
        rays.append(np.broadcast(x, y).size)
        return inside(x, y, z)

    body = lattice.fill(replace(solid, inside=inside))
    assert 0.9 * lattice.AUTOMATIC_COUNT < len(body.volumes) <= lattice.AUTOMATIC_COUNT
    assert body.volumes.sum() == pytest.approx(solid.volume, rel=1e-12)
    assert max(rays) <= 32**2
    np.testing.assert_allclose(body.positions[:, :2], 0.0, atol=1e-12)  # on the axis


@pytest.mark.parametrize("solid", [lattice.cylinder(1e-4, 0.7), lattice.ellipsoid([1e-4, 1e-4, 0.3])])
def test_spacing_of_a_wire_takes_long_steps_to_the_same_lattice(solid, monkeypatch):
    filled = lattice.fill(solid, 0.0, 3, together=True)
    monkeypatch.setattr(lattice, "_steps", lambda *_: 1)
    np.testing.assert_array_equal(filled.positions, lattice.fill(solid, 0.0, 3, together=True).positions)
