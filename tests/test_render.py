"""Pictures of stages: what stands where, which frame, from which camera."""

import numpy as np
import pytest
from pxr import Usd

from warpmag import cli
from warpmag.engine.render import render
from warpmag.errors import InputError
from warpmag.scenes_usd import authoring, balls_up

pytest.importorskip("matplotlib")
from matplotlib.image import imread


@pytest.fixture(scope="module")
def stage(tmp_path_factory):
    """One iron ball on the ground below a red magnet, which it jumps to, and a camera that looks at them."""
    path = tmp_path_factory.mktemp("render") / "scene.usda"
    balls_up.author(path, columns=1, rows=1, layers=1, height=0.045)
    opened = Usd.Stage.Open(str(path))
    opened.RemovePrim("/World/Camera")
    authoring.add_camera(opened, (0.0, -0.3, 0.03), (0.0, 0.0, 0.03))
    opened.GetRootLayer().Save()
    return path


def drawn(stage, path, device, **arguments):
    """Draw and return the pixels, shape [height, width, 3]."""
    render(stage, path, device=device, width=192, height=108, **arguments)
    return imread(path)[..., :3].astype(float)


def rows_of(pixels, is_there):
    """First and last row in which ``is_there`` holds, in parts of the height."""
    rows = np.flatnonzero(is_there(pixels).any(axis=1)) / len(pixels)
    return rows[0], rows[-1]


def red(pixels):
    return pixels[..., 0] > 2.0 * pixels[..., 2]


def test_bodies_stand_where_the_camera_sees_them(stage, device, tmp_path):
    """The magnet is 40 mm high, its middle 15 mm above that of the picture, which shows 0.3 m tan 17.5° · 9/8 m."""
    first, last = rows_of(drawn(stage, tmp_path / "one.png", device), red)
    half = 0.3 * np.tan(np.radians(17.5)) * 9.0 / 16.0
    front = 0.3 / (0.3 - 0.02)  # the magnet's face is nearer to the camera than its middle
    assert first == pytest.approx(0.5 - 0.5 * front * 0.035 / half, abs=0.02)
    assert last == pytest.approx(0.5 + 0.5 * front * 0.005 / half, abs=0.02)


def test_a_frame_of_a_run(stage, device, tmp_path):
    """The first frame is the scene; in the last, which is the default, the ball has left the ground."""
    out = tmp_path / "run" / "out.usda"
    assert cli.main(["run", str(stage), "-o", str(out), "--frames", "12", "--device", device]) == 0
    scene = drawn(stage, tmp_path / "scene.png", device)
    first, last = (drawn(out, tmp_path / f"{frame}.png", device, frame=frame) for frame in (0, 12))
    np.testing.assert_array_equal(first, scene)
    np.testing.assert_array_equal(drawn(out, tmp_path / "end.png", device), last)
    ground = slice(60, None)  # rows below the magnet: the ball, then its shadow alone
    assert np.abs(last - first)[ground].max() > 0.05
    with pytest.raises(InputError, match="has frames 0 to 12, got 13"):
        drawn(out, tmp_path / "no.png", device, frame=13)


def test_without_a_camera_all_bodies_are_in_the_picture(stage, device, tmp_path):
    opened = Usd.Stage.Open(str(stage))
    for path in ("/World/Camera", "/World/Ground"):
        opened.RemovePrim(path)
    opened.GetRootLayer().Export(str(tmp_path / "bare.usda"))
    opened.GetRootLayer().Reload(force=True)
    pixels = drawn(tmp_path / "bare.usda", tmp_path / "bare.png", device)
    there = np.abs(pixels - pixels[0, 0]).max(axis=2) > 0.02
    first, last = rows_of(pixels, lambda _: there)
    assert 0.0 < first and last < 0.99 and last - first > 0.5
    assert not there[:, 0].any() and not there[:, -1].any()


def test_bad_input_is_one_line(stage, tmp_path, capsys):
    (tmp_path / "file").touch()
    for arguments, text in (
        (["-o", str(tmp_path / "file" / "a.png")], "a.png: cannot be written ("),
        (["-o", "picture.jpg"], "picture.jpg: a picture is written as .png"),
        (["-o", str(tmp_path / "a.png"), "--frame", "-1"], "has frames 0 to"),
    ):
        assert cli.main(["render", str(stage), *arguments]) == cli.BAD_INPUT
        (line,) = capsys.readouterr().err.strip().splitlines()
        assert line.startswith("warpmag: ") and text in line
    with pytest.raises(InputError, match="size: must be positive, got 0 x 540"):
        render(stage, tmp_path / "a.png", width=0)
