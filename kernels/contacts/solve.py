"""Newton's XPBD for rigid bodies in contact, with work proportional to contacts and sums in a fixed order.

Once a substep the contacts are listed for each body that they can move. An iteration then relaxes all contacts at once
(``contact_law.h``), and each body sums up the impulses of its own contacts. On a CPU one launch does all iterations,
and the impulse of a contact is computed once. On a GPU both bodies compute it, and an iteration is a launch. A small
scene, or many small worlds, are solved in one launch (``solve_cluster.h``).
"""

from dataclasses import dataclass
from functools import cache
from typing import Any

import numpy as np
import warp as wp

from warpmag.kernels.rigid.newton_views import BodyView, ContactView
from warpmag.kernels.rigid.worlds import is_chosen
from warpmag.kernels.shared.native import CHUNK, LINE, native_kernel
from warpmag.kernels.shared.team import team, threads_for

RECOVERY_SPEED = 2.0
"""Penetration recovery speed [m/s]: the limit at which overlapping bodies separate, because they keep that speed. In
the longest substep, 0.5 ms, it undoes an overlap of 1 mm. In the shortest, 31 µs, it undoes the new overlap that a step
allows balls of 5 mm."""
FRICTION, MOMENTUM = 0.35, 0.8
"""Relaxation of friction relative to that of normal impulses, because friction also rotates balls; and the largest
Nesterov momentum of an iteration."""
_GROUPS = ((100, 32), (400, 16), (6_000, 8), (20_000, 4), (2**31, 2))
"""Threads of a GPU that share a body, as (most bodies, threads): fastest with three contacts per body on an H200."""
_CLUSTER, _CLUSTER_CAPACITY, _SIDES_PER_BLOCK = 16, 50_000, 375
"""Blocks of a cluster; most contacts that it lists; and most sides per block that it iterates over. With more sides,
launches are faster: a cluster takes a third of their time in Balls Up (1,500 sides), and longer in Falling Magnet
(10,000)."""
_WORLDS, _WORLD_GROUP, _WORLD_LINES = 16, 8, (32, 64, 128, 208)
"""Number of worlds beyond which each has its own block; threads that share a body there; and possible numbers of bodies
in a block's shared memory."""
_BLOCK, _WIDE_BLOCKS = 128, 64  # threads of a block; and blocks for wide bodies, which a whole block shares
_WIDE = 16, 4, 64
"""A body is wide with more contacts than 16 + 4 for each thread of its group, 64 at most. In Letters a body
has up to 140 contacts. A solve takes 0.12 ms on an H200, and 0.14 ms without wide bodies, in groups of 32 threads."""
_CONTACTS_PER_THREAD = 100  # fewest contacts per thread of a CPU: an iteration over them takes 1 to 2 µs
_ROUND_TOLERANCE = 1e-6  # relative difference of inverse inertias up to which a body counts as round: float32 rounding
_CONTACT_SIZE, _RETURN_SIZE, _IMPULSE_SIZE, _RECORD_SIZE, _KEPT_SIZE = 20, 8, 12, 8, 9
"""Sizes, in numbers, of a contact, its return velocity, its accumulated impulse, a record and a kept slip; as in
``solve_arrays.h``."""
_TOTALS, _UNSOLVED = 6, 4
"""Number of totals, and index of the bodies that a cluster leaves to launches; as in ``solve_cuda.h``."""


