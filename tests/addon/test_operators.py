"""The operators without a window: they block, take settings from arguments or the scene, and fail with sentences."""

from __future__ import annotations

import json
import math

import pytest

SETUP = """
import fieldwork
fieldwork.register()
scene = bpy.context.scene
settings = scene.fieldwork
def attempt(call):
    try:
        return sorted(call())
    except RuntimeError as error:
        return str(error)
"""


def make_project(folder, **more):
    """A project as the panels see it."""
    folder.mkdir(parents=True, exist_ok=True)
    project = {
        "format": "fieldwork-project",
        "version": 1,
        "images": [
            {"name": "a", "file": "images/a.jpg", "width": 640, "height": 480, "label": "labels/a.png"},
            {"name": "b", "file": "", "status": "rejected", "reason": "It is blurred."},
        ],
        "classes": [
            {"id": 1, "name": "stone", "color": [0.5, 0.5, 0.5], "priority": 1.0},
            {"id": 2, "name": "gold", "color": [1.0, 0.8, 0.0], "priority": 2.0},
        ],
        "provenance": [{"verb": "mesh", "time": "", "version": "", "result": {"classes": {"gold": {"area": 0.25}}}}],
        **more,
    }
    (folder / "project.json").write_text(json.dumps(project))
    return folder


def test_new_reads_photos_and_fills_the_lists(bpy_script, shared_data, tmp_path):
    photos = shared_data("banana")
    facts = bpy_script(
        SETUP
        + """
done = bpy.ops.fieldwork.new(project=project, photos=photos, max_size=320)
answer({"done": sorted(done), "project": settings.project, "images": len(settings.images),
        "sizes": [max(i.width, i.height) for i in settings.images], "first": settings.images[0].name})
""",
        project=tmp_path / "Meine Aufnahme",
        photos=photos,
    )
    assert facts["done"] == ["FINISHED"]
    assert facts["project"] == str(tmp_path / "Meine Aufnahme")
    assert facts["images"] > 10
    assert set(facts["sizes"]) == {320}


def test_failures_are_sentences(bpy_script, tmp_path):
    (tmp_path / "empty").mkdir()
    facts = bpy_script(
        SETUP
        + """
answer({
    "no project": attempt(lambda: bpy.ops.fieldwork.poses()),
    "photos": attempt(lambda: bpy.ops.fieldwork.new(project=folder + "/p", photos=folder + "/none")),
    "no photos": attempt(lambda: bpy.ops.fieldwork.new(project=folder + "/p")),
    "empty": attempt(lambda: bpy.ops.fieldwork.new(project=folder + "/p", photos=folder + "/empty")),
    "project": attempt(lambda: bpy.ops.fieldwork.poses(project=folder + "/none")),
    "settings": attempt(lambda: bpy.ops.fieldwork.train(project=folder, settings="fast")),
    "align": attempt(lambda: bpy.ops.fieldwork.align(project=folder)),
    "blend": attempt(lambda: bpy.ops.fieldwork.blend(project=folder, out="x.obj")),
    "camera": attempt(lambda: (setattr(scene, "camera", None), bpy.ops.fieldwork.render(project=folder))[1]),
    "open": attempt(lambda: bpy.ops.fieldwork.open(filepath=folder + "/nothing.mp4")),
})
""",
        folder=tmp_path,
    )
    for name, words in {
        "photos": "does not exist",
        "no photos": "Choose a folder of photos",
        "empty": "photo",
        "project": "not a capture project",
        "no project": "Choose a project folder",
        "settings": "name=value",
        "align": "Choose an up direction",
        "blend": "ends in .blend",
        "camera": "no active camera",
        "open": "nothing at",
    }.items():
        assert words in facts[name], name


def test_missing_engine_is_told(bpy_script, tmp_path):
    message = bpy_script(
        SETUP
        + """
from fieldwork.addon import preferences
preferences.engine_python = lambda: None
answer(attempt(lambda: bpy.ops.fieldwork.doctor()))
"""
    )
    assert "not installed" in message


