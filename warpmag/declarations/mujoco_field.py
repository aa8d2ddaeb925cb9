"""MuJoCo's magnetic flux as an external field."""

import numpy as np
import numpy.typing as npt

from warpmag.declarations.curves import MU0

ATTRIBUTE = "mjc:option:magnetic"
"""USD attribute of a PhysicsScene that holds the option ``magnetic`` of MJCF."""
_DEFAULT = (0.0, -0.5, 0.0)
"""MuJoCo's default flux. It counts as not given: MuJoCo only has it for magnetometers."""


def external_fields(flux: npt.ArrayLike) -> np.ndarray:
    """Return the applied field H0 = B/μ0 [A/m] of MuJoCo's flux B [T], shape [n, 3]; 0 for MuJoCo's default."""
    b = np.asarray(flux, dtype=float).reshape(-1, 3)
    return np.where(np.isclose(b, _DEFAULT, atol=1e-6).all(axis=1, keepdims=True), 0.0, b / MU0)


def field_message(fields: np.ndarray) -> str:
    """Return a sentence that an imported flux became an external field, for the fields of all worlds [A/m]."""
    strongest = fields[np.argmax(np.linalg.norm(fields, axis=1))]
    flux, field = (f"({', '.join(f'{value:.4g}' for value in vector)})" for vector in (MU0 * strongest, strongest))
    return f"the option magnetic of MuJoCo, {flux} T, becomes the external field, {field} A/m"
