"""Kinds of prims, and traversals around them."""

from collections.abc import Iterator

from pxr import Usd, UsdGeom, UsdPhysics

_SOLIDS = (
    *(UsdGeom.Sphere, UsdGeom.Cube, UsdGeom.Mesh, UsdGeom.Cone),
    *(UsdGeom.Capsule, UsdGeom.Capsule_1, UsdGeom.Cylinder, UsdGeom.Cylinder_1),
)


def is_body(prim: Usd.Prim) -> bool:
    """Return whether a prim is an enabled rigid body."""
    return prim.HasAPI(UsdPhysics.RigidBodyAPI) and bool(UsdPhysics.RigidBodyAPI(prim).GetRigidBodyEnabledAttr().Get())


def is_collider(prim: Usd.Prim) -> bool:
    """Return whether a prim is an enabled collider."""
    return prim.HasAPI(UsdPhysics.CollisionAPI) and bool(UsdPhysics.CollisionAPI(prim).GetCollisionEnabledAttr().Get())


def is_physical(prim: Usd.Prim) -> bool:
    """Return whether a prim has a schema of a body, a collider, a magnet or a field source."""
    schemas = prim.GetPrimTypeInfo().GetAppliedAPISchemas()
    return any(name.startswith(("PhysicsRigidBody", "PhysicsCollision", "Warpmag")) for name in schemas)


def is_solid(prim: Usd.Prim) -> bool:
    """Return whether a prim is of a type that has a volume."""
    return any(prim.IsA(kind) for kind in _SOLIDS)


def has_volume(stage: Usd.Stage, body: str) -> bool:
    """Return whether a rigid body has a collider of a type that has a volume."""
    return any(is_collider(prim) and is_solid(prim) for prim in prims_of_magnet(stage.GetPrimAtPath(body)))


def body_of(prim: Usd.Prim) -> Usd.Prim | None:
    """Return the nearest rigid body at or above a prim, None where there is none."""
    while prim and not prim.IsPseudoRoot():
        if is_body(prim):
            return prim
        prim = prim.GetParent()
    return None


def descendants(prim: Usd.Prim) -> Iterator[Usd.Prim]:
    """Yield a prim and all prims below it: inactive ones, abstract ones and those in instances too."""
    return iter(Usd.PrimRange(prim, Usd.TraverseInstanceProxies(Usd.PrimAllPrimsPredicate)))


def prims_of_magnet(prim: Usd.Prim) -> Iterator[Usd.Prim]:
    """Yield the prims that a magnet at ``prim`` may cover: all that move with a body, or a collider alone."""
    return _prims_of_body(prim) if is_body(prim) else iter((prim,))


def _prims_of_body(body: Usd.Prim) -> Iterator[Usd.Prim]:
    """Yield the prims that move with ``body``: its subtree without nested bodies."""
    prims = iter(Usd.PrimRange(body, Usd.TraverseInstanceProxies()))
    for prim in prims:
        if prim != body and is_body(prim):
            prims.PruneChildren()
        else:
            yield prim
