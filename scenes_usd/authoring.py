"""Building blocks of the bundled scenes: SI units, Z up, one prim per body, all attributes authored."""

import argparse
import inspect
import math
import os
import re
import sys
from collections.abc import Callable, Sequence
from pathlib import Path

import numpy as np
from pxr import Gf, Sdf, Usd, UsdGeom, UsdLux, UsdPhysics, UsdShade, Vt

from warpmag.declarations.magnets import Magnet, MagneticSettings
from warpmag.errors import InputError
from warpmag.show.materials import author_surface
from warpmag.usd import author_magnet, author_settings
from warpmag.usd.write.output import Output

GRAVITY = 9.81  # acceleration of free fall [m/s²]
IRON_DENSITY = 7870.0  # density of iron [kg/m³]
STEEL_COLOR, MAGNET_COLOR, GROUND_COLOR = (0.55, 0.57, 0.6), (0.75, 0.08, 0.06), (0.32, 0.33, 0.35)  # linear RGB

CONTACT_PATCH = 1e-4
"""Size of the contact patch of two bodies [m], the coefficient of rolling and torsional friction.

Newton's default for rolling friction. Without rolling friction balls circle a magnet forever."""

BALL_SPACING = 2.002
"""Distance of neighboring balls in radii: a gap of a thousandth, so that rounding never makes them overlap."""

DYNAMIC, KINEMATIC, STATIC = "dynamic", "kinematic", "static"
"""Motion of a shape: a body of its own, a body held in place, or a part of its ancestor."""

_FILM, _F_STOP = 0.036, 8.0  # width of the camera's film [m], and focal length over aperture
_SOFT_BOXES = (
    ("Key", (-0.75, -0.4, 1.0), 0.8, 9.0, (1.0, 0.96, 0.9)),
    ("Rim", (0.9, 0.9, 0.6), 0.6, 8.0, (0.9, 0.95, 1.0)),
)
"""Name, offset from the target and side over the camera's distance, radiance, and linear RGB of each light."""


def new_stage(documentation: str, *, seconds: float, frames_per_second: float = 60.0) -> Usd.Stage:
    """Return an empty stage in meters and kilograms with Z up, the default prim ``/World`` and a duration [s].

    ``warpmag scenes`` prints the first line of the ``documentation``. Frames and time codes have the same rate [Hz].
    """
    stage = Usd.Stage.CreateInMemory()
    metadata = {"metersPerUnit": 1.0, "kilogramsPerUnit": 1.0, "upAxis": "Z", "documentation": documentation}
    for key, value in metadata.items():
        stage.SetMetadata(key, value)
    stage.SetTimeCodesPerSecond(frames_per_second)
    stage.SetFramesPerSecond(frames_per_second)
    stage.SetStartTimeCode(0.0)
    stage.SetEndTimeCode(seconds * frames_per_second)
    stage.SetDefaultPrim(UsdGeom.Xform.Define(stage, "/World").GetPrim())
    return stage


def save(stage: Usd.Stage, path: str | os.PathLike) -> None:
    """Write a stage to a file.

    Raises:
        InputError: The file cannot be written.
    """
    path = Path(path)
    with Output.errors(path):
        path.parent.mkdir(parents=True, exist_ok=True)
        stage.GetRootLayer().Export(str(path))


def add_scene(stage: Usd.Stage, settings: MagneticSettings, *, gravity: float = GRAVITY) -> None:
    """Author the physics scene: a time step of 1 ms, gravity [m/s²] towards -z and magnetic settings."""
    scene = UsdPhysics.Scene.Define(stage, "/World/PhysicsScene")
    scene.CreateGravityDirectionAttr(Gf.Vec3f(0.0, 0.0, -1.0))
    scene.CreateGravityMagnitudeAttr(gravity)
    prim = scene.GetPrim()
    prim.AddAppliedSchema("NewtonSceneAPI")
    rate = prim.CreateAttribute("newton:timeStepsPerSecond", Sdf.ValueTypeNames.Int, False, Sdf.VariabilityUniform)
    rate.Set(1000)
    author_settings(prim, settings)


