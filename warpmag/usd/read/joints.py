"""Reads which bodies joints connect, and where the ends of joints stand that no body moves.

Newton's importer drops joints that it cannot make, without a word, and takes the frame of a fixed prim at a joint for
that of the world. Both are found here.
"""

import math
from collections.abc import Container, Iterator
from dataclasses import dataclass

from pxr import Gf, Sdf, Tf, Usd, UsdGeom, UsdPhysics

from warpmag.declarations.checks import joint_ends_apart, joint_gap_message
from warpmag.errors import InputError
from warpmag.usd.read.transforms import TransformCheck
from warpmag.usd.values import Finding, value_of

_AXES = ("transX", "transY", "transZ", "rotX", "rotY", "rotZ")
_MEETING = (UsdPhysics.FixedJoint, UsdPhysics.RevoluteJoint, UsdPhysics.SphericalJoint)
"""Joints whose ends are at one place; those of a prismatic joint are on its axis."""
_PLACES = ("physics:localPos0", "physics:localPos1")
_ROOTS = ("PhysicsArticulationRootAPI", "NewtonArticulationRootAPI")
"""What makes a prim the root of an articulation; the second brings the first along."""
_SELF_COLLISION = "newton:selfCollisionEnabled"


@dataclass(frozen=True)
class GroundedJoint:
    """A joint between a body that moves and something that does not.

    Attributes:
        path: Prim of the joint.
        position: Where the joint's frame stands on what is fixed [m], world frame.
        rotation: How it is turned there, quaternion x y z w.
        fixed: Prim that is fixed, a collider or a kinematic body for instance; empty for the world itself.
        moving: Prim of the body that moves.
        reversed: Whether the body that moves is ``body0``: coordinates of the joint then count the other way round.
        collides: Whether the two may touch.
    """

    path: str
    position: tuple[float, float, float]
    rotation: tuple[float, float, float, float]
    fixed: str
    moving: str
    reversed: bool
    collides: bool


@dataclass(frozen=True)
class _End:
    """One end of a joint: what it is attached to, and the rigid body that carries that, if one does."""

    prim: Usd.Prim | None
    body: Usd.Prim | None
    moves: bool


def joint_findings(stage: Usd.Stage, keyed: Container[str] = ()) -> Iterator[Finding]:
    """Yield what is wrong with the joints of a stage, of which keys move the bodies ``keyed``."""
    transforms = TransformCheck()
    for joint in enabled_joints(stage):
        path = str(joint.GetPath())
        for end in _ends(stage, joint):
            if end.prim:
                yield from transforms.findings(end.prim)
        if problem := _problem(stage, joint):
            yield Finding(path, problem)
        elif keyed and (carrier := _hung_on(stage, joint)) in keyed:
            message = "by physics:body1, which Newton would hold still: name it as physics:body0"
            yield Finding(path, f"hangs on {carrier}, which keys move, {message}")
        elif not any(end.moves for end in _ends(stage, joint)):
            yield Finding(path, "joins things that do not move, and is left out", "warning")
    for path, gap in _strained_joints(stage).items():
        yield Finding(path, f"its ends are {joint_gap_message(gap)}", "warning")


def _hung_on(stage, joint) -> str:
    """Return the body that is ``physics:body1`` of a joint whose other end moves, empty where there is none."""
    one, other = _ends(stage, joint)
    return str(other.body.GetPath()) if one.moves and other.body else ""


def _strained_joints(stage: Usd.Stage) -> dict[str, float]:
    """Return how far the ends of joints are apart at the start [m], in ways that the joint does not leave free."""
    places, found = UsdGeom.XformCache(Usd.TimeCode.Default()), {}
    for joint in enabled_joints(stage):
        ends, slides = _ends(stage, joint), joint.GetPrim().IsA(UsdPhysics.PrismaticJoint)
        if not (slides or any(joint.GetPrim().IsA(kind) for kind in _MEETING)) or not all(end.prim for end in ends):
            continue
        try:
            frames = [places.GetLocalToWorldTransform(end.prim) for end in ends]
            one, other = (
                frame.Transform(Gf.Vec3d(value_of(joint.GetPrim(), name)))
                for frame, name in zip(frames, _PLACES, strict=True)
            )
            axis = frames[0].TransformDir(_axis(joint.GetPrim())).GetNormalized() if slides else Gf.Vec3d(0.0)
        except (InputError, Tf.ErrorException):  # among the findings of the attributes and ends
            continue
        gap = (one - other - axis * ((one - other) * axis)).GetLength()
        if any(end.moves for end in ends) and joint_ends_apart(gap, one.GetLength()):
            found[str(joint.GetPath())] = gap
    return found


def _axis(joint: Usd.Prim) -> Gf.Vec3d:
    """Return the direction in which a prismatic joint slides, in the frame of what ``body0`` names."""
    axis = Gf.Vec3d(0.0)
    axis["XYZ".index(value_of(joint, "physics:axis"))] = 1.0
    return Gf.Rotation(Gf.Quatd(value_of(joint, "physics:localRot0"))).TransformDir(axis)


def enabled_joints(stage: Usd.Stage) -> list[UsdPhysics.Joint]:
    """Return the joints of a stage that are enabled, those in instances included."""
    prims = Usd.PrimRange.Stage(stage, Usd.TraverseInstanceProxies())
    joints = [UsdPhysics.Joint(prim) for prim in prims if prim.IsA(UsdPhysics.Joint)]
    return [joint for joint in joints if joint.GetJointEnabledAttr().Get()]


def enabled_joint_paths(stage: Usd.Stage) -> list[str]:
    """Return the paths of the enabled joints of a stage, those in instances included."""
    return [str(joint.GetPath()) for joint in enabled_joints(stage)]


