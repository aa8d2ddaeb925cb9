"""Pairs of shapes whose bounding boxes meet within a substep, and contacts of balls: for piles among other shapes.

Newton's broad phase sorts all boxes along an axis and compares those whose projections overlap, N^(5/3) in a heap of N
balls. Here balls find each other through the lists of neighbours that moments have, too (``pairs.neighbors``): these
hold what is near, and are made anew only once a ball has moved by a part of its radius. All other shapes are compared
with everything, a vector of boxes at a time. Which pairs are kept is decided as Newton does: by worlds, collision
groups, bodies and excluded pairs, and by whether the boxes meet as they move.

A ball is taken as the ball about the middle of its way that holds it all along, or, if it moves farther than contacts
are sought ahead, about where it is. Of two balls whose boxes meet but whose
surfaces do not come as near as contacts are sought, the pair is left out.

Pairs of a ball and a ball, plane, box or capsule become contacts at once (``ball_contacts.h``), all others are left to
Newton's narrow phase.
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
from warpmag.kernels.shared.team import team, threads_for

_SKIN = 0.3
"""Part of its radius that a ball may move before the lists are made anew."""
_LARGEST = 2.0
"""Balls of more than so many times the median radius are compared with everything, like other shapes: the largest
radius sets how wide the search's cells are."""
_PADDING = 16
"""Boxes that vectors may read beyond the last."""
_TARGETS_PER_THREAD = 120
"""Shapes that make another thread of a CPU worth waking."""
_TARGETS_AT_ONCE = 64
"""Targets that a thread of a CPU takes at a time."""
_MOST_COMPARISONS = 2e7
"""With other shapes; more take longer than to sort all boxes."""
_FEW = 25_000
"""Shapes beyond which the sort, too, compares more than that, N^(5/3), and each pair by itself."""
_MANY = 64
"""Other shapes from which a warp of a GPU shares a target, in place of a group of threads."""
_BLOCK = 128
_NOTES, _NOTE = 16 * _TARGETS_AT_ONCE, 12
"""Pairs and contacts that such a chunk of targets notes, and the numbers of each, as in ``broad_phase.h``."""
_PACKED_ROWS = 5
PARTNERS = ("plane", "ball", "capsule", "box")
"""Shapes whose contacts with balls are found here, as in ``ball_contacts.h``."""
_KINEMATIC = 2
"""Newton's flag of bodies that forces do not move."""
_lists_type = neighbors.lists_type(wp.float32)


@wp.struct
class BroadPhaseArrays:
    """Shapes, s of them, and the t targets among them that collide: b balls, then o others.

    Attributes:
        lower, upper: Boxes of the shapes [m], enlarged by how far contacts are sought, shape [s].
        displacement: Motion of the shapes within the substep [m], shape [s], or none.
        group, world, body: Collision group, world and body of the shapes, shape [s].
        kind: Index of each shape's kind in ``PARTNERS``, or their number if its contacts are left to Newton, shape [s].
        scale: Radius of balls and capsules, half of a capsule's length, half of a box's sides [m], shape [s].
        margin, gap: Distance of each surface from the shape, and up to which contacts are found [m], shape [s].
        frame, placement: Pose of the shapes in the world and in their bodies, shape [s].
        body_qd: Velocities of the bodies, see ``BodyView``.
        dt: Substep [s].
        body_flags: Newton's flags of the bodies.
        excluded: Sorted pairs of shapes that do not collide; the first ``excluded_count`` count.
        fixed_pairs: Whether shapes that forces do not move collide with each other.
        farthest: How far ahead of a shape contacts are sought, along an axis [m].
        shape: Shape of each target, shape [t]; the others of all worlds first, then by world, first those that cannot
            move.
        range: Others in the world of each target, begin and end, shape [t].
        shared: Others of all worlds.
        radius: Radii of the balls with how far contacts are sought [m], shape [b].
        lists: Neighbour lists of the balls; packed row 4 holds the radius that a ball was listed with, and the reach is
            that of the balls as they are.
        boxes: Swept boxes of the others [m], lower then upper, shape [6, o padded].
        bounds: On a CPU, boxes around those of each vector of others, shape [6, o / 16 padded].
        found: On a CPU, how many pairs and contacts chunks of targets find, and notes of them, shape [chunks, 2 + NOTE
            NOTES].
        pairs, pair_count: Out, the pairs and how many there are, also beyond their room.
        contacts: Out, contacts of balls; Newton's are appended.
    """

    lower: wp.array[wp.vec3]
    upper: wp.array[wp.vec3]
    displacement: wp.array[wp.vec3]
    group: wp.array[int]
    world: wp.array[int]
    body: wp.array[int]
    kind: wp.array[int]
    scale: wp.array[wp.vec3]
    margin: wp.array[float]
    gap: wp.array[float]
    frame: wp.array[wp.transform]
    placement: wp.array[wp.transform]
    body_qd: wp.array[wp.spatial_vector]
    dt: float
    body_flags: wp.array[int]
    excluded: wp.array[wp.vec2i]
    excluded_count: int
    fixed_pairs: int
    farthest: float
    shape: wp.array[int]
    range: wp.array[wp.vec2i]
    shared: int
    radius: wp.array[float]
    lists: _lists_type
    boxes: wp.array2d[float]
    bounds: wp.array2d[float]
    found: wp.array2d[int]
    pairs: wp.array[wp.vec2i]
    pair_count: wp.array[int]
    contacts: ContactView


