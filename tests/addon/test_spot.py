"""What a click on the surface says, and which photos it finds."""

from __future__ import annotations

import json

import numpy as np
import pytest
from fieldwork.tests.addon.test_mesh_import import make_package

LOOK = """
import numpy as np
import fieldwork
fieldwork.register()
from mathutils import Vector
from fieldwork.addon.scene.package import read_package
from fieldwork.addon.scene.build import import_package
from fieldwork.addon.scene.spot import spot_at
from fieldwork.addon.scene import visibility
from fieldwork.addon.roles import Owner
from fieldwork.operators.picking import spot_text
scene = bpy.context.scene
for item in list(bpy.data.objects):
    bpy.data.objects.remove(item)
made = import_package(scene, read_package(package), split=split)
# A box of the user's before the surface, which is looked through.
bpy.ops.mesh.primitive_cube_add(size=0.1, location=(0.3, 0.7, 1))
bpy.context.view_layer.update()
def spot(x, y, z=2, down=-1):
    found = spot_at(scene, bpy.context.evaluated_depsgraph_get(), Vector((x, y, z)), Vector((0, 0, down)))
    return found and {
        "class": [found.class_id, found.class_name], "instance": found.instance, "confidence": found.confidence,
        "photos": [shown.camera.name for shown in found.photos],
        "sharpness": [shown.sharpness for shown in found.photos],
        "place": list(found.place), "text": spot_text(found)}
answers = {"gold": spot(0.7, 0.7), "stone": spot(0.3, 0.7), "beside": spot(3, 3), "behind": spot(0.7, 0.7, -2, 1)}
for item in visibility.meshes(Owner("capture")):
    visibility.hide_classes(item, [2])
bpy.context.view_layer.update()
answers["hidden"] = spot(0.7, 0.7)
answers["left"] = spot(0.3, 0.7)
answers["shown"] = sorted(bpy.ops.fieldwork.show_photo(camera="near"))
answers["camera"] = scene.camera.name
try:
    bpy.ops.fieldwork.show_photo(camera="nobody")
except RuntimeError as error:
    answers["nobody"] = str(error)
bpy.context.view_layer.objects.active = scene.objects["Surface"] if split == "none" else scene.objects["stone"]
bpy.ops.object.mode_set(mode="EDIT")
answers["edited"] = spot(0.3, 0.7)
bpy.ops.object.mode_set(mode="OBJECT")
bpy.context.object.modifiers.new("Remesh", "REMESH").voxel_size = 0.2
bpy.context.view_layer.update()
answers["remeshed"] = spot(0.3, 0.7)
answers["waits"] = bpy.ops.fieldwork.pick_surface.poll()
answer(answers)
"""


@pytest.mark.parametrize("split", ["none", "instances"])
def test_a_place_says_what_it_is_and_which_photos_show_it(bpy_script, tmp_path, split):
    folder = make_package(tmp_path / "package", 9, cameras=5, points=4)
    with np.load(folder / "mesh.npz") as data:
        arrays = {name: data[name] for name in data.files}
    middle = arrays["vertices"][arrays["faces"]].mean(1)
    # A small sheet hangs above the gold half, between it and the last camera.
    flap = np.array([[0.84, 0.6, 1], [0.86, 0.6, 1], [0.85, 0.8, 1]], np.float32)
    arrays["face_class"] = np.append(np.where(middle[:, 0] < 0.44, 1, 2), 1)
    arrays["face_instance"] = np.append(np.where(middle[:, 0] < 0.44, 0, 7), 0)
    arrays["unseen"] = np.append(middle[:, 0] < 0.44, False)
    arrays["faces"] = np.vstack([arrays["faces"], np.arange(3) + len(arrays["vertices"])])
    arrays["vertices"] = np.vstack([arrays["vertices"], flap])
    arrays["uv"] = np.vstack([arrays["uv"], np.zeros((1, 3, 2), np.float32)])
    for name in ("colors", "class_id"):
        arrays[name] = np.concatenate([arrays[name], arrays[name][:3]])
    arrays["confidence"] = np.full(len(arrays["vertices"]), 0.75, np.float32)
    np.savez(folder / "mesh.npz", **arrays)
    value = json.loads((folder / "package.json").read_text())
    value["instances"] = [{"id": 7, "name": "gold.001", "class_id": 2}]
    places = {"near": (0.7, 0.7, 1.5), "far": (0.7, 0.7, 4.0), "off": (6, 0.7, 2), "below": (0.7, 0.7, -2)}
    places["covered"] = (1.0, 0.7, 2.0)
    for entry, (name, place) in zip(value["cameras"], places.items()):
        pose = np.diag([1.0, 1, 1, 1] if name != "below" else [1.0, -1, -1, 1])
        pose[:3, 3] = place
        entry |= {"name": name, "camera_to_world": pose.tolist()}
    (folder / "package.json").write_text(json.dumps(value))
    facts = bpy_script(LOOK, package=folder, split=split)
    gold = facts["gold"]
    assert gold["class"] == [2, "gold"]
    assert gold["instance"] == "gold.001"
    assert gold["confidence"] == pytest.approx(0.75)
    assert gold["place"] == pytest.approx([0.7, 0.7, 0], abs=1e-5)
    # "off" does not have it in its picture, "below" sees the other side, the flap stands before "covered".
    assert gold["photos"] == ["near", "far"]
    assert gold["sharpness"] == pytest.approx([40 / 1.5, 40 / 4], rel=1e-4)
    assert gold["text"] == "gold, gold.001: 75% sure, shown by 2 photos"
    assert facts["stone"]["class"] == [1, "stone"]
    assert facts["stone"]["text"] == "stone: 75% sure, its surface a guess"
    assert facts["stone"]["instance"] == ""
    assert facts["behind"]["photos"] == ["below"]
    assert facts["beside"] is None
    assert facts["hidden"] is None
    assert facts["edited"] is None
    assert facts["remeshed"] is None
    assert facts["left"]["class"] == [1, "stone"]
    assert facts["shown"] == ["FINISHED"]
    assert facts["camera"] == "near"
    assert "nobody" in facts["nobody"]
    assert facts["waits"] is False
