"""The cache of a run: what was simulated stands in the stage, and the scene is left as it was.

Tolerances: frames come in as float32 and orientations go out as quatf, both with a unit roundoff of 6e-8; a few
operations on values of order ten leave 1e-5.
"""

import itertools
import os

import numpy as np
import pytest
from pxr import Gf, Sdf, Usd, UsdGeom, UsdPhysics, UsdUtils

from warpmag.errors import InputError
from warpmag.scenes_usd import balls_up
from warpmag.usd import CacheWriter, check, open_stage, read_magnets, stage_clock, survey

FLOAT = 1e-5

SCENE = """#usda 1.0
(
    defaultPrim = "World"
    doc = "A scene"
    metersPerUnit = 1
    kilogramsPerUnit = 1
    upAxis = "Z"
    startTimeCode = 10
    endTimeCode = 20
    timeCodesPerSecond = 48
    framesPerSecond = 24
)
def Xform "World"
{
    def PhysicsScene "Scene" { }
    def Sphere "Plain" (prepend apiSchemas = ["PhysicsRigidBodyAPI", "PhysicsCollisionAPI", "WarpmagMagnetAPI"])
    {
        vector3f physics:velocity = (1, 2, 3)
    }
    def Xform "Scaled" (prepend apiSchemas = ["PhysicsRigidBodyAPI", "WarpmagMagnetAPI"])
    {
        double3 xformOp:translate = (1, 2, 3)
        float xformOp:rotateZ = 30
        float3 xformOp:scale = (1, 2, 3)
        uniform token[] xformOpOrder = ["xformOp:translate", "xformOp:rotateZ", "xformOp:scale"]
        def Cube "Box" (prepend apiSchemas = ["PhysicsCollisionAPI"]) { }
        def Xform "Nested" (prepend apiSchemas = ["PhysicsRigidBodyAPI", "WarpmagMagnetAPI"])
        {
            double3 xformOp:translate = (0, 0, 9)
            uniform token[] xformOpOrder = ["!resetXformStack!", "xformOp:translate"]
            def Sphere "Ball" (prepend apiSchemas = ["PhysicsCollisionAPI"]) { }
        }
    }
    def Xform "Turned"
    {
        double3 xformOp:translate = (10, 0, 0)
        float3 xformOp:rotateXYZ = (10, 20, 30)
        float3 xformOp:scale = (2, 2, 2)
        uniform token[] xformOpOrder = ["xformOp:translate", "xformOp:rotateXYZ", "xformOp:scale"]
        def Sphere "Inside" (prepend apiSchemas = ["PhysicsRigidBodyAPI", "PhysicsCollisionAPI", "WarpmagMagnetAPI"])
        {
            double3 xformOp:translate = (1, 2, 3)
            uniform token[] xformOpOrder = ["xformOp:translate"]
        }
    }
    def Xform "Stretched"
    {
        float3 xformOp:scale = (1, 1, 3)
        uniform token[] xformOpOrder = ["xformOp:scale"]
        def Cube "Inside" (prepend apiSchemas = ["PhysicsRigidBodyAPI", "PhysicsCollisionAPI", "WarpmagMagnetAPI"]) { }
    }
    def Xform "Swinging"
    {
        double3 xformOp:translate.timeSamples = { 10: (0, 0, 0), 20: (5, 0, 0) }
        uniform token[] xformOpOrder = ["xformOp:translate"]
        def Sphere "Inside" (prepend apiSchemas = ["PhysicsRigidBodyAPI", "PhysicsCollisionAPI", "WarpmagMagnetAPI"])
        { }
    }
    def Xform "Instance" (instanceable = true
        references = </Prototype>) { }
}
class Xform "Prototype"
{
    def Sphere "Inside" (prepend apiSchemas = ["PhysicsRigidBodyAPI", "PhysicsCollisionAPI", "WarpmagMagnetAPI"]) { }
}
"""


@pytest.fixture
def scene(tmp_path):
    path = tmp_path / "scenes" / "scene.usda"
    path.parent.mkdir()
    path.write_text(SCENE.replace("}", "\n}"))  # usda wants a brace on a line of its own
    return path


