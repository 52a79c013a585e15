"""More of what happens in the window: whole sessions, and the smaller tools."""

from __future__ import annotations

import json
import os
import shutil
from pathlib import Path

import bpy
from mathutils import Vector
from steps import alias, finish, opened

MODULE = "bl_ext.user_default.fieldwork"


def registered():
    """Everything an add-on could have left behind in this Blender."""
    handlers = [getattr(bpy.app.handlers, name) for name in dir(bpy.app.handlers)]
    kinds = (bpy.types.Operator, bpy.types.Panel, bpy.types.Menu, bpy.types.UIList, bpy.types.PropertyGroup)
    classes = [cls for kind in kinds for cls in kind.__subclasses__()]
    return {
        "types": sorted(name for name in dir(bpy.types) if "fieldwork" in name.lower()),
        "classes": sorted(c.__name__ for c in classes if c.__module__.startswith(MODULE) and c.is_registered),
        "operators": dir(bpy.ops.fieldwork),
        "properties": sorted(name for name in dir(bpy.types) if hasattr(getattr(bpy.types, name), "fieldwork")),
        "handlers": sum(len(value) for value in handlers if isinstance(value, list)),
        "status_bar": len(getattr(bpy.types.STATUSBAR_HT_header.draw, "_draw_funcs", [0])),
        "menus": [
            len(getattr(getattr(bpy.types, name).draw, "_draw_funcs", [0]))
            for name in ("VIEW3D_MT_object", "TOPBAR_MT_file_import", "TOPBAR_MT_file_export")
        ],
        "enabled": MODULE in bpy.context.preferences.addons,
    }


def life(screen):
    """Install the archive, enable, a tiny capture to a mesh in the scene, disable, uninstall: nothing is left."""
    screen.facts["blender"] = bpy.app.version_string
    before = registered()
    bpy.ops.extensions.package_install_files(
        filepath=os.environ["FIELDWORK_ZIP"], repo="user_default", enable_on_install=True
    )
    yield 1.0
    screen.facts["registered"] = registered()["types"]
    yield from screen.show_sidebar()
    screen.shot("installed")
    for obj in list(bpy.data.objects):
        bpy.data.objects.remove(obj)
    museum = alias(Path(os.environ["FIELDWORK_MUSEUM"]), "museum")
    bpy.ops.fieldwork.import_dataset(
        directory=f"{museum}/ground_truth", project=alias(screen.folder / "project", "museum_fieldwork")
    )
    yield from screen.idle(120)
    settings = bpy.context.scene.fieldwork
    screen.facts["photos"] = len(settings.images)
    settings.preset, settings.time_limit, settings.resolution = "draft", 20.0, 64
    yield from screen.press_button("fieldwork.train")
    yield from screen.wait(lambda: screen.queue.running, 5, "the button did nothing")
    yield from screen.idle(200)
    screen.shot("trained")
    yield from screen.run_operator("fieldwork.mesh", 200)
    yield from screen.run_operator("fieldwork.import_scene", 120)
    surface = next(obj for obj in bpy.data.objects if obj.get("fieldwork_role") == "mesh")
    screen.facts["faces"] = len(surface.data.polygons)
    yield 1.0
    screen.shot("scene")
    yield from finish(screen)
    tick = screen.module("addon.jobs.timer")._tick
    engine = screen.queue.link.process
    bpy.ops.preferences.addon_disable(module=MODULE)
    yield 0.5
    yield from screen.wait(lambda: engine.poll() is not None, 10, "the engine outlives the extension")
    assert not bpy.app.timers.is_registered(tick)
    after = registered()
    screen.facts["left"] = {key: [before[key], after[key]] for key in before if before[key] != after[key]}
    repos = bpy.context.preferences.extensions.repos
    index = next(i for i, repo in enumerate(repos) if repo.module == "user_default")
    bpy.ops.extensions.package_uninstall(repo_index=index, pkg_id="fieldwork")
    yield 0.5
    screen.facts["files"] = Path(bpy.utils.user_resource("EXTENSIONS"), "user_default", "fieldwork").exists()
    screen.shot("uninstalled")


