"""What the panels show and do, one thing after the other, on the simulated capture. Each function is a generator over a
`Screen` (see driver.py)."""

from __future__ import annotations

import os
from pathlib import Path

import bpy
from sessions import open_from_the_start
from steps import PHOTOS, alias, close_browser, drag_photo, every_panel, finish


def image_editors(screen):
    return [a for w in bpy.context.window_manager.windows for a in w.screen.areas if a.ui_type == "IMAGE_EDITOR"]


def panels(screen):
    """From an empty scene: the drop, the one button, headers, locked fields, rows, the measured line, pictures."""
    settings = bpy.context.scene.fieldwork
    # Without Fieldwork's tab a dropped picture is Blender's, and nothing asks.
    yield from drag_photo(screen, PHOTOS)
    screen.shot("drop-without-tab")
    yield from close_browser(screen)
    screen.facts["without tab"] = [settings.photos, sum(obj.type == "EMPTY" for obj in bpy.data.objects)]
    for obj in list(bpy.data.objects):
        bpy.data.objects.remove(obj)
    yield from screen.show_sidebar()
    screen.shot("nothing")
    museum = alias(Path(os.environ["FIELDWORK_MUSEUM"]), "museum")
    bpy.ops.fieldwork.open(filepath=museum)
    settings.project = alias(screen.folder / "project", "museum_fieldwork")
    settings.preset, settings.time_limit, settings.texture = "draft", 60.0, "0"
    yield from screen.run_operator("fieldwork.doctor", 60)
    yield 0.5
    screen.shot("one-button")
    yield from screen.press_button("fieldwork.reconstruct")
    yield from screen.wait(lambda: screen.queue.running, 5, "the button did nothing")
    yield from screen.wait(
        lambda: screen.queue.running is None or len(screen.queue.running.curve) > 5, 400, "no training"
    )
    yield from screen.toggle("train")
    yield 1.0
    screen.shot("locked")
    yield from screen.toggle("train")
    yield from screen.wait(lambda: screen.queue.current is None, 900, "the reconstruction does not end")
    assert screen.queue.last.state == "done", screen.queue.last.report()
    yield 1.0
    screen.shot("reconstructed")
    screen.facts["verbs"] = [job.verb for job in screen.queue.finished]
    screen.facts["meshes"] = sum(obj.get("fieldwork_role") == "mesh" for obj in bpy.data.objects)
    yield from every_panel(screen, "all")
    yield from finish(screen)


def documents(screen):
    """What was reconstructed is looked at, rendered, measured and drawn; a new file finds it again."""
    open_from_the_start(bpy.types.FIELDWORK_PT_align)
    settings = bpy.context.scene.fieldwork
    for obj in list(bpy.data.objects):
        bpy.data.objects.remove(obj)
    yield from screen.show_sidebar()
    settings.project = alias(screen.folder / "project", "museum_fieldwork")
    yield from screen.run_operator("fieldwork.import_scene", 120)
    yield from rows_and_line(screen, settings)
    yield from pictures(screen, settings)
    yield from recent(screen)
    yield from finish(screen)


def rows_and_line(screen, settings):
    """A click on a row looks through that camera; A and B stand in the viewport."""
    names = [image.name for image in settings.images]
    yield from screen.toggle("poses")
    yield 0.5
    settings.pose_index = 5
    yield 0.5
    screen.shot("looked-through")
    view = screen.area.spaces.active.region_3d
    screen.facts["looked through"] = [bpy.context.scene.camera.name, names[5], view.view_perspective]
    yield from screen.toggle("poses")
    view.view_perspective = "PERSP"
    bpy.ops.object.select_all(action="DESELECT")
    next(obj for obj in bpy.data.objects if obj.get("fieldwork_role") == "mesh").select_set(True)
    settings.point_a, settings.point_b = (-1.0, 0.0, 0.5), (1.2, 0.3, 1.1)
    with bpy.context.temp_override(window=screen.window, area=screen.area, region=screen.view):
        bpy.ops.view3d.view_selected()
        bpy.ops.view3d.zoom(delta=4)
    yield from screen.toggle("poses")
    yield 1.0
    screen.shot("measured-line")
    yield from screen.toggle("poses")
    settings.point_a = settings.point_b = (0.0, 0.0, 0.0)


def pictures(screen, settings):
    """What was rendered and drawn opens in an image editor."""
    settings.render_from, settings.orbit, settings.size = "orbit", 2, (180, 120)
    screen.facts["editors before"] = len(image_editors(screen))
    yield from screen.run_operator("fieldwork.render", 120)
    yield 1.0
    screen.shot("rendered")
    screen.facts["rendered"] = [a.spaces.active.image.name for a in image_editors(screen) if a.spaces.active.image]
    screen.facts["windows"] = len(bpy.context.window_manager.windows)
    yield from screen.run_operator("fieldwork.measure", 120)
    yield from screen.run_operator("fieldwork.plan", 200)
    yield 1.0
    screen.facts["drawn"] = [a.spaces.active.image.name for a in image_editors(screen) if a.spaces.active.image]
    yield from screen.run_operator("fieldwork.section", 120)
    yield from screen.run_operator("fieldwork.report", 120)
    settings.other_project = settings.project
    yield from screen.run_operator("fieldwork.compare", 200)
    yield 1.0
    screen.shot("drawn")
    yield from screen.toggle("measure")
    yield 0.5
    screen.shot("measured")
    yield from screen.toggle("measure")


def recent(screen):
    """A new file: the project is among those that were open last."""
    bpy.ops.wm.read_homefile(app_template="")
    yield 1.0
    yield from screen.show_sidebar()
    yield 0.5
    screen.shot("recent")
    yield from screen.press_button("fieldwork.open_recent", depth=400)
    yield 0.5
    screen.facts["recent"] = bpy.context.scene.fieldwork.project
    screen.shot("opened")


def preview(screen):
    """The mesh button: a first look comes into the scene, then the mesh in its place."""
    import time

    settings = bpy.context.scene.fieldwork
    for obj in list(bpy.data.objects):
        bpy.data.objects.remove(obj)
    yield from screen.show_sidebar()
    settings.project = os.environ["FIELDWORK_TRAINED"]
    settings.resolution, settings.texture = 160, "0"
    yield from screen.run_operator("fieldwork.doctor", 60)  # the engine runs, as after a training
    roles = lambda: {str(obj.get("fieldwork_role")) for obj in bpy.data.objects}  # noqa: E731
    yield from screen.press_button("fieldwork.mesh")
    begin = time.monotonic()
    yield from screen.wait(lambda: "preview" in roles(), 120, "no first look")
    screen.facts["seconds"] = time.monotonic() - begin
    yield 0.5
    with bpy.context.temp_override(window=screen.window, area=screen.area, region=screen.view):
        bpy.ops.view3d.view_all()
    yield 0.5
    screen.shot("preview")
    screen.facts["preview faces"] = len(next(o for o in bpy.data.objects if "Preview" in o.name).data.polygons)
    yield from screen.idle(600)
    yield 1.0
    screen.shot("mesh")
    screen.facts["roles"] = sorted(role for role in roles() if role in ("mesh", "preview"))
    yield from finish(screen)
