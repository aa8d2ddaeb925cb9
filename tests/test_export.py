"""Stages for renderers and arrays of numbers: the motion of a run value for value, meshes, materials, no physics."""

import csv
import importlib.util
import json
import math
import os
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest
from matplotlib.image import imread
from pxr import Gf, Usd, UsdGeom, UsdLux, UsdShade, UsdValidation

from bench.reference import oracle
from warpmag import cli
from warpmag.declarations.magnets import Magnet, MagneticSettings
from warpmag.errors import InputError
from warpmag.scenes_usd import authoring, balls_up
from warpmag.show.blender import render_final
from warpmag.show.export import export
from warpmag.show.magnet_overlays import trace
from warpmag.usd import CacheWriter, open_stage

R = 0.005  # m
FRAMES = 5
BODIES = ("/World/Ball", "/World/Big", "/World/Group/Box", "/World/Magnet")
MAGNETS = ("/World/Ball", "/World/Big", "/World/Magnet")
KINDS = {
    "plain.usda": {},
    "shaded.usdc": {"color": "speed", "arrows": True},
    "lines.usd": {"color": "magnetization", "field_lines": 5},
    "pulled.usdz": {"color": "force", "fps": 30.0},
}


def scene(path):
    """Balls of two sizes, a box in a group that is turned and moved, a magnet, a post that stands still, a ground."""
    stage = authoring.new_stage("Parts of all kinds", seconds=0.1)
    authoring.add_scene(stage, MagneticSettings(external_field=(0.0, 0.0, 3e3)))
    steel = authoring.add_material(stage, "Steel", color=(0.5, 0.5, 0.5), metallic=1.0)
    paint = authoring.add_material(stage, "Paint", color=(0.8, 0.1, 0.1))
    authoring.add_ground(stage, paint, size=1.0)
    authoring.add_ball(stage, "/World/Ball", (0.0, 0.0, R), R, steel, magnet=Magnet())
    authoring.add_ball(stage, "/World/Big", (0.05, 0.0, 2 * R), 2 * R, steel, magnet=Magnet())
    group = UsdGeom.Xform.Define(stage, "/World/Group")
    group.AddTranslateOp().Set(Gf.Vec3d(0.1, 0.02, 0.0))
    group.AddRotateZOp().Set(30.0)
    authoring.add_box(stage, "/World/Group/Box", (0.0, 0.0, 0.03), (0.01, 0.02, 0.03), paint)
    magnet = Magnet(kind="permanent", magnetization=(0.0, 0.0, 1e6))
    authoring.add_box(stage, "/World/Magnet", (0.0, 0.1, 0.02), (0.02,) * 3, paint, magnet=magnet)
    authoring.add_capsule(stage, "/World/Post", (-0.05, 0.0, 0.0), (-0.05, 0.0, 0.05), R, steel, color=(0.5, 0.5, 0.5))
    authoring.add_camera(stage, (0.3, -0.5, 0.3), (0.05, 0.0, 0.0))
    authoring.save(stage, path)


def frames():
    """Poses, velocities and moments of a made-up run."""
    random = np.random.default_rng(5)
    body_q = random.normal(size=(FRAMES, len(BODIES), 7))
    body_q[..., :3] = 0.05 * random.normal(size=(FRAMES, len(BODIES), 3)) + np.arange(4)[:, None] * (0.3, 0.0, 0.0)
    body_q[..., 3:] /= np.linalg.norm(body_q[..., 3:], axis=-1, keepdims=True)
    body_qd = random.normal(size=(FRAMES, len(BODIES), 6))
    moments = random.normal(size=(FRAMES, len(MAGNETS), 3))
    return body_q.astype(np.float32), body_qd.astype(np.float32), moments.astype(np.float32)


