"""How the surface looks: photo colour, class colour or confidence, by one slider of the parent.

The slider is a custom property, copied into the node trees by drivers without scripts, so that it works in any file and
without this add-on. Cycles and EEVEE see the materials' shader group; Workbench, the solid viewport, draws a colour
attribute that a geometry-nodes modifier fills with the same blend.
"""

from __future__ import annotations

from typing import Any

import bpy

from ..roles import Owner
from .edited import WRITTEN, tree_fingerprint
from .own_look import TEXTURE
from .owned import find

SWITCH = "show_labels"  # custom property of the parent empty: 0 photo colour, 1 class colour, 2 confidence
SLIDER = f'["{SWITCH}"]'  # the way to it in drivers
COLOR_ATTRIBUTE = "Color"  # of the photos, at the vertices
CLASS_COLOR_ATTRIBUTE = "class_color"  # at the faces
CONFIDENCE_ATTRIBUTE = "confidence"  # at the vertices
SHOWN_ATTRIBUTE = "Shown"  # what Workbench draws, at the corners
MODIFIER = "Fieldwork Viewport Colors"
GROUP, VIEWPORT_GROUP = "Fieldwork Surface", "Fieldwork Viewport Colors"
FIRST_GROUP = "Fieldwork"  # what the shader group was called at first
# From unsure to sure, linear: viridis at quarters (van der Walt and Smith, 2015), which is even to the eye and safe for
# the colour-blind.
RAMP = (
    (0.0, (0.0584, 0.0004, 0.0887)),
    (0.25, (0.0423, 0.0839, 0.2582)),
    (0.5, (0.0147, 0.2832, 0.2623)),
    (0.75, (0.1078, 0.5870, 0.1248)),
    (1.0, (0.9838, 0.7990, 0.0185)),
)


def set_switch(root: bpy.types.Object) -> None:
    """Give a parent the slider, or one of before it knew confidence its present range."""
    root[SWITCH] = float(root.get(SWITCH, 0.0))
    root.id_properties_ui(SWITCH).update(
        min=0.0, max=2.0, description="0: colors of the photos, 1: class colors, 2: confidence of the classes"
    )


def slider_of(tree: bpy.types.NodeTree) -> bpy.types.Object | None:
    """The parent whose slider a node group follows; None where it follows none, or one that was deleted."""
    for curve in tree.animation_data.drivers if tree.animation_data else ():
        for variable in curve.driver.variables:
            if variable.targets[0].data_path == SLIDER:
                return variable.targets[0].id
    return None


def may_follow(tree: bpy.types.NodeTree, root: bpy.types.Object | None) -> bool:
    """Whether a node group may follow the slider of this parent: it does not follow that of another scene."""
    present = slider_of(tree)
    if present is None or present == root:
        return True
    return all(root is not None and scene in root.users_scene for scene in present.users_scene)


def shader_group(
    owner: Owner, part: str, root: bpy.types.Object, texture: bpy.types.Image | None = None
) -> bpy.types.NodeTree:
    """The shader group shared by all classes of a part ("mesh" or "points"): class colour in, the colour to show out.

    The colour of the photos is that of `texture` by the mesh's UVs, or without one that of its colour attribute. One
    that the project has already in the scene of `root` is built anew, unless the user changed its nodes.
    """
    ending = " · points" if part == "points" else ""
    role = f"colors:{part}"
    name = f"{FIRST_GROUP} · {owner.name}{ending}"
    tree = find(bpy.data.node_groups, owner, role, name, lambda tree: may_follow(tree, root))
    if tree is not None and tree.name.startswith(f"{FIRST_GROUP} · "):
        tree.name = f"{GROUP} · {owner.name}{ending}"
    if tree is None:
        tree = bpy.data.node_groups.new(f"{GROUP} · {owner.name}{ending}", "ShaderNodeTree")
        owner.mark(tree, role)
        tree.interface.new_socket("Class Color", in_out="INPUT", socket_type="NodeSocketColor")
        tree.interface.new_socket("Color", in_out="OUTPUT", socket_type="NodeSocketColor")
    elif _kept(tree, root, texture):
        return tree
    _clear(tree)
    given, result = tree.nodes.new("NodeGroupInput"), tree.nodes.new("NodeGroupOutput")
    if texture is None:
        photo = tree.nodes.new("ShaderNodeAttribute")
        photo.attribute_name = COLOR_ATTRIBUTE
    else:
        photo = tree.nodes.new("ShaderNodeTexImage")
        photo.image = texture
    sure = tree.nodes.new("ShaderNodeAttribute")
    sure.attribute_name = CONFIDENCE_ATTRIBUTE
    mixed = _blend(tree, root, photo.outputs["Color"], given.outputs[0], sure.outputs["Fac"])
    tree.links.new(mixed, result.inputs[0])
    _place(tree)
    tree[WRITTEN] = tree_fingerprint(tree)
    return tree


