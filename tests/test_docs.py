"""The documents: their Python runs, what they say of schemas and commands is so, and every public name is described."""

import doctest
import importlib.util
import re
import runpy
import shlex
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest
import warp as wp
from pxr import Sdf

import warpmag
from warpmag import cli

ROOT = Path(__file__).resolve().parents[1]
DOCS = ROOT / "docs"
PAGES = [ROOT / "README.md", *sorted(page for page in DOCS.rglob("*.md") if "paper" not in page.parts)]
SNIPPET = re.compile(r"^(?:```python|<!-- python)\n(.*?)^(?:```|-->)$", re.MULTILINE | re.DOTALL)
"""A block of Python; in a comment it is what a page leaves to its reader, such as the model that it speaks of."""
IMPORT = re.compile(r"^(?:import|from) (\w+)", re.MULTILINE)
MISSING = {name for name in ("torch", "isaaclab") if importlib.util.find_spec(name) is None}
"""Libraries of some pages that the tests do not install; ``.ci/isaaclab`` runs these pages with them."""
FILE = re.compile(r"^```(?:xml)?\n((?:#usda 1\.0\n# |<!-- )(\S+).*?)^```$", re.MULTILINE | re.DOTALL)
"""A whole stage or MJCF and the file to save it as."""
COMMAND = re.compile(r"^(?:pip install uv && uv run )?(warpmag .*)$", re.MULTILINE)
SLOW = (
    "physics.md",
    *(f"physics/{name}.md" for name in ("equilibrium", "uniqueness", "forces", "bodies", "near_bodies", "coils")),
    *(f"physics/{name}.md" for name in ("curves", "eddy")),
    *(f"howto/{name}.md" for name in ("coils", "design", "energy", "gradients", "holding", "holding_solvers")),
    *(f"howto/{name}.md" for name in ("material", "mujoco", "newton", "simulation", "switch", "voltages", "workload")),
    *(f"tutorials/{name}.md" for name in ("blender", "coils", "robot")),
)
"""Pages that take long, most of them to compile kernels that no other test needs; ``.ci/run`` runs them, too."""

WITH_EXAMPLE = {
    *("h_field", "wrench", "solve_induction", "sweep", "material", "MagnetizationCurve", "register_custom_attributes"),
    *("add_inducible", "add_permanent", "add_balls", "add_coil", "add_field_map", "Magnetics", "Simulation", "check"),
    *("SensorMagnetometer", "render", "export", "Display", "KeyedCurrents"),
}
"""Public names whose docstring has an example that runs. Others are results, errors and an old name."""


def program(page: Path) -> str:
    """Return the Python of a page, each line at its place, up to a block that imports a library not installed here."""
    text, lines = page.read_text(encoding="utf-8"), []
    for snippet in SNIPPET.finditer(text):
        if any(library in MISSING for library in IMPORT.findall(snippet[1])):
            break
        lines += [""] * (text.count("\n", 0, snippet.start(1)) - len(lines))
        lines += snippet[1].splitlines()
    return "\n".join(lines)


def pages_with_programs():
    results = []
    for page in PAGES:
        if program(page):
            name = page.relative_to(DOCS if page.is_relative_to(DOCS) else ROOT).as_posix()
            results.append(pytest.param(page, id=name, marks=[pytest.mark.long] if name in SLOW else []))
    return results


@pytest.mark.parametrize("page", pages_with_programs())
def test_snippets_run(page, device, tmp_path, monkeypatch):
    """One after the other, as a reader would type them; they assert what they claim."""
    monkeypatch.chdir(tmp_path)
    for file in FILE.finditer(page.read_text(encoding="utf-8")):
        (tmp_path / file[2]).write_text(file[1], encoding="utf-8")
    path = tmp_path / f"page_{page.stem}.py"
    path.write_text(program(page), encoding="utf-8")
    with wp.ScopedDevice(device), np.errstate(over="ignore"):
        runpy.run_path(str(path))


@pytest.mark.parametrize("page", [page for page in PAGES if COMMAND.search(page.read_text(encoding="utf-8"))], ids=str)
def test_commands_are_understood(page):
    for command in COMMAND.finditer(page.read_text(encoding="utf-8")):
        cli._parser().parse_args(shlex.split(command[1])[1:])


@pytest.mark.parametrize("page", sorted((DOCS / "tutorials").glob("*.md")), ids=lambda page: page.stem)
def test_notebooks_follow_their_pages(page):
    """``docs/make_notebooks.py`` makes them; ``test_snippets_run`` runs their code."""
    made = runpy.run_path(str(DOCS / "make_notebooks.py"))["notebook"](page)
    assert (DOCS / "notebooks" / f"{page.stem}.ipynb").read_text(encoding="utf-8") == made


def test_every_public_name_is_described():
    text = "".join(page.read_text(encoding="utf-8") for page in (DOCS / "api").glob("*.md"))
    described = re.findall(r"^\.\. auto\w+:: warpmag\.(\w+)$", text, re.MULTILINE)
    assert {*described, "register_attributes"} >= set(warpmag.__all__)


def test_examples_of_public_docstrings_run(tmp_path, monkeypatch):
    """Examples of functions, classes and their methods; ``lift.usda`` is the stage of the page on stages."""
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr(wp.config, "log_level", wp.LOG_WARNING)  # no lines of modules among the results
    text = (DOCS / "howto" / "stages.md").read_text(encoding="utf-8")
    (tmp_path / "lift.usda").write_text(next(FILE.finditer(text))[1], encoding="utf-8")
    finder, runner, run = doctest.DocTestFinder(), doctest.DocTestRunner(), set()
    with wp.ScopedDevice("cpu"):
        for name in warpmag.__all__:
            for example in finder.find(getattr(warpmag, name), name, module=False, globs={}):
                if example.examples:
                    assert runner.run(example).failed == 0, f"{example.name}: see the output above"
                    run.add(example.name.partition(".")[0])
    assert run >= WITH_EXAMPLE


@pytest.mark.long
def test_pages_build_without_a_warning(tmp_path):
    """Schemas, commands and docstrings are read anew, so that pages cannot go stale."""
    pytest.importorskip("sphinx", reason="the pages need the extra docs")
    build = [sys.executable, "-m", "sphinx", "-q", "-n", "-W", "--keep-going", DOCS, tmp_path]
    built = subprocess.run(build, capture_output=True, text=True, timeout=600)
    assert built.returncode == 0, built.stderr
    page = (tmp_path / "usd.html").read_text(encoding="utf-8").replace("<wbr>", "")  # possible breaks in names
    layer = Sdf.Layer.FindOrOpen(str(ROOT / "warpmag" / "usd" / "schema" / "generatedSchema.usda"))
    attributes = {entry.name for prim in layer.rootPrims for entry in prim.properties}
    assert "warpmag:kind" in attributes
    assert {name for name in attributes if name not in page} == set()
