"""Computes the table of the near-contact model: ``python -m bench.reference.near_contact_table``.

For two equal balls of unit radius the exact solution is reduced to sources, dipoles and, on the axis, quadrupoles. They
are driven by the potentials and fields of a conducting surface: K = M_LL − M_LH (M_HH + δ)⁻¹ M_HL. M is the matrix of
two perfect conductors in multipoles. L are these low degrees, H the higher ones, and δ_l = (2l+1)/(l(μr−1)) describes a
finite permeability. K minus the long-range part M_lr is the short-range resistance of the pair. K₂ is the part of K
that the model has without the table: no degrees beyond 2, no coupling of sources with quadrupoles. The conductance of
the pair is ΔC = (K − M_lr)⁻¹ − (K₂ − M_lr)⁻¹.
"""

import math

import numpy as np
from scipy.linalg import cho_factor, cho_solve
from scipy.special import gammaln

from bench.reference.near_contact import long_range, long_range_self
from bench.reference.spheres import sufficient_order
from warpmag.kernels.near_contact.contact_table import FUNCTIONS, HARDNESSES, LOG_GAPS, TABLE_FILE


def reduced_resistance(distance, permeabilities, m: int, highest: int, order: int, source_quadrupole=1.0) -> np.ndarray:
    """K of order m of two balls of unit radius: computed up to degree ``order``, reduced to degrees up to ``highest``.

    For m = 0 a ball has a source; its coupling to the other's quadrupole is scaled by ``source_quadrupole``.
    """
    degree = np.arange(m, order + 1)
    rows, columns = degree[:, None], degree[None, :]
    norm = -0.5 * (gammaln(degree + m + 1.0) + gammaln(degree - m + 1.0))
    size = gammaln(rows + columns + 1.0) + norm[:, None] + norm[None, :] - (rows + columns + 1.0) * math.log(distance)
    coupling = (-1.0) ** (rows + m) * np.exp(size)  # target second ball, on the +z side of the first
    if m == 0:
        coupling[0, 2] *= source_quadrupole
        coupling[2, 0] *= source_quadrupole
    system = np.block([[np.eye(len(degree)), coupling.T], [coupling, np.eye(len(degree))]])
    share = np.where(degree > highest, (2.0 * degree + 1.0) / np.maximum(degree, 1), 0.0)
    system += np.diag(np.concatenate([share / (mu - 1.0) for mu in permeabilities]))
    low = np.arange(highest + 1 - m)
    low = np.concatenate([low, len(degree) + low])
    return np.linalg.inv(cho_solve(cho_factor(system), np.eye(len(system))[:, low])[low])


def pair_conductance(distance: float, permeabilities, tolerance: float = 1e-7) -> np.ndarray:
    """Functions of the first of two balls of unit radius and given μr, in the order of the table."""
    u, g1, g2, _ = long_range(np.array(distance), 1.0, 1.0)
    # fraction of 3/d³, the coupling of a source with a quadrupole, in U_sr
    short_range = 1.0 - g2 * distance**5 / 3.0
    self_source, self_dipole = long_range_self(1.0)
    # potential of a dipole and field of a source on the axis have the radial derivative U' = g1 d
    axial = np.zeros((3, 3))
    axial[:2, :2] = [[u, -g1 * distance], [g1 * distance, -g1 - g2 * distance**2]]
    order = sufficient_order(distance, 1.0, 1.0, tolerance)
    parts = []
    for m, highest, coupling, diagonal in (
        (0, 2, axial, np.diag([self_source, self_dipole, 0.0])),
        (1, 1, np.array([[-g1]]), np.array([[self_dipole]])),
    ):
        far = np.block([[diagonal, coupling.T], [coupling, diagonal]])
        exact = reduced_resistance(distance, permeabilities, m, highest, order)
        plain = reduced_resistance(distance, permeabilities, m, highest, 2, short_range)
        parts.append(np.linalg.inv(exact - far) - np.linalg.inv(plain - far))
    x, y = parts
    dipoles = (x[0, 0], x[0, 3], x[0, 1], -x[0, 4], x[1, 1], -x[1, 4], y[0, 0], y[0, 1])
    return np.array([*dipoles, x[0, 2], x[0, 5], x[1, 2], x[1, 5], x[2, 2], x[2, 5]])


def spline_coefficients(values: np.ndarray) -> np.ndarray:
    """Coefficients of a uniform cubic B-spline with not-a-knot ends, two more than values along the first axis."""
    n = len(values)
    matrix = np.zeros((n + 2, n + 2))
    for k in range(n):
        matrix[k + 1, k : k + 3] = np.array([1.0, 4.0, 1.0]) / 6.0
    matrix[0, :5] = matrix[-1, -5:] = [1.0, -4.0, 6.0, -4.0, 1.0]
    right = np.concatenate([np.zeros_like(values[:1]), values, np.zeros_like(values[:1])])
    return np.linalg.solve(matrix, right.reshape(n + 2, -1)).reshape(n + 2, *values.shape[1:])


def make_table() -> np.ndarray:
    """The table, shape [gap nodes + 2, hardness nodes + 2, hardness nodes + 2, FUNCTIONS]."""
    gaps = np.exp(np.linspace(*LOG_GAPS))
    # a ball of μr = 1 has no higher multipoles
    permeabilities = [1e12 if y == 0.0 else min(max(y**-2.0, 1.0 + 1e-9), 1e12) for y in np.linspace(*HARDNESSES)]
    values = np.zeros((len(gaps), len(permeabilities), len(permeabilities), FUNCTIONS))
    for i, j, k in np.ndindex(values.shape[:3]):
        values[i, j, k] = pair_conductance(2.0 + gaps[i], (permeabilities[j], permeabilities[k]))
    for axis in (0, 1, 2):
        values = np.moveaxis(spline_coefficients(np.moveaxis(values, axis, 0)), 0, axis)
    return values.astype(np.float32)


if __name__ == "__main__":
    table = make_table()
    np.save(TABLE_FILE, table)
    print(f"{TABLE_FILE}: {table.shape}, {TABLE_FILE.stat().st_size / 1024:.0f} kB")
