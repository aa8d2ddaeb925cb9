"""Lattices of moments that fill a solid body.

A body that is not a ball is replaced by moments of volume Vᵢ at xᵢ. ΣVᵢ is the volume of the body, and ΣVᵢxᵢ/ΣVᵢ its
centroid. Nearly cubic cells divide the bounding box of a shape exactly. The moment of a cell is at the centroid of
the part that the shape fills. Cells filled by less than 0.32, or a half in a body of several shapes, join their
nearest neighbor, so that a curved surface has neither steps nor slivers. Where possible, the faces of a single mesh,
such as the sides of the strokes of a letter, lie between cells of its grid. The filled part is found from a fine grid
of test points. Where shapes of a body overlap, each test point counts once.

The accuracy determines :data:`AUTOMATIC_COUNT`. The table lists errors of a uniformly magnetized cube of side L as n³
point dipoles. The field's error is a relative L2 norm over all points at distance d from the surface. The force acts on
an iron ball of radius L/8 (5 mm at a cube of 40 mm) with its center at the distance d: at L/8 it is in contact. The
error of the force is equal for linear and saturated balls.

====  =====  ==============  ============  ==============  ============
n     n³     field, d=0.2 L  field, d=L/8  force, d=0.2 L  force, d=L/8
====  =====  ==============  ============  ==============  ============
4     64     1.0e-2          4.7e-2        7.8e-2          3.8e-1
6     216    1.3e-3          1.1e-2        1.2e-2          1.1e-1
8     512    3e-4            2.5e-3        2e-3            3.3e-2
9     729    2e-4            1.3e-3        1.1e-3          1.8e-2
10    1000   1e-4            7e-4          7e-4            9.5e-3
====  =====  ==============  ============  ==============  ============

729 is the smallest cube number that keeps the force at contact within 2 %. A cylinder as wide as high has 621 moments,
and errors of the field of 2e-3 at 0.2 L and 5e-3 at L/8. The error falls off as exp(−2πd/a) with the side a of a cell.
The near fields of permanent boxes and cylinders are closed forms (``kernels/applied``). At a distance they are replaced
by moments at Gauss points (``polyhedra.py``), which are fewer.

The radius of a moment's ball matters if another ball touches the body. Balls of the moments' own volumes
(:attr:`Lattice.radii`) protrude from the body by 0.12 a. Averaging over that overlap changes the force by 14 to 22 % (n
of 12 to 8). Inducible bodies need these balls, because with them the equilibrium is unique. Permanent bodies use balls
inscribed in the cells (:attr:`Lattice.inner_radii`), so that the errors in the table hold for a touching ball.

The moments of an inducible body act on each other as parts of cells (``demagnetization.py``), which :class:`Pieces`
describe. A thin body gets flat cells, so that :data:`LEAST_ACROSS` cells span its thickness.
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import partial

import numpy as np

from warpmag.errors import InputError
from warpmag.shapes import facets
from warpmag.shapes.cell_grid import CellGrid, Filled, cells_over
from warpmag.shapes.closed_mesh import check_closed, steps_of, welded, winding_number
from warpmag.shapes.solids import Solid, Values

AUTOMATIC_COUNT = 729
"""Largest number of moments of a body at automatic spacing: 9³, see the table above. A body of n shapes with c cells
across may have c³ n, if that is more: 27 for each shape of an inducible body of more than 27 shapes."""
LEAST_ACROSS = 3
"""Smallest number of cells across an inducible shape at automatic spacing. Before cells had charges on their faces near
magnets, the force of a ferrite cube of 20 mm at 0.5 mm from a plate of 40:40:5 mm was 4 % too small with 3 cells
across, and 6 % with 2. More cells are flatter and slower. Shapes so thin that cells would be flatter than
:data:`FLATTEST` have fewer."""

FLATTEST = 3.0
"""Largest ratio of a cell's sides at automatic spacing, unless a shape is one cell across. The force on a sheet follows
from the magnetization along it. Before cells had charges on their faces near magnets, the force of a ferrite cube of
20 mm at 0.5 mm from a sheet of 100:100:2 mm was 10 to 18 % too small with cells 1.9 times as wide as thick. With three
cells across, 10 times as wide as thick, it was between 50 % too small and 65 % too large. A magnet of 20:5 mm at 1 mm
from a plate of 80:3 mm pulled 16 % too little with one cell across, and 8 % with two that are 2.8 times as wide as
thick: the faces of a cell have opposite charges, but those of a plate have not."""

LONGEST = 1.25
"""Largest ratio of a cell's longest side to the next one at automatic spacing. Longer cells are poor dipoles along a
rod."""

_JOINED = 0.32, 0.5
"""Shares of a whole cell below which a cell joins a neighbor, in bodies of one shape and of several. Near cells of
different bodies act on each other as boxes, but joined cells are not boxes: with 0.42 for one shape, forces in a stack
of five discs were up to 29 % too large. In bodies of several shapes, which share cells, a third would leave many small
parts."""

_STEP = 1.02
"""Ratio of successive trial spacings."""

LARGEST_COUNT = 20_000
"""Largest number of moments of a body at any spacing; a smaller spacing raises an error."""
_FINE_POINTS = 32
"""Test points along each axis of a mesh's bounding box."""
_CHUNK = 1 << 18
"""Pairs of cells evaluated at a time (some tens of MB)."""
_NO_MOMENTS = np.empty((0, 3)), np.empty(0), (np.empty(0, int), np.empty(0, int), np.empty(0))
"""Moments of a shape that lies inside others: positions, weights and joined cells."""


