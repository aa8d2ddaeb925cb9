"""Every command and every function that reads a stage ends: on hostile stages in one line, and soon after a signal."""

import collections
import contextlib
import itertools
import os
import shutil
import signal
import subprocess
import sys
import time
from pathlib import Path

import pytest
from pxr import Sdf

import warpmag
from warpmag import cli, terminal, usd
from warpmag.engine.stepping import recording
from warpmag.engine.stepping.scene import import_scene
from warpmag.errors import InputError
from warpmag.scenes_usd import balls_up
from warpmag.show import blender, export, ray_tracing
from warpmag.usd import open_animated, open_stage
from warpmag.usd.read import trial_read

COMMANDS = {
    "run": ["run", "SCENE", "-o", "OUT/run.usda", "--frames", "1", "--device", "cpu"],
    "check": ["check", "SCENE"],
    "render": ["render", "SCENE", "-o", "OUT/picture.png", "--size", "16x9", "--device", "cpu"],
    "render final": ["render", "SCENE", "-o", "OUT/picture.png", "--quality", "final"],
    "export": ["export", "SCENE", "-o", "OUT/out.usdc"],
    "export package": ["export", "SCENE", "-o", "OUT/out.usdz"],
    "export page": ["export", "SCENE", "-o", "OUT/out.html"],
    "export numbers": ["export", "SCENE", "-o", "OUT/out.npz"],
}
FUNCTIONS = {
    "open_stage": open_stage,
    "open_animated": open_animated,
    "check": warpmag.check,
    "import_scene": import_scene,
    "Simulation": lambda path: warpmag.Simulation(path, device="cpu"),
    "render": lambda path: warpmag.render(path, path.with_name("picture.png"), size=(16, 9), device="cpu"),
    "export": lambda path: warpmag.export(path, path.with_name("out.usdc")),
    "render_final": lambda path: blender.render_final(path, path.with_name("picture.png")),
}
HEAD = "#usda 1.0\n"
DEEP = HEAD + "(customLayerData = " + "{ dictionary a = " * 100_000 + "{}" + "}" * 100_000 + ")\n"
VARIABLE = '(expressionVariables = {string X = "odd.usda"}\nsubLayers = [@./between.usda@])\n'


def sublayer(folder, text):
    (folder / "scene.usda").write_text(f"{HEAD}(subLayers = [@./scene0.usda@, @./odd.usda@])\n")
    if text:
        (folder / "odd.usda").write_text(text)
    else:
        os.mkfifo(folder / "odd.usda")


def crashing(folder):
    """A layer on which USD crashes."""
    sublayer(folder, DEEP)


def pipe(folder):
    """A layer that is a pipe, by its name."""
    sublayer(folder, "")


def computed_pipe(folder):
    """A layer that is a pipe, whose name is known only after composition."""
    os.mkfifo(folder / "odd.usda")
    (folder / "scene.usda").write_text(HEAD + VARIABLE)
    (folder / "between.usda").write_text(f'{HEAD}(subLayers = [@./scene0.usda@, @`"./${{X}}"`@])\n')


def textured(folder, name, kind="asset", time=None):
    value = f" = {name}" if time is None else f".timeSamples = {{{time}: {name}}}"
    (folder / "between.usda").write_text(
        f'{HEAD}def Material "Odd" {{\ndef Shader "Picture" {{\nuniform token info:id = "UsdUVTexture"\n'
        f"{kind} inputs:file{value}\n}}\n}}\n"
    )
    variables = '(expressionVariables = {string X = "zero"}\nsubLayers = [@./scene0.usda@, @./between.usda@])\n'
    (folder / "scene.usda").write_text(HEAD + variables)


def texture(folder):
    """A texture of a device, by its name."""
    textured(folder, "@/dev/zero@")


def sampled_texture(folder):
    """A texture of a device, in a time sample."""
    textured(folder, "@/dev/zero@", time=5)


def computed_texture(folder):
    """A texture of a device, whose name is known only after composition."""
    textured(folder, '@`"/dev/${X}"`@')


def computed_textures(folder):
    """An array of textures of devices, in a time sample, whose names are known only after composition."""
    textured(folder, '[@`"/dev/${X}"`@]', kind="asset[]", time=5)


def computed_metadata(folder):
    """An asset in metadata that is a pipe, whose name is known only after composition: a package would contain it."""
    os.mkfifo(folder / "zero")
    textured(folder, "@@")
    odd = f'{HEAD}def "More" (customData = {{asset a = @`"./${{X}}"`@}}) {{\ndouble x = 1\n}}\n'
    (folder / "between.usda").write_text(odd)


