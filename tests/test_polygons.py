"""Concave polygons: triangles, Newton's meshes and iron cells cover a letter and nothing beside it."""

import newton
import numpy as np
import pytest
from pxr import Gf, Sdf, Usd, UsdGeom, UsdPhysics, Vt

from warpmag.engine.magnets.sampling import solid_of
from warpmag.engine.stepping.scene import import_scene
from warpmag.engine.stepping.simulation import Simulation
from warpmag.errors import InputError
from warpmag.shapes import lattice
from warpmag.shapes.polygons import fans, triangulate
from warpmag.show.meshes import shape_of, triangles_of
from warpmag.usd import open_stage, triangulate_concave_faces

ROUND = 2e-6  # of an area: coordinates in single precision
HEIGHT = 0.01  # of the prisms [m]
SIZE = 0.01  # of a unit of the outlines [m]


def arc(radius, count, begin=0.0, end=2.0 * np.pi, closed=False):
    angle = np.linspace(begin, end, count, endpoint=not closed)
    return np.multiply(radius, [np.cos(angle), np.sin(angle)]).T


def keyholed(outer, hole):
    """An outline with a hole: both joined by an edge between their first corners, which is passed twice."""
    return np.concatenate([outer, outer[:1], hole[:1], hole[:0:-1], hole[:1]])


def sector(radius, angle):
    """Area of a triangle of two radii."""
    return 0.5 * radius**2 * np.sin(angle)


OUTLINES = {
    "L": ([(3, 0), (3, 1), (1, 1), (1, 3), (0, 3), (0, 0)], 5.0),
    "repeated corners": ([(3, 0), (3, 0), (3, 1), (1, 1), (1, 1), (1, 3), (0, 3), (0, 0), (0, 0)], 5.0),
    "C": (
        np.concatenate([arc(2.0, 20, 0.7, 5.6), arc(1.2, 20, 5.6, 0.7)]),
        19 * (sector(2.0, 4.9 / 19) - sector(1.2, 4.9 / 19)),
    ),
    "star": (arc(np.where(np.arange(10) % 2, 0.4, 1.0), 10, closed=True), 2.0 * np.sin(np.radians(36.0))),
    "O": (
        keyholed(arc(2.0, 40, closed=True), arc(1.0, 24, closed=True)),
        40 * sector(2.0, np.pi / 20) - 24 * sector(1.0, np.pi / 12),
    ),
    "bridge in line with edges": (
        keyholed(
            np.array([(3, 1), (3, 3), (0, 3), (0, 0), (3, 0)]), np.array([(2, 1), (2, 2), (1, 2), (1, 1)])
        ),
        8.0,
    ),
    "E with corners on straight edges": (
        [
            *[(0, 0), (2, 0), (4, 0), (4, 1), (2, 1), (1, 1), (1, 2), (2, 2), (4, 2), (4, 3), (1, 3), (1, 4), (4, 4)],
            *[(4, 5), (2, 5), (0, 5), (0, 4), (0, 2), (0, 1)],
        ],
        14.0,
    ),
    "spiral": (
        [
            *[(0, 0), (7, 0), (7, 7), (0, 7), (0, 2), (5, 2), (5, 5), (2, 5), (2, 4), (4, 4), (4, 3), (1, 3), (1, 6)],
            *[(6, 6), (6, 1), (0, 1)],
        ],
        31.0,
    ),
}  # fmt: skip
"""Corners of each outline, counterclockwise, and its area by hand."""
LETTERS = {name: (np.array(outline, float), area) for name, (outline, area) in OUTLINES.items()}


def inside(outline, points):
    """Points inside an outline, by the number of its edges to their right."""
    (x, y), (x1, y1) = outline.T[:, :, None], np.roll(outline, -1, axis=0).T[:, :, None]
    px, py = points.T
    with np.errstate(divide="ignore", invalid="ignore"):
        crossed = ((y > py) != (y1 > py)) & (px < x + (py - y) / (y1 - y) * (x1 - x))
    return crossed.sum(axis=0) % 2 == 1


