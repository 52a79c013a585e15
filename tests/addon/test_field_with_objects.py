"""A field among Blender's objects: two scenes and the compositor, against the same picture at 32 times the resolution."""

from __future__ import annotations

import numpy as np
import pytest
from fieldwork.tests.addon.rendered import ball
from fieldwork.tests.addon.support import SETUP, make_project

__all__ = ["ball"]

START = (
    """
os.environ["FIELDWORK_ENGINE_PYTHON"] = ENGINE_PYTHON
import math
import numpy as np
"""
    + SETUP
    + """
settings.project = project
render, camera = scene.render, scene.camera
camera.location, camera.rotation_euler = (0, -2, 0), (math.pi / 2, 0, 0)
camera.data.clip_end = 50
scene.fieldwork_live.source = "baked"
render.engine = "CYCLES"
scene.cycles.samples, scene.cycles.use_denoising, scene.cycles.pixel_filter_type = 64, False, "BOX"
scene.view_settings.view_transform = "Raw"
bpy.data.objects.remove(bpy.data.objects["Cube"])
def plate(name, color, corners):
    mesh = bpy.data.meshes.new(name)
    mesh.from_pydata(corners, [], [(0, 1, 2, 3)])
    obj = bpy.data.objects.new(name, mesh)
    scene.collection.objects.link(obj)
    material = bpy.data.materials.new(name)
    material.use_nodes = True
    tree = material.node_tree
    tree.nodes.clear()
    glow, out = tree.nodes.new("ShaderNodeEmission"), tree.nodes.new("ShaderNodeOutputMaterial")
    glow.inputs[0].default_value = (*color, 1)
    tree.links.new(glow.outputs[0], out.inputs[0])
    mesh.materials.append(material)
    return obj
plate("before", (0.9, 0.2, 0.1), [(-0.35, -1, -0.3), (-0.05, -1, -0.35), (0.0, -1, 0.0), (-0.3, -1, 0.02)])
plate("through", (0.1, 0.8, 0.9), [(0.1, -0.7, -0.5), (0.5, 0.6, -0.5), (0.45, 0.6, 0.1), (0.1, -0.7, 0.1)])
plate("behind", (0.2, 0.9, 0.2), [(-0.9, 1, 0.2), (0.9, 1, 0.3), (0.9, 1, 1.2), (-0.9, 1, 1.2)])
image = render.image_settings
if hasattr(image, "media_type"):
    image.media_type = "IMAGE"
image.file_format, image.color_mode, image.color_depth = "OPEN_EXR", "RGBA", "32"
def shoot(name, target=None):
    render.filepath = f"{folder}/{name}.exr"
    bpy.ops.render.render(write_still=True)
    import OpenImageIO as oiio
    source = oiio.ImageInput.open(render.filepath)
    return np.asarray(source.read_image(0, 0, 0, source.spec().nchannels, "float"))
def small_and_large(samples, object_samples):
    # A picture of 72×48, and one 32 times as large with one sample a pixel, from which its truth is averaged.
    render.resolution_x, render.resolution_y = 72, 48
    bpy.ops.fieldwork.setup_compositor()
    made = scene["fieldwork_field_scene"]
    made.fieldwork_live.samples, scene.cycles.samples = samples, object_samples
    small = shoot("small")
    render.resolution_percentage = 3200
    scene.cycles.samples = 1
    bpy.ops.fieldwork.setup_compositor()
    made.fieldwork_live.samples = 1
    np.savez(f"{folder}/both.npz", small=small, large=shoot("large"))
    return made
"""
)