def random_frames(count, bodies, magnets, seed=1):
    """Turning bodies; the sign of each quaternion is drawn anew, as a solver is free to choose it."""
    rng = np.random.default_rng(seed)
    q = rng.normal(size=(bodies, 7))
    for _ in range(count):
        q = q + 0.2 * rng.normal(size=q.shape)
        q[:, 3:] /= np.linalg.norm(q[:, 3:], axis=1, keepdims=True)
        q[:, 3:] *= rng.choice((-1.0, 1.0), size=(bodies, 1))
        yield q.astype(np.float32), rng.normal(size=(bodies, 6)), rng.normal(size=(magnets, 3))


def write(scene, output, times, seed=1, **options):
    stage = open_stage(scene)
    bodies = survey(stage).bodies
    magnets = list(read_magnets(stage).magnets)
    frames = list(random_frames(len(times), len(bodies), len(magnets), seed))
    with CacheWriter(stage, output, bodies, magnets, **options) as writer:
        for time, frame in zip(times, frames, strict=True):
            writer.add_frame(time, *frame)
    return bodies, magnets, frames


def body_frame(prim, code):
    """Position and rotation [3, 3] of a prim as USD's physics takes them: scale left out."""
    transform = Gf.Transform(UsdGeom.Xformable(prim).ComputeLocalToWorldTransform(code))
    return np.array(transform.GetTranslation()), np.array(Gf.Matrix3d(transform.GetRotation())).T


def rotation(x, y, z, w):
    return np.array(Gf.Matrix3d(Gf.Rotation(Gf.Quatd(float(w), float(x), float(y), float(z))))).T


def assert_equal_to_frame(stage, code, bodies, magnets, frame):
    body_q, body_qd, moments = frame
    for path, q, qd in zip(bodies, body_q, body_qd, strict=True):
        prim = stage.GetPrimAtPath(path)
        position, turn = body_frame(prim, code)
        np.testing.assert_allclose(position, q[:3], atol=FLOAT, err_msg=path)
        np.testing.assert_allclose(turn, rotation(*q[3:]), atol=FLOAT, err_msg=path)
        body = UsdPhysics.RigidBodyAPI(prim)
        np.testing.assert_allclose(turn @ body.GetVelocityAttr().Get(code), qd[:3], atol=FLOAT)
        angular = np.radians(turn @ body.GetAngularVelocityAttr().Get(code))
        np.testing.assert_allclose(angular, qd[3:], atol=FLOAT)
    for path, moment in zip(magnets, moments, strict=True):
        np.testing.assert_allclose(
            stage.GetPrimAtPath(path).GetAttribute("warpmag:moment").Get(code), moment, rtol=1e-6
        )


@pytest.mark.parametrize("suffix", ["usda", "usdc", "usd"])
@pytest.mark.parametrize("copy_scene", [False, True])
def test_reopened_stage_equals_what_was_given(tmp_path, scene, suffix, copy_scene):
    times = [0.0, 0.01, 0.5, 1.0 / 3.0 + 0.5]
    output = tmp_path / "deep" / "out" / f"run.{suffix}"
    before = scene.read_text()
    bodies, magnets, frames = write(scene, output, times, copy_scene=copy_scene)
    assert len(bodies) == len(magnets) == 7 and scene.read_text() == before
    expected = {f"run.{suffix}", "run.cache.usdc", *(["run.scene.usdc"] if copy_scene else [])}
    assert set(os.listdir(output.parent)) == expected
    stage = Usd.Stage.Open(str(output))
    for time, frame in zip(times, frames, strict=True):
        assert_equal_to_frame(stage, 10.0 + 48.0 * time, bodies, magnets, frame)
    assert_equal_to_frame(stage, Usd.TimeCode.Default(), bodies, magnets, frames[0])


