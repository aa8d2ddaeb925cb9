"""The joints of a model that comes from a builder, for its stage."""

import math

import newton
import numpy as np
import warp as wp

from warpmag.engine.newton_versions import drive_target
from warpmag.usd import StageDrive, StageJoint

_KINDS = {newton.JointType[kind]: kind.lower() for kind in ("FIXED", "REVOLUTE", "PRISMATIC", "BALL", "DISTANCE")}
_UNLIMITED = 1e9
"""Positions and forces from which Newton means none; its own value is 1e10."""


def stage_joints(model: newton.Model) -> tuple[list[StageJoint], list[str]]:
    """Return the joints of a model, without free ones, and a warning for each that a stage does not get."""
    joints, warnings = [], []
    types = model.joint_type.numpy() if model.joint_count else ()
    for joint, number in enumerate(types):
        kind = newton.JointType(number)
        if kind in _KINDS:
            joints.append(_stage_joint(model, joint, _KINDS[kind]))
        elif kind != newton.JointType.FREE:
            name = kind.name.lower()
            warnings.append(f"{model.joint_label[joint]}: the output has no {name} joints, and leaves it out")
    return joints, warnings


def _stage_joint(model: newton.Model, joint: int, kind: str) -> StageJoint:
    bodies = int(model.joint_parent.numpy()[joint]), int(model.joint_child.numpy()[joint])
    frames = [wp.transform(*frames.numpy()[joint].tolist()) for frames in (model.joint_X_p, model.joint_X_c)]
    limits, drive, axis = (-math.inf, math.inf), None, int(model.joint_qd_start.numpy()[joint])
    if kind in ("revolute", "prismatic"):
        along = wp.quat_between_vectors(wp.vec3(1.0, 0.0, 0.0), wp.vec3(*model.joint_axis.numpy()[axis].tolist()))
        frames = [frame * wp.transform(wp.vec3(), along) for frame in frames]
        drive = _drive(model, joint, axis)
    if kind in ("revolute", "prismatic", "distance"):
        lower, upper = (float(values.numpy()[axis]) for values in (model.joint_limit_lower, model.joint_limit_upper))
        limits = lower if lower > -_UNLIMITED else -math.inf, upper if upper < _UNLIMITED else math.inf
    return StageJoint(
        label=model.joint_label[joint],
        kind=kind,
        bodies=bodies,
        frames=(np.array(frames[0]), np.array(frames[1])),
        limits=limits,
        drive=drive,
        enabled=bool(model.joint_enabled.numpy()[joint]),
        collides=_collide(model, bodies),
    )


def _drive(model: newton.Model, joint: int, axis: int) -> StageDrive | None:
    """Return the drive of a joint with one degree of freedom; None without stiffness and damping."""
    stiffness, damping = (float(values.numpy()[axis]) for values in (model.joint_target_ke, model.joint_target_kd))
    if stiffness == 0.0 and damping == 0.0:
        return None
    most = float(model.joint_effort_limit.numpy()[axis])
    return StageDrive(stiffness, damping, *drive_target(model, joint, axis), most if most < _UNLIMITED else math.inf)


def _collide(model: newton.Model, bodies: tuple[int, int]) -> bool:
    """Return True unless the shapes of two bodies are filtered from each other's collisions."""
    first, second = (model.body_shapes.get(body, []) for body in bodies)
    filtered = model.shape_collision_filter_pairs
    return not any((min(a, b), max(a, b)) in filtered for a in first for b in second)