@dataclass(frozen=True)
class Pieces:
    """Parts of shapes in the cells of a grid, one piece per shape and cell, and the moments that represent them."""

    sides: np.ndarray  # sides of a cell [m], shape [3]
    index: np.ndarray  # index of each piece's cell in the grid, shape [p, 3]
    filled: np.ndarray  # filled share of each subcell, shape [p, a, b, c]
    piece: np.ndarray  # index of the piece of each entry, shape [entries]
    moment: np.ndarray  # index of the moment of each entry, shape [entries]
    share: np.ndarray  # share of the piece that belongs to the moment, shape [entries]
    position: np.ndarray  # origin of the grid in the body's frame [m], shape [3]
    rotation: np.ndarray  # rotation from the frame of the grid to the body's, shape [3, 3]


@dataclass(frozen=True)
class Lattice:
    """Moments that represent one solid body."""

    positions: np.ndarray  # positions of the moments [m], body frame, shape [n, 3]
    volumes: np.ndarray  # volumes [m³], shape [n]; their sum is the volume of the body
    owners: np.ndarray  # index of each moment's shape, non-decreasing, shape [n]
    pieces: tuple[Pieces, ...] = ()  # parts of cells that the moments represent, one entry per grid; empty for a ball

    @property
    def radii(self) -> np.ndarray:
        """Radii of the balls of the same volumes, (3V/4π)^⅓ [m], shape [n]."""
        return np.cbrt(0.75 * self.volumes / np.pi)

    @property
    def inner_radii(self) -> np.ndarray:
        """Radii of the balls inscribed in cubes of the same volumes, V^⅓/2 [m], shape [n]; for permanent moments."""
        return 0.5 * np.cbrt(self.volumes)


def box(half_extents: Values) -> Solid:
    """Return a box of half sides ``half_extents`` [m], shape [3], centered at the origin."""
    h = _lengths("box: half_extents", half_extents, 3)

    def inside(x, y, z):
        return (np.abs(x / h[0]) <= 1.0) & (np.abs(y / h[1]) <= 1.0) & (np.abs(z / h[2]) <= 1.0)

    return Solid("box", -h, h, float(8.0 * h.prod()), np.zeros(3), inside, partial(facets.box, h))


def sphere(radius: float) -> Solid:
    """Return a sphere of ``radius`` [m], centered at the origin."""
    (r,) = _lengths("sphere: radius", [radius], 1)
    return replace(ellipsoid([r, r, r]), name="sphere")


def ellipsoid(semi_axes: Values) -> Solid:
    """Return an ellipsoid of ``semi_axes`` [m], shape [3], centered at the origin."""
    a = _lengths("ellipsoid: semi_axes", semi_axes, 3)
    volume = 4.0 / 3.0 * np.pi * float(a.prod())

    def inside(x, y, z):
        return (x / a[0]) ** 2 + (y / a[1]) ** 2 + (z / a[2]) ** 2 <= 1.0

    return Solid("ellipsoid", -a, a, volume, np.zeros(3), inside, partial(facets.ellipsoid, a))


