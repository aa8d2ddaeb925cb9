"""The near-contact model on the device: what balls that nearly touch add to their dipoles.

``warpmag.near_contact`` holds the physics, the table and the reference implementation; names are the same. Every ball
has contact sources n = (q, N, n_Θ), and with what is left of its actual ones, ã = (−q, m − N, Θ̃),

    e = M ã,    n = ΔC e,    e_Θ = (1 − p) (e' − n_Θ/R⁵),    Θ̃ = −p R⁵ e' − (1 − p) n_Θ,    4π H_near = (M_sr a − e)_m,

e' the e_Θ that other balls make, p the polarizability. Heavy-ball sweeps

    n ← n + α s (ΔC e − n) + β (n − n'),

and the same for Θ̃, with s the inverse diagonal of 1 + ΔC M, run along with the induction, from where the last left off.

Only eligible balls take part, in pairs with one another: single inducible moments with no more near balls than there
are slots, and no more volume shared than the model allows. Near balls are found as ``neighbors`` finds overlaps, and
kept as slots, those whose surfaces nearly touch first. ``near_contact_code`` has the passes over them, and what each
row of an array is.

| variable | shape | meaning |
|---|---|---|
| near | [chunks, slots, LANES] | near balls |
| pairs, changes, contacts, slopes | [chunks, slots, rows, LANES] | what does not change while balls stand still |
| mirror | [chunks, slots, LANES] | place in ``halves`` of the other ball's half |
| contact, last_contact | [chunks, rows, LANES] | n and Θ̃, those of the sweep before |
| placed, seen, driven | [balls, BLOCK] | what others read of a ball: place; ã and m; e |
| outer | [chunks, rows, LANES] | what the first pass keeps for the others |
| field | [chunks, 3, LANES] | 4π H_near [A/m] |

Ball i is number i mod LANES of chunk i div LANES.
"""

from contextlib import contextmanager
from dataclasses import dataclass
from functools import cache
from itertools import pairwise
from typing import Any

import numpy as np
import warp as wp

from warpmag import near_contact as model
from warpmag.kernels import neighbors
from warpmag.kernels.cpu_team import team, threads_for
from warpmag.kernels.near_contact_code import (
    CANDIDATES,
    CHANGE_ROWS,
    CONTACT_ROWS,
    CONTACTS,
    NEAR,
    OUTER_ROWS,
    PAIR_ROWS,
    SKIN,
    SLOPE_ROWS,
    STATE_ROWS,
    SWEEPS,
    force_text,
    place_text,
    sweep_text,
    tabulate_text,
)
from warpmag.kernels.vector_passes import BLOCK, LANES
from warpmag.near_contact import FUNCTIONS

KINDS = 16
"""Susceptibilities that are told apart."""
_BALLS_PER_THREAD = 500
"""Balls that make another thread of a CPU worth its start."""
_MANY_BALLS = 5000
"""Balls that keep a GPU busy with half as many threads for each."""


@cache
def _arrays_type(dtype):
    """Type of what kernels of a precision are given."""
    vec3 = wp.types.vector(3, dtype)

    @wp.struct
    class NearContactArrays:
        packed: wp.array2d[dtype]
        group: wp.array[int]
        kind: wp.array[int]
        candidate: wp.array2d[int]
        candidate_count: wp.array[int]
        found_at: wp.array[vec3]
        moved: wp.array[int]
        tables: wp.array2d[dtype]
        near: wp.array3d[int]
        count: wp.array[int]
        contact_count: wp.array[int]
        used: wp.array2d[int]
        mirror: wp.array3d[int]
        radius: wp.array[dtype]
        saturation: wp.array[dtype]
        curve_slope: wp.array[dtype]
        ease: wp.array2d[dtype]
        placed: wp.array2d[dtype]
        pairs: wp.array4d[dtype]
        changes: wp.array4d[dtype]
        contacts: wp.array4d[dtype]
        slopes: wp.array4d[dtype]
        contact: wp.array3d[dtype]
        last_contact: wp.array3d[dtype]
        seen: wp.array2d[dtype]
        driven: wp.array2d[dtype]
        outer: wp.array3d[dtype]
        halves: wp.array4d[dtype]
        field: wp.array3d[dtype]
        row_of: wp.array[int]
        partial: wp.array3d[dtype]
        movable: wp.array[int]
        twisted: wp.array[int]
        forces: wp.array[vec3]
        torques: wp.array[vec3]
        kinds: int
        curve: int

    return NearContactArrays


