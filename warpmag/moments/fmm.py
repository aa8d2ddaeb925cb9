"""What the fast multipole method needs to know: expansions of which degree, and cells of which size, for an error."""

import math
from functools import cache

import numpy as np

from warpmag.declarations.checks import check_token
from warpmag.declarations.magnets import METHODS
from warpmag.errors import InputError
from warpmag.kernels.fmm.evaluation import FmmSums
from warpmag.kernels.fmm.expansions import ExpansionTables
from warpmag.kernels.fmm.octree import Octree, join_moments
from warpmag.kernels.fmm.translate import displacements
from warpmag.kernels.pairs.pair_terms import Quantity
from warpmag.moments import harmonics
from warpmag.moments.ranks import ranks


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
        multipole_to_parent=harmonics.multipole_to_multipole(degree, 0),
        local_to_child=harmonics.local_to_local(degree, 0),
        multipole_to_local=np.stack([harmonics.multipole_to_local(degree, -offset) for offset in displacements()]),
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
_SLACK = 1.001
"""Part by which rounding may take moments of a body farther from each other."""
_LARGE_PART = 0.1
"""Part of all pairs from which on the method sums them where it is asked for."""
_COSTS = {
    ("cpu", Quantity.FIELD): (2.8e7, 55.0),
    ("cpu", Quantity.WRENCH): (1.0e7, 30.0),
    ("cuda", Quantity.FIELD): (9.8e8, 96.0),
    ("cuda", Quantity.WRENCH): (1.24e8, 128.0),
    ("cuda, launched", Quantity.FIELD): (2.32e9, 137.0),
    ("cuda, launched", Quantity.WRENCH): (6.8e8, 90.0),
}
"""What the method takes, in pairs that are summed in the same time: at all, and for each harmonic of each moment; on a
GPU in a graph, and where its many kernels are launched from Python.

Both ways are as fast with 8,000 moments at 1e-3 and 13,500 at 1e-5, forces with 4,600 and 8,000, on two cores; on an
H200, in a graph, with 35,500 and 44,000, forces with 17,500 and 33,000; launched, with 54,000 and 66,000, forces with
30,000 and 38,000."""


def check_fast(rtol: float):
    """Raise ``InputError`` where expansions are not made for a relative error."""
    if rtol < LEAST_RTOL:
        raise InputError(f"rtol: the fast multipole method reaches {LEAST_RTOL:g}, got {rtol:g}; use 'direct'")


