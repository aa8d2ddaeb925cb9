"""Moments packed on one device, and the pairs of them that overlap: what every pass over the pairs starts from."""

import numpy as np
import warp as wp

from warpmag.kernels import pair_loops
from warpmag.kernels.neighbors import CAPACITY, launch_find_neighbors
from warpmag.kernels.packing import launch_pack

_MOST_GRID_CELLS = 64


class PackedMoments:
    """Moments packed for the pair loops. Buffers are allocated once; both launches can be captured in a graph.

    Attributes:
        count: Number of moments n.
        packed: Packed moments, shape [8, n], see ``kernels.pair_loops``.
        neighbors: Moments that overlap each, shape [n, capacity], valid after :meth:`find_overlaps`.
        neighbor_counts: How many they are, shape [n]; zero until then.
        overlaps: Volume shared with neighbours [dimensionless], shape [n].
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
        self.packed = wp.zeros((pair_loops.PACKED_ROWS, n), dtype=dtype, device=device)
        self.points = wp.zeros(n, dtype=wp.vec3, device=device)
        self.neighbors = wp.zeros((n, CAPACITY), dtype=int, device=device)
        self.neighbor_counts = wp.zeros(n, dtype=int, device=device)
        self.overlaps = wp.zeros(n, dtype=dtype, device=device)
        # about one ball per cell of a compact pile; a larger grid only costs time to clear
        cells = int(np.clip(2 ** np.ceil(np.log2(max(n, 1)) / 3.0), 8, _MOST_GRID_CELLS))
        self._grid = wp.HashGrid(cells, cells, cells, device=device)
        self._grid.reserve(max(n, 1), with_groups=True)

    def pack(self, positions, moments):
        """Launch the packing of positions [m] and moments [A·m²], Warp arrays of vectors, shape [n]."""
        if self.count:
            launch_pack(positions, moments, self.radii, self.labels, self.packed, self.points)

    def find_overlaps(self, sources: "PackedMoments | None" = None):
        """Launch the search for the ``sources`` that overlap these moments; None means these moments themselves."""
        same_set = sources is None
        sources = self if sources is None else sources
        cell = sources.largest_radius + self.largest_radius
        if cell == 0.0 or self.count == 0 or sources.count == 0:
            return
        sources._grid.build(sources.points, cell, sources.groups)
        launch_find_neighbors(
            sources._grid,
            self.packed,
            sources.packed,
            self.groups,
            sources.largest_radius,
            same_set,
            self.neighbors,
            self.neighbor_counts,
            self.overlaps,
        )
