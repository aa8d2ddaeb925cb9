"""Array arguments: checks of shapes, values and ranges, and conversion between NumPy and Warp.

Calls on arrays take NumPy or Warp arrays and return arrays of the same kind. Snapshots of Warp arrays are at the end.
"""

import math
import numbers
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import numpy as np
import numpy.typing as npt
import warp as wp

from warpmag.declarations.checks import BYTES, check_token, short_repr
from warpmag.declarations.magnets import MATERIAL_RANGE
from warpmag.errors import InputError
from warpmag.moments.ranks import launched_ranks

Numbers = npt.ArrayLike | wp.array
"""Type of array arguments: numbers, lists of numbers, NumPy arrays and Warp arrays."""
PersistentArray = wp.array | Callable[[], wp.array]
"""Array in a snapshot, or a function that returns its part in use."""
DTYPES = {"float32": wp.float32, "float64": wp.float64}
RADIUS_RANGE = {wp.float32: (5e-8, 2e4), wp.float64: (1e-30, 1e30)}
"""Smallest and largest radius [m] of a ball by Warp scalar type: neither r⁻⁵ nor products of moments may overflow."""
FARTHEST = {wp.float32: 1e7, wp.float64: 1e30}
"""Largest coordinate [m] by Warp scalar type: r⁻⁵ of the largest distance is still a normal number."""
REFERENCE_RADIUS_RANGE = {wp.float32: (1e-6, 2e4), wp.float64: (1e-30, 1e30)}
"""Smallest and largest radius [m] for the method ``reference``, which computes r⁶ of overlapping balls."""
REFERENCE_FARTHEST = {wp.float32: 5e4, wp.float64: 1e30}
"""Largest coordinate [m] for the method ``reference``."""
LEAST_FORCE_MOMENT = {wp.float32: 1e-18, wp.float64: 1e-150}
"""Lower limit [A·m²] of the largest moment component for forces, by Warp scalar type: smaller products underflow."""
GRID_REACH = 1e9
"""Largest coordinate that the grid of the neighbor search can index, in contact distances of the largest balls."""
_INTEGERS = (wp.int8, wp.uint8, wp.int16, wp.uint16, wp.int32, wp.uint32, wp.int64, wp.uint64)
_NUMBERS = (wp.float16, wp.float32, wp.float64, *_INTEGERS)
MOST_BODIES = {wp.float32: 2**24, wp.float64: 2**31 - 1}
"""Largest number of bodies by Warp scalar type: kernels store a body's number as a scalar beside its moments."""


def dtype_name(dtype) -> str:
    """Return ``"float32"`` or ``"float64"`` for a Warp scalar type."""
    return next(name for name, scalar in DTYPES.items() if scalar is dtype)


def check_bodies(text: str, count: int, dtype) -> None:
    """Raise ``InputError``, beginning with ``text``, if ``count`` bodies are too many for the scalar type ``dtype``."""
    if count > MOST_BODIES[dtype]:
        raise InputError(f"{text}, at most {MOST_BODIES[dtype]} {precision_hint(dtype)}")


def precision_hint(dtype) -> str:
    """Return the end of a message about a number out of range of the Warp scalar type ``dtype``."""
    return "in float32; use float64" if dtype is wp.float32 else "in float64"


def range_message(name: str, unit: str, value: float, limits: tuple[float, float], dtype) -> str:
    """Return the message for a value that is out of the range of the Warp scalar type ``dtype``."""
    text = f"{name}: must be {limits[0]:g} to {limits[1]:g}{unit} in {dtype_name(dtype)}, got {value:g}"
    return text + ("; use float64" if dtype is wp.float32 else "")


def largest_coordinate(dtype, reach: float, *, reference: bool = False) -> float:
    """Return the largest coordinate [m] of positions, for balls with a largest contact distance ``reach`` [m].

    ``reference`` means the method ``reference``.
    """
    most = (REFERENCE_FARTHEST if reference else FARTHEST)[dtype]
    return min(most, GRID_REACH * reach) if reach > 0.0 else most


def shape_message(name: str, expected: str, array) -> str:
    """Return the message for an array of the wrong shape."""
    return f"{name}: shape must be {expected}, got {list(array.shape)}"


