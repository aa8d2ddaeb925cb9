"""Every block of the pages runs in a test, or has a reason for which it does not: commands, excerpts, fragments."""

import doctest
import re
import shlex
import shutil
from pathlib import Path

import pytest
from pxr import Sdf
from test_docs import COMMAND, DOCS, FILE, PAGES, ROOT, SNIPPET, program

import warpmag
from warpmag.cli import main

BLOCK = re.compile(r"^```([\w{}-]*)\n(.*?)^```$", re.MULTILINE | re.DOTALL)
FRAGMENT = re.compile(r"^def \w+ \"")
"""A prim of a stage."""
COLUMNS = 88
"""Columns of a block that a page shows without scrolling, at 1,400 pixels."""
RUN = ("README.md", "docs/command.md", "docs/howto/stages.md", "docs/tutorials/blender.md")
"""Pages whose commands run as they stand."""
LEFT_OUT = {
    r"(pip install|uv venv|python3 -m venv|export) ": "changes the environment; test_packaging installs the wheel",
    r"(pip install uv && )?uv run warpmag run": "the same without uv is on README",
    r"pip install uv && uv run --extra test pytest": "the tests themselves",
    r"cp docs/tutorials/desk.usdc": "the tests copy this file",
    r"mpirun ": "needs Open MPI; test_ranks runs programs in two processes",
    r"python -m warpmag.examples ": "test_examples runs every example",
    r"python -c .*render_final|warpmag render .*--quality final": "needs Blender; test_export runs a stand-in for it",
    r"warpmag run (alphabets|balls_up|crystal_balls|falling_magnet|sakura_tree)": "test_scenes_bundled runs each scene",
    r"warpmag run million": "needs a GPU; test_many runs it with fewer balls",
}
"""Commands that do not run as they stand, as patterns of their beginnings, and the reasons."""
EXCERPTS = {"docs/howto/isaaclab.md": "an outline of the task of isaaclab_task.md, which .ci/isaaclab runs"}
"""Pages with a block of Python that is an excerpt."""
BEYOND = {"docs/howto/isaaclab_task.md", "docs/howto/learning.md"}
"""Pages whose Python needs Isaac Lab or PyTorch; ``.ci/isaaclab`` runs all of it."""


def name_of(page: Path) -> str:
    return page.relative_to(ROOT).as_posix()


def blocks(page: Path):
    """Return the language and the text of each block, without directives of Sphinx."""
    return [block for block in BLOCK.findall(page.read_text(encoding="utf-8")) if not block[0].startswith("{")]


def commands(page: Path) -> list[str]:
    """Return the lines of the blocks of commands of a page."""
    plain = [text.replace("\\\n", "") for language, text in blocks(page) if not language]
    return [
        line
        for text in plain
        if not (text.startswith("#usda") or FRAGMENT.match(text))
        for line in text.splitlines()
        if line
    ]


@pytest.mark.parametrize("page", [page for page in PAGES if blocks(page)], ids=name_of)
def test_no_block_is_left_out_without_a_reason(page):
    name = name_of(page)
    for language, text in blocks(page):
        whole_file = FILE.match(f"```{language}\n{text}```")
        assert language in ("", "python", "pycon") or whole_file or name in EXCERPTS, text
    left_out = set() if name in RUN else set(commands(page))
    left_out |= {line for line in commands(page) if not COMMAND.match(line)}
    for line in left_out:
        assert any(re.match(pattern, line) for pattern in LEFT_OUT), line
    snippets, run = SNIPPET.findall(page.read_text(encoding="utf-8")), program(page)
    assert name in BEYOND or all(snippet.strip() in run for snippet in snippets)


@pytest.mark.parametrize("page", [page for page in PAGES if blocks(page)], ids=name_of)
def test_lines_of_code_fit_the_page(page):
    lines = [line for _, text in blocks(page) for line in text.splitlines()]
    assert [line for line in lines if len(line) > COLUMNS] == []


def test_reasons_are_needed():
    lines = [line for page in PAGES for line in commands(page)]
    for pattern in LEFT_OUT:
        assert any(re.match(pattern, line) for line in lines), pattern


@pytest.mark.long
@pytest.mark.parametrize("name", RUN)
def test_commands_run(name, tmp_path, monkeypatch, capsys):
    """One after the other, in a folder with the files of all pages."""
    monkeypatch.chdir(tmp_path)
    shutil.copy(DOCS / "tutorials" / "desk.usdc", tmp_path)
    for page in PAGES:
        for file in FILE.finditer(page.read_text(encoding="utf-8")):
            (tmp_path / file[2]).write_text(file[1], encoding="utf-8")
    lines = [line for line in commands(ROOT / name) if COMMAND.match(line)]
    assert lines
    for line in lines:
        assert main(shlex.split(line)[1:]) == 0, f"{line}\n{capsys.readouterr().err}"


@pytest.mark.parametrize("text", [text for page in PAGES for language, text in blocks(page) if language == "pycon"])
def test_dialogs_run(text):
    source = "".join(example.source for example in doctest.DocTestParser().get_examples(text))
    pytest.importorskip(re.match(r"import (\w+)", source)[1], reason="needs an extra of warpmag")
    exec(source, {"warpmag": warpmag})


def test_fragments_of_stages_are_read():
    """Their attributes are those of the schemas, with the same types."""
    schemas = Sdf.Layer.FindOrOpen(str(ROOT / "warpmag" / "usd" / "schema" / "generatedSchema.usda"))
    types = {attribute.name: attribute.typeName for prim in schemas.rootPrims for attribute in prim.attributes}
    fragments = [text for page in PAGES for language, text in blocks(page) if FRAGMENT.match(text)]
    assert len(fragments) >= 2
    for fragment in fragments:
        layer = Sdf.Layer.CreateAnonymous(".usda")
        assert layer.ImportFromString(f"#usda 1.0\n{fragment}")
        for attribute in layer.rootPrims[0].attributes:
            if attribute.name.startswith("warpmag:"):
                assert attribute.typeName == types[attribute.name], attribute.path
