"""A data set from any .blend: poses, labels and depth must tell one story, whatever the path and the lens."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import OpenImageIO as oiio
import pytest
from fieldwork.nerfcore.blender.dataset import dataset
from fieldwork.nerfcore.data.importer import import_dataset
from fieldwork.nerfcore.data.load import load_scene
from fieldwork.nerfcore.errors import BlenderError, InputError
from fieldwork.nerfcore.geometry.cameras import Camera, flip_camera_axes, pixel_centers, rays
from fieldwork.nerfcore.params import DatasetParams, ImportParams
from fieldwork.nerfcore.progress import Reporter
from fieldwork.nerfcore.project.store import load_project
from PIL import Image

# A floor of 4 m at z = 0 and a cube of 1 m on it; a camera with a vertical sensor fit and a shift that moves for ten
# frames under a scaled parent; a circle of 3 m to walk along.
SCENE = """
from math import pi
bpy.ops.wm.read_homefile(use_factory_startup=True, use_empty=True)
scene = bpy.context.scene
def thing(make, name, color, collection, **arguments):
    make(**arguments)
    item = bpy.context.object
    item.name = name
    material = bpy.data.materials.new("paint of " + name)
    material.diffuse_color = (*color, 1)
    item.data.materials.append(material)
    group = bpy.data.collections.new(collection)
    scene.collection.children.link(group)
    for old in item.users_collection:
        old.objects.unlink(item)
    group.objects.link(item)
thing(bpy.ops.mesh.primitive_plane_add, "floor", (0.2, 0.5, 0.2), "ground", size=4)
thing(bpy.ops.mesh.primitive_cube_add, "cube", (0.8, 0.1, 0.1), "things", size=1, location=(0, 0, 0.5))
spare = bpy.data.materials.new("spare paint that nothing wears")
spare.pass_index, spare.use_fake_user = 7, True
bpy.ops.object.light_add(type="SUN", rotation=(0.5, 0.3, 0))
bpy.ops.curve.primitive_bezier_circle_add(radius=3, location=(0, 0, 2))
bpy.context.object.name = "walk"
bpy.ops.object.empty_add()
parent = bpy.context.object
parent.scale = (2, 2, 2)
bpy.ops.object.camera_add(location=(2, 0, 1.2), rotation=(1.1, 0, pi / 2))
camera = scene.camera = bpy.context.object
camera.parent = parent
camera.data.sensor_fit, camera.data.sensor_height, camera.data.lens = "VERTICAL", 30, 40
camera.data.shift_x, camera.data.shift_y = 0.08, -0.05
for frame, x in ((1, 2.0), (10, 2.6)):
    camera.location.x = x
    camera.keyframe_insert("location", frame=frame)
