"""Magnets that Newton's own ``builder.add_usd`` brings in, against warpmag's reader."""

import newton
import numpy as np
import pytest
import warp as wp
from pxr import Gf, Usd, UsdGeom, UsdPhysics

import warpmag
from warpmag.declarations.coils import Coil, FieldMap
from warpmag.declarations.magnets import Magnet
from warpmag.engine.magnets.attributes import marked_shapes
from warpmag.engine.stepping.scene import import_scene
from warpmag.errors import InputError
from warpmag.scenes_usd import bundled
from warpmag.usd import author_coil, author_field_map, author_magnet


def by_newton(stage):
    """The magnets of a stage by the label of their shapes, as a program without ``Simulation`` finds them."""
    builder = newton.ModelBuilder()
    warpmag.register_attributes(builder)
    builder.add_usd(str(stage))
    model = builder.finalize(device="cpu")
    return model, {model.shape_label[shape]: magnet for shape, magnet in marked_shapes(model).items()}


def compare(imported, expected):
    assert imported.keys() == expected.keys()
    for label, magnet in expected.items():
        other = imported[label]
        assert (other.kind, other.curve) == (magnet.kind, magnet.curve)
        numbers = [(each.saturation, each.susceptibility, each.moment_spacing) for each in (other, magnet)]
        np.testing.assert_array_equal(*numbers)
        size = np.linalg.norm(magnet.magnetization)  # turned by quaternions in float32
        np.testing.assert_allclose(other.magnetization, magnet.magnetization, rtol=0, atol=1e-6 * size)


QUICK = ("balls_up", "crystal_balls")
SCENES = [pytest.param(scene, marks=() if scene in QUICK else pytest.mark.long) for scene in bundled()]


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
    model, magnets = by_newton(stage)
    assert magnets.keys() == {"/Body/Group/Capsule", "/Box", "/Static"}
    assert magnets["/Static"] == Magnet()
    assert magnets["/Box"].saturation == 1e6
    shape = model.shape_label.index("/Body/Group/Capsule")
    turn = wp.quat(*model.shape_transform.numpy()[shape, 3:].tolist())
    assert abs(turn[3]) < 0.9
    magnetization = wp.quat_rotate(turn, wp.vec3(*magnets["/Body/Group/Capsule"].magnetization))
    np.testing.assert_allclose(magnetization, (1e5, 2e5, 3e5), rtol=1e-5)
    theirs = import_scene(stage).builder.finalize(device="cpu")
    compare(magnets, {theirs.shape_label[shape]: magnet for shape, magnet in marked_shapes(theirs).items()})
    assert len(warpmag.Magnetics(model).magnets) == 3


def test_a_wrong_value_is_refused_by_name(stage):
    wrong = Usd.Stage.Open(str(stage))
    wrong.GetPrimAtPath("/Box").GetAttribute("warpmag:saturationMagnetization").Set(-1.0)
    wrong.Save()
    with pytest.raises(warpmag.InputError, match="^/Box: "):
        by_newton(stage)


@pytest.fixture
def coils(stage):
    """The same stage with a coil on the body, one in the world and a map, and a body of its own frame above."""
    made = Usd.Stage.Open(str(stage))
    for path, where in (("/Body/Coil", (0.1, 0.2, 0.3)), ("/Lift", (4.0, 5.0, 6.0)), ("/Earth", (0.0, 0.0, 0.0))):
        prim = UsdGeom.Xform.Define(made, path)
        prim.AddTranslateOp().Set(Gf.Vec3d(*where))
        prim.AddRotateYOp().Set(25.0)
        if path == "/Earth":
            author_field_map(prim.GetPrim(), FieldMap((-9.0,) * 3, (18.0,) * 3, np.full((2, 2, 2, 3), 7.0)))
        else:
            author_coil(prim.GetPrim(), Coil("solenoid", radius=0.2, length=0.5, ampere_turns=50.0))
    made.Save()
    return stage


