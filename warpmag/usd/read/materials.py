"""Physics materials of colliders, and densities of magnets made of named materials."""

from collections.abc import Iterable, Iterator

from pxr import Usd, UsdPhysics, UsdShade

from warpmag.declarations.materials import material
from warpmag.usd.read.prims import body_of, is_collider, prims_of_magnet
from warpmag.usd.schemas import MATERIAL
from warpmag.usd.values import Finding

_PURPOSE = "physics"
_ROLES = {"PhysicsMaterialAPI", "PhysicsRigidBodyAPI", "PhysicsCollisionAPI"}
"""Schemas of which USD's physics reads the first one alone, if that is the material's."""


def material_findings(colliders: list[Usd.Prim]) -> Iterator[Finding]:
    """Yield an error for each collider that is a physics material, or has an inactive, abstract or undefined one."""
    if not colliders:
        return
    for collider in colliders:
        if next(name for name in collider.GetAppliedSchemas() if name in _ROLES) == "PhysicsMaterialAPI":
            yield Finding(
                str(collider.GetPath()),
                "PhysicsMaterialAPI is applied before PhysicsCollisionAPI: USD's physics reads a material, no collider",
            )
    materials, _ = UsdShade.MaterialBindingAPI.ComputeBoundMaterials(colliders, _PURPOSE)
    for collider, bound in zip(colliders, materials, strict=True):
        prim = bound.GetPrim()
        if not (prim and prim.HasAPI(UsdPhysics.MaterialAPI)):
            continue
        if prim.IsActive() and prim.IsDefined() and not prim.IsAbstract() and prim.IsLoaded():
            continue
        state = "abstract" if prim.IsAbstract() else "inactive" if not prim.IsActive() else "not defined"
        yield Finding(str(collider.GetPath()), f"its physics material {prim.GetPath()} is {state}")


def give_densities(stage: Usd.Stage, magnets: Iterable[str]) -> None:
    """Give magnets of named materials the density of their material [kg/m³], where no mass or density is authored.

    A mass or density of the collider, of its rigid body or of its bound physics material takes precedence. The density
    is written to the session layer, from which Newton reads it.
    """
    with Usd.EditContext(stage, stage.GetSessionLayer()):
        for path in magnets:
            prim = stage.GetPrimAtPath(path)
            name = prim.GetAttribute(MATERIAL).Get()
            body = body_of(prim)
            if not name or body is None or _has_mass(body):
                continue
            for collider in prims_of_magnet(prim):
                if is_collider(collider) and not _has_mass(collider) and not _bound_density(collider):
                    # prims inside an instance cannot be edited, their body can
                    owner = body if collider.IsInstanceProxy() else collider
                    _apply_mass(owner).CreateDensityAttr(material(name).density)


def _apply_mass(prim) -> UsdPhysics.MassAPI:
    """Apply the mass schema to a prim; values authored without the schema stay without effect."""
    if not prim.HasAPI(UsdPhysics.MassAPI):
        for name in UsdPhysics.MassAPI.GetSchemaAttributeNames(False):
            if stray := prim.GetAttribute(name):
                stray.Block()
    return UsdPhysics.MassAPI.Apply(prim)


def _has_mass(prim) -> bool:
    """Return True if a prim has a mass or a density; in USD zero means none."""
    mass = UsdPhysics.MassAPI(prim)
    return prim.HasAPI(UsdPhysics.MassAPI) and bool(mass.GetMassAttr().Get() or mass.GetDensityAttr().Get())


def _bound_density(collider) -> bool:
    bound, _ = UsdShade.MaterialBindingAPI(collider).ComputeBoundMaterial(_PURPOSE)
    return bool(bound) and bool(UsdPhysics.MaterialAPI(bound.GetPrim()).GetDensityAttr().Get())
