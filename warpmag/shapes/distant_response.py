"""A few moments that replace an iron body while every source of a field is far from it.

Fields of sources beyond a surface around the body equal fields of charges on that surface. Over the body they vary
slowly: a few combinations of them, F at the cells, span all others up to a tolerance. Let R be the response of the
cells to any field (``demagnetization.py``), and Q = FᵀRF. Moments at few points with the same fields F' there act like
the cells up to the tolerance if their response R' has F'ᵀR'F' = Q. With the pseudoinverse F'⁺ and ε =
:data:`_OTHER_RESPONSE`,

    R' = F'⁺ᵀ Q F'⁺ + ε (1 − F' F'⁺),

with fields and magnetizations times the roots of volumes, so that a uniform magnetization stays uniform. The second
term lets the moments respond to other fields as well, so that R' has an inverse, and the moments follow a magnetization
curve like cells. The tensors between the moments are T = (1/3 − R'⁻¹)/V, since a ball of ideal permeability has the
response 3. The volumes V are chosen so that the mean square of the magnetization is that of the cells
(:func:`_volumes`). Each point is the centroid of a group of cells. The groups are narrower near the ends of the body,
where the charges are.

There are several levels, :data:`FAR_TO_NEAR`: the nearer the surface, the more combinations and points. The number of
points follows from the forces on ball magnets around the body, which act as dipoles. The diameter of each ball equals
its distance from the body. A level has the fewest points with which the largest error of these forces, over several
places and directions, is at most :data:`BALL_ERROR` at its smallest distance. If no number of points suffices, the
distance is larger instead, because the error falls with the third power of the distance or faster. The median error is
a fifth of the largest.
"""

import itertools
import math
from dataclasses import dataclass, replace

import numpy as np

from warpmag.shapes.demagnetization import Coupling, full_tensors, pair_law_tensors
from warpmag.shapes.uniform_response import cell_matrix

FAR_TO_NEAR = 0.6, 0.3, 0.15
"""Smallest distance at which each level is used, from the body's box to the surface of charges, in longest sides of
the box."""
BALL_ERROR = 0.025
"""Largest relative error of the force of a ball magnet at the smallest distance of a level."""
POINT_COUNTS = 8, 9, 12, 16, 20, 25, 36, 49, 64, 81, 100, 125, 144, 196
"""Upper limits of the number of points, tried in this order at each level."""
LEAST_REPLACED_CELLS = 65
"""Smallest number of cells of a body that few moments replace."""
MOST_REPLACED_CELLS = 1000
"""Largest number of cells of bodies that get few moments. More would need a larger matrix than 72 MB."""
_SOURCE_SPACING = 0.75
"""Largest spacing of the charges on the surface, in distances of the surface from the body."""
_LEAST_FIELD = 0.003
"""Smallest singular value of the fields that counts, over the largest, at the cells and at the points."""
_EDGE_WEIGHTS = 0.4, 0.8
"""Weights of Chebyshev spacing in the boundaries between groups of cells, tried in this order: 0 is uniform, 1 is
Chebyshev spacing. In plates the larger one lowers errors 2 to 5 times, but at susceptibilities below 50 errors of the
moment are larger with it."""
_OTHER_RESPONSE = 1.0
"""Response ε to other fields: that of a sheet to a field normal to it."""


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
    coefficients: np.ndarray  # from the moments to the strengths of p fields [A/m], shape [p, 3 k]
    patterns: np.ndarray  # magnetizations of the cells at unit strengths, shape [3, p, n]

    reach: float  # smallest distance of sources from the box [m]


def distant_bodies(body, coupling: Coupling) -> list[DistantBody] | None:
    """Return the few moments of a body at each level, or None if rounding errors leave no positive response.

    A level is left out if it has more than three quarters of the moments of the nearer level, or of the cells.

    Args:
        body: The cells, with ``positions`` [m], ``volumes`` [m³] and ``radii`` [m].
        coupling: Tensors between the cells.
    """
    try:
        bodies = [_fewest_moments(body, response) for response in _responses(body, coupling)]
    except np.linalg.LinAlgError:
        return None
    kept, moments = [], len(body.volumes)
    for few in reversed(bodies):
        if 4 * len(few.volumes) <= 3 * moments:
            kept.append(few)
            moments = len(few.volumes)
    return kept[::-1] or None


