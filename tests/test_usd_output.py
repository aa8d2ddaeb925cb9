"""The files of a run at every moment: frames, ends of any kind, checkpoints, and the memory of the writer."""

import contextlib
import errno
import json
import os
import random
import subprocess
import sys

import numpy as np
import pytest
from pxr import Gf, Sdf

from tests.recorded_balls import NAMES, PATHS, add, assert_has, make_frames, open_scene, read
from warpmag.errors import InputError
from warpmag.usd import CacheWriter
from warpmag.usd.write.output import Output


@pytest.fixture
def stage(tmp_path):
    return open_scene(tmp_path)


def test_every_frame_is_there_as_soon_as_it_is_added(tmp_path, stage):
    output, frames = tmp_path / "run.usda", make_frames(7)
    with CacheWriter(stage, output, PATHS, PATHS, frames=7) as writer:
        for k in range(7):
            add(writer, frames, [k])
            assert_has(output, frames, k + 1)
            cache = Sdf.Layer.OpenAsAnonymous(str(tmp_path / "run.cache.usdc"))
            assert cache.endTimeCode == k
    assert Sdf.Layer.OpenAsAnonymous(str(output)).endTimeCode == 6.0


@pytest.mark.parametrize("planned", [None, 3, 200, 1300])
def test_samples_are_those_that_usd_itself_would_write(tmp_path, stage, planned):
    """However many frames were planned; 1,300 need more than one page of references in a row."""
    output, count = tmp_path / "run.usda", 1300 if planned == 1300 else 200
    frames = make_frames(count)
    frames[1][:150, 1] = 0.0  # starts to move late
    with CacheWriter(stage, output, PATHS, PATHS, frames=planned) as writer:
        add(writer, frames, range(count))
    reference = Sdf.Layer.CreateAnonymous(".usdc")
    for index, path in enumerate(PATHS):
        for name, kind, values in ((NAMES[0], Gf.Vec3d, frames[0]), ("warpmag:moment", Gf.Vec3f, frames[2])):
            at = Sdf.Path(f"{path}.{name}")
            types = {Gf.Vec3d: Sdf.ValueTypeNames.Double3, Gf.Vec3f: Sdf.ValueTypeNames.Vector3f}
            Sdf.JustCreatePrimAttributeInLayer(reference, at, types[kind], Sdf.VariabilityVarying, False)
            for time, value in enumerate(values[:, index, :3].tolist()):
                reference.SetTimeSample(at, float(time), kind(*value))
    actual = read(output)
    for at in (f"{path}.{name}" for path in PATHS for name in (NAMES[0], "warpmag:moment")):
        times = reference.ListTimeSamplesForPath(at)
        assert actual[at] == {time: reference.QueryTimeSample(at, time) for time in times}
    assert len(actual[f"{PATHS[1]}.physics:velocity"]) == count


def test_a_cache_can_be_edited_and_saved(tmp_path, stage):
    """USD saves in place, over what it takes for the end of the file."""
    output, frames = tmp_path / "run.usda", make_frames(100)
    with CacheWriter(stage, output, PATHS, PATHS) as writer:
        add(writer, frames, range(100))
    before = read(output)
    layer = Sdf.Layer.FindOrOpen(str(tmp_path / "run.cache.usdc"))
    layer.SetTimeSample(f"{PATHS[0]}.warpmag:moment", 1000.0, Gf.Vec3f(1.0, 2.0, 3.0))
    layer.comment = "edited"
    assert layer.Save()
    before[f"{PATHS[0]}.warpmag:moment"][1000.0] = Gf.Vec3f(1.0, 2.0, 3.0)
    assert read(output) == before


class Ended(BaseException):
    """The process is no more."""


@pytest.mark.parametrize("how", ["killed", "full"])
def test_ended_at_any_write_the_stage_has_all_frames(tmp_path, stage, monkeypatch, how):
    """The cache is written by ``os.pwrite`` alone. Killed, nothing is done any more; a full disk takes a part first."""
    frames, write = make_frames(150), os.pwrite
    allowed, taken, done = 0, 0, 0

    def limited(file, data, place):
        nonlocal taken
        taken += 1
        if taken <= allowed:
            return write(file, data, place)
        if how == "killed":
            raise Ended
        if len(data) > 8 and taken == allowed + 1:
            return write(file, data[: len(data) // 2], place)
        raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))

    monkeypatch.setattr(os, "pwrite", limited)
    draw = random.Random(how)
    for attempt in range(40):
        output = tmp_path / f"{how}{attempt}" / "run.usda"
        allowed, taken, done = draw.randrange(600), 0, 0
        writer = CacheWriter(stage, output, PATHS, PATHS)
        with pytest.raises((Ended, InputError)) as ended:
            for done in range(150):
                add(writer, frames, [done])
        with contextlib.suppress(Ended):  # gives the files up
            writer.close(complete=False)
        assert how == "killed" or "No space left on device" in str(ended.value)
        if done:
            assert_has(output, frames, done)
        else:
            assert not output.exists()


