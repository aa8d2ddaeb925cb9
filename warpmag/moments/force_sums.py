"""Sums of forces and torques over the pairs of a system's moments, for each force law."""

import numpy as np

from warpmag.kernels.pairs.evaluate import PairEvaluation
from warpmag.kernels.pairs.pair_law import Quantity
from warpmag.kernels.pairs.work_list import pair_count
from warpmag.kernels.shared.copies import repeat_rows
from warpmag.moments.layout import MomentLayout


def force_sums(layout: MomentLayout, rotatable: np.ndarray, fast, effective, packed, *arrays, **options):
    """Return the evaluations of forces on movable moments and of torques, by force law.

    Args:
        layout: Worlds and bodies of the moments, and the movable ones.
        rotatable: True for moments with a torque, shape [n].
        fast: Fast sums of the system (``moments.fmm``).
        effective: Effective moments of the force law ``zeeman``.
        packed: All moments, packed (``kernels.pairs.packing.PackedMoments``).
        arrays, options: Field that exerts torques, forces, and options of :class:`PairEvaluation`.
    """
    mutual, rotating = layout.runs(layout.movable & ~rotatable), layout.movable & rotatable
    runs = mutual, layout.wrench_runs(rotating), mutual + layout.runs(rotating)
    step, copies = len(layout.radii), layout.copies
    *segments, all_segments = (repeat_rows(np.reshape(rows, (-1, 4)), copies, step) for rows in runs)
    pairs = pair_count(all_segments)

    def evaluations(force, effective):
        # moments with a torque come last: the others use the mirrored form, which writes the forces on all moments
        parts = [(force, segments[0]), (Quantity.WRENCH, segments[1])]
        if fast.uses_multipoles(Quantity.WRENCH, pairs):  # in one sum, so that actions equal reactions
            parts = [(Quantity.WRENCH if len(segments[1]) else force, all_segments)]
        return [
            PairEvaluation(
                quantity, rows, packed, packed, *arrays, copies=copies, effective=effective,
                sums=fast.sums_of(quantity, pairs), **options,
            )
            for quantity, rows in parts
            if len(rows)
        ]  # fmt: skip

    return {"kelvin": evaluations(Quantity.MUTUAL_FORCE, None), "zeeman": evaluations(Quantity.FORCE, effective)}
