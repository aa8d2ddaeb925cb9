"""Near contacts on the device: buffers of the near pairs, and launches of the passes over them.

The package's docstring has the physics and the names. Every ball has contact sources n = (q, N, n_Θ), and with what is
left of its actual ones, ã = (−q, m − N, Θ̃),

    e = M ã,    n = ΔC e,    e_Θ = (1 − p) (e' − n_Θ/R⁵),    Θ̃ = −p R⁵ e' − (1 − p) n_Θ,    4π H_near = (M_sr a − e)_m,

e' the e_Θ that other balls make, p the polarizability. Heavy-ball sweeps

    n ← n + α s (ΔC e − n) + β (n − n'),

and the same for Θ̃, with s the inverse diagonal of 1 + ΔC M, run along with the induction, from where the last left off.

Only eligible balls take part, in pairs with one another: single inducible moments with no more near balls than there
are slots, and no more volume shared than the model allows. Near balls are found as ``neighbors`` finds overlaps, and
kept as slots, those whose surfaces nearly touch first. ``select.h`` and ``tabulate.h`` have the passes that find them,
``sweeps.h`` the sweeps, ``forces.h`` the forces. ``uneven.py`` has what permanent moments add, and its arrays.

| array | shape | meaning |
|---|---|---|
| group, kind | [balls] | world, −1 for balls that do not take part; kind of material |
| tables | [kinds² (gaps + 2), LINE] | spline coefficients of A to P by gap for each pair of kinds |
| radius, unsaturated | [balls] | radii [m] and 1/(V Ms) [1/(A·m²)] |
| curve_slope, hardness | [balls] | slopes k of the curve, and (2χ + 5)/2χ |
| curve, curve_tables | [balls], [rows, 8] | ids of the curves, and measured ones (``material.curves``) |
| places | [balls, LINE] | x, y, z, radius; how far a ball takes part, kind |
| near, near_count, contact_count | [chunks, slots, CHUNK], [balls] | near balls, how many, and how many nearly touch |
| used | [2, balls] | slots of both kinds that hold something |
| pairs | [chunks, slots, 8, CHUNK] | direction to the other ball; U_sr, g1 d, g2 d², 1/d, the quadrupoles' window |
| pair_slopes | [chunks, slots, 2, CHUNK] | derivatives, apart since sweeps do not read them: g3 d³ and the window's |
| conductances | [chunks, slots, 17, CHUNK] | of contacts: A to P, then D', J' and L' of the other ball |
| conductance_slopes | [chunks, slots, 14, CHUNK] | derivatives of A to P by the distance |
| relaxation | [2, balls] | s of a ball's q and N |
| state, last_state | [chunks, 16, CHUNK] | xx, yy, xy, yz, zx of Θ̃, N; n_Θ, q, two unused; those of the sweep before |
| sources, drives | [balls, LINE] | what others read: Θ̃, N, q and m; R² e_Θ, R e_m, φ and the weight |
| kept | [chunks, 24, CHUNK] | what passes keep for those that follow, see below |
| pair_forces | [chunks + 1, slots, 3, CHUNK] | what a ball has of its contacts' forces; zeros at the end |
| counterpart | [chunks, slots, CHUNK] | place in ``pair_forces`` of what the other ball has |
| field | [chunks, 3, CHUNK] | 4π H_near [A/m], for torques |
| field_row, partial | [balls], [rows, 3] | row of each ball in the field sums, −1 if it has none; the part to add |
| movable, turned | [balls] | whether the force and the torque on a ball are wanted |

Rows of ``kept`` are 0 to 7 and 13 what balls make of the drive that do not touch (e_Θ, e_m, φ), 8 to 12 what Θ̃ moves
towards, 16, 22 and 23 (M_sr a)_m, 17 and 18 the polarizability of the quadrupole and the weight that falls as a ball
saturates. Ball i is number i mod CHUNK of chunk i div CHUNK.
"""

from contextlib import contextmanager
from dataclasses import dataclass
from functools import cache
from itertools import pairwise
from typing import Any

import numpy as np
import warp as wp

from warpmag.kernels.near_contact import contact_table, uneven
from warpmag.kernels.pairs import neighbors
from warpmag.kernels.pairs.pair_law import INVERSE_4PI
from warpmag.kernels.pairs.wrench import MU0
from warpmag.kernels.shared.native import CHUNK, LINE, PASS_ARGUMENTS, native_kernel
from warpmag.kernels.shared.team import team, threads_for

