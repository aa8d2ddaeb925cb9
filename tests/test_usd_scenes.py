"""The bundled scenes: what they hold, and what Newton makes of them."""

import math
import subprocess
import sys

import numpy as np
import pytest
from pxr import UsdGeom

from warpmag.declarations.magnets import Magnet, MagneticSettings
from warpmag.errors import InputError
from warpmag.scenes_usd import balls_up, bundled
from warpmag.usd import check, describe, open_stage, read_magnets


def test_bundled_scenes_are_small_and_described():
    scenes = bundled()
    assert "balls_up" in scenes
    for path in scenes.values():
        assert path.stat().st_size < 2**20
        assert len(describe(path)) > 20


def test_bundled_names_need_no_usd():
    program = "import sys\nfrom warpmag.scenes_usd import bundled\nbundled()\nprint('pxr' in sys.modules)"
    done = subprocess.run([sys.executable, "-c", program], capture_output=True, text=True, check=True)
    assert done.stdout.strip() == "False"


def test_balls_up_is_the_scene_of_the_paper():
    report = check(bundled()["balls_up"])
    assert len(report.magnets("inducible")) == 243
    assert report.magnets("permanent") == report.contents.kinematic == ["/World/Magnet"]
    assert report.contents.magnets["/World/Magnet"].magnetization == (0.0, 0.0, 1e6)
    assert all(report.contents.magnets[path] == Magnet(conductivity=1e7) for path in report.magnets("inducible"))
    assert report.contents.settings == MagneticSettings()
    assert (report.clock.step, report.clock.frames_per_second, report.clock.start) == (1e-3, 60.0, 0.0)


def test_balls_of_balls_up_touch_nothing(tmp_path):
    path = tmp_path / "scene.usdc"
    balls_up.author(path, columns=4, rows=3, layers=5, radius=0.003, height=0.2)
    stage = open_stage(path)
    magnets = read_magnets(stage).magnets
    balls = [UsdGeom.Sphere.Get(stage, name) for name, magnet in magnets.items() if magnet.kind == "inducible"]
    centers = np.array([ball.ComputeLocalToWorldTransform(0.0).ExtractTranslation() for ball in balls])
    distances = np.linalg.norm(centers[:, None] - centers[None], axis=2)[~np.eye(60, dtype=bool)]
    assert len(balls) == 60 and centers[:, 2].min() == pytest.approx(0.003)
    assert 2.0 * 0.003 < distances.min() < 2.01 * 0.003
    np.testing.assert_allclose(centers[:, :2].mean(axis=0), 0.0, atol=1e-12)


def test_a_magnet_inside_the_stack_is_refused(tmp_path):
    with pytest.raises(InputError, match="height"):
        balls_up.author(tmp_path / "scene.usdc", layers=8)
    assert not (tmp_path / "scene.usdc").exists()


def test_the_script_runs_from_the_command_line(tmp_path):
    path = tmp_path / "deep" / "scene.usda"
    command = [sys.executable, "-m", "warpmag.scenes_usd.balls_up", "--layers", "1", "--columns", "2", "-o", str(path)]
    subprocess.run(command, check=True)
    assert len(check(path).magnets("inducible")) == 18


def test_newton_imports_balls_up():
    newton = pytest.importorskip("newton")
    builder = newton.ModelBuilder()
    result = builder.add_usd(open_stage(bundled()["balls_up"]))
    assert builder.body_count == 244 and builder.shape_count == 245
    assert result["physics_dt"] == 1e-3
    assert set(read_magnets(open_stage(bundled()["balls_up"])).magnets) == set(result["path_body_map"])
    np.testing.assert_allclose(builder.gravity, (0.0, 0.0, -9.81), rtol=1e-6)
    ball_mass = 7870.0 * 4.0 / 3.0 * math.pi * 0.005**3
    for path, body in result["path_body_map"].items():
        shape = result["path_shape_map"][path]
        if path == "/World/Magnet":
            assert builder.body_flags[body] & int(newton.BodyFlags.KINEMATIC)
            assert builder.shape_type[shape] == newton.GeoType.BOX
            np.testing.assert_allclose(builder.shape_scale[shape], 0.02, rtol=1e-6)
        else:
            # float32 sums in the importer
            assert builder.body_mass[body] == pytest.approx(ball_mass, rel=1e-5)
            assert builder.shape_type[shape] == newton.GeoType.SPHERE
            assert builder.shape_scale[shape][0] == pytest.approx(0.005, rel=1e-6)
    plane = result["path_shape_map"]["/World/Ground"]
    assert builder.shape_type[plane] == newton.GeoType.PLANE and builder.shape_body[plane] == -1
    assert tuple(builder.shape_scale[plane])[:2] == (0.0, 0.0)  # infinite
    assert set(builder.shape_material_mu) == set(builder.shape_material_restitution) == {0.0}


def test_newton_takes_y_up_stages_as_they_are(tmp_path):
    """With the stage's own up axis Newton's world is the stage's world, so that results go back unturned."""
    newton = pytest.importorskip("newton")
    balls_up.author(tmp_path / "scene.usda", columns=2, rows=1, layers=1, height=0.08)
    text = (tmp_path / "scene.usda").read_text().replace('upAxis = "Z"', 'upAxis = "Y"')
    (tmp_path / "turned.usda").write_text(text.replace("gravityDirection = (0, 0, -1)", "gravityDirection = (0, 0, 0)"))
    builder = newton.ModelBuilder()
    result = builder.add_usd(open_stage(tmp_path / "turned.usda"), apply_up_axis_from_stage=True)
    np.testing.assert_allclose(builder.gravity, (0.0, -9.81, 0.0), rtol=1e-6)
    np.testing.assert_allclose(
        np.array(builder.body_q[result["path_body_map"]["/World/Magnet"]]),
        (0.0, 0.0, 0.08, 0.0, 0.0, 0.0, 1.0),
        atol=1e-7,
    )
