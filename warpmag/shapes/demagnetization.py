"""Demagnetizing tensors of the cells that a solid is divided into.

A lattice (``lattice.py``) divides a solid into cells, each uniformly magnetized. Averaged over each other, they make an
operator H_i = −Σ_j N_ij M_j that is symmetric and positive, with eigenvalues between 0 and 1: it is the true one
restricted to such magnetizations. Ellipsoids are therefore exact up to rounding of their shape, and anything else comes
out a little too stiff: a cube of 9³ cells and χ = ∞ takes a moment of 3.58 V H0 of 3.64 V H0.

The tensor of two equal cuboids on one grid is that of Newell, Williams and Dunlop, "A generalization of the
demagnetizing tensor for nonuniform magnetization" (1993), Eqs. 27, 28 and 32. Where a surface cuts a cell, only what
lies inside counts: cells are resolved by a grid of subcells, and their tensors added up. That is what makes curved
bodies right: of whole cells, which leave steps, a sphere takes 10 % too much however fine they are.

The sums over all pairs already give each pair of cells as two balls (``kernels/pairs/pair_law.py``). A coupling is what
is to be added to that: for cells nearer than :data:`EXACT_REACH` the exact tensor less that of the balls, and for a
cell itself less the 1/3 that the magnetization law of a ball contains.
"""

from dataclasses import dataclass
from functools import cached_property

import numpy as np

from warpmag.shapes.ball_pairs import radial_factors
from warpmag.shapes.lattice import Lattice, Pieces, grid

EXACT_REACH = 3.0
"""Distance up to which two cells of a body are exact, in longest sides of its cells (see ``tests/test_cells.py``)."""

_SUBCELLS = 8
"""Subcells that resolve a cell which the surface cuts, along each axis, at most."""

_FAR_SUBCELLS = 4
"""The same for cells that do not touch."""

_FAR = 4.0
"""Distance up to which moments lack more than a dipole, in :data:`EXACT_REACH`."""

_WIDEST = 0.15
"""Norm of a moment's second moments that counts, at most, in squares of a cell's longest side; two cells have 0.2."""

PLACES = np.array([0, 1, 2, 0, 0, 1]), np.array([0, 1, 2, 1, 2, 2])
"""Rows and columns of the six numbers of a symmetric tensor: xx, yy, zz, xy, xz, yz."""

_STEPS = 20
"""Steps of Lanczos's iteration, at most; the largest eigenvalue is right to 3 % then."""

_BATCH = 1 << 22
"""Numbers in a temporary array (tens of MB)."""


@dataclass(frozen=True)
class Coupling:
    """What the pair sums lack between moments of one body, in its frame: H_i += Σ T_ij m_j.

    Attributes:
        start: First entry of each moment, and the end, shape [n + 1].
        other: Moment j of each entry, ascending, shape [entries].
        tensor: T_ij [1/m³], xx, yy, zz, xy, xz, yz, shape [entries, 6].
        common: What moments make of fields that they all have in common (``even_field.py``): of amounts Σ E_i^T m_i the
            strengths of these fields [1/m³], shape [8, 8].
        positions: Where the moments are [m], shape [n, 3].
        radii: Radii of their balls [m], shape [n].
    """

    start: np.ndarray
    other: np.ndarray
    tensor: np.ndarray
    common: np.ndarray
    positions: np.ndarray
    radii: np.ndarray

    @cached_property
    def centre(self) -> np.ndarray:
        """Mean of the positions [m], shape [3]."""
        return self.positions.mean(axis=0)

    @cached_property
    def extent(self) -> float:
        """Largest distance from there [m], or the radius if there is but one moment."""
        return float(np.linalg.norm(self.positions - self.centre, axis=1).max()) or float(self.radii.max())

    @property
    def places(self) -> np.ndarray:
        """Positions about their mean in extents, shape [n, 3]."""
        return (self.positions - self.centre) / self.extent

    @cached_property
    def hardening(self) -> float:
        """Demagnetizing factor that the moments lack to be as hard as balls in their places [dimensionless].

        The largest eigenvalue of √V_i T_ij √V_j, with the common fields, by Lanczos's iteration with all vectors kept.
        """
        root = np.sqrt(4.0 / 3.0 * np.pi * self.radii**3)[:, None]
        near, common = full_tensors(self.tensor), common_fields(self.places)

        def apply(m):
            m = root * m.reshape(-1, 3)
            sums = np.add.reduceat((near @ m[self.other, :, None])[..., 0], self.start[:-1], axis=0)
            return (root * (sums + common @ (self.common @ np.einsum("nkl,nk->l", common, m)))).ravel()

        basis = np.random.default_rng(0).normal(size=(1, 3 * len(root)))
        basis /= np.linalg.norm(basis)
        images = np.empty((0, basis.shape[1]))
        while len(images) < min(_STEPS, basis.shape[1]):
            images = np.append(images, [apply(basis[-1])], axis=0)
            rest = images[-1] - (basis @ images[-1]) @ basis
            rest -= (basis @ rest) @ basis
            size = np.linalg.norm(rest)
            if size < 1e-9 * np.linalg.norm(images[0]):
                break
            basis = np.append(basis, [rest / size], axis=0)
        return max(0.0, float(np.linalg.eigvalsh(basis[: len(images)] @ images.T)[-1]))

    @cached_property
    def dense(self) -> np.ndarray:
        """Tensors between all moments [1/m³], whole ones, and those of the pair sums, shape [2, n, n, 6].

        Only for moments without common fields but the even ones: other tensors are not symmetric.
        """
        n = len(self.radii)
        i, j = np.divmod(np.arange(n * n), n)
        law = _pair_law(self.positions[i] - self.positions[j], self.radii[i], self.radii[j], i == j)
        law[i == j] = 0.0  # a ball's own field is in its curve
        whole = law.reshape(n, n, 6).copy()
        whole[np.repeat(np.arange(n), np.diff(self.start)), self.other] += self.tensor
        whole += self.common[PLACES]
        return np.stack([whole, law.reshape(n, n, 6)])