MOST_KINDS = 16
"""Susceptibilities that are distinguished."""
CANDIDATES = 64
"""Balls that may be listed as near, or about to be."""
MARGIN = 0.05
"""Part of its radius that a ball may move before near balls are sought anew."""
_RATIO = 0.5 * contact_table.REACH + MARGIN
NEAR_SLOTS = 32
"""Slots for near balls; balls that do not overlap have at most about 24."""
CONTACT_SLOTS = 16
"""The first of them, for those that nearly touch."""
GROUP = 8
"""Threads of a GPU that share a ball."""
SWEEPS = 2
"""Sweeps before each field evaluation, and before forces are taken: with one, a cold solve of a pile takes twice as
many evaluations."""
_LAST = 2 * SWEEPS
"""The last pass of the sweeps: a drive and a step for each."""
_ROWS = dict(
    PAIR_ROWS=8, PAIR_SLOPE_ROWS=2, CONDUCTANCE_ROWS=17, CONDUCTANCE_SLOPE_ROWS=14, STATE_ROWS=16, KEPT_ROWS=24
)  # fmt: skip
_WARM = ("state", "last_state", "sources")
"""Arrays that sweeps go on from."""
_BALLS_PER_THREAD = 500
"""Balls that make another thread of a CPU worth its start."""
_PAIRS_PER_THREAD = 20000
"""Pairs of a ball and a permanent moment that do: 0.1 ms."""
_LEAST, _MOST = 0.4, 4.0
"""Between these lie the eigenvalues of what sweeps solve for, in piles of any permeability, touching or overlapping."""


def _constants() -> dict[str, int | float]:
    """What the headers take."""
    first, last, nodes = contact_table.LOG_GAPS
    fades = {name: getattr(contact_table, name) for name in ("MOST_SHARED", "LEAST_RATIO", "CONTACT_GAP", "DEEPEST")}
    fades["QUADRUPOLE_GAP"] = [distance - 2.0 for distance in contact_table.QUADRUPOLE_REACH]
    fades["QUADRUPOLE_OVERLAP"] = contact_table.QUADRUPOLE_OVERLAP
    return _ROWS | uneven.constants() | dict(
        GROUP=GROUP, CANDIDATES=CANDIDATES, NEAR_SLOTS=NEAR_SLOTS, CONTACT_SLOTS=CONTACT_SLOTS, SWEEPS=SWEEPS,
        MARGIN=MARGIN, HALF_RANGE=0.5 * contact_table.RANGE, HALF_REACH=0.5 * contact_table.REACH,
        SMALLEST_GAP=contact_table.SMALLEST_GAP, SOFTNESS=contact_table.SOFTNESS, NODES=nodes, FIRST_NODE=first,
        NODES_PER_UNIT=(nodes - 1) / (last - first), UNIT=MU0 * INVERSE_4PI,
        # M of a ball of unit radius on itself
        OWN_SOURCE=1.0 - 1.2 * 2.0 / contact_table.RANGE, OWN_DIPOLE=1.0 - (2.0 / contact_table.RANGE) ** 3,
        PACE=4.0 / (_MOST**0.5 + _LEAST**0.5) ** 2,
        MOMENTUM=((_MOST**0.5 - _LEAST**0.5) / (_MOST**0.5 + _LEAST**0.5)) ** 2,
        **{f"{name}_LOW": low for name, (low, _) in fades.items()},
        **{f"{name}_HIGH": high for name, (_, high) in fades.items()},
    )  # fmt: skip


# those that sweeps read stand together, at the end of the integers and at the beginning of the reals
_INTEGERS = (
    *("group", "field_row", "kind", "candidate", "candidate_count", "moved", "used", "counterpart"),
    *("movable", "turned", "near", "near_count", "contact_count", "curve", "other_begin", "other_end", "pushed"),
)
_SIZES = ("balls", "moment_stride", "kinds", "common_curve")
_REALS = (
    *("packed", "radius", "unsaturated", "curve_slope", "hardness", "relaxation", "pairs", "conductances", "state"),
    *("last_state", "sources", "drives", "field", "kept", "pair_slopes", "conductance_slopes", "pair_forces"),
    *("partial", "found_at", "tables", "places", "forces", "torques", "curve_tables", "alone", "response", "bounds"),
    "expansion",
)
_MEMBERS = dict.fromkeys(_INTEGERS, wp.uint64) | dict.fromkeys(_SIZES, int) | dict.fromkeys(_REALS, wp.uint64)
_DOC = "Where arrays begin, side by side, for a GPU to read together; and sizes. As in ``state.h``."
ContactArrays = wp.struct(type("ContactArrays", (), {"__doc__": _DOC, "__annotations__": _MEMBERS}))


