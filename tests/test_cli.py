"""The command: what it prints, what it writes, how it ends."""

import io
import os
import re
import shlex
import shutil
import signal
import subprocess
import sys
import time
from importlib import metadata
from types import SimpleNamespace

import pytest
import warp as wp
from pxr import Gf, Usd, UsdGeom, UsdPhysics

from warpmag import cli
from warpmag.declarations.magnets import Magnet, MagneticSettings
from warpmag.declarations.materials import MATERIALS
from warpmag.progress import Progress, Waiting
from warpmag.scenes_usd import balls_up
from warpmag.usd import author_magnet, author_settings


@pytest.fixture(scope="module")
def scene(tmp_path_factory):
    """A Balls Up of four balls."""
    path = tmp_path_factory.mktemp("cli") / "small.usda"
    balls_up.author(path, columns=2, rows=2, layers=1, height=0.05)
    return path


def edited(scene, path, edit):
    """Copy ``scene`` to ``path`` with ``edit`` done to the stage."""
    stage = Usd.Stage.Open(str(scene))
    edit(stage)
    stage.GetRootLayer().Export(str(path))
    stage.GetRootLayer().Reload(force=True)
    return path


def test_run_writes_a_stage_and_a_summary(scene, device, tmp_path, capfd):
    out = tmp_path / "new" / "out.usda"
    assert cli.main(["run", str(scene), "-o", str(out), "--frames", "3", "--device", device]) == 0
    printed = capfd.readouterr()
    for word in ("4 moving", "RMS", "peak", "% of the half-thickness at most", "wall time", "loading"):
        assert word in printed.out
    assert "Ti " not in printed.out  # only with --verbose
    assert "3/3" in printed.err  # the progress bar
    assert "Warp" not in printed.out + printed.err
    stage = Usd.Stage.Open(str(out))
    assert stage.GetEndTimeCode() == pytest.approx(3.0)
    assert stage.GetPrimAtPath("/World/Balls/Ball_0000").GetAttribute("warpmag:moment").GetNumTimeSamples() == 4


@pytest.mark.parametrize("said", ["", "Unable to allocate 9 EiB"])
def test_too_little_memory_is_one_line(scene, said, monkeypatch, capsys):
    def load(*_, **__):
        raise MemoryError(*[said] * bool(said))

    monkeypatch.setattr(cli, "_load", load)
    assert cli.main(["run", str(scene)]) == cli.FAILED
    assert capsys.readouterr().err == f"warpmag: not enough memory{f' ({said})' * bool(said)}\n"


def test_too_little_memory_for_warp_is_one_line(scene, device, monkeypatch, capsys):
    monkeypatch.setattr(cli, "_load", lambda *_, **__: wp.empty((2**30, 2**30), dtype=wp.uint8, device=device))
    assert cli.main(["run", str(scene)]) == cli.FAILED
    assert re.fullmatch(r"warpmag: not enough memory \(Failed to allocate 1152.* bytes .*\)\n", capsys.readouterr().err)


def test_version(capsys):
    with pytest.raises(SystemExit) as ended:
        cli.main(["--version"])
    assert ended.value.code == 0
    assert capsys.readouterr().out == f"warpmag {metadata.version('warpmag')}\n"


@pytest.mark.parametrize("preset", ["warpmag", "paper", "kim2018"])
def test_presets_run_by_name(scene, device, preset, tmp_path, capfd):
    out = tmp_path / "out.usda"
    command = ["run", str(scene), "-o", str(out), "--frames", "1", "--device", device, "--preset", preset]
    assert cli.main([*command, "--verbose"]) == 0
    printed = capfd.readouterr().out
    for word in ("Ti ", "Tf ", "Tr ", "evaluations per step", "magnetization error", "buffer growths"):
        assert word in printed


@pytest.mark.parametrize(
    ("command", "old", "new", "stored"),
    [
        ("run", "--sums fmm", "--method fmm", {"preset": None, "method": "fmm"}),
        ("run", "--method paper", "--preset paper", {"preset": "paper", "method": "auto"}),
        ("render -o a.png", "--moments", "--arrows", {"arrows": True}),
        ("export -o a.usdc", "--rate 30.0", "--fps 30.0", {"fps": 30.0}),
    ],
)
def test_renamed_options_still_work_with_a_warning(command, old, new, stored, monkeypatch, capsys):
    options = []
    for name in ("_run", "_render", "_export"):
        monkeypatch.setattr(cli, name, lambda given: options.append(given) or 0)
    for spelling, warning in ((old, f"warpmag: warning: {old} is deprecated, write {new}\n"), (new, "")):
        assert cli.main([*command.split(), "balls_up", *spelling.split()]) == 0
        given = vars(options.pop())
        assert {name: given[name] for name in stored} == stored
        assert capsys.readouterr().err == warning


