"""Setups of iron bodies and magnets near each other, and their converged solutions by finite elements.

A setup is declared once, in :data:`SETUPS`. ``finite_elements`` solves it and writes the table ``iron_bodies.json``;
``bench.iron`` compares warpmag with the table. Names give gaps in mm.
"""

import json
import math
from dataclasses import dataclass
from pathlib import Path

from bench.reference.oracle import MU0

FILE = Path(__file__).with_name("iron_bodies.json")
CURVE = "1010-steel"
"""Material of the steel plates with a measured curve."""
_SUSCEPTIBILITY, _FIELD = 1000.0, 1e4  # of linear iron, and of a uniform applied field [A/m]
_REMANENCE = 1.3  # of N42 [T]


@dataclass(frozen=True)
class Body:
    """A body of iron or a permanent magnet."""

    shape: str  # box, cylinder, ball or prism
    size: tuple[float, ...]  # half sides of a box, radius and half height of a cylinder along z, radius [m]; of a
    # prism along y half the length
    center: tuple[float, float, float]  # [m]
    susceptibility: float = _SUSCEPTIBILITY  # of a magnet its recoil permeability less 1
    material: str | None = None  # with a measured curve, in place of the susceptibility
    magnetization: tuple[float, float, float] | None = None  # of a magnet without a field [A/m]
    turn: float = 0.0  # rotation about y [rad]
    outline: tuple[tuple[float, float], ...] = ()  # corners (x, z) of a prism around the center [m]

    @property
    def reach(self) -> float:
        """Largest distance of a point from the center [m]."""
        return math.hypot(*self.size, max((math.hypot(*corner) for corner in self.outline), default=0.0))

    @property
    def volume(self) -> float:
        """Volume [m³]."""
        if self.shape == "prism":
            edges = zip(self.outline, self.outline[1:] + self.outline[:1], strict=True)
            return self.size[0] * abs(sum(a[0] * b[1] - a[1] * b[0] for a, b in edges))
        unit = {"box": 8.0, "cylinder": 2.0 * math.pi, "ball": 4.0 / 3.0 * math.pi}[self.shape]
        powers = {"box": (1, 1, 1), "cylinder": (2, 1), "ball": (3,)}[self.shape]
        return unit * math.prod(length**power for length, power in zip(self.size, powers, strict=True))


@dataclass(frozen=True)
class Setup:
    """Bodies in a uniform field."""

    bodies: tuple[Body, ...]
    field: tuple[float, float, float] = (0.0, 0.0, 0.0)  # applied field H [A/m]

    @property
    def vectors(self) -> list[tuple[float, float, float]]:
        """Applied field and magnetizations [A/m]."""
        return [self.field, *(body.magnetization for body in self.bodies if body.magnetization)]

    @property
    def is_axial(self) -> bool:
        """True if the z axis is an axis of rotation of bodies and fields."""
        round_bodies = all(body.shape in ("ball", "cylinder") and not any(body.center[:2]) for body in self.bodies)
        return round_bodies and not any(vector[0] or vector[1] for vector in self.vectors)

    def is_mirrored(self, axis: int) -> bool:
        """True if the plane through the origin across an axis mirrors bodies, field and magnetizations."""
        oblique = axis == 0 and any(body.outline or body.turn % (0.5 * math.pi) for body in self.bodies)
        centered = not any(body.center[axis] for body in self.bodies)
        return centered and not oblique and not any(vector[axis] for vector in self.vectors)


def _millimeters(*lengths: float) -> tuple[float, ...]:
    return tuple(1e-3 * length for length in lengths)


def _cylinder(diameter: float, height: float, bottom: float, x: float = 0.0, **properties) -> Body:
    """Cylinder along z from its diameter, its height and the height of its lower face [mm]."""
    center = _millimeters(x, 0.0, bottom + 0.5 * height)
    return Body("cylinder", _millimeters(0.5 * diameter, 0.5 * height), center, **properties)


def _ball(bottom: float, x: float = 0.0) -> Body:
    """Iron ball of 10 mm from the height of its lowest point [mm]."""
    return Body("ball", _millimeters(5.0), _millimeters(x, 0.0, bottom + 5.0))


