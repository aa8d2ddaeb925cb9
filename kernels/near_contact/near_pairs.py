"""Near contacts on the device: buffers of the near pairs, and launches of the passes over them.

The package's docstring has the physics and the symbols. Every ball has contact sources n = (q, N, n_Θ) and smooth
sources ã = (−q, m − N, Θ̃), with

    e = M ã,    n = ΔC e,    e_Θ = (1 − p) (e' − n_Θ/R⁵),    Θ̃ = −p R⁵ e' − (1 − p) n_Θ,    4π H_near = (M_sr a − e)_m,

where e' is the e_Θ of other balls, and p the polarizability. Heavy-ball sweeps

    n ← n + α s (ΔC e − n) + β (n − n'),

and the same for Θ̃, alternate with the evaluations of the induction, and start from the state of the last solve. s is
the inverse diagonal of 1 + ΔC M.

Only eligible balls take part, in pairs with one another. They are single inducible moments, with no more near balls
than slots and no more shared volume than the model allows. Near balls are found as ``neighbors`` finds overlaps, and
stored in slots, contacts first. ``select.h`` and ``tabulate.h`` have the passes that find them, ``sweeps.h`` the
sweeps, ``forces.h`` the forces. ``nonuniform.py`` has the forces of permanent moments, and their arrays. Ball i is
number i mod CHUNK of chunk i div CHUNK.

Rows of ``cached``: 0 to 7 and 13 are the drive by near balls that are no contacts (e_Θ, e_m, φ). Rows 8 to 12 are the
target of Θ̃; 16, 22 and 23 are (M_sr a)_m. Row 17 is the polarizability of the quadrupole, and 18 the weight that falls
as a ball saturates.
"""

from contextlib import contextmanager
from dataclasses import dataclass
from functools import cache
from itertools import pairwise
from typing import Any

import numpy as np
import warp as wp

from warpmag.kernels.near_contact import contact_table, images, nonuniform
from warpmag.kernels.pairs import neighbors
from warpmag.kernels.pairs.pair_law import INVERSE_4PI
from warpmag.kernels.pairs.wrench import MU0
from warpmag.kernels.shared.native import CHUNK, LINE, PASS_ARGUMENTS, native_kernel
from warpmag.kernels.shared.team import launch_passes, threads_for

MOST_KINDS = 16  # largest number of different susceptibilities; if there are more, quantiles represent all of them
CANDIDATES = 64  # capacity of a ball's list of candidates, which are near or may become near
MARGIN = 0.05  # fraction of its radius that a ball may move before candidates are searched again
_SEARCH_RATIO = 0.5 * contact_table.REACH + MARGIN
NEAR_SLOTS = 32  # slots for near balls; balls that do not overlap have at most about 24
CONTACT_SLOTS = 16  # slots for contacts: the first of the slots for near balls
GROUP = 8  # threads of a GPU that share a ball
SWEEPS = 2
"""Sweeps before each field evaluation and before forces. With one, a cold solve of a pile takes twice as many
evaluations."""
_LAST_SWEEP_PASS = 2 * SWEEPS
"""Index of the last pass of the sweeps: each sweep has a pass for the drive and one for the step."""
_ROWS = dict(
    PAIR_ROWS=8, PAIR_SLOPE_ROWS=2, CONDUCTANCE_ROWS=17, CONDUCTANCE_SLOPE_ROWS=14, STATE_ROWS=16, CACHED_ROWS=24
)  # fmt: skip
_START_ARRAYS = ("state", "last_state", "sources")  # arrays from which the sweeps of the next solve start
_BALLS_PER_THREAD = 500  # fewest balls per thread of a CPU
_PAIRS_PER_THREAD = 20000  # fewest pairs of a ball and a permanent moment per thread of a CPU: 0.1 ms
_EIGENVALUES = 0.4, 4.0
"""Bounds of the eigenvalues of 1 + ΔC M, scaled by s, in piles of any permeability, touching or overlapping."""


