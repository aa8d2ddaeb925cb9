"""Pictures of stages: what stands where, which frame, from which camera."""

import numpy as np
import pytest
from PIL import Image
from pxr import Usd

from warpmag import cli
from warpmag.errors import InputError
from warpmag.scenes_usd import authoring, balls_up
from warpmag.show.ray_tracing import render

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
    render(stage, path, device=device, size=(192, 108), **arguments)
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


@pytest.fixture(scope="module")
def run(stage, device, tmp_path_factory):
    """A run of twelve frames; the ball has left the ground after two."""
    out = tmp_path_factory.mktemp("run") / "out.usda"
    assert cli.main(["run", str(stage), "-o", str(out), "--frames", "12", "--device", device]) == 0
    return out


def test_a_frame_of_a_run(stage, run, device, tmp_path):
    """The first frame is the scene; in the last, which is the default, the ball has left the ground."""
    scene = drawn(stage, tmp_path / "scene.png", device)
    first, last = (drawn(run, tmp_path / f"{frame}.png", device, frame=frame) for frame in (0, 12))
    np.testing.assert_array_equal(first, scene)
    np.testing.assert_array_equal(drawn(run, tmp_path / "end.png", device), last)
    ground = slice(60, None)  # rows below the magnet: the ball, then its shadow alone
    assert np.abs(last - first)[ground].max() > 0.05
    with pytest.raises(InputError, match="has frames 0 to 12, got 13"):
        drawn(run, tmp_path / "no.png", device, frame=13)


def test_frames_of_several_pictures_are_those_of_single_ones(run, device, tmp_path):
    paths = render(run, tmp_path / "film.png", frames=(0, 2), size=(96, 54), device=device)
    assert [path.name for path in paths] == ["film.0000.png", "film.0001.png", "film.0002.png"]
    render(run, tmp_path / "one.png", frame=1, size=(96, 54), device=device)
    np.testing.assert_array_equal(imread(paths[1]), imread(tmp_path / "one.png"))
    assert (imread(paths[0]) != imread(paths[2])).any()


def duration(film, frame):
    """Duration of a frame [ms], which a WebP knows once the frame is loaded."""
    film.seek(frame)
    film.load()
    return film.info["duration"]


@pytest.mark.parametrize("suffix", [".gif", ".webp", ".mp4"])
def test_films_last_as_long_as_their_frames(run, device, tmp_path, suffix):
    ffmpeg = pytest.importorskip("imageio_ffmpeg") if suffix == ".mp4" else None
    film, size = tmp_path / f"film{suffix}", (64, 36)
    command = ["render", str(run), "-o", str(film), "--size", "64x36", "--device", device]
    assert cli.main(command) == 0
    if ffmpeg:
        frames, seconds = ffmpeg.count_frames_and_secs(str(film))
        assert frames == 13 and seconds == pytest.approx(13 / 60.0, abs=0.02)
    else:
        with Image.open(film) as opened:
            lasting = sum(duration(opened, frame) for frame in range(opened.n_frames))
            assert opened.size == size and lasting == 5 * 50  # frames 0, 3, ... 12 of 60 a second


def test_arrows_stand_on_magnets(run, device, tmp_path):
    """The cube's moment points up: the cone on top of it is above the row where the cube ends."""
    plain, shown = (drawn(run, tmp_path / f"{m}.png", device, arrows=m) for m in (False, True))
    (top, _), other = rows_of(plain, red), np.abs(shown - plain).max(axis=2) > 0.05
    assert other[: int(top * len(plain))].any()


def test_edges_of_bodies_are_between_what_is_beside_them(stage, device, tmp_path):
    """Colours are mixed as light: the magnet's upper edge is no darker than what is beside it."""
    pixels = drawn(stage, tmp_path / "edge.png", device)
    first, _ = rows_of(pixels, red)
    row, column = int(first * len(pixels)), pixels.shape[1] // 2
    above, edge, below = pixels[row - 2, column], pixels[row - 1 : row + 1, column], pixels[row + 2, column]
    assert (edge >= np.minimum(above, below) - 2.0 / 255.0).all()
    assert (edge <= np.maximum(above, below) + 2.0 / 255.0).all()


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


