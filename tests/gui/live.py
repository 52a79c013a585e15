"""The field in the viewport and rendered in the window. Each function is a generator over a `Screen` (see driver.py)."""

from __future__ import annotations

import math
import os
import signal
import statistics
import time
from pathlib import Path

import bpy
import numpy as np
from bpy_extras.view3d_utils import location_3d_to_region_2d
from mathutils import Matrix, Quaternion, Vector
from steps import alias

SIDE = Quaternion((1, 0, 0), math.pi / 2)  # looks along y, z is up


def ball(screen, sidebar=False):
    """A scene with the ball's field, a cube before it and a large one behind it."""
    settings = bpy.context.scene.fieldwork
    settings.project = alias(Path(os.environ["FIELDWORK_BALL"]), "ball")
    for obj in list(bpy.data.objects):
        if obj.type == "MESH":
            bpy.data.objects.remove(obj)
    for name, size, place in (("front", 0.24, (-0.2, -0.9, 0.15)), ("back", 1.4, (0, 1.6, 0))):
        bpy.ops.mesh.primitive_cube_add(size=size, location=place)
        bpy.context.object.name = name
    bpy.ops.object.select_all(action="DESELECT")
    bpy.ops.fieldwork.add_field()
    screen.area.spaces.active.show_region_ui = sidebar
    yield 0.3
    look(screen)


def look(screen):
    space = screen.area.spaces.active.region_3d
    space.view_perspective, space.view_rotation = "PERSP", SIDE
    space.view_location, space.view_distance = (0, 0, 0), 3.0
    space.update()


def place(screen, point):
    """Where a point of the scene is in a screenshot."""
    view = screen.view
    x, y = location_3d_to_region_2d(view, screen.area.spaces.active.region_3d, Vector(point))
    return [round(view.x + x), 1080 - 1 - round(view.y + y)]


def settled(screen, seconds=120):
    """Wait until the picture is as fine as it gets."""
    viewport = screen.module("addon.live.viewport").viewport
    screen.area.tag_redraw()
    yield 0.3

    def fine():
        assert not viewport.error, viewport.error
        return viewport.views and all(view.refined for view in viewport.views.values())

    yield from screen.wait(fine, seconds, "the field is not drawn to its end")
    return viewport