@pytest.mark.slow
def test_edges_of_objects_are_exact_in_the_composite(bpy_script, ball, tmp_path):
    """No pixel here has an edge of one object on another that the field hides: of such a pixel the renderer of the objects
    tells one colour only (docs/live.md)."""
    facts = bpy_script(
        START
        + """
made = small_and_large(256, 512)
answer({"scenes": len(bpy.data.scenes), "nodes": len(made.objects), "engine": made.render.engine})
""",
        project=ball,
        folder=tmp_path,
    )
    assert facts["scenes"] == 2, "the button makes one scene, however often it is pressed"
    assert facts["engine"] == "FIELDWORK"
    pictures = np.load(tmp_path / "both.npz")
    small, large = pictures["small"], pictures["large"]
    truth = large.reshape(48, 32, 72, 32, 4).mean((1, 3))
    assert truth[..., 3].max() > 0.99
    spread = large.reshape(48, 32, 72, 32, 4).std((1, 3)).max(-1)
    edges = spread > 0.15
    assert edges.sum() > 150
    error = np.abs(small - truth)[..., :3]
    print("mean error", 255 * error.mean(), "at edges", 255 * error[edges].mean(), edges.sum())
    assert error.mean() < 0.2 / 255
    assert error[edges].mean() < 1 / 255
    # Before, within and behind the field, each is seen.
    for color, least in (((0.9, 0.2, 0.1), 60), ((0.1, 0.8, 0.9), 15), ((0.2, 0.9, 0.2), 60)):
        assert (np.abs(small[..., :3] - color).max(-1) < 0.03).sum() > least, color


def test_the_button_keeps_what_the_user_composited(bpy_script, ball, tmp_path):
    facts = bpy_script(
        START
        + """
from fieldwork.addon.live import compositor
render.resolution_x, render.resolution_y = 24, 16
tree, out = compositor.tree_of(scene)
layers = next((n for n in tree.nodes if n.type == "R_LAYERS"), None) or tree.nodes.new("CompositorNodeRLayers")
blur = tree.nodes.new("CompositorNodeBlur")
tree.links.new(layers.outputs["Image"], blur.inputs["Image"])
tree.links.new(blur.outputs["Image"], out.inputs[0])
for _ in range(2):
    bpy.ops.fieldwork.setup_compositor()
facts = {"nodes": sorted(n.type for n in tree.nodes), "into blur": blur.inputs["Image"].links[0].from_node["fieldwork_node"],
         "out": out.inputs[0].links[0].from_node.type}
bpy.ops.render.render()
scene.render.engine = "FIELDWORK"
facts["itself"] = attempt(bpy.ops.fieldwork.setup_compositor)
scene.render.engine, scene.camera = "CYCLES", None
facts["camera"] = attempt(bpy.ops.fieldwork.setup_compositor)
answer(facts)
""",
        project=ball,
        folder=tmp_path,
    )
    assert facts["nodes"].count("R_LAYERS") == 2
    assert facts["nodes"].count("ALPHAOVER") == 2
    assert facts["into blur"] == "front"
    assert facts["out"] == "BLUR"
    assert "itself" in facts["itself"]
    assert "camera" in facts["camera"]


SCENES = (
    SETUP
    + """
from fieldwork.addon.live import compositor, shadows
settings.project = project
cube = bpy.data.objects["Cube"]
for collection in list(cube.users_collection):
    collection.objects.unlink(cube)
scene.collection.objects.link(cube)
"""
)


def test_the_scene_of_the_field_follows_what_is_deleted_and_cuts_between_cameras(bpy_script, tmp_path):
    facts = bpy_script(
        SCENES
        + """
props = bpy.data.collections.new("Props")
scene.collection.children.link(props)
made = compositor.set_up(scene)
seen = [cube.name in made.objects, props.name in made.collection.children]
bpy.ops.object.select_all(action="DESELECT")
cube.select_set(True)
bpy.ops.object.delete()
scene.collection.children.unlink(props)
first, second = scene.camera, bpy.data.objects.new("Second", bpy.data.cameras.new("Second"))
scene.collection.objects.link(second)
for name, frame, camera in (("one", 1, first), ("two", 10, second)):
    scene.timeline_markers.new(name, frame=frame).camera = camera
scene.frame_set(12)
for _ in range(2):
    compositor.set_up(scene)
cameras = []
for frame in (1, 12):
    made.frame_set(frame)
    cameras.append(made.camera.name)
answer({"before": seen, "after": ["Cube" in made.objects, "Props" in made.collection.children], "cameras": cameras,
        "markers": len(made.timeline_markers), "same": set(made.objects) == set(scene.objects)})
""",
        project=make_project(tmp_path / "capture"),
    )
    assert facts["before"] == [True, True]
    assert facts["after"] == [False, False]
    assert facts["cameras"] == ["Camera", "Second"]
    assert facts["markers"] == 2
    assert facts["same"]


