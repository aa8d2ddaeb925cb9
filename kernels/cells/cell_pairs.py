"""Corrections of the field and of forces between near cells of different bodies, and their launches.

The sums over pairs treat a cell as a ball, which is wrong for neighbors: a flat cell's ball reaches through a sheet. So
cells that are near each other act on each other as boxes, at the present poses of their bodies (``cell_pairs.h``). The
candidates are found by the neighbor search of ``pairs.neighbors``. The tensor of a pair is kept while the relative pose
of its bodies does not change. A close pair is computed once, for both cells (``cell_rows.h``). The field of a ball at a
cell is an average over the cell, and a difference between its halves.

The operator of induction is positive for disjoint bodies: it is the exact one, integrated by Gauss points. For bodies
that intersect the points can make it negative. So a cell inside another body gets an additional demagnetizing factor.
"""

import math
from collections.abc import Callable
from dataclasses import replace
from functools import cache, partial

import numpy as np
import warp as wp

from warpmag.kernels.pairs import neighbors
from warpmag.kernels.pairs.wrench import MU0
from warpmag.kernels.shared.launches import RecordedLaunches
from warpmag.kernels.shared.native import CHUNK, LINE, PASS_ARGUMENTS, native_kernel
from warpmag.kernels.shared.reductions import group_threads
from warpmag.kernels.shared.team import launch_passes, threads_for

WINDOW = 2.5, 3.5
"""Distances between which the law of boxes is blended into that of balls, in mean sizes of two boxes. The size of a box
is its longest side times the root of its ratio to the shortest side, less for small cells. Dipoles lack the quadrupole
of flat cells, and need more distance. Without :data:`_OF_SHEETS` the force between two discs of 40:2 mm has an error of
5 %, and 3 % with 4.5 and 6. But then up to five times as many cells are in the lists."""
_OF_SHEETS = 1.5
"""Factor of the sizes of linear cells in sheets of one or two layers. The fields of their cells almost cancel, but not
where the formulas change with the distance. Without the factor the operator of three sheets of 30 × 30 × 1 mm that lie
on each other would have an eigenvalue of -0.0014, and forces in stacks of discs would be 1 to 2 % larger. If the factor
applied to :data:`CLOSE` only, the eigenvalue would be -0.0002, and to :data:`WINDOW` only, -0.0013."""
_LARGEST_RATIO = 3.0
"""Largest ratio of sides that increases a size: the largest of whole cells at automatic spacing. Flatter boxes are
cells of little volume that the surface cuts."""
CLOSE = 1.75, 2.25
"""Distances between which the average over close boxes is blended into their quadrupoles, also in mean sizes. With
distances in mean longest sides, the operator of a stack of five sheets would have an eigenvalue of -0.0025."""
FINE = 1.2, 1.6
"""Distances between which 4 × 4 × 2 points of a flat box are blended into 2³, in mean longest sides. The demagnetizing
factor between touching boxes twice as wide as high is 7 % too large with 2³ points. Cells beside a touching one are
within 1.2 sides. The force between two discs of 40:2 mm has an error of 3 %. With 0.9 and 1.2 it is 9 %, with 2.1 and
2.6 it is 4 %. A pair with fine points takes four times as long as another close one."""
FLAT = 0.57
"""Ratio of the shortest side to the next one below which whole cells of a body are flat."""
OVERLAP_DEMAGNETIZATION = 0.45
"""Demagnetizing factor added to a cell inside another body. Quadrature over intersecting boxes leaves eigenvalues of
-0.13."""
OVERLAP = 0.02, 0.5
"""Shares of a cell's volume inside other bodies at which the added factor starts and is complete. Cells of bodies in
contact overlap less."""
OVERLAP_BODIES = 4
"""Number of bodies around a cell beyond which the added factor grows in proportion to it. Solves of 30 cones in nearly
one place take at most 29 evaluations, those of random heaps 23 in the median. If the factor grows beyond two bodies
they take 21 and 25, beyond one body 23 and 31. If it does not grow, the cones do not converge."""
_LONGEST_LIST = 2048
"""Longest list of candidates. A face cell of a cube has 50 to 60, one in a stack of five sheets up to 500."""
_LONGEST_CLOSE = 192
"""Largest number of close candidates of a cell whose differences act on other bodies."""
_BALL_REACH = 2.1
"""Half side of the box that represents a ball in :data:`WINDOW` and :data:`CLOSE`, in longest half sides of the cells
of its world. The average over cubic cells of equal size ends at distances of 2.7 to 3.5 sides."""
_MOST_BALLS = 400
"""Largest number of balls near a cell: those at least as wide as a cell, packed densely on one side."""
_SHORTEST_LIST = 64
"""Shortest list of candidates."""
_SAMPLES = 32
"""Points whose neighbors are counted for the length of the lists."""
_MARGIN = 0.5
"""Fraction of half its size that a cell may move before candidates are searched again."""
LOCATE, CLEAR, SELECT, ARRANGE, ASSIGN, LINK, TABULATE, COPY_BALLS, ADD_FIELD, ADD_FORCE, ADD_REACTION = range(11)
"""The passes, in order; as in ``cell_pairs.h``."""
_MATRIX_ROWS, _DETAIL_ROWS, _POSE_ROWS, _REACTION_ROWS = 9, 27, 7, 8
"""Numbers stored for a pair: matrix of means, matrices of differences, relative pose, and force and torque; as in
``cell_rows.h``."""
_KINDS = 10
"""Kinds of candidates; as in ``cell_rows.h``."""
_BINS = 256
"""Bins of rows by their numbers of candidates; as in ``cell_rows.h``."""
CELLS_PER_THREAD = 100
"""Fewest cells per thread of a CPU."""


