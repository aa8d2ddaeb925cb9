"""Setup of the fast multipole method: degree of expansions, size of boxes, and the choice against direct sums."""

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
from warpmag.kernels.pairs.pair_law import Quantity
from warpmag.moments import harmonics
from warpmag.moments.ranks import current_ranks

_DEGREES = (
    (1e-2, 5, 57), (3e-3, 6, 57), (1e-3, 8, 57), (3e-4, 9, 57), (1e-4, 10, 70), (3e-5, 12, 90), (1e-5, 14, 100),
)  # fmt: skip
"""Relative error, degree of the expansions, and moments of a leaf box. The largest measured errors of fields and forces
are a third to four fifths of the relative error. The cases are random and aligned moments in boxes and balls, in
equilibrium and near saturation. Others are moments in a shell, a chain and two distant clumps."""
DEFAULT_RTOL = 1e-3
"""Relative error of the method ``fmm`` if the caller gives none."""
LEAST_RTOL = _DEGREES[-1][0]
"""Smallest relative error that the expansions reach."""
_FIELD_SHARE = 0.3
"""Relative error of a field, over the relative error of the magnetization computed from it."""
_SLACK = 1.001
"""Factor on the extent of a body, because rounding of poses may move moments apart."""
_LARGE_SHARE = 0.1
"""The method ``fmm`` sums by multipoles from this share of all pairs on, even if direct sums are faster."""
_COSTS = {
    ("cpu", Quantity.FIELD): (2.8e7, 55.0),
    ("cpu", Quantity.WRENCH): (1.0e7, 30.0),
    ("cuda", Quantity.FIELD): (9.8e8, 96.0),
    ("cuda", Quantity.WRENCH): (1.24e8, 128.0),
    ("cuda, launched", Quantity.FIELD): (2.32e9, 137.0),
    ("cuda, launched", Quantity.WRENCH): (6.8e8, 90.0),
}
"""Time of the method, as the number of pairs that direct sums compute in that time: a constant, plus a number per
harmonic and moment. On a GPU ``launched`` means kernels launched from Python instead of by a graph.

Smallest numbers of moments for which the method is faster, at a relative error of 1e-3 and of 1e-5:

==========================  ================  ================
device                      fields            forces
==========================  ================  ================
CPU, two cores              8,000 and 13,500  4,600 and 8,000
H200, in a graph            35,500 and 44,000 17,500 and 33,000
H200, launched from Python  54,000 and 66,000 30,000 and 38,000
==========================  ================  ================
"""


@cache
def expansion_tables(degree: int) -> ExpansionTables:
    """Return the coefficient tables of the harmonics up to a degree."""
    n, m = harmonics.degrees(degree).astype(float), np.abs(harmonics.orders(degree)).astype(float)
    root = np.sqrt(np.maximum((n + m) * (n - m), 1.0))
    sectoral = np.where(m > 1.0, np.sqrt(np.maximum(2.0 * m - 1.0, 0.0) / np.maximum(2.0 * m, 1.0)), 1.0)
    growth = np.where(n > m, (2.0 * n - 1.0) / root, sectoral)
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


def check_fast(rtol: float, share: float = 1.0):
    """Raise ``InputError`` if expansions cannot reach a ``share`` of the relative error ``rtol``."""
    least = math.ceil(1e6 * LEAST_RTOL / share - 1e-6) / 1e6
    if rtol < least:
        raise InputError(f"rtol: the fast multipole method reaches {least:g}, got {rtol:g}; use 'direct'")


def is_fast(pairs: float, count: int, quantity: Quantity, rtol: float, device, launched: bool = False) -> bool:
    """Return True if the method reaches ``rtol`` and is faster than direct sums of ``FIELD`` or ``WRENCH``.

    ``pairs`` counts pairs of a target and a moment, ``count`` moments and targets. ``launched`` means that Python
    launches the kernels on a GPU, which is slower than a graph.
    """
    if rtol < LEAST_RTOL:
        return False
    on_gpu = "cuda, launched" if launched else "cuda"
    constant, per_harmonic = _COSTS[on_gpu if device.is_cuda else "cpu", quantity]
    return pairs >= constant + (choose_degree(rtol)[0] + 1) ** 2 * per_harmonic * count


def choose_degree(rtol: float) -> tuple[int, int]:
    """Return the degree of the expansions for a relative error, and the number of moments of a leaf box."""
    return next((degree, occupancy) for error, degree, occupancy in _DEGREES if rtol >= error)