def capsule(radius: float, half_height: float) -> Solid:
    """Return a capsule along z: a cylinder of ``radius`` and ``half_height`` [m] with a hemisphere at each end."""
    r, h = _lengths("capsule: radius and half_height", [radius, half_height], 2)

    def inside(x, y, z):
        return x**2 + y**2 + np.maximum(np.abs(z) - h, 0.0) ** 2 <= r * r

    upper = np.array([r, r, h + r])
    volume, surface = np.pi * r * r * (2.0 * h + 4.0 / 3.0 * r), partial(facets.capsule, r, h)
    return Solid("capsule", -upper, upper, volume, np.zeros(3), inside, surface)


def cylinder(radius: float, half_height: float) -> Solid:
    """Return a cylinder along z of ``radius`` and ``half_height`` [m], centered at the origin."""
    r, h = _lengths("cylinder: radius and half_height", [radius, half_height], 2)

    def inside(x, y, z):
        return (x**2 + y**2 <= r * r) & (np.abs(z) <= h)

    upper = np.array([r, r, h])
    volume, surface = 2.0 * np.pi * r * r * h, partial(facets.cylinder, r, h)
    return Solid("cylinder", -upper, upper, volume, np.zeros(3), inside, surface)


def cone(radius: float, half_height: float) -> Solid:
    """Return a cone along z: base of ``radius`` [m] at z = −``half_height`` [m], tip at +``half_height``."""
    r, h = _lengths("cone: radius and half_height", [radius, half_height], 2)

    def inside(x, y, z):
        width = r * (h - z) / (2.0 * h)
        return (x**2 + y**2 <= width * width) & (np.abs(z) <= h)

    upper = np.array([r, r, h])
    volume, surface = 2.0 / 3.0 * np.pi * r * r * h, partial(facets.cone, r, h)
    return Solid("cone", -upper, upper, volume, np.array([0.0, 0.0, -0.5 * h]), inside, surface)


def mesh(vertices: np.ndarray, faces: np.ndarray) -> Solid:
    """Return the solid that a closed triangle mesh bounds.

    Vertices at the same position are joined first. The triangles must then traverse every edge equally often in both
    directions; either orientation of the whole mesh is accepted. Shells may intersect; shared volume counts once.
    ``vertices`` [m] have the shape [n, 3]; ``faces`` are triples of their indices, shape [k, 3] or flat.
    """
    points, triangles = welded(vertices, faces)
    check_closed(triangles)
    corners = points[triangles]
    middle = 0.5 * (points.min(axis=0) + points.max(axis=0))  # apex of tetrahedra: keeps the digits of a far mesh
    local = corners - middle
    parts = np.einsum("nk,nk->n", local[:, 0], np.cross(local[:, 1], local[:, 2])) / 6.0
    volume, lower, upper = float(parts.sum()), points.min(axis=0), points.max(axis=0)
    if abs(volume) <= 1e-9 * float((upper - lower).max()) ** 3:
        raise InputError("mesh: encloses no volume")
    centroid = middle + (parts[:, None] * local.sum(axis=1)).sum(axis=0) / (4.0 * volume)
    winding = winding_number(points, triangles if volume > 0.0 else triangles[:, ::-1])
    surface = partial(facets.mesh, corners if volume > 0.0 else corners[:, ::-1])
    steps = steps_of(corners)
    solid = Solid("mesh", lower, upper, abs(volume), centroid, lambda x, y, z: winding(x, y, z) != 0, surface, steps)
    samples = lower + (np.arange(_FINE_POINTS)[:, None] + 0.5) * ((upper - lower) / _FINE_POINTS)
    windings = winding(*np.ix_(*samples.T))
    if np.isin(windings, (0, 1)).all():
        return solid
    inside = windings != 0  # intersecting shells: the integrals above count shared volume repeatedly
    volume = abs(volume) * float(inside.sum()) / float(windings.sum())
    centroid = np.array([samples[rows, k].mean() for k, rows in enumerate(np.nonzero(inside))])
    return replace(solid, volume=volume, centroid=centroid)


def ball(radius: float) -> Lattice:
    """Return the single moment of a ball of ``radius`` [m], which is exact for a uniformly magnetized ball."""
    (r,) = _lengths("ball: radius", [radius], 1)
    return Lattice(np.zeros((1, 3)), np.array([4.0 / 3.0 * np.pi * r**3]), np.zeros(1, int))


def fits(boxes: Sequence[np.ndarray], spacing: float, largest: int = LARGEST_COUNT) -> bool:
    """Return False if a body with these bounding boxes [m] surely needs more than ``largest`` moments."""
    with np.errstate(over="ignore"):  # a shape thinner than the spacing has one cell across
        return not sum(np.prod(np.maximum(box / spacing, 1.0)) for box in boxes) > 4.0 * largest