@cache
def cell_pairs_type(dtype):
    """Return the struct of the arrays, for n moments, b bodies with cells, c of them, and rows with candidates."""
    vec3, quaternion = wp.types.vector(3, dtype), wp.types.quaternion(dtype)

    @wp.struct
    class CellPairs:
        # Model:
        group: wp.array[int]  # world of each moment that takes part, −1 for the others, shape [n]
        body: wp.array[int]  # index of the body of each cell, b for balls, shape [n]
        half: wp.array2d[dtype]  # half sides of the boxes in the frame of the body's grid, and sizes [m], shape [4, n]
        grid: wp.array[quaternion]  # from the frame of each body's grid to that of the body, shape [b]
        linear: wp.array[int]  # 1 for bodies of linear cells, 0 for balls, shape [b + 1]
        flat: wp.array[int]  # 1 for bodies of flat cells, 0 for balls, shape [b + 1]
        inducible: wp.array[int]  # 1 for inducible moments, shape [n]
        movable: wp.array[int]  # 1 where the force is evaluated, shape [n]
        rotatable: wp.array[int]  # 1 where the torque is evaluated, too, shape [n]
        # Data in:
        rotation: wp.array[quaternion]  # from each body's frame to the world, shape [b]
        packed: wp.array2d[dtype]  # packed moments (``packing.PackedMoments``)
        means: wp.array[vec3]  # mean moments of cells, frames of their grids, and of balls [A·m²], shape [n]
        differences: wp.array[vec3]  # half differences of the halves of cells, like ``means``
        # Data out:
        h: wp.array[vec3]  # field to which corrections are added [A/m], shape [n]
        difference_field: wp.array[vec3]  # half differences of the fields of halves, added to, frames of grids, [n]
        forces: wp.array[vec3]  # [N], shape [n]
        torques: wp.array[vec3]  # about the moments' positions [N·m], shape [n]
        crowded: wp.array[int]  # 1 if a cell had more candidates, or close ones, than its lists hold, shape [1]
        close_capacity: int  # close candidates of a cell with details; 0 if no body has linear cells
        # Work:
        box: wp.array[dtype]  # line of each moment, as in ``locate``, shape [16 n]
        candidate: wp.array2d[int]  # moments that are or may become near, shape [n, capacity]
        candidate_count: wp.array[int]  # their number, which may exceed the capacity, shape [n]
        found_at: wp.array[vec3]  # positions at the last search [m], shape [n]
        moved: wp.array[int]  # 1 if a cell has moved too far since then, shape [1]
        searching: wp.array[int]  # nonzero if the last search rebuilt the lists, shape [1]
        displaced: wp.array[int]  # 1 if a box has moved since the last call of ``find``, shape [1]
        rows: wp.array[int]  # number of rows, shape [1]
        bin: wp.array[int]  # bin of each moment by its numbers of candidates, −1 for no row, shape [n]
        bin_end: wp.array[int]  # end of each bin's rows, shape [BINS]
        kind_end: wp.array[int]  # end of each kind of candidates in the row of a moment, shape [n, KINDS], flat
        cell: wp.array[int]  # cell of each row, shape [c padded]
        row_of: wp.array[int]  # row of each moment that has one, shape [n]
        column: wp.array[int]  # candidates of each row, shape [c padded / CHUNK, capacity, CHUNK], flat
        other_slot: wp.array[int]  # slot of each owned pair in its other cell's row, or its owner, like ``column``
        near_end: wp.array[int]  # end of the slots in the window, of vectors of rows, shape [c padded]
        pose: wp.array[dtype]  # relative pose of each tensor, shape [c padded / CHUNK, capacity, 7, CHUNK], flat
        overlap_factor: wp.array[dtype]  # demagnetizing factor of overlaps over the volume [1/m³], shape [c padded]
        matrix: wp.array[dtype]  # T_ij of means [1/m³], shape [c padded / CHUNK, capacity, 9, CHUNK], flat
        detail: wp.array[dtype]  # T_ij of differences [1/m³], shape [c padded / CHUNK, close_capacity, 27, CHUNK]
        reaction: wp.array[dtype]  # force and torque/μ0 by the row of the other cell, shape [capacity, c padded, 8]

    return CellPairs


