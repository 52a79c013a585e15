"""What happens in the window. Each function is a generator over a `Screen` (see driver.py)."""

from __future__ import annotations

import bpy


def look(screen):
    """All panels of a capture that has photos and poses."""
    settings = bpy.context.scene.fieldwork
    settings.photos = "/work/shared/data/banana/images"
    settings.project = str(screen.folder / "project")
    yield from screen.show_sidebar()
    screen.shot("chosen")
    bpy.ops.fieldwork.new()
    yield 1.0
    screen.shot("reading")
    yield from screen.wait(lambda: not screen.queue.current, 60, "reading photos")
    bpy.ops.fieldwork.poses(preset="fast")
    yield 8.0
    screen.shot("posing")
    yield from screen.wait(lambda: not screen.queue.current, 240, "estimating poses")
    screen.facts["error"] = screen.queue.last.error
    for panel in ("capture", "poses", "classes", "train", "render", "mesh", "export", "engine"):
        yield from screen.toggle(panel)
        screen.shot(f"panel-{panel}")
        yield from screen.toggle(panel)
    screen.facts["slowest"] = screen.queue.slowest_tick
    bpy.ops.fieldwork.import_scene()
    yield from screen.wait(lambda: not screen.queue.current, 60, "package")
    yield 1.0
    screen.shot("scene")
    bpy.ops.screen.userpref_show("INVOKE_DEFAULT")
    bpy.ops.fieldwork.open_preferences()
    yield 2.0
    screen.shot("preferences")