def add_material(
    stage: Usd.Stage,
    name: str,
    *,
    color: Sequence[float],
    metallic: float = 0.0,
    roughness: float = 0.5,
    coat: float = 0.0,
    density: float | None = None,
    friction: float = 0.0,
) -> UsdShade.Material:
    """Author a material for physics and rendering, ``/World/Materials/NAME``.

    The color is linear RGB; metalness, roughness and clear coat are 0 to 1. Bodies with this material have the density
    [kg/m³]. If ``friction`` is positive, rolling and torsional friction are :data:`CONTACT_PATCH`, else zero.
    """
    UsdGeom.Scope.Define(stage, "/World/Materials")
    material = UsdShade.Material.Define(stage, f"/World/Materials/{name}")
    physics = UsdPhysics.MaterialAPI.Apply(material.GetPrim())
    physics.CreateStaticFrictionAttr(friction)
    physics.CreateDynamicFrictionAttr(friction)
    physics.CreateRestitutionAttr(0.0)
    if density is not None:
        physics.CreateDensityAttr(density)
    material.GetPrim().AddAppliedSchema("NewtonMaterialAPI")
    for attribute_name in ("newton:rollingFriction", "newton:torsionalFriction"):
        attribute = material.GetPrim().CreateAttribute(attribute_name, Sdf.ValueTypeNames.Float, custom=False)
        attribute.Set(CONTACT_PATCH if friction else 0.0)
    author_surface(material, color=color, metallic=metallic, roughness=roughness, coat=coat)
    return material


def add_iron_material(stage: Usd.Stage, *, friction: float = 0.0) -> UsdShade.Material:
    """Author the material of iron balls."""
    return add_material(
        stage, "Iron", color=STEEL_COLOR, metallic=1.0, roughness=0.3, density=IRON_DENSITY, friction=friction
    )


def add_magnet_material(stage: Usd.Stage, *, density: float = 7500.0, friction: float = 0.0) -> UsdShade.Material:
    """Author the material of permanent magnets."""
    return add_material(
        stage, "Magnet", color=MAGNET_COLOR, roughness=0.3, coat=1.0, density=density, friction=friction
    )


def add_gray_ground(stage: Usd.Stage, *, size: float, friction: float = 0.0) -> None:
    """Author the ground and its material."""
    add_ground(stage, add_material(stage, "Ground", color=GROUND_COLOR, roughness=0.8, friction=friction), size=size)


def add_ground(stage: Usd.Stage, material: UsdShade.Material, *, size: float) -> None:
    """Author the plane z = 0: infinite as a collider, drawn as a square of ``size`` [m]."""
    plane = UsdGeom.Plane.Define(stage, "/World/Ground")
    plane.CreateAxisAttr(UsdGeom.Tokens.z)
    plane.CreateWidthAttr(size)
    plane.CreateLengthAttr(size)
    _add_shape_properties(plane, material, GROUND_COLOR, STATIC)


def add_body(stage: Usd.Stage, path: str, position: Sequence[float], *, kinematic: bool = False) -> UsdGeom.Xform:
    """Author a rigid body at ``position`` [m]; its shapes are prims below it."""
    body = UsdGeom.Xform.Define(stage, path)
    _translate(body, position)
    UsdPhysics.RigidBodyAPI.Apply(body.GetPrim()).CreateKinematicEnabledAttr(kinematic)
    return body


def add_ball(
    stage: Usd.Stage,
    path: str,
    position: Sequence[float],
    radius: float,
    material: UsdShade.Material,
    *,
    motion: str = DYNAMIC,
    magnet: Magnet | None = None,
    color: Sequence[float] = STEEL_COLOR,
) -> Usd.Prim:
    """Author a ball: a sphere that is its own collider, centered at ``position`` [m]."""
    ball = UsdGeom.Sphere.Define(stage, path)
    ball.CreateRadiusAttr(radius)
    _translate(ball, position)
    return _add_shape_properties(ball, material, color, motion, magnet)


def add_ball_prims(stage: Usd.Stage, positions, radius: float, material: UsdShade.Material, *, digits=4, **options):
    """Author balls below ``/World/Balls``, named by numbers of ``digits`` digits; see :func:`add_ball`."""
    UsdGeom.Scope.Define(stage, "/World/Balls")
    for number, position in enumerate(positions):
        add_ball(stage, f"/World/Balls/Ball_{number:0{digits}d}", position, radius, material, **options)


