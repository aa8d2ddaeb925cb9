"""Alphabets: an invisible moment in the middle draws letters together (Kim and Han 2022, Fig. 4).

``python -m warpmag.scenes_usd.alphabets -o alphabets.usdc``; outlines need Matplotlib (the extra ``plots``).
"""

import itertools
import math
import os
import string

import numpy as np
from pxr import Gf, Sdf, Usd, UsdGeom, UsdPhysics, UsdShade

from warpmag.declarations.magnets import Magnet, MagneticSettings
from warpmag.scenes_usd import authoring, lettering
from warpmag.show.meshes import author_mesh
from warpmag.usd import author_magnet

PAINTS = {
    "Coral": (0.86, 0.19, 0.13),
    "Amber": (0.95, 0.47, 0.05),
    "Leaf": (0.15, 0.5, 0.2),
    "Sea": (0.04, 0.42, 0.5),
    "Ink": (0.08, 0.17, 0.5),
    "Plum": (0.4, 0.1, 0.38),
}
"""Linear RGB of the letters, used in turn."""

_GAP = 1.12  # distance of neighboring letters over their largest size along the axis
_MARGIN = 0.03
"""Collision margin over the thickness of the letters.

The margin keeps the boxes apart, so that a contact has the direction between nearest points, which is continuous. The
direction in which overlapping boxes are separated may jump to another axis, which ejects letters."""
_BEVEL = 0.02  # width of the bevel over the size of a capital


def author(
    path: str | os.PathLike,
    *,
    columns: int = 5,
    rows: int = 5,
    layers: int = 4,
    size: float = 0.02,
    thickness: float = 0.005,
    moment_spacing: float = 0.004,
    moment: float = 12.0,
    core: float = 0.03,
    saturation: float = 1.7e6,
    friction: float = 0.4,
) -> None:
    """Write the stage to ``path``.

    Args:
        columns: Letters along x.
        rows: Letters along z.
        layers: Letters along y.
        size: Height of a capital [m].
        thickness: Thickness of the letters [m].
        moment_spacing: Distance between the moments of a letter [m].
        moment: The invisible moment, along z [A·m²].
        core: Radius of the ball over which the moment is spread; nothing collides with the ball [m].
        saturation: Saturation magnetization of the letters [A/m].
        friction: Coefficient of friction of the letters.
    """
    for name, value in (("columns", columns), ("rows", rows), ("layers", layers)):
        authoring.check_count(name, value)
    count = columns * rows * layers
    stage = authoring.new_stage(
        f"Alphabets: {count} iron letters fly to an invisible, very strong magnetic moment at their center\n\n"
        "Kim and Han 2022, Fig. 4. No gravity, ordinary friction, steps of 1 ms.",
        seconds=5.0,
    )
    authoring.add_scene(stage, MagneticSettings(), gravity=0.0)
    iron = authoring.add_material(stage, "Iron", color=authoring.STEEL_COLOR, metallic=1.0, friction=friction)
    paints = [authoring.add_material(stage, name, color=color, roughness=0.35) for name, color in PAINTS.items()]
    used = string.ascii_uppercase[:count]
    shapes = {letter: _define_letter(stage, letter, iron, size, thickness) for letter in used}
    widths, heights = np.max([extent for extent, _ in shapes.values()], axis=0)
    pitch = np.array([_GAP * widths, _GAP * size, _GAP * heights])
    center = 0.5 * (np.array([columns, layers, rows]) - 1.0)
    UsdGeom.Scope.Define(stage, "/World/Letters")
    cells = itertools.product(range(layers), reversed(range(rows)), range(columns))
    for number, (layer, row, column) in enumerate(cells):
        letter = used[number % len(used)]
        position = (np.array([column, layer, row]) - center) * pitch
        body = authoring.add_body(stage, f"/World/Letters/{letter}_{number:03d}", position).GetPrim()
        body.GetInherits().AddInherit(_class_of(letter))
        UsdPhysics.MassAPI.Apply(body).CreateMassAttr(authoring.IRON_DENSITY * shapes[letter][1])
        UsdShade.MaterialBindingAPI.Apply(body).Bind(paints[number % len(paints)])
        # the curve is the paper's Eq. 10
        author_magnet(body, Magnet(moment_spacing=moment_spacing, saturation=saturation, curve="tanh-applied"))
    _add_center(stage, moment, core)
    reach = 0.5 * float(np.linalg.norm(pitch * (columns, layers, rows)))
    authoring.add_camera(stage, (1.5 * reach, -3.8 * reach, 0.9 * reach), (0.0, 0.0, 0.0))
    authoring.save(stage, path)


