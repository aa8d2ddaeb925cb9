"""Octree of moments: the occupied boxes of all levels, built on the device in buffers of fixed size.

A cube around all moments is halved until its boxes hold about the target number of moments. Coarser leaves are chosen
if the buffers are too small for finer ones. A first round measures how occupancy depends on the edge of the leaves;
the second round sets the edge of the cube accordingly. Worlds share the cube, and have boxes of their own.

Heights count from the leaves, 0, to the cube. Boxes are numbered height by height, and within a height by world, z, y
and x. ``octree.h`` builds them.
"""

from enum import IntEnum
from functools import cache

import warp as wp

from warpmag.kernels.pairs.packing import PACKED_ROWS, PITCH
from warpmag.kernels.shared.native import native_kernel
from warpmag.kernels.shared.team import MOMENTS_PER_THREAD, team, threads_for

_BLOCK = 256  # moments of a thread block; as in ``octree.h``
_MAX_LEVELS = 14
"""Most levels below the cube. Keys of boxes and moments are then sorted in six passes of 8 bits: after an odd number of
passes Warp would copy the results."""
_KEY_BITS, _HEIGHT_BITS, _OCTANT_BITS = 64, 4, 8
_LEAVES_PER_BOX = 0.3
"""Number of leaves at the target occupancy over the capacity for boxes. Box counts of two levels differ by a factor of
up to 8, and the nearer level is chosen."""


class _Pass(IntEnum):
    BOUND, KEYS, COUNT, WRITE, INVERT, LINK, PLACE = range(7)


_BLOCK_PASSES = (_Pass.BOUND, _Pass.COUNT, _Pass.WRITE)  # passes that take a block of moments at a time


@cache
def _arrays_type(dtype):
    @wp.struct
    class OctreeArrays:
        # Moments in:
        packed: wp.array2d[dtype]  # the packed moments, shape [8, n]
        group: wp.array[int]
        # Parameters:
        depth: int
        worlds: int
        world_bits: int
        capacity: int
        occupancy: wp.float64
        reach: wp.float64
        # Cube, and numbers of boxes:
        block_bounds: wp.array2d[dtype]
        arrived: wp.array[int]
        # Corner of the cube, its edge, the edge of a leaf, and the leaf edge that would give the target occupancy [m],
        # shape [6].
        frame: wp.array[wp.float64]
        box_starts: wp.array2d[int]
        counts: wp.array[int]  # levels below the cube, and number of boxes, shape [2]
        level_begin: wp.array[int]  # first box of each height, shape [levels + 1]
        # Moments along the Morton curve:
        keys: wp.array[wp.uint64]
        index: wp.array[int]
        split_level: wp.array[int]
        unsorted_leaf: wp.array[int]
        # Boxes before and after sorting:
        box_keys: wp.array[wp.uint64]
        unsorted_box: wp.array[int]
        sorted_box: wp.array[int]
        first_moment: wp.array[int]
        unsorted_parent: wp.array[int]
        moment_counts: wp.array[int]
        # Boxes out:
        moment_begin: wp.array[int]  # first sorted moment of each leaf, shape [c + 1]
        # Box of the same height at each offset x + 3 y + 9 z from (−1, −1, −1), −1 for none, shape [c, 27].
        neighbors: wp.array2d[int]
        children: wp.array2d[int]  # child in each octant x + 2 y + 4 z, −1 for none, shape [c, 8]
        parent: wp.array[int]  # parent of each box, −1 for none, shape [c]
        octant: wp.array[int]  # octant of each box in its parent, shape [c]
        order_keys: wp.array[int]
        order: wp.array[int]  # boxes sorted by height and octant, shape [c]
        octant_begin: wp.array2d[int]  # range of each height and octant in ``order``, shape [levels, 9]
        # Moments out:
        packed_index: wp.array[int]  # packed column of each sorted moment, shape [n]
        leaf: wp.array[int]  # leaf of each sorted moment, shape [n]
        sorted_index: wp.array[int]  # sorted index of each packed column, shape [n]
        sorted: wp.array2d[dtype]  # the packed moments in sorted order, shape [8, n]
        # Position of each sorted moment relative to its leaf's center, in leaf edges, shape [3, n].
        leaf_position: wp.array2d[dtype]

    return OctreeArrays


