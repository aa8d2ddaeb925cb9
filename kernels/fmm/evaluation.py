"""Field and force sums of packed moments by the fast multipole method: a form of the sums of ``pairs.evaluate``.

Near pairs are those of the all-pairs sums, clamped at contact; far ones come from expansions. Both are added in the
order in which the grid sorts moments, and go to the partial sums of target rows from there.
"""

from contextlib import contextmanager
from functools import cache

import numpy as np
import warp as wp

from warpmag.kernels.fmm.expansions import Expansions, ExpansionTables
from warpmag.kernels.fmm.grid import MomentGrid
from warpmag.kernels.fmm.near import launch_near_sums
from warpmag.kernels.fmm.sharing import share_cells
from warpmag.kernels.pairs.packing import PITCH
from warpmag.kernels.pairs.pair_terms import WIDTHS, Quantity


class CellSums:
    """Sums of a quantity over all pairs of the moments of a grid.

    Args:
        grid: The cells, built by the caller whenever moments have moved.
        tables: Numbers of the harmonics.
        quantity: What is summed; of ``MUTUAL_FORCE`` as of ``FORCE``.
        first: Column in the grid of the first target column.
        sources: Whether each moment counts as a source, NumPy, shape [n]; None means all do.
        ranks: Processes that share out the sums (``warpmag.moments.ranks.Ranks``); None means that there is but this
            one.
    """

    def __init__(
        self, grid: MomentGrid, tables: ExpansionTables, quantity: Quantity, first: int = 0, sources=None, ranks=None
    ):
        """Allocate the sums and the expansions."""
        self._first, self._shares = first, share_cells(grid, ranks)
        self._leaves = grid.level_begin if self._shares is None else self._shares.leaves
        counts = np.ones(grid.count, np.int32) if sources is None else sources.astype(np.int32)
        self._sources = wp.array(counts, dtype=wp.int32, device=grid.device)
        self._quantity = Quantity.FORCE if quantity == Quantity.MUTUAL_FORCE else quantity
        self._grid = grid
        n, device, dtype = grid.count, grid.device, grid.sorted.dtype
        self._sums = wp.zeros((n, WIDTHS[quantity]), dtype=dtype, device=device)
        self._moments = grid.sorted
        self._effective = wp.zeros((3, (1 + -(-n // PITCH)) * PITCH), dtype=dtype, device=device)[:, :n]
        self._expansions = Expansions(grid, tables, self._quantity, self._moments, self._effective, self._sums)
        self._expansions.share(self._leaves, self._shares)
        self._stream = wp.Stream(device, priority=-1) if device.is_cuda else None
        self._events = [wp.Event(device) for _ in range(2)] if device.is_cuda else []

    def __call__(self, effective, target, partial):
        """Launch the sums of the moments as they are now, where they were when the grid was built.

        Args:
            effective: Effective moments e [A·m²] of the force, shape [3, n].
            target: Packed column of each target row.
            partial: Out, sums of the target rows, shape [1, rows, 3 or 6].
        """
        grid, device, dtype = self._grid, self._grid.device, self._sums.dtype
        wp.launch(
            _moments_kernel(dtype),
            grid.count,
            [grid.packed, grid.source, self._sources],
            [self._moments],
            device=device,
        )
        if self._quantity != Quantity.FIELD:
            wp.launch(_sort_kernel(dtype), (3, grid.count), [effective, grid.source], [self._effective], device=device)
        if self._shares is not None:
            self._shares.find()
            self._sums.zero_()
        with self._beside():
            self._expansions.gather()
            self._expansions.translate()
        launch_near_sums(
            self._quantity, self._moments, self._effective, grid.neighbors, grid.moment_begin, self._leaves, self._sums
        )
        if self._stream is not None:
            wp.get_stream(device).wait_event(self._events[1])
        self._expansions.add_fields()
        if self._shares is not None:
            self._shares.ranks.merge(self._sums)
        inputs = [self._sums, target, grid.place[self._first :]]
        wp.launch(_return_kernel(dtype), partial.shape[1:], inputs, [partial], device=device)

    @contextmanager
    def _beside(self):
        """On a GPU, launch what follows on a stream of its own: far cells wait for each other, which near ones fill."""
        if self._stream is None:
            yield
            return
        self._stream.wait_event(wp.get_stream(self._stream.device).record_event(self._events[0]))
        with wp.ScopedStream(self._stream, sync_enter=False):
            yield
            self._stream.record_event(self._events[1])


@cache
def _moments_kernel(dtype):
    @wp.kernel(module="unique", enable_backward=False)
    def sort_moments(
        # inputs:
        packed: wp.array2d[dtype],
        source: wp.array[int],
        counts: wp.array[int],
        # outputs:
        sorted_out: wp.array2d[dtype],
    ):
        i = wp.tid()
        j = source[i]
        for c in range(4, 7):
            sorted_out[c, i] = wp.where(counts[j] == 1, packed[c, j], dtype(0.0))

    return sort_moments


@cache
def _sort_kernel(dtype):
    @wp.kernel(module="unique", enable_backward=False)
    def sort_vectors(
        # inputs:
        vectors: wp.array2d[dtype],
        source: wp.array[int],
        # outputs:
        sorted_out: wp.array2d[dtype],
    ):
        c, i = wp.tid()
        sorted_out[c, i] = vectors[c, source[i]]

    return sort_vectors


@cache
def _return_kernel(dtype):
    @wp.kernel(module="unique", enable_backward=False)
    def return_sums(
        # inputs:
        sums: wp.array2d[dtype],
        target: wp.array[int],
        place: wp.array[int],
        # outputs:
        partial_out: wp.array3d[dtype],
    ):
        row, c = wp.tid()
        partial_out[0, row, c] = sums[place[target[row]], c]

    return return_sums
