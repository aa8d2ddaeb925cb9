"""The files of a run beside others: locks, links, copied scenes, and names."""

import os
import signal
import subprocess
import sys

import pytest
from pxr import Usd, UsdGeom

import warpmag
from tests.recorded_balls import BALL, PATHS, SCENE, add, assert_has, make_frames, open_scene
from warpmag.errors import InputError
from warpmag.scenes_usd import balls_up
from warpmag.show.blender import BLENDER, render_final
from warpmag.usd import CacheWriter, open_stage


@pytest.fixture
def stage(tmp_path):
    return open_scene(tmp_path)


# ---------------------------------------------------------------------------------------------------------------------
# Other runs, other files
# ---------------------------------------------------------------------------------------------------------------------


def test_two_runs_with_one_output(tmp_path, stage):
    output, frames = tmp_path / "run.usda", make_frames(3)
    (tmp_path / "link").symlink_to(tmp_path)
    with CacheWriter(stage, output, PATHS, PATHS) as first:
        add(first, frames, [0])
        for other in (output, tmp_path / "run.usdc", tmp_path / "link" / "run.usda"):  # one cache
            with pytest.raises(InputError, match=f"^{other}: another run is writing it$"):
                add(CacheWriter(stage, other, PATHS, PATHS), frames, [0])
        add(first, frames, [1, 2])
    assert_has(output, frames, 3)
    with CacheWriter(stage, output, PATHS, PATHS) as second:
        add(second, frames, [0])


def test_files_of_a_killed_run_do_not_disturb_the_next(tmp_path, stage):
    script = (
        "import sys, time, numpy as np\n"
        "from warpmag.usd import CacheWriter, open_stage\n"
        "writer = CacheWriter(open_stage(sys.argv[1]), sys.argv[2], [], [])\n"
        "writer.add_frame(0.0, np.zeros((0, 7)), np.zeros((0, 6)), np.zeros((0, 3)))\n"
        "print('there', flush=True)\n"
        "time.sleep(1000)\n"
    )
    output = tmp_path / "out" / "run.usda"
    command = [sys.executable, "-c", script, str(tmp_path / "scene.usda"), str(output)]
    with subprocess.Popen(command, stdout=subprocess.PIPE, text=True) as process:
        assert process.stdout.readline() == "there\n"
        with pytest.raises(InputError, match="another run is writing it"):
            add(CacheWriter(stage, output, PATHS, PATHS), make_frames(1), [0])
        process.send_signal(signal.SIGKILL)
    assert len(os.listdir(output.parent)) == 4
    with CacheWriter(stage, output, PATHS, PATHS) as writer:
        add(writer, make_frames(1), [0])
    assert sorted(os.listdir(output.parent)) == ["run.cache.usdc", "run.usda"]


def test_planted_links_are_not_followed(tmp_path, stage):
    victim, folder = tmp_path / "victim", tmp_path / "out"
    victim.write_text("precious")
    folder.mkdir()
    names = ["run.usda", "run.cache.usdc", "run.resume.npz"]
    names += [f".run{middle}.{os.getpid()}.tmp{end}" for middle, end in (("", ".usda"), (".cache", ".usdc"))]
    for name in names:
        (folder / name).symlink_to(victim)
    with CacheWriter(stage, folder / "run.usda", PATHS, PATHS) as writer:
        add(writer, make_frames(2), [0, 1], state=dict)
    assert victim.read_text() == "precious"
    assert_has(folder / "run.usda", make_frames(2), 2)
    (folder / ".other.lock").symlink_to(victim)
    with pytest.raises(InputError, match=r"other\.usda: cannot be written"):
        add(CacheWriter(stage, folder / "other.usda", PATHS, PATHS), make_frames(1), [0])
    assert victim.read_text() == "precious"


def test_files_are_as_readable_as_others(tmp_path, stage):
    before = os.umask(0o027)
    try:
        with CacheWriter(stage, tmp_path / "run.usda", PATHS, PATHS, copy_scene=True) as writer:
            add(writer, make_frames(1), [0], state=dict)
            names = ("run.usda", "run.cache.usdc", "run.scene.usdc", "run.resume.npz")
            assert {(tmp_path / name).stat().st_mode & 0o777 for name in names} == {0o640}
    finally:
        os.umask(before)


