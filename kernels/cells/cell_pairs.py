"""Corrections of the field and of forces between near cells of different bodies, and their launches.

The sums over pairs treat a cell as a ball, which is wrong for neighbors: a flat cell's ball reaches through a sheet. So
cells that are near each other act on each other as boxes, at the present poses of their bodies (``cell_pairs.h``). The
candidates are found by the neighbor search of ``pairs.neighbors``. The tensor of a pair is kept while the relative pose
of its bodies rests.

The operator of induction is positive for disjoint bodies: it is the exact one, integrated by Gauss points. For bodies
that intersect the points can make it negative. So a cell inside another body gets an additional demagnetizing factor.
"""

import math
from functools import cache

import numpy as np
import warp as wp

from warpmag.kernels.pairs import neighbors
from warpmag.kernels.pairs.wrench import MU0
from warpmag.kernels.shared.native import CHUNK, PASS_ARGUMENTS, native_kernel
from warpmag.kernels.shared.reductions import group_threads
from warpmag.kernels.shared.team import launch_passes, threads_for

WINDOW = 2.5, 3.5
"""Distances at which boxes start to turn into balls and are balls, in means of their sizes: the longest side times the
root of its ratio to the shortest, less for small cells. Dipoles lack the quadrupole of flat
cells, and need more distance."""
_FLATTEST = 3.0
"""Largest ratio of sides that increases a size, that of whole cells at automatic spacing. Flatter cells are parts that
a surface cuts off, of little volume."""
CLOSE = 1.75, 2.25
"""Distances at which the average over close boxes turns into their quadrupoles, in means of their longest sides."""
HARDENING = 0.45
"""Demagnetizing factor added to a cell inside another body. Quadrature over intersecting boxes leaves eigenvalues of
-0.05."""
_LONGEST_LIST = 2048
"""Longest list of candidates. A face cell of a cube has 50 to 60, one in a stack of five sheets up to 500."""
_SHORTEST_LIST = 64
"""Shortest list of candidates."""
_SAMPLES = 32
"""Points whose neighbors are counted for the length of the lists."""
_MARGIN = 0.5
"""Part of half its size that a cell may move before candidates are searched again."""
LOCATE, CLEAR, SELECT, ARRANGE, ASSIGN, TABULATE, ADD_FIELD, ADD_FORCE = range(8)
"""The passes, in order; as in ``cell_pairs.h``."""
_TENSOR_ROWS, _POSE_ROWS = 6, 7
"""Numbers of a tensor and of a relative pose; as in ``cell_pairs.h``."""
_BINS = 256
"""Bins of rows by their numbers of candidates; as in ``cell_pairs.h``."""
_CELLS_PER_THREAD = 100
"""Fewest cells per thread of a CPU."""


@cache
def cell_pairs_type(dtype):
    """Return the struct of the arrays, for n moments, b bodies with cells, c of them, and rows with candidates."""
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
        candidate: wp.array2d[int]  # moments that are or may become near, shape [n, capacity]
        candidate_count: wp.array[int]  # their number, which may exceed the capacity, shape [n]
        found_at: wp.array[vec3]  # positions at the last search [m], shape [n]
        moved: wp.array[int]  # 1 if a cell has moved too far since then, shape [1]
        searching: wp.array[int]  # nonzero if the last search rebuilt the lists, shape [1]
        rows: wp.array[int]  # number of rows, shape [1]
        bin: wp.array[int]  # bin of each moment by its numbers of candidates, −1 for no row, shape [n]
        bin_end: wp.array[int]  # end of each bin's rows, shape [BINS]
        cell: wp.array[int]  # cell of each row, shape [c padded]
        pose: wp.array[dtype]  # relative pose of each tensor, shape [c padded / CHUNK, capacity, 7, CHUNK], flat
        hardness: wp.array[
            dtype
        ]  # demagnetizing factor added where bodies intersect, over the volume [1/m³], shape [c padded]
        tensor: wp.array[dtype]  # T_ij [1/m³] in the frame of box i, shape [c padded / CHUNK, capacity, 6, CHUNK], flat

    return CellPairs


@cache
def _kernel(dtype, group: int):
    arguments = {**PASS_ARGUMENTS, "arrays": cell_pairs_type(dtype)}
    constants = dict(
        HARDENING=HARDENING,
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
        GROUP=group,
        **constants,
    )


def _volume_factors(half_sides) -> np.ndarray:
    """Return (V/V_max)^⅕ for half sides of the boxes of a body, shape [3, cells]: quadrupole fields fall as V/r⁵."""
    volumes = half_sides.prod(axis=0)
    return (volumes / volumes.max()) ** 0.2


def _list_length(bodies, group, reach: float) -> int:
    """Return the length of lists for candidates up to ``reach`` [m]: all bodies of a world around a cell, or a solid.

    Bodies that intersect can have more candidates.
    """
    near = {id(coupling): _most_near(coupling.positions, reach) for _, coupling in bodies}
    counts = np.zeros(group.max() + 1)
    np.add.at(counts, [group[first] for first, _ in bodies], [near[id(coupling)] for _, coupling in bodies])
    solid = (
        4.0
        / 3.0
        * np.pi
        * reach**3
        / np.mean([np.prod(2.0 * coupling.half_sides, axis=1).max() for _, coupling in bodies])
    )
    needed = np.clip(min(counts.max(), solid), _SHORTEST_LIST, _LONGEST_LIST)
    return 2 ** math.ceil(math.log2(needed))  # the search is compiled for each length