def test_a_frame_can_be_added_again_after_a_full_disk(tmp_path, stage, monkeypatch):
    """Whichever write failed: of the second frame, with which samples begin, or of one that makes the file longer."""
    frames, write, count, missing, spans = make_frames(67), os.pwrite, 0, 0, {}

    def limited(file, data, place):
        nonlocal count
        count += 1
        if count == missing:
            raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))
        return write(file, data, place)

    def run(output):
        with CacheWriter(stage, output, PATHS, PATHS) as writer:
            for k in range(67):
                before = count
                try:
                    add(writer, frames, [k])
                except InputError:
                    writer.save(None)
                    assert k > 1 or Sdf.Layer.OpenAsAnonymous(str(output)).endTimeCode == 0.0
                    add(writer, frames, [k])
                spans[k] = range(before + 1, count + 1)
        assert_has(output, frames, 67)

    monkeypatch.setattr(os, "pwrite", limited)
    run(tmp_path / "whole" / "run.usda")
    assert len(spans[64]) > len(spans[63])
    for number in (*spans[1], *spans[64]):
        count, missing = 0, number
        run(tmp_path / f"{number}" / "run.usda")


def test_a_run_continues_where_it_ended(tmp_path, stage, monkeypatch):
    """Frames that came after the checkpoint are dropped, and those that are added grow the file."""
    monkeypatch.setattr("warpmag.usd.write.writer._CHECKPOINT_SECONDS", 0.0)
    monkeypatch.setattr("warpmag.usd.write.writer._CHECKPOINT_SHARE", 1e9)
    output, frames = tmp_path / "run.usda", make_frames(100)
    first = CacheWriter(stage, output, PATHS, PATHS, frames=20, options={"force": "kelvin"})
    add(first, frames, range(15), state=lambda: {"seed": np.arange(5)})
    add(first, make_frames(20, seed=2), range(15, 20))
    first.close(complete=False)
    assert sorted(os.listdir(tmp_path)) == ["run.cache.usdc", "run.resume.npz", "run.usda", "scene.usda"]
    with pytest.raises(InputError, match=r"run\.usda: .*another force: kelvin, now zeeman"):
        CacheWriter(stage, output, PATHS, PATHS, options={"force": "zeeman"}).resume()
    before = (tmp_path / "run.cache.usdc").read_bytes(), output.read_bytes()
    unused = CacheWriter(stage, output, PATHS, PATHS, options={"force": "kelvin"})
    assert unused.resume() is not None
    unused.close(complete=False)  # its state did not fit
    assert before == ((tmp_path / "run.cache.usdc").read_bytes(), output.read_bytes())
    with CacheWriter(stage, output, PATHS, PATHS, options={"force": "kelvin"}) as writer:
        result = writer.resume()
        assert result.time == 14 / 128 and np.array_equal(result.state["seed"], np.arange(5))
        add(writer, frames, [15])
        assert_has(output, frames, 16)
        add(writer, frames, range(16, 100))
    assert_has(output, frames, 100)
    again = CacheWriter(stage, output, PATHS, PATHS, options={"force": "kelvin"})
    assert again.resume().state is None
    again.close()
    assert sorted(os.listdir(tmp_path)) == ["run.cache.usdc", "run.usda", "scene.usda"]


@pytest.mark.parametrize("complete", [False, True])
def test_a_cache_that_is_cut_off_is_refused_in_one_line(tmp_path, stage, complete):
    output, cache = tmp_path / "run.usda", tmp_path / "run.cache.usdc"
    writer = CacheWriter(stage, output, PATHS, PATHS)
    add(writer, make_frames(2), range(2), state=dict)
    writer.close(complete=complete)
    whole = cache.read_bytes()
    for size in (0, 100, 2000, len(whole) - 1):
        cache.write_bytes(whole[:size])
        with pytest.raises(InputError, match=r"run\.cache\.usdc: (cannot be resumed|USD cannot read it)") as refused:
            CacheWriter(stage, output, PATHS, PATHS).resume()
        assert "\n" not in str(refused.value)
    cache.write_bytes(whole)
    writer = CacheWriter(stage, output, PATHS, PATHS)
    assert (writer.resume().state is None) == complete
    writer.close(complete=complete)


def test_an_invalid_checkpoint_is_refused_in_one_line(tmp_path, stage):
    output = tmp_path / "run.usda"
    for content in (b"", b"nonsense", b"PK\x03\x04 cut off"):
        (tmp_path / "run.resume.npz").write_bytes(content)
        with pytest.raises(InputError, match=r"run\.resume\.npz: cannot be read") as refused:
            CacheWriter(stage, output, PATHS, PATHS).resume()
        assert "\n" not in str(refused.value)


def test_a_pipe_in_place_of_a_checkpoint_does_not_wait(tmp_path, stage):
    os.mkfifo(tmp_path / "run.resume.npz")
    with pytest.raises(InputError, match=r"run\.resume\.npz is not a regular file"):
        CacheWriter(stage, tmp_path / "run.usda", PATHS, PATHS).resume()


