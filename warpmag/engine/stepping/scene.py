"""Imports a USD stage as a Newton builder with the magnets of the stage."""

import math
import os
from dataclasses import dataclass, replace
from functools import cached_property
from typing import Any

import newton
import numpy as np
import warp as wp

from warpmag.declarations.coils import Coil
from warpmag.declarations.keys import Keys, SceneKeys
from warpmag.declarations.magnets import Magnet, StageMagnets
from warpmag.engine.magnets.attributes import declare_attributes, mark_shapes
from warpmag.engine.magnets.balls import copy_ball
from warpmag.engine.magnets.declared_magnets import axis_rotation, in_shape_frame, magnet_shapes
from warpmag.engine.magnets.declared_sources import add_placed_source
from warpmag.engine.newton_versions import reverse_targets
from warpmag.engine.stepping.replaced_meshes import StageBuilder
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
    enabled_joint_paths,
    give_densities,
    has_volume,
    inspect,
    newton_errors,
    open_deferred,
    prepare_joints,
    shape_axis,
    triangulate_concave_faces,
    usd_errors,
)


@dataclass(frozen=True)
class ImportedScene:
    """An imported stage."""

    opened: Any  # the open stage, without prims for instances of identical balls
    identical_balls: list[IdenticalBalls]
    builder: newton.ModelBuilder  # bodies, shapes and joints, in the world frame and the units of the stage
    clock: StageClock
    magnets: StageMagnets
    bodies: dict[str, int]  # body of each rigid-body prim
    magnet_shapes: dict[str, list[int]]  # shapes of each magnet prim
    circuits: dict[str, int]  # shape of each coil prim with a resistance
    keys: SceneKeys  # keys from time samples
    warnings: tuple[str, ...]  # warnings about the stage, one line each

    @cached_property
    def stage(self) -> Any:
        """The open stage with a prim for each body, except for bodies of :attr:`swarms`."""
        complete_instances([balls for balls in self.identical_balls if not balls.stays_instancer])
        return self.opened

    @cached_property
    def swarms(self) -> list[BallInstancer]:
        """Instancers with too many bodies to have prims."""
        return ball_instancers(self.opened, self.identical_balls)


def import_scene(
    path: str | os.PathLike, *, visuals: bool = False, time_code: float | None = None, articulations: bool = False
) -> ImportedScene:
    """Import a stage with its magnets.

    Args:
        path: USD file.
        visuals: Also import visual shapes that do not collide, for a viewer.
        time_code: Time code of the poses of bodies; by default the start of the stage.
        articulations: Keep articulations, for solvers in generalized coordinates.

    Raises:
        InputError: The stage cannot be read, or Newton does not import one of its bodies, joints or magnets.
    """
    with usd_errors(str(path)):
        return _import(path, visuals, time_code, articulations)


def _import(path: str | os.PathLike, visuals: bool, time_code: float | None, articulations: bool) -> ImportedScene:
    stage, identical_balls = open_deferred(path, time_code)
    report = inspect(stage, path)
    if report.errors:
        raise InputError(str(report.errors[0]))
    clock, contents = report.clock, report.contents
    assert clock is not None, "an invalid clock is an error of the report"
    grounded = prepare_joints(stage, articulations=articulations)
    give_densities(stage, contents.magnets)
    triangulate_concave_faces(stage, visuals=visuals)
    builder = StageBuilder()
    declare_attributes(builder)
    with newton_errors(str(path), "import"):
        imported = builder.add_usd(
            stage, apply_up_axis_from_stage=True, load_visual_shapes=visuals, only_load_enabled_rigid_bodies=True
        )
    _remove_default_rolling_friction(builder)
    bodies, shapes, joints = (imported[f"path_{kind}_map"] for kind in ("body", "shape", "joint"))
    for prim in contents.bodies:
        if prim not in bodies:
            raise InputError(f"{prim}: Newton does not import this body")
    _check_masses(builder, stage, contents, bodies)
    _check_colors(builder)
    for prim in enabled_joint_paths(stage):
        if prim not in joints:
            raise InputError(f"{prim}: Newton does not import this joint")
    for joint in grounded:
        _correct_grounded_joint(builder, joint, joints[joint.path], bodies[joint.moving], shapes)
    shapes_of_magnets = _mark_magnets(builder, stage, contents.magnets, bodies, shapes)
    drives, circuits = _add_sources(builder, contents.sources, bodies)
    magnets = StageMagnets(contents.magnets, contents.settings, contents.initial_moments)
    keys = _scene_keys(builder, stage, contents, clock, bodies, shapes_of_magnets, drives)
    for balls in identical_balls:
        _copy_balls(builder, stage, balls, bodies, shapes_of_magnets, magnets)
    warnings = tuple(map(str, report.warnings))
    return ImportedScene(
        stage, identical_balls, builder, clock, magnets, bodies, shapes_of_magnets, circuits, keys, warnings
    )


