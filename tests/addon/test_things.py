"""Things in the scene: relations as custom properties, the list of the panel, questions that select objects."""

from __future__ import annotations

import json

import pytest
from fieldwork.tests.addon.support import SETUP, make_posed_project
from fieldwork.tests.addon.test_surface_look import package  # noqa: F401

pytest.importorskip("bpy")

from fieldwork.addon.project.things import graph, held, outline

NAMES = {1: "floor.001", 2: "table.001", 3: "vase.001", 4: "lamp.001"}
GRAPH = {
    "made": "",
    "things": [{"id": number, "name": name, "class": name[:-4]} for number, name in NAMES.items()],
    "relations": [
        {"subject": 2, "relation": "on", "object": 1, "gap": 0.0},
        {"subject": 3, "relation": "on", "object": 2, "gap": 0.0},
        {"subject": 3, "relation": "next to", "object": 4, "gap": 0.1},
        {"subject": 4, "relation": "on", "object": 2, "gap": 0.0},
    ],
}


def with_graph(folder, value=GRAPH, names=NAMES):
    exports = folder / "exports/main"
    exports.mkdir(parents=True, exist_ok=True)
    (exports / "scene_graph.json").write_text(json.dumps(value))
    (exports / "instances.json").write_text(json.dumps([{"id": i, "name": n, "class_id": 1} for i, n in names.items()]))
    return folder


def test_the_list_stands_each_thing_below_what_holds_it():
    lines = outline(GRAPH)
    assert [(line.depth, line.name, line.relation) for line in lines] == [
        (0, "floor.001", ""),
        (1, "table.001", "on"),
        (2, "vase.001", "on"),
        (2, "lamp.001", "on"),
    ]
    assert [line.beside for line in lines] == [(), (), ("lamp.001",), ("vase.001",)]
    assert held(lines, 2) == [3, 4]
    assert held(lines, 4) == []
    # What holds itself over others is still listed, once.
    circle = [{"subject": a, "relation": "on", "object": b, "gap": 0} for a, b in ((1, 2), (2, 3), (3, 1))]
    assert sorted(line.id for line in outline({**GRAPH, "relations": circle})) == [1, 2, 3, 4]


def test_a_graph_of_other_instances_is_none(tmp_path):
    folder = with_graph(tmp_path)
    assert graph(folder, "main") == GRAPH
    with_graph(folder, names={**NAMES, 3: "Ming vase"})
    assert graph(folder, "main") is None
    (folder / "exports/main/scene_graph.json").write_text("[1]")
    assert graph(folder, "main") is None
    assert graph(None, "main") is None


def test_the_panel_asks_for_a_mesh_only_where_there_is_none(bpy_script, tmp_path):
    """Also after an extraction that made the relations found before those of another mesh."""
    project = with_graph(
        make_posed_project(tmp_path / "capture"), value={**GRAPH, "made": "before"}, names={1: "wall.001"}
    )
    said = bpy_script(
        SETUP
        + """
from fieldwork.panels import things
labels = []
class Layout:
    def __getattr__(self, name):
        return lambda *args, **values: (labels.append(values["text"]) if name == "label" else None) or self
def look():
    labels.clear()
    things.FIELDWORK_PT_things.draw(type("Panel", (), {"layout": Layout()})(), bpy.context)
    return list(labels)
settings.project = folder
before = look()
(Path(folder) / "exports/main/mesh.npz").touch()
answer([before, look()])
""",
        folder=project,
    )
    assert [len(texts) for texts in said] == [1, 1]
    assert "Extract the mesh" in said[0][0]
    assert "Extract" not in said[1][0]
    assert "relations" in said[1][0]


