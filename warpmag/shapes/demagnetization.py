"""Demagnetizing tensors between the cells of a solid, and their difference from the sums over pairs of balls.

A lattice (``lattice.py``) divides a solid into cells of uniform magnetization. Fields averaged over cells give the
operator H_i = −Σ_j N_ij M_j. It is the exact operator restricted to such magnetizations: symmetric and positive, with
eigenvalues between 0 and 1. Ellipsoids are exact, except for the resolution of their surface. Other bodies have a
slightly too small moment: a cube of 9³ cells and χ = ∞ has 3.58 V H0 instead of 3.64 V H0.

The tensor of two equal cuboids on a grid is from Newell, Williams and Dunlop, "A generalization of the demagnetizing
tensor for nonuniform magnetization" (1993), Eqs. 27, 28 and 32. A cell that the surface cuts is resolved by subcells,
and the tensors of its filled subcells are added. Without subcells, a sphere of any resolution has steps, and its moment
is 10 % too large.

The sums over all pairs treat each cell as a ball (``kernels/pairs/pair_law.py``). A :class:`Coupling` holds the
correction: for cells nearer than :data:`EXACT_REACH`, the exact tensor minus the tensor of two balls. For a cell
itself, the 1/3 that the magnetization curve of a ball contains is subtracted instead.
"""

from collections import Counter
from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np

from warpmag.declarations.rotations import quaternion_of, rotate
from warpmag.shapes.ball_pairs import radial_factors
from warpmag.shapes.lattice import Lattice, Pieces
from warpmag.shapes.solids import grid

EXACT_REACH = 3.0, 6.0
"""Smallest and largest distance up to which pairs of cells are corrected, in longest sides of a cell."""

_NEAR_CELLS = 114
"""Number of cells within the smallest reach in a block of cubes. Rods and sheets have fewer there, so their reach grows
until it holds as many cells. With dipoles from 3 sides on, the operator of rods of 1:40 has negative eigenvalues. With
dipoles from 6 sides on, its error is 1e-4 to 1e-5."""

_SUBCELLS = 8
"""Largest number of subcells along each axis of a cell that the surface cuts. Coarser subcells for pairs that do not
touch give rods of 1:20 negative eigenvalues."""

_FAR_REACH = 4.0
"""Distance up to which quadrupoles of cells are corrected, in reaches of the exact tensors."""

_LARGEST_SPREAD = 0.15
"""Bound on the norm of the traceless mean of x xᵀ over the volume of a moment, about its centroid. In squares of the
longest side of a cell; two joined cubic cells have 0.2."""
COMPONENTS = np.array([0, 1, 2, 0, 0, 1]), np.array([0, 1, 2, 1, 2, 2])
"""Rows and columns of the six components of a symmetric tensor: xx, yy, zz, xy, xz, yz."""
_BATCH = 1 << 22
"""Largest number of entries of a temporary array (tens of MB)."""


@dataclass(frozen=True)
class LoneSlopes:
    """Changes of :class:`Slopes` in a world without other iron."""

    layer: np.ndarray  # ``Slopes.layer`` there, shape [n, 3]
    tensor: dict[tuple[int, int], np.ndarray]  # added to components (k, j) of T_ij [1/m³], shape [entries] each


@dataclass(frozen=True)
class Slopes:
    """Neighbors of a body's linear cells (``linear_cells.py``), and the correction of the pair sums between them.

    Everything is in the frame of the grid. Sides are −x, +x, −y, +y, −z, +z.
    """

    neighbor: np.ndarray  # neighbor of each cell on each side, the cell itself where there is none, shape [n, 6]
    weight: np.ndarray  # weights w of the neighbors, shape [n, 6]
    layer: np.ndarray  # factors of differences along axes without neighbors (``linear_cells.py``), shape [n, 3]
    tensor: np.ndarray  # T_ij [1/m³] for the entries of the coupling, H_i += Σ T_ij m_j, shape [entries, 3, 3]
    alone: LoneSlopes | None  # changes in a world without other iron; None if ``tensor`` contains them

    def without_other_iron(self) -> "Slopes":
        """Return the slopes in a world without other iron."""
        if self.alone is None:
            return self
        tensor = self.tensor.copy()
        for (k, j), added in self.alone.tensor.items():
            tensor[:, k, j] += added
        return Slopes(self.neighbor, self.weight, self.alone.layer, tensor, None)


