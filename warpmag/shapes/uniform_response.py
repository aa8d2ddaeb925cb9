"""Response of a body to uniform fields, from a surface integral, and the correction of its cells.

Without a correction the moment of the cells (``demagnetization.py``, ``linear_cells.py``) is too small: by up to two
thirds with one or two uniform cells across the strokes of a letter, by up to 5 % with linear cells. The response of an
ideally permeable body follows from its surface alone, which is at one potential. In a uniform field H0 its charges σ
obey (1/4π) ∫ σ/‖x − y‖ dA = H0·x + const, and the moment is ∫ σ x dA. The charge σ is constant on facets
(``facets.py``). The potential of a facet is a closed form (Wilton et al., IEEE Trans. Antennas Propag. 32 (1984) 276).
The response of the cells is solved directly, or by conjugate gradients if there are many.

Let P be the polarizability of the cells and Q that of the surface. The correction adds a uniform field of C = P⁻¹ − Q⁻¹
times the moment of the body to all cells. By Woodbury's formula the response to a uniform field becomes Q. Because Q is
positive, the operator stays positive. A change of the cells' own tensors would not ensure that. In a world with n
bodies of cells the correction of each is C/n (:meth:`Coupling.among`), so the response is Q only for n = 1.
"""

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from warpmag.declarations.rotations import rotate
from warpmag.shapes import facets
from warpmag.shapes.ball_pairs import radial_factors
from warpmag.shapes.demagnetization import COMPONENTS, Coupling
from warpmag.shapes.lattice import Lattice
from warpmag.shapes.solids import Solid

FACETS = 600
"""Approximate number of facets of a body. Extrapolation from it and a quarter of it gives a cube's moment to 0.3 %."""
_FACETS_PER_SHAPE = 150
"""Smallest number of facets per shape: a quarter of it is the smallest number that ``facets.py`` makes."""
MOST_FACETS = 1500
"""Largest number of facets. Bodies of more facets, such as meshes of many triangles, are not corrected."""
MOST_MOMENTS = 3000
"""Largest number of moments of a corrected body: arrays over its pairs take 0.15 GB."""
_POLARIZABILITY_RATIOS = 0.9, 4.0
"""Smallest and largest plausible ratio of the polarizabilities of surface and cells. Ratios outside come from
nearly touching surfaces, which facets do not resolve."""
_NEAR_DISTANCE = 6.0
"""Distance up to which a facet's potential is integrated, in distances from its center to its farthest corner."""
_ON_EDGE = 1e-15
"""Relative rounding error of r1 + r2 − l on an edge of length l. It bounds a logarithm multiplied by 0 there."""
_RESIDUAL = 1e-3
"""Relative residual of the cells' magnetization. The moment's error is its square over the smallest eigenvalue."""
_MOST_STEPS = 120
"""Largest number of steps of conjugate gradients; rods of 1:10 take about 60. Bodies that need more, such as wires of
thousands of cells, are not corrected: each step of 3,000 cells takes 0.1 s."""
_MATRIX_CELLS = 1000
"""Largest number of cells whose response is solved directly, with a matrix of 72 MB: exact also for wires, for which
conjugate gradients do not converge. A direct solution takes about 1 s at this number."""
_CHUNK = 1 << 18
"""Pairs of facets evaluated at a time (some tens of MB)."""