# ---------------------------------------------------------------------------------------------------------------------
# Scenes of several files, and names
# ---------------------------------------------------------------------------------------------------------------------


def test_a_copied_scene_has_everything_with_it(tmp_path):
    """Sublayers, references, payloads and textures, also from folders above the scene's."""
    project, shared = tmp_path / "project", tmp_path / "shared"
    (project / "sub").mkdir(parents=True)
    (shared / "textures").mkdir(parents=True)
    (shared / "textures" / "iron.png").write_text("a picture")
    (project / "sub" / "more.usda").write_text('#usda 1.0\nover "World"\n{\n    custom int more = 5\n}\n')
    ball = '#usda 1.0\n(\n    defaultPrim = "Ball"\n)\n' + BALL.replace("Ball_{}", "Ball").format()
    (shared / "ball.usda").write_text(ball.replace("{\n}", "{\n    asset file = @./textures/iron.png@\n}"))
    children = "".join(
        f'def "Ball_{k}" (\n    {arc} = @../shared/ball.usda@\n)\n{{\n}}\n'
        for k, arc in enumerate(("references", "payload", "references"))
    )
    head = SCENE.split('def Xform "World"')[0].replace("(\n", "(\n    subLayers = [@./sub/more.usda@]\n", 1)
    (project / "scene.usda").write_text(f'{head}def Xform "World"\n{{\n{children}}}\n')
    output = tmp_path / "elsewhere" / "run.usda"
    for _ in range(2):  # the second replaces the first
        with CacheWriter(open_stage(project / "scene.usda"), output, PATHS, PATHS, copy_scene=True) as writer:
            add(writer, make_frames(3), range(3))
    assert sorted(os.listdir(output.parent)) == ["run.cache.usdc", "run.scene", "run.usda"]
    project.rename(tmp_path / "gone")
    shared.rename(tmp_path / "gone too")
    output.parent.rename(tmp_path / "moved")
    moved = Usd.Stage.Open(str(tmp_path / "moved" / "run.usda"))
    assert not moved.GetCompositionErrors()
    assert moved.GetAttributeAtPath("/World.more").Get() == 5
    for path in PATHS:
        prim = moved.GetPrimAtPath(path)
        assert prim.IsA(UsdGeom.Sphere)
        with open(prim.GetAttribute("file").Get().resolvedPath, encoding="utf-8") as texture:
            assert texture.read() == "a picture"


ODD = [
    "a b",
    "a:b",
    "anon:x",
    "a@b",
    "a#b",
    "@@@x",
    "a%20b",
    "%s",
    "a[b]",
    "a{b}",
    "`x`",
    "µ漢字",
    "$x",
    "<UDIM>",
    "-x",
    pytest.param("n" * 236, id="files of 255 bytes"),
]
REFUSED = ["a\nb", "a\\b", "a\tb", "a\x7fb", "a\udcffb", "a:SDF_FORMAT_ARGS:b=c", "x" * 300, "x" * 252, "x" * 250]


@pytest.mark.parametrize("name", ODD)
def test_odd_names_work(tmp_path, monkeypatch, name):
    folder = tmp_path / name
    folder.mkdir()
    (folder / f"{name}.usda").write_text(SCENE)
    monkeypatch.chdir(folder)
    for scene, output in ((folder / f"{name}.usda", folder / f"{name}.out.usda"), (f"{name}.usda", f"{name}.usdc")):
        with CacheWriter(open_stage(scene), output, PATHS, PATHS) as writer:
            add(writer, make_frames(2), [0, 1])
        assert Usd.Stage.Open(str(folder / output)).GetPrimAtPath(PATHS[0]).IsA(UsdGeom.Sphere)


