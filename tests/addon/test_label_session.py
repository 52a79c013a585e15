"""Labelling in the open Blender while classes, marks and undo come from several sides."""

from __future__ import annotations

import pytest
from fieldwork.tests.addon.support import SETUP
from fieldwork.tests.addon.test_labels import project_with_labels

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
