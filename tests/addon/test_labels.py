"""Labelling on Blender's side: marks on their way to the engine, undo, what panels and overlay show."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest
from fieldwork.addon.errors import EngineError
from fieldwork.nerfcore.labels.journal import append_mark, show
from fieldwork.nerfcore.labels.lookup import Labelling, read_labelling, surfel_map
from fieldwork.nerfcore.labels.revisions import path_of, save
from fieldwork.tests.addon.support import SETUP, make_posed_project

pytest.importorskip("bpy")

from fieldwork.addon.labels import draw, journal, pending, results

LINE = {"photo": "a", "shape": "line", "points": [(1.0, 2.0), (3.0, 4.0)], "width": 2.0, "class_id": 1}
DEAD = EngineError("died", "The engine stopped unexpectedly (signal 9).", "Run it again.")


@pytest.fixture(autouse=True)
def forgotten():
    pending.clear()
    yield
    pending.clear()


class Engine:
    """Takes marks as the engine does; `dies`: when it does not answer. `before`: it dies before it writes."""

    def __init__(self, project: Path) -> None:
        self.project, self.dies, self.before, self.asked = project, False, False, []

    def __call__(self, verb, params, answer):
        self.asked.append(verb)
        if self.dies and self.before:
            return answer(None, DEAD)
        if verb == "label checkout":
            show(self.project, params["revision"])
            result = {"revision": params["revision"]}
        else:
            values = {name: value for name, value in params.items() if name not in ("project", "void")}
            result = {"revision": append_mark(self.project, values).revision}
        return answer(None, DEAD) if self.dies else answer(result, None)


def project_with_labels(folder: Path) -> Path:
    """A posed project whose run was prepared, with the labels of revision 2: photo "a" shows four surfels."""
    make_posed_project(folder)
    run = folder / "runs/main"
    (run / "surfels").mkdir(parents=True)
    (run / "field.safetensors").touch()
    (run / "config.json").write_text(json.dumps({"accepted": {"revision": 1, "time": ""}}))
    photos = [{"name": "b", "width": 2, "height": 1, "first": 0}, {"name": "a", "width": 3, "height": 2, "first": 2}]
    np.save(run / "surfels/pixel_surfel.npy", np.array([0, 0, 0, 1, -1, 2, 3, 3], np.int32))
    (run / "surfels/prepared.json").write_text(json.dumps({"inputs": {}, "photos": photos}))
    for class_id in (1, 2):
        append_mark(folder, {**LINE, "class_id": class_id})
    probability = np.array([[0.9, 0.05], [0.2, 0.6], [0.1, 0.1], [0.55, 0.4]], np.float32)
    told = {"seconds": 1.5, "self_check": 0.75, "conflicts": [{"revision": 2, "other": 1, "surfels": 3}], "unused": [2]}
    told["doubtful"] = [{"revision": 2, "looks_like": 1}, {"revision": 9, "looks_like": 7}]
    save(folder, "main", Labelling(2, probability, np.array([1, 2], np.int32), "made", told))
    return folder


def test_a_mark_that_the_engine_does_not_answer_is_sent_again_and_written_once(tmp_path):
    for before in (True, False):
        project = tmp_path / str(before)
        engine = Engine(project)
        engine.dies, engine.before = True, before
        pending.mark(project, LINE)
        pending.mark(project, {**LINE, "class_id": 2})
        pending.send(engine)
        assert len(pending.marks_of(project)) == 2, "nothing is lost"
        assert "signal 9" in pending.error(project).message
        assert pending.take() == []
        pending.send(engine)
        assert len(engine.asked) == 1, "it is not asked again at once"
        engine.dies = False
        for _ in range(3):
            pending.send(engine, at_once=True)
        assert not pending.waiting(project)
        assert pending.error(project) is None
        assert [mark["class_id"] for mark in journal.marks(project)] == [1, 2], "in order, and each once"
        assert [(taken.verb, taken.revision) for taken in pending.take()] == [("label stroke", 1), ("label stroke", 2)]


def test_all_marks_that_wait_are_sent_when_blender_ends(tmp_path):
    engine, late = Engine(tmp_path), []
    for class_id in (1, 2, 3):
        pending.mark(tmp_path, {**LINE, "class_id": class_id})
    pending.send(lambda *request: late.append(request))
    pending.send_rest(lambda *request: late.append(request))
    for request in late:
        engine(*request)
    assert [mark["class_id"] for mark in journal.marks(tmp_path)] == [1, 2, 3]


def test_pieces_of_a_stroke_are_told_from_marks_of_their_own(tmp_path):
    for more in (True, True, False, False):
        pending.mark(tmp_path, LINE, more)
    for _ in range(4):
        pending.send(Engine(tmp_path), at_once=True)
    assert [(taken.revision, taken.more) for taken in pending.take()] == [(1, True), (2, True), (3, False), (4, False)]


def test_a_mark_that_is_refused_is_dropped_and_the_next_one_goes_on(tmp_path):
    refused = EngineError("input", "The mark lies outside the photo.")
    pending.mark(tmp_path, {**LINE, "photo": "nowhere"})
    pending.send(lambda verb, params, answer: answer(None, refused))
    assert pending.error(tmp_path) is refused
    assert not pending.waiting()
    pending.mark(tmp_path, LINE)
    assert pending.error(tmp_path) is None, "the message goes with the next mark"
    pending.send(Engine(tmp_path))
    assert len(journal.marks(tmp_path)) == 1


def test_a_mark_that_is_never_answered_is_sent_again(tmp_path, monkeypatch):
    """An engine that was stopped by its button answers nothing more."""
    now, engine, answers = [100.0], Engine(tmp_path), []
    monkeypatch.setattr(pending.time, "monotonic", lambda: now[0])
    pending.mark(tmp_path, LINE)
    pending.send(lambda verb, params, answer: engine(verb, params, lambda *given: answers.append((answer, given))))
    assert len(journal.marks(tmp_path)) == 1
    for seconds in (1.0, pending.LOST - 2.0):
        now[0] += seconds
        pending.send(engine, at_once=True)
    assert len(engine.asked) == 1
    now[0] += 2.0
    pending.send(engine)
    assert not pending.waiting()
    assert len(journal.marks(tmp_path)) == 1, "it is there once"
    ((answer, given),) = answers
    answer(*given)
    assert len(pending.take()) == 1, "a late answer is none"


def test_a_mark_without_an_engine_waits(tmp_path):
    def missing(verb, params, answer):
        raise EngineError("missing", "The engine is not installed.")

    pending.mark(tmp_path, LINE)
    pending.send(missing)
    assert "not installed" in pending.error(tmp_path).message
    assert pending.waiting(tmp_path)


def test_of_several_undone_steps_the_last_one_is_shown_at_once_and_after_the_marks(tmp_path):
    engine = Engine(tmp_path)
    for class_id in (1, 2, 3):
        pending.mark(tmp_path, {**LINE, "class_id": class_id})
        pending.send(engine)
    pending.check_out(tmp_path, 2)
    pending.check_out(tmp_path, 1)
    assert pending.shown(tmp_path) == 1
    assert journal.shown(tmp_path) == 3, "the engine has not been told"
    pending.send(engine)
    assert journal.shown(tmp_path) == 1
    assert engine.asked[3:] == ["label checkout"], "what lies between is not worth asking for"
    assert [mark["class_id"] for mark in journal.marks_at(tmp_path, 3)] == [1, 2, 3]
    pending.mark(tmp_path, {**LINE, "class_id": 7})
    pending.send(engine)
    assert journal.ancestry(tmp_path, 4) == [4, 1], "a mark grows from what is shown"


def test_a_mark_that_waits_grows_from_the_revision_that_it_was_drawn_on(tmp_path):
    engine = Engine(tmp_path)
    for class_id in (1, 2):
        pending.mark(tmp_path, {**LINE, "class_id": class_id})
        pending.send(engine)
    pending.check_out(tmp_path, 1)
    pending.mark(tmp_path, {**LINE, "class_id": 7})
    pending.check_out(tmp_path, 0)
    for _ in range(3):
        pending.send(engine)
    assert journal.ancestry(tmp_path, 3) == [3, 1]
    assert journal.shown(tmp_path) == 0


def test_marks_on_a_photo_are_drawn_while_one_on_the_surface_is_on_its_way(tmp_path):
    append_mark(tmp_path, LINE)
    pending.mark(tmp_path, {"shape": "line", "places": [(0, 0, 0)], "width": 1.0, "class_id": 1})
    pending.mark(tmp_path, {**LINE, "erase": True})
    pending.mark(tmp_path, {**LINE, "class_id": 2})
    assert [mark["class_id"] for mark in draw.marks_on(tmp_path, "a")] == [1, 2]
    assert draw.marks_on(tmp_path, "b") == []
    assert [mark["class_id"] for mark in draw.marks_on(tmp_path, "a", erased={1})] == [2]


def test_a_torn_or_foreign_journal_is_read_as_far_as_it_is_whole(tmp_path):
    assert journal.marks(tmp_path) == []
    append_mark(tmp_path, LINE)
    path = tmp_path / journal.JOURNAL
    whole = path.read_bytes()
    for more in (b'{"revision": 2, "par', b"no json\n", b'{"revision": 9, "parent": 0}\n'):
        path.write_bytes(whole + more)
        assert [mark["revision"] for mark in journal.marks(tmp_path)] == [1]
    (tmp_path / journal.SHOWN).write_text('{"revision": 12}')
    assert journal.shown(tmp_path) == 1


def test_what_was_propagated_is_looked_up_without_the_engine(tmp_path):
    folder = project_with_labels(tmp_path / "p")
    assert results.prepared(folder, "main")
    assert results.computed(folder, "main", 2)
    assert results.nearest_computed(folder, "main", 2) == 2
    append_mark(folder, LINE)
    assert results.nearest_computed(folder, "main", 3) == 2, "until it is propagated, the one before is shown"
    assert results.nearest_computed(folder, "main", 1) is None
    found = results.labelling(folder, "main", 2)
    assert found is not None
    shares, void = results.shares(found, 0)
    assert (shares[1].share, shares[2].share, void) == (0.5, 0.25, 0.25)
    assert shares[1].confidence == pytest.approx((0.9 + 0.55) / 2, abs=1e-3)
    record = folder / "runs/main/surfels/prepared.json"
    record.write_text(record.read_text())  # prepared anew
    assert not results.computed(folder, "main", 2)


def test_the_overlay_has_the_colours_of_the_classes_where_photos_show_them(tmp_path):
    folder = project_with_labels(tmp_path / "p")
    found = results.labelling(folder, "main", 2)
    surfels = results.photo_map(folder, "main", "a")
    np.testing.assert_array_equal(surfels, [[0, 1, -1], [2, 3, 3]])
    colors = {1: (1.0, 0.0, 0.0), 2: (0.0, 0.5, 0.0)}
    seen = results.overlay(found, surfels, colors, 0, confidence=False)
    red, green, clear = (1, 0, 0, 1), (0, 0.5, 0, 1), (0, 0, 0, 0)
    # From the bottom row: surfel 2 is void, 3 is of the first class.
    np.testing.assert_allclose(seen, [[clear, red, red], [red, green, clear]])
    doubt = results.overlay(found, surfels, colors, 0, confidence=True)
    assert doubt[0, 0].tolist() == pytest.approx([*results.VOID_COLOR, 1.0])
    assert doubt[1, 0].tolist() == [1, 0, 0, 1], "sure places are as before"
    assert doubt[1, 1, 1] < 0.5, "unsure places are hatched"
    assert doubt[1, 2, 3] == 0


def test_what_is_missing_or_damaged_is_no_labelling(tmp_path):
    folder = project_with_labels(tmp_path / "p")
    assert surfel_map(folder / "runs/main/surfels", "nobody") is None
    assert surfel_map(folder / "runs/other/surfels", "a") is None
    path = path_of(folder, "main", 2)
    whole = path.read_bytes()
    for broken in (b"", whole[:100], b"PK" + whole[2:50]):
        path.write_bytes(broken)
        assert read_labelling(path) is None
        assert results.labelling(folder, "main", 2) is None


def test_marks_become_steps_of_undo_and_undo_shows_earlier_revisions(bpy_script, tmp_path):
    """The revision stands in the scene: undo brings it back, and the project follows."""
    facts = bpy_script(
        SETUP
        + """
