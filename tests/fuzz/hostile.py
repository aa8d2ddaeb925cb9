"""Stages of a hostile author: addresses behind connections, devices, endless lists, slender bodies, odd circuits.

Every fault takes a layer that lies in a folder, the prims of the seed and a source of chance, changes the layer, may
write files beside it, and returns what it did.
"""

import math
import os
from collections.abc import Callable
from pathlib import Path

from pxr import Gf, Sdf, Vt

from .authoring import declare, define

TEXTURES = (
    *("http://127.0.0.1:9/x.png", "HTTPS://127.0.0.1:9/x.png", "file:///dev/zero", "ftp:/x", " http://127.0.0.1:9/"),
    *("/dev/stdin", "/dev/zero", "/proc/self/mem", "./pipe.png", "./link.png", "./", "", "nothing.png", "<UDIM>.png"),
    *("`${X}`", "a.usdz[b.png]", "@" * 50, "x" * 5000),
)
KINDS = (*("asset", "string", "token") * 4, "asset[]", "string[]", "int", "color3f")
TIMES = (0.0, 1.0, 10.0, -1.0, 1e9, 1e12, 1e300, math.inf, math.nan, 1e-9)
RATIOS = (1e-6, 1e-4, 1e-3, 1e-2, 0.1, 10.0, 100.0, 1e3, 1e4, 1e6)
DISTANCES = (0.02, 0.1, 0.15, 0.5, 10.0, 1e5)
"""Distances of plates [m]: those of 60 mm act by few moments from about 0.1 m on."""
THICKNESSES = (0.02, 0.003, 0.001, 0.0003, 0.0001)
"""Thicknesses of plates and sheets [m]."""
SIZES = (0.0, -1.0, 1e-30, 1e-12, 1e-3, 1.0, 1e12, 1e30, math.inf, math.nan)
"""Numbers of circuits in their units."""
SCHEMAS = (
    *("CollectionAPI:c", "PhysicsLimitAPI:", "PhysicsDriveAPI:rot", "OddAPI", "PhysicsMassAPI", "WarpmagMagnetAPI:"),
    *("MaterialBindingAPI", "SemanticsAPI:x", "NewtonArticulationRootAPI", "CoordSysAPI:x", "WarpmagCoilAPI", "x:y:z"),
)


def texture(layer, prims, chance) -> str:
    """Bind a material whose texture is an address, a device or nonsense, behind connections."""
    prim, number = layer.GetPrimAtPath(chance.choice(prims)), chance.randrange(1000)
    material = define(layer, f"/Looks{number}", "Material")
    surface, picture = (define(layer, f"/Looks{number}/{name}", "Shader") for name in ("Surface", "Picture"))
    declare(surface, "info:id", "token").default = "UsdPreviewSurface"
    declare(picture, "info:id", "token").default = chance.choice(("UsdUVTexture",) * 7 + ("ND_image_color3",))
    declare(picture, "inputs:sourceColorSpace", "token").default = chance.choice(("raw", "raw", "sRGB"))
    name, kind = chance.choice(TEXTURES), chance.choice(KINDS)
    folder = Path(layer.realPath).parent
    if not os.path.lexists(folder / "pipe.png"):
        os.mkfifo(folder / "pipe.png")
        os.symlink("/dev/zero", folder / "link.png")
    links = _chain(layer, picture, f"/Looks{number}", kind, chance)
    _give(layer, links[-1], kind, name, chance)
    color = chance.choice(("diffuseColor",) * 8 + ("emissiveColor", "roughness"))
    connected = declare(surface, f"inputs:{color}", "color3f")
    connected.connectionPathList.explicitItems = [picture.path.AppendProperty("outputs:rgb")]
    declare(picture, "outputs:rgb", "float3")
    declare(surface, "outputs:surface", "token")
    output = declare(material, "outputs:surface", "token")
    output.connectionPathList.explicitItems = [surface.path.AppendProperty("outputs:surface")]
    binding = chance.choice(("material:binding", "material:binding", "material:binding:preview"))
    if chance.random() < 0.8:
        _make_mesh(prim)
    if binding in prim.properties:
        prim.RemoveProperty(prim.properties[binding])
    Sdf.RelationshipSpec(prim, binding, custom=False).targetPathList.explicitItems = [material.path]
    return f"{prim.path} with a texture {name[:40]!r} of {kind} behind {len(links) - 1} connections"


