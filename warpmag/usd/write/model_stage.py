"""Authors a stage of bodies, shapes, magnets, joints and coils that were made without a stage."""

from dataclasses import dataclass

import numpy as np
from pxr import Gf, Sdf, Tf, Usd, UsdGeom, UsdPhysics, Vt

from warpmag.declarations.coils import Coil, FieldMap
from warpmag.declarations.magnets import Magnet, MagneticSettings
from warpmag.usd.read.coils import author_coil, author_field_map
from warpmag.usd.schemas import author_magnet, author_settings
from warpmag.usd.write.model_joints import StageJoint, author_joint

_COLORS = {"inducible": (0.55, 0.57, 0.6), "permanent": (0.75, 0.08, 0.06), "": (0.32, 0.33, 0.35)}
"""Color by the kind of magnet, linear RGB."""


@dataclass(frozen=True)
class StageBody:
    """A rigid body."""

    label: str  # its last part becomes the name of the prim
    pose: np.ndarray  # position [m] and quaternion x y z w, shape [7]
    mass: float  # [kg]
    kinematic: bool


@dataclass(frozen=True)
class StageShape:
    """A shape of a body or of the world."""

    label: str
    body: int  # index among the bodies, -1 for the world
    kind: str  # ``sphere``, ``box``, ``capsule``, ``cylinder``, ``cone``, ``mesh`` or ``plane``
    pose: np.ndarray  # in the frame of the body, shape [7]
    size: tuple[float, float, float]  # Newton's scale [m]: radius and half height, or half edges
    collides: bool
    magnet: Magnet | None  # in the frame of the shape
    points: np.ndarray | None = None  # vertices of a mesh [m], shape [n, 3]
    triangles: np.ndarray | None = None  # indices of vertices, shape [m, 3]


class ModelStage:
    """A stage in meters and kilograms.

    Attributes:
        stage: The stage, without a file.
        bodies: Paths of the bodies.
        shapes: Paths of the shapes.
    """

    def __init__(self, up_axis: str, gravity: np.ndarray, settings: MagneticSettings, frame_rate: float):
        """Author the scene: ``gravity`` [m/s²], magnetic settings, frames per second [Hz]."""
        self.stage = stage = Usd.Stage.CreateInMemory()
        UsdGeom.SetStageMetersPerUnit(stage, 1.0)
        UsdPhysics.SetStageKilogramsPerUnit(stage, 1.0)
        UsdGeom.SetStageUpAxis(stage, up_axis)
        stage.SetTimeCodesPerSecond(frame_rate)
        stage.SetFramesPerSecond(frame_rate)
        stage.SetStartTimeCode(0.0)
        stage.SetEndTimeCode(0.0)
        stage.SetDefaultPrim(UsdGeom.Xform.Define(stage, "/World").GetPrim())
        scene = UsdPhysics.Scene.Define(stage, "/World/PhysicsScene")
        magnitude = float(np.linalg.norm(gravity))
        scene.CreateGravityMagnitudeAttr(magnitude)
        scene.CreateGravityDirectionAttr(Gf.Vec3f(*(gravity / (magnitude or 1.0)).tolist()))
        author_settings(scene.GetPrim(), settings)
        self.bodies: list[str] = []
        self.shapes: list[str] = []

    def add_body(self, body: StageBody) -> None:
        """Add a rigid body."""
        xform = UsdGeom.Xform.Define(self.stage, self._new_path("/World", body.label))
        _place(xform, body.pose)
        rigid = UsdPhysics.RigidBodyAPI.Apply(xform.GetPrim())
        rigid.CreateKinematicEnabledAttr(body.kinematic)
        if body.mass > 0.0:
            UsdPhysics.MassAPI.Apply(xform.GetPrim()).CreateMassAttr(body.mass)
        self.bodies.append(str(xform.GetPath()))

    def add_shape(self, shape: StageShape) -> None:
        """Add a shape to a body that was added, or to the world."""
        path = self._new_path(self.bodies[shape.body] if shape.body >= 0 else "/World", shape.label)
        geometry, scale = _define(self.stage, path, shape)
        _place(geometry, shape.pose, scale)
        prim = geometry.GetPrim()
        color = _COLORS[shape.magnet.kind if shape.magnet else ""]
        geometry.CreateDisplayColorAttr(Vt.Vec3fArray([Gf.Vec3f(*color)]))
        if shape.collides:
            UsdPhysics.CollisionAPI.Apply(prim)
        if shape.magnet:
            author_magnet(prim, shape.magnet)
        self.shapes.append(path)

    def add_joint(self, joint: StageJoint) -> None:
        """Add a joint between bodies that were added."""
        author_joint(self.stage, self._new_path("/World", joint.label), joint, self.bodies)

    def add_source(self, source: Coil | FieldMap, label: str, body: int, pose: np.ndarray) -> str:
        """Add a coil or a field map with a pose in the frame of a body, or for -1 in the world; return its path."""
        path = self._new_path(self.bodies[body] if body >= 0 else "/World", label)
        xform = UsdGeom.Xform.Define(self.stage, path)
        _place(xform, pose)
        author = author_coil if isinstance(source, Coil) else author_field_map
        author(xform.GetPrim(), source)
        return path

    def _new_path(self, parent: str, label: str) -> str:
        """Return a path below ``parent`` that no prim has, named after the last part of a label."""
        name = Tf.MakeValidIdentifier(label.rpartition("/")[2] or "Body")
        path, number = Sdf.Path(parent).AppendChild(name), 0
        while self.stage.GetPrimAtPath(path):
            number += 1
            path = Sdf.Path(parent).AppendChild(f"{name}_{number}")
        return str(path)


