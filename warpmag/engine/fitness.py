"""Refuses, in one line each, what a solver cannot take and what does not fit a model."""

from collections.abc import Sequence

import newton
import numpy as np
import warp as wp

from warpmag.engine.contacts import MAXIMAL
from warpmag.engine.grouping import BodyMagnet
from warpmag.engine.sampling import BodyLattice
from warpmag.errors import InputError
from warpmag.magnets import shown

SPRING_STIFFNESS = 1e4
"""Stiffness of the semi-implicit solver's joints as Newton sets it [N/m and N·m/rad]."""
_SAME = 1e-3
"""Magnets whose centres are nearer than this part of the smaller one's radius are at the same place."""
_DIRECTION = np.array((0.6180, 0.5257, 0.5845))
"""A direction that no lattice of magnets is likely to have planes across."""
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


def check_places(model: newton.Model, magnets: Sequence[BodyMagnet], solver: str) -> None:
    """Refuse magnets of two moving bodies whose centres are at the same place, as a copy left where it was made is.

    The centre has to be inside of both: a rotor may be in the middle of a ring. Magnets of different worlds never meet.

    Args:
        model: The model, with its bodies where they start.
        magnets: Its magnets.
        solver: What moves them: those of generalized coordinates take poses from joints.
    """
    _, first, kinds = np.unique([id(one.lattice) for one in magnets], return_index=True, return_inverse=True)
    alike = np.array([_middle(magnets[one].lattice) for one in first])[kinds]
    bodies, worlds = (np.array([getattr(one, name) for one in magnets]) for name in ("body", "world"))
    rows = np.flatnonzero((bodies >= 0) & (alike[:, 3] > 0.0))
    if len(rows):  # a model without bodies has no flags of them
        moving = (model.body_inv_mass.numpy() > 0.0) & ~(model.body_flags.numpy() & newton.BodyFlags.KINEMATIC > 0)
        rows = rows[moving[bodies[rows]]]
    if len(rows) < 2:
        return
    state = model.state()
    if solver not in MAXIMAL:
        newton.eval_fk(model, state.joint_q, state.joint_qd, state)
    poses, middles, bodies = state.body_q.numpy()[bodies[rows]].astype(float), alike[rows, :3], bodies[rows]
    axes = poses[:, 3:6]
    turned = middles + 2.0 * np.cross(axes, np.cross(axes, middles) + poses[:, 6:] * middles)
    if pair := _at_one_place(poses[:, :3] + turned, _SAME * alike[rows, 3], bodies, worlds[rows]):
        first, second = (model.body_label[body] for body in sorted(bodies[list(pair)].tolist()))
        raise InputError(f"{first} and {second}: magnets of different bodies at the same place; move or remove one")


def _middle(lattice: BodyLattice) -> tuple[float, ...]:
    """Return the centre of a magnet and the radius of a ball of its volume [m], 0 where the centre is in a hole."""
    volumes = lattice.volumes
    total = volumes.sum()
    middle = volumes @ lattice.positions / total
    gaps = np.linalg.norm(lattice.positions - middle, axis=1)
    near = int(np.argmin(gaps))
    radii = np.cbrt(0.75 / np.pi * np.array([volumes[near], total]))
    # From the corner that eight cubes share to a centre are 1.4 radii; a hole cuts volume off the cells around it.
    solid = gaps[near] <= 1.5 * radii[0] and volumes[near] >= 0.99 * volumes.max()
    return (*middle.tolist(), float(radii[1]) if solid else 0.0)


def _at_one_place(
    centres: np.ndarray, reaches: np.ndarray, bodies: np.ndarray, worlds: np.ndarray
) -> tuple[int, int] | None:
    """Return two rows of different bodies in one world that are nearer to each other than the smaller reach.

    They are sorted along a direction, the worlds one behind the other, and compared with those that follow.

    Args:
        centres: Places [m], shape [n, 3].
        reaches: Distances that count as none [m], shape [n].
        bodies: Body of each, shape [n].
        worlds: World of each, shape [n].
    """
    along = centres @ _DIRECTION
    along += worlds * (2.0 * np.ptp(along) + 2.0 * reaches.max())
    order = np.argsort(along, kind="stable")
    along, centres, reaches, bodies = along[order], centres[order], reaches[order], bodies[order]
    lead, step = np.arange(len(order)), 1
    while len(lead):
        lead = lead[lead + step < len(order)]
        lead = lead[along[lead + step] - along[lead] <= reaches[lead]]  # the farther ones are beyond reach, too
        other = lead + step
        same = np.linalg.norm(centres[other] - centres[lead], axis=1) < np.minimum(reaches[lead], reaches[other])
        same &= bodies[other] != bodies[lead]
        if same.any():
            found = int(np.argmax(same))
            return int(order[lead[found]]), int(order[other[found]])
        step += 1
    return None


def solver_warnings(solver: str) -> list[str]:
    """Return what a user of the solver should know, a line each."""
    return [_WEAKNESSES[solver]] if solver in _WEAKNESSES else []


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
