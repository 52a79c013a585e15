"""The materials of a labelled mesh: one for each class, unlit, their colour by the shared group (see look.py)."""

from __future__ import annotations

from typing import Any

import bpy

from ..roles import ROLE, Owner
from .look import may_follow, slider_of
from .owned import find

PARTS = ("void", "points", "volume")  # that are no classes and have a material, see points.py and volume.py


def srgb_to_linear(value: float) -> float:
    """One sRGB channel in [0, 1] as linear light (IEC 61966-2-1)."""
    return value / 12.92 if value <= 0.04045 else ((value + 0.055) / 1.055) ** 2.4


def find_material(
    owner: Owner, label: str, root: bpy.types.Object | None, is_class: bool = True
) -> bpy.types.Material | None:
    """The material of the class or, if it is none, of the part that is called `label`, under this parent, marked as the
    project's; None when there is none yet."""

    def found(role: str) -> Any:
        return find(bpy.data.materials, owner, role, f"{owner.name} · {label}", lambda material: _fits(material, root))

    material = found(_role(label, is_class))
    if material is None and is_class and label not in PARTS:
        material = found(_role(label, False))  # classes were marked like parts at first
        if material is not None:
            owner.mark(material, _role(label, is_class))
    return material


def _fits(material: bpy.types.Material, root: bpy.types.Object | None) -> bool:
    """Whether a material may be used under this parent: its colour does not follow the slider of another scene."""
    chooser = _chooser(material)
    return chooser is None or chooser.node_tree is None or may_follow(chooser.node_tree, root)


def _role(label: str, is_class: bool) -> str:
    return f"class material:{label}" if is_class else f"material:{label}"


def label_of(material: bpy.types.Material) -> str:
    """What a material is of; its name where that is not known."""
    return str(material[ROLE]).partition(":")[2] if ROLE in material else material.name


def make_material(
    owner: Owner, label: str, color: list[float], group: Any, is_class: bool = True
) -> bpy.types.Material:
    """The material of a class or part (see `find_material`): `color` is sRGB in [0, 1]. One that the project has is given
    the colour anew."""
    material = find_material(owner, label, slider_of(group), is_class)
    linear = (*(srgb_to_linear(channel) for channel in color), 1.0)
    if material is None:
        material = bpy.data.materials.new(f"{owner.name} · {label}")
        owner.mark(material, _role(label, is_class))
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
    chooser = _chooser(material)
    if chooser is not None:  # else the user made another material of it
        chooser.node_tree = group
        chooser.inputs[0].default_value = linear
    material.diffuse_color = linear
    return material


def _chooser(material: bpy.types.Material) -> Any:
    """The node that chooses the colour to show; None where the user took it away."""
    nodes = material.node_tree.nodes if material.node_tree is not None else ()
    return next((node for node in nodes if _is_ours(node)), None)


def _is_ours(node: bpy.types.Node) -> bool:
    """Whether a node is the one that chooses the colour to show."""
    return node.type == "GROUP" and (node.node_tree is None or str(node.node_tree.get(ROLE, "")).startswith("colors:"))
