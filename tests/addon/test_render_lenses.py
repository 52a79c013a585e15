"""Cameras of the render engine “Fieldwork”: every setting, panoramas, blur."""

from __future__ import annotations

import pytest
from fieldwork.tests.addon.rendered import START, ball

__all__ = ["ball"]

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
    "mirrored": dict(scale=(-1, 1, 1)),
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
    assert len(errors) == 15
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


@pytest.mark.slow
def test_lenses_and_shutters_blur(bpy_script, ball, tmp_path):
    facts = bpy_script(BLURRED, project=ball, folder=tmp_path)
    assert facts["out of focus"] > facts["in focus"] + 4
    assert facts["focus object"] <= facts["in focus"] + 2
    # 0.25 units to the side at a distance of about 2, by a focal length of 120 · 50 / 36 pixels: 21 pixels on both sides
    assert facts["moving"] > facts["still"] + 25
    assert facts["middle"] == pytest.approx(59.5, abs=1.5)
    assert facts["later"] == pytest.approx(59.5 - 0.125 / 2 * 120 * 50 / 36, abs=2.5)
    assert facts["frame"] == 1


MOVED = (
    START
    + """
settings.project = ""
camera.location, camera.rotation_euler = (0, -2, 0), (math.pi / 2, 0, 0)
live.samples = 48
obj = bpy.data.objects.new("field", None)
scene.collection.objects.link(obj)
obj.fieldwork.is_field, obj.fieldwork.project = True, project
for frame, x in ((0, -0.5), (2, 0.5)):
    obj.location.x = x
    obj.keyframe_insert("location", frame=frame)
curves = obj.animation_data.action
for key in [p for c in (curves.fcurves if hasattr(curves, "fcurves") else curves.layers[0].strips[0].channelbags[0].fcurves)
            for p in c.keyframe_points]:
    key.interpolation = "LINEAR"
scene.frame_set(1)
def row():
    found = passes(shoot())["Combined.A"][40]
    return int(((found > 0.05) & (found < 0.95)).sum()), float((found * np.arange(120)).sum() / found.sum())
facts = {"still": row()}
render.use_motion_blur, render.motion_blur_shutter = True, 0.5
facts["moving"] = row()
render.motion_blur_position = "START"
facts["later"] = row()
facts["place"] = [scene.frame_current, obj.matrix_world.translation.x]
answer(facts)
"""
)


@pytest.mark.slow
def test_fields_that_move_are_blurred(bpy_script, ball, tmp_path):
    facts = bpy_script(MOVED, project=ball, folder=tmp_path)
    # 0.25 units at a distance of about 2, by a focal length of 120 · 50 / 36 pixels: 21 pixels on both sides.
    assert facts["moving"][0] > facts["still"][0] + 25
    assert facts["moving"][1] == pytest.approx(59.5, abs=1.5)
    assert facts["later"][1] == pytest.approx(59.5 + 0.125 / 2 * 120 * 50 / 36, abs=2.5)
    assert facts["place"] == [1, pytest.approx(0, abs=1e-6)], "the scene is as it was"


STEREO = (
    START
    + """
render.use_multiview, image.views_format = True, "INDIVIDUAL"
eyes = camera.data.stereo
eyes.interocular_distance, eyes.convergence_distance, eyes.pivot = 0.3, 2.5, "CENTER"
def seen(name):
    found = passes(f"{folder}/{name}.exr")
    rows, columns = np.nonzero(found["Combined.A"] > 0.9)
    return {"middle": float(columns.mean()), "points": len(rows)}
facts = {}
for mode in ("OFFAXIS", "PARALLEL", "TOE"):
    eyes.convergence_mode = mode
    shoot(mode)
    facts[mode] = [seen(f"{mode}_L"), seen(f"{mode}_R")]
other = bpy.data.objects.new("Other_R", camera.data.copy())
camera.name, other.matrix_world = "Other_L", camera.matrix_world @ Matrix.Translation((0.1, 0, 0))
scene.collection.objects.link(other)
render.views_format = "MULTIVIEW"
shoot("cameras")
facts["cameras"] = [seen("cameras_L"), seen("cameras_R")]
camera.data.type = "PANO"
own = camera.data if hasattr(camera.data, "panorama_type") else camera.data.cycles
own.panorama_type, eyes.use_spherical_stereo = "EQUIRECTANGULAR", True
facts["spherical"] = attempt(bpy.ops.render.render)
answer(facts)
"""
)


