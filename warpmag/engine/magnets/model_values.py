"""Notices when a model says something else about its magnets than when they were taken from it.

Magnetizations are read again in every substep. What else ``model.warpmag`` holds is made into buffers, tables and
lattices once. A change of it is seen on the device, where moments are gathered, and told on the host, which on a GPU
does not wait for the device to ask.
"""

from typing import Any

import newton
import numpy as np
import warp as wp

from warpmag.declarations.magnets import CURVES, check_material
from warpmag.engine.magnets.attributes import NAMESPACE, NO_MAGNET
from warpmag.errors import InputError
from warpmag.kernels.rigid.bodies import ShapeMagnets

_MATERIAL = ("saturation", "susceptibility")
"""What can be taken over; the others decide which moments there are, and what they are computed by."""
_NAMES = ("kind", *_MATERIAL, "curve", "recoil_permeability", "moment_spacing", "conductivity")
_PLACES = (
    *("body_q", "body_com", "body_flags"),
    *("shape_body", "shape_type", "shape_transform", "shape_scale", "shape_world"),
)
"""What else of a model decides about its magnets, besides meshes."""


def contents(model: newton.Model) -> dict[str, Any]:
    """Return what decides about the magnets of ``model`` and the forces on them, by names that messages have for it."""
    own = {name: one for name, one in vars(getattr(model, NAMESPACE)).items() if isinstance(one, wp.array)}
    meshes = [getattr(one, "vertices", None) for one in model.shape_source]
    values = {name: getattr(model, name) for name in _PLACES} | {"shape_source": meshes}
    values |= {f"{NAMESPACE}.{name}": one for name, one in own.items()}
    return {f"model.{name}": one for name, one in values.items()}


class ModelValues:
    """What one model says about magnets now, and what it said when it was last looked at.

    Attributes:
        now, then: Both, for the kernels.
        changed: A shape that has changed, plus one, or 0, on the device, shape [1].
    """

    def __init__(self, model: newton.Model, *, measured: bool):
        """Take the values of ``model``; ``measured`` tells whether one measured curve is that of all magnets."""
        self._model, self._measured = model, measured
        self.now, self.then = ShapeMagnets(), ShapeMagnets()
        for name in _NAMES:
            setattr(self.now, name, self._array(name))
            setattr(self.then, name, wp.clone(self._array(name)))
        self.changed = wp.zeros(1, dtype=wp.int32, device=model.device)
        self._seen = self.changed
        if self.changed.device.is_cuda:
            self._seen = wp.zeros(1, dtype=wp.int32, device="cpu", pinned=True)

    def _array(self, name: str) -> Any:
        return getattr(getattr(self._model, NAMESPACE), name)

    def check(self, *, wait: bool) -> None:
        """Refuse to go on with a model that has changed.

        Args:
            wait: Wait for the device to say so. Otherwise a change may be told later.

        Raises:
            InputError: It has.
        """
        device = self.changed.device
        if self._seen is not self.changed:
            if device.is_capturing:  # nobody could be told; the device remembers
                return
            wp.copy(self._seen, self.changed)
            if wait:
                wp.synchronize_stream(device.stream)
        if shape := int(self._seen.numpy()[0]):
            name = next((one for one in _NAMES if (shape - 1) in self._differing(one)), _MATERIAL[0])
            raise InputError(
                f"{self._model.shape_label[shape - 1]}: model.{NAMESPACE}.{name} was changed, call "
                "notify_model_changed() of its Magnetics"
            )

    def _differing(self, name: str) -> np.ndarray:
        """Shapes of which the model says something else under ``name`` than it said then."""
        now, then = getattr(self.now, name).numpy(), getattr(self.then, name).numpy()
        magnet = (self.now.kind.numpy() != NO_MAGNET) | (name == "kind")
        return np.flatnonzero((now != then) & magnet)

    def changed_materials(self) -> np.ndarray:
        """Return the shapes whose material has changed, once they are sound.

        Raises:
            InputError: A material is out of range, or something else has changed.
        """
        labels = self._model.shape_label
        for name in _NAMES:
            for shape in self._differing(name).tolist():
                where = f"{labels[shape]}: {NAMESPACE}.{name}"
                if name not in _MATERIAL:
                    raise InputError(
                        f"{where} was changed, and this Magnetics keeps what it was made with: make another"
                    )
                if self._measured or self.now.curve.numpy()[shape] >= len(CURVES):
                    raise InputError(f"{where} was changed, and a measured curve says what it is")
                value = float(getattr(self.now, name).numpy()[shape])
                check_material(where, value, infinite=name == "susceptibility")
        return np.unique(np.concatenate([self._differing(name) for name in _MATERIAL]))

    def material(self, shapes) -> tuple[np.ndarray, np.ndarray]:
        """Return saturations [A/m] and susceptibilities of shapes as the model has them now."""
        saturation, susceptibility = (getattr(self.now, name).numpy()[shapes].astype(float) for name in _MATERIAL)
        return saturation, susceptibility

    def carried(self) -> dict[str, wp.array]:
        """Return the arrays of what can be changed, by name."""
        return {f"{when}.{name}": getattr(getattr(self, when), name) for when in ("now", "then") for name in _MATERIAL}

    def take(self) -> None:
        """Take the values that the model has now."""
        for name in _NAMES:
            wp.copy(getattr(self.then, name), getattr(self.now, name))
        self.changed.zero_()
        self._seen.zero_()
