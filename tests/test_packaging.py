"""What is installed: the source distribution has all that its tests need, the wheel that is made of it holds every
module and data file, and works with what it asks for and nothing else."""

import email
import math
import os
import re
import shutil
import subprocess
import sys
import tarfile
import zipfile
from importlib import metadata
from pathlib import Path

import pytest
from pxr import Usd

import warpmag
from warpmag.scenes_usd import balls_up

ROOT = Path(__file__).resolve().parents[1]
FOLDERS = {"warpmag": "warpmag", "kernels": "warpmag/kernels", "scenes_usd": "warpmag/scenes_usd"}
BESIDE = (".ci", "bench", "docs", "tests")
"""Folders of a source distribution that are not installed."""
FILES = (
    *("ARCHITECTURE.md", "CHANGELOG.md", "CITATION.cff", "CONTRIBUTING.md", "LICENSE", "README.md", "SECURITY.md"),
    *(".clang-format", "MANIFEST.in", "pyproject.toml"),
)
PYTHONS = ("3.11", "3.12", "3.13")


def run(command, cwd, **environment):
    timeout = 1800  # ends what hangs; kernels compile for minutes where other work shares the cores
    environment = os.environ | environment
    return subprocess.run(command, cwd=cwd, env=environment, capture_output=True, text=True, timeout=timeout)


def printed(command, cwd, **environment):
    result = run(command, cwd, **environment)
    assert result.returncode == 0, result.stdout + result.stderr
    return result.stdout.splitlines()


@pytest.fixture(scope="module")
def distribution(tmp_path_factory):
    """The source distribution of this checkout, built from a copy, without network, and unpacked."""
    source, built = (tmp_path_factory.mktemp(name) for name in ("source", "built"))
    for folder in (*FOLDERS, *BESIDE):
        shutil.copytree(ROOT / folder, source / folder, ignore=shutil.ignore_patterns("__pycache__"))
    for name in FILES:
        shutil.copy(ROOT / name, source)
    code = f"from setuptools import build_meta; build_meta.build_sdist({str(built)!r})"
    printed([sys.executable, "-c", code], source)
    (path,) = built.glob(f"warpmag-{warpmag.__version__}.tar.gz")
    with tarfile.open(path) as opened:
        opened.extractall(built, filter="data")
    return built / f"warpmag-{warpmag.__version__}"


@pytest.fixture(scope="module")
def archive(distribution, tmp_path_factory):
    """The wheel, built of the source distribution without network."""
    built = tmp_path_factory.mktemp("wheel")
    code = f"from setuptools import build_meta; build_meta.build_wheel({str(built)!r})"
    printed([sys.executable, "-c", code], distribution)
    (path,) = built.glob("*.whl")
    return path


@pytest.fixture(scope="module")
def wheel(archive, tmp_path_factory):
    """The wheel, unpacked."""
    unpacked = tmp_path_factory.mktemp("unpacked")
    with zipfile.ZipFile(archive) as opened:
        opened.extractall(unpacked)
    return unpacked


def uv():
    result = os.environ.get("UV") or shutil.which("uv")
    if result is None:
        pytest.skip("needs uv")
    return result


@pytest.fixture(scope="module")
def environment(archive, tmp_path_factory):
    """A fresh environment with the wheel and what it asks for, in the versions that are here; its ``bin``."""
    folder = tmp_path_factory.mktemp("environment")
    (folder / "versions").write_text(
        "".join(f"{entry.name}=={entry.version}\n" for entry in metadata.distributions() if entry.name != "warpmag")
    )
    printed([uv(), "venv", "--quiet", "--python", sys.executable, "fresh"], folder)
    place = folder / "fresh" / ("Scripts" if os.name == "nt" else "bin")
    asked = ["--python", str(place / "python"), "--constraints", "versions"]
    printed([uv(), "pip", "install", "--quiet", *asked, str(archive)], folder)
    return place