def pair_constants() -> dict[str, float]:
    """Return the constants of ``cell_pairs.h`` by name."""
    return dict(
        OVERLAP_DEMAGNETIZATION=OVERLAP_DEMAGNETIZATION,
        OVERLAP_BEGIN=OVERLAP[0],
        OVERLAP_END=OVERLAP[1],
        OVERLAP_BODIES=OVERLAP_BODIES,
        CLOSE_BEGIN=CLOSE[0],
        CLOSE_END=CLOSE[1],
        FINE_BEGIN=FINE[0],
        FINE_END=FINE[1],
        WINDOW_BEGIN=WINDOW[0],
        WINDOW_END=WINDOW[1],
        MARGIN=_MARGIN,
        MU0=MU0,
    )


@cache
def _kernel(dtype, group: int):
    arguments = {**PASS_ARGUMENTS, "arrays": cell_pairs_type(dtype)}
    call = "add_cell_pairs(thread, first, last, threads, team.data, arrays)"
    return native_kernel(call, "cells/cell_pairs.h", arguments, dtype=dtype, GROUP=group, **pair_constants())


def _volume_factors(half_sides) -> np.ndarray:
    """Return (V/V_max)^⅕ for half sides of the boxes of a body, shape [3, cells]: quadrupole fields fall as V/r⁵."""
    volumes = half_sides.prod(axis=0)
    return (volumes / volumes.max()) ** 0.2


def _has_flat_cells(half_sides) -> bool:
    """Return True if whole cells of a body are flat; ``half_sides`` have the shape [cells, 3]."""
    least, middle, _ = np.sort(half_sides[half_sides.prod(axis=1).argmax()])
    return bool(least < FLAT * middle)


def _balls_among_cells(balls, radii, worlds, group, half) -> np.ndarray:
    """Return the balls that are at least as wide as the longest cell of their world, and write their half sides."""
    longest = np.zeros(worlds.max() + 1)
    np.maximum.at(longest, worlds[group >= 0], half[:3, group >= 0].max(axis=0))
    near_balls = np.flatnonzero(balls & (longest[worlds] > 0.0) & (radii >= longest[worlds]))
    half[:3, near_balls] = _BALL_REACH * longest[worlds[near_balls]]
    half[3, near_balls] = 2.0 * half[0, near_balls]
    return near_balls