@wp.struct
class SolveArrays:
    """Addresses of the arrays of the solver, for c contacts, b bodies and l lines; ``Arrays`` in ``solve_arrays.h``.

    Addresses instead of arrays make a launch's arguments 0.4 KB long instead of 2.9 KB. A solve on a GPU is up to 30
    launches of a few microseconds.

    A side is a contact seen from one of its bodies. A line holds a body that takes part, at the length of a cache line;
    the last one is the world. P is c, padded to a multiple of CHUNK. A CPU holds contacts in vectors, seen from their
    second bodies, as [P / CHUNK, numbers, CHUNK]. A GPU holds both sides, ordered by body.
    """

    # sizes: c, b and l
    contact_max: int
    body_count: int
    line_count: int
    kinematic_flag: int  # Newton's flag of kinematic bodies
    # contacts, as in ContactView
    count: wp.uint64
    shape0: wp.uint64
    shape1: wp.uint64
    shape_body: wp.uint64
    point0: wp.uint64
    point1: wp.uint64
    offset0: wp.uint64
    offset1: wp.uint64
    normal: wp.uint64
    margin0: wp.uint64
    margin1: wp.uint64
    mu: wp.uint64
    mu_torsional: wp.uint64
    mu_rolling: wp.uint64
    # bodies, as in BodyView; ``qd`` is written
    flags: wp.uint64
    com: wp.uint64
    inv_mass: wp.uint64
    inv_inertia: wp.uint64
    q: wp.uint64
    qd: wp.uint64
    # work
    shares: wp.uint64  # number of shares that mass splitting divides each body into, shape [b]; 0 for whole bodies
    # GPU: numbers of bodies and sides that take part, of immovable, wide and unsolved bodies, and 1 if a contact has
    # friction, shape [6]. Launches solve the bodies that a cluster leaves unsolved.
    totals: wp.uint64
    side_count: wp.uint64  # number of sides of each body, shape [b]
    filled: wp.uint64  # GPU: number of those that are listed so far, shape [b]
    slot: wp.uint64  # line of each body, shape [b]
    body: wp.uint64  # body of each line, -1 for the world, shape [l]
    range: wp.uint64  # first of the sides of a line's body, and the one after the last, shape [l, 2]
    entry: wp.uint64  # GPU: 2 c + end for each side of contact c, by body, shape [2P]. CPU: contacts of movable bodies
    # GPU: line of the other body, then contact of each side, shape [2, 2c]. CPU: lines of the first and second body,
    # then their records, shape [P / CHUNK, 4, CHUNK].
    other: wp.uint64
    records_zero: wp.uint64  # CPU: 1 for each vector of contacts whose records are zero, shape [P / CHUNK]
    wide: wp.uint64  # GPU: lines of wide bodies, shape [b]
    world_first: wp.uint64  # first body of each world that has a block, and the one after the last, shape [worlds + 1]
    kept_range: wp.uint64  # range of the sides of each body in the last substep, shape [b, 2]
    key: wp.uint64  # GPU: shapes of each side, shape [2P]
    kept_key: wp.uint64  # shapes of the sides in the last substep, shape [2P]
    motion: wp.uint64  # lines of velocities, inverse masses and inertias before an iteration, shape [l, LINE]
    next_motion: wp.uint64  # GPU: the same after the iteration
    pose: wp.uint64  # lines of centers of mass and orientations before the substep, shape [l, LINE]
    side: wp.uint64  # contacts of ``contact_law.h``: GPU: prepared, shape [2P, LINE]; CPU: detected, then prepared
    return_velocity: wp.uint64  # return velocity of each side, shape [2P, 8]; on a CPU first its slip
    impulse: wp.uint64  # accumulated impulse of each side, shape [2P, 12]
    # CPU: impulse of an iteration on each side, by body, and one for the immovable bodies of each vector, shape
    # [2P + P / CHUNK, 8].
    record: wp.uint64
    kept: wp.uint64  # slips of those sides [m, rad], and points on the bodies of the first shapes [m], shape [2P, 9]


@dataclass(frozen=True)
class SolveBuffers:
    """Buffers of the solver on a device."""

    arrays: Any  # the :class:`SolveArrays` that kernels read
    work: dict[str, wp.array]  # arrays of the solver; ``counters`` has ``totals``, ``side_count`` and ``filled``
    round: bool  # true if every body has the same inertia about all axes
    group: int  # threads of a GPU that share a body, 0 on a CPU
    cluster: int  # blocks of a GPU's cluster, which lists the contacts and solves small scenes; 0 for launches
    limit: int  # most threads of a CPU, or most sides that a cluster solves
    worlds: int  # worlds that have a block of a GPU each, 0 for none
    world_lines: int  # bodies that fit into such a block

    def persistent_arrays(self) -> dict[str, wp.array]:
        """Return the arrays that a substep hands on to the next one, by name."""
        return {name: self.work[name] for name in ("kept_range", "kept_key", "kept")}


