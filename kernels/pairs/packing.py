"""Packed moments for the sums over pairs: one row of scalars per component.

The layout suits vector loads on a CPU and coalesced loads on a GPU:

| packed row | 0 1 2 | 3 | 4 5 6 | 7 |
|---|---|---|---|---|
| content | position [m] | radius [m] | moment [A·m²] | body label |
"""

from copy import copy
from functools import cache
from typing import Any

import numpy as np
import warp as wp

from warpmag.kernels.pairs import neighbors
from warpmag.kernels.shared.launches import RecordedLaunches

PACKED_ROWS = 8
PITCH = 128
"""Rows are a multiple of this number of columns apart. For vector loads they have at least as many empty columns at the
end."""


@wp.func
def ball_volume(radius: Any):
    """Volume 4π/3 R³ [m³] of a ball."""
    return type(radius)(4.18879020478639) * radius * radius * radius


@wp.func
def store_magnetization(i: int, magnetization: Any, moments: wp.array(dtype=Any), packed: wp.array2d(dtype=Any)):
    """Set the moment of ball ``i``, m = V M, from a magnetization [A/m], in both arrays."""
    m = ball_volume(packed[3, i]) * magnetization
    moments[i] = m
    for c in range(3):
        packed[c + 4, i] = m[c]


@cache
def _pack_kernel(dtype):
    vec3 = wp.types.vector(3, dtype)

    @wp.kernel(module="unique", enable_backward=False)
    def pack(
        positions: wp.array[vec3],
        moments: wp.array[vec3],
        radii: wp.array[dtype],
        labels: wp.array[int],
        groups: wp.array[int],
        found_at: wp.array[vec3],
        packed_out: wp.array2d[dtype],
        moved_out: wp.array[int],
    ):
        i = wp.tid()
        if groups[i] < 0:
            return
        x = positions[i]
        m = moments[i]
        for c in range(3):
            packed_out[c, i] = x[c]
            packed_out[c + 4, i] = m[c]
        packed_out[3, i] = radii[i]
        packed_out[7, i] = dtype(labels[i])
        if not wp.length(x - found_at[i]) <= dtype(wp.static(neighbors.SKIN)) * radii[i]:
            moved_out[0] = 1

    return pack