def open_from_the_start(panel):
    """Let a panel be open when it is first drawn: clicking it open would need its place."""
    bpy.utils.unregister_class(panel)
    panel.bl_options = set()
    bpy.utils.register_class(panel)


def leave(screen):
    """Close Blender in the middle of a training that is to go on."""
    settings = yield from opened(screen)
    screen.module("addon.machine").preferences().on_close = "continue"
    settings.preset, settings.time_limit, settings.run = "draft", 45.0, "second"
    bpy.ops.fieldwork.train()
    yield from screen.wait(lambda: screen.queue.running and len(screen.queue.running.curve) > 2, 120, "the curve")
    screen.shot("left")


def back(screen):
    """A new Blender opens the project: the job is found, followed to its end, and its run can be chosen."""
    settings = bpy.context.scene.fieldwork
    open_from_the_start(bpy.types.FIELDWORK_PT_runs)
    yield from screen.show_sidebar()
    settings.project = alias(screen.folder / "project", "banana_fieldwork")
    followed = screen.queue.followed
    assert followed is not None, "the job was not found"
    screen.facts["followed"] = followed.verb
    yield from screen.wait(lambda: followed.curve, 20, "the curve from the files")
    screen.facts["points"] = len(followed.curve)
    settings.run = "second"
    yield from screen.toggle("train")
    yield 1.0
    screen.shot("reattached")
    yield from screen.wait(lambda: not followed.active, 120, "the end of the job")
    screen.facts["state"] = followed.state
    settings.run = "main"
    yield 1.0
    screen.facts["runs"] = screen.module("addon.project.runs").runs(screen.folder / "project")
    yield from screen.scroll_down(40)  # the runs are the last in the panel
    yield from screen.press_button("fieldwork.use_run", depth=2000)
    screen.facts["used"] = settings.run
    screen.shot("runs")


def tools(screen):
    """Search and menus by the keyboard, picking points, the region box, a data set of the scene, translations."""
    open_from_the_start(bpy.types.FIELDWORK_PT_align)
    settings = yield from opened(screen)
    queue = screen.queue
    bpy.data.objects.remove(bpy.data.objects["Cube"])
    yield from screen.run_operator("fieldwork.import_scene", 120)
    x, y = screen.area.x + screen.area.width * 0.4, screen.area.y + screen.area.height * 0.5

    # Operator search: F3, a few letters, return.
    yield from screen.click(x, y)
    screen.press("F3", x, y)
    yield 0.5
    yield from screen.type("check engine")
    yield 0.5
    screen.shot("search")
    screen.press("RET", x, y)
    yield from screen.wait(lambda: queue.current, 5, "the search")
    screen.facts["searched"] = queue.current.verb
    yield from screen.idle(60)

    # The menu, walked with the arrow keys: five below the first entry comes that of the poses.
    with bpy.context.temp_override(window=screen.window, area=screen.area, region=screen.view):
        bpy.ops.wm.call_menu("INVOKE_DEFAULT", name="FIELDWORK_MT_steps")
    yield 0.5
    for _ in range(5):
        screen.press("DOWN_ARROW", x, y)
        yield 0.2
    screen.shot("menu")
    screen.press("RET", x, y)
    yield from screen.wait(lambda: queue.current, 5, "the menu")
    screen.facts["menu"] = queue.current.verb
    queue.cancel()
    yield from screen.wait(lambda: queue.current is None, 20, "cancel")

    yield from pick(screen, settings)

    # The box of the training region is an object like any other.
    bpy.ops.fieldwork.crop_add()
    region = screen.module("addon.project.region")
    box = region.find(bpy.context.scene)
    box.location, box.scale = (1, 0, 1), (2, 2, 1)
    edits = screen.module("addon.project.edits")
    yield 2.0
    yield from screen.wait(lambda: not edits.waiting(), 30, "the engine does not take the region")
    screen.facts["region"] = region.bounds(screen.folder / "project")
    screen.shot("region")
    bpy.ops.fieldwork.crop_remove()

    yield from data_set(screen)
    yield from translated(screen)
    yield from finish(screen)


