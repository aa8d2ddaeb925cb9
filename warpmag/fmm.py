"""What the fast multipole method needs to know: expansions of which degree, and cells of which size, for an error."""

from functools import cache

import numpy as np

from warpmag import harmonics
from warpmag.kernels.fmm.evaluation import CellSums
from warpmag.kernels.fmm.expansions import ExpansionTables
from warpmag.kernels.fmm.grid import MomentGrid, join_moments
from warpmag.kernels.fmm.translate import displacements
from warpmag.kernels.pairs.pair_terms import Quantity


@cache
def expansion_tables(degree: int) -> ExpansionTables:
    """Numbers of the harmonics up to a degree."""
    n, m = harmonics.degrees(degree).astype(float), np.abs(harmonics.orders(degree)).astype(float)
    root = np.sqrt(np.maximum((n + m) * (n - m), 1.0))
    along = np.where(m > 1.0, np.sqrt(np.maximum(2.0 * m - 1.0, 0.0) / np.maximum(2.0 * m, 1.0)), 1.0)
    growth = np.where(n > m, (2.0 * n - 1.0) / root, along)
    decay = np.sqrt(np.maximum((n + m - 1.0) * (n - m - 1.0), 0.0)) / root
    return ExpansionTables(
        degree=degree,
        growth=growth,
        decay=decay,
        derivatives=harmonics.derivatives(degree),
        up=harmonics.multipole_to_multipole(degree, 0),
        down=harmonics.local_to_local(degree, 0),
        across=np.stack([harmonics.multipole_to_local(degree, -offset) for offset in displacements()]),
        parity=harmonics.parity(degree),
    )


_DEGREES = ((1e-2, 5, 50), (1e-3, 8, 57), (1e-4, 11, 90), (1e-5, 15, 125))
"""Relative error, degree of the expansions, and moments of a leaf that are fastest with them."""
USUAL_RTOL = 1e-3
LEAST_RTOL = _DEGREES[-1][0]
"""Smallest relative error that expansions are made for."""


def choose_degree(rtol: float) -> tuple[int, int]:
    """Degree of the expansions for a relative error, and moments of a leaf."""
    return next((degree, held) for error, degree, held in _DEGREES if rtol >= error)


def make_sums(quantity: Quantity, moments, rtol: float, targets=None) -> CellSums:
    """Sums over pairs of moments, for ``pairs.evaluate.PairEvaluation``, their cells made.

    Args:
        quantity: What is summed.
        moments: Packed moments (``pairs.packing.PackedMoments``), at least one.
        rtol: Relative error wanted, at least ``LEAST_RTOL``.
        targets: Packed targets; None means the moments themselves.
    """
    degree, held = choose_degree(rtol)
    packed, groups, first = moments.packed, moments.groups, 0
    reach = moments.largest_radius + (moments if targets is None else targets).largest_radius
    if targets is not None:  # moments of no strength among the others
        first = moments.count
        packed, groups = join_moments(moments, targets)
    grid = MomentGrid(packed, groups, occupancy=held, reach=reach)
    grid.build()
    return CellSums(grid, expansion_tables(degree), quantity, first)
