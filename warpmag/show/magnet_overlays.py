"""Colors, arrows and field lines of the magnets of a recording."""

import itertools
from collections.abc import Callable, Sequence

import numpy as np

from warpmag.declarations.rotations import rotate
from warpmag.errors import InputError
from warpmag.moments.fields import h_field, wrench
from warpmag.shapes import lattice
from warpmag.show.meshes import BALL
from warpmag.show.renderer_stage import DrawnShape, RendererStage

COLORS = {"magnetization": "A/m", "speed": "m/s", "force": "N"}
"""Quantities that may color bodies, and their units."""
_FAR = 4.0
"""Distance from the magnets at which field lines end, over the size of the largest magnet."""
_FINE_COUNT, _COARSE_COUNT = 8, 27
"""Up to 8 shapes other than balls are sampled as in a simulation. Of more shapes, each gets about 27 moments."""
_ARROW, _MOST_SIZES = 1.6, 2.5
"""Length of the longest arrow over the size of its magnet, which counts as at most this multiple of the median size."""
_OFFSET = 0.03
"""Distance from the surface at which field lines begin (outside) and end (inside), over the size of the magnet."""
_STEPS, _STEP = 300, 0.05
"""Largest number of steps of a field line, and their length over the size of the largest magnet."""
_POINTS = 72
"""Points of a curve."""


