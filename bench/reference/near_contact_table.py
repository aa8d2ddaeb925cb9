"""Writes the table of the near-contact model: ``python -m bench.reference.near_contact_table``.

For two equal balls of unit radius the exact solution is reduced to sources and dipoles, driven by potentials and
fields that a conducting surface would have: K = M_LL − M_LH (M_HH + δ)⁻¹ M_HL, where M is the matrix of two perfect
conductors in multipoles, H the degrees from 2 up, and δ_l = (2l+1)/(l(μr−1)) what a finite permeability adds. Less the
long-range part this is the short-range resistance of the pair, and with the short-range matrix M_sr of sources and
dipoles alone, the pair's conductance is ΔC = (K − M_lr)⁻¹ − M_sr⁻¹.
"""

import math

import numpy as np
from scipy.linalg import cho_factor, cho_solve
from scipy.special import gammaln

from bench.reference.spheres import sufficient_order
from warpmag import near_contact


def reduced_resistance(distance: float, permeabilities, m: int, tolerance: float = 1e-7) -> np.ndarray:
    """K of two balls of unit radius for order m, sources and dipoles (m = 0) or dipoles (m = 1) of both balls."""
    order = sufficient_order(distance, 1.0, 1.0, tolerance)
    degree = np.arange(m, order + 1)
    rows, columns = degree[:, None], degree[None, :]
    norm = -0.5 * (gammaln(degree + m + 1.0) + gammaln(degree - m + 1.0))
    size = gammaln(rows + columns + 1.0) + norm[:, None] + norm[None, :] - (rows + columns + 1.0) * math.log(distance)
    coupling = (-1.0) ** (rows + m) * np.exp(size)  # target second ball, on the +z side of the first
    system = np.block([[np.eye(len(degree)), coupling.T], [coupling, np.eye(len(degree))]])
    share = np.where(degree > 1, (2.0 * degree + 1.0) / np.maximum(degree, 1), 0.0)
    system += np.diag(np.concatenate([share / (mu - 1.0) for mu in permeabilities]))
    low = np.concatenate([np.arange(2 - m), len(degree) + np.arange(2 - m)])
    return np.linalg.inv(cho_solve(cho_factor(system), np.eye(len(system))[:, low])[low])


def pair_conductance(distance: float, permeabilities) -> np.ndarray:
    """The functions A to H of the first of two balls of unit radius and given μr."""
    u, g1, g2, _ = near_contact.long_range(np.array(distance), 1.0, 1.0)
    self_source, self_dipole = near_contact.long_range_self(1.0)
    axial, across = g1 + g2 * distance**2, g1
    # potential of a dipole and field of a source on the axis have the radial derivative U' = g1 d
    long = np.array([[u, -g1 * distance], [g1 * distance, -axial]])
    parts = []
    for m, coupling, own in (
        (0, long, np.diag([self_source, self_dipole])),
        (1, np.array([[-across]]), np.array([[self_dipole]])),
    ):
        d = distance
        dipoles = np.array([[1.0 / d, 1.0 / d**2], [-1.0 / d**2, -2.0 / d**3]]) if m == 0 else np.array([[1.0 / d**3]])
        plain = np.block([[np.eye(2 - m), dipoles.T], [dipoles, np.eye(2 - m)]])
        far = np.block([[own, coupling.T], [coupling, own]])
        parts.append(np.linalg.inv(reduced_resistance(distance, permeabilities, m) - far) - np.linalg.inv(plain - far))
    x, y = parts
    return np.array([x[0, 0], x[0, 2], x[0, 1], -x[0, 3], x[1, 1], -x[1, 3], y[0, 0], y[0, 1]])


def spline_coefficients(values: np.ndarray) -> np.ndarray:
    """Uniform cubic B-spline coefficients, two more than values along the first axis; not-a-knot ends."""
    n = len(values)
    matrix = np.zeros((n + 2, n + 2))
    for k in range(n):
        matrix[k + 1, k : k + 3] = np.array([1.0, 4.0, 1.0]) / 6.0
    matrix[0, :5] = matrix[-1, -5:] = [1.0, -4.0, 6.0, -4.0, 1.0]
    right = np.concatenate([np.zeros_like(values[:1]), values, np.zeros_like(values[:1])])
    return np.linalg.solve(matrix, right.reshape(n + 2, -1)).reshape(n + 2, *values.shape[1:])


def make_table() -> np.ndarray:
    """The table, shape [gap nodes + 2, hardness nodes + 2, hardness nodes + 2, 8]."""
    gaps = np.exp(np.linspace(*near_contact.LOG_GAPS))
    permeabilities = [math.inf if y == 0.0 else y**-2.0 for y in np.linspace(*near_contact.HARDNESSES)]
    values = np.zeros((len(gaps), len(permeabilities), len(permeabilities), near_contact.FUNCTIONS))
    for i, gap in enumerate(gaps):
        for j, own in enumerate(permeabilities):
            for k, other in enumerate(permeabilities):
                # a ball of μr = 1 has no higher multipoles
                soft = [min(max(mu, 1.0 + 1e-9), 1e12) for mu in (own, other)]
                values[i, j, k] = pair_conductance(2.0 + gap, soft)
    for axis in (0, 1, 2):
        values = np.moveaxis(spline_coefficients(np.moveaxis(values, axis, 0)), 0, axis)
    return values.astype(np.float32)


if __name__ == "__main__":
    table = make_table()
    np.save(near_contact.TABLE_FILE, table)
    print(f"{near_contact.TABLE_FILE}: {table.shape}, {near_contact.TABLE_FILE.stat().st_size / 1024:.0f} kB")
