"""Letters as solids: outlines of a font, a mesh for rendering, and boxes along the strokes for collisions.

Coordinates are in the plane of the letter, x to the right and y up, in units of the height of a capital. The font is
DejaVu Sans Bold, which is part of Matplotlib (the extra ``plots``).
"""

import math
from dataclasses import dataclass

import numpy as np

from warpmag.errors import InputError

_UNITS = 2048
"""Units per em of the font: its points have integer coordinates, or half-integer ones between control points."""
_CAPITAL = 1493  # height of the font's capitals in the same units
_CELLS = 48  # number of cells across a capital in the fit of boxes
_ANGLES = 12  # number of directions of boxes over a quarter turn, besides those of straight strokes
_STRAIGHT = 0.3  # smallest length of the edges of straight strokes
_COVERED, _LEAST_GAIN = 0.96, 0.025
"""Boxes are added until they cover the first fraction of the letter, or the next box would add less than the second."""
_THINNEST = 0.16  # smallest side of a box: strokes are 0.19 wide, and thin boxes require short time steps
_OVERHANG = 0.015
"""Largest overhang of a box beyond the letter, besides half a cell: curved strokes then need fewer boxes."""


@dataclass(frozen=True)
class Box:
    """A rectangle in the plane of a letter."""

    center: np.ndarray  # shape [2]
    half: np.ndarray  # half sides, shape [2]
    angle: float  # rotation, counterclockwise [rad]

    def contains(self, points: np.ndarray) -> np.ndarray:
        """Return True for each of ``points``, shape [n, 2], inside the box, shape [n]."""
        return np.max(np.abs(_rotated(points - self.center, -self.angle)) - self.half, axis=1) <= 0.0


def outline(letter: str, segments: int = 4) -> list[np.ndarray]:
    """Return the corners of the closed curves that bound a letter, with the material on their left, shape [n, 2] each.

    The first corner is not repeated. The origin is the center of the bounding box. Each curved piece is divided into
    ``segments`` straight ones. Raises :class:`InputError` if Matplotlib is missing, or the letter has no outline.
    """
    if not letter.strip():
        raise InputError(f"letters: {letter!r} has no outline")
    try:
        from matplotlib.font_manager import FontProperties  # noqa: PLC0415 - only authoring letters needs it
        from matplotlib.textpath import TextPath  # noqa: PLC0415
    except ImportError:
        raise InputError("letters: their outlines need Matplotlib, install the extra 'plots'") from None
    path = TextPath((0.0, 0.0), letter, size=_UNITS, prop=FontProperties(family="DejaVu Sans", weight="bold"))
    curves, corners = [], []
    for points, code in path.iter_segments(simplify=False, curves=True):
        ends = (np.rint(2.0 * points) / 2.0 / _CAPITAL).reshape(-1, 2)  # reverts the rounding of the rasterizer
        if code == path.CURVE3:
            t = np.linspace(0.0, 1.0, segments + 1)[1:, None]
            corners += list((1.0 - t) ** 2 * corners[-1] + 2.0 * t * (1.0 - t) * ends[0] + t**2 * ends[1])
        elif code in (path.MOVETO, path.LINETO):
            corners.append(ends[0])
        if code == path.CLOSEPOLY:
            curves.append(_cleaned(np.array(corners)))
            corners = []
    center = 0.5 * (np.concatenate(curves).min(axis=0) + np.concatenate(curves).max(axis=0))
    if area(curves) < 0.0:  # TrueType has the opposite orientation
        curves = [curve[::-1] for curve in curves]
    return [curve - center for curve in curves]


def area(curves: list[np.ndarray]) -> float:
    """Return the area of an outline; clockwise curves, such as holes, count negatively."""
    pairs = [(curve, np.roll(curve, -1, axis=0)) for curve in curves]
    return sum(float(0.5 * np.sum(a[:, 0] * b[:, 1] - a[:, 1] * b[:, 0])) for a, b in pairs)


def triangles(curves: list[np.ndarray]) -> np.ndarray:
    """Triangulate the inside of an outline by cutting off ears; bridges join holes to the curves around them.

    Triangles are counterclockwise indices of the concatenated corners of the curves, shape [n, 3].
    """
    points = np.concatenate(curves)
    loops = [list(range(start, start + len(curve))) for start, curve in zip(_starts(curves), curves, strict=True)]
    outer = [loop for loop, curve in zip(loops, curves, strict=True) if area([curve]) > 0.0]
    holes = [loop for loop, curve in zip(loops, curves, strict=True) if area([curve]) < 0.0]
    ears = []
    for loop in outer:
        inside = [hole for hole in holes if _inside(points[hole[:1]], [points[loop]])[0]]
        for hole in sorted(inside, key=lambda hole: -points[hole, 0].max()):
            loop = _bridged(points, loop, hole)
        ears += _ears(points, loop)
    return np.array(ears)


