"""What is installed: the wheel holds every module and data file, and works with what it asks for and nothing else."""

import math
import os
import shutil
import subprocess
import sys
import zipfile
from importlib import metadata
from pathlib import Path

import pytest
from pxr import Usd

from warpmag.scenes_usd import balls_up

ROOT = Path(__file__).resolve().parents[1]
FOLDERS = {"warpmag": "warpmag", "kernels": "warpmag/kernels", "scenes_usd": "warpmag/scenes_usd"}


def run(command, cwd, **environment):
    return subprocess.run(command, cwd=cwd, env=os.environ | environment, capture_output=True, text=True, timeout=300)


def printed(command, cwd, **environment):
    result = run(command, cwd, **environment)
    assert result.returncode == 0, result.stderr
    return result.stdout.splitlines()


@pytest.fixture(scope="module")
def archive(tmp_path_factory):
    """The wheel of this checkout, built from a copy, without network."""
    source, built = (tmp_path_factory.mktemp(name) for name in ("source", "built"))
    for folder in FOLDERS:
        shutil.copytree(ROOT / folder, source / folder, ignore=shutil.ignore_patterns("__pycache__"))
    for name in ("pyproject.toml", "README.md"):
        shutil.copy(ROOT / name, source)
    code = f"from setuptools import build_meta; build_meta.build_wheel({str(built)!r})"
    printed([sys.executable, "-c", code], source)
    (path,) = built.glob("*.whl")
    return path


@pytest.fixture(scope="module")
def wheel(archive, tmp_path_factory):
    """The wheel, unpacked."""
    unpacked = tmp_path_factory.mktemp("unpacked")
    with zipfile.ZipFile(archive) as opened:
        opened.extractall(unpacked)
    return unpacked


@pytest.fixture(scope="module")
def environment(archive, tmp_path_factory):
    """A fresh environment with the wheel and what it asks for, in the versions that are here; its ``bin``."""
    uv = os.environ.get("UV") or shutil.which("uv")
    if uv is None:
        pytest.skip("needs uv")
    folder = tmp_path_factory.mktemp("environment")
    (folder / "versions").write_text(
        "".join(f"{one.name}=={one.version}\n" for one in metadata.distributions() if one.name != "warpmag")
    )
    printed([uv, "venv", "--quiet", "--python", sys.executable, "fresh"], folder)
    place = folder / "fresh" / ("Scripts" if os.name == "nt" else "bin")
    asked = ["--python", str(place / "python"), "--constraints", "versions"]
    printed([uv, "pip", "install", "--quiet", *asked, str(archive)], folder)
    return place


def test_wheel_holds_every_module_and_data_file(wheel):
    expected = {
        f"{installed}/{path.relative_to(ROOT / folder).as_posix()}"
        for folder, installed in FOLDERS.items()
        for path in (ROOT / folder).rglob("*")
        if path.suffix in (".py", ".h", ".npy", ".usd", ".usda", ".usdc", ".json")
    }
    assert {
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
    assert names == sorted(path.stem for path in (ROOT / "scenes_usd").glob("*.usdc"))
    balls_up.author(tmp_path / "small.usda", columns=2, rows=2, layers=1)
    lines = printed([command, "run", "small.usda", "--frames", "1", "--device", "cpu", "-o", "out.usda"], tmp_path)
    assert lines[0].split() == ["magnets", "4", "moving"]
    stage = Usd.Stage.Open(str(tmp_path / "out.usda"))
    assert stage.GetPrimAtPath("/World/Balls/Ball_0000").GetAttribute("warpmag:moment").Get(1.0)[2] > 0.0


def test_kernels_are_refused_under_another_name():
    result = run([sys.executable, "-c", "import kernels"], ROOT)
    assert result.returncode != 0
    assert result.stderr.splitlines()[-1].startswith("ImportError: import this package as 'warpmag.kernels'")
