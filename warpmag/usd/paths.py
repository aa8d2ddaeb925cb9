"""Paths that USD can name."""

import os
import re
from pathlib import Path

from warpmag.errors import InputError

_ARGUMENTS = ":SDF_FORMAT_ARGS:"
_UNPRINTABLE = re.compile("[\x00-\x1f\x7f-\x9f\u2028\u2029\ud800-\udfff]")
"""Control characters, ends of lines, and what Python makes of bytes that are no UTF-8."""


def usable_path(path: str | os.PathLike) -> Path:
    """Return a path as USD takes it, ``~`` expanded.

    Raises:
        InputError: USD cannot name it, neither in a layer nor in a message.
    """
    text = os.fsdecode(path)
    if not text:
        raise InputError("the path of a file must not be empty")
    if _UNPRINTABLE.search(text):
        raise InputError(f"{text!a}: a path with a control character or one that is no UTF-8")
    if _ARGUMENTS in text:
        raise InputError(f"{text}: USD takes what follows {_ARGUMENTS} for arguments")
    try:
        found = Path(text).expanduser()
    except RuntimeError:
        raise InputError(f"{text}: no such home folder") from None
    if "\\" in os.path.abspath(found):
        raise InputError(f"{text}: USD takes a backslash for a slash")
    return found


def full_path(path: Path) -> Path:
    """Return the full path of a file; links to it stay, those on the way to a folder above them are resolved.

    USD takes ``link/..`` for the folder that holds the link; it is the folder above the one that it points to.
    """
    return (path.parent.resolve() if ".." in path.parts else Path(os.path.abspath(path.parent))) / path.name


def path_between(layer: Path, target: Path) -> str:
    """Return by which path ``layer`` names ``target``: relative to it, also where a link leads to its folder."""
    short = os.path.relpath(full_path(target), layer.parent.resolve())
    for folder in (layer.parent.resolve(), full_path(layer).parent):
        found = os.path.normpath(os.path.join(folder, short))
        if not (os.path.exists(found) and os.path.samefile(found, target)):
            return str(full_path(target))
    return short if short.startswith("..") else f"./{short}"
