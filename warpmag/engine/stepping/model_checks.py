"""Checks a model: articulations and stability for its solver, and gaps of joints."""

from typing import Any

import newton
import numpy as np

from warpmag.declarations.checks import joint_ends_apart, joint_gap_message
from warpmag.engine.pile_xpbd.joints import are_pins
from warpmag.engine.pile_xpbd.solvers import MAXIMAL
from warpmag.errors import InputError

SPRING_STIFFNESS = 1e4
"""Stiffness of the joints of Newton's semi-implicit solver [N/m and N·m/rad]."""


def articulate(builder: newton.ModelBuilder, solver: str) -> None:
    """Make an articulation of each joint between a body and the world, for solvers that move articulations only.

    Another joint outside all articulations raises :class:`InputError`.
    """
    if solver in MAXIMAL:
        return
    joints = list(zip(builder.joint_articulation, builder.joint_parent, builder.joint_child, strict=True))
    articulated = {body for articulation, *bodies in joints if articulation >= 0 for body in bodies}
    for joint, (articulation, parent, child) in enumerate(joints):
        if articulation >= 0 or child in articulated:
            continue
        if parent >= 0 or builder.joint_world[joint] != builder.current_world:
            raise InputError(
                f"{builder.joint_label[joint]}: the joint is outside all articulations, which the solver {solver} does "
                f"not support; use one of {', '.join(MAXIMAL)}, or apply PhysicsArticulationRootAPI above it"
            )
        builder.add_articulation([joint])
        articulated.add(child)


def check_stability(model: newton.Model, solver: str, dt: float) -> None:
    """Raise :class:`InputError` if an initial state is not finite, or the solver is unstable with ``dt`` [s]."""
    _check_joint_springs(model, solver, dt)
    for name, quantity in (("body_q", "position or orientation"), ("body_qd", "velocity")):
        bad = ~np.isfinite(getattr(model, name).numpy()).all(axis=1)
        if bad.any():
            raise InputError(f"{model.body_label[int(np.argmax(bad))]}: {quantity} is not finite")


def _check_joint_springs(model: newton.Model, solver: str, dt: float) -> None:
    """Raise :class:`InputError` if the springs of the semi-implicit solver are too stiff for a body and ``dt`` [s]."""
    if solver != "semi-implicit" or not model.joint_count:
        return
    constrained = np.flatnonzero(~np.isin(model.joint_type.numpy(), (newton.JointType.FREE, newton.JointType.DISTANCE)))
    if not len(constrained):
        return
    inv_inertias = np.linalg.eigvalsh(np.asarray(model.body_inv_inertia.numpy(), dtype=float)).max(axis=1)
    gains = np.maximum(model.body_inv_mass.numpy(), inv_inertias) * SPRING_STIFFNESS * dt**2
    for joint in constrained:
        bodies = model.joint_parent.numpy()[joint], model.joint_child.numpy()[joint]
        if max(gains[body] for body in bodies if body >= 0) > 1.0:
            raise InputError(
                f"{model.joint_label[joint]}: a body of the joint is too light for the solver {solver}, whose joints "
                f"are springs of {SPRING_STIFFNESS:g} N/m and N·m/rad; use another solver"
            )


def joint_gaps(model: newton.Model) -> dict[str, float]:
    """Return the distances between the ends of joints at the start [m], by joint label, where they are apart.

    Displacements along free axes of a joint do not count. A joint with a gap pulls at the start. Newton does not place
    bodies by their joints: call ``newton.eval_fk``, or add the bodies with ``xform``.
    """
    if not model.joint_count:
        return {}
    poses = np.append(_host(model.body_q), [[0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 1.0]], axis=0)  # body -1 is the world
    parents, frames = poses[_host(model.joint_parent)], _host(model.joint_X_p)
    parent_ends = _to_world(parents, frames[:, :3])
    gaps = parent_ends - _to_world(poses[_host(model.joint_child)], _host(model.joint_X_c)[:, :3])
    slides = _host(model.joint_type) == newton.JointType.PRISMATIC
    axes = _host(model.joint_axis)[_host(model.joint_qd_start)[:-1][slides]]
    axes = _rotate(parents[slides], _rotate(frames[slides], axes))
    gaps[slides] -= axes * (axes * gaps[slides]).sum(axis=1, keepdims=True)
    lengths = np.linalg.norm(gaps, axis=1)
    apart = (are_pins(model) | slides) & _host(model.joint_enabled)
    apart &= joint_ends_apart(lengths, np.linalg.norm(parent_ends, axis=1))
    return {model.joint_label[joint]: float(lengths[joint]) for joint in np.flatnonzero(apart)}


def _to_world(poses: np.ndarray, points: np.ndarray) -> np.ndarray:
    """Transform points [n, 3] from frames with ``poses`` [n, 7] to the world."""
    return poses[:, :3] + _rotate(poses, points)


def _rotate(poses: np.ndarray, vectors: np.ndarray) -> np.ndarray:
    """Rotate vectors [n, 3] from frames with ``poses`` [n, 7] to the world."""
    axes = poses[:, 3:6]
    return vectors + 2.0 * np.cross(axes, np.cross(axes, vectors) + poses[:, 6:] * vectors)


def _host(array: Any) -> np.ndarray:  # Newton's annotations hide that these are arrays
    return array.numpy()


def joint_gap_warnings(gaps: dict[str, float]) -> list[str]:
    """Return a warning about :func:`joint_gaps` as a list of at most one line; stages have warnings by prim instead."""
    if not gaps:
        return []
    label, more = next(iter(gaps)), len(gaps) - 1
    ends = f"{label} and {more} other joints: their ends are up to" if more else f"{label}: its ends are"
    return [f"{ends} {joint_gap_message(max(gaps.values()))}; place the bodies, for example with newton.eval_fk"]