def edits(screen):
    """A class is edited, undone, edited without an engine; the project's folder is moved away and found again."""
    project, moved = screen.folder / "vase", screen.folder / "elsewhere"
    for folder in (project, moved):
        shutil.rmtree(folder, ignore_errors=True)
    project.mkdir()
    classes = [
        {"id": 1, "name": "stone", "color": [0.5, 0.5, 0.5], "priority": 1.0},
        {"id": 2, "name": "gold", "color": [1.0, 0.8, 0.0], "priority": 2.0},
    ]
    value = {"format": "fieldwork-project", "version": 2, "uuid": "a" * 32, "created": "", "classes": classes}
    (project / "project.json").write_text(json.dumps(value))
    stored = lambda: json.loads((project / "project.json").read_text())["classes"][0]  # noqa: E731
    under_way = screen.module("addon.project.edits")
    settings = bpy.context.scene.fieldwork
    settings.project = str(project)
    yield from screen.show_sidebar()
    bpy.ops.ed.undo_push(message="project")
    settings.classes[0].priority = 4.0
    bpy.ops.ed.undo_push(message="priority")
    yield from screen.wait(lambda: stored()["priority"] == 4.0, 60, "the engine does not take the edit")
    bpy.ops.ed.undo()
    yield from screen.wait(lambda: stored()["priority"] == 1.0, 30, "undo is no edit")
    screen.facts["undone"] = bpy.context.scene.fieldwork.classes[0].priority

    engine, chosen = os.environ.pop("FIELDWORK_ENGINE_PYTHON"), screen.module("addon.machine").preferences()
    chosen.engine_python = "/nowhere/python"
    bpy.ops.fieldwork.stop_engine()
    bpy.context.scene.fieldwork.classes[0].name = "marble"
    yield from screen.wait(under_way.failed, 30, "nobody misses the engine")
    screen.sidebar.tag_redraw()
    yield 0.5
    screen.shot("unsaved")
    screen.facts["unsaved"] = [str(under_way.failed()[0].error), stored()["name"]]
    os.environ["FIELDWORK_ENGINE_PYTHON"] = engine
    yield from screen.wait(lambda: stored()["name"] == "marble", 60, "the edit was not tried again")
    yield from screen.wait(lambda: not under_way.failed(), 10, "the message stays")
    bpy.context.scene.fieldwork.classes[0].name = "gold"  # there is one already
    yield from screen.wait(under_way.failed, 30, "the engine takes two classes of one name")
    screen.facts["refused"] = str(under_way.failed()[0].error)
    screen.sidebar.tag_redraw()
    yield 0.5
    yield from screen.press_button("fieldwork.discard_edits", depth=600)
    yield from screen.wait(lambda: not under_way.failed(), 10, "the button did nothing")

    project.rename(moved)
    screen.sidebar.tag_redraw()
    yield 0.5
    screen.shot("gone")
    bpy.ops.fieldwork.locate_project(directory=str(moved))
    yield 0.5
    screen.shot("found")
    screen.facts["found"] = [bpy.context.scene.fieldwork.project, bpy.context.scene.fieldwork.classes[0].name]
    yield from finish(screen)