def _most_near(points: np.ndarray, reach: float) -> int:
    """Return the largest number of points within ``reach`` [m] of one of :data:`_SAMPLES` points."""
    samples = points[:: -(-len(points) // _SAMPLES)]
    middle = points[[np.argmin(np.linalg.norm(points - points.mean(axis=0), axis=1))]]
    distances = np.linalg.norm(np.concatenate([middle, samples])[:, None] - points, axis=2)
    return int((distances <= reach).sum(axis=1).max())


def _large_zeros(size: int, dtype, device) -> wp.array:
    """Return zeros that take memory on a CPU only where they are written: most rows of many bodies never are."""
    if device.is_cuda:
        return wp.zeros(size, dtype=dtype, device=device)
    line = 64  # bytes of a cache line
    values = np.zeros(size + line, wp.dtype_to_numpy(dtype))
    begin = -values.ctypes.data % line // values.itemsize
    return wp.array(values[begin : begin + size], dtype=dtype, device=device, copy=False)


class CellPairs:
    """Corrections between cells of different bodies, evaluated repeatedly in the same arrays.

    Args:
        bodies: First moment and coupling of each body. A coupling has ``half_sides`` and ``grid_rotation`` of its cells
            (``warpmag.shapes.demagnetization``).
        takes_part: False for bodies whose near field has a closed form, shape [bodies].
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

    def __init__(self, bodies, takes_part, rotations, worlds, movable, packed, moments, h, forces, torques):
        """Lay out the arrays on the device of the moments."""
        dtype, device, n = packed.dtype, packed.device, packed.count
        group, body, half = np.full(n, -1), np.zeros(n, int), np.ones((4, n))
        for number, (first, coupling) in enumerate(bodies):
            if not takes_part[number]:
                continue
            cells = slice(first, first + len(coupling.radii))
            sides = coupling.half_sides.T
            group[cells], body[cells], half[:3, cells] = worlds[cells], number, sides
            most, least = sides.max(axis=0), sides.min(axis=0)
            half[3, cells] = 2.0 * most * np.sqrt(np.minimum(most / least, _FLATTEST)) * _volume_factors(sides)
        ratio, reach = WINDOW[1] + _MARGIN, float(half[3, group >= 0].max())
        capacity = _list_length([body for body in bodies if group[body[0]] >= 0], group, ratio * reach)
        padded = -(-int((group >= 0).sum()) // CHUNK) * CHUNK

        def put(values, kind=wp.int32):
            return wp.array(np.ascontiguousarray(values), dtype=kind, device=device)

        def zeros(*shape, kind=wp.int32):
            return wp.zeros(shape, dtype=kind, device=device)

        self._lists = lists = neighbors.allocate(
            n, packed.packed, put(group), reach=reach, ratio=ratio, capacity=capacity,
            radii=put(0.5 * half[3], dtype), bodies=body,
        )  # fmt: skip
        self._pairs = a = cell_pairs_type(dtype)()
        quaternion = wp.types.quaternion(dtype)
        a.group, a.body, a.half, a.movable = put(group), put(body), put(half, dtype), put(movable)
        a.grid, a.rotation = put([coupling.grid_rotation for _, coupling in bodies], quaternion), rotations
        a.packed, a.moments, a.h, a.forces, a.torques = packed.packed, moments, h, forces, torques
        a.candidate, a.candidate_count, a.found_at = lists.neighbor, lists.count, lists.found_at
        a.moved, a.searching, a.frame = lists.moved, lists.searching, zeros(len(bodies), kind=quaternion)
        self.crowded = a.crowded = zeros(1)
        a.rows, a.bin, a.bin_end = zeros(1), zeros(n), zeros(_BINS)
        a.cell, a.hardness = zeros(padded), zeros(padded, kind=dtype)
        a.pose = _large_zeros(padded * capacity * _POSE_ROWS, dtype, device)
        a.tensor = _large_zeros(padded * capacity * _TENSOR_ROWS, dtype, device)
        self._locate, self._tabulate = self._record(LOCATE, LOCATE), self._record(CLEAR, TABULATE)
        self._field, self._force = self._record(ADD_FIELD, ADD_FIELD), self._record(ADD_FORCE, ADD_FORCE)

    def _record(self, first: int, last: int) -> list:
        """Return launches of passes ``first`` to ``last``: one on a CPU, one each on a GPU."""
        pairs, device = self._pairs, self._pairs.h.device
        group, rows = group_threads(device), max(pairs.cell.shape[0], pairs.group.shape[0], _BINS)
        kernel = _kernel(pairs.packed.dtype, group)
        sizes = dict(threads=threads_for(rows, _CELLS_PER_THREAD), gpu_threads=group * rows)
        ranges = [(k, k + 1) for k in range(first, last + 1)] if device.is_cuda else [(first, last + 1)]
        return [launch_passes(kernel, *ends, pairs, device=device, record_cmd=True, **sizes) for ends in ranges]

    def request_search(self, chosen):
        """Search again, and compute all tensors again, in the next :meth:`find` if any entry of ``chosen`` is not 0."""
        neighbors.launch_request_search(self._lists, chosen)

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
        """Return the arrays that the next search and the next evaluation read, by name."""
        kept = ("rows", "cell", "pose", "tensor", "hardness", "crowded")
        return neighbors.persistent_lists(self._lists) | {name: getattr(self._pairs, name) for name in kept}