def test_stereo_has_a_picture_for_each_eye(bpy_script, ball, tmp_path):
    facts = bpy_script(STEREO, project=ball, folder=tmp_path)
    for name in ("OFFAXIS", "PARALLEL", "TOE", "cameras"):
        left, right = facts[name]
        assert min(left["points"], right["points"]) > 3000, name
    # Of the outline of a ball of radius 0.5, which is farther out than its middle, in pixels.
    focal, distance = 120 / 36 * 50, 1.934
    apart = 0.3 * focal * distance / (distance**2 - 0.5**2)
    for name, expected in (("PARALLEL", apart), ("cameras", apart / 3), ("OFFAXIS", apart - 0.3 * focal / 2.5)):
        left, right = facts[name]
        assert left["middle"] - right["middle"] == pytest.approx(expected, abs=1.5), name
    assert "spherical stereo" in facts["spherical"]


HIDDEN_IN_TIME = (
    START
    + """
bpy.ops.fieldwork.add_field()
field = bpy.context.object
layer.use_pass_z = True
for number, hidden in ((1, False), (2, True)):
    field.hide_render = hidden
    field.keyframe_insert("hide_render", frame=number)
scene.frame_set(1)
scene.frame_start, scene.frame_end = 1, 2
shoot("frame_", animation=True)
found = [passes(f"{folder}/frame_{number:04}.exr") for number in (1, 2)]
render.film_transparent = False
next(node for node in scene.world.node_tree.nodes if node.type == "BACKGROUND").inputs["Color"].default_value = (0.25, 0.5, 0.75, 1)
scene.frame_set(2)
world = passes(shoot("world"))
field.animation_data_clear()
field.hide_render = False
held = bpy.data.collections.new("Held")
scene.collection.children.link(held)
for collection in list(field.users_collection):
    collection.objects.unlink(field)
held.objects.link(field)
other = scene.view_layers.new("Other")
other.layer_collection.children["Held"].exclude = True
render.film_transparent = True
def alphas():  # of each view layer
    source, number, seen = oiio.ImageInput.open(shoot("layers")), 0, {}
    while source.seek_subimage(number, 0):
        spec, number = source.spec(), number + 1
        pixels = source.read_image(number - 1, 0, 0, spec.nchannels, "float")
        seen |= {name: float(pixels[..., place].max()) for place, name in enumerate(spec.channelnames) if name.endswith("Combined.A")}
    return [seen["ViewLayer.Combined.A"], seen["Other.Combined.A"]]
import OpenImageIO as oiio
layers = alphas()
layer.layer_collection.children["Held"].exclude = True
nowhere = attempt(bpy.ops.render.render)
answer({"layers": layers, "nowhere": nowhere, "alpha": [float(one["Combined.A"].max()) for one in found], "far": float(found[1]["Depth.Z"].min()),
        "world": [float(world[f"Combined.{letter}"].min()) for letter in "RGBA"]})
"""
)


def test_fields_are_hidden_in_the_frames_and_view_layers_that_say_so(bpy_script, ball, tmp_path):
    facts = bpy_script(HIDDEN_IN_TIME, project=ball, folder=tmp_path)
    assert facts["alpha"][0] > 0.9
    assert facts["alpha"][1] == 0.0
    assert facts["far"] == pytest.approx(1e10)
    assert facts["world"] == pytest.approx([0.25, 0.5, 0.75, 1.0])
    assert facts["layers"][0] > 0.9
    assert facts["layers"][1] == 0.0, "not the project's field in the place of the one that is excluded"
    assert "hidden in renders" in facts["nowhere"]


def test_cameras_that_are_not_rendered_are_told(bpy_script):
    told = bpy_script(
        """
from fieldwork.addon.errors import SceneError
from fieldwork.addon.live.camera import lens
camera = bpy.context.scene.camera
kinds = [item.identifier for item in camera.data.bl_rna.properties["type"].enum_items]
def kind():
    try:
        return lens(camera, 120, 80, (1, 1))["kind"]
    except SceneError as error:
        return str(error)
found = {}
for camera.data.type in kinds:
    found[camera.data.type] = kind()
answer(found)
"""
    )
    assert (told.pop("PERSP"), told.pop("ORTHO")) == ("perspective", "orthographic")
    told.pop("PANO")
    assert all("does not render" in text for text in told.values()), "such as those of shaders, from Blender 5 on"
