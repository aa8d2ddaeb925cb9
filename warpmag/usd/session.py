"""Layers that reading adds to the session of a stage: instances as prims, and SI units.

From weak to strong a stage then has its own layers, ``instances`` in its own units, ``units`` in SI units, and the
session layer itself, which holds the values of one moment. Who reads the stage needs not know of any of them; who
writes over the scene takes :func:`as_written` for what a layer over it finds there.
"""

from pxr import Sdf, Usd

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
    """Make what instances below a prim hold editable, those in instances included, by opinions in ``layer``."""
    while True:
        prims = Usd.PrimRange(stage.GetPrimAtPath(within), Usd.PrimAllPrimsPredicate)
        instances = [prim.GetPath() for prim in prims if prim.IsInstance()]
        if not instances:
            return
        with Sdf.ChangeBlock():
            for path in instances:
                Sdf.CreatePrimInLayer(layer, path).instanceable = False


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
