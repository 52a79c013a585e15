"""Shadows that Blender's objects cast on a field."""

from __future__ import annotations

import pytest
from fieldwork.tests.addon.rendered import ball
from fieldwork.tests.addon.test_field_with_objects import START

__all__ = ["ball"]


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
sun = bpy.data.objects.new("sun", bpy.data.lights.new("sun", "SUN"))
sun.data.energy, sun.data.angle = 3.0, 0.0
scene.collection.objects.link(sun)  # it shines downwards
scene.world.use_nodes = True
scene.world.node_tree.nodes["Background"].inputs["Strength"].default_value = 0.0
roof = plate("roof", (1, 1, 1), [(0, -1, 1.2), (1, -1, 1.2), (1, 1, 1.2), (0, 1, 1.2)])
roof.visible_camera = False
render.resolution_x, render.resolution_y = 90, 60
scene.cycles.samples = 64
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