@dataclass(frozen=True)
class Coupling:
    """Correction of the pair sums between the moments of one body, in its frame: H_i += Σ T_ij m_j + C Σ m_j."""

    start: np.ndarray  # first entry of each moment, and the end, shape [n + 1]
    other: np.ndarray  # moment j of each entry, ascending, shape [entries]
    tensor: np.ndarray  # T_ij [1/m³], xx, yy, zz, xy, xz, yz, shape [entries, 6]
    common: np.ndarray  # C [1/m³] (``uniform_response.py``), shape [3, 3]
    positions: np.ndarray  # positions of the moments [m], shape [n, 3]
    radii: np.ndarray  # radii of the moments' balls [m], shape [n]
    half_sides: np.ndarray  # boxes with the volumes and second moments of the cells, frame of the grid [m], [n, 3]
    outer_faces: np.ndarray  # True for the faces −x, +x, −y, ... of whole cells on the body's surface, shape [n, 6]
    cell_sides: np.ndarray  # sides of a whole cell [m], frame of the grid, shape [3]
    grid_rotation: np.ndarray  # from the frame of the grid to that of the body (x, y, z, w), shape [4]
    slopes: Slopes | None  # of linear cells

    near = True
    """True if the moments are cells, whose fields nearby are not those of balls."""

    @cached_property
    def center(self) -> np.ndarray:
        """Mean of the positions [m], shape [3]."""
        return self.positions.mean(axis=0)

    @cached_property
    def extent(self) -> float:
        """Largest distance of a moment from the center [m], or the radius of a single moment."""
        return float(np.linalg.norm(self.positions - self.center, axis=1).max()) or float(self.radii.max())

    @cached_property
    def grid_extents(self) -> np.ndarray:
        """Extents of the body along the axes of the grid [m], accurate to about half a cell, shape [3]."""
        local = self.positions @ rotate(self.grid_rotation[None], np.eye(3)).T
        return np.ptp(local, axis=0) + self.cell_sides

    @cached_property
    def is_sheet(self) -> bool:
        """True for linear cells in one or two layers."""
        return self.slopes is not None and bool((self.grid_extents < 2.5 * self.cell_sides).any())

    def among(self, bodies: int, *, balls: bool) -> "Coupling":
        """Return the coupling in a world with a number of iron bodies of cells, this one included.

        C replaces charges near edges. Where bodies touch there are none, so C is divided by ``bodies``. With all of C
        the operator of a closed ring of bodies would not be positive. ``balls`` is True if the world has iron balls.
        The only iron of a world has other slopes (``linear_cells.py``). Bodies that share a coupling share the results.
        """
        if (bodies, balls) not in self._among:
            slopes = self.slopes
            if slopes is not None and bodies == 1 and not balls:
                slopes = slopes.without_other_iron()
            self._among[bodies, balls] = replace(self, common=self.common / bodies, slopes=slopes)
        return self._among[bodies, balls]

    @cached_property
    def _among(self) -> dict[tuple[int, bool], "Coupling"]:
        return {}

    @property
    def grid_tensor(self) -> np.ndarray:
        """Tensors of the entries in the frame of the grid, of linear cells if the body has them, [entries, 3, 3]."""
        if self.slopes is not None:
            return self.slopes.tensor
        return full_tensors(rotated(self.tensor, rotate(self.grid_rotation[None], np.eye(3))))

    @cached_property
    def grid_common(self) -> np.ndarray:
        """C in the frame of the grid, shape [3, 3]."""
        turn = rotate(self.grid_rotation[None], np.eye(3))
        return turn @ self.common @ turn.T

    @property
    def neighbor(self) -> np.ndarray:
        """Neighbor of each cell on the sides −x, +x, −y, ... of the grid, or the cell itself, shape [n, 6]."""
        own = np.arange(len(self.radii))
        return np.repeat(own[:, None], 6, axis=1) if self.slopes is None else self.slopes.neighbor

    @property
    def weights(self) -> np.ndarray:
        """Weights of each moment and of its neighbors in its differences, 0 for uniform cells, shape [n, 12]."""
        if self.slopes is None:
            return np.zeros((len(self.radii), 12))
        ratio = (self.radii[:, None] / self.radii[self.neighbor]) ** 3
        return np.concatenate([self.slopes.weight, self.slopes.weight * ratio], axis=1)

    @property
    def layer(self) -> np.ndarray:
        """Factors of differences along axes without neighbors, 0 for uniform cells, shape [n, 3]."""
        return np.zeros((len(self.radii), 3)) if self.slopes is None else self.slopes.layer


