"""USD arguments of the calls: prims and a stage, valid ones and others, and functions that author records."""

import inspect
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
from pxr import Usd, UsdGeom

from warpmag import usd
from warpmag.declarations.coils import Coil, FieldMap
from warpmag.declarations.magnets import Magnet, MagneticSettings

STAGE_FUNCTIONS = (
    *("author_magnet", "author_settings", "author_coil", "author_field_map", "magnet_of", "open_stage"),
    *("read_magnets", "triangulate_concave_faces"),
)
"""Public functions of ``warpmag.usd``."""
FOLDER = Path(__file__).parents[1]
STAGE = str(FOLDER / "workshop.usda")
INVALID_PRIMS = {"no_prim": Usd.Prim(), "lost_prim": Usd.Stage.CreateInMemory().DefinePrim("/Ball")}
"""Prims without a stage, for functions of prims alone: each access to them raises an error of USD."""
RECORDS: dict[type, Callable] = {
    Magnet: usd.author_magnet,
    MagneticSettings: usd.author_settings,
    Coil: usd.author_coil,
    FieldMap: usd.author_field_map,
}
"""Records that scripts make, and the functions that author them."""


def new_arguments() -> dict[str, Any]:
    """Return right arguments by name, with a prim in an instance, which cannot be authored."""
    stage = Usd.Stage.CreateInMemory()
    prim = UsdGeom.Sphere.Define(stage, "/World/Ball").GetPrim()
    copy = stage.DefinePrim("/Copy")
    copy.GetReferences().AddInternalReference("/World")
    copy.SetInstanceable(True)
    return {
        "prim": prim,
        "prim_stage": stage,
        "scene_stage": Usd.Stage.Open(STAGE),
        "magnet": Magnet("permanent", magnetization=(0.0, 0.0, 1e6)),
        "settings": MagneticSettings(),
        "loop": Coil(radius=0.01),
        "field_map": FieldMap((0.0,) * 3, (0.01,) * 3, np.ones((3, 3, 3, 3))),
        "root_prim": stage.GetPseudoRoot(),
        "prim_in_instance": stage.GetPrimAtPath("/Copy/Ball"),
    }


def authoring(record: type, prim: Usd.Prim) -> Callable:
    """Return a function that makes a record of its arguments, and authors it on a prim."""

    def author(**fields):
        RECORDS[record](prim, record(**fields))

    author.__signature__ = inspect.signature(record)
    return author
