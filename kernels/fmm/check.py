"""The error of fields by expansions, against sums over all pairs at some moments."""

import numpy as np
import warp as wp

from warpmag.kernels.pairs.evaluate import PairEvaluation
from warpmag.kernels.pairs.pair_terms import Quantity

_CHECKED = 256
"""Moments at which the error is measured."""


def sampled_error(sums, moments, ranges, given, base) -> float:
    """Relative error ‖H − H_exact‖/‖H_exact‖ of a field at random moments; waits for the device.

    Args:
        sums: Sums of the targets' field on each other, as ``PairEvaluation`` takes them; None means over all pairs.
        moments: Packed moments.
        ranges: For each world the columns of targets, begin and end, and the end of sources, integers [worlds, 3].
        given: Field on top of that of targets, which has those of the other sources [A/m], shape [n].
        base: Field on top of that of all sources [A/m], shape [n].
    """
    ranges = np.reshape(ranges, (-1, 3))
    own = np.concatenate([np.arange(begin, end) for begin, end, _ in ranges])
    if len(own) == 0:
        return 0.0
    rows = np.sort(np.random.default_rng(0).choice(own, min(_CHECKED, len(own)), replace=False))
    begin, middle, end = ranges[np.searchsorted(ranges[:, 2], rows, side="right")].T
    fields = []
    for last, below, how in ((middle, given, sums), (end, base, None)):
        field, segments = wp.zeros_like(base), np.stack([rows, rows + 1, begin, last], axis=1)
        PairEvaluation(Quantity.FIELD, segments, moments, moments, below, field, sums=how).launch()
        fields.append(field.numpy()[rows].astype(float))
    found, exact = fields
    return float(np.linalg.norm(found - exact) / max(np.linalg.norm(exact), np.finfo(float).tiny))
