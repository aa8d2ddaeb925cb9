"""One process's share of an octree's boxes. Merged sums are bitwise identical to those of a single process.

Every process has the octree and all multipoles. It takes a contiguous range of leaves, for near pairs and for fields at
its moments. Multipoles are translated to these leaves and to their ancestors. Two processes may both compute an
ancestor. Ancestors are few, and local expansions then need not be merged.
"""

import warp as wp

from warpmag.kernels.fmm.octree import Octree
from warpmag.kernels.fmm.translate import Translation

_LEAST_BOXES = {"cpu": 1, "cuda": 8193}
"""Fewest boxes that processes share, by device. With fewer, a GPU splits translations into partial sums instead."""


def share_boxes(octree: Octree, ranks) -> "BoxShares | None":
    """Return this process's share of boxes; None for a single process, or where sharing would be slower."""
    worth_sharing = octree.capacity >= _LEAST_BOXES["cuda" if octree.device.is_cuda else "cpu"]
    return BoxShares(octree, ranks) if worth_sharing and ranks is not None else None


class BoxShares:
    """One process's share of the boxes.

    Args:
        ranks: The processes (``warpmag.moments.ranks.Ranks``).

    Attributes:
        leaves: Range of this process's leaves, shape [2].
        order, octant_begin: This process's boxes, as in ``octree``.
    """

    def __init__(self, octree: Octree, ranks):
        """Allocate the lists."""
        self._octree, self.ranks = octree, ranks
        self.leaves = wp.zeros(2, dtype=int, device=octree.device)
        self._marks, self._counts = (wp.zeros(octree.capacity, dtype=int, device=octree.device) for _ in range(2))
        self.order, self.octant_begin = wp.zeros_like(octree.order), wp.zeros_like(octree.octant_begin)

    def find(self):
        """Launch the choice of boxes, after the octree was built."""
        octree, count, device = self._octree, self._octree.capacity, self._octree.device
        self._marks.zero_()
        inputs = [self.ranks.rank, self.ranks.size, octree.level_begin, octree.parent]
        wp.launch(_mark_boxes, count, inputs, [self.leaves, self._marks], device=device)
        inputs = [octree.octant_begin, octree.order, self._marks]
        wp.launch(_list_marks, count, inputs, [self._counts], device=device)
        wp.utils.array_scan(self._counts, self._counts, inclusive=True)
        inputs += [self._counts]
        outputs = [self.order, self.octant_begin]
        wp.launch(_choose_boxes, max(count, octree.octant_begin.size), inputs, outputs, device=device)

    def translate(self, translation: Translation, arrays):
        """Launch the translation to this process's boxes; ``arrays`` are bound to its lists."""
        arrays.locals.zero_()  # the downward pass accumulates in boxes that are not translated to
        translation.launch(arrays)


@wp.kernel(module="unique", enable_backward=False)
def _mark_boxes(
    rank: int,
    ranks: int,
    level_begin: wp.array[int],
    parent: wp.array[int],
    leaves_out: wp.array[int],
    marks_out: wp.array[int],
):
    leaf = wp.tid()
    begin = level_begin[1] * rank // ranks
    end = level_begin[1] * (rank + 1) // ranks
    if leaf == 0:
        leaves_out[0] = begin
        leaves_out[1] = end
    if leaf >= begin and leaf < end:
        box = int(leaf)
        while box >= 0 and marks_out[box] == 0:  # the thread that marks a box goes on with its ancestors
            marks_out[box] = 1
            box = parent[box]


@wp.kernel(module="unique", enable_backward=False)
def _list_marks(octant_begin: wp.array2d[int], order: wp.array[int], marks: wp.array[int], marks_out: wp.array[int]):
    i = wp.tid()
    mark = int(0)
    if i < octant_begin[octant_begin.shape[0] - 1, 8]:
        mark = marks[order[i]]
    marks_out[i] = mark


@wp.kernel(module="unique", enable_backward=False)
def _choose_boxes(
    octant_begin: wp.array2d[int],
    order: wp.array[int],
    marks: wp.array[int],
    marks_before: wp.array[int],
    order_out: wp.array[int],
    octant_begin_out: wp.array2d[int],
):
    i = wp.tid()
    if i < octant_begin[octant_begin.shape[0] - 1, 8] and marks[order[i]] == 1:
        order_out[marks_before[i] - 1] = order[i]
    if i < octant_begin.shape[0] * 9:
        first = octant_begin[i // 9, i % 9]
        octant_begin_out[i // 9, i % 9] = wp.where(first > 0, marks_before[wp.max(first - 1, 0)], 0)