def areas(corners):
    """Signed areas of triangles in the plane, corners of shape [k, 3, 2 or more]."""
    (a, b, c) = corners[..., :2].transpose(1, 0, 2)
    return 0.5 * ((b - a)[:, 0] * (c - a)[:, 1] - (b - a)[:, 1] * (c - a)[:, 0])


def covers(triangles, points):
    """Number of triangles of any orientation that contain each point, corners of shape [k, 3, 2]."""
    x, y = triangles.T[..., None]
    dx, dy = np.roll(x, -1, axis=0) - x, np.roll(y, -1, axis=0) - y
    left = dx * (points[:, 1] - y) - dy * (points[:, 0] - x) > 0.0
    return (left.all(axis=0) | ~left.any(axis=0)).sum(axis=0)


def check_cover(triangles, outline, area):
    """Check that triangles, corners of shape [k, 3, 2], cover an outline once, and nothing beside it."""
    assert np.abs(areas(triangles)).sum() == pytest.approx(area, rel=ROUND)
    low, high = outline.min(axis=0) - 0.2, outline.max(axis=0) + 0.2
    points = np.random.default_rng(5).uniform(low, high, (4000, 2))
    np.testing.assert_array_equal(covers(triangles, points), inside(outline, points))


@pytest.mark.parametrize("shift", [0, 1, 5])
@pytest.mark.parametrize("name", LETTERS)
def test_triangles_cover_a_letter_once(name, shift):
    outline, area = np.roll(LETTERS[name][0], shift, axis=0), LETTERS[name][1]
    n = len(outline)
    triangles = triangulate(np.c_[outline, np.zeros(n)], [n], np.arange(n))
    assert triangles.shape == (n - 2, 3)
    assert (areas(outline[triangles]) > -ROUND * area).all()  # oriented as the outline
    check_cover(outline[triangles], outline, area)
    edges = np.stack([triangles, np.roll(triangles, -1, axis=1)], axis=-1).reshape(-1, 2)
    outside = {tuple(edge) for edge in edges.tolist()} - {tuple(edge) for edge in edges[:, ::-1].tolist()}
    assert outside == {(k, (k + 1) % n) for k in range(n)}  # all edges stay: a closed mesh stays closed


@pytest.mark.parametrize("seed", range(20))
def test_random_polygons_in_space(seed):
    rng = np.random.default_rng(seed)
    n = int(rng.integers(5, 60))
    angle = (np.arange(n) + rng.uniform(size=n)) * 2.0 * np.pi / n  # gaps under π: no edge passes the center
    outline = np.roll(rng.uniform(0.05, 1.0, n) * [np.cos(angle), np.sin(angle)], rng.integers(n), axis=1).T
    basis = np.linalg.qr(rng.normal(size=(3, 3)))[0]
    basis *= np.sign(np.linalg.det(basis))
    points = (np.c_[outline, np.zeros(n)] @ basis + rng.normal(size=3)).astype(np.float32)
    (first, second) = outline, np.roll(outline, -1, axis=0)
    area = 0.5 * float((first[:, 0] * second[:, 1] - first[:, 1] * second[:, 0]).sum())
    triangles = outline[triangulate(points, [n], np.arange(n))]
    assert (areas(triangles) > -ROUND * area).all()
    assert np.abs(areas(triangles)).sum() == pytest.approx(area, rel=10 * ROUND)


def test_other_polygons_are_fans():
    square, arrow = [(0, 0), (1, 0), (1, 1), (0, 1)], [(0, 0), (2, -1), (1, 0), (2, 1)]  # its fan has two triangles
    bow, pentagram = [(0, 0), (1, 1), (1, 0), (0, 1)], arc(1.0, 5, closed=True)[[0, 2, 4, 1, 3]]
    line, point = [(0, 0), (3, 0), (1, 0), (2, 0), (0.5, 0)], np.zeros((6, 2))
    faces = [np.array(face, float) for face in (square, arrow, bow, pentagram, line, point)]
    points, counts = np.concatenate(faces), [len(face) for face in faces]
    points = np.c_[points, np.zeros(len(points))]
    np.testing.assert_array_equal(triangulate(points, counts, np.arange(len(points))), fans(counts))
    assert fans([3, 5]).tolist() == [[0, 1, 2], [3, 4, 5], [3, 5, 6], [3, 6, 7]]
    points[2] = np.nan, np.inf, 1e200
    np.testing.assert_array_equal(triangulate(points, counts, np.arange(len(points))), fans(counts))


