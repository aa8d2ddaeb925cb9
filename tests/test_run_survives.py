"""A run survives its end: whatever ends it, the stage has its frames, and it can be resumed to the same bits.

Runs are children that are really killed. What they leave is compared, bit by bit, with a run that nobody disturbed.
"""

import contextlib
import copy
import errno
import json
import math
import os
import random
import shutil
import signal
import subprocess
import sys
import time

import numpy as np
import pytest
from pxr import Sdf, Usd, UsdPhysics, UsdUtils
from run_server import RunServer

from warpmag import InputError, Simulation, cli
from warpmag.engine.stepping import recording
from warpmag.scenes_usd import balls_up
from warpmag.usd.read.trial_read import trial_read

FRAMES = 60
BALLS = 18


@pytest.fixture(scope="module")
def scene(tmp_path_factory):
    path = tmp_path_factory.mktemp("survives") / "small.usda"
    balls_up.author(path, columns=3, rows=3, layers=2, height=0.05)
    return path


def samples(output):
    """All time samples and defaults of a run's cache, the values as bytes."""
    layer = Sdf.Layer.OpenAsAnonymous(str(output.with_name(f"{output.stem}.cache.usdc")))
    results = {}

    def visit(path):
        if path.IsPropertyPath():
            times = layer.ListTimeSamplesForPath(path)
            values = [layer.QueryTimeSample(path, time) for time in times]
            results[path] = layer.GetAttributeAtPath(path).default, dict(zip(times, values, strict=True))

    layer.Traverse("/", visit)
    return results


def frames_of(output):
    """Numbers of the frames that stand on the stage of a run, which must open and be whole."""
    stage = Usd.Stage.Open(str(output))
    assert not stage.GetCompositionErrors()
    times = stage.GetAttributeAtPath("/World/Balls/Ball_0000.warpmag:moment").GetTimeSamples()
    last = times[-1] if times else 0.0
    assert stage.GetEndTimeCode() <= max(last, round(last))  # the frame of the last step, at which players stop
    return times


def rub(layer, friction):
    """Give all materials of a scene a coefficient of friction."""
    stage = Usd.Stage.Open(layer)
    for prim in stage.Traverse():
        if prim.HasAPI(UsdPhysics.MaterialAPI):
            UsdPhysics.MaterialAPI(prim).GetDynamicFrictionAttr().Set(friction)


def first_difference(run, expected):
    """Where two runs, evaluations, substeps and samples, differ first: a step or the samples of the earliest time."""
    steps = [step for step, pair in enumerate(zip(run[0], expected[0], strict=False)) if pair[0] != pair[1]]
    lines = [f"step {step}: {run[0][step]} evaluations, not {expected[0][step]}" for step in steps[:1]]
    (of_run, of_expected), missing = (run[2], expected[2]), (None, {})
    paths = sorted(of_run.keys() | of_expected.keys())
    both = [(path, of_run.get(path, missing), of_expected.get(path, missing)) for path in paths]
    lines += [f"{path}: {mine[0]}, not {its[0]}" for path, mine, its in both if mine[0] != its[0]][:1]
    apart = [
        (time, path, mine[1].get(time), its[1].get(time))
        for path, mine, its in both
        for time in mine[1].keys() | its[1].keys()
        if mine[1].get(time) != its[1].get(time)
    ]
    lines += [f"{path} at {time}: {a}, not {b}" for time, path, a, b in sorted(apart, key=lambda row: row[:2])[:1]]
    return "; ".join([*lines, f"{run[1]} substeps and {expected[1]}"])


def assert_begins_like(output, reference):
    """Every sample on the stage is one of the undisturbed run, and none of those up to the last is missing."""
    actual = samples(output)
    assert actual.keys() == reference.keys()
    last = max((max(times) for _, times in actual.values() if times), default=0.0)
    for path, (default, times) in actual.items():
        before, expected = reference[path]
        assert default == before
        until = {time: value for time, value in expected.items() if time <= last}
        # an attribute gets samples once it changes
        assert times == until or (not times and all(value == default for value in until.values())), path


def alive(process):
    try:
        os.kill(process, 0)
    except ProcessLookupError:
        return False
    return True


