"""Expansions of cells: from moments to multipoles, up and down between levels, and from local expansions to fields.

What is particular to the harmonics comes from the caller, as numbers (``warpmag/moments/fmm.py``).
"""

from dataclasses import dataclass
from enum import IntEnum
from functools import cache

import numpy as np
import warp as wp

from warpmag.kernels.fmm.grid import MomentGrid
from warpmag.kernels.fmm.translate import Translation, pitch
from warpmag.kernels.pairs.pair_terms import Quantity
from warpmag.kernels.shared.native import native_options
from warpmag.kernels.shared.team import team, threads_for

_THREADS = 128
"""Threads of a block, which has a cell."""
_FALLING_BLOCKS = 8
"""Blocks for each multiprocessor that share the cells above the leaves on the way down."""
_CELLS_PER_THREAD = 64
"""Cells of a CPU that make another thread worth waking."""
TERMS = 5
"""Terms of a multipole's coefficient, as in ``expansions.h``."""


class _Step(IntEnum):
    RISE, FALL, FIELDS = range(3)


@dataclass(frozen=True, eq=False)
class ExpansionTables:
    """Numbers of the harmonics up to a degree p, K = (p + 1)² of them, in float64.

    Attributes:
        degree: Highest degree p.
        growth, decay: R_n = growth z R_(n−1) − decay r² R_(n−2) at degree n and order m; where n = m, the factor of
            (x + iy) R_(m−1), shape [K].
        derivatives: Matrices D with ∇R_i = Σ_j D[:, i, j] R_j, shape [3, K, K].
        up: Matrix that takes the multipole of a child in octant 0 to its part of its parent's, shape [K, K].
        down: Matrix that takes a parent's local expansion to that of its child in octant 0, shape [K, K].
        across: Matrix of each displacement of ``translate.displacements``, shape [56, K, K].
        parity: Signs that harmonics take where x, y or z changes its sign, shape [3, K].
    """

    degree: int
    growth: np.ndarray
    decay: np.ndarray
    derivatives: np.ndarray
    up: np.ndarray
    down: np.ndarray
    across: np.ndarray
    parity: np.ndarray


@cache
def _arrays_type(dtype):
    @wp.struct
    class ExpansionArrays:
        counts: wp.array[int]
        level_begin: wp.array[int]
        leaves: wp.array[int]
        moment_begin: wp.array[int]
        children: wp.array2d[int]
        parent: wp.array[int]
        arrived: wp.array[int]
        frame: wp.array[wp.float64]
        inside: wp.array2d[dtype]
        sorted: wp.array2d[dtype]
        effective: wp.array2d[dtype]
        sums: wp.array2d[dtype]
        multipoles: wp.array2d[dtype]
        locals: wp.array2d[dtype]
        growth: wp.array[dtype]
        decay: wp.array[dtype]
        gather_index: wp.array2d[int]
        gather_weight: wp.array2d[dtype]
        spread_index: wp.array3d[int]
        spread_weight: wp.array3d[dtype]
        up: wp.array2d[dtype]
        down: wp.array2d[dtype]
        signs: wp.array2d[dtype]
        sources: int

    return ExpansionArrays


class Expansions:
    """Multipoles and local expansions of the cells of a grid, and the fields of the latter at its moments.

    Args:
        grid: The cells.
        tables: Numbers of the harmonics.
        quantity: What is wanted at the moments, ``FIELD``, ``FORCE`` or ``WRENCH``.
        moments: Moments as the grid sorts them, packed rows, shape [8, n]; written by the caller.
        effective: Effective moments e of the force, sorted likewise, shape [3, n].
        sums: 4π times the force and the field, sorted likewise, shape [n, 3 or 6].
    """

    def __init__(self, grid: MomentGrid, tables: ExpansionTables, quantity: Quantity, moments, effective, sums):
        """Allocate the expansions and copy the tables to the device."""
        device, dtype = grid.device, moments.dtype
        harmonics = (tables.degree + 1) ** 2
        width = pitch(harmonics)
        self._grid, self._quantity, self._dtype = grid, quantity, dtype
        self._translation = _translation(tables, dtype, device.alias)
        self._constants = {"DEGREE": tables.degree, "HARMONICS": harmonics, "PITCH": width, "THREADS": _THREADS}
        self._arrays = a = _arrays_type(dtype)()
        for name in ("counts", "level_begin", "moment_begin", "children", "parent", "frame", "inside"):
            setattr(a, name, getattr(grid, name))
        for name, array in _device_tables(tables, dtype, device.alias).items():
            setattr(a, name, array)
        a.sorted, a.effective, a.sums = moments, effective, sums
        a.multipoles = wp.zeros((grid.capacity + 1, width), dtype=dtype, device=device)
        a.locals = wp.zeros_like(a.multipoles)
        self._parts = self._translation.parts(a.locals.shape)  # its own: graphs that were captured write to them
        a.arrived = wp.zeros(grid.capacity, dtype=wp.int32, device=device)
        # forces: sources to one degree less, for actions and reactions to add up to zero
        a.sources = harmonics if quantity == Quantity.FIELD else tables.degree**2

    def share(self, leaves, shares=None):
        """Set the first of the leaves whose moments are targets, and the end after the last, shape [2].

        Where several processes share out the cells, ``shares`` has those of this one (``sharing.CellShares``).
        """
        a, grid, cells = self._arrays, self._grid, shares or self._grid
        a.leaves, self._shares = leaves, shares
        parts = None if shares else self._parts
        lists = grid.neighbors, a.children, a.parent, cells.order, cells.octant_begin
        self._across = self._translation.bind(a.multipoles, a.locals, *lists, parts=parts)

    def gather(self):
        """Launch the multipoles of all cells."""
        self._launch(_Step.RISE)

    def translate(self):
        """Launch the local expansions of all cells: across, and down."""
        if self._shares is not None:
            self._shares.translate(self._translation, self._across)
        else:
            self._translation.launch(self._across)
        self._launch(_Step.FALL)

    def add_fields(self):
        """Launch the fields of local expansions at all moments, added to ``sums``."""
        self._launch(_Step.FIELDS)

    def _launch(self, step: _Step):
        grid, device = self._grid, self._grid.device
        kernel = _kernel(self._dtype, step, self._quantity, tuple(self._constants.items()))
        if device.is_cpu:
            threads = threads_for(grid.capacity, _CELLS_PER_THREAD)
            wp.launch(kernel, dim=1, inputs=[threads, team(), self._arrays], device=device)
            return
        blocks = min(grid.capacity, _FALLING_BLOCKS * device.sm_count) if step == _Step.FALL else grid.capacity
        inputs = [blocks, None, self._arrays]
        wp.launch(kernel, dim=blocks * _THREADS, inputs=inputs, device=device, block_dim=_THREADS)


