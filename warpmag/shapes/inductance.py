"""Inductances of coils per turn, from their records, in double precision.

Loops and current sheets have closed forms. Everything else is the flux of Neumann's formula,

    M = ∮ A(x)·dl,

with the vector potential A of one coil, integrated along the filaments of the other. A loop's A follows from complete
elliptic integrals, that of a straight piece from logarithms. A sheet is a set of loops at Gauss-Legendre heights. The
current of a wire is uniform over its cross section: a distance from the axis of a wire of radius w is at least its
geometric mean distance w e^(−1/4) (F. W. Grover, Inductance Calculations, 1946).
"""

import itertools

import numpy as np

from warpmag.declarations.coils import SourceRecord
from warpmag.errors import InputError

MU0 = 4e-7 * np.pi
_MEAN_DISTANCE = float(np.exp(-0.25))
"""Geometric mean distance within a circle with uniform current, over its radius."""
_LEAST_SHARE = 0.01
"""Smallest declared inductance of a coil, over the computed one. The wire of a loop may be 50 times as thick as by
default, which reduces the inductance to a fifth."""
_HEIGHTS, _FILAMENTS, _ANGLES, _PIECES = 24, 37, 128, 48
"""Numbers of loops that replace a sheet as the source of A and as filaments; of points of a circle; of points of a
straight piece. The first two differ, so that filaments do not coincide with the loops of an equal sheet."""


def self_inductance(record: SourceRecord) -> float:
    """Return the inductance of a loop, solenoid or closed polyline of one turn [H].

    Example: a loop of radius a and wire radius w ≪ a has μ0 a (ln(8 a/w) − 7/4).
    """
    radius, wire = record.parameters[0], record.parameters[-1]
    if record.kind == "loop":
        s = (wire / radius) ** 2 / 8.0  # Rosa and Grover 1912, Eq. 63
        return MU0 * radius * ((1.0 + s) * np.log(8.0 * radius / wire) + s / 3.0 - 1.75)
    if record.kind == "solenoid":
        return _sheet_inductance(radius, 2.0 * record.parameters[1])
    return _flux(record, *_filaments(record), wire=wire)


def check_inductance(name: str, record: SourceRecord) -> None:
    """Raise :class:`InputError` naming ``name`` if the given inductance is far too small for the coil's turns.

    The flux of magnets through the turns would drive currents without bounds.
    """
    if record.circuit is None or not record.circuit.inductance:
        return
    turns, _, given = record.circuit
    usual = turns**2 * self_inductance(record)
    if not given >= _LEAST_SHARE * usual:
        least = f"{100.0 * _LEAST_SHARE:g} % of the {usual:.3g} H of {turns:g} turns of this shape"
        raise InputError(f"{name}: inductance must be 0 or at least {least}, got {given:g}")


def mutual_inductance(record: SourceRecord, other: SourceRecord, rotation: np.ndarray, offset: np.ndarray) -> float:
    """Return the mutual inductance of two coils of one turn each [H].

    Args:
        record: The first coil.
        other: The second coil.
        rotation: Rotation from the frame of ``other`` to that of ``record``, shape [3, 3].
        offset: Origin of ``other`` in the frame of ``record`` [m], shape [3].
    """
    points, steps = _filaments(other)
    wire = max(record.parameters[-1], other.parameters[-1])
    return _flux(record, points @ rotation.T + offset, steps @ rotation.T, wire=wire)


def _sheet_inductance(radius: float, length: float) -> float:
    """Return the inductance of a cylindrical current sheet of one turn [H] (Lorenz 1879)."""
    k2 = 4.0 * radius**2 / (4.0 * radius**2 + length**2)
    k = np.sqrt(k2)
    complete_k, complete_e = _elliptic(np.array(k2))
    terms = (2.0 * k2 - 1.0) / k**3 * complete_e + (1.0 - k2) / k**3 * complete_k - 1.0
    return float(8.0 * MU0 * radius**3 / (3.0 * length**2) * terms)


