"""The examples, small: each checks its physics itself, in ``test_final``."""

import importlib
import re
import subprocess
import sys
from pathlib import Path

import newton
import pytest
import warp as wp

from warpmag import examples
from warpmag.errors import extra

FOLDER = Path(examples.__file__).parent
SMALL = {
    "arm": "--num-frames 150",
    "balls_up": "--columns 3 --layers 2 --num-frames 15",
    "chain": "--balls 4 --num-frames 40",
    "compass_swarm": "--columns 2 --rows 2 --num-frames 62",
    "connectors": "--num-frames 40",
    "levitation": "--num-frames 30",
    "sorter": "--coils 2 --num-frames 24",
    "trap": "--num-frames 100",
    "worlds": "--world-count 32 --num-frames 15",
}


def make(name, device, options):
    """An example that draws nothing, and its options."""
    with wp.ScopedDevice(device):
        module = importlib.import_module(f"warpmag.examples.{name}")
        options = module.Example.create_parser().parse_args([*options.split(), "--describe"])
        return module.Example(newton.viewer.ViewerNull(num_frames=options.num_frames), options), options


def run(name, device, options, capsys):
    example, options = make(name, device, options)
    with wp.ScopedDevice(device):
        examples.run(example, options)
    lines = capsys.readouterr().out.splitlines()
    assert lines[0] == examples.get_examples()[name]
    assert any(line.startswith("Check ") for line in lines)  # the docstring of ``test_final``
    assert lines[-1] == f"Passed: {example.summary()}"


@pytest.mark.parametrize("name", examples.get_examples())
def test_small(name, device, capsys):
    if name == "arm":
        pytest.importorskip("mujoco_warp")
    run(name, device, SMALL[name], capsys)


@pytest.mark.long
@pytest.mark.parametrize("name", examples.get_examples())
def test_as_it_is(name, device, capsys):
    if name == "arm":
        pytest.importorskip("mujoco_warp")
    run(name, device, "", capsys)


def test_before_its_time_an_example_fails(device):
    """What ``test_final`` asks for is not there from the start."""
    example, _ = make("worlds", device, SMALL["worlds"])
    with pytest.raises(AssertionError):
        example.test_final()


def test_readme_lists_all():
    text = (FOLDER / "README.md").read_text(encoding="utf-8")
    assert re.findall(r"^\| `(\w+)`", text, re.MULTILINE) == list(examples.get_examples())


def test_command(monkeypatch, capsys):
    monkeypatch.setattr("sys.argv", ["examples"])
    assert examples.main() == 0
    listed = capsys.readouterr().out
    assert all(name in listed for name in SMALL)
    monkeypatch.setattr("sys.argv", ["examples", "ball_up"])
    assert examples.main() == 2
    assert capsys.readouterr().err.startswith("warpmag: 'ball_up': no such example, there are arm, balls_up, ")


FAULTS = {
    "'a\\nb': no such example, there are ": ("a\nb",),
    "device: no 'cuda:9' here; available: ": ("sorter", "--headless", "--device", "cuda:9"),
    "worlds: the check failed: ": ("worlds", "--headless", "--num-frames", "0", "--describe"),
}


@pytest.mark.parametrize("line", FAULTS)
def test_faults_are_one_line(line, monkeypatch, capsys):
    monkeypatch.setattr("sys.argv", ["examples", *FAULTS[line]])
    assert examples.main() == (1 if "check" in line else 2)
    (message,) = capsys.readouterr().err.splitlines()
    assert message.startswith(f"warpmag: {line}")


def test_a_full_standard_output_is_one_line():
    with open("/dev/full", "w") as full:
        command = [sys.executable, "-m", "warpmag.examples"]
        done = subprocess.run(command, stdout=full, stderr=subprocess.PIPE, text=True)
    assert (done.returncode, done.stderr) == (1, "warpmag: [Errno 28] No space left on device\n")


def test_a_viewer_that_cannot_open_is_one_line(monkeypatch, capsys):
    def fail(**_):
        raise RuntimeError("no display\nhere")

    monkeypatch.setattr(newton.viewer, "ViewerGL", fail)
    monkeypatch.setattr("sys.argv", ["examples", "worlds"])
    assert examples.main() == 2
    (line,) = capsys.readouterr().err.strip().splitlines()
    assert line == "warpmag: viewer: gl cannot open, it needs a display; viser and rerun need none: no display"


def test_an_example_without_its_solver_is_one_line():
    """In a process of its own, where Warp starts: what it says of a missing GPU is no second line."""
    hide = "import sys; sys.modules |= {'mujoco': None, 'mujoco_warp': None}; sys.argv[1:] = ['arm', '--headless']"
    code = f"{hide}; from warpmag.examples import main; sys.exit(main())"
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True)
    (line,) = done.stderr.splitlines()
    assert (done.returncode, done.stdout) == (2, "")
    assert line.startswith(f"warpmag: arm needs {extra('sim')}: ")