class Survival:
    """Ends runs at random moments and looks at what is left."""

    def __init__(self, scene, folder, seed):
        self.server, self.random = RunServer(), random.Random(seed)
        self.folder, self.command = folder, ["run", scene, "--frames", FRAMES, "--device", "cpu"]
        self.output, self.messages, self.log = folder / "out.usda", folder / "messages", folder / "frames"
        assert self.run(folder / "reference" / "out.usda") == 0
        times = self.frames().values()
        self.seconds = max(times) - min(times)
        self.reference = samples(folder / "reference" / "out.usda")

    def start(self, output):
        return self.server.start([*self.command, "-o", output, "--resume"], self.messages, self.log)

    def run(self, output):
        self.start(output)
        return self.server.wait()

    def frames(self):
        """Time of each frame that the run says it has done."""
        lines = self.log.read_text().splitlines() if self.log.exists() else []
        return {int(frame): float(when) for when, frame in (line.split() for line in lines)}

    def end(self, number):
        """Start or resume the run and end it at a random moment; return whether it had ended by itself."""
        self.log.unlink(missing_ok=True)
        process = self.start(self.output)
        if self.random.random() < 0.8:  # in the run proper, not while it is loaded
            while not self.frames() and alive(process):
                time.sleep(0.01)
        time.sleep(self.random.uniform(0.0, 0.6 * self.seconds))
        killed = time.monotonic()
        with contextlib.suppress(ProcessLookupError):
            os.kill(process, number)
        code = self.server.wait()
        assert code in (0, -number if number == signal.SIGKILL else 128 + number), code
        done = [frame for frame, when in self.frames().items() if when < killed - 1.0]
        if done:  # a first frame alone makes no samples
            assert len(frames_of(self.output)) > max(done) or max(done) == 0
        if self.output.exists():
            assert_begins_like(self.output, self.reference)
        if code and number != signal.SIGKILL:
            (line,) = self.messages.read_text().splitlines()
            assert line.startswith("warpmag: interrupted" if number == signal.SIGINT else "warpmag: ended by SIG")
            if self.frames():  # the end may come between a frame and what the run says of it
                last = max(self.frames())
                ends = [f", {self.output} has the frames up to {frame}" for frame in (last, last + 1)]
                ends += ["ended by SIGHUP", "ended by SIGTERM", "interrupted"] if last == FRAMES else []  # a whole run
                assert line.endswith(tuple(ends))
        return code == 0

    def finish(self):
        """Resume the run to its end and compare it."""
        assert self.run(self.output) == 0
        assert samples(self.output) == self.reference
        assert sorted(os.listdir(self.output.parent)) == ["out.cache.usdc", "out.usda"]


def checkpoint_each_frame(patch):
    """Write a checkpoint after every frame."""
    patch.setattr("warpmag.usd.write.writer._CHECKPOINT_SECONDS", 0.0)
    patch.setattr("warpmag.usd.write.writer._CHECKPOINT_SHARE", math.inf)


@pytest.fixture
def always(monkeypatch):
    """A checkpoint after every frame."""
    checkpoint_each_frame(monkeypatch)


@pytest.mark.parametrize(
    "options",
    [{}, {"contact_model": "multipole", "friction": 0.5}, {"dynamics": "theta-euler"}],
    ids=str,
)
def test_a_resumed_run_ends_with_the_same_bits(scene, tmp_path, device, always, options):
    """Also where it is interrupted again and again: every part of the state is in the checkpoint."""

    options, friction = dict(options), options.get("friction")
    if friction:  # contacts then remember how far they slipped
        del options["friction"]
        # not the layer of the file, which the process shares as long as anything holds it: other tests would read this
        layer, scene = Sdf.Layer.OpenAsAnonymous(str(scene)), tmp_path / "rubs.usda"
        rub(layer, friction)
        layer.Export(str(scene))

    def run(name, last, resume):
        simulation = Simulation(scene, device=device, **options)
        output = tmp_path / name / "out.usda"
        figures = simulation.run(9, output=output, resume=resume, on_frame=lambda frame: frame < last)
        return figures.evaluations, figures.substeps, samples(output)

    expected = run("whole", 9, False)
    for last in (2, 5, 9):
        actual = run("parts", last, True)
    same = actual == expected
    assert same, first_difference(actual, expected)
    assert sorted(os.listdir(tmp_path / "parts")) == ["out.cache.usdc", "out.usda"]


def test_a_resumed_run_keeps_what_was_set(scene, tmp_path, device, always):
    """Fields, magnetizations and materials that a program set before the checkpoint."""

    def run(name, last, resume):
        simulation = Simulation(scene, device=device)
        magnetics, output = simulation.magnetics, tmp_path / name / "out.usda"

        def on_frame(frame):
            if frame == 1:
                magnetics.set_external_field((0.0, 2e4, 0.0))
                magnet = next(entry for entry in magnetics.magnets if entry.magnet.kind == "permanent")
                magnetics.set_magnetization((0.0, 0.0, 7e5), body=magnet.body, shape=int(magnet.shapes[0]))
                simulation.model.warpmag.saturation.fill_(5e5)
                magnetics.notify_model_changed()
            return frame < last

        figures = simulation.run(5, output=output, resume=resume, on_frame=on_frame)
        return figures.evaluations, figures.substeps, samples(output)

    expected = run("whole", 5, False)
    run("parts", 3, False)
    actual = run("parts", 5, True)
    same = actual == expected
    assert same, first_difference(actual, expected)


