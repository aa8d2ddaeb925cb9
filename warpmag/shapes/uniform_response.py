"""How a body answers to an even field and to one of even gradient, from its surface, and what its cells lack for that.

Cells of uniform magnetization take too little moment (``demagnetization.py``): one or two across a sheet or a letter up
to a third. What they take in a field is known at once, by conjugate gradients; what the body takes, if it is ideally
permeable, is known from its surface alone, which is at one potential then: (1/4π) ∫ σ/‖x − y‖ dA = ψ, where ψ is H0·x
in an even field, and the moment is ∫ σ x dA. σ is taken as constant on facets (``facets.py``), whose potentials are
closed forms (Wilton et al., IEEE Trans. Antennas Propag. 32 (1984) 276).

With polarizabilities P of the cells and Q of the surface the operator of the cells N is replaced by N − E C Eᵀ,
C = P⁻¹ − Q⁻¹, E an even field: all cells feel C times the moment of the body on top. By Woodbury's formula the body
then takes Q in an even field; and since Q is positive the operator stays positive, which a change of the cells' own
tensors would not leave it.

The same holds for more fields at once. The columns of E are gradients of harmonic polynomials ψ_k, and P and Q matrices
of what each gives of each, Q_kl = ∫ σ_k ψ_l dA. Beside the three even fields there are five of even gradient, which a
magnet nearby makes most of the rest of: a plate below one lacks 2 to 4 % of the force without them.
"""

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from warpmag.shapes import facets
from warpmag.shapes.ball_pairs import radial_factors
from warpmag.shapes.demagnetization import Coupling, common_fields, full_tensors
from warpmag.shapes.lattice import Lattice
from warpmag.shapes.solids import Solid

FIELDS = 8
"""Fields that all cells of a body may have in common: three even ones and five of even gradient."""

_UNEVEN = 65, 2500
"""Cells of bodies that get the fields of even gradient, too: with fewer they are tensors that are not symmetric, which
bodies that respond as wholes do not know; with more cells lack little, and as many more fields take as much longer."""

FACETS = 600
"""Facets of a body, about; from these and a quarter as many its moment is extrapolated, to 0.3 % for a cube."""

_FACETS_OF_PART = 150
"""The same of each shape, at least: a quarter as many are then the fewest that ``facets.py`` gives."""

MOST_FACETS = 1500
"""A mesh of more triangles is left as its cells are."""

MOST_MOMENTS = 6200
"""A body of more moments is left as its cells are: arrays of their pairs take 0.6 GB."""

_RATIOS = 0.9, 4.0
"""Moments of surfaces over those of cells: others come from surfaces that nearly meet, which facets do not resolve."""

_NEAR = 6.0
"""Distance up to which the potential of a facet is that of its area, in distances from its middle to its corners."""

_ON_EDGE = 1e-15
"""What rounding leaves of r1 + r2 − l on an edge of length l, over r1 + r2; its logarithm there is multiplied by 0."""

_RESIDUAL = 1e-3
"""Relative residual of the cells' magnetization; the error of the moment is its square over the least eigenvalue."""

_MOST_STEPS = 1000
"""Steps of conjugate gradients; rods of 1:10 take some 60."""

_CHUNK = 1 << 18
"""Pairs of facets evaluated at a time (some tens of MB)."""