scene.frame_start, scene.frame_end = 1, 10
scene.render.resolution_x, scene.render.resolution_y, scene.render.resolution_percentage = 240, 160, 50
bpy.ops.wm.save_as_mainfile(filepath=path)
answer(True)
"""


@pytest.fixture(scope="module")
def blend(tmp_path_factory, bpy_script) -> Path:
    path = tmp_path_factory.mktemp("scene") / "Büro.blend"
    bpy_script(SCENE, path=path)
    return path


def take(blend: Path, out: Path, **changes) -> dict:
    return dataset(DatasetParams(**{"blend": blend, "out": out, "views": 4, "samples": 1, **changes}), Reporter())


def surfaces(out: Path) -> dict[int, np.ndarray]:
    """World points (N, 3) of all pixels, by class id."""
    truth = json.loads((out / "transforms.json").read_text())
    assert truth["depth_unit_scale_factor"] == 1.0  # without it others would read millimetres
    found: dict[int, list[np.ndarray]] = {}
    for frame in truth["frames"]:
        lens = {**truth, **frame}
        camera = Camera(
            width=lens["w"], height=lens["h"], fx=lens["fl_x"], fy=lens["fl_y"], cx=lens["cx"], cy=lens["cy"]
        )
        pose = flip_camera_axes(np.array(frame["transform_matrix"]))
        label = np.array(Image.open(out / frame["label_path"]))
        depth = oiio.ImageBuf(str(out / frame["depth_file_path"])).get_pixels(oiio.FLOAT)[..., 0]
        assert label.shape == depth.shape == (camera.height, camera.width)
        assert Image.open(out / frame["file_path"]).size == (camera.width, camera.height)
        directions, _ = rays(camera, pixel_centers(camera.width, camera.height).reshape(-1, 2))
        world = directions / directions[:, 2:] * depth.reshape(-1, 1) @ pose[:3, :3].T + pose[:3, 3]
        for number in np.unique(label):
            found.setdefault(int(number), []).append(world[label.reshape(-1) == number])
    return {number: np.concatenate(parts) for number, parts in found.items()}


CLASSES = {
    "material": ["paint of cube", "paint of floor"],
    "object": ["cube", "floor"],
    "collection": ["ground", "things"],
}


@pytest.mark.parametrize(
    ("path", "labels"),
    [("hemisphere", "material"), ("camera", "object"), ("curve", "collection"), ("sphere", "material")],
)
def test_labels_depth_and_poses_agree(path, labels, blend, tmp_path):
    result = take(blend, tmp_path / "out", path=path, labels=labels, curve="walk" if path == "curve" else None)
    assert result["images"] == 4
    named = json.loads((tmp_path / "out/classes.json").read_text())["classes"]
    assert list(named.values()) == result["classes"]
    assert set(CLASSES[labels]) <= set(result["classes"])
    ids = {name: int(number) for number, name in named.items()}
    cube, floor = (ids[name] for name in (CLASSES[labels] if labels != "collection" else ["things", "ground"]))
    found = surfaces(tmp_path / "out")
    assert np.abs(found[floor][:, 2]).max() < 2e-3
    assert np.abs(found[floor][:, :2]).max() < 2.001
    from_center = np.abs(found[cube] - [0, 0, 0.5])
    np.testing.assert_allclose(from_center.max(-1), 0.5, atol=2e-3)
    assert set(found) <= {0, cube, floor}


def test_everything_is_in_the_picture_from_the_hemisphere(blend, tmp_path):
    take(blend, tmp_path / "out", views=6)
    for path in (tmp_path / "out/labels").iterdir():
        label = np.asarray(Image.open(path))
        border = np.concatenate([label[0], label[-1], label[:, 0], label[:, -1]])
        assert (border == 0).all()
        assert (label != 0).mean() > 0.02


def test_transparent_photos_have_alpha_only_where_something_is(blend, tmp_path):
    take(blend, tmp_path / "out", views=1, transparent=True, labels="none", depth=False, size=(60, 40))
    assert sorted(p.name for p in (tmp_path / "out").iterdir()) == ["dataset.json", "images", "transforms.json"]
    pixels = np.asarray(Image.open(tmp_path / "out/images/0001.png"))
    assert pixels.shape == (40, 60, 4)
    assert pixels[0, 0, 3] == 0
    assert pixels[20, 30, 3] == 255


def test_the_data_set_becomes_a_project_in_the_scene_s_own_frame(blend, tmp_path):
    take(blend, tmp_path / "out", path="camera", labels="object")
    report = Reporter()
    result = import_dataset(ImportParams(dataset=tmp_path / "out", project=tmp_path / "project"), report)
    assert result["images"] == result["labelled"] == 4
    assert not report.warnings
    assert load_project(tmp_path / "project").frame.scale_known
    scene = load_scene(tmp_path / "project")
    truth = json.loads((tmp_path / "out/transforms.json").read_text())["frames"]
    for view, frame in zip(scene.views, truth):
        np.testing.assert_allclose(flip_camera_axes(view.camera_to_world), frame["transform_matrix"], atol=1e-5)
    assert {c.name for c in scene.classes} >= {"cube", "floor"}


def test_a_second_run_takes_only_what_is_missing(blend, tmp_path):
    take(blend, tmp_path / "out")
    photos = sorted((tmp_path / "out/images").iterdir())
    times = [p.stat().st_mtime_ns for p in photos]
    photos[1].unlink()
    take(blend, tmp_path / "out")
    assert [p.stat().st_mtime_ns == t for p, t in zip(photos, times)] == [True, False, True, True]
    with pytest.raises(InputError, match="other settings"):
        take(blend, tmp_path / "out", samples=2)


def test_what_cannot_be_photographed_is_said(blend, tmp_path, bpy_script):
    with pytest.raises(InputError, match="does not exist"):
        take(tmp_path / "none.blend", tmp_path / "a")
    with pytest.raises(BlenderError, match="no curve “river”"):
        take(blend, tmp_path / "b", path="curve", curve="river")
    bpy_script(
        "bpy.ops.wm.read_homefile(use_factory_startup=True, use_empty=True)\n"
        "bpy.ops.wm.save_as_mainfile(filepath=path)\nanswer(1)",
        path=tmp_path / "empty.blend",
    )
    with pytest.raises(BlenderError, match="shows nothing"):
        take(tmp_path / "empty.blend", tmp_path / "c")
    with pytest.raises(BlenderError, match="no perspective camera"):
        take(tmp_path / "empty.blend", tmp_path / "d", path="camera")


ODD = """
bpy.ops.wm.open_mainfile(filepath=blend)
scene = bpy.context.scene
scene.camera, scene.view_layers[0].name = bpy.data.objects["cube"], "v1.2 final"
bpy.ops.wm.save_as_mainfile(filepath=path, copy=True)
answer(1)
"""


def test_dots_in_names_of_view_layers_and_cameras_that_are_none_do_not_matter(blend, tmp_path, bpy_script):
    bpy_script(ODD, blend=blend, path=tmp_path / "odd.blend")
    take(tmp_path / "odd.blend", tmp_path / "out", views=1)
    assert set(surfaces(tmp_path / "out")) - {0} == {1, 2}
    with pytest.raises(BlenderError, match="no perspective camera"):
        take(tmp_path / "odd.blend", tmp_path / "path", path="camera")


LINKED = """
bpy.ops.wm.open_mainfile(filepath=blend)
bpy.data.scenes[0].collection.children.unlink(bpy.data.collections["things"])
bpy.data.collections["things"].use_fake_user = True
bpy.ops.wm.save_as_mainfile(filepath=library, copy=True)
bpy.data.collections.remove(bpy.data.collections["things"])
with bpy.data.libraries.load(library, link=True) as (_, wanted):
    wanted.collections = ["things"]
