"""Neighbor lists, for corrections of overlapping pairs.

The all-pairs loops clamp the dipole at contact. Corrections of overlapping pairs are added from a short list of
neighbors per moment, in ascending order. If a list is full, its target visits all its sources instead.

Neighbors are nearer than (1 + ``SKIN``) times the contact distance. The lists are rebuilt once a moment has moved by
``SKIN`` times its radius; until then no other pair can touch. The neighbors that overlap are listed for every
arrangement.

The search sorts moments into cubic cells as wide as the largest distance of neighbors, with a hash table
(``neighbor_cells.h``). Each device has its own search. Linked lists on a GPU need no prefix sum over buckets. A
counting sort on a CPU makes the candidates of a target contiguous.
"""

import math
from functools import cache

import numpy as np
import warp as wp

from warpmag.kernels.shared.native import native_kernel
from warpmag.kernels.shared.reductions import group_threads, most_blocks
from warpmag.kernels.shared.team import MOMENTS_PER_THREAD, team, threads_for

CAPACITY = 64  # length of a list
SKIN = 0.6
"""Fraction of its radius that a moment may move before the lists are rebuilt. A larger skin makes lists longer and
rebuilds rarer. Longer lists also save field evaluations of the induction, which predicts the moments of neighbors
(``theta_flow``)."""
_BUCKETS_PER_MOMENT = 4
_BLOCK = 128
_PADDING = 16  # entries beyond the last that vectors may read


@cache
def lists_type(dtype):
    """Struct of moments, or other balls, and their neighbors; see :func:`allocate`."""
    vec3 = wp.types.vector(3, dtype)

    @wp.struct
    class NeighborLists:
        # Model:
        group: wp.array[int]  # only moments of one group are neighbors; none if negative, shape [n] or longer
        body: wp.array[int]  # moments of one body are not neighbors, shape [n]
        ratio: wp.float64  # distance of neighbors over their contact distance, at most
        reach: wp.array[wp.float64]  # largest contact distance [m], shape [1]
        # Data in:
        packed: wp.array2d[dtype]
        radius: wp.array[dtype]  # radii that determine contact distances [m], shape [n]
        moved: wp.array[int]  # 1 if a moment has moved too far since the last search, shape [1]; from ``packing``
        # Data out:
        neighbor: wp.array2d[int]  # ascending indices of neighbors, shape [n, capacity]
        count: wp.array[int]  # number of neighbors, which may exceed the capacity, shape [n]
        overlap: wp.array2d[int]  # ascending indices of overlapping neighbors, shape [n, capacity]
        overlap_count: wp.array[int]  # their number; ``count`` where a list is full, shape [n]
        found_at: wp.array[vec3]  # positions at the last search [m], shape [n]
        searching: wp.array[int]  # nonzero if the last search rebuilt the lists, shape [1]; on a GPU its number
        # Buffers of a GPU:
        searches: wp.array[int]  # number of the last search that filled the hash table, shape [1]
        table: wp.array[wp.uint64]  # last search and last moment of each bucket, shape [2ᵏ]
        cell: wp.array[wp.vec4i]  # cell (x, y, z, group) of each moment, shape [n]
        before: wp.array[int]  # previous moment of the same bucket, or -1, shape [n]
        # Buffers of a CPU, in the order of buckets:
        bucket: wp.array[int]  # first entry of each bucket, shape [2ᵏ + 1]
        entries: wp.array2d[int]  # index, body, cell's x and y, group; and each moment's bucket, shape [6, n padded]
        balls: wp.array2d[dtype]  # positions and radii [m], shape [4, n padded]

    return NeighborLists


