"""Corrections of the field and of forces between near cells of different bodies, and their launches.

The sums over pairs treat a cell as a ball, which is wrong for neighbors: a flat cell's ball reaches through a sheet. So
cells that are near each other act on each other as boxes, at the present poses of their bodies (``cell_pairs.h``). The
candidates are found by the neighbor search of ``pairs.neighbors``. The tensor of a pair is kept while the relative pose
of its bodies rests.

Bodies do not overlap, so that the operator of induction is positive: it is the exact one, integrated by Gauss points.
Bodies that intersect make it slightly negative. The demagnetizing factor of cells that overlap other bodies therefore
grows (``couplings.py``).
"""

from functools import cache

import numpy as np
import warp as wp

from warpmag.kernels.pairs import neighbors
from warpmag.kernels.pairs.wrench import MU0
from warpmag.kernels.shared.native import CHUNK, PASS_ARGUMENTS, native_kernel
from warpmag.kernels.shared.reductions import group_threads
from warpmag.kernels.shared.team import team, threads_for

WINDOW = 2.5, 3.5
"""Distances at which boxes start to turn into balls and are balls, in means of their sizes: the longest side times the
root of its ratio to the shortest. Dipoles lack the quadrupole of flat cells, and need more distance."""
CLOSE = 1.75, 2.25
"""Distances at which the average over close boxes turns into the field at their centers, in the same unit."""
CLOSE_POINTS = 2
"""Gauss points of close boxes along each axis."""
HARDENING = 0.3
"""Demagnetizing factor added to a cell inside another body. Quadrature over intersecting boxes leaves eigenvalues of
-0.05."""
CAPACITY = 384
"""Longest list of candidates. A face cell of a cube has 50 to 60, a cell inside another body 110, and one in a stack of
five sheets up to 150. Cells with more take no part."""
_MARGIN = 0.15
"""Fraction of its radius that a cell may move before candidates are searched again."""
LOCATE, CLEAR, SELECT, TABULATE, ADD_FIELD, ADD_FORCE = range(6)
"""The passes, in order; as in ``cell_pairs.h``."""
_TENSOR_ROWS, _POSE_ROWS = 6, 7
"""Numbers of a tensor and of a relative pose; as in ``cell_pairs.h``."""
_CELLS_PER_THREAD = 100
"""Fewest cells per thread of a CPU."""


@cache
def cell_pairs_type(dtype):
    """Return the struct of the arrays, for n moments, b bodies with cells, and rows of cells with candidates."""
    vec3, quaternion = wp.types.vector(3, dtype), wp.types.quaternion(dtype)

    @wp.struct
    class CellPairs:
        # Model:
        group: wp.array[int]  # world of each moment, −1 for moments without a cell, shape [n]
        body: wp.array[int]  # index of the body of each cell, shape [n]
        half: wp.array2d[dtype]  # half sides of the boxes in the frame of the body's grid, and sizes [m], shape [4, n]
        grid: wp.array[quaternion]  # from the frame of each body's grid to that of the body, shape [b]
        movable: wp.array[int]  # 1 where the force is evaluated, shape [n]
        # Data in:
        rotation: wp.array[quaternion]  # from each body's frame to the world, shape [b]
        packed: wp.array2d[dtype]  # packed moments (``packing.PackedMoments``)
        moments: wp.array[vec3]  # [A·m²], shape [n]
        # Data out:
        h: wp.array[vec3]  # field to which corrections are added [A/m], shape [n]
        forces: wp.array[vec3]  # [N], shape [n]
        torques: wp.array[vec3]  # about the moments' positions [N·m], shape [n]
        crowded: wp.array[int]  # 1 if a cell had more candidates than its list holds, shape [1]
        # Work:
        frame: wp.array[quaternion]  # from the frame of each body's grid to the world, shape [b]
        candidate: wp.array2d[int]  # moments that are or may become near, shape [n, CAPACITY]
        candidate_count: wp.array[int]  # their number, which may exceed the capacity, shape [n]
        found_at: wp.array[vec3]  # positions at the last search [m], shape [n]
        moved: wp.array[int]  # 1 if a cell has moved too far since then, shape [1]
        searching: wp.array[int]  # nonzero if the last search rebuilt the lists, shape [1]
        rows: wp.array[int]  # number of rows, shape [1]
        cell: wp.array[int]  # cell of each row, shape [padded]
        pose: wp.array[dtype]  # relative pose of each tensor, shape [padded / CHUNK, CAPACITY, 7, CHUNK], flat
        hardness: wp.array[dtype]  # demagnetizing factor added where bodies intersect, over the volume [1/m³], [padded]
        tensor: wp.array[dtype]  # T_ij [1/m³] in the frame of box i, shape [padded / CHUNK, CAPACITY, 6, CHUNK], flat

    return CellPairs


@cache
def _kernel(dtype, group: int):
    arguments = {**PASS_ARGUMENTS, "arrays": cell_pairs_type(dtype)}
    constants = dict(
        HARDENING=HARDENING,
        CLOSE_POINTS=CLOSE_POINTS,
        CLOSE_BEGIN=CLOSE[0],
        CLOSE_END=CLOSE[1],
        WINDOW_BEGIN=WINDOW[0],
        WINDOW_END=WINDOW[1],
        MARGIN=_MARGIN,
        MU0=MU0,
    )
    return native_kernel(
        "add_cell_pairs(thread, first, last, threads, team.data, arrays)",
        "cells/cell_pairs.h",
        arguments,
        dtype=dtype,
        CAPACITY=CAPACITY,
        GROUP=group,
        **constants,
    )


