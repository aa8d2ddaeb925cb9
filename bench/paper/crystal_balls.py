"""The crystal balls of the paper's Fig. 7: 178 fixed inducible balls around a bar magnet.

The paper states the count and shows the picture, but no sizes or strengths. Here the balls fill a plane grid of 16 × 13
cells, as in the bundled scene; the bar is in the middle 10 × 3 cells. The second choice is 14 × 13 cells and a bar
of 4 × 1, with a wider range of fields at the balls. Strengths of the bar:

* weak, 1e6 A/m, neodymium: no ball of iron saturates, ‖H‖ is 0.8 to 20 % of Ms;
* strong, 4e7 A/m, "excessively strong" as in the paper's scenes: ‖H‖ is 0.3 to 8 Ms.
"""

from dataclasses import dataclass

import numpy as np

import warpmag
from bench.systems import moment_system
from warpmag.declarations.magnets import SATURATION_OF_IRON
from warpmag.moments.dynamics import SubmagnetizationPairs
from warpmag.moments.system import MomentSystem
from warpmag.shapes import lattice

BALL_RADIUS = 0.005  # radius of the balls [m]
PITCH = 0.011  # distance of neighbors [m]; the balls do not touch
CELLS, OTHER_CELLS = (16, 13, 10, 3), (14, 13, 4, 1)
"""Cells of the grid along x and y, and cells of the bar; the first and the second choice."""
STRENGTHS = {"weak": 1e6, "strong": 4e7}  # magnetization of the bar, along its length [A/m]
PAIRS = ("across", "in plane", "random")
"""Initial directions M1 = −M2 of the pairs: normal to the plane of the balls; in the plane, across the bar; random."""


@dataclass(frozen=True)
class Layout:
    """Positions [m] of the balls, shape [178, 3], half extents [m] of the bar, and its moments."""

    balls: np.ndarray
    bar_half_extents: tuple[float, float, float]
    bar: lattice.Lattice


def layout(cells: tuple[int, int, int, int] = CELLS) -> Layout:
    """Return the positions of balls and bar."""
    columns, rows, length, width = cells
    centers = [(i - 0.5 * (columns - 1), j - 0.5 * (rows - 1), 0.0) for j in range(rows) for i in range(columns)]
    balls = [(x, y, z) for x, y, z in centers if abs(x) > 0.5 * length or abs(y) > 0.5 * width]
    half = (0.5 * length * PITCH - 5e-4, 0.5 * width * PITCH - 5e-4, 0.5 * width * PITCH - 5e-4)
    return Layout(PITCH * np.array(balls), half, lattice.fill([lattice.box(half)], 0.5 * PITCH))


def make_system(strength, dynamics: str, device: str, *, cells=CELLS, start="across", **settings) -> MomentSystem:
    """Return a system of the balls, followed by the moments of a bar of magnetization ``strength`` [A/m].

    Pairs have the directions ``start``, one of :data:`PAIRS`; ``settings`` are more arguments of ``moment_system``.
    """
    balls, bar = layout(cells).balls, layout(cells).bar
    count = len(balls) + len(bar.positions)
    system = moment_system(
        radii=np.concatenate([np.full(len(balls), BALL_RADIUS), bar.radii]), permanent=np.arange(count) >= len(balls),
        saturation=SATURATION_OF_IRON, dynamics=dynamics, device=device, **settings,
    )  # fmt: skip
    system.positions.assign(np.concatenate([balls, bar.positions]))
    moments = np.zeros((count, 3))
    moments[len(balls) :, 0] = strength * bar.volumes
    system.moments.assign(moments)
    if dynamics != "theta":
        set_pairs(system, start)
    return system


def applied_field(strength: float) -> np.ndarray:
    """Return the field at the balls [A/m] of a bar of magnetization ``strength`` [A/m], shape [178, 3]."""
    balls, bar = layout().balls, layout().bar
    moments = np.outer(bar.volumes, [strength, 0.0, 0.0])
    settings = {"radii": bar.radii, "target_radii": BALL_RADIUS, "dtype": "float64", "device": "cpu"}
    return warpmag.h_field(bar.positions, moments, balls, **settings)


def set_pairs(system: MomentSystem, start: str):
    """Set the pairs of a system to one of the directions :data:`PAIRS`."""
    if start == "random":
        axis = np.random.default_rng(0).normal(size=(system.count, 3))
    else:
        axis = np.tile([0.0, 0.0, 1.0] if start == "across" else [0.0, 1.0, 0.0], (system.count, 1))
    axis /= np.linalg.norm(axis, axis=1)[:, None]
    _pairs(system).set_pairs(axis, -axis)


def directions(system: MomentSystem) -> tuple[np.ndarray, np.ndarray]:
    """Return the directions of M1 and M2 of a system's pairs, each of shape [n, 3]."""
    return _pairs(system).first.numpy(), _pairs(system).second.numpy()


def _pairs(system: MomentSystem) -> SubmagnetizationPairs:
    assert isinstance(system.dynamics, SubmagnetizationPairs)
    return system.dynamics
