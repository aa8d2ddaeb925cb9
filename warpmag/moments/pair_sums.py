"""Sums over pairs for calls on arrays. Buffers and recorded launches are cached for the next call of the same shape.

The cache is for CPUs only. Making the buffers takes a millisecond, as long as a core sums the field of 2000 moments.
"""

import os
from collections import OrderedDict
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass

import numpy as np
import warp as wp

from warpmag.kernels.fmm.evaluation import FmmSums
from warpmag.kernels.pairs.evaluate import REFERENCE, PairEvaluation
from warpmag.kernels.pairs.packing import PackedMoments
from warpmag.kernels.pairs.pair_law import Quantity
from warpmag.kernels.shared.team import MOST_THREADS, threads_for
from warpmag.moments.arrays import vec3_type
from warpmag.moments.fmm import FastSums
from warpmag.moments.ranks import current_ranks

_MOST_CACHED, _MOST_CACHED_MOMENTS = 4, 40_000
"""Largest number of cached sums, and of moments and targets of each; a moment takes half a kilobyte."""
_cache: "OrderedDict[SumsShape, PairSums]" = OrderedDict()


@dataclass(frozen=True)
class SumsShape:
    """Shape and options of sums, the key of the cache."""

    quantity: Quantity  # ``FIELD``, ``WRENCH``, or ``FORCE`` on targets
    device: str  # alias of the Warp device
    dtype: type  # Warp scalar type
    count: int  # number of moments
    radius: float  # largest radius of the moments [m]
    target_count: int | None = None  # number of targets; None means the moments themselves
    target_radius: float = 0.0  # largest radius of the targets [m]
    reference: bool = False  # the plain loop computes the sums
    smoothing: float = 0.0  # smoothing length [m] of Kim and Han 2022, section 5


@dataclass(frozen=True)
class BallMoments:
    """Moments of balls on one device, or the moments that stand for other vectors at their positions."""

    positions: wp.array  # centers [m], shape [n]
    moments: wp.array  # moments [A·m²], shape [n]
    radii: wp.array | None  # radii [m], shape [n]; None means point dipoles
    largest_radius: float  # [m]

    @property
    def count(self) -> int:
        """Number of moments n."""
        return self.positions.shape[0]

    def pack(self, packed: PackedMoments) -> None:
        """Pack the moments."""
        if self.radii is not None:
            wp.copy(packed.radii, self.radii)
        packed.pack(self.positions, self.moments)


class PairSums:
    """Buffers and launches of sums over all pairs of a target and a moment.

    Attributes:
        moments: Packed moments.
        targets: Packed targets; the same object as ``moments`` if the moments are the targets.
        base: Field [A/m] at the targets, shape [targets]; 0 at first. ``FIELD`` adds it to the sums. In ``WRENCH`` it
            exerts torques.
        out: Field [A/m] or forces [N], shape [targets]. ``FORCE`` is the force on moments that the targets are packed
            with, also in the field of a moment of the same index.
        torques: Torques [N·m], shape [targets], 0 for ``FORCE``; None for ``FIELD``.
    """

    def __init__(self, shape: SumsShape):
        """Allocate all buffers; radii are 0."""
        self.threads = _threads()

        def packed(count, radius, labels=None):
            radii = wp.zeros(count, dtype=shape.dtype, device=shape.device)
            return PackedMoments(radii, largest_radius=radius, labels=labels, moving=False)

        self.moments = self.targets = packed(shape.count, shape.radius)
        if shape.target_count is not None:
            # forces leave out moments of the target's label
            labels = np.full(shape.target_count, -1) if shape.quantity == Quantity.FORCE else None
            self.targets = packed(shape.target_count, shape.target_radius, labels)
        count = self.targets.count
        self.base, self.out = (wp.zeros(count, dtype=vec3_type(shape.dtype), device=shape.device) for _ in range(2))
        self.torques = rotatable = None
        if shape.quantity != Quantity.FIELD:
            self.torques, rotatable = wp.zeros_like(self.out), wp.ones(count, dtype=int, device=shape.device)
        self._rotatable, self._shape, self._all_pairs = rotatable, shape, None

    def launch(self, fmm_rtol: float | None = None) -> None:
        """Launch the sums at the targets, by multipoles with the relative error ``fmm_rtol``; None means all pairs."""
        others = None if self.targets is self.moments else self.targets
        if not self._shape.reference:  # the plain loop finds overlapping pairs itself
            self.targets.find_overlaps(None if others is None else self.moments)
        if fmm_rtol is not None:  # not cached, because the boxes depend on the positions
            fast = FastSums(self.moments, fmm_rtol, others)
            fast.build()
            self._evaluation(self._fast_sums(fast)).launch()
            return
        if self._all_pairs is None:
            self._all_pairs = self._evaluation()
        self._all_pairs.launch()

    def _fast_sums(self, fast: FastSums):
        """Return the sums by multipoles as ``PairEvaluation`` takes them."""
        if self.targets is self.moments or self._shape.quantity == Quantity.FIELD:
            return fast.sums(self._shape.quantity)
        # the octree holds the moments, and then the targets, which are no sources
        n, count = self.moments.count, self.moments.count + self.targets.count
        effective = wp.zeros((3, count), dtype=self._shape.dtype, device=self.out.device)
        wp.copy(effective[:, n:], self.targets.moments)
        sums = fast.sums(self._shape.quantity, np.arange(count) < n)
        assert sums is not None, "there is a moment"
        return lambda _, target, partial: sums(effective, target, partial)

    def _evaluation(self, sums: "FmmSums | Callable | None" = None) -> PairEvaluation:
        shape, count = self._shape, self.targets.count
        return PairEvaluation(
            shape.quantity, [(0, count, 0, shape.count)], self.targets, self.moments, self.base, self.out,
            with_torque=self._rotatable, torques=self.torques, form=REFERENCE if shape.reference else None,
            smoothing=shape.smoothing, sums=sums, ranks=current_ranks(),
        )  # fmt: skip


@contextmanager
def pair_sums(shape: SumsShape) -> Iterator[PairSums]:
    """Yield sums of a shape for one call. The caller must copy the results before the next call overwrites them."""
    sums = _cache.pop(shape, None)  # removed, so that threads never share sums
    if sums is None or sums.threads != _threads():
        sums = PairSums(shape)
    yield sums
    if shape.device == "cpu" and shape.count + (shape.target_count or 0) <= _MOST_CACHED_MOMENTS:
        _cache[shape] = sums
        while len(_cache) > _MOST_CACHED:
            _cache.popitem(last=False)


def _threads() -> int:
    """Return the largest number of threads that launches recorded now may use."""
    return threads_for(MOST_THREADS, 1)


if hasattr(os, "register_at_fork"):
    os.register_at_fork(after_in_child=_cache.clear)  # a child lacks the threads of the recorded launches
