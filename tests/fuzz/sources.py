"""The stages that are spoiled: the bundled scenes, small, and one as somebody else would author it."""

import shutil
from pathlib import Path

from warpmag.scenes_usd import balls_up, crystal_balls, falling_magnet, sakura_tree

WORKSHOP = Path(__file__).with_name("workshop.usda")


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
    paths.append(folder / WORKSHOP.name)
    shutil.copyfile(WORKSHOP, paths[-1])
    return paths
