"""The part of the cells that one of several processes has: what they sum is merged, and has the bits of one process.

All have the grid and the multipoles. Of the leaves a process has a run, for the pairs that are near and for the fields
at its moments. It translates to these and to the cells that they are part of, which two processes may both have: there
are few of them, and local expansions then need not be merged.
"""

import warp as wp

from warpmag.kernels.fmm.grid import MomentGrid
from warpmag.kernels.fmm.translate import Translation

_LEAST_CELLS = {"cpu": 1, "cuda": 8193}
"""Fewest cells that there is room for that are worth sharing out, by kind of device: for fewer a GPU translates in
parts, all of which it adds up."""


def share_cells(grid: MomentGrid, ranks) -> "CellShares | None":
    """Cells of one of ``ranks``; None where there are none of these, or each does better with all cells."""
    worth = grid.capacity >= _LEAST_CELLS["cuda" if grid.device.is_cuda else "cpu"]
    return CellShares(grid, ranks) if worth and ranks is not None else None


class CellShares:
    """Cells of one of several processes.

    Args:
        grid: The cells of all.
        ranks: The processes (``warpmag.moments.ranks.Ranks``).

    Attributes:
        leaves: First leaf of this process, and the end after its last, shape [2].
        order: Its cells by height and octant, as those of the grid.
        octant_begin: Where those of each octant begin and end in ``order``.
    """

    def __init__(self, grid: MomentGrid, ranks):
        """Allocate the lists."""
        self._grid, self.ranks = grid, ranks
        self.leaves = wp.zeros(2, dtype=int, device=grid.device)
        self._own, self._before = (wp.zeros(grid.capacity, dtype=int, device=grid.device) for _ in range(2))
        self.order, self.octant_begin = wp.zeros_like(grid.order), wp.zeros_like(grid.octant_begin)

    def find(self):
        """Launch the choice of cells of a grid that has been built."""
        grid, count, device = self._grid, self._grid.capacity, self._grid.device
        self._own.zero_()
        inputs = [self.ranks.rank, self.ranks.size, grid.level_begin, grid.parent]
        wp.launch(_mark_cells, count, inputs, [self.leaves, self._own], device=device)
        inputs = [grid.octant_begin, grid.order, self._own]
        wp.launch(_list_marks, count, inputs, [self._before], device=device)
        wp.utils.array_scan(self._before, self._before, inclusive=True)
        inputs += [self._before]
        outputs = [self.order, self.octant_begin]
        wp.launch(_choose_cells, max(count, grid.octant_begin.size), inputs, outputs, device=device)

    def translate(self, translation: Translation, arrays):
        """Launch the translation to the cells of this process, of arrays that are bound to its lists."""
        arrays.locals.zero_()  # others get what their parents have, again and again
        translation.launch(arrays)


@wp.kernel(module="unique", enable_backward=False)
def _mark_cells(
    # inputs:
    rank: int,
    ranks: int,
    level_begin: wp.array[int],
    parent: wp.array[int],
    # outputs:
    leaves_out: wp.array[int],
    own_out: wp.array[int],
):
    leaf = wp.tid()
    begin = level_begin[1] * rank // ranks
    end = level_begin[1] * (rank + 1) // ranks
    if leaf == 0:
        leaves_out[0] = begin
        leaves_out[1] = end
    if leaf >= begin and leaf < end:
        cell = int(leaf)
        while cell >= 0 and own_out[cell] == 0:  # who has marked a cell goes on with those it is part of
            own_out[cell] = 1
            cell = parent[cell]


@wp.kernel(module="unique", enable_backward=False)
def _list_marks(
    # inputs:
    octant_begin: wp.array2d[int],
    order: wp.array[int],
    own: wp.array[int],
    # outputs:
    marks_out: wp.array[int],
):
    i = wp.tid()
    mark = int(0)
    if i < octant_begin[octant_begin.shape[0] - 1, 8]:
        mark = own[order[i]]
    marks_out[i] = mark


@wp.kernel(module="unique", enable_backward=False)
def _choose_cells(
    # inputs:
    octant_begin: wp.array2d[int],
    order: wp.array[int],
    own: wp.array[int],
    before: wp.array[int],
    # outputs:
    order_out: wp.array[int],
    octant_begin_out: wp.array2d[int],
):
    i = wp.tid()
    if i < octant_begin[octant_begin.shape[0] - 1, 8] and own[order[i]] == 1:
        order_out[before[i] - 1] = order[i]
    if i < octant_begin.shape[0] * 9:
        first = octant_begin[i // 9, i % 9]
        octant_begin_out[i // 9, i % 9] = wp.where(first > 0, before[wp.max(first - 1, 0)], 0)
