"""Spoils USD stages at random: up to three faults in each, by a seed that repeats."""

import math
import random
from collections.abc import Callable
from pathlib import Path

from pxr import Gf, Sdf, Tf, Vt

import warpmag.usd  # noqa: F401  (registers the schemas before a stage is opened)

from .hostile import HOSTILE
from .hurried import HURRIED
from .strangers import STRANGERS

_MANY = 500

NUMBERS = (
    0.0,
    -1.0,
    math.nan,
    math.inf,
    -math.inf,
    1e300,
    -1e300,
    5e-324,
    1e39,
    1e38,
    1e28,
    1e-30,
    1e9,
    -0.0,
    1e5,
    0.5,
)
TYPES = (
    "float",
    "double",
    "string",
    "int",
    "bool",
    "float[]",
    "double3",
    "token",
    "token[]",
    "quatf",
    "matrix4d",
    "asset",
)
WORDS = (
    *("", "none", "Z", "x", "tanh", "../..", "convexHull", "Ü" * 300, "1e3"),
    *("zeeman", "theta-euler", "llg", "multipole"),
)
METADATA = (
    "metersPerUnit",
    "kilogramsPerUnit",
    "startTimeCode",
    "endTimeCode",
    "timeCodesPerSecond",
    "framesPerSecond",
)
AUTHORED = {
    "physics:mass": "float",
    "physics:density": "float",
    "physics:centerOfMass": "point3f",
    "physics:diagonalInertia": "float3",
    "physics:principalAxes": "quatf",
    "physics:velocity": "vector3f",
    "physics:angularVelocity": "vector3f",
    "physics:staticFriction": "float",
    "physics:dynamicFriction": "float",
    "physics:restitution": "float",
    "physics:kinematicEnabled": "bool",
    "physics:rigidBodyEnabled": "bool",
    "physics:collisionEnabled": "bool",
    "physics:approximation": "token",
    "physics:gravityMagnitude": "float",
    "physics:gravityDirection": "vector3f",
    "newton:contactMargin": "float",
    "newton:contactGap": "float",
    "newton:torsionalFriction": "float",
    "newton:rollingFriction": "float",
    "newton:timeStepsPerSecond": "int",
    "newton:inertia": "float[]",
    "radius": "double",
    "height": "double",
    "size": "double",
    "axis": "token",
    "warpmag:kind": "token",
    "warpmag:saturationMagnetization": "float",
    "warpmag:susceptibility": "float",
    "warpmag:magnetization": "vector3f",
    "warpmag:momentSpacing": "float",
    "warpmag:conductivity": "float",
    "warpmag:moment": "vector3f",
    "warpmag:externalField": "vector3f",
    "warpmag:rtol": "float",
    "warpmag:force": "token",
    "warpmag:dynamics": "token",
    "warpmag:contactModel": "token",
    "warpmag:curve": "token",
    "warpmag:material": "token",
    "warpmag:recoilPermeability": "float",
    "warpmag:curve:h": "double[]",
    "warpmag:curve:b": "double[]",
    "warpmag:coil:shape": "token",
    "warpmag:coil:radius": "float",
    "warpmag:coil:length": "float",
    "warpmag:coil:points": "point3f[]",
    "warpmag:coil:closed": "bool",
    "warpmag:coil:wireRadius": "float",
    "warpmag:coil:ampereTurns": "float",
    "warpmag:coil:resistance": "float",
    "warpmag:coil:voltage": "float",
    "warpmag:coil:turns": "float",
    "warpmag:coil:inductance": "float",
    "warpmag:coil:current": "double",
    "warpmag:fieldMap:origin": "point3f",
    "warpmag:fieldMap:spacing": "vector3f",
    "warpmag:fieldMap:counts": "int3",
    "warpmag:fieldMap:values": "vector3f[]",
    "warpmag:fieldMap:factor": "float",
}
SCHEMAS = (
    *("PhysicsRigidBodyAPI", "PhysicsCollisionAPI", "PhysicsMassAPI", "PhysicsMaterialAPI", "WarpmagMagnetAPI"),
    *("PhysicsArticulationRootAPI", "WarpmagSceneAPI", "NewtonCollisionAPI", "PhysicsMeshCollisionAPI"),
    *("WarpmagCoilAPI", "WarpmagFieldMapAPI"),
)
KINDS = ("Sphere", "Cube", "Capsule", "Cylinder", "Cone", "Plane", "Mesh", "Xform", "Scope", "PointInstancer")
JOINTS = ("PhysicsFixedJoint", "PhysicsRevoluteJoint", "PhysicsPrismaticJoint", "PhysicsSphericalJoint", "PhysicsJoint")


def mutate(scene: Path, target: Path, seed: int, fewest: int = 1) -> tuple[str, Sdf.Layer]:
    """Write a copy of ``scene`` with ``fewest`` to three faults to ``target``.

    Returns:
        What was done, and the layer: USD itself cannot read all texts that it writes.
    """
    chance = random.Random(seed)
    layer = Sdf.Layer.CreateNew(str(target))
    layer.TransferContent(Sdf.Layer.FindOrOpen(str(scene)))
    done = []
    for _ in range(chance.randint(fewest, 3)):
        fault = chance.choice(chance.choice((FAULTS, STRANGERS, HOSTILE, HURRIED)))
        try:
            done.append(fault(layer, _prims(layer), chance))
        except Tf.ErrorException:  # USD does not let a layer hold it
            done.append(f"no {fault.__name__}")
    layer.Save()
    return "; ".join(done), layer


