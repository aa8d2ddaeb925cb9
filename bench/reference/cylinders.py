"""Moments of ideally permeable cylinders from a surface integral equation, for ``tests/test_cells.py``.

As in ``boxes.py`` the surface is at one potential, (1/4π) ∫ σ/‖x − y‖ dA = H0·x, and the moment is ∫ σ x dA. In a field
along the axis σ is the same all around it, in one across it goes as the cosine of the azimuth. So σ, or its amplitude,
is taken as constant on rings that get narrow towards the edge, where it is singular. Half the surface is enough: in a
field along the axis σ is odd in z, in one across even.

Run as ``python -m bench.reference.cylinders``; with twice the rings numbers change by less than 0.1 %.
"""

import numpy as np

LENGTHS = (1.0, 5.0, 10.0)
"""Lengths over diameters."""

_NODES, _WEIGHTS = np.polynomial.legendre.leggauss(8)


def moments(length: float, rings: int = 24) -> np.ndarray:
    """Moment over V H0 along the axis and across it of a cylinder of unit diameter, shape [2].

    Args:
        length: Its length.
        rings: Rings on half a cap, and on half of the side.
    """
    radius, (lower, upper) = 0.5, rings_of(length, rings)
    middle, width = 0.5 * (lower + upper), np.linalg.norm(upper - lower, axis=1)
    found = []
    for mode, sign, values in ((0, -1.0, middle[:, 1]), (1, 1.0, middle[:, 0])):
        matrix = _potentials(middle, lower, upper, mode) + sign * _potentials(middle * [1, -1], lower, upper, mode)
        charge = np.linalg.solve(matrix, values)
        around = 2.0 * np.pi if mode == 0 else np.pi
        found.append(2.0 * around * (charge * values * middle[:, 0]) @ width / (np.pi * radius**2 * length))
    return np.array(found)


def rings_of(length: float, count: int) -> tuple[np.ndarray, np.ndarray]:
    """Ends of rings in (ρ, z), ``count`` on half of the side, then on a cap, shape [2 count, 2] each."""
    radius, half = 0.5, 0.5 * length
    at = np.sin(0.5 * np.pi * np.linspace(0.0, 1.0, count + 1))
    side, cap = np.stack([np.full(count + 1, radius), half * at]), np.stack([radius * at, np.full(count + 1, half)])
    lower, upper = (np.concatenate([side.T[part], cap.T[part]]) for part in (slice(None, -1), slice(1, None)))
    return lower, upper


def nodes_on(points, a, b):
    """Nodes and weights on a ring from a to b, for each point: they crowd where it is nearest, for logarithms."""
    near = np.clip((points - a) @ (b - a) / ((b - a) @ (b - a)), 0.0, 1.0)
    s, weights = (0.5 + 0.5 * _NODES) ** 3, 1.5 * (0.5 + 0.5 * _NODES) ** 2 * _WEIGHTS
    for end in (0.0, 1.0):
        t = near[:, None] + (end - near[:, None]) * s
        yield a + t[..., None] * (b - a), np.abs(end - near)[:, None] * weights * np.linalg.norm(b - a)


def _potentials(points, lower, upper, mode: int) -> np.ndarray:
    """(1/4π) ∫ cos(mode φ) dA/‖x − y‖ of each ring at each point, at azimuth 0, shape [points, rings]."""
    result = np.empty((len(points), len(lower)))
    for k, (a, b) in enumerate(zip(lower, upper, strict=True)):
        total = 0.0
        for y, weights in nodes_on(points, a, b):
            total = total + (y[..., 0] * _around(points[:, None], y, mode) * weights).sum(axis=1)
        result[:, k] = total / (4.0 * np.pi)
    return result


def _around(x, y, mode: int) -> np.ndarray:
    """∫ cos(mode φ)/‖x − y‖ dφ over a circle through y, from complete elliptic integrals."""
    rho, other, height = x[..., 0], y[..., 0], x[..., 1] - y[..., 1]
    far = np.hypot(rho + other, height)
    rest = ((rho - other) ** 2 + height**2) / far**2  # 1 − k²
    first, second = elliptic(rest)
    if mode == 0:
        return 4.0 * first / far
    k2 = np.maximum(1.0 - rest, np.finfo(float).tiny)
    return 4.0 / far * ((2.0 / k2 - 1.0) * first - 2.0 / k2 * second)


def elliptic(rest) -> tuple[np.ndarray, np.ndarray]:
    """K and E of 1 − k² by the arithmetic-geometric mean (Abramowitz and Stegun 17.6)."""
    a, b = np.ones_like(rest), np.sqrt(rest)
    total, power = 0.5 * (1.0 - rest), 0.5
    for _ in range(12):
        a, b, c = 0.5 * (a + b), np.sqrt(a * b), 0.5 * (a - b)
        power *= 2.0
        total = total + power * c * c
    first = 0.5 * np.pi / a
    return first, first * (1.0 - total)


def main() -> None:
    """Print the moments of all cylinders."""
    for length in LENGTHS:
        coarse, fine = moments(length, 20), moments(length, 40)
        print(
            length, "m/(V H0) along and across", fine.round(4), "change from half as many", (fine / coarse - 1).round(4)
        )


if __name__ == "__main__":
    main()