def check_warp_array(name: str, array: Any, dtype, device, shape: tuple[int, ...] | None = None) -> None:
    """Raise ``InputError`` unless ``array`` is a Warp array of a type and a shape on a device; values are not read.

    None for ``dtype`` accepts any type, None for ``shape`` any number of entries.
    """
    if isinstance(array, wp.array):
        fits = array.ndim == 1 if shape is None else array.shape == shape
        if fits and array.device == device and (dtype is None or wp.types.types_equal(array.dtype, dtype)):
            return
        actual = f"{list(array.shape)} of {array.dtype.__name__} on {array.device}"
    else:
        actual = short_repr(array)
    kind, size = "" if dtype is None else f" of {dtype.__name__}", "" if shape is None else f" of shape {list(shape)}"
    raise InputError(f"{name}: must be a Warp array{kind}{size} on {device}, got {actual}")


def vec3_type(dtype):
    """Return the Warp three-vector of a scalar type."""
    return wp.vec3 if dtype is wp.float32 else wp.vec3d


def resolve_dtype(dtype: str):
    """Return the Warp scalar type of ``"float32"`` or ``"float64"``."""
    check_token("dtype", dtype, tuple(DTYPES))
    return DTYPES[dtype]


def resolve_device(device):
    """Return the Warp device of a name or a device; None means Warp's default.

    Under ``mpirun``, each rank on a host gets another GPU.
    """
    if device is None and wp.is_cuda_available() and (all_ranks := launched_ranks()) is not None:
        wp.set_device(f"cuda:{all_ranks.local_rank % wp.get_cuda_device_count()}")
    try:
        return wp.get_device(device)
    except Exception as error:  # Warp raises RuntimeError, ValueError or TypeError, with long texts
        available = ", ".join(d.alias for d in wp.get_devices())
        raise InputError(f"device: no {short_repr(device)} here; available: {available}") from error


def real_array(name: str, value, *, single: bool = False) -> np.ndarray:
    """Return real numbers, without masked entries, as a NumPy float64 array; ``single`` keeps float32 as it is."""
    if isinstance(value, (wp.array, wp.indexedarray)):
        value = value.numpy()
    try:
        array = np.asarray(None if isinstance(value, BYTES) else value)
    except Exception as error:  # a ragged list, or an object that fails to become an array
        raise InputError(f"{name}: no array of numbers: {short_repr(value)}") from error
    if isinstance(value, np.ma.MaskedArray) and np.ma.is_masked(value):
        raise InputError(f"{name}: has masked entries")
    kind = array.dtype.kind
    if kind == "O" and array.size and all(isinstance(v, numbers.Real) for v in array.flat):
        kind = "b" if any(isinstance(v, bool) for v in array.flat) else "f"  # ints beyond 64 bits, fractions
    if kind not in "iuf":
        raise InputError(f"{name}: must be real numbers, got {short_repr(value)}")
    if single and array.dtype == np.float32:
        return array
    try:
        with np.errstate(over="ignore"):
            return array.astype(np.float64, copy=False)
    except OverflowError as error:
        raise InputError(f"{name}: beyond the largest float64") from error


def host_array(name: str, value, *, infinite: bool = False) -> np.ndarray:
    """Return a NumPy float64 array of real numbers that are finite, or not NaN if ``infinite``."""
    array = real_array(name, value)
    if not (np.isnan(array).any() if infinite else not np.isfinite(array).all()):
        return array
    raise InputError(f"{name}: must not be NaN" if infinite else f"{name}: must be finite")


def host_radii(name: str, value, dtype, *, reference: bool = False) -> np.ndarray:
    """Return a NumPy float64 array of radii [m] of any shape, each 0 or in the range of the scalar type ``dtype``."""
    radii = host_array(name, value)
    if not (radii >= 0.0).all():
        raise InputError(f"{name}: must not be negative, got {radii.min():g}")
    least, most = (REFERENCE_RADIUS_RANGE if reference else RADIUS_RANGE)[dtype]
    outside = (radii > 0.0) & ((radii < least) | (radii > most))
    if outside.any():
        raise InputError(range_message(name, " m", radii[outside].flat[0], (least, most), dtype))
    return radii


def host_scalars(name: str, value, count: int, *, infinite: bool = False) -> np.ndarray:
    """Return a NumPy float64 array of shape [count], from one number or from ``count`` numbers."""
    array = host_array(name, value, infinite=infinite)
    if array.shape not in ((), (count,)):
        raise InputError(shape_message(name, f"[] or [{count}]", array))
    return np.broadcast_to(array, (count,))


