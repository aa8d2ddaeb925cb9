"""Corrections of the field between the cells of each body, and their launches.

A table belongs to a shape and serves all bodies of that shape. It has a list of entries for each cell. Chunks of
``native.CHUNK`` cells are stored side by side, with as many slots as the longest list of the chunk.
:func:`couplings_type` has the arrays.
"""

from functools import cache

import numpy as np
import warp as wp

from warpmag.kernels.shared.native import CHUNK, PASS_ARGUMENTS, native_kernel
from warpmag.kernels.shared.reductions import group_threads, most_blocks
from warpmag.kernels.shared.team import launch_passes, threads_for

COMMON = 8  # low-order fields that all cells of a body share: three uniform and five linear ones; as in ``couplings.h``
TURN, SHARE, ADD = range(3)  # the passes, in order; as in ``couplings.h``
_CELLS_PER_THREAD = 500  # cells per thread of a CPU, at least


@cache
def couplings_type(dtype):
    """Struct of tables, bodies and buffers."""
    vec3, quaternion = wp.types.vector(3, dtype), wp.types.quaternion(dtype)

    @wp.struct
    class Couplings:
        # Model: tables of shapes
        slot_begin: wp.array[int]  # first slot of each chunk of all tables, and the end
        other: wp.array[int]  # cell of the body that an entry refers to, shape [slots · CHUNK]
        tensor: wp.array[dtype]  # T_ij [1/m³]: xx, yy, zz, xy, xz, yz of CHUNK cells per slot; zero after a list's end
        position: wp.array2d[dtype]  # positions of cells for the low-order fields of their body, shape [3, rows]
        # Model: bodies
        chunk: wp.array[wp.vec4i]  # first moment, count, first row of the body, first row of its table, shape [chunks]
        active: wp.array[int]  # on a GPU the number of chunks that are summed, then these; None for all
        body: wp.array[int]  # body of a chunk, shape [chunks]
        rows: wp.array[wp.vec2i]  # range of rows of each body, shape [bodies]
        matrix: wp.array[dtype]  # COMMON × COMMON matrix from moments to low-order coefficients [1/m³], per body
        # Data in:
        rotation: wp.array[quaternion]  # from each body's frame to the world (x, y, z, w), shape [bodies]
        moments: wp.array[vec3]  # [A·m²], consecutive for a body, shape [n]
        # Data out:
        body_moments: wp.array2d[dtype]  # moments in the frames of their bodies, shape [3, chunks · CHUNK]
        common: wp.array[dtype]  # low-order coefficients in the frame of the body [A/m], COMMON per body
        h: wp.array[vec3]  # field to which corrections are added [A/m], shape [n]

    return Couplings


def _table(start, other, tensor):
    """Return the number of slots of each chunk of a table, and the entries: cells and tensors."""
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
    return native_kernel(call, "cells/couplings.h", arguments, dtype=dtype, GROUP=group)