def test_questions_select_objects_and_relations_are_properties(bpy_script, tmp_path, package):  # noqa: F811
    project = with_graph(make_posed_project(tmp_path / "capture"))
    value = json.loads((package / "package.json").read_text())
    facts = bpy_script(
        SETUP
        + """
import numpy as np
from fieldwork.addon.project import snapshot
from fieldwork.addon.scene import things
from fieldwork.addon.roles import ROLE
settings.project = folder
owner = snapshot.owner(Path(folder))
for number, name in names.items():
    item = bpy.data.objects.new(name, bpy.data.meshes.new(name))
    owner.mark(item, f"instance:{number}")
    scene.collection.objects.link(item)
value = json.loads((Path(folder) / "exports/main/scene_graph.json").read_text())
things.describe(owner, value)
seen = {item.name: dict(item["relations"]) for item in scene.objects if "relations" in item}
things.describe(owner, {**value, "relations": []})
gone = any("relations" in item for item in scene.objects)
chosen = lambda: sorted(item.name for item in scene.objects if item.select_get())
bpy.ops.fieldwork.select_thing(number=3)
picked = [chosen()]
bpy.ops.fieldwork.select_thing(number=2, below=True)
picked.append(chosen())
from fieldwork.addon.jobs.queue import queue
from fieldwork.operators import things as operators
asked = []
def run(job):
    asked.append(job.params)
    job.state, job.project, job.result = "done", Path(folder), {"found": ["lamp.001", "vase.001"]}
    operators.show_relations(job)
queue.run = run
(Path(folder) / "exports/main/mesh.npz").touch()
settings.thing_query = "everything on the table"
bpy.ops.fieldwork.relations()
picked.append(chosen())
def changed(job):
    asked.append(job.params)
    instances = [{"id": 3, "name": "Ming", "class_id": 1, "class": "", "area": 1.0}]
    job.state, job.project, job.result = "done", Path(folder), {"instances": instances, "changed": ["Ming"]}
    operators.show_instances(job)
queue.run = changed
bpy.ops.fieldwork.select_thing(number=3)
bpy.ops.fieldwork.instances(rename="Ming")
things.select(owner, [3, 4])
bpy.context.view_layer.objects.active = bpy.data.objects["Ming"]
bpy.ops.fieldwork.instances(merge=True)
one = attempt(lambda: (things.select(owner, [3]), bpy.ops.fieldwork.instances(merge=True))[1])
bpy.ops.fieldwork.select_thing(number=4, extend=True)
extended = chosen()
nothing = attempt(lambda: (things.select(owner, []), bpy.ops.fieldwork.instances(split=True))[1])
answer({"seen": seen, "gone": gone, "picked": picked, "asked": asked, "named": sorted(i.name for i in scene.objects), "nothing": nothing, "one": one, "extended": extended})
""",
        folder=project,
        names={str(number): name for number, name in NAMES.items()},
    )
    assert facts["seen"]["vase.001"] == {"on": "table.001", "next to": "lamp.001"}
    assert facts["seen"]["table.001"] == {"on": "floor.001"}
    assert "floor.001" not in facts["seen"]
    assert not facts["gone"]
    everything = ["lamp.001", "table.001", "vase.001"]
    assert facts["picked"] == [["vase.001"], everything, ["lamp.001", "vase.001"]]
    assert facts["asked"][0]["query"] == "everything on the table"
    assert facts["asked"][1]["rename"] == ["vase.001", "Ming"]
    assert facts["asked"][2]["merge"] == ["vase.001", "lamp.001"]
    assert "Ming" in facts["named"]
    assert "vase.001" not in facts["named"]
    assert "Select a thing" in facts["nothing"]
    assert "two things" in facts["one"]
    assert facts["extended"] == ["Ming", "lamp.001"]
    # As the package brings them into the scene.
    value["instances"] = [{"id": 1, "name": "gold.001", "class_id": 2}, {"id": 2, "name": "base", "class_id": 1}]
    value["relations"] = [{"subject": 1, "relation": "on", "object": 2, "gap": 0.0}]
    (package / "package.json").write_text(json.dumps(value))
    facts = bpy_script(
        """
from fieldwork.addon.scene.package import read_package
from fieldwork.addon.scene.build import import_package
from fieldwork.addon.scene import things
from fieldwork.addon.roles import Owner, ROLE
import numpy as np
bpy.ops.wm.read_factory_settings(use_empty=True)
loaded = read_package(package)
import_package(bpy.context.scene, loaded, split="instances")
told = {item[ROLE]: dict(item["relations"]) for item in bpy.data.objects if "relations" in item}
bpy.ops.wm.read_factory_settings(use_empty=True)
import_package(bpy.context.scene, loaded, split="none")
owner = Owner(loaded.name, loaded.uuid)
count = things.select(owner, [1])
mesh = next(item for item in bpy.data.objects if item.get(ROLE) == "mesh").data
chosen = np.empty(len(mesh.polygons), bool)
mesh.polygons.foreach_get("select", chosen)
own = np.empty(len(mesh.polygons), np.int32)
mesh.attributes["instance_id"].data.foreach_get("value", own)
selected = [things.selected(owner)]
other = int(own[own != 1][0])
things.select(owner, [other], extend=True)
selected.append(sorted(things.selected(owner)) == sorted([1, other]))
things.select(owner, [other])
selected.append(things.selected(owner) == [other])
same, some = bool(((own == 1) == chosen).all()), int(chosen.sum())
answer({"told": told, "count": count, "same": same, "some": some, "selected": selected})
""",
        package=package,
    )
    assert facts["told"] == {"instance:1": {"on": "base"}}
    assert facts["count"] == 1
    assert facts["same"]
    assert facts["some"] > 0
    assert facts["selected"] == [[1], True, True], "things of a surface in one piece can be renamed and joined, too"


