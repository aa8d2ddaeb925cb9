"""Numbers and gradients of a result, which have to be finite."""

from collections.abc import Iterator
from dataclasses import fields, is_dataclass
from typing import Any

import numpy as np
import warp as wp

from warpmag.declarations.magnets import Magnet


def numbers(result: Any) -> Iterator[np.ndarray]:
    """Yield the arrays and numbers of a result."""
    for part in _parts(result):
        if isinstance(part, wp.array) and part.dtype in (wp.float32, wp.vec3):
            yield part.numpy()
        elif hasattr(part, "detach"):
            yield part.detach().numpy()
        elif isinstance(part, np.ndarray | float):
            yield np.asarray(part)


def gradients(result: Any, positions: Any, tape: wp.Tape | None) -> list[np.ndarray]:
    """Return the gradients of the sum of the results by the positions, if they require one."""
    parts = [part for part in _parts(result) if getattr(part, "requires_grad", False)]
    if not parts or not getattr(positions, "requires_grad", False):
        return []
    if isinstance(parts[0], wp.array):
        tape.backward(grads={part: wp.ones_like(part) for part in parts})
        return [positions.grad.numpy()]
    sum(part.sum() for part in parts).backward()
    return [positions.grad.numpy()]


def _parts(result: Any) -> list:
    """Return the arrays of a result: of a sequence, of the fields of a dataclass, or itself."""
    if is_dataclass(result) and not isinstance(result, Magnet):  # a susceptibility may be infinite
        return [getattr(result, entry.name) for entry in fields(result)]
    return list(result) if isinstance(result, tuple | list) else [result]


def short(value: Any) -> str:
    """Return a short text of an argument or a result."""
    if isinstance(value, np.ndarray | wp.array):
        return f"{type(value).__module__.split('.')[0]}.{getattr(value.dtype, '__name__', value.dtype)}{value.shape}"
    return " ".join(repr(value).split())[:80]
