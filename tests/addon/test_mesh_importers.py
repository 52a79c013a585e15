"""Mesh files in Blender, through its own importers: places, colours and classes as they were written."""

from __future__ import annotations

import numpy as np
import pytest
from fieldwork.nerfcore.mesh.files import write_surface
from fieldwork.tests.nerfcore.support import painted_box as box
from skimage.color import deltaE_ciede2000, rgb2lab

IMPORT = """
import addon_utils
import numpy as np
def srgb(linear):
    linear = np.clip(linear, 0, 1)
    return np.where(linear <= 0.0031308, linear * 12.92, 1.055 * linear ** (1 / 2.4) - 0.055)
def shown(mesh):
    # The sRGB colours (3F, 3) of a mesh's corners: its texture's at their places, else its colour attribute's.
    images = [n.image for m in mesh.materials for n in m.node_tree.nodes if n.type == "TEX_IMAGE"]
    corners = [corner.vertex_index for corner in mesh.loops]
    if images:
        assert {image.colorspace_settings.name for image in images} == {"sRGB"}
        width, height = images[0].size
        pixels = np.array(images[0].pixels[:]).reshape(height, width, 4)
        uv = np.array([corner.uv for corner in mesh.uv_layers[0].data])
        x, y = (uv % 1 * [width, height]).astype(int).T
        return pixels[y, x, :3]
    if not len(mesh.color_attributes):
        return np.zeros((len(corners), 3))
    colors = mesh.color_attributes[0]
    values = srgb(np.array([item.color[:3] for item in colors.data]))
    return values if colors.domain == "CORNER" else values[corners]
found = {}
for path in paths:
    bpy.ops.wm.read_factory_settings(use_empty=True)
    addon_utils.enable("io_scene_gltf2")
    kind = path.rsplit(".", 1)[1]
    operators = {"glb": bpy.ops.import_scene.gltf, "obj": bpy.ops.wm.obj_import, "ply": bpy.ops.wm.ply_import,
                 "stl": bpy.ops.wm.stl_import}
    more = {"use_split_groups": True} if kind == "obj" else {}
    operators.get(kind, bpy.ops.wm.usd_import)(filepath=path, **more)
    bpy.context.view_layer.update()
    entry = found[path] = {"places": [], "colors": [], "classes": [], "names": []}
    for item in bpy.data.objects:
        if item.type == "MESH":
            mesh = item.data
            world = [list(item.matrix_world @ v.co) for v in mesh.vertices]
            entry["places"] += [[world[v] for v in face.vertices] for face in mesh.polygons]
            entry["colors"] += np.asarray(shown(mesh)).reshape(-1, 3, 3).tolist()
            entry["names"] += [item.name] * len(mesh.polygons)
            if "class_id" in mesh.attributes and mesh.attributes["class_id"].domain == "FACE":
                entry["classes"] += [value.value for value in mesh.attributes["class_id"].data]
answer(found)
"""


@pytest.mark.parametrize("textured", [True, False])
def test_what_was_written_is_what_blender_shows(tmp_path, bpy_script, textured):
    texture = box.texture() if textured else None
    paths = [
        write_surface(tmp_path / f"Kugel ü.{kind}", box.surface(), box.features(), split, texture)[0]
        for kind, split in (
            ("glb", "instances"),
            ("obj", "none"),
            ("ply", "none"),
            ("stl", "none"),
            ("usdc", "none"),
            ("usdz", "none"),
        )
    ]
    found = bpy_script(IMPORT, paths=[str(path) for path in paths])
    ours = box.surface().vertices[box.surface().faces]
    rows = box.features()
    for path in paths:
        entry, kind = found[str(path)], path.suffix
        places = np.array(entry["places"])
        assert places.shape == (12, 3, 3)
        # Corners may begin elsewhere in a triangle.
        order, turn = zip(
            *(
                np.unravel_index(
                    np.argmin([[np.abs(np.roll(o, k, 0) - p).max() for k in range(3)] for o in ours]), (12, 3)
                )
                for p in places
            )
        )
        assert sorted(order) == list(range(12))
        for p, o, k in zip(places, order, turn):
            np.testing.assert_allclose(p, np.roll(ours[o], k, 0), atol=1e-5)
        if kind == ".stl":
            continue
        true = np.repeat(box.face_colors()[:, None], 3, 1)
        if not textured or kind == ".ply":
            true = box.surface().colors[box.surface().faces]
        true = np.array([np.roll(true[o], k, 0) for o, k in zip(order, turn)]) / 255
        difference = deltaE_ciede2000(rgb2lab(true), rgb2lab(np.array(entry["colors"])))
        assert difference.max() <= 1, f"{kind}: ΔE {difference.max():.2f}"
        if kind in (".glb", ".obj"):
            names = [rows.rows[rows.face[o]].name for o in order]
            assert [n.replace("_", " ") for n in entry["names"]] == names
        if kind.startswith(".usd"):
            assert entry["classes"] == box.FACE_CLASS[list(order)].tolist()
