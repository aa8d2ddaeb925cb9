"""Arrays in and out: NumPy or Warp, checked once, returned in the kind they came in."""

import math
import numbers
from dataclasses import dataclass
from typing import Any

import numpy as np
import numpy.typing as npt
import warp as wp

from warpmag.declarations.checks import check_token, short_repr
from warpmag.declarations.magnets import MATERIAL_RANGE
from warpmag.errors import InputError
from warpmag.moments.ranks import launched

Numbers = npt.ArrayLike | wp.array
"""What arguments take: numbers, lists of them and NumPy arrays, or a Warp array."""
DTYPES = {"float32": wp.float32, "float64": wp.float64}
RADIUS_RANGE = {wp.float32: (5e-8, 2e4), wp.float64: (1e-30, 1e30)}
"""Smallest and largest radius [m] of a ball by Warp scalar type: neither r⁻⁵ nor products of moments may overflow."""
FARTHEST = {wp.float32: 1e7, wp.float64: 1e30}
"""Largest coordinate [m] by Warp scalar type: r⁻⁵ of two of them is still a normal number."""
REFERENCE_RADIUS_RANGE = {wp.float32: (1e-6, 2e4), wp.float64: (1e-30, 1e30)}
REFERENCE_FARTHEST = {wp.float32: 5e4, wp.float64: 1e30}
"""The same of the plain loop, which has r⁶ of overlapping balls."""
LEAST_OF_FORCE = {wp.float32: 1e-18, wp.float64: 1e-150}
"""Least of the largest component of moments [A·m²], by Warp scalar type: products of smaller ones have no digits."""
CELLS = 1e9
"""Distance from the origin, in contact distances of the largest balls, to which the search for neighbours has cells."""

_INTEGERS = (wp.int8, wp.uint8, wp.int16, wp.uint16, wp.int32, wp.uint32, wp.int64, wp.uint64)
_NUMBERS = (wp.float16, wp.float32, wp.float64, *_INTEGERS)


def name_of(dtype) -> str:
    """Name of a Warp scalar type as it is passed."""
    return next(name for name, one in DTYPES.items() if one is dtype)


MOST_BODIES = {wp.float32: 2**24, wp.float64: 2**31 - 1}
"""Bodies that are told apart by their numbers, which are packed with moments, by Warp scalar type."""


def check_bodies(text: str, count: int, dtype) -> None:
    """Raise ``InputError`` that begins with a text where ``count`` numbers of bodies are too many for ``dtype``."""
    if count > MOST_BODIES[dtype]:
        raise InputError(f"{text}, at most {MOST_BODIES[dtype]} {hint(dtype)}")


def hint(dtype) -> str:
    """End of a message about numbers that are out of range of the Warp scalar type ``dtype``."""
    return "in float32; use float64" if dtype is wp.float32 else "in float64"


def range_message(name: str, unit: str, value: float, limits: tuple[float, float], dtype) -> str:
    """Text for a value that is out of the range of the Warp scalar type ``dtype``."""
    text = f"{name}: must be {limits[0]:g} to {limits[1]:g}{unit} in {name_of(dtype)}, got {value:g}"
    return text + ("; use float64" if dtype is wp.float32 else "")


def farthest_place(dtype, reach: float, *, reference: bool = False) -> float:
    """Largest coordinate [m] in the Warp scalar type ``dtype`` of balls that touch at ``reach`` [m], 0 for points."""
    most = (REFERENCE_FARTHEST if reference else FARTHEST)[dtype]
    return min(most, CELLS * reach) if reach > 0.0 else most


def shape_message(name: str, wanted: str, array) -> str:
    """Text for an array whose shape is not as wanted."""
    return f"{name}: shape must be {wanted}, got {list(array.shape)}"


def vec3_type(dtype):
    """Three-vector of a Warp scalar type."""
    return wp.vec3 if dtype is wp.float32 else wp.vec3d


def resolve_dtype(dtype: str):
    """Warp scalar type of ``"float32"`` or ``"float64"``."""
    check_token("dtype", dtype, tuple(DTYPES))
    return DTYPES[dtype]


def resolve_device(device):
    """Warp device of a name, a device or None: Warp's default, which of several ranks is each its own GPU.

    Raises:
        InputError: There is no such device.
    """
    if device is None and wp.is_cuda_available() and (all_ranks := launched()) is not None:
        wp.set_device(f"cuda:{all_ranks.local_rank % wp.get_cuda_device_count()}")
    try:
        return wp.get_device(device)
    except Exception as error:  # Warp raises RuntimeError, ValueError or TypeError, with long texts
        available = ", ".join(d.alias for d in wp.get_devices())
        raise InputError(f"device: no {short_repr(device)} here; available: {available}") from error