def _constants(with_images: bool) -> dict[str, int | float]:
    """Return the constants of the headers."""
    low, high = (bound**0.5 for bound in _EIGENVALUES)
    first, last, nodes = contact_table.LOG_GAPS
    fades = {name: getattr(contact_table, name) for name in ("MOST_SHARED", "LEAST_RATIO", "CONTACT_GAP", "DEEPEST")}
    fades["QUADRUPOLE_GAP"] = [distance - 2.0 for distance in contact_table.QUADRUPOLE_REACH]
    fades["QUADRUPOLE_OVERLAP"] = contact_table.QUADRUPOLE_OVERLAP
    return _ROWS | nonuniform.constants() | images.image_constants(with_images) | dict(
        GROUP=GROUP, CANDIDATES=CANDIDATES, NEAR_SLOTS=NEAR_SLOTS, CONTACT_SLOTS=CONTACT_SLOTS, SWEEPS=SWEEPS,
        MARGIN=MARGIN, HALF_RANGE=0.5 * contact_table.RANGE, HALF_REACH=0.5 * contact_table.REACH,
        SMALLEST_GAP=contact_table.SMALLEST_GAP, SOFTNESS=contact_table.SOFTNESS, NODES=nodes, FIRST_NODE=first,
        NODES_PER_UNIT=(nodes - 1) / (last - first), UNIT=MU0 * INVERSE_4PI,
        # diagonal of M for a ball of unit radius
        OWN_SOURCE=1.0 - 1.2 * 2.0 / contact_table.RANGE, OWN_DIPOLE=1.0 - (2.0 / contact_table.RANGE) ** 3,
        PACE=4.0 / (high + low) ** 2, MOMENTUM=((high - low) / (high + low)) ** 2,
        **{f"{name}_LOW": value for name, (value, _) in fades.items()},
        **{f"{name}_HIGH": value for name, (_, value) in fades.items()},
    )  # fmt: skip


@cache
def contact_arrays(dtype) -> Any:
    """Return the struct of the arrays of the passes, for n moments; ``NearArrays`` in ``state.h``.

    Balls are moments padded to a multiple of ``CHUNK``.
    """
    vec3 = wp.types.vector(3, dtype)

    @wp.struct
    class ContactArrays:
        balls: int
        moment_stride: int  # numbers in a row of ``packed``
        kinds: int  # number of kinds of material
        common_curve: int  # id of the magnetization curve that all balls share, else negative
        # Model:
        packed: wp.array2d[dtype]  # the moments (``pairs.packing``)
        group: wp.array[wp.int32]  # world, −1 for balls that do not take part [balls]
        kind: wp.array[wp.int32]  # kind of material [balls]
        tables: wp.array2d[dtype]  # spline coefficients of A to P by gap for pairs of kinds [kinds² (gaps + 2), LINE]
        radius: wp.array[dtype]  # [m] [balls]
        inverse_saturation: wp.array[dtype]  # 1/(V Ms) [1/(A·m²)] [balls]
        curve_slope: wp.array[dtype]  # slopes k of the curves [balls]
        hardness: wp.array[dtype]  # (2χ + 5)/2χ [balls]
        curve: wp.array[wp.int32]  # ids of the curves [balls]
        curve_tables: wp.array2d[dtype]  # measured curves (``material.curves``) [rows, 8]
        movable: wp.array[wp.int32]  # 1 where the force is evaluated [balls]
        rotatable: wp.array[wp.int32]  # 1 where the torque is evaluated [balls]
        # Work: near pairs
        candidate: wp.array2d[wp.int32]  # balls that are near, or may become near
        candidate_count: wp.array[wp.int32]
        found_at: wp.array[vec3]  # positions at the last search
        moved: wp.array[wp.int32]  # 1 if a ball has moved too far since then [1]
        positions: wp.array2d[dtype]  # x, y, z, radius; weight, kind [balls, LINE]
        near: wp.array3d[wp.int32]  # near balls [chunks, slots, CHUNK]
        near_count: wp.array[wp.int32]  # number of near balls [balls]
        contact_count: wp.array[wp.int32]  # number of contacts [balls]
        used: wp.array2d[wp.int32]  # number of slots of both kinds in use [2, balls]
        pairs: wp.array4d[dtype]  # direction; U_sr, g1 d, g2 d², 1/d, window of quadrupoles [chunks, slots, 8, CHUNK]
        pair_slopes: wp.array4d[dtype]  # for forces: g3 d³, derivative of the window [chunks, slots, 2, CHUNK]
        conductances: wp.array4d[dtype]  # A to P, then D', J', L' of the other ball [chunks, slots, 17, CHUNK]
        conductance_slopes: wp.array4d[dtype]  # derivatives of A to P by the distance [chunks, slots, 14, CHUNK]
        counterpart: wp.array3d[wp.int32]  # index of the other ball's part in ``pair_forces`` [chunks, slots, CHUNK]
        relaxation: wp.array2d[dtype]  # s of a ball's q and N [2, balls]
        # Work: sweeps
        state: wp.array3d[dtype]  # xx, yy, xy, yz, zx of Θ̃, N; n_Θ, q, two unused [chunks, 16, CHUNK]
        last_state: wp.array3d[dtype]  # state before the last sweep
        sources: wp.array2d[dtype]  # Θ̃, N, q and m, for other balls to read [balls, LINE]
        drives: wp.array2d[dtype]  # R² e_Θ, R e_m, φ and the weight, for other balls to read [balls, LINE]
        cached: wp.array3d[dtype]  # rows described above [chunks, 24, CHUNK]
        # Data out:
        field_row: wp.array[wp.int32]  # row of each ball in ``partial``, −1 without one [balls]
        partial: wp.array2d[dtype]  # partial sums of the field [rows, 3]
        field: wp.array3d[dtype]  # 4π H_near [A/m], for torques [chunks, 3, CHUNK]
        pair_forces: wp.array4d[dtype]  # forces of contacts by the own half of ΔC [chunks + 1, slots, 3, CHUNK]
        forces: wp.array[vec3]  # [N] [n]
        torques: wp.array[vec3]  # [N·m] [n]
        magnets: nonuniform.magnet_arrays(dtype)  # permanent moments
        faces: images.face_arrays(dtype)  # flat faces of iron

    return ContactArrays