def couplings_in_worlds(
    couplings: Sequence[Coupling], worlds: Sequence[int], iron: Sequence[bool], ball_worlds: set[int]
) -> list[Coupling]:
    """Return the couplings of bodies among the other iron of their worlds.

    Args:
        couplings: Coupling of each body of cells.
        worlds: World of each of these bodies.
        iron: False for permanent boxes and cylinders with recoil permeability. They do not count, because they hardly
            respond.
        ball_worlds: Worlds with balls of iron.
    """
    count = Counter(world for world, is_iron in zip(worlds, iron, strict=True) if is_iron)
    return [
        coupling.among(max(count[world], 1), balls=world in ball_worlds)
        for coupling, world in zip(couplings, worlds, strict=True)
    ]


def pair_law_tensors(positions: np.ndarray, radii: np.ndarray) -> np.ndarray:
    """Return the field tensors between n balls [1/m³], 0 between a ball and itself, shape [n, n, 6]."""
    n = len(radii)
    i, j = np.divmod(np.arange(n * n), n)
    law = _pair_law(positions[i] - positions[j], radii[i], radii[j], i == j)
    law[i == j] = 0.0  # the magnetization curve contains a ball's own field
    return law.reshape(n, n, 6)


def cuboid_tensors(offsets: np.ndarray, sides: np.ndarray) -> np.ndarray:
    """Return the demagnetizing tensors N, H = −N M, between equal cuboids on a grid, xx, yy, zz, xy, xz, yz, [n, 6].

    ``offsets`` are the vectors between their centers in ``sides``, whole numbers, shape [n, 3].
    """
    offsets = np.asarray(offsets).astype(int)
    signs, distances = np.where(offsets < 0, -1.0, 1.0), np.abs(offsets)
    total = _tensor_table(distances.max(axis=0, initial=0) + 1, sides)[tuple(distances.T)]
    total[:, 3:] *= signs[:, [0, 0, 1]] * signs[:, [1, 2, 2]]
    return total


def _tensor_table(counts: np.ndarray, sides: np.ndarray) -> np.ndarray:
    """Return :func:`cuboid_tensors` for all offsets below ``counts`` along each axis, shape [a, b, c, 6]."""
    unit = np.asarray(sides, float) / np.max(sides)
    x, y, z = np.ix_(*(step * np.arange(-1, count + 1) for step, count in zip(unit, counts, strict=True)))
    diagonal = [_diagonal(x, y, z), _diagonal(y, x, z), _diagonal(z, y, x)]
    total = np.stack([*diagonal, _off_diagonal(x, y, z), _off_diagonal(x, z, y), _off_diagonal(y, z, x)])
    for _ in range(3):  # second differences along each axis
        total = np.moveaxis(2.0 * total[:, 1:-1] - total[:, :-2] - total[:, 2:], 1, 3)
    return np.moveaxis(total, 0, 3) / (4.0 * np.pi * unit.prod())


def _diagonal(x, y, z):
    """Return f of Newell, Williams and Dunlop, Eq. 27, without the terms that cancel."""
    x, y, z = np.abs(x), np.abs(y), np.abs(z)
    r = np.sqrt(x * x + y * y + z * z)
    return (
        0.5 * y * (z * z - x * x) * np.arcsinh(_quotient(y, np.hypot(x, z)))
        + 0.5 * z * (y * y - x * x) * np.arcsinh(_quotient(z, np.hypot(x, y)))
        - x * y * z * np.arctan2(y * z, x * r)
        + (2.0 * x * x - y * y - z * z) * r / 6.0
    )


