"""Couplings between the cells of bodies, and the launches that add their field.

A table belongs to a shape and serves all bodies of that shape. It has a list of entries for each cell, in chunks of
``native.CHUNK`` cells side by side, with as many slots as the longest list of the chunk:

    slot_begin: First slot of each chunk of all tables, and the end.
    other: The cell of its body that an entry is about, shape [slots · CHUNK].
    tensor: T_ij [1/m³], rows xx, yy, zz, xy, xz, yz of CHUNK numbers for each slot, flat; zero where a list has ended.
    place: Where cells are in their body, as its common fields have it, shape [3, rows].

Bodies refer to them, in as many chunks:

    chunk: First moment, how many moments, first row of the body, and first row of its table, shape [chunks].
    body: Which body it is of, shape [chunks].
    rotation: Rotation of each body, from its frame to the world's (x, y, z, w), shape [bodies].
    rows: First row of each body, and the end of them, shape [bodies].
    matrix: Strengths of the fields that all cells of a body have in common, of what it has of them [1/m³], flat,
        COMMON rows of COMMON a body.
    common: These strengths [A/m], frame of the body, flat, COMMON a body.
    moments: Moments [A·m²], shape [n]; those of a body follow each other.
    turned: Moments in the frames of their bodies, shape [3, chunks · CHUNK].
    world: First inducible moment of the chunk's world, and the end of them, shape [chunks].
    packed, overlap, overlap_count: All moments, packed, and what overlaps each (``packing.PackedMoments``).
    hardening: Demagnetizing factor of a body's cell that wholly lies in another body's [1], shape [bodies].
    hardness: What is added to the demagnetizing factor, over the volume [1/m³], shape [chunks · CHUNK].
    h: Field that is added to [A/m], shape [n].

Cells of different bodies act on each other as balls. Where these overlap, balls within the bodies would, too, count as
demagnetizing, and cells do not: the operator of bodies that intersect would be no longer positive, and induction have
several solutions. So a cell is demagnetized besides by the part of it that it shares with cells of other bodies, times
what the softest magnetization of its body lacks to be as hard as that of balls (``Coupling.hardening``): 0.1 for a
cube, 0.2 for a ball, more for thin sheets. That is enough for bodies in one place, and was for all others of 140
arrangements that were tried. Cubes that only touch share a tenth of a cell, whose demagnetizing factor grows by 0.01.
"""

from functools import cache

import numpy as np
import warp as wp

from warpmag.kernels.pairs.neighbors import CAPACITY
from warpmag.kernels.shared.native import CHUNK, PASS_ARGUMENTS, native_kernel
from warpmag.kernels.shared.reductions import group_threads
from warpmag.kernels.shared.team import team, threads_for

COMMON = 8
"""Fields that all cells of a body have in common; as in ``couplings.h``."""
HARDEN, TURN, SHARE, ADD = range(4)
"""The passes, in order; as in ``couplings.h``."""
_CELLS_PER_THREAD = 500
"""Cells that make another thread of a CPU worth waking."""


@cache
def couplings_type(dtype):
    """Type of the couplings; the module says what its arrays are."""
    vec3, quaternion = wp.types.vector(3, dtype), wp.types.quaternion(dtype)

    @wp.struct
    class Couplings:
        slot_begin: wp.array[int]
        other: wp.array[int]
        tensor: wp.array[dtype]
        chunk: wp.array[wp.vec4i]
        body: wp.array[int]
        rotation: wp.array[quaternion]
        rows: wp.array[wp.vec2i]
        place: wp.array2d[dtype]
        matrix: wp.array[dtype]
        common: wp.array[dtype]
        moments: wp.array[vec3]
        turned: wp.array2d[dtype]
        world: wp.array[wp.vec2i]
        packed: wp.array2d[dtype]
        overlap: wp.array2d[int]
        overlap_count: wp.array[int]
        hardening: wp.array[dtype]
        hardness: wp.array[dtype]
        h: wp.array[vec3]

    return Couplings


