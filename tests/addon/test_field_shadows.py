"""Shadows that Blender's objects cast on a field."""

from __future__ import annotations

import numpy as np
import pytest
from fieldwork.tests.addon.rendered import ball
from fieldwork.tests.addon.test_field_with_objects import START

__all__ = ["ball"]


LIGHT = """
sun = bpy.data.objects.new("sun", bpy.data.lights.new("sun", "SUN"))
sun.data.energy, sun.data.angle = 3.0, 0.0
scene.collection.objects.link(sun)  # it shines downwards
scene.world.use_nodes = True
scene.world.node_tree.nodes["Background"].inputs["Strength"].default_value = 0.0
roof = plate("roof", (1, 1, 1), [(0, -1, 1.2), (1, -1, 1.2), (1, 1, 1.2), (0, 1, 1.2)])
roof.visible_camera = False
render.resolution_x, render.resolution_y = 90, 60
scene.cycles.samples = 64
"""


def test_surfaces_in_instances_catch_shadows(bpy_script, tmp_path):
    """Those that another file has are that file's to change: a sentence says so."""
    facts = bpy_script(
        """
import fieldwork
fieldwork.register()
from fieldwork.addon.errors import SceneError
from fieldwork.addon.live import shadows
scene = bpy.context.scene
def instance(collection):
    held = bpy.data.collections.new("held")
    scene.collection.children.link(held)
    empty = bpy.data.objects.new("empty", None)
    empty.instance_type, empty.instance_collection = "COLLECTION", collection
    held.objects.link(empty)
    return held
surface = bpy.data.objects.new("surface", bpy.data.meshes.new("surface"))
surface["fieldwork_role"] = "mesh"
inner, outer = (bpy.data.collections.new(name) for name in ("inner", "outer"))
inner.objects.link(surface)
outer.objects.link(bpy.data.objects.new("inside", None))
outer.objects["inside"].instance_type, outer.objects["inside"].instance_collection = "COLLECTION", inner
held = instance(outer)
scene.render.engine = "BLENDER_EEVEE"
shadows.catch(scene)
made = shadows.set_up(scene)
layer = bpy.context.view_layer.layer_collection.children[held.name]
facts = [surface.is_shadow_catcher, made.view_layers[0].cycles.use_pass_shadow_catcher, layer.holdout]
surface.is_shadow_catcher = False
bpy.data.libraries.write(f"{folder}/other.blend", {inner})
for collection in (inner, outer, held):
    bpy.data.collections.remove(collection)
bpy.data.objects.remove(surface)
with bpy.data.libraries.load(f"{folder}/other.blend", link=True) as (there, linked):
    linked.collections = ["inner"]
instance(linked.collections[0])
try:
    shadows.catch(scene)
except SceneError as error:
    facts.append(str(error))
answer(facts)
""",
        folder=tmp_path,
    )
    assert facts[:3] == [True, True, True]
    assert "“surface” is linked" in facts[3]
    assert "other.blend" in facts[3]


@pytest.mark.slow
def test_shadows_of_objects_lie_on_the_field(bpy_script, ball, tmp_path):
    """The surface of the capture as a shadow catcher: a roof over the right half of the ball darkens that half only."""
    facts = bpy_script(
        START
        + """
for obj in [o for o in scene.objects if o.type in ("MESH", "LIGHT")]:
    bpy.data.objects.remove(obj)
bpy.ops.mesh.primitive_uv_sphere_add(radius=0.5, segments=64, ring_count=32)
surface = bpy.context.object
surface["fieldwork_role"], surface.is_shadow_catcher = "mesh", True
"""
        + LIGHT
        + """
found = {}
for name, hidden in (("lit", True), ("shadow", False)):
    roof.hide_render = hidden
    bpy.ops.fieldwork.setup_compositor()
    picture = shoot(name)
    # 30 pixels are 0.48 at the distance of the ball: its upper left and upper right
    found[name] = [picture[14:20, 30:38, :3].mean().item(), picture[14:20, 52:60, :3].mean().item()]
answer(found)
""",
        project=ball,
        folder=tmp_path,
    )
    left, right = zip(facts["lit"], facts["shadow"])
    assert left[0] > 0.05
    assert right[0] > 0.05
    assert left[1] == pytest.approx(left[0], abs=0.02), "beside the shadow it is as before"
    assert right[1] < 0.5 * right[0], "the field is dark where the roof hides the sun"


