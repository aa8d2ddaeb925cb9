"""Makes a stage of a model that comes from a builder, so that its run can be written and drawn."""

from typing import Any

import newton
import numpy as np

from warpmag.declarations.attributes import NAMESPACE
from warpmag.declarations.coils import Coil, SourceRecord
from warpmag.declarations.keys import SceneKeys
from warpmag.declarations.magnets import MagneticSettings, StageMagnets
from warpmag.engine.magnets.attributes import marked_shapes
from warpmag.engine.stepping.builder_joints import stage_joints
from warpmag.engine.stepping.scene import ImportedScene
from warpmag.errors import InputError
from warpmag.usd import ModelStage, StageBody, StageShape, stage_clock

_KINDS = {
    **{newton.GeoType[kind]: kind.lower() for kind in ("SPHERE", "BOX", "CAPSULE", "CYLINDER", "CONE", "PLANE")},
    **{newton.GeoType[kind]: "mesh" for kind in ("MESH", "CONVEX_MESH", "ELLIPSOID")},  # USD has no ellipsoids
}
_INFINITE_PLANE = 20.0
"""Edge of an infinite plane over the largest distance of a body from the origin."""


def builder_scene(
    builder: newton.ModelBuilder,
    model: newton.Model,
    state: newton.State,
    settings: MagneticSettings,
    frame_rate: float,
) -> ImportedScene:
    """Return a scene of the bodies, shapes and magnets of ``model`` at ``state``.

    A stage lacks joints of more than one axis, and passive springs. So it can be drawn and run, but is not resumed.

    Raises:
        InputError: A shape has a type that stages cannot have, such as a height field.
    """
    gravity = model.gravity.numpy().reshape(-1, 3)[0].astype(float)
    made = ModelStage("XYZ"[int(model.up_axis)], gravity, settings, frame_rate)
    poses, flags = state.body_q.numpy(), model.body_flags.numpy()
    for body, label in enumerate(model.body_label):
        kinematic = bool(flags[body] & int(newton.BodyFlags.KINEMATIC))
        made.add_body(StageBody(label, poses[body], float(model.body_mass.numpy()[body]), kinematic))
    magnets = marked_shapes(model)
    shown = [shape for shape in range(model.shape_count) if shape in magnets or _is_visible(model, shape)]
    for shape in shown:
        made.add_shape(_stage_shape(model, shape, magnets.get(shape), float(np.abs(poses[:, :3]).max(initial=0.05))))
    paths = dict(zip(shown, made.shapes, strict=True))
    joints, warnings = stage_joints(model)
    for joint in joints:
        made.add_joint(joint)
    circuits = _add_sources(made, model)
    return ImportedScene(
        opened=made.stage,
        identical_balls=[],
        builder=builder,
        clock=stage_clock(made.stage),
        magnets=StageMagnets({paths[shape]: magnet for shape, magnet in magnets.items()}, settings),
        bodies=dict(zip(made.bodies, range(model.body_count), strict=True)),
        magnet_shapes={paths[shape]: [shape] for shape in magnets},
        circuits=circuits,
        keys=SceneKeys({}, {}, {}, {}),
        warnings=tuple(warnings),
    )


def _add_sources(made: ModelStage, model: newton.Model) -> dict[str, int]:
    """Add the coils and the field maps of a model to a stage; return the shapes of coils with a resistance by path."""
    circuits = {}
    attributes = getattr(model, NAMESPACE)
    strengths, voltages = attributes.strength.numpy(), attributes.voltage.numpy()
    for shape in [shape for shape, text in enumerate(attributes.source) if text]:
        source = SourceRecord.from_text(attributes.source[shape]).declared(
            float(strengths[shape]), float(voltages[shape])
        )
        body, pose = int(model.shape_body.numpy()[shape]), model.shape_transform.numpy()[shape]
        path = made.add_source(source, model.shape_label[shape], body, pose)
        if isinstance(source, Coil) and source.resistance:
            circuits[path] = shape
    return circuits


def _is_visible(model: newton.Model, shape: int) -> bool:
    """Return True for a shape that is drawn or collides; sites, such as those of coils, are not."""
    flags = int(model.shape_flags.numpy()[shape])
    return bool(flags & int(newton.ShapeFlags.VISIBLE | newton.ShapeFlags.COLLIDE_SHAPES)) and not (
        flags & int(newton.ShapeFlags.SITE)
    )


def _stage_shape(model: newton.Model, shape: int, magnet: Any, reach: float) -> StageShape:
    kind = newton.GeoType(model.shape_type.numpy()[shape])
    if kind not in _KINDS:
        raise InputError(f"{model.shape_label[shape]}: a {kind.name.lower()} cannot be written to a stage")
    scale = model.shape_scale.numpy()[shape].astype(float)
    points = triangles = None
    if _KINDS[kind] == "mesh":
        mesh: Any = model.shape_source[shape]
        if kind == newton.GeoType.ELLIPSOID:
            mesh = newton.Mesh.create_ellipsoid(1.0, 1.0, 1.0, compute_inertia=False)
        points, triangles = np.asarray(mesh.vertices) * scale, np.asarray(mesh.indices).reshape(-1, 3)
    elif _KINDS[kind] == "plane":
        scale = np.where(scale > 0.0, scale, _INFINITE_PLANE * reach)
    return StageShape(
        label=model.shape_label[shape],
        body=int(model.shape_body.numpy()[shape]),
        kind=_KINDS[kind],
        pose=model.shape_transform.numpy()[shape],
        size=tuple(scale.tolist()),
        collides=bool(model.shape_flags.numpy()[shape] & int(newton.ShapeFlags.COLLIDE_SHAPES)),
        magnet=magnet,
        points=points,
        triangles=triangles,
    )