def test_size_of_bodies_is_kept(tmp_path, scene):
    bodies, _, _ = write(scene, tmp_path / "run.usda", [0.0, 0.5])
    before, after = open_stage(scene), Usd.Stage.Open(str(tmp_path / "run.usda"))
    for path in bodies:
        for code in (10.0, 34.0):
            sizes = []
            for stage, at in ((before, 10.0), (after, code)):
                matrix = np.array(UsdGeom.Xformable(stage.GetPrimAtPath(path)).ComputeLocalToWorldTransform(at))
                sizes.append(np.linalg.norm(matrix[:3, :3], axis=1))
            if path == "/World/Scaled/Nested":
                np.testing.assert_allclose(sizes[1], (1.0, 1.0, 1.0), atol=FLOAT)
            np.testing.assert_allclose(*sizes, atol=FLOAT, err_msg=path)


def test_metadata_of_the_root(tmp_path, scene):
    write(scene, tmp_path / "run.usda", [0.0, 0.125, 0.26])
    root = Sdf.Layer.FindOrOpen(str(tmp_path / "run.usda"))
    assert list(root.subLayerPaths) == ["./run.cache.usdc", "./scenes/scene.usda"]
    assert not root.rootPrims
    stage = Usd.Stage.Open(root)
    assert UsdGeom.GetStageMetersPerUnit(stage) == UsdPhysics.GetStageKilogramsPerUnit(stage) == 1.0
    assert UsdGeom.GetStageUpAxis(stage) == "Z"
    assert (stage.GetStartTimeCode(), stage.GetEndTimeCode()) == (10.0, 10.0 + 48.0 * 0.26)
    assert stage.GetDefaultPrim().GetPath() == "/World"
    assert stage.GetMetadata("documentation") == "A scene"
    clock = stage_clock(stage)
    assert (clock.time_codes_per_second, clock.frames_per_second) == (48.0, 24.0)
    samples = stage.GetAttributeAtPath("/World/Plain.xformOp:translate:warpmag").GetTimeSamples()
    assert samples[-1] == stage.GetEndTimeCode()
    for layer in stage.GetLayerStack(includeSessionLayers=False):
        assert layer.timeCodesPerSecond == 48.0


@pytest.mark.parametrize(("time", "frames"), [(0.667, 16.0), (0.666, 16.0), (0.26, 6.24), (0.04, 1.0)])
def test_a_stage_ends_at_a_whole_frame(time, frames, tmp_path, scene):
    """The last step is up to half a step beside a frame. One that is far from any frame has to be shown, too."""
    write(scene, tmp_path / "run.usda", [0.0, time])
    stage = Usd.Stage.Open(str(tmp_path / "run.usda"))
    assert stage.GetEndTimeCode() == pytest.approx(10.0 + 2.0 * frames, abs=1e-9)


@pytest.mark.parametrize(
    "rates",
    ["timeCodesPerSecond = 48\n    framesPerSecond = 24", "framesPerSecond = 30", "timeCodesPerSecond = 10", ""],
)
def test_animation_of_the_scene_keeps_its_time(tmp_path, scene, rates):
    """A layer without a rate of its own has a fallback; USD would rescale its samples if the root's differed."""
    text = scene.read_text().replace("timeCodesPerSecond = 48\n    framesPerSecond = 24", rates)
    scene.write_text(text)
    write(scene, tmp_path / "run.usda", [0.0, 0.1])
    stages = [Usd.Stage.Open(str(path)) for path in (scene, tmp_path / "run.usda")]
    assert stages[0].GetTimeCodesPerSecond() == stages[1].GetTimeCodesPerSecond()
    swings = [stage.GetAttributeAtPath("/World/Swinging.xformOp:translate") for stage in stages]
    assert swings[1].GetTimeSamples() == swings[0].GetTimeSamples() == [10.0, 20.0]


@pytest.mark.parametrize("layers", [1, 2])
def test_scene_in_a_package(tmp_path, scene, layers):
    package, top = str(tmp_path / "scene.usdz"), scene
    if layers == 2:
        top = scene.with_name("top.usda")
        layer = Sdf.Layer.CreateNew(str(top))
        UsdUtils.CopyLayerMetadata(Sdf.Layer.FindOrOpen(str(scene)), layer)
        layer.subLayerPaths[:] = ["./scene.usda"]
        layer.Save()
    assert UsdUtils.CreateNewUsdzPackage(str(top), package)
    bodies, magnets, frames = write(package, tmp_path / "run.usda", [0.0, 0.1])
    assert_equal_to_frame(Usd.Stage.Open(str(tmp_path / "run.usda")), 14.8, bodies, magnets, frames[1])


