"""Colors, arrows and field lines of the magnets of a recording."""

from collections.abc import Callable, Sequence

import numpy as np

from warpmag.declarations.rotations import rotate
from warpmag.errors import InputError
from warpmag.moments.fields import h_field, wrench
from warpmag.shapes import lattice
from warpmag.show.meshes import BALL, triangles_of
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
_INVERSE = (-1.0, -1.0, -1.0, 1.0)
"""Factors that invert a unit quaternion x y z w."""


class MagnetOverlays:
    """The magnets of a stage over time, each replaced by moments."""

    def __init__(self, stage: RendererStage):
        """Sample the magnets of a stage."""
        self._record = record = stage.recording
        self._unit = record.meters_per_unit
        self._shapes = stage.shapes_of_magnets()
        sampled = sum(not shape.radius for shapes in self._shapes for shape in shapes)
        parts = [_moments_of(shapes, sampled) for shapes in self._shapes]
        # of each moment: position in the frame of its body, volume, radius of its ball [units], and magnet
        self._local, self._volumes, self._radii = (np.concatenate([part[k] for part in parts]) for k in range(3))
        self._owners = np.repeat(np.arange(len(parts)), [len(part[0]) for part in parts])
        self._shares = self._volumes / np.bincount(self._owners, weights=self._volumes)[self._owners]
        # of each magnet: row of its body in the recording, center, size and bounding box in the frame of the body
        self._rows = np.array([shapes[0].row for shapes in self._shapes])
        self._centers = np.array([np.mean([shape.center for shape in shapes], axis=0) for shapes in self._shapes])
        self._sizes = np.array([max(shape.size for shape in shapes) for shapes in self._shapes])
        self._boxes = [_box(shapes) for shapes in self._shapes]

    def values(self, color: str, device) -> np.ndarray:
        """Return the quantity ``color`` of each body at each frame, shape [f, n]."""
        record, bodies = self._record, np.maximum(self._rows, 0)
        values = np.zeros(record.positions.shape[:2])
        if color == "speed":
            return np.linalg.norm(record.linear, axis=-1) * self._unit
        if color == "magnetization":
            total = np.zeros(record.positions.shape)
            np.add.at(total, (slice(None), bodies), np.where(self._rows[:, None] < 0, 0.0, record.moments))
            volumes = np.bincount(self._owners, weights=self._volumes) * self._unit**3
            volumes = np.bincount(bodies, weights=volumes, minlength=values.shape[1])
            return np.linalg.norm(total, axis=-1) / np.where(volumes > 0.0, volumes, np.inf)
        rows = self._rows[self._owners]
        for frame in range(len(values)):
            positions, moments = self._moments(frame)
            forces, _ = wrench(positions, moments, radii=self._radii * self._unit, device=device)
            total = np.zeros((values.shape[1], 3))
            np.add.at(total, rows[rows >= 0], forces[rows >= 0])
            values[frame] = np.linalg.norm(total, axis=-1)
        return values

    def arrows(self) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Return centers, moments and lengths of arrows; the strongest magnetization has the longest arrow."""
        frames = range(len(self._record.codes))
        centers = np.stack([self._to_world(self._centers, self._rows, frame) for frame in frames])
        moments = self._record.moments
        strength = np.linalg.norm(moments, axis=-1) / np.bincount(self._owners, weights=self._volumes)
        strength /= max(float(strength.max()), 1e-300)
        sizes = np.minimum(self._sizes, _MOST_SIZES * np.median(self._sizes))
        return centers, moments, _ARROW * sizes * strength

    def field_lines(self, count: int, device) -> tuple[np.ndarray, float]:
        """Return field lines, shape [f, lines, points, 3], and the width of their curves."""
        record = self._record
        sources = np.flatnonzero(record.permanent & (np.linalg.norm(record.moments[0], axis=-1) > 0.0))
        if not len(sources):
            raise InputError("field_lines: the stage has no permanent magnet where they could begin")
        each = -(-count // len(sources))
        local, rows = [], np.repeat(self._rows[sources], each)
        for magnet in sources.tolist():
            row, moment = self._rows[magnet], record.moments[:1, magnet].astype(float)
            moment = rotate(record.rotations[:1, row] * _INVERSE, moment) if row >= 0 else moment
            local.append(_seeds(self._shapes[magnet], moment[0], each, _OFFSET * self._sizes[magnet]))
        local, size = np.concatenate(local), float(self._sizes[sources].max())
        lines = [self._lines_at(frame, local, rows, sources, size, device) for frame in range(len(record.codes))]
        return np.stack(lines), 0.008 * size

    def _lines_at(self, frame: int, local, rows, sources, size: float, device) -> np.ndarray:
        """Return the field lines of a frame, shape [lines, points, 3]."""
        positions, moments = self._moments(frame)
        external, unit = self._record.external[frame], self._unit

        def field(points):
            return h_field(positions, moments, points * unit, radii=self._radii * unit, device=device) + external

        def ends(points):
            """Return True for points inside a magnet, or far from all magnets."""
            inside, near = np.zeros(len(points), dtype=bool), np.zeros(len(points), dtype=bool)
            for magnet in sources.tolist():
                low, high = self._boxes[magnet]
                shell = (1.0 - _OFFSET) * 0.5 * (high - low)
                offset = self._to_body(points, self._rows[magnet], frame) - 0.5 * (low + high)
                ball = all(shape.radius for shape in self._shapes[magnet])
                inside |= (offset**2).sum(axis=1) < shell[0] ** 2 if ball else (np.abs(offset) < shell).all(axis=1)
                near |= np.linalg.norm(offset, axis=1) < _FAR * size
            return inside | ~near

        return trace(field, ends, self._to_world(local, rows, frame), size)

    def _to_body(self, points: np.ndarray, row: int, frame: int) -> np.ndarray:
        """Return points of the world in the frame of a body; row -1 is the world itself."""
        if row < 0:
            return points
        rotation = self._record.rotations[frame, row].astype(float) * _INVERSE
        return rotate(np.broadcast_to(rotation, (len(points), 4)), points - self._record.positions[frame, row])

    def _moments(self, frame: int) -> tuple[np.ndarray, np.ndarray]:
        """Return positions [m] and moments [A·m²] of all parts of the magnets at a frame."""
        positions = self._to_world(self._local, self._rows[self._owners], frame) * self._unit
        return positions, self._record.moments[frame, self._owners] * self._shares[:, None]

    def _to_world(self, local: np.ndarray, rows: np.ndarray, frame: int) -> np.ndarray:
        """Return points of bodies in the world at a frame; row -1 is the world itself."""
        record, points, moving = self._record, local.copy(), rows >= 0
        rotations = record.rotations[frame, rows[moving]].astype(float)
        points[moving] = rotate(rotations, local[moving]) + record.positions[frame, rows[moving]]
        return points


_Function = Callable[[np.ndarray], np.ndarray]


def trace(field: _Function, ends: _Function, seeds: np.ndarray, size: float) -> np.ndarray:
    """Return field lines through points, by the midpoint rule in steps of equal length.

    Args:
        field: Function that returns the field at points, shape [k, 3]; a line ends where the field is zero.
        ends: Function that returns True where a line ends at points, shape [k].
        seeds: First points of the lines, shape [k, 3].
        size: Size that the length of steps is proportional to.

    Returns:
        Points of the lines, at equal distances along each, shape [k, points, 3].
    """
    lines = np.empty((_STEPS + 1, len(seeds), 3))
    lines[0] = seeds
    last = np.zeros(len(seeds), dtype=int)
    growing = np.ones(len(seeds), dtype=bool)
    for step in range(_STEPS):
        lines[step + 1] = lines[step]
        if not growing.any():
            continue
        start = lines[step, growing]
        direction = _direction(field(start + 0.5 * _STEP * size * _direction(field(start))))
        end = start + _STEP * size * direction
        lines[step + 1, growing] = end
        last[growing] = step + 1
        growing[growing] = direction.any(axis=1) & ~ends(end)
    position = np.linspace(0.0, 1.0, _POINTS)[:, None] * last
    low = np.minimum(position.astype(int), _STEPS - 1)
    part = (position - low)[..., None]
    line = np.arange(len(seeds))
    return ((1.0 - part) * lines[low, line] + part * lines[low + 1, line]).transpose(1, 0, 2)


def _direction(field: np.ndarray) -> np.ndarray:
    size = np.linalg.norm(field, axis=1, keepdims=True)
    return np.where(size > 0.0, field / np.maximum(size, 1e-300), 0.0)


def _box(shapes: Sequence[DrawnShape]) -> np.ndarray:
    """Return the corners of the bounding box of shapes, shape [2, 3]."""
    lows = [shape.center - shape.radius if shape.radius else shape.points.min(axis=0) for shape in shapes]
    highs = [shape.center + shape.radius if shape.radius else shape.points.max(axis=0) for shape in shapes]
    return np.array([np.min(lows, axis=0), np.max(highs, axis=0)])


def _moments_of(shapes: Sequence[DrawnShape], sampled: int) -> tuple[np.ndarray, ...]:
    """Return positions, volumes and radii of a magnet's moments; ``sampled`` shapes of all magnets are not balls."""
    parts = []
    for shape in shapes:
        box = np.ptp(shape.points, axis=0) if len(shape.points) else np.zeros(3)
        if shape.radius:
            part = np.array([shape.center]), np.array([4.0 / 3.0 * np.pi * shape.radius**3]), np.array([shape.radius])
        else:
            spacing = 0.0 if sampled <= _FINE_COUNT else float(np.cbrt(box.prod() / _COARSE_COUNT))
            try:
                cells = lattice.fill(lattice.mesh(shape.points, triangles_of(shape.points, shape.faces)), spacing)
                part = cells.positions, cells.volumes, cells.inner_radii
            except InputError:  # an open mesh counts as its bounding box
                part = np.array([shape.center]), np.array([box.prod()]), np.array([0.5 * box.min()])
        parts.append(part)
    return tuple(np.concatenate(arrays) for arrays in zip(*parts, strict=True))


