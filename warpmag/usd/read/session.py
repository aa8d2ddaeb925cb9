"""Layers that reading adds to the session of a stage: instances as prims, and SI units.

From weak to strong a stage then has its own layers, ``instances`` in its own units, and ``units`` in SI units. The
session layer itself is the strongest and has the values of one time code. Code that reads the stage can ignore the
layers. Code that writes a layer over the scene uses :func:`as_written`, the stage as seen below that layer.
"""

from collections.abc import Iterable, Iterator

from pxr import Sdf, Usd

from warpmag.errors import InputError
from warpmag.usd.read.prims import descendants, is_physical
from warpmag.usd.values import Finding

INSTANCES, UNITS = "warpmag_instances", "warpmag_units"
"""Names of the layers."""


def add_layer(stage: Usd.Stage, name: str) -> Sdf.Layer:
    """Insert an empty layer directly below the session layer of a stage; :func:`added_layer` finds it by its name."""
    session, layer = stage.GetSessionLayer(), Sdf.Layer.CreateAnonymous(f"{name}.usda")
    for target in (session, layer):  # USD would rescale its time samples otherwise
        target.timeCodesPerSecond = stage.GetTimeCodesPerSecond()
    session.subLayerPaths.insert(0, layer.identifier)
    return layer


def added_layer(stage: Usd.Stage, name: str) -> Sdf.Layer | None:
    """Return the added layer ``name``, None where there is none."""
    layers = (Sdf.Layer.Find(path) for path in stage.GetSessionLayer().subLayerPaths)
    return next((layer for layer in layers if layer and layer.GetDisplayName() == f"{name}.usda"), None)


def release_instances(stage: Usd.Stage, layer: Sdf.Layer, within: Sdf.Path) -> None:
    """Make all instances below a prim editable, nested ones included, see :func:`release`."""
    while True:
        prims = Usd.PrimRange(stage.GetPrimAtPath(within), Usd.PrimAllPrimsPredicate)
        instances = [prim.GetPath() for prim in prims if prim.IsInstance()]
        if not instances:
            return
        release(stage, layer, instances)


def release(stage: Usd.Stage, layer: Sdf.Layer, instances: list[Sdf.Path]) -> None:
    """Make instances editable in ``layer``; raise :class:`InputError` if that applies an override to a physical one."""
    with Sdf.ChangeBlock():
        for path in instances:
            Sdf.CreatePrimInLayer(layer, path).instanceable = False
    for finding in instance_findings(
        prim
        for prim in map(stage.GetPrimAtPath, instances)
        if any(is_physical(inner) or inner.GetTypeName().startswith("Physics") for inner in descendants(prim))
    ):
        raise InputError(str(finding))


def editable(stage: Usd.Stage, path: Sdf.Path) -> Usd.Prim:
    """Return the prim at ``path``, with the instances around it made editable in the edit target of the stage."""
    while (prim := stage.GetPrimAtPath(path)).IsInstanceProxy():
        while prim.IsInstanceProxy():
            prim = prim.GetParent()
        prim.SetInstanceable(False)
    return prim


def instances_around(prims: Iterable[Usd.Prim]) -> list[Usd.Prim]:
    """Return the instances at or above prims, each once."""
    instances = {}
    for prim in prims:
        while (prim.IsInstance() or prim.IsInstanceProxy()) and prim.GetPath() not in instances:
            instances[prim.GetPath()] = prim
            prim = prim.GetParent()
    return [prim for prim in instances.values() if prim.IsInstance()]


def instance_findings(instances: Iterable[Usd.Prim]) -> Iterator[Finding]:
    """Yield an error for each instance with overrides of prims in it: USD ignores them while it is not editable."""
    for prim in instances:
        if spec := _ignored_override(prim):
            message = f"USD ignores the override {spec.path} in the instance, but a run would apply it"
            yield Finding(str(prim.GetPath()), f"{message}: remove the override, or set instanceable = false")


def _ignored_override(prim: Usd.Prim) -> Sdf.PrimSpec | None:
    """Return an override of a prim inside an instance, None where there is none."""
    stage = prim.GetStage()
    scene = stage.GetLayerStack(includeSessionLayers=False)
    added = [layer for layer in stage.GetLayerStack() if layer not in scene]
    waiting = [(prim.GetPrimInPrototype() if prim.IsInstanceProxy() else prim).GetPrimIndex().rootNode]
    root = waiting[0]
    while waiting:
        node = waiting.pop()
        waiting += node.children
        if node != root and not node.IsDueToAncestor():  # shared by all instances
            continue
        for layer in node.layerStack.layers:
            spec = layer.GetPrimAtPath(node.path) if layer not in added else None
            override = next(filter(None, map(_first_opinion, spec.nameChildren)), None) if spec else None
            if override:
                return override
    return None


def _first_opinion(spec: Sdf.PrimSpec) -> Sdf.PrimSpec | None:
    """Return the first prim of a tree with an opinion."""
    has_opinion = spec.specifier != Sdf.SpecifierOver or spec.properties or set(spec.ListInfoKeys()) > {"specifier"}
    return spec if has_opinion else next(filter(None, map(_first_opinion, spec.nameChildren)), None)


def unsaved_layers(stage: Usd.Stage) -> list[Sdf.Layer]:
    """Return the layers of a stage with files and with edits that this process has not saved."""
    return [layer for layer in stage.GetUsedLayers() if layer.realPath and layer.dirty]


def without_frozen(stage: Usd.Stage) -> Usd.Stage:
    """Return the stage without frozen values, with its time samples."""
    return _reopened(stage, list(stage.GetSessionLayer().subLayerPaths))


def as_written(stage: Usd.Stage) -> Usd.Stage:
    """Return the stage in the units of its file, without frozen values, with its instances as prims."""
    layer = added_layer(stage, INSTANCES)
    added = [layer.identifier] if layer else []
    session = stage.GetSessionLayer()
    unchanged = list(session.subLayerPaths) == added and not session.rootPrims
    return stage if unchanged else _reopened(stage, added)


def file_of(stage: Usd.Stage) -> Usd.Stage:
    """Return the stage of the file alone, without added layers."""
    return Usd.Stage.Open(stage.GetRootLayer(), None) if stage.GetSessionLayer().subLayerPaths else stage


def _reopened(stage: Usd.Stage, added: list[str]) -> Usd.Stage:
    if not added:
        return Usd.Stage.Open(stage.GetRootLayer(), None)
    session = Sdf.Layer.CreateAnonymous()
    session.timeCodesPerSecond = stage.GetTimeCodesPerSecond()
    session.subLayerPaths[:] = added
    return Usd.Stage.Open(stage.GetRootLayer(), session)
