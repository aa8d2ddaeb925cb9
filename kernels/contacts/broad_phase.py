"""Broad phase for piles of balls among other shapes, and the contacts of balls.

Newton's broad phase sorts all bounding boxes along an axis and compares those whose projections overlap: N^(5/3)
comparisons in a heap of N balls. Here balls find each other in neighbor lists (``pairs.neighbors``), which are rebuilt
only after a ball has moved by a fraction of its radius. All other shapes are compared with all targets, a vector of
boxes at a time. Pairs are selected by Newton's rules: worlds, collision groups, bodies, excluded pairs, and boxes that
overlap as they move.

A ball is represented by a ball that encloses it throughout the substep. If it moves farther than ``farthest``, the
enclosing ball is about its present position. Two balls whose boxes overlap, but whose surfaces stay farther apart than
contacts are detected, are not a pair.

Pairs of a ball and a ball, plane, box or capsule become contacts directly (``ball_contacts.h``). Newton's narrow phase
takes all others.
"""

from dataclasses import dataclass
from functools import cache
from typing import Any

import numpy as np
import warp as wp

from warpmag.kernels.pairs import neighbors
from warpmag.kernels.rigid.newton_views import ContactView
from warpmag.kernels.shared.native import PASS_ARGUMENTS, native_kernel
from warpmag.kernels.shared.reductions import group_threads
from warpmag.kernels.shared.team import launch_passes, threads_for

_SKIN = 0.3  # fraction of its radius that a ball may move before the neighbor lists are rebuilt
_LARGEST_LISTED_RADIUS = 2.0
"""Radius [median radii] beyond which a ball is compared with all targets, like other shapes: the largest radius in the
neighbor lists sets the width of the search's cells."""
_PADDING = 16  # boxes that vectors may read after the last one
_TARGETS_PER_THREAD = 120  # fewest shapes per thread of a CPU
_TARGETS_AT_ONCE = 64  # targets in a chunk of a CPU thread
_MOST_COMPARISONS = 2e7  # comparisons with other shapes beyond which Newton's sort is faster
_CONSTANT_LIMIT_SHAPES = 25_000  # shapes beyond which the limit grows as N^(5/3), like the comparisons of Newton's sort
_OTHERS_FOR_A_WARP = 64
"""Fewest other shapes with which a warp of a GPU shares a target, instead of a smaller group of threads."""
_BLOCK = 128
_RESULTS, _RESULT_SIZE = 16 * _TARGETS_AT_ONCE, 12
"""Results that a chunk of targets can buffer, and the numbers of each, as in ``broad_phase.h``."""
_PACKED_ROWS = 5
PARTNERS = ("plane", "ball", "capsule", "box")
"""Shapes whose contacts with balls are detected here, as in ``ball_contacts.h``."""
_KINEMATIC = 2  # Newton's flag of bodies that forces do not move
_lists_type = neighbors.lists_type(wp.float32)


@wp.struct
class BroadPhaseArrays:
    """Arrays of the broad phase, for s shapes. The t shapes that can collide are targets: b balls, then o others."""

    # Model:
    lower: wp.array[wp.vec3]  # corners of the boxes around shapes, enlarged by the detection distance [m], shape [s]
    upper: wp.array[wp.vec3]
    displacement: wp.array[wp.vec3]  # displacement of the shapes in the substep [m], shape [s], or empty
    group: wp.array[int]  # collision group of each shape, shape [s]
    world: wp.array[int]  # its world
    body: wp.array[int]  # its body
    kind: wp.array[int]  # index of each shape's type in ``PARTNERS``, or ``len(PARTNERS)`` for other types, shape [s]
    # Radius of balls and capsules, half length of capsules, half extents of boxes [m], shape [s].
    scale: wp.array[wp.vec3]
    margin: wp.array[float]  # distance of each surface from the shape [m], shape [s]
    gap: wp.array[float]  # detection distance of contacts [m], shape [s]
    frame: wp.array[wp.transform]  # pose of each shape in the world, shape [s]
    placement: wp.array[wp.transform]  # its pose in its body
    body_qd: wp.array[wp.spatial_vector]  # velocities of the bodies, see ``BodyView``
    dt: float  # length of the substep [s]
    body_flags: wp.array[int]  # Newton's flags of the bodies
    excluded: wp.array[wp.vec2i]  # sorted pairs of shapes that do not collide, ``excluded_count`` of them
    excluded_count: int
    fixed_pairs: int  # 1 if shapes that forces do not move collide with each other
    farthest: float  # largest displacement of a shape for which contacts are detected in advance, along an axis [m]
    # Targets and work:
    # Shape of each target, shape [t]. Others of all worlds come first, then others by world, the immovable ones first.
    shape: wp.array[int]
    range: wp.array[wp.vec2i]  # first other in the world of each target, and the one after the last, shape [t]
    shared: int  # number of others of all worlds
    radius: wp.array[float]  # radii of the balls, plus the detection distance [m], shape [b]
    # Neighbor lists of the balls. Packed row 4 holds the radius that a list was made with. The search distance is that
    # of the present balls.
    lists: _lists_type
    boxes: wp.array2d[float]  # swept boxes of the others, lower then upper [m], shape [6, o padded]
    bounds: wp.array2d[float]  # CPU: bounding box of each vector of swept boxes, shape [6, o / 16 padded]
    # CPU: numbers of pairs and contacts of each chunk of targets, and the results, shape
    # [chunks, 2 + RESULT_SIZE RESULTS].
    results: wp.array2d[int]
    # Data out:
    pairs: wp.array[wp.vec2i]
    pair_count: wp.array[int]  # number of pairs, which may exceed the capacity, shape [1]
    contacts: ContactView  # contacts of balls; Newton appends its own


