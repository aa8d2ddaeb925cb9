"""Constants of the near-contact model, and its table of two equal balls by gap and permeabilities. NumPy, no Warp."""

from functools import cache
from pathlib import Path

import numpy as np

RANGE = 3.0  # distance [mean radii] beyond which sources and dipoles have no short-range part
QUADRUPOLE_REACH = (2.8, 3.3)  # distance [mean radii] over which quadrupoles fade
REACH = max(RANGE, QUADRUPOLE_REACH[1])  # distance [mean radii] of the farthest near pair
QUADRUPOLE_OVERLAP = (0.0, 0.15)
"""Overlap [mean radii] over which quadrupoles fade: at deeper overlaps their mutual induction diverges."""
CONTACT_GAP = (0.4, 0.8)  # gap [radii] over which the conductance of a pair fades
SMALLEST_GAP = 0.01  # gap [radii] below which forces do not grow: contact solvers cannot resolve smaller gaps
SOFTNESS = 0.03  # depth [radii] over which the conductance of a pair levels off below the smallest gap
DEEPEST = (0.1, 0.3)
"""Overlap [radii] over which the conductance of a pair fades: balls that overlap so deeply are not physical."""

MOST_SHARED = (0.1, 0.3)
"""Overlap volume with neighbors [ball volumes] over which a ball leaves the model: such heaps are not physical."""
LEAST_RATIO = (0.5, 0.8)  # ratio of radii over which the conductance of a pair sets in: the table is for equal balls

MAGNET_REACH = (8.0, 10.0)
"""Distance [radii of a ball] over which the effect of permanent moments on its multipoles fades."""
MAGNET_OVERLAP = (0.1, 0.3)  # overlap [radii of the permanent ball] over which that effect fades
LEAST_MAGNET = 0.1
"""Least radius of a permanent ball [radii of the ball]: the force of a point dipole on a surface would diverge."""
CELL_SIZE = (0.48, 0.64)
"""Radius of a cell [radii of the ball] over which its effect fades: larger cells do not represent their body."""
CELL_DEPTH = 0.87  # least distance of cells from the surface of their body [radii of their balls]; 1 in a cubic lattice

LOG_GAPS = (float(np.log(4.9e-4)), float(np.log(0.8)), 26)
"""Natural logarithm of gap/R: first node, last node, number of nodes."""
HARDNESSES = (0.0, 1.0, 11)  # μr^(-1/2): first node, last node, number of nodes
FUNCTIONS = 14

TABLE_FILE = Path(__file__).with_name("near_contact.npy")


@cache
def table() -> np.ndarray:
    """Return the cubic B-spline coefficients of A to P by gap and hardnesses, shape [gaps + 2, n + 2, n + 2, 14]."""
    return np.load(TABLE_FILE)


def hardness(susceptibility):
    """Return the table's coordinate (1 + χ)^(-1/2); 0 for an ideally permeable ball."""
    return 1.0 / np.sqrt(1.0 + np.asarray(susceptibility, float))


def b_spline(x, nodes):
    """Return the first of four coefficients, and their weights and slopes, of a uniform cubic B-spline at ``x``."""
    first, last, count = nodes
    scale = (count - 1) / (last - first)
    x = np.clip((np.asarray(x, float) - first) * scale, 0.0, count - 1.0)
    base = np.minimum(x.astype(int), count - 2)
    t = x - base
    weights = np.stack([(1 - t) ** 3, 3 * t**3 - 6 * t**2 + 4, -3 * t**3 + 3 * t**2 + 3 * t + 1, t**3], -1) / 6.0
    slopes = scale * np.stack([-((1 - t) ** 2), 3 * t**2 - 4 * t, -3 * t**2 + 2 * t + 1, t**2], -1) / 2.0
    return base, weights, slopes


@cache
def gap_table(own: float, other: float) -> np.ndarray:
    """Return the coefficients of A to P by gap for balls of hardnesses ``own`` and ``other``, shape [gaps + 2, 14]."""
    row, row_weights, _ = b_spline(own, HARDNESSES)
    column, column_weights, _ = b_spline(other, HARDNESSES)
    patch = table()[:, row : row + 4, column : column + 4].astype(float)
    return np.einsum("a,b,gabf->gf", row_weights, column_weights, patch)
