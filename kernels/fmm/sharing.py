"""The part of the cells that one of several processes has: what they sum is merged, and has the bits of one process.

All have the grid and the multipoles. Of each height and octant a process translates to as many cells as the others, and
of the leaves it has a run, for the pairs that are near and for the fields at its moments.
"""

import warp as wp

from warpmag.kernels.fmm.grid import MomentGrid
from warpmag.kernels.fmm.translate import OCTANTS, Translation

_LANES = 64
"""Threads of a GPU that copy the cells of a height and octant."""


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
        ranks: The processes (``warpmag.ranks.Ranks``).

    Attributes:
        leaves: First leaf of this process, and the end after its last, shape [2].
        order: Its cells by height and octant, as those of the grid.
        octant_begin: Where those of each octant begin and end in ``order``.
    """

    def __init__(self, grid: MomentGrid, ranks):
        """Allocate the lists."""
        self._grid, self.ranks = grid, ranks
        self.leaves = wp.zeros(2, dtype=int, device=grid.device)
        self.order, self.octant_begin = wp.zeros_like(grid.order), wp.zeros_like(grid.octant_begin)

    def find(self):
        """Launch the choice of cells of a grid that has been built."""
        grid, lanes = self._grid, _LANES if self._grid.device.is_cuda else 1
        wp.launch(
            _choose_cells,
            dim=(OCTANTS * grid.octant_begin.shape[0], lanes),
            inputs=[self.ranks.rank, self.ranks.size, lanes, grid.level_begin, grid.octant_begin, grid.order],
            outputs=[self.leaves, self.octant_begin, self.order],
            device=grid.device,
        )

    def translate(self, translation: Translation, arrays):
        """Launch the translation to the cells of all processes, of arrays that are bound to those of this one."""
        arrays.locals.zero_()
        translation.launch(arrays)
        self.ranks.merge(arrays.locals)


@wp.func
def _share(count: int, rank: int, ranks: int):
    return count * rank // ranks


@wp.kernel(module="unique", enable_backward=False)
def _choose_cells(
    # inputs:
    rank: int,
    ranks: int,
    lanes: int,
    level_begin: wp.array[int],
    octant_begin: wp.array2d[int],
    order: wp.array[int],
    # outputs:
    leaves_out: wp.array[int],
    octant_begin_out: wp.array2d[int],
    order_out: wp.array[int],
):
    segment, lane = wp.tid()
    start = int(0)
    for k in range(segment + 1):
        begin = octant_begin[k // 8, k % 8]
        count = octant_begin[k // 8, k % 8 + 1] - begin
        first = _share(count, rank, ranks)
        own = _share(count, rank + 1, ranks) - first
        if k < segment:
            start += own
        else:
            for i in range(lane, own, lanes):
                order_out[start + i] = order[begin + first + i]
            if lane == 0:
                octant_begin_out[k // 8, k % 8] = start
                if k % 8 == 7:
                    octant_begin_out[k // 8, 8] = start + own
    if segment == 0 and lane == 0:
        leaves_out[0] = _share(level_begin[1], rank, ranks)
        leaves_out[1] = _share(level_begin[1], rank + 1, ranks)
