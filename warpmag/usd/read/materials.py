"""Physics materials that are bound to colliders."""

from collections.abc import Iterator

from pxr import Usd, UsdPhysics, UsdShade

from warpmag.usd.values import Finding

_PURPOSE = "physics"


def material_findings(colliders: list[Usd.Prim]) -> Iterator[Finding]:
    """Yield which colliders have a physics material that is not there: inactive, abstract, or without definition."""
    if not colliders:
        return
    materials, _ = UsdShade.MaterialBindingAPI.ComputeBoundMaterials(colliders, _PURPOSE)
    for collider, material in zip(colliders, materials, strict=True):
        prim = material.GetPrim()
        if not (prim and prim.HasAPI(UsdPhysics.MaterialAPI)):
            continue
        if prim.IsActive() and prim.IsDefined() and not prim.IsAbstract() and prim.IsLoaded():
            continue
        state = "abstract" if prim.IsAbstract() else "inactive" if not prim.IsActive() else "not defined"
        yield Finding(str(collider.GetPath()), f"its physics material {prim.GetPath()} is {state}")