def test_the_scene_of_the_field_goes_on_with_cameras_and_size_of_the_picture(bpy_script, tmp_path):
    facts = bpy_script(
        SCENES
        + """
from fieldwork.addon.live import in_step, shared_scene
cube["fieldwork_role"], cube.is_shadow_catcher, scene.render.engine = "mesh", True, "BLENDER_WORKBENCH"
made = compositor.set_up(scene)
caught = scene[shadows.SHADOW_SCENE]
render, other = scene.render, bpy.data.objects.new("Other", scene.camera.data)
scene.collection.objects.link(other)
scene.camera, scene.frame_end = other, 77
scene.timeline_markers.new("cut", frame=5).camera = other
render.resolution_percentage, render.use_border, render.border_max_x, render.pixel_aspect_x = 25, True, 0.5, 2
render.use_multiview, render.views_format = True, "MULTIVIEW"
render.views.new("third").camera_suffix = "_T"
render.views["left"].use = False
in_step._rendering(scene)
def settings_of(scene):
    return [scene.camera.name, scene.frame_end, [m.camera.name for m in scene.timeline_markers],
            *[round(getattr(scene.render, name), 4) if isinstance(getattr(scene.render, name), float)
              else getattr(scene.render, name) for name in shared_scene.SHARED],
            sorted([view.name, view.use, view.camera_suffix] for view in scene.render.views)]
markers = made.timeline_markers[0].as_pointer()
in_step._rendering(scene)
answer([settings_of(each) == settings_of(scene) for each in (made, caught)]
       + [made.timeline_markers[0].as_pointer() == markers])
""",
        project=make_project(tmp_path / "capture"),
    )
    assert facts == [True] * 3


def test_what_is_aligned_comes_once_into_scenes_that_show_the_same(bpy_script, tmp_path):
    facts = bpy_script(
        SCENES
        + """
from fieldwork.addon.jobs.queue import queue
from fieldwork.addon.project import snapshot
from fieldwork.operators.poses import aligned
held = bpy.data.collections.new("Capture")
scene.collection.children.link(held)
root = bpy.data.objects.new("root", None)
snapshot.owner(Path(project)).mark(root, "root")
held.objects.link(root)
made, asked = compositor.set_up(scene), []
queue.follow_up = lambda job: asked.append(job.verb)
job = queue.make("align", {"project": project})
job.state, made.fieldwork.up = "done", "y"
aligned(job)
answer([root.name in made.objects, asked, made.fieldwork.up])
""",
        project=make_project(tmp_path / "capture"),
    )
    assert facts == [True, ["package"], "auto"]


def test_composites_follow_the_border_and_the_camera(bpy_script, ball, tmp_path):
    facts = bpy_script(
        START
        + """
render.resolution_x, render.resolution_y, scene.cycles.samples = 72, 48, 1
bpy.ops.fieldwork.setup_compositor()
again = bpy.data.objects.new("Again", camera.data)
again.location, again.rotation_euler = (0.3, -2, 0), camera.rotation_euler
scene.collection.objects.link(again)
scene.camera = again
render.use_border = render.use_crop_to_border = True
render.border_min_x, render.border_max_x, render.border_min_y, render.border_max_y = 0.25, 0.75, 0.25, 0.75
followed = shoot("followed")
bpy.ops.fieldwork.setup_compositor()
pressed = shoot("pressed")
bpy.app.handlers.render_init.clear()
scene["fieldwork_field_scene"].render.use_border = False
bpy.ops.render.render()
from fieldwork.addon.jobs.queue import queue
from fieldwork.addon.live import engine, in_step
told = list(engine.untold)
in_step._taken()
answer([list(followed.shape), float(followed[..., 3].mean()), bool(np.array_equal(followed, pressed)), told, str(queue.outcome.error), engine.untold])
""",
        project=ball,
        folder=tmp_path,
    )
    assert facts[0] == [24, 36, 4]
    assert facts[1] > 0.5
    assert facts[2], "as if the button had been pressed again"
    (told,) = facts[3]
    assert "press Composite with Objects again" in told
    assert told in facts[4], "the panel tells it"
    assert facts[5] == []


