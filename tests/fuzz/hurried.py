"""Stages of a hurried author: keyed bodies, meshes that bound no volume, point instancers and joints with odd numbers.

Every fault takes a layer, the prims of the seed and a source of chance, changes the layer, and returns what it did.
"""

import math
from collections.abc import Callable

from pxr import Gf, Sdf, Vt

from .authoring import declare, define

DISTANCES = (1e-12, 1e-4, 0.01, 1.0, 1e3, 1e6, 1e12, 1e30)
"""Lengths of keyed motions [m], in the units of the stage."""
ANGLES = (1e-6, 1.0, 179.9, 180.0, 360.0, 7.2e4, 1e9, 1e12, 1e30)
"""Angles of keyed motions [deg]."""
TIMES = ((0, 1), (0, 1, 2, 3), (0, 1e-9), (0, 0.5, 0.5000001), (-1e9, 1e9), (-1, 0), (5, 6), (0, 1e300))
"""Time codes of keys."""
LIMITS = (0.0, -1.0, 1.0, 1e-30, 1e9, 1e30, math.inf, -math.inf, math.nan, 90.0, -360.0)
"""Limits, stiffnesses and forces of joints, in their units."""
MAGNET = ("PhysicsRigidBodyAPI", "PhysicsCollisionAPI", "WarpmagMagnetAPI")
BOX = (
    (0, 1, 3, 2), (4, 6, 7, 5), (0, 4, 5, 1), (2, 3, 7, 6), (0, 2, 6, 4), (1, 5, 7, 3)
)  # fmt: skip
"""Faces of a box whose corner k is at the bits of k along x, y and z; normals point outward."""


def motion(layer, prims, chance) -> str:
    """Drive a body by keys: far, fast, around many times, by quaternions of other signs, or at almost equal times."""
    prim = _body(layer, prims, chance)
    declare(prim, "physics:kinematicEnabled", "bool").default = chance.random() < 0.9
    times, kind = chance.choice(TIMES), chance.choice(("translate", "rotateZ", "rotateXYZ", "orient", "scale"))
    size = chance.choice(ANGLES if kind.startswith("rotate") else DISTANCES)
    name = f"xformOp:{kind}"
    types = {"translate": "double3", "rotateZ": "float", "rotateXYZ": "float3", "orient": "quatf", "scale": "float3"}
    attribute = declare(prim, name, types[kind])
    for number, time in enumerate(times):
        layer.SetTimeSample(attribute.path, float(time), _key(kind, size, number))
    given = prim.attributes["xformOpOrder"].default if "xformOpOrder" in prim.attributes else None
    order = list(given) if isinstance(given, Vt.TokenArray) else []
    if name not in order:
        declare(prim, "xformOpOrder", "token[]").default = Vt.TokenArray([*order, name])
    return f"{prim.path} keyed at {times}, {kind} by {size:g}"


def _key(kind, size, number):
    """Return the value of a key: alternately at two ends, and further around at each for rotations."""
    if kind == "rotateZ":
        return min(size * number, 3e38)
    if kind == "orient":
        return (Gf.Quatf(1.0, 0.0, 0.0, 0.0), Gf.Quatf(-1.0, 0.0, 0.0, size % 1.0), Gf.Quatf(0.0))[number % 3]
    if kind == "scale":
        return Gf.Vec3f(1.0 + (number % 2) * size)
    vector = (0.0, size * (number % 2), -size * number)
    return Gf.Vec3d(*vector) if kind == "translate" else Gf.Vec3f(*vector)


def solid(layer, prims, chance) -> str:
    """Add a magnet whose mesh bounds no volume, or one that is inside out, doubled, open, flat, torn or far away."""
    fault = chance.choice(sorted(SOLIDS))
    points, faces = SOLIDS[fault](chance)
    side = chance.choice((0.02, 0.02, 0.02, 1e-4, 1.0))
    prim = define(layer, f"/Solid{chance.randrange(1000)}", "Mesh")
    prim.SetInfo("apiSchemas", Sdf.TokenListOp.CreateExplicit([*MAGNET, "PhysicsMeshCollisionAPI"]))
    approximations = ("none", "convexHull", "convexDecomposition", "boundingCube", "sdf", "meshSimplification")
    values = {
        "points": ("point3f[]", Vt.Vec3fArray([Gf.Vec3f(*(side * x for x in point)) for point in points])),
        "faceVertexCounts": ("int[]", Vt.IntArray([len(face) for face in faces])),
        "faceVertexIndices": ("int[]", Vt.IntArray([index for face in faces for index in face])),
        "physics:approximation": ("token", chance.choice(approximations)),
        "orientation": ("token", chance.choice(("rightHanded", "rightHanded", "leftHanded"))),
        "subdivisionScheme": ("token", chance.choice(("none", "catmullClark"))),
        "xformOp:translate": ("double3", Gf.Vec3d(0.0, 0.3, 0.3)),
        "xformOpOrder": ("token[]", Vt.TokenArray(["xformOp:translate"])),
        "warpmag:material": ("token", chance.choice(("iron", "iron", "N42"))),
    }
    for name, (kind, value) in values.items():
        declare(prim, name, kind).default = value
    return f"{prim.path} {fault}, side {side}, {values['physics:approximation'][1]}"


