"""A field in training in the viewport, and what is said where a field is not to be seen. Each function is a generator
over a `Screen` (see driver.py)."""

from __future__ import annotations

import statistics
import time
from pathlib import Path

import bpy
from live import ball, look, place, settled

POINTS = {
    "field": (0.2, -0.45, 0.1), "low": (0.1, -0.46, -0.2), "front": (-0.2, -1.02, 0.15), "back": (0.6, 0.9, 0.55),
    "top": (0.15, -0.42, 0.25),
}  # fmt: skip


def field_in_training(screen):
    """The ball while a run of it is trained: from the first picture on, among cubes, in each shading mode, with its class
    panel; and what comes after it."""
    yield from ball(screen)
    space, settings = screen.area.spaces.active, bpy.context.scene.fieldwork
    trainings = screen.module("addon.live.training").trainings
    settings.preset, settings.time_limit = "draft", 240.0
    bpy.ops.fieldwork.train()
    own = next(obj for obj in bpy.data.objects if obj.fieldwork.is_field).fieldwork

    def watch():
        return next(iter(trainings.views.values()), None)

    asked, waits = 0.0, []

    def picture(number):
        return watch() is not None and watch().shown is not None and watch().shown_number >= number

    yield from screen.wait(lambda: watch() is not None, 120, "the viewport does not look at the training")
    asked = time.monotonic()
    yield from screen.wait(lambda: picture(1), 60, "there is no picture")
    waits.append(time.monotonic() - asked)
    screen.facts["first size"] = list(watch().size)
    yield 0.3
    screen.shot("first")
    screen.facts["places"] = {name: place(screen, point) for name, point in POINTS.items()}
    screen.facts["points"] = POINTS
    yield 25.0
    screen.facts["later size"] = list(watch().size)
    screen.shot("solid")
    before = len(screen.queue.running.curve)
    for number in range(6):
        space.region_3d.view_distance = 3.0 + 0.3 * (number % 2)
        screen.area.tag_redraw()
        yield 0.5
        wanted = watch().number
        asked = time.monotonic()
        yield from screen.wait(lambda wanted=wanted: picture(wanted), 60, "a view that moved is not shown")
        waits.append(time.monotonic() - asked)
    screen.facts["waits"] = waits
    look(screen)
    own.classes[0].visible = False
    screen.area.tag_redraw()
    yield 12.0
    screen.shot("hidden")
    own.classes[0].visible = True
    own.look = 1.0
    yield 12.0
    screen.shot("labels")
    own.look = 0.0
    space.shading.type = "MATERIAL"
    yield 40.0  # software OpenGL compiles EEVEE's shaders
    screen.shot("material")
    bpy.context.scene.render.engine = "CYCLES"
    bpy.context.scene.cycles.use_denoising = False
    bpy.context.scene.cycles.preview_samples = 1
    space.shading.type = "RENDERED"
    yield 10.0
    screen.shot("cycles")
    space.shading.type = "SOLID"
    assert screen.queue.running is not None, "the training is over too early"
    screen.facts["events"] = len(screen.queue.running.curve) - before
    screen.facts["pictures"] = trainings.pictures
    screen.facts["python"] = statistics.median(screen.module("addon.live.viewport").viewport.seconds)
    screen.facts["viewport error"] = screen.module("addon.live.viewport").viewport.error
    bpy.ops.fieldwork.cancel()
    yield from screen.wait(lambda: screen.queue.current is None, 60, "the training does not end")
    yield 2.0
    screen.facts["left"] = [len(trainings.views), (Path(settings.project) / "jobs/live/views.json").exists()]


def overlays(screen):
    """Where a version of Blender needs overlays to draw a field, a viewport without them says so."""
    screen.module("addon.live.hint").NEEDS_OVERLAYS = True
    yield from ball(screen)
    yield from settled(screen)
    screen.facts["places"] = {name: place(screen, point) for name, point in POINTS.items()}
    screen.shot("shown")
    screen.area.spaces.active.overlay.show_overlays = False
    yield 1.0
    screen.shot("overlays-off")
    header = next(region for region in screen.area.regions if region.type == "HEADER")
    screen.facts["header"] = [header.x, 1080 - header.y - header.height, header.width, header.height]


def endurance(screen):
    """200 sizes of the viewport and 50 undos: what is kept, and what memory it takes."""
    bpy.context.preferences.edit.undo_steps = 64  # Blender keeps 32 otherwise, and fifty are taken back
    bpy.context.preferences.system.use_region_overlap = False  # else the view stays as large below the sidebar
    yield from ball(screen)
    space = screen.area.spaces.active
    drawn = yield from settled(screen)

    def memory():
        # What is used and what of it is textures cannot be told apart with software OpenGL: all of it counts.
        line = next(line for line in Path("/proc/self/status").read_text().splitlines() if line.startswith("VmRSS"))
        return int(line.split()[1]) / 1024

    widths = []

    def resize(times):
        for number in range(times):
            space.show_region_ui = not space.show_region_ui
            space.show_region_toolbar = number % 3 == 0
            yield 0.0
            bpy.ops.wm.redraw_timer(type="DRAW_WIN", iterations=1)
            widths.append(screen.view.width)

    def undo(times):
        for _ in range(times):
            next(o for o in bpy.data.objects if o.fieldwork.is_field).location.x += 0.02
            bpy.ops.ed.undo_push(message="moved")
            yield 0.02
        for _ in range(times):
            bpy.ops.ed.undo()
            bpy.ops.wm.redraw_timer(type="DRAW_WIN", iterations=1)
            yield 0.02

    bpy.ops.ed.undo_push(message="field")
    yield from resize(40)
    yield from undo(10)
    begin = memory()
    yield from resize(200)
    resized = memory()
    yield from undo(50)
    space.show_region_ui, space.show_region_toolbar = False, True
    yield 0.5
    yield from settled(screen)
    screen.facts["memory"] = [begin, resized, memory()]
    screen.facts["changes"] = sum(one != other for one, other in zip(widths, widths[1:]))
    screen.facts["widths"] = sorted(set(widths))
    screen.facts["moved"] = next(o for o in bpy.data.objects if o.fieldwork.is_field).location.x
    screen.facts["kept"] = [len(drawn.views), len(drawn.assets)]
    screen.facts["viewport error"] = drawn.error
    screen.facts["places"] = {name: place(screen, point) for name, point in POINTS.items()}
    screen.facts["points"] = POINTS
    screen.shot("after")