def with_surface_response(coupling: Coupling, lattice: Lattice, solids: Sequence[Solid]) -> Coupling:
    """Return the coupling with a common field that gives the body the response of its surface.

    The coupling is returned unchanged if the body has separate parts, or too many facets or cells, or if facets of
    different shapes coincide.
    """
    if len(lattice.volumes) > MOST_MOMENTS or not _is_connected(coupling):
        return coupling
    most = max(FACETS, _FACETS_PER_SHAPE * len(solids))
    coarse, fine = (facets.of_body(solids, count) for count in (most // 4, most))
    if not len(coarse) or len(fine) > MOST_FACETS:
        return coupling
    surface = extrapolated_polarizability(coarse, fine)
    cells = cell_polarizability(coupling, lattice)
    ratios = np.linalg.eigvals(np.linalg.solve(surface, cells)).real
    if ratios.min() > 1.0 / _POLARIZABILITY_RATIOS[1] and ratios.max() < 1.0 / _POLARIZABILITY_RATIOS[0]:
        return replace(coupling, common=np.linalg.inv(cells) - np.linalg.inv(surface))
    return coupling


def extrapolated_polarizability(coarse: np.ndarray, fine: np.ndarray) -> np.ndarray:
    """Return :func:`surface_polarizability`, extrapolated; its error is inversely proportional to the facet count."""
    result = surface_polarizability(fine)
    if len(fine) < 2 * len(coarse):
        return result
    return result + (result - surface_polarizability(coarse)) / (len(fine) / len(coarse) - 1.0)


def surface_polarizability(surface: np.ndarray) -> np.ndarray:
    """Return the polarizability Q [m³] of an ideally permeable body: its moments in uniform fields, shape [3, 3].

    ``surface`` are the facets of the body [m], shape [m, 4, 3].
    """
    centroids, (_, areas) = facets.centroids(surface), facets.normals_and_areas(surface)
    potential = centroids - centroids.mean(axis=0)
    matrix = np.zeros((len(potential) + 1, len(potential) + 1))
    step = max(1, _CHUNK // len(potential))
    for start in range(0, len(potential), step):
        matrix[start : min(start + step, len(potential)), :-1] = potentials(centroids[start : start + step], surface)
    matrix[:-1, -1], matrix[-1, :-1] = 1.0, areas  # unknown potential of the body, total charge zero
    charges = np.linalg.solve(matrix, np.append(potential, np.zeros((1, 3)), axis=0))[:-1]
    result = (charges * areas[:, None]).T @ potential
    return 0.5 * (result + result.T)


def potentials(points: np.ndarray, surface: np.ndarray) -> np.ndarray:
    """Return (1/4π) ∫ dA/‖x − y‖ of each facet at each point [m], shape [points, facets].

    A distant facet counts as its area at its center, with an error below 0.3 %.
    """
    origin = surface.mean(axis=(0, 1))  # near the facets, so that distances from their planes keep their digits
    points, surface = points - origin, surface - origin
    centroids, (_, areas) = facets.centroids(surface), facets.normals_and_areas(surface)
    squares = _squared_distances(points, centroids)
    size2 = ((surface - centroids[:, None]) ** 2).sum(axis=2).max(axis=1)
    near = squares < _NEAR_DISTANCE**2 * size2
    squares[near] = 1.0
    result = areas / np.sqrt(squares)
    result[near] = _near_potentials(points, surface, near)
    return result / (4.0 * np.pi)


def _squared_distances(points: np.ndarray, others: np.ndarray) -> np.ndarray:
    """Return the squared distances between points, shape [points, others]."""
    separation = points[:, None] - others  # x² − 2xy + y² would lose the digits of small facets far from the origin
    return np.einsum("nmk,nmk->nm", separation, separation)


def _near_potentials(points: np.ndarray, surface: np.ndarray, near: np.ndarray) -> np.ndarray:
    """Return ∫ dA/‖x − y‖ for the pairs of a point and a facet that ``near`` marks.

    The integral is a sum over edges, minus the point's height over the plane times the solid angle. The term of an edge
    is its distance from the point's projection times a logarithm of the distances of its ends. The solid angle is the
    sum over two triangles (van Oosterom and Strackee 1983), with scalar triple products of height times area.
    """
    normals, _ = facets.normals_and_areas(surface)
    squares = [_squared_distances(points, surface[:, k])[near] for k in range(4)]
    distances = [np.sqrt(square) for square in squares]
    height = np.abs(points @ normals.T - np.einsum("mk,mk->m", normals, surface[:, 0]))[near]
    lengths = np.linalg.norm(np.roll(surface, -1, axis=1) - surface, axis=2)
    diagonals = np.linalg.norm(surface[:, 2] - surface[:, 0], axis=1)
    facet = np.broadcast_to(np.arange(len(surface)), near.shape)[near]
    total = np.zeros_like(height)
    for k in range(4):
        side, length = surface[:, (k + 1) % 4] - surface[:, k], lengths[:, k]
        outward = np.cross(side, normals) / np.maximum(length, np.finfo(float).tiny)[:, None]
        across = (np.einsum("mk,mk->m", outward, surface[:, k]) - points @ outward.T)[near]
        r1_plus_r2, length = distances[k] + distances[(k + 1) % 4], length[facet]
        total += across * np.log((r1_plus_r2 + length) / np.maximum(r1_plus_r2 - length, _ON_EDGE * r1_plus_r2))
    angle = np.ones(len(height), complex)
    for k in (1, 2):
        corners = surface[:, 0], surface[:, k], surface[:, k + 1]
        double_area = np.linalg.norm(np.cross(corners[1] - corners[0], corners[2] - corners[0]), axis=1)[facet]
        sides = (lengths[:, 0], lengths[:, 1], diagonals) if k == 1 else (diagonals, lengths[:, 2], lengths[:, 3])
        a, b, c = distances[0], distances[k], distances[k + 1]
        a2, b2, c2 = squares[0], squares[k], squares[k + 1]
        ab, bc, ca = (side[facet] ** 2 for side in sides)
        real = a * b * c + 0.5 * ((a2 + b2 - ab) * c + (b2 + c2 - bc) * a + (c2 + a2 - ca) * b)
        angle *= real + 1j * height * double_area
    return total - 2.0 * height * np.angle(angle)


def cell_polarizability(coupling: Coupling, lattice: Lattice) -> np.ndarray:
    """Return the polarizability P [m³] of a body's cells: their moments in uniform fields, shape [3, 3].

    Pairs of cells without an entry in the coupling act on each other as dipoles. Raises ``LinAlgError`` if conjugate
    gradients do not converge.
    """
    fields = np.sqrt(lattice.volumes)[:, None, None] * np.eye(3)
    if len(fields) <= _MATRIX_CELLS:
        columns = fields.reshape(3 * len(fields), -1)
        moments = columns.T @ np.linalg.solve(cell_matrix(coupling, lattice), columns)
    else:
        solution, residual = _conjugate_gradients(_cell_operator(coupling, lattice), fields)
        moments = np.einsum("nkl,nkm->lm", solution, fields + residual)  # second order in the residual
    return 0.5 * (moments + moments.T)


def _conjugate_gradients(apply, fields: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return solutions of N M = H for the operator ``apply`` and ``fields`` H, and the residuals, shape [n, 3, k]."""
    solution, residual = np.zeros_like(fields), fields
    search, squared_norm = residual, (residual**2).sum(axis=(0, 1))
    goal = _RESIDUAL**2 * squared_norm
    for _ in range(_MOST_STEPS):
        unfinished = squared_norm > goal
        if not unfinished.any():
            break
        image = apply(search)
        step = np.where(unfinished, squared_norm / np.where(unfinished, (search * image).sum(axis=(0, 1)), 1.0), 0.0)
        solution, residual = solution + step * search, residual - step * image
        squared_norm, previous = (residual**2).sum(axis=(0, 1)), squared_norm
        search = residual + np.where(unfinished, squared_norm / previous, 0.0) * search
    if (squared_norm > goal).any():
        raise np.linalg.LinAlgError("conjugate gradients do not converge")
    return solution, residual


def _cell_operator(coupling: Coupling, lattice: Lattice):
    """Return the operator N of the cells, symmetrized by their volumes: a function of arrays [n, 3, fields].

    With r = x − y, each term of r(r·m) becomes a sum over y, computed as a product of matrices.
    """
    x, root, isotropic, dipolar, unit = pair_factors(coupling, lattice)
    n, tensors = len(x), _tensors(coupling) * unit**3

    def apply(scaled: np.ndarray) -> np.ndarray:
        m = scaled * root[:, None, None]
        along = np.einsum("nk,nkf->nf", x, m)
        products = (x[:, k, None, None] * m for k in range(3))
        parts = np.concatenate([m, along[:, None], *products, x[:, :, None] * along[:, None]], axis=1)
        sums = (dipolar @ parts.reshape(n, -1)).reshape(n, 16, -1)
        inner = np.einsum("nk,nkf->nf", x, sums[:, :3]) - sums[:, 3]
        outer = np.einsum("nklf,nl->nkf", sums[:, 4:13].reshape(n, 3, 3, -1), x) - sums[:, 13:]
        field = (isotropic @ m.reshape(n, -1)).reshape(m.shape)
        field = (field + x[:, :, None] * inner[:, None] - outer) / (4.0 * np.pi)
        field += np.add.reduceat(tensors @ m[coupling.other], coupling.start[:-1], axis=0)
        return -field * root[:, None, None]

    return apply


def cell_matrix(coupling: Coupling, lattice: Lattice) -> np.ndarray:
    """Return the operator of :func:`_cell_operator` as a matrix, shape [3 n, 3 n]."""
    x, root, isotropic, dipolar, unit = pair_factors(coupling, lattice)
    n, tensors = len(x), _tensors(coupling) * unit**3
    matrix = np.empty((n, 3, n, 3))
    for k, j in zip(*COMPONENTS, strict=True):
        block = dipolar * (x[:, None, k] - x[:, k]) * (x[:, None, j] - x[:, j]) + (isotropic if k == j else 0.0)
        matrix[:, k, :, j] = matrix[:, j, :, k] = block / (4.0 * np.pi)
    matrix[np.repeat(np.arange(n), np.diff(coupling.start)), :, coupling.other] += tensors
    matrix *= -root[:, None, None, None] * root[:, None]
    return matrix.reshape(3 * n, 3 * n)


def _tensors(coupling: Coupling) -> np.ndarray:
    """Return the tensors of the coupling's entries in the frame of the body, shape [entries, 3, 3]."""
    turn = rotate(coupling.grid_rotation[None], np.eye(3)).T
    return turn @ coupling.grid_tensor @ turn.T


def pair_factors(coupling: Coupling, lattice: Lattice) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray, float]:
    """Return positions, roots of volumes, factors of m and of r (r·m) in 4π times the pair sums, and a unit of length.

    The unit is the largest radius [m]. The shapes are [n, 3], [n], [n, n] and [n, n].
    """
    unit, n = float(lattice.radii.max()), len(lattice.volumes)
    x, radii = (lattice.positions - lattice.positions.mean(axis=0)) / unit, lattice.radii / unit
    root = np.sqrt(lattice.volumes / unit**3)
    isotropic, dipolar = np.empty((2, n, n))
    step = max(1, _CHUNK // n)
    for start in range(0, n, step):
        rows = slice(start, start + step)
        distances = np.linalg.norm(x[rows, None] - x, axis=2)
        isotropic[rows], dipolar[rows] = radial_factors(distances, radii[rows, None], radii)
    isotropic[np.arange(n), np.arange(n)], dipolar[np.arange(n), np.arange(n)] = -1.0 / radii**3, 0.0
    return x, root, isotropic, dipolar, unit


def _is_connected(coupling: Coupling) -> bool:
    """Return True if the couplings connect all cells, directly or through other cells."""
    group, before = np.arange(len(coupling.start) - 1), None
    while before is None or (group != before).any():
        before, group = group, np.minimum.reduceat(group[coupling.other], coupling.start[:-1])
    return not group.any()
