"""Paths of files, as USD can name them."""

import os
import re
from pathlib import Path

from warpmag.declarations.checks import short_repr
from warpmag.errors import InputError

_ARGUMENTS = ":SDF_FORMAT_ARGS:"
_UNPRINTABLE = re.compile("[\x00-\x1f\x7f-\x9f\u2028\u2029\ud800-\udfff]")
"""Control characters, line separators, and the surrogates by which Python represents invalid UTF-8."""


def usable_path(path: str | os.PathLike, argument: str = "path") -> Path:
    """Return a path, ``~`` expanded; raise :class:`InputError` if USD cannot name it in a layer or in a message.

    ``argument`` is the name of the caller's argument, for the message.
    """
    text = os.fsdecode(path) if isinstance(path, str | os.PathLike) else ""
    if not text:
        raise InputError(f"{argument}: must be the name of a file, got {short_repr(path)}")
    if _UNPRINTABLE.search(text):
        raise InputError(f"{text!a}: the path contains a control character or is not UTF-8")
    if _ARGUMENTS in text:
        raise InputError(f"{text}: USD reads the text after {_ARGUMENTS} as arguments")
    try:
        expanded = Path(text).expanduser()
    except RuntimeError:
        raise InputError(f"{text}: no such home folder") from None
    if "\\" in os.path.abspath(expanded):
        raise InputError(f"{text}: USD reads a backslash as a slash")
    return expanded


def full_path(path: Path) -> Path:
    """Return the absolute path of a file.

    A link to the file is kept. Links to folders are resolved if the path contains ``..``: USD reads ``link/..`` as the
    folder that holds the link, the file system as the folder above the link's target.
    """
    return (path.parent.resolve() if ".." in path.parts else Path(os.path.abspath(path.parent))) / path.name


def path_between(layer: Path, target: Path) -> str:
    """Return the path by which ``layer`` names ``target``: relative where possible, otherwise absolute."""
    short = os.path.relpath(full_path(target), layer.parent.resolve())
    for folder in (layer.parent.resolve(), full_path(layer).parent):  # the second may be a link to the first
        joined = os.path.normpath(os.path.join(folder, short))
        if not (os.path.exists(joined) and os.path.samefile(joined, target)):
            return str(full_path(target))
    return short if short.startswith("..") else f"./{short}"