def damaged(folder):
    """A binary file cut short."""
    layer = Sdf.Layer.FindOrOpen(str(folder / "scene0.usda"))
    layer.Export(str(folder / "whole.usdc"))
    content = (folder / "whole.usdc").read_bytes()
    (folder / "scene.usda").write_text(f"{HEAD}(subLayers = [@./odd.usdc@])\n")
    (folder / "odd.usdc").write_bytes(content[: len(content) * 2 // 3])


def lost_variants(folder):
    """A binary layer with damaged variants."""
    shutil.copy(Path(__file__).parent / "fuzz" / "lost_variants.usdc", folder / "odd.usdc")
    (folder / "scene.usda").write_text(f"{HEAD}(subLayers = [@./odd.usdc@])\n")


REGULAR = "is not a regular file"
HOSTILE = {
    crashing: "USD's reader crashes on it (SIGSEGV)",
    pipe: REGULAR,
    computed_pipe: "USD did not read it within 1 s",
    texture: REGULAR,
    sampled_texture: REGULAR,
    computed_texture: REGULAR,
    computed_textures: REGULAR,
    computed_metadata: REGULAR,
    damaged: "",
    lost_variants: "damaged: ",
}


@pytest.fixture(scope="module")
def scene(tmp_path_factory):
    path = tmp_path_factory.mktemp("scene") / "scene0.usda"
    balls_up.author(path, columns=1, rows=1, layers=1)
    return path


@pytest.fixture
def folder(scene, tmp_path, monkeypatch):
    """A folder with the scene; children are given one second, and final pictures a Python."""
    shutil.copy(scene, tmp_path)
    monkeypatch.setattr(trial_read, "_SECONDS", 1.0)
    monkeypatch.setenv(blender.BLENDER, sys.executable)
    return tmp_path


def fork(action, messages):
    """Start an action in a forked process, which writes its standard files to ``messages``; return the process."""
    process = os.fork()
    if not process:
        code = 99
        try:
            file = os.open(messages, os.O_WRONLY | os.O_CREAT)
            os.dup2(file, 1)
            os.dup2(file, 2)
            sys.stdout, sys.stderr = os.fdopen(1, "w", closefd=False), os.fdopen(2, "w", closefd=False)
            code = action()
        except InputError as error:
            print(error, file=sys.stderr)
            code = cli.BAD_INPUT
        finally:
            sys.stdout.flush()
            sys.stderr.flush()
            os._exit(code)
    return process


def exit_status(process, seconds=60.0):
    """Wait for a process and return its exit status, or a text if it does not end."""
    try:
        deadline = time.monotonic() + seconds
        while time.monotonic() < deadline:
            ended, status = os.waitpid(process, os.WNOHANG)
            if ended:
                return os.waitstatus_to_exitcode(status)
            time.sleep(0.01)
    except BaseException:
        os.kill(process, signal.SIGKILL)
        raise
    os.kill(process, signal.SIGKILL)
    os.waitpid(process, 0)
    return "it did not end"


def forked(action, messages):
    """Return the exit status of an action in a forked process, which writes its standard files to ``messages``."""
    return exit_status(fork(action, messages))


def command_of(name, scene):
    places = {"SCENE": str(scene)}
    return [places.get(word, word.replace("OUT", str(scene.parent))) for word in COMMANDS[name]]


def long_unless(case, is_short):
    """A case of a test that is marked ``long`` where others show the same in a shorter time."""
    return pytest.param(*case, marks=() if is_short else pytest.mark.long)


HOSTILE_CASES = [
    long_unless(
        (name, kind),
        name == "check" or kind in (crashing, texture) or (name, kind) == ("export package", computed_metadata),
    )
    for name in COMMANDS
    for kind in HOSTILE
]
"""All commands read stages in the same way: by default each stage with one command, and two stages with each."""


@pytest.mark.parametrize(("name", "kind"), HOSTILE_CASES, ids=lambda value: getattr(value, "__name__", value))
def test_a_hostile_stage_is_one_line_of_each_command(name, kind, folder):
    kind(folder)
    code = forked(lambda: cli.main(command_of(name, folder / "scene.usda")), folder / "messages")
    lines = (folder / "messages").read_text().splitlines()
    assert (code, len(lines)) == (cli.BAD_INPUT, 1), (code, lines)
    assert lines[0].startswith("warpmag: ") and HOSTILE[kind] in lines[0]


@pytest.mark.parametrize(
    ("name", "kind"),
    [
        long_unless((name, kind), kind is crashing or name == "open_stage")
        for name in FUNCTIONS
        for kind in (crashing, computed_pipe)
    ],
    ids=lambda value: getattr(value, "__name__", value),
)
def test_a_hostile_stage_is_one_line_of_each_function(name, kind, folder):
    kind(folder)
    code = forked(lambda: FUNCTIONS[name](folder / "scene.usda") and 0, folder / "messages")
    lines = (folder / "messages").read_text().splitlines()
    assert code == cli.BAD_INPUT and HOSTILE[kind] in lines[-1], (code, lines)  # Warp has introduced itself


def swapped(folder):
    """The result of a run whose scene another has replaced."""
    run = cli.main(["run", str(folder / "scene0.usda"), "-o", str(folder / "scene.usda"), "--frames", "1"])
    assert run == 0
    (folder / "scene0.usda").write_text(DEEP)


@pytest.mark.parametrize("name", [name for name in COMMANDS if name != "run"])
def test_a_result_over_a_hostile_scene_is_one_line(name, folder):
    swapped(folder)
    code = forked(lambda: cli.main(command_of(name, folder / "scene.usda")), folder / "messages")
    (line,) = (folder / "messages").read_text().splitlines()
    assert code == cli.BAD_INPUT and line.endswith("USD's reader crashes on it (SIGSEGV)")


@pytest.mark.parametrize("hostile", ["pipe", "text", "link"])
def test_resume_reads_no_hostile_cache(hostile, folder):
    """The cache of a complete run, which has no checkpoint."""
    command = ["run", str(folder / "scene0.usda"), "-o", str(folder / "out.usda"), "--frames", "1", "--device", "cpu"]
    assert cli.main(command) == 0
    cache = folder / "out.cache.usdc"
    cache.unlink()
    if hostile == "pipe":
        os.mkfifo(cache)
    elif hostile == "link":
        cache.symlink_to("/dev/zero")
    else:
        cache.write_text(DEEP)
    code = forked(lambda: cli.main([*command, "--resume"]), folder / "messages")
    (line,) = (folder / "messages").read_text().splitlines()
    reason = "brackets are nested" if hostile == "text" else REGULAR
    assert code == cli.BAD_INPUT and "cannot be resumed" in line and reason in line


@pytest.fixture
def trials(monkeypatch):
    """Stages that children have read."""
    paths, run = [], subprocess.run

    def noted(command, **options):
        if command[3] == trial_read.__file__:
            paths.append(Path(command[5]).name)
        return run(command, **options)

    monkeypatch.setattr(subprocess, "run", noted)
    return paths


@pytest.mark.parametrize("name", [*COMMANDS, "run and export"])
def test_each_command_tries_a_stage_once(name, folder, trials, capsys):
    """Although some open it twice. A result of the same process needs no trial."""
    Sdf.Layer.FindOrOpen(str(folder / "scene0.usda")).Export(str(folder / "scene.usdc"))
    command = command_of(name.split()[0] if "and" in name else name, folder / "scene.usdc")
    cli.main([*command, "--for", "render"] if "and" in name else command)
    assert trials == ["scene.usdc"]


def test_a_stage_is_tried_again_when_a_file_changes(folder, trials):
    """One that its root layer names, directly or not, or that did not exist."""
    (folder / "scene.usda").write_text(f"{HEAD}(subLayers = [@./between.usda@])\n")
    (folder / "between.usda").write_text(f"{HEAD}(subLayers = [@./scene0.usda@, @./odd.usda@])\n")
    texts = {"scene0.usda": (folder / "scene0.usda").read_text() + "\n", "odd.usda": HEAD, "between.usda": HEAD}
    with contextlib.suppress(InputError):  # a missing layer
        open_stage(folder / "scene.usda")
    for count, (name, text) in enumerate(texts.items(), 2):
        (folder / name).write_text(text)
        for _ in range(2):
            with contextlib.suppress(InputError):
                open_stage(folder / "scene.usda")
        assert len(trials) == count, name


PHASES = {
    "run": (cli, "_load"),
    "check": (usd, "check"),
    "render": (ray_tracing, "render"),
    "render final": (blender, "render_final"),
    "export": (export, "export"),
    "scenes": (usd, "describe"),
    "materials": (cli, "_materials"),
}
"""Commands, and a function in each that does not return to Python."""
SIGNALS = ("SIGTERM", "SIGINT", "SIGHUP")


def endless(begin):
    """A loop of iterators that stands for native code: it holds the lock and reads no signals."""
    collections.deque(itertools.chain(map(os.write, [begin], [b"."]), range(10**13)), maxlen=0)


def interrupt(action, number, messages):
    """Fork an action and send it a signal when it has written a byte; return the process and the time of the signal."""
    reader, writer = os.pipe()

    def act():
        for default in SIGNALS:
            signal.signal(getattr(signal, default), signal.SIG_DFL)
        signal.signal(signal.SIGINT, signal.default_int_handler)
        return action(writer)

    process = fork(act, messages)
    os.close(writer)
    begun = os.read(reader, 1)
    os.close(reader)
    if begun != b".":
        pytest.fail(f"it did not begin: {exit_status(process)}, {messages.read_text()}")
    os.kill(process, number)
    return process, time.monotonic()


def interrupted(action, number, messages):
    """Return the exit status of an action, and the seconds from a signal to its end."""
    process, sent = interrupt(action, number, messages)
    return exit_status(process), time.monotonic() - sent


@pytest.mark.parametrize(
    ("name", "way"),
    [long_unless((name, way), name == "check" or way == "SIGTERM") for name in PHASES for way in SIGNALS],
)
def test_a_signal_ends_native_code_of_each_command(name, way, folder, monkeypatch):
    """In about a second; the limit is for a loaded machine."""
    module, function = PHASES[name]

    def act(begin):
        setattr(module, function, lambda *_, **__: endless(begin))
        return cli.main(command_of(name, folder / "scene0.usda") if name in COMMANDS else [name])

    code, seconds = interrupted(act, getattr(signal, way), folder / "messages")
    assert code == -signal.SIGKILL and seconds < 10.0
    assert (folder / "messages").read_text().splitlines()[-1] == "warpmag: ended by a signal"


@pytest.mark.parametrize("way", SIGNALS)
def test_a_signal_ends_a_trial_read_that_waits(way, folder, monkeypatch):
    """The command reacts by itself, and leaves no child."""
    monkeypatch.setattr(trial_read, "_SECONDS", 30.0)
    computed_pipe(folder)

    def act(begin):
        run = subprocess.run
        subprocess.run = lambda *command, **options: (os.write(begin, b"."), run(*command, **options))[1]
        return cli.main(["check", str(folder / "scene.usda")])

    number = getattr(signal, way)
    code, seconds = interrupted(act, number, folder / "messages")
    assert code == 128 + number and seconds < 10.0
    with pytest.raises(OSError, match="No such device or address"):  # nothing reads the pipe
        os.open(folder / "odd.usda", os.O_WRONLY | os.O_NONBLOCK)


def test_a_command_that_reacts_has_time_to_close_its_files(folder, monkeypatch):
    """Three seconds are enough; a minute is cut to the limit."""
    monkeypatch.setattr(terminal, "_ENDING", 6.0)

    def command(seconds):
        def close_slowly(begin):
            try:
                os.write(begin, b".")
                time.sleep(100.0)
            finally:
                end = time.monotonic() + seconds
                while time.monotonic() < end:
                    time.sleep(0.1)

        def act(begin):
            cli._materials = lambda _: close_slowly(begin)
            return cli.main(["materials"])

        return act

    numbers = [getattr(signal, way) for way in SIGNALS]
    cases = [(seconds, number) for seconds in (3.0, 60.0) for number in numbers]
    files = [folder / f"messages{k}" for k in range(len(cases))]
    started = [interrupt(command(case[0]), case[1], file) for case, file in zip(cases, files, strict=True)]
    for (seconds, number), (process, sent) in zip(cases, started, strict=True):  # all wait at the same time
        code, lasted = exit_status(process), time.monotonic() - sent
        assert code == (128 + number if seconds < 6.0 else -signal.SIGKILL) and lasted < 12.0, (seconds, number)


def test_a_frame_is_written_before_the_end(folder):
    """Python delays a signal while it writes a frame, however long that takes."""

    def act(begin):
        def write_slowly(_):
            with recording._signals_delayed():
                os.write(begin, b".")
                end = time.monotonic() + 3.0
                while time.monotonic() < end:
                    time.sleep(0.1)
            print("went on")

        cli._materials = write_slowly
        return cli.main(["materials"])

    numbers = [getattr(signal, way) for way in SIGNALS]
    started = [interrupt(act, number, folder / f"messages{number}") for number in numbers]
    for number, (process, sent) in zip(numbers, started, strict=True):
        code, seconds = exit_status(process), time.monotonic() - sent
        assert code == 128 + number and seconds > 2.9, number
        assert "went on" not in (folder / f"messages{number}").read_text()


def test_other_signals_and_other_handlers_are_left_alone(folder):
    """A program that calls the command keeps its handler, and the guard ends nothing."""
    handled = []

    def act(begin):
        for name in (*SIGNALS, "SIGUSR1"):
            signal.signal(getattr(signal, name), lambda number, _: handled.append(number))

        def wait(_):
            os.write(begin, b".")
            for name in (*SIGNALS, "SIGUSR1"):
                os.kill(os.getpid(), getattr(signal, name))
            time.sleep(2.5)
            return len(handled)

        cli._materials = wait
        return cli.main(["materials"])

    reader, writer = os.pipe()
    assert forked(lambda: act(writer), folder / "messages") == 4
    os.close(reader)
    os.close(writer)
