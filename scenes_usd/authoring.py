"""Building blocks of the bundled scenes: SI units, Z up, one prim per body, every attribute authored."""

import math
import os
from collections.abc import Sequence
from pathlib import Path

from pxr import Gf, Sdf, Usd, UsdGeom, UsdLux, UsdPhysics, UsdShade, Vt

from warpmag.magnets import Magnet, MagneticSettings
from warpmag.usd import author_magnet, author_settings

GRAVITY = 9.81
"""Acceleration of free fall [m/s²]."""
IRON_DENSITY = 7870.0
"""Density of iron [kg/m³]."""
STEEL_COLOR = (0.55, 0.57, 0.6)
MAGNET_COLOR = (0.75, 0.08, 0.06)
GROUND_COLOR = (0.32, 0.33, 0.35)

_METRICS = {"metersPerUnit": 1.0, "kilogramsPerUnit": 1.0, "upAxis": "Z"}


def new_stage(documentation: str, *, seconds: float, frames_per_second: float = 60.0) -> Usd.Stage:
    """Return an empty stage in metres and kilograms with Z up and the default prim ``/World``.

    Args:
        documentation: What the scene shows; the first line is what ``warpmag scenes`` prints.
        seconds: Length of the scene [s].
        frames_per_second: Output rate [Hz], also the time codes per second.
    """
    stage = Usd.Stage.CreateInMemory()
    for key, value in _METRICS.items():
        stage.SetMetadata(key, value)
    stage.SetMetadata("documentation", documentation)
    stage.SetTimeCodesPerSecond(frames_per_second)
    stage.SetFramesPerSecond(frames_per_second)
    stage.SetStartTimeCode(0.0)
    stage.SetEndTimeCode(seconds * frames_per_second)
    stage.SetDefaultPrim(UsdGeom.Xform.Define(stage, "/World").GetPrim())
    return stage


def save(stage: Usd.Stage, path: str | os.PathLike) -> None:
    """Write a stage to a file."""
    Path(path).parent.mkdir(parents=True, exist_ok=True)
    stage.GetRootLayer().Export(str(path))


def add_scene(stage: Usd.Stage, settings: MagneticSettings, *, step: float) -> Usd.Prim:
    """Author the physics scene: gravity, time step [s] and magnetic settings."""
    scene = UsdPhysics.Scene.Define(stage, "/World/PhysicsScene")
    scene.CreateGravityDirectionAttr(Gf.Vec3f(0.0, 0.0, -1.0))
    scene.CreateGravityMagnitudeAttr(GRAVITY)
    prim = scene.GetPrim()
    prim.AddAppliedSchema("NewtonSceneAPI")
    prim.CreateAttribute("newton:timeStepsPerSecond", Sdf.ValueTypeNames.Int, False, Sdf.VariabilityUniform).Set(
        round(1.0 / step)
    )
    author_settings(prim, settings)
    return prim


def add_material(
    stage: Usd.Stage,
    name: str,
    *,
    color: Sequence[float],
    metallic: float = 0.0,
    roughness: float = 0.5,
    density: float | None = None,
    friction: float = 0.0,
    restitution: float = 0.0,
) -> UsdShade.Material:
    """Author one material for physics and for looks.

    Args:
        stage: The stage.
        name: Name of the prim under ``/World/Materials``.
        color: Linear RGB.
        metallic: Metalness, 0 to 1.
        roughness: Roughness, 0 to 1.
        density: Mass density [kg/m³] of the bodies that it is bound to.
        friction: Coefficient of static and dynamic friction.
        restitution: Coefficient of restitution.
    """
    UsdGeom.Scope.Define(stage, "/World/Materials")
    material = UsdShade.Material.Define(stage, f"/World/Materials/{name}")
    physics = UsdPhysics.MaterialAPI.Apply(material.GetPrim())
    physics.CreateStaticFrictionAttr(friction)
    physics.CreateDynamicFrictionAttr(friction)
    physics.CreateRestitutionAttr(restitution)
    if density is not None:
        physics.CreateDensityAttr(density)
    shader = UsdShade.Shader.Define(stage, material.GetPath().AppendChild("Surface"))
    shader.CreateIdAttr("UsdPreviewSurface")
    shader.CreateInput("diffuseColor", Sdf.ValueTypeNames.Color3f).Set(Gf.Vec3f(*color))
    shader.CreateInput("metallic", Sdf.ValueTypeNames.Float).Set(metallic)
    shader.CreateInput("roughness", Sdf.ValueTypeNames.Float).Set(roughness)
    material.CreateSurfaceOutput().ConnectToSource(shader.ConnectableAPI(), "surface")
    return material


