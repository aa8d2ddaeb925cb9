"""Cells of each body: the differences of their halves, corrections of the field between them, and the launches.

A table belongs to a shape and serves all bodies of that shape. It has a list of entries for each cell. Chunks of
``native.CHUNK`` cells are stored side by side, with as many slots as the longest list of the chunk.
:func:`couplings_type` has the arrays.
"""

from functools import cache

import numpy as np
import warp as wp

from warpmag.kernels.shared.native import CHUNK, PASS_ARGUMENTS, native_kernel
from warpmag.kernels.shared.pieces import cut
from warpmag.kernels.shared.reductions import group_threads, most_blocks
from warpmag.kernels.shared.team import launch_passes, threads_for

DIFFERENCES, UNIFORM_FIELD, TRANSPOSE, ADD = range(4)  # the passes, in order; as in ``couplings.h``
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
        tensor: wp.array[dtype]  # T_ij [1/m³], row after row, of CHUNK cells per slot; zero after a list's end
        side: wp.array2d[int]  # neighbor of each cell on the sides −x, +x, −y, ..., or the cell, shape [6, rows]
        weight: wp.array2d[dtype]  # weights in differences: of the cell's moment, of the neighbors', shape [12, rows]
        layer: wp.array2d[dtype]  # factors of differences across layers (``shared/layer.h``), shape [3, rows]
        has_layers: int  # 1 if any of these factors is not 0
        has_slopes: int  # 1 if any weight is not 0
        # Model: bodies
        chunk: wp.array[wp.vec4i]  # first moment, count, first row of the body, first row of its table, shape [chunks]
        active: wp.array[int]  # on a GPU the number of chunks that are summed, then these; None for all
        body: wp.array[int]  # body of a chunk, shape [chunks]
        rows: wp.array[wp.vec2i]  # range of rows of each body, shape [bodies]
        matrix: wp.array[dtype]  # C from the moment of a body to the field that its cells share [1/m³], [bodies · 9]
        grid: wp.array[quaternion]  # from the frame of the tensors to the body's (x, y, z, w), shape [bodies]
        # Data in:
        rotation: wp.array[quaternion]  # from each body's frame to the world (x, y, z, w), shape [bodies]
        moments: wp.array[vec3]  # [A·m²], consecutive for a body, shape [n]
        # Data out:
        body_moments: wp.array2d[dtype]  # moments in the frames of their bodies, shape [3, chunks · CHUNK]
        fields: wp.array2d[dtype]  # fields of differences, frame of the tensors, shape [3, chunks · CHUNK]
        common: wp.array[dtype]  # field that the cells of a body share, frame of the tensors [A/m], shape [bodies · 3]
        means: wp.array[vec3]  # moments of cells in the frame of the tensors [A·m²], shape [n]
        differences: wp.array[vec3]  # half the differences of the halves of cells, like ``means``
        difference_field: wp.array[vec3]  # half the difference of the fields of the halves, like ``means`` [A/m]
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
    tensors = np.zeros((int(slots.sum()), 9, CHUNK))
    others[slot, cell % CHUNK] = other
    tensors[slot, :, cell % CHUNK] = tensor
    return slots, others, tensors


def padded_vectors(count: int, dtype, device) -> wp.array:
    """Return zero vectors in memory that has one vector more, because reading four numbers at a time is faster."""
    return wp.zeros(count + 1, dtype=dtype, device=device)[:count]


@cache
def _kernel(dtype, group: int):
    call = "add_couplings(thread, first, last, threads, team.data, arrays)"
    arguments = {**PASS_ARGUMENTS, "arrays": couplings_type(dtype)}
    return native_kernel(call, "cells/couplings.h", arguments, dtype=dtype, GROUP=group)


