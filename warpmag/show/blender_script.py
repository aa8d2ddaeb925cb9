"""Draws a stage with Blender's path tracer: ``python -P blender_script.py STAGE OUTPUT FRAME SAMPLES WIDTH HEIGHT``.

A child process runs this file, which imports nothing of warpmag: Blender loads its own USD library, and a process can
hold only one. If the stage cannot be drawn, it prints one line.
"""

import sys

_FEWEST = 3
"""Smallest number of bodies that the camera is zoomed to."""
_OUTSIDE, _MARGIN = 0.1, 1.65
"""Fraction of bodies ignored on each side, and width of the picture over the width of the remaining bodies."""


def draw(stage: str, output: str, frame: int, samples: int, width: int, height: int) -> str:
    """Draw a denoised frame of a stage for renderers; return the reason why it cannot be drawn, or an empty string.

    ``frame`` is a time code, ``samples`` are paths per pixel; the picture has ``width`` and ``height`` [px].
    """
    import bpy  # noqa: PLC0415  # pyright: ignore[reportMissingImports] - Blender as a module

    if not prepare(bpy, stage, frame, samples, width, height):
        return "the stage has no camera"
    render = bpy.context.scene.render
    render.filepath = output
    render.image_settings.file_format = "JPEG" if output.endswith((".jpg", ".jpeg")) else "PNG"
    bpy.ops.render.render(write_still=True)
    return ""


def prepare(bpy, stage: str, frame: int, samples: int, width: int, height: int) -> bool:
    """Open a stage for renderers and frame its bodies at a time code; return False if the stage has no camera."""
    bpy.ops.wm.read_factory_settings()
    for item in list(bpy.data.objects):
        bpy.data.objects.remove(item)
    bpy.ops.wm.usd_import(filepath=stage)
    _paint_curves(bpy)
    scene = bpy.context.scene
    cameras = [item for item in bpy.data.objects if item.type == "CAMERA"]
    if not cameras:
        return False
    scene.camera = cameras[0]
    scene.frame_set(frame)
    _frame_bodies(bpy, scene.camera, width / height)
    scene.view_settings.look = "AgX - Medium High Contrast"
    scene.render.engine = "CYCLES"
    scene.cycles.samples, scene.cycles.use_denoising = samples, True
    scene.render.resolution_x, scene.render.resolution_y, scene.render.resolution_percentage = width, height, 100
    scene.render.use_motion_blur = False
    return True


def _paint_curves(bpy) -> None:
    """Make materials for curves from their attribute ``displayColor``: the importer drops the materials of curves."""
    for item in bpy.data.objects:
        bare = item.type == "CURVES" and not item.data.materials
        color = item.data.attributes.get("displayColor") if bare else None
        if color:
            material = bpy.data.materials.new(item.name)
            material.use_nodes = True
            material.node_tree.nodes["Principled BSDF"].inputs["Base Color"].default_value = color.data[0].color
            item.data.materials.append(material)


def _frame_bodies(bpy, camera, aspect: float) -> None:
    """Zoom and shift the lens to frame the bodies, without moving the camera."""
    # the frame spans the centers of the bodies, without the outermost tenth on each side, plus half the median size
    from mathutils import Vector  # noqa: PLC0415  # pyright: ignore[reportMissingImports] - of Blender

    to_camera = camera.matrix_world.inverted()
    boxes = []
    for item in bpy.context.evaluated_depsgraph_get().object_instances:
        if item.is_instance:
            corners = [to_camera @ (item.matrix_world @ Vector(corner)) for corner in item.object.bound_box]
            if all(corner.z < 0.0 for corner in corners):
                projected = [(corner.x / -corner.z, corner.y / -corner.z) for corner in corners]
                boxes.append([(min(values), max(values)) for values in zip(*projected, strict=True)])
    if len(boxes) < _FEWEST:
        return
    sides = []
    for spans in zip(*boxes, strict=True):
        ignored = int(_OUTSIDE * len(spans))
        centers = sorted(0.5 * (low + high) for low, high in spans)
        size = sorted(high - low for low, high in spans)[len(spans) // 2]
        sides.append((centers[ignored] - 0.5 * size, centers[-1 - ignored] + 0.5 * size))
    (left, right), (low, high) = sides
    lens = camera.data
    width = _MARGIN * max(right - left, aspect * (high - low), 1e-6)
    zoom = lens.sensor_width / width / lens.lens
    lens.lens *= zoom
    lens.dof.aperture_fstop *= zoom  # keeps the aperture itself, and with it the depth of field
    lens.shift_x, lens.shift_y = 0.5 * (left + right) / width, 0.5 * (low + high) / width


if __name__ == "__main__":
    sys.exit(draw(sys.argv[1], sys.argv[2], *map(int, sys.argv[3:7])) or 0)