class Octree:
    """Octree of n packed moments with at most c boxes.

    Args:
        packed: Packed moments, shape [8, n], at least one.
        groups: World of each moment, shape [n].
        occupancy: Target for the mean number of moments in a leaf.
        reach: Largest distance of two moments in contact [m]; leaves are at least as large.

    Attributes:
        count, capacity, levels: Number of moments n, most boxes c, and most levels.

    The other attributes are arrays of the struct with the same names, written by :meth:`build`.
    """

    def __init__(self, packed, groups, worlds: int = 1, *, occupancy: float, reach: float = 0.0):
        """Allocate all buffers."""
        n, device, dtype = groups.shape[0], packed.device, packed.dtype
        bits = (worlds - 1).bit_length()
        self.count, self.device = n, device
        self.capacity = c = max(worlds, int(n / (_LEAVES_PER_BOX * occupancy)) + 64)
        depth = min(_MAX_LEVELS, (_KEY_BITS - _HEIGHT_BITS - bits) // 3)
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
        a.block_bounds, a.arrived, a.frame = zeros(blocks, 6, dtype=dtype), zeros(1), zeros(6, dtype=wp.float64)
        a.keys, a.index, a.split_level = zeros(2 * n, dtype=wp.uint64), zeros(2 * n), zeros(n)
        a.box_starts, a.counts, a.level_begin = zeros(blocks, depth + 1), zeros(2), zeros(depth + 2)
        a.unsorted_leaf, a.first_moment, a.unsorted_parent = zeros(n), zeros(c), zeros(c)
        a.box_keys, a.unsorted_box, a.sorted_box = zeros(2 * c, dtype=wp.uint64), zeros(2 * c), zeros(c)
        a.moment_counts, a.moment_begin = zeros(c + 1), zeros(c + 1)
        a.neighbors, a.children, a.parent, a.octant = zeros(c, 27), zeros(c, 8), zeros(c), zeros(c)
        a.order_keys, a.order, a.octant_begin = zeros(2 * c), zeros(2 * c), zeros(depth + 1, 9)
        a.packed_index, a.leaf, a.sorted_index = zeros(n), zeros(n), zeros(n)
        a.sorted, a.leaf_position = pitched(PACKED_ROWS), pitched(3)
        self.frame, self.counts, self.level_begin, self.moment_begin = a.frame, a.counts, a.level_begin, a.moment_begin
        self.neighbors, self.children, self.parent, self.octant = a.neighbors, a.children, a.parent, a.octant
        self.order, self.octant_begin, self.packed = a.order, a.octant_begin, packed
        self.packed_index, self.sorted_index, self.leaf = a.packed_index, a.sorted_index, a.leaf
        self.sorted, self.leaf_position = a.sorted, a.leaf_position

    def build(self):
        """Launch the build of the octree from the present packed moments."""
        a, n, c = self.arrays, self.count, self.capacity
        blocks = -(-n // _BLOCK)
        self._launch(_Pass.BOUND, blocks)
        for round_number in range(2):
            self._launch(_Pass.KEYS, max(n, c))
            wp.utils.radix_sort_pairs(a.keys, a.index, n, 0, 3 * a.depth + a.world_bits)
            self._launch(_Pass.COUNT, blocks, round_number)
        self._launch(_Pass.WRITE, blocks)
        wp.utils.radix_sort_pairs(a.box_keys, a.unsorted_box, c, 0, 3 * a.depth + a.world_bits + _HEIGHT_BITS)
        self._launch(_Pass.INVERT, c)
        wp.utils.array_scan(a.moment_counts, a.moment_begin, inclusive=False)
        self._launch(_Pass.LINK, c)
        wp.utils.radix_sort_pairs(a.order_keys, a.order, c, 0, _OCTANT_BITS)
        self._launch(_Pass.PLACE, max(n, a.octant_begin.size))

    def _launch(self, build_pass: _Pass, count: int, round_number: int = 0):
        cuda, item = self.device.is_cuda, _BLOCK if build_pass in _BLOCK_PASSES else 1
        threads = threads_for(count * item, MOMENTS_PER_THREAD)
        wp.launch(
            _kernel(self.arrays.packed.dtype, build_pass),
            dim=-(-count * item // _BLOCK) * _BLOCK if cuda else 1,
            inputs=[count, round_number, threads, None if cuda else team(), self.arrays],
            device=self.device,
            block_dim=_BLOCK,
        )


def join_moments(first, second) -> tuple[wp.array, wp.array]:
    """Return the packed rows and groups of two sets of packed moments, concatenated."""
    n, k = first.count, second.count
    packed = wp.zeros((PACKED_ROWS, n + k), dtype=first.dtype, device=first.device)
    groups = wp.zeros(n + k, dtype=int, device=first.device)
    for begin, end, part in ((0, n, first), (n, n + k, second)):
        if end > begin:
            wp.copy(packed[:, begin:end], part.packed)
            wp.copy(groups[begin:end], part.groups)
    return packed, groups


@cache
def _kernel(dtype, build_pass: _Pass):
    call = f"build_octree<warpmag::Pass({build_pass:d})>(thread, count, round_number, threads, team.data, arrays)"
    arguments = {"count": int, "round_number": int, "threads": int, "team": wp.array2d[wp.uint64]}
    arguments["arrays"] = _arrays_type(dtype)
    return native_kernel(call, "fmm/octree.h", arguments, dtype=dtype, launch={"grid_stride": False})
