"""Overlapping pairs: found once per arrangement, corrected in every pass over the pairs.

The all-pairs loops clamp the dipole at contact. What an overlapping pair lacks is added here, from a short list of
neighbours per moment, in the order of their indices. A list that is full is no error: its target walks all its sources
instead.

Lists hold everything nearer than (1 + ``SKIN``) times contact, and are made anew once a moment has moved by ``SKIN``
times its radius: what was farther apart is until then farther than contact. Which of them do overlap is sought for
every arrangement, and is what the passes over the pairs walk.

The search sorts moments into cubic cells as wide as the farthest pair of a list. A hash table holds for each cell the
last moment that was put in, and each moment knows the one before it. A target meets its neighbours in its own cell and
the 26 around it, on a GPU by a thread for each. The lists are then sorted, so that the order in which threads came does
not show. A CPU has a search of its own, ``neighbors_cpu``, and ``moment_code`` for what is done with the lists; what
stands here is what it falls back to, see ``cpu_team.VECTORS``.
"""

import math
from dataclasses import dataclass
from functools import cache
from typing import Any

import numpy as np
import warp as wp

from warpmag.kernels.pairs import neighbors_cpu
from warpmag.kernels.pairs.pair_law import field_of, gradient_of, overlap_factors, overlap_fraction, pair_factors
from warpmag.kernels.shared import team as cpu_team
from warpmag.kernels.shared.reductions import group_threads, places_in_group, wait_for_warp

CAPACITY = 64
"""Neighbours a list can hold before its target falls back to walking all its sources."""
SKIN = 0.6
"""Part of its radius that a moment may move before the lists are made anew. Longer lists are walked longer, but made
less often, and spare induction evaluations (see ``theta_flow``): what moves nearby is known best where it is listed."""
_BUCKETS_PER_MOMENT = 4
_PADDING = 16
"""Entries that vectors may read beyond the last."""
_FARTHEST_CELL = 1.0e9
"""Cells from the origin beyond which a moment is left out: its cell would be no integer."""


@wp.func
def bucket_of(cell: wp.vec4i, bucket_count: int):
    """Place of a cell (x, y, z, group) in a hash table of 2ᵏ buckets, after Teschner et al. 2003."""
    x = wp.uint32(cell[0]) * wp.uint32(73856093)
    y = wp.uint32(cell[1]) * wp.uint32(19349663)
    z = wp.uint32(cell[2]) * wp.uint32(83492791)
    mixed = x ^ y ^ z ^ (wp.uint32(cell[3]) * wp.uint32(49979687))
    return int(mixed & wp.uint32(bucket_count - 1))


@wp.kernel(enable_backward=False)
def empty_lists(
    # inputs:
    moved: wp.array[int],
    # outputs:
    searching_out: wp.array[int],
    last_out: wp.array[int],
    neighbor_count_out: wp.array[int],
):
    """Empty the hash table and the lists if they are to be made anew."""
    k = wp.tid()
    if k == 0:
        searching_out[0] = moved[0]
    if moved[0] == 1:
        if k < last_out.shape[0]:
            last_out[k] = -1
        if k < neighbor_count_out.shape[0]:
            neighbor_count_out[k] = 0


@wp.func
def find_cell(packed: wp.array2d(dtype=Any), i: int, group: int, width: wp.float64):
    """Cell (x, y, z, group) of moment ``i``; of no group where it has none."""
    x = wp.float64(packed[0, i]) / width
    y = wp.float64(packed[1, i]) / width
    z = wp.float64(packed[2, i]) / width
    farthest = wp.max(wp.abs(x), wp.max(wp.abs(y), wp.abs(z)))
    if wp.isfinite(x + y + z) and farthest < wp.float64(wp.static(_FARTHEST_CELL)):
        return wp.vec4i(int(wp.floor(x)), int(wp.floor(y)), int(wp.floor(z)), group)
    return wp.vec4i(0, 0, 0, -1)


@cache
def _fill_kernel(dtype):
    @wp.kernel(module="unique", enable_backward=False)
    def fill_cells(
        # inputs:
        sources: wp.array2d[dtype],
        group: wp.array[int],
        width: wp.float64,
        searching: wp.array[int],
        # outputs:
        cell_out: wp.array[wp.vec4i],
        last_out: wp.array[int],
        before_out: wp.array[int],
        moved_out: wp.array[int],
    ):
        j = wp.tid()
        if j == 0:
            moved_out[0] = 0
        if searching[0] == 0:
            return
        cell = find_cell(sources, j, group[j], width)
        cell_out[j] = cell
        if cell[3] >= 0:
            before_out[j] = wp.atomic_exch(last_out, bucket_of(cell, last_out.shape[0]), j)

    return fill_cells