def test_a_camera_that_sees_no_body_is_replaced_unless_it_is_named(stage, device, tmp_path):
    """Inside the magnet, or turned away: all bodies are shown, and a line names the camera."""
    opened = Usd.Stage.Open(str(stage))
    opened.RemovePrim("/World/Camera")
    authoring.add_camera(opened, (0.0, 0.0, 0.045), (0.0, 0.01, 0.045))  # in the middle of the magnet
    Usd.Stage.GetRootLayer(opened).Export(str(tmp_path / "inside.usda"))
    opened.GetRootLayer().Reload(force=True)
    lines, pictures = [], {}
    for name in (None, "auto", "/World/Camera"):
        pictures[name] = drawn(
            tmp_path / "inside.usda", tmp_path / "one.png", device, camera=name, on_camera=lines.append
        )
    assert lines[0] == "all bodies, as the camera /World/Camera sees none or one from inside"
    assert lines[1:] == ["all bodies", "camera /World/Camera"]
    np.testing.assert_array_equal(pictures[None], pictures["auto"])
    assert red(pictures[None]).any() and not np.array_equal(pictures[None], pictures["/World/Camera"])
    drawn(stage, tmp_path / "one.png", device, on_camera=lines.append)
    assert lines[-1] == "camera /World/Camera"


def test_a_camera_that_usd_cannot_place(stage, tmp_path, capsys):
    """``check`` reads no cameras, and finds the stage sound."""
    opened = Usd.Stage.Open(str(stage))
    opened.GetPrimAtPath("/World/Camera").GetAttribute("xformOpOrder").Set(["elsewhere"])
    opened.Export(str(tmp_path / "scene.usda"))
    opened.Reload()
    assert cli.main(["render", str(tmp_path / "scene.usda"), "-o", str(tmp_path / "a.png")]) == cli.BAD_INPUT
    (line,) = capsys.readouterr().err.strip().splitlines()
    assert line.startswith("warpmag: /World/Camera: Newton cannot look from it (Invalid xform op")
    assert not (tmp_path / "a.png").exists()


def test_bad_input_is_one_line(stage, tmp_path, capsys):
    (tmp_path / "file").touch()
    for arguments, text in (
        (["-o", str(tmp_path / "file" / "a.png")], "a.png: cannot be written ("),
        (["-o", "picture.jpg"], "picture.jpg: a picture is written as .png, a film as .mp4, .webp or .gif"),
        (["-o", str(tmp_path / "a.png"), "--frame", "-1"], "has frames 0 to"),
        (
            ["-o", str(tmp_path / "a.png"), "--camera", "/World"],
            "no perspective camera of the stage; there are auto",
        ),
        (["-o", str(tmp_path / "a.png"), "--frames", "3:2"], "got 3 to 2"),
        (["-o", str(tmp_path / "a.png"), "--frames", "all"], "frames: must be two whole numbers such as 10:20"),
        (["-o", str(tmp_path / "a.png"), "--size", "1280"], "size: must be two whole numbers such as 10x20"),
    ):
        assert cli.main(["render", str(stage), *arguments]) == cli.BAD_INPUT
        (line,) = capsys.readouterr().err.strip().splitlines()
        assert line.startswith("warpmag: ") and text in line
    with pytest.raises(InputError, match="size: must be 1 to 16384, got 0 x 540"):
        render(stage, tmp_path / "a.png", size=(0, 540))
    with pytest.raises(InputError, match="holds no moments to show"):
        render(stage, tmp_path / "a.png", arrows=True)
    assert not list(tmp_path.glob("*.png"))