def real_array(name: str, value, *, single: bool = False) -> np.ndarray:
    """Real numbers as a NumPy array of float64, or what is float32 as such if ``single``, whatever holds them.

    Raises:
        InputError: There is anything else.
    """
    if isinstance(value, (wp.array, wp.indexedarray)):
        value = value.numpy()
    try:
        array = np.asarray(value)
    except Exception as error:  # a ragged list, or an object that fails to become an array
        raise InputError(f"{name}: no array of numbers: {short_repr(value)}") from error
    if np.ma.is_masked(value):
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
    """Real numbers as by :func:`real_array`, all finite, or else only infinite where ``infinite`` allows it."""
    array = real_array(name, value)
    if not (np.isnan(array).any() if infinite else not np.isfinite(array).all()):
        return array
    raise InputError(f"{name}: must not be NaN" if infinite else f"{name}: must be finite")


def host_radii(name: str, value, dtype, *, reference: bool = False) -> np.ndarray:
    """NumPy float64 array of radii [m]: zero or in range of the Warp scalar type ``dtype``, of any shape."""
    radii = host_array(name, value)
    if not (radii >= 0.0).all():
        raise InputError(f"{name}: must not be negative, got {radii.min():g}")
    least, most = (REFERENCE_RADIUS_RANGE if reference else RADIUS_RANGE)[dtype]
    outside = (radii > 0.0) & ((radii < least) | (radii > most))
    if outside.any():
        raise InputError(range_message(name, " m", radii[outside].flat[0], (least, most), dtype))
    return radii


def host_scalars(name: str, value, count: int, *, infinite: bool = False) -> np.ndarray:
    """NumPy float64 array of shape [count] from one number or an array of either kind, checked."""
    array = host_array(name, value, infinite=infinite)
    if array.shape not in ((), (count,)):
        raise InputError(shape_message(name, f"[] or [{count}]", array))
    return np.broadcast_to(array, (count,))


def host_positive(name: str, value, count: int, dtype, *, infinite: bool = False) -> np.ndarray:
    """As :func:`host_scalars`, of numbers that are positive and in range of the Warp scalar type ``dtype``."""
    array = host_scalars(name, value, count, infinite=infinite)
    if not (array > 0.0).all():
        raise InputError(f"{name}: must be positive, got {array.min():g}")
    least, most = MATERIAL_RANGE[name_of(dtype)]
    outside = (array < least) | (np.isfinite(array) & (array > most))
    if outside.any():
        raise InputError(range_message(name, "", array[outside][0], (least, most), dtype))
    return array


def norm_squared(array) -> float:
    """Sum of the squares of a Warp array of vectors, infinite or NaN if one of them is: on a GPU one reduction."""
    total: Any = wp.utils.array_inner(array, array)
    return float(total)


def largest(array) -> float:
    """Largest absolute component of a Warp array of vectors; on a GPU their norm, where its square is a float32."""
    if array.shape[0] and array.device.is_cuda and 1e-30 < (squared := norm_squared(array)) < 1e30:
        return math.sqrt(squared)
    return float(np.abs(array.numpy()).max(initial=0.0))


def first_not_finite(array, count: int) -> int | None:
    """Row among the first ``count`` of an array that is not finite, None if all are: on a GPU one reduction."""
    if isinstance(array, wp.array):
        if not count or (array.device.is_cuda and math.isfinite(norm_squared(array[:count]))):
            return None
        array = array.numpy()
    host = array[:count]
    return None if np.isfinite(host).all() else int(np.argwhere(~np.isfinite(host))[0, 0])


