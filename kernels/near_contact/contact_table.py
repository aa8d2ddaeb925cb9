"""The near-contact model's constants, and its table of two equal balls, by gap and permeabilities. NumPy, no Warp."""

from functools import cache
from pathlib import Path

import numpy as np

RANGE = 3.0
"""Distance [mean radii] beyond which sources and dipoles have no short-range part."""
QUADRUPOLE_REACH = (2.8, 3.3)
"""Distance [mean radii] over which quadrupoles fade."""
REACH = max(RANGE, QUADRUPOLE_REACH[1])
"""Distance [mean radii] of the farthest near pair."""
QUADRUPOLE_OVERLAP = (0.0, 0.15)
"""Overlap [mean radii] over which they fade: nearer than contact they would induce each other without end."""
CONTACT_GAP = (0.4, 0.8)
"""Gap [radii] over which the pair's part fades."""
SMALLEST_GAP = 0.01
"""Gap [radii] at which forces are largest: contact solvers cannot follow them further."""
SOFTNESS = 0.03
"""Depth [radii] over which the pair's part levels off below the smallest gap."""
DEEPEST = (0.1, 0.3)
"""Overlap [radii] over which the pair's part fades: balls that deep in one another are no physical pair."""

MOST_SHARED = (0.1, 0.3)
"""Volume shared with neighbours, in volumes, over which a ball leaves the model: heaps that deep are no contacts."""
LEAST_RATIO = (0.5, 0.8)
"""Ratio of radii over which the pair's part sets in: the table is that of equal balls."""

MAGNET_REACH = (8.0, 10.0)
"""Distance [radii of a ball] over which permanent moments that act on its multipoles fade."""
MAGNET_OVERLAP = (0.1, 0.3)
"""Overlap [radii of the permanent ball] over which they fade, too."""
LEAST_MAGNET = 0.1
"""Radius [radii of the ball] that smaller permanent balls count as: on a surface a dipole pulls without bounds."""
CELL_SIZE = (0.48, 0.64)
"""Radius of a cell's ball [radii of the ball] over which it fades: nearer than that cells do not stand for a body."""
CELL_DEPTH = 0.87
"""Least distance of cells from the surface of their body, in radii of their balls; 1 in a cubic lattice."""

LOG_GAPS = (float(np.log(4.9e-4)), float(np.log(0.8)), 26)
"""Natural logarithm of gap/R: first node, last node, number of nodes."""
HARDNESSES = (0.0, 1.0, 11)
"""μr^(-1/2): first node, last node, number of nodes."""
FUNCTIONS = 14

TABLE_FILE = Path(__file__).with_name("near_contact.npy")


@cache
def table() -> np.ndarray:
    """Cubic B-spline coefficients of A to P by gap, own and other hardness, shape [gaps + 2, n + 2, n + 2, 14]."""
    return np.load(TABLE_FILE)


def hardness(susceptibility):
    """Coordinate (1 + χ)^(-1/2) of the table; 0 for an ideally permeable ball."""
    return 1.0 / np.sqrt(1.0 + np.asarray(susceptibility, float))


def b_spline(x, nodes):
    """First of four coefficients, their weights and slopes of a uniform cubic B-spline at coordinates ``x``."""
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
    """Coefficients of A to P by gap for a ball of hardness ``own`` near one of ``other``, shape [gaps + 2, 14]."""
    row, row_weights, _ = b_spline(own, HARDNESSES)
    column, column_weights, _ = b_spline(other, HARDNESSES)
    patch = table()[:, row : row + 4, column : column + 4].astype(float)
    return np.einsum("a,b,gabf->gf", row_weights, column_weights, patch)
