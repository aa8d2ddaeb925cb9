"""Layers that reading adds to the session of a stage: instances as prims, and SI units.

From weak to strong a stage then has its own layers, ``instances`` in its own units, ``units`` in SI units, and the
session layer itself, which holds the values of one moment. Who reads the stage needs not know of any of them; who
writes over the scene takes :func:`as_written` for what a layer over it finds there.
"""

from collections.abc import Iterable, Iterator

from pxr import Sdf, Usd

from warpmag.errors import InputError
from warpmag.usd.read.prims import is_physical
from warpmag.usd.values import Finding

INSTANCES, UNITS = "warpmag_instances", "warpmag_units"
"""Names of the layers."""


def add_layer(stage: Usd.Stage, layer: Sdf.Layer) -> None:
    """Put a layer between the session layer of a stage and all others that are below it so far."""
    session = stage.GetSessionLayer()
    for one in (session, layer):  # USD would rescale its time samples otherwise
        one.timeCodesPerSecond = stage.GetTimeCodesPerSecond()
    session.subLayerPaths.insert(0, layer.identifier)


def new_layer(name: str) -> Sdf.Layer:
    """Return an empty layer that :func:`added_layer` finds by its name."""
    return Sdf.Layer.CreateAnonymous(f"{name}.usda")


def added_layer(stage: Usd.Stage, name: str) -> Sdf.Layer | None:
    """Return the layer of a name that was added to a stage, None where there is none."""
    found = (Sdf.Layer.Find(path) for path in stage.GetSessionLayer().subLayerPaths)
    return next((one for one in found if one and one.GetDisplayName() == f"{name}.usda"), None)


def release_instances(stage: Usd.Stage, layer: Sdf.Layer, within: Sdf.Path) -> None:
    """Make what instances below a prim hold editable, those in instances included, by opinions in ``layer``.

    Raises:
        InputError: One would change by that.
    """
    while True:
        prims = Usd.PrimRange(stage.GetPrimAtPath(within), Usd.PrimAllPrimsPredicate)
        instances = [prim.GetPath() for prim in prims if prim.IsInstance()]
        if not instances:
            return
        release(stage, layer, instances)


def release(stage: Usd.Stage, layer: Sdf.Layer, instances: list[Sdf.Path]) -> None:
    """Make what instances hold editable, by opinions in ``layer``.

    Raises:
        InputError: What they hold that is physical may change by that.
    """
    with Sdf.ChangeBlock():
        for path in instances:
            Sdf.CreatePrimInLayer(layer, path).instanceable = False
    everywhere = Usd.TraverseInstanceProxies(Usd.PrimAllPrimsPredicate)
    for finding in instance_findings(
        prim
        for prim in map(stage.GetPrimAtPath, instances)
        if any(is_physical(one) or one.GetTypeName().startswith("Physics") for one in Usd.PrimRange(prim, everywhere))
    ):
        raise InputError(str(finding))


def instances_around(prims: Iterable[Usd.Prim]) -> list[Usd.Prim]:
    """Return the instances that prims are, or are in, each once."""
    found = {}
    for prim in prims:
        while (prim.IsInstance() or prim.IsInstanceProxy()) and prim.GetPath() not in found:
            found[prim.GetPath()] = prim
            prim = prim.GetParent()
    return [prim for prim in found.values() if prim.IsInstance()]


def instance_findings(instances: Iterable[Usd.Prim]) -> Iterator[Finding]:
    """Yield which instances say something about what they hold: USD passes over that until they are editable."""
    for prim in instances:
        if spec := _passed_over(prim):
            message = (
                f"USD passes over {spec.path}, for it is in an instance, and a run, which edits what is in it, cannot"
            )
            yield Finding(str(prim.GetPath()), f"{message}: remove that, or set instanceable = false")


def _passed_over(prim: Usd.Prim) -> Sdf.PrimSpec | None:
    """Return what an instance says of a prim below it, itself or as a part of what it was referred to in."""
    stage = prim.GetStage()
    own = stage.GetLayerStack(includeSessionLayers=False)
    added = [layer for layer in stage.GetLayerStack() if layer not in own]
    waiting = [(prim.GetPrimInPrototype() if prim.IsInstanceProxy() else prim).GetPrimIndex().rootNode]
    root = waiting[0]
    while waiting:
        node = waiting.pop()
        waiting += node.children
        if node != root and not node.IsDueToAncestor():  # all instances share what it brings
            continue
        for layer in node.layerStack.layers:
            spec = layer.GetPrimAtPath(node.path) if layer not in added else None
            if found := next((one for child in spec.nameChildren if (one := _opinion(child))), None) if spec else None:
                return found
    return None


def _opinion(spec: Sdf.PrimSpec) -> Sdf.PrimSpec | None:
    """Return the first prim of a tree of which something is said."""
    says = spec.specifier != Sdf.SpecifierOver or spec.properties or set(spec.ListInfoKeys()) > {"specifier"}
    return spec if says else next((one for child in spec.nameChildren if (one := _opinion(child))), None)


def unsaved_layers(stage: Usd.Stage) -> list[Sdf.Layer]:
    """Return the layers with files, of those a stage is made of, that this process has edited and not saved."""
    return [layer for layer in stage.GetUsedLayers() if layer.realPath and layer.dirty]


def without_held(stage: Usd.Stage) -> Usd.Stage:
    """Return the stage without the values that are held at one moment."""
    return _opened(stage, list(stage.GetSessionLayer().subLayerPaths))


def as_written(stage: Usd.Stage) -> Usd.Stage:
    """Return the stage in the units of its file, no values held, with its instances as prims."""
    layer = added_layer(stage, INSTANCES)
    added = [layer.identifier] if layer else []
    session = stage.GetSessionLayer()
    as_it_is = list(session.subLayerPaths) == added and not session.rootPrims
    return stage if as_it_is else _opened(stage, added)


def file_of(stage: Usd.Stage) -> Usd.Stage:
    """Return the stage as its file has it where layers were added, else the stage."""
    return Usd.Stage.Open(stage.GetRootLayer(), None) if stage.GetSessionLayer().subLayerPaths else stage


def _opened(stage: Usd.Stage, added: list[str]) -> Usd.Stage:
    if not added:
        return Usd.Stage.Open(stage.GetRootLayer(), None)
    session = Sdf.Layer.CreateAnonymous()
    session.timeCodesPerSecond = stage.GetTimeCodesPerSecond()
    session.subLayerPaths[:] = added
    return Usd.Stage.Open(stage.GetRootLayer(), session)
