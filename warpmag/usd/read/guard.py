"""Turns what USD or Newton raises over a stage, or warns about and then leaves out, into one line about the stage."""

import contextlib
import logging
import re
import warnings
from collections.abc import Iterator

from pxr import Tf

from warpmag.errors import InputError
from warpmag.usd.read.first_reading import FAILURES, failure
from warpmag.usd.values import quiet

_LOSSES = re.compile(r"[Ss]kipp|Invalid|Ignoring(?! body-level density)|unspecified|zero mass|not imported|result\.")
"""What a warning says by which something of the stage is lost; the others are remarks."""
_SESSION = re.compile(r",@anon:[^@]*@")
"""How USD names a stage's session layer, by an address that is another one each time."""
_TOLD = "Custom attribute '"
"""What a warning begins with of which the reader has told already, and named the prim."""


@contextlib.contextmanager
def refusals(where: str, what: str) -> Iterator[None]:
    """Raise :class:`InputError` for every error in the block, and for every warning by which something gets lost.

    Args:
        where: The stage, as messages call it.
        what: What the block does with it.
    """
    try:
        with quiet(), _logged() as logged, warnings.catch_warnings(record=True) as caught:
            warnings.simplefilter("always")
            yield
    except InputError:
        raise
    except Exception as error:  # of any kind: nothing of Newton's or Warp's is to reach the user as a traceback
        said = failure(error) if isinstance(error, Tf.ErrorException) else line_of(error)
        raise InputError(f"{where}: Newton cannot {what} it ({said or type(error).__name__})") from None
    for said in (*(line_of(one.message) for one in caught), *logged):
        if _LOSSES.search(said) and not said.startswith(_TOLD):
            raise InputError(f"{where}: Newton cannot {what} all of it ({said})")


@contextlib.contextmanager
def _logged() -> Iterator[list[str]]:
    """Yield the warnings that Newton logs meanwhile, a line each, which nobody else gets."""
    lines, logger = [], logging.getLogger("newton")

    class _Lines(logging.Handler):
        def emit(self, record):
            lines.append(line_of(record.getMessage()))

    handler, before = _Lines(logging.WARNING), logger.propagate
    logger.addHandler(handler)
    logger.propagate = False
    try:
        yield lines
    finally:
        logger.propagate = before
        logger.removeHandler(handler)


@contextlib.contextmanager
def readable(where: str, otherwise: str = "USD cannot read it") -> Iterator[None]:
    """Raise :class:`InputError` for what USD raises in the block, and keep what it has to say off stderr.

    Args:
        where: The stage, as messages call it.
        otherwise: What is wrong with it then.
    """
    try:
        with quiet():
            yield
    except InputError:
        raise
    except FAILURES as error:
        raise InputError(f"{where}: {otherwise} ({failure(error)})") from None


def line_of(text) -> str:
    """Return a text on one line, without the session layers that it names, which USD calls otherwise each time."""
    return " ".join(_SESSION.sub("", str(text)).split())