@dataclass(frozen=True)
class _Response:
    """Fields of sources at the distance of a level, and the response of the cells, both times the roots of volumes."""

    distance: float  # in longest sides of the body's box
    charges: np.ndarray  # places of the charges, shape [s, 3]
    combinations: np.ndarray  # of their fields, shape [s, p]
    patterns: np.ndarray  # magnetizations of the cells in these combinations F, shape [3 n, p]
    product: np.ndarray  # Q = FᵀRF, shape [p, p]
    uniform: np.ndarray  # magnetizations in unit fields along the axes, shape [3 n, 3]
    balls: np.ndarray  # places of ball magnets, shape [b, 3]
    forces: np.ndarray  # forces on the cells by these balls, magnetized along x, y and z in turn, shape [3, 3 b]


def _responses(body, coupling: Coupling) -> list[_Response]:
    """Return the fields and the responses of the cells at all levels."""
    box = _box(body)
    charges = [_charges(*box, distance) for distance in FAR_TO_NEAR]
    balls = [_ball_places(*box, 1.5 * distance) for distance in FAR_TO_NEAR]
    bases = [_basis(_scaled_fields(body.positions, body.volumes, x)) for x in charges]
    tests = [_Tests.at(x, body.positions, body.volumes) for x in balls]
    fields = [fields for (cells, _), test in zip(bases, tests, strict=True) for fields in (cells, test.fields)]
    fields.append(_uniform_fields(body.volumes))
    ends = np.cumsum([field.shape[1] for field in fields])[:-1]
    *responses, uniform = np.split(_solve(body, coupling, np.hstack(fields)), ends, axis=1)
    return [
        _Response(distance, places, combinations, patterns, cells.T @ patterns, uniform, ball, test.forces(magnetized))
        for distance, places, (cells, combinations), patterns, ball, test, magnetized in zip(
            FAR_TO_NEAR, charges, bases, responses[::2], balls, tests, responses[1::2], strict=True
        )
    ]


@dataclass(frozen=True)
class _Tests:
    """Fields of dipoles at points and their gradients, times the roots of volumes, shapes [3 n, t] and [3 n, 3, t]."""

    fields: np.ndarray
    gradients: np.ndarray

    @classmethod
    def at(cls, places: np.ndarray, points: np.ndarray, volumes: np.ndarray) -> "_Tests":
        """Return the fields of dipoles at ``places`` in the directions of all axes."""
        places, axis = np.repeat(places, 3, axis=0), np.tile(np.arange(3), len(places))
        unit = np.eye(3)
        r = points[:, None] - places
        d, m, along = np.linalg.norm(r, axis=2)[..., None], unit[axis], r[:, np.arange(len(axis)), axis, None]
        fields = 3.0 * r * along / d**5 - m / d**3
        outer = r[..., :, None] * m[:, None] + m[:, :, None] * r[..., None, :] + along[..., None] * unit
        gradients = 3.0 * outer / d[..., None] ** 5 - 15.0 * (along * r / d**7)[..., None] * r[..., None, :]
        root = np.sqrt(volumes)[:, None, None]
        fields, gradients = (root * fields).transpose(0, 2, 1), (root[..., None] * gradients).transpose(0, 2, 3, 1)
        return cls(fields.reshape(-1, len(axis)), gradients.reshape(-1, 3, len(axis)))

    def forces(self, magnetizations: np.ndarray) -> np.ndarray:
        """Return the forces of the dipoles on magnetizations times the roots of volumes, shape [3, t]."""
        return np.einsum("ikt,it->kt", self.gradients, magnetizations)