@cache
def _search_kernel(dtype, cells: int):
    """Kernel whose threads search ``cells`` of the 27 cells around a target."""
    vec3 = wp.types.vector(3, dtype)

    @wp.kernel(module="unique", enable_backward=False)
    def search_cells(
        # inputs:
        targets: wp.array2d[dtype],
        sources: wp.array2d[dtype],
        group: wp.array[int],
        width: wp.float64,
        ratio: dtype,
        searching: wp.array[int],
        cell: wp.array[wp.vec4i],
        last: wp.array[int],
        before: wp.array[int],
        same_set: int,
        # outputs:
        neighbor_out: wp.array2d[int],
        neighbor_count_out: wp.array[int],
    ):
        if searching[0] == 0:
            return
        k, i = wp.tid()
        own = wp.vec4i()
        if same_set == 1:
            own = cell[i]
        else:
            own = find_cell(targets, i, group[i], width)
        if own[3] < 0:
            return
        x = vec3(targets[0, i], targets[1, i], targets[2, i])
        radius = targets[3, i]
        for c in range(k * wp.static(cells), (k + 1) * wp.static(cells)):
            sought = own + wp.vec4i(c // 9 - 1, c // 3 % 3 - 1, c % 3 - 1, 0)
            j = last[bucket_of(sought, last.shape[0])]
            while j >= 0:
                # a bucket may hold several cells
                if cell[j] == sought and not (same_set == 1 and i == j):
                    r = x - vec3(sources[0, j], sources[1, j], sources[2, j])
                    s = ratio * (radius + sources[3, j])
                    if wp.dot(r, r) < s * s:
                        place = wp.atomic_add(neighbor_count_out, i, 1)
                        if place < neighbor_out.shape[1]:
                            neighbor_out[i, place] = j
                j = before[j]

    return search_cells


@cache
def _sort_kernel(dtype, shares: int, capacity: int):
    """Kernel that sorts each list by ``shares`` threads, a whole warp if more than one."""
    vec3 = wp.types.vector(3, dtype)
    entries = wp.types.vector(math.ceil(capacity / shares), int)

    @wp.kernel(module="unique", enable_backward=False)
    def sort_lists(
        # inputs:
        targets: wp.array2d[dtype],
        searching: wp.array[int],
        neighbor_count: wp.array[int],
        # outputs:
        neighbor_out: wp.array2d[int],
        found_at_out: wp.array[vec3],
    ):
        if searching[0] == 0:
            return
        i = wp.tid() // wp.static(shares)
        share = wp.tid() % wp.static(shares)
        if share == 0:
            found_at_out[i] = vec3(targets[0, i], targets[1, i], targets[2, i])
        count = wp.min(neighbor_count[i], wp.static(capacity))
        mine = entries()
        place = entries()
        for n in range(share, count, wp.static(shares)):
            j = neighbor_out[i, n]
            before = int(0)
            for other in range(count):
                before += wp.where(neighbor_out[i, other] < j, 1, 0)
            mine[n // wp.static(shares)] = j
            place[n // wp.static(shares)] = before
        wait_for_warp()
        for n in range(share, count, wp.static(shares)):
            neighbor_out[i, place[n // wp.static(shares)]] = mine[n // wp.static(shares)]

    return sort_lists


@dataclass(frozen=True)
class SortedByCell:
    """Moments in the order of their cells, as a CPU searches them; arrays of nothing on a GPU.

    Attributes:
        begin: Where each bucket begins, shape [2ᵏ + 1].
        entries: Number, cell's x and y, and world of each, and the bucket of each moment, shape [5, n padded].
        places: Position and radius of each [m], shape [4, n padded].
    """

    begin: wp.array
    entries: wp.array
    places: wp.array


@dataclass(frozen=True)
class NeighborLists:
    """Neighbours of n moments, and what their search keeps.

    Attributes:
        ratio: What is nearer than this times contact is a neighbour.
        neighbor: Indices of the neighbours, ascending, shape [n, capacity].
        count: How many there are, also beyond the capacity, shape [n].
        found_at: Where each moment was when the lists were made [m], shape [n].
        moved: Whether one has moved too far since, shape [1]; set by ``packing``.
        searching: Whether the search that runs makes lists, shape [1].
        cell: Cell (x, y, z, group) of each moment, shape [n].
        last: Moment that was last put into each bucket, shape [2ᵏ].
        before: Moment that was put into its bucket before each, shape [n].
        by_cell: What a CPU has in the place of these three.
    """

    ratio: float
    neighbor: wp.array
    count: wp.array
    found_at: wp.array
    moved: wp.array
    searching: wp.array
    cell: wp.array
    last: wp.array
    before: wp.array
    by_cell: SortedByCell


def allocate(count: int, dtype, device, *, ratio=1.0 + SKIN, capacity=CAPACITY) -> NeighborLists:
    """Allocate the lists of ``count`` moments, empty."""
    buckets = 2 ** int(np.ceil(np.log2(_BUCKETS_PER_MOMENT * max(count, 1))))
    padded = count + _PADDING if wp.get_device(device).is_cpu else 0
    by_cell = SortedByCell(
        begin=wp.zeros(buckets + 1 if padded else 0, dtype=int, device=device),
        entries=wp.zeros((5, padded), dtype=int, device=device),
        places=wp.zeros((4, padded), dtype=dtype, device=device),
    )
    return NeighborLists(
        ratio=ratio,
        neighbor=wp.zeros((count, capacity), dtype=int, device=device),
        count=wp.zeros(count, dtype=int, device=device),
        found_at=wp.full(count, math.inf, dtype=wp.types.vector(3, dtype), device=device),
        moved=wp.ones(1, dtype=int, device=device),
        searching=wp.zeros(1, dtype=int, device=device),
        cell=wp.zeros(count, dtype=wp.vec4i, device=device),
        last=wp.zeros(buckets, dtype=int, device=device),
        before=wp.zeros(count, dtype=int, device=device),
        by_cell=by_cell,
    )


def launch_find_neighbors(targets, sources, target_group, source_group, reach, lists, source_lists):
    """List the sources near each target, if moments have moved since the last time.

    Args:
        targets: Packed targets, shape [8, t].
        sources: Packed sources, shape [8, n].
        target_group: Group of each target, shape [t]; it sees sources of its own group only.
        source_group: Group of each source, shape [n].
        reach: Distance of the farthest contact [m].
        lists: The targets' lists.
        source_lists: The sources' lists, whose cells are used; the targets' own if both are the same moments, none of
            which is its own neighbour.
    """
    device, dtype = targets.device, targets.dtype
    # what is near is nearer than a cell is wide, however the quotient is rounded
    width = wp.float64((lists.ratio + 1e-6) * reach)
    if device.is_cpu and cpu_team.VECTORS:
        neighbors_cpu.launch_search(
            targets, sources, target_group, source_group, width, lists, source_lists, _FARTHEST_CELL
        )
        return
    wp.launch(
        empty_lists,
        dim=max(source_lists.last.shape[0], targets.shape[1]),
        inputs=[lists.moved],
        outputs=[lists.searching, source_lists.last, lists.count],
        device=device,
    )
    wp.launch(
        _fill_kernel(dtype),
        dim=sources.shape[1],
        inputs=[sources, source_group, width, lists.searching],
        outputs=[source_lists.cell, source_lists.last, source_lists.before, lists.moved],
        device=device,
    )
    cells = 1 if device.is_cuda else 27
    wp.launch(
        _search_kernel(dtype, cells),
        dim=(27 // cells, targets.shape[1]),
        inputs=[
            targets,
            sources,
            target_group,
            width,
            dtype(lists.ratio),
            lists.searching,
            source_lists.cell,
            source_lists.last,
            source_lists.before,
            int(lists is source_lists),
        ],
        outputs=[lists.neighbor, lists.count],
        device=device,
    )
    shares, capacity = 32 if device.is_cuda else 1, lists.neighbor.shape[1]
    wp.launch(
        _sort_kernel(dtype, shares, capacity),
        dim=shares * targets.shape[1],
        inputs=[targets, lists.searching, lists.count],
        outputs=[lists.neighbor, lists.found_at],
        device=device,
    )


@cache
def _overlap_kernel(dtype):
    vec3 = wp.types.vector(3, dtype)

    @wp.kernel(module="unique", enable_backward=False)
    def list_overlaps(
        # inputs:
        targets: wp.array2d[dtype],
        sources: wp.array2d[dtype],
        neighbor: wp.array2d[int],
        neighbor_count: wp.array[int],
        shares: int,
        # outputs:
        overlap_out: wp.array2d[int],
        overlap_count_out: wp.array[int],
    ):
        i = wp.tid() // shares
        share = wp.tid() % shares
        count = neighbor_count[i]
        found = count
        if count <= wp.static(CAPACITY):
            found = int(0)
            x = vec3(targets[0, i], targets[1, i], targets[2, i])
            radius = targets[3, i]
            for first in range(0, count, shares):
                overlapping = int(0)
                j = neighbor[i, wp.min(first + share, count - 1)]
                if first + share < count:
                    r = x - vec3(sources[0, j], sources[1, j], sources[2, j])
                    s = radius + sources[3, j]
                    if wp.dot(r, r) < s * s:
                        overlapping = 1
                places = places_in_group(overlapping, shares)
                if overlapping == 1:
                    overlap_out[i, found + places[0]] = j
                found += places[1]
        if share == 0:
            overlap_count_out[i] = found

    return list_overlaps


def launch_list_overlaps(targets, sources, lists, overlap, overlap_count):
    """List those of each target's neighbours that overlap it.

    Args:
        targets: Packed targets, shape [8, t].
        sources: Packed sources, shape [8, n].
        lists: The targets' lists, of ``CAPACITY``.
        overlap: Out, indices of what overlaps each, ascending, shape [t, CAPACITY].
        overlap_count: Out, how many they are, shape [t]; where a list was full, its count, beyond the capacity.
    """
    if targets.device.is_cpu and cpu_team.VECTORS:
        neighbors_cpu.launch_overlaps(targets, sources, lists, overlap, overlap_count)
        return
    shares = group_threads(targets.device)
    wp.launch(
        _overlap_kernel(targets.dtype),
        dim=shares * targets.shape[1],
        inputs=[targets, sources, lists.neighbor, lists.count, shares],
        outputs=[overlap, overlap_count],
        device=targets.device,
    )


# ---------------------------------------------------------------------------------------------------------------------
# What is done with the lists
# ---------------------------------------------------------------------------------------------------------------------


@wp.func
def shared_volume(
    packed: wp.array2d(dtype=Any),
    i: int,
    begin: int,
    end: int,
    neighbor: wp.array2d[int],
    neighbor_count: wp.array[int],
    share: int,
    shares: int,
):
    """Volume that ball ``i`` shares with balls ``begin`` to ``end``, o_i = Σ_j |B_i ∩ B_j|/√(V_i V_j).

    Of that, as of all sums here, thread ``share`` of ``shares`` gets its share.

    Uniformly magnetized balls carry a field energy of at most ½μ0 ∫‖Σ M_i‖², so the eigenvalues of the coupling lie
    above 1/3 − (1 + max o_i), which is −2/3 without overlap. From it the induction solver takes a step length that
    converges for any arrangement.
    """
    total = packed[3, i] - packed[3, i]
    count = neighbor_count[i]
    if count <= wp.static(CAPACITY):
        for n in range(share, count, shares):
            j = neighbor[i, n]
            if j >= begin and j < end:
                total += pair_overlap(packed, i, j)
    else:
        for j in range(begin + share, end, shares):
            if j != i:
                total += pair_overlap(packed, i, j)
    return total


@wp.func
def pair_overlap(packed: wp.array2d(dtype=Any), i: int, j: int):
    """Share of their volume that two balls have in common; zero where one has none."""
    x = packed[0, i] - packed[0, j]
    y = packed[1, i] - packed[1, j]
    z = packed[2, i] - packed[2, j]
    d2 = x * x + y * y + z * z
    s = packed[3, i] + packed[3, j]
    if d2 < s * s and packed[3, i] * packed[3, j] > type(s)(0.0):
        return overlap_fraction(wp.sqrt(d2), packed[3, i], packed[3, j])
    return type(s)(0.0)


@wp.func
def contact_unit(a: Any, b: Any):
    """Inverse of two balls' distance in contact [1/m]; in it as the unit of length, no power of r overflows."""
    s = a + b
    one = type(s)(1.0)
    return wp.where(s > type(s)(0.0), one / s, one)


@wp.func
def near_pair(xi: Any, xj: Any, a: Any, b: Any, moment: Any):
    """4π times the field [A/m] at a ball of radius ``a`` of another's ``moment`` [A·m²], radius ``b``."""
    unit = contact_unit(a, b)
    r = unit * (xi - xj)
    return field_of(pair_factors(wp.dot(r, r), unit * a, unit * b), r, (unit * unit * unit) * moment)


@wp.func
def near_field(
    packed: wp.array2d(dtype=Any),
    moments: wp.array(dtype=Any),
    i: int,
    begin: int,
    end: int,
    neighbor: wp.array2d[int],
    neighbor_count: wp.array[int],
    share: int,
    shares: int,
):
    """4π times the field [A/m] at ball ``i`` of other ``moments`` [A·m²] on its neighbours among ``begin`` to ``end``.

    It serves to guess: a ball whose list is full gets none.
    """
    h = moments[i] - moments[i]
    count = neighbor_count[i]
    if count <= wp.static(CAPACITY):
        x = type(h)(packed[0, i], packed[1, i], packed[2, i])
        for n in range(share, count, shares):
            j = neighbor[i, n]
            if j >= begin and j < end:
                y = type(h)(packed[0, j], packed[1, j], packed[2, j])
                h += near_pair(x, y, packed[3, i], packed[3, j], moments[j])
    return h


@wp.func
def extrapolated_near_field(
    packed: wp.array2d(dtype=Any),
    positions: wp.array2d(dtype=Any),
    moments: wp.array2d(dtype=Any),
    ahead: Any,
    i: int,
    begin: int,
    end: int,
    neighbor: wp.array2d[int],
    neighbor_count: wp.array[int],
    share: int,
    shares: int,
):
    """What :func:`near_field` was at the last solution, and ``ahead`` of its change from the one before.

    Both are those of the present neighbours. Positions [m] and moments [A·m²] have shape [2, n], the last ones first.
    """
    h = moments[0, i] - moments[0, i]
    count = neighbor_count[i]
    if count <= wp.static(CAPACITY):
        a = packed[3, i]
        for n in range(share, count, shares):
            j = neighbor[i, n]
            if j >= begin and j < end:
                b = packed[3, j]
                last = near_pair(positions[0, i], positions[0, j], a, b, moments[0, j])
                h += last + ahead * (last - near_pair(positions[1, i], positions[1, j], a, b, moments[1, j]))
    return h


@cache
def pair_correction(dtype, gradient: bool, exclude_body: bool):
    """Warp function that corrects one target's sums for its overlapping sources within a range.

    It returns 4π times the field [A/m] and, with ``gradient``, the gradient [A/m²], as a vector of 3 or 9. Of several
    threads that take turns, thread ``share`` of ``shares`` gets its share of that.
    """
    vec3 = wp.types.vector(3, dtype)
    width = 9 if gradient else 3
    sums = wp.types.vector(width, dtype)

    @wp.func
    def one_pair(targets: wp.array2d[dtype], sources: wp.array2d[dtype], i: int, j: int):
        total = sums()
        r = vec3(targets[0, i] - sources[0, j], targets[1, i] - sources[1, j], targets[2, i] - sources[2, j])
        d2 = wp.dot(r, r)
        s = targets[3, i] + sources[3, j]
        left_out = False
        if wp.static(exclude_body):
            left_out = targets[7, i] == sources[7, j]
        if d2 < s * s and not left_out:
            unit = contact_unit(targets[3, i], sources[3, j])
            m = (unit * unit * unit) * vec3(sources[4, j], sources[5, j], sources[6, j])
            r *= unit
            g = overlap_factors(unit * wp.sqrt(d2), unit * targets[3, i], unit * sources[3, j])
            h = field_of(g, r, m)
            for c in range(3):
                total[c] = h[c]
            if wp.static(gradient):
                t = gradient_of(g, r, m)
                for c in range(6):
                    total[3 + c] = unit * t[c]
        return total

    @wp.func
    def correct_pairs(
        targets: wp.array2d[dtype],
        sources: wp.array2d[dtype],
        i: int,
        begin: int,
        end: int,
        skip: int,
        neighbor: wp.array2d[int],
        neighbor_count: wp.array[int],
        share: int,
        shares: int,
    ):
        total = sums()
        count = neighbor_count[i]
        nearest = neighbor[i, share]  # before it is known to be one, so that both are waited for at once
        listed = count <= wp.static(CAPACITY)
        for n in range(share, wp.where(listed, count, end - begin), shares):
            j = nearest
            if not listed:
                j = begin + n
            elif n > share:
                j = neighbor[i, n]
            if j >= begin and j < end and j != skip:
                total += one_pair(targets, sources, i, j)
        return total

    return correct_pairs
