"""Expansion of a field about a ball's center: sample points, and tables that convert the field there to tensors. NumPy.

With x the position relative to the center, in radii of the ball, a field without sources in the ball is

    4π H = −∇ Σ_l (2l − 1)!!/l! b_l:x^l,

with b_l symmetric and traceless. ``near_contact`` computes the b_l of magnets in closed form. For other sources the b_l
of degrees 1 to 4 are least-squares fits to H at the corners of an icosahedron of radius ``POINT_DEPTH``. So they are
linear in H. The error of b_l by a higher degree l' is the tensor of that degree times ``POINT_DEPTH`` to the power l' −
l.

Derivatives of b_l by the position of the ball are the tensors of the field's derivatives. The energy of a ball with
polarizabilities p_l is −½ (μ0/4π) R³ Σ p_l (2l − 1)!!/l! b_l:b_l. The force on it is (μ0/4π) R³ Σ B_l:∂b_l, with its
response B_l (``near_contact.nonuniform``).
"""

import itertools
from math import comb, factorial, prod

import numpy as np

from warpmag.kernels.shared.native import CHUNK

POINT_DEPTH = 0.4  # distance of the points from the ball's center [radii]
TENSOR_ROWS = 21  # independent components of the tensors of degrees 2 to 4
EXPANSION_ROWS = 4 * TENSOR_ROWS
"""Rows of an expansion: the components, then for each component its derivatives along x, y and z for the force."""
_INDEPENDENT = {
    1: ("x", "y", "z"),
    2: ("xx", "yy", "xy", "yz", "zx"),
    3: ("xxx", "yyy", "xxy", "xxz", "yyx", "yyz", "xyz"),
    4: ("xxxx", "yyyy", "xxyy", "xxxy", "xxxz", "yyyx", "yyyz", "xxyz", "yyzx"),
}
"""Independent components of the tensor of each degree."""


def points() -> np.ndarray:
    """Return the 12 corners of an icosahedron [radii], padded with the last corner, shape [3, CHUNK]."""
    golden = 0.5 * (1.0 + 5.0**0.5)
    corners = [np.roll([0.0, a, b * golden], turn) for turn in range(3) for a, b in itertools.product((1, -1), (1, -1))]
    x = POINT_DEPTH / np.hypot(1.0, golden) * np.array(corners).T
    return np.concatenate([x, np.repeat(x[:, -1:], CHUNK - x.shape[1], axis=1)], axis=1)


def tables() -> np.ndarray:
    """Return the weights of H in each component of b, and of ∂H in the force, shape [TENSOR_ROWS, 2, 3, CHUNK]."""
    x = points()[:, :12]
    parts = [_components(degree) for degree in _INDEPENDENT]
    fields = np.concatenate([-_gradients(x, *part) / (4.0 * np.pi) for part in parts])
    inverse = np.linalg.pinv(fields.reshape(len(fields), -1).T).reshape(-1, 3, 12)
    weights, first = [], 0
    for degree, (powers, basis) in zip(_INDEPENDENT, parts, strict=True):
        rows = inverse[first : first + basis.shape[1]] / (prod(range(1, 2 * degree, 2)) / factorial(degree))
        first += basis.shape[1]
        contraction = basis.T @ (_multiplicities(powers)[:, None] * basis)
        weights.append(np.stack([rows, np.einsum("ab,bck->ack", contraction, rows)], axis=1))
    padded = np.zeros((TENSOR_ROWS, 2, 3, CHUNK))
    padded[..., :12] = np.concatenate(weights[1:])  # without degree 1
    return padded


def _components(degree: int) -> tuple[np.ndarray, np.ndarray]:
    """Return the powers of x, y, z of all components of a degree, and the matrix to them from the independent ones."""
    names = [tuple(name.count(axis) for axis in "xyz") for name in _INDEPENDENT[degree]]
    independent = dict(zip(names, np.eye(len(names)), strict=True))

    def component(i, j, k):
        # the trace is zero
        return independent[i, j, k] if k < 2 else -component(i + 2, j, k - 2) - component(i, j + 2, k - 2)

    powers = [(i, j, degree - i - j) for i in range(degree + 1) for j in range(degree + 1 - i)]
    return np.array(powers), np.array([component(*power) for power in powers])


def _multiplicities(powers: np.ndarray) -> np.ndarray:
    """Return the number of times that each component occurs in a symmetric tensor."""
    return np.array([comb(i + j + k, i) * comb(j + k, j) for i, j, k in powers])


def _gradients(x: np.ndarray, powers: np.ndarray, basis: np.ndarray) -> np.ndarray:
    """Return ∇(C:x^l) at points for each independent component of C, shape [components, 3, points]."""
    gradients = []
    for axis in range(3):
        lower = powers - np.eye(3, dtype=int)[axis]
        values = np.prod(x[None] ** np.maximum(lower, 0)[:, :, None], axis=1) * powers[:, axis, None]
        gradients.append(basis.T @ (_multiplicities(powers)[:, None] * values))
    return np.stack(gradients, axis=1)
