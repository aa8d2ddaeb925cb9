"""Prims and attributes of layers, which replace those that are there."""

from pxr import Sdf


def define(layer: Sdf.Layer, path: Sdf.Path | str, kind: str) -> Sdf.PrimSpec:
    """Define a prim of a type; an empty ``kind`` keeps the type that it has."""
    prim = Sdf.CreatePrimInLayer(layer, path)
    prim.specifier = Sdf.SpecifierDef
    if kind:
        prim.typeName = kind
    return prim


def declare(prim: Sdf.PrimSpec, name: str, kind: str) -> Sdf.AttributeSpec:
    """Declare an attribute of a type, without a value."""
    if name in prim.properties:
        prim.RemoveProperty(prim.properties[name])
    return Sdf.AttributeSpec(prim, name, Sdf.ValueTypeNames.Find(kind))