def _box(sides, bottom: float, x: float = 0.0, **properties) -> Body:
    """Box from its sides and the height of its lower face [mm]."""
    half = _millimeters(*(0.5 * side for side in sides))
    return Body("box", half, _millimeters(x, 0.0, bottom + 0.5 * sides[2]), **properties)


def _letter(corners, x: float) -> Body:
    """Iron letter of 4 mm in y from the corners (x, z) of its outline and the shift of the outline along x [mm]."""
    middle = 0.5 * max(corner[0] for corner in corners), 0.5 * max(corner[1] for corner in corners)
    outline = [_millimeters(corner[0] - middle[0], corner[1] - middle[1]) for corner in corners]
    return Body("prism", _millimeters(2.0), _millimeters(x + middle[0], 0.0, middle[1]), outline=tuple(outline))


def _magnet(permeability: float = 1.0, sign: float = 1.0) -> dict:
    """Properties of an N42 magnet along z of a recoil permeability."""
    return {"magnetization": (0.0, 0.0, sign * _REMANENCE / MU0), "susceptibility": permeability - 1.0}


def _axial_setups() -> dict[str, Setup]:
    along, setups = (0.0, 0.0, _FIELD), {}
    for gap in (0.01, 0.2, 1.0, 5.0):
        pair = _cylinder(20.0, 20.0, 0.0), _cylinder(20.0, 20.0, 20.0 + gap)
        setups[f"cylinders in line, gap {gap:g}"] = Setup(pair, along)
    for gap in (0.005, 0.2, 1.0, 5.0):
        setups[f"balls in line, gap {gap:g}"] = Setup((_ball(0.0), _ball(10.0 + gap)), along)
        setups[f"ball on plate, gap {gap:g}"] = Setup((_cylinder(60.0, 3.0, 0.0), _ball(3.0 + gap)), along)
    for count in (1, 2, 5):
        discs = tuple(_cylinder(40.0, 2.0, 2.02 * k) for k in range(count))
        setups[f"{count} discs, gap 0.02"] = Setup(discs, along)
    for count, diameter, height, gap in ((2, 30.0, 3.0, 0.05), (2, 50.0, 5.0, 0.1), (3, 25.0, 1.0, 0.01)):
        discs = tuple(_cylinder(diameter, height, (height + gap) * k) for k in range(count))
        setups[f"{count} discs of {diameter:g} x {height:g}, gap {gap:g}"] = Setup(discs, along)
    for thickness in (1.0, 3.0, 10.0):
        for gap in (0.02, 1.0, 5.0, 20.0):
            place = f"plate {thickness:g}, gap {gap:g}"
            plate = _cylinder(80.0, thickness, 0.0)
            steel = _cylinder(80.0, thickness, 0.0, material=CURVE)
            for permeability in (1.0, 1.05):
                magnet = _cylinder(20.0, 5.0, thickness + gap, **_magnet(permeability))
                setups[f"magnet μ {permeability:g} over iron {place}"] = Setup((plate, magnet))
                setups[f"magnet μ {permeability:g} over steel {place}"] = Setup((steel, magnet))
    return setups


def _solid_setups() -> dict[str, Setup]:
    setups = {}
    for gap in (0.2, 1.0):
        pair = [_cylinder(20.0, 20.0, -10.0, side * (10.0 + 0.5 * gap)) for side in (-1.0, 1.0)]
        setups[f"cylinders side by side, gap {gap:g}"] = Setup(tuple(pair), (_FIELD, 0.0, 0.0))
    for gap in (1.0, 5.0):
        cube = _box((20.0, 20.0, 20.0), 3.0 + gap, **_magnet())
        setups[f"cube magnet over iron plate 3, gap {gap:g}"] = Setup((_box((80.0, 80.0, 3.0), 0.0), cube))
    for gap in (0.2, 1.0):
        feet = [_box((10.0, 10.0, 10.0), 0.0, 15.0 * sign, **_magnet(sign=sign)) for sign in (-1.0, 1.0)]
        setups[f"bar across two magnets, gap {gap:g}"] = Setup((*feet, _box((50.0, 10.0, 5.0), 10.0 + gap)))
    for gap in (0.02, 0.2, 1.0):
        cube = _box((20.0, 20.0, 20.0), -20.0)
        setups[f"ball on the face of a cube, gap {gap:g}"] = Setup((cube, _ball(gap)), (0.0, 0.0, _FIELD))
        edge = _box((20.0, 20.0, 20.0), -10.0, turn=0.25 * math.pi)
        ball = _ball(10.0 * math.sqrt(2.0) + gap)
        setups[f"ball on the edge of a cube, gap {gap:g}"] = Setup((edge, ball), (0.0, 0.0, _FIELD))
    return setups


