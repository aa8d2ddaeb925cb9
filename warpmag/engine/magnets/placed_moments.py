"""The moments of magnets on the bodies of a Newton model: a system that follows the poses and acts on the bodies."""

import newton
import numpy as np
import warp as wp

from warpmag.declarations.attributes import NAMESPACE
from warpmag.engine.magnets.equal_worlds import KINEMATIC, EqualWorlds
from warpmag.engine.magnets.magnet_system import make_system
from warpmag.engine.magnets.model_values import ModelValues
from warpmag.engine.magnets.sampling import BodyLattice
from warpmag.kernels.rigid.bodies import (
    BodyMoments,
    add_wrenches,
    gather_bias,
    gather_frames,
    gather_moments,
    gather_rotations,
)
from warpmag.kernels.shared.copies import put_copies
from warpmag.kernels.shared.launches import RecordedLaunches


class PlacedMoments:
    """The moments of magnets, fixed to the bodies of a model.

    Attributes:
        worlds: The magnets, in the order of their moments.
        system: The moments on the device.
        table: The moments and their bodies, as kernels read them.
        first: First moment of each magnet, and the end, shape [magnets + 1].
        recoiling: Moments with recoil permeability, on the device.
        coupled_bodies: Body of each magnet of cells, in the order of ``system.rotations``, on the device.
        solid_bodies: Body of each permanent part with a closed form, in the order of ``system.sources.solid_frames``.
    """

    def __init__(self, model: newton.Model, worlds: EqualWorlds, settings, **options):
        """Make the system of the moments of all magnets; see :func:`make_system` for the other arguments."""
        self.worlds, self._device, self._launch = worlds, model.device, RecordedLaunches()
        self.system = make_system(model, worlds, settings, **options)
        lattices = [magnet.lattice for magnet in worlds.magnets]
        counts = [len(lattice.volumes) for lattice in lattices]
        starts = np.cumsum([0, *counts])
        self.first = np.append(worlds.of_magnets(starts[:-1], starts[-1]), worlds.copies * starts[-1])
        self.table = self._make_table(model, lattices, counts)
        coupled = [magnet.body for magnet in worlds.magnets if magnet.lattice.coupling is not None]
        solid = [magnet.body for magnet in worlds.magnets for _ in magnet.lattice.solids]
        self.coupled_bodies, self.solid_bodies = (
            self._put(bodies, wp.int32, step=worlds.body_step) for bodies in (coupled, solid)
        )
        materials = [magnet.magnet for magnet in worlds.magnets]
        recoiling = np.flatnonzero(np.repeat([material.recoils for material in materials], counts))
        susceptibility = np.repeat([material.recoil_permeability - 1.0 for material in materials], counts)
        self.recoiling = self._put(recoiling, wp.int32, step=int(starts[-1]))
        self._bias_factors = self._put(1.0 / susceptibility[recoiling], wp.float32)

    def _put(self, values, kind, *, step=0) -> wp.array:
        """Return copies of values of one copy on the device."""
        if kind == wp.int32:
            values = np.asarray(values, np.int32)
        return put_copies(values, kind, self._device, self.worlds.copies, step)

    def _make_table(self, model: newton.Model, lattices: list[BodyLattice], counts: list[int]) -> BodyMoments:
        """Return the moments and their bodies, with the runs of moments of each body."""
        magnets, worlds, moments = self.worlds.magnets, self.worlds, BodyMoments()
        shapes = [shape for magnet in magnets for shape in magnet.shapes]
        shape_counts = np.concatenate([lattice.counts for lattice in lattices])
        bodies = np.repeat([magnet.body for magnet in magnets], counts)
        moments.body = self._put(bodies, wp.int32, step=worlds.body_step)
        moments.permanent = self._put(np.repeat([magnet.magnet.fixed for magnet in magnets], counts), wp.bool)
        moments.local_positions = self._put(np.concatenate([lattice.positions for lattice in lattices]), wp.vec3)
        moments.volumes = self._put(np.concatenate([lattice.volumes for lattice in lattices]), wp.float32)
        moments.shape = self._put(np.repeat(shapes, shape_counts), wp.int32, step=worlds.shape_step)
        moments.shape_frames = model.shape_transform
        moments.magnetizations = getattr(model, NAMESPACE).magnetization
        moments.kinematic_flag, moments.resting = KINEMATIC, self.system.resting
        run_body = worlds.bodies()
        order = np.argsort(run_body, kind="stable")
        bodies, first = np.unique(run_body[order], return_index=True)
        dynamic = bodies >= 0
        body_world = worlds.world_numbers()[order][first][dynamic]
        run_start, runs = np.append(first[dynamic], len(order)), np.stack([self.first[:-1], self.first[1:]], axis=1)
        moments.body_list, moments.body_world, moments.body_run_start = (
            wp.array(values, dtype=wp.int32, device=self._device) for values in (bodies[dynamic], body_world, run_start)
        )
        moments.runs = wp.array(runs[order].astype(np.int32), dtype=wp.vec2i, device=self._device)
        return moments

    def gather(self, body_q: wp.array, values: ModelValues) -> None:
        """Write positions, rotations and permanent moments at the poses ``body_q`` to the system."""
        system, table = self.system, self.table
        gather_moments(
            self._launch, body_q, table, values.present, values.used, system.positions, system.moments, values.changed
        )
        self.gather_frames(body_q)
        if len(self.recoiling):
            gather_bias(self._launch, body_q, table, self.recoiling, self._bias_factors, system.bias)

    def gather_frames(self, body_q: wp.array) -> None:
        """Write rotations of bodies of cells and frames of permanent bodies at the poses ``body_q`` to the system."""
        system = self.system
        if system.rotations is not None:
            gather_rotations(self._launch, body_q, self.coupled_bodies, system.rotations)
        if len(self.solid_bodies):
            gather_frames(self._launch, body_q, self.solid_bodies, system.sources.solid_frames)

    def add_wrenches(self, model: newton.Model, state: newton.State) -> None:
        """Add the forces that the system computed to ``state.body_f``, but not in worlds where it rests."""
        system = self.system
        add_wrenches(self._launch, self.table, model, state, system.positions, system.forces, system.torques)
