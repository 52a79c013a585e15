"""The surface in the scene: one slider from photo colours over class colours to confidence, objects, collections and
what was measured."""

from __future__ import annotations

import json

import numpy as np
import pytest
from fieldwork.tests.addon.test_mesh_import import make_package

MEASURES = {
    "unit": "m",
    "classes": [
        {"id": 1, "name": "stone", "area": 0.5, "area_low": 0.4, "area_high": 0.6, "volume": None},
        {"id": 2, "name": "gold", "area": 0.3, "area_low": 0.2, "area_high": 0.4, "volume": None},
    ],
    "instances": [{"id": 1, "name": "gold.001", "area": 0.1, "area_low": 0.1, "area_high": 0.1, "volume": 0.25}],
}


@pytest.fixture
def package(tmp_path):
    """A sheet: left half stone, right half gold, of which the upper part is an instance; photos see it in one colour."""
    folder = make_package(tmp_path / "package", 9, cameras=2, points=4)
    with np.load(folder / "mesh.npz") as data:
        arrays = {name: data[name] for name in data.files if name != "uv"}
    middle = arrays["vertices"][arrays["faces"]].mean(1)
    arrays["face_class"] = np.where(middle[:, 0] < 0.44, 1, 2).astype(np.uint16)
    arrays["face_instance"] = ((arrays["face_class"] == 2) & (middle[:, 1] > 0.44)).astype(np.uint32)
    arrays["colors"] = np.full((len(arrays["vertices"]), 3), (200, 100, 50), np.uint8)
    arrays["unseen"] = arrays["face_class"] == 1
    arrays["confidence"] = np.where(arrays["vertices"][:, 1] > 0.5, 1.0, 0.0).astype(np.float32)
    np.savez(folder / "mesh.npz", **arrays)
    value = json.loads((folder / "package.json").read_text())
    value |= {"measures": MEASURES, "instances": [{"id": 1, "name": "gold.001", "class_id": 2}]}
    value["label_revision"] = 7
    value["classes"] = [
        {"id": 1, "name": "stone", "color": [0.1, 0.2, 0.9]},
        {"id": 2, "name": "gold", "color": [0.9, 0.8, 0.0]},
    ]
    (folder / "package.json").write_text(json.dumps(value))
    return folder


IMPORT = """
import numpy as np
from fieldwork.addon.scene.package import read_package
from fieldwork.addon.scene.build import import_package
bpy.ops.wm.read_factory_settings(use_empty=True)
scene = bpy.context.scene
made = import_package(scene, read_package(package), split=split)
root = made.root
"""

SLIDE = """
def shown():
    # What Workbench draws at the corners of the first and the last face.
    root.update_tag()
    bpy.context.view_layer.update()
    mesh = made.mesh.evaluated_get(bpy.context.evaluated_depsgraph_get()).data
    assert mesh.color_attributes.active_color_name == "Shown"
    assert mesh.color_attributes.active_color.domain == "CORNER"
    corners = mesh.color_attributes["Shown"].data
    return [[round(255 * c) for c in corners[i].color_srgb[:3]] for i in (0, len(corners) - 1)]
before = list(made.mesh.data.color_attributes["Shown"].data[0].color_srgb[:3])
views = {}
for value in (0.0, 0.5, 1.0, 2.0):
    root["show_labels"] = value
    views[value] = shown()
bpy.context.scene.camera = None
data = bpy.data.cameras.new("above")
above = bpy.data.objects.new("above", data)
data.type, data.ortho_scale = "ORTHO", 0.88
scene.collection.objects.link(above)
above.location = (0.444, 0.444, 2)
scene.camera = above
scene.render.engine, scene.cycles.samples, scene.cycles.use_denoising = "CYCLES", 1, False
scene.render.resolution_x = scene.render.resolution_y = 16
scene.view_settings.view_transform = "Standard"
for item in scene.objects:
    item.hide_render = item != made.mesh
for value in (0.0, 1.0, 2.0):
    root["show_labels"] = value
    root.update_tag()
    scene.render.filepath = f"{out}/{value}.png"
    bpy.ops.render.render(write_still=True)
groups = [t.name for t in bpy.data.node_groups if t.bl_idname == "ShaderNodeTree" and "points" not in t.name]
limits = root.id_properties_ui("show_labels").as_dict()
answer({"views": views, "groups": groups, "before": before, "limits": [limits["min"], limits["max"]],
        "users": len({m.node_tree.nodes[0].node_tree for m in made.mesh.data.materials})})
"""


