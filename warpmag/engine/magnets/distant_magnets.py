"""Few moments in place of the cells of iron bodies in worlds where every other magnet keeps a distance from them."""

from dataclasses import replace
from functools import partial

import newton
import numpy as np
import warp as wp

from warpmag.declarations.magnets import MagneticSettings
from warpmag.engine.magnets.grouping import BodyMagnet
from warpmag.engine.magnets.model_values import ModelValues
from warpmag.engine.magnets.placed_moments import PlacedMoments
from warpmag.engine.magnets.sampling import BodyLattice
from warpmag.kernels.rigid.distant import (
    DistantBodies,
    DistantLaunches,
    SystemArrays,
    WorldChoice,
)
from warpmag.kernels.shared.copies import put_copies
from warpmag.moments.arrays import PersistentArray
from warpmag.moments.cached_shapes import shape_cache
from warpmag.moments.ranks import current_ranks
from warpmag.moments.resting_worlds import RestingWorlds
from warpmag.moments.system import MomentSystem
from warpmag.shapes import distant_response
from warpmag.shapes.demagnetization import Coupling, couplings_in_worlds
from warpmag.shapes.distant_response import LEAST_REPLACED_CELLS, MOST_REPLACED_CELLS, DistantBody


def distant_bodies(
    model: newton.Model, magnets: list[BodyMagnet], settings: MagneticSettings, *, method: str, has_sources: bool
) -> dict[int, list[DistantBody]]:
    """Return the few moments of iron bodies among ``magnets`` at their levels, by the index of the magnet.

    There are none where the model needs cells always.

    The fields of coils and field maps vary over a body at any distance. Recoil permeability, eddy currents, gradients
    and mirror images are computed for cells only, and several processes share sums over many moments.
    """
    materials = {id(magnet.magnet): magnet.magnet for magnet in magnets}.values()
    if (
        has_sources
        or model.requires_grad
        or (settings.dynamics, settings.contact_model) != ("theta", "dipole")
        or method == "fmm"
        or current_ranks() is not None
        or any(material.recoils or material.conductivity for material in materials)
    ):
        return {}
    coupled = {k: magnet.lattice for k, magnet in enumerate(magnets) if magnet.lattice.coupling is not None}
    large = {k: lattice for k, lattice in coupled.items() if len(lattice.volumes) >= LEAST_REPLACED_CELLS}
    if any(len(lattice.volumes) > MOST_REPLACED_CELLS for lattice in large.values()):
        return {}
    ball_worlds = {magnet.world for k, magnet in enumerate(magnets) if k not in coupled and not magnet.magnet.fixed}
    couplings = [lattice.coupling for lattice in coupled.values()]
    among = couplings_in_worlds(couplings, [magnets[k].world for k in coupled], [True] * len(coupled), ball_worlds)
    coupling_of = dict(zip(coupled, among, strict=True))
    bodies: dict[int, list[DistantBody] | None] = {}
    result = {}
    for k, lattice in large.items():
        coupling = coupling_of[k]
        if id(coupling) not in bodies:
            bodies[id(coupling)] = _few_moments(model.shape_label[magnets[k].shapes[0]], lattice, coupling)
        if (body := bodies[id(coupling)]) is None:
            return {}
        result[k] = body
    return result


def _few_moments(label: str, lattice: BodyLattice, coupling: Coupling) -> list[DistantBody] | None:
    """Return the few moments of a body at its levels, from the cache of shapes or computed."""
    key = ("distant", lattice.positions, lattice.volumes, lattice.radii, coupling.start, coupling.other)
    key = (*key, coupling.grid_tensor, coupling.common)
    return shape_cache().get(f"{label}: few moments", key, lambda: distant_response.distant_bodies(lattice, coupling))


