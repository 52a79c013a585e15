"""The Label panel: what it says, classes that are added, chosen and removed."""

from __future__ import annotations

import pytest
from fieldwork.nerfcore.labels.journal import append_mark
from fieldwork.tests.addon.support import SETUP, make_posed_project
from fieldwork.tests.addon.test_labels import project_with_labels

pytest.importorskip("bpy")

from fieldwork.panels import label_states


def test_the_panel_says_what_is_shown_and_what_contradicts(bpy_script, tmp_path):
    facts = bpy_script(
        SETUP
        + """
from fieldwork.panels import label_states as states
from fieldwork.addon.labels import pending, journal
settings.project = project
known = states.facts(bpy.context)
seen = [states.lines(known), states.class_text(known, 1), states.class_line(known, "stone", 1)]
seen.append(states.conflict_text(known.told["conflicts"][0], journal.marks(Path(project))))
seen.append([states.doubt_text(doubt, journal.marks(Path(project)), {1: "stone"}) for doubt in known.told["doubtful"]])
seen.append(list(states.label(bpy.context)))
pending.mark(Path(project), {"photo": "a", "points": [[1, 1]], "width": 2, "class_id": 1})
seen.append(states.class_text(states.facts(bpy.context), 1))
settings.run = "other"
seen.append(states.lines(states.facts(bpy.context)))
answer(seen)
""",
        project=project_with_labels(tmp_path / "p"),
    )
    lines, row, line, conflict, doubts, state, more, nothing = facts
    assert lines[0] == "Revision 2 of 2 is shown."
    assert "25% of the surface is void: nothing like it is marked." in lines
    assert "The last propagation took 1.5 s." in lines
    assert "Self-check: from the other photos 75% of the marks are guessed." in lines
    assert "1 mark does not count: there is no surface under it, or its class or photo is gone." in lines
    assert "The field has the classes of revision 1." in lines
    assert row == "1 ✎  50%"
    assert line.startswith("stone: 1 mark, 50% of the surface, 7")
    assert conflict == "Mark 2 on a contradicts mark 1 on a."
    assert doubts == ["Mark 2 on a looks like stone: is it right?", "Mark 9 on ? looks like ?: is it right?"]
    assert state == [True, "75% labeled"]
    assert more == "2 ✎  50%"
    assert nothing == ["Choose a class and draw over what belongs to it."]
    assert label_states.Facts(revision=3, computed=2).stale
    assert label_states.class_text(label_states.Facts(), 1) == "", "nothing is known of a class before labels are"


CLASSES = """
from fieldwork.addon.jobs.queue import queue
def engine(verb, params, on_done):
    path = Path(params["project"]) / "project.json"
    value = json.loads(path.read_text())
    known = {entry["id"]: entry for entry in value["classes"]}
    value["classes"] = [{"color": [0, 0, 1], "priority": 1.0, **known.get(c["id"], {}), **c} for c in params["classes"]]
    path.with_name("part").write_text(json.dumps(value))
    os.replace(path.with_name("part"), path)
    on_done({}, None)
queue.ask_and_wait = engine
settings.project = project
"""


def test_classes_are_added_chosen_and_removed(bpy_script, tmp_path):
    facts = bpy_script(
        SETUP
        + CLASSES
        + """
rows = lambda: [[entry.id, entry.name] for entry in settings.classes]
seen = [rows()]
bpy.ops.fieldwork.class_add(name="wood")
seen.append([rows(), settings.class_index])
bpy.ops.fieldwork.class_add()
bpy.ops.fieldwork.class_add(name="wood")
seen.append(rows())
settings.label_tool = "erase"
bpy.ops.fieldwork.label_class(number=2)
seen.append([settings.class_index, settings.label_tool])
bpy.ops.fieldwork.class_remove()
seen.append(rows())
seen.append(sorted(bpy.ops.fieldwork.label_class(number=9)))
answer(seen)
""",
        project=make_posed_project(tmp_path / "p"),
    )
    first, added, more, chosen, removed, beyond = facts
    assert first == [[1, "stone"], [2, "gold"]]
    assert added == [[*first, [3, "wood"]], 2], "the new class is the chosen one"
    assert more[3:] == [[4, "Class 4"], [5, "wood'"]]
    assert chosen == [1, "brush"]
    assert removed == [[1, "stone"], [3, "wood"], [4, "Class 4"], [5, "wood'"]]
    assert beyond == ["CANCELLED"]


def test_a_new_class_does_not_take_over_the_marks_of_one_that_was_removed(bpy_script, tmp_path):
    folder = make_posed_project(tmp_path / "p")
    append_mark(folder, {"photo": "a", "shape": "line", "points": [(1, 1)], "class_id": 2})
    added = bpy_script(
        SETUP
        + CLASSES
        + """
settings.class_index = 1
bpy.ops.fieldwork.class_remove()
bpy.ops.fieldwork.class_add(name="wood")
answer([[entry.id, entry.name] for entry in settings.classes])
""",
        project=folder,
    )
    assert added == [[1, "stone"], [3, "wood"]]


def test_a_new_class_does_not_take_over_what_label_maps_say_of_one_that_was_removed(bpy_script, tmp_path):
    added = bpy_script(
        SETUP
        + """
from fieldwork.addon.jobs.queue import queue
from fieldwork.nerfcore.params import ClassesParams
from fieldwork.nerfcore.progress import Reporter
from fieldwork.nerfcore.project.edit import classes
queue.ask_and_wait = lambda _, params, on_done: on_done(classes(ClassesParams(**params), Reporter()), None)
settings.project = project
settings.class_index = 1
bpy.ops.fieldwork.class_remove()
bpy.ops.fieldwork.class_add(name="wood")
answer([[entry.id, entry.name] for entry in settings.classes])
""",
        project=make_posed_project(tmp_path / "p"),
    )
    assert added == [[1, "stone"], [3, "wood"]]


def test_edits_before_the_engine_answered_keep_the_added_class(bpy_script, tmp_path):
    lists = bpy_script(
        SETUP
        + CLASSES
        + """
from fieldwork.addon.project import edits
held, seen = [], []
queue.ask_and_wait = lambda *request: held.append(request)
rows = lambda: [[entry.id, entry.name] for entry in settings.classes]
bpy.ops.fieldwork.class_add(name="wood")
bpy.ops.fieldwork.class_add()
settings.classes[0].color = (1, 0, 0)
edits.send(lambda *request: held.append(request), at_once=True)
seen = [[c["name"] for c in params["classes"]] for _, params, _ in held]
for request in held:
    engine(*request)
answer([seen, rows(), [round(c, 3) for c in settings.classes[0].color]])
""",
        project=make_posed_project(tmp_path / "p"),
    )
    assert lists == [
        [["stone", "gold", "wood"], ["stone", "gold", "wood", "Class 4"], ["stone", "gold", "wood", "Class 4"]],
        [[1, "stone"], [2, "gold"], [3, "wood"], [4, "Class 4"]],
        [1, 0, 0],
    ]


def test_a_refused_class_is_told(bpy_script, tmp_path):
    message = bpy_script(
        SETUP
        + """
from fieldwork.addon.errors import EngineError
from fieldwork.addon.jobs.queue import queue
queue.ask_and_wait = lambda verb, params, on_done: on_done(None, EngineError("setting", "300 classes are too many."))
settings.project = project
answer(attempt(lambda: bpy.ops.fieldwork.class_add()))
""",
        project=make_posed_project(tmp_path / "p"),
    )
    assert "too many" in message