def _list_length(bodies, group, balls, reach: float) -> int:
    """Return the length of lists for candidates up to ``reach`` [m] of bodies that do not intersect.

    The bodies of a world fill a sphere of the radius ``reach``, those with the smallest cells first. ``balls`` are the
    indices of balls. Bodies that intersect can have more candidates.
    """
    near = {id(coupling): _most_near(coupling.positions, reach) for _, coupling in bodies}
    volumes = np.array([np.prod(2.0 * coupling.half_sides, axis=1).max() for _, coupling in bodies])
    worlds, most = group[[first for first, _ in bodies]], np.array([near[id(coupling)] for _, coupling in bodies])
    order = np.lexsort((volumes, worlds))
    volumes, worlds, most = volumes[order], worlds[order], most[order]
    before = np.cumsum(most * volumes) - most * volumes
    before -= before[np.searchsorted(worlds, worlds)]  # volume of the smaller cells of the same world
    room = 4.0 / 3.0 * np.pi * reach**3 - before
    counts = np.bincount(worlds, np.clip(room / volumes, 0.0, most), minlength=group.max() + 1)
    counts += np.minimum(np.bincount(group[balls], minlength=len(counts)), _MOST_BALLS)
    needed = np.clip(counts.max(), _SHORTEST_LIST, _LONGEST_LIST)
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
        cells: The cells of the bodies (``couplings.CellCouplings``).
        layout: Radii [m] and worlds of moments, ``single_balls``, which take part unless they are narrower than a cell,
            and ``permanent`` and ``movable``, True for moments that are (``warpmag.moments.layout.MomentLayout``).
        rotatable: Nonzero for moments whose torque is evaluated, Warp array, shape [n].
        packed: All moments, packed (``packing.PackedMoments``).
        h: Field to add to [A/m], Warp array, shape [n].
        forces, torques: Forces [N] and torques [N·m] to add to, Warp arrays, shape [n].

    Attributes:
        arrays: The struct of arrays (:func:`cell_pairs_type`).
        crowded: 1 if a cell had more candidates than a list holds and took no part, or more close ones than have
            details, so that its differences did not act on other bodies, Warp array, shape [1].
    """

    def __init__(self, bodies, takes_part, cells, layout, rotatable, packed, h, forces, torques):
        """Lay out the arrays on the device of the moments."""
        self._cells, self._model, worlds = cells, (bodies, takes_part, layout, rotatable), layout.worlds
        dtype, device, n = packed.dtype, packed.device, packed.count
        group, body, half = np.full(n, -1), np.zeros(n, int), np.ones((4, n))
        for number, (first, coupling) in enumerate(bodies):
            if not takes_part[number]:
                continue
            span = slice(first, first + len(coupling.radii))
            sides = coupling.half_sides.T
            group[span], body[span], half[:3, span] = worlds[span], number, sides
            most, least = sides.max(axis=0), sides.min(axis=0)
            half[3, span] = 2.0 * most * np.sqrt(np.minimum(most / least, _LARGEST_RATIO)) * _volume_factors(sides)
            half[3, span] *= _OF_SHEETS if coupling.is_sheet else 1.0
        near_balls = _balls_among_cells(layout.single_balls, layout.radii, worlds, group, half)
        group[near_balls], body[near_balls] = worlds[near_balls], len(bodies)
        ratio, reach = WINDOW[1] + _MARGIN, float(half[3, group >= 0].max())
        capacity = _list_length([body for body in bodies if group[body[0]] >= 0], group, near_balls, ratio * reach)
        padded = -(-int((group >= 0).sum()) // CHUNK) * CHUNK

        def put(values, kind=wp.int32):
            return wp.array(np.ascontiguousarray(values), dtype=kind, device=device)

        def zeros(*shape, kind=wp.int32):
            return wp.zeros(shape, dtype=kind, device=device)

        self._launch = RecordedLaunches()
        self._lists = lists = neighbors.allocate(
            n, packed.packed, put(group), reach=reach, ratio=ratio, capacity=capacity,
            radii=put(0.5 * half[3], dtype), bodies=body,
        )  # fmt: skip
        self.arrays = a = cell_pairs_type(dtype)()
        quaternion = wp.types.quaternion(dtype)
        a.group, a.body, a.half, a.movable = put(group), put(body), put(half, dtype), put(layout.movable)
        a.rotatable, a.inducible = rotatable, put(~layout.permanent)
        a.flat = put([*(_has_flat_cells(coupling.half_sides) for _, coupling in bodies), False])
        a.linear = put([*(coupling.slopes is not None for _, coupling in bodies), False])
        a.grid, a.rotation = put([coupling.grid_rotation for _, coupling in bodies], quaternion), cells.rotations
        a.packed, a.h, a.forces, a.torques = packed.packed, h, forces, torques
        a.means, a.differences, a.difference_field = cells.means, cells.differences, cells.difference_field
        a.candidate, a.candidate_count, a.found_at = lists.neighbor, lists.count, lists.found_at
        a.moved, a.searching, a.box = lists.moved, lists.searching, zeros(LINE * n, kind=dtype)
        self.crowded, a.kind_end, a.displaced = zeros(1), zeros(_KINDS * n), zeros(1)
        a.crowded = self.crowded
        a.rows, a.bin, a.bin_end, a.row_of = zeros(1), zeros(n), zeros(_BINS), zeros(n)
        a.cell, a.near_end, a.overlap_factor = zeros(padded), zeros(padded), zeros(padded, kind=dtype)
        a.pose = _large_zeros(padded * capacity * _POSE_ROWS, dtype, device)
        a.column, a.other_slot = (_large_zeros(padded * capacity, wp.int32, device) for _ in range(2))
        a.close_capacity = min(capacity, _LONGEST_CLOSE) if a.linear.numpy().any() else 0
        a.matrix = _large_zeros(padded * capacity * _MATRIX_ROWS, dtype, device)
        a.detail = _large_zeros(padded * a.close_capacity * _DETAIL_ROWS, dtype, device)
        a.reaction = _large_zeros(padded * capacity * _REACTION_ROWS, dtype, device)
        self._locate, self._tabulate = self._record(LOCATE, LOCATE), self._record(CLEAR, TABULATE)
        copy_balls = self._record(COPY_BALLS, COPY_BALLS) if len(near_balls) else []
        self._field = self._record(COPY_BALLS if copy_balls else ADD_FIELD, ADD_FIELD)
        self._force = [*copy_balls, *self._record(ADD_FORCE, ADD_REACTION)]

    def for_all_moments(self, cells, packed, h) -> "CellPairs":
        """Return pairs of the same model with lists and tensors of their own, for other moments.

        They add the field of the ``packed`` moments to ``h`` at all moments, also at permanent ones. They have no
        forces. ``cells`` are the ``CellCouplings`` of these moments.
        """
        bodies, takes_part, layout, rotatable = self._model
        layout, none = replace(layout, permanent=np.zeros_like(layout.permanent)), wp.zeros_like(h)
        return CellPairs(bodies, takes_part, cells, layout, rotatable, packed, h, none, none)

    def _record(self, first: int, last: int) -> list:
        """Return launches of passes ``first`` to ``last``: one on a CPU, one each on a GPU."""
        pairs, device = self.arrays, self.arrays.h.device
        group, rows = group_threads(device, long_lists=True), max(pairs.cell.shape[0], pairs.group.shape[0], _BINS)
        kernel = _kernel(pairs.packed.dtype, group)
        sizes = dict(threads=threads_for(rows, CELLS_PER_THREAD), gpu_threads=group * rows)
        ranges = [(k, k + 1) for k in range(first, last + 1)] if device.is_cuda else [(first, last + 1)]
        return [launch_passes(kernel, *ends, pairs, device=device, record_cmd=True, **sizes) for ends in ranges]

    def request_search(self, chosen):
        """Search again, and compute all tensors again, in the next :meth:`find` if any entry of ``chosen`` is not 0."""
        neighbors.launch_request_search(self._lists, chosen)

    def find(self):
        """Launch the search for near cells, and compute the tensors of pairs that have moved."""
        self.arrays.displaced.zero_()
        for launch in self._locate:
            launch.launch()
        neighbors.launch_find_neighbors(self._lists, self._lists, self._launch)
        for launch in self._tabulate:
            launch.launch()

    def add_field(self):
        """Add the corrections to the field, and the fields of differences to the cells' ``difference_field``."""
        self._cells.write_differences()
        for launch in self._field:
            launch.launch()

    def add_forces(self):
        """Add the corrections to forces and torques."""
        self._cells.write_differences()
        for launch in self._force:
            launch.launch()

    def persistent_arrays(self) -> dict[str, wp.array | Callable[[], wp.array]]:
        """Return the arrays that the next search and the next evaluation read, by name, and functions that return them.

        The functions return the parts of the tables of pairs in use. They need the other arrays of the same time. The
        tables have room for far more pairs than most scenes have.
        """
        names = "box", "rows", "cell", "row_of", "overlap_factor", "near_end", "crowded", "kind_end"
        tables = {"column": 1, "other_slot": 1, "pose": _POSE_ROWS, "matrix": _MATRIX_ROWS, "detail": _DETAIL_ROWS}
        result = neighbors.persistent_lists(self._lists) | {name: getattr(self.arrays, name) for name in names}
        return result | {name: partial(self._used_part, name, numbers) for name, numbers in tables.items()}

    def _used_part(self, name: str, numbers: int) -> wp.array:
        """Return the part of a table, with so many numbers a pair, that has pairs. Waits for the device."""
        pairs, table = self.arrays, getattr(self.arrays, name)
        if not table.size:
            return table
        chunks = -(-int(pairs.rows.numpy()[0]) // CHUNK)
        slots = int(pairs.kind_end.numpy().reshape(-1, _KINDS)[:, -1].max(initial=0))
        capacity = table.size // (pairs.cell.size * numbers)
        return table.reshape((pairs.cell.size // CHUNK, capacity, numbers * CHUNK))[:chunks, : min(slots, capacity)]
