"""Fields in collections of which empties are instances, as linking a collection from another file makes them."""

from __future__ import annotations

from pathlib import Path

import pytest
from fieldwork.tests.addon.rendered import START, ball
from fieldwork.tests.addon.support import SETUP, make_project

__all__ = ["ball"]

NESTED = """
from mathutils import Matrix
from fieldwork.addon.live import fields
def empty(name, collection, instance=None, **more):
    made = bpy.data.objects.new(name, None)
    collection.objects.link(made)
    if instance is not None:
        made.instance_type, made.instance_collection = "COLLECTION", instance
    for key, value in more.items():
        setattr(made, key, value)
    return made
inner, outer, drawer = (bpy.data.collections.new(name) for name in ("Inner", "Outer", "Drawer"))
inner.instance_offset, outer.instance_offset = (0, 0, 1), (0.5, 0, 0)
inner.children.link(drawer)
field = empty("Field", drawer, location=(1, 2, 3), scale=(2, 2, 2))
field.fieldwork.is_field, field.fieldwork.project = True, project
box = field.fieldwork.crop = empty("Box", drawer, location=(0, 0, 3), empty_display_size=0.5)
copy = empty("Copy", inner, location=(4, 0, 0))
copy.fieldwork_copy.field, copy.fieldwork_copy.thing = field, "cup"
low = empty("Low", outer, inner, rotation_euler=(0, 0, 1))
high = empty("High", scene.collection, outer, location=(0, 7, 0))
beside = empty("Beside", scene.collection, inner, scale=(3, 3, 3))
"""


def test_parts_stand_where_blender_has_the_instances_and_are_hidden_with_them(bpy_script, tmp_path: Path) -> None:
    facts = bpy_script(
        SETUP
        + NESTED
        + """
graph = bpy.context.evaluated_depsgraph_get()
there = {}
for each in graph.object_instances:
    if each.is_instance:
        there.setdefault(each.object.name, []).append([list(row) for row in each.matrix_world])
def off(one, other):
    return max(abs(a - b) for row, line in zip(one, other) for a, b in zip(row, line))
places, shown = [], fields.rendered_parts(graph)
for part in shown:
    found = fields.poses_of_part(part, graph)
    at = found["scene_from_capture"]
    places.append(min(off(at, matrix) for matrix in there[part.object.name]))
    if part.copy is None:
        scaled = [[list(row) for row in Matrix(matrix) @ Matrix.Scale(0.5, 4)] for matrix in there["Box"]]
        places.append(min(off(found["crop"], matrix) for matrix in scaled))
facts = {"off": max(places), "names": [part.name for part in shown], "all": len(fields.all_parts(scene))}
def names():
    bpy.context.view_layer.update()
    return sorted(part.name for part in fields.rendered_parts(bpy.context.evaluated_depsgraph_get()))
low.hide_render = True
facts["without low"] = names()
drawer.hide_render = True
facts["without the drawer"] = names()
answer(facts)
""",
        project=make_project(tmp_path / "capture"),
    )
    field, copy = "Beside\nField", "Beside\nCopy"
    assert sorted(facts["names"]) == sorted([field, copy, "High\nLow\nField", "High\nLow\nCopy"])
    assert facts["off"] < 1e-5
    assert facts["all"] == 4
    assert facts["without low"] == sorted([field, copy])
    assert facts["without the drawer"] == [copy], "as copies of a field that is hidden in the scene itself"


def test_copies_in_instances_are_shown_where_their_field_is_in_the_scene_itself(bpy_script, tmp_path: Path) -> None:
    facts = bpy_script(
        SETUP
        + NESTED
        + """
drawer.objects.unlink(field)
scene.collection.objects.link(field)
def names():
    bpy.context.view_layer.update()
    return sorted(part.name for part in fields.rendered_parts(bpy.context.evaluated_depsgraph_get()))
facts = [names()]
parts = {part.name: part for part in fields.all_parts(scene)}
facts.append(fields.poses_of_part(parts["Beside\\nCopy"])["scene_from_capture"][0][3])
scene.collection.objects.unlink(field)
facts.append(names())
answer(facts)
""",
        project=make_project(tmp_path / "capture"),
    )
    assert facts == [["Beside\nCopy", "Field", "High\nLow\nCopy"], 12.0, []], "deleted fields have no copies"


def test_the_viewport_has_them_in_the_same_places(bpy_script, tmp_path: Path) -> None:
    facts = bpy_script(
        SETUP
        + NESTED
        + """
from types import SimpleNamespace
from fieldwork.addon.live.training import _is_there
from fieldwork.addon.live.viewport import Viewport
bpy.context.view_layer.update()
meta = {"class_ids": [], "sfm_from_box": [[float(i == k) for k in range(4)] for i in range(4)]}
asset = SimpleNamespace(found=SimpleNamespace(meta=meta), told=None)
own = Viewport()
parts = {part.name: part for part in fields.all_parts(scene)}
facts = {}
for name in ("Beside\\nField", "High\\nLow\\nField"):
    part = parts[name]
    shown, poses = own._placed(part, Path(project), asset), fields.poses_of_part(part)
    pairs = (shown.box, poses["scene_from_capture"]), (shown.crop, poses["crop"])
    facts[name] = [abs(a - b) for one, other in pairs for row, line in zip(one, other) for a, b in zip(row, line)]
window = SimpleNamespace(scene=scene, view_layer=bpy.context.view_layer)
area = SimpleNamespace(type="VIEW_3D", regions=[SimpleNamespace(as_pointer=lambda: 1)])
window.screen = SimpleNamespace(areas=[area])
from fieldwork.addon.live import training
training.bpy = SimpleNamespace(context=SimpleNamespace(window_manager=SimpleNamespace(windows=[window])))
facts["watched"] = [_is_there((1, "High\\nLow\\nField")), _is_there((1, "Elsewhere\\nField"))]
answer(facts)
""",
        project=make_project(tmp_path / "capture"),
    )
    assert facts.pop("watched") == [True, False]
    assert max(value for values in facts.values() for value in values) < 1e-6


@pytest.mark.slow
def test_an_instance_is_rendered_as_the_field_itself_would_be(bpy_script, ball: Path, tmp_path: Path) -> None:
    facts = bpy_script(
        START
        + """
from fieldwork.addon.live import fields
render.resolution_percentage = 50
bpy.ops.fieldwork.add_field()
field = bpy.context.object
field.matrix_world = Matrix.Translation((0.3, 0, 0.1)) @ Matrix.Scale(0.8, 4)
wanted = stack(passes(shoot()), "Combined", "RGBA")
held = bpy.data.collections.new("Held")
for collection in field.users_collection:
    collection.objects.unlink(field)
held.objects.link(field)
held.instance_offset = (0, 0.4, 0)
field.location.x = 0.0
settings.project = ""
facts = {"nothing": attempt(bpy.ops.render.render)}
empty = bpy.data.objects.new("Instance", None)
scene.collection.objects.link(empty)
empty.instance_type, empty.instance_collection, empty.location = "COLLECTION", held, (0.3, 0.4, 0)
seen = stack(passes(shoot()), "Combined", "RGBA")
empty.hide_render = True
facts |= {"off": float(abs(seen - wanted).max()), "alpha": float(wanted[..., 3].max())}
facts["hidden"] = attempt(bpy.ops.render.render)
answer(facts)
""",
        project=ball,
        folder=tmp_path,
    )
    assert "has no field" in facts["nothing"]
    assert facts["alpha"] > 0.9
    assert facts["off"] == pytest.approx(0, abs=1e-3)
    assert "hidden in renders" in facts["hidden"]