def _make_mesh(prim) -> None:
    """Make a prim a tetrahedron with the coordinates of a texture, which Newton then opens."""
    prim.typeName = "Mesh"
    points, corners = Gf.Matrix3f(0.01), [0, 2, 1, 0, 1, 3, 0, 3, 2, 1, 2, 3]
    values = {
        "warpmag:momentSpacing": ("float", 0.005),  # ten magnets of 700 cells take minutes for a frame, and rightly
        "points": ("point3f[]", Vt.Vec3fArray([Gf.Vec3f(0.0), *(points.GetRow(k) for k in range(3))])),
        "faceVertexIndices": ("int[]", Vt.IntArray(corners)),
        "faceVertexCounts": ("int[]", Vt.IntArray([3] * 4)),
        "primvars:st": ("texCoord2f[]", Vt.Vec2fArray([Gf.Vec2f(0.1 * k, 0.5) for k in range(12)])),
    }
    for name, (kind, value) in values.items():
        declare(prim, name, kind).default = value
    prim.attributes["primvars:st"].SetInfo("interpolation", "faceVarying")
    before = prim.GetInfo("apiSchemas").GetAppliedItems() if prim.HasInfo("apiSchemas") else []
    schemas = dict.fromkeys((*before, "PhysicsCollisionAPI", "MaterialBindingAPI"))
    prim.SetInfo("apiSchemas", Sdf.TokenListOp.CreateExplicit([*schemas]))


def _chain(layer, picture, looks, kind, chance):
    """Return ``inputs:file`` of a shader and attributes that it is connected to, one behind the other."""
    links = [declare(picture, "inputs:file", kind)]
    for depth in range(chance.choice((0, 0, 1, 2, 3, 40))):
        prim = define(layer, f"{looks}/Values{depth}", chance.choice(("NodeGraph", "Shader", "Material", "", "Xform")))
        links.append(declare(prim, chance.choice(("outputs:", "inputs:") * 4 + ("",)) + f"chosen{depth}", kind))
        links[-2].connectionPathList.explicitItems = [links[-1].path]
    if chance.random() < 0.1:  # a circle
        links[-1].connectionPathList.explicitItems = [links[0].path]
    return links


def _give(layer, attribute, kind, text, chance):
    """Give an attribute a text in its own type, perhaps as a sample."""
    value = {"asset": Sdf.AssetPath(text), "string": text, "token": text}.get(kind)
    if kind == "asset[]":
        value = Sdf.AssetPathArray([Sdf.AssetPath(text)])
    elif kind == "string[]":
        value = Vt.StringArray([text])
    if value is None:
        return
    if chance.random() < 0.3:
        layer.SetTimeSample(attribute.path, chance.choice((0.0, 1.0, 50.0)), value)
    else:
        attribute.default = value


def clips(layer, prims, chance) -> str:
    """Give a prim value clips: a template with odd times, lists that do not fit, files that are not there."""
    prim, names = layer.GetPrimAtPath(chance.choice(prims)), _files(layer, chance)
    clip_set = {"primPath": chance.choice((str(prim.path), "/", "/Nowhere", "", "odd path"))}
    if chance.random() < 0.5:
        clip_set["templateAssetPath"] = chance.choice(("./clip.#.usda", "./clip.###.##.usda", "./clip.usda", "#", ""))
        for name in ("templateStartTime", "templateEndTime", "templateStride", "templateActiveOffset"):
            if chance.random() < 0.8:
                clip_set[name] = chance.choice((*TIMES, "text", True))
    else:
        clip_set["assetPaths"] = Sdf.AssetPathArray([Sdf.AssetPath(chance.choice(names)) for _ in range(3)])
    for name in ("active", "times"):
        if chance.random() < 0.6:
            count = chance.choice((0, 1, 3, 2_000))
            pairs = [Gf.Vec2d(chance.choice(TIMES), chance.choice((0, 1, 2, 7, -1, *TIMES))) for _ in range(count)]
            clip_set[name] = Vt.Vec2dArray(pairs)
    if chance.random() < 0.4:
        clip_set["manifestAssetPath"] = Sdf.AssetPath(chance.choice(names))
    clip_set["interpolateMissingClipValues"] = chance.random() < 0.5
    sets = {name: clip_set for name in chance.choice((("default",), ("a", "b"), ("",)))}
    prim.SetInfo("clips", chance.choice((sets, sets, sets, {"default": "text"})))
    if chance.random() < 0.3:
        prim.SetInfo("clipSets", Sdf.StringListOp.CreateExplicit(["b", "nothing"]))
    return f"clips of {prim.path}: {' '.join(f'{key} {value}' for key, value in clip_set.items())}"[:200]


