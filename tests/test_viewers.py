"""What a viewer is shown of a run; Newton's own need a window or a browser, so one that takes notes stands in."""

import newton
import numpy as np
import pytest
import warp as wp
from pxr import Usd
from small_builders import add_ball, new_builder

import warpmag
from warpmag import cli
from warpmag.errors import extra
from warpmag.scenes_usd import balls_up


class Notes:
    """A viewer that is closed after ``open_for`` frames."""

    open_for = 100

    def __init__(self):
        Notes.last = self
        self.times, self.heights, self.shown = [], [], 0
        self.camera, self.arrows, self.paused, self.closed = None, [], set(), False

    def set_reset_callback(self, callback):
        self.reset = callback

    def set_model(self, model):
        self.moving = int(np.argmin(model.body_mass.numpy()))

    def set_camera(self, position, pitch, yaw):
        self.camera = np.array(position), pitch, yaw

    def log_arrows(self, name, starts, ends, colors, width):
        self.arrows.append([entry.numpy() for entry in (starts, ends, colors)])

    def should_step(self):
        return self.shown not in self.paused

    def close(self):
        self.closed = True

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


def watch(scene, out, device, monkeypatch, viewer, name="gl"):
    monkeypatch.setattr(newton.viewer, {"gl": "ViewerGL", "viser": "ViewerViser"}[name], viewer, raising=False)
    return cli.main(["run", str(scene), "-o", str(out), "--frames", "3", "--device", device, "--viewer", name])


def test_a_viewer_sees_every_frame(scene, device, monkeypatch, tmp_path):
    assert watch(scene, tmp_path / "out.usda", device, monkeypatch, Notes) == 0
    assert Notes.last.times == pytest.approx([0.0, 0.017, 0.033, 0.05], abs=1e-9)  # at steps of 1 ms
    assert Notes.last.shown == 4
    # from the ground to the magnet, whose face is 30 mm above it; contacts give way by parts of a radius of 5 mm
    assert Notes.last.heights == pytest.approx([0.005, 0.025, 0.025, 0.025], abs=1e-4)


@wp.kernel(enable_backward=False)
def press(force: float, body: int, body_f: wp.array[wp.spatial_vector]):
    body_f[body] = body_f[body] + wp.spatial_vector(wp.vec3(0.0, 0.0, -force), wp.vec3(0.0))


class Dragging(Notes):
    """A viewer whose mouse presses the ball down."""

    def apply_forces(self, state):
        wp.launch(press, dim=1, inputs=[10.0, self.moving, state.body_f], device=state.body_f.device)


def test_the_mouse_drags_bodies(scene, device, monkeypatch, tmp_path):
    """10 N down keep the ball on the ground, which else jumps to the magnet within a frame; here in a graph."""
    assert watch(scene, tmp_path / "out.usda", device, monkeypatch, Dragging) == 0
    assert Notes.last.heights == pytest.approx([0.005] * 4, abs=2e-4)


def test_a_display_hands_on_the_viewer_s_forces(device):
    builder = new_builder()
    add_ball(builder, (0.0, 0.0, 0.1))
    model = builder.finalize(device=device)
    magnetics, state = warpmag.Magnetics(model), model.state()
    for viewer, force in ((Dragging(), -10.0), (Notes(), 0.0)):  # some of Newton's viewers pick nothing
        state.clear_forces()
        warpmag.Display(viewer, model, magnetics).apply_forces(state)
        assert state.body_f.numpy()[0, 2] == force
    with pytest.raises(warpmag.InputError, match="state: must be a newton.State"):
        warpmag.Display(Notes(), model, magnetics).apply_forces(None)


