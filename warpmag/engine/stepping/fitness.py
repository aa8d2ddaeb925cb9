"""Refuses, in one line each, what a solver cannot take and what does not fit a model."""

import newton
import numpy as np
import warp as wp

from warpmag.declarations.checks import short_repr
from warpmag.engine.pile_xpbd.contacts import MAXIMAL
from warpmag.errors import InputError

SPRING_STIFFNESS = 1e4
"""Stiffness of the semi-implicit solver's joints as Newton sets it [N/m and N·m/rad]."""
_WEAKNESSES = {
    "kamino": "solver kamino: hundreds of bodies that touch take it seconds a step, and drives of joints hold far "
    "stiffer than their gains; not so with xpbd",
    "vbd": "solver vbd: bodies that magnets press together sink into each other and may be thrown out, and hinged "
    "bodies lose several per cent of a swing; not so with xpbd",
}


def articulate(builder: newton.ModelBuilder, solver: str) -> None:
    """Make an articulation of each joint by which a body hangs from the world alone, where the solver knows no others.

    Such bodies would stay where they are, and those that hang from other bodies outside all articulations are refused.
    """
    if solver in MAXIMAL:
        return
    joints = list(zip(builder.joint_articulation, builder.joint_parent, builder.joint_child, strict=True))
    inside = {body for articulation, *bodies in joints if articulation >= 0 for body in bodies}
    for joint, (articulation, parent, child) in enumerate(joints):
        if articulation >= 0 or child in inside:
            continue
        if parent >= 0 or builder.joint_world[joint] != builder.current_world:
            raise InputError(
                f"{builder.joint_label[joint]}: a joint outside all articulations, which the solver {solver} cannot "
                f"take, but {', '.join(MAXIMAL)} can; or apply PhysicsArticulationRootAPI above it"
            )
        builder.add_articulation([joint])
        inside.add(child)


def check_model(model: newton.Model, solver: str, dt: float) -> None:
    """Refuse what the solver cannot move in substeps of ``dt`` [s], and bodies whose start is not finite."""
    _check_joint_springs(model, solver, dt)
    for name in ("body_q", "body_qd"):
        bad = ~np.isfinite(getattr(model, name).numpy()).all(axis=1)
        if bad.any():
            what = "position or orientation" if name == "body_q" else "velocity"
            raise InputError(f"{model.body_label[int(np.argmax(bad))]}: {what} is not finite")


def _check_joint_springs(model: newton.Model, solver: str, dt: float) -> None:
    """Refuse joints of bodies that the springs which the solver makes of them would blow up in substeps of ``dt``."""
    kinds = model.joint_type.numpy() if model.joint_count else np.zeros(0, int)
    held = np.flatnonzero((kinds != newton.JointType.FREE) & (kinds != newton.JointType.DISTANCE))
    if solver != "semi-implicit" or not len(held):
        return
    spins = np.linalg.eigvalsh(np.asarray(model.body_inv_inertia.numpy(), dtype=float)).max(axis=1)
    gains = np.maximum(model.body_inv_mass.numpy(), spins) * SPRING_STIFFNESS * dt**2
    for joint in held:
        bodies = model.joint_parent.numpy()[joint], model.joint_child.numpy()[joint]
        if max(gains[body] for body in bodies if body >= 0) > 1.0:
            raise InputError(
                f"{model.joint_label[joint]}: a joint of a body that is too light for the solver {solver}, "
                f"whose joints are springs of {SPRING_STIFFNESS:g} N/m and N·m/rad; take another solver"
            )


def solver_warnings(solver: str) -> list[str]:
    """Return what a user of the solver should know, a line each."""
    return [_WEAKNESSES[solver]] if solver in _WEAKNESSES else []


def check_control(control: newton.Control, model: newton.Model) -> None:
    """Refuse what is no control of ``model``."""
    if not isinstance(control, newton.Control):
        raise InputError(f"control: must be a newton.Control, got {short_repr(control)}")
    for name, wanted in vars(model.control()).items():
        if isinstance(wanted, wp.array):
            given = getattr(control, name, None)
            if not (isinstance(given, wp.array) and (given.shape, given.dtype) == (wanted.shape, wanted.dtype)):
                raise InputError(
                    f"control: {name} does not fit the model, take a control from simulation.model.control()"
                )
            if given.device != wanted.device:
                raise InputError(f"control: {name} is on {given.device}, the model is on {wanted.device}")