def viewport(screen):
    """The field among cubes in each shading mode; its classes, crop box, transform; frame times."""
    yield from ball(screen)
    drawn = yield from settled(screen)
    points = {
        "field": (0.2, -0.45, 0.1), "low": (0.1, -0.46, -0.2), "front": (-0.2, -1.02, 0.15), "back": (0.6, 0.9, 0.55),
        "top": (0.15, -0.42, 0.25), "grid": (0, 0, -1.1),
    }  # fmt: skip
    screen.facts["points"] = points
    screen.facts["places"] = {name: place(screen, point) for name, point in points.items()}
    space = screen.area.spaces.active

    def shaded(name, seconds):
        yield seconds
        screen.shot(name)
        space.overlay.show_overlays = False
        yield 2.0
        screen.shot(f"{name}-no-overlays")
        # The cube in front away: at first the object, then its vertices alone.
        front = bpy.data.objects["front"]
        if name == "eevee":
            front.location.z += 5
            yield 2.0
            screen.shot("object-away")
            front.location.z -= 5
        if name == "cycles":
            front.data.transform(Matrix.Translation((0, 0, 5)))
            front.data.update()
            yield 4.0
            screen.shot("vertices-away")
            front.data.transform(Matrix.Translation((0, 0, -5)))
            front.data.update()
        space.overlay.show_overlays = True

    yield from shaded("solid", 0.1)
    space.shading.type = "MATERIAL"
    yield from shaded("material", 35.0)  # software OpenGL compiles EEVEE's shaders
    space.shading.type = "RENDERED"
    assert "EEVEE" in bpy.context.scene.render.engine
    yield from shaded("eevee", 10.0)
    bpy.context.scene.render.engine = "CYCLES"
    bpy.context.scene.cycles.use_denoising = False
    bpy.context.scene.cycles.preview_samples = 1
    yield from shaded("cycles", 6.0)
    bpy.context.scene.render.engine = "FIELDWORK"
    yield 2.0
    screen.shot("fieldwork")
    space.shading.type = "SOLID"

    own = next(obj for obj in bpy.data.objects if obj.fieldwork.is_field).fieldwork
    own.classes[0].visible = False
    yield 0.5
    yield from settled(screen)
    screen.shot("hidden")
    own.classes[0].visible = True
    own.look = 1.0
    yield from settled(screen)
    screen.shot("labels")
    own.look = 2.0
    yield from settled(screen)
    screen.shot("confidence")
    own.look = 0.0
    own.classes[1].tint, own.classes[1].color = 1.0, (0.0, 1.0, 0.0)
    yield from settled(screen)
    screen.shot("tinted")
    own.classes[1].tint = 0.0
    bpy.ops.fieldwork.add_crop_box()
    own.crop.location = (0, 0, -1)
    yield from settled(screen)
    screen.shot("cropped")
    own.crop = None
    field = own.id_data
    field.rotation_euler = (math.pi, 0, 0)  # upside down
    own.look = 1.0
    yield from settled(screen)
    screen.shot("turned")
    own.look, field.rotation_euler = 0.0, (0, 0, 0)
    copy = field.copy()
    bpy.context.scene.collection.objects.link(copy)
    copy.location = (0, 0, 1.05)
    yield from settled(screen)
    screen.shot("two")
    screen.facts["assets"] = len(drawn.assets)
    bpy.data.objects.remove(copy)

    # While the view moves.
    drawn.seconds.clear()
    moving = []
    for turn in range(20):
        space.region_3d.view_rotation = Quaternion((0, 0, 1), 0.05 * turn) @ SIDE
        begin = time.perf_counter()
        bpy.ops.wm.redraw_timer(type="DRAW_WIN", iterations=1)
        moving.append(time.perf_counter() - begin)
        yield 0.0
    screen.facts["moving"] = [statistics.median(moving), statistics.median(drawn.frame_seconds[-20:])]
    space.overlay.show_overlays = True
    look(screen)
    yield from settled(screen)
    drawn.seconds.clear()
    for _ in range(30):
        bpy.ops.wm.redraw_timer(type="DRAW_WIN", iterations=1)
    screen.facts["python"] = statistics.median(drawn.seconds)
    begin = time.perf_counter()
    own.look = 0.01
    yield from settled(screen)
    screen.facts["refined after"] = time.perf_counter() - begin
    screen.facts["size"] = [screen.view.width, screen.view.height]

    # Regions change their size, and edits are undone.
    own.look = 0.0
    bpy.ops.ed.undo_push(message="field")
    for _ in range(20):
        space.show_region_ui = not space.show_region_ui
        bpy.ops.wm.redraw_timer(type="DRAW_WIN", iterations=1)
    for _ in range(10):
        next(o for o in bpy.data.objects if o.fieldwork.is_field).location.x += 0.1
        bpy.ops.ed.undo_push(message="moved")
        yield 0.05
    for _ in range(10):
        bpy.ops.ed.undo()
        bpy.ops.wm.redraw_timer(type="DRAW_WIN", iterations=1)
        yield 0.05
    space.show_region_ui = False
    yield 0.5
    yield from settled(screen)
    screen.shot("undone")
    screen.facts["error"] = ""
    screen.facts["viewport error"] = drawn.error
    screen.facts["kept"] = [len(drawn.views), len(drawn.assets)]
    yield 0.5


