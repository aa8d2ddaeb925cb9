"""Checks and prepares joints for Newton's importer.

The importer silently drops joints that it cannot create, and ignores the frame of a fixed prim at a joint. The
checks report dropped joints; :func:`prepare_joints` returns the ignored frames.
"""

import math
from collections.abc import Container, Iterator
from dataclasses import dataclass

from pxr import Gf, Tf, Usd, UsdGeom, UsdPhysics

from warpmag.declarations.checks import joint_ends_apart, joint_gap_message
from warpmag.errors import InputError
from warpmag.usd.read.prims import body_of
from warpmag.usd.read.session import editable
from warpmag.usd.read.transforms import TransformCheck
from warpmag.usd.values import Finding, value_of

_AXES = ("transX", "transY", "transZ", "rotX", "rotY", "rotZ")
_MEETING = (UsdPhysics.FixedJoint, UsdPhysics.RevoluteJoint, UsdPhysics.SphericalJoint)
"""Joints whose ends coincide; the ends of a prismatic joint lie on its axis."""
_PLACES = ("physics:localPos0", "physics:localPos1")
_ROOTS = ("PhysicsArticulationRootAPI", "NewtonArticulationRootAPI")
"""API schemas of the root of an articulation; the second includes the first."""
_SELF_COLLISION = "newton:selfCollisionEnabled"


@dataclass(frozen=True)
class GroundedJoint:
    """A joint between a dynamic body and a fixed end."""

    path: str
    position: tuple[float, float, float]  # of the joint's frame at the fixed end [m], world frame
    rotation: tuple[float, float, float, float]  # of that frame, a quaternion (x, y, z, w)
    fixed: str  # path of the fixed prim, such as a collider or a kinematic body; empty for the world itself
    moving: str  # path of the dynamic body
    reversed: bool  # True if the dynamic body is ``body0``: the joint's coordinates then have the opposite sign
    collides: bool  # True if the body and the fixed prim may collide


@dataclass(frozen=True)
class _End:
    """One end of a joint."""

    prim: Usd.Prim | None
    body: Usd.Prim | None  # the rigid body that carries the prim
    moves: bool  # True if that body is dynamic


def joint_findings(stage: Usd.Stage, keyed: Container[str] = ()) -> Iterator[Finding]:
    """Yield errors in the joints of a stage; ``keyed`` are paths of bodies that keys move."""
    transforms = TransformCheck()
    for joint in enabled_joints(stage):
        path, ends = str(joint.GetPath()), _ends(stage, joint)
        for end in ends:
            if end.prim:
                yield from transforms.findings(end.prim)
        carrier = str(ends[1].body.GetPath()) if ends[1].body else ""
        if problem := _problem(stage, joint):
            yield Finding(path, problem)
        elif ends[0].moves and carrier in keyed:
            message = "and Newton would hold it still: name it as physics:body0"
            yield Finding(path, f"its physics:body1 {carrier} is moved by keys, {message}")
        elif not any(end.moves for end in ends):
            yield Finding(path, "joins two fixed ends, and is left out", "warning")
    for path, gap in _strained_joints(stage).items():
        yield Finding(path, f"its ends are {joint_gap_message(gap)}", "warning")


def _strained_joints(stage: Usd.Stage) -> dict[str, float]:
    """Return the distance [m] between the ends of joints at the start, along directions that the joint constrains."""
    transforms, gaps = UsdGeom.XformCache(Usd.TimeCode.Default()), {}
    for joint in enabled_joints(stage):
        ends, slides = _ends(stage, joint), joint.GetPrim().IsA(UsdPhysics.PrismaticJoint)
        if not (slides or any(joint.GetPrim().IsA(kind) for kind in _MEETING)) or not all(end.prim for end in ends):
            continue
        try:
            frames = [transforms.GetLocalToWorldTransform(end.prim) for end in ends]
            first, second = (
                frame.Transform(Gf.Vec3d(value_of(joint.GetPrim(), name)))
                for frame, name in zip(frames, _PLACES, strict=True)
            )
            axis = frames[0].TransformDir(_axis(joint.GetPrim())).GetNormalized() if slides else Gf.Vec3d(0.0)
        except (InputError, Tf.ErrorException):  # reported with the attributes and ends
            continue
        gap = (first - second - axis * ((first - second) * axis)).GetLength()
        if any(end.moves for end in ends) and joint_ends_apart(gap, first.GetLength()):
            gaps[str(joint.GetPath())] = gap
    return gaps


def _axis(joint: Usd.Prim) -> Gf.Vec3d:
    """Return the sliding direction of a prismatic joint, in the frame of ``body0``."""
    axis = Gf.Vec3d(0.0)
    axis["XYZ".index(value_of(joint, "physics:axis"))] = 1.0
    return Gf.Rotation(Gf.Quatd(value_of(joint, "physics:localRot0"))).TransformDir(axis)


def enabled_joints(stage: Usd.Stage) -> list[UsdPhysics.Joint]:
    """Return the enabled joints of a stage, including those in instances."""
    prims = Usd.PrimRange.Stage(stage, Usd.TraverseInstanceProxies())
    joints = [UsdPhysics.Joint(prim) for prim in prims if prim.IsA(UsdPhysics.Joint)]
    return [joint for joint in joints if joint.GetJointEnabledAttr().Get()]