@dataclass(frozen=True)
class NearContactBuffers:
    """All that the model keeps on the device, for n moments; balls are moments padded to ``LANES``.

    Attributes:
        group: World of each moment, −1 if it may not take part, shape [balls].
        lists: Balls that are near, or about to be.
        arrays: What passes over the pairs work on, a Warp struct. Besides what the module names:
            packed: The packed moments.
            group, kind: World, and kind of material, shape [balls].
            candidate, candidate_count, found_at, moved: Of ``lists``.
            tables: Spline coefficients of A to P by gap for each pair of kinds, shape [kinds² (gaps + 2), BLOCK].
            count, contact_count: Near balls of each, and those of them that nearly touch, shape [balls].
            used: Slots of both kinds that hold something, shape [2, balls].
            radius, saturation, curve_slope: Radii [m], Ms [A/m] and slopes k of the curve, shape [balls].
            ease: Inverse diagonals s of a ball's q and N, shape [2, balls].
            halves: What each ball sees of its contacts' forces, then zeros, shape [chunks + 1, CONTACTS, 3, LANES].
            row_of: Row of each ball among the targets of the field loop, −1 if it has none, shape [balls].
            partial: Sums of that loop, of which the last part is the near contacts', shape [parts, rows, 3].
            movable, twisted: Whether a ball's force is wanted, and its torque, shape [balls].
            forces, torques: What they are added to [N, N·m], shape [n].
            kinds, curve: Number of kinds of material; the magnetization curve.
        reach: Distance of the farthest contact [m]; 0 if no moment may take part.
        threads: Threads of a CPU.
        ways: Threads of a GPU that share a ball.
        stream: Stream of a GPU for what is done beside the pair loops.
        events: There, when it starts, when the field is summed, and when all is done.
        commands: Launches as they were recorded, which spares packing the arrays each time.
    """

    group: wp.array
    lists: neighbors.NeighborLists
    arrays: Any
    reach: float
    threads: int
    ways: int
    stream: wp.Stream | None
    events: tuple[wp.Event, ...]
    commands: dict

    def forget(self):
        """Start cold, from no contact sources."""
        for array in (self.arrays.contact, self.arrays.last_contact, self.arrays.seen):
            array.zero_()