from fieldwork.addon.jobs.queue import queue
from fieldwork.addon.labels import journal, pending, session
from fieldwork.nerfcore.labels.journal import append_mark, show
folder = Path(project)
def engine(verb, params, on_done):
    values = {name: value for name, value in params.items() if name not in ("project", "revision")}
    if verb == "label checkout":
        show(folder, params["revision"])
        on_done({"revision": params["revision"]}, None)
    else:
        on_done({"revision": append_mark(folder, values).revision}, None)
queue.ask_and_wait = engine
look = lambda: [bpy.context.scene.fieldwork.label_revision, journal.shown(folder)]
settings.project = project
session.begin(settings)
bpy.ops.ed.undo_push(message="begin")
seen = [look()]
for class_id in (1, 2):
    session.mark(folder, {"photo": "a", "shape": "line", "points": [[1, 1]], "width": 2.0, "class_id": class_id})
    bpy.ops.ed.undo_push(message="Label")
    seen.append(look())
for step in (bpy.ops.ed.undo, bpy.ops.ed.undo, bpy.ops.ed.redo):
    step()
    seen.append(look())
# A file that was saved before: its revision is old news.
bpy.ops.wm.save_as_mainfile(filepath=project + "/x.blend")
append_mark(folder, {"photo": "a", "shape": "line", "points": [[1, 1]], "width": 2.0, "class_id": 1})
bpy.ops.wm.open_mainfile(filepath=project + "/x.blend")
seen.append(look())
answer(seen)
""",
        project=project_without_marks(tmp_path / "p"),
    )
    assert facts == [[0, 0], [1, 1], [2, 2], [1, 1], [0, 0], [1, 1], [3, 3]]


def test_undo_of_a_mark_on_its_way_waits_until_it_is_a_step(bpy_script, tmp_path):
    facts = bpy_script(
        SETUP
        + """