@dataclass(frozen=True)
class NearContactBuffers:
    """All that the model keeps on the device, for n moments; balls are moments padded to ``CHUNK``.

    Attributes:
        dtype: Warp scalar type.
        lists: Balls that are near, or about to be.
        arrays: What passes over the pairs work on: those of the table above, and packed, candidate, candidate_count,
            found_at, moved, forces and torques of others.
        given: Where these are, their sizes and what else passes are given: kinds, the number of kinds of material, and
            the magnetization curve.
        reach: Distance of the farthest contact [m]; 0 if no moment may take part.
        threads: Threads of a CPU.
        uneven: Those for what uneven fields add; 0 if there are none.
        stream: Stream of a GPU for what is done beside the pair loops.
        events: There, when it starts, when the field is summed, and when all is done.
        commands: Launches as they were recorded, which spares packing the arrays each time.
    """

    dtype: Any
    lists: Any
    arrays: dict[str, wp.array]
    given: Any
    reach: float
    threads: int
    uneven: int
    stream: wp.Stream | None
    events: tuple[wp.Event, ...]
    commands: dict

    @property
    def device(self):
        """Where it is."""
        return self.arrays["group"].device

    def forget(self):
        """Start cold, from no contact sources."""
        for name in _WARM:
            self.arrays[name].zero_()

    def carried(self) -> dict:
        """Return the arrays that one solve hands on to the next one, by name."""
        return neighbors.carried_lists(self.lists) | {name: self.arrays[name] for name in _WARM}


