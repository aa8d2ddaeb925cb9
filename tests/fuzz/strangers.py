"""What strangers send: other compositions, units, names and sizes, all of it valid USD or nearly so.

Every fault takes a layer that lies in a folder, the prims of the seed and a source of chance, changes the layer, may
write files beside it, and returns what it did.
"""

from collections.abc import Callable
from pathlib import Path

from pxr import Gf, Sdf, Tf, Vt

NAMES = ("Kugel_größe", "磁石", "Магнит", "a" * 300, "b" * 5000, "nan", "_", "inputs", "e\u0301")
SHIFTS = (0.0, 0.0, 1e-9, 1e-4, 2e-3, 0.1, 1e6)
"""Distances of copies [m]: most often at the same place, as copying and pasting leaves them."""
TIMES = (-1e300, -5.0, 0.0, 0.5, 1.0, 1e9, 1e300)


def units(layer, prims, chance) -> str:
    """Other units, another axis up, another default prim."""
    choices = [("metersPerUnit", unit) for unit in (0.01, 0.001, 0.0254)]
    choices += [("upAxis", axis) for axis in ("Y", "Y", "X", "z", "")]
    choices += [("kilogramsPerUnit", 0.001), ("defaultPrim", chance.choice(("Nowhere", "", "World/A")))]
    key, value = chance.choice(choices)
    layer.pseudoRoot.SetInfo(key, value)
    return f"{key} = {value!r}"


def variant(layer, prims, chance) -> str:
    """Move what a prim says into a variant, which may not be the one selected."""
    prim = _prim(layer, prims, chance)
    sizes = Sdf.VariantSetSpec(prim, "size")
    for name in ("small", "large"):
        spec = Sdf.VariantSpec(sizes, name)
        for attribute in list(prim.attributes):
            if chance.random() < 0.5:
                Sdf.CopySpec(layer, attribute.path, layer, spec.primSpec.path.AppendProperty(attribute.name))
    prim.variantSetNameList.prependedItems = ["size"]
    selected = chance.choice(("small", "large", "neither"))
    prim.variantSelections["size"] = selected
    if chance.random() < 0.5:
        for attribute in list(prim.attributes):
            prim.RemoveProperty(attribute)
    return f"{prim.path} in variants, {selected} selected"


def arc(layer, prims, chance) -> str:
    """Bring in a prim by a reference or the like: from here, from beside, from nowhere, in a circle."""
    prim = Sdf.CreatePrimInLayer(layer, f"/Arc{chance.randrange(1000)}")
    prim.specifier, prim.typeName = Sdf.SpecifierDef, chance.choice(("Xform", "Mesh", "Scope"))
    prim.instanceable = chance.random() < 0.4
    source = chance.choice(prims)
    kind = chance.choice(("reference", "payload", "inherit", "specialize"))
    if kind in ("inherit", "specialize"):
        paths = prim.inheritPathList if kind == "inherit" else prim.specializesList
        paths.prependedItems = [chance.choice((source, prim.path, Sdf.Path("/Nowhere"), source.AppendChild("Inner")))]
        return f"{prim.path} {kind}s {paths.prependedItems[0]}"
    asset = chance.choice(("", "", _own(layer), _beside(layer, chance), "./nowhere.usda", "./", "@", "http://x/y.usd"))
    target = chance.choice((source, source, Sdf.Path("/Nowhere"), Sdf.Path()))
    offset = Sdf.LayerOffset(chance.choice((0.0, 10.0, 1e300)), chance.choice((1.0, 1.0, 0.0, -1.0, 5e-324)))
    made = (Sdf.Reference if kind == "reference" else Sdf.Payload)(asset, target, offset)
    (prim.referenceList if kind == "reference" else prim.payloadList).prependedItems = [made]
    return f"{prim.path} {kind} of {asset!r} {target} {offset}"


def circle(layer, prims, chance) -> str:
    """Let two prims, or a prim and its child, refer to each other."""
    prim = _prim(layer, prims, chance)
    inner = Sdf.CreatePrimInLayer(layer, prim.path.AppendChild("Again"))
    inner.specifier = Sdf.SpecifierDef
    inner.referenceList.prependedItems = [Sdf.Reference("", prim.path)]
    return f"{inner.path} refers to {prim.path}"


def sublayer(layer, prims, chance) -> str:
    """Put a layer below: one with faults of time, one that is not there, or itself."""
    beside = _beside(layer, chance)
    path = chance.choice((beside, beside, "./nowhere.usda", _own(layer), "./", "ü.usd"))
    layer.subLayerPaths.append(path)
    offset = Sdf.LayerOffset(chance.choice((0.0, 5.0, -1e30)), chance.choice((1.0, 2.0, 0.0, -1.0, 1e-300)))
    layer.subLayerOffsets[len(layer.subLayerPaths) - 1] = offset
    return f"sublayer {path} {offset}"


