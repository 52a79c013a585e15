"""The operators without a window: they block, take settings from arguments or the scene, and fail with sentences."""

from __future__ import annotations

import json

import pytest
from fieldwork.tests.addon.support import SETUP, make_posed_project, make_project


def test_failures_are_sentences(bpy_script, tmp_path):
    (tmp_path / "empty").mkdir()
    facts = bpy_script(
        SETUP
        + """
answer({
    "no project": attempt(lambda: bpy.ops.fieldwork.poses()),
    "photos": attempt(lambda: bpy.ops.fieldwork.new(project=folder + "/p", photos=folder + "/none")),
    "no photos": attempt(lambda: bpy.ops.fieldwork.new(project=folder + "/p")),
    "empty": attempt(lambda: bpy.ops.fieldwork.new(project=folder + "/p", photos=folder + "/empty")),
    "project": attempt(lambda: bpy.ops.fieldwork.poses(project=folder + "/none")),
    "settings": attempt(lambda: bpy.ops.fieldwork.train(project=folder, settings="fast")),
    "align": attempt(lambda: bpy.ops.fieldwork.align(project=folder)),
    "blend": attempt(lambda: bpy.ops.fieldwork.blend(project=folder, out="x.obj")),
    "open blend": attempt(lambda: (bpy.ops.wm.save_as_mainfile(filepath=folder + "/x.blend"),
                                   bpy.ops.fieldwork.blend(project=folder, out=folder + "/x.blend"))[1]),
    "export": attempt(lambda: bpy.ops.fieldwork.export(project=folder, to="glb")),
    "export to": attempt(lambda: bpy.ops.fieldwork.export(project=folder)),
    "batch": attempt(lambda: bpy.ops.fieldwork.batch(list=folder + "/none.csv")),
    "no batch": attempt(lambda: bpy.ops.fieldwork.batch()),
    "bench": attempt(lambda: bpy.ops.fieldwork.bench(out=folder, scenes="nothing")),
    "no bench": attempt(lambda: bpy.ops.fieldwork.bench()),
    "camera": attempt(lambda: (setattr(scene, "camera", None), bpy.ops.fieldwork.render(project=folder))[1]),
    "open": attempt(lambda: bpy.ops.fieldwork.open(filepath=folder + "/nothing.mp4")),
})
""",
        folder=tmp_path,
    )
    for name, words in {
        "photos": "does not exist",
        "no photos": "Choose a folder of photos",
        "empty": "photo",
        "project": "not a capture project",
        "no project": "Choose a project folder",
        "settings": "name=value",
        "align": "Choose an up direction",
        "blend": "ends in .blend",
        "open blend": "x.blend is open here",
        "export": "not a capture project",
        "export to": "Choose a format",
        "batch": "cannot be read",
        "no batch": "Choose a list",
        "bench": "nothing",
        "no bench": "Choose a folder",
        "camera": "no active camera",
        "open": "nothing at",
    }.items():
        assert words in facts[name], name


def test_missing_engine_is_told(bpy_script, tmp_path):
    message = bpy_script(
        SETUP
        + """
from fieldwork.addon import machine
machine.engine_python = lambda: None
answer(attempt(lambda: bpy.ops.fieldwork.doctor()))
"""
    )
    assert "not installed" in message


def test_grey_buttons_say_why(bpy_script, tmp_path):
    facts = bpy_script(
        SETUP
        + """
import sys
from fieldwork.addon import machine
operators = {
    name: getattr(bpy.types, f"FIELDWORK_OT_{name}")
    for name in ("new", "poses", "align", "train", "render", "mesh", "blend", "import_scene", "evaluate")
}
reasons = {name: cls.reason(bpy.context) for name, cls in operators.items()}
machine.engine_python = lambda: None
settings.project = project
reasons["no engine"] = operators["poses"].reason(bpy.context)
need = bpy.types.FIELDWORK_OT_export.need_format
needs = [need(bpy.context)]
for settings.export_to in ("glb", "onnx", "colmap"):
    needs.append(need(bpy.context))
reasons["export"] = needs
answer(reasons)
""",
        project=make_project(tmp_path / "capture"),
    )
    assert facts.pop("export") == [
        "Choose a format for other programs in the Export panel",
        "Extract the mesh first",
        "Estimate the camera poses first",
        None,
    ]
    assert facts.pop("new") == "Choose a folder of photos, or a video, first"
    assert "preferences" in facts.pop("no engine")
    assert set(facts.values()) <= {"Read photos into a project first", "The scene has no active camera"}
    assert facts["poses"] == "Read photos into a project first"