def test_lists_follow_the_project_and_class_edits_go_back(bpy_script, tmp_path):
    folder = make_project(tmp_path / "capture")
    facts = bpy_script(
        SETUP
        + """
from fieldwork.addon import state
settings.project = project
rows = [[i.name, i.status, i.reason, i.labelled] for i in settings.images]
classes = [[c.id, c.name, round(c.priority, 3), round(c.area, 3)] for c in settings.classes]
settings.classes[0].priority = 4.0
settings.classes[1].name = "gilding"
state.write_classes()
settings.project = ""
answer({"rows": rows, "classes": classes, "left": len(settings.images)})
""",
        project=folder,
    )
    assert facts["rows"] == [["a", "ok", "", True], ["b", "rejected", "It is blurred.", False]]
    assert facts["classes"] == [[1, "stone", 1.0, 0.0], [2, "gold", 2.0, 0.25]]
    assert facts["left"] == 0
    classes = json.loads((folder / "project.json").read_text())["classes"]
    assert [(c["id"], c["name"], c["priority"]) for c in classes] == [(1, "stone", 4.0), (2, "gilding", 2.0)]
    assert classes[1]["color"] == pytest.approx([1.0, 0.8, 0.0], abs=1e-5)


def test_open_understands_folders_photos_videos_and_projects(bpy_script, tmp_path):
    project = make_project(tmp_path / "old")
    photos = tmp_path / "day one"
    (photos / "labels").mkdir(parents=True)
    (photos / "a.jpg").touch()
    (tmp_path / "museum" / "photos").mkdir(parents=True)
    (tmp_path / "museum" / "labels").mkdir()
    (tmp_path / "museum" / "classes.json").touch()
    (tmp_path / "walk.mp4").touch()
    facts = bpy_script(
        SETUP
        + """
seen = {}
for name, arguments in {
    "project": {"filepath": folder + "/old/project.json"},
    "folder": {"filepath": folder + "/day one"},
    "capture": {"filepath": folder + "/museum"},
    "photo": {"directory": folder + "/day one", "files": [{"name": "a.jpg"}]},
    "video": {"directory": folder, "files": [{"name": "walk.mp4"}]},
}.items():
    bpy.ops.fieldwork.open(**arguments)
    seen[name] = [settings.photos, settings.project, settings.labels]
answer(seen)
""",
        folder=tmp_path,
    )
    assert facts["project"][1] == str(project)
    expected = [str(photos), f"{photos}_fieldwork", str(photos / "labels")]
    assert facts["folder"] == expected
    assert facts["photo"] == expected
    museum = tmp_path / "museum"
    assert facts["capture"] == [str(museum / "photos"), f"{museum}_fieldwork", str(museum / "labels")]
    assert facts["video"] == [str(tmp_path / "walk.mp4"), str(tmp_path / "walk_fieldwork"), ""]


@pytest.mark.parametrize(("width", "height"), [(640, 480), (480, 640)])
@pytest.mark.parametrize("fit", ["AUTO", "HORIZONTAL", "VERTICAL"])
def test_scene_camera_as_pixels_agrees_with_blender(bpy_script, width, height, fit):
    """Blender's own projection of a point, and that through the exported intrinsics, meet."""
    facts = bpy_script(
        SETUP
        + """
from bpy_extras.object_utils import world_to_camera_view
from mathutils import Matrix, Vector
from fieldwork.operators.render import camera_frames
scene.render.resolution_x, scene.render.resolution_y = width, height
camera = scene.camera
camera.data.sensor_fit, camera.data.lens = fit, 41.0
camera.data.shift_x, camera.data.shift_y = 0.11, -0.07
camera.scale = (2, 2, 2)
bpy.context.view_layer.update()
frame = camera_frames(scene, False, (0, 0))["frames"][0]
seen = []
for point in (Vector((0, 0, 0)), Vector((1, 0.5, -0.3)), Vector((-0.8, 0.2, 1.0))):
    x, y, _ = world_to_camera_view(scene, camera, point)
    p = Matrix(frame["transform_matrix"]).inverted() @ point
    mine = [frame["cx"] + frame["fl_x"] * p.x / -p.z, frame["cy"] - frame["fl_y"] * p.y / -p.z]
    seen.append([[x * width, (1 - y) * height], mine])
answer(seen)
""",
        width=width,
        height=height,
        fit=fit,
    )
    for blender, mine in facts:
        assert mine == pytest.approx(blender, abs=0.01)


