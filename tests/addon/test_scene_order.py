"""A capture in a scene that the user has put in order: other collections, hidden ones, no parent, several scenes."""

from __future__ import annotations

import pytest
from fieldwork.tests.addon.support import SETUP, make_posed_project, make_project
from fieldwork.tests.addon.test_scene_bridge import package

__all__ = ["package"]

UPDATE = (
    SETUP
    + """
from fieldwork.addon.scene.package import read_package
from fieldwork.addon.scene.build import import_package
update = lambda: import_package(scene, read_package(package))
"""
)
ELSEWHERE = {
    "the collection": "own.children.link(held); scene.collection.children.unlink(held)",
    "its objects": "[(own.objects.link(o), held.objects.unlink(o)) for o in list(held.objects) if o.type == 'MESH']",
}
HIDDEN = {
    "nothing": "",
    "excluded": "layer.exclude = True",
    "collection": "held.hide_viewport = True",
    "parent": "root.hide_viewport = True",
}


@pytest.mark.parametrize("move", ELSEWHERE)
def test_what_was_moved_to_another_collection_is_updated_there(bpy_script, package, move):
    facts = bpy_script(
        UPDATE
        + """
made = update()
held = next(c for c in bpy.data.collections if c.get("fieldwork_role") == "all")
own = bpy.data.collections.new("Scan")
scene.collection.children.link(own)
exec(move)
before = sorted(o.name for o in bpy.data.objects), sorted(c.name for c in bpy.data.collections)
mesh = made.mesh.name
again = [update() for _ in range(2)][-1]
after = sorted(o.name for o in bpy.data.objects), sorted(c.name for c in bpy.data.collections)
answer({"before": before, "after": after, "mesh": [again.mesh.name, mesh], "warnings": again.warnings,
        "in": bpy.data.objects[mesh].name in own.all_objects})
""",
        package=package,
        move=ELSEWHERE[move],
    )
    assert facts["after"] == facts["before"]
    assert facts["mesh"][0] == facts["mesh"][1]
    assert facts["warnings"] == []
    assert facts["in"]


def test_a_new_parent_takes_what_the_deleted_one_left(bpy_script, package):
    facts = bpy_script(
        UPDATE
        + """
scene.unit_settings.scale_length = 0.01
made = update()
free = made.cameras[0].name
bpy.data.objects.remove(made.root)
made = update()
bpy.context.view_layer.update()
answer({"scale": list(made.mesh.matrix_world.to_scale()), "parents": [o.parent == made.root for o in made.objects() if o != made.root]})
""",
        package=package,
    )
    assert facts["scale"] == pytest.approx([100] * 3)
    assert all(facts["parents"])


@pytest.mark.parametrize(
    "hide", ["nothing", "excluded", *(pytest.param(h, marks=pytest.mark.slow) for h in ("collection", "parent"))]
)
def test_the_place_of_a_capture_that_nothing_evaluates_is_known(bpy_script, tmp_path, hide):
    """Blender stores no matrices of what is excluded or disabled in viewports."""
    facts = bpy_script(
        SETUP
        + """
from mathutils import Vector
from fieldwork.addon.roles import Owner
from fieldwork.addon.scene.frame import scene_from_capture, world_of
owner = Owner("p", "u")
held = bpy.data.collections.new("capture")
scene.collection.children.link(held)
above, root = bpy.data.objects.new("above", None), bpy.data.objects.new("root", None)
for item in (above, root):
    held.objects.link(item)
above.location, above.rotation_euler = (5, 0, 0), (0, 0, 1.5)
root.location, root.scale = (1, 2, 3), (2, 2, 2)
bpy.context.view_layer.update()
owner.mark(root, "root")
root.parent, root.matrix_parent_inverse = above, above.matrix_world.inverted()
bpy.context.view_layer.update()
true = [list(row) for row in root.matrix_world]
layer = bpy.context.view_layer.layer_collection.children[held.name]
exec(hide)
bpy.ops.wm.save_as_mainfile(filepath=file)
bpy.ops.wm.open_mainfile(filepath=file)
scene = bpy.context.scene
bpy.context.view_layer.update()
root = bpy.data.objects["root"]
box = bpy.data.objects.new("box", None)
scene.collection.objects.link(box)
box.parent = root
found = [list(row) for row in scene_from_capture(scene, owner)]
answer({"true": true, "found": found, "child": [list(row) for row in world_of(box)]})
""",
        hide=HIDDEN[hide],
        file=str(tmp_path / "a.blend"),
    )
    for name in ("found", "child"):
        for found, true in zip(facts[name], facts["true"]):
            assert found == pytest.approx(true, abs=1e-5)