def test_a_copy_of_the_scene_gets_scenes_of_its_own(bpy_script, tmp_path):
    facts = bpy_script(
        SCENES
        + """
cube["fieldwork_role"], cube.is_shadow_catcher = "mesh", True
def names(scene):
    return [scene[key].name for key in (compositor.FIELD_SCENE, shadows.SHADOW_SCENE)]
made = compositor.set_up(scene)
scene[shadows.SHADOW_SCENE].cycles.samples = 7
bpy.ops.scene.new(type="FULL_COPY")
copy = bpy.context.scene
for each in (copy, scene, copy):
    compositor.set_up(each)
nodes = {
    each.name: sorted(n.scene.name for n in compositor.tree_of(each)[0].nodes if n.type == "R_LAYERS")
    for each in (scene, copy)
}
answer({"scenes": [names(scene), names(copy)], "cameras": [made.camera == scene.camera, made.camera == copy.camera],
        "nodes": nodes, "samples": scene[shadows.SHADOW_SCENE].cycles.samples, "all": len(bpy.data.scenes)})
""",
        project=make_project(tmp_path / "capture"),
    )
    first, second = facts["scenes"]
    assert first == ["Scene · Field", "Scene · Shadows"]
    assert second == ["Scene.001 · Field", "Scene.001 · Shadows"]
    assert facts["all"] == 6
    assert facts["cameras"] == [True, False]
    assert facts["samples"] == 7, "what the user set stays"
    assert facts["nodes"] == {"Scene": sorted(["Scene", *first]), "Scene.001": sorted(["Scene.001", *second])}


def test_surfaces_of_the_capture_do_not_hide_its_field(bpy_script, ball, tmp_path):
    facts = bpy_script(
        START
        + """
from fieldwork.addon.live.objects import triangles
depsgraph = bpy.context.evaluated_depsgraph_get()
facts = {"all": [len(a) for a in triangles(depsgraph)]}
bpy.data.objects["before"]["fieldwork_role"] = "mesh"
bpy.data.objects["behind"].hide_render = True
bpy.context.view_layer.update()
facts["one"] = [len(a) for a in triangles(bpy.context.evaluated_depsgraph_get())]
bpy.data.objects["through"].location = (1, 2, 3)
bpy.context.view_layer.update()
through = bpy.data.objects["through"]
def held():
    bpy.context.view_layer.update()
    found = triangles(bpy.context.evaluated_depsgraph_get())
    return [len(found.faces), bool(found.holdout.all())]
through.is_holdout = True
facts["holdouts"] = [held()]
through.is_holdout = False
group = bpy.data.collections.new("group")
scene.collection.children.link(group)
group.objects.link(through)
bpy.context.view_layer.layer_collection.children["group"].holdout = True
facts["holdouts"].append(held())
facts["place"] = [float(v) for v in triangles(bpy.context.evaluated_depsgraph_get())[0][0]]
answer(facts)
""",
        project=ball,
        folder=tmp_path,
    )
    assert facts["all"] == [12, 6, 6]
    assert facts["one"] == [4, 2, 2]
    assert facts["holdouts"] == [[2, True], [2, True]]
    assert facts["place"] == pytest.approx([1.1, 1.3, 2.5], abs=1e-5)