def _fewest_moments(body, response: _Response) -> DistantBody:
    """Return the fewest moments with an error of at most :data:`BALL_ERROR`, or the most that are tried."""
    counts = [count for count in POINT_COUNTS if count < len(body.volumes)]
    before = None
    for count, edge_weight in itertools.product(counts, _EDGE_WEIGHTS):
        group = _groups(body.positions, count, edge_weight)
        if before is not None and np.array_equal(group, before):
            continue
        before = group
        few, error = _few_moments(body, response, group)
        if error <= BALL_ERROR:
            break
    return replace(few, reach=few.reach * max(1.0, float(np.cbrt(error / BALL_ERROR))))


def _few_moments(body, response: _Response, group: np.ndarray) -> tuple[DistantBody, float]:
    """Return moments in place of the cells, and the largest relative error of a ball's force.

    ``group`` is the group of each cell.
    """
    volumes = body.volumes
    shares = np.bincount(group, volumes)
    points = np.stack([np.bincount(group, volumes * x) for x in body.positions.T], axis=1) / shares[:, None]
    fields = _scaled_fields(points, shares, response.charges) @ response.combinations
    left, values, right = np.linalg.svd(fields, full_matrices=False)
    rank = int((values > _LEAST_FIELD * values[0]).sum())
    left, inverse = left[:, :rank], (right[:rank].T / values[:rank]) @ left[:, :rank].T
    matrix = inverse.T @ response.product @ inverse
    matrix = 0.5 * (matrix + matrix.T) + _OTHER_RESPONSE * (np.eye(len(left)) - left @ left.T)
    inverse_response = np.linalg.inv(matrix)
    finite = np.isfinite(inverse_response).all() and np.isfinite(response.patterns).all()
    if not (finite and np.linalg.eigvalsh(inverse_response)[0] > 0.0):
        raise np.linalg.LinAlgError("rounding leaves no response")  # in wires longer than 1e9 radii
    test = _Tests.at(response.balls, points, shares)
    errors = np.linalg.norm(test.forces(matrix @ test.fields) - response.forces, axis=0)
    root, cell_root = np.repeat(np.sqrt(shares), 3), np.repeat(np.sqrt(volumes), 3)
    patterns = (response.patterns / cell_root[:, None]).reshape(len(volumes), 3, -1)
    lower, upper = _box(body)
    own_volumes = _volumes(shares, matrix @ _uniform_fields(shares), response.uniform)
    few = DistantBody(
        _coupling(points, own_volumes, inverse_response / (root[:, None] * root)), own_volumes, lower, upper,
        coefficients=inverse @ inverse_response / root, patterns=patterns.transpose(1, 2, 0).copy(),
        reach=response.distance * float((upper - lower).max()),
    )  # fmt: skip
    return few, float((errors / np.linalg.norm(response.forces, axis=0)).max())


def _volumes(shares: np.ndarray, few: np.ndarray, cells: np.ndarray) -> np.ndarray:
    """Return the volumes of few moments [m³], with the sum of ``shares`` [m³].

    At a finite susceptibility or near saturation, the solution also depends on the mean square of the magnetization.
    The volumes are interpolated between ``shares`` and those with which all moments have the same magnetization. In
    unit fields along the axes the mean square is then that of the cells, if possible. ``few`` and ``cells`` are the
    magnetizations in these fields times the roots of volumes, which are ``shares`` for few moments, shape [3 n, 3].
    """
    few, volume = few.reshape(-1, 3, 3) * np.sqrt(shares)[:, None, None], shares.sum()
    moments = np.linalg.norm(few.sum(axis=0), axis=0)  # along each axis of the field
    squares = (np.square(few).sum(axis=1) / moments**2).sum(axis=1)  # of the moments, relative
    goal = (np.square(cells).sum(axis=0) * volume / moments**2).sum()
    uniform = volume * np.sqrt(squares) / np.sqrt(squares).sum()
    low, high = 0.0, 1.0
    for _ in range(20):
        weight = 0.5 * (low + high)
        volumes = shares + weight * (uniform - shares)
        low, high = (weight, high) if (squares / volumes).sum() * volume > goal else (low, weight)
    return volumes


