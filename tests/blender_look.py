"""Opens a stage in Blender as a module and prints what is there; ``python blender_look.py STAGE PICTURE``."""

import json
import sys

import bpy


def places(scene, frame):
    """Where instances are at a frame."""
    scene.frame_set(frame)
    shown = bpy.context.evaluated_depsgraph_get().object_instances
    return [list(entry.matrix_world.translation) for entry in shown if entry.is_instance]


def brightness(path):
    """Mean of a picture's colours, as it is stored."""
    image = bpy.data.images.load(path)
    image.colorspace_settings.name = "Non-Color"
    pixels = list(image.pixels)
    return sum(value for number, value in enumerate(pixels) if number % 4 != 3) / (0.75 * len(pixels))


def main(stage, picture):
    """Look at all of it."""
    bpy.ops.wm.read_factory_settings()
    for entry in list(bpy.data.objects):
        bpy.data.objects.remove(entry)
    bpy.ops.wm.usd_import(filepath=stage)
    scene, objects = bpy.context.scene, list(bpy.data.objects)
    cameras = [entry for entry in objects if entry.type == "CAMERA"]
    meshes = [entry for entry in objects if entry.type == "MESH"]
    result = {
        "range": [scene.frame_start, scene.frame_end],
        "unit": scene.unit_settings.scale_length,
        "camera": len(cameras),
        "lights": sum(entry.type == "LIGHT" for entry in objects),
        "without_material": [
            entry.name for entry in meshes if not (entry.material_slots and entry.material_slots[0].material)
        ],
        "first": places(scene, scene.frame_start),
        "last": places(scene, scene.frame_end),
    }
    scene.camera = cameras[0]
    scene.render.engine = "CYCLES"
    scene.cycles.samples = 8
    scene.render.resolution_x, scene.render.resolution_y, scene.render.resolution_percentage = 160, 90, 100
    scene.render.filepath = picture
    bpy.ops.render.render(write_still=True)
    result["brightness"] = brightness(picture)
    print(json.dumps(result))


if __name__ == "__main__":
    main(*sys.argv[1:])
