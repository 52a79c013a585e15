"""A scene knows its project by its UUID: not by the name of the folder, and wherever the folder is."""

from __future__ import annotations

import json
import shutil

from fieldwork.tests.addon.support import ENGINE, SETUP, make_posed_project, make_project
from fieldwork.tests.addon.test_mesh_import import make_package

IMPORT = """
from fieldwork.addon.roles import Owner
from fieldwork.addon.scene.build import import_package
from fieldwork.addon.scene.package import read_package
def package_of(project):
    folder = Path(package)
    value = json.loads((folder / "package.json").read_text())
    uuid = json.loads((Path(project) / "project.json").read_text()).get("uuid", "")
    (folder / "package.json").write_text(json.dumps(value | {"name": Path(project).name, "uuid": uuid}))
    return read_package(folder)
def roles(uuid):
    return sorted(o["fieldwork_role"] for o in bpy.data.objects if o.get("fieldwork_uuid") == uuid)
"""


def uuid_of(folder):
    return json.loads((folder / "project.json").read_text())["uuid"]


def test_projects_whose_folders_have_one_name_stay_apart(bpy_script, tmp_path):
    one, two = make_posed_project(tmp_path / "a/capture"), make_posed_project(tmp_path / "b/capture")
    facts = bpy_script(
        SETUP
        + IMPORT
        + """
from fieldwork.addon.project import snapshot
from fieldwork.addon.scene.frame import root_of
first = import_package(scene, package_of(one))
second = import_package(scene, package_of(two))
again = import_package(scene, package_of(one))
materials = [[m.name for m in result.meshes[0].data.materials] for result in (again, second)]
settings.project = one
settings.classes[0].visible = False
owners = [snapshot.owner(Path(folder)) for folder in (one, two)]
answer({
    "apart": not {o.name for o in first.objects()} & {o.name for o in second.objects()},
    "same": {o.name for o in first.objects()} == {o.name for o in again.objects()},
    "roots": [root_of(scene, owner).name for owner in owners],
    "materials": materials,
    "groups": [{m.node_tree.nodes[0].node_tree.name for m in r.meshes[0].data.materials}.pop() for r in (again, second)],
    "hidden": [sum(m.name == "Fieldwork Classes" for m in result.meshes[0].modifiers) for result in (again, second)],
    "collections": sorted(c.name for c in scene.collection.children if "fieldwork_uuid" in c),
})
""",
        one=one,
        two=two,
        package=make_package(tmp_path / "package", 4, cameras=2, points=10),
    )
    assert facts["apart"]
    assert facts["same"]
    assert facts["roots"] == ["Fieldwork · capture", "Fieldwork · capture.001"]
    assert facts["collections"] == facts["roots"]
    assert not set(facts["materials"][0]) & set(facts["materials"][1])
    assert facts["groups"][0] != facts["groups"][1]
    assert facts["hidden"] == [1, 0]


def test_a_scene_of_the_first_version_is_gone_on_with(bpy_script, tmp_path):
    """It knows objects by the name of the project's folder, materials and groups by their own names."""
    project = make_posed_project(tmp_path / "capture")
    facts = bpy_script(
        SETUP
        + IMPORT
        + """
from fieldwork.addon.project import snapshot
from fieldwork.addon.scene import visibility
from fieldwork.addon.scene.frame import root_of
old = import_package(scene, package_of(project))
for group in bpy.data.node_groups:
    group.name = group.name.replace("Fieldwork Surface", "Fieldwork")  # as they were called then
for items in (bpy.data.objects, bpy.data.collections, bpy.data.materials, bpy.data.node_groups):
    for item in items:
        if "fieldwork_uuid" in item:
            del item["fieldwork_uuid"]
            if items in (bpy.data.materials, bpy.data.node_groups):
                del item["fieldwork_role"], item["fieldwork_project"]
bpy.ops.wm.save_as_mainfile(filepath=blend)
bpy.ops.wm.open_mainfile(filepath=blend)
before = {name: sorted(getattr(bpy.data, name).keys()) for name in ("objects", "collections", "materials", "node_groups")}
before["node_groups"] = sorted(n.replace("Fieldwork · ", "Fieldwork Surface · ") for n in before["node_groups"])
scene = bpy.context.scene
scene.fieldwork.project = project
owner = snapshot.owner(Path(project))
known = [root_of(scene, owner).name, len(visibility.meshes(owner))]
new = import_package(scene, package_of(project))
after = {name: sorted(getattr(bpy.data, name).keys()) for name in before}
answer({"before": before, "after": after, "known": known, "roles": roles(owner.uuid)})
""",
        project=project,
        blend=tmp_path / "old.blend",
        package=make_package(tmp_path / "package", 4, cameras=2, points=10),
    )
    assert facts["known"] == ["Fieldwork · capture", 1]
    assert facts["after"] == facts["before"], "nothing is there twice"
    assert facts["roles"] == ["camera path", "camera:view_000", "camera:view_001", "mesh", "points", "root"]


