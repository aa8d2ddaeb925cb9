"""Eddy currents in the conducting balls of a Newton model, from the velocities of balls and sources."""

import newton
import numpy as np

from warpmag.engine.magnets.grouping import BodyMagnet
from warpmag.engine.magnets.sources import ModelSources
from warpmag.errors import InputError
from warpmag.kernels.rigid.bodies import BodyMoments, gather_motion
from warpmag.moments.system import MomentSystem


def set_conductivities(model: newton.Model, magnets: list[BodyMagnet], system: MomentSystem, step: float) -> None:
    """Start computing eddy currents in the conducting balls of a model; without any, nothing is allocated.

    Forces are evaluated at least every ``step`` [s]. A conducting magnet that is not a ball of one moment, or not the
    only magnet of its body, raises :class:`InputError`.
    """
    conductivity = [magnet.magnet.conductivity for magnet in magnets]
    if not any(conductivity):
        return
    counts = [len(magnet.lattice.volumes) for magnet in magnets]
    kinds, bodies = model.shape_type.numpy(), [magnet.body for magnet in magnets]
    for magnet, count in zip(magnets, counts, strict=True):
        if magnet.magnet.conductivity == 0.0:
            continue
        is_ball = count == 1 and kinds[magnet.shapes[0]] == newton.GeoType.SPHERE
        if not is_ball or (magnet.body >= 0 and bodies.count(magnet.body) > 1):
            label = model.shape_label[magnet.shapes[0]]
            raise InputError(
                f"{label}: conductivity: only balls of one moment that are their body's only magnet may conduct"
            )
    system.set_conductivity(np.repeat(conductivity, counts), step)


def gather_velocities(
    model: newton.Model, state: newton.State, moments: BodyMoments, sources: ModelSources, system: MomentSystem
) -> None:
    """Write the velocities of balls and sources at ``state`` to the system, if balls conduct."""
    if system.eddy is None or state.body_qd is None:
        return
    gather_motion(moments, model, state, system.positions, system.eddy.motion)
    if system.source_interaction is not None:
        sources.gather_motion(state, system.source_interaction.source_motion)
