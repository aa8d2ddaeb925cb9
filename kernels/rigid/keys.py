"""Time-sampled values on the device: interpolated between keys as in USD, and held before the first and after the last.

Time is read from a clock on the device, an array of one number. So a captured graph follows it for any length of
substeps.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
import warp as wp

wp.set_module_options({"enable_backward": False})

INTERPOLATIONS = ("linear", "held", "slerp")  # interpolations between two keys; ``slerp`` is for quaternions
_HELD, _SLERP = wp.constant(1), wp.constant(2)
_LINEAR_LIMIT = wp.constant(wp.float64(1e-5))
"""Quaternions whose dot product differs from 1 by less are interpolated linearly, as in USD."""


@wp.struct
class KeyedValues:
    """Curves of keys, for k keys in c curves."""

    times: wp.array[wp.float64]  # times of the keys [s], ascending in each curve, shape [k]
    values: wp.array[wp.float64]  # numbers of all keys, one key after the other
    first: wp.array[wp.int32]  # first key of each curve, and the one after the last, shape [c + 1]
    offset: wp.array[wp.int32]  # index of each curve's first number in ``values``, shape [c]
    width: wp.array[wp.int32]  # numbers of a key, shape [c]
    interpolation: wp.array[wp.int32]  # index in ``INTERPOLATIONS``, shape [c]


def keyed_values(curves: Sequence, device) -> Any:
    """Return :class:`KeyedValues` on a device.

    ``curves`` have ``times`` [s], shape [k], ``values``, shape [k, width], and ``interpolation``.
    """

    def put(values, dtype):
        return wp.array(np.ascontiguousarray(values), dtype=dtype, device=device)

    counts, widths = [len(curve.times) for curve in curves], [curve.values.shape[1] for curve in curves]
    sizes = np.multiply(counts, widths)
    keyed = KeyedValues()
    keyed.times = put(np.concatenate([curve.times for curve in curves]), wp.float64)
    keyed.values = put(np.concatenate([curve.values.ravel() for curve in curves]), wp.float64)
    keyed.first = put(np.concatenate([[0], np.cumsum(counts)]), wp.int32)
    keyed.offset, keyed.width = put(np.cumsum(sizes) - sizes, wp.int32), put(widths, wp.int32)
    keyed.interpolation = put([INTERPOLATIONS.index(curve.interpolation) for curve in curves], wp.int32)
    return keyed


@wp.func
def key_before(keyed: KeyedValues, curve: int, time: wp.float64) -> int:
    """Return the last key of a curve at or before a time, or its first key."""
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
def fraction_after(keyed: KeyedValues, curve: int, key: int, time: wp.float64) -> wp.float64:
    """Return the fraction of the interval from a key to the next that has passed at a time, 0 if the key is held."""
    if keyed.interpolation[curve] == _HELD or key + 1 >= keyed.first[curve + 1] or time <= keyed.times[key]:
        return wp.float64(0.0)
    return (time - keyed.times[key]) / (keyed.times[key + 1] - keyed.times[key])


@wp.func
def key_number(keyed: KeyedValues, curve: int, key: int, component: int) -> wp.float64:
    """Return a number of a key."""
    return keyed.values[keyed.offset[curve] + (key - keyed.first[curve]) * keyed.width[curve] + component]


@wp.func
def interpolate_number(keyed: KeyedValues, curve: int, key: int, fraction: wp.float64, component: int) -> wp.float64:
    """Return a number between a key and the next one, interpolated linearly."""
    value = key_number(keyed, curve, key, component)
    if fraction > wp.float64(0.0):
        value = (wp.float64(1.0) - fraction) * value + fraction * key_number(keyed, curve, key + 1, component)
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
def interpolate_quaternion(keyed: KeyedValues, curve: int, key: int, fraction: wp.float64) -> wp.quatd:
    """Return the unit quaternion x y z w between a key and the next one, along the shorter arc."""
    a = _key_quaternion(keyed, curve, key)
    if fraction > wp.float64(0.0):
        b = _key_quaternion(keyed, curve, key + 1)
        unit = wp.float64(1.0)
        cosine = wp.dot(a, b)
        if cosine < wp.float64(0.0):
            cosine = -cosine
            b = -b
        if unit - cosine > _LINEAR_LIMIT:
            angle = wp.acos(cosine)
            a = (wp.sin((unit - fraction) * angle) * a + wp.sin(fraction * angle) * b) / wp.sin(angle)
        else:
            a = (unit - fraction) * a + fraction * b
    return wp.normalize(a)


@wp.kernel
def _write_values(
    keyed: KeyedValues,
    time_in: wp.array[wp.float64],
    sharing_in: wp.array[wp.int32],
    offset: wp.float64,
    substep: wp.float64,
    targets_out: wp.array[wp.uint64],
):
    curve = wp.tid()
    time = time_in[0] + offset + wp.float64(0.5) * wp.float64(sharing_in[0] - 1) * substep
    key = key_before(keyed, curve, time)
    fraction = fraction_after(keyed, curve, key, time)
    width = keyed.width[curve]
    target = wp.array(ptr=targets_out[curve], shape=(width,), dtype=wp.float32)
    for k in range(width):
        target[k] = float(interpolate_number(keyed, curve, key, fraction, k))


@dataclass(frozen=True)
class KeyedArrays:
    """Arrays on the device that follow keys."""

    keyed: Any  # the curves
    targets: Sequence[wp.array]  # arrays that receive the values; the reference keeps them alive
    addresses: wp.array  # address of each
    time: wp.array  # time on the device [s], shape [1]
    single: wp.array  # the number 1, shape [1]


def keyed_arrays(curves: Sequence, targets: Sequence[wp.array], time: wp.array) -> KeyedArrays:
    """Return arrays that follow keys, linear or held, by the time on the device [s], float64, shape [1].

    Each target is a contiguous array of float32, or of vectors of them, that receives the numbers of a curve.
    """
    for curve, target in zip(curves, targets, strict=True):
        size = target.size * wp.types.type_size_in_bytes(target.dtype)
        assert size >= 4 * curve.values.shape[1], "a target holds the numbers of a key"
        assert target.is_contiguous, "a target is contiguous"
    addresses = wp.array(np.array([target.ptr for target in targets], np.uint64), device=time.device)
    single = wp.ones(1, dtype=wp.int32, device=time.device)
    return KeyedArrays(keyed_values(curves, time.device), list(targets), addresses, time, single)


def write_keyed_values(
    arrays: KeyedArrays, offset: float = 0.0, *, shared: wp.array | None = None, substep: float = 0.0
):
    """Write the values of all curves at a time, in one launch; capturable in a graph.

    Args:
        offset: Time relative to the clock [s].
        shared: Number of substeps that share the values, shape [1]. The values are those halfway between the starts of
            the first and the last of these substeps. None means one.
        substep: Length of a substep [s].
    """
    sharing = arrays.single if shared is None else shared
    inputs = [arrays.keyed, arrays.time, sharing, wp.float64(offset), wp.float64(substep)]
    outputs, device = [arrays.addresses], arrays.time.device
    wp.launch(_write_values, dim=len(arrays.targets), inputs=inputs, outputs=outputs, device=device)