@pytest.fixture(scope="module")
def run(tmp_path_factory):
    """The stage of a run at 60 Hz whose frames are known."""
    folder = tmp_path_factory.mktemp("export")
    scene(folder / "scene.usda")
    with CacheWriter(open_stage(folder / "scene.usda"), folder / "out.usda", BODIES, MAGNETS, frames=FRAMES) as writer:
        for frame, values in enumerate(zip(*frames(), strict=True)):
            writer.add_frame(round(1000.0 * frame / 60.0) / 1000.0, *values)  # at steps of 1 ms
    return folder / "out.usda"


@pytest.fixture(scope="module")
def exported(run, device):
    """The stage of each kind of output."""
    for name, options in KINDS.items():
        export(run, run.with_name(name), device=device, **options)
    return {name: Usd.Stage.Open(str(run.with_name(name))) for name in KINDS}


@pytest.mark.parametrize("name", KINDS)
def test_the_motion_is_that_of_the_run(name, exported):
    stage = exported[name]
    rate = KINDS[name].get("fps", 24.0)
    assert stage.GetTimeCodesPerSecond() == stage.GetFramesPerSecond() == rate
    assert (stage.GetStartTimeCode(), stage.GetEndTimeCode()) == (0.0, math.ceil(0.067 * rate - 0.05))
    assert UsdGeom.GetStageMetersPerUnit(stage) == 1.0 and UsdGeom.GetStageUpAxis(stage) == "Z"
    body_q, body_qd, _ = frames()
    for path, rows in (("Balls", [0, 1]), ("Bodies", [2, 3])):
        prim = UsdGeom.PointInstancer.Get(stage, f"/World/Render/{path}")
        codes = prim.GetPositionsAttr().GetTimeSamples()
        np.testing.assert_allclose(codes, [rate * time for time in (0.0, 0.017, 0.033, 0.05, 0.067)], atol=1e-9)
        for frame, code in enumerate(codes):
            # written into the turned group in double precision and taken back
            np.testing.assert_allclose(prim.GetPositionsAttr().Get(code), body_q[frame, rows, :3], rtol=0, atol=1e-8)
            # turned into the body's frame and back in single precision
            np.testing.assert_allclose(prim.GetVelocitiesAttr().Get(code), body_qd[frame, rows, :3], atol=3e-6)
            if path == "Bodies":
                turns = np.array(prim.GetOrientationsAttr().Get(code), dtype=float)
                turns /= np.linalg.norm(turns, axis=1, keepdims=True)  # half precision
                cosines = np.abs(np.einsum("ni,ni->n", turns, body_q[frame, rows, 3:]))
                np.testing.assert_allclose(cosines, 1.0, atol=1e-6)
                spins = np.radians(prim.GetAngularVelocitiesAttr().Get(code))
                np.testing.assert_allclose(spins, body_qd[frame, rows, 3:], atol=1e-5)


def test_positions_of_free_balls_are_the_same_to_the_bit(exported):
    prim = UsdGeom.PointInstancer.Get(exported["plain.usda"], "/World/Render/Balls")
    for frame, code in enumerate(prim.GetPositionsAttr().GetTimeSamples()):
        np.testing.assert_array_equal(prim.GetPositionsAttr().Get(code), frames()[0][frame, :2, :3])


@pytest.mark.parametrize("name", KINDS)
def test_everything_is_a_mesh_with_a_material_and_none_simulates(name, exported):
    stage = exported[name]
    drawn = [prim for prim in stage.Traverse() if prim.IsA(UsdGeom.Gprim)]
    assert {prim.GetTypeName() for prim in drawn} <= {"Mesh", "BasisCurves"} and len(drawn) >= 5
    for prim in drawn:
        material, _ = UsdShade.MaterialBindingAPI(prim).ComputeBoundMaterial()
        assert material and material.ComputeSurfaceSource()[0], prim.GetPath()
        assert prim.IsA(UsdGeom.BasisCurves) or UsdGeom.Mesh(prim).GetNormalsAttr().Get()
    assert len([prim for prim in stage.Traverse() if prim.HasAPI(UsdLux.LightAPI)]) == 3
    assert stage.GetPrimAtPath("/World/Camera") and stage.GetDefaultPrim().GetName() == "World"
    text = stage.GetRootLayer().ExportToString()
    assert "Physics" not in text and "physics:" not in text and "warpmag:" not in text and "newton" not in text