def fill(
    solids: Solid | Sequence[Solid],
    spacing: float = 0.0,
    across: int = 1,
    *,
    together: bool = False,
    largest: int = LARGEST_COUNT,
) -> Lattice:
    """Fill a body with moments. Their total volume is exact, or accurate to about 1 % if shapes overlap.

    Args:
        solids: Shapes of one body, posed in its frame. Overlap belongs to the earlier shape.
        spacing: Distance between moments [m]; 0 chooses it for about, and at most, :data:`AUTOMATIC_COUNT` moments, or
            ``across``³ for each shape if that is more. A shape smaller than the spacing gets one moment. A smaller
            spacing than the automatic one leaves at least as many cells across a shape.
        across: Smallest number of cells across a shape at automatic spacing, with flatter cells where necessary, up to
            :data:`FLATTEST`. Thinner shapes have fewer cells across.
        together: True if all shapes share one grid, in the frame of the largest, which tensors between them require. A
            cell in several shapes then gives a moment of each shape.
        largest: Largest number of moments at a given spacing.

    Raises:
        InputError: No shape, a spacing that is negative or not finite, or one that needs more moments than ``largest``.
    """
    parts = [solids] if isinstance(solids, Solid) else list(solids)
    if not parts:
        raise InputError("solids: a body needs at least one shape")
    if not (np.isfinite(spacing) and spacing >= 0.0):
        raise InputError(f"spacing: must be zero or positive and finite, got {spacing}")
    too_many = InputError(f"spacing: {spacing:g} m needs more than {largest} moments for one body")
    if spacing > 0.0 and not fits([p.upper - p.lower for p in parts], spacing, largest):
        raise too_many
    most = max(AUTOMATIC_COUNT, across**3 * len(parts))
    automatic, across, grids = _automatic_cells(parts, across, most, together)
    if spacing > 0.0:
        # shapes with much common volume have an automatic spacing above the sides of their cells
        longest = max(cells.sides.max() for cells in grids)
        lattice = _fill(parts, spacing, across if spacing < min(automatic, longest) else 1, together)
        if len(lattice.volumes) > largest:
            raise too_many
        return lattice
    spacing = automatic
    lattice = _fill(parts, spacing, across, together)
    while len(lattice.volumes) > most:
        spacing *= _STEP ** _steps(lattice, most)
        lattice = _fill(parts, spacing, across, together)
    return lattice


def _steps(lattice: Lattice, most: int) -> int:
    """Return the number of steps by which the spacing grows before the next fill.

    It is 1, except for cells in a row, as in a wire: their number is inversely proportional to the spacing, so steps
    that would leave more than ``most`` moments are skipped.
    """
    if len(lattice.pieces) > 1 or np.count_nonzero(np.ptp(lattice.pieces[0].index, axis=0)) > 1:
        return 1
    return max(1, int(np.log(len(lattice.volumes) / most) / np.log(_STEP)) - 1)


def _automatic_cells(
    parts: Sequence[Solid], across: int, most: int, together: bool
) -> tuple[float, int, list[CellGrid]]:
    """Return a spacing [m], the number of cells across a shape, and grids of at most ``most`` cells by volume."""
    first = (sum(p.volume for p in parts) / AUTOMATIC_COUNT) ** (1.0 / 3.0)
    widest = max((p.upper - p.lower).max() for p in parts)
    for fewer in range(across, 0, -1):
        spacing = first
        grids = _grids(parts, spacing, fewer, together)
        while _cell_volumes(grids) > most * (1.0 + 1e-9) and spacing < widest:
            spacing *= _STEP
            grids = _grids(parts, spacing, fewer, together)
        if fewer == 1 or all(_is_nearly_cubic(cells.sides) for cells in grids):
            break
    return spacing, fewer, grids


def _grids(parts: Sequence[Solid], spacing: float, across: int, together: bool) -> list[CellGrid]:
    """Return one grid for all shapes, or one for each shape."""
    if together:
        return [cells_over(parts, [], spacing, across)]
    return [cells_over([part], parts[:k], spacing, across) for k, part in enumerate(parts)]


def _is_nearly_cubic(sides: np.ndarray) -> bool:
    """Return True if a cell with these sides is neither too flat nor too long."""
    least, middle, most = np.sort(sides)
    return bool(most <= FLATTEST * least and most <= LONGEST * middle)