def test_things_that_were_changed_in_a_window_are_listed_again(bpy_script, tmp_path):
    """With their relations, by whose names the list goes."""
    folder = with_graph(make_posed_project(tmp_path / "capture"))
    asked = bpy_script(
        SETUP
        + """
from types import SimpleNamespace
from fieldwork.addon.jobs.job import Job
from fieldwork.operators import things
asked = []
things.bpy = SimpleNamespace(app=SimpleNamespace(background=False), data=bpy.data)
things.queue = SimpleNamespace(make=lambda verb, params, done: [verb, params, done.__name__], follow_up=asked.append)
things.undo_step = lambda name: None
for changed in (["Ming"], []):
    result = {"instances": [{"id": 3, "name": "Ming"}], "changed": changed}
    params = {"project": folder, "run": "main"}
    things.show_instances(Job("instances", params, "x", Path(folder), state="done", result=result))
answer(asked)
""",
        folder=folder,
    )
    assert asked == [["relations", {"project": str(folder), "run": "main"}, "show_relations"]]


def test_a_renamed_thing_keeps_its_look_and_copies_in_fields(bpy_script, tmp_path):
    folder = with_graph(make_posed_project(tmp_path / "capture"))
    facts = bpy_script(
        SETUP
        + """
from fieldwork.addon.jobs.job import Job
from fieldwork.addon.live import fields
from fieldwork.addon.live import things
from fieldwork.operators.things import show_instances
def field_of(project):
    field = bpy.data.objects.new("field", None)
    scene.collection.objects.link(field)
    own = field.fieldwork
    own.is_field, own.project, own.run = True, str(project), "main"
    for name in ("table.001", "vase.001"):
        own.things.add().name = name
    own.things["vase.001"].opacity = 0.25
    return field, things.add_copy(field, own.things["vase.001"], "copy")
(field, copy), (other, apart) = field_of(folder), field_of(Path(folder) / "other")
job = Job("instances", {"project": folder, "run": "main", "rename": ["vase.001", " Ming"]}, id="x", project=Path(folder))
job.state, job.result = "done", {"instances": [{"id": 3, "name": "Ming"}], "changed": ["Ming"]}
show_instances(job)
look = lambda field, copy: [[[e.name, e.opacity] for e in field.fieldwork.things], copy.fieldwork_copy.thing]
answer([look(field, copy), look(other, apart)])
""",
        folder=folder,
    )
    assert facts[0] == [[["table.001", 1.0], ["Ming", 0.25]], "Ming"]
    assert facts[1] == [[["table.001", 1.0], ["vase.001", 0.25]], "vase.001"]


def test_things_are_selected_on_a_surface_with_quads_and_not_while_it_is_edited(bpy_script, tmp_path):
    facts = bpy_script(
        SETUP
        + """
from fieldwork.addon.project import snapshot
from fieldwork.addon.scene import things
settings.project = folder
owner = snapshot.owner(Path(folder))
mesh = bpy.data.meshes.new("Surface")
mesh.from_pydata([(0, 0, 0), (1, 0, 0), (1, 1, 0), (0, 1, 0), (2, 0, 0)], [], [(0, 1, 2, 3), (1, 4, 2)])
mesh.attributes.new("instance_id", "INT", "FACE").data.foreach_set("value", [1, 2])
item = bpy.data.objects.new("Surface", mesh)
owner.mark(item, "mesh")
scene.collection.objects.link(item)
bpy.context.view_layer.objects.active = item
for mode in ("EDIT", "OBJECT"):  # where the user makes quads
    bpy.ops.object.mode_set(mode=mode)
seen = []
for number in (1, 2):
    seen += [things.select(owner, [number]), [p.select for p in mesh.polygons], [v.select for v in mesh.vertices]]
bpy.ops.object.mode_set(mode="EDIT")
told = attempt(lambda: bpy.ops.fieldwork.select_thing(number=1))
bpy.ops.object.mode_set(mode="OBJECT")
answer([seen, told, attempt(lambda: bpy.ops.fieldwork.select_thing(number=1))])
""",
        folder=make_posed_project(tmp_path / "capture"),
    )
    quad, triangle = facts[0][:3], facts[0][3:]
    assert quad == [1, [True, False], [True, True, True, True, False]]
    assert triangle == [1, [False, True], [False, True, True, False, True]]
    assert "Object Mode" in facts[1]
    assert facts[2] == ["FINISHED"]