def test_a_project_of_the_first_version_is_known_by_the_uuid_it_will_have(bpy_script, tmp_path):
    from fieldwork.nerfcore.project.store import edit_project

    folder = make_project(tmp_path / "capture")
    value = json.loads((folder / "project.json").read_text())
    del value["uuid"]
    (folder / "project.json").write_text(json.dumps({**value, "version": 1, "created": "2026-11-01T10:00:00"}))
    code = SETUP + "settings.project = project\nanswer(settings.project_uuid)"
    seen = bpy_script(code, project=folder)
    with edit_project(folder) as project:
        project.ignore_id = 0
    assert seen == uuid_of(folder) == bpy_script(code, project=folder)


def test_a_project_that_is_away_is_told_and_found_again(bpy_script, tmp_path):
    project, other = make_posed_project(tmp_path / "capture"), make_project(tmp_path / "other")
    facts = bpy_script(
        SETUP
        + ENGINE
        + IMPORT
        + """
import shutil
from fieldwork.addon.jobs.timer import _file_loaded
from fieldwork.addon.project import snapshot
from fieldwork.addon.scene.frame import root_of
from fieldwork.panels.main import next_step
settings.project = project
seen = {"there": snapshot.absence(settings)}
import_package(scene, package_of(project))
for item in bpy.data.objects:
    if item.get("fieldwork_role") == "points":
        del item["fieldwork_uuid"]  # of before projects had one
settings.classes[0].name = "marble"
images = [bpy.data.images.new(name, 4, 4) for name in ("photo", "own")]
for image, folder in zip(images, (project, str(Path(project).parent))):
    image.filepath_raw, image.file_format = f"{folder}/{image.name}.png", "PNG"
    image.save()
shutil.move(project, moved)
_file_loaded()
seen["gone"] = snapshot.absence(settings)
seen["lists"] = [len(settings.images), len(settings.classes)]
seen["reasons"] = [getattr(bpy.types, f"FIELDWORK_OT_{name}").reason(bpy.context) for name in ("poses", "train")]
seen["step"] = next_step(bpy.context).operator
seen["none"] = attempt(lambda: bpy.ops.fieldwork.locate_project(directory=str(Path(moved).parent)))
seen["other"] = attempt(lambda: bpy.ops.fieldwork.locate_project(directory=other))
shutil.copytree(other, project)
seen["replaced"] = snapshot.absence(settings)
seen["found"] = attempt(lambda: bpy.ops.fieldwork.locate_project(directory=moved))
seen["after"] = [settings.project, snapshot.absence(settings), [c.name for c in settings.classes]]
bpy.ops.fieldwork.save_edits()
seen["saved"] = stored(moved)["classes"][0]["name"]
owner = snapshot.owner(Path(moved))
seen["images"] = [image.filepath for image in images]
seen["root"] = root_of(scene, owner).name
seen["points"] = [owner.owns(o) for o in bpy.data.objects if o.get("fieldwork_role") == "points"]
settings.project = other
seen["chosen"] = snapshot.absence(settings)
answer(seen)
""",
        project=project,
        moved=tmp_path / "elsewhere" / "vase",
        other=other,
        package=make_package(tmp_path / "package", 4, cameras=2, points=10),
    )
    assert facts["there"] is None
    assert str(project) in facts["gone"]
    assert "moved" in facts["gone"]
    assert facts["lists"] == [2, 2], "what is known of it stays"
    assert facts["reasons"] == [facts["gone"]] * 2
    assert facts["step"] == "fieldwork.locate_project"
    assert "There is no project" in facts["none"]
    assert "holds another project" in facts["other"]
    assert "another project" in facts["replaced"]
    assert facts["found"] == ["FINISHED"]
    assert facts["after"] == [str(tmp_path / "elsewhere/vase"), None, ["marble", "gold"]]
    assert facts["saved"] == "marble"
    assert facts["images"] == [str(tmp_path / "elsewhere/vase/photo.png"), str(tmp_path / "own.png")]
    assert facts["root"] == "Fieldwork · capture"
    assert facts["points"] == [True]
    assert facts["chosen"] is None
    shutil.rmtree(tmp_path / "elsewhere")


