"""Writes what was simulated for others: stages for renderers, web pages, and arrays of numbers."""

import csv
import itertools
import os
from collections.abc import Sequence
from pathlib import Path

import numpy as np

from warpmag.declarations.checks import check_positive, check_token, short_repr
from warpmag.errors import InputError
from warpmag.moments.fields import h_field, wrench
from warpmag.shapes import lattice
from warpmag.show.field_lines import trace
from warpmag.show.meshes import BALL
from warpmag.show.render_layer import RenderLayer
from warpmag.usd import Recording, open_motion, read_recording, usable_path
from warpmag.usd.write.placements import rotate

COLORS = {"magnetization": "A/m", "speed": "m/s", "force": "N"}
"""What bodies can be coloured by, and its unit."""
_TOP = 0.99
"""Part of all values that a colour scale spans; a few collisions would leave one colour for the rest."""
_FAR = 4.0
"""Distance from the magnets, over the size of the largest, at which field lines end."""
_FEW = 8
"""Magnets of other shapes than balls that are as finely divided as a simulation does; more get fewer moments each."""
_COARSE = 27
_ARROW, _LONG = 1.6, 2.5
"""Length of the longest arrow over the size of its magnet, which counts as at most this many times the usual one's."""
_OFF = 0.03
"""Distance at which field lines begin and end, over the size of the magnet; outside, and inside."""


def export(
    stage: str | os.PathLike,
    output: str | os.PathLike,
    *,
    rate: float = 24.0,
    color: str | None = None,
    arrows: bool = False,
    field_lines: int = 0,
    materialx: bool = False,
    device: str | None = None,
) -> list[str]:
    """Export a scene, or what a run wrote.

    Positions are those of the stage, bit by bit in single precision. ``.npz`` and ``.csv`` get what was simulated in SI
    units, and take no options. ``.html`` is one web page that needs no network, to orbit and play, in the colours of
    the materials, without textures.

    Args:
        stage: USD file.
        output: File to write: ``.usd``, ``.usda``, ``.usdc``, ``.usdz``, ``.html``, ``.npz`` or ``.csv``.
        rate: Frames, and time codes, that a second takes [1/s]; Blender plays at 24, a page as time goes.
        color: What bodies are coloured by: ``magnetization``, ``speed`` or ``force``, the magnetic one, between the
            moments of the frame; by default their materials.
        arrows: Whether to draw moments as arrows.
        field_lines: How many field lines to draw from the permanent magnets, of the moments and the external field.
        materialx: Whether to describe materials in MaterialX, too.
        device: Warp device; by default Warp's.

    Returns:
        What there is to say about the result, a line each.

    Raises:
        InputError: The stage cannot be read, the output cannot be written, or an argument is wrong.
    """
    suffix = usable_path(output).suffix
    check_positive("rate", rate)
    if not (isinstance(field_lines, int) and field_lines >= 0):
        raise InputError(f"field_lines: must be a whole number from 0 on, got {short_repr(field_lines)}")
    if color is not None:
        check_token("color", color, tuple(COLORS))
    if suffix in (".npz", ".csv"):
        _write_numbers(stage, usable_path(output))
        return []
    layer, said = RenderLayer(stage, rate=rate), []
    if (color or arrows or field_lines) and not layer.recording.magnets:
        raise InputError(f"{stage}: has no moments to show, since no run has written it")
    magnets = _Magnets(layer) if color or arrows or field_lines else None
    shades = None
    if magnets and color:
        values = magnets.values(color, device)
        top = float(np.quantile(values, _TOP)) or 1.0
        shades = np.clip(values / top, 0.0, 1.0)
        said.append(f"colour         {color}, from 0 to {top:.3g} {COLORS[color]}")
    layer.add_bodies(shades)
    if magnets and arrows:
        layer.add_arrows(*magnets.arrows())
    if magnets and field_lines:
        layer.add_lines(*magnets.field_lines(field_lines, device))
    layer.save(output, materialx=materialx)
    return said


