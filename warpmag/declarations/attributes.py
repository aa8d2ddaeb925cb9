"""Table of attributes: one row describes a field of a record for Newton, USD, checks and documentation.

A record, such as ``Magnet``, is a dataclass. The annotation of each field holds an :class:`Attribute`, its row of the
table. The rows generate the attributes of Newton models, the USD schemas, their reading and writing, the checks of
values, and the tables of the documentation. ``warpmag.declarations.schemas`` lists all rows.
"""

from collections.abc import Callable
from dataclasses import MISSING, dataclass, fields, replace
from functools import cache
from typing import Any, Literal, get_type_hints

from warpmag.declarations.checks import check_token, plain_value, short_repr
from warpmag.errors import InputError

NAMESPACE = "warpmag"
"""Namespace of attributes in USD and in Newton models."""


@dataclass(frozen=True)
class Attribute:
    """One row of the table."""

    name: str  # in USD, without the namespace
    usd_type: str  # ``token``, ``float``, ``double``, ``bool``, ``vector3f``, ``point3f``, ``int3`` or an array of them
    title: str  # name in user interfaces
    doc: str  # meaning, in one or two sentences
    unit: str = ""  # as USD's own schemas write it, empty for tokens and flags; ``distance`` means the stage's unit
    range: str = ""  # range of values in the documentation, empty where every finite value is valid
    tokens: tuple[str, ...] = ()  # valid tokens
    check: Callable[[str, Any], Any] | None = None  # function of name and value that raises an error; None for tokens
    uniform: bool = False  # True if USD allows no time samples
    kind: str = ""  # kind of magnets that the attribute describes, empty for all
    optional: bool = False  # True if warpmag omits the default from the stages that it writes
    # A change of a Newton model's array takes effect from the next substep on, or after
    # ``Magnetics.notify_model_changed``, or raises an error.
    model_change: Literal["substep", "notified", "never"] = "never"
    field: str = ""  # field of the record, or a name in the same style for an attribute of USD alone
    default: Any = None  # None where the attribute has no default

    @property
    def usd_name(self) -> str:
        """Name in USD."""
        return f"{NAMESPACE}:{self.name}"

    @property
    def documentation(self) -> str:
        """Text of the USD schema: meaning, range and unit."""
        details = [f"{name}: {text}" for name, text in (("Range", self.range), ("Units", self.unit)) if text]
        return "\n".join([self.doc, "", *details] if details else [self.doc])

    def check_value(self, owner: str, value: Any) -> None:
        """Raise :class:`InputError` if ``value`` is invalid; the message names the owner and the field."""
        name = f"{owner}: {self.field.replace('_', ' ')}"
        if self.check is not None:
            self.check(name, value)
        else:
            check_token(name, value, self.tokens)


@cache
def attributes_of(record: type) -> tuple[Attribute, ...]:
    """Return the rows of a record, in the order of its fields, with field names and defaults."""
    hints = get_type_hints(record, include_extras=True)
    rows = []
    for field in fields(record):
        (row,) = hints[field.name].__metadata__
        default = row.default if field.default is MISSING else field.default
        rows.append(replace(row, field=field.name, default=default))
    return tuple(rows)


def check_record(name: str, value: Any, record: type) -> None:
    """Raise :class:`InputError` unless ``value`` is a record of the class ``record``."""
    if not isinstance(value, record):
        raise InputError(f"{name}: must be a {record.__name__}, got {short_repr(value)}")


def check_fields(record: Any, owner: str, *names: str) -> None:
    """Raise :class:`InputError` if a named field of a record is invalid; the message names ``owner``."""
    for row in attributes_of(type(record)):
        if row.field in names:
            row.check_value(owner, getattr(record, row.field))


def make_plain(record: Any) -> None:
    """Replace values of a frozen record by :func:`plain_value`; :class:`InputError` names a field that has none."""
    for row in attributes_of(type(record)):
        value = getattr(record, row.field)
        if isinstance(value, float | int | str) or (
            isinstance(value, tuple) and all(isinstance(v, float) for v in value)
        ):
            continue  # as nearly always
        value = plain_value(row.field, value)
        if getattr(value, "shape", None) == (1, 3):  # a Warp array of one vector
            value = value[0]
        if isinstance(value, list | tuple):
            value = tuple(plain_value(row.field, component) for component in value)
        object.__setattr__(record, row.field, value)


@dataclass(frozen=True)
class Schema:
    """An applied API schema of USD."""

    name: str  # in USD
    record: type  # the record that a prim with the schema declares
    doc: str  # meaning, in a few sentences
    usd_only: tuple[Attribute, ...] = ()  # rows of attributes without a field of the record

    @property
    def attributes(self) -> tuple[Attribute, ...]:
        """All rows: first the record's, then ``usd_only``."""
        return (*attributes_of(self.record), *self.usd_only)

    def usd_name(self, field: str) -> str:
        """Return the USD name of a field's attribute."""
        return next(row.usd_name for row in self.attributes if row.field == field)