FIELDS = """
from fieldwork.addon.live import fields
def add_field(scene, folder):
    field = bpy.data.objects.new("Field", None)
    scene.collection.objects.link(field)
    field.fieldwork.is_field, field.fieldwork.project = True, folder
    bpy.context.view_layer.objects.active = field
    return field
"""


def test_fields_and_volumes_go_where_the_project_is_found(bpy_script, tmp_path):
    project, other = make_posed_project(tmp_path / "capture"), make_project(tmp_path / "other")
    facts = bpy_script(
        SETUP
        + FIELDS
        + """
import shutil
settings.project = project
field, others = add_field(scene, project), add_field(scene, other)
bpy.context.view_layer.objects.active = field
bpy.ops.fieldwork.refresh_field_classes()
field.fieldwork.classes[0].visible = False
volume = bpy.data.volumes.new("volume")
volume.filepath = f"{project}/exports/main/field.vdb"
shutil.move(project, moved)
seen = {"away": attempt(bpy.ops.fieldwork.refresh_field_classes)}
seen["kept"] = [entry.visible for entry in field.fieldwork.classes]
seen["found"] = attempt(lambda: bpy.ops.fieldwork.locate_project(directory=moved))
seen["read"] = attempt(bpy.ops.fieldwork.refresh_field_classes)
answer({**seen, "fields": [field.fieldwork.project, others.fieldwork.project], "volume": volume.filepath})
""",
        project=project,
        moved=tmp_path / "elsewhere",
        other=other,
    )
    assert "cannot be read" in facts["away"]
    assert str(project) in facts["away"]
    assert facts["kept"] == [False, True]
    assert facts["found"] == facts["read"] == ["FINISHED"]
    assert facts["fields"] == [str(tmp_path / "elsewhere"), str(other)]
    assert facts["volume"] == str(tmp_path / "elsewhere/exports/main/field.vdb")


def test_a_linked_field_names_a_folder_beside_its_own_file(bpy_script, tmp_path):
    project = make_project(tmp_path / "library/capture")
    (tmp_path / "work").mkdir()
    facts = bpy_script(
        SETUP
        + FIELDS
        + """
bpy.ops.wm.save_as_mainfile(filepath=f"{folder}/library/fields.blend")
add_field(bpy.context.scene, "//capture")
bpy.ops.wm.save_mainfile()
bpy.ops.wm.read_factory_settings(use_empty=True)
with bpy.data.libraries.load(f"{folder}/library/fields.blend", link=True) as (_, wanted):
    wanted.objects = ["Field"]
bpy.ops.wm.save_as_mainfile(filepath=f"{folder}/work/scene.blend")
field = bpy.data.objects["Field"]
bpy.context.scene.collection.objects.link(field)
layer = bpy.context.view_layer
layer.update()
both = (field, field.evaluated_get(layer.depsgraph))
answer([str(fields.folder_of(obj.fieldwork)) for obj in both] + [fields.item_of(field, False)["project"]])
""",
        folder=tmp_path,
    )
    assert facts == [str(project)] * 3