def test_one_slider_goes_from_photos_over_classes_to_confidence(package, tmp_path, bpy_script):
    from PIL import Image

    facts = bpy_script(IMPORT + SLIDE, package=package, split="none", out=tmp_path)
    photo, stone, gold, unsure, sure = (200, 100, 50), (26, 51, 230), (230, 204, 0), (68, 1, 84), (253, 231, 37)
    views = facts["views"]
    assert np.abs(np.array(facts["before"]) * 255 - photo).max() <= 1
    for value, (first, last) in {"0.0": (photo, photo), "1.0": (stone, gold), "2.0": (unsure, sure)}.items():
        np.testing.assert_allclose(views[value], [first, last], atol=2)
        picture = np.asarray(Image.open(tmp_path / f"{value}.png").convert("RGB")).astype(int)
        np.testing.assert_allclose(picture[14, 1], first, atol=2, err_msg=f"slider at {value}")
        np.testing.assert_allclose(picture[1, 14], last, atol=2, err_msg=f"slider at {value}")
    assert 26 < views["0.5"][0][0] < 200
    assert facts["groups"] == ["Fieldwork Surface · capture"]
    assert facts["users"] == 1
    assert facts["limits"] == [0, 2]


SPLIT = """
def describe(item):
    return {key: item[key] for key in item.keys() if key in ("area", "area_low", "area_high", "volume", "unit")}
meshes = {m.name: m for m in made.meshes}
hidden = []
import fieldwork.addon.scene.visibility as visibility
from fieldwork.addon.roles import Owner
for item in visibility.meshes(Owner("capture")):
    visibility.hide_classes(item, [2])
bpy.context.view_layer.update()
depsgraph = bpy.context.evaluated_depsgraph_get()
answer({
    "names": sorted(meshes),
    "collections": {name: [c.name for c in m.users_collection] for name, m in meshes.items()},
    "measured": {name: describe(m) for name, m in meshes.items()},
    "materials": {m.name: describe(m) for m in next(iter(meshes.values())).data.materials},
    "faces": {name: len(m.data.polygons) for name, m in meshes.items()},
    "instances": {name: sorted({v.value for v in m.data.attributes["instance_id"].data}) for name, m in meshes.items()},
    "unseen": {name: [v.value for v in m.data.attributes["unseen"].data] for name, m in meshes.items()},
    "left": {name: len(m.evaluated_get(depsgraph).data.polygons) for name, m in meshes.items()},
    "revisions": sorted({m["label_revision"] for m in meshes.values()}),
    "again": sorted(m.name for m in import_package(scene, read_package(package), split="none").meshes),
    "after": sorted(c.name for c in bpy.data.collections),
})
"""


@pytest.mark.parametrize("split", ["classes", "instances"])
def test_objects_are_named_and_sorted_by_class_and_say_what_was_measured(package, bpy_script, split):
    facts = bpy_script(IMPORT + SPLIT, package=package, split=split)
    names = ["gold", "stone"] if split == "classes" else ["gold", "gold.001", "stone"]
    assert facts["names"] == names
    assert facts["collections"] == {name: [name.split(".")[0]] for name in names}
    stone = {"area": 0.5, "area_low": 0.4, "area_high": 0.6, "unit": "m"}
    assert facts["measured"]["stone"] == stone
    assert facts["materials"]["capture · stone"] == stone
    assert facts["materials"]["capture · void"] == {}
    if split == "instances":
        assert facts["measured"]["gold.001"]["volume"] == 0.25
        assert facts["measured"]["gold"] == {}, "what is left beside the instances was not measured"
        assert facts["instances"] == {"gold": [0], "gold.001": [1], "stone": [0]}
    assert facts["revisions"] == [7]
    assert sum(facts["faces"].values()) == 128
    assert {name: set(unseen) for name, unseen in facts["unseen"].items()} == {
        name: {name == "stone"} for name in facts["names"]
    }
    assert {name: left for name, left in facts["left"].items() if left} == {"stone": facts["faces"]["stone"]}
    assert facts["again"] == ["Surface"]
    assert not {"gold", "stone"} & set(facts["after"]), "collections that nothing stands in are gone"


