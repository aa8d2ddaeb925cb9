"""Few moments that replace a body of iron while every source of a field is far from it.

The potential of sources outside of a sphere around the body is a sum of harmonic polynomials there. Their share in the
force falls off as (a/d)^l with the degree l, the size a of the body, and the distance d. Let F be the gradients of the
polynomials up to a degree at the cells, R the response of the cells to any field (``demagnetization.py``), and
Q = FᵀRF. Moments at few points with the gradients E there act like the cells up to that degree if their response P has
EᵀPE = Q. With the pseudoinverse E⁺,

    P = E⁺ᵀ Q E⁺ + ε (1 − E E⁺),

with fields and magnetizations times the roots of volumes, so that a uniform magnetization stays uniform. The second
term lets the moments respond to other fields as well, so that P has an inverse: the moments follow a magnetization
curve like cells. Their own field is T = (1/3 − P⁻¹)/V, since a ball of ideal permeability has the response 3. The
points are means of cells, so that they are inside the body.

With degree 4 and up to 27 points the force of a dipole differs by up to 1 % from that on the cells, at
:data:`DISTANT_REACH` (``tests/test_distant_bodies.py``). Degree 2, the dipole and the quadrupole, leaves up to 10 %
there: the moment that a field of degree 3 induces acts as much as the quadrupole.
"""

from dataclasses import dataclass

import numpy as np

from warpmag.shapes.demagnetization import Coupling, full_tensors, pair_law_tensors
from warpmag.shapes.uniform_response import cell_matrix

DISTANT_REACH = 3.0
"""Smallest distance of sources from the body's box, in halves of its longest side."""
MOST_POINTS = 27
"""Largest number of moments: 3 × 3 × 3 in a cube, 5 × 5 in a plate."""
LEAST_REPLACED_CELLS = 65
"""Smallest number of cells of a body that few moments replace."""
MOST_REPLACED_CELLS = 1000
"""Largest number of cells of bodies that get few moments. More would need a larger matrix than 72 MB."""
_DEGREE = 4
_LEAST_GRADIENT = 0.01
"""Least singular value of E over that of the cells: polynomials that vary less over the points get no response."""
_OTHER_RESPONSE = 1.0
"""Response ε to other fields: that of a sheet across itself."""


@dataclass(frozen=True)
class DistantCoupling(Coupling):
    """Coupling of few moments that replace a body; they have no near field."""

    differences: np.ndarray  # tensors of all pairs less those of the pair law [1/m³], shape [k², 3, 3]

    near = False

    @property
    def grid_tensor(self) -> np.ndarray:
        """Tensors of the entries, as :attr:`Coupling.grid_tensor`."""
        return self.differences


@dataclass(frozen=True)
class DistantBody:
    """Few moments of a body of n cells, in its frame."""

    coupling: DistantCoupling  # the k moments
    volumes: np.ndarray  # [m³], shape [k]
    lower: np.ndarray  # corners of a box around the cells [m], shape [3]
    upper: np.ndarray
    coefficients: np.ndarray  # from the moments to the strengths of p polynomials [A/m], shape [p, 3 k]
    patterns: np.ndarray  # magnetizations of the cells at unit strengths, shape [3, p, n]

    @property
    def reach(self) -> float:
        """Smallest distance of sources from the box [m]."""
        return DISTANT_REACH * 0.5 * float((self.upper - self.lower).max())


def distant_body(body, coupling: Coupling) -> DistantBody | None:
    """Return the few moments of a body, or None if rounding leaves no response.

    Args:
        body: The cells, with ``positions`` [m], ``volumes`` [m³] and ``radii`` [m].
        coupling: Tensors between the cells.
    """
    volumes, center, extent = body.volumes, coupling.center, coupling.extent
    part = _parts(body.positions)
    shares = np.bincount(part, volumes)
    points = np.stack([np.bincount(part, volumes * x) for x in body.positions.T], axis=1) / shares[:, None]
    cells, few = (_scaled_fields((x - center) / extent, v) for x, v in ((body.positions, volumes), (points, shares)))
    norms = np.linalg.norm(cells, axis=0)
    norms[norms == 0.0] = 1.0  # a wire has polynomials that vanish along it
    try:
        patterns = _solve(body, coupling, cells / norms)
        left, values, right = np.linalg.svd(few / norms, full_matrices=False)
        rank = int((values > _LEAST_GRADIENT * values[0]).sum())
        left, inverse = left[:, :rank], (right[:rank].T / values[:rank]) @ left[:, :rank].T
        response = inverse.T @ (cells / norms).T @ patterns @ inverse
        other = _OTHER_RESPONSE * (np.eye(len(left)) - left @ left.T)
        inverse_response = np.linalg.inv(0.5 * (response + response.T) + other)
    except np.linalg.LinAlgError:
        return None
    if not (
        np.isfinite(inverse_response).all()
        and np.isfinite(patterns).all()
        and np.linalg.eigvalsh(inverse_response)[0] > 0.0
    ):
        return None  # cells of wires of lengths beyond 1e9 radii
    root, cell_root = np.repeat(np.sqrt(shares), 3), np.repeat(np.sqrt(volumes), 3)
    patterns = (patterns / cell_root[:, None]).reshape(len(volumes), 3, -1)
    return DistantBody(
        _coupling(points, shares, inverse_response / (root[:, None] * root)), shares, *_box(body),
        coefficients=inverse @ inverse_response / root, patterns=patterns.transpose(1, 2, 0).copy(),
    )  # fmt: skip