def _box(shift=(0.0, 0.0, 0.0), height=1.0):
    return [(shift[0] + (k & 1), shift[1] + (k >> 1 & 1), shift[2] + height * (k >> 2)) for k in range(8)]


def _two_boxes(shift):
    return [*_box(), *_box(shift)], [*BOX, *(tuple(8 + index for index in face) for face in BOX)]


def _star(_):
    corners = [((0.2 + k % 2) * math.cos(k / 20.0), (0.2 + k % 2) * math.sin(k / 20.0)) for k in range(120)]
    sides = [(k, (k + 1) % 120, 120 + (k + 1) % 120, 120 + k) for k in range(120)]
    points = [(x, y, z) for z in (0.0, 0.3) for x, y in corners]
    return points, [tuple(range(119, -1, -1)), tuple(range(120, 240)), *sides]


def _soup(chance):
    points = [[chance.random() for _ in range(3)] for _ in range(60)]
    return points, [chance.sample(range(60), 3) for _ in range(200)]


def _strip(_):
    """Return a Möbius strip, which has one side."""
    points = []
    for k in range(24):
        turn, half = k * math.pi / 12.0, k * math.pi / 24.0
        for side in (-0.3, 0.3):
            radius = 1.0 + side * math.cos(half)
            points.append((radius * math.cos(turn), radius * math.sin(turn), side * math.sin(half)))
    faces = [(2 * k, 2 * k + 1, 2 * k + 3, 2 * k + 2) for k in range(23)]
    return points, [*faces, (46, 47, 0, 1)]


SOLIDS: dict[str, Callable] = {
    "inside out": lambda _: (_box(), [face[::-1] for face in BOX]),
    "half inside out": lambda _: (_box(), [*BOX[:3], *(face[::-1] for face in BOX[3:])]),
    "open": lambda chance: (_box(), BOX[: chance.choice((1, 3, 5))]),
    "flat": lambda chance: (_box(height=chance.choice((0.0, 1e-9, 1e-6, 1e-3))), BOX),
    "doubled": lambda _: _two_boxes((0.0, 0.0, 0.0)),
    "two that intersect": lambda chance: _two_boxes((0.5, chance.choice((0.0, 0.5)), chance.choice((0.0, 1e-7, 0.5)))),
    "two at an edge": lambda _: _two_boxes((1.0, 1.0, 0.0)),
    "two far apart": lambda chance: _two_boxes((chance.choice((20.0, 1e4)), 0.0, 0.0)),
    "far from its origin": lambda chance: (_box((chance.choice((10.0, 1e3, 1e9)), 0.0, 0.0)), BOX),
    "a star": _star,
    "a soup": _soup,
    "a strip": _strip,
    "a sliver": lambda chance: ([*_box(), (0.5, 0.0, chance.choice((1e-9, 0.0)))], [*BOX, (0, 8, 1)]),
    "a face of a point": lambda _: (_box(), [*BOX, (0, 0, 0), (1, 1, 2)]),
    "empty": lambda _: ([], []),
}
"""Points and faces of meshes by their faults."""


def swarm(layer, prims, chance) -> str:
    """Add a point instancer of a prim with one odd array: too short, far, not finite, or of unknown prototypes."""
    prim = define(layer, f"/Swarm{chance.randrange(1000)}", "PointInstancer")
    count, source = chance.choice((1, 3, 12)), chance.choice(prims)
    targets = [source] if chance.random() < 0.9 else [source, "/Nowhere", prim.path]
    Sdf.RelationshipSpec(prim, "prototypes", custom=False).targetPathList.explicitItems = targets
    spread = chance.choice((0.05, 0.05, 0.0, 1e-4, 1e7))
    values = {
        "protoIndices": ("int[]", Vt.IntArray(count)),
        "positions": ("point3f[]", Vt.Vec3fArray([Gf.Vec3f(spread * k, 0.5, 0.5) for k in range(count)])),
        "orientations": ("quath[]", Vt.QuathArray([Gf.Quath(1.0, 0.0, 0.0, 0.0)] * count)),
        "scales": ("float3[]", Vt.Vec3fArray([Gf.Vec3f(1.0)] * count)),
        "ids": ("int64[]", Vt.Int64Array(range(count))),
    }
    odd = chance.choice(("nothing", *values, "invisibleIds", "velocities"))
    values |= {name: ODD_ARRAYS[name](count, chance) for name in ODD_ARRAYS if name == odd}
    for name, (kind, value) in values.items():
        declare(prim, name, kind).default = value
    if chance.random() < 0.2:
        prim.SetInfo("inactiveIds", Sdf.Int64ListOp.CreateExplicit([0, 5, -1]))
    return f"{prim.path} of {count} {source}, spread {spread}, odd {odd}"


