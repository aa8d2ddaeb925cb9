"""Volume-filling lattices of moments: how a solid body is sampled for the dipole sums.

A body that is not a small ball is replaced by moments of volume Vᵢ at xᵢ such that ΣVᵢ is its volume and ΣVᵢxᵢ/ΣVᵢ its
centroid. Each shape's bounding box is divided into near-cubic cells that fit it exactly. A cell's moment sits at the
centroid of the part of the cell that the shape fills; cells filled by less than half join their nearest neighbour, so
that a curved surface leaves neither steps nor slivers. What a cell holds is found by testing a fine grid of points in
it, which also finds where several shapes of one body overlap: there every point counts once.

Accuracy, which sets :data:`AUTOMATIC_COUNT`. Uniformly magnetized cube of side L as n³ point dipoles, relative L2 error
of the field over all points at distance d from the surface, and of the force on an iron ball that touches a face
(radius L/8, the 5 mm ball at the 40 mm cube; linear and saturated ball alike):

====  =====  ==============  ============  ==============  ============
n     n³     field, d=0.2 L  field, d=L/8  force, d=0.2 L  force, d=L/8
====  =====  ==============  ============  ==============  ============
4     64     1.0e-2          4.7e-2        7.8e-2          3.8e-1
6     216    1.3e-3          1.1e-2        1.2e-2          1.1e-1
8     512    3e-4            2.5e-3        2e-3            3.3e-2
9     729    2e-4            1.3e-3        1.1e-3          1.8e-2
10    1000   1e-4            7e-4          7e-4            9.5e-3
====  =====  ==============  ============  ==============  ============

729 is thus the smallest cube number that keeps the force at contact within 2 %. A cylinder as wide as high, 621
moments then, has 2e-3 in the field at 0.2 L and 5e-3 at L/8. The error falls off as exp(−2πd/a) with the cell side a.
Permanent boxes and cylinders, whose fields are closed forms close up (``kernels/applied``), have points of Gauss
instead (``polyhedra.py``), which are fewer.

Which radius a moment's ball gets matters where another ball touches the body. Balls of the moments' own volumes
(:attr:`Lattice.radii`) stick out of the body by 0.12 a, and averaging over that overlap puts the force above 14 to 22 %
off (n of 12 to 8). An inducible lattice needs them, for its equilibrium to stay unique. A permanent one does not: with
balls inscribed in the cells (:attr:`Lattice.inner_radii`) a touching ball sees the point dipoles of the table.

The moments of an inducible body act on each other as what they are, parts of cells (``demagnetization.py``), which
:class:`Pieces` describe. Its cells are flatter than wide where it is thin, so that it is :data:`LEAST_ACROSS` across.
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from functools import partial

import numpy as np

from warpmag.errors import InputError
from warpmag.shapes import facets
from warpmag.shapes.cell_grid import CellGrid, Filled, cells_over
from warpmag.shapes.closed_mesh import check_closed, welded, winding_number
from warpmag.shapes.solids import Solid, Values, grid

AUTOMATIC_COUNT = 729
"""Moments of one body at automatic spacing, at most (see the table above): 9³, a cube's."""

LEAST_ACROSS = 3
"""Cells across an inducible shape at automatic spacing, at least. A ferrite cube of 20 mm pulls a plate of 40:40:5 mm
with 4 % too little at 0.5 mm, of two across with 6 %. With more, which are flatter, solves take longer."""

LARGEST_COUNT = 20_000
"""Moments of one body at any spacing; a smaller spacing is refused as a mistake."""

_FINE_POINTS = 32
"""Test points across a shape, along each axis, at least."""

_CHUNK = 1 << 18
"""Pairs of cells evaluated at a time (some tens of MB)."""

_NOTHING = np.empty((0, 3)), np.empty(0), (np.empty(0, int), np.empty(0, int), np.empty(0))
"""Moments of a shape that lies within others."""


@dataclass(frozen=True)
class Pieces:
    """What shapes fill of the cells of a grid, a piece for each cell of each, and the moments that stand for it.

    Attributes:
        sides: Sides of a cell [m], shape [3].
        index: Place of each piece's cell in the grid, shape [p, 3].
        filled: Share of each subcell that the piece fills, shape [p, a, b, c].
        piece, moment, share: Piece, moment, and the share of the piece that belongs to the moment, shape [entries].
        position, rotation: Origin of the grid's frame in the body's [m], and rotation to it, shapes [3] and [3, 3].
    """

    sides: np.ndarray
    index: np.ndarray
    filled: np.ndarray
    piece: np.ndarray
    moment: np.ndarray
    share: np.ndarray
    position: np.ndarray
    rotation: np.ndarray