def _check_masses(builder: newton.ModelBuilder, stage, contents, bodies: dict[str, int]) -> None:
    """Raise :class:`InputError` if a free body cannot move: it has a volume but no mass, for example an open mesh."""
    for path in contents.bodies:
        free = path not in contents.kinematic
        if free and not builder.body_mass[bodies[path]] > 0.0 and has_volume(stage, path):
            raise InputError(f"{path}: its colliders have no mass: close their meshes, or author physics:mass")


def _check_colors(builder: newton.ModelBuilder) -> None:
    """Raise :class:`InputError` if a color that Newton finds for a shape is not finite: pictures would be none."""
    for label, color in zip(builder.shape_label, builder.shape_color, strict=True):
        if not all(map(math.isfinite, color)):
            raise InputError(f"{label}: color must be finite, got {tuple(color)}")


def _copy_balls(
    builder: newton.ModelBuilder, stage, balls: IdenticalBalls, bodies, shapes_of_magnets, magnets: StageMagnets
) -> None:
    """Copy the body, the shapes and the magnet of the first of several identical balls for the others."""
    first, others = balls.bodies()
    body = bodies[first]
    frames = BallFrames(stage, balls, np.array(builder.body_q[body], float)[3:])
    velocities = frames.velocities(balls.arrays, np.array(builder.body_qd[body], float))
    added = copy_ball(builder, body, frames.poses(balls.arrays)[1:], velocities[1:], first, others)
    bodies |= dict(zip(others, added.bodies, strict=True))
    moments = balls.arrays[MOMENTS_PRIMVAR]
    for prim in [path for path in shapes_of_magnets if path == first or path.startswith(f"{first}/")]:
        copies = balls.copies_of(prim)
        shapes_of_magnets |= zip(copies, ([shape] for shape in added.shapes), strict=True)
        magnets.magnets.update(dict.fromkeys(copies, magnets.magnets[prim]))
        if prim in magnets.initial_moments:
            own = moments[1:].astype(float).tolist() if len(moments) else [magnets.initial_moments[prim]] * len(copies)
            magnets.initial_moments.update((path, (x, y, z)) for path, (x, y, z) in zip(copies, own, strict=True))


def _correct_grounded_joint(
    builder: newton.ModelBuilder, joint: GroundedJoint, index: int, body: int, shapes: dict[str, int]
) -> None:
    """Correct Newton's import of a joint between a body and a fixed prim or the world.

    Newton assumes that the fixed end is at the body's end, which is wrong for a distance joint. It also assumes that
    the frame of a fixed prim is the world's, and that ``body0`` is the fixed end.
    """
    kind = builder.joint_type[index]
    if joint.fixed or kind == newton.JointType.DISTANCE:
        builder.joint_X_p[index] = wp.transform(joint.position, joint.rotation)
    if joint.reversed and kind in (newton.JointType.REVOLUTE, newton.JointType.PRISMATIC):
        axis = builder.joint_qd_start[index]
        lower, upper = builder.joint_limit_lower[axis], builder.joint_limit_upper[axis]
        builder.joint_limit_lower[axis], builder.joint_limit_upper[axis] = -upper, -lower
        reverse_targets(builder, index, axis)
    if joint.fixed and not joint.collides:
        for prim, shape in shapes.items():
            if prim == joint.fixed or prim.startswith(f"{joint.fixed}/"):
                for other in builder.body_shapes[body]:
                    builder.add_shape_collision_filter_pair(shape, other)


