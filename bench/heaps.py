"""Random heaps of iron bodies and magnets: ``python -m bench.heaps --count 2000 --seed 7``.

The bodies of a heap touch and intersect. Its induction is solved. Forces and torques must be finite and sum to zero,
and the operator of induction must be positive definite. Each heap that fails is one JSON line. The last line is a
summary.

Heaps are worlds of one model, :data:`BATCH` at a time. The bodies of a batch have one geometry for each shape.
"""

import argparse
import json
import math
import time
from dataclasses import asdict, dataclass

import newton
import numpy as np
import warp as wp
from scipy.spatial.transform import Rotation

import warpmag
from bench.prisms import prism
from bench.reference.oracle import MU0
from warpmag.declarations.measured import MEASURED_CURVES

BATCH = 50
"""Largest number of heaps in a model."""
_SIZES = 0.004, 0.02  # half of the largest extent of a body [m]
_CELLS = 8, 120  # number of cells in the bounding box of a body, about
_SUSCEPTIBILITIES, _FIELDS = (10.0, 5000.0), (1e3, 1e6)  # fields in A/m
_UNSATURATED = 1e9  # saturation of iron with a linear curve [A/m]
_REMANENCE = 1e6  # of magnets [A/m]
_SETTLED = 1e-4  # tolerance of the solve
IMBALANCE = 1e-3
"""Largest sum of forces or torques over the sum of their absolute values. Half of the heaps are below 1e-7, nine of
ten below 1e-6. Where a Gauss point of one body is at a distance p from an edge of another one, rounding of float32 is a
share 6e-8 size/p of the force, and p counts from 1e-4 of a size (``box_field.h``). In float64 sums are below 1e-13."""
_LETTERS = {
    "L": ((-6, -10), (6, -10), (6, -6), (-2, -6), (-2, 10), (-6, 10)),
    "T": ((-2, -10), (2, -10), (2, 6), (7, 6), (7, 10), (-7, 10), (-7, 6), (-2, 6)),
    "E": (
        (-6, -10),
        (6, -10),
        (6, -6),
        (-2, -6),
        (-2, -2),
        (4, -2),
        (4, 2),
        (-2, 2),
        (-2, 6),
        (6, 6),
        (6, 10),
        (-6, 10),
    ),
}
"""Outlines of letters, counterclockwise, in tenths of half their height."""
_HALF_SIDES = {
    "plate": (1.0, 0.8, 0.1), "bar": (0.2, 0.25, 1.0), "cube": (1.0, 1.0, 1.0), "cylinder": (0.6, 0.6, 1.0),
    "disc": (1.0, 1.0, 0.15), "ball": (1.0, 1.0, 1.0), "ball of cells": (1.0, 1.0, 1.0), "L": (0.6, 0.2, 1.0),
    "T": (0.7, 0.2, 1.0), "E": (0.6, 0.2, 1.0),
}  # fmt: skip
"""Half sides of the bounding boxes of shapes over the largest. A ``ball`` is one moment."""


@dataclass(frozen=True)
class Geometry:
    """A body without a pose."""

    shape: str
    half: np.ndarray  # half sides of its bounding box [m], shape [3]
    spacing: float  # of its cells [m]
    mesh: newton.Mesh | None  # of a letter


@dataclass(frozen=True)
class Piece:
    """A body of a heap."""

    geometry: Geometry
    center: np.ndarray  # [m], shape [3]
    turn: Rotation
    material: dict  # arguments of ``add_inducible`` or, with a magnetization, of ``add_permanent``


@dataclass(frozen=True)
class Heap:
    """Bodies that touch or intersect, in a uniform field."""

    pieces: list[Piece]
    field: np.ndarray  # [A/m], shape [3]


@dataclass
class Verdict:
    """Result of a heap."""

    number: int
    cells: int
    evaluations: int
    converged: bool
    finite: bool
    force_sum: float  # over the sum of absolute values
    torque_sum: float
    demagnetization: float | None = None  # least eigenvalue of D in H = H0 - D M, where it is computed
    operator: float | None = None  # least eigenvalue of 1/χ + D

    @property
    def passes(self) -> bool:
        """True if the heap is solved and balanced, and its operator, where known, is positive definite."""
        balanced = self.force_sum <= IMBALANCE and self.torque_sum <= IMBALANCE
        return self.converged and self.finite and balanced and (self.operator is None or self.operator > 0.0)