def test_objects_that_no_camera_sees_do_not_hide_the_field(bpy_script, ball, tmp_path):
    facts = bpy_script(
        START
        + """
from fieldwork.addon.live.objects import triangles
def count():
    bpy.context.view_layer.update()
    return len(triangles(bpy.context.evaluated_depsgraph_get()).faces)
bpy.data.objects["before"].visible_camera = False
facts = {"one less": count()}
group = bpy.data.collections.new("group")
group.objects.link(bpy.data.objects["through"])
placed = bpy.data.objects.new("placed", None)
placed.instance_type, placed.instance_collection = "COLLECTION", group
scene.collection.objects.link(placed)
facts["instance"] = count()
placed.visible_camera = False
facts["hidden instance"] = count()
answer(facts)
""",
        project=ball,
        folder=tmp_path,
    )
    assert facts == {"one less": 4, "instance": 6, "hidden instance": 4}


@pytest.mark.slow
def test_holdouts_cut_the_field(bpy_script, ball, tmp_path):
    """A holdout before the field leaves nothing of it, one within only what is before it; at edges, too, against 32 times the
    resolution. Its collection may be what makes it one, also in the field's scene."""
    facts = bpy_script(
        START
        + """
bpy.data.objects["before"].is_holdout = True
group = bpy.data.collections.new("group")
scene.collection.children.link(group)
group.objects.link(bpy.data.objects["through"])
scene.collection.objects.unlink(bpy.data.objects["through"])
bpy.context.view_layer.layer_collection.children["group"].holdout = True
made = small_and_large(64, 128)
answer({"group": made.view_layers[0].layer_collection.children["group"].holdout})
""",
        project=ball,
        folder=tmp_path,
    )
    assert facts["group"]
    pictures = np.load(tmp_path / "both.npz")
    small, large = pictures["small"], pictures["large"]
    truth = large.reshape(48, 32, 72, 32, 4).mean((1, 3))
    print("mean error", 255 * np.abs(small - truth).mean())
    assert np.abs(small - truth).mean() < 0.6 / 255
    assert small[29, 28, 3] < 0.01, "nothing is behind the plate before the field"
    assert small[16, 34, 3] > 0.95, "the field beside it is whole"
    assert (np.abs(small[..., :3] - (0.2, 0.9, 0.2)).max(-1) < 0.03).sum() > 60, "objects are as they were"
    for color in ((0.9, 0.2, 0.1), (0.1, 0.8, 0.9)):
        assert (np.abs(small[..., :3] - color).max(-1) < 0.03).sum() == 0, color


def test_the_surface_of_the_capture_as_a_holdout_hides_objects_and_leaves_the_field(bpy_script, ball, tmp_path):
    facts = bpy_script(
        START
        + """
for name in ("before", "through"):
    bpy.data.objects.remove(bpy.data.objects[name])
bpy.data.objects["behind"].location.z = -0.6
bpy.ops.mesh.primitive_uv_sphere_add(radius=0.45, segments=32, ring_count=16)
surface = bpy.context.object
surface["fieldwork_role"], surface.is_holdout = "mesh", True
render.resolution_x, render.resolution_y = 36, 24
scene.cycles.samples = 16
bpy.ops.fieldwork.setup_compositor()
found = {}
for name, hidden in (("held", False), ("plain", True)):
    surface.hide_render = hidden
    picture = shoot(name)
    found[name] = [float(v) for v in picture[12, 18]]
    render.use_compositing = False
    found[name + " objects"] = float(shoot(name + "-objects")[12, 18, 3])
    render.use_compositing = True
answer(found)
""",
        project=ball,
        folder=tmp_path,
    )
    assert facts["plain objects"] == pytest.approx(1, abs=1e-3), "the plate is behind the ball"
    assert facts["held objects"] == pytest.approx(0, abs=1e-3)
    assert facts["held"][3] > 0.95
    assert facts["held"] == pytest.approx(facts["plain"], abs=0.03)
