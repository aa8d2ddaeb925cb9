"""Differences between the versions of Newton that warpmag runs with: 1.6.1, which Isaac Lab 3.0 needs, to 1.8."""

import inspect
from typing import Any

import newton
import warp as wp

from warpmag.errors import InputError


def add_copies(builder: newton.ModelBuilder, template: newton.ModelBuilder, count: int) -> None:
    """Add copies of a builder to the current world of another one."""
    if "separate_worlds" in inspect.signature(newton.ModelBuilder.replicate).parameters:
        builder.replicate(template, count, separate_worlds=False)
        return
    for _ in range(count):  # earlier versions make a world of each copy
        builder.add_builder(template)


def triangle_limit(most: int | None) -> dict[str, int]:
    """Return the argument of ``newton.CollisionPipeline`` that limits pairs of triangles; None for Newton's default."""
    return {} if most is None else {"max_triangle_pairs": most}  # None is an argument from 1.8 on


def has_tendons(model: newton.Model) -> bool:
    """Return True if a model has tendons, which versions before 1.8 do not know."""
    return getattr(model, "tendon_segment_count", 0) > 0


def reverse_targets(builder: newton.ModelBuilder, joint: int, axis: int) -> None:
    """Reverse the target position and velocity of a joint's drive along its axis, the degree of freedom ``axis``."""
    if hasattr(builder, "joint_target_q"):
        builder.joint_target_qd[axis] *= -1.0
        builder.joint_target_q[builder.joint_q_start[joint]] *= -1.0
        return
    for name in ("joint_target_vel", "joint_target_pos"):  # before 1.8
        getattr(builder, name)[axis] *= -1.0


def drive_target(model: newton.Model, joint: int, axis: int) -> tuple[float, float]:
    """Return the target position and velocity of the drive of a joint with the one degree of freedom ``axis``."""
    if hasattr(model, "joint_target_q"):
        position = model.joint_target_q.numpy()[model.joint_q_start.numpy()[joint]]
        return float(position), float(model.joint_target_qd.numpy()[axis])
    old: Any = model  # before 1.8
    return float(old.joint_target_pos.numpy()[axis]), float(old.joint_target_vel.numpy()[axis])


def has_joint_kernels(solver: newton.solvers.SolverXPBD) -> bool:
    """Return True if a solver has the joints of 1.8, whose kernels warpmag launches; and no mimic joints."""
    return not getattr(solver, "_has_joint_mimics", True)


def has_moving_surfaces(contacts: newton.Contacts) -> bool:
    """Return True if surfaces move along contacts, which versions before 1.8 do not know."""
    return getattr(contacts, "rigid_contact_surface_velocity", None) is not None


def lost_contacts(contacts: newton.Contacts) -> wp.array | None:
    """Return the counter of contacts of meshes lost during reduction, shape [1]; None where none is counted."""
    counters: Any = contacts.contact_counters
    return counters[2:3] if counters.shape[0] > 2 else None  # two counters before 1.8


def camera_type() -> Any:
    """Return Newton's ray tracer; versions without it raise :class:`InputError`."""
    try:
        from newton.sensors import SensorCamera  # noqa: PLC0415
    except ImportError:
        version = newton.__version__
        raise InputError(f"pictures: need Newton 1.8, which has a ray tracer of its own; this is {version}") from None
    return SensorCamera