holder = bpy.data.collections.new("holder")
bpy.context.scene.collection.children.link(holder)
if instance:
    if instance == "beside":
        bpy.context.scene.collection.children.link(wanted.collections[0])
    empty = bpy.data.objects.new("instance", None)
    empty.instance_type, empty.instance_collection = "COLLECTION", wanted.collections[0]
    holder.objects.link(empty)
else:
    holder.children.link(wanted.collections[0])
bpy.ops.wm.save_as_mainfile(filepath=path, copy=True)
answer(1)
"""


@pytest.mark.parametrize("instance", ["", "alone", "beside"])
def test_what_is_linked_from_another_file_has_the_class_of_its_collection(blend, tmp_path, bpy_script, instance):
    bpy_script(LINKED, blend=blend, path=tmp_path / "here.blend", library=tmp_path / "library.blend", instance=instance)
    take(tmp_path / "here.blend", tmp_path / "out", views=1, labels="collection")
    classes = json.loads((tmp_path / "out/classes.json").read_text())["classes"]
    found = {classes[str(number)]: places for number, places in surfaces(tmp_path / "out").items() if number}
    own = "things" if instance == "beside" else "holder"  # where it lies itself counts before where it is instanced
    assert set(found) == {"ground", own}
    assert found[own][:, 2].max() > 0.9, "the cube"


NAMESAKES = """
bpy.ops.wm.open_mainfile(filepath=blend)
own, other = bpy.data.materials["paint of floor"], bpy.data.materials["paint of cube"]
own.name, other.name = "kept", "paint"
bpy.ops.wm.save_as_mainfile(filepath=library, copy=True)
bpy.data.objects.remove(bpy.data.objects["cube"])
bpy.data.materials.remove(other)
own.name = "paint"
with bpy.data.libraries.load(library, link=True) as (_, wanted):
    wanted.collections = ["things"]
