"""The render engine “Fieldwork” without a window: films, borders, many frames, a dead engine, field objects."""

from __future__ import annotations

import pytest
from fieldwork.tests.addon.rendered import START, ball
from fieldwork.tests.addon.support import SETUP

__all__ = ["ball"]

FILMS = (
    START
    + """
whole = passes(shoot())
facts = {"clear": [float(whole["Combined.A"][0, 0]), float(whole["Combined.A"].max())]}
render.film_transparent = False
world = scene.world
for node in world.node_tree.nodes if world.node_tree else []:
    if node.type == "BACKGROUND":
        node.inputs[0].default_value, node.inputs[1].default_value = (0.2, 0.4, 0.6, 1), 0.5
found = passes(shoot())
facts["world"] = [float(found[f"Combined.{c}"][0, 0]) for c in "RGBA"]
facts["solid"] = float(found["Combined.A"].min())
render.film_transparent = True
render.use_border = True
render.border_min_x, render.border_max_x, render.border_min_y, render.border_max_y = 0.25, 0.75, 0.5, 0.9
part = passes(shoot())
facts["border"] = list(part["Combined.A"].shape)
facts["same"] = float(np.abs(part["Combined.A"][8:40, 30:90] - whole["Combined.A"][8:40, 30:90]).max())
facts["outside"] = float(part["Combined.A"][45:].max())
render.use_crop_to_border = True
crop = passes(shoot())
facts["crop"] = list(crop["Combined.A"].shape)
facts["cropped"] = float(np.abs(crop["Combined.A"] - whole["Combined.A"][8:40, 30:90]).max())
render.use_border = False
camera.data.clip_end = 1.0
facts["clipped"] = float(passes(shoot())["Combined.A"].max())
camera.data.clip_end, camera.data.clip_start = 100, 1.7
layer.use_pass_z = True
found = passes(shoot())
facts["near"] = float(found["Depth.Z" if "Depth.Z" in found else "Depth.V"].min())
answer(facts)
"""
)


def test_films_borders_and_clipping(bpy_script, ball, tmp_path):
    facts = bpy_script(FILMS, project=ball, folder=tmp_path)
    assert facts["clear"][0] < 0.02
    assert facts["clear"][1] > 0.95
    assert facts["world"] == pytest.approx([0.1, 0.2, 0.3, 1.0], abs=0.02)
    assert facts["solid"] == pytest.approx(1.0, abs=1e-4)
    assert facts["border"] == [80, 120]
    assert facts["same"] < 1e-3
    assert facts["outside"] == 0
    assert facts["crop"] == [32, 60]
    assert facts["cropped"] < 1e-3
    assert facts["clipped"] < 0.02
    assert facts["near"] >= 1.69


ANIMATED = (
    START
    + """
for frame, x in ((1, -0.5), (100, 0.5)):
    camera.location.x = x
    camera.keyframe_insert("location", frame=frame)
scene.frame_start, scene.frame_end = 1, 100
render.resolution_percentage = 25
begun = time.monotonic()
loads, asked = [], engine.frames().render
def noted(*args):
    frame = asked(*args)
    loads.append(frame.facts["loaded"])
    return frame
engine.frames().render = noted
shoot("frame_", animation=True)
seconds = time.monotonic() - begun
left = list(engine.frames().folder().iterdir())
place = engine.frames().folder()
fieldwork.unregister()
answer({"frames": len(loads), "loads": max(loads), "seconds": seconds, "left": [str(p) for p in left],
        "gone": not place.exists(), "files": len(list(Path(folder).glob("frame_*.exr")))})
"""
)


@pytest.mark.slow
def test_a_hundred_frames_load_the_field_once_and_leave_nothing(bpy_script, ball, tmp_path):
    facts = bpy_script(ANIMATED, project=ball, folder=tmp_path)
    assert facts["frames"] == facts["files"] == 100
    assert facts["loads"] == 1
    assert facts["left"] == []
    assert facts["gone"]


KILLED = (
    START
    + """
import signal, threading
live.source, live.samples = "field", 4096
killed = []
def kill():
    while engine.frames().process is None:
        time.sleep(0.05)
    time.sleep(wait)
    killed.append(time.monotonic())
    os.kill(engine.frames().process.pid, signal.SIGKILL)
facts = {}
for name, wait in (("while it starts", 0.3), ("in the middle", 12.0)):
    thread = threading.Thread(target=kill)
    thread.start()
    message = attempt(bpy.ops.render.render)
    facts[name] = [message, time.monotonic() - killed.pop()]
    thread.join()
live.source, live.samples = "baked", 1
facts["again"] = float(passes(shoot())["Combined.A"].max())
camera.data.type = "PERSP"
settings.project = ""
facts["no project"] = attempt(bpy.ops.render.render)
settings.project = folder + "/nothing"
facts["no such project"] = attempt(bpy.ops.render.render)
scene.camera = None
facts["no camera"] = attempt(bpy.ops.render.render)
answer(facts)
"""
)


