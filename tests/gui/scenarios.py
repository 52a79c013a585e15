"""What happens in the window. Each function is a generator over a `Screen` (see driver.py)."""

from __future__ import annotations

import os
import signal
import time
from pathlib import Path

import bpy
from steps import PHOTOS, alias, drop, every_panel, faces, finish, opened, training


def capture(screen):
    """Drop a photo onto the viewport, read the photos, estimate poses: by the mouse alone. Every panel on the way."""
    yield from screen.show_sidebar()
    screen.shot("empty")
    settings = bpy.context.scene.fieldwork
    for _ in range(6):  # a machine under load may miss the start of a drag
        if not settings.photos:
            yield from drop(screen, PHOTOS)
    screen.facts["dropped"] = [settings.photos, settings.project]
    # Beside the photos may not be written here; short names keep the machine's folders out of the pictures.
    settings.photos = alias(PHOTOS, "banana")
    settings.project = alias(screen.folder / "project", "banana_fieldwork")
    settings.max_size = 480
    bpy.data.objects.remove(bpy.data.objects["Cube"])
    screen.shot("dropped")
    yield from screen.press_button("fieldwork.new")
    yield from screen.wait(lambda: screen.queue.running, 5, "the button did nothing")
    yield 1.0
    screen.shot("reading")
    yield from screen.idle(90)
    yield from screen.press_button("fieldwork.poses")
    yield from screen.wait(lambda: screen.queue.running, 5, "the button did nothing")
    yield from screen.wait(lambda: screen.queue.running is None or screen.queue.running.fraction, 60, "progress")
    yield 1.0
    screen.shot("posing")
    yield from screen.idle(300)
    placed = sum(image.status == "ok" for image in settings.images)
    screen.facts["placed"] = [placed, len(settings.images)]
    yield from every_panel(screen, "posed")
    yield from screen.run_operator("fieldwork.import_scene", 120)
    bpy.ops.object.select_all(action="DESELECT")
    for obj in bpy.data.objects:
        obj.select_set(obj.get("fieldwork_role", "").startswith(("camera", "points")))
    with bpy.context.temp_override(window=screen.window, area=screen.area, region=screen.view):
        bpy.ops.view3d.view_selected()
    bpy.ops.object.select_all(action="DESELECT")
    yield 1.0
    screen.shot("scene")
    screen.facts["cameras"] = sum(obj.type == "CAMERA" for obj in bpy.data.objects)
    # Once more: nothing may pile up.
    yield from screen.run_operator("fieldwork.import_scene", 120)
    screen.facts["cameras again"] = sum(obj.type == "CAMERA" for obj in bpy.data.objects)
    yield from finish(screen)


def train(screen):
    """Train the posed capture for some seconds, look at the live panel, extract the mesh, bring it into the scene."""
    settings = yield from opened(screen)
    bpy.data.objects.remove(bpy.data.objects["Cube"])
    settings.preset, settings.time_limit = "draft", 40.0
    yield from screen.press_button("fieldwork.train")
    yield from screen.wait(lambda: screen.queue.running, 5, "the button did nothing")
    yield from screen.wait(lambda: screen.queue.running and len(screen.queue.running.curve) > 12, 120, "the curve")
    yield from screen.toggle("train")
    yield 1.0
    screen.shot("training")
    yield from screen.idle(200)
    screen.facts["curve"] = len(screen.queue.last.curve)
    screen.facts["preview"] = bool(screen.queue.last.preview)
    yield 0.5
    screen.shot("trained")
    yield from screen.toggle("train")
    settings.resolution = 96
    yield from screen.press_button("fieldwork.mesh")
    yield from screen.wait(lambda: screen.queue.running, 5, "the button did nothing")
    yield from screen.idle(200)
    yield from screen.run_operator("fieldwork.import_scene", 120)
    meshes = [obj for obj in bpy.data.objects if obj.get("fieldwork_role") == "mesh"]
    screen.facts["faces"] = [len(obj.data.polygons) for obj in meshes]
    yield 1.0
    screen.shot("scene")
    yield from every_panel(screen, "trained")
    yield from finish(screen)


