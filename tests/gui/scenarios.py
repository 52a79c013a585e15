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
    for panel in ("capture", "poses", "classes", "train", "render", "mesh", "export", "engine"):
        yield from screen.toggle(panel)
        screen.shot(f"panel-{panel}")
        yield from screen.toggle(panel)
    screen.facts["slowest"] = screen.queue.slowest_tick