def host_positive(name: str, value, count: int, dtype, *, infinite: bool = False) -> np.ndarray:
    """Return :func:`host_scalars` that are positive and in :data:`MATERIAL_RANGE` of the Warp scalar type ``dtype``."""
    array = host_scalars(name, value, count, infinite=infinite)
    if not (array > 0.0).all():
        raise InputError(f"{name}: must be positive, got {array.min():g}")
    least, most = MATERIAL_RANGE[dtype_name(dtype)]
    outside = (array < least) | (np.isfinite(array) & (array > most))
    if outside.any():
        raise InputError(range_message(name, "", array[outside][0], (least, most), dtype))
    return array


def norm_squared(array) -> float:
    """Return the sum of squares of a Warp array of vectors; infinite or NaN if a component is infinite or NaN."""
    total: Any = wp.utils.array_inner(array, array)
    return float(total)


def largest(array) -> float:
    """Return the largest absolute component of a Warp array of vectors.

    On a GPU one reduction returns the root of the sum of squares instead, if the sum is between 1e-30 and 1e30.
    """
    if array.shape[0] and array.device.is_cuda and 1e-30 < (squared := norm_squared(array)) < 1e30:
        return math.sqrt(squared)
    return float(np.abs(array.numpy()).max(initial=0.0))


def first_not_finite(array, count: int) -> int | None:
    """Return the index of the first of ``count`` rows that is not finite, or None. On a GPU a reduction tests first."""
    if isinstance(array, wp.array):
        if not count or (array.device.is_cuda and math.isfinite(norm_squared(array[:count]))):
            return None
        array = array.numpy()
    host = array[:count]
    return None if np.isfinite(host).all() else int(np.argwhere(~np.isfinite(host))[0, 0])


@dataclass(frozen=True)
class CallContext:
    """Device and scalar type of a call on arrays, and the library of the arrays that it returns."""

    device: Any
    dtype: type  # Warp scalar type
    warp_out: bool  # results are Warp arrays, else NumPy arrays

    def result(self, array, count=None):
        """Return the first ``count`` entries of a Warp array, or all, as an array of the caller's library."""
        if not self.warp_out:
            return array.numpy() if count is None else array.numpy()[:count].copy()
        if count is None:
            return array
        # Warp cannot slice zero entries
        return wp.clone(array[:count]) if count else wp.empty(0, dtype=array.dtype, device=array.device)

    def vectors(self, name, value, count=None, *, farthest=None, least=None, shared=False):
        """Return a Warp array of three-vectors, shape [n], from an array [n, 3] or a Warp array.

        Args:
            name: Name of the argument, for messages.
            value: Its value; with ``count`` also one vector, shape [3], for all.
            count: Number of vectors; None accepts any.
            farthest: Largest coordinate [m], for positions; None accepts any.
            least: Lower limit of the largest component, by Warp scalar type; all zeros are always accepted.
            shared: True if the result may share the caller's memory, because the call only reads it.
        """
        least = 0.0 if least is None else least[self.dtype]
        if isinstance(value, (wp.array, wp.indexedarray)):
            array = self._from_warp(name, value, vec3_type(self.dtype), count)
            if not _is_within(array, least, self._most(farthest)):
                self._check_size(name, array.numpy(), farthest, least)
            return array
        array = real_array(name, value, single=True)
        if count is not None and array.shape == (3,):
            array = np.broadcast_to(array, (count, 3))
        if array.ndim != 2 or array.shape[1] != 3 or (count is not None and len(array) != count):
            expected = "[n, 3]" if count is None else f"[3] or [{count}, 3]"
            raise InputError(shape_message(name, expected, array))
        self._check_size(name, array, farthest, least)
        return self._upload(array, vec3_type(self.dtype), shared)

    def scalars(self, name, value, count):
        """Return a Warp array of scalars, shape [count], from one number or ``count`` numbers."""
        if isinstance(value, (wp.array, wp.indexedarray)):
            return self._from_warp(name, value, self.dtype, count)
        return self._upload(host_scalars(name, value, count), self.dtype)

    def _upload(self, array, warp_type, shared=False):
        array = np.ascontiguousarray(array, dtype=dtype_name(self.dtype))
        return wp.array(array, dtype=warp_type, device=self.device, copy=not shared)

    def _most(self, farthest) -> float:
        return float(np.finfo(dtype_name(self.dtype)).max) if farthest is None else farthest

    def _check_size(self, name, array, farthest, least):
        """Raise ``InputError`` if the largest absolute value of an array is out of range or NaN."""
        size = max(float(array.max(initial=0.0)), -float(array.min(initial=0.0)))  # NaN if any entry is
        if least <= size <= self._most(farthest) or size == 0.0:
            return
        if np.isnan(size):
            raise InputError(f"{name}: contains NaN (row {int(np.argwhere(np.isnan(array))[0, 0])})")
        if size < least:
            raise InputError(f"{name}: all below {least:g}, the largest is {size:g}, {precision_hint(self.dtype)}")
        row = int(np.argwhere(np.abs(array) == size)[0, 0])
        if size > self._most(None):
            raise InputError(f"{name}: not finite in {dtype_name(self.dtype)} (row {row})")
        text = f"{name}: {size:g} m from the origin (row {row})"
        if farthest not in (FARTHEST[self.dtype], REFERENCE_FARTHEST[self.dtype]):
            raise InputError(f"{text}, with balls of this size at most {farthest:g} m; shift the origin")
        raise InputError(f"{text}, at most {farthest:g} m {precision_hint(self.dtype)}")

    def _from_warp(self, name, array, warp_type, count):
        """Return a contiguous Warp array of a type, from one that may be strided, indexed or of another scalar type."""
        if array.ndim != 1 or (count is not None and array.shape[0] != count):
            expected = f"[{'n' if count is None else count}] of {warp_type.__name__}"
            raise InputError(shape_message(name, expected, array) + f" of {array.dtype.__name__}")
        if array.device != self.device:
            raise InputError(f"{name}: is on {array.device}, not on {self.device}")
        array = array.contiguous()
        if wp.types.types_equal(array.dtype, warp_type):
            return array
        convertible = _NUMBERS if warp_type is self.dtype else (wp.types.vector(3, scalar) for scalar in _NUMBERS)
        if not any(wp.types.types_equal(array.dtype, other) for other in convertible):
            raise InputError(f"{name}: cannot convert {array.dtype.__name__} to {warp_type.__name__}")
        cast = wp.empty(array.shape[0], dtype=warp_type, device=self.device)
        wp.utils.array_cast(in_array=array, out_array=cast)
        return cast