@pytest.mark.parametrize("name", REFUSED, ids=range(len(REFUSED)))
def test_impossible_names_are_refused_in_one_line(tmp_path, stage, name):
    refusals = [lambda: CacheWriter(stage, tmp_path / f"{name}.usda", [], [])]
    if len(name) not in (250, 252):  # there may be such a scene
        refusals.append(lambda: open_stage(tmp_path / f"{name}.usda"))
    for refusal in refusals:
        with pytest.raises(InputError) as refused:
            refusal()
        message = str(refused.value)
        assert message.isprintable() and "usda" in message
    assert os.listdir(tmp_path) == ["scene.usda"]


OF_PATHS = {
    "check: path": lambda path, _: warpmag.check(path),
    "open_stage: path": lambda path, _: open_stage(path),
    "Simulation: scene": lambda path, _: warpmag.Simulation(path, device="cpu"),
    "Simulation.run: output": lambda path, scene: warpmag.Simulation(scene, device="cpu").run(1, output=path),
    "render: stage": lambda path, scene: warpmag.render(path, scene.with_name("a.png"), device="cpu"),
    "render: output": lambda path, scene: warpmag.render(scene, path, device="cpu"),
    "render_final: stage": lambda path, scene: render_final(path, scene.with_name("a.png")),
    "render_final: output": lambda path, scene: render_final(scene, path),
    "export: stage": lambda path, scene: warpmag.export(path, scene.with_name("a.usdc")),
    "export: output": lambda path, scene: warpmag.export(scene, path),
    "MagnetizationCurve.from_csv: path": lambda path, _: warpmag.MagnetizationCurve.from_csv(path),
}
"""Every public function of a path, with the name of that argument."""


@pytest.mark.parametrize("wrong", [3, b"scene.usda", ["scene.usda"], ""])
@pytest.mark.parametrize("name", OF_PATHS)
def test_an_argument_that_is_no_path_is_named(name, wrong, tmp_path):
    balls_up.author(tmp_path / "scene.usda", columns=1, rows=1, layers=1)
    with pytest.raises(InputError, match=rf"^{name.partition(': ')[2]}: must be [^\n]*$"):
        OF_PATHS[name](wrong, tmp_path / "scene.usda")
    assert os.listdir(tmp_path) == ["scene.usda"]


@pytest.mark.parametrize("wrong", ["a\0b.usda", "none.usda", "folder", "pipe.usda", "/dev/zero"])
@pytest.mark.parametrize("name", [name for name in OF_PATHS if "output" not in name])
def test_no_file_is_one_line(name, wrong, tmp_path, monkeypatch):
    """Missing, or something else than a file; nothing waits, and nothing is written."""
    (tmp_path / "folder").mkdir()
    os.mkfifo(tmp_path / "pipe.usda")
    monkeypatch.setenv(BLENDER, sys.executable)
    with pytest.raises(InputError) as refused:
        OF_PATHS[name](wrong if wrong[0] == "/" else tmp_path / wrong, tmp_path / "scene.usda")
    message = str(refused.value)
    assert message.isprintable() and wrong.rpartition("/")[2].rpartition("\0")[2] in message
    assert sorted(os.listdir(tmp_path)) == ["folder", "pipe.usda"]


def test_home_and_links_to_folders(tmp_path, monkeypatch):
    """A link leads to a folder elsewhere: from there the way to the scene is another one."""
    deep = tmp_path / "some" / "where" / "deep"
    deep.mkdir(parents=True)
    (tmp_path / "link").symlink_to(deep)
    (tmp_path / "scene.usda").write_text(SCENE)
    monkeypatch.setenv("HOME", str(tmp_path))
    with CacheWriter(open_stage("~/link/../../../scene.usda"), "~/link/run.usda", PATHS, PATHS) as writer:
        add(writer, make_frames(2), [0, 1])
    assert not (tmp_path / "~").exists()
    for folder in (tmp_path / "link", deep):
        stage = Usd.Stage.Open(str(folder / "run.usda"))
        assert not stage.GetCompositionErrors() and stage.GetPrimAtPath(PATHS[0]).IsA(UsdGeom.Sphere)
