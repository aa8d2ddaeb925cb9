"""Copies of Warp arrays of any type on the host, bit by bit."""

import numpy as np
import warp as wp

from warpmag.errors import InputError


def _bytes_of(array: wp.array) -> wp.array:
    """Return the memory of an array as bytes."""
    assert array.is_contiguous, "its elements lie side by side"
    size = array.size * wp.types.type_size_in_bytes(array.dtype)
    return wp.array(ptr=array.ptr, dtype=wp.uint8, shape=size, device=array.device)


def contents(arrays: dict[str, wp.array]) -> dict[str, np.ndarray]:
    """Return the contents of arrays, bytes by name; on a CPU their memory itself, as long as it is theirs."""
    return {name: _bytes_of(array).numpy() for name, array in arrays.items() if array.size}


def save(arrays: dict[str, wp.array]) -> dict[str, np.ndarray]:
    """Return the contents of arrays as they are now, bytes by name."""
    found = contents(arrays)
    return {name: one.copy() if arrays[name].device.is_cpu else one for name, one in found.items()}


def load(arrays: dict[str, wp.array], saved: dict[str, np.ndarray]) -> None:
    """Give arrays the contents that :func:`save` returned.

    Raises:
        InputError: They are of other arrays.
    """
    for name, array in arrays.items():
        if array.size:
            memory, found = _bytes_of(array), saved.get(name)
            if found is None or found.dtype != np.uint8 or found.shape != memory.shape:
                raise InputError(f"checkpoint: {name} is not that of this run")
            memory.assign(found)