def test_edits_without_a_window_wait_for_the_engine(bpy_script, tmp_path):
    """The engine itself writes; what it refuses is an error and stays until it is discarded."""
    project = make_posed_project(tmp_path / "capture")
    (tmp_path / "classes.json").write_text(json.dumps({"classes": {"1": "stone", "7": "wood"}}))
    facts = bpy_script(
        SETUP
        + """
from fieldwork.addon.project import edits
from fieldwork.addon.jobs.queue import queue
stored = lambda: json.loads((Path(project) / "project.json").read_text())
settings.project = project
settings.classes[0].name, settings.classes[0].priority = "marble", 3.0
bpy.ops.fieldwork.save_edits()
seen = {"saved": [[c["name"], c["priority"]] for c in stored()["classes"]], "waiting": edits.waiting()}
settings.classes[0].name = "gold"
seen["refused"] = attempt(lambda: bpy.ops.fieldwork.save_edits())
seen["verb"] = attempt(lambda: bpy.ops.fieldwork.train())
seen["shown"] = [c.name for c in settings.classes]
bpy.ops.fieldwork.discard_edits()
seen["discarded"] = [c.name for c in settings.classes]
bpy.ops.fieldwork.crop_add()
settings.region_box.location, settings.region_box.scale = (1, 2, 3), (1, 1, 1)
bpy.ops.fieldwork.crop_apply()
seen["region"] = stored()["frame"]["bounds"]
bpy.ops.fieldwork.crop_remove()
seen["cleared"] = stored()["frame"]["bounds"]
bpy.ops.fieldwork.classes_apply(file=classes)
seen["from file"] = [[c.id, c.name] for c in settings.classes]
seen["no file"] = attempt(lambda: bpy.ops.fieldwork.classes_apply(file=classes + "x"))
queue.stop_engine(timeout=5.0)
answer(seen)
""",
        project=project,
        classes=tmp_path / "classes.json",
    )
    assert facts["saved"] == [["marble", 3.0], ["gold", 2.0]]
    assert not facts["waiting"]
    assert "gold" in facts["refused"]
    assert "not saved" in facts["verb"]
    assert facts["shown"] == ["gold", "gold"]
    assert facts["discarded"] == ["marble", "gold"]
    assert facts["region"] == [[0, 1, 2], [2, 3, 4]]
    assert facts["cleared"] is None
    assert facts["from file"] == [[1, "stone"], [7, "wood"]]
    assert "classes.jsonx" in facts["no file"]


def test_a_project_above_the_open_file_is_known_by_its_own_name(bpy_script, tmp_path):
    project = make_posed_project(tmp_path / "capture")
    facts = bpy_script(
        SETUP
        + """
from fieldwork.addon.project import snapshot
from fieldwork.addon.render.slot import is_of
picture = Path(project, "exports/main/a.png")
picture.parent.mkdir(parents=True)
made = bpy.data.images.new("a", 4, 4)
made.filepath_raw, made.file_format = str(picture), "PNG"
made.save()
bpy.ops.wm.save_as_mainfile(filepath=str(picture.with_name("a.blend")))
settings.project, made.filepath = "//../..", "//../main/a.png"
answer([str(snapshot.folder_of(settings)), is_of(made, picture), len(settings.images)])
""",
        project=project,
    )
    assert facts[:2] == [str(project), True]
    assert facts[2] > 0


def test_paths_beside_the_file_lead_where_they_led_when_it_is_saved_elsewhere(bpy_script, tmp_path):
    project = make_project(tmp_path / "one/capture")
    (tmp_path / "two/deep").mkdir(parents=True)
    facts = bpy_script(
        SETUP
        + FIELDS
        + """
from fieldwork.addon.project import snapshot
from fieldwork.addon.roles import FOLDER
bpy.ops.wm.save_as_mainfile(filepath=f"{folder}/one/first.blend")
settings.project, settings.photos, settings.export_path = "//capture", "//photos", f"{folder}/absolute.glb"
add_field(scene, "//capture")
root = bpy.data.objects.new("root", None)
root[FOLDER] = "//capture"
scene.collection.objects.link(root)
uuid = settings.project_uuid
def seen():
    own, field = bpy.context.scene.fieldwork, bpy.data.objects["Field"]
    return [own.project, own.photos, own.export_path, field.fieldwork.project, bpy.data.objects["root"][FOLDER],
            str(snapshot.folder_of(own)), str(fields.folder_of(field.fieldwork)), own.project_uuid == uuid, len(own.images)]
def save(name, **more):
    bpy.ops.wm.save_as_mainfile(filepath=f"{folder}/{name}", **more)
    return seen()
facts = {"beside": save("one/second.blend"), "copy": save("two/copy.blend", copy=True), "deep": save("two/deep/third.blend")}
try:
    save("nowhere/fourth.blend")
except RuntimeError:
    facts["not saved"] = seen()
for name in ("two/copy.blend", "two/deep/third.blend"):
    bpy.ops.wm.open_mainfile(filepath=f"{folder}/{name}")
    facts[f"opened {name}"] = seen()
answer(facts)
""",
        folder=tmp_path,
    )
    there = [str(project), str(project), True, 2]
    absolute = str(tmp_path / "absolute.glb")

    def stored(way):
        return [f"{way}/capture", f"{way}/photos", absolute, f"{way}/capture", f"{way}/capture", *there]

    assert facts["beside"] == facts["copy"] == stored("/")
    assert facts["deep"] == facts["not saved"] == facts["opened two/deep/third.blend"] == stored("//../../one")
    assert facts["opened two/copy.blend"] == stored("//../one")