from fieldwork.addon.errors import EngineError
from fieldwork.addon.jobs.queue import queue
from fieldwork.addon.labels import journal, pending, session
from fieldwork.nerfcore.labels.journal import append_mark, show
folder, answers = Path(project), []
def engine(verb, params, on_done):
    if verb == "label checkout":
        show(folder, params["revision"])
        on_done({"revision": params["revision"]}, None)
    else:
        values = {name: value for name, value in params.items() if name not in ("project", "revision")}
        answers.append(lambda: on_done({"revision": append_mark(folder, values).revision}, None))
        refusals.append(lambda: on_done(None, EngineError("input", "It lies outside the photo.")))
queue.ask_and_wait, refusals = engine, []
session.undo_step = lambda message: bpy.ops.ed.undo_push(message=message)  # without a window nothing is one
mark = lambda: session.mark(folder, {"photo": "a", "shape": "line", "points": [[1, 1]], "width": 2.0, "class_id": 1})
look = lambda: [bpy.context.scene.fieldwork.label_revision, journal.shown(folder), bpy.ops.fieldwork.label_undo.poll()]
settings.project = project
session.begin(settings)
bpy.ops.ed.undo_push(message="begin")
seen = []
def land():
    seen.append(look())
    answers.pop(0)()
    session.work()
    session.work()
    seen.append(look())
