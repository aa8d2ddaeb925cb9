"""Checks on the host that models, states and controls of a caller fit together.

Kernels do not check bounds: they would read and write beyond the end of an array of the wrong size. The checks compare
types, sizes and devices, never values. They do not wait for the device, and a captured graph does not contain them.
"""

from collections.abc import Iterable
from typing import Any

import newton
import warp as wp

from warpmag.declarations.attributes import NAMESPACE
from warpmag.declarations.checks import check_positive, short_repr
from warpmag.errors import InputError
from warpmag.moments.arrays import check_warp_array

_MODEL_NAMES = {"body_f": "body_qd"}
"""Name of the model's array of equal size for arrays of a state that a model does not have."""
_INITIAL = ("body_q", "body_qd", "shape_type", "shape_scale", "shape_world", "shape_flags")
_READ = (
    *("body_com", "body_flags", "body_world", "body_inertia", "body_inv_mass", "body_inv_inertia"),
    *("shape_body", "shape_transform"),
)
"""Arrays of a model over bodies or shapes: those read once, and those that kernels read in every call."""


class HeldArrays:
    """The arrays that an object holds, to detect that a program put other arrays in their place."""

    def __init__(self, label: str, owner: Any, names: Iterable[str] | None = None):
        """Remember the arrays ``names`` of ``owner``, by default all; messages begin with ``label``."""
        self._label, self._owner = label, owner
        names = [name for name, value in vars(owner).items() if isinstance(value, wp.array)] if names is None else names
        self.arrays = {name: getattr(owner, name) for name in names}

    def check(self) -> None:
        """Raise :class:`InputError` if an array was replaced: kernels and captured graphs use the earlier one."""
        for name, array in self.arrays.items():
            if getattr(self._owner, name) is not array:
                raise InputError(f"{self._label}: {name} is another array than before; write into it with assign()")


def held_by_model(model: Any) -> list[HeldArrays]:
    """Return the arrays of a model that kernels read in every call.

    Raises:
        InputError: ``model`` is not a Newton model, or an array does not have the model's number of bodies or shapes.
    """
    if not isinstance(model, newton.Model):
        raise InputError(f"model: must be a newton.Model, got {short_repr(model)}")
    held, counts = [HeldArrays("model", model, _READ)], {"body": model.body_count, "shape": model.shape_count}
    arrays = held[0].arrays | {name: getattr(model, name) for name in _INITIAL}
    sizes = [(f"model: {name}", array, counts[name.partition("_")[0]]) for name, array in arrays.items()]
    if attributes := getattr(model, NAMESPACE, None):
        held.append(HeldArrays(f"model.{NAMESPACE}", attributes))
        sizes += [(f"model.{NAMESPACE}: {name}", array, model.shape_count) for name, array in held[1].arrays.items()]
    for name, array, count in sizes:
        if count:
            check_warp_array(name, array, None, model.device, (count,))
    return held


def check_state(state: Any, model: newton.Model, *names: str) -> None:
    """Raise :class:`InputError` unless the arrays ``names`` of ``state`` fit the bodies and particles of ``model``."""
    if not isinstance(state, newton.State):
        raise InputError(f"state: must be a newton.State, got {short_repr(state)}")
    for name in names:
        own: Any = getattr(model, _MODEL_NAMES.get(name, name))
        if own is not None and own.size:
            check_warp_array(f"state: {name}", getattr(state, name), own.dtype, own.device, own.shape)


def check_duration(dt: float | None, sharing: wp.array | None, device: Any) -> None:
    """Raise :class:`InputError` unless ``dt`` and its factor ``sharing`` on ``device`` are right or None."""
    if dt is not None:
        check_positive("dt", dt)
    if sharing is not None:
        check_warp_array("sharing", sharing, wp.int32, device, (1,))


def check_control(control: Any, model: newton.Model) -> None:
    """Raise :class:`InputError` unless ``control`` fits ``model``."""
    if not isinstance(control, newton.Control):
        raise InputError(f"control: must be a newton.Control, got {short_repr(control)}")
    for name, own in vars(model.control()).items():
        if isinstance(own, wp.array):
            check_warp_array(f"control: {name}", getattr(control, name, None), own.dtype, own.device, own.shape)