@dataclass(frozen=True)
class Lattice:
    """Moments that stand for one solid body.

    Attributes:
        positions: Positions of the moments [m], body frame, shape [n, 3].
        volumes: Volumes of the moments [m³], shape [n]; their sum is the volume of the body.
        owners: Index of the shape that each moment belongs to, non-decreasing, shape [n].
        pieces: The parts of cells that they stand for, of each grid; none of a ball.
    """

    positions: np.ndarray
    volumes: np.ndarray
    owners: np.ndarray
    pieces: tuple[Pieces, ...] = ()

    @property
    def radii(self) -> np.ndarray:
        """Radii of the balls of the same volumes, (3V/4π)^⅓ [m], shape [n]."""
        return np.cbrt(0.75 * self.volumes / np.pi)

    @property
    def inner_radii(self) -> np.ndarray:
        """Radii of the balls inscribed in cubes of the same volumes, V^⅓/2 [m], shape [n]; for permanent moments."""
        return 0.5 * np.cbrt(self.volumes)


def box(half_extents: Values) -> Solid:
    """A box of half sides ``half_extents`` [m], shape [3], centred at the origin."""
    h = _lengths("box: half_extents", half_extents, 3)
    inside, surface = (lambda p: np.abs(p / h).max(axis=1) <= 1.0), partial(facets.box, h)
    return Solid("box", -h, h, float(8.0 * h.prod()), np.zeros(3), inside, surface)


def sphere(radius: float) -> Solid:
    """A sphere of ``radius`` [m], centred at the origin."""
    (r,) = _lengths("sphere: radius", [radius], 1)
    return replace(ellipsoid([r, r, r]), name="sphere")


def ellipsoid(semi_axes: Values) -> Solid:
    """An ellipsoid of ``semi_axes`` [m], shape [3], centred at the origin."""
    a = _lengths("ellipsoid: semi_axes", semi_axes, 3)
    volume = 4.0 / 3.0 * np.pi * float(a.prod())
    inside, surface = (lambda p: ((p / a) ** 2).sum(axis=1) <= 1.0), partial(facets.ellipsoid, a)
    return Solid("ellipsoid", -a, a, volume, np.zeros(3), inside, surface)


def capsule(radius: float, half_height: float) -> Solid:
    """A capsule along z: a cylinder of ``radius`` and ``half_height`` [m] with half a sphere on each end."""
    r, h = _lengths("capsule: radius and half_height", [radius, half_height], 2)

    def inside(p):
        return p[:, 0] ** 2 + p[:, 1] ** 2 + np.maximum(np.abs(p[:, 2]) - h, 0.0) ** 2 <= r * r

    upper = np.array([r, r, h + r])
    volume, surface = np.pi * r * r * (2.0 * h + 4.0 / 3.0 * r), partial(facets.capsule, r, h)
    return Solid("capsule", -upper, upper, volume, np.zeros(3), inside, surface)


def cylinder(radius: float, half_height: float) -> Solid:
    """A cylinder along z of ``radius`` and ``half_height`` [m], centred at the origin."""
    r, h = _lengths("cylinder: radius and half_height", [radius, half_height], 2)

    def inside(p):
        return (p[:, 0] ** 2 + p[:, 1] ** 2 <= r * r) & (np.abs(p[:, 2]) <= h)

    upper = np.array([r, r, h])
    volume, surface = 2.0 * np.pi * r * r * h, partial(facets.cylinder, r, h)
    return Solid("cylinder", -upper, upper, volume, np.zeros(3), inside, surface)


def cone(radius: float, half_height: float) -> Solid:
    """A cone along z of base ``radius`` [m], its base at z = −``half_height`` [m], its tip at +``half_height``."""
    r, h = _lengths("cone: radius and half_height", [radius, half_height], 2)

    def inside(p):
        width = r * (h - p[:, 2]) / (2.0 * h)
        return (p[:, 0] ** 2 + p[:, 1] ** 2 <= width * width) & (np.abs(p[:, 2]) <= h)

    upper = np.array([r, r, h])
    volume, surface = 2.0 / 3.0 * np.pi * r * r * h, partial(facets.cone, r, h)
    return Solid("cone", -upper, upper, volume, np.array([0.0, 0.0, -0.5 * h]), inside, surface)


