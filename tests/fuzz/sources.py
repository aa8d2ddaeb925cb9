"""The stages that are spoiled: the bundled scenes, small, and three as somebody else would author them."""

import random
import shutil
from pathlib import Path

from pxr import Sdf

from warpmag.scenes_usd import balls_up, crystal_balls, falling_magnet, sakura_tree

from .hostile import texture

DRAWN = "drawn.usda"
"""Name of the stage with a texture, which is also drawn."""
STRANGE = [Path(__file__).with_name(name) for name in ("workshop.usda", "laboratory.usda", "studio.usda")]


def author(folder: Path) -> list[Path]:
    """Write small scenes of each kind into a folder; return their files."""
    folder.mkdir(parents=True, exist_ok=True)
    small = {
        balls_up: {"columns": 2, "rows": 1, "layers": 1},
        falling_magnet: {"balls": 3, "layers": 1},
        crystal_balls: {"columns": 4, "rows": 3, "bar": 2, "bar_rows": 1},
        sakura_tree: {"balls": 8, "branches": 3},
    }
    paths = []
    for scene, options in small.items():
        paths.append(folder / f"{scene.__name__.rpartition('.')[2]}.usda")
        scene.author(paths[-1], **options)
    return [*paths, *(Path(shutil.copyfile(stage, folder / stage.name)) for stage in STRANGE)]


def author_others(folder: Path) -> list[Path]:
    """Write sound stages that need kernels which only mutants need else; return their files."""
    folder.mkdir(parents=True, exist_ok=True)
    paths = [folder / name for name in ("multipole.usda", "box.usda", DRAWN)]
    for path in paths:
        balls_up.author(path, columns=2, rows=1, layers=1, conductivity=0.0)  # which only balls have
        layer = Sdf.Layer.FindOrOpen(str(path))
        if path.stem == "box":
            layer.GetPrimAtPath("/World/Balls/Ball_0000").typeName = "Cube"
        elif path.name == DRAWN:
            texture(layer, [Sdf.Path("/World/Balls/Ball_0000")], random.Random(0))
        else:
            layer.GetAttributeAtPath("/World/PhysicsScene.warpmag:contactModel").default = "multipole"
        layer.Save()
    return paths