def test_a_scene_edited_in_memory_is_another_scene(scene, tmp_path, device, always):
    """A process reads its own edits where it has not saved them, and who resumes without them has another scene."""
    own, output = tmp_path / "own.usda", tmp_path / "out.usda"
    own.write_bytes(scene.read_bytes())
    layer = Sdf.Layer.FindOrOpen(str(own))

    def run(last):
        Simulation(own, device=device).run(4, output=output, resume=True, on_frame=lambda frame: frame < last)

    rub(layer, 0.5)
    run(1)
    run(2)
    layer.Reload(force=True)
    with pytest.raises(InputError, match="out.usda: cannot resume, it was run with another scene"):
        run(4)
    rub(layer, 0.5)
    run(4)
    assert layer.dirty


@pytest.mark.parametrize("kind", ["below", "package"])
def test_what_is_written_of_a_scene_edited_in_memory_has_the_edits(kind, scene, tmp_path, device):
    """The file has not, and what is read of the result elsewhere would be a motion of other things."""
    edited, output = tmp_path / "scene" / "edited.usda", tmp_path / "out" / "out.usda"
    edited.parent.mkdir()
    edited.write_bytes(scene.read_bytes())
    path = edited
    if kind == "below":
        path = edited.with_name("root.usda")
        layer = Sdf.Layer.CreateNew(str(path))
        layer.pseudoRoot.SetInfo("metersPerUnit", 1.0)
        layer.subLayerPaths.append(str(edited))
        layer.Save()
    if kind == "package":
        path = edited.with_suffix(".usdz")
        assert UsdUtils.CreateNewUsdzPackage(str(edited), str(path))
    layer = Sdf.Layer.FindOrOpen(str(path if kind == "package" else edited))
    rub(layer, 0.25)
    simulation = Simulation(path, device=device)
    (warning,) = [line for line in simulation.warnings() if "unsaved" in line]
    assert warning.startswith(f"{layer.realPath}: has unsaved edits in this process")
    if kind == "package":
        with pytest.raises(InputError, match=r"edited.usdz: has unsaved edits and is in a package"):
            simulation.run(1, output=output)
        return
    simulation.run(1, output=output)
    program = (
        f"from pxr import Usd, UsdPhysics\nstage = Usd.Stage.Open({str(output)!r})\n"
        "frictions = [UsdPhysics.MaterialAPI(prim).GetDynamicFrictionAttr().Get() for prim in stage.Traverse()]\n"
        "print({friction for friction in frictions if friction is not None})"
    )
    done = subprocess.run([sys.executable, "-c", program], capture_output=True, text=True, check=True)
    assert done.stdout == "{0.25}\n"
    layer.Reload(force=True)


def test_an_invalid_resume_prints_one_line(scene, tmp_path, device, always, capsys):
    output = tmp_path / "out.usda"
    Simulation(scene, device=device).run(6, output=output, on_frame=lambda frame: frame < 3)
    other = tmp_path / "other.usda"
    balls_up.author(other, columns=3, rows=3, layers=1, height=0.05)
    command = ["run", "-o", str(output), "--device", device, "--resume"]
    for arguments, message in [
        ([str(scene), "--frames", "6", "--force", "zeeman"], "cannot resume, it was run with another force: kelvin"),
        ([str(scene), "--frames", "6", "--rtol", "1e-4"], "another rtol: 0.001"),
        ([str(other), "--frames", "6"], "cannot resume, it was run with another scene"),
        ([str(scene), "--frames", "2"], "already has 0.05 s, more than 2 frames"),
    ]:
        assert cli.main([*command, *arguments]) == 2
        printed = capsys.readouterr()
        (line,) = printed.err.splitlines()
        assert line.startswith("warpmag: ") and "out.usda" in line and message in line and not printed.out
    checkpoint = tmp_path / "out.resume.npz"
    content = checkpoint.read_bytes()
    with np.load(checkpoint) as saved:
        arrays = dict(saved)
    noted = json.loads(str(arrays.pop("about")))
    for name, message in [
        ("buffers", "its checkpoint has no 'buffers'"),
        ("stat.steps", "its checkpoint has no 'steps'"),
        ("state.0", "checkpoint: state.0 does not fit this run"),
    ]:
        left = {key: array for key, array in arrays.items() if key != f"state/{name}"}
        np.savez(checkpoint, about=np.array(json.dumps({**noted, "names": sorted(left)})), **left)
        assert cli.main([*command, str(scene), "--frames", "6"]) == 2
        assert capsys.readouterr().err == f"warpmag: {output}: cannot resume, {message}\n"
    checkpoint.write_bytes(content)
    assert cli.main([*command, str(scene), "--frames", "6"]) == 0
    assert "written" in capsys.readouterr().out
    assert cli.main([*command, str(scene), "--frames", "6"]) == 0
    assert "already has all 6 frames" in capsys.readouterr().out
    assert cli.main([*command, str(scene), "--frames", "7"]) == 2
    assert "cannot be extended" in capsys.readouterr().err


