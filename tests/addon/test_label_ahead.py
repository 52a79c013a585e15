"""Photos that are encoded ahead: those that a click may come to next, each once, and only when there is time."""

from __future__ import annotations

from fieldwork.tests.addon.support import SETUP, make_posed_project


def test_the_photo_shown_and_the_next_three_are_encoded_one_by_one(bpy_script, tmp_path):
    for name in ("e.onnx", "d.onnx"):
        (tmp_path / name).touch()
    facts = bpy_script(
        SETUP
        + """
from fieldwork.addon.jobs.queue import queue
from fieldwork.addon.labels import ahead, editor
names = ["a", "b", "c", "d", "e", "f"]
editor.photos = lambda found: {name: {"name": name} for name in names}
editor.shown_photo = lambda found: "e"
asked = []
queue.submit = lambda job: asked.append([job.verb, *job.params["photos"]])
def turn():
    for _ in range(6):
        ahead.encode(scene)
    told = list(asked)
    asked.clear()
    return told
settings.project = folder + "/p"
facts = [turn()]
settings.label_encoder, settings.label_decoder = folder + "/e.onnx", folder + "/none.onnx"
settings.label_tool = "click"
facts.append(turn())
settings.label_decoder = folder + "/d.onnx"
settings.label_tool = "brush"
facts.append(turn())
settings.label_tool = "click"
facts.append(turn())
editor.shown_photo = lambda found: "a"
facts.append(turn())
ahead.clear()
names[:] = ["a", "b"]
facts.append(turn())
answer(facts)
""",
        folder=tmp_path,
        project=make_posed_project(tmp_path / "p"),
    )
    assert facts[:3] == [[], [], []], "no model, no file, another tool"
    assert facts[3] == [["assist embed", name] for name in ("e", "f", "a", "b")]
    assert facts[4] == [["assist embed", name] for name in ("c", "d")], "what was asked is not asked again"
    assert facts[5] == [["assist embed", name] for name in ("a", "b")]
