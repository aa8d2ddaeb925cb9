"""What a viewer is shown of a run; Newton's own need a window or a browser, so one that takes notes stands in."""

import newton
import numpy as np
import pytest
from pxr import Usd

from warpmag import cli
from warpmag.scenes_usd import balls_up


class Notes:
    """A viewer that is closed after ``open_for`` frames."""

    open_for = 100

    def __init__(self):
        Notes.last = self
        self.times, self.heights, self.shown = [], [], 0

    def set_model(self, model):
        self.moving = int(np.argmin(model.body_mass.numpy()))

    def begin_frame(self, time):
        self.times.append(time)

    def log_state(self, state):
        self.heights.append(state.body_q.numpy()[self.moving, 2])

    def end_frame(self):
        self.shown += 1

    def is_running(self):
        return self.shown < self.open_for


@pytest.fixture(scope="module")
def scene(tmp_path_factory):
    path = tmp_path_factory.mktemp("viewers") / "small.usda"
    balls_up.author(path, columns=1, rows=1, layers=1, height=0.05)
    return path


def watch(scene, out, device, monkeypatch, viewer):
    monkeypatch.setattr(newton.viewer, "ViewerGL", viewer, raising=False)
    return cli.main(["run", str(scene), "-o", str(out), "--frames", "3", "--device", device, "--viewer", "gl"])


def test_a_viewer_sees_every_frame(scene, device, monkeypatch, tmp_path):
    assert watch(scene, tmp_path / "out.usda", device, monkeypatch, Notes) == 0
    assert Notes.last.times == pytest.approx([0.0, 0.017, 0.033, 0.05], abs=1e-9)  # at steps of 1 ms
    assert Notes.last.shown == 4
    # from the ground to the magnet, whose face is 30 mm above it; contacts give way by parts of a radius of 5 mm
    assert Notes.last.heights == pytest.approx([0.005, 0.025, 0.025, 0.025], abs=1e-4)


def test_a_closed_window_ends_the_run(scene, device, monkeypatch, tmp_path):
    monkeypatch.setattr(Notes, "open_for", 2)
    assert watch(scene, tmp_path / "out.usda", device, monkeypatch, Notes) == 0
    assert Notes.last.shown == 2
    stage = Usd.Stage.Open(str(tmp_path / "out.usda"))
    assert stage.GetPrimAtPath("/World/Balls/Ball_0000").GetAttribute("warpmag:moment").GetNumTimeSamples() == 2


@pytest.mark.parametrize(
    ("error", "reason"), [(ImportError("no pyglet\nhere"), "(no pyglet)"), (RuntimeError(), "(RuntimeError)")]
)
def test_a_viewer_that_cannot_open_is_one_line(scene, device, monkeypatch, tmp_path, capsys, error, reason):
    def fail():
        raise error

    assert watch(scene, tmp_path / "out.usda", device, monkeypatch, fail) == cli.BAD_INPUT
    (line,) = capsys.readouterr().err.strip().splitlines()
    assert line == f"warpmag: viewer: gl cannot open, it needs the extra 'viewers' {reason}"
    assert not (tmp_path / "out.usda").exists()
