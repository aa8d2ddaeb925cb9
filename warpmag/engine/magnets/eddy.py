"""Eddy currents on a Newton model: which balls conduct, and how what they see moves."""

import newton
import numpy as np

from warpmag.engine.magnets.grouping import BodyMagnet
from warpmag.engine.magnets.sources import ModelSources
from warpmag.errors import InputError
from warpmag.kernels.rigid.bodies import BodyMoments
from warpmag.kernels.rigid.motion import gather_motion
from warpmag.moments.system import MomentSystem


class BodyEddies:
    """Eddy currents of the conducting balls of a model; without such, nothing is allocated and nothing launched.

    Args:
        model: The model.
        magnets: Its magnets, in the order of their moments.
        moments: How these belong to bodies.
        sources: Its sources of fields.
        system: The moments, which are given their conductivity.
        step: Longest time [s] for which forces count.

    Raises:
        InputError: A magnet conducts that is no ball, or not its body's only magnet.
    """

    def __init__(
        self,
        model: newton.Model,
        magnets: list[BodyMagnet],
        moments: BodyMoments,
        sources: ModelSources,
        system: MomentSystem,
        step: float,
    ):
        """Find the balls that conduct."""
        self._model, self._moments, self._sources, self._system = model, moments, sources, system
        conductivity = [one.magnet.conductivity for one in magnets]
        if not any(conductivity):
            return
        moments_of = [len(one.lattice.volumes) for one in magnets]
        kinds, bodies = model.shape_type.numpy(), [one.body for one in magnets]
        for one, count in zip(magnets, moments_of, strict=True):
            if one.magnet.conductivity == 0.0:
                continue
            ball = count == 1 and kinds[one.shapes[0]] == newton.GeoType.SPHERE
            if not ball or (one.body >= 0 and bodies.count(one.body) > 1):
                where = model.shape_label[one.shapes[0]]
                raise InputError(f"{where}: conductivity: only of a ball of one moment, its body's only magnet")
        system.set_conductivity(np.repeat(conductivity, moments_of), step)

    def gather(self, state: newton.State) -> None:
        """Tell the system how the bodies of ``state`` move."""
        system = self._system
        if system.eddy is None or state.body_qd is None:
            return
        gather_motion(self._moments, self._model, state, system.positions, system.eddy.motion)
        if system.source_interaction is not None:
            self._sources.gather_motion(state, system.source_interaction.source_motion)
