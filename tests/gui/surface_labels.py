"""Marks on the surface by the mouse in the 3D viewport. A generator over a `Screen` (see driver.py).

FIELDWORK_BALL names the project of the trained ball with a mesh.
"""

from __future__ import annotations

import math
import os
from pathlib import Path

import bpy
from bpy_extras.view3d_utils import location_3d_to_region_2d
from live import look
from mathutils import Vector
from steps import alias, finish

RADIUS = 0.5


def labels_on_surface(screen):
    """A stroke over the upper half, one over the lower, a click beside the ball, a stroke that begins beside it, leaves it and
    comes back, and undo of that and of the one before."""
    for obj in list(bpy.data.objects):
        bpy.data.objects.remove(obj)
    settings = bpy.context.scene.fieldwork
    settings.project = alias(Path(os.environ["FIELDWORK_BALL"]), "ball_labels")
    folder = Path(settings.project)
    yield from screen.show_sidebar()
    bpy.ops.fieldwork.import_scene()
    found = lambda: any(obj.get("fieldwork_role") == "mesh" for obj in bpy.data.objects)  # noqa: E731
    yield from screen.wait(found, 120, "the mesh does not come")
    yield from screen.wait(lambda: screen.queue.current is None, 60, "the job does not end")
    for obj in bpy.data.objects:
        obj.hide_set(obj.get("fieldwork_role") not in ("mesh", "root"))
    look(screen)
    yield 0.5
    with bpy.context.temp_override(window=screen.window, area=screen.area, region=screen.view):
        bpy.ops.wm.tool_set_by_id(name="fieldwork.label_surface", space_type="VIEW_3D")
    journal, results = screen.module("addon.labels.journal"), screen.module("addon.labels.results")
    yield 0.5
    for number, height in enumerate((0.5, -0.5)):
        settings.class_index = number
        yield from stroke(screen, height)
        yield from screen.wait(lambda n=number: len(journal.marks(folder)) == n + 1, 60, "the mark is not taken")
    yield from screen.wait(lambda: results.computed(folder, "main", 2), 120, "nothing was propagated")
    yield from screen.wait(lambda: screen.queue.current is None, 60, "the job does not end")
    yield 0.5
    screen.shot("surface")
    screen.facts["colors"] = {str(c.id): list(c.color) for c in settings.classes}
    screen.facts["seen"] = {str(height): seen(screen, -math.pi / 2, height) for height in (0.5, -0.5)}
    x, y = screen.area.x + screen.area.width * 0.25, screen.area.y + 60
    yield from screen.click(x, y)
    screen.facts["after a click beside it"] = len(journal.marks(folder))
    settings.class_index = 0
    upper, lower = (on_screen(screen, -math.pi / 2, height)[1] for height in (0.4, -0.4))
    middle, right = on_screen(screen, -math.pi / 2, 0)[0], on_screen(screen, 0, 0)[0] + 60
    yield from drag(screen, [(2 * middle - right, upper), (right, upper), (right, lower), (middle, lower)])
    yield from screen.wait(lambda: settings.label_revision == 4, 60, "the pieces of the stroke are not taken")
    screen.shot("pieces")
    for revision, words in ((2, "undo does not take all pieces"), (1, "undo does not show the revision before")):
        with bpy.context.temp_override(window=screen.window, area=screen.area, region=screen.view):
            bpy.ops.ed.undo()
        yield from screen.wait(lambda r=revision: journal.shown(folder) == r, 60, words)
    screen.facts["marks"] = journal.marks(folder)
    yield from finish(screen)


def on_screen(screen, azimuth, height):
    flat = math.sqrt(1 - height**2)
    point = Vector((flat * math.cos(azimuth), flat * math.sin(azimuth), height)) * RADIUS
    x, y = location_3d_to_region_2d(screen.view, screen.area.spaces.active.region_3d, point)
    return round(screen.view.x + x), round(screen.view.y + y)


def seen(screen, azimuth, height):
    """Where a place of the ball is in a screenshot."""
    x, y = on_screen(screen, azimuth, height)
    return [x, 1080 - 1 - y]


def stroke(screen, height):
    """Draw along the ball's side that is seen."""
    yield from drag(screen, [on_screen(screen, -math.pi / 2 + step * 0.1, height) for step in range(-8, 9)])


def drag(screen, places):
    """Draw with the left button from place to place of the screen."""
    send = screen.window.event_simulate
    screen.move(*places[0])
    yield 0.2
    send(type="LEFTMOUSE", value="PRESS", x=places[0][0], y=places[0][1])
    yield 0.1
    for place in places[1:]:
        screen.move(*place)
        yield 0.03
    send(type="LEFTMOUSE", value="RELEASE", x=places[-1][0], y=places[-1][1])
    yield 0.2