def speed(screen):
    """Frames a second of the march of the viewport at three sizes, as the view has them: colour, depth and classes."""
    yield from ball(screen)
    for name in ("front", "back"):
        bpy.data.objects.remove(bpy.data.objects[name])
    if "FIELDWORK_INSIDE" in os.environ:  # seen from within, as photos of a room are
        region = screen.area.spaces.active.region_3d
        region.view_location, region.view_distance = (0, 0, 1), 1.5
        region.update()
    drawn, asked = screen.module("addon.live.viewport").viewport, []
    march = drawn._march_rows

    def listening(picture, *arguments):
        asked[:] = arguments[:-1]
        return march(picture, *arguments)

    drawn._march_rows = listening
    yield from settled(screen, 300)
    module, found = screen.module("addon.live.viewport"), {}

    def measure():
        for name, size in (("400", (400, 400)), ("800", (800, 800)), ("1080", (1920, 1080))):
            times = []
            for _ in range(4):
                picture = module.Picture(*size)
                times.append(march(picture, *asked, size[1]))
            pixels = picture.buffer.read_color(0, 0, *size, 4, 0, "FLOAT")
            pixels.dimensions = math.prod(size) * 4  # Blender 4.3 tells wrong strides of more than one
            found[name] = [1 / statistics.median(times[1:]), float(np.asarray(pixels)[3::4].mean())]

    # Only while a view is drawn is its context the card's.
    handle = bpy.types.SpaceView3D.draw_handler_add(lambda: found or measure(), (), "WINDOW", "POST_VIEW")
    screen.area.tag_redraw()
    yield from screen.wait(lambda: len(found) == 3, 120, "nothing is measured")
    bpy.types.SpaceView3D.draw_handler_remove(handle, "WINDOW")
    screen.facts["frames"] = found
    screen.facts["viewport error"] = drawn.error
    screen.shot("speed")


def things(screen):
    """Single things of the field hidden, tinted, dimmed, moved and copied in the viewport; the panel."""
    yield from ball(screen)
    bpy.data.objects.remove(bpy.data.objects["front"])
    field = next(obj for obj in bpy.data.objects if obj.fieldwork.is_field)
    own, answers = field.fieldwork, screen.module("addon.live.thing_texels").answers
    drawn = yield from settled(screen)
    screen.shot("plain")
    points = {
        "left": (-0.25, -0.35, 0.25), "right": (0.25, -0.35, 0.25), "low": (0.1, -0.46, -0.2),
        "moved": (0.65, -0.35, 0.25), "copied": (0.1, -0.35, 0.8),
    }  # fmt: skip
    screen.facts["points"] = points
    screen.facts["places"] = {name: place(screen, point) for name, point in points.items()}
    begin = time.perf_counter()
    own.things["left"].visible = False
    yield 0.3
    yield from screen.wait(lambda: not answers.waiting, 60, "the things are not told apart")
    screen.facts["told after"] = time.perf_counter() - begin
    assert not any(known.error for known in answers._known.values()), [k.error for k in answers._known.values()]
    yield from settled(screen)
    screen.shot("hidden")
    # From now on at the next redraw, before the picture becomes fine.
    own.things["left"].visible = True
    own.things["right"].tint, own.things["right"].color = 1.0, (0.0, 1.0, 0.0)
    screen.shot("tinted")
    own.look = 1.0
    screen.shot("labels")
    own.look = 0.0
    own.things["right"].opacity = 0.005  # a sharp field stays opaque by less
    screen.shot("dimmed")
    own.things["right"].opacity = 1.0
    bpy.ops.fieldwork.place_thing(thing="left")
    moved = next(obj for obj in bpy.data.objects if obj.fieldwork_copy.thing == "left")
    moved.location.x += 0.9
    bpy.ops.fieldwork.place_thing(thing="right", copy=True)
    copy = next(obj for obj in bpy.data.objects if obj.fieldwork_copy.thing == "right")
    copy.location.x, copy.location.z = copy.location.x - 0.15, copy.location.z + 0.55
    bpy.context.view_layer.update()
    screen.shot("elsewhere at once")
    yield from settled(screen)
    screen.shot("elsewhere")
    drawn.seconds.clear()
    for _ in range(30):
        bpy.ops.wm.redraw_timer(type="DRAW_WIN", iterations=1)
    screen.facts["python"] = statistics.median(drawn.seconds)
    drawn.frame_seconds.clear()
    space = screen.area.spaces.active.region_3d
    for turn in range(10):
        space.view_rotation = Quaternion((0, 0, 1), 0.05 * turn) @ SIDE
        bpy.ops.wm.redraw_timer(type="DRAW_WIN", iterations=1)
    screen.facts["moving"] = statistics.median(drawn.frame_seconds)
    look(screen)
    yield from settled(screen)
    copy.hide_set(True)
    yield from settled(screen)
    screen.shot("hidden copy")
    screen.facts["viewport error"] = drawn.error
    copy.hide_set(False)
    screen.area.spaces.active.show_region_ui = True
    yield from screen.show_sidebar()
    yield from screen.toggle("live")
    yield 1.0
    screen.shot("panel")