def test_every_operator_and_property_has_a_tooltip(bpy_script):
    lacking = bpy_script(
        SETUP
        + """
lacking = []
for name in dir(bpy.ops.fieldwork):
    rna = getattr(bpy.ops.fieldwork, name).get_rna_type()
    if not rna.description:
        lacking.append(name)
for group in (settings, ):
    for prop in group.bl_rna.properties:
        if prop.identifier not in ("rna_type", "name", "images", "classes") and not prop.description:
            lacking.append(prop.identifier)
answer(lacking)
"""
    )
    assert lacking == []


def test_training_settings_are_read_from_text():
    pytest.importorskip("bpy")
    from fieldwork.operators.train import parse_settings

    assert parse_settings("loss.semantic_weight=0.1  field.levels=6") == {
        "loss.semantic_weight": "0.1",
        "field.levels": "6",
    }
    assert parse_settings("") == {}
    with pytest.raises(ValueError, match="name=value"):
        parse_settings("field.levels=")


# Settings of verbs that operators call otherwise: Python and Blender's own names stand in the way, or a scene does
# what a file does on the command line.
RENAMED = {
    ("import", "dataset"): "directory",
    ("align", "scale"): "distance",
    ("train", "set"): "settings",
    ("render", "test"): "source",
    ("render", "all"): "source",
    ("reconstruct", "set"): "settings",
    ("blocks", "set"): "settings",
    ("reconstruct", "report"): "report_file",
    ("batch", "report"): "report_file",
    ("evaluate", "report"): "report_file",
    ("bench", "set"): "settings",
    ("dataset", "blend"): None,  # the file that is open
    ("dataset", "path"): "path_kind",
    ("dataset", "center"): "around",
    ("label import", "file"): "filepath",
    ("label export", "out"): "filepath",
    ("classes", "classes"): None,  # those of the list in the scene
    ("region", "bounds"): None,  # those of the box in the scene
    ("region", "clear"): None,  # crop_remove
}
OPERATORS = {"import": "import_dataset", "package": "import_scene", "classes": "classes_apply", "region": "crop_apply"}


def test_every_verb_with_every_setting_is_an_operator(bpy_script):
    from fieldwork.nerfcore.verbs import VERBS

    # Edits that take no time are no jobs: the list of classes and the crop box make them.
    jobs = {verb: entry for verb, entry in VERBS.items() if not entry.immediate}
    wanted = {verb: sorted(entry.params.model_fields) for verb, entry in jobs.items()}
    lacking = bpy_script(
        SETUP
        + """
lacking = []
for verb, names in wanted.items():
    operator = operators.get(verb, verb.replace(" ", "_"))
    if operator not in dir(bpy.ops.fieldwork):
        lacking.append(operator)
        continue
    properties = set(getattr(bpy.ops.fieldwork, operator).get_rna_type().properties.keys())
    for name in names:
        own = renamed.get(f"{verb}.{name}", name)
        if own is not None and own not in properties:
            lacking.append(f"{operator}.{own}")
answer(lacking)
""",
        wanted=wanted,
        operators=OPERATORS,
        renamed={f"{verb}.{name}": own for (verb, name), own in RENAMED.items()},
    )
    assert lacking == []