mark()
land()
mark()
bpy.ops.fieldwork.label_undo()
land()
# Twice: the mark and the one before it.
mark()
bpy.ops.fieldwork.label_undo()
bpy.ops.fieldwork.label_undo()
land()
# What the engine refuses is no step.
mark()
bpy.ops.fieldwork.label_undo()
try:
    refusals[-1]()
    session.work()
except EngineError:
    pass
seen.append(look())
answer(seen)
""",
        project=project_without_marks(tmp_path / "p"),
    )
    on_the_way, taken = facts[0:-1:2], facts[1:-1:2]
    assert on_the_way == [[0, 0, True], [1, 1, True], [1, 1, True]]
    assert taken == [[1, 1, False], [1, 1, False], [0, 0, False]]
    assert facts[-1] == [0, 0, False]


def test_undo_of_what_is_being_cut_out_cancels_that(bpy_script, tmp_path):
    """Unless something was drawn since: then that is undone."""
    facts = bpy_script(
        SETUP
        + """
from fieldwork.addon.jobs.queue import queue
from fieldwork.addon.labels import pending
folder, cancelled, seen = Path(project), [], []
settings.project = project
can = bpy.ops.fieldwork.label_undo.poll
seen.append(can())
queue.running = queue.make("assist segment", {"project": project, "drawn_on": 0})
queue.running.state = "running"
queue.cancel = lambda job: (cancelled.append(job.verb), setattr(job, "state", "cancelling"))
seen.append(can())
bpy.ops.fieldwork.label_undo()
seen += [list(cancelled), can()]
queue.running.state = "running"
queue.running.params["drawn_on"] = 3
seen.append(can())
queue.running.params["drawn_on"] = 0
pending.mark(folder, {"photo": "a"})
bpy.ops.fieldwork.label_undo()
seen.append(len(cancelled))
queue.running = None
answer(seen)
""",
        project=project_without_marks(tmp_path / "p"),
    )
    assert facts == [False, True, ["assist segment"], False, False, 1]


def test_undo_of_what_is_being_cut_out_after_a_stroke_on_its_way_cancels_that_and_not_the_stroke(bpy_script, tmp_path):
    facts = bpy_script(
        SETUP
        + """
