"""Stages of bodies that keys move, as text, for the tests of what follows keys."""

import math

import numpy as np
from pxr import Gf, UsdGeom

MU0 = 4e-7 * math.pi
G = 9.81
RATE = 24.0
HEAD = """#usda 1.0
(
    metersPerUnit = 1
    kilogramsPerUnit = 1
    upAxis = "Z"
    defaultPrim = "World"
    startTimeCode = START
    endTimeCode = 100
    timeCodesPerSecond = 24
    framesPerSecond = 12
)
def Xform "World"
{
def PhysicsScene "Scene" (prepend apiSchemas = ["WarpmagSceneAPI"])
{
    vector3f physics:gravityDirection = (0, 0, -1)
    float physics:gravityMagnitude = GRAVITY
    SCENE
}
def Material "Rough" (prepend apiSchemas = ["PhysicsMaterialAPI"])
{
    float physics:staticFriction = 0.4
    float physics:dynamicFriction = 0.4
    float physics:restitution = 0
}
BODIES
}
"""
MAGNET, BODY, COLLIDER = "WarpmagMagnetAPI", "PhysicsRigidBodyAPI", "PhysicsCollisionAPI"
KINEMATIC = "bool physics:kinematicEnabled = 1"


def prim(kind, name, apis, *lines):
    quoted = ", ".join(f'"{entry}"' for entry in (*apis, "MaterialBindingAPI", "PhysicsMassAPI"))
    inner = "\n".join(("rel material:binding = </World/Rough>", *lines))
    return f'def {kind} "{name}" (prepend apiSchemas = [{quoted}])\n{{\n{inner}\n}}\n'


def operations(**given):
    """Transforms in the order given, each a value or samples, or others in the words of USD for ``order``.

    Names have double underscores for colons.
    """
    types = {"translate": "double3", "scale": "float3", "orient": "quatd", "transform": "matrix4d", "rotate": "double3"}
    lines, order = [], []
    for name, value in given.items():
        if name.startswith("order"):
            order.append(f'"{value}"')
            continue
        name = f"xformOp:{name.replace('__', ':')}"
        kind = name.split(":")[1]
        kind = "double" if kind in ("translateX", "rotateZ", "scaleY") else types[kind.rstrip("XYZ")]
        samples = ".timeSamples" if isinstance(value, dict) else ""
        lines.append(f"{kind} {name}{samples} = {text(value)}")
        order.append(f'"{name}"')
    lines.append(f"uniform token[] xformOpOrder = [{', '.join(order)}]")
    return "\n".join(lines)


def text(value):
    if isinstance(value, dict):
        return "{ " + ", ".join(f"{time:.17g}: {entry}" for time, entry in value.items()) + " }"
    return str(value)


def write(folder, *bodies, scene="", gravity=0.0, start=0, name="scene.usda"):
    path = folder / name
    result = HEAD.replace("START", str(start)).replace("GRAVITY", str(gravity)).replace("SCENE", scene)
    path.write_text(result.replace("BODIES", "\n".join(bodies)))
    return path


def body_of(simulation, name):
    return simulation._scene.bodies[f"/World/{name}"]


def pose_of(stage, path, time):
    """Position, and orientation x y z w, that USD composes."""
    frame = Gf.Transform(UsdGeom.XformCache(time).GetLocalToWorldTransform(stage.GetPrimAtPath(path)))
    turn = frame.GetRotation().GetQuat()
    return np.array(frame.GetTranslation()), np.array([*turn.GetImaginary(), turn.GetReal()])


def held_ball(distance):
    return prim("Sphere", "Ball", (BODY, COLLIDER, MAGNET), "double radius = 0.005", "float physics:density = 7874",
                operations(translate=(distance, 0, 0)))  # fmt: skip


def cube_on_arm(**arm):
    """A magnet of 2 cm, 5 cm from the axis of what turns it."""
    own = operations(translate=(0.05, 0, 0))
    lines = ("double size = 0.02", KINEMATIC, 'uniform token warpmag:kind = "permanent"')
    field = "vector3f warpmag:magnetization = (1e6, 0, 0)"
    cube = prim("Cube", "Magnet", (BODY, COLLIDER, MAGNET), *lines, field, own)
    return f'def Xform "Arm"\n{{\n{operations(**arm)}\n{cube}\n}}'
