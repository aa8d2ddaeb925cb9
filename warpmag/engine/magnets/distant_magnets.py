"""Few moments in place of the cells of iron bodies in worlds where every other magnet is far from them."""

from collections import Counter
from dataclasses import replace
from functools import partial

import newton
import numpy as np
import warp as wp

from warpmag.declarations.magnets import MagneticSettings
from warpmag.engine.magnets.grouping import BodyMagnet
from warpmag.engine.magnets.model_values import ModelValues
from warpmag.engine.magnets.placed_moments import PlacedMoments
from warpmag.engine.magnets.sampling import BodyLattice, shape_cache
from warpmag.kernels.rigid.distant import (
    DistantBodies,
    DistantLaunches,
    SystemArrays,
    WorldChoice,
)
from warpmag.moments.ranks import current_ranks
from warpmag.moments.resting_worlds import RestingWorlds
from warpmag.shapes.demagnetization import Coupling
from warpmag.shapes.distant_response import LEAST_REPLACED_CELLS, MOST_REPLACED_CELLS, DistantBody, distant_body


def distant_bodies(
    model: newton.Model, magnets: list[BodyMagnet], settings: MagneticSettings, *, method: str, has_sources: bool
) -> dict[int, DistantBody]:
    """Return the few moments of iron bodies by the index of the magnet; none where the model needs cells always.

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
    in_world = Counter(magnets[k].world for k in coupled)
    bodies: dict[int, DistantBody | None] = {}
    result = {}
    for k, lattice in large.items():
        coupling = lattice.coupling.among(in_world[magnets[k].world])
        if id(coupling) not in bodies:
            bodies[id(coupling)] = _distant_body(model.shape_label[magnets[k].shapes[0]], lattice, coupling)
        if (body := bodies[id(coupling)]) is None:
            return {}
        result[k] = body
    return result


def _distant_body(label: str, lattice: BodyLattice, coupling: Coupling) -> DistantBody | None:
    """Return the few moments of a body, from the cache of shapes or computed."""
    key = ("distant", lattice.positions, lattice.volumes, lattice.radii, coupling.start, coupling.other)
    key = (*key, coupling.grid_tensor, coupling.common)
    return shape_cache().get(f"{label}: few moments", key, lambda: distant_body(lattice, coupling))


class DistantMagnets:
    """Two systems of the same magnets, with cells and with few moments. Each world solves only the first or the second.

    Attributes:
        few: The moments, few in place of the cells of some bodies.
    """

    def __init__(
        self, model: newton.Model, many: PlacedMoments, bodies: dict[int, DistantBody], settings: MagneticSettings,
        **options,
    ):  # fmt: skip
        """Make the system of few moments.

        Args:
            model: The model.
            many: All moments, with the cells of all bodies.
            bodies: Few moments by the index of a magnet.
            settings, options: As of the system of ``many``.
        """
        self._model, self._many = model, many
        magnets = [
            replace(magnet, lattice=_few(bodies[k], len(magnet.shapes))) if k in bodies else magnet
            for k, magnet in enumerate(many.magnets)
        ]
        self.few = PlacedMoments(model, magnets, settings, **options)
        worlds = np.array([magnet.world for magnet in magnets])
        self._bodies = self._on_device(bodies, worlds)
        self._choice = self._make_choice(np.isin(np.arange(len(many.system.world_ranges)), worlds[list(bodies)]))
        few_arrays, many_arrays = (self._arrays(placed, bodies) for placed in (self.few, many))
        self._launches = DistantLaunches(self._bodies, self._choice, many.table, many_arrays, few_arrays)
        self._poses = wp.zeros(model.body_count, dtype=wp.transform, device=model.device)  # of the last solve
        many.system.refresh = self._refresh
        self._resting = RestingWorlds(many.system) if len(many.system.world_ranges) > 1 else None

    @property
    def systems(self):
        """The system with few moments, and that with cells."""
        return self.few.system, self._many.system

    def _put(self, values, dtype) -> wp.array:
        return wp.array(np.ascontiguousarray(values), dtype=dtype, device=self._model.device)

    def _make_choice(self, has_bodies: np.ndarray) -> WorldChoice:
        few, many = self.systems
        choice = WorldChoice()
        choice.many_rest, choice.few_rest = many.resting, few.resting
        few.resting.fill_(1)
        of_worlds = ("many_rested", "many_begin", "few_begin", "is_near", "saturated")
        of_all = ("any_many_begin", "any_few_begin", "any_many", "any_few")
        for names, length in ((of_worlds, len(has_bodies)), (of_all, 1)):
            for name in names:
                setattr(choice, name, wp.zeros(length, dtype=wp.int32, device=self._model.device))
        choice.always_near = self._put(~has_bodies, wp.int32)
        return choice

    def _on_device(self, bodies: dict[int, DistantBody], worlds: np.ndarray) -> DistantBodies:
        """Return the tables of bodies with few moments."""
        arrays, first, magnets, put = DistantBodies(), self.few.first, self._many.magnets, self._put
        indices, records = list(bodies), list(bodies.values())
        ranges = np.array(self.few.system.world_ranges)[worlds[indices]]
        arrays.body = put([magnets[k].body for k in indices], wp.int32)
        arrays.world = put(worlds[indices], wp.int32)
        arrays.own = put([(first[k], first[k + 1]) for k in indices], wp.vec2i)
        arrays.sources = put(ranges[:, [0, 2]], wp.vec2i)
        arrays.lower, arrays.upper = (put([getattr(b, name) for b in records], wp.vec3) for name in ("lower", "upper"))
        arrays.reach = put([body.reach for body in records], float)
        shapes = {id(body): body for body in records}
        counts = np.array([(body.coefficients.size, body.patterns.size) for body in shapes.values()])
        begin = dict(zip(shapes, (np.cumsum(counts, axis=0) - counts).tolist(), strict=True))
        arrays.table = put([(*begin[id(body)], body.patterns.shape[2]) for body in records], wp.vec3i)
        arrays.coefficients = put(np.concatenate([body.coefficients.ravel() for body in shapes.values()]), float)
        arrays.patterns = put(np.concatenate([body.patterns.ravel() for body in shapes.values()]), float)
        arrays.pattern_count = records[0].patterns.shape[1]
        arrays.strengths = wp.zeros((len(records), arrays.pattern_count), dtype=float, device=self._model.device)
        many = self._many
        number = {k: row for row, k in enumerate(indices)}
        source, cell = np.full(len(many.volumes), -1), np.full((len(many.volumes), 2), -1)
        for k, magnet in enumerate(many.magnets):
            own = slice(many.first[k], many.first[k + 1])
            count = len(magnet.lattice.volumes)
            if k in bodies:
                cell[own] = np.stack([np.full(count, number[k]), np.arange(count)], axis=1)
            else:
                source[own] = first[k] + np.arange(count)
        coupled = [k for k, magnet in enumerate(many.magnets) if magnet.lattice.coupling is not None]
        arrays.rotation = put(np.searchsorted(coupled, indices), wp.int32)
        arrays.same = put(self._matching_moments(), wp.int32)
        arrays.source, arrays.cell = put(source, wp.int32), put(cell, wp.vec2i)
        arrays.moment_world = put(many.system.worlds, wp.int32)
        return arrays

    def _matching_moments(self) -> np.ndarray:
        """Return for each of the few moments one of the other system, of the same magnet."""
        few, many = self.few.first, self._many.first
        magnet = np.repeat(np.arange(len(few) - 1), np.diff(few))
        return many[magnet] + np.minimum(np.arange(few[-1]) - few[magnet], np.diff(many)[magnet] - 1)

    def _arrays(self, placed: PlacedMoments, bodies: dict[int, DistantBody]) -> SystemArrays:
        """Return the arrays of a system, as kernels take them."""
        arrays, system, counts = SystemArrays(), placed.system, np.diff(placed.first)
        names = ("positions", "radii", "moments", "external_field", "rotations")
        for name in (*names, "error", "residual", "evaluations", "converged"):
            setattr(arrays, name, getattr(system, name))
        replaced = np.repeat([k in bodies for k in range(len(counts))], counts)
        arrays.saturation, arrays.volumes = system.material.saturation, placed.table.volumes
        arrays.replaced = self._put(np.where(replaced, system.worlds, -1), wp.int32)
        return arrays

    def gather(self, body_q: wp.array, values: ModelValues) -> None:
        """Write positions, rotations and permanent moments at the poses ``body_q`` to the system with few moments."""
        if len(self._poses):
            wp.copy(self._poses, body_q)
        self.few.gather(body_q, values)

    def solve(self, values: ModelValues, *, allowed: bool = True) -> None:
        """Launch the solve; with ``allowed`` False that of the system with cells in all worlds."""
        few, choice = self.few.system, self._choice
        self._launches.choose(self._poses, allowed=allowed)
        wp.capture_if(choice.any_few_begin, partial(few.start_cold, choice.few_begin))
        wp.capture_if(choice.any_few, few.solve)
        self._launches.finish_few()
        wp.capture_if(choice.any_many, partial(self._solve_many, values))

    def _solve_many(self, values: ModelValues) -> None:
        choice = self._choice
        wp.capture_if(choice.any_many_begin, partial(self._many.system.start_cold, choice.many_begin))
        self._many.gather(self._poses, values)
        if self._resting is not None:  # a single world rests as a whole
            self._resting.leave_out()
        self._many.system.solve()
        self._launches.finish_many()

    def _refresh(self) -> None:
        """Write positions and moments of the system with cells where it rests."""
        self._many.gather_frames(self._poses)
        self._launches.spread_moments(self._poses)

    def add_forces(self, state: newton.State) -> None:
        """Launch the forces of the last solve, and add them to ``state.body_f``."""
        for placed, condition in ((self.few, self._choice.any_few), (self._many, self._choice.any_many)):
            wp.capture_if(condition, partial(self._add_forces, placed, state))

    def _add_forces(self, placed: PlacedMoments, state: newton.State) -> None:
        placed.system.apply_forces()
        placed.add_wrenches(self._model, state)

    def persistent_arrays(self) -> dict[str, wp.array]:
        """Return the arrays that the next solve and :meth:`add_forces` read, by name."""
        choice = self._choice
        own = {name: getattr(choice, name) for name in ("saturated", "any_many", "any_few")}
        own["poses"] = self._poses
        return self.few.system.persistent_arrays() | own

    def evaluate_again(self) -> None:
        """Launch all that a solve computes from restored arrays, without a step."""
        if self._resting is not None:
            self._resting.leave_out()
        for system in self.systems:
            system.evaluate_again()

    def energy(self) -> np.ndarray:
        """Return the energy of each world with magnets [J]; waits for the device."""
        few, many = self.systems
        return np.where(many.resting.numpy() != 0, few.energy(), many.energy())

    def rest_everywhere(self) -> bool:
        """Return True if the system with cells rests in all worlds; waits for the device."""
        return bool(self.systems[1].resting.numpy().all())


def _few(body: DistantBody, shape_count: int) -> BodyLattice:
    """Return the lattice of the few moments of a body; they count as those of its first shape."""
    coupling = body.coupling
    counts = np.array([len(body.volumes), *[0] * (shape_count - 1)])
    return BodyLattice(coupling.positions, body.volumes, coupling.radii, counts, coupling=coupling)