class MagnetOverlays:
    """The magnets of a stage over time, each replaced by moments.

    Attributes:
        local: Positions of the moments in the frames of their bodies [units], shape [k, 3].
        owners: Magnet of each moment, shape [k].
        volumes: Volume of each moment, shape [k].
        radii: Radius of the ball of each moment, shape [k].
    """

    def __init__(self, stage: RendererStage):
        """Sample the magnets of a stage."""
        self._record = record = stage.recording
        self._unit = record.meters_per_unit
        self._shapes = stage.shapes_of_magnets()
        others = sum(not shape.radius for shapes in self._shapes for shape in shapes)
        parts = [_moments_of(shapes, others) for shapes in self._shapes]
        self.local, self.volumes, self.radii = (np.concatenate([part[k] for part in parts]) for k in range(3))
        self.owners = np.repeat(np.arange(len(parts)), [len(part[0]) for part in parts])
        self.rows = np.array([shapes[0].row for shapes in self._shapes])
        self.middles = np.array([np.mean([shape.middle for shape in shapes], axis=0) for shapes in self._shapes])
        self.sizes = np.array([max(shape.size for shape in shapes) for shapes in self._shapes])
        self._boxes = [_box(shapes) for shapes in self._shapes]
        self._shares = self.volumes / np.bincount(self.owners, weights=self.volumes)[self.owners]

    def values(self, color: str, device) -> np.ndarray:
        """Return the quantity ``color`` of each body at each frame, shape [f, n]."""
        record, bodies = self._record, np.maximum(self.rows, 0)
        values = np.zeros(record.positions.shape[:2])
        if color == "speed":
            return np.linalg.norm(record.linear, axis=-1) * self._unit
        if color == "magnetization":
            total = np.zeros(record.positions.shape)
            np.add.at(total, (slice(None), bodies), np.where(self.rows[:, None] < 0, 0.0, record.moments))
            volumes = np.bincount(self.owners, weights=self.volumes) * self._unit**3
            whole = np.bincount(bodies, weights=volumes, minlength=values.shape[1])
            return np.linalg.norm(total, axis=-1) / np.where(whole > 0.0, whole, np.inf)
        for frame in range(len(values)):
            places, moments = self._moments(frame)
            forces, _ = wrench(places, moments, radii=self.radii * self._unit, device=device)
            total = np.zeros((values.shape[1], 3))
            body = self.rows[self.owners]
            np.add.at(total, body[body >= 0], forces[body >= 0])
            values[frame] = np.linalg.norm(total, axis=-1)
        return values

    def arrows(self) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Return middles, moments and lengths of arrows; the strongest magnetization has the longest arrow."""
        middles = np.stack([self._placed(self.middles, self.rows, frame) for frame in range(len(self._record.codes))])
        moments = self._record.moments
        strength = np.linalg.norm(moments, axis=-1) / np.bincount(self.owners, weights=self.volumes)
        strength /= max(float(strength.max()), 1e-300)
        sizes = np.minimum(self.sizes, _MOST_SIZES * np.median(self.sizes))
        return middles, moments, _ARROW * sizes * strength

    def field_lines(self, count: int, device) -> tuple[np.ndarray, float]:
        """Return field lines, shape [f, lines, points, 3], and the width of their curves."""
        record = self._record
        sources = np.flatnonzero(record.permanent & (np.linalg.norm(record.moments[0], axis=-1) > 0.0))
        if not len(sources):
            raise InputError("field_lines: the stage has no permanent magnet where they could begin")
        each = -(-count // len(sources))
        local, rows = [], np.repeat(self.rows[sources], each)
        for magnet in sources.tolist():
            row = self.rows[magnet]
            back = record.rotations[:1, row] * (-1.0, -1.0, -1.0, 1.0) if row >= 0 else np.array([[0.0, 0.0, 0.0, 1.0]])
            along = rotate(back, record.moments[:1, magnet].astype(float))[0]
            local.append(_seeds(self._shapes[magnet], along, each, _OFFSET * self.sizes[magnet]))
        local, size = np.concatenate(local), float(self.sizes[sources].max())
        lines = [self._lines_at(frame, local, rows, sources, size, device) for frame in range(len(record.codes))]
        return np.stack(lines), 0.008 * size

    def _lines_at(self, frame: int, local, rows, sources, size: float, device) -> np.ndarray:
        """Return the field lines of a frame, shape [lines, points, 3]."""
        places, moments = self._moments(frame)
        external, unit = self._record.external[frame], self._unit

        def field(points):
            return h_field(places, moments, points * unit, radii=self.radii * unit, device=device) + external

        def ends(points):
            """Return true for points inside a magnet, or far from all magnets."""
            inside, near = np.zeros(len(points), dtype=bool), np.zeros(len(points), dtype=bool)
            for magnet in sources.tolist():
                low, high = self._boxes[magnet]
                shell = (1.0 - _OFFSET) * 0.5 * (high - low)
                away = self._in_body(points, self.rows[magnet], frame) - 0.5 * (low + high)
                ball = all(shape.radius for shape in self._shapes[magnet])
                inside |= (away**2).sum(axis=1) < shell[0] ** 2 if ball else (np.abs(away) < shell).all(axis=1)
                near |= np.linalg.norm(away, axis=1) < _FAR * size
            return inside | ~near

        return trace(field, ends, self._placed(local, rows, frame), size)

    def _in_body(self, points: np.ndarray, row: int, frame: int) -> np.ndarray:
        """Return points of the world in the frame of a body."""
        if row < 0:
            return points
        turn = self._record.rotations[frame, row].astype(float) * (-1.0, -1.0, -1.0, 1.0)
        away = points - self._record.positions[frame, row]
        return rotate(np.broadcast_to(turn, (len(points), 4)), away)

    def _moments(self, frame: int) -> tuple[np.ndarray, np.ndarray]:
        """Return positions [m] and moments [A·m²] of all parts of the magnets at a frame."""
        places = self._placed(self.local, self.rows[self.owners], frame) * self._unit
        return places, self._record.moments[frame, self.owners] * self._shares[:, None]

    def _placed(self, local: np.ndarray, rows: np.ndarray, frame: int) -> np.ndarray:
        """Return points of bodies in the world at a frame; row -1 is the world itself."""
        record, placed = self._record, local.copy()
        own = rows >= 0
        turns = record.rotations[frame, rows[own]].astype(float)
        placed[own] = rotate(turns, local[own]) + record.positions[frame, rows[own]]
        return placed


def trace(
    field: Callable[[np.ndarray], np.ndarray],
    ends: Callable[[np.ndarray], np.ndarray],
    seeds: np.ndarray,
    size: float,
) -> np.ndarray:
    """Return field lines through points, by the midpoint rule in steps of equal length.

    Args:
        field: Function that returns the field at points, shape [k, 3]; a line ends where the field is zero.
        ends: Function that returns whether a line ends at points, shape [k].
        seeds: First points of the lines, shape [k, 3].
        size: Size that the length of steps is proportional to.

    Returns:
        Points of the lines, evenly along each, shape [k, points, 3].
    """
    lines = np.empty((_STEPS + 1, len(seeds), 3))
    lines[0] = seeds
    last = np.zeros(len(seeds), dtype=int)
    going = np.ones(len(seeds), dtype=bool)
    for step in range(_STEPS):
        lines[step + 1] = lines[step]
        if not going.any():
            continue
        here = lines[step, going]
        direction = _direction(field(here + 0.5 * _STEP * size * _direction(field(here))))
        there = here + _STEP * size * direction
        lines[step + 1, going] = there
        last[going] = step + 1
        stay = direction.any(axis=1) & ~ends(there)
        going[going] = stay
    at = np.linspace(0.0, 1.0, _POINTS)[:, None] * last
    low = np.minimum(at.astype(int), _STEPS - 1)
    part = (at - low)[..., None]
    line = np.arange(len(seeds))
    return ((1.0 - part) * lines[low, line] + part * lines[low + 1, line]).transpose(1, 0, 2)


def _direction(field: np.ndarray) -> np.ndarray:
    size = np.linalg.norm(field, axis=1, keepdims=True)
    return np.where(size > 0.0, field / np.maximum(size, 1e-300), 0.0)


def _box(shapes: Sequence[DrawnShape]) -> np.ndarray:
    """Return the corners of the bounding box of shapes, shape [2, 3]."""
    lows = [shape.middle - shape.radius if shape.radius else shape.points.min(axis=0) for shape in shapes]
    highs = [shape.middle + shape.radius if shape.radius else shape.points.max(axis=0) for shape in shapes]
    return np.array([np.min(lows, axis=0), np.max(highs, axis=0)])


def _moments_of(shapes: Sequence[DrawnShape], others: int) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return positions, volumes and radii of the moments of a magnet's shapes.

    Args:
        shapes: The shapes of the magnet.
        others: Number of shapes of all magnets that are not balls.
    """
    parts = []
    for shape in shapes:
        box = np.ptp(shape.points, axis=0) if len(shape.points) else np.zeros(3)
        if shape.radius:
            part = np.array([shape.middle]), np.array([4.0 / 3.0 * np.pi * shape.radius**3]), np.array([shape.radius])
        else:
            spacing = 0.0 if others <= _FINE_COUNT else float(np.cbrt(box.prod() / _COARSE_COUNT))
            try:
                filled = lattice.fill(lattice.mesh(shape.points, _triangles(shape.faces)), spacing)
                part = filled.positions, filled.volumes, filled.inner_radii
            except InputError:  # an open mesh counts as its bounding box
                part = np.array([shape.middle]), np.array([box.prod()]), np.array([0.5 * box.min()])
        parts.append(part)
    places, volumes, radii = (np.concatenate(arrays) for arrays in zip(*parts, strict=True))
    return places, volumes, radii


