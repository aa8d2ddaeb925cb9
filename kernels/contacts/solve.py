"""Newton's XPBD for rigid bodies in contact, where work follows contacts and no sum depends on the order of threads.

Once a substep the contacts that move anything are listed for each body that they move. An iteration then relaxes them
all at once (``contact_law.h``): each body gathers from its own contacts. On a CPU one launch does all iterations, and
the impulses of a contact are computed once. On a GPU both bodies compute them. An iteration is a launch there; those of
a small scene, or of many small worlds, are one launch together (``solve_cluster.h``).
"""

from dataclasses import dataclass
from functools import cache
from typing import Any

import numpy as np
import warp as wp

from warpmag.kernels.rigid.newton_views import BodyView, ContactView
from warpmag.kernels.shared.native import CHUNK, LINE, native_options
from warpmag.kernels.shared.team import team, threads_for

_GROUPS = ((100, 32), (400, 16), (6_000, 8), (20_000, 4), (2**31, 2))
"""Bodies up to which so many threads of a GPU share each, measured with three contacts a body on an H200."""
_CLUSTER, _CLUSTER_CAPACITY, _SIDES_PER_BLOCK = 16, 50_000, 375
"""Blocks of a cluster, contacts that there may be for it to list them, and sides for each block that it iterates over:
more take longer than a launch, going by Balls Up (1,500 sides, a third of a launch) and Falling Magnet (10,000)."""
_WORLDS, _WORLD_GROUP, _WORLD_LINES = 16, 8, (32, 64, 128, 208)
"""Worlds from which on each has a block, threads that share a body there, and bodies that such a block may keep."""
_BLOCK, _WIDE_BLOCKS = 128, 64
"""Threads of a block, and blocks for bodies with many contacts, which are shared by a whole one."""
_WIDE = 16, 4, 64
"""Contacts beyond which a body counts as one with many: so many and so many for each thread of its group, at most the
last. Letters with up to 140 are solved in 0.12 ms so on an H200, and in 0.14 where their groups of 32 take them all."""
_CONTACTS_PER_THREAD = 100
"""Contacts that make another thread of a CPU worth its start: an iteration over them takes 1 to 2 µs."""
PUSH_OUT = 2.0
"""Most speed at which bodies that overlap are moved apart [m/s]: they keep it when they are. In the longest substep,
0.5 ms, it undoes an overlap of 1 mm, and what 5 mm balls may newly overlap in a step in the shortest, 31 µs."""
FRICTION, MOMENTUM = 0.35, 0.8
"""Part of what pushes are relaxed by for friction, which turns balls besides, and most momentum of an iteration."""
_ROUND = 1e-6
"""Part by which inverse inertias of a round body may differ, and products of inertia from zero: float32 rounding."""
_TOUCH, _BACK, _GIVEN, _RECORD, _KEPT = 20, 8, 12, 8, 9
"""Numbers of a contact as found, of how it goes back, of its impulses, of a record, and of what is kept of a side, as
in ``solve_arrays.h``."""
_TOTALS, _LEFT = 6, 4
"""Number of totals, and which is that of bodies left to launches; as in ``solve_cuda.h``."""

_SIZES = ("contact_max", "bodies", "lines", "kinematic_flag")
_OF_CONTACTS = (
    *("count", "shape0", "shape1", "shape_body", "point0", "point1", "offset0", "offset1", "normal"),
    *("margin0", "margin1", "mu", "mu_torsional", "mu_rolling"),
)
_OF_BODIES = ("flags", "com", "inv_mass", "inv_inertia", "q", "qd")
_OWN = (
    *("totals", "side_count", "filled", "slot", "body", "range", "entry", "other", "wide", "world_first", "kept_range"),
    *("key", "kept_key", "motion", "next_motion", "pose", "side", "back", "given", "record", "kept"),
)
_ADDRESSES = (*_OF_CONTACTS, *_OF_BODIES, "shares", *_OWN)
_DOC = "Sizes, and where arrays begin; as ``Arrays`` in ``solve_arrays.h``."
SolveArrays = wp.struct(
    type(
        "SolveArrays",
        (),
        {"__doc__": _DOC, "__annotations__": dict.fromkeys(_SIZES, int) | dict.fromkeys(_ADDRESSES, wp.uint64)},
    )
)