def test_an_existing_result_is_not_overwritten(scene, device, tmp_path, capsys):
    """The run of hours was replaced without a word."""
    out = tmp_path / "out.usda"
    out.write_text("a result")
    command = ["run", str(scene), "-o", str(out), "--frames", "1", "--device", device]
    check_refused(
        command, f"{out}: exists; add --overwrite to replace it, --resume to continue its run, or another -o", capsys
    )
    assert out.read_text() == "a result"
    assert cli.main([*command, "--overwrite"]) == 0
    assert Usd.Stage.Open(str(out)).GetEndTimeCode() == pytest.approx(1.0, abs=0.03)  # at the nearest step


@pytest.mark.parametrize("name", ["x" * 260, f"{'x' * 300}/out"], ids=["file", "folder"])
def test_an_output_whose_name_is_too_long_is_refused_in_one_line(name, scene, device, tmp_path, capsys):
    out = tmp_path / f"{name}.usda"
    assert cli.main(["run", str(scene), "-o", str(out), "--frames", "1", "--device", device]) == cli.BAD_INPUT
    (line,) = capsys.readouterr().err.splitlines()
    assert line.startswith(f"warpmag: {out}: ")


def test_step_duration_and_field_reach_the_simulation(scene, tmp_path, monkeypatch):
    """A field that begins with a minus and has an exponent is no option."""
    loaded = {}

    def load(_, **settings):
        loaded.update(settings)
        return SimpleNamespace(model=None, magnetics=None, frame_rate=60.0, frames_of=lambda frames: frames)

    frames = []
    monkeypatch.setattr(cli, "_load", load)
    monkeypatch.setattr(cli, "_simulate", lambda s, _, options, *__, **___: frames.append(cli._frames_of(s, options)))
    command = ["run", str(scene), "-o", str(tmp_path / "out.usda"), "--duration", "0.25", "--step", "5e-4"]
    assert cli.main([*command, "--external-field", "-8e4", "0", "-.5"]) == 0
    assert (loaded["dt"], loaded["external_field"], frames) == (5e-4, [-8e4, 0.0, -0.5], [15])


def test_the_wall_time_is_the_stopwatch_s(scene, device, tmp_path):
    """Whole and sum of the parts to 5 %, and to the 0.05 s of rounding and 0.2 s in which a busy machine starts."""
    command = [sys.executable, "-m", "warpmag.cli", "run", str(scene), "-o", str(tmp_path / "out.usda")]
    began = time.perf_counter()
    done = subprocess.run([*command, "--frames", "2", "--device", device], capture_output=True, text=True, check=True)
    whole = time.perf_counter() - began
    (line,) = (line for line in done.stdout.splitlines() if line.startswith("wall time"))
    total, *parts = map(float, re.findall(r"([\d.]+) s", line))
    assert total == pytest.approx(whole, rel=0.05, abs=0.25)
    assert sum(parts) == pytest.approx(total, abs=0.05 * (len(parts) + 2))  # at most two parts are too short to show


COMPILE = """
import time, warp as wp
from warpmag.kernel_loading import kernel_seconds, watch_kernels
wp.config.log_level = wp.LOG_ERROR
watch_kernels(lambda: print("compiling", flush=True))
@wp.kernel
def fill(values: wp.array[float]):
    values[wp.tid()] = 1.0
values = wp.zeros(1, dtype=float, device="cpu")
began = time.perf_counter()
for _ in range(2):
    wp.launch(fill, dim=1, inputs=[values], device="cpu")
print(0.0 < kernel_seconds() < time.perf_counter() - began)
"""


def test_a_compilation_is_announced_before_it_begins(tmp_path):
    program = tmp_path / "program.py"
    program.write_text(COMPILE)
    for cached in (False, True):
        environment = os.environ | {"WARP_CACHE_PATH": str(tmp_path / "cache")}
        run = subprocess.run([sys.executable, program], env=environment, capture_output=True, text=True, check=True)
        assert run.stdout.split() == [*["compiling"] * (not cached), "True"]


def test_examples_of_every_help_are_understood():
    parser = cli._parser()
    (commands,) = (action.choices for action in parser._subparsers._group_actions)
    assert set(commands) == {"run", "scenes", "materials", "check", "render", "export"}
    for name, command in {"warpmag": parser, **commands}.items():
        examples = re.findall(r"^  warpmag (.*?)(?:   .*)?$", command.format_help().partition("examples:")[2], re.M)
        assert examples, name
        for example in examples:
            parser.parse_args(shlex.split(example))


