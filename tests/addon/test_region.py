"""The box of the training region: both ways between the scene and the project."""

from __future__ import annotations

import pytest
from fieldwork.tests.addon.support import ENGINE, SETUP, make_posed_project

BOX = (
    SETUP
    + ENGINE
    + """
from fieldwork.addon.project import region
def bounds():
    return stored(project).get("frame", {}).get("bounds")
settings.project = project
bpy.ops.fieldwork.crop_add()
box = region.find(scene)
"""
)


def test_crop_box_becomes_the_training_region(bpy_script, tmp_path):
    folder = make_posed_project(tmp_path / "capture")
    facts = bpy_script(
        BOX
        + """
import math
box.location, box.scale, box.rotation_euler = (1, 2, 3), (1, 2, 0.5), (0, 0, math.pi / 2)
bpy.ops.fieldwork.crop_apply()
written = bounds()
box.scale.z = 0
flat = attempt(lambda: bpy.ops.fieldwork.crop_apply())
bpy.ops.fieldwork.crop_remove()
answer({"written": written, "flat": flat, "after": bounds(), "box": region.find(scene) is None})
""",
        project=folder,
    )
    assert facts["written"][0] == pytest.approx([-1, 1, 2.5], abs=1e-5)
    assert facts["written"][1] == pytest.approx([3, 3, 3.5], abs=1e-5)
    assert "flat" in facts["flat"]
    assert facts["after"] is None
    assert facts["box"]


def test_moving_the_region_box_edits_the_training_region(bpy_script, tmp_path):
    folder = make_posed_project(tmp_path / "capture")
    facts = bpy_script(
        BOX
        + """
def look():
    bpy.context.view_layer.update()
    edited = region.follow(scene)
    settle()
    return edited, bounds()
box.location, box.scale = (1, 2, 3), (1, 1, 1)
seen = [look()]  # still moving, as far as is known
seen.append(look())
seen.append(look())
box.location.x = 5
seen += [look(), look()]
box.scale.x = 0
seen += [look(), look()]
bpy.data.objects.remove(box)
seen.append(look())
answer(seen)
""",
        project=folder,
    )
    first, second = [[0, 1, 2], [2, 3, 4]], [[4, 1, 2], [6, 3, 4]]
    assert [written for written, _ in facts] == [False, True, False, False, True, False, False, False]
    assert [bounds for _, bounds in facts] == [None, first, first, first, second, second, second, second]


def test_the_box_goes_where_the_project_says(bpy_script, tmp_path):
    """After aligning, and in a file that was saved before: the box must not carry its old bounds back."""
    folder = make_posed_project(tmp_path / "capture")
    facts = bpy_script(
        BOX
        + """
box.location, box.scale = (1, 2, 3), (1, 1, 1)
def look():
    bpy.context.view_layer.update()
    edited = region.follow(scene)
    settle()
    bpy.context.view_layer.update()
    return edited, region.bounds_of(scene, box), bounds()
seen = [look(), look()]
write(project, frame={"bounds": [[0, 0, 0], [4, 2, 6]]})  # as aligning does
seen += [look(), look()]
region._seen.clear()  # another file is loaded
box.location.x = 50
seen += [look(), look()]
write(project, frame={"bounds": None})
seen += [look(), look()]
box.location.x = 7
seen += [look(), look()]
answer(seen)
""",
        project=folder,
    )
    moved = [[0, 0, 0], [4, 2, 6]]
    assert [written for written, _, _ in facts] == [False, True, False, False, False, False, False, False, False, True]
    for _, box, project in facts[2:6]:
        assert box == moved == project
    assert [project for _, _, project in facts[6:8]] == [None, None], "cleared elsewhere, it stays so"
    assert facts[9][2] == [[5, 0, 0], [9, 2, 6]]