@dataclass(frozen=True)
class PairSearch:
    """Buffers of the search on one device.

    Attributes:
        arrays: What the passes work on.
        targets: Number of targets.
        group: Threads of a GPU that share a target.
    """

    arrays: Any
    targets: int
    group: int


def allocate(shape_world, shape_body, colliding, ball_radius, *, farthest, device) -> PairSearch | None:
    """Plan the search.

    Args:
        shape_world: World of each shape, -1 for all worlds, shape [s].
        shape_body: Body of each shape, -1 for one that cannot move, shape [s].
        colliding: Whether a shape collides at all, shape [s].
        ball_radius: Radius [m] of a ball with how far contacts are sought, NaN for other shapes, shape [s].
        farthest: How far ahead of a shape contacts are sought [m].
        device: Warp device.

    Returns:
        The buffers; None where comparing all other shapes would take too long.
    """
    worlds = np.where(colliding, shape_world, -1)
    worlds = worlds if (worlds >= 0).any() else np.zeros_like(worlds)
    is_ball = colliding & np.isfinite(ball_radius) & (worlds >= 0)
    is_ball &= ball_radius <= _LARGEST * np.median(ball_radius[is_ball]) if is_ball.any() else False
    balls, others = np.flatnonzero(is_ball), np.flatnonzero(colliding & ~is_ball)
    others = others[np.lexsort((shape_body[others] >= 0, worlds[others]))]
    shape = np.concatenate([balls, others])
    limits = [np.searchsorted(worlds[others], worlds[shape], side) for side in ("left", "right")]
    ranges = np.where(worlds[shape] >= 0, limits, 0).T.astype(np.int32)
    shared = int(np.count_nonzero(worlds[others] < 0))
    comparisons = len(shape) * shared + np.sum(ranges[:, 1] - ranges[:, 0])
    if comparisons > _MOST_COMPARISONS * max(1.0, len(shape) / _FEW) ** (5 / 3):
        return None

    def integers(values, dtype=wp.int32):
        return wp.array(np.ascontiguousarray(values, np.int32), dtype=dtype, device=device)

    arrays = BroadPhaseArrays()
    arrays.shape, arrays.range, arrays.shared = integers(shape), integers(ranges, wp.vec2i), shared
    arrays.radius = wp.array(ball_radius[balls], dtype=float, device=device)
    packed = wp.zeros((_PACKED_ROWS, max(len(balls), 1)), dtype=float, device=device)
    group = integers(worlds[balls])
    # the reach is that of the present balls
    arrays.lists = neighbors.allocate(len(balls), packed, group, reach=0.0, ratio=1.0 + _SKIN)
    sizes = -(-len(others) // _PADDING) * _PADDING, len(others) // _PADDING
    arrays.boxes, arrays.bounds = (wp.empty((6, n + _PADDING), dtype=float, device=device) for n in sizes)
    for boxes in (arrays.boxes, arrays.bounds):
        boxes[:3].fill_(np.inf)
        boxes[3:].fill_(-np.inf)
    chunks = -(-len(shape) // _TARGETS_AT_ONCE) if device.is_cpu else 0
    arrays.found = wp.zeros((chunks, 2 + _NOTE * _NOTES), dtype=int, device=device)
    arrays.farthest = farthest
    return PairSearch(arrays, len(shape), 32 if len(others) >= _MANY else group_threads(device))


@cache
def _kernel(call: str, group: int):
    return native_kernel(
        f"{call}(thread, threads, team.data, arrays)", "contacts/broad_phase.h",
        {**PASS_ARGUMENTS, "arrays": BroadPhaseArrays}, dtype=wp.float32,
        CAPACITY=neighbors.CAPACITY, GROUP=group, BLOCK=_BLOCK, SKIN=_SKIN,
        KINEMATIC=_KINEMATIC, TARGETS_AT_ONCE=_TARGETS_AT_ONCE, NOTES=_NOTES, NOTE=_NOTE,
    )  # fmt: skip


def launch_find_shape_pairs(search: PairSearch) -> None:
    """Find the pairs of shapes whose boxes meet; ``search.arrays`` has the boxes, and gets pairs and contacts."""
    if search.targets == 0:
        return
    arrays = search.arrays
    _launch("place_targets", search, 1)
    if arrays.radius.shape[0]:
        neighbors.launch_find_neighbors(arrays.lists, arrays.lists)
    _launch("find_pairs", search, search.group)


def _launch(call: str, search: PairSearch, group: int) -> None:
    device = search.arrays.shape.device
    threads, members = (0, None) if device.is_cuda else (threads_for(search.targets, _TARGETS_PER_THREAD), team())
    wp.launch(
        _kernel(call, group),
        dim=group * search.targets if device.is_cuda else 1,
        inputs=[0, 1, threads, members, search.arrays],
        device=device,
        block_dim=_BLOCK,
    )