class PackedMoments:
    """Packed moments on one device, and lists of overlapping moments, for sums over pairs.

    Buffers are allocated once; both launches can be captured in a graph.

    Attributes:
        count: Number of moments n.
        packed: Packed moments, shape [8, n].
        moments: Rows of the moments, a view of ``packed``, shape [3, n].
        active_groups: World of each moment, or -1 for moments that :meth:`pack` and :meth:`find_overlaps` leave as they
            are, on the device, shape [n].
        neighbors, neighbor_counts, overlaps, overlap_counts, searching: Lists of ``neighbors.lists_type``, valid after
            :meth:`find_overlaps`; without neighbors before.
    """

    def __init__(self, radii, *, largest_radius: float, labels=None, groups=None, moving=True):
        """Allocate the buffers.

        Args:
            radii: Ball radii [m], Warp array, shape [n].
            labels: Body label of each moment, exact in float32 up to 2²⁴, shape [n]; None means one body each. A Warp
                array is not copied; nor are groups.
            groups: World of each moment, shape [n]; None means one world.
            moving: True if the moments move by small steps, for which neighbor lists with a skin are faster. Otherwise
                the lists are rebuilt each time.
        """
        device, dtype, n = radii.device, radii.dtype, radii.shape[0]
        self.count, self.device, self.dtype = n, device, dtype
        self.radii, self.largest_radius, self._moving = radii, largest_radius, moving
        self._launch = RecordedLaunches()

        def integers(values):
            is_array = isinstance(values, wp.array)
            return values if is_array else wp.array(np.asarray(values, np.int32), dtype=wp.int32, device=device)

        self.labels = integers(np.arange(n, dtype=np.int32) if labels is None else labels)
        self.groups = wp.zeros(n, dtype=wp.int32, device=device) if groups is None else integers(groups)
        pitched = self._whole = self._pitched(PACKED_ROWS)
        pitched[3].fill_(largest_radius)
        pitched[7].fill_(-1.0)
        self.packed: wp.array = pitched[:, :n] if n else pitched
        self.moments = self.packed[4:7] if n else self.packed
        ratio = 1.0 + neighbors.SKIN if moving else 1.0
        self.active_groups = wp.clone(self.groups)
        lists = neighbors.allocate(n, self.packed, self.active_groups, reach=2.0 * largest_radius, ratio=ratio)
        self._lists = lists
        self.neighbors, self.neighbor_counts, self.searching = lists.neighbor, lists.count, lists.searching
        self.overlaps, self.overlap_counts = lists.overlap, lists.overlap_count

    def _pitched(self, rows: int) -> wp.array:
        """Rows of zeros, with padding after the last moment."""
        return wp.zeros((rows, (1 + -(-self.count // PITCH)) * PITCH), dtype=self.dtype, device=self.device)

    def twin(self, labels=None) -> "PackedMoments":
        """Return packed moments of the same radii and worlds with other labels, a Warp array; None means the same.

        Both share the lists of overlapping moments, for moments at the same positions. Each is packed on its own.
        """
        twin = copy(self)
        twin._launch = RecordedLaunches()
        pitched = wp.clone(self._whole)
        twin._whole, twin.labels = pitched, self.labels if labels is None else labels
        twin.packed = pitched[:, : self.count] if self.count else pitched
        twin.moments = twin.packed[4:7] if self.count else pitched
        return twin

    def vectors(self, rows: int = 3) -> wp.array:
        """Allocate rows with the layout of :attr:`moments`, zero, shape [rows, n]."""
        return self._pitched(rows)[:, : self.count] if self.count else self._pitched(rows)

    def persistent_arrays(self) -> dict:
        """Return the arrays that the next search reads, by name."""
        return neighbors.persistent_lists(self._lists)

    def request_search(self, chosen):
        """Rebuild the lists in the next search if any entry of ``chosen`` is not 0."""
        neighbors.launch_request_search(self._lists, chosen)

    def pack(self, positions, moments, *, resting: bool = False):
        """Pack positions [m] and moments [A·m²], Warp arrays of vectors, shape [n], with those that rest or without."""
        if self.count:
            groups = self.groups if resting else self.active_groups
            inputs = [positions, moments, self.radii, self.labels, groups, self._lists.found_at]
            outputs = [self.packed, self._lists.moved]
            self._launch(_pack_kernel(self.dtype), self.count, inputs=inputs, outputs=outputs, device=self.device)

    def find_overlaps(self, sources: "PackedMoments | None" = None):
        """List the ``sources`` that overlap each of these moments; None means these moments themselves."""
        if sources is None:
            sources = self
        reach = sources.largest_radius + self.largest_radius
        if reach == 0.0 or self.count == 0 or sources.count == 0:
            return
        if sources is not self or not self._moving:
            self._lists.moved.fill_(1)  # ``pack`` detects motion of these moments only
        if sources is not self:
            self._lists.reach.fill_(reach)
        neighbors.launch_find_neighbors(self._lists, sources._lists, self._launch)
        neighbors.launch_list_overlaps(self._lists, sources._lists, self._launch)


@cache
def _divide_kernel(dtype):
    vec3 = wp.types.vector(3, dtype)

    @wp.kernel(module="unique", enable_backward=False)
    def divide_by_volume(moments: wp.array[vec3], radii: wp.array[dtype], magnetizations_out: wp.array[vec3]):
        i = wp.tid()
        volume = ball_volume(radii[i])
        m = vec3()
        if volume > dtype(0.0):
            m = moments[i] / volume
        magnetizations_out[i] = m

    return divide_by_volume


def launch_divide_by_volume(moments, radii, magnetizations):
    """Write the magnetizations M = m/V [A/m] of balls, shape [n]; zero where the radius is zero."""
    inputs, outputs = [moments, radii], [magnetizations]
    wp.launch(_divide_kernel(radii.dtype), radii.shape[0], inputs=inputs, outputs=outputs, device=radii.device)


@cache
def _volume_gradients_kernel(dtype):
    vec3 = wp.types.vector(3, dtype)

    @wp.kernel(module="unique", enable_backward=False)
    def volume_gradients(
        radii: wp.array[dtype],
        moments: wp.array[vec3],
        by_moments: wp.array[vec3],
        by_magnetizations_out: wp.array[vec3],
        by_radii_out: wp.array[dtype],
    ):
        i = wp.tid()
        by_magnetizations_out[i] = ball_volume(radii[i]) * by_moments[i]
        by_radii_out[i] = dtype(3.0) / radii[i] * wp.dot(moments[i], by_moments[i])

    return volume_gradients


def launch_volume_gradients(radii, moments, by_moments, by_magnetizations, by_radii):
    """Write the gradients by magnetizations and radii of a function of the moments m = V M of balls, shape [n] each.

    ``by_moments`` is the gradient of the function by the moments. Radii are positive.
    """
    inputs, outputs = [radii, moments, by_moments], [by_magnetizations, by_radii]
    kernel = _volume_gradients_kernel(radii.dtype)
    wp.launch(kernel, radii.shape[0], inputs=inputs, outputs=outputs, device=radii.device)