def allocate(count: int, packed, group, *, reach: float, ratio=1.0 + SKIN, capacity=CAPACITY, radii=None, bodies=None):
    """Allocate empty lists of ``count`` moments; return the struct :func:`lists_type`, which describes the arguments.

    A ``ratio`` of 1 lists overlapping pairs only. None for ``radii`` means those of the packed moments. Without
    ``bodies`` each moment is a body.
    """
    device, dtype = packed.device, packed.dtype
    linked, padded = (0, count + _PADDING) if device.is_cpu else (count, 0)
    lists = lists_type(dtype)()
    lists.packed, lists.group, lists.ratio = packed, group, ratio
    lists.radius = packed[3] if radii is None else radii
    own_bodies = np.arange(count, dtype=np.int32)
    lists.body = wp.array(own_bodies if bodies is None else bodies, dtype=wp.int32, device=device)
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
    lists.entries = wp.zeros((6, padded), dtype=int, device=device)
    lists.balls = wp.zeros((4, padded), dtype=dtype, device=device)
    return lists


def persistent_lists(lists) -> dict:
    """Return the arrays that a search reads from the previous search, by name."""
    return {name: getattr(lists, name) for name in ("neighbor", "count", "found_at", "moved", "searching")}


@wp.kernel(enable_backward=False)
def _request_search(chosen: wp.array[int], moved: wp.array[int]):
    if chosen[wp.tid()] != 0:
        moved[0] = 1


def launch_request_search(lists, chosen):
    """Rebuild the lists in the next search if any entry of ``chosen`` is not 0, as if a moment had moved too far."""
    wp.launch(_request_search, len(chosen), inputs=[chosen], outputs=[lists.moved], device=chosen.device)


@cache
def _kernel(call: str, header: str, dtype, capacity: int, group: int):
    arguments = {"threads": int, "team": wp.array2d[wp.uint64]}
    arguments |= dict.fromkeys(("targets", "sources"), lists_type(dtype))
    return native_kernel(call, header, arguments, dtype=dtype, CAPACITY=capacity, GROUP=group, BLOCK=_BLOCK)


def _launch(launch, call: str, targets, sources, dim: int = 1, most: int = 0):
    """Launch ``dim`` threads that make a call of the device's header; on a CPU one thread shares it with the team.

    At most ``most`` blocks make several calls in each thread; 0 means that each thread makes one call.
    """
    device = targets.packed.device
    header, threads, members = "pairs/neighbors_cuda.h", 0, None
    if device.is_cpu:
        header, members = "pairs/neighbors_cpu.h", team()
        threads = threads_for(targets.packed.shape[1], MOMENTS_PER_THREAD)
    kernel = _kernel(call, header, targets.packed.dtype, targets.neighbor.shape[1], group_threads(device))
    options = {"device": device, "block_dim": _BLOCK, "max_blocks": most}
    launch(kernel, dim, inputs=[threads, members, targets, sources], **options)


def launch_find_neighbors(targets, sources, launch):
    """List the sources near each target, if a target has moved too far since the last search.

    ``targets`` holds the reach of both sets, ``sources`` the hash table. If both are the same, a moment is not its own
    neighbor. ``launch`` is ``wp.launch``, or the ``RecordedLaunches`` of these lists.
    """
    if targets.packed.device.is_cpu:
        _launch(launch, "search_neighbors(targets, sources, threads, team.data)", targets, sources)
        return
    _launch(launch, "fill_table(thread, targets, sources)", targets, sources, max(sources.packed.shape[1], 1))
    # in most steps nothing has moved too far, and a block for each four targets would only start and end
    dim, most = 32 * targets.packed.shape[1], most_blocks(targets.packed.device)
    _launch(launch, "list_neighbors(thread, targets, sources)", targets, sources, dim, most)


def launch_list_overlaps(targets, sources, launch):
    """List the neighbors of each target that overlap it, by the ``RecordedLaunches`` of these lists."""
    if targets.overlap is targets.neighbor:
        return
    if targets.packed.device.is_cpu:
        _launch(launch, "list_overlaps_of_all(targets, sources, threads, team.data)", targets, sources)
    else:
        dim = group_threads(targets.packed.device) * targets.packed.shape[1]
        _launch(launch, "list_overlaps(targets, sources, thread / warpmag::GROUP)", targets, sources, dim)
