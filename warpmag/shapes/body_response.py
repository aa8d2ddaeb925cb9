"""Response of a small body to a residual of its magnetization, as a whole: the inverse of its own operator.

An induction solve compares the reduced field g of each moment with its dual variable s (``kernels/induction``). A
lone body of χ = ∞, far from saturation, is solved by s + Q (g − s) with Q = (1 − 3 T V)⁻¹. Here 3 is the initial slope
k of a ball, T are the tensors between the body's cells, and V their volumes. Among other bodies, Q takes the slow modes
of the body itself out of the iteration.
"""

import numpy as np

from warpmag.shapes.demagnetization import Coupling
from warpmag.shapes.lattice import Lattice
from warpmag.shapes.uniform_response import cell_matrix

MOST_CELLS = 64
"""Largest number of cells of a body with a response: a matrix of 150 kB. That of 729 cells takes 19 MB."""
_SLOPE = 3.0
"""Initial slope k = 3χ/(3 + χ) of a ball of χ = ∞."""
_LEAST = 0.03
"""Lower bound of the eigenvalues that are inverted. Those of letters of 5 to 24 cells are above 0.06."""


def residual_response(coupling: Coupling) -> tuple[np.ndarray, float]:
    """Return Q − 1 between the cells of a body, in its frame, shape [n, 3, n, 3], and its largest eigenvalue."""
    volumes = 4.0 / 3.0 * np.pi * coupling.radii**3
    root = np.sqrt(volumes)
    cells = cell_matrix(coupling, Lattice(coupling.positions, volumes, np.zeros(len(root), int)))
    shared = (root[:, None, None, None] * coupling.common[:, None] * root[:, None]).reshape(cells.shape)
    unit = np.eye(len(cells))
    values, vectors = np.linalg.eigh(unit + _SLOPE * (cells - shared - unit / 3.0))
    gains = 1.0 / np.maximum(values, _LEAST) - 1.0
    scale = np.repeat(root, 3)
    response = (vectors * gains) @ vectors.T * scale / scale[:, None]
    return response.reshape(len(root), 3, len(root), 3), float(gains.max())
