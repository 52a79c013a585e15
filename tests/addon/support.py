"""What tests of the Blender side share."""

from __future__ import annotations

import json
import uuid

SETUP = """
import fieldwork
fieldwork.register()
scene = bpy.context.scene
settings = scene.fieldwork
def attempt(call):
    try:
        return sorted(call())
    except RuntimeError as error:
        return str(error)
"""

# What the engine does with edits of a project, at once and in this process.
ENGINE = """
from fieldwork.addon.jobs.queue import queue
from fieldwork.addon.project import edits
asked = []
def write(folder, **changes):
    path = Path(folder) / "project.json"
    value = json.loads(path.read_text()) | changes
    path.with_name("part").write_text(json.dumps(value))
    os.replace(path.with_name("part"), path)
def stored(folder):
    return json.loads((Path(folder) / "project.json").read_text())
def engine(verb, params, on_done):
    asked.append(verb)
    folder = params["project"]
    if verb == "classes":
        write(folder, classes=params["classes"])
    else:
        write(folder, frame={**stored(folder).get("frame", {}), "bounds": params.get("bounds")})
    on_done({}, None)
def settle():
    edits.send(engine, at_once=True)
queue.ask_and_wait = engine
"""


def make_project(folder, **more):
    """A project as the panels see it."""
    folder.mkdir(parents=True, exist_ok=True)
    project = {
        "format": "fieldwork-project",
        "version": 2,
        "uuid": uuid.uuid4().hex,
        "images": [
            {"name": "a", "file": "images/a.jpg", "width": 640, "height": 480, "label": "labels/a.png"},
            {"name": "b", "file": "", "status": "rejected", "reason": "It is blurred."},
        ],
        "classes": [
            {"id": 1, "name": "stone", "color": [0.5, 0.5, 0.5], "priority": 1.0},
            {"id": 2, "name": "gold", "color": [1.0, 0.8, 0.0], "priority": 2.0},
        ],
        "provenance": [{"verb": "mesh", "time": "", "version": "", "result": {"classes": {"gold": {"area": 0.25}}}}],
        **more,
    }
    (folder / "project.json").write_text(json.dumps(project))
    return folder


def make_posed_project(folder):
    """A project with camera poses, as the panels see it."""
    make_project(folder)
    (folder / "poses").mkdir()
    (folder / "poses" / "poses.json").write_text("{}")
    return folder
