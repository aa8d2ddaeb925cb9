"""The moments of magnets on the bodies of a Newton model: a system that follows the poses and acts on the bodies."""

import newton
import numpy as np
import warp as wp

from warpmag.declarations.attributes import NAMESPACE
from warpmag.engine.magnets.grouping import BodyMagnet
from warpmag.engine.magnets.magnet_system import KINEMATIC, make_system
from warpmag.engine.magnets.model_values import ModelValues
from warpmag.kernels.rigid.bodies import (
    BodyMoments,
    add_wrenches,
    gather_bias,
    gather_frames,
    gather_moments,
    gather_rotations,
)


class PlacedMoments:
    """The moments of magnets, fixed to the bodies of a model.

    Attributes:
        magnets: The magnets, in the order of their moments.
        system: The moments on the device.
        table: The moments and their bodies, as kernels read them.
        first: First moment of each magnet, and the end, shape [magnets + 1].
        volumes: Volume of each moment [m³], shape [n].
        recoiling: Moments with recoil permeability, on the device.
        coupled_bodies: Body of each magnet of cells, in the order of ``system.rotations``, on the device.
        solid_bodies: Body of each permanent part with a closed form, in the order of ``system.sources.solid_frames``.
    """

    def __init__(self, model: newton.Model, magnets: list[BodyMagnet], settings, **options):
        """Make the system of the moments of ``magnets``; see :func:`make_system` for the other arguments."""
        self.magnets, device = magnets, model.device
        self.system, coupled_bodies, solid_bodies = make_system(model, magnets, settings, **options)

        def put(values, dtype):
            return wp.array(np.ascontiguousarray(values), dtype=dtype, device=device)

        lattices, materials = [magnet.lattice for magnet in magnets], [magnet.magnet for magnet in magnets]
        counts = [len(lattice.volumes) for lattice in lattices]
        run_body = np.array([magnet.body for magnet in magnets])
        self.volumes = np.concatenate([lattice.volumes for lattice in lattices])
        self.first = start = np.concatenate([[0], np.cumsum(counts)])
        shapes = [shape for magnet in magnets for shape in magnet.shapes]
        shape_counts = np.concatenate([lattice.counts for lattice in lattices])

        self.table = moments = BodyMoments()
        moments.body = put(np.repeat(run_body, counts), wp.int32)
        moments.permanent = put(np.repeat([material.fixed for material in materials], counts), wp.bool)
        moments.local_positions = put(np.concatenate([lattice.positions for lattice in lattices]), wp.vec3)
        moments.volumes, moments.shape = put(self.volumes, float), put(np.repeat(shapes, shape_counts), wp.int32)
        moments.shape_frames = model.shape_transform
        moments.magnetizations = getattr(model, NAMESPACE).magnetization
        moments.kinematic_flag = KINEMATIC
        order = np.argsort(run_body, kind="stable")
        bodies, first = np.unique(run_body[order], return_index=True)
        dynamic = bodies >= 0
        worlds = np.array([magnet.world for magnet in magnets])[order][first]
        moments.body_list, moments.body_world = put(bodies[dynamic], wp.int32), put(worlds[dynamic], wp.int32)
        moments.body_run_start = put(np.append(first[dynamic], len(order)), wp.int32)
        moments.runs = put(np.stack([start[:-1], start[1:]], axis=1)[order], wp.vec2i)
        moments.resting = self.system.resting

        self.coupled_bodies, self.solid_bodies = put(coupled_bodies, wp.int32), put(solid_bodies, wp.int32)
        susceptibility = np.repeat([material.recoil_permeability - 1.0 for material in materials], counts)
        recoiling = np.flatnonzero(np.repeat([material.recoils for material in materials], counts))
        self.recoiling, self._bias_factors = put(recoiling, wp.int32), put(1.0 / susceptibility[recoiling], float)

    def gather(self, body_q: wp.array, values: ModelValues) -> None:
        """Write positions, rotations and permanent moments at the poses ``body_q`` to the system."""
        system, table = self.system, self.table
        gather_moments(body_q, table, values.present, values.used, system.positions, system.moments, values.changed)
        self.gather_frames(body_q)
        if len(self.recoiling):
            gather_bias(body_q, table, self.recoiling, self._bias_factors, system.bias)

    def gather_frames(self, body_q: wp.array) -> None:
        """Write rotations of bodies of cells and frames of permanent bodies at the poses ``body_q`` to the system."""
        system = self.system
        if system.rotations is not None:
            gather_rotations(body_q, self.coupled_bodies, system.rotations)
        if len(self.solid_bodies):
            gather_frames(body_q, self.solid_bodies, system.sources.solid_frames)

    def add_wrenches(self, model: newton.Model, state: newton.State) -> None:
        """Add the forces that the system computed to ``state.body_f``, but not in worlds where it rests."""
        system = self.system
        add_wrenches(self.table, model, state, system.positions, system.forces, system.torques)
