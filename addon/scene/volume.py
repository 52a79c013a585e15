"""The baked field as a volume in the open scene: an object that Cycles and EEVEE render, of a file of OpenVDB."""

from __future__ import annotations

from pathlib import Path

import bpy

from ..roles import Owner, by_role
from .frame import root_of, scene_from_capture
from .owned import VOLUME, find


def show(scene: bpy.types.Scene, owner: Owner, path: Path) -> bpy.types.Object:
    """The volume of a project in a scene, read from this file: a new object, or the one of before with the new file."""
    item = by_role(scene.objects, owner).get(VOLUME)
    if item is None or item.type != "VOLUME":
        item = bpy.data.objects.new(f"{owner.name} · volume", bpy.data.volumes.new(owner.name))
        owner.mark(item, VOLUME)
        scene.collection.objects.link(item)
        item.parent = root_of(scene, owner)
        if item.parent is None:
            item.matrix_world = scene_from_capture(scene, owner)
    item.data.filepath = str(path)
    item.data.grids.unload()
    material = volume_material(owner)
    if material.name not in item.data.materials:
        item.data.materials.append(material)
    return item


def volume_material(owner: Owner) -> bpy.types.Material:
    """Glows as the photos do and hides what is behind it: extinction from the grid `density`, light from `color`."""
    name = f"{owner.name} · volume"
    material = find(bpy.data.materials, owner, "material:volume", name)
    if material is not None:
        return material
    material = bpy.data.materials.new(name)
    owner.mark(material, "material:volume")
    material.use_nodes = True
    tree = material.node_tree
    tree.nodes.clear()
    density, color, absorption, emission, both, output = (
        tree.nodes.new(kind)
        for kind in (
            "ShaderNodeAttribute", "ShaderNodeAttribute", "ShaderNodeVolumeAbsorption", "ShaderNodeEmission",
            "ShaderNodeAddShader", "ShaderNodeOutputMaterial",
        )
    )  # fmt: skip
    density.attribute_name, color.attribute_name = "density", "color"
    factor = next(socket for socket in density.outputs if socket.identifier in ("Fac", "Factor"))
    # What is absorbed is a share of each channel: black is all of them.
    absorption.inputs[0].default_value = (0, 0, 0, 1)
    tree.links.new(factor, absorption.inputs[1])
    tree.links.new(color.outputs[0], emission.inputs[0])
    tree.links.new(factor, emission.inputs[1])
    tree.links.new(absorption.outputs[0], both.inputs[0])
    tree.links.new(emission.outputs[0], both.inputs[1])
    tree.links.new(both.outputs[0], next(socket for socket in output.inputs if socket.identifier == "Volume"))
    for node, place in ((density, 0), (color, 0), (absorption, 1), (emission, 1), (both, 2), (output, 3)):
        node.location = (220 * place, 200 if node in (density, absorption, both, output) else 0)
    return material
