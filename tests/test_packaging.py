"""What is installed: the wheel holds every module and data file, and importing warpmag stays light."""

import math
import os
import shutil
import subprocess
import sys
import zipfile
from pathlib import Path

import pytest

ROOT = Path(__file__).resolve().parents[1]
FOLDERS = {"warpmag": "warpmag", "kernels": "warpmag/kernels", "scenes_usd": "warpmag/scenes_usd"}


def python(code, cwd, **environment):
    return subprocess.run(
        [sys.executable, "-c", code],
        cwd=cwd,
        env=os.environ | environment,
        capture_output=True,
        text=True,
        timeout=120,
    )


@pytest.fixture(scope="module")
def wheel(tmp_path_factory):
    """The wheel of this checkout, built from a copy, without network, and unpacked."""
    source, built, unpacked = (tmp_path_factory.mktemp(name) for name in ("source", "built", "unpacked"))
    for folder in FOLDERS:
        shutil.copytree(ROOT / folder, source / folder, ignore=shutil.ignore_patterns("__pycache__"))
    for name in ("pyproject.toml", "README.md"):
        shutil.copy(ROOT / name, source)
    result = python(f"from setuptools import build_meta; build_meta.build_wheel({str(built)!r})", source)
    assert result.returncode == 0, result.stderr
    (path,) = built.glob("*.whl")
    with zipfile.ZipFile(path) as archive:
        archive.extractall(unpacked)
    return unpacked


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


def test_import_is_light_and_comes_from_the_wheel(wheel):
    code = "import sys, warpmag; print(warpmag.__file__); print({'newton', 'pxr', 'warp'} & set(sys.modules))"
    result = python(code, wheel)
    assert result.returncode == 0, result.stderr
    assert result.stdout.splitlines() == [str(wheel / "warpmag" / "__init__.py"), "set()"]


def test_kernels_compile_from_the_wheel(wheel, tmp_path):
    """Where nothing was compiled before, with headers that lie beside the installed package."""
    code = """
import warp
import warpmag.kernels
warp.config.log_level = warp.LOG_WARNING
print(warpmag.kernels.__file__)
print(*warpmag.h_field([[0.0, 0, 0], [0, 0, 1], [0, 0, 3]], [[0.0, 0, 1]] * 3, device="cpu")[:, 2])
"""
    result = python(code, wheel, WARP_CACHE_PATH=str(tmp_path))
    assert result.returncode == 0, result.stderr
    file, field = result.stdout.splitlines()
    assert file == str(wheel / "warpmag" / "kernels" / "__init__.py")
    pairs = [2 * (1 + 1 / 27), 2 * (1 + 1 / 8), 2 * (1 / 27 + 1 / 8)]
    assert [4 * math.pi * float(h) for h in field.split()] == pytest.approx(pairs, rel=1e-6)


def test_kernels_are_refused_under_another_name():
    result = python("import kernels", ROOT)
    assert result.returncode != 0
    assert result.stderr.splitlines()[-1].startswith("ImportError: import this package as 'warpmag.kernels'")