def test_source_distribution_has_all_that_its_tests_need(distribution):
    expected = {
        path.relative_to(ROOT).as_posix()
        for folder in (*FOLDERS, *BESIDE)
        for path in (ROOT / folder).rglob("*")
        if path.is_file() and path.suffix != ".pyc"
    }
    held = {path.relative_to(distribution).as_posix() for path in distribution.rglob("*") if path.is_file()}
    assert {*expected, *FILES} - held == set()


@pytest.mark.long
def test_tests_of_the_source_distribution_run(environment, distribution, tmp_path):
    """Where it is unpacked, of the packages that are there; what these ask for is installed."""
    tools = tmp_path / "tools"
    printed([uv(), "pip", "install", "--quiet", "--target", tools, "pytest", "hypothesis"], tmp_path)
    files = [f"tests/test_{name}.py" for name in ("oracle", "structure", "usd_schemas")]
    command = [environment / "python", "-m", "pytest", "-q", "-p", "no:cacheprovider", *files]
    lines = printed(command, distribution, PYTHONPATH=str(tools))
    code = "import warpmag.kernels, warpmag.scenes_usd; print(warpmag.kernels.__file__)"
    assert Path(*printed([environment / "python", "-c", code], distribution)).is_relative_to(distribution)
    assert " passed" in lines[-1] and "skipped" not in lines[-1]


def test_wheel_holds_every_module_and_data_file(wheel):
    expected = {
        f"{installed}/{path.relative_to(ROOT / folder).as_posix()}"
        for folder, installed in FOLDERS.items()
        for path in (ROOT / folder).rglob("*")
        if path.suffix in (".py", ".pyi", ".typed", ".h", ".npy", ".usd", ".usda", ".usdc", ".json")
    }
    assert {
        "warpmag/__init__.pyi",
        "warpmag/py.typed",
        "warpmag/kernels/__init__.py",
        "warpmag/kernels/pairs/pair_law.h",
        "warpmag/scenes_usd/balls_up.usdc",
        "warpmag/usd/schema/generatedSchema.usda",
        "warpmag/usd/schema/plugInfo.json",
    } <= expected
    assert ".npy" in {Path(name).suffix for name in expected}
    held = {path.relative_to(wheel).as_posix() for path in wheel.rglob("*") if path.is_file()}
    assert expected - held == set()


def test_wheel_installs_the_command_and_nothing_at_top_level(wheel):
    (info,) = wheel.glob("*.dist-info")
    assert {path.name for path in wheel.iterdir()} == {"warpmag", info.name}
    assert "warpmag = warpmag.cli:main" in (info / "entry_points.txt").read_text()


def test_metadata(wheel):
    (info,) = wheel.glob("*.dist-info")
    metadata_of_wheel = email.message_from_string((info / "METADATA").read_text())
    assert metadata_of_wheel["Version"] == warpmag.__version__ == metadata.version("warpmag")
    assert metadata_of_wheel["License-Expression"] == "Apache-2.0"
    assert metadata_of_wheel["Author"] == "warpmag contributors"
    assert "Project-URL" not in metadata_of_wheel
    assert {f"Programming Language :: Python :: {python}" for python in PYTHONS} <= set(
        metadata_of_wheel.get_all("Classifier")
    )
    assert (info / "licenses" / "LICENSE").read_text() == (ROOT / "LICENSE").read_text()


def test_one_version_everywhere():
    assert re.search(r"^version: (.*)$", (ROOT / "CITATION.cff").read_text(), re.MULTILINE)[1] == warpmag.__version__
    assert re.search(r"^## ([\d.]+)", (ROOT / "CHANGELOG.md").read_text(), re.MULTILINE)[1] == warpmag.__version__


def test_every_public_name_is_there():
    assert set(dir(warpmag)) == {*warpmag.__all__, "__version__"}
    for name in warpmag.__all__:
        assert getattr(warpmag, name).__module__.startswith("warpmag.")
    assert warpmag.register_attributes is warpmag.register_custom_attributes