def test_materials_lists_every_material(capsys):
    assert cli.main(["materials"]) == 0
    lines = capsys.readouterr().out.splitlines()[1:]
    assert [line.split()[0] for line in lines] == list(MATERIALS)
    (line,) = (line for line in lines if line.startswith("N42"))
    assert "remanence 1.3 T" in line and "7500 kg/m³" in line


def test_a_run_repeats(scene, device, tmp_path, capfd):
    ends = []
    for name in ("one", "other"):
        out = tmp_path / name / "out.usda"
        command = ["run", str(scene), "-o", str(out), "--frames", "12", "--device", device]
        assert cli.main(command) == 0
        stage = Usd.Stage.Open(str(out))
        balls = [stage.GetPrimAtPath(f"/World/Balls/Ball_{k:04d}") for k in range(4)]
        ends.append([ball.GetAttribute("warpmag:moment").Get(12.0) for ball in balls])
        ends.append([UsdGeom.Xformable(ball).ComputeLocalToWorldTransform(12.0) for ball in balls])
    assert ends[:2] == ends[2:]


def test_contact_model_by_option_and_by_stage(scene, device, tmp_path, capsys):
    out = str(tmp_path / "out.usda")
    command = ["run", "-o", out, "--overwrite", "--frames", "1", "--device", device]
    assert cli.main([*command, str(scene), "--contact-model", "multipole"]) == 0

    def choose(stage):
        settings = MagneticSettings(contact_model="multipole")
        author_settings(next(p for p in stage.Traverse() if p.IsA(UsdPhysics.Scene)), settings)

    stage = edited(scene, tmp_path / "near.usda", choose)
    assert cli.main(["check", str(stage)]) == 0
    assert "kelvin, theta, multipole" in capsys.readouterr().out
    assert cli.main([*command, str(stage), "--force", "zeeman"]) == cli.BAD_INPUT
    assert "multipole" in capsys.readouterr().err


def test_scenes_lists_what_is_bundled(capsys):
    assert cli.main(["scenes"]) == 0
    assert "balls_up" in capsys.readouterr().out


def test_check_tells_what_a_stage_holds(scene, capsys):
    assert cli.main(["check", str(scene)]) == 0
    printed = capsys.readouterr().out
    assert "4 inducible, 1 permanent" in printed
    assert "1 m, 1 kg, Z up" in printed
    assert printed.splitlines()[-1] == "verdict     ready to run"


def set_on_ball(name, value):
    return lambda stage: stage.GetPrimAtPath("/World/Balls/Ball_0001").GetAttribute(name).Set(value)


BAD_STAGES = {
    "negative saturation": (set_on_ball("warpmag:saturationMagnetization", -1.0), "/World/Balls/Ball_0001: saturation"),
    "saturation not a number": (
        set_on_ball("warpmag:saturationMagnetization", float("nan")),
        "/World/Balls/Ball_0001: saturation",
    ),
    "no radius": (set_on_ball("radius", 0.0), "/World/Balls/Ball_0001: radius"),
    "unknown token": (set_on_ball("warpmag:curve", "cubic"), "/World/Balls/Ball_0001: curve"),
    "position not a number": (
        set_on_ball("xformOp:translate", (float("nan"), 0.0, 0.0)),
        "/World/Balls/Ball_0001: transform is not finite",
    ),
    "no unit": (lambda stage: UsdGeom.SetStageMetersPerUnit(stage, 0.0), "metersPerUnit must be positive"),
    "no magnets": (
        lambda stage: [prim.RemoveAPI("WarpmagMagnetAPI") for prim in stage.Traverse()],
        "no magnets",
    ),
}


@pytest.mark.parametrize("case", BAD_STAGES)
def test_a_bad_stage_is_refused_in_one_line(scene, tmp_path, capsys, case):
    edit, message = BAD_STAGES[case]
    bad = edited(scene, tmp_path / "bad.usda", edit)
    check_refused(["run", str(bad), "-o", str(tmp_path / "out" / "out.usda")], message, capsys)
    assert sorted(path.name for path in tmp_path.iterdir()) == ["bad.usda"]  # nothing written, no folder made


def check_refused(arguments, message, capsys):
    assert cli.main(arguments) == 2
    printed = capsys.readouterr()
    assert printed.out == ""
    lines = printed.err.splitlines()
    assert len(lines) == 1
    assert lines[0].startswith("warpmag: ")
    assert message in lines[0]


