"""F12 in `blender -b`: all passes into a multilayer file, and the field among a cube by the compositor.

blender -b --python background.py -- PROJECT OUTPUT_FOLDER
"""

from __future__ import annotations

import math
import sys

import bpy

PACKAGE = "bl_ext.user_default.fieldwork"


def main() -> None:
    project, folder = sys.argv[sys.argv.index("--") + 1 :]
    bpy.ops.preferences.addon_enable(module=PACKAGE)
    scene = bpy.context.scene
    scene.fieldwork.project = project
    scene.fieldwork_live.source, scene.fieldwork_live.samples = "baked", 8
    render, layer = scene.render, scene.view_layers[0]
    render.engine, render.film_transparent = "FIELDWORK", True
    render.resolution_x, render.resolution_y, render.resolution_percentage = 120, 80, 100
    scene.camera.location, scene.camera.rotation_euler = (0, -2, 0), (math.pi / 2, 0, 0)
    layer.use_pass_z = layer.use_pass_position = layer.use_pass_normal = True
    layer.use_pass_cryptomatte_object = layer.use_pass_cryptomatte_material = True
    own = layer.fieldwork
    own.use_class_index = own.use_class_color = own.use_confidence = True
    image = render.image_settings
    if hasattr(image, "media_type"):
        image.media_type = "MULTI_LAYER_IMAGE"
    image.file_format, image.color_depth = "OPEN_EXR_MULTILAYER", "32"
    render.filepath = f"{folder}/passes.exr"
    bpy.ops.render.render(write_still=True)

    cube = bpy.data.objects["Cube"]
    cube.scale, cube.location = (0.1, 0.1, 0.1), (0.0, -0.8, 0.0)
    render.engine = "CYCLES"
    scene.cycles.samples, scene.cycles.use_denoising = 8, False
    bpy.ops.fieldwork.setup_compositor()
    scene.view_settings.view_transform = "Raw"
    if hasattr(image, "media_type"):
        image.media_type = "IMAGE"
    image.file_format, image.color_mode, image.color_depth = "OPEN_EXR", "RGBA", "32"
    render.filepath = f"{folder}/composite.exr"
    bpy.ops.render.render(write_still=True)


main()