def test_animation_gives_a_frame_each_and_leaves_the_scene_where_it_was(bpy_script):
    facts = bpy_script(
        SETUP
        + """
from fieldwork.operators.render import camera_frames
scene.frame_start, scene.frame_end, scene.frame_step = 2, 8, 3
for frame, x in ((2, 0.0), (8, 6.0)):
    scene.camera.location.x = x
    scene.camera.keyframe_insert("location", frame=frame)
scene.frame_set(5)
frames = camera_frames(scene, True, (100, 50))["frames"]
answer({"names": [f["file_path"] for f in frames], "x": [f["transform_matrix"][0][3] for f in frames],
        "size": [frames[0]["w"], frames[0]["h"]], "now": scene.frame_current})
"""
    )
    assert facts["names"] == ["frame_0002", "frame_0005", "frame_0008"]
    assert facts["x"][0] == pytest.approx(0, abs=1e-6)
    assert facts["x"][2] == pytest.approx(6, abs=1e-6)
    assert (facts["size"], facts["now"]) == ([100, 50], 5)


def test_crop_box_becomes_the_training_region(bpy_script, tmp_path):
    folder = make_project(tmp_path / "capture")
    (folder / "poses").mkdir()
    (folder / "poses" / "poses.json").write_text("{}")
    facts = bpy_script(
        SETUP
        + """
import math
from fieldwork.addon import crop
settings.project = project
bpy.ops.fieldwork.crop_add()
box = crop.find(scene)
box.location, box.scale, box.rotation_euler = (1, 2, 3), (1, 2, 0.5), (0, 0, math.pi / 2)
bpy.ops.fieldwork.crop_apply()
written = crop.read_bounds(Path(project))
box.scale.z = 0
flat = attempt(lambda: bpy.ops.fieldwork.crop_apply())
bpy.ops.fieldwork.crop_remove()
answer({"written": written, "flat": flat, "after": crop.read_bounds(Path(project)), "box": crop.find(scene) is None})
""",
        project=folder,
    )
    assert facts["written"][0] == pytest.approx([-1, 1, 2.5], abs=1e-5)
    assert facts["written"][1] == pytest.approx([3, 3, 3.5], abs=1e-5)
    assert "flat" in facts["flat"]
    assert facts["after"] is None
    assert facts["box"]


def test_moving_the_region_box_edits_the_training_region(bpy_script, tmp_path):
    folder = make_project(tmp_path / "capture")
    (folder / "poses").mkdir()
    (folder / "poses" / "poses.json").write_text("{}")
    facts = bpy_script(
        SETUP
        + """
from fieldwork.addon import crop
settings.project = project
bpy.ops.fieldwork.crop_add()
box = crop.find(scene)
def look():
    bpy.context.view_layer.update()
    return crop.follow(scene), crop.read_bounds(Path(project))
box.location, box.scale = (1, 2, 3), (1, 1, 1)
seen = [look()]  # still moving, as far as is known
seen.append(look())
seen.append(look())
box.location.x = 5
seen += [look(), look()]
box.scale.x = 0
seen += [look(), look()]
bpy.data.objects.remove(box)
seen.append(look())
answer(seen)
""",
        project=folder,
    )
    first, second = [[0, 1, 2], [2, 3, 4]], [[4, 1, 2], [6, 3, 4]]
    assert [written for written, _ in facts] == [False, True, False, False, True, False, False, False]
    assert [bounds for _, bounds in facts] == [None, first, first, first, second, second, second, second]


