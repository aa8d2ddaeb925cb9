"""Nothing is fetched from a network for a stage: Newton would ask for a texture at whatever address a shader names."""

import re
from collections.abc import Iterator

from pxr import Sdf, Usd

from warpmag.errors import InputError

_ADDRESS = re.compile(r"[A-Za-z][A-Za-z0-9+.-]+:/")
"""What begins so is no path; a drive of Windows has one letter."""
_EVERYWHERE = Usd.TraverseInstanceProxies(Usd.PrimAllPrimsPredicate)


def cut_off(stage: Usd.Stage) -> None:
    """Block the inputs of shaders that name addresses, in the session layer; ``warpmag check`` warns of them.

    Raises:
        InputError: One lies inside an instance, where nothing can be blocked.
    """
    found = list(_addresses(stage))
    with Usd.EditContext(stage, stage.GetSessionLayer()):
        for attribute, address in found:
            prim = attribute.GetPrim()
            if prim.IsInstanceProxy():
                raise InputError(
                    f"{prim.GetPath()}: {attribute.GetName()} is {address[:80]!r} inside an instance, and nothing is "
                    "fetched from a network: name a file, or set instanceable = false"
                )
            attribute.Block()


def _addresses(stage: Usd.Stage) -> Iterator[tuple[Usd.Attribute, str]]:
    for prim in Usd.PrimRange(stage.GetPseudoRoot(), _EVERYWHERE):
        for attribute in prim.GetAuthoredPropertiesInNamespace("inputs"):
            value = attribute.Get() if isinstance(attribute, Usd.Attribute) else None
            text = value.path if isinstance(value, Sdf.AssetPath) else value
            if isinstance(text, str) and _ADDRESS.match(text):
                yield attribute, text
