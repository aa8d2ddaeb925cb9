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
| outer | [chunks, rows, LANES] | what passes keep for those that follow |
| halves | [chunks, slots, 3, LANES] | what a ball sees of its contacts' forces |
| field, pulled | [chunks, 3, LANES] | 4π H_near [A/m]; on a GPU with few balls also forces [N] over μ0/4π |

Ball i is number i mod LANES of chunk i div LANES. On a GPU what balls tell others stands in packets of four numbers,
the last a mark, in place of rows of three; ``seen`` and ``driven`` hold it as it was in the last turns, too.
"""

from contextlib import contextmanager
from dataclasses import dataclass
from functools import cache
from itertools import pairwise
from typing import Any

import numpy as np
import warp as wp

from warpmag import near_contact as model
from warpmag.kernels.near_contact.near_contact_code import (
    CANDIDATES,
    CHANGE_ROWS,
    CONTACT_ROWS,
    CONTACTS,
    FORCES,
    INTEGER_ARRAYS,
    NEAR,
    OUTER_ROWS,
    PAIR_ROWS,
    REAL_ARRAYS,
    SKIN,
    SLOPE_ROWS,
    STATE_ROWS,
    WAYS,
    contact_text,
    place_text,
    tabulate_text,
)
from warpmag.kernels.pairs import neighbors
from warpmag.kernels.shared.vector_text import BLOCK, LANES
from warpmag.kernels.shared.team import team, threads_for, wide_registers
from warpmag.near_contact import FUNCTIONS

KINDS = 16
"""Susceptibilities that are told apart."""
_BALLS_PER_THREAD = 500
"""Balls that make another thread of a CPU worth its start."""
_SIZES = ("balls", "moment_stride", "kinds", "curve")

ContactArrays = wp.struct(
    type(
        "ContactArrays",
        (),
        {
            "__doc__": "What passes are given: where arrays begin, side by side, for a GPU to read at once; and sizes.",
            "__annotations__": dict.fromkeys(INTEGER_ARRAYS, wp.uint64)
            | dict.fromkeys(_SIZES, int)
            | dict.fromkeys(REAL_ARRAYS, wp.uint64),
        },
    )
)


@dataclass(frozen=True)
class NearContactBuffers:
    """All that the model keeps on the device, for n moments; balls are moments padded to ``LANES``.

    Attributes:
        dtype: Warp scalar type.
        balls: How many there are.
        group: World of each moment, −1 if it may not take part, shape [balls].
        lists: Balls that are near, or about to be.
        arrays: What passes over the pairs work on. Besides what the module names:
            packed: The packed moments.
            group, kind: World, and kind of material, shape [balls].
            candidate, candidate_count, found_at, moved: Of ``lists``.
            tables: Spline coefficients of A to P by gap for each pair of kinds, shape [kinds² (gaps + 2), BLOCK].
            count, contact_count: Near balls of each, and those of them that nearly touch, shape [balls].
            used: Slots of both kinds that hold something, shape [2, balls].
            radius, unsaturated: Radii [m] and 1/(V Ms) [1/(A·m²)], shape [balls].
            curve_slope, hardness: Slopes k of the curve, and (2χ + 5)/2χ, shape [balls].
            ease: Inverse diagonals s of a ball's q and N, shape [2, balls].
            row_of: Row of each ball among the targets of the field loop, −1 if it has none, shape [balls].
            partial: Sums of that loop, of which the last part is the near contacts', shape [parts, rows, 3].
            turns: How often drives have been told, shape [balls].
            movable, twisted: Whether a ball's force is wanted, and its torque, shape [balls].
            forces, torques: What they are added to [N, N·m], shape [n].
        given: Where these are, their sizes and what else passes are given: kinds, the number of kinds of material, and
            the magnetization curve.
        reach: Distance of the farthest contact [m]; 0 if no moment may take part.
        threads: Threads of a CPU.
        stream: Stream of a GPU for what is done beside the pair loops.
        events: There, when it starts, when the field is summed, and when all is done.
        commands: Launches as they were recorded, which spares packing the arrays each time.
    """

    dtype: Any
    balls: int
    group: wp.array
    lists: Any
    arrays: dict[str, wp.array]
    given: Any
    reach: float
    threads: int
    stream: wp.Stream | None
    events: tuple[wp.Event, ...]
    commands: dict

    @property
    def device(self):
        """Where it is."""
        return self.group.device

    def forget(self):
        """Start cold, from no contact sources."""
        for name in ("contact", "last_contact", "seen"):
            self.arrays[name].zero_()


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
        rows: Evaluation of their field (``evaluate.PairEvaluation``).
        partial: Its sums, and one part more, to be written by sweeps; no part, if the sums are fused.
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

    slope = 3.0 / (1.0 + 3.0 / np.asarray(susceptibility, float))
    saturated = 4.0 / 3.0 * np.pi * np.where(eligible, radii, 1.0).astype(float) ** 3 * saturation
    chunks = balls // LANES
    ratio = 0.5 * model.REACH + SKIN
    group = padded(worlds, -1, wp.int32)
    lists = neighbors.allocate(n, packed.packed, group, ratio=ratio, capacity=CANDIDATES)
    row_of = np.full(n, -1)
    if len(partial):
        row_of[rows.target.numpy()] = np.arange(rows.count)
    seen, driven, width = (4, 2, 4) if device.is_cuda else (1, 1, 3)
    arrays = {
        "packed": packed.packed,
        "group": group,
        "kind": padded(kind, 0, wp.int32),
        "candidate": lists.neighbor,
        "candidate_count": lists.count,
        "found_at": lists.found_at,
        "moved": lists.moved,
        "tables": put(np.pad(tables, ((0, 0), (0, BLOCK - FUNCTIONS))), dtype),
        "near": zeros(chunks, NEAR, LANES, kind=wp.int32),
        "count": zeros(balls, kind=wp.int32),
        "contact_count": zeros(balls, kind=wp.int32),
        "used": zeros(2, balls, kind=wp.int32),
        "mirror": zeros(chunks, CONTACTS, LANES, kind=wp.int32),
        "radius": padded(radii, 1.0),
        "unsaturated": padded(1.0 / saturated, 1.0),
        "curve_slope": padded(slope, 1.0),
        "hardness": padded(2.5 / slope + 1.0 / 6.0, 1.0),
        "ease": zeros(2, balls),
        "placed": zeros(balls, BLOCK),
        "pairs": zeros(chunks, NEAR, PAIR_ROWS, LANES),
        "changes": zeros(chunks, NEAR, CHANGE_ROWS, LANES),
        "contacts": zeros(chunks, CONTACTS, CONTACT_ROWS, LANES),
        "slopes": zeros(chunks, CONTACTS, SLOPE_ROWS, LANES),
        "contact": zeros(chunks, STATE_ROWS, LANES),
        "last_contact": zeros(chunks, STATE_ROWS, LANES),
        "seen": zeros(seen, balls, BLOCK),
        "driven": zeros(driven, balls, BLOCK),
        "turns": zeros(balls, kind=wp.int32),
        "outer": zeros(chunks, OUTER_ROWS, LANES),
        "halves": zeros(chunks + 1, CONTACTS, width, LANES),  # the last are zeros
        "field": zeros(chunks, width, LANES),
        "pulled": zeros(chunks, width, LANES),
        "row_of": padded(row_of, -1, wp.int32),
        "partial": partial[-1] if len(partial) else partial,
        "movable": padded(movable, 0, wp.int32),
        "twisted": padded(twisted, 0, wp.int32),
        "forces": forces,
        "torques": torques,
    }
    given = ContactArrays()
    for name in (*INTEGER_ARRAYS, *REAL_ARRAYS):
        setattr(given, name, arrays[name].ptr or 0)
    given.balls, given.kinds, given.curve = balls, len(levels), curve
    given.moment_stride = packed.packed.strides[0] // wp.types.type_size_in_bytes(dtype)
    return NearContactBuffers(
        dtype=dtype,
        balls=balls,
        group=group,
        lists=lists,
        arrays=arrays,
        given=given,
        reach=2.0 * float(np.max(radii, initial=0.0, where=eligible)),
        threads=threads_for(n, _BALLS_PER_THREAD),
        stream=wp.Stream(device, priority=-1) if device.is_cuda else None,
        events=tuple(wp.Event(device) for _ in range(3)) if device.is_cuda else (),
        commands={},
    )


# ---------------------------------------------------------------------------------------------------------------------
# Launches
# ---------------------------------------------------------------------------------------------------------------------


@cache
def passes(dtype, text, *options):
    """Warp function that makes passes of ``near_contact_code``."""

    @wp.func_native(text("float" if dtype is wp.float32 else "double", *options))
    def make_passes(
        thread: int, first: int, last: int, threads: int, team: wp.array2d[wp.uint64], arrays: ContactArrays
    ): ...

    return make_passes


@cache
def _kernel(dtype, text, *options):
    make_passes = passes(dtype, text, *options)

    @wp.kernel(module="unique", enable_backward=False, module_options=wide_registers())
    def near_contact_passes(first: int, last: int, threads: int, team: wp.array2d[wp.uint64], arrays: ContactArrays):
        make_passes(wp.tid(), first, last, threads, team, arrays)

    return near_contact_passes


def _launch(b: NearContactBuffers, first: int, last: int, text, *options):
    """Launch passes ``first`` to ``last``."""
    device = b.device
    key = first, last, text, *options
    if key not in b.commands:
        b.commands[key] = wp.launch(
            _kernel(b.dtype, text, *options),
            dim=1 if device.is_cpu else WAYS * b.balls,
            inputs=[first, last, b.threads, team() if device.is_cpu else None, b.given],
            device=device,
            block_dim=128,
            record_cmd=True,
        )
    b.commands[key].launch()


def _launch_each(b: NearContactBuffers, first: int, last: int, text, *options):
    """Launch passes ``first`` to ``last``, one by one on a GPU, where a launch is what they meet at."""
    for begin, end in [(first, last)] if b.device.is_cpu else pairwise(range(first, last + 1)):
        _launch(b, begin, end, text, *options)


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
    with _beside(b):
        _launch_each(b, 0, 1, place_text)
        neighbors.launch_find_neighbors(b.lists, b.lists, b.reach)
        _launch_each(b, 0, 2, tabulate_text)


def launch_sweeps(b: NearContactBuffers):
    """Move the contact sources towards those of the packed moments, and write their field into ``partial``.

    On a GPU that is done beside what is launched next, until :func:`wait_for_field` and :func:`wait` end it.
    """
    if b.reach == 0.0:
        return
    with _beside(b):
        if b.stream is None:
            _launch(b, 0, FORCES, contact_text, True)  # as a part of what finds forces, to compile that only
        else:
            _launch_each(b, 1, FORCES - 1, contact_text, False)
            b.stream.record_event(b.events[1])  # the field needs no more
            _launch(b, FORCES - 1, FORCES, contact_text, False)


def wait_for_field(b: NearContactBuffers):
    """Have what is launched next wait for the field of :func:`launch_sweeps`."""
    if b.reach > 0.0 and b.stream is not None:
        wp.get_stream(b.stream.device).wait_event(b.events[1])


def wait(b: NearContactBuffers):
    """Have what is launched next wait for all that is done beside."""
    if b.reach > 0.0 and b.stream is not None:
        wp.get_stream(b.stream.device).wait_event(b.events[2])


def launch_add_forces(b: NearContactBuffers):
    """Add the forces [N] of near pairs, and the torques [N·m] where they are wanted, to those of ``allocate``.

    On a CPU after sweeps, on a GPU :func:`launch_sweeps` goes before.
    """
    if b.reach > 0.0:
        _launch_each(b, 0 if b.stream is None else FORCES, FORCES + 2, contact_text, True)