@pytest.mark.parametrize("name", KINDS)
def test_outputs_are_valid(name, exported):
    registry = UsdValidation.ValidationRegistry()
    errors = UsdValidation.ValidationContext(registry.GetOrLoadAllValidators()).Validate(exported[name])
    assert [error.GetMessage() for error in errors] == []


def test_shapes_keep_their_places_and_sizes(exported, run):
    """Boxes of what is drawn, at each sample, are those of the stage that the run wrote."""
    stage, source = exported["plain.usda"], Usd.Stage.Open(str(run))
    paths = {"/World/Post": "/World/Post", "/World/Ground": "/World/Ground"}
    for path, own in paths.items():
        boxes = [
            UsdGeom.BBoxCache(0.0, [UsdGeom.Tokens.default_])
            .ComputeWorldBound(entry.GetPrimAtPath(at))
            .ComputeAlignedBox()
            for entry, at in ((source, path), (stage, own))
        ]
        np.testing.assert_allclose(boxes[1].GetMin(), boxes[0].GetMin(), atol=1e-7)
        np.testing.assert_allclose(boxes[1].GetMax(), boxes[0].GetMax(), atol=1e-7)
    balls = UsdGeom.PointInstancer.Get(stage, "/World/Render/Balls")
    np.testing.assert_allclose(np.array(balls.GetScalesAttr().Get())[:, 0], (R, 2 * R), rtol=1e-6)
    bodies = UsdGeom.PointInstancer.Get(stage, "/World/Render/Bodies")
    sides = [
        np.ptp(np.array(UsdGeom.Mesh.Get(stage, path).GetPointsAttr().Get()), axis=0)
        for path in bodies.GetPrototypesRel().GetTargets()
    ]
    np.testing.assert_allclose(sides, [(0.01, 0.02, 0.03), (0.02,) * 3], rtol=1e-5)


def test_colours_follow_the_speed(exported, run):
    """The fastest have the last colour, those at rest the first; steps of a 23rd between."""
    stage = exported["shaded.usdc"]
    speeds = np.linalg.norm(frames()[1][..., :3], axis=-1)
    top = np.quantile(speeds, 0.99)
    for path, rows in (("Balls", [0, 1]), ("Bodies", [2, 3])):
        prim = UsdGeom.PointInstancer.Get(stage, f"/World/Render/{path}")
        prototypes = prim.GetPrototypesRel().GetTargets()
        for frame, code in enumerate(
            exported["shaded.usdc"].GetPrimAtPath(prim.GetPath()).GetAttribute("positions").GetTimeSamples()
        ):
            shades = []
            for kind in prim.GetProtoIndicesAttr().Get(code):
                bound, _ = UsdShade.MaterialBindingAPI(stage.GetPrimAtPath(prototypes[kind])).ComputeBoundMaterial()
                shades.append(int(bound.GetPrim().GetName().removeprefix("Shade_")))
            expected = 23.0 * np.minimum(speeds[frame, rows] / top, 1.0)
            np.testing.assert_allclose(shades, expected, atol=0.51)