@pytest.mark.parametrize("names", [("points", "void"), ("volume", "gold")])
def test_classes_called_like_other_parts_have_materials_of_their_own(names, package, bpy_script):
    value = json.loads((package / "package.json").read_text())
    for entry, name in zip(value["classes"], names):
        entry["name"] = name
    (package / "package.json").write_text(json.dumps(value))
    facts = bpy_script(
        IMPORT
        + """
from fieldwork.addon.roles import Owner
from fieldwork.addon.scene.materials import label_of
from fieldwork.addon.scene.volume import volume_material
balls = next(n for n in made.points.modifiers[0].node_group.nodes if n.type == "SET_MATERIAL")
others = [balls.inputs["Material"].default_value, volume_material(Owner("capture"))]
answer([[m.name for m in (*made.mesh.data.materials, *others)], [label_of(m) for m in made.mesh.data.materials]])
""",
        package=package,
        split="none",
    )
    materials, labels = facts
    assert len(set(materials)) == 5
    assert labels == ["void", *names]


def test_materials_that_are_marked_like_parts_stay_those_of_their_classes(package, bpy_script):
    facts = bpy_script(
        IMPORT
        + """
before = sorted(m.name for m in bpy.data.materials)
for material in made.mesh.data.materials:
    material["fieldwork_role"] = material["fieldwork_role"].replace("class material:", "material:")
made = import_package(scene, read_package(package))
answer([before, sorted(m.name for m in bpy.data.materials), made.warnings,
        [m["fieldwork_role"] for m in made.mesh.data.materials]])
""",
        package=package,
        split="none",
    )
    before, after, warnings, roles = facts
    assert before == after
    assert warnings == []
    assert roles == ["material:void", "class material:stone", "class material:gold"]


def test_each_scene_of_a_project_has_its_own_slider(package, bpy_script):
    facts = bpy_script(
        IMPORT
        + """
def followed(item):
    groups = [n.node_tree for m in item.data.materials for n in m.node_tree.nodes if n.type == "GROUP"]
    groups += [m.node_group for m in item.modifiers if m.type == "NODES"]
    return sorted({d.driver.variables[0].targets[0].id.name for g in groups for d in g.animation_data.drivers})
def count():
    return [len(getattr(bpy.data, kind)) for kind in ("materials", "node_groups")]
first = [count(), followed(made.mesh)]
bpy.ops.scene.new(type="NEW")
other = import_package(bpy.context.scene, read_package(package))
second = [count(), followed(other.mesh), followed(made.mesh)]
again = [import_package(place, read_package(package)) for place in (scene, bpy.context.scene)]
third = [count(), *(followed(item.mesh) for item in again)]
roots = [made.root.name, other.root.name]
bpy.data.objects.remove(other.root)  # a new parent takes its place
last = import_package(bpy.context.scene, read_package(package))
answer({"first": first, "second": second, "third": third, "last": [count(), followed(last.mesh) == [last.root.name]],
        "roots": roots})
""",
        package=package,
        split="none",
    )
    (one, mine), (two, others, unchanged) = facts["first"], facts["second"]
    root, other = facts["roots"]
    assert mine == unchanged == [root]
    assert others == [other]
    assert two == [2 * n for n in one]
    assert facts["third"] == [two, [root], [other]], "nothing is there twice"
    assert facts["last"] == [two, True]
