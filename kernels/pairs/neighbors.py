"""Lists of neighbours: found once per arrangement, for all passes over overlapping pairs.

The all-pairs loops clamp the dipole at contact. What an overlapping pair lacks is added from a short list of neighbours
per moment, in ascending order. A list that is full is no error: its target goes through all its sources instead.

Lists hold everything nearer than (1 + ``SKIN``) times contact, and are made anew once a moment has moved by ``SKIN``
times its radius: what was farther apart is until then farther than contact. Which neighbours do overlap is found for
every arrangement.

The search sorts moments into cubic cells as wide as the largest distance of two neighbours, found by a hash table
(``cells.h``). The devices have a search each: a GPU's linked lists need no prefix sum over the buckets, and a CPU's
counting sort puts what a vector of candidates reads side by side.
"""

import math
from functools import cache

import warp as wp

from warpmag.kernels.shared.native import native_kernel
from warpmag.kernels.shared.reductions import group_threads
from warpmag.kernels.shared.team import MOMENTS_PER_THREAD, team, threads_for

CAPACITY = 64
"""Neighbours a list can hold before its target falls back to going through all its sources."""
SKIN = 0.6
"""Part of its radius that a moment may move before the lists are made anew. Longer lists take longer to go through, but
are made less often, and spare induction evaluations (see ``theta_flow``), which predict the moments of neighbours."""
_BUCKETS_PER_MOMENT = 4
_BLOCK = 128
_PADDING = 16
"""Entries that vectors may read beyond the last."""


@cache
def lists_type(dtype):
    """Struct of moments, or other balls, and their neighbours; see :func:`allocate`."""
    vec3 = wp.types.vector(3, dtype)

    @wp.struct
    class NeighborLists:
        """Moments, their neighbours, and what the search keeps; see :func:`allocate`."""

        packed: wp.array2d[dtype]
        group: wp.array[int]
        ratio: wp.float64
        reach: wp.array[wp.float64]
        neighbor: wp.array2d[int]
        count: wp.array[int]
        overlap: wp.array2d[int]
        overlap_count: wp.array[int]
        found_at: wp.array[vec3]
        moved: wp.array[int]
        searching: wp.array[int]
        searches: wp.array[int]
        bucket: wp.array[int]
        table: wp.array[wp.uint64]
        cell: wp.array[wp.vec4i]
        before: wp.array[int]
        entries: wp.array2d[int]
        places: wp.array2d[dtype]

    return NeighborLists