@dataclass(frozen=True)
class SolveBuffers:
    """Buffers for c contacts, which have two sides each, and b bodies.

    Attributes:
        arrays: The arrays: on a GPU
                totals: Numbers of bodies and sides that take part, of bodies that nothing moves, of those with many
                    contacts, and of bodies that a cluster leaves to launches; whether any contact sticks; shape [6].
                side_count, filled: Sides of each body, and how many of them are listed, shape [b].
                entry, key: Side, twice its contact plus its end, and shapes of it, by bodies, shape [2c].
                other: Line of the body at the other end, and then the contact of each side, shape [2, 2c].
                side: Contacts as each end sees them, see ``contact_law.h``, shape [2c, LINE].
                back: Speeds at which they go back to where they stuck, shape [2c, 8].
                given: Impulses that each end has been given, shape [2c, 12].
                wide: Lines of bodies with many contacts, shape [b].
                world_first: First body of each world that has a block, and the one after the last, shape [worlds + 1].
            and on a CPU, where vectors of contacts are seen from their second bodies,
                side_count: Sides of each body, shape [b].
                entry: Contacts that take part, shape [c].
                other: Lines of the first and second body and their records, shape [c padded / CHUNK, 4, CHUNK].
                side: The contacts, as found and then as prepared, shape [c padded / CHUNK, 20, CHUNK].
                back: How far they slipped, and then speeds at which they go back, shape [c padded / CHUNK, 8, CHUNK].
                given: Impulses that they have given, shape [c padded / CHUNK, 12, CHUNK].
                record: Impulses on each side, by bodies, and one for each vector of what nothing moves, shape
                    [2c + c padded / CHUNK, 8].
                wide: Whether records of a vector of contacts are zero, shape [c padded / CHUNK].
            and on both
                slot: Line of each body, shape [b].
                body: Body of each line, -1 for the world, shape [lines].
                range: First of the sides of a line's body, and the one after the last, shape [lines, 2].
                motion, next_motion: Lines of velocities, before and on a GPU after an iteration, and of inverse
                    masses and inertias, shape [lines, LINE].
                pose: Lines of where bodies are before the substep, shape [lines, LINE].
                kept_range: First of the sides of each body in the last substep, and the one after the last, shape
                    [b, 2].
                kept_key, kept: Shapes of these sides; how far they slipped and turned [m, rad], and where they were on
                    the body of their first shape [m], shapes [2c] and [2c, 9].
        given: Their sizes and addresses, and what else the kernels are given.
        round: Whether every body has the same inertia about all axes.
        group: Threads of a GPU that share a body, 0 on a CPU.
        cluster: Blocks of a GPU that list the contacts together, and solve them where they are few; 0 for launches.
        most: Most threads of a CPU; most sides that a cluster solves.
        worlds: Worlds that have a block of a GPU each, 0 for none.
        world_lines: Bodies that such a block can keep.
    """

    arrays: dict[str, wp.array]
    given: Any
    round: bool
    group: int
    cluster: int
    most: int
    worlds: int
    world_lines: int

    def carried(self) -> dict[str, wp.array]:
        """Return the arrays that one substep hands on to the next one, by name."""
        return {name: self.arrays[name] for name in ("kept_range", "kept_key", "kept")}


