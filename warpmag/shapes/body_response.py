"""Response of a body to a residual of its magnetization, as a whole: the inverse of its own operator.

An induction solve compares the reduced field g of each moment with its dual variable s (``kernels/induction``). A
lone body of χ = ∞, far from saturation, is solved by s + Q (g − s) with Q = (1 − 3 T V)⁻¹. Here 3 is the initial slope
k of a ball, T are the tensors between the body's cells, and V their volumes. Among other bodies, Q takes the slow modes
of the body itself out of the iteration.
"""

import numpy as np

from warpmag.shapes.demagnetization import Coupling
from warpmag.shapes.lattice import Lattice
from warpmag.shapes.uniform_response import cell_matrix

MOST_CELLS = 1000
"""Largest number of cells of a body with a response: a table of 18 MB. That of 722 cells takes 1 s and 9.4 MB."""
_SLOPE = 3.0
"""Initial slope k = 3χ/(3 + χ) of a ball of χ = ∞."""
_SHIFT = 0.01
"""Number added to all eigenvalues before the inversion, because those of sheets and of loops of magnetization are below
0.001. With 0.03 a lone plate of χ = ∞ takes 1.5 times as many evaluations, with 0.001 one of χ = 300 1.3 times."""
_POWERS = 30
"""Products with a vector that give the largest eigenvalue, to some percent."""


def residual_response(coupling: Coupling) -> tuple[np.ndarray, float]:
    """Return Q − 1 between the cells of a body, in its frame, and its largest eigenvalue.

    The elements are the upper halves of float32, rounded to nearest, shape [n, 3, n, 3], type uint16.
    """
    volumes = 4.0 / 3.0 * np.pi * coupling.radii**3
    root = np.sqrt(volumes)
    cells = cell_matrix(coupling, Lattice(coupling.positions, volumes, np.zeros(len(root), int)))
    shared = (root[:, None, None, None] * coupling.common[:, None] * root[:, None]).reshape(cells.shape)
    unit = np.eye(len(cells))
    change = np.linalg.inv(unit + _SLOPE * (cells - shared - unit / 3.0) + _SHIFT * unit) - unit
    scale = np.repeat(root, 3)
    response = (change * scale / scale[:, None]).astype(np.float32).reshape(len(root), 3, len(root), 3)
    bits = response.view(np.uint32)
    return ((bits + 0x7FFF + (bits >> 16 & 1)) >> 16).astype(np.uint16), _largest_eigenvalue(change)


def _largest_eigenvalue(matrix: np.ndarray) -> float:
    """Return the largest eigenvalue of a symmetric matrix, by the power method."""
    vector, norm = np.random.default_rng(0).normal(size=len(matrix)), 0.0
    for _ in range(_POWERS):
        vector = matrix @ vector
        norm = float(np.linalg.norm(vector))
        vector /= norm
    return norm