def live_panel(screen):
    """The Live View panel and the properties of the render engine."""
    yield from ball(screen, sidebar=True)
    yield from screen.show_sidebar()
    bpy.context.scene.render.engine = "FIELDWORK"
    yield from settled(screen)
    yield from screen.toggle("live")
    yield 1.0
    screen.shot("panel")
    properties = next(area for area in screen.window.screen.areas if area.type == "PROPERTIES")
    properties.spaces.active.context = "RENDER"
    yield 1.0
    screen.shot("engine")
    properties.spaces.active.context = "VIEW_LAYER"
    yield 1.0
    screen.shot("passes")


def rendering(screen):
    """F12 in the window: a picture, a cancel with escape, an engine that is killed, an animation."""
    yield from ball(screen)
    scene = bpy.context.scene
    scene.render.engine = "FIELDWORK"
    scene.render.resolution_x, scene.render.resolution_y = 240, 160
    scene.render.film_transparent = False
    scene.camera.location, scene.camera.rotation_euler = (0, -2, 0), (math.pi / 2, 0, 0)
    scene.view_settings.view_transform = "Standard"
    live, engine = scene.fieldwork_live, screen.module("addon.live.engine")
    live.source, live.samples = "baked", 4
    running = lambda: bpy.app.is_job_running("RENDER")  # noqa: E731

    def start():
        bpy.ops.render.render("INVOKE_DEFAULT")
        yield from screen.wait(running, 10, "the render does not start")

    def saved(name):
        path = screen.folder / f"{name}.png"
        bpy.data.images["Render Result"].save_render(str(path))
        return str(path)

    yield from start()
    yield from screen.wait(lambda: not running(), 90, "the render does not end")
    yield 1.0
    screen.shot("rendered")
    saved("picture")
    live.source, live.samples = "field", 4096
    yield from start()
    yield 10.0
    assert running()
    screen.shot("progress")
    # Escape itself comes from the window system, which is not heard while events are simulated; the cross beside the bar
    # does the same.
    screen.shot("cross")
    for x in range(1060, 1100, 6):
        if running():
            screen.move(x, 11)
            yield 0.2
            begin = time.monotonic()
            screen.press("LEFTMOUSE", x, 11)
            yield 0.3
    yield from screen.wait(lambda: not running(), 5, "the cross")
    screen.facts["cancel"] = time.monotonic() - begin
    yield 0.5
    bpy.ops.render.render("INVOKE_DEFAULT")
    yield 6.0
    assert running()
    begin = time.monotonic()
    os.kill(engine.frames().process.pid, signal.SIGKILL)
    yield from screen.wait(lambda: not running(), 20, "the death was not noticed")
    screen.facts["death"] = time.monotonic() - begin
    yield 1.0
    screen.shot("died")
    live.source, live.samples = "baked", 1
    scene.render.resolution_x, scene.render.resolution_y = 120, 80
    scene.frame_start, scene.frame_end = 1, 5
    scene.render.filepath = str(screen.folder / "frame_")
    bpy.ops.render.render("INVOKE_DEFAULT", animation=True)
    yield from screen.wait(running, 10, "the animation does not start")
    yield from screen.wait(lambda: not running(), 120, "the animation does not end")
    screen.facts["frames"] = len(list(Path(screen.folder).glob("frame_*.png")))
    yield 0.5