def _filaments(record: SourceRecord) -> tuple[np.ndarray, np.ndarray]:
    """Return points and steps dl of the filaments of a coil, weighted by their share of the current, shape [p, 3]."""
    if record.kind == "polyline":
        corners, (nodes, weights) = record.table, _nodes(_PIECES)
        u = nodes * nodes * (3.0 - 2.0 * nodes)  # dense near the corners, where A has a logarithm
        along, weights = np.diff(corners, axis=0)[:, None], weights * 6.0 * nodes * (1.0 - nodes)
        points, steps = corners[:-1, None] + u[:, None] * along, weights[:, None] * along
        return points.reshape(-1, 3), steps.reshape(-1, 3)
    radius, (heights, weights) = record.parameters[0], _heights(record, _FILAMENTS)
    angle = 2.0 * np.pi * np.arange(_ANGLES) / _ANGLES
    circle = np.stack([np.cos(angle), np.sin(angle), np.zeros(_ANGLES)], axis=1)
    tangent = np.stack([-circle[:, 1], circle[:, 0], np.zeros(_ANGLES)], axis=1) * (2.0 * np.pi * radius / _ANGLES)
    points = radius * circle + heights[:, None, None] * [0.0, 0.0, 1.0]
    return points.reshape(-1, 3), (weights[:, None, None] * tangent).reshape(-1, 3)


def _heights(record: SourceRecord, count: int) -> tuple[np.ndarray, np.ndarray]:
    """Return heights of the loops of a loop or a solenoid [m], and their shares of the current."""
    if record.kind == "loop":
        return np.zeros(1), np.ones(1)
    nodes, weights = _nodes(count)
    return record.parameters[1] * (2.0 * nodes - 1.0), weights


def _nodes(count: int) -> tuple[np.ndarray, np.ndarray]:
    """Return nodes and weights of Gauss-Legendre quadrature from 0 to 1."""
    nodes, weights = np.polynomial.legendre.leggauss(count)
    return 0.5 * (nodes + 1.0), 0.5 * weights


def _flux(record: SourceRecord, points: np.ndarray, steps: np.ndarray, *, wire: float) -> float:
    """Return ∫ A·dl along filaments [Wb], for one ampere-turn.

    Distances are at least the geometric mean distance of a wire of radius ``wire`` [m].
    """
    nearest = wire * _MEAN_DISTANCE
    if record.kind == "polyline":
        pieces = itertools.pairwise(record.table)
        return sum(_flux_of_piece(start, end, points, steps, nearest) for start, end in pieces)
    total, radius = 0.0, record.parameters[0]
    rho = np.hypot(points[:, 0], points[:, 1])
    safe = np.where(rho > 0.0, rho, 1.0)
    azimuthal = (points[:, 0] * steps[:, 1] - points[:, 1] * steps[:, 0]) / safe
    for height, share in zip(*_heights(record, _HEIGHTS), strict=True):
        potential = _loop_potential(radius, rho, points[:, 2] - height, nearest)
        total += share * float(potential @ azimuthal)
    return total


def _loop_potential(radius: float, rho: np.ndarray, z: np.ndarray, nearest: float) -> np.ndarray:
    """Return the azimuthal vector potential of a loop of one ampere [Wb/m], at distances of ``nearest`` or more."""
    gap2 = np.maximum((radius - rho) ** 2 + z * z, nearest**2)
    far2 = gap2 + 4.0 * radius * rho
    k2 = 4.0 * radius * rho / far2
    complete_k, complete_e = _elliptic(k2)
    near_axis = k2 < 1e-6  # differences of nearly equal numbers
    bracket = np.where(near_axis, np.pi / 16.0 * k2**2, (2.0 - k2) * complete_k - 2.0 * complete_e)
    return MU0 / (4.0 * np.pi) * np.sqrt(far2) / np.where(rho > 0.0, rho, 1.0) * bracket


def _flux_of_piece(start, end, points, steps, nearest: float) -> float:
    """Return ∫ A·dl of a straight piece of wire with one ampere [Wb]."""
    axis = end - start
    length = float(np.linalg.norm(axis))
    axis = axis / length
    along = (points - start) @ axis
    across2 = np.maximum(((points - start) ** 2).sum(axis=1) - along**2, nearest**2)
    across = np.sqrt(across2)
    potential = np.arcsinh(along / across) + np.arcsinh((length - along) / across)
    return float(MU0 / (4.0 * np.pi) * (potential @ (steps @ axis)))


def _elliptic(k2: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return the complete elliptic integrals K and E of the squared modulus, by the arithmetic-geometric mean."""
    a, b, c2, power = np.ones_like(k2), np.sqrt(1.0 - k2), np.array(k2, float), 0.5
    total = power * c2
    for _ in range(12):  # quadratic convergence, also near k² = 1
        a, b, c2 = 0.5 * (a + b), np.sqrt(a * b), (0.5 * (a - b)) ** 2
        power *= 2.0
        total = total + power * c2
    complete_k = 0.5 * np.pi / a
    return complete_k, complete_k * (1.0 - total)