class DistantMagnets:
    """Systems of the same magnets: levels with few moments, and one with cells. Each world solves only one of them.

    Attributes:
        levels: The moments at each level, few in place of the cells of some bodies.
    """

    def __init__(
        self, model: newton.Model, cells: PlacedMoments, bodies: dict[int, list[DistantBody]],
        settings: MagneticSettings, **options,
    ):  # fmt: skip
        """Make the systems of few moments.

        Args:
            model: The model.
            cells: All moments, with the cells of all bodies.
            bodies: Few moments at the levels of a body by the index of a magnet of ``cells.worlds``.
            settings, options: As of the system of ``cells``.
        """
        self._model, self._cells = model, cells
        count = max(len(levels) for levels in bodies.values())
        of_level = [{k: levels[min(level, len(levels) - 1)] for k, levels in bodies.items()} for level in range(count)]
        magnets = [_replaced(cells.worlds.magnets, few) for few in of_level]
        self.levels = [PlacedMoments(model, replace(cells.worlds, magnets=few), settings, **options) for few in magnets]
        in_copy = np.isin(np.arange(cells.worlds.world_step), [cells.worlds.magnets[k].world for k in bodies])
        self._choice = self._make_choice(np.tile(in_copy, cells.worlds.copies))
        tables = [self._on_device(few, placed, bodies) for few, placed in zip(of_level, self.levels, strict=True)]
        arrays = [self._arrays(number, placed, bodies) for number, placed in enumerate((*self.levels, cells))]
        self._launches = DistantLaunches(tables, self._choice, cells.table, arrays)
        self._begins = [system.begins for system in arrays]
        entries = [self._choice.acting[entry : entry + 1] for entry in range(2 * len(arrays))]
        self._acts_anywhere, self._begins_anywhere = entries[::2], entries[1::2]
        self._poses = wp.zeros(model.body_count, dtype=wp.transform, device=model.device)  # of the last solve
        cells.system.refresh = self._refresh
        # a single world rests as a whole; passes over the fewest moments cost less than lists of worlds
        several = len(self.converged) > 1
        self._resting = [
            RestingWorlds(system) if number and several else None for number, system in enumerate(self.systems)
        ]

    @property
    def systems(self) -> list[MomentSystem]:
        """The systems of the levels, and that with cells."""
        return [placed.system for placed in (*self.levels, self._cells)]

    @property
    def converged(self) -> wp.array:
        """1 where the last solve converged, shape [worlds]."""
        return self._cells.system.converged

    def _put(self, values, dtype) -> wp.array:
        return wp.array(np.ascontiguousarray(values), dtype=dtype, device=self._model.device)

    def _put_copies(self, values, dtype, step=0) -> wp.array:
        """Return the values of a copy of the worlds, and of all other copies, on the device."""
        values = np.asarray(values, float if dtype == wp.vec3 else np.int32)
        return put_copies(values, dtype, self._model.device, self._cells.worlds.copies, step)

    def _make_choice(self, has_bodies: np.ndarray) -> WorldChoice:
        choice, worlds, count = WorldChoice(), len(has_bodies), len(self.levels)
        choice.level = self._put(np.full(worlds, count), wp.int32)
        for name, length in (("before", worlds), ("nearest", worlds), ("saturated", worlds), ("acting", 2 * count + 2)):
            setattr(choice, name, wp.zeros(length, dtype=wp.int32, device=self._model.device))
        choice.always_near = self._put(~has_bodies, wp.int32)
        return choice

    def _on_device(
        self, bodies: dict[int, DistantBody], placed: PlacedMoments, levels: dict[int, list[DistantBody]]
    ) -> DistantBodies:
        """Return the tables of bodies with few moments at one of their levels, the moments ``placed``."""
        arrays, first, cells, put = DistantBodies(), placed.first, self._cells, self._put_copies
        indices, records, equal = list(bodies), list(bodies.values()), cells.worlds
        magnets, moments = equal.magnets, int(first[len(equal.magnets)])  # moments of a copy
        worlds = np.array([magnets[k].world for k in indices])
        ranges = np.array(placed.system.world_ranges[: equal.world_step])[worlds]
        arrays.body = put([magnets[k].body for k in indices], wp.int32, equal.body_step)
        arrays.world = put(worlds, wp.int32, equal.world_step)
        arrays.own = put([(first[k], first[k + 1]) for k in indices], wp.vec2i, moments)
        arrays.sources = put(ranges[:, [0, 2]], wp.vec2i, moments)
        arrays.lower, arrays.upper = (put([getattr(b, name) for b in records], wp.vec3) for name in ("lower", "upper"))
        reaches = np.full((len(indices), len(self.levels)), np.inf)
        for row, k in enumerate(indices):
            reaches[row, : len(levels[k])] = [body.reach for body in levels[k]]
        arrays.reach = self._put(np.tile(reaches, (equal.copies, 1)), float)
        self._put_patterns(arrays, records)
        coupled = [k for k, magnet in enumerate(magnets) if magnet.lattice.coupling is not None]
        arrays.rotation = put(np.searchsorted(coupled, indices), wp.int32, len(coupled))
        self._put_matches(arrays, first[: len(magnets) + 1], indices)
        arrays.moment_world = cells.system.world_of_moments
        return arrays

    def _put_patterns(self, arrays: DistantBodies, records: list[DistantBody]) -> None:
        """Set the patterns of the magnetization in the cells of bodies, and their coefficients."""
        shapes = {id(body): body for body in records}
        counts = np.array([(body.coefficients.size, body.patterns.size) for body in shapes.values()])
        begin = dict(zip(shapes, (np.cumsum(counts, axis=0) - counts).tolist(), strict=True))
        arrays.table = self._put_copies([(*begin[id(body)], body.patterns.shape[2]) for body in records], wp.vec3i)
        arrays.coefficients = self._put(np.concatenate([body.coefficients.ravel() for body in shapes.values()]), float)
        arrays.patterns = self._put(np.concatenate([body.patterns.ravel() for body in shapes.values()]), float)
        pattern_counts = [body.patterns.shape[1] for body in records]
        arrays.pattern_count = self._put_copies(pattern_counts, wp.int32)
        count = self._cells.worlds.copies * len(records)
        arrays.strengths = wp.zeros((count, max(pattern_counts)), dtype=float, device=self._model.device)

    def _put_matches(self, arrays: DistantBodies, few: np.ndarray, indices: list[int]) -> None:
        """Set the moments of the cells' system that stand for few moments, and the other way round.

        ``few`` is the first of the few moments of each magnet of a copy, and the end; ``indices`` are the magnets of
        the bodies.
        """
        cells = self._cells.first[: len(few)]
        numbers = np.full(len(few) - 1, -1)
        numbers[indices] = np.arange(len(indices))
        counts = np.diff(cells)
        within = np.arange(cells[-1]) - np.repeat(cells[:-1], counts)
        number = np.repeat(numbers, counts)
        source = np.where(number < 0, np.repeat(few[:-1], counts) + within, -1)
        cell = np.stack([number, np.where(number < 0, -1, within)], axis=1)
        arrays.same = self._put_copies(_matching_moments(few, cells), wp.int32, int(cells[-1]))
        arrays.source = self._put_copies(source, wp.int32, int(few[-1]))
        arrays.cell = self._put_copies(cell, wp.vec2i, [len(indices), 0])

    def _arrays(self, number: int, placed: PlacedMoments, bodies: dict[int, list[DistantBody]]) -> SystemArrays:
        """Return the arrays of a system, as kernels take them."""
        arrays, system, worlds = SystemArrays(), placed.system, placed.worlds
        names = ("resting", "positions", "radii", "moments", "external_field", "rotations")
        for name in (*names, "error", "residual", "evaluations", "converged"):
            setattr(arrays, name, getattr(system, name))
        arrays.number, arrays.begins = number, wp.zeros_like(system.resting)
        replaced = [magnet.world if k in bodies else -1 for k, magnet in enumerate(worlds.magnets)]
        counts = np.diff(placed.first[: len(replaced) + 1])
        arrays.saturation, arrays.volumes = system.material.saturation, placed.table.volumes
        arrays.replaced = self._put_copies(np.repeat(replaced, counts), wp.int32, worlds.world_step)
        return arrays

    def gather(self, body_q: wp.array, values: ModelValues) -> None:
        """Write positions, rotations and permanent moments at the poses ``body_q`` to the system of fewest moments."""
        if len(self._poses):
            wp.copy(self._poses, body_q)
        self.levels[0].gather(body_q, values)

    def solve(self, values: ModelValues, *, allowed: bool = True) -> None:
        """Launch the solve; with ``allowed`` False that of the system with cells in all worlds."""
        self._launches.choose(self._poses, allowed=allowed)
        for level in range(len(self.levels)):
            wp.capture_if(self._acts_anywhere[level], partial(self._solve_few, level, values))
        self._launches.let_cells_act()
        wp.capture_if(self._acts_anywhere[-1], partial(self._solve_cells, values))

    def _solve_few(self, level: int, values: ModelValues) -> None:
        self._launches.set_external_field(level)
        if level:
            self.levels[level].gather(self._poses, values)
        self._solve_system(level)
        self._launches.finish_few(level)

    def _solve_cells(self, values: ModelValues) -> None:
        self._cells.gather(self._poses, values)
        self._solve_system(len(self.levels))
        self._launches.finish_cells()

    def _solve_system(self, number: int) -> None:
        """Launch the solve of a system in the worlds where it acts."""
        placed, resting = (*self.levels, self._cells)[number], self._resting[number]
        wp.capture_if(self._begins_anywhere[number], partial(placed.system.start_cold, self._begins[number]))
        if resting is not None:
            resting.leave_out()
        placed.system.solve()

    def _refresh(self) -> None:
        """Write positions and moments of the system with cells where it rests."""
        self._cells.gather_frames(self._poses)
        self._launches.spread_moments(self._poses)

    def add_forces(self, state: newton.State) -> None:
        """Launch the forces of the last solve, and add them to ``state.body_f``."""
        for number, placed in enumerate((*self.levels, self._cells)):
            wp.capture_if(self._acts_anywhere[number], partial(self._add_forces, placed, state))

    def _add_forces(self, placed: PlacedMoments, state: newton.State) -> None:
        placed.system.apply_forces()
        placed.add_wrenches(self._model, state)

    def persistent_arrays(self) -> dict[str, PersistentArray]:
        """Return the arrays that the next solve and :meth:`add_forces` read, by name."""
        result = {name: getattr(self._choice, name) for name in ("level", "saturated", "acting")}
        result["poses"] = self._poses
        for level, placed in enumerate(self.levels):
            result |= {f"{level}.{name}": array for name, array in placed.system.persistent_arrays().items()}
        return result

    def evaluate_again(self) -> None:
        """Launch all that a solve computes from restored arrays, without a step."""
        for system, resting in zip(self.systems, self._resting, strict=True):
            if resting is not None:
                resting.leave_out()
            system.evaluate_again()

    def energy(self) -> np.ndarray:
        """Return the energy of each world with magnets [J]; waits for the device."""
        energies = np.stack([system.energy() for system in self.systems])
        return np.take_along_axis(energies, self._choice.level.numpy()[None], axis=0)[0]

    def most_moments(self) -> PlacedMoments:
        """Return the moments of the largest system that acts in any world; waits for the device."""
        return (*self.levels, self._cells)[int(self._choice.level.numpy().max())]