@cache
def _translation(tables: ExpansionTables, dtype, device: str) -> Translation:
    """Matrices on a device, of which all evaluations have one copy."""
    return Translation(tables.across, tables.parity, dtype, device)


@cache
def _device_tables(tables: ExpansionTables, dtype, device: str) -> dict[str, wp.array]:
    """The other numbers of the harmonics on a device, by their names in the struct."""
    harmonics = (tables.degree + 1) ** 2
    padding = (0, 0), (0, pitch(harmonics) - harmonics)

    def numbers(values):
        return wp.array(np.ascontiguousarray(values), dtype=dtype, device=device)

    def integers(values):
        return wp.array(np.ascontiguousarray(values, np.int32), dtype=wp.int32, device=device)

    gather, spread = _sparse_derivatives(tables)
    octants = np.arange(8)[:, None, None] >> np.arange(3)[None, :, None] & 1
    signs = np.where(octants & (tables.parity < 0)[None], -1.0, 1.0).prod(axis=1)
    return {
        "growth": numbers(tables.growth),
        "decay": numbers(tables.decay),
        "gather_index": integers(gather[0]),
        "gather_weight": numbers(gather[1]),
        "spread_index": integers(spread[0]),
        "spread_weight": numbers(spread[1]),
        "up": numbers(np.pad(tables.up.T, padding)),
        "down": numbers(np.pad(tables.down.T, padding)),
        "signs": numbers(np.pad(signs, padding)),
    }


def _sparse_derivatives(tables: ExpansionTables):
    """Index and weight of the terms of derivatives: of each multipole's coefficient, and of each field's."""
    below, derivatives = tables.degree**2, tables.derivatives
    size = derivatives.shape[1]
    gather = np.zeros((size, TERMS), int), np.zeros((size, TERMS))
    spread = np.zeros((below, 3, 2), int), np.zeros((below, 3, 2))
    filled, used = np.zeros(size, int), np.zeros((below, 3), int)
    for axis, i, j in np.argwhere(np.abs(derivatives) > 1e-12):
        weight = derivatives[axis, i, j]
        for (index, weights), row, place, at in (
            (gather, i, filled[i], 3 * j + axis),
            (spread, (j, axis), used[j, axis], i),
        ):
            index[row][place], weights[row][place] = at, weight
        filled[i] += 1
        used[j, axis] += 1
    return gather, spread


@cache
def _kernel(dtype, step: _Step, quantity: Quantity, constants):
    arrays_struct = _arrays_type(dtype)
    call = f"visit_cells<warpmag::Step({step:d}), warpmag::Quantity({quantity:d})>"

    @wp.func_native(f"warpmag::{call}(thread, threads, team.data, arrays);")
    def run(thread: int, threads: int, team: wp.array2d[wp.uint64], arrays: arrays_struct): ...

    @wp.kernel(
        module="unique",
        enable_backward=False,
        grid_stride=False,
        module_options=native_options("fmm/expansions.h", dtype=dtype, **dict(constants)),
    )
    def expand(threads: int, team: wp.array2d[wp.uint64], arrays: arrays_struct):
        run(wp.tid(), threads, team, arrays)

    return expand
