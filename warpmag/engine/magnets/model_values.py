"""Detects changes of ``model.warpmag`` after ``Magnetics`` was built.

Magnetizations are read in every substep. All other attributes are copied once, into buffers, tables and lattices. The
kernel that gathers moments detects changes on the device. The host raises the error. With a GPU it does so some calls
later, because it does not wait.
"""

from typing import Any

import newton
import numpy as np
import warp as wp

from warpmag.declarations.attributes import NAMESPACE
from warpmag.declarations.magnets import CURVES
from warpmag.engine.magnets.attributes import MAGNET_ATTRIBUTES, NO_MAGNET
from warpmag.errors import InputError
from warpmag.kernels.rigid.bodies import ShapeMagnets

_COMPARED = {row.field: row for row in MAGNET_ATTRIBUTES if row.model_change != "substep"}
"""Attributes with changes that are detected, the fields of ``ShapeMagnets``."""
_MATERIAL = [name for name, row in _COMPARED.items() if row.model_change == "notified"]
"""Attributes that may change after a notification; the others determine the moments and their solver."""
_MODEL_ARRAYS = (
    *("body_q", "body_com", "body_flags"),
    *("shape_body", "shape_type", "shape_transform", "shape_scale", "shape_world"),
)
"""Further arrays of a model that determine its magnets. Meshes determine them, too."""


def magnetic_arrays(model: newton.Model) -> dict[str, Any]:
    """Return the arrays that determine the magnets of ``model`` and their forces, by name for messages."""
    meshes = [getattr(mesh, "vertices", None) for mesh in model.shape_source[: model.shape_count]]
    arrays = {name: getattr(model, name) for name in _MODEL_ARRAYS} | {"shape_source": meshes}
    attributes = vars(getattr(model, NAMESPACE)).items()
    arrays |= {f"{NAMESPACE}.{name}": values for name, values in attributes if isinstance(values, wp.array)}
    return {f"model.{name}": values for name, values in arrays.items()}


class ModelValues:
    """The ``present`` attributes of a model's magnets, and copies of what ``Magnetics`` last read of them, ``used``.

    On the device, ``changed`` is 1 + the index of a changed shape, or 0, shape [1].
    """

    def __init__(self, model: newton.Model, *, measured: bool):
        """Copy the values of ``model``; ``measured`` means that one measured curve replaces all curves."""
        self._model, self._measured = model, measured
        self.present, self.used = ShapeMagnets(), ShapeMagnets()
        for name in _COMPARED:
            array = getattr(getattr(model, NAMESPACE), name)
            setattr(self.present, name, array)
            setattr(self.used, name, wp.clone(array))
        self.changed = wp.zeros(1, dtype=wp.int32, device=model.device)
        self._changed_on_host = self.changed
        if self.changed.device.is_cuda:
            self._changed_on_host = wp.zeros(1, dtype=wp.int32, device="cpu", pinned=True)

    def check(self, *, wait: bool) -> None:
        """Raise :class:`InputError` if the model has changed. Without ``wait`` a later call may raise the error."""
        device = self.changed.device
        if self._changed_on_host is not self.changed:
            if device.is_capturing:  # the host cannot read here; the flag stays set on the device
                return
            wp.copy(self._changed_on_host, self.changed)
            if wait:
                wp.synchronize_stream(device.stream)
        if shape := int(self._changed_on_host.numpy()[0]):
            name = next((name for name in _COMPARED if (shape - 1) in self._differing(name)), _MATERIAL[0])
            raise InputError(
                f"{self._model.shape_label[shape - 1]}: model.{NAMESPACE}.{name} was changed, call "
                "notify_model_changed() of its Magnetics"
            )

    def _differing(self, name: str) -> np.ndarray:
        """Return the magnetic shapes with a changed value of one attribute."""
        present, used = getattr(self.present, name).numpy(), getattr(self.used, name).numpy()
        is_magnet = (self.present.kind.numpy() != NO_MAGNET) | (name == "kind")
        return np.flatnonzero((present != used) & is_magnet)

    def changed_materials(self) -> np.ndarray:
        """Return the shapes with a changed material; raise :class:`InputError` if the change is not possible."""
        labels = self._model.shape_label
        for name, row in _COMPARED.items():
            for shape in self._differing(name).tolist():
                subject = f"{labels[shape]}: {NAMESPACE}.{name}"
                if name not in _MATERIAL:
                    raise InputError(f"{subject} was changed, and its Magnetics cannot follow: make another")
                if self._measured or self.present.curve.numpy()[shape] >= len(CURVES):
                    raise InputError(f"{subject} was changed, but a measured curve determines it")
                assert row.check is not None, "only tokens have no check"
                row.check(subject, float(getattr(self.present, name).numpy()[shape]))
        return np.unique(np.concatenate([self._differing(name) for name in _MATERIAL]))

    def material(self, shapes) -> tuple[np.ndarray, np.ndarray]:
        """Return the present saturations [A/m] and susceptibilities of shapes."""
        saturation, susceptibility = (
            getattr(self.present, name).numpy()[shapes].astype(float) for name in ("saturation", "susceptibility")
        )
        return saturation, susceptibility

    def persistent_arrays(self) -> dict[str, wp.array]:
        """Return the arrays of changeable attributes by name, for a checkpoint."""
        return {
            f"{when}.{name}": getattr(getattr(self, when), name) for when in ("present", "used") for name in _MATERIAL
        }

    def accept_changes(self) -> None:
        """Copy the present values of the model, and clear :attr:`changed`."""
        for name in _COMPARED:
            wp.copy(getattr(self.used, name), getattr(self.present, name))
        self.changed.zero_()
        self._changed_on_host.zero_()
