"""A solution that is kept during a trial solve."""

from collections.abc import Sequence

import warp as wp

from warpmag.moments.arrays import PersistentArray, restore_snapshot, take_snapshot


class KeptSolution:
    """Copies of the arrays of a solution, from which :meth:`restore` brings it back."""

    def __init__(self, solutions: dict[str, PersistentArray], fields: Sequence[wp.array]):
        """Copy the arrays that solves pass to the next ones, and those that callers write before a solve."""
        self._solutions, self._fields = solutions, fields
        self._saved, self._saved_fields = take_snapshot(solutions), [wp.clone(array) for array in fields]

    def restore(self) -> None:
        """Copy all arrays back."""
        restore_snapshot(self._solutions, self._saved)
        for array, values in zip(self._fields, self._saved_fields, strict=True):
            wp.copy(array, values)
