"""Makes ``docs/tutorials/desk.usdc``, the artist's file of a tutorial, with Blender: ``PYTHON -P docs/make_desk.py``.

``PYTHON`` is one with ``bpy``, as described in ``docs/pictures.md``. The file holds a desk, five nuts and a disc that
is animated to come down to the nuts and to go up again. It holds no physics.
"""

import math
from pathlib import Path

import bpy  # pyright: ignore[reportMissingImports] - Blender as a module

FILE = Path(__file__).parent / "tutorials" / "desk.usdc"
NUTS = (
    (0.0, 0.0),
    (0.022, 0.004),
    (-0.02, 0.012),
    (0.006, -0.022),
    (-0.012, -0.018),
)  # m
POSES = {1: 0.09, 24: 0.024, 36: 0.024, 60: 0.09}  # frame: height of the disc [m]


def material(name, color, metallic, roughness):
    """Return a new material."""
    new = bpy.data.materials.new(name)
    new.use_nodes = True
    values = new.node_tree.nodes["Principled BSDF"].inputs
    values["Base Color"].default_value = (*color, 1.0)
    values["Metallic"].default_value, values["Roughness"].default_value = (
        metallic,
        roughness,
    )
    return new


def add(name, look, location):
    """Name the active object, apply its scale, and place it."""
    item = bpy.context.object
    item.name = item.data.name = name
    bpy.ops.object.transform_apply(scale=True, rotation=False, location=False)
    item.location = location
    item.data.materials.append(look)
    return item


def main():
    """Build the scene and export it."""
    bpy.ops.wm.read_factory_settings(use_empty=True)
    wood, steel, red = (
        material("Wood", (0.35, 0.2, 0.1), 0.0, 0.6),
        material("Steel", (0.6, 0.6, 0.62), 1.0, 0.3),
        material("Red", (0.7, 0.05, 0.04), 0.0, 0.4),
    )
    bpy.ops.mesh.primitive_cube_add(size=1.0, scale=(0.3, 0.2, 0.02))
    add("Desk", wood, (0.0, 0.0, -0.01))
    for number, (x, y) in enumerate(NUTS, 1):
        bpy.ops.mesh.primitive_cylinder_add(vertices=6, radius=0.007, depth=0.005)
        add(f"Nut_{number}", steel, (x, y, 0.0025))
    bpy.ops.mesh.primitive_cylinder_add(vertices=48, radius=0.012, depth=0.008)
    disc = add("Disc", red, (0.0, 0.0, POSES[1]))
    for frame, height in POSES.items():
        disc.location.z = height
        disc.keyframe_insert("location", frame=frame)
    bpy.ops.object.camera_add(
        location=(0.2, -0.275, 0.205),
        rotation=(math.radians(63.0), 0.0, math.radians(36.0)),
    )
    scene = bpy.context.scene
    scene.camera = bpy.context.object
    scene.frame_start, scene.frame_end, scene.render.fps = 1, 60, 24
    bpy.ops.wm.usd_export(filepath=str(FILE), export_animation=True)


if __name__ == "__main__":
    main()
