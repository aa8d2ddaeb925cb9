"""Coils with a resistance on a Newton model: their circuits, and the arrays of their state."""

from collections.abc import Sequence
from itertools import pairwise

import newton
import numpy as np
import warp as wp

from warpmag.declarations.attributes import NAMESPACE
from warpmag.declarations.coils import SourceRecord
from warpmag.engine.magnets.world_reset import WorldMask, WorldRows
from warpmag.errors import InputError
from warpmag.kernels.applied.circuits import CircuitArrays, CircuitSteps
from warpmag.kernels.applied.sources import SourceKind
from warpmag.moments.system import MomentSystem
from warpmag.shapes.inductance import mutual_inductance, self_inductance

_POSE_DIGITS = 4
"""Digits of relative poses, over the size of a coil, to which inductances of replicated worlds are shared."""
_LEAST_ENERGY = 1e-4
"""Smallest energy of currents through coupled coils, over that without the coupling."""


class CoilCircuits:
    """The coils of a model whose currents follow from voltages (``kernels.applied.circuits``).

    Attributes:
        shapes: Shape of each coil, in the order of the arrays: by world, then by number.
        labels: Labels of these shapes.
        currents: Currents at the end of the last step [A], on the device, shape [coils].
        flux: Flux through one turn of each coil [Wb], on the device, float64, shape [coils].
    """

    def __init__(
        self, model: newton.Model, shapes: Sequence[int], records: Sequence[SourceRecord], system: MomentSystem
    ):
        """Compute the inductances; ``shapes`` and ``records`` are those of the sources of ``system``."""
        applied = system.sources.applied
        circuits = [k for k, record in enumerate(records) if record.circuit is not None]
        for k in circuits:
            if applied[k].world < 0:
                label = model.shape_label[shapes[k]]
                raise InputError(f"{label}: a coil with a resistance outside all worlds, while several hold magnets")
        circuits.sort(key=lambda k: (applied[k].world, shapes[k]))
        self._system, self._attributes = system, getattr(model, NAMESPACE)
        self.shapes = [shapes[k] for k in circuits]
        self.labels = [model.shape_label[shape] for shape in self.shapes]
        self._arrays = self._make_arrays(circuits, [records[k] for k in circuits])
        inductances = _Inductances(model, shapes, records, applied)
        worlds = np.array([applied[k].world for k in circuits])
        self._set_inductances(inductances, circuits, worlds)
        self.currents, self.flux = self._arrays.current, self._arrays.flux
        moments = np.array([system.world_ranges[world] for world in np.unique(worlds)])[:, [0, 2]]
        self._steps = CircuitSteps(self._arrays, system.sources, moments)
        self._rows = [WorldRows(array, model.shape_world.numpy()[self.shapes]) for array in self._state()]

    def _put(self, values, dtype) -> wp.array:
        return wp.array(np.ascontiguousarray(values), dtype=dtype, device=self._system.device)

    def _make_arrays(self, circuits: list[int], records: list[SourceRecord]) -> CircuitArrays:
        """Return the arrays of the circuits, without those of worlds and inductances."""
        windings = [record.circuit for record in records]
        turns, a, count = np.array([winding.turns for winding in windings]), CircuitArrays(), len(circuits)
        a.source, a.shape = (self._put(values, wp.int32) for values in (circuits, self.shapes))
        a.turns = self._put(turns, wp.float64)
        a.resistance = self._put([winding.resistance for winding in windings] / turns**2, wp.float64)
        a.voltage, a.strength = self._attributes.voltage, self._attributes.strength
        a.flux, a.fresh = self._put(np.zeros(count), wp.float64), self._put(np.ones(count), wp.int32)
        a.current = self._put(a.strength.numpy()[self.shapes] / turns, wp.float32)
        return a

    def _set_inductances(self, inductances: "_Inductances", circuits: list[int], worlds: np.ndarray) -> None:
        """Set the inductances between circuits of a world, and to the coils with given currents."""
        _, begin, world = np.unique(worlds, return_index=True, return_inverse=True)
        begin, count = [*begin.tolist(), len(circuits)], len(circuits)
        table = np.zeros((count, max(last - first for first, last in pairwise(begin))))
        for row, k in enumerate(circuits):
            first, last = begin[world[row]], begin[world[row] + 1]
            table[row, : last - first] = [inductances.between(k, j) for j in circuits[first:last]]
        for first, last in pairwise(begin):
            table[first:last, : last - first] = _with_positive_energy(table[first:last, : last - first])
        given_of = [inductances.given(k) for k in circuits]
        given = np.full((count, max(map(len, given_of))), -1)
        given_table = np.zeros(given.shape)
        for row, (k, sources) in enumerate(zip(circuits, given_of, strict=True)):
            given[row, : len(sources)] = [inductances.shapes[j] for j in sources]
            given_table[row, : len(sources)] = [inductances.between(k, j) for j in sources]
        a = self._arrays
        a.world, a.begin, a.given = (self._put(values, wp.int32) for values in (world, begin, given))
        a.inductance, a.given_inductance = self._put(table, wp.float64), self._put(given_table, wp.float64)
        a.response = wp.zeros_like(a.inductance)

    def _state(self) -> list[wp.array]:
        """Return the arrays that one step passes to the next, besides the strengths of the model."""
        a = self._arrays
        return [a.flux, a.response, a.fresh, a.current]

    def step(self, dt: float, sharing: wp.array | None = None) -> None:
        """Launch a step of ``dt`` [s], which ends with an induction solve (``CircuitSteps.step``)."""
        self._steps.step(self._system, dt, sharing)

    def persistent_arrays(self) -> dict[str, wp.array]:
        """Return the arrays that one step passes to the next, and the voltages, by name."""
        names = ("flux", "response", "fresh", "current")
        return {"voltage": self._arrays.voltage} | dict(zip(names, self._state(), strict=True))

    def stepped_arrays(self) -> list[wp.array]:
        """Return the arrays that a step changes; restoring them repeats it."""
        return [self._arrays.strength, *self._state()]

    def reset(self, mask: WorldMask) -> None:
        """Launch a reset of the circuits of chosen worlds to their initial state, with the strengths of the model."""
        for rows in self._rows:
            rows.restore(mask)


