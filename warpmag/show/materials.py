"""Materials of surfaces: UsdPreviewSurface, which every renderer reads, and MaterialX."""

from collections.abc import Sequence
from typing import Any

import numpy as np
from pxr import Gf, Sdf, Usd, UsdShade

from warpmag.usd.values import value_of

_MATERIALX = "ND_standard_surface_surfaceshader"
_NAMES = {"diffuseColor": "base_color", "metallic": "metalness", "roughness": "specular_roughness", "clearcoat": "coat"}
"""Inputs of UsdPreviewSurface that are authored here, and their names in MaterialX's standard surface."""

_PLASMA = ((13, 8, 135), (92, 1, 166), (156, 23, 158), (204, 71, 120), (237, 121, 83), (253, 180, 47), (240, 249, 33))
"""Colors of the scale at equal distances, 8-bit sRGB (Matplotlib's plasma, by N. Smith and S. van der Walt, CC0)."""


def author_surface(
    material: UsdShade.Material,
    *,
    color: Sequence[float],
    metallic: float = 0.0,
    roughness: float = 0.5,
    coat: float = 0.0,
) -> None:
    """Author the surface of a material as UsdPreviewSurface; the color is linear RGB, other values are 0 to 1."""
    values = {"diffuseColor": Gf.Vec3f(*color), "metallic": metallic, "roughness": roughness, "clearcoat": coat}
    _connect(material, "Surface", "UsdPreviewSurface", values, material.CreateSurfaceOutput(), "surface")


def author_materialx(stage: Usd.Stage) -> None:
    """Author MaterialX shaders with the values of the UsdPreviewSurface materials of a stage.

    USD's Python package has no MaterialX: its validators report these shaders as unknown.
    """
    for prim in stage.Traverse():
        if prim.IsA(UsdShade.Material):
            material = UsdShade.Material(prim)
            shader, _, _ = material.ComputeSurfaceSource()
            if shader and shader.GetShaderId() == "UsdPreviewSurface":
                values = {name: surface_value(material, key) for key, name in _NAMES.items()}
                values = {name: value for name, value in values.items() if value is not None}
                _connect(material, "MaterialX", _MATERIALX, values, material.CreateSurfaceOutput("mtlx"), "out")


def color_scale(count: int) -> np.ndarray:
    """Return a color scale, linear RGB, shape [count, 3]."""
    anchors = (np.array(_PLASMA) / 255.0) ** 2.2
    at = np.linspace(0.0, len(anchors) - 1.0, count)
    return np.stack([np.interp(at, np.arange(len(anchors)), anchors[:, k]) for k in range(3)], axis=1)


def _connect(material, name, identifier, values, output, source) -> None:
    """Author a shader below a material and connect its output ``source`` to the material's ``output``."""
    shader = UsdShade.Shader.Define(material.GetPrim().GetStage(), material.GetPath().AppendChild(name))
    shader.CreateIdAttr(identifier)
    for key, value in values.items():
        kind = Sdf.ValueTypeNames.Float if isinstance(value, float) else Sdf.ValueTypeNames.Color3f
        shader.CreateInput(key, kind).Set(value)
    output.ConnectToSource(shader.ConnectableAPI(), source)


def bound_material(prim: Usd.Prim) -> UsdShade.Material | None:
    """Return the material that is bound to a prim."""
    material = UsdShade.MaterialBindingAPI(prim).ComputeBoundMaterial()[0] if prim else None
    return material or None


def surface_value(material: UsdShade.Material | None, name: str) -> Any:
    """Return the value of an input of a material's UsdPreviewSurface; None if there is none.

    A value of another type, or that is not finite, raises :class:`InputError`.
    """
    surface = material.ComputeSurfaceSource()[0] if material else None
    return value_of(surface.GetPrim(), f"inputs:{name}") if surface else None


def metalness(stage: Usd.Stage, path: str) -> float:
    """Return the metalness of a prim's surface, 0 to 1."""
    value = surface_value(bound_material(stage.GetPrimAtPath(path)), "metallic")
    return min(max(float(value), 0.0), 1.0) if isinstance(value, float) else 0.0
