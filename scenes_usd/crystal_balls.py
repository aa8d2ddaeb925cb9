"""Crystal Balls: fixed balls around a bar magnet, magnetized by it and by each other (Kim and Han 2022, Fig. 7).

``python -m warpmag.scenes_usd.crystal_balls -o crystal_balls.usdc``

The variant set ``strength`` of ``/World/Magnet`` selects the strong or the weak magnet.
"""

import os

from pxr import Gf, Usd

from warpmag.declarations.magnets import Magnet, MagneticSettings
from warpmag.errors import InputError
from warpmag.scenes_usd import authoring
from warpmag.usd import author_magnet

CRYSTAL_COLOR = (0.45, 0.68, 0.8)


def author(
    path: str | os.PathLike,
    *,
    columns: int = 16,
    rows: int = 13,
    bar: int = 10,
    bar_rows: int = 3,
    radius: float = 0.005,
    spacing: float = 0.011,
    strong: float = 4e7,
    weak: float = 1e6,
    strength: str = "strong",
) -> None:
    """Write the stage to ``path``.

    Args:
        columns: Cells of the grid along x.
        rows: Cells along z.
        bar: Cells along x in the middle that the bar magnet occupies.
        bar_rows: Cells along z that the bar magnet occupies.
        radius: Radius of the balls [m], one in each remaining cell.
        spacing: Size of a cell [m].
        strong: Magnetization of the strong magnet, along x [A/m].
        weak: Magnetization of the weak magnet, along x [A/m].
        strength: Selected magnet, strong or weak.
    """
    _check(columns, rows, bar, bar_rows, radius, spacing, strength)
    count = columns * rows - bar * bar_rows
    stage = authoring.new_stage(
        f"Crystal Balls: {count} fixed balls show the sum of their own fields and the field of a bar magnet\n\n"
        "Kim and Han 2022, Fig. 7. Nothing moves but the magnetizations. Variant set strength: strong, weak.",
        seconds=1.0,
    )
    authoring.add_scene(stage, MagneticSettings(), gravity=0.0)
    crystal = authoring.add_material(stage, "Crystal", color=CRYSTAL_COLOR, roughness=0.1, density=2650.0)
    red = authoring.add_magnet_material(stage)
    gap = spacing - 2.0 * radius
    sizes = (bar * spacing - gap, bar_rows * spacing - gap, bar_rows * spacing - gap)
    prim = authoring.add_box(stage, "/World/Magnet", (0.0, 0.0, 0.0), sizes, red, motion=authoring.KINEMATIC)
    _add_strengths(prim, {"strong": strong, "weak": weak}, strength)
    cells = [(x - 0.5 * (columns - 1), z - 0.5 * (rows - 1)) for z in range(rows) for x in range(columns)]
    free_cells = [(x, z) for x, z in cells if abs(x) > 0.5 * bar or abs(z) > 0.5 * bar_rows]
    positions = [(x * spacing, 0.0, z * spacing) for x, z in free_cells]
    options = {"motion": authoring.KINEMATIC, "magnet": Magnet(), "color": CRYSTAL_COLOR}
    authoring.add_ball_prims(stage, positions, radius, crystal, **options)
    reach = spacing * max(columns, 1.78 * rows)
    authoring.add_camera(stage, (0.35 * reach, -1.75 * reach, 0.3 * reach), (0.0, 0.0, 0.0))
    authoring.save(stage, path)


def _check(columns, rows, bar, bar_rows, radius, spacing, strength) -> None:
    for name, value in (("columns", columns), ("rows", rows), ("bar", bar), ("bar_rows", bar_rows)):
        authoring.check_count(name, value)
    for name, value, total in (("bar", bar, columns), ("bar_rows", bar_rows, rows)):
        if value > total or (total - value) % 2:
            raise InputError(f"{name}: must leave an even number of {total} cells, half on each side, got {value}")
    if spacing < authoring.BALL_SPACING * radius:
        raise InputError(f"spacing: balls of radius {radius:g} m would touch, got {spacing:g} m")
    if strength not in ("strong", "weak"):
        raise InputError(f"strength: {strength!r} is not one of strong, weak")


def _add_strengths(prim: Usd.Prim, magnetizations: dict[str, float], selected: str) -> None:
    """Author the variant set ``strength`` of a magnet, with the magnetization in the variants only."""
    author_magnet(prim, Magnet(kind="permanent"))
    attribute = prim.GetAttribute("warpmag:magnetization")
    attribute.Clear()  # an opinion on the prim itself would override the variants
    variants = prim.GetVariantSets().AddVariantSet("strength")
    for name, magnetization in magnetizations.items():
        variants.AddVariant(name)
        variants.SetVariantSelection(name)
        with variants.GetVariantEditContext():
            attribute.Set(Gf.Vec3f(magnetization, 0.0, 0.0))
    variants.SetVariantSelection(selected)


if __name__ == "__main__":
    authoring.run(author)
