"""The error of fields by expansions, against sums over all pairs at some moments."""

import numpy as np
import warp as wp

from warpmag.kernels.pairs.evaluate import PairEvaluation
from warpmag.kernels.pairs.pair_terms import Quantity

_CHECKED = 256
"""Moments at which the error is measured."""


def sampled_error(evaluation: PairEvaluation, moments, ranges, base, out) -> float:
    """Relative error ‖H − H_exact‖/‖H_exact‖ of a field at random moments; waits for the device.

    Args:
        evaluation: What evaluates the field to ``out``, which is as before when this returns.
        moments: Packed moments.
        ranges: For each world the columns of targets, begin and end, and the end of sources, integers [worlds, 3].
        base: Field on top of that of sources [A/m], shape [n].
        out: Its field [A/m], shape [n].
    """
    ranges = np.reshape(ranges, (-1, 3))
    own = np.concatenate([np.arange(begin, end) for begin, end, _ in ranges])
    if len(own) == 0:
        return 0.0
    rows = np.sort(np.random.default_rng(0).choice(own, min(_CHECKED, len(own)), replace=False))
    begin, _, end = ranges[np.searchsorted(ranges[:, 2], rows, side="right")].T
    kept, exact = wp.clone(out), wp.zeros_like(out)
    evaluation.launch()
    found = out.numpy()[rows].astype(float)
    wp.copy(out, kept)
    segments = np.stack([rows, rows + 1, begin, end], axis=1)
    PairEvaluation(Quantity.FIELD, segments, moments, moments, base, exact).launch()
    wanted = exact.numpy()[rows].astype(float)
    return float(np.linalg.norm(found - wanted) / max(np.linalg.norm(wanted), np.finfo(float).tiny))