@wp.kernel(enable_backward=False)
def _forget_slips(mask_in: wp.array[wp.bool], world_in: wp.array[wp.int32], kept_range_out: wp.array2d[wp.int32]):
    body = wp.tid()
    if is_chosen(mask_in, world_in[body]):
        kept_range_out[body, 0] = 0
        kept_range_out[body, 1] = 0


def launch_forget_slips(buffers: SolveBuffers, mask, body_world):
    """Discard the slips of sticking contacts in the worlds that a complete mask chooses (``rigid.worlds``)."""
    inputs, outputs = [mask, body_world], [buffers.work["kept_range"]]
    wp.launch(_forget_slips, len(body_world), inputs=inputs, outputs=outputs, device=mask.device)


def allocate(contact_max: int, bodies: BodyView, *, kinematic_flag: int) -> SolveBuffers:
    """Return the buffers for at most ``contact_max`` contacts; ``kinematic_flag`` is Newton's for kinematic ones."""
    device, inertia = bodies.inv_mass.device, bodies.inv_inertia.numpy()
    world_first, world_lines = _split_worlds(bodies)
    body_count = len(inertia)
    isotropic = inertia[:, 0, 0, None, None] * np.eye(3)
    is_round = bool((np.abs(inertia - isotropic) <= _ROUND_TOLERANCE * isotropic.max((1, 2), keepdims=True)).all())
    group = _WORLD_GROUP if world_lines else next(group for most, group in _GROUPS if body_count <= most)
    small = contact_max <= _CLUSTER_CAPACITY and body_count <= _GROUPS[2][0] and not world_lines
    cluster = _most_blocks(device, is_round, group) if small else 0
    arrays = SolveArrays()
    arrays.contact_max, arrays.body_count, arrays.line_count = contact_max, body_count, _line_count(body_count)
    arrays.kinematic_flag = kinematic_flag
    work = _allocate_work(contact_max, body_count, device)
    work["world_first"] = wp.array(world_first, dtype=wp.int32, device=device)
    for name in work.keys() - {"counters"}:
        setattr(arrays, name, work[name].ptr or 0)
    limit = threads_for(contact_max, 1) if device.is_cpu else _SIDES_PER_BLOCK * cluster
    group, worlds = 0 if device.is_cpu else group, len(world_first) - 1 if world_lines else 0
    return SolveBuffers(arrays, work, is_round, group, cluster, limit, worlds, world_lines)


