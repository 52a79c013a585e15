"""Things of a field object hidden, recoloured, moved and copied in Blender: by F12, and as a file for the command line."""

from __future__ import annotations

import json
import shutil
from pathlib import Path

import pytest
from fieldwork.nerfcore.film.edits import render
from fieldwork.nerfcore.params import RenderParams
from fieldwork.nerfcore.progress import Reporter
from fieldwork.tests.addon.rendered import START, ball
from fieldwork.tests.nerfcore.support.halves import write_halves
from PIL import Image

__all__ = ["ball"]

THINGS = (
    START
    + """
from fieldwork.addon.live import fields
bpy.ops.fieldwork.add_field()
field = bpy.context.object
own = field.fieldwork
camera.location, camera.rotation_euler = (0, -3, 0), (math.pi / 2, 0, 0)
render.resolution_percentage = 100
facts = {"things": [e.name for e in own.things]}
# The ball is 56 pixels wide around (60, 40): its upper left and right, its lower half, and free space above and beside.
SPOTS = {"left": (29, 52), "right": (29, 68), "below": (50, 60), "above": (8, 60), "beside": (29, 97)}
def look():
    found = passes(shoot())
    return {n: [float(found[f"Combined.{c}"][y, x]) for c in "RGBA"] for n, (y, x) in SPOTS.items()}
facts["plain"] = look()
own.things["left"].visible = False
facts["hidden"] = look()
own.things["left"].visible = True
own.things["right"].tint, own.things["right"].color = 1.0, (0, 1, 0)
facts["tinted"] = look()
facts["moved"] = bpy.ops.fieldwork.place_thing(thing="left") == {"FINISHED"}
moved = bpy.context.selected_objects[0]
bpy.context.view_layer.update()
facts["in place"] = look()
moved.location.x += 0.81
own.thing_index = [e.name for e in own.things].index("right")
bpy.ops.fieldwork.place_thing(copy=True)
copy = bpy.context.selected_objects[0]
copy.location.x, copy.location.z = 0.0, 0.6
bpy.context.view_layer.update()
facts["elsewhere"] = look()
facts["saved"] = list(bpy.ops.fieldwork.save_field_edits(filepath=folder + "/edits.json"))
copy.hide_render = True
facts["hidden copy"] = look()["above"][3]
copy.hide_render = False
moved.keyframe_insert("location", frame=scene.frame_current)
moved.location.x += 0.6
moved.keyframe_insert("location", frame=scene.frame_current + 1)
render.use_motion_blur, render.motion_blur_shutter, render.motion_blur_position, live.samples = True, 1.0, "START", 16
facts["blurred"] = look()["beside"][3]
render.use_motion_blur, live.samples = False, 1
fields.refresh(field)
facts["kept"] = [own.things["left"].visible, own.things["right"].tint]
live.source = "field"
facts["not baked"] = attempt(bpy.ops.render.render)
answer(facts)
"""
)


@pytest.fixture(scope="module")
def things(ball: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    project = Path(shutil.copytree(ball, tmp_path_factory.mktemp("things") / "ball"))
    write_halves(project)
    return project


def test_things_are_edited_in_renders(bpy_script, things: Path, tmp_path: Path) -> None:
    facts = bpy_script(THINGS, project=things, folder=tmp_path)
    assert facts["things"] == ["left", "right"]
    plain = facts["plain"]
    assert [plain[n][3] > 0.9 for n in ("left", "right", "below", "above", "beside")] == [True] * 3 + [False] * 2
    assert facts["hidden"]["left"][3] < 0.6
    assert facts["hidden"]["right"] == pytest.approx(plain["right"], abs=0.05)
    assert facts["tinted"]["right"] == pytest.approx([0, 1, 0, 1], abs=0.1)
    assert facts["tinted"]["left"] == pytest.approx(plain["left"], abs=0.02)
    assert facts["moved"]
    assert facts["in place"]["left"] == pytest.approx(plain["left"], abs=0.1), "a moved thing begins where it stood"
    there = facts["elsewhere"]
    assert there["left"][3] < 0.6, "it is gone from there"
    assert there["beside"][3] > 0.9
    assert there["above"] == pytest.approx([0, 1, 0, 1], abs=0.15), "a copy looks as the thing does"
    assert there["right"] == pytest.approx([0, 1, 0, 1], abs=0.1)
    assert facts["hidden copy"] < 0.1
    assert 0.05 < facts["blurred"] < 0.95
    assert facts["kept"] == [False, 1.0]
    assert "choose Baked Field" in facts["not baked"]
    assert facts["saved"] == ["FINISHED"]
    # The command line shows what F12 does.
    edits = json.loads((tmp_path / "edits.json").read_text(encoding="utf-8"))["edits"]
    assert {edit["instance"]: len(edit["copies"]) for edit in edits} == {"left": 1, "right": 1}
    pose = [[1, 0, 0, 0], [0, 0, -1, -3], [0, 1, 0, 0], [0, 0, 0, 1]]
    frame = {"file_path": "a", "transform_matrix": pose, "w": 120, "h": 80, "fl_x": 120 * 50 / 36}
    (tmp_path / "cameras.json").write_text(json.dumps({"w": 120, "h": 80, "frames": [frame]}))
    params = RenderParams(
        project=things, out=tmp_path, camera=tmp_path / "cameras.json", baked=True, edits=tmp_path / "edits.json"
    )
    render(params, Reporter())

    with Image.open(tmp_path / "a.png") as picture:
        pixels = picture.convert("RGB")
        assert pixels.getpixel((60, 8)) == pytest.approx((0, 255, 0), abs=40)
        assert pixels.getpixel((2, 2)) != pytest.approx(pixels.getpixel((97, 29)), abs=10)