def test_arrows_point_along_the_moments(exported):
    stage = exported["shaded.usdc"]
    prim = UsdGeom.PointInstancer.Get(stage, "/World/Render/Moments")
    body_q, _, moments = frames()
    for frame, code in enumerate(prim.GetPositionsAttr().GetTimeSamples()):
        np.testing.assert_allclose(prim.GetPositionsAttr().Get(code), body_q[frame, [0, 1, 3], :3], atol=1e-7)
        for turn, moment in zip(prim.GetOrientationsAttr().Get(code), moments[frame], strict=True):
            along = Gf.Rotation(Gf.Quatd(turn)).TransformDir(Gf.Vec3d(0.0, 0.0, 1.0))
            np.testing.assert_allclose(along, moment / np.linalg.norm(moment), atol=3e-3)  # half precision
    strength = np.linalg.norm(moments, axis=-1) / (4 / 3 * math.pi * R**3, 4 / 3 * math.pi * 8 * R**3, 0.02**3)
    lengths = np.array(
        [np.array(prim.GetScalesAttr().Get(code))[:, 0] for code in prim.GetScalesAttr().GetTimeSamples()]
    )
    np.testing.assert_allclose(lengths, 1.6 * np.array([2 * R, 4 * R, 0.02]) * strength / strength.max(), rtol=1e-2)


def test_field_lines_are_those_of_a_dipole():
    """r = r0 sin²θ about the axis of a point dipole; the midpoint rule with 0.05 of its size a step, to 1e-3."""
    moment = np.array([[0.0, 0.0, 2.0]])

    def field(points):
        return oracle.h_field(np.zeros((1, 3)), moment, points)

    seeds = np.array([[0.3 * math.sin(angle), 0.0, 0.3 * math.cos(angle)] for angle in (0.5, 0.7, 0.9)])
    lines = trace(field, lambda points: np.linalg.norm(points, axis=1) < 0.29, seeds, 0.3)
    radii = np.linalg.norm(lines, axis=2)
    sines = np.linalg.norm(lines[..., :2], axis=2) / radii
    widths = 0.3 / np.sin((0.5, 0.7, 0.9)) ** 2
    np.testing.assert_allclose(radii / sines**2, np.broadcast_to(widths[:, None], radii.shape), rtol=3e-3)
    assert (lines[:, -1, 2] < 0.0).all()  # they come back on the other side
    assert (np.linalg.norm(lines[:, -1], axis=1) < 0.31).all()


def test_field_lines_begin_at_the_pole_of_the_magnet(exported):
    points = UsdGeom.BasisCurves.Get(exported["lines.usd"], "/World/Render/FieldLines").GetPointsAttr()
    body_q, _, moments = frames()
    first = np.array(points.Get(0.0)).reshape(5, -1, 3)[:, 0]
    away = first - body_q[0, 3, :3]
    assert (away @ moments[0, 2] > 0.0).all()
    half = np.linalg.norm(away, axis=1)
    assert (half > 0.01).all() and (half < 0.01 * math.sqrt(3.0) + 1e-3).all()
    assert len(points.GetTimeSamples()) == FRAMES


def test_numbers_are_those_of_the_run(run):
    body_q, body_qd, moments = frames()
    export(run, run.with_name("numbers.npz"))
    with np.load(run.with_name("numbers.npz")) as result:
        assert result["bodies"].tolist() == list(BODIES) and result["magnets"].tolist() == list(MAGNETS)
        np.testing.assert_allclose(result["time"], (0.0, 0.017, 0.033, 0.05, 0.067), atol=1e-9)
        np.testing.assert_allclose(result["positions"], body_q[..., :3], atol=1e-8)
        assert (np.abs(np.einsum("fni,fni->fn", result["orientations"], body_q[..., 3:])) > 1.0 - 1e-6).all()
        np.testing.assert_allclose(result["velocities"], body_qd[..., :3], atol=3e-6)
        np.testing.assert_allclose(result["angular_velocities"], body_qd[..., 3:], atol=3e-6)
        np.testing.assert_array_equal(result["moments"], moments)
    export(run, run.with_name("numbers.csv"))
    with open(run.with_name("numbers.csv"), encoding="utf-8", newline="") as file:
        rows = list(csv.DictReader(file))
    assert len(rows) == FRAMES * len(BODIES)
    assert rows[7]["prim"] == "/World/Magnet" and float(rows[7]["time [s]"]) == pytest.approx(0.017)
    assert [float(rows[7][f"m{axis} [A m2]"]) for axis in "xyz"] == moments[1, 2].tolist()
    np.testing.assert_allclose([float(rows[7][f"{axis} [m]"]) for axis in "xyz"], body_q[1, 3, :3], atol=1e-8)