def test_paths_of_what_is_appended_or_overridden_lead_where_they_led(bpy_script, tmp_path):
    project = make_project(tmp_path / "library/capture")
    (tmp_path / "work").mkdir()
    facts = bpy_script(
        SETUP
        + FIELDS
        + """
bpy.ops.wm.save_as_mainfile(filepath=f"{folder}/library/fields.blend")
settings.project = "//capture"
add_field(scene, "//capture")
scene.name = "Library"
bpy.ops.wm.save_mainfile()
bpy.ops.wm.read_homefile()
bpy.ops.wm.save_as_mainfile(filepath=f"{folder}/work/scene.blend")
def append(kind, name):
    bpy.ops.wm.append(directory=f"{folder}/library/fields.blend/{kind}/", filename=name)
append("Object", "Field")
places = {"appended": str(fields.folder_of(bpy.data.objects["Field"].fieldwork))}
bpy.data.objects.remove(bpy.data.objects["Field"])
append("Scene", "Library")
places["scene"] = bpy.data.scenes["Library"].fieldwork.project
places["of the scene"] = bpy.data.objects["Field"].fieldwork.project
bpy.data.objects.remove(bpy.data.objects["Field"])
with bpy.data.libraries.load(f"{folder}/library/fields.blend", link=True) as (_, wanted):
    wanted.objects = ["Field"]
linked = wanted.objects[0]
bpy.context.scene.collection.objects.link(linked)
made = linked.override_create(remap_local_usages=True)
places["overridden"] = [made.library is None, str(fields.folder_of(made.fieldwork)), made.fieldwork.project]
answer([places, bpy.app.version >= (4, 3, 0)])
""",
        folder=tmp_path,
    )
    places, told = facts
    assert places["overridden"] == [True, str(project), "//capture"]
    if told:  # Blender 4.2 does not say what was appended
        assert places["appended"] == str(project)
        assert places["scene"] == places["of the scene"] == "//../library/capture"


def test_a_field_that_is_pasted_leads_where_it_led(bpy_script, tmp_path):
    project, other = make_project(tmp_path / "one/capture"), make_project(tmp_path / "two/capture")
    make_project(tmp_path / "moved/capture")
    facts = bpy_script(
        SETUP
        + FIELDS
        + """
def copy():
    bpy.ops.object.select_all(action="DESELECT")
    bpy.data.objects["Field"].select_set(True)
    bpy.ops.view3d.copybuffer()
def paste(name):
    bpy.ops.wm.read_homefile()
    if name:
        bpy.ops.wm.save_as_mainfile(filepath=f"{folder}/{name}")
    bpy.ops.view3d.pastebuffer()
    own = bpy.data.objects["Field"].fieldwork
    return [str(fields.folder_of(own)), own.project]
bpy.ops.wm.save_as_mainfile(filepath=f"{folder}/one/first.blend")
own = add_field(scene, "//capture").fieldwork
copy()
bpy.ops.wm.save_as_mainfile(filepath=f"{folder}/one/plain.blend", compress=False, copy=True)
facts = {"kept": own.folder, "saved": paste("two/second.blend"), "unsaved": paste("")}
bpy.ops.wm.open_mainfile(filepath=f"{folder}/one/first.blend")
add_field(bpy.context.scene, "//capture")
bpy.ops.wm.save_mainfile()
os.replace(f"{folder}/one/first.blend", f"{folder}/moved/first.blend")  # with its project
bpy.ops.wm.open_mainfile(filepath=f"{folder}/moved/first.blend")
copy()
facts["moved"] = paste("two/third.blend")
answer([facts, bpy.app.version >= (4, 3, 0)])
""",
        folder=tmp_path,
    )
    places, told = facts
    assert places["kept"] == str(project)
    assert str(project).encode() not in (tmp_path / "one/plain.blend").read_bytes(), "files do not tell where they lay"
    if told:  # Blender 4.2 does not say what was pasted
        assert places["saved"] == [str(project), "//../one/capture"], f"not {other}"
        assert places["unsaved"] == [str(project), str(project)]
        assert places["moved"] == [str(tmp_path / "moved/capture"), "//../moved/capture"]


