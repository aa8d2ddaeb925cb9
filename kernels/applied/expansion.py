"""How a field is expanded about a ball: points in it, and the tables that turn fields there into multipoles. NumPy.

About the centre, with places x in radii of the ball, a field without sources there is

    4π H = −∇ Σ_l (2l − 1)!!/l! b_l:x^l,

b_l symmetric and traceless: of magnets at ρ those of ``near_contact.uneven``. The b_l of degrees 1 to 4 that fit best
to H at the corners of an icosahedron of radius ``POINT_DEPTH`` are linear in H; a degree above leaves in them its own
part times the power of ``POINT_DEPTH`` by which it is above. Derivatives by the place of the ball are the same of the
field's derivatives. The ball has the energy −½ (μ0/4π) R³ Σ p (2l − 1)!!/l! b_l:b_l, and so (μ0/4π) R³ Σ B_l:∂b_l pulls
it, B_l being its response.
"""

import itertools
from math import comb, factorial, prod

import numpy as np

from warpmag.kernels.shared.native import CHUNK

POINT_DEPTH = 0.4
"""Distance of the points from the ball's centre [radii]."""
TENSOR_ROWS = 21
"""Numbers of degrees 2 to 4, in the order of ``near_contact/uneven.h``."""
EXPANSION_ROWS = 4 * TENSOR_ROWS
"""Those, and for each three more, which the response of the ball times them pulls it by along x, y and z."""
_INDEPENDENT = {
    1: ("x", "y", "z"),
    2: ("xx", "yy", "xy", "yz", "zx"),
    3: ("xxx", "yyy", "xxy", "xxz", "yyx", "yyz", "xyz"),
    4: ("xxxx", "yyyy", "xxyy", "xxxy", "xxxz", "yyyx", "yyyz", "xxyz", "yyzx"),
}


def points() -> np.ndarray:
    """Corners of an icosahedron [radii], the last one again up to ``CHUNK`` of them, shape [3, CHUNK]."""
    golden = 0.5 * (1.0 + 5.0**0.5)
    corners = [np.roll([0.0, a, b * golden], turn) for turn in range(3) for a, b in itertools.product((1, -1), (1, -1))]
    x = POINT_DEPTH / np.hypot(1.0, golden) * np.array(corners).T
    return np.concatenate([x, np.repeat(x[:, -1:], CHUNK - x.shape[1], axis=1)], axis=1)


def tables() -> np.ndarray:
    """What of H at each point makes each number of b, and what of ∂H pulls, shape [TENSOR_ROWS, 2, 3, CHUNK]."""
    x = points()[:, :12]
    parts = [_components(degree) for degree in _INDEPENDENT]
    fields = np.concatenate([-_gradients(x, *part) / (4.0 * np.pi) for part in parts])
    solved = np.linalg.pinv(fields.reshape(len(fields), -1).T).reshape(-1, 3, 12)
    found, first = [], 0
    for degree, (powers, chosen) in zip(_INDEPENDENT, parts, strict=True):
        rows = solved[first : first + chosen.shape[1]] / (prod(range(1, 2 * degree, 2)) / factorial(degree))
        first += chosen.shape[1]
        contraction = chosen.T @ (_multiplicities(powers)[:, None] * chosen)
        found.append(np.stack([rows, np.einsum("ab,bck->ack", contraction, rows)], axis=1))
    whole = np.zeros((TENSOR_ROWS, 2, 3, CHUNK))
    whole[..., :12] = np.concatenate(found[1:])
    return whole


def _components(degree: int) -> tuple[np.ndarray, np.ndarray]:
    """Powers of x, y, z of all components of a degree, and these from the independent ones, traces being zero."""
    names = [tuple(name.count(axis) for axis in "xyz") for name in _INDEPENDENT[degree]]
    known = dict(zip(names, np.eye(len(names)), strict=True))

    def component(i, j, k):
        return known[i, j, k] if k < 2 else -component(i + 2, j, k - 2) - component(i, j + 2, k - 2)

    powers = [(i, j, degree - i - j) for i in range(degree + 1) for j in range(degree + 1 - i)]
    return np.array(powers), np.array([component(*one) for one in powers])


def _multiplicities(powers: np.ndarray) -> np.ndarray:
    """How often each component occurs in a tensor."""
    return np.array([comb(i + j + k, i) * comb(j + k, j) for i, j, k in powers])


def _gradients(x: np.ndarray, powers: np.ndarray, chosen: np.ndarray) -> np.ndarray:
    """Gradient of C:x^l by each independent component of C at places, shape [components, 3, points]."""
    found = []
    for axis in range(3):
        lower = powers - np.eye(3, dtype=int)[axis]
        values = np.prod(x[None] ** np.maximum(lower, 0)[:, :, None], axis=1) * powers[:, axis, None]
        found.append(chosen.T @ (_multiplicities(powers)[:, None] * values))
    return np.stack(found, axis=1)