def extruded(curves: list[np.ndarray], depth: float, bevel: float) -> tuple[np.ndarray, list[np.ndarray]]:
    """Return a closed mesh of an outline with thickness ``depth`` and edges beveled by a small width ``bevel``.

    Returns:
        Points, shape [n, 3], z normal to the letter and zero in its middle; faces, counterclockwise seen from outside.
    """
    insets = [_inset(curve, bevel) for curve in curves]
    rims, inner = np.concatenate(curves), np.concatenate(insets)
    count = len(rims)
    rings = [(inner, 0.5 * depth), (rims, 0.5 * depth - bevel), (rims, bevel - 0.5 * depth), (inner, -0.5 * depth)]
    points = np.concatenate([np.c_[ring, np.full(count, z)] for ring, z in rings])
    caps = triangles(insets)  # triangles of the outline would fold at the ends of curved strokes
    starts = zip(_starts(curves), curves, strict=True)
    following = np.concatenate([start + np.roll(np.arange(len(curve)), -1) for start, curve in starts])
    corner = np.arange(count)
    faces = [*caps, *(caps[:, ::-1] + 3 * count)]
    for upper in range(3):
        low, high = (upper + 1) * count, upper * count
        faces += list(np.stack([corner + low, following + low, following + high, corner + high], axis=1))
    return points, faces


def boxes(curves: list[np.ndarray]) -> list[Box]:
    """Cover a letter with few overlapping boxes along its strokes, in the order of the area that they add."""
    grids = [_Grid(curves, angle) for angle in _directions(curves)]
    cover: list[Box] = []
    letter_area = area(curves)
    covered = 0.0
    gains, best = [math.inf] * len(grids), {}
    while covered < _COVERED * letter_area:
        outdated = set(range(len(grids)))
        while (first := gains.index(max(gains))) in outdated:  # gains of a grid only fall
            gains[first], best[first] = grids[first].best()
            outdated.remove(first)
        gain, box = gains[first], best[first]
        if gain < _LEAST_GAIN * letter_area:
            break
        covered += gain
        cover.append(box)
        for grid in grids:
            grid.cover(box)
    return cover


def _directions(curves) -> np.ndarray:
    """Return the allowed angles of boxes, in [0, π/2)."""
    quarter = 0.5 * np.pi
    edges = np.concatenate([np.roll(curve, -1, axis=0) - curve for curve in curves])
    long = edges[np.linalg.norm(edges, axis=1) > _STRAIGHT]
    strokes = np.round(np.arctan2(long[:, 1], long[:, 0]) % quarter, 4) % quarter
    return np.unique(np.concatenate([np.arange(_ANGLES) * (quarter / _ANGLES), strokes]))


class _Grid:
    """Cells over a letter in one direction, with marks where boxes may lie and where no box covers the letter yet."""

    def __init__(self, curves, angle):
        self._angle = angle
        self._cell = 1.0 / _CELLS
        rotated = [_rotated(curve, -angle) for curve in curves]
        enlarged = [_inset(curve, -_OVERHANG) for curve in rotated]
        corners = np.concatenate(enlarged)
        self._lower = corners.min(axis=0)
        columns, rows = np.ceil(np.ptp(corners, axis=0) / self._cell - 1e-6).astype(int)
        x, y = np.meshgrid(np.arange(columns) + 0.5, np.arange(rows) + 0.5)
        centers = self._lower + self._cell * np.stack([x.ravel(), y.ravel()], axis=1)
        self._inside = _inside(centers, enlarged).reshape(rows, columns)
        self._open = _inside(centers, rotated).reshape(rows, columns)
        self._centers = _rotated(centers, angle)

    def cover(self, box: Box) -> None:
        self._open &= ~box.contains(self._centers).reshape(self._open.shape)

    def best(self) -> tuple[float, Box]:
        """Return the area of open cells under the best box, and that box."""
        rows, columns = self._inside.shape
        thinnest = int(_THINNEST / self._cell)
        # for every first row at once: the columns that are inside from it to the last row, and their open cells
        inside = np.ones((rows, columns), bool)
        opened = np.zeros((rows, columns), int)
        most, corners = 0, (0, 0, 0, 0)
        for last in range(rows):
            inside[: last + 1] &= self._inside[last]
            opened[: last + 1] += self._open[last]
            runs = _run_sums(np.where(inside, opened, 0), inside)  # largest at the end of the best run of columns
            runs[_run_sums(inside, inside) < thinnest] = 0
            runs[max(0, last + 2 - thinnest) :] = 0
            first, end = np.unravel_index(np.argmax(runs), runs.shape)
            if runs[first, end] > most:
                most = runs[first, end]
                before = np.flatnonzero(~inside[first, :end])
                begin = before[-1] + 1 if len(before) else 0
                after = np.flatnonzero(~inside[first, end:])
                corners = (begin, first, end + after[0] if len(after) else columns, last + 1)
        lower, upper = (self._lower + self._cell * np.array(corners[k : k + 2]) for k in (0, 2))
        box = Box(_rotated(0.5 * (lower + upper), self._angle), 0.5 * (upper - lower), float(self._angle))
        return float(most) * self._cell**2, box