def test_points_are_found_where_blender_draws_them(bpy_script):
    facts = bpy_script(
        """
import numpy as np
import fieldwork
fieldwork.register()
from bpy_extras.object_utils import world_to_camera_view
from mathutils import Vector
from fieldwork.addon.picking import project
scene, camera = bpy.context.scene, bpy.context.scene.camera
scene.render.resolution_x, scene.render.resolution_y = 200, 100
depsgraph = bpy.context.evaluated_depsgraph_get()
matrix = camera.calc_matrix_camera(depsgraph, x=200, y=100) @ camera.matrix_world.inverted()
places = np.array([[0, 0, 0], [1, 0.5, -0.3], [40, -40, 30]], np.float32)
seen = project(places, np.array(matrix), 200, 100)
want = [list(world_to_camera_view(scene, camera, Vector(p))) for p in places.tolist()]
answer({"seen": [[x if np.isfinite(x) else None for x in row] for row in seen.tolist()], "want": want})
"""
    )
    for (x, y, depth), (u, v, z) in zip(facts["seen"][:2], facts["want"][:2]):
        assert [x, y] == pytest.approx([200 * u, 100 * v], abs=0.01)
        assert depth == pytest.approx(z, rel=1e-4)
    assert facts["seen"][2][2] < 0, "behind the camera"
    assert facts["seen"][2][0] is None


def test_hidden_classes_vanish_from_the_mesh(bpy_script, tmp_path):
    facts = bpy_script(
        SETUP
        + """
from fieldwork.addon import visibility
settings.project = project
mesh = bpy.data.meshes.new("Surface")
mesh.from_pydata([(x, y, 0) for y in range(2) for x in range(4)], [], [(i, i + 1, i + 5, i + 4) for i in range(3)])
mesh.attributes.new("class_id", "INT", "FACE").data.foreach_set("value", [1, 2, 2])
obj = bpy.data.objects.new("Surface", mesh)
obj["fieldwork_role"], obj["fieldwork_project"] = "mesh", "capture"
scene.collection.objects.link(obj)
def faces():
    return len(obj.evaluated_get(bpy.context.evaluated_depsgraph_get()).data.polygons)
counts = [faces()]
for one, two in ((True, False), (False, True), (False, False), (True, True)):
    settings.classes[0].visible, settings.classes[1].visible = one, two
    counts.append(faces())
answer({"counts": counts, "modifiers": len(obj.modifiers), "groups": len(bpy.data.node_groups)})
""",
        project=make_project(tmp_path / "capture"),
    )
    assert facts == {"counts": [3, 1, 2, 0, 3], "modifiers": 0, "groups": 0}


def test_grey_buttons_say_why(bpy_script, tmp_path):
    facts = bpy_script(
        SETUP
        + """
import sys
from fieldwork.addon import preferences
operators = {
    name: getattr(bpy.types, f"FIELDWORK_OT_{name}")
    for name in ("new", "poses", "align", "train", "render", "mesh", "blend", "import_scene", "evaluate")
}
reasons = {name: cls.reason(bpy.context) for name, cls in operators.items()}
preferences.engine_python = lambda: None
settings.project = project
reasons["no engine"] = operators["poses"].reason(bpy.context)
answer(reasons)
""",
        project=make_project(tmp_path / "capture"),
    )
    assert facts.pop("new") == "Choose a folder of photos, or a video, first"
    assert "preferences" in facts.pop("no engine")
    assert set(facts.values()) <= {"Read photos into a project first", "The scene has no active camera"}
    assert facts["poses"] == "Read photos into a project first"


def test_every_operator_and_property_has_a_tooltip(bpy_script):
    lacking = bpy_script(
        SETUP
        + """
lacking = []
for name in dir(bpy.ops.fieldwork):
    rna = getattr(bpy.ops.fieldwork, name).get_rna_type()
    if not rna.description:
        lacking.append(name)
for group in (settings, ):
    for prop in group.bl_rna.properties:
        if prop.identifier not in ("rna_type", "name", "images", "classes") and not prop.description:
            lacking.append(prop.identifier)
answer(lacking)
"""
    )
    assert lacking == []