def _mark_magnets(
    builder: StageBuilder, stage, magnets: dict[str, Magnet], bodies: dict[str, int], shapes: dict[str, int]
) -> dict[str, list[int]]:
    """Mark the shapes of the magnet prims as magnets; return the shapes of each prim."""
    shapes_of_magnets = {}
    for prim, magnet in magnets.items():
        if prim in bodies:
            shapes_of_magnets[prim] = magnet_shapes(builder, body=bodies[prim])
        elif prim in shapes:
            shapes_of_magnets[prim] = magnet_shapes(builder, shape=shapes[prim])
        else:
            raise InputError(f"{prim}: Newton imports neither body nor shape of this magnet")
        shapes_of_magnets[prim] = builder.with_original_meshes(shapes_of_magnets[prim])
        for shape in shapes_of_magnets[prim]:
            rotation = _shape_rotation(builder, stage, prim, shape, bodies)
            mark_shapes(builder, [shape], in_shape_frame(magnet, rotation))
    return shapes_of_magnets


def _scene_keys(
    builder, stage, contents: StageContents, clock: StageClock, bodies, shapes_of_magnets, drives
) -> SceneKeys:
    """Return the keys of the stage, with times in seconds, by Newton's bodies and shapes."""

    def in_seconds(keys):
        return keys.in_seconds(clock.start, clock.time_codes_per_second)

    def in_shape(keys: Keys, prim: str, shape: int) -> Keys:
        rotation = np.array(wp.quat_to_matrix(_shape_rotation(builder, stage, prim, shape, bodies))).reshape(3, 3)
        return replace(keys, values=keys.values @ rotation)

    motions = {bodies[prim]: in_seconds(motion) for prim, motion in contents.motions.items()}
    magnetizations = {
        shape: in_shape(in_seconds(keys), prim, shape)
        for prim, keys in contents.magnetization_keys.items()
        for shape in shapes_of_magnets[prim]
    }
    currents, voltages = ({shape: in_seconds(keys) for shape, keys in drive.items()} for drive in drives)
    field = contents.field_keys and in_seconds(contents.field_keys)
    return SceneKeys(motions, magnetizations, currents, voltages, field)


def _shape_rotation(builder, stage, prim: str, shape: int, bodies: dict[str, int]) -> Any:
    """Return the rotation from a shape's frame to the frame of its magnet prim."""
    return builder.shape_transform[shape].q if prim in bodies else axis_rotation(shape_axis(stage, prim))


def _add_sources(
    builder: newton.ModelBuilder, sources, bodies: dict[str, int]
) -> tuple[tuple[dict[int, Keys], dict[int, Keys]], dict[str, int]]:
    """Add the coils and field maps of a stage to the builder.

    Return the keys of currents and of voltages by shape, and the shapes of coils with a resistance by prim.
    """
    currents, voltages, circuits = {}, {}, {}
    for source in (source for placed in sources.values() for source in placed):
        body = -1 if source.body is None else bodies[source.body]
        shape = add_placed_source(builder, source, body, wp.transform(source.position, source.rotation))
        driven = isinstance(source.source, Coil) and bool(source.source.resistance)
        if driven:
            circuits[source.prim] = shape
        if source.drive is not None:
            (voltages if driven else currents)[shape] = source.drive
    return (currents, voltages), circuits


def _remove_default_rolling_friction(builder: newton.ModelBuilder) -> None:
    """Remove Newton's default torsional and rolling friction, which USD does not have, from frictionless shapes."""
    default = builder.default_shape_cfg
    for values, default_value in (
        (builder.shape_material_mu_torsional, default.mu_torsional),
        (builder.shape_material_mu_rolling, default.mu_rolling),
    ):
        for shape, mu in enumerate(builder.shape_material_mu):
            if mu == 0.0 and values[shape] == default_value:
                values[shape] = 0.0
