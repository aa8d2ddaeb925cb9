"""Rows of a state by world, with their values at the start."""

import newton
import numpy as np
import warp as wp

from warpmag.engine.magnets.world_reset import WorldRows

_FORCES = ("body_f", "particle_f")


def state_rows(model: newton.Model, state: newton.State) -> list[WorldRows]:
    """Return the arrays of bodies, joints and particles of ``state``, with copies of their present values.

    Other arrays belong to a solver, which resets them itself.
    """
    kinds = newton.Model.AttributeFrequency
    joint_worlds = _host(model.joint_world)
    worlds = {kinds.BODY: _host(model.body_world), kinds.JOINT: joint_worlds}
    worlds[kinds.PARTICLE] = _host(model.particle_world)
    for kind, starts in ((kinds.JOINT_COORD, model.joint_q_start), (kinds.JOINT_DOF, model.joint_qd_start)):
        worlds[kind] = np.repeat(joint_worlds, np.diff(_host(starts))[: len(joint_worlds)])
    return [WorldRows(array, worlds[kind]) for kind, array in _arrays_by_kind(model, state) if kind in worlds]


def _arrays_by_kind(model: newton.Model, state: newton.State) -> list[tuple]:
    """Return the kind of object and the array of each attribute of a state, without forces and empty arrays."""
    arrays = {name: array for name, array in vars(state).items() if name not in _FORCES}
    for space, values in vars(state).items():
        if isinstance(values, newton.Model.AttributeNamespace):
            arrays |= {f"{space}:{name}": array for name, array in vars(values).items()}
    return [(_kind(model, name), array) for name, array in arrays.items() if isinstance(array, wp.array) and array.size]


def _kind(model: newton.Model, name: str):
    """Return the kind of object that an attribute belongs to; None if the model does not know the attribute."""
    try:
        return model.get_attribute_frequency(name)
    except (AttributeError, KeyError):
        return None


def _host(array: wp.array | None) -> np.ndarray:
    return np.zeros(0, np.int32) if array is None else array.numpy()
