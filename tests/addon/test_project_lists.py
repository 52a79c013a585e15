"""The project in the lists of the panels, and what is edited there back in the project."""

from __future__ import annotations

import json

import pytest
from fieldwork.nerfcore.images.suffixes import PHOTO_SUFFIXES, VIDEO_SUFFIXES
from fieldwork.tests.addon.support import ENGINE, SETUP, make_project


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


def test_lists_follow_the_project_and_class_edits_go_back(bpy_script, tmp_path):
    folder = make_project(tmp_path / "capture")
    facts = bpy_script(
        SETUP
        + ENGINE
        + """
settings.project = project
rows = [[i.name, i.status, i.reason, i.labelled] for i in settings.images]
classes = [[c.id, c.name, round(c.priority, 3), round(c.area, 3)] for c in settings.classes]
settings.run = "second"
areas = [c.area for c in settings.classes]
settings.run = "main"
settings.classes[0].priority = 4.0
settings.classes[1].name = "gilding"
before = stored(project)["classes"]
bpy.ops.fieldwork.save_edits()
settings.project = ""
answer({"rows": rows, "classes": classes, "left": len(settings.images), "asked": asked, "areas": areas, "before": before[0]["priority"]})
""",
        project=folder,
    )
    assert facts["rows"] == [["a", "ok", "", True], ["b", "rejected", "It is blurred.", False]]
    assert facts["classes"] == [[1, "stone", 1.0, 0.0], [2, "gold", 2.0, 0.25]]
    assert facts["left"] == 0
    assert facts["areas"] == [0.0, 0.0], "another run has a mesh of its own"
    assert facts["before"] == 1.0, "Blender itself writes nothing"
    assert facts["asked"] == ["classes"], "one edit for both"
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


def test_whatever_the_engine_reads_is_shown_dropped_and_opened(bpy_script, tmp_path):
    read = sorted(PHOTO_SUFFIXES | VIDEO_SUFFIXES)
    for suffix in read:
        (tmp_path / suffix[1:]).mkdir()
        (tmp_path / suffix[1:] / f"a{suffix.upper()}").touch()
        (tmp_path / suffix[1:] / "images").mkdir()  # not meant where there are photos beside it
    facts = bpy_script(
        SETUP
        + """
import fnmatch
opened = []
for suffix in read:
    bpy.ops.fieldwork.open(directory=f"{folder}/{suffix[1:]}", files=[{"name": f"a{suffix.upper()}"}])
    opened.append(settings.photos)
dropped = bpy.types.FIELDWORK_FH_capture.bl_file_extensions.split(";")
glob = bpy.ops.fieldwork.open.get_rna_type().properties["filter_glob"].default
known = bpy.path.extensions_image | bpy.path.extensions_movie
shown = [s for s in read if s in known or any(fnmatch.fnmatch(f"a{s}", one) for one in glob.split(";"))]
answer({"opened": opened, "dropped": dropped, "shown": shown, "glob": len(glob)})
""",
        read=read,
        folder=tmp_path,
    )
    folders = [tmp_path / suffix[1:] for suffix in read]
    meant = [f if s in PHOTO_SUFFIXES else f / f"a{s.upper()}" for f, s in zip(folders, read)]
    assert facts["opened"] == [str(path) for path in meant]
    assert facts["dropped"] == facts["shown"] == read
    assert facts["glob"] < 256  # Blender cuts what is longer


def test_open_refuses_json_that_is_no_project(bpy_script, tmp_path):
    project = make_project(tmp_path / "old")
    for name in ("old/instances.json", "set/transforms.json", "set/project.json"):
        (tmp_path / name).parent.mkdir(exist_ok=True)
        (tmp_path / name).write_text("[]")
    facts = bpy_script(
        SETUP
        + """
settings.project = project
files = ("old/instances.json", "set/transforms.json", "set/project.json", "nowhere/a.jpg")
said = [attempt(lambda: bpy.ops.fieldwork.open(filepath=f"{folder}/{file}")) for file in files]
said.append(attempt(bpy.ops.fieldwork.open))
answer({"said": said, "project": settings.project, "photos": settings.photos})
""",
        folder=tmp_path,
        project=project,
    )
    *json_files, missing, nothing = facts["said"]
    for name, said in zip(("instances.json", "transforms.json", "project.json"), json_files):
        assert f"{name} is no project of Fieldwork" in said
        assert "Import Posed Data Set" in said
    assert f"nothing at {tmp_path / 'nowhere'}" in missing
    assert "Choose a folder of photos" in nothing
    assert (facts["project"], facts["photos"]) == (str(project), "")