bpy.context.scene.collection.children.link(wanted.collections[0])
bpy.ops.wm.save_as_mainfile(filepath=path, copy=True)
answer(1)
"""


def test_materials_of_two_files_that_have_one_name_are_one_class(blend, tmp_path, bpy_script):
    bpy_script(NAMESAKES, blend=blend, path=tmp_path / "here.blend", library=tmp_path / "library.blend")
    take(tmp_path / "here.blend", tmp_path / "out", views=1)
    places = surfaces(tmp_path / "out")
    assert set(places) == {0, 1}
    assert places[1][:, 2].max() > 0.9, "the cube"
    assert np.abs(places[1][:, :2]).max() > 1.5, "the floor"


NUMBERS = """
bpy.ops.wm.open_mainfile(filepath=blend)
for name, number in (("floor", 300), ("cube", 2)):
    bpy.data.objects[name].pass_index = number
bpy.ops.wm.save_as_mainfile(filepath=path, copy=True)
answer(1)
"""


def test_class_numbers_above_255_reach_the_project(blend, tmp_path, bpy_script):
    bpy_script(NUMBERS, blend=blend, path=tmp_path / "numbers.blend")
    result = take(tmp_path / "numbers.blend", tmp_path / "set", labels="object", views=2)
    assert result["classes"] == ["cube", "floor"]
    for path in (tmp_path / "set/labels").iterdir():
        label = np.array(Image.open(path))
        assert label.dtype == np.uint16
        assert set(np.unique(label).tolist()) == {0, 2, 300}
    assert np.abs(surfaces(tmp_path / "set")[300][:, 2]).max() < 1e-3, "300 is the floor"
    import_dataset(ImportParams(dataset=tmp_path / "set", project=tmp_path / "project"), Reporter())
    scene = load_scene(tmp_path / "project")
    assert [c.id for c in scene.classes] == [2, 300]
    assert set(np.unique(np.array(Image.open(scene.views[0].label))).tolist()) == {0, 2, 300}


OPERATOR = """
import fieldwork
fieldwork.register()
from fieldwork.addon import machine
machine.engine_python = lambda: Path(sys.executable)
bpy.ops.wm.open_mainfile(filepath=blend)
bpy.data.objects["cube"].location.x = 1.5  # not saved: the scene is photographed as it is now
result = bpy.ops.fieldwork.dataset(out=out, views=3, samples=1, labels="object", path_kind="hemisphere")
try:
    bpy.ops.fieldwork.dataset(out=out, views=3)
    refused = ""
except RuntimeError as error:
    refused = str(error)
from fieldwork.addon.jobs.queue import queue
queue.stop_engine()
answer({"result": list(result), "project": bpy.context.scene.fieldwork.project, "refused": refused, "left": os.listdir(bpy.app.tempdir)})
"""


def test_the_operator_photographs_the_scene_as_it_is_and_makes_a_project(blend, tmp_path, bpy_script):
    facts = bpy_script(OPERATOR, blend=blend, out=tmp_path / "set")
    assert facts["result"] == ["FINISHED"]
    assert facts["project"] == str(tmp_path / "set_fieldwork")
    assert "not empty" in facts["refused"]
    assert not any(name.endswith(".blend") for name in facts["left"])
    ids = json.loads((tmp_path / "set/classes.json").read_text())["classes"]
    cube = surfaces(tmp_path / "set")[next(int(k) for k, name in ids.items() if name == "cube")]
    np.testing.assert_allclose(np.abs(cube - [1.5, 0, 0.5]).max(-1), 0.5, atol=2e-3)
    assert len(load_scene(tmp_path / "set_fieldwork").views) == 3


def test_the_dialog_says_the_size_that_photos_get(bpy_script):
    """33 % of 1920 pixels are 633, as Blender has it."""
    facts = bpy_script(
        """