def _files(layer, chance):
    """Return names of clips: copies of the layer as it is now, the layer itself, a device, a text, nothing."""
    folder = Path(layer.realPath).parent
    for number in range(chance.choice((0, 2))):
        layer.Export(str(folder / f"clip.{number}.usda"))
    (folder / "note.usda").write_text("hello", encoding="utf-8")
    return (
        "./clip.0.usda",
        "./clip.1.usda",
        f"./{Path(layer.realPath).name}",
        "/dev/zero",
        "./note.usda",
        "",
        "./no.usda",
    )


def slender(layer, prims, chance) -> str:
    """Stretch a body to a needle, a foil or a speck, in its own sizes or by its scale."""
    prim = layer.GetPrimAtPath(chance.choice(prims))
    first, second = chance.choice(RATIOS), chance.choice((1.0, *RATIOS))
    if chance.random() < 0.5:
        prim.typeName = chance.choice(("Cube", "Cylinder", "Capsule", "Cone", "Cylinder", "Sphere"))
        for name, size in (("size", 1.0), ("radius", first), ("height", second)):
            declare(prim, name, "double").default = 0.01 * size
    order = prim.attributes["xformOpOrder"].default if "xformOpOrder" in prim.attributes else None
    if isinstance(order, Vt.TokenArray) and "xformOp:scale:slender" in order:
        return f"{prim.path} of other sizes"
    given = order if isinstance(order, Vt.TokenArray) else ()
    declare(prim, "xformOp:scale:slender", "double3").default = Gf.Vec3d(first, second, 1.0)
    declare(prim, "xformOpOrder", "token[]").default = Vt.TokenArray([*given, "xformOp:scale:slender"])
    if chance.random() < 0.4:
        declare(prim, "warpmag:momentSpacing", "float").default = chance.choice((1e-9, 1e-5, 1e-3, 0.1, 1e9))
    return f"{prim.path} stretched by {first}, {second}"


def plates(layer, prims, chance) -> str:
    """Add a plate of iron, near or far, where it acts by few moments, and sheets in, on and across it."""
    if layer.GetPrimAtPath("/Plate"):
        return "nothing"
    distance, thickness = chance.choice(DISTANCES), chance.choice(THICKNESSES)
    plate = _add_plate(layer, "/Plate", (0.06, 0.06, thickness), (0.0, 0.0, distance), (0.0, 0.0, 0.0))
    if chance.random() < 0.1:  # cells cannot conduct
        declare(plate, "warpmag:conductivity", "float").default = 1e6
    places = chance.choices(("inside", "same", "on", "across", "turned"), k=chance.choice((0, 0, 1, 1, 2, 3)))
    for number, place in enumerate(places):
        sheet, side = chance.choice(THICKNESSES), chance.choice((0.06, 0.06, 0.02))
        offset, turn = [chance.uniform(-0.2, 0.2) * side, chance.uniform(-0.2, 0.2) * side, 0.0], (0.0, 0.0, 0.0)
        if place == "same":
            offset = [0.0, 0.0, 0.0]
        elif place == "on":
            offset[2] = 0.5 * (thickness + sheet) * chance.choice((1.0, 0.999, 0.9, 1.01))
        elif place != "inside":
            turn = (chance.uniform(-90.0, 90.0) if place == "across" else 0.0, 0.0, chance.uniform(-90.0, 90.0))
        center = (offset[0], offset[1], distance + offset[2])
        prim = _add_plate(layer, f"/Sheet{number}", (side, side, sheet), center, turn)
        if number:  # a second sheet of automatic cells would have more than two thousand with the others
            declare(prim, "warpmag:momentSpacing", "float").default = chance.choice((0.006, 0.02))
    return f"a plate at {distance}, sheets {places}"


def _add_plate(layer, path, sides, center, turn) -> Sdf.PrimSpec:
    """Add a plate of iron of sides [m] at a center [m], turned by angles [deg]."""
    prim = define(layer, path, "Cube")
    apis = ["PhysicsRigidBodyAPI", "PhysicsCollisionAPI", "WarpmagMagnetAPI"]
    prim.SetInfo("apiSchemas", Sdf.TokenListOp.CreateExplicit(apis))
    values = {
        "size": ("double", 1.0),
        "xformOp:translate": ("double3", Gf.Vec3d(*center)),
        "xformOp:rotateXYZ": ("float3", Gf.Vec3f(*turn)),
        "xformOp:scale": ("double3", Gf.Vec3d(*sides)),
        "xformOpOrder": ("token[]", Vt.TokenArray(["xformOp:translate", "xformOp:rotateXYZ", "xformOp:scale"])),
        "warpmag:material": ("token", "iron"),
    }
    for name, (kind, value) in values.items():
        declare(prim, name, kind).default = value
    return prim


