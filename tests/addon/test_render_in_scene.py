"""Cameras of the scene as pixels for the engine, and rendered images back in the scene."""

from __future__ import annotations

from typing import get_args

import pytest
from fieldwork.tests.addon.support import SETUP, make_project


@pytest.mark.parametrize(("width", "height"), [(640, 480), (480, 640)])
@pytest.mark.parametrize("fit", ["AUTO", "HORIZONTAL", "VERTICAL"])
def test_scene_camera_as_pixels_agrees_with_blender(bpy_script, tmp_path, width, height, fit):
    """Blender's own projection of a point, and that through the exported intrinsics, meet, also where pixels are not
    square, and where the camera is scaled or mirrored."""
    facts = bpy_script(
        SETUP
        + """
from bpy_extras.object_utils import world_to_camera_view
from mathutils import Matrix, Vector
from fieldwork.operators.render import write_cameras
scene.render.resolution_x, scene.render.resolution_y = width, height
camera = scene.camera
camera.data.sensor_fit, camera.data.lens = fit, 41.0
camera.data.shift_x, camera.data.shift_y = 0.11, -0.07
file = Path(folder, "cameras.json")
seen = []
for aspect, scale in (((1, 1), (2, 2, 2)), ((2, 1), (1, 2, 3)), ((1, 1.5), (1, 1, 1)), ((1, 1), (-1, 1, 1))):
    scene.render.pixel_aspect_x, scene.render.pixel_aspect_y = aspect
    camera.scale = scale
    bpy.context.view_layer.update()
    for _ in write_cameras(file, scene, False, (0, 0)):
        pass
    frame = json.loads(file.read_text())["frames"][0]
    for point in (Vector((0, 0, 0)), Vector((1, 0.5, -0.3)), Vector((-0.8, 0.2, 1.0))):
        x, y, depth = world_to_camera_view(scene, camera, point)
        p = Matrix(frame["transform_matrix"]).inverted() @ point
        mine = [frame["cx"] + frame["fl_x"] * p.x / -p.z, frame["cy"] - frame["fl_y"] * p.y / -p.z, -p.z]
        seen.append([[x * width, (1 - y) * height, depth], mine])
answer(seen)
""",
        width=width,
        height=height,
        fit=fit,
        folder=tmp_path,
    )
    for blender, mine in facts:
        assert mine == pytest.approx(blender, abs=0.01)


def test_a_render_has_as_many_pixels_as_blenders_own(bpy_script, tmp_path):
    """33 % of 1920 × 1080: Blender cuts off what is left over."""
    facts = bpy_script(
        SETUP
        + """
from fieldwork.operators.render import write_cameras
seen = []
class Asked(bpy.types.RenderEngine):
    bl_idname = "ASKED"
    bl_label = "Asked"
    def render(self, depsgraph):
        seen.append([self.resolution_x, self.resolution_y])
bpy.utils.register_class(Asked)
render = scene.render
render.engine = "ASKED"
render.resolution_x, render.resolution_y, render.resolution_percentage = 1920, 1080, 33
bpy.ops.render.render()
file = Path(folder, "cameras.json")
for _ in write_cameras(file, scene, False, (0, 0)):
    pass
frame = json.loads(file.read_text())["frames"][0]
answer({"blender": seen[0], "fieldwork": [frame["w"], frame["h"]]})
""",
        folder=tmp_path,
    )
    assert facts["fieldwork"] == facts["blender"] == [633, 356]


def test_animation_gives_a_frame_each_and_leaves_the_scene_where_it_was(bpy_script, tmp_path):
    facts = bpy_script(
        SETUP
        + """
from fieldwork.operators.render import write_cameras
scene.frame_start, scene.frame_end, scene.frame_step = 2, 8, 3
for frame, x in ((2, 0.0), (8, 6.0)):
    scene.camera.location.x = x
    scene.camera.keyframe_insert("location", frame=frame)
scene.frame_set(5)
file = Path(folder, "cameras.json")
seen = [scene.frame_current for _ in write_cameras(file, scene, True, (100, 50))]
frames = json.loads(file.read_text())["frames"]
answer({"names": [f["file_path"] for f in frames], "x": [f["transform_matrix"][0][3] for f in frames],
        "size": [frames[0]["w"], frames[0]["h"]], "now": seen})
""",
        folder=tmp_path,
    )
    assert facts["names"] == ["frame_0002", "frame_0005", "frame_0008"]
    assert facts["x"][0] == pytest.approx(0, abs=1e-6)
    assert facts["x"][2] == pytest.approx(6, abs=1e-6)
    assert (facts["size"], facts["now"]) == ([100, 50], [5, 5, 5])


