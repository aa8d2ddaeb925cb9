"""Text of ``schema/generatedSchema.usda``, made from the table of attributes.

``python -m warpmag.usd.schema_text`` writes the file.

The folder's ``plugInfo.json`` names the schemas and the prims that they apply to.
"""

import textwrap
from pathlib import Path
from typing import Any

from warpmag.declarations.attributes import Attribute, Schema
from warpmag.declarations.schemas import SCHEMAS

SCHEMA_FILE = Path(__file__).parent / "schema" / "generatedSchema.usda"
_WIDTH = 120
_INTRODUCTION = (
    "Codeless applied API schemas of warpmag. Lengths are in the unit of the stage, like those of shapes. "
    "Magnetizations, fields, currents and moments are SI in every stage: USD has no unit for a current."
)


def schema_text() -> str:
    """Return the text of all schemas."""
    head = f"#usda 1.0\n(\n    {_quoted(_INTRODUCTION, 4)}\n)\n"
    return "\n".join([head, *map(_schema, SCHEMAS)])


def _schema(schema: Schema) -> str:
    attributes = "".join(map(_attribute, schema.attributes))
    return f'class "{schema.name}" (\n    doc = {_quoted(schema.doc, 4)}\n)\n{{\n{attributes}}}\n'


def _attribute(row: Attribute) -> str:
    declaration = f"{'uniform ' * row.uniform}{row.usd_type} {row.usd_name}"
    lines = [f"{declaration} (" if row.default is None else f"{declaration} = {_value(row)} ("]
    if row.tokens:
        lines.append(f"    allowedTokens = [{', '.join(map(_value_text, row.tokens))}]")
    lines += [f'    displayName = "{row.title}"', f"    doc = {_quoted(row.documentation, 8)}", ")"]
    return "".join(f"    {line}\n" for line in lines)


def _value(row: Attribute) -> str:
    """Return the default of a row as USD writes it."""
    if row.usd_type.endswith("[]"):
        return f"[{', '.join(map(_value_text, row.default))}]"
    return _value_text(row.default)


def _value_text(value: Any) -> str:
    if isinstance(value, tuple):
        return f"({', '.join(map(_value_text, value))})"
    if isinstance(value, bool):
        return str(value).lower()
    return f'"{value}"' if isinstance(value, str) else f"{value:g}".replace("e+0", "e")


def _quoted(text: str, indent: int) -> str:
    """Return a quoted text, over several lines where it does not fit into one."""
    if "\n" not in text and indent + len(text) + 8 <= _WIDTH:
        return f'"{text}"'
    first, *rest = text.split("\n")
    margin = " " * indent
    lines = [line for part in (first, *rest) for line in textwrap.wrap(part, _WIDTH - indent - 10) or [""]]
    return '"""' + "\n".join([lines[0], *(f"{margin}{line}" if line else "" for line in lines[1:])]) + '"""'


if __name__ == "__main__":
    SCHEMA_FILE.write_text(schema_text(), encoding="utf-8")