def relationship(layer, prims, chance) -> str:
    """Let a relationship name something that is not there, is something else, or is itself."""
    prim = _prim(layer, prims, chance)
    name = chance.choice(
        (
            *("material:binding:physics", "material:binding", "physics:simulationOwner", "physics:filteredPairs"),
            *("prototypes", "proxyPrim", "physics:body0", "collection:colliders:includes"),
        )
    )
    if name in prim.properties:
        prim.RemoveProperty(prim.properties[name])
    other = chance.choice((*prims[:5], chance.choice(prims), prim.path, "/Nowhere", "/World.radius"))
    Sdf.RelationshipSpec(prim, name, custom=False).targetPathList.explicitItems = [other]
    return f"{prim.path}.{name} to {other}"


def nest(layer, prims, chance) -> str:
    """Put frames within frames, with a body at the end of them or without."""
    depth = chance.choice((20, 200, 700))
    path = Sdf.Path(f"/Deep{chance.randrange(1000)}")
    with Sdf.ChangeBlock():
        for _ in range(depth):
            prim = Sdf.CreatePrimInLayer(layer, path)
            prim.specifier, prim.typeName = Sdf.SpecifierDef, "Xform"
            path = path.AppendChild("x")
    source = chance.choice(prims)
    if chance.random() < 0.5:
        Sdf.CopySpec(layer, source, layer, path)
    return f"{depth} levels above a copy of {source}"


def crowd(layer, prims, chance) -> str:
    """Very many prims, or an attribute of very many values or samples."""
    prim, kind = _prim(layer, prims, chance), chance.randrange(4)
    count = chance.choice((500, 5_000))
    if kind == 0:
        with Sdf.ChangeBlock():
            for number in range(count):
                prim = Sdf.CreatePrimInLayer(layer, f"/Crowd/x{number}")
                prim.specifier, prim.typeName = Sdf.SpecifierDef, chance.choice(("Xform", "Sphere", "Scope"))
        return f"{count} prims more"
    if kind == 1:
        for number in range(chance.choice((10, 30))):  # a hundred bodies of 250 moments take minutes, and rightly
            Sdf.CopySpec(layer, prim.path, layer, Sdf.Path(f"/Copy{number}"))
        return f"{number + 1} copies of {prim.path}"
    if kind == 2:
        name = chance.choice(("points", "velocities", "physics:approximation"))
        if name in prim.attributes:
            prim.RemoveProperty(prim.attributes[name])
        Sdf.AttributeSpec(prim, name, Sdf.ValueTypeNames.Point3fArray).default = Vt.Vec3fArray(100 * count)
        return f"{100 * count} {name} on {prim.path}"
    for attribute in list(prim.attributes)[:1]:
        for number in range(count):
            layer.SetTimeSample(attribute.path, float(number), attribute.default)
        return f"{count} samples of {attribute.path}"
    return "nothing"


def name(layer, prims, chance) -> str:
    """Give a prim an unusual name."""
    prim = _prim(layer, prims, chance)
    before, prim_name = prim.path, chance.choice(NAMES)
    try:
        prim.name = prim_name
    except (ValueError, Tf.ErrorException):
        return "nothing"
    return f"{before} called {prim_name[:20]}"


def standing(layer, prims, chance) -> str:
    """Switch a prim off, make it abstract, an opinion alone, hidden, or of another purpose."""
    prim, kind = _prim(layer, prims, chance), chance.randrange(5)
    if kind == 0:
        prim.active = False
    elif kind < 3:
        prim.specifier = (Sdf.SpecifierClass, Sdf.SpecifierOver)[kind - 1]
    else:
        what, value = (("visibility", "invisible"), ("purpose", chance.choice(("guide", "proxy", "odd"))))[kind - 3]
        if what in prim.attributes:
            prim.RemoveProperty(prim.attributes[what])
        Sdf.AttributeSpec(prim, what, Sdf.ValueTypeNames.Token).default = value
    return f"{prim.path} " + ("off", "a class", "an over", "invisible", "of another purpose")[kind]


def animation(layer, prims, chance) -> str:
    """Samples at odd times, none of them at the start, with values that are blocked."""
    prim = _prim(layer, prims, chance)
    attributes = list(prim.attributes)
    if not attributes:
        return "nothing"
    attribute = chance.choice(attributes)
    value = attribute.default
    for time in chance.sample(TIMES, 3):
        layer.SetTimeSample(attribute.path, time, Sdf.ValueBlock() if chance.random() < 0.2 else value)
    if chance.random() < 0.5:
        attribute.ClearDefaultValue()
    return f"{attribute.path} sampled at odd times"