def _table(start, other, tensor):
    """Slots of a table's chunks, and their entries: numbers of cells and tensors."""
    counts = np.diff(start)
    chunks = -(-len(counts) // CHUNK)
    cell = np.repeat(np.arange(len(counts)), counts)
    padded = np.append(counts, np.zeros(chunks * CHUNK - len(counts), int)).reshape(chunks, CHUNK)
    slots = padded.max(axis=1, initial=0)
    begin = np.cumsum(slots) - slots
    slot = begin[cell // CHUNK] + np.arange(len(cell)) - np.repeat(start[:-1], counts)
    others = np.zeros((int(slots.sum()), CHUNK), np.int32)
    tensors = np.zeros((int(slots.sum()), 6, CHUNK))
    others[slot, cell % CHUNK] = other
    tensors[slot, :, cell % CHUNK] = tensor
    return slots, others, tensors


@cache
def _kernel(dtype, group: int):
    call = "add_couplings(thread, first, last, threads, team.data, arrays)"
    arguments = {**PASS_ARGUMENTS, "arrays": couplings_type(dtype)}
    return native_kernel(call, "cells/couplings.h", arguments, dtype=dtype, CAPACITY=CAPACITY, GROUP=group)


class CellCouplings:
    """What one set of bodies adds to a field, again and again in the same arrays.

    Args:
        bodies: Of each body the first moment, and the coupling of its cells: ``start``, ``other`` and ``tensor``, a
            list for each, ``places``, ``common`` and ``hardening`` (see ``warpmag.shapes.demagnetization``). Bodies
            with one and the same coupling share its table.
        worlds: First inducible moment of each world, and the end of them, shape [worlds, 2].
        packed: All moments, packed (``packing.PackedMoments``).
        moments: Moments [A·m²], Warp array, shape [n].
        h: Field to add to [A/m], Warp array, shape [n].
        whole: Of each body whether :meth:`launch_others` leaves it out, shape [bodies]; None leaves out none.

    Attributes:
        rotations: Rotation of each body, from its frame to the world's, shape [bodies]; written by the caller.
        hardness: What is added to the demagnetizing factor of cells, over the volume [1/m³].
        rows: First row of each body there, shape [bodies].
        entries: Pairs of cells that one evaluation sums.
    """

    def __init__(self, bodies, worlds, packed, moments, h, whole=None):
        """Lay out the tables on the device of the moments."""
        dtype = packed.dtype
        self._couplings = c = couplings_type(dtype)()
        c.moments, c.h, c.packed = moments, h, packed.packed
        c.overlap, c.overlap_count = packed.overlaps, packed.overlap_counts
        left = self._lay_out(bodies, whole, np.asarray(worlds), dtype, h.device)
        self.rotations, self.entries = c.rotation, sum(len(coupling.other) for _, coupling in bodies)
        self.hardness = c.hardness
        self._start = self._record(c, HARDEN, HARDEN)
        self._launches, self._others = self._record_field(c), []
        if left:
            part = couplings_type(dtype)()
            for name in couplings_type(dtype).vars:
                setattr(part, name, getattr(c, name))
            part.chunk = c.chunk[:left]
            self._others = self._record_field(part)

    def _record_field(self, couplings):
        on_gpu = couplings.h.device.is_cuda
        passes = [(one, one) for one in (TURN, SHARE, ADD)] if on_gpu else [(TURN, ADD)]
        return [self._record(couplings, *one) for one in passes]

    @staticmethod
    def _record(couplings, first: int, last: int):
        device, rows = couplings.h.device, CHUNK * couplings.chunk.shape[0]
        group, threads = group_threads(device), threads_for(rows, _CELLS_PER_THREAD)
        inputs = [first, last + 1, threads, None if device.is_cuda else team(), couplings]
        dim = group * rows if device.is_cuda else 1
        kernel = _kernel(couplings.packed.dtype, group)
        return wp.launch(kernel, dim=dim, inputs=inputs, device=device, record_cmd=True)

    def _lay_out(self, bodies, whole, worlds, dtype, device) -> int:
        """Fill the arrays; return how many chunks those bodies have that are not whole, which come first."""
        c, found, tables, places, chunks, body, left = self._couplings, {}, [], [], [], [], 0
        self.rows = np.zeros(len(bodies), int)
        whole = np.zeros(len(bodies), bool) if whole is None else np.asarray(whole, bool)
        for number in np.argsort(whole, kind="stable").tolist():
            first, coupling = bodies[number]
            if id(coupling) not in found:
                found[id(coupling)] = CHUNK * sum(len(slots) for slots, _, _ in tables)
                tables.append(_table(coupling.start, coupling.other, coupling.tensor))
                places.append(
                    np.pad(coupling.scaled_positions.T, ((0, 0), (0, -len(coupling.scaled_positions) % CHUNK)))
                )
            count, row = len(coupling.start) - 1, CHUNK * len(chunks)
            self.rows[number] = row
            starts = range(0, count, CHUNK)
            chunks += [(first + k, min(CHUNK, count - k), row, found[id(coupling)]) for k in starts]
            body += [number] * len(starts)
            left += 0 if whole[number] else len(starts)
        slots, others, tensors = (np.concatenate(parts) for parts in zip(*tables, strict=True))

        def put(values, kind):
            return wp.array(np.ascontiguousarray(values), dtype=kind, device=device)

        c.slot_begin = put(np.append(0, np.cumsum(slots)).astype(np.int32), wp.int32)
        c.other, c.tensor = put(others.reshape(-1), wp.int32), put(tensors.reshape(-1), dtype)
        c.chunk, c.body = put(np.array(chunks, np.int32), wp.vec4i), put(np.array(body, np.int32), wp.int32)
        identity = np.broadcast_to([0.0, 0.0, 0.0, 1.0], (len(bodies), 4))
        c.rotation = put(identity, wp.types.quaternion(dtype))
        ends = self.rows + CHUNK * np.bincount(body, minlength=len(bodies))
        c.rows = put(np.stack([self.rows, ends], axis=1).astype(np.int32), wp.vec2i)
        c.place = put(np.concatenate(places, axis=1), dtype)
        c.matrix = put(np.concatenate([coupling.common.ravel() for _, coupling in bodies]), dtype)
        c.hardening = put([coupling.hardening for _, coupling in bodies], dtype)
        c.common = wp.zeros(COMMON * len(bodies), dtype=dtype, device=device)
        c.turned = wp.zeros((3, CHUNK * len(chunks)), dtype=dtype, device=device)
        c.hardness = wp.zeros(CHUNK * len(chunks), dtype=dtype, device=device)
        world = np.searchsorted(worlds[:, 0], [first for first, *_ in chunks], side="right") - 1
        c.world = put(worlds[world].astype(np.int32), wp.vec2i)
        return left

    def start(self):
        """Begin a solve where the moments are now."""
        self._start.launch()

    def launch(self):
        """Add to the field what the couplings make of the moments."""
        for one in self._launches:
            one.launch()

    def launch_others(self):
        """The same, save for whole bodies."""
        for one in self._others:
            one.launch()