def test_bad_arguments_are_refused_in_one_line(scene, tmp_path, capsys):
    text = tmp_path / "text.usda"
    text.write_text("hello")
    for arguments, message in [
        (["run", "nowhere"], "nowhere: no such file and no bundled scene"),
        (["run", str(tmp_path / "nowhere.usda")], "no such file"),
        (["run", str(text)], "not a USD file"),
        (["check", str(text)], "not a USD file"),
        (["run", str(scene), "--frames", "0"], "frames: must be positive"),
        (["run", str(scene), "--frames", "many"], "--frames"),
        (["run", str(scene), "--rtol", "-1"], "rtol: must be at least"),
        (["run", str(scene), "--force", "lorentz"], "lorentz"),
        (["run", str(scene), "--device", "cuda:99"], "device: no 'cuda:99' here"),
        (["run", str(scene), "-o", str(tmp_path / "out.txt"), "--device", "cpu"], "the output must end in"),
        (["fly"], "fly"),
        ([], "required"),
    ]:
        check_refused(arguments, message, capsys)
    assert sorted(path.name for path in tmp_path.iterdir()) == ["text.usda"]


def test_a_point_instancer_of_nothing_is_refused(scene, tmp_path, capsys):
    def instance(stage):
        instancer = UsdGeom.PointInstancer.Define(stage, "/World/Many")
        ball = UsdGeom.Sphere.Define(stage, "/World/Many/Ball")
        UsdPhysics.RigidBodyAPI.Apply(ball.GetPrim())
        author_magnet(ball.GetPrim(), Magnet())
        instancer.CreatePrototypesRel().AddTarget(ball.GetPath())
        instancer.CreatePositionsAttr([(0.0, 0.0, 1.0)])
        instancer.CreateProtoIndicesAttr([1])

    bad = edited(scene, tmp_path / "bad.usda", instance)
    check_refused(["run", str(bad)], "/World/Many: protoIndices names prototype 1", capsys)


def test_overlapping_balls_are_a_warning(scene, device, tmp_path, capsys):
    def press(stage):
        place = stage.GetPrimAtPath("/World/Balls/Ball_0000").GetAttribute("xformOp:translate")
        place.Set(place.Get() + Gf.Vec3d(0.0005, 0.0, 0.0))  # a tenth of the radius into its neighbour

    path = edited(scene, tmp_path / "pressed.usda", press)
    out = tmp_path / "out.usda"
    assert cli.main(["run", str(path), "-o", str(out), "--frames", "1", "--device", device]) == 0
    assert "warpmag: warning: 1 pair of bodies overlaps at the start" in capsys.readouterr().err


def test_an_interrupted_run_leaves_the_frames_so_far(scene, device, tmp_path):
    out = tmp_path / "out.usda"
    command = [sys.executable, "-m", "warpmag.cli", "run", str(scene), "-o", str(out), "--device", device]
    process = subprocess.Popen(
        [*command, "--frames", "100000"],
        stderr=subprocess.PIPE,
        text=True,
        env=os.environ | {"PYTHONUNBUFFERED": "1"},
        preexec_fn=lambda: signal.signal(signal.SIGINT, signal.SIG_DFL),  # ignored in background jobs
    )
    deadline = time.monotonic() + 240.0
    text = ""
    while "0/100000" not in text and time.monotonic() < deadline:  # the bar is there: the first frame is done
        text += process.stderr.read(1)
    time.sleep(2.0)
    process.send_signal(signal.SIGINT)
    _, rest = process.communicate(timeout=60.0)
    assert process.returncode == 130
    assert f"warpmag: interrupted, {out} has the frames up to" in rest
    assert "Traceback" not in rest
    stage = Usd.Stage.Open(str(out))
    assert stage.GetPrimAtPath("/World/Balls/Ball_0000").GetAttribute("warpmag:moment").HasAuthoredValue()


DRIVER = r"""
#include <stdint.h>
#include <string.h>
static int version(int *value) { *value = 13000; return 0; }
static int begin(unsigned flags) { return 100; }
static int text(int code, const char **value) { *value = "no CUDA-capable device is detected"; return 0; }
static int none(void) { return 100; }
int cuGetProcAddress(const char *name, void **found, int version_, uint64_t flags, void *status) {
    *found = !strcmp(name, "cuDriverGetVersion") ? (void *)version : !strcmp(name, "cuInit") ? (void *)begin
        : !strcmp(name, "cuGetErrorString") ? (void *)text : (void *)none;
    return 0;
}
"""


