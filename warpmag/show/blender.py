"""Draws a stage with Blender's path tracer: ``python -P blender.py STAGE OUTPUT FRAME SAMPLES WIDTH HEIGHT``.

A process of its own runs this file, which imports nothing of warpmag: Blender brings a USD that cannot live beside
another one. It prints one line where it cannot draw.
"""

import sys

_FEWEST = 3
_OUTSIDE, _MARGIN = 0.1, 1.65
"""Part of the bodies that may lie outside on each side, and the width of the picture over that of the others."""


def draw(stage: str, output: str, frame: int, samples: int, width: int, height: int) -> str:
    """Draw a frame, denoised; return why that cannot be done, or nothing.

    Args:
        stage: USD file for renderers, as ``warpmag export`` writes it.
        output: Picture to write.
        frame: Time code.
        samples: Paths per pixel.
        width: Width of the picture [px].
        height: Height of the picture [px].
    """
    import bpy  # noqa: PLC0415  # pyright: ignore[reportMissingImports] - Blender as a module

    bpy.ops.wm.read_factory_settings()
    for one in list(bpy.data.objects):
        bpy.data.objects.remove(one)
    bpy.ops.wm.usd_import(filepath=stage)
    _paint_curves(bpy)
    scene = bpy.context.scene
    cameras = [one for one in bpy.data.objects if one.type == "CAMERA"]
    if not cameras:
        return "the stage has no camera"
    scene.camera = cameras[0]
    scene.frame_set(frame)
    _frame_bodies(bpy, scene.camera, width / height)
    scene.view_settings.look = "AgX - Medium High Contrast"
    scene.render.engine = "CYCLES"
    scene.cycles.samples, scene.cycles.use_denoising = samples, True
    scene.render.resolution_x, scene.render.resolution_y, scene.render.resolution_percentage = width, height, 100
    scene.render.use_motion_blur = False
    scene.render.filepath = output
    scene.render.image_settings.file_format = "JPEG" if output.endswith((".jpg", ".jpeg")) else "PNG"
    bpy.ops.render.render(write_still=True)
    return ""


def _paint_curves(bpy) -> None:
    """Give curves their colour, which the importer leaves as an attribute, since it drops their materials."""
    for one in bpy.data.objects:
        color = one.data.attributes.get("displayColor") if one.type == "CURVES" and not one.data.materials else None
        if color:
            material = bpy.data.materials.new(one.name)
            material.use_nodes = True
            material.node_tree.nodes["Principled BSDF"].inputs["Base Color"].default_value = color.data[0].color
            one.data.materials.append(material)


def _frame_bodies(bpy, camera, aspect: float) -> None:
    """Zoom to what moves and shift the lens there, as an architect does; the camera stays where it is.

    Of the bodies those count whose middles lie, across and up, between the outermost tenths, and what a usual one takes
    on each side.
    """
    from mathutils import Vector  # noqa: PLC0415  # pyright: ignore[reportMissingImports] - of Blender

    back = camera.matrix_world.inverted()
    boxes = []
    for one in bpy.context.evaluated_depsgraph_get().object_instances:
        if one.is_instance:
            corners = [back @ (one.matrix_world @ Vector(corner)) for corner in one.object.bound_box]
            if all(corner.z < 0.0 for corner in corners):
                seen = [(corner.x / -corner.z, corner.y / -corner.z) for corner in corners]
                boxes.append([(min(values), max(values)) for values in zip(*seen, strict=True)])
    if len(boxes) < _FEWEST:
        return
    sides = []
    for own in zip(*boxes, strict=True):
        few = int(_OUTSIDE * len(own))
        middles = sorted(0.5 * (low + high) for low, high in own)
        size = sorted(high - low for low, high in own)[len(own) // 2]
        sides.append((middles[few] - 0.5 * size, middles[-1 - few] + 0.5 * size))
    (left, right), (low, high) = sides
    lens = camera.data
    width = _MARGIN * max(right - left, aspect * (high - low), 1e-6)
    zoom = lens.sensor_width / width / lens.lens
    lens.lens *= zoom
    lens.dof.aperture_fstop *= zoom  # the aperture itself stays, and with it the depth of field
    lens.shift_x, lens.shift_y = 0.5 * (left + right) / width, 0.5 * (low + high) / width


if __name__ == "__main__":
    sys.exit(draw(sys.argv[1], sys.argv[2], *map(int, sys.argv[3:7])) or 0)
