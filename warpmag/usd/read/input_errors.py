"""Converts exceptions and warnings of USD, Newton and Warp into an :class:`InputError` of one line about the stage."""

import contextlib
import logging
import re
import warnings
from collections.abc import Iterator

from pxr import Tf

from warpmag.errors import InputError
from warpmag.usd.values import quiet

USD_FAILURES = (RuntimeError, UnicodeDecodeError, MemoryError, OverflowError, SystemError)
"""Exceptions that USD raises when it reads a stage; ``Tf.ErrorException`` and ``RecursionError`` are RuntimeErrors."""
NOT_USD = "not a USD file"
_NOT_TEXT = "text that is not UTF-8"
_LONGEST = 1_000
"""Largest number of characters read of USD's message, which for a damaged file may have a gigabyte."""
_LZ4_CODE = re.compile(r" LZ4 error code: -?\d+")
"""Part of USD's message about a damaged file that differs each time."""
_LOSSES = re.compile(r"[Ss]kipp|Invalid|Ignoring(?! body-level density)|unspecified|zero mass|not imported|result\.")
"""Words of a warning about content that Newton leaves out; other warnings are ignored."""
_SESSION_LAYER = re.compile(r",@anon:[^@]*@")
"""USD's identifier of a session layer, which contains an address."""
_REPORTED = "Custom attribute '"
"""Beginning of warnings about attributes that :func:`warpmag.usd.survey` reports already, with the prim."""


@contextlib.contextmanager
def newton_errors(stage_name: str, action: str) -> Iterator[None]:
    """Raise :class:`InputError` for every exception in the block, and for warnings about content that is left out.

    ``action`` is the verb for what Newton does with the stage.
    """
    try:
        with quiet(), _logged_warnings() as logged, warnings.catch_warnings(record=True) as caught:
            warnings.simplefilter("always")
            yield
    except InputError:
        raise
    except Exception as error:  # of any kind: users see no traceback of Newton or Warp
        message = first_line(error) if isinstance(error, Tf.ErrorException) else one_line_of(error)
        raise InputError(f"{stage_name}: Newton cannot {action} it ({message or type(error).__name__})") from None
    for message in (*(one_line_of(warning.message) for warning in caught), *logged):
        if _LOSSES.search(message) and not message.startswith(_REPORTED):
            raise InputError(f"{stage_name}: Newton cannot {action} all of it ({message})")


@contextlib.contextmanager
def _logged_warnings() -> Iterator[list[str]]:
    """Yield the warnings that Newton logs in the block, one line each, and keep them from other handlers."""
    lines, logger = [], logging.getLogger("newton")

    class _Lines(logging.Handler):
        def emit(self, record):
            lines.append(one_line_of(record.getMessage()))

    handler, propagates = _Lines(logging.WARNING), logger.propagate
    logger.addHandler(handler)
    logger.propagate = False
    try:
        yield lines
    finally:
        logger.propagate = propagates
        logger.removeHandler(handler)


@contextlib.contextmanager
def usd_errors(stage_name: str, message: str = "USD cannot read it") -> Iterator[None]:
    """Raise :class:`InputError` for exceptions of USD in the block, and keep USD's messages off stderr.

    USD's own message follows ``message`` in brackets.
    """
    try:
        with quiet():
            yield
    except InputError:
        raise
    except USD_FAILURES as error:
        raise InputError(f"{stage_name}: {message} ({first_line(error)})") from None


def first_line(error: Exception) -> str:
    """Return the first line of the message of an exception that USD raised."""
    if isinstance(error, UnicodeDecodeError):
        return _NOT_TEXT
    try:
        message = getattr(error.args[0], "commentary", error.args[0]) if error.args else ""
    except UnicodeDecodeError:  # the message quotes the file
        return _NOT_TEXT
    except MemoryError:
        message = ""
    lines = str(message)[:_LONGEST].strip().splitlines()
    return _LZ4_CODE.sub("", lines[0]) if lines else type(error).__name__


def one_line_of(text) -> str:
    """Return a text on one line, without the identifiers of session layers, which differ each time."""
    return " ".join(_SESSION_LAYER.sub("", str(text)).split())