def test_a_dent_in_a_quadrilateral_chooses_the_other_diagonal():
    points = np.array([(2, -1, 0), (1, 0, 0), (2, 1, 0), (0, 0, 0)], float)
    triangles = {tuple(sorted(corners)) for corners in triangulate(points, [4], np.arange(4)).tolist()}
    assert triangles == {(0, 1, 3), (1, 2, 3)}


def prism(outline):
    """Points, counts and indices of a prism over an outline [m], with one polygon at each end."""
    n = len(outline)
    points = np.concatenate([np.c_[outline, np.full(n, z)] for z in (0.0, HEIGHT)])
    faces = [(k, (k + 1) % n, n + (k + 1) % n, n + k) for k in range(n)]
    faces += [tuple(range(n))[::-1], tuple(range(n, 2 * n))]
    return points, [len(face) for face in faces], [corner for face in faces for corner in face]


def letter_stage(path, outline, left_handed=False, body=True):
    """Write a stage with a letter of iron."""
    stage = Usd.Stage.CreateNew(str(path))
    UsdGeom.SetStageMetersPerUnit(stage, 1.0)
    UsdGeom.SetStageUpAxis(stage, "Z")
    stage.SetTimeCodesPerSecond(60)
    stage.SetEndTimeCode(60)
    stage.SetDefaultPrim(UsdGeom.Xform.Define(stage, "/World").GetPrim())
    UsdPhysics.Scene.Define(stage, "/World/Scene")
    mesh = UsdGeom.Mesh.Define(stage, "/World/Letter")
    points, counts, indices = prism(SIZE * outline)
    if left_handed:
        indices = [corner for face in np.split(indices, np.cumsum(counts)[:-1]) for corner in face[::-1].tolist()]
        mesh.CreateOrientationAttr(UsdGeom.Tokens.leftHanded)
    mesh.CreatePointsAttr(Vt.Vec3fArray.FromNumpy(points.astype(np.float32)))
    mesh.CreateFaceVertexCountsAttr(counts)
    mesh.CreateFaceVertexIndicesAttr(indices)
    mesh.CreateSubdivisionSchemeAttr(UsdGeom.Tokens.none)
    UsdPhysics.CollisionAPI.Apply(mesh.GetPrim())
    UsdPhysics.MeshCollisionAPI.Apply(mesh.GetPrim()).CreateApproximationAttr("none")
    if body:
        UsdPhysics.RigidBodyAPI.Apply(mesh.GetPrim())
        mesh.GetPrim().AddAppliedSchema("WarpmagMagnetAPI")
    stage.Save()
    return stage


def check_prism(points, triangles, outline, area):
    """Check the ends of a prism over an outline, and its volume."""
    corners = np.asarray(points, float)[np.reshape(triangles, (-1, 3))]
    for z, sign in ((0.0, -1.0), (HEIGHT, 1.0)):
        end = corners[(np.abs(corners[..., 2] - z) < 1e-6).all(axis=1)] / SIZE
        assert (sign * areas(end) > -ROUND * area).all()  # normals point out
        check_cover(end[..., :2], outline, area)
    volume = np.einsum("ki,ki->k", corners[:, 0], np.cross(corners[:, 1], corners[:, 2])).sum() / 6.0
    assert volume == pytest.approx(area * SIZE**2 * HEIGHT, rel=ROUND)


