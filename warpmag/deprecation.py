"""Earlier spellings of arguments, which still work and warn with the present one."""

from collections.abc import Callable
from functools import wraps
from typing import Any, ParamSpec, TypeVar, cast

from warpmag.declarations.checks import short_repr
from warpmag.errors import warn_caller

Parameters = ParamSpec("Parameters")
Result = TypeVar("Result")


def renamed_arguments(**present: str) -> Callable[[Callable[Parameters, Result]], Callable[Parameters, Result]]:
    """Return a decorator that accepts earlier names of keyword arguments, with a DeprecationWarning.

    Args:
        present: Present name of each argument, by its earlier name.
    """

    def decorate(function: Callable[Parameters, Result]) -> Callable[Parameters, Result]:
        owner = function.__qualname__.removesuffix(".__init__")

        @wraps(function)
        def renamed(*positions, **values):
            for earlier in present.keys() & values.keys():
                name = present[earlier]
                if name in values:
                    raise TypeError(f"{owner}() got {name} and its earlier name {earlier}")
                message = f"{owner}: {earlier} is deprecated, use {name}"
                warn_caller(message, DeprecationWarning)
                values[name] = values.pop(earlier)
            return cast(Any, function)(*positions, **values)

        return cast(Any, renamed)

    return decorate


def keyword_arguments(*names: str) -> Callable[[Callable[Parameters, Result]], Callable[Parameters, Result]]:
    """Return a decorator of ``function(builder, *, ...)`` that also accepts ``names`` by position, with a warning.

    By position an index of a shape passed for that of a body, and another shape became the magnet.
    """

    def decorate(function: Callable[Parameters, Result]) -> Callable[Parameters, Result]:
        call = cast(Any, function)

        @wraps(function)
        def named(builder, *positions, **values):
            given = dict(zip(names, positions, strict=False))
            if given:
                name = function.__name__
                spelled = ", ".join(f"{argument}={short_repr(value)}" for argument, value in given.items())
                message = f"{name}: name the {', '.join(given)}, {name}(builder, {spelled}, ...)"
                warn_caller(message, DeprecationWarning)
            return call(builder, *positions[len(given) :], **{**given, **values})

        return cast(Any, named)

    return decorate
