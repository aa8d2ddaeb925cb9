"""Settings of Sphinx: ``uv run --extra docs sphinx-build -n -W docs build/docs``. Pages are MyST Markdown."""

import os
import re
from functools import partial
from itertools import pairwise
from pathlib import Path

from docutils import nodes
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
    "sphinx_design",  # cards
    "sphinx-mathjax-offline",  # formulas without a network
]
exclude_patterns = ["paper/*"]
html_theme = "furo"
html_title = f"warpmag {release}"
html_static_path, html_css_files = ["static"], ["page.css"]
html_favicon = "static/icon.svg"

myst_enable_extensions = ["colon_fence", "dollarmath"]
myst_heading_anchors = 3

autodoc_member_order = "bysource"
autodoc_mock_imports = ["isaaclab", "isaaclab_newton", "torch"]
autodoc_typehints = "none"  # docstrings state shapes and units, which types do not
maximum_signature_line_length = 90
autodoc_preserve_defaults = True
napoleon_use_ivar = True
# no links to other projects' pages, nor to names that are not public
nitpick_ignore_regex = [("py:mod", ".*"), ("py:.*", r"(?!warpmag\.[A-Za-z_]+$).*")]


def _schemas() -> str:
    """Return tables of the attributes of all schemas."""
    layer = Sdf.Layer.FindOrOpen(
        str(ROOT / "warpmag" / "usd" / "schema" / "generatedSchema.usda")
    )
    return "\n".join(_schema(prim) for prim in layer.rootPrims)


def _schema(prim) -> str:
    lines = [f"## {prim.name}", "", _one_line(prim.documentation), ""]
    lines += ["| attribute | type | default | meaning |", "|---|---|---|---|"]
    for attribute in prim.properties:
        kind = f"{'uniform ' * (attribute.variability == Sdf.VariabilityUniform)}{attribute.typeName}"
        allowed = ", ".join(f"`{token}`" for token in attribute.allowedTokens or ())
        tokens = f" One of {allowed}." if allowed else ""
        default = attribute.default
        if isinstance(default, float):
            default = float(f"{default:.7g}")  # USD stores 32 bits
        default = "" if default in (None, "") else f"`{default}`"
        lines.append(
            f"| `{attribute.name}` | {kind} | {default} | {_one_line(attribute.documentation)}{tokens} |"
        )
    return "\n".join([*lines, ""])


def _one_line(text: str) -> str:
    """Return the documentation of a schema in one line of Markdown."""
    return (
        " ".join(text.split())
        .replace("Range: ", "<br>Range: ")
        .replace(" Units: ", "<br>Units: ")
    )


def _commands() -> str:
    """Return the help of the command and of each subcommand."""
    os.environ["COLUMNS"] = "84"
    parser = cli._parser()
    (commands,) = (action.choices for action in parser._subparsers._group_actions)
    parsers = {
        "warpmag": parser,
        **{f"warpmag {name}": command for name, command in commands.items()},
    }
    return "\n".join(
        f"## {name}\n\n```text\n{command.format_help()}```\n"
        for name, command in parsers.items()
    )


def _arrows(flowchart: re.Match) -> str:
    """Return a table of the arrows in a Mermaid flowchart, which Sphinx does not draw."""
    node, nodes, targets = r'(\w+)(?:\["<b>(.+?)</b><br>(.+)"\])?', {}, {}
    for line in flowchart[1].splitlines()[1:]:
        names = []
        for part in line.split("-->"):
            name, title, subject = re.fullmatch(node, part.strip()).groups()
            if title:
                nodes[name] = title, subject.replace("<br>", " ")
            names.append(name)
        for first, second in pairwise(names):
            targets.setdefault(first, []).append(second)
    rows = (
        f"| `{title}` | {subject} | "
        + ", ".join(f"`{nodes[target][0]}`" for target in targets.get(name, []))
        + " |\n"
        for name, (title, subject) in nodes.items()
    )
    return "| room | subject | arrows to |\n|---|---|---|\n" + "".join(rows)


def _file(name: str) -> str:
    """Return the text of a file outside this folder. Links to pages are adapted, other links to files removed."""
    text = (ROOT / name).read_text(encoding="utf-8")
    text = re.sub(r"```mermaid\n(.+?)```\n", _arrows, text, flags=re.DOTALL)
    text = re.sub(r"\[([^]]+)\]\(docs/([\w/]+\.md(?:#[\w-]+)?)\)", r"[\1](\2)", text)
    return re.sub(
        r"\[([^]]+)\]\(([\w.]+)(#[\w-]+)?\)",
        lambda link: (
            f"[{link[1]}]({FILES[link[2]]}{link[3] or ''})"
            if link[2] in FILES
            else link[1]
        ),
        text,
    )


FILES = {
    "ARCHITECTURE.md": "architecture.md",
    "CHANGELOG.md": "changes.md",
    "CONTRIBUTING.md": "contributing.md",
    "SECURITY.md": "security.md",
    "warpmag/examples/README.md": "examples.md",
}
"""Files outside this folder that become pages, and the names of the pages."""
GENERATED = {
    "schemas": _schemas,
    "command": _commands,
    **{name: partial(_file, name) for name in FILES},
}
"""Generated texts by name: ``<!-- name -->`` in a page is replaced by the text."""


def _fill_in(app, page, source):
    names = "|".join(map(re.escape, GENERATED))
    source[0] = re.sub(
        rf"^<!-- ({names}) -->$",
        lambda marker: GENERATED[marker[1]](),
        source[0],
        flags=re.MULTILINE,
    )


FIGURE = re.compile(r"(\d+e-\d+|\d+ (?:%|[mµ]?[msTNJA]|[kM]?Hz|A/m|G?B)(?!\w))")
"""A number with an exponent or a unit."""


def _keep_figures_in_a_line(app, page, *_):
    """Mark figures of a page, so that ``static/page.css`` forbids a line break before a unit or in an exponent."""
    for text in list(page.findall(nodes.Text)):
        if isinstance(
            text.parent, (nodes.literal, nodes.literal_block, nodes.math)
        ) or not FIGURE.search(text):
            continue
        parts = enumerate(FIGURE.split(text))
        marked = [
            nodes.inline("", part, classes=["figure"]) if k % 2 else nodes.Text(part)
            for k, part in parts
            if part
        ]
        text.parent.replace(text, marked)


CODE = re.compile(r'<table.*?</table>|(?<=<span class="pre">)[^<]{29,}', re.DOTALL)
CODE_IN_TABLE = re.compile(r'(?<=<span class="pre">)[^<]{13,}')
"""Words of code in HTML that are too long for a line or a column on a phone."""
PARTS = re.compile(
    r"(?<=[A-Za-z)\]][_:/=])(?=\w\w|&)|(?<=[A-Za-z)\]]\.)(?=\w{4})|(?<=[a-z])(?=[A-Z])"
)
"""Places in a name, a path or an assignment where a line may end."""


def _break_codes(app, page, template, context, doctree):
    """Let long words of code continue on the next line at their parts. ``static/page.css`` forbids other breaks."""

    def broken(code):
        if code[0].startswith("<table"):
            return CODE_IN_TABLE.sub(lambda word: PARTS.sub("<wbr>", word[0]), code[0])
        return PARTS.sub("<wbr>", code[0])

    context["body"] = CODE.sub(broken, context.get("body", ""))


def setup(app):
    """Register the replacement of comments and the marks of figures and codes. Sphinx calls this function."""
    app.connect("source-read", _fill_in)
    app.connect("doctree-resolved", _keep_figures_in_a_line)
    app.connect("html-page-context", _break_codes)