def allocate(count: int, packed, group, *, reach: float, ratio=1.0 + SKIN, capacity=CAPACITY):
    """Allocate the lists of moments, empty.

    Args:
        count: Number of moments n.
        packed: The packed moments, shape [8, n].
        group: Group of each, shape [n] or longer: only moments of one group are neighbours, none if it is negative.
        reach: Distance of the farthest contact [m].
        ratio: What is nearer than this times contact is a neighbour; with 1 the neighbours are what overlaps.
        capacity: Neighbours a list can hold.

    Returns:
        A Warp struct of these, the reach as an array of shape [1], and
            neighbor: Indices of the neighbours, ascending, shape [n, capacity].
            count: How many there are, also beyond the capacity, shape [n].
            overlap: Indices of what overlaps each, ascending, shape [n, capacity].
            overlap_count: How many they are, shape [n]; where a list is full, its count.
            found_at: Where each moment was when the lists were made [m], shape [n].
            moved: Whether one has moved too far since, shape [1]; set by ``packing``.
            searching: Whether the last search made lists, shape [1]; on a GPU its number.
            searches: On a GPU the last search that filled the hash table, shape [1].
            bucket: On a CPU where each bucket begins, shape [2ᵏ + 1].
            table: On a GPU the number of the last search that used each bucket, and the moment that it last put there,
                shape [2ᵏ].
            cell: On a GPU the cell (x, y, z, group) of each moment, shape [n].
            before: On a GPU the moment that was put into its bucket before each, −1 if none, shape [n].
            entries: On a CPU, in the order of buckets, index, cell's x and y, and group, and the bucket of each moment,
                shape [5, n padded].
            places: On a CPU, in that order, positions and radii [m], shape [4, n padded].
    """
    device, dtype = packed.device, packed.dtype
    linked, padded = (0, count + _PADDING) if device.is_cpu else (count, 0)
    lists = lists_type(dtype)()
    lists.packed, lists.group, lists.ratio = packed, group, ratio
    lists.reach = wp.full(1, reach, dtype=wp.float64, device=device)
    lists.neighbor = (wp.zeros if ratio > 1.0 else wp.empty)((count, capacity), dtype=int, device=device)
    lists.count = wp.zeros(count, dtype=int, device=device)
    lists.overlap, lists.overlap_count = lists.neighbor, lists.count
    if ratio > 1.0:
        lists.overlap, lists.overlap_count = wp.zeros_like(lists.neighbor), wp.zeros_like(lists.count)
    lists.found_at = wp.full(count, math.inf, dtype=wp.types.vector(3, dtype), device=device)
    lists.moved = wp.ones(1, dtype=int, device=device)
    lists.searching, lists.searches = (wp.zeros(1, dtype=int, device=device) for _ in range(2))
    buckets = 2 ** math.ceil(math.log2(_BUCKETS_PER_MOMENT * max(count, 1)))
    lists.bucket = wp.zeros(buckets + 1 if device.is_cpu else 0, dtype=int, device=device)
    lists.table = wp.zeros(0 if device.is_cpu else buckets, dtype=wp.uint64, device=device)
    lists.cell = wp.zeros(linked, dtype=wp.vec4i, device=device)
    lists.before = wp.zeros(linked, dtype=int, device=device)
    lists.entries = wp.zeros((5, padded), dtype=int, device=device)
    lists.places = wp.zeros((4, padded), dtype=dtype, device=device)
    return lists


def carried_lists(lists) -> dict:
    """Return the arrays of lists that one search hands on to the next one, by name."""
    return {name: getattr(lists, name) for name in ("neighbor", "count", "found_at", "moved", "searching")}


@cache
def _kernel(call: str, header: str, dtype, capacity: int, group: int):
    arguments = {"threads": int, "team": wp.array2d[wp.uint64]}
    arguments |= dict.fromkeys(("targets", "sources"), lists_type(dtype))
    return native_kernel(call, header, arguments, dtype=dtype, CAPACITY=capacity, GROUP=group, BLOCK=_BLOCK)


def _launch(call: str, targets, sources, dim: int = 1):
    """Launch threads that call a function of the device's header; on a CPU one, which shares the work out."""
    device = targets.packed.device
    header, threads, members = "pairs/neighbors_cuda.h", 0, None
    if device.is_cpu:
        header, members = "pairs/neighbors_cpu.h", team()
        threads = threads_for(targets.packed.shape[1], MOMENTS_PER_THREAD)
    wp.launch(
        _kernel(call, header, targets.packed.dtype, targets.neighbor.shape[1], group_threads(device)),
        dim=dim,
        inputs=[threads, members, targets, sources],
        device=device,
        block_dim=_BLOCK,
    )


def launch_find_neighbors(targets, sources):
    """List the sources near each target, if targets have moved too far since the last time.

    Args:
        targets: Lists of the targets; their reach is that of both.
        sources: Lists of the sources, whose hash table is used; the targets' own if both are the same moments, none of
            which is its own neighbour.
    """
    if targets.packed.device.is_cpu:
        _launch("search_neighbors(targets, sources, threads, team.data)", targets, sources)
        return
    for call, dim in (
        ("fill_table", max(sources.packed.shape[1], 1)),
        ("list_neighbors", 32 * targets.packed.shape[1]),
    ):
        _launch(f"{call}(thread, targets, sources)", targets, sources, dim)


def launch_list_overlaps(targets, sources):
    """List those of each target's neighbours that overlap it; both are lists."""
    if targets.overlap is targets.neighbor:
        return
    if targets.packed.device.is_cpu:
        _launch("list_overlaps_of_all(targets, sources, threads, team.data)", targets, sources)
    else:
        dim = group_threads(targets.packed.device) * targets.packed.shape[1]
        _launch("list_overlaps(targets, sources, thread / warpmag::GROUP)", targets, sources, dim)
