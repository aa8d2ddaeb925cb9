"""Instancers of very many balls stay instancers in what a run writes, and say there what prims would say."""

import numpy as np
import pytest
from pxr import Usd, UsdGeom
from test_usd_instancers import BALL, MAGNET, instancer, write

from warpmag.engine.stepping.scene import import_scene
from warpmag.engine.stepping.simulation import Simulation
from warpmag.show.export import export
from warpmag.usd import Playback, check, open_animated, read_recording
from warpmag.usd.read import identical_balls
from warpmag.usd.read.instancers import expand_instancers
from warpmag.usd.write import instancer_frames

COUNT, FRAMES = 12, 3
LAST = float(FRAMES)
MATERIAL = """uniform token[] xformOpOrder = ["xformOp:translate", "xformOp:rotateX"]
    double3 xformOp:translate = (0.002, 0, 0.001)
    double xformOp:rotateX = 40
"""
SHIFTED = BALL.replace('"Ball"', '"Shifted"').replace("radius = 0.004", f"radius = 0.004\n{MATERIAL}")
LINES = f"""
    quatf[] orientationsf = [{", ".join(["(1, 0, 0, 0)", "(0.6, 0, 0.8, 0)", "(0.5, 0.5, -0.5, 0.5)"] * 4)}]
    float3[] scales = [{", ".join(["(1, 1, 1)", "(1, 1, 1)", "(1.5, 1.5, 1.5)"] * 4)}]
    vector3f[] velocities = [{", ".join(f"(0.01, {0.02 * k}, 0.3)" for k in range(COUNT))}]
    vector3f[] angularVelocities = [{", ".join(f"({90 * k}, 0, 300)" for k in range(COUNT))}]
"""
OUTER = "int[] protoIndices = [0]\npoint3f[] positions = [(0, 0, 1)]\n"


@pytest.fixture(scope="module")
def runs(device, tmp_path_factory):
    """Outputs of a run of balls of two prototypes and sizes that spin: as an instancer, of a run that was interrupted
    and resumed, and as prims."""
    folder, places = tmp_path_factory.mktemp("swarm"), [(0.03 * k, 0.02 * (k % 3), 0.05) for k in range(COUNT)]
    path = write(folder, instancer(["Ball", "Shifted"], [0, 0, 1] * 4, places, LINES, BALL + SHIFTED), MAGNET)
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(identical_balls, "COMPACT_COUNT", COUNT)
        patch.setattr(instancer_frames, "_BLOCK", 3)  # several blocks, the last one smaller
        Simulation(path, device=device).run(FRAMES, output=folder / "whole.usda", on_frame=lambda frame: frame < 1)
        Simulation(path, device=device).run(FRAMES, output=folder / "whole.usda", resume=True)
        patch.setattr(identical_balls, "COMPACT_COUNT", COUNT + 1)
        Simulation(path, device=device).run(FRAMES, output=folder / "prims.usda")
    return folder


@pytest.fixture
def whole(runs, monkeypatch):
    monkeypatch.setattr(identical_balls, "COMPACT_COUNT", COUNT)
    return runs / "whole.usda"


def arrays(recording):
    """What a recording holds of each body and magnet, by name."""
    bodies = zip(recording.positions, recording.rotations, recording.linear, recording.angular, strict=True)
    values = np.concatenate([np.concatenate(body, axis=-1)[None] for body in bodies])
    rows = {name: values[:, row] for row, name in enumerate(recording.bodies)}
    moments = {name: recording.moments[:, row] for row, name in enumerate(recording.magnets)}
    return rows, moments, dict(zip(recording.magnets, recording.permanent.tolist(), strict=True))


def same(computed, wanted, atol):
    assert computed.keys() == wanted.keys()
    for name, values in wanted.items():
        np.testing.assert_allclose(computed[name], values, rtol=1e-6, atol=atol, err_msg=name)


def test_an_instancer_says_what_prims_say(runs, whole):
    first, other = (read_recording(*open_animated(runs / f"{name}.usda")) for name in ("whole", "prims"))
    np.testing.assert_array_equal(first.codes, other.codes)
    (rows, moments, permanent), (wanted, theirs, kinds) = arrays(first), arrays(other)
    assert len(rows) == COUNT and min(np.ptp(values[:, 2]) for values in rows.values()) > 3e-3  # they fly
    for name, values in wanted.items():  # quaternions have two signs; one stays what it was from frame to frame
        sign = np.sign((values[:1, 3:7] * rows[name][:1, 3:7]).sum())
        rows[name][:, 3:7] *= sign
    same(rows, wanted, 3e-6)  # single precision of positions up to 0.5 m, of speeds up to 2 m/s and 30 rad/s
    same(moments, theirs, 1e-9)
    assert permanent == kinds


def test_other_readers_find_the_balls_where_prims_are(runs, whole):
    stage, prims = Usd.Stage.Open(str(whole)), Usd.Stage.Open(str(runs / "prims.usda"))
    many, kinds = UsdGeom.PointInstancer(stage.GetPrimAtPath("/World/Many")), UsdGeom.PointInstancer
    assert many and not many.GetPrim().GetChild("instance0")
    world = UsdGeom.XformCache(LAST).GetLocalToWorldTransform(many.GetPrim())
    actual = many.ComputeInstanceTransformsAtTime(LAST, LAST, kinds.IncludeProtoXform, kinds.IgnoreMask)
    places = UsdGeom.XformCache(LAST)
    for row in range(COUNT):
        prim = prims.GetPrimAtPath(f"/World/Many/instance{row}/{['Ball', 'Ball', 'Shifted'][row % 3]}")
        wanted = np.array(places.GetLocalToWorldTransform(prim))
        np.testing.assert_allclose(np.array(actual[row] * world), wanted, atol=1e-6)
    middles = np.array([entry.ExtractTranslation() for entry in actual])
    reach = 0.004 * np.array([[1.0], [1.0], [1.5]] * 4)
    box = np.array([(middles - reach).min(axis=0), (middles + reach).max(axis=0)])
    np.testing.assert_allclose(np.array(many.GetExtentAttr().Get(LAST)), box, atol=1e-6)


