"""Warnings about attributes without effect: misspelled names, missing schemas, values of the other kind of magnet."""

import difflib
import functools
from collections.abc import Collection, Iterator

from pxr import Usd

from warpmag.declarations.attributes import NAMESPACE, attributes_of
from warpmag.declarations.magnets import Magnet
from warpmag.declarations.schemas import SCHEMAS
from warpmag.usd.schemas import has_api
from warpmag.usd.values import Finding

_SCHEMA_NAMES = [schema.name for schema in SCHEMAS]
_SCHEMA_OF = {row.usd_name: schema.name for schema in SCHEMAS for row in schema.attributes}
_SIMILAR = 0.85
"""Least similarity of a misspelled and a correct name: one wrong letter in seven, or two swapped letters."""


def stray_findings(prim: Usd.Prim) -> Iterator[Finding]:
    """Yield warnings about schemas and attributes of a prim that are named like warpmag's and have no effect."""
    path = str(prim.GetPath())
    for api in prim.GetPrimTypeInfo().GetAppliedAPISchemas():
        if api not in _SCHEMA_NAMES and _is_similar(api[: len(NAMESPACE)], (NAMESPACE,)):
            message = f"{api} has no effect: there is no such schema{_nearest(api, _SCHEMA_NAMES)}"
            yield Finding(path, message, "warning")
    for name in prim.GetAuthoredPropertyNames():
        if not _is_similar(name.partition(":")[0], (NAMESPACE,)):
            continue
        schema = _SCHEMA_OF.get(name)
        if schema is None:
            yield Finding(path, f"{name} has no effect: no schema has it{_nearest(name, list(_SCHEMA_OF))}", "warning")
        elif not has_api(prim, schema):
            yield Finding(path, f"{name} has no effect: the prim has no {schema}", "warning")


def kind_findings(prim: Usd.Prim, magnet: Magnet, *, keyed: bool) -> Iterator[Finding]:
    """Yield warnings about a permanent magnet without magnetization, and about values without effect on its kind.

    ``keyed`` is True where keys change the magnetization.
    """
    path = str(prim.GetPath())
    if magnet.kind == "permanent" and not (keyed or any(magnet.magnetization)):
        yield Finding(path, "a permanent magnet without magnetization: author warpmag:magnetization", "warning")
    if magnet.kind == "inducible":
        for row in attributes_of(Magnet):
            used = getattr(magnet, row.field) != row.default or (keyed and row.field == "magnetization")
            if row.kind == "permanent" and used:
                message = f"{row.usd_name} has no effect on an inducible magnet, as warpmag:kind declares it"
                yield Finding(path, message, "warning")


@functools.cache  # thousands of prims have the same few names
def _is_similar(name: str, known: Collection[str]) -> bool:
    """Return True if a name is one of the known names, or may be a misspelling of one."""
    return any(difflib.SequenceMatcher(None, name.lower(), other.lower()).ratio() >= _SIMILAR for other in known)


def _nearest(name: str, known: list[str]) -> str:
    """Return the end of a message that proposes the nearest known name, empty where none is near."""
    matches = difflib.get_close_matches(name, known, n=1, cutoff=0.6)
    return f", the nearest is {matches[0]}" if matches else ""