def test_hidden_classes_vanish_from_the_mesh(bpy_script, tmp_path):
    facts = bpy_script(
        SETUP
        + """
from fieldwork.addon.scene import visibility
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


def test_undo_leaves_the_lists_as_the_project_says(bpy_script, tmp_path):
    """Undo makes a new edit of the user's edits, and brings back neither the lists of before a job nor what others
    have changed since."""
    folder = make_project(tmp_path / "capture")
    facts = bpy_script(
        SETUP
        + ENGINE
        + """
from fieldwork.addon.project import lists
settings.project = project
fieldwork_of = lambda: bpy.context.scene.fieldwork
shown = lambda: [[c.name, round(c.priority, 3)] for c in fieldwork_of().classes]
def saved():
    return [[c["name"], c["priority"]] for c in stored(project)["classes"]]
seen = {}
def look(name):
    seen[name] = [shown(), saved(), list(asked)]
    asked.clear()
bpy.ops.ed.undo_push(message="project")
fieldwork_of().classes[0].priority = 4.0
settle()
bpy.ops.ed.undo_push(message="priority")
look("edited")
# A job adds a photo; another program gives the other class another priority.
value = stored(project)
value["classes"][1]["priority"] = 7.0
write(project, images=[*value["images"], {"name": "c", "file": "images/c.jpg"}], classes=value["classes"])
lists.refresh(fieldwork_of())
look("changed elsewhere")
bpy.ops.ed.undo()
look("undone, not sent")
images = [i.name for i in fieldwork_of().images]
settle()
look("undone")
bpy.ops.ed.redo()
settle()
look("redone")
# What is edited again elsewhere is not overwritten by an undo of something else.
value = stored(project)
value["classes"][0]["priority"] = 9.0
write(project, classes=value["classes"])
lists.refresh(fieldwork_of())
bpy.ops.ed.undo()
settle()
look("undone over another's edit")
answer({"seen": seen, "images": images})
""",
        project=folder,
    )
    seen = facts["seen"]
    start, theirs = ["stone", 1.0], ["gold", 7.0]
    edited = ["stone", 4.0]
    assert seen["edited"] == [[edited, ["gold", 2.0]], [edited, ["gold", 2.0]], ["classes"]]
    assert seen["changed elsewhere"] == [[edited, theirs], [edited, theirs], []]
    assert seen["undone, not sent"] == [[start, theirs], [edited, theirs], []]
    assert seen["undone"] == [[start, theirs], [start, theirs], ["classes"]]
    assert seen["redone"] == [[edited, theirs], [edited, theirs], ["classes"]]
    other = ["stone", 9.0]
    assert seen["undone over another's edit"] == [[other, theirs], [other, theirs], []]
    assert facts["images"] == ["a", "b", "c"]


def test_undo_goes_back_along_the_users_own_edits_only(bpy_script, tmp_path):
    """A name that a job gave between two edits of the user is newer than what he had before it."""
    folder = make_project(tmp_path / "capture")
    facts = bpy_script(
        SETUP
        + ENGINE
        + """
from fieldwork.addon.project import lists
settings.project = project
name = lambda: bpy.context.scene.fieldwork.classes[0].name
saved = lambda: stored(project)["classes"][0]["name"]
def give(value):
    bpy.context.scene.fieldwork.classes[0].name = value
    settle()
    bpy.ops.ed.undo_push(message=value)
def undo():
    bpy.ops.ed.undo()
    settle()
    return [name(), saved()]
bpy.ops.ed.undo_push(message="project")
give("marble")
value = stored(project)
value["classes"][0]["name"] = "granite"  # by a job, from a file of classes
write(project, classes=value["classes"])
lists.refresh(bpy.context.scene.fieldwork)
bpy.ops.ed.undo_push(message="cube")
give("basalt")
give("slate")
seen = [undo(), undo(), undo(), undo()]
bpy.ops.ed.redo()
settle()
answer([*seen, [name(), saved()]])
""",
        project=folder,
    )
    assert facts[:2] == [["basalt", "basalt"], ["granite", "granite"]]
    assert facts[2:4] == [["granite", "granite"]] * 2, "neither marble nor stone comes back over what the job gave"
    assert facts[4] == ["granite", "granite"]