class CellCouplings:
    """Cells of a set of bodies, evaluated repeatedly in the same arrays.

    Args:
        bodies: First moment and coupling of each body (``warpmag.shapes.demagnetization``). Bodies with the same
            coupling object share its table.
        moments: Moments [A·m²], Warp array, shape [n].
        h: Field to add to [A/m], Warp array, shape [n].
        paired: True if the caller calls :meth:`write_differences` before :meth:`launch`, and adds to
            ``difference_field`` between.

    Attributes:
        rotations: Rotation from each body's frame to the world, shape [bodies]; written by the caller.
        means, differences: Moments of cells and half the differences of their halves, in the frames of their grids
            [A·m²], shape [n]; written by :meth:`write_differences`.
        difference_field: Field of the differences by other bodies, in the frames of the grids [A/m], shape [n].
            :meth:`write_differences` clears it, and the caller adds to it.
        entries: Pairs of cells per evaluation.
        chunks: First moment, count, first row of the body and first row of its table of each chunk of cells.
    """

    def __init__(self, bodies, moments, h, *, paired=False):
        """Lay out the tables on the device of the moments."""
        dtype = h.dtype._wp_scalar_type_
        self._couplings = c = couplings_type(dtype)()
        c.moments, c.h = moments, h
        self._lay_out(bodies, dtype, h.device)
        self.chunks = c.chunk
        c.difference_field = wp.zeros_like(moments)
        c.means, c.differences = (padded_vectors(len(moments), moments.dtype, h.device) for _ in range(2))
        self.means, self.differences = c.means, c.differences
        self.difference_field = c.difference_field
        self.rotations, self.entries = c.rotation, sum(len(coupling.other) for _, coupling in bodies)
        has_matrix, has_slopes = bool(c.matrix.numpy().any()), bool(c.has_slopes)
        needed = {DIFFERENCES: not paired, UNIFORM_FIELD: has_matrix, TRANSPOSE: has_slopes, ADD: True}
        self._passes = [number for number, is_needed in needed.items() if is_needed]
        self._record_all()

    def _record_all(self):
        c = self._couplings
        self._write_differences = self._record(c, DIFFERENCES, DIFFERENCES)
        ranges = [(k, k) for k in self._passes] if c.h.device.is_cuda else [(self._passes[0], ADD)]
        self._launches = [self._record(c, *ends) for ends in ranges]

    def sum_active(self, list_active):
        """Leave out the chunks of resting worlds in all later sums, on a GPU.

        ``list_active`` takes the array ``chunk`` and returns a Warp array: the number of active chunks, then indices.
        """
        self._couplings.active = list_active(self._couplings.chunk)
        self._record_all()

    @staticmethod
    def _record(couplings, first: int, last: int):
        device, rows = couplings.h.device, CHUNK * couplings.chunk.shape[0]
        group = group_threads(device, moments=rows)
        sizes = dict(threads=threads_for(rows, _CELLS_PER_THREAD), gpu_threads=group * rows)
        sizes["max_blocks"] = most_blocks(device) if couplings.active else 0
        kernel = _kernel(couplings.tensor.dtype, group)
        return launch_passes(kernel, first, last + 1, couplings, device=device, record_cmd=True, **sizes)

    def _lay_out(self, bodies, dtype, device):
        """Fill the arrays."""
        c, first_rows, tables, sides, weights, layers = self._couplings, {}, [], [], [], []
        for _, coupling in bodies:
            if id(coupling) not in first_rows:
                first_rows[id(coupling)] = CHUNK * sum(len(slots) for slots, _, _ in tables)
                tables.append(_table(coupling.start, coupling.other, coupling.grid_tensor.reshape(-1, 9)))
                values = coupling.neighbor, coupling.weights, coupling.layer
                padding = (0, 0), (0, -len(coupling.radii) % CHUNK)
                for parts, value in zip((sides, weights, layers), values, strict=True):
                    parts.append(np.pad(value.T, padding))
        first = np.array([first for first, _ in bodies])
        body, begin, end = cut(first, first + [len(coupling.radii) for _, coupling in bodies], CHUNK)
        first_row = CHUNK * np.searchsorted(body, np.arange(len(bodies) + 1))
        table_row = np.array([first_rows[id(coupling)] for _, coupling in bodies])
        chunks = np.stack([begin, end - begin, first_row[body], table_row[body]], axis=1)
        slots, others, tensors = (np.concatenate(parts) for parts in zip(*tables, strict=True))

        def put(values, kind):
            return wp.array(np.ascontiguousarray(values), dtype=kind, device=device)

        c.slot_begin = put(np.append(0, np.cumsum(slots)).astype(np.int32), wp.int32)
        c.other, c.tensor = put(others.reshape(-1), wp.int32), put(tensors.reshape(-1), dtype)
        c.chunk, c.body = put(chunks.astype(np.int32), wp.vec4i), put(body.astype(np.int32), wp.int32)
        identity = np.broadcast_to([0.0, 0.0, 0.0, 1.0], (len(bodies), 4))
        c.rotation = put(identity, wp.types.quaternion(dtype))
        c.grid = put([coupling.grid_rotation for _, coupling in bodies], wp.types.quaternion(dtype))
        c.rows = put(np.stack([first_row[:-1], first_row[1:]], axis=1).astype(np.int32), wp.vec2i)
        c.matrix = put(np.concatenate([coupling.grid_common.ravel() for _, coupling in bodies]), dtype)
        c.common = wp.zeros(3 * len(bodies), dtype=dtype, device=device)
        c.side, c.weight = put(np.concatenate(sides, axis=1), wp.int32), put(np.concatenate(weights, axis=1), dtype)
        c.layer, c.has_layers = put(np.concatenate(layers, axis=1), dtype), int(any(part.any() for part in layers))
        c.has_slopes = int(any(part.any() for part in weights))
        c.body_moments = wp.zeros((3, CHUNK * len(chunks)), dtype=dtype, device=device)
        c.fields = wp.zeros((3, CHUNK * len(chunks)), dtype=dtype, device=device)

    def write_differences(self):
        """Launch the half differences of the cells."""
        self._write_differences.launch()

    def launch(self):
        """Add the corrections to the field."""
        for launch in self._launches:
            launch.launch()
