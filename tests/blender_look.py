"""Opens a stage in Blender as a module and prints what is there; ``python blender_look.py STAGE PICTURE``."""

import json
import sys

import bpy


def places(scene, frame):
    """Where instances are at a frame."""
    scene.frame_set(frame)
    shown = bpy.context.evaluated_depsgraph_get().object_instances
    return [list(one.matrix_world.translation) for one in shown if one.is_instance]


def brightness(path):
    """Mean of a picture's colours, as it is stored."""
    image = bpy.data.images.load(path)
    image.colorspace_settings.name = "Non-Color"
    pixels = list(image.pixels)
    return sum(value for number, value in enumerate(pixels) if number % 4 != 3) / (0.75 * len(pixels))


def main(stage, picture):
    """Look at all of it."""
    bpy.ops.wm.read_factory_settings()
    for one in list(bpy.data.objects):
        bpy.data.objects.remove(one)
    bpy.ops.wm.usd_import(filepath=stage)
    scene, objects = bpy.context.scene, list(bpy.data.objects)
    cameras = [one for one in objects if one.type == "CAMERA"]
    meshes = [one for one in objects if one.type == "MESH"]
    found = {
        "range": [scene.frame_start, scene.frame_end],
        "unit": scene.unit_settings.scale_length,
        "camera": len(cameras),
        "lights": sum(one.type == "LIGHT" for one in objects),
        "without_material": [one.name for one in meshes if not (one.material_slots and one.material_slots[0].material)],
        "first": places(scene, scene.frame_start),
        "last": places(scene, scene.frame_end),
    }
    scene.camera = cameras[0]
    scene.render.engine = "CYCLES"
    scene.cycles.samples = 8
    scene.render.resolution_x, scene.render.resolution_y, scene.render.resolution_percentage = 160, 90, 100
    scene.render.filepath = picture
    bpy.ops.render.render(write_still=True)
    found["brightness"] = brightness(picture)
    print(json.dumps(found))


if __name__ == "__main__":
    main(*sys.argv[1:])
