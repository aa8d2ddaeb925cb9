"""From a USD stage to a Newton builder whose shapes carry the stage's magnets."""

import os
from dataclasses import dataclass

import newton
import numpy as np
import warp as wp

from warpmag.engine.attributes import magnet_shapes, mark_shape, register_attributes
from warpmag.errors import InputError
from warpmag.magnets import Magnet, StageMagnets
from warpmag.usd import StageClock, open_stage, read_magnets, refusals, stage_clock


@dataclass(frozen=True)
class ImportedScene:
    """A stage as Newton sees it.

    Attributes:
        stage: The open stage, for a :class:`warpmag.usd.CacheWriter`.
        builder: Bodies, shapes and joints; world frame and units are the stage's.
        clock: How time runs on the stage.
        magnets: What the stage says about magnets.
        bodies: Body of each rigid-body prim.
        magnet_shapes: Shapes of each magnet prim.
    """

    stage: object
    builder: newton.ModelBuilder
    clock: StageClock
    magnets: StageMagnets
    bodies: dict[str, int]
    magnet_shapes: dict[str, list[int]]


def import_scene(path: str | os.PathLike, *, visuals: bool = False, time_code: float | None = None) -> ImportedScene:
    """Read a stage and everything magnetic on it.

    Args:
        path: USD file.
        visuals: Also import what is only seen, for a viewer.
        time_code: The moment at which bodies stand; by default the start of the stage.

    Raises:
        InputError: The stage cannot be read, or a magnet of it became no shape.
    """
    stage = open_stage(path, time_code)
    magnets = read_magnets(stage)
    clock = stage_clock(stage)
    builder = newton.ModelBuilder()
    register_attributes(builder)
    with refusals(str(path), "import"):
        found = builder.add_usd(stage, apply_up_axis_from_stage=True, load_visual_shapes=visuals)
    _let_frictionless_roll(builder)
    bodies, shapes = found["path_body_map"], found["path_shape_map"]
    covered = {}
    for prim, magnet in magnets.magnets.items():
        if prim in bodies:
            covered[prim] = magnet_shapes(builder, bodies[prim])
        elif prim in shapes:
            covered[prim] = magnet_shapes(builder, -1, shapes[prim])
        else:
            raise InputError(f"{prim}: a magnet of which Newton imported neither body nor shape")
        for shape in covered[prim]:
            turn = builder.shape_transform[shape].q if prim in bodies else _axis_turn(stage, prim)
            mark_shape(builder, shape, _in_shape_frame(magnet, turn))
    return ImportedScene(stage, builder, clock, magnets, bodies, covered)


def _in_shape_frame(magnet: Magnet, turn: wp.quat) -> Magnet:
    """Return ``magnet`` with its magnetization in the frame of a shape that is turned by ``turn`` from the prim's."""
    if not np.any(magnet.magnetization):
        return magnet
    turned = wp.quat_rotate_inv(turn, wp.vec3(*magnet.magnetization))
    return Magnet(magnet.kind, magnetization=tuple(turned), moment_spacing=magnet.moment_spacing)


def _axis_turn(stage, prim: str):
    """Return how Newton turns the frame of a capsule, cylinder or cone prim, whose axis it puts along z."""
    axis = stage.GetPrimAtPath(prim).GetAttribute("axis")
    value = axis.Get() if axis else None
    return newton.math.quat_between_axes(newton.Axis.Z, newton.Axis.from_any(value)) if value else wp.quat_identity()


def _let_frictionless_roll(builder: newton.ModelBuilder) -> None:
    """Take Newton's default torsional and rolling friction, which USD does not know, from shapes without friction."""
    default = builder.default_shape_cfg
    for values, given in (
        (builder.shape_material_mu_torsional, default.mu_torsional),
        (builder.shape_material_mu_rolling, default.mu_rolling),
    ):
        for shape, mu in enumerate(builder.shape_material_mu):
            if mu == 0.0 and values[shape] == given:
                values[shape] = 0.0