def operations(layer, prims, chance) -> str:
    """Say a transform twice, inverted, or with operations that are named anew."""
    prim = _prim(layer, prims, chance)
    order = prim.attributes["xformOpOrder"] if "xformOpOrder" in prim.attributes else None
    if order is None or not order.default:
        return "nothing"
    names = list(order.default)
    extra = chance.choice(
        ([names[0]], ["!invert!" + names[0]], names, ["xformOp:translate:pivot"], ["xformOp:scale:b"])
    )
    order.default = Vt.TokenArray([*names, *extra] if chance.random() < 0.5 else [*extra, *names])
    return f"{prim.path} transformed by {list(order.default)}"[:200]


def scale(layer, prims, chance) -> str:
    """Scale a prim, far or by a little."""
    prim = _prim(layer, prims, chance)
    factor = chance.choice((1e30, 1e-30, 1e-3, 1e3, -1.0, 1.5, 5e-324, 1e-45))
    order = prim.attributes["xformOpOrder"] if "xformOpOrder" in prim.attributes else None
    if "xformOp:scale:fuzz" in prim.attributes:
        return "nothing"
    Sdf.AttributeSpec(prim, "xformOp:scale:fuzz", Sdf.ValueTypeNames.Double3).default = Gf.Vec3d(
        *(factor if chance.random() < 0.8 else 1.0 for _ in range(3))
    )
    if order is None:
        order = Sdf.AttributeSpec(prim, "xformOpOrder", Sdf.ValueTypeNames.TokenArray, Sdf.VariabilityUniform)
    given = order.default if isinstance(order.default, Vt.TokenArray) else ()  # it may have another type
    order.default = Vt.TokenArray([*given, "xformOp:scale:fuzz"])
    return f"{prim.path} scaled by {factor}"


def copy(layer, prims, chance) -> str:
    """Put a copy of a prim beside it, at the same place or almost."""
    source = chance.choice(prims)
    target = source.GetParentPath().AppendChild(f"Copy{chance.randrange(1000)}")
    if not Sdf.CopySpec(layer, source, layer, target):
        return "nothing"
    shift = chance.choice(SHIFTS)
    place = layer.GetAttributeAtPath(target.AppendProperty("xformOp:translate"))
    if place is not None and isinstance(place.default, (Gf.Vec3d, Gf.Vec3f)):
        place.default = place.default + type(place.default)(0.0, 0.0, shift)
    return f"{target} a copy of {source} shifted by {shift}"


def empty(layer, prims, chance) -> str:
    """Take away what a stage is about: all prims, the scene, the units, the times."""
    kind = chance.randrange(3)
    if kind == 0:
        for prim in list(layer.rootPrims):
            del layer.rootPrims[prim.name]
    elif kind == 1:
        for key in layer.pseudoRoot.ListInfoKeys():
            if key not in ("primChildren", "subLayers", "subLayerOffsets"):
                layer.pseudoRoot.ClearInfo(key)
    else:
        scenes = {path for path in prims if layer.GetPrimAtPath(path).typeName == "PhysicsScene"}
        for path in sorted(scenes, reverse=True):  # what is below others first
            place = layer.GetPrimAtPath(path)
            del (place.nameParent or layer.pseudoRoot).nameChildren[path.name]
    return ("no prims", "no metadata", "no scene")[kind]


def connection(layer, prims, chance) -> str:
    """Connect an attribute, give it odd metadata."""
    attributes = list(_prim(layer, prims, chance).attributes)
    if not attributes:
        return "nothing"
    attribute = chance.choice(attributes)
    attribute.connectionPathList.explicitItems = [chance.choice((attribute.path, Sdf.Path("/Nowhere.out")))]
    attribute.customData = {"x": {"y": Vt.DoubleArray([float("nan")])}}
    return f"{attribute.path} connected"


STRANGERS: tuple[Callable, ...] = (
    *(units, variant, arc, arc, circle, sublayer, relationship, relationship, nest, crowd, name, standing, standing),
    *(animation, animation, operations, scale, copy, copy, empty, connection),
)


def _prim(layer, prims, chance) -> Sdf.PrimSpec:
    return layer.GetPrimAtPath(chance.choice(prims))


def _own(layer) -> str:
    return f"./{Path(layer.realPath).name}"


def _beside(layer, chance) -> str:
    """Write a copy of a layer as it is now beside it; return how to name it."""
    target = Path(layer.realPath)
    name = f"{target.stem}.part{chance.randrange(1000)}{chance.choice(('.usda', '.usdc'))}"
    layer.Export(str(target.with_name(name)))
    return f"./{name}"
