"""Worlds of a model that start again: their mask, and arrays whose rows return to earlier values."""

from typing import Any

import newton
import numpy as np
import numpy.typing as npt
import warp as wp

from warpmag.declarations.attributes import NAMESPACE
from warpmag.declarations.checks import short_repr
from warpmag.errors import InputError
from warpmag.kernels.rigid.worlds import choose, complete_mask, restore_rows
from warpmag.moments.arrays import check_warp_array


class WorldMask:
    """A mask of the worlds of a model on its device, with Newton's last entry for everything outside all worlds.

    Attributes:
        array: The mask, shape [worlds + 1].
    """

    def __init__(self, model: newton.Model):
        """Allocate the mask."""
        self._count, self._device = max(model.world_count, 1), wp.get_device(model.device)
        self.array = wp.zeros(self._count + 1, dtype=wp.bool, device=self._device)

    def set(self, worlds: Any) -> None:
        """Set the mask; capturable in a graph with an array on the device.

        Args:
            worlds: True for each chosen world, shape [worlds], or [worlds + 1] with Newton's last entry. A Warp array
                of bool, a tensor that supports DLPack, NumPy's bools or a list of bools. None chooses everything.

        Raises:
            InputError: The mask has another type or shape, or is on another device.
        """
        if worlds is None:
            self.array.fill_(True)
            return
        complete_mask(self._on_device(worlds), self.array)

    def _on_device(self, worlds: Any) -> wp.array:
        if not isinstance(worlds, wp.array | np.ndarray) and hasattr(worlds, "__dlpack__"):
            worlds = _from_dlpack(worlds)
        if not isinstance(worlds, wp.array):
            try:
                values = np.asarray(worlds)
            except Exception:  # a ragged list, or an object that fails to become an array
                values = np.zeros(0)
            if values.dtype != bool:
                raise InputError(f"worlds: must be a mask of bools, one for each world, got {short_repr(worlds)}")
            worlds = wp.array(values, dtype=wp.bool, device=self._device)
        if worlds.shape != (self._count + 1,):
            check_warp_array("worlds", worlds, wp.bool, self._device, (self._count,))
        check_warp_array("worlds", worlds, wp.bool, self._device)
        return worlds


def _from_dlpack(tensor: Any) -> wp.array:
    """Return the memory of a tensor of bools as a Warp array; another tensor raises :class:`InputError`."""
    try:
        array: Any = wp.from_dlpack(tensor)
    except Exception as error:  # Warp and the tensor's library raise errors of many types
        raise InputError(f"worlds: {' '.join(str(error).split())}") from None
    if array.dtype is wp.uint8 and "bool" in str(tensor.dtype):
        array = wp.array(ptr=array.ptr, dtype=wp.bool, shape=array.shape, device=array.device, deleter=None)
        array.tensor = tensor  # keeps the memory alive
    return array


class WorldRows:
    """An array over the objects of a model, and a copy of it from which the rows of worlds return."""

    def __init__(self, array: wp.array, worlds: npt.ArrayLike | wp.array):
        """Copy the values of a contiguous array.

        ``worlds`` are the worlds of its rows, -1 for outside all, shape [rows]. A Warp array is not copied.
        """
        self._rows = _bytes_of(array)
        self._saved = wp.clone(self._rows)
        on_device = isinstance(worlds, wp.array)
        self._worlds = worlds if on_device else wp.array(worlds, dtype=wp.int32, device=array.device)
        self._array = array  # ``_rows`` is a view of its memory

    def restore(self, mask: WorldMask) -> None:
        """Launch a reset of the rows of chosen worlds."""
        restore_rows(mask.array, self._worlds, self._saved, self._rows)


class WorldStart:
    """Values of the magnets of a model that return where worlds start again."""

    def __init__(self, model: newton.Model, worlds: wp.array, external_field: wp.array, moment_worlds: wp.array):
        """Copy the present values.

        Args:
            model: The model.
            worlds: Newton's numbers of the worlds with magnets, on the device.
            external_field: External field of each moment.
            moment_worlds: Newton's number of each moment's world, on the device.
        """
        attributes, shape_worlds = getattr(model, NAMESPACE), model.shape_world.numpy()[: model.shape_count]
        self._mask = WorldMask(model)
        self._worlds = worlds
        self._chosen = wp.zeros_like(self._worlds)
        self._values = [
            WorldRows(attributes.magnetization, shape_worlds),
            WorldRows(attributes.strength, shape_worlds),
            WorldRows(attributes.voltage, shape_worlds),
            WorldRows(external_field, moment_worlds),
        ]

    def restore(self, worlds: Any) -> tuple[WorldMask, wp.array]:
        """Launch a reset of the values of ``worlds``, as of :meth:`WorldMask.set`.

        Returns:
            The mask, and 1 for each of the system's worlds that starts again, else 0, shape [worlds of the system].
        """
        self._mask.set(worlds)
        for rows in self._values:
            rows.restore(self._mask)
        choose(self._mask.array, self._worlds, self._chosen)
        return self._mask, self._chosen


def _bytes_of(array: wp.array) -> wp.array:
    """Return the memory of a contiguous array as bytes, shape [rows, bytes of a row]."""
    assert array.is_contiguous, "rows need contiguous memory"
    width = array.size // array.shape[0] * wp.types.type_size_in_bytes(array.dtype)
    return wp.array(ptr=array.ptr, dtype=wp.uint8, shape=(array.shape[0], width), device=array.device)
