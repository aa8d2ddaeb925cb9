"""Magnets of meshes that collide as something simpler: volume, place and magnetization are those of the mesh."""

import sys

import newton
import numpy as np
import pytest

from warpmag import Magnetics
from warpmag.engine.magnets.workload import moments_line
from warpmag.engine.stepping.scene import import_scene

STAGE = """#usda 1.0
(
    metersPerUnit = 1
    kilogramsPerUnit = 1
    upAxis = "Z"
    defaultPrim = "Tool"
)
def Xform "Tool" (prepend apiSchemas = ["PhysicsRigidBodyAPI", "WarpmagMagnetAPI"])
{
    double3 xformOp:translate = (1, 2, 3)
    float xformOp:rotateX = 30
    uniform token[] xformOpOrder = ["xformOp:translate", "xformOp:rotateX"]
    uniform token warpmag:kind = "KIND"
    vector3f warpmag:magnetization = MAGNETIZATION
    def Mesh "Blade" (prepend apiSchemas = ["PhysicsCollisionAPI", "PhysicsMeshCollisionAPI"])
    {
        double3 xformOp:translate = (0.1, 0, 0)
        float xformOp:rotateZ = 40
        float3 xformOp:scale = (0.02, 0.01, 0.03)
        uniform token[] xformOpOrder = ["xformOp:translate", "xformOp:rotateZ", "xformOp:scale"]
        uniform token physics:approximation = "APPROXIMATION"
        point3f[] points = POINTS
        int[] faceVertexCounts = COUNTS
        int[] faceVertexIndices = INDICES
    }
}
"""
FLAT_L = np.array([(0, 0), (3, 0), (3, 1), (1, 1), (1, 3), (0, 3)], float)  # area 5, centroid (1.1, 1.1)
VOLUME, CENTROID = 5 * 6e-6, np.array([1.1, 1.1, 0.5])


def prism(outline):
    """Points, counts and indices of a prism of height 1 over an outline that is seen from its first corner."""
    n = len(outline)
    points = [(*p, z) for z in (0.0, 1.0) for p in outline.tolist()]
    faces = [(k, (k + 1) % n, n + (k + 1) % n, n + k) for k in range(n)]
    faces += [tuple(range(n))[::-1], tuple(range(n, 2 * n))]
    return points, [len(face) for face in faces], [corner for face in faces for corner in face]


class Decomposer:
    """Stands for CoACD, which takes a second: the two legs."""

    def Mesh(vertices, faces):
        return vertices, faces

    def run_coacd(mesh, **settings):
        legs = [
            np.array(entry, float) for entry in ([(0, 0), (3, 0), (3, 1), (0, 1)], [(0, 1), (1, 1), (1, 3), (0, 3)])
        ]
        results = []
        for points, _, indices in map(prism, legs):
            quads = np.reshape(indices, (-1, 4))
            results.append((np.array(points), np.concatenate([quads[:, [0, 1, 2]], quads[:, [0, 2, 3]]])))
        return results


def magnetics_of(folder, approximation, outline=FLAT_L, magnetization=None, drop=0):
    points, counts, indices = prism(np.roll(outline, -3, axis=0) if len(outline) == 6 else outline)  # the inner corner
    counts, indices = counts[drop:], indices[4 * drop :]
    text = STAGE.replace("KIND", "inducible" if magnetization is None else "permanent")
    for name, value in {
        "APPROXIMATION": approximation, "MAGNETIZATION": magnetization or (0, 0, 0), "POINTS": points, "COUNTS": counts,
        "INDICES": indices,
    }.items():  # fmt: skip
        text = text.replace(name, str(value))
    path = folder / "stage.usda"
    path.write_text(text)
    scene = import_scene(path)
    model = scene.builder.finalize(device="cpu")
    magnetics = Magnetics(model)
    magnetics.apply(state := model.state())
    assert np.isfinite(state.body_f.numpy()).all()
    return scene, model, magnetics


@pytest.mark.parametrize(
    "approximation", ["boundingSphere", "boundingCube", "convexHull", "convexDecomposition", "none"]
)
def test_iron_is_what_is_drawn(tmp_path, approximation, monkeypatch):
    monkeypatch.setitem(sys.modules, "coacd", Decomposer)
    scene, model, magnetics = magnetics_of(tmp_path, approximation)
    (magnet,) = magnetics.magnets
    volumes = magnet.lattice.volumes
    assert volumes.sum() == pytest.approx(VOLUME, rel=1e-6)  # single precision
    s, c = np.sin(np.radians(40)), np.cos(np.radians(40))
    place = np.array([[c, -s, 0], [s, c, 0], [0, 0, 1]]) @ (CENTROID * [0.02, 0.01, 0.03]) + [0.1, 0, 0]
    np.testing.assert_allclose(volumes @ magnet.lattice.positions / volumes.sum(), place, atol=1e-7)
    assert scene.magnet_shapes == {"/Tool": list(magnet.shapes)}
    colliding = model.shape_flags.numpy() & newton.ShapeFlags.COLLIDE_SHAPES != 0
    assert colliding.sum() == (2 if approximation == "convexDecomposition" else 1)  # no collider more
    assert colliding[list(magnet.shapes)].all() == (approximation == "none")
    # the path of the mesh, also where the magnet is not the collider
    assert moments_line(magnetics) == f"{len(volumes)} in 1 body: /Tool/Blade"
    assert magnetics.workload().bodies[0].label == "/Tool/Blade"
    assert scene.warnings == ()


@pytest.mark.parametrize("approximation", ["boundingSphere", "boundingCube", "convexHull"])
def test_a_permanent_mesh_is_as_strong_as_it_is_large(tmp_path, approximation):
    _, _, magnetics = magnetics_of(tmp_path, approximation, magnetization=(1e5, 0, 3e5))
    moment = magnetics.system.moments.numpy().sum(axis=0)
    s, c = np.sin(np.radians(30)), np.cos(np.radians(30))
    np.testing.assert_allclose(moment, VOLUME * np.array([1e5, -s * 3e5, c * 3e5]), rtol=1e-5, atol=1e-5 * VOLUME * 3e5)


def test_a_box_of_triangles_stays_the_box_that_it_collides_as(tmp_path):
    square = np.array([(0, 0), (1, 0), (1, 1), (0, 1)], float)
    _, model, magnetics = magnetics_of(tmp_path, "boundingCube", square, (0, 0, 1e5))
    assert model.shape_count == 1
    assert magnetics.magnets[0].lattice.volumes.sum() == pytest.approx(6e-6, rel=1e-5)


def test_an_open_mesh_is_what_it_collides_as_and_says_so(tmp_path):
    scene, model, magnetics = magnetics_of(tmp_path, "convexHull", drop=1)
    assert model.shape_count == 1
    assert magnetics.magnets[0].lattice.volumes.sum() == pytest.approx(7 * 6e-6, rel=1e-5)
    (warning,) = scene.warnings
    assert (
        warning.startswith("/Tool/Blade: mesh: not closed")
        and "its approximation for collisions, convexHull" in warning
    )
