"""Arrays in and out: NumPy or Warp, checked once, returned in the kind they came in."""

from dataclasses import dataclass

import numpy as np
import warp as wp

from warpmag.errors import InputError

DTYPES = {"float32": wp.float32, "float64": wp.float64}
RADIUS_RANGE = {wp.float32: (5e-8, 2e4), wp.float64: (0.0, np.inf)}
"""Smallest and largest radius [m] of a ball by Warp scalar type: neither r⁻⁵ nor products of moments may overflow."""


def check_radii(name: str, radii: np.ndarray, dtype):
    """Raise :class:`InputError` where a radius [m] is negative, or out of range of the Warp scalar type ``dtype``."""
    if not (radii >= 0.0).all():
        raise InputError(f"{name}: must not be negative, got {radii.min()}")
    least, most = RADIUS_RANGE[dtype]
    outside = (radii > 0.0) & ((radii < least) | (radii > most))
    if outside.any():
        first = radii[outside].flat[0]
        raise InputError(f"{name}: must be {least:g} to {most:g} m in float32, got {first:g}; use float64")


def vec3_type(dtype):
    """Three-vector of a Warp scalar type."""
    return wp.vec3 if dtype is wp.float32 else wp.vec3d


def resolve_dtype(dtype: str):
    """Warp scalar type of ``"float32"`` or ``"float64"``."""
    if dtype not in DTYPES:
        raise InputError(f"dtype: {dtype!r} is not one of {', '.join(DTYPES)}")
    return DTYPES[dtype]


def resolve_device(device):
    """Warp device of a name, a device or None (Warp's default); ``InputError`` where there is no such device."""
    try:
        return wp.get_device(device)
    except Exception as error:  # Warp raises RuntimeError or ValueError, with long texts
        available = ", ".join(d.alias for d in wp.get_devices())
        raise InputError(f"device: no {device!r} here; available: {available}") from error


@dataclass(frozen=True)
class Kind:
    """Where a call computes and what it returns: device, scalar type, NumPy or Warp."""

    device: object
    dtype: type
    warp_out: bool

    def finish(self, array, count=None):
        """Return a Warp array, or its first ``count`` entries, as the caller's kind."""
        if count is not None:
            # Warp refuses an empty slice
            array = array[:count] if count else wp.empty(0, dtype=array.dtype, device=array.device)
        return array if self.warp_out else array.numpy()

    def vectors(self, name, value, count=None):
        """Warp array of three-vectors, shape [n], from [n, 3] or, with ``count``, from one vector for all."""
        if isinstance(value, wp.array):
            return self._from_warp(name, value, vec3_type(self.dtype), count)
        array = np.asarray(value, dtype=np.float64)
        if count is not None and array.shape == (3,):
            array = np.broadcast_to(array, (count, 3))
        if array.ndim != 2 or array.shape[1] != 3 or (count is not None and len(array) != count):
            wanted = "[n, 3]" if count is None else f"[3] or [{count}, 3]"
            raise InputError(f"{name}: shape must be {wanted}, got {list(array.shape)}")
        return self._upload(name, array, vec3_type(self.dtype))

    def scalars(self, name, value, count):
        """Warp array of scalars, shape [count], from one number or [count]."""
        if isinstance(value, wp.array):
            return self._from_warp(name, value, self.dtype, count)
        array = np.asarray(value, dtype=np.float64)
        if array.shape not in ((), (count,)):
            raise InputError(f"{name}: shape must be [] or [{count}], got {list(array.shape)}")
        return self._upload(name, np.broadcast_to(array, (count,)), self.dtype)

    def _upload(self, name, array, warp_type):
        if np.isnan(array).any():
            raise InputError(f"{name}: contains NaN (row {int(np.argwhere(np.isnan(array))[0, 0])})")
        scalar = np.float32 if self.dtype is wp.float32 else np.float64
        with np.errstate(over="ignore"):
            cast = np.ascontiguousarray(array, dtype=scalar)
        if np.isinf(cast).any():
            raise InputError(f"{name}: not finite in {scalar.__name__} (row {int(np.argwhere(np.isinf(cast))[0, 0])})")
        return wp.array(cast, dtype=warp_type, device=self.device)

    def _from_warp(self, name, array, warp_type, count):
        if array.ndim != 1 or (count is not None and array.shape[0] != count):
            raise InputError(f"{name}: shape must be [{'n' if count is None else count}], got {list(array.shape)}")
        if array.device != self.device:
            raise InputError(f"{name}: lives on {array.device}, not on {self.device}")
        if wp.types.types_equal(array.dtype, warp_type):
            return array.contiguous()
        cast = wp.empty(array.shape[0], dtype=warp_type, device=self.device)
        try:
            wp.utils.array_cast(in_array=array, out_array=cast)
        except Exception as error:
            raise InputError(f"{name}: cannot convert {array.dtype.__name__} to {warp_type.__name__}") from error
        return cast


def resolve_kind(first, dtype: str, device) -> Kind:
    """Decide device, scalar type and kind of result from the first array argument, ``dtype`` and ``device``."""
    warp_out = isinstance(first, wp.array)
    if device is None and warp_out:
        device = first.device
    return Kind(resolve_device(device), resolve_dtype(dtype), warp_out)