def mesh(vertices: np.ndarray, faces: np.ndarray) -> Solid:
    """The solid that a closed triangle mesh bounds.

    Vertices at the same place are joined first. Every edge must then be passed as often one way as the other by its
    triangles; both orientations of the whole mesh are accepted. Shells may intersect: what lies in several counts once.

    Args:
        vertices: Vertices [m], shape [n, 3].
        faces: Indices of each triangle's vertices, shape [m, 3] or flat.
    """
    points, triangles = welded(vertices, faces)
    check_closed(triangles)
    corners = points[triangles]
    middle = 0.5 * (points.min(axis=0) + points.max(axis=0))  # tetrahedra from there keep the digits of a far mesh
    local = corners - middle
    parts = np.einsum("nk,nk->n", local[:, 0], np.cross(local[:, 1], local[:, 2])) / 6.0
    volume, lower, upper = float(parts.sum()), points.min(axis=0), points.max(axis=0)
    if abs(volume) <= 1e-9 * float((upper - lower).max()) ** 3:
        raise InputError("mesh: encloses no volume")
    centroid = middle + (parts[:, None] * local.sum(axis=1)).sum(axis=0) / (4.0 * volume)
    winding = winding_number(points, triangles if volume > 0.0 else triangles[:, ::-1])
    surface = partial(facets.mesh, corners if volume > 0.0 else corners[:, ::-1])
    solid = Solid("mesh", lower, upper, abs(volume), centroid, lambda p: winding(p) != 0, surface)
    turns, samples = _turns(solid, winding)
    if np.isin(turns, (0, 1)).all():
        return solid
    inside = turns != 0  # intersecting shells: the integrals above count the shared part more than once
    return replace(
        solid, volume=abs(volume) * float(inside.sum()) / float(turns.sum()), centroid=samples[inside].mean(axis=0)
    )


def ball(radius: float) -> Lattice:
    """The one moment of a ball of ``radius`` [m]: exact for a uniformly magnetized ball."""
    (r,) = _lengths("ball: radius", [radius], 1)
    return Lattice(np.zeros((1, 3)), np.array([4.0 / 3.0 * np.pi * r**3]), np.zeros(1, int))


def fits(boxes: Sequence[np.ndarray], spacing: float) -> bool:
    """Whether a body whose shapes have these bounding boxes [m] gets no more than :data:`LARGEST_COUNT` moments."""
    with np.errstate(over="ignore"):
        return not sum(np.prod(box / spacing) for box in boxes) > 4.0 * LARGEST_COUNT


def fill(solids: Solid | Sequence[Solid], spacing: float = 0.0, across: int = 1, *, together: bool = False) -> Lattice:
    """Fill a body with moments.

    Args:
        solids: The shapes of one body, posed in its frame. Where they overlap, the earlier one fills the place.
        spacing: Distance between moments [m]; 0 chooses one that needs about, and at most,
            :data:`AUTOMATIC_COUNT` moments. A spacing larger than a shape gives that shape one moment.
        across: Cells across a shape at automatic spacing, at least; they are as much flatter where that is more.
        together: Whether all shapes share the cells of one grid, in the frame of the largest, as tensors between them
            need. A cell that several shapes reach into is then a moment of each.

    Returns:
        The lattice. Its volume is exact if no two shapes overlap, else known to the fine test grid, about 1 %.
    """
    parts = [solids] if isinstance(solids, Solid) else list(solids)
    if not parts:
        raise InputError("solids: a body needs at least one shape")
    if not (np.isfinite(spacing) and spacing >= 0.0):
        raise InputError(f"spacing: must be zero or positive and finite, got {spacing}")
    if spacing > 0.0:
        if not fits([p.upper - p.lower for p in parts], spacing):
            raise InputError(f"spacing: {spacing} m needs more than {LARGEST_COUNT} moments for one body")
        return _fill(parts, spacing, 1, together)
    spacing = (sum(p.volume for p in parts) / AUTOMATIC_COUNT) ** (1.0 / 3.0)
    lattice = _fill(parts, spacing, across, together)
    most = max(AUTOMATIC_COUNT, across**3 * len(parts))
    while len(lattice.volumes) > most:
        spacing *= max(1.02, (len(lattice.volumes) / AUTOMATIC_COUNT) ** (1.0 / 3.0))
        lattice = _fill(parts, spacing, across, together)
    return lattice