def _with_positive_energy(table: np.ndarray) -> np.ndarray:
    """Return inductances of coils [H] with mutual inductances reduced by a factor if the energy could be negative.

    Inductances that are given, and rounding at coils in the same place, may contradict the geometry. The currents would
    grow without bounds.
    """
    sizes = np.sqrt(np.diag(table))
    excess = max(_LEAST_ENERGY - np.linalg.eigvalsh(table / np.outer(sizes, sizes))[0], 0.0)
    return (table + excess * np.diag(np.diag(table))) / (1.0 + excess)


class _Inductances:
    """Inductances of the coils among the sources of a model, for one turn each [H]."""

    def __init__(self, model: newton.Model, shapes: Sequence[int], records: Sequence[SourceRecord], applied):
        self.shapes, self._records, self._applied = shapes, records, applied
        self._frames = model.shape_transform.numpy()[list(shapes)].astype(float)
        self._known: dict[tuple, float] = {}
        self._given: dict[int, list[int]] = {}  # coils with given currents by world, -1 for all worlds
        for k, record in enumerate(records):
            if record.circuit is None:
                self._given.setdefault(applied[k].world, []).append(k)

    def given(self, k: int) -> list[int]:
        """Return the coils with given currents in the world of source k that do not move relative to it."""
        worlds = -1, self._applied[k].world
        return [j for world in worlds for j in self._given.get(world, []) if self._are_linked(k, j)]

    def between(self, k: int, j: int) -> float:
        """Return the inductance of one turn of source k to one of source j; 0 if they move relative to each other."""
        record, other = self._records[k], self._records[j]
        if k == j:
            if record.circuit is not None and record.circuit.inductance:
                return record.circuit.inductance / record.circuit.turns**2
            return self._once((id(record),), lambda: self_inductance(record))
        if not self._are_linked(k, j):
            return 0.0
        size = np.abs(self._applied[k].extent()).max()
        inverse = wp.transform_inverse(wp.transform(*self._frames[k].tolist()))
        pose = inverse * wp.transform(*self._frames[j].tolist())
        rotation, offset = np.array(wp.quat_to_matrix(pose.q)).reshape(3, 3), np.array(pose.p)
        key = id(record), id(other), *np.round([*rotation.ravel(), *offset / size], _POSE_DIGITS).tolist()
        return self._once(key, lambda: mutual_inductance(record, other, rotation, offset))

    def _are_linked(self, k: int, j: int) -> bool:
        """Return True for coils of one world that do not move relative to each other."""
        source, other = self._applied[k], self._applied[j]
        return SourceKind.FIELD_MAP not in (source.kind, other.kind) and source.body == other.body

    def _once(self, key: tuple, value) -> float:
        if key not in self._known:
            self._known[key] = value()
        return self._known[key]
