"""Real solid harmonics and their translations in float64, for the expansions of the fast multipole method.

Harmonics are Schmidt semi-normalized: at a unit vector the squares of one degree sum to 1, so that coefficients stay
near 1 up to high degrees. With i = n² + n + m, m > 0 for cos mφ and m < 0 for sin |m|φ, they satisfy

    1/|y − x| = Σ R_i(x) I_i(y) for |x| < |y|.

There are K = (degree + 1)² harmonics. Each is even or odd under x → −x, y → −y and z → −z (``parity``). If two offsets
differ in signs only, so do the entries of their translations.

Positions are relative to the center of an octree box, in units of its edge h. A multipole q and a local expansion L
represent the potential ψ, H = −∇ψ, of dipoles with moments m,

    4π h² ψ(u) = Σ q_i I_i(u) far away, q_i = m·∇R_i,    4π h² ψ(u) = Σ L_i R_i(u) inside.

Translations between a box and its parent include the factor 2 between their edges. The theorems are from
W. Dehnen, "A fast multipole method for stellar dynamics", Comput. Astrophys. Cosmol. 1 (2014), appendix A.
"""

from functools import cache
from math import factorial

import numpy as np


def count(degree: int) -> int:
    """Return the number K of harmonics up to a degree."""
    return (degree + 1) ** 2


def degrees(degree: int) -> np.ndarray:
    """Return the degree n of each harmonic, shape [K]."""
    return np.repeat(np.arange(degree + 1), 2 * np.arange(degree + 1) + 1)


def orders(degree: int) -> np.ndarray:
    """Return the order m of each harmonic, negative for sin |m|φ, shape [K]."""
    n = degrees(degree)
    return np.arange(count(degree)) - n * n - n


def parity(degree: int) -> np.ndarray:
    """Return the factor ±1 of each harmonic when x, y or z changes its sign, shape [3, K]."""
    n, m = degrees(degree), orders(degree)
    sine = np.where(m < 0, -1, 1)
    odd_order = np.where(m % 2, -1, 1)
    return np.stack([sine * odd_order, sine, np.where((n + m) % 2, -1, 1)])


def regular(degree: int, points) -> np.ndarray:
    """Return the regular harmonics R, polynomials of degree n, shape [n, K], at points [n, 3]."""
    x, y, z = np.asarray(points, np.float64).T
    r2 = x * x + y * y + z * z
    values = np.zeros((count(degree), len(x)))
    sectoral = np.ones(len(x), complex)  # harmonic of degree and order m, with cos mφ + i sin mφ
    for m in range(degree + 1):
        if m > 0:
            sectoral = sectoral * (x + 1j * y) * (1 if m == 1 else np.sqrt((2 * m - 1) / (2 * m)))
        last, before = sectoral, np.zeros_like(sectoral)
        for n in range(m, degree + 1):
            if n > m:
                following = (2 * n - 1) * z * last - np.sqrt((n + m - 1) * (n - m - 1)) * r2 * before
                last, before = following / np.sqrt((n + m) * (n - m)), last
            values[n * n + n - m] = np.imag(last)
            values[n * n + n + m] = np.real(last)
    return values.T.copy()


def irregular(degree: int, points) -> np.ndarray:
    """Return the irregular harmonics I = R/r^(2n + 1), shape [n, K], at points [n, 3] other than the origin."""
    r = np.linalg.norm(np.asarray(points, np.float64), axis=1)
    return regular(degree, points) / r[:, None] ** (2 * degrees(degree) + 1)


@cache
def derivatives(degree: int) -> np.ndarray:
    """Return the matrices D with ∇R_i = Σ_j D[:, i, j] R_j, shape [3, K, K]."""
    size = count(degree)
    mixed = np.zeros((3, size, size), complex)  # ∂x − i∂y, ∂x + i∂y and ∂z of complex harmonics
    n, m = degrees(degree), orders(degree)
    for k, (shift, sign) in enumerate(((-1, 1), (1, -1), (0, 1))):
        i = np.flatnonzero(np.abs(m + shift) < n)
        mixed[k, i, n[i] * n[i] - n[i] + m[i] + shift] = sign
    below, above, along = (_real(matrix, degree) for matrix in mixed)
    return np.real(np.stack([(above + below) / 2, (above - below) / 2j, along]))


def octant_offset(octant: int) -> np.ndarray:
    """Return the vector from a box's center to its child's, in units of the child's edge; octant = x + 2 y + 4 z."""
    return np.array([octant & 1, octant >> 1 & 1, octant >> 2 & 1]) - 0.5


def multipole_to_multipole(degree: int, octant: int) -> np.ndarray:
    """Return the matrix from a child's multipole to its contribution to the parent's, shape [K, K]."""
    shrink = 2.0 ** (1 - degrees(degree))
    return shrink[:, None] * _regular_shift(degree, octant_offset(octant))