def test_orientations_do_not_flip(tmp_path, scene):
    bodies, _, _ = write(scene, tmp_path / "run.usda", [0.1 * k for k in range(20)])
    stage = Usd.Stage.Open(str(tmp_path / "run.usda"))
    for path in bodies:
        orient = stage.GetAttributeAtPath(f"{path}.xformOp:orient:warpmag")
        turns = [orient.Get(code) for code in orient.GetTimeSamples()]
        assert len(turns) == 20
        assert all(Gf.Dot(a, b) > 0.0 for a, b in itertools.pairwise(turns))


def test_what_stands_still_gets_no_samples(tmp_path, scene):
    stage = open_stage(scene)
    path = "/World/Scaled"
    still = np.array([[1.0, 2.0, 3.0, 0.0, 0.0, 0.0, 1.0]])
    with CacheWriter(stage, tmp_path / "run.usda", [path], [path]) as writer:
        for frame in range(5):
            writer.add_frame(frame / 24, still, np.zeros((1, 6)), [[0.0, 0.0, 1.0]])
    after = Usd.Stage.Open(str(tmp_path / "run.usda"))
    names = ("xformOp:translate:warpmag", "xformOp:orient:warpmag", "physics:velocity", "warpmag:moment")
    for name in names:
        assert after.GetPrimAtPath(path).GetAttribute(name).GetNumTimeSamples() == 0
    position, turn = body_frame(after.GetPrimAtPath(path), 12.0)
    np.testing.assert_array_equal(position, (1.0, 2.0, 3.0))
    np.testing.assert_array_equal(turn, np.eye(3))
    assert after.GetEndTimeCode() == 10.0 + 48.0 * 4 / 24


def test_interrupted_run_leaves_a_valid_stage(tmp_path, scene):
    stage = open_stage(scene)
    contents = survey(stage)
    frames = list(random_frames(3, len(contents.bodies), len(contents.magnets)))
    with (
        pytest.raises(KeyboardInterrupt),
        CacheWriter(stage, tmp_path / "run.usda", contents.bodies, list(contents.magnets)) as writer,
    ):
        for number, frame in enumerate(frames):
            writer.add_frame(number / 24, *frame)
        raise KeyboardInterrupt
    after = Usd.Stage.Open(str(tmp_path / "run.usda"))
    assert after.GetEndTimeCode() == 10.0 + 2 * 2.0
    assert_equal_to_frame(after, 14.0, contents.bodies, list(contents.magnets), frames[2])
    report = check(tmp_path / "run.usda")
    assert report.errors == report.broken_rules == ()


def test_without_frames_nothing_is_written(tmp_path, scene):
    stage = open_stage(scene)
    with CacheWriter(stage, tmp_path / "out" / "run.usda", ["/World/Plain"], []):
        pass
    assert os.listdir(tmp_path) == ["scenes"]


def test_failed_write_leaves_the_earlier_result(tmp_path, scene, monkeypatch):
    output = tmp_path / "out" / "run.usda"
    write(scene, output, [0.0, 0.1])
    kept = {name: (output.parent / name).read_bytes() for name in os.listdir(output.parent)}
    export = Sdf.Layer.Export

    def fail_for_the_root(layer, path, **options):
        if path.endswith(".usda"):
            raise OSError(28, "No space left on device", path)
        return export(layer, path, **options)

    monkeypatch.setattr(Sdf.Layer, "Export", fail_for_the_root)
    with pytest.raises(InputError, match="No space left"):
        write(scene, output, [0.0, 0.1, 0.2], seed=2)
    assert {name: (output.parent / name).read_bytes() for name in os.listdir(output.parent)} == kept