class Late(recording.Recorder):
    """Writes a frame before the next one is taken, as on a GPU, on a CPU, too."""

    def add_frame(self, time, state):
        self.write()
        with pytest.MonkeyPatch.context() as patch:
            patch.setattr(self, "write", lambda: None)
            super().add_frame(time, state)
        self._pending = copy.deepcopy(self._pending)  # a checkpoint of a CPU is valid until the next step only


@pytest.mark.parametrize("recorder", [recording.Recorder, Late])
def test_a_full_disk_ends_a_run_in_one_line(scene, tmp_path, device, always, monkeypatch, capsys, recorder):
    """And where there is room again, it goes on."""
    monkeypatch.setattr(recording, "Recorder", recorder)
    command = ["run", str(scene), "--frames", "9", "--device", device, "--resume", "-o"]
    assert cli.main([*command, str(tmp_path / "whole" / "out.usda")]) == 0
    output, write, room = tmp_path / "parts" / "out.usda", os.pwrite, 28000

    def limited(file, data, place):
        nonlocal room
        room -= len(data)
        if room < 0:
            raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))
        return write(file, data, place)

    monkeypatch.setattr(os, "pwrite", limited)
    capsys.readouterr()
    assert cli.main([*command, str(output)]) == 2
    line = capsys.readouterr().err.splitlines()[-1]
    last = len(frames_of(output)) - 1
    assert 0 < last < 9
    reason = "cannot be written (No space left on device)"
    assert line == f"warpmag: {tmp_path}/parts/out.cache.usdc: {reason}, {output} has the frames up to {last}"
    monkeypatch.setattr(os, "pwrite", write)
    assert cli.main([*command, str(output)]) == 0
    assert samples(output) == samples(tmp_path / "whole" / "out.usda")


def test_a_last_frame_that_cannot_be_written_can_be_resumed(scene, tmp_path, device, always, monkeypatch):
    """On a GPU it is written when all steps are done, and the run is not complete without it."""

    def full(*frame):
        raise InputError("no room")

    monkeypatch.setattr(recording, "Recorder", Late)
    output = tmp_path / "out.usda"
    with pytest.MonkeyPatch.context() as patch, pytest.raises(InputError, match="no room"):
        Simulation(scene, device=device).run(
            1, output=output, on_frame=lambda k: k < 1 or patch.setattr(recording.CacheWriter, "add_frame", full)
        )
    assert (tmp_path / "out.resume.npz").exists()
    Simulation(scene, device=device).run(1, output=output, resume=True)
    assert len(frames_of(output)) == 2
    assert sorted(os.listdir(tmp_path)) == ["out.cache.usdc", "out.usda"]


def test_nobody_reads_what_a_run_prints(scene, tmp_path):
    """The run goes on to its end, for its frames are what it is for."""
    output = tmp_path / "out.usda"
    command = [sys.executable, "-m", "warpmag.cli", "run", str(scene), "-o", str(output), "--frames", "5"]
    with subprocess.Popen([*command, "--device", "cpu"], stdout=subprocess.PIPE, stderr=subprocess.PIPE) as process:
        process.stdout.close()
        process.stderr.close()
    assert process.returncode == 128 + signal.SIGPIPE
    assert len(frames_of(output)) == 6
    assert sorted(os.listdir(tmp_path)) == ["out.cache.usdc", "out.usda"]


def test_ended_in_each_way(scene, tmp_path):
    survival = Survival(scene, tmp_path, seed=1)
    survival.output = tmp_path / "run" / "out.usda"
    for way in (signal.SIGKILL, signal.SIGTERM, signal.SIGHUP, signal.SIGINT):
        if survival.end(way):
            break
    survival.finish()
    survival.server.close()


