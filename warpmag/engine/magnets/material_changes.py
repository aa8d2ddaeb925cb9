"""Changed materials of a model, passed on to the moments of its magnets."""

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from warpmag.engine.magnets.grouping import BodyMagnet
from warpmag.engine.magnets.model_values import ModelValues
from warpmag.engine.magnets.placed_moments import PlacedMoments


def change_materials(
    values: ModelValues, systems: Sequence[PlacedMoments], magnets: list[BodyMagnet]
) -> list[BodyMagnet]:
    """Set the present saturations and susceptibilities of a model in its systems of moments; return its magnets.

    Raises:
        InputError: A value is out of range, the contact model has tables for the old value, or another attribute was
            changed.
    """
    changed = values.changed_materials()
    for placed in systems:
        moment_shapes = placed.table.shape.numpy()
        affected = np.isin(moment_shapes, changed) & ~placed.table.permanent.numpy()
        affected[placed.recoiling.numpy()] = False
        moments = np.flatnonzero(affected)
        placed.system.set_material(moments, *values.material(moment_shapes[moments]))
    saturations, susceptibilities = values.material([magnet.shapes[0] for magnet in magnets])
    rows = zip(magnets, saturations.tolist(), susceptibilities.tolist(), strict=True)
    present = [
        replace(body_magnet, magnet=replace(body_magnet.magnet, saturation=saturation, susceptibility=susceptibility))
        for body_magnet, saturation, susceptibility in rows
    ]
    values.accept_changes()
    return present