def _define(stage: Usd.Stage, path: str, shape: StageShape):
    """Define the gprim of a shape; return it and its scale, or None."""
    first, second, third = shape.size
    if shape.kind == "box":
        cube = UsdGeom.Cube.Define(stage, path)
        cube.CreateSizeAttr(2.0)
        return cube, (first, second, third)
    if shape.kind == "sphere":
        sphere = UsdGeom.Sphere.Define(stage, path)
        sphere.CreateRadiusAttr(first)
        return sphere, None
    if shape.kind == "mesh":
        mesh = UsdGeom.Mesh.Define(stage, path)
        mesh.CreatePointsAttr(Vt.Vec3fArray.FromNumpy(np.ascontiguousarray(shape.points, np.float32)))
        mesh.CreateFaceVertexCountsAttr([3] * len(shape.triangles))
        mesh.CreateFaceVertexIndicesAttr(Vt.IntArray.FromNumpy(np.ascontiguousarray(shape.triangles, np.int32).ravel()))
        mesh.CreateSubdivisionSchemeAttr("none")
        return mesh, None
    if shape.kind == "plane":
        plane = UsdGeom.Plane.Define(stage, path)
        plane.CreateWidthAttr(first)
        plane.CreateLengthAttr(second)
        plane.CreateAxisAttr("Z")
        return plane, None
    kind = {"capsule": UsdGeom.Capsule, "cylinder": UsdGeom.Cylinder, "cone": UsdGeom.Cone}[shape.kind]
    gprim = kind.Define(stage, path)
    gprim.CreateRadiusAttr(first)
    gprim.CreateHeightAttr(2.0 * second)
    gprim.CreateAxisAttr("Z")
    return gprim, None


def _place(xformable, pose: np.ndarray, scale: tuple[float, float, float] | None = None) -> None:
    """Author the pose of a prim in its parent's frame, and its scale."""
    x, y, z, qx, qy, qz, qw = map(float, pose)
    xformable.AddTranslateOp(UsdGeom.XformOp.PrecisionDouble).Set(Gf.Vec3d(x, y, z))
    xformable.AddOrientOp().Set(Gf.Quatf(qw, qx, qy, qz))
    if scale is not None:
        xformable.AddScaleOp().Set(Gf.Vec3f(*scale))
