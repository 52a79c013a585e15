"""The materials of a labelled mesh: photo colour or class colour, unlit, switched by one property of the parent."""

from __future__ import annotations

from typing import Any

import bpy

from ..roles import Owner
from .owned import find

SWITCH = "show_labels"  # custom property of the parent empty: 0 photo colour, 1 class colour
COLOR_ATTRIBUTE = "Color"


def srgb_to_linear(value: float) -> float:
    """One sRGB channel in [0, 1] as linear light (IEC 61966-2-1)."""
    return value / 12.92 if value <= 0.04045 else ((value + 0.055) / 1.055) ** 2.4


def make_group(
    owner: Owner, part: str, root: bpy.types.Object, texture: bpy.types.Image | None = None
) -> bpy.types.NodeTree:
    """The node group shared by all classes of a part ("mesh" or "points"): class colour in, the colour to show out,
    switched by `root`.

    The colour of the photos is that of `texture` by the mesh's UVs, or without one that of its colour attribute. One
    that the project has already is built anew.
    """
    name, role = f"Fieldwork · {owner.name}" + (" · points" if part == "points" else ""), f"colors:{part}"
    tree = find(bpy.data.node_groups, owner, role, name)
    if tree is None:
        tree = bpy.data.node_groups.new(name, "ShaderNodeTree")
        owner.mark(tree, role)
        tree.interface.new_socket("Class Color", in_out="INPUT", socket_type="NodeSocketColor")
        tree.interface.new_socket("Color", in_out="OUTPUT", socket_type="NodeSocketColor")
    tree.animation_data_clear()
    nodes = tree.nodes
    nodes.clear()
    given, result = nodes.new("NodeGroupInput"), nodes.new("NodeGroupOutput")
    if texture is None:
        photo = nodes.new("ShaderNodeAttribute")
        photo.attribute_name = COLOR_ATTRIBUTE
    else:
        photo = nodes.new("ShaderNodeTexImage")
        photo.image = texture
    switch = nodes.new("ShaderNodeValue")
    mix = nodes.new("ShaderNodeMix")
    mix.data_type = "RGBA"
    # The Mix node has sockets for every data type; the colour ones are inputs 6 and 7 and output 2.
    for start, end in (
        (switch.outputs[0], mix.inputs[0]),
        (photo.outputs["Color"], mix.inputs[6]),
        (given.outputs[0], mix.inputs[7]),
        (mix.outputs[2], result.inputs[0]),
    ):
        tree.links.new(start, end)
    for column, node in enumerate((given, photo, switch, mix, result)):
        node.location = (260 * column, 0)
    driver = switch.outputs[0].driver_add("default_value").driver
    driver.type = "AVERAGE"  # a plain copy: needs no script execution
    variable = driver.variables.new()
    variable.type = "SINGLE_PROP"
    variable.targets[0].id = root
    variable.targets[0].data_path = f'["{SWITCH}"]'
    return tree


def make_material(owner: Owner, label: str, color: list[float], group: Any) -> bpy.types.Material:
    """The material of what is called `label`: `color` is sRGB in [0, 1]. One that the project has is given the colour
    anew."""
    name, role = f"{owner.name} · {label}", f"material:{label}"
    material = find(bpy.data.materials, owner, role, name)
    linear = (*(srgb_to_linear(channel) for channel in color), 1.0)
    if material is None:
        material = bpy.data.materials.new(name)
        owner.mark(material, role)
        material.use_nodes = True
        tree = material.node_tree
        tree.nodes.clear()
        chooser = tree.nodes.new("ShaderNodeGroup")
        chooser.node_tree = group
        # Light is in the photos already: an unlit surface looks as they do.
        emission = tree.nodes.new("ShaderNodeEmission")
        output = tree.nodes.new("ShaderNodeOutputMaterial")
        tree.links.new(chooser.outputs[0], emission.inputs[0])
        tree.links.new(emission.outputs[0], output.inputs[0])
        for column, node in enumerate((chooser, emission, output)):
            node.location = (220 * column, 0)
    chooser = next(node for node in material.node_tree.nodes if node.type == "GROUP")
    chooser.node_tree = group
    chooser.inputs[0].default_value = linear
    material.diffuse_color = linear
    return material