def test_the_region_of_a_capture_that_nothing_evaluates_is_that_of_the_capture(bpy_script, tmp_path):
    facts = bpy_script(
        SETUP
        + """
from fieldwork.addon.project import region, snapshot
from fieldwork.operators.region import default_bounds
owner = snapshot.owner(Path(project))
held = bpy.data.collections.new("capture")
scene.collection.children.link(held)
root = bpy.data.objects.new("root", None)
mesh = bpy.data.meshes.new("Surface")
mesh.from_pydata([(x, y, z) for x in (-1, 1) for y in (-2, 2) for z in (-3, 3)], [], [])
surface = bpy.data.objects.new("Surface", mesh)
for item, role in ((root, "root"), (surface, "mesh")):
    held.objects.link(item)
    owner.mark(item, role)
root.location, root.scale, surface.parent = (5, 0, 0), (100, 100, 100), root
settings.project = project
bpy.context.view_layer.layer_collection.children[held.name].exclude = True
bpy.ops.wm.save_as_mainfile(filepath=file)
bpy.ops.wm.open_mainfile(filepath=file)
scene = bpy.context.scene
box = region.add(scene, [[-1, -1, -1], [1, 1, 1]])
answer({"bounds": region.bounds_of(scene, box), "mesh": default_bounds(scene)})
""",
        project=make_posed_project(tmp_path / "capture"),
        file=str(tmp_path / "a.blend"),
    )
    for found, true in ((facts["bounds"], (1, 1, 1)), (facts["mesh"], (1, 2, 3))):
        assert found[0] == pytest.approx([-v for v in true], abs=1e-4)
        assert found[1] == pytest.approx(list(true), abs=1e-4)


def test_a_volume_in_the_scene_outlives_updates(bpy_script, package, tmp_path):
    facts = bpy_script(
        UPDATE
        + """
from fieldwork.addon.roles import Owner
from fieldwork.addon.scene import volume
made = update()
owner = Owner(made.root["fieldwork_project"], made.root.get("fieldwork_uuid", ""))
shown = volume.show(scene, owner, Path(folder, "a.vdb")).name
update()
answer({"there": shown in bpy.data.objects, "role": bpy.data.objects[shown].get("fieldwork_role")})
""",
        package=package,
        folder=str(tmp_path),
    )
    assert facts == {"there": True, "role": "volume"}


def test_up_is_an_axis_of_the_scene_however_the_capture_is_turned(bpy_script, tmp_path):
    facts = bpy_script(
        SETUP
        + """
from math import pi
from mathutils import Euler, Matrix
from fieldwork.operators.poses import up_in_capture
turned = (Matrix.Translation((1, 2, 3)) @ Euler((pi / 2, 0, 0)).to_matrix().to_4x4() @ Matrix.Scale(3, 4)).inverted()
moved = (Matrix.Translation((1, 2, 3)) @ Matrix.Scale(3, 4)).inverted()
answer({up: [up_in_capture(up, turned), up_in_capture(up, moved)] for up in ("x", "y", "-z")})
"""
    )
    assert [facts[up][1] for up in facts] == ["x", "y", "-z"]
    assert facts["x"][0] == "x"
    assert [float(v) for v in facts["y"][0].split(",")] == pytest.approx([0, 0, -1], abs=1e-6)
    assert [float(v) for v in facts["-z"][0].split(",")] == pytest.approx([0, -1, 0], abs=1e-6)


def test_classes_are_hidden_in_their_own_scene_and_project_only(bpy_script, tmp_path):
    facts = bpy_script(
        SETUP
        + """
def surface(where, name="Surface", capture="capture"):
    mesh = bpy.data.meshes.new(name)
    mesh.from_pydata([(0, 0, 0), (1, 0, 0), (0, 1, 0)], [], [(0, 1, 2)])
    item = bpy.data.objects.new(name, mesh)
    item["fieldwork_role"], item["fieldwork_project"] = "mesh", capture
    where.collection.objects.link(item)
    return item
surface(scene)
bpy.data.libraries.write(file, {bpy.data.objects["Surface"]})
with bpy.data.libraries.load(file, link=True) as (_, wanted):
    wanted.objects = ["Surface"]
scene.collection.objects.link(wanted.objects[0])
other = bpy.data.scenes.new("other")
surface(other, "Other")
settings.project = project
settings.classes[0].visible = False
modifiers = {(o.name, o.library is not None): len(o.modifiers) for o in bpy.data.objects if o.type == "MESH"}
settings.project = second
answer({"own": modifiers[("Surface", False)], "linked": modifiers[("Surface", True)], "other": modifiers[("Other", False)],
        "visible": [c.visible for c in settings.classes]})
""",
        project=make_project(tmp_path / "capture"),
        second=make_posed_project(tmp_path / "second"),
        file=str(tmp_path / "library.blend"),
    )
    assert (facts["own"], facts["linked"], facts["other"]) == (1, 0, 0)
    assert facts["visible"]
    assert all(facts["visible"])


def test_the_surface_stays_split_as_it_was_chosen(bpy_script, package, tmp_path):
    facts = bpy_script(
        SETUP
        + """
from fieldwork.addon.jobs.queue import queue
from fieldwork.operators import scene as scenes
chosen = []
scenes.import_steps = lambda job, cameras, scene, split: chosen.append([cameras, split])
queue.follow_up = lambda job: job.on_done(job)
class Done:
    project, verb, state, result, params, warnings = Path(project), "mesh", "done", {"folder": package}, {}, []
queue.make = lambda verb, params, then: type("Made", (Done,), {"on_done": staticmethod(then)})()
settings.project = project
scenes.update_scene(Done(), scene, always=True)
settings.scene_split, settings.scene_cameras = "classes", "many"
scenes.update_scene(Done(), scene, always=True)
answer(chosen)
""",
        project=make_posed_project(tmp_path / "capture"),
        package=package,
    )
    assert facts == [["both", "none"], ["many", "classes"]]
