"""Values that keys give over time, evaluated on the device: between two keys as USD interpolates, held outside them.

Times are those of a clock on the device, an array of one number, so that a captured graph follows them whatever the
length of its substeps.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
import warp as wp

wp.set_module_options({"enable_backward": False})

INTERPOLATIONS = ("linear", "held", "slerp")
"""How values go on from a key to the next; the last is for quaternions."""
_HELD, _SLERP = wp.constant(1), wp.constant(2)
_STRAIGHT = wp.constant(wp.float64(1e-5))
"""Quaternions whose product is 1 up to this part are interpolated linearly, as by USD."""


@wp.struct
class KeyedValues:
    """Curves of keys, for k keys in c curves.

    Attributes:
        times: Times of the keys [s], those of a curve rising, shape [k].
        values: Numbers of the keys, side by side.
        first: First key of each curve, and the one after the last, shape [c + 1].
        place: Where the numbers of each curve begin, shape [c].
        width: Numbers of a key, shape [c].
        interpolation: Index in ``INTERPOLATIONS``, shape [c].
    """

    times: wp.array[wp.float64]
    values: wp.array[wp.float64]
    first: wp.array[wp.int32]
    place: wp.array[wp.int32]
    width: wp.array[wp.int32]
    interpolation: wp.array[wp.int32]


def keyed_values(curves: Sequence, device) -> Any:
    """Return :class:`KeyedValues` on a device.

    Args:
        curves: Objects with ``times`` [s], shape [k], ``values``, shape [k, width], and ``interpolation``.
        device: Warp device.
    """

    def put(values, dtype):
        return wp.array(np.ascontiguousarray(values), dtype=dtype, device=device)

    counts, widths = [len(one.times) for one in curves], [one.values.shape[1] for one in curves]
    sizes = np.multiply(counts, widths)
    keyed = KeyedValues()
    keyed.times = put(np.concatenate([one.times for one in curves]), wp.float64)
    keyed.values = put(np.concatenate([one.values.ravel() for one in curves]), wp.float64)
    keyed.first = put(np.concatenate([[0], np.cumsum(counts)]), wp.int32)
    keyed.place, keyed.width = put(np.cumsum(sizes) - sizes, wp.int32), put(widths, wp.int32)
    keyed.interpolation = put([INTERPOLATIONS.index(one.interpolation) for one in curves], wp.int32)
    return keyed


@wp.func
def key_before(keyed: KeyedValues, curve: int, time: wp.float64) -> int:
    """The last key of a curve that is not after a time, or its first one."""
    low = keyed.first[curve]
    high = keyed.first[curve + 1]
    while high - low > 1:
        middle = (low + high) // 2
        if keyed.times[middle] <= time:
            low = middle
        else:
            high = middle
    return low


@wp.func
def part_after(keyed: KeyedValues, curve: int, key: int, time: wp.float64) -> wp.float64:
    """Which part of the way from a key to the next is done at a time, 0 where the key is held."""
    if keyed.interpolation[curve] == _HELD or key + 1 >= keyed.first[curve + 1] or time <= keyed.times[key]:
        return wp.float64(0.0)
    return (time - keyed.times[key]) / (keyed.times[key + 1] - keyed.times[key])


@wp.func
def key_number(keyed: KeyedValues, curve: int, key: int, component: int) -> wp.float64:
    """A number of a key."""
    return keyed.values[keyed.place[curve] + (key - keyed.first[curve]) * keyed.width[curve] + component]


@wp.func
def keyed_number(keyed: KeyedValues, curve: int, key: int, part: wp.float64, component: int) -> wp.float64:
    """A number on the way from a key to the next, linear."""
    value = key_number(keyed, curve, key, component)
    if part > wp.float64(0.0):
        value = (wp.float64(1.0) - part) * value + part * key_number(keyed, curve, key + 1, component)
    return value


@wp.func
def _key_quaternion(keyed: KeyedValues, curve: int, key: int) -> wp.quatd:
    return wp.quatd(
        key_number(keyed, curve, key, 0),
        key_number(keyed, curve, key, 1),
        key_number(keyed, curve, key, 2),
        key_number(keyed, curve, key, 3),
    )


@wp.func
def keyed_quaternion(keyed: KeyedValues, curve: int, key: int, part: wp.float64) -> wp.quatd:
    """A quaternion x y z w on the way from a key to the next along the shorter arc, of length 1."""
    a = _key_quaternion(keyed, curve, key)
    if part > wp.float64(0.0):
        b = _key_quaternion(keyed, curve, key + 1)
        one = wp.float64(1.0)
        cosine = wp.dot(a, b)
        if cosine < wp.float64(0.0):
            cosine = -cosine
            b = -b
        if one - cosine > _STRAIGHT:
            angle = wp.acos(cosine)
            a = (wp.sin((one - part) * angle) * a + wp.sin(part * angle) * b) / wp.sin(angle)
        else:
            a = (one - part) * a + part * b
    return wp.normalize(a)


@wp.struct
class Clock:
    """A moment, relative to the time of a clock.

    Attributes:
        time: The time [s], shape [1].
        shared: Number of substeps that share the moment, shape [1].
    """

    time: wp.array[wp.float64]
    shared: wp.array[wp.int32]


@wp.kernel
def _follow(
    # inputs:
    keyed: KeyedValues,
    clock: Clock,
    offset: wp.float64,
    substep: wp.float64,
    # outputs:
    targets_out: wp.array[wp.uint64],
):
    curve = wp.tid()
    time = clock.time[0] + offset + wp.float64(0.5) * wp.float64(clock.shared[0] - 1) * substep
    key = key_before(keyed, curve, time)
    part = part_after(keyed, curve, key, time)
    width = keyed.width[curve]
    target = wp.array(ptr=targets_out[curve], shape=(width,), dtype=wp.float32)
    for k in range(width):
        target[k] = float(keyed_number(keyed, curve, key, part, k))


@dataclass(frozen=True)
class Followers:
    """Numbers on the device that follow keys.

    Attributes:
        keyed: The curves.
        targets: The arrays whose memory takes the numbers, kept alive.
        addresses: Where each begins.
        clock: Time [s] on the device, shape [1].
        alone: A number of 1, shape [1].
    """

    keyed: Any
    targets: Sequence[wp.array]
    addresses: wp.array
    time: wp.array
    alone: wp.array


def follow(curves: Sequence, targets: Sequence[wp.array], time: wp.array) -> Followers:
    """Return what lets arrays follow keys.

    Args:
        curves: See :func:`keyed_values`; linear or held ones.
        targets: For each curve an array of float32, or of vectors of them, whose memory its numbers fill from the
            beginning on.
        time: Time on the device [s], float64, shape [1].
    """
    for curve, target in zip(curves, targets, strict=True):
        size = target.size * wp.types.type_size_in_bytes(target.dtype)
        assert size >= 4 * curve.values.shape[1], "a target has room for the numbers of a key"
        assert target.is_contiguous, "and they lie side by side"
    addresses = wp.array(np.array([one.ptr for one in targets], np.uint64), device=time.device)
    alone = wp.ones(1, dtype=wp.int32, device=time.device)
    return Followers(keyed_values(curves, time.device), list(targets), addresses, time, alone)


def launch_follow(followers: Followers, offset: float = 0.0, *, shared: wp.array | None = None, substep: float = 0.0):
    """Write what the keys say, all in one launch; capturable in a graph.

    Args:
        followers: What follows what.
        offset: Time since that of the clock [s].
        shared: Number of substeps that the values are for, shape [1]: they are those half-way between the times at
            which the first and the last of these begin; None means one.
        substep: Length of these [s].
    """
    clock = Clock()
    clock.time, clock.shared = followers.time, followers.alone if shared is None else shared
    inputs = [followers.keyed, clock, wp.float64(offset), wp.float64(substep)]
    outputs, device = [followers.addresses], followers.time.device
    wp.launch(_follow, dim=len(followers.targets), inputs=inputs, outputs=outputs, device=device)