def _off_diagonal(x, y, z):
    """Return g of Newell, Williams and Dunlop, Eq. 32."""
    r = np.sqrt(x * x + y * y + z * z)
    return (
        x * y * z * np.arcsinh(_quotient(z, np.hypot(x, y)))
        + y * (3.0 * z * z - y * y) / 6.0 * np.arcsinh(_quotient(x, np.hypot(y, z)))
        + x * (3.0 * z * z - x * x) / 6.0 * np.arcsinh(_quotient(y, np.hypot(x, z)))
        - z**3 / 6.0 * np.arctan(_quotient(x * y, z * r))
        - 0.5 * z * y * y * np.arctan(_quotient(x * z, y * r))
        - 0.5 * z * x * x * np.arctan(_quotient(y * z, x * r))
        - x * y * r / 3.0
    )


def _quotient(a, b):
    """Return a/b, or 0 where b = 0, because the factor before the term is 0 there."""
    return np.where(b != 0.0, a / np.where(b != 0.0, b, 1.0), 0.0)


def coupling(lattice: Lattice, radii: np.ndarray) -> Coupling:
    """Return the correction of the pair sums between near moments of one body.

    ``radii`` are the radii of the balls in the pair sums [m], shape [n]. Cells of different grids are not corrected.
    """
    x, volumes = lattice.positions, lattice.volumes
    entries, tensors = [np.empty((2, 0), int)], [np.empty((0, 6))]
    for part in lattice.pieces:
        (i, j), exact = _part_tensors(part, lattice)
        entries.append(np.stack([i, j]))
        exact = -exact / np.sqrt(volumes[i] * volumes[j])[:, None]
        tensors.append(exact - _pair_law(x[i] - x[j], radii[i], radii[j], i == j))
    (i, j), tensor = np.concatenate(entries, axis=1), np.concatenate(tensors)
    order = np.lexsort((j, i))
    start = np.searchsorted(i[order], np.arange(len(volumes) + 1))
    (part,) = lattice.pieces  # the shapes of an inducible body share a grid
    return Coupling(
        start, j[order], tensor[order], np.zeros((3, 3)), x, radii, _boxes(part, lattice.volumes),
        _outer_faces(part, len(volumes)), part.sides, quaternion_of(part.rotation), None,
    )  # fmt: skip


def _boxes(part: Pieces, volumes: np.ndarray) -> np.ndarray:
    """Return half sides of boxes with the volumes of the cells and the ratios of their second moments [m], [n, 3]."""
    filled = np.bincount(part.moment, part.share * part.filled.mean(axis=(1, 2, 3))[part.piece])
    squares = np.einsum("nkk->nk", _spreads(part, 0, filled))
    half = np.sqrt(3.0 * squares)
    return half * np.cbrt(volumes / (8.0 * half.prod(axis=1)))[:, None]


