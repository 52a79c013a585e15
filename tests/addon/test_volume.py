"""The baked field as a volume of OpenVDB, read by Blender's own library and rendered by Cycles."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from fieldwork.nerfcore.export.vdb import Grid, write_vdb
from fieldwork.tests.addon.rendered import START, ball

__all__ = ["ball"]

# Values of a grid where Blender's library finds them: it makes a point of each voxel, from 5.0 on.
READ = """
def read(path):
    volume = bpy.data.volumes.new("read")
    volume.filepath = path
    loaded = volume.grids.load()
    grids = {g.name: [g.data_type, [list(row) for row in g.matrix_object], g.load()] for g in volume.grids}
    return {"loaded": [loaded, volume.grids.error_message], "grids": grids}
"""


def test_grids_are_read_by_blender_with_their_places(bpy_script, tmp_path: Path) -> None:
    """Points far apart, in more than one of the largest nodes; the surface around single voxels is where they are."""
    places = np.array([[1, 2, 3], [130, 7, 8], [4100, 9, 4099], [8, 8, 8]])
    matrix = np.diag([0.5, 0.25, 2.0, 1.0])
    matrix[:3, 3] = 1, -2, 3
    values = np.array([1, 0.9, 0.8, 0.7], np.float32)
    colors = np.arange(12, dtype=np.float32).reshape(4, 3)
    write_vdb(
        tmp_path / "a.vdb",
        [Grid("density", places, values), Grid("color", places, colors), Grid("class_Wand ü", places[:2], values[:2])],
        matrix,
        {"label_revision": 3},
    )
    facts = bpy_script(
        READ
        + """
found = read(folder + "/a.vdb")
# The corners of the surface that Blender finds around the voxels.
mesh_object = bpy.data.objects.new("m", bpy.data.meshes.new("m"))
holder = bpy.data.objects.new("v", bpy.data.volumes["read"])
for item in (mesh_object, holder):
    bpy.context.scene.collection.objects.link(item)
modifier = mesh_object.modifiers.new("m", "VOLUME_TO_MESH")
modifier.object, modifier.threshold, modifier.grid_name = holder, 0.35, "density"
mesh = mesh_object.evaluated_get(bpy.context.evaluated_depsgraph_get()).to_mesh()
found["vertices"] = [list(v.co) for v in mesh.vertices]
answer(found)
""",
        folder=tmp_path,
    )
    assert facts["loaded"] == [True, ""]
    assert set(facts["grids"]) == {"density", "color", "class_Wand ü"}
    assert [facts["grids"][name][0] for name in ("density", "color")] == ["FLOAT", "VECTOR_FLOAT"]
    for _, found, loaded in facts["grids"].values():
        assert loaded
        assert found == pytest.approx(matrix)
    vertices = np.array(facts["vertices"])
    for place, value in zip(places, values):
        world = matrix[:3, :3] @ place + matrix[:3, 3]
        near = np.abs(vertices - world) <= np.diag(matrix)[:3]
        around = vertices[near.all(1)]
        assert len(around) >= 6, place
        assert around.mean(0) == pytest.approx(world, abs=1e-3)
        # The value falls to the threshold on the way to the next voxel; a corner lies amid three such places.
        reach = np.abs(around - world).max(0) / np.diag(matrix)[:3]
        assert reach == pytest.approx([(1 - 0.35 / value) / 3] * 3, abs=1e-3)


RENDERED = (
    START
    + READ
    + """
bpy.ops.fieldwork.export(to="vdb")
volume = next(o for o in scene.objects if o.type == "VOLUME")
facts = {"name": volume.name, "grids": sorted(read(volume.data.filepath)["grids"]), "file": volume.data.filepath}
bpy.ops.fieldwork.export(to="vdb")
facts["volumes"] = len([o for o in scene.objects if o.type == "VOLUME"])
volume.data.grids.load()
facts["box"] = [list(corner) for corner in volume.bound_box]
camera.location, camera.rotation_euler = (0, -3, 0), (math.pi / 2, 0, 0)
render.resolution_percentage = 50
field = passes(shoot())
render.engine = "CYCLES"
scene.cycles.device, scene.cycles.samples, scene.cycles.use_denoising = "CPU", 16, False
scene.cycles.volume_step_rate = 0.5
volume.data.render.step_size = 0.0
for obj in list(scene.objects):
    if obj.type not in ("VOLUME", "CAMERA"):
        bpy.data.objects.remove(obj)
found = passes(shoot("cycles"))
spots = {"above": (14, 30), "below": (26, 30), "beside": (3, 3)}
for name, there in (("field", field), ("cycles", found)):
    facts[name] = {n: [float(there[f"Combined.{c}"][y, x]) for c in "RGBA"] for n, (y, x) in spots.items()}
difference = [np.abs(found[f"Combined.{c}"] - field[f"Combined.{c}"]).mean() for c in "RGB"]
facts["difference"] = float(np.mean(difference))
facts["alpha"] = float(np.abs(found["Combined.A"] - field["Combined.A"]).mean())
answer(facts)
"""
)


@pytest.mark.slow
def test_the_volume_of_a_field_looks_like_it_in_cycles(bpy_script, ball: Path, tmp_path: Path) -> None:
    import shutil

    project = Path(shutil.copytree(ball, tmp_path / "ball"))
    facts = bpy_script(RENDERED, project=project, folder=tmp_path)
    assert facts["grids"] == ["class_bottom", "class_top", "color", "density"]
    assert facts["volumes"] == 1, "written again, it is the same object"
    corners = np.array(facts["box"])
    assert 0.45 < np.abs(corners).max() < 1.0
    assert facts["cycles"]["beside"][3] < 0.05
    assert facts["cycles"]["above"][3] > 0.9
    assert facts["difference"] < 0.03
    assert facts["alpha"] < 0.05