def test_a_button_cancels_only_its_own_job(bpy_script, tmp_path):
    facts = bpy_script(
        SETUP
        + """
from fieldwork.addon.jobs.queue import queue
make = lambda: queue.make("count", {"project": folder})
running, first, second = make(), make(), make()
running.state, queue.running, queue.waiting = "running", running, [first, second]
bpy.ops.fieldwork.cancel(job="count-of-yesterday")
states = [[j.state for j in (running, first, second)]]
bpy.ops.fieldwork.cancel(job=second.id)
states.append([j.state for j in (running, first, second)])
bpy.ops.fieldwork.cancel()
states.append([j.state for j in (running, first, second)])
answer(states)
""",
        folder=tmp_path,
    )
    assert facts == [
        ["running", "queued", "queued"],
        ["running", "queued", "cancelled"],
        ["cancelling", "queued", "cancelled"],
    ]


def test_holding_out_is_a_switch_and_without_it_there_is_nothing_to_measure(bpy_script, tmp_path):
    project = make_posed_project(tmp_path / "capture")
    images = [{"name": str(number), "file": "", "status": "ok"} for number in range(9)]
    value = json.loads((project / "project.json").read_text())
    (project / "project.json").write_text(json.dumps({**value, "images": images}))
    for run, info in {"whole": {"holdout": 0}, "usual": {"holdout": 8}, "older": {}, "few": {"holdout": 20}}.items():
        (project / "runs" / run).mkdir(parents=True)
        (project / "runs" / run / "field.safetensors").touch()
        (project / "runs" / run / "config.json").write_text(json.dumps(info))
    facts = bpy_script(
        SETUP
        + """
from fieldwork.addon.jobs.queue import queue
from fieldwork.panels.main import next_step
seen = []
queue.run = lambda job: seen.append(job.params["holdout"])
settings.project = project
for settings.hold_out in (True, False):
    bpy.ops.fieldwork.train()
    bpy.ops.fieldwork.reconstruct(photos=project)
    bpy.ops.fieldwork.train(holdout=10)
measure, render = bpy.types.FIELDWORK_OT_evaluate, bpy.types.FIELDWORK_OT_render
settings.render_from = "photos"
reasons = {}
for settings.run in ("whole", "usual", "older", "few"):
    reasons[settings.run] = [cls.reason(bpy.context) for cls in (measure, render)]
settings.run, settings.render_from = "whole", "all"
reasons["all photos"] = render.reason(bpy.context)
answer({"seen": seen, "reasons": reasons})
""",
        project=project,
    )
    assert facts["seen"] == [8, 8, 10, 0, 0, 10]
    for run, held_out in {"whole": False, "usual": True, "older": True, "few": False}.items():
        for reason in facts["reasons"][run]:
            assert reason is None if held_out else "all photos" in reason
    assert facts["reasons"]["all photos"] is None


def test_a_reconstruction_closes_its_mesh_as_the_mesh_panel_says(bpy_script, tmp_path):
    seen = bpy_script(
        SETUP
        + """
from fieldwork.addon.jobs.queue import queue
seen = []
queue.run = lambda job: seen.append([job.params["close_gaps"], job.params["watertight"]])
settings.project = folder
bpy.ops.fieldwork.reconstruct(photos=folder)
settings.close_gaps = 5
bpy.ops.fieldwork.reconstruct(photos=folder)
bpy.ops.fieldwork.reconstruct(photos=folder, close_gaps=2, watertight=True)
settings.watertight = True
bpy.ops.fieldwork.reconstruct(photos=folder)
answer(seen)
""",
        folder=tmp_path,
    )
    assert seen == [[0, False], [5, False], [2, True], [5, True]]


def test_a_training_that_is_to_take_the_place_of_another_can_be_resumed(tmp_path):
    from fieldwork.addon.project import runs

    (tmp_path / "runs/.new/main").mkdir(parents=True)
    (tmp_path / "runs/.new/main/field.safetensors").touch()
    assert runs.can_resume(tmp_path, "main")
    assert runs.runs(tmp_path) == []
