"""Arrangements of iron balls in fields from weak to saturating, for errors of a solve against an exact solution.

There are chains, rings, shells, packings, heaps and loose balls; touching, apart and overlapping; in uniform fields and
under a dipole, where one end saturates and the other is hardly magnetized.
"""

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from bench.cases import RADIUS, SATURATION
from bench.reference import oracle
from bench.systems import moment_system
from warpmag.moments.system import MomentSystem

TILTED = np.array([0.48, 0.6, 0.64])  # direction of uniform fields, oblique to all axes of an arrangement


@dataclass(frozen=True)
class Arrangement:
    """Balls in a field."""

    positions: np.ndarray  # centers [m], shape [n, 3], exact in float32
    applied: np.ndarray  # applied field [A/m], shape [n, 3]
    radii: float | np.ndarray  # [m], scalar or [n]
    material: dict  # material arguments of a solve


def _chain(count):
    return 2.0 * RADIUS * np.arange(count)[:, None] * [1.0, 0.0, 0.0]


def _ring(count):
    angle = 2.0 * np.pi * np.arange(count) / count
    return RADIUS / np.sin(np.pi / count) * np.stack([np.cos(angle), np.sin(angle), np.zeros(count)], axis=1)


def _shell(count):
    """Balls on a spiral over a sphere; the nearest two touch."""
    z = 1.0 - (2.0 * np.arange(count) + 1.0) / count
    angle, across = np.pi * (1.0 + np.sqrt(5.0)) * np.arange(count), np.sqrt(1.0 - z * z)
    unit = np.stack([across * np.cos(angle), across * np.sin(angle), z], axis=1)
    distances = np.linalg.norm(unit[:, None] - unit, axis=-1) + 9.0 * np.eye(count)
    return 2.0 * RADIUS / distances.min() * unit


def _grid(*counts):
    axes = np.meshgrid(*[np.arange(float(count)) for count in counts], indexing="ij")
    return 2.0 * RADIUS * np.stack(axes, axis=-1).reshape(-1, 3)


def _packing(cells):
    """Face-centered cubic packing of touching balls."""
    basis = np.array([[0.0, 0.0, 0.0], [0.5, 0.5, 0.0], [0.5, 0.0, 0.5], [0.0, 0.5, 0.5]])
    corners = _grid(*cells).reshape(-1, 1, 3) / (2.0 * RADIUS)
    return (2.0 * np.sqrt(2.0) * RADIUS * (corners + basis)).reshape(-1, 3)


def _heap(count):
    """A cone of touching balls."""
    x = _packing((8, 8, 4))
    center = x.mean(axis=0)
    height = np.hypot(x[:, 0] - center[0], x[:, 1] - center[1]) + x[:, 2]
    return x[np.argsort(height, kind="stable")[:count]]


def _loose(count, extent, seed=0):
    """Balls at random in a cube, some of them overlapping."""
    return extent * np.random.default_rng(seed).uniform(-0.5, 0.5, (count, 3))


def _uniform(positions, strength, radii=RADIUS, **material):
    """Arrangement in a tilted uniform field of ``strength`` times the saturation."""
    x = np.asarray(positions, np.float32).astype(float)
    applied = np.broadcast_to(strength * SATURATION * TILTED, x.shape)
    return Arrangement(x, applied, radii, {"saturation": SATURATION, **material})


def _dipole(positions, moment, **material):
    """Arrangement under a dipole [A·m²], two centimeters above its top and off its center."""
    x = np.asarray(positions, np.float32).astype(float)
    center = x.mean(axis=0)
    source = np.array([[center[0] + 0.003, center[1] + 0.001, x[:, 2].max() + 0.02]])
    applied = oracle.h_field(source, np.array([[0.2 * moment, 0.0, moment]]), x)
    return Arrangement(x, applied, RADIUS, {"saturation": SATURATION, **material})


def _mixed():
    """Balls of three sizes and of random materials."""
    rng = np.random.default_rng(5)
    x = 1.2 * _grid(5, 5, 5)
    saturation, susceptibility = rng.uniform(0.3, 2.0, len(x)) * 1e6, 10.0 ** rng.uniform(-1.0, 3.0, len(x))
    radii = rng.choice([0.004, 0.005, 0.006], len(x))
    return _uniform(x, 0.15, radii, saturation=saturation, susceptibility=susceptibility)


ARRANGEMENTS: dict[str, Callable[[], Arrangement]] = {
    "chain, weak field": lambda: _uniform(_chain(60), 1e-4),
    "chain under a dipole": lambda: _dipole(_chain(60), 60.0),
    "ring": lambda: _uniform(_ring(40), 0.1),
    "shell": lambda: _uniform(_shell(100), 0.1),
    "shell under a dipole": lambda: _dipole(_shell(100), 60.0),
    "packing, weak field": lambda: _uniform(_packing((3, 3, 3)), 1e-4),
    "packing, half saturated": lambda: _uniform(_packing((3, 3, 3)), 0.5),
    "packing, clamped": lambda: _uniform(_packing((3, 3, 3)), 0.2, curve="clamped"),
    "packing, frohlich": lambda: _uniform(_packing((3, 3, 3)), 0.2, curve="frohlich"),
    "packing under a dipole": lambda: _dipole(_packing((3, 3, 3)), 900.0),
    "heap, weak field": lambda: _uniform(_heap(120), 1e-4),
    "heap under a dipole": lambda: _dipole(_heap(120), 60.0),
    "heap under a weak dipole": lambda: _dipole(_heap(120), 5.0),
    "heap under a dipole, langevin": lambda: _dipole(_heap(120), 60.0, curve="langevin"),
    "pile under a dipole": lambda: _dipole(_grid(5, 5, 5), 60.0),
    "pile under a strong dipole": lambda: _dipole(_grid(5, 5, 5), 900.0),
    "pile of a weak material": lambda: _dipole(_grid(5, 5, 5), 60.0, susceptibility=3.0),
    "bar": lambda: _uniform(_grid(14, 3, 3), 0.1),
    "heap, eleven balls at one position": lambda: _uniform(_heap(120)[[*range(110), *[20] * 10]], 0.1),
    "materials side by side": _mixed,
    "loose balls": lambda: _uniform(_loose(120, 0.12), 0.1),
    "overlapping balls": lambda: _uniform(_loose(120, 0.05), 0.1),
}


def arranged(balls: Arrangement, **settings) -> MomentSystem:
    """System of an arrangement; ``settings`` are more arguments of the system."""
    radii = np.broadcast_to(balls.radii, len(balls.positions))
    system = moment_system(radii=radii, external_field=balls.applied, **balls.material, **settings)
    system.positions.assign(balls.positions)
    return system


def trace(system: MomentSystem, *, to_residual: bool = False) -> np.ndarray:
    """Solve, and return the residual e_M (Eq. 12) after each field evaluation.

    With ``to_residual`` the solve ends when the residual is at most ``rtol`` or not finite, else by its own criterion.
    """
    residuals, ended = [], False
    system.begin()
    while not ended and len(residuals) < system.settings.max_evaluations:
        system.iterate()
        residuals.append(float(system.residual.numpy()[0]))
        reached = residuals[-1] <= system.rtol or not np.isfinite(residuals[-1])
        ended = reached if to_residual else bool(system.converged.numpy()[0])
    return np.array(residuals)
