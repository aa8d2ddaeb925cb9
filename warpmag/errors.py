"""Errors and warnings of the library."""

import re
import sys
import warnings
from types import FrameType

_BEGIN, _END = 400, 200
"""Characters kept at the start and at the end of a long message."""


def one_line(text: str) -> str:
    """Return ``text`` as one line of printable characters, without its middle if it is very long."""
    if len(text) > _BEGIN + _END:  # cut first: a list of a gigabyte's characters would exhaust memory
        text = f"{text[:_BEGIN]} ... {text[-_END:]}"
    return "".join(character if character.isprintable() else " " for character in text)


def extra(name: str) -> str:
    """Return the name of an extra of the package and the commands that install it, for an error message."""
    return f"the extra '{name}' (in a checkout pip install '.[{name}]', or uv run --extra {name} ...)"


_OWN_MODULES = re.compile(r"(warpmag|warp|contextlib)\b(?!\.examples)")
"""Modules that are not part of the user's program: warpmag, and modules that it is called through."""


def warn_caller(text: str, category: type[Warning] = UserWarning) -> None:
    """Issue a warning at the line of the user's program that called warpmag, at any depth of calls."""
    frame: FrameType | None = sys._getframe(1)
    level = 2
    while frame is not None and _OWN_MODULES.match(frame.f_globals.get("__name__", "")):
        frame, level = frame.f_back, level + 1
    warnings.warn(text, category, stacklevel=level if frame is not None else 2)


class InputError(ValueError):
    """Invalid input. The message is one line that names the prim or the argument.

    The command prints it and exits with code 2. In Python it is a ``ValueError``.
    """

    def __init__(self, message: str):
        """Turn ``message`` into one line."""
        super().__init__(one_line(str(message)))


class SimulationError(RuntimeError):
    """A simulation that cannot continue. The message is one line that names the step and the body."""

    def __init__(self, message: str):
        """Turn ``message`` into one line."""
        super().__init__(one_line(str(message)))


class ConvergenceWarning(UserWarning):
    """An induction solve that ended before it reached its tolerance."""


class UnitWarning(UserWarning):
    """A valid value that was likely meant in another unit."""