def _scaled_fields(points: np.ndarray, volumes: np.ndarray) -> np.ndarray:
    """Return :func:`harmonic_fields` times the roots of volumes, shape [3 n, 24]."""
    return (np.sqrt(volumes)[:, None, None] * harmonic_fields(points)).reshape(3 * len(points), -1)


def harmonic_fields(points: np.ndarray) -> np.ndarray:
    """Return gradients of harmonic polynomials up to degree 4 at points, shape [n, 3, 24].

    The polynomials of degree l are a basis of the kernel of the Laplace operator among all polynomials of that degree.
    """
    fields = [np.broadcast_to(np.eye(3), (len(points), 3, 3))]
    for degree in range(2, _DEGREE + 1):
        powers, lower = _powers(degree), _powers(degree - 2)
        laplacian = np.zeros((len(lower), len(powers)))
        gradients = np.zeros((len(points), 3, len(powers)))
        for column, power in enumerate(powers):
            for axis in range(3):
                once, twice = power - np.eye(3, dtype=int)[axis], power - 2 * np.eye(3, dtype=int)[axis]
                if once[axis] >= 0:
                    gradients[:, axis, column] = power[axis] * np.prod(points**once, axis=1)
                if twice[axis] >= 0:
                    row = int(np.flatnonzero((lower == twice).all(axis=1))[0])
                    laplacian[row, column] += power[axis] * once[axis]
        basis = np.linalg.svd(laplacian)[2][len(lower) :]
        fields.append(gradients @ basis.T)
    return np.concatenate(fields, axis=2)


def _powers(degree: int) -> np.ndarray:
    """Return the powers of x, y and z of all monomials of a degree, shape [m, 3]."""
    return np.array([(i, j, degree - i - j) for i in range(degree + 1) for j in range(degree + 1 - i)])


def _parts(positions: np.ndarray) -> np.ndarray:
    """Return a number for each cell: that of its box in a grid of at most ``MOST_POINTS`` boxes, nearly cubes."""
    lower, sides = positions.min(axis=0), np.ptp(positions, axis=0)
    sides = np.maximum(sides, 1e-6 * sides.max())
    spacing, counts = sides.max(), np.ones(3, int)
    while True:
        spacing *= 0.98
        finer = np.maximum(np.rint(sides / spacing).astype(int), 1)
        if finer.prod() > MOST_POINTS:
            break
        counts = finer
    index = np.minimum(((positions - lower) / sides * counts).astype(int), counts - 1)
    _, part = np.unique(np.ravel_multi_index(tuple(index.T), tuple(counts)), return_inverse=True)
    return part.reshape(-1)


def _solve(body, coupling: Coupling, fields: np.ndarray) -> np.ndarray:
    """Return the magnetizations of ideally permeable cells in fields, both times √V, shape [3 n, fields]."""
    uniform = (np.sqrt(body.volumes)[:, None, None] * np.eye(3)).reshape(-1, 3)
    return np.linalg.solve(cell_matrix(coupling, body) - uniform @ coupling.common @ uniform.T, fields)


def _box(body) -> tuple[np.ndarray, np.ndarray]:
    """Return the corners of a box around the balls of the cells [m]."""
    radii = body.radii[:, None]
    return (body.positions - radii).min(axis=0), (body.positions + radii).max(axis=0)


def _coupling(points: np.ndarray, volumes: np.ndarray, inverse_response: np.ndarray) -> DistantCoupling:
    """Return the coupling of moments at points from their inverse response [1/m³], shape [3 k, 3 k]."""
    k, radii = len(points), np.cbrt(0.75 * volumes / np.pi)
    full = np.diag(np.repeat(1.0 / (3.0 * volumes), 3)) - inverse_response
    law = full_tensors(pair_law_tensors(points, radii).reshape(-1, 6)).reshape(k, k, 3, 3)
    differences = full.reshape(k, 3, k, 3).transpose(0, 2, 1, 3) - law
    sides = np.repeat(np.cbrt(volumes)[:, None], 3, axis=1)
    return DistantCoupling(
        k * np.arange(k + 1), np.tile(np.arange(k), k), np.zeros((k * k, 6)), np.zeros((3, 3)), points, radii,
        0.5 * sides, np.zeros((k, 6), bool), sides.max(axis=0), np.array([0.0, 0.0, 0.0, 1.0]), None,
        differences.reshape(-1, 3, 3),
    )  # fmt: skip
