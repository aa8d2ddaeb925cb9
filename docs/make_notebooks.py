"""Makes the notebooks of ``docs/notebooks/`` from the pages of ``docs/tutorials/``: ``python docs/make_notebooks.py``.

Blocks of Python become cells of code, commands cells that start with ``!``, and stages cells that write their files.
The notebooks hold no outputs. A test compares them with the pages, and another runs the code of the pages.
"""

import json
import re
from pathlib import Path

DOCS = Path(__file__).parent
PAGES = sorted((DOCS / "tutorials").glob("*.md"))
_BLOCK = re.compile(
    r"^(```(?:python)?\n.*?^```|<!-- python\n.*?^-->)\n", re.MULTILINE | re.DOTALL
)
_STAGE = re.compile(r"#usda 1\.0\n# (\S+)\n")


def notebook(page: Path) -> str:
    """Return the notebook of a page, as JSON."""
    cells = []
    for part in _BLOCK.split(page.read_text(encoding="utf-8")):
        if part.startswith("<!--") or not part.strip():
            continue
        code = part.startswith("```")
        text = _code(part) if code else part.strip()
        cell = {
            "cell_type": "code" if code else "markdown",
            "id": f"cell-{len(cells)}",
            "metadata": {},
        }
        cell["source"] = text.splitlines(keepends=True)
        cells.append(cell | ({"execution_count": None, "outputs": []} if code else {}))
    kernel = {"display_name": "Python 3", "language": "python", "name": "python3"}
    metadata = {"kernelspec": kernel, "language_info": {"name": "python"}}
    return (
        json.dumps(
            {"cells": cells, "metadata": metadata, "nbformat": 4, "nbformat_minor": 5},
            indent=1,
        )
        + "\n"
    )


def _code(block: str) -> str:
    """Return the source of the cell of a block."""
    kind, _, text = block.removesuffix("```").rstrip().partition("\n")
    if kind == "```python":
        return text
    if stage := _STAGE.match(text):
        return f"%%writefile {stage[1]}\n{text}"
    # notebooks start in their own folder
    return "\n".join(
        f"!{line}".replace("!cp docs/", "!cp ../") for line in text.splitlines()
    )


def main() -> None:
    """Write all notebooks."""
    for page in PAGES:
        (DOCS / "notebooks" / f"{page.stem}.ipynb").write_text(
            notebook(page), encoding="utf-8"
        )


if __name__ == "__main__":
    main()