from types import SimpleNamespace
from unittest.mock import MagicMock
import fieldwork
fieldwork.register()
from fieldwork.addon.photograph.dataset import scene_size
from fieldwork.operators.dataset import FIELDWORK_OT_dataset
render, layout = bpy.context.scene.render, MagicMock()
render.resolution_x, render.resolution_y, render.resolution_percentage = 1920, 1081, 33
own = SimpleNamespace(layout=layout, path_kind="camera", size=(0, 0))
FIELDWORK_OT_dataset.draw(own, bpy.context)
told = layout.column().label.call_args.kwargs["text"]
answer([told, scene_size(bpy.context.scene, None)])
"""
    )
    assert facts[1] == [633, 356]
    assert facts[0].startswith("633 × 356 pixels")


def test_a_scene_in_centimetres_becomes_a_data_set_in_metres(blend, tmp_path, bpy_script):
    """Lengths of the scene, times the scale of its units: here the cube of one unit has a side of one centimetre."""
    small = tmp_path / "small.blend"
    code = "bpy.ops.wm.open_mainfile(filepath=path)\nbpy.context.scene.unit_settings.scale_length = 0.01\n"
    bpy_script(code + "bpy.ops.wm.save_as_mainfile(filepath=out)\nanswer(1)", path=blend, out=small)
    result = take(small, tmp_path / "out", views=2, labels="object")
    ids = {name: number for number, name in enumerate(["", *result["classes"]])}
    from_center = np.abs(surfaces(tmp_path / "out")[ids["cube"]] - [0, 0, 0.005])
    np.testing.assert_allclose(from_center.max(-1), 0.005, atol=5e-5)


def test_the_scene_s_camera_keeps_its_step_of_frames(bpy_script):
    names = bpy_script(
        """
from fieldwork.addon.photograph.dataset import camera_shots
scene = bpy.context.scene
scene.frame_start, scene.frame_end, scene.frame_step = 2, 12, 5
answer([shot.name for shot in camera_shots(scene, 100, None)])
"""
    )
    assert names == ["0002", "0007", "0012"]


CUTS = """
from fieldwork.addon.photograph.dataset import camera_shots, plan
from fieldwork.addon.photograph.shoot import photograph
bpy.ops.wm.open_mainfile(filepath=blend)
scene = bpy.context.scene
first = scene.camera
second = bpy.data.objects.new("second", bpy.data.cameras.new("second"))
second.location = 0, 0, 12
scene.collection.objects.link(second)
request = {"path": "hemisphere", "views": 3, "size": [32, 48], "center": None, "radius": None}
shots = plan(scene, request)

def depths(name):
    photograph(scene, shots, Path(folder) / name, samples=1, labels="none")
    import numpy as np
    return np.stack([np.load(Path(folder) / name / f"{shot.name}.depth.npy") for shot in shots])

plain = depths("plain")
scene.render.use_stamp = scene.render.use_multiview = True
for name, frame, camera in (("a", 1, first), ("b", 6, second)):
    scene.timeline_markers.new(name, frame=frame).camera = camera