@pytest.fixture
def begun(tmp_path, stage, monkeypatch):
    """The checkpoint of a run that was ended."""
    monkeypatch.setattr("warpmag.usd.write.writer._CHECKPOINT_SECONDS", 0.0)
    writer = CacheWriter(stage, tmp_path / "run.usda", PATHS, PATHS)
    add(writer, make_frames(3), range(3), state=lambda: {"seed": np.arange(5)})
    writer.close(complete=False)
    return tmp_path / "run.resume.npz"


def refusal(stage, checkpoint):
    """Why a run cannot be resumed."""
    with pytest.raises(InputError) as refused:
        CacheWriter(stage, checkpoint.with_name("run.usda"), PATHS, PATHS).resume()
    return str(refused.value).removeprefix(f"{checkpoint}: ")


def test_a_checkpoint_of_another_version_is_refused_in_one_line(begun, stage):
    """Without a number, as they were once: with the run's options alone."""
    with np.load(begun) as saved:
        arrays = dict(saved)
    noted = json.loads(str(arrays.pop("about")))
    for about in (noted["run"], {**noted, "format": 0}, {**noted, "format": noted["format"] + 1}, "kelvin"):
        np.savez(begun, about=np.array(json.dumps(about)), **arrays)
        assert refusal(stage, begun) == "cannot be resumed, another version of warpmag has written it"
    np.savez(begun, about=np.array(json.dumps(noted)), **{name: arrays[name] for name in list(arrays)[1:]})
    assert refusal(stage, begun) == "cannot be read (some of it is missing)"
    np.savez(begun, about=np.array(json.dumps(noted)), **arrays)
    with CacheWriter(stage, begun.with_name("run.usda"), PATHS, PATHS) as writer:
        assert np.array_equal(writer.resume().state["seed"], np.arange(5))


def test_a_damaged_checkpoint_is_refused_or_read(begun, stage):
    """Whatever a byte is changed to: Python's reader of archives has many words for it."""
    content, chance = begun.read_bytes(), random.Random(3)
    with np.load(begun) as saved:
        whole = dict(saved)
    for place in chance.sample(range(len(content)), 150) + list(range(12)):
        begun.write_bytes(content[:place] + bytes([content[place] ^ chance.randrange(1, 256)]) + content[place + 1 :])
        try:
            _, arrays = Output(begun.with_name("run.usda"), set()).load_checkpoint()
        except InputError as error:
            assert str(error).startswith(f"{begun}: cannot be read (") and not str(error).endswith("()")
        else:  # when it was written, say
            assert all(np.array_equal(array, whole[name]) for name, array in arrays.items())


def test_a_run_whose_cache_was_cut_is_refused_in_one_line(begun, stage):
    cache, output = begun.with_name("run.cache.usdc"), begun.with_name("run.usda")
    content = cache.read_bytes()
    for size in range(0, len(content), len(content) // 20):
        cache.write_bytes(content[:size])
        with pytest.raises(InputError, match=f"^{cache}: "):
            CacheWriter(stage, output, PATHS, PATHS).resume()
    cache.unlink()
    with pytest.raises(InputError, match=f"^{cache}: "):
        CacheWriter(stage, output, PATHS, PATHS).resume()


def test_a_stage_without_a_run_is_not_resumed(tmp_path, stage):
    output = tmp_path / "run.usda"
    output.write_text("#usda 1.0\n")
    with pytest.raises(InputError, match=r"run\.usda: nothing to resume"):
        CacheWriter(stage, output, PATHS, PATHS).resume()


MEMORY = """
import sys
import numpy as np
from pxr import Usd, UsdGeom
from warpmag.usd import CacheWriter

def resident():
    with open("/proc/self/status") as file:
        return next(int(line.split()[1]) / 1024 for line in file if line.startswith("VmRSS"))

def write(name, n):
    stage, rng = Usd.Stage.CreateNew(f"{sys.argv[1]}/{name}.usda"), np.random.default_rng(0)
    UsdGeom.SetStageMetersPerUnit(stage, 1.0)
    paths = [str(UsdGeom.Sphere.Define(stage, f"/World/Ball_{k:04}").GetPath()) for k in range(n)]
    stage.Save()
    writer = CacheWriter(stage, f"{sys.argv[1]}/{name}.out.usda", paths, paths, frames=10_000)
    before = resident()
    poses = np.concatenate([rng.normal(size=(n, 3)), np.tile((0.0, 0.0, 0.0, 1.0), (n, 1))], axis=1)
    for frame in range(3):
        writer.add_frame(1e-3 * frame, poses + 1e-3 * frame, rng.normal(size=(n, 6)), rng.normal(size=(n, 3)))
    return resident() - before

write("few", 10)  # what is loaded at first use stays
print(write("many", 2500))
"""


@pytest.mark.skipif(not os.path.exists("/proc/self/status"), reason="reads the memory of a process as Linux tells it")
def test_memory_of_a_written_layer_is_freed(tmp_path):
    done = subprocess.run([sys.executable, "-c", MEMORY, tmp_path], capture_output=True, text=True, check=True)
    assert float(done.stdout) < 16.0  # MiB, of which the values of two frames are 0.6; 25 to 33 where nothing is given
