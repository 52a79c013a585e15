"""What several scenarios have in common. Each function that waits is a generator over a `Screen` (see driver.py)."""

from __future__ import annotations

import shutil
from pathlib import Path

import bpy

DATA = Path(__file__).resolve().parents[3] / "shared" / "data"
PHOTOS = DATA / "banana" / "images"

PANELS = [
    "capture",
    "poses",
    "classes",
    "train",
    "label",
    "render",
    "live",
    "mesh",
    "measure",
    "things",
    "export",
    "engine",
]


def faces(obj):
    return len(obj.evaluated_get(bpy.context.evaluated_depsgraph_get()).data.polygons)


def every_panel(screen, name):
    """Open the sub-panels one by one."""
    for panel in PANELS:
        yield from screen.toggle(panel)
        yield 0.4
        screen.shot(f"{name}-{panel}")
        yield from screen.toggle(panel)


def opened(screen):
    """A copy of the posed capture that the scenario `capture` left."""
    project = screen.folder / "project"
    if not project.is_dir():
        shutil.copytree(screen.folder.parent / "capture" / "project", project)
    settings = bpy.context.scene.fieldwork
    settings.project = alias(project, "banana_fieldwork")
    yield from screen.show_sidebar()
    return settings


def alias(folder, name):
    """A short way to a folder."""
    folder.mkdir(exist_ok=True)
    link = Path("/tmp", name)
    if not link.is_symlink():
        link.symlink_to(folder)
    return str(link)


def training(screen, operator, resume=False):
    bpy.ops.fieldwork.train(resume=resume)
    yield from screen.wait(
        lambda: screen.queue.running is None or len(screen.queue.running.curve) > 1, 120, "training does not start"
    )
    assert screen.queue.running is not None, screen.queue.last.error


def drop(screen, folder):
    """Drag a photo from a file browser onto the viewport, and open it in Fieldwork."""
    target = yield from drag_photo(screen, folder)
    # Blender itself can make an image of the photo: a menu asks. Which entry is under the mouse depends on its version.
    screen.shot("drop-menu")
    screen.press("O", *target)  # the underlined letter of “Open Photos or Project”
    yield 0.5
    yield from close_browser(screen)


def close_browser(screen):
    """Let the file browser be the properties again."""
    next(area for area in screen.window.screen.areas if area.type == "FILE_BROWSER").type = "PROPERTIES"
    yield 0.5


def drag_photo(screen, folder):
    """Drag a photo from a file browser onto the viewport; returns where it was let go."""
    browser = next(area for area in screen.window.screen.areas if area.type == "PROPERTIES")
    browser.type = "FILE_BROWSER"
    yield 1.0
    browser.spaces.active.show_region_toolbar = False
    params = browser.spaces.active.params
    params.directory = str(folder).encode()
    params.display_type = "LIST_VERTICAL"
    params.use_filter = False
    yield 2.0
    region = next(region for region in browser.regions if region.type == "WINDOW")
    x, y = region.x + 18, region.y + region.height - 40
    for shift in (3, 1, 0):
        screen.move(x + shift, y)
        yield 0.2
    screen.shot("browser")
    screen.window.event_simulate(type="LEFTMOUSE", value="PRESS", x=int(x), y=int(y))
    yield 0.3
    for shift in range(2, 40, 3):
        screen.move(x - shift / 4, y + shift)
        yield 0.05
    view = screen.area
    target = (view.x + view.width * 0.4, view.y + view.height * 0.6)
    for step in range(1, 12):
        screen.move(x + (target[0] - x) * step / 11, y + (target[1] - y) * step / 11)
        yield 0.1
    screen.shot("dragging")
    screen.window.event_simulate(type="LEFTMOUSE", value="RELEASE", x=int(target[0]), y=int(target[1]))
    yield 1.0
    return target


def finish(screen):
    """What every scenario promises."""
    screen.facts["slowest_tick"] = screen.queue.slowest_tick
    screen.facts["slowest_step"] = screen.queue.slowest_step
    screen.facts["slowest_cpu"] = screen.queue.slowest_cpu
    yield 0.1