class CellPairs:
    """Corrections between cells of different bodies, evaluated repeatedly in the same arrays.

    Args:
        bodies: First moment and coupling of each body. A coupling has ``half_sides`` and ``grid_rotation`` of its cells
            (``warpmag.shapes.demagnetization``).
        rotations: Rotation from each body's frame to the world, Warp array, shape [bodies].
        worlds: World of each moment, shape [n].
        movable: True for moments whose force is evaluated, shape [n].
        packed: All moments, packed (``packing.PackedMoments``).
        moments: Moments [A·m²], Warp array, shape [n].
        h: Field to add to [A/m], Warp array, shape [n].
        forces, torques: Forces [N] and torques [N·m] to add to, Warp arrays, shape [n].

    Attributes:
        crowded: 1 if a cell had more candidates than a list holds and took no part, Warp array, shape [1].
    """

    def __init__(self, bodies, rotations, worlds, movable, packed, moments, h, forces, torques):
        """Lay out the arrays on the device of the moments."""
        dtype, device, n = packed.dtype, packed.device, packed.count
        padded = -(-n // CHUNK) * CHUNK
        group, body, half = np.full(n, -1), np.zeros(n, int), np.ones((4, n))
        for number, (first, coupling) in enumerate(bodies):
            cells = slice(first, first + len(coupling.radii))
            sides = coupling.half_sides.T
            group[cells], body[cells], half[:3, cells] = worlds[cells], number, sides
            half[3, cells] = 2.0 * sides.max(axis=0) ** 1.5 / np.sqrt(sides.min(axis=0))
        radii = packed.radii.numpy()
        ratio = WINDOW[1] * float((0.5 * half[3] / radii)[group >= 0].max()) + _MARGIN
        reach = 2.0 * float(radii[group >= 0].max())

        def put(values, kind=wp.int32):
            return wp.array(np.ascontiguousarray(values), dtype=kind, device=device)

        def zeros(*shape, kind=wp.int32):
            return wp.zeros(shape, dtype=kind, device=device)

        self._lists = lists = neighbors.allocate(
            n, packed.packed, put(group), reach=reach, ratio=ratio, capacity=CAPACITY, bodies=body
        )
        self._pairs = a = cell_pairs_type(dtype)()
        quaternion = wp.types.quaternion(dtype)
        a.group, a.body, a.half, a.movable = put(group), put(body), put(half, dtype), put(movable)
        a.grid, a.rotation = put([coupling.grid_rotation for _, coupling in bodies], quaternion), rotations
        a.packed, a.moments, a.h, a.forces, a.torques = packed.packed, moments, h, forces, torques
        a.candidate, a.candidate_count, a.found_at = lists.neighbor, lists.count, lists.found_at
        a.moved, a.searching, a.frame = lists.moved, lists.searching, zeros(len(bodies), kind=quaternion)
        self.crowded = a.crowded = zeros(1)
        a.rows, a.cell, a.hardness = zeros(1), zeros(padded), zeros(padded, kind=dtype)
        a.pose = zeros(padded * CAPACITY * _POSE_ROWS, kind=dtype)
        a.tensor = zeros(padded * CAPACITY * _TENSOR_ROWS, kind=dtype)
        self._locate, self._tabulate = self._record(LOCATE, LOCATE), self._record(CLEAR, TABULATE)
        self._field, self._force = self._record(ADD_FIELD, ADD_FIELD), self._record(ADD_FORCE, ADD_FORCE)

    def _record(self, first: int, last: int) -> list:
        """Return launches of passes ``first`` to ``last``: one on a CPU, one each on a GPU."""
        pairs, device = self._pairs, self._pairs.h.device
        group, rows = group_threads(device), pairs.cell.shape[0]
        passes = [(k, k + 1) for k in range(first, last + 1)] if device.is_cuda else [(first, last + 1)]
        return [
            wp.launch(
                _kernel(pairs.packed.dtype, group),
                dim=group * rows if device.is_cuda else 1,
                inputs=[begin, end, threads_for(rows, _CELLS_PER_THREAD), None if device.is_cuda else team(), pairs],
                device=device,
                record_cmd=True,
            )
            for begin, end in passes
        ]

    def find(self):
        """Launch the search for near cells, and compute the tensors of pairs that have moved."""
        for launch in self._locate:
            launch.launch()
        neighbors.launch_find_neighbors(self._lists, self._lists)
        for launch in self._tabulate:
            launch.launch()

    def add_field(self):
        """Add the corrections to the field."""
        for launch in self._field:
            launch.launch()

    def add_forces(self):
        """Add the corrections to forces and torques."""
        for launch in self._force:
            launch.launch()

    def persistent_arrays(self) -> dict[str, wp.array]:
        """Return the arrays that the next search reads, by name."""
        return neighbors.persistent_lists(self._lists)
