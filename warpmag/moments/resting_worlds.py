"""Work lists of a system of moments without the worlds that rest."""

import numpy as np
import warp as wp

from warpmag.kernels.applied.fields import AppliedForces
from warpmag.kernels.pairs.evaluate import FUSED, LOOP
from warpmag.kernels.shared.copies import put_copies
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
        self._system, self._launches, self._kept, self._layout = system, [], [], system._layout
        self._lists: dict[bytes, wp.array] = {}
        on_gpu, groups = system.device.is_cuda, system.world_of_moments
        self._add(system._packed.active_groups, groups, _NONE)
        evaluations = [system._permanent_field, system._inducible_field]
        evaluations += [evaluation for parts in system._wrench.values() for evaluation in parts]
        for evaluation in evaluations:
            if evaluation.form in (LOOP, FUSED):
                self._add(evaluation.tiles, self._worlds_of(evaluation.tiles, 2), _TILE_ROWS, _TILE_SOURCES)
            if on_gpu and evaluation.form != FUSED:
                evaluation.finish_active(self._list(evaluation.target))
        if on_gpu:
            system._induction.active = self._list(system._induction.row)
        couplings = None if system._cells is None else system._cells.couplings
        if couplings is not None and on_gpu:
            couplings.sum_active(self._list)
        elif couplings is not None:
            self._add(couplings.chunks, self._worlds_of(couplings.chunks), _COUNT)
        if system.source_interaction is not None:
            self._add_sources(system.source_interaction)

    def _worlds_of(self, entries: wp.array, column: int = 0) -> wp.array:
        """Return the world of each entry of a list, which has a moment in a column."""
        worlds = self._layout.worlds_of(_column(entries, column))
        return wp.array(worlds, dtype=wp.int32, device=entries.device)

    def _list(self, entries: wp.array) -> wp.array:
        """Return a list of the entries, each with a moment in its first column, that belong to no resting world.

        The entries are equal in all copies of worlds.
        """
        device, layout, count = self._system.device, self._layout, len(entries) // self._layout.copies
        moments = _column(entries[:count], 0) if count else np.zeros(0, int)
        if (key := moments.tobytes()) not in self._lists:
            self._lists[key] = active = wp.zeros(len(entries) + 1, dtype=wp.int32, device=device)
            worlds = layout.worlds[moments].astype(np.int32)
            worlds = put_copies(worlds, wp.int32, device, layout.copies, layout.world_count)
            if count:
                self._launches.append(record_list_active(worlds, self._system.resting, active))
        return self._lists[key]

    def _add_sources(self, interaction: AppliedForces) -> None:
        """Add the lists of targets of sources, of cells near permanent bodies, and of reactions."""
        arrays, sources, device = interaction.arrays, interaction.sources, self._system.device
        chunks, rows = arrays.targets.chunk, arrays.row
        if device.is_cuda:
            interaction.list_active(self._list)
        else:
            self._add(chunks, self._worlds_of(chunks), _COUNT)
            if interaction.cell_count:
                self._add(arrays.cells.cell, self._worlds_of(arrays.cells.cell), _BODIES)
        source_worlds = np.append([source.world for source in sources.applied], sources.solid_worlds).astype(int)
        row_worlds = wp.array(source_worlds[_column(rows, 0)], dtype=wp.int32, device=device)
        self._add(rows, row_worlds, _ITEMS)
        self._add(interaction.movable, self._system.world_of_moments, _ZERO)

    def _add(self, entries: wp.array, worlds: wp.array, *ranges: dict[str, int]) -> None:
        """Add a list of entries with their worlds, and the columns to empty."""
        if not len(entries):
            return
        columns = entries.size * wp.types.type_size_in_bytes(entries.dtype) // (4 * len(entries))
        table = wp.array(ptr=entries.ptr, dtype=wp.int32, shape=(len(entries), columns), device=entries.device)
        copy = wp.clone(table)
        self._kept.append((entries, table))
        resting = self._system.resting
        self._launches += [record_leave_out(copy, worlds, resting, entries=table, **ends) for ends in ranges]

    def leave_out(self) -> None:
        """Launch the removal of the worlds that rest, and the return of the others."""
        for active in self._lists.values():
            active[:1].zero_()
        for launch in self._launches:
            launch.launch()


def _column(entries: wp.array, number: int) -> np.ndarray:
    """Return a column of a list of integers."""
    return entries.numpy().reshape(len(entries), -1)[:, number]