@dataclass(frozen=True)
class NearContactBuffers:
    """Buffers of the model on a device."""

    dtype: Any  # Warp scalar type
    lists: Any  # neighbor lists of the candidates
    arrays: Any  # arrays of the passes, see :func:`contact_arrays`
    reach: float  # distance of the farthest contact [m]; 0 if no moment takes part
    threads: int  # threads of a CPU for passes over near pairs
    nonuniform_threads: int  # threads of a CPU for forces of non-uniform fields; 0 if there are none
    stream: wp.Stream | None  # stream of a GPU that runs in parallel with the pair sums
    # Events of that stream: its start, the write of H_near to the field's sums, and its end.
    events: tuple[wp.Event, ...]
    reactions: images.ImageReactions | None  # on iron with faces; None without
    commands: dict  # recorded launches, so that the arrays are packed only once

    @property
    def device(self):
        """The Warp device."""
        return self.arrays.group.device

    def start_cold(self, chosen):
        """Set the contact sources to zero in worlds where ``chosen`` is not 0, shape [worlds]."""
        neighbors.launch_request_search(self.lists, chosen)
        wp.launch(_cold_kernel(self.dtype), self.arrays.balls, inputs=[chosen, self.arrays], device=self.device)

    def persistent_arrays(self) -> dict:
        """Return the arrays that persist from one solve to the next, by name."""
        return neighbors.persistent_lists(self.lists) | {name: getattr(self.arrays, name) for name in _START_ARRAYS}


@cache
def _cold_kernel(dtype):
    @wp.kernel(module="unique", enable_backward=False)
    def start_cold(chosen: wp.array[int], a: contact_arrays(dtype)):
        i = wp.tid()
        world = a.group[i]
        if world < 0:
            return
        if chosen[world] == 0:
            return
        chunk = i // wp.static(CHUNK)
        lane = i % wp.static(CHUNK)
        for row in range(a.state.shape[1]):
            a.state[chunk, row, lane] = dtype(0.0)
            a.last_state[chunk, row, lane] = dtype(0.0)
        for entry in range(a.sources.shape[1]):
            a.sources[i, entry] = dtype(0.0)

    return start_cold