def allocate(
    packed, worlds, eligible, susceptibility, saturation, curve, *, rows, partial, movable, twisted, forces, torques
) -> NearContactBuffers:
    """Allocate the buffers.

    Args:
        packed: The moments (``warpmag.packed.PackedMoments``).
        worlds: World of each moment, shape [n].
        eligible: Whether a moment may take part, shape [n].
        susceptibility: Susceptibility of each, shape [n], may be infinite.
        saturation: Saturation magnetization of each [A/m], shape [n].
        curve: Their magnetization curve, of ``curves.CURVE_IDS``.
        rows: Work list of the field loop (``pair_loops.Rows``).
        partial: Its sums, and one part more, to be written by sweeps.
        movable: Whether the force on a moment is wanted, shape [n].
        twisted: Whether its torque is, shape [n].
        forces: What forces are added to [N], Warp array, shape [n].
        torques: What torques are added to [N·m], Warp array, shape [n].
    """
    n, dtype, device = packed.count, packed.dtype, packed.device
    balls = -(-max(n, 1) // LANES) * LANES
    eligible = np.asarray(eligible, bool)
    radii = packed.radii.numpy()
    hardness = model.hardness(susceptibility)
    levels = np.unique(hardness[eligible]) if np.any(eligible) else np.zeros(1)
    if len(levels) > KINDS:
        levels = np.quantile(levels, np.linspace(0.0, 1.0, KINDS))
    kind = np.abs(hardness[:, None] - levels[None]).argmin(1)
    tables = np.concatenate([model.gap_table(float(own), float(other)) for own in levels for other in levels])

    def put(values, kind):
        return wp.array(np.ascontiguousarray(values), dtype=kind, device=device)

    def zeros(*shape, kind=dtype):
        return wp.zeros(shape, dtype=kind, device=device)

    def padded(values, other, kind=dtype):
        """Values of balls that take part, and another of the rest."""
        return put(np.pad(np.where(eligible, values, other), (0, balls - n), constant_values=other), kind)

    chunks = balls // LANES
    ratio = 0.5 * model.REACH + SKIN
    lists = neighbors.allocate(n, dtype, device, ratio=ratio, capacity=CANDIDATES)
    group = padded(worlds, -1, wp.int32)
    arrays = _arrays_type(dtype)()
    arrays.packed = packed.packed
    arrays.group, arrays.kind = group, padded(kind, 0, wp.int32)
    arrays.candidate, arrays.candidate_count = lists.neighbor, lists.count
    arrays.found_at, arrays.moved = lists.found_at, lists.moved
    arrays.tables = put(np.pad(tables, ((0, 0), (0, BLOCK - FUNCTIONS))), dtype)
    arrays.near = zeros(chunks, NEAR, LANES, kind=wp.int32)
    arrays.count = zeros(balls, kind=wp.int32)
    arrays.contact_count = zeros(balls, kind=wp.int32)
    arrays.used = zeros(2, balls, kind=wp.int32)
    arrays.mirror = zeros(chunks, CONTACTS, LANES, kind=wp.int32)
    arrays.radius = padded(radii, 1.0)
    arrays.saturation = padded(saturation, 1.0)
    arrays.curve_slope = padded(3.0 / (1.0 + 3.0 / np.asarray(susceptibility, float)), 1.0)
    arrays.ease = zeros(2, balls)
    arrays.placed = zeros(balls, BLOCK)
    arrays.pairs = zeros(chunks, NEAR, PAIR_ROWS, LANES)
    arrays.changes = zeros(chunks, NEAR, CHANGE_ROWS, LANES)
    arrays.contacts = zeros(chunks, CONTACTS, CONTACT_ROWS, LANES)
    arrays.slopes = zeros(chunks, CONTACTS, SLOPE_ROWS, LANES)
    arrays.contact = zeros(chunks, STATE_ROWS, LANES)
    arrays.last_contact = zeros(chunks, STATE_ROWS, LANES)
    arrays.seen = zeros(balls, BLOCK)
    arrays.driven = zeros(balls, BLOCK)
    arrays.outer = zeros(chunks, OUTER_ROWS, LANES)
    arrays.halves = zeros(chunks + 1, CONTACTS, 3, LANES)
    arrays.field = zeros(chunks, 3, LANES)
    row_of = np.full(n, -1)
    row_of[rows.target.numpy()] = np.arange(rows.count)
    arrays.row_of = padded(row_of, -1, wp.int32)
    arrays.partial = partial
    arrays.movable, arrays.twisted = padded(movable, 0, wp.int32), padded(twisted, 0, wp.int32)
    arrays.forces, arrays.torques = forces, torques
    arrays.kinds = len(levels)
    arrays.curve = curve
    return NearContactBuffers(
        group=group,
        lists=lists,
        arrays=arrays,
        reach=2.0 * float(np.max(radii, initial=0.0, where=eligible)),
        threads=threads_for(n, _BALLS_PER_THREAD),
        ways=8 if n < _MANY_BALLS else 4,
        stream=wp.Stream(device, priority=-1) if device.is_cuda else None,
        events=tuple(wp.Event(device) for _ in range(3)) if device.is_cuda else (),
        commands={},
    )


# ---------------------------------------------------------------------------------------------------------------------
# Launches
# ---------------------------------------------------------------------------------------------------------------------


@cache
def _kernel(dtype, text, ways: int):
    """Kernel that makes passes of ``near_contact_code``."""
    arrays_type = _arrays_type(dtype)

    @wp.func_native(text("float" if dtype is wp.float32 else "double", ways))
    def make_passes(
        thread: int, first: int, last: int, threads: int, team: wp.array2d[wp.uint64], arrays: arrays_type
    ): ...

    # registers as wide as the CPU has
    flags = f"{wp.config.cpu_compiler_flags or '-march=native'} -mprefer-vector-width=512"

    @wp.kernel(module="unique", enable_backward=False, module_options={"cpu_compiler_flags": flags})
    def near_contact_passes(first: int, last: int, threads: int, team: wp.array2d[wp.uint64], arrays: arrays_type):
        make_passes(wp.tid(), first, last, threads, team, arrays)

    return near_contact_passes


def _launch(text, first: int, last: int, b: NearContactBuffers):
    """Launch passes ``first`` to ``last``; one by one on a GPU, where a launch is what they meet at."""
    device = b.arrays.radius.device
    for begin, end in [(first, last)] if device.is_cpu else pairwise(range(first, last + 1)):
        key = text, begin, end
        if key not in b.commands:
            b.commands[key] = wp.launch(
                _kernel(b.arrays.radius.dtype, text, b.ways),
                dim=1 if device.is_cpu else b.ways * b.arrays.radius.shape[0],
                inputs=[begin, end, b.threads, team() if device.is_cpu else None, b.arrays],
                device=device,
                block_dim=128,
                record_cmd=True,
            )
        b.commands[key].launch()


@contextmanager
def _beside(b: NearContactBuffers):
    """On a GPU, launch what follows on a stream of its own, which begins when all that was launched is done."""
    if b.stream is None:
        yield
        return
    b.stream.wait_event(wp.get_stream(b.stream.device).record_event(b.events[0]))
    with wp.ScopedStream(b.stream, sync_enter=False):
        yield
        b.stream.record_event(b.events[2])


def launch_find_pairs(moments, b: NearContactBuffers):
    """Find the near pairs of packed moments (``warpmag.packed.PackedMoments``) and tabulate what they add.

    On a GPU that is done beside what is launched next, until :func:`wait` ends it.
    """
    if b.reach == 0.0:
        return
    packed = moments.packed
    with _beside(b):
        _launch(place_text, 0, 1, b)
        neighbors.launch_find_neighbors(packed, packed, b.group, b.group, b.reach, b.lists, b.lists)
        _launch(tabulate_text, 0, 2, b)


def launch_sweeps(b: NearContactBuffers):
    """Move the contact sources towards those of the packed moments, and write their field into ``partial``.

    On a GPU that is done beside what is launched next, until :func:`wait_for_field` and :func:`wait` end it.
    """
    if b.reach == 0.0:
        return
    with _beside(b):
        if b.stream is None:
            _launch(sweep_text, 0, 1 + 2 * SWEEPS, b)
        else:
            _launch(sweep_text, 1, 2 * SWEEPS, b)
            b.stream.record_event(b.events[1])  # the field needs no more
            _launch(sweep_text, 2 * SWEEPS, 1 + 2 * SWEEPS, b)


def wait_for_field(b: NearContactBuffers):
    """Have what is launched next wait for the field of :func:`launch_sweeps`."""
    if b.reach > 0.0 and b.stream is not None:
        wp.get_stream(b.stream.device).wait_event(b.events[1])


def wait(b: NearContactBuffers):
    """Have what is launched next wait for all that is done beside."""
    if b.reach > 0.0 and b.stream is not None:
        wp.get_stream(b.stream.device).wait_event(b.events[2])


def launch_add_forces(b: NearContactBuffers):
    """Add the forces [N] of near pairs, and the torques [N·m] where they are wanted, to those of ``allocate``."""
    if b.reach > 0.0:
        _launch(force_text, 0, 2, b)