class _Magnets:
    """The magnets of a stage over time, as moments that stand for them.

    Attributes:
        local: Where these are in the frames of their bodies [units], shape [k, 3].
        owners: The magnet of each, shape [k].
        volumes: Volume of each, shape [k].
        radii: Radius of its ball, shape [k].
    """

    def __init__(self, layer: RenderLayer):
        self._record = record = layer.recording
        self._unit = record.metres_per_unit
        self._shapes = layer.shapes_of_magnets()
        loose = sum(not shape.radius for shapes in self._shapes for shape in shapes)
        parts = [_moments_of(shapes, loose) for shapes in self._shapes]
        self.local, self.volumes, self.radii = (np.concatenate([part[k] for part in parts]) for k in range(3))
        counts = [len(part[0]) for part in parts]
        self.owners = np.repeat(np.arange(len(parts)), counts)
        self.rows = np.array([shapes[0].row for shapes in self._shapes])
        self.middles = np.array([np.mean([one.middle for one in shapes], axis=0) for shapes in self._shapes])
        self.sizes = np.array([max(one.size for one in shapes) for shapes in self._shapes])
        self._boxes = [_box(shapes) for shapes in self._shapes]
        self._shares = self.volumes / np.bincount(self.owners, weights=self.volumes)[self.owners]

    def values(self, color: str, device) -> np.ndarray:
        """Return by what each body is coloured, shape [f, n]."""
        record, bodies = self._record, np.maximum(self.rows, 0)
        found = np.zeros(record.positions.shape[:2])
        if color == "speed":
            return np.linalg.norm(record.linear, axis=-1) * self._unit
        if color == "magnetization":
            total = np.zeros(record.positions.shape)
            np.add.at(total, (slice(None), bodies), np.where(self.rows[:, None] < 0, 0.0, record.moments))
            volumes = np.bincount(self.owners, weights=self.volumes) * self._unit**3
            whole = np.bincount(bodies, weights=volumes, minlength=found.shape[1])
            return np.linalg.norm(total, axis=-1) / np.where(whole > 0.0, whole, np.inf)
        for frame in range(len(found)):
            places, moments = self._moments(frame)
            forces, _ = wrench(places, moments, radii=self.radii * self._unit, device=device)
            total = np.zeros((found.shape[1], 3))
            of_body = self.rows[self.owners]
            np.add.at(total, of_body[of_body >= 0], forces[of_body >= 0])
            found[frame] = np.linalg.norm(total, axis=-1)
        return found

    def arrows(self) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Return middles, moments and lengths of arrows, the longest for the strongest magnetization."""
        middles = np.stack([self._placed(self.middles, self.rows, frame) for frame in range(len(self._record.codes))])
        moments = self._record.moments
        strength = np.linalg.norm(moments, axis=-1) / np.bincount(self.owners, weights=self.volumes)
        strength /= max(float(strength.max()), 1e-300)
        sizes = np.minimum(self.sizes, _LONG * np.median(self.sizes))
        return middles, moments, _ARROW * sizes * strength

    def field_lines(self, count: int, device) -> tuple[np.ndarray, float]:
        """Return field lines, shape [f, lines, points, 3], and the width of their curves."""
        record = self._record
        sources = np.flatnonzero(record.permanent & (np.linalg.norm(record.moments[0], axis=-1) > 0.0))
        if not len(sources):
            raise InputError("field_lines: there is no permanent magnet that they could begin at")
        each = -(-count // len(sources))
        local, rows = [], np.repeat(self.rows[sources], each)
        for magnet in sources.tolist():
            row = self.rows[magnet]
            back = record.turns[:1, row] * (-1.0, -1.0, -1.0, 1.0) if row >= 0 else np.array([[0.0, 0.0, 0.0, 1.0]])
            along = rotate(back, record.moments[:1, magnet].astype(float))[0]
            local.append(_seeds(self._shapes[magnet], along, each, _OFF * self.sizes[magnet]))
        local, size = np.concatenate(local), float(self.sizes[sources].max())
        lines = [self._lines_at(frame, local, rows, sources, size, device) for frame in range(len(record.codes))]
        return np.stack(lines), 0.008 * size

    def _lines_at(self, frame: int, local, rows, sources, size: float, device) -> np.ndarray:
        """Return the field lines of a sample, shape [lines, points, 3]."""
        places, moments = self._moments(frame)
        external, unit = self._record.external[frame], self._unit

        def field(points):
            return h_field(places, moments, points * unit, radii=self.radii * unit, device=device) + external

        def ends(points):
            """Whether points are in a magnet, or far from all of them."""
            inside, near = np.zeros(len(points), dtype=bool), np.zeros(len(points), dtype=bool)
            for magnet in sources.tolist():
                low, high = self._boxes[magnet]
                shell = (1.0 - _OFF) * 0.5 * (high - low)
                away = self._taken_back(points, self.rows[magnet], frame) - 0.5 * (low + high)
                ball = all(one.radius for one in self._shapes[magnet])
                inside |= (away**2).sum(axis=1) < shell[0] ** 2 if ball else (np.abs(away) < shell).all(axis=1)
                near |= np.linalg.norm(away, axis=1) < _FAR * size
            return inside | ~near

        return trace(field, ends, self._placed(local, rows, frame), size)

    def _taken_back(self, points: np.ndarray, row: int, frame: int) -> np.ndarray:
        """Return where points of the world are in the frame of a body."""
        if row < 0:
            return points
        turn = self._record.turns[frame, row].astype(float) * (-1.0, -1.0, -1.0, 1.0)
        away = points - self._record.positions[frame, row]
        return rotate(np.broadcast_to(turn, (len(points), 4)), away)

    def _moments(self, frame: int) -> tuple[np.ndarray, np.ndarray]:
        """Return places [m] and moments [A·m²] of all parts of the magnets at a sample."""
        places = self._placed(self.local, self.rows[self.owners], frame) * self._unit
        return places, self._record.moments[frame, self.owners] * self._shares[:, None]

    def _placed(self, local: np.ndarray, rows: np.ndarray, frame: int) -> np.ndarray:
        """Return where points of bodies are in the world at a sample; -1 is the world itself."""
        record, found = self._record, local.copy()
        own = rows >= 0
        turns = record.turns[frame, rows[own]].astype(float)
        found[own] = rotate(turns, local[own]) + record.positions[frame, rows[own]]
        return found


def _box(shapes: Sequence) -> np.ndarray:
    """Return the corners of the box of some shapes, shape [2, 3]."""
    lows = [one.middle - one.radius if one.radius else one.points.min(axis=0) for one in shapes]
    highs = [one.middle + one.radius if one.radius else one.points.max(axis=0) for one in shapes]
    return np.array([np.min(lows, axis=0), np.max(highs, axis=0)])


def _moments_of(shapes: Sequence, loose: int) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return places, volumes and radii of the moments that stand for the shapes of a magnet."""
    places, volumes, radii = [], [], []
    for shape in shapes:
        box = np.ptp(shape.points, axis=0) if len(shape.points) else np.zeros(3)
        if shape.radius:
            found = np.array([shape.middle]), np.array([4.0 / 3.0 * np.pi * shape.radius**3]), np.array([shape.radius])
        else:
            spacing = 0.0 if loose <= _FEW else float(np.cbrt(box.prod() / _COARSE))
            try:
                filled = lattice.fill(lattice.mesh(shape.points, _triangles(shape.faces)), spacing)
                found = filled.positions, filled.volumes, filled.inner_radii
            except InputError:  # an open mesh; as its box
                found = np.array([shape.middle]), np.array([box.prod()]), np.array([0.5 * box.min()])
        for one, values in zip((places, volumes, radii), found, strict=True):
            one.append(values)
    return np.concatenate(places), np.concatenate(volumes), np.concatenate(radii)


