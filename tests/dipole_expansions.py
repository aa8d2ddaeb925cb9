"""Expansions of dipoles in a box: multipoles from their moments, fields from local expansions, in float64."""

import numpy as np

from warpmag.moments import harmonics


def regular_gradients(degree: int, points) -> np.ndarray:
    """Gradients of the regular harmonics at points [n, 3], shape [n, K, 3]."""
    return np.einsum("cij,nj->nic", harmonics.derivatives(degree), harmonics.regular(degree, points))


def dipole_to_multipole(degree: int, points, moments) -> np.ndarray:
    """Coefficients q [A·m²], shape [K], of dipoles [A·m²] at points relative to the box's center in edges, [n, 3]."""
    return np.einsum("nic,nc->i", regular_gradients(degree, points), np.asarray(moments, np.float64))


def local_to_field(local, points) -> np.ndarray:
    """4π h³ H [A·m²], shape [n, 3], of coefficients L [A·m²] at points relative to the box's center in edges h."""
    degree = int(np.sqrt(len(local))) - 1
    return -np.einsum("nic,i->nc", regular_gradients(degree, points), np.asarray(local, np.float64))
