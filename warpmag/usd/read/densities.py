"""What magnets of named materials weigh."""

from collections.abc import Iterable

from pxr import Usd, UsdPhysics, UsdShade

from warpmag.declarations.materials import material
from warpmag.usd.read.geometry import is_solid
from warpmag.usd.read.reader import prims_of_magnet
from warpmag.usd.read.transforms import is_body, is_collider
from warpmag.usd.schemas import MATERIAL


def give_densities(stage: Usd.Stage, magnets: Iterable[str]) -> None:
    """Give magnets of named materials the density of their material [kg/m³], where nothing says what they weigh.

    A mass or a density of the collider, of its rigid body or of a physics material that is bound to it counts more. It
    is written in the session layer, from which Newton reads it; the scene stays as it is.

    Args:
        stage: As ``open_stage`` opened it.
        magnets: Paths of the magnets.
    """
    with Usd.EditContext(stage, stage.GetSessionLayer()):
        for path in magnets:
            prim = stage.GetPrimAtPath(path)
            name = prim.GetAttribute(MATERIAL).Get()
            body = _body_of(prim)
            if not name or body is None or _weighs(body):
                continue
            for collider in prims_of_magnet(prim):
                if is_collider(collider) and not _weighs(collider) and not _bound_density(collider):
                    # what an instance holds cannot be edited, and what has it can
                    owner = body if collider.IsInstanceProxy() else collider
                    _apply_mass(owner).CreateDensityAttr(material(name).density)


def _apply_mass(prim) -> UsdPhysics.MassAPI:
    """Apply the schema to a prim; values that it has without the schema go on having no effect."""
    if not prim.HasAPI(UsdPhysics.MassAPI):
        for name in UsdPhysics.MassAPI.GetSchemaAttributeNames(False):
            if stray := prim.GetAttribute(name):
                stray.Block()
    return UsdPhysics.MassAPI.Apply(prim)


def has_volume(stage: Usd.Stage, body: str) -> bool:
    """Return whether a rigid body has a collider of a type that has a volume."""
    return any(is_collider(one) and is_solid(one) for one in prims_of_magnet(stage.GetPrimAtPath(body)))


def _body_of(prim) -> Usd.Prim | None:
    while not prim.IsPseudoRoot():
        if is_body(prim):
            return prim
        prim = prim.GetParent()
    return None


def _weighs(prim) -> bool:
    """Whether a prim says what it weighs; zero says nothing, by USD."""
    mass = UsdPhysics.MassAPI(prim)
    return prim.HasAPI(UsdPhysics.MassAPI) and bool(mass.GetMassAttr().Get() or mass.GetDensityAttr().Get())


def _bound_density(collider) -> bool:
    bound, _ = UsdShade.MaterialBindingAPI(collider).ComputeBoundMaterial("physics")
    return bool(bound) and bool(UsdPhysics.MaterialAPI(bound.GetPrim()).GetDensityAttr().Get())