@pytest.mark.parametrize("left_handed", [False, True])
@pytest.mark.parametrize("name", LETTERS)
def test_newton_pictures_and_iron_get_the_letter(name, left_handed, tmp_path):
    outline, area = LETTERS[name]
    stage = letter_stage(tmp_path / "letter.usda", outline, left_handed)
    text = (tmp_path / "letter.usda").read_text(encoding="utf-8")
    scene = import_scene(tmp_path / "letter.usda")
    (mesh,) = (source for source in scene.builder.shape_source if isinstance(source, newton.Mesh))
    check_prism(mesh.vertices, mesh.indices, outline, area)
    points, faces = shape_of(stage.GetPrimAtPath("/World/Letter"))
    faces = [face[::-1] for face in faces] if left_handed else faces
    check_prism(points, triangles_of(points, faces), outline, area)
    cells = lattice.fill(solid_of(newton.GeoType.MESH, (1.0, 1.0, 1.0), mesh))
    assert cells.volumes.sum() == pytest.approx(area * SIZE**2 * HEIGHT, rel=ROUND)
    assert inside(outline, cells.positions[:, :2] / SIZE).all()
    assert (tmp_path / "letter.usda").read_text(encoding="utf-8") == text


def test_a_run_keeps_the_polygons(tmp_path, device):
    outline, _ = LETTERS["L"]
    stage = letter_stage(tmp_path / "letter.usda", outline)
    Simulation(tmp_path / "letter.usda", device=device).run(2, output=tmp_path / "run.usda")
    written = Usd.Stage.Open(str(tmp_path / "run.usda"))
    letters = [opened.GetPrimAtPath("/World/Letter") for opened in (stage, written)]
    for name in ("faceVertexCounts", "faceVertexIndices"):
        authored, kept = (letter.GetAttribute(name).Get() for letter in letters)
        assert authored == kept


def test_values_of_faces_and_corners_follow_the_triangles(tmp_path):
    outline, _ = LETTERS["E with corners on straight edges"]
    stage = letter_stage(tmp_path / "letter.usda", outline)
    mesh = UsdGeom.Mesh.Get(stage, "/World/Letter")
    _, counts, indices = prism(outline)
    primvars, types, faces = UsdGeom.PrimvarsAPI(mesh), Sdf.ValueTypeNames, len(counts)
    primvars.CreatePrimvar("st", types.TexCoord2fArray, "faceVarying").Set(
        [Gf.Vec2f(k, 0) for k in range(len(indices))]
    )
    names = primvars.CreatePrimvar("name", types.StringArray, "uniform")
    names.Set(["side", "end"])
    names.SetIndices(Vt.IntArray([0] * (faces - 2) + [1] * 2))
    primvars.CreatePrimvar("temperature", types.FloatArray, "vertex").Set([float(k) for k in range(2 * len(outline))])
    primvars.CreatePrimvar("short", types.FloatArray, "uniform").Set([1.0])  # of the wrong length: left as it is
    corner_faces = np.repeat(np.arange(faces), counts)
    mesh.CreateNormalsAttr(Vt.Vec3fArray([Gf.Vec3f(float(face), 0, 1) for face in corner_faces]))
    mesh.SetNormalsInterpolation("faceVarying")
    mesh.CreateHoleIndicesAttr([faces - 2])
    ends = UsdGeom.Subset.CreateGeomSubset(mesh, "ends", "face", Vt.IntArray([faces - 2, faces - 1]))
    corner = UsdGeom.Subset.CreateGeomSubset(mesh, "corner", "point", Vt.IntArray([0, faces - 1]))
    stage.Save()
    triangulate_concave_faces(stage := open_stage(tmp_path / "letter.usda"))
    mesh = UsdGeom.Mesh.Get(stage, "/World/Letter")
    n = len(outline)
    triangles = 2 * n + 2 * (n - 2)
    assert list(mesh.GetFaceVertexCountsAttr().Get()) == [3] * triangles
    primvars = UsdGeom.PrimvarsAPI(mesh)
    corners = np.array(primvars.GetPrimvar("st").ComputeFlattened())[:, 0].astype(int)
    np.testing.assert_array_equal(np.array(indices)[corners], mesh.GetFaceVertexIndicesAttr().Get())
    face_of_triangle = corner_faces[corners].reshape(-1, 3)
    assert (face_of_triangle == face_of_triangle[:, :1]).all()
    np.testing.assert_array_equal(np.array(mesh.GetNormalsAttr().Get())[:, 0], face_of_triangle.reshape(-1))
    is_end = face_of_triangle[:, 0] >= faces - 2
    assert [name == "end" for name in primvars.GetPrimvar("name").ComputeFlattened()] == is_end.tolist()
    assert len(primvars.GetPrimvar("temperature").Get()) == 2 * n
    assert not primvars.GetPrimvar("short").IsIndexed()
    subset = UsdGeom.Subset.Get(stage, ends.GetPath()).GetIndicesAttr().Get()
    np.testing.assert_array_equal(subset, np.flatnonzero(is_end))
    assert list(UsdGeom.Subset.Get(stage, corner.GetPath()).GetIndicesAttr().Get()) == [0, faces - 1]
    assert (face_of_triangle[np.array(mesh.GetHoleIndicesAttr().Get()), 0] == faces - 2).all()
    assert len(mesh.GetHoleIndicesAttr().Get()) == n - 2


