"""Points of the capture under the mouse."""

from __future__ import annotations

import pytest


def test_points_are_found_where_blender_draws_them(bpy_script):
    facts = bpy_script(
        """
import numpy as np
import fieldwork
fieldwork.register()
from bpy_extras.object_utils import world_to_camera_view
from mathutils import Vector
from fieldwork.addon.scene.picking import project
scene, camera = bpy.context.scene, bpy.context.scene.camera
scene.render.resolution_x, scene.render.resolution_y = 200, 100
depsgraph = bpy.context.evaluated_depsgraph_get()
matrix = camera.calc_matrix_camera(depsgraph, x=200, y=100) @ camera.matrix_world.inverted()
places = np.array([[0, 0, 0], [1, 0.5, -0.3], [40, -40, 30]], np.float32)
seen = project(places, np.array(matrix), 200, 100)
want = [list(world_to_camera_view(scene, camera, Vector(p))) for p in places.tolist()]
answer({"seen": [[x if np.isfinite(x) else None for x in row] for row in seen.tolist()], "want": want})
"""
    )
    for (x, y, depth), (u, v, z) in zip(facts["seen"][:2], facts["want"][:2]):
        assert [x, y] == pytest.approx([200 * u, 100 * v], abs=0.01)
        assert depth == pytest.approx(z, rel=1e-4)
    assert facts["seen"][2][2] < 0, "behind the camera"
    assert facts["seen"][2][0] is None