def _is_within(array, least: float, most: float) -> bool:
    """Return True if one reduction on a GPU proves that the largest absolute component is in range."""
    if not (array.shape[0] and array.device.is_cuda):
        return False
    square = norm_squared(array)  # between the square of the largest component and 3n times that
    return 3.0 * array.shape[0] * least**2 < square < math.inf and math.sqrt(square) <= most


def resolve_context(first, dtype: str, device) -> CallContext:
    """Return the context of a call from its first array argument, ``dtype`` and ``device``."""
    warp_out = isinstance(first, (wp.array, wp.indexedarray))
    if device is None and warp_out:
        device = first.device
    return CallContext(resolve_device(device), resolve_dtype(dtype), warp_out)


def _bytes(array: PersistentArray) -> np.ndarray:
    """Return the bytes of an array, without copying those of a contiguous one on a CPU."""
    array = array() if callable(array) else array
    return np.ascontiguousarray(array.numpy()).reshape(-1).view(np.uint8)


def snapshot_views(arrays: dict[str, PersistentArray]) -> dict[str, np.ndarray]:
    """Return the bytes of each array, without copying on a CPU: such a view changes with its array."""
    return {name: data for name, array in arrays.items() if (data := _bytes(array)).size}


def take_snapshot(arrays: dict[str, PersistentArray]) -> dict[str, np.ndarray]:
    """Return a copy of the bytes of each array, by name."""
    return {name: data.copy() for name, data in snapshot_views(arrays).items()}


def restore_snapshot(arrays: dict[str, PersistentArray], saved: dict[str, np.ndarray]) -> None:
    """Copy the bytes that :func:`take_snapshot` returned back into the arrays, which must have the same sizes."""
    for name, persistent in arrays.items():
        array = persistent() if callable(persistent) else persistent
        if array.size:
            data, size = saved.get(name), array.size * wp.types.type_size_in_bytes(array.dtype)
            if data is None or data.dtype != np.uint8 or data.shape != (size,):
                raise InputError(f"checkpoint: {name} does not fit this run")
            same = wp.array(ptr=data.ctypes.data, dtype=array.dtype, shape=array.shape, device="cpu")
            wp.copy(array, same)