@dataclass(frozen=True)
class PairSearch:
    """Buffers of the search on one device."""

    arrays: Any  # arrays of the search, :class:`BroadPhaseArrays`
    targets: int  # number of targets
    group: int  # threads of a GPU that share a target


def allocate(shape_world, shape_body, colliding, ball_radius, *, farthest, device) -> PairSearch | None:
    """Return the buffers, or None where comparing all other shapes would take too long.

    Args:
        shape_world: World of each shape, -1 for all worlds, shape [s].
        shape_body: Body of each shape, -1 for an immovable shape, shape [s].
        colliding: True for shapes that collide at all, shape [s].
        ball_radius: Radius of a ball plus the detection distance of contacts [m], NaN for other shapes, shape [s].
        farthest: Largest displacement of a shape for which contacts are detected in advance [m].
    """
    worlds = np.where(colliding, shape_world, -1)
    worlds = worlds if (worlds >= 0).any() else np.zeros_like(worlds)
    is_ball = colliding & np.isfinite(ball_radius) & (worlds >= 0)
    is_ball &= ball_radius <= _LARGEST_LISTED_RADIUS * np.median(ball_radius[is_ball]) if is_ball.any() else False
    balls, others = np.flatnonzero(is_ball), np.flatnonzero(colliding & ~is_ball)
    others = others[np.lexsort((shape_body[others] >= 0, worlds[others]))]
    shape = np.concatenate([balls, others])
    limits = [np.searchsorted(worlds[others], worlds[shape], side) for side in ("left", "right")]
    ranges = np.where(worlds[shape] >= 0, limits, 0).T.astype(np.int32)
    shared = int(np.count_nonzero(worlds[others] < 0))
    comparisons = len(shape) * shared + np.sum(ranges[:, 1] - ranges[:, 0])
    if comparisons > _MOST_COMPARISONS * max(1.0, len(shape) / _CONSTANT_LIMIT_SHAPES) ** (5 / 3):
        return None

    def integers(values, dtype=wp.int32):
        return wp.array(np.ascontiguousarray(values, np.int32), dtype=dtype, device=device)

    arrays = BroadPhaseArrays()
    arrays.shape, arrays.range, arrays.shared = integers(shape), integers(ranges, wp.vec2i), shared
    arrays.radius = wp.array(ball_radius[balls], dtype=float, device=device)
    packed = wp.zeros((_PACKED_ROWS, max(len(balls), 1)), dtype=float, device=device)
    group = integers(worlds[balls])
    # the search distance follows the present balls
    arrays.lists = neighbors.allocate(len(balls), packed, group, reach=0.0, ratio=1.0 + _SKIN)
    sizes = -(-len(others) // _PADDING) * _PADDING, len(others) // _PADDING
    arrays.boxes, arrays.bounds = (wp.empty((6, n + _PADDING), dtype=float, device=device) for n in sizes)
    for boxes in (arrays.boxes, arrays.bounds):
        boxes[:3].fill_(np.inf)
        boxes[3:].fill_(-np.inf)
    chunks = -(-len(shape) // _TARGETS_AT_ONCE) if device.is_cpu else 0
    arrays.results = wp.zeros((chunks, 2 + _RESULT_SIZE * _RESULTS), dtype=int, device=device)
    arrays.farthest = farthest
    return PairSearch(arrays, len(shape), 32 if len(others) >= _OTHERS_FOR_A_WARP else group_threads(device))


@cache
def _kernel(call: str, group: int):
    return native_kernel(
        f"{call}(thread, threads, team.data, arrays)", "contacts/broad_phase.h",
        {**PASS_ARGUMENTS, "arrays": BroadPhaseArrays}, dtype=wp.float32,
        CAPACITY=neighbors.CAPACITY, GROUP=group, BLOCK=_BLOCK, SKIN=_SKIN,
        KINEMATIC=_KINEMATIC, TARGETS_AT_ONCE=_TARGETS_AT_ONCE, RESULTS=_RESULTS, RESULT_SIZE=_RESULT_SIZE,
    )  # fmt: skip


def launch_find_shape_pairs(search: PairSearch) -> None:
    """Find the pairs of shapes whose boxes overlap, and the contacts of balls; ``search.arrays`` receives them."""
    if search.targets == 0:
        return
    arrays = search.arrays
    _launch("place_targets", search, 1)
    if arrays.radius.shape[0]:
        neighbors.launch_find_neighbors(arrays.lists, arrays.lists, wp.launch)
    _launch("find_pairs", search, search.group)


def _launch(call: str, search: PairSearch, group: int) -> None:
    arrays, targets = search.arrays, search.targets
    sizes = dict(threads=threads_for(targets, _TARGETS_PER_THREAD), gpu_threads=group * targets, block_dim=_BLOCK)
    launch_passes(_kernel(call, group), 0, 1, arrays, device=arrays.shape.device, **sizes)