def _run_sums(values, inside) -> np.ndarray:
    """Return sums of ``values`` along each row since the last column that is not ``inside``."""
    sums = np.cumsum(values, axis=1)
    return sums - np.maximum.accumulate(np.where(inside, 0, sums), axis=1)


def _starts(curves) -> np.ndarray:
    return np.cumsum([0, *map(len, curves[:-1])])


def _rotated(points, angle) -> np.ndarray:
    cos, sin = np.cos(angle), np.sin(angle)
    return points @ np.array([[cos, sin], [-sin, cos]])


def _cleaned(curve) -> np.ndarray:
    """Remove corners that repeat the corner before them."""
    return curve[np.linalg.norm(curve - np.roll(curve, 1, axis=0), axis=1) > 1e-9]


def _inset(curve, width) -> np.ndarray:
    """Move every edge of ``curve`` to its left by ``width``; corners sharper than a right angle are truncated."""
    before, after = curve - np.roll(curve, 1, axis=0), np.roll(curve, -1, axis=0) - curve
    normals = [np.stack([-e[:, 1], e[:, 0]], axis=1) / np.linalg.norm(e, axis=1)[:, None] for e in (before, after)]
    bisector = normals[0] + normals[1]
    return curve + width * bisector / np.maximum(0.5 * np.sum(bisector**2, axis=1), 1.0)[:, None]


def _inside(points, curves) -> np.ndarray:
    """Return True for points, shape [n, 2], inside the curves: a ray to the right meets an odd number of edges."""
    result = np.zeros(len(points), bool)
    x, y = points.T
    for curve in curves:
        for (ax, ay), (bx, by) in zip(curve, np.roll(curve, -1, axis=0), strict=True):
            if ay != by:
                result ^= ((ay > y) != (by > y)) & (x < ax + (y - ay) * (bx - ax) / (by - ay))
    return result


def _cross(o, a, b) -> float:
    return (a[0] - o[0]) * (b[1] - o[1]) - (a[1] - o[1]) * (b[0] - o[0])


def _bridged(points, loop, hole) -> list[int]:
    """Join ``hole`` to ``loop`` by the shortest bridge that crosses neither."""
    edges = [(curve[k - 1], curve[k]) for curve in (loop, hole) for k in range(len(curve))]
    distances = np.linalg.norm(points[loop][:, None] - points[hole], axis=2)
    for pair in np.argsort(distances, axis=None, kind="stable"):
        a, b = np.unravel_index(pair, distances.shape)
        if not any(_crosses(points, loop[a], hole[b], *edge) for edge in edges):
            return [*loop[: a + 1], *hole[b:], *hole[: b + 1], *loop[a:]]
    raise ValueError("outline: a hole cannot be reached from the curve around it")


def _crosses(points, a, b, c, d) -> bool:
    if {a, b} & {c, d}:
        return False
    a, b, c, d = points[[a, b, c, d]]
    return _cross(a, b, c) * _cross(a, b, d) <= 0.0 and _cross(c, d, a) * _cross(c, d, b) <= 0.0


def _ears(points, loop) -> list[list[int]]:
    """Cut a simple loop into triangles, always at the ear of the highest quality."""
    loop, ears = list(loop), []
    while len(loop) > 3:
        quality, k = max((_quality(points, loop, k), k) for k in range(len(loop)))
        if quality <= 0.0:
            raise ValueError("outline: crosses itself")
        ears.append([loop[k - 1], loop[k], loop[(k + 1) % len(loop)]])
        del loop[k]
    return [*ears, loop]


def _quality(points, loop, k) -> float:
    """Return twice the area over the longest side squared of the ear at corner ``k``; 0 if it is not an ear."""
    ear = [loop[k - 1], loop[k], loop[(k + 1) % len(loop)]]
    a, b, c = points[ear]
    double = _cross(a, b, c)
    if double <= 1e-12:
        return 0.0
    rest = points[[corner for corner in loop if corner not in ear]]
    if len(rest):
        sides = np.stack([_cross(p, q, rest.T) for p, q in ((a, b), (b, c), (c, a))])
        if (sides >= -1e-12).all(axis=0).any():
            return 0.0
    return double / max(np.sum((p - q) ** 2) for p, q in ((a, b), (b, c), (c, a)))
