"""Draws a stage with Blender's path tracer: ``python -P blender.py STAGE OUTPUT FRAME SAMPLES WIDTH HEIGHT``.

A process of its own runs this file, which imports nothing of warpmag: Blender brings a USD that cannot live beside
another one. It prints one line where it cannot draw.
"""

import sys


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
    scene = bpy.context.scene
    cameras = [one for one in bpy.data.objects if one.type == "CAMERA"]
    if not cameras:
        return "the stage has no camera"
    scene.camera = cameras[0]
    scene.frame_set(frame)
    scene.render.engine = "CYCLES"
    scene.cycles.samples, scene.cycles.use_denoising = samples, True
    scene.render.resolution_x, scene.render.resolution_y, scene.render.resolution_percentage = width, height, 100
    scene.render.use_motion_blur = False
    scene.render.filepath = output
    scene.render.image_settings.file_format = "JPEG" if output.endswith((".jpg", ".jpeg")) else "PNG"
    bpy.ops.render.render(write_still=True)
    return ""


if __name__ == "__main__":
    sys.exit(draw(sys.argv[1], sys.argv[2], *map(int, sys.argv[3:7])) or 0)