def add_balls(
    stage: Usd.Stage,
    path: str,
    positions: np.ndarray,
    radius: float,
    material: UsdShade.Material,
    *,
    magnet: Magnet,
) -> None:
    """Author very many balls as instances of one ball, centered at ``positions`` [m], shape [n, 3]."""
    instancer = UsdGeom.PointInstancer.Define(stage, path)
    ball = f"{path}/Ball"
    add_ball(stage, ball, (0.0, 0.0, 0.0), radius, material, magnet=magnet)
    instancer.CreatePrototypesRel().SetTargets([Sdf.Path(ball)])
    instancer.CreateProtoIndicesAttr(Vt.IntArray.FromNumpy(np.zeros(len(positions), np.int32)))
    instancer.CreatePositionsAttr(Vt.Vec3fArray.FromNumpy(np.ascontiguousarray(positions, np.float32)))
    bounds = np.array([positions.min(axis=0) - radius, positions.max(axis=0) + radius], np.float32)
    instancer.CreateExtentAttr(Vt.Vec3fArray.FromNumpy(bounds))


def scatter(sites: np.ndarray, spacing: float, least: float, random: np.random.Generator) -> np.ndarray:
    """Return sites of a cubic lattice, shape [n, 3], with random offsets that keep the ``least`` distance [m]."""
    return sites + 0.5 * (spacing - least) * random.uniform(-1.0, 1.0, sites.shape)


def add_box(
    stage: Usd.Stage,
    path: str,
    position: Sequence[float],
    sizes: Sequence[float],
    material: UsdShade.Material,
    *,
    motion: str = DYNAMIC,
    magnet: Magnet | None = None,
) -> Usd.Prim:
    """Author a box with edges of ``sizes`` [m] along x, y and z."""
    box = UsdGeom.Cube.Define(stage, path)
    box.CreateSizeAttr(sizes[0])
    _translate(box, position)
    if len(set(sizes)) > 1:
        box.AddScaleOp().Set(Gf.Vec3f(*(size / sizes[0] for size in sizes)))
    return _add_shape_properties(box, material, MAGNET_COLOR, motion, magnet)


def add_capsule(
    stage: Usd.Stage,
    path: str,
    start: Sequence[float],
    end: Sequence[float],
    radius: float,
    material: UsdShade.Material,
    *,
    color: Sequence[float],
) -> None:
    """Author a static capsule whose axis runs from ``start`` to ``end`` [m]."""
    axis = np.subtract(end, start)
    capsule = UsdGeom.Capsule.Define(stage, path)
    capsule.CreateAxisAttr(UsdGeom.Tokens.z)
    capsule.CreateRadiusAttr(radius)
    capsule.CreateHeightAttr(float(np.linalg.norm(axis)))
    _translate(capsule, 0.5 * np.add(start, end))
    rotation = Gf.Rotation(Gf.Vec3d(0.0, 0.0, 1.0), Gf.Vec3d(*axis.tolist()))
    capsule.AddOrientOp().Set(Gf.Quatf(rotation.GetQuat()))
    _add_shape_properties(capsule, material, color, STATIC)


def add_camera(stage: Usd.Stage, eye: Sequence[float], target: Sequence[float], *, field_of_view: float = 35.0) -> None:
    """Author a camera at ``eye`` [m] that looks at ``target`` [m], ``field_of_view`` [degrees] wide, and the lights.

    The film is 36 mm wide; UsdGeom measures film and focal length in tenths of the stage's unit.
    """
    camera = UsdGeom.Camera.Define(stage, "/World/Camera")
    camera.AddTransformOp().Set(_look_at(eye, target))
    film = 10.0 / UsdGeom.GetStageMetersPerUnit(stage) * _FILM
    camera.CreateHorizontalApertureAttr(film)
    camera.CreateVerticalApertureAttr(film * 9.0 / 16.0)
    camera.CreateFocalLengthAttr(0.5 * film / math.tan(math.radians(0.5 * field_of_view)))
    camera.CreateFStopAttr(_F_STOP)
    distance = math.dist(eye, target)
    camera.CreateClippingRangeAttr(Gf.Vec2f(0.01 * distance, 100.0 * distance))
    camera.CreateFocusDistanceAttr(distance)
    _add_lights(stage, target, distance)


