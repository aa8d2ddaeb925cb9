"""Values that callers pass to :class:`Magnetics`, checked and converted: vectors on the device, worlds of points."""

import numpy as np
import warp as wp

from warpmag.declarations.checks import short_repr
from warpmag.errors import InputError
from warpmag.moments.arrays import CallContext, check_warp_array, host_array


def device_vectors(name: str, value, counts: tuple[int, ...], device: wp.Device) -> wp.array:
    """Return ``value`` as an array of vectors on ``device``; its length must be one of ``counts``.

    Values of a Warp array are not read, so that a graph can capture the call.

    Raises:
        InputError: ``value`` has another shape, is not finite, or is a Warp array of another type or device. The
            message begins with ``name``.
    """
    if isinstance(value, wp.array):
        check_warp_array(name, value, wp.vec3, device)
        vectors = value
    else:
        context = CallContext(wp.get_device(device), wp.float32, warp_out=False)
        vectors = context.vectors(name, np.atleast_2d(host_array(name, value)))
    if len(vectors) not in counts:
        allowed = " or ".join(f"[{count}, 3]" for count in dict.fromkeys(counts))
        raise InputError(f"{name}: shape must be [3] or {allowed}, got {list(np.shape(value))}")
    return vectors


def world_indices(worlds, magnetic_worlds: np.ndarray, count: int) -> np.ndarray:
    """Return the index of each point's world among the worlds with magnets, shape [count].

    Args:
        worlds: World of each point, a number or shape [count]; None means the only world with magnets.
        magnetic_worlds: Worlds with magnets, ascending.
        count: Number of points.

    Raises:
        InputError: ``worlds`` are not such numbers, one of them holds no magnets, or they are None and several worlds
            hold magnets.
    """
    if worlds is None:
        if len(magnetic_worlds) > 1:
            raise InputError(f"worlds: must be given, {len(magnetic_worlds)} worlds hold magnets")
        return np.zeros(count, int)
    numbers = host_array("worlds", worlds)
    worlds = numbers.astype(int) if (np.abs(numbers) < 2**31).all() else np.full(numbers.shape, -1)
    if (worlds != numbers).any() or worlds.shape not in ((), (count,)):
        raise InputError(f"worlds: must be whole numbers, one or {count}, got {short_repr(numbers.tolist())}")
    unknown = worlds[~np.isin(worlds, magnetic_worlds)]
    if unknown.size:
        raise InputError(f"worlds: world {unknown.flat[0]} holds no magnets")
    return np.broadcast_to(np.searchsorted(magnetic_worlds, worlds), count)
