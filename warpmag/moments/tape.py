"""Gradients of calls on arrays, recorded on Warp's tape.

Native code has no adjoints that Warp could generate. A call therefore pauses the active ``wp.Tape`` while it launches
kernels, and records one function that adds its vector-Jacobian product to the gradients of its arguments.
"""

from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from typing import Any

import warp as wp
from warp._src import context as warp_context  # the active tape has no public name

from warpmag.errors import InputError
from warpmag.kernels.shared.axpy import launch_add_scaled

Gradients = dict[str, wp.array]
"""Gradients of a loss with respect to the arguments of a call, by the names of the arguments."""


@contextmanager
def paused_tape() -> Iterator[wp.Tape | None]:
    """Yield the active tape, or None. Launches in this context are not recorded."""
    runtime = warp_context.runtime
    tape = None if runtime is None else runtime.tape
    if tape is None:
        yield None
        return
    runtime.tape = None
    try:
        yield tape
    finally:
        runtime.tape = tape


def differentiable(arguments: dict[str, Any]) -> dict[str, wp.array]:
    """Return the Warp arrays among arguments that require a gradient; raises ``InputError`` for indexed arrays."""
    for name, value in arguments.items():
        if isinstance(value, wp.indexedarray) and value.data is not None and value.data.requires_grad:
            raise InputError(f"{name}: an indexed array has no gradient; pass a wp.array")
    return {name: value for name, value in arguments.items() if isinstance(value, wp.array) and value.requires_grad}


def check_constant(arguments: dict[str, Any], reason: str) -> None:
    """Raise ``InputError`` with a reason if any of the arguments requires a gradient."""
    for name in differentiable(arguments):
        raise InputError(f"{name}: requires a gradient, but {reason}")


def check_untaped(arguments: dict[str, Any], reason: str) -> None:
    """Raise ``InputError`` with a reason if a tape is active and any of the arguments requires a gradient."""
    with paused_tape() as tape:
        if tape is not None:
            check_constant(arguments, reason)


def record(
    tape: wp.Tape,
    arguments: dict[str, Any],
    results: Sequence[Any],
    product: Callable[[list[wp.array], set[str]], Gradients],
) -> None:
    """Record the gradients of a call on a tape, unless no argument requires one.

    Args:
        tape: The tape that was active when the call began.
        arguments: Arrays of the call by name.
        results: Arrays that the call returns, Warp or NumPy. They require gradients from now on.
        product: Function that returns the vector-Jacobian product. It takes the gradients of the results, and the names
            of the arguments that require gradients. It may return gradients of others, too.
    """
    required = differentiable(arguments)
    if required and not all(isinstance(array, wp.array) for array in results):
        raise InputError(f"{next(iter(required))}: requires a gradient, but results are NumPy arrays as positions are")
    if not required or not all(array.shape[0] for array in results):
        return
    for array in results:
        array.requires_grad = True

    def add_gradients():
        with paused_tape():
            gradients = product([array.grad for array in results], set(required))
            for name, array in required.items():
                _add(gradients[name], array.grad)

    tape.record_func(add_gradients, [*required.values(), *results])


def _add(values: wp.array, total: wp.array) -> None:
    """Add values to a gradient, which may be strided or of another scalar type."""
    if not wp.types.types_equal(values.dtype, total.dtype):
        cast = wp.empty(values.shape[0], dtype=total.dtype, device=values.device)
        wp.utils.array_cast(in_array=values, out_array=cast)
        values = cast
    launch_add_scaled(values, total)