scene.frame_set(1)
marked = depths("marked")
places = {shot.name: [round(float(v), 3) for v in shot.camera_to_world[:3, 3]] for shot in camera_shots(scene, 10, None)}
answer({
    "same": bool((plain == marked).all()), "seen": float((plain > 0).mean()), "places": places,
    "after": [scene.frame_current, scene.camera.name, [m.camera.name for m in scene.timeline_markers]],
    "first": first.name, "kept": [scene.render.use_stamp, scene.render.use_multiview],
})
"""


def test_cameras_of_timeline_markers_are_followed_only_along_the_scene_s_camera(blend, tmp_path, bpy_script):
    facts = bpy_script(CUTS, blend=blend, folder=tmp_path)
    assert facts["same"], "photos along other paths do not look through the cameras of the markers"
    assert facts["seen"] > 0.02
    assert facts["places"]["0006"] == facts["places"]["0010"] == [0, 0, 12]
    assert facts["places"]["0001"] != facts["places"]["0005"] != [0, 0, 12]
    assert facts["after"] == [1, facts["first"], [facts["first"], "second"]]
    assert facts["kept"] == [True, True]
    plain, marked = (sorted((tmp_path / name).glob("*.png")) for name in ("plain", "marked"))
    assert [p.name for p in plain] == [p.name for p in marked]
    for one, other in zip(plain, marked):
        np.testing.assert_array_equal(np.asarray(Image.open(one)), np.asarray(Image.open(other)))


MIRRORED = """
bpy.ops.wm.open_mainfile(filepath=blend)
scene = bpy.context.scene
scene.camera.parent.scale = eval(scale)
scene.camera.data.shift_x = 0
bpy.ops.wm.save_as_mainfile(filepath=path, copy=True)
matrix = scene.camera.evaluated_get(bpy.context.evaluated_depsgraph_get()).matrix_world
answer([list(row) for row in matrix])
"""


@pytest.mark.parametrize("scale", ["(-2, 2, 2)", "(-1, -1, -1)", "(1, 3, 0.5)"])
def test_a_camera_under_a_mirrored_or_stretched_parent_looks_the_same_way(blend, tmp_path, bpy_script, scale):
    matrix = np.array(bpy_script(MIRRORED, blend=blend, path=tmp_path / "m.blend", scale=scale))
    take(tmp_path / "m.blend", tmp_path / "out", path="camera", views=1, labels="none", depth=False)
    pose = np.array(json.loads((tmp_path / "out/transforms.json").read_text())["frames"][0]["transform_matrix"])
    np.testing.assert_allclose(pose[:3, :3] @ pose[:3, :3].T, np.eye(3), atol=1e-5)
    assert np.linalg.det(pose[:3, :3]) > 0
    np.testing.assert_allclose(pose[:3, 3], matrix[:3, 3], atol=1e-5)
    back, up = (matrix[:3, k] / np.linalg.norm(matrix[:3, k]) for k in (2, 1))
    np.testing.assert_allclose(pose[:3, 2], back, atol=1e-5)
    assert pose[:3, 1] @ up > 0.8


HIDDEN = """
bpy.ops.wm.open_mainfile(filepath=blend)
scene = bpy.context.scene
bpy.data.objects["cube"].hide_viewport = how == "monitor"
bpy.data.objects["cube"].hide_set(how == "eye")
scene.view_layers[0].layer_collection.children["things"].hide_viewport = how == "collection"
bpy.ops.mesh.primitive_cube_add(size=1, location=(40, 0, 0))  # a helper that is not rendered
helper = bpy.context.object
helper.data.materials.append(bpy.data.materials.new("paint of helper"))
group = bpy.data.collections.new("helpers")
scene.collection.children.link(group)
for old in helper.users_collection:
    old.objects.unlink(helper)
group.objects.link(helper)
group.hide_render = True
bpy.ops.wm.save_as_mainfile(filepath=path, copy=True)
answer(1)
"""


@pytest.mark.parametrize("how", ["monitor", "eye", "collection"])
def test_what_renders_counts_and_not_what_the_viewport_shows(blend, tmp_path, bpy_script, how):
    bpy_script(HIDDEN, blend=blend, path=tmp_path / "hidden.blend", how=how)
    result = take(tmp_path / "hidden.blend", tmp_path / "out", views=2)
    assert result["classes"] == CLASSES["material"]
    found = surfaces(tmp_path / "out")
    assert set(found) == {0, 1, 2}
    np.testing.assert_allclose(np.abs(found[1] - [0, 0, 0.5]).max(-1), 0.5, atol=2e-3)
