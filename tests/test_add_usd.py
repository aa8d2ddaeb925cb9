"""Magnets that Newton's own ``builder.add_usd`` brings in, against warpmag's reader."""

import newton
import numpy as np
import pytest
import warp as wp
from pxr import Gf, Usd, UsdGeom, UsdPhysics

import warpmag
from warpmag.engine.attributes import marked_shapes
from warpmag.engine.scene import import_scene
from warpmag.magnets import Magnet
from warpmag.scenes_usd import bundled
from warpmag.usd import author_magnet


def by_newton(stage):
    """The magnets of a stage by the label of their shapes, as a program without ``Simulation`` finds them."""
    builder = newton.ModelBuilder()
    warpmag.register_attributes(builder)
    builder.add_usd(str(stage))
    model = builder.finalize(device="cpu")
    return model, {model.shape_label[shape]: magnet for shape, magnet in marked_shapes(model).items()}


def compare(found, expected):
    assert found.keys() == expected.keys()
    for label, magnet in expected.items():
        other = found[label]
        assert (other.kind, other.curve) == (magnet.kind, magnet.curve)
        numbers = [(one.saturation, one.susceptibility, one.moment_spacing) for one in (other, magnet)]
        np.testing.assert_array_equal(*numbers)
        size = np.linalg.norm(magnet.magnetization)  # turned by quaternions in float32
        np.testing.assert_allclose(other.magnetization, magnet.magnetization, rtol=0, atol=1e-6 * size)


QUICK = ("balls_up", "crystal_balls")
SCENES = [pytest.param(one, marks=() if one in QUICK else pytest.mark.long) for one in bundled()]


@pytest.mark.parametrize("name", SCENES)
def test_bundled_scenes_have_the_same_magnets(name):
    builder = import_scene(bundled()[name]).builder
    model = builder.finalize(device="cpu")
    expected = {model.shape_label[shape]: magnet for shape, magnet in marked_shapes(model).items()}
    compare(by_newton(bundled()[name])[1], expected)


@pytest.fixture
def stage(tmp_path):
    """A turned body of a turned capsule, a box of iron, a magnet by default, and what is no magnet."""
    stage = Usd.Stage.CreateNew(str(tmp_path / "scene.usda"))
    UsdGeom.SetStageMetersPerUnit(stage, 1.0)
    UsdGeom.SetStageUpAxis(stage, "Z")
    UsdPhysics.Scene.Define(stage, "/Physics")
    body = UsdGeom.Xform.Define(stage, "/Body")
    body.AddRotateXYZOp().Set(Gf.Vec3f(20, 30, 40))
    UsdPhysics.RigidBodyAPI.Apply(body.GetPrim())
    capsule = UsdGeom.Capsule.Define(stage, "/Body/Group/Capsule")
    capsule.CreateAxisAttr("X")
    capsule.AddRotateZOp().Set(35.0)
    UsdGeom.Xform(stage.GetPrimAtPath("/Body/Group")).AddRotateXOp().Set(-50.0)
    box, far, plain = (UsdGeom.Cube.Define(stage, path) for path in ("/Box", "/Static", "/Plain"))
    for k, shape in enumerate((capsule, box, far, plain)):
        UsdPhysics.CollisionAPI.Apply(shape.GetPrim())
        if k:
            shape.AddTranslateOp().Set(Gf.Vec3d(10.0 * k, 0.0, 0.0))
    author_magnet(body.GetPrim(), Magnet("permanent", magnetization=(1e5, 2e5, 3e5)))
    author_magnet(box.GetPrim(), Magnet(saturation=1e6))
    prim = far.GetPrim()  # says nothing, so that defaults count
    prim.AddAppliedSchema("WarpmagMagnetAPI")
    stage.Save()
    return tmp_path / "scene.usda"


def test_magnets_of_bodies_and_colliders(stage):
    model, found = by_newton(stage)
    assert found.keys() == {"/Body/Group/Capsule", "/Box", "/Static"}
    assert found["/Static"] == Magnet()
    assert found["/Box"].saturation == 1e6
    shape = model.shape_label.index("/Body/Group/Capsule")
    turn = wp.quat(*model.shape_transform.numpy()[shape, 3:].tolist())
    assert abs(turn[3]) < 0.9
    magnetization = wp.quat_rotate(turn, wp.vec3(*found["/Body/Group/Capsule"].magnetization))
    np.testing.assert_allclose(magnetization, (1e5, 2e5, 3e5), rtol=1e-5)
    theirs = import_scene(stage).builder.finalize(device="cpu")
    compare(found, {theirs.shape_label[shape]: magnet for shape, magnet in marked_shapes(theirs).items()})
    assert len(warpmag.Magnetics(model).magnets) == 3


def test_a_wrong_value_is_refused_by_name(stage):
    wrong = Usd.Stage.Open(str(stage))
    wrong.GetPrimAtPath("/Box").GetAttribute("warpmag:saturationMagnetization").Set(-1.0)
    wrong.Save()
    with pytest.raises(warpmag.InputError, match="^/Box: "):
        by_newton(stage)