def _letter_setups() -> dict[str, Setup]:
    t = (5, 0), (9, 0), (9, 16), (14, 16), (14, 20), (0, 20), (0, 16), (5, 16)
    l = (0, 0), (12, 0), (12, 4), (4, 4), (4, 20), (0, 20)  # noqa: E741
    return {
        f"letters T and L, gap {gap:g}": Setup((_letter(t, -14.0 - gap), _letter(l, 0.0)), (_FIELD, 0.0, 0.0))
        for gap in (0.2, 1.0)
    }


def _assembled_setups() -> dict[str, Setup]:
    """Setups off axes of symmetry, and a circuit of four bodies: magnets stand 0.2 mm above the yoke."""
    setups = {}
    for gap in (0.2, 1.0):
        poles = [_cylinder(10.0, 5.0, 5.2, 15.0 * sign, **_magnet(sign=sign)) for sign in (-1.0, 1.0)]
        yoke, bar = _box((50.0, 12.0, 5.0), 0.0), _box((50.0, 12.0, 5.0), 10.2 + gap)
        setups[f"yoke with two magnets and bar, gap {gap:g}"] = Setup((yoke, *poles, bar))
    turn = math.radians(10.0)
    height = 10.0 * (math.cos(turn) + math.sin(turn))
    cubes = _box((20.0, 20.0, 20.0), -20.0), _box((20.0, 20.0, 20.0), 0.5 + height - 10.0, turn=turn)
    setups["tilted cube over cube, gap 0.5"] = Setup(cubes, (0.0, 0.0, _FIELD))
    plate, disc = _box((40.0, 40.0, 3.0), 0.0), _cylinder(20.0, 5.0, 4.0, 20.0, **_magnet())
    setups["magnet over the edge of iron plate 3, gap 1"] = Setup((plate, disc))
    for place in (7.0, 9.0):
        bodies = _box((20.0, 20.0, 20.0), -20.0), _ball(0.2, place)
        name = f"ball on the face of a cube, {10.0 - place:g} from its edge, gap 0.2"
        setups[name] = Setup(bodies, (0.0, 0.0, _FIELD))
    return setups


def _saturated_setups() -> dict[str, Setup]:
    """Magnets on plates that they saturate, of measured steels: material and thickness [mm] of a plate, and magnet."""
    setups = {}
    for material, thickness, magnet in (
        (CURVE, 0.5, (20.0, 5.0)), (CURVE, 0.5, (10.0, 3.0)), (CURVE, 1.0, (20.0, 20.0)), (CURVE, 1.5, (20.0, 5.0)),
        ("M-19", 1.0, (20.0, 5.0)), ("430-stainless", 1.0, (20.0, 5.0)), ("430-stainless", 3.0, (30.0, 15.0)),
    ):  # fmt: skip
        plate = _cylinder(80.0 if magnet[0] > 10.0 else 50.0, thickness, 0.0, material=material)
        name = f"magnet {magnet[0]:g} x {magnet[1]:g} on {material} {thickness:g}, gap 0.02"
        setups[name] = Setup((plate, _cylinder(*magnet, thickness + 0.02, **_magnet())))
    return setups


SETUPS = _axial_setups() | _solid_setups() | _letter_setups() | _assembled_setups() | _saturated_setups()
"""Setups by name."""


def load() -> dict[str, dict]:
    """Rows of the table by setup: forces [N] and moments [A·m²] of the bodies, shape [n, 3], and their accuracy."""
    return json.loads(FILE.read_text(encoding="utf-8")) if FILE.exists() else {}