def multipole_to_local(degree: int, offsets) -> np.ndarray:
    """Return the matrices from a box's multipole to the local expansion of another box of the same size.

    ``offsets`` are vectors from the multipole's center to the local expansion's, in edges, shape [3] or [n, 3]. Rows of
    the matrices belong to the local expansion, shape [K, K] or [n, K, K].
    """
    offsets = np.asarray(offsets, np.float64)
    values = irregular(2 * degree, offsets.reshape(-1, 3))
    added, subtracted, of_added, of_subtracted = _shift_terms(degree)
    matrices = added * values[:, of_added] + subtracted * values[:, of_subtracted]
    return matrices.reshape(*offsets.shape[:-1], *added.shape)


@cache
def _shift_terms(degree: int) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
    """Return the two terms of each entry of ``multipole_to_local``: factors and indices of harmonics at the offset.

    A complex harmonic V of degree n and order m at d + u is Σ (−1)^k conj(W) V(d). Here W are the regular harmonics of
    degree k and order j at u. V(d) are the harmonics of degree n + k and order m + j at d. The orders ±j give the terms
    m + |j| and m − |j|.
    """
    n, m, sine = degrees(degree), np.abs(orders(degree)), orders(degree) < 0
    k, j, target_sine = n[:, None], m[:, None], sine[:, None]
    has_sine = target_sine != sine  # the harmonic at the offset has a sine
    sum_degree, sum_order, difference = k + n, m + j, np.abs(m - j)
    sign = np.where(k % 2, -1.0, 1.0) * _irregular_scales(degree) / _scales(degree)[:, None]
    added = sign * np.where(target_sine & sine, -1, 1)
    subtracted = sign * np.where(target_sine & ~sine, -1, 1) * np.where(j % 2, -1, 1)
    # a harmonic of negative order m − |j| is (−1)^(m − j) times the conjugate
    subtracted = subtracted * np.where(m < j, np.where(difference % 2, -1, 1) * np.where(has_sine, -1, 1), 1)
    subtracted = np.where((j == 0) | (has_sine & (difference == 0)), 0, subtracted)
    order_sign = np.where(has_sine, -1, 1)
    of_added = sum_degree * sum_degree + sum_degree + order_sign * sum_order
    of_subtracted = sum_degree * sum_degree + sum_degree + order_sign * difference
    scales = _irregular_scales(2 * degree)
    return added / scales[of_added], subtracted / scales[of_subtracted], of_added, of_subtracted


def local_to_local(degree: int, octant: int) -> np.ndarray:
    """Return the matrix from a parent's local expansion to a child's, shape [K, K]."""
    shrink = 2.0 ** (-2 - degrees(degree))
    return (shrink[:, None] * _regular_shift(degree, octant_offset(octant))).T.copy()


def _mirrored(degree: int) -> np.ndarray:
    """Return the index of the harmonic of order −m, shape [K]."""
    n = degrees(degree)
    return n * n + n - orders(degree)


def _scales(degree: int) -> np.ndarray:
    """Return the norm of each real harmonic over the norm of r^n P_n^m/(n + m)! exp(imφ), shape [K]."""
    pairs = zip(degrees(degree).tolist(), np.abs(orders(degree)).tolist(), strict=True)
    return np.array([np.sqrt(float((2 if m else 1) * factorial(n - m) * factorial(n + m))) for n, m in pairs])


def _irregular_scales(degree: int) -> np.ndarray:
    """Return :func:`_scales` for the irregular harmonics, (n − m)! P_n^m/r^(n + 1) exp(imφ)."""
    return np.where(orders(degree) == 0, 1, 2) / _scales(degree)


def _real(matrix: np.ndarray, degree: int) -> np.ndarray:
    """Convert a matrix between complex harmonics to real ones. Complex order −m is (−1)^m times the conjugate of m."""
    m, mirrored, scale = orders(degree), _mirrored(degree), _scales(degree)
    sign = np.where(m % 2, -1, 1)
    # cos is half the sum of the orders m and −m, sin their difference over 2i
    own = np.where(m == 0, scale, np.where(m > 0, scale / 2, sign * scale * 0.5j))
    other = np.where(m == 0, 0, np.where(m > 0, sign * scale / 2, -0.5j * scale))
    rows = own[:, None] * matrix + other[:, None] * matrix[mirrored]
    return (rows * own.conj() + rows[:, mirrored] * other.conj()) * (np.where(m == 0, 1, 2) / scale**2)


def _complex(values: np.ndarray, degree: int) -> np.ndarray:
    """Convert values of real harmonics to complex ones of the same norm, shape [K]."""
    m, mirrored = orders(degree), _mirrored(degree)
    sign = np.where(m % 2, -1, 1)
    return np.where(m < 0, sign * (values[mirrored] - 1j * values), values + np.where(m == 0, 0, 1j) * values[mirrored])


def _regular_shift(degree: int, offset: np.ndarray) -> np.ndarray:
    """Return the matrix A with R_i(u + offset) = Σ_j A[i, j] R_j(u), shape [K, K]."""
    n, m = degrees(degree), orders(degree)
    at_offset = _complex(regular(degree, offset[None, :])[0] / _scales(degree), degree)
    lower, order = n[:, None] - n[None, :], m[:, None] - m[None, :]
    exists = np.abs(order) <= lower
    shifted = np.where(exists, at_offset[np.where(exists, lower * lower + lower + order, 0)], 0)
    return np.real(_real(shifted, degree))
