"""A scene that Fieldwork's engine renders, as a script for Blender, and the ball it shows."""

from __future__ import annotations

from pathlib import Path

import pytest
from fieldwork.tests.addon.support import SETUP
from fieldwork.tests.nerfcore.support.live import shared_ball

START = (
    """
os.environ["FIELDWORK_ENGINE_PYTHON"] = ENGINE_PYTHON
import math, time
import numpy as np
"""
    + SETUP
    + """
from mathutils import Matrix, Vector
from fieldwork.addon.live import engine
scene.render.engine = "FIELDWORK"
settings.project = project
live, render, layer, camera = scene.fieldwork_live, scene.render, scene.view_layers[0], scene.camera
live.samples, live.source = 1, "baked"
render.resolution_x, render.resolution_y, render.resolution_percentage = 120, 80, 100
render.film_transparent = True
camera.location, camera.rotation_euler = (0.2, -1.9, 0.3), (math.radians(82), 0.02, math.radians(6))
image = render.image_settings
if hasattr(image, "media_type"):
    image.media_type = "MULTI_LAYER_IMAGE"
image.file_format, image.color_depth = "OPEN_EXR_MULTILAYER", "32"
def shoot(name="shot", animation=False):
    render.filepath = f"{folder}/{name}"
    bpy.ops.render.render(write_still=not animation, animation=animation)
    return f"{folder}/{name}.exr"
def passes(path):
    import OpenImageIO as oiio
    source, found, number = oiio.ImageInput.open(path), {}, 0
    while source.seek_subimage(number, 0):
        spec = source.spec()
        pixels = np.asarray(source.read_image(number, 0, 0, spec.nchannels, "float"))
        for place, name in enumerate(spec.channelnames):
            found[name.partition(".")[2]] = pixels[..., place]
        number += 1
    return found
def stack(found, name, letters):
    return np.stack([found[f"{name}.{letter}"] for letter in letters], -1)
"""
)


@pytest.fixture(scope="module")
def ball(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The trained and baked ball; no test changes it."""
    return shared_ball(tmp_path_factory)
