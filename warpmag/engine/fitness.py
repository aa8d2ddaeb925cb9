"""Refuses, in one line each, what a solver cannot take and what does not fit a model."""

import newton
import warp as wp

from warpmag.engine.contacts import MAXIMAL
from warpmag.errors import InputError
from warpmag.magnets import shown


def check_articulations(builder: newton.ModelBuilder, solver: str) -> None:
    """Refuse joints outside articulations to solvers that know bodies by their articulations alone."""
    if solver in MAXIMAL:
        return
    joints = list(
        zip(builder.joint_label, builder.joint_articulation, builder.joint_parent, builder.joint_child, strict=True)
    )
    inside = {body for _, articulation, *bodies in joints if articulation >= 0 for body in bodies}
    for label, articulation, parent, child in joints:
        if articulation < 0 and parent >= 0 and child not in inside:
            raise InputError(
                f"{label}: a joint outside all articulations, which the solver {solver} cannot take, but "
                f"{' and '.join(MAXIMAL)} can; or apply PhysicsArticulationRootAPI above it"
            )


def check_control(control: newton.Control, model: newton.Model) -> None:
    """Refuse what is no control of ``model``."""
    if not isinstance(control, newton.Control):
        raise InputError(f"control: must be a newton.Control, got {shown(control)}")
    for name, wanted in vars(model.control()).items():
        if isinstance(wanted, wp.array):
            given = getattr(control, name, None)
            if not (isinstance(given, wp.array) and (given.shape, given.dtype) == (wanted.shape, wanted.dtype)):
                raise InputError(
                    f"control: {name} does not fit the model, take a control from simulation.model.control()"
                )
            if given.device != wanted.device:
                raise InputError(f"control: {name} is on {given.device}, the model is on {wanted.device}")