@pytest.mark.slow
@pytest.mark.parametrize("engine", ["CYCLES", "EEVEE"])
def test_one_button_lets_the_surface_catch_shadows(bpy_script, ball, tmp_path, engine):
    """Shadows lie on the field, also before objects that are behind it; these are hidden, what is in front is not."""
    facts = bpy_script(
        START
        + """
for obj in [o for o in scene.objects if o.type in ("MESH", "LIGHT") and o.name not in ("before", "behind")]:
    bpy.data.objects.remove(obj)
bpy.data.objects["behind"].location.z = -0.7
"""
        + LIGHT
        + """
from fieldwork.addon.live import compositor
facts = {"no surface": attempt(bpy.ops.fieldwork.catch_shadows)}
bpy.ops.mesh.primitive_uv_sphere_add(radius=0.5, segments=64, ring_count=32)
surface = bpy.context.object
surface["fieldwork_role"] = "mesh"
from fieldwork.addon.roles import Owner
from fieldwork.addon.scene import look, materials
owner, root = Owner("capture", "1"), bpy.data.objects.new("root", None)
look.set_switch(root)
surface.data.materials.append(materials.make_material(owner, "one", [1, 1, 1], look.shader_group(owner, "mesh", root)))
capture = bpy.data.collections.new("capture")
scene.collection.children.link(capture)
for collection in surface.users_collection:
    collection.objects.unlink(surface)
capture.objects.link(surface)
surface.hide_render = True
if engine == "EEVEE":
    render.engine = "BLENDER_EEVEE" if bpy.app.version >= (5, 0) else "BLENDER_EEVEE_NEXT"
    scene.eevee.taa_render_samples = 32
for _ in range(2):
    facts["pressed"] = attempt(bpy.ops.fieldwork.catch_shadows)
output = surface.active_material.node_tree.get_output_node
facts["shown"] = [output(engine).inputs["Surface"].links[0].from_node.type for engine in ("CYCLES", "EEVEE")]
tree, _ = compositor.tree_of(scene)
facts["scenes"], facts["layers"] = len(bpy.data.scenes), len([n for n in tree.nodes if n.type == "R_LAYERS"])
for name, hidden in (("lit", True), ("shadow", False)):
    roof.hide_render = hidden
    np.save(f"{folder}/{name}.npy", shoot(name))
# Without the catcher, and in Cycles again.
surface.hide_render, roof.hide_render = True, True
facts["composited"] = attempt(bpy.ops.fieldwork.setup_compositor)
facts["without"] = len([n for n in tree.nodes if n.type == "R_LAYERS"])
np.save(f"{folder}/plain.npy", shoot("plain"))
render.engine = "CYCLES"
bpy.ops.fieldwork.catch_shadows()
facts["held"] = bpy.context.view_layer.layer_collection.children["capture"].holdout
answer(facts)
""",
        project=ball,
        folder=tmp_path,
        engine=engine,
    )
    assert "no surface" in facts["no surface"]
    assert facts["pressed"] == ["FINISHED"]
    assert facts["scenes"] == facts["layers"] == (2 if engine == "CYCLES" else 3), "however often it is pressed"
    assert facts["without"] == 2
    assert facts["shown"] == ["MIX_SHADER", "EMISSION"], "other engines show the photos' colours"
    assert not facts["held"]
    lit, shadow, plain = (np.load(tmp_path / f"{name}.npy") for name in ("lit", "shadow", "plain"))
    # 30 pixels are 0.48 at the distance of the ball.
    left, right, before = np.s_[14:20, 30:38], np.s_[14:20, 54:60], np.s_[34:37, 26:30]
    for place in (left, right):
        assert plain[place][..., 3].min() > 0.95
        assert np.abs(lit[place][..., :3] - plain[place][..., :3]).max() < 0.03
    assert shadow[left][..., :3].mean() == pytest.approx(lit[left][..., :3].mean(), abs=0.02)
    assert shadow[right][..., :3].mean() < 0.5 * lit[right][..., :3].mean()
    assert shadow[right][..., 3].min() > 0.95
    for picture in (lit, shadow):
        within = np.s_[24:40, 46:70, :3]  # light and shadow of the sun meet there
        assert (picture[within] - plain[within]).max() < 0.03, "nothing is brighter"
        assert picture[before][..., :3] == pytest.approx(np.broadcast_to((0.9, 0.2, 0.1), (3, 4, 3)), abs=0.05)
        assert (np.abs(picture[..., :3] - (0.2, 0.9, 0.2)).max(-1) < 0.05).sum() > 200, "beside the field"
        assert (np.abs(picture[20:30, 35:40, :3] - (0.2, 0.9, 0.2)).max(-1) < 0.05).sum() == 0, "behind the field"