def circuit(layer, prims, chance) -> str:
    """Add a coil that answers to a voltage, one of whose numbers is odd."""
    prim = layer.GetPrimAtPath(chance.choice(prims)) if chance.random() < 0.5 else None
    prim = prim or define(layer, f"/Driven{chance.randrange(1000)}", "Xform")
    before = prim.GetInfo("apiSchemas").GetAppliedItems() if prim.HasInfo("apiSchemas") else []
    prim.SetInfo("apiSchemas", Sdf.TokenListOp.CreateExplicit([*dict.fromkeys((*before, "WarpmagCoilAPI"))]))
    numbers = {"radius": 0.02, "wireRadius": 1e-3, "resistance": 2.0, "turns": 100.0, "voltage": 12.0}
    numbers |= {name: 1e-3 for name in ("inductance", "ampereTurns") if chance.random() < 0.3}
    odd = chance.choice(sorted(numbers))
    numbers[odd] = chance.choice(SIZES)
    for name, value in numbers.items():
        declare(prim, f"warpmag:coil:{name}", "float").default = value
    if chance.random() < 0.3:
        for time in (0.0, 10.0):
            layer.SetTimeSample(prim.path.AppendProperty("warpmag:coil:voltage"), time, chance.choice(SIZES))
    return f"{prim.path} driven, {odd} {numbers[odd]}"


def schemas(layer, prims, chance) -> str:
    """Apply very many schemas, of any names, some several times, or lists that contradict each other."""
    prim, count = layer.GetPrimAtPath(chance.choice(prims)), chance.choice((3, 50, 900, 1_100, 20_000))
    stems = chance.sample(SCHEMAS, chance.choice((1, 3)))
    names = [
        f"{stem}{number}" if stem[-1] in ":xt" else stem for number in range(count) for stem in stems[: 1 + number % 3]
    ]
    names = list(dict.fromkeys(names))
    chance.shuffle(names)
    before = prim.GetInfo("apiSchemas").GetAppliedItems() if prim.HasInfo("apiSchemas") else []
    kept = list(dict.fromkeys((*before, *names)))
    value = Sdf.TokenListOp()
    if chance.random() < 0.2:
        value.prependedItems, value.deletedItems = kept, kept[::2]
    elif chance.random() < 0.2:
        value.prependedItems, value.appendedItems = kept, kept[::-1]
    else:
        value = Sdf.TokenListOp.CreateExplicit(kept)
    prim.SetInfo("apiSchemas", value)
    return f"{len(kept)} schemas on {prim.path}: {stems}"


def connections(layer, prims, chance) -> str:
    """Connect attributes to each other, to prims, to themselves, in chains, circles and stars."""
    attributes = [attribute for path in prims[:200] for attribute in layer.GetPrimAtPath(path).attributes]
    if not attributes:
        return "nothing"
    count = chance.choice((2, 5, 60))
    some = [chance.choice(attributes) for _ in range(count)]
    others = [attribute.path for attribute in some[1:] + some[:1]]
    others = chance.choice((others, [some[0].path] * count, [chance.choice(prims) for _ in some]))
    for attribute, other in zip(some, others, strict=True):
        attribute.connectionPathList.explicitItems = [other] if chance.random() < 0.8 else [other, *others[:20]]
        if chance.random() < 0.2:
            attribute.ClearDefaultValue()
    return f"{count} connections from {some[0].path}"


def long_transform(layer, prims, chance) -> str:
    """Give a prim very many transform operations."""
    prim, count = layer.GetPrimAtPath(chance.choice(prims)), chance.choice((100, 900, 1_100, 30_000))
    names = [f"xformOp:translate:t{number}" for number in range(min(count, 2_000))]
    with Sdf.ChangeBlock():
        for name in names:
            if name not in prim.attributes:
                Sdf.AttributeSpec(prim, name, Sdf.ValueTypeNames.Double3).default = Gf.Vec3d(0.0, 0.0, 1e-6)
    order = (names * (1 + count // len(names)))[:count] if chance.random() < 0.5 else names[:1] * count
    declare(prim, "xformOpOrder", "token[]").default = Vt.TokenArray(order)
    return f"{count} transform operations on {prim.path}"


HOSTILE: tuple[Callable, ...] = (
    *(texture, texture, texture, clips, clips, slender, slender, schemas, connections, connections, long_transform),
    *(plates, plates, circuit, circuit),
)