def add_ground(stage: Usd.Stage, material: UsdShade.Material, *, size: float, color=GROUND_COLOR) -> Usd.Prim:
    """Author the plane z = 0: infinite as a collider, drawn as a square of ``size`` [m]."""
    plane = UsdGeom.Plane.Define(stage, "/World/Ground")
    plane.CreateAxisAttr(UsdGeom.Tokens.z)
    plane.CreateWidthAttr(size)
    plane.CreateLengthAttr(size)
    _finish(plane, material, color)
    return plane.GetPrim()


def add_ball(
    stage: Usd.Stage,
    path: str,
    position: Sequence[float],
    radius: float,
    material: UsdShade.Material,
    *,
    magnet: Magnet | None = None,
    color: Sequence[float] = STEEL_COLOR,
) -> Usd.Prim:
    """Author a ball: a sphere that is a rigid body and its own collider, with its centre at ``position`` [m]."""
    ball = UsdGeom.Sphere.Define(stage, path)
    ball.CreateRadiusAttr(radius)
    _make_body(ball, position, kinematic=False)
    _finish(ball, material, color)
    if magnet is not None:
        author_magnet(ball.GetPrim(), magnet)
    return ball.GetPrim()


def add_cube(
    stage: Usd.Stage,
    path: str,
    position: Sequence[float],
    size: float,
    material: UsdShade.Material,
    *,
    magnet: Magnet | None = None,
    kinematic: bool = False,
    color: Sequence[float] = MAGNET_COLOR,
) -> Usd.Prim:
    """Author a cube with edges of ``size`` [m], held in place where it is ``kinematic``."""
    cube = UsdGeom.Cube.Define(stage, path)
    cube.CreateSizeAttr(size)
    _make_body(cube, position, kinematic=kinematic)
    _finish(cube, material, color)
    if magnet is not None:
        author_magnet(cube.GetPrim(), magnet)
    return cube.GetPrim()


def add_camera(stage: Usd.Stage, eye: Sequence[float], target: Sequence[float], *, field_of_view: float = 35.0) -> None:
    """Author a camera at ``eye`` [m] that looks at ``target`` [m], ``field_of_view`` [degrees] wide."""
    camera = UsdGeom.Camera.Define(stage, "/World/Camera")
    view = Gf.Matrix4d().SetLookAt(Gf.Vec3d(*eye), Gf.Vec3d(*target), Gf.Vec3d(0.0, 0.0, 1.0))
    camera.AddTransformOp().Set(view.GetInverse())
    aperture = camera.GetHorizontalApertureAttr().Get()
    camera.CreateHorizontalApertureAttr(aperture)
    camera.CreateVerticalApertureAttr(aperture * 9.0 / 16.0)
    camera.CreateFocalLengthAttr(0.5 * aperture / math.tan(math.radians(0.5 * field_of_view)))
    distance = math.dist(eye, target)
    camera.CreateClippingRangeAttr(Gf.Vec2f(0.01 * distance, 100.0 * distance))
    camera.CreateFocusDistanceAttr(distance)


def add_lights(stage: Usd.Stage) -> None:
    """Author a sun from the upper left and a sky that fills the shadows."""
    sky = UsdLux.DomeLight.Define(stage, "/World/Lights/Sky")
    sky.CreateIntensityAttr(0.4)
    sun = UsdLux.DistantLight.Define(stage, "/World/Lights/Sun")
    sun.CreateIntensityAttr(2.0)
    sun.CreateAngleAttr(2.0)
    sun.AddRotateXYZOp().Set(Gf.Vec3f(40.0, -25.0, 0.0))


def _make_body(shape, position, *, kinematic) -> None:
    shape.AddTranslateOp().Set(Gf.Vec3d(*position))
    body = UsdPhysics.RigidBodyAPI.Apply(shape.GetPrim())
    body.CreateKinematicEnabledAttr(kinematic)


def _finish(shape, material, color) -> None:
    """Make ``shape`` a collider and give it an extent, a material and a colour."""
    shape.CreateExtentAttr(UsdGeom.Boundable.ComputeExtentFromPlugins(shape, Usd.TimeCode.Default()))
    UsdPhysics.CollisionAPI.Apply(shape.GetPrim())
    shape.CreateDisplayColorAttr(Vt.Vec3fArray([Gf.Vec3f(*color)]))
    UsdShade.MaterialBindingAPI.Apply(shape.GetPrim()).Bind(material)
