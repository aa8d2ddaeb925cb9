"""From a USD stage to a Newton builder whose shapes carry the stage's magnets."""

import os
from dataclasses import dataclass, replace
from functools import cached_property
from typing import Any

import newton
import numpy as np
import warp as wp

from warpmag.declarations.keys import Keys, SceneKeys
from warpmag.declarations.magnets import Magnet, StageMagnets
from warpmag.engine.magnets.attributes import declare_attributes, mark_shapes
from warpmag.engine.magnets.balls import copy_ball
from warpmag.engine.magnets.declared_magnets import axis_turn, in_shape_frame, magnet_shapes
from warpmag.engine.magnets.declared_sources import add_placed_source
from warpmag.engine.stepping.drawn import StageBuilder
from warpmag.errors import InputError
from warpmag.usd import (
    MOMENTS_PRIMVAR,
    BallFrames,
    BallInstancer,
    GroundedJoint,
    IdenticalBalls,
    StageClock,
    StageContents,
    ball_instancers,
    complete_instances,
    enabled_joints,
    give_densities,
    has_volume,
    inspect,
    newton_errors,
    open_deferred,
    prepare_joints,
    shape_axis,
    usd_errors,
)


@dataclass(frozen=True)
class ImportedScene:
    """A stage as Newton sees it.

    Attributes:
        opened: The open stage as it was read, without prims for instances that are like others.
        apart: Those instances.
        builder: Bodies, shapes and joints; world frame and units are the stage's.
        clock: How time runs on the stage.
        magnets: What the stage says about magnets.
        bodies: Body of each rigid-body prim.
        magnet_shapes: Shapes of each magnet prim.
        keys: What follows time samples.
        warnings: What the user should know about the stage, a line each.
    """

    opened: Any
    apart: list[IdenticalBalls]
    builder: newton.ModelBuilder
    clock: StageClock
    magnets: StageMagnets
    bodies: dict[str, int]
    magnet_shapes: dict[str, list[int]]
    keys: SceneKeys
    warnings: tuple[str, ...]

    @cached_property
    def stage(self) -> Any:
        """The open stage with a prim for each body but those of :attr:`swarms`."""
        complete_instances([one for one in self.apart if not one.stays_instancer])
        return self.opened

    @cached_property
    def swarms(self) -> list[BallInstancer]:
        """Instancers that hold too many bodies for prims."""
        return ball_instancers(self.opened, self.apart)


def import_scene(
    path: str | os.PathLike,
    *,
    visuals: bool = False,
    time_code: float | None = None,
    articulations: bool = False,
) -> ImportedScene:
    """Read a stage and everything magnetic on it.

    Args:
        path: USD file.
        visuals: Also import what is only seen, for a viewer.
        time_code: The moment at which bodies stand; by default the start of the stage.
        articulations: Whether joints are wanted in trees, as solvers of generalized coordinates take them.

    Raises:
        InputError: The stage cannot be read, or Newton imports a body, a joint or a magnet of it as nothing.
    """
    with usd_errors(str(path)):
        return _import(path, visuals, time_code, articulations)


def _import(path: str | os.PathLike, visuals: bool, time_code: float | None, articulations: bool) -> ImportedScene:
    stage, apart = open_deferred(path, time_code)
    report = inspect(stage, path)
    if report.errors:
        raise InputError(str(report.errors[0]))
    clock, contents = report.clock, report.contents
    assert clock is not None, "a clock that is wrong is a reason to refuse"
    grounded = prepare_joints(stage, articulations=articulations)
    give_densities(stage, contents.magnets)
    builder = StageBuilder()
    declare_attributes(builder)
    found = _add_stage(builder, stage, path, visuals)
    _let_frictionless_roll(builder)
    bodies, shapes, joints = found["path_body_map"], found["path_shape_map"], found["path_joint_map"]
    for prim in contents.bodies:
        if prim not in bodies:
            raise InputError(f"{prim}: Newton imports no body from it")
    _check_masses(builder, stage, contents, bodies)
    for joint in enabled_joints(stage):
        if str(joint.GetPath()) not in joints:
            raise InputError(f"{joint.GetPath()}: Newton imports no joint from it")
    for joint in grounded:
        _place_on_ground(builder, joint, joints[joint.path], bodies[joint.moving], shapes)
    covered = _mark_magnets(builder, stage, contents.magnets, bodies, shapes)
    currents = _add_sources(builder, contents.sources, bodies)
    magnets = StageMagnets(contents.magnets, contents.settings, contents.initial_moments)
    keys = _scene_keys(builder, stage, contents, clock, bodies, covered, currents)
    for balls in apart:
        _copy_balls(builder, stage, balls, bodies, covered, magnets)
    return ImportedScene(
        opened=stage,
        apart=apart,
        builder=builder,
        clock=clock,
        magnets=magnets,
        bodies=bodies,
        magnet_shapes=covered,
        keys=keys,
        warnings=tuple(map(str, report.warnings)),
    )


def _check_masses(builder: newton.ModelBuilder, stage, contents, bodies: dict[str, int]) -> None:
    """Refuse free bodies with a volume that Newton gives no mass, of an open mesh, say: they would stand still."""
    for path in contents.bodies:
        free = path not in contents.kinematic
        if free and not builder.body_mass[bodies[path]] > 0.0 and has_volume(stage, path):
            raise InputError(f"{path}: Newton finds no mass of its colliders: close their meshes, or give physics:mass")


def _add_stage(builder: newton.ModelBuilder, stage, path: str | os.PathLike, visuals: bool) -> dict[str, Any]:
    """Let Newton import ``stage``; return which prim became what."""
    with newton_errors(str(path), "import"):
        return builder.add_usd(
            stage, apply_up_axis_from_stage=True, load_visual_shapes=visuals, only_load_enabled_rigid_bodies=True
        )


