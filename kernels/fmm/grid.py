"""The grid of cells that hold moments, on all levels from the leaves up, made on the device in buffers of fixed size.

A cube around all moments is halved until its cells hold about as many moments as wanted, or more where there is no room
for finer ones: on a level there are at least as many cells as on the one above. How large the cube is for that, a first
round tells. Worlds have the same cube, and cells of
their own. Heights count from the leaves, 0, to the cube, and cells of all heights are numbered one height after the
other, and by world, z, y and x within one. ``grid.h`` makes them.
"""

from enum import IntEnum
from functools import cache

import warp as wp

from warpmag.kernels.pairs.packing import PACKED_ROWS, PITCH
from warpmag.kernels.shared.native import native_options
from warpmag.kernels.shared.team import MOMENTS_PER_THREAD, team, threads_for

_BLOCK = 256
"""Moments of a block of threads, as in ``grid.h``."""
_MOST_LEVELS = 14
"""Levels below the cube, for keys of cells and moments that are sorted in six passes of 8 bits, an even number: after
an odd one the results are copied."""
_KEY_BITS, _HEIGHT_BITS, _OCTANT_BITS = 64, 4, 8
_ROOM = 0.3
"""Cells for which there is room, over the leaves that hold as many moments as wanted: levels differ by a factor of up
to 8, of which the nearest is chosen."""


class _Pass(IntEnum):
    BOUND, KEYS, COUNT, WRITE, NOTE, LINK, PLACE = range(7)


_OF_BLOCKS = (_Pass.BOUND, _Pass.COUNT, _Pass.WRITE)


@cache
def _arrays_type(dtype):
    @wp.struct
    class GridArrays:
        packed: wp.array2d[dtype]
        group: wp.array[int]
        depth: int
        worlds: int
        world_bits: int
        capacity: int
        occupancy: wp.float64
        reach: wp.float64
        boxes: wp.array2d[dtype]
        arrived: wp.array[int]
        frame: wp.array[wp.float64]
        keys: wp.array[wp.uint64]
        index: wp.array[int]
        fork: wp.array[int]
        beginnings: wp.array2d[int]
        counts: wp.array[int]
        level_begin: wp.array[int]
        leaf_before: wp.array[int]
        cell_keys: wp.array[wp.uint64]
        cell_before: wp.array[int]
        cell_after: wp.array[int]
        first: wp.array[int]
        parent_before: wp.array[int]
        held: wp.array[int]
        moment_begin: wp.array[int]
        neighbors: wp.array2d[int]
        children: wp.array2d[int]
        parent: wp.array[int]
        octant: wp.array[int]
        order_keys: wp.array[int]
        order: wp.array[int]
        octant_begin: wp.array2d[int]
        source: wp.array[int]
        leaf: wp.array[int]
        place: wp.array[int]
        sorted: wp.array2d[dtype]
        inside: wp.array2d[dtype]

    return GridArrays