def allocate(
    packed, worlds, eligible, susceptibility, material, *, ranges, magnets, single, field, movable, rotatable,
    forces, torques, expansion=None, faces=(), rotations=None,
) -> NearContactBuffers:  # fmt: skip
    """Return the buffers.

    Args:
        worlds: World of each moment, shape [n].
        eligible: True for moments that may take part, shape [n].
        susceptibility: Susceptibility of each moment, which may be infinite, shape [n].
        material: Curves of the moments (``curves.CurveParameters``).
        ranges: First moment, first permanent moment and end of each world.
        magnets: True for moments of permanent magnets, fixed or with a recoil permeability, shape [n].
        single: True for moments that are their body's only one, shape [n].
        field: Evaluation of the field at the moments (``evaluate.PairEvaluation``), whose last partial sum is written.
        movable, rotatable: True for moments whose force and torque are evaluated, shape [n].
        forces, torques: In and out [N, N·m], Warp arrays, shape [n].
        expansion: Expansions of the sources' fields about the moments (``applied/balls.h``), or None.
        faces: Flat faces of iron bodies (``images.IronFaces``), ordered by world.
        rotations: Rotation of each body of cells to the world, Warp array, shape [bodies].
    """
    n, dtype, device = packed.count, packed.dtype, packed.device
    balls = -(-max(n, 1) // CHUNK) * CHUNK

    def padded(values, fill):
        """Return the values of balls that take part, and ``fill`` for all other moments."""
        chosen = np.pad(np.where(eligible, values, fill), (0, balls - n), constant_values=fill)
        return wp.array(chosen, dtype=dtype if isinstance(fill, float) else wp.int32, device=device)

    group = padded(worlds, -1)
    radii = packed.radii.numpy()
    reach = 2.0 * float(np.max(radii, initial=0.0, where=eligible))
    lists = neighbors.allocate(n, packed.packed, group, reach=reach, ratio=_SEARCH_RATIO, capacity=CANDIDATES)
    a = contact_arrays(dtype)()
    a.balls, a.common_curve = balls, material.common_curve
    a.moment_stride = packed.packed.strides[0] // wp.types.type_size_in_bytes(dtype)
    a.packed, a.group = packed.packed, group
    a.candidate, a.candidate_count, a.found_at, a.moved = lists.neighbor, lists.count, lists.found_at, lists.moved
    a.field_row, a.partial = padded(_field_rows(field, n), -1), field.partial[-1]
    a.movable, a.rotatable = padded(movable, 0), padded(movable & rotatable, 0)
    a.forces, a.torques = forces, torques
    _set_materials(a, radii, eligible, susceptibility, material, padded)
    _set_pairs(a, balls, images.IMAGES if faces else 0, dtype, device)
    a.faces = images.allocate(balls, faces, rotations, worlds, radii, material, dtype=dtype, device=device)
    moving = [(k, *ranges[body.world][::2]) for k, body in enumerate(faces) if movable[body.first]]
    reactions = images.ImageReactions(a.faces, moving, packed, forces, torques) if faces else None
    pairs, a.magnets = nonuniform.allocate(
        balls, ranges, eligible, magnets, single, movable, dtype=dtype, device=device, expansion=expansion
    )
    threads = threads_for(n, _BALLS_PER_THREAD)
    nonuniform_threads = threads_for(pairs, _PAIRS_PER_THREAD) if pairs or expansion is not None else 0
    stream = wp.Stream(device, priority=-1) if device.is_cuda else None
    events = tuple(wp.Event(device) for _ in range(3)) if device.is_cuda else ()
    return NearContactBuffers(
        dtype, lists, a, reach, threads, nonuniform_threads, stream, events, reactions, commands={}
    )


def _field_rows(field, n: int) -> np.ndarray:
    """Return the row of each moment in the sums of ``field``, −1 for moments without one."""
    rows = np.full(n, -1)
    rows[field.target.numpy()] = np.arange(field.count)
    return rows


def _set_materials(a, radii, eligible, susceptibility, material, padded) -> None:
    """Set the arrays that describe the balls' materials."""
    hardness = contact_table.hardness(susceptibility)
    levels = np.unique(hardness[eligible]) if np.any(eligible) else np.zeros(1)
    if len(levels) > MOST_KINDS:
        levels = np.quantile(levels, np.linspace(0.0, 1.0, MOST_KINDS))
    tables = np.concatenate([contact_table.gap_table(float(own), float(other)) for own in levels for other in levels])
    slope = 3.0 / (1.0 + 3.0 / np.asarray(susceptibility, float))
    saturated = 4.0 / 3.0 * np.pi * np.where(eligible, radii, 1.0).astype(float) ** 3 * material.saturation.numpy()
    lines = np.pad(tables, ((0, 0), (0, LINE - contact_table.FUNCTIONS)))
    a.kinds, a.kind = len(levels), padded(np.abs(hardness[:, None] - levels[None]).argmin(1), 0)
    a.radius, a.inverse_saturation = padded(radii, 1.0), padded(1.0 / saturated, 1.0)
    a.curve_slope, a.hardness = padded(slope, 1.0), padded(2.5 / slope + 1.0 / 6.0, 1.0)
    a.curve, a.curve_tables = padded(material.curve.numpy(), 0), material.tables
    a.tables = wp.array(lines, dtype=a.radius.dtype, device=a.radius.device)


def _set_pairs(a, balls: int, images_of_ball: int, dtype, device) -> None:
    """Set the arrays to no pairs: each slot holds the ball itself and has no counterpart."""
    chunks = balls // CHUNK

    def zeros(*shape, kind=dtype):
        return wp.zeros(shape, dtype=kind, device=device)

    def slots(count, rows):
        return zeros(chunks, count, _ROWS[rows], CHUNK)

    own_indices = np.broadcast_to(np.arange(balls).reshape(chunks, 1, CHUNK), (chunks, NEAR_SLOTS, CHUNK))
    no_counterpart = np.full((chunks, CONTACT_SLOTS, CHUNK), chunks * CONTACT_SLOTS * 3 * CHUNK)
    a.near = wp.array(own_indices, dtype=wp.int32, device=device)
    a.counterpart = wp.array(no_counterpart, dtype=wp.int32, device=device)
    a.near_count, a.contact_count = zeros(balls, kind=wp.int32), zeros(balls, kind=wp.int32)
    a.used, a.relaxation = zeros(2, balls, kind=wp.int32), zeros(2, balls)
    a.positions, a.sources, a.drives = (zeros((1 + images_of_ball) * balls, LINE) for _ in range(3))
    a.pairs, a.pair_slopes = slots(NEAR_SLOTS, "PAIR_ROWS"), slots(NEAR_SLOTS, "PAIR_SLOPE_ROWS")
    a.conductances = slots(CONTACT_SLOTS, "CONDUCTANCE_ROWS")
    a.conductance_slopes = slots(CONTACT_SLOTS, "CONDUCTANCE_SLOPE_ROWS")
    a.pair_forces, a.field = zeros(chunks + 1, CONTACT_SLOTS, 3, CHUNK), zeros(chunks, 3, CHUNK)
    states, cached = (chunks, _ROWS["STATE_ROWS"], CHUNK), (chunks, _ROWS["CACHED_ROWS"], CHUNK)
    a.state, a.last_state, a.cached = zeros(*states), zeros(*states), zeros(*cached)


_HEADERS = dict(Positions="select", Pairs="tabulate", Sweeps="sweeps", Forces="forces", NonuniformField="nonuniform")


@cache
def kernel(dtype, passes: str, with_images: bool = False):
    """Return a kernel that runs the passes of a struct in one of the headers."""
    call = f"make_passes<warpmag::{passes}>(thread, first, last, threads, team.data, arrays)"
    header, arguments = f"near_contact/{_HEADERS[passes]}.h", {**PASS_ARGUMENTS, "arrays": contact_arrays(dtype)}
    return native_kernel(call, header, arguments, dtype=dtype, **_constants(with_images))


def _launch(buffers: NearContactBuffers, passes: str, first: int, last: int):
    """Launch passes ``first`` to ``last`` − 1: all at once on a CPU, one by one on a GPU."""
    threads = buffers.nonuniform_threads if passes == "NonuniformField" else buffers.threads
    sizes = dict(threads=threads, gpu_threads=GROUP * buffers.arrays.balls, block_dim=128)
    for begin, end in [(first, last)] if buffers.device.is_cpu else pairwise(range(first, last + 1)):
        key = passes, begin, end
        if key not in buffers.commands:
            native, device = kernel(buffers.dtype, passes, buffers.reactions is not None), buffers.device
            command = launch_passes(native, begin, end, buffers.arrays, device=device, record_cmd=True, **sizes)
            buffers.commands[key] = command
        buffers.commands[key].launch()


@contextmanager
def _on_side_stream(buffers: NearContactBuffers):
    """Run the launches of a ``with`` block on a separate stream of a GPU, after all previous launches."""
    if buffers.stream is None:
        yield
        return
    buffers.stream.wait_event(wp.get_stream(buffers.stream.device).record_event(buffers.events[0]))
    with wp.ScopedStream(buffers.stream, sync_enter=False):
        yield
        buffers.stream.record_event(buffers.events[2])


def _first_pass(buffers: NearContactBuffers) -> int:
    """Return the first pass of a GPU: without images, none reads the moments in lines that pass 0 writes."""
    return 0 if buffers.reactions is not None else 1


def launch_find_pairs(buffers: NearContactBuffers):
    """Find the near pairs of the packed moments and tabulate them.

    On a GPU this runs in parallel with the following launches, until :func:`wait`.
    """
    if buffers.reach == 0.0:
        return
    with _on_side_stream(buffers):
        _launch(buffers, "Positions", 0, 1)
        neighbors.launch_find_neighbors(buffers.lists, buffers.lists, wp.launch)
        _launch(buffers, "Pairs", 0, 2)


def launch_sweeps(buffers: NearContactBuffers):
    """Move the contact sources towards equilibrium with the packed moments, and write 4π H_near to the field sums.

    On a GPU this runs in parallel with the following launches, until :func:`wait`.
    """
    if buffers.reach == 0.0:
        return
    if buffers.stream is None:
        _launch(buffers, "Sweeps", 0, _LAST_SWEEP_PASS + 1)
        return
    with _on_side_stream(buffers):
        _launch(buffers, "Sweeps", _first_pass(buffers), _LAST_SWEEP_PASS)
        buffers.stream.record_event(buffers.events[1])
        _launch(buffers, "Sweeps", _LAST_SWEEP_PASS, _LAST_SWEEP_PASS + 1)


def launch_begin_forces(buffers: NearContactBuffers):
    """Begin the sweeps for the forces on a GPU, in parallel with the following launches."""
    if buffers.reach > 0.0 and buffers.stream is not None:
        with _on_side_stream(buffers):
            _launch(buffers, "Forces", _first_pass(buffers), _LAST_SWEEP_PASS + 1)


def launch_add_forces(buffers: NearContactBuffers):
    """Add the forces [N] and torques [N·m] of near pairs, and of balls in non-uniform fields."""
    if buffers.reach == 0.0:
        return
    wait(buffers)
    _launch(buffers, "Forces", 0 if buffers.stream is None else _LAST_SWEEP_PASS + 1, _LAST_SWEEP_PASS + 2)
    if buffers.reactions is not None:
        buffers.reactions.add()
    if buffers.nonuniform_threads:
        _launch(buffers, "NonuniformField", 0, 4)


def wait(buffers: NearContactBuffers, *, for_field: bool = False):
    """Make the following launches wait for the parallel stream, or only for the field of :func:`launch_sweeps`."""
    if buffers.reach > 0.0 and buffers.stream is not None:
        wp.get_stream(buffers.stream.device).wait_event(buffers.events[1 if for_field else 2])