def test_a_viewer_sees_magnetizations_and_all_of_the_scene(scene, device, monkeypatch, tmp_path):
    """A ball of 5 mm radius below a cube of 40 mm that hangs 50 mm high; both are magnetized along z."""
    watch(scene, tmp_path / "out.usda", device, monkeypatch, Notes)
    starts, ends, colors = Notes.last.arrows[-1]
    along = ends - starts
    assert (along[:, 2] > 0.0).all() and (np.abs(along[:, :2]) < 1e-2 * along[:, 2:]).all()
    ball = int(np.argmin(along[:, 2]))
    np.testing.assert_allclose(0.5 * (starts + ends)[ball], (0.0, 0.0, Notes.last.heights[-1]), atol=1e-6)
    assert along[ball, 2] > 0.01  # longer than the ball, which would hide it
    assert colors[ball].tolist() != colors[1 - ball].tolist()
    position, pitch, yaw = Notes.last.camera
    turn, tip = np.radians((yaw, pitch))
    front = np.array((np.cos(turn) * np.cos(tip), np.sin(turn) * np.cos(tip), np.sin(tip)))
    for point in ((0.0, 0.0, 0.0), *(0.02 * np.array(corner) + (0, 0, 0.05) for corner in np.ndindex(2, 2, 2))):
        sight = np.array(point) - position
        angle = np.degrees(np.arccos(sight @ front / np.linalg.norm(sight)))
        assert angle < 22.5  # half of the viewers' field of view
    assert np.linalg.norm(position) < 0.4


def test_a_paused_viewer_shows_the_same_frame(scene, device, monkeypatch, tmp_path):
    def viewer():
        notes = Notes()
        notes.paused = {2, 3}
        return notes

    assert watch(scene, tmp_path / "out.usda", device, monkeypatch, viewer) == 0
    assert Notes.last.times == pytest.approx([0.0, 0.017, 0.017, 0.017, 0.033, 0.05], abs=1e-9)


def test_a_viewer_in_a_browser_stays_until_one_leaves(scene, device, monkeypatch, tmp_path, capsys):
    asked = iter([True] * 12)

    class Browser(Notes):
        def is_running(self):
            return next(asked, False)

    assert watch(scene, tmp_path / "out.usda", device, monkeypatch, Browser, "viser") == 0
    assert Notes.last.closed and next(asked, None) is None
    assert "warpmag: the viser viewer shows the last frame until Ctrl-C" in capsys.readouterr().err


def test_a_restart_begins_anew(scene, device, monkeypatch, tmp_path, capsys):
    """Pressed after the second frame, and again while the browser keeps the last one."""

    class Browser(Notes):
        def end_frame(self):
            super().end_frame()
            if self.shown == 2:
                self.reset()

        def should_step(self):
            asked.append(self.shown)
            if asked.count(6) == 2 and self.shown == 6:
                self.reset()
            return True

        def is_running(self):
            return self.shown < 10

    asked = []
    assert watch(scene, tmp_path / "out.usda", device, monkeypatch, Browser, "viser") == 0
    frames = [0.0, 0.017, 0.033, 0.05]
    assert Notes.last.times == pytest.approx([*frames[:2], *frames, *frames], abs=1e-9)
    assert capsys.readouterr().out.count("written") == 2  # of the two runs that came to their end
    stage = Usd.Stage.Open(str(tmp_path / "out.usda"))
    assert stage.GetPrimAtPath("/World/Balls/Ball_0000").GetAttribute("warpmag:moment").GetNumTimeSamples() == 4


def test_a_closed_window_ends_the_run(scene, device, monkeypatch, tmp_path):
    monkeypatch.setattr(Notes, "open_for", 2)
    assert watch(scene, tmp_path / "out.usda", device, monkeypatch, Notes) == 0
    assert Notes.last.shown == 2
    stage = Usd.Stage.Open(str(tmp_path / "out.usda"))
    assert stage.GetPrimAtPath("/World/Balls/Ball_0000").GetAttribute("warpmag:moment").GetNumTimeSamples() == 2


@pytest.mark.parametrize(
    ("error", "text"),
    [
        (ModuleNotFoundError("no pyglet\nhere"), f"needs {extra('viewers')}: no pyglet"),
        (RuntimeError(), "cannot open, it needs a display; viser and rerun need none: RuntimeError"),
    ],
)
def test_a_viewer_that_cannot_open_is_one_line(scene, device, monkeypatch, tmp_path, capsys, error, text):
    def fail():
        raise error

    assert watch(scene, tmp_path / "out.usda", device, monkeypatch, fail) == cli.BAD_INPUT
    (line,) = capsys.readouterr().err.strip().splitlines()
    assert line == f"warpmag: viewer: gl {text}"
    assert not (tmp_path / "out.usda").exists()