class MomentGrid:
    """Cells of n packed moments, c of them at most.

    Args:
        packed: Packed moments, shape [8, n], at least one.
        groups: World of each, shape [n].
        worlds: Number of worlds.
        occupancy: Moments that a leaf is to hold in the mean.
        reach: Distance of the farthest contact [m]: leaves are not smaller.

    Attributes:
        count: Number of moments n.
        capacity: Number of cells c that there is room for.
        levels: Most levels that cells can have.
        frame: Corner of the cube, edge of it, of a leaf, and of a leaf that would hold what is wanted [m], shape [6].
        counts: Levels below the cube, and number of cells, shape [2].
        level_begin: First cell of each height, shape [levels + 1].
        moment_begin: First sorted moment of each leaf, shape [c + 1].
        neighbors: Cell of the same height at each offset x + 3 y + 9 z from (−1, −1, −1), −1 for none, shape [c, 27].
        children: Child of each octant x + 2 y + 4 z, −1 for none, shape [c, 8].
        parent: Parent of each cell, −1 for none, shape [c].
        octant: Octant of each cell in its parent, shape [c].
        order: Cells by height and octant, shape [c].
        octant_begin: Where those of each octant begin and end in ``order``, shape [levels, 9].
        source: Packed column of each sorted moment, shape [n].
        place: Sorted place of each packed column, shape [n].
        leaf: Leaf of each sorted moment, shape [n].
        packed: The packed moments, shape [8, n].
        sorted: Those as they are sorted, shape [8, n].
        inside: Place of each sorted moment in its leaf, from the centre, in units of its edge, shape [3, n].
    """

    def __init__(self, packed, groups, worlds: int = 1, *, occupancy: float, reach: float = 0.0):
        """Allocate all buffers."""
        n, device, dtype = groups.shape[0], packed.device, packed.dtype
        bits = (worlds - 1).bit_length()
        self.count, self.device = n, device
        self.capacity = c = max(worlds, int(n / (_ROOM * occupancy)) + 64)
        depth = min(_MOST_LEVELS, (_KEY_BITS - _HEIGHT_BITS - bits) // 3)
        self.levels = depth + 1
        blocks = -(-n // _BLOCK)

        def zeros(*shape, dtype=wp.int32):
            return wp.zeros(shape, dtype=dtype, device=device)

        def pitched(rows):
            return zeros(rows, (1 + -(-n // PITCH)) * PITCH, dtype=dtype)[:, :n]

        self.arrays = a = _arrays_type(dtype)()
        a.packed, a.group = packed, groups
        a.depth, a.worlds, a.world_bits, a.capacity = depth, worlds, bits, c
        a.occupancy, a.reach = occupancy, reach
        a.boxes, a.arrived, a.frame = zeros(blocks, 6, dtype=dtype), zeros(1), zeros(6, dtype=wp.float64)
        a.keys, a.index, a.fork = zeros(2 * n, dtype=wp.uint64), zeros(2 * n), zeros(n)
        a.beginnings, a.counts, a.level_begin = zeros(blocks, depth + 1), zeros(2), zeros(depth + 2)
        a.leaf_before, a.first, a.parent_before = zeros(n), zeros(c), zeros(c)
        a.cell_keys, a.cell_before, a.cell_after = zeros(2 * c, dtype=wp.uint64), zeros(2 * c), zeros(c)
        a.held, a.moment_begin = zeros(c + 1), zeros(c + 1)
        a.neighbors, a.children, a.parent, a.octant = zeros(c, 27), zeros(c, 8), zeros(c), zeros(c)
        a.order_keys, a.order, a.octant_begin = zeros(2 * c), zeros(2 * c), zeros(depth + 1, 9)
        a.source, a.leaf, a.place = zeros(n), zeros(n), zeros(n)
        a.sorted, a.inside = pitched(PACKED_ROWS), pitched(3)
        self.frame, self.counts, self.level_begin, self.moment_begin = a.frame, a.counts, a.level_begin, a.moment_begin
        self.neighbors, self.children, self.parent, self.octant = a.neighbors, a.children, a.parent, a.octant
        self.order, self.octant_begin, self.packed = a.order, a.octant_begin, packed
        self.source, self.place, self.leaf, self.sorted, self.inside = a.source, a.place, a.leaf, a.sorted, a.inside

    def build(self):
        """Launch the build for the moments as they are packed."""
        a, n, c = self.arrays, self.count, self.capacity
        blocks = -(-n // _BLOCK)
        self._launch(_Pass.BOUND, blocks)
        for choice in range(2):
            self._launch(_Pass.KEYS, max(n, c))
            wp.utils.radix_sort_pairs(a.keys, a.index, n, 0, 3 * a.depth + a.world_bits)
            self._launch(_Pass.COUNT, blocks, choice)
        self._launch(_Pass.WRITE, blocks)
        wp.utils.radix_sort_pairs(a.cell_keys, a.cell_before, c, 0, 3 * a.depth + a.world_bits + _HEIGHT_BITS)
        self._launch(_Pass.NOTE, c)
        wp.utils.array_scan(a.held, a.moment_begin, inclusive=False)
        self._launch(_Pass.LINK, c)
        wp.utils.radix_sort_pairs(a.order_keys, a.order, c, 0, _OCTANT_BITS)
        self._launch(_Pass.PLACE, max(n, a.octant_begin.size))

    def _launch(self, one: _Pass, count: int, choice: int = 0):
        cuda, each = self.device.is_cuda, _BLOCK if one in _OF_BLOCKS else 1
        threads = threads_for(count * each, MOMENTS_PER_THREAD)
        wp.launch(
            _kernel(self.arrays.packed.dtype, one),
            dim=-(-count * each // _BLOCK) * _BLOCK if cuda else 1,
            inputs=[count, choice, threads, None if cuda else team(), self.arrays],
            device=self.device,
            block_dim=_BLOCK,
        )


def join_moments(first, second) -> tuple[wp.array, wp.array]:
    """Packed rows and groups of two sets of packed moments, one after the other."""
    n, k = first.count, second.count
    packed = wp.zeros((PACKED_ROWS, n + k), dtype=first.dtype, device=first.device)
    groups = wp.zeros(n + k, dtype=int, device=first.device)
    for begin, end, part in ((0, n, first), (n, n + k, second)):
        if end > begin:
            wp.copy(packed[:, begin:end], part.packed)
            wp.copy(groups[begin:end], part.groups)
    return packed, groups


@cache
def _kernel(dtype, one: _Pass):
    arrays = _arrays_type(dtype)

    @wp.func_native(f"warpmag::build<warpmag::Pass({one:d})>(thread, count, choice, threads, team.data, arrays);")
    def run(thread: int, count: int, choice: int, threads: int, team: wp.array2d[wp.uint64], arrays: arrays): ...

    @wp.kernel(
        module="unique",
        enable_backward=False,
        grid_stride=False,
        module_options=native_options("fmm/grid.h", dtype=dtype),
    )
    def build_cells(count: int, choice: int, threads: int, team: wp.array2d[wp.uint64], arrays: arrays):
        run(wp.tid(), count, choice, threads, team, arrays)

    return build_cells