def labelled(screen):
    """A capture with labels, in a light theme and at high resolution too: classes, renders, visibility, presets."""
    yield from screen.show_sidebar()
    settings = bpy.context.scene.fieldwork
    bpy.ops.fieldwork.open(filepath=alias(Path(os.environ["FIELDWORK_MUSEUM"]), "museum"))
    settings.project = alias(screen.folder / "project", "museum_fieldwork")
    yield from screen.run_operator("fieldwork.new", 120)
    yield from screen.run_operator("fieldwork.poses", 600)
    settings.preset, settings.time_limit = "draft", 60.0
    yield from screen.run_operator("fieldwork.train", 600)
    yield from screen.run_operator("fieldwork.evaluate", 600)
    settings.resolution = 128
    yield from screen.run_operator("fieldwork.mesh", 600)
    for obj in list(bpy.data.objects):
        bpy.data.objects.remove(obj)
    yield from screen.run_operator("fieldwork.import_scene", 120)
    settings.show_as = "background"
    yield from screen.run_operator("fieldwork.render", 600)
    screen.facts["background"] = [s.image.name for s in bpy.context.scene.camera.data.background_images]
    screen.facts["classes"] = [[c.name, c.area] for c in settings.classes]
    settings.export_to = "glb"
    yield from screen.run_operator("fieldwork.export", 120)
    # Looked at here: this Blender has a /tmp of its own.
    screen.facts["exported"] = [Path(p).read_bytes()[:4].decode() for p in screen.queue.last.result["files"]]
    space = screen.area.spaces.active
    space.region_3d.view_perspective = "CAMERA"
    yield from screen.toggle("classes")
    yield 1.0
    screen.shot("classes")
    mesh = next(obj for obj in bpy.data.objects if obj.get("fieldwork_role") == "mesh")
    whole = faces(mesh)
    largest = max(settings.classes, key=lambda c: c.area)
    largest.visible = False
    yield 1.0
    screen.facts["hidden"] = [largest.name, whole, faces(mesh)]
    space.region_3d.view_perspective = "PERSP"
    yield 0.5
    screen.shot("hidden")
    largest.visible = True
    yield from screen.toggle("classes")

    # The user's own presets.
    settings.time_limit, settings.steps = 77.0, 5
    bpy.ops.fieldwork.train_preset_add(name="Quick Look")
    settings.time_limit, settings.steps = 0.0, 0
    folder = next(path for path in bpy.utils.preset_paths("fieldwork/train"))
    preset = next(Path(folder).glob("*.py"))
    bpy.ops.script.execute_preset(filepath=str(preset), menu_idname="FIELDWORK_PT_train_presets")
    screen.facts["preset"] = [preset.name, settings.time_limit, settings.steps]
    yield from every_panel(screen, "labelled")

    theme = next(Path(path) / "Blender_Light.xml" for path in bpy.utils.preset_paths("interface_theme"))
    bpy.ops.script.execute_preset(filepath=str(theme), menu_idname="USERPREF_MT_interface_theme_presets")
    yield from screen.toggle("train")
    yield 1.0
    screen.shot("light")
    yield from screen.toggle("train")
    bpy.context.preferences.view.ui_scale = 1.6
    yield 1.0
    yield from screen.toggle("train")
    yield 1.0
    screen.shot("large")
    yield from finish(screen)


def interruptions(screen):
    """Cancel, kill the engine, undo and load another file, each in the middle of a training."""
    settings = yield from opened(screen)
    settings.preset, settings.time_limit, settings.run = "draft", 600.0, "interrupted"
    project = settings.project
    bpy.ops.ed.undo_push(message="settings")

    # Undo, then pause with the button.
    yield from training(screen, "fieldwork.train")
    bpy.ops.mesh.primitive_cube_add()
    bpy.ops.ed.undo_push(message="cube")
    bpy.ops.ed.undo()
    yield 1.0
    assert screen.queue.running is not None, "undo broke the job"
    assert bpy.context.scene.fieldwork.project == project
    yield from screen.press_button("fieldwork.cancel")
    yield from screen.wait(lambda: screen.queue.running is None, 10, "cancel")
    screen.facts["cancel"] = time.monotonic() - screen.clicked
    assert screen.queue.last.state == "cancelled", screen.queue.last.error
    yield from screen.toggle("train")
    yield 0.5
    screen.shot("paused")
    yield from screen.toggle("train")

    # The engine is killed.
    yield from training(screen, "fieldwork.train", resume=True)
    first = screen.queue.running.curve[0][0]
    screen.facts["resumed at"] = first
    os.kill(screen.queue.link.process.pid, signal.SIGKILL)
    yield from screen.wait(lambda: screen.queue.running is None, 10, "the death was not noticed")
    screen.facts["death"] = screen.queue.last.error.message
    yield 0.5
    screen.shot("died")
    yield from screen.press_button("fieldwork.copy_report")
    screen.facts["report"] = bpy.context.window_manager.clipboard
    yield from screen.press_button("fieldwork.dismiss")

    # Another file is loaded.
    yield from training(screen, "fieldwork.train", resume=True)
    bpy.ops.wm.read_homefile(app_template="")
    yield 2.0
    assert screen.queue.running is not None, "loading a file broke the job"
    points = len(screen.queue.running.curve)
    yield 3.0
    assert len(screen.queue.running.curve) > points, "the job is not followed any more"
    yield from screen.show_sidebar()
    screen.shot("other-file")

    # Go on without Blender, follow from the files, stop it from there.
    bpy.ops.fieldwork.detach()
    bpy.context.scene.fieldwork.project = project
    yield from screen.wait(lambda: screen.queue.followed, 5, "the job is not followed")
    yield from screen.wait(lambda: screen.queue.followed.curve, 20, "no curve from the files")
    screen.shot("detached")
    begin = time.monotonic()
    screen.queue.cancel()
    yield from screen.wait(lambda: screen.queue.followed is None, 10, "cancel from outside")
    screen.facts["cancel detached"] = time.monotonic() - begin
    yield from finish(screen)


def preferences(screen):
    """The preferences: without an engine, while it is installed, after a failure."""
    machine = screen.module("addon.machine")
    yield from screen.show_sidebar()
    os.environ.pop("FIELDWORK_ENGINE_PYTHON", None)
    screen.shot("no-engine")
    chosen = machine.preferences()
    bpy.ops.screen.userpref_show("INVOKE_DEFAULT")
    yield 0.5
    bpy.ops.fieldwork.open_preferences()
    yield 1.0
    screen.shot("preferences")
    chosen.wheels, chosen.base_python, chosen.device = str(screen.folder), os.environ["FIELDWORK_BASE_PYTHON"], "cpu"
    bpy.ops.fieldwork.engine_install()
    yield 1.0
    screen.shot("installing")
    yield from screen.wait(lambda: not screen.queue.installer.is_alive(), 120, "installing")
    screen.facts["failure"] = screen.queue.installer.error
    yield 0.5
    screen.shot("failed")
    yield from finish(screen)