def cuboid_tensors(offsets: np.ndarray, sides: np.ndarray) -> np.ndarray:
    """Demagnetizing tensors of equal cuboids, one averaged over the other (Newell, Williams and Dunlop 1993).

    Args:
        offsets: From one centre to the other in sides, whole numbers, shape [n, 3].
        sides: Sides of the cuboids, shape [3].

    Returns:
        N, xx, yy, zz, xy, xz, yz, of H = −N M, shape [n, 6].
    """
    offsets = np.asarray(offsets).astype(int)
    signs, places = np.where(offsets < 0, -1.0, 1.0), np.abs(offsets)
    total = _tensor_table(places.max(axis=0, initial=0) + 1, sides)[tuple(places.T)]
    total[:, 3:] *= signs[:, [0, 0, 1]] * signs[:, [1, 2, 2]]
    return total


def _tensor_table(counts: np.ndarray, sides: np.ndarray) -> np.ndarray:
    """:func:`cuboid_tensors` of all offsets from 0 on, ``counts`` along each axis, shape [a, b, c, 6]."""
    unit = np.asarray(sides, float) / np.max(sides)
    x, y, z = np.ix_(*(step * np.arange(-1, count + 1) for step, count in zip(unit, counts, strict=True)))
    parts = (
        _diagonal(x, y, z),
        _diagonal(y, x, z),
        _diagonal(z, y, x),
        _mixed(x, y, z),
        _mixed(x, z, y),
        _mixed(y, z, x),
    )
    total = np.stack(parts)
    for _ in range(3):  # second differences along each axis
        total = np.moveaxis(2.0 * total[:, 1:-1] - total[:, :-2] - total[:, 2:], 1, 3)
    return np.moveaxis(total, 0, 3) / (4.0 * np.pi * unit.prod())


def _diagonal(x, y, z):
    """f of Newell, Williams and Dunlop, Eq. 27, without terms that cancel."""
    x, y, z = np.abs(x), np.abs(y), np.abs(z)
    r = np.sqrt(x * x + y * y + z * z)
    return (
        0.5 * y * (z * z - x * x) * _arsinh(y, np.hypot(x, z))
        + 0.5 * z * (y * y - x * x) * _arsinh(z, np.hypot(x, y))
        - x * y * z * np.arctan2(y * z, x * r)
        + (2.0 * x * x - y * y - z * z) * r / 6.0
    )


def _mixed(x, y, z):
    """g of Newell, Williams and Dunlop, Eq. 32."""
    r = np.sqrt(x * x + y * y + z * z)
    return (
        x * y * z * _arsinh(z, np.hypot(x, y))
        + y * (3.0 * z * z - y * y) / 6.0 * _arsinh(x, np.hypot(y, z))
        + x * (3.0 * z * z - x * x) / 6.0 * _arsinh(y, np.hypot(x, z))
        - z**3 / 6.0 * _arctan(x * y, z * r)
        - 0.5 * z * y * y * _arctan(x * z, y * r)
        - 0.5 * z * x * x * _arctan(y * z, x * r)
        - x * y * r / 3.0
    )