def test_it_is_checked_and_goes_on_as_prims_do(runs, whole):
    reports = [check(runs / f"{name}.usda") for name in ("whole", "prims")]
    for report in reports:
        assert not report.errors
        assert {first.message.rpartition(".")[2] for first in report.broken_rules} == {
            "MissingDefaultPrim]"
        }  # the scene's
    first, other = (report.contents for report in reports)
    for name in ("bodies", "colliders", "magnets"):
        assert sorted(getattr(first, name)) == sorted(getattr(other, name)) and len(first.bodies) == COUNT
    actual, wanted = (import_scene(runs / f"{name}.usda", time_code=LAST) for name in ("whole", "prims"))
    assert (len(actual.swarms), len(wanted.swarms)) == (1, 0)
    for name in ("body_q", "body_qd"):
        given = [(getattr(scene.builder, name), scene.bodies) for scene in (actual, wanted)]
        values = [np.array([array[bodies[prim]] for prim in first.bodies]) for array, bodies in given]
        if name == "body_q":
            values[0][:, 3:] *= np.sign((values[0][:, 3:] * values[1][:, 3:]).sum(axis=1, keepdims=True))
        np.testing.assert_allclose(*values, rtol=1e-6, atol=3e-6)
    assert actual.magnets.initial_moments.keys() == wanted.magnets.initial_moments.keys()
    for prim, moment in wanted.magnets.initial_moments.items():
        np.testing.assert_allclose(actual.magnets.initial_moments[prim], moment, rtol=1e-6)


def test_it_is_played_and_exported_as_prims_are(runs, whole, tmp_path):
    shown, poses, moments = [], [], []
    for name in ("whole", "prims"):
        scene = import_scene(runs / f"{name}.usda")
        motion = Playback(scene.stage, scene.swarms)
        motion.seek(LAST)
        names = sorted(scene.bodies)
        poses.append(motion.poses(names)[:, :3])
        moments.append(motion.moments([*names, "/Magnet"]))
        export(runs / f"{name}.usda", tmp_path / "out.usdc", fps=60.0, color="magnetization", arrows=True)
        stage = Usd.Stage.Open(str(tmp_path / "out.usdc"))
        balls = UsdGeom.PointInstancer(stage.GetPrimAtPath("/World/Render/Balls"))
        above = UsdGeom.XformCache(LAST).GetLocalToWorldTransform(balls.GetPrim())
        seen = np.array([above.Transform(entry) for entry in balls.GetPositionsAttr().Get(LAST)])
        rows = np.c_[seen, np.array(balls.GetScalesAttr().Get())[:, :1], np.array(balls.GetVelocitiesAttr().Get(LAST))]
        shown.append(rows[np.argsort(rows[:, 0])])
    np.testing.assert_allclose(*poses, atol=1e-6)
    assert np.linalg.norm(moments[0], axis=1).min() > 0.0
    np.testing.assert_allclose(*moments, rtol=1e-6)
    np.testing.assert_allclose(*shown, rtol=1e-6, atol=3e-6)


def test_few_balls_and_those_that_are_not_alone_become_prims(runs, monkeypatch):
    """An instancer that is scaled, that moves or speeds up, or that holds something else beside balls that are alike;
    and each ball by itself where something may speak of single ones."""
    monkeypatch.setattr(identical_balls, "COMPACT_COUNT", COUNT)
    text = (runs / "scene.usda").read_text()
    by_two = '"xformOp:rotateZ", "xformOp:scale"]\n float3 xformOp:scale = (2, 2, 2)'
    scaled = text.replace('"xformOp:rotateZ"]', by_two, 1)
    moved = text.replace("double xformOp:rotateZ = 30", "double xformOp:rotateZ.timeSamples = { 0: 30, 60: 30 }")
    single = text.replace("protoIndices = [0, 0, 1, 0,", "protoIndices = [1, 0, 1, 0,")
    faster = text.replace(
        "vector3f[] velocities", f"vector3f[] accelerations = {[(0, 0, 1)] * COUNT}\nvector3f[] velocities"
    )
    several = {"scaled": scaled, "moved": moved, "single": single, "faster": faster, "same": text}
    for name, other in several.items():
        assert (other == text) == (name == "same")
        path = runs / f"{name}.usda"
        path.write_text(other)
        deferred = expand_instancers(Usd.Stage.Open(str(path)), 0.0, defer=True)
        assert deferred, name
        assert {balls.stays_instancer for balls in deferred} == {name == "same"}, name
    for name, more in (
        ("joint", 'def PhysicsFixedJoint "Joint" {\nrel physics:body1 = </World/Many/instance1/Ball>\n}\n'),
        ("group", 'def PhysicsCollisionGroup "Group" {\n}\n'),
        ("pairs", 'def Scope "Pairs" (prepend apiSchemas = ["PhysicsFilteredPairsAPI"]) {\n}\n'),
        ("outer", f'def PointInstancer "Outer" {{\nrel prototypes = </World>\n{OUTER}}}\n'),
    ):
        path = runs / f"{name}.usda"
        path.write_text(text + more)
        assert not expand_instancers(Usd.Stage.Open(str(path)), 0.0, defer=True), name