def is_fast(pairs: float, count: int, quantity: Quantity, rtol: float, device, launched: bool = False) -> bool:
    """Whether the method reaches a relative error, and sooner than the sums over so many pairs of ``count`` moments.

    On a GPU that depends on whether kernels are ``launched`` from Python or by a graph.
    """
    if rtol < LEAST_RTOL:
        return False
    on_gpu = "cuda, launched" if launched else "cuda"
    alone, each = _COSTS[on_gpu if device.is_cuda else "cpu", quantity]
    return pairs >= alone + (choose_degree(rtol)[0] + 1) ** 2 * each * count


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
        extent: Distance up to which pairs must be summed one by one [m], whether they touch or not.

    """

    def __init__(self, moments, rtol: float, targets=None, worlds: int = 1, extent: float = 0.0):
        """Allocate the cells."""
        degree, held = choose_degree(rtol)
        packed, groups, self._first = moments.packed, moments.groups, 0
        reach = moments.largest_radius + (moments if targets is None else targets).largest_radius
        reach = max(reach, _SLACK * extent)
        if targets is not None:  # moments of no strength among the others
            self._first = moments.count
            packed, groups = join_moments(moments, targets)
        self._tables = expansion_tables(degree)
        self._octree = Octree(packed, groups, worlds, occupancy=held, reach=reach)

    def build(self):
        """Launch the making of the cells, for moments that have moved."""
        self._octree.build()

    def sums(self, quantity: Quantity, sources=None) -> FmmSums | None:
        """Sums of a quantity, of some ``sources`` only (see :class:`FmmSums`); None for those of none."""
        if sources is not None and not sources.any():
            return None
        return FmmSums(self._octree, self._tables, quantity, self._first, sources, ranks())


class SystemSums(FastSums):
    """Sums over pairs of the moments of a system, those of a part of them only where that is better.

    Args:
        moments: Packed moments, at least one.
        rtol: Relative error wanted.
        worlds: Number of worlds.
        extent: Distance up to which pairs must be summed one by one [m].
        crowding: Moments of a leaf over those that are wanted.
        always_from: Fewest pairs for which the method is to be used even if it is slower.
    """

    def __init__(self, moments, rtol: float, worlds: int, extent: float, crowding: float, always_from: float):
        """Allocate the cells."""
        super().__init__(moments, rtol, worlds=worlds, extent=extent)
        self._costs = moments.count, rtol, moments.device
        self._crowding, self._always_from = crowding, always_from

    def serves(self, quantity: Quantity, pairs: float) -> bool:
        """Whether so many pairs of a target and a source are to be summed by the method.

        Few are not: one by one they are summed sooner, and without an error that counts where nothing is near, as in
        the field of a few magnets at many balls.
        """
        count, rtol, device = self._costs
        kind = Quantity.FIELD if quantity == Quantity.FIELD else Quantity.WRENCH
        return pairs >= self._always_from or is_fast(pairs / self._crowding, count, kind, rtol, device)

    def sums_of(self, quantity: Quantity, pairs: float, sources=None) -> FmmSums | None:
        """Sums as :meth:`sums` has them; None where so many pairs are better summed one by one."""
        return self.sums(quantity, sources) if self.serves(quantity, pairs) else None


class NoFastSums:
    """What stands for :class:`SystemSums` where all pairs are summed."""

    def build(self):
        """Do nothing."""

    def sums_of(self, quantity: Quantity, pairs: float, sources=None) -> None:
        """Return nothing."""

    def serves(self, quantity: Quantity, pairs: float) -> bool:
        """Return False."""
        return False


def fast_sums_for(method: str, moments, layout, extent: float | None, rtol: float) -> SystemSums | NoFastSums:
    """Cells for the sums of an induction solve and of its forces, none where all pairs are summed.

    Moments of a body exert no force on each other. Expansions do not tell bodies apart, so that the moments of one that
    may move have to be near each other: in cells that are neighbours.

    Args:
        method: One of ``magnets.METHODS``.
        moments: Packed moments.
        layout: What each of them is (``layout.MomentLayout``).
        extent: Largest distance between moments of a body that may move [m]; None means not known.
        rtol: Relative error of the magnetization that is wanted.

    Raises:
        InputError: The method is wanted where it cannot be had.
    """
    check_token("method", method, METHODS)
    several, rtol = layout.movable & ~layout.alone, _PART_OF_FIELD * rtol
    known = extent is not None or not several.any()
    if method == "fmm":
        check_fast(rtol)
        if not known:
            body = layout.bodies[several.argmax()]
            raise InputError(f"method: 'fmm' has to know the extent of body {body}, which has several moments")
    worlds, extent = layout.ranges(), extent or 0.0
    counts = np.diff([0, *(end for _, _, end in worlds)])
    pairs = counts @ counts
    crowding = _crowding(layout.radii, max(2.0 * moments.largest_radius, extent), rtol)
    forces = counts[layout.worlds] @ layout.movable
    of_fields = (counts[layout.worlds] @ ~layout.permanent, Quantity.FIELD)
    better = any(
        is_fast(which / crowding, moments.count, quantity, rtol, moments.device)
        for which, quantity in (of_fields, (forces, Quantity.WRENCH))
    )
    if not moments.count or method == "direct" or (method == "auto" and not (known and better)):
        return NoFastSums()
    always_from = _LARGE_PART * pairs if method == "fmm" else math.inf
    return SystemSums(moments, rtol, len(worlds), extent, crowding, always_from)


def _crowding(radii: np.ndarray, reach: float, rtol: float) -> float:
    """Moments in a leaf as large as it has to be [m] where they touch, over as many as are wanted; at least 1."""
    usual = float(np.median(radii)) if len(radii) else 0.0
    held = (0.5 * reach / usual) ** 3 if usual > 0.0 else 0.0
    return max(1.0, held / choose_degree(max(rtol, LEAST_RTOL))[1])