def _seeds(shapes: Sequence[DrawnShape], along: np.ndarray, count: int, offset: float) -> np.ndarray:
    """Return points above the surface of a magnet, with a density proportional to its positive magnetic charge M·n.

    Args:
        shapes: The shapes of the magnet.
        along: Direction of its moment, in the frame of the shapes, shape [3].
        count: Number of points.
        offset: Distance of the points from the surface.
    """
    z = along / np.linalg.norm(along)
    surfaces = [
        (shape.middle + shape.radius * BALL[0], BALL[1]) if shape.radius else (shape.points, shape.faces)
        for shape in shapes
    ]
    triangles = np.concatenate([points[_triangles(faces)] for points, faces in surfaces])
    areas = np.cross(triangles[:, 1] - triangles[:, 0], triangles[:, 2] - triangles[:, 0])
    charge = np.cumsum(np.maximum(areas @ z, 0.0))
    order = np.arange(count) + 0.5
    chosen = np.searchsorted(charge, charge[-1] * order / count)
    a, b = (
        np.mod(order * 0.7548776662466927, 1.0),
        np.mod(order * 0.5698402909980532, 1.0),
    )  # R2 low-discrepancy sequence
    a, b = np.where(a + b > 1.0, (1.0 - a, 1.0 - b), (a, b))
    corners = triangles[chosen]
    places = corners[:, 0] + a[:, None] * (corners[:, 1] - corners[:, 0]) + b[:, None] * (corners[:, 2] - corners[:, 0])
    return places + offset * areas[chosen] / np.linalg.norm(areas[chosen], axis=1, keepdims=True)


def _triangles(faces: Sequence[np.ndarray]) -> np.ndarray:
    """Return the triangles of polygons, as fans from their first corners, shape [k, 3]."""
    return np.array([(face[0], a, b) for face in faces for a, b in itertools.pairwise(face[1:])])