@pytest.mark.skipif(not shutil.which("gcc"), reason="makes a CUDA driver with gcc")
def test_a_hidden_gpu_is_no_news(tmp_path):
    (tmp_path / "driver.c").write_text(DRIVER)
    subprocess.run(["gcc", "-shared", "-fPIC", "-o", "libcuda.so", "driver.c"], cwd=tmp_path, check=True)
    quiet = "from warpmag.terminal import quiet_warp; quiet_warp(); import warp; assert not warp.get_cuda_devices()"
    environment = os.environ | {"LD_LIBRARY_PATH": f"{tmp_path}:{os.environ.get('LD_LIBRARY_PATH', '')}"}
    loud = subprocess.run(
        [sys.executable, "-c", "import warp; warp.init()"], env=environment, capture_output=True, text=True
    )
    assert "no CUDA-capable device is detected" in loud.stderr  # the driver is taken
    done = subprocess.run([sys.executable, "-c", quiet], env=environment, capture_output=True, text=True)
    assert (done.returncode, done.stdout, done.stderr) == (0, "", "")


@pytest.mark.parametrize("arguments", [["scenes"], ["check", "balls_up"], ["--version"], ["run", "--help"]])
def test_a_full_standard_output_ends_in_one_line(arguments):
    command = [sys.executable, "-m", "warpmag.cli", *arguments]
    with open("/dev/full", "w", encoding="utf-8") as full:
        result = subprocess.run(command, stdout=full, stderr=subprocess.PIPE, text=True, timeout=300, check=False)
    assert result.returncode == 1
    assert result.stderr == "warpmag: [Errno 28] No space left on device\n"


@pytest.mark.parametrize("where", [{"WARP_CACHE_PATH": "/dev/null/x"}, {"HOME": "/dev/null"}])
def test_without_a_usable_cache_kernels_are_compiled_for_one_command(where):
    program = (
        "from warpmag.terminal import quiet_warp; quiet_warp(); import warp, os;"
        "print(os.access(warp.config.kernel_cache_dir, os.W_OK))"
    )
    environment = {key: value for key, value in os.environ.items() if key not in ("WARP_CACHE_PATH", "XDG_CACHE_HOME")}
    command = [sys.executable, "-c", program]
    result = subprocess.run(command, env=environment | where, capture_output=True, text=True, timeout=300, check=False)
    assert result.stdout == "True\n"
    (line,) = result.stderr.splitlines()
    assert line.startswith("warpmag: warning: kernels are compiled for this command only")


def test_check_ends_with_a_verdict(scene, tmp_path, capsys):
    def press(stage):
        place = stage.GetPrimAtPath("/World/Balls/Ball_0000").GetAttribute("xformOp:translate")
        place.Set(place.Get() + Gf.Vec3d(0.0005, 0.0, 0.0))

    for edit, code, verdict in (
        (set_on_ball("warpmag:saturationMagnetization", -1.0), cli.BAD_INPUT, "cannot be run: 1 error"),
        (press, 0, "ready to run, with 1 warning"),
    ):
        assert cli.main(["check", str(edited(scene, tmp_path / "edited.usda", edit))]) == code
        assert capsys.readouterr().out.splitlines()[-1] == f"verdict     {verdict}"


def test_check_counts_moments_and_solves_nothing(scene, capsys, monkeypatch):
    monkeypatch.setattr("warpmag.engine.magnets.magnetics.Magnetics.induce", None)
    assert cli.main(["check", str(scene)]) == 0
    assert re.search(r"^moments     [\d,]+ in \d+ bodies, at most [\d,]+ in one body: /", capsys.readouterr().out, re.M)


class Terminal(io.StringIO):
    """A stderr that is a terminal."""

    def isatty(self):
        return True


def test_a_line_shows_from_the_first_second_that_a_stage_loads(monkeypatch):
    monkeypatch.setattr("sys.stderr", terminal := Terminal())
    Waiting("scene: loading")
    assert "scene: loading, 00:00" in terminal.getvalue()
    time.sleep(1.7)
    assert "scene: loading, 00:01" in terminal.getvalue()
    Progress.interrupt("scene: compiling kernels")
    assert "scene: compiling kernels\n" in terminal.getvalue()
    progress = Progress(10)
    progress.show(0)  # the bar replaces the line
    shown = len(terminal.getvalue())
    time.sleep(0.7)
    assert "loading" not in terminal.getvalue()[shown:]
    assert "0/10" in terminal.getvalue()
    progress.close()
    Waiting.end()
