"""How surfaces look: UsdPreviewSurface, which every renderer knows, and MaterialX beside it."""

from collections.abc import Sequence

import numpy as np
from pxr import Gf, Sdf, Usd, UsdShade

_MATERIALX = "ND_standard_surface_surfaceshader"
_NAMES = {
    "diffuseColor": "base_color",
    "metallic": "metalness",
    "roughness": "specular_roughness",
    "clearcoat": "coat",
}
"""Inputs of UsdPreviewSurface that are authored here, and what MaterialX's standard surface calls them."""

_PLASMA = ((13, 8, 135), (92, 1, 166), (156, 23, 158), (204, 71, 120), (237, 121, 83), (253, 180, 47), (240, 249, 33))
"""Colours of the scale, evenly spaced, 8-bit sRGB (Matplotlib's plasma, by N. Smith and S. van der Walt, CC0)."""


def author_surface(
    material: UsdShade.Material,
    *,
    color: Sequence[float],
    metallic: float = 0.0,
    roughness: float = 0.5,
    coat: float = 0.0,
) -> None:
    """Author the surface of a material as UsdPreviewSurface.

    Args:
        material: The material.
        color: Linear RGB.
        metallic: Metalness, 0 to 1.
        roughness: Roughness, 0 to 1.
        coat: Clear lacquer, 0 to 1.
    """
    values = {"diffuseColor": Gf.Vec3f(*color), "metallic": metallic, "roughness": roughness, "clearcoat": coat}
    _connect(material, "Surface", "UsdPreviewSurface", values, material.CreateSurfaceOutput(), "surface")


def author_materialx(stage: Usd.Stage) -> None:
    """Say in MaterialX what the materials of a stage say in UsdPreviewSurface by values, for renderers that want it.

    USD's own Python package knows no MaterialX: its validators call these shaders unknown.
    """
    for prim in stage.Traverse():
        if prim.IsA(UsdShade.Material):
            material = UsdShade.Material(prim)
            shader, _, _ = material.ComputeSurfaceSource()
            if shader and shader.GetShaderId() == "UsdPreviewSurface":
                given = {own: shader.GetInput(name) for name, own in _NAMES.items()}
                values = {own: one.Get() for own, one in given.items() if one and one.Get() is not None}
                _connect(material, "MaterialX", _MATERIALX, values, material.CreateSurfaceOutput("mtlx"), "out")


def color_scale(count: int) -> np.ndarray:
    """Return a scale of colours, linear RGB, shape [count, 3]."""
    anchors = (np.array(_PLASMA) / 255.0) ** 2.2
    at = np.linspace(0.0, len(anchors) - 1.0, count)
    return np.stack([np.interp(at, np.arange(len(anchors)), anchors[:, k]) for k in range(3)], axis=1)


def _connect(material, name, identifier, values, output, own_output) -> None:
    """Author a shader below a material and connect the material's output to its own."""
    shader = UsdShade.Shader.Define(material.GetPrim().GetStage(), material.GetPath().AppendChild(name))
    shader.CreateIdAttr(identifier)
    for key, value in values.items():
        kind = Sdf.ValueTypeNames.Float if isinstance(value, float) else Sdf.ValueTypeNames.Color3f
        shader.CreateInput(key, kind).Set(value)
    output.ConnectToSource(shader.ConnectableAPI(), own_output)


def metalness(stage: Usd.Stage, prim: str) -> float:
    """Return how metallic the surface of a prim is, 0 to 1, after the UsdPreviewSurface that is bound to it."""
    found = stage.GetPrimAtPath(prim)
    material, _ = UsdShade.MaterialBindingAPI(found).ComputeBoundMaterial() if found else (None, None)
    surface = material.ComputeSurfaceSource()[0] if material else None
    value = surface.GetInput("metallic").Get() if surface and surface.GetInput("metallic") else None
    return min(max(float(value), 0.0), 1.0) if isinstance(value, float) else 0.0
