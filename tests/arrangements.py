"""Arrangements of balls that several tests share."""

import numpy as np


def as_float32(*arrays):
    """The arrays rounded to float32 and back: inputs that both precisions see alike."""
    return tuple(np.asarray(a, np.float32).astype(np.float64) for a in arrays)


def pile(count=2000, seed=0):
    """Balls of three radii on a 1 cm grid, the middle ones touching: positions [n, 3], radii [n], moments [n, 3]."""
    rng = np.random.default_rng(seed)
    grid = np.stack(np.meshgrid(*[np.arange(13.0)] * 3, indexing="ij"), -1).reshape(-1, 3)[:count]
    radii = rng.choice([0.004, 0.005, 0.006], count)
    return as_float32(0.01 * grid, radii, rng.normal(size=(count, 3)) * 1e6 * radii[:, None] ** 3)


def overlapping(count=400, extent=0.05, radius=0.01, seed=0):
    """Balls thrown into a cube with no regard for one another: positions [n, 3], radii [n], moments [n, 3]."""
    rng = np.random.default_rng(seed)
    positions = rng.uniform(-0.5, 0.5, (count, 3)) * extent
    return as_float32(positions, np.full(count, radius), rng.normal(size=(count, 3)))


def fcc_block(cells=(6, 6, 7), radius=0.005):
    """Touching balls in face-centred cubic packing: 1,008 positions [n, 3] for 6 × 6 × 7 cells."""
    basis = np.array([[0.0, 0.0, 0.0], [0.5, 0.5, 0.0], [0.5, 0.0, 0.5], [0.0, 0.5, 0.5]])
    corners = np.stack(np.meshgrid(*[np.arange(float(c)) for c in cells], indexing="ij"), -1).reshape(-1, 1, 3)
    return (2.0 * np.sqrt(2.0) * radius * (corners + basis)).reshape(-1, 3)


def relative(value, reference):
    """Relative L2 difference; NaN compares as failure in ``<``."""
    return np.linalg.norm(np.asarray(value) - reference) / np.linalg.norm(reference)