def test_second_run_replaces_the_first_also_where_it_is_open(tmp_path, scene):
    output = tmp_path / "run.usda"
    write(scene, output, [0.0, 0.1])
    stage = Usd.Stage.Open(str(output))
    bodies, magnets, frames = write(scene, output, [0.0, 0.1, 0.2], seed=2)
    assert_equal_to_frame(stage, 10.0 + 48.0 * 0.2, bodies, magnets, frames[2])


def test_input_is_never_overwritten(tmp_path, scene):
    stage = open_stage(scene)
    with pytest.raises(InputError, match="would overwrite"):
        CacheWriter(stage, scene, [], [])
    write(scene, tmp_path / "run.usda", [0.0, 0.1])
    for name in ("run.usda", "run.usdc"):  # the second shares its cache with the first
        with pytest.raises(InputError, match="would overwrite"):
            CacheWriter(open_stage(tmp_path / "run.usda"), tmp_path / name, [], [])


@pytest.mark.parametrize("name", ["run.abc", "run", "run.usdz"])
def test_other_suffixes_are_refused(tmp_path, scene, name):
    with pytest.raises(InputError, match=r"must end in \.usd"):
        CacheWriter(open_stage(scene), tmp_path / name, [], [])


def test_unwritable_places_are_refused_before_the_run(tmp_path, scene):
    (tmp_path / "file").write_text("")
    with pytest.raises(InputError, match="cannot write to"):
        CacheWriter(open_stage(scene), tmp_path / "file" / "run.usda", [], [])
    (tmp_path / "run.usda").mkdir()
    with pytest.raises(InputError, match="is a directory"):
        CacheWriter(open_stage(scene), tmp_path / "run.usda", [], [])


def test_time_must_rise(tmp_path, scene):
    writer = CacheWriter(open_stage(scene), tmp_path / "run.usda", [], [])
    writer.add_frame(0.5, np.zeros((0, 7)), np.zeros((0, 6)), np.zeros((0, 3)))
    with pytest.raises(ValueError, match="time must increase"):
        writer.add_frame(0.5, np.zeros((0, 7)), np.zeros((0, 6)), np.zeros((0, 3)))


def test_run_of_a_run_starts_where_it_is_held(tmp_path, scene):
    """A result is a scene again: moments and motion of the chosen time are what a new run begins with."""
    times = [0.0, 0.25, 0.5]
    bodies, magnets, frames = write(scene, tmp_path / "run.usda", times)
    stage = open_stage(tmp_path / "run.usda", 10.0 + 48.0 * 0.25)
    assert_equal_to_frame(stage, Usd.TimeCode.Default(), bodies, magnets, frames[1])
    moments = read_magnets(stage).initial_moments
    assert list(moments) == magnets
    np.testing.assert_allclose(list(moments.values()), frames[1][2], rtol=1e-6)


def test_validators_find_nothing_in_a_written_stage(tmp_path):
    balls_up.author(tmp_path / "scene.usdc", columns=3, rows=3, layers=1)
    write(tmp_path / "scene.usdc", tmp_path / "run.usda", [0.0, 0.1, 0.2])
    report = check(tmp_path / "run.usda")
    assert [str(finding) for finding in (*report.errors, *report.broken_rules)] == []


def test_newton_imports_the_state_that_was_exported(tmp_path, scene):
    """Velocities stand in the frame of the body, angular ones in degrees: what Newton reads."""
    newton = pytest.importorskip("newton")
    times = [0.0, 0.25, 0.5]
    bodies, _, frames = write(scene, tmp_path / "run.usda", times)
    for time, (body_q, body_qd, _) in zip(times, frames, strict=True):
        builder = newton.ModelBuilder()
        result = builder.add_usd(open_stage(tmp_path / "run.usda", 10.0 + 48.0 * time))["path_body_map"]
        assert set(result) == set(bodies)
        for path, q, qd in zip(bodies, body_q, body_qd, strict=True):
            pose = np.array(builder.body_q[result[path]])
            pose[3:] *= np.sign(pose[3:] @ q[3:])
            np.testing.assert_allclose(pose, q, atol=FLOAT, err_msg=path)
            np.testing.assert_allclose(np.array(builder.body_qd[result[path]]), qd, atol=FLOAT, err_msg=path)