def test_a_dead_engine_and_bad_scenes_are_told_at_once(bpy_script, ball, tmp_path):
    facts = bpy_script(KILLED, project=ball, folder=tmp_path)
    for when in ("while it starts", "in the middle"):
        message, seconds = facts[when]
        assert "stopped unexpectedly" in message
        assert "signal 9" in message
        assert seconds < 2, when
    assert facts["again"] > 0.9, "the next render starts another engine"
    assert "no field" in facts["no project"]
    assert "nothing" in facts["no such project"]
    assert "camera" in facts["no camera"]


FIELDS = (
    START
    + """
def add(name, place, **more):
    obj = bpy.data.objects.new(name, None)
    scene.collection.objects.link(obj)
    obj.matrix_world = place
    obj.fieldwork.is_field, obj.fieldwork.project = True, project
    for key, value in more.items():
        setattr(obj.fieldwork, key, value)
    return obj
settings.project = ""
camera.location, camera.rotation_euler = (0, -3, 0), (math.pi / 2, 0, 0)
left, right = add("Left", Matrix.Translation((-0.6, 0, 0))), add("Right", Matrix.Translation((0.6, 0, 0)), look=1.0)
both = passes(shoot())
facts = {"both": [float(both["Combined.A"][40, x]) for x in (27, 60, 93)]}
facts["labels"] = [float(both[f"Combined.{c}"][32, 93]) for c in "RGB"]
left.hide_render = True
facts["one"] = [float(passes(shoot())["Combined.A"][40, x]) for x in (27, 93)]
right.hide_render = True
facts["none"] = attempt(bpy.ops.render.render)
left.hide_render = False
crop = bpy.data.objects.new("crop", None)
scene.collection.objects.link(crop)
crop.empty_display_type, crop.empty_display_size, crop.location = "CUBE", 1.0, (-0.6, 0, 1)
left.fieldwork.crop = crop
bpy.context.view_layer.update()
cut = passes(shoot())["Combined.A"]
facts["crop"] = [float(cut[y, 27]) for y in (32, 48)]
left.fieldwork.crop = None
from fieldwork.addon.live.fields import refresh
refresh(left)
facts["classes"] = [[c.id, c.name] for c in left.fieldwork.classes]
left.fieldwork.classes[0].visible = False
refresh(left)
facts["hidden"] = float(passes(shoot())["Combined.A"][:38].sum() / both["Combined.A"][:38, :60].sum())
left.fieldwork.project = ""
facts["no project"] = attempt(bpy.ops.render.render)
answer(facts)
"""
)


def test_field_objects_are_moved_cropped_hidden_and_coloured(bpy_script, ball, tmp_path):
    facts = bpy_script(FIELDS, project=ball, folder=tmp_path)
    assert facts["both"][0] > 0.9
    assert facts["both"][1] < 0.1
    assert facts["both"][2] > 0.9
    assert facts["labels"] == pytest.approx([0.604, 0.033, 0.033], abs=0.08)
    assert facts["one"][0] < 0.1
    assert facts["one"][1] > 0.9
    assert "hidden" in facts["none"]
    assert facts["crop"][0] > 0.8
    assert facts["crop"][1] < 0.1
    assert facts["classes"] == [[1, "top"], [2, "bottom"]]
    assert facts["hidden"] < 0.4
    assert "no project folder" in facts["no project"]


def test_a_crop_box_that_was_deleted_cuts_nothing(bpy_script):
    facts = bpy_script(
        SETUP
        + """
from fieldwork.addon.live import fields
field = bpy.data.objects.new("Field", None)
scene.collection.objects.link(field)
field.fieldwork.is_field = True
bpy.context.view_layer.objects.active = field
bpy.ops.fieldwork.add_crop_box()
def cropped():
    depsgraph = bpy.context.evaluated_depsgraph_get()
    seen = (field, None), (field.evaluated_get(depsgraph), depsgraph)
    return ["crop" in fields.poses_of(*each) for each in seen]
facts = {"there": cropped()}
bpy.ops.object.select_all(action="DESELECT")
field.fieldwork.crop.select_set(True)
bpy.ops.object.delete()
answer({**facts, "deleted": cropped(), "pointer": field.fieldwork.crop is not None})
"""
    )
    assert facts == {"there": [True, True], "deleted": [False, False], "pointer": True}