def _seeds(shapes: Sequence[DrawnShape], moment: np.ndarray, count: int, offset: float) -> np.ndarray:
    """Return points at a distance ``offset`` from a magnet, of density proportional to its positive charge M·n."""
    surfaces = [
        (shape.center + shape.radius * BALL[0], BALL[1]) if shape.radius else (shape.points, shape.faces)
        for shape in shapes
    ]
    triangles = np.concatenate([points[triangles_of(points, faces)] for points, faces in surfaces])
    areas = np.cross(triangles[:, 1] - triangles[:, 0], triangles[:, 2] - triangles[:, 0])
    charge = np.cumsum(np.maximum(areas @ (moment / np.linalg.norm(moment)), 0.0))
    order = np.arange(count) + 0.5
    chosen = np.searchsorted(charge, charge[-1] * order / count)
    a, b = (np.mod(order * step, 1.0) for step in (0.7548776662466927, 0.5698402909980532))  # low-discrepancy R2
    a, b = np.where(a + b > 1.0, (1.0 - a, 1.0 - b), (a, b))
    first, second, third = triangles[chosen].transpose(1, 0, 2)
    points = first + a[:, None] * (second - first) + b[:, None] * (third - first)
    return points + offset * areas[chosen] / np.linalg.norm(areas[chosen], axis=1, keepdims=True)