def draw(batch: int, seed: int) -> list[Heap]:
    """Return the heaps of a batch."""
    rng = np.random.default_rng((seed, batch))
    geometries = [_geometry(rng, shape) for shape in _HALF_SIDES]
    return [_heap(rng, geometries) for _ in range(BATCH)]


def _geometry(rng, shape: str) -> Geometry:
    size, cells = rng.uniform(*_SIZES), _logarithmic(rng, _CELLS)
    half = size * np.array(_HALF_SIDES[shape])
    mesh = prism(0.1 * size * np.array(_LETTERS[shape]), half[1]) if shape in _LETTERS else None
    return Geometry(shape, half, 0.0 if shape == "ball" else float(np.cbrt(8.0 * half.prod() / cells)), mesh)


def _heap(rng, geometries: list[Geometry]) -> Heap:
    """Return two to six bodies; one of them is a magnet in every third heap or so."""
    pieces: list[Piece] = []
    count, magnet = rng.integers(2, 7), rng.integers(0, 12)
    for k in range(count):
        geometry = geometries[rng.integers(len(geometries))]
        center, turn = _pose(rng, pieces, geometry.half)
        pieces.append(Piece(geometry, center, turn, _magnet(rng) if k == magnet else _iron(rng)))
    return Heap(pieces, _direction(rng) * _logarithmic(rng, _FIELDS))


def _pose(rng, pieces: list[Piece], half: np.ndarray) -> tuple[np.ndarray, Rotation]:
    """Center [m] and rotation of a body: face on face of an earlier one, or turned and touching or intersecting."""
    if not pieces:
        return np.zeros(3), _turn(rng)
    below = pieces[rng.integers(len(pieces))]
    if rng.random() < 0.4:
        axis, offset = rng.integers(3), rng.uniform(-0.5, 0.5, 3) * half
        offset[axis] = rng.choice((-1.0, 1.0)) * (half + below.geometry.half)[axis] * rng.choice((1.0, 1.02))
        return below.center + below.turn.apply(offset), below.turn
    reach = half.max() + rng.uniform(0.1, 1.0) * below.geometry.half.max()
    return below.center + _direction(rng) * reach * rng.uniform(0.1, 1.0), _turn(rng)


def _iron(rng) -> dict:
    kind = str(rng.choice(("linear", "tanh", "frohlich", "measured")))
    if kind == "measured":
        return {"material": str(rng.choice(list(MEASURED_CURVES)))}
    material = {"susceptibility": _logarithmic(rng, _SUSCEPTIBILITIES)}
    return material | ({"saturation": _UNSATURATED} if kind == "linear" else {"curve": kind})


def _magnet(rng) -> dict:
    magnetization = tuple((_REMANENCE * _direction(rng)).tolist())
    return {"magnetization": magnetization, "recoil_permeability": float(rng.choice((1.0, 1.05)))}


def _logarithmic(rng, limits: tuple[float, float]) -> float:
    return float(np.exp(rng.uniform(*np.log(limits))))


def _turn(rng) -> Rotation:
    return Rotation.from_quat(rng.normal(size=4))


def _direction(rng) -> np.ndarray:
    vector = rng.normal(size=3)
    return vector / np.linalg.norm(vector)


