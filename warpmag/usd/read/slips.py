"""Slips of the pen: attributes and schemas in warpmag's name that no schema has, and values that count for nothing."""

import difflib
import functools
from collections.abc import Collection, Iterator

from pxr import Usd

from warpmag.declarations.magnets import Magnet
from warpmag.usd.read.coils import COIL_API, COIL_NAMES, MAP_API, MAP_NAMES
from warpmag.usd.schemas import MAGNET_API, MAGNET_NAMES, MATERIAL, SCENE_API, SCENE_NAMES, has_api
from warpmag.usd.values import Finding

_NAMES = {MAGNET_API: MAGNET_NAMES, SCENE_API: SCENE_NAMES, COIL_API: COIL_NAMES, MAP_API: MAP_NAMES}
_SCHEMA_OF = {name: schema for schema, names in _NAMES.items() for name in names}
_NAMESPACE = "warpmag"
_LIKE = 0.85
"""How much a slip is like what is meant; one letter of seven, or two that changed places."""


def stray_findings(prim: Usd.Prim) -> Iterator[Finding]:
    """Yield which schemas and attributes in warpmag's name a prim has for nothing."""
    path = str(prim.GetPath())
    for api in prim.GetPrimTypeInfo().GetAppliedAPISchemas():
        if api not in _NAMES and _like(api[: len(_NAMESPACE)], (_NAMESPACE,)):
            yield Finding(path, f"{api} has no effect: there is no such schema{_nearest(api, list(_NAMES))}", "warning")
    for name in prim.GetAuthoredPropertyNames():
        if not _like(name.partition(":")[0], (_NAMESPACE,)):
            continue
        schema = _SCHEMA_OF.get(name)
        if schema is None:
            message = f"{name} has no effect: no schema has it{_nearest(name, list(_SCHEMA_OF))}"
            yield Finding(path, message, "warning")
        elif not has_api(prim, schema):
            yield Finding(path, f"{name} has no effect: the prim has no {schema}", "warning")


def kind_findings(prim: Usd.Prim, magnet: Magnet, *, keyed: bool) -> Iterator[Finding]:
    """Yield what a magnet says that does not go with its kind.

    Args:
        prim: The prim.
        magnet: What it says.
        keyed: Whether keys change the magnetization.
    """
    path, magnetized = str(prim.GetPath()), keyed or any(magnet.magnetization)
    if magnet.kind == "permanent" and not magnetized:
        message = f"a permanent magnet without magnetization: warpmag:magnetization says it, or {MATERIAL} its strength"
        yield Finding(path, message, "warning")
    if magnet.kind == "inducible":
        for name, said in (("magnetization", magnetized), ("recoilPermeability", magnet.recoil_permeability > 1.0)):
            if said:
                message = f"warpmag:{name} has no effect on an inducible magnet: warpmag:kind says what it is"
                yield Finding(path, message, "warning")


@functools.cache  # thousands of prims have the same few names
def _like(name: str, known: Collection[str]) -> bool:
    """Return whether a name is, or may be a slip for, a known one."""
    return any(difflib.SequenceMatcher(None, name.lower(), one.lower()).ratio() >= _LIKE for one in known)


def _nearest(name: str, known: list[str]) -> str:
    """Return which known name is next to one, in words."""
    found = difflib.get_close_matches(name, known, n=1, cutoff=0.6)
    return f", the nearest is {found[0]}" if found else ""