def viewport_group(owner: Owner, root: bpy.types.Object) -> bpy.types.NodeTree:
    """The geometry-nodes group that fills the attribute which Workbench draws; built anew where the project has it,
    unless the user changed its nodes."""
    role = "colors:viewport"
    name = f"{VIEWPORT_GROUP} · {owner.name}"
    tree = find(bpy.data.node_groups, owner, role, name, lambda tree: may_follow(tree, root))
    if tree is None:
        tree = bpy.data.node_groups.new(f"{VIEWPORT_GROUP} · {owner.name}", "GeometryNodeTree")
        owner.mark(tree, role)
        for side in ("INPUT", "OUTPUT"):
            tree.interface.new_socket("Geometry", in_out=side, socket_type="NodeSocketGeometry")
    elif _kept(tree, root):
        return tree
    _clear(tree)
    given, result = tree.nodes.new("NodeGroupInput"), tree.nodes.new("NodeGroupOutput")
    photo = _attribute(tree, COLOR_ATTRIBUTE, "FLOAT_COLOR")
    label = _attribute(tree, CLASS_COLOR_ATTRIBUTE, "FLOAT_COLOR")
    mixed = _blend(tree, root, photo, label, _attribute(tree, CONFIDENCE_ATTRIBUTE, "FLOAT"))
    store = tree.nodes.new("GeometryNodeStoreNamedAttribute")
    store.data_type, store.domain = "BYTE_COLOR", "CORNER"
    store.inputs["Name"].default_value = SHOWN_ATTRIBUTE
    tree.links.new(given.outputs[0], store.inputs["Geometry"])
    tree.links.new(mixed, next(s for s in store.inputs if s.enabled and s.name == "Value"))
    tree.links.new(store.outputs[0], result.inputs[0])
    _place(tree)
    tree[WRITTEN] = tree_fingerprint(tree)
    return tree


def add_viewport_colors(item: bpy.types.Object, tree: bpy.types.NodeTree) -> None:
    """Let Workbench draw a surface by the slider, in the viewport and in renders of its own."""
    modifier = item.modifiers.get(MODIFIER) or item.modifiers.new(MODIFIER, "NODES")
    modifier.node_group = tree


def _kept(tree: bpy.types.NodeTree, root: bpy.types.Object, texture: bpy.types.Image | None = None) -> bool:
    """Whether a group has nodes that the user changed: then it only follows the parent and the texture."""
    if WRITTEN not in tree or tree[WRITTEN] == tree_fingerprint(tree):
        return False
    for curve in tree.animation_data.drivers if tree.animation_data else ():
        for variable in curve.driver.variables:
            if variable.targets[0].data_path == SLIDER:
                variable.targets[0].id = root
    for node in tree.nodes:
        if node.type == "TEX_IMAGE" and texture is not None and (node.image is None or TEXTURE in node.image):
            node.image = texture
    return True


def _clear(tree: bpy.types.NodeTree) -> None:
    tree.animation_data_clear()
    tree.nodes.clear()


def _attribute(tree: bpy.types.NodeTree, name: str, kind: str) -> bpy.types.NodeSocket:
    node = tree.nodes.new("GeometryNodeInputNamedAttribute")
    node.data_type = kind
    node.inputs["Name"].default_value = name
    return next(socket for socket in node.outputs if socket.enabled)


def _blend(tree: bpy.types.NodeTree, root: bpy.types.Object, photo: Any, label: Any, sure: Any) -> bpy.types.NodeSocket:
    """Photo at 0 of the slider, label at 1, confidence at 2, blended between."""
    switch = _slider(tree, root)
    ramp = tree.nodes.new("ShaderNodeValToRGB")
    while len(ramp.color_ramp.elements) < len(RAMP):
        ramp.color_ramp.elements.new(0.5)
    for element, (position, color) in zip(ramp.color_ramp.elements, RAMP):
        element.position, element.color = position, (*color, 1.0)
    tree.links.new(sure, ramp.inputs[0])
    first = _mix(tree, switch, photo, label)
    second = tree.nodes.new("ShaderNodeMath")
    second.operation = "SUBTRACT"
    second.inputs[1].default_value = 1.0
    tree.links.new(switch, second.inputs[0])
    return _mix(tree, second.outputs[0], first, ramp.outputs[0])


def _mix(tree: bpy.types.NodeTree, factor: Any, a: Any, b: Any) -> bpy.types.NodeSocket:
    """The colour `a` at factors up to 0, `b` from 1 on."""
    node = tree.nodes.new("ShaderNodeMix")
    node.data_type = "RGBA"
    node.clamp_factor = True
    # The Mix node has sockets for every data type; the colour ones are inputs 6 and 7 and output 2.
    for source, index in ((factor, 0), (a, 6), (b, 7)):
        tree.links.new(source, node.inputs[index])
    return node.outputs[2]


def _slider(tree: bpy.types.NodeTree, root: bpy.types.Object) -> bpy.types.NodeSocket:
    """A value that follows the slider of the parent."""
    node = tree.nodes.new("ShaderNodeValue")
    driver = node.outputs[0].driver_add("default_value").driver
    driver.type = "AVERAGE"  # a plain copy: needs no script execution
    variable = driver.variables.new()
    variable.type = "SINGLE_PROP"
    variable.targets[0].id = root
    variable.targets[0].data_path = SLIDER
    return node.outputs[0]


def _place(tree: bpy.types.NodeTree) -> None:
    for column, node in enumerate(tree.nodes):
        node.location = (260 * (column // 2), -320 * (column % 2))