def test_training_settings_are_read_from_text():
    pytest.importorskip("bpy")
    from fieldwork.operators.train import parse_settings

    assert parse_settings("loss.semantic=0.1  field.levels=6") == {"loss.semantic": "0.1", "field.levels": "6"}
    assert parse_settings("") == {}
    with pytest.raises(ValueError, match="name=value"):
        parse_settings("field.levels=")


def test_curve_picture_shows_both_lines():
    from fieldwork.addon.curve import LOSS_COLOR, PSNR_COLOR, draw_curve

    curve = [(step, math.exp(-step / 50), 10 + step / 10) for step in range(100)]
    image = draw_curve(curve, 64, 32)
    assert image.shape == (32, 64, 4)
    for color, slope in ((PSNR_COLOR, 1), (LOSS_COLOR, -1)):
        rows, columns = (abs(image[..., :3] - color).max(-1) < 1e-6).nonzero()
        left, right = rows[columns < 8].mean(), rows[columns >= 56].mean()
        assert (right - left) * slope > 10
    assert draw_curve([(0, 1.0, float("nan")), (1, 1.0, float("nan"))], 8, 8).shape == (8, 8, 4)


def test_renders_appear_behind_their_cameras_or_on_planes_once(bpy_script, tmp_path):
    facts = bpy_script(
        SETUP
        + """
from fieldwork.addon import render_result
settings.project = project
files = []
for name in ("a", "a_depth", "b"):
    image = bpy.data.images.new(name, 64, 48)
    image.filepath_raw, image.file_format = f"{project}/{name}.png", "PNG"
    image.save()
    bpy.data.images.remove(image)
    files.append(Path(project) / f"{name}.png")
cameras = {}
for name in "ab":
    cameras[name] = bpy.data.objects.new(name, bpy.data.cameras.new(name))
    cameras[name]["fieldwork_role"], cameras[name]["fieldwork_project"] = f"camera:{name}.jpg", "capture"
    scene.collection.objects.link(cameras[name])
def show(kind, photos):
    steps = render_result.show_steps(scene, files, kind, photos, "capture")
    while True:
        try:
            next(steps)
        except StopIteration as end:
            return end.value
for _ in range(2):
    for kind in ("background", "plane", "none"):
        pairs = show(kind, True)
answer({
    "images": sorted(i.name for i in bpy.data.images if i.filepath),
    "slots": {n: [s.image.name for s in c.data.background_images] for n, c in cameras.items()},
    "planes": {n: [o.data.name for o in c.children] for n, c in cameras.items()},
    "animation": [[c.name, i.source] for c, i in show("background", False)],
})
""",
        project=make_project(tmp_path / "capture"),
    )
    assert facts["images"] == ["a.png", "a_depth.png", "b.png"]
    assert facts["slots"] == {"a": ["a.png"], "b": ["b.png"]}
    assert facts["planes"] == {"a": ["a.png"], "b": ["b.png"]}
    assert facts["animation"] == [["Camera", "SEQUENCE"]]


def test_image_plane_covers_exactly_what_the_camera_sees(bpy_script, tmp_path):
    facts = bpy_script(
        SETUP
        + """
from bpy_extras.object_utils import world_to_camera_view
from mathutils import Vector
from fieldwork.addon import render_result
scene.render.resolution_x, scene.render.resolution_y = 200, 100
scene.camera.data.shift_x = 0.2
image = bpy.data.images.new("frame", 200, 100)
render_result.plane(scene, scene.camera, image, 1)
bpy.context.view_layer.update()
(empty,) = scene.camera.children
half = empty.empty_display_size / 2
corners = [empty.matrix_world @ Vector((x * half, y * half / 2, 0)) for x in (-1, 1) for y in (-1, 1)]
answer([[round(v, 4) for v in world_to_camera_view(scene, scene.camera, c)[:2]] for c in corners])
"""
    )
    assert facts == [[0, 0], [0, 1], [1, 0], [1, 1]]