def test_a_scene_that_has_not_run_is_a_still(tmp_path, device):
    scene(tmp_path / "scene.usda")
    export(tmp_path / "scene.usda", tmp_path / "out.usdc", materialx=True)
    stage = Usd.Stage.Open(str(tmp_path / "out.usdc"))
    balls = UsdGeom.PointInstancer.Get(stage, "/World/Render/Balls")
    np.testing.assert_allclose(balls.GetPositionsAttr().Get(), [(0, 0, R), (0.05, 0, 2 * R)], atol=1e-8)
    steel = UsdShade.Material.Get(stage, "/World/Materials/Steel")
    shader, _, _ = steel.ComputeSurfaceSource("mtlx")
    assert shader.GetShaderId() == "ND_standard_surface_surfaceshader"
    assert shader.GetInput("metalness").Get() == 1.0
    with pytest.raises(InputError, match=r"scene\.usda: has no moments to show"):
        export(tmp_path / "scene.usda", tmp_path / "two.usdc", arrows=True)


def test_a_kinematic_body_that_has_not_moved_stays(tmp_path):
    balls_up.author(tmp_path / "scene.usda", columns=2, rows=2, layers=1)
    export(tmp_path / "scene.usda", tmp_path / "out.usdc")
    stage = Usd.Stage.Open(str(tmp_path / "out.usdc"))
    assert stage.GetPrimAtPath("/World/Magnet").IsA(UsdGeom.Mesh)


def test_a_mesh_may_be_a_body_itself(tmp_path):
    """And not only a shape of a body: the tetrahedron of the workshop."""
    export(Path(__file__).with_name("fuzz") / "workshop.usda", tmp_path / "out.usdc")
    stage = Usd.Stage.Open(str(tmp_path / "out.usdc"))
    prototypes = stage.GetPrimAtPath("/World/Render/Bodies/Prototypes").GetChildren()
    corners = [list(UsdGeom.Mesh(prim).GetFaceVertexIndicesAttr().Get()) for prim in prototypes]
    assert [0, 2, 1, 0, 1, 3, 0, 3, 2, 1, 2, 3] in corners


@pytest.mark.parametrize(
    "output,options,message",
    [
        ("out.usda", {}, "would overwrite the exported scene"),
        ("new.png", {}, "a stage must end in"),
        ("new.usda", {"color": "taste"}, "color: 'taste'"),
        ("new.usda", {"fps": 0.0}, "fps: must be positive"),
        ("new.usda", {"field_lines": -1}, "field_lines: must be"),
        ("scene.usda/new.usda", {}, "cannot be written"),
    ],
)
def test_invalid_exports_raise_an_error_of_one_line(run, output, options, message):
    before = sorted(os.listdir(run.parent))
    with pytest.raises(InputError, match=message) as error:
        export(run, run.parent / output, **options)
    assert "\n" not in str(error.value)
    assert sorted(os.listdir(run.parent)) == before


def test_a_run_for_renderers(tmp_path, device, capsys):
    balls_up.author(tmp_path / "scene.usda", columns=2, rows=1, layers=1, height=0.05)
    command = ["run", str(tmp_path / "scene.usda"), "-o", str(tmp_path / "out.usda"), "--frames", "2"]
    assert cli.main([*command, "--device", device, "--for", "render"]) == 0
    assert f"to render      {tmp_path / 'out.render.usdc'}" in capsys.readouterr().out
    assert Usd.Stage.Open(str(tmp_path / "out.render.usdc")).GetPrimAtPath("/World/Render/Balls")
    assert cli.main(["export", str(tmp_path / "out.usda"), "-o", str(tmp_path / "a.usdz"), "--color", "force"]) == 0
    assert "color          force, from 0 to" in capsys.readouterr().out