class FastSums:
    """Octree of boxes that hold moments, and sums over pairs for ``pairs.evaluate.PairEvaluation``."""

    def __init__(self, moments, rtol: float, targets=None, worlds: int = 1, extent: float = 0.0):
        """Allocate boxes for packed moments, at least one, and packed targets; None means the moments themselves.

        Overlapping pairs, and all pairs up to a distance ``extent`` [m], are summed one by one.
        """
        degree, occupancy = choose_degree(rtol)
        packed, groups, self._first = moments.packed, moments.groups, 0
        reach = moments.largest_radius + (moments if targets is None else targets).largest_radius
        reach = max(reach, _SLACK * extent)
        if targets is not None:  # the targets join the moments, with a moment of 0
            self._first = moments.count
            packed, groups = join_moments(moments, targets)
        self._tables = expansion_tables(degree)
        self._octree = Octree(packed, groups, worlds, occupancy=occupancy, reach=reach)

    def build(self):
        """Launch the sorting of moments into boxes, after they have moved."""
        self._octree.build()

    def sums(self, quantity: Quantity, acting: np.ndarray | None = None) -> FmmSums | None:
        """Return sums of a quantity over the moments that ``acting`` marks (None: all), or None if it marks none."""
        if acting is not None and not acting.any():
            return None
        return FmmSums(self._octree, self._tables, quantity, self._first, acting, current_ranks())


class SystemSums(FastSums):
    """Sums over pairs of a system's moments, by multipoles where that is faster.

    ``rtol`` is the relative error of the fields.
    """

    def __init__(self, moments, rtol: float, worlds: int, extent: float, crowding: float, always_from: float):
        """Allocate the boxes. Leaf boxes hold ``crowding`` times the optimal number of moments.

        ``always_from`` is the smallest number of pairs that multipoles sum even if they are slower.
        """
        super().__init__(moments, rtol, worlds=worlds, extent=extent)
        self.rtol, self._costs = rtol, (moments.count, rtol, moments.device)
        self._crowding, self._always_from = crowding, always_from

    def uses_multipoles(self, quantity: Quantity, pairs: float) -> bool:
        """Return True if multipoles sum this number of pairs of a target and an acting moment.

        Few pairs are summed one by one, which is faster. It also avoids an error that is relatively large if no moment
        is near, as in the field of a few magnets at many balls.
        """
        count, rtol, device = self._costs
        kind = Quantity.FIELD if quantity == Quantity.FIELD else Quantity.WRENCH
        return pairs >= self._always_from or is_fast(pairs / self._crowding, count, kind, rtol, device)

    def sums_of(self, quantity: Quantity, pairs: float, acting: np.ndarray | None = None) -> FmmSums | None:
        """Return :meth:`sums`, or None if this number of pairs is summed one by one."""
        return self.sums(quantity, acting) if self.uses_multipoles(quantity, pairs) else None


class NoFastSums:
    """Replacement of :class:`SystemSums` for systems that sum all pairs one by one."""

    rtol = None

    def build(self):
        """Do nothing."""

    def sums_of(self, quantity: Quantity, pairs: float, acting=None) -> None:
        """Return None."""

    def uses_multipoles(self, quantity: Quantity, pairs: float) -> bool:
        """Return False."""
        return False


def fast_sums_for(method: str, moments, layout, extent: float | None, rtol: float) -> SystemSums | NoFastSums:
    """Return the sums of an induction solve and of its forces.

    Moments of a body exert no force on each other, but expansions cannot distinguish bodies. The moments of a movable
    body must therefore be in neighboring boxes, because pairs of neighboring boxes are summed one by one. ``extent`` is
    the largest distance between two of them [m], None if unknown; ``rtol`` is the error of the magnetization.
    """
    check_token("method", method, METHODS)
    share_body = layout.movable & ~layout.single
    extent_known = extent is not None or not share_body.any()
    if method == "fmm":
        check_fast(rtol, _FIELD_SHARE)
        if not extent_known:
            body = layout.bodies[share_body.argmax()]
            raise InputError(f"method: 'fmm' needs body_extent, because the movable body {body} has several moments")
    rtol *= _FIELD_SHARE
    counts, copies, extent = np.bincount(layout.worlds), layout.copies, extent or 0.0
    pairs = copies * (counts @ counts)
    crowding = _crowding(layout.radii, max(2.0 * moments.largest_radius, extent), rtol)
    forces = copies * (counts[layout.worlds] @ layout.movable)
    fields = copies * (counts[layout.worlds] @ ~layout.permanent)
    is_faster = any(
        is_fast(number / crowding, moments.count, quantity, rtol, moments.device)
        for number, quantity in ((fields, Quantity.FIELD), (forces, Quantity.WRENCH))
    )
    if not moments.count or method == "direct" or (method == "auto" and not (extent_known and is_faster)):
        return NoFastSums()
    always_from = _LARGE_SHARE * pairs if method == "fmm" else math.inf
    return SystemSums(moments, rtol, copies * len(counts), extent, crowding, always_from)


def _crowding(radii: np.ndarray, reach: float, rtol: float) -> float:
    """Return the number of touching moments in the smallest possible leaf box, over the optimal number; at least 1.

    A leaf box is at least as long as ``reach`` [m], so that all near pairs are in neighboring boxes.
    """
    radius = float(np.median(radii)) if len(radii) else 0.0
    occupancy = (0.5 * reach / radius) ** 3 if radius > 0.0 else 0.0
    return max(1.0, occupancy / choose_degree(max(rtol, LEAST_RTOL))[1])