def _uniform_fields(volumes: np.ndarray) -> np.ndarray:
    """Return unit fields along the axes, times the roots of volumes, shape [3 n, 3]."""
    return (np.sqrt(volumes)[:, None, None] * np.eye(3)).reshape(-1, 3)


def _charges(lower: np.ndarray, upper: np.ndarray, distance: float) -> np.ndarray:
    """Return points at a distance from a box, in its longest sides, all around it, shape [s, 3]."""
    sides = (upper - lower) / (upper - lower).max() + 2.0 * distance
    return _shell(lower, upper, distance, [1 + math.ceil(side / (_SOURCE_SPACING * distance)) for side in sides])


def _ball_places(lower: np.ndarray, upper: np.ndarray, distance: float) -> np.ndarray:
    """Return points at a distance from the centers of faces and edges of a box and from its corners."""
    return _shell(lower, upper, distance, [3, 3, 3])


def _shell(lower: np.ndarray, upper: np.ndarray, distance: float, counts: list[int]) -> np.ndarray:
    """Return points at a distance from a box, from the surface of a grid of ``counts`` points around it."""
    distance = distance * (upper - lower).max()
    sides = upper - lower + 2.0 * distance
    grid = [np.linspace(-0.5, 0.5, count) * side for count, side in zip(counts, sides, strict=True)]
    points = np.stack(np.meshgrid(*grid, indexing="ij"), axis=-1).reshape(-1, 3)
    points = 0.5 * (lower + upper) + points[(np.abs(points) > 0.499 * sides).any(axis=1)]
    nearest = np.clip(points, lower, upper)
    outward = points - nearest
    return nearest + distance * outward / np.linalg.norm(outward, axis=1)[:, None]


def _scaled_fields(points: np.ndarray, volumes: np.ndarray, charges: np.ndarray) -> np.ndarray:
    """Return the fields r/r³ of charges at points, times the roots of volumes, shape [3 n, charges]."""
    r = points[:, None] - charges
    fields = np.sqrt(volumes)[:, None, None] * r / np.linalg.norm(r, axis=2)[:, :, None] ** 3
    return fields.transpose(0, 2, 1).reshape(3 * len(points), -1)


def _basis(fields: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return the strongest orthogonal combinations of fields, shape [3 n, p], and their coefficients, [fields, p]."""
    norms = np.linalg.norm(fields, axis=0)
    squares, combinations = np.linalg.eigh((fields / norms).T @ (fields / norms))
    combinations = combinations[:, squares > _LEAST_FIELD**2 * squares[-1]] / norms[:, None]
    return fields @ combinations, combinations


def _groups(positions: np.ndarray, most: int, edge_weight: float) -> np.ndarray:
    """Return a number for each cell: that of its group in a grid of at most ``most`` groups.

    Groups at the ends of the grid are narrower if ``edge_weight`` is positive.
    """
    lower, sides = positions.min(axis=0), np.ptp(positions, axis=0)
    sides = np.maximum(sides, 1e-6 * sides.max())
    spacing, counts = sides.max(), np.ones(3, int)
    while True:
        spacing *= 0.98
        finer = np.maximum(np.rint(sides / spacing).astype(int), 1)
        if finer.prod() > most:
            break
        counts = finer
    places = ((positions - lower) / sides).T
    index = [
        np.searchsorted(_group_boundaries(count, edge_weight), x, side="right")
        for count, x in zip(counts, places, strict=True)
    ]
    _, group = np.unique(np.ravel_multi_index(tuple(index), tuple(counts)), return_inverse=True)
    return group.reshape(-1)


def _group_boundaries(count: int, edge_weight: float) -> np.ndarray:
    """Return the places in 0 … 1 between ``count`` groups of cells."""
    equal = np.arange(1, count) / count
    return equal + edge_weight * (0.5 - 0.5 * np.cos(np.pi * equal) - equal)


def _solve(body, coupling: Coupling, fields: np.ndarray) -> np.ndarray:
    """Return the magnetizations of ideally permeable cells in fields, both times √V, shape [3 n, fields]."""
    uniform = _uniform_fields(body.volumes)
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