def _replaced(magnets: list[BodyMagnet], bodies: dict[int, DistantBody]) -> list[BodyMagnet]:
    """Return the magnets with few moments in place of the cells of ``bodies``."""
    # many worlds share one lattice
    kinds = {(id(body), len(magnets[k].shapes)): body for k, body in bodies.items()}
    lattices = {(key, count): _few(body, count) for (key, count), body in kinds.items()}
    return [
        replace(magnet, lattice=lattices[id(bodies[k]), len(magnet.shapes)]) if k in bodies else magnet
        for k, magnet in enumerate(magnets)
    ]


def _matching_moments(few: np.ndarray, cells: np.ndarray) -> np.ndarray:
    """Return for each of the few moments one of the cells' system, of the same magnet, by first moments of magnets."""
    magnet = np.repeat(np.arange(len(few) - 1), np.diff(few))
    return cells[magnet] + np.minimum(np.arange(few[-1]) - few[magnet], np.diff(cells)[magnet] - 1)


def _few(body: DistantBody, shape_count: int) -> BodyLattice:
    """Return the lattice of the few moments of a body; they count as those of its first shape."""
    coupling = body.coupling
    counts = np.array([len(body.volumes), *[0] * (shape_count - 1)])
    return BodyLattice(coupling.positions, body.volumes, coupling.radii, counts, coupling=coupling)
