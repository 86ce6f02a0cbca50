"""Photographs a GLB file in Blender: run by a Python that has bpy, as `python in_blender.py REQUEST.json`.

Cycles, as it needs no graphics card, with a box as wide as a pixel for its filter; the view transform "Standard", which
shows sRGB as it is (Blender's default, AgX, is made for lit scenes).
"""

import json
import math
import sys

import bpy  # pyright: ignore[reportMissingImports]
from mathutils import Matrix  # pyright: ignore[reportMissingImports]

Z_UP = Matrix.Rotation(math.pi / 2, 4, "X")
"""What importing does to the axes of glTF."""

FROM_ABOVE = Matrix.Rotation(-0.6, 4, "X") @ Matrix.Rotation(0.6, 4, "Y")
"""From where light comes, as the camera sees it."""


def main(request):
    bpy.ops.wm.read_factory_settings(use_empty=True)
    bpy.ops.import_scene.gltf(filepath=request["file"])
    scene = bpy.context.scene
    render, cycles = scene.render, scene.cycles
    render.engine = "CYCLES"
    cycles.samples, cycles.max_bounces, cycles.pixel_filter_type = request["samples"], 0, "BOX"
    cycles.use_adaptive_sampling = cycles.use_denoising = False
    cycles.transparent_max_bounces = 8
    render.film_transparent = True
    render.threads_mode, render.threads = "FIXED", 1
    render.image_settings.file_format, render.image_settings.color_mode = "PNG", "RGBA"
    scene.view_settings.view_transform = "Standard"
    camera = bpy.data.objects.new("camera", bpy.data.cameras.new("camera"))
    scene.collection.objects.link(camera)
    scene.camera = camera
    lamp = bpy.data.objects.new("lamp", bpy.data.lights.new("lamp", "SUN"))  # that only lit materials see
    lamp.data.energy = 3.0
    scene.collection.objects.link(lamp)
    for view in request["views"]:
        width, height = view["width"], view["height"]
        fx, fy, cx, cy = view["intrinsics"]
        render.resolution_x, render.resolution_y, render.resolution_percentage = width, height, 100
        render.pixel_aspect_x, render.pixel_aspect_y = max(1.0, fy / fx), max(1.0, fx / fy)
        lens = camera.data
        lens.sensor_fit, lens.sensor_width, lens.lens = "HORIZONTAL", 36.0, 36 * fx / width
        lens.shift_x, lens.shift_y = (width / 2 - cx) / width, (cy - height / 2) / width * (fx / fy)
        lens.clip_start, lens.clip_end = view["near"], view["far"]
        pose = view["pose"]
        camera.matrix_world = Z_UP @ Matrix([pose[4 * row : 4 * row + 4] for row in range(4)])
        lamp.matrix_world = camera.matrix_world @ FROM_ABOVE
        render.filepath = view["picture"]
        bpy.ops.render.render(write_still=True)


if __name__ == "__main__":
    with open(sys.argv[1], encoding="utf-8") as file:
        main(json.load(file))