def _fill(parts: Sequence[Solid], spacing: float, across: int, together: bool) -> Lattice:
    grids = _grids(parts, spacing, across, together)
    filled = [_fill_part(one, k) for one in grids for k in range(one.earlier, len(one.solids))]
    counts = [len(volumes) for _, volumes, _ in filled]
    firsts = np.cumsum(counts) - counts
    moved = [replace(one, moment=one.moment + first) for (_, _, one), first in zip(filled, firsts, strict=True)]
    pieces = [_side_by_side(moved)] if together else [one for one in moved if len(one.index)]
    return Lattice(
        np.concatenate([positions for positions, _, _ in filled]),
        np.concatenate([volumes for _, volumes, _ in filled]),
        np.repeat(np.arange(len(parts)), counts),
        tuple(pieces),
    )


def _grids(parts: Sequence[Solid], spacing: float, across: int, together: bool) -> list[CellGrid]:
    """The one grid of all shapes, or that of each."""
    if together:
        return [cells_over(parts, [], spacing, across)]
    return [cells_over([part], parts[:k], spacing, across) for k, part in enumerate(parts)]


def _side_by_side(pieces: list[Pieces]) -> Pieces:
    """Pieces of several shapes in the cells of one grid, as of one shape."""
    before = np.cumsum([0, *(len(one.index) for one in pieces)])
    return replace(
        pieces[0],
        index=np.concatenate([one.index for one in pieces]),
        filled=np.concatenate([one.filled for one in pieces]),
        piece=np.concatenate([one.piece + first for one, first in zip(pieces, before, strict=False)]),
        moment=np.concatenate([one.moment for one in pieces]),
        share=np.concatenate([one.share for one in pieces]),
    )


def _fill_part(cells: CellGrid, k: int) -> tuple[np.ndarray, np.ndarray, Pieces]:
    """Positions, in the body's frame, and volumes of the moments of what shape ``k`` adds to those before it."""
    part, found = cells.solids[k], cells.filled(k)
    if found.whole == 0.0:
        raise InputError(f"{part.name}: too thin to be filled with moments")
    positions, weights, (piece, moment, share) = _joined(found) if len(found.index) else _NOTHING
    if found.weights.sum() == found.whole:  # nothing taken away: the exact centroid is known
        positions = positions + part.to_body(part.centroid[None]) - weights @ positions / weights.sum()
    pieces = Pieces(cells.sides, found.index, found.shares, piece, moment, share, cells.position, cells.rotation)
    return positions @ cells.rotation.T + cells.position, weights * (part.volume / found.whole), pieces


def _joined(found: Filled) -> tuple[np.ndarray, np.ndarray, tuple[np.ndarray, ...]]:
    """Centroids and weights of the cells, those filled by less than half joined with their nearest neighbours.

    Also returned are which cell is joined with which, and the share of it.
    """
    hits, sums = found.weights, found.sums
    centroids = sums / hits[:, None]
    full = hits >= 0.5 * hits.max()
    weights, moments = hits[full], sums[full]
    scattered = np.flatnonzero(~full)
    joined = [(np.flatnonzero(full), np.arange(len(weights)), np.ones(len(weights)))]
    step = max(1, _CHUNK // len(weights))
    for start in range(0, len(scattered), step):
        rows = scattered[start : start + step]
        distances = ((centroids[rows, None, :] - centroids[full]) ** 2).sum(axis=2)
        nearest = distances.min(axis=1, keepdims=True)
        shares = (distances <= nearest * (1.0 + 1e-6)).astype(float)  # ties are shared, which keeps symmetry
        shares /= shares.sum(axis=1, keepdims=True)
        weights = weights + hits[rows] @ shares
        moments = moments + shares.T @ sums[rows]
        given, taker = np.nonzero(shares)
        joined.append((rows[given], taker, shares[given, taker]))
    return moments / weights[:, None], weights, tuple(np.concatenate(one) for one in zip(*joined, strict=True))


def _lengths(name: str, values: Values, count: int) -> np.ndarray:
    array = np.asarray(values, float)
    if array.shape != (count,) or not (np.isfinite(array).all() and (array > 0.0).all()):
        got = values if count > 1 else values[0]
        raise InputError(f"{name}: must be positive and finite{', three lengths' if count == 3 else ''}, got {got}")
    return array


def _turns(solid: Solid, winding: Callable[[np.ndarray], np.ndarray]) -> tuple[np.ndarray, np.ndarray]:
    """Winding numbers at a grid of points in the bounding box, and the points."""
    counts = np.full(3, _FINE_POINTS)
    points = solid.lower + (grid(counts) + 0.5) * ((solid.upper - solid.lower) / counts)
    return winding(points), points
