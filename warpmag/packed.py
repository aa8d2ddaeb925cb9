"""Moments packed on one device, and the pairs of them that overlap: what every pass over the pairs starts from."""

import numpy as np
import warp as wp

from warpmag.kernels.pairs import neighbors
from warpmag.kernels.pairs import work_list as pair_loops
from warpmag.kernels.pairs.packing import launch_pack


class PackedMoments:
    """Moments packed for the pair loops. Buffers are allocated once; both launches can be captured in a graph.

    Attributes:
        count: Number of moments n.
        packed: Packed moments, shape [8, n], see ``kernels.pair_loops``.
        moments: The moments among them, a view, shape [3, n].
        neighbors: Moments that overlap each, or nearly do, shape [n, capacity], valid after :meth:`find_overlaps`.
        neighbor_counts: How many they are, shape [n]; zero until then.
        searching: Whether the last :meth:`find_overlaps` made those lists anew, shape [1].
        overlaps: Those of them that do overlap it, shape [n, capacity].
        overlap_counts: How many they are, shape [n].
    """

    def __init__(self, radii, *, largest_radius: float, labels=None, groups=None):
        """Allocate for moments of given radii.

        Args:
            radii: Ball radii [m], Warp array, shape [n].
            largest_radius: The largest of them [m].
            labels: Body label of each moment, shape [n]; None means each its own.
            groups: World of each moment, shape [n]; None means one world.
        """
        device, dtype, n = radii.device, radii.dtype, radii.shape[0]
        self.count = n
        self.device = device
        self.dtype = dtype
        self.radii = radii
        self.largest_radius = largest_radius

        def integers(values):
            return wp.array(np.ascontiguousarray(values, np.int32), dtype=wp.int32, device=device)

        self.labels = integers(np.arange(n) if labels is None else labels)
        self.groups = integers(np.zeros(n) if groups is None else groups)
        pitched = np.zeros((pair_loops.PACKED_ROWS, (1 + -(-n // pair_loops.PITCH)) * pair_loops.PITCH))
        pitched[3], pitched[7] = largest_radius, -1.0
        pitched = wp.array(pitched, dtype=dtype, device=device)
        self.packed: wp.array = pitched[:, :n] if n else pitched
        self.moments = self.packed[4:7] if n else self.packed
        lists = self._lists = neighbors.allocate(n, self.packed, self.groups)
        self.neighbors, self.neighbor_counts, self.searching = lists.neighbor, lists.count, lists.searching
        self.overlaps, self.overlap_counts = lists.overlap, lists.overlap_count

    def pack(self, positions, moments):
        """Launch the packing of positions [m] and moments [A·m²], Warp arrays of vectors, shape [n]."""
        if self.count:
            launch_pack(positions, moments, self.radii, self.labels, self._lists, self.packed)

    def find_overlaps(self, sources: "PackedMoments | None" = None):
        """Launch the search for the ``sources`` that overlap these moments; None means these moments themselves."""
        if sources is None:
            sources = self
        else:
            self._lists.moved.fill_(1)  # only the motion of these moments is watched
        reach = sources.largest_radius + self.largest_radius
        if reach == 0.0 or self.count == 0 or sources.count == 0:
            return
        neighbors.launch_find_neighbors(self._lists, sources._lists, reach)
        neighbors.launch_list_overlaps(self._lists, sources._lists)