def _arsinh(a, b):
    """Inverse hyperbolic sine of a/b; what multiplies it vanishes with b."""
    return np.where(b > 0.0, np.arcsinh(a / np.where(b > 0.0, b, 1.0)), 0.0)


def _arctan(a, b):
    """Inverse tangent of a/b; what multiplies it vanishes with b."""
    return np.where(b != 0.0, np.arctan(a / np.where(b != 0.0, b, 1.0)), 0.0)


def coupling(lattice: Lattice, radii: np.ndarray, reach: float = EXACT_REACH) -> Coupling:
    """What the pair sums lack between the moments of one body.

    Args:
        lattice: Its moments with their cells. Moments in cells of different grids are left to the pair sums.
        radii: Radii of the balls that the pair sums take them for [m], shape [n].
        reach: Distance up to which pairs are exact, in longest sides of the cells.
    """
    x, volumes = lattice.positions, lattice.volumes
    entries, tensors = [np.empty((2, 0), int)], [np.empty((0, 6))]
    for part in lattice.pieces:
        (i, j), exact = _part_tensors(part, lattice, reach)
        entries.append(np.stack([i, j]))
        exact = -exact / np.sqrt(volumes[i] * volumes[j])[:, None]
        tensors.append(exact - _pair_law(x[i] - x[j], radii[i], radii[j], i == j))
    (i, j), tensor = np.concatenate(entries, axis=1), np.concatenate(tensors)
    order = np.lexsort((j, i))
    start = np.searchsorted(i[order], np.arange(len(volumes) + 1))
    return Coupling(start, j[order], tensor[order], np.zeros((8, 8)), x, radii)


def _pair_law(r, a, b, same):
    """H = T m of the pair sums, in six numbers [1/m³]; of a moment itself −M/3, which the curve of a ball contains."""
    g1, g2 = radial_factors(np.linalg.norm(r, axis=1), a, b)
    g1, g2 = np.where(same, -1.0 / a**3, g1), np.where(same, 0.0, g2)
    products = r[:, PLACES[0]] * r[:, PLACES[1]]
    return (g1[:, None] * np.array([1.0, 1.0, 1.0, 0.0, 0.0, 0.0]) + g2[:, None] * products) / (4.0 * np.pi)


