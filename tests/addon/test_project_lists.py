"""The project in the lists of the panels, and what is edited there back in the project."""

from __future__ import annotations

import json

import pytest
from fieldwork.tests.addon.support import SETUP, make_project


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
        + """
from fieldwork.addon.project import snapshot as state
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
    """Undo brings back an edit of a class, in the project too, but not the lists of before a job."""
    folder = make_project(tmp_path / "capture")
    facts = bpy_script(
        SETUP
        + """
from fieldwork.addon.project import snapshot as state
settings.project = project
classes = lambda: [c["priority"] for c in json.loads((Path(project) / "project.json").read_text())["classes"]]
bpy.ops.ed.undo_push(message="project")
bpy.context.scene.fieldwork.classes[0].priority = 4.0
state.write_classes()
bpy.ops.ed.undo_push(message="priority")
edited = classes()
# A job adds a photo to the project.
path = Path(project) / "project.json"
value = json.loads(path.read_text())
value["images"].append({"name": "c", "file": "images/c.jpg"})
path.write_text(json.dumps(value))
os.utime(path, (1, 1))
state.refresh(bpy.context.scene.fieldwork)
bpy.ops.ed.undo()
now = bpy.context.scene.fieldwork
answer({"edited": edited, "undone": classes(), "shown": [c.priority for c in now.classes],
        "images": [i.name for i in now.images]})
""",
        project=folder,
    )
    assert facts["edited"] == [4.0, 2.0]
    assert facts["undone"] == facts["shown"] == [1.0, 2.0]
    assert facts["images"] == ["a", "b", "c"]