def test_an_invalid_finished_picture_raises_an_error_of_one_line(run, monkeypatch):
    monkeypatch.setenv("WARPMAG_BLENDER", str(run.with_name("no_python")))
    command = ["render", str(run), "--quality", "final", "-o"]
    for arguments, message in (
        ([run.with_name("a.gif")], "a finished picture must end in .png or .jpg"),
        ([run.with_name("a.png"), "--size", "0x9"], "width: must be at least 1"),
        ([run.with_name("a.png"), "--frames", "0:3"], "quality: 'final' draws one frame"),
        ([run.with_name("a.png")], "WARPMAG_BLENDER: .*no_python is not a Python that can be started"),
    ):
        with pytest.raises(InputError, match=message):
            options = cli._parser().parse_args([*command, *map(str, arguments)])
            options.command(options)
    monkeypatch.setenv("WARPMAG_BLENDER", sys.executable)  # which has none
    if not importlib.util.find_spec("bpy"):
        with pytest.raises(InputError, match="Blender could not draw it .*No module named 'bpy'"):
            render_final(run, run.with_name("a.png"))
    with pytest.raises(InputError, match="frame: .* has frames 0 to 4, got 5"):
        render_final(run, run.with_name("a.png"), frame=5)
    for frame in ("1", 1.5, True, [1]):
        with pytest.raises(InputError, match="^frame: must be a whole number, got "):
            render_final(run, run.with_name("a.png"), frame=frame)
    for size in (None, 16, (16, 9, 1), "ab", (16.0, 9)):
        with pytest.raises(InputError, match="^size: must be two whole numbers|^size: must be a whole number"):
            render_final(run, run.with_name("a.png"), size=size)


BLENDER = os.environ.get("WARPMAG_BLENDER", sys.executable if importlib.util.find_spec("bpy") else "")
"""A Python that has ``bpy``: Blender's USD and ours cannot live in one process."""


@pytest.mark.skipif(not BLENDER, reason="needs bpy, here or in the Python that WARPMAG_BLENDER names")
@pytest.mark.parametrize("name", KINDS)
def test_blender_shows_every_body(name, exported, run, tmp_path):
    """Where and when the run has it, in metres, with a material, before the camera; neither dark nor glaring."""
    script = Path(__file__).with_name("blender_look.py")
    arguments = [BLENDER, str(script), str(run.with_name(name)), str(tmp_path / "picture.png")]
    done = subprocess.run(arguments, capture_output=True, text=True, timeout=600)
    assert done.returncode == 0, done.stderr
    seen = json.loads(done.stdout.splitlines()[-1])
    body_q, _, _ = frames()
    assert seen["range"] == [0, math.ceil(0.067 * KINDS[name].get("fps", 24.0) - 0.05)]
    assert seen["unit"] == 1.0 and seen["camera"] and seen["lights"] == 2
    assert seen["without_material"] == []
    times = np.array([0.0, 0.017, 0.033, 0.05, 0.067])
    for name_of_frame, code in zip(("first", "last"), seen["range"], strict=True):
        at = min(code / KINDS[name].get("fps", 24.0), times[-1])
        places = np.array(seen[name_of_frame])
        for body in range(len(BODIES)):  # straight between samples
            place = [np.interp(at, times, body_q[:, body, axis]) for axis in range(3)]
            assert np.linalg.norm(places - place, axis=1).min() < 1e-5
    assert 0.2 < seen["brightness"] < 0.8


@pytest.mark.skipif(not BLENDER, reason="needs bpy, here or in the Python that WARPMAG_BLENDER names")
def test_a_finished_picture(run, monkeypatch):
    """It has the size asked for, and is neither dark nor glaring."""
    monkeypatch.setenv("WARPMAG_BLENDER", BLENDER)
    written = render_final(run, run.with_name("final.png"), frame=2, size=(160, 90), samples=4)
    pixels = imread(written)[..., :3]
    assert pixels.shape == (90, 160, 3) and 0.2 < pixels.mean() < 0.8
