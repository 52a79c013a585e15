"""Labelling in the open Blender while classes, marks and undo come from several sides."""

from __future__ import annotations

import pytest
from fieldwork.tests.addon.support import SETUP
from fieldwork.tests.addon.test_labels import project_with_labels, project_without_marks

pytest.importorskip("bpy")


def test_labels_are_propagated_again_when_a_class_of_theirs_is_removed(bpy_script, tmp_path):
    asked = bpy_script(
        SETUP
        + """
from fieldwork.addon.jobs.queue import queue
from fieldwork.addon.labels import session
asked = []
queue.submit = lambda job: asked.append([job.verb, job.params["revision"]])
settings.project = project
session.begin(settings)
def look():
    session._propagate(scene)
    return len(asked)
before = look()
path = Path(project) / "project.json"
value = json.loads(path.read_text())
value["classes"] = value["classes"][:1]
path.write_text(json.dumps(value))
answer([before, look(), look(), asked])
""",
        project=project_with_labels(tmp_path / "p"),
    )
    assert asked == [0, 1, 1, [["label propagate", 2]]]


def test_photos_are_shown_where_there_is_no_engine(bpy_script, tmp_path):
    shown = bpy_script(
        SETUP
        + """
from types import SimpleNamespace
from fieldwork.addon import machine
from fieldwork.addon.jobs.queue import queue
from fieldwork.operators import label
machine.engine_python = lambda: None
settings.project, seen = project, []
label.bpy = SimpleNamespace(app=SimpleNamespace(background=False))  # as in a window
label.editor.show = lambda folder, photo: seen.append(photo["name"])
label.show_photo(scene, Path(project), "a")
answer([seen, queue.link is None])
""",
        project=project_with_labels(tmp_path / "p"),
    )
    assert shown == [["a"], True]


def test_undo_of_something_else_hides_no_mark_that_was_made_elsewhere(bpy_script, tmp_path):
    seen = bpy_script(
        SETUP
        + """
from fieldwork.addon.jobs.queue import queue
from fieldwork.addon.labels import journal, session
from fieldwork.nerfcore.labels.journal import append_mark, show
folder, line = Path(project), {"photo": "a", "shape": "line", "points": [[1, 1]], "width": 2.0, "class_id": 1}
def engine(verb, params, on_done):
    values = {name: value for name, value in params.items() if name not in ("project", "revision")}
    revision = append_mark(folder, values).revision if verb == "label stroke" else params["revision"]
    show(folder, revision)
    on_done({"revision": revision}, None)
queue.ask_and_wait = engine
settings.project = project
session.begin(settings)
bpy.ops.ed.undo_push(message="begin")
session.mark(folder, line)
bpy.ops.ed.undo_push(message="Label")
append_mark(folder, line)
bpy.data.objects["Cube"].location.x = 3
bpy.ops.ed.undo_push(message="Move")
seen = []
for step in (bpy.ops.ed.undo, bpy.ops.ed.redo, bpy.ops.ed.undo, bpy.ops.ed.undo):
    step()
    seen.append(journal.shown(folder))
answer(seen)
""",
        project=project_without_marks(tmp_path / "p"),
    )
    assert seen == [2, 2, 2, 0]


def test_without_a_window_a_mark_is_on_disk_also_after_one_that_failed(bpy_script, tmp_path):
    seen = bpy_script(
        SETUP
        + """
from fieldwork.addon.errors import EngineError
from fieldwork.addon.jobs.queue import queue
from fieldwork.addon.labels import journal, session
from fieldwork.nerfcore.labels.journal import append_mark
folder, seen, dead = Path(project), [], [True, False, False, True]
def engine(verb, params, on_done):
    if dead.pop(0):
        raise EngineError("died", "The engine stopped unexpectedly.")
    values = {name: value for name, value in params.items() if name != "project"}
    on_done({"revision": append_mark(folder, values).revision}, None)
queue.ask_and_wait = engine
settings.project = project
for class_id in (1, 2, 1):
    try:
        session.mark(folder, {"photo": "a", "shape": "line", "points": [[1, 1]], "width": 2.0, "class_id": class_id})
        told = ""
    except EngineError as error:
        told = error.kind
    seen.append([told, [mark["class_id"] for mark in journal.marks(folder)]])
answer(seen)
""",
        project=project_without_marks(tmp_path / "p"),
    )
    assert seen == [["died", []], ["", [1, 2]], ["died", [1, 2]]]