def prepare_joints(stage: Usd.Stage, *, articulations: bool = True) -> list[GroundedJoint]:
    """Rewrite joints that Newton reads otherwise than USD means them, in the stage's session layer.

    Joints with a kinematic body as ``body1`` hang on the world then, those between two things that do not move are
    disabled, and axes that a generic joint does not limit are free in so many words.

    Args:
        stage: The stage.
        articulations: Whether joints are wanted in trees. Newton takes nothing but trees, from parent to child, with
            all their bodies in them; where each joint counts for itself, the roots only stand in the way of the rest.

    Returns:
        The joints between a body that moves and something that does not, but for kinematic bodies as ``body0``.
    """
    if not articulations:
        _drop_articulations(stage)
    grounded = []
    for path in [joint.GetPath() for joint in enabled_joints(stage)]:
        joint = UsdPhysics.Joint.Get(stage, path)
        ends, axes = _ends(stage, joint), _free_axes(joint.GetPrim())
        still = [number for number, end in enumerate(ends) if not end.moves]
        if (still == [0] and not ends[0].body) or still == [1]:
            grounded.append(_grounded(joint, ends, still[0]))
        swapped = still == [1] and ends[1].body is not None
        if not (axes or swapped or len(still) == 2):
            continue
        with Usd.EditContext(stage, stage.GetSessionLayer()):
            joint = UsdPhysics.Joint(_editable(stage, path))
            for axis in axes:
                limit = UsdPhysics.LimitAPI.Apply(joint.GetPrim(), axis)
                limit.CreateLowAttr(-math.inf)
                limit.CreateHighAttr(math.inf)
            if swapped:  # Newton drops it; where a prim is no body it takes the world, and joints with one prim each
                joint.GetBody1Rel().SetTargets([path])
            if len(still) == 2:
                joint.GetJointEnabledAttr().Set(False)
    return grounded


def _drop_articulations(stage: Usd.Stage) -> None:
    """Take the roots of articulations off, but for those within which bodies do not collide."""
    for path in [prim.GetPath() for prim in Usd.PrimRange.Stage(stage, Usd.TraverseInstanceProxies())]:
        prim = stage.GetPrimAtPath(path)
        if prim.HasAPI(UsdPhysics.ArticulationRootAPI) and prim.GetAttribute(_SELF_COLLISION).Get() is not False:
            with Usd.EditContext(stage, stage.GetSessionLayer()):
                for schema in _ROOTS:
                    _editable(stage, path).RemoveAppliedSchema(schema)


def _editable(stage: Usd.Stage, path: Sdf.Path) -> Usd.Prim:
    """Return the prim at ``path``, no longer in an instance: those cannot be edited."""
    while (prim := stage.GetPrimAtPath(path)).IsInstanceProxy():
        while prim.IsInstanceProxy():
            prim = prim.GetParent()
        prim.SetInstanceable(False)
    return prim


def _free_axes(joint: Usd.Prim) -> list[str]:
    """Return the axes that a generic joint leaves free by having no limit for them, which Newton would lock."""
    if joint.GetTypeName() != "PhysicsJoint":
        return []
    return [axis for axis in _AXES if not joint.HasAPI(UsdPhysics.LimitAPI, axis)]


def _problem(stage: Usd.Stage, joint: UsdPhysics.Joint) -> str:
    """Return why a joint cannot be made; empty if it can."""
    for relationship in _relationships(joint):
        targets = relationship.GetTargets()
        if len(targets) > 1:
            return f"{relationship.GetName()} names {len(targets)} prims, a joint has one at each end"
        if targets and not stage.GetPrimAtPath(targets[0]):
            return f"{relationship.GetName()} names {targets[0]}, which is not there"
    one, other = _ends(stage, joint)
    if one.body and one.body == other.body:
        return f"both of its ends are on the body {one.body.GetPath()}"
    return ""


def _relationships(joint) -> tuple[Usd.Relationship, Usd.Relationship]:
    return joint.GetBody0Rel(), joint.GetBody1Rel()


def _ends(stage, joint) -> list[_End]:
    ends = []
    for relationship in _relationships(joint):
        targets = relationship.GetTargets()
        prim = stage.GetPrimAtPath(targets[0]) if targets else None
        body = prim
        while body and not _is_body(body):
            body = body.GetParent()
        kinematic = body and UsdPhysics.RigidBodyAPI(body).GetKinematicEnabledAttr().Get()
        ends.append(_End(prim or None, body or None, bool(body) and not kinematic))
    return ends


def _is_body(prim) -> bool:
    return prim.HasAPI(UsdPhysics.RigidBodyAPI) and bool(UsdPhysics.RigidBodyAPI(prim).GetRigidBodyEnabledAttr().Get())


def _grounded(joint, ends, still: int) -> GroundedJoint:
    """Return where the end number ``still`` of a joint stands in the world."""
    place = (joint.GetLocalPos0Attr, joint.GetLocalPos1Attr)[still]().Get()
    turn = Gf.Quatd((joint.GetLocalRot0Attr, joint.GetLocalRot1Attr)[still]().Get()).GetNormalized()
    fixed = ends[still].prim
    world = UsdGeom.XformCache(Usd.TimeCode.Default()).GetLocalToWorldTransform(fixed) if fixed else Gf.Matrix4d(1.0)
    position = world.Transform(Gf.Vec3d(place))
    turn = Gf.Transform(world).GetRotation().GetQuat() * turn
    return GroundedJoint(
        str(joint.GetPath()),
        tuple(position),
        (*turn.GetImaginary(), turn.GetReal()),
        str(fixed.GetPath()) if fixed else "",
        str(ends[1 - still].body.GetPath()),
        still == 1,
        bool(joint.GetCollisionEnabledAttr().Get()),
    )
