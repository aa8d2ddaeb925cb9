"""What the fast multipole method needs to know: expansions of which degree, and cells of which size, for an error."""

from functools import cache

import numpy as np

from warpmag import harmonics
from warpmag.errors import InputError
from warpmag.kernels.fmm.evaluation import CellSums
from warpmag.kernels.fmm.expansions import ExpansionTables
from warpmag.kernels.fmm.grid import MomentGrid, join_moments
from warpmag.kernels.fmm.translate import displacements
from warpmag.kernels.pairs.pair_terms import Quantity
from warpmag.magnets import check_token


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


_DEGREES = (
    (1e-2, 5, 57), (3e-3, 6, 57), (1e-3, 8, 57), (3e-4, 9, 57), (1e-4, 10, 70), (3e-5, 12, 90), (1e-5, 14, 100),
)  # fmt: skip
"""Relative error, degree of the expansions, and moments of a leaf. The largest errors of fields and forces that were
measured with them are a third to four fifths of that: of random and aligned moments in boxes and in balls, in
equilibrium and near saturation, in a shell, a chain and two clumps far apart."""
USUAL_RTOL = 1e-3
LEAST_RTOL = _DEGREES[-1][0]
"""Smallest relative error that expansions are made for."""


_PART_OF_FIELD = 0.3
"""Error of a field over that of the magnetization that it is for."""
SUMS_OF_SOLVES = ("auto", "vectorized", "fmm")
"""How an induction solve sums pairs."""
_COSTS = {
    ("cpu", Quantity.FIELD): (2.8e7, 55.0),
    ("cpu", Quantity.WRENCH): (1.0e7, 30.0),
    ("cuda", Quantity.FIELD): (8.7e8, 70.0),
    ("cuda", Quantity.WRENCH): (7.0e8, 55.0),
}
"""What the method takes, in pairs that are summed in the same time: for itself, and for each harmonic of each moment.
On two cores both ways are as fast with 8,000 moments at 1e-3 and 13,500 at 1e-5, forces with 4,600 and 8,000."""


def check_fast(rtol: float):
    """Raise ``InputError`` where expansions are not made for a relative error."""
    if rtol < LEAST_RTOL:
        raise InputError(f"rtol: the fast multipole method reaches {LEAST_RTOL:g}, got {rtol:g}; use 'vectorized'")


def is_fast(pairs: float, count: int, quantity: Quantity, rtol: float, device) -> bool:
    """Whether the method reaches a relative error, and sooner than the sums over so many pairs of ``count`` moments."""
    if rtol < LEAST_RTOL:
        return False
    alone, each = _COSTS["cuda" if device.is_cuda else "cpu", quantity]
    return pairs >= alone + each * (choose_degree(rtol)[0] + 1) ** 2 * count


def choose_degree(rtol: float) -> tuple[int, int]:
    """Degree of the expansions for a relative error, and moments of a leaf."""
    return next((degree, held) for error, degree, held in _DEGREES if rtol >= error)


class FastSums:
    """Cells of moments, and sums over pairs of them for ``pairs.evaluate.PairEvaluation``.

    Args:
        moments: Packed moments (``pairs.packing.PackedMoments``), at least one.
        rtol: Relative error wanted, at least ``LEAST_RTOL``.
        targets: Packed targets; None means the moments themselves.
        worlds: Number of worlds.

    """

    def __init__(self, moments, rtol: float, targets=None, worlds: int = 1):
        """Allocate the cells."""
        degree, held = choose_degree(rtol)
        packed, groups, self._first = moments.packed, moments.groups, 0
        reach = moments.largest_radius + (moments if targets is None else targets).largest_radius
        if targets is not None:  # moments of no strength among the others
            self._first = moments.count
            packed, groups = join_moments(moments, targets)
        self._tables = expansion_tables(degree)
        self._grid = MomentGrid(packed, groups, worlds, occupancy=held, reach=reach)

    def build(self):
        """Launch the making of the cells, for moments that have moved."""
        self._grid.build()

    def sums(self, quantity: Quantity, sources=None) -> CellSums | None:
        """Sums of a quantity, of some ``sources`` only (see :class:`CellSums`); None for those of none."""
        if sources is not None and not sources.any():
            return None
        return CellSums(self._grid, self._tables, quantity, self._first, sources)


class NoFastSums:
    """What stands for :class:`FastSums` where all pairs are summed."""

    def build(self):
        """Do nothing."""

    def sums(self, quantity: Quantity, sources=None) -> None:
        """Return nothing."""


def fast_sums_for(method: str, moments, bodies, rtol: float, ranges) -> FastSums | NoFastSums:
    """Cells for the fields of an induction solve, none where all pairs are summed.

    Args:
        method: One of ``SUMS_OF_SOLVES``.
        moments: Packed moments.
        bodies: Body of each moment.
        rtol: Relative error of the magnetization that is wanted.
        ranges: For each world the first of its moments, the first that is no target, and the end, integers [worlds, 3].

    Raises:
        InputError: The method is wanted where it cannot be had.
    """
    check_token("method", method, SUMS_OF_SOLVES)
    alone, rtol = len(np.unique(bodies)) == len(bodies), _PART_OF_FIELD * rtol
    if method == "fmm":
        check_fast(rtol)
        if not alone:
            raise InputError("method: 'fmm' is not for bodies of several moments")
    begin, targets_end, end = np.reshape(ranges, (-1, 3)).T.astype(float)
    pairs, count, device = ((targets_end - begin) @ (end - begin)), moments.count, moments.device
    better = method == "auto" and alone and is_fast(pairs, count, Quantity.FIELD, rtol, device)
    return FastSums(moments, rtol, worlds=len(end)) if (better or method == "fmm") and count else NoFastSums()