@pytest.mark.long
def test_a_checker_of_types_sees_through_lazy_imports(environment, tmp_path):
    """From the wheel, as a user's does: ``tests/typed_use.py`` has the types, the second file mistakes."""
    pytest.importorskip("pyright")
    shutil.copy(ROOT / "tests" / "typed_use.py", tmp_path)
    (tmp_path / "mistakes.py").write_text("import warpmag\n\nwarpmag.Simulaton\nwarpmag.Simulation('a', stp=1.0)\n")
    checked = run([sys.executable, "-m", "pyright", "--pythonpath", environment / "python", "."], tmp_path)
    errors = [line.split(":")[1] for line in checked.stdout.splitlines() if " error: " in line]
    assert errors == ["3", "4"], checked.stdout


@pytest.mark.long
@pytest.mark.parametrize("version", PYTHONS)
def test_wheel_works_on_each_python(version, archive, tmp_path):
    if run([uv(), "venv", "-q", "--no-python-downloads", "--python", version, "fresh"], tmp_path).returncode:
        pytest.skip(f"no Python {version} here")
    place = tmp_path / "fresh" / "bin"
    printed([uv(), "pip", "install", "--quiet", "--python", place / "python", archive], tmp_path)
    balls_up.author(tmp_path / "small.usda", columns=2, rows=2, layers=1)
    lines = printed([place / "warpmag", "run", "small.usda", "--frames", "1", "--device", "cpu"], tmp_path)
    assert lines[0].split() == ["magnets", "4", "moving"]


def test_import_is_light_and_comes_from_the_wheel(environment, tmp_path):
    code = "import sys, warpmag; print(warpmag.__file__); print({'newton', 'pxr', 'warp'} & set(sys.modules))"
    file, imported = printed([environment / "python", "-c", code], tmp_path)
    assert Path(file).is_relative_to(environment.parent)
    assert imported == "set()"


def test_kernels_compile_from_the_wheel(environment, tmp_path):
    """Where nothing was compiled before, with headers that lie beside the installed package."""
    code = """
import warp
import warpmag.kernels
warp.config.log_level = warp.LOG_WARNING
print(warpmag.kernels.__file__)
print(*warpmag.h_field([[0.0, 0, 0], [0, 0, 1], [0, 0, 3]], [[0.0, 0, 1]] * 3, device="cpu")[:, 2])
"""
    file, field = printed([environment / "python", "-c", code], tmp_path, WARP_CACHE_PATH=str(tmp_path))
    assert Path(file).is_relative_to(environment.parent)
    pairs = [2 * (1 + 1 / 27), 2 * (1 + 1 / 8), 2 * (1 / 27 + 1 / 8)]
    assert [4 * math.pi * float(h) for h in field.split()] == pytest.approx(pairs, rel=1e-6)


def test_the_command_runs_from_the_wheel(environment, tmp_path):
    command = environment / "warpmag"
    names = [line.split()[0] for line in printed([command, "scenes"], tmp_path)]
    assert names == sorted([*(path.stem for path in (ROOT / "scenes_usd").glob("*.usdc")), "million"])
    balls_up.author(tmp_path / "small.usda", columns=2, rows=2, layers=1)
    lines = printed([command, "run", "small.usda", "--frames", "1", "--device", "cpu", "-o", "out.usda"], tmp_path)
    assert lines[0].split() == ["magnets", "4", "moving"]
    stage = Usd.Stage.Open(str(tmp_path / "out.usda"))
    assert stage.GetPrimAtPath("/World/Balls/Ball_0000").GetAttribute("warpmag:moment").Get(1.0)[2] > 0.0


def test_kernels_are_refused_under_another_name():
    result = run([sys.executable, "-c", "import kernels"], ROOT)
    assert result.returncode != 0
    assert result.stderr.splitlines()[-1].startswith("ImportError: import this package as 'warpmag.kernels'")