def _copy_balls(
    builder: newton.ModelBuilder,
    stage,
    balls: IdenticalBalls,
    bodies: dict[str, int],
    covered: dict[str, list[int]],
    magnets: StageMagnets,
) -> None:
    """Copy what Newton has made of the first of balls that are alike, and what is known of its magnet."""
    first, others = balls.bodies()
    body = bodies[first]
    frames = BallFrames(stage, balls, np.array(builder.body_q[body], float)[3:])
    speeds = frames.velocities(balls.arrays, np.array(builder.body_qd[body], float))
    added = copy_ball(builder, body, frames.poses(balls.arrays)[1:], speeds[1:], first, others)
    bodies |= dict(zip(others, added.bodies, strict=True))
    moments = balls.arrays[MOMENTS_PRIMVAR]
    for prim in [one for one in covered if one == first or one.startswith(f"{first}/")]:
        own = balls.copies_of(prim)
        covered |= zip(own, ([shape] for shape in added.shapes), strict=True)
        magnets.magnets.update(dict.fromkeys(own, magnets.magnets[prim]))
        if prim in magnets.initial_moments:
            each = moments[1:].astype(float).tolist() if len(moments) else [magnets.initial_moments[prim]] * len(own)
            magnets.initial_moments.update({path: (x, y, z) for path, (x, y, z) in zip(own, each, strict=True)})


def _place_on_ground(
    builder: newton.ModelBuilder, joint: GroundedJoint, number: int, body: int, shapes: dict[str, int]
) -> None:
    """Put right what Newton makes of a joint to something that does not move.

    It takes the fixed end for one that lies where the body's end is, which a distance joint need not do, the frame of
    a fixed prim for that of the world, and ``body0`` for the end that is fixed.
    """
    kind = builder.joint_type[number]
    if joint.fixed or kind == newton.JointType.DISTANCE:
        builder.joint_X_p[number] = wp.transform(joint.position, joint.rotation)
    if joint.reversed and kind in (newton.JointType.REVOLUTE, newton.JointType.PRISMATIC):
        axis = builder.joint_qd_start[number]
        lower, upper = builder.joint_limit_lower[axis], builder.joint_limit_upper[axis]
        builder.joint_limit_lower[axis], builder.joint_limit_upper[axis] = -upper, -lower
        builder.joint_target_qd[axis] *= -1.0
        builder.joint_target_q[builder.joint_q_start[number]] *= -1.0
    if joint.fixed and not joint.collides:
        for prim, shape in shapes.items():
            if prim == joint.fixed or prim.startswith(f"{joint.fixed}/"):
                for other in builder.body_shapes[body]:
                    builder.add_shape_collision_filter_pair(shape, other)


def _mark_magnets(
    builder: StageBuilder, stage, magnets: dict[str, Magnet], bodies: dict[str, int], shapes: dict[str, int]
) -> dict[str, list[int]]:
    """Let the shapes of the magnet prims carry the magnets; return the shapes of each prim."""
    covered = {}
    for prim, magnet in magnets.items():
        if prim in bodies:
            covered[prim] = magnet_shapes(builder, bodies[prim])
        elif prim in shapes:
            covered[prim] = magnet_shapes(builder, -1, shapes[prim])
        else:
            raise InputError(f"{prim}: a magnet of which Newton imported neither body nor shape")
        covered[prim] = builder.as_drawn(covered[prim])
        for shape in covered[prim]:
            turn = _shape_turn(builder, stage, prim, shape, bodies)
            mark_shapes(builder, [shape], in_shape_frame(magnet, turn))
    return covered


def _scene_keys(
    builder, stage, contents: StageContents, clock: StageClock, bodies, covered, currents: dict[int, Keys]
) -> SceneKeys:
    """Return what follows time samples, in seconds and in Newton's words."""

    def in_seconds(keys):
        return keys.in_seconds(clock.start, clock.time_codes_per_second)

    def turned_back(keys: Keys, prim: str, shape: int) -> Keys:
        turn = np.array(wp.quat_to_matrix(_shape_turn(builder, stage, prim, shape, bodies))).reshape(3, 3)
        return replace(keys, values=keys.values @ turn)

    motions = {bodies[prim]: in_seconds(motion) for prim, motion in contents.motions.items()}
    magnetizations = {
        shape: turned_back(in_seconds(keys), prim, shape)
        for prim, keys in contents.magnetization_keys.items()
        for shape in covered[prim]
    }
    currents = {shape: in_seconds(keys) for shape, keys in currents.items()}
    return SceneKeys(motions, magnetizations, currents, contents.field_keys and in_seconds(contents.field_keys))


def _shape_turn(builder, stage, prim: str, shape: int, bodies: dict[str, int]) -> Any:
    """Return how the frame of a shape is turned from that of the magnet prim that it belongs to."""
    return builder.shape_transform[shape].q if prim in bodies else axis_turn(shape_axis(stage, prim))


def _add_sources(builder: newton.ModelBuilder, sources, bodies: dict[str, int]) -> dict[int, Keys]:
    """Put coils and field maps of a stage on their bodies, or into the world, labelled with the paths of their prims.

    Returns:
        Keys of the currents of those coils that have some, by the shape that stands for the coil.
    """
    currents = {}
    for one in (one for placed in sources.values() for one in placed):
        body = -1 if one.body is None else bodies[one.body]
        shape = add_placed_source(builder, one, body, wp.transform(one.position, one.rotation))
        if one.currents is not None:
            currents[shape] = one.currents
    return currents


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
