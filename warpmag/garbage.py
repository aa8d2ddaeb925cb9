"""When Python looks for garbage."""

import contextlib
import gc
from collections.abc import Iterator


@contextlib.contextmanager
def collection_paused() -> Iterator[None]:
    """Keep Python from looking for garbage while very many objects come to be and none of them is any.

    It would look at all that there are again and again: a fifth of the time in which a stage of 100,000 balls is read
    and built, a seventh of that in which Newton is imported. Also a decorator. What a caller has switched off stays so.
    """
    enabled = gc.isenabled()
    gc.disable()
    try:
        yield
    finally:
        if enabled:
            gc.enable()