def authored_value(layer, prims, chance) -> str:
    """Give an attribute that is there another value of its type."""
    attribute = _some_attribute(layer, prims, chance)
    if attribute is None:
        return "nothing"
    return _set(attribute, _value(str(attribute.typeName), chance))


def other_type(layer, prims, chance) -> str:
    """Give an attribute another type."""
    attribute = _some_attribute(layer, prims, chance)
    if attribute is None:
        return "nothing"
    prim, name = layer.GetPrimAtPath(attribute.path.GetPrimPath()), attribute.name
    prim.RemoveProperty(attribute)
    kind = chance.choice(TYPES)
    return _set(_attribute(prim, name, kind), _value(kind, chance))


def new_attribute(layer, prims, chance) -> str:
    """Author an attribute that Newton or warpmag reads, where it belongs or not."""
    prim = layer.GetPrimAtPath(chance.choice(prims))
    name = chance.choice(sorted(AUTHORED))
    return _set(_attribute(prim, name, AUTHORED[name]), _value(AUTHORED[name], chance))


def time_samples(layer, prims, chance) -> str:
    """Animate an attribute, from one odd value to another."""
    attribute = _some_attribute(layer, prims, chance)
    if attribute is None:
        return "nothing"
    for time in (0.0, 1.0, 50.0):
        value = _value(str(attribute.typeName), chance)
        try:
            layer.SetTimeSample(attribute.path, time, value)
        except (TypeError, Tf.ErrorException):
            continue
    return f"samples of {attribute.path}"


def metadata(layer, prims, chance) -> str:
    """Change units and times."""
    key = chance.choice(METADATA)
    sound = 0.01 if key.endswith("Unit") else 10.0  # a frame of 100 s would run for hours, and rightly
    value = chance.choice((*NUMBERS, 1.0, sound))
    layer.pseudoRoot.SetInfo(key, value)
    return f"{key} = {value}"


def transform(layer, prims, chance) -> str:
    """Give a prim other operations: ones that do not exist, of odd types, twice, inverted."""
    prim = layer.GetPrimAtPath(chance.choice(prims))
    order = []
    for kind in chance.sample(("translate", "scale", "orient", "rotateXYZ", "transform", "rotateX", "nothing"), 3):
        name = f"xformOp:{kind}"
        if chance.random() < 0.8:
            usual = {"orient": "quatf", "transform": "matrix4d", "rotateX": "float"}.get(kind, "double3")
            usual = chance.choice(TYPES) if chance.random() < 0.2 else usual
            _set(_attribute(prim, name, usual), _value(usual, chance))
        order += [chance.choice(("", "", "!invert!")) + name]
    order += chance.choice(([], ["!resetXformStack!"], order[:1]))
    _set(_attribute(prim, "xformOpOrder", "token[]"), Vt.TokenArray(order))
    return f"{prim.path} transformed by {order}"


def mesh(layer, prims, chance) -> str:
    """Make a mesh of a prim, or spoil the topology of one."""
    prim = layer.GetPrimAtPath(chance.choice(prims))
    prim.typeName = "Mesh"
    points = [(0, 0, 0), (1e-2, 0, 0), (0, 1e-2, 0), (0, 0, 1e-2)]
    faces = [0, 2, 1, 0, 1, 3, 0, 3, 2, 1, 2, 3]
    counts = [3, 3, 3, 3]
    fault = chance.randrange(8)
    if fault < 2:
        faces[chance.randrange(12)] = chance.choice((20, -1, 4, 2**31 - 1, -(2**31)))
    elif fault < 4:
        counts[chance.randrange(4)] = chance.choice((0, 1, 2, 4, -3, 2**31 - 1))
    elif fault == 4:
        points[chance.randrange(4)] = (chance.choice(NUMBERS), 0.0, 0.0)
    elif fault == 5:
        points, faces, counts = points[:2], faces[:6], counts[:2]
    elif fault == 6:
        faces, counts = faces[:9], counts[:3]
    _set(_attribute(prim, "points", "point3f[]"), Vt.Vec3fArray([Gf.Vec3f(*_single(point)) for point in points]))
    _set(_attribute(prim, "faceVertexIndices", "int[]"), Vt.IntArray(faces))
    _set(_attribute(prim, "faceVertexCounts", "int[]"), Vt.IntArray(counts))
    return f"{prim.path} a mesh, fault {fault}"


def schema(layer, prims, chance) -> str:
    """Apply a schema to any prim."""
    prim = layer.GetPrimAtPath(chance.choice(prims))
    name = chance.choice(SCHEMAS)
    before = prim.GetInfo("apiSchemas") if prim.HasInfo("apiSchemas") else Sdf.TokenListOp()
    kept = [item for item in before.GetAppliedItems() if chance.random() < 0.9]
    prim.SetInfo("apiSchemas", Sdf.TokenListOp.CreateExplicit([*dict.fromkeys((*kept, name))]))
    return f"{name} on {prim.path}"


