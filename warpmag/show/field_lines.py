"""Follows field lines through the field of moments."""

from collections.abc import Callable

import numpy as np

_STEPS = 300
_STEP = 0.05
"""Steps of a line at most, and their length over the size of the largest magnet."""
_POINTS = 72
"""Points of a curve."""


def trace(
    field: Callable[[np.ndarray], np.ndarray],
    ends: Callable[[np.ndarray], np.ndarray],
    seeds: np.ndarray,
    size: float,
) -> np.ndarray:
    """Follow the field from points, by the midpoint rule in steps of equal length.

    Args:
        field: Returns the field at points, shape [k, 3]; where it is zero a line ends.
        ends: Returns whether a line ends at points, shape [k].
        seeds: Where lines begin, shape [k, 3].
        size: Size that steps are measured by.

    Returns:
        Points of the lines, evenly along each, shape [k, points, 3].
    """
    lines = np.empty((_STEPS + 1, len(seeds), 3))
    lines[0] = seeds
    last = np.zeros(len(seeds), dtype=int)
    going = np.ones(len(seeds), dtype=bool)
    for step in range(_STEPS):
        lines[step + 1] = lines[step]
        if not going.any():
            continue
        here = lines[step, going]
        way = _direction(field(here + 0.5 * _STEP * size * _direction(field(here))))
        there = here + _STEP * size * way
        lines[step + 1, going] = there
        last[going] = step + 1
        stay = way.any(axis=1) & ~ends(there)
        going[going] = stay
    at = np.linspace(0.0, 1.0, _POINTS)[:, None] * last
    low = np.minimum(at.astype(int), _STEPS - 1)
    part = (at - low)[..., None]
    which = np.arange(len(seeds))
    return ((1.0 - part) * lines[low, which] + part * lines[low + 1, which]).transpose(1, 0, 2)


def _direction(field: np.ndarray) -> np.ndarray:
    size = np.linalg.norm(field, axis=1, keepdims=True)
    return np.where(size > 0.0, field / np.maximum(size, 1e-300), 0.0)