from fieldwork.addon.jobs.queue import queue
from fieldwork.addon.labels import pending
from fieldwork.nerfcore.labels.journal import append_mark, show
from fieldwork.operators.label_models import cut_out
folder, cancelled, answers, seen = Path(project), [], [], []
def run(job):
    queue.running = job
    job.state = "running"
def engine(verb, params, on_done):
    values = {name: value for name, value in params.items() if name not in ("project", "revision")}
    answers.append(lambda: on_done({"revision": append_mark(folder, values).revision}, None))
queue.run, queue.cancel = run, lambda job: cancelled.append(job.verb)
settings.project = project
settings.label_encoder, settings.label_decoder, settings.class_index = "/m/e.onnx", "/m/d.onnx", 1
def stroke():
    pending.mark(folder, {"photo": "a", "shape": "line", "points": [[1, 1]], "width": 2.0, "class_id": 1})
    pending.send(engine)
def undo():
    before = len(cancelled)
    bpy.ops.fieldwork.label_undo()
    return len(cancelled) > before
stroke()
cut_out(settings, folder, "a", [(10.5, 20.0)])
seen.append(undo())  # while the engine has not answered
answers.pop(0)()
seen.append(undo())  # before it is a step
pending.take()
seen += [queue.running.params["drawn_on"], undo()]
stroke()
seen.append(undo())  # drawn later
answers.pop(0)()
pending.take()
seen.append(bpy.ops.fieldwork.label_undo.poll())  # Blender undoes it
show(folder, 1)
seen.append(undo())
answer(seen)
""",
        project=project_without_marks(tmp_path / "p"),
    )
    assert facts == [True, True, 1, True, False, False, True]


def project_without_marks(folder: Path) -> Path:
    project_with_labels(folder)
    for path in (folder / "marks").iterdir():
        path.unlink()
    return folder


def test_what_a_stroke_says_follows_from_the_tool(bpy_script, tmp_path):
    facts = bpy_script(
        SETUP
        + """
from fieldwork.operators.label_tool import mark_parameters
seen = [mark_parameters(settings)]
settings.project = project
settings.label_width, settings.label_author, settings.class_index = 7, "Ada", 1
for tool in ("brush", "click", "erase", "void"):
    settings.label_tool = tool
    seen.append(mark_parameters(settings))
settings.label_tool = "brush"
seen.append(mark_parameters(settings, erase=True))
settings.label_tool, settings.label_encoder, settings.label_decoder = "click", "e.onnx", "d.onnx"
seen.append(mark_parameters(settings))
settings.label_tool = "part"
seen.append(mark_parameters(settings))
answer(seen)
""",
        project=make_posed_project(tmp_path / "p"),
    )
    common = {"width": 7.0, "author": "Ada"}
    assert facts[0] is None, "there is no class to mark"
    assert facts[1] == {**common, "shape": "line", "class_id": 2}
    assert facts[2] == {**common, "shape": "part", "width": 2.0, "class_id": 2}
    assert facts[3] == facts[5] == {**common, "shape": "line", "erase": True}
    assert facts[4] == {**common, "shape": "line", "void": True}
    assert facts[6]["box"], "with a model a click asks it"
    from fieldwork.nerfcore.params import LabelStrokeParams

    part = {**common, "shape": "part", "width": 2.0, "class_id": 2}
    assert facts[7] == {**part, "level": "coarse"}, "parts are those of the surface, with a model too"
    for values in (*facts[1:6], facts[7]):
        LabelStrokeParams.model_validate({"project": tmp_path, "photo": "a", "points": [(1, 1)], **values})


def test_labels_are_imported_and_exported_by_the_engine(bpy_script, tmp_path):
    """What the operators ask for is what the verbs take."""
    facts = bpy_script(
        SETUP
        + """
from fieldwork.addon.jobs.queue import queue
asked = []
def run(job):
    asked.append([job.verb, job.params])
    job.state, job.result = "done", {"photos": 3}
    if job.on_done:
        job.on_done(job)
    return job.result
