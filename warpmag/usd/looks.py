"""How surfaces look: UsdPreviewSurface, which every renderer knows, and MaterialX beside it."""

from collections.abc import Sequence

from pxr import Gf, Sdf, Usd, UsdShade

_MATERIALX = "ND_standard_surface_surfaceshader"
_NAMES = {
    "diffuseColor": "base_color",
    "metallic": "metalness",
    "roughness": "specular_roughness",
    "clearcoat": "coat",
}
"""Inputs of UsdPreviewSurface that are authored here, and what MaterialX's standard surface calls them."""


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


def _connect(material, name, identifier, values, output, own_output) -> None:
    """Author a shader below a material and connect the material's output to its own."""
    shader = UsdShade.Shader.Define(material.GetPrim().GetStage(), material.GetPath().AppendChild(name))
    shader.CreateIdAttr(identifier)
    for key, value in values.items():
        kind = Sdf.ValueTypeNames.Float if isinstance(value, float) else Sdf.ValueTypeNames.Color3f
        shader.CreateInput(key, kind).Set(value)
    output.ConnectToSource(shader.ConnectableAPI(), own_output)
