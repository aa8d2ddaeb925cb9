"""External field of a model that was imported from MJCF."""

import newton
import numpy as np

from warpmag.declarations.mujoco_field import external_fields, field_message
from warpmag.errors import warn_caller


def imported_field(model: newton.Model) -> np.ndarray | None:
    """Return the external field [A/m] of each world, shape [worlds, 3], from the option ``magnetic`` of MJCF, or None.

    Warns:
        UserWarning: The model has such a field.
    """
    flux = getattr(getattr(model, "mujoco", None), "magnetic", None)
    if flux is None:
        return None
    fields = external_fields(flux.numpy())
    if not fields.any():
        return None
    warn_caller(f"{field_message(fields)}; external_field= sets another")
    return fields
