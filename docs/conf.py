"""Sphinx reads this: ``uv run --extra docs sphinx-build -n -W docs build/docs``; pages are MyST Markdown."""

import os
import re
from functools import partial
from pathlib import Path

from pxr import Sdf

import warpmag.usd  # noqa: F401 - registers schemas before USD is used
from warpmag import __version__, cli

ROOT = Path(__file__).resolve().parents[1]

project, author = "warpmag", "warpmag contributors"
copyright = "warpmag contributors, Apache-2.0"
version = release = __version__
extensions = [
    "myst_parser",
    "sphinx.ext.autodoc",
    "sphinx.ext.napoleon",
    "sphinx.ext.mathjax",
    "sphinx-mathjax-offline",  # formulas without a network
]
exclude_patterns = ["paper/*"]
html_theme = "furo"
html_title = f"warpmag {release}"

myst_enable_extensions = ["dollarmath"]
myst_heading_anchors = 3

autodoc_member_order = "bysource"
autodoc_typehints = "none"  # docstrings say shapes and units, which types do not
maximum_signature_line_length = 90
autodoc_preserve_defaults = True
napoleon_use_ivar = True
napoleon_custom_sections = ["Warns"]
# Warp's, Newton's, NumPy's and USD's own pages are not asked for, and what is not public has none
nitpick_ignore_regex = [("py:mod", ".*"), ("py:.*", r"(?!warpmag\.[A-Za-z_]+$).*")]


def _schemas() -> str:
    """Tables of the attributes of all schemas, from their text."""
    layer = Sdf.Layer.FindOrOpen(str(ROOT / "warpmag" / "usd" / "schema" / "generatedSchema.usda"))
    return "\n".join(_schema(prim) for prim in layer.rootPrims)


def _schema(prim) -> str:
    lines = [f"## {prim.name}", "", _plain(prim.documentation), ""]
    lines += ["| attribute | type | default | meaning |", "|---|---|---|---|"]
    for one in prim.properties:
        kind = f"{'uniform ' * (one.variability == Sdf.VariabilityUniform)}{one.typeName}"
        tokens = f" One of {', '.join(f'`{token}`' for token in one.allowedTokens)}." if one.allowedTokens else ""
        default = "" if one.default in (None, "") else f"`{one.default}`"
        lines.append(f"| `{one.name}` | {kind} | {default} | {_plain(one.documentation)}{tokens} |")
    return "\n".join([*lines, ""])


def _plain(text: str) -> str:
    """Documentation of a schema in one line."""
    return " ".join(text.split()).replace("Range: ", "<br>Range: ").replace(" Units: ", "<br>Units: ")


def _commands() -> str:
    """Help of the command and of each of its commands."""
    os.environ["COLUMNS"] = "84"
    parser = cli._parser()
    (commands,) = (one.choices for one in parser._subparsers._group_actions)
    texts = {"warpmag": parser, **{f"warpmag {name}": one for name, one in commands.items()}}
    return "\n".join(f"## {name}\n\n```text\n{one.format_help()}```\n" for name, one in texts.items())


def _file(name: str) -> str:
    """A file beside this folder; its links go to pages, or to nothing where there is none."""
    text = (ROOT / name).read_text(encoding="utf-8").replace("```mermaid", "```text")
    text = re.sub(r"\[([^]]+)\]\(docs/([\w/]+\.md)\)", r"[\1](\2)", text)
    return re.sub(
        r"\[([^]]+)\]\(([\w.]+)\)", lambda link: f"[{link[1]}]({FILES[link[2]]})" if link[2] in FILES else link[1], text
    )


FILES = {
    "ARCHITECTURE.md": "architecture.md",
    "CHANGELOG.md": "changes.md",
    "CONTRIBUTING.md": "contributing.md",
    "SECURITY.md": "security.md",
    "warpmag/examples/README.md": "examples.md",
}
"""Files beside this folder that are pages, too."""
GENERATED = {"schemas": _schemas, "command": _commands, **{name: partial(_file, name) for name in FILES}}
"""What stands in a page, as a comment, for text that is made where the page is."""


def _fill_in(app, page, source):
    source[0] = re.sub(r"^<!-- (\S+) -->$", lambda marker: GENERATED[marker[1]](), source[0], flags=re.MULTILINE)


def setup(app):
    """Sphinx calls this."""
    app.connect("source-read", _fill_in)
