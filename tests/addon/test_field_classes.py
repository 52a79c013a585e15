"""The classes of a field object: shown alone, and read again from the project."""

from __future__ import annotations

import json

import pytest
from fieldwork.tests.addon.support import SETUP, make_project

FIELD = """
field = bpy.data.objects.new("Field", None)
scene.collection.objects.link(field)
own = field.fieldwork
own.is_field, own.project, own.run = True, project, "main"
read = bpy.ops.fieldwork.refresh_field_classes
read()
def listed():
    return [[entry.id, entry.name, entry.visible] for entry in own.classes]
"""


def test_one_class_is_shown_alone_and_then_all_are(bpy_script, tmp_path):
    facts = bpy_script(
        SETUP
        + FIELD
        + """
def isolate(index):
    bpy.ops.fieldwork.isolate_class(index=index)
    return [entry.visible for entry in own.classes]
seen = [isolate(1), isolate(1), isolate(0), isolate(1), isolate(1)]
answer({"seen": seen, "none": attempt(lambda: bpy.ops.fieldwork.isolate_class(index=2)), "left": listed()})
""",
        project=make_project(tmp_path / "capture"),
    )
    assert facts["seen"] == [[False, True], [True, True], [True, False], [False, True], [True, True]]
    assert "no such class" in facts["none"]
    assert facts["left"] == [[1, "stone", True], [2, "gold", True]]


def test_classes_are_read_again_and_keep_what_was_set(bpy_script, tmp_path):
    project = make_project(tmp_path / "capture")
    changed = json.loads((project / "project.json").read_text())["classes"]
    changed[1]["name"] = "gilding"
    facts = bpy_script(
        SETUP
        + FIELD
        + """
own.classes[1].visible, own.classes[1].opacity = False, 0.5
path, seen = Path(project, "project.json"), []
for classes in (changed, [changed[1], {**changed[0], "id": 7, "name": "wood"}]):
    path.with_name("part").write_text(json.dumps({**json.loads(path.read_text()), "classes": classes}))
    os.replace(path.with_name("part"), path)
    read()
    seen.append(listed())
answer({"seen": seen, "opacity": own.classes[0].opacity})
""",
        project=project,
        changed=changed,
    )
    assert facts["seen"] == [
        [[1, "stone", True], [2, "gilding", False]],
        [[2, "gilding", False], [7, "wood", True]],
    ]
    assert facts["opacity"] == 0.5


def test_fields_are_rendered_unless_their_collection_is_left_out(bpy_script, tmp_path):
    seen = bpy_script(
        SETUP
        + FIELD
        + """
from fieldwork.addon.live.fields import rendered_parts
outer, inner = bpy.data.collections.new("outer"), bpy.data.collections.new("inner")
scene.collection.children.link(outer)
outer.children.link(inner)
scene.collection.objects.unlink(field)
inner.objects.link(field)
def count():
    return len(rendered_parts(bpy.context.evaluated_depsgraph_get()))
seen = [count()]
outer.hide_render = True
seen.append(count())
outer.hide_render, inner.hide_render = False, True
seen.append(count())
inner.hide_render = False
bpy.context.view_layer.layer_collection.children["outer"].exclude = True
seen.append(count())
scene.collection.objects.link(field)
seen.append(count())
answer(seen)
""",
        project=make_project(tmp_path / "capture"),
    )
    assert seen == [1, 0, 0, 0, 1]


def test_the_background_is_that_of_the_node_at_the_worlds_output(bpy_script):
    colors = bpy_script(
        SETUP
        + """
from fieldwork.addon.live.passes import world_color
world = bpy.data.worlds.new("sky")
world.use_nodes = True
nodes, links = world.node_tree.nodes, world.node_tree.links
nodes.clear()
unused, used = nodes.new("ShaderNodeBackground"), nodes.new("ShaderNodeBackground")
output = nodes.new("ShaderNodeOutputWorld")
unused.inputs[0].default_value, used.inputs[0].default_value = (1, 0, 0, 1), (0, 0.5, 0.25, 1)
used.inputs[1].default_value = 2
seen = [world_color(world)]
links.new(used.outputs[0], output.inputs[0])
seen.append(world_color(world))
answer(seen)
"""
    )
    assert colors == [[0, 0, 0], [0, 1, 0.5]]


def test_the_background_is_told_as_the_engine_counts_and_comes_back_as_blender_does(bpy_script):
    there_and_back = bpy_script(
        SETUP
        + """
import numpy as np
from fieldwork.addon.live.passes import rec709, working_space
color = (0.8, 0.1, 0.05)
spaces = ("Linear Rec.709", "Linear Rec.2020", "ACEScg")
answer([np.array(working_space(np.array([*rec709(color, space), 1.0]), space)).tolist() for space in spaces])
"""
    )
    for found in there_and_back:
        assert found == pytest.approx([0.8, 0.1, 0.05, 1], abs=1e-5)
