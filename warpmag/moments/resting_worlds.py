"""Work lists of a system of moments without the worlds that rest."""

import numpy as np
import warp as wp

from warpmag.kernels.applied.fields import AppliedForces
from warpmag.kernels.pairs.evaluate import FUSED, LOOP
from warpmag.kernels.shared.leave_out import record_leave_out, record_list_active
from warpmag.moments.system import MomentSystem

_TILE_ROWS, _TILE_SOURCES = {"column": 1, "begin": 0}, {"column": 4, "begin": 3}
"""Columns of end and begin of the target rows and of the sources of a tile (``kernels.pairs.work_list``)."""
_COUNT = {"column": 1}
"""Column of the number of moments of a chunk."""
_BODIES = {"column": 3, "begin": 2}
"""Columns of the range of permanent bodies that act on a cell (``kernels.applied.near_cells``)."""
_ITEMS = {"column": 2, "begin": 1}
"""Columns of the range of targets or cells of a row of a reaction (``kernels.applied.fields``)."""
_NONE, _ZERO = {"column": 0, "empty": -1}, {"column": 0}
"""Entries that are single numbers: −1 or 0 stands for no entry."""


class RestingWorlds:
    """Removes the worlds that rest from all passes over moments, pairs, cells and the targets of sources.

    The passes of the solve itself skip such worlds without lists.
    """

    def __init__(self, system: MomentSystem):
        """Copy the work lists of ``system``."""
        self._system, self._launches, self._kept = system, [], []
        self._lists: dict[bytes, wp.array] = {}
        worlds, on_gpu = system.worlds, system.device.is_cuda
        self._add(system._packed.active_groups, worlds, _NONE)
        evaluations = [system._permanent_field, system._inducible_field]
        evaluations += [evaluation for parts in system._wrench.values() for evaluation in parts]
        for evaluation in evaluations:
            if evaluation.form in (LOOP, FUSED):
                self._add(evaluation.tiles, worlds[_column(evaluation.tiles, 2)], _TILE_ROWS, _TILE_SOURCES)
            if on_gpu and evaluation.form != FUSED:
                evaluation.finish_active(self._list(evaluation.target))
        if on_gpu:
            system._induction.active = self._list(system._induction.row)
        if system._cells is not None and on_gpu:
            system._cells.sum_active(self._list)
        elif system._cells is not None:
            self._add(system._cells.chunks, worlds[_column(system._cells.chunks, 0)], _COUNT)
        if system.source_interaction is not None:
            self._add_sources(system.source_interaction)

    def _list(self, entries: wp.array) -> wp.array:
        """Return a list of the entries, each with a moment in its first column, that belong to no resting world."""
        moments = _column(entries, 0)
        if (key := moments.tobytes()) not in self._lists:
            device = self._system.device
            self._lists[key] = active = wp.zeros(len(moments) + 1, dtype=wp.int32, device=device)
            world = wp.array(self._system.worlds[moments], dtype=wp.int32, device=device)
            if len(moments):
                self._launches.append(record_list_active(world, self._system.resting, active))
        return self._lists[key]

    def _add_sources(self, interaction: AppliedForces) -> None:
        """Add the lists of targets of sources, of cells near permanent bodies, and of reactions."""
        worlds, arrays, sources = self._system.worlds, interaction.arrays, interaction.sources
        chunks, rows, of_source = arrays.targets.chunk, arrays.row, (*sources.applied, *sources.solids)
        if self._system.device.is_cuda:
            interaction.list_active(self._list)
        else:
            self._add(chunks, worlds[_column(chunks, 0)], _COUNT)
            if interaction.cell_count:
                self._add(arrays.cells.cell, worlds[_column(arrays.cells.cell, 0)], _BODIES)
        self._add(rows, np.array([of_source[s].world for s in _column(rows, 0)], int), _ITEMS)
        self._add(interaction.movable, worlds, _ZERO)

    def _add(self, entries: wp.array, world: np.ndarray, *ranges: dict[str, int]) -> None:
        """Add a list of entries with their worlds, and the columns to empty."""
        if not len(entries):
            return
        system, whole = self._system, entries.numpy().reshape(len(entries), -1)
        table = wp.array(ptr=entries.ptr, dtype=wp.int32, shape=whole.shape, device=system.device)
        copy, of_world = (wp.array(values, dtype=wp.int32, device=system.device) for values in (whole, world))
        self._kept.append((entries, table))
        self._launches += [record_leave_out(copy, of_world, system.resting, entries=table, **ends) for ends in ranges]

    def leave_out(self) -> None:
        """Launch the removal of the worlds that rest, and the return of the others."""
        for active in self._lists.values():
            active[:1].zero_()
        for launch in self._launches:
            launch.launch()


def _column(entries: wp.array, number: int) -> np.ndarray:
    """Return a column of a list of integers."""
    return entries.numpy().reshape(len(entries), -1)[:, number]