def kind(layer, prims, chance) -> str:
    """Make a prim of another type, or switch it off."""
    prim = layer.GetPrimAtPath(chance.choice(prims))
    if chance.random() < 0.2:
        prim.active = False
    else:
        prim.typeName = chance.choice(KINDS)
    return f"{prim.path} a {prim.typeName}"


def joint(layer, prims, chance) -> str:
    """Join two prims."""
    prim = Sdf.CreatePrimInLayer(layer, f"/Joint{chance.randrange(1000)}")
    prim.specifier, prim.typeName = Sdf.SpecifierDef, chance.choice(JOINTS)
    for name in ("physics:body0", "physics:body1"):
        if chance.random() < 0.9:
            Sdf.RelationshipSpec(prim, name, custom=False).targetPathList.explicitItems = [chance.choice(prims)]
    for name, usual in (("physics:localPos0", "point3f"), ("physics:localRot0", "quatf"), ("physics:axis", "token")):
        if chance.random() < 0.3:
            _set(_attribute(prim, name, usual), _value(usual, chance))
    return f"{prim.typeName} {prim.path}"


def instance(layer, prims, chance) -> str:
    """Put an instance of a prim beside it, of which something may be animated."""
    source = chance.choice(prims)
    prim = Sdf.CreatePrimInLayer(layer, f"/Instance{chance.randrange(1000)}")
    prim.specifier, prim.typeName, prim.instanceable = Sdf.SpecifierDef, "Xform", True
    prim.referenceList.prependedItems = [Sdf.Reference("", source)]
    return f"{prim.path} an instance of {source}"


FAULTS: tuple[Callable, ...] = (
    *(authored_value, authored_value, authored_value, other_type, new_attribute, new_attribute),
    *(time_samples, metadata, transform, mesh, schema, kind, joint, instance),
)


def _prims(layer) -> list[Sdf.Path]:
    """Return some hundred prims, the first ones where there are more; those with schemas several times."""
    paths, left = [], list(layer.rootPrims)
    while left and len(paths) < _MANY:
        prim = left.pop(0)
        physical = prim.HasInfo("apiSchemas") or prim.typeName.startswith("Physics")
        paths += [prim.path] * (6 if physical else 1)
        left[:0] = list(prim.nameChildren)[:_MANY]
    return sorted(paths) or [Sdf.CreatePrimInLayer(layer, "/Empty").path]


def _some_attribute(layer, prims, chance):
    for _ in range(20):
        attributes = list(layer.GetPrimAtPath(chance.choice(prims)).attributes)
        if attributes:
            return chance.choice(attributes)
    return None


def _attribute(prim, name, kind):
    if name in prim.attributes:
        prim.RemoveProperty(prim.attributes[name])
    return Sdf.AttributeSpec(prim, name, Sdf.ValueTypeNames.Find(kind), declaresCustom=False)


def _set(attribute, value) -> str:
    attribute.default = value
    shown = " ".join(str(value).split())
    return f"{attribute.path} = {attribute.typeName} {shown[:60]}"


def _value(kind, chance):
    """Return an odd value of a type."""
    example = Sdf.ValueTypeNames.Find(kind).defaultValue
    if isinstance(example, bool):
        return chance.random() < 0.5
    if isinstance(example, str):
        return chance.choice(WORDS)
    if isinstance(example, int):
        return chance.choice((0, -1, 1, 2**31 - 1, -(2**31), 20)) if kind != "uchar" else 1
    if isinstance(example, float):
        return _single([chance.choice(NUMBERS)])[0] if kind in ("float", "half") else chance.choice(NUMBERS)
    if isinstance(example, Sdf.AssetPath):
        return Sdf.AssetPath("./nothing.png")
    if kind.endswith("[]"):
        single = kind.removesuffix("[]")
        return type(example)([_value(single, chance) for _ in range(chance.choice((0, 1, 3, 6)))])
    return _filled(example, chance)


def _filled(example, chance):
    """Return a vector, quaternion or matrix with one odd number, or all of them."""
    odd = _single([chance.choice(NUMBERS)])[0]
    if isinstance(example, (Gf.Quatf, Gf.Quatd, Gf.Quath)):
        return type(example)(odd, 0.0, chance.choice((0.0, odd)), 0.0)
    if isinstance(example, Gf.Matrix4d):
        value = Gf.Matrix4d(1.0)
        value[chance.randrange(4), chance.randrange(4)] = odd
        return value
    if isinstance(example, Gf.Vec3i):
        return Gf.Vec3i(*(_value("int", chance) for _ in range(3)))
    try:
        value = type(example)(*(chance.choice((0.0, 1.0, odd)) for _ in range(len(example))))
    except (TypeError, OverflowError, ValueError):
        return example
    return value


def _single(values) -> list[float]:
    """Return numbers that single precision takes, the rest as infinities."""
    largest = 3.4e38
    return [math.copysign(math.inf, value) if abs(value) > largest else value for value in values]