@pytest.mark.long
@pytest.mark.parametrize("way", ["SIGKILL", "SIGTERM", "SIGHUP", "SIGINT"])
def test_fifty_random_moments(scene, tmp_path, way):
    survival = Survival(scene, tmp_path, seed=way)
    survival.output = tmp_path / "run" / "out.usda"
    for moment in range(50):
        if survival.end(getattr(signal, way)) or moment % 5 == 4:
            survival.finish()
            for left in survival.output.parent.iterdir():
                left.unlink()
    survival.server.close()


@pytest.fixture(scope="module")
def ended_runs(scene, device, tmp_path_factory):
    """Two runs that ended early, with a checkpoint."""
    folder = tmp_path_factory.mktemp("ended")
    with pytest.MonkeyPatch.context() as patch:
        checkpoint_each_frame(patch)
        for name, frames, last in (("out", 4, 2), ("other", 40, 3)):
            Simulation(scene, device=device).run(
                frames, output=folder / name / "out.usda", on_frame=lambda frame, last=last: frame < last
            )
    return folder


@pytest.fixture
def ended(ended_runs, tmp_path):
    """The output of a copy of the first run, beside a copy of the other one; the scene is as far away."""
    shutil.copytree(ended_runs, tmp_path, dirs_exist_ok=True)
    return tmp_path / "out" / "out.usda"


@pytest.mark.parametrize("place", [0.02, 0.3, 0.6, 0.9, 0.97])
def test_a_damaged_cache_is_refused_or_readable(place, scene, ended, device, always, capsys):
    """Zeros in the cache: USD opens the result of a resumed run, or the run is refused in one line."""
    output, cache = ended, ended.with_name("out.cache.usdc")
    content = bytearray(cache.read_bytes())
    begin = int(place * len(content))
    content[begin : begin + 512] = bytes(len(content[begin : begin + 512]))
    cache.write_bytes(content)
    code = cli.main(["run", str(scene), "--frames", "4", "-o", str(output), "--device", device, "--resume"])
    if code:
        assert code == 2
        (line,) = capsys.readouterr().err.splitlines()
        assert line.startswith("warpmag: ") and "resume" in line
    else:
        assert len(frames_of(output)) == 5
        assert not trial_read(cache)


FOREIGN = {
    "of another length": lambda saved, other: other,
    "of no numbers": lambda saved, other: saved | {"file/times": np.array("x")},
    "of other places": lambda saved, other: saved | {"file/heads": saved["file/heads"] + 8},
    "of fewer values": lambda saved, other: saved | {"file/types": saved["file/types"][:1]},
    "of other statistics": lambda saved, other: saved | {"state/stat.error": np.zeros(0)},
    "of another time": lambda saved, other: saved | {"state/steps": np.array(5)},
    "of endless buffers": lambda saved, other: saved | {"state/buffers": 0 * saved["state/buffers"] + 2**60},
}


@pytest.mark.parametrize("kind", FOREIGN)
def test_a_foreign_checkpoint_is_refused_and_nothing_written(kind, scene, ended, tmp_path, device, always, capsys):
    saved, other = (dict(np.load(tmp_path / name / "out.resume.npz")) for name in ("out", "other"))
    np.savez(tmp_path / "out" / "out.resume.npz", **FOREIGN[kind](saved, other))
    output, cache = ended, ended.with_name("out.cache.usdc").read_bytes()
    assert cli.main(["run", str(scene), "--frames", "4", "-o", str(output), "--device", device, "--resume"]) == 2
    (line,) = capsys.readouterr().err.splitlines()
    assert line.startswith("warpmag: ") and "resume" in line
    assert (tmp_path / "out" / "out.cache.usdc").read_bytes() == cache
    assert len(frames_of(output)) == 3


def test_damaged_references_are_repaired_and_values_recognized(scene, ended, device, always, capsys):
    """The places of a frame's values are known without the file; the values themselves have a checksum."""
    output, cache = ended, ended.with_name("out.cache.usdc")
    places = dict(np.load(ended.with_name("out.resume.npz")))
    content = cache.read_bytes()
    row, value = int(places["file/times"]) + 8 * (1 + int(places["file/capacity"])) + 16, int(places["file/starts"][0])

    def resume(place):
        cache.write_bytes(content[:place] + b"\xff" * 4 + content[place + 4 :])
        return cli.main(["run", str(scene), "--frames", "4", "-o", str(output), "--device", device, "--resume"])

    assert resume(value) == 2
    assert "cannot be resumed, it has changed" in capsys.readouterr().err
    assert resume(row) == 0
    assert len(samples(output)) and len(frames_of(output)) == 5