queue.run = run
settings.project = project
seen = [attempt(lambda: bpy.ops.fieldwork.label_import()), attempt(lambda: bpy.ops.fieldwork.label_export())]
bpy.ops.fieldwork.label_import(filepath="/data/annotations.xml", format="cvat", replace=True)
settings.class_index = 1
bpy.ops.fieldwork.label_export(filepath="/data/labels", format="coco")
bpy.ops.fieldwork.label_export(filepath="/data/masks", format="masks", source="marks", revision=2)
answer([seen, asked])
""",
        project=make_posed_project(tmp_path / "p"),
    )
    (nothing, nowhere), asked = facts
    assert "Choose a file" in nothing
    assert "Choose a file" in nowhere
    from fieldwork.nerfcore.params import LabelExportParams, LabelImportParams

    read = LabelImportParams.model_validate(asked[0][1])
    assert (read.file, read.format, read.replace) == (Path("/data/annotations.xml"), "cvat", True)
    files, masks = (LabelExportParams.model_validate(params) for _, params in asked[1:])
    assert (files.out, files.format, files.source) == (Path("/data/labels.json"), "coco", "maps")
    assert (masks.out, masks.class_name, masks.revision) == (Path("/data/masks"), "gold", 2)


def test_the_file_browser_warns_of_files_that_are_there(bpy_script):
    """It looks for the name that is shown, which therefore ends as the file will."""
    facts = bpy_script(
        SETUP
        + """
from types import SimpleNamespace
from fieldwork.operators.label_files import FIELDWORK_OT_label_export as Export
from fieldwork.operators.live import FIELDWORK_OT_save_field_edits as Save
own = bpy.ops.fieldwork
facts = [each.get_rna_type().properties["check_existing"].default for each in (own.label_export, own.save_field_edits)]
own = SimpleNamespace(filepath="/data/labels", format="coco")
own._named = lambda path: Export._named(own, path)
for format in ("coco", "cvat", "masks", "masks"):
    own.format = format
    facts.append([Export.check(own, None), own.filepath])
own.filepath = "/data/edits"
facts += [[Save.check(own, None), own.filepath], [Save.check(own, None), own.filepath]]
answer(facts)
"""
    )
    assert facts[:2] == [True, True]
    assert facts[2:6] == [
        [True, "/data/labels.json"],
        [True, "/data/labels.xml"],
        [True, "/data/labels"],
        [False, "/data/labels"],
    ]
    assert facts[6:] == [[True, "/data/edits.json"], [False, "/data/edits.json"]]


def test_clicks_and_boxes_go_to_the_model_and_come_back_as_marks(bpy_script, tmp_path):
    facts = bpy_script(
        SETUP
        + """
from fieldwork.addon.jobs.queue import queue
from fieldwork.addon.labels import pending
from fieldwork.operators.label_models import cut_out
asked = []
def run(job):
    asked.append([job.verb, dict(job.params)])
    job.state, job.result = "done", {"revision": 7}
    if job.on_done:
        job.on_done(job)
    return job.result
queue.run = run
settings.project = project
folder = Path(project)
settings.label_encoder, settings.label_decoder, settings.class_index = "/m/e.onnx", "/m/d.onnx", 1
cut_out(settings, folder, "a", [(10.5, 20.0), (11.0, 20.0)])
revision = settings.label_revision
pending.mark(folder, {"photo": "a"})
cut_out(settings, folder, "a", [(30.0, 5.0), (10.0, 25.0)])
pending.clear()
bpy.ops.fieldwork.assist_segment(photo="a", points="1,2 3,4", outside="9,9", void=True)
bpy.ops.fieldwork.assist_embed(photos="a, b")
bpy.ops.fieldwork.assist_suggest(model="/m/s.onnx", mapping="/m/c.json", least=0.25)
wrong = attempt(lambda: bpy.ops.fieldwork.assist_segment(photo="a", points="1;2"))
answer([asked, revision, wrong])
""",
        project=make_posed_project(tmp_path / "p"),
    )
    asked, revision, wrong = facts
    from fieldwork.nerfcore import params as p

    models = [
        p.AssistSegmentParams,
        p.AssistSegmentParams,
        p.AssistSegmentParams,
        p.AssistEmbedParams,
        p.AssistSuggestParams,
    ]
    click, box, void, ahead, guess = (model.model_validate(values) for model, (_, values) in zip(models, asked))
    assert (click.points, click.box, click.class_id) == ([(10.5, 20.0)], None, 2)
    assert (box.points, box.box) == ([], (10.0, 5.0, 30.0, 25.0))
    assert (click.drawn_on, box.drawn_on) == (0, None), "a mark on its way has no revision yet"
    assert (void.points, void.outside, void.void, void.class_id) == ([(1, 2), (3, 4)], [(9, 9)], True, None)
    assert ahead.photos == ["a", "b"]
    assert (guess.model, guess.least) == (Path("/m/s.onnx"), 0.25)
    assert revision == 7, "what was cut out is a step of undo"
    assert "are no places" in wrong