def corrected(coupling: Coupling, lattice: Lattice, solids: Sequence[Solid]) -> Coupling:
    """The coupling with the fields that all cells have in common, which bring the body's answer to that of its surface.

    Bodies in parts that are apart have none, nor those of which surface or cells are too many, nor two parts in the
    same place, whose facets all lie on each other.
    """
    if len(lattice.volumes) > MOST_MOMENTS or not _hangs_together(coupling):
        return coupling
    most = max(FACETS, _FACETS_OF_PART * len(solids))
    coarse, fine = (facets.of_body(solids, count) for count in (most // 4, most))
    if not len(coarse) or len(fine) > MOST_FACETS:
        return coupling
    of_surface, of_cells = extrapolated_moments(coupling, coarse, fine), cell_moments(coupling, lattice)
    for count in range(len(of_cells), 0, -FIELDS + 3):
        cells, surface = of_cells[:count, :count], of_surface[:count, :count]
        parts = np.linalg.eigvals(np.linalg.solve(surface, cells)).real
        if parts.min() > 1.0 / _RATIOS[1] and parts.max() < 1.0 / _RATIOS[0]:
            common = np.zeros((FIELDS, FIELDS))
            common[:count, :count] = np.linalg.inv(cells) - np.linalg.inv(surface)
            return replace(coupling, common=common)
    return coupling


def common_potentials(places: np.ndarray) -> np.ndarray:
    """Potentials x, y, z, (x² − z²)/2, (y² − z²)/2, xy, xz, yz at places in extents, shape [n, 8]."""
    x, y, z = places.T
    return np.stack([x, y, z, 0.5 * (x * x - z * z), 0.5 * (y * y - z * z), x * y, x * z, y * z], axis=1)


def extrapolated_moments(coupling: Coupling, coarse: np.ndarray, fine: np.ndarray) -> np.ndarray:
    """:func:`surface_moments` for ever more facets, of which the error goes as one over their number."""
    found = surface_moments(coupling, fine)
    if len(fine) < 2 * len(coarse):
        return found
    return found + (found - surface_moments(coupling, coarse)) / (len(fine) / len(coarse) - 1.0)


def surface_moments(coupling: Coupling, surface: np.ndarray) -> np.ndarray:
    """What an ideally permeable body takes of common fields in each of them [m³], in even fields moments, shape [k, k].

    Args:
        coupling: The coupling of its cells, of which the number tells which fields count.
        surface: Its facets [m], shape [m, 4, 3].
    """
    middles, (_, areas) = facets.middles(surface), facets.measures(surface)
    count = _field_count(coupling)
    at = coupling.extent * common_potentials((middles - coupling.centre) / coupling.extent)[:, :count]
    matrix = np.zeros((len(at) + 1, len(at) + 1))
    step = max(1, _CHUNK // len(at))
    for start in range(0, len(at), step):
        matrix[start : min(start + step, len(at)), :-1] = potentials(middles[start : start + step], surface)
    matrix[:-1, -1], matrix[-1, :-1] = 1.0, areas  # the potential of the body is free, its charge is zero
    charges = np.linalg.solve(matrix, np.append(at, np.zeros((1, count)), axis=0))[:-1]
    found = (charges * areas[:, None]).T @ at
    return 0.5 * (found + found.T)


def _field_count(coupling: Coupling) -> int:
    return FIELDS if _UNEVEN[0] <= len(coupling.radii) <= _UNEVEN[1] else 3


def potentials(points: np.ndarray, surface: np.ndarray) -> np.ndarray:
    """(1/4π) ∫ dA/‖x − y‖ of each facet at each point [m], shape [points, facets].

    From afar, where that differs by less than 0.3 %, that of its area in its middle.
    """
    origin = surface.mean(axis=(0, 1))  # about which heights keep their digits
    points, surface = points - origin, surface - origin
    middles, (_, areas) = facets.middles(surface), facets.measures(surface)
    square = _squares(points, middles)
    extent2 = ((surface - middles[:, None]) ** 2).sum(axis=2).max(axis=1)
    near = square < _NEAR**2 * extent2
    square[near] = 1.0
    result = areas / np.sqrt(square)
    result[near] = _near_potentials(points, surface, near)
    return result / (4.0 * np.pi)


def _squares(points: np.ndarray, others: np.ndarray) -> np.ndarray:
    """Squares of the distances between points, shape [points, others]."""
    apart = points[:, None] - others  # the squares of places would lose the digits of small facets far out
    return np.einsum("nmk,nmk->nm", apart, apart)


def _near_potentials(points: np.ndarray, surface: np.ndarray, near: np.ndarray) -> np.ndarray:
    """∫ dA/‖x − y‖ for the pairs of a point and a facet that ``near`` marks.

    Of each edge the distance in the plane from the point times the logarithm of its ends' distances, less the height
    over the plane times the solid angle: that of two triangles (van Oosterom and Strackee 1983), whose scalar triple
    products are heights times areas.
    """
    normals, _ = facets.measures(surface)
    square = [_squares(points, surface[:, k])[near] for k in range(4)]
    away = [np.sqrt(one) for one in square]
    height = np.abs(points @ normals.T - np.einsum("mk,mk->m", normals, surface[:, 0]))[near]
    lengths = np.linalg.norm(np.roll(surface, -1, axis=1) - surface, axis=2)
    diagonals = np.linalg.norm(surface[:, 2] - surface[:, 0], axis=1)
    which = np.broadcast_to(np.arange(len(surface)), near.shape)[near]
    total = np.zeros_like(height)
    for k in range(4):
        side, length = surface[:, (k + 1) % 4] - surface[:, k], lengths[:, k]
        outward = np.cross(side, normals) / np.maximum(length, np.finfo(float).tiny)[:, None]
        across = (np.einsum("mk,mk->m", outward, surface[:, k]) - points @ outward.T)[near]
        both, length = away[k] + away[(k + 1) % 4], length[which]
        total += across * np.log((both + length) / np.maximum(both - length, _ON_EDGE * both))
    turned = np.ones(len(height), complex)
    for k in (1, 2):
        corners = surface[:, 0], surface[:, k], surface[:, k + 1]
        double = np.linalg.norm(np.cross(corners[1] - corners[0], corners[2] - corners[0]), axis=1)[which]
        sides = (lengths[:, 0], lengths[:, 1], diagonals) if k == 1 else (diagonals, lengths[:, 2], lengths[:, 3])
        (a, b, c), (a2, b2, c2) = (away[0], away[k], away[k + 1]), (square[0], square[k], square[k + 1])
        ab, bc, ca = (one[which] ** 2 for one in sides)
        real = a * b * c + 0.5 * ((a2 + b2 - ab) * c + (b2 + c2 - bc) * a + (c2 + a2 - ca) * b)
        turned *= real + 1j * height * double
    return total - 2.0 * height * np.angle(turned)


def cell_moments(coupling: Coupling, lattice: Lattice) -> np.ndarray:
    """The same of the cells of a body, of which those without a coupling are dipoles to each other."""
    apply, root = _operator(coupling, lattice), np.sqrt(lattice.volumes)[:, None, None]
    fields = root * common_fields(coupling.places)[:, :, : _field_count(coupling)]
    found, rest = np.zeros_like(fields), fields
    search, size = rest, (rest**2).sum(axis=(0, 1))
    goal = _RESIDUAL**2 * size
    for _ in range(_MOST_STEPS):
        going = size > goal
        if not going.any():
            break
        image = apply(search)
        step = np.where(going, size / np.where(going, (search * image).sum(axis=(0, 1)), 1.0), 0.0)
        found, rest = found + step * search, rest - step * image
        size, before = (rest**2).sum(axis=(0, 1)), size
        search = rest + np.where(going, size / before, 0.0) * search
    moments = np.einsum("nkl,nkm->lm", found, fields + rest)  # second order in the residual
    return 0.5 * (moments + moments.T)


def _operator(coupling: Coupling, lattice: Lattice):
    """N of the cells, symmetrized by their volumes, as a function of magnetizations, shape [n, 3, fields].

    Of r(r·m), r = x − y, each factor is a sum over y that a product of matrices makes.
    """
    unit, n = float(lattice.radii.max()), len(lattice.volumes)
    x, radii = (lattice.positions - lattice.positions.mean(axis=0)) / unit, lattice.radii / unit
    root, tensors = np.sqrt(lattice.volumes / unit**3), full_tensors(coupling.tensor) * unit**3
    even, odd = np.empty((2, n, n))
    step = max(1, _CHUNK // n)
    for start in range(0, n, step):
        rows = slice(start, start + step)
        apart = np.linalg.norm(x[rows, None] - x, axis=2)
        even[rows], odd[rows] = radial_factors(apart, radii[rows, None], radii)
    even[np.arange(n), np.arange(n)], odd[np.arange(n), np.arange(n)] = -1.0 / radii**3, 0.0

    def apply(scaled: np.ndarray) -> np.ndarray:
        m = scaled * root[:, None, None]
        along = np.einsum("nk,nkf->nf", x, m)
        products = (x[:, k, None, None] * m for k in range(3))
        parts = np.concatenate([m, along[:, None], *products, x[:, :, None] * along[:, None]], axis=1)
        sums = (odd @ parts.reshape(n, -1)).reshape(n, 16, -1)
        inner = np.einsum("nk,nkf->nf", x, sums[:, :3]) - sums[:, 3]
        outer = np.einsum("nklf,nl->nkf", sums[:, 4:13].reshape(n, 3, 3, -1), x) - sums[:, 13:]
        near = (even @ m.reshape(n, -1)).reshape(m.shape)
        field = (near + x[:, :, None] * inner[:, None] - outer) / (4.0 * np.pi)
        field += np.add.reduceat(tensors @ m[coupling.other], coupling.start[:-1], axis=0)
        return -field * root[:, None, None]

    return apply


def _hangs_together(coupling: Coupling) -> bool:
    """Whether each cell is coupled with each other one, over others."""
    group, before = np.arange(len(coupling.start) - 1), None
    while before is None or (group != before).any():
        before, group = group, np.minimum.reduceat(group[coupling.other], coupling.start[:-1])
    return not group.any()