class CellCouplings:
    """Corrections that a set of bodies adds to a field, evaluated repeatedly in the same arrays.

    Args:
        bodies: First moment and coupling of each body. A coupling has ``start``, ``other`` and ``tensor``, the list of
            each cell, ``scaled_positions`` and ``common`` (``warpmag.shapes.demagnetization``). Bodies with the same
            coupling object share its table.
        moments: Moments [A·m²], Warp array, shape [n].
        h: Field to add to [A/m], Warp array, shape [n].
        collective: True for bodies with a collective response (``induction``), which :meth:`launch_others` leaves out,
            shape [bodies]; None means no such body.

    Attributes:
        rotations: Rotation from each body's frame to the world, shape [bodies]; written by the caller.
        entries: Pairs of cells per evaluation.
        chunks: First moment, count, first row of the body and first row of its table of each chunk of cells.
    """

    def __init__(self, bodies, moments, h, collective=None):
        """Lay out the tables on the device of the moments."""
        dtype = h.dtype._wp_scalar_type_
        self._couplings = c = couplings_type(dtype)()
        c.moments, c.h = moments, h
        other_chunks = self._lay_out(bodies, collective, dtype, h.device)
        self.chunks = c.chunk
        self.rotations, self.entries = c.rotation, sum(len(coupling.other) for _, coupling in bodies)
        self._part = None
        if other_chunks:
            self._part = part = couplings_type(dtype)()
            for name in couplings_type(dtype).vars:
                setattr(part, name, getattr(c, name))
            part.chunk = c.chunk[:other_chunks]
        self._record_all()

    def _record_all(self):
        self._launches = self._record_field(self._couplings)
        self._others = [] if self._part is None else self._record_field(self._part)

    def sum_active(self, list_active):
        """Sum only chunks of worlds that do not rest from now on, on a GPU.

        ``list_active`` returns for chunks, a Warp array, their list on the device: a number, then indices.
        """
        for couplings in filter(None, (self._couplings, self._part)):
            couplings.active = list_active(couplings.chunk)
        self._record_all()

    def _record_field(self, couplings):
        on_gpu = couplings.h.device.is_cuda
        ranges = [(number, number) for number in (TURN, SHARE, ADD)] if on_gpu else [(TURN, ADD)]
        return [self._record(couplings, first, last) for first, last in ranges]

    @staticmethod
    def _record(couplings, first: int, last: int):
        device, rows = couplings.h.device, CHUNK * couplings.chunk.shape[0]
        group = group_threads(device)
        sizes = dict(threads=threads_for(rows, _CELLS_PER_THREAD), gpu_threads=group * rows)
        sizes["max_blocks"] = most_blocks(device) if couplings.active else 0
        kernel = _kernel(couplings.tensor.dtype, group)
        return launch_passes(kernel, first, last + 1, couplings, device=device, record_cmd=True, **sizes)

    def _lay_out(self, bodies, collective, dtype, device) -> int:
        """Fill the arrays; return the number of chunks of bodies without a collective response, which come first."""
        c, first_rows, tables, positions, chunks, body, other_chunks = self._couplings, {}, [], [], [], [], 0
        first_row = np.zeros(len(bodies), int)
        collective = np.zeros(len(bodies), bool) if collective is None else np.asarray(collective, bool)
        for number in np.argsort(collective, kind="stable").tolist():
            first, coupling = bodies[number]
            if id(coupling) not in first_rows:
                first_rows[id(coupling)] = CHUNK * sum(len(slots) for slots, _, _ in tables)
                tables.append(_table(coupling.start, coupling.other, coupling.tensor))
                scaled = coupling.scaled_positions
                positions.append(np.pad(scaled.T, ((0, 0), (0, -len(scaled) % CHUNK))))
            count, row = len(coupling.start) - 1, CHUNK * len(chunks)
            first_row[number] = row
            starts = range(0, count, CHUNK)
            chunks += [(first + k, min(CHUNK, count - k), row, first_rows[id(coupling)]) for k in starts]
            body += [number] * len(starts)
            other_chunks += 0 if collective[number] else len(starts)
        slots, others, tensors = (np.concatenate(parts) for parts in zip(*tables, strict=True))

        def put(values, kind):
            return wp.array(np.ascontiguousarray(values), dtype=kind, device=device)

        c.slot_begin = put(np.append(0, np.cumsum(slots)).astype(np.int32), wp.int32)
        c.other, c.tensor = put(others.reshape(-1), wp.int32), put(tensors.reshape(-1), dtype)
        c.chunk, c.body = put(np.array(chunks, np.int32), wp.vec4i), put(np.array(body, np.int32), wp.int32)
        identity = np.broadcast_to([0.0, 0.0, 0.0, 1.0], (len(bodies), 4))
        c.rotation = put(identity, wp.types.quaternion(dtype))
        ends = first_row + CHUNK * np.bincount(body, minlength=len(bodies))
        c.rows = put(np.stack([first_row, ends], axis=1).astype(np.int32), wp.vec2i)
        c.position = put(np.concatenate(positions, axis=1), dtype)
        c.matrix = put(np.concatenate([coupling.common.ravel() for _, coupling in bodies]), dtype)
        c.common = wp.zeros(COMMON * len(bodies), dtype=dtype, device=device)
        c.body_moments = wp.zeros((3, CHUNK * len(chunks)), dtype=dtype, device=device)
        return other_chunks

    def launch(self):
        """Add the corrections to the field."""
        for launch in self._launches:
            launch.launch()

    def launch_others(self):
        """Add the corrections of bodies without a collective response to the field."""
        for launch in self._others:
            launch.launch()
