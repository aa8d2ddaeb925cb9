"""Authors joints that were made without a stage."""

import math
from dataclasses import dataclass

import numpy as np
from pxr import Gf, Usd, UsdPhysics

_KINDS = {
    "fixed": UsdPhysics.FixedJoint,
    "revolute": UsdPhysics.RevoluteJoint,
    "prismatic": UsdPhysics.PrismaticJoint,
    "ball": UsdPhysics.SphericalJoint,
    "distance": UsdPhysics.DistanceJoint,
}


@dataclass(frozen=True)
class StageDrive:
    """Drive of a revolute or a prismatic joint, in meters or radians."""

    stiffness: float  # [N/m] or [N·m/rad]
    damping: float  # [N·s/m] or [N·m·s/rad]
    position: float  # target
    velocity: float  # target
    most: float  # largest force [N] or torque [N·m], infinite for no limit


@dataclass(frozen=True)
class StageJoint:
    """A joint between two bodies, or a body and the world. Its axis is the x axis of both frames."""

    label: str
    kind: str  # ``fixed``, ``revolute``, ``prismatic``, ``ball`` or ``distance``
    bodies: tuple[int, int]  # parent and child, indices among the bodies, -1 for the world
    frames: tuple[np.ndarray, np.ndarray]  # of the joint in these bodies, shape [7] each
    limits: tuple[float, float] = (-math.inf, math.inf)  # of the position [m or rad], or of the distance [m]
    drive: StageDrive | None = None
    enabled: bool = True
    collides: bool = False  # True if the bodies collide with each other


def author_joint(stage: Usd.Stage, path: str, joint: StageJoint, bodies: list[str]) -> None:
    """Author a joint at a path, with the paths of all bodies."""
    prim = _KINDS[joint.kind].Define(stage, path)
    for number, (body, frame) in enumerate(zip(joint.bodies, joint.frames, strict=True)):
        x, y, z, qx, qy, qz, qw = map(float, frame)
        if body >= 0:
            (prim.CreateBody1Rel if number else prim.CreateBody0Rel)().SetTargets([bodies[body]])
        (prim.CreateLocalPos1Attr if number else prim.CreateLocalPos0Attr)(Gf.Vec3f(x, y, z))
        (prim.CreateLocalRot1Attr if number else prim.CreateLocalRot0Attr)(Gf.Quatf(qw, qx, qy, qz))
    prim.CreateJointEnabledAttr(joint.enabled)
    prim.CreateCollisionEnabledAttr(joint.collides)
    if joint.kind in ("revolute", "prismatic"):
        prim.CreateAxisAttr("X")
        _author_motion(prim, joint)
    elif joint.kind == "distance":
        least, most = joint.limits
        if least >= 0.0:
            prim.CreateMinDistanceAttr(least)
        if 0.0 <= most < math.inf:
            prim.CreateMaxDistanceAttr(most)


def _author_motion(prim, joint: StageJoint) -> None:
    """Author limits and drive of a joint with one degree of freedom. USD has degrees."""
    turns = joint.kind == "revolute"
    unit = math.degrees(1.0) if turns else 1.0
    lower, upper = joint.limits
    if lower > -math.inf:
        prim.CreateLowerLimitAttr(lower * unit)
    if upper < math.inf:
        prim.CreateUpperLimitAttr(upper * unit)
    if (drive := joint.drive) is not None:
        api = UsdPhysics.DriveAPI.Apply(prim.GetPrim(), "angular" if turns else "linear")
        api.CreateTypeAttr("force")
        api.CreateStiffnessAttr(drive.stiffness / unit)
        api.CreateDampingAttr(drive.damping / unit)
        api.CreateTargetPositionAttr(drive.position * unit)
        api.CreateTargetVelocityAttr(drive.velocity * unit)
        if drive.most < math.inf:
            api.CreateMaxForceAttr(drive.most)