def pick(screen, settings):
    """Click a sparse point; turn the view meanwhile; escape."""
    from bpy_extras.view3d_utils import location_3d_to_region_2d

    region, view = screen.view, screen.area.spaces.active.region_3d
    cloud = next(obj for obj in bpy.data.objects if obj.get("fieldwork_role") == "points")
    start = lambda end: bpy.ops.fieldwork.pick_point("INVOKE_DEFAULT", end=end)  # noqa: E731
    with bpy.context.temp_override(window=screen.window, area=screen.area, region=region):
        start("A")
    yield 0.3
    before = view.view_rotation.copy()
    centre = (region.x + region.width // 2, region.y + region.height // 2)
    screen.move(*centre)
    yield 0.1
    screen.window.event_simulate(type="MIDDLEMOUSE", value="PRESS", x=centre[0], y=centre[1])
    for shift in range(5, 60, 5):
        screen.move(centre[0] + shift, centre[1])
        yield 0.05
    screen.window.event_simulate(type="MIDDLEMOUSE", value="RELEASE", x=centre[0] + 55, y=centre[1])
    yield 0.3
    screen.facts["kept turning"] = view.view_rotation.rotation_difference(before).angle > 0.05
    # The point that is nearest to the viewer, so that none hides it.
    places = [cloud.matrix_world @ vertex.co for vertex in cloud.data.vertices]
    depth = view.perspective_matrix
    seen = [(location_3d_to_region_2d(region, view, place), place) for place in places]
    seen = [
        (at, place) for at, place in seen if at and 100 < at.x < region.width * 0.7 and 60 < at.y < region.height - 60
    ]
    at, place = min(seen, key=lambda entry: (depth @ entry[1].to_4d()).w)
    target = (region.x + round(at.x), region.y + round(at.y))
    screen.move(*target)
    yield 0.2
    screen.shot("picking")
    yield from screen.click(*target)
    screen.facts["picked"] = (Vector(settings.point_a) - place).length
    with bpy.context.temp_override(window=screen.window, area=screen.area, region=region):
        start("B")
    yield 0.2
    screen.press("ESC", *target)
    yield 0.3
    screen.facts["cancelled"] = tuple(settings.point_b) == (0.0, 0.0, 0.0) and not screen.window.modal_operators
    yield from screen.toggle("poses")
    yield 0.5
    screen.shot("align")
    yield from screen.toggle("poses")


def data_set(screen):
    """Photograph the default scene from a hemisphere, straight into a project."""
    bpy.ops.wm.read_homefile(app_template="")
    yield 1.0
    yield from screen.show_sidebar()
    scene = bpy.context.scene
    scene.render.resolution_x, scene.render.resolution_y = 96, 64
    out = Path(alias(screen.folder / "set", "house_dataset"))
    with bpy.context.temp_override(window=screen.window, area=screen.area, region=screen.view):
        bpy.ops.fieldwork.dataset("INVOKE_DEFAULT", out=str(out))
    yield 0.7
    screen.shot("dataset")
    screen.press("ESC", screen.area.x + 300, screen.area.y + 300)
    yield 0.5
    bpy.ops.fieldwork.dataset(out=str(out), views=3, samples=1, labels="object")
    yield from screen.idle(120)
    yield from screen.idle(120)
    screen.facts["photographed"] = len(list((out / "images").glob("*.png")))
    settings = bpy.context.scene.fieldwork
    screen.facts["project images"] = len(settings.images)
    screen.facts["classes"] = [entry.name for entry in settings.classes]
    screen.shot("photographed")


def translated(screen):
    """With a translation in place the interface shows it."""
    text, view = screen.module("addon.text"), bpy.context.preferences.view
    try:
        view.language = "de_DE"
    except TypeError:
        screen.facts["translated"] = "no languages here"
        return
    text.unregister()
    text.TRANSLATIONS["de_DE"] = {
        (text.CONTEXT, "Estimate Poses"): "Posen schätzen",
        (text.CONTEXT, "{} of {} photos placed"): "{} von {} Fotos verortet",
        (text.CONTEXT, "Poses"): "Posen",
    }
    text.register()
    view.use_translate_interface = True
    yield 1.0
    pgettext = bpy.app.translations.pgettext_iface
    screen.facts["translated"] = [pgettext("Estimate Poses", text.CONTEXT), text.t("{} of {} photos placed", 3, 4)]
    screen.shot("translated")
    view.language = "en_US"
