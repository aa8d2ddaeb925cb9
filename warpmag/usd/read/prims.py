"""Kinds of prims, and traversals around them."""

from collections.abc import Iterator

from pxr import Usd, UsdGeom, UsdPhysics

_SOLIDS = (
    *(UsdGeom.Sphere, UsdGeom.Cube, UsdGeom.Mesh, UsdGeom.Cone),
    *(UsdGeom.Capsule, UsdGeom.Capsule_1, UsdGeom.Cylinder, UsdGeom.Cylinder_1),
)


def is_body(prim: Usd.Prim) -> bool:
    """Return True if a prim is an enabled rigid body."""
    return prim.HasAPI(UsdPhysics.RigidBodyAPI) and bool(UsdPhysics.RigidBodyAPI(prim).GetRigidBodyEnabledAttr().Get())


def is_collider(prim: Usd.Prim) -> bool:
    """Return True if a prim is an enabled collider."""
    return prim.HasAPI(UsdPhysics.CollisionAPI) and bool(UsdPhysics.CollisionAPI(prim).GetCollisionEnabledAttr().Get())


def is_physical(prim: Usd.Prim) -> bool:
    """Return True if a prim has a schema of a body, a collider, a magnet or a field source."""
    schemas = prim.GetPrimTypeInfo().GetAppliedAPISchemas()
    return any(name.startswith(("PhysicsRigidBody", "PhysicsCollision", "Warpmag")) for name in schemas)


def is_solid(prim: Usd.Prim) -> bool:
    """Return True if a prim is of a type that has a volume."""
    return any(prim.IsA(kind) for kind in _SOLIDS)


def has_volume(stage: Usd.Stage, body: str) -> bool:
    """Return True if a rigid body has a collider of a type that has a volume."""
    return any(is_collider(prim) and is_solid(prim) for prim in prims_of_magnet(stage.GetPrimAtPath(body)))


def body_of(prim: Usd.Prim) -> Usd.Prim | None:
    """Return the nearest rigid body at or above a prim, None where there is none."""
    return next(filter(is_body, lineage(prim)), None)


def lineage(prim: Usd.Prim) -> Iterator[Usd.Prim]:
    """Yield a prim and its parents up to the root of the stage, which is left out."""
    while prim and not prim.IsPseudoRoot():
        yield prim
        prim = prim.GetParent()


def descendants(prim: Usd.Prim) -> Iterator[Usd.Prim]:
    """Yield a prim and all prims below it: inactive ones, abstract ones and those in instances too."""
    return iter(Usd.PrimRange(prim, Usd.TraverseInstanceProxies(Usd.PrimAllPrimsPredicate)))


def prims_of_magnet(prim: Usd.Prim) -> Iterator[Usd.Prim]:
    """Yield the prims that a magnet at ``prim`` may cover: a body's subtree without nested bodies, or a collider."""
    if not is_body(prim):
        yield prim
        return
    prims = iter(Usd.PrimRange(prim, Usd.TraverseInstanceProxies()))
    for part in prims:
        if part != prim and is_body(part):
            prims.PruneChildren()
        else:
            yield part
