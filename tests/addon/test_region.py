"""The box of the training region: both ways between the scene and the project."""

from __future__ import annotations

import pytest
from fieldwork.tests.addon.support import SETUP, make_posed_project

BOX = (
    SETUP
    + """
from fieldwork.addon.project import region as crop
settings.project = project
bpy.ops.fieldwork.crop_add()
box = crop.find(scene)
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
written = crop.read_bounds(Path(project))
box.scale.z = 0
flat = attempt(lambda: bpy.ops.fieldwork.crop_apply())
bpy.ops.fieldwork.crop_remove()
answer({"written": written, "flat": flat, "after": crop.read_bounds(Path(project)), "box": crop.find(scene) is None})
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
    return crop.follow(scene), crop.read_bounds(Path(project))
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
    written = crop.follow(scene)
    bpy.context.view_layer.update()
    return written, crop.bounds_of(scene, box), crop.read_bounds(Path(project))
seen = [look(), look()]
crop.write_bounds(Path(project), [[0, 0, 0], [4, 2, 6]])  # as aligning does
os.utime(Path(project) / "project.json", (1, 1))
seen += [look(), look()]
crop._seen.clear()  # another file is loaded
box.location.x = 50
seen += [look(), look()]
crop.write_bounds(Path(project), None)
os.utime(Path(project) / "project.json", (2, 2))
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