@pytest.mark.parametrize("turned", [False, True])
def test_coils_and_field_maps_come_in(coils, turned):
    """At the places where ``Simulation`` has them, also where the program moves the stage or has other axes."""
    ours = warpmag.Magnetics(import_scene(coils).builder.finalize(device="cpu"))
    builder = newton.ModelBuilder(up_axis=newton.Axis.Y if turned else newton.Axis.Z)
    warpmag.register_attributes(builder)
    moved = wp.transform((1.0, 2.0, 3.0), wp.quat_from_axis_angle(wp.vec3(0.0, 0.6, 0.8), 0.7))
    builder.add_usd(str(coils), xform=moved if turned else None)
    model = builder.finalize(device="cpu")
    theirs = warpmag.Magnetics(model)
    states = [magnetics._model.state() for magnetics in (ours, theirs)]
    whole = moved * wp.transform((0.0, 0.0, 0.0), newton.math.quat_between_axes(newton.Axis.Z, newton.Axis.Y))
    whole = whole if turned else wp.transform_identity()
    for magnetics, state in zip((ours, theirs), states, strict=True):
        magnetics.induce(state)
    names = [
        [magnetics._model.shape_label[shape] for shape in magnetics._sources.shapes] for magnetics in (ours, theirs)
    ]
    assert names[0] == names[1] == ["/Body/Coil", "/Lift", "/Earth"]
    frames, others = (magnetics.system.sources.frames.numpy() for magnetics in (ours, theirs))
    for frame, other in zip(frames, others, strict=True):
        expected = np.array(whole * wp.transform(frame[:3], frame[3:]))
        np.testing.assert_allclose(other[:3], expected[:3], atol=1e-5)
        assert abs(abs(expected[3:] @ other[3:]) - 1.0) < 1e-5
    strengths = [magnetics.system.sources.strengths.numpy() for magnetics in (ours, theirs)]
    np.testing.assert_array_equal(*strengths)


def test_keyed_currents_are_followed(coils):
    """Linear between two samples and held after the last, of two worlds alike, in a captured graph, too."""
    keyed = Usd.Stage.Open(str(coils))
    keyed.SetStartTimeCode(10.0)
    keyed.SetTimeCodesPerSecond(20.0)
    current = keyed.GetPrimAtPath("/Lift").GetAttribute("warpmag:coil:ampereTurns")
    for code, value in ((10.0, -4.0), (20.0, 6.0), (30.0, 60.0)):
        current.Set(value, code)
    keyed.Save()
    world, builder = newton.ModelBuilder(), newton.ModelBuilder()
    warpmag.register_attributes(world)
    world.add_usd(str(coils))
    builder.replicate(world, 2)
    model = builder.finalize(device="cpu")
    currents, strengths = warpmag.KeyedCurrents(model), model.warpmag.strength
    lifts = [shape for shape, label in enumerate(model.shape_label) if label.endswith("/Lift")]
    assert list(currents.shapes) == lifts
    assert len(lifts) == 2
    for time, expected in ((None, -4.0), (0.25, 1.0), (0.75, 33.0), (9.0, 60.0)):
        if time is not None:
            currents.set(time)
        np.testing.assert_allclose(strengths.numpy()[lifts], expected, rtol=1e-6)
    with wp.ScopedCapture(device="cpu") as capture:
        currents.set()
    currents.time.fill_(0.5)
    wp.capture_launch(capture.graph)
    np.testing.assert_allclose(strengths.numpy()[lifts], 6.0, rtol=1e-6)
    others = np.setdiff1d([shape for shape, text in enumerate(model.warpmag.source) if text], lifts)
    np.testing.assert_array_equal(strengths.numpy()[others], [50.0, 1.0] * 2)
    with pytest.raises(InputError, match="time: must be finite"):
        currents.set(float("nan"))
    with pytest.raises(InputError, match="no coil of the model has a current with time samples"):
        warpmag.KeyedCurrents(newton.ModelBuilder().finalize(device="cpu"))


def test_a_wrong_coil_is_refused_by_name(coils):
    """Newton wraps what its readers raise, so that the line is within another one."""
    wrong = Usd.Stage.Open(str(coils))
    wrong.GetPrimAtPath("/Lift").GetAttribute("warpmag:coil:radius").Set(-1.0)
    wrong.Save()
    with pytest.raises(RuntimeError, match="/Lift: radius: must be positive"):
        by_newton(coils)