def allocate(contact_max: int, bodies: BodyView, *, kinematic_flag: int) -> SolveBuffers:
    """Allocate the buffers.

    Args:
        contact_max: Most contacts.
        bodies: The bodies.
        kinematic_flag: Newton's flag of kinematic bodies.
    """
    device, inertia = bodies.inv_mass.device, bodies.inv_inertia.numpy()
    world_first, world_lines = _split_worlds(bodies)
    bodies = len(inertia)
    isotropic = inertia[:, 0, 0, None, None] * np.eye(3)
    lines = -(-bodies // CHUNK) * CHUNK + 3 * CHUNK  # the movable and the others are padded, and the world has a vector
    padded = -(-max(contact_max, 1) // CHUNK) * CHUNK

    def zeros(*shape, dtype=wp.int32):
        return wp.zeros(shape, dtype=dtype, device=device)

    counters = zeros(_TOTALS + 2 * bodies)
    arrays = {"counters": counters, "totals": counters[:_TOTALS], "side_count": counters[_TOTALS : _TOTALS + bodies]}
    arrays["filled"] = counters[_TOTALS + bodies :]
    arrays |= {"slot": zeros(bodies), "range": zeros(lines, 2), "entry": zeros(2 * padded), "other": zeros(4 * padded)}
    arrays["body"] = wp.full(lines, -1, dtype=wp.int32, device=device)
    arrays["wide"] = zeros(max(bodies, padded // CHUNK))
    arrays |= {name: zeros(lines, LINE, dtype=wp.float32) for name in ("motion", "pose")}
    arrays["next_motion"] = zeros(0 if device.is_cpu else lines, LINE, dtype=wp.float32)
    sides = padded if device.is_cpu else 2 * padded
    arrays["side"] = zeros(sides, _TOUCH if device.is_cpu else LINE, dtype=wp.float32)
    arrays["given"] = zeros(sides, _GIVEN, dtype=wp.float32)
    arrays["record"] = zeros((2 * padded + padded // CHUNK) if device.is_cpu else 0, _RECORD, dtype=wp.float32)
    arrays["back"] = zeros(sides, _BACK, dtype=wp.float32)
    arrays["key"] = zeros(0 if device.is_cpu else 2 * padded, dtype=wp.uint64)
    arrays |= {"kept_range": zeros(max(bodies, 1), 2), "kept_key": zeros(2 * padded, dtype=wp.uint64)}
    arrays["kept"] = zeros(2 * padded, _KEPT, dtype=wp.float32)
    arrays["world_first"] = wp.array(world_first, dtype=wp.int32, device=device)
    given = SolveArrays()
    for name in _OWN:
        setattr(given, name, arrays[name].ptr or 0)
    for name, size in zip(_SIZES, (contact_max, bodies, lines, kinematic_flag), strict=True):
        setattr(given, name, size)
    is_round = bool((np.abs(inertia - isotropic) <= _ROUND * isotropic.max((1, 2), keepdims=True)).all())
    group = _WORLD_GROUP if world_lines else next(group for most, group in _GROUPS if bodies <= most)
    small = contact_max <= _CLUSTER_CAPACITY and bodies <= _GROUPS[2][0] and not world_lines
    cluster = _most_blocks(device, is_round, group) if small else 0
    return SolveBuffers(
        arrays,
        given,
        round=is_round,
        group=0 if device.is_cpu else group,
        cluster=cluster,
        most=threads_for(contact_max, 1) if device.is_cpu else _SIDES_PER_BLOCK * cluster,
        worlds=len(world_first) - 1 if world_lines else 0,
        world_lines=world_lines,
    )


def _split_worlds(bodies: BodyView) -> tuple[np.ndarray, int]:
    """First bodies of many small worlds, and how many bodies a block has to keep, 0 where blocks do not suit them."""
    world, movable = bodies.world.numpy(), bodies.inv_mass.numpy() > 0.0
    so_far = np.maximum.accumulate(world)
    first = np.searchsorted(so_far, np.arange(world.max(initial=-1) + 2))
    lines = next((lines for lines in _WORLD_LINES if lines >= np.diff(first).max(initial=0)), 0)
    suited = len(first) > _WORLDS and ((world == so_far) | ((world < 0) & ~movable)).all()
    return first, lines if suited and bodies.inv_mass.device.is_cuda and not movable[world < 0].any() else 0


def _most_blocks(device, is_round: bool, group: int) -> int:
    """Blocks of the largest cluster that a device runs, 0 if none."""
    if device.is_cpu or device.arch < 90 or device.get_cuda_compile_arch() < 90:
        return 0
    for blocks in (_CLUSTER, _CLUSTER // 2):
        kernel, block = solve_kernel(SOLVE, is_round, group, blocks)
        if wp.get_cuda_max_cluster_dim(kernel, device, block_dim=block) == blocks:
            return blocks
    return 0


def _teams(group: int) -> int:
    """Bodies that a block of a cluster moves at a time; its threads may have 128 registers."""
    return 512 // group


@cache
def solve_kernel(call: str, is_round: bool, group: int, cluster: int = 0, lines: int = 0):
    """Kernel that calls a function of the device's header, and threads of its blocks on a GPU."""
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
        constants["WIDE"] = 2**30  # groups take all bodies
    constants |= dict(CLUSTER=cluster, LINES=lines)
    options = dict(cluster_dim=cluster, launch_bounds=block) if cluster else {}
    constants |= dict(
        PUSH_OUT=PUSH_OUT, FRICTION=FRICTION, MOMENTUM=MOMENTUM, BLOCK=block, CONTACTS_PER_THREAD=_CONTACTS_PER_THREAD
    )

    @wp.func_native(f"warpmag::{call};")
    def run(
        thread: int,
        given: SolveArrays,
        number: int,
        relaxation: float,
        dt: float,
        most: int,
        team: wp.array2d[wp.uint64],
    ): ...

    @wp.kernel(
        module="unique",
        enable_backward=False,
        module_options=native_options(header, dtype=wp.float32, **constants),
        **options,
    )
    def solve_contacts(
        given: SolveArrays, number: int, relaxation: float, dt: float, most: int, team: wp.array2d[wp.uint64]
    ):
        run(wp.tid(), given, number, relaxation, dt, most, team)

    return solve_contacts, block


ON_CPU = "solve_contacts(warpmag::Arrays(given), number, relaxation, dt, most, team.data)"
COUNT = "count_sides(thread, warpmag::Arrays(given))"
PLACE = "place_body(thread, warpmag::Arrays(given))"
LIST = "list_sides(thread, warpmag::Arrays(given))"
WRITE = "write_side(thread, warpmag::Arrays(given), relaxation, dt)"
ITERATE = "iterate(thread, warpmag::Arrays(given), number, most)"
SOLVE = "solve_in_cluster(warpmag::Arrays(given), number, most, relaxation, dt)"
SOLVE_WORLD = "solve_world(warpmag::Arrays(given), number, relaxation, dt)"
FINISH = "finish(thread, warpmag::Arrays(given), number, relaxation, dt)"


def launch_solve_contacts(
    b: SolveBuffers, contacts: ContactView, bodies: BodyView, shares, *, iterations: int, relaxation: float, dt: float
):
    """Change velocities so that bodies end a substep out of their contacts.

    Args:
        b: Buffers.
        contacts: The contacts.
        bodies: The bodies as contacts found them, with the velocities that they have without contacts; ``qd`` of those
            with contacts is changed.
        shares: Number of shares that contacts split each body into, shape [bodies], or None for whole bodies.
        iterations: Number of iterations.
        relaxation: Part of its correction that each contact is given in an iteration.
        dt: Substep [s].
    """
    given, device = b.given, b.arrays["motion"].device
    for names, view in ((_OF_CONTACTS, contacts), (_OF_BODIES, bodies)):
        for name in names:
            setattr(given, name, getattr(view, name).ptr or 0)
    given.shares = 0 if shares is None else shares.ptr

    def launch(call, dim, number=0, blocks=0, most=0, **form):
        inputs = [given, number, relaxation, dt, most or b.most, team() if device.is_cpu else None]
        kernel, block = solve_kernel(call, b.round, b.group, **form)
        wp.launch(kernel, dim or blocks * block, inputs=inputs, device=device, block_dim=block)

    if device.is_cpu:
        launch(ON_CPU, 1, iterations)
        return
    if b.cluster:
        launch(SOLVE, 0, iterations, b.cluster, cluster=b.cluster)
    else:
        b.arrays["counters"].zero_()
        launch(COUNT, given.contact_max)
        launch(PLACE, -(-(given.bodies + 1) // 32) * 32)
        launch(LIST, given.contact_max)
        launch(WRITE, 2 * given.contact_max)
    if b.worlds:
        launch(SOLVE_WORLD, 0, iterations, b.worlds, cluster=1, lines=b.world_lines)
        return
    threads = _WIDE_BLOCKS * _BLOCK + b.group * given.bodies

    def iterate():
        for iteration in range(iterations):
            launch(ITERATE, threads, iteration, most=iterations)
        launch(FINISH, threads, iterations % 2)

    left = _LEFT if b.cluster else 0
    if not b.cluster or 2 * given.contact_max > b.most or given.bodies > b.cluster // 2 * _teams(b.group):
        wp.capture_if(b.arrays["totals"][left : left + 1], iterate)