ODD_ARRAYS: dict[str, Callable] = {
    "protoIndices": lambda count, chance: ("int[]", Vt.IntArray([chance.choice((-1, 1, 7, 2**31 - 1))] * count)),
    "positions": lambda count, chance: (
        "point3f[]",
        Vt.Vec3fArray([Gf.Vec3f(chance.choice((math.nan, 1e30, math.inf)))] * chance.choice((0, count, count + 1))),
    ),
    "orientations": lambda count, chance: (
        "quath[]",
        Vt.QuathArray([Gf.Quath(chance.choice((0.0, math.nan, 1e4)), 0.0, 0.0, 0.0)] * chance.choice((1, count))),
    ),
    "scales": lambda count, chance: (
        "float3[]",
        Vt.Vec3fArray([Gf.Vec3f(chance.choice((0.0, -1.0, 1e-6, 1e4, math.nan)), 1.0, 1.0)] * count),
    ),
    "ids": lambda count, chance: ("int64[]", Vt.Int64Array([chance.choice((0, -1, 2**62))] * count)),
    "invisibleIds": lambda count, chance: ("int64[]", Vt.Int64Array([0, 0, chance.choice((-5, 2**62))])),
    "velocities": lambda count, chance: ("vector3f[]", Vt.Vec3fArray([Gf.Vec3f(chance.choice((1e30, 1.0)))] * count)),
}
"""Arrays of point instancers, by name."""


def linkage(layer, prims, chance) -> str:
    """Join bodies to each other, to themselves or in a circle, with odd limits, drives and frames."""
    bodies = [_body(layer, prims, chance).path for _ in range(chance.choice((1, 2, 2, 3)))]
    kinds = "Fixed", "Revolute", "Revolute", "Prismatic", "Spherical", "Distance", ""
    kind, numbers = f"Physics{chance.choice(kinds)}Joint", []
    for number, body in enumerate(bodies):
        prim = define(layer, f"/Linkage{chance.randrange(1000)}", kind)
        pair = {"physics:body0": body, "physics:body1": bodies[(number + 1) % len(bodies)]}
        for name, target in pair.items():
            if name not in prim.properties and chance.random() < 0.95:
                Sdf.RelationshipSpec(prim, name, custom=False).targetPathList.explicitItems = [target]
        drive = chance.choice(("angular", "linear", "transX", "rotZ"))
        prim.SetInfo("apiSchemas", Sdf.TokenListOp.CreateExplicit([f"PhysicsDriveAPI:{drive}"]))
        driven = ("stiffness", "damping", "maxForce", "targetPosition", "targetVelocity")
        names = ["physics:lowerLimit", "physics:upperLimit", "physics:breakForce", "physics:breakTorque"]
        names += [f"drive:{drive}:physics:{name}" for name in driven]
        for name in chance.sample(names, chance.choice((1, 2, 4))):
            numbers.append(value := chance.choice(LIMITS))
            declare(prim, name, "float").default = value
        if chance.random() < 0.3:
            declare(prim, "physics:localRot0", "quatf").default = Gf.Quatf(
                chance.choice((0.0, 1e20, 1.0)), 0.0, 0.0, 0.0
            )
        if chance.random() < 0.3:
            far = chance.choice((1e-9, 1.0, 1e7, 1e30))
            declare(prim, "physics:localPos1", "point3f").default = Gf.Vec3f(0.0, far, 0.0)
    return f"{kind}s of {[str(body) for body in bodies]}, {numbers}"


HURRIED: tuple[Callable, ...] = (motion, motion, solid, solid, swarm, linkage)


def _body(layer, prims, chance) -> Sdf.PrimSpec:
    """Return one of the rigid bodies, or any prim where there are none."""
    bodies = [path for path in prims if "PhysicsRigidBodyAPI" in _schemas(layer.GetPrimAtPath(path))]
    return layer.GetPrimAtPath(chance.choice(bodies or prims))


def _schemas(prim) -> list[str]:
    return prim.GetInfo("apiSchemas").GetAppliedItems() if prim.HasInfo("apiSchemas") else []