def _seeds(shapes: Sequence, along: np.ndarray, count: int, off: float) -> np.ndarray:
    """Return points a bit off the surface of a magnet, as dense as its magnetic charge M·n is where that is positive.

    Args:
        shapes: The shapes of the magnet.
        along: Direction of its moment, in the frame of the shapes, shape [3].
        count: Number of points.
        off: Their distance from the surface.
    """
    z = along / np.linalg.norm(along)
    surfaces = [
        (one.middle + one.radius * BALL[0], BALL[1]) if one.radius else (one.points, one.faces) for one in shapes
    ]
    triangles = np.concatenate([points[_triangles(faces)] for points, faces in surfaces])
    areas = np.cross(triangles[:, 1] - triangles[:, 0], triangles[:, 2] - triangles[:, 0])
    charge = np.cumsum(np.maximum(areas @ z, 0.0))
    order = np.arange(count) + 0.5
    chosen = np.searchsorted(charge, charge[-1] * order / count)
    a, b = np.mod(order * 0.7548776662466927, 1.0), np.mod(order * 0.5698402909980532, 1.0)  # evenly in the plane
    a, b = np.where(a + b > 1.0, (1.0 - a, 1.0 - b), (a, b))
    corners = triangles[chosen]
    places = corners[:, 0] + a[:, None] * (corners[:, 1] - corners[:, 0]) + b[:, None] * (corners[:, 2] - corners[:, 0])
    return places + off * areas[chosen] / np.linalg.norm(areas[chosen], axis=1, keepdims=True)


