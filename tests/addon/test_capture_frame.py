"""A capture that was moved, turned or scaled in the scene, and scenes in other units than metres."""

from __future__ import annotations

import json

import numpy as np
import pytest
from fieldwork.tests.addon.support import SETUP, make_posed_project
from fieldwork.tests.addon.test_mesh_import import make_package

MOVED = """
from mathutils import Euler, Matrix, Vector
root = bpy.data.objects.new("capture", None)
root["fieldwork_role"], root["fieldwork_project"] = "root", "capture"
scene.collection.objects.link(root)
root.location, root.scale, root.rotation_euler = (5, -3, 2), (2, 2, 2), (0.3, 0.2, 1.0)
bpy.context.view_layer.update()
settings.project = project
"""


def test_cameras_points_and_region_are_those_of_the_capture(bpy_script, tmp_path):
    facts = bpy_script(
        SETUP
        + MOVED
        + """
from fieldwork.addon.project import region, snapshot
from fieldwork.operators.render import write_cameras
# A camera, two points and a box, each given in the capture and put where they appear in the scene.
pose = Matrix.LocRotScale(Vector((1, 2, 3)), Euler((1.1, 0.2, 0.4)), None)
scene.camera.matrix_world = root.matrix_world @ pose
bpy.context.view_layer.update()
file = Path(project, "cameras.json")
for _ in write_cameras(file, scene, False, (100, 50), snapshot.owner(Path(project))):
    pass
frame = json.loads(file.read_text())["frames"][0]
settings.point_a, settings.point_b = (root.matrix_world @ Vector(p) for p in ((1, 0, 0), (1, 2, 0)))
settings.distance = 5.0
class Operator:
    use_scale, ground, gps, crop, project = True, False, False, "", ""
    value = lambda self, context, name: getattr(context.scene.fieldwork, name)
    project_path = lambda self, context: project
params = bpy.types.FIELDWORK_OT_align.parameters(Operator(), bpy.context)
box = region.add(scene, [[0, 0, 0], [1, 2, 4]])
bpy.context.view_layer.update()
bounds = region.bounds_of(scene, box)
root.location.x += 10
bpy.context.view_layer.update()
answer({"frame": frame["transform_matrix"], "pose": [list(r) for r in pose], "scale": params["scale"],
        "bounds": bounds, "moved along": region.bounds_of(scene, box)})
""",
        project=make_posed_project(tmp_path / "capture"),
    )
    for mine, true in zip(facts["frame"], facts["pose"]):
        assert mine == pytest.approx(true, abs=1e-5)
    a, b, metres = facts["scale"]
    assert [float(v) for v in a.split(",")] == pytest.approx([1, 0, 0], abs=1e-5)
    assert [float(v) for v in b.split(",")] == pytest.approx([1, 2, 0], abs=1e-5)
    assert metres == pytest.approx(5.0)
    for found in (facts["bounds"], facts["moved along"]):
        assert found[0] == pytest.approx([0, 0, 0], abs=1e-5)
        assert found[1] == pytest.approx([1, 2, 4], abs=1e-5)


@pytest.mark.parametrize("metres", [1.0, 0.01, 0.3048])
def test_a_metre_is_a_metre_in_every_unit(bpy_script, tmp_path, metres):
    facts = bpy_script(
        SETUP
        + """
from fieldwork.addon.scene.build import import_steps, load
scene.unit_settings.scale_length = metres
for _ in range(2):
    steps = import_steps(scene, load(folder))
    while True:
        try:
            next(steps)
        except StopIteration as end:
            imported = end.value
            break
bpy.context.view_layer.update()
mesh = imported.mesh
width = max((mesh.matrix_world @ v.co).x for v in mesh.data.vertices)
camera = imported.cameras[0].data
answer({"width": width * metres, "scale": list(imported.root.scale),
        "clip": [camera.clip_start * metres, camera.clip_end * metres]})
""",
        folder=make_package(tmp_path / "package", 20, cameras=3, points=50),
        metres=metres,
    )
    assert facts["width"] == pytest.approx(0.95, rel=1e-4)
    assert facts["scale"] == pytest.approx([1 / metres] * 3, rel=1e-4)
    assert facts["clip"] == pytest.approx([0.01, 1000], rel=1e-4)


@pytest.mark.parametrize("size", [1e-3, 1.0, 1e4])
def test_cameras_show_all_of_a_capture_however_small_or_large(bpy_script, tmp_path, size):
    folder = make_package(tmp_path / "package", 20, cameras=3, points=50)
    package = json.loads((folder / "package.json").read_text())
    for camera in package["cameras"]:
        for row in camera["camera_to_world"][:3]:
            row[3] *= size
    (folder / "package.json").write_text(json.dumps(package))
    for name, key in (("points.npz", "xyz"), ("mesh.npz", "vertices")):
        arrays = dict(np.load(folder / name))
        np.savez(folder / name, **{**arrays, key: arrays[key] * np.float32(size)})
    facts = bpy_script(
        SETUP
        + """
from fieldwork.addon.child.package import _show_colors
from fieldwork.addon.scene.build import import_package
from fieldwork.addon.scene.cameras import clip_range
from fieldwork.addon.scene.package import read_package
package = read_package(folder)
imported = import_package(scene, package)
depths = []
for camera in imported.cameras:
    away = [(v.co - camera.location).length for v in imported.mesh.data.vertices]
    depths.append([camera.data.clip_start, min(away), max(away), camera.data.clip_end])
camera = imported.cameras[1].data
camera.clip_end = 77
import_package(scene, package)
_show_colors(imported, clip_range(package))
space = next(s for screen in bpy.data.screens for a in screen.areas for s in a.spaces if s.type == "VIEW_3D")
answer({"depths": depths, "chosen": camera.clip_end, "view": [space.clip_start, space.clip_end]})
""",
        folder=folder,
    )
    for depths in [*facts["depths"], [facts["view"][0], *facts["depths"][0][1:3], facts["view"][1]]]:
        assert depths == sorted(depths)
    assert facts["chosen"] == 77
    if size == 1:
        assert facts["view"] == pytest.approx([0.01, 1000])


def test_the_limit_of_a_comparison_is_in_the_units_of_the_scene(bpy_script, tmp_path):
    facts = bpy_script(
        SETUP
        + """
class Operator:
    value = lambda self, context, name: getattr(settings, bpy.types.FIELDWORK_OT_compare.scene_names[name])
    path = lambda self, context, name: project
    project_path = lambda self, context: project
scene.unit_settings.scale_length = 0.01
seen = []
for limit in (0.0, 25.0):
    settings.compare_limit = limit
    seen.append(bpy.types.FIELDWORK_OT_compare.parameters(Operator(), bpy.context)["limit"])
answer(seen)
""",
        project=make_posed_project(tmp_path / "capture"),
    )
    assert facts == [None, pytest.approx(0.25)]