def _part_tensors(part: Pieces, lattice: Lattice, reach: float) -> tuple[np.ndarray, np.ndarray]:
    """Pairs (i, j) of near moments of one grid, shape [2, pairs], and N_ij √(V_i V_j) over V in six numbers."""
    first, count = int(part.moment.min()), len(np.unique(part.moment))
    local = (lattice.positions[first : first + count] - part.position) @ part.rotation
    reach = reach * float(part.sides.max())
    i, j = _near_pairs(local, reach)
    volume = np.bincount(part.moment - first, part.share * part.filled.mean(axis=(1, 2, 3))[part.piece], count)
    order = np.argsort(part.moment, kind="stable")
    piece, share = part.piece[order], part.share[order]
    begin = np.searchsorted(part.moment[order] - first, np.arange(count + 1))
    held = np.diff(begin)
    # every pair of pieces of a pair of moments
    pairs = held[i] * held[j]
    pair = np.repeat(np.arange(len(i)), pairs)
    rank = np.arange(len(pair)) - np.repeat(np.cumsum(pairs) - pairs, pairs)
    a, b = begin[i[pair]] + rank // held[j[pair]], begin[j[pair]] + rank % held[j[pair]]
    p, q = piece[a], piece[b]
    key, which = np.unique(np.minimum(p, q) * len(part.index) + np.maximum(p, q), return_inverse=True)
    values = _piece_tensors(part, key // len(part.index), key % len(part.index))[which]
    weight = share[a] * share[b]
    sums = np.stack([np.bincount(pair, weight * values[:, c], len(i)) for c in range(6)], axis=1)
    sums /= np.sqrt(volume[i] * volume[j])[:, None]
    sums[i == j] += _lack_from_afar(local, part.sides.prod() * volume, _spreads(part, first, volume), reach)[i[i == j]]
    both = i != j
    pairs = np.concatenate([np.stack([i, j]), np.stack([j[both], i[both]])], axis=1) + first
    return pairs, _turned(np.concatenate([sums, sums[both]]), part.rotation)


def _spreads(part: Pieces, first: int, volume: np.ndarray) -> np.ndarray:
    """Second moments of each moment's pieces about their centroid, over volume, less their trace, shape [n, 3, 3]."""
    split = np.array(part.filled.shape[1:])
    points, weights = (grid(split) + 0.5) / split * part.sides, part.filled.reshape(len(part.filled), -1) / split.prod()
    corner, held = part.index * part.sides, weights.sum(axis=1)[:, None]
    ones = weights @ points
    twos = np.stack([weights @ (points[:, [k]] * points) for k in range(3)], axis=1)
    twos += held[..., None] * np.diag((part.sides / split) ** 2 / 12.0)
    twos += ones[:, :, None] * corner[:, None] + corner[:, :, None] * (ones + held * corner)[:, None]
    ones += held * corner
    sums = np.concatenate([ones, twos.reshape(-1, 9)], axis=1)[part.piece] * part.share[:, None]
    sums = np.stack([np.bincount(part.moment - first, x, len(volume)) for x in sums.T], axis=1) / volume[:, None]
    centre = sums[:, :3]
    spread = sums[:, 3:].reshape(-1, 3, 3) - centre[:, :, None] * centre[:, None]
    spread -= np.trace(spread, axis1=1, axis2=2)[:, None, None] * np.eye(3) / 3.0
    size, most = np.linalg.norm(spread, axis=(1, 2)), _WIDEST * part.sides.max() ** 2
    return spread * np.minimum(1.0, most / np.maximum(size, np.finfo(float).tiny))[:, None, None]


def _lack_from_afar(points: np.ndarray, volumes: np.ndarray, spreads: np.ndarray, reach: float) -> np.ndarray:
    """What moments beyond the reach lack as dipoles, if they are magnetized as the one that they act on, shape [n, 6].

    It falls off with the fifth power of the distance, and is taken up to ``_FAR`` times the reach. What would make the
    operator softer is left out, which thin plates with flat cells would not stay positive with.
    """
    total = np.zeros((6, len(points)))
    if np.abs(spreads).max() < 1e-9 * reach * reach:  # of cubes
        return total.T
    pairs = np.stack(_near_pairs(points, _FAR * reach))
    step = _BATCH // 64
    for start in range(0, pairs.shape[1], step):
        i, j = pairs[:, start : start + step]
        r = points[i] - points[j]
        square = (r * r).sum(axis=1)
        far = square > reach * reach * (1.0 + 1e-9)
        i, j, r, d = i[far], j[far], r[far], np.sqrt(square[far])[:, None]
        spread = spreads[i] + spreads[j]
        turned = np.einsum("nkl,nl->nk", spread, r)
        along = (turned * r).sum(axis=1)[:, None]
        rows, columns = PLACES
        mixed = r[:, rows] * turned[:, columns] + turned[:, rows] * r[:, columns]
        one = np.array([1.0, 1.0, 1.0, 0.0, 0.0, 0.0])
        found = 105.0 * along * r[:, rows] * r[:, columns] / d**9 - 15.0 * (along * one + 2.0 * mixed) / d**7
        found = (found + 6.0 * spread[:, rows, columns] / d**5) / (-8.0 * np.pi)
        for k in range(6):
            total[k] += np.bincount(i, volumes[j] * found[:, k], len(points))
            total[k] += np.bincount(j, volumes[i] * found[:, k], len(points))
    values, vectors = np.linalg.eigh(full_tensors(total.T))
    stiffer = (vectors * np.maximum(values, 0.0)[:, None]) @ np.swapaxes(vectors, 1, 2)
    return stiffer[:, *PLACES]


def _near_pairs(points: np.ndarray, reach: float) -> tuple[np.ndarray, np.ndarray]:
    """Pairs i ≤ j of points not farther apart than ``reach``."""
    found = []
    step = max(1, _BATCH // max(1, 3 * len(points)))
    for begin in range(0, len(points), step):
        apart = points[begin : begin + step, None] - points
        i, j = np.nonzero((apart**2).sum(axis=2) <= reach * reach * (1.0 + 1e-9))
        found.append(np.stack([i + begin, j]))
    i, j = np.concatenate(found, axis=1)
    return i[i <= j], j[i <= j]


def _piece_tensors(part: Pieces, p: np.ndarray, q: np.ndarray) -> np.ndarray:
    """∫∫ over two pieces of cells, over the volume of a cell, of the demagnetizing kernel, shape [pairs, 6]."""
    apart = part.index[p] - part.index[q]
    full = part.filled.min(axis=(1, 2, 3)) == 1.0
    whole, touching = full[p] & full[q], (np.abs(apart) <= 1).all(axis=1)
    near, far = np.flatnonzero(~whole & touching), np.flatnonzero(~whole & ~touching)
    result = np.empty((len(p), 6))
    offsets, which = np.unique(apart[whole], axis=0, return_inverse=True)
    result[whole] = cuboid_tensors(offsets, part.sides)[which.reshape(-1)]
    if len(near):
        filled = _sharp(_coarser(part.filled, _SUBCELLS))
        result[near] = _cut_tensors(part.sides, filled, p[near], q[near], apart[near])
    if len(far):
        result[far] = _cut_tensors(part.sides, _coarser(part.filled, _FAR_SUBCELLS), p[far], q[far], apart[far])
    return result


def _cut_tensors(sides: np.ndarray, filled: np.ndarray, p, q, apart) -> np.ndarray:
    """The same for pieces that are cut, from the tensors of their subcells.

    The sum over pairs of subcells is one of tensors times the correlation of what is filled, taken in Fourier's space.
    """
    split = np.array(filled.shape[1:])
    reach = (np.abs(apart).max(axis=0) + 1) * split
    table = _tensor_table(reach, sides / split)
    period, size = tuple(2 * split), len(filled)
    filled = np.fft.rfftn(filled, period, axes=(1, 2, 3))
    twice = np.where(np.arange(split[2] + 1) % split[2] == 0, 1.0, 2.0)  # other halves of the spectrum are conjugate
    twice = np.broadcast_to(twice, filled.shape[1:]).reshape(-1)
    filled = filled.reshape(size, -1)
    between = (grid(2 * split) + split) % (2 * split) - split
    valid = np.all(between > -split, axis=1)
    result = np.empty((len(p), 6))
    offsets, which = np.unique(apart, axis=0, return_inverse=True)
    order = np.argsort(which.reshape(-1), kind="stable")
    ends = np.append(0, np.cumsum(np.bincount(which.reshape(-1))))
    for k, offset in enumerate(offsets):
        steps = offset * split + between
        tensors = np.where(valid[:, None], table[tuple(np.minimum(np.abs(steps), reach - 1).T)], 0.0)
        signs = np.where(steps < 0, -1.0, 1.0)
        tensors[:, 3:] *= signs[:, [0, 0, 1]] * signs[:, [1, 2, 2]]
        tensors = np.fft.rfftn(tensors.reshape(*period, 6), axes=(0, 1, 2)).reshape(-1, 6) * twice[:, None]
        rows = order[ends[k] : ends[k + 1]]
        step = max(1, _BATCH // len(twice))
        for start in range(0, len(rows), step):
            part = rows[start : start + step]
            result[part] = ((filled[p[part]] * filled[q[part]].conj()) @ tensors.conj()).real
    return result / (split.prod() * np.prod(period))


def _sharp(filled: np.ndarray) -> np.ndarray:
    """Subcells that are full or empty, with the same mean."""
    inside = (filled >= np.minimum(0.5, filled.max(axis=(1, 2, 3), keepdims=True))).astype(float)
    return inside * (filled.mean(axis=(1, 2, 3)) / inside.mean(axis=(1, 2, 3)))[:, None, None, None]


def _coarser(filled: np.ndarray, most: int) -> np.ndarray:
    """Filled shares of fewer subcells, at most ``most`` along an axis; where there are more, that divides them."""
    for axis, size in enumerate(filled.shape[1:], start=1):
        if size > most:
            shape = (*filled.shape[:axis], most, size // most, *filled.shape[axis + 1 :])
            filled = filled.reshape(shape).mean(axis=axis + 1)
    return filled


def common_fields(places: np.ndarray) -> np.ndarray:
    """Fields that all cells of a body may have in common, at places in extents: three even ones, then five of even
    gradient (see ``even_field.common_potentials``), shape [n, 3, 8]."""
    x, y, z = places.T
    zero, one = np.zeros_like(x), np.ones_like(x)
    rows = (
        (one, zero, zero, x, zero, y, z, zero),
        (zero, one, zero, zero, y, x, zero, z),
        (zero, zero, one, -z, -z, zero, x, y),
    )
    return np.moveaxis(np.array(rows), 2, 0)


def full_tensors(six: np.ndarray) -> np.ndarray:
    """Symmetric tensors of their six numbers, shape [n, 3, 3]."""
    rows, columns = PLACES
    full = np.empty((len(six), 3, 3))
    full[:, rows, columns] = full[:, columns, rows] = six
    return full


def _turned(six: np.ndarray, rotation: np.ndarray) -> np.ndarray:
    """Symmetric tensors in six numbers, turned."""
    return (rotation @ full_tensors(six) @ rotation.T)[:, *PLACES]