def allocate(
    packed, worlds, eligible, susceptibility, material, *, ranges, magnets, lone, field, movable, turned,
    forces, torques, expansion=None,
) -> NearContactBuffers:  # fmt: skip
    """Allocate the buffers.

    Args:
        packed: The moments (``packing.PackedMoments``).
        worlds: World of each, shape [n].
        eligible: Whether a moment may take part, shape [n].
        susceptibility: Susceptibility of each, shape [n], may be infinite.
        material: Their ``curves.CurveParameters``.
        ranges: For each world its first moment, its first permanent one, and the end.
        magnets: Whether a moment is that of a permanent magnet, shape [n].
        lone: Whether it is its body's only one, shape [n].
        field: Evaluation of the field at them (``evaluate.PairEvaluation``), whose last part of the sums is written.
        movable: Whether the force on a moment is wanted, shape [n].
        turned: Whether its torque is, shape [n].
        forces, torques: What is added to [N, N·m], Warp arrays, shape [n].
        expansion: Fields of sources about the moments (``applied/balls.h``); None without such.
    """
    n, dtype, device = packed.count, packed.dtype, packed.device
    balls = -(-max(n, 1) // CHUNK) * CHUNK

    def padded(values, other):
        """Values of balls that take part, and another of the rest."""
        chosen = np.pad(np.where(eligible, values, other), (0, balls - n), constant_values=other)
        return wp.array(chosen, dtype=dtype if isinstance(other, float) else wp.int32, device=device)

    group = padded(worlds, -1)
    radii = packed.radii.numpy()
    reach = 2.0 * float(np.max(radii, initial=0.0, where=eligible))
    lists = neighbors.allocate(n, packed.packed, group, reach=reach, ratio=_RATIO, capacity=CANDIDATES)
    kinds, described = _material_arrays(radii, eligible, susceptibility, material, padded)
    pairs, others = uneven.allocate(balls, ranges, eligible, magnets, lone, movable, dtype, device)
    arrays = _pair_arrays(balls, dtype, device) | described | others
    arrays |= {
        "packed": packed.packed,
        "group": group,
        **{"candidate": lists.neighbor, "candidate_count": lists.count},
        **{"found_at": lists.found_at, "moved": lists.moved},
        "field_row": padded(_field_rows(field, n), -1),
        "partial": field.partial[-1],
        "movable": padded(movable, 0),
        "turned": padded(movable & turned, 0),
        **{"forces": forces, "torques": torques, "expansion": expansion},
    }
    stride = packed.packed.strides[0] // wp.types.type_size_in_bytes(dtype)
    return NearContactBuffers(
        dtype=dtype,
        lists=lists,
        arrays=arrays,
        given=_addresses(arrays, balls=balls, moment_stride=stride, kinds=kinds, common_curve=material.common_curve),
        reach=reach,
        uneven=threads_for(pairs, _PAIRS_PER_THREAD) if pairs or expansion is not None else 0,
        threads=threads_for(n, _BALLS_PER_THREAD),
        stream=wp.Stream(device, priority=-1) if device.is_cuda else None,
        events=tuple(wp.Event(device) for _ in range(3)) if device.is_cuda else (),
        commands={},
    )


def _field_rows(field, n: int) -> np.ndarray:
    """Row of each moment in the sums of ``field``, −1 if it has none."""
    rows = np.full(n, -1)
    rows[field.target.numpy()] = np.arange(field.count)
    return rows


def _addresses(arrays: dict[str, wp.array], **sizes: int) -> Any:
    given = ContactArrays()
    for name in (*_INTEGERS, *_REALS):
        setattr(given, name, (arrays[name].ptr if arrays[name] is not None else None) or 0)
    for name, size in sizes.items():
        setattr(given, name, size)
    return given


def _material_arrays(radii, eligible, susceptibility, material, padded) -> tuple[int, dict[str, wp.array]]:
    """The number of kinds of material, and the arrays that describe what balls are made of."""
    hardness = contact_table.hardness(susceptibility)
    levels = np.unique(hardness[eligible]) if np.any(eligible) else np.zeros(1)
    if len(levels) > MOST_KINDS:
        levels = np.quantile(levels, np.linspace(0.0, 1.0, MOST_KINDS))
    tables = np.concatenate([contact_table.gap_table(float(own), float(other)) for own in levels for other in levels])
    slope = 3.0 / (1.0 + 3.0 / np.asarray(susceptibility, float))
    saturated = 4.0 / 3.0 * np.pi * np.where(eligible, radii, 1.0).astype(float) ** 3 * material.saturation.numpy()
    arrays = {
        "kind": padded(np.abs(hardness[:, None] - levels[None]).argmin(1), 0),
        "radius": padded(radii, 1.0),
        "unsaturated": padded(1.0 / saturated, 1.0),
        "curve_slope": padded(slope, 1.0),
        "curve": padded(material.curve.numpy(), 0),
        "curve_tables": material.tables,
        "hardness": padded(2.5 / slope + 1.0 / 6.0, 1.0),
    }
    lines = np.pad(tables, ((0, 0), (0, LINE - contact_table.FUNCTIONS)))
    arrays["tables"] = wp.array(lines, dtype=arrays["radius"].dtype, device=arrays["radius"].device)
    return len(levels), arrays


def _pair_arrays(balls: int, dtype, device) -> dict[str, wp.array]:
    """Arrays of the pairs, of no pair: slots hold the ball itself, and have no counterpart."""
    chunks = balls // CHUNK

    def zeros(*shape, kind=dtype):
        return wp.zeros(shape, dtype=kind, device=device)

    def slots(count, rows):
        return zeros(chunks, count, _ROWS[rows], CHUNK)

    itself = np.broadcast_to(np.arange(balls).reshape(chunks, 1, CHUNK), (chunks, NEAR_SLOTS, CHUNK))
    none = np.full((chunks, CONTACT_SLOTS, CHUNK), chunks * CONTACT_SLOTS * 3 * CHUNK)
    return {
        "near": wp.array(itself, dtype=wp.int32, device=device),
        "counterpart": wp.array(none, dtype=wp.int32, device=device),
        **{name: zeros(balls, kind=wp.int32) for name in ("near_count", "contact_count")},
        "used": zeros(2, balls, kind=wp.int32),
        "relaxation": zeros(2, balls),
        **{name: zeros(balls, LINE) for name in ("places", "sources", "drives")},
        "pairs": slots(NEAR_SLOTS, "PAIR_ROWS"),
        "pair_slopes": slots(NEAR_SLOTS, "PAIR_SLOPE_ROWS"),
        "conductances": slots(CONTACT_SLOTS, "CONDUCTANCE_ROWS"),
        "conductance_slopes": slots(CONTACT_SLOTS, "CONDUCTANCE_SLOPE_ROWS"),
        "pair_forces": zeros(chunks + 1, CONTACT_SLOTS, 3, CHUNK),
        **{name: zeros(chunks, _ROWS["STATE_ROWS"], CHUNK) for name in ("state", "last_state")},
        "kept": zeros(chunks, _ROWS["KEPT_ROWS"], CHUNK),
        "field": zeros(chunks, 3, CHUNK),
    }


# ---------------------------------------------------------------------------------------------------------------------
# Launches
# ---------------------------------------------------------------------------------------------------------------------


@cache
def kernel(dtype, passes: str):
    """Kernel that makes passes ``Places``, ``Pairs``, ``Sweeps``, ``Forces`` or ``Uneven``."""
    headers = {"Places": "select", "Pairs": "tabulate", "Sweeps": "sweeps", "Forces": "forces", "Uneven": "uneven"}
    call = f"make_passes<warpmag::{passes}>(thread, first, last, threads, team.data, arrays)"
    header, arguments = f"near_contact/{headers[passes]}.h", {**PASS_ARGUMENTS, "arrays": ContactArrays}
    return native_kernel(call, header, arguments, dtype=dtype, **_constants())


def _launch(b: NearContactBuffers, passes: str, first: int, last: int):
    """Launch passes ``first`` to ``last``, one by one on a GPU, where a launch is what they wait for."""
    cpu = b.device.is_cpu
    for begin, end in [(first, last)] if cpu else pairwise(range(first, last + 1)):
        key = passes, begin, end
        if key not in b.commands:
            b.commands[key] = wp.launch(
                kernel(b.dtype, passes),
                dim=1 if cpu else GROUP * b.given.balls,
                inputs=[begin, end, b.uneven if passes == "Uneven" else b.threads, team() if cpu else None, b.given],
                device=b.device,
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


def launch_find_pairs(b: NearContactBuffers):
    """Find the near pairs of the packed moments and tabulate what they add.

    On a GPU that is done beside what is launched next, until :func:`wait` ends it.
    """
    if b.reach == 0.0:
        return
    with _beside(b):
        _launch(b, "Places", 0, 1)
        neighbors.launch_find_neighbors(b.lists, b.lists)
        _launch(b, "Pairs", 0, 2)


def launch_sweeps(b: NearContactBuffers):
    """Move the contact sources towards those of the packed moments, and write their part of the field sums.

    On a GPU that is done beside what is launched next, until :func:`wait_for_field` and :func:`wait` end it.
    """
    if b.reach == 0.0:
        return
    if b.stream is None:
        _launch(b, "Sweeps", 0, _LAST + 1)
        return
    with _beside(b):
        _launch(b, "Sweeps", 1, _LAST)
        b.stream.record_event(b.events[1])
        _launch(b, "Sweeps", _LAST, _LAST + 1)


def wait_for_field(b: NearContactBuffers):
    """Have what is launched next wait for the field of :func:`launch_sweeps`."""
    if b.reach > 0.0 and b.stream is not None:
        wp.get_stream(b.stream.device).wait_event(b.events[1])


def launch_begin_forces(b: NearContactBuffers):
    """Begin to find the forces; on a GPU beside what is launched next, until :func:`launch_add_forces`."""
    if b.reach > 0.0 and b.stream is not None:
        with _beside(b):
            _launch(b, "Forces", 1, _LAST + 1)


def launch_add_forces(b: NearContactBuffers):
    """Add the forces [N] of near pairs, and the torques [N·m] where they are wanted, to those of the moments.

    And those of permanent moments on balls that feel an uneven field, and back.
    """
    if b.reach == 0.0:
        return
    wait(b)
    _launch(b, "Forces", 0 if b.stream is None else _LAST + 1, _LAST + 2)
    if b.uneven:
        _launch(b, "Uneven", 0, 4)


def wait(b: NearContactBuffers):
    """Have what is launched next wait for all that is done beside."""
    if b.reach > 0.0 and b.stream is not None:
        wp.get_stream(b.stream.device).wait_event(b.events[2])
