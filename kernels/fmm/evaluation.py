"""Field and force sums of packed moments by the fast multipole method, as one form of the sums of ``pairs.evaluate``.

Near pairs are summed directly and clamped at contact, as in the all-pairs sums. Far pairs come from expansions. Both
sums are in the octree's order of moments; a last kernel copies them to the partial sums of target rows.
"""

from contextlib import contextmanager
from functools import cache

import numpy as np
import warp as wp

from warpmag.kernels.fmm.expansions import Expansions, ExpansionTables
from warpmag.kernels.fmm.near import launch_near_sums
from warpmag.kernels.fmm.octree import Octree
from warpmag.kernels.fmm.sharing import share_boxes
from warpmag.kernels.pairs.evaluate import PairEvaluation
from warpmag.kernels.pairs.packing import PITCH
from warpmag.kernels.pairs.pair_law import WIDTHS, Quantity

_SAMPLED = 256  # moments at which the error of the field is measured


class FmmSums:
    """Sums of a quantity over all pairs of an octree's moments.

    Args:
        octree: The octree, built by the caller whenever moments have moved.
        quantity: Quantity that is summed; ``MUTUAL_FORCE`` is summed as ``FORCE``.
        first: Packed column of the first target in the octree.
        sources: True for moments that are sources, NumPy, shape [n]; None means all moments.
        ranks: Processes that share the sums (``warpmag.moments.ranks.Ranks``); None means a single process.
    """

    def __init__(
        self, octree: Octree, tables: ExpansionTables, quantity: Quantity, first: int = 0, sources=None, ranks=None
    ):
        """Allocate the sums and the expansions."""
        self._first, self._shares = first, share_boxes(octree, ranks)
        self._leaves = octree.level_begin if self._shares is None else self._shares.leaves
        self._sources = None if sources is None else wp.array(sources, dtype=wp.bool, device=octree.device)
        self._quantity = Quantity.FORCE if quantity == Quantity.MUTUAL_FORCE else quantity
        self._octree = octree
        n, device, dtype = octree.count, octree.device, octree.sorted.dtype
        self._sums = wp.zeros((n, WIDTHS[quantity]), dtype=dtype, device=device)
        self._moments, self._vectors = octree.sorted, (octree.packed[4:7], octree.sorted[4:7])
        self._effective = wp.zeros((3, (1 + -(-n // PITCH)) * PITCH), dtype=dtype, device=device)[:, :n]
        self._expansions = Expansions(octree, tables, self._quantity, self._moments, self._effective, self._sums)
        self._expansions.share(self._leaves, self._shares)
        self._stream = wp.Stream(device, priority=-1) if device.is_cuda else None
        self._events = [wp.Event(device) for _ in range(2)] if device.is_cuda else []

    def __call__(self, effective, target, partial):
        """Launch the sums of the present moments, at their positions when the octree was built, to ``partial``.

        The arguments are those of ``PairEvaluation``'s ``sums``.
        """
        octree, device, dtype = self._octree, self._octree.device, self._sums.dtype
        inputs = [self._vectors[0], octree.packed_index, self._sources]
        wp.launch(_sort_kernel(dtype), (3, octree.count), inputs, [self._vectors[1]], device=device)
        if self._quantity != Quantity.FIELD:
            inputs = [effective, octree.packed_index, None]
            wp.launch(_sort_kernel(dtype), (3, octree.count), inputs, [self._effective], device=device)
        if self._shares is not None:
            self._shares.find()
            self._sums.zero_()
        with self._concurrent():
            self._expansions.compute_multipoles()
            self._expansions.translate()
        leaves = octree.neighbors, octree.moment_begin, self._leaves
        launch_near_sums(self._quantity, self._moments, self._effective, *leaves, self._sums)
        if self._stream is not None:
            wp.get_stream(device).wait_event(self._events[1])
        self._expansions.add_fields()
        if self._shares is not None:
            self._shares.ranks.merge(self._sums)
        inputs = [self._sums, target, octree.sorted_index[self._first :]]
        wp.launch(_return_kernel(dtype), partial.shape[1:], inputs, [partial], device=device)

    @contextmanager
    def _concurrent(self):
        """On a GPU, launch on a second stream: near sums fill the GPU while passes over boxes wait."""
        if self._stream is None:
            yield
            return
        self._stream.wait_event(wp.get_stream(self._stream.device).record_event(self._events[0]))
        with wp.ScopedStream(self._stream, sync_enter=False):
            yield
            self._stream.record_event(self._events[1])


@cache
def _sort_kernel(dtype):
    """Return the kernel that sorts vectors, and sets the vectors of moments that are not sources to zero."""

    @wp.kernel(module="unique", enable_backward=False)
    def sort_vectors(
        vectors: wp.array2d[dtype],
        packed_index: wp.array[int],
        is_source: wp.array[wp.bool],
        sorted_out: wp.array2d[dtype],
    ):
        c, i = wp.tid()
        value = vectors[c, packed_index[i]]
        if is_source:
            if not is_source[packed_index[i]]:
                value = dtype(0.0)
        sorted_out[c, i] = value

    return sort_vectors


@cache
def _return_kernel(dtype):
    @wp.kernel(module="unique", enable_backward=False)
    def return_sums(
        sums: wp.array2d[dtype], target: wp.array[int], sorted_index: wp.array[int], partial_out: wp.array3d[dtype]
    ):
        row, c = wp.tid()
        partial_out[0, row, c] = sums[sorted_index[target[row]], c]

    return return_sums


def sampled_error(sums, moments, ranges, target_base, base) -> float:
    """Return the relative error ‖H − H_exact‖/‖H_exact‖ of a field at random moments, against sums over all pairs.

    Waits for the device.

    Args:
        sums: Sums of the targets' fields at each other, as ``PairEvaluation`` takes them; None sums over all pairs.
        ranges: Columns of each world: begin and end of targets, and end of sources, integers [worlds, 3].
        target_base: Base field of the targets' sums, including the field of other sources [A/m], shape [n].
        base: Base field of the sums over all sources [A/m], shape [n].
    """
    ranges = np.reshape(ranges, (-1, 3))
    targets = np.concatenate([np.arange(begin, end) for begin, end, _ in ranges])
    if len(targets) == 0:
        return 0.0
    rows = np.sort(np.random.default_rng(0).choice(targets, min(_SAMPLED, len(targets)), replace=False))
    begin, middle, end = ranges[np.searchsorted(ranges[:, 2], rows, side="right")].T
    fields = []
    for last, added, form in ((middle, target_base, sums), (end, base, None)):
        field, segments = wp.zeros_like(base), np.stack([rows, rows + 1, begin, last], axis=1)
        PairEvaluation(Quantity.FIELD, segments, moments, moments, added, field, sums=form).launch()
        fields.append(field.numpy()[rows].astype(float))
    approximate, exact = fields
    return float(np.linalg.norm(approximate - exact) / max(np.linalg.norm(exact), np.finfo(float).tiny))