def enabled_joint_paths(stage: Usd.Stage) -> list[str]:
    """Return the paths of the enabled joints of a stage, those in instances included."""
    return [str(joint.GetPath()) for joint in enabled_joints(stage)]


def prepare_joints(stage: Usd.Stage, *, articulations: bool = True) -> list[GroundedJoint]:
    """Rewrite joints that Newton would misread, in the stage's session layer.

    Joints with a kinematic ``body1`` are attached to the world. Joints between two fixed ends are disabled. Unlimited
    axes of a generic joint get explicit infinite limits. Solvers in generalized coordinates need
    ``articulations``. Newton then accepts only trees from parent to child that contain all their bodies. Without
    articulations it accepts any graph of joints.

    Returns:
        The joints between a dynamic body and a fixed end, except for kinematic bodies as ``body0``.
    """
    if not articulations:
        _drop_articulations(stage)
    grounded = []
    for path in [joint.GetPath() for joint in enabled_joints(stage)]:
        joint = UsdPhysics.Joint.Get(stage, path)
        ends, axes = _ends(stage, joint), _free_axes(joint.GetPrim())
        fixed_ends = [number for number, end in enumerate(ends) if not end.moves]
        if (fixed_ends == [0] and not ends[0].body) or fixed_ends == [1]:
            grounded.append(_grounded(joint, ends, fixed_ends[0]))
        swapped = fixed_ends == [1] and ends[1].body is not None
        if not (axes or swapped or len(fixed_ends) == 2):
            continue
        with Usd.EditContext(stage, stage.GetSessionLayer()):
            joint = UsdPhysics.Joint(editable(stage, path))
            for axis in axes:
                limit = UsdPhysics.LimitAPI.Apply(joint.GetPrim(), axis)
                limit.CreateLowAttr(-math.inf)
                limit.CreateHighAttr(math.inf)
            if swapped:  # Newton would drop the joint; a target that is not a body makes it use the world
                joint.GetBody1Rel().SetTargets([path])
            if len(fixed_ends) == 2:
                joint.GetJointEnabledAttr().Set(False)
    return grounded


def _drop_articulations(stage: Usd.Stage) -> None:
    """Remove articulation roots, except for articulations without self-collision."""
    for path in [prim.GetPath() for prim in Usd.PrimRange.Stage(stage, Usd.TraverseInstanceProxies())]:
        prim = stage.GetPrimAtPath(path)
        if prim.HasAPI(UsdPhysics.ArticulationRootAPI) and prim.GetAttribute(_SELF_COLLISION).Get() is not False:
            with Usd.EditContext(stage, stage.GetSessionLayer()):
                for schema in _ROOTS:
                    editable(stage, path).RemoveAppliedSchema(schema)


def _free_axes(joint: Usd.Prim) -> list[str]:
    """Return the axes without limits of a generic joint, which USD leaves free and Newton would lock."""
    axes = _AXES if joint.GetTypeName() == "PhysicsJoint" else ()
    return [axis for axis in axes if not joint.HasAPI(UsdPhysics.LimitAPI, axis)]


def _problem(stage: Usd.Stage, joint: UsdPhysics.Joint) -> str:
    """Return the reason why a joint cannot be created, empty where it can."""
    for relationship in _relationships(joint):
        targets = relationship.GetTargets()
        if len(targets) > 1:
            return f"{relationship.GetName()} names {len(targets)} prims, a joint has one at each end"
        if targets and not stage.GetPrimAtPath(targets[0]):
            return f"{relationship.GetName()} names {targets[0]}, which is not there"
    first, second = _ends(stage, joint)
    if first.body and first.body == second.body:
        return f"both of its ends are on the body {first.body.GetPath()}"
    return ""


def _relationships(joint) -> tuple[Usd.Relationship, Usd.Relationship]:
    return joint.GetBody0Rel(), joint.GetBody1Rel()


def _ends(stage, joint) -> list[_End]:
    ends = []
    for relationship in _relationships(joint):
        targets = relationship.GetTargets()
        prim = stage.GetPrimAtPath(targets[0]) if targets else None
        body = body_of(prim) if prim else None
        kinematic = body and UsdPhysics.RigidBodyAPI(body).GetKinematicEnabledAttr().Get()
        ends.append(_End(prim or None, body or None, bool(body) and not kinematic))
    return ends


def _grounded(joint, ends, fixed_end: int) -> GroundedJoint:
    """Return a joint with the world frame of its fixed end, 0 or 1."""
    local_position = (joint.GetLocalPos0Attr, joint.GetLocalPos1Attr)[fixed_end]().Get()
    local_rotation = Gf.Quatd((joint.GetLocalRot0Attr, joint.GetLocalRot1Attr)[fixed_end]().Get()).GetNormalized()
    fixed = ends[fixed_end].prim
    world = UsdGeom.XformCache(Usd.TimeCode.Default()).GetLocalToWorldTransform(fixed) if fixed else Gf.Matrix4d(1.0)
    position = world.Transform(Gf.Vec3d(local_position))
    rotation = Gf.Transform(world).GetRotation().GetQuat() * local_rotation
    return GroundedJoint(
        str(joint.GetPath()),
        tuple(position),
        (*rotation.GetImaginary(), rotation.GetReal()),
        str(fixed.GetPath()) if fixed else "",
        str(ends[1 - fixed_end].body.GetPath()),
        fixed_end == 1,
        bool(joint.GetCollisionEnabledAttr().Get()),
    )