def test_undo_of_a_region_is_an_edit_only_where_the_user_had_made_one(bpy_script, tmp_path):
    folder = make_posed_project(tmp_path / "capture")
    facts = bpy_script(
        BOX
        + """
box.location, box.scale = (1, 2, 3), (1, 1, 1)
def look(times=3):
    for _ in range(times):
        bpy.context.view_layer.update()
        region.follow(bpy.context.scene)
        settle()
    bpy.context.view_layer.update()
    box = region.find(bpy.context.scene)
    return [region.bounds_of(bpy.context.scene, box) if box else None, bounds()]
seen = {"first": look()}
bpy.ops.ed.undo_push(message="first")
region.find(bpy.context.scene).location.x = 5
seen["second"] = look()
bpy.ops.ed.undo_push(message="second")
bpy.ops.ed.undo()
seen["undone"] = look()
bpy.ops.ed.redo()
seen["redone"] = look()
# Aligning moves the region; undo of something else brings back a box of before.
write(project, frame={"bounds": [[0, 0, 0], [4, 2, 6]]})
seen["aligned"] = look()
asked.clear()
bpy.ops.ed.undo()
seen["undone after"] = look()
answer({"seen": seen, "asked": asked})
""",
        project=folder,
    )
    first, second, aligned = [[0, 1, 2], [2, 3, 4]], [[4, 1, 2], [6, 3, 4]], [[0, 0, 0], [4, 2, 6]]
    wanted = {"first": first, "second": second, "undone": first, "redone": second}
    wanted |= {"aligned": aligned, "undone after": aligned}
    assert facts["seen"] == {name: [bounds, bounds] for name, bounds in wanted.items()}
    assert facts["asked"] == [], "nothing was written after the undo"


def test_loading_a_file_changes_no_region(bpy_script, tmp_path):
    """Neither where the file's box is an old one, nor where the project's region was cleared since."""
    folder = make_posed_project(tmp_path / "capture")
    facts = bpy_script(
        BOX
        + """
def look(times=4):
    for _ in range(times):
        bpy.context.view_layer.update()
        region.follow(bpy.context.scene)
        settle()
    bpy.context.view_layer.update()
    box = region.find(bpy.context.scene)
    return [bounds(), region.bounds_of(bpy.context.scene, box)]
def load():
    bpy.ops.wm.open_mainfile(filepath=file)
    asked.clear()
    return [*look(), list(asked)]
file = folder + "/old.blend"
bpy.context.preferences.filepaths.save_version = 0
box.location, box.scale = (1, 2, 3), (1, 1, 1)
seen = {"saved": look()}
bpy.ops.wm.save_as_mainfile(filepath=file)
region.find(bpy.context.scene).location.x = 5
seen["newer"] = look()
seen["loaded"] = load()
write(project, frame={"bounds": None})
seen["cleared"] = load()
region.find(bpy.context.scene).location.x = 7
seen["moved"] = look()
answer(seen)
""",
        project=folder,
        folder=tmp_path,
    )
    first, second, third = ([[x - 1, 1, 2], [x + 1, 3, 4]] for x in (1, 5, 7))
    assert facts["saved"] == [first, first]
    assert facts["newer"] == [second, second]
    assert facts["loaded"] == [second, second, []], "the box goes to the region"
    assert facts["cleared"] == [None, first, []]
    assert facts["moved"] == [third, third], "moving it says that it is meant"


def test_undo_of_regions_goes_back_along_the_users_own_edits_only(bpy_script, tmp_path):
    folder = make_posed_project(tmp_path / "capture")
    facts = bpy_script(
        BOX
        + """
def look(times=4):
    for _ in range(times):
        bpy.context.view_layer.update()
        region.follow(bpy.context.scene)
        settle()
    return bounds()
def put(x):
    region.find(bpy.context.scene).location.x = x
    found = look()
    bpy.ops.ed.undo_push(message=str(x))
    return found
def undo():
    bpy.ops.ed.undo()
    return look()
bpy.ops.ed.undo_push(message="start")
put(1), put(2)
write(project, frame={"bounds": [[0, 0, 0], [4, 2, 6]]})  # as aligning does
look()
bpy.ops.ed.undo_push(message="something else")
put(7), put(8), put(9)
seen = [undo() for _ in range(5)]
bpy.ops.ed.redo()
answer([*seen, look()])
""",
        project=folder,
    )
    aligned = [[0, 0, 0], [4, 2, 6]]
    assert [bounds[0][0] for bounds in facts[:2]] == [6, 5]
    assert facts[2] == aligned
    assert facts[3:] == [aligned] * 3, "what was there before aligning does not come back"
