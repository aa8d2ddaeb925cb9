"""Sums over pairs for one-shot calls on arrays: on a CPU what a call allocates and records serves the next one like it.

To make all of that afresh takes a millisecond, as long as a core sums two thousand moments.
"""

import os
from collections import OrderedDict
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass

import warp as wp

from warpmag.kernels.fmm.evaluation import FmmSums
from warpmag.kernels.pairs.evaluate import REFERENCE, PairEvaluation
from warpmag.kernels.pairs.packing import PackedMoments
from warpmag.kernels.pairs.pair_terms import Quantity
from warpmag.kernels.shared.team import MOST_THREADS, threads_for
from warpmag.moments.arrays import vec3_type
from warpmag.moments.fmm import FastSums
from warpmag.moments.ranks import ranks

_MOST_KEPT, _MOST_MOMENTS_KEPT = 4, 40_000
"""Sums that are kept, and the most moments and targets of one: half a kilobyte each."""
_kept: "OrderedDict[SumsShape, PairSums]" = OrderedDict()


@dataclass(frozen=True)
class SumsShape:
    """What sums are made for.

    Attributes:
        quantity: What is summed, ``FIELD`` or ``WRENCH``.
        device: Its alias in Warp.
        dtype: Warp scalar type.
        count: Number of moments.
        radius: Their largest radius [m].
        target_count: Number of targets; None means the moments themselves.
        target_radius: Largest radius of the targets [m].
        reference: Whether the plain loop is to be used.
        smoothing: Length [m] of the paper's smoothing.
    """

    quantity: Quantity
    device: str
    dtype: type
    count: int
    radius: float
    target_count: int | None = None
    target_radius: float = 0.0
    reference: bool = False
    smoothing: float = 0.0


class PairSums:
    """Buffers and launches of sums over all pairs of targets and moments.

    Attributes:
        moments: The packed moments.
        targets: The packed targets, the same object if they are the moments.
        base: Field [A/m] to start from, or that turns moments, too, shape [targets]; zero.
        out: Field [A/m] or forces [N], shape [targets].
        torques: Torques [N·m], with ``WRENCH``, shape [targets].
    """

    def __init__(self, shape: SumsShape):
        """Allocate; radii are zero."""
        self.threads = _threads()

        def packed(count, radius):
            radii = wp.zeros(count, dtype=shape.dtype, device=shape.device)
            return PackedMoments(radii, largest_radius=radius, moving=False)

        self.moments = self.targets = packed(shape.count, shape.radius)
        if shape.target_count is not None:
            self.targets = packed(shape.target_count, shape.target_radius)
        count = self.targets.count
        self.base, self.out = (wp.zeros(count, dtype=vec3_type(shape.dtype), device=shape.device) for _ in range(2))
        self.torques = turned = None
        if shape.quantity == Quantity.WRENCH:
            self.torques, turned = wp.zeros_like(self.out), wp.ones(count, dtype=int, device=shape.device)
        self._turned, self._shape, self._all_pairs = turned, shape, None

    def launch(self, fmm_rtol: float | None = None) -> None:
        """Launch the sums of what is packed; the plain loop finds overlapping pairs by itself.

        Args:
            fmm_rtol: Relative error to sum by the fast multipole method; None means over all pairs.
        """
        others = None if self.targets is self.moments else self.targets
        if not self._shape.reference:
            self.targets.find_overlaps(None if others is None else self.moments)
        if fmm_rtol is not None:  # its cells are of these places
            fast = FastSums(self.moments, fmm_rtol, others)
            fast.build()
            self._evaluation(fast.sums(self._shape.quantity)).launch()
            return
        if self._all_pairs is None:
            self._all_pairs = self._evaluation()
        self._all_pairs.launch()

    def _evaluation(self, sums: FmmSums | None = None) -> PairEvaluation:
        shape, count = self._shape, self.targets.count
        return PairEvaluation(
            shape.quantity, [(0, count, 0, shape.count)], self.targets, self.moments, self.base, self.out,
            turned=self._turned, torques=self.torques, form=REFERENCE if shape.reference else None,
            smoothing=shape.smoothing, sums=sums, ranks=ranks(),
        )  # fmt: skip


@contextmanager
def pair_sums(shape: SumsShape) -> Iterator[PairSums]:
    """Sums of a shape for a call; results are to be copied, unless it fails the next call overwrites them."""
    sums = _kept.pop(shape, None)  # so that calls of several threads never share one
    if sums is None or sums.threads != _threads():
        sums = PairSums(shape)
    yield sums
    if shape.device == "cpu" and shape.count + (shape.target_count or 0) <= _MOST_MOMENTS_KEPT:
        _kept[shape] = sums
        while len(_kept) > _MOST_KEPT:
            _kept.popitem(last=False)


def _threads() -> int:
    """Most threads that launches recorded now may use."""
    return threads_for(MOST_THREADS, 1)


if hasattr(os, "register_at_fork"):
    os.register_at_fork(after_in_child=_kept.clear)  # the threads that launches were recorded with
