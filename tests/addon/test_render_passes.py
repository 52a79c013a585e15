"""Passes and Cryptomattes of the render engine “Fieldwork”."""

from __future__ import annotations

import shutil

import numpy as np
import pytest
from fieldwork.tests.addon.rendered import START, ball

__all__ = ["ball"]

PASSES = (
    START
    + """
live.samples = 8
layer.use_pass_z = layer.use_pass_position = layer.use_pass_normal = True
layer.use_pass_cryptomatte_object = layer.use_pass_cryptomatte_material = layer.use_pass_cryptomatte_asset = True
own = layer.fieldwork
own.use_class_index = own.use_class_color = own.use_confidence = True
camera.location, camera.rotation_euler = (0, -2, 0), (math.pi / 2, 0, 0)
found = passes(shoot("passes"))
up, down = (28, 60), (52, 60)
depth = found["Depth.Z"]
facts = {
    "depth": float(depth[40, 60]), "far": float(depth[0, 0]),
    "index": [float(found["Class Index.X"][p]) for p in (up, down, (0, 0))],
    "color": [[float(found[f"Class Color.{c}"][p]) for c in "RGB"] for p in (up, down)],
    "confidence": [float(found["Confidence.X"][p]) for p in (up, (0, 0))],
    "normal": [float(found[f"Normal.{c}"][35:45, 55:65].mean()) for c in "XYZ"],
    "crypto": sorted(name for name in found if name.startswith("Crypto")),
}
import OpenImageIO as oiio
spec = oiio.ImageInput.open(f"{folder}/passes.exr").spec()
facts["metadata"] = {a.name: a.value for a in spec.extra_attribs if a.name.startswith("cryptomatte/")}
facts["revisions"] = {a.name: a.value for a in spec.extra_attribs if a.name.startswith("label_revision")}
np.savez(f"{folder}/mine.npz", **{n: v for n, v in found.items() if n.startswith("CryptoMaterial")})

# What Blender's own node makes of it, from the render and from the file.
def composited(source):
    if hasattr(scene, "compositing_node_group"):
        tree = scene.compositing_node_group = bpy.data.node_groups.new("matte", "CompositorNodeTree")
        tree.interface.new_socket("Image", in_out="OUTPUT", socket_type="NodeSocketColor")
        out = tree.nodes.new("NodeGroupOutput")
    else:
        scene.use_nodes = True
        tree = scene.node_tree
        tree.nodes.clear()
        out = tree.nodes.new("CompositorNodeComposite")
    node = tree.nodes.new("CompositorNodeCryptomatteV2")
    node.source = source
    if source == "RENDER":
        node.scene = scene
    else:
        node.image = bpy.data.images.load(f"{folder}/passes.exr")
    facts.setdefault("layers", {})[source] = [i.identifier for i in node.bl_rna.properties["layer_name"].enum_items] or node.layer_name
    node.layer_name = f"{layer.name}.CryptoMaterial"
    node.matte_id = "top"
    tree.links.new(node.outputs["Matte"], out.inputs[0])
    if hasattr(image, "media_type"):
        image.media_type = "IMAGE"
    image.file_format, image.color_mode, image.color_depth = "OPEN_EXR", "RGBA", "32"
    render.filepath = f"{folder}/{source}.exr"
    bpy.ops.render.render(write_still=True)
    source_file = oiio.ImageInput.open(f"{folder}/{source}.exr")
    return np.asarray(source_file.read_image(0, 0, 0, source_file.spec().nchannels, "float"))[..., 0]
np.savez(f"{folder}/blender.npz", render=composited("RENDER"), image=composited("IMAGE"))
answer(facts)
"""
)


def test_passes_and_cryptomatte_from_the_render_and_from_the_file(bpy_script, ball, tmp_path):
    from fieldwork.nerfcore.film.cryptomatte import id_of
    from fieldwork.nerfcore.project.runs import run_folder
    from fieldwork.nerfcore.render.run import load_info, save_info

    ball = shutil.copytree(ball, tmp_path / "ball")
    # As if its label maps were from the seventh revision of marks.
    save_info(run_folder(ball, "main"), load_info(ball, "main").model_copy(update={"map_revision": 7}))
    facts = bpy_script(PASSES, project=ball, folder=tmp_path)
    assert facts["revisions"] == {"label_revision/ball": "7"}
    assert facts["depth"] == pytest.approx(1.5, abs=0.08)
    assert facts["far"] == pytest.approx(1e10)
    assert facts["index"] == [1, 2, 0]
    assert facts["color"][0] == pytest.approx([0.604, 0.033, 0.033], abs=0.05)
    assert facts["color"][1][2] > 0.5
    assert facts["confidence"][0] > 0.8
    assert facts["confidence"][1] == 0
    assert facts["normal"] == pytest.approx([0, -0.9, 0], abs=0.25)
    assert len(facts["crypto"]) == 3 * 3 * 4
    manifests = [value for name, value in facts["metadata"].items() if name.endswith("manifest")]
    assert any('"top"' in value and '"bottom"' in value for value in manifests)
    assert any('"ball.top"' in value for value in manifests)
    mine, blender = np.load(tmp_path / "mine.npz"), np.load(tmp_path / "blender.npz")
    top = np.float32(id_of("top"))
    matte = sum(
        np.where(mine[f"CryptoMaterial{n:02}.{a}"] == top, mine[f"CryptoMaterial{n:02}.{b}"], 0)
        for n in range(3) for a, b in ("RG", "BA")
    )  # fmt: skip
    for source in ("render", "image"):
        found = blender[source]
        both, either = np.minimum(matte, found).sum(), np.maximum(matte, found).sum()
        assert either > 100
        assert both / either >= 0.99, source
