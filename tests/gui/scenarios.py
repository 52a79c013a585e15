"""What happens in the window. Each function is a generator over a `Screen` (see driver.py)."""

from __future__ import annotations

import os
import signal
import time
from pathlib import Path

import bpy

DATA = Path(__file__).resolve().parents[3] / "shared" / "data"
PHOTOS = DATA / "banana" / "images"


def capture(screen):
    """Drop a photo onto the viewport, read the photos, estimate poses: by the mouse alone. Every panel on the way."""
    yield from screen.show_sidebar()
    screen.shot("empty")
    settings = bpy.context.scene.fieldwork
    for _ in range(3):  # a machine under load may miss the start of a drag
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
    bpy.ops.script.execute_preset(filepath=str(preset), menu_idname="FIELDWORK_MT_train_presets")
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


def faces(obj):
    return len(obj.evaluated_get(bpy.context.evaluated_depsgraph_get()).data.polygons)


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
    jobs = screen.module("addon.jobs")
    prefs = screen.module("addon.preferences")
    yield from screen.show_sidebar()
    os.environ.pop("FIELDWORK_ENGINE_PYTHON", None)
    screen.shot("no-engine")
    chosen = prefs.preferences()
    bpy.ops.screen.userpref_show("INVOKE_DEFAULT")
    yield 0.5
    bpy.ops.fieldwork.open_preferences()
    yield 1.0
    screen.shot("preferences")
    chosen.wheels, chosen.base_python, chosen.device = str(screen.folder), os.environ["FIELDWORK_BASE_PYTHON"], "cpu"
    bpy.ops.fieldwork.engine_install()
    yield 1.0
    screen.shot("installing")
    yield from screen.wait(lambda: not jobs.queue.installer.is_alive(), 120, "installing")
    screen.facts["failure"] = jobs.queue.installer.error
    yield 0.5
    screen.shot("failed")
    yield from finish(screen)


def every_panel(screen, name):
    """Open the sub-panels one by one."""
    for panel in ("capture", "poses", "classes", "train", "render", "mesh", "export", "engine"):
        yield from screen.toggle(panel)
        yield 0.4
        screen.shot(f"{name}-{panel}")
        yield from screen.toggle(panel)


def opened(screen):
    """A copy of the posed capture that the scenario `capture` left."""
    import shutil

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
    link.symlink_to(folder)
    return str(link)


def training(screen, operator, resume=False):
    bpy.ops.fieldwork.train(resume=resume)
    yield from screen.wait(
        lambda: screen.queue.running is None or len(screen.queue.running.curve) > 1, 120, "training does not start"
    )
    assert screen.queue.running is not None, screen.queue.last.error


def drop(screen, folder):
    """Drag a photo from a file browser onto the viewport."""
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
    # Blender itself can make an image of the photo: a menu asks, with our entry under the mouse.
    screen.shot("drop-menu")
    screen.press("RET", *target)
    yield 0.5
    browser.type = "PROPERTIES"
    yield 0.5


def finish(screen):
    """What every scenario promises."""
    screen.facts["slowest_tick"] = screen.queue.slowest_tick
    screen.facts["slowest_result"] = screen.queue.slowest_result
    yield 0.1