def _outer_faces(part: Pieces, count: int) -> np.ndarray:
    """Return True for each face of a whole cell beyond which no cell follows, shape [count, 6]."""
    whole = (part.filled.min(axis=(1, 2, 3)) == 1.0) & (np.bincount(part.piece) == 1)
    alone = whole[part.piece] & (np.bincount(part.moment, minlength=count) == 1)[part.moment]
    index = part.index - part.index.min(axis=0) + 1
    occupied = np.zeros(index.max(axis=0) + 2, bool)
    occupied[tuple(index.T)] = True
    outer = np.zeros((count, 6), bool)
    for face in range(6):
        beyond = index[part.piece[alone]]
        beyond[:, face // 2] += 2 * (face % 2) - 1
        outer[part.moment[alone], face] = ~occupied[tuple(beyond.T)]
    return outer


def _pair_law(r, a, b, same):
    """Return T of the pair sums' field H = T m [1/m³], shape [n, 6]; for a moment itself H = −M/3."""
    g1, g2 = radial_factors(np.linalg.norm(r, axis=1), a, b)
    g1, g2 = np.where(same, -1.0 / a**3, g1), np.where(same, 0.0, g2)
    products = r[:, COMPONENTS[0]] * r[:, COMPONENTS[1]]
    return (g1[:, None] * np.array([1.0, 1.0, 1.0, 0.0, 0.0, 0.0]) + g2[:, None] * products) / (4.0 * np.pi)


def _part_tensors(part: Pieces, lattice: Lattice) -> tuple[np.ndarray, np.ndarray]:
    """Return pairs of near moments, shape [2, pairs], and N_ij √(V_i V_j) over a cell's volume, shape [pairs, 6]."""
    first, count = int(part.moment.min()), len(np.unique(part.moment))
    local = (lattice.positions[first : first + count] - part.position) @ part.rotation
    reach = _reach(local, float(part.sides.max()))
    i, j = _near_pairs(local, reach)
    volume = np.bincount(part.moment - first, part.share * part.filled.mean(axis=(1, 2, 3))[part.piece], count)
    order = np.argsort(part.moment, kind="stable")
    piece, share = part.piece[order], part.share[order]
    begin = np.searchsorted(part.moment[order] - first, np.arange(count + 1))
    pieces = np.diff(begin)
    # every pair of pieces of each pair of moments
    pairs = pieces[i] * pieces[j]
    pair = np.repeat(np.arange(len(i)), pairs)
    rank = np.arange(len(pair)) - np.repeat(np.cumsum(pairs) - pairs, pairs)
    a, b = begin[i[pair]] + rank // pieces[j[pair]], begin[j[pair]] + rank % pieces[j[pair]]
    p, q = piece[a], piece[b]
    key, inverse = np.unique(np.minimum(p, q) * len(part.index) + np.maximum(p, q), return_inverse=True)
    values = _piece_tensors(part, key // len(part.index), key % len(part.index))[inverse]
    weight = share[a] * share[b]
    sums = np.stack([np.bincount(pair, weight * values[:, c], len(i)) for c in range(6)], axis=1)
    sums /= np.sqrt(volume[i] * volume[j])[:, None]
    own, spreads = i == j, _second_moments(part, first, volume)
    sums[own] += _far_corrections(local, part.sides.prod() * volume, spreads, reach)[i[own]]
    distinct = i != j
    pairs = np.concatenate([np.stack([i, j]), np.stack([j[distinct], i[distinct]])], axis=1) + first
    return pairs, rotated(np.concatenate([sums, sums[distinct]]), part.rotation)


def _second_moments(part: Pieces, first: int, volume: np.ndarray) -> np.ndarray:
    """Return the traceless part of :func:`_spreads`, at most ``_LARGEST_SPREAD``, shape [n, 3, 3]."""
    spread = _spreads(part, first, volume)
    spread -= np.trace(spread, axis1=1, axis2=2)[:, None, None] * np.eye(3) / 3.0
    size, most = np.linalg.norm(spread, axis=(1, 2)), _LARGEST_SPREAD * part.sides.max() ** 2
    return spread * np.minimum(1.0, most / np.maximum(size, np.finfo(float).tiny))[:, None, None]


def _spreads(part: Pieces, first: int, volume: np.ndarray) -> np.ndarray:
    """Return the mean of x xᵀ over the volume of each moment, about its centroid [m²], shape [n, 3, 3]."""
    split = np.array(part.filled.shape[1:])
    points, weights = (grid(split) + 0.5) / split * part.sides, part.filled.reshape(len(part.filled), -1) / split.prod()
    corner, zeroth = part.index * part.sides, weights.sum(axis=1)[:, None]
    first_moments = weights @ points
    second_moments = np.stack([weights @ (points[:, [k]] * points) for k in range(3)], axis=1)
    second_moments += zeroth[..., None] * np.diag((part.sides / split) ** 2 / 12.0)
    second_moments += (
        first_moments[:, :, None] * corner[:, None] + corner[:, :, None] * (first_moments + zeroth * corner)[:, None]
    )
    first_moments += zeroth * corner
    sums = np.concatenate([first_moments, second_moments.reshape(-1, 9)], axis=1)[part.piece] * part.share[:, None]
    sums = np.stack([np.bincount(part.moment - first, x, len(volume)) for x in sums.T], axis=1) / volume[:, None]
    center = sums[:, :3]
    return sums[:, 3:].reshape(-1, 3, 3) - center[:, :, None] * center[:, None]


def _far_corrections(points: np.ndarray, volumes: np.ndarray, spreads: np.ndarray, reach: float) -> np.ndarray:
    """Return the quadrupole fields of cells beyond ``reach`` [m], as a tensor on each moment itself, shape [n, 6].

    Distant cells are dipoles in the pair sums. The correction assumes that they are magnetized like the moment itself.
    It falls off with the fifth power of the distance and ends at ``_FAR_REACH`` times the reach. Negative eigenvalues
    are set to 0. With them, the operator of thin plates with flat cells would not stay positive.
    """
    total = np.zeros((6, len(points)))
    if np.abs(spreads).max() < 1e-9 * reach * reach:  # cubes have no quadrupole
        return total.T
    pairs = np.stack(_near_pairs(points, _FAR_REACH * reach))
    step = _BATCH // 64
    for start in range(0, pairs.shape[1], step):
        i, j = pairs[:, start : start + step]
        r = points[i] - points[j]
        square = (r * r).sum(axis=1)
        far = square > reach * reach * (1.0 + 1e-9)
        i, j, r, d = i[far], j[far], r[far], np.sqrt(square[far])[:, None]
        spread = spreads[i] + spreads[j]
        product = np.einsum("nkl,nl->nk", spread, r)
        along = (product * r).sum(axis=1)[:, None]
        rows, columns = COMPONENTS
        mixed = r[:, rows] * product[:, columns] + product[:, rows] * r[:, columns]
        identity = np.array([1.0, 1.0, 1.0, 0.0, 0.0, 0.0])
        tensor = 105.0 * along * r[:, rows] * r[:, columns] / d**9 - 15.0 * (along * identity + 2.0 * mixed) / d**7
        tensor = (tensor + 6.0 * spread[:, rows, columns] / d**5) / (-8.0 * np.pi)
        for k in range(6):
            total[k] += np.bincount(i, volumes[j] * tensor[:, k], len(points))
            total[k] += np.bincount(j, volumes[i] * tensor[:, k], len(points))
    values, vectors = np.linalg.eigh(full_tensors(total.T))
    positive = (vectors * np.maximum(values, 0.0)[:, None]) @ np.swapaxes(vectors, 1, 2)
    return positive[:, *COMPONENTS]


def _reach(points: np.ndarray, side: float) -> float:
    """Return the distance [m] up to which moments of cells with a longest ``side`` [m] are corrected."""
    least, most = (side * sides for sides in EXACT_REACH)
    i, j = _near_pairs(points, most)
    distances = np.sort(np.linalg.norm(points[i] - points[j], axis=1))  # each moment itself, and each pair once
    needed = len(points) * (_NEAR_CELLS + 1) // 2
    return float(np.clip(distances[needed], least, most)) if needed < len(distances) else most


def _near_pairs(points: np.ndarray, reach: float) -> tuple[np.ndarray, np.ndarray]:
    """Return the pairs i ≤ j of points at most ``reach`` apart."""
    pairs = []
    step = max(1, _BATCH // max(1, 3 * len(points)))
    for begin in range(0, len(points), step):
        separation = points[begin : begin + step, None] - points
        i, j = np.nonzero((separation**2).sum(axis=2) <= reach * reach * (1.0 + 1e-9))
        pairs.append(np.stack([i + begin, j]))
    i, j = np.concatenate(pairs, axis=1)
    return i[i <= j], j[i <= j]


def _piece_tensors(part: Pieces, p: np.ndarray, q: np.ndarray) -> np.ndarray:
    """Return ∫∫ of the demagnetizing kernel over pairs of pieces, divided by a cell's volume, shape [pairs, 6]."""
    separation = part.index[p] - part.index[q]
    full = part.filled.min(axis=(1, 2, 3)) == 1.0
    both_full = full[p] & full[q]
    cut = np.flatnonzero(~both_full)
    result = np.empty((len(p), 6))
    offsets, inverse = np.unique(separation[both_full], axis=0, return_inverse=True)
    result[both_full] = cuboid_tensors(offsets, part.sides)[inverse.reshape(-1)]
    if len(cut):
        filled = _binary(_coarsened(part.filled, _SUBCELLS))
        patterns, pattern = np.unique(filled.reshape(len(filled), -1), axis=0, return_inverse=True)
        # pieces repeat along a rod and over a plate: each pair of patterns is evaluated once at each offset
        pattern, shift = pattern.reshape(-1), separation[cut] - separation[cut].min(axis=0)
        columns = pattern[p[cut]], pattern[q[cut]], *shift.T
        rows = np.ravel_multi_index(columns, (len(patterns), len(patterns), *(shift.max(axis=0) + 1)))
        _, first, inverse = np.unique(rows, return_index=True, return_inverse=True)
        patterns, offsets = patterns.reshape(-1, *filled.shape[1:]), separation[cut][first]
        result[cut] = _cut_tensors(part.sides, patterns, columns[0][first], columns[1][first], offsets)[inverse]
    return result


def _cut_tensors(sides: np.ndarray, filled: np.ndarray, p, q, separation) -> np.ndarray:
    """Return :func:`_piece_tensors` of pieces that the surface cuts, from the tensors of their subcells.

    The sum over pairs of subcells is a sum of tensors times the correlation of the filled shares, by Fourier transform.
    """
    split = np.array(filled.shape[1:])
    reach = (np.abs(separation).max(axis=0) + 1) * split
    table = _tensor_table(reach, sides / split)
    period, size = tuple(2 * split), len(filled)
    filled = np.fft.rfftn(filled, period, axes=(1, 2, 3))
    weights = np.where(np.arange(split[2] + 1) % split[2] == 0, 1.0, 2.0)  # the other half of the spectrum is conjugate
    weights = np.broadcast_to(weights, filled.shape[1:]).reshape(-1)
    filled = filled.reshape(size, -1)
    between = (grid(2 * split) + split) % (2 * split) - split  # offset between subcells, in subcells
    valid = np.all(between > -split, axis=1)
    result = np.empty((len(p), 6))
    offsets, inverse = np.unique(separation, axis=0, return_inverse=True)
    order = np.argsort(inverse.reshape(-1), kind="stable")
    ends = np.append(0, np.cumsum(np.bincount(inverse.reshape(-1))))
    for k, offset in enumerate(offsets):  # in cells
        steps = offset * split + between
        tensors = np.where(valid[:, None], table[tuple(np.minimum(np.abs(steps), reach - 1).T)], 0.0)
        signs = np.where(steps < 0, -1.0, 1.0)
        tensors[:, 3:] *= signs[:, [0, 0, 1]] * signs[:, [1, 2, 2]]
        tensors = np.fft.rfftn(tensors.reshape(*period, 6), axes=(0, 1, 2)).reshape(-1, 6) * weights[:, None]
        rows = order[ends[k] : ends[k + 1]]
        step = max(1, _BATCH // len(weights))
        for start in range(0, len(rows), step):
            part = rows[start : start + step]
            result[part] = ((filled[p[part]] * filled[q[part]].conj()) @ tensors.conj()).real
    return result / (split.prod() * np.prod(period))


def _binary(filled: np.ndarray) -> np.ndarray:
    """Return filled shares with the same mean in each cell, where subcells are either empty or equally filled."""
    inside = (filled >= np.minimum(0.5, filled.max(axis=(1, 2, 3), keepdims=True))).astype(float)
    return inside * (filled.mean(axis=(1, 2, 3)) / inside.mean(axis=(1, 2, 3)))[:, None, None, None]


def _coarsened(filled: np.ndarray, most: int) -> np.ndarray:
    """Return the filled shares of at most ``most`` subcells along each axis; ``most`` must divide larger counts."""
    for axis, size in enumerate(filled.shape[1:], start=1):
        if size > most:
            shape = (*filled.shape[:axis], most, size // most, *filled.shape[axis + 1 :])
            filled = filled.reshape(shape).mean(axis=axis + 1)
    return filled


def full_tensors(six: np.ndarray) -> np.ndarray:
    """Return symmetric tensors from their six components, shape [n, 3, 3]."""
    rows, columns = COMPONENTS
    full = np.empty((len(six), 3, 3))
    full[:, rows, columns] = full[:, columns, rows] = six
    return full


def rotated(six: np.ndarray, rotation: np.ndarray) -> np.ndarray:
    """Return the six components of rotated symmetric tensors."""
    return (rotation @ full_tensors(six) @ rotation.T)[:, *COMPONENTS]