def _cell_volumes(grids: Sequence[CellGrid]) -> float:
    """Return the total volume of the shapes of grids, in cells."""
    return sum(part.volume / cells.sides.prod() for cells in grids for part in cells.solids[cells.earlier :])


def _fill(parts: Sequence[Solid], spacing: float, across: int, together: bool) -> Lattice:
    """Return the lattice of shapes at a spacing [m]."""
    grids = _grids(parts, spacing, across, together)
    filled = [_fill_part(cells, k) for cells in grids for k in range(cells.earlier, len(cells.solids))]
    counts = [len(volumes) for _, volumes, _ in filled]
    firsts = np.cumsum(counts) - counts
    all_pieces = [replace(p, moment=p.moment + first) for (_, _, p), first in zip(filled, firsts, strict=True)]
    pieces = [_concatenated(all_pieces)] if together else [p for p in all_pieces if len(p.index)]
    return Lattice(
        np.concatenate([positions for positions, _, _ in filled]),
        np.concatenate([volumes for _, volumes, _ in filled]),
        np.repeat(np.arange(len(parts)), counts),
        tuple(pieces),
    )


def _concatenated(pieces: list[Pieces]) -> Pieces:
    """Return the pieces of several shapes in one grid as one record."""
    if len(pieces) == 1:
        return pieces[0]  # without copies: those of a long wire are large
    firsts = np.cumsum([0, *(len(p.index) for p in pieces)])
    pieces = [replace(p, piece=p.piece + first) for p, first in zip(pieces, firsts, strict=False)]
    columns = ("index", "filled", "piece", "moment", "share")
    return replace(pieces[0], **{name: np.concatenate([getattr(p, name) for p in pieces]) for name in columns})


def _fill_part(cells: CellGrid, k: int) -> tuple[np.ndarray, np.ndarray, Pieces]:
    """Return positions [m], body frame, volumes [m³] and pieces of shape ``k``'s moments outside earlier shapes."""
    part, filled = cells.solids[k], cells.filled(k)
    if filled.point_count == 0:
        raise InputError(f"{part.name}: too thin to be filled with moments")
    least = _JOINED[len(cells.solids) > 1]
    positions, weights, (piece, moment, share) = _joined(filled, least) if len(filled.index) else _NO_MOMENTS
    if filled.weights.sum() > (1.0 - 1e-9) * filled.point_count:  # no overlap: the exact centroid is known
        positions = positions + part.to_body(part.centroid[None]) - weights @ positions / weights.sum()
    pieces = Pieces(cells.sides, filled.index, filled.shares, piece, moment, share, cells.position, cells.rotation)
    return positions @ cells.rotation.T + cells.position, weights * (part.volume / filled.point_count), pieces


def _joined(filled: Filled, least: float) -> tuple[np.ndarray, np.ndarray, tuple[np.ndarray, ...]]:
    """Return centroids and weights of the moments, and (cell, moment, share of the cell that belongs to the moment).

    Cells filled by less than ``least`` of the fullest one join their nearest neighbors.
    """
    hits, sums = filled.weights, filled.sums
    centroids = sums / hits[:, None]
    full = hits >= least * hits.max()
    weights, moments = hits[full], sums[full]
    scattered = np.flatnonzero(~full)
    joined = [(np.flatnonzero(full), np.arange(len(weights)), np.ones(len(weights)))]
    step = max(1, _CHUNK // len(weights))
    for start in range(0, len(scattered), step):
        rows = scattered[start : start + step]
        distances = ((centroids[rows, None, :] - centroids[full]) ** 2).sum(axis=2)
        nearest = distances.min(axis=1, keepdims=True)
        shares = (distances <= nearest * (1.0 + 1e-6)).astype(float)  # equal distances share, to keep symmetry
        shares /= shares.sum(axis=1, keepdims=True)
        weights = weights + hits[rows] @ shares
        moments = moments + shares.T @ sums[rows]
        row, moment = np.nonzero(shares)
        joined.append((rows[row], moment, shares[row, moment]))
    return moments / weights[:, None], weights, tuple(np.concatenate(column) for column in zip(*joined, strict=True))


def _lengths(name: str, values: Values, count: int) -> np.ndarray:
    """Return ``count`` positive lengths [m] as an array; raises ``InputError`` for other values."""
    array = np.asarray(values, float)
    if array.shape != (count,) or not (np.isfinite(array).all() and (array > 0.0).all()):
        got = values if count > 1 else values[0]
        raise InputError(f"{name}: must be positive and finite{', three lengths' if count == 3 else ''}, got {got}")
    return array