def test_an_overridden_field_keeps_how_it_is_shown(bpy_script, tmp_path):
    facts = bpy_script(
        SETUP
        + FIELDS
        + """
bpy.ops.wm.save_as_mainfile(filepath=f"{folder}/library.blend")
own = add_field(scene, project).fieldwork
for name in ("stone", "gold"):
    own.classes.add().name = name
own.things.add().name = "cup"
bpy.ops.wm.save_mainfile()
bpy.ops.wm.read_homefile()
with bpy.data.libraries.load(f"{folder}/library.blend", link=True) as (_, wanted):
    wanted.objects = ["Field"]
linked = wanted.objects[0]
collection = bpy.context.scene.collection
collection.objects.link(linked)
bpy.context.view_layer.objects.active = linked
told = attempt(lambda: bpy.ops.fieldwork.isolate_class(index=1))
made = linked.override_create(remap_local_usages=True)
box = bpy.data.objects.new("Box", None)
collection.objects.link(box)
own = made.fieldwork
own.look, own.crop, own.classes[0].opacity, own.things[0].tint = 1.5, box, 0.25, 0.5
bpy.context.view_layer.objects.active = made
bpy.ops.fieldwork.isolate_class(index=1)
bpy.ops.wm.save_as_mainfile(filepath=f"{folder}/user.blend")
bpy.ops.wm.open_mainfile(filepath=f"{folder}/user.blend")
own = next(obj for obj in bpy.data.objects if obj.override_library).fieldwork
answer([told, own.look, own.crop.name, [[c.visible, c.opacity] for c in own.classes], own.things[0].tint])
""",
        folder=tmp_path,
        project=make_project(tmp_path / "capture"),
    )
    assert "linked from another file" in facts[0]
    assert facts[1:] == [1.5, "Box", [[False, 0.25], [True, 1.0]], 0.5]


def test_fields_crop_boxes_and_copies_come_into_the_scene_where_the_collection_is_linked(bpy_script, tmp_path):
    project = make_posed_project(tmp_path / "capture")
    (project / "runs/main").mkdir(parents=True)
    (project / "runs/main/field.safetensors").touch()
    facts = bpy_script(
        SETUP
        + FIELDS
        + """
bpy.ops.wm.save_as_mainfile(filepath=f"{folder}/library.blend")
held = bpy.data.collections.new("Held")
scene.collection.children.link(held)
field = add_field(scene, project)
held.objects.link(field)
scene.collection.objects.unlink(field)
field.fieldwork.things.add().name = "cup"
bpy.ops.wm.save_mainfile()
bpy.ops.wm.read_homefile()
with bpy.data.libraries.load(f"{folder}/library.blend", link=True) as (_, wanted):
    wanted.collections = ["Held"]
scene, layer = bpy.context.scene, bpy.context.view_layer
linked = wanted.collections[0]
scene.collection.children.link(linked)
layer.active_layer_collection = layer.layer_collection.children["Held"]
scene.fieldwork.project = project
added = bpy.ops.fieldwork.add_field()
names = [obj.name for obj in scene.collection.objects if obj.fieldwork.is_field]
for name in names:
    bpy.data.objects.remove(bpy.data.objects[name])
linked.override_hierarchy_create(scene, layer)
made = next(obj for obj in scene.objects if obj.override_library and obj.fieldwork.is_field)
layer.objects.active = made
box, copy = bpy.ops.fieldwork.add_crop_box(), bpy.ops.fieldwork.place_thing(thing="cup")
answer([sorted(added), len(names), made.fieldwork.crop.name in scene.collection.objects,
        [obj.fieldwork_copy.thing for obj in scene.collection.objects if obj.fieldwork_copy.thing]])
""",
        folder=tmp_path,
        project=project,
    )
    assert facts == [["FINISHED"], 1, True, ["cup"]]