@dataclass(frozen=True)
class Kind:
    """Where a call computes and what it returns: device, scalar type, NumPy or Warp."""

    device: Any
    dtype: type
    warp_out: bool

    def finish(self, array, count=None):
        """Return a Warp array, or a copy of its first ``count`` entries, as the caller's kind."""
        if not self.warp_out:
            return array.numpy() if count is None else array.numpy()[:count].copy()
        if count is None:
            return array
        # Warp refuses an empty slice
        return wp.clone(array[:count]) if count else wp.empty(0, dtype=array.dtype, device=array.device)

    def vectors(self, name, value, count=None, *, farthest=None, least=None, shared=False):
        """Warp array of three-vectors, shape [n], from [n, 3] or, with ``count``, from one vector for all.

        Args:
            name: Name of the argument.
            value: Its value.
            count: Number of vectors; None means any.
            farthest: If they are places, the largest coordinate [m] that is allowed.
            least: The least that the largest of all components may be unless they are zero, by Warp scalar type.
            shared: Whether the array may be the caller's own memory: it is only read, before the call returns.
        """
        least = 0.0 if least is None else least[self.dtype]
        if isinstance(value, (wp.array, wp.indexedarray)):
            array = self._from_warp(name, value, vec3_type(self.dtype), count)
            if not _within(array, least, self._most(farthest)):
                self._check_size(name, array.numpy(), farthest, least)
            return array
        array = real_array(name, value, single=True)
        if count is not None and array.shape == (3,):
            array = np.broadcast_to(array, (count, 3))
        if array.ndim != 2 or array.shape[1] != 3 or (count is not None and len(array) != count):
            wanted = "[n, 3]" if count is None else f"[3] or [{count}, 3]"
            raise InputError(shape_message(name, wanted, array))
        self._check_size(name, array, farthest, least)
        return self._upload(array, vec3_type(self.dtype), shared)

    def scalars(self, name, value, count):
        """Warp array of scalars, shape [count], from one number or [count]."""
        if isinstance(value, (wp.array, wp.indexedarray)):
            return self._from_warp(name, value, self.dtype, count)
        return self._upload(host_scalars(name, value, count), self.dtype)

    def _upload(self, array, warp_type, shared=False):
        array = np.ascontiguousarray(array, dtype=name_of(self.dtype))
        return wp.array(array, dtype=warp_type, device=self.device, copy=not shared)

    def _most(self, farthest) -> float:
        return float(np.finfo(name_of(self.dtype)).max) if farthest is None else farthest

    def _check_size(self, name, array, farthest, least):
        """Raise ``InputError`` where the largest absolute value of an array is out of range, or is no number."""
        size = max(float(array.max(initial=0.0)), -float(array.min(initial=0.0)))  # both are NaN if one is
        if least <= size <= self._most(farthest) or size == 0.0:
            return
        if np.isnan(size):
            raise InputError(f"{name}: contains NaN (row {int(np.argwhere(np.isnan(array))[0, 0])})")
        if size < least:
            raise InputError(f"{name}: all below {least:g}, the largest is {size:g}, {hint(self.dtype)}")
        row = int(np.argwhere(np.abs(array) == size)[0, 0])
        if size > self._most(None):
            raise InputError(f"{name}: not finite in {name_of(self.dtype)} (row {row})")
        where = f"{name}: {size:g} m from the origin (row {row})"
        if farthest not in (FARTHEST[self.dtype], REFERENCE_FARTHEST[self.dtype]):
            raise InputError(f"{where}, with balls of this size at most {farthest:g} m; shift the origin")
        raise InputError(f"{where}, at most {farthest:g} m {hint(self.dtype)}")

    def _from_warp(self, name, array, warp_type, count):
        """Warp array of a type, from one of its shape that may be strided, indexed or of another scalar type."""
        if array.ndim != 1 or (count is not None and array.shape[0] != count):
            wanted = f"[{'n' if count is None else count}] of {warp_type.__name__}"
            raise InputError(shape_message(name, wanted, array) + f" of {array.dtype.__name__}")
        if array.device != self.device:
            raise InputError(f"{name}: lives on {array.device}, not on {self.device}")
        array = array.contiguous()
        if wp.types.types_equal(array.dtype, warp_type):
            return array
        convertible = _NUMBERS if warp_type is self.dtype else (wp.types.vector(3, scalar) for scalar in _NUMBERS)
        if not any(wp.types.types_equal(array.dtype, one) for one in convertible):
            raise InputError(f"{name}: cannot convert {array.dtype.__name__} to {warp_type.__name__}")
        cast = wp.empty(array.shape[0], dtype=warp_type, device=self.device)
        wp.utils.array_cast(in_array=array, out_array=cast)
        return cast


def _within(array, least: float, most: float) -> bool:
    """Whether a reduction on a GPU tells that the largest absolute value of an array of vectors is in range."""
    if not (array.shape[0] and array.device.is_cuda):
        return False
    square = norm_squared(array)  # of the largest, at least, and at most so many times that
    return 3.0 * array.shape[0] * least**2 < square < math.inf and math.sqrt(square) <= most


def resolve_kind(first, dtype: str, device) -> Kind:
    """Decide device, scalar type and kind of result from the first array argument, ``dtype`` and ``device``."""
    warp_out = isinstance(first, (wp.array, wp.indexedarray))
    if device is None and warp_out:
        device = first.device
    return Kind(resolve_device(device), resolve_dtype(dtype), warp_out)