class SolvedHeaps:
    """Heaps in equilibrium, each in a world of one model."""

    def __init__(self, heaps: list[Heap], device="cpu"):
        """Build the model, and solve."""
        builder, self.heaps = _new_builder(), heaps
        for heap in heaps:
            world = _new_builder()
            for piece in heap.pieces:
                _add(world, piece)
            builder.add_world(world)
        model = builder.finalize(device=device)
        self.magnetics, self.state = warpmag.Magnetics(model, rtol=_SETTLED), model.state()
        self.magnetics.set_external_field(np.array([heap.field for heap in heaps]))
        self.state.clear_forces()
        self.magnetics.apply(self.state)

    def verdicts(self, first: int, most_cells: int = 0) -> list[Verdict]:
        """Verdicts of the heaps, numbered from ``first``, with eigenvalues up to a number of cells.

        Eigenvalues overwrite the moments.
        """
        system, verdicts = self.magnetics.system, []
        arrays = system.positions, system.moments, system.h, system.forces, system.torques
        values = [array.numpy().astype(float) for array in arrays]
        evaluations, converged, energies = system.evaluations.numpy(), system.converged.numpy(), self.magnetics.energy()
        for world, (begin, _, end) in enumerate(system.world_ranges):
            cells = slice(begin, end)
            own = [array[cells] for array in values]
            finite = math.isfinite(energies[world]) and all(np.isfinite(array).all() for array in own)
            results = int(evaluations[world]), bool(converged[world]), finite
            verdicts.append(Verdict(first + world, end - begin, *results, *self._imbalances(world, cells, *own)))
        chosen = [verdict for verdict in verdicts if verdict.cells <= most_cells]
        for verdict, pair in zip(chosen, self._least_eigenvalues([v.number - first for v in chosen]), strict=True):
            verdict.demagnetization, verdict.operator = pair
        return verdicts

    def _imbalances(self, world: int, cells: slice, positions, moments, h, forces, torques) -> tuple[float, float]:
        """Sums of forces and torques over the sums of their absolute values.

        Torques are about the origin, without those of the applied field. The solver leaves out those on the moments of
        single balls, which are 0 in equilibrium. Forces on bodies inside a ball are 0: they count from a thousandth of
        the torque of the applied field over the extent of the heap.
        """
        extent = np.linalg.norm(positions - positions[0], axis=1).max()
        least_force = (
            1e-3 * MU0 * np.linalg.norm(moments, axis=1).sum() * np.linalg.norm(self.heaps[world].field) / extent
        )
        balls = self._single_balls()[cells, None]
        turning = [
            torques,
            np.cross(positions, forces),
            -MU0 * np.cross(moments, self.heaps[world].field),
            MU0 * np.cross(moments, h) * balls,
        ]
        return _balance([forces], least_force), _balance(turning)

    def _single_balls(self) -> np.ndarray:
        """True for moments that are a whole inducible ball each, shape [moments]."""
        magnets = self.magnetics.magnets
        single = [magnet.magnet.kind == "inducible" and magnet.lattice.coupling is None for magnet in magnets]
        return np.repeat(single, [len(magnet.lattice.volumes) for magnet in magnets])

    def _least_eigenvalues(self, worlds: list[int]) -> list[tuple[float, float]]:
        """Least eigenvalues of the demagnetization D and of 1/χ + D of worlds.

        D is made of the fields of unit moments, one in each world at a time. Roots of volumes make it symmetric. χ is
        the largest slope of a curve.
        """
        system = self.magnetics.system
        rows = [np.arange(begin, middle) for begin, middle, _ in (system.world_ranges[world] for world in worlds)]
        volumes = 4.0 / 3.0 * math.pi * system.radii.numpy().astype(float) ** 3
        slopes = system.material.slope.numpy().astype(float)  # of balls, 3χ/(3 + χ)
        base = self._field_of(np.zeros((system.count, 3)))
        strength = np.maximum(np.linalg.norm(base, axis=1).max(), 1.0)
        matrices = [np.empty((len(own), 3, len(own), 3)) for own in rows]
        for k in range(max(map(len, rows), default=0)):
            active = [(own, matrix) for own, matrix in zip(rows, matrices, strict=True) if k < len(own)]
            sources = [own[k] for own, _ in active]
            for axis in range(3):
                moments = np.zeros((system.count, 3))
                moments[sources, axis] = strength * volumes[sources]
                field = (self._field_of(moments) - base) / strength
                for own, matrix in active:
                    matrix[:, :, k, axis] = field[own] * np.sqrt(volumes[own] / volumes[own[k]])[:, None]
        return [_least(matrix, slopes[own]) for matrix, own in zip(matrices, rows, strict=True)]

    def _field_of(self, moments: np.ndarray) -> np.ndarray:
        """Field of moments [A·m²] at the inducible moments, without a moment's own field [A/m], shape [moments, 3]."""
        system = self.magnetics.system
        system.moments.assign(moments)
        system._packed.pack(system.positions, system.moments)
        system.evaluate()
        return system.h.numpy().astype(float)