def _class_of(letter: str) -> Sdf.Path:
    return Sdf.Path(f"/_Letter_{letter}")


def _define_letter(
    stage: Usd.Stage, letter: str, material: UsdShade.Material, size: float, thickness: float
) -> tuple[np.ndarray, float]:
    """Author the class of a letter, its mesh and boxes; return its extent [m], shape [2], and unbeveled volume [m³]."""
    root = stage.CreateClassPrim(_class_of(letter)).GetPath()
    curves = lettering.outline(letter)
    upright = np.array([[1.0, 0.0, 0.0], [0.0, 0.0, 1.0], [0.0, -1.0, 0.0]])  # y of the letter is up, its face at -y
    points, faces = lettering.extruded(curves, thickness / size, _BEVEL)
    shell = UsdGeom.Mesh.Define(stage, root.AppendChild("Shell"))
    author_mesh(shell, size * points @ upright, faces)
    for number, box in enumerate(lettering.boxes(curves)):
        cube = UsdGeom.Cube.Define(stage, root.AppendChild(f"Box_{number:02d}"))
        prim = cube.GetPrim()
        cube.CreateSizeAttr(1.0)
        cube.CreateExtentAttr(UsdGeom.Boundable.ComputeExtentFromPlugins(cube, Usd.TimeCode.Default()))
        cube.CreatePurposeAttr(UsdGeom.Tokens.guide)
        cube.AddTranslateOp().Set(Gf.Vec3d(size * float(box.center[0]), 0.0, size * float(box.center[1])))
        cube.AddRotateYOp().Set(-math.degrees(box.angle))
        sides = 2.0 * size * box.half
        cube.AddScaleOp().Set(Gf.Vec3f(float(sides[0]), thickness, float(sides[1])))
        UsdPhysics.CollisionAPI.Apply(prim)
        prim.AddAppliedSchema("NewtonCollisionAPI")
        margin = prim.CreateAttribute("newton:contactMargin", Sdf.ValueTypeNames.Float, custom=False)
        margin.Set(_MARGIN * thickness)
        UsdShade.MaterialBindingAPI.Apply(prim).Bind(material)  # USD's physics does not inherit material bindings
    return size * np.ptp(np.concatenate(curves), axis=0), lettering.area(curves) * size**2 * thickness


def _add_center(stage: Usd.Stage, moment: float, core: float) -> None:
    """Author the invisible moment: a static ball that collides with nothing."""
    nothing = authoring.add_material(stage, "Nothing", color=(1.0, 1.0, 1.0))
    magnet = Magnet(kind="permanent", magnetization=(0.0, 0.0, moment / (4.0 / 3.0 * math.pi * core**3)))
    origin = (0.0, 0.0, 0.0)
    center = authoring.add_ball(stage, "/World/Center", origin, core, nothing, motion=authoring.STATIC, magnet=magnet)
    UsdGeom.Imageable(center).MakeInvisible()
    ghosts = UsdPhysics.CollisionGroup.Define(stage, "/World/Ghosts")
    ghosts.CreateInvertFilteredGroupsAttr(True)  # collides only with the groups that it names: none
    ghosts.GetCollidersCollectionAPI().CreateIncludesRel().SetTargets([center.GetPath()])


if __name__ == "__main__":
    authoring.run(author)