def _add_lights(stage: Usd.Stage, target: Sequence[float], distance: float) -> None:
    """Author a sky, and two soft boxes at the camera's ``distance`` [m] from ``target`` [m]."""
    # without normalization intensities are radiances: a white wall that faces the key light has a radiance of about 1
    UsdGeom.Scope.Define(stage, "/World/Lights")
    sky = UsdLux.DomeLight.Define(stage, "/World/Lights/Sky")
    sky.CreateIntensityAttr(0.35)
    sky.CreateColorAttr(Gf.Vec3f(0.86, 0.93, 1.0))
    for name, offset, side, intensity, color in _SOFT_BOXES:
        box = UsdLux.RectLight.Define(stage, f"/World/Lights/{name}")
        box.CreateWidthAttr(side * distance)
        box.CreateHeightAttr(side * distance)
        box.CreateIntensityAttr(intensity)
        box.CreateNormalizeAttr(False)
        box.CreateColorAttr(Gf.Vec3f(*color))
        box.MakeMatrixXform().Set(_look_at(np.add(target, np.multiply(distance, offset)), target))
        box.CreateExtentAttr(UsdGeom.Boundable.ComputeExtentFromPlugins(box, Usd.TimeCode.Default()))


def _look_at(eye: Sequence[float], target: Sequence[float]) -> Gf.Matrix4d:
    """Return the transform whose -z axis points from ``eye`` to ``target``, z up."""
    up = Gf.Vec3d(0.0, 0.0, 1.0)
    return Gf.Matrix4d().SetLookAt(Gf.Vec3d(*map(float, eye)), Gf.Vec3d(*map(float, target)), up).GetInverse()


def run(author: Callable) -> None:
    """Call ``author`` from the command line: ``-o`` is its path, each parameter is an option of the same name.

    Types, defaults and help texts of the options come from its signature and docstring.
    """
    summary = inspect.getdoc(inspect.getmodule(author)).partition("\n")[0]
    texts = dict(re.findall(r"^ {4}(\w+): (.+?)\.?$", inspect.getdoc(author) or "", re.MULTILINE))
    parser = argparse.ArgumentParser(description=summary)
    parser.add_argument("-o", "--output", required=True, help="USD file to write")
    for name, parameter in inspect.signature(author).parameters.items():
        if name != "path":
            option, kind = f"--{name.replace('_', '-')}", parameter.annotation
            text = f"{texts[name]} (default: %(default)s)"
            parser.add_argument(option, type=kind, default=parameter.default, help=text.replace("%)", "%%)"))
    options = vars(parser.parse_args())
    try:
        author(options.pop("output"), **options)
    except InputError as error:
        sys.exit(f"{parser.prog}: {error}")


def check_count(name: str, value: int) -> None:
    """Raise :class:`InputError` for the parameter ``name`` unless ``value`` is positive."""
    if not value > 0:
        raise InputError(f"{name}: must be positive, got {value}")


def _translate(shape, position) -> None:
    shape.AddTranslateOp().Set(Gf.Vec3d(*map(float, position)))


def _add_shape_properties(shape, material, color, motion, magnet=None) -> Usd.Prim:
    """Author collision, extent, material, color, motion and the magnet, if given, of ``shape``; return its prim."""
    prim = shape.GetPrim()
    if motion != STATIC:
        UsdPhysics.RigidBodyAPI.Apply(prim).CreateKinematicEnabledAttr(motion == KINEMATIC)
    shape.CreateExtentAttr(UsdGeom.Boundable.ComputeExtentFromPlugins(shape, Usd.TimeCode.Default()))
    UsdPhysics.CollisionAPI.Apply(prim)
    shape.CreateDisplayColorAttr(Vt.Vec3fArray([Gf.Vec3f(*color)]))
    UsdShade.MaterialBindingAPI.Apply(prim).Bind(material)
    if magnet is not None:
        author_magnet(prim, magnet)
    return prim