def _new_builder() -> newton.ModelBuilder:
    builder = newton.ModelBuilder(gravity=(0.0, 0.0, 0.0))
    warpmag.register_custom_attributes(builder)
    return builder


def _add(builder: newton.ModelBuilder, piece: Piece) -> None:
    """Add a body with its shape and its magnet."""
    body = builder.add_body(xform=wp.transform(piece.center, wp.quat(*piece.turn.as_quat())))
    geometry, half = piece.geometry, piece.geometry.half
    if geometry.mesh is not None:
        builder.add_shape_mesh(body, mesh=geometry.mesh)
    elif geometry.shape in ("cylinder", "disc"):
        builder.add_shape_cylinder(body, radius=half[0], half_height=half[2])
    elif geometry.shape in ("ball", "ball of cells"):
        builder.add_shape_sphere(body, radius=half[0])
    else:
        builder.add_shape_box(body, hx=half[0], hy=half[1], hz=half[2])
    add = warpmag.add_permanent if "magnetization" in piece.material else warpmag.add_inducible
    add(builder, body=body, moment_spacing=geometry.spacing, **piece.material)


def _balance(parts: list[np.ndarray], least: float = 1e-300) -> float:
    """Length of the sum of vectors over the sum of their lengths, or over ``least`` where that is larger."""
    vectors = np.concatenate(parts)
    return float(np.linalg.norm(vectors.sum(axis=0)) / max(np.linalg.norm(vectors, axis=1).sum(), least))


def _least(field: np.ndarray, slopes: np.ndarray) -> tuple[float, float]:
    """Least eigenvalues of D = 1/3 - field and of 1/χ + D."""
    size = 3 * len(slopes)
    demagnetization = np.eye(size) / 3.0 - field.reshape(size, size)
    operator = demagnetization + np.diag(np.repeat(1.0 / slopes - 1.0 / 3.0, 3))
    least = [float(np.linalg.eigvalsh(0.5 * (a + a.T))[0]) for a in (demagnetization, operator)]
    return least[0], least[1]


def judge(count: int, seed: int, most_cells: int = 0, device="cpu"):
    """Yield the verdicts of heaps of a seed."""
    for first in range(0, count, BATCH):
        heaps = draw(first // BATCH, seed)[: count - first]
        yield from SolvedHeaps(heaps, device).verdicts(first, most_cells)


def main() -> None:
    """Judge heaps and print those that fail."""
    parser = argparse.ArgumentParser(prog="python -m bench.heaps", description=__doc__.partition(":")[0])
    parser.add_argument("--count", type=int, default=2000)
    parser.add_argument("--seed", type=int, default=7)
    parser.add_argument("--device", default="cpu")
    parser.add_argument("--eigenvalues", type=int, default=0, metavar="N", help="of heaps of at most N cells")
    options = parser.parse_args()
    wp.config.log_level = wp.LOG_WARNING
    began, verdicts = time.perf_counter(), []
    for verdict in judge(options.count, options.seed, options.eigenvalues, options.device):
        verdicts.append(verdict)
        if not verdict.passes:
            print(json.dumps(asdict(verdict)), flush=True)
    spectra = [verdict for verdict in verdicts if verdict.operator is not None]
    summary = {"heaps": len(verdicts), "failed": sum(not verdict.passes for verdict in verdicts)}
    for name in ("cells", "evaluations", "force_sum", "torque_sum"):
        column = [getattr(verdict, name) for verdict in verdicts]
        summary |= {f"median {name}": float(np.median(column)), f"largest {name}": max(column)}
    summary["above 1e-6"] = sum(verdict.force_sum > 1e-6 or verdict.torque_sum > 1e-6 for verdict in verdicts)
    summary["eigenvalues of"] = len(spectra)
    for name in ("demagnetization", "operator") if spectra else ():
        summary[f"least {name}"] = min(getattr(verdict, name) for verdict in spectra)
    print(json.dumps(summary | {"seconds": round(time.perf_counter() - began, 1)}))


if __name__ == "__main__":
    main()