def _triangles(faces: Sequence[np.ndarray]) -> np.ndarray:
    """Return the triangles of polygons, as fans from their first corners, shape [k, 3]."""
    return np.array([(face[0], a, b) for face in faces for a, b in itertools.pairwise(face[1:])])


# ---------------------------------------------------------------------------------------------------------------------


def _write_numbers(stage: str | os.PathLike, path: Path) -> None:
    """Write what a stage shows as arrays, SI units, world frame."""
    record = read_recording(*open_motion(stage))
    columns = {
        "positions": record.positions * record.metres_per_unit,
        "orientations": record.turns,
        "velocities": record.linear * np.float32(record.metres_per_unit),
        "angular_velocities": record.angular,
    }
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
        if path.suffix == ".npz":
            names = {"bodies": np.array(record.bodies), "magnets": np.array(record.magnets)}
            with open(path, "wb") as file:
                np.savez_compressed(file, time=record.seconds, moments=record.moments, **names, **columns)
        else:
            _write_table(path, record, columns)
    except OSError as error:
        raise InputError(f"{path}: cannot be written ({error.strerror})") from None


def _write_table(path: Path, record: Recording, columns: dict[str, np.ndarray]) -> None:
    """Write a line for each body, and for each magnet that is none, at each time."""
    moments = {name: record.moments[:, k] for k, name in enumerate(record.magnets)}
    others = [name for name in record.magnets if name not in record.bodies]
    head = "time [s],prim,x [m],y [m],z [m],qx,qy,qz,qw,vx [m/s],vy [m/s],vz [m/s],wx [rad/s],wy [rad/s],wz [rad/s]"
    with open(path, "w", newline="", encoding="utf-8") as file:
        table = csv.writer(file)
        table.writerow([*head.split(","), "mx [A m2]", "my [A m2]", "mz [A m2]"])
        values = np.concatenate(list(columns.values()), axis=-1)
        for frame, second in enumerate(record.seconds.tolist()):
            for row, name in enumerate(record.bodies):
                moment = moments[name][frame].tolist() if name in moments else [""] * 3
                table.writerow([second, name, *values[frame, row].tolist(), *moment])
            for name in others:
                table.writerow([second, name, *[""] * values.shape[-1], *moments[name][frame].tolist()])
