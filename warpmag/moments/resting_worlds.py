"""Work lists of a system of moments without the worlds that rest."""

import warp as wp

from warpmag.kernels.pairs.evaluate import FUSED, LOOP
from warpmag.kernels.shared.leave_out import record_leave_out
from warpmag.moments.system import MomentSystem

_ROWS, _SOURCES = (1, 0), (4, 3)
"""Columns of end and begin of the target rows and of the sources of a tile (``kernels.pairs.work_list``)."""
_COUNT = (1, -1)
"""Column of the number of moments of a chunk."""


class RestingWorlds:
    """Removes the worlds that rest from the sums over pairs, the couplings of cells and the fields of sources.

    These take most of the time of a solve. The other passes skip such worlds by themselves or cost little.
    """

    def __init__(self, system: MomentSystem):
        """Copy the work lists of ``system``."""
        self._system, self._launches, self._kept = system, [], []
        evaluations = [system._permanent_field, system._inducible_field]
        evaluations += [evaluation for parts in system._wrench.values() for evaluation in parts]
        # without target rows a tile of a GPU would read beyond its table
        ranges = (_SOURCES,) if system.device.is_cuda else (_ROWS, _SOURCES)
        for evaluation in evaluations:
            if evaluation.form in (LOOP, FUSED):
                self._add(evaluation.tiles, 2, ranges)
        if system._cells is not None:
            self._add(system._cells.chunks, 0, (_COUNT,))
        if system.source_interaction is not None:
            self._add(system.source_interaction.arrays.targets.chunk, 0, (_COUNT,))

    def _add(self, entries: wp.array, moment: int, ranges) -> None:
        """Add a list of entries with a moment in column ``moment``, and the columns of the ranges to empty."""
        if not len(entries):
            return
        system, whole = self._system, entries.numpy()
        table = wp.array(ptr=entries.ptr, dtype=wp.int32, shape=whole.shape, device=system.device)
        world = wp.array(system.worlds[whole.T[moment]], dtype=wp.int32, device=system.device)
        copy = wp.array(whole, dtype=wp.int32, device=system.device)
        self._kept.append((entries, table))
        for end, begin in ranges:
            self._launches.append(record_leave_out(copy, world, system.resting, end, begin, table))

    def leave_out(self) -> None:
        """Launch the removal of the worlds that rest, and the return of the others."""
        for launch in self._launches:
            launch.launch()