def test_camera_is_where_it_stands_whichever_view_layer_the_window_shows(bpy_script, tmp_path):
    facts = bpy_script(
        SETUP
        + """
from fieldwork.operators.render import camera_at
def place():
    scene = bpy.context.scene
    return camera_at(scene, scene.frame_current, 64, 48, None)["transform_matrix"][0][3]
other = scene.view_layers.new("Other")
bpy.context.window_manager.windows[0].view_layer = other
place()
scene.camera.location.x = 12
other.update()
found = [place()]
bpy.ops.wm.save_as_mainfile(filepath=file)
bpy.ops.wm.open_mainfile(filepath=file)
answer({"layer": bpy.context.view_layer.name, "places": [*found, place()]})
""",
        file=tmp_path / "layers.blend",
    )
    assert facts["layer"] == "Other"
    assert facts["places"] == pytest.approx([12, 12])


def test_renders_appear_behind_their_cameras_or_on_planes_once(bpy_script, tmp_path):
    facts = bpy_script(
        SETUP
        + """
from fieldwork.addon.render import result
from fieldwork.addon.roles import Owner
settings.project = project
files = []
for name in ("a", "a_depth", "a_unknown", "b"):
    image = bpy.data.images.new(name, 64, 48)
    image.filepath_raw, image.file_format = f"{project}/{name}.png", "PNG"
    image.save()
    bpy.data.images.remove(image)
    files.append(Path(project) / f"{name}.png")
cameras = {}
for name in "ab":
    cameras[name] = bpy.data.objects.new(name, bpy.data.cameras.new(name))
    cameras[name]["fieldwork_role"], cameras[name]["fieldwork_project"] = f"camera:{name}", "capture"
    scene.collection.objects.link(cameras[name])
def show(kind, photos):
    steps = result.show_steps(scene, files, kind, photos, Owner("capture"))
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
    assert facts["images"] == ["a.png", "a_depth.png", "a_unknown.png", "b.png"]
    assert facts["slots"] == {"a": ["a.png"], "b": ["b.png"]}
    assert facts["planes"] == {"a": ["a.png"], "b": ["b.png"]}
    assert facts["animation"] == [["Camera", "SEQUENCE"]]


def test_renders_go_to_the_cameras_of_their_own_project(bpy_script, tmp_path):
    """Another capture, in a folder of the same name, has a camera of the same name."""
    facts = bpy_script(
        SETUP
        + """
from fieldwork.addon.render import result
from fieldwork.addon.roles import Owner
image = bpy.data.images.new("a", 8, 8)
image.filepath_raw, image.file_format = f"{folder}/a.png", "PNG"
image.save()
cameras, owners = {}, {uuid: Owner("capture", uuid) for uuid in ("first", "second")}
for uuid, owner in owners.items():
    cameras[uuid] = bpy.data.objects.new(uuid, bpy.data.cameras.new("a"))
    owner.mark(cameras[uuid], "camera:a")
    scene.collection.objects.link(cameras[uuid])
seen = []
for owner in owners.values():
    for _ in result.show_steps(scene, [Path(folder) / "a.png"], "background", True, owner):
        pass
    seen.append([len(camera.data.background_images) for camera in cameras.values()])
answer(seen)
""",
        folder=tmp_path,
    )
    assert facts == [[1, 0], [1, 1]]


def test_image_plane_covers_exactly_what_the_camera_sees(bpy_script, tmp_path):
    facts = bpy_script(
        SETUP
        + """
from bpy_extras.object_utils import world_to_camera_view
from mathutils import Vector
from fieldwork.addon.render import result
scene.render.resolution_x, scene.render.resolution_y = 200, 100
scene.camera.data.shift_x = 0.2
image = bpy.data.images.new("frame", 200, 100)
result.plane(scene, scene.camera, image, 1, 1)
bpy.context.view_layer.update()
(empty,) = scene.camera.children
half = empty.empty_display_size / 2
corners = [empty.matrix_world @ Vector((x * half, y * half / 2, 0)) for x in (-1, 1) for y in (-1, 1)]
answer([[round(v, 4) for v in world_to_camera_view(scene, scene.camera, c)[:2]] for c in corners])
"""
    )
    assert facts == [[0, 0], [0, 1], [1, 0], [1, 1]]


def test_every_pass_of_the_engine_is_offered_and_asked_for(bpy_script, tmp_path):
    from fieldwork.nerfcore.params import Pass

    facts = bpy_script(
        SETUP
        + """
from fieldwork.operators.render import FIELDWORK_OT_render
items = [item.identifier for item in settings.bl_rna.properties["passes"].enum_items]
settings.project, settings.render_from = project, "orbit"
settings.passes = set(items)
class Asked:
    out, camera, baked, edits, frame_range = "", "", False, "", (-1, -1)
    value = lambda self, context, name: {"run": "main", "source": "orbit"}.get(name) or getattr(settings, name)
    project_path = lambda self, context: project
answer([items, FIELDWORK_OT_render.parameters(Asked(), bpy.context)["passes"]])
""",
        project=make_project(tmp_path / "capture"),
    )
    assert facts == [list(get_args(Pass))] * 2


def test_an_animation_of_every_other_frame_is_shown_without_gaps(bpy_script, tmp_path):
    facts = bpy_script(
        SETUP
        + """
from fieldwork.addon.render import result
from fieldwork.addon.roles import Owner
files = []
for number in (1, 3, 5):
    image = bpy.data.images.new("frame", 8, 8)
    files.append(Path(folder, f"frame_{number:04}.png"))
    image.filepath_raw, image.file_format = str(files[-1]), "PNG"
    image.save()
    bpy.data.images.remove(image)
for _ in result.show_steps(scene, files, "background", False, Owner("capture")):
    pass
(slot,) = scene.camera.data.background_images
answer([slot.image_user.frame_duration, Path(slot.image.filepath).parent.name])
""",
        folder=tmp_path,
    )
    assert facts == [6, "every_frame"]


def test_an_animation_that_begins_before_frame_0_is_shown_in_its_frames(bpy_script, tmp_path):
    facts = bpy_script(
        SETUP
        + """
from fieldwork.addon.render import result
from fieldwork.addon.roles import Owner
files = []
for number in (-2, -1, 0, 1):
    image = bpy.data.images.new("frame", 8, 8)
    files.append(Path(folder, f"frame_{number:04}.png"))
    image.filepath_raw, image.file_format = str(files[-1]), "PNG"
    image.save()
    bpy.data.images.remove(image)
for _ in result.show_steps(scene, files, "background", False, Owner("capture")):
    pass
(slot,) = scene.camera.data.background_images
user = slot.image_user
answer([user.frame_start, user.frame_duration, user.frame_offset, Path(slot.image.filepath).name])
""",
        folder=tmp_path,
    )
    assert facts == [-2, 4, 0, "frame_0001.png"]


def test_photos_called_like_passes_are_colors_too(tmp_path):
    pytest.importorskip("bpy")
    from fieldwork.addon.render.result import colored_files

    def files(*names):
        return [tmp_path / name for name in names]

    rendered = files("a.png", "a__depth.png", "a.exr", "a_depth.png", "a_depth_depth.png", "a_depth.exr")
    assert colored_files(rendered) == files("a.png", "a_depth.png")
    assert colored_files(files("a_depth.png", "a.exr")) == [], "of the depth alone"
    assert colored_files(files("stairs_depth.png", "b.png")) == files("stairs_depth.png", "b.png"), "straightened ones"


def test_what_is_no_perspective_camera_is_told_in_any_frame(bpy_script, tmp_path):
    facts = bpy_script(
        SETUP
        + """
from fieldwork.addon.errors import SceneError
from fieldwork.operators.render import camera_fault, write_cameras
own, empty = scene.camera, bpy.data.objects.new("Empty", None)
flat = bpy.data.objects.new("Flat", bpy.data.cameras.new("flat"))
flat.data.type = "ORTHO"
for obj in (empty, flat):
    scene.collection.objects.link(obj)
faults = []
for scene.camera in (own, empty, flat, None):
    faults.append(camera_fault(scene))
for number, camera in ((1, own), (3, flat)):
    scene.timeline_markers.new("cut", frame=number).camera = camera
scene.frame_start, scene.frame_end = 1, 4
scene.frame_set(1)
try:
    list(write_cameras(Path(folder, "cameras.json"), scene, True, (8, 8)))
except SceneError as error:
    faults.append(str(error))
settings.project, settings.render_from, scene.camera = project, "camera", empty
scene.timeline_markers.clear()
scene.camera = empty
faults.append(attempt(bpy.ops.fieldwork.render))
answer([faults, scene.frame_current, Path(folder, "cameras.json").exists()])
""",
        folder=tmp_path,
        project=make_project(tmp_path / "capture"),
    )
    own, empty, flat, none, animated, told = facts[0]
    assert own is None
    assert "no camera" in empty
    assert "not a perspective" in flat
    assert "no active camera" in none
    assert "Frame 3" in animated
    assert "not a perspective" in animated
    assert "“Empty” is the active camera, but no camera." in told
    assert "Traceback" not in told
    assert facts[1:] == [1, False]


def test_a_size_of_one_side_is_not_ignored(bpy_script, tmp_path):
    facts = bpy_script(
        SETUP
        + """
from fieldwork.operators.render import FIELDWORK_OT_render
settings.project = project
class Asked:
    out, camera, baked, edits, frame_range = "", "", False, "", (-1, -1)
    source, size = "orbit", (80, 0)
    def value(self, context, name):
        return {"run": "main", "source": self.source, "size": self.size, "orbit": 4, "passes": {"rgb"}}[name]
    project_path = lambda self, context: project
def sized(source, size, camera=""):
    Asked.source, Asked.size, Asked.camera = source, size, camera
    try:
        return FIELDWORK_OT_render.parameters(Asked(), bpy.context)["size"]
    except ValueError as error:
        return str(error)
answer([sized("orbit", (80, 0)), sized("photos", (0, 60)), sized("camera", (80, 0), "file.json"), sized("orbit", (80, 60)),
        sized("orbit", (0, 0)), sized("camera", (80, 0))])
""",
        project=make_project(tmp_path / "capture"),
    )
    assert all("both width and height" in told for told in facts[:3])
    assert facts[3:] == [[80, 60], None, None], "the scene's camera has a height of its own"


def test_a_render_region_that_does_not_count_is_told(bpy_script, tmp_path):
    facts = bpy_script(
        SETUP
        + """
from fieldwork.operators.render import FIELDWORK_OT_render
settings.project, told = project, []
class Asked:
    out, camera, baked, edits, frame_range = "", "", False, "", (-1, -1)
    value = lambda self, context, name: getattr(settings, FIELDWORK_OT_render.scene_names[name])
    project_path = lambda self, context: project
    report = lambda self, kind, text: told.append(text)
for source, region in (("camera", True), ("orbit", True), ("camera", False)):
    settings.render_from, scene.render.use_border = source, region
    FIELDWORK_OT_render.parameters(Asked(), bpy.context)
answer(told)
""",
        project=make_project(tmp_path / "capture"),
    )
    assert facts == ["The whole picture is rendered: Render Region is for F12"]


def test_renders_find_their_cameras_when_things_are_renamed_or_gone_meanwhile(bpy_script, tmp_path):
    facts = bpy_script(
        SETUP
        + """
from fieldwork.addon.render import result
from fieldwork.addon.roles import Owner
files, owner = [], Owner("capture")
for name in ("a", "b"):
    image = bpy.data.images.new(name, 8, 8)
    image.filepath_raw, image.file_format = f"{folder}/{name}.png", "PNG"
    image.save()
    files.append(Path(folder, f"{name}.png"))
    camera = bpy.data.objects.new(name, bpy.data.cameras.new(name))
    owner.mark(camera, f"camera:{name}")
    scene.collection.objects.link(camera)
def play(meanwhile):
    steps = result.show_steps(scene, files, "background", True, owner)
    pairs, count = None, 0
    while pairs is None:
        try:
            next(steps)
            count += 1
            meanwhile.get(count, lambda: None)()
        except StopIteration as end:
            pairs = end.value
    return [[camera.name, image.name] for camera, image in pairs]
def rename(item, name):
    item.name = name
renamed = play({1: lambda: rename(scene, "Other"), 3: lambda: rename(bpy.data.objects["a"], "first")})
other = bpy.data.scenes.new("Left")
gone = play({1: lambda: bpy.data.scenes.remove(scene)})
answer([renamed, gone])
""",
        folder=tmp_path,
    )
    assert facts == [[["first", "a"], ["b", "b"]], []]
