"""The render engine “Fieldwork” without a window: every camera setting, passes, films, borders, errors, a dead engine."""

from __future__ import annotations

import os
import signal
import sys
import threading
import time
from pathlib import Path

import numpy as np
import pytest
from fieldwork.addon.engine.link import Link
from fieldwork.addon.errors import EngineError
from fieldwork.tests.addon.support import SETUP
from fieldwork.tests.nerfcore.support.live import live_ball

START = (
    """
os.environ["FIELDWORK_ENGINE_PYTHON"] = sys.executable
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
    return live_ball(tmp_path_factory.mktemp("engine") / "ball")


PROJECTED = (
    START
    + """
from bpy_extras.object_utils import world_to_camera_view
layer.use_pass_position = True
plain = dict(fit="AUTO", lens=35.0, shift=(0, 0), aspect=(1, 1), size=(120, 80), percent=100, kind="PERSP", scale=(1, 1, 1))
cases = {
    "plain": {},
    "long lens": dict(lens=62.0),
    "horizontal": dict(fit="HORIZONTAL", size=(80, 120)),
    "vertical": dict(fit="VERTICAL", size=(120, 80)),
    "upright": dict(size=(80, 120)),
    "shifted": dict(shift=(0.13, -0.09)),
    "wide pixels": dict(aspect=(2, 1)),
    "tall pixels": dict(aspect=(1, 1.7), fit="VERTICAL"),
    "half": dict(percent=50, size=(240, 160)),
    "odd": dict(percent=33, size=(331, 207)),
    "orthographic": dict(kind="ORTHO"),
    "orthographic, shifted": dict(kind="ORTHO", shift=(0.1, 0.2), aspect=(1, 1.5)),
    "orthographic, vertical": dict(kind="ORTHO", fit="VERTICAL", size=(80, 120)),
    "scaled": dict(scale=(2, 3, 0.5)),
}
asked, frame, errors = engine.frames().render, None, {}
def noted(*args):
    global frame
    frame = asked(*args)
    return frame
engine.frames().render = noted
for name, changes in cases.items():
    case = {**plain, **changes}
    data = camera.data
    data.type, data.sensor_fit, data.lens, data.ortho_scale = case["kind"], case["fit"], case["lens"], 1.6
    data.shift_x, data.shift_y = case["shift"]
    render.pixel_aspect_x, render.pixel_aspect_y = case["aspect"]
    render.resolution_x, render.resolution_y = case["size"]
    render.resolution_percentage, camera.scale = case["percent"], case["scale"]
    bpy.context.view_layer.update()
    # Blender itself cannot write multilayer files of pixels that are not square.
    bpy.ops.render.render()
    points, alpha = frame.passes["Position"][::-1], frame.passes["Combined"][::-1, :, 3]
    height, width = alpha.shape
    rows, columns = np.nonzero(alpha > 0.9)
    worst = 0.0
    for row, column in list(zip(rows, columns))[::7]:
        u, v, _ = world_to_camera_view(scene, camera, Vector(points[row, column]))
        worst = max(worst, math.hypot(u * width - column - 0.5, (1 - v) * height - row - 0.5))
    errors[name] = [len(rows), worst]
answer(errors)
"""
)


def test_points_are_where_blender_projects_them(bpy_script, ball, tmp_path):
    """For each camera setting, the point that a pixel shows is projected by Blender into this pixel."""
    errors = bpy_script(PROJECTED, project=ball, folder=tmp_path)
    assert len(errors) == 14
    for name, (count, worst) in errors.items():
        assert count > 100, name
        assert worst < 0.5, name


PANORAMAS = (
    START
    + """
layer.use_pass_position = True
bpy.data.objects.remove(bpy.data.objects["Cube"])
bpy.ops.mesh.primitive_uv_sphere_add(radius=0.5, segments=128, ring_count=64)
sphere = bpy.context.object
camera.location, camera.rotation_euler = (0.2, -0.9, 0.2), (math.radians(75), 0.1, math.radians(15))
camera.data.type = "PANO"
own = camera.data if hasattr(camera.data, "panorama_type") else camera.data.cycles
scene.cycles.samples, scene.cycles.use_denoising = 1, False
render.resolution_x, render.resolution_y = 160, 120
seen = {}
for kind, changes in {
    "EQUIRECTANGULAR": dict(),
    "part": dict(longitude_min=-1.2, longitude_max=1.4, latitude_min=-0.9, latitude_max=1.1),
    "FISHEYE_EQUIDISTANT": dict(fisheye_fov=2.6),
    "FISHEYE_EQUISOLID": dict(fisheye_fov=2.6, fisheye_lens=9.0),
}.items():
    own.panorama_type = kind if kind.isupper() else "EQUIRECTANGULAR"
    for name, value in changes.items():
        setattr(own, name, value)
    found = {}
    for name in ("CYCLES", "FIELDWORK"):
        render.engine = name
        found[name] = passes(shoot(name))
    eye = np.array(camera.matrix_world.translation)
    rays = {}
    for name, own_passes in found.items():
        ray = stack(own_passes, "Position", "XYZ") - eye
        rays[name] = ray / np.linalg.norm(ray, axis=-1, keepdims=True)
    both = (found["CYCLES"]["Combined.A"] > 0.99) & (found["FIELDWORK"]["Combined.A"] > 0.9)
    angle = np.arccos(np.clip((rays["CYCLES"] * rays["FIELDWORK"]).sum(-1), -1, 1))
    # How far directions of neighbouring pixels are apart.
    step = np.arccos(np.clip((rays["CYCLES"][:, 1:] * rays["CYCLES"][:, :-1]).sum(-1), -1, 1))
    pixel = np.median(step[both[:, 1:] & both[:, :-1]])
    seen[kind] = [int(both.sum()), float(np.percentile(angle[both], 99) / pixel)]
own.panorama_type = "MIRRORBALL"
seen["refused"] = attempt(lambda: bpy.ops.render.render())
answer(seen)
"""
)


def test_panoramas_look_as_those_of_cycles(bpy_script, ball, tmp_path):
    """Directions of pixels, by the points that Cycles finds on a sphere and Fieldwork on the ball, in pixels. Cycles looks
    through a random place of a pixel, which is up to 0.7 from its middle."""
    seen = bpy_script(PANORAMAS, project=ball, folder=tmp_path)
    assert "panorama" in seen.pop("refused")
    for kind, (count, error) in seen.items():
        assert count > 200, kind
        assert error < 0.8, kind


BLURRED = (
    START
    + """
def width_of_edge(found):
    row = found["Combined.A"][found["Combined.A"].shape[0] // 2]
    return int(((row > 0.05) & (row < 0.95)).sum())
camera.location, camera.rotation_euler = (0, -2, 0), (math.pi / 2, 0, 0)
live.samples = 48
facts = {"sharp": width_of_edge(passes(shoot()))}
camera.data.dof.use_dof, camera.data.dof.aperture_fstop = True, 0.1
camera.data.dof.focus_distance = 2.0
facts["in focus"] = width_of_edge(passes(shoot()))
camera.data.dof.focus_distance = 0.7
facts["out of focus"] = width_of_edge(passes(shoot()))
target = bpy.data.objects.new("target", None)
target.location = (0.5, 0, 0.7)
scene.collection.objects.link(target)
camera.data.dof.focus_object = target
facts["focus object"] = width_of_edge(passes(shoot()))
camera.data.dof.use_dof = False
for frame, x in ((0, -0.5), (2, 0.5)):
    camera.location.x = x
    camera.keyframe_insert("location", frame=frame)
curves = camera.animation_data.action
for key in [p for c in (curves.fcurves if hasattr(curves, "fcurves") else curves.layers[0].strips[0].channelbags[0].fcurves)
            for p in c.keyframe_points]:
    key.interpolation = "LINEAR"
scene.frame_set(1)
facts["still"] = width_of_edge(passes(shoot()))
render.use_motion_blur, render.motion_blur_shutter = True, 0.5
moved = passes(shoot())
facts["moving"] = width_of_edge(moved)
row = moved["Combined.A"][40]
facts["middle"] = float((row * np.arange(120)).sum() / row.sum())
render.motion_blur_position = "START"
row = passes(shoot())["Combined.A"][40]
facts["later"] = float((row * np.arange(120)).sum() / row.sum())
facts["frame"] = scene.frame_current
answer(facts)
"""
)


def test_lenses_and_shutters_blur(bpy_script, ball, tmp_path):
    facts = bpy_script(BLURRED, project=ball, folder=tmp_path)
    assert facts["out of focus"] > facts["in focus"] + 4
    assert facts["focus object"] <= facts["in focus"] + 2
    # 0.25 units to the side at a distance of about 2, by a focal length of 120 · 50 / 36 pixels: 21 pixels on both sides
    assert facts["moving"] > facts["still"] + 25
    assert facts["middle"] == pytest.approx(59.5, abs=1.5)
    assert facts["later"] == pytest.approx(59.5 - 0.125 / 2 * 120 * 50 / 36, abs=2.5)
    assert facts["frame"] == 1


FILMS = (
    START
    + """
whole = passes(shoot())
facts = {"clear": [float(whole["Combined.A"][0, 0]), float(whole["Combined.A"].max())]}
render.film_transparent = False
world = scene.world
for node in world.node_tree.nodes if world.node_tree else []:
    if node.type == "BACKGROUND":
        node.inputs[0].default_value, node.inputs[1].default_value = (0.2, 0.4, 0.6, 1), 0.5
found = passes(shoot())
facts["world"] = [float(found[f"Combined.{c}"][0, 0]) for c in "RGBA"]
facts["solid"] = float(found["Combined.A"].min())
render.film_transparent = True
render.use_border = True
render.border_min_x, render.border_max_x, render.border_min_y, render.border_max_y = 0.25, 0.75, 0.5, 0.9
part = passes(shoot())
facts["border"] = list(part["Combined.A"].shape)
facts["same"] = float(np.abs(part["Combined.A"][8:40, 30:90] - whole["Combined.A"][8:40, 30:90]).max())
facts["outside"] = float(part["Combined.A"][45:].max())
render.use_crop_to_border = True
crop = passes(shoot())
facts["crop"] = list(crop["Combined.A"].shape)
facts["cropped"] = float(np.abs(crop["Combined.A"] - whole["Combined.A"][8:40, 30:90]).max())
render.use_border = False
camera.data.clip_end = 1.0
facts["clipped"] = float(passes(shoot())["Combined.A"].max())
camera.data.clip_end, camera.data.clip_start = 100, 1.7
layer.use_pass_z = True
found = passes(shoot())
facts["near"] = float(found["Depth.Z" if "Depth.Z" in found else "Depth.V"].min())
answer(facts)
"""
)


def test_films_borders_and_clipping(bpy_script, ball, tmp_path):
    facts = bpy_script(FILMS, project=ball, folder=tmp_path)
    assert facts["clear"][0] < 0.02
    assert facts["clear"][1] > 0.95
    assert facts["world"] == pytest.approx([0.1, 0.2, 0.3, 1.0], abs=0.02)
    assert facts["solid"] == pytest.approx(1.0, abs=1e-4)
    assert facts["border"] == [80, 120]
    assert facts["same"] < 1e-3
    assert facts["outside"] == 0
    assert facts["crop"] == [32, 60]
    assert facts["cropped"] < 1e-3
    assert facts["clipped"] < 0.02
    assert facts["near"] >= 1.69


PASSES = (
    START
    + """
live.samples = 8
layer.use_pass_z = layer.use_pass_position = layer.use_pass_normal = True
layer.use_pass_cryptomatte_object = layer.use_pass_cryptomatte_material = layer.use_pass_cryptomatte_asset = True
own = layer.fieldwork
own.use_class_index = own.use_class_color = own.use_confidence = True
camera.location, camera.rotation_euler = (0, -2, 0), (math.pi / 2, 0, 0)
found = passes(shoot("passes"))
up, down = (28, 60), (52, 60)
depth = found["Depth.Z"]
facts = {
    "depth": float(depth[40, 60]), "far": float(depth[0, 0]),
    "index": [float(found["Class Index.X"][p]) for p in (up, down, (0, 0))],
    "color": [[float(found[f"Class Color.{c}"][p]) for c in "RGB"] for p in (up, down)],
    "confidence": [float(found["Confidence.X"][p]) for p in (up, (0, 0))],
    "normal": [float(found[f"Normal.{c}"][35:45, 55:65].mean()) for c in "XYZ"],
    "crypto": sorted(name for name in found if name.startswith("Crypto")),
}
import OpenImageIO as oiio
spec = oiio.ImageInput.open(f"{folder}/passes.exr").spec()
facts["metadata"] = {a.name: a.value for a in spec.extra_attribs if a.name.startswith("cryptomatte/")}
np.savez(f"{folder}/mine.npz", **{n: v for n, v in found.items() if n.startswith("CryptoMaterial")})

# What Blender's own node makes of it, from the render and from the file.
def composited(source):
    if hasattr(scene, "compositing_node_group"):
        tree = scene.compositing_node_group = bpy.data.node_groups.new("matte", "CompositorNodeTree")
        tree.interface.new_socket("Image", in_out="OUTPUT", socket_type="NodeSocketColor")
        out = tree.nodes.new("NodeGroupOutput")
    else:
        scene.use_nodes = True
        tree = scene.node_tree
        tree.nodes.clear()
        out = tree.nodes.new("CompositorNodeComposite")
    node = tree.nodes.new("CompositorNodeCryptomatteV2")
    node.source = source
    if source == "RENDER":
        node.scene = scene
    else:
        node.image = bpy.data.images.load(f"{folder}/passes.exr")
    facts.setdefault("layers", {})[source] = [i.identifier for i in node.bl_rna.properties["layer_name"].enum_items] or node.layer_name
    node.layer_name = f"{layer.name}.CryptoMaterial"
    node.matte_id = "top"
    tree.links.new(node.outputs["Matte"], out.inputs[0])
    if hasattr(image, "media_type"):
        image.media_type = "IMAGE"
    image.file_format, image.color_mode, image.color_depth = "OPEN_EXR", "RGBA", "32"
    render.filepath = f"{folder}/{source}.exr"
    bpy.ops.render.render(write_still=True)
    source_file = oiio.ImageInput.open(f"{folder}/{source}.exr")
    return np.asarray(source_file.read_image(0, 0, 0, source_file.spec().nchannels, "float"))[..., 0]
np.savez(f"{folder}/blender.npz", render=composited("RENDER"), image=composited("IMAGE"))
answer(facts)
"""
)


def test_passes_and_cryptomatte_from_the_render_and_from_the_file(bpy_script, ball, tmp_path):
    from fieldwork.nerfcore.film.cryptomatte import id_of

    facts = bpy_script(PASSES, project=ball, folder=tmp_path)
    assert facts["depth"] == pytest.approx(1.5, abs=0.08)
    assert facts["far"] == pytest.approx(1e10)
    assert facts["index"] == [1, 2, 0]
    assert facts["color"][0] == pytest.approx([0.604, 0.033, 0.033], abs=0.05)
    assert facts["color"][1][2] > 0.5
    assert facts["confidence"][0] > 0.8
    assert facts["confidence"][1] == 0
    assert facts["normal"] == pytest.approx([0, -0.9, 0], abs=0.25)
    assert len(facts["crypto"]) == 3 * 3 * 4
    manifests = [value for name, value in facts["metadata"].items() if name.endswith("manifest")]
    assert any('"top"' in value and '"bottom"' in value for value in manifests)
    assert any('"ball.top"' in value for value in manifests)
    mine, blender = np.load(tmp_path / "mine.npz"), np.load(tmp_path / "blender.npz")
    top = np.float32(id_of("top"))
    matte = sum(
        np.where(mine[f"CryptoMaterial{n:02}.{a}"] == top, mine[f"CryptoMaterial{n:02}.{b}"], 0)
        for n in range(3) for a, b in ("RG", "BA")
    )  # fmt: skip
    for source in ("render", "image"):
        found = blender[source]
        both, either = np.minimum(matte, found).sum(), np.maximum(matte, found).sum()
        assert either > 100
        assert both / either >= 0.99, source


ANIMATED = (
    START
    + """
for frame, x in ((1, -0.5), (100, 0.5)):
    camera.location.x = x
    camera.keyframe_insert("location", frame=frame)
scene.frame_start, scene.frame_end = 1, 100
render.resolution_percentage = 25
begun = time.monotonic()
loads, asked = [], engine.frames().render
def noted(*args):
    frame = asked(*args)
    loads.append(frame.facts["loaded"])
    return frame
engine.frames().render = noted
shoot("frame_", animation=True)
seconds = time.monotonic() - begun
left = list(engine.frames().folder().iterdir())
place = engine.frames().folder()
fieldwork.unregister()
answer({"frames": len(loads), "loads": max(loads), "seconds": seconds, "left": [str(p) for p in left],
        "gone": not place.exists(), "files": len(list(Path(folder).glob("frame_*.exr")))})
"""
)


def test_a_hundred_frames_load_the_field_once_and_leave_nothing(bpy_script, ball, tmp_path):
    facts = bpy_script(ANIMATED, project=ball, folder=tmp_path)
    assert facts["frames"] == facts["files"] == 100
    assert facts["loads"] == 1
    assert facts["left"] == []
    assert facts["gone"]


KILLED = (
    START
    + """
import signal, threading
live.source, live.samples = "field", 4096
killed = []
def kill():
    while engine.frames().process is None:
        time.sleep(0.05)
    time.sleep(wait)
    killed.append(time.monotonic())
    os.kill(engine.frames().process.pid, signal.SIGKILL)
facts = {}
for name, wait in (("while it starts", 0.3), ("in the middle", 12.0)):
    thread = threading.Thread(target=kill)
    thread.start()
    message = attempt(bpy.ops.render.render)
    facts[name] = [message, time.monotonic() - killed.pop()]
    thread.join()
live.source, live.samples = "baked", 1
facts["again"] = float(passes(shoot())["Combined.A"].max())
camera.data.type = "PERSP"
settings.project = ""
facts["no project"] = attempt(bpy.ops.render.render)
settings.project = folder + "/nothing"
facts["no such project"] = attempt(bpy.ops.render.render)
scene.camera = None
facts["no camera"] = attempt(bpy.ops.render.render)
answer(facts)
"""
)


def test_a_dead_engine_and_bad_scenes_are_told_at_once(bpy_script, ball, tmp_path):
    facts = bpy_script(KILLED, project=ball, folder=tmp_path)
    for when in ("while it starts", "in the middle"):
        message, seconds = facts[when]
        assert "stopped unexpectedly" in message
        assert "signal 9" in message
        assert seconds < 2, when
    assert facts["again"] > 0.9, "the next render starts another engine"
    assert "no field" in facts["no project"]
    assert "nothing" in facts["no such project"]
    assert "camera" in facts["no camera"]


FIELDS = (
    START
    + """
def add(name, place, **more):
    obj = bpy.data.objects.new(name, None)
    scene.collection.objects.link(obj)
    obj.matrix_world = place
    obj.fieldwork.is_field, obj.fieldwork.project = True, project
    for key, value in more.items():
        setattr(obj.fieldwork, key, value)
    return obj
settings.project = ""
camera.location, camera.rotation_euler = (0, -3, 0), (math.pi / 2, 0, 0)
left, right = add("Left", Matrix.Translation((-0.6, 0, 0))), add("Right", Matrix.Translation((0.6, 0, 0)), look=1.0)
both = passes(shoot())
facts = {"both": [float(both["Combined.A"][40, x]) for x in (27, 60, 93)]}
facts["labels"] = [float(both[f"Combined.{c}"][32, 93]) for c in "RGB"]
left.hide_render = True
facts["one"] = [float(passes(shoot())["Combined.A"][40, x]) for x in (27, 93)]
right.hide_render = True
facts["none"] = attempt(bpy.ops.render.render)
left.hide_render = False
crop = bpy.data.objects.new("crop", None)
scene.collection.objects.link(crop)
crop.empty_display_type, crop.empty_display_size, crop.location = "CUBE", 1.0, (-0.6, 0, 1)
left.fieldwork.crop = crop
bpy.context.view_layer.update()
cut = passes(shoot())["Combined.A"]
facts["crop"] = [float(cut[y, 27]) for y in (32, 48)]
left.fieldwork.crop = None
from fieldwork.addon.live.fields import fill_classes
fill_classes(left)
facts["classes"] = [[c.id, c.name] for c in left.fieldwork.classes]
left.fieldwork.classes[0].visible = False
fill_classes(left)
facts["hidden"] = float(passes(shoot())["Combined.A"][:38].sum() / both["Combined.A"][:38, :60].sum())
left.fieldwork.project = ""
facts["no project"] = attempt(bpy.ops.render.render)
answer(facts)
"""
)


def test_field_objects_are_moved_cropped_hidden_and_coloured(bpy_script, ball, tmp_path):
    facts = bpy_script(FIELDS, project=ball, folder=tmp_path)
    assert facts["both"][0] > 0.9
    assert facts["both"][1] < 0.1
    assert facts["both"][2] > 0.9
    assert facts["labels"] == pytest.approx([0.604, 0.033, 0.033], abs=0.08)
    assert facts["one"][0] < 0.1
    assert facts["one"][1] > 0.9
    assert "hidden" in facts["none"]
    assert facts["crop"][0] > 0.8
    assert facts["crop"][1] < 0.1
    assert facts["classes"] == [[1, "top"], [2, "bottom"]]
    assert facts["hidden"] < 0.4
    assert "no project folder" in facts["no project"]


# The link to the engine of frames, without Blender


def shot(project: Path, samples: int, source: bool) -> dict:
    pose = [[1, 0, 0, 0], [0, 0, -1, -2], [0, 1, 0, 0], [0, 0, 0, 1]]
    lens = {"kind": "perspective", "width": 64, "height": 48, "scale": (80, 80), "center": (32, 24), "clip": (0.1, 10)}
    field = {"name": "Ball", "project": str(project), "baked": source, "scene_from_capture": np.eye(4).tolist()}
    return {"lens": {**lens, "poses": [pose]}, "border": (0, 0, 64, 48), "samples": samples, "fields": [field],
            "passes": ["Combined"]}  # fmt: skip


def test_stopping_a_frame_takes_no_time_and_the_engine_goes_on(ball, tmp_path):
    from fieldwork.addon.live.frames import FrameEngine, Sizes

    frames = FrameEngine(lambda: Link(sys.executable, tmp_path / "engine.log"))
    sizes, told, shown = Sizes(64, 48, {"Combined": 4}), [], []
    try:
        first = frames.render(shot(ball, 1, True), sizes, lambda: False, lambda *said: told.append(said))
        assert first.passes["Combined"][24, 32, 3] > 0.9
        process = frames.process
        stopped = []

        def stop() -> bool:
            if len(shown) > 2 and not stopped:
                stopped.append(time.monotonic())
            return bool(stopped)

        with pytest.raises(EngineError) as caught:
            frames.render(shot(ball, 4096, False), sizes, stop, lambda *said: told.append(said), shown.append)
        assert caught.value.kind == "cancelled"
        assert time.monotonic() - stopped[0] < 0.5
        assert shown[0].shape == (48, 64, 4)
        begin = time.monotonic()
        frames.render(shot(ball, 1, True), sizes, lambda: False, lambda *said: None)
        assert time.monotonic() - begin < 2, "the stopped frame is given up"
        assert frames.process is process
        assert any(stage == "Rendering" and share > 0 for stage, share in told)
        assert list(frames.folder().iterdir()) == []
    finally:
        folder = frames.folder()
        frames.close()
    assert not folder.exists()
    assert process.poll() is not None


def test_an_engine_that_does_not_give_up_a_frame_is_ended(ball, tmp_path):
    from fieldwork.addon.live import frames as module

    frames = module.FrameEngine(lambda: Link(sys.executable, tmp_path / "engine.log"))
    sizes = module.Sizes(64, 48, {"Combined": 4})
    try:
        frames.render(shot(ball, 1, True), sizes, lambda: False, lambda *said: None)
        process = frames.process
        os.kill(process.pid, signal.SIGSTOP)  # as if a native call did not come back
        end = time.monotonic() + 0.5
        with pytest.raises(EngineError):
            frames.render(shot(ball, 1, True), sizes, lambda: time.monotonic() > end, lambda *said: None)
        frames._left = dict.fromkeys(frames._left, time.monotonic() - module.PATIENCE - 1)
        again = frames.render(shot(ball, 1, True), sizes, lambda: False, lambda *said: None)
        assert again.passes["Combined"][24, 32, 3] > 0.9
        assert frames.process is not process
        assert process.wait(5) == -signal.SIGKILL
    finally:
        frames.close()


def test_frames_of_several_threads_wait_for_each_other(ball, tmp_path):
    from fieldwork.addon.live.frames import FrameEngine, Sizes

    frames = FrameEngine(lambda: Link(sys.executable, tmp_path / "engine.log"))
    found: list = []

    def one() -> None:
        frame = frames.render(shot(ball, 2, True), Sizes(64, 48, {"Combined": 4}), lambda: False, lambda *said: None)
        found.append(frame.passes["Combined"][24, 32, 3])

    threads = [threading.Thread(target=one) for _ in range(4)]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join(60)
    frames.close()
    assert len(found) == 4
    assert min(found) > 0.9