def _line_count(body_count: int) -> int:
    """Return the number of lines: movable and immovable bodies are padded to vectors, and the world has a vector."""
    return -(-body_count // CHUNK) * CHUNK + 3 * CHUNK


def _allocate_work(contact_max: int, body_count: int, device) -> dict[str, wp.array]:
    """Return the work arrays of :class:`SolveArrays`, by name."""
    line_count, padded = _line_count(body_count), -(-max(contact_max, 1) // CHUNK) * CHUNK
    on_cpu, on_gpu = int(device.is_cpu), int(device.is_cuda)
    sides = padded if on_cpu else 2 * padded

    def integers(*shape):
        return wp.zeros(shape, dtype=wp.int32, device=device)

    def numbers(*shape):
        return wp.zeros(shape, dtype=wp.float32, device=device)

    def keys(count):
        return wp.zeros(count, dtype=wp.uint64, device=device)

    counters = integers(_TOTALS + 2 * body_count)
    return {
        "counters": counters,
        "totals": counters[:_TOTALS],
        "side_count": counters[_TOTALS : _TOTALS + body_count],
        "filled": counters[_TOTALS + body_count :],
        "slot": integers(body_count),
        "body": wp.full(line_count, -1, dtype=wp.int32, device=device),
        "range": integers(line_count, 2),
        "entry": integers(2 * padded),
        "other": integers(4 * padded),
        "records_zero": integers(on_cpu * padded // CHUNK),
        "wide": integers(on_gpu * body_count),
        "kept_range": integers(max(body_count, 1), 2),
        "key": keys(on_gpu * 2 * padded),
        "kept_key": keys(2 * padded),
        "motion": numbers(line_count, LINE),
        "next_motion": numbers(on_gpu * line_count, LINE),
        "pose": numbers(line_count, LINE),
        "side": numbers(sides, _CONTACT_SIZE if on_cpu else LINE),
        "return_velocity": numbers(sides, _RETURN_SIZE),
        "impulse": numbers(sides, _IMPULSE_SIZE),
        "record": numbers(on_cpu * (2 * padded + padded // CHUNK), _RECORD_SIZE),
        "kept": numbers(2 * padded, _KEPT_SIZE),
    }


def _split_worlds(bodies: BodyView) -> tuple[np.ndarray, int]:
    """Return the first body of each world, and the number of bodies that a block holds, 0 if worlds have no blocks."""
    world, movable = bodies.world.numpy(), bodies.inv_mass.numpy() > 0.0
    so_far = np.maximum.accumulate(world)
    first = np.searchsorted(so_far, np.arange(world.max(initial=-1) + 2))
    lines = next((lines for lines in _WORLD_LINES if lines >= np.diff(first).max(initial=0)), 0)
    separate = len(first) > _WORLDS and ((world == so_far) | ((world < 0) & ~movable)).all()
    return first, lines if separate and bodies.inv_mass.device.is_cuda and not movable[world < 0].any() else 0


def _most_blocks(device, is_round: bool, group: int) -> int:
    """Return the number of blocks of the largest cluster that a device runs, 0 for none."""
    if device.is_cpu or device.arch < 90 or device.get_cuda_compile_arch() < 90:
        return 0
    for blocks in (_CLUSTER, _CLUSTER // 2):
        kernel, block = solve_kernel(SOLVE, is_round, group, blocks)
        if wp.get_cuda_max_cluster_dim(kernel, device, block_dim=block) == blocks:
            return blocks
    return 0


def _teams(group: int) -> int:
    """Return the number of bodies that a block of a cluster solves at a time; 512 threads may have 128 registers."""
    return 512 // group


_CONTACT_ARRAYS = (
    *("count", "shape0", "shape1", "shape_body", "point0", "point1", "offset0", "offset1", "normal", "margin0"),
    *("margin1", "mu", "mu_torsional", "mu_rolling"),
)
"""Arrays of :class:`ContactView` that kernels read."""
_BODY_ARRAYS = ("flags", "com", "inv_mass", "inv_inertia", "q", "qd")  # arrays of :class:`BodyView` that kernels read
_ARGUMENTS = {
    **{"arrays": SolveArrays, "number": int, "relaxation": float, "dt": float, "limit": int},
    "team": wp.array2d[wp.uint64],
}
"""Arguments of the kernels. ``number`` is the number of iterations; in ``ITERATE`` the index of one; in ``FINISH`` 1 if
their number is odd. ``limit`` is a number of threads, iterations or sides, as the call requires."""


@cache
def solve_kernel(call: str, is_round: bool, group: int, cluster: int = 0, lines: int = 0):
    """Return a kernel that calls a function of the device's header, and the threads of its blocks on a GPU."""
    header = "contacts/solve_cuda.h" if group else "contacts/solve_cpu.h"
    block = _BLOCK
    few, per_thread, most = _WIDE
    wide = min(few + per_thread * group, most)
    constants = dict(ROUND=int(is_round), GROUP=group, WIDE=wide, WIDE_BLOCKS=_WIDE_BLOCKS)
    if cluster > 1:
        header, lines = "contacts/solve_cluster.h", _teams(group)
        block = lines * group
    elif cluster == 1:
        header, block = "contacts/solve_cluster.h", min(256, lines * group)
        constants["WIDE"] = 2**30  # no body is wide
    constants |= dict(CLUSTER=cluster, LINES=lines)
    options = dict(cluster_dim=cluster, launch_bounds=block) if cluster else {}
    constants |= dict(RECOVERY_SPEED=RECOVERY_SPEED, FRICTION=FRICTION, MOMENTUM=MOMENTUM)
    constants |= dict(BLOCK=block, CONTACTS_PER_THREAD=_CONTACTS_PER_THREAD)
    return native_kernel(call, header, _ARGUMENTS, dtype=wp.float32, launch=options, **constants), block


ON_CPU = "solve_contacts(warpmag::Arrays(arrays), number, relaxation, dt, limit, team.data)"
COUNT = "count_sides(thread, warpmag::Arrays(arrays))"
PLACE = "place_body(thread, warpmag::Arrays(arrays))"
LIST = "list_sides(thread, warpmag::Arrays(arrays))"
WRITE = "write_side(thread, warpmag::Arrays(arrays), relaxation, dt)"
ITERATE = "iterate(thread, warpmag::Arrays(arrays), number, limit)"
SOLVE = "solve_in_cluster(warpmag::Arrays(arrays), number, limit, relaxation, dt)"
SOLVE_WORLD = "solve_world(warpmag::Arrays(arrays), number, relaxation, dt)"
FINISH = "finish(thread, warpmag::Arrays(arrays), number, relaxation, dt)"


def _set_views(arrays: SolveArrays, contacts: ContactView, bodies: BodyView, shares) -> None:
    """Set the addresses of Newton's arrays, which change from substep to substep."""
    for view, names in ((contacts, _CONTACT_ARRAYS), (bodies, _BODY_ARRAYS)):
        for name in names:
            setattr(arrays, name, getattr(view, name).ptr or 0)
    arrays.shares = 0 if shares is None else shares.ptr


def launch_solve_contacts(
    buffers: SolveBuffers,
    contacts: ContactView,
    bodies: BodyView,
    shares,
    *,
    iterations: int,
    relaxation: float,
    dt: float,
):
    """Change velocities so that bodies do not overlap at the end of a substep of ``dt`` [s].

    Args:
        bodies: The bodies as contacts were detected, with their velocities without contacts; ``qd`` of bodies with
            contacts is changed.
        shares: Number of shares that mass splitting divides each body into, shape [bodies], or None for whole bodies.
        relaxation: Fraction of its correction that each contact applies in an iteration.
    """
    a, counters, totals = buffers.arrays, buffers.work["counters"], buffers.work["totals"]
    device = counters.device
    _set_views(a, contacts, bodies, shares)

    def launch(call, dim, number=0, blocks=0, limit=0, **variant):
        inputs = [a, number, relaxation, dt, limit or buffers.limit, team() if device.is_cpu else None]
        kernel, block = solve_kernel(call, buffers.round, buffers.group, **variant)
        wp.launch(kernel, dim or blocks * block, inputs=inputs, device=device, block_dim=block)

    if device.is_cpu:
        launch(ON_CPU, 1, iterations)
        return
    if buffers.cluster:
        launch(SOLVE, 0, iterations, buffers.cluster, cluster=buffers.cluster)
    else:
        counters.zero_()
        launch(COUNT, a.contact_max)
        launch(PLACE, -(-(a.body_count + 1) // 32) * 32)
        launch(LIST, a.contact_max)
        launch(WRITE, 2 * a.contact_max)
    if buffers.worlds:
        launch(SOLVE_WORLD, 0, iterations, buffers.worlds, cluster=1, lines=buffers.world_lines)
        return
    threads = _WIDE_BLOCKS * _BLOCK + buffers.group * a.body_count

    def iterate():
        for iteration in range(iterations):
            launch(ITERATE, threads, iteration, limit=iterations)
        launch(FINISH, threads, iterations % 2)

    condition = _UNSOLVED if buffers.cluster else 0
    if (
        not buffers.cluster
        or 2 * a.contact_max > buffers.limit
        or a.body_count > buffers.cluster // 2 * _teams(buffers.group)
    ):
        wp.capture_if(totals[condition : condition + 1], iterate)
