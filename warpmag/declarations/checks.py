"""Checks of single values, each with a message of one line that names the value.

Stages, command lines and scripts use the same checks, so that an invalid value gives the same message.
"""

import math
import numbers
import reprlib
from collections.abc import Mapping, Set
from typing import Any

from warpmag.errors import InputError

_JOINT_GAP, _JOINT_ROUNDING = 1e-4, 1e-5
"""Gap [m] up to which the ends of a joint count as coincident, and a fraction of their distance from the origin.

The gap grows by this fraction, because poses are in single precision.
"""

BYTES = (bytes, bytearray, memoryview)
"""Types that NumPy and ``len`` read as numbers, although they are bytes."""
_NO_SEQUENCES = (str, *BYTES, Set, Mapping)
_REPR = reprlib.Repr()
_REPR.maxother = 60


def short_repr(value: Any) -> str:
    """Return any value as short text on one line, for a message."""
    return " ".join(_REPR.repr_instance(value, 0).split())


def plain_value(name: str, value: Any) -> Any:
    """Return a Warp scalar as a number, and an array of Warp, PyTorch or the like as NumPy; others unchanged.

    A tensor that NumPy cannot read, on a GPU or with gradients, raises :class:`InputError`.
    """
    try:
        if callable(convert := getattr(value, "numpy", None)):
            return convert()
    except Exception as error:  # libraries raise errors of several types, those of USD at each access
        raise InputError(f"{name}: cannot be read as a NumPy array ({error})") from error
    number = getattr(value, "value", None)  # of a Warp scalar
    return number if isinstance(number, numbers.Real) else value


def real_number(name: str, value: Any) -> float:
    """Return one real number as a float; raise :class:`InputError` for anything else, including a bool."""
    plain = value = plain_value(name, value)
    if getattr(value, "shape", None) == () and hasattr(value, "item") and not getattr(value, "mask", False):
        plain = value.item()
    if isinstance(plain, bool) or not isinstance(plain, numbers.Real):
        raise InputError(f"{name}: must be one real number, got {short_repr(value)}")
    try:
        return float(plain)
    except OverflowError as error:  # an int or a fraction
        raise InputError(f"{name}: beyond the largest float, got {short_repr(value)}") from error


def check_text(name: str, value: Any) -> None:
    """Raise :class:`InputError` unless ``value`` is text."""
    if not isinstance(value, str):
        raise InputError(f"{name}: must be text, got {short_repr(value)}")


def check_token(name: str, value: Any, allowed: tuple[str, ...]) -> None:
    """Raise :class:`InputError` unless ``value`` is one of ``allowed``."""
    if not isinstance(value, str) or value not in allowed:
        raise InputError(f"{name}: {short_repr(value)} is not one of {', '.join(allowed)}")


def check_positive(name: str, value: Any, *, infinite: bool = False) -> None:
    """Raise :class:`InputError` unless ``value`` is positive and finite, or ``infinite`` is True and it is infinite."""
    number = real_number(name, value)
    if not number > 0.0 or (math.isinf(number) and not infinite):
        raise InputError(f"{name}: must be positive{'' if infinite else ' and finite'}, got {number:g}")


def check_not_negative(name: str, value: Any) -> None:
    """Raise :class:`InputError` unless ``value`` is zero or positive and finite."""
    number = real_number(name, value)
    if not (number >= 0.0 and math.isfinite(number)):
        raise InputError(f"{name}: must be zero or positive and finite, got {number:g}")


def check_vector(name: str, values: Any) -> None:
    """Raise :class:`InputError` unless ``values`` are three finite numbers."""
    vector(name, values)


def vector(name: str, values: Any) -> tuple[float, float, float]:
    """Return three finite numbers; raise :class:`InputError` for anything else."""
    values = plain_value(name, values)
    if getattr(values, "shape", None) == (1, 3):  # a Warp array of one vector
        values = values[0]
    try:
        three = len(values) == 3 and not isinstance(values, _NO_SEQUENCES)
    except TypeError:  # len() of a zero-dimensional NumPy array raises
        three = False
    if not three:
        raise InputError(f"{name}: must be three numbers, got {short_repr(values)}")
    x, y, z = (real_number(name, component) for component in values)
    if not all(map(math.isfinite, (x, y, z))):
        raise InputError(f"{name}: must be finite, got {(x, y, z)}")
    return x, y, z


def check_flag(name: str, value: Any) -> None:
    """Raise :class:`InputError` unless ``value`` is a bool of Python or NumPy."""
    if type(value).__name__ not in ("bool", "bool_"):
        raise InputError(f"{name}: must be True or False, got {short_repr(value)}")


def check_whole(name: str, value: Any) -> None:
    """Raise :class:`InputError` unless ``value`` is a whole number."""
    if isinstance(value, bool) or not isinstance(value, numbers.Integral):
        raise InputError(f"{name}: must be a whole number, got {short_repr(value)}")


def whole_pair(name: str, values: Any) -> tuple[int, int]:
    """Return two whole numbers; raise :class:`InputError` for anything else."""
    values = plain_value(name, values)
    try:
        two = len(values) == 2 and not isinstance(values, _NO_SEQUENCES)
    except TypeError:  # len() of a zero-dimensional NumPy array raises
        two = False
    if not two:
        raise InputError(f"{name}: must be two whole numbers, got {short_repr(values)}")
    first, second = values
    check_whole(name, first)
    check_whole(name, second)
    return int(first), int(second)


def check_count(name: str, value: Any) -> None:
    """Raise :class:`InputError` unless ``value`` is a whole number from 1 to 2³¹ − 1."""
    check_whole(name, value)
    if not 1 <= value < 2**31:
        raise InputError(f"{name}: must be at least 1 and below 2³¹, got {short_repr(value)}")


def joint_ends_apart(gap, distance):
    """Return True if the gap [m] between the ends of a joint exceeds rounding at their distance [m] from the origin."""
    return gap > _JOINT_GAP + _JOINT_ROUNDING * distance


def joint_gap_message(gap: float) -> str:
    """Return the end of a warning about a gap [m] between the ends of a joint."""
    return f"{gap:.3g} m apart at the start, and the run begins by pulling them together"