def test_convex_meshes_are_left_alone(tmp_path):
    letter_stage(tmp_path / "box.usda", np.array([(0, 0), (1, 0), (1, 1), (0, 1)], float))
    stage = open_stage(tmp_path / "box.usda")
    before = stage.GetSessionLayer().ExportToString()
    triangulate_concave_faces(stage)
    assert stage.GetSessionLayer().ExportToString() == before


def test_letters_in_instances(tmp_path):
    outline, area = LETTERS["C"]
    letter_stage(tmp_path / "letter.usda", outline, body=False)
    stage = Usd.Stage.CreateNew(str(tmp_path / "stage.usda"))
    UsdGeom.SetStageMetersPerUnit(stage, 1.0)
    UsdGeom.SetStageUpAxis(stage, "Z")
    stage.SetTimeCodesPerSecond(60)
    stage.SetDefaultPrim(UsdGeom.Xform.Define(stage, "/World").GetPrim())
    UsdPhysics.Scene.Define(stage, "/World/Scene")
    for name in ("First", "Second"):
        letter = UsdGeom.Xform.Define(stage, f"/World/{name}").GetPrim()
        letter.GetReferences().AddReference("./letter.usda")
        letter.SetInstanceable(True)
    UsdPhysics.RigidBodyAPI.Apply(ball := UsdGeom.Sphere.Define(stage, "/World/Ball").GetPrim())
    UsdPhysics.CollisionAPI.Apply(ball)
    ball.AddAppliedSchema("WarpmagMagnetAPI")
    stage.Save()
    scene = import_scene(tmp_path / "stage.usda")
    meshes = [source for source in scene.builder.shape_source if isinstance(source, newton.Mesh)]
    assert len(meshes) == 2
    for mesh in meshes:
        check_prism(mesh.vertices, mesh.indices, outline, area)
    over = Sdf.CreatePrimInLayer(stage.GetRootLayer(), "/World/First/Letter")
    Sdf.AttributeSpec(over, "note", Sdf.ValueTypeNames.String).default = "ignored"
    stage.Save()
    with pytest.raises(InputError, match="USD ignores the override /World/First/Letter in the instance"):
        import_scene(tmp_path / "stage.usda")


def test_a_ball_falls_through_the_hole_of_an_o(tmp_path, device):
    """Beside the ball's fall by ½ g t², no contact acts on it. A fan closes the hole."""
    stage = letter_stage(tmp_path / "o.usda", LETTERS["O"][0], body=False)
    ball = UsdGeom.Sphere.Define(stage, "/World/Ball")
    ball.CreateRadiusAttr(0.4 * SIZE)
    ball.AddTranslateOp().Set(Gf.Vec3d(0.0, 0.0, 0.02))
    UsdPhysics.RigidBodyAPI.Apply(ball.GetPrim())
    UsdPhysics.CollisionAPI.Apply(ball.GetPrim())
    ball.GetPrim().AddAppliedSchema("WarpmagMagnetAPI")
    stage.Save()
    simulation = Simulation(tmp_path / "o.usda", device=device)
    simulation.run(12)
    height = float(simulation.state.body_q.numpy()[0, 2])
    time = 12 / 60
    # the first-order integration of the substeps lags by g·t·dt/2, at most 1 ms each
    assert height == pytest.approx(0.02 - 0.5 * 9.81 * time**2, abs=9.81 * time * 1e-3)
