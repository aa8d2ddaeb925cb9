"""The documents: their Python runs, what they say of schemas and commands is so, and every public name is described."""

import re
import runpy
from pathlib import Path

import numpy as np
import pytest
import warp as wp

ROOT = Path(__file__).resolve().parents[1]
DOCS = ROOT / "docs"
PAGES = [ROOT / "README.md", *sorted(page for page in DOCS.rglob("*.md") if "paper" not in page.parts)]
SNIPPET = re.compile(r"^(?:```python|<!-- python)\n(.*?)^(?:```|-->)$", re.MULTILINE | re.DOTALL)
"""A block of Python; in a comment it is what a page leaves to its reader, such as the model that it speaks of."""
SLOW = {"howto/mujoco.md": "MuJoCo's kernels take minutes to compile"}


def program(page: Path) -> str:
    """The Python of a page, each line where it is on the page."""
    text, lines = page.read_text(encoding="utf-8"), []
    for snippet in SNIPPET.finditer(text):
        lines += [""] * (text.count("\n", 0, snippet.start(1)) - len(lines))
        lines += snippet[1].splitlines()
    return "\n".join(lines)


def pages_with_programs():
    found = []
    for page in PAGES:
        if program(page):
            name = page.relative_to(DOCS if page.is_relative_to(DOCS) else ROOT).as_posix()
            found.append(pytest.param(page, id=name, marks=[pytest.mark.long] if name in SLOW else []))
    return found


@pytest.mark.parametrize("page", pages_with_programs())
def test_snippets_run(page, device, tmp_path, monkeypatch):
    """One after the other, as a reader would type them; they assert what they claim."""
    monkeypatch.chdir(tmp_path)
    path = tmp_path / f"page_{page.stem}.py"
    path.write_text(program(page), encoding="utf-8")
    with wp.ScopedDevice(device), np.errstate(over="ignore"):
        runpy.run_path(str(path))
